//! Tests that a ring of routers heals, with real processes: five routers with chords, three proxies and independent
//! programs, each network in a namespace of its own. A seed cuts links and kills, restarts and stops routers. Three
//! topics flow from the robot to the desk and the lab. No reliable message may be lost, repeated or reordered.
//!
//! A second run is the same with a store of names (`mapping = "store"`), a real cluster with a cable to each router. The
//! seed also kills and stops its servers and cuts its cables, and topics that are new every few seconds have routers look
//! names up all the while. Data never depends on the store: what flows goes on, and new topics are heard although no
//! server can be reached. When nothing of the store is broken any more, it answers all routers and has all names again.
//!
//! `SGC_RING_SEED` and `SGC_RING_SECONDS` choose the faults and how long there are any, `SGC_RING_DIR` a directory that
//! keeps the logs and the trace. A plan follows from the seed alone, its moments do not: no router is taken before
//! the nodes say that there is a way without it, since links are dialled again in seconds, not at once.
//!
//! Proxies and peers are not killed here; `peers.rs` does that.

#![allow(clippy::unwrap_used)]

mod graph;
mod judge;
mod lab;
mod ledger;
mod new_topics;
mod plan;
mod run;
mod store;
mod store_faults;
#[path = "../support/mod.rs"]
mod support;

use std::collections::BTreeMap;
use std::str::FromStr;
use std::time::{Duration, Instant};

use graph::NODES;
use lab::Lab;
use run::{CALM, Run};
use support::say;
use support::turn::{Turn, TurnKind};

const SEED: u64 = 4;
const SECONDS: u64 = 40;
/// The same for the ring with a store.
const STORE_SEED: u64 = 789;
const STORE_SECONDS: u64 = 20;

fn chosen<T: FromStr>(variable: &str, otherwise: T) -> T {
    match std::env::var(variable) {
        Ok(text) => text.parse().unwrap_or_else(|_| panic!("{variable} is no number: {text:?}")),
        Err(_) => otherwise,
    }
}

/// Lets faults follow from a seed for a time. `usual` are both without a choice.
fn heal(usual: (u64, u64), has_store: bool) {
    let _turn = Turn::take(TurnKind::Exclusive);
    let (seed, seconds) = (chosen("SGC_RING_SEED", usual.0), chosen("SGC_RING_SECONDS", usual.1));
    let with = if has_store { " with a store" } else { "" };
    say(&format!("ring{with}: SGC_RING_SEED={seed} SGC_RING_SECONDS={seconds}"));
    let time = Duration::from_secs(seconds);
    let mut run = Run::new(time, has_store);
    let calm_since = Instant::now();
    run.pass(CALM);
    let memory = NODES.map(|node| run.lab.resident(node));
    if has_store {
        run.use_store();
    }
    run.chaos(seed, time);
    run.wait_for_links();
    if has_store {
        run.require_store();
    }
    run.pass(CALM);
    run.finish();
    let ended = Instant::now();

    let broken: Vec<_> = run.events.iter().filter(|event| !event.kind.starts_with("mended")).collect();
    let mut kinds = BTreeMap::<&str, u32>::new();
    broken.iter().for_each(|event| *kinds.entry(&event.kind).or_default() += 1);
    let mut report = vec![format!("seed {seed}: {} faults in {seconds} s: {kinds:?}", broken.len())];
    run.judge(&mut report);
    run.outages(&mut report, calm_since, ended);
    run.first_uses(&mut report);
    run.look_at_nodes(&memory, &mut report);
    let trace = run.trace();
    run.lab.keep("trace.log", &trace);
    say(&report.join("\n"));
    if !run.problems.is_empty() {
        say(&trace);
        panic!("seed {seed}, {seconds} s:\n{}", run.problems.join("\n"));
    }
}

#[test]
fn a_ring_heals_and_nothing_reliable_is_lost_or_doubled() {
    heal((SEED, SECONDS), false);
}

#[test]
fn a_ring_with_a_store_heals_and_finds_names_while_the_store_breaks() {
    if Lab::can_be_apart() {
        heal((STORE_SEED, STORE_SECONDS), true);
    }
}
