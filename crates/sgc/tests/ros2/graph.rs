//! Far programs in the local ROS graph, those that publish and those that consume, as a program of each distribution
//! reads it.

use std::collections::{BTreeMap, BTreeSet};
use std::process::Stdio;

use rustix::process::Signal;
use serde_json::Value;

use crate::lab::{Lab, Site, robot_to_desk, share, uses};
use crate::support::Peer;
use crate::{PAIRS, PLAN};

/// Returns the ends of a topic as a program of this distribution sees them at a site, once each has a node.
fn ends(lab: &Lab, site: Site, distribution: &str, publishers: &str, subscribers: &str) -> Value {
    let counts = ["--publishers", publishers, "--subscribers", subscribers];
    // A far publisher appears under the node of `sgc` until its own node is known.
    let args = [&["--topic", "/load", "--node", "load", "--timeout", "30"][..], &counts].concat();
    lab.rclpy(site, distribution, "graph.py", &args).summary()
}

/// Returns the description of an end without the id in its own network.
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

/// Returns the subscribers of a topic by the name of their node, once each of these nodes (sorted) has one and no other
/// has any. A number alone would be met by a subscriber of the pair before, whose end is not known yet.
fn subscribers(lab: &Lab, site: Site, distribution: &str, nodes: &str) -> BTreeMap<String, Value> {
    let count = nodes.split(',').count().to_string();
    let counts = ["--exactly", "--publishers", "1", "--subscribers", &count, "--subscriber-nodes", nodes];
    let args = [&["--topic", "/load", "--timeout", "30"][..], &counts].concat();
    let found = lab.rclpy(site, distribution, "graph.py", &args).summary();
    let all = found["subscribers"].as_array().unwrap();
    let mut names: Vec<_> = all.iter().map(|end| end["node"].as_str().unwrap()).collect();
    names.sort_unstable();
    assert_eq!(names.join(","), nodes, "{distribution} at {site:?}: {found}");
    all.iter().map(|end| (end["node"].as_str().unwrap().to_owned(), end.clone())).collect()
}

fn subscriber(lab: &Lab, distribution: &str, node: &str, more: &[&str]) -> Peer {
    let common = ["sub", "--topic", "/load", "--node", node, "--wait-stop", "--timeout", PLAN.peer_life];
    lab.load(Site::Desk, distribution, &[&common, more].concat())
}

#[test]
fn far_subscribers_are_shown_with_node_type_qos_and_id_while_they_live() {
    let lab = Lab::real(PLAN, robot_to_desk("topic", ["/load"]));
    for [talks, hears] in PAIRS {
        let talk = ["pub", "--topic", "/load", "--wait-go", "--timeout", PLAN.peer_life];
        let mut talker = lab.load(Site::Robot, talks, &talk);
        let _view = subscriber(&lab, hears, "map_view", &["--reliable"]);
        let mut recorder = subscriber(&lab, hears, "recorder", &["--best-effort"]);
        for reads in ["jazzy", "kilted"] {
            let native = subscribers(&lab, Site::Desk, reads, "map_view,recorder");
            // The reader that takes the messages for both is one of the node of `sgc`.
            let far = subscribers(&lab, Site::Robot, reads, "map_view,recorder,sgc_robot");
            for (node, end) in &native {
                assert_eq!(without_gid(&far[node]), without_gid(end), "{talks}, {hears}, {reads}");
            }
            assert_ne!(far["map_view"]["gid"], far["recorder"]["gid"]);
            assert_ne!(far["map_view"]["reliability"], far["recorder"]["reliability"]);
        }
        recorder.end();
        subscribers(&lab, Site::Robot, talks, "map_view,sgc_robot");
        // The publisher matches one reader, however many are shown.
        talker.end();
        assert_eq!(talker.summary()["matched"], 1, "{talks}, {hears}");
    }
}

