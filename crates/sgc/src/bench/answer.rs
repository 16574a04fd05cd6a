//! `sgc bench answer`: the side that waits, sends back, counts, and opens the plain echo for the time of a run.
//!
//! It serves one run at a time and forgets one that is silent. What it opens beside the node is open for the address that
//! is linked, and closed with the run.

use std::collections::BTreeMap;
use std::net::{IpAddr, SocketAddr};
use std::path::PathBuf;
use std::sync::mpsc::{Receiver, SyncSender, sync_channel};
use std::sync::{Arc, Mutex, PoisonError};
use std::time::{Duration, Instant};

use clap::Args;
use sgc_dds::CycloneNetwork;
use sgc_trust::Suite;

use super::echo::Echo;
use super::machine::{Machine, cpu_us};
use super::program::{End, Tally};
use super::side::{self, Meeting, Side, Topics};
use super::words::{Answer, Ask, Frame, Lane, PROTOCOL, Question, RunId, Tell};
use super::{EVENTS_MAX, Event, failed, listen_addr, next_event, router_url, wait_ready};
use crate::demo::domains::{HeldDomain, hold_one};
use crate::error::CliError;
use crate::output;

/// How long a run may be silent; then another may begin.
const RUN_SILENCE_MAX: Duration = Duration::from_secs(30);
/// How often it is looked at.
const LOOK_PERIOD: Duration = Duration::from_secs(1);
/// How far the domain of direct DDS is looked for from that of the node, so that both rarely want the same.
const DIRECT_OFFSET: u32 = 17;

/// Wait for `sgc bench run` on another machine, and answer it, until Ctrl-C
///
/// Any member of the fleet may measure, and nobody else. While one does, a TCP and a UDP port that send back what comes are
/// open to its address, and a DDS participant looks for its machine.
#[derive(Debug, Args)]
pub(crate) struct AnswerArgs {
    /// The identity that `sgc fleet enroll` made, of another node than the measuring one
    #[arg(long, value_name = "FILE")]
    identity: PathBuf,
    /// Where to listen, such as quic://0.0.0.0:7448; several with commas
    #[arg(long, value_name = "URL", value_delimiter = ',', value_parser = listen_addr, required_unless_present = "router")]
    listen: Vec<String>,
    /// A router of yours instead, which the other side names as well; several with commas
    #[arg(long, value_name = "URL", value_delimiter = ',', value_parser = router_url, conflicts_with = "listen")]
    router: Vec<String>,
    /// The TCP and UDP port of the plain echo, if a firewall has to let it in; else the system chooses
    #[arg(long, value_name = "PORT", default_value_t = 0)]
    echo_port: u16,
}

