//! The router's state machine: frames and link changes in, frames and forwarding entries out.
//!
//! The network is in `topology.rs`, names are in `names.rs`, trees in `tree.rs`, certificates and lists in `trust.rs`.

use std::collections::{BTreeMap, BTreeSet, VecDeque};
use std::fmt;
use std::sync::Arc;
use std::time::{Duration, Instant};

use sgc_trust::{CLOCK_SKEW_MAX, CaFingerprint, CrlError, Identity, SignedError, TrustAnchors};
use sgc_wire::{ClockWatch, Control, Hello, Name, NodeId, Now, PeerClock, SinkId, UnixMillis};
use smallvec::SmallVec;

use crate::FibEntry;
use crate::limits::{Allowance, Limits};
use crate::links::{LinkState, Neighbour};
use crate::lists::ListAllowances;
use crate::mapping::{Mapping, MappingKind};
use crate::names::Names;
use crate::topology::{RouteStats, Topology};
use crate::tree::Tree;

/// A link of this node, by number. Numbers are never used again while the process lives.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub struct LinkId(pub u32);

impl LinkId {
    /// The link to this node's own endpoint; always up.
    pub const LOCAL: Self = Self(0);
}

impl fmt::Display for LinkId {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        if *self == Self::LOCAL { f.write_str("local") } else { write!(f, "link {}", self.0) }
    }
}

/// Links of one node; its link state must have room for each.
const LINKS_MAX: usize = sgc_wire::ADJACENCIES_MAX + sgc_wire::ATTACHED_MAX;

/// Number of allowances below which unused ones are kept.
const ALLOWANCES_MIN: usize = 1024;

/// Least time until a neighbour is told everything once more because a clock was set.
const TELL_AGAIN_EVERY: Duration = Duration::from_secs(60);

/// Returns `true` if clocks differ so much that either node refuses the other's signed bodies.
pub fn clocks_differ(ahead_ms: i64) -> bool {
    ahead_ms.unsigned_abs() > CLOCK_SKEW_MAX.as_millis() as u64
}

/// Parameters of a router.
#[derive(Clone, Debug)]
pub struct RouterConfig {
    /// This node's identity, for signing.
    pub identity: Arc<Identity>,
    /// This node's id.
    pub node: NodeId,
    /// Whether it carries others' names.
    pub transit: bool,
    /// Random number of this run.
    pub incarnation: u64,
    /// Beginning of this run: earlier advertisements of the node are void.
    pub started: UnixMillis,
    /// Mapping of names to owners; unused unless `transit`.
    pub mapping: MappingKind,
    /// The trust anchors.
    pub anchors: Arc<TrustAnchors>,
    /// Bounds.
    pub limits: Limits,
}

/// Work for the driver.
#[derive(Clone, Debug)]
pub enum Output {
    /// Send a frame over a link; over [`LinkId::LOCAL`], hand it to the endpoint.
    Send {
        /// The link.
        link: LinkId,
        /// The frame.
        frame: Control,
    },
    /// The forwarding of a name changed; `None` ends it.
    Forward {
        /// The name.
        name: Name,
        /// The new entry.
        entry: Option<FibEntry>,
    },
    /// Close a link; the driver then reports it down.
    Close {
        /// The link.
        link: LinkId,
        /// The reason.
        reason: LinkClose,
    },
    /// The trust anchors changed, because a newer revocation list came. The driver stores them, and passes them to
    /// everything else that verifies certificates.
    Trust(Arc<TrustAnchors>),
    /// Call [`Router::handle_flushed`] once the link has taken all earlier frames; the router has more for it than a
    /// queue can hold.
    Flush {
        /// The link.
        link: LinkId,
    },
    /// A frame or body was dropped: count it and, where it matters, log it.
    Dropped(RouterDrop),
    /// Nothing more to do until this time, or until something happens.
    Timeout(Option<Instant>),
}

