//! Back-off between attempts: the wait grows with each failure and is always jittered, so that nodes that lost the same
//! router do not all return at one moment.

use std::time::{Duration, Instant};

use rand_chacha::ChaCha20Rng;
use rand_core::RngCore;

/// The shortest wait, before jitter.
pub const BACKOFF_MIN: Duration = Duration::from_millis(250);
/// The longest wait for a router that the user, or the user's DNS, named.
pub const BACKOFF_MAX: Duration = Duration::from_secs(10);
/// The first wait, before jitter, after another process with this node's identity took its links. It is doubled each
/// time.
const DISPLACED_MIN: Duration = Duration::from_secs(1);
/// The longest such wait, before jitter.
pub const DISPLACED_MAX: Duration = Duration::from_secs(300);
/// The wait where an early attempt cannot succeed.
pub const STAND_BACK: Duration = Duration::from_secs(300);

/// The attempts at one target.
#[derive(Clone, Copy, Debug)]
pub struct Backoff {
    max: Duration,
    failures: u32,
    /// Number of times in a row that another process with this node's identity took the links.
    displaced: u32,
    due: Option<Instant>,
}

impl Backoff {
    /// Creates a back-off that is due at once. No wait exceeds `max`, except [`STAND_BACK`].
    pub fn new(max: Duration) -> Self {
        Self { max, failures: 0, displaced: 0, due: None }
    }

    /// Notes that a link was up and ended.
    pub fn ended(&mut self, now: Instant, rng: &mut ChaCha20Rng) {
        (self.failures, self.displaced) = (0, 0);
        self.due = Some(now + wait(1, self.max, rng));
    }

    /// Notes that a link ended because another process uses this node's identity.
    pub fn displaced(&mut self, now: Instant, rng: &mut ChaCha20Rng) {
        self.displaced = self.displaced.saturating_add(1);
        self.due = Some(now + doubled(DISPLACED_MIN, self.displaced, DISPLACED_MAX, rng));
    }

    /// Notes that an attempt failed.
    pub fn failed(&mut self, now: Instant, rng: &mut ChaCha20Rng) {
        self.failures = self.failures.saturating_add(1);
        self.due = Some(now + wait(self.failures, self.max, rng));
    }

    /// Notes that an early attempt is useless.
    pub fn stand_back(&mut self, now: Instant, rng: &mut ChaCha20Rng) {
        self.due = Some(now + jittered(STAND_BACK, rng));
    }

    /// Returns the number of failures in a row.
    pub fn failures(&self) -> u32 {
        self.failures
    }

    /// Returns the time of the next attempt; `None` means at once.
    pub fn due(&self) -> Option<Instant> {
        self.due
    }

    /// Returns `true` if the next attempt is due.
    pub fn is_due(&self, now: Instant) -> bool {
        self.due.is_none_or(|due| due <= now)
    }
}

/// Returns the wait after this many failures in a row: `BACKOFF_MIN` doubled for each after the first, at most `max`,
/// times a random factor in [0.5, 1).
pub fn wait(failures: u32, max: Duration, rng: &mut ChaCha20Rng) -> Duration {
    doubled(BACKOFF_MIN, failures, max, rng)
}

/// Returns `least` doubled `times` times, at most `max`, with jitter.
pub fn doubled(least: Duration, times: u32, max: Duration, rng: &mut ChaCha20Rng) -> Duration {
    let doubled = least.saturating_mul(2u32.saturating_pow(times.saturating_sub(1).min(16)));
    jittered(doubled.min(max), rng)
}

/// Returns a random duration between half of `wait` and `wait`.
pub fn jittered(wait: Duration, rng: &mut ChaCha20Rng) -> Duration {
    wait.mul_f64(0.5 + f64::from(rng.next_u32()) / f64::from(u32::MAX) / 2.0)
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used, clippy::disallowed_methods)]

    use rand_core::SeedableRng as _;

    use super::*;

    #[test]
    fn waits_grow_to_their_limit_and_differ() {
        let mut rng = ChaCha20Rng::seed_from_u64(1);
        for (failures, most) in
            [(0, 250), (1, 250), (2, 500), (5, 4000), (6, 8000), (7, 10_000), (900, 10_000)]
        {
            let waits: Vec<_> = (0..100).map(|_| wait(failures, BACKOFF_MAX, &mut rng).as_millis()).collect();
            assert!(waits.iter().all(|w| (most / 2..=most).contains(w)), "{failures}: {waits:?}");
            assert!(waits.iter().max() > waits.iter().min());
        }
    }

    #[test]
    fn a_displaced_process_waits_twice_as_long_each_time_until_a_link_ends_otherwise() {
        let (mut rng, mut backoff) = (ChaCha20Rng::seed_from_u64(3), Backoff::new(BACKOFF_MAX));
        let now = Instant::now();
        for most_s in [1, 2, 4, 8, 16, 32, 64, 128, 256, 300, 300] {
            backoff.displaced(now, &mut rng);
            let wait = backoff.due().unwrap() - now;
            let most = Duration::from_secs(most_s);
            assert!(wait >= most / 2 && wait <= most, "{wait:?} of {most:?}");
        }
        backoff.ended(now, &mut rng);
        backoff.displaced(now, &mut rng);
        assert!(backoff.due().unwrap() - now <= DISPLACED_MIN);
    }

    #[test]
    fn success_makes_patience_short_again() {
        let (mut rng, mut backoff) = (ChaCha20Rng::seed_from_u64(2), Backoff::new(BACKOFF_MAX));
        let now = Instant::now();
        assert!(backoff.is_due(now));
        for _ in 0..20 {
            backoff.failed(now, &mut rng);
        }
        assert!(!backoff.is_due(now + BACKOFF_MAX / 2 - Duration::from_millis(1)));
        assert!(backoff.is_due(now + BACKOFF_MAX));
        backoff.stand_back(now, &mut rng);
        assert!(!backoff.is_due(now + BACKOFF_MAX) && backoff.is_due(now + STAND_BACK));
        assert_eq!(backoff.failures(), 20);
        backoff.ended(now, &mut rng);
        assert!(!backoff.is_due(now) && backoff.is_due(now + BACKOFF_MIN));
        assert_eq!(backoff.failures(), 0);
    }
}
