//! Programs of DDS at the two sites, which know nothing of the system that carries their topics.

use std::time::Duration;

use anyhow::{Context, Result, ensure};
use serde_json::{Value, json};

use super::lab::Lab;
use super::pair::{Pair, Plan, START_MAX};
use crate::compare::{Dds, Program, Side};

/// The topics, and the sites of their subscribers.
pub(super) const TOPICS: [(&str, Side); 3] = [(PING, Side::Right), (PONG, Side::Left), (FLOW, Side::Right)];
const PING: &str = "/bench/ping";
const PONG: &str = "/bench/pong";
const FLOW: &str = "/bench/flow";
/// Bytes of a message of a transfer.
const FLOW_BYTES: usize = 64 << 10;
/// A transfer is over when its last message is there, or when nothing has come for so long.
const QUIET: Duration = Duration::from_secs(3);
/// How long a message is waited for.
const LOST_AFTER: Duration = Duration::from_secs(5);

/// The programs.
pub(super) struct Programs {
    ping: Program,
    _pong: Program,
    source: Program,
    sink: Program,
    run: u32,
}

impl Programs {
    /// Starts them in these local networks. They wait until a system connects the sites.
    pub(super) fn start(lab: &Lab, dds: &[Dds; 2]) -> Result<Self> {
        let [left, right] = dds;
        let args = ["--topic", PING, "--back", PONG, "--reliable"];
        // Keeps all that is not acknowledged, so that the sender waits for what is slow.
        let flow = ["--topic", FLOW, "--reliable", "--depth", "0"];
        let mut pong = lab.load(right, Side::Right, &[&["pong"][..], &args].concat())?;
        pong.soon("up")?;
        let mut sink = lab.load(right, Side::Right, &[&["sink"][..], &flow].concat())?;
        sink.soon("up")?;
        let ping = lab.load(left, Side::Left, &[&["ping"][..], &args].concat())?;
        let source = lab.load(left, Side::Left, &[&["source"][..], &flow].concat())?;
        Ok(Self { ping, _pong: pong, source, sink, run: 0 })
    }

    /// Waits for the first message there and back.
    pub(super) fn wait_for_first(&mut self) -> Result<()> {
        self.ping.until("connected", START_MAX).map(drop)
    }

    /// One transfer. Returns the bytes of content that arrived in a second.
    fn transfer(&mut self, seconds: f64, most: Duration) -> Result<f64> {
        self.run += 1;
        self.source.order(&json!({ "send": {
            "run": self.run, "size": FLOW_BYTES, "count": u32::MAX, "seconds": seconds, "rate": Value::Null,
        }}))?;
        let sent = self.source.until("sent", most)?;
        self.sink.order(&json!({ "count": {
            "run": self.run, "last": sent["count"], "quiet_seconds": QUIET.as_secs_f64(),
        }}))?;
        let counted = self.sink.until("counted", most)?;
        let (sent_count, received) = (sent["count"].as_u64(), counted["received"][0].as_u64());
        ensure!(sent_count == received, "{sent_count:?} messages sent, {received:?} received");
        let at = |report: &Value, field: &str| report[field].as_u64().with_context(|| field.to_owned());
        let nanoseconds = at(&counted, "ended_ns")?.saturating_sub(at(&sent, "begun_ns")?);
        let bytes = received.unwrap_or_default() * FLOW_BYTES as u64;
        Ok(bytes as f64 / (nanoseconds as f64 / 1e9))
    }
}

impl Pair for Programs {
    fn round_trips(&mut self, size: usize, plan: &Plan) -> Result<Vec<f64>> {
        self.ping.order(&json!({ "measure": {
            "size": size, "count": plan.count, "seconds": plan.seconds, "warm_up": plan.warm_up,
            "patience_seconds": LOST_AFTER.as_secs_f64(),
        }}))?;
        let measured = self.ping.until("measured", plan.most())?;
        ensure!(measured["lost"] == 0, "{} messages are lost", measured["lost"]);
        let round_trips = measured["round_trips_us"].as_array().context("no round trips")?;
        Ok(round_trips.iter().filter_map(Value::as_f64).collect())
    }

    fn throughput(&mut self, plan: &Plan) -> Result<f64> {
        if self.run == 0 {
            self.sink.until("connected", START_MAX)?;
        }
        self.transfer(plan.flow_warm_up_seconds, plan.most())?;
        self.transfer(plan.flow_seconds, plan.most())
    }
}
