//! The driver of SGC: the one place where machines, sockets, the local ROS 2 network, files and clocks meet.
//!
//! It decides nothing that a machine can decide. [`config`] reads a [`config::Config`] from its file, and [`run`] runs
//! it. One control task owns the machines (`core`). The data path (`dataplane`) runs beside it, on the
//! receiving tasks and threads.
#![forbid(unsafe_code)]

pub mod admin;
mod clock;
pub mod config;
mod control;
mod data;
mod discovery;
mod drops;
mod gateway;
mod link;
mod local;
mod metrics;
mod node;
mod state;

pub use admin::{graph, shell};
pub use control::faults::alerts;
pub use control::fleet::partners;
pub use control::settings::policy;
#[cfg(feature = "benchmarks")]
#[doc(hidden)]
pub use data::benchmarks;
pub use local::discovery_server;
pub use state::audit;

pub use admin::status::{LinkStatus, NameStatus, RouteLine, RouterLine, Status};
pub use admin::{SocketError, default_socket_path, find_socket, has_hidden_services, usual_sockets};
pub use control::fleet::members::{UnknownMember, unknown_members};
pub use control::fleet::operations::OperationError;
pub use control::fleet::operators::{roster_head, roster_row};
pub use control::settings::reload::{ConfigSource, ReloadReport};
pub use control::settings::rules::{RulesError, read_stop, read_token};
pub use data::stats::DataDrop;
pub use discovery::RouterStatus;
pub use drops::NodeDrop;
pub use gateway::access::{
    ACCESS_TOKENS_MAX, AccessError, AccessRecord, AccessRecords, access_of, access_with,
};
pub use gateway::certificate::{
    GatewayCertificate, GatewayCertificateError, gateway_expiry_warning, gateway_urls,
};
pub use gateway::{GatewayStartError, OpenLocalRos};
pub use link::push_crl::{PushCrlError, push_crl};
pub use link::store::{StoreSettingsError, load_store};
pub use metrics::push::PushStatus;
pub use metrics::series::{METRICS, Metric, MetricKind};
pub use node::{
    NodeError, OpenNetwork, RunOptions, Watchdog, admin_socket_path, check_identity, enclave_of,
    expiry_warning, load_identity, run, run_on, run_opening,
};
pub use state::fleet_file::{FleetFileError, LockedFleet, read_fleet};
pub use state::run_lock::IdentityInUse;
pub use state::{StateError, check_state_dir, create_state_dir, state_bases, state_dir, storage_fault};
