//! A running node drives the search for direct paths as `sgc-node` does.

use std::collections::BTreeSet;

use bytes::Bytes;
use sgc_session::DirectOutput;
use sgc_trust::VerifiedPeer;
use sgc_wire::{Now, SinkId};

use super::direct::{DirectNode, LOOK_EVERY};
use super::{Effect, Running};

impl Running {
    /// Looks for direct paths from here on.
    pub(crate) fn begin_direct(&mut self, now: Now, seed: u64) {
        self.direct = Some(DirectNode::new(now.instant, self.identity.as_peer(), seed));
        self.endpoint.offer_paths(now, true);
    }

    pub(super) fn path_asked(&mut self, now: Now, sink: SinkId, peer: &VerifiedPeer, question: &Bytes) {
        let Some(direct) = &mut self.direct else { return };
        let answer = direct.asked(now.instant, peer, question);
        self.endpoint.answer_path(now, sink, answer);
    }

    /// Looks at the direct links if it is time to.
    pub(super) fn direct_timeout(&mut self, now: Now) {
        let Some(direct) = &mut self.direct else { return };
        if direct.look_at <= now.instant {
            direct.look_at = now.instant + LOOK_EVERY;
            self.effects.push(Effect::Look);
            self.look_at_direct(now);
        }
    }

    /// Looks with whom data is exchanged, and closes direct links that nothing uses.
    fn look_at_direct(&mut self, now: Now) {
        let Some(direct) = &mut self.direct else { return };
        let configured = self.neighbours.iter().filter(|(link, _)| !direct.is_direct(**link));
        let reached: BTreeSet<_> = configured.map(|(_, node)| *node).collect();
        let owners = self.endpoint.data_owners().filter(|owner| !reached.contains(&owner.node_id));
        let permitted = owners.filter(|owner| direct.permitted.find(owner).is_some());
        let wanted = permitted.map(|owner| owner.node_id).chain(direct.forced.iter().copied()).collect();
        direct.paths.want(now.instant, &wanted);
        for link in direct.unused(now.instant, &self.router) {
            self.effects.push(Effect::HangUp(link));
        }
    }

    /// Carries out what the search for direct paths wants. Returns `true` if there was something.
    pub(super) fn drain_direct(&mut self, now: Now) -> bool {
        let Some(direct) = &mut self.direct else { return false };
        if direct.paths.deadline().is_some_and(|at| at <= now.instant) {
            direct.paths.handle_timeout(now.instant);
        }
        let mut progressed = false;
        while let Some(output) = direct.paths.poll() {
            progressed = true;
            match output {
                DirectOutput::Ask { peer, question } => self.endpoint.ask_path(now, peer, &question),
                DirectOutput::Leave { peer } => self.endpoint.leave_path(now, &peer),
                DirectOutput::Send { from, to, datagram } => {
                    // As in the driver, checks leave from the address that the system chooses.
                    if direct.host == Some(from) {
                        self.effects.push(Effect::Check(to, datagram));
                    }
                }
                DirectOutput::Admit { peer, from } => {
                    direct.expected.insert(from, peer);
                }
                DirectOutput::Shut { peer } => direct.expected.retain(|_, expected| *expected != peer),
                DirectOutput::Dial { peer, to } => self.effects.push(Effect::Dial(peer, to)),
            }
        }
        progressed
    }
}
