//! The parts of the control task's state.
//!
//! Each part owns its fields. It returns values, and effects on the machines, on other parts and on the local network,
//! which [`super::core`] carries out. The rest a part does itself, without blocking:
//!
//! - [`link_table`] queues frames, probes peers, starts the senders of packets, and closes links.
//! - [`certificates`] has the identity and the revocation lists saved, and passes credentials to links, to the gateway
//!   and to dialling tasks.
//! - [`direct_links`] sends checks, and has peers dialled.
//! - [`publishers`] creates signing keys.
//! - [`shares`] and [`services`] send on other threads: announcements of silent sources, and questions and notices
//!   about calls.
//! - [`sinks`] closes the queues of writers, which ends the writers, and drops keys of past epochs.
//!
//! [`forward_table`], [`network_ends`], [`newcomers`] and [`wishes`] only keep entries.

pub(crate) mod certificates;
pub(crate) mod closings;
pub(crate) mod direct_links;
pub(crate) mod forward_table;
pub(crate) mod link_table;
pub(crate) mod network_ends;
pub(crate) mod newcomers;
pub(crate) mod publishers;
pub(crate) mod services;
pub(crate) mod shares;
mod sink_timers;
pub(crate) mod sinks;
pub(crate) mod wishes;
