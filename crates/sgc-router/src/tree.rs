//! Trees: the sinks of a name, and the branches to them.
//!
//! A branch is pinned to the link towards the owner that its request took. When the route to the owner changes,
//! existing branches serve while their sinks ask again over the new route; branches whose link is gone are cut.

use std::collections::BTreeMap;
use std::sync::Arc;
use std::time::Instant;

use sgc_trust::{CertId, SignedError, VerifiedPeer, verify_answer, verify_join};
use sgc_wire::{
    Answer, AnswerBody, Control, Decode, JoinBody, Name, NodeId, Now, Recover, RejectReason, Role,
    SignedBody, SinkId,
};
use smallvec::SmallVec;

use crate::fib::{self, FibEntry};
use crate::router::{DropReason, LinkId, Output, Router};

/// Stage of a branch, by the event that it waits for.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Stage {
    /// The owner's answer.
    ExpectAnswer { until: Instant },
    /// Nothing.
    Granted,
    /// The sink's new request over a better route.
    Draining { until: Instant },
}

/// A sink's place in the tree.
#[derive(Clone, Debug)]
pub(crate) struct Branch {
    /// The link towards the sink.
    pub(crate) link: LinkId,
    /// The node at its other end.
    neighbour: NodeId,
    /// The link towards the owner.
    pub(crate) up: LinkId,
    /// The owner as its advertisement proved it when the request was passed on.
    owner: Arc<VerifiedPeer>,
    pub(crate) peer: NodeId,
    /// The certificates of its request.
    pub(crate) certs: Arc<[CertId]>,
    role: Role,
    stage: Stage,
}

impl Branch {
    fn deadline(&self) -> Option<Instant> {
        match self.stage {
            Stage::ExpectAnswer { until } | Stage::Draining { until } => Some(until),
            Stage::Granted => None,
        }
    }

    fn carries(&self) -> bool {
        !matches!(self.stage, Stage::ExpectAnswer { .. })
    }
}

/// The branches of one name.
#[derive(Debug, Default)]
pub(crate) struct Tree {
    pub(crate) branches: BTreeMap<SinkId, Branch>,
    /// The upper link of each link with sinks behind it: that of the branch granted last. It never goes back to an
    /// older one, or the trees of several sinks could form a circle (`docs/spec/tree-model.md`).
    feeds: BTreeMap<(LinkId, Role), LinkId>,
}

