//! A ROS 2 talker and listener on `ros2-client` and RustDDS that does not know SGC.
//!
//! `../../README.md` specifies the command line and the printed lines. All events come through one channel: data from a
//! stream, signals and standard input from threads. How many are matched is asked for at an interval, because
//! `ros2-client` tells its changes through channels of eight places and drops what does not fit.

mod messages;
mod options;
mod service;

use std::collections::HashSet;
use std::io::Write as _;
use std::process::ExitCode;
use std::sync::Arc;
use std::sync::mpsc::{Receiver, RecvTimeoutError, Sender, channel};
use std::time::{Duration, Instant, SystemTime, UNIX_EPOCH};

use futures::channel::oneshot;
use futures::executor::block_on;
use futures::{FutureExt as _, StreamExt as _, select};
use messages::{Image, Message, Odd, PointCloud, Reading, Text, WideText};
use options::{Options, Role};
use ros2_client::qos::{Durability, History, QosProfile, Reliability, WhenFull};
use ros2_client::{Context, MessageTypeName, Name, Node, NodeName, NodeOptions};
use rustdds::DomainParticipantBuilder;
use serde_json::{Value, json};

const WRONG: u8 = 1;
const REFUSED: u8 = 2;
const INCOMPLETE: u8 = 3;

/// Time that a reliable publisher stays for its subscribers, because `ros2-client` does not report acknowledgements.
const SETTLE: Duration = Duration::from_secs(5);

/// Time between two looks at how many are matched.
const LOOK: Duration = Duration::from_millis(100);

enum Event {
    /// It is time to ask how many are matched.
    Look,
    /// A line came on standard input, or its end (false).
    Line(bool),
    Received(Result<Reading, String>),
    Signal,
}

fn main() -> ExitCode {
    let options = match Options::parse(std::env::args().skip(1)) {
        Ok(options) => options,
        Err(problem) => {
            eprintln!(
                "peer: {problem}; usage: peer pub|sub|client|server [options], see tests/peers/README.md"
            );
            return ExitCode::from(REFUSED);
        }
    };
    let is_service = matches!(options.role, Role::Client | Role::Server);
    let run = match options.kind.as_str() {
        _ if is_service => service::run,
        "string" => run::<Text>,
        "wstring" => run::<WideText>,
        "image" => run::<Image>,
        "pointcloud" => run::<PointCloud>,
        "custom" => run::<Odd>,
        other => {
            eprintln!("peer: no such type here: {other}");
            return ExitCode::from(REFUSED);
        }
    };
    match run(&options) {
        Ok(code) => ExitCode::from(code),
        Err(problem) => {
            eprintln!("peer: {problem}");
            ExitCode::from(REFUSED)
        }
    }
}

fn emit(event: &str, fields: Value) {
    let mut line = json!({ "event": event });
    if let (Value::Object(line), Value::Object(fields)) = (&mut line, fields) {
        line.extend(fields);
    }
    let mut out = std::io::stdout().lock();
    if writeln!(out, "{line}").and_then(|()| out.flush()).is_err() {
        // The reader of standard output is gone.
        std::process::exit(INCOMPLETE.into());
    }
}

fn wall_clock_ns() -> u64 {
    SystemTime::now().duration_since(UNIX_EPOCH).map_or(0, |now| now.as_nanos() as u64)
}

fn qos(options: &Options) -> QosProfile {
    QosProfile::publisher_default()
        .reliability(if options.reliable {
            Reliability::Reliable { when_full: WhenFull::Wait(Duration::from_secs(10)) }
        } else {
            Reliability::BestEffort
        })
        .durability(if options.transient_local { Durability::TransientLocal } else { Durability::Volatile })
        .history(match options.depth {
            0 => History::KeepAll,
            depth => History::KeepLast { depth },
        })
}

/// A running node.
fn with_node(options: &Options, act: impl FnOnce(Node) -> Result<u8, String>) -> Result<u8, String> {
    let mut participant = DomainParticipantBuilder::new(options.domain);
    if options.localhost {
        participant = participant.with_only_networks([std::net::Ipv4Addr::LOCALHOST]);
    }
    let participant = participant.build().map_err(|e| e.to_string())?;
    let context = Context::from_domain_participant(participant).map_err(|e| e.to_string())?;
    let name =
        NodeName::new("/", &format!("rustdds_peer_{}", std::process::id())).map_err(|e| e.to_string())?;
    let node_options = NodeOptions::new().enable_rosout(false).start_parameter_services(false);
    let mut node = context.new_node(name, node_options).map_err(|e| format!("{e:?}"))?;
    let spinner = node.spinner().map_err(|e| e.to_string())?;
    let spinning = std::thread::spawn(move || block_on(spinner.spin()));
    let code = act(node)?;
    // The participant says farewell when its last owner is dropped. The spinner owns it until it has ended.
    let _ = spinning.join();
    drop(context);
    Ok(code)
}

