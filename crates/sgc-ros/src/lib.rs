//! The ROS 2 side of SGC without DDS: the interface to the local network, names, QoS mapping and routes.
//!
//! [`Routes`] is a pure machine that decides which endpoints exist on the local network. [`RosNetwork`] is the
//! interface that a DDS implementation provides (`sgc-dds`). Only the CDR of tf messages is looked into
//! ([`prefix_frames`]).
#![forbid(unsafe_code)]

mod frames;
pub mod graph;
mod interface;
mod names;
mod network;
mod qos;
mod routes;

pub use frames::{FrameError, TF_MESSAGE, prefix_frames};
pub use interface::{Interface, Part};
pub use names::{
    ENCLAVE_BYTES_MAX, ServiceTopic, TOPIC_BYTES_MAX, dds_topic, dds_type, is_enclave, is_topic_name,
    ros_topic, ros_type,
};
pub use network::{
    DiscoveredEndpoint, DiscoveryEvent, DiscoveryHandler, EndpointKind, EndpointSpec, GraphNode, Guid,
    HandleCalls, HandleSamples, KeyHash, Reach, RequestHandler, RequestId, RosClient, RosError, RosNetwork,
    RosServer, RosWriter, Sample, SampleHandler, SampleHead, SampleKind, SentRequest, ServiceSpec,
    SharedSamples, ShownEndpoint, UnhandledCall,
};
pub use qos::{
    KEYED_INSTANCES_KEPT, KEYED_SAMPLES_MAX, QosMismatch, QosOverride, QosPolicy, RELIABLE_READER_DEPTH_MIN,
    SERVICE_DEPTH, UNACKNOWLEDGED_MIN, for_all_instances, mismatches, reader_for, service_qos, weakest,
};
pub use routes::{
    ANNOUNCED_EVERY, AnnouncedPublishers, Command, Consumers, DeadManRule, Direction, GLOBAL_TOPICS,
    HEARD_MIN, LITERAL_TOPICS, LocalEnd, Naming, OfferView, Offerer, OwnerState, Problem, REDISCOVERY_HOLD,
    ROUTES_PER_WILDCARD_MAX, Rename, Resume, RouteKind, RouteState, RouteStatus, Routes, SINKLESS_HOLD,
    Shaping, ShareRouteView, ShareRule, ShareRuleId, ShareView, StopMessage, UNREACHABLE_HOLD, UseRouteView,
    UseRule, UseRuleId, UseView, WRITERLESS_HOLD, Way, is_for_wildcards, is_pattern, matches,
};
