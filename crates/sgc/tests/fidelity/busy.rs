//! Measures a node in a network of many nodes of which little is shared: its cost, and the traffic of its link while no
//! message is published.
//!
//! `SGC_GRAPH_NODES`, each of ten endpoints, `SGC_GRAPH_SHARED` and `SGC_GRAPH_SECONDS` make it larger (`make
//! bench-graph`: the figures of benchmarks/graph.md).

use std::fs;
use std::time::{Duration, Instant};

use crate::lab::{Lab, Site};
use crate::support::{environment, eventually, say};
use crate::{EXCLUSIVE, python};

const NODES: u64 = 20;
const SHARED: u64 = 10;
const SECONDS: u64 = 3;
/// Bound of a node's memory per endpoint of its network: names, QoS and Cyclone's own state.
const ENDPOINT_KB_MAX: u64 = 64;
/// Bound of traffic on an idle link. One message per second and idle topic would exceed it.
const IDLE_BYTES_PER_S_MAX: u64 = 500;

/// Returns the processor time of a process so far.
fn busy(pid: u32) -> Duration {
    let stat = fs::read_to_string(format!("/proc/{pid}/stat")).unwrap();
    let after_name = stat.rsplit_once(')').unwrap().1;
    let ticks =
        after_name.split_whitespace().skip(11).take(2).map(|t| t.parse::<u64>().unwrap()).sum::<u64>();
    // USER_HZ is 100 on Linux.
    Duration::from_millis(ticks * 10)
}

fn carried(lab: &Lab) -> u64 {
    let status = lab.status(Site::Robot);
    let links = status["links"].as_array().unwrap();
    links.iter().map(|l| l["sent_bytes"].as_u64().unwrap() + l["received_bytes"].as_u64().unwrap()).sum()
}

#[test]
fn a_busy_network_costs_little_and_its_silence_next_to_nothing() {
    let (nodes, shared) = (environment("SGC_GRAPH_NODES", NODES), environment("SGC_GRAPH_SHARED", SHARED));
    let seconds = environment("SGC_GRAPH_SECONDS", SECONDS);
    let lab = Lab::with_topics(EXCLUSIVE, (0..shared).map(|n| format!("/shared/n{n}")));
    let node = lab.node(Site::Robot);
    let pid = node.pid();
    let (before, begun, idle) = (node.held(), Instant::now(), busy(pid));
    let mut many = python(&lab, Site::Robot, "busy.py", &[&nodes.to_string(), &shared.to_string()]);
    let made = many.wait("all endpoints", |e| e["event"] == "ready")["endpoints"].as_u64().unwrap();
    let made_after = begun.elapsed();
    let granted = || {
        let routes = lab.status(Site::Desk)["routes"].as_array().cloned().unwrap_or_default();
        let is_there = |r: &&serde_json::Value| r["state"].as_str().is_some_and(|s| s.starts_with("granted"));
        routes.iter().filter(is_there).count() as u64
    };
    eventually("all that is shared is at the desk", || granted() == shared);
    let there_after = begun.elapsed();
    let discovery = busy(pid) - idle;
    // Waits until the work that discovery causes is over.
    eventually("rest", || {
        let before = (busy(pid), carried(&lab));
        std::thread::sleep(Duration::from_secs(1));
        busy(pid) - before.0 < Duration::from_millis(200) && carried(&lab) - before.1 < IDLE_BYTES_PER_S_MAX
    });
    let (cpu, bytes, since) = (busy(pid), carried(&lab), Instant::now());
    std::thread::sleep(Duration::from_secs(seconds));
    let lasted = since.elapsed();
    let (cpu, bytes) = (busy(pid) - cpu, carried(&lab) - bytes);
    let after = node.held();
    let per_second = bytes as f64 / lasted.as_secs_f64();
    let endpoint_kb = (after.resident_kb - before.resident_kb) / made;
    say(&format!(
        "graph: {made} endpoints of {nodes} nodes, {shared} shared: made after {made_after:.1?}, all at the desk after \
         {there_after:.1?}, {discovery:.2?} of processor time for it; at rest {:.2} % of a core, {per_second:.0} bytes a \
         second on the link; {} kB before, {} kB then, {} threads",
        100.0 * cpu.as_secs_f64() / lasted.as_secs_f64(),
        before.resident_kb,
        after.resident_kb,
        after.threads,
    ));
    assert!(endpoint_kb < ENDPOINT_KB_MAX, "{endpoint_kb} kB for each endpoint");
    assert!(bytes < IDLE_BYTES_PER_S_MAX * seconds.max(1) * 2, "{bytes} bytes in {lasted:?}");
}
