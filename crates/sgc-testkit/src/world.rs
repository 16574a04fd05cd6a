//! The network and its time: connections, frames and packets in flight, and a record of all events.

use std::collections::{BTreeMap, BTreeSet, VecDeque};
use std::fmt::Write as _;
use std::net::SocketAddr;
use std::ops::RangeInclusive;
use std::time::{Duration, Instant};

use bytes::Bytes;
use sgc_endpoint::{Event, JoinKind, JoinStatus, PackedType};
use sgc_router::{LinkClose, LinkId, MappingKind, Neighbour, RouterStats, StoreOp};
use sgc_trust::{Identity, TopicSecret, derive_name, name_of, paths_blind};
use sgc_wire::{
    AdvertBody, Answer, AnswerBody, Catalogue, Consumer, Control, Decode, Encode, JoinBody, LinkStateBody,
    Metadata, Name, NodeId, Packet, Qos, RefuseReason, Report, ReportQuestion, Role, RosNode, SinkId,
    SourceId, SourceOffer, Wish,
};

use crate::cast::{Member, identity};
use crate::clock::{Clock, GENESIS};
use crate::datagrams::Datagrams;
use crate::ids::{MessageId, NodeKey};
use crate::node::{Arrival, Directory, Effect, Node, Sharing, metadata};
use crate::record::{
    CapturedFrame, CapturedPacket, DataDrop, LogEntry, PublishedMessage, ReceivedMessage, What,
};
use crate::rng::Dice;
use crate::store::SimStore;
use crate::wires::{Cable, Content, Wire, WireEnd};

/// Number of deliveries in one call of [`World::run`] above which the network counts as looping.
const STEPS_MAX: usize = 300_000;
/// Period in which [`World::run_until`] checks its condition.
const LOOK: Duration = Duration::from_millis(20);
/// Silence after which a link seems dead.
pub(crate) const SUSPECT_AFTER: Duration = Duration::from_millis(2500);
/// As in `sgc-session`: least time until a link is dialled again that ended because another run has its place.
const DISPLACED_MIN: Duration = Duration::from_secs(1);
/// Bound of the `until_…` methods: longer than a lease and the longest wait between attempts.
const PATIENCE: Duration = Duration::from_secs(350);

/// The settings of a world.
#[derive(Clone, Debug)]
pub struct WorldConfig {
    /// Seed of everything that is drawn.
    pub seed: u64,
    /// Latency of a cable, drawn once for each.
    pub latency: RangeInclusive<Duration>,
    /// Extra delay of each frame or packet. Frames of a link, and packets of one name on it, keep their order.
    pub jitter: RangeInclusive<Duration>,
    /// Percentage of best-effort packets that each link loses.
    pub loss_percent: usize,
    /// Percentage of best-effort packets that come twice, and of those that later ones overtake.
    pub repeat_percent: usize,
    /// Mappings by which routers learn owners of names; each router draws one.
    pub mappings: Vec<MappingKind>,
    /// Bounds of the routers.
    pub router_limits: sgc_router::Limits,
    /// Bounds and timers of the endpoints.
    pub endpoint_limits: sgc_endpoint::Limits,
}

impl WorldConfig {
    /// Links of 1–40 ms with a little jitter and no loss, everything else as in production.
    pub fn new(seed: u64) -> Self {
        Self {
            seed,
            latency: Duration::from_millis(1)..=Duration::from_millis(40),
            jitter: Duration::ZERO..=Duration::from_millis(3),
            loss_percent: 0,
            repeat_percent: 0,
            mappings: vec![MappingKind::Flood],
            router_limits: sgc_router::Limits::default(),
            endpoint_limits: sgc_endpoint::Limits::default(),
        }
    }
}

pub(crate) enum Pending {
    Frame {
        wire: usize,
        to: usize,
        bytes: Vec<u8>,
    },
    Packet {
        wire: usize,
        to: usize,
        packet: Packet,
    },
    /// The far end is gone. `superseded` says that it closed because another run of the node took its place.
    LinkDown {
        wire: usize,
        to: usize,
        superseded: bool,
    },
    Quality {
        wire: usize,
        to: usize,
        suspect: bool,
    },
    /// An input for this run of a node.
    Input {
        node: NodeKey,
        run: u64,
        arrival: Arrival,
    },
    /// A dial of a direct path, once its packets may have gone there and back.
    Dial(Dial),
    /// A look at a connection through NATs.
    Probe {
        wire: usize,
    },
    /// An operation of this run of a node at the store.
    Store {
        node: NodeKey,
        run: u64,
        op: StoreOp,
    },
    /// A dial of a configured link that was closed because another run of the node took its place.
    Redial {
        cable: usize,
    },
}

/// A dial of a direct path.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Dial {
    pub(crate) node: NodeKey,
    pub(crate) run: u64,
    pub(crate) peer: NodeId,
    pub(crate) to: SocketAddr,
    /// Time until its packets are sent once more, and at which it is given up.
    pub(crate) again_after: Duration,
    pub(crate) until: Instant,
}

/// The detail of a trace. The environment variable `SGC_TRACE` can raise it.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Tracing {
    /// Actions on the world.
    Transitions,
    /// `SGC_TRACE=log`: also events at the nodes.
    Log,
    /// `SGC_TRACE=frames`: also every frame.
    Frames,
}

/// The nodes, the network, and the time.
pub struct World {
    pub(crate) clock: Clock,
    pub(crate) config: WorldConfig,
    dice: Dice,
    pub(crate) nodes: Vec<Node>,
    pub(crate) members: Vec<Member>,
    pub(crate) directory: Directory,
    pub(crate) cables: Vec<Cable>,
    pub(crate) wires: Vec<Wire>,
    pub(crate) datagrams: Datagrams,
    pub(crate) store: SimStore,
    queue: BTreeMap<(Instant, u64), Pending>,
    queued: u64,
    log: Vec<LogEntry>,
    received: Vec<ReceivedMessage>,
    published: Vec<PublishedMessage>,
    pub(crate) captured: Option<Vec<CapturedFrame>>,
    pub(crate) captured_packets: Vec<CapturedPacket>,
    /// Number of times that each packet crossed each wire in each direction, if it is counted.
    pub(crate) copies: Option<BTreeMap<WireCrossing, usize>>,
    trace: Vec<String>,
    tracing: Tracing,
    steps: usize,
}

/// A packet on a wire: wire, sending side, source, message, fragment, addressee.
pub(crate) type WireCrossing = (usize, usize, SourceId, u64, u16, Option<SinkId>);

impl World {
    /// Returns a world of [`WorldConfig::new`].
    pub fn new(seed: u64) -> Self {
        Self::with(WorldConfig::new(seed))
    }

    /// Returns a world without nodes.
    pub fn with(config: WorldConfig) -> Self {
        Self {
            clock: Clock::default(),
            dice: Dice::new(config.seed),
            config,
            nodes: Vec::new(),
            members: Vec::new(),
            directory: Directory::default(),
            cables: Vec::new(),
            wires: Vec::new(),
            datagrams: Datagrams::default(),
            store: SimStore::default(),
            queue: BTreeMap::new(),
            queued: 0,
            log: Vec::new(),
            received: Vec::new(),
            published: Vec::new(),
            captured: None,
            captured_packets: Vec::new(),
            copies: None,
            trace: Vec::new(),
            tracing: match std::env::var("SGC_TRACE").as_deref() {
                Err(_) => Tracing::Transitions,
                Ok("frames") => Tracing::Frames,
                Ok(_) => Tracing::Log,
            },
            steps: 0,
        }
    }

