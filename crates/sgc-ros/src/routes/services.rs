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
use crate::names::{ServiceTopic, dds_type, ros_topic, ros_type};
use crate::network::{DiscoveredEndpoint, EndpointKind, EndpointSpec, ServiceSpec};
use crate::qos::service_qos;

/// The prefix that ROS 2 reserves for services as a whole ("Topic and Service name mapping to DDS").
const SERVICE_PREFIX: &str = "rs";

/// Returns the kind and name of the interface that an endpoint provides.
pub(super) fn interface(topic: &str) -> Option<(Kind, &str)> {
    let service = topic.strip_prefix(SERVICE_PREFIX).filter(|service| service.starts_with('/'));
    service.map(|service| (Kind::Service, service)).or_else(|| Some((Kind::Topic, ros_topic(topic)?)))
}

/// Returns the spec of both topics of a service.
pub(super) fn service_spec(local_name: &str, type_name: &str, type_hash: Option<&str>) -> ServiceSpec {
    let half = |half: ServiceTopic, type_hash: Option<&str>| EndpointSpec {
        topic: half.dds_topic(local_name),
        type_name: half.dds_type(type_name),
        keyless: true,
        asks_key_hash: false,
        type_hash: type_hash.map(str::to_owned),
        qos: service_qos(),
    };
    ServiceSpec { request: half(ServiceTopic::Request, type_hash), reply: half(ServiceTopic::Reply, None) }
}

impl<R: RngCore> Routes<R> {
    /// Returns `true` if a name that is shared or used here belongs to a service.
    pub fn is_service(&self, name: &Name) -> bool {
        let shared = self.shares.get(name).map(|share| self.share_rules[share.rule].is_service());
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
            if let Some(server) = server(request) {
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
        for server in requests.skip(left).filter_map(server).collect::<Vec<_>>() {
            self.writer_gone(now, &server);
        }
    }

    /// Updates the local client of a shared service to match its callers.
    pub(super) fn refresh_client(&mut self, name: Name) {
        let Some(share) = self.shares.get_mut(&name) else { return };
        let wanted = !share.sinks.is_empty() || share.sinkless_until.is_some();
        if !share.sinks.is_empty() {
            share.sinkless_until = None;
        }
        let hash = share.writers.values().find_map(|w| w.type_hash.as_deref());
        let spec = wanted.then(|| service_spec(&share.local_name, &ros_type(&share.type_name), hash));
        if share.client.is_some() == spec.is_some() {
            return;
        }
        self.commands.push_back(match &spec {
            Some(spec) => Command::OpenClient { name, spec: spec.clone() },
            None => Command::CloseClient { name },
        });
        share.client = spec;
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

/// Returns the endpoint that represents a server in a share route, from its request reader.
fn server(request: &DiscoveredEndpoint) -> Option<DiscoveredEndpoint> {
    let (_, name, type_name) = ServiceTopic::parse(&request.topic, &request.type_name)?;
    Some(DiscoveredEndpoint {
        kind: EndpointKind::Writer,
        topic: format!("{SERVICE_PREFIX}{name}"),
        type_name: dds_type(&type_name),
        qos: service_qos(),
        ..request.clone()
    })
}
