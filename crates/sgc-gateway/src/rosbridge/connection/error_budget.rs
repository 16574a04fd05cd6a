//! [`ErrorBudget`]: the number of errors that a client may still make.

use tokio::time::Instant;

/// Errors that a client may make in a burst, and per second. A client beyond that is disconnected.
const ERRORS_BURST: u32 = 200;
const ERRORS_PER_SECOND: u32 = 100;

/// The number of errors that a client may still make.
pub(super) struct ErrorBudget {
    left: u32,
    since: Instant,
}

impl ErrorBudget {
    pub(super) fn new() -> Self {
        Self { left: ERRORS_BURST, since: Instant::now() }
    }

    /// Counts an error. Returns `false` if there were too many.
    pub(super) fn count(&mut self, now: Instant) -> bool {
        let earned =
            now.saturating_duration_since(self.since).as_millis() * u128::from(ERRORS_PER_SECOND) / 1000;
        if earned > 0 {
            self.left =
                u32::try_from(earned).map_or(ERRORS_BURST, |n| self.left.saturating_add(n).min(ERRORS_BURST));
            self.since = now;
        }
        let may = self.left > 0;
        self.left = self.left.saturating_sub(1);
        may
    }
}

#[cfg(test)]
mod tests {
    use std::time::Duration;

    use super::*;

    #[tokio::test(start_paused = true)]
    async fn occasional_errors_are_forgiven() {
        let mut budget = ErrorBudget::new();
        for _ in 0..10_000 {
            assert!(budget.count(Instant::now()));
            tokio::time::advance(Duration::from_millis(11)).await;
        }
        let mut errors = 0;
        while budget.count(Instant::now()) {
            errors += 1;
        }
        assert_eq!(errors, ERRORS_BURST);
    }
}
