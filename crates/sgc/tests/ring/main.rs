//! Tests that a ring of routers heals, with real processes: five routers with chords, three proxies and independent
//! programs, each network in a namespace of its own. A seed cuts links and kills, restarts and stops routers. Three
//! topics flow from the robot to the desk and the lab. No reliable message may be lost, repeated or reordered.
//!
//! `SGC_RING_SEED` and `SGC_RING_SECONDS` choose the faults and how long there are any, `SGC_RING_DIR` a directory that
//! keeps the logs and the trace. A plan follows from the seed alone, its moments do not: no router is taken before
//! the nodes say that there is a way without it, since links are dialled again in seconds, not at once.
//!
//! Proxies and peers are not killed here; `peers.rs` does that.

#![allow(clippy::unwrap_used)]

mod graph;
mod lab;
mod ledger;
#[path = "../support/mod.rs"]
mod support;

use std::collections::BTreeMap;
use std::path::PathBuf;
use std::str::FromStr;
use std::thread::sleep;
use std::time::{Duration, Instant};

use graph::{Act, Chaos, Fault, NODES, Node};
use lab::Lab;
use ledger::{Listener, Row, Talker, Topic};
use serde_json::Value;
use support::{eventually, say};

const SEED: u64 = 4;
const SECONDS: u64 = 40;
/// Period of polling.
const TICK: Duration = Duration::from_millis(50);
/// Before the first fault, and after the last one is mended.
const CALM: Duration = Duration::from_secs(4);
/// No further fault while a receiver of `/state` has waited for longer than this: what heals is to be disturbed, but
/// not without end, since sources do not keep their messages for ever.
const STILL_MAX: Duration = Duration::from_secs(5);
/// How long the ring may take until a way that is there carries data again, and until all links are up again.
const HEAL_MAX: Duration = Duration::from_secs(30);
/// How long what was sent last may take.
const LAST_MAX: Duration = Duration::from_secs(60);
/// Longest wait for a best-effort message that may be lost, and for something doubled that should not come.
const LINGER: Duration = Duration::from_secs(2);
/// Best effort: how much must come at least, and how much may be lost with no fault near (to a busy processor).
const SHARE_MIN: f64 = 0.5;
const UNEXPLAINED_MAX: f64 = 0.02;
/// How much longer than the faults all the rest may take.
const OVERTIME_MAX: Duration = Duration::from_secs(300);
/// How many seconds publishers stay when they have sent all, so that what was lost can be asked for.
const HOLD: &str = "120";
/// How long after the mending of a fault it explains a loss.
const EXPLAINS: Duration = Duration::from_secs(15);
/// Events that are no further apart than this count as one moment: what is under way still arrives.
const TOGETHER: Duration = Duration::from_millis(100);
/// How much more memory a router may have in the end.
const GROWTH_KB_MAX: u64 = 64 * 1024;
/// Counters of what an honest peer never causes (`docs/spec/routing.md`). `wrong_way` is also a control frame that
/// crossed another; the log tells the two apart.
const SUSPICIOUS: [&str; 7] =
    ["not_verified", "not_owner", "hop_limit", "limit", "crl", "not_router", "malformed_control"];
/// Texts that no log may contain.
const UNSPEAKABLE: [&str; 4] =
    ["panicked", " ERROR ", "dropped an invalid packet of a peer", "control frame refused; counted"];

static TOPICS: [Topic; 3] = [
    Topic {
        name: "/state",
        reliable: true,
        both: &["--type", "string"],
        talker: &["--rate", "50", "--size", "64", "--depth", "1000"],
        listener: &["--depth", "0"],
    },
    Topic {
        name: "/map",
        reliable: true,
        both: &["--type", "image", "--transient-local", "--large"],
        talker: &["--rate", "1", "--size", "300000", "--depth", "30"],
        listener: &["--depth", "0"],
    },
    Topic {
        name: "/video",
        reliable: false,
        both: &["--type", "image", "--best-effort", "--large"],
        talker: &["--rate", "20", "--size", "30000", "--depth", "5"],
        listener: &["--depth", "100"],
    },
];

/// The beginning or the end of a fault.
struct Event {
    at: Instant,
    kind: String,
    what: String,
    /// For the beginning of a fault: the time of its end.
    mended: Option<Instant>,
}

