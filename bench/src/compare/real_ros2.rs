//! Table `real-ros2`: programs of real ROS 2 with stock Fast DDS, one distribution at the left and another at the
//! right.
//!
//! The programs are the C load generator on `rcl` of `tests/peers/ros2`. Each measurement starts the places, the system
//! and the programs anew, since a system may keep something of programs that have gone: that has a row of its own, the
//! restart.

use std::path::{Path, PathBuf};
use std::time::Duration;

use anyhow::{Context, Result, ensure};
use serde::Deserialize;

use super::lab::{Lab, PathKind, Side};
use super::program::Program;
use super::system::{Dds, Running, System, Topic};
use super::{Compare, Figures};

/// The table as `--only` names it. Figures of messages at a rate have the same name.
pub(crate) const TABLE: &str = "real-ros2";
/// Figures of publishers that keep all and write without a pause.
pub(crate) const KEEP_ALL: &str = "real-ros2-keep-all";
/// Figures of messages there and back.
pub(crate) const ROUND_TRIP: &str = "real-ros2-round-trip";
/// Figures of programs that are ended and started anew.
pub(crate) const RESTART: &str = "real-ros2-restart";
/// Both programs at one place, where Fast DDS takes shared memory.
pub(crate) const ONE_HOST: &str = "one-host";

/// The distributions at the left and at the right, by the name that figures have for their path.
const PAIRS: [(&str, [&str; 2]); 2] =
    [(JAZZY_KILTED, ["jazzy", "kilted"]), (KILTED_JAZZY, ["kilted", "jazzy"])];
/// The publisher is of Jazzy, the subscriber of Kilted.
pub(crate) const JAZZY_KILTED: &str = "jazzy-kilted";
/// The publisher is of Kilted, the subscriber of Jazzy.
pub(crate) const KILTED_JAZZY: &str = "kilted-jazzy";
/// The systems of the table: those that goals compare, and relays, which show the least that two programs between take.
const SYSTEMS: [&str; 7] = [
    "direct",
    "zenoh-tcp",
    "sgc-quic-group",
    "sgc-quic-pairwise",
    "sgc-quic-standard",
    "relay",
    "relay-gathers",
];

const TOPIC: &str = "/load";
const BACK: &str = "/load_back";
const TOPICS: [Topic; 2] = [
    Topic { name: TOPIC, towards: Side::Right, reliable: true },
    Topic { name: BACK, towards: Side::Left, reliable: true },
];
/// Bytes of a message that goes one way.
const FLOW_BYTES: usize = 1000;
/// The history of ROS 2's default QoS, messages.
const DEFAULT_DEPTH: u32 = 10;
/// Messages a second.
const RATES: [u32; 3] = [2_000, 5_000, 20_000];
const RATE_SECONDS: f64 = 4.0;
const QUICK_RATE_SECONDS: f64 = 0.3;
/// Messages of a publisher that keeps all.
const KEEP_ALL_COUNT: u32 = 150_000;
const QUICK_KEEP_ALL_COUNT: u32 = 3_000;
/// Bytes of a message there and back, and how many there are; 24 B are the least that the programs send.
const ROUND_TRIPS: [(usize, u32); 5] =
    [(24, 2_000), (1000, 2_000), (8 << 10, 2_000), (64 << 10, 600), (1 << 20, 60)];
const QUICK_ROUND_TRIPS: u32 = 20;
/// Runs of the restart, the first included.
const RESTART_RUNS: u32 = 3;
const RESTART_RATE: u32 = 500;
const RESTART_COUNT: u32 = 1_000;
const QUICK_RESTART_COUNT: u32 = 100;

/// A pause after the first message, so that nothing that is set up by it is in the rate.
const BEGIN_SECONDS: f64 = 0.5;
/// A publisher's life after its last message, so that its end is not what loses messages.
const HOLD_SECONDS: f64 = 1.0;
/// A subscriber listens on for so long after the last message, for what comes twice.
const LINGER_SECONDS: f64 = 0.3;
/// A publisher gives up after so long, and then waits at most so long for acknowledgements.
const PUBLISHER_SECONDS: u64 = 40;
const ACKNOWLEDGED_SECONDS: u64 = 20;
/// Round trips of one size end after so long.
const PING_SECONDS: u64 = 25;
/// Longer than a subscriber ever lives here.
const SUBSCRIBER_SECONDS: u64 = 120;
/// The subscriber is terminated when its last message is not there so long after the publisher's end.
const QUIET: Duration = Duration::from_secs(10);
/// A system joins its networks at most so late.
const CONNECT_MAX: Duration = Duration::from_secs(30);
/// How much longer something may take than it says.
const SPARE: Duration = Duration::from_secs(10);

