//! The network from its nodes' link states, and the routes through it.
//!
//! Each node signs its links. Routers pass link states on to each other, every one once, and each finds the shortest
//! routes by itself. An edge counts only if both its ends list it, so nobody can claim to be where it is not.
//! `names.rs` has the routes to names.

use std::collections::{BTreeMap, BTreeSet};
use std::ops::Bound;
use std::sync::Arc;
use std::time::{Duration, Instant};

use sgc_trust::{CertId, next_seq, signed_digest, verify_link_state};
use sgc_wire::{Adjacency, Control, LinkStateBody, NodeId, NodeTag, Now, SignedBody, UnixMillis};

use crate::links::LinkState;
use crate::memory::Memory;
use crate::router::{DropReason, LinkId, Router};
use crate::spf::{Path, shortest_paths};

/// Lifetime of a link state; it is signed anew after a third of it.
const LEASE: Duration = Duration::from_secs(300);
/// Least time between two link states of this node.
const ORIGINATE_EVERY: Duration = Duration::from_millis(100);
/// Least time between two searches for routes.
const SEARCH_EVERY: Duration = Duration::from_millis(50);
/// A cost that differs by less than a quarter is not announced anew.
const COST_PART: u32 = 4;

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

/// A node's verified link state.
#[derive(Debug)]
pub(crate) struct NodeRecord {
    pub(crate) seq: u64,
    /// Advertisements of it with lower numbers are void.
    pub(crate) floor: u64,
    pub(crate) transit: bool,
    routers: Vec<Adjacency>,
    attached: Vec<NodeTag>,
    pub(crate) certs: Arc<[CertId]>,
    pub(crate) signed: SignedBody,
    pub(crate) issued_at: UnixMillis,
    digest: [u8; 32],
    expires: Instant,
}

impl NodeRecord {
    fn cost_to(&self, router: &NodeId) -> Option<u32> {
        let at = self.routers.binary_search_by(|a| a.node.cmp(router)).ok()?;
        Some(self.routers[at].cost)
    }

    fn says(&self, node: &NodeId, transit: bool) -> bool {
        if transit { self.cost_to(node).is_some() } else { self.attached.binary_search(&node.tag()).is_ok() }
    }
}

/// Changes that affect routes.
#[derive(Debug, Default)]
struct Changes {
    /// Nodes that gained or lost a link to this node, or whose link states changed.
    nodes: BTreeSet<NodeId>,
    /// Nodes that a router gained or lost.
    attached: BTreeSet<NodeTag>,
}

/// All link states, and the routes to the routers among them.
#[derive(Debug, Default)]
pub(crate) struct Topology {
    nodes: BTreeMap<NodeId, NodeRecord>,
    expiries: BTreeSet<(Instant, NodeId)>,
    seen: BTreeMap<[u8; 32], NodeId>,
    /// Link states that are no longer in force.
    memory: Memory,
    /// Nodes whose link states wait for their allowance to be passed on.
    pub(crate) late: BTreeSet<NodeId>,
    paths: BTreeMap<NodeId, Path>,
    /// Changes since the last search.
    changes: Changes,
    /// Names whose routes were checked again after a search.
    pub(crate) names_checked: u64,
    /// Time of the next search, if something changed.
    pub(crate) search_at: Option<Instant>,
    searched: Option<Instant>,
    searches: u64,
    /// Time of the last search that found other routes.
    routes_changed: Option<Instant>,
    /// Time at which this node signs its next link state.
    pub(crate) originate_at: Option<Instant>,
    originated: Option<Instant>,
    own_seq: u64,
}

impl Topology {
    pub(crate) fn node(&self, node: &NodeId) -> Option<&NodeRecord> {
        self.nodes.get(node)
    }

    /// Returns the number of known nodes.
    pub(crate) fn len(&self) -> usize {
        self.nodes.len()
    }

    pub(crate) fn next_deadline(&self) -> Option<Instant> {
        self.expiries.first().map(|(at, _)| *at).into_iter().chain(self.memory.deadline()).min()
    }

