//! The stage that keeps samples in order: those that wait for their source or their type, and batches that are open.
//!
//! One sample passes at a time, because the lock is held until the stages behind have sent it. They decide whether a
//! sample can pass ([`Downstream`]).

use std::sync::atomic::{AtomicUsize, Ordering::SeqCst, fence};
use std::sync::{Arc, Mutex, MutexGuard};
use std::time::Instant;

use sgc_ros::Sample;
use sgc_sync::lock;

use crate::data::pending::{PendingBytes, PendingQueue};
use crate::data::sending::source_map::SourceSlot;
use crate::data::stats::{DataDrop, Dropped};

/// Samples that may wait until their writer is discovered or their type is known.
pub(crate) const EARLY_SAMPLES_MAX: usize = 256;

/// Holds the samples of one share.
pub(crate) struct HoldStage {
    inbox: Mutex<Inbox>,
    /// Number of waiting samples. It is readable without the lock, which a blocked publisher holds.
    waiting: AtomicUsize,
}

/// Samples and sources that wait.
struct Inbox {
    /// Samples without a source or a type. DDS may deliver a late joiner's history before it discovers the writer, and
    /// samples to convert to JSON wait for their type.
    early: PendingQueue<Sample>,
    /// Sources that expect more messages and keep an unfinished batch.
    open: Vec<SourceSlot>,
}

/// The stages behind the hold.
pub(crate) trait Downstream {
    /// Sends a sample, unless its source or its type is unknown. With `more`, the source may keep an unfinished batch.
    fn pass(&self, sample: Sample, more: bool) -> PassOutcome;

    /// Finishes the open batch of a source, because no more messages follow.
    fn finish_batch(&self, source: &SourceSlot);

    /// Returns `true` if no sample can pass, because its type may still become known.
    fn awaits_type(&self) -> bool;

    /// Returns `true` if a waiting sample is useless when late.
    fn is_useless_late(&self, sample: &Sample) -> bool;

    /// Counts samples that were dropped while they waited.
    fn count_given_up(&self, dropped: Dropped);
}

/// The fate of a sample behind the hold.
pub(crate) enum PassOutcome {
    /// The sample was sent or dropped.
    Done,
    /// The sample was sent, and its source may keep an unfinished batch.
    Open(SourceSlot),
    /// The sample has to wait.
    Waits(Sample),
}

/// The right to send a sample past an empty hold. No other sample passes meanwhile.
pub(crate) struct Bypass<'a> {
    _inbox: MutexGuard<'a, Inbox>,
}

impl HoldStage {
    /// Creates an empty stage. `pending` counts the bytes that all topics keep.
    pub(crate) fn new(pending: Arc<PendingBytes>) -> Self {
        let early = PendingQueue::new(EARLY_SAMPLES_MAX, pending);
        Self { inbox: Mutex::new(Inbox { early, open: Vec::new() }), waiting: AtomicUsize::new(0) }
    }

    /// Passes a sample on behind those that wait, or holds it.
    pub(crate) fn publish(&self, sample: Sample, next: &impl Downstream) {
        let more = sample.more;
        let mut inbox = lock(&self.inbox);
        self.pass_early(&mut inbox, next);
        if let Some(sample) = inbox.pass(sample, more, next) {
            let reason = if next.awaits_type() { DataDrop::NoDefinition } else { DataDrop::Stale };
            let given_up = inbox.early.push(Instant::now(), sample.payload.len(), sample);
            if let Err(dropped) = Dropped::check(reason, given_up) {
                next.count_given_up(dropped);
            }
            self.waiting.store(inbox.early.len(), SeqCst);
            // The source may have been added between the two checks. A later `set_map` sees the waiting sample.
            self.pass_early(&mut inbox, next);
        }
        if !more {
            inbox.finish_batches(next);
        }
    }

    /// Passes on the samples that need not wait any more. Blocks while another one passes.
    pub(crate) fn publish_early(&self, next: &impl Downstream) {
        let mut inbox = lock(&self.inbox);
        self.pass_early(&mut inbox, next);
        inbox.finish_batches(next);
    }

    /// Finishes open batches, because no more messages follow. Blocks while a sample passes.
    pub(crate) fn finish_batches(&self, next: &impl Downstream) {
        lock(&self.inbox).finish_batches(next);
    }

    /// Returns `true` if samples wait. The caller has changed what they wait for: the fence orders that change before
    /// the look, as the fence in `pass_early` orders the number of waiting samples before the look at the change.
    pub(crate) fn has_waiting(&self) -> bool {
        fence(SeqCst);
        self.waiting.load(SeqCst) > 0
    }

