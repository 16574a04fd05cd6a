//! The measurements of a run, and their tables.

use std::collections::BTreeMap;
use std::fs;

use serde::Serialize;

use super::pair::Start;
use super::{DELAYS_MS, SIZES, System};
use crate::report::{Spread, Table, digits, median};

/// The share of a plain round trip that the direct path may take longer, beside the cost of the nodes.
const ALLOWED: f64 = 0.05;

/// A system, and the delay between each NAT and the cloud, ms.
type Setting = (&'static str, u64);

/// All measurements.
#[derive(Debug, Default)]
pub(super) struct Figures {
    loads: Vec<f64>,
    starts: BTreeMap<Setting, Vec<Start>>,
    /// Round trips of each round by size, µs.
    round_trips: BTreeMap<(Setting, usize), Vec<Vec<f64>>>,
    /// Bytes a second of each round.
    throughput: BTreeMap<Setting, Vec<f64>>,
    /// Bytes a second at the router of each round, by phase.
    router: BTreeMap<(&'static str, String), Vec<f64>>,
    left_out: Vec<String>,
}

impl Figures {
    /// Notes the load of the machine before a round.
    pub(super) fn begin_round(&mut self) {
        let load = fs::read_to_string("/proc/loadavg").unwrap_or_default();
        self.loads.extend(load.split(' ').next().and_then(|load| load.parse::<f64>().ok()));
    }

    pub(super) fn add_start(&mut self, setting: Setting, start: Start) {
        self.starts.entry(setting).or_default().push(start);
    }

    pub(super) fn add_round_trips(&mut self, setting: Setting, size: usize, round_trips_us: Vec<f64>) {
        self.round_trips.entry((setting, size)).or_default().push(round_trips_us);
    }

    pub(super) fn add_throughput(&mut self, setting: Setting, bytes_per_second: f64) {
        self.throughput.entry(setting).or_default().push(bytes_per_second);
    }

    pub(super) fn add_router(&mut self, system: &'static str, phase: &str, bytes_per_second: f64) {
        self.router.entry((system, phase.to_owned())).or_default().push(bytes_per_second);
    }

    /// Says that something is missing.
    pub(super) fn leave_out(&mut self, (system, delay_ms): Setting, round: usize, error: &anyhow::Error) {
        let text = format!("{system} with {delay_ms} ms, round {round}: {error:#}");
        eprintln!("        left out: {text}");
        self.left_out.push(text);
    }

    /// Returns the rows of the file.
    pub(super) fn rows(&self) -> Rows {
        let starts = self.starts.iter().map(|(&(system, delay_ms), starts)| StartRow {
            system,
            delay_ms,
            first_ms: starts.iter().filter_map(|start| start.first_ms).collect(),
            direct_ms: starts.iter().filter_map(|start| start.direct_ms).collect(),
            known_to_direct_ms: starts.iter().filter_map(|start| start.known_to_direct_ms).collect(),
        });
        let round_trips =
            self.round_trips.iter().map(|(&((system, delay_ms), bytes), rounds)| RoundTripRow {
                system,
                delay_ms,
                bytes,
                samples: rounds.iter().map(Vec::len).sum(),
                us: Spread::from_samples(rounds.concat()),
                p50_us_of_rounds: rounds.iter().map(|round| median(round.iter().copied())).collect(),
            });
        let throughput = self.throughput.iter().map(|(&(system, delay_ms), rounds)| ThroughputRow {
            system,
            delay_ms,
            mbyte_per_second: rounds.iter().map(|rate| rate / 1e6).collect(),
        });
        let router = self.router.iter().map(|((system, phase), rounds)| RouterRow {
            system,
            phase: phase.clone(),
            bytes_per_second: rounds.clone(),
        });
        Rows {
            loads: self.loads.clone(),
            starts: starts.filter(|row| !row.first_ms.is_empty()).collect(),
            round_trips: round_trips.collect(),
            throughput: throughput.collect(),
            router: router.collect(),
            goals: SIZES.iter().filter_map(|&bytes| self.goal(bytes)).collect(),
            left_out: self.left_out.clone(),
        }
    }

    /// Compares the direct path with its bound: a plain round trip over the same path and a twentieth, plus the cost of
    /// the nodes. That is the difference of both without delay.
    fn goal(&self, bytes: usize) -> Option<Goal> {
        let p50 = |system: System, delay_ms| {
            let rounds = self.round_trips.get(&((system.name(), delay_ms), bytes))?;
            Some(Spread::from_samples(rounds.concat()).p50)
        };
        let [near, far] = DELAYS_MS;
        let (plain_us, direct_us) = (p50(System::Plain, far)?, p50(System::SgcDirect, far)?);
        let nodes_us = p50(System::SgcDirect, near)? - p50(System::Plain, near)?;
        let bound_us = plain_us * (1.0 + ALLOWED) + nodes_us;
        Some(Goal { bytes, plain_us, nodes_us, bound_us, direct_us, is_met: direct_us <= bound_us })
    }
}

/// The content of the file.
#[derive(Debug, Serialize)]
pub(super) struct Rows {
    /// Load average of the last minute before each round. From the second round on, this run is in it.
    loads: Vec<f64>,
    starts: Vec<StartRow>,
    round_trips: Vec<RoundTripRow>,
    throughput: Vec<ThroughputRow>,
    router: Vec<RouterRow>,
    goals: Vec<Goal>,
    /// Measurements that failed, with the reasons.
    left_out: Vec<String>,
}

/// The starts of a system; [`Start`] has the meaning of its fields.
#[derive(Debug, Serialize)]
struct StartRow {
    system: &'static str,
    delay_ms: u64,
    first_ms: Vec<f64>,
    direct_ms: Vec<f64>,
    known_to_direct_ms: Vec<f64>,
}

/// Round trips of a size, of all rounds together.
#[derive(Debug, Serialize)]
struct RoundTripRow {
    system: &'static str,
    delay_ms: u64,
    bytes: usize,
    samples: usize,
    us: Spread,
    p50_us_of_rounds: Vec<f64>,
}

/// Content that arrived, by round.
#[derive(Debug, Serialize)]
struct ThroughputRow {
    system: &'static str,
    delay_ms: u64,
    mbyte_per_second: Vec<f64>,
}

/// Bytes of IP packets that the router or relay received and sent, by round.
#[derive(Debug, Serialize)]
struct RouterRow {
    system: &'static str,
    phase: String,
    bytes_per_second: Vec<f64>,
}

/// The round trip of the direct path and its bound.
#[derive(Debug, Serialize)]
struct Goal {
    bytes: usize,
    plain_us: f64,
    nodes_us: f64,
    bound_us: f64,
    direct_us: f64,
    is_met: bool,
}

impl Rows {
    /// Returns the tables for people.
    pub(super) fn tables(&self) -> Vec<Table> {
        let starts = self.starts.iter().map(|row| {
            let (delay, count) = (row.delay_ms.to_string(), row.first_ms.len().to_string());
            let times =
                [&row.first_ms, &row.direct_ms, &row.known_to_direct_ms].map(|times| middle_and_most(times));
            [row.system.to_owned(), delay, count].into_iter().chain(times).collect()
        });
        let round_trips = self.round_trips.iter().map(|row| {
            let ms = |us: f64| digits(us / 1e3);
            vec![
                row.system.to_owned(),
                row.delay_ms.to_string(),
                row.bytes.to_string(),
                ms(row.us.p50),
                ms(row.us.p99),
                row.samples.to_string(),
            ]
        });
        let throughput = self.throughput.iter().map(|row| {
            let rates = row.mbyte_per_second.iter().map(|rate| digits(*rate)).collect::<Vec<_>>().join(", ");
            let middle = digits(median(row.mbyte_per_second.iter().copied()));
            vec![row.system.to_owned(), row.delay_ms.to_string(), middle, rates]
        });
        let router = self.router.iter().map(|row| {
            let middle = median(row.bytes_per_second.iter().copied());
            vec![row.system.to_owned(), row.phase.clone(), format!("{middle:.0}")]
        });
        let goals = self.goals.iter().map(|goal| {
            let ms = |us: f64| digits(us / 1e3);
            vec![
                goal.bytes.to_string(),
                ms(goal.plain_us),
                ms(goal.nodes_us),
                ms(goal.bound_us),
                ms(goal.direct_us),
                if goal.is_met { "yes" } else { "no" }.to_owned(),
            ]
        });
        vec![
            Table {
                title: "Time to the first message and to the direct path, ms, median / longest".into(),
                columns: vec!["system", "delay", "starts", "first message", "direct", "known to direct"],
                rows: starts.collect(),
            },
            Table {
                title: "Round trips, ms".into(),
                columns: vec!["system", "delay", "bytes", "p50", "p99", "samples"],
                rows: round_trips.collect(),
            },
            Table {
                title: "Throughput, MB/s of content: median, and each round".into(),
                columns: vec!["system", "delay", "MB/s", "rounds"],
                rows: throughput.collect(),
            },
            Table {
                title: "Bytes a second at the router or relay, in and out".into(),
                columns: vec!["system", "while", "bytes/s"],
                rows: router.collect(),
            },
            Table {
                title: "The direct round trip and its bound, ms".into(),
                columns: vec!["bytes", "plain", "nodes", "bound", "direct", "met"],
                rows: goals.collect(),
            },
        ]
    }
}

/// Formats the median and the longest of some times; nothing if there are none.
fn middle_and_most(times: &[f64]) -> String {
    if times.is_empty() {
        return String::new();
    }
    let spread = Spread::from_samples(times.to_vec());
    format!("{} / {}", digits(spread.p50), digits(spread.max))
}
