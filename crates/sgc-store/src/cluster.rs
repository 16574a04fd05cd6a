//! [`Cluster`]: the machine that carries operations out on the servers of a store.
//!
//! It decides which servers to connect to, which one gets an operation, when to try again and when to give up, and when
//! changes may have gone unreported. It opens no connections and reads no clock; the driver in `driver.rs` does. It knows
//! nothing about the meaning of values.

use std::collections::{BTreeMap, BTreeSet, VecDeque};
use std::time::{Duration, Instant};

use sgc_router::{StoreAction, StoreEvent, StoreFailure, StoreOp, StoreReply};

use crate::command::{Answer, answer, encode_action, message};
use crate::config::{ServerAddress, StoreConfig};
use crate::key::{Keys, slot};
use crate::resp::{Frame, encode};
use crate::topology::Topology;

/// Operations under way at one time.
pub(crate) const OPS_MAX: usize = 1024;
/// Commands without a reply on one link. More than [`OPS_MAX`] operations can be among them, since an operation that is out
/// of time keeps its place.
pub(crate) const LINK_COMMANDS_MAX: usize = 1024;
/// Time after which an operation fails.
pub(crate) const OP_TIMEOUT: Duration = Duration::from_secs(2);
/// Time without an expected reply after which a link is given up.
const SILENCE_MAX: Duration = Duration::from_millis(1500);
/// Time without commands after which a link gets a probe: tracking ends unnoticed with a connection that breaks unnoticed.
const PROBE_AFTER: Duration = Duration::from_secs(2);
/// Time between two questions for the servers of all slots, and the least time while something is wrong.
const TOPOLOGY_EVERY: Duration = Duration::from_secs(5);
const TOPOLOGY_SOON: Duration = Duration::from_millis(250);
/// Pause before an operation is repeated that a server cannot carry out at present.
const REPEAT_AFTER: Duration = Duration::from_millis(100);
/// Pause between two looks for operations that can go on.
const LOOK_EVERY: Duration = Duration::from_millis(20);
/// Redirections and lost links that an operation survives.
const DETOURS_MAX: u8 = 8;
/// Least and longest pause before the next connection to a server that could not be reached.
const RETRY_MIN: Duration = Duration::from_millis(100);
const RETRY_MAX: Duration = Duration::from_secs(2);
/// Age of a link at which its loss is no failure to connect.
const STABLE_AFTER: Duration = Duration::from_secs(2);
/// Least time between two [`StoreEvent::Up`].
const UP_EVERY: Duration = Duration::from_secs(1);
/// Time for which a server is kept that has no slots yet but was named by `ASK`.
const GUEST_TIME: Duration = Duration::from_secs(30);
/// Most such servers.
const GUESTS_MAX: usize = 16;
/// Replicas to which links are opened if no primary can be reached.
const REPLICAS_MAX: usize = 16;
/// Log lines at once, and the time after which there may be one more.
const LOG_LINES_MAX: u32 = 16;
const LOG_EVERY: Duration = Duration::from_secs(2);

/// The number of a link.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub(crate) struct LinkId(u64);

/// News from a link.
#[derive(Debug)]
pub(crate) enum LinkEvent {
    /// The server has accepted the user and tracks keys.
    Ready,
    Frame(Frame),
    /// The link ended, or could not be opened.
    Closed(String),
}

/// A step for the driver.
#[derive(Debug)]
pub(crate) enum Output {
    Event(StoreEvent),
    Open {
        link: LinkId,
        server: ServerAddress,
    },
    Close {
        link: LinkId,
    },
    Send {
        link: LinkId,
        command: Vec<u8>,
    },
    /// A line for the log.
    Warn(String),
    Inform(String),
}

/// The command to which the next reply of a link belongs.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Expected {
    Op(u64),
    /// The reply to `ASKING` or `PING` means nothing.
    Nothing,
    ClusterInfo,
    ClusterSlots,
}

#[derive(Debug)]
struct ReadyLink {
    id: LinkId,
    since: Instant,
    expected: VecDeque<(Expected, Instant)>,
    used_at: Instant,
}

