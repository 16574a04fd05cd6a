//! Pages of a run: goals, a table for every path, plots, the machine, and what was left out.
//!
//! It shows whatever figures there are; tables that it knows nothing of it lays out by the same rule as those it has
//! words for. It measures nothing, and judging goals is [`super::goals`]'s.

use std::fmt::Write as _;
use std::fs;
use std::path::Path;

use anyhow::{Context, Result};
use serde::{Deserialize, Serialize};

use super::figures::{Figure, Figures};
use super::goals;
use super::plot::{self, Axis, Bar, Hue, Series, Stroke, Unit, join, three_digits};
use super::real_ros2;
use super::rmw_zenoh;
use super::round_trip::GAVE_UP;
use super::system::WITH_RMW_ZENOH;
use crate::report::Machine;

/// The results of a run.
#[derive(Serialize, Deserialize)]
pub(crate) struct Run {
    machine: Machine,
    /// Shows that all parts work; the figures mean little.
    is_quick: bool,
    #[serde(flatten)]
    figures: Figures,
}

/// A file of the report.
#[derive(Debug)]
pub(crate) struct Page {
    /// Its name, without a directory.
    pub(crate) name: String,
    pub(crate) text: String,
}

impl Run {
    /// Returns the results of a run on this machine.
    pub(crate) fn here(figures: Figures, is_quick: bool) -> Self {
        Self { machine: Machine::here(), is_quick, figures }
    }

    /// As [`Self::write`] wrote it.
    pub(crate) fn read(path: &Path) -> Result<Self> {
        let text = fs::read_to_string(path).with_context(|| path.display().to_string())?;
        serde_json::from_str(&text).with_context(|| format!("{}: not a run of `compare`", path.display()))
    }

    /// Writes the figures as `compare.json`.
    pub(crate) fn write(&self, dir: &Path) -> Result<()> {
        let text = serde_json::to_string_pretty(self)? + "\n";
        write(dir, &Page { name: "compare.json".into(), text })
    }

    /// Writes `report.md` and its plots, in place of those of an earlier run.
    pub(crate) fn render(&self, dir: &Path) -> Result<()> {
        let pages = self.pages();
        // A plot of an earlier run that this one has not would be taken for this one's.
        if let Ok(entries) = fs::read_dir(dir) {
            for entry in entries.flatten() {
                let name = entry.file_name();
                if name.to_str().is_some_and(|n| n.starts_with(PLOT_PREFIX) && n.ends_with(".svg")) {
                    fs::remove_file(entry.path()).with_context(|| entry.path().display().to_string())?;
                }
            }
        }
        pages.iter().try_for_each(|page| write(dir, page))
    }

    /// The report and its plots.
    pub(crate) fn pages(&self) -> Vec<Page> {
        let mut pages = Vec::new();
        let mut text = String::from("# SGC beside what a user would pick instead\n\n");
        let _ = writeln!(text, "Measured in one run on one machine: {}.\n", self.machine.sentence());
        if self.is_quick {
            text.push_str("**A quick run: it shows that all parts work. Its figures mean little.**\n\n");
        }
        text.push_str(HOW_TO_READ);
        text.push_str(&goals_table(&self.figures));
        for table in tables(&self.figures) {
            let about = About::for_table(table);
            let _ = writeln!(text, "## {}\n\n{}", about.title, about.says);
            let plots = plots(&self.figures, &about);
            for page in &plots {
                let _ = writeln!(text, "![{}]({})\n", page.name.trim_end_matches(".svg"), page.name);
            }
            pages.extend(plots);
            for path in paths(&self.figures, table) {
                text.push_str(&path_tables(&self.figures, &about, path));
            }
        }
        text.push_str("## Left out\n\n");
        if self.figures.left_out.is_empty() {
            text.push_str("Nothing.\n");
        }
        for reason in &self.figures.left_out {
            let _ = writeln!(text, "- {reason}");
        }
        pages.insert(0, Page { name: "report.md".into(), text });
        pages
    }
}

const PLOT_PREFIX: &str = "compare-";

const HOW_TO_READ: &str = "Compare ratios and not times: machines differ, and all systems take turns on this one. Times are \
from publishing to the subscribing program and, where it says round trip, back. Cells with several numbers are p50 / p99 / \
longest. `group`, `pairwise`, `standard` and `paper` are SGC's cipher suites: sealed with a key that members share; with a MAC for \
each receiver (the default); signed by each source; the paper's choices. *with a router*: through an `sgc` router process, otherwise one node dials the \
other. A dash is what was not measured.\n\n";

/// The description of a table.
struct About<'a> {
    table: &'a str,
    title: &'a str,
    /// A paragraph, and an empty line.
    says: &'a str,
    /// The meaning of `at`; empty if it has none.
    at: &'static str,
    at_unit: Unit,
    plot: Plot,
}

