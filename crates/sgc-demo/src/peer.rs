//! Talker and listener of the demo: a plain DDS participant in one domain that does not know `sgc`, like a ROS 2
//! program.
//!
//! It runs in a process of its own, takes commands over standard input, and ends when that ends. Messages flow as soon
//! as a listener is there. They are numbered and counted only between [`PeerCommand::Go`] and [`PeerCommand::Stop`].

use std::io::{BufRead, Write};
use std::process;
use std::sync::mpsc::{Receiver, RecvTimeoutError, Sender, channel};
use std::sync::{Arc, Mutex};
use std::thread;
use std::time::{Duration, Instant, SystemTime, UNIX_EPOCH};

use rustix::time::{ClockId, clock_gettime};
use sgc_dds::{CycloneNetwork, DdsConfig, DiscoveryRange};
use sgc_process::EXIT_FAILURE;
use sgc_ros::{RosError, RosNetwork, RosWriter, Sample, SampleKind};
use sgc_sync::lock;

use crate::error::DemoError;
use crate::messages::{self, Draft};
use crate::protocol::{PeerCommand, PeerEvent};
use crate::topics::{Role, Topic};
use crate::tracker::Tracker;

/// The period of its reports.
const REPORT_PERIOD: Duration = Duration::from_millis(200);

/// Runs a peer until standard input ends.
pub fn peer(role: Role, domain: u32) -> Result<(), DemoError> {
    let events = Events::default();
    if let Err(error) = run_peer(role, domain, &events) {
        events.tell(&PeerEvent::Failed { reason: error.to_string() });
        return Err(DemoError::Failed { reason: error.to_string(), facts: Vec::new() });
    }
    Ok(())
}

fn run_peer(role: Role, domain: u32, events: &Events) -> Result<(), RosError> {
    let network = CycloneNetwork::open(&DdsConfig {
        domain,
        discovery: DiscoveryRange::LocalHost,
        ..DdsConfig::default()
    })?;
    let mut listeners = Vec::new();
    for topic in Topic::owned_by(role.other()) {
        listeners.push(Listener::start(&network, topic, events)?);
    }
    let (mut orders, mut talkers) = (Vec::new(), Vec::new());
    for topic in Topic::owned_by(role) {
        let (order, taken) = channel();
        let talker =
            Talker { topic, writer: network.create_writer(&topic.writer())?, events: events.clone() };
        talkers.push(thread::spawn(move || talker.run(&taken)));
        orders.push(order);
    }
    obey(&orders);

    // Standard input has ended. The steps below leave the network in good order. They must not take for ever, because
    // the parent may be dead.
    thread::spawn(sgc_process::exit_after_grace);
    drop(orders);
    for talker in talkers {
        let _ = talker.join();
    }
    drop(listeners);
    Ok(())
}

/// Hands the demo's commands to the talkers, until standard input ends.
fn obey(orders: &[Sender<PeerCommand>]) {
    for line in std::io::stdin().lock().lines() {
        let Ok(line) = line else { return };
        match serde_json::from_str::<PeerCommand>(&line) {
            Ok(command) => {
                for order in orders {
                    // A talker that is gone has reported its failure itself.
                    let _ = order.send(command);
                }
            }
            Err(error) => tracing::error!(%line, %error, "not a command"),
        }
    }
}

/// Reports events to the demo.
#[derive(Clone, Default)]
struct Events(Arc<Mutex<()>>);

impl Events {
    fn tell(&self, event: &PeerEvent) {
        let Ok(mut line) = serde_json::to_vec(event) else { return };
        line.push(b'\n');
        let _whole_lines = lock(&self.0);
        let mut out = std::io::stdout().lock();
        if out.write_all(&line).and_then(|()| out.flush()).is_err() {
            // The demo is gone, so there is nothing left to do.
            process::exit(EXIT_FAILURE.into());
        }
    }
}

