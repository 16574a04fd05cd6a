//! [`NetworkSlot`]: the local network of a node, which may join it long after its start.

use std::sync::{Arc, Mutex, MutexGuard, PoisonError};

/// The local network, once the node has joined one.
pub(crate) struct NetworkSlot<N>(Arc<Mutex<Option<Arc<N>>>>);

impl<N> Clone for NetworkSlot<N> {
    fn clone(&self) -> Self {
        Self(self.0.clone())
    }
}

impl<N> NetworkSlot<N> {
    pub(crate) fn new(network: Option<Arc<N>>) -> Self {
        Self(Arc::new(Mutex::new(network)))
    }

    pub(crate) fn get(&self) -> Option<Arc<N>> {
        self.lock().clone()
    }

    pub(crate) fn put(&self, network: Arc<N>) {
        *self.lock() = Some(network);
    }

    /// Returns the network, so that it ends with its last holder.
    pub(crate) fn take(&self) -> Option<Arc<N>> {
        self.lock().take()
    }

    fn lock(&self) -> MutexGuard<'_, Option<Arc<N>>> {
        self.0.lock().unwrap_or_else(PoisonError::into_inner)
    }
}
