//! Tests of files, output and exit codes of the real binary.

#![allow(clippy::unwrap_used)]

use std::collections::{BTreeMap, BTreeSet};
use std::fs;
use std::io::{BufRead as _, BufReader, Read as _, Write as _};
use std::os::unix::fs::PermissionsExt;
use std::os::unix::net::UnixListener;
use std::path::Path;
use std::process::{Command, Output, Stdio};

use serde_json::Value;
use sgc_node::admin::TapHead;
use sgc_trust::{EnrollRequest, Fleet, Identity, derive_name};
use sgc_wire::{Metadata, UnixMillis};
use tempfile::TempDir;

const NAME_ARGS: [&str; 7] =
    ["name", "--topic", "/camera/image", "--type", "sensor_msgs/msg/Image", "--identity", "arm-1.identity"];

/// A directory in which `sgc` runs, without the user's environment.
struct Place {
    dir: TempDir,
}

/// The result of a run.
#[derive(Debug)]
struct Ran {
    code: Option<i32>,
    stdout: String,
    stderr: String,
}

impl Place {
    fn new() -> Self {
        Self { dir: tempfile::tempdir().unwrap() }
    }

    /// Returns a place with the fleet `lab`, the nodes `arm-1` and `desk`, and the router `cloud`.
    fn with_fleet() -> Self {
        let place = Self::new();
        place.good(&["fleet", "create", "lab"]);
        place.good(&["fleet", "enroll", "arm-1", "--group", "arms"]);
        place.good(&["fleet", "enroll", "desk"]);
        place.good(&["fleet", "enroll", "cloud", "--role", "router"]);
        place
    }

    fn path(&self) -> &Path {
        self.dir.path()
    }

    fn command(&self, args: &[&str]) -> Command {
        let mut command = Command::new(env!("CARGO_BIN_EXE_sgc"));
        command
            .args(args)
            .current_dir(self.path())
            .env_clear()
            .env("XDG_RUNTIME_DIR", self.path())
            .stdin(Stdio::null());
        command
    }

    fn run(&self, args: &[&str]) -> Ran {
        Ran::from(self.command(args).output().unwrap())
    }

    /// Returns standard output of a run that must succeed and print nothing to standard error.
    fn good(&self, args: &[&str]) -> String {
        let ran = self.run(args);
        assert_eq!((ran.code, ran.stderr.as_str()), (Some(0), ""), "{args:?}");
        ran.stdout
    }

    /// Returns standard error of a run that must fail with this code and print nothing to standard output.
    fn bad(&self, code: i32, args: &[&str]) -> String {
        let ran = self.run(args);
        assert_eq!((ran.code, ran.stdout.as_str()), (Some(code), ""), "{args:?}: {}", ran.stderr);
        ran.stderr
    }

    /// Checks that a run fails with exactly this line.
    fn says(&self, code: i32, args: &[&str], line: &str) {
        assert_eq!(self.bad(code, args), format!("sgc: {line}\n"), "{args:?}");
    }

    fn write(&self, file: &str, text: &str) {
        fs::write(self.path().join(file), text).unwrap();
    }

    fn read(&self, file: &str) -> String {
        fs::read_to_string(self.path().join(file)).unwrap()
    }

    fn mode(&self, file: &str) -> u32 {
        fs::metadata(self.path().join(file)).unwrap().permissions().mode() & 0o7777
    }

    fn set_mode(&self, file: &str, mode: u32) {
        fs::set_permissions(self.path().join(file), fs::Permissions::from_mode(mode)).unwrap();
    }

    fn files(&self) -> Vec<String> {
        let entries = fs::read_dir(self.path()).unwrap();
        let mut names: Vec<_> =
            entries.map(|entry| entry.unwrap().file_name().into_string().unwrap()).collect();
        names.sort();
        names
    }

    fn identity(&self, file: &str) -> Identity {
        Identity::parse(&self.read(file)).unwrap()
    }
}

impl From<Output> for Ran {
    fn from(output: Output) -> Self {
        Self {
            code: output.status.code(),
            stdout: String::from_utf8(output.stdout).unwrap(),
            stderr: String::from_utf8(output.stderr).unwrap(),
        }
    }
}

#[test]
fn a_fleet_is_made_for_its_owner_alone_and_never_overwritten() {
    let place = Place::new();
    let said = place.good(&["fleet", "create", "lab"]);
    assert!(said.starts_with("lab.fleet: fleet lab, "), "{said}");
    assert!(said.contains("sgc fleet enroll "), "{said}");
    assert_eq!(place.mode("lab.fleet"), 0o600);
    let before = place.read("lab.fleet");
    assert_eq!(Fleet::parse(&before).unwrap().name().as_str(), "lab");

    place.says(
        2,
        &["fleet", "create", "lab"],
        "lab.fleet exists already; a fleet is never overwritten: its nodes would no longer be known",
    );
    assert_eq!(place.read("lab.fleet"), before);
    assert_eq!(place.files(), ["lab.fleet"]);
}

#[test]
fn a_fleet_goes_where_it_is_told() {
    let place = Place::new();
    fs::create_dir(place.path().join("keys")).unwrap();
    let said = place.good(&["fleet", "create", "lab", "--dir", "keys"]);
    assert!(said.contains("--fleet keys/lab.fleet"), "{said}");
    place.good(&["fleet", "enroll", "arm-1", "--fleet", "keys/lab.fleet", "--out", "keys/a"]);
    assert_eq!(place.mode("keys/a"), 0o600);
    let said = place.bad(1, &["fleet", "create", "lab", "--dir", "nowhere"]);
    assert!(said.starts_with("sgc: cannot write nowhere/lab.fleet: "), "{said}");
}

#[test]
fn an_identity_is_what_was_asked_for() {
    let place = Place::new();
    place.good(&["fleet", "create", "lab"]);
    let said = place.good(&["fleet", "enroll", "arm-1", "--group", "b", "--group", "a", "--valid", "3d"]);
    assert!(said.starts_with("arm-1.identity: node arm-1 of fleet lab, in b, a, holds until "), "{said}");
    assert!(said.contains("sgc run --identity arm-1.identity "), "{said}");
    assert_eq!(place.mode("arm-1.identity"), 0o600);
    let identity = place.identity("arm-1.identity");
    let fleet = Fleet::parse(&place.read("lab.fleet")).unwrap();
    assert_eq!((identity.node_name().as_str(), identity.fleet_name().as_str()), ("arm-1", "lab"));
    let tags = ["a", "b"].map(|group| fleet.secret().group_tag(group));
    assert!(tags.iter().all(|tag| identity.groups().contains(tag)) && identity.groups().len() == 2);
    let left = identity.not_after().secs() - now().secs();
    assert!((3 * 86_400 - 600..=3 * 86_400).contains(&left), "{left}");

    place.good(&["fleet", "enroll", "desk"]);
    let left = place.identity("desk.identity").not_after().secs() - now().secs();
    assert!((90 * 86_400 - 600..=90 * 86_400).contains(&left), "{left}");
}

#[test]
fn a_routers_identity_has_no_secret() {
    let place = Place::with_fleet();
    assert!(place.identity("cloud.identity").fleet_secret().is_none());
    assert!(place.identity("arm-1.identity").fleet_secret().is_some());
}