#[derive(Debug)]
enum ServerState {
    Waiting { until: Instant },
    Connecting(LinkId),
    Ready(ReadyLink),
}

#[derive(Debug)]
struct Server {
    state: ServerState,
    /// Connections in turn that failed or did not last.
    failures: u32,
    /// Time since which no connection succeeds.
    failed_since: Option<Instant>,
    /// Time until which the server is kept without slots.
    guest_until: Option<Instant>,
}

impl Server {
    fn ready(&self) -> Option<&ReadyLink> {
        match &self.state {
            ServerState::Ready(link) => Some(link),
            _ => None,
        }
    }
}

/// The place of an operation.
#[derive(Debug)]
enum Place {
    Waiting { until: Instant },
    Sent(LinkId),
}

#[derive(Debug)]
struct PendingOp {
    op: StoreOp,
    key: Vec<u8>,
    slot: u16,
    deadline: Instant,
    detours: u8,
    /// The server to ask next instead of that of the slot.
    ask: Option<ServerAddress>,
    place: Place,
    /// Whether a server may have carried it out without an answer.
    may_be_done: bool,
}

/// Carries operations out on the servers of a store.
pub(crate) struct Cluster {
    keys: Keys,
    seeds: Vec<ServerAddress>,
    servers: BTreeMap<ServerAddress, Server>,
    links: BTreeMap<LinkId, ServerAddress>,
    next_link: u64,
    /// By the order of their beginnings, which is that of their deadlines.
    ops: BTreeMap<u64, PendingOp>,
    next_op: u64,
    waiting: usize,
    topology: Option<Topology>,
    /// The last server that was asked for the topology, the link until it has answered, and the state that it reported.
    topology_from: Option<ServerAddress>,
    topology_asked: Option<LinkId>,
    topology_is_ok: bool,
    topology_due: Instant,
    /// Since when the cluster says that it does not work, or no server says which slots it has.
    unusable_since: Option<Instant>,
    /// Whether changes may have gone unreported since the last [`StoreEvent::Up`].
    is_news: bool,
    up_from: Instant,
    had_failed: bool,
    is_down_told: bool,
    is_up_told: bool,
    log_full_at: Option<Instant>,
    log_left_out: u64,
    random: u64,
    outputs: VecDeque<Output>,
}

impl Cluster {
    /// Begins to connect. `random` spreads the reconnections of many routers.
    pub(crate) fn new(now: Instant, config: &StoreConfig, random: u64) -> Self {
        let mut cluster = Self {
            keys: Keys::new(&config.prefix),
            seeds: config.servers.iter().map(|server| server.address.clone()).collect(),
            servers: BTreeMap::new(),
            links: BTreeMap::new(),
            next_link: 0,
            ops: BTreeMap::new(),
            next_op: 0,
            waiting: 0,
            topology: None,
            topology_from: None,
            topology_asked: None,
            topology_is_ok: true,
            topology_due: now,
            unusable_since: None,
            is_news: false,
            up_from: now,
            had_failed: false,
            is_down_told: false,
            is_up_told: false,
            log_full_at: None,
            log_left_out: 0,
            random: random | 1,
            outputs: VecDeque::new(),
        };
        cluster.settle(now);
        cluster
    }

    /// Returns whether there is room for one more operation.
    pub(crate) fn has_room(&self) -> bool {
        self.ops.len() < OPS_MAX
    }

    /// Returns the next step for the driver.
    pub(crate) fn poll_output(&mut self) -> Option<Output> {
        self.outputs.pop_front()
    }

    /// Begins an operation.
    pub(crate) fn handle_op(&mut self, now: Instant, op: StoreOp) {
        let key = self.keys.encode(&op.key);
        let slot = slot(&key);
        let number = self.next_op;
        self.next_op += 1;
        let place = Place::Waiting { until: now };
        let deadline = now + OP_TIMEOUT;
        let op = PendingOp { op, key, slot, deadline, detours: 0, ask: None, place, may_be_done: false };
        self.ops.insert(number, op);
        self.waiting += 1;
        self.dispatch(now, number);
    }

