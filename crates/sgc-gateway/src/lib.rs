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
mod content;
mod error;
mod feed;
mod graph;
mod hub;
mod message;
mod publisher;
mod queue;
mod ros;
mod service;
mod session;
mod types;

pub mod foxglove;

pub use access::{Client, Right, Scope};
pub use content::{Content, Form};
pub use error::{ErrorKind, GatewayError};
pub use feed::{Delivery, Subscription};
pub use graph::{ActionInfo, EndpointInfo, Graph, NodeInfo, ServiceInfo, TopicInfo, is_hidden};
pub use hub::{Hub, HubOptions};
pub use message::Message;
pub use publisher::Publication;
pub use ros::{LocalReader, LocalRos};
pub use service::{Replier, Request, Serving};
pub use session::{Advertise, Session, SessionLimits, Subscribe};
pub use types::{FindDefinitions, InterfaceType, Shipped, Types};
