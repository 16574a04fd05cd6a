//! Table `round-trip`: a message to the other place and back, by its size.
//!
//! Systems take turns in rounds. A turn starts the system anew, and measures all sizes one after the other; on thin
//! paths several have theirs at the same time.

use std::collections::BTreeMap;
use std::time::Duration;

use anyhow::{Context, Result};
use serde_json::json;

use super::flow::CONNECT_MAX;
use super::lab::{Lab, PathKind, Side};
use super::plan::Breadth;
use super::program::Program;
use super::sample::{LARGE_BYTES, Plan, Sample};
use super::system::{Running, System, Topic};
use super::turns::by_stages;
use super::{Compare, Figures, plan, tcp};
use crate::report::Spread;

const PING: &str = "/bench/ping";
const PONG: &str = "/bench/pong";
/// The metric of a size that never came back: the length of the wait in µs.
pub(crate) const GAVE_UP: &str = "gave_up_us";
/// Bytes of a message.
const SIZES: [usize; 7] = [16, 100, 1000, 8 << 10, 64 << 10, 1 << 20, 13 << 20];
/// How much longer than it may take is waited for an answer.
const SPARE: Duration = Duration::from_secs(5);

/// Measures it.
pub(crate) fn run(compare: &Compare, figures: &mut Figures) -> Result<()> {
    for kind in [PathKind::Bare, PathKind::Paper, PathKind::Lossy] {
        if !compare.wants_path(&kind) {
            continue;
        }
        let sizes = sizes(&kind, compare.is_quick());
        let breadth = if matches!(kind, PathKind::Bare) { Breadth::Whole } else { Breadth::Cross };
        let why = "the path says how long it takes there, and hardly the suite";
        let systems = compare.systems_of(breadth, &format!("round-trip on {}", kind.name()), why, figures);
        // Gathering is for rates.
        let is_in = |relay: &&dyn System| matches!(kind, PathKind::Bare) || relay.name() == plan::RELAY;
        let relays = compare.relays().iter().map(|relay| &**relay).filter(is_in);
        let mut who: Vec<_> = systems.into_iter().chain(relays).map(Who::System).collect();
        who.extend(compare.wants(tcp::NAME).then_some(Who::Tcp));
        let mut samples = BTreeMap::new();
        for round in 0..compare.rounds() {
            let its = who.iter().copied().filter(|who| round < plan::rounds(&kind, &who.name())).collect();
            for together in plan::together(&kind, its, Who::name) {
                let names: Vec<_> = together.iter().map(Who::name).collect();
                compare.note(&format!("round trip, {}, round {round}: {}", kind.name(), names.join(", ")));
                let turns = by_stages(
                    &together,
                    sizes,
                    |who| Turn::start(compare, &kind, who),
                    |turn, size| turn.measure(size, &Plan::for_path(&kind, size, compare.is_quick())),
                );
                for (name, turn) in names.into_iter().zip(turns) {
                    add(&mut samples, &name, sizes, turn.stages);
                    if let Some(error) = turn.error {
                        figures.leave_out(
                            &format!("round-trip {name} on {}", kind.name()),
                            format!("{error:#}"),
                        );
                    }
                }
            }
        }
        push(samples, "round-trip", kind.name(), figures);
    }
    Ok(())
}

/// Returns the measured sizes. A short run skips sizes that take long on thin paths.
fn sizes(kind: &PathKind, quick: bool) -> &'static [usize] {
    match kind {
        PathKind::Bare => &SIZES,
        _ if quick => &SIZES[..3],
        _ => &SIZES,
    }
}

/// Writes the figures of samples down.
pub(crate) fn push(samples: Samples, table: &str, path: &str, figures: &mut Figures) {
    for ((name, size), Sample { round_trips_us, lost, patience }) in samples {
        let mut push = |metric, value| figures.push(table, &name, path, size as f64, metric, value);
        push("lost", lost as f64);
        push("samples", round_trips_us.len() as f64);
        if !round_trips_us.is_empty() {
            let spread = Spread::from_samples(round_trips_us);
            push("p50_us", spread.p50);
            push("p99_us", spread.p99);
            push("max_us", spread.max);
        } else if lost > 0 {
            push(GAVE_UP, patience.as_secs_f64() * 1e6);
        }
    }
}

