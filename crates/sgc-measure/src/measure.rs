//! `sgc bench run`: the side that measures.
//!
//! It measures one thing after the other, so that none disturbs another: each suite, then the bare path, then DDS
//! without `sgc`. Every wait is bounded, and its error names the cause as far as this side knows it.

use std::collections::HashMap;
use std::net::{IpAddr, SocketAddr};
use std::path::PathBuf;
use std::sync::mpsc::{Receiver, SyncSender, sync_channel};
use std::time::{Duration, Instant};

use rand_core::RngCore as _;
use sgc_dds::CycloneNetwork;
use sgc_diagnosis::status;
use sgc_process::{ProcessError, output};
use sgc_ros::RosError;
use sgc_trust::{NodeName, Suite};

use crate::echo::{Tcp, UDP_BYTES_MAX, Udp};
use crate::error::MeasureError;
use crate::error::failed;
use crate::event::{EVENTS_MAX, Event};
use crate::machine::{Machine, cpu_us};
use crate::program::End;
use crate::report::{Flow, Path, Report, Trips};
use crate::side::{self, Rendezvous, Side, Topics};
use crate::side::{next_event, wait_ready};
use crate::words::{Answer, Ask, Channel, Frame, Kind, PROTOCOL, Question, Reply, RunId, Size, StreamCount};

/// Longest wait for the first answer.
const HELLO_MAX: Duration = Duration::from_secs(30);
/// Consecutive failures of the link after which waiting ends.
const FAILURES_MAX: u32 = 3;
/// Longest wait for other answers.
const ANSWER_MAX: Duration = Duration::from_secs(15);
/// Time after which an unanswered question is repeated.
const ASK_AGAIN: Duration = Duration::from_millis(500);
/// How often the other side gets a sign of life.
const KEEP_PERIOD: Duration = Duration::from_secs(3);
/// Time without a message after which, and from then on how often, the link is checked.
const SILENCE: Duration = Duration::from_secs(3);
/// Longest time without a message, beyond the time that a slow path needs for the message itself.
const SILENCE_MAX: Duration = Duration::from_secs(30);
/// Rate of the slowest supported path, in bytes per second.
const SLOWEST: u64 = 50_000;
/// Most round trips of one size.
const TRIPS_MAX: usize = 1000;
/// Bounds of the window: fewest and most messages of a stream in flight.
const WINDOW: (u64, u64) = (8, 1000);
const WINDOW_BYTES: u64 = 8_000_000;
/// Number of messages per window that the other side answers.
const WINDOW_MARKS: u64 = 8;
/// Longest wait of a stream for an answer before it goes on without one.
const PROGRESS_MAX: Duration = Duration::from_secs(2);
/// Longest wait for missing messages at the end of a stream.
const DRAIN_MAX: Duration = Duration::from_secs(3);
/// How often the count is asked for meanwhile.
const COUNT_PERIOD: Duration = Duration::from_millis(200);
/// Longest time direct DDS may take to find the other side.
const DIRECT_MAX: Duration = Duration::from_secs(8);
/// Bytes per write of the plain TCP stream.
const TCP_PIECE_BYTES: usize = 64 << 10;
/// Most sizes in one run.
const SIZES_MAX: usize = 16;

/// The measurement of one side, and its peer.
#[derive(Clone, Debug)]
pub struct MeasureOptions {
    /// Identity file of a node, other than the answering one's.
    pub identity: PathBuf,
    /// Name of the answering node.
    pub with: NodeName,
    /// URLs at which it listens; none if `router` names one.
    pub connect: Vec<String>,
    /// Routers between the two sides.
    pub router: Vec<String>,
    /// Suites to measure.
    pub suites: Vec<Suite>,
    /// Sizes of messages.
    pub sizes: Vec<Size>,
    /// Duration of each measurement in seconds.
    pub seconds: u32,
    /// File for the figures as JSON.
    pub json_file: Option<PathBuf>,
    /// Whether the figures are printed as JSON instead of as a table.
    pub prints_json: bool,
    /// File for the tables as Markdown.
    pub markdown: Option<PathBuf>,
}

