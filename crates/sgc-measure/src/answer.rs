//! `sgc bench answer`: the side that waits, echoes, counts, and opens the plain echo for the time of a run.
//!
//! It serves one run at a time and drops a silent one. The plain echo is open only to the address of the linked peer,
//! and is closed with the run.

use std::collections::BTreeMap;
use std::net::{IpAddr, SocketAddr};
use std::path::PathBuf;
use std::sync::mpsc::{Receiver, SyncSender, sync_channel};
use std::sync::{Arc, Mutex};
use std::time::{Duration, Instant};

use sgc_dds::CycloneNetwork;
use sgc_process::domains::{DomainLock, lock_one};
use sgc_process::output;
use sgc_sync::lock;
use sgc_trust::Suite;

use crate::echo::Echo;
use crate::error::MeasureError;
use crate::error::failed;
use crate::event::{EVENTS_MAX, Event};
use crate::machine::{Machine, cpu_us};
use crate::program::{End, Tally};
use crate::side::{self, Rendezvous, Side, Topics};
use crate::side::{next_event, wait_ready};
use crate::words::{Answer, Ask, Channel, Frame, PROTOCOL, Question, Reply, RunId};

/// Longest silence of a run. After it another run may begin.
const RUN_SILENCE_MAX: Duration = Duration::from_secs(30);
/// How often the silence is checked.
const LOOK_PERIOD: Duration = Duration::from_secs(1);
/// Distance between the node's domain and the first candidate for direct DDS, so that both rarely want the same domain.
const DIRECT_OFFSET: u32 = 17;

/// How a side answers.
#[derive(Clone, Debug)]
pub struct AnswerOptions {
    /// Identity file of a node, other than the measuring one's.
    pub identity: PathBuf,
    /// Addresses to listen on; none if `router` names one.
    pub listen: Vec<String>,
    /// Routers between the two sides.
    pub router: Vec<String>,
    /// TCP and UDP port of the plain echo; 0 lets the system choose.
    pub echo_port: u16,
}

/// Answers measurements until the user interrupts.
pub fn answer(args: &AnswerOptions) -> Result<(), MeasureError> {
    let name = sgc_node::load_identity(&args.identity)?.node_name().to_string();
    let (sender, events) = sync_channel(EVENTS_MAX);
    side::tell_of_signals(sender.clone())?;
    let is_direct = args.router.is_empty();
    let meeting = match is_direct {
        true => Rendezvous::Listen(args.listen.clone()),
        false => Rendezvous::Connect(args.router.clone()),
    };
    let side = Side::start(&args.identity, &meeting, &Topics::Own, &sender)?;
    let urls = wait_ready(&events, &side)?;
    let network = side.join()?;
    let tally = Arc::default();
    let control = End::answering(&network, Channel::Control, Arc::clone(&tally), sender.clone())
        .map_err(|error| failed(error.to_string()))?;
    introduce(&name, is_direct, if is_direct { &urls } else { &args.router })?;
    let echo_port = args.echo_port;
    let mut answer_side = AnswerSide {
        side,
        network,
        control,
        tally,
        sender,
        is_direct,
        echo_port,
        run: None,
        refused: BTreeMap::new(),
    };
    answer_side.serve(&events)
}

fn introduce(name: &str, is_direct: bool, urls: &[String]) -> Result<(), MeasureError> {
    let how = if is_direct { "--connect" } else { "--router" };
    output::line(format!("{name} waits at {}", urls.join(",")))?;
    output::line("On the other machine, with the identity of another node of the fleet:")?;
    // A node that listens on all addresses does not know the one at which it is reached.
    let reached = urls.iter().map(|url| {
        let anywhere = |url: &str, any: &str| url.replacen(any, "//THIS-MACHINE:", 1);
        anywhere(&anywhere(url, "//0.0.0.0:"), "//[::]:")
    });
    output::line(format!(
        "  sgc bench run --identity FILE --with {name} {how} {}",
        reached.collect::<Vec<_>>().join(",")
    ))?;
    Ok(output::line("Ctrl-C ends it.")?)
}