#[test]
fn an_identity_is_overwritten_only_by_force() {
    let place = Place::with_fleet();
    let before = place.read("arm-1.identity");
    let said = place.bad(2, &["fleet", "enroll", "arm-1"]);
    assert!(said.starts_with("sgc: arm-1.identity exists already; --force replaces it"), "{said}");
    assert_eq!(place.read("arm-1.identity"), before);
    let id = place.identity("arm-1.identity").node_id();

    place.set_mode("arm-1.identity", 0o644);
    place.good(&["fleet", "enroll", "arm-1", "--force"]);
    assert_ne!(place.read("arm-1.identity"), before);
    assert_eq!(place.mode("arm-1.identity"), 0o600);
    assert_eq!(place.identity("arm-1.identity").node_id(), id);
    let left = ["arm-1.identity", "cloud.identity", "desk.identity", "lab.fleet"];
    assert_eq!(place.files(), left, "no file is left over");
}

#[test]
fn ambiguous_fleet_is_refused() {
    let place = Place::new();
    place.says(
        2,
        &["fleet", "enroll", "arm-1"],
        "no fleet file here: name one with --fleet FILE, or make a fleet with `sgc fleet create NAME`",
    );
    place.good(&["fleet", "create", "lab"]);
    place.good(&["fleet", "create", "field"]);
    place.says(
        2,
        &["fleet", "enroll", "arm-1"],
        "which fleet? Name one with --fleet: field.fleet, lab.fleet",
    );
    place.good(&["fleet", "enroll", "arm-1", "--fleet", "field.fleet"]);
    assert_eq!(place.identity("arm-1.identity").fleet_name().as_str(), "field");
}

#[test]
fn a_fleet_file_that_will_not_do_is_refused() {
    let place = Place::with_fleet();
    place.set_mode("lab.fleet", 0o640);
    place.says(
        2,
        &["fleet", "enroll", "new"],
        "lab.fleet: its mode 0640 lets others at the CA's private key: chmod 600 lab.fleet",
    );
    place.write("broken.fleet", "nothing");
    place.set_mode("broken.fleet", 0o600);
    let said = place.bad(2, &["fleet", "enroll", "new", "--fleet", "broken.fleet"]);
    assert!(said.starts_with("sgc: broken.fleet: ") && said.lines().count() == 1, "{said}");
    let said = place.bad(1, &["fleet", "enroll", "new", "--fleet", "absent.fleet"]);
    assert!(said.starts_with("sgc: cannot read absent.fleet: "), "{said}");
    assert!(!place.path().join("new.identity").exists());
}

#[test]
fn names_that_are_none_are_refused_with_the_rule() {
    let place = Place::with_fleet();
    for args in [
        &["fleet", "create", "Lab"][..],
        &["fleet", "enroll", "Lab"],
        &["fleet", "enroll", "x", "--group", "Lab"],
    ] {
        let said = place.bad(2, args);
        let rule = "name \"Lab\" cannot contain 'L': use a-z, 0-9, '-', '_' and '.'\n";
        assert!(said.starts_with("sgc: ") && said.ends_with(rule), "{said}");
    }
}

#[test]
fn a_good_configuration_is_summed_up() {
    let place = Place::with_fleet();
    place.write(
        "node.toml",
        r#"
        [node]
        name = "arm-1"
        routers = ["quic://router.lab.example"]
        [ros]
        domain_id = 7
        discovery_range = "localhost"
        [[share]]
        topic = "/camera/image"
        type = "sensor_msgs/msg/Image"
        to = ["desk", "group:operators"]
        [[share]]
        topic = "/tf"
        to = ["*"]
        [[use]]
        from = "desk"
        topic = "/cmd_vel"
        "#,
    );
    let name = place.good(&[&NAME_ARGS[..], &["--owner", "arm-1"]].concat());
    let until = place.identity("arm-1.identity").not_after();
    let expected = format!(
        "node.toml: no mistakes\n\
         node      arm-1 of fleet lab\n\
         identity  arm-1.identity, holds until {until}\n\
         dials     quic://router.lab.example:7447\n\
         ROS 2     domain 7, this host\n\
         shares    /camera/image [sensor_msgs/msg/Image] with desk, group:operators\n          \
         named {name}\
         shares    /tf with everyone in the fleet\n\
         uses      /cmd_vel from desk\n\
         warning   `to` of /camera/image names \"group:operators\", and no node of the fleet is in that group\n"
    );
    assert_eq!(place.good(&["check", "-c", "node.toml"]), expected);
    // The configuration alone cannot show that no node has a name.
    let text = place.read("node.toml");
    place.write("node.toml", &text.replace("\"desk\"", "\"deks\"").replace("operators", "arms"));
    let said = place.good(&["check", "-c", "node.toml"]);
    for key in ["`to` of /camera/image", "`from` of /cmd_vel"] {
        let warning = format!(
            "warning   {key} names \"deks\", and the fleet has no node of that name; did you mean \"desk\"?\n"
        );
        assert!(said.contains(&warning), "{said}");
    }
    assert_eq!(said.matches("warning").count(), 2, "{said}");
    // The fleet file may be elsewhere, as on the laptop of the fleet's keeper.
    fs::create_dir(place.path().join("safe")).unwrap();
    fs::rename(place.path().join("lab.fleet"), place.path().join("safe/lab.fleet")).unwrap();
    assert!(!place.good(&["check", "-c", "node.toml"]).contains("warning"), "nobody can say");
    let there = place.good(&["check", "-c", "node.toml", "--fleet", "safe/lab.fleet"]);
    assert_eq!(there, said);
    assert!(place.bad(1, &["check", "-c", "node.toml", "--fleet", "lab.fleet"]).contains("lab.fleet"));
    place.good(&["fleet", "create", "acme"]);
    let other = place.bad(1, &["check", "-c", "node.toml", "--fleet", "acme.fleet"]);
    assert!(other.contains("acme.fleet is the file of another fleet than that of arm-1"), "{other}");
}

#[test]
fn check_warns_of_a_state_directory_that_others_may_enter() {
    let place = Place::with_fleet();
    place
        .write("node.toml", "identity = 'arm-1.identity'\n[node]\nrouters = ['quic://r']\nstate = 'state'\n");
    let check = ["check", "-c", "node.toml"];
    assert!(!place.good(&check).contains("warning"), "it is made when the node starts");
    fs::create_dir(place.path().join("state")).unwrap();
    for (mode, warns) in [(0o755, true), (0o700, false)] {
        fs::set_permissions(place.path().join("state"), fs::Permissions::from_mode(mode)).unwrap();
        let said = place.good(&check);
        assert_eq!(said.contains("its mode 0755 lets others in; chmod 700 it"), warns, "{said}");
    }
}