/// Measures, and prints a table and an interpretation.
pub fn measure(args: &MeasureOptions) -> Result<(), MeasureError> {
    let name = sgc_node::load_identity(&args.identity)?.node_name().to_string();
    if name == args.with.to_string() {
        let reason = format!(
            "{name} cannot measure with itself: enrol another node (`sgc fleet enroll`), one identity for each machine"
        );
        return Err(MeasureError::Cannot { reason });
    }
    if args.sizes.len() > SIZES_MAX {
        return Err(MeasureError::Cannot { reason: format!("at most {SIZES_MAX} sizes in one run") });
    }
    let (sender, events) = sync_channel(EVENTS_MAX);
    side::tell_of_signals(sender.clone())?;
    let mut bytes = [0; 16];
    sgc_process::system_rng()?.fill_bytes(&mut bytes);
    let mut measure_side = MeasureSide::start(args, events, sender, RunId::new(bytes))?;
    let report = measure_side.run()?;
    // A failure is ignored: the other side may be gone already.
    let _ = measure_side.say(&Ask::Bye);
    drop(measure_side);
    let text = || {
        serde_json::to_string_pretty(&report)
            .map_err(|e| ProcessError::System { what: "cannot write the figures", source: e.into() })
    };
    let write = |path: &PathBuf, text: String| {
        std::fs::write(path, text).map_err(|source| ProcessError::Write { path: path.clone(), source })
    };
    if args.prints_json {
        output::line(text()?)?;
    } else {
        report.lines().into_iter().try_for_each(output::line)?;
    }
    if let Some(path) = &args.json_file {
        write(path, text()? + "\n")?;
    }
    if let Some(path) = &args.markdown {
        write(path, report.markdown())?;
    }
    Ok(())
}

struct MeasureSide<'a> {
    // Fields in the order of dropping: programs before their network, the network before the node.
    ends: HashMap<Channel, End>,
    direct: Option<CycloneNetwork>,
    network: CycloneNetwork,
    side: Side,
    events: Receiver<Event>,
    sender: SyncSender<Event>,
    run: RunId,
    args: &'a MeasureOptions,
    phase: u32,
    kept: Instant,
}

