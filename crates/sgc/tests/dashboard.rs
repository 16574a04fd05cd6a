//! `sgc dashboard` in Chromium, for a fleet of twenty-two nodes. `tests/js/dashboard.js` looks at the page.

#![allow(clippy::unwrap_used)]

use std::fmt::Write as _;
use std::fs;
use std::io::{BufRead as _, BufReader};
use std::net::UdpSocket;
use std::path::{Path, PathBuf};
use std::process::{Child, Command, Stdio};
use std::time::{Duration, Instant};

/// Nodes besides the router, the authority, the observer, the busy and the absent one.
const ARMS: usize = 17;
const TOPICS: usize = 500;
const PICTURES: [&str; 8] = [
    "fleet.png",
    "dark.png",
    "rights.png",
    "rights-dark.png",
    "revoke.png",
    "refused.png",
    "audit.png",
    "dead.png",
];
/// Rules of one node that permit each kind of recipient something.
const RULES: &str = r#"
[[partner]]
name = "acme"
ca = "acme.pem"
[[share]]
topic = "/odom"
to = ["*", "partner:acme"]
[[share]]
topic = "/cmd_vel"
type = "geometry_msgs/msg/Twist"
to = ["desk"]
publish = ["group:operators"]
[[share]]
topic = "/camera/**"
except = ["/camera/raw"]
to = ["group:observers", "ghost"]
[[share]]
service = "/reset"
to = ["group:operators", "busy"]
"#;

/// A child that ends with its owner.
struct Running(Child);

impl Drop for Running {
    fn drop(&mut self) {
        let _ = self.0.kill();
        let _ = self.0.wait();
    }
}

/// A fleet in a directory, whose nodes meet at a router on loopback.
struct Fleet {
    dir: tempfile::TempDir,
    port: u16,
}

impl Fleet {
    fn new(members: &[String]) -> Self {
        let port = UdpSocket::bind("127.0.0.1:0").unwrap().local_addr().unwrap().port();
        let fleet = Self { dir: tempfile::tempdir().unwrap(), port };
        fleet.good(&["create", "lab", "--authority", "keeper"]);
        fleet.good(&["enroll", "router", "--role", "router"]);
        fleet.good(&["enroll", "desk", "--group", "observers", "--group", "operators"]);
        fleet.good(&["enroll", "busy", "--group", "observers"]);
        for member in members {
            fleet.good(&["enroll", member]);
        }
        let partner = fleet.dir.path().join("partner");
        fs::create_dir(&partner).unwrap();
        fleet.good_in(&partner, &["create", "acme"]);
        fs::write(fleet.dir.path().join("acme.pem"), fleet.good_in(&partner, &["ca"])).unwrap();
        fleet
    }

    fn command(&self) -> Command {
        let mut command = Command::new(env!("CARGO_BIN_EXE_sgc"));
        command.current_dir(self.dir.path()).env("XDG_RUNTIME_DIR", self.dir.path()).stdin(Stdio::null());
        command.env("HOME", self.dir.path()).env("ROS_AUTOMATIC_DISCOVERY_RANGE", "OFF");
        command
    }

    fn good(&self, args: &[&str]) -> String {
        self.good_in(self.dir.path(), args)
    }

    /// Runs a command of `sgc fleet` in a directory. Returns what it prints.
    fn good_in(&self, dir: &Path, args: &[&str]) -> String {
        let ran = self.command().current_dir(dir).arg("fleet").args(args).output().unwrap();
        assert!(ran.status.success(), "{args:?}: {}", String::from_utf8_lossy(&ran.stderr));
        String::from_utf8(ran.stdout).unwrap()
    }

    /// Returns the number of links that a node has.
    fn links(&self, node: &str) -> usize {
        let ran =
            self.command().args(["status", "--json", "--socket", &format!("{node}.sock")]).output().unwrap();
        let status: serde_json::Value = serde_json::from_slice(&ran.stdout).unwrap();
        status["links"].as_array().unwrap().len()
    }

    /// Serves the page of a node, and lets it revoke. Returns the URLs to operate and to look.
    fn dashboard(&self, node: &str) -> (Running, [String; 2]) {
        let mut command = self.command();
        let socket = format!("{node}.sock");
        command.args(["dashboard", "--operate", "--socket", &socket, "--listen", "127.0.0.1:0"]);
        let (child, [operate, look]) = first_lines(&mut command);
        let look = look.strip_prefix("to look only: ").unwrap().to_owned();
        (child, [operate, look])
    }

