//! `sgc bench run`: the side that measures.
//!
//! One thing after the other, so that nothing disturbs another: each suite, then the bare path, then DDS without `sgc`.
//! Every wait is bounded, and what it ends by is said with the cause, as far as this side knows it.

use std::collections::HashMap;
use std::net::{IpAddr, SocketAddr};
use std::path::PathBuf;
use std::sync::mpsc::{Receiver, SyncSender, sync_channel};
use std::time::{Duration, Instant};

use clap::Args;
use rand_core::RngCore as _;
use sgc_dds::CycloneNetwork;
use sgc_ros::RosError;
use sgc_trust::{NodeName, Suite};

use super::echo::{Tcp, UDP_BYTES_MAX, Udp};
use super::machine::{Machine, cpu_us};
use super::program::End;
use super::report::{Flow, Path, Report, Trips};
use super::side::{self, Meeting, Side, Topics};
use super::words::{Answer, Ask, Counted, Frame, Kind, Lane, PROTOCOL, Question, RunId, Size, Tell};
use super::{EVENTS_MAX, Event, failed, next_event, router_url, wait_ready};
use crate::error::CliError;
use crate::{fleet, output, status, why};

/// How long the first answer may take.
const HELLO_MAX: Duration = Duration::from_secs(30);
/// Refusals of the link in a row after which nothing else is waited for.
const FAILURES_MAX: u32 = 3;
/// How long other answers may take.
const ANSWER_MAX: Duration = Duration::from_secs(15);
/// A question without an answer is asked again after so long.
const ASK_AGAIN: Duration = Duration::from_millis(500);
/// How often the other side hears that we are here.
const KEEP_PERIOD: Duration = Duration::from_secs(3);
/// How long nothing may come before the link is looked at, and how often then.
const SILENCE: Duration = Duration::from_secs(3);
/// How long nothing may come at all, beside what a slow path takes for the message.
const SILENCE_MAX: Duration = Duration::from_secs(30);
/// What the slowest path carries that is waited for, bytes a second.
const SLOWEST: u64 = 50_000;
/// Round trips of one size at most.
const TRIPS_MAX: usize = 1000;
/// Messages of a stream that are under way at most, and their bytes.
const WINDOW: (u64, u64) = (8, 1000);
const WINDOW_BYTES: u64 = 8_000_000;
/// Of so many parts of what may be under way one message each is answered.
const WINDOW_MARKS: u64 = 8;
/// How long a stream waits for word of its progress before it goes on without.
const PROGRESS_MAX: Duration = Duration::from_secs(2);
/// How long what is missing at the end of a stream may still come.
const DRAIN_MAX: Duration = Duration::from_secs(3);
/// How often it is counted meanwhile.
const COUNT_PERIOD: Duration = Duration::from_millis(200);
/// How long direct DDS may take to find the other side.
const DIRECT_MAX: Duration = Duration::from_secs(8);
/// What one write of the plain TCP stream takes.
const TCP_PIECE_BYTES: usize = 64 << 10;
/// Sizes at most.
const SIZES_MAX: usize = 16;

/// Measure between this machine and one where `sgc bench answer` runs
///
/// Prints a table and what it means; takes about twice --seconds for each suite and size. Exit code 0: it was measured;
/// 1: it could not be, and why.
#[derive(Debug, Args)]
pub(crate) struct MeasureArgs {
    /// The identity that `sgc fleet enroll` made, of another node than the answering one
    #[arg(long, value_name = "FILE")]
    identity: PathBuf,
    /// The name of the node that answers
    #[arg(long, value_name = "NODE")]
    with: NodeName,
    /// Where it listens, such as quic://desk.example:7448; several ways with commas
    #[arg(long, value_name = "URL", value_delimiter = ',', value_parser = router_url, required_unless_present = "router")]
    to: Vec<String>,
    /// A router of yours instead, which the other side names as well; several with commas
    #[arg(long, value_name = "URL", value_delimiter = ',', value_parser = router_url, conflicts_with = "to")]
    router: Vec<String>,
    /// Suites to measure, with commas
    #[arg(long, value_name = "SUITES", value_delimiter = ',', default_value = "group,standard")]
    suites: Vec<Suite>,
    /// Sizes of messages, with commas
    #[arg(long, value_name = "SIZES", value_delimiter = ',', default_value = "16,1000,1MB")]
    sizes: Vec<Size>,
    /// How long each measurement lasts
    #[arg(long, value_name = "N", default_value_t = 5, value_parser = clap::value_parser!(u32).range(1..=60))]
    seconds: u32,
    /// Write the figures as JSON
    #[arg(long, value_name = "FILE")]
    json: Option<PathBuf>,
    /// Write the tables as Markdown
    #[arg(long, value_name = "FILE")]
    markdown: Option<PathBuf>,
}

