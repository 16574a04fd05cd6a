//! `sgc topic` and `sgc why` between two ROS 2 networks and a router: what they show of the messages of a program that is not
//! ours, and what they name when a part is missing.

#![allow(clippy::unwrap_used)]

#[allow(dead_code, reason = "nobody waits for its peers here")]
mod support;

use std::fs;
use std::io::{BufRead, BufReader};
use std::path::{Path, PathBuf};
use std::process::{Child, Command, Output, Stdio};

use serde_json::Value;
use support::{Peer, eventually, ip, say};
use tempfile::TempDir;

/// Two domains of one network stand for two networks.
const DOMAINS: [(&str, &str); 2] = [("robot", "93"), ("desk", "94")];

struct Lab {
    dir: TempDir,
    /// None where namespaces cannot be made.
    namespace: Option<String>,
    nodes: Vec<Child>,
}

impl Lab {
    fn new() -> Self {
        let namespace = format!("sgcl-{}", std::process::id());
        let made = ip(&["netns", "add", &namespace])
            .and_then(|()| ip(&["-n", &namespace, "link", "set", "lo", "up"]))
            .and_then(|()| ip(&["-n", &namespace, "link", "set", "lo", "multicast", "on"]));
        let namespace = match made {
            Ok(()) => Some(namespace),
            Err(why) => {
                say(&format!("NO NETWORK NAMESPACES ({why}): using this host's network"));
                None
            }
        };
        let lab = Self { dir: tempfile::tempdir().unwrap(), namespace, nodes: Vec::new() };
        for args in [
            &["fleet", "create", "lab"][..],
            &["fleet", "enroll", "robot"],
            &["fleet", "enroll", "cloud", "--router"],
            &["fleet", "enroll", "desk"],
        ] {
            let output = lab.sgc(args);
            assert!(output.status.success(), "{output:?}");
        }
        lab
    }

    fn command(&self, program: &Path) -> Command {
        support::command(self.namespace.as_deref(), self.dir.path(), program)
    }

    fn sgc(&self, args: &[&str]) -> Output {
        self.command(Path::new(env!("CARGO_BIN_EXE_sgc"))).args(args).output().unwrap()
    }

    fn path(&self, name: &str) -> PathBuf {
        self.dir.path().join(name)
    }

    /// Starts a node; gives the addresses that it listens on.
    fn start(&mut self, node: &str, config: &str) -> Vec<String> {
        let text = format!("identity = \"{node}.identity\"\n[admin]\nsocket = \"{node}.sock\"\n{config}");
        fs::write(self.path(&format!("{node}.toml")), text).unwrap();
        let log = fs::File::create(self.path(&format!("{node}.log"))).unwrap();
        let mut command = self.command(Path::new(env!("CARGO_BIN_EXE_sgc")));
        command.args(["run", "--print-ready", "-c", &format!("{node}.toml")]);
        let mut child = command.stdout(Stdio::piped()).stderr(log).spawn().unwrap();
        let mut line = String::new();
        BufReader::new(child.stdout.take().unwrap()).read_line(&mut line).unwrap();
        self.nodes.push(child);
        assert!(line.contains("ready"), "{node}: {line} {}", self.log(node));
        let ready: Value = serde_json::from_str(&line).unwrap();
        let listen = ready["ready"].as_array().unwrap_or_else(|| panic!("{line}"));
        listen.iter().map(|url| url.as_str().unwrap().to_owned()).collect()
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
        let mut command = self.command(&Peer::program("cyclone"));
        command.args([role, "--localhost", "--domain", domain, "--timeout", "150", "--topic", "/chatter"]);
        command.args(args);
        Peer::start(command)
    }

    /// A server of `/add_two_ints`.
    fn server(&self, node: &str) -> Peer {
        let root = Path::new(env!("CARGO_MANIFEST_DIR")).join("../..");
        let domain = DOMAINS.iter().find(|(name, _)| *name == node).unwrap().1;
        let mut command = self.command(&root.join(".venv/bin/python"));
        command.arg("-B").arg(root.join("tests/peers/py/services.py"));
        command.args(["server", "--localhost", "--domain", domain, "--timeout", "150"]);
        Peer::start(command)
    }

    /// What `sgc why` came to: exit code, and the step that is wrong.
    fn why(&self, node: &str, what: &[&str]) -> (i32, String) {
        let socket = format!("{node}.sock");
        let args = [&["why", "--json", "--socket", &socket], what].concat();
        let output = self.sgc(&args);
        let steps: Value = serde_json::from_slice(&output.stdout).unwrap_or_else(|_| panic!("{output:?}"));
        let wrong = steps.as_array().unwrap().iter().find(|step| step["verdict"] == "wrong");
        let found = wrong.map_or(String::new(), |step| step["found"].as_str().unwrap().to_owned());
        (output.status.code().unwrap(), found)
    }

