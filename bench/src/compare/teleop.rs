//! Table `teleop`: driving a robot over a thin uplink while its camera sends three times the uplink's rate.
//!
//! The programs are those of every table, with the QoS that ROS 2 gives them by default: commands and state reliable,
//! the camera best effort as sensor data. Each system is configured as its users would for this, see [`PRIORITIES`] and
//! [`zenoh_tuning`].

use std::time::Duration;

use anyhow::{Context, Result};
use serde_json::{Value, json};
use sgc_testkit::netsim::{Direction, Profile, QueueLimit};

use super::lab::{Lab, PathKind, Side};
use super::program::Program;
use super::system::{Running, System, Topic};
use super::turns::abreast;
use super::{Compare, Figures};

/// Rate of the uplink, in bits per second.
const UPLINK_RATE: u64 = 5_000_000;
/// Rate of the way to the robot, in bits per second.
const DOWNLINK_RATE: u64 = 20_000_000;
/// Bound of either queue.
const QUEUE: Duration = Duration::from_millis(200);
/// Names for the report, and one way, in each direction.
const PATHS: [(&str, Duration); 2] = [("uplink", Duration::ZERO), ("uplink-40ms", Duration::from_millis(40))];

/// Flows before it is measured.
const WARM_UP_SECONDS: f64 = 3.0;
const SECONDS: f64 = 10.0;
const QUICK_SECONDS: f64 = 3.0;
/// How long a system may take until the first message is through.
const CONNECT_MAX: Duration = Duration::from_secs(30);
/// Nothing is under way any more when nothing has come for so long.
const QUIET_SECONDS: f64 = 3.0;
/// How much longer something may take than it says.
const SPARE: Duration = Duration::from_secs(60);

/// A flow at a rate of its own.
pub(crate) struct Flow {
    /// Prefix of its figures.
    pub(crate) figures: &'static str,
    pub(crate) topic: Topic,
    pub(crate) per_second: f64,
    pub(crate) bytes: usize,
}

const FLOWS: [Flow; 3] = [
    Flow {
        figures: "commands",
        topic: Topic { name: "/cmd_vel", towards: Side::Left, reliable: true },
        per_second: 50.0,
        bytes: 64,
    },
    Flow {
        figures: "state",
        topic: Topic { name: "/state", towards: Side::Right, reliable: true },
        per_second: 30.0,
        bytes: 700,
    },
    Flow {
        figures: "camera",
        topic: Topic { name: "/camera", towards: Side::Right, reliable: false },
        per_second: 30.0,
        bytes: 60_000,
    },
];

/// Priorities that users of SGC configure.
const PRIORITIES: &[(&str, &str)] = &[("/cmd_vel", "realtime"), ("/camera", "bulk")];

/// Returns settings for users of the Zenoh bridge: priorities of topics, small messages without batching, only as many
/// frames as the uplink carries (nine take 4.3 of its 5 Mbit/s; the user has to know the rate), and a short kernel
/// queue.
fn zenoh_tuning() -> Value {
    json!({
        "plugins": { "ros2dds": {
            "pub_priorities": ["/cmd_vel=1:express", "/state=2:express", "/camera=7"],
            "pub_max_frequencies": ["/camera=9"],
        }},
        "transport": { "link": { "tcp": { "so_sndbuf": 16384 } } },
    })
}

/// Measures it.
pub(crate) fn run(compare: &Compare, figures: &mut Figures) -> Result<()> {
    let systems = compare.configured(PRIORITIES, zenoh_tuning())?;
    for (name, delay) in PATHS {
        let kind = path(name, delay);
        if !compare.wants_path(&kind) {
            continue;
        }
        // Commands and state alone leave the machine idle; a camera has its time to itself.
        let turn = |system: &dyn System, with_camera| {
            let (name, path) = (system.name(), kind.name());
            let mut figures = Figures::default();
            if let Err(error) = measure(compare, kind, with_camera, system, &mut figures) {
                let camera = if with_camera { "with camera" } else { "without camera" };
                figures.leave_out(&format!("teleop {name} on {path}, {camera}"), format!("{error:#}"));
            }
            figures
        };
        compare.note(&format!("teleop, {name}, without camera: all systems"));
        let without = abreast(&systems, |system| turn(&**system, false));
        without.into_iter().for_each(|its| figures.append(its));
        for system in &systems {
            compare.note(&format!("teleop, {name}, with camera: {}", system.name()));
            figures.append(turn(&**system, true));
        }
    }
    Ok(())
}

