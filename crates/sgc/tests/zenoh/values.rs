//! Each message type of the packages that both distributions have, by value.

use std::fs;

use serde_json::json;

use crate::CASES;
use crate::lab::{Site, robot_to_desk};
use crate::networks::Middleware::{Dds, Zenoh};
use crate::networks::Networks;
use crate::support::Peer;

#[test]
fn every_message_type_arrives_by_value() {
    // Types with Zenoh at both ends are as opaque to `sgc` as these.
    for on in &CASES[..2] {
        let Some(networks) = Networks::start(*on, robot_to_desk("topic", ["/types/**"])) else { return };
        // The Zenoh peer has no definitions of its own.
        let file = networks.dir().join("values.json");
        let dump = networks.ros(Site::Robot, "jazzy", "values.py").arg("dump").output().unwrap();
        assert!(dump.status.success(), "{dump:?}");
        fs::write(&file, dump.stdout).unwrap();
        let run = |site, role: &str| -> Peer {
            match networks.at(site) {
                Dds(distribution) => {
                    networks.rclpy(site, distribution, "values.py", &[role, "--timeout", "60"])
                }
                Zenoh => networks.zenoh(site, "values", &[role, "--file", file.to_str().unwrap()]),
            }
        };
        let mut listener = run(Site::Desk, "sub");
        let mut talker = run(Site::Robot, "pub");
        talker.wait_matched("a match of each publisher");
        listener.wait_matched("a match of each subscriber");
        talker.go();
        let summary = listener.summary();
        assert!(summary["types"].as_u64() > Some(130), "{summary}");
        let faults = ["missing", "altered", "wrong"].map(|key| summary[key].clone());
        assert_eq!(faults, [json!([]), json!([]), json!({})], "{on:?}");
    }
}
