//! The machine: frames and link changes in, frames and forwarding entries out.
//!
//! Routes are in `routes.rs`, trees in `tree.rs`, whom to believe in `trust.rs`.

use std::collections::{BTreeMap, BTreeSet, VecDeque};
use std::fmt;
use std::sync::Arc;
use std::time::{Duration, Instant};

use sgc_trust::{CrlError, SignedError, TrustAnchors};
use sgc_wire::{Control, Hello, Name, NodeId, Now, RejectReason, SinkId};

use crate::FibEntry;
use crate::links::{LinkState, Neighbour};
use crate::rib::NameState;

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

/// Bounds on what neighbours may make this node remember.
#[derive(Clone, Debug)]
pub struct Limits {
    /// Routes learned over a link to a router.
    pub routes_per_router_max: usize,
    /// Routes learned over a link to a proxy (its own names).
    pub routes_per_proxy_max: usize,
    /// Branches over one link.
    pub branches_per_link_max: usize,
    /// Branches of one name.
    pub branches_per_name_max: usize,
    /// Names that one link may ask for.
    pub interests_per_link_max: usize,
    /// Withdrawn names remembered against replay, and as many lost ones against circles.
    pub tombstones_max: usize,
    /// How long an owner may take to answer a join.
    pub answer_wait: Duration,
    /// Longest lease of an advertisement that is honoured.
    pub lease_max: Duration,
    /// Links of one node at one time.
    pub links_per_node_max: usize,
    /// Requests to join that a proxy's link may bring at once; refilled by an eighth of it a second. A router's, which
    /// speaks for many, may bring sixteen times as many.
    pub joins_burst: u32,
    /// Things that do not verify which a link may bring before it is closed; one is forgiven a second.
    pub forgeries_max: u32,
}

impl Default for Limits {
    fn default() -> Self {
        Self {
            routes_per_router_max: 1_000_000,
            routes_per_proxy_max: 16_384,
            branches_per_link_max: 65_536,
            branches_per_name_max: 4096,
            interests_per_link_max: 65_536,
            tombstones_max: 100_000,
            answer_wait: Duration::from_secs(10),
            lease_max: Duration::from_secs(600),
            links_per_node_max: 8,
            joins_burst: 1024,
            forgeries_max: 64,
        }
    }
}

/// What a router is made of.
#[derive(Clone, Debug)]
pub struct RouterConfig {
    /// This node.
    pub node: NodeId,
    /// True if it carries others' names.
    pub transit: bool,
    /// Random number of this run.
    pub incarnation: u64,
    /// Whose certificates it believes.
    pub anchors: Arc<TrustAnchors>,
    /// Bounds.
    pub limits: Limits,
}

/// What the driver has to do.
#[derive(Clone, Debug)]
pub enum Output {
    /// Send a frame over a link; over [`LinkId::LOCAL`], hand it to the endpoint.
    Send {
        /// Where.
        link: LinkId,
        /// What.
        frame: Control,
    },
    /// The forwarding of a name changed; `None` ends it.
    Forward {
        /// Which.
        name: Name,
        /// The new entry.
        entry: Option<FibEntry>,
    },
    /// Close a link; the driver then reports it down.
    Close {
        /// Which.
        link: LinkId,
        /// Why.
        reason: LinkClose,
    },
    /// Other certificates are believed from here on: a newer revocation list came. To be kept, and told to whatever
    /// else verifies certificates.
    Trust(Arc<TrustAnchors>),
    /// Something was refused; count it and, where it matters, say it.
    Dropped(Dropped),
    /// Nothing more to do until then, or until something happens.
    Timeout(Option<Instant>),
}

/// Why a link is closed.
#[derive(Clone, Debug, PartialEq, Eq, PartialOrd, Ord, thiserror::Error)]
pub enum LinkClose {
    /// The node greeted on a newer link from another run of its process.
    #[error("the node connected again from a new run; this link is of the old one")]
    Superseded,
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
    /// The node's certificate is over.
    #[error("the peer's certificate has ended")]
    Expired,
    /// The node has too many links.
    #[error("the peer has too many links")]
    TooMany,
    /// The peer sent too much that does not verify.
    #[error("the peer keeps sending what does not verify")]
    Forgeries,
}