    // ---- Nodes.

    /// Adds and starts a node that only routes; its identity lacks the fleet secret.
    pub fn router(&mut self, name: &str) -> NodeKey {
        self.node(Member { router: true, ..Member::new(name) }, true)
    }

    /// Adds and starts a node that only serves itself.
    pub fn proxy(&mut self, name: &str) -> NodeKey {
        self.node(Member::new(name), false)
    }

    /// Sets the mapping of routers that are added from here on.
    pub fn set_mapping(&mut self, mapping: MappingKind) {
        self.config.mappings = vec![mapping];
    }

    /// Adds and starts a node for a member, which carries names of others if `transit`.
    pub fn node(&mut self, member: Member, transit: bool) -> NodeKey {
        let key = NodeKey(self.nodes.len());
        let member = Member { may_route: member.may_route || transit, ..member };
        let identity = identity(&member);
        self.directory.by_id.insert(identity.node_id(), key);
        self.directory.names.push(member.name.clone());
        self.note(format!("{key:?} is {}{}", member.name, if transit { ", carries others" } else { "" }));
        self.nodes.push(Node {
            key,
            name: member.name.clone(),
            identity,
            transit,
            mapping: match self.config.mappings.as_slice() {
                [one] => *one,
                several => several[self.dice.below(several.len())],
            },
            router_limits: self.config.router_limits.clone(),
            endpoint_limits: self.config.endpoint_limits.clone(),
            shares: BTreeMap::new(),
            uses: BTreeSet::new(),
            publishing: BTreeSet::new(),
            running: None,
            runs: 0,
            frozen: None,
            skew_ms: 0,
            anchors: None,
            is_direct: false,
        });
        self.members.push(member);
        self.start(key);
        key
    }

    /// Starts a stopped node with its configuration and connects its cables.
    pub fn start(&mut self, node: NodeKey) {
        if self.is_running(node) {
            return;
        }
        self.note(format!("start {node:?}"));
        let (now, seed) = (self.now_at(node), self.dice.number());
        self.nodes[node.0].start(now, seed, &self.directory);
        self.settle(node);
        self.connect_store(node);
        for cable in self.cables_of(node) {
            self.connect(cable);
        }
    }

    /// Kills a node. Its neighbours see its links go down at once.
    pub fn crash(&mut self, node: NodeKey) {
        self.crash_unseen(node, Duration::ZERO);
    }

    /// Kills a node. Its neighbours see its links go down only after `idle`, unless they hear of its restart.
    pub fn crash_unseen(&mut self, node: NodeKey, idle: Duration) {
        if !self.is_running(node) {
            return;
        }
        self.note(format!("crash {node:?}, seen after {idle:?}"));
        self.stop(node, idle, false);
    }

    /// Kills a node and starts it again 50 ms later. Its neighbours see both at once.
    pub fn restart(&mut self, node: NodeKey) {
        self.crash(node);
        self.run(Duration::from_millis(50));
        self.start(node);
    }

    /// Ends a node cleanly: it withdraws its names and says goodbye to its neighbours.
    pub fn shut_down(&mut self, node: NodeKey) {
        if !self.is_running(node) {
            return;
        }
        self.note(format!("shut down {node:?}"));
        let now = self.now_at(node);
        let Some(running) = &mut self.nodes[node.0].running else { return };
        running.endpoint.withdraw_all(now);
        self.settle(node);
        let links: Vec<_> = self.nodes[node.0].running.iter().flat_map(|r| r.links.keys().copied()).collect();
        for link in links {
            self.send_frame(node, link, Control::Goodbye);
        }
        self.stop(node, Duration::ZERO, true);
    }

    /// Freezes a node, as SIGSTOP does: its links stay up, and it does nothing.
    pub fn freeze(&mut self, node: NodeKey) {
        self.note(format!("freeze {node:?}"));
        self.nodes[node.0].frozen.get_or_insert_default();
        self.tell_neighbours(node, SUSPECT_AFTER, true);
    }

    /// Lets a frozen node go on and handle all that arrived meanwhile.
    pub fn thaw(&mut self, node: NodeKey) {
        self.note(format!("thaw {node:?}"));
        for arrival in self.nodes[node.0].frozen.take().into_iter().flatten() {
            self.arrive(node, arrival);
        }
        self.tell_neighbours(node, Duration::ZERO, false);
    }

    /// Reports the quality of links to a node to its neighbours, after a delay.
    fn tell_neighbours(&mut self, node: NodeKey, after: Duration, suspect: bool) {
        let links: Vec<_> =
            self.nodes[node.0].running.iter().flat_map(|r| r.links.values().copied()).collect();
        for (wire, side) in links {
            self.queue(self.clock.instant() + after, Pending::Quality { wire, to: 1 - side, suspect });
        }
    }

    /// Deletes the state that a stopped node keeps over restarts: the revocations that it knows.
    pub fn wipe(&mut self, node: NodeKey) {
        assert!(!self.is_running(node), "a running node keeps what it knows");
        self.note(format!("wipe {node:?}"));
        self.nodes[node.0].anchors = None;
    }

    /// Starts counting how often each packet crosses each wire.
    pub fn count_copies(&mut self) {
        self.copies = Some(BTreeMap::new());
    }

    /// Ends [`Self::count_copies`]. Returns the packets that crossed a wire more than once in one direction.
    pub fn copied(&mut self) -> Vec<String> {
        let copies = self.copies.take().unwrap_or_default();
        let name = |wire: usize, side: usize| {
            let ends = &self.wires[wire].ends;
            format!("{:?} to {:?}", ends[side].node, ends[1 - side].node)
        };
        let many = copies.iter().filter(|(_, n)| **n > 1);
        many.map(|((wire, side, _, seq, ..), n)| format!("{seq} from {} {n} times", name(*wire, *side)))
            .collect()
    }

    // ---- Cables.

    /// Lays a cable and connects it.
    pub fn link(&mut self, a: NodeKey, b: NodeKey) {
        let latency = self.dice.time(&self.config.latency.clone());
        self.link_over(a, b, latency);
    }

    /// Lays a cable of that latency and connects it.
    pub fn link_over(&mut self, a: NodeKey, b: NodeKey, latency: Duration) {
        self.note(format!("link {a:?} {b:?} {latency:?}"));
        let cable = Cable {
            ends: [a, b],
            whole: true,
            wire: None,
            latency,
            tampers: [None, None],
            loses: [false; 2],
            is_direct: false,
        };
        self.cables.push(cable);
        self.connect(self.cables.len() - 1);
    }

    /// Cuts a cable. Both ends see it at once.
    pub fn cut(&mut self, a: NodeKey, b: NodeKey) {
        self.cut_unseen(a, b, Duration::ZERO, Duration::ZERO);
    }