#[test]
fn check_lists_router_discovery_and_admission() {
    let place = Place::with_fleet();
    let ca = place.good(&["fleet", "ca"]);
    place.write("lab-ca.pem", &ca);
    place.write(
        "node.toml",
        "[node]\nname = 'arm-1'\nrouters = ['srv://lab.example', 'mdns://', 'mdns://cloud']\nresolver = '10.0.0.53'\n\
         [router]\nlisten = ['quic://0.0.0.0:7447']\nannounce = true\naccept = ['lab-ca.pem']\n",
    );
    let said = place.good(&["check", "-c", "node.toml"]);
    let expected = "finds     srv://lab.example, one of those that _sgc._udp.lab.example names in DNS\n\
                    finds     mdns://, routers of the local network that are trusted\n\
                    finds     mdns://cloud, router cloud on the local network\n          \
                    looked up at 10.0.0.53:53\n\
                    listens   quic://0.0.0.0:7447\n          \
                    announced on the local network by mDNS\n\
                    accepts   nodes of the CAs in lab-ca.pem only\n";
    assert!(said.contains(expected), "{said}");
    let text = "identity = 'cloud.identity'\n[node]\nrouters = ['mdns://cloud']\n";
    place.write("router.toml", text);
    let said = place.bad(2, &["check", "-c", "router.toml"]);
    assert!(said.contains("cannot tell nodes by their names: write \"mdns://\""), "{said}");
}

#[test]
fn every_mistake_is_told_with_its_line() {
    let place = Place::with_fleet();
    place.write(
        "node.toml",
        "identity = 'arm-1.identity'\n\
         [node]\n\
         router = ['quic://a']\n\
         [[share]]\n\
         topic = 'camera/image'\n\
         to = ['Desk']\n\
         [[use]]\n\
         topic = '/cmd_vel'\n",
    );
    assert_eq!(
        place.bad(2, &["check", "-c", "node.toml"]),
        "node.toml:3: [node] has no key `router`; did you mean `routers`?\n\
         node.toml:5: `topic` is \"camera/image\"; a topic name starts with '/': \"/camera/image\"\n\
         node.toml:6: `to` names \"Desk\"; name nodes (\"desk\"), groups (\"group:operators\"), partners \
         (\"partner:acme\") or \"*\", names of 1 to 64 of a-z, 0-9, '-', '_' and '.'\n\
         node.toml:7: [[use]] has no `from`; add one, such as from = \"arm-1\"\n\
         sgc: node.toml: 4 mistakes\n"
    );
    assert_eq!(
        place.bad(2, &["check", "-c", "absent.toml"]),
        "absent.toml: cannot read the configuration: No such file or directory (os error 2)\n\
         sgc: absent.toml: 1 mistake\n"
    );
}

#[test]
fn run_tells_the_mistakes_that_check_tells() {
    let place = Place::with_fleet();
    place.write("node.toml", "identity = 'arm-1.identity'\n[node]\nrouter = ['quic://a']\n");
    let said = place.bad(2, &["check", "-c", "node.toml"]);
    assert_eq!(place.bad(2, &["run", "-c", "node.toml"]), said);
    assert_eq!(place.bad(2, &["status", "-c", "node.toml"]), said);
}

#[test]
fn an_identity_of_another_node_or_a_router_is_found_by_check() {
    let place = Place::with_fleet();
    let start = "[node]\nname = 'desk'\nrouters = ['quic://a']\n";
    place.write("other.toml", &format!("identity = 'arm-1.identity'\n{start}"));
    let said = place.bad(2, &["check", "-c", "other.toml"]);
    assert!(said.starts_with("sgc: other.toml: "), "{said}");
    assert!(said.contains("\"desk\"") && said.contains("\"arm-1\"") && said.lines().count() == 1, "{said}");

    let text =
        "identity = 'cloud.identity'\n[node]\nrouters = ['quic://a']\n[[use]]\nfrom = 'desk'\ntopic = '/t'\n";
    place.write("router.toml", text);
    let said = place.bad(2, &["check", "-c", "router.toml"]);
    assert!(said.starts_with("sgc: router.toml: this identity is a router's"), "{said}");
}

#[test]
fn an_expired_identity_is_found_by_check() {
    let place = Place::new();
    let mut rng = <rand_chacha::ChaCha20Rng as rand_core::SeedableRng>::from_seed([5; 32]);
    let then = UnixMillis(now().0 - 100 * 86_400_000);
    let fleet = Fleet::create("lab".parse().unwrap(), then, &mut rng).unwrap();
    let old = fleet.issue(&EnrollRequest::new("arm-1".parse().unwrap(), then), &mut rng).unwrap();
    place.write("arm-1.identity", &old.to_text());
    place.set_mode("arm-1.identity", 0o600);
    place.write("node.toml", "[node]\nname = 'arm-1'\nrouters = ['quic://127.0.0.1:1']\n");
    let said = place.bad(2, &["check", "-c", "node.toml"]);
    assert!(said.contains("arm-1.identity") && said.contains("expired"), "{said}");
}

#[test]
fn check_warns_of_a_certificate_that_ends_soon_and_of_metrics_that_others_reach() {
    let place = Place::new();
    place.good(&["fleet", "create", "lab"]);
    place.good(&["fleet", "enroll", "arm-1", "--valid", "10d"]);
    let base = "[node]\nname = 'arm-1'\nrouters = ['quic://127.0.0.1:1']\nstate = 'state'\n";
    let check = |metrics: &str| {
        place.write("node.toml", &format!("{base}{metrics}"));
        place.run(&["check", "-c", "node.toml"]).stdout
    };
    let said = check("[metrics]\n");
    assert!(said.contains("this node's certificate ends in 9 days"), "{said}");
    assert!(said.contains("http://127.0.0.1:9464/metrics") && !said.contains("neither encrypted"), "{said}");
    for (listen, warns) in [("[::1]:1", false), ("0.0.0.0:1", true), ("10.0.0.7:1", true)] {
        let said = check(&format!("[metrics]\nlisten = '{listen}'\n"));
        assert_eq!(said.contains("neither encrypted nor protected"), warns, "{said}");
    }
    place.write("node.toml", &format!("{base}[metrics]\nlisten = 'http://127.0.0.1:1'\n"));
    let said = place.bad(2, &["check", "-c", "node.toml"]);
    assert!(said.contains("it takes an IP address and a port"), "{said}");
}

#[test]
fn an_identity_that_others_can_read_is_refused() {
    let place = Place::with_fleet();
    place.set_mode("arm-1.identity", 0o644);
    let mistake = "its mode 0644 lets others at the private key; `chmod 600 arm-1.identity` and, if others had \
                   access, enrol again";
    let run = ["run", "--identity", "arm-1.identity", "--router", "quic://127.0.0.1:1"];
    assert_eq!(
        place.bad(2, &run),
        format!(
            "command line: `--identity` is arm-1.identity: {mistake}\n\
             sgc: command line: 1 mistake\n"
        )
    );
    let said = place.bad(2, &[&NAME_ARGS[..], &["--owner", "arm-1"]].concat());
    assert!(said.starts_with("sgc: identity arm-1.identity: "), "{said}");
}

