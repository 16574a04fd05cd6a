//! Tests of `sgc demo` from the outside: its output, its result, and that it leaves nothing behind however it ends.

#![allow(clippy::unwrap_used)]

use std::collections::BTreeSet;
use std::fs;
use std::os::unix::fs::PermissionsExt;
use std::process::{Child, Command, Output, Stdio};
use std::thread;
use std::time::{Duration, Instant};

use rustix::process::{Pid, Signal, kill_process};
use serde_json::Value;
use tempfile::TempDir;

/// Longest wait for an event, far beyond what any takes.
const PATIENCE: Duration = Duration::from_secs(90);
/// Number of children: a router, two nodes and two peers.
const CHILDREN: usize = 5;

/// A demo whose temporary files go to a directory of the test.
struct Demo {
    child: Child,
    tmp: TempDir,
}

impl Demo {
    fn start(args: &[&str]) -> Self {
        let tmp = tempfile::tempdir().unwrap();
        let child = Command::new(env!("CARGO_BIN_EXE_sgc"))
            .arg("demo")
            .args(args)
            .env("TMPDIR", tmp.path())
            // Variables of the user must not affect the demo.
            .env("ROS_DOMAIN_ID", "3")
            .env("ROS_STATIC_PEERS", "192.0.2.1")
            .stdin(Stdio::null())
            .stdout(Stdio::piped())
            .stderr(Stdio::piped())
            .spawn()
            .unwrap();
        Self { child, tmp }
    }

    /// Returns the demo's children once all of them exist.
    fn children(&mut self) -> BTreeSet<Process> {
        let parent = self.child.id();
        let mut children = BTreeSet::new();
        eventually("all children are there", || {
            assert_eq!(self.child.try_wait().unwrap(), None, "the demo is over");
            children = children_of(parent);
            children.len() == CHILDREN
        });
        children
    }

    fn signal(&self, signal: Signal) {
        kill_process(Pid::from_child(&self.child), signal).unwrap();
    }

    fn output(self) -> (Output, TempDir) {
        (self.child.wait_with_output().unwrap(), self.tmp)
    }
}

/// A process. Its start time distinguishes it from a later process with the same number.
#[derive(Clone, Debug, PartialEq, Eq, PartialOrd, Ord)]
struct Process {
    pid: u32,
    started: String,
}

/// Returns a process and its parent if it is alive. A zombie is not.
fn process(pid: u32) -> Option<(u32, Process)> {
    let stat = fs::read_to_string(format!("/proc/{pid}/stat")).ok()?;
    // The program's name is in parentheses and may hold anything.
    let fields: Vec<&str> = stat.rsplit_once(')')?.1.split_whitespace().collect();
    let is_alive = !matches!(*fields.first()?, "Z" | "X");
    let parent = fields.get(1)?.parse().ok()?;
    let started = (*fields.get(19)?).to_owned();
    is_alive.then_some((parent, Process { pid, started }))
}

fn children_of(parent: u32) -> BTreeSet<Process> {
    let pids = fs::read_dir("/proc").unwrap().filter_map(|e| e.ok()?.file_name().to_str()?.parse().ok());
    pids.filter_map(process).filter(|(p, _)| *p == parent).map(|(_, process)| process).collect()
}

fn all_gone(children: &BTreeSet<Process>) {
    eventually("all children are gone", || {
        children.iter().all(|child| process(child.pid).is_none_or(|(_, now)| now != *child))
    });
}

fn eventually(what: &str, mut done: impl FnMut() -> bool) {
    let deadline = Instant::now() + PATIENCE;
    while !done() {
        assert!(Instant::now() < deadline, "waited in vain: {what}");
        thread::sleep(Duration::from_millis(10));
    }
}

fn is_empty(dir: &TempDir) -> bool {
    fs::read_dir(dir.path()).unwrap().next().is_none()
}

fn stderr(output: &Output) -> String {
    String::from_utf8_lossy(&output.stderr).into_owned()
}

