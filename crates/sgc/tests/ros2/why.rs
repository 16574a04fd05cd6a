//! `sgc why` on networks of rclpy: nodes with topics, services, actions and parameters, all shared by patterns.

use serde_json::Value;

use crate::lab::{Lab, Site};
use crate::support::{Peer, eventually, say};
use crate::{PAIRS, PLAN};

/// The robot shares all that it has, and the desk takes all of it: by a pattern for topics, one for services, and the
/// name of an action, of which patterns cover no part.
pub(crate) fn everything() -> [String; 2] {
    let rules = |table: &str, whom: &str| {
        [("topic", "/**"), ("service", "/**"), ("action", "/robot/fibonacci")]
            .map(|(kind, name)| format!("[[{table}]]\n{whom}\n{kind} = \"{name}\"\n"))
            .concat()
    };
    [rules("share", "to = [\"desk\"]"), rules("use", "from = \"robot\"")]
}

/// The exit code of `sgc why`, and the step that is wrong.
fn why(lab: &Lab, site: Site, what: &str) -> (Option<i32>, String) {
    let socket = format!("{}.sock", site.name());
    let output = lab.sgc(None, &["why", "--json", "--socket", &socket, what]).output().unwrap();
    let steps: Value = serde_json::from_slice(&output.stdout).unwrap_or_default();
    let wrong = steps.as_array().into_iter().flatten().find(|step| step["verdict"] == "wrong");
    let found = wrong.and_then(|step| step["found"].as_str()).unwrap_or_default();
    (output.status.code(), found.to_owned())
}

/// Waits until `sgc why` ends like this, with this among what is wrong.
pub(crate) fn wait(lab: &Lab, site: Site, what: &str, code: i32, found: &str) {
    let mut asked = 0;
    eventually(&format!("{what} at the {} comes to {code}", site.name()), || {
        let last = why(lab, site, what);
        asked += 1;
        if asked % 200 == 0 {
            say(&format!("{} says of {what}: {last:?}", site.name()));
        }
        last.0 == Some(code) && last.1.contains(found)
    });
}

pub(crate) fn node(lab: &Lab, site: Site, distribution: &str, role: &str) -> Peer {
    let mut command = lab.ros(site, distribution, "mixed.py");
    command.args([role, "--timeout", PLAN.peer_life]);
    Peer::start(command)
}

#[test]
fn healthy_interfaces_under_patterns_have_no_fault() {
    let lab = Lab::real(PLAN, everything());
    for [there, here] in PAIRS {
        let mut robot = node(&lab, Site::Robot, there, "robot");
        let mut desk = node(&lab, Site::Desk, here, "desk");
        desk.wait("a message", |event| event["event"] == "received");
        for site in [Site::Robot, Site::Desk] {
            for what in ["/robot/chatter", "/robot/status", "/robot/fibonacci", "/robot/talker"] {
                wait(&lab, site, what, 0, "");
            }
        }
        // Each node publishes on it, and patterns leave it out.
        wait(&lab, Site::Robot, "/rosout", 1, "but no rule names it");
        robot.end();
        wait(&lab, Site::Robot, "/robot/chatter", 1, "/robot/chatter");
        wait(&lab, Site::Desk, "/robot/chatter", 1, "robot is in reach and does not share /robot/chatter");
        desk.end();
    }
}
