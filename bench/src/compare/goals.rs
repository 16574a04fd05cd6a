//! The project's goals, each judged by the figures of one run: met, missed, or not measured.
//!
//! A goal against another system is a ratio to that system's figure in the same run, because times differ from machine
//! to machine. This module judges and measures nothing.

use super::figures::{Figure, Figures};
use super::plot::Unit;
use super::real_ros2::{self, JAZZY_KILTED, KILTED_JAZZY};
use super::round_trip::GAVE_UP;

/// A goal and what became of it.
#[derive(Debug, PartialEq)]
pub(crate) struct Goal {
    /// The subject of the goal.
    pub(crate) what: String,
    /// The bound, with its unit.
    pub(crate) bound: String,
    /// The reached figures: the worst of the parts, or each of them.
    pub(crate) reached: String,
    /// The figures over TCP, where they were measured and the transport matters.
    pub(crate) by_tcp: String,
    /// The figures of programs that only carry messages; empty where they say nothing.
    pub(crate) by_relay: String,
    /// Whether that is within the bound.
    pub(crate) verdict: Verdict,
}

/// Whether a goal is met.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Verdict {
    /// Every part of it was measured and is within the bound.
    Met,
    /// A part of it is not within the bound.
    Missed,
    /// A part of it was not measured, and those that were are within the bound.
    NotMeasured,
}

impl Verdict {
    /// As it stands in the report.
    pub(crate) fn text(self) -> &'static str {
        match self {
            Self::Met => "met",
            Self::Missed => "**missed**",
            Self::NotMeasured => "not measured",
        }
    }
}

/// The suite that costs least, over the default transport.
const GROUP: &str = "sgc-quic-group";
/// The system with default settings.
const PAIRWISE: &str = "sgc-quic-pairwise";
/// The suite in which each message is signed.
const STANDARD: &str = "sgc-quic-standard";
/// The same suites over the transport that the peers of most goals use.
const GROUP_TCP: &str = "sgc-tcp-group";
const STANDARD_TCP: &str = "sgc-tcp-standard";
const ZENOH: &str = "zenoh-tcp";
/// Minimal systems with a program at each place; the better of both counts.
const RELAYS: [&str; 2] = ["relay", "relay-gathers"];
/// The first of them, with a program between that forwards the bytes of the connection.
const FORWARDER: &str = "relay-forwarder";
/// Sizes of messages, bytes, that are small.
const SMALL: [f64; 4] = [16.0, 100.0, 1e3, 8e3];
const SIZES: [f64; 7] = [16.0, 100.0, 1e3, 8e3, 64e3, 1e6, 13e6];
const LARGE: f64 = 1e6;
const HUGE: f64 = 13e6;
const MESSAGE: f64 = 1e3;
/// 64 KB may mean 64 000 or 65 536: so far a size may be from the one that is asked for.
const SIZE_TOLERANCE: f64 = 0.1;

/// One thing that a goal asks for.
struct Part {
    /// Where: a size, a path.
    label: String,
    /// `None` if it was not measured.
    value: Option<f64>,
}

#[derive(Clone, Copy)]
enum Bound {
    AtMost(f64),
    AtLeast(f64),
}

impl Bound {
    fn holds(self, value: f64) -> bool {
        match self {
            Self::AtMost(most) => value <= most,
            Self::AtLeast(least) => value >= least,
        }
    }

    /// The bound and numbers beside it, in the same unit. A ratio has none.
    fn text(self, unit: Option<Unit>) -> String {
        let (sign, value) = match self {
            Self::AtMost(most) => ("≤", most),
            Self::AtLeast(least) => ("≥", least),
        };
        format!("{sign} {}", number(value, unit))
    }
}

fn number(value: f64, unit: Option<Unit>) -> String {
    let Some(unit) = unit else {
        // As exactly as it takes to see on which side of 1 a ratio is.
        let ratio = if value < 10.0 { (value * 1e3).round() / 1e3 } else { value.round() };
        return format!("{ratio} ×");
    };
    unit.text(value)
}

fn goal(what: impl Into<String>, bound: Bound, unit: Option<Unit>, parts: Vec<Part>) -> Goal {
    let is_missed = parts.iter().any(|p| p.value.is_some_and(|v| !bound.holds(v)));
    let is_whole = !parts.is_empty() && parts.iter().all(|p| p.value.is_some());
    let verdict = match (is_missed, is_whole) {
        (true, _) => Verdict::Missed,
        (false, true) => Verdict::Met,
        (false, false) => Verdict::NotMeasured,
    };
    let (by_tcp, by_relay) = (String::new(), String::new());
    Goal { what: what.into(), bound: bound.text(unit), reached: say(&parts, unit), by_tcp, by_relay, verdict }
}