/// Publishes one topic, on a thread of its own.
struct Talker<W> {
    topic: Topic,
    writer: W,
    events: Events,
}

impl<W: RosWriter> Talker<W> {
    fn run(&self, orders: &Receiver<PeerCommand>) {
        let topic = self.topic;
        let mut next = Instant::now();
        let mut reported = Instant::now();
        let mut readers = 0;
        // Number of messages sent since `Go`; `None` before it and after `Stop`.
        let mut sent: Option<u64> = None;
        loop {
            match orders.recv_timeout(next.saturating_duration_since(Instant::now())) {
                Ok(PeerCommand::Go) => sent = Some(0),
                Ok(PeerCommand::Stop) => {
                    let total = sent.take().unwrap_or(0);
                    self.events.tell(&PeerEvent::Sent { topic, total });
                }
                Err(RecvTimeoutError::Disconnected) => return,
                Err(RecvTimeoutError::Timeout) => {
                    next = (next + topic.period()).max(Instant::now());
                    let matched = self.writer.matched_readers();
                    if matched != readers {
                        readers = matched;
                        self.events.tell(&PeerEvent::Matched { topic, readers });
                    }
                    if readers == 0 && sent.is_none() {
                        continue;
                    }
                    if let Err(error) = self.publish(sent.map_or(0, |n| n + 1)) {
                        self.events.tell(&PeerEvent::Failed { reason: error.to_string() });
                        return;
                    }
                    if let Some(sent) = &mut sent {
                        *sent += 1;
                        if reported.elapsed() >= REPORT_PERIOD {
                            reported = Instant::now();
                            self.events.tell(&PeerEvent::Sending { topic, sent: *sent });
                        }
                    }
                }
            }
        }
    }

    fn publish(&self, seq: u64) -> Result<(), RosError> {
        let draft = Draft::new(self.topic, seq);
        let since_epoch = SystemTime::now().duration_since(UNIX_EPOCH).unwrap_or_default();
        let unix_ns = u64::try_from(since_epoch.as_nanos()).unwrap_or(0);
        let payload = draft.finish(monotonic_ns(), unix_ns);
        self.writer.write(SampleKind::Write, unix_ns as i64, payload)
    }
}

/// Subscribes to one topic and reports its progress.
struct Listener<R> {
    _reader: R,
    /// Ends the reporting thread when it is dropped.
    _end: Sender<()>,
}

impl<R> Listener<R> {
    fn start(network: &impl RosNetwork<Reader = R>, topic: Topic, events: &Events) -> Result<Self, RosError> {
        let tracker = Arc::new(Mutex::new(Tracker::new()));
        let reader = {
            let (tracker, events) = (Arc::clone(&tracker), events.clone());
            let mut arrived = false;
            network.create_reader(
                &topic.reader(),
                Box::new(move |sample: Sample| {
                    let now_ns = monotonic_ns();
                    let message = messages::decode(topic, &sample.payload);
                    let mut tracker = lock(&tracker);
                    tracker.handle(message, now_ns);
                    if !arrived && tracker.is_alive() {
                        arrived = true;
                        events.tell(&PeerEvent::Arrived { topic });
                    }
                }),
            )?
        };
        let (end, ended) = channel();
        let events = events.clone();
        thread::spawn(move || {
            let mut told = None;
            while let Err(RecvTimeoutError::Timeout) = ended.recv_timeout(REPORT_PERIOD) {
                let counts = lock(&tracker).counts();
                if told.as_ref() != Some(&counts) {
                    events.tell(&PeerEvent::Receiving { topic, counts: counts.clone() });
                    told = Some(counts);
                }
            }
        });
        Ok(Self { _reader: reader, _end: end })
    }
}

/// Reads the clock that all processes of this host share.
fn monotonic_ns() -> u64 {
    let now = clock_gettime(ClockId::Monotonic);
    now.tv_sec as u64 * 1_000_000_000 + now.tv_nsec as u64
}
