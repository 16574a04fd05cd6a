//! The loss of a direct link, and its cost.
//!
//! A message whose packet is lost waits for a round trip and more, so a direct link that loses packets can be worse than
//! a longer path over routers. Each end measures the packets that it sends.

use std::time::{Duration, Instant};

/// Least number of packets, and least time, of which a share is taken.
const WINDOW_PACKETS_MIN: u64 = 100;
const WINDOW_MIN: Duration = Duration::from_secs(3);
/// The same for a link with little traffic.
const IDLE_PACKETS_MIN: u64 = 20;
const IDLE_WINDOW_MIN: Duration = Duration::from_secs(60);
/// Loss counts from the first of these shares on, in thousandths, until it is below the second. A congestion controller
/// loses less.
const COUNTS_FROM: u32 = 80;
const COUNTS_NOT_BELOW: u32 = 30;
/// Each hundredth of loss costs a fifth of the link's round trip: the slowest hundredth of messages on a path that loses
/// a fifth waits for three repetitions.
const COST_OF_THOUSANDTH_DIVISOR: u32 = 50;

/// The share of packets that a link loses.
#[derive(Debug, Default)]
pub(super) struct Loss {
    /// Begin of the window, with the packets sent and lost until then.
    window: Option<(Instant, u64, u64)>,
    /// Smoothed share, in thousandths.
    smoothed: u32,
    counts: bool,
}

impl Loss {
    /// Takes the numbers of packets sent and lost since the link came up.
    pub(super) fn measure(&mut self, now: Instant, sent: u64, lost: u64) {
        let (begun, sent_before, lost_before) = *self.window.get_or_insert((now, sent, lost));
        let (sent_since, lost_since) = (sent.saturating_sub(sent_before), lost.saturating_sub(lost_before));
        let age = now.saturating_duration_since(begun);
        let is_full = (sent_since >= WINDOW_PACKETS_MIN && age >= WINDOW_MIN)
            || (sent_since >= IDLE_PACKETS_MIN && age >= IDLE_WINDOW_MIN);
        if !is_full {
            return;
        }
        self.window = Some((now, sent, lost));
        // A packet of the window before may be found lost in this one.
        let share = (lost_since.min(sent_since) * 1000 / sent_since) as u32;
        self.smoothed = self.smoothed.midpoint(share);
        self.counts = self.smoothed >= if self.counts { COUNTS_NOT_BELOW } else { COUNTS_FROM };
    }

    /// Returns the cost of the loss on a link with this round trip, microseconds.
    pub(super) fn cost(&self, round_trip: u32) -> u32 {
        let share = if self.counts { self.smoothed } else { 0 };
        round_trip.saturating_mul(share) / COST_OF_THOUSANDTH_DIVISOR
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// A link that sends so many packets a second and loses this share of them, in thousandths.
    struct Sender {
        now: Instant,
        sent: u64,
        lost: u64,
        loss: Loss,
    }

    impl Sender {
        fn new() -> Self {
            #[allow(clippy::disallowed_methods)]
            Self { now: Instant::now(), sent: 0, lost: 0, loss: Loss::default() }
        }

        /// Returns the cost after this time, in round trips of 1000.
        fn run(&mut self, seconds: u64, rate: u64, share: u64) -> f64 {
            let (sent, lost) = (self.sent, self.lost);
            for second in 1..=seconds {
                self.now += Duration::from_secs(1);
                self.sent = sent + second * rate;
                self.lost = lost + second * rate * share / 1000;
                self.loss.measure(self.now, self.sent, self.lost);
            }
            f64::from(self.loss.cost(1000)) / 1000.0
        }
    }

    #[test]
    fn loss_of_a_busy_link_counts_within_seconds_and_ends_when_it_ends() {
        let mut sender = Sender::new();
        assert_eq!(sender.run(20, 100, 20), 0.0, "as much as a congestion controller loses");
        let cost = sender.run(8, 100, 200);
        assert!(cost > 2.0, "{cost}");
        let cost = sender.run(20, 100, 200);
        assert!((3.0..=4.5).contains(&cost), "{cost}");
        assert!(sender.run(4, 100, 0) > 0.0, "a short pause");
        assert_eq!(sender.run(20, 100, 0), 0.0);
    }

    #[test]
    fn loss_of_a_link_without_traffic_is_remembered_until_enough_packets_have_passed() {
        let mut sender = Sender::new();
        sender.run(20, 100, 200);
        assert!(sender.run(50, 1, 0) > 3.0);
        assert_eq!(sender.run(300, 1, 0), 0.0);
        let cost = sender.run(300, 1, 250);
        assert!(cost > 3.0, "{cost}");
        assert!(sender.loss.cost(u32::MAX) > 0, "no overflow");
    }

    #[test]
    fn share_is_at_most_everything() {
        let mut sender = Sender::new();
        sender.loss.measure(sender.now, 0, 0);
        sender.loss.measure(sender.now + WINDOW_MIN, 100, 900);
        assert_eq!(sender.loss.smoothed, 500);
        sender.loss.measure(sender.now + 2 * WINDOW_MIN, 50, 0);
        assert_eq!(sender.loss.smoothed, 500, "counters that went back");
    }
}
