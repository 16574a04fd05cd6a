//! One-way flows: a sending program and counting ones at the two ends of a system, and the results of their runs.

use std::time::Duration;

use anyhow::{Context, Result};
use serde::Deserialize;
use serde_json::json;

use super::lab::{Lab, Side};
use super::program::Program;
use super::system::{Dds, Running};

/// How long a system may take until the first message has arrived.
pub(crate) const CONNECT_MAX: Duration = Duration::from_secs(30);
/// A run is over when its last message is there, or when nothing has come for so long.
const QUIET: Duration = Duration::from_secs(3);
/// How much longer than it may take is waited for an answer.
const SPARE: Duration = Duration::from_secs(10);

/// The ends and the topic of a flow.
#[derive(Clone, Copy, Debug)]
pub(crate) struct FlowSpec {
    /// The topic.
    pub(crate) topic: &'static str,
    /// The sending place. The other place counts.
    pub(crate) from: Side,
    /// Readers there, all of one process in each local network.
    pub(crate) readers: usize,
    /// Whether nothing may be lost.
    pub(crate) reliable: bool,
    /// Messages that writer and readers keep; 0 for all, so that the sender waits for who is slow.
    pub(crate) depth: u32,
}

/// One run.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Order {
    /// Bytes of a message.
    pub(crate) size: usize,
    /// At most so many messages.
    pub(crate) count: u32,
    /// None begins after so long.
    pub(crate) seconds: f64,
    /// Messages a second; None is as fast as writing goes.
    pub(crate) rate: Option<f64>,
}

/// The result of a run.
#[derive(Clone, Debug)]
pub(crate) struct Outcome {
    /// Messages written.
    pub(crate) sent: u32,
    /// Messages that arrived, by reader.
    pub(crate) received: Vec<u32>,
    /// From before the first was written until the last had been taken.
    pub(crate) seconds: f64,
    /// From before a message was written until it was taken: p50, p99, most, µs; of several local networks the worst.
    pub(crate) age_us: [f64; 3],
    /// CPU time of the system's processes meanwhile, seconds.
    pub(crate) cpu_seconds: f64,
    /// CPU time of these programs meanwhile, seconds. Threads that have ended are not in it.
    pub(crate) load_cpu_seconds: f64,
}

impl Outcome {
    /// Messages that arrived, at all readers together.
    pub(crate) fn arrived(&self) -> f64 {
        self.received.iter().map(|&n| f64::from(n)).sum()
    }

    /// Messages that each reader should have had and has not, all together.
    pub(crate) fn lost(&self) -> f64 {
        f64::from(self.sent) * self.received.len() as f64 - self.arrived()
    }
}

/// The programs.
#[derive(Debug)]
pub(crate) struct Flow {
    source: Program,
    sinks: Vec<Program>,
    run: u32,
}

#[derive(Deserialize)]
struct SourceReport {
    count: u32,
    begun_ns: u64,
}

#[derive(Deserialize)]
struct SinkReport {
    received: Vec<u32>,
    ended_ns: u64,
    age_us: [f64; 3],
}

impl Flow {
    /// Starts them; every reader has had a message when this returns.
    pub(crate) fn start(lab: &Lab, running: &Running, spec: &FlowSpec) -> Result<Self> {
        let there = [running.dds[spec.from.other() as usize].clone()];
        Self::start_between(lab, &running.dds[spec.from as usize], &there, spec)
    }

    /// Starts a flow from a local network here to several there.
    pub(crate) fn start_between(lab: &Lab, here: &Dds, there: &[Dds], spec: &FlowSpec) -> Result<Self> {
        let (depth, readers) = (spec.depth.to_string(), spec.readers.to_string());
        let mut args = vec!["--topic", spec.topic, "--depth", &depth];
        if spec.reliable {
            args.push("--reliable");
        }
        let sink_args = [&["sink"][..], &args, &["--readers", &readers]].concat();
        let sinks = there.iter().map(|dds| lab.load_in(dds, spec.from.other(), &sink_args));
        let mut sinks = sinks.collect::<Result<Vec<_>>>()?;
        for sink in &mut sinks {
            sink.soon("up")?;
        }
        let source = lab.load_in(here, spec.from, &[&["source"][..], &args].concat())?;
        for sink in &mut sinks {
            sink.until("connected", CONNECT_MAX)?;
        }
        Ok(Self { source, sinks, run: 0 })
    }

    /// Sends and counts.
    pub(crate) fn run(&mut self, running: &Running, order: &Order) -> Result<Outcome> {
        self.run += 1;
        let (cpu, load_cpu) = (running.cpu_seconds(), self.cpu_seconds());
        self.source.order(&json!({ "send": {
            "run": self.run, "size": order.size, "count": order.count, "seconds": order.seconds,
            "rate": order.rate,
        }}))?;
        let most = Duration::from_secs_f64(order.seconds) + SPARE;
        let sent: SourceReport = serde_json::from_value(self.source.until("sent", most)?)?;
        for sink in &mut self.sinks {
            sink.order(&json!({ "count": {
                "run": self.run, "last": sent.count, "quiet_seconds": QUIET.as_secs_f64(),
            }}))?;
        }
        let (mut received, mut ended_ns, mut age_us) = (Vec::new(), 0, [0.0_f64; 3]);
        for sink in &mut self.sinks {
            let counted = sink.until("counted", most + QUIET)?;
            let counted: SinkReport = serde_json::from_value(counted).context("what a sink counted")?;
            received.extend(counted.received);
            ended_ns = ended_ns.max(counted.ended_ns);
            for (worst, age) in age_us.iter_mut().zip(counted.age_us) {
                *worst = worst.max(age);
            }
        }
        Ok(Outcome {
            sent: sent.count,
            received,
            seconds: ended_ns.saturating_sub(sent.begun_ns) as f64 / 1e9,
            age_us,
            cpu_seconds: running.cpu_seconds() - cpu,
            load_cpu_seconds: self.cpu_seconds() - load_cpu,
        })
    }

    fn cpu_seconds(&self) -> f64 {
        self.source.cpu_seconds() + self.sinks.iter().map(Program::cpu_seconds).sum::<f64>()
    }
}
