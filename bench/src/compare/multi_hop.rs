//! Table `multi-hop`: round trips and throughput of `sgc` with one router after the other between the two places, all
//! routers at the right one.

use std::collections::BTreeMap;

use anyhow::Result;

use super::flow::{Flow, FlowSpec, Order};
use super::lab::{Lab, PathKind, Side};
use super::round_trip;
use super::system::{Sgc, System as _, Topic};
use super::tally::Tally;
use super::{Compare, Figures};

const TOPIC: &str = "/bench/hops";
/// Routers in a row; without one the right proxy is dialled, which is where counting begins.
const ROUTERS: std::ops::RangeInclusive<usize> = 0..=5;
const SUITES: [&str; 2] = ["group", "standard"];
const BYTES: usize = 1000;
const RUN_SECONDS: f64 = 2.0;
const WARM_UP_SECONDS: f64 = 0.3;

/// Measures it.
pub(crate) fn run(compare: &Compare, figures: &mut Figures) -> Result<()> {
    let kind = PathKind::Bare;
    if !compare.wants_path(&kind) {
        return Ok(());
    }
    let mut tally = Tally::new("multi-hop");
    // One round: no goal asks.
    for round in 0..1 {
        for suite in SUITES {
            let name = format!("sgc-quic-{suite}");
            if !compare.wants(&name) {
                continue;
            }
            for routers in ROUTERS {
                compare.note(&format!("multi-hop, round {round}: {name} over {routers}"));
                if let Err(error) = measure(compare, suite, routers, &name, &mut tally) {
                    figures.leave_out(&format!("multi-hop {name} over {routers}"), format!("{error:#}"));
                }
            }
        }
    }
    tally.write(figures);
    Ok(())
}

fn measure(
    compare: &Compare,
    suite: &'static str,
    routers: usize,
    name: &str,
    tally: &mut Tally,
) -> Result<()> {
    let kind = PathKind::Bare;
    let system = Sgc::new(compare.sgc(), "quic", suite, routers)?;
    let mut samples = BTreeMap::new();
    round_trip::measure(compare, &kind, &system, &[BYTES], &mut samples)?;
    for round_trip::Sample { round_trips_us, .. } in samples.into_values() {
        let spread = crate::report::Spread::of(round_trips_us);
        tally.add(name, kind.name(), routers as u64, "p50_us", spread.p50);
        tally.add(name, kind.name(), routers as u64, "p99_us", spread.p99);
        tally.add(name, kind.name(), routers as u64, "max_us", spread.max);
    }
    let lab = Lab::new(kind, compare.load())?;
    let running = system.start(&lab, &[Topic { name: TOPIC, towards: Side::Right, reliable: true }])?;
    let spec = FlowSpec { topic: TOPIC, from: Side::Left, readers: 1, reliable: true, depth: 0 };
    let mut flow = Flow::start(&lab, &running, &spec)?;
    let part = if compare.is_quick() { 0.2 } else { 1.0 };
    let order = |seconds: f64| Order { size: BYTES, count: u32::MAX, seconds: seconds * part, rate: None };
    flow.run(&running, &order(WARM_UP_SECONDS))?;
    let outcome = flow.run(&running, &order(RUN_SECONDS))?;
    let mut add = |metric, value| tally.add(name, kind.name(), routers as u64, metric, value);
    add("per_second", outcome.arrived() / outcome.seconds);
    add("lost", outcome.lost());
    add("cpu_us_per_message", outcome.cpu_seconds * 1e6 / outcome.arrived());
    Ok(())
}
