//! A wall clock that may be set while a program runs.

use std::time::Duration;

use crate::ids::{Now, UnixMillis};

/// Least move of the wall clock against the monotonic one that counts as a new setting.
const STEP_MIN: Duration = Duration::from_secs(60);

/// Notices that the wall clock was set: by NTP some time after the start, by a user, or while the machine slept.
#[derive(Clone, Copy, Debug)]
pub struct ClockWatch {
    base: Now,
}

impl ClockWatch {
    /// Starts to watch.
    pub fn new(now: Now) -> Self {
        Self { base: now }
    }

    /// Returns `true` if the wall clock was set by a minute or more since the last time that this returned `true`.
    pub fn was_set(&mut self, now: Now) -> bool {
        let set =
            now.unix.0.abs_diff(wall_after(self.base.unix, self.base, now).0) >= STEP_MIN.as_millis() as u64;
        if set {
            self.base = now;
        }
        set
    }
}

/// A peer's wall clock, continued by the monotonic clock here.
#[derive(Clone, Copy, Debug)]
pub struct PeerClock {
    time: UnixMillis,
    at: Now,
}

impl PeerClock {
    /// Returns the clock that a peer sent at `at`.
    pub fn new(time: UnixMillis, at: Now) -> Self {
        Self { time, at }
    }

    /// Returns by how many milliseconds the peer's clock is ahead of the one here; negative if it is behind.
    pub fn ahead_ms(&self, now: Now) -> i64 {
        let theirs = wall_after(self.time, self.at, now).0;
        let ahead = i128::from(theirs) - i128::from(now.unix.0);
        ahead.clamp(i64::MIN.into(), i64::MAX.into()) as i64
    }
}

/// Returns the present time of the wall clock that showed `time` at `then`.
fn wall_after(time: UnixMillis, then: Now, now: Now) -> UnixMillis {
    let passed = now.instant.saturating_duration_since(then.instant).as_millis();
    UnixMillis(time.0.saturating_add(u64::try_from(passed).unwrap_or(u64::MAX)))
}

#[cfg(test)]
mod tests {
    use super::*;

    fn at(base: Now, passed_ms: u64, set_ms: i64) -> Now {
        Now {
            instant: base.instant + Duration::from_millis(passed_ms),
            unix: UnixMillis((base.unix.0 + passed_ms).saturating_add_signed(set_ms)),
        }
    }

    fn base() -> Now {
        #[allow(clippy::disallowed_methods)]
        let instant = std::time::Instant::now();
        Now { instant, unix: UnixMillis(1_795_000_000_000) }
    }

    #[test]
    fn only_a_clock_that_was_set_is_noticed_and_once() {
        let base = base();
        let mut watch = ClockWatch::new(base);
        assert!(!watch.was_set(at(base, 86_400_000, 0)));
        assert!(!watch.was_set(at(base, 86_400_000, 59_000)));
        for set in [7_200_000, -60_000] {
            assert!(watch.was_set(at(base, 86_401_000, set)));
            assert!(!watch.was_set(at(base, 86_402_000, set)));
        }
    }

    #[test]
    fn a_difference_ends_when_either_clock_is_set() {
        let base = base();
        let told = PeerClock::new(UnixMillis(base.unix.0 + 7_200_000), base);
        assert_eq!(told.ahead_ms(at(base, 5000, 0)), 7_200_000);
        assert_eq!(told.ahead_ms(at(base, 5000, 7_200_000)), 0);
        assert_eq!(PeerClock::new(UnixMillis(0), base).ahead_ms(base), -1_795_000_000_000);
        assert_eq!(PeerClock::new(UnixMillis(u64::MAX), base).ahead_ms(base), i64::MAX);
    }
}
