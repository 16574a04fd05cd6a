//! Measures the time from a publisher's link to its first message at a waiting subscriber.
//!
//! Subscriber and router are up. The publisher's node starts with an application on its local network that was there
//! before: so each run has everything in it that a start has, the owner's advertisements, the subscriber's requests to
//! join its catalogue and its topic, two grants, and the message.

use std::path::Path;
use std::sync::mpsc::{Receiver, channel};
use std::sync::{Mutex, PoisonError};
use std::time::{Duration, Instant};

use anyhow::{Context, Result};
use bytes::Bytes;
use serde::Serialize;
use sgc_testkit::FakeDomain;
use sgc_trust::Suite;
use sgc_wire::{Durability, History, Qos};
use tracing::field::{Field, Visit};
use tracing_subscriber::layer::{Context as LayerContext, Layer, SubscriberExt as _};

use crate::RunArgs;
use crate::fleet::BenchFleet;
use crate::node::{Listener, Node, Talker, config, share, usage, wait};
use crate::process::{PATIENCE, SgcRouter};
use crate::report::{Report, Spread, Table, digits};

const TOPIC: &str = "/first";
const MESSAGE_BYTES: usize = 1024;
/// Period of a publisher without a history, which is the resolution of the measurement.
const EVERY: Duration = Duration::from_micros(200);

/// Time at which this process last logged that a link is up.
static LINK_UP: Mutex<Option<Instant>> = Mutex::new(None);

/// The kind of publisher.
#[derive(Clone, Copy, Serialize)]
#[serde(rename_all = "snake_case")]
enum Publisher {
    /// The application has published one message and keeps it for late joiners.
    Latched,
    /// The application publishes all the time.
    Stream,
}

#[derive(Serialize)]
struct Figures {
    publisher: Publisher,
    suite: String,
    starts: usize,
    /// From link up to the first message, milliseconds.
    after_link_ms: Spread,
    /// From the start of the node, with its handshake, milliseconds.
    after_start_ms: Spread,
}

/// Measures all kinds of publishers.
pub(crate) fn run(args: &RunArgs) -> Result<Report> {
    watch_links()?;
    let starts = if args.quick { 5 } else { 200 };
    let mut figures = Vec::new();
    for publisher in [Publisher::Latched, Publisher::Stream] {
        for suite in [Suite::Group, Suite::Standard] {
            figures.push(measure(args, publisher, suite, starts)?);
        }
    }
    let row = |f: &Figures| {
        let publisher = match f.publisher {
            Publisher::Latched => "latched message",
            Publisher::Stream => "stream",
        };
        let spread = |s: &Spread| format!("{} / {}", digits(s.p50), digits(s.p99));
        vec![
            publisher.to_owned(),
            f.suite.clone(),
            f.starts.to_string(),
            spread(&f.after_link_ms),
            spread(&f.after_start_ms),
        ]
    };
    let table = Table {
        title: "First message after a publisher's start, ms".into(),
        columns: vec!["publisher", "suite", "starts", "after link up: p50 / p99", "after start: p50 / p99"],
        rows: figures.iter().map(row).collect(),
    };
    Report::new(&figures, vec![table])
}

fn measure(args: &RunArgs, publisher: Publisher, suite: Suite, starts: usize) -> Result<Figures> {
    let (fleet, dir) = (BenchFleet::new()?, tempfile::tempdir()?);
    fleet.write_router(dir.path())?;
    let router = SgcRouter::start(&args.sgc, dir.path())?;
    measure_at(&router, &fleet, dir.path(), publisher, suite, starts)
}

/// From a publisher's link to a latched message at the subscriber, by this router, milliseconds.
pub(crate) fn latched_after_link_ms(
    router: &SgcRouter,
    fleet: &BenchFleet,
    dir: &Path,
    suite: Suite,
    starts: usize,
) -> Result<Spread> {
    // Another watcher in this process sees the same.
    let _ = watch_links();
    Ok(measure_at(router, fleet, dir, Publisher::Latched, suite, starts)?.after_link_ms)
}

