//! Bounds of invitations, and the mark of their certificates in a roster.

use std::time::Duration;

pub use sgc_wire::INVITATION_ROUTERS_MAX;
pub(crate) use sgc_wire::ROUTER_BYTES_MAX;

/// Longest time for which an invitation is valid.
pub const INVITATION_TIME_MAX: Duration = Duration::from_secs(7 * 86_400);

/// Beginning of the serial numbers of invitations, which 16 random bytes follow. Those of nodes' certificates have 16
/// bytes.
pub(crate) const INVITATION_SERIAL: [u8; 4] = *b")sgc";