/// What was refused, and who sent it.
#[derive(Clone, Debug)]
pub struct Dropped {
    /// The link it came over.
    pub link: LinkId,
    /// The node at its other end, if the link is known.
    pub peer: Option<NodeId>,
    /// Why.
    pub reason: DropReason,
}

/// Why a frame was refused.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
pub enum DropReason {
    /// A signed body that does not verify.
    #[error("{what} not believed: {why}")]
    NotVerified {
        /// Advertisement, join or answer.
        what: &'static str,
        /// What is wrong with it.
        why: SignedError,
    },
    /// A node that carries nobody else's names advertised for another owner.
    #[error("advertises names of {owner:?}, which is another node")]
    NotOwner {
        /// The owner in the advertisement.
        owner: NodeId,
    },
    /// An advertisement that is older than what is known, or withdrawn.
    #[error("advertisement {seq} is not newer than {known}")]
    Stale {
        /// Its sequence number.
        seq: u64,
        /// The one known.
        known: u64,
    },
    /// Too many hops.
    #[error("hop limit reached")]
    HopLimit,
    /// A bound of [`Limits`] is reached.
    #[error("limit reached: {what}")]
    Limit {
        /// Which.
        what: &'static str,
    },
    /// A frame for a name or sink that is not known here.
    #[error("{what} for a name or sink that is unknown here")]
    Unknown {
        /// Kind of frame.
        what: &'static str,
    },
    /// A frame from a neighbour that is not on the way to the owner.
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
    /// A neighbour says that it is a router, and its certificate does not.
    #[error(
        "says that it carries others' names, but its certificate does not let it: enroll it with --router or --may-route"
    )]
    NotRouter,
}

impl DropReason {
    /// True for what an honest neighbour never causes; the others happen when frames cross.
    pub fn is_suspicious(&self) -> bool {
        match self {
            Self::NotVerified { .. }
            | Self::NotOwner { .. }
            | Self::HopLimit
            | Self::Limit { .. }
            | Self::Crl(_)
            | Self::NotRouter => true,
            Self::Stale { .. } | Self::Unknown { .. } | Self::WrongWay { .. } | Self::NoLink => false,
        }
    }

    /// A short, stable name for counters.
    pub fn key(&self) -> &'static str {
        match self {
            Self::NotVerified { .. } => "not_verified",
            Self::NotOwner { .. } => "not_owner",
            Self::Stale { .. } => "stale",
            Self::HopLimit => "hop_limit",
            Self::Limit { .. } => "limit",
            Self::Unknown { .. } => "unknown",
            Self::WrongWay { .. } => "wrong_way",
            Self::NoLink => "no_link",
            Self::Crl(_) => "crl",
            Self::NotRouter => "not_router",
        }
    }
}

/// How much is known, for status.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct RouterStats {
    /// Names with a route.
    pub routed_names: usize,
    /// Names in any state.
    pub names: usize,
    /// Branches, pending ones included.
    pub branches: usize,
    /// Withdrawn names remembered.
    pub tombstones: usize,
}

/// The machine.
#[derive(Debug)]
pub struct Router {
    pub(crate) config: RouterConfig,
    pub(crate) links: BTreeMap<LinkId, LinkState>,
    pub(crate) names: BTreeMap<Name, NameState>,
    /// Withdrawn names: the withdrawal's sequence number, and until when a replay would still verify.
    pub(crate) tombstones: BTreeMap<Name, (u64, Instant)>,
    pub(crate) forgets: BTreeSet<(Instant, Name)>,
    /// Names without a route whose feasible distance is remembered, and until when.
    pub(crate) memories: BTreeSet<(Instant, Name)>,
    pub(crate) expiries: BTreeSet<(Instant, Name, LinkId)>,
    pub(crate) pending: BTreeSet<(Instant, Name, SinkId)>,
    /// Names that neighbours are to be told are out of reach, gathered into few frames; always sent before any other
    /// frame to the same neighbour.
    pub(crate) unreached: BTreeMap<LinkId, Vec<Name>>,
    pub(crate) outputs: VecDeque<Output>,
}