fn watch_links() -> Result<()> {
    Ok(tracing::subscriber::set_global_default(tracing_subscriber::registry().with(LinkWatch))?)
}

fn measure_at(
    router: &SgcRouter,
    fleet: &BenchFleet,
    dir: &Path,
    publisher: Publisher,
    suite: Suite,
    starts: usize,
) -> Result<Figures> {
    let (near, far) = (FakeDomain::default(), FakeDomain::default());
    let mut desk = config(dir, "desk", &[&router.url])?;
    desk.uses = vec![usage(TOPIC, "robot")?];
    let desk = Node::start(desk, fleet.issue("desk", false)?, &far)?;
    let qos = match publisher {
        Publisher::Latched => {
            Qos { durability: Durability::TransientLocal, history: History::KeepLast(1), ..Qos::default() }
        }
        Publisher::Stream => Qos::default(),
    };
    let (sender, heard) = channel();
    let _listener = Listener::new(&far, TOPIC, qos.clone(), move |_| {
        let _ = sender.send(Instant::now());
    })?;
    let talker = Talker::new(&near, TOPIC, qos)?;
    let payload = Bytes::from(vec![7; MESSAGE_BYTES]);
    talker.say(payload.clone())?;
    let robot_identity = fleet.issue("robot", false)?;
    wait("the subscriber is connected", || {
        Ok(desk.status()?["links"].as_array().is_some_and(|l| !l.is_empty()))
    })?;

    let others = router.links()?;
    let (mut after_link, mut after_start) = (Vec::new(), Vec::new());
    for _ in 0..starts {
        let mut robot = config(dir, "robot", &[&router.url])?;
        robot.shares = vec![share(TOPIC, "desk", suite)?];
        *link_up() = None;
        let begun = Instant::now();
        let robot = Node::start(robot, robot_identity.clone(), &near)?;
        let arrived = first(&heard, begun, || match publisher {
            Publisher::Latched => Ok(()),
            Publisher::Stream => talker.say(payload.clone()),
        })?;
        let up = link_up().context("no link came up")?;
        after_link.push(arrived.saturating_duration_since(up).as_secs_f64() * 1e3);
        after_start.push((arrived - begun).as_secs_f64() * 1e3);
        // The next start meets the same state: no node has a name or a grant of this one.
        let granted = desk.route_state()?;
        drop(robot);
        wait("the publisher is forgotten", || {
            Ok(router.links()? == others && desk.route_state()? != granted)
        })?;
        while heard.try_recv().is_ok() {}
    }
    Ok(Figures {
        publisher,
        suite: suite.to_string(),
        starts,
        after_link_ms: Spread::from_samples(after_link),
        after_start_ms: Spread::from_samples(after_start),
    })
}

/// Publishes until the first message arrives, and returns its time.
fn first(
    heard: &Receiver<Instant>,
    begun: Instant,
    mut publish: impl FnMut() -> Result<()>,
) -> Result<Instant> {
    loop {
        publish()?;
        match heard.recv_timeout(EVERY) {
            Ok(arrived) => return Ok(arrived),
            Err(error) if begun.elapsed() > PATIENCE => return Err(error).context("no message arrives"),
            Err(_) => {}
        }
    }
}

fn link_up() -> std::sync::MutexGuard<'static, Option<Instant>> {
    LINK_UP.lock().unwrap_or_else(PoisonError::into_inner)
}

/// Notes when a node of this process logs that a link is up: nodes tell it nowhere else.
struct LinkWatch;

impl<S: tracing::Subscriber> Layer<S> for LinkWatch {
    fn on_event(&self, event: &tracing::Event<'_>, _: LayerContext<'_, S>) {
        let now = Instant::now();
        let mut message = Message(false);
        event.record(&mut message);
        if message.0 {
            link_up().get_or_insert(now);
        }
    }
}

/// Returns `true` if it is that message.
struct Message(bool);

impl Visit for Message {
    fn record_debug(&mut self, field: &Field, value: &dyn std::fmt::Debug) {
        self.0 |= field.name() == "message" && format!("{value:?}") == "link is up";
    }
}
