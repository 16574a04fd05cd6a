//! Tests in the large that an unmodified program cannot tell sgc from a plain network: latched topics many to many,
//! programs and nodes that come and go, a subscriber that stalls, and isolation of topics that are not shared.

#![allow(clippy::unwrap_used)]

mod busy;
mod churn;
mod identity;
mod isolation;
#[path = "../support/lab.rs"]
mod lab;
mod latched;
mod observer;
mod policies;
mod stall;
#[path = "../support/mod.rs"]
mod support;

use lab::{Lab, Plan, Site};
use support::Peer;
use support::turn::TurnKind;

/// Peers live for as long as the longest of these tests.
const PLAN: Plan = Plan { name: "sgcfi", domains: ["93", "94"], peer_life: "3000", turn: TurnKind::Shared };
/// The settings of labs in which a test measures.
const EXCLUSIVE: Plan = Plan { turn: TurnKind::Exclusive, ..PLAN };

/// Starts a Python program of `tests/peers/py`, whose first argument is its domain.
fn python(lab: &Lab, site: Site, program: &str, args: &[&str]) -> Peer {
    lab.python(site, program, &[&[lab.domain(site)], args].concat())
}
