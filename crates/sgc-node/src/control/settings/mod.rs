//! The configuration in force: its rules and policies, and their replacement by a reload.

pub(crate) mod file_watch;
pub mod policy;
pub(crate) mod reload;
pub(crate) mod rules;
