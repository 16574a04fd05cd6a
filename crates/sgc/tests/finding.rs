//! Routers and nodes as processes that find each other: in a mesh from the command line, and by mDNS between two network
//! namespaces.

#![allow(clippy::unwrap_used)]

use std::fs::File;
use std::io::{BufRead, BufReader, Write as _};
use std::path::Path;
use std::process::{Child, Command, Stdio};
use std::sync::atomic::{AtomicU32, Ordering};
use std::time::{Duration, Instant};

use rustix::process::{Pid, Signal, kill_process};
use serde_json::Value;
use tempfile::TempDir;

/// Longest wait for an event, far beyond what any takes.
const PATIENCE: Duration = Duration::from_secs(60);
static NETWORKS: AtomicU32 = AtomicU32::new(0);

/// Two network namespaces joined by a cable, which go when this does.
struct Cable {
    names: [String; 2],
}

impl Cable {
    fn lay() -> Result<Self, String> {
        let number = std::process::id() * 16 % 100_000 + NETWORKS.fetch_add(1, Ordering::Relaxed);
        let cable = Self { names: ["a", "b"].map(|end| format!("sgcf-{number}-{end}")) };
        let [a, b] = &cable.names;
        for name in &cable.names {
            ip(&["netns", "add", name])?;
            ip(&["-n", name, "link", "set", "lo", "up"])?;
        }
        ip(&["link", "add", "cable", "netns", a, "type", "veth", "peer", "name", "cable", "netns", b])?;
        for (name, address) in [(a, "10.92.1.1/24"), (b, "10.92.1.2/24")] {
            ip(&["-n", name, "address", "add", address, "dev", "cable"])?;
            ip(&["-n", name, "link", "set", "cable", "up"])?;
        }
        Ok(cable)
    }
}

impl Drop for Cable {
    fn drop(&mut self) {
        for name in &self.names {
            let _ = ip(&["netns", "delete", name]);
        }
    }
}

fn ip(args: &[&str]) -> Result<(), String> {
    let output = Command::new("ip").args(args).output().map_err(|e| format!("ip: {e}"))?;
    match output.status.success() {
        true => Ok(()),
        false => Err(format!("ip {}: {}", args.join(" "), String::from_utf8_lossy(&output.stderr).trim())),
    }
}

/// Says something in spite of the test harness, which keeps what passing tests print.
fn say(text: &str) {
    let _ = writeln!(std::io::stderr(), "{text}");
}

/// A fleet's files, and where its nodes run.
struct Place {
    dir: TempDir,
    cable: Option<Cable>,
}

impl Place {
    fn new(nodes: &[&str], routers: &[&str], cable: Option<Cable>) -> Self {
        let place = Self { dir: tempfile::tempdir().unwrap(), cable };
        let run = |args: &[&str]| {
            let output = place.sgc(0, args).output().unwrap();
            assert!(output.status.success(), "{output:?}");
        };
        run(&["fleet", "create", "lab"]);
        nodes.iter().for_each(|node| run(&["fleet", "enroll", node]));
        routers.iter().for_each(|node| run(&["fleet", "enroll", node, "--router"]));
        place
    }

    fn sgc(&self, end: usize, args: &[&str]) -> Command {
        let program = env!("CARGO_BIN_EXE_sgc");
        let mut command = match &self.cable {
            Some(cable) => {
                let mut command = Command::new("ip");
                command.args(["netns", "exec", &cable.names[end], program]);
                command
            }
            None => Command::new(program),
        };
        command.args(args).current_dir(self.dir.path()).env_clear().env("XDG_RUNTIME_DIR", self.dir.path());
        command.env("PATH", std::env::var_os("PATH").unwrap());
        command.stdin(Stdio::null()).stdout(Stdio::piped());
        command
    }

    /// Starts a node, and waits until it is up; it ends with this test.
    fn start(&self, end: usize, node: &str, args: &[&str]) -> Running {
        let log = File::options().create(true).append(true).open(self.dir.path().join(format!("{node}.log")));
        let mut command = self.sgc(end, &[args, &["--print-ready", "--until-stdin-closes"]].concat());
        let mut child = command.stdin(Stdio::piped()).stderr(log.unwrap()).spawn().unwrap();
        let mut line = String::new();
        BufReader::new(child.stdout.take().unwrap()).read_line(&mut line).unwrap();
        let ready: Value =
            serde_json::from_str(&line).unwrap_or_else(|_| panic!("{node}: {}", self.log(node)));
        let addresses = ready["ready"].as_array().unwrap();
        Running { child, addresses: addresses.iter().map(|a| a.as_str().unwrap().to_owned()).collect() }
    }

    fn log(&self, node: &str) -> String {
        std::fs::read_to_string(self.dir.path().join(format!("{node}.log"))).unwrap_or_default()
    }

    fn status(&self, node: &str) -> Value {
        let socket = self.dir.path().join(format!("sgc/{node}.sock"));
        let mut command = self.sgc(0, &["status", "--json", "--socket", socket.to_str().unwrap()]);
        serde_json::from_slice(&command.output().unwrap().stdout).unwrap_or(Value::Null)
    }

