//! [`Trees`]: the sinks of each name, and the branches to them.
//!
//! A branch is pinned to the link towards the owner that its request took. When the route to the owner changes,
//! existing branches serve while their sinks ask again over the new route; branches whose link is gone are cut.
//!
//! This part verifies nothing and knows no routes: the router does that first, and carries out the [`Effects`].

mod tree;

use std::collections::{BTreeMap, BTreeSet};
use std::sync::Arc;
use std::time::{Duration, Instant};

use sgc_trust::{CertId, VerifiedPeer};
use sgc_wire::{Control, Name, NodeId, RejectReason, SinkId};
use smallvec::SmallVec;

pub(crate) use self::tree::{Branch, NewBranch};
use self::tree::{RouteChange, Tree};
use crate::drops::DropReason;
use crate::fib::FibEntry;
use crate::limits::Limits;
use crate::link_id::LinkId;

/// Work that follows from a change of branches.
#[derive(Clone, Debug)]
pub(crate) enum Effect {
    /// Send a frame over a link, if that is up.
    Send { link: LinkId, frame: Control },
    /// Forward the data of a name by another entry.
    Forward { name: Name, entry: Option<FibEntry> },
}

/// Effects in their order; cutting a branch has three.
pub(crate) type Effects = SmallVec<[Effect; 3]>;

/// The place of a sink that asks to join.
#[derive(Debug, PartialEq, Eq)]
pub(crate) enum Place {
    /// It has none yet.
    New,
    /// It keeps its branch, over this link towards the owner.
    Kept { up: LinkId },
    /// Another node has it, or the same request came over another link.
    Taken,
}

/// The trees of all names.
#[derive(Debug)]
pub(crate) struct Trees {
    trees: BTreeMap<Name, Tree>,
    /// Branches that wait for something, by their deadlines.
    deadlines: BTreeSet<(Instant, Name, SinkId)>,
    /// Branches that end at a link, on either side.
    of_link: BTreeMap<LinkId, BTreeSet<(Name, SinkId)>>,
    /// Number of branches towards sinks behind a neighbour.
    of_node: BTreeMap<NodeId, usize>,
    per_name_max: usize,
    per_node_max: usize,
    answer_wait: Duration,
}

impl Trees {
    pub(crate) fn new(limits: &Limits) -> Self {
        Self {
            trees: BTreeMap::new(),
            deadlines: BTreeSet::new(),
            of_link: BTreeMap::new(),
            of_node: BTreeMap::new(),
            per_name_max: limits.branches_per_name_max,
            per_node_max: limits.branches_per_peer_max,
            answer_wait: limits.answer_wait,
        }
    }

    // ---- Looking branches up.

    /// Returns `true` if the name has branches.
    pub(crate) fn contains(&self, name: &Name) -> bool {
        self.trees.contains_key(name)
    }

    /// Iterates over the names with branches.
    pub(crate) fn names(&self) -> impl Iterator<Item = &Name> {
        self.trees.keys()
    }

    /// Returns the number of names with branches.
    pub(crate) fn names_len(&self) -> usize {
        self.trees.len()
    }

    /// Returns the number of branches.
    pub(crate) fn len(&self) -> usize {
        self.trees.values().map(Tree::len).sum()
    }

    /// Returns `true` if a branch ends at a link, on either side.
    pub(crate) fn uses(&self, link: LinkId) -> bool {
        self.of_link.contains_key(&link)
    }

    /// Returns `true` if data of a name goes over a link other than `link` that is wanted, to a sink of a node other than
    /// `node`.
    pub(crate) fn serves_others(
        &self,
        name: &Name,
        link: LinkId,
        node: &NodeId,
        is_wanted: impl Fn(LinkId) -> bool,
    ) -> bool {
        let serves = |branch: &Branch| branch.carries_to_others(link, node) && is_wanted(branch.link());
        self.trees.get(name).is_some_and(|tree| tree.iter().any(|(_, branch)| serves(branch)))
    }

    /// Returns `true` if data of a name goes over another link than `link` to a sink of `node`.
    pub(crate) fn serves_elsewhere(&self, name: &Name, link: LinkId, node: &NodeId) -> bool {
        let mut branches = self.trees.get(name).into_iter().flat_map(|tree| tree.iter());
        branches.any(|(_, branch)| branch.carries_elsewhere(link, node))
    }

    /// Returns the time of the next timeout.
    pub(crate) fn next_deadline(&self) -> Option<Instant> {
        self.deadlines.first().map(|(at, ..)| *at)
    }

    /// Returns the branch that a frame from the owner's side takes.
    pub(crate) fn downward(
        &self,
        link: LinkId,
        name: &Name,
        sink: &SinkId,
        what: &'static str,
    ) -> Result<&Branch, DropReason> {
        let branch = self.branch(name, sink).ok_or(DropReason::Unknown { what })?;
        if branch.up() == link { Ok(branch) } else { Err(DropReason::WrongWay { what }) }
    }

