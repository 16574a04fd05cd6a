//! [`Queue`]: the samples of a reader between Cyclone's receiving thread and a worker, and the states of both.
//!
//! It locks nothing and wakes nobody: [`crate::intake`] does.

use std::collections::VecDeque;
use std::sync::Arc;

use cyclors::{dds_instance_handle_t, ddsi_serdata};

use crate::backpressure::{Progress, Tally};

/// Most queued bytes of one reader; a single sample may be longer.
pub const WAITING_BYTES_MAX: usize = 64 << 20;

/// Bytes in a queue beyond which the samples of reliable writers are refused. Samples on their way still come.
const REFUSED_BYTES: usize = WAITING_BYTES_MAX / 4;

/// Divisor: the same for one part in this many of the samples that may be queued.
const REFUSED_PART: usize = 2;

/// Divisor: samples are accepted again once the queue has sunk to one part in this many of what began the refusal.
const ROOM_PART: usize = 2;

/// Most writers of one reader whose samples are refused. Samples of others are queued, and the oldest give way.
const REFUSED_WRITERS_MAX: usize = 1024;

/// Most queued liveliness changes of one reader. The oldest give way.
const LIVELINESS_CHANGES_MAX: usize = 1024;

/// A sample converted from Cyclone's.
pub(crate) trait FromSerdata: Send + Sized {
    /// Takes over a reference. Returns `None` for an unusable sample.
    ///
    /// # Safety
    /// The caller owns one reference to `sample`, which is of the type that `Self` is made of.
    unsafe fn from_raw(sample: *mut ddsi_serdata) -> Option<Self>;

    /// Returns the length of the payload in bytes.
    fn bytes(&self) -> usize;
}

/// A sample with the reader's information on it.
#[derive(Debug)]
pub(crate) struct Arrival<S> {
    pub(crate) sample: S,
    /// The writer, by the reader's handle.
    pub(crate) writer: dds_instance_handle_t,
    pub(crate) source_timestamp_ns: i64,
}

/// A change of a writer's liveliness.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) struct LivelinessChange {
    pub(crate) writer: dds_instance_handle_t,
    pub(crate) now: WriterState,
}

/// The state of a writer.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum WriterState {
    Alive,
    /// The lease expired.
    Lapsed,
    /// The writer is no longer matched.
    Gone,
}

/// An entry of a queue.
#[derive(Debug)]
pub(crate) enum Next<S> {
    Sample(Arrival<S>),
    Liveliness(LivelinessChange),
}

/// The queue of a reader.
#[derive(Debug)]
pub(crate) struct Queue<S> {
    arrivals: VecDeque<Arrival<S>>,
    bytes: usize,
    /// Most queued samples.
    depth: usize,
    /// The numbers of samples that were queued so far, and that left the queue.
    pushed: u64,
    popped: u64,
    /// Changes of liveliness, each with the number of samples before it.
    changes: VecDeque<(u64, LivelinessChange)>,
    overrun: u64,
    /// A worker is at work or about to begin.
    is_at_work: bool,
    is_stopped: bool,
    receiving: ReceivingState,
    /// The writers whose samples are refused, or were before.
    refused: Vec<RefusedWriter>,
}

/// A writer whose samples are refused until there is room, or were before.
#[derive(Debug)]
struct RefusedWriter {
    writer: dds_instance_handle_t,
    tally: Arc<Tally>,
    is_refused: bool,
}

/// The state of the receiving thread towards one reader.
#[derive(Clone, Copy, Debug)]
enum ReceivingState {
    Free,
    /// The receiving thread waits until the queue has sunk to the level.
    Held {
        until: Level,
        is_stuck: bool,
    },
    /// The receiving thread waited in vain, and nothing was taken since.
    Stuck,
}

/// An amount of samples in a queue.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Level {
    pub(crate) samples: usize,
    pub(crate) bytes: usize,
}

impl<S: FromSerdata> Queue<S> {
    /// Creates the queue of a worker that begins once the receiver is known.
    pub(crate) fn new(depth: usize) -> Self {
        Self {
            arrivals: VecDeque::new(),
            bytes: 0,
            depth,
            pushed: 0,
            popped: 0,
            changes: VecDeque::new(),
            overrun: 0,
            is_at_work: true,
            is_stopped: false,
            receiving: ReceivingState::Free,
            refused: Vec::new(),
        }
    }