    fn start(&self, node: &str, more: &str) -> Running {
        let routers = match node {
            "router" => String::new(),
            _ => format!("routers = [\"quic://127.0.0.1:{}\"]\n", self.port),
        };
        let text = format!(
            "identity = \"{node}.identity\"\n[node]\nstate = \"{node}.state\"\nwatch = false\n{routers}\
             [admin]\nsocket = \"{node}.sock\"\n{more}"
        );
        fs::write(self.dir.path().join(format!("{node}.toml")), text).unwrap();
        let mut command = self.command();
        command.args(["run", "-c", &format!("{node}.toml"), "--print-ready"]);
        let (child, [line]) = first_lines(command.stderr(Stdio::null()));
        assert!(!line.is_empty(), "{node} does not start");
        child
    }
}

/// Starts a command. Returns it and the first lines that it writes.
fn first_lines<const N: usize>(command: &mut Command) -> (Running, [String; N]) {
    let mut child = command.stdout(Stdio::piped()).spawn().unwrap();
    let mut reader = BufReader::new(child.stdout.take().unwrap());
    let lines = std::array::from_fn(|_| {
        let mut line = String::new();
        reader.read_line(&mut line).unwrap();
        line.trim_end().to_owned()
    });
    (Running(child), lines)
}

/// Waits until something is so, for at most half a minute.
fn wait(what: &str, mut is: impl FnMut() -> bool) {
    let begun = Instant::now();
    while !is() {
        assert!(begun.elapsed() < Duration::from_secs(30), "{what}");
        std::thread::sleep(Duration::from_millis(100));
    }
}

fn repository(file: &str) -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("../../").join(file)
}

#[test]
fn page_shows_a_fleet_of_twenty_nodes_its_rights_and_a_death_and_revokes_a_node() {
    let arms: Vec<_> = (0..ARMS).map(|n| format!("arm-{n:02}")).collect();
    let others = ["keeper", "absent"].map(str::to_owned);
    let fleet = Fleet::new(&[&arms[..], &others].concat());
    let listen = format!("[router]\nlisten = [\"quic://127.0.0.1:{}\"]\n", fleet.port);
    let _router = fleet.start("router", &listen);
    let _keeper =
        fleet.start("keeper", "[authority]\nfleet = \"lab.fleet\"\noperators = [\"group:operators\"]\n");
    let mut shares = String::new();
    for n in 0..TOPICS {
        write!(shares, "[[share]]\ntopic = \"/topic_{n}\"\nto = [\"desk\"]\n").unwrap();
    }
    let _others = (fleet.start("busy", &shares), fleet.start("desk", ""));
    let rules = |arm: &String| if arm == "arm-00" { RULES } else { "" };
    let mut running: Vec<_> = arms.iter().map(|arm| fleet.start(arm, rules(arm))).collect();

    let (_dashboard, urls) = fleet.dashboard("desk");
    // Its node is an observer and no operator.
    let (_refused, [refused, _]) = fleet.dashboard("busy");
    let browser = fleet.dir.path().join("browser");
    let mut node = Command::new("node");
    node.arg(repository("tests/js/dashboard.js")).args(&urls).arg(&refused).arg(&browser);
    node.env("HOME", fleet.dir.path()).env("TMPDIR", fleet.dir.path()).stdin(Stdio::null());
    let spawned = node.stdout(Stdio::piped()).stderr(Stdio::piped()).spawn();
    let mut page = spawned.unwrap_or_else(|why| panic!("{why}: run `make deps-test peers` first: node"));
    let mut said = Vec::new();
    for line in BufReader::new(page.stdout.take().unwrap()).lines() {
        let line = line.unwrap();
        if line == "kill" {
            // The one of this name ends without a word.
            drop(running.remove(3));
        }
        if line == "revoked" {
            let list = fleet.good(&["list", "--at", "keeper", "--socket", "desk.sock"]);
            let is_revoked =
                |node: &str| list.lines().any(|row| row.starts_with(node) && row.contains("revoked"));
            assert!(is_revoked("arm-05") && !is_revoked("arm-06"), "{list}");
            wait("arm-05 is out", || fleet.links("arm-05") == 0);
            assert!(fleet.links("arm-06") > 0);
        }
        said.push(line);
    }
    let output = page.wait_with_output().unwrap();
    let errors = String::from_utf8_lossy(&output.stderr);
    assert!(output.status.success() && said == ["revoked", "kill", "all is well"], "{said:?}\n{errors}");
    if let Some(keep) = std::env::var_os("SGC_KEEP_PICTURES") {
        for picture in PICTURES {
            fs::copy(browser.join(picture), Path::new(&keep).join(picture)).unwrap();
        }
    }
}