/// The reason why a link is closed.
#[derive(Clone, Debug, PartialEq, Eq, PartialOrd, Ord, thiserror::Error)]
pub enum LinkClose {
    /// Another run of the node has the place of this one.
    #[error("the node's identity is in use at another place")]
    Superseded {
        /// The link of the other run, if it is here; otherwise the other run is linked to another router.
        by: Option<LinkId>,
        /// Whether the closed run is known to live, because it came back after it was superseded once. The process of a
        /// run that just greeted anew is usually gone.
        alive: bool,
    },
    /// A frame came before the greeting, or a second greeting.
    #[error("the peer did not greet as the protocol says")]
    Greeting,
    /// The peer said goodbye.
    #[error("the peer closed in good order")]
    Goodbye,
    /// The link leads to this very node.
    #[error("the link leads to this node itself")]
    Loop,
    /// The node's certificate was revoked, or its CA is no longer trusted.
    #[error("the peer's certificate is revoked")]
    Revoked,
    /// The node's certificate has expired.
    #[error("the peer's certificate has expired")]
    Expired,
    /// The node has too many links.
    #[error("the peer has too many links")]
    TooMany,
    /// The peer sent too many bodies that do not verify.
    #[error("the peer keeps sending bodies that do not verify")]
    Forgeries,
}

/// A dropped frame or body, and its sender.
#[derive(Clone, Debug)]
pub struct RouterDrop {
    /// The link that brought it.
    pub link: LinkId,
    /// The node at its other end, if the link is known.
    pub peer: Option<NodeId>,
    /// The reason.
    pub reason: DropReason,
}

/// The reason why a frame or body was dropped.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
pub enum DropReason {
    /// A signed body that does not verify.
    #[error("{what} not believed: {why}")]
    NotVerified {
        /// Advertisement, join or answer.
        what: &'static str,
        /// The error of the verification.
        why: SignedError,
    },
    /// A node that carries nobody else's names advertised for another owner.
    #[error("advertises names of another node, {}", owner.short())]
    NotOwner {
        /// The owner in the advertisement.
        owner: NodeId,
    },
    /// An answer that no known key of the owner signed. Its sink asks again, and the neighbour is asked for the owner's
    /// advertisement: the owner may have another certificate by now.
    #[error("answer is not signed with a known key of node {}", owner.short())]
    OwnerKey {
        /// The owner of the name.
        owner: NodeId,
    },
    /// An advertisement that is older than the known one, or withdrawn.
    #[error("advertisement {seq} is not newer than {known}")]
    Stale {
        /// Its sequence number.
        seq: u64,
        /// The known number.
        known: u64,
    },
    /// Too many hops.
    #[error("hop limit reached")]
    HopLimit,
    /// A bound of [`Limits`] is reached.
    #[error("limit reached: {what}")]
    Limit {
        /// The bound.
        what: &'static str,
    },
    /// The neighbour has brought the most questions for names, and the table is full. It may be honest: it brings the
    /// questions of the nodes behind it.
    #[error("too many questions for names are under way")]
    QuestionsFull,
    /// The neighbour has brought too many announcements without news; this one was not looked at.
    #[error("brings too many old announcements")]
    StaleFlood,
    /// A frame for an unknown name or sink.
    #[error("{what} for an unknown name or sink")]
    Unknown {
        /// Kind of frame.
        what: &'static str,
    },
    /// A frame from a neighbour that is not on the route to the owner.
    #[error("{what} from a neighbour that is not on the way to the owner")]
    WrongWay {
        /// Kind of frame.
        what: &'static str,
    },
    /// A frame over a link that is not up.
    #[error("a frame over a link that is not up")]
    NoLink,
    /// A revocation list that is not believed.
    #[error("revocation list not believed: {0}")]
    Crl(CrlError),
    /// A new revocation list beyond the allowance of its CA. The newest such list waits.
    #[error("new revocation lists of the CA {ca} come faster than one a second; the newest of them waits")]
    ListFlood {
        /// The CA that signed it.
        ca: CaFingerprint,
    },
    /// A signed body whose time is not near the time here.
    #[error(
        "{what} signed at {signed}, which is not near {now}: one of the two clocks is wrong, or it is a replay"
    )]
    Clock {
        /// Advertisement, join or link state.
        what: &'static str,
        /// The time in the body.
        signed: UnixMillis,
        /// The time here.
        now: UnixMillis,
    },
    /// A neighbour claims to be a router without the certificate of one.
    #[error(
        "says that it carries others' names, but its certificate does not let it: enroll it with --router or --may-route"
    )]
    NotRouter,
}

impl DropReason {
    /// Returns `true` for reasons that an honest neighbour never causes; the others happen when frames cross.
    pub fn is_suspicious(&self) -> bool {
        match self {
            Self::NotVerified { .. }
            | Self::NotOwner { .. }
            | Self::HopLimit
            | Self::Limit { .. }
            | Self::StaleFlood
            | Self::Crl(_)
            | Self::Clock { .. }
            | Self::NotRouter => true,
            // An honest neighbour passes on what the CA signs.
            Self::ListFlood { .. }
            | Self::OwnerKey { .. }
            | Self::QuestionsFull
            | Self::Stale { .. }
            | Self::Unknown { .. }
            | Self::WrongWay { .. }
            | Self::NoLink => false,
        }
    }

