//! Faults that users of other bridges suffer from, with programs of ROS 2: each scenario is that of a public report.

use std::collections::BTreeSet;

use rustix::process::Signal;

use crate::lab::{Lab, Site, robot_to_desk};
use crate::support::Peer;
use crate::{PAIRS, PLAN, count};

/// Starts a Python program of `tests/peers/ros2`.
fn start(lab: &Lab, site: Site, distribution: &str, program: &str, args: &[&str]) -> Peer {
    let mut command = lab.ros(site, distribution, program);
    command.args(args);
    Peer::start(command)
}

/// eclipse-zenoh/zenoh-plugin-ros2dds #700 and #570: after each restart of a publisher, or of a bridge, every message comes once more often.
#[test]
fn subscriber_hears_each_message_once_however_often_publisher_and_nodes_restart() {
    /// Each publisher's numbers begin at its run times this.
    const RUN_NUMBERS: u64 = 100_000;
    let mut lab = Lab::real(PLAN, robot_to_desk("topic", ["/restarts"]));
    for [talks, listens] in PAIRS {
        let topic = ["--topic", "/restarts"];
        let mut listener = start(&lab, Site::Desk, listens, "events.py", &[&["sub"], &topic[..]].concat());
        let mut heard = Vec::new();
        for (run, restarted) in (0..).zip([None, Some(Site::Robot), None, Some(Site::Desk)]) {
            if let Some(site) = restarted {
                lab.kill(site);
                lab.start(site);
            }
            let first = run * RUN_NUMBERS;
            let start_at = first.to_string();
            let args = [&["pub", "--rate", "20", "--start", &start_at], &topic[..]].concat();
            let talker = start(&lab, Site::Robot, talks, "events.py", &args);
            let mut of_run = 0;
            while of_run < 20 {
                let event = listener.wait("a message", |e| e["event"] == "received");
                heard.push(count(&event, "seq"));
                of_run += u64::from(heard.last() >= Some(&first));
            }
            talker.signal(Signal::KILL);
        }
        let follows = |pair: &[u64]| pair[1] == pair[0] + 1 || pair[1] / RUN_NUMBERS > pair[0] / RUN_NUMBERS;
        assert!(heard.windows(2).all(follows), "{talks} to {listens}: {heard:?}");
    }
}

/// eclipse-zenoh/zenoh-plugin-ros2dds #712: a program that makes and destroys subscriptions costs the bridge gigabytes.
#[test]
fn subscriptions_that_come_and_go_leave_no_memory_behind() {
    const SUBSCRIPTIONS: &str = "300";
    /// Far below 16 bytes for each subscription of each message about the graph, which was the leak: 1.4 MB for 300, and four times
    /// that for 600.
    const MORE_KB_MAX: u64 = 2_000;
    let lab = Lab::real(PLAN, robot_to_desk("topic", ["/churn"]));
    let _talker = start(&lab, Site::Robot, "jazzy", "events.py", &["pub", "--topic", "/churn"]);
    for distribution in ["jazzy", "kilted"] {
        let args = ["subscriptions", "--topic", "/churn", "--count", SUBSCRIPTIONS];
        let mut churn = start(&lab, Site::Desk, distribution, "churn.py", &args);
        let mut resident = Vec::new();
        for _ in 0..4 {
            churn.wait("all subscriptions", |e| e["event"] == "done");
            resident.push(lab.node(Site::Desk).held().resident_kb);
            churn.go();
        }
        // The first fill what is reused.
        assert!(resident[3] <= resident[1] + MORE_KB_MAX, "{distribution}: {resident:?} KB");
    }
}

/// eclipse-zenoh/zenoh-plugin-ros2dds #690: 13 participants that join at once end `/tf` for good.
#[test]
fn topic_survives_thirteen_participants_that_join_at_once() {
    const PARTICIPANTS: usize = 13;
    let lab = Lab::real(PLAN, robot_to_desk("topic", ["/tf"]));
    for [talks, listens] in PAIRS {
        let _talker =
            start(&lab, Site::Robot, talks, "events.py", &["pub", "--topic", "/tf", "--rate", "50"]);
        let mut listener = start(&lab, Site::Desk, listens, "events.py", &["sub", "--topic", "/tf"]);
        listener.wait("a message", |e| e["event"] == "received");
        let mut crowd = start(&lab, Site::Desk, listens, "churn.py", &["participants", "--topic", "/tf"]);
        let mut hear = BTreeSet::new();
        while hear.len() < PARTICIPANTS {
            let event = crowd.wait("a message for another", |e| e["event"] == "hears");
            hear.insert(count(&event, "number"));
        }
        // Whoever was there before still hears what is said now.
        let before = listener.events.try_iter().filter_map(|(_, e)| e["seq"].as_u64()).max();
        listener.wait("a later message", |e| e["seq"].as_u64() > before);
    }
}
