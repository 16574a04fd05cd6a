//! Table `fan-out`: one publisher and many subscribers at the other place, which share a process and its local network.
//!
//! At a steady rate, how old messages were when they were taken; as fast as they are taken, how many arrived at all
//! subscribers together. `sgc-…-nodes` is one subscriber at each of several nodes, with a local network of its own.

use anyhow::Result;

use super::flow::{Flow, FlowSpec, Order};
use super::lab::{Lab, PathKind, Side};
use super::plan::Breadth;
use super::system::{Running, Sgc, System, Topic};
use super::tally::{Round, Tally};
use super::{Compare, Figures};

const TOPIC: &str = "/bench/fan";
/// Nodes, where each has one subscriber. More would measure how many processes this machine can run.
const NODES: [u32; 2] = [1, 10];
const NODES_SUITE: &str = "group";
/// Subscribers.
const SINKS: [usize; 3] = [1, 10, 100];
const BYTES: usize = 1000;
/// Messages a second of the steady part.
const RATE: f64 = 100.0;
const RUN_SECONDS: f64 = 1.5;
const WARM_UP_SECONDS: f64 = 0.3;

/// Measures it.
pub(crate) fn run(compare: &Compare, figures: &mut Figures) -> Result<()> {
    let why = "no goal asks, and what they differ in is in the rows of their own";
    let systems = compare.systems_of(Breadth::Cross, "fan-out", why, figures);
    // One round: no goal asks.
    Round::all(compare, figures, "fan-out", 1, |round| {
        for system in &systems {
            for sinks in SINKS {
                let what = format!("{} to {sinks}", system.name());
                round.measure(&what, |tally| measure(compare, *system, sinks, tally));
            }
        }
        let name = format!("sgc-quic-{NODES_SUITE}");
        for nodes in NODES.into_iter().filter(|_| compare.wants(&name)) {
            let name = format!("{name}-nodes");
            round.measure(&format!("{name} to {nodes}"), |tally| measure_nodes(compare, &name, nodes, tally));
        }
    });
    Ok(())
}

fn measure(compare: &Compare, system: &dyn System, sinks: usize, tally: &mut Tally) -> Result<()> {
    let name = system.name();
    let lab = Lab::new(PathKind::Bare, compare.load())?;
    let topics = [Topic { name: TOPIC, towards: Side::Right, reliable: true }];
    let running = system.start(&lab, &topics)?;
    let spec = FlowSpec { topic: TOPIC, from: Side::Left, readers: sinks, reliable: true, depth: 0 };
    let flow = Flow::start(&lab, &running, &spec)?;
    run_flow(compare, &name, sinks, &running, flow, tally)
}

fn measure_nodes(compare: &Compare, name: &str, nodes: u32, tally: &mut Tally) -> Result<()> {
    let lab = Lab::new(PathKind::Bare, compare.load())?;
    let system = Sgc::new(compare.sgc(), "quic", NODES_SUITE, 0)?;
    let (running, networks) = system.start_fan(&lab, TOPIC, nodes)?;
    let spec = FlowSpec { topic: TOPIC, from: Side::Left, readers: 1, reliable: true, depth: 0 };
    let here = &running.dds[Side::Left as usize];
    let flow = Flow::start_between(&lab, here, &networks, &spec)?;
    run_flow(compare, name, nodes as usize, &running, flow, tally)
}

fn run_flow(
    compare: &Compare,
    name: &str,
    sinks: usize,
    running: &Running,
    mut flow: Flow,
    tally: &mut Tally,
) -> Result<()> {
    let part = if compare.is_quick() { 0.2 } else { 1.0 };
    let order = |seconds: f64, rate| Order { size: BYTES, count: u32::MAX, seconds: seconds * part, rate };
    flow.run(running, &order(WARM_UP_SECONDS, Some(RATE)))?;
    let steady = flow.run(running, &order(RUN_SECONDS, Some(RATE)))?;
    let fast = flow.run(running, &order(RUN_SECONDS, None))?;
    let mut add = |metric, value| tally.add(name, PathKind::Bare.name(), sinks as u64, metric, value);
    add("p50_us", steady.age_us[0]);
    add("p99_us", steady.age_us[1]);
    add("max_us", steady.age_us[2]);
    add("per_second", fast.arrived() / fast.seconds);
    add("lost", steady.lost() + fast.lost());
    add("cpu_us_per_message", fast.cpu_seconds * 1e6 / fast.arrived());
    Ok(())
}
