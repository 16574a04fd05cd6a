//! Bounds of invitations, also for the errors of fleets.

use std::time::Duration;

/// Most routers that one invitation names.
pub const INVITATION_ROUTERS_MAX: usize = 8;
/// Longest URL of a router in an invitation, bytes.
pub(crate) const ROUTER_BYTES_MAX: usize = 300;
/// Longest time for which an invitation is valid.
pub const INVITATION_TIME_MAX: Duration = Duration::from_secs(7 * 86_400);
