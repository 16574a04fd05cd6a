//! Surroundings of a process of SGC: standard streams, files of secrets, signals, randomness, ROS domains.
//!
//! The command line and the libraries behind it share them. This crate parses no arguments and starts no node; `sgc`
//! does.

pub mod children;
pub mod domains;
mod error;
pub mod files;
pub mod output;
mod signals;
pub mod style;
mod system;

pub use error::ProcessError;
pub use signals::{EXIT_FAILURE, EndSignals, ORPHAN_GRACE, exit_after_grace, listen, stdin_closed};
pub use system::{system_rng, unix_now};
