//! Published messages that a source keeps for late joiners, and for sinks with losses.
//!
//! One queue of consecutive numbers serves both; each has its own end of it. Payloads are references.

use std::collections::VecDeque;

use bytes::Bytes;
use sgc_wire::{MessageHead, MessageKind};

/// Messages that a reliable source keeps for recovery.
pub const RECOVERY_MESSAGES_MAX: usize = 4096;
/// Bytes of those; the newest message is kept whatever its size.
pub const RECOVERY_BYTES_MAX: usize = 16 << 20;

/// Size of a kept message beyond its payload, bytes.
const KEPT_OVERHEAD_BYTES: usize = 64;

/// Messages that a reliable source keeps for recovery. Bounds are number and bytes: they bound memory, and a bound by
/// age would drop messages that are asked for after a long interruption, when nobody else has them.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct RecoveryLimits {
    /// Messages, marks among them; 0 if lost messages stay lost.
    pub messages_max: usize,
    /// Bytes.
    pub bytes_max: usize,
}

impl RecoveryLimits {
    /// Keeps nothing: nobody can ask for lost messages.
    pub const NONE: Self = Self { messages_max: 0, bytes_max: 0 };
}

impl Default for RecoveryLimits {
    fn default() -> Self {
        Self { messages_max: RECOVERY_MESSAGES_MAX, bytes_max: RECOVERY_BYTES_MAX }
    }
}

/// A message as it was published.
pub(crate) struct HistoryEntry {
    pub(crate) seq: u64,
    pub(crate) head: MessageHead,
    pub(crate) payload: Bytes,
}

impl HistoryEntry {
    pub(crate) fn is_mark(&self) -> bool {
        self.head.kind == MessageKind::Mark
    }

    fn bytes(&self) -> usize {
        self.payload.len() + KEPT_OVERHEAD_BYTES
    }
}

/// The newest part of the queue, for one of its purposes.
struct Tail {
    from: u64,
    numbers: usize,
    /// Messages that are no marks.
    messages: usize,
    bytes: usize,
}

impl Tail {
    fn add(&mut self, kept: &HistoryEntry) {
        self.numbers += 1;
        self.messages += usize::from(!kept.is_mark());
        self.bytes += kept.bytes();
    }

    fn drop_first(&mut self, first: &HistoryEntry) {
        self.from = first.seq + 1;
        self.numbers -= 1;
        self.messages -= usize::from(!first.is_mark());
        self.bytes -= first.bytes();
    }
}

pub(crate) struct History {
    depth: usize,
    bytes_max: usize,
    recovery: RecoveryLimits,
    /// Consecutive numbers, up to the last published.
    kept: VecDeque<HistoryEntry>,
    /// Messages for late joiners.
    late: Tail,
    /// Messages for recovery.
    recent: Tail,
}

impl History {
    /// Returns a history of `depth` messages of at most `bytes_max` for late joiners. The first message has the number
    /// `from`.
    pub(crate) fn new(from: u64, depth: usize, bytes_max: usize, recovery: RecoveryLimits) -> Self {
        let tail = || Tail { from, numbers: 0, messages: 0, bytes: 0 };
        Self { depth, bytes_max, recovery, kept: VecDeque::new(), late: tail(), recent: tail() }
    }

    /// Takes the next message.
    pub(crate) fn push(&mut self, message: HistoryEntry) {
        let next = message.seq + 1;
        self.late.add(&message);
        self.recent.add(&message);
        self.kept.push_back(message);
        self.trim_late();
        let front = self.front();
        let at = |tail: &Tail| (tail.from - front) as usize;
        while self.recovery.messages_max > 0
            && (self.recent.numbers > self.recovery.messages_max
                || self.recent.bytes > self.recovery.bytes_max)
            && let Some(first) = self.kept.get(at(&self.recent))
            && (first.is_mark() || self.recent.messages > 1)
        {
            self.recent.drop_first(first);
        }
        if self.depth == 0 {
            self.late = Tail { from: next, numbers: 0, messages: 0, bytes: 0 };
        }
        if self.recovery.messages_max == 0 {
            self.recent = Tail { from: next, numbers: 0, messages: 0, bytes: 0 };
        }
        self.drop_unused();
    }