/// Runs `sgc bench run`.
pub(crate) fn measure(args: &MeasureArgs) -> Result<(), CliError> {
    let name = sgc_node::load_identity(&args.identity)?.node_name().to_string();
    if name == args.with.to_string() {
        let reason = format!(
            "{name} cannot measure with itself: enrol another node (`sgc fleet enroll`), one identity for each machine"
        );
        return Err(CliError::Cannot { reason });
    }
    if args.sizes.len() > SIZES_MAX {
        return Err(CliError::Cannot { reason: format!("at most {SIZES_MAX} sizes in one run") });
    }
    let (sender, events) = sync_channel(EVENTS_MAX);
    side::tell_of_signals(sender.clone())?;
    let mut bytes = [0; 16];
    fleet::system_rng()?.fill_bytes(&mut bytes);
    let mut measuring = Measuring::start(args, events, sender, RunId::new(bytes))?;
    let report = measuring.run()?;
    // Nobody needs to hear it who is gone.
    let _ = measuring.say(&Ask::Bye);
    drop(measuring);
    for line in report.lines() {
        output::line(line)?;
    }
    let text = || {
        serde_json::to_string_pretty(&report)
            .map_err(|e| CliError::System { what: "cannot write the figures", source: e.into() })
    };
    let write = |path: &PathBuf, text: String| {
        std::fs::write(path, text).map_err(|source| CliError::Write { path: path.clone(), source })
    };
    if let Some(path) = &args.json {
        write(path, text()? + "\n")?;
    }
    if let Some(path) = &args.markdown {
        write(path, report.markdown())?;
    }
    Ok(())
}

struct Measuring<'a> {
    // In the order in which they are to go: programs before their network, that before the node.
    ends: HashMap<Lane, End>,
    direct: Option<CycloneNetwork>,
    network: CycloneNetwork,
    side: Side,
    events: Receiver<Event>,
    sender: SyncSender<Event>,
    run: RunId,
    args: &'a MeasureArgs,
    phase: u32,
    kept: Instant,
}

impl<'a> Measuring<'a> {
    fn start(
        args: &'a MeasureArgs,
        events: Receiver<Event>,
        sender: SyncSender<Event>,
        run: RunId,
    ) -> Result<Self, CliError> {
        let urls = if args.router.is_empty() { &args.to } else { &args.router };
        let topics = Topics::Of(args.with.to_string(), args.suites.clone());
        let side = Side::start(&args.identity, &Meeting::Connect(urls.clone()), &topics, &sender)?;
        wait_ready(&events, &side)?;
        let network = side.join()?;
        let mut measuring = Self {
            ends: HashMap::new(),
            direct: None,
            network,
            side,
            events,
            sender,
            run,
            args,
            phase: 0,
            kept: Instant::now(),
        };
        for lane in measuring.lanes().into_iter().chain([Lane::Control]) {
            let end = End::asking(&measuring.network, lane, measuring.sender.clone()).map_err(from_dds)?;
            measuring.ends.insert(lane, end);
        }
        Ok(measuring)
    }

    fn lanes(&self) -> Vec<Lane> {
        let mut lanes = Vec::new();
        for suite in &self.args.suites {
            if !lanes.contains(&Lane::Sealed(*suite)) {
                lanes.push(Lane::Sealed(*suite));
            }
        }
        lanes
    }

