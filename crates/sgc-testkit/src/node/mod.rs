//! One node: a router and an endpoint, wired as the driver wires them, with the data path between.
//!
//! The node owns no time and no network: the world passes in arrivals and carries out its [`Effect`]s.

mod direct;
mod direct_links;
mod publisher;
mod publishing;

use std::collections::{BTreeMap, BTreeSet, VecDeque};
use std::net::SocketAddr;
use std::sync::Arc;
use std::time::{Duration, Instant};

use bytes::Bytes;
use rand_chacha::ChaCha20Rng;
use rand_core::SeedableRng;
use sgc_endpoint::{
    AskAgain, Delivery, Endpoint, EndpointConfig, Event, JoinKind, JoinStatus, Marks, Message,
    RecoveryLimits, RefusedBy, ShareSpec, Sink, SinkDrop, SinkLimits, Source, SourceConfig,
};
use sgc_router::{
    DirectReach, FibEntry, LinkClose, LinkId, LinkQuality, MappingKind, Neighbour, Router, RouterConfig,
    StoreEvent, StoreOp,
};
use sgc_trust::{Grantees, Identity, MessageKey, Policy, Suite, TrustAnchors, name_of};
use sgc_wire::{
    Catalogue, CatalogueSource, Class, Control, Durability, History, MessageHead, MessageKind, Metadata,
    Name, NodeId, Now, Packet, Qos, RefuseReason, Reliability, SourceId,
};

use direct::DirectNode;

use publisher::Publisher;

use crate::cast::{Member, identity};
use crate::ids::{MessageId, NodeKey};
use crate::record::{DataDrop, What};

/// Type of every topic.
const TYPE_NAME: &str = "sgc_testkit/msg/Numbered";
/// Time after which a missing history is requested again.
const HISTORY_RETRY: Duration = Duration::from_secs(2);
const HISTORY_BYTES_MAX: usize = 1 << 20;
/// Time for which packets of past epochs are still accepted.
pub(crate) const EPOCH_GRACE: Duration = Duration::from_secs(5);

/// The recipients and the settings of a shared topic.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct Sharing {
    /// Every member of the owner's fleet is permitted.
    pub fleet: bool,
    /// Permitted nodes.
    pub nodes: BTreeSet<NodeKey>,
    /// Groups of the owner's fleet whose members are permitted.
    pub groups: BTreeSet<String>,
    /// Messages that late joiners get; 0 for a volatile topic.
    pub depth: usize,
    /// The topic is best effort: links may lose its messages.
    pub best_effort: bool,
    /// Other fleets whose members are all permitted.
    pub partners: BTreeSet<String>,
    /// Nodes that may publish too.
    pub publishers: BTreeSet<NodeKey>,
    /// The suite, unless it is the default.
    pub suite: Option<Suite>,
    /// The limits of messages kept for recovery.
    pub recovery: RecoveryLimits,
}

impl Sharing {
    /// Shares with the whole fleet.
    pub fn to_fleet() -> Self {
        Self { fleet: true, ..Self::default() }
    }

    /// Shares with these nodes.
    pub fn to(nodes: &[NodeKey]) -> Self {
        Self { nodes: nodes.iter().copied().collect(), ..Self::default() }
    }

    /// Shares with these groups.
    pub fn to_groups(groups: &[&str]) -> Self {
        Self { groups: groups.iter().map(|g| (*g).to_owned()).collect(), ..Self::default() }
    }

    /// Makes the topic transient local with a history of `depth` messages.
    pub fn transient_local(self, depth: usize) -> Self {
        Self { depth, ..self }
    }

    /// Keeps so many messages for recovery.
    pub fn recovering(self, messages_max: usize) -> Self {
        let recovery = RecoveryLimits { messages_max, ..self.recovery };
        Self { recovery, ..self }
    }

    /// Makes the topic best effort.
    pub fn best_effort(self) -> Self {
        Self { best_effort: true, ..self }
    }

    fn qos(&self) -> Qos {
        Qos {
            reliability: if self.best_effort { Reliability::BestEffort } else { Reliability::Reliable },
            durability: if self.depth > 0 { Durability::TransientLocal } else { Durability::Volatile },
            history: History::KeepLast(self.depth.max(1) as u32),
            ..Qos::default()
        }
    }
}

