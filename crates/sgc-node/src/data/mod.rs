//! The data path: everything that a message passes between the local network and a link.

#[cfg(test)]
mod allocations;
pub(crate) mod assertions;
#[cfg(feature = "benchmarks")]
#[doc(hidden)]
pub mod benchmarks;
mod burst;
pub(crate) mod call_ledger;
pub(crate) mod calls;
pub(crate) mod conversion;
pub(crate) mod dataplane;
pub(crate) mod labels;
pub(crate) mod manual_lease;
pub(crate) mod message_keys;
pub(crate) mod outflow;
pub(crate) mod pending;
pub(crate) mod queue;
pub(crate) mod replays;
pub(crate) mod sinks;
pub(crate) mod sources;
pub(crate) mod spacing;
pub(crate) mod stats;
pub(crate) mod tap;
pub(crate) mod writer_queue;
