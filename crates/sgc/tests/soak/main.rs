//! Tests that twenty nodes stay as they are for hours: memory, file descriptors, threads, the volume of their logs and
//! the number of their metrics. Two routers and eighteen proxies share two hundred topics between programs on plain
//! DDS, which number their messages. A seed kills and restarts nodes, and gives proxies other routers.
//!
//! `SGC_SOAK_SEED` and `SGC_SOAK_SECONDS` choose the faults and how long it takes, `SGC_SOAK_DIR` a directory that keeps
//! the logs, `samples.csv` and `report.txt`, and `SGC_SOAK_PROGRAM` another build of the program. `make soak` takes two
//! hours. The suite has a short run, which shows that everything works and that nothing grows fast.
//!
//! The table compares the medians of the second and of the last quarter. The programs at both ends of a topic between
//! nodes that were never restarted must have every message once and in order. Every topic must flow again after each
//! fault.

#![allow(clippy::unwrap_used)]

mod flatness;
mod lab;
#[path = "../support/mod.rs"]
mod support;

use std::collections::BTreeMap;
use std::fmt::Write as _;
use std::fs::{self, File};
use std::io::Write as _;
use std::path::PathBuf;
use std::str::FromStr;
use std::thread::sleep;
use std::time::{Duration, Instant};

use flatness::{Comparison, FIGURES, Kind, Sample};
use lab::{Flow, Heard, Lab, Node, PROXIES, ROUTERS};
use sgc_testkit::Dice;
use support::{eventually, say, say_log};

const SEED: u64 = 7;
const SECONDS: u64 = 60;
/// Samples of a run, at most one in `SAMPLE_MAX`; a longer run has more.
const ROUNDS: u32 = 40;
const SAMPLE_MAX: Duration = Duration::from_secs(30);
/// Time between two faults, in periods of sampling.
const FAULT_AFTER: std::ops::RangeInclusive<f64> = 1.0..=3.0;
/// Every so many faults, the second router is restarted. All nodes log this, so each quarter must have as many.
const ROUTER_EVERY: u32 = 5;
/// How many of a hundred other faults restart a proxy; the rest change routers.
const RESTART_PERCENT: usize = 55;
/// Time between two messages of a topic.
const PERIOD: Duration = Duration::from_secs(2);
/// Runs of this time and more begin with more messages: a node keeps the last ones of each publisher, and its memory is flat
/// only from then on.
const FILLED_FROM: Duration = Duration::from_secs(3600);
/// Messages of each topic in a period until then.
const FILL: u32 = 6;
/// Longest time without a message of a topic, whatever was restarted.
const STILL_MAX: Duration = Duration::from_secs(60);
/// How much longer than the run everything else may take.
const OVERTIME_MAX: Duration = Duration::from_secs(900);
/// Texts that no log may contain.
const UNSPEAKABLE: [&str; 2] = ["panicked", " ERROR "];

/// A fault.
#[derive(Debug)]
enum Act {
    Restart(Node),
    Routers(Node, Vec<usize>),
}

impl Act {
    /// Draws the fault of this number.
    fn draw(dice: &mut Dice, number: u32) -> Self {
        let restarted =
            |routers| Node::all().filter(move |node| !node.is_steady() && node.is_router() == routers);
        if number % ROUTER_EVERY == ROUTER_EVERY / 2 {
            return Self::Restart(restarted(true).next().unwrap());
        }
        if dice.chance(RESTART_PERCENT) {
            return Self::Restart(dice.pick(&restarted(false).collect::<Vec<_>>()).unwrap());
        }
        let proxy = Node::proxy(dice.below(PROXIES));
        // Messages of steady proxies must survive the kill of the second router, so these always have the first one.
        let choices: &[&[usize]] =
            if proxy.is_steady() { &[&[0], &[0, 1], &[1, 0]] } else { &[&[0], &[1], &[0, 1], &[1, 0]] };
        Self::Routers(proxy, dice.pick(choices).unwrap().to_vec())
    }
}

