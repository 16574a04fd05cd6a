//! Nodes: the local node of each endpoint, and the far node that each local writer represents.

use std::collections::BTreeMap;

use rand_core::RngCore;
use sgc_wire::{Name, NodeId, RosNode, SourceId};

use super::{Command, LOCAL_ENDPOINTS_MAX, Rename, Routes, UseRule};
use crate::network::{GraphNode, Guid};

impl UseRule {
    /// Returns the local name of a node whose interfaces this rule brings.
    pub(super) fn local_node(&self, node: &RosNode) -> RosNode {
        let Rename::Namespace(namespace) = &self.naming.rename else { return node.clone() };
        let below = node.namespace().trim_end_matches('/');
        // A name that becomes too long stays as it is.
        let named = RosNode::new(&format!("{namespace}{below}"), node.name(), node.enclave());
        named.unwrap_or_else(|| node.clone())
    }
}

impl<R: RngCore> Routes<R> {
    /// Replaces the nodes of a local participant.
    pub(super) fn handle_nodes(&mut self, participant: Guid, nodes: Vec<GraphNode>) {
        let before = self.nodes.remove(&participant).unwrap_or_default();
        let mut after = BTreeMap::new();
        let known: usize = self.nodes.values().map(BTreeMap::len).sum();
        for GraphNode { node, readers, writers } in nodes {
            let room = LOCAL_ENDPOINTS_MAX.saturating_sub(known + after.len());
            after.extend(readers.into_iter().chain(writers).take(room).map(|guid| (guid, node.clone())));
        }
        let has_changed = |guid: &Guid| before.get(guid) != after.get(guid);
        let concerned = self
            .shares
            .iter()
            .filter(|(_, share)| share.own.keys().chain(share.writers.keys()).any(has_changed));
        let concerned: Vec<Name> = concerned.map(|(name, _)| *name).collect();
        if !after.is_empty() {
            self.nodes.insert(participant, after);
        }
        for name in concerned {
            self.refresh_share(name);
        }
    }

    /// Returns the local node that an endpoint belongs to, if it is known.
    pub fn node_of(&self, endpoint: &Guid) -> Option<&RosNode> {
        // The participant has the same prefix as its endpoints.
        let mut first = Guid([0; 16]);
        first.0[..12].copy_from_slice(&endpoint.prefix());
        let mut last = Guid([0xff; 16]);
        last.0[..12].copy_from_slice(&endpoint.prefix());
        self.nodes.range(first..=last).find_map(|(_, nodes)| nodes.get(endpoint))
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
