//! Pacing of a local writer's samples.
//!
//! [`Burst`] waits for acknowledgements of local readers, and [`Room`] tells whether a sample can be written at once.
//! Neither queues messages; [`crate::data::writer_queue`] does.

use std::sync::atomic::{AtomicU32, Ordering::Relaxed};
use std::sync::{Arc, Mutex, MutexGuard};
use std::thread;
use std::time::{Duration, Instant};

use sgc_ros::RosWriter;
use sgc_sync::lock;
use sgc_wire::SourceId;

use crate::data::spacing::Spacing;

/// Longest wait of a burst for acknowledgements of local readers.
const ACKNOWLEDGED_WAIT_MAX: Duration = Duration::from_secs(1);
/// Time during which no burst waits again after a local reader acknowledged nothing.
const STALLED_READER_PAUSE: Duration = Duration::from_secs(10);

/// Paces messages that arrive in a burst after an interruption. A reliable writer that keeps the last samples never
/// blocks, so a burst would overwrite itself before readers take it. Its publisher spread the messages over time.
#[derive(Default)]
pub(crate) struct Burst {
    pub(crate) room: Arc<Room>,
    /// No wait before this time, because a reader is stalled.
    not_before: Option<Instant>,
}

/// Upper bound of a writer's unacknowledged samples. Only the holder of the consumer's lock changes it.
#[derive(Default)]
pub(crate) struct Room {
    unacknowledged: AtomicU32,
    /// The smallest number of samples that the writer kept at a write since none was unacknowledged.
    kept_min: AtomicU32,
    /// When the last message was written, and its time stamp.
    last: Mutex<Option<(Instant, i64)>>,
    spacing: Mutex<Spacing>,
}

impl Room {
    /// Returns `true` if a message of this size and time can be written without overwriting one that a reader may lack.
    /// Never waits.
    pub(crate) fn is_there(&self, writer: &impl RosWriter, bytes: usize, timestamp_ns: i64) -> bool {
        let Some(kept) = writer.kept(bytes) else { return true };
        let kept = self.kept(kept);
        if self.unacknowledged.load(Relaxed) < kept || self.is_in_its_time(timestamp_ns) {
            return true;
        }
        let acknowledged = || writer.wait_acknowledged(Duration::ZERO).then_some(0);
        let Some(unacknowledged) = writer.unacknowledged().or_else(acknowledged) else { return false };
        self.unacknowledged.store(unacknowledged, Relaxed);
        unacknowledged < kept
    }

    /// Returns the number of samples that can be unacknowledged, given the number that the writer keeps of the next
    /// one's size. Unacknowledged long samples leave less room for short ones.
    fn kept(&self, of_next: u32) -> u32 {
        match self.unacknowledged.load(Relaxed) {
            0 => of_next,
            _ => of_next.min(self.kept_min.load(Relaxed)),
        }
    }

    /// Returns `true` if the time since the last write is about the publisher's interval. Readers then have the time
    /// that the publisher would have given them, and acknowledge no more often.
    fn is_in_its_time(&self, timestamp_ns: i64) -> bool {
        let Some((written, published_ns)) = *self.last() else { return false };
        let apart = timestamp_ns.checked_sub(published_ns).and_then(|ns| u64::try_from(ns).ok());
        apart.is_some_and(|ns| ns > 0 && written.elapsed() >= Duration::from_nanos(ns / 2))
    }

    /// Waits until a message may be written, and records the write.
    pub(crate) fn space(&self, writer: &impl RosWriter, source: SourceId, published_ns: i64) {
        let wait = self.spacing().wait(Instant::now(), source, published_ns);
        if let Some(wait) = wait {
            writer.flush();
            thread::sleep(wait);
        }
        self.spacing().note(Instant::now(), source, published_ns);
    }

    pub(crate) fn spacing(&self) -> MutexGuard<'_, Spacing> {
        lock(&self.spacing)
    }

    fn last(&self) -> MutexGuard<'_, Option<(Instant, i64)>> {
        lock(&self.last)
    }
}