/// The run that is being served.
struct Run {
    id: RunId,
    /// The other side knows that it may begin.
    has_begun: bool,
    heard: Instant,
    /// The channels of the run. They exist as long as they are held here.
    channels: Vec<(Channel, End)>,
    echo: Option<Echo>,
    /// The bytes that the echo had moved at the last check.
    echo_moved: u64,
    direct: Option<Direct>,
}

impl Run {
    /// Takes traffic on the echo for a sign of life: a peer that uses the echo asks nothing meanwhile.
    fn look_at_echo(&mut self) {
        let moved = self.echo.as_ref().map_or(0, Echo::moved);
        if std::mem::replace(&mut self.echo_moved, moved) != moved {
            self.heard = Instant::now();
        }
    }
}

/// DDS without `sgc`.
struct Direct {
    // Dropped before its network.
    _end: End,
    _network: CycloneNetwork,
    domain: DomainLock,
}

struct AnswerSide {
    // Fields in the order of dropping: programs before their network, the network before the node.
    run: Option<Run>,
    control: End,
    network: CycloneNetwork,
    side: Side,
    tally: Arc<Mutex<Tally>>,
    sender: SyncSender<Event>,
    is_direct: bool,
    echo_port: u16,
    /// The number of peers refused at admission so far, by kind.
    refused: BTreeMap<String, u64>,
}

impl AnswerSide {
    fn serve(&mut self, events: &Receiver<Event>) -> Result<(), MeasureError> {
        loop {
            match next_event(events, &self.side, Instant::now() + LOOK_PERIOD) {
                Ok(Some(Event::Frame(Channel::Control, frame, _))) => {
                    if let Some(question) = frame.said() {
                        self.handle(question)?;
                    }
                }
                Ok(None) if self.run.is_none() => self.tell_refused()?,
                Ok(_) => {}
                Err(MeasureError::Failed { reason, .. }) if reason == "interrupted" => return Ok(()),
                Err(error) => return Err(error),
            }
            if let Some(run) = &mut self.run {
                run.look_at_echo();
            }
            if self.run.as_ref().is_some_and(|run| run.heard.elapsed() > RUN_SILENCE_MAX) {
                self.run = None;
                output::line("the other side is silent; ready for another run")?;
            }
        }
    }

    /// Tells the waiting user about peers that were refused.
    fn tell_refused(&mut self) -> Result<(), MeasureError> {
        let Ok(status) = self.side.status() else { return Ok(()) };
        for (kind, count) in
            status.refused.iter().filter(|(kind, count)| self.refused.get(*kind) != Some(count))
        {
            output::line(output::clean(&format!("a machine was refused: {kind} ({count} times so far)")))?;
        }
        self.refused = status.refused;
        Ok(())
    }

    fn handle(&mut self, question: Question) -> Result<(), MeasureError> {
        let Question { run: id, ask } = question;
        let is_hello = matches!(ask, Ask::Hello { .. });
        let is_known = self.run.as_ref().is_some_and(|run| run.id == id);
        let tell = match ask {
            Ask::Hello { protocol, version, suites } if !is_known => {
                self.begin(&id, protocol, &version, &suites)
            }
            Ask::Hello { .. } => self.welcome(),
            // The run is over or never existed.
            _ if !is_known => Reply::Refused { reason: "this run is over here; start it again".to_owned() },
            Ask::Echo => self.open_echo(&id),
            Ask::Direct => self.open_direct(),
            Ask::Count { phase } => {
                let mut counted = lock(&self.tally).stream_count(phase);
                counted.node_cpu_us = cpu_us(self.side.process()).unwrap_or(0);
                Reply::Counted(counted)
            }
            Ask::Bye => {
                self.run = None;
                return Ok(output::line("the run is over; ready for another")?);
            }
        };
        if let Some(run) = self.run.as_mut().filter(|run| run.id == id) {
            run.heard = Instant::now();
            if !is_hello && !std::mem::replace(&mut run.has_begun, true) {
                let channels: Vec<_> = run.channels.iter().map(|(channel, _)| channel.name()).collect();
                output::line(format!("a run goes on: {}", channels.join(", ")))?;
            }
        }
        let answer = Frame::words(&Answer { run: id, tell });
        // The other side asks again or gives up.
        if let Err(error) = self.control.send(&answer) {
            output::diagnostic(&format!("sgc: an answer was not sent: {error}"));
        }
        Ok(())
    }

