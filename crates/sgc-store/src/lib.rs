//! The store of names that routers share: a client of Valkey and Redis, as a cluster or a single server.
#![forbid(unsafe_code)]

mod config;

use sgc_router::{StoreEvent, StoreFailure, StoreOp};
use tokio::sync::mpsc;

pub use config::{
    PORT_DEFAULT, PREFIX_BYTES_MAX, SERVERS_MAX, StoreConfig, StoreConfigError, StorePrefix,
    StorePrefixError, StoreServer, StoreServerError, StoreTls, StoreTlsError, StoreUser, StoreUserError,
};

/// Carries operations out until `ops` is closed.
pub async fn run(_config: StoreConfig, mut ops: mpsc::Receiver<StoreOp>, events: mpsc::Sender<StoreEvent>) {
    while let Some(op) = ops.recv().await {
        let reply = StoreEvent::Reply { id: op.id, result: Err(StoreFailure::Unreachable) };
        if events.send(reply).await.is_err() {
            return;
        }
    }
}

/// Says whether a store fits.
pub async fn check(_config: StoreConfig) -> StoreReport {
    StoreReport { findings: Vec::new() }
}

/// The findings about a store.
#[derive(Clone, Debug)]
pub struct StoreReport {
    /// The findings, the gravest first.
    pub findings: Vec<StoreFinding>,
}

/// Severity of a finding.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub enum Severity {
    /// The store does not work, or loses names, until this is fixed.
    Error,
    /// The store works, with a risk.
    Warning,
    /// Fits.
    Ok,
}

/// A finding; `Display` is its text.
#[derive(Clone, Debug, PartialEq)]
#[non_exhaustive]
pub enum StoreFinding {}

impl StoreFinding {
    /// Returns the severity.
    pub fn severity(&self) -> Severity {
        match *self {}
    }

    /// Returns the step that mends it, if it needs one.
    pub fn fix(&self) -> Option<String> {
        match *self {}
    }
}

impl std::fmt::Display for StoreFinding {
    fn fmt(&self, _: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        match *self {}
    }
}
