//! Links: connections to other nodes, from the first dial to the last frame.

pub(crate) mod control_tx;
pub(crate) mod direct;
pub(crate) mod direct_address;
pub(crate) mod in_use;
pub(crate) mod inflow;
pub(crate) mod lanes;
pub(crate) mod links;
pub(crate) mod mapping_report;
pub(crate) mod port_mapping;
pub(crate) mod push_crl;
pub(crate) mod renewal;
pub(crate) mod roaming;
pub(crate) mod store;
mod upnp;
