//! The clocks of the node. Machines take the time as an argument.

use std::time::{Instant, SystemTime, UNIX_EPOCH};

use sgc_wire::{Now, UnixMillis};

/// Returns the current time of both clocks.
pub(crate) fn now() -> Now {
    let unix = SystemTime::now().duration_since(UNIX_EPOCH).unwrap_or_default();
    Now { instant: Instant::now(), unix: UnixMillis(unix.as_millis().try_into().unwrap_or(u64::MAX)) }
}

/// Returns the time of the runtime, which tests can stop.
pub(crate) fn time_now() -> Instant {
    tokio::time::Instant::now().into_std()
}

/// Returns the wall-clock time that publishers stamp samples with, nanoseconds since the Unix epoch.
pub(crate) fn unix_ns() -> i64 {
    let unix = SystemTime::now().duration_since(UNIX_EPOCH).unwrap_or_default();
    unix.as_nanos().try_into().unwrap_or(i64::MAX)
}
