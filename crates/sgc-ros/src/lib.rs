//! The ROS 2 side of SGC, without any DDS: the local network's seam, QoS mapping and routes.
#![forbid(unsafe_code)]

mod network;

pub use network::{
    DiscoveredEndpoint, DiscoveryEvent, DiscoveryHandler, EndpointKind, EndpointSpec, Guid, RosError,
    RosNetwork, RosWriter, Sample, SampleHandler, SampleKind,
};
