//! Tests of rights with the real binary: policy, reload, tokens and the audit log.

#![allow(clippy::unwrap_used)]

use std::fs;
use std::io::{BufRead, BufReader, Read, Write};
use std::net::{TcpListener, TcpStream};
use std::os::unix::fs::PermissionsExt;
use std::os::unix::net::UnixStream;
use std::path::Path;
use std::process::{Child, ChildStdout, Command, Stdio};
use std::sync::Arc;
use std::time::{Duration, Instant, SystemTime, UNIX_EPOCH};

use rand_chacha::ChaCha20Rng;
use rand_chacha::rand_core::SeedableRng as _;
use rustix::process::{Pid, Signal, kill_process};
use rustls::pki_types::pem::PemObject as _;
use rustls::pki_types::{CertificateDer, ServerName};
use rustls::{ClientConfig, ClientConnection, RootCertStore};
use serde_json::Value;
use sgc_gateway::{AccessToken, Right};
use sgc_trust::{Identity, ServerCertificate, ShareToken, derive_name};
use sgc_wire::{Metadata, UnixMillis};
use tempfile::TempDir;

const PATIENCE: Duration = Duration::from_secs(30);
const POSE: &str = "geometry_msgs/msg/PoseStamped";

/// A directory with the fleet `lab` (arm-1, desk in operators) and the fleet `acme` (cart).
struct Place {
    dir: TempDir,
}

struct Ran {
    code: Option<i32>,
    stdout: String,
    stderr: String,
}

impl Place {
    fn new() -> Self {
        let place = Self { dir: tempfile::tempdir().unwrap() };
        for args in [
            &["fleet", "create", "lab"][..],
            &["fleet", "create", "acme"],
            &["fleet", "enroll", "arm-1", "--fleet", "lab.fleet"],
            &["fleet", "enroll", "desk", "--fleet", "lab.fleet", "--group", "operators"],
            &["fleet", "enroll", "cart", "--fleet", "acme.fleet"],
        ] {
            place.good(args);
        }
        place.write("acme-ca.pem", &certificate_of(&place.read("acme.fleet")));
        place.write("lab-ca.pem", &certificate_of(&place.read("lab.fleet")));
        let text = "# arm-1\n[node]\nname = \"arm-1\"\nrouters = [\"quic://127.0.0.1:9\"]\nstate = \"state\"\nwatch = false\n\n\
                    [admin]\nsocket = \"arm.sock\"\n\n\
                    [[share]]\ntopic = \"/cmd_vel\"\nto = [\"group:operators\"]\npublish = [\"desk\"]\ntype = \"geometry_msgs/msg/Twist\"\n\n\
                    [[share]]\ntopic = \"/handoff/pose\"\nto = [\"desk\"]\n";
        place.write("arm-1.toml", text);
        let text = "[node]\nname = \"cart\"\nrouters = [\"quic://127.0.0.1:9\"]\nstate = \"cart-state\"\nwatch = false\n\n\
                    [admin]\nsocket = \"cart.sock\"\n";
        place.write("cart.toml", text);
        place
    }

    fn command(&self, args: &[&str]) -> Command {
        let mut command = Command::new(env!("CARGO_BIN_EXE_sgc"));
        command
            .args(args)
            .current_dir(self.dir.path())
            .env_clear()
            .env("XDG_RUNTIME_DIR", self.dir.path())
            .env("XDG_STATE_HOME", self.dir.path().join("states"))
            .env("ROS_AUTOMATIC_DISCOVERY_RANGE", "OFF")
            .stdin(Stdio::null());
        command
    }

    fn run(&self, args: &[&str]) -> Ran {
        let output = self.command(args).output().unwrap();
        let text = |bytes| String::from_utf8(bytes).unwrap();
        Ran { code: output.status.code(), stdout: text(output.stdout), stderr: text(output.stderr) }
    }

    fn good(&self, args: &[&str]) -> String {
        let ran = self.run(args);
        assert_eq!(ran.code, Some(0), "{args:?}: {}", ran.stderr);
        ran.stdout
    }

    fn bad(&self, code: i32, args: &[&str]) -> String {
        let ran = self.run(args);
        assert_eq!(ran.code, Some(code), "{args:?}: {}{}", ran.stdout, ran.stderr);
        ran.stderr
    }

    fn path(&self, file: &str) -> std::path::PathBuf {
        self.dir.path().join(file)
    }

    fn read(&self, file: &str) -> String {
        fs::read_to_string(self.path(file)).unwrap()
    }

    fn write(&self, file: &str, text: &str) {
        fs::write(self.path(file), text).unwrap();
    }

    fn mode(&self, file: &str) -> u32 {
        fs::metadata(self.path(file)).unwrap().permissions().mode() & 0o7777
    }

    fn identity(&self, file: &str) -> Identity {
        Identity::parse(&self.read(file)).unwrap()
    }

    fn policy(&self, args: &[&str]) -> (Option<i32>, String) {
        let ran = self.run(&[&["policy", "test", "-c", "arm-1.toml"], args].concat());
        assert_eq!(ran.stderr, "");
        (ran.code, ran.stdout.trim_end().to_owned())
    }

    fn start(&self, config: &str) -> Running {
        self.start_with(config, |command| command)
    }

    fn start_with(&self, config: &str, change: impl FnOnce(Command) -> Command) -> Running {
        let mut command = change(self.command(&["run", "-c", config, "--print-ready"]));
        let mut child = command.stdout(Stdio::piped()).stderr(Stdio::piped()).spawn().unwrap();
        let mut stdout = BufReader::new(child.stdout.take().unwrap());
        let mut line = String::new();
        stdout.read_line(&mut line).unwrap();
        if line.is_empty() {
            let mut log = String::new();
            child.stderr.take().unwrap().read_to_string(&mut log).unwrap();
            panic!("it did not start: {log}");
        }
        Running { child, _stdout: stdout }
    }
}

struct Running {
    child: Child,
    _stdout: BufReader<ChildStdout>,
}

impl Running {
    fn signal(&self, signal: Signal) {
        kill_process(Pid::from_child(&self.child), signal).unwrap();
    }

    /// Ends the node and returns its log.
    fn end(mut self) -> String {
        self.signal(Signal::TERM);
        let deadline = Instant::now() + PATIENCE;
        while self.child.try_wait().unwrap().is_none() {
            assert!(Instant::now() < deadline, "it does not end");
            std::thread::sleep(Duration::from_millis(5));
        }
        let mut log = String::new();
        self.child.stderr.take().unwrap().read_to_string(&mut log).unwrap();
        log
    }
}

impl Drop for Running {
    fn drop(&mut self) {
        let _ = self.child.kill();
        let _ = self.child.wait();
    }
}

