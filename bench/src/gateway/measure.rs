//! Times round trips to DDS, messages from DDS, and messages to DDS.

use std::sync::Arc;
use std::sync::atomic::{AtomicU32, AtomicU64, Ordering};
use std::time::Duration;

use anyhow::{Context, Result, bail, ensure};
use serde::Deserialize;
use serde_json::json;
use tokio::time::{Instant, sleep, timeout};

use super::client::{Hearer, Sayer, Way};
use super::scene::{DOWN, PING, PONG, Scene, UP, now_ns, numbered};

/// Longest time until the path carries messages.
const CONNECT_MAX: Duration = Duration::from_secs(30);
/// Time after which a message is repeated while the path may not be up yet.
const HELLO_EVERY: Duration = Duration::from_millis(200);
/// Longest wait for an answer.
const ANSWER_MAX: Duration = Duration::from_secs(10);
/// A run is over when its last message is there, or when nothing has come for so long.
const QUIET: Duration = Duration::from_secs(2);
/// Period of polling.
const LOOK: Duration = Duration::from_millis(2);
/// Additional wait for a program's answer, beyond its own limit.
const SPARE: Duration = Duration::from_secs(20);

/// The extent of a measurement.
pub(super) struct Plan {
    warm_up: usize,
    round_trips: usize,
    seconds: f64,
}

impl Plan {
    pub(super) fn for_size(size: usize, quick: bool) -> Self {
        let (warm_up, round_trips) = if size >= 1 << 20 { (5, 200) } else { (100, 3000) };
        if quick {
            return Self { warm_up: warm_up / 5, round_trips: round_trips / 20, seconds: 0.3 };
        }
        Self { warm_up, round_trips, seconds: 2.0 }
    }
}

/// Messages in one direction.
#[derive(Clone, Copy, Debug)]
pub(super) struct Flow {
    pub(super) sent: u32,
    pub(super) received: u32,
    /// Time from before the first message was sent until the last had arrived.
    pub(super) seconds: f64,
    /// CPU time of the gateway's process meanwhile, seconds.
    pub(super) cpu_seconds: f64,
}

/// From before the client says a message until it has it back from the DDS program, µs.
pub(super) async fn round_trip(scene: &Scene, way: Way, size: usize, plan: &Plan) -> Result<Vec<f64>> {
    let run = scene.run();
    let mut hearer = Hearer::new(scene, way, PONG, size, false).await?;
    let mut sayer = Sayer::new(scene, way, PING, size, false).await?;
    let mut number = 0;
    let connected = Instant::now();
    loop {
        ensure!(connected.elapsed() < CONNECT_MAX, "nothing comes back");
        number += 1;
        sayer.say(numbered(run, number)).await?;
        sayer.flush().await?;
        if timeout(HELLO_EVERY, until(&mut hearer, numbered(run, number))).await.is_ok() {
            break;
        }
    }
    let mut took_us = Vec::with_capacity(plan.round_trips);
    let begun = Instant::now();
    for trip in 0..plan.warm_up + plan.round_trips {
        if begun.elapsed().as_secs_f64() > 2.0 * plan.seconds {
            break;
        }
        number += 1;
        let before = std::time::Instant::now();
        sayer.say(numbered(run, number)).await?;
        sayer.flush().await?;
        timeout(ANSWER_MAX, until(&mut hearer, numbered(run, number))).await.context("no answer")??;
        if trip >= plan.warm_up {
            took_us.push(before.elapsed().as_secs_f64() * 1e6);
        }
    }
    Ok(took_us)
}

async fn until(hearer: &mut Hearer, number: u64) -> Result<()> {
    while hearer.next().await? != number {}
    Ok(())
}

#[derive(Deserialize)]
struct SourceReport {
    count: u32,
    begun_ns: u64,
}

/// The messages of a run that the client has received.
#[derive(Default)]
struct ClientArrivals {
    run: AtomicU32,
    received: AtomicU32,
    last: AtomicU32,
    last_ns: AtomicU64,
}

