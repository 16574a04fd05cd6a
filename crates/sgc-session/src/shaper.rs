//! Shaping of a topic: limits its rate, its bandwidth and the age of its messages.
//!
//! The caller passes in the time and holds messages back. This machine returns the time of the next message.

use std::time::{Duration, Instant};

use sgc_ros::Shaping;

/// Delay of timers and schedulers that costs a topic no bandwidth.
const SLACK: Duration = Duration::from_millis(50);

/// The most that the subscribers of a topic wish together.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Wished {
    /// Least time between two messages.
    pub interval: Option<Duration>,
    /// Most bits of payload a second.
    pub bits_per_s: Option<u64>,
}

impl Wished {
    /// Returns what satisfies both: the more of each. No subscriber gets less than it wishes because of another.
    #[must_use]
    pub fn or_more(self, other: Self) -> Self {
        Self {
            interval: self.interval.zip(other.interval).map(|(a, b)| a.min(b)),
            bits_per_s: self.bits_per_s.zip(other.bits_per_s).map(|(a, b)| a.max(b)),
        }
    }
}

/// Decides when the next message of a topic may leave.
#[derive(Debug, Default)]
pub struct Shaper {
    shaping: Shaping,
    limits: Pacer,
    /// The limit that the subscribers wish. Messages beyond it give way, reliable ones too, because nobody wants them.
    wished: Pacer,
    age: Age,
}

/// A limit of rate and bandwidth.
#[derive(Debug, Default)]
struct Pacer {
    interval: Option<Duration>,
    bits_per_s: Option<u64>,
    /// Time allowed by the rate.
    rate_due: Option<Instant>,
    /// Time allowed by the bandwidth.
    bandwidth_due: Option<Instant>,
}

impl Pacer {
    fn new(interval: Option<Duration>, bits_per_s: Option<u64>) -> Self {
        Self { interval, bits_per_s, ..Self::default() }
    }

    fn due(&self) -> Option<Instant> {
        self.rate_due.max(self.bandwidth_due)
    }

    fn takes(&mut self, now: Instant, bytes: usize) {
        if let Some(interval) = self.interval {
            let next = self.rate_due.map(|due| due + interval).filter(|next| *next > now);
            self.rate_due = Some(next.unwrap_or(now + interval));
        }
        if let Some(bits_per_s) = self.bits_per_s {
            let earliest = now.checked_sub(SLACK).unwrap_or(now);
            let begins = self.bandwidth_due.map_or(now, |due| due.max(earliest));
            self.bandwidth_due = Some(begins + time_of(bytes, bits_per_s));
        }
    }

    fn corrects(&mut self, taken: usize, left: usize) {
        if let (Some(due), Some(bits_per_s)) = (&mut self.bandwidth_due, self.bits_per_s) {
            let took = time_of(taken.abs_diff(left), bits_per_s);
            *due = if left > taken { *due + took } else { due.checked_sub(took).unwrap_or(*due) };
        }
    }
}

/// Returns the time that a payload takes at a bandwidth.
fn time_of(bytes: usize, bits_per_s: u64) -> Duration {
    Duration::from_secs_f64(bytes as f64 * 8.0 / bits_per_s.max(1) as f64)
}

impl Shaper {
    /// Replaces the settings.
    pub fn set(&mut self, shaping: Shaping) {
        self.shaping = shaping;
        self.limits = Pacer::new(shaping.interval, shaping.bits_per_s);
        self.age = Age::default();
    }

    /// Sets what the subscribers wish. The same wishes change nothing.
    pub fn wish(&mut self, wished: Wished) {
        if wished != self.wished() {
            self.wished = Pacer::new(wished.interval, wished.bits_per_s);
        }
    }

    /// Returns the settings.
    pub fn shaping(&self) -> &Shaping {
        &self.shaping
    }

    /// Returns what the subscribers wish.
    pub fn wished(&self) -> Wished {
        Wished { interval: self.wished.interval, bits_per_s: self.wished.bits_per_s }
    }

    /// Returns the time at which a message may leave. A message that waits for the rate, or for what the subscribers
    /// wish, is replaced by the next. One that waits for bandwidth is replaced only if it is best effort.
    pub fn due(&self) -> Option<Instant> {
        self.limits.due().max(self.wished.due())
    }

    /// Returns `true` if a message may leave now.
    pub fn is_due(&self, now: Instant) -> bool {
        self.due().is_none_or(|due| due <= now)
    }

    /// Returns `true` if a waiting message is replaced by the next one.
    pub fn gives_way(&self, now: Instant, reliable: bool) -> bool {
        let waits = |due: Option<Instant>| due.is_some_and(|due| due > now);
        !reliable || waits(self.limits.rate_due) || waits(self.wished.due())
    }

    /// Returns `true` if the settings let later messages replace one that waits.
    pub fn thins(&self, reliable: bool) -> bool {
        self.shaping.interval.is_some()
            || self.wished() != Wished::default()
            || (!reliable && self.shaping.bits_per_s.is_some())
    }

    /// Charges a message that leaves. The next one is due relative to this one's due time, so that the configured rate
    /// is met.
    pub fn takes(&mut self, now: Instant, bytes: usize) {
        self.limits.takes(now, bytes);
        self.wished.takes(now, bytes);
    }

    /// Corrects the charge, because the message's final length differs.
    pub fn corrects(&mut self, taken: usize, left: usize) {
        self.limits.corrects(taken, left);
        self.wished.corrects(taken, left);
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

    #[test]
    fn what_the_subscribers_wish_limits_reliable_topics_too_and_holds_nobody_up() {
        let mut shaper = Shaper::default();
        let begin = Instant::now();
        shaper.wish(Wished { interval: Some(ms(100)), bits_per_s: None });
        let times = went(&mut shaper, begin, 10, 100);
        assert!(times.len() == 600 && shaper.gives_way(begin + ms(59_950), true), "{}", times.len());
        shaper.wish(Wished { interval: None, bits_per_s: Some(8_000) });
        shaper.takes(begin, 1000);
        assert!(!shaper.is_due(begin + ms(900)) && shaper.gives_way(begin + ms(900), true));
        assert!(shaper.is_due(begin + ms(1000)));
        // The same wishes change nothing, and no wishes end the limit.
        shaper.wish(Wished { interval: None, bits_per_s: Some(8_000) });
        assert!(!shaper.is_due(begin + ms(900)));
        shaper.wish(Wished::default());
        assert!(shaper.is_due(begin));
        // A limit of the configuration stays.
        shaper.set(Shaping { bits_per_s: Some(8_000), ..Shaping::default() });
        shaper.takes(begin, 1000);
        assert!(!shaper.is_due(begin + ms(900)) && !shaper.gives_way(begin + ms(900), true));
    }

    #[test]
    fn nobody_gets_less_because_of_the_wishes_of_others() {
        let slow = Wished { interval: Some(ms(500)), bits_per_s: Some(1000) };
        let quick = Wished { interval: Some(ms(100)), bits_per_s: None };
        assert_eq!(slow.or_more(quick), Wished { interval: Some(ms(100)), bits_per_s: None });
        assert_eq!(quick.or_more(slow), slow.or_more(quick));
        assert_eq!(slow.or_more(Wished::default()), Wished::default());
    }

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
