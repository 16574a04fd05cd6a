//! Networks of rmw_zenoh, ROS 2's middleware on Zenoh: [`ZenohNetwork`] implements [`sgc_ros::RosNetwork`].
//!
//! The protocol is that of `docs/spec/zenoh.md`, in bytes and text by [`sgc_zenoh`]. This crate opens a session of the
//! crate `zenoh`, declares publishers, subscribers, queryables and tokens on it, and hands over what comes. It decides
//! neither which topics are bridged nor what a message means.
#![forbid(unsafe_code)]

mod config;
mod discovery;
mod history;
mod intake;
mod late;
mod network;
mod participant;
mod reader;
mod requests;
mod service;
mod tokens;
mod writer;

use sgc_ros::RosError;

pub use config::{FindServiceHash, ROUTER_DEFAULT, ZenohConfig};
pub use network::ZenohNetwork;
pub use reader::ZenohReader;
pub use service::{ZenohClient, ZenohServer};
pub use writer::ZenohWriter;

/// Length of the encapsulation header in front of a payload, bytes (RTPS 2.5, 10.2).
const HEADER_BYTES: usize = 4;
/// Longest payload, bytes, as on DDS.
pub const PAYLOAD_BYTES_MAX: usize = 64 << 20;

/// Checks the length of a payload, which has a header and is not too long.
fn check_length(bytes: usize) -> Result<(), RosError> {
    if (HEADER_BYTES..=PAYLOAD_BYTES_MAX).contains(&bytes) {
        Ok(())
    } else {
        Err(RosError::Payload { bytes })
    }
}
