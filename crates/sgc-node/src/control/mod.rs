//! The control task: it owns the machines, and with them all that is decided once rather than for each packet.

pub(crate) mod core;
pub(crate) mod event;
pub(crate) mod faults;
pub(crate) mod fleet;
pub(crate) mod graph;
pub(crate) mod parts;
pub(crate) mod peers;
pub(crate) mod settings;
pub(crate) mod types;
