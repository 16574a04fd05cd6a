//! Measures messages of 1 KB from a sender through one router to a receiver, beside other systems.
//!
//! Sender and receiver are in this process, so that one clock times both; the router is a process of its own, whose CPU
//! time the system counts. All ways stay up for the whole run and take turns, so that what else the machine does meets
//! each of them.

mod sgc;
pub(crate) mod tcp;
#[cfg(feature = "zenoh")]
pub(crate) mod zenoh;

use std::any::Any;
use std::sync::atomic::{AtomicU64, Ordering::SeqCst};
use std::sync::{Arc, LazyLock, Mutex, PoisonError};
use std::time::{Duration, Instant};

use anyhow::{Result, ensure};
use bytes::Bytes;
use serde::Serialize;
use sgc_trust::Suite;

use crate::RunArgs;
use crate::process::{PATIENCE, Server};
use crate::report::{Report, Spread, Table, digits, median, thousands};

/// Payload of a message.
const MESSAGE_BYTES: usize = 1024;
/// Messages that the sender hands over together when it goes as fast as it can: what an application under load has at
/// hand.
const BURST: usize = 32;
/// Messages a second when it is delays that are measured.
const PACE: Duration = Duration::from_millis(1);
/// Offset of the time of sending in a payload, behind the CDR encapsulation header.
const STAMP_AT: usize = 4;

/// Names of the rows with zenoh.
const ZENOH: &str = "zenoh router";

/// The zero of the time stamps.
static EPOCH: LazyLock<Instant> = LazyLock::new(Instant::now);

/// One way from the sender to the receiver.
struct Way {
    name: &'static str,
    sender: Box<dyn Sender>,
    arrivals: Arc<Arrivals>,
    /// The process in the middle; none where the ends talk to each other.
    router: Option<Server>,
    /// Values that have to live as long, dropped last.
    _rest: Box<dyn Any>,
}

/// The sending end of a way: reliable, in order, and it waits while the way takes no more.
trait Sender {
    /// Sends these messages.
    fn send(&mut self, payloads: &[Bytes]) -> Result<()>;
}

/// The arrivals at the receiver.
#[derive(Default)]
struct Arrivals {
    count: AtomicU64,
    /// Delay of each message in microseconds, while it is recorded.
    delays: Mutex<Option<Vec<f64>>>,
}

impl Arrivals {
    /// A message is here.
    fn take(&self, payload: &[u8]) {
        let arrived = EPOCH.elapsed();
        if let Some(delays) = &mut *self.delays() {
            let stamp = payload.get(STAMP_AT..STAMP_AT + 8).and_then(|s| s.try_into().ok());
            let sent = Duration::from_nanos(u64::from_le_bytes(stamp.unwrap_or_default()));
            delays.push(arrived.saturating_sub(sent).as_secs_f64() * 1e6);
        }
        self.count.fetch_add(1, SeqCst);
    }

    fn count(&self) -> u64 {
        self.count.load(SeqCst)
    }

    fn delays(&self) -> std::sync::MutexGuard<'_, Option<Vec<f64>>> {
        self.delays.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

impl Way {
    /// Sends until something arrives, and waits until nothing more does.
    fn warm_up(&mut self) -> Result<()> {
        let begun = Instant::now();
        while self.arrivals.count() == 0 {
            ensure!(begun.elapsed() < PATIENCE, "nothing arrives over {}", self.name);
            self.sender.send(&[stamped()])?;
            std::thread::sleep(Duration::from_millis(20));
        }
        let mut before = 0;
        while before != self.arrivals.count() {
            before = self.arrivals.count();
            std::thread::sleep(Duration::from_millis(300));
        }
        Ok(())
    }

    /// Waits for the message with this number.
    fn until_arrived(&self, number: u64) -> Result<()> {
        let begun = Instant::now();
        while self.arrivals.count() < number {
            let count = self.arrivals.count();
            ensure!(begun.elapsed() < PATIENCE, "{}: {count} of {number} messages arrive", self.name);
            std::thread::sleep(Duration::from_micros(200));
        }
        Ok(())
    }

    /// As fast as it goes for so long.
    fn rush(&mut self, time: Duration) -> Result<Rush> {
        let burst = vec![stamped(); BURST];
        let first = self.arrivals.count();
        let cpu = self.cpu_seconds();
        let begun = Instant::now();
        let mut sent = 0;
        while begun.elapsed() < time {
            self.sender.send(&burst)?;
            sent += BURST as u64;
        }
        self.until_arrived(first + sent)?;
        let took = begun.elapsed().as_secs_f64();
        Ok(Rush { per_second: sent as f64 / took, router_us: (self.cpu_seconds() - cpu) * 1e6 / sent as f64 })
    }

    /// One every [`PACE`] for so long: how long each is under way, microseconds.
    fn stroll(&mut self, time: Duration) -> Result<Vec<f64>> {
        *self.arrivals.delays() = Some(Vec::new());
        let first = self.arrivals.count();
        let (begun, mut sent) = (Instant::now(), 0);
        while begun.elapsed() < time {
            self.sender.send(&[stamped()])?;
            sent += 1;
            std::thread::sleep((PACE * sent).saturating_sub(begun.elapsed()));
        }
        self.until_arrived(first + u64::from(sent))?;
        Ok(self.arrivals.delays().take().unwrap_or_default())
    }