impl Router {
    /// A router with nothing but its local link.
    pub fn new(config: RouterConfig) -> Self {
        let mut local = LinkState::local(config.node, &config.limits);
        local.hello = Some(Hello { minor: 0, incarnation: config.incarnation, transit: false });
        Self {
            config,
            links: BTreeMap::from([(LinkId::LOCAL, local)]),
            names: BTreeMap::new(),
            tombstones: BTreeMap::new(),
            forgets: BTreeSet::new(),
            memories: BTreeSet::new(),
            expiries: BTreeSet::new(),
            pending: BTreeSet::new(),
            unreached: BTreeMap::new(),
            outputs: VecDeque::new(),
        }
    }

    /// A link to an authenticated node is up; greets it.
    pub fn handle_link_up(&mut self, now: Now, link: LinkId, neighbour: Neighbour) {
        debug_assert_ne!(link, LinkId::LOCAL);
        let of_node = self.links.values().filter(|l| l.node == neighbour.node).count();
        let refused = if neighbour.node == self.config.node {
            Some(LinkClose::Loop)
        } else if self.is_untrusted(&neighbour.certs) {
            Some(LinkClose::Revoked)
        } else if of_node >= self.config.limits.links_per_node_max {
            Some(LinkClose::TooMany)
        } else {
            None
        };
        if let Some(reason) = refused {
            self.outputs.push_back(Output::Close { link, reason });
            return;
        }
        self.links.insert(link, LinkState::new(now, neighbour, &self.config.limits));
        let hello = Hello { minor: 0, incarnation: self.config.incarnation, transit: self.config.transit };
        self.send(link, Control::Hello(hello));
        // Before anything that they bear on.
        for der in self.config.anchors.crls().cloned().collect::<Vec<_>>() {
            self.send(link, Control::Crl { der });
        }
    }

    /// A link is down; everything that depended on it is taken back.
    pub fn handle_link_down(&mut self, link: LinkId) {
        debug_assert_ne!(link, LinkId::LOCAL);
        self.forget_link(link);
    }

