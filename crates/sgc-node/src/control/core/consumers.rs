//! Consumers across nodes: local subscribers, publishers and service clients are announced to the owners of what they
//! use, and far ones that use our shares are shown on the local network.
//!
//! One reader takes the messages of a shared topic, however many far subscribers there are. Each of them is shown by an
//! endpoint that nothing matches ([`RosNetwork::show`]). One writer writes the messages of all far publishers. It is
//! shown as the first of them, and each other one by an endpoint that nothing matches.

use std::collections::BTreeMap;
use std::time::Duration;

use sgc_endpoint::LostReason;
use sgc_ros::{EndpointKind, EndpointSpec, RosError, RosNetwork, ShownEndpoint, UNREACHABLE_HOLD};
use sgc_wire::{Consumer, NodeId, Now};
use tracing::{debug, info};

use super::{Core, drop_elsewhere};
use crate::control::event::{ConsumerKey, CoreEvent};
use crate::control::graph::far_consumers::{AskChanges, MadeEndpoints, ShowChanges};
use crate::drops::NodeDrop;

impl<N: RosNetwork> Core<N> {
    /// Schedules an announcement, since local consumers may have changed.
    pub(super) fn note_consumers(&mut self) {
        if self.routes.as_mut().is_some_and(|routes| routes.take_consumers_changed()) {
            self.consumers.tell_soon();
        }
    }

    /// Handles a node's announcement of its consumers.
    pub(super) fn consumers_told(&mut self, now: Now, peer: NodeId, consumers: Vec<Consumer>) {
        self.consumers.peer_told(now.instant, peer, consumers);
    }

    /// Handles that a node no longer announces its consumers. They go at once if it withdrew them, or after a while if
    /// it is out of reach.
    pub(super) fn consumers_lost(&mut self, now: Now, peer: NodeId, reason: LostReason) {
        let hold = match reason {
            LostReason::Withdrawn | LostReason::Refused(_) => Duration::ZERO,
            LostReason::Unreachable | LostReason::Cut(_) => UNREACHABLE_HOLD,
        };
        self.consumers.peer_lost(peer, now.instant + hold);
    }

    pub(super) fn consumers_due(&mut self, now: Now) {
        if self.consumers.take_tell_due(now.instant)
            && let Some(routes) = &self.routes
        {
            let consumers = routes.consumers();
            let more = self.consumers.more_untold(consumers.left_out);
            self.count_left_out(NodeDrop::ConsumersUntold, more);
            self.endpoint.set_consumers(now, consumers.by_owner);
        }
        if self.consumers.take_changes(now.instant) {
            self.ask_consumers(now);
            if let Some(routes) = &mut self.routes {
                routes.handle_announced(now.instant, self.consumers.publishers());
            }
            self.show_consumers();
        }
    }

    /// Asks the granted nodes for their consumers, and no others.
    fn ask_consumers(&mut self, now: Now) {
        let has_graph = self.network.get().is_some_and(|network| network.has_graph());
        let AskChanges { leave, ask } = self.consumers.ask(has_graph, self.certificates.identity().node_id());
        for peer in leave {
            self.endpoint.leave_consumers(now, &peer);
        }
        for peer in ask {
            self.endpoint.ask_consumers(now, peer);
        }
    }

    /// Shows the far consumers on the local network.
    fn show_consumers(&mut self) {
        let (Some(routes), Some(network)) = (&self.routes, self.network.get()) else { return };
        let (wanted, left_out) = self.consumers.wanted();
        let mut publishers = BTreeMap::new();
        let mut wanted: BTreeMap<_, _> = wanted
            .into_iter()
            .map(|(key, consumer)| (key, (consumer.node.clone(), routes.consumer_ends(consumer))))
            .filter(|(_, (_, ends))| !ends.is_empty())
            .collect();
        // A service client has two endpoints.
        wanted.retain(|key, (node, ends)| {
            let is_writer = ends.iter().all(|(kind, _)| *kind == EndpointKind::Writer);
            let is_first = is_writer && !publishers.contains_key(&key.interface);
            if is_first {
                publishers.insert(key.interface, (key.peer, node.clone()));
            }
            !is_first
        });
        self.graph.set_publishers(publishers);
        let more = self.consumers.more_unshown(left_out);
        self.count_left_out(NodeDrop::ConsumersUnshown, more);
        let ShowChanges { gone, moved, fresh } = self.consumers.show(wanted);
        for (key, endpoints) in gone {
            self.graph.consumer_gone(&key);
            if let Some(endpoints) = endpoints {
                drop_elsewhere(Box::new(endpoints));
            }
        }
        for (key, node, ids) in moved {
            self.graph.consumer_there(key, node, &ids);
        }
        let Some(events) = self.events.upgrade().filter(|_| !fresh.is_empty()) else { return };
        let (network, alive, failures) = (network.clone(), self.alive.clone(), self.ros_failures.clone());
        // The endpoints are created one after the other: each takes a lock of the local network, and others need
        // blocking threads, too.
        tokio::task::spawn_blocking(move || {
            let _alive = alive;
            for (key, ends) in fresh {
                let made = ends.into_iter().map(|(kind, spec)| {
                    let endpoint = network.show(kind, &spec)?;
                    Ok((kind, spec, endpoint))
                });
                let ends = match made.collect::<Result<_, RosError>>() {
                    Ok(ends) => ends,
                    Err(error @ RosError::ForbiddenPartition { .. }) => {
                        if failures.count(NodeDrop::ConsumersForbidden) {
                            info!("far programs are not shown in the local graph: {error}");
                        }
                        continue;
                    }
                    Err(error) => {
                        failures.count(NodeDrop::ShowConsumer);
                        debug!(%error, "the local graph does not show a far subscriber or client");
                        continue;
                    }
                };
                if events.blocking_send(CoreEvent::ConsumerShown { key, ends }).is_err() {
                    return;
                }
            }
        });
    }

    /// Handles new endpoints of a consumer, which may have changed meanwhile.
    pub(super) fn consumer_shown(
        &mut self,
        key: ConsumerKey,
        made: Vec<(EndpointKind, EndpointSpec, ShownEndpoint)>,
    ) {
        let (ends, endpoints): (Vec<_>, Vec<_>) =
            made.into_iter().map(|(kind, spec, endpoint)| ((kind, spec), (kind, endpoint))).unzip();
        match self.consumers.made(&key, &ends, endpoints) {
            MadeEndpoints::Shown(node, ids) => self.graph.consumer_there(key, node, &ids),
            MadeEndpoints::Unwanted(endpoints) => drop_elsewhere(Box::new(endpoints)),
        }
    }

    /// Counts more consumers without room.
    fn count_left_out(&self, kind: NodeDrop, more: u64) {
        if more > 0 {
            self.control_drops.add(kind, more);
        }
    }

    /// Removes all shown consumers.
    pub(super) fn end_consumers(&mut self) {
        drop_elsewhere(Box::new(std::mem::take(&mut self.consumers).take_shown()));
    }
}
