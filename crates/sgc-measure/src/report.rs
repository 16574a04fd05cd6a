//! The report of a measurement between two machines: figures, tables and findings in words. Pure.

use std::fmt::Write as _;
use std::time::Duration;

use serde::Serialize;
use sgc_process::output;

use crate::machine::Machine;
use crate::words::{Size, StreamCount};

/// Fraction of lost UDP packets from which the findings mention loss.
const UDP_LOSS_TOLD: f64 = 0.005;
/// Fraction of plain TCP's throughput below which the network is not the limit.
const NETWORK_BOUND: f64 = 0.8;

/// The path between the two nodes.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub(crate) struct Path {
    /// `"direct"` or `"router"`.
    pub(crate) via: &'static str,
    /// The schemes of the URLs.
    pub(crate) transports: Vec<String>,
    /// Round-trip time of this side's link, measured by its transport, in microseconds.
    pub(crate) rtt_us: Option<u64>,
}

/// Round trips of one size, one at a time.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub(crate) struct Trips {
    /// `"sgc group"`, `"TCP"`, `"direct DDS"`.
    pub(crate) way: String,
    /// Bytes of the message.
    pub(crate) size: Size,
    /// Number of round trips.
    pub(crate) count: usize,
    /// Packets that did not come back, for UDP only.
    pub(crate) lost: usize,
    /// Median in microseconds.
    pub(crate) p50_us: u64,
    /// 99th percentile in microseconds.
    pub(crate) p99_us: u64,
    /// Maximum in microseconds.
    pub(crate) max_us: u64,
}

impl Trips {
    /// Summarises the times of round trips, given in any order.
    pub(crate) fn from_times(way: String, size: Size, mut took: Vec<Duration>, lost: usize) -> Self {
        took.sort_unstable();
        let at = |percent: usize| {
            // The smallest value that so many per cent do not exceed.
            let rank = (took.len() * percent).div_ceil(100).max(1) - 1;
            took.get(rank).map_or(0, |took| took.as_micros() as u64)
        };
        Self { way, size, count: took.len(), lost, p50_us: at(50), p99_us: at(99), max_us: at(100) }
    }
}

/// A stream of one size.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub(crate) struct Flow {
    /// As in [`Trips`].
    pub(crate) way: String,
    /// Bytes of the message.
    pub(crate) size: Size,
    /// Messages sent.
    pub(crate) sent: u64,
    /// Messages that arrived.
    pub(crate) received: u64,
    /// Repeated messages.
    pub(crate) repeated: u64,
    /// Messages received per second of the receiver's clock.
    pub(crate) per_s: f64,
    /// Throughput of content, in 10⁶ bits per second.
    pub(crate) mbit_s: f64,
    /// Processor time of the node on this side, in microseconds per message.
    pub(crate) cpu_us_here: Option<f64>,
    /// Processor time of the node on the other side, in microseconds per message.
    pub(crate) cpu_us_there: Option<f64>,
}

impl Flow {
    /// Summarises the count of a stream. `sending` is its duration where the count has none.
    pub(crate) fn from_count(
        way: String,
        size: Size,
        sent: u64,
        counted: &StreamCount,
        sending: Duration,
    ) -> Self {
        // n messages span n - 1 periods.
        let (periods, us) = match counted.us {
            0 => (counted.received, sending.as_micros().max(1) as u64),
            us => (counted.received.saturating_sub(1), us),
        };
        let per_s = periods as f64 * 1e6 / us as f64;
        Self {
            way,
            size,
            sent,
            received: counted.received,
            repeated: counted.repeated,
            per_s,
            mbit_s: per_s * size.0 as f64 * 8.0 / 1e6,
            cpu_us_here: None,
            cpu_us_there: None,
        }
    }

    /// Adds the processor time that both nodes used.
    pub(crate) fn with_cpu(self, here: Option<u64>, there: Option<u64>) -> Self {
        let each = |us: Option<u64>| us.map(|us| us as f64 / self.received.max(1) as f64);
        let (cpu_us_here, cpu_us_there) = (each(here), each(there));
        Self { cpu_us_here, cpu_us_there, ..self }
    }

