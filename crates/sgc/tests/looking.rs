//! Tests of `sgc topic` and `sgc why` between two ROS 2 networks and a router: messages of an independent program, and
//! the fault that is named when a part is missing.

#![allow(clippy::unwrap_used)]

mod support;

use std::fs;
use std::path::PathBuf;
use std::process::Output;

use serde_json::Value;
use sgc_testkit::netsim::Namespace;
use support::{Peer, Running, eventually, say, say_log};
use tempfile::TempDir;

/// Two domains of one network stand for two networks.
const DOMAINS: [(&str, &str); 2] = [("robot", "93"), ("desk", "94")];

struct Lab {
    dir: TempDir,
    /// `None` where namespaces cannot be made.
    namespace: Option<Namespace>,
    nodes: Vec<Running>,
}

impl Lab {
    fn new(name: &str) -> Self {
        let namespace = support::own_network(format!("sgcl-{name}-{}", std::process::id()));
        let dir = tempfile::tempdir().unwrap();
        support::enroll(dir.path(), ["robot", "cloud --role router", "desk"]);
        Self { dir, namespace, nodes: Vec::new() }
    }

    fn sgc(&self, args: &[&str]) -> Output {
        support::sgc(self.namespace.as_ref(), self.dir.path()).args(args).output().unwrap()
    }

    fn path(&self, name: &str) -> PathBuf {
        self.dir.path().join(name)
    }

    /// Starts a node and returns the addresses on which it listens.
    fn start(&mut self, node: &str, config: &str) -> Vec<String> {
        let text = format!("identity = \"{node}.identity\"\n[admin]\nsocket = \"{node}.sock\"\n{config}");
        fs::write(self.path(&format!("{node}.toml")), text).unwrap();
        let mut command = support::sgc(self.namespace.as_ref(), self.dir.path());
        command.args(["run", "-c", &format!("{node}.toml")]);
        self.nodes.push(Running::start(command, &self.path(&format!("{node}.log"))));
        self.nodes.last().unwrap().addresses.clone()
    }

    fn log(&self, node: &str) -> String {
        fs::read_to_string(self.path(&format!("{node}.log"))).unwrap_or_default()
    }

    fn ros(&self, node: &str, router: &str) -> String {
        let domain = DOMAINS.iter().find(|(name, _)| *name == node).unwrap().1;
        format!(
            "[node]\nrouters = [\"{router}\"]\n[ros]\ndomain_id = {domain}\ndiscovery_range = \"localhost\"\nstatic_peers = []\n"
        )
    }

    fn peer(&self, node: &str, role: &str, args: &[&str]) -> Peer {
        let domain = DOMAINS.iter().find(|(name, _)| *name == node).unwrap().1;
        let program = Peer::program("cyclone");
        let mut command = support::command(self.namespace.as_ref(), self.dir.path(), &program);
        command.args([role, "--localhost", "--domain", domain, "--timeout", "150", "--topic", "/chatter"]);
        command.args(args);
        Peer::start(command)
    }

    /// Starts a server of `/add_two_ints`.
    fn server(&self, node: &str) -> Peer {
        let domain = DOMAINS.iter().find(|(name, _)| *name == node).unwrap().1;
        let mut command = support::python(self.namespace.as_ref(), self.dir.path(), "services.py");
        command.args(["server", "--localhost", "--domain", domain, "--timeout", "150"]);
        Peer::start(command)
    }

    /// Returns the exit code of `sgc why` and the step with the fault.
    fn why(&self, node: &str, what: &[&str]) -> (i32, String) {
        let socket = format!("{node}.sock");
        let args = [&["why", "--json", "--socket", &socket], what].concat();
        let output = self.sgc(&args);
        let steps: Value = serde_json::from_slice(&output.stdout).unwrap_or_else(|_| panic!("{output:?}"));
        let wrong = steps.as_array().unwrap().iter().find(|step| step["verdict"] == "wrong");
        let found = wrong.map_or(String::new(), |step| step["found"].as_str().unwrap().to_owned());
        (output.status.code().unwrap(), found)
    }