fn path(name: &'static str, delay: Duration) -> PathKind {
    let profile =
        |rate| Profile { rate: Some(rate), queue: QueueLimit::Time(QUEUE), delay, ..Profile::default() };
    PathKind::Other(name, [profile(UPLINK_RATE), profile(DOWNLINK_RATE)])
}

fn measure(
    compare: &Compare,
    kind: PathKind,
    with_camera: bool,
    system: &dyn System,
    figures: &mut Figures,
) -> Result<()> {
    let lab = Lab::new(kind, compare.load())?;
    let flows: Vec<_> = FLOWS.iter().filter(|flow| with_camera || flow.topic.reliable).collect();
    let topics: Vec<_> = flows.iter().map(|flow| flow.topic.clone()).collect();
    let running = system.start(&lab, &topics)?;
    let seconds = if compare.is_quick() { QUICK_SECONDS } else { SECONDS };
    for (flow, outcome) in flows.iter().zip(drive(&lab, &running, &flows, seconds)?) {
        let mut push = |metric: &str, value| {
            let (at, metric) = (f64::from(u8::from(with_camera)), format!("{}_{metric}", flow.figures));
            figures.push("teleop", &system.name(), lab.kind.name(), at, &metric, value);
        };
        push("sent", outcome.sent as f64);
        push("lost", outcome.sent.saturating_sub(outcome.heard) as f64);
        push("per_second", outcome.heard as f64 / seconds);
        // Without messages there is no age.
        for (metric, age) in ["p50_us", "p99_us", "max_us"].into_iter().zip(outcome.age_us) {
            if outcome.heard > 0 {
                push(metric, age);
            }
        }
    }
    // The longest that a packet waited at the uplink, since the system was started.
    let path = lab.path.as_ref().context("an uplink without an emulator")?;
    let waited_us = path.counters(Direction::Forth).queue_time_max.as_secs_f64() * 1e6;
    let at = f64::from(u8::from(with_camera));
    figures.push("teleop", &system.name(), lab.kind.name(), at, "queue_max_us", waited_us);
    Ok(())
}

/// Lets flows go at the same time, for so long after a warm-up, and returns their results.
pub(crate) fn drive(lab: &Lab, running: &Running, flows: &[&Flow], seconds: f64) -> Result<Vec<Outcome>> {
    let mut programs = Vec::new();
    for flow in flows {
        let mut args = vec!["", "--topic", flow.topic.name];
        args.extend(flow.topic.reliable.then_some("--reliable"));
        let towards = flow.topic.towards;
        let mut start = |role, side| {
            args[0] = role;
            lab.load(running, side, &args)
        };
        let mut sink = start("sink", towards)?;
        sink.soon("up")?;
        programs.push((*flow, start("source", towards.other())?, sink));
    }
    for (flow, _, sink) in &mut programs {
        sink.until("connected", CONNECT_MAX).with_context(|| flow.topic.name)?;
    }
    for (flow, source, _) in &mut programs {
        for (run, seconds) in [(1, WARM_UP_SECONDS), (2, seconds)] {
            source.order(&json!({ "send": {
                "run": run, "size": flow.bytes, "count": u32::MAX, "seconds": seconds, "rate": flow.per_second,
            }}))?;
        }
    }
    let outcomes = programs
        .iter_mut()
        .map(|(flow, source, sink)| outcome(source, sink, seconds).with_context(|| flow.topic.name));
    outcomes.collect()
}

/// The result of a flow.
pub(crate) struct Outcome {
    /// Messages written.
    pub(crate) sent: u64,
    /// Messages that arrived.
    pub(crate) heard: u64,
    /// From before a message was written until it was taken: p50, p99, most, µs.
    pub(crate) age_us: [f64; 3],
}

fn outcome(source: &mut Program, sink: &mut Program, seconds: f64) -> Result<Outcome> {
    let most = Duration::from_secs_f64(WARM_UP_SECONDS + seconds) + SPARE;
    source.until("sent", most)?;
    let sent = source.until("sent", most)?["count"].as_u64().context("no count of what was sent")?;
    sink.order(&json!({ "count": { "run": 2, "last": sent, "quiet_seconds": QUIET_SECONDS } }))?;
    let counted = sink.until("counted", SPARE)?;
    let age = |n: usize| counted["age_us"][n].as_f64().context("no age");
    let heard = counted["received"][0].as_u64().context("no count of what came")?;
    Ok(Outcome { sent, heard, age_us: [age(0)?, age(1)?, age(2)?] })
}
