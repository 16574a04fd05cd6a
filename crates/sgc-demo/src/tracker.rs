//! Counts what a listener receives of one topic: missing, repeated and damaged messages, and their latency.
//!
//! Pure: the driver passes in each message and its time.

use hdrhistogram::Histogram;
use serde::{Deserialize, Serialize};

use crate::messages::{Damage, Stamp};

/// Largest sequence number: two weeks at 50 Hz, 8 MB of bits. A larger one counts as damage.
pub(crate) const SEQ_MAX: u64 = 1 << 26;
/// Longest latency that the histogram resolves, in microseconds.
const LATENCY_US_MAX: u64 = 60_000_000;
const LATENCY_DIGITS: u8 = 3;

/// The state of one topic at its listener.
pub(crate) struct Tracker {
    /// One bit for each number.
    seen: Vec<u64>,
    highest: u64,
    received: u64,
    duplicated: u64,
    corrupt: u64,
    first_damage: Option<Damage>,
    uncounted: u64,
    ended: bool,
    latency_us: Histogram<u64>,
}

/// The counts of one topic, as a peer reports them.
#[derive(Clone, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
pub(crate) struct Counts {
    /// Numbers received at least once.
    pub(crate) received: u64,
    /// Numbers below the highest that have not been received.
    pub(crate) missing: u64,
    /// Messages whose number had been received already.
    pub(crate) duplicated: u64,
    /// Damaged messages.
    pub(crate) corrupt: u64,
    /// The damage of the first of them.
    pub(crate) damage: Option<String>,
    /// Set once an uncounted message follows a counted one: the talker has stopped numbering.
    pub(crate) ended: bool,
    /// Median latency in microseconds.
    pub(crate) p50_us: u64,
    /// 99th percentile of the latency in microseconds.
    pub(crate) p99_us: u64,
}

impl Tracker {
    /// Returns a tracker without messages.
    pub(crate) fn new() -> Self {
        Self {
            seen: Vec::new(),
            highest: 0,
            received: 0,
            duplicated: 0,
            corrupt: 0,
            first_damage: None,
            uncounted: 0,
            ended: false,
            latency_us: Histogram::new_with_max(LATENCY_US_MAX, LATENCY_DIGITS)
                .expect("constants that hdrhistogram allows"),
        }
    }

    /// Counts a message that arrived at `now_ns` on the clock of its stamp.
    pub(crate) fn handle(&mut self, message: Result<Stamp, Damage>, now_ns: u64) {
        match message {
            Ok(Stamp { seq: 0, .. }) => {
                self.uncounted += 1;
                self.ended |= self.received > 0;
            }
            Ok(stamp) if stamp.seq <= SEQ_MAX => self.count(stamp, now_ns),
            Ok(_) => self.damage(Damage::Foreign("its number is too large")),
            Err(damage) => self.damage(damage),
        }
    }

    /// Returns `true` once an undamaged message has arrived.
    pub(crate) fn is_alive(&self) -> bool {
        self.received + self.uncounted > 0
    }

    /// Returns the counts so far.
    pub(crate) fn counts(&self) -> Counts {
        Counts {
            received: self.received,
            missing: self.highest - self.received,
            duplicated: self.duplicated,
            corrupt: self.corrupt,
            damage: self.first_damage.map(|d| d.to_string()),
            ended: self.ended,
            p50_us: self.latency_us.value_at_quantile(0.5),
            p99_us: self.latency_us.value_at_quantile(0.99),
        }
    }

    fn count(&mut self, stamp: Stamp, now_ns: u64) {
        let (word, bit) = ((stamp.seq / 64) as usize, 1 << (stamp.seq % 64));
        if self.seen.len() <= word {
            self.seen.resize(word + 1, 0);
        }
        if self.seen[word] & bit != 0 {
            self.duplicated += 1;
            return;
        }
        self.seen[word] |= bit;
        self.received += 1;
        self.highest = self.highest.max(stamp.seq);
        self.latency_us.saturating_record(now_ns.saturating_sub(stamp.sent_ns) / 1000);
    }

    fn damage(&mut self, damage: Damage) {
        self.corrupt += 1;
        self.first_damage.get_or_insert(damage);
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn tracked(seqs: &[u64]) -> Counts {
        let mut tracker = Tracker::new();
        for seq in seqs {
            tracker.handle(Ok(Stamp { seq: *seq, sent_ns: 0 }), 1_000_000);
        }
        tracker.counts()
    }

    #[test]
    fn gaps_repetitions_and_late_messages_are_counted() {
        let counts = tracked(&[0, 1, 2, 5, 5, 3, 1]);
        assert_eq!((counts.received, counts.missing, counts.duplicated), (4, 1, 2));
        assert!(!counts.ended);
        assert_eq!(counts.p50_us, 1000);
    }

    #[test]
    fn uncounted_message_ends_count_only_after_counted_one() {
        assert!(!tracked(&[0, 0]).ended);
        assert!(tracked(&[0, 1, 0]).ended);
    }

    #[test]
    fn damage_is_counted_and_first_is_named() {
        let mut tracker = Tracker::new();
        tracker.handle(Err(Damage::Checksum), 0);
        tracker.handle(Ok(Stamp { seq: SEQ_MAX + 1, sent_ns: 0 }), 0);
        let counts = tracker.counts();
        assert_eq!((counts.corrupt, counts.received), (2, 0));
        assert_eq!(counts.damage, Some(Damage::Checksum.to_string()));
        assert!(!tracker.is_alive());
        assert!(tracker.seen.is_empty());
    }
}