    /// Waits until `sgc why` finds this fault, or no fault if the text is empty.
    fn finds(&self, node: &str, what: &[&str], found: &str) {
        let mut last = (0, String::new());
        let mut asked = 0;
        eventually(&format!("{node} finds {found:?}"), || {
            last = self.why(node, what);
            asked += 1;
            if asked % 100 == 0 {
                say(&format!("{node} still says {last:?}, not {found:?}"));
            }
            if found.is_empty() { last == (0, String::new()) } else { last.0 == 1 && last.1.contains(found) }
        });
    }

    /// Returns a node's report of itself.
    fn report(&self, node: &str) -> Value {
        let output = self.sgc(&["fleet", "status", node, "--json", "--socket", &format!("{node}.sock")]);
        let status: Value = serde_json::from_slice(&output.stdout).unwrap_or_else(|_| panic!("{output:?}"));
        status["nodes"].as_array().unwrap().iter().find(|found| found["name"] == node).unwrap()["report"]
            .clone()
    }

    fn topic(&self, node: &str, args: &[&str]) -> Output {
        let socket = format!("{node}.sock");
        self.sgc(&[&["topic"], args, &["--socket", &socket]].concat())
    }
}

impl Drop for Lab {
    fn drop(&mut self) {
        self.nodes.clear();
        if std::thread::panicking() {
            ["robot", "cloud", "desk"].into_iter().for_each(|node| say_log(node, &self.log(node)));
        }
    }
}

/// Returns a topic of a report.
fn topic_of(report: &Value, topic: &str) -> Value {
    let found = report["topics"].as_array().unwrap().iter().find(|found| found["topic"] == topic);
    found.unwrap_or_else(|| panic!("{topic} is not in {report}")).clone()
}

#[test]
fn owner_on_the_same_local_network_is_pointed_out() {
    let mut lab = Lab::new("same");
    let router = lab.start("cloud", "[router]\nlisten = [\"quic://127.0.0.1:0\"]\n").remove(0);
    let here = lab.ros("robot", &router);
    lab.start("robot", &format!("{here}[[share]]\ntopic = \"/chatter\"\nto = [\"desk\"]\n"));
    lab.start("desk", &format!("{here}[[use]]\nfrom = \"robot\"\ntopic = \"/chatter\"\n"));
    let _talker = lab.peer("robot", "pub", &["--type", "string", "--rate", "20", "--wait-matched", "0"]);
    let alert = "robot and this node are on the same local ROS 2 network";
    eventually("why points it out", || {
        let output = lab.sgc(&["why", "--socket", "desk.sock", "/chatter"]);
        String::from_utf8_lossy(&output.stdout).contains(alert)
    });
    eventually("the log warns", || lab.log("desk").contains(alert));
    assert!(!lab.log("robot").contains("same local ROS 2 network"), "it uses nothing of the desk");
}