/// Samples by system and size.
pub(crate) type Samples = BTreeMap<(String, usize), Sample>;

/// Adds what was measured of these sizes, as far as it came.
fn add(samples: &mut Samples, name: &str, sizes: &[usize], measured: Vec<Sample>) {
    for (&size, sample) in sizes.iter().zip(measured) {
        let of_size = samples.entry((name.to_owned(), size)).or_default();
        of_size.round_trips_us.extend(sample.round_trips_us);
        of_size.lost += sample.lost;
        of_size.patience = sample.patience;
    }
}

/// The participants of the rounds.
#[derive(Clone, Copy)]
enum Who<'a> {
    System(&'a dyn System),
    Tcp,
}

impl Who<'_> {
    fn name(&self) -> String {
        match self {
            Self::System(system) => system.name(),
            Self::Tcp => tcp::NAME.to_owned(),
        }
    }
}

/// A turn. Fields go in this order.
struct Turn {
    ends: Ends,
    _lab: Lab,
}

#[expect(clippy::large_enum_variant, reason = "there are a few at a time")]
enum Ends {
    Programs { ping: Program, _pong: Program, _running: Running },
    Tcp(tcp::Tcp),
}

impl Turn {
    fn start(compare: &Compare, kind: &PathKind, who: Who<'_>) -> Result<Self> {
        let lab = Lab::new(*kind, compare.load())?;
        let Who::System(system) = who else {
            return Ok(Self { ends: Ends::Tcp(tcp::Tcp::connect(&lab)?), _lab: lab });
        };
        let topics = [
            Topic { name: PING, towards: Side::Right, reliable: true },
            Topic { name: PONG, towards: Side::Left, reliable: true },
        ];
        let running = system.start(&lab, &topics)?;
        let args = ["--topic", PING, "--back", PONG, "--reliable"];
        let mut pong = lab.load(&running, Side::Right, &[&["pong"][..], &args].concat())?;
        pong.soon("up")?;
        let mut ping = lab.load(&running, Side::Left, &[&["ping"][..], &args].concat())?;
        ping.until("connected", CONNECT_MAX)?;
        Ok(Self { ends: Ends::Programs { ping, _pong: pong, _running: running }, _lab: lab })
    }

    /// One size; itself, unless there is no going on.
    fn measure(mut self, size: usize, plan: &Plan) -> Result<(Sample, Option<Self>)> {
        let ping = match &mut self.ends {
            Ends::Tcp(tcp) => return Ok((tcp.measure(size, plan)?, Some(self))),
            Ends::Programs { ping, .. } => ping,
        };
        ping.order(&json!({ "measure": {
            "size": size, "count": plan.count, "seconds": plan.seconds, "warm_up": plan.warm_up,
            "patience_seconds": plan.patience.as_secs_f64(),
        }}))?;
        let most = plan.patience * (1 + plan.warm_up as u32) + Duration::from_secs_f64(plan.seconds) + SPARE;
        let measured = ping.until("measured", most)?;
        let round_trips = measured["round_trips_us"].as_array().context("no round trips")?;
        let round_trips_us = round_trips.iter().filter_map(serde_json::Value::as_f64).collect();
        let lost = measured["lost"].as_u64().context("no count of what was lost")?;
        // Abandoned messages still fill the path.
        let goes_on = lost == 0 || size < LARGE_BYTES;
        Ok((Sample { round_trips_us, lost, patience: plan.patience }, goes_on.then_some(self)))
    }
}

/// A turn of a system by itself.
pub(crate) fn measure(
    compare: &Compare,
    kind: &PathKind,
    system: &dyn System,
    sizes: &[usize],
    samples: &mut Samples,
) -> Result<()> {
    let mut turn = Some(Turn::start(compare, kind, Who::System(system))?);
    for &size in sizes {
        let Some(going) = turn.take() else { break };
        let (sample, after) = going.measure(size, &Plan::for_path(kind, size, compare.is_quick()))?;
        add(samples, &system.name(), &[size], vec![sample]);
        turn = after;
    }
    Ok(())
}