    /// Returns a short, stable name for counters.
    pub fn key(&self) -> &'static str {
        match self {
            Self::NotVerified { .. } => "not_verified",
            Self::NotOwner { .. } => "not_owner",
            Self::OwnerKey { .. } => "owner_key",
            Self::Stale { .. } => "stale",
            Self::HopLimit => "hop_limit",
            Self::Limit { .. } => "limit",
            Self::QuestionsFull => "questions_full",
            Self::StaleFlood => "stale_flood",
            Self::Unknown { .. } => "unknown",
            Self::WrongWay { .. } => "wrong_way",
            Self::NoLink => "no_link",
            Self::Crl(_) => "crl",
            Self::ListFlood { .. } => "crl_flood",
            Self::Clock { .. } => "clock",
            Self::NotRouter => "not_router",
        }
    }
}

/// Sizes of the router's tables, for status.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct RouterStats {
    /// Names with a route.
    pub routed_names: usize,
    /// Names in any state.
    pub names: usize,
    /// Nodes that described their links.
    pub nodes: usize,
    /// Branches, pending ones included.
    pub branches: usize,
    /// Withdrawn names remembered.
    pub tombstones: usize,
}

/// The state machine.
#[derive(Debug)]
pub struct Router {
    pub(crate) config: RouterConfig,
    pub(crate) mapping: Box<dyn Mapping>,
    pub(crate) links: BTreeMap<LinkId, LinkState>,
    /// The links to each neighbour, ascending.
    pub(crate) links_of: BTreeMap<NodeId, SmallVec<[LinkId; 2]>>,
    allowances: BTreeMap<NodeId, Allowance>,
    /// Number of allowances at which the router looks for unused ones.
    allowances_max: usize,
    pub(crate) topology: Topology,
    pub(crate) names: Names,
    pub(crate) trees: BTreeMap<Name, Tree>,
    /// Branches that wait for something, by their deadlines.
    pub(crate) deadlines: BTreeSet<(Instant, Name, SinkId)>,
    /// Time at which to pass on announcements beyond the allowance of their signer.
    pub(crate) late_at: Option<Instant>,
    pub(crate) lists: ListAllowances,
    pub(crate) outputs: VecDeque<Output>,
    /// Set once another run of this node took over from this one.
    yields: bool,
    clock: ClockWatch,
    /// The driver's last time.
    pub(crate) now: Now,
}

impl Router {
    /// Returns a router with only its local link.
    pub fn new(config: RouterConfig, now: Now) -> Self {
        let mut local = LinkState::local(config.node);
        local.hello = Some(Hello {
            minor: 0,
            incarnation: config.incarnation,
            transit: false,
            yields: false,
            started: config.started,
        });
        let mut topology = Topology::default();
        topology.begin(now.instant, config.transit);
        Self {
            mapping: config.mapping.build(),
            config,
            links: BTreeMap::from([(LinkId::LOCAL, local)]),
            links_of: BTreeMap::new(),
            allowances: BTreeMap::new(),
            allowances_max: 2 * ALLOWANCES_MIN,
            topology,
            names: Names::default(),
            trees: BTreeMap::new(),
            deadlines: BTreeSet::new(),
            late_at: None,
            lists: ListAllowances::default(),
            outputs: VecDeque::new(),
            yields: false,
            clock: ClockWatch::new(now),
            now,
        }
    }

    /// Takes a new link to an authenticated node, and greets it.
    pub fn handle_link_up(&mut self, now: Now, link: LinkId, neighbour: Neighbour) {
        debug_assert_ne!(link, LinkId::LOCAL);
        self.now = now;
        let of_node = self.links_of.get(&neighbour.node).map_or(0, |links| links.len());
        let refused = if neighbour.node == self.config.node {
            Some(LinkClose::Loop)
        } else if self.is_untrusted(&neighbour.certs) {
            Some(LinkClose::Revoked)
        } else if of_node >= self.config.limits.links_per_node_max || self.links.len() >= LINKS_MAX {
            Some(LinkClose::TooMany)
        } else {
            None
        };
        if let Some(reason) = refused {
            self.outputs.push_back(Output::Close { link, reason });
            return;
        }
        let of_node = self.links_of.entry(neighbour.node).or_default();
        of_node.push(link);
        of_node.sort_unstable();
        self.links.insert(link, LinkState::new(now, neighbour));
        let hello = Hello {
            minor: 0,
            incarnation: self.config.incarnation,
            transit: self.config.transit,
            yields: self.yields,
            started: self.config.started,
        };
        self.send(link, Control::Hello(hello));
        self.send(link, Control::Clock { time: now.unix });
        // Lists go first, before everything that they bear on.
        for der in self.config.anchors.crls().cloned().collect::<Vec<_>>() {
            self.send(link, Control::Crl { der });
        }
    }