#[test]
fn messages_are_shown_at_both_ends_and_missing_parts_are_named() {
    let mut lab = Lab::new("two");
    assert_eq!(lab.why("robot", &["/chatter"]).0, 1, "no node runs");
    let router = lab.start("cloud", "[router]\nlisten = [\"quic://127.0.0.1:0\"]\n").remove(0);
    let config = lab.ros("robot", &router)
        + "[[share]]\ntopic = \"/chatter\"\nto = [\"desk\"]\n[[share]]\nservice = \"/add_two_ints\"\nto = [\"desk\"]\n";
    lab.start("robot", &config);
    lab.finds("robot", &["/chatter"], "no publisher of /chatter is on the local network");
    lab.finds("robot", &["/chater"], "did you mean /chatter?");
    let mut talker = lab.peer("robot", "pub", &["--type", "string", "--rate", "20", "--wait-matched", "0"]);
    lab.finds("robot", &["/chatter"], "nobody asked for it");
    let config = lab.ros("desk", &router)
        + "[[use]]\nfrom = \"robot\"\ntopic = \"/chatter\"\n[[use]]\nfrom = \"robot\"\nservice = \"/add_two_ints\"\n";
    lab.start("desk", &config);
    lab.finds("desk", &["/chatter"], "nobody on this local network subscribes to /chatter");
    let mut listener = lab.peer("desk", "sub", &["--type", "string"]);
    listener.wait("a match", |event| event["event"] == "matched");
    lab.finds("desk", &["/chatter"], "");
    lab.finds("robot", &["/chatter"], "");

    // The report has the path of the topic and the age of its last message; one of an own topic has neither.
    let report = lab.report("desk");
    let topic = topic_of(&report, "/chatter");
    assert_eq!(
        (&topic["via"], &topic["direct"]),
        (&report["links"][0]["peer"], &Value::from(false)),
        "{topic}"
    );
    assert!(topic["path_us"].as_u64() > Some(0) && topic["drops"].is_object(), "{topic}");
    let age_us = topic["age_us"].as_i64().unwrap_or_else(|| panic!("{topic}"));
    assert!((0..60_000_000).contains(&age_us), "{topic}");
    assert!(report["links"][0]["sent_packets"].as_u64() > Some(0), "{report}");
    let topic = topic_of(&lab.report("robot"), "/chatter");
    assert_eq!(["via", "path_us", "age_us"].map(|key| topic[key].is_null()), [true; 3], "{topic}");

    // A service has a server there and none here.
    lab.finds("robot", &["/add_two_ints"], "no server of /add_two_ints is on the local network");
    lab.finds("desk", &["/add_two_ints"], "robot is in reach and does not share /add_two_ints");
    let server = lab.server("robot");
    lab.finds("robot", &["/add_two_ints"], "");
    lab.finds("desk", &["/add_two_ints"], "");
    drop(server);

    // Each side has the same messages to show, decoded.
    for (node, side) in [("robot", "local"), ("robot", "sent"), ("desk", "far")] {
        let args = ["echo", "/chatter", "--json", "-n", "3", "--timeout", "60s", "--side", side];
        let output = lab.topic(node, &args);
        assert!(output.status.success(), "{node} {side}: {output:?}");
        let lines: Vec<_> = output.stdout.split(|b| *b == b'\n').filter(|line| !line.is_empty()).collect();
        assert_eq!(lines.len(), 3);
        for line in lines {
            let message: Value = serde_json::from_slice(line).unwrap();
            assert!(message["data"].as_str().is_some_and(|text| !text.is_empty()), "{message}");
        }
    }
    let output = lab.topic("desk", &["echo", "/chatter", "--once", "--timeout", "60s"]);
    let text = String::from_utf8(output.stdout).unwrap();
    assert!(text.starts_with("data: ") && text.ends_with("---\n"), "{text}");
    let output = lab.topic("desk", &["hz", "/chatter", "-n", "3"]);
    let text = String::from_utf8(output.stdout).unwrap();
    assert!(text.contains("average rate: "), "{text}");
    let output = lab.topic("robot", &["bw", "/chatter", "-n", "3"]);
    assert!(String::from_utf8(output.stdout).unwrap().contains("Message size mean"), "bandwidth");
    // A string has no header.
    assert_eq!(lab.topic("robot", &["delay", "/chatter"]).status.code(), Some(1));
    // No program has the topic.
    let output = lab.topic("robot", &["echo", "/other"]);
    assert_eq!(output.status.code(), Some(1));
    assert!(String::from_utf8(output.stderr).unwrap().contains("sgc why /other"));

    let list = String::from_utf8(lab.topic("robot", &["list"]).stdout).unwrap();
    let line = list.lines().find(|line| line.starts_with("/chatter")).unwrap_or_else(|| panic!("{list}"));
    assert!(line.contains("std_msgs/msg/String") && line.contains("shared: 1 node has it"), "{list}");
    let info = String::from_utf8(lab.topic("desk", &["info", "-v", "/chatter"]).stdout).unwrap();
    assert!(info.contains("Reliability: RELIABLE") && info.contains("Shared by robot"), "{info}");

    // The router knows only the 256-bit name.
    let name = info.lines().find_map(|line| line.trim().strip_prefix("Name: ")).unwrap();
    lab.finds("cloud", &["--name", name], "");
    lab.finds("cloud", &["--name", &"0".repeat(64)], "nobody in reach advertises it");
    lab.finds("cloud", &["/chatter"], "touches no ROS 2 network");

    listener.end();
    lab.finds("desk", &["/chatter"], "nobody on this local network subscribes to /chatter");
    // The subscriber asks for a history that no publisher keeps.
    let mut strict = lab.peer("desk", "sub", &["--type", "string", "--transient-local"]);
    lab.finds("desk", &["/chatter"], "by durability: VOLATILE is offered");
    strict.end();
    talker.end();
    lab.finds("robot", &["/chatter"], "no publisher of /chatter");
}
