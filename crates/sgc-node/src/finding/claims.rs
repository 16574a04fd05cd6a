//! Which nodes this one has links to, so that two ways to one router make one link.
//!
//! It decides nothing: who finds a node taken stands back, which is for the caller.

use std::collections::{BTreeMap, BTreeSet};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};

use sgc_wire::NodeId;
use tokio::sync::watch;

/// Nodes that this one dialled, each by one of its tasks, and nodes that came by themselves. Clones share.
#[derive(Clone, Debug, Default)]
pub(crate) struct Claims {
    shared: Arc<Shared>,
}

#[derive(Debug, Default)]
struct Shared {
    table: Mutex<Table>,
    changed: watch::Sender<()>,
}

#[derive(Debug, Default)]
struct Table {
    dialled: BTreeSet<NodeId>,
    /// How many links each has here.
    came: BTreeMap<NodeId, usize>,
}

impl Claims {
    /// Takes a node that was dialled, unless another task has it.
    pub(crate) fn claim(&self, node: NodeId) -> Option<Claim> {
        let is_free = self.table().dialled.insert(node);
        is_free.then(|| Claim { node, claims: self.clone() })
    }

    /// Notes that a node came, until the result is dropped.
    pub(crate) fn note_arrival(&self, node: NodeId) -> Arrival {
        *self.table().came.entry(node).or_default() += 1;
        self.shared.changed.send_replace(());
        Arrival { node, claims: self.clone() }
    }

    /// True if a node came by itself and is here.
    pub(crate) fn has_come(&self, node: &NodeId) -> bool {
        self.table().came.contains_key(node)
    }

    /// Waits until there is no link to this node.
    pub(crate) async fn released(&self, node: &NodeId) {
        self.until(|table| !table.dialled.contains(node) && !table.came.contains_key(node)).await;
    }

    /// Waits until this node came by itself.
    pub(crate) async fn arrived(&self, node: &NodeId) {
        self.until(|table| table.came.contains_key(node)).await;
    }

    async fn until(&self, is_so: impl Fn(&Table) -> bool) {
        let mut changed = self.shared.changed.subscribe();
        while !is_so(&self.table()) {
            // Never an error: this holds the sender.
            let _ = changed.changed().await;
        }
    }

    fn table(&self) -> MutexGuard<'_, Table> {
        self.shared.table.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

/// The right to keep a link to a node; dropping it gives it back.
#[derive(Debug)]
pub(crate) struct Claim {
    node: NodeId,
    claims: Claims,
}

impl Claim {
    /// Whose it is.
    pub(crate) fn node(&self) -> NodeId {
        self.node
    }
}

impl Drop for Claim {
    fn drop(&mut self) {
        self.claims.table().dialled.remove(&self.node);
        self.claims.shared.changed.send_replace(());
    }
}

/// A link of a node that came.
#[derive(Debug)]
pub(crate) struct Arrival {
    node: NodeId,
    claims: Claims,
}

impl Drop for Arrival {
    fn drop(&mut self) {
        let mut table = self.claims.table();
        if let Some(links) = table.came.get_mut(&self.node) {
            *links -= 1;
            if *links == 0 {
                table.came.remove(&self.node);
            }
        }
        drop(table);
        self.claims.shared.changed.send_replace(());
    }
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]

    use std::time::Duration;

    use tokio::time::timeout;

    use super::*;

    #[tokio::test(start_paused = true)]
    async fn a_node_is_kept_by_one_and_then_free_for_the_next() {
        let (claims, node, other) = (Claims::default(), NodeId([1; 32]), NodeId([2; 32]));
        let first = claims.claim(node).unwrap();
        assert!(claims.claim(node).is_none());
        let second = claims.claim(other).unwrap();
        let soon = Duration::from_secs(1);
        assert!(timeout(soon, claims.released(&node)).await.is_err());
        let waiting = tokio::spawn({
            let claims = claims.clone();
            async move { claims.released(&node).await }
        });
        drop(second);
        tokio::task::yield_now().await;
        assert!(!waiting.is_finished());
        drop(first);
        timeout(soon, waiting).await.unwrap().unwrap();
        assert!(claims.claim(node).is_some());
    }

    #[tokio::test(start_paused = true)]
    async fn who_came_twice_is_here_until_both_links_are_gone() {
        let (claims, node) = (Claims::default(), NodeId([1; 32]));
        assert!(timeout(Duration::from_secs(1), claims.arrived(&node)).await.is_err());
        let (first, second) = (claims.note_arrival(node), claims.note_arrival(node));
        claims.arrived(&node).await;
        drop(first);
        assert!(claims.has_come(&node));
        drop(second);
        assert!(!claims.has_come(&node));
    }
}
