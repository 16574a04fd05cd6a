//! Consumers: local subscribers, publishers and service clients of interfaces that others own, and the endpoints that
//! represent remote consumers.

use std::collections::BTreeMap;

use rand_core::RngCore;
use sgc_wire::{CONSUMERS_MAX, CONSUMERS_PER_INTERFACE_MAX, Consumer, Kind, Name, NodeId, Qos, Role};

use super::Routes;
use crate::names::{ServiceTopic, dds_topic, dds_type};
use crate::network::{EndpointKind, EndpointSpec};
use crate::routes::rules::Direction;
use crate::routes::use_route::UseRoute;

/// Local consumers of interfaces that others own.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct Consumers {
    /// The consumers by the owner of the interface.
    pub by_owner: BTreeMap<NodeId, Vec<Consumer>>,
    /// The number of consumers beyond [`CONSUMERS_PER_INTERFACE_MAX`] of an interface and [`CONSUMERS_MAX`] of an
    /// owner.
    pub left_out: u64,
}

/// The kind of endpoint that consumers of an interface have.
struct ConsumingEnd {
    kind: EndpointKind,
    type_name: String,
    interface: Name,
    owner: NodeId,
}

impl<R: RngCore> Routes<R> {
    /// Returns `true` if consumers may have changed since the last call.
    pub fn take_consumers_changed(&mut self) -> bool {
        std::mem::take(&mut self.consumers_changed)
    }

    /// Returns the local subscribers, publishers and service clients that belong to a ROS 2 node and use granted
    /// interfaces.
    pub fn consumers(&self) -> Consumers {
        let mut used = BTreeMap::<String, Vec<ConsumingEnd>>::new();
        for (name, route) in &self.uses {
            if let Some((kind, topic, type_name)) = self.consuming_end(route) {
                let owner = self.use_rules[route.rule()].owner;
                used.entry(topic).or_default().push(ConsumingEnd {
                    kind,
                    type_name,
                    interface: *name,
                    owner,
                });
            }
        }
        let mut consumers = Consumers::default();
        if used.is_empty() {
            return consumers;
        }
        let mut of_interface = BTreeMap::<Name, usize>::new();
        for endpoint in self.local.endpoints() {
            let (Some(ends), Some(node)) = (used.get(&endpoint.topic), self.node_of(&endpoint.guid)) else {
                continue;
            };
            let fits =
                |end: &&ConsumingEnd| (end.kind, &end.type_name) == (endpoint.kind, &endpoint.type_name);
            for ConsumingEnd { interface, owner, .. } in ends.iter().filter(fits) {
                let of_owner = consumers.by_owner.entry(*owner).or_default();
                let known = of_interface.entry(*interface).or_default();
                if *known >= CONSUMERS_PER_INTERFACE_MAX || of_owner.len() >= CONSUMERS_MAX {
                    consumers.left_out += 1;
                    continue;
                }
                *known += 1;
                of_owner.push(Consumer {
                    interface: *interface,
                    id: self.secret.publisher_tag(&endpoint.guid.0),
                    role: match endpoint.kind {
                        EndpointKind::Reader => Role::Subscribe,
                        EndpointKind::Writer => Role::Publish,
                    },
                    is_alive: self.local.is_alive(&endpoint.guid),
                    node: node.clone(),
                    type_hash: endpoint.type_hash.clone(),
                    qos: Qos { partitions: Vec::new(), ..endpoint.qos.clone() },
                });
            }
        }
        consumers
    }

    /// Returns kind, topic and type of the endpoints by which programs consume a used interface.
    fn consuming_end(&self, route: &UseRoute) -> Option<(EndpointKind, String, String)> {
        if !route.is_up() {
            return None;
        }
        let (rule, type_name) = (&self.use_rules[route.rule()], &route.entry().metadata.type_name);
        let request = ServiceTopic::Request;
        match (rule.kind, rule.direction) {
            (Kind::Service, _) => Some((
                EndpointKind::Writer,
                request.dds_topic(route.local_name()),
                request.dds_type(type_name),
            )),
            (_, direction) => {
                let kind = match direction {
                    Direction::Bring => EndpointKind::Reader,
                    Direction::Publish => EndpointKind::Writer,
                };
                Some((kind, dds_topic(route.local_name()), dds_type(type_name)))
            }
        }
    }

    /// Returns the endpoints that represent a remote consumer of a share in the local graph: a reader, a writer, or
    /// both ends of a service client. The list is empty without such a share, or without the writer for messages of
    /// others.
    pub fn consumer_ends(&self, consumer: &Consumer) -> Vec<(EndpointKind, EndpointSpec)> {
        let share = self.shares.get(&consumer.interface);
        share.map_or_else(Vec::new, |share| share.consumer_ends(&self.share_rules[share.rule()], consumer))
    }
}
