//! The store of names that routers share: a client of Valkey and Redis, as a cluster or a single server.
//!
//! [`run`] carries out the operations of the router's mapping `store`. The servers are not trusted: whatever they send
//! costs bounded memory and time, and values are the router's to verify. [`check`] says whether a store fits.
//!
//! `resp` reads and writes the protocol, `cluster` is the machine that decides, and `link` and `driver` do the IO. The
//! crate knows nothing about names and their owners; `sgc-router` does.
#![forbid(unsafe_code)]

mod cluster;
mod command;
mod config;
mod driver;
mod key;
mod link;
mod resp;
mod topology;

pub use config::{
    PORT_DEFAULT, PREFIX_BYTES_MAX, SERVERS_MAX, StoreConfig, StoreConfigError, StorePrefix,
    StorePrefixError, StoreServer, StoreServerError, StoreTls, StoreTlsError, StoreUser, StoreUserError,
};

pub use driver::run;

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