fn run<M: Message>(options: &Options) -> Result<u8, String> {
    let deadline = Instant::now() + options.timeout;
    let (sender, events) = channel();
    let mut signals = signal_hook::iterator::Signals::new([2, 15]).map_err(|e| e.to_string())?;
    let signal_sender = sender.clone();
    std::thread::spawn(move || {
        for _ in signals.forever() {
            let _ = signal_sender.send(Event::Signal);
        }
    });
    with_node(options, |node| {
        let look_sender = sender.clone();
        std::thread::spawn(move || {
            while look_sender.send(Event::Look).is_ok() {
                std::thread::sleep(LOOK);
            }
        });
        let mut peer = Peer { options, node, events, matched: 0, signalled: false, deadline };
        match options.role {
            Role::Pub => peer.publish::<M>(sender),
            _ => peer.subscribe::<M>(sender),
        }
    })
}

struct Peer<'a> {
    options: &'a Options,
    node: Node,
    events: Receiver<Event>,
    matched: usize,
    signalled: bool,
    deadline: Instant,
}

impl Peer<'_> {
    fn topic<M: Message>(&self) -> Result<rustdds::Topic, String> {
        let name = Name::parse(&self.options.topic).map_err(|e| e.to_string())?;
        let (package, kind) = M::TYPE;
        let kind = MessageTypeName::new(package, kind);
        self.node.create_topic(&name, kind, &qos(self.options)).map_err(|e| e.to_string())
    }

    /// Returns the next event before a deadline, or `None` if there is none or a signal came.
    fn next(&mut self, until: Instant) -> Option<Event> {
        if self.signalled {
            return None;
        }
        let left = until.min(self.deadline).saturating_duration_since(Instant::now());
        match self.events.recv_timeout(left) {
            Ok(Event::Signal) => {
                self.signalled = true;
                None
            }
            Ok(event) => Some(event),
            Err(RecvTimeoutError::Timeout | RecvTimeoutError::Disconnected) => None,
        }
    }

    fn set_matched(&mut self, count: usize) {
        if count != self.matched {
            self.matched = count;
            emit("matched", json!({ "count": count }));
        }
    }

    fn publish<M: Message>(&mut self, sender: Sender<Event>) -> Result<u8, String> {
        let topic = self.topic::<M>()?;
        let publisher = self.node.create_publisher::<M>(&topic, None).map_err(|e| e.to_string())?;
        emit("ready", json!({}));
        while self.matched < self.options.wait_matched {
            if self.next(self.deadline).is_none() {
                break;
            }
            self.set_matched(publisher.get_subscription_count(&self.node));
        }
        let mut matched = self.matched >= self.options.wait_matched;
        if matched && self.options.wait_go {
            std::thread::spawn(move || {
                let read = std::io::stdin().read_line(&mut String::new());
                let _ = sender.send(Event::Line(read.is_ok_and(|bytes| bytes > 0)));
            });
            matched = loop {
                match self.next(self.deadline) {
                    None => break false,
                    Some(Event::Line(go)) => break go,
                    Some(_) => self.set_matched(publisher.get_subscription_count(&self.node)),
                }
            };
        }
        let (begun, first) = (Instant::now(), self.options.start);
        let mut sent = 0;
        while matched && (self.options.count == 0 || sent < self.options.count) {
            let due = if self.options.rate > 0.0 {
                begun + Duration::from_secs_f64(sent as f64 / self.options.rate)
            } else {
                begun
            };
            while Instant::now() < due && self.next(due).is_some() {
                self.set_matched(publisher.get_subscription_count(&self.node));
            }
            if self.signalled || Instant::now() >= self.deadline {
                break;
            }
            let message = M::make(first + sent, wall_clock_ns(), self.options.size);
            if publisher.publish(message).is_err() {
                emit("refused", json!({ "seq": first + sent }));
                break;
            }
            if self.options.verbose {
                emit("sent", json!({ "seq": first + sent }));
            }
            sent += 1;
        }
        let seconds = begun.elapsed().as_secs_f64();
        emit("all_sent", json!({ "sent": sent, "acknowledged": null }));
        let mut stay = Instant::now() + self.options.hold;
        if self.options.reliable && sent > 0 && self.options.hold.is_zero() {
            stay += SETTLE;
        }
        while (self.matched > 0 || !self.options.hold.is_zero()) && self.next(stay).is_some() {
            self.set_matched(publisher.get_subscription_count(&self.node));
        }
        let last = (first + sent).checked_sub(1).filter(|_| sent > 0);
        emit(
            "summary",
            json!({ "role": "pub", "sent": sent, "first": last.map(|_| first), "last": last, "seconds": seconds,
                    "acknowledged": null, "matched": self.matched }),
        );
        let good = self.signalled || (matched && sent >= self.options.count);
        Ok(if good { 0 } else { INCOMPLETE })
    }

    fn subscribe<M: Message>(&mut self, sender: Sender<Event>) -> Result<u8, String> {
        let topic = self.topic::<M>()?;
        let subscription = self.node.create_subscription::<M>(&topic, None).map_err(|e| e.to_string())?;
        emit("ready", json!({}));
        let (stop, stopped) = oneshot::channel::<()>();
        let subscription = Arc::new(subscription);
        let reader = Arc::clone(&subscription);
        let reading = std::thread::spawn(move || {
            let mut stream = std::pin::pin!(reader.async_stream());
            let mut stopped = stopped.fuse();
            block_on(async {
                loop {
                    select! {
                        _ = stopped => break,
                        taken = stream.select_next_some() => {
                            let read = match taken {
                                Ok((message, _)) => message.read().ok_or_else(|| "it says nothing of itself".into()),
                                Err(error) => Err(format!("{error:?}")),
                            };
                            let _ = sender.send(Event::Received(read));
                        }
                    }
                }
            });
        });
        let mut tally = Tally::default();
        let mut until = self.deadline;
        let mut complete = false;
        loop {
            if !complete && self.options.count > 0 && tally.seen.len() as u64 >= self.options.count {
                complete = true;
                until = Instant::now() + self.options.linger;
            }
            let Some(event) = self.next(until) else { break };
            let read = match event {
                Event::Received(read) => read,
                _ => {
                    self.set_matched(subscription.get_publisher_count(&self.node));
                    continue;
                }
            };
            let read = read.unwrap_or_else(|error| {
                emit("unreadable", json!({ "error": error }));
                Reading { seq: 0, stamp_ns: wall_clock_ns(), intact: false }
            });
            if self.options.verbose || !read.intact {
                emit("received", json!({ "seq": read.seq, "ok": read.intact }));
            }
            tally.add(&read);
        }
        let _ = stop.send(());
        let _ = reading.join();
        let mut summary = tally.summary();
        summary["role"] = "sub".into();
        summary["matched"] = self.matched.into();
        emit("summary", summary);
        if tally.altered > 0 || tally.duplicated > 0 {
            return Ok(WRONG);
        }
        let enough = self.signalled || tally.seen.len() as u64 >= self.options.count;
        Ok(if enough { 0 } else { INCOMPLETE })
    }
}

