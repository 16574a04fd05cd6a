//! Networks of rmw_zenoh through `sgc`: programs of the Zenoh peer (`tests/peers/zenoh`) and real ROS 2 on DDS (`rclpy` of
//! Jazzy and Kilted), in each combination of a robot's network and a desk's.
//!
//! The networks are those of `support/lab.rs`. Each Zenoh network has a router of its own on its loopback interface, so
//! that only `sgc` connects robot and desk.

#![allow(clippy::unwrap_used)]

mod faults;
mod gateway;
mod graph;
mod hostile;
#[path = "../support/lab.rs"]
mod lab;
mod loops;
mod networks;
mod secured;
mod services;
#[path = "../support/mod.rs"]
mod support;
mod topics;
mod values;

use lab::Plan;
use networks::Middleware::{self, Dds, Zenoh};
use serde_json::Value;
use support::turn::TurnKind;

const PLAN: Plan = Plan { name: "sgcz", domains: ["85", "86"], peer_life: "1200", turn: TurnKind::Shared };

/// The middleware at the robot and that at the desk.
const CASES: [[Middleware; 2]; 3] = [[Dds("jazzy"), Zenoh], [Zenoh, Dds("kilted")], [Zenoh, Zenoh]];

/// Returns the numbers in a summary.
fn counts<const N: usize>(summary: &Value, keys: [&str; N]) -> [u64; N] {
    keys.map(|key| summary[key].as_u64().unwrap_or_else(|| panic!("no {key} in {summary}")))
}
