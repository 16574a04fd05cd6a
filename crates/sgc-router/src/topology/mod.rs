//! The network from its nodes' link states, and the routes through it.
//!
//! Each node signs its links. Routers pass link states on to each other, every one once, and each finds the shortest
//! routes by itself. An edge counts only if both its ends list it, so nobody can claim to be where it is not.
//!
//! This part verifies nothing: the router does that first.

mod paths;
mod record;

use std::collections::{BTreeMap, BTreeSet};
use std::ops::Bound;
use std::sync::Arc;
use std::time::{Duration, Instant};

use sgc_trust::{CertId, Identity, SignedError, VerifiedLinkState, next_seq, signed_digest};
use sgc_wire::{Adjacency, LinkStateBody, NodeId, NodeTag, Now, SignedBody, UnixMillis};

pub use self::paths::{Path, ShortestPaths};
pub(crate) use self::record::NodeRecord;
use crate::config::RouterConfig;
use crate::drops::DropReason;
use crate::lease::lease_end;
use crate::links::Peer;
use crate::memory::Memory;

/// Lifetime of a link state; it is signed anew after a third of it.
const LEASE: Duration = Duration::from_secs(300);
/// Least time between two link states of this node.
const ORIGINATE_EVERY: Duration = Duration::from_millis(100);
/// Least time between two searches for routes.
const SEARCH_EVERY: Duration = Duration::from_millis(50);

/// Results of a router's searches for routes.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct RouteStats {
    /// Routers in reach, this one among them.
    pub routers: usize,
    /// Searches so far.
    pub searches: u64,
    /// Time of the last search that found other routes.
    pub changed: Option<Instant>,
    /// Names whose routes were checked again because of them.
    pub names_checked: u64,
}

/// Changes that affect routes.
#[derive(Debug, Default)]
struct Changes {
    /// Nodes that gained or lost a link to this node, or whose link states changed.
    nodes: BTreeSet<NodeId>,
    /// Nodes that a router gained or lost.
    attached: BTreeSet<NodeTag>,
}

/// A link state as its digest tells it.
#[derive(Debug, PartialEq, Eq)]
pub(crate) enum Recognised {
    /// It has to be verified.
    New,
    /// It is in force.
    InForce,
    /// It is no longer in force.
    Ended { node: NodeId, seq: u64 },
}

/// The consequence of a verified link state.
#[derive(Debug, PartialEq, Eq)]
pub(crate) enum Admission {
    /// It is in force from now on; advertisements of its node with numbers below the floor are void.
    Admitted { node: NodeId, floor: u64 },
    /// It is this node's own, of an earlier run whose clock was ahead: this run continues from there.
    Own,
    /// It is this node's own, and old.
    OwnStale,
    /// It is older than the known one.
    Stale { node: NodeId, seq: u64 },
    /// It does not count.
    Refused(DropReason),
    /// No time of its lease is left.
    Ended(SignedError),
}

/// A node whose link state ended, and the floor in it.
#[derive(Debug, PartialEq, Eq)]
pub(crate) struct EndedRun {
    pub(crate) node: NodeId,
    pub(crate) floor: u64,
}

/// All link states, and the routes to the routers among them.
#[derive(Debug)]
pub(crate) struct Topology {
    own: NodeId,
    transit: bool,
    /// The floor in this node's own link state.
    own_floor: u64,
    nodes_max: usize,
    lease_max: Duration,
    nodes: BTreeMap<NodeId, NodeRecord>,
    expiries: BTreeSet<(Instant, NodeId)>,
    seen: BTreeMap<[u8; 32], NodeId>,
    /// Link states that are no longer in force.
    memory: Memory,
    /// Nodes whose link states wait for their allowance to be passed on.
    late: BTreeSet<NodeId>,
    paths: ShortestPaths,
    /// Changes since the last search.
    changes: Changes,
    /// Names whose routes were checked again after a search.
    names_checked: u64,
    /// Time of the next search, if something changed.
    search_at: Option<Instant>,
    searched: Option<Instant>,
    searches: u64,
    /// Time of the last search that found other routes.
    routes_changed: Option<Instant>,
    /// Time at which this node signs its next link state.
    originate_at: Option<Instant>,
    originated: Option<Instant>,
    own_seq: u64,
}

