//! iroh: the programs of `bench/iroh-peer` at both sites, and its relay in the cloud.

use std::path::Path;
use std::time::Instant;

use anyhow::{Context, Result};
use serde_json::{Value, json};

use super::lab::{Lab, ROUTER};
use super::pair::{Pair, Plan, START_MAX, Start, ms};
use crate::compare::{Program, Side};

const PORT: u16 = 3443;
const HTTP_PORT: u16 = 3340;
/// The UDP port on which the relay tells endpoints their addresses.
const ADDRESS_PORT: u16 = 7842;

/// How the endpoints connect.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Kind {
    /// Through the relay alone.
    Relayed,
    /// Directly, once that is possible; the dialer connects as soon as it has started.
    Direct,
    /// The same, but the dialer first waits for its relay, which tells it its address.
    Online,
}

/// Fields go in this order.
struct Iroh {
    dialer: Program,
    _server: Program,
    _relay: Program,
}

/// Starts the relay, the server at the right site, and the dialer at the left one.
pub(super) fn start(lab: &Lab, program: &Path, kind: Kind) -> Result<(Box<dyn Pair>, Start)> {
    let dir = lab.new_dir("iroh")?;
    let certificate = dir.join("relay.der");
    let mut command = lab.cloud().command(program);
    command.args(["relay", "--address", &ROUTER.to_string(), "--port", &PORT.to_string()]);
    command.args(["--http-port", &HTTP_PORT.to_string(), "--address-port", &ADDRESS_PORT.to_string()]);
    command.arg("--certificate").arg(&certificate);
    let mut relay = Program::start("iroh-relay", command, &dir)?;
    relay.soon("up")?;
    let peer = |side: Side, role: &str| {
        let mut command = lab.site(side).command(program);
        command.args([role, "--relay", &format!("https://{ROUTER}:{PORT}")]);
        command.args(["--address-port", &ADDRESS_PORT.to_string(), "--certificate"]).arg(&certificate);
        // The relayed end warns of each packet that it drops, which would take its time.
        command.env("RUST_LOG", "error");
        if kind == Kind::Relayed {
            command.arg("--relayed");
        }
        command
    };
    let mut server = Program::start("iroh-serve", peer(Side::Right, "serve"), &dir)?;
    let id = server.soon("serving")?;
    let mut command = peer(Side::Left, "connect");
    command.args(["--peer", id.as_str().context("an id that is no text")?]);
    if kind == Kind::Online {
        command.arg("--online");
    }
    let begun = Instant::now();
    let mut dialer = Program::start("iroh-connect", command, &dir)?;
    let start = watch(&mut dialer, begun, kind)?;
    if kind != Kind::Relayed {
        server.until("direct", START_MAX).context("the server's way back")?;
    }
    Ok((Box::new(Iroh { dialer, _server: server, _relay: relay }), start))
}

/// Waits for the first message and the direct path, in whatever order they come.
fn watch(dialer: &mut Program, begun: Instant, kind: Kind) -> Result<Start> {
    let mut start = Start::default();
    while start.first_ms.is_none() || (kind != Kind::Relayed && start.direct_ms.is_none()) {
        let line = dialer.line(START_MAX)?;
        let event: Value = serde_json::from_str(&line)?;
        if event.get("connected").is_some() {
            start.first_ms = Some(ms(begun.elapsed()));
        } else if let Some(direct) = event.get("direct") {
            start.direct_ms = Some(ms(begun.elapsed()));
            start.known_to_direct_ms = direct["after_ms"].as_f64();
        }
    }
    Ok(start)
}

impl Pair for Iroh {
    fn round_trips(&mut self, size: usize, plan: &Plan) -> Result<Vec<f64>> {
        self.dialer.order(&json!({ "measure": {
            "size": size, "count": plan.count, "seconds": plan.seconds, "warm_up": plan.warm_up,
        }}))?;
        let measured = self.dialer.until("measured", plan.most())?;
        let round_trips = measured["round_trips_us"].as_array().context("no round trips")?;
        Ok(round_trips.iter().filter_map(Value::as_f64).collect())
    }

    fn throughput(&mut self, plan: &Plan) -> Result<f64> {
        self.dialer.order(&json!({ "send": {
            "seconds": plan.flow_seconds, "warm_up_seconds": plan.flow_warm_up_seconds,
        }}))?;
        let sent = self.dialer.until("sent", plan.most())?;
        let (bytes, seconds) = (sent["bytes"].as_f64(), sent["seconds"].as_f64());
        Ok(bytes.context("no bytes")? / seconds.filter(|s| *s > 0.0).context("no time")?)
    }
}
