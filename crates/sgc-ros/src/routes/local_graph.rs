//! [`LocalGraph`]: the endpoints of the local network, and the ROS 2 nodes that they belong to.

use std::collections::{BTreeMap, BTreeSet};

use sgc_wire::{History, Qos, RosNode};

use crate::network::{DiscoveredEndpoint, GraphNode, Guid};

/// Most local endpoints that are tracked.
pub(super) const LOCAL_ENDPOINTS_MAX: usize = 65_536;

/// The local endpoints and nodes.
#[derive(Debug, Default)]
pub(super) struct LocalGraph {
    endpoints: BTreeMap<Guid, DiscoveredEndpoint>,
    /// The writers whose liveliness lease has run out.
    lapsed: BTreeSet<Guid>,
    /// The endpoints of each local participant that belong to a ROS 2 node, with that node.
    nodes: BTreeMap<Guid, BTreeMap<Guid, RosNode>>,
}

impl LocalGraph {
    /// Returns `true` if no further endpoint is tracked.
    pub(super) fn is_full(&self) -> bool {
        self.endpoints.len() >= LOCAL_ENDPOINTS_MAX
    }

    /// Adds an endpoint. Returns the one that it replaces.
    pub(super) fn insert(&mut self, endpoint: DiscoveredEndpoint) -> Option<DiscoveredEndpoint> {
        self.endpoints.insert(endpoint.guid, endpoint)
    }

    /// Removes an endpoint.
    pub(super) fn remove(&mut self, guid: &Guid) -> Option<DiscoveredEndpoint> {
        self.lapsed.remove(guid);
        self.endpoints.remove(guid)
    }

    /// Iterates over the endpoints.
    pub(super) fn endpoints(&self) -> impl Iterator<Item = &DiscoveredEndpoint> {
        self.endpoints.values()
    }

    /// Handles the expiry of a writer's lease, or its renewal.
    pub(super) fn set_alive(&mut self, writer: &Guid, is_alive: bool) {
        if is_alive || !self.endpoints.contains_key(writer) {
            self.lapsed.remove(writer);
        } else {
            self.lapsed.insert(*writer);
        }
    }

    /// Returns `false` if the endpoint is a writer whose lease has run out.
    pub(super) fn is_alive(&self, endpoint: &Guid) -> bool {
        !self.lapsed.contains(endpoint)
    }

    /// Iterates over the participants whose nodes are known.
    pub(super) fn participants(&self) -> impl Iterator<Item = Guid> {
        self.nodes.keys().copied()
    }

    /// Sets the depth of a publisher that did not announce it, and returns its history. Not for publishers with a
    /// lifespan, because an expired message looks like a dropped one and makes the depth uncertain.
    pub(super) fn learn_depth(&mut self, writer: &Guid, depth: u32) -> Option<History> {
        let is_unsaid = |qos: &Qos| qos.history.is_unsaid() && qos.lifespan_ns.is_none();
        let endpoint = self.endpoints.get_mut(writer).filter(|e| is_unsaid(&e.qos))?;
        endpoint.qos.history = History::KeepLast(depth.max(1));
        Some(endpoint.qos.history)
    }

    /// Replaces the nodes of a participant. Returns the endpoints that belong to another node now.
    pub(super) fn set_nodes(&mut self, participant: Guid, nodes: Vec<GraphNode>) -> BTreeSet<Guid> {
        let before = self.nodes.remove(&participant).unwrap_or_default();
        let mut after = BTreeMap::new();
        let known: usize = self.nodes.values().map(BTreeMap::len).sum();
        for GraphNode { node, readers, writers } in nodes {
            let room = LOCAL_ENDPOINTS_MAX.saturating_sub(known + after.len());
            after.extend(readers.into_iter().chain(writers).take(room).map(|guid| (guid, node.clone())));
        }
        let both = before.keys().chain(after.keys());
        let changed = both.filter(|guid| before.get(guid) != after.get(guid)).copied().collect();
        if !after.is_empty() {
            self.nodes.insert(participant, after);
        }
        changed
    }

    /// Returns the node that an endpoint belongs to, if it is known.
    pub(super) fn node_of(&self, endpoint: &Guid) -> Option<&RosNode> {
        // The participant has the same prefix as its endpoints.
        let mut first = Guid([0; 16]);
        first.0[..12].copy_from_slice(&endpoint.prefix());
        let mut last = Guid([0xff; 16]);
        last.0[..12].copy_from_slice(&endpoint.prefix());
        self.nodes.range(first..=last).find_map(|(_, nodes)| nodes.get(endpoint))
    }
}
