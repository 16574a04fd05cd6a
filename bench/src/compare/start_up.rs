//! Table `start-up`: how long it takes until something is known, and until a first message comes, at a router that
//! knows much, and for an application by every system.
//!
//! `sgc-router` by the names that it knows; the other systems with nothing but the one topic.

use std::time::{Duration, Instant};

use anyhow::Result;
use sgc_trust::Suite;

use super::lab::{Lab, PathKind, Side};
use super::plan::Breadth;
use super::system::{System, Topic};
use super::{Compare, Figures};
use crate::fleet::BenchFleet;
use crate::process::SgcRouter;
use crate::report::Spread;
use crate::rib::{LinkedOwners, Neighbour};

const TABLE: &str = "start-up";
/// Names that the router knows.
const RECORDS: [usize; 3] = [10_000, 100_000, 1_000_000];
const TOPIC: &str = "/bench/first";
/// How often an application is started.
const STARTS: usize = 3;
/// How long an application may wait for its first message.
const CONNECT_MAX: Duration = Duration::from_secs(60);

/// Measures it.
pub(crate) fn run(compare: &Compare, figures: &mut Figures) -> Result<()> {
    let is_quick = compare.is_quick();
    for records in RECORDS.into_iter().filter(|n| !is_quick || *n == RECORDS[0]) {
        compare.note(&format!("start-up, {records} records"));
        if let Err(error) = router(compare, records, figures) {
            figures.leave_out(&format!("start-up with {records} records"), format!("{error:#}"));
        }
    }
    let starts = if is_quick { 1 } else { STARTS };
    let why = "what they differ in is in the rows of their own";
    let systems = compare.systems_of(Breadth::Cross, "start-up of an application", why, figures);
    for system in systems {
        compare.note(&format!("start-up, {}", system.name()));
        match application(compare, system, starts) {
            Ok(times) => {
                let spread = Spread::from_samples(times);
                figures.push(
                    TABLE,
                    &system.name(),
                    "bare",
                    0.0,
                    "application_first_message_p50_us",
                    spread.p50,
                );
                figures.push(
                    TABLE,
                    &system.name(),
                    "bare",
                    0.0,
                    "application_first_message_max_us",
                    spread.max,
                );
            }
            Err(error) => figures.leave_out(&format!("start-up {}", system.name()), format!("{error:#}")),
        }
    }
    Ok(())
}

/// A router, owners of so many names, and another router that hears of them.
fn router(compare: &Compare, records: usize, figures: &mut Figures) -> Result<()> {
    let (adverts, starts) = if compare.is_quick() { (10, 3) } else { (200, 20) };
    let (fleet, dir) = (BenchFleet::new()?, tempfile::tempdir()?);
    fleet.write_router(dir.path())?;
    let us = |begun: Instant| begun.elapsed().as_secs_f64() * 1e6;
    let mut push =
        |metric, value| figures.push(TABLE, "sgc-router", "records", records as f64, metric, value);

    let begun = Instant::now();
    let router = SgcRouter::start(compare.sgc(), dir.path())?;
    push("ready_us", us(begun));
    let mut owners = LinkedOwners::prepare(&router.url, &fleet, records)?;
    let known = router.routed_names()?;
    let begun = Instant::now();
    owners.advertise_all()?;
    router.until_routed(known + records as u64)?;
    push("all_known_us", us(begun));
    let begun = Instant::now();
    let mut neighbour = Neighbour::connect(&router.url, &fleet)?;
    neighbour.hears(records)?;
    push("neighbour_knows_all_us", us(begun));
    let mut each = Vec::new();
    for _ in 0..adverts {
        let begun = Instant::now();
        owners.advertise_one()?;
        neighbour.hears(1)?;
        each.push(us(begun));
    }
    let each = Spread::from_samples(each);
    push("advert_known_p50_us", each.p50);
    push("advert_known_p99_us", each.p99);
    let first =
        crate::first_message::latched_after_link_ms(&router, &fleet, dir.path(), Suite::Standard, starts)?;
    push("first_message_p50_us", first.p50 * 1e3);
    push("first_message_max_us", first.max * 1e3);
    Ok(())
}

/// From the start of an application that publishes to its first message at one that waits, several times over, µs. The
/// system is up.
fn application(compare: &Compare, system: &dyn System, starts: usize) -> Result<Vec<f64>> {
    let mut all = Vec::new();
    for _ in 0..starts {
        let lab = Lab::new(PathKind::Bare, compare.load())?;
        let topics = [Topic { name: TOPIC, towards: Side::Right, reliable: true }];
        let running = system.start(&lab, &topics)?;
        let args = |role| [role, "--topic", TOPIC, "--reliable"];
        let mut sink = lab.load(&running, Side::Right, &args("sink"))?;
        sink.soon("up")?;
        let begun = Instant::now();
        let _source = lab.load(&running, Side::Left, &args("source"))?;
        sink.until("connected", CONNECT_MAX)?;
        all.push(begun.elapsed().as_secs_f64() * 1e6);
    }
    Ok(all)
}