/// Checks the document, except for its verdict, against the manual.
fn check_report(report: &Value, seconds_min: f64) {
    let keys = |value: &Value| value.as_object().unwrap().keys().cloned().collect::<BTreeSet<_>>();
    let set = |keys: &[&str]| keys.iter().map(|k| (*k).to_owned()).collect::<BTreeSet<_>>();
    assert_eq!(keys(report), set(&["seconds", "topics", "ok"]), "{report}");
    assert!(report["seconds"].as_f64().unwrap() >= seconds_min);
    let expected = [
        ("/chatter", "std_msgs/msg/String", 10.0),
        ("/camera/image", "sensor_msgs/msg/Image", 10.0),
        ("/cmd_vel", "geometry_msgs/msg/Twist", 50.0),
    ];
    let topics = report["topics"].as_array().unwrap();
    assert_eq!(topics.len(), expected.len());
    let mut names = BTreeSet::new();
    for (topic, (ros_name, type_name, rate)) in topics.iter().zip(expected) {
        let fields =
            ["topic", "type", "name", "sent", "received", "lost", "duplicated", "corrupt", "latency_us"];
        assert_eq!(keys(topic), set(&fields));
        assert_eq!((&topic["topic"], &topic["type"]), (&ros_name.into(), &type_name.into()));
        let name = topic["name"].as_str().unwrap();
        assert!(name.len() == 64 && name.bytes().all(|b| b.is_ascii_hexdigit()), "{name}");
        names.insert(name.to_owned());
        for count in ["sent", "received", "lost", "duplicated", "corrupt"] {
            assert!(topic[count].is_u64(), "{count}: {topic}");
        }
        let sent = topic["sent"].as_u64().unwrap() as f64;
        // A slow machine sends fewer messages, and none sends more.
        let most = rate * report["seconds"].as_f64().unwrap() + 2.0;
        assert!((most * 0.2..=most).contains(&sent), "{topic}");
        assert_eq!(keys(&topic["latency_us"]), set(&["p50", "p99"]));
        let (p50, p99) = (&topic["latency_us"]["p50"], &topic["latency_us"]["p99"]);
        assert!(0 < p50.as_u64().unwrap() && p50.as_u64() <= p99.as_u64(), "{topic}");
    }
    assert_eq!(names.len(), expected.len());
}

#[test]
fn everything_arrives_once_and_unaltered() {
    let mut demo = Demo::start(&["--duration", "3s", "--json"]);
    let children = demo.children();
    let (output, tmp) = demo.output();
    assert!(output.status.success(), "{}\n{}", String::from_utf8_lossy(&output.stdout), stderr(&output));
    // Standard output is one document.
    let report: Value = serde_json::from_slice(&output.stdout).unwrap();
    check_report(&report, 3.0);
    assert_eq!(report["ok"], true);
    for topic in report["topics"].as_array().unwrap() {
        assert_eq!(topic["received"], topic["sent"]);
        for none in ["lost", "duplicated", "corrupt"] {
            assert_eq!(topic[none], 0);
        }
    }
    assert_eq!(stderr(&output), "");
    // The demo has waited for its children, so they are gone already.
    assert!(children.iter().all(|child| process(child.pid).is_none_or(|(_, now)| now != *child)));
    assert!(is_empty(&tmp), "files are left over");
}

#[test]
fn a_person_is_told_how_to_join_and_what_came_of_it() {
    let (output, _) = Demo::start(&["--duration", "3s"]).output();
    let text = String::from_utf8(output.stdout.clone()).unwrap();
    assert!(output.status.success(), "{text}\n{}", stderr(&output));
    assert!(text.contains(" ROS_AUTOMATIC_DISCOVERY_RANGE=LOCALHOST ros2 topic echo /chatter\n"), "{text}");
    assert!(text.contains(" ROS_LOCALHOST_ONLY=1 ros2 topic echo /chatter "), "{text}");
    assert!(text.contains("after 2 s\n"), "it shows how it goes:\n{text}");
    assert!(text.contains(" arrived, once each and unaltered."), "{text}");
    assert!(!text.contains('\x1b'), "control sequences are for terminals");
}

#[test]
fn killing_it_leaves_no_process() {
    let mut demo = Demo::start(&["--duration", "600s", "--json"]);
    let children = demo.children();
    demo.signal(Signal::KILL);
    demo.child.wait().unwrap();
    all_gone(&children);
}

