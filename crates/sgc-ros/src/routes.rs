//! The route machine: decides which local topics are shared, which remote topics are brought here, and which
//! endpoints the local network needs for that.
//!
//! The machine is pure. Discovery, the endpoint's events and the time go in. [`Command`]s come out, which the driver
//! carries out on its endpoint and its local network.
//!
//! A *share route* is one shared topic with one type. It exists from the first local writer of that type until the
//! last one has been gone for a while. A *use route* is one entry of a followed owner's catalogue that a rule asks
//! for. It exists while the catalogue lists the entry. A *token route* is a use route whose entry comes with the
//! grant, from an owner of another fleet whose catalogue this node cannot read.
//!
//! `machine.rs` has the machine's state; this file only lists its parts.

mod backlog;
mod checks;
mod command;
mod consumers;
mod graph;
mod local_graph;
mod machine;
mod naming;
mod own_sources;
mod owners;
mod problem;
mod publish;
mod readers;
mod reconfigure;
mod rules;
mod selection;
mod service_ends;
mod services;
mod settling;
mod share_route;
mod shares;
mod status;
mod tokens;
mod use_route;
mod uses;
mod view;

pub use command::Command;
pub use consumers::Consumers;
pub use machine::Routes;
pub use naming::{GLOBAL_TOPICS, LITERAL_TOPICS, Naming, Rename, is_for_wildcards, is_pattern, matches};
pub use own_sources::WRITERLESS_HOLD;
pub use owners::{OwnerState, REDISCOVERY_HOLD};
pub use problem::{LocalEnd, Offerer, Problem, Way};
pub use rules::{Direction, ROUTES_PER_WILDCARD_MAX, Shaping, ShareRule, ShareRuleId, UseRule, UseRuleId};
pub use share_route::SINKLESS_HOLD;
pub use status::{RouteKind, RouteState, RouteStatus};
pub use use_route::UNREACHABLE_HOLD;
pub use view::{OfferView, ShareRouteView, ShareView, UseRouteView, UseView};
