//! The parts of the control task's state. Each owns its fields and returns values or effects, and [`super::core`] carries
//! them out: no part knows the machines, another part, or the local network.

pub(crate) mod forward_table;
pub(crate) mod link_table;
pub(crate) mod publishers;
pub(crate) mod shares;
mod sink_timers;
pub(crate) mod sinks;