impl Topology {
    /// Begins. A router waits a moment for its links to come up, so that its first link state has all of them; a node
    /// that only shares or asks is in more of a hurry.
    pub(crate) fn new(now: Instant, config: &RouterConfig) -> Self {
        let mut topology = Self {
            own: config.node,
            transit: config.transit,
            own_floor: config.started.0,
            nodes_max: config.limits.nodes_max,
            lease_max: config.limits.lease_max,
            nodes: BTreeMap::new(),
            expiries: BTreeSet::new(),
            seen: BTreeMap::new(),
            memory: Memory::default(),
            late: BTreeSet::new(),
            paths: ShortestPaths::new(config.node),
            changes: Changes::default(),
            names_checked: 0,
            search_at: None,
            searched: None,
            searches: 0,
            routes_changed: None,
            originate_at: None,
            originated: config.transit.then_some(now),
            own_seq: 0,
        };
        topology.touch_own(now);
        topology
    }

    // ---- Looking nodes up.

    /// Returns a node's link state.
    pub(crate) fn node(&self, node: &NodeId) -> Option<&NodeRecord> {
        self.nodes.get(node)
    }

    /// Returns `true` if this node carries others' names.
    pub(crate) fn is_transit(&self) -> bool {
        self.transit
    }

    /// Returns this node's own link state.
    pub(crate) fn own(&self) -> Option<&NodeRecord> {
        self.nodes.get(&self.own)
    }

    /// Returns the floor in a node's link state: its advertisements with lower numbers are void.
    pub(crate) fn floor(&self, node: &NodeId) -> Option<u64> {
        self.nodes.get(node).map(|record| record.floor)
    }

    /// Returns the number of known nodes.
    pub(crate) fn len(&self) -> usize {
        self.nodes.len()
    }

    /// Returns the times of the next timeouts.
    pub(crate) fn deadlines(&self) -> impl Iterator<Item = Instant> {
        let expiry = self.expiries.first().map(|(at, _)| *at);
        [self.search_at, self.originate_at, expiry, self.memory.deadline()].into_iter().flatten()
    }

    /// Iterates over other nodes' link states, after one.
    pub(crate) fn others_after(&self, after: Option<NodeId>) -> impl Iterator<Item = (&NodeId, &NodeRecord)> {
        let from = after.map_or(Bound::Unbounded, Bound::Excluded);
        self.nodes.range((from, Bound::Unbounded)).filter(|(node, _)| **node != self.own)
    }

    /// Returns the greatest known number of a node's link states.
    pub(crate) fn known_seq(&self, node: &NodeId) -> Option<u64> {
        let ended = self.memory.floor(node).checked_sub(1);
        self.nodes.get(node).map(|record| record.seq).max(ended)
    }

    /// Returns the link state with that number.
    pub(crate) fn newest(&self, node: &NodeId) -> Option<(u64, &SignedBody)> {
        let in_force = self.nodes.get(node).map(|record| (record.seq, &record.signed));
        in_force.into_iter().chain(self.memory.newest(node)).max_by_key(|(seq, _)| *seq)
    }

    // ---- Changes.

    /// Notes that this node's links to a neighbour changed, or their costs.
    pub(crate) fn links_changed(&mut self, now: Instant, neighbour: &NodeId) {
        self.touch_own(now);
        self.changes.nodes.insert(*neighbour);
        self.touch(now);
    }