    /// Lets a sample past the hold if nothing waits, no batch is open, and no other sample passes.
    pub(crate) fn try_bypass(&self) -> Option<Bypass<'_>> {
        // The holder of the lock may be blocked.
        let inbox = self.inbox.try_lock().ok()?;
        (inbox.early.is_empty() && inbox.open.is_empty()).then_some(Bypass { _inbox: inbox })
    }

    /// Passes on in order the waiting samples whose writers have a source now. The caller finishes batches, or
    /// publishes more.
    fn pass_early(&self, inbox: &mut Inbox, next: &impl Downstream) {
        if inbox.early.is_empty() {
            return;
        }
        fence(SeqCst);
        let (now, mut late) = (Instant::now(), 0);
        if next.awaits_type() {
            late = inbox.early.give_up_late(now, |sample| next.is_useless_late(sample));
        } else {
            for mut held in inbox.early.take() {
                if held.is_late(now) && next.is_useless_late(&held.item) {
                    late += 1;
                    continue;
                }
                if let Some(sample) = inbox.pass(held.item, true, next) {
                    held.item = sample;
                    inbox.early.push_back(held);
                }
            }
        }
        if let Err(dropped) = Dropped::check(DataDrop::NoDefinition, late) {
            next.count_given_up(dropped);
        }
        self.waiting.store(inbox.early.len(), SeqCst);
    }
}

impl Inbox {
    /// Passes a sample on, and notes a batch that stays open. Returns the sample if it has to wait: also behind an earlier
    /// one of its writer, which may have become known since that one was looked at.
    fn pass(&mut self, sample: Sample, more: bool, next: &impl Downstream) -> Option<Sample> {
        if self.early.iter().any(|earlier| earlier.writer == sample.writer) {
            return Some(sample);
        }
        match next.pass(sample, more) {
            PassOutcome::Done => {}
            PassOutcome::Open(slot) => {
                if self.open.iter().all(|open| open.id != slot.id) {
                    self.open.push(slot);
                }
            }
            PassOutcome::Waits(sample) => return Some(sample),
        }
        None
    }

    fn finish_batches(&mut self, next: &impl Downstream) {
        for slot in self.open.drain(..) {
            next.finish_batch(&slot);
        }
    }
}

#[cfg(test)]
mod tests {
    use std::cell::{Cell, RefCell};

    use sgc_ros::Guid;

    use super::*;
    use crate::data::pending::PENDING_MAX;
    use crate::data::sending::fixtures::{KNOWN, STRANGER, sample, slot_with_id};

    /// Stages that note what comes to them.
    struct Recorder {
        slot: SourceSlot,
        known: RefCell<Vec<Guid>>,
        awaits_type: Cell<bool>,
        keeps_history: Cell<bool>,
        /// Looks at samples of strangers after which they are known.
        known_after: Cell<usize>,
        /// Time stamps of sent samples; 0 is the end of a batch.
        sent: RefCell<Vec<i64>>,
        dropped: RefCell<Vec<Dropped>>,
    }

    impl Recorder {
        fn new() -> Self {
            Self {
                slot: slot_with_id(1),
                known: vec![KNOWN].into(),
                awaits_type: Cell::new(false),
                keeps_history: Cell::new(false),
                known_after: Cell::new(usize::MAX),
                sent: RefCell::default(),
                dropped: RefCell::default(),
            }
        }
    }

    impl Downstream for Recorder {
        fn pass(&self, sample: Sample, more: bool) -> PassOutcome {
            let is_known = sample.writer.is_some_and(|writer| self.known.borrow().contains(&writer));
            if !is_known || self.awaits_type.get() {
                self.known_after.set(self.known_after.get().saturating_sub(1));
                if self.known_after.get() == 0 {
                    self.known.borrow_mut().push(STRANGER);
                }
                return PassOutcome::Waits(sample);
            }
            self.sent.borrow_mut().push(sample.source_timestamp_ns);
            if more { PassOutcome::Open(self.slot.clone()) } else { PassOutcome::Done }
        }

        fn finish_batch(&self, _: &SourceSlot) {
            self.sent.borrow_mut().push(0);
        }

        fn awaits_type(&self) -> bool {
            self.awaits_type.get()
        }

        fn is_useless_late(&self, _: &Sample) -> bool {
            !self.keeps_history.get()
        }

