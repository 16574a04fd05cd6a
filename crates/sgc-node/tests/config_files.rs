//! Configuration files on the disk, and the files that they name.

use std::fs;
use std::os::unix::fs::PermissionsExt;
use std::path::Path;

use sgc_node::config::{ArgsConfig, Config, ConfigErrors, Mistake, Origin, load, load_args};

/// The least that every node needs.
const NODE: &str = "identity = 'x'\nnode.routers = ['quic://r:7447']\n";

fn no_env(_: &str) -> Option<String> {
    None
}

#[test]
fn files_with_certificates_and_tokens_are_read_before_anything_is_done() {
    let dir = tempfile::tempdir().unwrap();
    let path = |name: &str| dir.path().join(name);
    fs::write(path("x"), "").unwrap();
    fs::set_permissions(path("x"), fs::Permissions::from_mode(0o600)).unwrap();
    fs::write(path("bad.pem"), "no certificate").unwrap();
    fs::write(path("t.token"), "sgc-token-1:AAAAAAAA").unwrap();
    let text = "identity = 'x'\nnode.routers = ['quic://r']\nnode.trust = ['none.pem', 'bad.pem']\n\
                [[use]]\ntoken = 't.token'\n[authority]\nfleet = 'lab.fleet'";
    fs::write(path("node.toml"), text).unwrap();
    let said = |dir: &Path| {
        let errors = load(&dir.join("node.toml"), &no_env).unwrap_err().to_string();
        errors.replace(&format!("{}/", dir.display()), "")
    };
    let ca = "it must be a file of CA certificates in PEM, such as `sgc fleet show --ca` prints";
    assert_eq!(
        said(dir.path()).lines().collect::<Vec<_>>(),
        [
            &format!(
                "node.toml:3: `trust` is none.pem: it cannot be read: No such file or directory (os error 2); {ca}"
            ),
            &format!(
                "node.toml:3: `trust` is bad.pem: no CA certificate is given: at least one is needed; {ca}"
            ),
            "node.toml:5: `token` is t.token: its mode 0644 lets others at the topic's secret; `chmod 600 t.token`",
            "node.toml:7: `fleet` is lab.fleet: no such file; it must be a file that this user may read",
        ]
    );
    fs::set_permissions(path("t.token"), fs::Permissions::from_mode(0o600)).unwrap();
    assert!(said(dir.path()).contains("its checksum is wrong"), "{}", said(dir.path()));
}

#[test]
fn files_of_a_gateway_are_looked_at() {
    let dir = tempfile::tempdir().unwrap();
    let (file, key) = (dir.path().join("node.toml"), dir.path().join("robot.key"));
    let identity = dir.path().join("x");
    for path in [&identity, &key] {
        fs::write(path, "nothing").unwrap();
        fs::set_permissions(path, fs::Permissions::from_mode(0o600)).unwrap();
    }
    fs::write(dir.path().join("robot.pem"), "nothing").unwrap();
    let gateway = "[gateway]\nlisten = ['wss://127.0.0.1']\ncertificate = 'robot.pem'\nkey = 'robot.key'\n";
    fs::write(&file, format!("{NODE}{gateway}")).unwrap();
    let told = || -> Vec<String> {
        let place = dir.path().display().to_string();
        let errors = load(&file, &no_env).unwrap_err();
        errors.iter().map(|error| error.to_string().replace(&place, "DIR")).collect()
    };
    let said = told();
    let lines: Vec<_> = said.iter().map(|line| &line[..16]).collect();
    assert_eq!(lines, ["DIR/node.toml:5:", "DIR/node.toml:6:"]);
    assert!(said[0].contains("no certificate is in it"), "{}", said[0]);
    assert!(said[1].contains("no private key is in it"), "{}", said[1]);
    fs::set_permissions(&key, fs::Permissions::from_mode(0o644)).unwrap();
    assert!(told()[1].contains("its mode 0644 lets others at the private key"), "{}", told()[1]);
}