/// How a table is drawn.
#[derive(Clone, Copy, PartialEq)]
enum Plot {
    /// A curve for each system, over `at`, for each path.
    Curves,
    /// Bars of this metric for each system and `at`, in one plot.
    Bars(&'static str),
    /// None.
    Nothing,
}

impl<'a> About<'a> {
    fn for_table(table: &'a str) -> Self {
        let (title, says, at, at_unit, plot) = match table {
            "round-trip" => (
                "Round trip",
                "One message there and the same back, one at a time, between two ROS 2 programs at the ends of the path.\n",
                "bytes of a message",
                Unit::Bytes,
                Plot::Curves,
            ),
            "throughput" => (
                "Throughput",
                "Reliable messages as fast as they are taken. CPU and memory are those of the system's own processes, not of \
                 the programs that publish and subscribe.\n",
                "bytes of a message",
                Unit::Bytes,
                Plot::Bars("per_second"),
            ),
            real_ros2::TABLE => (
                "Real ROS 2",
                "A C program on `rcl` and stock `rmw_fastrtps` publishes to another of the other distribution: 1000 B, reliable, `KEEP_LAST` \
                 10, as ROS 2 has it by default. *lost* counts from the first message that arrived. *direct DDS* is what users have natively, \
                 one network over the path; goals compare with it. *one host* is natively in shared memory, where nothing goes over a path.\n",
                "messages a second",
                Unit::Plain,
                Plot::Nothing,
            ),
            real_ros2::KEEP_ALL => (
                "Real ROS 2, `KEEP_ALL`",
                "The same programs, which keep all that is not acknowledged; the publisher writes without a pause. *refused* are messages \
                 that DDS did not take from the publisher.\n",
                "",
                Unit::Plain,
                Plot::Nothing,
            ),
            real_ros2::ROUND_TRIP => (
                "Real ROS 2, round trip",
                "One message there and the same back, one at a time, between the same programs.\n",
                "bytes of a message",
                Unit::Bytes,
                Plot::Curves,
            ),
            real_ros2::RESTART => (
                "Real ROS 2, restart",
                "Numbered messages from a publisher to a subscriber. Both are ended after runs 1 and 2 and started anew, while the system runs on. \
                 *duplicated* counts copies beyond the first that the subscriber of that run takes.\n",
                "run",
                Unit::Plain,
                Plot::Nothing,
            ),
            rmw_zenoh::TABLE => (
                "rmw_zenoh",
                "Programs of rmw_zenoh, or of DDS where it says so, at the two places: 1000 B, reliable, `KEEP_ALL`, as fast as they are \
                 taken. CPU and memory are those of Zenoh routers and `sgc`. SGC has a router of its own between the two proxies, suite `pairwise`.\n",
                "bytes of a message",
                Unit::Bytes,
                Plot::Nothing,
            ),
            rmw_zenoh::ROUND_TRIP => (
                "rmw_zenoh, round trip",
                "One message there and the same back, one at a time, between the same programs; reliable, depth 10.\n",
                "bytes of a message",
                Unit::Bytes,
                Plot::Curves,
            ),
            rmw_zenoh::TELEOP => (
                "rmw_zenoh, commands beside a camera",
                "Commands (50 Hz × 64 B) and a camera (30 Hz × 60 KB), both best effort, over the same uplink of 2 Mbit/s with a queue of \
                 200 ms. Ages, from publishing to the subscriber. SGC sends commands as `realtime` and the camera as `bulk`; rmw_zenoh has its defaults. \
                 CPU is that of Zenoh routers and `sgc` since their start.\n",
                "",
                Unit::Plain,
                Plot::Nothing,
            ),
            rmw_zenoh::IDLE => (
                "rmw_zenoh, idle processes",
                "A Zenoh router that is connected to another, and proxies of `sgc` without topics, after 20 s at rest.\n",
                "",
                Unit::Plain,
                Plot::Nothing,
            ),
            "start-up" => (
                "Start-up and advertisement",
                "With so many records known to the router beforehand.\n",
                "records",
                Unit::Plain,
                Plot::Curves,
            ),
            "applications" => (
                "Applications",
                "The applications of the paper, by shape and size: `vslam` sends 640 × 480 × 3 bytes 30 times a second and gets a pose \
                 back for each frame; `grasp-raw` sends a matrix of 13 MB and `grasp-compressed` an image of 300 KB, for a small answer; \
                 `motion` asks with 2 KB for a path of 8 KB. Times are from request to answer.\n",
                "",
                Unit::Plain,
                Plot::Nothing,
            ),
            "fleet-step" => (
                "Fleet learning step",
                "Four robots each send an image, a server answers all with actions once it has all four; the step ends when the last robot \
                 has its own. `near` is 10 ms away and `far` 76 ms (round trip), without a limit of rate. SSH: each robot puts its image \
                 as a file by SFTP, the server writes answers as files, and each robot asks for its own until it is there; every \
                 robot keeps one connection open over all steps, so no handshake is in a step.\n",
                "robots",
                Unit::Plain,
                Plot::Bars("p50_us"),
            ),
            "fan-out" => {
                ("Fan-out", "One publisher, so many subscribers.\n", "subscribers", Unit::Plain, Plot::Curves)
            }
            "multi-hop" => (
                "Multi-hop",
                "Through so many routers, one after the other.\n",
                "routers",
                Unit::Plain,
                Plot::Curves,
            ),
            "teleop" => (
                "Teleop under load",
                "Commands to a robot (50 Hz × 64 B), its state (30 Hz × 700 B) and a camera (30 Hz × 60 KB) from it, which wants 14 Mbit/s \
                 of an uplink that carries 5, with a queue of 200 ms. Ages, from publishing to the subscriber.\n",
                "cameras",
                Unit::Plain,
                Plot::Nothing,
            ),
            "roaming" => (
                "Roaming",
                "A robot changes its address while a reliable topic of 50 Hz flows (0), and later changes back (1).\n",
                "return",
                Unit::Plain,
                Plot::Nothing,
            ),
            "footprint" => {
                ("Footprint", "Size, memory and idle CPU of processes.\n", "count", Unit::Plain, Plot::Curves)
            }
            other => (other, "", "", Unit::Plain, Plot::Nothing),
        };
        About { table, title, says, at, at_unit, plot }
    }
}

impl About<'_> {
    /// Whether its tables have a place each and metrics as columns, since there are more of these than places.
    fn has_many_metrics(&self) -> bool {
        matches!(self.table, "throughput" | real_ros2::TABLE | "teleop" | "roaming")
    }

