//! [`NetworkSlot`]: the local network of a node, which may join it long after its start, and open it again.

use std::sync::{Arc, Mutex, MutexGuard, PoisonError};

use sgc_ros::RosError;

/// Opens a network as the present one was opened; may block.
pub(crate) type OpenAgain<N> = Arc<dyn Fn() -> Result<Arc<N>, RosError> + Send + Sync>;

/// The local network, once the node has joined one.
pub(crate) struct NetworkSlot<N>(Arc<Mutex<Place<N>>>);

struct Place<N> {
    network: Option<Arc<N>>,
    again: Option<OpenAgain<N>>,
}

impl<N> Clone for NetworkSlot<N> {
    fn clone(&self) -> Self {
        Self(self.0.clone())
    }
}

impl<N> NetworkSlot<N> {
    /// A slot with a network, and how to open it again, as far as there is either.
    pub(crate) fn new(network: Option<Arc<N>>, again: Option<OpenAgain<N>>) -> Self {
        Self(Arc::new(Mutex::new(Place { network, again })))
    }

    pub(crate) fn get(&self) -> Option<Arc<N>> {
        self.lock().network.clone()
    }

    pub(crate) fn put(&self, network: Arc<N>) {
        self.lock().network = Some(network);
    }

    /// Returns how the network is opened again.
    pub(crate) fn again(&self) -> Option<OpenAgain<N>> {
        self.lock().again.clone()
    }

    pub(crate) fn set_again(&self, again: OpenAgain<N>) {
        self.lock().again = Some(again);
    }

    /// Returns the network, so that it ends with its last holder.
    pub(crate) fn take(&self) -> Option<Arc<N>> {
        self.lock().network.take()
    }

    fn lock(&self) -> MutexGuard<'_, Place<N>> {
        self.0.lock().unwrap_or_else(PoisonError::into_inner)
    }
}
