//! Services: their differences from topics. They use the same two kinds of routes.
//!
//! In place of writers a service has servers, each with a request reader and a reply writer of one participant. A
//! share route sees a server as one endpoint, its reader, on the reserved topic `rs/…`. Where others publish on a
//! topic, they call a service: the share's route then has a local client, the use's a local server.

use std::time::Instant;

use rand_core::RngCore;
use sgc_wire::{Kind, Name};

use super::command::Command;
use super::machine::Routes;
use super::service_ends::{interface, server_of, service_spec};
use crate::names::ServiceTopic;
use crate::network::{DiscoveredEndpoint, EndpointKind};

impl<R: RngCore> Routes<R> {
    /// Returns `true` if a name that is shared or used here belongs to a service.
    pub fn is_service(&self, name: &Name) -> bool {
        let shared = self.shares.get(name).map(|share| self.share_rules[share.rule()].is_service());
        let used = || self.uses.get(name).map(|route| self.use_rules[route.rule].is_service());
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

    /// Updates the local server of a called service to match its catalogue entry.
    pub(super) fn refresh_server(&mut self, name: Name) {
        let Some(route) = self.uses.get_mut(&name).filter(|u| u.granted) else { return };
        let rule = &self.use_rules[route.rule];
        if !rule.is_service() {
            return;
        }
        let metadata = &route.entry.metadata;
        let hash = route.entry.type_hash.as_deref();
        let spec = service_spec(&rule.local_name(metadata), &metadata.type_name, hash);
        if route.server.as_ref() == Some(&spec) {
            return self.name_writers(name);
        }
        if route.server.is_some() {
            self.commands.push_back(Command::CloseServer { name });
        }
        self.commands.push_back(Command::OpenServer { name, spec: spec.clone() });
        route.server = Some(spec);
        route.nodes.clear();
        self.name_writers(name);
    }
}