/// Runs `sgc bench answer`.
pub(crate) fn answer(args: &AnswerArgs) -> Result<(), CliError> {
    let name = sgc_node::load_identity(&args.identity)?.node_name().to_string();
    let (sender, events) = sync_channel(EVENTS_MAX);
    side::tell_of_signals(sender.clone())?;
    let is_direct = args.router.is_empty();
    let meeting = match is_direct {
        true => Meeting::Listen(args.listen.clone()),
        false => Meeting::Connect(args.router.clone()),
    };
    let side = Side::start(&args.identity, &meeting, &Topics::Own, &sender)?;
    let urls = wait_ready(&events, &side)?;
    let network = side.join()?;
    let tally = Arc::default();
    let control = End::answering(&network, Lane::Control, Arc::clone(&tally), sender.clone())
        .map_err(|error| failed(error.to_string()))?;
    introduce(&name, is_direct, if is_direct { &urls } else { &args.router })?;
    let echo_port = args.echo_port;
    let mut answering = Answering {
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
    answering.serve(&events)
}

fn introduce(name: &str, is_direct: bool, urls: &[String]) -> Result<(), CliError> {
    let how = if is_direct { "--to" } else { "--router" };
    output::line(format!("{name} waits at {}", urls.join(",")))?;
    output::line("On the other machine, with the identity of another node of the fleet:")?;
    // Who listens everywhere is reached somewhere, which is not known here.
    let reached = urls.iter().map(|url| {
        let anywhere = |url: &str, any: &str| url.replacen(any, "//THIS-MACHINE:", 1);
        anywhere(&anywhere(url, "//0.0.0.0:"), "//[::]:")
    });
    output::line(format!(
        "  sgc bench run --identity FILE --with {name} {how} {}",
        reached.collect::<Vec<_>>().join(",")
    ))?;
    output::line("Ctrl-C ends it.")
}

/// A run that is served.
struct Run {
    id: RunId,
    /// The other side has heard that it may begin.
    has_begun: bool,
    heard: Instant,
    /// Its lanes; held so that they are there.
    lanes: Vec<(Lane, End)>,
    echo: Option<Echo>,
    /// How far the echo was when it was last looked at.
    echo_moved: u64,
    direct: Option<Direct>,
}

impl Run {
    /// Who uses the echo is there, though busy with it.
    fn look_at_echo(&mut self) {
        let moved = self.echo.as_ref().map_or(0, Echo::moved);
        if std::mem::replace(&mut self.echo_moved, moved) != moved {
            self.heard = Instant::now();
        }
    }
}

/// DDS without `sgc`.
struct Direct {
    // Before the network that they are of.
    _end: End,
    _network: CycloneNetwork,
    domain: HeldDomain,
}

struct Answering {
    // In the order in which they are to go: programs before their network, that before the node.
    run: Option<Run>,
    control: End,
    network: CycloneNetwork,
    side: Side,
    tally: Arc<Mutex<Tally>>,
    sender: SyncSender<Event>,
    is_direct: bool,
    echo_port: u16,
    /// Peers refused at the door so far, by kind.
    refused: BTreeMap<String, u64>,
}

impl Answering {
    fn serve(&mut self, events: &Receiver<Event>) -> Result<(), CliError> {
        loop {
            match next_event(events, &self.side, Instant::now() + LOOK_PERIOD) {
                Ok(Some(Event::Frame(Lane::Control, frame, _))) => {
                    if let Some(question) = frame.said() {
                        self.handle(question)?;
                    }
                }
                Ok(None) if self.run.is_none() => self.tell_refused()?,
                Ok(_) => {}
                Err(CliError::Bench { reason, .. }) if reason == "interrupted" => return Ok(()),
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

    /// Who waits for somebody is told of those who came and were not let in.
    fn tell_refused(&mut self) -> Result<(), CliError> {
        let Ok(status) = self.side.status() else { return Ok(()) };
        for (kind, count) in
            status.refused.iter().filter(|(kind, count)| self.refused.get(*kind) != Some(count))
        {
            output::line(output::clean(&format!("a machine was refused: {kind} ({count} times so far)")))?;
        }
        self.refused = status.refused;
        Ok(())
    }

    fn handle(&mut self, question: Question) -> Result<(), CliError> {
        let Question { run: id, ask } = question;
        let is_hello = matches!(ask, Ask::Hello { .. });
        let is_known = self.run.as_ref().is_some_and(|run| run.id == id);
        let tell = match ask {
            Ask::Hello { protocol, version, suites } if !is_known => {
                self.begin(&id, protocol, &version, &suites)
            }
            Ask::Hello { .. } => self.welcome(),
            // Of a run that was forgotten, or never was.
            _ if !is_known => Tell::Refused { reason: "this run is over here; start it again".to_owned() },
            Ask::Echo => self.open_echo(&id),
            Ask::Direct => self.open_direct(),
            Ask::Count { phase } => {
                let mut counted = self.tally.lock().unwrap_or_else(PoisonError::into_inner).of(phase);
                counted.node_cpu_us = cpu_us(self.side.process()).unwrap_or(0);
                Tell::Counted(counted)
            }
            Ask::Bye => {
                self.run = None;
                return output::line("the run is over; ready for another");
            }
        };
        if let Some(run) = self.run.as_mut().filter(|run| run.id == id) {
            run.heard = Instant::now();
            if !is_hello && !std::mem::replace(&mut run.has_begun, true) {
                let lanes: Vec<_> = run.lanes.iter().map(|(lane, _)| lane.name()).collect();
                output::line(format!("a run goes on: {}", lanes.join(", ")))?;
            }
        }
        let answer = Frame::words(&Answer { run: id, tell });
        // The one who asked asks again, or gives up.
        if let Err(error) = self.control.send(&answer) {
            output::diagnostic(&format!("sgc: an answer was not sent: {error}"));
        }
        Ok(())
    }

    fn begin(&mut self, id: &RunId, protocol: u32, version: &str, suites: &[String]) -> Tell {
        let refused = |reason: String| Tell::Refused { reason };
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
        let mut lanes = Vec::new();
        for lane in suites.into_iter().map(Lane::Sealed) {
            if lanes.iter().any(|(other, _)| *other == lane) {
                continue;
            }
            match End::answering(&self.network, lane, Arc::clone(&self.tally), self.sender.clone()) {
                Ok(end) => lanes.push((lane, end)),
                Err(error) => return refused(error.to_string()),
            }
        }
        *self.tally.lock().unwrap_or_else(PoisonError::into_inner) = Tally::default();
        self.run = Some(Run {
            id: id.clone(),
            has_begun: false,
            heard: Instant::now(),
            lanes,
            echo: None,
            echo_moved: 0,
            direct: None,
        });
        self.welcome()
    }

    fn welcome(&self) -> Tell {
        Tell::Welcome { version: env!("CARGO_PKG_VERSION").to_owned(), machine: Machine::here() }
    }

    fn open_echo(&mut self, id: &RunId) -> Tell {
        let peer = match self.peer() {
            Ok(peer) => peer,
            Err(reason) => return Tell::Without { reason },
        };
        let Some(run) = &mut self.run else { return Tell::Without { reason: "no run".to_owned() } };
        let echo = match run.echo.take() {
            Some(echo) => Ok(echo),
            None => Echo::open(peer, id, self.echo_port),
        };
        match echo {
            Ok(echo) => {
                let (tcp, udp) = echo.ports();
                run.echo = Some(echo);
                Tell::Echo { tcp, udp }
            }
            Err(error) => Tell::Without { reason: error.to_string() },
        }
    }

    fn open_direct(&mut self) -> Tell {
        let peer = match self.peer() {
            Ok(peer) => peer,
            Err(reason) => return Tell::Without { reason },
        };
        let Some(run) = &mut self.run else { return Tell::Without { reason: "no run".to_owned() } };
        if let Some(direct) = &run.direct {
            return Tell::Direct { domain: direct.domain.id() };
        }
        let Some(domain) = hold_one(std::process::id().wrapping_add(DIRECT_OFFSET)) else {
            return Tell::Without { reason: "no free ROS domain there".to_owned() };
        };
        let network = match side::join_directly(domain.id(), peer) {
            Ok(network) => network,
            Err(error) => return Tell::Without { reason: error.to_string() },
        };
        match End::answering(&network, Lane::Direct, Arc::clone(&self.tally), self.sender.clone()) {
            Ok(end) => {
                let direct = Direct { _end: end, _network: network, domain };
                let domain = run.direct.insert(direct).domain.id();
                Tell::Direct { domain }
            }
            Err(error) => Tell::Without { reason: error.to_string() },
        }
    }

    /// The address of the one machine that is linked.
    fn peer(&self) -> Result<IpAddr, String> {
        if !self.is_direct {
            return Err("through a router it is not known where the two machines are: measure with --listen and --to \
                        if one reaches the other"
                .to_owned());
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
