//! Keep-alive policies of peers. A peer behind a NAT that forgets soon needs shorter intervals, also on its next link.

use std::collections::BTreeMap;
use std::time::Duration;

use sgc_session::KeepAlivePolicy;
use sgc_wire::NodeId;

/// Most peers whose shorter keep-alive interval is remembered.
const IMPATIENT_MAX: usize = 1024;

/// The policy of new links, and the shorter intervals of some peers.
pub(crate) struct PeerPolicies {
    usual: KeepAlivePolicy,
    impatient: BTreeMap<NodeId, Duration>,
}

impl PeerPolicies {
    /// Creates the policies without exceptions.
    pub(crate) fn new(usual: KeepAlivePolicy) -> Self {
        Self { usual, impatient: BTreeMap::new() }
    }

    /// Returns the policy of a link to this peer.
    pub(crate) fn for_peer(&self, node: &NodeId) -> KeepAlivePolicy {
        KeepAlivePolicy { max: self.impatient.get(node).copied().unwrap_or(self.usual.max), ..self.usual }
    }

    /// Remembers the policy that an ending link had to use.
    pub(crate) fn remember(&mut self, node: NodeId, used: KeepAlivePolicy) {
        let is_known = self.impatient.contains_key(&node);
        if used.max < self.usual.max && (is_known || self.impatient.len() < IMPATIENT_MAX) {
            self.impatient.insert(node, used.max);
        }
    }
}
