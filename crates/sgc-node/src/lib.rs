//! The driver of SGC: the one place where machines, sockets, the local ROS 2 network, files and clocks meet.
//!
//! It decides nothing that a machine can decide. [`config`] turns the user's input into a [`config::Config`], and
//! [`run`] runs it. One control task owns the machines (`core`). The data path (`dataplane`) runs beside it, on the
//! receiving tasks and threads.
#![forbid(unsafe_code)]

mod access;
pub mod admin;
pub mod alerts;
#[cfg(test)]
mod allocations;
mod assertions;
pub mod audit;
mod authority;
#[cfg(feature = "benchmarks")]
#[doc(hidden)]
pub mod benchmarks;
mod call_ledger;
mod calls;
pub mod config;
mod control_queue;
mod conversion;
mod core;
mod credentials;
mod dataplane;
mod discovery;
pub mod discovery_server;
mod file_watch;
mod fleet_file;
mod gateway;
pub mod graph;
mod keep_alive;
mod labels;
mod lanes;
mod links;
mod members;
mod message_keys;
mod network_slot;
mod node;
mod operations;
mod operators;
mod outflow;
pub mod partners;
mod peer_rate;
mod pending;
pub mod policy;
mod problem_log;
mod push_crl;
mod queue;
mod records;
mod rediscovery;
mod refusal_log;
mod reload;
mod reopening;
mod replays;
mod roaming;
mod rules;
mod run_lock;
mod shaper;
pub mod shell;
mod sinks;
mod sources;
mod spacing;
mod state;
mod stats;
mod status;
mod strangers;
mod tap;
mod type_questions;

pub use access::{ACCESS_TOKENS_MAX, AccessError, AccessRecord, AccessRecords, access_of, access_with};
pub use admin::{SocketError, default_socket_path};
pub use discovery::RouterStatus;
pub use fleet_file::{FleetFileError, LockedFleet, read_fleet};
pub use gateway::{GatewayStartError, OpenLocalRos};
pub use members::{UnknownMember, unknown_members};
pub use node::{
    NodeError, OpenNetwork, RunOptions, admin_socket_path, check_identity, load_identity, run, run_on,
    run_opening,
};
pub use operations::OperationError;
pub use operators::{roster_head, roster_row};
pub use push_crl::{PushCrlError, push_crl};
pub use reload::{ConfigSource, ReloadReport};
pub use rules::{RulesError, read_token};
pub use run_lock::IdentityInUse;
pub use state::{StateError, check_state_dir, create_state_dir, state_dir};
pub use status::{LinkStatus, NameStatus, RouteLine, RouterLine, Status};