    fn run(&mut self) -> Result<Report, CliError> {
        let (version, there) = self.hello()?;
        let mut report = Report::new(self.path(), Machine::here(), there, version);
        for lane in self.lanes() {
            self.warm_up(lane, HELLO_MAX)?;
            for size in self.args.sizes.clone() {
                report.trips.push(self.trips(lane, size)?);
                report.flows.push(self.flow(lane, size)?);
            }
        }
        report.path.rtt_us = self.link_rtt();
        match self.bare(&mut report)? {
            Ok(()) => {}
            Err(reason) => report.bare_not = Some(reason),
        }
        match self.directly(&mut report)? {
            Ok(()) => {}
            Err(reason) => report.direct_not = Some(reason),
        }
        Ok(report)
    }

    // Talking.

    fn say(&mut self, ask: &Ask) -> Result<(), CliError> {
        self.kept = Instant::now();
        let question = Frame::words(&Question { run: self.run.clone(), ask: ask.clone() });
        self.ends[&Lane::Control].send(&question).map_err(from_dds)
    }

    /// The next event until then; meanwhile the other side hears that we are here.
    fn next(&mut self, until: Instant) -> Result<Option<Event>, CliError> {
        if self.kept.elapsed() > KEEP_PERIOD {
            self.say(&Ask::Count { phase: 0 })?;
        }
        next_event(&self.events, &self.side, until)
    }

    /// Asks until there is an answer that fits; `None` if there is none in time.
    fn ask<T>(
        &mut self,
        ask: &Ask,
        max: Duration,
        fits: impl Fn(Tell) -> Option<T>,
    ) -> Result<Option<T>, CliError> {
        let deadline = Instant::now() + max;
        while Instant::now() < deadline {
            self.say(ask)?;
            let again = deadline.min(Instant::now() + ASK_AGAIN);
            while let Some(event) = self.next(again)? {
                let Event::Frame(Lane::Control, frame, _) = event else { continue };
                let Some(Answer { run, tell }) = frame.said() else { continue };
                if run != self.run {
                    continue;
                }
                if let Tell::Refused { reason } = &tell {
                    let who = &self.args.with;
                    return Err(failed(format!("{who} refuses: {}", output::clean(reason))));
                }
                if let Some(answer) = fits(tell) {
                    return Ok(Some(answer));
                }
            }
        }
        Ok(None)
    }

    fn hello(&mut self) -> Result<(String, Machine), CliError> {
        let suites = self.args.suites.iter().map(|suite| suite.name().to_owned()).collect();
        let hello = Ask::Hello { protocol: PROTOCOL, version: env!("CARGO_PKG_VERSION").to_owned(), suites };
        let deadline = Instant::now() + HELLO_MAX;
        while Instant::now() < deadline {
            // Shorter than the whole, so that a link that is refused again and again is noticed.
            let answer = self.ask(&hello, Duration::from_secs(1), |tell| match tell {
                Tell::Welcome { version, machine } => Some((version, machine)),
                _ => None,
            })?;
            if let Some((version, machine)) = answer {
                return Ok((output::clean(&version.chars().take(40).collect::<String>()), machine.cleaned()));
            }
            let status = self.side.status()?;
            let is_refused = |router: &status::Router| router.failures >= FAILURES_MAX;
            if status.links.is_empty() && !status.routers.is_empty() && status.routers.iter().all(is_refused)
            {
                break;
            }
            if self.another(&status.links).is_some() {
                break;
            }
        }
        Err(self.unreached())
    }