struct Run {
    talkers: Vec<Talker>,
    listeners: Vec<Listener>,
    begun: Instant,
    active: Vec<Fault>,
    events: Vec<Event>,
    /// All failures, reported together at the end.
    problems: Vec<String>,
    /// The largest counts of drops that were seen, by node and key: a kill takes the counters along.
    drops: BTreeMap<(Node, String), u64>,
    /// Dropped last.
    lab: Lab,
}

impl Run {
    fn new(time: Duration) -> Self {
        let names: Vec<_> = TOPICS.iter().map(|topic| topic.name).collect();
        let lab = Lab::new(&names, std::env::var_os("SGC_RING_DIR").map(PathBuf::from), time + OVERTIME_MAX);
        let mut run = Self {
            talkers: Vec::new(),
            listeners: Vec::new(),
            begun: Instant::now(),
            active: Vec::new(),
            events: Vec::new(),
            problems: Vec::new(),
            drops: BTreeMap::new(),
            lab,
        };
        run.wait_for_links();
        run.start_peers();
        run
    }

    fn start_peers(&mut self) {
        for topic in &TOPICS {
            let both = [&["--topic", topic.name, "--verbose"][..], topic.both].concat();
            // Both vendors listen, each alone in its network.
            for (at, vendor) in [(Node::DESK, "cyclone"), (Node::LAB, "fastdds")] {
                let peer = self.lab.peer(at, vendor, "sub", &[&both[..], topic.listener].concat());
                self.listeners.push(Listener::new(topic, at, peer));
            }
            let control = ["--wait-go", "--wait-stop", "--hold", HOLD];
            let peer =
                self.lab.peer(Node::ROBOT, "cyclone", "pub", &[&both[..], topic.talker, &control].concat());
            self.talkers.push(Talker::new(topic, peer));
        }
        for talker in &mut self.talkers {
            talker.peer.wait_matched(&format!("a reader of {}", talker.topic.name));
        }
        for listener in &mut self.listeners {
            let what = format!("a writer of {}", listener.name());
            listener.peer.wait_matched(&what);
        }
        self.talkers.iter_mut().for_each(|talker| talker.peer.go());
        eventually("all that is sent comes", || {
            self.update();
            self.listeners.iter().all(|listener| !listener.got.is_empty())
        });
    }

    fn update(&mut self) {
        self.talkers.iter_mut().for_each(Talker::update);
        self.listeners.iter_mut().for_each(Listener::update);
    }

    /// Lets a time go by in which nothing is done, and looks what has ended meanwhile.
    fn pass(&mut self, time: Duration) {
        sleep(time);
        self.update();
        let fallen = self.lab.fallen();
        assert!(fallen.is_empty(), "ended by themselves: {fallen:?}");
        assert!(self.talkers.iter().all(|t| !t.done), "a talker ended by itself");
        assert!(self.listeners.iter().all(|l| !l.ended), "a listener ended by itself");
    }

    /// Whether this came to be so within a time.
    fn comes(&mut self, within: Duration, mut is_so: impl FnMut(&mut Self) -> bool) -> bool {
        let deadline = Instant::now() + within;
        while !is_so(self) {
            if Instant::now() >= deadline {
                return false;
            }
            self.pass(TICK);
        }
        true
    }

    fn trouble(&mut self, text: String) {
        let at = self.begun.elapsed().as_secs_f64();
        self.problems.push(format!("{at:.1} s: {text}"));
    }

    fn wait_for_links(&mut self) {
        let all = |run: &mut Self| run.lab.told(&run.active).edges.iter().all(|up| *up);
        if !self.comes(HEAL_MAX, all) {
            let told = self.lab.told(&self.active).edges;
            let down: Vec<_> = graph::Edge::all().filter(|edge| !told[edge.0]).collect();
            self.trouble(format!("not up within {HEAL_MAX:?}: {down:?}"));
        }
    }

    fn chaos(&mut self, seed: u64, time: Duration) {
        let mut chaos = Chaos::new(seed, self.lab.is_apart());
        self.begun = Instant::now();
        loop {
            let (after, act) = chaos.next();
            if self.begun.elapsed() + after >= time {
                self.pass(time.saturating_sub(self.begun.elapsed()));
                break;
            }
            self.pass(after);
            match act {
                Act::Break(fault) => {
                    if self.may_break(&fault) {
                        self.inflict(fault);
                    }
                }
                Act::Mend(fault) => self.mend(&fault),
            }
        }
        for fault in self.active.clone() {
            self.mend(&fault);
        }
    }

