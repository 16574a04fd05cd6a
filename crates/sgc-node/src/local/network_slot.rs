//! [`NetworkSlot`]: the local network of a node, which may be joined after the start and reopened.

use std::sync::{Arc, Mutex, MutexGuard};

use sgc_config::RosConfig;
use sgc_ros::RosError;
use sgc_sync::lock;
use sgc_trust::Identity;

/// Opens a network with the settings of the present one. May block.
pub(crate) type OpenAgain<N> = Arc<dyn Fn() -> Result<Arc<N>, RosError> + Send + Sync>;

/// Joins the local network of a configuration with an identity; blocks.
pub(crate) type JoinNetwork = Arc<dyn Fn(&RosConfig, &Identity) -> Result<(), String> + Send + Sync>;

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
    /// Creates a slot with a network and a function that reopens it, if they exist.
    pub(crate) fn new(network: Option<Arc<N>>, again: Option<OpenAgain<N>>) -> Self {
        Self(Arc::new(Mutex::new(Place { network, again })))
    }

    pub(crate) fn get(&self) -> Option<Arc<N>> {
        self.lock().network.clone()
    }

    pub(crate) fn put(&self, network: Arc<N>) {
        self.lock().network = Some(network);
    }

    /// Returns the function that reopens the network.
    pub(crate) fn again(&self) -> Option<OpenAgain<N>> {
        self.lock().again.clone()
    }

    pub(crate) fn set_again(&self, again: OpenAgain<N>) {
        self.lock().again = Some(again);
    }

    /// Removes and returns the network, so that it closes with its last owner.
    pub(crate) fn take(&self) -> Option<Arc<N>> {
        self.lock().network.take()
    }

    fn lock(&self) -> MutexGuard<'_, Place<N>> {
        lock(&self.0)
    }
}