    /// Why the other side was never heard.
    fn unreached(&self) -> CliError {
        let who = &self.args.with;
        let status = match self.side.status() {
            Ok(status) => status,
            Err(error) => return error,
        };
        if status.links.is_empty() {
            let mut facts = Vec::new();
            for router in &status.routers {
                let why = router.last_failure.as_deref().unwrap_or("no answer so far");
                let named =
                    if why.contains(&router.router) { String::new() } else { format!("{}: ", router.router) };
                facts.push(output::clean(&format!("{named}{why}")));
            }
            facts.push(
                "is `sgc bench answer` running there, does the firewall let its port in (UDP for quic and dtls, TCP for \
                 the others), and are both identities of one fleet, neither revoked nor expired?"
                    .to_owned(),
            );
            return CliError::Bench { reason: format!("no link to {who}"), facts };
        }
        if let Some(link) = self.another(&status.links) {
            let reason = format!("the node at {} is not {who}", output::clean(&link.remote));
            let fact =
                "`sgc bench answer` prints the name of its node there: that belongs behind --with".to_owned();
            return CliError::Bench { reason, facts: vec![fact] };
        }
        let mut facts = why::first_wrong(&self.side.socket(), &Lane::Control.answer())
            .or_else(|| why::first_wrong(&self.side.socket(), &Lane::Control.ask()))
            .unwrap_or_default();
        facts.push(format!(
            "is --with right? `sgc bench answer` prints the name of its node; here it is {who}"
        ));
        if !self.args.router.is_empty() {
            facts.push("does `sgc bench answer` run there, with the same --router?".to_owned());
        }
        let reason = format!("linked, but {who} does not answer after {} s", HELLO_MAX.as_secs());
        CliError::Bench { reason, facts }
    }

