//! Claims of tasks on nodes, and waiting for their end. [`ClaimTable`] holds them.

use std::sync::{Arc, Mutex, MutexGuard};

use sgc_session::ClaimTable;
use sgc_sync::lock;
use sgc_wire::NodeId;
use tokio::sync::watch;

/// Nodes that this node dialled, each claimed by one task, and nodes that dialled this one. Clones share the state.
#[derive(Clone, Debug, Default)]
pub(crate) struct Claims {
    shared: Arc<ClaimsInner>,
}

#[derive(Debug, Default)]
struct ClaimsInner {
    table: Mutex<ClaimTable>,
    changed: watch::Sender<()>,
}

impl Claims {
    /// Claims a dialled node, unless another task has claimed it.
    pub(crate) fn claim(&self, node: NodeId) -> Option<Claim> {
        let is_free = self.table().claim(node);
        is_free.then(|| Claim { node, claims: self.clone() })
    }

    /// Notes an incoming link of a node until the result is dropped.
    pub(crate) fn note_arrival(&self, node: NodeId) -> Arrival {
        self.table().arrives(node);
        self.shared.changed.send_replace(());
        Arrival { node, claims: self.clone() }
    }

    /// Returns `true` if a node has an incoming link here.
    pub(crate) fn has_come(&self, node: &NodeId) -> bool {
        self.table().has_come(node)
    }

    /// Waits until no link to this node is left.
    pub(crate) async fn released(&self, node: &NodeId) {
        self.until(|table| table.is_free(node)).await;
    }

    /// Waits for an incoming link of this node.
    pub(crate) async fn arrived(&self, node: &NodeId) {
        self.until(|table| table.has_come(node)).await;
    }

    async fn until(&self, is_so: impl Fn(&ClaimTable) -> bool) {
        let mut changed = self.shared.changed.subscribe();
        while !is_so(&self.table()) {
            // This cannot fail, since `self` holds the sender.
            let _ = changed.changed().await;
        }
    }

    fn table(&self) -> MutexGuard<'_, ClaimTable> {
        lock(&self.shared.table)
    }
}

/// The right of one task to keep a link to a node. Dropping it releases the node.
#[derive(Debug)]
pub(crate) struct Claim {
    node: NodeId,
    claims: Claims,
}

impl Claim {
    /// Returns the claimed node.
    pub(crate) fn node(&self) -> NodeId {
        self.node
    }
}

impl Drop for Claim {
    fn drop(&mut self) {
        self.claims.table().release(&self.node);
        self.claims.shared.changed.send_replace(());
    }
}

/// An incoming link of a node.
#[derive(Debug)]
pub(crate) struct Arrival {
    node: NodeId,
    claims: Claims,
}

impl Drop for Arrival {
    fn drop(&mut self) {
        self.claims.table().leaves(&self.node);
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
    async fn node_with_two_links_counts_as_present_until_both_end() {
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
