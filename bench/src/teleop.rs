//! Measures driving a robot over a thin uplink while its camera sends three times the uplink's rate.
//!
//! Robot, router and desk are nodes of this process, so that one clock times all; the robot is in one network
//! namespace, the others in another, and the emulated uplink is between them. Each run has nodes and an uplink of its
//! own.

use std::path::Path;
use std::sync::atomic::{AtomicBool, AtomicU64, Ordering::SeqCst};
use std::sync::{Arc, LazyLock, Mutex, PoisonError};
use std::thread::{JoinHandle, sleep};
use std::time::{Duration, Instant};

use anyhow::{Context, Result};
use bytes::Bytes;
use serde::Serialize;
use sgc_node::config;
use sgc_testkit::FakeDomain;
use sgc_testkit::netsim::{Direction, Profile, QueueLimit};
use sgc_wire::{History, Qos, Reliability};

use crate::RunArgs;
use crate::fleet::BenchFleet;
use crate::node::{Listener, Node, Talker, wait};
use crate::report::{Report, Spread, Table, digits};
use crate::uplink::{self, FAR, Uplink};

/// Rate of the uplink, in bits per second.
const UPLINK_RATE: u64 = 5_000_000;
/// Rate of the way back, in bits per second.
const DOWNLINK_RATE: u64 = 20_000_000;
/// Bound of either queue.
const QUEUE: Duration = Duration::from_millis(200);
/// Delay in each direction.
const DELAYS: [Duration; 2] = [Duration::ZERO, Duration::from_millis(40)];
const PORT: u16 = 7447;
/// Time of flow before the measurement.
const WARM_UP: Duration = Duration::from_secs(3);
/// Time after the measurement for messages in flight.
const SETTLE: Duration = Duration::from_secs(2);
/// Offset of number and time of sending in a payload, behind the CDR encapsulation header.
const NUMBER_AT: usize = 4;
const STAMP_AT: usize = 12;

/// The zero of the time stamps.
static EPOCH: LazyLock<Instant> = LazyLock::new(Instant::now);

/// One of the three topics.
struct Topic {
    name: &'static str,
    /// Towards the robot.
    is_command: bool,
    is_camera: bool,
    priority: &'static str,
    per_second: u32,
    bytes: usize,
}

const TOPICS: [Topic; 3] = [
    Topic {
        name: "/cmd_vel",
        is_command: true,
        is_camera: false,
        priority: "realtime",
        per_second: 50,
        bytes: 64,
    },
    Topic {
        name: "/state",
        is_command: false,
        is_camera: false,
        priority: "default",
        per_second: 30,
        bytes: 700,
    },
    Topic {
        name: "/camera",
        is_command: false,
        is_camera: true,
        priority: "bulk",
        per_second: 30,
        bytes: 60_000,
    },
];

/// The result of a topic.
#[derive(Clone, Copy, Default, Serialize)]
struct Outcome {
    /// From publishing to the subscriber, milliseconds.
    age_ms: Spread,
    sent: usize,
    heard: usize,
    per_second: f64,
}

#[derive(Serialize)]
struct Figures {
    transport: String,
    delay_ms: u128,
    reliable: bool,
    loaded: bool,
    commands: Outcome,
    state: Outcome,
    camera: Outcome,
    /// Longest time that a packet waited at the uplink, in milliseconds.
    queue_ms_max: f64,
    /// Packets that the uplink dropped because its queue was full.
    overflowed: u64,
    uplink_mbit_per_second: f64,
}

/// Measures every transport.
pub(crate) fn run(args: &RunArgs) -> Result<Report> {
    LazyLock::force(&EPOCH);
    let time = Duration::from_secs(if args.quick { 3 } else { args.seconds });
    let mut figures = Vec::new();
    for scheme in uplink::known(&args.schemes) {
        for delay in DELAYS {
            for loaded in [false, true] {
                let measured = measure(&scheme, delay, loaded, args.reliable, time);
                let measured = measured.with_context(|| format!("{scheme}, {delay:?}, loaded: {loaded}"))?;
                eprintln!("{}", row(&measured).join(" | "));
                figures.push(measured);
            }
        }
    }
    let kind = if args.reliable { "reliable" } else { "best-effort" };
    let table = Table {
        title: format!(
            "Teleop over 5 Mbit/s with 200 ms of queue: 50 Hz × 64 B commands, 30 Hz × 700 B state ({kind}), 30 Hz × 60 KB camera"
        ),
        columns: vec![
            "transport",
            "one way, ms",
            "camera",
            "commands p50 / p99 / max, ms",
            "lost",
            "state p50 / p99 / max, ms",
            "lost",
            "frame age p50 / p99 / max, ms",
            "frames/s",
            "queue max, ms",
            "dropped by queue",
            "uplink, Mbit/s",
        ],
        rows: figures.iter().map(row).collect(),
    };
    Report::new(&figures, vec![table])
}

