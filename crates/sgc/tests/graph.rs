//! The ROS graph as a program that is not ours finds it: nodes and endpoints of a robot's network at a desk, on the
//! loopback interface of this host, in two ROS domains (`tests/peers/README.md`).

#![allow(clippy::unwrap_used)]

#[allow(dead_code)]
mod support;

use std::fs;
use std::io::{BufRead, BufReader};
use std::path::Path;
use std::process::{Child, Command, Stdio};
use std::sync::{Mutex, MutexGuard, PoisonError};

use rustix::process::{Pid, Signal, kill_process};
use serde_json::Value;
use support::{Peer, command, eventually, ip};

/// ROS domains: the robot's and the desk's.
const ROBOT: &str = "81";
const DESK: &str = "82";
/// One lab at a time: where there are no namespaces, they would meet.
static TURN: Mutex<()> = Mutex::new(());

/// A robot that shares `/a` and `/b` with a desk, to which it is linked directly.
struct Lab {
    dir: tempfile::TempDir,
    /// Where nothing but this test is; none where none can be made.
    namespace: Option<String>,
    nodes: Vec<(&'static str, Child)>,
    _turn: MutexGuard<'static, ()>,
}

impl Lab {
    fn new(ros: &str) -> Self {
        let turn = TURN.lock().unwrap_or_else(PoisonError::into_inner);
        let namespace = format!("sgcg-{}", std::process::id());
        let made = ip(&["netns", "add", &namespace])
            .and_then(|()| ip(&["-n", &namespace, "link", "set", "lo", "up"]));
        let namespace = made.is_ok().then_some(namespace);
        let dir = tempfile::tempdir().unwrap();
        let mut lab = Self { dir, namespace, nodes: Vec::new(), _turn: turn };
        for args in [&["fleet", "create", "lab"][..], &["fleet", "enroll", "robot", "--may-route"]] {
            assert!(lab.sgc().args(args).status().unwrap().success());
        }
        assert!(lab.sgc().args(["fleet", "enroll", "desk"]).status().unwrap().success());
        let socket = std::net::UdpSocket::bind("127.0.0.1:0").unwrap();
        let port = socket.local_addr().unwrap().port();
        drop(socket);
        let common = |name: &str, domain: &str| {
            format!(
                "identity = \"{name}.identity\"\n[admin]\nsocket = \"{name}.sock\"\n[ros]\n\
                 domain_id = {domain}\ndiscovery_range = \"localhost\"\nstatic_peers = []\n{ros}\n"
            )
        };
        let mut robot =
            common("robot", ROBOT) + &format!("[router]\nlisten = [\"quic://127.0.0.1:{port}\"]\n");
        let mut desk = common("desk", DESK) + &format!("[node]\nrouters = [\"quic://127.0.0.1:{port}\"]\n");
        for topic in ["/a", "/b"] {
            robot += &format!("[[share]]\ntopic = \"{topic}\"\nto = [\"desk\"]\n");
            desk += &format!("[[use]]\nfrom = \"robot\"\ntopic = \"{topic}\"\n");
        }
        fs::write(lab.dir.path().join("robot.toml"), robot).unwrap();
        fs::write(lab.dir.path().join("desk.toml"), desk).unwrap();
        lab.start("robot");
        lab.start("desk");
        lab
    }

    fn sgc(&self) -> Command {
        let mut sgc =
            command(self.namespace.as_deref(), self.dir.path(), Path::new(env!("CARGO_BIN_EXE_sgc")));
        sgc.stdout(Stdio::null());
        sgc
    }

    fn start(&mut self, name: &'static str) {
        let log = fs::File::options().create(true).append(true).open(self.dir.path().join("log")).unwrap();
        let mut sgc = self.sgc();
        sgc.args(["run", "--print-ready", "-c", &format!("{name}.toml")]);
        let mut child = sgc.stdout(Stdio::piped()).stderr(log).spawn().unwrap();
        let mut line = String::new();
        BufReader::new(child.stdout.take().unwrap()).read_line(&mut line).unwrap();
        assert!(line.contains("ready"), "{name}: {}", self.log());
        self.nodes.push((name, child));
    }

    /// SIGTERM, and its end.
    fn stop(&mut self, name: &str) {
        let index = self.nodes.iter().position(|(known, _)| *known == name).unwrap();
        let (_, mut child) = self.nodes.remove(index);
        kill_process(Pid::from_child(&child), Signal::TERM).unwrap();
        child.wait().unwrap();
    }