#[test]
fn an_interrupt_ends_it_in_good_order() {
    for signal in [Signal::INT, Signal::TERM] {
        let mut demo = Demo::start(&["--duration", "600s", "--json"]);
        let children = demo.children();
        // Once the secrets are removed, all nodes are up. The count may or may not have begun.
        eventually("the secrets are gone", || {
            let identities = || fs::read_dir(demo.tmp.path()).unwrap().flatten().map(|e| e.path());
            identities().count() == 1
                && identities()
                    .all(|dir| dir.join("robot.toml").exists() && !dir.join("robot.identity").exists())
        });
        demo.signal(signal);
        let (output, tmp) = demo.output();
        let report: Value = serde_json::from_slice(&output.stdout).unwrap();
        assert!(report["ok"].is_boolean(), "{report}");
        let is_success = report["ok"] == true;
        assert_eq!(output.status.code(), Some(i32::from(!is_success)), "{report}\n{}", stderr(&output));
        all_gone(&children);
        assert!(is_empty(&tmp), "files are left over");
    }
}

#[test]
fn the_death_of_a_process_is_told_and_ends_it() {
    let mut demo = Demo::start(&["--duration", "600s", "--json"]);
    let children = demo.children();
    let victim = children.first().unwrap();
    let pid = Pid::from_raw(victim.pid.try_into().unwrap()).unwrap();
    kill_process(pid, Signal::KILL).unwrap();
    let (output, _) = demo.output();
    assert_eq!(output.status.code(), Some(1));
    let said = stderr(&output);
    assert!(said.starts_with("sgc: demo: ") && said.contains("ended too early: signal: 9"), "{said}");
    let report: Value = serde_json::from_slice(&output.stdout).unwrap();
    assert_eq!(report["ok"], false);
    assert!(said.contains(report["error"].as_str().unwrap()));
    all_gone(&children);
}

#[test]
fn two_demos_at_once_do_not_meet() {
    let demos = [Demo::start(&["--duration", "3s", "--json"]), Demo::start(&["--duration", "3s", "--json"])];
    for demo in demos {
        let (output, _) = demo.output();
        let report: Value = serde_json::from_slice(&output.stdout).unwrap();
        assert_eq!(report["ok"], true, "{report}\n{}", stderr(&output));
    }
}

#[test]
fn kept_files_can_be_run_again() {
    let place = tempfile::tempdir().unwrap();
    let dir = place.path().join("kept");
    let name = dir.to_str().unwrap();
    let (output, _) = Demo::start(&["--duration", "1s", "--json", "--keep", name]).output();
    assert!(output.status.success(), "{}", stderr(&output));
    let mut kept: Vec<_> =
        fs::read_dir(&dir).unwrap().map(|e| e.unwrap().file_name().into_string().unwrap()).collect();
    kept.sort();
    let expected = [
        "cloud.identity",
        "cloud.log",
        "cloud.sock.lock",
        "cloud.state",
        "cloud.toml",
        "demo.fleet",
        "operator-peer.log",
        "operator.identity",
        "operator.log",
        "operator.sock.lock",
        "operator.state",
        "operator.toml",
        "robot-peer.log",
        "robot.identity",
        "robot.log",
        "robot.sock.lock",
        "robot.state",
        "robot.toml",
    ];
    assert_eq!(kept, expected);
    for file in ["cloud.identity", "robot.identity", "operator.identity", "demo.fleet"] {
        assert_eq!(fs::metadata(dir.join(file)).unwrap().permissions().mode() & 0o777, 0o600);
    }
    let log = fs::read_to_string(dir.join("robot.log")).unwrap();
    assert!(!log.contains("ERROR") && !log.contains("panicked"), "{log}");
    for node in ["cloud", "robot", "operator"] {
        let config = dir.join(format!("{node}.toml"));
        let mut check = Command::new(env!("CARGO_BIN_EXE_sgc"));
        assert!(check.arg("check").arg("-c").arg(config).output().unwrap().status.success());
    }

    // Existing files are not overwritten.
    let (output, _) = Demo::start(&["--duration", "1s", "--keep", name]).output();
    assert_eq!(output.status.code(), Some(2));
    assert_eq!(
        stderr(&output),
        format!("sgc: {name} exists already and is not empty; name another directory for --keep\n")
    );
}