/// Measures the table.
pub(crate) fn run(compare: &Compare, figures: &mut Figures) -> Result<()> {
    if !compare.wants_path(&PathKind::Bare) {
        return Ok(());
    }
    let environments = compare.ros2();
    let environments =
        environments.canonicalize().with_context(|| format!("{}: is it built?", environments.display()))?;
    let systems = compare.systems().iter().chain(compare.relays());
    let mut ways: Vec<_> = systems.map(|system| Way::System(&**system)).collect();
    let all = ways.len();
    ways.retain(|way| SYSTEMS.contains(&&*way.name()));
    if ways.len() < all {
        let what = format!("{TABLE}, other systems than {}", SYSTEMS.join(", "));
        figures.leave_out(&what, "other transports and suites are in `round-trip` and `throughput`");
    }
    if compare.wants(ONE_HOST) {
        ways.insert(0, Way::OneHost);
    }
    // A short run shows with one of them that all parts work.
    let pairs = if compare.is_quick() { &PAIRS[..1] } else { &PAIRS[..] };
    for (path, distributions) in pairs {
        for measurement in Measurement::all(compare.is_quick()) {
            for way in &ways {
                let (name, what) = (way.name(), measurement.text());
                compare.note(&format!("{TABLE}, {path}, {what}: {name}"));
                let measured = Scene::start(compare, &environments, *distributions, way)
                    .and_then(|scene| measurement.measure(&scene, &name, path, figures));
                if let Err(error) = measured {
                    figures.leave_out(&format!("{TABLE} {name}, {path}, {what}"), format!("{error:#}"));
                }
            }
        }
    }
    Ok(())
}

/// A way to join the two programs.
enum Way<'a> {
    System(&'a dyn System),
    OneHost,
}

impl Way<'_> {
    fn name(&self) -> String {
        match self {
            Self::System(system) => system.name(),
            Self::OneHost => ONE_HOST.into(),
        }
    }
}

/// A row of the table.
enum Measurement {
    /// Messages of the default QoS, so many a second.
    Rate { per_second: u32, count: u32 },
    /// Messages without a pause, all kept until they are acknowledged.
    KeepAll { count: u32 },
    /// Messages there and back, one at a time.
    RoundTrip { size: usize, count: u32 },
    /// Numbered messages, to a subscriber that is started anew with their publisher.
    Restart { count: u32 },
}

impl Measurement {
    /// Returns all of them, in the order of the report.
    fn all(is_quick: bool) -> Vec<Self> {
        let seconds = if is_quick { QUICK_RATE_SECONDS } else { RATE_SECONDS };
        let rate = |per_second| Self::Rate { per_second, count: (f64::from(per_second) * seconds) as u32 };
        let mut all: Vec<_> = RATES.map(rate).into();
        all.push(Self::KeepAll { count: if is_quick { QUICK_KEEP_ALL_COUNT } else { KEEP_ALL_COUNT } });
        all.extend(ROUND_TRIPS.map(|(size, count)| {
            let count = if is_quick { count.min(QUICK_ROUND_TRIPS) } else { count };
            Self::RoundTrip { size, count }
        }));
        all.push(Self::Restart { count: if is_quick { QUICK_RESTART_COUNT } else { RESTART_COUNT } });
        all
    }

    fn text(&self) -> String {
        match self {
            Self::Rate { per_second, .. } => format!("{per_second} a second"),
            Self::KeepAll { .. } => "KEEP_ALL without pause".into(),
            Self::RoundTrip { size, .. } => format!("round trips of {size} B"),
            Self::Restart { .. } => "restart".into(),
        }
    }

    fn measure(&self, scene: &Scene, name: &str, path: &str, figures: &mut Figures) -> Result<()> {
        match *self {
            Self::Rate { per_second, count } => {
                let flow = scene.flow(count, per_second, DEFAULT_DEPTH)?;
                let mut push = |metric, value| {
                    figures.push(TABLE, name, path, f64::from(per_second), metric, value);
                };
                push("sent", flow.publisher.sent as f64);
                flow.push_counts(&mut push);
                flow.push_pace(&mut push);
            }
            Self::KeepAll { count } => {
                let flow = scene.flow(count, 0, 0)?;
                let mut push = |metric, value| figures.push(KEEP_ALL, name, path, 0.0, metric, value);
                push("sent", flow.publisher.sent as f64);
                push("refused", flow.publisher.refused as f64);
                flow.push_counts(&mut push);
                flow.push_pace(&mut push);
            }
            Self::RoundTrip { size, count } => {
                let summary = scene.round_trips(size, count)?;
                let mut push =
                    |metric, value| figures.push(ROUND_TRIP, name, path, size as f64, metric, value);
                ensure!(summary.received > 0, "no message came back");
                push("lost", summary.sent.saturating_sub(summary.first + summary.received) as f64);
                push("p50_us", summary.latency_us.p50);
                push("p99_us", summary.latency_us.p99);
                push("max_us", summary.latency_us.max);
            }
            Self::Restart { count } => {
                for run in 1..=RESTART_RUNS {
                    let flow = scene.flow(count, RESTART_RATE, DEFAULT_DEPTH)?;
                    flow.push_counts(&mut |metric, value| {
                        figures.push(RESTART, name, path, f64::from(run), metric, value);
                    });
                }
            }
        }
        Ok(())
    }
}