    /// Waits until there is a way without what is to be broken, and data on it.
    fn may_break(&mut self, fault: &Fault) -> bool {
        let parts = matches!(fault, Fault::Isolate { .. });
        let has_way = |run: &mut Self| {
            let told = run.lab.told(&run.active);
            if parts { told.connects() } else { told.without([fault]).connects() }
        };
        let flows = |run: &mut Self| {
            run.update();
            run.listeners.iter().all(|l| l.topic.name != "/state" || l.still() < STILL_MAX)
        };
        if !self.comes(HEAL_MAX, has_way) {
            let told = self.lab.told(&self.active).edges;
            let down: Vec<_> = graph::Edge::all().filter(|edge| !told[edge.0]).collect();
            self.trouble(format!("no way within {HEAL_MAX:?} beside {fault:?}: {down:?} are down"));
            return false;
        }
        if !self.comes(HEAL_MAX, flows) {
            let active = self.active.clone();
            self.trouble(format!("there is a way, and no /state on it within {HEAL_MAX:?}, with {active:?}"));
            return false;
        }
        true
    }

    fn inflict(&mut self, fault: Fault) {
        // Its counters would go with it.
        for router in fault.routers() {
            self.count_drops(router);
        }
        self.lab.inflict(&fault);
        let (kind, what) = (fault.kind().to_owned(), format!("{fault:?}"));
        self.events.push(Event { at: Instant::now(), kind, what, mended: None });
        self.active.push(fault);
    }

    fn mend(&mut self, fault: &Fault) {
        let Some(place) = self.active.iter().position(|other| other == fault) else { return };
        self.active.remove(place);
        self.lab.mend(fault);
        let at = Instant::now();
        let what = format!("{fault:?}");
        let broken = self.events.iter_mut().rev().find(|event| event.what == what).unwrap();
        broken.mended = Some(at);
        let (kind, what) = (format!("mended: {}", fault.kind()), format!("mended: {what}"));
        self.events.push(Event { at, kind, what, mended: Some(at) });
    }

    fn count_drops(&mut self, node: Node) {
        let status = self.lab.status(node);
        for (key, count) in status["drops"].as_object().into_iter().flatten() {
            let most = self.drops.entry((node, key.clone())).or_default();
            *most = (*most).max(count.as_u64().unwrap_or(0));
        }
    }

    /// Ends the sending, waits for what is under way, ends the peers.
    fn finish(&mut self) {
        self.talkers.iter_mut().for_each(|talker| talker.peer.go());
        eventually("the talkers stop", || {
            self.update();
            self.talkers.iter().all(|talker| talker.done)
        });
        let lasts: BTreeMap<_, _> = self.talkers.iter().map(|t| (t.topic.name, t.last().unwrap())).collect();
        let wait = |run: &mut Self, within: Duration, reliable: bool| {
            let deadline = Instant::now() + within;
            let lacks = |l: &Listener| l.topic.reliable == reliable && !l.has(lasts[l.topic.name]);
            while run.listeners.iter().any(lacks) && Instant::now() < deadline {
                sleep(TICK);
                run.update();
            }
            run.listeners.iter().filter(|l| lacks(l)).map(Listener::name).collect::<Vec<_>>()
        };
        let lacking = wait(self, LAST_MAX, true);
        if !lacking.is_empty() {
            self.trouble(format!("the last message did not come within {LAST_MAX:?}: {lacking:?}"));
            for node in [Node::ROBOT, Node::DESK, Node::LAB] {
                self.trouble(format!("{node:?} says {}", self.lab.status(node)["routes"]));
            }
        }
        wait(self, LINGER, false);
        sleep(LINGER);
        self.update();
        for listener in &mut self.listeners {
            listener.peer.end();
            let summary = listener.peer.summary();
            // The peer counts for itself; that both counts agree speaks for ours.
            let doubled = Row::from_numbers(listener.got.iter().map(|(_, seq)| *seq)).doubled.len() as u64;
            assert_eq!(summary["duplicated"].as_u64(), Some(doubled), "{}: {summary}", listener.name());
        }
        for talker in &mut self.talkers {
            talker.peer.end();
            talker.peer.summary();
        }
    }