fn row(f: &Figures) -> Vec<String> {
    let spread = |s: &Spread| format!("{} / {} / {}", digits(s.p50), digits(s.p99), digits(s.max));
    let lost = |o: &Outcome| format!("{} of {}", o.sent.saturating_sub(o.heard), o.sent);
    let camera = |text: String| if f.loaded { text } else { String::new() };
    vec![
        f.transport.clone(),
        f.delay_ms.to_string(),
        if f.loaded { "on" } else { "off" }.into(),
        spread(&f.commands.age_ms),
        lost(&f.commands),
        spread(&f.state.age_ms),
        lost(&f.state),
        camera(spread(&f.camera.age_ms)),
        camera(digits(f.camera.per_second)),
        digits(f.queue_ms_max),
        f.overflowed.to_string(),
        digits(f.uplink_mbit_per_second),
    ]
}

fn measure(scheme: &str, delay: Duration, loaded: bool, reliable: bool, time: Duration) -> Result<Figures> {
    let profile =
        |rate| Profile { rate: Some(rate), queue: QueueLimit::Time(QUEUE), delay, ..Profile::default() };
    let uplink = Uplink::new([profile(UPLINK_RATE), profile(DOWNLINK_RATE)])?;
    let (fleet, dir) = (BenchFleet::new()?, tempfile::tempdir()?);
    let listen = format!("[router]\nlisten = [\"{scheme}://0.0.0.0:{PORT}\"]\n");
    let url = format!("\"{scheme}://{FAR}:{PORT}\"");
    let router = load(dir.path(), "router", "", &listen)?;
    let router = Node::start_in(&uplink.far, router, fleet.issue("router", true)?, None).context("router")?;
    let (near, far) = (FakeDomain::default(), FakeDomain::default());
    let node = |name: &str, robot_side: bool| {
        let sections = TOPICS.iter().map(|topic| {
            let (topic_name, priority) = (topic.name, topic.priority);
            if topic.is_command == robot_side {
                let other = if robot_side { "desk" } else { "robot" };
                format!("[[use]]\nfrom = \"{other}\"\ntopic = \"{topic_name}\"\n")
            } else {
                let other = if robot_side { "desk" } else { "robot" };
                format!(
                    "[[share]]\ntopic = \"{topic_name}\"\nto = [\"{other}\"]\npriority = \"{priority}\"\n"
                )
            }
        });
        load(dir.path(), name, &url, &sections.collect::<String>())
    };
    let desk = Node::start_in(&uplink.far, node("desk", false)?, fleet.issue("desk", false)?, Some(&far))?;
    let robot =
        Node::start_in(&uplink.near, node("robot", true)?, fleet.issue("robot", false)?, Some(&near))?;

    let mut flows = Vec::new();
    for topic in &TOPICS {
        let (from, to) = if topic.is_command { (&far, &near) } else { (&near, &far) };
        let flow = (loaded || !topic.is_camera).then(|| Flow::start(topic, reliable, from, to));
        flows.push(flow.transpose()?);
    }
    for flow in flows.iter().flatten() {
        wait(&format!("{} arrives", flow.name), || Ok(!flow.arrivals().is_empty()))?;
    }
    sleep(WARM_UP);
    let before = uplink.path.counters(Direction::Forth);
    let begun: Vec<_> = flows.iter().map(|flow| flow.as_ref().map_or(0, Flow::said)).collect();
    sleep(time);
    let ended: Vec<_> = flows.iter().map(|flow| flow.as_ref().map_or(0, Flow::said)).collect();
    let after = uplink.path.counters(Direction::Forth);
    sleep(SETTLE);
    let outcome = |n: usize| {
        let flow = flows[n].as_ref();
        flow.map(|flow| flow.outcome(begun[n], ended[n], time)).unwrap_or_default()
    };
    let bits = (after.passed_bytes - before.passed_bytes) as f64 * 8.0;
    let figures = Figures {
        transport: scheme.to_owned(),
        delay_ms: delay.as_millis(),
        reliable,
        loaded,
        commands: outcome(0),
        state: outcome(1),
        camera: outcome(2),
        queue_ms_max: after.queue_time_max.as_secs_f64() * 1e3,
        overflowed: after.overflowed - before.overflowed,
        uplink_mbit_per_second: bits / time.as_secs_f64() / 1e6,
    };
    drop(flows);
    drop((robot, desk, router));
    Ok(figures)
}