    fn log(&self) -> String {
        fs::read_to_string(self.dir.path().join("log")).unwrap_or_default()
    }

    fn peer(&self, domain: &str, args: &[&str]) -> Peer {
        let mut peer = command(self.namespace.as_deref(), self.dir.path(), &Peer::program("cyclone"));
        let (role, args) = args.split_first().unwrap();
        peer.args([role, "--localhost", "--domain", domain, "--timeout", "150"]).args(args);
        Peer::start(peer)
    }

    /// A publisher of a node, at the robot.
    fn talker(&self, topic: &str, node: &str, extra: &[&str]) -> Peer {
        let args = ["pub", "--topic", topic, "--node", node, "--rate", "10", "--wait-matched", "0"];
        self.peer(ROBOT, &[&args[..], extra].concat())
    }
}

impl Drop for Lab {
    fn drop(&mut self) {
        for (_, child) in &mut self.nodes {
            let _ = child.kill();
            let _ = child.wait();
        }
        if std::thread::panicking() {
            support::say(&self.log());
        }
        if let Some(namespace) = &self.namespace {
            let _ = ip(&["netns", "delete", namespace]);
        }
    }
}

/// Waits for a graph with exactly these nodes, and these writers of a topic, by node.
fn finds(watcher: &mut Peer, nodes: &[&str], topic: &str, writers: &[&str]) -> Vec<Value> {
    let mut last = Value::Null;
    let of_topic = |event: &Value| -> Vec<Value> {
        let all = event["endpoints"].as_array().cloned().unwrap_or_default();
        all.into_iter().filter(|e| e["topic"] == topic && e["kind"] == "writer").collect()
    };
    let mut found = Vec::new();
    eventually(&format!("{nodes:?}"), || {
        while let Ok((_, event)) = watcher.events.try_recv() {
            if event["event"] == "graph" {
                last = event;
                found = of_topic(&last);
            }
        }
        let here: Vec<_> = found.iter().map(|e| e["node"].clone()).collect();
        last["nodes"] == Value::from(nodes) && here == writers
    });
    found
}

#[test]
fn far_nodes_are_found_with_their_endpoints_and_gone_when_they_go() {
    let mut lab = Lab::new("");
    // A network with ids of 16 bytes; the robot's has longer ones.
    let mut watcher = lab.peer(DESK, &["graph"]);
    finds(&mut watcher, &["/graph_watcher", "/sgc_desk"], "/a", &[]);
    let old = ["--gid-bytes", "24"];
    let mut talker = lab.talker("/a", "/robot/talker", &[&old[..], &["--deadline", "1.5"]].concat());
    let _second = lab.talker("/a", "/second", &[&old[..], &["--best-effort"]].concat());
    let _private = lab.talker("/private", "/private", &old);
    let all = ["/graph_watcher", "/robot/talker", "/second", "/sgc_desk"];
    let found = finds(&mut watcher, &all, "/a", &["/robot/talker", "/second"]);
    assert_eq!((&found[0]["qos"]["deadline"], &found[1]["qos"]["deadline"]), (&1.5.into(), &Value::Null));
    assert_eq!(found[0]["type"], "std_msgs::msg::dds_::String_");
    // Later a distribution with ids of 24 bytes is the greater part of it, whatever said the other before.
    watcher.end();
    watcher.summary();
    let mut watchers =
        ["/one", "/two"].map(|node| lab.peer(DESK, &["graph", "--gid-bytes", "24", "--node", node]));
    let all = ["/one", "/robot/talker", "/second", "/sgc_desk", "/two"];
    finds(&mut watchers[0], &all, "/a", &["/robot/talker", "/second"]);
    talker.end();
    talker.summary();
    let all = ["/one", "/second", "/sgc_desk", "/two"];
    finds(&mut watchers[0], &all, "/a", &["/second"]);
    lab.stop("robot");
    finds(&mut watchers[0], &["/one", "/sgc_desk", "/two"], "/a", &[]);
    lab.start("robot");
    finds(&mut watchers[0], &all, "/a", &["/second"]);
}

#[test]
fn switched_off_no_node_is_told_of_and_topics_are_as_before() {
    let lab = Lab::new("graph = false");
    let mut watcher = lab.peer(DESK, &["graph"]);
    let _talker = lab.talker("/a", "/robot/talker", &[]);
    finds(&mut watcher, &["/graph_watcher"], "/a", &["_NODE_NAME_UNKNOWN_"]);
}