    /// Returns the number of messages that never arrived.
    pub(crate) fn lost(&self) -> u64 {
        self.sent.saturating_sub(self.received)
    }
}

/// Converts bytes and time to 10⁶ bits per second.
pub(crate) fn mbit_s(bytes: u64, took: Duration) -> f64 {
    bytes as f64 * 8.0 / 1e6 / took.as_secs_f64().max(1e-6)
}

/// The whole report.
#[derive(Debug, Serialize)]
pub(crate) struct Report {
    /// Version of the program on this and on the other side.
    pub(crate) versions: [String; 2],
    /// The machine that measured.
    pub(crate) here: Machine,
    /// The machine that answered.
    pub(crate) there: Machine,
    /// The path between them.
    pub(crate) path: Path,
    /// Round trips.
    pub(crate) trips: Vec<Trips>,
    /// Streams from here to there.
    pub(crate) flows: Vec<Flow>,
    /// Throughput of one plain TCP connection from here to there, in 10⁶ bits per second.
    pub(crate) tcp_mbit_s: Option<f64>,
    /// The reason why the bare path was not measured, or only in part.
    pub(crate) bare_not: Option<String>,
    /// The reason why DDS without `sgc` was not measured.
    pub(crate) direct_not: Option<String>,
}

impl Report {
    /// Returns a report without figures.
    pub(crate) fn new(path: Path, here: Machine, there: Machine, version_there: String) -> Self {
        Self {
            versions: [env!("CARGO_PKG_VERSION").to_owned(), version_there],
            here,
            there,
            path,
            trips: Vec::new(),
            flows: Vec::new(),
            tcp_mbit_s: None,
            bare_not: None,
            direct_not: None,
        }
    }

    /// Formats the report for a terminal.
    pub(crate) fn lines(&self) -> Vec<String> {
        let mut lines = self.machines();
        for (title, table) in self.tables() {
            lines.extend([String::new(), format!("{title}:")]);
            lines.extend(output::columns(&table).into_iter().map(|line| format!("  {line}")));
        }
        lines.extend([String::new(), "What that means:".to_owned()]);
        lines.extend(self.findings().into_iter().map(|finding| format!("  - {finding}")));
        lines
    }

    /// Formats the report as Markdown.
    pub(crate) fn markdown(&self) -> String {
        let mut text = "# sgc between two machines\n\n".to_owned();
        for line in self.machines() {
            let _ = writeln!(text, "- {}", escaped(&line));
        }
        for (title, table) in self.tables() {
            let _ = writeln!(text, "\n## {title}\n");
            for (index, row) in table.iter().enumerate() {
                let cells: Vec<_> = row.iter().map(|cell| escaped(cell)).collect();
                let _ = writeln!(text, "| {} |", cells.join(" | "));
                if index == 0 {
                    let _ = writeln!(text, "|{}", "---|".repeat(row.len()));
                }
            }
        }
        text += "\n## What that means\n\n";
        for finding in self.findings() {
            let _ = writeln!(text, "- {}", escaped(&finding));
        }
        text
    }

    fn machines(&self) -> Vec<String> {
        let told =
            |m: &Machine, version: &str| format!("{}, {} cores, {}, sgc {version}", m.cpu, m.cores, m.kernel);
        let [here, there] = &self.versions;
        let how = match self.path.via {
            "router" => "through a router, ",
            _ => "",
        };
        vec![
            format!("here: {}", told(&self.here, here)),
            format!("there: {}", told(&self.there, there)),
            format!("between: {how}{}", self.path.transports.join(", ")),
        ]
    }