/// A configuration from its text, with everything that the node writes in `dir`.
fn load(dir: &Path, node: &str, routers: &str, rest: &str) -> Result<config::Config> {
    let text = format!(
        "identity = \"{node}.identity\"\n[admin]\nsocket = \"{node}.sock\"\n\
         [node]\nstate = \"{node}.state\"\nrouters = [{routers}]\n{rest}"
    );
    Ok(config::parse(&text, node, dir, &|_| None)?)
}

#[derive(Default)]
struct Exchange {
    said: AtomicU64,
    /// Number and age, milliseconds.
    arrivals: Mutex<Vec<(u64, f64)>>,
    ends: AtomicBool,
}

/// An application that publishes at its pace, and one that subscribes.
struct Flow {
    name: &'static str,
    exchange: Arc<Exchange>,
    talker: Option<JoinHandle<Result<()>>>,
    _listener: Listener,
}

impl Flow {
    fn start(topic: &'static Topic, reliable: bool, from: &FakeDomain, to: &FakeDomain) -> Result<Self> {
        let reliability =
            if reliable && !topic.is_camera { Reliability::Reliable } else { Reliability::BestEffort };
        let qos = Qos { reliability, history: History::KeepLast(5), ..Qos::default() };
        let exchange = Arc::<Exchange>::default();
        let hears = Arc::clone(&exchange);
        let listener = Listener::new(to, topic.name, qos.clone(), move |payload| {
            let now = EPOCH.elapsed();
            let word = |at: usize| payload.get(at..at + 8).and_then(|w| w.try_into().ok());
            let Some((number, stamp)) = word(NUMBER_AT).zip(word(STAMP_AT)) else { return };
            let sent = Duration::from_nanos(u64::from_le_bytes(stamp));
            let age = now.saturating_sub(sent).as_secs_f64() * 1e3;
            let mut arrivals = hears.arrivals.lock().unwrap_or_else(PoisonError::into_inner);
            arrivals.push((u64::from_le_bytes(number), age));
        })?;
        let talker = Talker::new(from, topic.name, qos)?;
        let its = Arc::clone(&exchange);
        let period = Duration::from_secs(1) / topic.per_second;
        let talker = std::thread::spawn(move || {
            let mut next = Instant::now();
            while !its.ends.load(SeqCst) {
                let number = its.said.load(SeqCst) + 1;
                let mut payload = vec![7; topic.bytes];
                payload[..NUMBER_AT].copy_from_slice(&[0, 1, 0, 0]);
                payload[NUMBER_AT..NUMBER_AT + 8].copy_from_slice(&number.to_le_bytes());
                let now = EPOCH.elapsed().as_nanos() as u64;
                payload[STAMP_AT..STAMP_AT + 8].copy_from_slice(&now.to_le_bytes());
                talker.say(Bytes::from(payload))?;
                its.said.store(number, SeqCst);
                // A delayed publisher keeps its pace and skips missed messages.
                next = (next + period).max(Instant::now());
                sleep(next - Instant::now().min(next));
            }
            Ok(())
        });
        Ok(Self { name: topic.name, exchange, talker: Some(talker), _listener: listener })
    }

    fn said(&self) -> u64 {
        self.exchange.said.load(SeqCst)
    }

    fn arrivals(&self) -> std::sync::MutexGuard<'_, Vec<(u64, f64)>> {
        self.exchange.arrivals.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// Summarises the messages from one number up to another.
    fn outcome(&self, from: u64, to: u64, time: Duration) -> Outcome {
        let arrivals = self.arrivals();
        let ages: Vec<_> = arrivals
            .iter()
            .filter(|(number, _)| (from + 1..=to).contains(number))
            .map(|(_, age)| *age)
            .collect();
        Outcome {
            sent: (to - from) as usize,
            heard: ages.len(),
            per_second: ages.len() as f64 / time.as_secs_f64(),
            age_ms: Spread::from_samples(ages),
        }
    }
}

impl Drop for Flow {
    fn drop(&mut self) {
        self.exchange.ends.store(true, SeqCst);
        if let Some(Ok(Err(error))) = self.talker.take().map(JoinHandle::join) {
            eprintln!("{}: {error}", self.name);
        }
    }
}
