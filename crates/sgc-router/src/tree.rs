//! Trees: who receives what, over which branches.

use sgc_trust::{SignedError, verify_answer, verify_join};
use sgc_wire::{
    Answer, AnswerBody, Control, Decode, JoinBody, Name, Now, Recover, RejectReason, Signed, SinkId,
};

use crate::rib::{Branch, NameState};
use crate::router::{DropReason, LinkId, Output, Router};

impl Router {
    pub(crate) fn handle_join(&mut self, now: Now, link: LinkId, signed: Signed) {
        // Verifying is what costs: a link that asks too often is refused before it.
        if !self.links.get_mut(&link).is_some_and(|l| l.may_ask(now.instant)) {
            self.reject_unverified(link, &signed, RejectReason::Limit);
            return self.drop_frame(link, DropReason::Limit { what: "requests per second" });
        }
        let join = match verify_join(&self.config.anchors, &signed, now.unix) {
            Ok(join) => join,
            Err(why) => {
                // Whoever sent it hears why: with a wrong clock, nothing else would say so.
                self.reject_unverified(link, &signed, why.reject_reason());
                return self.not_verified(now, link, "join", why);
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
        // The same sink asks again under a new certificate: what it is granted goes on meanwhile.
        let granted = state.branches.get(&sink).is_some_and(|b| b.pending.is_none());
        let pending = (!granted).then(|| now.instant + limits.answer_wait);
        let role = join.body.request.role();
        let branch = Branch { link, peer: join.peer.node_id, certs: join.peer.path, role, pending };
        match self.names.get_mut(&name).and_then(|s| s.branches.get_mut(&sink)) {
            Some(known) if granted && known.role == role => *known = branch,
            _ => {
                self.remove_branch(name, sink);
                self.put_branch(name, sink, branch);
            }
        }
        self.send(up, Control::Join { signed });
    }

    pub(crate) fn handle_leave(&mut self, link: LinkId, name: Name, sink: SinkId) {
        let ours = self.names.get(&name).and_then(|s| s.branches.get(&sink)).is_some_and(|b| b.link == link);
        if !ours {
            return self.drop_frame(link, DropReason::Unknown { what: "leave" });
        }
        self.remove_branch(name, sink);
        self.send_up(name, Control::Leave { name, sink });
        self.tidy(name);
    }

    pub(crate) fn handle_answer(&mut self, now: Now, link: LinkId, signed: Signed) {
        // The name is needed to find the key that the signature must verify with; it is believed only after.
        let claimed = match AnswerBody::from_slice(&signed.body) {
            Ok(body) => body.name,
            Err(why) => {
                return self.not_verified(now, link, "answer", SignedError::Decode(why));
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
            Err(why) => return self.not_verified(now, link, "answer", why),
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

    pub(crate) fn handle_reject(&mut self, link: LinkId, name: Name, sink: SinkId, reason: RejectReason) {
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
    pub(crate) fn handle_recover(&mut self, link: LinkId, recover: Recover) {
        let branch = self.names.get(&recover.name).and_then(|s| s.branches.get(&recover.sink));
        if branch.is_none_or(|b| b.link != link || b.pending.is_some()) {
            return self.drop_frame(link, DropReason::Unknown { what: "recover" });
        }
        self.send_up(recover.name, Control::Recover(recover));
    }

    /// A sink has the key of an epoch; passed on towards the owner if it has a place in the tree.
    pub(crate) fn handle_ack(&mut self, link: LinkId, name: Name, sink: SinkId, serial: u64) {
        let branch = self.names.get(&name).and_then(|s| s.branches.get(&sink));
        if branch.is_none_or(|b| b.link != link || b.pending.is_some()) {
            return self.drop_frame(link, DropReason::Unknown { what: "acknowledgement" });
        }
        self.send_up(name, Control::Ack { name, sink, serial });
    }

    /// Refuses a request that was not verified, as well as can be: its body may at least say whom to answer.
    fn reject_unverified(&mut self, link: LinkId, signed: &Signed, reason: RejectReason) {
        if let Ok(JoinBody { name, sink, .. }) = JoinBody::from_slice(&signed.body) {
            self.send(link, Control::Reject { name, sink, reason });
        }
    }

    pub(crate) fn put_branch(&mut self, name: Name, sink: SinkId, branch: Branch) {
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

    pub(crate) fn remove_branch(&mut self, name: Name, sink: SinkId) -> Option<Branch> {
        let branch = self.names.get_mut(&name)?.branches.remove(&sink)?;
        if branch.pending.is_none() {
            self.refresh_fib(name);
        }
        self.detach(name, sink, &branch);
        Some(branch)
    }

    /// Takes a branch that is out of its name's tree out of the timers and the link's counts.
    pub(crate) fn detach(&mut self, name: Name, sink: SinkId, branch: &Branch) {
        if let Some(deadline) = branch.pending {
            self.pending.remove(&(deadline, name, sink));
        }
        if let Some(link) = self.links.get_mut(&branch.link) {
            link.branches -= 1;
        }
        self.release(name, branch.link);
    }

    pub(crate) fn refresh_fib(&mut self, name: Name) {
        let entry = self.names.get(&name).and_then(NameState::compile);
        self.outputs.push_back(Output::Forward { name, entry });
    }

    pub(crate) fn send_up(&mut self, name: Name, frame: Control) {
        if let Some(up) = self.names.get(&name).and_then(NameState::route).map(|r| r.link) {
            self.send(up, frame);
        }
    }
}