    /// A link straight to a node that is called otherwise than --with has it.
    fn another<'l>(&self, links: &'l [status::Link]) -> Option<&'l status::Link> {
        if !self.args.router.is_empty() {
            return None;
        }
        let identity = sgc_node::load_identity(&self.args.identity).ok()?;
        let wanted = identity.node_id_of(self.args.with.as_str())?.to_string();
        links.iter().find(|link| link.peer != wanted)
    }

    /// Why the other side is heard no more, or a lane does not carry.
    fn silent(&self, lane: Lane, waited: Duration) -> CliError {
        let who = &self.args.with;
        let mut facts = Vec::new();
        match self.side.status() {
            Ok(status) if status.links.iter().any(|link| !link.silent) => {
                facts.extend(why::first_wrong(&self.side.socket(), &lane.ask()).unwrap_or_default());
                facts.push(
                    "the link of this side is up: look at what `sgc bench answer` said there".to_owned(),
                );
            }
            Ok(status) => {
                let last = status.routers.iter().filter_map(|router| router.last_failure.as_deref());
                facts.extend(last.map(output::clean));
                facts.push(
                    "the link broke: `sgc bench answer` or its machine ended there, or the network failed; start both again"
                        .to_owned(),
                );
            }
            Err(error) => facts.push(error.to_string()),
        }
        let reason = format!("{who} is silent on {} for {:.0} s", lane.name(), waited.as_secs_f64());
        CliError::Bench { reason, facts }
    }

    fn has_link(&self) -> bool {
        self.side.status().is_ok_and(|status| status.links.iter().any(|link| !link.silent))
    }

    fn link_rtt(&self) -> Option<u64> {
        self.side.status().ok()?.links.first().map(|link| link.rtt_us)
    }

    fn path(&self) -> Path {
        let (via, urls) = match self.args.router.is_empty() {
            true => ("direct", &self.args.to),
            false => ("router", &self.args.router),
        };
        // The scheme alone: a host is nobody's business.
        let transports =
            urls.iter().map(|url| url.split_once(':').map_or("", |(scheme, _)| scheme).to_owned());
        Path { via, transports: transports.collect(), rtt_us: None }
    }

    // Measuring.

    /// Waits until a lane carries: a grant, and DDS on both sides.
    fn warm_up(&mut self, lane: Lane, max: Duration) -> Result<(), CliError> {
        self.progress(&format!("{}: waiting until it carries", lane.name()));
        let begun = Instant::now();
        self.phase += 1;
        let ping = Frame { phase: self.phase, kind: Kind::Ping, seq: 0, data: vec![0; 16].into() };
        while begun.elapsed() < max {
            if self.ends[&lane].is_heard() {
                self.ends[&lane].send(&ping).map_err(from_dds)?;
            }
            let again = Instant::now() + ASK_AGAIN;
            while let Some(event) = self.next(again)? {
                if self.is_pong(&event, lane).is_some() {
                    return Ok(());
                }
            }
        }
        Err(self.silent(lane, begun.elapsed()))
    }

    /// The number of the pong of this measurement that this is, and when it came.
    fn is_pong(&self, event: &Event, of: Lane) -> Option<(u64, Instant)> {
        match event {
            Event::Frame(lane, frame, at)
                if *lane == of && frame.kind == Kind::Pong && frame.phase == self.phase =>
            {
                Some((frame.seq, *at))
            }
            _ => None,
        }
    }

    /// Waits for a pong; an error if it never comes. What is in the way is looked at when it is late.
    fn pong(&mut self, lane: Lane, size: Size) -> Result<(u64, Instant), CliError> {
        let begun = Instant::now();
        let max = SILENCE_MAX + Duration::from_secs(2 * size.0 as u64 / SLOWEST);
        while begun.elapsed() < max {
            let until = Instant::now() + SILENCE;
            while let Some(event) = self.next(until)? {
                if let Some(pong) = self.is_pong(&event, lane) {
                    return Ok(pong);
                }
            }
            if !self.has_link() {
                break;
            }
        }
        Err(self.silent(lane, begun.elapsed()))
    }

    fn trips(&mut self, lane: Lane, size: Size) -> Result<Trips, CliError> {
        self.progress(&format!("{}, {size}: round trips", lane.name()));
        self.phase += 1;
        let data = bytes::Bytes::from(vec![0x5a; size.0]);
        let (begun, mut took) = (Instant::now(), Vec::new());
        while took.len() < TRIPS_MAX && (took.is_empty() || begun.elapsed() < self.seconds()) {
            let seq = took.len() as u64;
            let ping = Frame { phase: self.phase, kind: Kind::Ping, seq, data: data.clone() };
            let sent = Instant::now();
            self.ends[&lane].send(&ping).map_err(from_dds)?;
            loop {
                let (number, at) = self.pong(lane, size)?;
                if number == seq {
                    took.push(at.saturating_duration_since(sent));
                    break;
                }
            }
        }
        Ok(Trips::of(lane.name(), size, took, 0))
    }

    fn flow(&mut self, lane: Lane, size: Size) -> Result<Flow, CliError> {
        self.progress(&format!("{}, {size}: throughput", lane.name()));
        self.phase += 1;
        let phase = self.phase;
        let before = self.count(lane, phase)?;
        let cpu_before = cpu_us(self.side.process());
        let data = bytes::Bytes::from(vec![0x5a; size.0]);
        let window = (WINDOW_BYTES / size.0 as u64).clamp(WINDOW.0, WINDOW.1);
        let every = window / WINDOW_MARKS;
        let (begun, mut sent, mut known) = (Instant::now(), 0, 0);
        let mut heard = Instant::now();
        while begun.elapsed() < self.seconds() {
            while sent - known < window && begun.elapsed() < self.seconds() {
                let is_marked = sent % every == 0;
                let kind = if is_marked { Kind::Marked } else { Kind::Stream };
                let frame = Frame { phase, kind, seq: sent, data: data.clone() };
                self.ends[&lane].send(&frame).map_err(from_dds)?;
                sent += 1;
                if is_marked {
                    break;
                }
            }
            // All that is there, and if the window is full, the next.
            let is_full = sent - known >= window;
            let until = Instant::now() + if is_full { PROGRESS_MAX } else { Duration::ZERO };
            match self.next(until)? {
                Some(event) => {
                    if let Some((seq, at)) = self.is_pong(&event, lane) {
                        known = known.max(seq + 1);
                        heard = at;
                    }
                }
                None if is_full => {
                    if !self.has_link() {
                        return Err(self.silent(lane, heard.elapsed()));
                    }
                    // Word of the progress may be lost on a path that loses: go on, and let the count say what was.
                    known = sent;
                }
                None => {}
            }
        }
        let sending = begun.elapsed();
        let after = self.drained(lane, phase, sent)?;
        let cpu_here = cpu_before.zip(cpu_us(self.side.process())).map(|(from, to)| to.saturating_sub(from));
        let cpu_there = after.node_cpu_us.saturating_sub(before.node_cpu_us);
        let is_direct = lane == Lane::Direct;
        Ok(Flow::of(lane.name(), size, sent, &after, sending)
            .with_cpu(cpu_here.filter(|_| !is_direct), Some(cpu_there).filter(|_| !is_direct)))
    }

    fn count(&mut self, lane: Lane, phase: u32) -> Result<Counted, CliError> {
        let counted = self.ask(&Ask::Count { phase }, ANSWER_MAX, |tell| match tell {
            Tell::Counted(counted) if counted.phase == phase => Some(counted),
            _ => None,
        })?;
        counted.ok_or_else(|| self.silent(lane, ANSWER_MAX))
    }

    /// What came of a stream once nothing more comes of it.
    fn drained(&mut self, lane: Lane, phase: u32, sent: u64) -> Result<Counted, CliError> {
        let (mut last, mut since) = (Counted::default(), Instant::now());
        loop {
            let counted = self.count(lane, phase)?;
            if counted.received != last.received {
                since = Instant::now();
            }
            if counted.received >= sent || since.elapsed() > DRAIN_MAX {
                return Ok(counted);
            }
            last = counted;
            let until = Instant::now() + COUNT_PERIOD;
            while self.next(until)?.is_some() {}
        }
    }

    fn seconds(&self) -> Duration {
        Duration::from_secs(self.args.seconds.into())
    }

    /// The address of the other machine, as this one reaches it.
    fn peer(&self) -> Result<IpAddr, String> {
        let status = self.side.status().map_err(|error| error.to_string())?;
        let remote = status.links.first().and_then(|link| link.remote.parse::<SocketAddr>().ok());
        remote.map(|remote| remote.ip().to_canonical()).ok_or_else(|| "no link is up".to_owned())
    }

    /// The bare path; the inner error is why there is none.
    fn bare(&mut self, report: &mut Report) -> Result<Result<(), String>, CliError> {
        self.progress("the bare path: TCP and UDP");
        let opened = self.ask(&Ask::Echo, ANSWER_MAX, |tell| match tell {
            Tell::Echo { tcp, udp } => Some(Ok((tcp, udp))),
            Tell::Without { reason } => Some(Err(output::clean(&reason))),
            _ => None,
        })?;
        let (tcp, udp) = match opened {
            None => return Err(self.silent(Lane::Control, ANSWER_MAX)),
            Some(Err(reason)) => return Ok(Err(reason)),
            Some(Ok(ports)) => ports,
        };
        let peer = match self.peer() {
            Ok(peer) => peer,
            Err(reason) => return Ok(Err(reason)),
        };
        let blocked = |what: &str, port: u16, error: &std::io::Error| {
            format!(
                "{what} port {port} there: {error}; if a firewall is in the way, let a port in and name it: \
                 `sgc bench answer --echo-port PORT`"
            )
        };
        if let Err(error) = self.tcp(SocketAddr::new(peer, tcp), report)? {
            return Ok(Err(blocked("TCP", tcp, &error)));
        }
        if let Err(error) = self.udp(SocketAddr::new(peer, udp), report)? {
            return Ok(Err(blocked("UDP", udp, &error)));
        }
        Ok(Ok(()))
    }

    fn tcp(&mut self, at: SocketAddr, report: &mut Report) -> Result<std::io::Result<()>, CliError> {
        let mut connection = match Tcp::for_echo(at, &self.run) {
            Ok(connection) => connection,
            Err(error) => return Ok(Err(error)),
        };
        for size in self.args.sizes.clone() {
            let (begun, mut took) = (Instant::now(), Vec::new());
            let mut message = vec![0x5a; size.0];
            while took.len() < TRIPS_MAX && (took.is_empty() || begun.elapsed() < self.seconds()) {
                match connection.round_trip(&mut message) {
                    Ok(one) => took.push(one),
                    Err(error) => return Ok(Err(error)),
                }
                self.breathe()?;
            }
            report.trips.push(Trips::of("TCP".to_owned(), size, took, 0));
        }
        let duration = self.seconds();
        let streamed = Tcp::for_stream(at, &self.run)
            .and_then(|connection| connection.stream(&[0x5a; TCP_PIECE_BYTES], duration));
        self.breathe()?;
        Ok(streamed.map(|(bytes, took)| report.tcp_mbit_s = Some(super::report::mbit_s(bytes, took))))
    }

    fn udp(&mut self, at: SocketAddr, report: &mut Report) -> Result<std::io::Result<()>, CliError> {
        let mut socket = match Udp::new(at, &self.run) {
            Ok(socket) => socket,
            Err(error) => return Ok(Err(error)),
        };
        for size in self.args.sizes.clone().into_iter().filter(|size| size.0 <= UDP_BYTES_MAX) {
            let (begun, mut took, mut lost) = (Instant::now(), Vec::new(), 0);
            while took.len() < TRIPS_MAX && (took.is_empty() || begun.elapsed() < self.seconds()) {
                match socket.round_trip(size.0) {
                    Ok(Some(one)) => took.push(one),
                    Ok(None) => lost += 1,
                    Err(error) => return Ok(Err(error)),
                }
                self.breathe()?;
                if took.is_empty() && begun.elapsed() > self.seconds() {
                    return Ok(Err(std::io::Error::new(std::io::ErrorKind::TimedOut, "nothing comes back")));
                }
            }
            report.trips.push(Trips::of("UDP".to_owned(), size, took, lost));
        }
        Ok(Ok(()))
    }

    /// Takes what came meanwhile, so that nobody waits for it to be taken.
    fn breathe(&mut self) -> Result<(), CliError> {
        while self.next(Instant::now())?.is_some() {}
        Ok(())
    }

    /// DDS without `sgc`; the inner error is why there is none.
    fn directly(&mut self, report: &mut Report) -> Result<Result<(), String>, CliError> {
        self.progress("DDS without sgc");
        let opened = self.ask(&Ask::Direct, ANSWER_MAX, |tell| match tell {
            Tell::Direct { domain } => Some(Ok(domain)),
            Tell::Without { reason } => Some(Err(output::clean(&reason))),
            _ => None,
        })?;
        let domain = match opened {
            None => return Err(self.silent(Lane::Control, ANSWER_MAX)),
            Some(Err(reason)) => return Ok(Err(reason)),
            Some(Ok(domain)) => domain,
        };
        let joined =
            self.peer().and_then(|peer| side::join_directly(domain, peer).map_err(|error| error.to_string()));
        let network = match joined {
            Ok(network) => network,
            Err(reason) => return Ok(Err(reason)),
        };
        let end = End::asking(&network, Lane::Direct, self.sender.clone()).map_err(from_dds)?;
        self.ends.insert(Lane::Direct, end);
        self.direct = Some(network);
        match self.warm_up(Lane::Direct, DIRECT_MAX) {
            Err(CliError::Bench { reason, .. }) if reason == "interrupted" => return Err(failed(reason)),
            Err(_) => {
                return Ok(Err(format!(
                    "it does not reach in {} s, as usual behind a NAT or a firewall: DDS needs UDP ports from {} on in \
                     both directions",
                    DIRECT_MAX.as_secs(),
                    7400 + 250 * domain
                )));
            }
            Ok(()) => {}
        }
        for size in self.args.sizes.clone() {
            let measured = self.trips(Lane::Direct, size).and_then(|trips| {
                report.trips.push(trips);
                self.flow(Lane::Direct, size)
            });
            match measured {
                Ok(flow) => report.flows.push(flow),
                Err(CliError::Bench { reason, .. }) if reason.starts_with(&self.args.with.to_string()) => {
                    return Ok(Err(format!("{size}: {reason}")));
                }
                Err(error) => return Err(error),
            }
        }
        Ok(Ok(()))
    }

    /// What goes on, for a person who waits.
    fn progress(&self, what: &str) {
        if std::io::IsTerminal::is_terminal(&std::io::stderr()) {
            output::diagnostic(&format!("… {what}"));
        }
    }
}

fn from_dds(error: RosError) -> CliError {
    failed(error.to_string())
}
