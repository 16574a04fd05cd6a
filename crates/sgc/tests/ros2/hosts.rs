//! Programs that `sgc` cannot find or reach on its own host: both are said.

use crate::lab::{Lab, Site, robot_to_desk};
use crate::support::eventually;
use crate::{PAIRS, PLAN};

const SERVER: &str = "ROS_DISCOVERY_SERVER=127.0.0.1:11811";

#[test]
fn a_discovery_server_of_programs_is_named() {
    let lab = Lab::real(PLAN, robot_to_desk("topic", ["/load"]));
    let before = lab.why(Site::Robot, "/load");
    assert!(!before.contains("ROS_DISCOVERY_SERVER"), "{before}");
    let variable = SERVER.split_once('=').unwrap();
    let arguments = ["pub", "--topic", "/load", "--timeout", PLAN.peer_life];
    let _talker = lab.load_within(Site::Robot, PAIRS[0][0], &[variable], &arguments);
    // Before it runs, the process is not the program's own.
    eventually("sgc why names the server", || lab.why(Site::Robot, "/load").contains(SERVER));
    eventually("the log names the server", || lab.log(Site::Robot).contains(SERVER));
    if lab.namespace(Site::Robot).is_some() {
        let elsewhere = lab.why(Site::Desk, "/load");
        assert!(!elsewhere.contains("ROS_DISCOVERY_SERVER"), "{elsewhere}");
    }
    let mut check = lab.sgc(None, &["check", "-c", "robot.toml"]);
    let checked = check.env(variable.0, variable.1).output().unwrap();
    let checked = String::from_utf8(checked.stdout).unwrap();
    assert!(checked.contains(&format!("{SERVER} is set")), "{checked}");
}

#[test]
fn packets_that_cannot_be_sent_to_local_programs_are_said() {
    let [jazzy, kilted] = PAIRS[0];
    let lab = Lab::real(PLAN, robot_to_desk("topic", ["/load"]));
    let Some(robot) = lab.namespace(Site::Robot) else { return };
    let ip = |args: &str| robot.ip(&args.split_whitespace().collect::<Vec<_>>()).unwrap();
    let talk = ["pub", "--topic", "/load", "--count", "0", "--rate", "20", "--timeout", PLAN.peer_life];
    let _talker = lab.load(Site::Robot, jazzy, &talk);
    let listen = ["sub", "--topic", "/load", "--verbose", "--timeout", PLAN.peer_life];
    let mut listener = lab.load(Site::Desk, kilted, &listen);
    listener.wait("a message", |event| event["event"] == "received");
    let before = lab.why(Site::Robot, "/load");
    assert!(!before.contains("cannot be sent"), "{before}");
    ip("addr del 10.92.1.2/24 dev cloud");
    eventually("sgc why says so", || lab.why(Site::Robot, "/load").contains("cannot be sent"));
    let lines = lab.log(Site::Robot).lines().filter(|line| line.contains("ddsi_")).count();
    assert_eq!(lines, 0, "lines of Cyclone's own");
}
