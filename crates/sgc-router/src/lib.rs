//! The routing machine of SGC: where names are, and which branches their data takes.
//!
//! A pure machine. The driver calls `handle_*` with what happened and the time, and after each call drains
//! [`Router::poll_output`] until it says [`Output::Timeout`]; that is the contract. The machine knows links by
//! number, never by address; it sees no payload and holds no key but the one that its node signs with. The data path
//! reads [`FibEntry`]s and never calls the machine. The normative text is `docs/spec/routing.md`.
//!
//! Every node has one, proxies too: a proxy is a router that carries nobody else's names, with its own
//! endpoint behind [`LinkId::LOCAL`].
#![forbid(unsafe_code)]

mod fib;
mod limits;
mod links;
mod lists;
mod mapping;
mod memory;
mod names;
mod router;
mod shares;
mod spf;
mod tell;
mod topology;
mod tree;
mod trust;

pub use fib::{FibEntry, Tree};
pub use limits::Limits;
pub use links::Neighbour;
pub use mapping::MappingKind;
pub use router::{
    DropReason, LinkClose, LinkId, Output, Router, RouterConfig, RouterDrop, RouterStats, clocks_differ,
};
pub use topology::RouteStats;