    /// Notes that a node's link state changed or ended. A mere renewal changes no route.
    fn record_changed(
        &mut self,
        now: Instant,
        node: &NodeId,
        old: Option<&NodeRecord>,
        new: Option<&NodeRecord>,
    ) {
        let same = old.map(|r| (r.transit, &r.routers)) == new.map(|r| (r.transit, &r.routers));
        let attached = |record: Option<&NodeRecord>| {
            record.into_iter().flat_map(|r| &r.attached).copied().collect::<BTreeSet<_>>()
        };
        let (before, after) = (attached(old), attached(new));
        if same && before == after {
            return;
        }
        self.changes.attached.extend(before.symmetric_difference(&after));
        self.edges_changed(node, old, new);
        // The search handles edges between routers.
        let is_router = |record: Option<&NodeRecord>| record.is_some_and(|r| r.transit);
        let edges_only = is_router(old) && is_router(new);
        if !same && !edges_only {
            self.changes.nodes.insert(*node);
        }
        self.touch(now);
    }

    /// Gives the edges of a node to the paths: those to routers that list it, too.
    fn edges_changed(&mut self, node: &NodeId, old: Option<&NodeRecord>, new: Option<&NodeRecord>) {
        let listed = [old, new].into_iter().flatten().flat_map(|r| r.routers.iter().map(|a| a.node));
        for other in listed.filter(|other| other != node) {
            let Some(back) = self.nodes.get(&other).and_then(|r| r.cost_to_router(node)) else { continue };
            let costs = |record: Option<&NodeRecord>| Some([record?.cost_to_router(&other)?, back]);
            if costs(old) != costs(new) {
                self.paths.set_edge(node, &other, costs(new));
            }
        }
    }

    fn touch(&mut self, now: Instant) {
        let at = self.searched.map_or(now, |at| now.max(at + SEARCH_EVERY));
        self.search_at.get_or_insert(at);
    }

    /// Notes that this node's own links changed.
    pub(crate) fn touch_own(&mut self, now: Instant) {
        let at = self.originated.map_or(now, |at| now.max(at + ORIGINATE_EVERY));
        self.originate_at = Some(self.originate_at.map_or(at, |due| due.min(at)));
    }

    /// Returns the route from this router to a node: its cost and the first node on it.
    pub(crate) fn next_hop(&self, node: &NodeId) -> Option<(u32, NodeId)> {
        if let Some(path) = self.paths.get(node) {
            return Some((path.cost, path.first));
        }
        let record = self.nodes.get(node).filter(|r| !r.transit)?;
        let over = |at: &Adjacency| {
            let path = self.paths.get(&at.node)?;
            let attached = self.nodes.get(&at.node).is_some_and(|r| r.says(node, false));
            let first = if at.node == self.own { *node } else { path.first };
            attached.then(|| (path.cost.saturating_add(at.cost), path.hops, first))
        };
        record.routers.iter().filter_map(over).min().map(|(cost, _, first)| (cost, first))
    }

    /// Returns the results of the route searches.
    pub(crate) fn route_stats(&self) -> RouteStats {
        RouteStats {
            routers: self.paths.reached(),
            searches: self.searches,
            changed: self.routes_changed,
            names_checked: self.names_checked,
        }
    }

    /// Returns `true` if a later run of a node than the one that `started` then is linked to another router than
    /// this node, and that router lists it, too.
    pub(crate) fn is_elsewhere(&self, node: &NodeId, started: UnixMillis) -> bool {
        let Some(record) = self.nodes.get(node).filter(|r| r.floor > started.0) else { return false };
        let says = |at: &Adjacency| self.nodes.get(&at.node).is_some_and(|r| r.says(node, record.transit));
        record.routers.iter().any(|at| at.node != self.own && self.paths.get(&at.node).is_some() && says(at))
    }

    // ---- Searches for routes.

    /// Returns `true` if a search is due.
    pub(crate) fn is_search_due(&self, now: Instant) -> bool {
        self.search_at.is_some_and(|at| at <= now)
    }

    /// Forgets the changes at a node that sees no topology.
    pub(crate) fn skip_search(&mut self) {
        self.search_at = None;
        self.changes = Changes::default();
    }

    /// Counts names whose routes are checked again after a search.
    pub(crate) fn count_checked(&mut self, names: usize) {
        self.names_checked += names as u64;
    }