    fn begin(&mut self, id: &RunId, protocol: u32, version: &str, suites: &[String]) -> Reply {
        let refused = |reason: String| Reply::Refused { reason };
        if protocol != PROTOCOL {
            return refused(format!(
                "`sgc bench` of version {} here does not understand that of version {}: use the same on both machines",
                env!("CARGO_PKG_VERSION"),
                output::clean(&version.chars().take(40).collect::<String>())
            ));
        }
        if self.run.is_some() {
            return refused(
                "another run is being answered; try again when it is over, or in half a minute if it broke off"
                    .to_owned(),
            );
        }
        let suites: Result<Vec<Suite>, _> = suites.iter().take(Suite::ALL.len()).map(|s| s.parse()).collect();
        let Ok(suites) = suites else {
            return refused(
                "a suite is asked for that this version does not have: use the same on both machines"
                    .to_owned(),
            );
        };
        let mut channels = Vec::new();
        for channel in suites.into_iter().map(Channel::Sealed) {
            if channels.iter().any(|(other, _)| *other == channel) {
                continue;
            }
            match End::answering(&self.network, channel, Arc::clone(&self.tally), self.sender.clone()) {
                Ok(end) => channels.push((channel, end)),
                Err(error) => return refused(error.to_string()),
            }
        }
        *lock(&self.tally) = Tally::default();
        self.run = Some(Run {
            id: id.clone(),
            has_begun: false,
            heard: Instant::now(),
            channels,
            echo: None,
            echo_moved: 0,
            direct: None,
        });
        self.welcome()
    }

    fn welcome(&self) -> Reply {
        Reply::Welcome { version: env!("CARGO_PKG_VERSION").to_owned(), machine: Machine::here() }
    }

    fn open_echo(&mut self, id: &RunId) -> Reply {
        let peer = match self.peer() {
            Ok(peer) => peer,
            Err(reason) => return Reply::Without { reason },
        };
        let Some(run) = &mut self.run else { return Reply::Without { reason: "no run".to_owned() } };
        let echo = match run.echo.take() {
            Some(echo) => Ok(echo),
            None => Echo::open(peer, id, self.echo_port),
        };
        match echo {
            Ok(echo) => {
                let (tcp, udp) = echo.ports();
                run.echo = Some(echo);
                Reply::Echo { tcp, udp }
            }
            Err(error) => Reply::Without { reason: error.to_string() },
        }
    }

    fn open_direct(&mut self) -> Reply {
        let peer = match self.peer() {
            Ok(peer) => peer,
            Err(reason) => return Reply::Without { reason },
        };
        let Some(run) = &mut self.run else { return Reply::Without { reason: "no run".to_owned() } };
        if let Some(direct) = &run.direct {
            return Reply::Direct { domain: direct.domain.id() };
        }
        let Some(domain) = lock_one(std::process::id().wrapping_add(DIRECT_OFFSET)) else {
            return Reply::Without { reason: "no free ROS domain there".to_owned() };
        };
        let network = match side::join_directly(domain.id(), peer) {
            Ok(network) => network,
            Err(error) => return Reply::Without { reason: error.to_string() },
        };
        match End::answering(&network, Channel::Direct, Arc::clone(&self.tally), self.sender.clone()) {
            Ok(end) => {
                let direct = Direct { _end: end, _network: network, domain };
                let domain = run.direct.insert(direct).domain.id();
                Reply::Direct { domain }
            }
            Err(error) => Reply::Without { reason: error.to_string() },
        }
    }

    /// Returns the address of the only linked machine.
    fn peer(&self) -> Result<IpAddr, String> {
        if !self.is_direct {
            return Err(
                "through a router it is not known where the two machines are: measure with --listen and \
                        --connect if one reaches the other"
                    .to_owned(),
            );
        }
        let status = self.side.status().map_err(|error| error.to_string())?;
        let mut peers: Vec<_> = status
            .links
            .iter()
            .filter_map(|link| Some(link.remote.parse::<SocketAddr>().ok()?.ip().to_canonical()))
            .collect();
        peers.sort_unstable();
        peers.dedup();
        match peers[..] {
            [peer] => Ok(peer),
            [] => Err("no machine is linked directly".to_owned()),
            _ => Err("several machines are linked, so it is not known which one asks".to_owned()),
        }
    }
}