#[test]
fn files_of_a_store_are_looked_at() {
    let dir = tempfile::tempdir().unwrap();
    let path = |name: &str| dir.path().join(name);
    let write = |name: &str, text: &str, mode: u32| {
        fs::write(path(name), text).unwrap();
        fs::set_permissions(path(name), fs::Permissions::from_mode(mode)).unwrap();
    };
    write("x", "nothing", 0o600);
    write("password", "secret\n", 0o640);
    write("ca.pem", "nothing", 0o644);
    let router = "identity = 'x'\n[router]\nlisten = ['quic://127.0.0.1:0']\nmapping = 'store'\n\
                  store = ['valkeys://store.example']\nstore_user = 'router'\n\
                  store_password_file = 'password'\nstore_ca = 'ca.pem'\n";
    fs::write(path("node.toml"), router).unwrap();
    let told = || -> Vec<String> {
        let place = format!("{}/", dir.path().display());
        let errors = load(&path("node.toml"), &no_env).unwrap_err();
        errors.iter().map(|error| error.to_string().replace(&place, "")).collect()
    };
    let said = told();
    let [exposed, ca] = &said[..] else { panic!("{said:?}") };
    assert_eq!(
        exposed,
        "node.toml:7: `store_password_file` is password: its mode 0640 lets others at the password; `chmod 600 password`"
    );
    assert!(
        ca.starts_with("node.toml:8: `store_ca` is ca.pem") && ca.contains("no certificate is in it"),
        "{ca}"
    );
    write("password", "\n", 0o600);
    assert!(told()[0].contains("1 to 1024 bytes"), "{:?}", told());
    write("password", &"a".repeat(100_000), 0o600);
    assert!(told()[0].contains("1 to 1024 bytes"), "{:?}", told());
    write("password", "secret\n", 0o600);
    assert_eq!(told().len(), 1, "{:?}", told());
    fs::write(path("node.toml"), router.replace("'router'", "'a b'")).unwrap();
    assert!(
        told()[0].contains("`store_user`: the name of a store's user has 1 to 255 characters"),
        "{:?}",
        told()
    );
}

#[cfg(feature = "zenoh")]
#[test]
fn session_configuration_of_zenoh_is_looked_at() {
    let dir = tempfile::tempdir().unwrap();
    let path = |name: &str| dir.path().join(name);
    fs::write(path("x"), "nothing").unwrap();
    fs::set_permissions(path("x"), fs::Permissions::from_mode(0o600)).unwrap();
    let zenoh = "[ros]\nmiddleware = 'zenoh'\n[ros.zenoh]\nconfig = 'session.json5'\n";
    fs::write(path("node.toml"), format!("{NODE}{zenoh}")).unwrap();
    let told = || {
        let place = format!("{}/", dir.path().display());
        load(&path("node.toml"), &no_env).map_err(|errors| errors.to_string().replace(&place, ""))
    };
    let expected = |reason: &str| {
        format!(
            "node.toml:6: `config` is session.json5: {reason}; it must be a session configuration of Zenoh, such as \
             rmw_zenoh's, that this user may read"
        )
    };
    assert_eq!(told(), Err(expected("No such file or directory (os error 2)")));
    fs::write(path("session.json5"), "\n").unwrap();
    assert_eq!(told(), Err(expected("it is empty")));
    fs::write(path("session.json5"), " ".repeat((1 << 20) + 1)).unwrap();
    assert_eq!(told(), Err(expected("it has more than 1048576 bytes")));
    fs::write(path("session.json5"), "{ mode: 'client' }").unwrap();
    let config = told().unwrap().ros.unwrap().zenoh.config;
    assert_eq!(config, Some(path("session.json5")));
    // The same holds for the variable.
    fs::write(path("node.toml"), format!("{NODE}[ros]\nmiddleware = 'zenoh'\n")).unwrap();
    let uri = |name: &str| (name == "ZENOH_SESSION_CONFIG_URI").then(|| "/nowhere/session.json5".to_owned());
    let errors = load(&path("node.toml"), &uri).unwrap_err().to_string();
    assert!(
        errors.starts_with("environment: `ZENOH_SESSION_CONFIG_URI` is /nowhere/session.json5: No such"),
        "{errors}"
    );
}