    /// Returns one part in `part` of the allowed amount.
    pub(crate) fn level(&self, part: usize) -> Level {
        Level { samples: self.depth / part, bytes: WAITING_BYTES_MAX / part }
    }

    /// Returns `true` if the queue holds more than `level`.
    pub(crate) fn is_above(&self, level: Level) -> bool {
        self.arrivals.len() > level.samples || self.bytes > level.bytes
    }

    pub(crate) fn is_full_to(&self, part: usize) -> bool {
        self.is_above(self.level(part))
    }

    /// Appends a sample. The oldest samples give way if there is no room.
    pub(crate) fn push(&mut self, arrival: Arrival<S>) {
        let bytes = arrival.sample.bytes();
        while (self.arrivals.len() >= self.depth || self.bytes + bytes > WAITING_BYTES_MAX)
            && self.pop().is_some()
        {
            self.overrun += 1;
        }
        self.bytes += bytes;
        self.pushed += 1;
        self.arrivals.push_back(arrival);
    }

    /// Appends a change of liveliness behind the queued samples.
    pub(crate) fn push_change(&mut self, change: LivelinessChange) {
        if self.changes.len() >= LIVELINESS_CHANGES_MAX {
            self.changes.pop_front();
            tracing::debug!("a change of liveliness is dropped: too many wait");
        }
        self.changes.push_back((self.pushed, change));
    }

    pub(crate) fn is_stopped(&self) -> bool {
        self.is_stopped
    }

    /// Returns `true` if no worker is at work. The caller lets one begin.
    pub(crate) fn begin_to_work(&mut self) -> bool {
        !std::mem::replace(&mut self.is_at_work, true)
    }

    /// Lets the worker go if nothing is queued. Returns `true` if it may.
    pub(crate) fn begin_to_rest(&mut self) -> bool {
        self.is_at_work = !self.is_empty();
        !self.is_at_work
    }

    /// Hands out nothing more from here on. Returns `true` if a worker is at work.
    pub(crate) fn stop(&mut self) -> bool {
        self.is_stopped = true;
        self.is_at_work
    }

    /// Begins a wait of the receiving thread until the queue has sunk to the level.
    pub(crate) fn begin_hold(&mut self, until: Level) {
        self.receiving = ReceivingState::Held { until, is_stuck: true };
    }

    /// Returns `true` while the receiving thread has to wait.
    pub(crate) fn is_held(&self) -> bool {
        matches!(self.receiving, ReceivingState::Held { .. }) && !self.is_stopped()
    }

    /// Ends the wait of the receiving thread.
    pub(crate) fn end_hold(&mut self) {
        self.receiving = match self.receiving {
            ReceivingState::Held { is_stuck: true, .. } | ReceivingState::Stuck => ReceivingState::Stuck,
            ReceivingState::Held { is_stuck: false, .. } | ReceivingState::Free => ReceivingState::Free,
        };
    }

    /// Returns `true` if the receiving thread waited in vain and nothing was taken since.
    pub(crate) fn is_stuck(&self) -> bool {
        matches!(self.receiving, ReceivingState::Stuck | ReceivingState::Held { is_stuck: true, .. })
    }

    /// Counts a sample of a writer whose samples were refused before.
    pub(crate) fn count_arrival(&self, writer: dds_instance_handle_t) {
        if let Some(refused) = self.refused.iter().find(|refused| refused.writer == writer) {
            refused.tally.count_arrival();
        }
    }

    /// Returns the tally of a writer if the queue has grown so long that its samples are to be refused from here on.
    pub(crate) fn begin_to_refuse(
        &mut self,
        writer: dds_instance_handle_t,
        reader: &Arc<Progress>,
    ) -> Option<Arc<Tally>> {
        if !self.is_above(self.refused_level(1)) {
            return None;
        }
        if let Some(known) = self.refused.iter_mut().find(|refused| refused.writer == writer) {
            let begins = !std::mem::replace(&mut known.is_refused, true);
            return begins.then(|| Arc::clone(&known.tally));
        }
        // Nobody else has the tally of a writer that is gone.
        let overrun = &mut self.overrun;
        self.refused.retain(|refused| {
            let is_there = Arc::strong_count(&refused.tally) > 1;
            if !is_there {
                *overrun += refused.tally.take_lost();
            }
            is_there
        });
        let has_room = self.refused.len() < REFUSED_WRITERS_MAX;
        has_room.then(|| {
            let tally = Arc::new(Tally::new(Arc::clone(reader)));
            self.refused.push(RefusedWriter { writer, tally: Arc::clone(&tally), is_refused: true });
            tally
        })
    }

