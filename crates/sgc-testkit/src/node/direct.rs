//! [`DirectNode`]: the direct links of a node, and the machine that finds them.

use std::collections::{BTreeMap, BTreeSet};
use std::net::SocketAddr;
use std::time::{Duration, Instant};

use bytes::Bytes;
use rand_chacha::ChaCha20Rng;
use rand_core::SeedableRng as _;
use sgc_router::{DirectReach, LinkId, Router};
use sgc_session::{DirectLinkTable, DirectPaths, local_addresses};
use sgc_trust::{Grantees, VerifiedPeer};
use sgc_wire::{NodeId, PathOffer, RefuseReason};

/// A function that replaces the addresses that a node tells a peer.
pub(crate) type TamperOffers = Box<dyn FnMut(PathOffer) -> PathOffer>;

/// Interval of looks at the links, as in `sgc-node`.
pub(super) const LOOK_EVERY: Duration = Duration::from_millis(500);
/// The direct links of a node.
pub(crate) struct DirectNode {
    pub(crate) paths: DirectPaths,
    links: DirectLinkTable<LinkId>,
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
            links: DirectLinkTable::default(),
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
        self.links.is_direct(link)
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
        self.paths.set_local(now, local_addresses(&[base], None, &self.reflexive));
    }

    /// Notes a link that is up. Returns where it leads if it is a direct one.
    pub(crate) fn link_up(
        &mut self,
        now: Instant,
        link: LinkId,
        peer: NodeId,
        (remote, reach): (SocketAddr, DirectReach),
    ) -> Option<DirectReach> {
        self.links.link_up(now, &mut self.paths, link, peer, remote).then_some(reach)
    }

    /// Notes that a link ended.
    pub(crate) fn link_down(&mut self, now: Instant, link: LinkId) {
        self.observed.remove(&link);
        self.links.link_down(now, &mut self.paths, link);
    }

    /// Notes whether nothing arrives over a link.
    pub(super) fn link_looked_at(&mut self, now: Instant, link: LinkId, is_silent: bool) {
        self.links.link_looked_at(now, &mut self.paths, link, is_silent);
    }

    /// Answers a peer that asks for the addresses of this node.
    pub(super) fn asked(
        &mut self,
        now: Instant,
        peer: &VerifiedPeer,
        question: &Bytes,
    ) -> Result<PathOffer, RefuseReason> {
        let is_permitted = self.permitted.find(peer).is_some();
        let offer = self.paths.answer(now, peer.node_id, is_permitted, question)?;
        Ok(match &mut self.tamper {
            Some(tamper) => tamper(offer),
            None => offer,
        })
    }

    /// Returns the direct links that nothing has used for a while.
    pub(super) fn unused(&mut self, now: Instant, router: &Router) -> Vec<LinkId> {
        let (is_superseded, is_used) = (|link| router.is_superseded(link), |link| router.is_used(link));
        self.links.unused(now, &self.paths, is_superseded, is_used)
    }

    pub(super) fn deadline(&mut self) -> Instant {
        self.paths.deadline().map_or(self.look_at, |at| at.min(self.look_at))
    }
}
