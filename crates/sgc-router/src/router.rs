//! The machine: frames and link changes in, frames and forwarding entries out.

use std::collections::{BTreeMap, BTreeSet, VecDeque};
use std::fmt;
use std::sync::Arc;
use std::time::{Duration, Instant};

use sgc_trust::{CLOCK_SKEW_MAX, SignedError, TrustAnchors, verify_advert, verify_answer, verify_join};
use sgc_wire::{
    Answer, Control, HOP_LIMIT, Hello, NAMES_PER_FRAME_MAX, Name, NodeId, Now, Recover, RejectReason, Signed,
    SinkId,
};

use crate::FibEntry;
use crate::links::LinkState;
use crate::rib::{AdvertRecord, Branch, NameState, Route};

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
}

impl DropReason {
    /// True for what an honest neighbour never causes; the others happen when frames cross.
    pub fn is_suspicious(&self) -> bool {
        matches!(self, Self::NotVerified { .. } | Self::NotOwner { .. } | Self::HopLimit | Self::Limit { .. })
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

/// What choosing a route anew came to.
enum Selection {
    /// The link in use is the same, or there still is none.
    Same,
    /// There was a route and there is none.
    Lost,
    /// Another link is in use.
    Moved,
}

/// The machine.
#[derive(Debug)]
pub struct Router {
    config: RouterConfig,
    links: BTreeMap<LinkId, LinkState>,
    names: BTreeMap<Name, NameState>,
    /// Withdrawn names: the withdrawal's sequence number, and until when a replay would still verify.
    tombstones: BTreeMap<Name, (u64, Instant)>,
    forgets: BTreeSet<(Instant, Name)>,
    /// Names without a route whose feasible distance is remembered, and until when.
    memories: BTreeSet<(Instant, Name)>,
    expiries: BTreeSet<(Instant, Name, LinkId)>,
    pending: BTreeSet<(Instant, Name, SinkId)>,
    /// Names that neighbours are to be told are out of reach, gathered into few frames; always sent before any other
    /// frame to the same neighbour.
    unreached: BTreeMap<LinkId, Vec<Name>>,
    outputs: VecDeque<Output>,
}

impl Router {
    /// A router with nothing but its local link.
    pub fn new(config: RouterConfig) -> Self {
        let mut local = LinkState::new(config.node);
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
    pub fn handle_link_up(&mut self, link: LinkId, node: NodeId) {
        debug_assert_ne!(link, LinkId::LOCAL);
        if node == self.config.node {
            self.outputs.push_back(Output::Close { link, reason: LinkClose::Loop });
            return;
        }
        self.links.insert(link, LinkState::new(node));
        let hello = Hello { minor: 0, incarnation: self.config.incarnation, transit: self.config.transit };
        self.send(link, Control::Hello(hello));
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
            Control::Answer { signed } => self.handle_answer(link, signed),
            Control::Reject { name, sink, reason } => self.handle_reject(link, name, sink, reason),
            Control::Recover(recover) => self.handle_recover(link, recover),
            Control::Crl { .. } => self.drop_frame(link, DropReason::Unknown { what: "revocation list" }),
            Control::Ack { .. } => self.drop_frame(link, DropReason::Unknown { what: "acknowledgement" }),
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
            Output::Timeout(expiry.into_iter().chain(pending).chain(forget).chain(memory).min())
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

    fn handle_hello(&mut self, link: LinkId, hello: Hello) {
        let Some(state) = self.links.get_mut(&link) else { return };
        state.hello = Some(hello);
        let (node, to_router) = (state.node, state.is_transit());
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

    /// Tells a router that just greeted what is reachable here, each advertisement once.
    fn send_routes(&mut self, link: LinkId) {
        let mut sent = BTreeSet::new();
        let mut frames = Vec::new();
        for route in self.names.values().filter_map(NameState::route) {
            if self.may_tell(route, link) && sent.insert(Arc::as_ptr(&route.advert)) {
                frames.extend(self.route_frames(route));
            }
        }
        for frame in frames {
            self.send(link, frame);
        }
    }

    /// Asks a neighbour for the names that are wanted here.
    fn send_interests(&mut self, link: LinkId) {
        if self.config.transit {
            return; // a router is told everything
        }
        let wanted: Vec<_> = self.links[&LinkId::LOCAL].interests.iter().copied().collect();
        for names in wanted.chunks(NAMES_PER_FRAME_MAX) {
            self.send(link, Control::Interest { names: names.to_vec() });
        }
    }

    /// True if `route` may be told over `link`: not back where it came from, and others' names only by routers.
    fn may_tell(&self, route: &Route, link: LinkId) -> bool {
        route.link != link && (route.link == LinkId::LOCAL || link == LinkId::LOCAL || self.config.transit)
    }

    fn handle_advert(&mut self, now: Now, link: LinkId, hops: u8, signed: Signed) {
        // Data must reach wherever a route does; a packet that comes with its last hop goes no further.
        if hops >= HOP_LIMIT - 1 {
            return self.drop_frame(link, DropReason::HopLimit);
        }
        let advert = match verify_advert(&self.config.anchors, &signed, now.unix) {
            Ok(advert) => advert,
            Err(why) => {
                return self.drop_frame(link, DropReason::NotVerified { what: "advertisement", why });
            }
        };
        let Some(state) = self.links.get(&link) else { return };
        let owner = advert.owner.node_id;
        if !state.is_transit() && (owner != state.node || hops != 0) {
            return self.drop_frame(link, DropReason::NotOwner { owner });
        }
        let seq = advert.body.seq;
        let lease = Duration::from_millis(advert.body.lease_ms.into()).min(self.config.limits.lease_max);
        let expires = now.instant + lease;
        let withdraw = advert.body.withdraw;
        let record = Arc::new(AdvertRecord { owner: advert.owner, seq, names: advert.names, signed });
        let mut news = Vec::new();
        let mut elsewhere = Vec::new();
        let mut stale = None;
        for name in record.names.iter().copied() {
            let known = self.known_seq(name);
            if withdraw {
                if known.is_none_or(|k| seq > k) {
                    if self.withdraw(now, name, seq) {
                        news.push(name);
                    }
                } else {
                    stale = known;
                }
                continue;
            }
            // The same advertisement over another link is another route; an older one is a replay or late.
            if known.is_some_and(|k| seq < k) || self.tombstones.contains_key(&name) && known >= Some(seq) {
                stale = known;
                continue;
            }
            self.remove_tombstone(name);
            if !self.put_route(name, Route { link, hops, advert: record.clone(), expires }) {
                self.drop_frame(link, DropReason::Limit { what: "routes per link" });
                break;
            }
            let lost = matches!(self.reselect(name, None), Selection::Lost);
            if self.names.get_mut(&name).is_some_and(NameState::take_news) {
                let here = self.route(&name).is_some_and(|(up, _)| up == link);
                if here { &mut news } else { &mut elsewhere }.push(name);
            } else if lost {
                self.tell_unreach(name);
            }
        }
        if let Some(known) = stale {
            self.drop_frame(link, DropReason::Stale { seq, known });
        }
        if withdraw && !news.is_empty() {
            let route = Route { link, hops, advert: record, expires };
            self.flood(link, &news, &[advert_frame(&route)]);
        } else if !news.is_empty() {
            self.tell(&Route { link, hops, advert: record, expires }, &news);
        }
        for name in elsewhere {
            self.tell_route(name);
        }
    }

    /// The newest sequence number known of a name, withdrawn or not.
    fn known_seq(&self, name: Name) -> Option<u64> {
        let live = self.names.get(&name).and_then(NameState::newest_seq);
        live.max(self.tombstones.get(&name).map(|(seq, _)| *seq))
    }

    /// Passes an advertisement on: to all other routers, and to those who asked for one of `names`.
    fn flood(&mut self, ingress: LinkId, names: &[Name], frames: &[Control]) {
        let carries = ingress == LinkId::LOCAL || self.config.transit;
        let targets: Vec<_> = self
            .links
            .iter()
            .filter(|(l, s)| {
                **l != ingress
                    && s.hello.is_some()
                    && (carries || **l == LinkId::LOCAL)
                    && (s.is_transit() || names.iter().any(|n| s.interests.contains(n)))
            })
            .map(|(l, _)| *l)
            .collect();
        for link in targets {
            for frame in frames {
                self.send(link, frame.clone());
            }
        }
    }

    /// Forgets a withdrawn name and remembers that it was; false if it was not known.
    fn withdraw(&mut self, now: Now, name: Name, seq: u64) -> bool {
        self.remove_tombstone(name);
        if self.tombstones.len() >= self.config.limits.tombstones_max
            && let Some((_, oldest)) = self.forgets.pop_first()
        {
            self.tombstones.remove(&oldest);
        }
        let until = now.instant + 2 * CLOCK_SKEW_MAX;
        self.tombstones.insert(name, (seq, until));
        self.forgets.insert((until, name));
        let Some(state) = self.names.get(&name) else { return false };
        let links = state.route_links();
        for link in &links {
            self.remove_route(name, *link);
        }
        self.reselect(name, None);
        // The sequence number alone tells what is old.
        self.forget(name);
        !links.is_empty()
    }

    fn remove_tombstone(&mut self, name: Name) {
        if let Some((_, until)) = self.tombstones.remove(&name) {
            self.forgets.remove(&(until, name));
        }
    }

    fn handle_unreach(&mut self, link: LinkId, names: &[Name]) {
        for name in names {
            self.lose_route(*name, link);
        }
    }

    fn handle_interest(&mut self, link: LinkId, names: &[Name]) {
        // One advertisement speaks for many names; it is sent once.
        let mut sent = BTreeSet::new();
        for name in names {
            let Some(state) = self.links.get_mut(&link) else { return };
            if state.interests.len() >= self.config.limits.interests_per_link_max {
                return self.drop_frame(link, DropReason::Limit { what: "interests per link" });
            }
            if !state.interests.insert(*name) {
                continue;
            }
            let entry = self.names.entry(*name).or_default();
            entry.interested.insert(link);
            let known = entry.route().cloned();
            let told = known.filter(|r| self.may_tell(r, link));
            if let Some(route) = told.filter(|r| sent.insert(Arc::as_ptr(&r.advert))) {
                for frame in self.route_frames(&route) {
                    self.send(link, frame);
                }
            }
            if link == LinkId::LOCAL {
                self.ask(&Control::Interest { names: vec![*name] });
            }
        }
    }

    fn handle_uninterest(&mut self, link: LinkId, names: &[Name]) {
        for name in names {
            let Some(state) = self.links.get_mut(&link) else { return };
            if !state.interests.remove(name) {
                continue;
            }
            if let Some(entry) = self.names.get_mut(name) {
                entry.interested.remove(&link);
            }
            if link == LinkId::LOCAL {
                self.ask(&Control::Uninterest { names: vec![*name] });
            }
            self.tidy(*name);
        }
    }

    /// Sends an interest of this node to its neighbours; a router is told everything anyway.
    fn ask(&mut self, frame: &Control) {
        let targets: Vec<_> = self
            .links
            .iter()
            .filter(|(l, s)| **l != LinkId::LOCAL && s.hello.is_some() && !self.config.transit)
            .map(|(l, _)| *l)
            .collect();
        for link in targets {
            self.send(link, frame.clone());
        }
    }

    fn handle_join(&mut self, now: Now, link: LinkId, signed: Signed) {
        let join = match verify_join(&self.config.anchors, &signed, now.unix) {
            Ok(join) => join,
            Err(why) => {
                // Whoever sent it hears why: with a wrong clock, nothing else would say so.
                if let Ok(body) = <sgc_wire::JoinBody as sgc_wire::Decode>::from_slice(&signed.body) {
                    let (name, sink, reason) = (body.name, body.sink, RejectReason::NotVerified);
                    self.send(link, Control::Reject { name, sink, reason });
                }
                return self.drop_frame(link, DropReason::NotVerified { what: "join", why });
            }
        };
        let (name, sink) = (join.body.name, join.body.sink);
        let reject = |this: &mut Self, reason| this.send(link, Control::Reject { name, sink, reason });
        let up = self.names.get(&name).and_then(NameState::route).map(|r| r.link);
        let Some(up) = up.filter(|up| *up != link) else {
            return reject(self, RejectReason::NoRoute);
        };
        let carries = up == LinkId::LOCAL || link == LinkId::LOCAL || self.config.transit;
        let Some(state) = self.names.get(&name).filter(|_| carries) else {
            return reject(self, RejectReason::NoRoute);
        };
        // A sink has one place in the tree and asks once: the same request over another link is a replay.
        if state.branches.get(&sink).is_some_and(|b| b.peer != join.peer.node_id || b.link != link) {
            return reject(self, RejectReason::NotVerified);
        }
        let over_link = self.links.get(&link).map_or(0, |l| l.branches);
        let limits = &self.config.limits;
        let full =
            state.branches.len() >= limits.branches_per_name_max || over_link >= limits.branches_per_link_max;
        if full && !state.branches.contains_key(&sink) {
            self.drop_frame(link, DropReason::Limit { what: "branches" });
            return reject(self, RejectReason::Limit);
        }
        let deadline = now.instant + limits.answer_wait;
        self.remove_branch(name, sink);
        let branch =
            Branch { link, peer: join.peer.node_id, role: join.body.request.role(), pending: Some(deadline) };
        self.put_branch(name, sink, branch);
        self.send(up, Control::Join { signed });
    }

    fn handle_leave(&mut self, link: LinkId, name: Name, sink: SinkId) {
        let ours = self.names.get(&name).and_then(|s| s.branches.get(&sink)).is_some_and(|b| b.link == link);
        if !ours {
            return self.drop_frame(link, DropReason::Unknown { what: "leave" });
        }
        self.remove_branch(name, sink);
        self.send_up(name, Control::Leave { name, sink });
        self.tidy(name);
    }

    fn handle_answer(&mut self, link: LinkId, signed: Signed) {
        // The name is needed to find the key that the signature must verify with; it is believed only after.
        let claimed = match <sgc_wire::AnswerBody as sgc_wire::Decode>::from_slice(&signed.body) {
            Ok(body) => body.name,
            Err(why) => {
                let why = SignedError::Decode(why);
                return self.drop_frame(link, DropReason::NotVerified { what: "answer", why });
            }
        };
        let Some(route) = self.names.get(&claimed).and_then(NameState::route) else {
            return self.drop_frame(link, DropReason::Unknown { what: "answer" });
        };
        if route.link != link {
            return self.drop_frame(link, DropReason::WrongWay { what: "answer" });
        }
        let body = match verify_answer(&route.advert.owner, &signed) {
            Ok(body) => body,
            Err(why) => return self.drop_frame(link, DropReason::NotVerified { what: "answer", why }),
        };
        let (name, sink) = (body.name, body.sink);
        let Some(branch) = self.names.get_mut(&name).and_then(|s| s.branches.get_mut(&sink)) else {
            // The owner granted a sink that has left meanwhile: it must not keep it.
            self.send(link, Control::Leave { name, sink });
            return self.drop_frame(link, DropReason::Unknown { what: "answer" });
        };
        let down = branch.link;
        match body.answer {
            Answer::Grant { .. } => {
                if let Some(deadline) = branch.pending.take() {
                    self.pending.remove(&(deadline, name, sink));
                    self.refresh_fib(name);
                }
            }
            Answer::Refuse { .. } => {
                self.remove_branch(name, sink);
            }
        }
        self.send(down, Control::Answer { signed });
        self.tidy(name);
    }

    fn handle_reject(&mut self, link: LinkId, name: Name, sink: SinkId, reason: RejectReason) {
        let state = self.names.get(&name);
        if state.and_then(NameState::route).is_none_or(|r| r.link != link) {
            return self.drop_frame(link, DropReason::WrongWay { what: "reject" });
        }
        let Some(branch) = self.remove_branch(name, sink) else {
            return self.drop_frame(link, DropReason::Unknown { what: "reject" });
        };
        self.send(branch.link, Control::Reject { name, sink, reason });
        self.tidy(name);
    }

    /// A sink asks for what it missed; passed on towards the owner if the sink has a place in the tree.
    fn handle_recover(&mut self, link: LinkId, recover: Recover) {
        let branch = self.names.get(&recover.name).and_then(|s| s.branches.get(&recover.sink));
        if branch.is_none_or(|b| b.link != link || b.pending.is_some()) {
            return self.drop_frame(link, DropReason::Unknown { what: "recover" });
        }
        self.send_up(recover.name, Control::Recover(recover));
    }

    /// Takes back everything that came over or goes over `link`.
    fn forget_link(&mut self, link: LinkId) {
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

    /// Removes the route over `link`, falls back on another, and tells whoever needs to know.
    fn lose_route(&mut self, name: Name, link: LinkId) {
        if !self.remove_route(name, link) {
            return;
        }
        match self.reselect(name, None) {
            Selection::Same => {}
            Selection::Lost => self.tell_unreach(name),
            Selection::Moved => self.tell_route(name),
        }
        self.tidy(name);
    }

    /// Chooses the route of a name anew. If the link in use changed, the tree over the old one is cut and its
    /// sinks are told, so that they join again.
    fn reselect(&mut self, name: Name, must: Option<LinkId>) -> Selection {
        let Some(state) = self.names.get_mut(&name) else { return Selection::Same };
        let Some(before) = state.select(must) else { return Selection::Same };
        let moved = state.route().is_some();
        let cut = std::mem::take(&mut state.branches);
        if cut.values().any(|b| b.pending.is_none()) {
            self.refresh_fib(name);
        }
        for (sink, branch) in cut {
            self.detach(name, sink, &branch);
            self.send(branch.link, Control::Reject { name, sink, reason: RejectReason::RouteLost });
            if let Some(old) = before {
                self.send(old, Control::Leave { name, sink });
            }
        }
        if moved { Selection::Moved } else { Selection::Lost }
    }

    /// Tells everyone who was told of a route to `name` that there is none.
    fn tell_unreach(&mut self, name: Name) {
        let targets: Vec<_> = self
            .links
            .iter()
            .filter(|(_, s)| s.hello.is_some() && (s.is_transit() || s.interests.contains(&name)))
            .map(|(l, _)| *l)
            .collect();
        for link in targets {
            let names = self.unreached.entry(link).or_default();
            names.push(name);
            if names.len() >= NAMES_PER_FRAME_MAX {
                self.flush_unreached(link);
            }
        }
    }

    /// Sends what [`Self::tell_unreach`] gathered for a link.
    fn flush_unreached(&mut self, link: LinkId) {
        if let Some(names) = self.unreached.remove(&link)
            && self.links.contains_key(&link)
        {
            self.outputs.push_back(Output::Send { link, frame: Control::Unreach { names } });
        }
    }

    /// Tells the route now in use, after another one was lost.
    fn tell_route(&mut self, name: Name) {
        let Some(state) = self.names.get_mut(&name) else { return };
        state.take_news();
        let Some(route) = state.route().cloned() else { return };
        self.tell(&route, &[name]);
    }

    /// Tells `route`, which `names` now use. Its advertisement speaks for more names than those; whatever it says
    /// of them must be true, or routes could go in a circle: so they take the same route, unless they are told
    /// better already.
    fn tell(&mut self, route: &Route, names: &[Name]) {
        // Names that had to move to yet another link, whose advertisements speak for further names in turn: a
        // list and not a recursion, since a peer decides how long the chain gets.
        let mut todo = vec![(route.clone(), names.to_vec())];
        while let Some((route, names)) = todo.pop() {
            let (link, seq) = (route.link, route.advert.seq);
            let tells_all = link == LinkId::LOCAL || self.config.transit;
            for name in route.advert.names.iter().copied().filter(|_| tells_all) {
                if !self.names.get_mut(&name).is_some_and(|s| s.promise(seq, route.distance())) {
                    continue;
                }
                match self.reselect(name, Some(link)) {
                    Selection::Same => {}
                    Selection::Lost => self.tell_unreach(name),
                    Selection::Moved => {
                        let Some(state) = self.names.get_mut(&name) else { continue };
                        let news = state.take_news();
                        if let Some(other) = state.route().filter(|r| news && r.link != link) {
                            todo.push((other.clone(), vec![name]));
                        }
                    }
                }
            }
            self.flood(link, &names, &self.route_frames(&route));
        }
    }

    /// The frames that tell a route: its advertisement, and which of its names are out of reach from here by now.
    fn route_frames(&self, route: &Route) -> Vec<Control> {
        let known = |name: &Name| self.names.get(name).is_some_and(|s| s.route().is_some());
        let gone: Vec<_> = route.advert.names.iter().copied().filter(|n| !known(n)).collect();
        let unreach = (!gone.is_empty()).then_some(Control::Unreach { names: gone });
        std::iter::once(advert_frame(route)).chain(unreach).collect()
    }

    /// Adds a route; false if the link has too many.
    fn put_route(&mut self, name: Name, route: Route) -> bool {
        let Some(link) = self.links.get_mut(&route.link) else { return false };
        let limits = &self.config.limits;
        let max = match (route.link, link.is_transit()) {
            (LinkId::LOCAL, _) => usize::MAX,
            (_, true) => limits.routes_per_router_max,
            (_, false) => limits.routes_per_proxy_max,
        };
        let entry = self.names.entry(name).or_default();
        let old = entry.route_over(route.link).map(|r| r.expires);
        if old.is_none() && link.routes >= max {
            self.tidy(name);
            return false;
        }
        if let Some(old) = old {
            self.expiries.remove(&(old, name, route.link));
        }
        self.expiries.insert((route.expires, name, route.link));
        link.names.insert(name);
        if entry.put_route(route) {
            link.routes += 1;
        }
        if let Some(until) = entry.resume() {
            self.memories.remove(&(until, name));
        }
        true
    }

    /// Removes the route over `link`; true if there was one. The caller selects anew.
    fn remove_route(&mut self, name: Name, link: LinkId) -> bool {
        let Some(entry) = self.names.get_mut(&name) else { return false };
        let Some(route) = entry.remove_route(link) else { return false };
        self.expiries.remove(&(route.expires, name, link));
        if entry.remember(route.expires) {
            let full = self.memories.len() >= self.config.limits.tombstones_max;
            let oldest = self.memories.first().filter(|_| full).map(|(_, oldest)| *oldest);
            self.memories.insert((route.expires, name));
            if let Some(oldest) = oldest {
                self.forget(oldest);
            }
        }
        if let Some(state) = self.links.get_mut(&link) {
            state.routes -= 1;
        }
        self.release(name, link);
        true
    }

    fn put_branch(&mut self, name: Name, sink: SinkId, branch: Branch) {
        if let Some(deadline) = branch.pending {
            self.pending.insert((deadline, name, sink));
        }
        if let Some(link) = self.links.get_mut(&branch.link) {
            link.branches += 1;
            link.names.insert(name);
        }
        if let Some(state) = self.names.get_mut(&name) {
            state.branches.insert(sink, branch);
        }
    }

    fn remove_branch(&mut self, name: Name, sink: SinkId) -> Option<Branch> {
        let branch = self.names.get_mut(&name)?.branches.remove(&sink)?;
        if branch.pending.is_none() {
            self.refresh_fib(name);
        }
        self.detach(name, sink, &branch);
        Some(branch)
    }

    /// Takes a branch that is out of its name's tree out of the timers and the link's counts.
    fn detach(&mut self, name: Name, sink: SinkId, branch: &Branch) {
        if let Some(deadline) = branch.pending {
            self.pending.remove(&(deadline, name, sink));
        }
        if let Some(link) = self.links.get_mut(&branch.link) {
            link.branches -= 1;
        }
        self.release(name, branch.link);
    }

    /// Forgets that `name` depends on `link` if it no longer does.
    fn release(&mut self, name: Name, link: LinkId) {
        let depends = self
            .names
            .get(&name)
            .is_some_and(|s| s.route_over(link).is_some() || s.branches.values().any(|b| b.link == link));
        if !depends && let Some(state) = self.links.get_mut(&link) {
            state.names.remove(&name);
        }
    }

    /// Forgets what was told of a name that has no route.
    fn forget(&mut self, name: Name) {
        if let Some(until) = self.names.get_mut(&name).and_then(NameState::forget) {
            self.memories.remove(&(until, name));
        }
        self.tidy(name);
    }

    /// Forgets a name of which nothing is known any more.
    fn tidy(&mut self, name: Name) {
        if self.names.get(&name).is_some_and(NameState::is_idle) {
            self.names.remove(&name);
        }
    }

    fn refresh_fib(&mut self, name: Name) {
        let entry = self.names.get(&name).and_then(NameState::compile);
        self.outputs.push_back(Output::Forward { name, entry });
    }

    fn send(&mut self, link: LinkId, frame: Control) {
        self.flush_unreached(link);
        if self.links.contains_key(&link) {
            self.outputs.push_back(Output::Send { link, frame });
        }
    }

    fn send_up(&mut self, name: Name, frame: Control) {
        if let Some(up) = self.names.get(&name).and_then(NameState::route).map(|r| r.link) {
            self.send(up, frame);
        }
    }

    fn drop_frame(&mut self, link: LinkId, reason: DropReason) {
        let peer = self.links.get(&link).map(|l| l.node);
        self.outputs.push_back(Output::Dropped(Dropped { link, peer, reason }));
    }
}

fn advert_frame(route: &Route) -> Control {
    Control::Advert { hops: route.distance(), signed: route.advert.signed.clone() }
}