    /// Calls `accept` with each writer whose samples are accepted again: if there is room, if the queue is stopped, or
    /// if nothing is taken from it (`is_stuck`).
    pub(crate) fn accept(&mut self, is_stuck: bool, accept: impl Fn(dds_instance_handle_t, &Arc<Tally>)) {
        if self.is_above(self.refused_level(ROOM_PART)) && !self.is_stopped() && !is_stuck {
            return;
        }
        for refused in self.refused.iter_mut().filter(|refused| refused.is_refused) {
            refused.is_refused = false;
            accept(refused.writer, &refused.tally);
        }
    }

    fn refused_level(&self, part: usize) -> Level {
        Level { samples: self.depth / (REFUSED_PART * part), bytes: REFUSED_BYTES / part }
    }

    /// Returns the number of lost samples since the last call: those that gave way, and those that writers dropped
    /// while they were refused.
    pub(crate) fn take_overrun(&mut self) -> u64 {
        let lost: u64 = self.refused.iter().map(|refused| refused.tally.take_lost()).sum();
        std::mem::take(&mut self.overrun) + lost
    }

    pub(crate) fn is_empty(&self) -> bool {
        self.arrivals.is_empty() && self.changes.is_empty()
    }

    fn pop(&mut self) -> Option<Arrival<S>> {
        let arrival = self.arrivals.pop_front()?;
        self.bytes -= arrival.sample.bytes();
        self.popped += 1;
        Some(arrival)
    }

