//! How `sgc` finds and reaches programs of its own host, and says where it cannot.

use std::time::{Duration, Instant};

use serde_json::Value;

use crate::lab::{Lab, Site, robot_to_desk, share, uses};
use crate::support::{PATIENCE, Peer, eventually};
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
fn packets_that_cannot_be_sent_are_said() {
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

/// Bound on the time from the end of a change to the next message.
const RESUMED: Duration = Duration::from_secs(2);

/// Environments of programs: as ROS 2 ships, and two ways to keep to one's host.
const RANGES: [(&str, &[(&str, &str)]); 3] = [
    ("subnet", &[]),
    ("localhost", &[("ROS_AUTOMATIC_DISCOVERY_RANGE", "LOCALHOST")]),
    ("localhost_only", &[("ROS_LOCALHOST_ONLY", "1")]),
];

/// A publisher and a subscriber at the robot, and their counterparts at the desk.
struct Flow {
    name: String,
    listeners: [Peer; 2],
    _talkers: [Peer; 2],
}

impl Flow {
    /// Starts both directions; the robot's programs have this environment.
    fn start(lab: &Lab, [robot, desk]: [&str; 2], range: (&str, &[(&str, &str)])) -> Self {
        let topics = ["up", "down"].map(|way| format!("/{way}_{}", range.0));
        let talk =
            |topic| ["pub", "--topic", topic, "--count", "0", "--rate", "20", "--timeout", PLAN.peer_life];
        let listen = |topic| ["sub", "--topic", topic, "--verbose", "--timeout", PLAN.peer_life];
        Self {
            name: format!("{robot} as {} at the robot, {desk} at the desk", range.0),
            listeners: [
                lab.load(Site::Desk, desk, &listen(&topics[0])),
                lab.load_within(Site::Robot, robot, range.1, &listen(&topics[1])),
            ],
            _talkers: [
                lab.load_within(Site::Robot, robot, range.1, &talk(&topics[0])),
                lab.load(Site::Desk, desk, &talk(&topics[1])),
            ],
        }
    }

    /// Asserts that both directions carry a message that arrives after `since`, in time.
    fn assert_goes_on(&mut self, since: Instant, bound: Duration, when: &str) {
        for (listener, way) in self.listeners.iter_mut().zip(["from", "to"]) {
            let deadline = since + bound;
            let in_time = since..=deadline;
            let is_message =
                |(at, event): (Instant, Value)| event["event"] == "received" && in_time.contains(&at);
            let heard = std::iter::from_fn(|| {
                listener.events.recv_timeout(deadline.saturating_duration_since(Instant::now())).ok()
            })
            .any(is_message);
            assert!(heard, "{way} {}: nothing within {bound:?}, {when}", self.name);
        }
    }
}

#[test]
fn topics_of_programs_of_a_host_survive_its_addresses() {
    for pair in PAIRS {
        let topics = |way: &str| RANGES.map(|(range, _)| format!("/{way}_{range}"));
        let [mut robot, mut desk] = robot_to_desk("topic", topics("up"));
        for topic in topics("down") {
            robot += &uses("topic", &topic, "desk");
            desk += &share("topic", &topic, "robot");
        }
        let lab = Lab::real(PLAN, [robot, desk]);
        let mut flows = RANGES.map(|range| Flow::start(&lab, pair, range));
        let mut assert_all = |bound, when: &str| {
            let since = Instant::now();
            flows.iter_mut().for_each(|flow| flow.assert_goes_on(since, bound, when));
        };
        assert_all(PATIENCE, "at first");
        let Some(robot) = lab.namespace(Site::Robot) else { continue };
        let ip = |args: &str| robot.ip(&args.split_whitespace().collect::<Vec<_>>()).unwrap();
        ip("addr del 10.92.1.2/24 dev cloud");
        ip("addr add 10.92.1.3/24 dev cloud");
        assert_all(RESUMED, "with another address");
        ip("link set cloud down");
        ip("link set cloud up");
        assert_all(RESUMED, "after the interface was down");
    }
}
