//! Tables `rmw-zenoh` and `rmw-zenoh-idle`: programs of rmw_zenoh natively, and through SGC.
//!
//! Programs have the settings and QoS of rmw_zenoh and ROS 2. Systems take turns in rounds, and each measurement starts
//! places, system and programs anew. Idle processes are a table of their own, so that builds of `sgc` can be compared.

use std::collections::BTreeMap;
use std::time::Duration;

use anyhow::{Context, Result};
use sgc_testkit::netsim::{Profile, QueueLimit};

use super::footprint::{self, stripped_bytes, without_topics};
use super::lab::{Lab, PathKind, Side};
use super::system::{System, Topic};
use super::tally::Tally;
use super::teleop::{self, Flow};
use super::turns::abreast;
use super::{Compare, Figures, round_trip, throughput};

/// The table as `--only` names it. Figures of throughput have the same name.
pub(crate) const TABLE: &str = "rmw-zenoh";
/// Figures of messages there and back.
pub(crate) const ROUND_TRIP: &str = "rmw-zenoh-round-trip";
/// Figures of commands beside a camera.
pub(crate) const TELEOP: &str = "rmw-zenoh-teleop";
/// The table of idle processes.
pub(crate) const IDLE: &str = "rmw-zenoh-idle";

/// Bytes of a message there and back.
const SIZES: [usize; 5] = [16, 1000, 8 << 10, 64 << 10, 1 << 20];
/// Bytes of a message that goes one way.
const FLOW_BYTES: usize = 1000;

/// Rate of the uplink, in bits per second.
const UPLINK_RATE: u64 = 2_000_000;
/// Rate of the other direction, in bits per second.
const DOWNLINK_RATE: u64 = 20_000_000;
/// Bound of either queue.
const QUEUE: Duration = Duration::from_millis(200);
pub(crate) const UPLINK: &str = "uplink-2";
const SECONDS: f64 = 10.0;
const QUICK_SECONDS: f64 = 3.0;

/// Commands and a camera that go the same way, over the uplink. Both are best effort.
const FLOWS: [Flow; 2] = [
    Flow {
        figures: "commands",
        topic: Topic { name: "/cmd_vel", towards: Side::Right, reliable: false },
        per_second: 50.0,
        bytes: 64,
    },
    Flow {
        figures: "camera",
        topic: Topic { name: "/camera", towards: Side::Right, reliable: false },
        per_second: 30.0,
        bytes: 60_000,
    },
];

/// Priorities that users of SGC configure. rmw_zenoh has no such setting.
const PRIORITIES: &[(&str, &str)] = &[("/cmd_vel", "realtime"), ("/camera", "bulk")];

/// Systems whose last process is measured while it is idle: a Zenoh router, and proxies.
const IDLE_SYSTEMS: [&str; 3] = ["rmw-zenoh-two-routers", "sgc-dds-dds", "sgc-zenoh-zenoh"];

/// Measures round trips, throughput and commands.
pub(crate) fn run(compare: &Compare, figures: &mut Figures) -> Result<()> {
    let systems = compare.with_rmw_zenoh(PRIORITIES)?;
    if compare.wants_path(&PathKind::Bare) {
        let mut samples = BTreeMap::new();
        for (round, system) in turns(compare, &systems) {
            compare.note(&format!("{ROUND_TRIP}, round {round}: {}", system.name()));
            let measured = round_trip::measure(compare, &PathKind::Bare, system, &SIZES, &mut samples);
            leave_out(figures, ROUND_TRIP, system, measured);
        }
        round_trip::push(samples, ROUND_TRIP, PathKind::Bare.name(), figures);
        let mut tally = Tally::new(TABLE);
        for (round, system) in turns(compare, &systems) {
            compare.note(&format!("{TABLE}, round {round}: {}", system.name()));
            let measured = throughput::measure(compare, system, FLOW_BYTES, &mut tally);
            leave_out(figures, TABLE, system, measured);
        }
        tally.write(figures);
    }
    if compare.wants_path(&uplink()) {
        let mut tally = Tally::new(TELEOP);
        for (round, system) in turns(compare, &systems) {
            // Without a path it has no uplink.
            if system.name() != "rmw-zenoh-one-host" {
                compare.note(&format!("{TELEOP}, round {round}: {}", system.name()));
                leave_out(figures, TELEOP, system, commands(compare, system, &mut tally));
            }
        }
        tally.write(figures);
    }
    Ok(())
}

/// Measures idle processes, and the size of the program.
pub(crate) fn run_idle(compare: &Compare, figures: &mut Figures) -> Result<()> {
    let program = compare.sgc();
    let bytes = stripped_bytes(program).with_context(|| program.display().to_string())?;
    figures.push(IDLE, "sgc", "program", 0.0, "program_bytes", bytes as f64);
    let idle = if compare.is_quick() { footprint::IDLE_QUICK } else { footprint::IDLE };
    compare.note(IDLE);
    let systems = compare.with_rmw_zenoh(PRIORITIES)?;
    let systems = systems.iter().filter(|system| IDLE_SYSTEMS.contains(&&*system.name()));
    let measured = abreast(systems, |system| {
        let mut figures = Figures::default();
        let measured = without_topics(compare, IDLE, &**system, idle, &mut figures);
        leave_out(&mut figures, IDLE, &**system, measured);
        figures
    });
    measured.into_iter().for_each(|its| figures.append(its));
    Ok(())
}

/// The systems of all rounds, one after the other.
fn turns<'a>(
    compare: &Compare,
    systems: &'a [Box<dyn System>],
) -> impl Iterator<Item = (usize, &'a dyn System)> {
    let rounds = 0..compare.rounds();
    rounds.flat_map(move |round| systems.iter().map(move |system| (round, &**system)))
}

fn leave_out(figures: &mut Figures, table: &str, system: &dyn System, measured: Result<()>) {
    if let Err(error) = measured {
        figures.leave_out(&format!("{table} {}", system.name()), format!("{error:#}"));
    }
}

fn uplink() -> PathKind {
    let profile = |rate| Profile { rate: Some(rate), queue: QueueLimit::Time(QUEUE), ..Profile::default() };
    PathKind::Other(UPLINK, [profile(UPLINK_RATE), profile(DOWNLINK_RATE)])
}

fn commands(compare: &Compare, system: &dyn System, tally: &mut Tally) -> Result<()> {
    let lab = Lab::new(uplink(), compare.load())?;
    let running = system.start(&lab, &FLOWS.each_ref().map(|flow| flow.topic.clone()))?;
    let seconds = if compare.is_quick() { QUICK_SECONDS } else { SECONDS };
    let name = system.name();
    let mut add = |metric, value| tally.add(&name, UPLINK, 0, metric, value);
    let [commands, camera] = <[_; 2]>::try_from(teleop::drive(&lab, &running, &FLOWS.each_ref(), seconds)?)
        .map_err(|_| anyhow::anyhow!("another number of flows"))?;
    add("commands_received_percent", commands.heard as f64 * 100.0 / commands.sent as f64);
    if commands.heard > 0 {
        add("commands_p50_us", commands.age_us[0]);
        add("commands_p99_us", commands.age_us[1]);
        add("commands_max_us", commands.age_us[2]);
    }
    add("camera_per_second", camera.heard as f64 / seconds);
    if camera.heard > 0 {
        add("camera_p50_us", camera.age_us[0]);
        add("camera_p99_us", camera.age_us[1]);
    }
    // From their start on.
    add("cpu_seconds", running.cpu_seconds());
    Ok(())
}
