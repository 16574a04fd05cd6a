//! The local ROS 2 network as a whole: joining it, joining it again, and what keeps others from being seen in it.

pub(crate) mod dds_discovery;
pub mod discovery_server;
#[cfg(any(feature = "zenoh", test))]
pub(crate) mod joined;
pub(crate) mod middleware;
pub(crate) mod network_slot;
pub(crate) mod network_state;
pub(crate) mod rediscovery;
pub(crate) mod reopening;
pub(crate) mod strangers;
pub(crate) mod zenoh;
