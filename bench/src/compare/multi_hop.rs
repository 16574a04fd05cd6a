//! Table `multi-hop`: round trips and throughput of `sgc` with one router after the other between the two places, all
//! routers at the right one.

use std::collections::BTreeMap;

use anyhow::Result;

use super::lab::PathKind;
use super::sample::Sample;
use super::system::Sgc;
use super::tally::{Round, Tally};
use super::{Compare, Figures, round_trip, throughput};

/// Routers in a row; without one the right proxy is dialled, which is where counting begins.
const ROUTERS: std::ops::RangeInclusive<usize> = 0..=5;
const SUITES: [&str; 2] = ["group", "standard"];
const BYTES: usize = 1000;

/// Measures it.
pub(crate) fn run(compare: &Compare, figures: &mut Figures) -> Result<()> {
    // One round: no goal asks.
    Round::all(compare, figures, "multi-hop", 1, |round| {
        for suite in SUITES {
            let name = format!("sgc-quic-{suite}");
            for routers in ROUTERS.filter(|_| compare.wants(&name)) {
                let what = format!("{name} over {routers}");
                round.measure(&what, |tally| measure(compare, suite, routers, &name, tally));
            }
        }
    });
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
    for Sample { round_trips_us, .. } in samples.into_values() {
        let spread = crate::report::Spread::from_samples(round_trips_us);
        tally.add(name, kind.name(), routers as u64, "p50_us", spread.p50);
        tally.add(name, kind.name(), routers as u64, "p99_us", spread.p99);
        tally.add(name, kind.name(), routers as u64, "max_us", spread.max);
    }
    let (outcome, _) = throughput::one_way(compare, &system, BYTES)?;
    let mut add = |metric, value| tally.add(name, kind.name(), routers as u64, metric, value);
    add("per_second", outcome.arrived() / outcome.seconds);
    add("lost", outcome.lost());
    add("cpu_us_per_message", outcome.cpu_seconds * 1e6 / outcome.arrived());
    Ok(())
}
