//! Wishes: what this node's subscribers want less of is told to the owners, and owners send no more than somebody wants.

use std::collections::BTreeSet;

use sgc_endpoint::LostReason;
use sgc_ros::RosNetwork;
use sgc_wire::{NodeId, Wish};

use super::Core;
use crate::clock::now;

impl<N: RosNetwork> Core<N> {
    /// Takes all the wishes of a node.
    pub(super) fn wishes_told(&mut self, peer: NodeId, wishes: &[Wish]) {
        self.wishes.told(peer, wishes);
    }

    /// Handles that a node tells no wishes any more. Those of a node that is out of reach stay while it is a subscriber.
    pub(super) fn wishes_lost(&mut self, peer: &NodeId, reason: LostReason) {
        match reason {
            LostReason::Withdrawn | LostReason::Refused(_) => self.wishes.withdrawn(peer),
            LostReason::Unreachable | LostReason::Cut(_) => {}
        }
    }

    /// Tells owners what this node wants if that has changed, and limits its own topics to what is wanted. Returns `true`
    /// if there was something to do.
    pub(super) fn settle_wishes(&mut self) -> bool {
        let own = self.wishes.take_own();
        let is_own_changed = own.is_some();
        if let Some(own) = own {
            self.endpoint.set_wishes(now(), own);
        }
        if !self.wishes.take_changed() {
            return is_own_changed;
        }
        let own = self.certificates.identity().node_id();
        let names: Vec<_> = self.shares.names().collect();
        let subscribers = names.iter().flat_map(|name| self.endpoint.subscribers(name));
        let subscribers: BTreeSet<_> = subscribers.filter(|node| *node != own).collect();
        let asked = self.wishes.ask(&subscribers);
        asked.leave.iter().for_each(|peer| self.endpoint.leave_wishes(now(), peer));
        asked.ask.iter().for_each(|peer| self.endpoint.ask_wishes(now(), *peer));
        for name in names {
            let wished = self.wishes.of(&name, self.endpoint.subscribers(&name));
            if let Some(share) = self.shares.get(&name) {
                share.wish(wished);
            }
        }
        true
    }
}