    /// Takes the oldest entry, and tells whether the receiving thread may continue.
    pub(crate) fn next(&mut self) -> (Option<Next<S>>, bool) {
        let is_due = self.changes.front().is_some_and(|(behind, _)| *behind <= self.popped);
        if let Some((_, change)) = is_due.then(|| self.changes.pop_front()).flatten() {
            return (Some(Next::Liveliness(change)), false);
        }
        let next = self.pop().map(Next::Sample);
        let may_go_on = match self.receiving {
            ReceivingState::Held { until, .. } => !self.is_above(until),
            ReceivingState::Free | ReceivingState::Stuck => false,
        };
        self.receiving = match self.receiving {
            ReceivingState::Held { until, .. } if !may_go_on => {
                ReceivingState::Held { until, is_stuck: false }
            }
            _ => ReceivingState::Free,
        };
        (next, may_go_on)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const CROWDED_PART: usize = 8;

    impl FromSerdata for usize {
        unsafe fn from_raw(sample: *mut ddsi_serdata) -> Option<Self> {
            Some(sample as Self)
        }

        fn bytes(&self) -> usize {
            *self
        }
    }

    /// Returns the lengths of the queued samples, and the number of dropped ones.
    fn waits(depth: usize, all: impl IntoIterator<Item = usize>) -> (Vec<usize>, u64) {
        let mut queue = Queue::new(depth);
        for bytes in all {
            queue.push(Arrival { sample: bytes, writer: 1, source_timestamp_ns: 0 });
            assert!(queue.bytes <= WAITING_BYTES_MAX.max(bytes));
        }
        let waits = std::iter::from_fn(|| queue.pop()).map(|a| a.sample).collect();
        assert_eq!(queue.bytes, 0);
        (waits, queue.overrun)
    }

    #[test]
    fn queue_is_bounded_in_samples_and_bytes() {
        assert_eq!(waits(3, 10..15), (vec![12, 13, 14], 2));
        const HALF: usize = WAITING_BYTES_MAX / 2;
        assert_eq!(waits(9, [5, HALF, HALF]), (vec![HALF, HALF], 1));
        assert_eq!(waits(9, [5, 7, WAITING_BYTES_MAX + 1]), (vec![WAITING_BYTES_MAX + 1], 2));
        assert_eq!(waits(9, [WAITING_BYTES_MAX + 1, 6]), (vec![6], 1));
    }

    #[test]
    fn held_reader_continues_once_half_of_the_queue_is_gone() {
        let mut queue = Queue::new(16 * CROWDED_PART);
        let push = |queue: &mut Queue<usize>, bytes| {
            queue.push(Arrival { sample: bytes, writer: 1, source_timestamp_ns: 0 });
            queue.is_full_to(CROWDED_PART)
        };
        assert!((0..16).all(|_| !push(&mut queue, 1)) && push(&mut queue, 1));
        queue.begin_hold(queue.level(2 * CROWDED_PART));
        for _ in 0..8 {
            assert!(!queue.next().1);
        }
        assert!(queue.next().1 && matches!(queue.receiving, ReceivingState::Free));
        assert!(!queue.next().1, "it was told");
        assert!(push(&mut queue, WAITING_BYTES_MAX / CROWDED_PART), "bytes count as well");
    }

    #[test]
    fn writers_are_refused_beyond_a_level_until_there_is_room_or_nothing_is_taken() {
        let mut queue = Queue::new(8);
        let reader = Arc::default();
        let push = |queue: &mut Queue<usize>, writer| {
            queue.count_arrival(writer);
            queue.push(Arrival { sample: 1, writer, source_timestamp_ns: 0 });
            queue.begin_to_refuse(writer, &reader)
        };
        let accepted = |queue: &mut Queue<usize>, is_stuck| {
            let all = std::cell::RefCell::new(Vec::new());
            queue.accept(is_stuck, |writer, _| all.borrow_mut().push(writer));
            all.into_inner()
        };
        assert!((0..4).all(|_| push(&mut queue, 1).is_none()));
        let first = push(&mut queue, 1).expect("half of the queue is full");
        assert!(push(&mut queue, 1).is_none(), "once");
        let second = push(&mut queue, 2).expect("another writer");
        assert_eq!(accepted(&mut queue, false), []);
        while queue.arrivals.len() > 2 {
            assert_eq!(accepted(&mut queue, false), []);
            queue.next();
        }
        assert_eq!(accepted(&mut queue, false), [1, 2]);
        assert_eq!(accepted(&mut queue, false), [], "once");
        // A reader that takes nothing accepts all, and refuses again later.
        (0..4).for_each(|_| drop(push(&mut queue, 3)));
        assert!(push(&mut queue, 1).is_some_and(|again| Arc::ptr_eq(&again, &first)));
        assert_eq!(accepted(&mut queue, true), [1, 3]);
        assert!(push(&mut queue, 1).is_some());
        // The tally of a writer that is gone leaves with what it counted.
        assert_eq!(queue.refused.len(), 3);
        drop((first, second));
        assert!(push(&mut queue, 4).is_some());
        assert_eq!(queue.refused.len(), 1);
    }

    #[test]
    fn changes_of_liveliness_keep_their_place_among_samples_and_have_a_bound() {
        let mut queue = Queue::new(3);
        let change = |writer| LivelinessChange { writer, now: WriterState::Lapsed };
        let sample = |bytes| Arrival { sample: bytes, writer: 1, source_timestamp_ns: 0 };
        queue.push_change(change(1));
        (0..2).for_each(|bytes| queue.push(sample(bytes)));
        queue.push_change(change(2));
        // The first sample gives way.
        (2..4).for_each(|bytes| queue.push(sample(bytes)));
        let order = std::iter::from_fn(|| match queue.next().0? {
            Next::Sample(arrival) => Some(format!("sample {}", arrival.sample)),
            Next::Liveliness(change) => Some(format!("change {}", change.writer)),
        });
        assert_eq!(order.collect::<Vec<_>>(), ["change 1", "sample 1", "change 2", "sample 2", "sample 3"]);
        let many = LIVELINESS_CHANGES_MAX as u64 + 7;
        (0..many).for_each(|writer| queue.push_change(change(writer)));
        assert_eq!(queue.changes.len(), LIVELINESS_CHANGES_MAX);
        assert!(matches!(queue.next().0, Some(Next::Liveliness(c)) if c.writer == 7));
    }
}