#[test]
fn the_identity_file_is_checked_when_loading() {
    let dir = tempfile::tempdir().unwrap();
    let file = dir.path().join("node.toml");
    let identity = dir.path().join("arm-1.identity");
    let write = |text: &str| fs::write(&file, text).unwrap();
    let chmod = |mode| fs::set_permissions(&identity, fs::Permissions::from_mode(mode)).unwrap();
    let said = |result: Result<Config, ConfigErrors>| {
        result.unwrap_err().to_string().replace(&dir.path().display().to_string(), "DIR")
    };

    write("node.routers = ['quic://r:7447']\nnode.name = 'arm-1'");
    assert_eq!(
        said(load(&file, &no_env)),
        "DIR/node.toml:2: `identity` is DIR/arm-1.identity (after the node's name): no such file; `sgc fleet enroll \
         arm-1 --out DIR/arm-1.identity` makes one"
    );
    write("identity = 'arm-1.identity'\nnode.routers = ['quic://r:7447']");
    assert_eq!(
        said(load(&file, &no_env)),
        "DIR/node.toml:1: `identity` is DIR/arm-1.identity: no such file; `sgc fleet enroll NODE --out \
         DIR/arm-1.identity` makes one"
    );
    fs::create_dir(&identity).unwrap();
    assert_eq!(
        said(load(&file, &no_env)),
        "DIR/node.toml:1: `identity` is DIR/arm-1.identity: not a file; it must be a file that this user may read"
    );
    fs::remove_dir(&identity).unwrap();
    fs::write(&identity, "secret").unwrap();
    for mode in [0o644, 0o640, 0o602, 0o601] {
        chmod(mode);
        assert_eq!(
            said(load(&file, &no_env)),
            format!(
                "DIR/node.toml:1: `identity` is DIR/arm-1.identity: its mode {mode:04o} lets others at the private key; \
                 `chmod 600 DIR/arm-1.identity` and, if others had access, enrol again"
            )
        );
    }
    for mode in [0o600, 0o400] {
        chmod(mode);
        assert_eq!(load(&file, &no_env).unwrap().identity, identity);
    }
    let from_args = ArgsConfig {
        identity: Some(identity.clone()),
        routers: vec!["quic://r:7447".into()],
        ..ArgsConfig::default()
    };
    assert_eq!(load_args(&from_args, &no_env).unwrap().identity, identity);
    chmod(0o666);
    assert!(
        said(load_args(&from_args, &no_env))
            .starts_with("command line: `--identity` is DIR/arm-1.identity: its mode 0666")
    );
}

#[test]
fn a_file_that_cannot_be_read_is_told() {
    let dir = tempfile::tempdir().unwrap();
    let file = dir.path().join("node.toml");
    let mistake =
        || load(&file, &no_env).unwrap_err().iter().map(|error| (*error.mistake).clone()).next().unwrap();
    assert!(matches!(mistake(), Mistake::Unreadable { reason } if reason.contains("No such file")));
    fs::write(&file, b"a = 1\n\xff").unwrap();
    assert_eq!(mistake(), Mistake::Unreadable { reason: "line 2 is not UTF-8 text".to_owned() });
    fs::write(&file, vec![b'#'; 5 * 1024 * 1024]).unwrap();
    assert_eq!(mistake(), Mistake::TooLarge { bytes: 5 * 1024 * 1024, max: 4 * 1024 * 1024 });
    let errors = load(dir.path(), &no_env).unwrap_err();
    assert!(matches!(errors.iter().next().unwrap().origin, Origin::File { line: None, .. }));
}