    /// Handles the end of a link: everything that depended on it is withdrawn.
    pub fn handle_link_down(&mut self, now: Now, link: LinkId) {
        debug_assert_ne!(link, LinkId::LOCAL);
        self.now = now;
        self.forget_link(link);
    }

    /// Takes the measurements of a link: its round trip, and whether nothing at all arrives although something should.
    /// Such a link is used only where there is no other route.
    pub fn handle_link_quality(&mut self, now: Now, link: LinkId, round_trip: Duration, suspect: bool) {
        self.now = now;
        let Some(state) = self.links.get_mut(&link) else { return };
        let node = state.node;
        if state.cost.measure(now.instant, round_trip, suspect) {
            self.links_changed(now.instant, &node);
        }
    }

    /// Takes a frame from a link.
    pub fn handle_frame(&mut self, now: Now, link: LinkId, frame: Control) {
        self.now = now;
        let Some(state) = self.links.get(&link) else {
            self.drop_frame(link, DropReason::NoLink);
            return;
        };
        if state.hello.is_some() == matches!(frame, Control::Hello(_)) {
            self.outputs.push_back(Output::Close { link, reason: LinkClose::Greeting });
            self.forget_link(link);
            return;
        }
        match frame {
            Control::Hello(hello) => self.handle_hello(link, hello),
            Control::Advert { cost, signed } => self.handle_advert(now, link, cost, signed),
            Control::Unreach { names } => self.handle_unreach(link, &names),
            Control::Interest { names } => self.handle_interest(now, link, &names),
            Control::Uninterest { names } => self.handle_uninterest(link, &names),
            Control::Join { signed } => self.handle_join(now, link, signed),
            Control::Leave { name, sink } => self.handle_leave(link, name, sink),
            Control::Answer { signed } => self.handle_answer(now, link, signed),
            Control::Reject { name, sink, reason } => self.handle_reject(link, name, sink, reason),
            Control::Recover(recover) => self.handle_recover(link, recover),
            Control::Crl { der } => self.handle_crl(now, link, &der),
            Control::Ack { name, sink, serial } => self.handle_ack(link, name, sink, serial),
            Control::LinkState { signed } => self.handle_link_state(now, link, signed),
            Control::Query { id, hops, names } => self.handle_query(now, link, id, hops, &names),
            Control::Reroute { name, sink } => self.handle_reroute(link, name, sink),
            Control::Label { .. } | Control::LabelAck { .. } => {
                self.drop_frame(link, DropReason::Unknown { what: "label" });
            }
            Control::Probe { .. } => self.drop_frame(link, DropReason::Unknown { what: "probe" }),
            Control::Clock { time } => self.handle_clock(now, link, time),
            // Its content is for the operator alone.
            Control::IdentityInUse { .. } => self.drop_frame(link, DropReason::Unknown { what: "identity" }),
            Control::LaneOffer { .. } | Control::LaneAnswer { .. } | Control::LaneWanted { .. } => {
                self.drop_frame(link, DropReason::Unknown { what: "lane" });
            }
            Control::Goodbye => {
                self.outputs.push_back(Output::Close { link, reason: LinkClose::Goodbye });
                self.forget_link(link);
            }
        }
    }

    /// Notes that the link has taken all frames before an [`Output::Flush`].
    pub fn handle_flushed(&mut self, now: Now, link: LinkId) {
        self.now = now;
        self.continue_sync(link);
    }

    /// Acts on timers that are due.
    pub fn handle_timeout(&mut self, now: Now) {
        self.now = now;
        if self.clock.was_set(now) {
            self.clock_was_set(now);
        }
        self.close_expired(now);
        self.expire_nodes(now);
        self.names_timeout(now);
        self.pass_on_late(now);
        self.take_waiting_lists(now);
        self.branches_timeout(now);
    }