#[test]
fn a_name_is_the_one_that_the_nodes_derive() {
    let place = Place::with_fleet();
    let args = |more: &[&'static str]| [&NAME_ARGS[..], more].concat();
    let name = place.good(&args(&["--owner", "arm-1"]));
    let identity = place.identity("desk.identity");
    let metadata = Metadata::topic("arm-1", "/camera/image", "sensor_msgs/msg/Image");
    let secret = identity.fleet_secret().unwrap();
    let owner = identity.node_id_of("arm-1").unwrap();
    assert_eq!(name, format!("{}\n", derive_name(secret, &owner, &metadata)));
    assert_eq!(name.trim_end().len(), 64);

    // The name is the same for other nodes, for both spellings of the type, and after the owner has a new key.
    place.good(&["fleet", "enroll", "arm-1", "--force"]);
    assert_eq!(place.good(&args(&["--owner", "arm-1"])), name);
    let dds = "sensor_msgs::msg::dds_::Image_";
    let asked = ["name", "--owner", "arm-1", "--topic", "/camera/image", "--type", dds];
    assert_eq!(place.good(&[&asked[..], &["--identity", "desk.identity"]].concat()), name);

    let full = Metadata {
        node: "/camera".into(),
        author: "Ada".into(),
        maintainer: "ops@example.org".into(),
        interface: "v4l2".into(),
        description: "the \"wrist\" camera, 50 µs".into(),
        unique: "left".into(),
        ..metadata
    };
    let said = place.good(&args(&[
        "--owner",
        "arm-1",
        "--ros-node",
        "/camera",
        "--author",
        "Ada",
        "--maintainer",
        "ops@example.org",
        "--interface",
        "v4l2",
        "--description",
        "the \"wrist\" camera, 50 µs",
        "--unique",
        "left",
    ]));
    assert_eq!(said, format!("{}\n", derive_name(secret, &owner, &full)));
}

#[test]
fn a_router_can_derive_no_name() {
    let place = Place::with_fleet();
    let args = ["name", "--owner", "arm-1", "--topic", "/t", "--type", "a/msg/B", "--identity"];
    place.says(
        2,
        &[&args[..], &["cloud.identity"]].concat(),
        "cloud.identity is a router's identity: it holds no fleet secret, so that a router can derive no name; use \
         a member's identity",
    );
}

#[test]
fn invalid_share_has_no_name() {
    let place = Place::with_fleet();
    let end = ["--owner", "arm-1", "--identity", "arm-1.identity"];
    for (topic, type_name, mistake) in [
        ("t", "a/msg/B", "`topic` is \"t\"; a topic name starts with '/': \"/t\""),
        ("/t", "a/B", "`type` is \"a/B\"; a message type is PACKAGE/msg/NAME: \"a/msg/B\""),
    ] {
        place.says(2, &[&["name", "--topic", topic, "--type", type_name], &end[..]].concat(), mistake);
    }
}

#[test]
fn usage_errors_are_one_line_and_code_2() {
    let place = Place::new();
    let bench = ["bench", "run", "--identity", "x", "--with", "desk", "--connect", "quic://desk"];
    place.says(2, &["fly"], "unrecognized subcommand 'fly'; see `sgc --help`");
    // Earlier spellings are refused with the present ones, whatever stands behind them.
    for (old, new) in [
        (&["share-token", "-c", "x.toml", "--topic", "/t"][..], "sgc token share create, list and revoke"),
        (&["share-token", "--list"], "sgc token share create, list and revoke"),
        (&["use", "pose.token", "-c", "x.toml"], "sgc token use"),
        (&["token", "create", "--for", "x"], "sgc token access create"),
        (&["token", "list", "--json"], "sgc token access list"),
        (&["token", "revoke", "3f9c"], "sgc token access revoke"),
        (&["policy", "test", "--identity", "desk", "--topic", "/t"], "sgc policy test NODE"),
        (&["fleet", "enroll", "hub", "--router"], "--role router"),
        (&["demo", "--seconds", "10"], "--duration 10s"),
        (&[&bench[..], &["--seconds", "5"]].concat(), "--duration 5s"),
        (&[&bench[..], &["--json", "run.json"]].concat(), "--json-file run.json"),
        (&["bench", "run", "--with", "desk", "--to", "quic://desk"], "--connect"),
        (&["fleet", "accept", "a.pem", "--ca", "ca.pem", "--node", "a"], "--node-name"),
        (&["fleet", "merge", "b.fleet", "--router", "quic://r"], "--push"),
        (&["fleet", "revoke", "a", "--router", "quic://r"], "--push"),
        (&["token", "share", "create", "--topic", "/t", "--router", "quic://r"], "--via"),
        (&["audit", "--peer", "ab"], "--about"),
        (&["--allow-core-dumps", "audit", "--peer", "ab"], "--about"),
        (&["fleet", "set", "--post-quantum", "false"], "--no-post-quantum"),
        (&["fleet", "set", "--post-quantum", "true"], "--post-quantum"),
        (&["fleet", "set", "--post-quantum=true"], "--post-quantum"),
        (&["policy", "test", "desk", "--topic", "/t", "--publish"], "--right publish"),
        (&["join", "--wait=1s"], "--timeout"),
        (&["name", "--owner", "a", "--node", "driver"], "--ros-node"),
        (&["topic", "pub", "/t", "--wait", "1"], "--wait-subscribers"),
        (&["topic", "pub", "/t", "-w", "1"], "--wait-subscribers"),
        (&["topic", "pub", "/t", "-w1"], "--wait-subscribers"),
    ] {
        let said = place.bad(2, old);
        assert!(said.contains("has another name now") && said.trim_end().ends_with(new), "{old:?}: {said}");
    }
    assert!(
        place
            .bad(2, &["fleet", "enroll", "x", "--role", "router", "--may-route"])
            .contains("--may-route out")
    );
    let said = place.bad(2, &["token", "access", "create", "--for", "x", "--valid", "soon"]);
    assert!(said.trim_end().ends_with("see `sgc token access create --help`"), "{said}");
    place.says(
        2,
        &["statos"],
        "unrecognized subcommand 'statos'; a similar subcommand exists: 'status'; see `sgc --help`",
    );
    for args in [
        &["fleet", "enroll"][..],
        &["fleet", "enroll", "a", "--valid", "0d"],
        &["demo", "--duration", "0s"],
        &["demo", "--duration", "8d"],
        &["topic", "echo", "/t", "--timeout", "soon"],
        &["check"],
        &["router", "--identity", "x"],
        &["run", "-c", "node.toml", "--share", "/t"],
        &["status", "-c", "node.toml", "--socket", "x"],
    ] {
        let said = place.bad(2, args);
        assert!(said.starts_with("sgc: ") && said.lines().count() == 1, "{args:?}: {said}");
    }
    // Without a command, sgc prints its help.
    assert!(place.bad(2, &[]).contains("Usage: sgc [OPTIONS] <COMMAND>"));
    assert!(place.good(&["--help"]).contains("Usage: sgc [OPTIONS] <COMMAND>"));
    let version = place.good(&["--version"]);
    assert!(version.starts_with(concat!("sgc ", env!("CARGO_PKG_VERSION"))), "{version}");
    assert!(!place.good(&["--help"]).contains("demo-peer"));
}

#[test]
fn time_without_unit_is_refused_with_its_unit() {
    let place = Place::new();
    for args in [
        &["topic", "echo", "/t", "--timeout", "10"][..],
        &["topic", "pub", "/t", "--timeout", "10"],
        &["service", "call", "/s", "--timeout", "10"],
        &["demo", "--duration", "10"],
        &["fleet", "status", "--watch=10"],
        &["fleet", "enroll", "a", "--valid", "10"],
        &["fleet", "invite", "a", "--within", "10"],
        &["join", "--timeout", "10"],
        &["audit", "--since", "10"],
        &["token", "access", "create", "--for", "x", "--valid", "10"],
        &["token", "share", "create", "--topic", "/t", "--to", "ca.pem", "--valid", "10"],
    ] {
        let said = place.bad(2, args);
        assert!(said.contains("a time has a unit: 10s; see `sgc "), "{args:?}: {said}");
    }
    for kind in [&["access", "create", "--for", "x"][..], &["share", "create", "--topic", "/t", "--to", "c"]]
    {
        let said = place.bad(2, &[&["token"], kind, &["--valid", "3651d"]].concat());
        assert!(said.contains("for '--valid <TIME>': at most 3650d; see "), "{said}");
    }
    // The commands get as far as the node, which does not run.
    for args in [
        &["topic", "echo", "/t", "--timeout", "2s"][..],
        &["topic", "pub", "/t", "{}", "--timeout", "1min"],
        &["service", "call", "/s", "--timeout", "2s"],
    ] {
        assert!(place.bad(1, args).contains("no node of this user runs here"), "{args:?}");
    }
}

#[test]
fn time_of_watch_is_not_taken_for_a_node() {
    let place = Place::new();
    let rule = "a time follows --watch after an equals sign: --watch=1s";
    place.says(2, &["fleet", "status", "--watch", "1s"], rule);
    assert!(place.bad(1, &["fleet", "status", "--watch=1s"]).contains("no node of this user runs here"));
    assert!(place.bad(1, &["fleet", "status", "1s"]).contains("no node of this user runs here"));
    assert!(place.good(&["fleet", "status", "--help"]).contains("--watch[=<TIME>]"));
}

#[test]
fn name_ca_and_access_token_are_printed_as_json() {
    let place = Place::with_fleet();
    place
        .write("node.toml", "identity = 'arm-1.identity'\n[node]\nrouters = ['quic://r']\nstate = 'state'\n");
    let name = [&NAME_ARGS[..], &["--owner", "arm-1"]].concat();
    let parsed = |text: &str| serde_json::from_str::<Value>(text).expect(text);
    let json = parsed(&place.good(&[&name[..], &["--json"]].concat()));
    assert_eq!(json["name"], place.good(&name).trim_end());
    let json = parsed(&place.good(&["fleet", "ca", "--json"]));
    assert_eq!(
        (&json["fleet"], &json["certificate"]),
        (&"lab".into(), &place.good(&["fleet", "ca"]).trim_end().into())
    );
    let ran = place.run(&["token", "access", "create", "--for", "x", "--subscribe", "/t", "--json"]);
    let json = parsed(&ran.stdout);
    assert_eq!((ran.code, &json["for"]), (Some(0), &"x".into()), "{}", ran.stderr);
    let listed = parsed(&place.good(&["token", "access", "list", "--json"]));
    for key in ["id", "for", "expires"] {
        assert_eq!(listed[0][key], json[key], "{key}");
    }
    assert!(json["token"].as_str().is_some_and(|token| !token.is_empty()));
}

/// Serves the taps of one `sgc topic` command at this socket: a topic with three messages, which then falls silent.
fn serve_taps(socket: &Path, taps: usize) -> std::thread::JoinHandle<()> {
    let listener = UnixListener::bind(socket).unwrap();
    std::thread::spawn(move || {
        for _ in 0..taps {
            let (mut stream, _) = listener.accept().unwrap();
            let mut request = String::new();
            BufReader::new(&stream).read_line(&mut request).unwrap();
            assert!(request.contains("tap any ") && request.ends_with(" /t\n"), "{request}");
            stream.write_all(b"{\"ok\":{\"type\":\"geometry_msgs/msg/PointStamped\"}}\n").unwrap();
            for n in 0..3 {
                let head = TapHead {
                    kind: 0,
                    source_timestamp_ns: 0,
                    seen_unix_ns: 5_250_000_000,
                    seen_ns: n * 125_000_000,
                    dropped: 0,
                    bytes: 1000,
                    carried: 12,
                };
                // Little endian, stamped 5 s after the epoch.
                let payload = [0, 1, 0, 0, 5, 0, 0, 0, 0, 0, 0, 0];
                // A command that wants only the type ends the connection at once.
                if stream.write_all(&[&head.to_bytes()[..], &payload].concat()).is_err() {
                    break;
                }
            }
            let _ = stream.read_to_end(&mut Vec::new());
        }
    })
}

#[test]
fn rate_bandwidth_and_delay_are_printed_as_a_line_of_json_per_report() {
    let place = Place::new();
    for (command, taps, figures, silent) in [
        (
            "hz",
            1,
            serde_json::json!({
                "messages": 3, "rate_hz": 8.0, "period_min_s": 0.125, "period_max_s": 0.125, "period_std_dev_s": 0.0,
            }),
            "rate_hz",
        ),
        (
            "bw",
            1,
            serde_json::json!({
                "messages": 3, "bytes_per_s": 8000.0, "message_mean_bytes": 1000.0, "message_min_bytes": 1000.0,
                "message_max_bytes": 1000.0,
            }),
            "bytes_per_s",
        ),
        (
            "delay",
            2,
            serde_json::json!({
                "messages": 3, "delay_s": 0.25, "delay_min_s": 0.25, "delay_max_s": 0.25, "delay_std_dev_s": 0.0,
            }),
            "delay_s",
        ),
    ] {
        let socket = place.path().join(command);
        let node = serve_taps(&socket, taps);
        let said = place.good(&["topic", command, "/t", "--json", "-n", "2", "--socket", command]);
        let reports: Vec<Value> = said.lines().map(|line| serde_json::from_str(line).expect(line)).collect();
        assert_eq!(reports.len(), 2, "{said}");
        assert_eq!(reports[0], figures);
        // The second report has no new messages.
        assert_eq!((&reports[1]["messages"], &reports[1][silent]), (&0.into(), &Value::Null));
        assert_eq!(reports[1].as_object().unwrap().len(), figures.as_object().unwrap().len());
        node.join().unwrap();
    }
}

#[test]
fn check_prints_mistakes_as_json_with_the_same_exit_code() {
    let place = Place::with_fleet();
    let check = |code: i32| {
        let plain = place.run(&["check"]);
        let ran = place.run(&["check", "--json"]);
        assert_eq!((ran.code, plain.code), (Some(code), Some(code)), "{}", ran.stderr);
        assert_eq!(ran.stderr, plain.stderr);
        serde_json::from_str::<Value>(&ran.stdout).expect(&ran.stdout)
    };
    place.write("node.toml", "identity = 'arm-1.identity'\n[node]\nrouters = ['nonsense']\nnames = 3\n");
    let json = check(2);
    assert_eq!(json.as_object().unwrap().len(), 1, "{json}");
    let mistakes = json["mistakes"].as_array().unwrap();
    let places: Vec<_> = mistakes.iter().map(|m| (m["file"].as_str(), m["line"].as_u64())).collect();
    assert_eq!(places, [(Some("node.toml"), Some(3)), (Some("node.toml"), Some(4))], "{json}");
    assert!(mistakes[0]["mistake"].as_str().unwrap().contains("nonsense"), "{json}");
    // An identity that cannot be used is a mistake as well.
    place.write("node.toml", "identity = 'absent.identity'\n[node]\nrouters = ['quic://r']\n");
    let json = check(2);
    assert_eq!(json["mistakes"].as_array().unwrap().len(), 1);
    assert!(json["mistakes"][0]["mistake"].as_str().unwrap().contains("absent.identity"), "{json}");
    place.write("node.toml", "identity = 'arm-1.identity'\n[node]\nrouters = ['quic://r']\n");
    let json = check(0);
    assert_eq!((&json["mistakes"], json["node"].is_array()), (&serde_json::json!([]), true), "{json}");
}

#[test]
fn fleet_commands_print_their_results_as_json() {
    let place = Place::new();
    let json = |args: &[&str]| {
        let said = place.good(&[args, &["--json"]].concat());
        assert_eq!(said.lines().count(), 1, "{args:?}: {said}");
        serde_json::from_str::<Value>(&said).expect(&said)
    };
    let made = json(&["fleet", "create", "lab", "--authority", "hub"]);
    assert_eq!((&made["file"], &made["authority"]), (&"lab.fleet".into(), &"hub".into()));
    assert_eq!(json(&["fleet", "set", "--post-quantum"])["post_quantum"], true);

    let enrolled = json(&["fleet", "enroll", "arm-1"]);
    let until = place.identity("arm-1.identity").not_after().to_string();
    let expected = serde_json::json!({
        "file": "arm-1.identity", "node": "arm-1", "fleet": "lab", "expires": until, "has_key": true,
    });
    assert_eq!(enrolled, expected);
    let requested = json(&["fleet", "request", "desk"]);
    assert_eq!(
        requested,
        serde_json::json!({ "node": "desk", "key_file": "desk.key", "request_file": "desk.csr" })
    );
    let answered = json(&["fleet", "enroll", "desk", "--csr", "desk.csr"]);
    assert_eq!((&answered["file"], &answered["has_key"]), (&"desk.answer".into(), &false.into()));
    assert_eq!(json(&["fleet", "accept", "desk.answer"])["file"], "desk.identity");
    let renewed = json(&["fleet", "renew", "desk", "--valid", "1d"]);
    assert_eq!(renewed["expires"], place.identity("desk.identity").not_after().to_string());
    assert_eq!(
        json(&["fleet", "extensions", "arm-2", "--secret", "lab.fleet"]),
        serde_json::json!({ "node": "arm-2", "file": "arm-2.ext" })
    );

    let rotated = json(&["fleet", "rotate-secret"]);
    assert_eq!(rotated["secret_generations"], serde_json::json!([1, 2]));
    let retired = json(&["fleet", "retire-secret", "2", "--force"]);
    assert_eq!(retired["secret_generations"], serde_json::json!([2]));

    json(&["fleet", "enroll", "hub"]);
    let invite = ["fleet", "invite", "new", "--via", "quic://router.lab.example"];
    let ran = place.run(&[&invite[..], &["--json"]].concat());
    let invited: Value = serde_json::from_str(&ran.stdout).expect(&ran.stdout);
    assert_eq!((&invited["node"], &invited["authority"]), (&"new".into(), &"hub".into()));
    assert_eq!(invited["routers"], serde_json::json!(["quic://router.lab.example"]));
    let code = sgc_trust::Invitation::parse(invited["code"].as_str().unwrap()).unwrap();
    assert_eq!(invited["expires"], code.validity().unwrap().1.to_string());

    let copied = json(&["fleet", "backup", "lab.fleet-backup"]);
    assert_eq!((&copied["file"], &copied["nodes"]), (&"lab.fleet-backup".into(), &4.into()));
    place.says(
        2,
        &["fleet", "backup", "-", "--json"],
        "the copy goes to standard output: leave --json out, or name a file",
    );
    let revoked = json(&["fleet", "revoke", "arm-1"]);
    assert_eq!(revoked["nodes"], serde_json::json!(["arm-1"]));
    assert_eq!((&revoked["revocation_list_file"], &revoked["authority"]), (&"lab.crl".into(), &Value::Null));
    assert_eq!(revoked["pushed_to"], serde_json::json!([]));

    let restored = json(&["fleet", "restore", "lab.fleet-backup", "--fleet", "copy.fleet"]);
    assert_eq!(restored["ended_invitations"], serde_json::json!(["new"]));
    let merged = json(&["fleet", "merge", "lab.crl", "--fleet", "copy.fleet"]);
    assert_eq!((&merged["revoked"], &merged["settings"]), (&serde_json::json!(["arm-1"]), &false.into()));
    json(&["fleet", "enroll", "arm-3", "--fleet", "lab.fleet"]);
    let merged = json(&["fleet", "merge", "lab.fleet", "--fleet", "copy.fleet"]);
    assert_eq!(merged["enrolled"], serde_json::json!(["arm-3"]));
    let adopted = ["fleet", "adopt", "desk", "--certificate", "desk.identity", "--fleet", "lab.fleet"];
    assert_eq!(json(&adopted), serde_json::json!({ "file": "lab.fleet", "node": "desk" }));
}

#[test]
fn fleet_commands_name_the_node_that_asks_an_authority_as_other_commands_do() {
    let place = Place::with_fleet();
    place.write("node.toml", "[node]\nname = 'arm-1'\nrouters = ['quic://a']\n[admin]\nsocket = 'a.sock'\n");
    let usual = place.path().join("sgc/arm-1.sock").display().to_string();
    let node = [
        (&["-c", "node.toml"][..], "a.sock"),
        (&["--socket", "b.sock"], "b.sock"),
        (&["--node", "arm-1"], &usual),
    ];
    for command in [&["list"][..], &["enroll", "x"], &["renew", "desk"], &["revoke", "desk"]] {
        for (named, socket) in node {
            let args = [&["fleet"][..], command, named].concat();
            place.says(
                2,
                &args,
                "-c, --node and --socket name the node that sends a request: add --at AUTHORITY",
            );
            let args = [&args[..], &["--at", "keeper"]].concat();
            place.says(1, &args, &format!("no node runs at {socket}: there is no such socket"));
        }
    }
    // The node here also names the routers of an invitation, with and without an authority.
    for (named, socket) in node {
        let said = place.bad(2, &[&["fleet", "invite", "x"], named].concat());
        assert!(said.contains(&format!("no node runs at {socket}: ")), "{said}");
    }
}

#[test]
fn reply_of_a_service_is_json_with_and_without_the_option() {
    let place = Place::new();
    let listener = UnixListener::bind(place.path().join("a.sock")).unwrap();
    let node = std::thread::spawn(move || {
        for _ in 0..2 {
            let (mut stream, _) = listener.accept().unwrap();
            BufReader::new(&stream).read_line(&mut String::new()).unwrap();
            stream.write_all(b"{\"ok\":{\"sum\":5}}\n").unwrap();
        }
    });
    for json in [&[][..], &["--json"]] {
        let args = ["service", "call", "/add", "{a: 2, b: 3}", "--socket", "a.sock"];
        assert_eq!(place.good(&[&args[..], json].concat()), "{\"sum\":5}\n");
    }
    node.join().unwrap();
}

#[test]
fn validity_in_days_is_refused_with_its_span() {
    let place = Place::with_fleet();
    for verb in ["enroll", "renew"] {
        let args = ["fleet", verb, "arm-1", "--force", "--days", "30"];
        place.says(2, &args, "`--days 30` has another name now: --valid 30d");
    }
}

#[test]
fn run_takes_the_only_configuration_here() {
    let place = Place::with_fleet();
    place.says(2, &["run"], "no configuration here (no *.toml): name one with -c FILE");
    place.write("node.toml", "identity = 'absent.identity'\n[node]\nrouters = ['nonsense']\n");
    let said = place.bad(2, &["run"]);
    assert!(said.ends_with("sgc: node.toml: 2 mistakes\n"), "{said}");
    // Arguments that describe a node are not mixed with the configuration.
    let said = place.bad(2, &["run", "--identity", "arm-1.identity", "--share", "/t"]);
    assert!(said.contains("sgc: command line: "), "{said}");
    place.write("other.toml", "");
    place.says(2, &["run"], "which configuration? Name one with -c: node.toml, other.toml");
}

#[test]
fn help_and_man_page_list_the_exit_codes() {
    let place = Place::new();
    let code = "2  arguments, a configuration or an identity that cannot be right";
    assert!(place.good(&["--help"]).contains(code));
    place.good(&["man", "."]);
    assert!(place.read("sgc.1").contains(code));
}

#[test]
fn example_configurations_of_the_package_have_no_mistakes() {
    let place = Place::new();
    place.good(&["fleet", "create", "lab"]);
    place.good(&["fleet", "enroll", "robot"]);
    place.good(&["fleet", "enroll", "router", "--role", "router"]);
    let examples = Path::new(env!("CARGO_MANIFEST_DIR")).join("../../dist/examples");
    for node in ["robot", "router"] {
        let text = fs::read_to_string(examples.join(format!("{node}.toml"))).unwrap();
        let here = text.replace("/var/lib/sgc/", "");
        assert_ne!(here, text);
        let file = format!("{node}.toml");
        fs::write(place.path().join(&file), here).unwrap();
        assert!(place.good(&["check", "-c", &file]).contains("no mistakes"), "{node}");
    }
}

#[test]
fn dashboard_prints_its_urls_as_json() {
    let place = Place::new();
    for (operate, has_second) in [(&["--operate"][..], true), (&[], false)] {
        let args = ["dashboard", "--json", "--socket", "x.sock", "--listen", "127.0.0.1:0"];
        let mut command = place.command(&[&args[..], operate].concat());
        let mut child = command.stdout(Stdio::piped()).stderr(Stdio::null()).spawn().unwrap();
        let mut line = String::new();
        BufReader::new(child.stdout.take().unwrap()).read_line(&mut line).unwrap();
        child.kill().unwrap();
        child.wait().unwrap();
        let urls: Value = serde_json::from_str(&line).expect(&line);
        assert!(urls["look"].as_str().unwrap().starts_with("http://127.0.0.1:"), "{urls}");
        assert_eq!(urls["operate"].is_string(), has_second, "{urls}");
    }
}

/// Returns the commands that do something and are not hidden, by their names without `sgc`.
fn leaves(command: &clap::Command, name: &str) -> Vec<(String, clap::Command)> {
    let shown = command.get_subcommands().filter(|below| !below.is_hide_set());
    let below: Vec<_> =
        shown.flat_map(|below| leaves(below, format!("{name} {}", below.get_name()).trim())).collect();
    // `sgc router` runs a node, and has a command below it.
    let does_something = below.is_empty() || command.is_args_conflicts_with_subcommands_set();
    let itself = does_something.then(|| (name.to_owned(), command.clone()));
    itself.into_iter().chain(below).collect()
}

/// Commands without `--json`, and why.
const WITHOUT_JSON: [(&str, &str); 6] = [
    ("bench answer", "waits, and tells a person the command for the other machine"),
    ("completions", "prints a program for a shell"),
    ("router", "runs a node; --log-format has the form of its log"),
    ("run", "runs a node; --log-format has the form of its log"),
    ("topic pub", "prints the messages that the caller gave"),
    ("topic resume", "prints only that it is done"),
];

#[test]
fn every_command_that_prints_data_takes_json() {
    let commands = leaves(&sgc::command_line(), "");
    assert!(commands.len() > 40, "{}", commands.len());
    let takes_json = |command: &clap::Command| {
        let json = command.get_arguments().find(|arg| arg.get_long() == Some("json"));
        json.is_some_and(|json| !json.is_hide_set() && !json.get_action().takes_values())
    };
    let mut without: Vec<_> =
        commands.iter().filter(|(_, command)| !takes_json(command)).map(|(name, _)| name.as_str()).collect();
    without.sort_unstable();
    assert_eq!(without, WITHOUT_JSON.map(|(name, _)| name));
}

#[test]
fn option_has_the_same_form_in_every_command() {
    // For each option, the forms that commands give it, as their help shows them.
    let mut forms: BTreeMap<String, BTreeSet<String>> = BTreeMap::new();
    let mut shorts: BTreeMap<char, BTreeSet<String>> = BTreeMap::new();
    for (name, command) in leaves(&sgc::command_line(), "") {
        for arg in command.get_arguments().filter(|arg| !arg.is_hide_set()) {
            let Some(long) = arg.get_long() else {
                assert!(arg.is_positional(), "{name}: {} has a short form alone", arg.get_id());
                continue;
            };
            let mut form = format!("{:?} --{long}", arg.get_short());
            if arg.get_action().takes_values() {
                let id = arg.get_id().as_str().to_uppercase();
                let value = arg.get_value_names().map_or(id, |names| names.join(" "));
                form.push_str(if arg.is_require_equals_set() { "=" } else { " " });
                form.push_str(&value);
            }
            forms.entry(long.to_owned()).or_default().insert(form);
            if let Some(short) = arg.get_short() {
                shorts.entry(short).or_default().insert(long.to_owned());
            }
        }
    }
    assert!(forms.len() > 60 && shorts.len() > 5, "{forms:?} {shorts:?}");
    forms.retain(|_, forms| forms.len() > 1);
    assert!(forms.is_empty(), "{forms:#?}");
    shorts.retain(|_, longs| longs.len() > 1);
    assert!(shorts.is_empty(), "{shorts:#?}");
}

#[test]
fn completions_and_man_pages_know_every_command() {
    let place = Place::new();
    for shell in ["bash", "zsh", "fish"] {
        let text = place.good(&["completions", shell]);
        assert!(text.contains("rotate-secret") && !text.contains("demo-peer"), "{shell}");
        assert!(text.contains("version"), "{shell}");
    }
    assert!(place.bad(2, &["completions", "tcsh"]).contains("tcsh"));
    fs::create_dir(place.path().join("man")).unwrap();
    place.good(&["man", "man"]);
    let page = |name: &str| fs::read_to_string(place.path().join("man").join(name));
    assert!(page("sgc.1").unwrap().contains(r"sgc\-run"));
    assert!(page("sgc-fleet-rotate-secret.1").unwrap().contains("new generation"));
    assert!(page("sgc-demo-peer.1").is_err() && page("sgc-man.1").is_err());
    assert!(place.bad(1, &["man", "nowhere"]).contains("nowhere"));
}

#[test]
fn arguments_that_make_no_node_are_told() {
    let place = Place::with_fleet();
    let said = place.bad(2, &["run", "--identity", "arm-1.identity", "--use", "desk/t", "--to", "desk"]);
    assert!(said.contains("command line: `--use` is \"desk/t\"; write NODE:/TOPIC: "), "{said}");
    assert!(said.contains("command line: neither `--router` nor `--listen` is given"), "{said}");
    assert!(said.ends_with("sgc: command line: 3 mistakes\n"), "{said}");
    // Several routers and addresses are separated by commas, or the option is repeated.
    for several in [&["--router", "a,b"][..], &["--router", "a", "--router", "b"]] {
        let said = place.bad(2, &[&["run", "--identity", "arm-1.identity"], several].concat());
        assert!(said.contains("`--router` is \"a\"; ") && said.contains("`--router` is \"b\"; "), "{said}");
    }
    let args =
        ["router", "--identity", "cloud.identity", "--listen", "quic://127.0.0.1:0", "--log", "loud=x=y"];
    let said = place.bad(2, &args);
    assert!(said.starts_with("sgc: --log is \"loud=x=y\": ") && said.lines().count() == 1, "{said}");
    // A word that is no level would be taken for a target and silence the log.
    let right = "\"verbose\" is no level: write off, error, warn, info, debug or trace";
    let said = place.bad(2, &["run", "--identity", "arm-1.identity", "--log", "verbose"]);
    assert!(said.starts_with(&format!("sgc: --log is \"verbose\": {right}")), "{said}");
    let output = place.command(&["run", "--identity", "arm-1.identity"]).env("SGC_LOG", "verbose").output();
    let said = String::from_utf8(output.unwrap().stderr).unwrap();
    assert!(said.starts_with(&format!("sgc: SGC_LOG is \"verbose\": {right}")), "{said}");
}

#[test]
fn log_in_json_has_an_object_for_each_event() {
    let place = Place::with_fleet();
    let args =
        ["router", "--identity", "cloud.identity", "--listen", "tls://127.0.0.1:0", "--until-stdin-closes"];
    for (extra, variable) in [(&["--log-format", "json"][..], "text"), (&[], "json")] {
        let mut command = place.command(&[&args[..], extra].concat());
        let output = command.env("SGC_LOG_FORMAT", variable).output().unwrap();
        let log = String::from_utf8(output.stderr).unwrap();
        let events: Vec<Value> = log.lines().map(|line| serde_json::from_str(line).expect(line)).collect();
        let is_it = |event: &&Value| {
            event["message"]
                .as_str()
                .is_some_and(|text| text.contains("there is no place for this node's state"))
        };
        let event = events.iter().find(is_it).unwrap_or_else(|| panic!("{log}"));
        assert_eq!((&event["level"], event["timestamp"].is_string()), (&"WARN".into(), true), "{event}");
    }
    let output = place.command(&args).env("SGC_LOG_FORMAT", "xml").output().unwrap();
    assert_eq!(
        String::from_utf8(output.stderr).unwrap(),
        "sgc: SGC_LOG_FORMAT is \"xml\": write text or json\n"
    );
    assert_eq!(output.status.code(), Some(2));
}

#[test]
fn status_of_no_node_says_so() {
    let place = Place::with_fleet();
    let dir = place.path().join("sgc");
    place.says(
        1,
        &["status"],
        &format!(
            "no node of this user runs here (no socket in {}); name one with -c or --socket",
            dir.display()
        ),
    );
    place.says(1, &["status", "--socket", "x.sock"], "no node runs at x.sock: there is no such socket");
    place.write("node.toml", "[node]\nname = 'arm-1'\nrouters = ['quic://a']\n[admin]\nsocket = 'a.sock'\n");
    drop(UnixListener::bind(place.path().join("a.sock")).unwrap());
    place.says(1, &["status", "-c", "node.toml"], "no node runs at a.sock: its socket is left over");
}

#[test]
fn a_closed_reader_is_no_failure() {
    let place = Place::with_fleet();
    let (reader, writer) = std::io::pipe().unwrap();
    drop(reader);
    let args = [&NAME_ARGS[..], &["--owner", "arm-1"]].concat();
    let ran = Ran::from(place.command(&args).stdout(writer).stderr(Stdio::piped()).output().unwrap());
    assert_eq!((ran.code, ran.stderr.as_str()), (Some(0), ""));
}

fn now() -> UnixMillis {
    let since = std::time::SystemTime::now().duration_since(std::time::UNIX_EPOCH).unwrap();
    UnixMillis(since.as_millis() as u64)
}

/// Beginnings of the escape sequences of a good and of a bad state, and their end.
const GREEN: &str = "\x1b[32m";
const RED: &str = "\x1b[31m";
const RESET: &str = "\x1b[0m";

#[test]
fn colours_are_for_terminals_and_on_request() {
    let place = Place::with_fleet();
    place.write("node.toml", "[node]\nname = 'arm-1'\nrouters = ['quic://127.0.0.1:1']\nstate = 'state'\n");
    let run = |args: &[&str], variables: &[(&str, &str)]| {
        let mut command = place.command(args);
        String::from_utf8(command.envs(variables.iter().copied()).output().unwrap().stdout).unwrap()
    };
    let check = ["check", "-c", "node.toml"];
    let why = ["why", "/chatter", "-c", "node.toml"];
    let forced = [("CLICOLOR_FORCE", "1")];
    assert!(run(&check, &forced).starts_with(&format!("node.toml: {GREEN}no mistakes{RESET}\n")));
    assert!(run(&why, &forced).starts_with(&format!("{RED}✗{RESET} no node runs")));
    let json = |args: &[&str]| run(&[args, &["--json"]].concat(), &forced);
    for plain in [
        run(&check, &[]),
        run(&why, &[("TERM", "xterm")]),
        run(&check, &[forced[0], ("NO_COLOR", "1")]),
        json(&check),
        json(&why),
    ] {
        assert!(!plain.is_empty() && !plain.contains('\x1b'), "{plain}");
    }
    // With a terminal, which `script` makes.
    let at_terminal = |variables: &[(&str, &str)]| {
        let line = format!("{} check -c node.toml", env!("CARGO_BIN_EXE_sgc"));
        let mut command = Command::new("script");
        command.args(["--quiet", "--return", "--command", &line, "/dev/null"]).current_dir(place.path());
        command.env_clear().env("PATH", std::env::var_os("PATH").unwrap()).stdin(Stdio::null());
        String::from_utf8(command.envs(variables.iter().copied()).output().unwrap().stdout).unwrap()
    };
    assert!(at_terminal(&[("TERM", "xterm")]).contains(GREEN));
    for variables in [
        &[("TERM", "dumb")][..],
        &[("TERM", "xterm"), ("NO_COLOR", "1")],
        &[("TERM", "xterm"), ("CLICOLOR", "0")],
    ] {
        let plain = at_terminal(variables);
        assert!(plain.contains("no mistakes") && !plain.contains(GREEN), "{variables:?}: {plain}");
    }
}