    /// Cuts a cable. `a` sees it after `a_idle`, `b` after `b_idle`.
    pub fn cut_unseen(&mut self, a: NodeKey, b: NodeKey, a_idle: Duration, b_idle: Duration) {
        self.note(format!("cut {a:?} {b:?}, seen after {a_idle:?} and {b_idle:?}"));
        let cable = self.cable(a, b);
        self.cables[cable].whole = false;
        let Some(wire) = self.cables[cable].wire.take() else { return };
        self.wires[wire].carries = false;
        for to in 0..2 {
            let idle = if self.wires[wire].ends[to].node == a { a_idle } else { b_idle };
            self.queue(self.clock.instant() + SUSPECT_AFTER, Pending::Quality { wire, to, suspect: true });
            self.queue(self.clock.instant() + idle, Pending::LinkDown { wire, to, superseded: false });
        }
    }

    /// Starts or ends the loss of packets from one node to another. Frames still arrive.
    pub fn lose_packets(&mut self, from: NodeKey, to: NodeKey, lose: bool) {
        self.note(format!("{} packets {from:?} {to:?}", if lose { "lose" } else { "carry" }));
        let cable = self.cable(from, to);
        let side = self.cables[cable].end_of(from).expect("its own cable");
        self.cables[cable].loses[side] = lose;
    }

    /// Mends a cable and connects it.
    pub fn rejoin(&mut self, a: NodeKey, b: NodeKey) {
        self.note(format!("rejoin {a:?} {b:?}"));
        let cable = self.cable(a, b);
        self.cables[cable].whole = true;
        self.connect(cable);
    }

    /// Returns `true` if a cable connects the two nodes and both know it.
    pub fn is_linked(&self, a: NodeKey, b: NodeKey) -> bool {
        let wire = self.cables[self.cable(a, b)].wire;
        wire.is_some_and(|wire| self.wires[wire].carries && self.wires[wire].ends.iter().all(|end| end.up))
    }

    // ---- Shares, uses and messages.

    /// Shares a topic, now and after every restart. Returns its name.
    pub fn share(&mut self, node: NodeKey, topic: &str, sharing: Sharing) -> Name {
        self.note(format!("share {node:?} {topic} {sharing:?}"));
        let now = self.now_at(node);
        let Node { shares, running, .. } = &mut self.nodes[node.0];
        if let Some(running) = running {
            running.share(now, topic, &sharing, &self.directory);
        }
        shares.insert(topic.to_owned(), sharing);
        self.settle(node);
        self.name(node, topic)
    }

    /// Ends a share.
    pub fn unshare(&mut self, node: NodeKey, topic: &str) {
        self.note(format!("unshare {node:?} {topic}"));
        let now = self.now_at(node);
        let Node { shares, running, .. } = &mut self.nodes[node.0];
        shares.remove(topic);
        if let Some(running) = running {
            running.unshare(now, topic);
        }
        self.settle(node);
    }

    /// Uses a topic whenever the owner's catalogue shows it, now and after every restart.
    pub fn use_topic(&mut self, node: NodeKey, owner: NodeKey, topic: &str) {
        self.note(format!("use {node:?} {owner:?}:{topic}"));
        let now = self.now_at(node);
        let Node { uses, running, .. } = &mut self.nodes[node.0];
        uses.insert((owner, topic.to_owned()));
        if let Some(running) = running {
            running.use_topic(now, owner, topic, &self.directory);
        }
        self.settle(node);
    }

    /// Ends the use of a topic.
    pub fn stop_using(&mut self, node: NodeKey, owner: NodeKey, topic: &str) {
        self.note(format!("stop using {node:?} {owner:?}:{topic}"));
        let now = self.now_at(node);
        let Node { uses, running, .. } = &mut self.nodes[node.0];
        uses.remove(&(owner, topic.to_owned()));
        if let Some(running) = running {
            running.stop_using(now, owner, topic);
        }
        self.settle(node);
    }

    /// Joins a name without looking into its owner's catalogue, until the node stops.
    pub fn join_blindly(&mut self, node: NodeKey, owner: NodeKey, topic: &str) {
        self.note(format!("join blindly {node:?} {owner:?}:{topic}"));
        self.join_name(node, owner, self.name(owner, topic));
    }

    /// Joins a name that a node learnt in another way, until the node stops.
    pub fn join_name(&mut self, node: NodeKey, owner: NodeKey, name: Name) {
        let (now, id) = (self.now_at(node), self.identity(owner).node_id());
        if let Some(running) = &mut self.nodes[node.0].running {
            // Like the holder of a token, who knows only the name of the topic.
            running.endpoint.join(now, name, id, JoinKind::Subscribe { describe: true });
        }
        self.settle(node);
    }

    /// Gives a node's endpoint the type description of a topic that it shares.
    pub fn describe(&mut self, node: NodeKey, topic: &str, type_hash: &str, description: &Bytes) {
        self.describe_all(node, &[topic], type_hash, description);
    }

    /// Gives a node's endpoint the type description of several topics at one time.
    pub fn describe_all(&mut self, node: NodeKey, topics: &[&str], type_hash: &str, description: &Bytes) {
        self.note(format!("describe {node:?} {topics:?}"));
        let now = self.now_at(node);
        for topic in topics {
            let name = self.name(node, topic);
            let packed = PackedType::new(type_hash, description).expect("within the bounds");
            if let Some(running) = &mut self.nodes[node.0].running {
                running.endpoint.describe(now, &name, packed);
            }
        }
        if let Some(running) = &mut self.nodes[node.0].running {
            running.endpoint.tell_types(now);
        }
        self.settle(node);
    }

    /// Asks an owner for the type descriptions of these topics, and no longer for others.
    pub fn ask_types(&mut self, node: NodeKey, owner: NodeKey, topics: &[&str]) {
        self.note(format!("ask types {node:?} {owner:?}:{topics:?}"));
        let (now, id) = (self.now_at(node), self.identity(owner).node_id());
        let names = topics.iter().map(|topic| self.name(owner, topic)).collect();
        if let Some(running) = &mut self.nodes[node.0].running {
            running.endpoint.ask_types(now, id, names);
        }
        self.settle(node);
    }

    /// Sets the consumers of a node: for each, the owner and the topic that it uses, and the name of its ROS 2 node.
    pub fn set_consumers(&mut self, node: NodeKey, consumers: &[(NodeKey, &str, &str)]) {
        self.note(format!("consumers {node:?}:{consumers:?}"));
        let now = self.now_at(node);
        let mut by_owner = BTreeMap::<_, Vec<_>>::new();
        for (n, (owner, topic, ros_node)) in (0_u64..).zip(consumers) {
            let consumer = Consumer {
                interface: self.name(*owner, topic),
                id: n.to_be_bytes(),
                role: Role::Subscribe,
                is_alive: true,
                node: RosNode::new("/", ros_node, None).expect("a name that ROS 2 accepts"),
                type_hash: None,
                qos: Qos::default(),
            };
            by_owner.entry(self.identity(*owner).node_id()).or_default().push(consumer);
        }
        if let Some(running) = &mut self.nodes[node.0].running {
            running.endpoint.set_consumers(now, by_owner);
        }
        self.settle(node);
    }

    /// Asks another node for its consumers of what this one owns.
    pub fn ask_consumers(&mut self, node: NodeKey, other: NodeKey) {
        self.note(format!("ask consumers {node:?} {other:?}"));
        let (now, id) = (self.now_at(node), self.identity(other).node_id());
        if let Some(running) = &mut self.nodes[node.0].running {
            running.endpoint.ask_consumers(now, id);
        }
        self.settle(node);
    }

