//! The protocol of rmw_zenoh, ROS 2's middleware on Zenoh, as bytes and text.
//!
//! Keys of topics and services ([`TopicInfo`]), the liveliness tokens from which programs learn the ROS graph
//! ([`Token`]) with the QoS in them, the attachments of messages ([`Attachment`]), the ids of endpoints ([`Gid`]) and of
//! Zenoh sessions ([`ZenohId`]). What is written is what rmw_zenoh writes; what is read may be sloppier, but everything
//! is bounded, and each refusal is a [`CodecError`]. The normative text is `docs/spec/zenoh.md`.
//!
//! Nothing here opens a Zenoh session, sends or receives. Payloads stay as they are: CDR behind its encapsulation header.
#![forbid(unsafe_code)]

mod attachment;
mod error;
mod gid;
mod graph;
mod id;
mod qos;
mod text;
mod token;
mod topic;

pub use attachment::{ATTACHMENT_BYTES, Attachment};
pub use error::{CodecError, Field};
pub use gid::Gid;
pub use graph::{
    ENDPOINT_ID_MAX, ENDPOINT_TOKENS_MAX, EndpointRef, Graph, GraphError, SESSION_TOKENS_MAX, TOKENS_MAX,
    participant, unassigned_node,
};
pub use id::{SGC_MARK, ZenohId};
pub use qos::{DEPTH_DEFAULT, DEPTH_MAX, decode_qos, encode_qos};
pub use token::{BACKENDS_BYTES_MAX, BACKENDS_CPU, EntityKind, TOKEN_BYTES_MAX, Token, TokenEndpoint};
pub use topic::{KEY_BYTES_MAX, TYPE_BYTES_MAX, TopicInfo};
