//! Table `throughput`: messages one way, as fast as they are taken, by their size; over the bare path.
//!
//! The topic is reliable and keeps all that is not acknowledged, so who writes waits for who is slow, as far as the
//! system hands that on; what is lost all the same is counted.

use anyhow::Result;

use super::flow::{Flow, FlowSpec, Order, Outcome};
use super::lab::{Lab, PathKind, Side};
use super::plan::Breadth;
use super::system::{System, Topic};
use super::tally::{Round, Tally};
use super::{Compare, Figures, plan};

const TOPIC: &str = "/bench/flow";
/// Bytes of a message.
const SIZES: [usize; 4] = [100, 1000, 64 << 10, 1 << 20];
/// Seconds of a run, and of the one before, which does not count.
const RUN_SECONDS: f64 = 2.0;
const WARM_UP_SECONDS: f64 = 0.3;
/// The size that goals ask about: it alone is measured in every round, and of every variant.
const SIZE_ASKED: usize = 1000;
/// The system and size that show a router's processor time.
const ROUTED: (&str, usize) = ("sgc-quic-group-router", 64 << 10);
/// Most bytes that a run sends, so that its end soon follows its last write.
const RUN_BYTES_MAX: usize = 2 << 30;

/// Measures it.
pub(crate) fn run(compare: &Compare, figures: &mut Figures) -> Result<()> {
    let why = "what a suite and what a transport costs at other sizes is in the rows of their own";
    let what = format!("throughput at other sizes than {SIZE_ASKED} B");
    let others = compare.systems_of(Breadth::Cross, &what, why, figures);
    let relays = compare.relays();
    let others: Vec<_> = others.into_iter().chain(relays.iter().map(|r| &**r)).map(System::name).collect();
    Round::all(compare, figures, "throughput", compare.rounds(), |round| {
        let number = round.number;
        let has_turn = |name: &str| number < plan::rounds(&PathKind::Bare, name);
        for system in compare.systems().iter().chain(relays).filter(|system| has_turn(&system.name())) {
            let name = system.name();
            let is_measured = |size| {
                size == SIZE_ASKED || (number == 0 && (others.contains(&name) || ROUTED == (&name, size)))
            };
            for size in SIZES.into_iter().filter(|size| is_measured(*size)) {
                let what = format!("{name} at {size} B");
                round.measure(&what, |tally| measure(compare, &**system, size, tally));
            }
        }
    });
    Ok(())
}

/// Measures a run over the bare path through a system that is started anew, so that memory is that of the size.
pub(crate) fn measure(compare: &Compare, system: &dyn System, size: usize, tally: &mut Tally) -> Result<()> {
    let (kind, name) = (PathKind::Bare, system.name());
    let (outcome, rss_bytes) = one_way(compare, system, size)?;
    let mut add = |metric, value| tally.add(&name, kind.name(), size as u64, metric, value);
    add("per_second", outcome.arrived() / outcome.seconds);
    add("lost", outcome.lost());
    add("cpu_us_per_message", outcome.cpu_seconds * 1e6 / outcome.arrived());
    add("load_cpu_us_per_message", outcome.load_cpu_seconds * 1e6 / outcome.arrived());
    add("rss_bytes", rss_bytes as f64);
    Ok(())
}

/// Returns the outcome of a run and the resident memory behind it, bytes.
pub(crate) fn one_way(compare: &Compare, system: &dyn System, size: usize) -> Result<(Outcome, u64)> {
    let lab = Lab::new(PathKind::Bare, compare.load())?;
    let running = system.start(&lab, &[Topic { name: TOPIC, towards: Side::Right, reliable: true }])?;
    let spec = FlowSpec { topic: TOPIC, from: Side::Left, readers: 1, reliable: true, depth: 0 };
    let mut flow = Flow::start(&lab, &running, &spec)?;
    let count = u32::try_from(RUN_BYTES_MAX / size).unwrap_or(u32::MAX);
    let part = if compare.is_quick() { 0.2 } else { 1.0 };
    let order = |seconds: f64| Order { size, count, seconds: seconds * part, rate: None };
    flow.run(&running, &order(WARM_UP_SECONDS))?;
    let outcome = flow.run(&running, &order(RUN_SECONDS))?;
    Ok((outcome, running.rss_bytes().1))
}
