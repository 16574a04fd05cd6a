//! [`Failback`]: when a link by a worse URL looks for a better one.

use std::time::{Duration, Instant};

use rand_chacha::ChaCha20Rng;

use crate::jittered;

/// First wait before failback, and the longest.
const CLIMB_MIN: Duration = Duration::from_secs(30);
const CLIMB_MAX: Duration = Duration::from_secs(600);

/// Schedule of attempts at a better URL than the one in use.
#[derive(Debug)]
pub struct Failback {
    failures: u32,
    due: Option<Instant>,
}

impl Failback {
    /// Starts for a link by the URL of this rank. Rank 0 is the best, so it schedules nothing.
    pub fn new(rank: usize, now: Instant, rng: &mut ChaCha20Rng) -> Self {
        let due = (rank > 0).then(|| now + jittered(CLIMB_MIN, rng));
        Self { failures: 0, due }
    }

    /// Notes that no better URL works yet.
    pub fn failed(&mut self, now: Instant, rng: &mut ChaCha20Rng) {
        self.failures = self.failures.saturating_add(1);
        let doubled = CLIMB_MIN.saturating_mul(2u32.saturating_pow(self.failures.min(16)));
        self.due = Some(now + jittered(doubled.min(CLIMB_MAX), rng));
    }

    /// Makes an attempt due, because another network may not block the better URL.
    pub fn network_changed(&mut self, now: Instant) {
        if self.due.is_some() {
            *self = Self { failures: 0, due: Some(now) };
        }
    }

    /// Returns the time of the next attempt; `None` if none is scheduled.
    pub fn due(&self) -> Option<Instant> {
        self.due
    }
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used, clippy::disallowed_methods)]

    use rand_core::SeedableRng as _;

    use super::*;

    #[test]
    fn a_better_way_is_tried_again_with_growing_patience() {
        let (mut rng, mut now) = (ChaCha20Rng::seed_from_u64(1), Instant::now());
        let mut failback = Failback::new(1, now, &mut rng);
        let mut waits = Vec::new();
        for _ in 0..10 {
            let due = failback.due().unwrap();
            waits.push((due - now).as_secs_f64());
            now = due;
            failback.failed(now, &mut rng);
        }
        for (n, wait) in waits.iter().enumerate() {
            let most = f64::from(30 << n.min(5)).min(600.0);
            assert!((most / 2.0 - 0.01..=most + 0.01).contains(wait), "{n}: {waits:?}");
        }
        assert_eq!(Failback::new(0, now, &mut rng).due(), None);
    }
}