    fn cpu_seconds(&self) -> f64 {
        self.router.as_ref().map_or(0.0, Server::cpu_seconds)
    }
}

/// A message that says when it was made.
fn stamped() -> Bytes {
    let mut payload = vec![7; MESSAGE_BYTES];
    payload[..STAMP_AT].copy_from_slice(&[0, 1, 0, 0]);
    let now = EPOCH.elapsed().as_nanos() as u64;
    payload[STAMP_AT..STAMP_AT + 8].copy_from_slice(&now.to_le_bytes());
    payload.into()
}

/// The result of one [`Way::rush`].
#[derive(Clone, Copy)]
struct Rush {
    per_second: f64,
    /// CPU time of the router for one message, microseconds.
    router_us: f64,
}

/// The figures of one kind of way.
#[derive(Serialize)]
struct Figures {
    way: &'static str,
    messages_per_second: f64,
    router_cpu_us_per_message: f64,
    messages_per_second_per_router_core: f64,
    /// Sender to receiver through the router, microseconds.
    through_us: Spread,
    /// The same ends without a router between them.
    direct_us: Spread,
    added_p50_us: f64,
    added_p99_us: f64,
}

/// A way, the same ends without its router, and what was measured of both.
struct Contestant {
    through: Way,
    direct: Way,
    rushes: Vec<Rush>,
    through_us: Vec<f64>,
    direct_us: Vec<f64>,
}

impl Contestant {
    fn new(through: Way, direct: Way) -> Self {
        let (rushes, through_us, direct_us) = (Vec::new(), Vec::new(), Vec::new());
        Self { through, direct, rushes, through_us, direct_us }
    }

    fn round(&mut self, time: Duration) -> Result<()> {
        self.rushes.push(self.through.rush(time)?);
        self.through_us.extend(self.through.stroll(time)?);
        self.direct_us.extend(self.direct.stroll(time)?);
        Ok(())
    }

    fn figures(self) -> Figures {
        let (through_us, direct_us) =
            (Spread::from_samples(self.through_us), Spread::from_samples(self.direct_us));
        let router_us = median(self.rushes.iter().map(|r| r.router_us));
        Figures {
            way: self.through.name,
            messages_per_second: median(self.rushes.iter().map(|r| r.per_second)),
            router_cpu_us_per_message: router_us,
            messages_per_second_per_router_core: 1e6 / router_us,
            through_us,
            direct_us,
            added_p50_us: through_us.p50 - direct_us.p50,
            added_p99_us: through_us.p99 - direct_us.p99,
        }
    }
}

/// Measures all ways.
pub(crate) fn run(args: &RunArgs) -> Result<Report> {
    let (rounds, time) =
        if args.quick { (1, Duration::from_millis(500)) } else { (7, Duration::from_secs(2)) };
    LazyLock::force(&EPOCH);
    let mut all = vec![
        Contestant::new(tcp::relayed()?, tcp::direct()?),
        #[cfg(feature = "zenoh")]
        Contestant::new(zenoh::routed()?, zenoh::direct()?),
        Contestant::new(sgc::routed(&args.sgc, Suite::Group)?, sgc::direct(Suite::Group)?),
        Contestant::new(sgc::routed(&args.sgc, Suite::Standard)?, sgc::direct(Suite::Standard)?),
    ];
    for contestant in &mut all {
        contestant.through.warm_up()?;
        contestant.direct.warm_up()?;
    }
    for round in 0..rounds {
        // Whoever follows may find the machine in another state: they change places.
        for turn in 0..all.len() {
            let place = (round + turn) % all.len();
            all[place].round(time)?;
        }
    }
    let figures: Vec<_> = all.into_iter().map(Contestant::figures).collect();
    let rate = |way: &str| {
        let found = figures.iter().find(|f| f.way == way);
        found.map_or(f64::NAN, |f| f.messages_per_second_per_router_core)
    };
    let (tcp, zenoh) = (rate(tcp::NAME), rate(ZENOH));
    let row = |f: &Figures| {
        vec![
            f.way.to_owned(),
            thousands(f.messages_per_second),
            digits(f.router_cpu_us_per_message),
            thousands(f.messages_per_second_per_router_core),
            digits(f.messages_per_second_per_router_core / tcp),
            digits(f.messages_per_second_per_router_core / zenoh),
            format!("{} / {}", digits(f.added_p50_us), digits(f.added_p99_us)),
            format!("{} / {}", digits(f.through_us.p50), digits(f.through_us.p99)),
        ]
    };
    let table = Table {
        title: format!("Forwarding {MESSAGE_BYTES} bytes through one router"),
        columns: vec![
            "way",
            "messages/s, all on this machine",
            "router CPU, µs a message",
            "messages/s a router core",
            "× TCP relay",
            "× zenoh",
            "added p50 / p99, µs",
            "one way p50 / p99, µs",
        ],
        rows: figures.iter().map(row).collect(),
    };
    Report::new(&figures, vec![table])
}