struct Run {
    lab: Lab,
    begun: Instant,
    samples: Vec<(Node, Sample)>,
    rounds: usize,
    csv: File,
    /// For each flow its last counts, and the time of the last new message.
    flows: BTreeMap<Flow, (Heard, Instant)>,
    problems: Vec<String>,
    restarts: u32,
    changes: u32,
}

impl Run {
    fn new(lab: Lab) -> Self {
        let mut csv = File::create(lab.dir().join("samples.csv")).unwrap();
        let figures = FIGURES.map(|figure| figure.name());
        writeln!(csv, "seconds,round,node,age,{},cpu_of_all", figures.join(",")).unwrap();
        Self {
            lab,
            begun: Instant::now(),
            samples: Vec::new(),
            rounds: 0,
            csv,
            flows: BTreeMap::new(),
            problems: Vec::new(),
            restarts: 0,
            changes: 0,
        }
    }

    fn trouble(&mut self, text: String) {
        let text = format!("{:.0} s: {text}", self.begun.elapsed().as_secs_f64());
        say(&text);
        self.problems.push(text);
    }

    /// Waits until every topic flows.
    fn wait_for_flows(&mut self, what: &str) {
        let before = self.lab.heard();
        eventually(what, || {
            let now = self.lab.heard();
            let silent = now.iter().filter(|(flow, heard)| heard.received <= before[flow].received).count();
            sleep(PERIOD / 4);
            silent == 0
        });
        let now = Instant::now();
        self.flows = self.lab.heard().into_iter().map(|(flow, heard)| (flow, (heard, now))).collect();
    }

    fn act(&mut self, act: Act) {
        match act {
            Act::Restart(node) => {
                self.lab.restart(node);
                self.restarts += 1;
            }
            Act::Routers(proxy, dials) => {
                self.lab.set_routers(proxy, dials);
                self.changes += 1;
            }
        }
    }

    fn look(&mut self) {
        let round = self.rounds;
        for node in Node::all() {
            let sample = self.lab.sample(node, round);
            let (at, cpu) = (self.begun.elapsed().as_secs_f64(), self.lab.processor_seconds());
            let figures = sample.figures.map(|figure| figure.to_string()).join(",");
            writeln!(self.csv, "{at:.1},{round},{},{},{figures},{cpu:.2}", node.name(), sample.age).unwrap();
            self.samples.push((node, sample));
        }
        self.rounds += 1;
        let now = Instant::now();
        for (flow, heard) in self.lab.heard() {
            let (before, since) = &self.flows[&flow];
            if heard.received > before.received {
                self.flows.insert(flow, (heard, now));
            } else if since.elapsed() > STILL_MAX {
                self.trouble(format!("{}: nothing for {STILL_MAX:?}", flow.name()));
                self.flows.insert(flow, (heard, now));
            }
        }
    }

    /// Draws faults and takes samples until the time is over.
    fn soak(&mut self, seed: u64, time: Duration) {
        let mut dice = Dice::new(seed);
        let period = (time / ROUNDS).min(SAMPLE_MAX);
        let pause = |dice: &mut Dice| {
            let (from, to) = FAULT_AFTER.into_inner();
            period.mul_f64(from + (to - from) * dice.fraction())
        };
        self.begun = Instant::now();
        let (mut next_look, mut next_act) = (period, pause(&mut dice));
        while next_look <= time {
            sleep(next_look.min(next_act).saturating_sub(self.begun.elapsed()));
            if next_act < next_look {
                let act = Act::draw(&mut dice, self.restarts + self.changes);
                self.act(act);
                next_act += pause(&mut dice);
            } else {
                self.look();
                next_look += period;
            }
        }
    }

    fn judge_messages(&mut self) {
        let mut problems = Vec::new();
        for (flow, (heard, _)) in &self.flows {
            let spoilt = heard.doubled + heard.altered > 0;
            let incomplete = flow.is_steady() && heard.lost + heard.late > 0;
            if spoilt || incomplete {
                problems.push(format!("{}: {heard:?}", flow.name()));
            }
        }
        problems.into_iter().for_each(|problem| self.trouble(problem));
    }