    fn links(&self, node: &str) -> usize {
        self.status(node)["links"].as_array().map_or(0, Vec::len)
    }

    fn wait(&self, what: &str, until: impl Fn() -> bool) {
        let deadline = Instant::now() + PATIENCE;
        while !until() {
            if Instant::now() >= deadline {
                for entry in std::fs::read_dir(self.dir.path()).unwrap().flatten() {
                    let name = entry.file_name().to_string_lossy().into_owned();
                    if let Some(node) = name.strip_suffix(".log") {
                        say(&format!("{node}:\n{}", self.log(node)));
                    }
                }
                panic!("never: {what}");
            }
            std::thread::sleep(Duration::from_millis(20));
        }
    }
}

struct Running {
    child: Child,
    addresses: Vec<String>,
}

impl Running {
    fn terminate(mut self) {
        kill_process(Pid::from_child(&self.child), Signal::TERM).unwrap();
        let _ = self.child.wait();
    }

    fn kill(mut self) {
        // Of a namespace: the program itself, since `ip` becomes it.
        self.child.kill().unwrap();
        let _ = self.child.wait();
    }
}

impl Drop for Running {
    fn drop(&mut self) {
        let _ = self.child.kill();
        let _ = self.child.wait();
    }
}

#[test]
fn routers_join_a_mesh_from_the_command_line() {
    let place = Place::new(&["robot"], &["cloud1", "cloud2", "cloud3"], None);
    let listen = ["--listen", "quic://127.0.0.1:0"];
    let router = |node: &'static str, peers: &[&str]| {
        let identity = format!("{node}.identity");
        let args = [&["router", "--identity", &identity][..], &listen, peers].concat();
        place.start(0, node, &args)
    };
    let first = router("cloud1", &[]);
    let second = router("cloud2", &["--peer", &first.addresses[0]]);
    let _third = router("cloud3", &["--peer", &first.addresses[0], "--peer", &second.addresses[0]]);
    place.wait("each is linked to both others", || {
        ["cloud1", "cloud2", "cloud3"].iter().all(|node| place.links(node) == 2)
    });
    let output = place.sgc(0, &["status", "--socket", "sgc/cloud3.sock"]).output().unwrap();
    let text = String::from_utf8(output.stdout).unwrap();
    let shown = text.lines().filter(|line| line.contains("  static  ") && line.contains("  linked"));
    assert_eq!(shown.count(), 2, "{text}");

    let output =
        place.sgc(0, &["router", "--identity", "cloud1.identity", listen[0], listen[1], "--peer", "cloud2"]);
    let output = { output }.stderr(Stdio::piped()).output().unwrap();
    let said = String::from_utf8(output.stderr).unwrap();
    assert!(output.status.code() == Some(2) && said.contains("`--peer` is \"cloud2\""), "{said}");
}

#[test]
fn a_router_on_another_machine_is_found_by_mdns_lost_and_found_again() {
    let cable = match Cable::lay() {
        Ok(cable) => Some(cable),
        Err(why) => {
            say(&format!(
                "NO NETWORK NAMESPACES ({why}): mDNS is tested on this host's own interfaces instead"
            ));
            None
        }
    };
    let (here, there) = if cable.is_some() { (0, 1) } else { (0, 0) };
    let place = Place::new(&["robot"], &["cloud"], cable);
    let listen = |port: &str| format!("quic://0.0.0.0:{port}");
    let start_cloud = |listen: &str| {
        let args = ["router", "--identity", "cloud.identity", "--announce", "--listen", listen];
        place.start(there, "cloud", &args)
    };
    let cloud = start_cloud(&listen("0"));
    let _robot = place.start(here, "robot", &["run", "--identity", "robot.identity", "--router", "mdns://"]);
    let linked = || place.links("robot") == 1 && place.links("cloud") == 1;
    place.wait("it is found", linked);
    if place.cable.is_some() {
        let remote = place.status("robot")["links"][0]["remote"].as_str().unwrap().to_owned();
        assert!(remote.starts_with("10.92.1.2:") || remote.starts_with("[fe80::"), "{remote}");
    }
    // It says goodbye, and comes back at another port.
    cloud.terminate();
    place.wait("it is lost", || place.links("robot") == 0);
    let cloud = start_cloud(&listen("0"));
    place.wait("it is found again", linked);
    // It dies without a word, and comes back where it was.
    let address = cloud.addresses[0].clone();
    let port = address.rsplit(':').next().unwrap().to_owned();
    cloud.kill();
    place.wait("it is lost again", || place.links("robot") == 0);
    let _cloud = start_cloud(&listen(&port));
    place.wait("it is found once more", linked);
    let said = place.log("robot") + &place.log("cloud");
    assert!(!said.contains(" ERROR ") && Path::new(&place.dir.path().join("cloud.log")).exists(), "{said}");
}