fn say(parts: &[Part], unit: Option<Unit>) -> String {
    let one = |part: &Part| {
        let value = part.value.map_or_else(|| "–".into(), |v| number(v, unit));
        if part.label.is_empty() { value } else { format!("{}: {value}", part.label) }
    };
    parts.iter().map(one).collect::<Vec<_>>().join(", ")
}

/// Nothing if nothing was measured.
fn say_measured(parts: &[Part]) -> String {
    if parts.iter().any(|part| part.value.is_some()) { say(parts, None) } else { String::new() }
}

impl Goal {
    /// With the ratios that were reached by TCP, and by a relay.
    fn beside(self, by_tcp: &[Part], by_relay: &[Part]) -> Self {
        Self { by_tcp: say_measured(by_tcp), by_relay: say_measured(by_relay), ..self }
    }
}

/// Returns every goal.
pub(crate) fn judge(figures: &Figures) -> Vec<Goal> {
    let run = Run { figures };
    let mut goals = run.round_trips();
    goals.extend(run.rates());
    goals.extend(run.router());
    goals.push(run.losses());
    goals.extend(
        [("group", GROUP), ("pairwise", PAIRWISE), ("standard", STANDARD)]
            .into_iter()
            .flat_map(|suite| run.real_ros2(suite)),
    );

    goals.extend(run.real_ros2_to_bridge());

    let thin = ["paper", "lossy"];
    let huge = |path| run.ratio(("round-trip", path, HUGE, "p50_us"), STANDARD, "tcp");
    let parts = thin.iter().map(|path| part(path, huge(path))).collect();
    goals.push(goal("13 MB over the thin links: `standard` to plain TCP", Bound::AtMost(1.1), None, parts));
    for path in thin {
        let beside = |&at: &f64| {
            let place = ("round-trip", path, at, "p50_us");
            match run.patience(path, at, "wireguard") {
                None => run.at_size(at, run.ratio(place, STANDARD, "wireguard")),
                // It takes longer than that, so the ratio is less than this.
                Some(waited) => Part {
                    label: format!("{}, none came back over WireGuard", Unit::Bytes.text(at)),
                    value: run.number(place, STANDARD).map(|ours| ours / waited),
                },
            }
        };
        let what = format!("Round trip p50, every size, `{path}`: `standard` to DDS over WireGuard");
        let goal = goal(what, Bound::AtMost(1.0), None, SIZES.iter().map(beside).collect());
        let of = |ours: &str| {
            let ratio = |&at: &f64| run.ratio(("round-trip", path, at, "p50_us"), ours, "wireguard");
            SIZES.iter().map(|at| run.at_size(*at, ratio(at))).collect::<Vec<_>>()
        };
        goals.push(goal.beside(&of(STANDARD_TCP), &of(RELAYS[0])));
    }
    goals.extend(run.teleop());
    goals.extend(run.roaming());

    let step = |path| run.ratio(("fleet-step", path, FLEET, "p50_us"), STANDARD, "ssh");
    let parts = ["near", "far"].map(|path| part(path, step(path))).into();
    goals.push(goal(
        "Fleet step, p50: `standard` to files over SSH and SFTP",
        Bound::AtMost(0.36),
        None,
        parts,
    ));
    goals.extend(run.footprint());
    goals
}

/// Robots of the fleet step.
const FLEET: f64 = 4.0;

fn part(label: &str, value: Option<f64>) -> Part {
    Part { label: label.to_owned(), value }
}

struct Run<'a> {
    figures: &'a Figures,
}

/// Table, path, size and metric of a number.
type Place<'a> = (&'a str, &'a str, f64, &'a str);