impl Burst {
    /// Waits while a sample of this size would overwrite one that a reader may lack. A single sample is written at
    /// once, as its publisher did.
    pub(crate) fn before_next(
        &mut self,
        writer: &impl RosWriter,
        is_alone: bool,
        bytes: usize,
        timestamp_ns: i64,
    ) {
        let Some(of_next) = writer.kept(bytes) else { return };
        let kept = self.room.kept(of_next);
        let mut unacknowledged = self.room.unacknowledged.load(Relaxed);
        if unacknowledged >= kept {
            unacknowledged = writer.unacknowledged().unwrap_or(unacknowledged);
        }
        // A single sample is acknowledged, or waited for, before the next burst.
        let waits = !is_alone && self.not_before.is_none_or(|at| Instant::now() >= at);
        if waits && unacknowledged >= kept {
            let acknowledged = writer.wait_acknowledged(ACKNOWLEDGED_WAIT_MAX);
            // A slow reader that acknowledged some is not stalled.
            let left = writer.unacknowledged().filter(|_| !acknowledged);
            let is_stalled = !acknowledged && left.is_none_or(|left| left >= kept);
            self.not_before = is_stalled.then(|| Instant::now() + STALLED_READER_PAUSE);
            unacknowledged = left.unwrap_or(0);
        }
        let kept_min = if unacknowledged == 0 { of_next } else { kept };
        self.room.kept_min.store(kept_min, Relaxed);
        self.room.unacknowledged.store(unacknowledged.saturating_add(1), Relaxed);
        *self.room.last() = Some((Instant::now(), timestamp_ns));
    }
}

#[cfg(test)]
mod tests {
    use std::sync::atomic::{AtomicBool, AtomicUsize};

    use bytes::Bytes;
    use sgc_ros::{Guid, RosError, SampleHead};

    use super::*;

    struct Slow {
        kept: Option<u32>,
        /// The count that it knows, if it knows one, before and after a wait.
        unacknowledged: [Option<u32>; 2],
        waited: AtomicUsize,
        stands_still: AtomicBool,
    }

    impl Slow {
        fn new(kept: Option<u32>) -> Self {
            Self {
                kept,
                unacknowledged: [None; 2],
                waited: AtomicUsize::new(0),
                stands_still: AtomicBool::new(false),
            }
        }
    }

    impl RosWriter for Slow {
        fn write_ahead(&self, _: SampleHead, _: Bytes) -> Result<(), RosError> {
            Ok(())
        }

        fn kept(&self, bytes: usize) -> Option<u32> {
            // Half as many long messages are kept.
            self.kept.map(|kept| if bytes > 1000 { kept / 2 } else { kept })
        }

        fn unacknowledged(&self) -> Option<u32> {
            let [before, after] = self.unacknowledged;
            if self.waited.load(Relaxed) == 0 { before } else { after }
        }

        fn wait_acknowledged(&self, _: Duration) -> bool {
            self.waited.fetch_add(1, Relaxed);
            !self.stands_still.load(Relaxed)
        }

        fn matched_readers(&self) -> u32 {
            1
        }

        fn wait_matched(&self, _: u32, _: Duration) -> u32 {
            1
        }

        fn guid(&self) -> Guid {
            Guid([0; 16])
        }
    }

