//! Versions and limits of the framing, which errors name.

use sgc_wire::{HEADER_BYTES_MAX, PAYLOAD_BYTES_MAX};

/// Version of the link protocol, in the greeting.
pub const LINK_VERSION: u16 = 1;
/// Version of the framing of a flow, its first byte.
pub const FLOW_VERSION: u8 = 1;
/// Longest control frame, bytes.
pub const CONTROL_FRAME_BYTES_MAX: usize = 1 << 20;
/// Longest packet of a flow, bytes.
pub const FLOW_PACKET_BYTES_MAX: usize = HEADER_BYTES_MAX + PAYLOAD_BYTES_MAX;
