//! The routing machine of SGC: where names are, and which branches their data takes.
//!
//! A pure machine. The driver calls `handle_*` with what happened and the time, and after each call drains
//! [`Router::poll_output`] until it says [`Output::Timeout`]; that is the contract. The machine knows links by
//! number, never by address; it sees no payload and holds no key but the one that its node signs with. The data path
//! reads [`FibEntry`]s and never calls the machine. The normative text is `docs/spec/routing.md`.
//!
//! [`Router`] is a composition. `Links` has the neighbours and the costs of links, `Topology` the network behind them,
//! `Names` the owners of names and the nodes to tell, `Trees` the branches. Each part keeps its state to itself and
//! verifies nothing. The router verifies an event, asks the parts, and passes the effects of one on to the next. No
//! file imports one that imports it.
//!
//! Every node has one, proxies too: a proxy is a router that carries nobody else's names, with its own
//! endpoint behind [`LinkId::LOCAL`].
#![forbid(unsafe_code)]

mod config;
mod context;
mod drops;
mod fib;
mod lease;
mod limits;
mod link_id;
mod links;
mod mapping;
mod memory;
mod names;
mod network;
mod output;
mod router;
mod shares;
mod store;
mod topology;
mod trees;

pub use config::RouterConfig;
pub use drops::{DropReason, RouterDrop};
pub use fib::{FibEntry, Tree};
pub use limits::Limits;
pub use link_id::LinkId;
pub use links::{DirectReach, LinkQuality, Neighbour, PathKind, clocks_differ};
pub use mapping::MappingKind;
pub use output::{LinkClose, Output};
pub use router::{Router, RouterStats};
pub use store::{
    BATCH_TAG_LEN, BatchTag, STORE_VALUE_BYTES_MAX, StoreAction, StoreEvent, StoreFailure, StoreKey, StoreOp,
    StoreOpId, StoreReply, StoreStats, WriteIf,
};
pub use topology::{Path, RouteStats, ShortestPaths};