impl Run<'_> {
    /// The number of a system, at about this size.
    fn number(&self, (table, path, at, metric): Place<'_>, system: &str) -> Option<f64> {
        let is_it = |f: &&Figure| {
            (&*f.table, &*f.system, &*f.path, &*f.metric) == (table, system, path, metric)
                && (f.at - at).abs() <= at * SIZE_TOLERANCE
        };
        self.figures.figures.iter().rev().find(is_it).map(|f| f.value)
    }

    /// Ours by theirs, at the same place.
    fn ratio(&self, place: Place<'_>, ours: &str, theirs: &str) -> Option<f64> {
        let (ours, theirs) = (self.number(place, ours)?, self.number(place, theirs)?);
        (theirs > 0.0).then(|| ours / theirs)
    }

    /// The better relay by theirs, at the same place.
    fn by_relay(&self, place: Place<'_>, theirs: &str, better: fn(f64, f64) -> f64) -> Option<f64> {
        RELAYS.iter().filter_map(|relay| self.ratio(place, relay, theirs)).reduce(better)
    }

    /// Ours by the better relay, at the same place.
    fn to_relay(&self, place: Place<'_>, ours: &str, better: fn(f64, f64) -> f64) -> Option<f64> {
        let relay = RELAYS.iter().filter_map(|relay| self.number(place, relay)).reduce(better)?;
        self.number(place, ours).filter(|_| relay > 0.0).map(|ours| ours / relay)
    }

    /// Round trips on the bare path, of each size.
    fn bare(&self, sizes: &[f64], metric: &str, ours: &str, theirs: &str) -> Vec<Part> {
        let part = |&at: &f64| self.at_size(at, self.ratio(("round-trip", "bare", at, metric), ours, theirs));
        sizes.iter().map(part).collect()
    }

    /// Messages there and back, one at a time.
    fn round_trips(&self) -> Vec<Goal> {
        /// A suite, its systems by QUIC and perhaps by TCP, and the bounds of p50 and p99.
        type Suite = (&'static str, &'static str, Option<&'static str>, [f64; 2]);
        const SUITES: [Suite; 3] = [
            ("group", GROUP, Some(GROUP_TCP), [0.7, 0.75]),
            ("pairwise", PAIRWISE, None, [0.85, 0.9]),
            ("standard", STANDARD, Some(STANDARD_TCP), [1.0, 1.0]),
        ];
        /// Sizes of messages, and the bound of `group` to the relay.
        const TO_RELAY: [(&str, &[f64], f64); 4] = [
            ("16 B to 1 KB", &[16.0, 100.0, 1e3], 1.2),
            ("8 KB and 64 KB", &[8e3, 64e3], 1.25),
            ("1 MB", &[LARGE], 1.15),
            ("13 MB", &[HUGE], 1.0),
        ];
        let mut goals = Vec::new();
        for (number, (tail, metric)) in [("p50", "p50_us"), ("p99", "p99_us")].into_iter().enumerate() {
            let relay = |&at: &f64| {
                self.at_size(at, self.by_relay(("round-trip", "bare", at, metric), ZENOH, f64::min))
            };
            let by_relay: Vec<_> = SMALL.iter().map(relay).collect();
            for (suite, ours, by_tcp, bounds) in SUITES {
                let what = format!(
                    "Round trip {tail}, 16 B to 8 KB, bare link: `{suite}` to the Zenoh bridge over TCP"
                );
                let ours = self.bare(&SMALL, metric, ours, ZENOH);
                let by_tcp = by_tcp.map(|tcp| self.bare(&SMALL, metric, tcp, ZENOH)).unwrap_or_default();
                goals.push(goal(what, Bound::AtMost(bounds[number]), None, ours).beside(&by_tcp, &by_relay));
            }
        }
        for (sizes, all, bound) in TO_RELAY {
            let to_relay = |ours: &str| {
                let part = |&at: &f64| {
                    let place = ("round-trip", "bare", at, "p50_us");
                    self.at_size(at, self.to_relay(place, ours, f64::min))
                };
                all.iter().map(part).collect::<Vec<_>>()
            };
            let what = format!("Round trip p50, {sizes}, bare link: `group` to the bare relay");
            goals.push(
                goal(what, Bound::AtMost(bound), None, to_relay(GROUP)).beside(&to_relay(GROUP_TCP), &[]),
            );
        }
        goals
    }

    /// Messages one way without pause.
    fn rates(&self) -> Vec<Goal> {
        /// A suite, its systems by QUIC and perhaps by TCP, and the bounds to the bridge and to the relay.
        type Suite = (&'static str, &'static str, Option<&'static str>, [f64; 2]);
        const SUITES: [Suite; 2] =
            [("group", GROUP, Some(GROUP_TCP), [1.15, 0.92]), ("pairwise", PAIRWISE, None, [1.1, 0.87])];
        /// Sizes, and the bounds of messages a second and of processor time a message.
        const SIZES: [(f64, Option<f64>, f64); 4] =
            [(100.0, None, 0.9), (MESSAGE, None, 0.9), (64e3, Some(1.1), 0.95), (LARGE, Some(1.2), 0.85)];
        let place = |at, metric| ("throughput", "bare", at, metric);
        let rate = |at| place(at, "per_second");
        let one = |value| vec![part("", value)];
        let mut goals = Vec::new();
        for (suite, ours, by_tcp, [to_bridge, to_relay]) in SUITES {
            let over = |whom: &str| format!("Messages of 1000 B a second: `{suite}` to the {whom}");
            let bridge = |ours| one(self.ratio(rate(MESSAGE), ours, ZENOH));
            let relay = |ours| one(self.to_relay(rate(MESSAGE), ours, f64::max));
            let by_relay = [part("", self.by_relay(rate(MESSAGE), ZENOH, f64::max))];
            goals.extend([
                goal(over("Zenoh bridge over TCP"), Bound::AtLeast(to_bridge), None, bridge(ours))
                    .beside(&by_tcp.map(bridge).unwrap_or_default(), &by_relay),
                goal(over("bare relay"), Bound::AtLeast(to_relay), None, relay(ours))
                    .beside(&by_tcp.map(relay).unwrap_or_default(), &[]),
            ]);
        }
        for (at, bound, _) in SIZES {
            let Some(bound) = bound else { continue };
            let what = format!("Messages of {} a second: `group` to the Zenoh bridge", Unit::Bytes.text(at));
            let bridge = |ours| one(self.ratio(rate(at), ours, ZENOH));
            let by_relay = [part("", self.by_relay(rate(at), ZENOH, f64::max))];
            goals.push(
                goal(what, Bound::AtLeast(bound), None, bridge(GROUP)).beside(&bridge(GROUP_TCP), &by_relay),
            );
        }
        for (at, _, bound) in SIZES {
            let what = format!(
                "CPU time a message of {}, both proxies: `group` to the Zenoh bridge",
                Unit::Bytes.text(at)
            );
            let cpu = place(at, "cpu_us_per_message");
            let bridge = |ours| one(self.ratio(cpu, ours, ZENOH));
            let by_relay = [part("", self.by_relay(cpu, ZENOH, f64::min))];
            goals.push(
                goal(what, Bound::AtMost(bound), None, bridge(GROUP)).beside(&bridge(GROUP_TCP), &by_relay),
            );
        }
        let flood = self.number(place(64e3, "rss_bytes"), GROUP);
        goals.push(goal(
            "Resident memory of both proxies, 64 KB without pause, `group`",
            Bound::AtMost(60e6),
            Some(Unit::Bytes),
            one(flood),
        ));
        goals
    }

    /// Judges the cost of a router between two proxies by that of a program that only forwards a TCP connection.
    fn router(&self) -> Vec<Goal> {
        let router = format!("{GROUP}-router");
        let more =
            |place, with: &str, without: &str| Some(self.number(place, with)? - self.number(place, without)?);
        let round_trip = |&at: &f64| {
            let place = ("round-trip", "bare", at, "p50_us");
            let ours = more(place, &router, GROUP);
            let theirs = more(place, FORWARDER, RELAYS[0]).filter(|more| *more > 0.0);
            self.at_size(at, ours.zip(theirs).map(|(ours, theirs)| ours / theirs))
        };
        let cpu = ("throughput", "bare", 64e3, "cpu_us_per_message");
        // Both proxies together.
        let proxies = self.number(cpu, GROUP).filter(|cpu| *cpu > 0.0);
        let part_of_proxy =
            more(cpu, &router, GROUP).zip(proxies).map(|(router, both)| router / (both / 2.0));
        vec![
            goal(
                "Round trip p50, added by a router, `group`: to what a TCP forwarder adds between bare relays",
                Bound::AtMost(1.3),
                None,
                SMALL.iter().map(round_trip).collect(),
            ),
            goal(
                "CPU time a message of 64 KB, `group`: the router to a proxy",
                Bound::AtMost(0.6),
                None,
                vec![part("", part_of_proxy)],
            ),
        ]
    }

    /// Messages of publishers that keep all, by every suite and transport. Those without a loss are not named.
    fn losses(&self) -> Goal {
        let is_it =
            |f: &&Figure| f.table == "throughput" && f.metric == "lost" && f.system.starts_with("sgc-");
        let lost = self.figures.figures.iter().filter(is_it);
        let one = |f: &Figure| part(&format!("{}, {}", f.system, Unit::Bytes.text(f.at)), Some(f.value));
        let (none, some): (Vec<_>, Vec<_>) = lost.map(one).partition(|part| part.value == Some(0.0));
        let parts = match (some.is_empty(), none.is_empty()) {
            (false, _) => some,
            (true, false) => vec![part("", Some(0.0))],
            (true, true) => vec![part("", None)],
        };
        let what = "Messages lost of publishers that keep all, 100 B to 1 MB, every suite and transport";
        goal(what, Bound::AtMost(0.0), Some(Unit::Plain), parts)
    }

    /// How long round trips were waited for of which none came back.
    fn patience(&self, path: &str, at: f64, system: &str) -> Option<f64> {
        let is_measured = self.number(("round-trip", path, at, "p50_us"), system).is_some();
        self.number(("round-trip", path, at, GAVE_UP), system).filter(|_| !is_measured)
    }

    fn at_size(&self, at: f64, value: Option<f64>) -> Part {
        Part { label: Unit::Bytes.text(at), value }
    }

    /// Judges programs of real ROS 2, each suite beside what they reach natively.
    fn real_ros2(&self, (suite, ours): (&str, &str)) -> Vec<Goal> {
        /// A measurement in words, and the table and place of its figures.
        type Row = (&'static str, &'static str, f64);
        const FLOWS: [Row; 2] =
            [("20 000 a second", real_ros2::TABLE, 20e3), ("`KEEP_ALL`", real_ros2::KEEP_ALL, 0.0)];
        const SIZES_SMALL: [f64; 3] = [24.0, 1e3, 8e3];
        let over = |what: &str| format!("Real ROS 2, {what}: `{suite}` to native");
        let round_trip = |&at: &f64| {
            PAIRS.map(|(name, path)| {
                let place = (real_ros2::ROUND_TRIP, path, at, "p50_us");
                part(&format!("{}, {name}", Unit::Bytes.text(at)), self.ratio(place, ours, "direct"))
            })
        };
        let rate = |&(what, table, at): &Row| {
            let parts = PAIRS
                .map(|(name, path)| part(name, self.ratio((table, path, at, "per_second"), ours, "direct")));
            let what = format!("{what}, messages of 1000 B a second");
            goal(over(&what), Bound::AtLeast(0.9), None, parts.into())
        };
        let lost = FLOWS.iter().flat_map(|&(what, table, at)| {
            PAIRS.map(|(name, path)| {
                let place = (table, path, at, "lost");
                let lost = self.number(place, ours).zip(self.number(place, "direct"));
                // Messages that are lost natively, too, are not the system's fault.
                part(&format!("{what}, {name}"), lost.map(|(ours, theirs)| (ours - theirs).max(0.0)))
            })
        });
        let mut goals: Vec<_> = FLOWS.iter().map(rate).collect();
        goals.extend([
            goal(
                format!("Real ROS 2, messages lost: `{suite}` beyond native"),
                Bound::AtMost(0.0),
                Some(Unit::Plain),
                lost.collect(),
            ),
            goal(
                over("round trip p50, 24 B to 8 KB"),
                Bound::AtMost(2.2),
                None,
                SIZES_SMALL.iter().flat_map(round_trip).collect(),
            ),
            goal(over("round trip p50, 1 MB"), Bound::AtMost(2.0), None, round_trip(&LARGE).into()),
        ]);
        goals
    }

    /// Judges programs of real ROS 2 beside the Zenoh bridge.
    fn real_ros2_to_bridge(&self) -> Vec<Goal> {
        const SMALL: &[f64] = &[24.0, 1e3, 8e3];
        const ROWS: [(&str, &str, &str, &[f64], f64); 3] = [
            ("pairwise", PAIRWISE, "24 B to 8 KB", SMALL, 0.9),
            ("group", GROUP, "24 B to 8 KB", SMALL, 0.8),
            ("group", GROUP, "64 KB", &[64e3], 0.9),
        ];
        let row = |(suite, ours, sizes, all, bound): (&str, &str, &str, &[f64], f64)| {
            let parts = all.iter().flat_map(|&at| {
                PAIRS.map(|(name, path)| {
                    let place = (real_ros2::ROUND_TRIP, path, at, "p50_us");
                    part(&format!("{}, {name}", Unit::Bytes.text(at)), self.ratio(place, ours, ZENOH))
                })
            });
            let what = format!("Real ROS 2, round trip p50, {sizes}: `{suite}` to the Zenoh bridge");
            goal(what, Bound::AtMost(bound), None, parts.collect())
        };
        ROWS.map(row).into()
    }

    /// Driving over an uplink that a camera fills, by the default transport.
    fn teleop(&self) -> Vec<Goal> {
        let ms = Some(Unit::Seconds);
        let at = |path: &str, metric, scale: f64| {
            let place = ("teleop", path, 1.0, metric);
            part(path, self.number(place, STANDARD).map(|v| v * scale))
        };
        let camera = |metric, scale| TELEOP_PATHS.map(|path| at(path, metric, scale)).into();
        vec![
            goal(
                "Teleop beside a camera, age of the state p99",
                Bound::AtMost(24e-3),
                ms,
                vec![at(TELEOP_PATHS[0], "state_p99_us", 1e-6)],
            ),
            goal(
                "Teleop beside a camera, 40 ms one way, age of the state p99",
                Bound::AtMost(60e-3),
                ms,
                vec![at(TELEOP_PATHS[1], "state_p99_us", 1e-6)],
            ),
            goal(
                "Teleop, age of the camera's frames p99",
                Bound::AtMost(155e-3),
                ms,
                vec![at(TELEOP_PATHS[0], "camera_p99_us", 1e-6)],
            ),
            goal(
                "Teleop, 40 ms one way, age of the camera's frames p99, the way included",
                Bound::AtMost(175e-3),
                ms,
                vec![at(TELEOP_PATHS[1], "camera_p99_us", 1e-6)],
            ),
            goal(
                "Teleop, frames of the camera",
                Bound::AtLeast(9.4),
                Some(Unit::PerSecond),
                camera("camera_per_second", 1.0),
            ),
        ]
    }

    /// A robot that changes its address under a reliable flow.
    fn roaming(&self) -> Vec<Goal> {
        let systems = [("QUIC", STANDARD), ("DTLS", "sgc-dtls-standard")];
        let parts = |metric: &str, scale: f64| {
            let value = |system, at| self.number(("roaming", "roam", at, metric), system).map(|v| v * scale);
            // Away, and back again.
            let worst = |system| Some(f64::max(value(system, 0.0)?, value(system, 1.0)?));
            systems.map(|(name, system)| part(name, worst(system))).into()
        };
        vec![
            goal(
                "Roaming on a bare link, longest silence",
                Bound::AtMost(100e-3),
                Some(Unit::Seconds),
                parts("outage_us", 1e-6),
            ),
            goal(
                "Roaming, messages of a reliable topic lost",
                Bound::AtMost(0.0),
                Some(Unit::Plain),
                parts("lost", 1.0),
            ),
        ]
    }

    fn footprint(&self) -> Vec<Goal> {
        let at =
            |path, at, metric, system| vec![part("", self.number(("footprint", path, at, metric), system))];
        let threads = |topics: u32, most| {
            let both = [("shares", "sgc-proxy"), ("uses", "sgc-proxy-use")].map(|(label, system)| {
                part(label, self.number(("footprint", "topics", topics.into(), "threads"), system))
            });
            let what = format!("Threads of a proxy with {topics} topics");
            goal(what, Bound::AtMost(most), Some(Unit::Plain), both.into())
        };
        vec![
            goal(
                "Resident memory of an idle proxy",
                Bound::AtMost(15e6),
                Some(Unit::Bytes),
                at("topics", 0.0, "rss_bytes", "sgc-proxy"),
            ),
            threads(10, 16.0),
            threads(200, 32.0),
            goal(
                "CPU of an idle proxy, of a core",
                Bound::AtMost(0.5),
                Some(Unit::Percent),
                at("topics", 0.0, "idle_cpu_percent", "sgc-proxy"),
            ),
            goal(
                "Resident memory of a router with 1 000 000 names",
                Bound::AtMost(300e6),
                Some(Unit::Bytes),
                at("names", 1e6, "rss_bytes", "sgc-router"),
            ),
        ]
    }
}

/// The distributions of real ROS 2 at both places, and the path of their figures.
const PAIRS: [(&str, &str); 2] = [("Jazzy to Kilted", JAZZY_KILTED), ("Kilted to Jazzy", KILTED_JAZZY)];

/// The uplink without a delay of its own, and with 40 ms one way.
const TELEOP_PATHS: [&str; 2] = ["uplink", "uplink-40ms"];

#[cfg(test)]
mod tests {
    use super::*;

    const WHAT: &str = "Round trip p50, 16 B to 8 KB, bare link: `group` to the Zenoh bridge over TCP";

    /// Round trips of 100 µs by the Zenoh bridge, and these by ours, at the small sizes.
    fn figures(ours: &[f64]) -> Figures {
        let mut figures = Figures::default();
        for (at, value) in [16.0, 100.0, 1000.0, 8192.0].into_iter().zip(ours) {
            figures.push("round-trip", ZENOH, "bare", at, "p50_us", 100.0);
            figures.push("round-trip", GROUP, "bare", at, "p50_us", *value);
        }
        figures
    }

    fn verdict(figures: &Figures, what: &str) -> (Verdict, String) {
        let goal = judge(figures).into_iter().find(|g| g.what == what).unwrap();
        (goal.verdict, goal.reached)
    }

    #[test]
    fn a_goal_is_met_when_every_part_is_within_the_bound() {
        let reached = "16 B: 0.6 ×, 100 B: 0.7 ×, 1 KB: 0.61 ×, 8 KB: 0.5 ×".to_owned();
        assert_eq!(verdict(&figures(&[60.0, 70.0, 61.0, 50.0]), WHAT), (Verdict::Met, reached));
    }

    #[test]
    fn beside_a_goal_stands_what_tcp_and_the_better_relay_reach() {
        let mut figures = figures(&[70.0]);
        let beside = |figures: &Figures| {
            let goal = judge(figures).into_iter().find(|g| g.what == WHAT).unwrap();
            (goal.by_tcp, goal.by_relay)
        };
        assert_eq!(beside(&figures), (String::new(), String::new()));
        figures.push("round-trip", GROUP_TCP, "bare", 16.0, "p50_us", 68.0);
        figures.push("round-trip", "relay", "bare", 16.0, "p50_us", 66.0);
        figures.push("round-trip", "relay-gathers", "bare", 16.0, "p50_us", 82.0);
        let (by_tcp, by_relay) = beside(&figures);
        assert_eq!(by_tcp, "16 B: 0.68 ×, 100 B: –, 1 KB: –, 8 KB: –");
        assert_eq!(by_relay, "16 B: 0.66 ×, 100 B: –, 1 KB: –, 8 KB: –");
    }

    #[test]
    fn goal_is_missed_if_any_part_exceeds_bound() {
        assert_eq!(verdict(&figures(&[60.0, 71.0, 61.0, 50.0]), WHAT).0, Verdict::Missed);
        assert_eq!(verdict(&figures(&[71.0]), WHAT).0, Verdict::Missed);
    }

    #[test]
    fn goal_without_figures_is_neither_met_nor_missed() {
        let (verdict_of_three, reached) = verdict(&figures(&[70.0, 70.0, 70.0]), WHAT);
        assert_eq!(verdict_of_three, Verdict::NotMeasured);
        assert!(reached.ends_with("8 KB: –"), "{reached}");
        assert!(judge(&Figures::default()).iter().all(|g| g.verdict == Verdict::NotMeasured));
    }

    #[test]
    fn lost_round_trip_counts_as_longer_than_wait() {
        let what = "Round trip p50, every size, `paper`: `standard` to DDS over WireGuard";
        let mut figures = Figures::default();
        for at in SIZES {
            figures.push("round-trip", STANDARD, "paper", at, "p50_us", 50.0);
            let metric = if at == HUGE { GAVE_UP } else { "p50_us" };
            figures.push("round-trip", "wireguard", "paper", at, metric, 100.0);
        }
        let (judged, reached) = verdict(&figures, what);
        assert_eq!(judged, Verdict::Met);
        assert!(reached.ends_with("13 MB, none came back over WireGuard: 0.5 ×"), "{reached}");
    }

    #[test]
    fn rates_have_to_reach_their_bound() {
        let what = "Messages of 1000 B a second: `group` to the Zenoh bridge over TCP";
        let mut figures = Figures::default();
        figures.push("throughput", ZENOH, "bare", 1000.0, "per_second", 100_000.0);
        figures.push("throughput", GROUP, "bare", 1000.0, "per_second", 114_000.0);
        assert_eq!(verdict(&figures, what), (Verdict::Missed, "1.14 ×".into()));
        // The last measurement counts.
        figures.push("throughput", GROUP, "bare", 1000.0, "per_second", 115_000.0);
        assert_eq!(verdict(&figures, what).0, Verdict::Met);
    }

    #[test]
    fn router_is_compared_with_forwarder_and_with_proxy() {
        let mut figures = Figures::default();
        for at in SMALL {
            for (system, us) in [("relay", 100.0), (FORWARDER, 150.0), (GROUP, 120.0)] {
                figures.push("round-trip", system, "bare", at, "p50_us", us);
            }
            figures.push("round-trip", "sgc-quic-group-router", "bare", at, "p50_us", 180.0);
        }
        for (system, us) in [(GROUP, 100.0), ("sgc-quic-group-router", 125.0)] {
            figures.push("throughput", system, "bare", 65_536.0, "cpu_us_per_message", us);
        }
        let what =
            "Round trip p50, added by a router, `group`: to what a TCP forwarder adds between bare relays";
        assert_eq!(
            verdict(&figures, what),
            (Verdict::Met, "16 B: 1.2 ×, 100 B: 1.2 ×, 1 KB: 1.2 ×, 8 KB: 1.2 ×".into())
        );
        let what = "CPU time a message of 64 KB, `group`: the router to a proxy";
        assert_eq!(verdict(&figures, what), (Verdict::Met, "0.5 ×".into()));
    }

    #[test]
    fn losses_of_one_system_miss_the_goal_of_all() {
        let what = "Messages lost of publishers that keep all, 100 B to 1 MB, every suite and transport";
        let mut figures = Figures::default();
        figures.push("throughput", "relay", "bare", 100.0, "lost", 5.0);
        assert_eq!(verdict(&figures, what), (Verdict::NotMeasured, "–".into()));
        figures.push("throughput", GROUP, "bare", 100.0, "lost", 0.0);
        assert_eq!(verdict(&figures, what), (Verdict::Met, "0".into()));
        figures.push("throughput", STANDARD, "bare", 100.0, "lost", 3.0);
        assert_eq!(verdict(&figures, what), (Verdict::Missed, "sgc-quic-standard, 100 B: 3".into()));
    }

    #[test]
    fn real_ros2_may_lose_no_more_than_natively() {
        let what = "Real ROS 2, messages lost: `group` beyond native";
        let mut figures = Figures::default();
        for path in [JAZZY_KILTED, KILTED_JAZZY] {
            for (table, at) in [(real_ros2::TABLE, 20e3), (real_ros2::KEEP_ALL, 0.0)] {
                figures.push(table, "direct", path, at, "lost", 10.0);
                figures.push(table, GROUP, path, at, "lost", 9.0);
            }
        }
        assert_eq!(verdict(&figures, what).0, Verdict::Met);
        figures.push(real_ros2::KEEP_ALL, GROUP, KILTED_JAZZY, 0.0, "lost", 12.0);
        let (judged, reached) = verdict(&figures, what);
        assert_eq!(judged, Verdict::Missed);
        assert!(reached.ends_with("`KEEP_ALL`, Kilted to Jazzy: 2"), "{reached}");
    }

    #[test]
    fn a_goal_with_a_unit_says_it() {
        let mut figures = Figures::default();
        figures.push("footprint", "sgc-router", "names", 1e6, "rss_bytes", 310e6);
        let goals = judge(&figures);
        let goal = goals.iter().find(|g| g.what.contains("1 000 000 names")).unwrap();
        assert_eq!((&*goal.bound, &*goal.reached), ("≤ 300 MB", "310 MB"));
        assert_eq!(goal.verdict, Verdict::Missed);
    }

    #[test]
    fn ages_under_load_are_judged_for_each_path() {
        let mut figures = Figures::default();
        for (path, state, frames) in [("uplink", 20.0, 154.0), ("uplink-40ms", 60.0, 193.0)] {
            figures.push("teleop", STANDARD, path, 1.0, "state_p99_us", state * 1e3);
            figures.push("teleop", STANDARD, path, 1.0, "camera_p99_us", frames * 1e3);
        }
        let judged = |what: &str| {
            let goal = judge(&figures).into_iter().find(|g| g.what == what).unwrap();
            (goal.bound, goal.reached, goal.verdict)
        };
        let met = |bound: &str, reached: &str| (bound.to_owned(), reached.to_owned(), Verdict::Met);
        let state = "age of the state p99";
        let frames = "age of the camera's frames p99";
        assert_eq!(judged(&format!("Teleop beside a camera, {state}")), met("≤ 24 ms", "uplink: 20 ms"));
        assert_eq!(
            judged(&format!("Teleop beside a camera, 40 ms one way, {state}")),
            met("≤ 60 ms", "uplink-40ms: 60 ms")
        );
        assert_eq!(judged(&format!("Teleop, {frames}")), met("≤ 155 ms", "uplink: 154 ms"));
        let (bound, reached, verdict) = judged(&format!("Teleop, 40 ms one way, {frames}, the way included"));
        assert_eq!((&*bound, &*reached), ("≤ 175 ms", "uplink-40ms: 193 ms"));
        assert_eq!(verdict, Verdict::Missed);
    }

    #[test]
    fn nothing_is_compared_with_a_system_that_reached_nothing() {
        let mut figures = Figures::default();
        figures.push("fleet-step", "ssh", "near", FLEET, "p50_us", 0.0);
        figures.push("fleet-step", STANDARD, "near", FLEET, "p50_us", 1.0);
        let what = "Fleet step, p50: `standard` to files over SSH and SFTP";
        assert_eq!(verdict(&figures, what), (Verdict::NotMeasured, "near: –, far: –".into()));
    }
}