    /// A place in words.
    fn place(&self, at: f64) -> String {
        match self.at_unit {
            Unit::Bytes => format!("messages of {}", Unit::Bytes.text(at)),
            unit => format!("{} {}", unit.text(at), self.at),
        }
    }
}

/// The tables of a run, the known ones first and in their order.
fn tables(figures: &Figures) -> Vec<&str> {
    const ORDER: [&str; 18] = [
        "round-trip",
        "throughput",
        real_ros2::TABLE,
        real_ros2::KEEP_ALL,
        real_ros2::ROUND_TRIP,
        real_ros2::RESTART,
        rmw_zenoh::TABLE,
        rmw_zenoh::ROUND_TRIP,
        rmw_zenoh::TELEOP,
        rmw_zenoh::IDLE,
        "start-up",
        "applications",
        "fleet-step",
        "fan-out",
        "multi-hop",
        "teleop",
        "roaming",
        "footprint",
    ];
    let mut tables = distinct(figures.figures.iter().map(|f| &*f.table));
    tables.sort_by_key(|table| ORDER.iter().position(|known| known == table).unwrap_or(ORDER.len()));
    tables
}

fn paths<'a>(figures: &'a Figures, table: &str) -> Vec<&'a str> {
    distinct(figures.figures.iter().filter(|f| f.table == table).map(|f| &*f.path))
}

/// In the order of their first appearance.
fn distinct<'a>(names: impl Iterator<Item = &'a str>) -> Vec<&'a str> {
    let mut distinct = Vec::new();
    for name in names {
        if !distinct.contains(&name) {
            distinct.push(name);
        }
    }
    distinct
}

/// The note beside goals.
const BESIDE: &str = "Ours is by QUIC, the default; *by TCP* is the same suite over the transport that most peers use here. \
                      *Bare relay* is what two programs reach that do nothing but carry messages between DDS and a TCP \
                      connection, in the clear: with short messages little is left to gain below it.";

fn goals_table(figures: &Figures) -> String {
    let goals = goals::judge(figures);
    let count = |verdict| goals.iter().filter(|g| g.verdict == verdict).count();
    let mut text = format!(
        "## Goals\n\n{} of {} met, {} missed, {} not measured in this run. {BESIDE}\n\n\
         | goal | bound | reached | | by TCP | bare relay |\n|---|---|---|---|---|---|\n",
        count(goals::Verdict::Met),
        goals.len(),
        count(goals::Verdict::Missed),
        count(goals::Verdict::NotMeasured),
    );
    for goal in &goals {
        let verdict = goal.verdict.text();
        let goals::Goal { what, bound, reached, by_tcp, by_relay, .. } = goal;
        let _ = writeln!(text, "| {what} | {bound} | {reached} | {verdict} | {by_tcp} | {by_relay} |");
    }
    text.push('\n');
    text
}

