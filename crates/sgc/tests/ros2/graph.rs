//! Far programs in the local ROS graph, as a program of each distribution reads it.

use std::collections::BTreeSet;

use serde_json::Value;

use crate::lab::{Lab, Site, robot_to_desk};
use crate::{PAIRS, PLAN};

/// The ends of a topic as a program of this distribution finds them at a site, once each has a node.
fn ends(lab: &Lab, site: Site, distribution: &str, publishers: &str, subscribers: &str) -> Value {
    let counts = ["--publishers", publishers, "--subscribers", subscribers];
    // A far publisher is shown as one of the node of `sgc`, until its own is told.
    let args = [&["--topic", "/load", "--node", "load", "--timeout", "30"][..], &counts].concat();
    lab.rclpy(site, distribution, "graph.py", &args).summary()
}

/// All that is said of an end, but for the id that it has in its own network.
fn without_gid(end: &Value) -> Value {
    let mut end = end.clone();
    let gid = end.as_object_mut().unwrap().remove("gid").unwrap();
    assert!(gid.as_str().unwrap().bytes().any(|digit| digit != b'0'), "{end}: {gid}");
    end
}

#[test]
fn far_publishers_are_shown_with_node_type_qos_and_id() {
    let lab = Lab::real(PLAN, robot_to_desk("topic", ["/load"]));
    for [talks, _] in PAIRS {
        let talk = ["pub", "--topic", "/load", "--wait-go", "--timeout", PLAN.peer_life];
        let mut talker = lab.load(Site::Robot, talks, &talk);
        let [native, far] = [Site::Robot, Site::Desk]
            .map(|site| ["jazzy", "kilted"].map(|reads| ends(&lab, site, reads, "1", "0")));
        let what = format!("{talks}: {native:?} {far:?}");
        for found in native.iter().chain(&far) {
            assert_eq!(found["publishers"].as_array().unwrap().len(), 1, "{what}");
            assert_eq!(
                without_gid(&found["publishers"][0]),
                without_gid(&native[0]["publishers"][0]),
                "{what}"
            );
        }
        let gids: BTreeSet<_> = far.iter().map(|found| found["publishers"][0]["gid"].to_string()).collect();
        assert_eq!(gids.len(), 1, "{what}");
        talker.end();
        talker.summary();
    }
}

#[test]
fn readers_of_sgc_are_shown_as_those_of_its_node() {
    let lab = Lab::real(PLAN, robot_to_desk("topic", ["/load"]));
    let talk = ["pub", "--topic", "/load", "--wait-go", "--timeout", PLAN.peer_life];
    let _talker = lab.load(Site::Robot, "kilted", &talk);
    for reads in ["jazzy", "kilted"] {
        let found = ends(&lab, Site::Robot, reads, "1", "1");
        assert_eq!(found["subscribers"][0]["node"], "sgc_robot", "{reads}: {found}");
    }
}