    /// Takes news from a link. News of links that were closed mean nothing.
    pub(crate) fn handle_link(&mut self, now: Instant, link: LinkId, event: LinkEvent) {
        let Some(address) = self.links.get(&link).cloned() else { return };
        match event {
            LinkEvent::Ready => self.link_ready(now, link, &address),
            LinkEvent::Closed(reason) => self.link_lost(now, link, &address, &reason, false),
            LinkEvent::Frame(Frame::Push(push)) => {
                self.take_push(&push);
                if !self.is_news {
                    return;
                }
            }
            LinkEvent::Frame(frame) => {
                let Some(Server { state: ServerState::Ready(ready), .. }) = self.servers.get_mut(&address)
                else {
                    return;
                };
                match ready.expected.pop_front() {
                    Some((Expected::Op(number), _)) => {
                        return self.op_answered(now, number, link, &frame, &address);
                    }
                    Some((Expected::Nothing, _)) => return,
                    Some((Expected::ClusterInfo, _)) => {
                        self.topology_is_ok = is_state_ok(&frame);
                        return;
                    }
                    Some((Expected::ClusterSlots, _)) => self.take_topology(now, &frame, &address),
                    None => {
                        self.close(link);
                        self.link_lost(now, link, &address, "the server sent a reply to no command", true);
                    }
                }
            }
        }
        self.settle(now);
    }

    /// Acts on everything that is due.
    pub(crate) fn handle_timeout(&mut self, now: Instant) {
        while let Some((&number, op)) = self.ops.first_key_value().filter(|(_, op)| op.deadline <= now) {
            // Its reply may still come, and then finds nothing.
            if matches!(op.place, Place::Waiting { .. }) {
                self.waiting -= 1;
            }
            let id = op.op.id;
            self.ops.remove(&number);
            self.reply(id, Err(StoreFailure::Unreachable));
        }
        let silent: Vec<_> = (self.servers.iter())
            .filter_map(|(address, server)| Some((address.clone(), server.ready()?)))
            .filter(|(_, link)| link.expected.front().is_some_and(|(_, at)| *at + SILENCE_MAX <= now))
            .map(|(address, link)| (address, link.id))
            .collect();
        for (address, link) in silent {
            self.close(link);
            let reason = format!("no answer within {} ms", SILENCE_MAX.as_millis());
            self.link_lost(now, link, &address, &reason, true);
        }
        let idle: Vec<_> = (self.servers.values().filter_map(Server::ready))
            .filter(|link| link.expected.is_empty() && link.used_at + PROBE_AFTER <= now)
            .map(|link| link.id)
            .collect();
        for link in idle {
            self.send(now, link, &[b"PING"], Expected::Nothing);
        }
        self.settle(now);
    }

    /// Returns the time of the next [`Self::handle_timeout`].
    pub(crate) fn next_timeout(&self, now: Instant) -> Instant {
        let servers = self.servers.values().map(|server| match &server.state {
            ServerState::Waiting { until } => *until,
            // The driver bounds the time of an attempt.
            ServerState::Connecting(_) => now + PROBE_AFTER,
            ServerState::Ready(link) => match link.expected.front() {
                Some((_, at)) => *at + SILENCE_MAX,
                None => link.used_at + PROBE_AFTER,
            },
        });
        let topology = match self.topology_asked {
            None if self.servers.values().any(|server| server.ready().is_some()) => Some(self.topology_due),
            _ => None,
        };
        let look = (self.waiting > 0).then_some(now + LOOK_EVERY);
        let overdue = self.ops.first_key_value().map(|(_, op)| op.deadline);
        let up = self.is_news.then_some(self.up_from).filter(|at| *at > now);
        servers.chain(topology).chain(look).chain(overdue).chain(up).min().unwrap_or(now + PROBE_AFTER)
    }