/// The tables of one path: systems are rows. Columns are the metrics where all is measured at one place, otherwise the
/// places, in a table for each metric.
fn path_tables(figures: &Figures, about: &About<'_>, path: &str) -> String {
    let here: Vec<_> = figures.figures.iter().filter(|f| f.table == about.table && f.path == path).collect();
    let families = families(&here);
    let systems = systems(here.iter().map(|f| &*f.system));
    let mut places: Vec<f64> = here.iter().map(|f| f.at).collect();
    places.sort_unstable_by(f64::total_cmp);
    places.dedup();
    let cell =
        |family: &Family<'_>, system: &str, at: f64| family.cell(figures, about.table, system, path, at);
    let mut text = String::new();
    if places.len() == 1 || about.has_many_metrics() {
        for at in places {
            let place = if about.at.is_empty() || (at == 0.0 && !about.has_many_metrics()) {
                String::new()
            } else {
                format!(", {}", about.place(at))
            };
            let _ = writeln!(text, "{}{place}\n", path_name(path));
            let is_any = |family: &&Family<'_>| {
                systems.iter().any(|system| family.is_measured(figures, about.table, system, path, at))
            };
            let families: Vec<_> = families.iter().filter(is_any).collect();
            header(&mut text, &families.iter().map(|family| family.name()).collect::<Vec<_>>());
            for system in &systems {
                let is_measured =
                    |family: &&Family<'_>| family.is_measured(figures, about.table, system, path, at);
                if families.iter().any(is_measured) {
                    row(&mut text, system, families.iter().map(|family| cell(family, system, at)));
                }
            }
            text.push('\n');
        }
        return text;
    }
    for family in &families {
        if family.first() == "lost" && here.iter().all(|f| f.metric != "lost" || f.value == 0.0) {
            let _ = writeln!(text, "{}: nothing lost\n", path_name(path));
            continue;
        }
        let _ = writeln!(text, "{}: {}, by {}\n", path_name(path), family.name(), or(about.at, "count"));
        let is_any =
            |at: &f64| systems.iter().any(|s| family.is_measured(figures, about.table, s, path, *at));
        let places: Vec<_> = places.iter().copied().filter(is_any).collect();
        let head: Vec<_> = places.iter().map(|at| about.at_unit.text(*at)).collect();
        header(&mut text, &head);
        for system in &systems {
            if places.iter().any(|at| family.is_measured(figures, about.table, system, path, *at)) {
                row(&mut text, system, places.iter().map(|at| cell(family, system, *at)));
            }
        }
        text.push('\n');
    }
    text
}

fn or<'a>(text: &'a str, otherwise: &'a str) -> &'a str {
    if text.is_empty() { otherwise } else { text }
}

fn header(text: &mut String, columns: &[String]) {
    let _ = writeln!(text, "| | {} |\n|---|{}", columns.join(" | "), "---:|".repeat(columns.len()));
}

fn row(text: &mut String, system: &str, cells: impl Iterator<Item = String>) {
    let cells: Vec<_> = cells.collect();
    let _ = writeln!(text, "| {} | {} |", system_name(system), cells.join(" | "));
}

/// A path in words.
fn path_name(path: &str) -> String {
    let name = match path {
        "bare" => "Bare link (`bare`)",
        "paper" => "76 ms round trip, 5 Mbit/s (`paper`)",
        "lossy" => "40 ms round trip, 50 Mbit/s, 2 % loss (`lossy`)",
        real_ros2::JAZZY_KILTED => "Jazzy to Kilted, bare link (`jazzy-kilted`)",
        real_ros2::KILTED_JAZZY => "Kilted to Jazzy, bare link (`kilted-jazzy`)",
        "near" => "10 ms round trip (`near`)",
        "far" => "76 ms round trip (`far`)",
        "uplink" => "Uplink of 5 Mbit/s",
        rmw_zenoh::UPLINK => "Uplink of 2 Mbit/s",
        "uplink-40ms" => "Uplink of 5 Mbit/s, 40 ms one way",
        other => return format!("`{other}`"),
    };
    name.to_owned()
}

/// Metrics that are shown in one cell: one alone, or p50, p99 and longest of the same.
#[derive(Debug, PartialEq)]
struct Family<'a> {
    metrics: Vec<&'a str>,
}

/// The quantiles of a distribution, in the order of a cell.
const QUANTILES: [&str; 3] = ["p50", "p99", "max"];

/// A metric without its quantile, if it has one: `state_p50_us` is `state_?_us`.
fn stem(metric: &str) -> (String, Option<usize>) {
    let mut quantile = None;
    let words: Vec<_> = metric
        .split('_')
        .map(|word| match QUANTILES.iter().position(|q| *q == word) {
            Some(at) if quantile.is_none() => {
                quantile = Some(at);
                "?"
            }
            _ => word,
        })
        .collect();
    (words.join("_"), quantile)
}

fn families<'a>(figures: &[&'a Figure]) -> Vec<Family<'a>> {
    let mut families: Vec<(String, Family<'a>)> = Vec::new();
    for metric in distinct(figures.iter().map(|f| &*f.metric)) {
        let (stem, _) = stem(metric);
        match families.iter_mut().find(|(known, _)| *known == stem) {
            Some((_, family)) => family.metrics.push(metric),
            None => families.push((stem, Family { metrics: vec![metric] })),
        }
    }
    for (_, family) in &mut families {
        family.metrics.sort_by_key(|metric| stem(metric).1);
    }
    families.into_iter().map(|(_, family)| family).collect()
}