fn wait(what: &str, done: impl Fn() -> bool) {
    let deadline = Instant::now() + PATIENCE;
    while !done() {
        assert!(Instant::now() < deadline, "not in time: {what}");
        std::thread::sleep(Duration::from_millis(20));
    }
}

/// Returns the CA certificate of a fleet file, which holds no other.
fn certificate_of(fleet: &str) -> String {
    let begin = fleet.find("-----BEGIN CERTIFICATE-----").unwrap();
    let end = "-----END CERTIFICATE-----\n";
    let length = fleet[begin..].find(end).unwrap() + end.len();
    fleet[begin..begin + length].to_owned()
}

#[test]
fn policy_is_answered_from_the_configuration_alone() {
    let place = Place::new();
    let says = |args: &[&str], code: i32, text: &str| {
        assert_eq!(place.policy(args), (Some(code), text.to_owned()), "{args:?}");
    };
    says(
        &["desk", "--topic", "/handoff/pose"],
        0,
        "yes: desk may subscribe to /handoff/pose: `to` names \"desk\": that is this node",
    );
    // Groups are in certificates, so a name alone does not tell them.
    says(
        &["desk", "--topic", "/cmd_vel"],
        1,
        "no: desk may not subscribe to /cmd_vel: `to` of /cmd_vel names \"group:operators\", and it is none of them (a \
         member of this fleet, in 0 groups)",
    );
    let by_group = "yes: desk may subscribe to /cmd_vel: `to` names \"group:operators\": its certificate puts it into that group";
    says(&["desk", "--group", "operators", "--topic", "/cmd_vel"], 0, by_group);
    says(&["--identity-file", "desk.identity", "--topic", "/cmd_vel"], 0, by_group);
    says(
        &["desk", "--topic", "/cmd_vel", "--right", "publish"],
        0,
        "yes: desk may publish on /cmd_vel: `publish` names \"desk\": that is this node",
    );
    says(
        &["desk", "--topic", "/handoff/pose", "--right", "publish"],
        1,
        "no: desk may not publish on /handoff/pose: `publish` of /handoff/pose names nobody",
    );
    says(
        &["arm-1", "--topic", "/handoff/pose", "--right", "publish"],
        0,
        "yes: arm-1 may publish on /handoff/pose: it is the owner",
    );
    says(&["desk", "--topic", "/other"], 1, "no: desk may not subscribe to /other: arm-1 does not share it");
    let (code, text) = place.policy(&["--identity-file", "cart.identity", "--topic", "/cmd_vel"]);
    assert_eq!(code, Some(1));
    assert!(text.contains("its certificate is not believed"), "{text}");
    let (_, json) = place.policy(&["desk", "--topic", "/handoff/pose", "--json"]);
    let json: Value = serde_json::from_str(&json).unwrap();
    assert_eq!((&json["permitted"], &json["role"]), (&Value::Bool(true), &Value::from("subscribe")));
    assert_eq!(json["node_id"], place.identity("desk.identity").node_id().to_string());
    // A question without an answer gives neither yes nor no.
    place.bad(2, &["policy", "test", "-c", "arm-1.toml", "--topic", "/cmd_vel"]);
    place.bad(2, &["policy", "test", "-c", "arm-1.toml", "No One", "--topic", "/cmd_vel"]);
}

#[test]
fn partners_are_known_by_their_certificates() {
    let place = Place::new();
    let cart = place.identity("cart.identity");
    let share = "\n[[share]]\ntopic = \"/map\"\nto = [\"partner:acme\"]\n\n[[partner]]\nname = \"acme\"\nca = \"acme-ca.pem\"\n";
    let base = place.read("arm-1.toml");
    place.write("arm-1.toml", &format!("{base}{share}"));
    let of_cart = ["--identity-file", "cart.identity", "--topic", "/map"];
    let (code, text) = place.policy(&of_cart);
    assert_eq!((code, text.contains("its certificate is of that partner's CA")), (Some(0), true), "{text}");
    let certificate = {
        let file = place.read("cart.identity");
        let begin =
            file.find("-----BEGIN CERTIFICATE").or_else(|| file.find("-----BEGIN SGC CHAIN")).unwrap_or(0);
        file[begin..].replace("SGC CHAIN", "CERTIFICATE")
    };
    place.write("cart.pem", &certificate_of(&certificate));
    let (code, _) = place.policy(&["--certificate", "cart.pem", "--topic", "/map"]);
    assert_eq!(code, Some(0));
    assert_eq!(place.policy(&["--identity-file", "desk.identity", "--topic", "/map"]).0, Some(1));
    // A list of nodes covers only these nodes, whatever else the CA certified.
    place.write("arm-1.toml", &format!("{base}{share}node = \"{}\"\n", "ab".repeat(32)));
    let (code, text) = place.policy(&of_cart);
    assert!(code == Some(1) && text.contains("not one of the nodes listed there"), "{text}");
    place.write("arm-1.toml", &format!("{base}{share}node = [\"{}\"]\n", cart.node_id()));
    assert_eq!(place.policy(&of_cart).0, Some(0));
}