    fn judge(&mut self, report: &mut Vec<String>) {
        let mut problems = Vec::new();
        for listener in &self.listeners {
            let talker = self.talkers.iter().find(|t| t.topic.name == listener.topic.name).unwrap();
            let (name, last) = (listener.name(), talker.last().unwrap());
            let row = Row::from_numbers(listener.got.iter().map(|(_, seq)| *seq));
            let sent = last + 1 - row.first;
            let share = row.received as f64 / sent as f64;
            report.push(format!(
                "{name:14} {:5} of {sent:5} ({:.1} %), {} lost in {} gaps, {} doubled, {} late, {} altered",
                row.received,
                100.0 * share,
                row.lost(),
                row.gaps.len(),
                row.doubled.len(),
                row.late.len(),
                listener.altered
            ));
            if !row.doubled.is_empty() || !row.late.is_empty() || listener.altered > 0 {
                problems.push(format!(
                    "{name}: doubled {} {:?}, late {} {:?}, altered {}",
                    row.doubled.len(),
                    shown(&row.doubled),
                    row.late.len(),
                    shown(&row.late),
                    listener.altered
                ));
            }
            if listener.topic.reliable {
                if !row.gaps.is_empty() {
                    problems.push(format!(
                        "{name}: lost {}, in {} gaps: {:?}",
                        row.lost(),
                        row.gaps.len(),
                        shown(&row.gaps)
                    ));
                }
                continue;
            }
            if share < SHARE_MIN {
                problems.push(format!("{name}: only {:.1} % came", 100.0 * share));
            }
            let unexplained: Vec<_> = talker
                .sent
                .iter()
                .filter(|(_, seq)| row.gaps.iter().any(|(from, to)| (*from..=*to).contains(seq)))
                .filter(|(at, _)| !self.events.iter().any(|event| explains(event, *at)))
                .map(|(_, seq)| *seq)
                .collect();
            if unexplained.len() as f64 > sent as f64 * UNEXPLAINED_MAX {
                problems.push(format!(
                    "{name}: {} lost with no fault near: {:?}",
                    unexplained.len(),
                    shown(&unexplained)
                ));
            }
        }
        self.problems.extend(problems);
    }

    /// By kind of event: the longest time for which `/state` stood still at a receiver, of those that began from it
    /// to the next event. Events at one moment share what they caused.
    fn outages(&self, report: &mut Vec<String>, calm_since: Instant, ended: Instant) {
        let mut kinds = BTreeMap::<&str, Vec<Duration>>::new();
        let starts = [("nothing", calm_since)].into_iter();
        let starts: Vec<_> = starts.chain(self.events.iter().map(|e| (e.kind.as_str(), e.at))).collect();
        for (kind, at) in &starts {
            let next = starts.iter().map(|(_, next)| *next).find(|next| *next > *at + TOGETHER);
            let (from, to) = (*at - TOGETHER, next.unwrap_or(ended) - TOGETHER);
            for listener in self.listeners.iter().filter(|l| l.topic.name == "/state") {
                kinds.entry(kind).or_default().extend(listener.outage(from, to));
            }
        }
        report.push("longest pause of /state after each, ms: median, longest".to_owned());
        for (kind, mut pauses) in kinds {
            pauses.sort();
            let (n, ms) = (pauses.len(), |pause: Option<&Duration>| pause.map_or(0, Duration::as_millis));
            let (median, longest) = (ms(pauses.get(n / 2)), ms(pauses.last()));
            report.push(format!("  {kind:28} {median:6} {longest:6}   of {n}"));
        }
    }

    fn look_at_nodes(&mut self, before: &[Option<u64>], report: &mut Vec<String>) {
        NODES.into_iter().for_each(|node| self.count_drops(node));
        let mut memory = Vec::new();
        for (node, before) in NODES.into_iter().zip(before) {
            let (before, after) = (before.unwrap_or(0), self.lab.resident(node).unwrap_or(0));
            memory.push(format!("{node:?} {before} → {after}"));
            if node.is_router() && after > before + GROWTH_KB_MAX {
                self.trouble(format!("{node:?} had {before} kB, and has {after} kB"));
            }
            for (path, count) in recovered(&self.lab.status(node), String::new()) {
                report.push(format!("{node:?}: {path} = {count}"));
            }
            let log = self.lab.log(node);
            for word in UNSPEAKABLE {
                let lines: Vec<_> = log.lines().filter(|line| line.contains(word)).collect();
                if let Some(line) = lines.first() {
                    self.trouble(format!("{node:?} logged {} times such as: {line}", lines.len()));
                }
            }
        }
        report.push(format!("resident memory, kB: {}", memory.join(", ")));
        let plain: Vec<_> = self.drops.iter().filter(|((_, key), _)| !key.contains(" from ")).collect();
        let texts: Vec<_> =
            plain.iter().map(|((node, key), count)| format!("{node:?} {key} {count}")).collect();
        report.push(format!("dropped: {}", texts.join(", ")));
        let suspicious: Vec<_> = plain
            .into_iter()
            .filter(|((_, key), count)| SUSPICIOUS.contains(&key.as_str()) && **count > 0)
            .map(|((node, key), count)| format!("{node:?} counted {count} of {key}"))
            .collect();
        self.problems.extend(suspicious);
    }