impl Family<'_> {
    /// The metric that plots and ratios take: the median where there is one.
    fn first(&self) -> &str {
        self.metrics.first().copied().unwrap_or_default()
    }

    /// The head of its column.
    fn name(&self) -> String {
        let (unit, _, words) = measure(self.first());
        let quantiles: Vec<_> = self
            .metrics
            .iter()
            .filter_map(|m| stem(m).1)
            .filter_map(|at| QUANTILES.get(at))
            .copied()
            .collect();
        let mut name: Vec<_> = words.split(' ').filter(|w| !w.is_empty() && !QUANTILES.contains(w)).collect();
        let quantiles = quantiles.join(" / ");
        if !quantiles.is_empty() {
            name.push(&quantiles);
        }
        match (name.is_empty(), unit) {
            (true, Unit::PerSecond) => "a second".into(),
            (true, _) => self.first().to_owned(),
            _ => name.join(" "),
        }
    }

    fn is_measured(&self, figures: &Figures, table: &str, system: &str, path: &str, at: f64) -> bool {
        self.metrics.iter().any(|metric| figures.value(table, system, path, at, metric).is_some())
    }

    /// Its numbers with the unit of the first, or a dash.
    fn cell(&self, figures: &Figures, table: &str, system: &str, path: &str, at: f64) -> String {
        let (unit, factor, _) = measure(self.first());
        let value = |metric: &&str| figures.value(table, system, path, at, metric).map(|v| v * factor);
        let values: Vec<_> = self.metrics.iter().map(value).collect();
        let Some(first) = values.iter().flatten().next() else { return "–".into() };
        let (scale, unit) = unit.scale(*first);
        let numbers: Vec<_> =
            values.iter().map(|v| v.map_or_else(|| "–".into(), |v| three_digits(v / scale))).collect();
        let unit = if unit == "/s" { "" } else { unit };
        join(&numbers.join(" / "), unit)
    }
}

/// Parses a metric's name to its unit, the factor to it, and the name in words.
fn measure(metric: &str) -> (Unit, f64, String) {
    const SUFFIXES: [(&str, Unit, f64); 7] = [
        ("us", Unit::Seconds, 1e-6),
        ("ms", Unit::Seconds, 1e-3),
        ("seconds", Unit::Seconds, 1.0),
        ("s", Unit::Seconds, 1.0),
        ("bytes", Unit::Bytes, 1.0),
        ("per_second", Unit::PerSecond, 1.0),
        ("percent", Unit::Percent, 1.0),
    ];
    for (suffix, unit, factor) in SUFFIXES {
        let Some(name) = metric.strip_suffix(suffix) else { continue };
        if name.is_empty() || name.ends_with('_') {
            let name = name.trim_end_matches('_');
            let rate = if suffix == "per_second" && !name.is_empty() { " a second" } else { "" };
            return (unit, factor, format!("{}{rate}", name.replace('_', " ")));
        }
    }
    // `cpu_us_per_message`: the unit is within.
    for (inner, unit, factor) in [("_us_per_", Unit::Seconds, 1e-6), ("_bytes_per_", Unit::Bytes, 1.0)] {
        if metric.contains(inner) {
            return (unit, factor, metric.replace(inner, " a ").replace('_', " "));
        }
    }
    (Unit::Plain, 1.0, metric.replace('_', " "))
}

/// A system's place among the others, by the parts of its name.
fn systems<'a>(names: impl Iterator<Item = &'a str>) -> Vec<&'a str> {
    const PEERS: [&str; 13] = [
        real_ros2::ONE_HOST,
        "tcp",
        "direct",
        "relay",
        "relay-gathers",
        "relay-forwarder",
        "wireguard",
        "dds-security",
        "zenoh-tcp",
        "zenoh-tls",
        "rosbridge",
        "ssh",
        "zenoh-bridge",
    ];
    let peers: Vec<_> = PEERS.into_iter().chain(WITH_RMW_ZENOH).collect();
    let mut systems = distinct(names);
    let place = |name: &&str| match Sgc::parse(name) {
        None => (peers.iter().position(|peer| peer == name).unwrap_or(peers.len()), 0, 0, false),
        Some(sgc) => {
            let at = |all: &[&str], it: &str| all.iter().position(|one| *one == it).unwrap_or(all.len());
            (peers.len() + 1, at(&SCHEMES, sgc.scheme), at(&SUITES, sgc.suite), sgc.is_routed)
        }
    };
    systems.sort_by_key(place);
    systems
}

const SCHEMES: [&str; 4] = ["quic", "dtls", "tls", "tcp"];
const SUITES: [&str; 4] = ["group", "pairwise", "standard", "paper"];

/// The parts of `sgc-quic-group-router`.
struct Sgc<'a> {
    scheme: &'a str,
    suite: &'a str,
    is_routed: bool,
}

impl<'a> Sgc<'a> {
    fn parse(system: &'a str) -> Option<Self> {
        let mut words = system.strip_prefix("sgc-")?.split('-');
        let (scheme, suite) = (words.next()?, words.next()?);
        let is_routed = match (words.next(), words.next()) {
            (None, _) => false,
            (Some("router"), None) => true,
            _ => return None,
        };
        SUITES.contains(&suite).then_some(Self { scheme, suite, is_routed })
    }
}