    /// Iterates over nodes with link states, from one on.
    pub(crate) fn nodes_from(&self, from: Bound<NodeId>) -> impl Iterator<Item = (&NodeId, &NodeRecord)> {
        self.nodes.range((from, Bound::Unbounded))
    }

    /// Returns the greatest known number of a node's link states.
    fn known_seq(&self, node: &NodeId) -> Option<u64> {
        let ended = self.memory.floor(node).checked_sub(1);
        self.nodes.get(node).map(|record| record.seq).max(ended)
    }

    /// Returns the link state with that number.
    fn newest(&self, node: &NodeId) -> Option<(u64, &SignedBody)> {
        let in_force = self.nodes.get(node).map(|record| (record.seq, &record.signed));
        in_force.into_iter().chain(self.memory.newest(node)).max_by_key(|(seq, _)| *seq)
    }

    /// Notes that a link of this node to another one changed.
    pub(crate) fn link_changed(&mut self, now: Instant, node: &NodeId) {
        self.changes.nodes.insert(*node);
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
        let says = |record: Option<&NodeRecord>| record.map(|r| (r.transit, r.routers.clone()));
        let attached = |record: Option<&NodeRecord>| {
            record.into_iter().flat_map(|r| &r.attached).copied().collect::<BTreeSet<_>>()
        };
        let (before, after) = (attached(old), attached(new));
        let same = says(old) == says(new);
        if same && before == after {
            return;
        }
        self.changes.attached.extend(before.symmetric_difference(&after));
        // The search handles edges between routers.
        let is_router = |record: Option<&NodeRecord>| record.is_some_and(|r| r.transit);
        let edges_only = is_router(old) && is_router(new);
        if !same && !edges_only {
            self.changes.nodes.insert(*node);
        }
        self.touch(now);
    }

    fn touch(&mut self, now: Instant) {
        let at = self.searched.map_or(now, |at| now.max(at + SEARCH_EVERY));
        self.search_at.get_or_insert(at);
    }

    /// Begins. A router waits a moment for its links to come up, so that its first link state has all of them; a node
    /// that only shares or asks is in more of a hurry.
    pub(crate) fn begin(&mut self, now: Instant, transit: bool) {
        self.originated = transit.then_some(now);
        self.touch_own(now);
    }

    /// Notes that this node's own links changed.
    pub(crate) fn touch_own(&mut self, now: Instant) {
        let at = self.originated.map_or(now, |at| now.max(at + ORIGINATE_EVERY));
        self.originate_at = Some(self.originate_at.map_or(at, |due| due.min(at)));
    }

    /// Returns the route from this router to a node: its cost and the first node on it.
    pub(crate) fn next_hop(&self, own: &NodeId, node: &NodeId) -> Option<(u32, NodeId)> {
        if let Some(path) = self.paths.get(node) {
            return Some((path.cost, path.first));
        }
        let record = self.nodes.get(node).filter(|r| !r.transit)?;
        let over = |at: &Adjacency| {
            let path = self.paths.get(&at.node)?;
            let attached = self.nodes.get(&at.node).is_some_and(|r| r.says(node, false));
            let first = if at.node == *own { *node } else { path.first };
            attached.then(|| (path.cost.saturating_add(at.cost), path.hops, first))
        };
        record.routers.iter().filter_map(over).min().map(|(cost, _, first)| (cost, first))
    }

    /// Returns the results of the route searches.
    pub(crate) fn route_stats(&self) -> RouteStats {
        RouteStats {
            routers: self.paths.len(),
            searches: self.searches,
            changed: self.routes_changed,
            names_checked: self.names_checked,
        }
    }

    /// Returns `true` if a later run of a node than the one that `started` then is linked to another router than `own`,
    /// and that router lists it, too.
    pub(crate) fn is_elsewhere(&self, own: &NodeId, node: &NodeId, started: UnixMillis) -> bool {
        let Some(record) = self.nodes.get(node).filter(|r| r.floor > started.0) else { return false };
        let says = |at: &Adjacency| self.nodes.get(&at.node).is_some_and(|r| r.says(node, record.transit));
        record.routers.iter().any(|at| at.node != *own && self.paths.contains_key(&at.node) && says(at))
    }

