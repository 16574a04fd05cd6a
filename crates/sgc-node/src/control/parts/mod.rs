//! The parts of the control task's state. Each owns its fields and returns values or effects, which [`super::core`] carries
//! out: no part reaches into the machines, another part, or the local network.

pub(crate) mod certificates;
pub(crate) mod forward_table;
pub(crate) mod link_table;
pub(crate) mod network_ends;
pub(crate) mod publishers;
pub(crate) mod services;
pub(crate) mod shares;
mod sink_timers;
pub(crate) mod sinks;