    /// Panics if there are more operations, servers or links than the bounds allow.
    #[cfg(any(test, feature = "fuzzing"))]
    pub(crate) fn assert_bounded(&self) {
        assert!(self.ops.len() <= OPS_MAX, "{} operations", self.ops.len());
        let servers_max = self.seeds.len() + GUESTS_MAX + 2 * crate::topology::NODES_MAX;
        assert!(self.servers.len() <= servers_max, "{} servers", self.servers.len());
        assert!(self.links.len() <= self.servers.len(), "{} links", self.links.len());
        assert!(self.waiting <= self.ops.len(), "{} waiting operations", self.waiting);
    }

    // ---- Operations.

    fn reply(&mut self, id: sgc_router::StoreOpId, result: Result<StoreReply, StoreFailure>) {
        self.outputs.push_back(Output::Event(StoreEvent::Reply { id, result }));
    }

    fn end_op(&mut self, number: u64, result: Result<StoreReply, StoreFailure>) {
        if let Some(op) = self.ops.remove(&number) {
            if matches!(op.place, Place::Waiting { .. }) {
                self.waiting -= 1;
            }
            self.reply(op.op.id, result);
        }
    }

    /// Sends a waiting operation if its server is ready, or gives it up if that has failed for long.
    fn dispatch(&mut self, now: Instant, number: u64) {
        let Some(op) = self.ops.get_mut(&number) else { return };
        if !matches!(op.place, Place::Waiting { until } if until <= now) {
            return;
        }
        let is_asking = op.ask.is_some();
        let target = match (&op.ask, &self.topology) {
            (Some(server), _) => Some(server),
            (None, Some(topology)) => topology.server(op.slot),
            (None, None) => None,
        };
        let server = target.and_then(|target| self.servers.get(target));
        let Some(link) = server.and_then(Server::ready) else {
            let is_lost = |since: Option<Instant>| since.is_some_and(|since| since + OP_TIMEOUT <= now);
            let is_hopeless = match (&self.topology, server) {
                (_, Some(server)) if is_asking && server.failed_since.is_some() => {
                    op.ask = None;
                    return;
                }
                (Some(_), Some(server)) => is_lost(server.failed_since),
                (Some(_), None) => is_lost(self.unusable_since),
                (None, _) => self.unusable_since.is_some() || self.have_all_failed(),
            };
            if is_hopeless {
                self.end_op(number, Err(StoreFailure::Unreachable));
            }
            return;
        };
        if link.expected.len() + 2 > LINK_COMMANDS_MAX {
            return;
        }
        let link = link.id;
        op.ask = None;
        op.place = Place::Sent(link);
        self.waiting -= 1;
        let mut command = Vec::new();
        encode_action(&op.op.action, &op.key, &mut command);
        if is_asking {
            self.send(now, link, &[b"ASKING"], Expected::Nothing);
        }
        self.send_encoded(now, link, command, Expected::Op(number));
    }

    fn dispatch_waiting(&mut self, now: Instant) {
        if self.waiting > 0 {
            let waiting = self.ops.iter().filter(|(_, op)| matches!(op.place, Place::Waiting { .. }));
            let waiting: Vec<u64> = waiting.map(|(number, _)| *number).collect();
            waiting.into_iter().for_each(|number| self.dispatch(now, number));
        }
    }

    /// Lets an operation wait for another attempt, or gives it up after too many.
    fn put_back(&mut self, now: Instant, number: u64, ask: Option<ServerAddress>) {
        let Some(op) = self.ops.get_mut(&number) else { return };
        op.detours += 1;
        if op.detours > DETOURS_MAX {
            return self.end_op(number, Err(StoreFailure::Unreachable));
        }
        op.ask = ask;
        if !matches!(std::mem::replace(&mut op.place, Place::Waiting { until: now }), Place::Waiting { .. }) {
            self.waiting += 1;
        }
    }