    /// Searches for the routes to all routers. Returns these owners' ids whose routes may have changed.
    fn search<'a>(
        &mut self,
        now: Instant,
        root: NodeId,
        owners: impl Iterator<Item = &'a NodeId>,
    ) -> Vec<NodeId> {
        self.search_at = None;
        self.searched = Some(now);
        let nodes = &self.nodes;
        let edges = |from: &NodeId| {
            let from = *from;
            let record = nodes.get(&from).filter(|r| r.transit);
            record.into_iter().flat_map(|r| &r.routers).filter_map(move |a| {
                let back = nodes.get(&a.node).filter(|r| r.transit)?.says(&from, true);
                back.then_some((a.node, a.cost))
            })
        };
        let paths = shortest_paths(root, &self.paths, edges);
        self.searches += 1;
        if paths != self.paths {
            self.routes_changed = Some(now);
        }
        let before = std::mem::replace(&mut self.paths, paths);
        let Changes { mut nodes, attached } = std::mem::take(&mut self.changes);
        let moved = |node: &NodeId| {
            let path = self.paths.get(node);
            path != before.get(node) || path.is_some_and(|p| nodes.contains(&p.first))
        };
        let routers: BTreeSet<_> = self
            .paths
            .keys()
            .chain(before.keys())
            .filter(|n| nodes.contains(*n) || moved(n))
            .copied()
            .collect();
        if attached.is_empty() && routers.is_empty() {
            return nodes.into_iter().collect();
        }
        nodes.extend(&routers);
        let concerned = |owner: &NodeId| {
            let over = || self.nodes.get(owner).into_iter().flat_map(|r| &r.routers);
            nodes.contains(owner)
                || attached.contains(&owner.tag())
                || over().any(|at| routers.contains(&at.node))
        };
        owners.filter(|owner| concerned(owner)).copied().collect()
    }

    fn insert(&mut self, now: Instant, node: NodeId, record: NodeRecord, max: usize) {
        let old = self.take(&node);
        self.record_changed(now, &node, old.as_ref(), Some(&record));
        if let Some(old) = old {
            self.memory.superseded(now, &node, old.seq, old.digest, max);
        }
        self.seen.insert(record.digest, node);
        self.expiries.insert((record.expires, node));
        self.nodes.insert(node, record);
    }

    /// Ends a link state. Returns the number below which advertisements of its node are void.
    fn end(&mut self, now: Instant, node: &NodeId, max: usize) -> Option<u64> {
        let old = self.take(node)?;
        self.record_changed(now, node, Some(&old), None);
        self.memory.ended(now, node, old.seq, old.digest, &old.signed, max);
        Some(old.floor)
    }

    fn take(&mut self, node: &NodeId) -> Option<NodeRecord> {
        let old = self.nodes.remove(node)?;
        self.seen.remove(&old.digest);
        self.expiries.remove(&(old.expires, *node));
        self.late.remove(node);
        Some(old)
    }
}

impl Router {
    /// Handles a change of this node's links to a neighbour, or of their costs.
    pub(crate) fn links_changed(&mut self, now: Instant, neighbour: &NodeId) {
        self.topology.touch_own(now);
        self.topology.link_changed(now, neighbour);
    }