/// The configuration of a node, whether the node runs or not.
pub(crate) struct Node {
    pub(crate) key: NodeKey,
    pub(crate) name: String,
    pub(crate) identity: Arc<Identity>,
    pub(crate) transit: bool,
    pub(crate) mapping: MappingKind,
    pub(crate) router_limits: sgc_router::Limits,
    pub(crate) endpoint_limits: sgc_endpoint::Limits,
    pub(crate) shares: BTreeMap<String, Sharing>,
    pub(crate) uses: BTreeSet<(NodeKey, String)>,
    /// Topics of others on which it publishes.
    pub(crate) publishing: BTreeSet<(NodeKey, String)>,
    pub(crate) running: Option<Running>,
    /// Number of starts so far.
    pub(crate) runs: u64,
    /// Arrivals while the node is frozen; `None` while it is not.
    pub(crate) frozen: Option<VecDeque<Arrival>>,
    /// Milliseconds by which its clock is ahead.
    pub(crate) skew_ms: i64,
    /// Its trust anchors, revocations included, which survive restarts. `None` stands for those of its identity.
    pub(crate) anchors: Option<Arc<TrustAnchors>>,
    /// It looks for direct paths.
    pub(crate) is_direct: bool,
}

/// An input of a node.
pub(crate) enum Arrival {
    Frame(LinkId, Control),
    Packet(LinkId, Packet),
    /// The link is down. The flag says that another run of this node took its place at the peer.
    LinkDown(LinkId, bool),
    /// The driver's measurement of a link.
    Quality(LinkId, Duration, bool),
    /// A datagram that looks like a check: the addresses at which and from which it came.
    Check(SocketAddr, SocketAddr, Vec<u8>),
    /// A router sees this node at an address.
    Observed(LinkId, SocketAddr),
    /// The peer of a direct path did not answer when it was dialled.
    NotDialled(NodeId),
    /// News from the store.
    Store(StoreEvent),
}

/// An action that the world carries out for a node.
pub(crate) enum Effect {
    /// Carry a frame over a link.
    Frame(LinkId, Control),
    /// Carry a packet over a link.
    Packet(LinkId, Packet),
    /// Take a link down.
    Close(LinkId, LinkClose),
    /// Take a link down that nobody uses.
    HangUp(LinkId),
    /// Send a check to an address.
    Check(SocketAddr, Vec<u8>),
    /// Make a link to a peer at an address.
    Dial(NodeId, SocketAddr),
    /// Find out the addresses of this node.
    Look,
    /// Carry out an operation of the store.
    Store(StoreOp),
    /// A message was delivered.
    Delivered { owner: NodeKey, topic: String, id: MessageId, use_number: u64 },
    /// Keep its trust anchors over restarts.
    Trust(Arc<TrustAnchors>),
    /// Write an event to the log for tests.
    Log(What),
}

/// Names and ids of all nodes, for lookups.
#[derive(Default)]
pub(crate) struct Directory {
    pub(crate) by_id: BTreeMap<NodeId, NodeKey>,
    pub(crate) names: Vec<String>,
}

/// A running node.
pub(crate) struct Running {
    pub(crate) key: NodeKey,
    pub(crate) run: u64,
    pub(crate) router: Router,
    pub(crate) endpoint: Endpoint,
    identity: Arc<Identity>,
    /// Its present trust anchors.
    pub(crate) anchors: Arc<TrustAnchors>,
    next_link: u32,
    /// Wire and side of each link that is up.
    pub(crate) links: BTreeMap<LinkId, (usize, usize)>,
    /// The node at the other end of each of them.
    neighbours: BTreeMap<LinkId, NodeId>,
    pub(crate) direct: Option<DirectNode>,
    pub(crate) fib: BTreeMap<Name, FibEntry>,
    pub(crate) sources: BTreeMap<Name, LocalSource>,
    pub(crate) sinks: BTreeMap<Name, LocalSink>,
    pub(crate) catalogues: BTreeMap<NodeKey, Catalogue>,
    uses: BTreeSet<(NodeKey, String)>,
    pub(crate) publishing: BTreeSet<(NodeKey, String)>,
    /// This node's publishers on topics of others.
    pub(crate) publishers: BTreeMap<Name, Publisher>,
    /// Owners whose catalogues this node follows.
    owners: BTreeMap<NodeKey, NodeId>,
    uses_begun: u64,
    pub(crate) wake: Option<Instant>,
    to_router: VecDeque<Control>,
    effects: Vec<Effect>,
}