    fn op_answered(&mut self, now: Instant, number: u64, link: LinkId, reply: &Frame, from: &ServerAddress) {
        let Some(op) = self.ops.get_mut(&number) else { return };
        if !matches!(op.place, Place::Sent(sent) if sent == link) {
            return;
        }
        match answer(&op.op.action, reply, from) {
            Answer::Done(StoreReply::Written { .. }) if op.may_be_done => {
                // The value may be that of the attempt before, so nothing is known of another.
                self.end_op(number, Ok(StoreReply::Written { existed: false }));
            }
            Answer::Done(done) => self.end_op(number, Ok(done)),
            Answer::Moved { slot, to } => {
                let before = self.topology.as_ref().and_then(|topology| topology.server(slot));
                if slot == op.slot && before != Some(&to) {
                    if let Some(topology) = &mut self.topology {
                        topology.move_slot(slot, to);
                    }
                    // The former server may not have reported changes since.
                    self.is_news = true;
                }
                self.doubt_topology(now);
                self.put_back(now, number, None);
                self.settle(now);
            }
            Answer::Ask { to } => {
                let is_known = self.servers.contains_key(&to);
                let guests = self.servers.values().filter(|server| server.guest_until.is_some()).count();
                if is_known || guests < GUESTS_MAX {
                    let server = self.servers.entry(to.clone()).or_insert_with(|| Server::new(now));
                    server.guest_until = Some(now + GUEST_TIME);
                    self.put_back(now, number, Some(to));
                } else {
                    self.put_back(now, number, None);
                }
                self.settle(now);
            }
            Answer::ReadOnly if self.topology.as_ref().is_some_and(Topology::is_single) => {
                self.warn(now, &format!("the server {from} only reads: it is a replica"));
                self.end_op(number, Err(StoreFailure::Refused));
            }
            Answer::Later | Answer::ReadOnly => {
                op.place = Place::Waiting { until: now + REPEAT_AFTER };
                self.waiting += 1;
                self.doubt_topology(now);
            }
            Answer::Refused(reason) => {
                let verb = match &op.op.action {
                    StoreAction::Read => "read",
                    StoreAction::Write { .. } => "write",
                    StoreAction::Remove { .. } => "remove",
                };
                let line = format!("the server {from} refuses to {verb} the {}: {reason}", op.op.key);
                self.warn(now, &line);
                self.end_op(number, Err(StoreFailure::Refused));
            }
        }
    }

    // ---- Changes of keys.

    fn take_push(&mut self, push: &[Frame]) {
        let [kind, keys] = push else { return };
        if kind.text() != Some(b"invalidate") {
            return;
        }
        match keys {
            Frame::Array(keys) => {
                let keys = keys.iter().filter_map(|key| self.keys.decode(key.text()?));
                self.outputs.extend(keys.map(|key| Output::Event(StoreEvent::Changed(key))));
            }
            // All keys: the server was flushed.
            _ => self.is_news = true,
        }
    }

    // ---- Links.

    fn send(&mut self, now: Instant, link: LinkId, command: &[&[u8]], expected: Expected) {
        let mut bytes = Vec::new();
        encode(command, &mut bytes);
        self.send_encoded(now, link, bytes, expected);
    }

    fn send_encoded(&mut self, now: Instant, link: LinkId, command: Vec<u8>, expected: Expected) {
        let server = self.links.get(&link).and_then(|address| self.servers.get_mut(address));
        if let Some(Server { state: ServerState::Ready(ready), .. }) = server {
            ready.expected.push_back((expected, now));
            ready.used_at = now;
            self.outputs.push_back(Output::Send { link, command });
        }
    }

    fn close(&mut self, link: LinkId) {
        self.outputs.push_back(Output::Close { link });
    }

    fn link_ready(&mut self, now: Instant, link: LinkId, address: &ServerAddress) {
        let Some(server) = self.servers.get_mut(address) else { return };
        server.state =
            ServerState::Ready(ReadyLink { id: link, since: now, expected: VecDeque::new(), used_at: now });
        if server.failed_since.take().is_some() {
            self.inform(now, &format!("the server {address} answers again"));
        }
        // Tracking begins anew with each connection.
        self.is_news = true;
    }

