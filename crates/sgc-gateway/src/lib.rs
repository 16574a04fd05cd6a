//! Programs without ROS on a ROS 2 network: what they may do, and what it takes to do it.
//!
//! A [`Hub`] is an ordinary node of the local ROS 2 network, which many clients share: it reads each topic once for all who
//! subscribe, knows the graph, and finds definitions. A [`Session`] is one client's part in it, which holds it to its
//! [`Scope`] and to bounds of its own. Protocols stand on sessions and on nothing below: [`rosbridge`], [`foxglove`],
//! [`grpc`].
//!
//! The hub knows of no other SGC node: what it writes is shared by the proxy beside it like what any program writes, by the
//! same rules. Sockets are opened by `server` alone, and the network behind [`LocalRos`] is for others to open.
#![forbid(unsafe_code)]

mod access;
mod access_watch;
mod action;
mod aside;
mod budget;
mod clock;
mod content;
mod door;
mod error;
mod feed;
pub mod foxglove;
mod graph;
pub mod grpc;
mod hub;
mod inflow;
mod message;
mod publisher;
mod queue;
mod quota;
mod ros;
pub mod rosbridge;
mod server;
mod service;
mod session;
mod tls;
mod types;
mod ws;

pub use access::{
    ACCESS_LABEL_BYTES_MAX, ACCESS_TOKEN_PREFIX, ACCESS_TOKEN_TEXT_BYTES_MAX, ACCESS_VALID_MS_MAX, Access,
    AccessGrant, AccessRules, AccessToken, AccessTokenError, Admission, AdmittedBy, Anonymous, Client,
    ClientRule, Denied, HearRefusals, ORIGIN_BYTES_MAX, PageOrigin, PageOriginError, Right, SCOPE_BYTES_MAX,
    SCOPE_PATTERNS_MAX, Scope, ScopeError, TokenId, TokenIdError, check_access_label,
};
pub use access_watch::AccessWatch;
pub use action::{
    ActionEvent, ActionReplier, ActionServing, CancelAnswer, Feedback, Goal, GoalId, GoalStatus, Outcome,
};
pub use clock::WallClock;
pub use content::{Content, Form};
pub use door::{ClientStatus, GatewayStatus};
pub use error::{ErrorKind, GatewayError};
pub use feed::{Delivery, Subscription};
pub use graph::{ActionInfo, EndpointInfo, Graph, NodeInfo, ServiceInfo, TopicInfo, is_hidden};
pub use hub::{Hub, HubOptions};
pub use message::Message;
pub use publisher::Publication;
pub use quota::Pool;
pub use ros::{LocalReader, LocalRos};
pub use server::{ListenAt, Protocol, Server, ServerError, ServerOptions};
pub use service::{Replier, Request, Serving};
pub use session::{Advertise, Session, SessionLimits, Subscribe};
pub use tls::{TlsError, certified_key};
pub use types::{FindDefinitions, InterfaceType, Shipped, Types};