    #[test]
    fn a_burst_waits_for_its_readers_but_not_for_one_that_stands_still() {
        let writer = Slow::new(Some(10));
        let mut burst = Burst::default();
        (0..100).for_each(|_| burst.before_next(&writer, true, 8, 0));
        assert_eq!(writer.waited.load(Relaxed), 0, "each alone");
        (0..100).for_each(|_| burst.before_next(&writer, false, 8, 0));
        assert_eq!(writer.waited.load(Relaxed), 10);
        (0..100).for_each(|_| burst.before_next(&writer, false, 2000, 0));
        assert_eq!(writer.waited.load(Relaxed), 30, "fewer of long ones are kept");
        writer.stands_still.store(true, Relaxed);
        (0..1000).for_each(|_| burst.before_next(&writer, false, 8, 0));
        assert!(writer.waited.load(Relaxed) <= 32, "once in a while");
        // A burst does not wait for samples that were acknowledged meanwhile.
        let acknowledging = Slow { unacknowledged: [Some(3); 2], ..Slow::new(Some(10)) };
        let mut burst = Burst::default();
        (0..100).for_each(|_| burst.before_next(&acknowledging, false, 8, 0));
        assert_eq!(acknowledging.waited.load(Relaxed), 0);
        // A reader that acknowledged some in the longest wait is slow, and not stalled.
        for (after, is_stalled) in [(4, false), (10, true)] {
            let lagging = Slow { unacknowledged: [Some(10), Some(after)], ..Slow::new(Some(10)) };
            lagging.stands_still.store(true, Relaxed);
            let mut burst = Burst::default();
            (0..11).for_each(|_| burst.before_next(&lagging, false, 8, 0));
            assert_eq!((lagging.waited.load(Relaxed), burst.not_before.is_some()), (1, is_stalled));
            assert_eq!(burst.room.unacknowledged.load(Relaxed), after + 1);
        }
        let (writer, mut other) = (Slow::new(None), Burst::default());
        (0..100).for_each(|_| other.before_next(&writer, false, 8, 0));
        assert_eq!(writer.waited.load(Relaxed), 0, "one that blocks by itself");
    }

    #[test]
    fn short_samples_overwrite_no_long_ones_that_are_unacknowledged() {
        let writer = Slow::new(Some(10));
        let mut burst = Burst::default();
        (0..5).for_each(|_| burst.before_next(&writer, false, 2000, 0));
        assert_eq!(writer.waited.load(Relaxed), 0);
        burst.before_next(&writer, false, 8, 0);
        assert_eq!(writer.waited.load(Relaxed), 1, "five long ones are kept");
        // The long ones are acknowledged, so ten short ones are kept again.
        (0..9).for_each(|_| burst.before_next(&writer, false, 8, 0));
        assert_eq!(writer.waited.load(Relaxed), 1);
        let stuck = Slow::new(Some(10));
        stuck.stands_still.store(true, Relaxed);
        let mut burst = Burst::default();
        (0..5).for_each(|_| burst.before_next(&stuck, true, 2000, 0));
        assert!(!burst.room.is_there(&stuck, 8, 0));
    }

    #[test]
    fn there_is_room_while_what_was_written_is_acknowledged() {
        let writer = Slow::new(Some(10));
        let mut burst = Burst::default();
        for _ in 0..35 {
            assert!(burst.room.is_there(&writer, 8, 0));
            burst.before_next(&writer, true, 8, 0);
        }
        assert_eq!(writer.waited.load(Relaxed), 3, "asked when as many were written as are kept");
        writer.stands_still.store(true, Relaxed);
        for _ in 0..5 {
            assert!(burst.room.is_there(&writer, 8, 0));
            burst.before_next(&writer, true, 8, 0);
        }
        assert!(!burst.room.is_there(&writer, 8, 0), "ten are under way");
        assert!(Burst::default().room.is_there(&Slow::new(None), 8, 0));
        // Messages at their publisher's pace need no more room than it had; messages in a burst do.
        let hour_ns = 3_600_000_000_000;
        assert!(!burst.room.is_there(&writer, 8, hour_ns) && !burst.room.is_there(&writer, 8, -1));
        let begun = Instant::now();
        while !burst.room.is_there(&writer, 8, 1_000_000) {
            assert!(begun.elapsed() < Duration::from_secs(20));
            thread::yield_now();
        }
        assert!(!burst.room.is_there(&writer, 8, hour_ns));
    }
}
