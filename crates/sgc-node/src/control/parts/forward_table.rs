//! [`ForwardTable`]: the forwarding entries of the router machine, with the statistics of their names.
//!
//! [`crate::data::dataplane`] has its own tables, which the control task builds from these entries.

use std::collections::HashMap;
use std::sync::Arc;

use sgc_router::{FibEntry, LinkId};
use sgc_wire::Name;

use crate::data::stats::NameStats;

/// Forwarding entries by name.
#[derive(Default)]
pub(crate) struct ForwardTable(HashMap<Name, (FibEntry, Arc<NameStats>)>);

impl ForwardTable {
    /// Sets the entry of a name. Returns the statistics, which an earlier entry of the name hands on.
    pub(crate) fn set(&mut self, name: Name, entry: FibEntry) -> Arc<NameStats> {
        let stats = self.0.remove(&name).map(|(_, stats)| stats).unwrap_or_default();
        self.0.insert(name, (entry, stats.clone()));
        stats
    }

    pub(crate) fn remove(&mut self, name: &Name) {
        self.0.remove(name);
    }

    pub(crate) fn get(&self, name: &Name) -> Option<(&FibEntry, &NameStats)> {
        self.0.get(name).map(|(entry, stats)| (entry, &**stats))
    }

    pub(crate) fn names(&self) -> impl Iterator<Item = &Name> {
        self.0.keys()
    }

    /// Returns the statistics of all names.
    pub(crate) fn stats(&self) -> impl Iterator<Item = (&Name, &NameStats)> {
        self.0.iter().map(|(name, (_, stats))| (name, &**stats))
    }

    /// Returns `true` if packets of a name leave or arrive on a link.
    pub(crate) fn uses_link(&self, name: &Name, link: LinkId) -> bool {
        self.get(name).is_some_and(|(entry, _)| {
            entry.links().contains(&link) || entry.trees.iter().any(|tree| tree.up == link)
        })
    }
}

#[cfg(test)]
mod tests {
    use sgc_router::Tree;

    use super::*;

    fn entry(up: LinkId, down: LinkId) -> FibEntry {
        let (down, publishers) = ([down].as_slice().into(), [].as_slice().into());
        FibEntry { trees: [Tree { up, down, publishers }].into(), sinks: vec![] }
    }

    #[test]
    fn statistics_outlast_a_changed_entry_and_end_with_the_name() {
        let (mut table, name) = (ForwardTable::default(), Name([1; 32]));
        let first = table.set(name, entry(LinkId(1), LinkId(2)));
        first.count(10);
        let second = table.set(name, entry(LinkId(1), LinkId(3)));
        assert!(Arc::ptr_eq(&first, &second));
        table.remove(&name);
        assert!(table.get(&name).is_none() && table.names().next().is_none());
        assert!(!Arc::ptr_eq(&first, &table.set(name, entry(LinkId(1), LinkId(2)))));
    }

    #[test]
    fn name_uses_the_links_on_which_its_packets_arrive_and_leave() {
        let (mut table, name) = (ForwardTable::default(), Name([1; 32]));
        table.set(name, entry(LinkId(1), LinkId(2)));
        let used: Vec<_> = (0..4).filter(|id| table.uses_link(&name, LinkId(*id))).collect();
        assert_eq!(used, [1, 2]);
        assert!(!table.uses_link(&Name([2; 32]), LinkId(1)));
    }
}
