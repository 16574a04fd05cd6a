//! The endpoints of services on the local network, as routes see them.

use sgc_wire::Kind;

use crate::names::{ServiceTopic, dds_type, ros_topic};
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

/// Returns the endpoint that represents a server in a share route, from its request reader.
pub(super) fn server_of(request: &DiscoveredEndpoint) -> Option<DiscoveredEndpoint> {
    let (_, name, type_name) = ServiceTopic::parse(&request.topic, &request.type_name)?;
    Some(DiscoveredEndpoint {
        kind: EndpointKind::Writer,
        topic: format!("{SERVICE_PREFIX}{name}"),
        type_name: dds_type(&type_name),
        qos: service_qos(),
        ..request.clone()
    })
}