#[test]
fn a_running_node_takes_what_it_can_and_names_what_needs_a_restart() {
    let place = Place::new();
    let node = place.start("arm-1.toml");
    assert_eq!(place.good(&["reload", "-c", "arm-1.toml"]), "nothing changed\n");
    let base = place.read("arm-1.toml");
    place.write(
        "arm-1.toml",
        &base.replace("to = [\"desk\"]", "to = [\"desk\", \"lamp\"]").replace("/cmd_vel", "/cmd"),
    );
    let said = place.good(&["reload", "--socket", "arm.sock"]);
    assert_eq!(
        said.lines().collect::<Vec<_>>(),
        ["/cmd_vel is no longer shared", "/cmd is shared", "/handoff/pose: who may subscribe changed"]
    );
    let status: Value =
        serde_json::from_str(&place.good(&["status", "--socket", "arm.sock", "--json"])).unwrap();
    let topics: Vec<_> = status["routes"].as_array().unwrap().iter().map(|r| r["topic"].clone()).collect();
    assert_eq!(topics, ["/cmd", "/handoff/pose"]);

    // With a mistake anywhere nothing changes, and all mistakes are reported.
    let good = place.read("arm-1.toml");
    place.write(
        "arm-1.toml",
        &good.replace("/cmd", "/new").replace("publish", "publsih").replace("\"desk\"", "\"Desk\""),
    );
    let said = place.bad(1, &["reload", "--socket", "arm.sock"]);
    assert!(said.contains("did you mean `publish`?") && said.contains("\"Desk\""), "{said}");
    let status: Value =
        serde_json::from_str(&place.good(&["status", "--socket", "arm.sock", "--json"])).unwrap();
    assert_eq!(status["routes"][0]["topic"], "/cmd");

    let other = good.replace("127.0.0.1:9", "127.0.0.1:10").replace("lamp", "sofa");
    place.write("arm-1.toml", &other.replace("watch = false", "watch = false\nkeep_alive = \"5s\""));
    let reload = || place.run(&["reload", "--socket", "arm.sock"]);
    let said = reload();
    let expected = [
        "/handoff/pose: who may subscribe changed",
        "quic://127.0.0.1:10 is searched for",
        "quic://127.0.0.1:9 is no longer searched for",
        "`keep_alive` changed, which needs a restart",
    ];
    assert_eq!((said.code, said.stdout.lines().collect::<Vec<_>>()), (Some(1), expected.to_vec()));
    let said = reload();
    assert_eq!(
        (said.code, &*said.stdout),
        (Some(1), &*format!("{}\n", expected[3])),
        "said until it is done"
    );
    let pending = format!("restart pending: {}", expected[3]);
    assert!(place.good(&["status", "--socket", "arm.sock"]).contains(&pending));

    // SIGHUP does the same and logs the result.
    place.write("arm-1.toml", &good);
    node.signal(Signal::HUP);
    let deadline = Instant::now() + PATIENCE;
    while !place.read("state/audit.jsonl").contains("SIGHUP") {
        assert!(Instant::now() < deadline, "the hang-up was not heard");
        std::thread::sleep(Duration::from_millis(5));
    }
    let log = node.end();
    assert!(log.contains("reload: /handoff/pose: who may subscribe changed"), "{log}");

    let json = place.good(&["audit", "-c", "arm-1.toml", "--event", "reload", "--json"]);
    let events: Vec<Value> = json.lines().map(|line| serde_json::from_str(line).unwrap()).collect();
    assert_eq!(events.len(), 6);
    assert!(events[2]["reason"].as_str().unwrap().starts_with("refused: "), "{json}");
    assert_eq!((&events[1]["by"], &events[5]["by"]), (&"sgc reload".into(), &"SIGHUP".into()));
}

#[test]
fn audit_log_rotation_and_peer_rate_change_at_a_reload() {
    let place = Place::new();
    let base = place.read("arm-1.toml");
    let node = place.start("arm-1.toml");
    let reload = |more: &str| {
        place.write("arm-1.toml", &format!("{base}\n{more}"));
        place.run(&["reload", "--socket", "arm.sock"])
    };
    let changed = |more: &str, lines: &[&str]| {
        let said = reload(more);
        assert_eq!((said.code, said.stdout.lines().collect::<Vec<_>>()), (Some(0), lines.to_vec()));
    };
    let rotation = "[rotation]\nevery = \"20s\"\nmessages = 2048\n";
    changed(rotation, &["topics get a new key after 20 s or 2048 messages"]);
    let moved = format!("{rotation}[audit]\nfile = \"elsewhere.jsonl\"\n");
    changed(&moved, &["the audit log is elsewhere.jsonl, at most 9 files of 16777216 bytes"]);
    let reloads = |file: &str| place.read(file).lines().filter(|line| line.contains("\"reload\"")).count();
    let wait = |file: &str, n: usize| {
        let deadline = Instant::now() + PATIENCE;
        while !place.path(file).exists() || reloads(file) < n {
            assert!(Instant::now() < deadline, "{file} has not {n} reloads");
            std::thread::sleep(Duration::from_millis(5));
        }
    };
    wait("elsewhere.jsonl", 1);
    assert_eq!(reloads("state/audit.jsonl"), 1, "that of the rotation");

    // The node goes on with the log that it has if the new one cannot be opened.
    fs::create_dir(place.path("folder")).unwrap();
    let said = reload(&moved.replace("elsewhere.jsonl", "folder"));
    assert!(said.code == Some(1) && said.stdout.contains("the audit log is as it was: "), "{}", said.stdout);
    wait("elsewhere.jsonl", 2);

    changed(&format!("{rotation}[audit]\noff = true\n"), &["there is no audit log any more"]);
    changed(&format!("{rotation}[audit]\noff = true\n"), &["nothing changed"]);
    changed(rotation, &["the audit log is state/audit.jsonl, at most 9 files of 16777216 bytes"]);
    wait("state/audit.jsonl", 2);
    node.end();
    assert_eq!(reloads("elsewhere.jsonl"), 2, "nothing while it was off");
}

#[test]
fn gateway_comes_moves_and_goes_at_a_reload_and_a_taken_port_stops_nothing() {
    let place = Place::new();
    let base = place.read("arm-1.toml");
    let with = |listen: &str| place.write("arm-1.toml", &format!("{base}\n[gateway]\nlisten = [{listen}]\n"));
    let status = || -> Value {
        serde_json::from_str(&place.good(&["status", "--socket", "arm.sock", "--json"])).unwrap()
    };
    let eventually = |what: &str, is_so: &dyn Fn() -> bool| {
        let deadline = Instant::now() + PATIENCE;
        while !is_so() {
            assert!(Instant::now() < deadline, "never: {what}");
            std::thread::sleep(Duration::from_millis(20));
        }
    };
    let taken = TcpListener::bind("127.0.0.1:0").unwrap();
    let url = format!("ws://{}", taken.local_addr().unwrap());
    with(&format!("'{url}', 'ws://127.0.0.1:0'"));
    let node = place.start("arm-1.toml");
    let alert = status()["alerts"][0].clone();
    assert_eq!((&alert["kind"], &alert["at"]), (&"gateway_not_listening".into(), &url.clone().into()));
    let listens_at = || status()["gateway"]["listen"].as_array().cloned().unwrap_or_default();
    assert_eq!(listens_at().len(), 1, "at the other one it does");
    drop(taken);
    eventually("it listens there, too", &|| listens_at().contains(&url.clone().into()));
    assert_eq!(status()["alerts"], Value::Array(Vec::new()));

    let reload = || place.good(&["reload", "--socket", "arm.sock"]);
    with("'ws://127.0.0.1:0'");
    assert_eq!(reload(), "programs without ROS are to connect at ws://127.0.0.1:0\n");
    assert!(TcpStream::connect(url.strip_prefix("ws://").unwrap()).is_err(), "that address is closed");
    assert_eq!(listens_at().len(), 1);
    place.write("arm-1.toml", &base);
    assert_eq!(reload(), "programs without ROS may not connect any more\n");
    assert!(status()["gateway"].is_null());
    with(&format!("'{url}'"));
    assert!(reload().contains(&format!("programs without ROS are to connect at {url}")));
    TcpStream::connect(url.strip_prefix("ws://").unwrap()).unwrap();
    place.write("arm-1.toml", &(place.read("arm-1.toml") + "clients_max = 3\n"));
    assert_eq!(reload(), "the gateway takes 3 clients at once\n");
    // The bound of buffers is that of the start.
    place.write("arm-1.toml", &(place.read("arm-1.toml") + "client_bytes_max = '1MiB'\n"));
    let said = place.run(&["reload", "--socket", "arm.sock"]);
    assert_eq!(said.code, Some(1), "{}", said.stdout);
    assert!(said.stdout.contains("`client_bytes_max` in [gateway] changed"), "{}", said.stdout);
    node.end();
}