    pub(crate) fn handle_link_state(&mut self, now: Now, link: LinkId, signed: SignedBody) {
        let Some(state) = self.links.get(&link).filter(|_| link != LinkId::LOCAL) else { return };
        let (neighbour, from_router) = (state.node, state.is_transit());
        let digest = signed_digest(&signed);
        if self.topology.seen.contains_key(&digest) {
            return;
        }
        if let Some((node, seq)) = self.topology.memory.known(&digest) {
            return self.stale_link_state(link, &node, seq);
        }
        if !self.may_bring(link) {
            return;
        }
        let verified = match verify_link_state(&self.config.anchors, &signed, now.unix) {
            Ok(verified) => verified,
            Err(why) => return self.not_verified(now, link, "link state", why),
        };
        let (node, body) = (verified.node.node_id, verified.body);
        if node == self.config.node {
            // From an earlier run whose clock was ahead: this run continues from there.
            if body.seq >= self.topology.own_seq {
                self.topology.own_seq = body.seq;
                self.topology.touch_own(now.instant);
            } else {
                self.charge_stale(link);
            }
            return;
        }
        let refused = if !self.config.transit {
            Some(DropReason::Unknown { what: "link state" })
        } else if !from_router && node != neighbour {
            Some(DropReason::NotOwner { owner: node })
        } else if body.transit && !verified.node.may_route {
            Some(DropReason::NotRouter)
        } else {
            None
        };
        if let Some(refused) = refused {
            self.charge_stale(link);
            return self.drop_frame(link, refused);
        }
        if self.topology.known_seq(&node).is_some_and(|known| known >= body.seq) {
            self.charge_stale(link);
            return self.stale_link_state(link, &node, body.seq);
        }
        let nodes_max = self.config.limits.nodes_max;
        if self.topology.node(&node).is_none() && self.topology.len() >= nodes_max {
            self.charge_stale(link);
            return self.drop_frame(link, DropReason::Limit { what: "nodes" });
        }
        let expires = match self.lease_end(now, body.lease_ms, &verified.node) {
            Ok(expires) => expires,
            Err(why) => return self.not_verified(now, link, "link state", why),
        };
        let record = NodeRecord {
            seq: body.seq,
            floor: body.floor,
            transit: body.transit,
            routers: body.routers,
            attached: body.attached,
            certs: verified.node.path,
            signed,
            issued_at: body.issued_at,
            digest,
            expires,
        };
        let floor = record.floor;
        self.topology.insert(now.instant, node, record, nodes_max);
        self.void_names(&node, floor);
        if node != neighbour {
            self.supersede_runs_before(&node, floor);
        }
        self.pass_on_node_or_wait(link, &node);
    }

    /// Answers an old link state of a node: if it comes from the node itself, the node should learn the newer number.
    fn stale_link_state(&mut self, link: LinkId, node: &NodeId, seq: u64) {
        let known = self.topology.known_seq(node).unwrap_or(seq);
        if self.links.get(&link).is_some_and(|state| state.node == *node)
            && let Some((_, newer)) = self.topology.newest(node).filter(|(newer, _)| *newer > seq)
        {
            let signed = newer.clone();
            self.send(link, Control::LinkState { signed });
        }
        self.drop_frame(link, DropReason::Stale { seq, known });
    }

    /// Closes the links of earlier runs of a node whose latest run is linked to another router.
    fn supersede_runs_before(&mut self, node: &NodeId, floor: u64) {
        let of_node = self.links_of.get(node).into_iter().flatten().copied();
        let earlier = |link: &LinkId| {
            let hello = self.links.get(link).and_then(|s| s.hello);
            hello.is_some_and(|h| h.started.0 < floor)
        };
        let earlier: Vec<_> = of_node.filter(earlier).collect();
        for link in earlier {
            let alive = self.links.get(&link).and_then(|s| s.hello).is_some_and(|h| h.yields);
            self.supersede(link, None, alive);
        }
    }

    /// Signs this node's link state, if that is due, and sends it to all neighbouring routers.
    pub(crate) fn originate_due(&mut self, now: Now) {
        if self.topology.originate_at.is_none_or(|at| at > now.instant) {
            return;
        }
        self.topology.originated = Some(now.instant);
        self.topology.originate_at = Some(now.instant + LEASE / 3);
        let mut routers = BTreeMap::<NodeId, u32>::new();
        let mut attached = BTreeSet::new();
        let greeted = |(l, s): &(&LinkId, &LinkState)| **l != LinkId::LOCAL && s.hello.is_some();
        for (_, state) in self.links.iter().filter(greeted) {
            if state.is_transit() {
                let cost = routers.entry(state.node).or_insert(u32::MAX);
                *cost = state.cost.now().min(*cost);
            } else if self.config.transit {
                attached.insert(state.node.tag());
            }
        }
        let own_seq = next_seq(self.topology.own_seq, now.unix);
        self.topology.own_seq = own_seq;
        let identity = &self.config.identity;
        let body = LinkStateBody {
            chain: identity.chain_bytes(),
            seq: own_seq,
            issued_at: now.unix,
            lease_ms: LEASE.as_millis() as u32,
            floor: self.config.started.0,
            transit: self.config.transit,
            routers: routers.into_iter().map(|(node, cost)| Adjacency { node, cost }).collect(),
            attached: attached.into_iter().collect(),
        };
        let signed = identity.sign_link_state(&body);
        let node = self.config.node;
        let record = NodeRecord {
            seq: body.seq,
            floor: body.floor,
            transit: body.transit,
            routers: body.routers,
            attached: body.attached,
            certs: Arc::new([]),
            digest: signed_digest(&signed),
            signed,
            issued_at: body.issued_at,
            // Always renewed before.
            expires: now.instant + LEASE,
        };
        self.topology.insert(now.instant, node, record, self.config.limits.nodes_max);
        self.tell_link_state(LinkId::LOCAL, &node);
    }