    /// Sets the number of messages for late joiners, at least one if it kept any.
    pub(crate) fn set_depth(&mut self, depth: usize) {
        if self.depth > 0 {
            self.depth = depth.max(1);
            self.trim_late();
            self.drop_unused();
        }
    }

    fn trim_late(&mut self) {
        let front = self.front();
        // Marks are small, and only their bytes count for late joiners.
        while self.depth > 0
            && (self.late.messages > self.depth || self.late.bytes > self.bytes_max)
            && let Some(first) = self.kept.get((self.late.from - front) as usize)
            && (first.is_mark() || self.late.messages > 1)
        {
            self.late.drop_first(first);
        }
    }

    fn drop_unused(&mut self) {
        let from = self.late.from.min(self.recent.from);
        while self.kept.front().is_some_and(|m| m.seq < from) {
            self.kept.pop_front();
        }
    }

    /// Returns the oldest number to keep; that of late joiners if there is none.
    fn front(&self) -> u64 {
        self.kept.front().map_or(self.late.from, |m| m.seq)
    }

    /// Drops messages dated before `ns`, up to the first later one: dates of one publisher rise. Messages without a
    /// date stay; marks go too.
    pub(crate) fn expire(&mut self, ns: i64) {
        while let Some(first) = self.kept.front()
            && (first.is_mark() || (1..ns).contains(&first.head.source_timestamp_ns))
            && self.kept.iter().any(|m| !m.is_mark())
        {
            for tail in [&mut self.late, &mut self.recent] {
                if tail.from <= first.seq && tail.numbers > 0 {
                    tail.drop_first(first);
                }
            }
            self.kept.pop_front();
        }
    }

    /// Returns the beginning of the history for late joiners: the next number if there is none.
    pub(crate) fn late_from(&self) -> u64 {
        self.late.from
    }

    /// Returns the oldest number that is here; the next one if there is none.
    pub(crate) fn oldest(&self) -> u64 {
        self.late.from.min(self.recent.from)
    }

    /// Returns the message published last, if it is here.
    pub(crate) fn newest(&self) -> Option<&HistoryEntry> {
        self.kept.back()
    }

    pub(crate) fn newest_mut(&mut self) -> Option<&mut HistoryEntry> {
        self.kept.back_mut()
    }

    /// Returns the kept messages of `from..=to`, as references that outlive a change.
    pub(crate) fn range(&self, from: u64, to: u64) -> Vec<(u64, MessageHead, Bytes)> {
        let begin = self.kept.partition_point(|m| m.seq < from);
        let asked = self.kept.iter().skip(begin).take_while(|m| m.seq <= to);
        asked.map(|m| (m.seq, m.head, m.payload.clone())).collect()
    }
}

#[cfg(test)]
mod tests {

    use super::*;

    fn history(depth: usize, bytes_max: usize, messages_max: usize, recovery_bytes_max: usize) -> History {
        History::new(1, depth, bytes_max, RecoveryLimits { messages_max, bytes_max: recovery_bytes_max })
    }

    fn push(history: &mut History, kind: MessageKind, bytes: usize) {
        let seq = history.newest().map_or(history.oldest(), |m| m.seq + 1);
        let head = MessageHead::new(kind, 0);
        history.push(HistoryEntry { seq, head, payload: vec![0; bytes].into() });
    }

    fn seqs(history: &History, from: u64) -> Vec<u64> {
        history.range(from, u64::MAX).iter().map(|(seq, ..)| *seq).collect()
    }

    #[test]
    fn each_purpose_has_its_own_bounds() {
        let mut history = history(2, 10_000, 5, 10_000);
        for _ in 0..8 {
            push(&mut history, MessageKind::Write, 10);
        }
        assert_eq!((history.late_from(), history.oldest()), (7, 4));
        assert_eq!(seqs(&history, 0), [4, 5, 6, 7, 8]);
        assert_eq!(seqs(&history, 7), [7, 8]);
        assert_eq!(seqs(&history, 9), []);
    }