impl<'a> MeasureSide<'a> {
    fn start(
        args: &'a MeasureOptions,
        events: Receiver<Event>,
        sender: SyncSender<Event>,
        run: RunId,
    ) -> Result<Self, MeasureError> {
        let urls = if args.router.is_empty() { &args.connect } else { &args.router };
        let topics = Topics::Of(args.with.to_string(), args.suites.clone());
        let side = Side::start(&args.identity, &Rendezvous::Connect(urls.clone()), &topics, &sender)?;
        wait_ready(&events, &side)?;
        let network = side.join()?;
        let mut measure_side = Self {
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
        for channel in measure_side.channels().into_iter().chain([Channel::Control]) {
            let end =
                End::asking(&measure_side.network, channel, measure_side.sender.clone()).map_err(from_dds)?;
            measure_side.ends.insert(channel, end);
        }
        Ok(measure_side)
    }

    fn channels(&self) -> Vec<Channel> {
        let mut channels = Vec::new();
        for suite in &self.args.suites {
            if !channels.contains(&Channel::Sealed(*suite)) {
                channels.push(Channel::Sealed(*suite));
            }
        }
        channels
    }

    fn run(&mut self) -> Result<Report, MeasureError> {
        let (version, there) = self.hello()?;
        let mut report = Report::new(self.path(), Machine::here(), there, version);
        for channel in self.channels() {
            self.warm_up(channel, HELLO_MAX)?;
            for size in self.args.sizes.clone() {
                report.trips.push(self.trips(channel, size)?);
                report.flows.push(self.flow(channel, size)?);
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

    // Questions and answers.

    fn say(&mut self, ask: &Ask) -> Result<(), MeasureError> {
        self.kept = Instant::now();
        let question = Frame::words(&Question { run: self.run.clone(), ask: ask.clone() });
        self.ends[&Channel::Control].send(&question).map_err(from_dds)
    }

    /// Returns the next event until then. Gives the other side signs of life meanwhile.
    fn next(&mut self, until: Instant) -> Result<Option<Event>, MeasureError> {
        if self.kept.elapsed() > KEEP_PERIOD {
            self.say(&Ask::Count { phase: 0 })?;
        }
        next_event(&self.events, &self.side, until)
    }

    /// Repeats a question until a fitting answer comes. Returns `None` if none comes in time.
    fn ask<T>(
        &mut self,
        ask: &Ask,
        max: Duration,
        fits: impl Fn(Reply) -> Option<T>,
    ) -> Result<Option<T>, MeasureError> {
        let deadline = Instant::now() + max;
        while Instant::now() < deadline {
            self.say(ask)?;
            let again = deadline.min(Instant::now() + ASK_AGAIN);
            while let Some(event) = self.next(again)? {
                let Event::Frame(Channel::Control, frame, _) = event else { continue };
                let Some(Answer { run, tell }) = frame.said() else { continue };
                if run != self.run {
                    continue;
                }
                if let Reply::Refused { reason } = &tell {
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

    fn hello(&mut self) -> Result<(String, Machine), MeasureError> {
        let suites = self.args.suites.iter().map(|suite| suite.name().to_owned()).collect();
        let hello = Ask::Hello { protocol: PROTOCOL, version: env!("CARGO_PKG_VERSION").to_owned(), suites };
        let deadline = Instant::now() + HELLO_MAX;
        while Instant::now() < deadline {
            // Shorter than HELLO_MAX, so that repeated refusals of the link are noticed.
            let answer = self.ask(&hello, Duration::from_secs(1), |tell| match tell {
                Reply::Welcome { version, machine } => Some((version, machine)),
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

    /// Explains why the other side never answered.
    fn unreached(&self) -> MeasureError {
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
            return MeasureError::Failed { reason: format!("no link to {who}"), facts };
        }
        if let Some(link) = self.another(&status.links) {
            let reason = format!("the node at {} is not {who}", output::clean(&link.remote));
            let fact =
                "`sgc bench answer` prints the name of its node there: that belongs behind --with".to_owned();
            return MeasureError::Failed { reason, facts: vec![fact] };
        }
        let mut facts = sgc_diagnosis::first_wrong(&self.side.socket(), &Channel::Control.answer())
            .or_else(|| sgc_diagnosis::first_wrong(&self.side.socket(), &Channel::Control.ask()))
            .unwrap_or_default();
        facts.push(format!(
            "is --with right? `sgc bench answer` prints the name of its node; here it is {who}"
        ));
        if !self.args.router.is_empty() {
            facts.push("does `sgc bench answer` run there, with the same --router?".to_owned());
        }
        let reason = format!("linked, but {who} does not answer after {} s", HELLO_MAX.as_secs());
        MeasureError::Failed { reason, facts }
    }

    /// Returns a direct link to a node whose name differs from --with.
    fn another<'l>(&self, links: &'l [status::Link]) -> Option<&'l status::Link> {
        if !self.args.router.is_empty() {
            return None;
        }
        let identity = sgc_node::load_identity(&self.args.identity).ok()?;
        let wanted = identity.node_id_of(self.args.with.as_str())?.to_string();
        links.iter().find(|link| link.peer != wanted)
    }

    /// Explains why the other side fell silent, or why a channel carries nothing.
    fn silent(&self, channel: Channel, waited: Duration) -> MeasureError {
        let who = &self.args.with;
        let mut facts = Vec::new();
        match self.side.status() {
            Ok(status) if status.links.iter().any(|link| !link.silent) => {
                facts.extend(
                    sgc_diagnosis::first_wrong(&self.side.socket(), &channel.ask()).unwrap_or_default(),
                );
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
        let reason = format!("{who} is silent on {} for {:.0} s", channel.name(), waited.as_secs_f64());
        MeasureError::Failed { reason, facts }
    }

    fn has_link(&self) -> bool {
        self.side.status().is_ok_and(|status| status.links.iter().any(|link| !link.silent))
    }

    fn link_rtt(&self) -> Option<u64> {
        self.side.status().ok()?.links.first().map(|link| link.rtt_us)
    }

    fn path(&self) -> Path {
        let (via, urls) = match self.args.router.is_empty() {
            true => ("direct", &self.args.connect),
            false => ("router", &self.args.router),
        };
        // Only the scheme, because a report must not reveal hosts.
        let transports =
            urls.iter().map(|url| url.split_once(':').map_or("", |(scheme, _)| scheme).to_owned());
        Path { via, transports: transports.collect(), rtt_us: None }
    }

    // Measurements.

    /// Waits until a channel carries messages: it needs a grant, and DDS discovery on both sides.
    fn warm_up(&mut self, channel: Channel, max: Duration) -> Result<(), MeasureError> {
        self.progress(&format!("{}: waiting until it carries", channel.name()));
        let begun = Instant::now();
        self.phase += 1;
        let ping = Frame { phase: self.phase, kind: Kind::Ping, seq: 0, data: vec![0; 16].into() };
        while begun.elapsed() < max {
            if self.ends[&channel].is_heard() {
                self.ends[&channel].send(&ping).map_err(from_dds)?;
            }
            let again = Instant::now() + ASK_AGAIN;
            while let Some(event) = self.next(again)? {
                if self.is_pong(&event, channel).is_some() {
                    return Ok(());
                }
            }
        }
        Err(self.silent(channel, begun.elapsed()))
    }

    /// Returns the number and time of a pong, if the event is one of this measurement.
    fn is_pong(&self, event: &Event, of: Channel) -> Option<(u64, Instant)> {
        match event {
            Event::Frame(channel, frame, at)
                if *channel == of && frame.kind == Kind::Pong && frame.phase == self.phase =>
            {
                Some((frame.seq, *at))
            }
            _ => None,
        }
    }

    /// Waits for a pong and fails if none comes. Checks the link when the pong is late.
    fn pong(&mut self, channel: Channel, size: Size) -> Result<(u64, Instant), MeasureError> {
        let begun = Instant::now();
        let max = SILENCE_MAX + Duration::from_secs(2 * size.0 as u64 / SLOWEST);
        while begun.elapsed() < max {
            let until = Instant::now() + SILENCE;
            while let Some(event) = self.next(until)? {
                if let Some(pong) = self.is_pong(&event, channel) {
                    return Ok(pong);
                }
            }
            if !self.has_link() {
                break;
            }
        }
        Err(self.silent(channel, begun.elapsed()))
    }

    fn trips(&mut self, channel: Channel, size: Size) -> Result<Trips, MeasureError> {
        self.progress(&format!("{}, {size}: round trips", channel.name()));
        self.phase += 1;
        let data = bytes::Bytes::from(vec![0x5a; size.0]);
        let (begun, mut took) = (Instant::now(), Vec::new());
        while took.len() < TRIPS_MAX && (took.is_empty() || begun.elapsed() < self.seconds()) {
            let seq = took.len() as u64;
            let ping = Frame { phase: self.phase, kind: Kind::Ping, seq, data: data.clone() };
            let sent = Instant::now();
            self.ends[&channel].send(&ping).map_err(from_dds)?;
            loop {
                let (number, at) = self.pong(channel, size)?;
                if number == seq {
                    took.push(at.saturating_duration_since(sent));
                    break;
                }
            }
        }
        Ok(Trips::from_times(channel.name(), size, took, 0))
    }

    fn flow(&mut self, channel: Channel, size: Size) -> Result<Flow, MeasureError> {
        self.progress(&format!("{}, {size}: throughput", channel.name()));
        self.phase += 1;
        let phase = self.phase;
        let before = self.count(channel, phase)?;
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
                self.ends[&channel].send(&frame).map_err(from_dds)?;
                sent += 1;
                if is_marked {
                    break;
                }
            }
            // Takes the events that are there. If the window is full, waits for the next.
            let is_full = sent - known >= window;
            let until = Instant::now() + if is_full { PROGRESS_MAX } else { Duration::ZERO };
            match self.next(until)? {
                Some(event) => {
                    if let Some((seq, at)) = self.is_pong(&event, channel) {
                        known = known.max(seq + 1);
                        heard = at;
                    }
                }
                None if is_full => {
                    if !self.has_link() {
                        return Err(self.silent(channel, heard.elapsed()));
                    }
                    // Answers may be lost on a lossy path: go on, and let the final count decide.
                    known = sent;
                }
                None => {}
            }
        }
        let sending = begun.elapsed();
        let after = self.drained(channel, phase, sent)?;
        let cpu_here = cpu_before.zip(cpu_us(self.side.process())).map(|(from, to)| to.saturating_sub(from));
        let cpu_there = after.node_cpu_us.saturating_sub(before.node_cpu_us);
        let is_direct = channel == Channel::Direct;
        Ok(Flow::from_count(channel.name(), size, sent, &after, sending)
            .with_cpu(cpu_here.filter(|_| !is_direct), Some(cpu_there).filter(|_| !is_direct)))
    }

    fn count(&mut self, channel: Channel, phase: u32) -> Result<StreamCount, MeasureError> {
        let counted = self.ask(&Ask::Count { phase }, ANSWER_MAX, |tell| match tell {
            Reply::Counted(counted) if counted.phase == phase => Some(counted),
            _ => None,
        })?;
        counted.ok_or_else(|| self.silent(channel, ANSWER_MAX))
    }

    /// Returns the count of a stream once no more messages arrive.
    fn drained(&mut self, channel: Channel, phase: u32, sent: u64) -> Result<StreamCount, MeasureError> {
        let (mut last, mut since) = (StreamCount::default(), Instant::now());
        loop {
            let counted = self.count(channel, phase)?;
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

    /// Returns the address at which this machine reaches the other.
    fn peer(&self) -> Result<IpAddr, String> {
        let status = self.side.status().map_err(|error| error.to_string())?;
        let remote = status.links.first().and_then(|link| link.remote.parse::<SocketAddr>().ok());
        remote.map(|remote| remote.ip().to_canonical()).ok_or_else(|| "no link is up".to_owned())
    }

    /// Measures the bare path. The inner error says why there is none.
    fn bare(&mut self, report: &mut Report) -> Result<Result<(), String>, MeasureError> {
        self.progress("the bare path: TCP and UDP");
        let opened = self.ask(&Ask::Echo, ANSWER_MAX, |tell| match tell {
            Reply::Echo { tcp, udp } => Some(Ok((tcp, udp))),
            Reply::Without { reason } => Some(Err(output::clean(&reason))),
            _ => None,
        })?;
        let (tcp, udp) = match opened {
            None => return Err(self.silent(Channel::Control, ANSWER_MAX)),
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

    fn tcp(&mut self, at: SocketAddr, report: &mut Report) -> Result<std::io::Result<()>, MeasureError> {
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
            report.trips.push(Trips::from_times("TCP".to_owned(), size, took, 0));
        }
        let duration = self.seconds();
        let streamed = Tcp::for_stream(at, &self.run)
            .and_then(|connection| connection.stream(&[0x5a; TCP_PIECE_BYTES], duration));
        self.breathe()?;
        Ok(streamed.map(|(bytes, took)| report.tcp_mbit_s = Some(crate::report::mbit_s(bytes, took))))
    }

    fn udp(&mut self, at: SocketAddr, report: &mut Report) -> Result<std::io::Result<()>, MeasureError> {
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
            report.trips.push(Trips::from_times("UDP".to_owned(), size, took, lost));
        }
        Ok(Ok(()))
    }

    /// Empties the event queue, so that no sender blocks on it.
    fn breathe(&mut self) -> Result<(), MeasureError> {
        while self.next(Instant::now())?.is_some() {}
        Ok(())
    }

    /// Measures DDS without `sgc`. The inner error says why there is none.
    fn directly(&mut self, report: &mut Report) -> Result<Result<(), String>, MeasureError> {
        self.progress("DDS without sgc");
        let opened = self.ask(&Ask::Direct, ANSWER_MAX, |tell| match tell {
            Reply::Direct { domain } => Some(Ok(domain)),
            Reply::Without { reason } => Some(Err(output::clean(&reason))),
            _ => None,
        })?;
        let domain = match opened {
            None => return Err(self.silent(Channel::Control, ANSWER_MAX)),
            Some(Err(reason)) => return Ok(Err(reason)),
            Some(Ok(domain)) => domain,
        };
        let joined =
            self.peer().and_then(|peer| side::join_directly(domain, peer).map_err(|error| error.to_string()));
        let network = match joined {
            Ok(network) => network,
            Err(reason) => return Ok(Err(reason)),
        };
        let end = End::asking(&network, Channel::Direct, self.sender.clone()).map_err(from_dds)?;
        self.ends.insert(Channel::Direct, end);
        self.direct = Some(network);
        match self.warm_up(Channel::Direct, DIRECT_MAX) {
            Err(MeasureError::Failed { reason, .. }) if reason == "interrupted" => {
                return Err(failed(reason));
            }
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
            let measured = self.trips(Channel::Direct, size).and_then(|trips| {
                report.trips.push(trips);
                self.flow(Channel::Direct, size)
            });
            match measured {
                Ok(flow) => report.flows.push(flow),
                Err(MeasureError::Failed { reason, .. })
                    if reason.starts_with(&self.args.with.to_string()) =>
                {
                    return Ok(Err(format!("{size}: {reason}")));
                }
                Err(error) => return Err(error),
            }
        }
        Ok(Ok(()))
    }

    /// Shows the current step to a waiting user.
    fn progress(&self, what: &str) {
        if std::io::IsTerminal::is_terminal(&std::io::stderr()) {
            output::diagnostic(&format!("… {what}"));
        }
    }
}

fn from_dds(error: RosError) -> MeasureError {
    failed(error.to_string())
}