pub(crate) struct LocalSource {
    pub(crate) topic: String,
    pub(crate) source: Source,
    marks: Marks,
}

pub(crate) struct LocalSink {
    pub(crate) owner: NodeKey,
    pub(crate) topic: String,
    pub(crate) use_number: u64,
    pub(crate) transient_local: bool,
    pub(crate) sources: Vec<SourceId>,
    pub(crate) sink: Option<Sink>,
    pub(crate) retry_at: Option<Instant>,
    /// Time at which the keys of past epochs are dropped.
    pub(crate) retire_at: Option<Instant>,
}

impl Node {
    /// Starts the node with its configuration.
    pub(crate) fn start(&mut self, now: Now, seed: u64, directory: &Directory) {
        self.runs += 1;
        self.frozen = None;
        let own = || Arc::new(self.identity.anchors().clone());
        let anchors = self.anchors.clone().unwrap_or_else(own);
        let config = RouterConfig {
            node: self.identity.node_id(),
            identity: self.identity.clone(),
            transit: self.transit,
            incarnation: seed,
            started: now.unix,
            mapping: self.mapping,
            anchors: anchors.clone(),
            limits: self.router_limits.clone(),
        };
        let router = Router::new(config, now);
        let config = EndpointConfig {
            identity: self.identity.clone(),
            authority: false,
            operations: false,
            limits: self.endpoint_limits.clone(),
        };
        let mut endpoint = Endpoint::new(config, ChaCha20Rng::seed_from_u64(seed), now);
        endpoint.set_anchors(now, anchors.clone());
        let mut running = Running {
            key: self.key,
            run: self.runs,
            router,
            endpoint,
            identity: self.identity.clone(),
            anchors,
            next_link: 1,
            links: BTreeMap::new(),
            neighbours: BTreeMap::new(),
            direct: None,
            fib: BTreeMap::new(),
            sources: BTreeMap::new(),
            sinks: BTreeMap::new(),
            catalogues: BTreeMap::new(),
            uses: BTreeSet::new(),
            publishing: BTreeSet::new(),
            publishers: BTreeMap::new(),
            owners: BTreeMap::new(),
            uses_begun: 0,
            wake: None,
            to_router: VecDeque::new(),
            effects: Vec::new(),
        };
        if self.is_direct {
            running.begin_direct(now, seed);
        }
        for (topic, sharing) in &self.shares {
            running.share(now, topic, sharing, directory);
        }
        for (owner, topic) in &self.uses {
            running.use_topic(now, *owner, topic, directory);
        }
        for (owner, topic) in &self.publishing {
            running.publish_on(now, *owner, topic, directory);
        }
        self.running = Some(running);
    }
}

impl Running {
    pub(crate) fn new_link(&mut self, now: Now, wire: usize, side: usize, peer: Neighbour) -> LinkId {
        let link = LinkId(self.next_link);
        self.next_link += 1;
        self.links.insert(link, (wire, side));
        self.neighbours.insert(link, peer.node);
        self.router.handle_link_up(now, link, peer);
        link
    }

    /// Adds a link to a node at a remote address, near or far. The search for direct paths knows whether it comes
    /// of an attempt.
    pub(crate) fn new_found_link(
        &mut self,
        now: Now,
        wire: usize,
        side: usize,
        peer: Neighbour,
        remote: (SocketAddr, DirectReach),
    ) -> LinkId {
        let next = LinkId(self.next_link);
        let found =
            self.direct.as_mut().and_then(|direct| direct.link_up(now.instant, next, peer.node, remote));
        self.new_link(now, wire, side, Neighbour { direct: found, ..peer })
    }

    pub(crate) fn set_anchors(&mut self, now: Now, anchors: Arc<TrustAnchors>) {
        self.anchors = anchors.clone();
        self.router.set_anchors(now, anchors.clone());
        self.endpoint.set_anchors(now, anchors);
    }

