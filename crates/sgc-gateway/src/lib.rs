//! Access to a ROS 2 network for programs without ROS.
//!
//! A [`Hub`] is an ordinary node of the local ROS 2 network that many clients share. It reads each topic once for all
//! subscribers, follows the graph and finds definitions. A [`Session`] is one client's use of the hub, bounded by a
//! [`Scope`] and limits. The protocols `rosbridge`, `foxglove` and `grpc` build on sessions only; each has a cargo
//! feature of its name.
//!
//! The hub knows no other SGC node: the proxy beside it shares its publications by the same rules as those of any
//! program. Only the module `server` opens sockets, and other crates open the network behind [`LocalRos`].
#![forbid(unsafe_code)]
#![cfg_attr(
    not(all(feature = "foxglove", feature = "grpc", feature = "rosbridge")),
    allow(dead_code, reason = "sessions offer all that the protocols need together")
)]

mod access;
mod access_watch;
mod action;
mod admission;
mod budget;
mod clock;
mod content;
mod definitions;
mod error;
mod feed;
#[cfg(feature = "foxglove")]
pub mod foxglove;
mod graph;
#[cfg(feature = "grpc")]
pub mod grpc;
mod hub;
mod inflow;
#[cfg(feature = "_websocket")]
mod keep_alive;
mod limits;
mod message;
mod network;
mod offload;
mod pool;
mod publisher;
mod queue;
mod quota;
mod refusal;
mod ros;
#[cfg(feature = "rosbridge")]
pub mod rosbridge;
mod server;
mod service;
mod session;
mod tls;
#[cfg(feature = "_websocket")]
mod ws;

pub use access::{
    ACCESS_LABEL_BYTES_MAX, ACCESS_TOKEN_PREFIX, ACCESS_TOKEN_TEXT_BYTES_MAX, ACCESS_VALID_MS_MAX, Access,
    AccessGrant, AccessRules, AccessToken, AccessTokenError, AdmissionRequest, AdmittedBy, Anonymous, Client,
    ClientRule, Denial, ORIGIN_BYTES_MAX, PageOrigin, PageOriginError, RefusalListener, Right,
    SCOPE_BYTES_MAX, SCOPE_PATTERNS_MAX, Scope, ScopeError, TokenId, TokenIdError, check_access_label,
};
pub use access_watch::AccessWatch;
pub use action::{
    ActionEvent, ActionReplier, ActionServing, CancelAnswer, Feedback, Goal, GoalId, GoalStatus, Outcome,
};
pub use admission::{ClientStatus, GatewayStatus, ShownCertificate};
pub use clock::WallClock;
pub use content::{Content, Form};
pub use definitions::{FindDefinitions, InterfaceType, ShippedDefinitions, Types};
pub use error::{ErrorKind, GatewayError};
pub use feed::{Delivery, Subscription};
pub use graph::{ActionInfo, EndpointInfo, Graph, NodeInfo, ServiceInfo, TopicInfo, is_hidden};
pub use hub::{Hub, HubOptions};
pub use limits::SessionLimits;
pub use message::Message;
pub use pool::Pool;
pub use publisher::Publication;
pub use refusal::ClientRefusal;
pub use ros::{LocalReader, LocalRos};
pub use server::{ListenAt, NotListening, Protocol, ProtocolNotBuilt, Server, ServerError, ServerOptions};
pub use service::{Replier, Request, Serving};
pub use session::{Advertise, Session, Subscribe};
pub use tls::{NODE_SERVER_NAME, TlsError, TlsKeys, certified_key};
