//! [`PushSchedule`]: when the next request is due.

use std::time::{Duration, Instant};

use rand_chacha::ChaCha20Rng;
use rand_core::RngCore as _;

use crate::fault::Fault;

/// The wait after the first failure, before jitter. It doubles with each further one.
pub const BACKOFF_MIN: Duration = Duration::from_secs(1);
/// The longest wait after a failure, before jitter, unless the interval is longer.
pub const BACKOFF_MAX: Duration = Duration::from_secs(60);
/// The longest wait that a collector may ask for. One that says more must not silence a node.
pub const RETRY_AFTER_MAX: Duration = Duration::from_secs(900);

/// The times of requests: one at each interval, and sooner again after a failure that may pass. There is never more than
/// one request, since the next one is due only after the last one ended.
#[derive(Clone, Copy, Debug)]
pub struct PushSchedule {
    interval: Duration,
    /// Passing failures in a row.
    failures: u32,
    due: Instant,
}

impl PushSchedule {
    /// Creates a schedule whose first request is due at once.
    pub fn new(interval: Duration, now: Instant) -> Self {
        Self { interval, failures: 0, due: now }
    }

    /// Returns the time of the next request.
    pub fn due(&self) -> Instant {
        self.due
    }

    /// Notes the end of the request that was due: `None` is success.
    pub fn ended(&mut self, fault: Option<&Fault>, now: Instant, rng: &mut ChaCha20Rng) {
        let Some(fault) = fault.filter(|fault| fault.is_passing()) else {
            self.failures = 0;
            // A request that took longer than the interval has no successors to catch up with.
            self.due = (self.due + self.interval).max(now);
            return;
        };
        self.failures = self.failures.saturating_add(1);
        let longest = BACKOFF_MAX.max(self.interval);
        let doubled = BACKOFF_MIN.saturating_mul(1 << (self.failures - 1).min(16)).min(longest);
        let wait = match fault {
            Fault::Busy { retry_after: Some(asked), .. } => {
                // Later than asked, never sooner.
                let asked = (*asked).clamp(BACKOFF_MIN, RETRY_AFTER_MAX);
                asked + asked.mul_f64(fraction(rng) / 10.0)
            }
            _ => doubled.mul_f64(0.5 + fraction(rng) / 2.0),
        };
        self.due = now + wait;
    }
}

/// Returns a random number in [0, 1).
fn fraction(rng: &mut ChaCha20Rng) -> f64 {
    f64::from(rng.next_u32()) / (f64::from(u32::MAX) + 1.0)
}

#[cfg(test)]
mod tests {
    use rand_core::SeedableRng as _;

    use super::*;

    const INTERVAL: Duration = Duration::from_secs(30);

    struct Run {
        schedule: PushSchedule,
        now: Instant,
        rng: ChaCha20Rng,
    }

    impl Run {
        fn new(interval: Duration) -> Self {
            let now = Instant::now();
            let rng = ChaCha20Rng::seed_from_u64(1);
            Self { schedule: PushSchedule::new(interval, now), now, rng }
        }

        /// Has the due request end like this, after `took`. Returns the wait until the next one.
        fn wait_after(&mut self, fault: Option<&Fault>, took: Duration) -> Duration {
            self.now = self.schedule.due().max(self.now) + took;
            self.schedule.ended(fault, self.now, &mut self.rng);
            self.schedule.due().duration_since(self.now)
        }
    }

    fn unreachable() -> Fault {
        Fault::Unreachable { reason: String::new() }
    }

    fn busy(retry_after: Option<Duration>) -> Fault {
        Fault::Busy { status: 503, message: String::new(), retry_after }
    }

    #[test]
    fn requests_keep_the_interval_however_long_one_takes() {
        let mut run = Run::new(INTERVAL);
        assert_eq!(run.wait_after(None, Duration::from_secs(2)), Duration::from_secs(28));
        assert_eq!(run.wait_after(None, Duration::from_secs(5)), Duration::from_secs(25));
        assert_eq!(run.wait_after(None, 3 * INTERVAL), Duration::ZERO);
        // Those that were due meanwhile are not made up for.
        assert_eq!(run.wait_after(None, Duration::ZERO), INTERVAL);
    }

    #[test]
    fn refusal_waits_for_the_interval() {
        let mut run = Run::new(INTERVAL);
        let refused = Fault::Refused { status: 400, message: String::new() };
        assert_eq!(run.wait_after(Some(&refused), Duration::ZERO), INTERVAL);
    }

    #[test]
    fn waits_double_up_to_their_bound_with_jitter() {
        let mut run = Run::new(INTERVAL);
        let mut expected = BACKOFF_MIN;
        for _ in 0..40 {
            let wait = run.wait_after(Some(&unreachable()), Duration::ZERO);
            assert!(expected / 2 <= wait && wait < expected, "{wait:?} is not in half of {expected:?}");
            expected = (2 * expected).min(BACKOFF_MAX);
        }
        run.wait_after(None, Duration::ZERO);
        assert!(run.wait_after(Some(&unreachable()), Duration::ZERO) < BACKOFF_MIN, "success ends it");
        let mut slow = Run::new(10 * BACKOFF_MAX);
        let waits = (0..40).map(|_| slow.wait_after(Some(&unreachable()), Duration::ZERO));
        assert!(waits.max() > Some(BACKOFF_MAX), "failures are no more frequent than requests are");
    }

    #[test]
    fn asked_wait_is_kept_within_its_bounds() {
        for (asked, least) in [
            (Duration::ZERO, BACKOFF_MIN),
            (Duration::from_secs(120), Duration::from_secs(120)),
            (Duration::from_secs(u64::MAX), RETRY_AFTER_MAX),
        ] {
            let wait = Run::new(INTERVAL).wait_after(Some(&busy(Some(asked))), Duration::ZERO);
            assert!(least <= wait && wait <= least + least / 10, "{asked:?}: {wait:?}");
        }
        assert!(Run::new(INTERVAL).wait_after(Some(&busy(None)), Duration::ZERO) < BACKOFF_MIN);
    }
}
