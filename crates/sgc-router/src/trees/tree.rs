//! The branches of one name, and the forwarding entry that they make.

use std::collections::BTreeMap;
use std::sync::Arc;
use std::time::Instant;

use sgc_trust::{CertId, VerifiedPeer};
use sgc_wire::{NodeId, Role, SinkId};
use smallvec::SmallVec;

use crate::fib::{self, FibEntry};
use crate::link_id::LinkId;

/// Stage of a branch, by the event that it waits for.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Stage {
    /// The owner's answer.
    ExpectAnswer { until: Instant },
    /// Nothing.
    Granted,
    /// The sink's new request over a better route.
    Draining { until: Instant },
}

/// A verified request to join, and the links that it takes.
#[derive(Debug)]
pub(crate) struct NewBranch {
    /// The link towards the sink.
    pub(crate) link: LinkId,
    /// The node at its other end.
    pub(crate) neighbour: NodeId,
    /// The link towards the owner.
    pub(crate) up: LinkId,
    /// The owner of the name.
    pub(crate) owner: Arc<VerifiedPeer>,
    /// The node of the sink.
    pub(crate) peer: NodeId,
    /// Its certificates.
    pub(crate) certs: Arc<[CertId]>,
    pub(crate) role: Role,
}

/// A sink's place in the tree.
#[derive(Clone, Debug)]
pub(crate) struct Branch {
    /// The link towards the sink.
    link: LinkId,
    /// The node at its other end.
    neighbour: NodeId,
    /// The link towards the owner.
    up: LinkId,
    /// The owner as its advertisement proved it when the request was passed on.
    owner: Arc<VerifiedPeer>,
    peer: NodeId,
    /// The certificates of its request.
    certs: Arc<[CertId]>,
    role: Role,
    stage: Stage,
}

impl Branch {
    /// Returns a branch that expects the owner's answer until then.
    pub(super) fn new(new: NewBranch, until: Instant) -> Self {
        let NewBranch { link, neighbour, up, owner, peer, certs, role } = new;
        Self { link, neighbour, up, owner, peer, certs, role, stage: Stage::ExpectAnswer { until } }
    }

    /// Returns the link towards the sink.
    pub(crate) fn link(&self) -> LinkId {
        self.link
    }

    /// Returns the link towards the owner.
    pub(crate) fn up(&self) -> LinkId {
        self.up
    }

    /// Returns the owner as its advertisement proved it when the request was passed on.
    pub(crate) fn owner(&self) -> &VerifiedPeer {
        &self.owner
    }

    /// Returns the node at the other end of the link towards the sink.
    pub(super) fn neighbour(&self) -> &NodeId {
        &self.neighbour
    }

    /// Returns the certificates of its request.
    pub(super) fn certs(&self) -> &[CertId] {
        &self.certs
    }

    /// Returns `true` if the sink is of this node, and over this link.
    pub(super) fn is_of(&self, link: LinkId, peer: &NodeId) -> bool {
        self.link == link && self.peer == *peer
    }

    /// Takes the certificates of a further request, and the owner as it is proved by now.
    pub(super) fn renew(&mut self, peer: &VerifiedPeer, owner: Option<&Arc<VerifiedPeer>>) {
        self.certs = peer.path.clone();
        if let Some(owner) = owner {
            self.owner = owner.clone();
        }
    }

    /// Returns the consequence of a route change; `is_known` tells whether the name is still advertised.
    pub(super) fn after_route_change(&self, is_known: bool, next_hop: Option<LinkId>) -> Option<RouteChange> {
        match (next_hop, self.stage) {
            // Withdrawn: the owner itself tells its sinks, unless it died.
            (None, _) if !is_known => Some(RouteChange::Cut),
            // The owner is out of reach from here; its neighbours will report it.
            (None, _) => None,
            (Some(next_hop), _) if next_hop == self.up => None,
            (Some(_), Stage::ExpectAnswer { .. }) => Some(RouteChange::Cut),
            (Some(_), Stage::Granted) => Some(RouteChange::Drain),
            (Some(_), Stage::Draining { .. }) => None,
        }
    }

    /// Returns `true` if data goes over it to a sink of another node than `node`, over another link than `link`.
    pub(super) fn carries_to_others(&self, link: LinkId, node: &NodeId) -> bool {
        self.role == Role::Subscribe && self.carries() && self.link != link && self.peer != *node
    }

    /// Returns `true` if data goes over it to a sink of `node`, over another link than `link`.
    pub(super) fn carries_elsewhere(&self, link: LinkId, node: &NodeId) -> bool {
        self.role == Role::Subscribe && self.carries() && self.link != link && self.peer == *node
    }

