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
//! `machine.rs` has the machine's state, and the files below it the handlers. The other files have its parts, each with
//! private state.

mod backlog;
mod command;
mod local_graph;
mod machine;
mod naming;
mod own_sources;
mod owners;
mod problem;
mod readers;
mod rules;
mod service_ends;
mod share_route;
mod token_join;
mod use_route;
mod use_writers;

pub use command::Command;
pub use machine::{
    Consumers, OfferView, RouteKind, RouteState, RouteStatus, Routes, ShareRouteView, ShareView,
    UseRouteView, UseView,
};
pub use naming::{GLOBAL_TOPICS, LITERAL_TOPICS, Naming, Rename, is_for_wildcards, is_pattern, matches};
pub use own_sources::WRITERLESS_HOLD;
pub use owners::{OwnerState, REDISCOVERY_HOLD};
pub use problem::{LocalEnd, Offerer, Problem, Way};
pub use rules::{
    DeadManRule, Direction, ROUTES_PER_WILDCARD_MAX, Resume, Shaping, ShareRule, ShareRuleId, StopMessage,
    UseRule, UseRuleId,
};
pub use share_route::{ANNOUNCED_EVERY, AnnouncedPublishers, HEARD_MIN, SINKLESS_HOLD};
pub use use_route::UNREACHABLE_HOLD;