    /// Lets a node tell its time.
    pub fn offer_clock(&mut self, node: NodeKey) {
        self.note(format!("offer clock {node:?}"));
        let now = self.now_at(node);
        if let Some(running) = &mut self.nodes[node.0].running {
            running.endpoint.offer_clock(now);
        }
        self.settle(node);
    }

    /// Asks another node for its time, once more if it did before.
    pub fn ask_clock(&mut self, node: NodeKey, other: NodeKey) {
        self.note(format!("ask clock {node:?} {other:?}"));
        let (now, id) = (self.now_at(node), self.identity(other).node_id());
        if let Some(running) = &mut self.nodes[node.0].running {
            running.endpoint.ask_clock(now, id);
        }
        self.settle(node);
    }

    /// Sets what a node wants of the topics of others: the owner, the topic, and the least time between two messages.
    pub fn set_wishes(&mut self, node: NodeKey, wishes: &[(NodeKey, &str, Duration)]) {
        self.note(format!("wishes {node:?}:{wishes:?}"));
        let now = self.now_at(node);
        let mut by_owner = BTreeMap::<_, Vec<_>>::new();
        for (owner, topic, interval) in wishes {
            let (interface, interval) = (self.name(*owner, topic), Some(*interval));
            let wish = Wish { interface, interval, bits_per_s: None };
            by_owner.entry(self.identity(*owner).node_id()).or_default().push(wish);
        }
        if let Some(running) = &mut self.nodes[node.0].running {
            running.endpoint.set_wishes(now, by_owner);
        }
        self.settle(node);
    }

    /// Asks another node for its wishes about what this one owns.
    pub fn ask_wishes(&mut self, node: NodeKey, other: NodeKey) {
        self.note(format!("ask wishes {node:?} {other:?}"));
        let (now, id) = (self.now_at(node), self.identity(other).node_id());
        if let Some(running) = &mut self.nodes[node.0].running {
            running.endpoint.ask_wishes(now, id);
        }
        self.settle(node);
    }

    /// Lets a node take questions for reports, or no more.
    pub fn offer_reports(&mut self, node: NodeKey, is_offered: bool) {
        self.note(format!("offer reports {node:?} {is_offered}"));
        let now = self.now_at(node);
        if let Some(running) = &mut self.nodes[node.0].running {
            running.endpoint.offer_reports(now, is_offered);
        }
        self.settle(node);
    }

    /// Asks another node for a report. Returns the name of the question.
    pub fn ask_report(&mut self, node: NodeKey, other: NodeKey, question: &ReportQuestion) -> Option<Name> {
        self.note(format!("ask report {node:?} {other:?}"));
        let (now, id) = (self.now_at(node), self.identity(other).node_id());
        let running = self.nodes[node.0].running.as_mut();
        let name = running.map(|running| running.endpoint.ask_report(now, id, question));
        self.settle(node);
        name
    }

    /// Answers a question for a report.
    pub fn answer_report(&mut self, node: NodeKey, sink: SinkId, answer: Result<Report, RefuseReason>) {
        self.note(format!("answer report {node:?} {answer:?}"));
        let now = self.now_at(node);
        if let Some(running) = &mut self.nodes[node.0].running {
            running.endpoint.answer_report(now, sink, answer);
        }
        self.settle(node);
    }

    /// Ends a node's question, or its interest in a topic.
    pub fn leave_name(&mut self, node: NodeKey, name: &Name) {
        self.note(format!("leave {node:?} {}", name.short()));
        let now = self.now_at(node);
        if let Some(running) = &mut self.nodes[node.0].running {
            running.endpoint.leave(now, name);
        }
        self.settle(node);
    }

    /// Asks to publish on another's topic without looking into its catalogue, until the node stops.
    pub fn publish_blindly(&mut self, node: NodeKey, owner: NodeKey, topic: &str, offer: SourceOffer) {
        self.note(format!("publish blindly {node:?} {owner:?}:{topic}"));
        let (now, name, id) = (self.now_at(node), self.name(owner, topic), self.identity(owner).node_id());
        if let Some(running) = &mut self.nodes[node.0].running {
            running.endpoint.join(now, name, id, JoinKind::Publish(offer));
        }
        self.settle(node);
    }

    /// Publishes a small message on a shared topic. Returns its number.
    pub fn publish(&mut self, node: NodeKey, topic: &str) -> MessageId {
        self.publish_bytes(node, topic, 8)
    }

    /// Publishes a message of that size.
    pub fn publish_bytes(&mut self, node: NodeKey, topic: &str, bytes: usize) -> MessageId {
        let (now, id) = (self.now_at(node), MessageId(self.published.len() as u64));
        let Node { running, frozen: None, .. } = &mut self.nodes[node.0] else {
            panic!("{node:?} is frozen and cannot publish")
        };
        let running = running.as_mut().expect("only a running node publishes");
        let source = running.publish(now, topic, id, bytes).expect("only what is shared is published");
        let (run, at, topic) = (running.run, self.clock.elapsed(), topic.to_owned());
        self.published.push(PublishedMessage { id, at, owner: node, by: node, run, topic, source });
        self.settle(node);
        id
    }

    /// Publishes on another's topic whenever the owner's catalogue permits it, now and after every restart.
    pub fn publish_on(&mut self, node: NodeKey, owner: NodeKey, topic: &str) {
        self.note(format!("publish on {node:?} {owner:?}:{topic}"));
        let now = self.now_at(node);
        let Node { publishing, running, .. } = &mut self.nodes[node.0];
        publishing.insert((owner, topic.to_owned()));
        if let Some(running) = running {
            running.publish_on(now, owner, topic, &self.directory);
        }
        self.settle(node);
    }

    /// Publishes a small message on another's topic. Returns `None` while that is not granted.
    pub fn publish_as(&mut self, node: NodeKey, owner: NodeKey, topic: &str) -> Option<MessageId> {
        let (now, id) = (self.now_at(node), MessageId(self.published.len() as u64));
        let name = self.name(owner, topic);
        let running = self.nodes[node.0].running.as_mut()?;
        let source = running.publish_as(now, &name, id, 8)?;
        let (run, at, topic) = (running.run, self.clock.elapsed(), topic.to_owned());
        self.published.push(PublishedMessage { id, at, owner, by: node, run, topic, source });
        self.settle(node);
        Some(id)
    }

    // ---- Time.

    /// Lets time pass.
    pub fn run(&mut self, time: Duration) {
        let until = self.clock.instant() + time;
        self.steps = 0;
        while self.step(until) {}
        self.clock.advance_to(until);
    }

    /// Lets time pass until `done`, at most `bound`. Returns whether it was done.
    pub fn run_until(&mut self, bound: Duration, mut done: impl FnMut(&Self) -> bool) -> bool {
        let until = self.clock.instant() + bound;
        while !done(self) {
            if self.clock.instant() >= until {
                return false;
            }
            self.run(LOOK);
        }
        true
    }

