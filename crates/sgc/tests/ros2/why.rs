//! `sgc why` on networks of rclpy: nodes with topics, services, actions and parameters, all shared by patterns.

use std::fs;

use serde_json::Value;

use crate::lab::{Lab, Site, robot_to_desk};
use crate::support::{Peer, eventually, say};
use crate::{PAIRS, PLAN};

/// The robot shares all that it has, and the desk takes all of it: by a pattern for topics, one for services, and the name of an
/// action, of which patterns cover no part.
fn everything() -> [String; 2] {
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
fn wait(lab: &Lab, site: Site, what: &str, code: i32, found: &str) {
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

fn node(lab: &Lab, site: Site, distribution: &str, role: &str) -> Peer {
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

/// A partner's node that begins without any rule, and without a local network, gets a topic by a token whose type nobody wrote down.
#[test]
fn token_takes_its_type_from_the_robot_and_the_partner_needs_no_restart() {
    let mut lab = Lab::silent(PLAN, robot_to_desk("topic", ["/robot/chatter"]));
    if lab.namespace(Site::Desk).is_none() {
        return say("two domains of one host are no two default networks: nothing is shown");
    }
    let sgc = |args: &[&str]| {
        let output = lab.sgc(None, args).output().unwrap();
        assert!(output.status.success(), "{args:?}: {output:?}");
        String::from_utf8(output.stdout).unwrap()
    };
    sgc(&["fleet", "create", "acme"]);
    sgc(&["fleet", "enroll", "cart", "--fleet", "acme.fleet"]);
    fs::write(lab.dir().join("acme.pem"), sgc(&["fleet", "ca", "--fleet", "acme.fleet"])).unwrap();
    let cart = "identity = \"cart.identity\"\nnode.routers = [\"quic://127.0.0.1:9\"]\nnode.state = \"cart.state\"\nadmin.socket = \"desk.sock\"\n";
    fs::write(lab.dir().join("desk.toml"), cart).unwrap();
    lab.reconfigure(Site::Robot, "discovery_range = \"localhost\"", "discovery_range = \"subnet\"");
    lab.reconfigure(Site::Robot, "[node]\n", "[node]\nstate = \"robot.state\"\n");
    lab.configure(Site::Cloud, "[node]\ntrust = [\"acme.pem\"]\n");
    lab.start_all();
    let _robot = node(&lab, Site::Robot, "jazzy", "robot");
    let mut desk = node(&lab, Site::Desk, "kilted", "desk");
    let router = format!("quic://{}", lab.cloud_address(Site::Desk));
    let give = [
        "share-token",
        "-c",
        "robot.toml",
        "--topic",
        "/robot/chatter",
        "--to",
        "acme.pem",
        "--router",
        &router,
    ];
    let mut token = Vec::new();
    eventually("the robot knows the type", || {
        let output = lab.sgc(None, &give).output().unwrap();
        token = output.stdout;
        output.status.success()
    });
    fs::write(lab.dir().join("chatter.token"), token).unwrap();
    let output = lab.sgc(None, &["use", "chatter.token", "-c", "desk.toml"]).output().unwrap();
    let said = String::from_utf8_lossy(&output.stdout);
    assert!(said.contains("[std_msgs/msg/String] of robot") && !said.contains("restart"), "{output:?}");
    desk.wait("a message", |event| event["event"] == "received");
}
