//! [`Receivers`]: the nodes that share a key with the owner of a name, for the MACs of a `pairwise` suite.
//!
//! The owner changes the set before it sends a grant or after it took one back. The sources of its node read the set
//! for each message, on their own threads. The owner's sink of a service finds the keys of callers in it. At a caller,
//! the set has the one key that it shares with the owner.

use std::collections::BTreeMap;
use std::sync::{Arc, Mutex};

use sgc_sync::lock;
use sgc_trust::RECEIVERS_MAX;
use sgc_wire::{NodeId, ReceiverKey, SinkId, SourceId};

/// The nodes with receiver keys of one name.
#[derive(Debug, Default)]
pub struct Receivers(Mutex<Granted>);

#[derive(Debug, Default)]
struct Granted {
    sinks: BTreeMap<SinkId, NodeId>,
    /// The sinks of callers, by the sources of their requests.
    callers: BTreeMap<SourceId, SinkId>,
    /// Each node with its key and its number of sinks.
    nodes: BTreeMap<NodeId, (Arc<ReceiverKey>, usize)>,
}

impl Receivers {
    /// Returns the set of a caller: the owner is the one receiver of its requests.
    pub fn of_caller(shared_with_owner: ReceiverKey) -> Self {
        // Nobody asks for the id of the owner.
        let owner = (NodeId([0; 32]), (Arc::new(shared_with_owner), 1));
        Self(Mutex::new(Granted { nodes: [owner].into(), ..Granted::default() }))
    }

    /// Adds a sink of a node, with the key of a new node. A known sink stays as it is.
    pub fn add(&self, sink: SinkId, node: NodeId, key: impl FnOnce() -> ReceiverKey) {
        let granted = &mut *lock(&self.0);
        if granted.sinks.contains_key(&sink) {
            return;
        }
        let (_, count) = granted.nodes.entry(node).or_insert_with(|| (Arc::new(key()), 0));
        *count += 1;
        granted.sinks.insert(sink, node);
    }

    /// Notes the source under which the node of a granted sink calls.
    pub fn set_caller(&self, source: SourceId, sink: SinkId) {
        lock(&self.0).callers.insert(source, sink);
    }

    /// Removes a sink.
    pub fn remove(&self, sink: &SinkId) {
        let granted = &mut *lock(&self.0);
        granted.callers.retain(|_, caller| caller != sink);
        let Some(node) = granted.sinks.remove(sink) else { return };
        if let Some((_, count)) = granted.nodes.get_mut(&node) {
            *count -= 1;
            if *count == 0 {
                granted.nodes.remove(&node);
            }
        }
    }

    /// Returns the key of the node of a granted sink.
    pub(crate) fn key_of(&self, sink: &SinkId) -> Option<Arc<ReceiverKey>> {
        let granted = lock(&self.0);
        let (key, _) = granted.nodes.get(granted.sinks.get(sink)?)?;
        Some(key.clone())
    }

    /// Returns the key of the node that calls under a source.
    pub(crate) fn key_of_caller(&self, source: &SourceId) -> Option<Arc<ReceiverKey>> {
        let sink = *lock(&self.0).callers.get(source)?;
        self.key_of(&sink)
    }

    /// Sets `listed` to the keys of all receivers, unless they are too many for MACs.
    pub(crate) fn update(&self, listed: &mut Vec<Arc<ReceiverKey>>) -> ReceiverList {
        let granted = lock(&self.0);
        if granted.nodes.len() > RECEIVERS_MAX {
            return ReceiverList::TooMany;
        }
        let now = granted.nodes.values().map(|(key, _)| key);
        if now.len() == listed.len()
            && now.clone().zip(&*listed).all(|(now, before)| Arc::ptr_eq(now, before))
        {
            return ReceiverList::Unchanged;
        }
        listed.clear();
        listed.extend(now.cloned());
        ReceiverList::Changed
    }
}

/// The result of [`Receivers::update`].
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum ReceiverList {
    /// The list is the one of before.
    Unchanged,
    /// The list is another one.
    Changed,
    /// There are more than [`RECEIVERS_MAX`] receivers. The list is the one of before.
    TooMany,
}

#[cfg(test)]
mod tests {
    use sgc_wire::SecretBytes;

