//! [`Shares`]: a bounded table with a share for each node, so that none can fill it for all.
//!
//! Nothing is reserved: a node may hold as much as others leave. Only a full table decides which entry gives way.
//! `sgc_trust::Places` has the same rule for the handshakes of strangers, of which there are few.

use std::collections::{BTreeMap, BTreeSet};
use std::ops::RangeInclusive;

use sgc_wire::NodeId;

/// Entries that are each charged to a node.
///
/// A newcomer that finds the table full displaces the oldest entry of the node that holds the most. Once its own node
/// would hold as much as that one, it displaces the oldest entry of its own node, and only one that may give way.
#[derive(Debug)]
pub(crate) struct Shares<K, V> {
    entries: BTreeMap<K, Entry<V>>,
    /// The entries of each node, the oldest first.
    of_node: BTreeMap<NodeId, BTreeSet<(u64, K)>>,
    /// Number that each node holds, the one with the most last.
    held: BTreeSet<(usize, NodeId)>,
    /// Number of the next entry.
    next: u64,
}

#[derive(Debug)]
struct Entry<V> {
    node: NodeId,
    number: u64,
    value: V,
}

impl<K, V> Default for Shares<K, V> {
    fn default() -> Self {
        Self { entries: BTreeMap::new(), of_node: BTreeMap::new(), held: BTreeSet::new(), next: 0 }
    }
}

impl<K: Ord + Copy, V> Shares<K, V> {
    /// Returns an entry.
    pub(crate) fn get(&self, key: &K) -> Option<&V> {
        self.entries.get(key).map(|entry| &entry.value)
    }

    /// Returns an entry to be changed.
    pub(crate) fn get_mut(&mut self, key: &K) -> Option<&mut V> {
        self.entries.get_mut(key).map(|entry| &mut entry.value)
    }

    /// Returns `true` if there is an entry.
    pub(crate) fn contains(&self, key: &K) -> bool {
        self.entries.contains_key(key)
    }

    /// Returns `true` if there are no entries.
    pub(crate) fn is_empty(&self) -> bool {
        self.entries.is_empty()
    }

    /// Iterates over the keys of a range that have an entry.
    pub(crate) fn keys(&self, range: RangeInclusive<K>) -> impl Iterator<Item = &K> {
        self.entries.range(range).map(|(key, _)| key)
    }

    /// Returns how many entries a node holds.
    pub(crate) fn held_by(&self, node: &NodeId) -> usize {
        self.of_node.get(node).map_or(0, BTreeSet::len)
    }

    /// Puts an entry in place of the one with the same key, and charges it to a node; returns `false` if there is no
    /// room among `max` entries.
    pub(crate) fn insert(
        &mut self,
        node: NodeId,
        key: K,
        value: V,
        max: usize,
        may_give_way: impl Fn(&V) -> bool,
    ) -> bool {
        self.remove(&key);
        if self.entries.len() >= max && !self.make_room(&node, may_give_way) {
            return false;
        }
        let number = self.next;
        self.next += 1;
        self.entries.insert(key, Entry { node, number, value });
        self.change(&node, |entries| entries.insert((number, key)));
        true
    }

    /// Removes an entry.
    pub(crate) fn remove(&mut self, key: &K) -> Option<V> {
        let Entry { node, number, value } = self.entries.remove(key)?;
        self.change(&node, |entries| entries.remove(&(number, *key)));
        Some(value)
    }

    /// Removes the entries with these keys.
    pub(crate) fn remove_range(&mut self, keys: RangeInclusive<K>) {
        let keys: Vec<_> = self.entries.range(keys).map(|(key, _)| *key).collect();
        for key in keys {
            self.remove(&key);
        }
    }

    /// Removes the entries for which `keep` returns `false`.
    pub(crate) fn retain(&mut self, keep: impl Fn(&V) -> bool) {
        let gone: Vec<_> =
            self.entries.iter().filter(|(_, entry)| !keep(&entry.value)).map(|(key, _)| *key).collect();
        for key in gone {
            self.remove(&key);
        }
    }

    fn make_room(&mut self, node: &NodeId, may_give_way: impl Fn(&V) -> bool) -> bool {
        let own = self.held_by(node);
        let Some((most, heaviest)) = self.held.last().copied() else { return false };
        // Displacing one of that node's entries leaves it with at least as many as the newcomer's node.
        let is_heavier = most > own + 1;
        let of = if is_heavier || own == 0 { heaviest } else { *node };
        let Some((_, oldest)) = self.of_node.get(&of).and_then(BTreeSet::first).copied() else {
            return false;
        };
        let displaces = is_heavier || self.get(&oldest).is_some_and(may_give_way);
        if displaces {
            self.remove(&oldest);
        }
        displaces
    }

    fn change(&mut self, node: &NodeId, change: impl FnOnce(&mut BTreeSet<(u64, K)>) -> bool) {
        let entries = self.of_node.entry(*node).or_default();
        self.held.remove(&(entries.len(), *node));
        change(entries);
        if entries.is_empty() {
            self.of_node.remove(node);
        } else {
            self.held.insert((entries.len(), *node));
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn node(number: u8) -> NodeId {
        NodeId([number; 32])
    }

    /// Inserts an entry that gives way once it is `true`.
    fn put(shares: &mut Shares<u32, bool>, by: u8, key: u32, settled: bool) -> bool {
        shares.insert(node(by), key, settled, 8, |settled| *settled)
    }

    #[test]
    fn the_node_with_the_most_makes_room_until_others_have_as_much() {
        let mut shares = Shares::default();
        assert!((0..8).all(|key| put(&mut shares, 1, key, false)), "it may have all that nobody else wants");
        assert!(!put(&mut shares, 1, 8, false));
        let taken = (100..120).filter(|key| put(&mut shares, 2, *key, false)).count();
        assert_eq!((taken, shares.held_by(&node(1)), shares.held_by(&node(2))), (4, 4, 4));
        assert!(
            (0..8).map(|key| shares.contains(&key)).eq([false, false, false, false, true, true, true, true])
        );
        assert!(put(&mut shares, 3, 200, false) && put(&mut shares, 3, 201, false));
        assert_eq!([1, 2, 3].map(|n| shares.held_by(&node(n))), [3, 3, 2]);
    }

    #[test]
    fn a_node_with_its_share_displaces_its_own_oldest_once_that_may_give_way() {
        let mut shares = Shares::default();
        assert!((0..4).all(|key| put(&mut shares, 1, key, key == 0)));
        assert!((4..8).all(|key| put(&mut shares, 2, key, false)));
        assert!(put(&mut shares, 1, 8, false));
        assert!(!put(&mut shares, 1, 9, false), "the next one is too young");
        assert_eq!((shares.get(&0), shares.held_by(&node(2))), (None, 4));
        assert!(put(&mut shares, 1, 8, true), "what is there needs no new room");
    }

    #[test]
    fn nothing_is_left_of_what_was_removed() {
        let mut shares = Shares::default();
        assert!((0..8).all(|key| put(&mut shares, (key % 3) as u8, key, key < 6)));
        shares.remove_range(0..=1);
        shares.retain(|settled| *settled);
        assert_eq!((shares.remove(&2), shares.remove(&2)), (Some(true), None));
        assert!((3..6).all(|key| shares.remove(&key).is_some()));
        assert!(shares.is_empty() && shares.of_node.is_empty() && shares.held.is_empty());
    }
}
