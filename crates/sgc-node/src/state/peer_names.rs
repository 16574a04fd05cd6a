//! [`PeerNames`]: the names of nodes, for the log, the audit log and the status.

use std::collections::BTreeMap;
use std::sync::Arc;

use arc_swap::ArcSwap;
use sgc_wire::NodeId;

/// The names that this node knows of others, by their ids. Clones share them.
///
/// A router knows few: the ids of nodes that it serves tell it no names.
#[derive(Clone, Debug, Default)]
pub struct PeerNames(Arc<ArcSwap<BTreeMap<NodeId, String>>>);

impl PeerNames {
    /// Replaces all names.
    pub fn set(&self, names: BTreeMap<NodeId, String>) {
        self.0.store(Arc::new(names));
    }

    /// Returns the name of a node, if it is known.
    pub fn get(&self, node: &NodeId) -> Option<String> {
        self.0.load().get(node).cloned()
    }

    /// Returns the name of a node, or the beginning of its id.
    pub fn called(&self, node: &NodeId) -> String {
        self.get(node).unwrap_or_else(|| node.short())
    }
}

impl From<BTreeMap<NodeId, String>> for PeerNames {
    fn from(names: BTreeMap<NodeId, String>) -> Self {
        Self(Arc::new(ArcSwap::from_pointee(names)))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn node_without_a_name_is_called_by_its_id() {
        let [known, unknown] = [NodeId([7; 32]), NodeId([8; 32])];
        let names = PeerNames::from(BTreeMap::from([(known, "desk".to_owned())]));
        let clone = names.clone();
        assert_eq!(clone.called(&known), "desk");
        assert_eq!((clone.get(&unknown), clone.called(&unknown)), (None, unknown.short()));
        names.set(BTreeMap::from([(unknown, "arm".to_owned())]));
        assert_eq!((clone.get(&known), clone.called(&unknown)), (None, "arm".to_owned()));
    }
}