    pub(crate) fn renew(&mut self, now: Now, identity: Arc<Identity>) {
        self.identity = identity.clone();
        self.router.set_identity(now, identity.clone());
        self.endpoint.set_identity(now, identity);
    }

    pub(crate) fn handle(&mut self, now: Now, arrival: Arrival) {
        match arrival {
            Arrival::Frame(link, frame) => self.router.handle_frame(now, link, frame),
            Arrival::Packet(link, packet) => self.forward(now, link, packet),
            Arrival::LinkDown(link, superseded) => {
                if superseded {
                    self.router.handle_superseded();
                    // Sinks of the other run must not be requested again.
                    self.sinks.values_mut().for_each(|local| local.sink = None);
                }
                self.link_down(now, link);
            }
            Arrival::Quality(link, round_trip, suspect) => {
                let quality = LinkQuality { round_trip, is_silent: suspect, ..LinkQuality::default() };
                self.router.handle_link_quality(now, link, quality);
                if let Some(direct) = &mut self.direct {
                    direct.link_looked_at(now.instant, link, suspect);
                }
            }
            Arrival::Check(to, from, datagram) => {
                if let Some(direct) = &mut self.direct {
                    direct.paths.received(now.instant, to, from, &datagram);
                }
            }
            Arrival::Observed(link, address) => {
                if let Some(direct) = self.direct.as_mut().filter(|_| self.links.contains_key(&link)) {
                    direct.observe(now.instant, link, address);
                }
            }
            Arrival::Store(event) => self.router.handle_store(now, event),
            Arrival::NotDialled(peer) => {
                if let Some(direct) = &mut self.direct {
                    direct.paths.not_dialled(now.instant, peer);
                }
            }
        }
    }

    pub(crate) fn link_down(&mut self, now: Now, link: LinkId) {
        if self.links.remove(&link).is_some() {
            self.neighbours.remove(&link);
            self.router.handle_link_down(now, link);
            if let Some(direct) = &mut self.direct {
                direct.link_down(now.instant, link);
            }
        }
    }

    pub(crate) fn handle_timeout(&mut self, now: Now) {
        self.router.handle_timeout(now);
        self.drain_router(now, None);
        self.endpoint.handle_timeout(now);
        self.direct_timeout(now);
        let due: Vec<_> = self
            .sinks
            .iter()
            .filter(|(_, s)| s.retry_at.is_some_and(|at| at <= now.instant))
            .map(|(n, _)| *n)
            .collect();
        for name in due {
            self.ask_again(now, name);
        }
        let mut marks = Vec::new();
        for local in self.sources.values_mut() {
            if local.marks.is_due(now.instant, &local.source.progress()) {
                local.source.mark(|p| marks.push(p));
            }
        }
        self.send_packets(now, marks);
        for local in self.sinks.values_mut() {
            if local.retire_at.take_if(|at| *at <= now.instant).is_some()
                && let Some(sink) = &mut local.sink
            {
                sink.retire_epochs();
            }
        }
    }

    pub(crate) fn share(
        &mut self,
        now: Now,
        topic: &str,
        sharing: &Sharing,
        directory: &Directory,
    ) -> Option<Name> {
        self.identity.fleet_secret()?;
        let suite = sharing.suite.unwrap_or(Suite::DEFAULT);
        let policy = policy(&self.identity, sharing, directory);
        let source_id = self.endpoint.new_source_id();
        let sources = match sharing.depth {
            0 => Vec::new(),
            _ => vec![CatalogueSource { source: source_id, qos: sharing.qos(), node: None }],
        };
        let spec = ShareSpec {
            metadata: metadata(self.identity.node_name().as_str(), topic),
            policy,
            suite,
            class: Class::Default,
            keyless: true,
            type_hash: None,
            qos: sharing.qos(),
            sources,
        };
        let name = self.endpoint.share(now, spec).ok()?;
        let config = SourceConfig {
            name,
            id: source_id,
            class: Class::Default,
            reliable: !sharing.best_effort,
            history_depth: sharing.depth,
            history_bytes_max: HISTORY_BYTES_MAX,
            recovery: sharing.recovery,
            receivers: self.endpoint.receivers(&name),
        };
        let grant = self.endpoint.share_grant(&name).expect("shared above");
        let message_key = MessageKey::generate(suite);
        let source = Source::new(config, &grant, message_key).expect("a key of that suite");
        self.endpoint.set_sources(now, &name, vec![source.progress()]);
        self.sources.insert(name, LocalSource { topic: topic.to_owned(), source, marks: Marks::default() });
        Some(name)
    }