        fn count_given_up(&self, dropped: Dropped) {
            self.dropped.borrow_mut().push(dropped);
        }
    }

    fn dated(writer: Guid, source_timestamp_ns: i64, more: bool) -> Sample {
        Sample { source_timestamp_ns, ..sample(writer, more) }
    }

    #[test]
    fn waiting_samples_pass_in_order_once_their_writer_is_known() {
        let (stage, next) = (HoldStage::new(Arc::default()), Recorder::new());
        stage.publish(dated(STRANGER, 1, true), &next);
        stage.publish(dated(KNOWN, 2, true), &next);
        stage.publish(dated(STRANGER, 3, false), &next);
        // The batch of the known writer is finished, although the last sample waits.
        assert_eq!((next.sent.take(), stage.has_waiting()), (vec![2, 0], true));
        next.known.borrow_mut().push(STRANGER);
        stage.publish(dated(KNOWN, 4, false), &next);
        assert_eq!((next.sent.take(), stage.has_waiting()), (vec![1, 3, 4, 0], false));
        assert!(next.dropped.take().is_empty());
        // A change also lets them pass without another sample.
        next.awaits_type.set(true);
        stage.publish(dated(KNOWN, 5, true), &next);
        next.awaits_type.set(false);
        stage.publish_early(&next);
        assert_eq!((next.sent.take(), stage.has_waiting()), (vec![5, 0], false));
    }

    #[test]
    fn writer_that_becomes_known_between_two_looks_keeps_its_order() {
        for looks in 1..10 {
            let (stage, next) = (HoldStage::new(Arc::default()), Recorder::new());
            (1..=3).for_each(|timestamp| stage.publish(dated(STRANGER, timestamp, true), &next));
            assert!(next.sent.take().is_empty());
            next.known_after.set(looks);
            stage.publish(dated(STRANGER, 4, true), &next);
            stage.publish(dated(STRANGER, 5, true), &next);
            next.known.borrow_mut().push(STRANGER);
            stage.publish_early(&next);
            assert_eq!(next.sent.take(), [1, 2, 3, 4, 5, 0], "known after {looks} looks");
        }
    }

    #[test]
    fn oldest_waiting_samples_make_room() {
        let (stage, next) = (HoldStage::new(Arc::default()), Recorder::new());
        for (awaits_type, reason) in [(false, DataDrop::Stale), (true, DataDrop::NoDefinition)] {
            next.awaits_type.set(awaits_type);
            next.dropped.borrow_mut().clear();
            (0..EARLY_SAMPLES_MAX + 2).for_each(|_| stage.publish(dated(STRANGER, 1, false), &next));
            let dropped = next.dropped.take();
            assert!(dropped.len() >= 2 && dropped.iter().all(|each| *each == Dropped::one(reason)));
        }
    }

    #[test]
    fn late_sample_is_dropped_unless_it_is_kept_for_late_joiners() {
        let (stage, next) = (HoldStage::new(Arc::default()), Recorder::new());
        let long_ago = Instant::now().checked_sub(2 * PENDING_MAX).unwrap();
        let lost = Dropped::one(DataDrop::NoDefinition);
        for (awaits_type, keeps_history) in [(true, true), (true, false), (false, true), (false, false)] {
            next.awaits_type.set(awaits_type);
            next.keeps_history.set(keeps_history);
            lock(&stage.inbox).early.push(long_ago, 1, dated(KNOWN, 1, false));
            stage.publish(dated(KNOWN, 2, false), &next);
            assert_eq!(next.dropped.take(), if keeps_history { vec![] } else { vec![lost] });
            assert_eq!(stage.has_waiting(), awaits_type);
            next.awaits_type.set(false);
            stage.publish_early(&next);
            assert_eq!(next.sent.take().contains(&1), keeps_history);
        }
    }

    #[test]
    fn sample_bypasses_only_an_empty_hold() {
        let (stage, next) = (HoldStage::new(Arc::default()), Recorder::new());
        {
            let first = stage.try_bypass();
            assert!(first.is_some() && stage.try_bypass().is_none(), "one sample passes at a time");
        }
        stage.publish(dated(KNOWN, 1, true), &next);
        assert!(stage.try_bypass().is_none(), "a batch is open");
        stage.finish_batches(&next);
        assert!(stage.try_bypass().is_some());
        stage.publish(dated(STRANGER, 2, false), &next);
        assert!(stage.try_bypass().is_none(), "a sample waits");
    }
}