    /// Lets time pass until the use of a topic is granted, and the owner knows it.
    ///
    /// # Panics
    /// If that takes longer than anything in the protocol takes.
    pub fn until_granted(&mut self, node: NodeKey, owner: NodeKey, topic: &str) {
        let done = |w: &Self| {
            w.status(node, owner, topic) == Some(JoinStatus::Granted)
                && w.granted(owner, topic).contains(&node)
        };
        if !self.run_until(PATIENCE, done) {
            let status = self.status(node, owner, topic);
            panic!("{node:?} is not granted {owner:?}:{topic} but {status:?}\n{}", self.trace());
        }
    }

    /// Lets time pass until an event for which `is` holds occurs at `node`, counting from now. Returns its time.
    ///
    /// # Panics
    /// If that takes longer than anything in the protocol takes.
    pub fn until_event(&mut self, node: NodeKey, what: &str, mut is: impl FnMut(&Event) -> bool) -> Duration {
        let mut from = self.log.len();
        let mut at = None;
        let done = self.run_until(PATIENCE, |w| {
            for logged in &w.log[from..] {
                if let What::Event(event) = &logged.what
                    && logged.node == node
                    && is(event)
                {
                    at = at.or(Some(logged.at));
                }
            }
            from = w.log.len();
            at.is_some()
        });
        assert!(done, "{what} never happened at {node:?}\n{}", self.trace());
        at.expect("set when done")
    }

    // ---- Inspection.

    /// Returns the time since the world began.
    pub fn elapsed(&self) -> Duration {
        self.clock.elapsed()
    }

    /// Returns the present.
    pub fn now(&self) -> sgc_wire::Now {
        self.clock.now()
    }