    /// Returns the granted branch that a frame from the sink's side takes.
    pub(crate) fn upward(
        &self,
        link: LinkId,
        name: &Name,
        sink: &SinkId,
        what: &'static str,
    ) -> Result<&Branch, DropReason> {
        let branch = self.branch(name, sink).filter(|b| b.link() == link && b.carries());
        branch.ok_or(DropReason::Unknown { what })
    }

    fn branch(&self, name: &Name, sink: &SinkId) -> Option<&Branch> {
        self.trees.get(name)?.get(sink)
    }

    // ---- Branches that come.

    /// Returns the place of a sink that asks to join. A sink has one and asks once: the same request over another link
    /// is a replay, or went in a circle. Over the same link it may ask again under a new certificate, and keeps its
    /// branch.
    pub(crate) fn place(
        &mut self,
        link: LinkId,
        name: &Name,
        sink: &SinkId,
        peer: &VerifiedPeer,
        owner: Option<&Arc<VerifiedPeer>>,
    ) -> Place {
        let Some(known) = self.trees.get_mut(name).and_then(|t| t.get_mut(sink)) else { return Place::New };
        if !known.is_of(link, &peer.node_id) {
            return Place::Taken;
        }
        known.renew(peer, owner);
        Place::Kept { up: known.up() }
    }

    /// Returns `true` if the name, or the neighbour, has as many branches as it may have.
    pub(crate) fn is_full(&self, name: &Name, neighbour: &NodeId) -> bool {
        self.trees.get(name).map_or(0, Tree::len) >= self.per_name_max
            || self.of_node.get(neighbour).copied().unwrap_or_default() >= self.per_node_max
    }

    /// Adds a branch, which expects the owner's answer.
    pub(crate) fn add(&mut self, now: Instant, name: Name, sink: SinkId, new: NewBranch) {
        let until = now + self.answer_wait;
        self.deadlines.insert((until, name, sink));
        for link in [new.link, new.up] {
            self.of_link.entry(link).or_default().insert((name, sink));
        }
        *self.of_node.entry(new.neighbour).or_default() += 1;
        self.trees.entry(name).or_default().insert(sink, Branch::new(new, until));
    }

    /// Takes the owner's grant.
    pub(crate) fn grant(&mut self, name: Name, sink: SinkId) -> Effects {
        let mut effects = Effects::new();
        if let Some(until) = self.trees.get_mut(&name).and_then(|tree| tree.grant(&sink)) {
            self.deadlines.remove(&(until, name, sink));
            effects.push(self.forward(name));
        }
        effects
    }

    // ---- Branches that go.

    /// Takes the owner's refusal, which the router passes on.
    pub(crate) fn refuse(&mut self, name: Name, sink: SinkId) -> Effects {
        let mut effects = Effects::new();
        self.remove(name, sink, &mut effects);
        effects
    }

    /// Ends a branch because its sink left over this link.
    pub(crate) fn leave(&mut self, link: LinkId, name: Name, sink: SinkId) -> Result<Effects, DropReason> {
        if self.branch(&name, &sink).is_none_or(|b| b.link() != link) {
            return Err(DropReason::Unknown { what: "leave" });
        }
        let mut effects = Effects::new();
        self.cut_up(name, sink, &mut effects);
        Ok(effects)
    }

    /// Ends a branch because it was rejected on the owner's side.
    pub(crate) fn reject(&mut self, name: Name, sink: SinkId, reason: RejectReason) -> Effects {
        let mut effects = Effects::new();
        self.cut_down(name, sink, reason, &mut effects);
        effects
    }

    /// Notes that a known key of the owner did not sign its answer: the sink asks again. A branch accepts at most two
    /// such answers.
    pub(crate) fn distrust_answer(&mut self, now: Instant, name: Name, sink: SinkId) -> Effects {
        let mut effects = Effects::new();
        let Some(branch) = self.branch(&name, &sink) else { return effects };
        if branch.is_granted() {
            self.drain(now, name, sink, &mut effects);
        } else {
            self.cut(name, sink, RejectReason::RouteLost, &mut effects);
        }
        effects
    }

    /// Follows a possible route change of a name. Sinks with branches over an old route are told to ask again;
    /// unanswered requests are given up, because their answers would come over the old one.
    pub(crate) fn follow(
        &mut self,
        now: Instant,
        name: &Name,
        is_known: bool,
        next_hop: Option<LinkId>,
    ) -> Effects {
        let mut effects = Effects::new();
        let Some(tree) = self.trees.get(name) else { return effects };
        let change = |(sink, branch): (&SinkId, &Branch)| {
            Some((*sink, branch.after_route_change(is_known, next_hop)?))
        };
        let changes: Vec<_> = tree.iter().filter_map(change).collect();
        for (sink, change) in changes {
            match change {
                RouteChange::Cut => self.cut(*name, sink, RejectReason::RouteLost, &mut effects),
                RouteChange::Drain => self.drain(now, *name, sink, &mut effects),
            }
        }
        effects
    }

