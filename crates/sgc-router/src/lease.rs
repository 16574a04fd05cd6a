//! The times in which signed bodies count.

use std::time::{Duration, Instant};

use sgc_trust::{CLOCK_SKEW_MAX, CertError, SignedError, VerifiedPeer};
use sgc_wire::{Now, UnixMillis};

/// Longest time of a frame to a neighbour, plus the usual difference of honest nodes' clocks.
const UNDER_WAY_MAX: Duration = Duration::from_secs(10);

/// Returns `true` if neighbours will still believe a body with this time of signing. A lease counts from an
/// announcement's arrival, so a late replay outlasts the time in which it verifies.
pub(crate) fn verifies_elsewhere(now: Now, issued_at: UnixMillis) -> bool {
    let age = now.unix.0.saturating_sub(issued_at.0);
    Duration::from_millis(age) + UNDER_WAY_MAX <= CLOCK_SKEW_MAX
}

/// Returns the end of a signed body: its lease, but not beyond `lease_max` or its signer's certificate.
pub(crate) fn lease_end(
    now: Now,
    lease_ms: u32,
    lease_max: Duration,
    signer: &VerifiedPeer,
) -> Result<Instant, SignedError> {
    let not_after = signer.not_after;
    // Certificates are judged by the second, so one may verify although no time of it is left.
    let left = not_after.0.checked_sub(now.unix.0).filter(|left| *left > 0);
    let left = left.ok_or(CertError::Expired { not_after, now: now.unix })?;
    let lease = Duration::from_millis(lease_ms.into()).min(lease_max);
    Ok(now.instant + lease.min(Duration::from_millis(left)))
}