    /// Returns all nodes.
    pub fn nodes(&self) -> impl Iterator<Item = NodeKey> + '_ {
        self.nodes.iter().map(|n| n.key)
    }

    /// Returns `true` unless the node crashed or was shut down.
    pub fn is_running(&self, node: NodeKey) -> bool {
        self.nodes[node.0].running.is_some()
    }

    /// Returns `true` while the node is frozen.
    pub fn is_frozen(&self, node: NodeKey) -> bool {
        self.nodes[node.0].frozen.is_some()
    }

    /// Returns how often a node was started.
    pub fn runs(&self, node: NodeKey) -> u64 {
        self.nodes[node.0].runs
    }

    /// Returns the member as which a node was enrolled.
    pub fn member(&self, node: NodeKey) -> &Member {
        &self.members[node.0]
    }

    /// Returns a node's identity.
    pub fn identity(&self, node: NodeKey) -> &Identity {
        &self.nodes[node.0].identity
    }

    /// Returns the name of a node's topic.
    pub fn name(&self, owner: NodeKey, topic: &str) -> Name {
        self.name_of(owner, &metadata(&self.nodes[owner.0].name, topic))
    }

    /// Returns the name of a node's catalogue.
    pub fn catalogue_name(&self, owner: NodeKey) -> Name {
        self.name_of(owner, &Metadata::catalogue(&self.nodes[owner.0].name))
    }

    /// Returns the name at which a node is asked for its addresses.
    pub fn paths_name(&self, owner: NodeKey) -> Name {
        let id = self.identity(owner).node_id();
        name_of(&id, &paths_blind(&id))
    }

    /// Returns the blind of a node's topic, as in its advertisements.
    pub fn blind(&self, owner: NodeKey, topic: &str) -> sgc_wire::Blind {
        let secret = self.identity(owner).fleet_secret().expect("owners hold the fleet secret");
        TopicSecret::derive(secret, &metadata(&self.nodes[owner.0].name, topic)).blind()
    }

    /// Returns the state of the join of a topic, or `None` if the node does not run or does not want it (yet).
    pub fn status(&self, node: NodeKey, owner: NodeKey, topic: &str) -> Option<JoinStatus> {
        self.nodes[node.0].running.as_ref()?.endpoint.join_status(&self.name(owner, topic))
    }

    /// Returns the nodes to which the owner has granted a topic, in ascending order.
    pub fn granted(&self, owner: NodeKey, topic: &str) -> Vec<NodeKey> {
        let mut nodes: Vec<_> = self.granted_sinks(owner, topic).into_iter().map(|(_, node)| node).collect();
        nodes.sort_unstable();
        nodes
    }

    /// Returns the sinks to which the owner has granted a topic.
    pub fn granted_sinks(&self, owner: NodeKey, topic: &str) -> Vec<(SinkId, NodeKey)> {
        let Some(running) = &self.nodes[owner.0].running else { return Vec::new() };
        let granted = running.endpoint.granted(&self.name(owner, topic)).into_iter();
        granted.filter_map(|(sink, id)| Some((sink, *self.directory.by_id.get(&id)?))).collect()
    }

    /// Returns the last catalogue of an owner that a node received.
    pub fn catalogue(&self, node: NodeKey, owner: NodeKey) -> Option<&Catalogue> {
        self.nodes[node.0].running.as_ref()?.catalogues.get(&owner)
    }

    /// Returns the topics in the last catalogue of an owner that a node received.
    pub fn catalogue_topics(&self, node: NodeKey, owner: NodeKey) -> Vec<String> {
        let entries = self.catalogue(node, owner).map(|c| c.entries.as_slice()).unwrap_or_default();
        let mut topics: Vec<_> = entries.iter().map(|e| e.metadata.ros_name.clone()).collect();
        topics.sort_unstable();
        topics
    }

    /// Returns the statistics of a node's router; all zero if the node does not run.
    pub fn stats(&self, node: NodeKey) -> RouterStats {
        self.nodes[node.0].running.as_ref().map(|r| r.router.stats()).unwrap_or_default()
    }

    /// Returns how many milliseconds the clock of a neighbour is ahead of a node's, as the node was told.
    pub fn clock_ahead_ms(&self, node: NodeKey, neighbour: NodeKey) -> Option<i64> {
        let running = self.nodes[node.0].running.as_ref()?;
        let is_there = |(wire, side): &(usize, usize)| self.wires[*wire].ends[1 - side].node == neighbour;
        let link = running.links.iter().find(|(_, end)| is_there(end)).map(|(link, _)| *link)?;
        running.router.clock_ahead_ms(link)
    }

    /// Returns the names with a forwarding entry at a node.
    pub fn forwarding(&self, node: NodeKey) -> Vec<Name> {
        self.nodes[node.0].running.iter().flat_map(|r| r.fib.keys().copied()).collect()
    }

    /// Returns the sinks in the forwarding entry of a name at a node.
    pub fn forwarding_sinks(&self, node: NodeKey, name: &Name) -> Vec<SinkId> {
        let entry = self.nodes[node.0].running.as_ref().and_then(|r| r.fib.get(name));
        entry.map(|e| e.sinks.iter().map(|(sink, _)| *sink).collect()).unwrap_or_default()
    }

    /// Returns the distance from a node to the owner of a name in links, or `None` without a route.
    pub fn distance(&self, node: NodeKey, name: &Name) -> Option<u8> {
        let (mut here, mut links) = (node, 0);
        loop {
            let next = self.next_hop(here, name)?;
            if next == here {
                return Some(links);
            }
            (here, links) = (next, links + 1);
            if usize::from(links) > self.nodes.len() {
                return None;
            }
        }
    }

    /// Returns the neighbour on a node's route to a name, or the node itself for its own. Returns `None` without a
    /// route, or if the link is gone.
    pub fn next_hop(&self, node: NodeKey, name: &Name) -> Option<NodeKey> {
        let running = self.nodes[node.0].running.as_ref()?;
        let (link, _) = running.router.route(name)?;
        if link == LinkId::LOCAL {
            return Some(node);
        }
        let (wire, side) = *running.links.get(&link)?;
        let far = &self.wires[wire].ends[1 - side];
        let there = self.nodes[far.node.0].running.as_ref()?;
        (self.wires[wire].carries && far.up && there.run == far.run).then_some(far.node)
    }

    /// Follows the data of a name from every node and link. Returns the nodes of the first circle. Routes may loop for
    /// a moment, while routers learn a change one after the other; data may not.
    pub fn circle(&self, name: &Name) -> Option<Vec<NodeKey>> {
        let mut done = BTreeSet::new();
        for start in self.nodes() {
            let entry = self.nodes[start.0].running.as_ref().and_then(|r| r.fib.get(name));
            for tree in entry.iter().flat_map(|e| &e.trees) {
                let mut way = Vec::new();
                if let Some(circle) = self.circle_from(name, (start, tree.up), &mut way, &mut done) {
                    return Some(circle);
                }
            }
        }
        None
    }

    /// Depth first: packets that came to a node over a link.
    fn circle_from(
        &self,
        name: &Name,
        at: (NodeKey, LinkId),
        way: &mut Vec<(NodeKey, LinkId)>,
        done: &mut BTreeSet<(NodeKey, LinkId)>,
    ) -> Option<Vec<NodeKey>> {
        if way.contains(&at) {
            return Some(way.iter().chain([&at]).map(|(node, _)| *node).collect());
        }
        if !done.insert(at) {
            return None;
        }
        let running = self.nodes[at.0.0].running.as_ref()?;
        let links: Vec<_> = running.fib.get(name)?.egress(at.1).filter(|l| *l != LinkId::LOCAL).collect();
        way.push(at);
        let circle = links.into_iter().find_map(|link| {
            let (wire, side) = *running.links.get(&link)?;
            let far = &self.wires[wire].ends[1 - side];
            self.circle_from(name, (far.node, far.link), way, done)
        });
        way.pop();
        circle
    }

    /// Returns the numbers of a topic's messages that a node received, over all its runs, in order of arrival.
    pub fn received(&self, node: NodeKey, owner: NodeKey, topic: &str) -> Vec<MessageId> {
        let of_topic = |r: &&ReceivedMessage| (r.node, r.owner) == (node, owner) && r.topic == topic;
        self.received.iter().filter(of_topic).map(|r| r.id).collect()
    }

    /// Returns all received messages.
    pub fn all_received(&self) -> &[ReceivedMessage] {
        &self.received
    }

    /// Returns all published messages.
    pub fn all_published(&self) -> &[PublishedMessage] {
        &self.published
    }

    /// Returns the whole log.
    pub fn log(&self) -> &[LogEntry] {
        &self.log
    }

    /// Returns the reasons for which a node's router refused frames, as keys.
    pub fn router_drops(&self, node: NodeKey) -> Vec<&'static str> {
        let of_node = self.log.iter().filter(|l| l.node == node);
        of_node
            .filter_map(|l| match &l.what {
                What::RouterDrop(dropped) => Some(dropped.reason.key()),
                _ => None,
            })
            .collect()
    }

    /// Returns the reasons for which a node's data path refused packets.
    pub fn data_drops(&self, node: NodeKey) -> Vec<DataDrop> {
        let of_node = self.log.iter().filter(|l| l.node == node);
        of_node
            .filter_map(|l| match &l.what {
                What::DataDrop { why, .. } => Some(*why),
                _ => None,
            })
            .collect()
    }

    /// Returns the number of messages that a node knows it will never get.
    pub fn lost(&self, node: NodeKey) -> u64 {
        let of_node = self.log.iter().filter(|l| l.node == node);
        let lost = of_node.filter_map(|l| match &l.what {
            What::SinkLost { messages, .. } => Some(*messages),
            _ => None,
        });
        lost.sum()
    }

    /// Returns the trace of actions on this world, for the output of a failing test.
    pub fn trace(&self) -> String {
        let mut text = format!("seed {}\n", self.config.seed);
        for line in &self.trace {
            let _ = writeln!(text, "{line}");
        }
        text
    }

    /// Adds a line to the trace.
    pub fn note(&mut self, line: String) {
        let at = self.clock.elapsed();
        self.trace.push(format!("{:>10.3} {line}", at.as_secs_f64()));
    }

    // ---- Internals.

    fn name_of(&self, owner: NodeKey, metadata: &Metadata) -> Name {
        let identity = self.identity(owner);
        match identity.fleet_secret() {
            Some(secret) => derive_name(secret, &identity.node_id(), metadata),
            // A router owns no name, so this is one that does not exist.
            None => name_of(&identity.node_id(), &sgc_wire::Blind([0; 32])),
        }
    }

    fn cables_of(&self, node: NodeKey) -> Vec<usize> {
        (0..self.cables.len()).filter(|c| self.cables[*c].end_of(node).is_some()).collect()
    }

    pub(crate) fn cable(&self, a: NodeKey, b: NodeKey) -> usize {
        let found = self.cables.iter().position(|c| c.end_of(a).is_some() && c.end_of(b).is_some());
        found.expect("a cable between the two")
    }

    pub(crate) fn wire_between(&self, from: NodeKey, to: NodeKey) -> (usize, usize) {
        let wire = self.cables[self.cable(from, to)].wire.expect("the two are connected");
        let side = self.wires[wire].ends.iter().position(|e| e.node == from);
        (wire, side.expect("the wire of both"))
    }

    /// Connects a cable that is not cut and whose ends run and are not connected.
    fn connect(&mut self, cable: usize) {
        let Cable { ends, whole, wire, is_direct, .. } = &self.cables[cable];
        let ends = *ends;
        if *is_direct || !whole || wire.is_some() || ends.iter().any(|n| !self.is_running(*n)) {
            return;
        }
        let wire = self.wires.len();
        self.cables[cable].wire = Some(wire);
        let instant = self.clock.instant();
        let nows = [0, 1].map(|side| self.now_at(ends[side]));
        let ends = [0, 1].map(|side| {
            let peer = Neighbour::from(self.identity(ends[1 - side]).as_peer());
            let running = self.nodes[ends[side].0].running.as_mut().expect("checked above");
            let link = running.new_link(nows[side], wire, side, peer);
            let (run, data) = (running.run, BTreeMap::new());
            WireEnd { node: ends[side], run, link, up: true, control: instant, data }
        });
        let nodes = [ends[0].node, ends[1].node];
        self.wires.push(Wire { cable, carries: true, ends, path: None });
        for (to, node) in nodes.into_iter().enumerate() {
            self.settle(node);
            self.queue(instant, Pending::Quality { wire, to, suspect: false });
        }
    }

    /// Ends a node. If it ends in order, its last frames still arrive.
    fn stop(&mut self, node: NodeKey, idle: Duration, in_order: bool) {
        let Node { running, frozen, .. } = &mut self.nodes[node.0];
        *frozen = None;
        let Some(running) = running.take() else { return };
        for (wire, side) in running.links.into_values() {
            self.wires[wire].ends[side].up = false;
            if in_order {
                self.hang_up(wire, side, false);
            } else if self.wires[wire].carries {
                self.wires[wire].carries = false;
                let (at, to) = (self.clock.instant(), 1 - side);
                self.queue(at + SUSPECT_AFTER, Pending::Quality { wire, to, suspect: true });
                self.queue(at + idle, Pending::LinkDown { wire, to, superseded: false });
                self.unplug(wire);
            }
        }
    }

    /// Tells the far end that this end closed, after all frames sent before.
    fn hang_up(&mut self, wire: usize, side: usize, superseded: bool) {
        self.wires[wire].ends[side].up = false;
        // The peer of a path that is silent learns nothing.
        if self.wires[wire].carries && self.passes(wire, side) {
            let at = self.arrival(wire, side);
            self.queue(at, Pending::LinkDown { wire, to: 1 - side, superseded });
        }
        self.unplug(wire);
    }

    pub(crate) fn unplug(&mut self, wire: usize) {
        let cable = self.wires[wire].cable;
        if self.cables[cable].wire == Some(wire) {
            // Two hosts may have several links.
            let is_other = |(other, known): &(usize, &Wire)| {
                *other != wire
                    && known.cable == cable
                    && known.carries
                    && known.path.is_some()
                    && known.ends.iter().any(|end| end.up)
            };
            let other = self.wires.iter().enumerate().rfind(is_other).map(|(other, _)| other);
            let cable = &mut self.cables[cable];
            cable.wire = other;
            cable.whole &= !cable.is_direct || other.is_some();
        }
    }

    pub(crate) fn queue(&mut self, at: Instant, pending: Pending) {
        self.queued += 1;
        self.queue.insert((at, self.queued), pending);
    }

    /// Returns the time at which a frame sent now arrives, which is not before earlier ones.
    fn arrival(&mut self, wire: usize, side: usize) -> Instant {
        let Wire { cable, ends, .. } = &mut self.wires[wire];
        let takes = self.cables[*cable].latency + self.dice.time(&self.config.jitter);
        let at = (self.clock.instant() + takes).max(ends[side].control);
        ends[side].control = at;
        at
    }

    fn send_frame(&mut self, node: NodeKey, link: LinkId, frame: Control) {
        let Some((wire, side)) =
            self.nodes[node.0].running.as_ref().and_then(|r| r.links.get(&link)).copied()
        else {
            return;
        };
        let cable = self.wires[wire].cable;
        let cable_side = self.cables[cable].end_of(node).expect("its own cable");
        let Some(mut tamper) = self.cables[cable].tampers[cable_side].take() else {
            return self.carry_frame(wire, side, &frame);
        };
        for frame in tamper(&frame) {
            self.carry_frame(wire, side, &frame);
        }
        self.cables[cable].tampers[cable_side] = Some(tamper);
    }

    pub(crate) fn carry_frame(&mut self, wire: usize, side: usize, frame: &Control) {
        if !self.passes(wire, side) {
            self.wait_for_path(wire, Content::Frame(side, frame.clone()));
            return;
        }
        let ends = &self.wires[wire].ends;
        let (from, to) = (ends[side].node, ends[1 - side].node);
        if let Some(captured) = &mut self.captured {
            captured.push(CapturedFrame { from, to, frame: frame.clone() });
        }
        if self.tracing == Tracing::Frames {
            self.note(format!("  {from:?} -> {to:?} {}", frame_text(frame)));
        }
        let at = self.arrival(wire, side);
        self.queue(at, Pending::Frame { wire, to: 1 - side, bytes: frame.to_vec() });
    }

    pub(crate) fn carry_packet(&mut self, wire: usize, side: usize, packet: Packet) {
        if self.captured.is_some() {
            let ends = &self.wires[wire].ends;
            let (from, to, at) = (ends[side].node, ends[1 - side].node, self.clock.elapsed());
            self.captured_packets.push(CapturedPacket { from, to, at, packet: packet.clone() });
        }
        let cable = &self.cables[self.wires[wire].cable];
        let loses = cable.end_of(self.wires[wire].ends[side].node).is_some_and(|end| cable.loses[end]);
        let passes = self.passes(wire, side);
        if !passes && packet.header.reliable {
            self.wait_for_path(wire, Content::Packet(side, packet));
            return;
        }
        if loses || !passes || (!packet.header.reliable && self.dice.chance(self.config.loss_percent)) {
            let (name, ingress) = (packet.header.name, self.wires[wire].ends[side].link);
            let node = self.wires[wire].ends[side].node;
            return self.write_log(node, What::DataDrop { name, ingress, why: DataDrop::Lost });
        }
        if let Some(copies) = &mut self.copies {
            let header = &packet.header;
            *copies.entry((wire, side, header.source, header.seq, header.index, header.to)).or_default() += 1;
        }
        if !packet.header.reliable && self.dice.chance(self.config.repeat_percent) {
            // Datagrams may be repeated, delayed and reordered.
            let late = self.cables[self.wires[wire].cable].latency * self.dice.below(4) as u32;
            let at = self.clock.instant() + late;
            self.queue(at, Pending::Packet { wire, to: 1 - side, packet: packet.clone() });
        }
        let Wire { cable, ends, .. } = &mut self.wires[wire];
        let takes = self.cables[*cable].latency + self.dice.time(&self.config.jitter);
        let last = ends[side].data.entry(packet.header.name).or_insert(self.clock.instant());
        *last = (self.clock.instant() + takes).max(*last);
        let at = *last;
        self.queue(at, Pending::Packet { wire, to: 1 - side, packet });
    }

    /// Handles the next event due by `until`. Returns `false` if there is none.
    fn step(&mut self, until: Instant) -> bool {
        let due = self.queue.first_key_value().map(|((at, _), _)| *at);
        let wake = self
            .nodes
            .iter()
            .filter(|n| n.frozen.is_none())
            .filter_map(|n| Some((n.running.as_ref()?.wake?, n.key)))
            .min();
        let at = due.into_iter().chain(wake.map(|(at, _)| at)).min().filter(|at| *at <= until);
        let Some(at) = at else { return false };
        self.steps += 1;
        assert!(self.steps <= STEPS_MAX, "the network runs in circles\n{}", self.trace());
        self.clock.advance_to(at);
        if due == Some(at) {
            let (_, pending) = self.queue.pop_first().expect("one is due");
            self.deliver(pending);
        } else if let Some((_, node)) = wake {
            let now = self.now_at(node);
            let running = self.nodes[node.0].running.as_mut().expect("only running nodes have timers");
            running.handle_timeout(now);
            self.settle(node);
            let again = self.nodes[node.0].running.as_ref().and_then(|r| r.wake);
            assert!(again != Some(at), "a timer of {node:?} that is due is not served\n{}", self.trace());
        }
        true
    }

    fn deliver(&mut self, pending: Pending) {
        let (wire, to) = match &pending {
            Pending::Input { .. }
            | Pending::Dial(_)
            | Pending::Probe { .. }
            | Pending::Redial { .. }
            | Pending::Store { .. } => return self.deliver_unlinked(pending),
            Pending::Frame { wire, to, .. }
            | Pending::Packet { wire, to, .. }
            | Pending::Quality { wire, to, .. }
            | Pending::LinkDown { wire, to, .. } => (*wire, *to),
        };
        let Wire { carries, ends, .. } = &mut self.wires[wire];
        let end = &mut ends[to];
        let (node, link, run) = (end.node, end.link, end.run);
        let is_down = matches!(pending, Pending::LinkDown { .. });
        let is_seen = is_down || matches!(pending, Pending::Quality { .. });
        if !end.up || !(*carries || is_seen) {
            return;
        }
        end.up &= !is_down;
        if self.nodes[node.0].running.as_ref().is_none_or(|r| r.run != run) {
            return;
        }
        let arrival = match pending {
            Pending::Frame { bytes, .. } => {
                let frame = Control::from_slice(&bytes).expect("a frame reads as it was written");
                Arrival::Frame(link, frame)
            }
            Pending::Packet { packet, .. } => {
                let mut bytes = Vec::with_capacity(packet.encoded_bytes());
                packet.header.put_into(&mut bytes);
                packet.payload.copy_into(&mut bytes);
                let packet = Packet::from_datagram(bytes.into()).expect("a packet reads as it was written");
                Arrival::Packet(link, packet)
            }
            Pending::Quality { suspect, .. } => {
                let cable = self.wires[wire].cable;
                Arrival::Quality(link, 2 * self.cables[cable].latency, suspect)
            }
            Pending::LinkDown { superseded, .. } => {
                self.unplug(wire);
                if superseded {
                    let cable = self.wires[wire].cable;
                    self.queue(self.clock.instant() + DISPLACED_MIN, Pending::Redial { cable });
                }
                Arrival::LinkDown(link, superseded)
            }
            Pending::Input { .. }
            | Pending::Dial(_)
            | Pending::Probe { .. }
            | Pending::Redial { .. }
            | Pending::Store { .. } => return,
        };
        self.arrive(node, arrival);
    }

    /// Handles an event that is of no link.
    fn deliver_unlinked(&mut self, pending: Pending) {
        match pending {
            Pending::Input { node, run, arrival } => {
                let Some(running) = &self.nodes[node.0].running else { return };
                if running.run == run {
                    self.arrive(node, arrival);
                }
            }
            Pending::Dial(dial) => self.try_dial(dial),
            Pending::Probe { wire } => self.probe(wire),
            Pending::Redial { cable } => self.connect(cable),
            Pending::Store { node, run, op } => self.serve_store((node, run), &op),
            _ => {}
        }
    }

    pub(crate) fn arrive(&mut self, node: NodeKey, arrival: Arrival) {
        let now = self.now_at(node);
        let Node { running, frozen, .. } = &mut self.nodes[node.0];
        match (frozen, running) {
            (Some(backlog), _) => backlog.push_back(arrival),
            (None, Some(running)) => {
                running.handle(now, arrival);
                self.settle(node);
            }
            (None, None) => {}
        }
    }

    /// Drains a node and carries out its effects.
    pub(crate) fn settle(&mut self, node: NodeKey) {
        let now = self.now_at(node);
        let mut effects = VecDeque::new();
        loop {
            match &mut self.nodes[node.0].running {
                Some(running) => effects.extend(running.drain(now)),
                None => return,
            }
            if effects.is_empty() {
                return;
            }
            for effect in std::mem::take(&mut effects) {
                self.perform(node, effect);
            }
        }
    }

    fn perform(&mut self, node: NodeKey, effect: Effect) {
        match effect {
            Effect::Frame(link, frame) => self.send_frame(node, link, frame),
            Effect::Packet(link, packet) => {
                let links = self.nodes[node.0].running.as_ref().map(|r| &r.links);
                if let Some((wire, side)) = links.and_then(|l| l.get(&link)).copied() {
                    self.carry_packet(wire, side, packet);
                }
            }
            Effect::Close(link, reason) => {
                let superseded = matches!(reason, LinkClose::Superseded { .. });
                self.write_log(node, What::Closed { reason });
                let now = self.now_at(node);
                let Some(running) = &mut self.nodes[node.0].running else { return };
                if let Some((wire, side)) = running.links.get(&link).copied() {
                    running.link_down(now, link);
                    self.hang_up(wire, side, superseded);
                }
            }
            Effect::HangUp(link) => {
                let now = self.now_at(node);
                let Some(running) = &mut self.nodes[node.0].running else { return };
                if let Some((wire, side)) = running.links.get(&link).copied() {
                    running.link_down(now, link);
                    self.hang_up(wire, side, false);
                }
            }
            Effect::Check(to, datagram) => self.send_check(node, to, datagram),
            Effect::Dial(peer, to) => self.dial(node, peer, to),
            Effect::Look => self.look_for_addresses(node),
            Effect::Store(op) => self.operate_store(node, op),
            Effect::Delivered { owner, topic, id, use_number } => {
                let (at, run) = (self.clock.elapsed(), self.nodes[node.0].runs);
                self.received.push(ReceivedMessage { id, at, node, run, use_number, owner, topic });
            }
            Effect::Trust(anchors) => self.nodes[node.0].anchors = Some(anchors),
            Effect::Log(what) => self.write_log(node, what),
        }
    }

    fn write_log(&mut self, node: NodeKey, what: What) {
        if self.tracing != Tracing::Transitions {
            self.note(format!("  {node:?} {what:?}"));
        }
        self.log.push(LogEntry { at: self.clock.elapsed(), node, what });
    }
}