    /// Gives up the branches whose deadlines are over.
    pub(crate) fn handle_timeout(&mut self, now: Instant) -> Effects {
        let mut effects = Effects::new();
        while let Some((at, name, sink)) = self.deadlines.first().copied().filter(|(at, ..)| *at <= now) {
            self.deadlines.remove(&(at, name, sink));
            let draining = self.branch(&name, &sink).is_some_and(Branch::carries);
            let reason = if draining { RejectReason::RouteLost } else { RejectReason::TimedOut };
            self.cut(name, sink, reason, &mut effects);
        }
        effects
    }

    /// Cuts all branches over a lost link.
    pub(crate) fn link_down(&mut self, link: LinkId) -> Effects {
        let mut effects = Effects::new();
        for (name, sink) in self.of_link.remove(&link).unwrap_or_default() {
            match self.branch(&name, &sink).map(|b| b.up() == link) {
                Some(true) => self.cut_down(name, sink, RejectReason::RouteLost, &mut effects),
                Some(false) => self.cut_up(name, sink, &mut effects),
                None => {}
            }
        }
        effects
    }

    /// Cuts the branches of sinks whose certificates are no longer believed.
    pub(crate) fn distrust(&mut self, is_untrusted: impl Fn(&[CertId]) -> bool) -> Effects {
        let mut gone = Vec::new();
        for (name, tree) in &self.trees {
            let untrusted = tree.iter().filter(|(_, b)| is_untrusted(b.certs()));
            gone.extend(untrusted.map(|(sink, _)| (*name, *sink)));
        }
        let mut effects = Effects::new();
        for (name, sink) in gone {
            self.cut(name, sink, RejectReason::Revoked, &mut effects);
        }
        effects
    }

    /// Keeps a granted branch while its sink asks again.
    fn drain(&mut self, now: Instant, name: Name, sink: SinkId, effects: &mut Effects) {
        let until = now + self.answer_wait;
        let Some(branch) = self.trees.get_mut(&name).and_then(|t| t.get_mut(&sink)) else { return };
        branch.drain(until);
        self.deadlines.insert((until, name, sink));
        effects.push(Effect::Send { link: branch.link(), frame: Control::Reroute { name, sink } });
    }

    /// Cuts a branch in both directions.
    fn cut(&mut self, name: Name, sink: SinkId, reason: RejectReason, effects: &mut Effects) {
        if let Some(branch) = self.remove(name, sink, effects) {
            effects.push(Effect::Send { link: branch.link(), frame: Control::Reject { name, sink, reason } });
            effects.push(Effect::Send { link: branch.up(), frame: Control::Leave { name, sink } });
        }
    }

    /// Cuts the rest of a branch whose upper part is gone.
    fn cut_down(&mut self, name: Name, sink: SinkId, reason: RejectReason, effects: &mut Effects) {
        if let Some(branch) = self.remove(name, sink, effects) {
            effects.push(Effect::Send { link: branch.link(), frame: Control::Reject { name, sink, reason } });
        }
    }

    /// Cuts the rest of a branch whose lower part is gone.
    fn cut_up(&mut self, name: Name, sink: SinkId, effects: &mut Effects) {
        if let Some(branch) = self.remove(name, sink, effects) {
            effects.push(Effect::Send { link: branch.up(), frame: Control::Leave { name, sink } });
        }
    }

    /// Removes a branch from the tree and from every index.
    fn remove(&mut self, name: Name, sink: SinkId, effects: &mut Effects) -> Option<Branch> {
        let tree = self.trees.get_mut(&name)?;
        let branch = tree.remove(&sink)?;
        let is_last = tree.is_empty();
        if branch.carries() {
            effects.push(self.forward(name));
        }
        if is_last {
            self.trees.remove(&name);
        }
        if let Some(deadline) = branch.deadline() {
            self.deadlines.remove(&(deadline, name, sink));
        }
        for link in [branch.link(), branch.up()] {
            if let Some(of_link) = self.of_link.get_mut(&link) {
                of_link.remove(&(name, sink));
                if of_link.is_empty() {
                    self.of_link.remove(&link);
                }
            }
        }
        if let Some(count) = self.of_node.get_mut(branch.neighbour()) {
            *count -= 1;
            if *count == 0 {
                self.of_node.remove(branch.neighbour());
            }
        }
        Some(branch)
    }

    fn forward(&self, name: Name) -> Effect {
        Effect::Forward { name, entry: self.trees.get(&name).and_then(Tree::compile) }
    }
}

#[cfg(test)]
mod tests;