    fn tables(&self) -> Vec<(&'static str, Vec<Vec<String>>)> {
        let row = |cells: &[&str]| cells.iter().map(|cell| (*cell).to_owned()).collect::<Vec<_>>();
        let mut trips = vec![row(&["way", "size", "round trip p50", "p99", "max", "count", "lost"])];
        for t in &self.trips {
            let times = [t.p50_us, t.p99_us, t.max_us].map(output::millis);
            let [p50, p99, max] = times;
            trips.push(vec![
                t.way.clone(),
                t.size.to_string(),
                p50,
                p99,
                max,
                t.count.to_string(),
                t.lost.to_string(),
            ]);
        }
        let cpu = |us: Option<f64>| us.map_or_else(|| "-".to_owned(), |us| format!("{us:.1} µs"));
        let mut flows =
            vec![row(&["way", "size", "messages/s", "Mbit/s", "sent", "lost", "CPU here", "CPU there"])];
        for f in &self.flows {
            flows.push(vec![
                f.way.clone(),
                f.size.to_string(),
                format!("{:.0}", f.per_s),
                format!("{:.1}", f.mbit_s),
                f.sent.to_string(),
                f.lost().to_string(),
                cpu(f.cpu_us_here),
                cpu(f.cpu_us_there),
            ]);
        }
        if let Some(mbit_s) = self.tcp_mbit_s {
            let rate = format!("{mbit_s:.1}");
            flows.push(vec![
                "TCP".into(),
                "stream".into(),
                "-".into(),
                rate,
                "-".into(),
                "0".into(),
                "-".into(),
                "-".into(),
            ]);
        }
        vec![
            ("Round trips", trips),
            ("Throughput from here to there; CPU of the sgc node, for one message", flows),
        ]
    }

    /// Interprets the figures, one finding a line.
    fn findings(&self) -> Vec<String> {
        let mut findings = Vec::new();
        for trips in self.trips.iter().filter(|trips| trips.way.starts_with("sgc ")) {
            let (way, size, p50) = (&trips.way, trips.size, output::millis(trips.p50_us));
            let bare = self.trips.iter().find(|other| other.way == "TCP" && other.size == size);
            findings.push(match bare {
                Some(bare) => format!(
                    "{way}, {size}: {p50} there and back; plain TCP takes {}, so two nodes, sealing and DDS on both ends add {}",
                    output::millis(bare.p50_us),
                    output::millis(trips.p50_us.saturating_sub(bare.p50_us)),
                ),
                None => format!("{way}, {size}: {p50} there and back"),
            });
        }
        for flow in self.flows.iter().filter(|flow| flow.way.starts_with("sgc ")) {
            let (way, size) = (&flow.way, flow.size);
            let arrived = match (flow.lost(), flow.repeated) {
                (0, 0) => "all arrived, once each".to_owned(),
                (lost, repeated) => format!(
                    "{lost} of {} lost and {repeated} repeated, which should not be: `sgc status` and `sgc why` say more \
                     while a node of yours runs",
                    flow.sent
                ),
            };
            findings.push(format!(
                "{way}, {size}: {:.0} messages/s, {:.1} Mbit/s, {arrived}",
                flow.per_s, flow.mbit_s
            ));
        }
        if let (Some(tcp), Some(best)) = (self.tcp_mbit_s, self.best_mbit_s()) {
            let share = best / tcp.max(1e-9);
            let limit = if share >= NETWORK_BOUND {
                "the network is what limits"
            } else {
                "the processors, or how the path loses and delays, limit before the network's rate does"
            };
            findings.push(format!(
                "at most {best:.1} Mbit/s through sgc, {tcp:.1} by one plain TCP connection: {:.0} %; {limit}",
                share * 100.0
            ));
        }
        for udp in self.trips.iter().filter(|trips| trips.way == "UDP") {
            let all = udp.count + udp.lost;
            let lost = udp.lost as f64 / all.max(1) as f64;
            if lost > UDP_LOSS_TOLD {
                findings.push(format!(
                    "the network loses: {} of {all} UDP packets of {} did not come back ({:.1} %)",
                    udp.lost,
                    udp.size,
                    lost * 100.0
                ));
            }
        }
        if let Some(why) = &self.bare_not {
            findings.push(format!("the bare path was not measured: {why}"));
        }
        match &self.direct_not {
            Some(why) => findings.push(format!("DDS without sgc was not measured: {why}")),
            None => {
                for direct in self.trips.iter().filter(|trips| trips.way == "direct DDS") {
                    findings.push(format!(
                        "DDS without sgc reaches here, unsealed and for everybody: {}, {} there and back",
                        direct.size,
                        output::millis(direct.p50_us)
                    ));
                }
            }
        }
        findings
    }

