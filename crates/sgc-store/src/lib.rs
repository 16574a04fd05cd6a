//! The store of names that routers share: a client of Valkey and Redis, as a cluster or a single server.
//!
//! [`run`] carries out the operations of the router's mapping `store`. The servers are not trusted: whatever they send
//! costs bounded memory and time, and values are the router's to verify. [`check`] says whether a store fits.
//!
//! `resp` reads and writes the protocol, `cluster` is the machine that decides, and `link` and `driver` do the IO. The
//! crate knows nothing about names and their owners; `sgc-router` does.
#![forbid(unsafe_code)]

mod check;
mod cluster;
mod command;
mod config;
mod driver;
#[cfg(any(test, feature = "fuzzing"))]
mod fuzzing;
mod key;
mod link;
mod resp;
mod topology;

pub use config::{
    PORT_DEFAULT, PREFIX_BYTES_MAX, SERVERS_MAX, StoreConfig, StoreConfigError, StorePrefix,
    StorePrefixError, StoreServer, StoreServerError, StoreTls, StoreTlsError, StoreUser, StoreUserError,
};

pub use check::{Severity, StoreFinding, StoreReport, check};
pub use driver::run;
#[cfg(feature = "fuzzing")]
pub use fuzzing::{fuzz_replies, fuzz_servers};
