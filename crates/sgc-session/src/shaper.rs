//! Shaping of a topic: limits its rate, its bandwidth and the age of its messages.
//!
//! The caller passes in the time and holds messages back. This machine returns the time of the next message.

use std::time::{Duration, Instant};

use sgc_ros::Shaping;

/// Delay of timers and schedulers that costs a topic no bandwidth.
const SLACK: Duration = Duration::from_millis(50);

/// Decides when the next message of a topic may leave.
#[derive(Debug, Default)]
pub struct Shaper {
    shaping: Shaping,
    /// Time allowed by the rate.
    rate_due: Option<Instant>,
    /// Time allowed by the bandwidth.
    bandwidth_due: Option<Instant>,
    age: Age,
}

impl Shaper {
    /// Replaces the settings.
    pub fn set(&mut self, shaping: Shaping) {
        *self = Self { shaping, ..Self::default() };
    }

    /// Returns the settings.
    pub fn shaping(&self) -> &Shaping {
        &self.shaping
    }

    /// Returns the time at which a message may leave. A message that waits for the rate is replaced by the next. One
    /// that waits for bandwidth is replaced only if it is best effort.
    pub fn due(&self) -> Option<Instant> {
        self.rate_due.max(self.bandwidth_due)
    }

    /// Returns `true` if a message may leave now.
    pub fn is_due(&self, now: Instant) -> bool {
        self.due().is_none_or(|due| due <= now)
    }

    /// Returns `true` if a waiting message is replaced by the next one.
    pub fn gives_way(&self, now: Instant, reliable: bool) -> bool {
        !reliable || self.rate_due.is_some_and(|due| due > now)
    }

    /// Returns `true` if the settings let later messages replace one that waits.
    pub fn thins(&self, reliable: bool) -> bool {
        self.shaping.interval.is_some() || (!reliable && self.shaping.bits_per_s.is_some())
    }

    /// Charges a message that leaves. The next one is due relative to this one's due time, so that the configured rate
    /// is met.
    pub fn takes(&mut self, now: Instant, bytes: usize) {
        if let Some(interval) = self.shaping.interval {
            let next = self.rate_due.map(|due| due + interval).filter(|next| *next > now);
            self.rate_due = Some(next.unwrap_or(now + interval));
        }
        if let Some(bits_per_s) = self.shaping.bits_per_s {
            let took = Duration::from_secs_f64(bytes as f64 * 8.0 / bits_per_s.max(1) as f64);
            let earliest = now.checked_sub(SLACK).unwrap_or(now);
            let begins = self.bandwidth_due.map_or(now, |due| due.max(earliest));
            self.bandwidth_due = Some(begins + took);
        }
    }

    /// Corrects the charge, because the message's final length differs.
    pub fn corrects(&mut self, taken: usize, left: usize) {
        if let (Some(due), Some(bits_per_s)) = (&mut self.bandwidth_due, self.shaping.bits_per_s) {
            let took = Duration::from_secs_f64(taken.abs_diff(left) as f64 * 8.0 / bits_per_s.max(1) as f64);
            *due = if left > taken { *due + took } else { due.checked_sub(took).unwrap_or(*due) };
        }
    }

    /// Returns `true` if a message is too old by its publisher's time stamp and this node's clock, both in ns since
    /// 1970.
    pub fn is_too_old(&mut self, now_ns: i64, dated_ns: i64) -> bool {
        let Some(max) = self.shaping.max_age else { return false };
        self.age.measure(now_ns, dated_ns) > max
    }
}

/// Age of messages. Clocks of hosts differ, so the youngest message seen counts as new.
#[derive(Debug, Default)]
struct Age {
    least_ns: Option<i64>,
}

