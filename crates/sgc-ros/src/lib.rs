//! The ROS 2 side of SGC, without any DDS: the local network's seam, names, QoS mapping and routes.
//!
//! [`Routes`] is a pure machine that decides what has to exist on the local network; [`RosNetwork`] is the seam
//! behind which a DDS implementation provides it (`sgc-dds`). No CDR is looked into.
#![forbid(unsafe_code)]

mod names;
mod network;
mod qos;
mod routes;

pub use names::{dds_topic, dds_type, ros_topic, ros_type};
pub use network::{
    DiscoveredEndpoint, DiscoveryEvent, DiscoveryHandler, EndpointKind, EndpointSpec, Guid, RosError,
    RosNetwork, RosWriter, Sample, SampleHandler, SampleKind,
};
pub use qos::{RELIABLE_READER_DEPTH_MIN, reader_for, weakest};
pub use routes::{
    Command, Direction, Problem, RouteStatus, Routes, SINKLESS_HOLD, ShareRule, UNREACHABLE_HOLD, UseRule,
    WRITERLESS_HOLD,
};
