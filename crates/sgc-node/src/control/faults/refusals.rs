//! Refused nodes of each share, to explain later why nothing flows.

use std::collections::BTreeMap;

use sgc_wire::{Name, NodeId};

/// Names whose refusals are remembered.
const REFUSED_NAMES_MAX: usize = 256;
/// Refused nodes remembered for one name.
const REFUSED_NODES_MAX: usize = 16;

/// Refusals by name and node.
#[derive(Default)]
pub(crate) struct Refusals {
    names: BTreeMap<Name, BTreeMap<NodeId, String>>,
}

impl Refusals {
    /// Remembers a refusal.
    pub(crate) fn remember(&mut self, name: Name, peer: NodeId, reason: &impl ToString) {
        if self.names.len() >= REFUSED_NAMES_MAX && !self.names.contains_key(&name) {
            self.names.pop_first();
        }
        let of_name = self.names.entry(name).or_default();
        if of_name.len() >= REFUSED_NODES_MAX && !of_name.contains_key(&peer) {
            of_name.pop_first();
        }
        of_name.insert(peer, reason.to_string());
    }

    /// Forgets a refusal, because it may no longer hold.
    pub(crate) fn forget(&mut self, name: &Name, peer: &NodeId) {
        if let Some(of_name) = self.names.get_mut(name) {
            of_name.remove(peer);
        }
    }

    /// Returns the refused nodes of a name, with the reasons.
    pub(crate) fn for_name(&self, name: &Name) -> impl Iterator<Item = (&NodeId, &String)> {
        self.names.get(name).into_iter().flatten()
    }
}