/// The two places with a system that has been started, for programs of ROS 2. Fields are dropped in this order.
struct Scene {
    running: Running,
    lab: Lab,
    /// Place of the program at the right end, which is the left place if both are on one host.
    far: Side,
    /// The environments of both ends.
    environments: [PathBuf; 2],
}

impl Scene {
    fn start(
        compare: &Compare,
        environments: &Path,
        distributions: [&str; 2],
        way: &Way<'_>,
    ) -> Result<Self> {
        let environments = distributions.map(|distribution| environments.join(distribution));
        for environment in &environments {
            let library = library_of(environment);
            ensure!(library.exists(), "{}: is it built?", library.display());
        }
        let lab = Lab::stock(PathKind::Bare, compare.load())?;
        let (running, far) = match way {
            Way::System(system) => (system.start(&lab, &TOPICS)?, Side::Right),
            Way::OneHost => {
                let dds = Side::BOTH.map(|_| Dds::stock(0));
                (Running { processes: Vec::new(), dds }, Side::Left)
            }
        };
        Ok(Self { running, lab, far, environments })
    }

    /// Starts a program at an end, with its role and what that is given.
    fn program(&self, end: Side, args: &[&str]) -> Result<Program> {
        let place = if end == Side::Left { end } else { self.far };
        let environment = &self.environments[end as usize];
        let mut command = self.lab.command(place, environment.join("bin/python"));
        command.arg("-B").arg(RUN).arg(library_of(environment)).args(args);
        for variable in ROS_VARIABLES {
            command.env_remove(variable);
        }
        let role = args.first().copied().unwrap_or_default();
        let dir = self.lab.new_dir(role)?;
        // Its logs go there.
        command.env("HOME", &dir).env("ROS_DOMAIN_ID", self.running.dds[end as usize].domain.to_string());
        Program::start_terminated(role, command, &dir)
    }

    /// Sends so many messages to the far end, at a rate or without a pause (0), with a history or all kept (0).
    fn flow(&self, count: u32, rate: u32, depth: u32) -> Result<Flow> {
        let (count, depth) = (count.to_string(), depth.to_string());
        let both = ["--topic", TOPIC, "--depth", &depth];
        let (linger, life) = (LINGER_SECONDS.to_string(), SUBSCRIBER_SECONDS.to_string());
        let args = ["--last", &count, "--linger", &linger, "--timeout", &life];
        let mut subscriber = self.program(Side::Right, &[&["sub"][..], &both, &args].concat())?;
        let (size, rate) = (FLOW_BYTES.to_string(), rate.to_string());
        let (begin, hold, life) =
            (BEGIN_SECONDS.to_string(), HOLD_SECONDS.to_string(), PUBLISHER_SECONDS.to_string());
        let args = ["--count", &count, "--rate", &rate, "--size", &size, "--wait-go"];
        let pace = ["--begin", &begin, "--hold", &hold, "--timeout", &life];
        let mut publisher = self.program(Side::Left, &[&["pub"][..], &both, &args, &pace].concat())?;
        for program in [&mut publisher, &mut subscriber] {
            program.until_event("matched", CONNECT_MAX)?;
        }
        publisher.tell("go")?;
        let most = Duration::from_secs(PUBLISHER_SECONDS + ACKNOWLEDGED_SECONDS) + SPARE;
        let published = publisher.until_event("summary", most)?;
        let received = match subscriber.until_event("summary", QUIET) {
            Ok(summary) => summary,
            Err(_) => {
                subscriber.terminate();
                subscriber.until_event("summary", SPARE)?
            }
        };
        let subscriber: Summary = serde_json::from_value(received)?;
        ensure!(subscriber.received > 1, "no flow: {} messages arrived", subscriber.received);
        Ok(Flow { publisher: serde_json::from_value(published)?, subscriber })
    }

