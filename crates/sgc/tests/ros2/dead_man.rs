//! The dead-man switch beside a robot: an operator's rclpy program drives a robot's over a router.

use std::thread;
use std::time::Duration;

use rustix::process::Signal;
use serde_json::Value;

use crate::lab::{Lab, Site, share, uses};
use crate::support::{Peer, eventually};
use crate::{EXCLUSIVE, PAIRS, PLAN};

const TOPIC: &str = "/cmd_vel";
/// More than `after` of the configuration.
const LET_GO: Duration = Duration::from_millis(1500);
/// Wait for a command that passes at once if it passes.
const HEARD_MAX: Duration = Duration::from_secs(5);
const TRIES_MAX: usize = 10;

/// Returns a lab whose desk shares commands with the robot, and whose robot uses them with these settings.
fn lab(switch: &str) -> Lab {
    let used = uses("topic", TOPIC, "desk") + &format!("deadman = {{ after = \"600ms\", {switch} }}\n");
    Lab::real(EXCLUSIVE, [used, share("topic", TOPIC, "robot")])
}

fn start(lab: &Lab, [at_robot, at_desk]: [&str; 2]) -> (Peer, Peer) {
    let drive = |site, distribution, role: &str| {
        let args = [role, "--topic", TOPIC, "--timeout", PLAN.peer_life];
        let mut peer = lab.rclpy(site, distribution, "drive.py", &args);
        peer.wait("an endpoint", |event| event["event"] == "ready");
        peer
    };
    (drive(Site::Robot, at_robot, "robot"), drive(Site::Desk, at_desk, "operator"))
}

/// Waits until the robot hears this speed. It must hear no other before.
fn next_speed(robot: &mut Peer, speed: f64) {
    let heard = robot.wait("a command", |event| event["event"] == "speed");
    assert_eq!(heard["speed"], speed, "{heard}");
}

/// Lets go, and holds anew, until the robot hears this speed. On a busy machine the switch may miss that somebody let go.
fn hold(operator: &mut Peer, robot: &mut Peer, speed: f64) {
    for _ in 0..TRIES_MAX {
        operator.tell("release");
        thread::sleep(LET_GO);
        operator.tell(&format!("hold {speed}"));
        if let Ok((_, heard)) = robot.events.recv_timeout(HEARD_MAX) {
            return assert_eq!(heard["speed"], speed, "{heard}");
        }
    }
    panic!("the robot does not move");
}

fn switch_of(lab: &Lab) -> Value {
    let mut command =
        lab.sgc(Some(Site::Robot), &["topic", "info", "--json", TOPIC, "--socket", "robot.sock"]);
    let output = command.output().unwrap();
    let info: Value = serde_json::from_slice(&output.stdout).unwrap_or_default();
    info["uses"][0]["route"]["dead_man"].clone()
}

#[test]
fn a_robot_stops_when_its_operator_is_gone_and_moves_when_somebody_let_go_and_began_again() {
    for pair in PAIRS {
        let lab = lab("publish = \"zero\"");
        let (mut robot, mut operator) = start(&lab, pair);
        // The stop message of the beginning is known to be published before somebody drives, and may come before the robot's
        // program joins.
        eventually("the first stop message", || switch_of(&lab)["stops"].as_u64() > Some(0));
        while robot.events.recv_timeout(LET_GO).is_ok() {}
        hold(&mut operator, &mut robot, 1.0);

        // The operator lets go.
        operator.tell("release");
        next_speed(&mut robot, 0.0);
        hold(&mut operator, &mut robot, 2.0);

        // The way stands still, and the operator does not let go.
        let router = lab.node(Site::Cloud);
        router.signal(Signal::STOP);
        next_speed(&mut robot, 0.0);
        router.signal(Signal::CONT);
        eventually("commands come again, and do not pass", || {
            let switch = switch_of(&lab);
            !switch["stopped"].is_null() && switch["not_resumed"].as_u64() > Some(10)
        });
        let why = lab.why(Site::Robot, TOPIC);
        assert!(why.contains("has not let go since") && why.contains("let go of the control"), "{why}");
        hold(&mut operator, &mut robot, 3.0);

        // The operator's program hangs. When it goes on, its silence counts as a pause.
        operator.signal(Signal::STOP);
        next_speed(&mut robot, 0.0);
        operator.signal(Signal::CONT);
        next_speed(&mut robot, 3.0);

        // Its node is killed.
        lab.node(Site::Desk).signal(Signal::KILL);
        next_speed(&mut robot, 0.0);
        assert!(
            lab.log(Site::Robot).contains("a dead-man switch stops the robot"),
            "{}",
            lab.log(Site::Robot)
        );
    }
}

#[test]
fn a_switch_without_automatic_end_waits_for_somebody_at_the_robot() {
    let lab = lab("publish = \"zero\", repeat = \"100ms\", resume = \"manual\"");
    let (mut robot, mut operator) = start(&lab, PAIRS[0]);
    operator.tell("hold 1");
    // The stop message is repeated until then.
    next_speed(&mut robot, 0.0);
    eventually("its commands come", || switch_of(&lab)["not_resumed"].as_u64() > Some(10));
    assert!(lab.asked(Site::Robot, &["topic", "resume", TOPIC]).contains("passes"));
    next_speed(&mut robot, 1.0);
    operator.tell("release");
    next_speed(&mut robot, 0.0);
    let why = lab.why(Site::Robot, TOPIC);
    assert!(why.contains("sgc topic resume /cmd_vel"), "{why}");
    let stops = switch_of(&lab)["stops"].as_u64();
    eventually("the stop message is repeated", || switch_of(&lab)["stops"].as_u64() > stops);
}
