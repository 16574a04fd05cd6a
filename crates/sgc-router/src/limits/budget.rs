//! Budgets: buckets of tokens that refill with time, and turns in order.

use std::time::{Duration, Instant};

use crate::limits::{QUERY_EVERY, ROUTER_FACTOR};

/// Turns in order: a fixed number in each [`QUERY_EVERY`].
#[derive(Debug)]
pub(crate) struct TurnBudget {
    max: u32,
    /// Time at which the turns taken so far are used up.
    next: Option<Instant>,
}

impl TurnBudget {
    pub(crate) fn new(max: u32) -> Self {
        Self { max: max.max(1), next: None }
    }

    fn interval(&self, is_router: bool) -> Duration {
        QUERY_EVERY / self.max.saturating_mul(if is_router { ROUTER_FACTOR } else { 1 })
    }

    /// Returns `true` if no turn is taken, so that forgetting it gives nothing back.
    pub(crate) fn is_whole(&self, now: Instant) -> bool {
        self.next.is_none_or(|at| at <= now)
    }

    /// Returns the time of the next one.
    pub(crate) fn next(&self, now: Instant, is_router: bool) -> Instant {
        let ahead = QUERY_EVERY - self.interval(is_router);
        self.next.and_then(|next| next.checked_sub(ahead)).map_or(now, |at| at.max(now))
    }

    /// Takes the next turn.
    pub(crate) fn take(&mut self, now: Instant, is_router: bool) -> Instant {
        let at = self.next(now, is_router);
        self.next = Some(self.next.map_or(now, |next| next.max(now)) + self.interval(is_router));
        at
    }
}

/// A bucket of tokens that refills with time.
#[derive(Debug)]
pub(crate) struct Budget {
    burst: u32,
    /// Tokens a second.
    rate: u32,
    used: f64,
    at: Option<Instant>,
}

impl Budget {
    pub(crate) fn new(burst: u32, rate: u32) -> Self {
        Self { burst, rate: rate.max(1), used: 0.0, at: None }
    }

    pub(crate) fn used_at(&self, now: Instant, factor: u32) -> f64 {
        let elapsed = self.at.map_or(Duration::ZERO, |at| now.saturating_duration_since(at));
        (self.used - elapsed.as_secs_f64() * f64::from(self.rate) * f64::from(factor)).max(0.0)
    }

    pub(crate) fn has_room(&self, now: Instant, tokens: u32, factor: u32) -> bool {
        self.used_at(now, factor) + f64::from(tokens) <= f64::from(self.burst) * f64::from(factor)
    }

    /// Returns the time of the next token.
    pub(crate) fn next_at(&self, now: Instant) -> Instant {
        let missing = (self.used_at(now, 1) + 1.0 - f64::from(self.burst)).max(0.0);
        now + Duration::from_secs_f64(missing / f64::from(self.rate))
    }

    pub(crate) fn take(&mut self, now: Instant, tokens: u32, factor: u32) -> bool {
        let room = self.has_room(now, tokens, factor);
        self.used = self.used_at(now, factor);
        self.at = Some(now);
        if room {
            self.used += f64::from(tokens);
        }
        room
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_budget_is_spent_and_comes_back_with_time() {
        #[allow(clippy::disallowed_methods)]
        let start = Instant::now();
        let mut budget = Budget::new(4, 2);
        let taken = |budget: &mut Budget, at| (0..10).filter(|_| budget.take(at, 1, 1)).count();
        assert_eq!(taken(&mut budget, start), 4);
        assert_eq!(taken(&mut budget, start + Duration::from_secs(1)), 2);
        assert_eq!(taken(&mut budget, start + Duration::from_secs(60)), 4);
        assert!(!budget.take(start + Duration::from_secs(70), 5, 1));
        assert!(budget.take(start + Duration::from_secs(70), 4, 1));
        let mut shared = Budget::new(4, 2);
        assert_eq!((0..100).filter(|_| shared.take(start, 1, 16)).count(), 64);
    }
}