/// A system in words.
fn system_name(system: &str) -> String {
    if let Some(Sgc { scheme, suite, is_routed }) = Sgc::parse(system) {
        let router = if is_routed { ", with a router" } else { "" };
        return format!("sgc {}, {suite}{router}", scheme.to_uppercase());
    }
    let name = match system {
        "tcp" => "plain TCP",
        "direct" => "direct DDS",
        real_ros2::ONE_HOST => "one host, shared memory",
        "relay" => "bare relay, TCP",
        "relay-gathers" => "bare relay, TCP, gathering",
        "wireguard" => "DDS over WireGuard",
        "dds-security" => "DDS Security",
        "zenoh-tcp" => "Zenoh bridge, TCP",
        "zenoh-tls" => "Zenoh bridge, TLS",
        "zenoh-bridge" => "Zenoh bridge",
        "rmw-zenoh-one-host" => "rmw_zenoh, one host",
        "rmw-zenoh-one-router" => "rmw_zenoh, one Zenoh router",
        "rmw-zenoh-two-routers" => "rmw_zenoh, two Zenoh routers",
        "sgc-zenoh-zenoh" => "sgc, Zenoh to Zenoh",
        "sgc-dds-zenoh" => "sgc, DDS to Zenoh",
        "sgc-dds-dds" => "sgc, DDS to DDS",
        "ssh" => "SSH and SFTP",
        "sgc-proxy" => "sgc proxy that shares",
        "sgc-proxy-use" => "sgc proxy that uses",
        "sgc-router" => "sgc router",
        other => other,
    };
    name.to_owned()
}

/// Colour by what carries it, line by how it is sealed.
fn look(system: &str) -> (Hue, Stroke) {
    if let Some(Sgc { scheme, suite, is_routed }) = Sgc::parse(system) {
        let hue = match (scheme, is_routed) {
            (_, true) => Hue::Teal,
            ("quic", _) => Hue::Blue,
            ("dtls", _) => Hue::Green,
            ("tls", _) => Hue::Purple,
            _ => Hue::Teal,
        };
        let stroke = match suite {
            "group" => Stroke::Solid,
            "pairwise" => Stroke::DashDotted,
            "standard" => Stroke::Dashed,
            _ => Stroke::Dotted,
        };
        return (hue, stroke);
    }
    match system {
        "sgc-proxy-use" => (Hue::Blue, Stroke::Dashed),
        "direct" => (Hue::Grey, Stroke::Solid),
        "tcp" | real_ros2::ONE_HOST => (Hue::Grey, Stroke::Dashed),
        "relay" | "relay-gathers" => (Hue::Grey, Stroke::Dotted),
        "wireguard" => (Hue::Orange, Stroke::Solid),
        "dds-security" => (Hue::Olive, Stroke::Solid),
        "zenoh-tls" => (Hue::Pink, Stroke::Dashed),
        "rmw-zenoh-one-host" => (Hue::Pink, Stroke::Dotted),
        "rmw-zenoh-one-router" => (Hue::Pink, Stroke::Dashed),
        "sgc-dds-zenoh" => (Hue::Blue, Stroke::Dashed),
        "sgc-dds-dds" => (Hue::Blue, Stroke::Dotted),
        s if s.starts_with("zenoh") || s.starts_with("rmw-zenoh") => (Hue::Pink, Stroke::Solid),
        "ssh" | "rosbridge" => (Hue::Brown, Stroke::Solid),
        s if s.contains("router") => (Hue::Teal, Stroke::Solid),
        _ => (Hue::Blue, Stroke::Solid),
    }
}

/// Every plot of a table.
fn plots(figures: &Figures, about: &About<'_>) -> Vec<Page> {
    match about.plot {
        Plot::Nothing => Vec::new(),
        Plot::Bars(metric) => bar_plots(figures, about, metric),
        Plot::Curves => {
            let paths = paths(figures, about.table);
            paths.into_iter().flat_map(|path| curve_plots(figures, about, path)).collect()
        }
    }
}

/// More lines than this in one plot cannot be told apart.
const LINES_MAX: usize = 10;

/// Metrics that say how far to trust the others: they are in the tables.
const NOT_DRAWN: [&str; 3] = ["samples", "lost", GAVE_UP];

