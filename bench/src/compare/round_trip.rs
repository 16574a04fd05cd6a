//! Table `round-trip`: a message to the other place and back, by its size.
//!
//! Systems take turns in rounds. A round starts the system anew, and measures all sizes one after the other.

use std::collections::BTreeMap;
use std::time::Duration;

use anyhow::{Context, Result};
use serde_json::json;

use super::flow::CONNECT_MAX;
use super::lab::{Lab, PathKind, Side};
use super::system::{System, Topic};
use super::{Compare, Figures, tcp};
use crate::report::Spread;

const PING: &str = "/bench/ping";
const PONG: &str = "/bench/pong";
/// Bytes of a message.
const SIZES: [usize; 7] = [16, 100, 1000, 8 << 10, 64 << 10, 1 << 20, 13 << 20];
/// From where on a message is large: few are measured, and one is enough where the path is thin.
const LARGE_BYTES: usize = 1 << 20;
/// How much longer than it may take is waited for an answer.
const SPARE: Duration = Duration::from_secs(5);

/// Measures it.
pub(crate) fn run(compare: &Compare, figures: &mut Figures) -> Result<()> {
    for kind in [PathKind::Bare, PathKind::Paper, PathKind::Lossy] {
        if !compare.wants_path(&kind) {
            continue;
        }
        let sizes = sizes(&kind, compare.is_quick());
        let mut samples = BTreeMap::new();
        for round in 0..compare.rounds(&kind) {
            for system in compare.systems() {
                let name = system.name();
                compare.note(&format!("round trip, {}, round {round}: {name}", kind.name()));
                if let Err(error) = measure(compare, &kind, &**system, sizes, &mut samples) {
                    figures.leave_out(&format!("round-trip {name} on {}", kind.name()), format!("{error:#}"));
                }
            }
            if compare.wants(tcp::NAME) {
                compare.note(&format!("round trip, {}, round {round}: {}", kind.name(), tcp::NAME));
                if let Err(error) = measure_tcp(compare, &kind, sizes, &mut samples) {
                    figures.leave_out(&format!("round-trip tcp on {}", kind.name()), format!("{error:#}"));
                }
            }
        }
        for ((name, size), Sample { round_trips_us, lost }) in samples {
            let mut push =
                |metric, value| figures.push("round-trip", &name, kind.name(), size as f64, metric, value);
            push("lost", lost as f64);
            push("samples", round_trips_us.len() as f64);
            if !round_trips_us.is_empty() {
                let spread = Spread::of(round_trips_us);
                push("p50_us", spread.p50);
                push("p99_us", spread.p99);
                push("max_us", spread.max);
            }
        }
    }
    Ok(())
}

/// What is measured. A short run leaves out on thin paths what takes their time alone.
fn sizes(kind: &PathKind, quick: bool) -> &'static [usize] {
    match kind {
        PathKind::Bare => &SIZES,
        _ if quick => &SIZES[..3],
        _ => &SIZES,
    }
}

/// Samples by system and size.
pub(crate) type Samples = BTreeMap<(String, usize), Sample>;

/// What was measured of one size.
#[derive(Debug, Default)]
pub(crate) struct Sample {
    /// Each round trip, µs.
    pub(crate) round_trips_us: Vec<f64>,
    /// Messages that did not come back in time.
    pub(crate) lost: u64,
}

/// A turn of TCP.
fn measure_tcp(compare: &Compare, kind: &PathKind, sizes: &[usize], samples: &mut Samples) -> Result<()> {
    let lab = Lab::new(*kind, compare.load())?;
    let plans: Vec<_> = sizes.iter().map(|&size| (size, Plan::of(kind, size, compare.is_quick()))).collect();
    tcp::measure(&lab, &plans, |size, sample| {
        let of_size = samples.entry((tcp::NAME.to_owned(), size)).or_default();
        of_size.round_trips_us.extend(sample.round_trips_us);
    })
}

/// A turn of a system.
pub(crate) fn measure(
    compare: &Compare,
    kind: &PathKind,
    system: &dyn System,
    sizes: &[usize],
    samples: &mut Samples,
) -> Result<()> {
    let lab = Lab::new(*kind, compare.load())?;
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
    for &size in sizes {
        let plan = Plan::of(kind, size, compare.is_quick());
        ping.order(&json!({ "measure": {
            "size": size, "count": plan.count, "seconds": plan.seconds, "warm_up": plan.warm_up,
            "patience_seconds": plan.patience.as_secs_f64(),
        }}))?;
        let most = plan.patience * (1 + plan.warm_up as u32) + Duration::from_secs_f64(plan.seconds) + SPARE;
        let measured = ping.until("measured", most)?;
        let sample = samples.entry((system.name(), size)).or_default();
        let round_trips = measured["round_trips_us"].as_array().context("no round trips")?;
        sample.round_trips_us.extend(round_trips.iter().filter_map(serde_json::Value::as_f64));
        let lost = measured["lost"].as_u64().context("no count of what was lost")?;
        sample.lost += lost;
        if lost > 0 && size >= LARGE_BYTES {
            // What was given up still fills the path.
            break;
        }
    }
    Ok(())
}

/// How one size is measured.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Plan {
    /// At most so many that count.
    pub(crate) count: usize,
    /// None begins after so long.
    pub(crate) seconds: f64,
    /// How many come first and do not count.
    pub(crate) warm_up: usize,
    /// How long each is waited for.
    pub(crate) patience: Duration,
}

impl Plan {
    fn of(kind: &PathKind, size: usize, quick: bool) -> Self {
        let is_large = size >= LARGE_BYTES;
        let (count, seconds, warm_up, patience): (usize, f64, usize, u64) = match kind {
            PathKind::Bare if is_large => (60, 3.0, 2, 20),
            PathKind::Bare => (3000, 2.0, 50, 5),
            _ if is_large => (3, 1.0, 0, 150),
            _ => (200, 6.0, 2, 10),
        };
        let (count, seconds) = if quick { (count.min(100), seconds.min(0.5)) } else { (count, seconds) };
        Self { count, seconds, warm_up, patience: Duration::from_secs(patience) }
    }
}