    /// Returns the next output; call until it is [`Output::Timeout`].
    pub fn poll_output(&mut self) -> Output {
        if self.outputs.is_empty() {
            self.originate_due(self.now);
            self.search_due(self.now);
            self.ask_due(self.now);
        }
        self.outputs.pop_front().unwrap_or_else(|| {
            let branch = self.deadlines.first().map(|(at, ..)| *at);
            let links = self.links.values().filter_map(|l| l.expires);
            let topology =
                [self.topology.search_at, self.topology.originate_at, self.topology.next_deadline()];
            let all = topology
                .into_iter()
                .flatten()
                .chain(branch)
                .chain(links)
                .chain(self.names.deadlines())
                .chain(self.late_at)
                .chain(self.lists.next_at());
            Output::Timeout(all.min())
        })
    }

    /// Takes another certificate of this node, which then signs its link state anew.
    pub fn set_identity(&mut self, now: Now, identity: Arc<Identity>) {
        self.now = now;
        self.config.identity = identity;
        self.topology.touch_own(now.instant);
    }

    /// Notes that a peer closed a link because another run of this node has its place. From here on this run takes over
    /// from no other: where two processes have one identity, the one that was started last keeps its links, and the
    /// other gets them when that one is gone.
    pub fn handle_superseded(&mut self) {
        self.yields = true;
    }

    /// Returns `true` once another run of this node has superseded this one.
    pub fn yields(&self) -> bool {
        self.yields
    }

    /// Returns by how many milliseconds the clock of a link's peer is ahead of the one here, from the peer's own
    /// report.
    pub fn clock_ahead_ms(&self, link: LinkId) -> Option<i64> {
        Some(self.links.get(&link)?.told_clock?.ahead_ms(self.now))
    }

    /// Returns the sizes of the tables.
    pub fn stats(&self) -> RouterStats {
        RouterStats {
            routed_names: self.routed_names(),
            names: self.names.known(),
            nodes: self.topology.len(),
            branches: self.trees.values().map(|t| t.branches.len()).sum(),
            tombstones: self.names.tombstones(),
        }
    }

    /// Returns the link towards the owner of `name`, and the cost of the route, microseconds of round trip.
    pub fn route(&self, name: &Name) -> Option<(LinkId, u32)> {
        self.next_hop(name)
    }

    /// Returns the cost of the route to a router, microseconds of round trip; `None` if it is out of reach.
    pub fn cost_to(&self, router: &NodeId) -> Option<u32> {
        self.topology.next_hop(&self.config.node, router).map(|(cost, _)| cost)
    }

    /// Returns the results of the route searches.
    pub fn route_stats(&self) -> RouteStats {
        self.topology.route_stats()
    }

    /// Returns the cost of a link, microseconds of round trip, and whether it seems dead.
    pub fn link_cost(&self, link: LinkId) -> Option<(u32, bool)> {
        let cost = &self.links.get(&link)?.cost;
        Some((cost.now(), cost.is_suspect()))
    }

    fn handle_hello(&mut self, link: LinkId, hello: Hello) {
        let Some(state) = self.links.get_mut(&link) else { return };
        state.hello = Some(hello);
        let (node, to_router) = (state.node, state.is_transit());
        if hello.transit && !to_router {
            self.drop_frame(link, DropReason::NotRouter);
        }
        let is_other = |s: &LinkState| s.hello.is_some_and(|h| h.incarnation != hello.incarnation);
        let of_node = self.links_of.get(&node).into_iter().flatten().copied();
        let others: SmallVec<[LinkId; 2]> =
            of_node.filter(|l| *l != link && self.links.get(l).is_some_and(is_other)).collect();
        // Greetings of two runs may cross; the newer link is that of the newer run, unless that run knows of another.
        let newest = others.iter().max().copied();
        let elsewhere = hello.yields && self.topology.is_elsewhere(&self.config.node, &node, hello.started);
        if elsewhere || newest.is_some_and(|newest| hello.yields || newest > link) {
            return self.supersede(link, newest, hello.yields);
        }
        for old in others {
            let alive = self.links.get(&old).and_then(|s| s.hello).is_some_and(|h| h.yields);
            self.supersede(old, Some(link), alive);
        }
        self.tell_all(link);
        self.links_changed(self.now.instant, &node);
    }

    /// Tells a neighbour this node's state, and that of the network if it is a router.
    fn tell_all(&mut self, link: LinkId) {
        if self.links.get(&link).is_some_and(LinkState::is_transit) {
            self.begin_sync(link);
        }
        self.send_interests(link);
    }