/// A plot for each metric that was measured at several places. Where there are many systems, one with SGC's default
/// transport beside the others, and one with SGC's transports alone.
fn curve_plots(figures: &Figures, about: &About<'_>, path: &str) -> Vec<Page> {
    let here: Vec<_> = figures.figures.iter().filter(|f| f.table == about.table && f.path == path).collect();
    let names = systems(here.iter().map(|f| &*f.system));
    let is_peer = |name: &&&str| Sgc::parse(name).is_none_or(|s| s.scheme == "quic");
    let is_direct = |name: &&&str| Sgc::parse(name).is_some_and(|s| !s.is_routed);
    let choices: Vec<(&str, Vec<&str>)> = if names.len() <= LINES_MAX {
        vec![("", names)]
    } else {
        vec![
            ("", names.iter().filter(is_peer).copied().collect()),
            ("-transports", names.iter().filter(is_direct).copied().collect()),
        ]
    };
    let mut pages = Vec::new();
    for family in families(&here) {
        let metric = family.first();
        if NOT_DRAWN.contains(&metric) {
            continue;
        }
        let (unit, factor, words) = measure(metric);
        for (suffix, names) in &choices {
            let series: Vec<_> = names
                .iter()
                .filter_map(|system| {
                    let its = here.iter().filter(|f| f.system == *system && f.metric == metric);
                    // The last measurement at a place counts, as in the tables.
                    let mut points: Vec<_> = its.rev().map(|f| (f.at, f.value * factor)).collect();
                    points.sort_by(|a, b| a.0.total_cmp(&b.0));
                    points.dedup_by_key(|point| point.0);
                    let (hue, stroke) = look(system);
                    (!points.is_empty()).then(|| Series { name: system_name(system), hue, stroke, points })
                })
                .collect();
            // A place alone is no curve: it is in the table.
            if series.iter().all(|line| line.points.len() < 2) {
                continue;
            }
            let x = Axis { title: or(about.at, "count"), unit: about.at_unit };
            let words = if words.is_empty() { "a second".to_owned() } else { words.clone() };
            let title = format!("{}, {}: {words}", about.title, path_name(path).replace('`', ""));
            let y = Axis { title: axis_title(&words, unit), unit };
            let svg = plot::curves(&title, &x, &y, &series);
            let name =
                format!("{PLOT_PREFIX}{}-{}-{}{suffix}.svg", about.table, file_part(path), file_part(metric));
            pages.extend(svg.map(|text| Page { name, text }));
        }
    }
    pages
}

/// Returns the title of a vertical axis.
fn axis_title(words: &str, unit: Unit) -> &str {
    match (words, unit) {
        ("p50" | "", Unit::Seconds) => "median time",
        ("", _) => "value",
        (words, _) => words,
    }
}

/// A plot for each place of the table, with a group of bars for each path.
fn bar_plots(figures: &Figures, about: &About<'_>, metric: &str) -> Vec<Page> {
    let here: Vec<_> =
        figures.figures.iter().filter(|f| f.table == about.table && f.metric == metric).collect();
    let mut places: Vec<f64> = here.iter().map(|f| f.at).collect();
    places.sort_unstable_by(f64::total_cmp);
    places.dedup();
    let (unit, factor, _) = measure(metric);
    let tail_metric = metric.replace("p50", "p99");
    let mut pages = Vec::new();
    for at in places {
        let groups: Vec<_> = distinct(here.iter().filter(|f| f.at == at).map(|f| &*f.path))
            .into_iter()
            .map(|path| {
                let value = |system: &str, metric: &str| {
                    figures.value(about.table, system, path, at, metric).map(|v| v * factor)
                };
                let names = systems(here.iter().filter(|f| f.at == at && f.path == path).map(|f| &*f.system));
                let bars = names.into_iter().filter_map(|system| {
                    let (hue, stroke) = look(system);
                    let tail = if tail_metric == metric { None } else { value(system, &tail_metric) };
                    Some(Bar { name: system_name(system), hue, stroke, value: value(system, metric)?, tail })
                });
                (path_name(path).replace('`', ""), bars.collect())
            })
            .collect();
        let title = format!("{}, {}", about.title, about.place(at));
        let what = match unit {
            Unit::PerSecond => "messages a second; longer is better",
            _ if tail_metric != metric => "median, and the line to p99; shorter is better",
            _ => "shorter is better",
        };
        let svg = plot::bars(&title, &Axis { title: what, unit }, &groups);
        let name = format!("{PLOT_PREFIX}{}-{}.svg", about.table, file_part(&about.at_unit.text(at)));
        pages.extend(svg.map(|text| Page { name, text }));
    }
    pages
}

/// Letters and digits of a name, the rest as dashes: what links and file systems take.
fn file_part(name: &str) -> String {
    let word = |c: char| if c.is_ascii_alphanumeric() || c == '.' { c.to_ascii_lowercase() } else { '-' };
    name.replace('\u{a0}', "").chars().map(word).collect()
}

fn write(dir: &Path, page: &Page) -> Result<()> {
    fs::create_dir_all(dir).with_context(|| dir.display().to_string())?;
    let path = dir.join(&page.name);
    fs::write(&path, &page.text).with_context(|| path.display().to_string())
}

#[cfg(test)]
mod tests {
    use super::*;

    fn run(figures: Figures) -> Run {
        Run::here(figures, false)
    }

    fn page(run: &Run, name: &str) -> String {
        let pages = run.pages();
        let names: Vec<_> = pages.iter().map(|p| p.name.clone()).collect();
        pages
            .into_iter()
            .find(|p| p.name == name)
            .unwrap_or_else(|| panic!("{name} is not in {names:?}"))
            .text
    }