    /// Searches for the routes to all routers. Returns the nodes whose routes may have changed.
    pub(crate) fn search(&mut self, now: Instant) -> BTreeSet<NodeId> {
        self.search_at = None;
        self.searched = Some(now);
        let mut routers = self.paths.search();
        self.searches += 1;
        if !routers.is_empty() {
            self.routes_changed = Some(now);
        }
        let Changes { mut nodes, mut attached } = std::mem::take(&mut self.changes);
        for node in &nodes {
            routers.extend(self.paths.get(node).map(|_| *node));
            routers.extend(self.paths.behind(node));
        }
        for router in routers {
            nodes.insert(router);
            attached.extend(self.nodes.get(&router).into_iter().flat_map(|r| &r.attached));
        }
        for tag in &attached {
            nodes.extend(self.with_tag(tag));
        }
        nodes
    }

    /// Iterates over the known nodes with this tag.
    fn with_tag(&self, tag: &NodeTag) -> impl Iterator<Item = NodeId> {
        let (mut first, mut last) = ([0; 32], [u8::MAX; 32]);
        first[..tag.0.len()].copy_from_slice(&tag.0);
        last[..tag.0.len()].copy_from_slice(&tag.0);
        self.nodes.range(NodeId(first)..=NodeId(last)).map(|(node, _)| *node)
    }

    // ---- Link states that come.

    /// Returns the link state with this digest.
    pub(crate) fn recognise(&self, digest: &[u8; 32]) -> Recognised {
        if self.seen.contains_key(digest) {
            return Recognised::InForce;
        }
        match self.memory.known(digest) {
            Some((node, seq)) => Recognised::Ended { node, seq },
            None => Recognised::New,
        }
    }

    /// Takes a verified link state that a neighbour brought.
    pub(crate) fn admit(
        &mut self,
        now: Now,
        from: Peer,
        signed: SignedBody,
        digest: [u8; 32],
        verified: VerifiedLinkState,
    ) -> Admission {
        let VerifiedLinkState { node: signer, body } = verified;
        let node = signer.node_id;
        if node == self.own {
            if body.seq < self.own_seq {
                return Admission::OwnStale;
            }
            self.own_seq = body.seq;
            self.touch_own(now.instant);
            return Admission::Own;
        }
        if !self.transit {
            return Admission::Refused(DropReason::Unknown { what: "link state" });
        } else if !from.is_router && node != from.node {
            return Admission::Refused(DropReason::NotOwner { owner: node });
        } else if body.transit && !signer.may_route {
            return Admission::Refused(DropReason::NotRouter);
        }
        if self.known_seq(&node).is_some_and(|known| known >= body.seq) {
            return Admission::Stale { node, seq: body.seq };
        }
        if !self.nodes.contains_key(&node) && self.nodes.len() >= self.nodes_max {
            return Admission::Refused(DropReason::Limit { what: "nodes" });
        }
        let expires = match lease_end(now, body.lease_ms, self.lease_max, &signer) {
            Ok(expires) => expires,
            Err(why) => return Admission::Ended(why),
        };
        let floor = body.floor;
        self.insert(now.instant, node, record(body, signer.path, signed, digest, expires));
        Admission::Admitted { node, floor }
    }

