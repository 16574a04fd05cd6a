//! The ROS graph: far programs in it with their nodes, types and hashes, as long as they live.

use serde_json::Value;

use crate::lab::{Site, robot_to_desk};
use crate::networks::Middleware::{Dds, Zenoh};
use crate::networks::{End, Networks};
use crate::{CASES, services};

/// `std_msgs/msg/UInt8MultiArray`, with the hash that its package has.
const TYPE: [&str; 2] = [
    "std_msgs/msg/UInt8MultiArray",
    "RIHS01_5687e861b8d307a5e48b7515467ae7a5fc2daf805bd0ce6d8e9e604bade9f385",
];

/// Returns an endpoint of that type.
pub(crate) fn end(kind: &'static str, node: &str) -> End {
    let [type_name, type_hash] = TYPE.map(str::to_owned);
    End { kind, node: node.to_owned(), type_name, type_hash }
}

#[test]
fn far_publishers_and_subscribers_are_shown_until_they_or_sgc_are_killed() {
    for on in CASES {
        let Some(mut networks) = Networks::start(on, robot_to_desk("topic", ["/load"])) else { return };
        let talk = ["--topic", "/load", "--wait-go"];
        let talker = networks.load_on(Site::Robot, "pub", "talker", &talk);
        let listener = networks.load_on(Site::Desk, "sub", "listener", &["--topic", "/load"]);
        let shown = [end("publisher", "talker"), end("subscription", "listener")];
        // The node of `sgc` at the robot reads for the subscriber.
        let and_sgc = shown.iter().cloned().chain([end("subscription", "sgc_robot")]).collect();
        networks.assert_ends(Site::Robot, "/load", and_sgc);
        networks.assert_ends(Site::Desk, "/load", shown.to_vec());
        networks.end_on(Site::Desk, listener);
        networks.end_on(Site::Robot, talker);
        networks.assert_ends(Site::Robot, "/load", vec![]);
        networks.assert_ends(Site::Desk, "/load", vec![]);
        let _talker = networks.load_on(Site::Robot, "pub", "talker", &talk);
        networks.assert_ends(Site::Desk, "/load", vec![end("publisher", "talker")]);
        let signal = networks.sudden_end(Site::Desk);
        networks.end(Site::Desk, signal);
        networks.assert_ends(Site::Desk, "/load", vec![]);
    }
}

/// A service type as tokens name it, with the hash that its package has.
const SERVICE: [&str; 2] = [
    "test_msgs::srv::dds_::BasicTypes_",
    "RIHS01_da348697437c103cc9a9322ac1bdbdcf8eb11a85de22f7f2492ca1df416e1a5f",
];

/// Waits until programs at a Zenoh site see a server or a client of a node, and no other endpoint of that node.
fn assert_shown(networks: &Networks, site: Site, kind: &str, node: &str) {
    let mut graph = networks.zenoh(site, "graph", &["--hidden"]);
    let is_it = |end: &&Value| end["topic"] == "/service" && end["node"] == node;
    graph.wait(&format!("the {kind} {node} at the {}, {:?}", site.name(), networks.on), |event| {
        let all = event["endpoints"].as_array().into_iter().flatten().filter(is_it);
        let found: Vec<_> =
            all.map(|end| ["kind", "type", "hash"].map(|key| end[key].as_str().unwrap())).collect();
        found == [[kind, SERVICE[0], SERVICE[1]]]
    });
}

#[test]
fn far_servers_and_clients_are_shown_with_type_and_hash() {
    for on in CASES {
        let Some(networks) = Networks::start(on, robot_to_desk("service", ["/service"])) else { return };
        let _server = services::serve(&networks, on[0], "/service");
        let (_client, node) = services::call_and_stay(&networks, "/service");
        match on[0] {
            Dds(distribution) => {
                let client = ["--service", "/service", "--client", node];
                let args = [&["--topic", "/none", "--timeout", "40"], &client[..]].concat();
                let found = networks.rclpy(Site::Robot, distribution, "graph.py", &args).summary();
                let clients = found["service_clients"].as_array().unwrap();
                assert!(clients.contains(&node.into()), "{on:?}: {found}");
            }
            Zenoh => assert_shown(&networks, Site::Robot, "client", node),
        }
        if on[1] == Zenoh {
            assert_shown(&networks, Site::Desk, "server", "/server");
        }
    }
}