impl Tree {
    fn compile(&self) -> Option<FibEntry> {
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

impl Router {
    pub(crate) fn handle_join(&mut self, now: Now, link: LinkId, signed: SignedBody) {
        // Verification is expensive: a node that asks too often is refused before it.
        let Some(state) = self.links.get(&link) else { return };
        let (node, is_router) = (state.node, state.is_transit());
        if link != LinkId::LOCAL && !self.allowance(&node).may_join(now.instant, is_router) {
            self.reject_unverified(link, &signed, RejectReason::Limit);
            return self.drop_frame(link, DropReason::Limit { what: "requests per second" });
        }
        let join = match verify_join(&self.config.anchors, &signed, now.unix) {
            Ok(join) => join,
            Err(why) => {
                // The sender learns the reason: with a wrong clock, nothing else would tell it.
                self.reject_unverified(link, &signed, why.reject_reason());
                return self.not_verified(now, link, "join", why);
            }
        };
        let (name, sink) = (join.body.name, join.body.sink);
        let owner = self.names.record(&name).map(|record| record.owner.clone());
        let reject = |this: &mut Self, reason| this.send(link, Control::Reject { name, sink, reason });
        if let Some(known) = self.trees.get_mut(&name).and_then(|t| t.branches.get_mut(&sink)) {
            // A sink has one place in the tree and asks once: the same request over another link is a replay, or went
            // in a circle. Over the same link it may ask again under a new certificate, and keeps its branch.
            if known.peer != join.peer.node_id || known.link != link {
                return reject(self, RejectReason::NoRoute);
            }
            known.certs = join.peer.path;
            known.owner = owner.unwrap_or_else(|| known.owner.clone());
            let up = known.up;
            return self.send(up, Control::Join { signed });
        }
        let next_hop = self.next_hop(&name).filter(|(up, _)| *up != link);
        let Some(((up, _), owner)) = next_hop.zip(owner) else {
            return reject(self, RejectReason::NoRoute);
        };
        if !(up == LinkId::LOCAL || link == LinkId::LOCAL || self.config.transit) {
            return reject(self, RejectReason::NoRoute);
        }
        let of_name = self.trees.get(&name).map_or(0, |t| t.branches.len());
        let of_peer = self.allowance(&node).branches;
        let limits = &self.config.limits;
        if of_name >= limits.branches_per_name_max || of_peer >= limits.branches_per_peer_max {
            self.drop_frame(link, DropReason::Limit { what: "branches" });
            return reject(self, RejectReason::Limit);
        }
        let until = now.instant + self.config.limits.answer_wait;
        let branch = Branch {
            link,
            neighbour: node,
            up,
            owner,
            peer: join.peer.node_id,
            certs: join.peer.path,
            role: join.body.request.role(),
            stage: Stage::ExpectAnswer { until },
        };
        self.put_branch(name, sink, branch);
        self.introduce(up, &name);
        self.send(up, Control::Join { signed });
    }

    pub(crate) fn handle_leave(&mut self, link: LinkId, name: Name, sink: SinkId) {
        if self.branch(&name, &sink).is_none_or(|b| b.link != link) {
            return self.drop_frame(link, DropReason::Unknown { what: "leave" });
        }
        if let Some(branch) = self.remove_branch(name, sink) {
            self.send(branch.up, Control::Leave { name, sink });
        }
    }

    pub(crate) fn handle_answer(&mut self, now: Now, link: LinkId, signed: SignedBody) {
        // Name and sink are needed to find the possible signing keys; they count only after verification.
        let body = match AnswerBody::from_slice(&signed.body) {
            Ok(body) => body,
            Err(why) => return self.not_verified(now, link, "answer", SignedError::Decode(why)),
        };
        let (name, sink) = (body.name, body.sink);
        let branch = self.branch(&name, &sink);
        let Some(branch) = branch.filter(|b| b.up == link) else {
            let reason = match branch {
                None => DropReason::Unknown { what: "answer" },
                Some(_) => DropReason::WrongWay { what: "answer" },
            };
            // The owner granted a sink that has left, or a request that came here in a circle: the grant is given back,
            // so that neither the owner nor a router between keeps it.
            if matches!(body.answer, Answer::Grant { .. }) {
                self.send(link, Control::Leave { name, sink });
            }
            return self.drop_frame(link, reason);
        };
        let down = branch.link;
        if !self.is_of_owner(now, &name, branch, &signed) {
            return self.answer_of_unknown_key(link, name, sink);
        }
        match body.answer {
            Answer::Grant { .. } => self.grant_branch(name, sink),
            Answer::Refuse { .. } => {
                self.remove_branch(name, sink);
            }
        }
        self.send(down, Control::Answer { signed });
    }

    /// Returns `true` if the owner of a name signed an answer: with the key of its advertisement in force, or with the
    /// key at the time of the request. Answers and advertisements may cross when an owner has another certificate.
    fn is_of_owner(&self, now: Now, name: &Name, branch: &Branch, signed: &SignedBody) -> bool {
        let signs = |owner: &VerifiedPeer| verify_answer(owner, signed).is_ok();
        let newest = self.names.record(name).map(|record| &record.owner);
        if newest.is_some_and(|owner| signs(owner)) {
            return true;
        }
        let before = &branch.owner;
        let is_another = newest.is_none_or(|owner| owner.cert != before.cert);
        let holds = now.unix <= before.not_after && !self.is_untrusted(&before.path);
        is_another && holds && signs(before)
    }

    /// Handles an answer that no known key signed. It goes no further: it is forged, or the owner has a certificate
    /// that the neighbour knows and this node does not. So the neighbour is asked for it, and not taken for a forger.
    /// The sink asks again; a branch accepts at most two such answers.
    fn answer_of_unknown_key(&mut self, link: LinkId, name: Name, sink: SinkId) {
        let Some(branch) = self.branch(&name, &sink) else { return };
        let (owner, is_granted) = (branch.owner.node_id, branch.stage == Stage::Granted);
        self.drop_frame(link, DropReason::OwnerKey { owner });
        self.ask_neighbour(link, name);
        if is_granted {
            self.drain(name, sink);
        } else {
            self.cut(name, sink, RejectReason::RouteLost);
        }
    }

    pub(crate) fn handle_reject(&mut self, link: LinkId, name: Name, sink: SinkId, reason: RejectReason) {
        match self.branch(&name, &sink).map(|b| b.up == link) {
            None => self.drop_frame(link, DropReason::Unknown { what: "reject" }),
            Some(false) => self.drop_frame(link, DropReason::WrongWay { what: "reject" }),
            Some(true) => self.cut_down(name, sink, reason),
        }
    }

    /// Passes on to the sink that the route changed closer to the owner.
    pub(crate) fn handle_reroute(&mut self, link: LinkId, name: Name, sink: SinkId) {
        match self.branch(&name, &sink).map(|b| (b.up == link, b.link)) {
            None => self.drop_frame(link, DropReason::Unknown { what: "reroute" }),
            Some((false, _)) => self.drop_frame(link, DropReason::WrongWay { what: "reroute" }),
            Some((true, down)) => self.send(down, Control::Reroute { name, sink }),
        }
    }

    /// Passes on a sink's request for lost messages towards the owner, if the sink has a place in the tree.
    pub(crate) fn handle_recover(&mut self, link: LinkId, recover: Recover) {
        self.send_from_sink(link, recover.name, recover.sink, "recover", Control::Recover(recover));
    }

    /// Passes on a sink's acknowledgement of a key towards the owner, if the sink has a place in the tree.
    pub(crate) fn handle_ack(&mut self, link: LinkId, name: Name, sink: SinkId, serial: u64) {
        self.send_from_sink(link, name, sink, "acknowledgement", Control::Ack { name, sink, serial });
    }

    fn send_from_sink(&mut self, link: LinkId, name: Name, sink: SinkId, what: &'static str, frame: Control) {
        match self.branch(&name, &sink).filter(|b| b.link == link && b.carries()).map(|b| b.up) {
            Some(up) => self.send(up, frame),
            None => self.drop_frame(link, DropReason::Unknown { what }),
        }
    }

    /// Follows a possible route change of a name. Sinks with branches over an old route are told to ask again;
    /// unanswered requests are given up, because their answers would come over the old one.
    pub(crate) fn follow_next_hop(&mut self, name: &Name) {
        let Some(tree) = self.trees.get(name) else { return };
        let known = self.names.record(name).is_some();
        let next_hop = self.next_hop(name).map(|(link, _)| link);
        let mut moved = Vec::new();
        for (sink, branch) in &tree.branches {
            match (next_hop, branch.stage) {
                // Withdrawn: the owner itself tells its sinks, unless it died.
                (None, _) if !known => moved.push((*sink, true)),
                // The owner is out of reach from here; its neighbours will report it.
                (None, _) => {}
                (Some(next_hop), _) if next_hop == branch.up => {}
                (Some(_), Stage::ExpectAnswer { .. }) => moved.push((*sink, true)),
                (Some(_), Stage::Granted) => moved.push((*sink, false)),
                (Some(_), Stage::Draining { .. }) => {}
            }
        }
        for (sink, cut) in moved {
            if cut {
                self.cut(*name, sink, RejectReason::RouteLost);
            } else {
                self.drain(*name, sink);
            }
        }
    }

    /// Keeps a granted branch while its sink asks again.
    fn drain(&mut self, name: Name, sink: SinkId) {
        let until = self.now.instant + self.config.limits.answer_wait;
        let Some(branch) = self.trees.get_mut(&name).and_then(|t| t.branches.get_mut(&sink)) else { return };
        branch.stage = Stage::Draining { until };
        let down = branch.link;
        self.deadlines.insert((until, name, sink));
        self.send(down, Control::Reroute { name, sink });
    }

    pub(crate) fn branches_timeout(&mut self, now: Now) {
        while let Some((at, name, sink)) =
            self.deadlines.first().copied().filter(|(at, ..)| *at <= now.instant)
        {
            self.deadlines.remove(&(at, name, sink));
            let draining = self.branch(&name, &sink).is_some_and(Branch::carries);
            let reason = if draining { RejectReason::RouteLost } else { RejectReason::TimedOut };
            self.cut(name, sink, reason);
        }
    }

    /// Cuts a branch in both directions.
    pub(crate) fn cut(&mut self, name: Name, sink: SinkId, reason: RejectReason) {
        if let Some(branch) = self.remove_branch(name, sink) {
            self.send(branch.link, Control::Reject { name, sink, reason });
            self.send(branch.up, Control::Leave { name, sink });
        }
    }

    /// Cuts the rest of a branch whose upper part is gone.
    fn cut_down(&mut self, name: Name, sink: SinkId, reason: RejectReason) {
        if let Some(branch) = self.remove_branch(name, sink) {
            self.send(branch.link, Control::Reject { name, sink, reason });
        }
    }

    /// Cuts all branches over a lost link.
    pub(crate) fn cut_link(&mut self, link: LinkId, branches: impl IntoIterator<Item = (Name, SinkId)>) {
        for (name, sink) in branches {
            match self.branch(&name, &sink).map(|b| b.up == link) {
                Some(true) => self.cut_down(name, sink, RejectReason::RouteLost),
                Some(false) => {
                    if let Some(branch) = self.remove_branch(name, sink) {
                        self.send(branch.up, Control::Leave { name, sink });
                    }
                }
                None => {}
            }
        }
    }

    /// Cuts the branches of sinks whose certificates are no longer believed.
    pub(crate) fn distrust_branches(&mut self) {
        let mut gone = Vec::new();
        for (name, tree) in &self.trees {
            let untrusted = tree.branches.iter().filter(|(_, b)| self.is_untrusted(&b.certs));
            gone.extend(untrusted.map(|(sink, _)| (*name, *sink)));
        }
        for (name, sink) in gone {
            self.cut(name, sink, RejectReason::Revoked);
        }
    }

    /// Refuses an unverified request as far as possible: its body may at least name the sink to answer.
    fn reject_unverified(&mut self, link: LinkId, signed: &SignedBody, reason: RejectReason) {
        if let Ok(JoinBody { name, sink, .. }) = JoinBody::from_slice(&signed.body) {
            self.send(link, Control::Reject { name, sink, reason });
        }
    }

    pub(crate) fn branch(&self, name: &Name, sink: &SinkId) -> Option<&Branch> {
        self.trees.get(name)?.branches.get(sink)
    }

    fn put_branch(&mut self, name: Name, sink: SinkId, branch: Branch) {
        if let Some(deadline) = branch.deadline() {
            self.deadlines.insert((deadline, name, sink));
        }
        for link in [branch.link, branch.up] {
            if let Some(link) = self.links.get_mut(&link) {
                link.branches.insert((name, sink));
            }
        }
        self.allowance(&branch.neighbour).branches += 1;
        self.trees.entry(name).or_default().branches.insert(sink, branch);
    }

    fn grant_branch(&mut self, name: Name, sink: SinkId) {
        let Some(tree) = self.trees.get_mut(&name) else { return };
        let Some(branch) = tree.branches.get_mut(&sink) else { return };
        let Stage::ExpectAnswer { until } = branch.stage else { return };
        branch.stage = Stage::Granted;
        tree.feeds.insert((branch.link, branch.role), branch.up);
        self.deadlines.remove(&(until, name, sink));
        self.refresh_fib(name);
    }

    fn remove_branch(&mut self, name: Name, sink: SinkId) -> Option<Branch> {
        let tree = self.trees.get_mut(&name)?;
        let branch = tree.branches.remove(&sink)?;
        let same = |b: &Branch| (b.link, b.role) == (branch.link, branch.role) && b.carries();
        if !tree.branches.values().any(same) {
            tree.feeds.remove(&(branch.link, branch.role));
        }
        if branch.carries() {
            self.refresh_fib(name);
        }
        if self.trees.get(&name).is_some_and(|t| t.branches.is_empty()) {
            self.trees.remove(&name);
        }
        if let Some(deadline) = branch.deadline() {
            self.deadlines.remove(&(deadline, name, sink));
        }
        for link in [branch.link, branch.up] {
            if let Some(link) = self.links.get_mut(&link) {
                link.branches.remove(&(name, sink));
            }
        }
        self.allowance(&branch.neighbour).branches -= 1;
        Some(branch)
    }

    fn refresh_fib(&mut self, name: Name) {
        let entry = self.trees.get(&name).and_then(Tree::compile);
        self.outputs.push_back(Output::Forward { name, entry });
    }
}