    #[test]
    fn systems_are_rows_and_places_are_columns() {
        let mut figures = Figures::default();
        for (at, p50, p99) in [(16.0, 170.0, 300.0), (1e6, 7500.0, 11_000.0)] {
            figures.push("round-trip", "sgc-quic-group", "bare", at, "p50_us", p50);
            figures.push("round-trip", "sgc-quic-group", "bare", at, "p99_us", p99);
        }
        figures.push("round-trip", "direct", "bare", 16.0, "p50_us", 100.0);
        let text = page(&run(figures), "report.md");
        assert!(
            text.contains("Bare link (`bare`): p50 / p99, by bytes of a message\n\n| | 16 B | 1 MB |\n"),
            "{text}"
        );
        assert!(text.contains("| direct DDS | 100 / – µs | – |\n"), "{text}");
        assert!(text.contains("| sgc QUIC, group | 170 / 300 µs | 7.5 / 11 ms |\n"), "{text}");
    }

    #[test]
    fn at_one_place_metrics_are_columns() {
        let mut figures = Figures::default();
        figures.push("applications", "direct", "bare", 0.0, "vslam_p50_us", 4000.0);
        figures.push("applications", "direct", "bare", 0.0, "vslam_p99_us", 9000.0);
        figures.push("applications", "direct", "bare", 0.0, "vslam_frames_per_second", 29.97);
        let text = page(&run(figures), "report.md");
        assert!(text.contains("| | vslam p50 / p99 | vslam frames a second |"), "{text}");
        assert!(text.contains("| direct DDS | 4 / 9 ms | 30 |"), "{text}");
    }

    #[test]
    fn tables_and_metrics_that_are_not_known_are_shown() {
        let mut figures = Figures::default();
        figures.push("new-one", "theirs", "moon", 3.0, "rocks", 12.0);
        let text = page(&run(figures), "report.md");
        assert!(text.contains("## new-one") && text.contains("| theirs | 12 |"), "{text}");
    }

    #[test]
    fn metrics_say_their_units() {
        let cases = [
            ("p50_us", Unit::Seconds, "p50"),
            ("cpu_us_per_message", Unit::Seconds, "cpu a message"),
            ("rss_bytes", Unit::Bytes, "rss"),
            ("per_second", Unit::PerSecond, ""),
            ("vslam_frames_per_second", Unit::PerSecond, "vslam frames a second"),
            ("idle_cpu_percent", Unit::Percent, "idle cpu"),
            ("start_seconds", Unit::Seconds, "start"),
            ("lost", Unit::Plain, "lost"),
            ("class", Unit::Plain, "class"),
        ];
        for (metric, unit, words) in cases {
            let (its_unit, _, its_words) = measure(metric);
            assert_eq!((its_unit, &*its_words), (unit, words), "{metric}");
        }
    }

    #[test]
    fn report_lists_omitted_measurements() {
        let mut figures = Figures::default();
        figures.leave_out("rosbridge", "no ROS 2 is installed here");
        let text = page(&run(figures), "report.md");
        assert!(text.contains("- rosbridge: no ROS 2 is installed here"), "{text}");
    }

    #[test]
    fn many_systems_are_drawn_in_two_plots() {
        let mut figures = Figures::default();
        let ours = SCHEMES.iter().flat_map(|s| SUITES.iter().map(move |c| format!("sgc-{s}-{c}")));
        for system in ours.chain(["direct".into(), "zenoh-tcp".into()]) {
            figures.push("round-trip", &system, "bare", 16.0, "p50_us", 100.0);
            figures.push("round-trip", &system, "bare", 1e6, "p50_us", 9000.0);
        }
        let run = run(figures);
        let peers = page(&run, "compare-round-trip-bare-p50-us.svg");
        assert!(peers.contains("Zenoh bridge, TCP") && !peers.contains("sgc TLS"));
        let transports = page(&run, "compare-round-trip-bare-p50-us-transports.svg");
        assert!(transports.contains("sgc TLS, paper") && !transports.contains("Zenoh"));
    }

    #[test]
    fn a_run_is_rendered_again_from_its_file_without_plots_of_an_earlier_one() {
        let dir = tempfile::tempdir().unwrap();
        let stale = dir.path().join("compare-fan-out-bare-p50-us.svg");
        let foreign = dir.path().join("other.svg");
        fs::write(&stale, "").unwrap();
        fs::write(&foreign, "").unwrap();
        let mut figures = Figures::default();
        figures.push("throughput", "direct", "bare", 1000.0, "per_second", 125_900.0);
        let run = run(figures);
        run.write(dir.path()).unwrap();
        let again = Run::read(&dir.path().join("compare.json")).unwrap();
        again.render(dir.path()).unwrap();
        let text = fs::read_to_string(dir.path().join("report.md")).unwrap();
        assert_eq!(text, page(&run, "report.md"));
        assert!(dir.path().join("compare-throughput-1-kb.svg").exists());
        assert!(!stale.exists() && foreign.exists());
    }
}