    /// Closes the link of a run that another one supersedes.
    pub(crate) fn supersede(&mut self, link: LinkId, by: Option<LinkId>, alive: bool) {
        self.outputs.push_back(Output::Close { link, reason: LinkClose::Superseded { by, alive } });
        self.forget_link(link);
    }

    fn handle_clock(&mut self, now: Now, link: LinkId, time: UnixMillis) {
        let Some(state) = self.links.get_mut(&link).filter(|_| link != LinkId::LOCAL) else { return };
        let told = PeerClock::new(time, now);
        let was_wrong = state.told_clock.replace(told).is_some_and(|old| clocks_differ(old.ahead_ms(now)));
        // One of the two refused the other's bodies until now, and would get new ones with the next lease only.
        if was_wrong && !clocks_differ(told.ahead_ms(now)) {
            self.tell_again(now, link);
        }
    }

    /// Handles a new setting of the wall clock here: tells peers, and signs own bodies anew.
    fn clock_was_set(&mut self, now: Now) {
        let links: Vec<_> = self.links.keys().filter(|l| **l != LinkId::LOCAL).copied().collect();
        for link in links {
            if let Some(state) = self.links.get_mut(&link) {
                state.set_expiry(now);
            }
            self.send(link, Control::Clock { time: now.unix });
            self.tell_again(now, link);
        }
        self.topology.touch_own(now.instant);
    }

    /// Tells a neighbour everything again, at most once in [`TELL_AGAIN_EVERY`].
    fn tell_again(&mut self, now: Now, link: LinkId) {
        let Some(state) = self.links.get_mut(&link).filter(|s| s.hello.is_some()) else { return };
        if state.told_again.is_some_and(|at| now.instant.saturating_duration_since(at) < TELL_AGAIN_EVERY) {
            return;
        }
        state.told_again = Some(now.instant);
        self.tell_all(link);
        self.tell_interested_again(link);
    }

    /// Withdraws everything that came over or goes over `link`.
    pub(crate) fn forget_link(&mut self, link: LinkId) {
        let Some(state) = self.links.remove(&link) else { return };
        if let Some(of_node) = self.links_of.get_mut(&state.node) {
            of_node.retain(|l| *l != link);
            if of_node.is_empty() {
                self.links_of.remove(&state.node);
            }
        }
        for name in state.interests.keys() {
            self.unwatch(link, name);
        }
        self.names.forget_asks(link);
        self.cut_link(link, state.branches);
        self.forget_via(link);
        if state.hello.is_some() {
            self.links_changed(self.now.instant, &state.node);
        }
    }

    /// Returns the remaining allowance of a node.
    pub(crate) fn allowance(&mut self, node: &NodeId) -> &mut Allowance {
        if self.allowances.len() >= self.allowances_max {
            // A node that has used nothing lately gets the same allowance when it comes back.
            let now = self.now.instant;
            self.allowances.retain(|_, allowance| !allowance.is_whole(now));
            self.allowances_max = 2 * self.allowances.len().max(ALLOWANCES_MIN);
        }
        let limits = &self.config.limits;
        self.allowances.entry(*node).or_insert_with(|| Allowance::new(limits))
    }

    /// Returns `true` if an announcement from `link` may be verified; otherwise it is dropped, because its neighbour
    /// brought too many without news.
    pub(crate) fn may_bring(&mut self, link: LinkId) -> bool {
        let Some(state) = self.links.get(&link).filter(|_| link != LinkId::LOCAL) else { return true };
        let (node, is_router, now) = (state.node, state.is_transit(), self.now.instant);
        let may = self.allowance(&node).may_bring(now, is_router);
        if !may {
            self.drop_frame(link, DropReason::StaleFlood);
        }
        may
    }

    /// Charges the neighbour that brought an announcement which was verified in vain.
    pub(crate) fn charge_stale(&mut self, link: LinkId) {
        let Some(state) = self.links.get(&link).filter(|_| link != LinkId::LOCAL) else { return };
        let (node, is_router, now) = (state.node, state.is_transit(), self.now.instant);
        self.allowance(&node).brought_stale(now, is_router);
    }

    pub(crate) fn send(&mut self, link: LinkId, frame: Control) {
        if self.links.contains_key(&link) {
            self.outputs.push_back(Output::Send { link, frame });
        }
    }

    pub(crate) fn drop_frame(&mut self, link: LinkId, reason: DropReason) {
        let peer = self.links.get(&link).map(|l| l.node);
        self.outputs.push_back(Output::Dropped(RouterDrop { link, peer, reason }));
    }
}