    /// A frame came over a link.
    pub fn handle_frame(&mut self, now: Now, link: LinkId, frame: Control) {
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
            Control::Advert { hops, signed } => self.handle_advert(now, link, hops, signed),
            Control::Unreach { names } => self.handle_unreach(link, &names),
            Control::Interest { names } => self.handle_interest(link, &names),
            Control::Uninterest { names } => self.handle_uninterest(link, &names),
            Control::Join { signed } => self.handle_join(now, link, signed),
            Control::Leave { name, sink } => self.handle_leave(link, name, sink),
            Control::Answer { signed } => self.handle_answer(now, link, signed),
            Control::Reject { name, sink, reason } => self.handle_reject(link, name, sink, reason),
            Control::Recover(recover) => self.handle_recover(link, recover),
            Control::Crl { der } => self.handle_crl(now, link, &der),
            Control::Ack { name, sink, serial } => self.handle_ack(link, name, sink, serial),
            Control::Label { .. } | Control::LabelAck { .. } => {
                self.drop_frame(link, DropReason::Unknown { what: "label" });
            }
            Control::Goodbye => {
                self.outputs.push_back(Output::Close { link, reason: LinkClose::Goodbye });
                self.forget_link(link);
            }
        }
    }

    /// Time passed.
    pub fn handle_timeout(&mut self, now: Now) {
        while let Some(&(at, name, link)) = self.expiries.first().filter(|(at, ..)| *at <= now.instant) {
            self.expiries.remove(&(at, name, link));
            if self.names.get(&name).and_then(|s| s.route_over(link)).is_some_and(|r| r.expires == at) {
                self.lose_route(name, link);
            }
        }
        while let Some(&(at, name, sink)) = self.pending.first().filter(|(at, ..)| *at <= now.instant) {
            if let Some(branch) = self.remove_branch(name, sink) {
                let reason = RejectReason::TimedOut;
                self.send(branch.link, Control::Reject { name, sink, reason });
                self.send_up(name, Control::Leave { name, sink });
                self.tidy(name);
            } else {
                self.pending.remove(&(at, name, sink));
            }
        }
        while let Some(&(at, name)) = self.forgets.first().filter(|(at, _)| *at <= now.instant) {
            self.forgets.remove(&(at, name));
            self.tombstones.remove(&name);
        }
        self.close_expired(now);
        while let Some(&(_, name)) = self.memories.first().filter(|(at, _)| *at <= now.instant) {
            self.forget(name);
        }
    }

    /// The next thing to do; call until it is [`Output::Timeout`].
    pub fn poll_output(&mut self) -> Output {
        if self.outputs.is_empty() {
            while let Some(link) = self.unreached.keys().next().copied() {
                self.flush_unreached(link);
            }
        }
        self.outputs.pop_front().unwrap_or_else(|| {
            let expiry = self.expiries.first().map(|(at, ..)| *at);
            let pending = self.pending.first().map(|(at, ..)| *at);
            let forget = self.forgets.first().map(|(at, _)| *at);
            let memory = self.memories.first().map(|(at, _)| *at);
            let links = self.links.values().filter_map(|l| l.expires).min();
            Output::Timeout([expiry, pending, forget, memory, links].into_iter().flatten().min())
        })
    }

    /// How much is known.
    pub fn stats(&self) -> RouterStats {
        RouterStats {
            routed_names: self.names.values().filter(|s| s.route().is_some()).count(),
            names: self.names.len(),
            branches: self.links.values().map(|l| l.branches).sum(),
            tombstones: self.tombstones.len(),
        }
    }

    /// The link towards the owner of `name`, and how far it is in links.
    pub fn route(&self, name: &Name) -> Option<(LinkId, u8)> {
        self.names.get(name)?.route().map(|r| (r.link, r.distance()))
    }

    pub(crate) fn handle_hello(&mut self, link: LinkId, hello: Hello) {
        let Some(state) = self.links.get_mut(&link) else { return };
        state.hello = Some(hello);
        let (node, to_router) = (state.node, state.is_transit());
        if hello.transit && !to_router {
            self.drop_frame(link, DropReason::NotRouter);
        }
        // Greetings of two runs may cross; the newer link is that of the newer run.
        let mut runs: Vec<_> = self
            .links
            .iter()
            .filter(|(l, s)| {
                **l == link
                    || **l != LinkId::LOCAL
                        && s.node == node
                        && s.hello.is_some_and(|h| h.incarnation != hello.incarnation)
            })
            .map(|(l, _)| *l)
            .collect();
        let newest = runs.pop();
        if newest != Some(link) {
            runs = vec![link];
        }
        for old in runs {
            self.outputs.push_back(Output::Close { link: old, reason: LinkClose::Superseded });
            self.forget_link(old);
        }
        if newest != Some(link) {
            return;
        }
        if to_router {
            self.send_routes(link);
        }
        self.send_interests(link);
    }

    /// Takes back everything that came over or goes over `link`.
    pub(crate) fn forget_link(&mut self, link: LinkId) {
        let Some(state) = self.links.remove(&link) else { return };
        for name in state.names.union(&state.interests).copied() {
            let Some(entry) = self.names.get_mut(&name) else { continue };
            entry.interested.remove(&link);
            let sinks: Vec<_> =
                entry.branches.iter().filter(|(_, b)| b.link == link).map(|(s, _)| *s).collect();
            for sink in sinks {
                self.remove_branch(name, sink);
                self.send_up(name, Control::Leave { name, sink });
            }
            self.lose_route(name, link);
            self.tidy(name);
        }
    }

    /// Forgets that `name` depends on `link` if it no longer does.
    pub(crate) fn release(&mut self, name: Name, link: LinkId) {
        let depends = self
            .names
            .get(&name)
            .is_some_and(|s| s.route_over(link).is_some() || s.branches.values().any(|b| b.link == link));
        if !depends && let Some(state) = self.links.get_mut(&link) {
            state.names.remove(&name);
        }
    }

    /// Forgets a name of which nothing is known any more.
    pub(crate) fn tidy(&mut self, name: Name) {
        if self.names.get(&name).is_some_and(NameState::is_idle) {
            self.names.remove(&name);
        }
    }

    pub(crate) fn send(&mut self, link: LinkId, frame: Control) {
        self.flush_unreached(link);
        if self.links.contains_key(&link) {
            self.outputs.push_back(Output::Send { link, frame });
        }
    }

    pub(crate) fn drop_frame(&mut self, link: LinkId, reason: DropReason) {
        let peer = self.links.get(&link).map(|l| l.node);
        self.outputs.push_back(Output::Dropped(Dropped { link, peer, reason }));
    }
}
