//! The data path: everything that a message passes between the local network and a link.

#[cfg(test)]
mod allocations;
#[cfg(feature = "benchmarks")]
#[doc(hidden)]
pub mod benchmarks;
mod burst;
pub(crate) mod call_ledger;
pub(crate) mod calls;
pub(crate) mod conversion;
pub(crate) mod dataplane;
pub(crate) mod dead_man;
pub(crate) mod labels;
pub(crate) mod outflow;
pub(crate) mod pending;
pub(crate) mod queue;
pub(crate) mod sending;
pub(crate) mod sinks;
pub(crate) mod source_clocks;
pub(crate) mod spacing;
pub(crate) mod stats;
pub(crate) mod tap;
pub(crate) mod writer_queue;