    #[test]
    fn late_joiners_get_no_more_once_the_depth_is_known() {
        let mut history = history(100, 10_000, 2, 10_000);
        for n in 1..=9_i64 {
            let head = MessageHead::new(if n == 7 { MessageKind::Mark } else { MessageKind::Write }, n * 10);
            history.push(HistoryEntry { seq: n as u64, head, payload: vec![0; 8].into() });
        }
        history.set_depth(3);
        assert_eq!((history.late_from(), seqs(&history, 0)), (6, vec![6, 7, 8, 9]));
        push(&mut history, MessageKind::Write, 8);
        assert_eq!(history.late_from(), 7);
        history.set_depth(0);
        assert_eq!(history.late_from(), 10);
        let mut volatile = self::history(0, 10_000, 2, 10_000);
        volatile.set_depth(5);
        push(&mut volatile, MessageKind::Write, 8);
        assert_eq!(volatile.late_from(), 2);
    }

    #[test]
    fn marks_take_no_place_of_late_joiners() {
        let mut history = history(2, 10_000, 4, 10_000);
        for kind in [MessageKind::Write, MessageKind::Write, MessageKind::Mark, MessageKind::Mark] {
            push(&mut history, kind, 8);
        }
        assert_eq!((history.late_from(), history.oldest()), (1, 1));
        for _ in 0..5 {
            push(&mut history, MessageKind::Mark, 8);
        }
        assert_eq!(seqs(&history, history.late_from()).len(), 9);
        push(&mut history, MessageKind::Write, 8);
        assert_eq!((history.late_from(), seqs(&history, 2).len()), (2, 9));
    }

    #[test]
    fn the_newest_message_stays_whatever_its_size() {
        for depth in [0, 3] {
            let mut history = history(depth, 1000, 100, 1000);
            push(&mut history, MessageKind::Write, 500);
            push(&mut history, MessageKind::Write, 5000);
            assert_eq!(seqs(&history, 0), [2]);
            push(&mut history, MessageKind::Mark, 8);
            assert_eq!(seqs(&history, 0), [2, 3]);
            push(&mut history, MessageKind::Write, 10);
            assert_eq!((seqs(&history, 0).last(), history.oldest() > 2), (Some(&4), true));
        }
    }

    #[test]
    fn expired_messages_go_and_later_ones_stay() {
        let mut history = history(3, 10_000, 5, 10_000);
        for n in 1..=6_i64 {
            let kind = if n == 2 { MessageKind::Mark } else { MessageKind::Write };
            let head = MessageHead::new(kind, if n == 2 { 0 } else { n * 10 });
            history.push(HistoryEntry { seq: n as u64, head, payload: vec![0; 8].into() });
        }
        assert_eq!((history.late_from(), history.oldest()), (4, 2));
        history.expire(35);
        assert_eq!((history.late_from(), history.oldest(), seqs(&history, 0)), (4, 4, vec![4, 5, 6]));
        history.expire(55);
        assert_eq!((history.late_from(), history.oldest(), seqs(&history, 0)), (6, 6, vec![6]));
        history.expire(i64::MAX);
        assert_eq!((history.late_from(), history.oldest(), seqs(&history, 0).len()), (7, 7, 0));
        let head = MessageHead::new(MessageKind::Write, 70);
        history.push(HistoryEntry { seq: 7, head, payload: vec![0; 8].into() });
        assert_eq!((history.late_from(), history.oldest(), seqs(&history, 0)), (7, 7, vec![7]));
    }

    #[test]
    fn without_a_purpose_nothing_is_kept() {
        let mut history = history(0, 1000, 0, 0);
        for n in 1..4 {
            history.push(HistoryEntry {
                seq: n,
                head: MessageHead::new(MessageKind::Write, 0),
                payload: Bytes::from_static(b"x"),
            });
            assert_eq!((history.late_from(), history.oldest(), seqs(&history, 0).len()), (n + 1, n + 1, 0));
        }
    }
}
