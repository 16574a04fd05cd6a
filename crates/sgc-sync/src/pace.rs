//! [`Pace`]: a limit on the time for which threads do other work than their own.

use std::sync::atomic::{AtomicU64, Ordering};
use std::time::Instant;

/// Shortest rest of the receiving thread after it handled a sample. It rests as long as that took; a worker
/// handles fast samples better, several at a time.
const REST_MIN_NS: u64 = 20_000;

/// A limiter of the time for which a network's receiving threads do other work than receive: at most half.
#[derive(Debug)]
pub struct Pace {
    began: Instant,
    rests_until_ns: AtomicU64,
}

impl Default for Pace {
    fn default() -> Self {
        Self::new()
    }
}

impl Pace {
    /// Creates a limiter. Work may begin at once.
    pub fn new() -> Self {
        Self { began: Instant::now(), rests_until_ns: AtomicU64::new(0) }
    }

    fn now_ns(&self) -> u64 {
        self.began.elapsed().as_nanos() as u64
    }

    /// Returns the current time, for [`Self::end`], if other work may begin.
    pub fn begin(&self) -> Option<u64> {
        let now_ns = self.now_ns();
        self.may_begin(now_ns).then_some(now_ns)
    }

    /// Notes the end of work that began at `began_ns`, as [`Self::begin`] returned it.
    pub fn end(&self, began_ns: u64) {
        self.end_at(began_ns, self.now_ns());
    }

    fn may_begin(&self, now_ns: u64) -> bool {
        now_ns >= self.rests_until_ns.load(Ordering::Relaxed)
    }

    fn end_at(&self, began_ns: u64, now_ns: u64) {
        let rest_ns = now_ns.saturating_sub(began_ns).max(REST_MIN_NS);
        self.rests_until_ns.store(now_ns.saturating_add(rest_ns), Ordering::Relaxed);
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn receiving_threads_rest_for_as_long_as_they_worked() {
        let pace = Pace::new();
        let may = |now_ns| pace.may_begin(now_ns);
        assert!(may(0), "nothing was handled yet");
        pace.end_at(1_000_000, 4_000_000);
        assert!(!may(4_000_000) && !may(6_999_999) && may(7_000_000));
        pace.end_at(7_000_000, 7_000_001);
        assert!(!may(7_020_000) && may(7_020_001), "a short time at least");
        pace.end_at(1, 0);
        assert!(!may(19_999) && may(20_000), "clocks of two threads may differ");
    }
}
