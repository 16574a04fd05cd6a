//! Direct and relayed paths as users see them: `sgc ping`, `sgc why`, `sgc status` and `sgc fleet status`.

use serde_json::{Value, json};

use crate::lab::{Lab, Nat, RANGES};
use crate::node::Node;
use crate::support::{self, eventually};
use crate::{Pair, cable, can_run, shared_turn};

const ROBOT: &str = "robot-quic";
const DESK: &str = "desk-quic";

/// A robot and a desk that exchange data, and their router.
struct Shown {
    lab: Lab,
    cloud: Node,
    _pair: Pair,
}

impl Shown {
    fn start(nat: Nat) -> Self {
        let lab = Lab::new(cable(), nat);
        let cloud = Node::start(&lab.cloud, &lab.router_config(), lab.enroll("cloud", true), None);
        let pair = Pair::start(&lab, "quic", &[&lab.url("quic")]);
        pair.wait_for("never begins", |_| 1);
        Self { lab, cloud, _pair: pair }
    }

    /// Runs a command that asks a node. Returns what it prints.
    fn said(&self, node: &str, args: &[&str]) -> String {
        let mut command = support::sgc(None, self.lab.dir());
        let output = command.args(args).args(["--socket", &format!("{node}.sock")]).output().unwrap();
        assert!(output.stderr.is_empty(), "{args:?}: {output:?}");
        String::from_utf8(output.stdout).unwrap()
    }

    fn ping(&self) -> Value {
        let said = self.said(DESK, &["ping", ROBOT, "--count", "1", "--json"]);
        serde_json::from_str(&said).unwrap_or_else(|_| panic!("{said}"))
    }

    /// Returns what a node reports to the desk.
    fn report(&self, node: &str) -> Value {
        let said = self.said(DESK, &["fleet", "status", node, "--json"]);
        let fleet: Value = serde_json::from_str(&said).unwrap_or_else(|_| panic!("{said}"));
        fleet["nodes"][0]["report"].clone()
    }
}

#[test]
fn direct_path_is_shown_with_its_round_trip_and_that_over_the_router() {
    if !can_run() {
        return;
    }
    let _turn = shared_turn();
    let mut shown = Shown::start(Nat::PortRestricted);
    eventually("the question goes directly", || shown.ping()["path"]["direct"] == true);
    let answer = shown.ping();
    assert!(answer["direct_us"].is_u64() && answer["relayed_us"].is_u64(), "{answer}");
    assert_eq!((&answer["answered_us"], &answer["not_direct"]), (&answer["direct_us"], &json!(null)));
    let said = shown.said(DESK, &["ping", ROBOT, "--count", "2"]);
    let lines: Vec<_> = said.lines().collect();
    assert!(
        lines[0].contains(", directly (") && lines[0].contains(", relayed by quic://10.10.0.1"),
        "{said}"
    );
    assert!(lines[3].starts_with("  directly: ") && lines[4].starts_with("  relayed: "), "{said}");

    eventually("the topic goes directly", || {
        shown
            .said(DESK, &["why", "/state"])
            .contains("✓ directly: no router stands between this node and robot")
    });
    eventually("it leaves directly", || {
        shown.said(ROBOT, &["why", "/state"]).contains("✓ directly to desk-quic: no router stands in between")
    });
    let status = shown.said(DESK, &["status"]);
    let row = status.lines().find(|line| line.starts_with("  robot-quic ")).unwrap_or_default();
    assert!(row.trim_end().ends_with("direct") && !status.contains("Over routers"), "{status}");
    let report = shown.report(ROBOT);
    let links = report["links"].as_array().unwrap();
    let direct: Vec<_> =
        links.iter().filter(|link| link["direct"] == true).map(|link| &link["name"]).collect();
    assert_eq!((direct, &report["not_direct"]), (vec![&json!(DESK)], &json!([])));

    shown.cloud.stop();
    let answer = shown.ping();
    assert!(answer["direct_us"].is_u64() && answer["relayed_us"].is_null(), "{answer}");
}

#[test]
fn relayed_path_is_shown_with_the_reason_and_the_remedy() {
    if !can_run() {
        return;
    }
    let _turn = shared_turn();
    let shown = Shown::start(Nat::RandomPort(RANGES[0]));
    eventually("it is given up", || shown.ping()["not_direct"]["reason"] == "blocked");
    let answer = shown.ping();
    assert_eq!((&answer["relayed_us"], &answer["direct_us"]), (&answer["answered_us"], &json!(null)));
    let why = "no packet passes between the two networks";
    let said = shown.said(DESK, &["ping", ROBOT, "--count", "2"]);
    assert_eq!(said.matches(why).count(), 1, "{said}");
    let remedy = "run `sgc netcheck` at both nodes";
    let said = shown.said(DESK, &["why", "/state"]);
    let words = format!("✓ over a router, since there is no direct link to robot-quic: {why}");
    assert!(said.contains(&words) && said.contains(remedy), "{said}");
    let status = shown.said(DESK, &["status"]);
    assert!(status.contains("Over routers:") && status.contains(why) && status.contains(remedy), "{status}");
    assert_eq!(shown.report(DESK)["not_direct"][0]["reason"], "blocked");
    // The robot uses nothing of the desk, so it knows the reason only while the desk tries.
    let said = shown.said(ROBOT, &["why", "/state"]);
    assert!(said.contains("✓ over a router, since there is no direct link to desk-quic: "), "{said}");
    assert!(shown.said(ROBOT, &["status"]).contains("Over routers:"));
    let not_direct = shown.report(ROBOT)["not_direct"].take();
    assert_eq!(not_direct[0]["name"], DESK, "{not_direct}");
    assert!(["blocked", "not_wanted", "first"].map(Value::from).contains(&not_direct[0]["reason"]));
}