    /// Takes the loss of a link. `is_hung` if the server did not close it.
    fn link_lost(
        &mut self,
        now: Instant,
        link: LinkId,
        address: &ServerAddress,
        reason: &str,
        is_hung: bool,
    ) {
        self.links.remove(&link);
        let Some(server) = self.servers.get_mut(address) else { return };
        let (was_stable, has_failed) = match &server.state {
            ServerState::Ready(ready) => (ready.since + STABLE_AFTER <= now, is_hung),
            _ => (false, true),
        };
        server.failures = if was_stable { 0 } else { server.failures.saturating_add(1) };
        let is_first = has_failed && server.failed_since.is_none();
        if is_first {
            server.failed_since = Some(now);
        }
        let failures = server.failures;
        let pause = self.retry_pause(failures);
        if let Some(server) = self.servers.get_mut(address) {
            server.state = ServerState::Waiting { until: now + pause };
        }
        if is_first {
            self.warn(now, &format!("the server {address} of the store does not answer: {reason}"));
        }
        self.abandon(now, link);
        self.doubt_topology(now);
    }

    /// Lets everything that was sent over a link go another way.
    fn abandon(&mut self, now: Instant, link: LinkId) {
        if self.topology_asked == Some(link) {
            self.topology_asked = None;
        }
        let sent =
            self.ops.iter_mut().filter(|(_, op)| matches!(op.place, Place::Sent(sent) if sent == link));
        let numbers: Vec<u64> = sent
            .map(|(number, op)| {
                op.may_be_done = true;
                *number
            })
            .collect();
        numbers.into_iter().for_each(|number| self.put_back(now, number, None));
    }

    /// Returns the pause before the next connection, between half and all of a time that doubles.
    fn retry_pause(&mut self, failures: u32) -> Duration {
        if failures == 0 {
            return Duration::ZERO;
        }
        // xorshift64: spreads reconnections, no more.
        self.random ^= self.random << 13;
        self.random ^= self.random >> 7;
        self.random ^= self.random << 17;
        let longest = RETRY_MIN.saturating_mul(1 << (failures - 1).min(10)).min(RETRY_MAX);
        longest / 2 + longest.mul_f64((self.random >> 11) as f64 / (1u64 << 54) as f64)
    }

    // ---- The servers.

    fn doubt_topology(&mut self, now: Instant) {
        self.topology_due = self.topology_due.min(now + TOPOLOGY_SOON);
    }

    fn take_topology(&mut self, now: Instant, reply: &Frame, from: &ServerAddress) {
        self.topology_asked = None;
        self.topology_due = now + TOPOLOGY_EVERY;
        let found = match reply {
            Frame::Error(text) if text.starts_with(b"ERR This instance has cluster support disabled") => {
                // Two servers without a cluster know nothing of each other: one is left only if it fails.
                let primaries = self.topology.as_ref().map(Topology::primaries).unwrap_or_default();
                if primaries.iter().any(|primary| primary != from && self.is_ready(primary)) {
                    return;
                }
                Ok(Topology::single(from.clone()))
            }
            Frame::Error(text) => Err(message(text)),
            reply if self.topology_is_ok || self.topology.is_none() => {
                Topology::parse(reply, from).ok_or_else(|| "no slots".into())
            }
            _ => Err("the cluster is down".into()),
        };
        match found {
            Ok(topology) => {
                self.unusable_since = (!self.topology_is_ok).then_some(now);
                let is_same = self.topology.as_ref().is_some_and(|known| known.has_same_slots(&topology));
                self.topology = Some(topology);
                // Keys that moved are tracked no more.
                self.is_news |= !is_same;
            }
            Err(reason) => {
                self.doubt_topology(now);
                if self.unusable_since.is_none() {
                    self.unusable_since = Some(now);
                    self.warn(
                        now,
                        &format!("the server {from} cannot say which servers have the keys: {reason}"),
                    );
                }
            }
        }
    }

    fn is_ready(&self, address: &ServerAddress) -> bool {
        self.servers.get(address).is_some_and(|server| server.ready().is_some())
    }

    fn has_failed(&self, address: &ServerAddress) -> bool {
        self.servers.get(address).is_some_and(|server| server.failed_since.is_some())
    }