/// Connects to a gateway that these certificates (PEM) verify, under this name. Returns the certificate that it shows.
fn handshake(port: u16, name: &str, trusted: &str) -> Result<Vec<u8>, std::io::Error> {
    let mut roots = RootCertStore::empty();
    for certificate in CertificateDer::pem_slice_iter(trusted.as_bytes()) {
        roots.add(certificate.unwrap()).unwrap();
    }
    let provider = Arc::new(rustls::crypto::aws_lc_rs::default_provider());
    let config = ClientConfig::builder_with_provider(provider)
        .with_protocol_versions(&[&rustls::version::TLS13])
        .unwrap()
        .with_root_certificates(roots)
        .with_no_client_auth();
    let name = ServerName::try_from(name.to_owned()).unwrap();
    let mut client = ClientConnection::new(Arc::new(config), name).unwrap();
    let mut socket = TcpStream::connect(("127.0.0.1", port))?;
    socket.set_read_timeout(Some(PATIENCE))?;
    while client.is_handshaking() {
        client.complete_io(&mut socket)?;
    }
    Ok(client.peer_certificates().unwrap()[0].to_vec())
}

#[test]
fn gateway_certificate_is_made_before_the_first_start_and_follows_its_names() {
    let place = Place::new();
    let base = place.read("arm-1.toml");
    let certificate = |how: &[&'static str]| [&["gateway", "certificate", "-c", "arm-1.toml"], how].concat();
    let said = place.bad(2, &certificate(&[]));
    assert!(said.contains("no gateway listens with TLS here"), "{said}");
    // A free port, for URLs that can be used.
    let free = TcpListener::bind("127.0.0.1:0").unwrap();
    let port = free.local_addr().unwrap().port();
    drop(free);
    let with = |more: &str| {
        place.write("arm-1.toml", &format!("{base}\n[gateway]\nlisten = ['wss://127.0.0.1:{port}']\n{more}"));
    };
    with("names = ['robot.example']");
    let trusted = place.good(&certificate(&["--pem"]));
    assert_eq!(place.mode("state/gateway-certificate.pem"), 0o600);
    assert!(!trusted.contains("PRIVATE"), "{trusted}");
    let json = || -> Value { serde_json::from_str(&place.good(&certificate(&["--json"]))).unwrap() };
    let first = json();
    assert_eq!(first["urls"], serde_json::json!([format!("wss://127.0.0.1:{port}")]));
    assert_eq!((&first["own"], &first["pem"]), (&Value::Bool(true), &trusted.clone().into()));
    let pin = first["pin"].as_str().unwrap().to_owned();
    assert!(place.good(&certificate(&[])).contains(&pin));
    let create = ["token", "access", "create", "-c", "arm-1.toml", "--for", "x", "--subscribe", "/odom"];
    let hint = place.run(&create).stderr;
    assert!(hint.contains(&pin) && hint.contains(&format!("wss://127.0.0.1:{port}")), "{hint}");

    let node = place.start("arm-1.toml");
    let status = || -> Value {
        serde_json::from_str(&place.good(&["status", "--socket", "arm.sock", "--json"])).unwrap()
    };
    let shown = || status()["gateway"]["certificate"].clone();
    wait("it listens", || TcpStream::connect(("127.0.0.1", port)).is_ok());
    assert_eq!(shown()["pin"], pin.as_str());
    assert!(place.good(&["status", "--socket", "arm.sock"]).contains(&pin));
    for name in ["robot.example", "localhost", "127.0.0.1"] {
        let leaf = handshake(port, name, &trusted).unwrap();
        assert_eq!(sgc_trust::certificate_pin(&leaf).as_deref(), Some(&*pin), "{name}");
    }
    // A name that is not the gateway's, and the certificate of another gateway.
    assert!(handshake(port, "other.example", &trusted).is_err());
    let (names, mut rng) = (["robot.example".parse().unwrap()].into(), ChaCha20Rng::seed_from_u64(1));
    let another = ServerCertificate::generate(&names, UnixMillis(1_795_000_000_000), &mut rng).unwrap();
    let another = sgc_trust::pem_text("CERTIFICATE", another.authority());
    assert!(handshake(port, "robot.example", &another).is_err());

    let reload = || place.good(&["reload", "--socket", "arm.sock"]);
    with("names = ['arm.example']");
    assert_eq!(reload(), "who connects to the gateway is shown another certificate\n");
    assert_eq!(reload(), "nothing changed\n");
    assert_eq!(shown()["pin"], pin.as_str(), "the key is the same");
    let renewed = place.good(&certificate(&["--pem"]));
    assert!(handshake(port, "arm.example", &renewed).is_ok());
    assert!(handshake(port, "robot.example", &renewed).is_err(), "that is no name any more");
    let log = node.end();
    assert!(log.contains(&format!("the pin {pin}")), "{log}");

    // The key outlives a restart.
    let node = place.start("arm-1.toml");
    assert_eq!(shown()["pin"], pin.as_str());
    wait("it listens again", || handshake(port, "arm.example", &renewed).is_ok());
    node.end();
    place.write("state/gateway-certificate.pem", "?");
    let said = place.bad(2, &certificate(&[]));
    assert!(said.contains("remove it"), "{said}");
}

#[test]
fn certificate_from_files_is_shown_with_its_pin_and_check_warns_before_its_end() {
    let place = Place::new();
    let base = place.read("arm-1.toml");
    let now = SystemTime::now().duration_since(UNIX_EPOCH).unwrap().as_millis() as u64;
    // Made so long ago that it ends in five days.
    let made = UnixMillis(now + 5 * 86_400_000 - sgc_trust::SERVER_VALIDITY.as_millis() as u64);
    let (names, mut rng) = (["robot.example".parse().unwrap()].into(), ChaCha20Rng::seed_from_u64(1));
    let made = ServerCertificate::generate(&names, made, &mut rng).unwrap();
    for file in ["gateway.pem", "gateway.key"] {
        place.write(file, &made.to_text());
    }
    fs::set_permissions(place.path("gateway.key"), fs::Permissions::from_mode(0o600)).unwrap();
    let gateway =
        "\n[gateway]\nlisten = ['wss://0.0.0.0:9443']\ncertificate = 'gateway.pem'\nkey = 'gateway.key'\n";
    place.write("arm-1.toml", &format!("{base}{gateway}"));
    let json = place.good(&["gateway", "certificate", "-c", "arm-1.toml", "--json"]);
    let json: Value = serde_json::from_str(&json).unwrap();
    assert_eq!(json["pin"], sgc_trust::certificate_pin(made.server()).unwrap());
    assert!(json["expires"].as_str().is_some_and(|time| time.ends_with('Z')), "{json}");
    assert_eq!((&json["own"], &json["urls"][0]), (&Value::Bool(false), &"wss://robot.example:9443".into()));
    assert!(!place.path("state/gateway-certificate.pem").exists());
    let said = place.good(&["check", "-c", "arm-1.toml"]);
    assert!(said.contains("gateway.pem ends in 4 days"), "{said}");
}

#[test]
fn the_status_socket_answers_old_and_odd_questions() {
    let place = Place::new();
    let node = place.start("arm-1.toml");
    let ask = |question: &[u8]| {
        let mut stream = UnixStream::connect(place.path("arm.sock")).unwrap();
        stream.set_read_timeout(Some(PATIENCE)).unwrap();
        let _ = stream.write_all(question);
        let mut text = String::new();
        let _ = stream.read_to_string(&mut text);
        serde_json::from_str::<Value>(&text).unwrap_or_default()
    };
    for question in [&b""[..], b"status\n", b"sgc/1 status\n"] {
        assert_eq!(ask(question)["node"], "arm-1", "{question:?}");
    }
    for (question, error) in [
        (&b"sgc/1 stop\n"[..], "\"stop\" is nothing"),
        (b"sgc/9 status\n", "speaks version 1"),
        (b"\xff\n", "not text"),
        (b"sgc/1 crl %\n", "lacks a usable argument"),
    ] {
        let answer = ask(question);
        assert!(answer["error"].as_str().unwrap().contains(error), "{answer}");
    }
    let long = ask(&vec![b'x'; 2 << 20]);
    assert!(long == Value::Null || long["error"].as_str().unwrap().contains("more than"), "{long}");
    // An unfinished request holds up no other.
    let mut slow = UnixStream::connect(place.path("arm.sock")).unwrap();
    slow.write_all(b"sgc/1 rel").unwrap();
    assert_eq!(ask(b"sgc/1 status\n")["node"], "arm-1");
    node.end();
}

#[test]
fn a_successor_gets_the_status_socket_when_its_predecessor_ends() {
    let place = Place::new();
    place.write("cart.toml", &place.read("cart.toml").replace("cart.sock", "arm.sock"));
    let status = || place.run(&["status", "--socket", "arm.sock", "--json"]).stdout;
    let first = place.start("arm-1.toml");
    let second = place.start("cart.toml");
    assert!(status().contains("\"node\":\"arm-1\""), "the live one keeps it");
    first.end();
    wait("the second has it", || status().contains("\"node\":\"cart\""));
    // Programs that tidy /tmp remove sockets.
    fs::remove_file(place.path("arm.sock")).unwrap();
    wait("it makes it again", || status().contains("\"node\":\"cart\""));
    let log = second.end();
    let no_socket =
        "no status socket: another node has it; it is taken over when that one ends; trying again";
    assert_eq!(log.matches(no_socket).count(), 1, "{log}");
    assert_eq!(log.matches("the status socket is there now").count(), 2, "{log}");
    assert!(!place.path("arm.sock").exists());
}

#[test]
fn a_directory_below_tmp_that_is_not_the_users_own_holds_no_status_socket() {
    let place = Place::new();
    fs::create_dir(place.path("tmp")).unwrap();
    place.write("cart.toml", &place.read("cart.toml").replace("[admin]\nsocket = \"cart.sock\"\n", ""));
    let with_tmp = |mut command: Command| {
        command.env_remove("XDG_RUNTIME_DIR").env("TMPDIR", place.path("tmp"));
        command
    };
    let dir = place.path("tmp").join(format!("sgc-{}", rustix::process::geteuid().as_raw()));
    let status = || {
        let output =
            with_tmp(place.command(&["status", "--socket", dir.join("cart.sock").to_str().unwrap()]));
        let output = { output }.output().unwrap();
        String::from_utf8([output.stdout, output.stderr].concat()).unwrap()
    };
    // Another user was there first and made a link to elsewhere.
    fs::create_dir(place.path("elsewhere")).unwrap();
    std::os::unix::fs::symlink(place.path("elsewhere"), &dir).unwrap();
    let node = place.start_with("cart.toml", with_tmp);
    assert_eq!(fs::read_dir(place.path("elsewhere")).unwrap().count(), 0);
    let said = status();
    assert!(said.contains("is not a directory but a file or a symbolic link: remove it, or set"), "{said}");
    fs::remove_file(&dir).unwrap();
    wait("the node makes it", || status().starts_with("cart: "));
    assert_eq!(fs::metadata(&dir).unwrap().permissions().mode() & 0o7777, 0o700);
    // The directory is opened to others while the node runs.
    fs::set_permissions(&dir, fs::Permissions::from_mode(0o755)).unwrap();
    assert!(status().contains("its mode 0755 lets others in; chmod 700 it"), "{}", status());
    node.end();
}

/// Runs in the process of another user: asks the node at a socket and prints the answer.
#[test]
fn as_another_user() {
    let Some(socket) = std::env::var_os("SGC_TEST_SOCKET") else { return };
    let mut stream = UnixStream::connect(socket).unwrap();
    let _ = stream.write_all(b"sgc/1 status\n");
    let mut text = String::new();
    let _ = stream.read_to_string(&mut text);
    println!("{text}");
}

#[test]
fn another_user_is_refused_at_a_status_socket_that_somebody_opened() {
    use std::os::unix::process::CommandExt;
    if !rustix::process::geteuid().is_root() {
        eprintln!("only root can be another user");
        return;
    }
    let place = Place::new();
    let node = place.start("arm-1.toml");
    let socket = place.path("arm.sock");
    fs::set_permissions(place.path("."), fs::Permissions::from_mode(0o755)).unwrap();
    fs::set_permissions(&socket, fs::Permissions::from_mode(0o777)).unwrap();
    for _ in 0..2 {
        // The user `nobody` may be unable to reach this program by its path.
        let mut command = Command::new("/proc/self/exe");
        command.args(["--exact", "as_another_user", "--nocapture"]).env("SGC_TEST_SOCKET", &socket);
        let output = command.uid(65534).gid(65534).output().unwrap();
        let said = String::from_utf8(output.stdout).unwrap();
        let why = "this node answers uid 0, whose it is, and root alone: you are uid 65534";
        assert!(said.contains(why) && !said.contains("links"), "{said}");
    }
    assert!(place.good(&["status", "--socket", "arm.sock"]).starts_with("arm-1: "));
    let log = node.end();
    assert_eq!(log.matches("refused another user at the status socket").count(), 1, "{log}");
}

#[test]
fn a_process_with_keys_leaves_no_core_and_is_not_traced_unless_its_user_says_so() {
    let place = Place::new();
    // Both processes run without root's capabilities, which would permit everything.
    let plain = |command: Command| {
        if !rustix::process::geteuid().is_root() {
            return command;
        }
        let mut plain = Command::new("setpriv");
        plain.args(["--inh-caps=-all", "--bounding-set=-all"]);
        plain.arg(command.get_program()).args(command.get_args());
        let variables = command.get_envs().filter_map(|(name, value)| Some((name, value?)));
        plain.env_clear().envs(variables).current_dir(place.path("."));
        plain.stdin(Stdio::null());
        plain
    };
    // Tries to read the memory from another process of the same user.
    let sees = |node: &Running| {
        let mut look = Command::new("cat");
        look.arg(format!("/proc/{}/maps", node.child.id()));
        plain(look).output().unwrap().status.success()
    };
    let core = |node: &Running| -> String {
        let limits = fs::read_to_string(format!("/proc/{}/limits", node.child.id())).unwrap();
        let line = limits.lines().find_map(|line| line.strip_prefix("Max core file size"));
        line.and_then(|line| line.split_whitespace().next()).unwrap().to_owned()
    };
    let node = place.start_with("arm-1.toml", plain);
    assert_eq!((sees(&node), core(&node)), (false, "0".to_owned()));
    node.end();
    let node = place.start_with("arm-1.toml", |mut command| {
        command.env("SGC_ALLOW_CORE_DUMPS", "1");
        plain(command)
    });
    assert!(sees(&node));
    node.end();
    let node = place.start_with("arm-1.toml", |mut command| {
        command.arg("--allow-core-dumps");
        plain(command)
    });
    assert!(sees(&node));
    node.end();
}

#[test]
fn a_token_hands_over_one_topic_and_is_taken_back() {
    let place = Place::new();
    let give =
        ["token", "share", "create", "-c", "arm-1.toml", "--topic", "/handoff/pose", "--to", "acme-ca.pem"];
    let said = place.bad(2, &give);
    assert!(said.contains("no node runs that could know it: add --type PACKAGE/msg/NAME"), "{said}");
    let ran = place.run(&[&give[..], &["--type", POSE, "--valid", "12h"]].concat());
    assert_eq!(ran.code, Some(0), "{}", ran.stderr);
    assert!(
        ran.stderr.contains("Token 1 for /handoff/pose [geometry_msgs") && ran.stderr.contains("next start"),
        "{}",
        ran.stderr
    );
    let token = ShareToken::parse(&ran.stdout).unwrap();
    let arm = place.identity("arm-1.identity");
    let metadata = Metadata::topic("arm-1", "/handoff/pose", POSE);
    assert_eq!(token.name(), derive_name(arm.fleet_secret().unwrap(), &arm.node_id(), &metadata));
    assert_eq!(token.routers, ["quic://127.0.0.1:9"]);
    assert_eq!((place.mode("state/partners.json"), place.mode("state")), (0o600, 0o700));
    let records = place.read("state/partners.json");
    assert!(!records.contains("sgc-token") && records.contains(&token.name().to_string()), "{records}");

    let listed = place.good(&["token", "share", "list", "-c", "arm-1.toml"]);
    assert!(listed.contains("/handoff/pose") && listed.lines().count() == 2, "{listed}");
    let of_cart = ["--identity-file", "cart.identity", "--topic", "/handoff/pose"];
    let (code, text) = place.policy(&of_cart);
    assert_eq!((code, text.contains("token 1 was given for it")), (Some(0), true), "{text}");
    assert_eq!(place.policy(&["--identity-file", "cart.identity", "--topic", "/cmd_vel"]).0, Some(1));
    assert_eq!(place.policy(&[&of_cart[..], &["--right", "publish"]].concat()).0, Some(1));

    // A running node is told by itself.
    let node = place.start("arm-1.toml");
    let said = place.good(&["token", "share", "revoke", "-c", "arm-1.toml", "1"]);
    assert!(said.contains("/handoff/pose: who may subscribe changed"), "{said}");
    assert_eq!(place.policy(&of_cart).0, Some(1));
    let said = place.bad(2, &["token", "share", "revoke", "-c", "arm-1.toml", "1"]);
    assert!(said.contains("no token has the number 1"), "{said}");
    node.end();
    // Numbers are not reused, and a token may be for one node of the partner alone.
    let cart = place.identity("cart.identity").node_id();
    for (to, permitted) in
        [(format!("acme-ca.pem:{cart}"), 0), (format!("acme-ca.pem:{}", "ab".repeat(32)), 1)]
    {
        let args = [&give[..7], &["--to", &to, "--type", POSE, "--json"]].concat();
        let ran = place.run(&args);
        let id = if permitted == 0 { 2 } else { 3 };
        assert!(ran.stderr.contains(&format!("Token {id} ")), "{}", ran.stderr);
        let made: Value = serde_json::from_str(&ran.stdout).expect(&ran.stdout);
        let token = ShareToken::parse(made["token"].as_str().unwrap()).unwrap();
        assert_eq!((&made["id"], &made["expires"]), (&id.into(), &token.expires.to_string().into()));
        assert_eq!(to.split_once(':').unwrap().1, made["node"], "{made}");
        assert_eq!(place.policy(&of_cart).0, Some(permitted), "{to}");
        let ran = place.run(&["token", "share", "revoke", "-c", "arm-1.toml", "--json", &id.to_string()]);
        let revoked: Value = serde_json::from_str(&ran.stdout).expect(&ran.stdout);
        assert_eq!((&revoked["id"], &revoked["topic"]), (&id.into(), &"/handoff/pose".into()));
        assert!(ran.stderr.contains("next start"), "{}", ran.stderr);
    }
    let said = place.bad(2, &[&give[..7], &["--to", "lab-ca.pem", "--type", POSE]].concat());
    assert!(said.contains("its nodes need no token"), "{said}");
}

#[test]
fn a_program_without_ros_gets_a_token_that_is_taken_back() {
    let place = Place::new();
    let create = ["token", "access", "create", "-c", "arm-1.toml", "--for", "dashboard"];
    let said = place.bad(2, &create);
    assert!(said.contains("it permits nothing: name at least one interface"), "{said}");
    let said = place.bad(2, &[&create[..], &["--subscribe", "odom"]].concat());
    assert!(said.contains("\"odom\" is neither the full name of an interface"), "{said}");
    place.bad(2, &[&create[..], &["--subscribe", "/odom", "--valid", "4000d"]].concat());
    assert!(!place.path("state/access.json").exists(), "nothing was made");

    let may =
        ["--subscribe", "/odom", "--subscribe", "/camera/**", "--publish", "/cmd_vel", "--valid", "12h"];
    let ran = place.run(&[&create[..], &may].concat());
    assert_eq!(ran.code, Some(0), "{}", ran.stderr);
    assert!(ran.stderr.contains("subscribe /odom /camera/**; publish /cmd_vel"), "{}", ran.stderr);
    assert!(ran.stderr.contains("has no [gateway] yet"), "{}", ran.stderr);
    let arm = place.identity("arm-1.identity");
    let token = AccessToken::parse(&ran.stdout).unwrap();
    let grant = token.verify(arm.as_peer()).unwrap();
    assert!(grant.scope.permits(Right::Subscribe, "/camera/front/image"));
    assert!(!grant.scope.permits(Right::Publish, "/camera/front/image"));
    assert_eq!(grant.expires.0 - grant.issued.0, 12 * 3_600_000);
    assert_eq!(place.mode("state/access.json"), 0o600);
    let records = place.read("state/access.json");
    assert!(!records.contains("sgc-access") && records.contains(&grant.id.to_string()), "{records}");

    let into = ["--for", "teleop", "--call", "/plan", "--out", "teleop.token"];
    let make = [&create[..5], &into].concat();
    assert_eq!(place.good(&make), "", "it is in the file alone");
    assert_eq!(place.mode("teleop.token"), 0o600);
    let second = AccessToken::parse(&place.read("teleop.token")).unwrap().id();
    let said = place.bad(2, &make);
    assert!(said.contains("teleop.token exists already"), "{said}");

    let list = ["token", "access", "list", "-c", "arm-1.toml"];
    let listed = place.good(&list);
    assert!(listed.contains("dashboard") && listed.contains("call /plan"), "{listed}");
    assert_eq!(listed.lines().count(), 3, "{listed}");
    let said = place.bad(2, &["token", "access", "revoke", "-c", "arm-1.toml", "0000"]);
    assert!(said.contains("no access token begins with"), "{said}");
    let id = grant.id.to_string();
    let said = place.good(&["token", "access", "revoke", "-c", "arm-1.toml", &id[..12]]);
    assert!(said.contains("for dashboard is revoked") && said.contains("next start"), "{said}");
    let ran = place.run(&["token", "access", "revoke", "-c", "arm-1.toml", "--json", &id]);
    let again: Value = serde_json::from_str(&ran.stdout).expect(&ran.stdout);
    assert_eq!(again, serde_json::json!({ "id": id, "for": "dashboard" }));
    let json = place.good(&[&list[..], &["--json"]].concat());
    let tokens: Vec<Value> = serde_json::from_str(&json).unwrap();
    let revoked: Vec<_> = tokens.iter().filter(|token| !token["revoked"].is_null()).collect();
    assert_eq!((revoked.len(), &revoked[0]["id"]), (1, &id.as_str().into()));
    assert!(tokens.iter().any(|token| token["id"] == second.to_string().as_str()));

    let audit = place.good(&["audit", "-c", "arm-1.toml", "--json"]);
    let records: Vec<Value> = audit.lines().map(|line| serde_json::from_str(line).unwrap()).collect();
    let events: Vec<_> = records.iter().map(|record| record["event"].as_str().unwrap()).collect();
    assert_eq!(events, ["token_made", "token_made", "token_revoked", "token_revoked"]);
    let why = |at: usize| records[at]["reason"].as_str().unwrap().to_owned();
    assert!(why(0).contains(&format!("{} for dashboard, until ", &id[..12])), "{audit}");
    assert!(why(0).ends_with("subscribe /odom /camera/**; publish /cmd_vel"), "{audit}");
    assert_eq!(why(2), format!("{} for dashboard", &id[..12]));
    assert!(records[2]["by"].as_str().unwrap().starts_with("uid "), "{audit}");
    assert!(!audit.contains("sgc-access"), "no token is in it");
    place.good(&["audit", "-c", "arm-1.toml", "--event", "token_refused"]);
}

#[test]
fn check_says_who_may_connect_to_a_gateway() {
    let place = Place::new();
    let before = place.read("arm-1.toml");
    let gateway = "\n[gateway]\nlisten = ['grpcs://0.0.0.0']\nanonymous = 'all'\n\
                   [[gateway.client]]\nwho = ['desk']\nsubscribe = ['/odom']\n";
    place.write("arm-1.toml", &format!("{before}{gateway}"));
    let said = place.good(&["check", "-c", "arm-1.toml"]);
    for part in [
        "gateway   grpcs://0.0.0.0:50051",
        "shows a certificate that it makes itself",
        "whoever reaches it may do everything",
        "certificates of desk: subscribe /odom",
        "anonymous = \"all\": whoever reaches grpcs://0.0.0.0:50051 may receive",
    ] {
        assert!(said.contains(part), "{part}\n{said}");
    }
}

#[test]
fn a_token_is_used_by_adding_three_lines() {
    let place = Place::new();
    let args = [
        "token",
        "share",
        "create",
        "-c",
        "arm-1.toml",
        "--topic",
        "/handoff/pose",
        "--to",
        "acme-ca.pem",
        "--type",
        POSE,
    ];
    let token = place.good(&args);
    let token = token.trim();
    place.write("pose.token", token);
    place.write("cut.token", &token[..token.len() - 3]);
    let before = place.read("cart.toml");
    // Any user who lists processes would see the token.
    let said = place.bad(2, &["token", "use", token, "-c", "cart.toml"]);
    assert!(said.contains("is shown to every user of this host") && !said.contains(&token[20..60]), "{said}");
    assert!(!place.path("cart-state").exists());
    let said = place.good(&["token", "use", "pose.token", "-c", "cart.toml", "--dry-run"]);
    assert!(
        said.contains("/handoff/pose [geometry_msgs/msg/PoseStamped] of arm-1") && said.contains("[[use]]"),
        "{said}"
    );
    let json = |args: &[&str]| -> Value {
        let ran = place.run(&[&["token", "use", "--json", "-c", "cart.toml"], args].concat());
        assert_eq!(ran.code, Some(0), "{}", ran.stderr);
        serde_json::from_str(&ran.stdout).expect(&ran.stdout)
    };
    let planned = json(&["pose.token", "--dry-run"]);
    assert_eq!((&planned["topic"], &planned["owner"]), (&"/handoff/pose".into(), &"arm-1".into()));
    assert_eq!((&planned["dry_run"], &planned["config_file"]), (&true.into(), &"cart.toml".into()));
    assert_eq!(place.read("cart.toml"), before);
    assert!(!place.path("cart-state").exists());

    fs::set_permissions(place.path("cart.toml"), fs::Permissions::from_mode(0o640)).unwrap();
    let used = json(&["--token-file", "pose.token"]);
    assert!(place.read("cart.toml").contains(used["added"].as_str().unwrap()), "{used}");
    assert_eq!((&used["dry_run"], &used["token_file"]), (&false.into(), &planned["token_file"]));
    let after = place.read("cart.toml");
    assert!(after.starts_with(&before) && !after.contains("sgc-token"), "{after}");
    assert_eq!((place.mode("cart.toml"), place.mode("cart-state/tokens")), (0o640, 0o700));
    let file = fs::read_dir(place.path("cart-state/tokens")).unwrap().next().unwrap().unwrap().path();
    assert_eq!(fs::metadata(&file).unwrap().permissions().mode() & 0o7777, 0o600);
    assert!(Path::new(&file).file_name().unwrap().to_str().unwrap().starts_with("handoff-pose-"));
    assert!(place.good(&["check", "-c", "cart.toml"]).contains("no mistakes"));
    let said = place.bad(2, &["token", "use", "pose.token", "-c", "cart.toml"]);
    assert!(said.contains("used with this very token already"), "{said}");
    let said = place.bad(2, &["token", "use", "cut.token", "-c", "cart.toml"]);
    assert!(said.contains("cut or mistyped") && !said.contains(&token[20..60]), "{said}");

    // The node joins that name and reports what it waits for.
    let node = place.start("cart.toml");
    let status: Value =
        serde_json::from_str(&place.good(&["status", "--socket", "cart.sock", "--json"])).unwrap();
    let route = &status["routes"][0];
    assert_eq!((&route["topic"], &route["owner"]), (&"/handoff/pose".into(), &"arm-1".into()));
    assert_eq!(route["name"], ShareToken::parse(token).unwrap().name().to_string());
    let log = node.end();
    assert!(!log.contains("sgc-token"), "{log}");
    // The rule is removed again while the node runs.
    let node = place.start("cart.toml");
    place.write("cart.toml", &before);
    let reload = || place.good(&["reload", "--socket", "cart.sock"]);
    let said = reload();
    assert!(said.starts_with("/handoff/pose of arm-1 is no longer used (by token)"), "{said}");
    node.end();
    // A node that started without a rule also takes one, and dials the router that the token names.
    let another = ["--via", "quic://127.0.0.1:10"];
    place.write("pose.token", place.good(&[&args[..], &another].concat()).trim());
    let node = place.start("cart.toml");
    let said = place.good(&["token", "use", "pose.token", "-c", "cart.toml"]);
    assert!(said.contains("/handoff/pose of arm-1 is used (by token)"), "{said}");
    assert!(said.contains("quic://127.0.0.1:10 is searched for"), "{said}");
    assert!(!said.contains("restart"), "{said}");
    let status: Value =
        serde_json::from_str(&place.good(&["status", "--socket", "cart.sock", "--json"])).unwrap();
    assert_eq!(status["routes"][0]["topic"], "/handoff/pose");
    assert!(status["routers"].to_string().contains("quic://127.0.0.1:10"), "{status}");
    place.write("cart.toml", &before);
    let said = reload();
    assert!(said.contains("quic://127.0.0.1:10 is no longer searched for"), "{said}");
    let routers = || place.good(&["status", "--socket", "cart.sock", "--json"]);
    let deadline = Instant::now() + PATIENCE;
    while routers().contains("quic://127.0.0.1:10") {
        assert!(Instant::now() < deadline, "the router of the token stays");
        std::thread::sleep(Duration::from_millis(20));
    }
    node.end();
}

#[test]
fn the_audit_log_is_found_filtered_and_read_over_what_is_broken() {
    let place = Place::new();
    place.start("arm-1.toml").end();
    let log = place.path("state/audit.jsonl");
    let peer = "ab".repeat(32);
    let mut file = fs::OpenOptions::new().append(true).open(&log).unwrap();
    let line = format!(
        "{{\"time\":\"2020-01-01T00:00:00Z\",\"unix_ms\":1577836800000,\"event\":\"refused\",\"topic\":\"/cmd_vel\",\
         \"peer\":\"{peer}\",\"reason\":\"\\u001b[2Jno\"}}\n{{\"time\":\"20"
    );
    file.write_all(line.as_bytes()).unwrap();
    // A later run begins a new line.
    place.start("arm-1.toml").end();
    let ran = place.run(&["audit", "-c", "arm-1.toml"]);
    let events: Vec<_> = ran.stdout.lines().filter_map(|line| line.split_whitespace().nth(1)).collect();
    assert_eq!(events, ["event", "started", "stopped", "refused", "started", "stopped"], "{}", ran.stdout);
    assert!(!ran.stdout.contains('\u{1b}') && ran.stdout.contains("[2Jno"));
    assert!(ran.stderr.contains("1 line is not readable"), "{}", ran.stderr);
    let lines = |args: &[&str]| {
        place.run(&[&["audit", "-c", "arm-1.toml", "--json"], args].concat()).stdout.lines().count()
    };
    assert_eq!(lines(&["--topic", "/cmd_vel"]), 1);
    assert_eq!((lines(&["--about", "abab"]), lines(&["--about", "ac"])), (1, 0));
    assert_eq!(lines(&["--event", "started", "--event", "refused"]), 3);
    assert_eq!(lines(&["--since", "1h"]), 4);
    let said = place.bad(2, &["audit", "-c", "arm-1.toml", "--event", "no"]);
    assert!(said.contains("granted, refused"), "{said}");
    assert!(place.bad(1, &["audit", "--file", "none"]).contains("there is no such file"));

    // The log is also found in the usual place.
    place.write("arm-1.toml", &place.read("arm-1.toml").replace("state = \"state\"\n", ""));
    place.start("arm-1.toml").end();
    assert!(place.good(&["audit"]).contains("started"));
    assert!(place.good(&["audit", "--node", "arm-1"]).contains("started"));
    // With the audit log off there is nothing to show.
    place.write("arm-1.toml", &format!("{}\n[audit]\noff = true\n", place.read("arm-1.toml")));
    place.start("arm-1.toml").end();
    assert_eq!(place.good(&["audit", "--node", "arm-1"]).lines().count(), 3);
    place.bad(2, &["audit", "-c", "arm-1.toml"]);
}
