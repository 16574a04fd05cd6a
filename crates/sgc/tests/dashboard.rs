//! `sgc dashboard` in Chromium, for a fleet of twenty-two nodes. `tests/js/dashboard.js` looks at the page.

#![allow(clippy::unwrap_used)]

use std::fmt::Write as _;
use std::fs;
use std::io::{BufRead as _, BufReader};
use std::net::UdpSocket;
use std::path::{Path, PathBuf};
use std::process::{Child, Command, Stdio};

/// Nodes besides the router, the authority, the observer, the busy and the absent one.
const ARMS: usize = 17;
const TOPICS: usize = 500;

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
        fleet.good(&["enroll", "desk", "--group", "observers"]);
        for member in members {
            fleet.good(&["enroll", member]);
        }
        fleet
    }

    fn command(&self) -> Command {
        let mut command = Command::new(env!("CARGO_BIN_EXE_sgc"));
        command.current_dir(self.dir.path()).env("XDG_RUNTIME_DIR", self.dir.path()).stdin(Stdio::null());
        command.env("HOME", self.dir.path()).env("ROS_AUTOMATIC_DISCOVERY_RANGE", "OFF");
        command
    }

    fn good(&self, args: &[&str]) {
        let ran = self.command().arg("fleet").args(args).output().unwrap();
        assert!(ran.status.success(), "{args:?}: {}", String::from_utf8_lossy(&ran.stderr));
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
        let (child, line) = first_line(command.stderr(Stdio::null()));
        assert!(!line.is_empty(), "{node} does not start");
        child
    }
}

/// Starts a command. Returns it and the first line that it writes.
fn first_line(command: &mut Command) -> (Running, String) {
    let mut child = command.stdout(Stdio::piped()).spawn().unwrap();
    let mut line = String::new();
    BufReader::new(child.stdout.take().unwrap()).read_line(&mut line).unwrap();
    (Running(child), line.trim_end().to_owned())
}

fn repository(file: &str) -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("../../").join(file)
}

#[test]
fn page_shows_a_fleet_of_twenty_nodes_five_hundred_topics_and_a_death() {
    let arms: Vec<_> = (0..ARMS).map(|n| format!("arm-{n:02}")).collect();
    let others = ["keeper", "busy", "absent"].map(str::to_owned);
    let fleet = Fleet::new(&[&arms[..], &others].concat());
    let listen = format!("[router]\nlisten = [\"quic://127.0.0.1:{}\"]\n", fleet.port);
    let _router = fleet.start("router", &listen);
    let _keeper = fleet.start("keeper", "[authority]\nfleet = \"lab.fleet\"\n");
    let mut shares = String::new();
    for n in 0..TOPICS {
        write!(shares, "[[share]]\ntopic = \"/topic_{n}\"\nto = [\"desk\"]\n").unwrap();
    }
    let _others = (fleet.start("busy", &shares), fleet.start("desk", ""));
    let mut running: Vec<_> = arms.iter().map(|arm| fleet.start(arm, "")).collect();

    let mut dashboard = fleet.command();
    dashboard.args(["dashboard", "--socket", "desk.sock", "--listen", "127.0.0.1:0"]);
    let (_dashboard, url) = first_line(&mut dashboard);
    let browser = fleet.dir.path().join("browser");
    let mut node = Command::new("node");
    node.arg(repository("tests/js/dashboard.js")).arg(&url).arg(&browser);
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
        said.push(line);
    }
    let output = page.wait_with_output().unwrap();
    let errors = String::from_utf8_lossy(&output.stderr);
    assert!(output.status.success() && said == ["kill", "all is well"], "{said:?}\n{errors}");
    if let Some(keep) = std::env::var_os("SGC_KEEP_PICTURES") {
        for picture in ["fleet.png", "dark.png", "dead.png"] {
            fs::copy(browser.join(picture), Path::new(&keep).join(picture)).unwrap();
        }
    }
}