/// The record of received messages.
#[derive(Default)]
struct Tally {
    seen: HashSet<u64>,
    first: u64,
    last: u64,
    altered: u64,
    duplicated: u64,
    reordered: u64,
    latency_us: Vec<i64>,
}

impl Tally {
    fn add(&mut self, read: &Reading) {
        self.latency_us.push((wall_clock_ns() as i64 - read.stamp_ns as i64) / 1000);
        if !read.intact {
            self.altered += 1;
        } else if !self.seen.insert(read.seq) {
            self.duplicated += 1;
        } else if self.seen.len() == 1 {
            (self.first, self.last) = (read.seq, read.seq);
        } else {
            self.reordered += u64::from(read.seq < self.last);
            self.first = self.first.min(read.seq);
            self.last = self.last.max(read.seq);
        }
    }

    fn summary(&mut self) -> Value {
        self.latency_us.sort_unstable();
        let count = self.latency_us.len();
        let at =
            |part: f64| self.latency_us.get(((count as f64 * part) as usize).min(count.saturating_sub(1)));
        let received = self.seen.len() as u64;
        let any = received > 0;
        json!({
            "received": received, "first": any.then_some(self.first), "last": any.then_some(self.last),
            "lost": if any { self.last - self.first + 1 - received } else { 0 },
            "duplicated": self.duplicated, "altered": self.altered, "reordered": self.reordered,
            "latency_us": { "p50": at(0.5), "p99": at(0.99), "max": at(1.0) },
        })
    }
}