    pub(crate) fn unshare(&mut self, now: Now, topic: &str) {
        let name = self.sources.iter().find(|(_, s)| s.topic == topic).map(|(n, _)| *n);
        if let Some(name) = name {
            self.sources.remove(&name);
            self.sinks.remove(&name);
            self.endpoint.unshare(now, &name);
        }
    }

    pub(crate) fn use_topic(&mut self, now: Now, owner: NodeKey, topic: &str, directory: &Directory) {
        self.uses.insert((owner, topic.to_owned()));
        self.follow(now, owner, directory);
    }

    pub(crate) fn follow(&mut self, now: Now, owner: NodeKey, directory: &Directory) {
        // The owner may belong to a fleet that this node cannot see. Then there is no catalogue to follow.
        let owner_name = &directory.names[owner.0];
        if self.endpoint.follow(now, owner_name) {
            self.owners.extend(self.identity.node_id_of(owner_name).map(|id| (owner, id)));
        }
        self.reconcile(now, owner);
    }

    pub(crate) fn stop_using(&mut self, now: Now, owner: NodeKey, topic: &str) {
        self.uses.remove(&(owner, topic.to_owned()));
        self.reconcile(now, owner);
        if self.uses.iter().chain(&self.publishing).all(|(o, _)| *o != owner) {
            if let Some(id) = self.owners.remove(&owner) {
                self.endpoint.unfollow(now, &id);
            }
            self.catalogues.remove(&owner);
        }
    }

    pub(crate) fn publish(&mut self, now: Now, topic: &str, id: MessageId, bytes: usize) -> Option<SourceId> {
        let (_, local) = self.sources.iter_mut().find(|(_, s)| s.topic == topic)?;
        let packets = sealed(&mut local.source, id, bytes);
        let source = local.source.id();
        local.marks.is_due(now.instant, &local.source.progress());
        self.send_packets(now, packets);
        Some(source)
    }

    pub(crate) fn send_packets(&mut self, now: Now, packets: Vec<Packet>) {
        for packet in packets {
            // As in the driver, packets without a forwarding entry are not sent.
            if self.fib.contains_key(&packet.header.name) {
                self.forward(now, LinkId::LOCAL, packet);
            }
        }
    }

    /// Drains both machines and the data path. Returns all their effects.
    pub(crate) fn drain(&mut self, now: Now) -> Vec<Effect> {
        loop {
            self.drain_endpoint(now);
            self.drain_router(now, None);
            while let Some(frame) = self.to_router.pop_front() {
                self.router.handle_frame(now, LinkId::LOCAL, frame);
                self.drain_router(now, None);
            }
            if !self.drain_direct(now) {
                break;
            }
        }
        let mut wake = None;
        self.drain_router(now, Some(&mut wake));
        if let sgc_endpoint::Output::Timeout(Some(at)) = self.endpoint.poll_output() {
            wake = Some(wake.map_or(at, |w: Instant| w.min(at)));
        }
        let sinks = self.sinks.values().flat_map(|s| [s.retry_at, s.retire_at]).flatten();
        let marks = self.sources.values().filter_map(|s| s.marks.deadline());
        let direct = self.direct.as_mut().map(DirectNode::deadline);
        self.wake = sinks.chain(marks).chain(wake).chain(direct).min();
        std::mem::take(&mut self.effects)
    }

