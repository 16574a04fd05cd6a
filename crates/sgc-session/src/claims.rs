//! [`ClaimTable`]: the nodes that this node has links to, so that two searches for one router make one link.
//!
//! It decides nothing. A caller that finds a node claimed stands back. The driver guards the table and wakes those that
//! wait for a change.

use std::collections::{BTreeMap, BTreeSet};

use sgc_wire::NodeId;

/// Nodes that this node dialled, each claimed once, and nodes that dialled this one.
#[derive(Debug, Default)]
pub struct ClaimTable {
    dialled: BTreeSet<NodeId>,
    /// Number of incoming links of each node.
    came: BTreeMap<NodeId, usize>,
}

impl ClaimTable {
    /// Claims a dialled node. Returns `false` if it is claimed already.
    pub fn claim(&mut self, node: NodeId) -> bool {
        self.dialled.insert(node)
    }

    /// Ends the claim of a dialled node.
    pub fn release(&mut self, node: &NodeId) {
        self.dialled.remove(node);
    }

    /// Adds an incoming link of a node.
    pub fn arrives(&mut self, node: NodeId) {
        *self.came.entry(node).or_default() += 1;
    }

    /// Removes an incoming link of a node.
    pub fn leaves(&mut self, node: &NodeId) {
        if let Some(links) = self.came.get_mut(node) {
            *links -= 1;
            if *links == 0 {
                self.came.remove(node);
            }
        }
    }

    /// Returns `true` if a node has an incoming link here.
    pub fn has_come(&self, node: &NodeId) -> bool {
        self.came.contains_key(node)
    }

    /// Returns `true` if no link to this node is left, in either direction.
    pub fn is_free(&self, node: &NodeId) -> bool {
        !self.dialled.contains(node) && !self.came.contains_key(node)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_node_is_claimed_once_until_it_is_released() {
        let (mut table, node, other) = (ClaimTable::default(), NodeId([1; 32]), NodeId([2; 32]));
        assert!(table.claim(node) && !table.claim(node) && table.claim(other));
        table.release(&other);
        assert!(!table.is_free(&node) && table.is_free(&other));
        table.release(&node);
        assert!(table.is_free(&node) && table.claim(node));
    }

    #[test]
    fn a_node_with_two_incoming_links_is_free_after_both_ended() {
        let (mut table, node) = (ClaimTable::default(), NodeId([1; 32]));
        table.arrives(node);
        table.arrives(node);
        table.leaves(&node);
        assert!(table.has_come(&node) && !table.is_free(&node));
        table.leaves(&node);
        assert!(!table.has_come(&node) && table.is_free(&node));
        // A departure that nobody saw arrive changes nothing.
        table.leaves(&node);
        assert!(table.is_free(&node));
    }
}
