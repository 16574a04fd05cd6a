//! Real ROS 2 through `sgc`: programs on the client library of Jazzy (Fast DDS 2.14) and of Kilted (Fast DDS 3.2),
//! installed from PyPI (`tests/peers/README.md`), as their packages set them up: default QoS, default discovery, shared
//! memory.
//!
//! They run in a robot's network, the cloud and a desk's network (`support/lab.rs`). The same programs without sgc are
//! the reference.

#![allow(clippy::unwrap_used)]

mod all;
mod bugs;
mod calls;
mod clocks;
mod dead_man;
mod durable;
mod events;
mod flow;
mod graph;
mod hosts;
mod keyed;
#[path = "../support/lab.rs"]
mod lab;
mod metrics;
mod partner;
mod secured;
#[path = "../support/mod.rs"]
mod support;
mod why;

use lab::Plan;
use serde_json::Value;
use support::turn::TurnKind;

const PLAN: Plan = Plan { name: "sgcr", domains: ["87", "88"], peer_life: "120", turn: TurnKind::Shared };
/// The settings of labs in which a test measures.
const EXCLUSIVE: Plan = Plan { turn: TurnKind::Exclusive, ..PLAN };

/// The distribution at the robot and that at the desk.
const PAIRS: [[&str; 2]; 2] = [["jazzy", "kilted"], ["kilted", "jazzy"]];

fn count(summary: &Value, key: &str) -> u64 {
    summary[key].as_u64().unwrap()
}