    fn drain_router(&mut self, now: Now, mut wake: Option<&mut Option<Instant>>) {
        loop {
            match self.router.poll_output() {
                sgc_router::Output::Send { link: LinkId::LOCAL, frame } => {
                    self.endpoint.handle_frame(now, frame);
                    self.drain_endpoint(now);
                }
                sgc_router::Output::Send { link, frame } => self.effects.push(Effect::Frame(link, frame)),
                sgc_router::Output::Forward { name, entry: Some(entry) } => {
                    self.fib.insert(name, entry);
                }
                sgc_router::Output::Forward { name, entry: None } => {
                    self.fib.remove(&name);
                }
                sgc_router::Output::Close { link, reason } => {
                    self.effects.push(Effect::Close(link, reason));
                }
                sgc_router::Output::Flush { link } => self.router.handle_flushed(now, link),
                sgc_router::Output::Store(op) => self.effects.push(Effect::Store(op)),
                sgc_router::Output::Trust(anchors) => {
                    self.anchors = anchors.clone();
                    self.effects.push(Effect::Trust(anchors.clone()));
                    self.endpoint.set_anchors(now, anchors);
                    self.drain_endpoint(now);
                }
                sgc_router::Output::Dropped(dropped) => {
                    self.effects.push(Effect::Log(What::RouterDrop(dropped)));
                }
                sgc_router::Output::Timeout(at) => {
                    if let Some(wake) = wake.as_deref_mut() {
                        *wake = at;
                    }
                    return;
                }
            }
        }
    }

    fn drain_endpoint(&mut self, now: Now) {
        loop {
            match self.endpoint.poll_output() {
                sgc_endpoint::Output::Send(frame) => self.to_router.push_back(frame),
                sgc_endpoint::Output::Event(event) => {
                    self.effects.push(Effect::Log(What::Event(event.clone())));
                    self.handle_event(now, event);
                }
                sgc_endpoint::Output::Dropped(dropped) => {
                    self.effects.push(Effect::Log(What::EndpointDrop(dropped)));
                }
                sgc_endpoint::Output::Timeout(_) => return,
            }
        }
    }

    fn handle_event(&mut self, now: Now, event: Event) {
        match event {
            Event::Granted { name, grant, .. } if self.publishers.contains_key(&name) => {
                let mut packets = Vec::new();
                if let Some(publisher) = self.publishers.get_mut(&name) {
                    publisher.take_grant(grant, |p| packets.push(p));
                }
                self.send_packets(now, packets);
            }
            Event::OwnGrant { name, grant } => self.handle_own_grant(now, name, grant),
            Event::Granted { name, sink: id, grant } => {
                let Some(local) = self.sinks.get_mut(&name) else { return };
                let mut released = Vec::new();
                match &mut local.sink {
                    Some(sink) => sink.regrant(id, grant, |delivery| released.push(delivery)),
                    None => {
                        let limits = SinkLimits::default();
                        local.sink = Some(Sink::new(name, id, grant, local.transient_local, limits));
                    }
                }
                local.retire_at = Some(now.instant + EPOCH_GRACE);
                for delivery in released {
                    self.delivered(now, name, delivery);
                }
                self.ask_history(now, name);
            }
            Event::Rekeyed { name, grant } => {
                let mut packets = Vec::new();
                if let Some(local) = self.sources.get_mut(&name) {
                    let _ = local.source.rekey(&grant, |p| packets.push(p));
                }
                for packet in packets {
                    self.forward(now, LinkId::LOCAL, packet);
                }
            }
            Event::Catalogue { owner, catalogue } => {
                let found = self.owners.iter().find(|(_, id)| **id == owner).map(|(key, _)| *key);
                if let Some(owner) = found {
                    self.catalogues.insert(owner, catalogue);
                    self.reconcile(now, owner);
                }
            }
            Event::PathAsked { sink, peer, question } => self.path_asked(now, sink, &peer, &question),
            Event::PathOffered { peer, offer } => {
                if let Some(direct) = &mut self.direct {
                    direct.paths.offered(now.instant, peer, &offer);
                }
            }
            Event::PathRefused { peer, by } => {
                let is_for_good = by == RefusedBy::Owner(RefuseReason::NotPermitted);
                if let Some(direct) = &mut self.direct {
                    direct.paths.refused(now.instant, peer, is_for_good);
                }
            }
            Event::Recover(recover) => {
                let mut packets = Vec::new();
                if let Some(local) = self.sources.get_mut(&recover.name)
                    && local.source.id() == recover.source
                {
                    local.source.replay(recover.sink, recover.from, recover.to, |p| packets.push(p));
                }
                for packet in packets {
                    self.forward(now, LinkId::LOCAL, packet);
                }
            }
            _ => {}
        }
    }

