//! Requests to join and their answers: verified, given a place by the trees, and passed on.

use sgc_trust::{SignedError, VerifiedPeer, name_of, operations_blind, verify_answer, verify_join};
use sgc_wire::{
    Answer, AnswerBody, Control, Decode, JoinBody, Name, Recover, RejectReason, SignedBody, SinkId,
};

use super::Router;
use crate::drops::DropReason;
use crate::link_id::LinkId;
use crate::names::Demand;
use crate::output::Output;
use crate::trees::{Effect, Effects, NewBranch, Place};

impl Router {
    pub(super) fn handle_join(&mut self, link: LinkId, signed: SignedBody) {
        // Verification is expensive: a node that asks too often is refused before it.
        let Some(from) = self.links.peer(link) else { return };
        let now = self.now;
        let allowance = self.allowances.node(now.instant, &from.node);
        if link != LinkId::LOCAL && !allowance.may_join(now.instant, from.is_router) {
            self.reject_unverified(link, &signed, RejectReason::Limit);
            return self.drop_frame(link, DropReason::Limit { what: "requests per second" });
        }
        let join = match verify_join(&self.config.anchors, &signed, now.unix) {
            Ok(join) => join,
            Err(why) => {
                // The sender learns the reason: with a wrong clock, nothing else would tell it.
                self.reject_unverified(link, &signed, why.reject_reason());
                return self.not_verified(link, "join", why);
            }
        };
        let (name, sink) = (join.body.name, join.body.sink);
        let owner = self.names.owner(&name);
        let reject = |this: &mut Self, reason| this.send(link, Control::Reject { name, sink, reason });
        // The holder of an invitation reaches the authority of its fleet, and nobody else.
        if join.peer.invitation.is_some()
            && let Some(owner) = owner
            && name != name_of(&owner.node_id, &operations_blind(&join.peer.ca))
        {
            reject(self, RejectReason::NotVerified);
            return self.drop_frame(link, DropReason::Invited { node: join.peer.node_id });
        }
        match self.trees.place(link, &name, &sink, &join.peer, owner) {
            Place::New => {}
            Place::Taken => return reject(self, RejectReason::NoRoute),
            Place::Kept { up } => return self.send(up, Control::Join { signed }),
        }
        let Some(owner) = owner.cloned() else { return reject(self, RejectReason::NoRoute) };
        let next_hop = self.names.next_hop_to(self.network(), &name, &owner.node_id);
        let Some((up, _)) = next_hop.filter(|(up, _)| *up != link) else {
            return reject(self, RejectReason::NoRoute);
        };
        if !(up == LinkId::LOCAL || link == LinkId::LOCAL || self.config.transit) {
            return reject(self, RejectReason::NoRoute);
        }
        if self.trees.is_full(&name, &from.node) {
            self.drop_frame(link, DropReason::Limit { what: "branches" });
            return reject(self, RejectReason::Limit);
        }
        let branch = NewBranch {
            link,
            neighbour: from.node,
            up,
            owner,
            peer: join.peer.node_id,
            certs: join.peer.path,
            role: join.body.request.role(),
        };
        self.trees.add(now.instant, name, sink, branch);
        self.names_part(|names, cx| names.introduce(cx, up, &name));
        self.send(up, Control::Join { signed });
    }

    pub(super) fn handle_leave(&mut self, link: LinkId, name: Name, sink: SinkId) {
        match self.trees.leave(link, name, sink) {
            Ok(effects) => self.perform(effects),
            Err(reason) => self.drop_frame(link, reason),
        }
    }

    pub(super) fn handle_answer(&mut self, link: LinkId, signed: SignedBody) {
        // Name and sink are needed to find the possible signing keys; they count only after verification.
        let body = match AnswerBody::from_slice(&signed.body) {
            Ok(body) => body,
            Err(why) => return self.not_verified(link, "answer", SignedError::Decode(why)),
        };
        let (name, sink) = (body.name, body.sink);
        let branch = match self.trees.downward(link, &name, &sink, "answer") {
            Ok(branch) => branch,
            Err(reason) => {
                // The owner granted a sink that has left, or a request that came here in a circle: the grant is given
                // back, so that neither the owner nor a router between keeps it.
                if matches!(body.answer, Answer::Grant { .. }) {
                    self.send(link, Control::Leave { name, sink });
                }
                return self.drop_frame(link, reason);
            }
        };
        if !self.is_of_owner(&name, branch.owner(), &signed) {
            let owner = branch.owner().node_id;
            // It goes no further: it is forged, or the owner has a certificate that the neighbour knows and this node
            // does not. So the neighbour is asked for it, and not taken for a forger.
            self.drop_frame(link, DropReason::OwnerKey { owner });
            self.names_part(|names, cx| names.ask_neighbour(cx, link, name));
            let effects = self.trees.distrust_answer(self.now.instant, name, sink);
            return self.perform(effects);
        }
        let down = branch.link();
        let effects = match body.answer {
            Answer::Grant { .. } => self.trees.grant(name, sink),
            Answer::Refuse { .. } => self.trees.refuse(name, sink),
        };
        self.perform(effects);
        self.send(down, Control::Answer { signed });
    }