    /// Waits until that is what is wrong; nothing, if it is empty.
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

    fn topic(&self, node: &str, args: &[&str]) -> Output {
        let socket = format!("{node}.sock");
        self.sgc(&[&["topic"], args, &["--socket", &socket]].concat())
    }
}

impl Drop for Lab {
    fn drop(&mut self) {
        for child in &mut self.nodes {
            let _ = child.kill();
            let _ = child.wait();
        }
        if std::thread::panicking() {
            for node in ["robot", "cloud", "desk"] {
                say(&format!("--- {node} ---\n{}", self.log(node)));
            }
        }
        if let Some(namespace) = &self.namespace {
            let _ = ip(&["netns", "delete", namespace]);
        }
    }
}

#[test]
fn messages_are_shown_at_both_ends_and_what_is_missing_is_named() {
    let mut lab = Lab::new();
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

    // A service has a server there and none here.
    lab.finds("robot", &["/add_two_ints"], "no server of /add_two_ints is on the local network");
    lab.finds("desk", &["/add_two_ints"], "robot is in reach and does not share /add_two_ints");
    let server = lab.server("robot");
    lab.finds("robot", &["/add_two_ints"], "");
    lab.finds("desk", &["/add_two_ints"], "");
    drop(server);

    // Each side has the same messages to show, decoded.
    for (node, side) in [("robot", "local"), ("robot", "sent"), ("desk", "far")] {
        let args = ["echo", "/chatter", "--json", "-n", "3", "--timeout", "60", "--side", side];
        let output = lab.topic(node, &args);
        assert!(output.status.success(), "{node} {side}: {output:?}");
        let lines: Vec<_> = output.stdout.split(|b| *b == b'\n').filter(|line| !line.is_empty()).collect();
        assert_eq!(lines.len(), 3);
        for line in lines {
            let message: Value = serde_json::from_slice(line).unwrap();
            assert!(message["data"].as_str().is_some_and(|text| !text.is_empty()), "{message}");
        }
    }
    let output = lab.topic("desk", &["echo", "/chatter", "--once", "--timeout", "60"]);
    let text = String::from_utf8(output.stdout).unwrap();
    assert!(text.starts_with("data: ") && text.ends_with("---\n"), "{text}");
    let output = lab.topic("desk", &["hz", "/chatter", "-n", "3"]);
    let text = String::from_utf8(output.stdout).unwrap();
    assert!(text.contains("average rate: "), "{text}");
    let output = lab.topic("robot", &["bw", "/chatter", "-n", "3"]);
    assert!(String::from_utf8(output.stdout).unwrap().contains("Message size mean"), "bandwidth");
    // A string has no header.
    assert_eq!(lab.topic("robot", &["delay", "/chatter"]).status.code(), Some(1));
    // Nobody has it.
    let output = lab.topic("robot", &["echo", "/other"]);
    assert_eq!(output.status.code(), Some(1));
    assert!(String::from_utf8(output.stderr).unwrap().contains("sgc why /other"));

    let list = String::from_utf8(lab.topic("robot", &["list"]).stdout).unwrap();
    let line = list.lines().find(|line| line.starts_with("/chatter")).unwrap_or_else(|| panic!("{list}"));
    assert!(line.contains("std_msgs/msg/String") && line.contains("shared: 1 nodes have it"), "{list}");
    let info = String::from_utf8(lab.topic("desk", &["info", "-v", "/chatter"]).stdout).unwrap();
    assert!(info.contains("Reliability: RELIABLE") && info.contains("Shared by robot"), "{info}");

    // The router knows its name alone.
    let name = info.lines().find_map(|line| line.trim().strip_prefix("Name: ")).unwrap();
    lab.finds("cloud", &["--name", name], "");
    lab.finds("cloud", &["--name", &"0".repeat(64)], "nobody in reach advertises it");
    lab.finds("cloud", &["/chatter"], "touches no ROS 2 network");

    listener.end();
    lab.finds("desk", &["/chatter"], "nobody on this local network subscribes to /chatter");
    // Asks for history, which nobody keeps.
    let mut strict = lab.peer("desk", "sub", &["--type", "string", "--transient-local"]);
    lab.finds("desk", &["/chatter"], "by durability: VOLATILE is offered");
    strict.end();
    talker.end();
    lab.finds("robot", &["/chatter"], "no publisher of /chatter");
}
