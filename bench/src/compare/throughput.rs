//! Table `throughput`: messages one way, as fast as they are taken, by their size; over the bare path.
//!
//! The topic is reliable and keeps all that is not acknowledged, so who writes waits for who is slow, as far as the system
//! hands that on; what is lost all the same is counted.

use anyhow::Result;

use super::flow::{Flow, FlowSpec, Order};
use super::lab::{Lab, PathKind, Side};
use super::plan::Breadth;
use super::system::{System, Topic};
use super::tally::Tally;
use super::{Compare, Figures, plan};

const TOPIC: &str = "/bench/flow";
/// Bytes of a message.
const SIZES: [usize; 4] = [100, 1000, 64 << 10, 1 << 20];
/// Seconds of a run, and of the one before, which does not count.
const RUN_SECONDS: f64 = 2.0;
const WARM_UP_SECONDS: f64 = 0.3;
/// The size that goals ask about: it alone is measured in every round, and of every variant.
const SIZE_ASKED: usize = 1000;
/// What a run sends at most, bytes, so that its end is not far behind its last write.
const RUN_BYTES_MAX: usize = 2 << 30;

/// Measures it.
pub(crate) fn run(compare: &Compare, figures: &mut Figures) -> Result<()> {
    let kind = PathKind::Bare;
    if !compare.wants_path(&kind) {
        return Ok(());
    }
    let mut tally = Tally::new("throughput");
    let why = "what a suite and what a transport costs at other sizes is in the rows of their own";
    let what = format!("throughput at other sizes than {SIZE_ASKED} B");
    let others = compare.systems_of(Breadth::Cross, &what, why, figures);
    let others: Vec<_> = others.into_iter().map(System::name).collect();
    for round in 0..compare.rounds() {
        for system in compare.systems().iter().filter(|system| round < plan::rounds(&kind, &system.name())) {
            let name = system.name();
            compare.note(&format!("throughput, round {round}: {name}"));
            let is_measured = |size| size == SIZE_ASKED || (round == 0 && others.contains(&name));
            for size in SIZES.into_iter().filter(|size| is_measured(*size)) {
                if let Err(error) = measure(compare, &**system, size, &mut tally) {
                    figures.leave_out(&format!("throughput {name} at {size} B"), format!("{error:#}"));
                }
            }
        }
    }
    tally.write(figures);
    Ok(())
}

/// Anew for each size, so that memory is that of the size.
fn measure(compare: &Compare, system: &dyn System, size: usize, tally: &mut Tally) -> Result<()> {
    let (kind, name) = (PathKind::Bare, system.name());
    let lab = Lab::new(kind, compare.load())?;
    let topics = [Topic { name: TOPIC, towards: Side::Right, reliable: true }];
    let running = system.start(&lab, &topics)?;
    let spec = FlowSpec { topic: TOPIC, from: Side::Left, readers: 1, reliable: true, depth: 0 };
    let mut flow = Flow::start(&lab, &running, &spec)?;
    let count = u32::try_from(RUN_BYTES_MAX / size).unwrap_or(u32::MAX);
    let part = if compare.is_quick() { 0.2 } else { 1.0 };
    let order = |seconds: f64| Order { size, count, seconds: seconds * part, rate: None };
    flow.run(&running, &order(WARM_UP_SECONDS))?;
    let outcome = flow.run(&running, &order(RUN_SECONDS))?;
    let mut add = |metric, value| tally.add(&name, kind.name(), size as u64, metric, value);
    add("per_second", outcome.arrived() / outcome.seconds);
    add("lost", outcome.lost());
    add("cpu_us_per_message", outcome.cpu_seconds * 1e6 / outcome.arrived());
    add("load_cpu_us_per_message", outcome.load_cpu_seconds * 1e6 / outcome.arrived());
    add("rss_bytes", running.rss_bytes().1 as f64);
    Ok(())
}