    use super::*;

    fn add(receivers: &Receivers, sink: u8, node: u8) {
        let key = || ReceiverKey { id: [node; 4], key: SecretBytes::new([node; 32]) };
        receivers.add(SinkId([sink; 16]), NodeId([node; 32]), key);
    }

    fn update(receivers: &Receivers, listed: &mut Vec<Arc<ReceiverKey>>) -> (ReceiverList, Vec<u8>) {
        let changed = receivers.update(listed);
        (changed, listed.iter().map(|key| key.id[0]).collect())
    }

    #[test]
    fn each_node_counts_once_while_it_has_a_sink() {
        use ReceiverList::{Changed, Unchanged};
        let (receivers, mut listed) = (Receivers::default(), Vec::new());
        assert_eq!(update(&receivers, &mut listed), (Unchanged, vec![]));
        for (sink, node) in [(1, 1), (2, 2), (3, 1), (3, 1)] {
            add(&receivers, sink, node);
        }
        assert_eq!(update(&receivers, &mut listed), (Changed, vec![1, 2]));
        assert_eq!(update(&receivers, &mut listed), (Unchanged, vec![1, 2]));
        let of_sink = |n: u8| receivers.key_of(&SinkId([n; 16])).map(|key| key.id[0]);
        assert_eq!([1, 2, 3, 4].map(of_sink), [Some(1), Some(2), Some(1), None]);
        receivers.remove(&SinkId([1; 16]));
        receivers.remove(&SinkId([1; 16]));
        assert_eq!(update(&receivers, &mut listed), (Unchanged, vec![1, 2]));
        receivers.remove(&SinkId([3; 16]));
        assert_eq!(update(&receivers, &mut listed), (Changed, vec![2]));
    }

    #[test]
    fn callers_are_known_by_their_sources_while_their_sinks_are_granted() {
        let receivers = Receivers::default();
        let key_of = |n| receivers.key_of_caller(&SourceId([n; 16])).map(|key| key.id[0]);
        for n in [1, 2] {
            add(&receivers, n, n);
            receivers.set_caller(SourceId([n; 16]), SinkId([n; 16]));
        }
        assert_eq!([1, 2, 3].map(key_of), [Some(1), Some(2), None]);
        receivers.remove(&SinkId([1; 16]));
        assert_eq!([1, 2].map(key_of), [None, Some(2)]);
    }

    #[test]
    fn nodes_whose_keys_have_one_id_have_both_keys() {
        let (receivers, mut listed) = (Receivers::default(), Vec::new());
        let key = |n| ReceiverKey { id: [7; 4], key: SecretBytes::new([n; 32]) };
        for n in [1, 2] {
            receivers.add(SinkId([n; 16]), NodeId([n; 32]), || key(n));
        }
        receivers.update(&mut listed);
        assert_eq!(listed.iter().map(|key| ReceiverKey::clone(key)).collect::<Vec<_>>(), [key(1), key(2)]);
        assert_eq!(receivers.key_of(&SinkId([2; 16])).as_deref(), Some(&key(2)));
        receivers.remove(&SinkId([1; 16]));
        receivers.update(&mut listed);
        assert_eq!(listed.iter().map(|key| ReceiverKey::clone(key)).collect::<Vec<_>>(), [key(2)]);
    }

    #[test]
    fn more_receivers_than_macs_are_not_listed() {
        use ReceiverList::{Changed, TooMany, Unchanged};
        let (receivers, mut listed) = (Receivers::default(), Vec::new());
        let many = RECEIVERS_MAX as u8 + 1;
        let all: Vec<_> = (1..many).collect();
        (1..=many).for_each(|n| add(&receivers, n, n));
        assert_eq!(update(&receivers, &mut listed), (TooMany, vec![]));
        receivers.remove(&SinkId([many; 16]));
        assert_eq!(update(&receivers, &mut listed), (Changed, all.clone()));
        add(&receivers, many, many);
        assert_eq!(update(&receivers, &mut listed), (TooMany, all.clone()));
        receivers.remove(&SinkId([many; 16]));
        assert_eq!(update(&receivers, &mut listed), (Unchanged, all.clone()));
    }
}
