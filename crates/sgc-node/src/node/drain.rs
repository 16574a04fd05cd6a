//! Ends a node: nothing more is taken in, queues drain, then the tasks end.

use std::time::Duration;

use sgc_ros::RosNetwork;
use sgc_transport::{CloseReason, Link};
use tokio::sync::{mpsc, oneshot};
use tokio::task::JoinHandle;
use tokio::time::timeout;
use tracing::{info, warn};

use crate::control::event::CoreEvent;
use crate::link::port_mapping::REMOVAL_MAX;
use crate::node::spawn::RunningNode;
use crate::state::audit::{AuditEvent, AuditRecord};

/// Time for queues to drain at shutdown.
const DRAIN_MAX: Duration = Duration::from_secs(2);
/// Time for peers to answer a goodbye.
const GOODBYE_MAX: Duration = Duration::from_secs(1);

impl<N: RosNetwork> RunningNode<N> {
    /// Withdraws the node's names, drains its queues and ends its tasks.
    pub(super) async fn drain(mut self) {
        if let Some(local) = self.reloader.searches.local() {
            local.say_goodbye().await;
        }
        self.gateway.stop().await;
        empty_queues(&self.events).await;
        say_goodbye(&self.events).await;
        self.reloader.searches.stop();
        self.tasks.iter().for_each(JoinHandle::abort);
        // A successor may own the socket by the time it is removed.
        self.socket.abort();
        let _ = self.socket.await;
        for (task, stop) in self.accepting {
            let _ = stop.send(());
            let _ = task.await;
        }
        // If both are the same dialer, the second call does nothing.
        tokio::join!(self.dialer.close(CloseReason::Goodbye), self.lane_dialer.close(CloseReason::Goodbye));
        let _ = self.core.await;
        if let Some(mapping) = &mut self.mapping
            && timeout(REMOVAL_MAX, &mut *mapping).await.is_err()
        {
            mapping.abort();
            info!("the gateway did not answer in time; the port mapping ends by itself");
        }
        drop(self.reloader);
        if timeout(DRAIN_MAX, self.all_ended.recv()).await.is_err() {
            warn!("the local network did not take everything in time");
        }
        self.audit.write(AuditRecord::new(AuditEvent::Stopped));
        let writer = self.audit_writer;
        let _ = tokio::task::spawn_blocking(move || writer.finish()).await;
        // Closing ends discovery and waits for its threads. The runtime waits for the rest.
        if let Some(network) = self.network.take() {
            let _ = tokio::task::spawn_blocking(move || drop(network)).await;
        }
        drop(self.run_lock);
    }
}

/// Stops receiving, and waits until the queued packets have left.
async fn empty_queues(events: &mpsc::Sender<CoreEvent>) {
    let (reply, flows) = oneshot::channel();
    let _ = events.send(CoreEvent::Quiesce(reply)).await;
    let flows = flows.await.unwrap_or_default();
    let emptied = async {
        for flow in flows {
            flow.ended().await;
        }
    };
    if timeout(DRAIN_MAX, emptied).await.is_err() {
        warn!("some peers did not take everything in time");
    }
}

/// Withdraws the names and ends the control task. A peer closes the link after the goodbye, which shows that it has
/// received everything before.
async fn say_goodbye(events: &mpsc::Sender<CoreEvent>) {
    let (reply, links) = oneshot::channel();
    let _ = events.send(CoreEvent::Stop(reply)).await;
    let links = links.await.unwrap_or_default();
    let closed = async {
        for link in links {
            link.closed().await;
        }
    };
    let _ = timeout(GOODBYE_MAX, closed).await;
}