    /// Waits for the sink's new request until then.
    pub(super) fn drain(&mut self, until: Instant) {
        self.stage = Stage::Draining { until };
    }

    /// Takes the owner's grant. Returns the deadline that no longer holds, or `None` if the branch expects no answer.
    fn grant(&mut self) -> Option<Instant> {
        let Stage::ExpectAnswer { until } = self.stage else { return None };
        self.stage = Stage::Granted;
        Some(until)
    }

    /// Returns `true` if it is granted and waits for nothing.
    pub(super) fn is_granted(&self) -> bool {
        self.stage == Stage::Granted
    }

    /// Returns the time at which it is given up.
    pub(super) fn deadline(&self) -> Option<Instant> {
        match self.stage {
            Stage::ExpectAnswer { until } | Stage::Draining { until } => Some(until),
            Stage::Granted => None,
        }
    }

    /// Returns `true` if data goes over it.
    pub(super) fn carries(&self) -> bool {
        !matches!(self.stage, Stage::ExpectAnswer { .. })
    }
}

/// The consequence of another route for a branch.
pub(super) enum RouteChange {
    /// It ends.
    Cut,
    /// It serves while its sink asks again.
    Drain,
}

/// The branches of one name.
#[derive(Debug, Default)]
pub(super) struct Tree {
    branches: BTreeMap<SinkId, Branch>,
    /// The upper link of each link with sinks behind it: that of the branch granted last. It never goes back to an
    /// older one, or the trees of several sinks could form a circle (`docs/spec/tree-model.md`).
    feeds: BTreeMap<(LinkId, Role), LinkId>,
}

impl Tree {
    /// Returns the number of branches.
    pub(super) fn len(&self) -> usize {
        self.branches.len()
    }

    /// Returns `true` if it has no branch.
    pub(super) fn is_empty(&self) -> bool {
        self.branches.is_empty()
    }

    /// Returns the branch of a sink.
    pub(super) fn get(&self, sink: &SinkId) -> Option<&Branch> {
        self.branches.get(sink)
    }

    /// Returns the branch of a sink to be changed.
    pub(super) fn get_mut(&mut self, sink: &SinkId) -> Option<&mut Branch> {
        self.branches.get_mut(sink)
    }

    /// Iterates over the branches, by their sinks.
    pub(super) fn iter(&self) -> impl Iterator<Item = (&SinkId, &Branch)> {
        self.branches.iter()
    }

    /// Adds a branch.
    pub(super) fn insert(&mut self, sink: SinkId, branch: Branch) {
        self.branches.insert(sink, branch);
    }

    /// Takes the owner's grant. Returns the deadline that no longer holds, or `None` if the branch expects no answer.
    pub(super) fn grant(&mut self, sink: &SinkId) -> Option<Instant> {
        let branch = self.branches.get_mut(sink)?;
        let until = branch.grant()?;
        self.feeds.insert((branch.link, branch.role), branch.up);
        Some(until)
    }

    /// Removes a branch.
    pub(super) fn remove(&mut self, sink: &SinkId) -> Option<Branch> {
        let branch = self.branches.remove(sink)?;
        let same = |b: &Branch| (b.link, b.role) == (branch.link, branch.role) && b.carries();
        if !self.branches.values().any(same) {
            self.feeds.remove(&(branch.link, branch.role));
        }
        Some(branch)
    }

    /// Returns the entry for the data path; `None` if no branch carries data.
    pub(super) fn compile(&self) -> Option<FibEntry> {
        let mut entry = FibEntry::default();
        let mut trees = BTreeMap::<LinkId, fib::Tree>::new();
        let tree = |up| fib::Tree { up, down: SmallVec::new(), publishers: SmallVec::new() };
        for (sink, branch) in self.branches.iter().filter(|(_, b)| b.carries()) {
            // Data that still comes over an old link is useless, but not wrong.
            trees.entry(branch.up).or_insert_with(|| tree(branch.up));
            // Publishers, too: a service's reply is for one of them.
            entry.sinks.push((*sink, branch.link));
        }
        for ((link, role), up) in &self.feeds {
            let tree = trees.entry(*up).or_insert_with(|| tree(*up));
            match role {
                Role::Subscribe => tree.down.push(*link),
                Role::Publish => tree.publishers.push(*link),
            }
        }
        entry.trees = trees.into_values().collect();
        (!entry.trees.is_empty()).then_some(entry)
    }
}