    fn best_mbit_s(&self) -> Option<f64> {
        let rates = self.flows.iter().filter(|flow| flow.way.starts_with("sgc ")).map(|flow| flow.mbit_s);
        rates.reduce(f64::max)
    }
}

/// Escapes Markdown in a text of the other machine, which may hold anything.
fn escaped(text: &str) -> String {
    let special = |c: char| "\\`*_{}[]<>#|!".contains(c);
    text.chars().flat_map(|c| special(c).then_some('\\').into_iter().chain([c])).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    fn machine(cpu: &str) -> Machine {
        Machine { cpu: cpu.into(), cores: 2, kernel: "Linux 6 x86_64".into() }
    }

    fn report() -> Report {
        let path = Path { via: "direct", transports: vec!["quic".into()], rtt_us: Some(300) };
        let mut report = Report::new(path, machine("a"), machine("b|<c>"), "0.1.0".into());
        let trips = |way: &str, us: u64| {
            let took = (1..=100).map(|n| Duration::from_micros(us * n)).collect();
            Trips::from_times(way.into(), Size(16), took, 0)
        };
        report.trips = vec![trips("sgc group", 20), trips("TCP", 5)];
        let counted = StreamCount { phase: 1, received: 101, repeated: 0, us: 1_000_000, node_cpu_us: 0 };
        let flow = Flow::from_count("sgc group".into(), Size(1000), 101, &counted, Duration::from_secs(1));
        report.flows = vec![flow.with_cpu(Some(1010), Some(2020))];
        report.tcp_mbit_s = Some(100.0);
        report.direct_not = Some("it does not reach".into());
        report
    }

    #[test]
    fn percentile_is_smallest_value_that_share_does_not_exceed() {
        let trips = &report().trips[0];
        assert_eq!((trips.p50_us, trips.p99_us, trips.max_us), (1000, 1980, 2000));
        assert_eq!(Trips::from_times("TCP".into(), Size(1), Vec::new(), 3).max_us, 0);
    }

    #[test]
    fn rates_use_receivers_clock_and_loss_counts_missing_messages() {
        let flow = &report().flows[0];
        assert!((flow.per_s - 100.0).abs() < 1e-9 && (flow.mbit_s - 0.8).abs() < 1e-9);
        assert_eq!((flow.cpu_us_here, flow.cpu_us_there), (Some(10.0), Some(20.0)));
        let counted = StreamCount { received: 7, ..StreamCount::default() };
        assert_eq!(Flow::from_count("x".into(), Size(1), 10, &counted, Duration::from_secs(1)).lost(), 3);
    }

    #[test]
    fn findings_are_worded() {
        let said = report().lines().join("\n");
        for part in [
            "plain TCP takes 0.25 ms, so two nodes, sealing and DDS on both ends add 0.75 ms",
            "all arrived, once each",
            "limit before the network's rate does",
            "DDS without sgc was not measured: it does not reach",
        ] {
            assert!(said.contains(part), "{part}\n{said}");
        }
        let mut lossy = report();
        lossy.flows[0].received = 99;
        assert!(lossy.lines().join("\n").contains("2 of 101 lost"));
    }

    #[test]
    fn markdown_escapes_text_of_other_machine() {
        let text = report().markdown();
        assert!(text.contains(r"there: b\|\<c\>, 2 cores"), "{text}");
        let rows: Vec<_> = text.lines().filter(|line| line.starts_with('|')).collect();
        assert!(rows.len() >= 6 && rows.iter().all(|row| row.ends_with('|')), "{text}");
    }
}
