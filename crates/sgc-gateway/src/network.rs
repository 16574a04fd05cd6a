//! [`Network`]: the gateway's end of the local network, its graph and the counts of its clients.
//!
//! Feeds, publications, services and callers use it. The hub above it has them.

use std::sync::{Arc, Mutex, MutexGuard};

use sgc_ros::{DiscoveredEndpoint, GraphNode, Guid, RosError};
use sgc_sync::lock;
use sgc_wire::RosNode;
use tokio::runtime::Handle;
use tokio::sync::{Notify, Semaphore, watch};

use crate::definitions::Types;
use crate::error::GatewayError;
use crate::graph::{Graph, GraphState};
use crate::quota::Quotas;
use crate::ros::LocalRos;

/// Most writers that wait for acknowledgements at their end at a time.
const FAREWELLS_MAX: usize = 32;

/// The local network as all clients share it.
pub(crate) struct Network {
    pub(crate) ros: Arc<dyn LocalRos>,
    pub(crate) types: Types,
    pub(crate) runtime: Handle,
    node: Option<RosNode>,
    node_name: String,
    state: Mutex<GraphState>,
    changed: watch::Sender<u64>,
    unused: Notify,
    /// The counts of all clients, and the threads on which calls and writes may wait.
    pub(crate) quotas: Arc<Quotas>,
    /// Permits for writers that wait for acknowledgements before they end.
    pub(crate) farewells: Arc<Semaphore>,
}

impl Network {
    /// Creates the end of a network that has not been joined yet, for a node of this name.
    pub(crate) fn new(ros: Arc<dyn LocalRos>, types: Types, node_name: &str) -> Self {
        let node = RosNode::new("/", node_name, None);
        let node_name = node.as_ref().map_or_else(|| format!("/{node_name}"), ToString::to_string);
        Self {
            ros,
            types,
            runtime: Handle::current(),
            node,
            node_name,
            state: Mutex::default(),
            changed: watch::Sender::new(0),
            unused: Notify::new(),
            quotas: Arc::default(),
            farewells: Arc::new(Semaphore::new(FAREWELLS_MAX)),
        }
    }

    /// Joins the network.
    ///
    /// # Errors
    /// The error of discovery.
    pub(crate) async fn join(self: &Arc<Self>) -> Result<(), GatewayError> {
        let weak = Arc::downgrade(self);
        self.blocking(move |network| {
            network.ros.discover(Box::new(move |event| {
                if let Some(network) = weak.upgrade() {
                    network.state().handle(event);
                    network.tell();
                }
            }))?;
            network.announce();
            Ok(())
        })
        .await
    }

    /// Returns the full name of the gateway's node.
    pub(crate) fn node_name(&self) -> &str {
        &self.node_name
    }

    /// Returns a receiver that is marked as changed whenever the graph changes.
    pub(crate) fn changes(&self) -> watch::Receiver<u64> {
        self.changed.subscribe()
    }

    /// Waits until a reader may be unused.
    pub(crate) async fn unused(&self) {
        self.unused.notified().await;
    }

    fn state(&self) -> MutexGuard<'_, GraphState> {
        lock(&self.state)
    }

    pub(crate) fn graph(&self) -> Arc<Graph> {
        self.state().graph(&self.node_name)
    }

    pub(crate) fn is_there(&self, guid: &Guid) -> bool {
        self.state().is_there(guid)
    }

    fn tell(&self) {
        self.changed.send_modify(|version| *version += 1);
    }

    /// Adds an endpoint of the gateway to the graph.
    pub(crate) fn know(&self, endpoint: DiscoveredEndpoint) {
        self.state().add_own(endpoint);
        self.tell();
    }

    /// Removes endpoints of the gateway from the graph.
    pub(crate) fn forget(&self, guids: &[Guid]) {
        guids.iter().for_each(|guid| self.state().remove_own(guid));
        self.tell();
    }

    /// Announces the gateway's node in the ROS graph. May block.
    pub(crate) fn announce(&self) {
        let Some(node) = self.node.clone() else { return };
        let (readers, writers) = self.state().own();
        if let Err(error) = self.ros.announce(&[GraphNode { node, readers, writers }]) {
            tracing::debug!(%error, "the gateway's node could not be announced");
        }
    }

    /// Schedules a search for unused readers.
    pub(crate) fn sweep(&self) {
        self.unused.notify_one();
    }

    /// Runs blocking work on a thread where it may block.
    pub(crate) async fn blocking<T: Send + 'static>(
        self: &Arc<Self>,
        work: impl FnOnce(&Arc<Self>) -> Result<T, RosError> + Send + 'static,
    ) -> Result<T, GatewayError> {
        self.run(move |shared| work(shared).map_err(GatewayError::Ros)).await
    }

    /// Runs blocking work that may fail in other ways than ROS errors.
    pub(crate) async fn run<T: Send + 'static>(
        self: &Arc<Self>,
        work: impl FnOnce(&Arc<Self>) -> Result<T, GatewayError> + Send + 'static,
    ) -> Result<T, GatewayError> {
        let shared = Arc::clone(self);
        let done = self.runtime.spawn_blocking(move || work(&shared)).await;
        done.unwrap_or(Err(GatewayError::Stopping))
    }
}