fn frame_text(frame: &Control) -> String {
    match frame {
        Control::Advert { cost, signed } => match AdvertBody::from_slice(&signed.body) {
            Ok(AdvertBody { seq, withdraw, blinds, .. }) => {
                let kind = if withdraw { "Withdrawal" } else { "Advert" };
                let blinds: Vec<_> = blinds.iter().map(|b| b.short()).collect();
                format!("{kind} at {cost} of {}: {}", seq.wrapping_sub(GENESIS.0), blinds.join(" "))
            }
            Err(_) => "malformed Advert".to_owned(),
        },
        Control::Join { signed } => match JoinBody::from_slice(&signed.body) {
            Ok(JoinBody { name, sink, .. }) => format!("Join {name:?} {sink:?}"),
            Err(_) => "malformed Join".to_owned(),
        },
        Control::Answer { signed } => match AnswerBody::from_slice(&signed.body) {
            Ok(AnswerBody { name, sink, serial, answer }) => {
                let text = if matches!(answer, Answer::Grant { .. }) { "Grant" } else { "Refuse" };
                format!("{text} {name:?} {sink:?} {serial}")
            }
            Err(_) => "malformed Answer".to_owned(),
        },
        Control::LinkState { signed } => match LinkStateBody::from_slice(&signed.body) {
            Ok(LinkStateBody { seq, routers, attached, .. }) => {
                let routers: Vec<_> =
                    routers.iter().map(|a| format!("{}:{}", a.node.short(), a.cost)).collect();
                let attached: Vec<_> = attached.iter().map(|t| t.short()).collect();
                format!(
                    "LinkState {}: {} + {}",
                    seq.wrapping_sub(GENESIS.0),
                    routers.join(" "),
                    attached.join(" ")
                )
            }
            Err(_) => "malformed LinkState".to_owned(),
        },
        other => format!("{other:?}"),
    }
}