    fn judge_logs(&mut self) {
        for node in Node::all() {
            let log = self.lab.log(node);
            for word in UNSPEAKABLE {
                if let Some(line) = log.lines().find(|line| line.contains(word)) {
                    self.trouble(format!("{} logged: {line}", node.name()));
                }
            }
        }
    }

    fn compare(&self) -> Vec<Comparison> {
        let of = |is_meant: &dyn Fn(Node) -> bool| -> Vec<Sample> {
            self.samples.iter().filter(|(node, _)| is_meant(*node)).map(|(_, sample)| *sample).collect()
        };
        let mut rows = Vec::new();
        for node in Node::all().filter(|node| node.is_steady()) {
            let kind = if node.is_router() { Kind::Router } else { Kind::Proxy };
            rows.extend(flatness::compare_by_time(
                &node.name(),
                kind,
                &of(&|other| other == node),
                self.rounds,
            ));
        }
        let restarted = |node: Node| !node.is_steady();
        for (whose, kind) in [("restarted proxies", Kind::Proxy), ("the restarted router", Kind::Router)] {
            let samples = of(&|node| restarted(node) && node.is_router() == (kind == Kind::Router));
            rows.extend(flatness::compare_by_age(whose, kind, &samples, self.rounds));
        }
        rows.push(flatness::compare_logs(self.samples.iter().map(|(_, sample)| sample), self.rounds));
        rows
    }
}

fn chosen<T: FromStr>(variable: &str, otherwise: T) -> T {
    match std::env::var(variable) {
        Ok(text) => text.parse().unwrap_or_else(|_| panic!("{variable} is no number: {text:?}")),
        Err(_) => otherwise,
    }
}

#[test]
fn twenty_nodes_stay_flat_while_nodes_restart_and_routers_change() {
    let (seed, seconds) = (chosen("SGC_SOAK_SEED", SEED), chosen("SGC_SOAK_SECONDS", SECONDS));
    say(&format!("soak: SGC_SOAK_SEED={seed} SGC_SOAK_SECONDS={seconds}"));
    let time = Duration::from_secs(seconds);
    let keep = std::env::var_os("SGC_SOAK_DIR").map(PathBuf::from);
    let fill = if time < FILLED_FROM { 1 } else { FILL };
    let Some(lab) = Lab::new(keep, PERIOD, fill, time + OVERTIME_MAX) else { return };
    let mut run = Run::new(lab);
    run.wait_for_flows("every topic flows");
    run.soak(seed, time);
    let took = run.begun.elapsed();
    run.wait_for_flows("every topic flows again");
    run.judge_messages();
    run.judge_logs();

    let rows = run.compare();
    let mut report = format!(
        "soak: seed {seed}, {seconds} s, {} nodes ({ROUTERS} routers), {} restarts, {} changes of routers, {} samples of \
         each, {:.2} processors\n",
        Node::all().count(),
        run.restarts,
        run.changes,
        run.rounds,
        run.lab.processor_seconds() / took.as_secs_f64()
    );
    let received: u64 = run.flows.values().map(|(heard, _)| heard.received).sum();
    let lost: u64 = run.flows.values().map(|(heard, _)| heard.lost).sum();
    let _ = writeln!(report, "{received} messages came; {lost} of nodes that were restarted did not");
    report += &flatness::table(&rows);
    run.problems.iter().for_each(|problem| report += &format!("{problem}\n"));
    fs::write(run.lab.dir().join("report.txt"), &report).unwrap();
    say(&report);
    let growing: Vec<_> = rows.iter().filter(|row| !row.is_flat()).collect();
    if !growing.is_empty() || !run.problems.is_empty() {
        Node::all().for_each(|node| say_log(&node.name(), &run.lab.log(node)));
    }
    assert!(run.problems.is_empty(), "seed {seed}, {seconds} s:\n{}", run.problems.join("\n"));
    assert!(growing.is_empty(), "seed {seed}, {seconds} s:\n{}", flatness::table(growing));
}
