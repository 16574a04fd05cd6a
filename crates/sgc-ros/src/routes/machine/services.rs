//! Services: their differences from topics. They use the same two kinds of routes.
//!
//! In place of writers a service has servers, each with a request reader and a reply writer of one participant. A
//! share route sees a server as one endpoint, its reader, on the reserved topic `rs/…`. Where others publish on a
//! topic, they call a service: the share's route then has a local client, the use's a local server.

use std::time::Instant;

use rand_core::RngCore;
use sgc_wire::{Kind, Name};

use super::Routes;
use crate::names::ServiceTopic;
use crate::network::{DiscoveredEndpoint, EndpointKind};
use crate::routes::service_ends::{interface, server_of};

impl<R: RngCore> Routes<R> {
    /// Returns `true` if a name that is shared or used here belongs to a service.
    pub fn is_service(&self, name: &Name) -> bool {
        let shared = self.shares.get(name).map(|share| self.share_rules[share.rule()].is_service());
        let used = || self.uses.get(name).map(|route| self.use_rules[route.rule()].is_service());
        shared.or_else(used).unwrap_or(false)
    }

    /// Handles a new endpoint of a service, which may complete a server. Returns `false` for an endpoint of a topic.
    pub(super) fn service_end_there(&mut self, endpoint: &DiscoveredEndpoint) -> bool {
        let Some((half, name, _)) = ServiceTopic::parse(&endpoint.topic, &endpoint.type_name) else {
            // A topic with the reserved prefix must not pass for a server.
            return matches!(interface(&endpoint.topic), Some((Kind::Service, _)));
        };
        let other = match (half, endpoint.kind) {
            (ServiceTopic::Request, EndpointKind::Reader) => (ServiceTopic::Reply, EndpointKind::Writer),
            (ServiceTopic::Reply, EndpointKind::Writer) => (ServiceTopic::Request, EndpointKind::Reader),
            // The endpoint belongs to a client.
            _ => return true,
        };
        let topic = other.0.dds_topic(name);
        let fits = |e: &&DiscoveredEndpoint| {
            (e.guid.prefix(), e.kind, &e.topic) == (endpoint.guid.prefix(), other.1, &topic)
        };
        let others: Vec<_> = self.local.endpoints().filter(fits).cloned().collect();
        for other in others {
            let request = if half == ServiceTopic::Request { endpoint } else { &other };
            if let Some(server) = server_of(request) {
                self.writer_there(server);
            }
        }
        true
    }

    /// Handles the end of an endpoint, which may have been part of a server.
    pub(super) fn service_end_gone(&mut self, now: Instant, endpoint: &DiscoveredEndpoint) {
        let Some((half, name, _)) = ServiceTopic::parse(&endpoint.topic, &endpoint.type_name) else { return };
        if half == ServiceTopic::Request {
            return self
                .writer_gone(now, &DiscoveredEndpoint { kind: EndpointKind::Writer, ..endpoint.clone() });
        }
        if endpoint.kind == EndpointKind::Reader {
            return;
        }
        // A participant has as many servers of a service as it has reply writers.
        let (prefix, topic) = (endpoint.guid.prefix(), ServiceTopic::Request.dds_topic(name));
        let of_it = |e: &&DiscoveredEndpoint| e.guid.prefix() == prefix;
        let left = self
            .local
            .endpoints()
            .filter(of_it)
            .filter(|e| e.kind == EndpointKind::Writer && e.topic == endpoint.topic)
            .count();
        let requests = self
            .local
            .endpoints()
            .filter(of_it)
            .filter(|e| e.kind == EndpointKind::Reader && e.topic == topic);
        for server in requests.skip(left).filter_map(server_of).collect::<Vec<_>>() {
            self.writer_gone(now, &server);
        }
    }
}
