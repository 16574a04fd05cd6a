//! Nodes: the local node of each endpoint.

use rand_core::RngCore;
use sgc_wire::{Name, RosNode};

use super::Routes;
use crate::network::{GraphNode, Guid};
use crate::routes::share_route::ShareRoute;

impl<R: RngCore> Routes<R> {
    /// Replaces the nodes of a local participant.
    pub(super) fn handle_nodes(&mut self, participant: Guid, nodes: Vec<GraphNode>) {
        let changed = self.local.set_nodes(participant, nodes);
        let concerned = self.shares.values().filter(|share| share.concerns(&changed));
        for name in concerned.map(ShareRoute::name).collect::<Vec<Name>>() {
            self.refresh_share(name);
        }
    }

    /// Returns the local node that an endpoint belongs to, if it is known.
    pub fn node_of(&self, endpoint: &Guid) -> Option<&RosNode> {
        self.local.node_of(endpoint)
    }
}
