//! Nodes: the local node of each endpoint, and the far node that each local writer represents.

use rand_core::RngCore;
use sgc_wire::{Name, NodeId, RosNode, SourceId};

use super::command::Command;
use super::machine::Routes;
use super::share_route::ShareRoute;
use crate::network::{GraphNode, Guid};

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

    /// Announces the far nodes that the open writers of a use represent, where they changed.
    pub(super) fn name_writers(&mut self, name: Name) {
        let Some(route) = self.uses.get_mut(&name) else { return };
        let rule = &self.use_rules[route.rule];
        let owner: NodeId = rule.owner;
        let is_here = |source: &Option<SourceId>| match source {
            None if route.server.is_some() => true,
            source => route.writers.contains_key(source),
        };
        route.nodes.retain(|source, _| is_here(source));
        for listed in &route.entry.sources {
            // One local server represents all remote ones and is shown as part of the first one's node.
            let source = listed.source.told_apart().filter(|_| route.server.is_none());
            let node = listed.node.as_ref().map(|node| rule.local_node(node));
            let is_first = source.is_some() || listed.source == route.entry.sources[0].source;
            if !is_first || !is_here(&source) || route.nodes.get(&source) == node.as_ref() {
                continue;
            }
            match &node {
                Some(node) => route.nodes.insert(source, node.clone()),
                None => route.nodes.remove(&source),
            };
            self.commands.push_back(Command::SetNode { name, source, owner, node });
        }
    }
}
