//! [`DirectNode`]: the direct links of a node, and the machine that finds them.

use std::collections::{BTreeMap, BTreeSet};
use std::net::SocketAddr;
use std::time::{Duration, Instant};

use bytes::Bytes;
use rand_chacha::ChaCha20Rng;
use rand_core::SeedableRng as _;
use sgc_router::{DirectReach, LinkId, Router};
use sgc_session::{DirectPaths, LocalAddress};
use sgc_trust::{Grantees, VerifiedPeer};
use sgc_wire::{
    CandidateKind, Decode as _, NodeId, PATH_CANDIDATES_MAX, PathOffer, PathQuestion, RefuseReason,
};

/// A function that replaces the addresses that a node tells a peer.
pub(crate) type TamperOffers = Box<dyn FnMut(PathOffer) -> PathOffer>;

/// Interval of looks at the links, as in `sgc-node`.
pub(super) const LOOK_EVERY: Duration = Duration::from_millis(500);
/// As in `sgc-node`: most reflexive addresses that peers are told.
const REFLEXIVE_MAX: usize = 3;
/// As in `sgc-node`: time after which a direct link is closed over which neither node wants data.
const UNUSED_MAX: Duration = Duration::from_secs(120);

/// As in `sgc-node`: time after which one is closed that has a better one beside it.
const SUPERSEDED_MAX: Duration = Duration::from_secs(10);

/// A direct link that is up.
#[derive(Debug)]
struct DirectLink {
    peer: NodeId,
    is_silent: bool,
    unused: Option<Instant>,
}

/// The direct links of a node.
pub(crate) struct DirectNode {
    pub(crate) paths: DirectPaths,
    links: BTreeMap<LinkId, DirectLink>,
    pub(super) permitted: Grantees,
    pub(super) host: Option<SocketAddr>,
    /// Addresses from which routers see this node come, by link, and those that were known last.
    observed: BTreeMap<LinkId, SocketAddr>,
    reflexive: BTreeSet<SocketAddr>,
    /// The nodes whose links are accepted, by the addresses from which they may come.
    pub(crate) expected: BTreeMap<SocketAddr, NodeId>,
    pub(super) look_at: Instant,
    pub(crate) tamper: Option<TamperOffers>,
    /// Peers to which it wants paths without data to exchange.
    pub(crate) forced: BTreeSet<NodeId>,
}

impl DirectNode {
    pub(super) fn new(now: Instant, own: &VerifiedPeer, seed: u64) -> Self {
        Self {
            paths: DirectPaths::new(own.node_id, ChaCha20Rng::seed_from_u64(seed)),
            links: BTreeMap::new(),
            permitted: Grantees { fleets: [own.ca].into(), ..Grantees::default() },
            host: None,
            observed: BTreeMap::new(),
            reflexive: BTreeSet::new(),
            expected: BTreeMap::new(),
            look_at: now,
            tamper: None,
            forced: BTreeSet::new(),
        }
    }

    /// Returns `true` for a direct link.
    pub(crate) fn is_direct(&self, link: LinkId) -> bool {
        self.links.contains_key(&link)
    }

    /// Returns `true` if a link of this node is accepted from an address.
    pub(crate) fn expects(&self, from: SocketAddr, node: &NodeId) -> bool {
        self.expected.get(&from) == Some(node)
    }

    /// Sets the address of this host.
    pub(crate) fn set_host(&mut self, now: Instant, host: SocketAddr) {
        if self.host != Some(host) {
            self.host = Some(host);
            self.addresses_changed(now);
        }
    }

    /// Takes the address at which a router sees this node.
    pub(crate) fn observe(&mut self, now: Instant, link: LinkId, address: SocketAddr) {
        self.observed.insert(link, address);
        let reflexive = self.observed.values().copied().collect();
        if self.reflexive != reflexive {
            self.reflexive = reflexive;
            self.addresses_changed(now);
        }
    }

    fn addresses_changed(&mut self, now: Instant) {
        let Some(base) = self.host else { return };
        let seen = self.reflexive.iter().copied().filter(|seen| *seen != base);
        let kind = CandidateKind::ServerReflexive;
        let reflexive = seen.map(|address| LocalAddress { kind, address, base });
        let host = LocalAddress { kind: CandidateKind::Host, address: base, base };
        let local = reflexive.take(REFLEXIVE_MAX).chain([host]).take(PATH_CANDIDATES_MAX);
        self.paths.set_local(now, local.collect());
    }

    /// Notes a link that is up. Returns where it leads if it is a direct one.
    pub(crate) fn link_up(
        &mut self,
        now: Instant,
        link: LinkId,
        peer: NodeId,
        (remote, reach): (SocketAddr, DirectReach),
    ) -> Option<DirectReach> {
        let is_direct = self.paths.is_expected(&peer, remote)
            // The successor of a direct link.
            || self.links.values().any(|known| known.peer == peer);
        if !is_direct {
            return None;
        }
        self.links.insert(link, DirectLink { peer, is_silent: false, unused: None });
        self.paths.linked(now, peer);
        Some(reach)
    }

    /// Notes that a link ended.
    pub(crate) fn link_down(&mut self, now: Instant, link: LinkId) {
        self.observed.remove(&link);
        let Some(DirectLink { peer, .. }) = self.links.remove(&link) else { return };
        if self.links.values().all(|other| other.peer != peer) {
            self.paths.ended(now, peer);
        } else {
            self.silence_changed(now, peer);
        }
    }

    /// Notes whether nothing arrives over a link.
    pub(super) fn link_looked_at(&mut self, now: Instant, link: LinkId, is_silent: bool) {
        let Some(direct) = self.links.get_mut(&link) else { return };
        if std::mem::replace(&mut direct.is_silent, is_silent) != is_silent {
            let peer = direct.peer;
            self.silence_changed(now, peer);
        }
    }

    fn silence_changed(&mut self, now: Instant, peer: NodeId) {
        let is_silent = self.links.values().filter(|link| link.peer == peer).all(|link| link.is_silent);
        self.paths.silent(now, peer, is_silent);
    }

    /// Answers a peer that asks for the addresses of this node.
    pub(super) fn asked(
        &mut self,
        now: Instant,
        peer: &VerifiedPeer,
        question: &Bytes,
    ) -> Result<PathOffer, RefuseReason> {
        match PathQuestion::from_slice(question) {
            _ if self.permitted.find(peer).is_none() => Err(RefuseReason::NotPermitted),
            Ok(question) => {
                let offer = self.paths.asked(now, peer.node_id, question).ok_or(RefuseReason::Limit)?;
                Ok(match &mut self.tamper {
                    Some(tamper) => tamper(offer),
                    None => offer,
                })
            }
            Err(_) => Err(RefuseReason::RoleNotOffered),
        }
    }

    /// Returns the direct links that nothing has used for a while.
    pub(super) fn unused(&mut self, now: Instant, router: &Router) -> Vec<LinkId> {
        let mut over = Vec::new();
        for (link, direct) in &mut self.links {
            let is_superseded = router.is_superseded(*link);
            let is_used = !is_superseded && (self.paths.is_wanted(&direct.peer) || router.is_used(*link));
            let unused_max = if is_superseded { SUPERSEDED_MAX } else { UNUSED_MAX };
            direct.unused = if is_used { None } else { direct.unused.or(Some(now)) };
            if direct.unused.is_some_and(|since| now.saturating_duration_since(since) >= unused_max) {
                over.push(*link);
            }
        }
        over
    }

    pub(super) fn deadline(&mut self) -> Instant {
        self.paths.deadline().map_or(self.look_at, |at| at.min(self.look_at))
    }
}
