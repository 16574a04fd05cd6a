//! The ROS graph as a program that is not ours finds it: nodes and endpoints of a robot's network at a desk, on the
//! loopback interface of this host, in two ROS domains (`tests/peers/README.md`).

#![allow(clippy::unwrap_used)]

mod support;

use std::fs;
use std::sync::{Mutex, MutexGuard};

use rustix::process::Signal;
use serde_json::Value;
use sgc_sync::lock;
use sgc_testkit::netsim::Namespace;
use sgc_testkit::unused_port;
use support::{Peer, Running, eventually};

/// ROS domains: the robot's and the desk's.
const ROBOT: &str = "81";
const DESK: &str = "82";
/// One lab at a time: where there are no namespaces, they would meet.
static TURN: Mutex<()> = Mutex::new(());

/// A robot that shares `/a` and `/b` with a desk, to which it is linked directly.
struct Lab {
    dir: tempfile::TempDir,
    /// Where nothing but this test is; none where none can be made.
    namespace: Option<Namespace>,
    nodes: Vec<(&'static str, Running)>,
    _turn: MutexGuard<'static, ()>,
}

impl Lab {
    fn new(ros: &str) -> Self {
        let turn = lock(&TURN);
        let made = Namespace::create(format!("sgcg-{}", std::process::id()));
        let namespace = support::namespaces(made, "using this host's network");
        let dir = tempfile::tempdir().unwrap();
        let mut lab = Self { dir, namespace, nodes: Vec::new(), _turn: turn };
        support::enroll(lab.dir.path(), ["robot --may-route", "desk"]);
        let port = unused_port();
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

    fn start(&mut self, name: &'static str) {
        let mut command = support::sgc(self.namespace.as_ref(), self.dir.path());
        command.args(["run", "-c", &format!("{name}.toml")]);
        self.nodes.push((name, Running::start(command, &self.dir.path().join("log"))));
    }

    /// SIGTERM, and its end.
    fn stop(&mut self, name: &str) {
        let index = self.nodes.iter().position(|(known, _)| *known == name).unwrap();
        self.nodes.remove(index).1.end(Signal::TERM);
    }

    fn peer(&self, domain: &str, args: &[&str]) -> Peer {
        let program = Peer::program("cyclone");
        let mut peer = support::command(self.namespace.as_ref(), self.dir.path(), &program);
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
        self.nodes.clear();
        if std::thread::panicking() {
            support::say_log(
                "both nodes",
                &fs::read_to_string(self.dir.path().join("log")).unwrap_or_default(),
            );
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