    /// Sends so many messages to the far end and back.
    fn round_trips(&self, size: usize, count: u32) -> Result<Summary> {
        let life = SUBSCRIBER_SECONDS.to_string();
        let _echo =
            self.program(Side::Right, &["echo", "--topic", TOPIC, "--back", BACK, "--timeout", &life])?;
        let (size, count) = (size.to_string(), count.to_string());
        let (begin, life) = (BEGIN_SECONDS.to_string(), PING_SECONDS.to_string());
        let args = ["ping", "--topic", TOPIC, "--back", BACK, "--rate", "0", "--size", &size];
        let plan = ["--count", &count, "--begin", &begin, "--timeout", &life];
        let mut ping = self.program(Side::Left, &[&args[..], &plan].concat())?;
        let most = Duration::from_secs(PING_SECONDS) + SPARE;
        Ok(serde_json::from_value(ping.until_event("summary", most)?)?)
    }
}

/// The script by which an environment's Python runs the load generator.
const RUN: &str = concat!(env!("CARGO_MANIFEST_DIR"), "/../tests/peers/ros2/run.py");

/// Variables of a user's shell that change ROS 2's defaults.
const ROS_VARIABLES: [&str; 8] = [
    "FASTDDS_BUILTIN_TRANSPORTS",
    "FASTDDS_DEFAULT_PROFILES_FILE",
    "FASTRTPS_DEFAULT_PROFILES_FILE",
    "RMW_IMPLEMENTATION",
    "ROS_AUTOMATIC_DISCOVERY_RANGE",
    "ROS_DISCOVERY_SERVER",
    "ROS_LOCALHOST_ONLY",
    "ROS_STATIC_PEERS",
];

/// The load generator of an environment.
fn library_of(environment: &Path) -> PathBuf {
    environment.join("load.so")
}

/// The summary of a publisher.
#[derive(Debug, Deserialize)]
struct PublisherReport {
    sent: u64,
    /// Messages that DDS did not take.
    refused: u64,
}

/// The summary of a program that receives; `sent` is that of a `ping`.
#[derive(Debug, Deserialize)]
struct Summary {
    sent: u64,
    /// Different messages.
    received: u64,
    /// The number of the first of them.
    first: u64,
    duplicated: u64,
    /// From the first message to the last.
    seconds: f64,
    latency_us: Latency,
}

#[derive(Debug, Deserialize)]
struct Latency {
    p50: f64,
    p99: f64,
    max: f64,
}

/// Messages one way.
#[derive(Debug)]
struct Flow {
    publisher: PublisherReport,
    subscriber: Summary,
}

impl Flow {
    /// Messages that DDS took and that did not arrive, from the first that did.
    fn lost(&self) -> u64 {
        let due = self.publisher.sent.saturating_sub(self.publisher.refused + self.subscriber.first);
        due.saturating_sub(self.subscriber.received)
    }

    /// Messages that arrived a second, without the pause after the first message.
    fn per_second(&self) -> f64 {
        let pause = if self.subscriber.first == 0 { BEGIN_SECONDS } else { 0.0 };
        let seconds = (self.subscriber.seconds - pause).max(f64::MIN_POSITIVE);
        self.subscriber.received.saturating_sub(1) as f64 / seconds
    }

    fn push_counts(&self, push: &mut impl FnMut(&'static str, f64)) {
        push("arrived", self.subscriber.received as f64);
        push("lost", self.lost() as f64);
        push("duplicated", self.subscriber.duplicated as f64);
    }

    fn push_pace(&self, push: &mut impl FnMut(&'static str, f64)) {
        push("per_second", self.per_second());
        push("p50_us", self.subscriber.latency_us.p50);
        push("p99_us", self.subscriber.latency_us.p99);
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn flow(sent: u64, refused: u64, received: u64, first: u64) -> Flow {
        let latency_us = Latency { p50: 1.0, p99: 1.0, max: 1.0 };
        let subscriber = Summary { sent: 0, received, first, duplicated: 0, seconds: 4.5, latency_us };
        Flow { publisher: PublisherReport { sent, refused }, subscriber }
    }

    #[test]
    fn messages_are_lost_from_the_first_that_arrived_to_the_last_that_dds_took() {
        assert_eq!(flow(100, 0, 100, 0).lost(), 0);
        assert_eq!(flow(100, 0, 90, 0).lost(), 10);
        assert_eq!(flow(100, 0, 97, 3).lost(), 0);
        assert_eq!(flow(100, 10, 90, 0).lost(), 0);
    }

    #[test]
    fn pause_after_the_first_message_is_not_in_the_rate() {
        assert_eq!(flow(8001, 0, 8001, 0).per_second(), 2000.0);
        assert_eq!(flow(9002, 0, 9001, 1).per_second(), 2000.0);
    }
}