    fn have_all_failed(&self) -> bool {
        self.servers.values().all(|server| server.failed_since.is_some())
    }

    /// Returns the servers that there should be links to.
    fn wanted(&self) -> BTreeSet<ServerAddress> {
        let Some(topology) = &self.topology else { return self.seeds.iter().cloned().collect() };
        let mut wanted: BTreeSet<_> = topology.primaries().iter().cloned().collect();
        if !topology.primaries().iter().all(|primary| self.is_ready(primary)) {
            // Others may know which server has the slots now.
            wanted.extend(self.seeds.iter().cloned());
        }
        if !self.servers.values().any(|server| server.ready().is_some()) {
            wanted.extend(topology.replicas().iter().take(REPLICAS_MAX).cloned());
        }
        wanted
    }

    /// Brings links, questions for the topology, waiting operations and news in line with all that is known.
    fn settle(&mut self, now: Instant) {
        let wanted = self.wanted();
        let is_kept = |address: &ServerAddress, server: &Server| {
            wanted.contains(address) || server.guest_until.is_some_and(|until| until > now)
        };
        let left: Vec<_> = (self.servers.iter())
            .filter(|(address, server)| !is_kept(address, server))
            .map(|(address, _)| address.clone())
            .collect();
        for address in left {
            let link = match self.servers.remove(&address).map(|server| server.state) {
                Some(ServerState::Connecting(link)) => link,
                Some(ServerState::Ready(ready)) => ready.id,
                _ => continue,
            };
            self.links.remove(&link);
            self.close(link);
            self.abandon(now, link);
        }
        for address in wanted {
            self.servers.entry(address).or_insert_with(|| Server::new(now));
        }
        for (address, server) in &mut self.servers {
            if matches!(server.state, ServerState::Waiting { until } if until <= now) {
                let link = LinkId(self.next_link);
                self.next_link += 1;
                server.state = ServerState::Connecting(link);
                self.links.insert(link, address.clone());
                self.outputs.push_back(Output::Open { link, server: address.clone() });
            }
        }
        self.ask_topology(now);
        self.dispatch_waiting(now);
        self.announce(now);
    }

    fn ask_topology(&mut self, now: Instant) {
        if self.topology_asked.is_some() || self.topology_due > now {
            return;
        }
        // Each server in turn, so that one that is cut off does not have the last word.
        let mut ready =
            self.servers.iter().filter_map(|(address, server)| Some((address, server.ready()?.id)));
        let behind = |(address, _): &(&ServerAddress, LinkId)| Some(*address) > self.topology_from.as_ref();
        let next = ready.clone().find(behind).or_else(|| ready.next());
        let Some((address, link)) = next.map(|(address, link)| (address.clone(), link)) else { return };
        self.topology_from = Some(address);
        self.topology_asked = Some(link);
        self.send(now, link, &[b"CLUSTER", b"INFO"], Expected::ClusterInfo);
        self.send(now, link, &[b"CLUSTER", b"SLOTS"], Expected::ClusterSlots);
    }

    /// Reports the store's state as far as it has changed.
    fn announce(&mut self, now: Instant) {
        let (is_settled, is_reached, has_failed) = match &self.topology {
            Some(topology) => {
                let primaries = topology.primaries();
                let is_settled = |primary: &ServerAddress| self.is_ready(primary) || self.has_failed(primary);
                (
                    primaries.iter().all(is_settled),
                    primaries.iter().any(|primary| self.is_ready(primary)) && self.unusable_since.is_none(),
                    primaries.iter().any(|primary| self.has_failed(primary)) || self.unusable_since.is_some(),
                )
            }
            None => (false, false, self.unusable_since.is_some() || self.have_all_failed()),
        };
        // The end of a failure is news.
        self.is_news |= self.had_failed && !has_failed;
        self.had_failed = has_failed;
        if self.is_news && is_settled && is_reached && self.up_from <= now {
            self.is_news = false;
            self.up_from = now + UP_EVERY;
            if !has_failed && (self.is_down_told || !self.is_up_told) {
                self.inform(now, "the store answers");
            }
            self.is_down_told = false;
            self.is_up_told = true;
            self.outputs.push_back(Output::Event(StoreEvent::Up));
        }
        if has_failed && !self.is_down_told {
            self.is_down_told = true;
            self.outputs.push_back(Output::Event(StoreEvent::Down));
        }
    }