impl Age {
    fn measure(&mut self, now_ns: i64, dated_ns: i64) -> Duration {
        // The message has no time stamp.
        if dated_ns <= 0 {
            return Duration::ZERO;
        }
        let difference = now_ns.saturating_sub(dated_ns);
        let least = self.least_ns.map_or(difference, |least| least.min(difference));
        self.least_ns = Some(least);
        Duration::from_nanos(difference.saturating_sub(least).unsigned_abs())
    }
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used, clippy::disallowed_methods)]

    use super::*;

    fn shaper(shaping: Shaping) -> (Shaper, Instant) {
        let mut shaper = Shaper::default();
        shaper.set(shaping);
        (shaper, Instant::now())
    }

    fn ms(n: u64) -> Duration {
        Duration::from_millis(n)
    }

    /// Offers a message every `every` ms for a minute, keeping the newest, and returns the times at which one left.
    fn went(shaper: &mut Shaper, begin: Instant, every: u64, bytes: usize) -> Vec<u64> {
        let (mut held, mut went) = (None, Vec::new());
        for at in 0..60_000 {
            if at % every == 0 {
                held = Some(at);
            }
            let now = begin + ms(at);
            if shaper.is_due(now) && held.take().is_some() {
                shaper.takes(now, bytes);
                went.push(at);
            }
        }
        went
    }

    #[test]
    fn a_rate_is_met_evenly_whatever_comes() {
        for every in [5, 33, 40, 70, 99] {
            let (mut shaper, begin) = shaper(Shaping { interval: Some(ms(100)), ..Shaping::default() });
            let went = went(&mut shaper, begin, every, 1000);
            assert!((598..=601).contains(&went.len()), "{every}: {}", went.len());
            let gaps = went.windows(2).map(|two| two[1] - two[0]);
            assert!(
                gaps.clone().all(|gap| (50..=150).contains(&gap)),
                "{every}: {:?}",
                gaps.collect::<Vec<_>>()
            );
        }
        // A slower topic passes unchanged.
        let (mut shaper, begin) = shaper(Shaping { interval: Some(ms(100)), ..Shaping::default() });
        assert_eq!(went(&mut shaper, begin, 250, 1000).len(), 240);
    }

    #[test]
    fn a_bandwidth_is_met_whatever_the_size() {
        for (every, bytes) in [(1, 100), (10, 10_000), (33, 60_000), (1000, 5_000_000)] {
            let (mut shaper, begin) = shaper(Shaping { bits_per_s: Some(2_000_000), ..Shaping::default() });
            let sent = went(&mut shaper, begin, every, bytes).len() as f64 * bytes as f64 * 8.0 / 60.0;
            let offered = bytes as f64 * 8.0 * 1000.0 / every as f64;
            let expected = offered.min(2_000_000.0);
            // The last message may exceed the minute.
            let most = expected + bytes as f64 * 8.0 / 60.0 + 20_000.0;
            assert!(sent >= expected * 0.9 && sent <= most, "{every} {bytes}: {sent}");
        }
    }

    #[test]
    fn a_bandwidth_counts_what_leaves() {
        let (mut shaper, now) = shaper(Shaping { bits_per_s: Some(8000), ..Shaping::default() });
        shaper.takes(now, 1000);
        shaper.corrects(1000, 100);
        assert_eq!(shaper.due(), Some(now + ms(100)));
        // JSON may be longer than its source.
        shaper.corrects(100, 300);
        assert_eq!(shaper.due(), Some(now + ms(300)));
    }

    #[test]
    fn only_what_may_be_missed_gives_way() {
        let (mut shaper, now) = shaper(Shaping { bits_per_s: Some(8000), ..Shaping::default() });
        shaper.takes(now, 1000);
        assert!(!shaper.is_due(now) && shaper.gives_way(now, false) && !shaper.gives_way(now, true));
        shaper.set(Shaping { interval: Some(ms(100)), ..Shaping::default() });
        shaper.takes(now, 1000);
        assert!(shaper.gives_way(now, true) && !shaper.gives_way(now + ms(100), true));
        shaper.set(Shaping::default());
        shaper.takes(now, 1 << 30);
        assert!(shaper.is_due(now));
    }

    #[test]
    fn age_counts_from_the_youngest_and_clocks_may_differ() {
        const MS: i64 = 1_000_000;
        for skew in [-3_600_000 * MS, 0, 3_600_000 * MS] {
            let (mut shaper, _) = shaper(Shaping { max_age: Some(ms(500)), ..Shaping::default() });
            let now = 1_700_000_000_000 * MS;
            let mut is_too_old = |age: i64| shaper.is_too_old(now, now + skew - age * MS);
            let ages = [0, 400, 600, 500, 10_000, 100];
            assert_eq!(ages.map(&mut is_too_old), [false, false, true, false, true, false]);
            assert!(!shaper.is_too_old(now, 0));
        }
        let (mut shaper, _) = shaper(Shaping::default());
        assert!(!shaper.is_too_old(i64::MAX, 1) && !shaper.is_too_old(i64::MIN, i64::MAX));
    }
}
