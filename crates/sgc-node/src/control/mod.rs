//! The control task: it owns the machines, and with them all that is decided once rather than for each packet.

pub mod alerts;
pub(crate) mod authority;
pub(crate) mod control_queue;
pub(crate) mod core;
pub(crate) mod event;
pub(crate) mod far_consumers;
pub(crate) mod file_watch;
pub(crate) mod interface_types;
pub(crate) mod local_graph;
pub(crate) mod members;
pub(crate) mod operations;
pub(crate) mod operators;
pub mod partners;
pub(crate) mod parts;
pub(crate) mod peer_policies;
pub(crate) mod peer_rate;
pub mod policy;
pub(crate) mod problem_log;
pub(crate) mod refusal_log;
pub(crate) mod refusals;
pub(crate) mod reload;
pub(crate) mod rules;
pub(crate) mod type_jobs;