/// Measures messages from a DDS program at full speed to the client. By gRPC the gateway buffers messages up to a
/// bound. It drops messages beyond that, and by rosbridge those beyond a queue.
pub(super) async fn down(scene: &Scene, way: Way, size: usize, plan: &Plan) -> Result<Flow> {
    let hearer = Hearer::new(scene, way, DOWN, size, true).await?;
    let heard = Arc::new(ClientArrivals::default());
    let hearing = tokio::spawn(hear(hearer, Arc::clone(&heard)));
    let send = async |seconds: f64, count: u32, size: usize, rate: Option<f64>| -> Result<SourceReport> {
        let run = scene.run();
        heard.received.store(0, Ordering::Relaxed);
        heard.last.store(0, Ordering::Relaxed);
        heard.run.store(run, Ordering::Relaxed);
        let order =
            json!({ "send": { "run": run, "size": size, "count": count, "seconds": seconds, "rate": rate } });
        let sent = scene.with_source(move |source| {
            source.order(&order)?;
            source.until("sent", Duration::from_secs_f64(seconds) + SPARE)
        });
        Ok(serde_json::from_value(sent.await?)?)
    };
    let connected = Instant::now();
    loop {
        ensure!(connected.elapsed() < CONNECT_MAX, "nothing comes");
        send(0.1, 1, size, None).await?;
        if until_quiet(&heard, 1, HELLO_EVERY).await {
            break;
        }
    }
    send(plan.seconds / 4.0, u32::MAX, size, None).await?;
    until_quiet(&heard, u32::MAX, HELLO_EVERY).await;
    let cpu = scene.cpu_seconds();
    let sent = send(plan.seconds, u32::MAX, size, None).await?;
    until_quiet(&heard, sent.count, QUIET).await;
    let cpu_seconds = scene.cpu_seconds() - cpu;
    if hearing.is_finished() {
        hearing.await??;
        bail!("the client has ended");
    }
    hearing.abort();
    let received = heard.received.load(Ordering::Relaxed);
    let seconds = heard.last_ns.load(Ordering::Relaxed).saturating_sub(sent.begun_ns) as f64 / 1e9;
    Ok(Flow { sent: sent.count, received, seconds, cpu_seconds })
}

/// Hears for as long as it can.
async fn hear(mut hearer: Hearer, heard: Arc<ClientArrivals>) -> Result<()> {
    loop {
        let number = hearer.next().await?;
        if (number >> 32) as u32 == heard.run.load(Ordering::Relaxed) {
            heard.received.fetch_add(1, Ordering::Relaxed);
            heard.last.store(number as u32, Ordering::Relaxed);
            heard.last_ns.store(now_ns(), Ordering::Relaxed);
        }
    }
}

/// Waits for the last message. Returns `false` if no more come.
async fn until_quiet(heard: &ClientArrivals, last: u32, quiet: Duration) -> bool {
    let (mut received, mut since) = (0, Instant::now());
    while heard.last.load(Ordering::Relaxed) < last {
        let now = heard.received.load(Ordering::Relaxed);
        if now != received {
            (received, since) = (now, Instant::now());
        } else if since.elapsed() > quiet {
            return false;
        }
        sleep(LOOK).await;
    }
    true
}

#[derive(Deserialize)]
struct SinkReport {
    received: Vec<u32>,
    ended_ns: u64,
}

/// Measures messages from the client at full speed to a DDS program. None is lost: DDS keeps unacknowledged messages,
/// and the gateway lets the client wait.
pub(super) async fn up(scene: &Scene, way: Way, size: usize, plan: &Plan) -> Result<Flow> {
    let mut sayer = Sayer::new(scene, way, UP, size, true).await?;
    let (.., before) = say(scene, &mut sayer, plan.seconds / 4.0).await?;
    let cpu = scene.cpu_seconds();
    let (run, begun_ns, said) = say(scene, &mut sayer, plan.seconds).await?;
    sayer.end(before + said).await?;
    let order = json!({ "count": { "run": run, "last": said, "quiet_seconds": QUIET.as_secs_f64() } });
    let counted = scene.with_sink(move |sink| {
        sink.order(&order)?;
        sink.until("counted", SPARE)
    });
    let counted: SinkReport = serde_json::from_value(counted.await?)?;
    let cpu_seconds = scene.cpu_seconds() - cpu;
    let received = counted.received.first().copied().unwrap_or_default();
    let seconds = counted.ended_ns.saturating_sub(begun_ns) as f64 / 1e9;
    Ok(Flow { sent: said, received, seconds, cpu_seconds })
}

/// Says as much as it can for so long: which run that was, when it began, and how many messages.
async fn say(scene: &Scene, sayer: &mut Sayer, seconds: f64) -> Result<(u32, u64, u32)> {
    let (run, begun_ns, begun) = (scene.run(), now_ns(), Instant::now());
    let mut said = 0;
    while begun.elapsed().as_secs_f64() < seconds {
        said += 1;
        sayer.say(numbered(run, said)).await?;
    }
    sayer.flush().await?;
    Ok((run, begun_ns, said))
}