    /// Joins wanted topics in the owner's catalogue and leaves all others.
    fn reconcile(&mut self, now: Now, owner: NodeKey) {
        let Some(owner_id) = self.owners.get(&owner).copied() else { return };
        let mut wanted = BTreeMap::new();
        for entry in self.catalogues.get(&owner).iter().flat_map(|c| &c.entries).filter(|e| e.subscribe) {
            if self.uses.contains(&(owner, entry.metadata.ros_name.clone())) {
                wanted.insert(name_of(&owner_id, &entry.blind), entry.clone());
            }
        }
        self.reconcile_publishers(now, owner, owner_id);
        let gone: Vec<_> = self
            .sinks
            .iter()
            .filter(|(name, s)| s.owner == owner && !wanted.contains_key(*name))
            .map(|(name, _)| *name)
            .collect();
        for name in gone {
            self.sinks.remove(&name);
            self.endpoint.leave(now, &name);
        }
        for (name, entry) in wanted {
            let sources: Vec<_> = entry.sources.iter().map(|s| s.source).collect();
            if let Some(local) = self.sinks.get_mut(&name) {
                for old in local.sources.iter().filter(|s| !sources.contains(s)) {
                    if let Some(sink) = &mut local.sink {
                        sink.forget(old);
                    }
                }
                local.sources = sources;
                self.ask_history(now, name);
                continue;
            }
            self.uses_begun += 1;
            let local = LocalSink {
                owner,
                topic: entry.metadata.ros_name.clone(),
                use_number: self.uses_begun,
                transient_local: entry.qos.is_transient_local(),
                sources,
                sink: None,
                retry_at: None,
                retire_at: None,
            };
            self.sinks.insert(name, local);
            self.endpoint.join(now, name, owner_id, JoinKind::Subscribe { describe: false });
        }
    }

    /// Requests all missing messages, if the name is granted.
    fn ask_history(&mut self, now: Now, name: Name) {
        self.ask(now, name, |sink, source| sink.ask(source).map_or(AskAgain::No, AskAgain::From));
    }

    /// Schedules another request for missing messages.
    fn ask_again(&mut self, now: Now, name: Name) {
        self.ask(now, name, Sink::ask_again);
    }

    fn ask(&mut self, now: Now, name: Name, mut ask: impl FnMut(&mut Sink, SourceId) -> AskAgain) {
        let granted = self.endpoint.join_status(&name) == Some(JoinStatus::Granted);
        let Some(local) = self.sinks.get_mut(&name) else { return };
        local.retry_at = None;
        let Some(sink) = local.sink.as_mut().filter(|_| granted) else { return };
        for source in sink.unsynced().collect::<Vec<_>>() {
            match ask(sink, source) {
                AskAgain::No => continue,
                AskAgain::Wait => {}
                AskAgain::From(from) => self.endpoint.recover(name, source, from, u64::MAX),
            }
            local.retry_at = Some(now.instant + HISTORY_RETRY);
        }
    }

    /// Forwards one packet on the data path.
    pub(crate) fn forward(&mut self, now: Now, ingress: LinkId, mut packet: Packet) {
        let name = packet.header.name;
        let Some(entry) = self.fib.get(&name) else {
            return self.drop_packet(name, ingress, DataDrop::NoTree);
        };
        if !entry.accepts_from(ingress) {
            return self.drop_packet(name, ingress, DataDrop::WrongWay);
        }
        if ingress != LinkId::LOCAL {
            match packet.header.hops.checked_sub(1) {
                Some(hops) if hops > 0 => packet.header.hops = hops,
                _ => return self.drop_packet(name, ingress, DataDrop::HopLimit),
            }
        }
        let links: Vec<_> = match packet.header.to {
            Some(sink) => entry.egress_to(ingress, &sink).into_iter().collect(),
            None => entry.egress(ingress).collect(),
        };
        if links.is_empty() && packet.header.to.is_some() {
            return self.drop_packet(name, ingress, DataDrop::NoSuchSink);
        }
        for link in links {
            if link == LinkId::LOCAL {
                self.deliver(now, &packet);
            } else {
                self.effects.push(Effect::Packet(link, packet.clone()));
            }
        }
    }