    /// Returns `true` if the owner of a name signed an answer: with the key of its advertisement in force, or with the
    /// key at the time of the request. Answers and advertisements may cross when an owner has another certificate.
    fn is_of_owner(&self, name: &Name, before: &VerifiedPeer, signed: &SignedBody) -> bool {
        let signs = |owner: &VerifiedPeer| verify_answer(owner, signed).is_ok();
        let newest = self.names.owner(name);
        if newest.is_some_and(|owner| signs(owner)) {
            return true;
        }
        let is_another = newest.is_none_or(|owner| owner.cert != before.cert);
        let holds = self.now.unix <= before.not_after && !self.is_untrusted(&before.path);
        is_another && holds && signs(before)
    }

    pub(super) fn handle_reject(&mut self, link: LinkId, name: Name, sink: SinkId, reason: RejectReason) {
        match self.trees.downward(link, &name, &sink, "reject").map(drop) {
            Ok(()) => {
                let effects = self.trees.reject(name, sink, reason);
                self.perform(effects);
            }
            Err(reason) => self.drop_frame(link, reason),
        }
    }

    /// Passes on to the sink that the route changed closer to the owner.
    pub(super) fn handle_reroute(&mut self, link: LinkId, name: Name, sink: SinkId) {
        match self.trees.downward(link, &name, &sink, "reroute").map(|branch| branch.link()) {
            Ok(down) => self.send(down, Control::Reroute { name, sink }),
            Err(reason) => self.drop_frame(link, reason),
        }
    }

    /// Passes on a sink's request for lost messages towards the owner, if the sink has a place in the tree.
    pub(super) fn handle_recover(&mut self, link: LinkId, recover: Recover) {
        self.send_from_sink(link, recover.name, recover.sink, "recover", Control::Recover(recover));
    }

    /// Passes on a sink's acknowledgement of a key towards the owner, if the sink has a place in the tree.
    pub(super) fn handle_ack(&mut self, link: LinkId, name: Name, sink: SinkId, serial: u64) {
        self.send_from_sink(link, name, sink, "acknowledgement", Control::Ack { name, sink, serial });
    }

    fn send_from_sink(&mut self, link: LinkId, name: Name, sink: SinkId, what: &'static str, frame: Control) {
        match self.trees.upward(link, &name, &sink, what).map(|branch| branch.up()) {
            Ok(up) => self.send(up, frame),
            Err(reason) => self.drop_frame(link, reason),
        }
    }

    /// Refuses an unverified request as far as possible: its body may at least name the sink to answer.
    fn reject_unverified(&mut self, link: LinkId, signed: &SignedBody, reason: RejectReason) {
        if let Ok(JoinBody { name, sink, .. }) = JoinBody::from_slice(&signed.body) {
            self.send(link, Control::Reject { name, sink, reason });
        }
    }

    /// Does [`Self::spare_uplink`] for all names, after the routers in reach changed.
    pub(super) fn spare_uplinks(&mut self) {
        for link in self.links.far().map(|(link, _)| link).collect::<Vec<_>>() {
            for name in self.names.own_wanted_by(link) {
                self.spare_uplink_at(link, name);
            }
        }
    }

    /// Lets one copy of a name of this node pass the uplink: while other nodes get it through the uplink as well, it is not
    /// told over a direct link, and its sink there joins over a router.
    fn spare_uplink(&mut self, name: Name) {
        for link in self.links.far().map(|(link, _)| link).collect::<Vec<_>>() {
            self.spare_uplink_at(link, name);
        }
    }

    /// Does so for one link. Nothing happens unless it is a direct link through the uplink.
    pub(super) fn spare_uplink_at(&mut self, link: LinkId, name: Name) {
        let links = &self.links;
        let Some((_, node)) = links.far().find(|(far, _)| *far == link) else { return };
        let passes = |link| links.passes_uplink(link);
        let demand = Demand {
            is_copied: self.names.is_own(&name) && links.has_copier(),
            others: self.trees.serves_others(&name, link, node, passes),
            is_served: self.trees.serves_elsewhere(&name, link, node),
        };
        self.names_part(|names, cx| names.withhold(cx, link, name, demand));
    }

    /// Carries out the effects of the trees.
    pub(super) fn perform(&mut self, effects: Effects) {
        for effect in effects {
            match effect {
                Effect::Send { link, frame } => self.send(link, frame),
                Effect::Forward { name, entry } => {
                    self.outputs.push(Output::Forward { name, entry });
                    self.spare_uplink(name);
                }
            }
        }
    }
}