    /// Every event with its time and what came next after it, and when writers came and went.
    fn trace(&self) -> String {
        let mut text = String::new();
        for event in &self.events {
            let at = event.at.saturating_duration_since(self.begun).as_secs_f64();
            text += &format!("{at:7.2} {}", event.what);
            for listener in &self.listeners {
                let next = listener.got.iter().find(|(got, _)| *got > event.at);
                let seq = next.map_or("-".to_owned(), |(got, seq)| {
                    format!("{seq}+{}ms", (*got - event.at).as_millis())
                });
                text += &format!("  {} {seq}", listener.name());
            }
            text.push('\n');
        }
        for listener in &self.listeners {
            for (at, count) in &listener.matched {
                let at = at.saturating_duration_since(self.begun).as_secs_f64();
                text += &format!("{at:7.2} {}: {count} writers\n", listener.name());
            }
        }
        text
    }
}

/// Limits a list to a readable length.
fn shown<T>(all: &[T]) -> &[T] {
    &all[..all.len().min(20)]
}

fn explains(event: &Event, at: Instant) -> bool {
    let from = event.at - Duration::from_secs(1);
    from <= at && event.mended.is_none_or(|mended| at <= mended + EXPLAINS)
}

/// Every number in a status document whose key speaks of recovery.
fn recovered(value: &Value, path: String) -> Vec<(String, u64)> {
    match value {
        Value::Object(fields) => {
            fields.iter().flat_map(|(key, value)| recovered(value, format!("{path}.{key}"))).collect()
        }
        Value::Array(values) => values
            .iter()
            .enumerate()
            .flat_map(|(i, value)| {
                let name = value["topic"].as_str().map_or(i.to_string(), str::to_owned);
                recovered(value, format!("{path}[{name}]"))
            })
            .collect(),
        Value::Number(number) if path.rsplit('.').next().is_some_and(|key| key.contains("recover")) => {
            number.as_u64().map(|n| (path, n)).into_iter().collect()
        }
        _ => Vec::new(),
    }
}

fn chosen<T: FromStr>(variable: &str, otherwise: T) -> T {
    match std::env::var(variable) {
        Ok(text) => text.parse().unwrap_or_else(|_| panic!("{variable} is no number: {text:?}")),
        Err(_) => otherwise,
    }
}

#[test]
fn a_ring_heals_and_nothing_reliable_is_lost_or_doubled() {
    let (seed, seconds) = (chosen("SGC_RING_SEED", SEED), chosen("SGC_RING_SECONDS", SECONDS));
    say(&format!("ring: SGC_RING_SEED={seed} SGC_RING_SECONDS={seconds}"));
    let time = Duration::from_secs(seconds);
    let mut run = Run::new(time);
    let calm_since = Instant::now();
    run.pass(CALM);
    let memory = NODES.map(|node| run.lab.resident(node));
    run.chaos(seed, time);
    run.wait_for_links();
    run.pass(CALM);
    run.finish();
    let ended = Instant::now();

    let broken: Vec<_> = run.events.iter().filter(|event| !event.kind.starts_with("mended")).collect();
    let mut kinds = BTreeMap::<&str, u32>::new();
    broken.iter().for_each(|event| *kinds.entry(&event.kind).or_default() += 1);
    let mut report = vec![format!("seed {seed}: {} faults in {seconds} s: {kinds:?}", broken.len())];
    run.judge(&mut report);
    run.outages(&mut report, calm_since, ended);
    run.look_at_nodes(&memory, &mut report);
    let trace = run.trace();
    run.lab.keep("trace.log", &trace);
    say(&report.join("\n"));
    if !run.problems.is_empty() {
        say(&trace);
        panic!("seed {seed}, {seconds} s:\n{}", run.problems.join("\n"));
    }
}
