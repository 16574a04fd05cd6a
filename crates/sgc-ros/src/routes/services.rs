//! Services: what is different from topics. They go through the same two kinds of routes.
//!
//! Where a topic has writers a service has servers: a request reader and a reply writer of one participant. What a
//! share route is told of them is one endpoint for both, the reader's, on the topic `rs/…`, which no other has. Where
//! others publish on a topic they call a service: a share's route has a local client then, a use's a local server.

use std::time::Instant;

use rand_core::RngCore;
use sgc_wire::{Kind, Name};

use super::{Command, Routes};
use crate::names::{ServiceTopic, dds_type, ros_topic, ros_type};
use crate::network::{DiscoveredEndpoint, EndpointKind, EndpointSpec, ServiceSpec};
use crate::qos::service_qos;

/// What the ROS 2 design reserves for services as a whole ("Topic and Service name mapping to DDS").
const SERVICE_PREFIX: &str = "rs";

/// The kind of interface that an endpoint provides, and its name.
pub(super) fn interface(topic: &str) -> Option<(Kind, &str)> {
    let service = topic.strip_prefix(SERVICE_PREFIX).filter(|service| service.starts_with('/'));
    service.map(|service| (Kind::Service, service)).or_else(|| Some((Kind::Topic, ros_topic(topic)?)))
}

/// Both topics of a service.
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
    /// Whether a name that is shared or used here is that of a service.
    pub fn is_service(&self, name: &Name) -> bool {
        let shared = self.shares.get(name).map(|share| self.share_rules[share.rule].is_service());
        let used = || self.uses.get(name).map(|route| self.use_rules[route.rule].is_service());
        shared.or_else(used).unwrap_or(false)
    }

    /// One end of a service, of a server or a client; false if it is of a topic. It may make a server whole.
    pub(super) fn service_end_there(&mut self, endpoint: &DiscoveredEndpoint) -> bool {
        let Some((half, name, _)) = ServiceTopic::of(&endpoint.topic, &endpoint.type_name) else {
            // Nobody else is to pass for a server.
            return matches!(interface(&endpoint.topic), Some((Kind::Service, _)));
        };
        let other = match (half, endpoint.kind) {
            (ServiceTopic::Request, EndpointKind::Reader) => (ServiceTopic::Reply, EndpointKind::Writer),
            (ServiceTopic::Reply, EndpointKind::Writer) => (ServiceTopic::Request, EndpointKind::Reader),
            // A client's.
            _ => return true,
        };
        let topic = other.0.dds_topic(name);
        let fits = |e: &&DiscoveredEndpoint| {
            (e.guid.prefix(), e.kind, &e.topic) == (endpoint.guid.prefix(), other.1, &topic)
        };
        let others: Vec<_> = self.endpoints.values().filter(fits).cloned().collect();
        for other in others {
            let request = if half == ServiceTopic::Request { endpoint } else { &other };
            if let Some(server) = server(request) {
                self.writer_there(server);
            }
        }
        true
    }

    /// What is gone may have been one end of a server, which is none without it.
    pub(super) fn service_end_gone(&mut self, now: Instant, endpoint: &DiscoveredEndpoint) {
        let Some((half, name, _)) = ServiceTopic::of(&endpoint.topic, &endpoint.type_name) else { return };
        if half == ServiceTopic::Request {
            return self
                .writer_gone(now, &DiscoveredEndpoint { kind: EndpointKind::Writer, ..endpoint.clone() });
        }
        if endpoint.kind == EndpointKind::Reader {
            return;
        }
        // As many servers of a service as the participant has reply writers left.
        let (prefix, topic) = (endpoint.guid.prefix(), ServiceTopic::Request.dds_topic(name));
        let of_it = |e: &&DiscoveredEndpoint| e.guid.prefix() == prefix;
        let left = self
            .endpoints
            .values()
            .filter(of_it)
            .filter(|e| e.kind == EndpointKind::Writer && e.topic == endpoint.topic)
            .count();
        let requests = self
            .endpoints
            .values()
            .filter(of_it)
            .filter(|e| e.kind == EndpointKind::Reader && e.topic == topic);
        for server in requests.skip(left).filter_map(server).collect::<Vec<_>>() {
            self.writer_gone(now, &server);
        }
    }

    /// Brings the local client of a shared service in line with who may call it.
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

    /// Brings the local server of a service that is called in line with its catalogue entry.
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

/// A server as a share route is told of it, by its request reader.
fn server(request: &DiscoveredEndpoint) -> Option<DiscoveredEndpoint> {
    let (_, name, type_name) = ServiceTopic::of(&request.topic, &request.type_name)?;
    Some(DiscoveredEndpoint {
        kind: EndpointKind::Writer,
        topic: format!("{SERVICE_PREFIX}{name}"),
        type_name: dds_type(&type_name),
        qos: service_qos(),
        ..request.clone()
    })
}