    fn deliver(&mut self, now: Now, packet: &Packet) {
        let name = packet.header.name;
        let sink = self.sinks.get_mut(&name).and_then(|local| local.sink.as_mut());
        match sink.map(|sink| sink.handle_packet(packet)) {
            Some(delivery) => self.delivered(now, name, delivery),
            None => self.drop_packet(name, LinkId::LOCAL, DataDrop::NotGranted),
        }
    }

    /// Handles the delivery of a packet.
    pub(crate) fn delivered(&mut self, now: Now, name: Name, delivery: Result<Delivery, SinkDrop>) {
        let Some(local) = self.sinks.get_mut(&name) else { return };
        match delivery {
            Ok(Delivery::Message(message)) => {
                let (owner, topic, use_number) = (local.owner, local.topic.clone(), local.use_number);
                self.effects.push(Effect::Delivered { owner, topic, id: number(&message), use_number });
            }
            Ok(Delivery::NeedsHistory(source)) => {
                local.retry_at.get_or_insert(now.instant + HISTORY_RETRY);
                if let Some(from) = local.sink.as_mut().and_then(|sink| sink.ask(source)) {
                    self.endpoint.recover(name, source, from, u64::MAX);
                }
            }
            Ok(Delivery::Lost(_, messages)) => {
                self.effects.push(Effect::Log(What::SinkLost { name, messages }));
            }
            Ok(Delivery::Synced(_)) => {
                if local.sink.as_ref().is_none_or(|sink| sink.unsynced().next().is_none()) {
                    local.retry_at = None;
                }
            }
            Ok(Delivery::Confirm(source, seq)) => self.endpoint.confirm(name, source, seq),
            Ok(Delivery::Incomplete | Delivery::Mark | Delivery::Asserted(_) | Delivery::Parked) => {}
            Err(why) => self.drop_packet(name, LinkId::LOCAL, DataDrop::Sink(why)),
        }
    }

    fn drop_packet(&mut self, name: Name, ingress: LinkId, why: DataDrop) {
        self.effects.push(Effect::Log(What::DataDrop { name, ingress, why }));
    }
}

pub(crate) fn sealed(source: &mut Source, id: MessageId, bytes: usize) -> Vec<Packet> {
    let mut payload = id.0.to_be_bytes().to_vec();
    payload.resize(bytes.max(8), 0x5a);
    let head = MessageHead::new(MessageKind::Write, 0);
    let mut packets = Vec::new();
    source.publish(&head, payload.into(), false, |p| packets.push(p)).expect("tests publish what fits");
    packets
}

/// Returns the policy that permits the recipients of a share.
pub(crate) fn policy(owner: &Identity, sharing: &Sharing, directory: &Directory) -> Policy {
    let ca = owner.as_peer().ca;
    let id = |node: &NodeKey| {
        directory.by_id.iter().find(|(_, k)| *k == node).map(|(id, _)| *id).expect("a node of this world")
    };
    let group = |g: &String| owner.fleet_secret().map(|s| (ca, s.group_tag(g)));
    let partner = |fleet: &String| {
        let anyone = Member { fleet: fleet.clone(), ..Member::new("anyone") };
        identity(&anyone).as_peer().ca
    };
    Policy {
        subscribe: Grantees {
            fleets: sharing
                .fleet
                .then_some(ca)
                .into_iter()
                .chain(sharing.partners.iter().map(partner))
                .collect(),
            nodes: sharing.nodes.iter().map(id).collect(),
            groups: sharing.groups.iter().filter_map(group).collect(),
        },
        publish: Grantees { nodes: sharing.publishers.iter().map(id).collect(), ..Grantees::default() },
    }
}

/// Returns the metadata of a node's topic.
pub(crate) fn metadata(owner: &str, topic: &str) -> Metadata {
    Metadata::topic(owner, topic, TYPE_NAME)
}

fn number(message: &Message) -> MessageId {
    let mut id = [0; 8];
    let payload: &Bytes = &message.payload;
    id.copy_from_slice(&payload[..8]);
    MessageId(u64::from_be_bytes(id))
}