    // ---- The log.

    fn warn(&mut self, now: Instant, line: &str) {
        if let Some(line) = self.line(now, line) {
            self.outputs.push_back(Output::Warn(line));
        }
    }

    fn inform(&mut self, now: Instant, line: &str) {
        if let Some(line) = self.line(now, line) {
            self.outputs.push_back(Output::Inform(line));
        }
    }

    fn line(&mut self, now: Instant, line: &str) -> Option<String> {
        let full_at = self.log_full_at.unwrap_or(now).max(now) + LOG_EVERY;
        if full_at > now + LOG_EVERY * LOG_LINES_MAX {
            self.log_left_out += 1;
            return None;
        }
        self.log_full_at = Some(full_at);
        Some(match std::mem::take(&mut self.log_left_out) {
            0 => line.to_owned(),
            more => format!("{line} (and {more} more since the last such line)"),
        })
    }
}

impl Server {
    fn new(now: Instant) -> Self {
        Self {
            state: ServerState::Waiting { until: now },
            failures: 0,
            failed_since: None,
            guest_until: None,
        }
    }
}

/// Returns what `CLUSTER INFO` says of the cluster; a server without a cluster is no reason for doubt.
fn is_state_ok(reply: &Frame) -> bool {
    match reply.text() {
        Some(text) => !text.windows(18).any(|part| part == b"cluster_state:fail"),
        None => true,
    }
}

#[cfg(test)]
mod tests {
    use bytes::Bytes;
    use sgc_testkit::{Clock, Dice};

    use super::*;
    use crate::fuzzing::Watched;

    /// Returns a frame as no honest server sends it, or as one may.
    fn frame(dice: &mut Dice, depth: u32) -> Frame {
        const TEXTS: [&[u8]; 9] = [
            b"OK",
            b"",
            b"invalidate",
            b"sgc:n:",
            b"MOVED 7 a:1",
            b"MOVED 99999 :0",
            b"ASK 16383 c:65535",
            b"CLUSTERDOWN",
            b"ERR This instance has cluster support disabled",
        ];
        let text = |dice: &mut Dice| Bytes::from_static(TEXTS[dice.below(TEXTS.len())]);
        let elements = |dice: &mut Dice| (0..dice.below(5)).map(|_| frame(dice, depth + 1)).collect();
        match dice.below(if depth < 4 { 9 } else { 6 }) {
            0 => Frame::Null,
            1 => Frame::TooLong,
            2 => Frame::Integer([0, 1, -1, 16_383, i64::MAX, i64::MIN][dice.below(6)]),
            3 => Frame::Error(text(dice)),
            4 | 5 => Frame::Text(text(dice)),
            6 | 7 => Frame::Array(elements(dice)),
            _ => Frame::Push(elements(dice)),
        }
    }

    /// Whatever servers do, each operation ends in time, with one result, and the machine's memory is bounded.
    #[test]
    fn operations_end_once_and_in_time_whatever_servers_send() {
        for seed in 0..200 {
            let mut dice = Dice::new(seed);
            let mut watched = Watched::new(Clock::default().now().instant, seed);
            for _ in 0..500 {
                match dice.below(10) {
                    0..3 => watched.begin(dice.below(3) as u8, dice.below(256) as u8),
                    3..8 => {
                        let which = dice.below(256);
                        let event = match dice.below(12) {
                            0..4 => LinkEvent::Ready,
                            4 => LinkEvent::Closed("gone".to_owned()),
                            _ => LinkEvent::Frame(frame(&mut dice, 0)),
                        };
                        watched.link(which, event);
                    }
                    _ => watched.wait(Duration::from_millis(dice.below(300) as u64)),
                }
            }
        }
    }
}