#[test]
fn far_publishers_on_a_topic_that_others_publish_on_are_shown_as_their_nodes() {
    let robot =
        share("topic", "/load", "desk") + "type = \"std_msgs/msg/UInt8MultiArray\"\npublish = [\"desk\"]\n";
    let desk = uses("topic", "/load", "robot") + "publish = true\n";
    let lab = Lab::real(PLAN, [robot, desk]);
    let publisher = |distribution| {
        let talk = ["pub", "--topic", "/load", "--wait-go", "--timeout", PLAN.peer_life];
        lab.load(Site::Desk, distribution, &talk)
    };
    let shown = |distribution, count: &str| {
        let args =
            ["--topic", "/load", "--node", "load", "--timeout", "30", "--exactly", "--publishers", count];
        let found = lab.rclpy(Site::Robot, distribution, "graph.py", &args).summary();
        let all = found["publishers"].as_array().unwrap();
        let of = |end: &Value| ["node", "namespace", "type", "reliability"].map(|key| end[key].clone());
        all.iter().map(of).collect::<Vec<_>>()
    };
    for [hears, talks] in PAIRS {
        let mut first = publisher(talks);
        let native = without_gid(&ends(&lab, Site::Desk, talks, "1", "0")["publishers"][0]);
        let native = ["node", "namespace", "type", "reliability"].map(|key| native[key].clone());
        for reads in ["jazzy", "kilted"] {
            assert_eq!(shown(reads, "1"), std::slice::from_ref(&native), "{talks} to {hears}, {reads}");
        }
        let mut second = publisher(hears);
        assert_eq!(shown(hears, "2"), [native.clone(), native], "{talks} to {hears}");
        for publisher in [&mut first, &mut second] {
            publisher.end();
            publisher.summary();
        }
    }
}

#[test]
fn programs_at_a_gateway_are_one_far_node() {
    let lab = Lab::real(PLAN, robot_to_desk("topic", ["/load"]));
    let talk = ["topic", "pub", "/load", "std_msgs/msg/UInt8MultiArray", "{data: [1]}", "--rate", "10"];
    let mut command = lab.sgc(Some(Site::Robot), &[&talk[..], &["--socket", "robot.sock"]].concat());
    let mut programs = [0; 2].map(|_| command.stdin(Stdio::null()).stdout(Stdio::null()).spawn().unwrap());
    let args = ["--topic", "/load", "--node", "sgc_gateway_robot", "--publishers", "2", "--timeout", "30"];
    let found = lab.rclpy(Site::Desk, "kilted", "graph.py", &args).summary();
    for program in &mut programs {
        program.kill().unwrap();
        program.wait().unwrap();
    }
    let publishers = found["publishers"].as_array().unwrap();
    let nodes: Vec<_> = publishers.iter().map(|end| end["node"].as_str().unwrap()).collect();
    assert_eq!(nodes, ["sgc_gateway_robot"; 2], "{found}");
    let is_it = |node: &&Value| **node == "/sgc_gateway_robot";
    assert_eq!(found["nodes"].as_array().unwrap().iter().filter(is_it).count(), 1, "{found}");
}

#[test]
fn far_service_and_action_clients_are_shown() {
    let (topic, service, action) = ("/robot/chatter", "/robot/status", "/robot/fibonacci");
    let mut tables = robot_to_desk("topic", [topic]);
    for (kind, name) in [("service", service), ("action", action)] {
        tables[0] += &share(kind, name, "desk");
        tables[1] += &uses(kind, name, "robot");
    }
    let lab = Lab::real(PLAN, tables);
    for [serves, calls] in PAIRS {
        let _robot = lab.rclpy(Site::Robot, serves, "mixed.py", &["robot"]);
        let _desk = lab.rclpy(Site::Desk, calls, "mixed.py", &["desk"]);
        let client = ["--client", "/desk/listener", "--timeout", "30"];
        let args = [&["--topic", topic, "--service", service, "--action", action][..], &client].concat();
        let found = lab.rclpy(Site::Robot, serves, "graph.py", &args).summary();
        for kind in ["service_clients", "action_clients"] {
            let clients = found[kind].as_array().unwrap();
            assert!(clients.contains(&"/desk/listener".into()), "{serves}, {calls}: {kind} of {found}");
        }
        let nodes = found["nodes"].as_array().unwrap();
        assert_eq!(nodes.iter().filter(|node| *node == "/desk/listener").count(), 1, "{nodes:?}");
    }
}

#[test]
fn consumers_of_a_node_without_graph_are_not_shown() {
    let mut lab = Lab::real(PLAN, robot_to_desk("topic", ["/load"]));
    let talk = ["pub", "--topic", "/load", "--timeout", PLAN.peer_life];
    let _talker = lab.load(Site::Robot, "jazzy", &talk);
    lab.end(Site::Desk, Signal::TERM);
    lab.reconfigure(Site::Desk, "[ros]\n", "[ros]\ngraph = false\n");
    lab.start(Site::Desk);
    let mut listener = subscriber(&lab, "kilted", "map_view", &["--verbose"]);
    // It hears messages for two seconds. A known consumer would appear after less than one.
    for _ in 0..20 {
        listener.wait("a message", |event| event["event"] == "received");
    }
    subscribers(&lab, Site::Robot, "jazzy", "sgc_robot");
    lab.end(Site::Desk, Signal::TERM);
    lab.reconfigure(Site::Desk, "graph = false\n", "");
    lab.start(Site::Desk);
    subscribers(&lab, Site::Robot, "jazzy", "map_view,sgc_robot");
}