    /// Signs this node's link state with these neighbours, if that is due. Returns `true` if so.
    pub(crate) fn originate_due(
        &mut self,
        now: Now,
        identity: &Identity,
        neighbours: impl FnOnce() -> (BTreeMap<NodeId, u32>, BTreeSet<NodeTag>),
    ) -> bool {
        if self.originate_at.is_none_or(|at| at > now.instant) {
            return false;
        }
        self.originated = Some(now.instant);
        self.originate_at = Some(now.instant + LEASE / 3);
        // Nobody believes the holder of an invitation, and nobody looks for it.
        if identity.as_peer().invitation.is_some() {
            return false;
        }
        self.own_seq = next_seq(self.own_seq, now.unix);
        let (routers, attached) = neighbours();
        let body = LinkStateBody {
            chain: identity.chain_bytes(),
            seq: self.own_seq,
            issued_at: now.unix,
            lease_ms: LEASE.as_millis() as u32,
            floor: self.own_floor,
            transit: self.transit,
            routers: routers.into_iter().map(|(node, cost)| Adjacency { node, cost }).collect(),
            // Nodes are attached to routers alone.
            attached: if self.transit { attached.into_iter().collect() } else { Vec::new() },
        };
        let signed = identity.sign_link_state(&body);
        let digest = signed_digest(&signed);
        // Always renewed before.
        let expires = now.instant + LEASE;
        self.insert(now.instant, self.own, record(body, Arc::new([]), signed, digest, expires));
        true
    }

    fn insert(&mut self, now: Instant, node: NodeId, record: NodeRecord) {
        let old = self.take(&node);
        self.record_changed(now, &node, old.as_ref(), Some(&record));
        if let Some(old) = old {
            self.memory.superseded(now, &node, old.seq, old.digest, self.nodes_max);
        }
        self.seen.insert(record.digest, node);
        self.expiries.insert((record.expires, node));
        self.nodes.insert(node, record);
    }

    // ---- Link states that end.

    /// Ends the link states whose leases are over. Returns their nodes: advertisements from before their runs stay
    /// void.
    pub(crate) fn expire(&mut self, now: Instant) -> Vec<EndedRun> {
        let mut ended = Vec::new();
        while let Some((at, node)) = self.expiries.first().copied().filter(|(at, _)| *at <= now) {
            self.expiries.remove(&(at, node));
            if node != self.own {
                ended.extend(self.end(now, &node).map(|floor| EndedRun { node, floor }));
            }
        }
        self.memory.expire(now);
        ended
    }

    /// Forgets link states under certificates that are no longer believed.
    pub(crate) fn distrust(&mut self, now: Instant, is_untrusted: impl Fn(&[CertId]) -> bool) {
        let gone = self.nodes.iter().filter(|(_, record)| is_untrusted(&record.certs));
        for node in gone.map(|(node, _)| *node).collect::<Vec<_>>() {
            // It counts again if its certificate does.
            let old = self.take(&node);
            self.record_changed(now, &node, old.as_ref(), None);
        }
    }

    /// Ends a link state. Returns the number below which advertisements of its node are void.
    fn end(&mut self, now: Instant, node: &NodeId) -> Option<u64> {
        let old = self.take(node)?;
        self.record_changed(now, node, Some(&old), None);
        self.memory.ended(now, node, old.seq, old.digest, &old.signed, self.nodes_max);
        Some(old.floor)
    }

    fn take(&mut self, node: &NodeId) -> Option<NodeRecord> {
        let old = self.nodes.remove(node)?;
        self.seen.remove(&old.digest);
        self.expiries.remove(&(old.expires, *node));
        self.late.remove(node);
        Some(old)
    }

    // ---- Link states that wait to be passed on.

    /// Lets a link state wait for the allowance of its node.
    pub(crate) fn wait(&mut self, node: NodeId) {
        self.late.insert(node);
    }

    /// Returns the nodes whose link states wait, and ends their wait.
    pub(crate) fn take_waiting(&mut self) -> BTreeSet<NodeId> {
        std::mem::take(&mut self.late)
    }

    /// Returns `true` if a link state waits.
    pub(crate) fn has_waiting(&self) -> bool {
        !self.late.is_empty()
    }
}

fn record(
    body: LinkStateBody,
    certs: Arc<[CertId]>,
    signed: SignedBody,
    digest: [u8; 32],
    expires: Instant,
) -> NodeRecord {
    let LinkStateBody { seq, floor, transit, routers, attached, issued_at, .. } = body;
    NodeRecord { seq, floor, transit, routers, attached, certs, signed, issued_at, digest, expires }
}

#[cfg(test)]
mod tests;
