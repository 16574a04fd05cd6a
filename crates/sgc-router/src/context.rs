//! [`Context`]: the surroundings of a part while the router handles an event.

use sgc_wire::{Control, Name, NodeId, Now};

use crate::drops::{DropReason, RouterDrop};
use crate::limits::allowances::{Allowance, Allowances};
use crate::link_id::LinkId;
use crate::network::Network;
use crate::output::{Output, Outputs};
use crate::store::{LookUpStart, Store};

/// The time, the network to read, the allowances to charge, and the queue for effects in their order.
#[derive(Debug)]
pub(crate) struct Context<'a> {
    pub(crate) now: Now,
    pub(crate) network: Network<'a>,
    pub(crate) allowances: &'a mut Allowances,
    pub(crate) outputs: &'a mut Outputs,
    /// The store, at a router that has one.
    pub(crate) store: Option<&'a mut Store>,
}

impl Context<'_> {
    /// Sends a frame over a link, if that is up.
    pub(crate) fn send(&mut self, link: LinkId, frame: Control) {
        if self.network.links.contains(link) {
            self.outputs.push(Output::Send { link, frame });
        }
    }

    /// Reports a dropped frame or body from a link.
    pub(crate) fn drop_frame(&mut self, link: LinkId, reason: DropReason) {
        let peer = self.network.links.get(link).map(|state| *state.node());
        self.outputs.push(Output::Dropped(RouterDrop { link, peer, reason }));
    }

    /// Returns the remaining allowance of a node.
    pub(crate) fn allowance(&mut self, node: &NodeId) -> &mut Allowance {
        self.allowances.node(self.now.instant, node)
    }

    /// Looks a name up in the store.
    pub(crate) fn look_up(&mut self, name: Name) -> LookUpStart {
        let now = self.now.instant;
        self.store.as_mut().map_or(LookUpStart::Unavailable, |store| store.look_up(now, name))
    }

    /// Returns `true` if an announcement from `link` may be verified; otherwise it is dropped, because its neighbour
    /// brought too many without news.
    pub(crate) fn may_bring(&mut self, link: LinkId) -> bool {
        let Some(peer) = self.network.links.remote_peer(link) else { return true };
        let now = self.now.instant;
        let may = self.allowance(&peer.node).may_bring(now, peer.is_router);
        if !may {
            self.drop_frame(link, DropReason::StaleFlood);
        }
        may
    }

    /// Charges the neighbour that brought an announcement which was verified in vain.
    pub(crate) fn charge_stale(&mut self, link: LinkId) {
        let Some(peer) = self.network.links.remote_peer(link) else { return };
        let now = self.now.instant;
        self.allowance(&peer.node).brought_stale(now, peer.is_router);
    }
}