    /// Passes on a link state: a router's to all routers, others as the mapping says.
    pub(crate) fn tell_link_state(&mut self, ingress: LinkId, node: &NodeId) {
        let is_told = |record: &&NodeRecord| self.verifies_elsewhere(record.issued_at);
        let Some(record) = self.topology.node(node).filter(is_told) else { return };
        let (everyone, signed) = (record.transit || *node == self.config.node, record.signed.clone());
        let everyone = everyone || self.mapping.tells_unasked();
        let targets: Vec<_> = self
            .links
            .iter()
            .filter(|(l, s)| **l != ingress && s.is_transit() && (everyone || s.follows.contains_key(node)))
            .map(|(l, _)| *l)
            .collect();
        for link in targets {
            self.send(link, Control::LinkState { signed: signed.clone() });
        }
    }

    /// Searches for routes if that is due, and updates everything that takes another route now.
    pub(crate) fn search_due(&mut self, now: Now) {
        if self.topology.search_at.is_none_or(|at| at > now.instant) {
            return;
        }
        if self.config.transit {
            let owners = self.topology.search(now.instant, self.config.node, self.names.owners());
            self.owner_routes_changed(&owners);
        } else {
            self.topology.search_at = None;
            self.topology.changes = Changes::default();
            self.own_links_changed();
        }
    }

    pub(crate) fn expire_nodes(&mut self, now: Now) {
        while let Some((at, node)) =
            self.topology.expiries.first().copied().filter(|(at, _)| *at <= now.instant)
        {
            self.topology.expiries.remove(&(at, node));
            if node != self.config.node {
                self.end_node(now.instant, &node);
            }
        }
        self.topology.memory.expire(now.instant);
    }

    /// Ends a link state; advertisements from before its run stay void.
    fn end_node(&mut self, now: Instant, node: &NodeId) {
        if let Some(floor) = self.topology.end(now, node, self.config.limits.nodes_max) {
            self.names.run_ended(now, node, floor, self.config.limits.nodes_max);
        }
    }

    /// Forgets link states under certificates that are no longer believed.
    pub(crate) fn distrust_nodes(&mut self, now: Instant) {
        let gone: Vec<_> = self
            .topology
            .nodes
            .iter()
            .filter(|(_, r)| self.is_untrusted(&r.certs))
            .map(|(n, _)| *n)
            .collect();
        for node in gone {
            // It counts again if its certificate does.
            let old = self.topology.take(&node);
            self.topology.record_changed(now, &node, old.as_ref(), None);
        }
    }

    /// Returns the best link to a neighbour: the cheapest, of about equal ones the newest.
    pub(crate) fn link_to(&self, node: &NodeId) -> Option<(LinkId, u32)> {
        let of_node = self.links_of.get(node).into_iter().flatten().rev();
        let up =
            of_node.filter_map(|link| Some((*link, self.links.get(link).filter(|s| s.hello.is_some())?)));
        let mut best: Option<(LinkId, u32)> = None;
        for (link, state) in up {
            let cost = state.cost.now();
            if best.is_none_or(|(_, known)| cost.saturating_mul(2).saturating_add(5000) < known) {
                best = Some((link, cost));
            }
        }
        best
    }
}

/// Returns `true` if a neighbour that was told `old` has to be told `new`.
pub(crate) fn cost_differs(old: u32, new: u32) -> bool {
    old.abs_diff(new) > old.min(new) / COST_PART
}
