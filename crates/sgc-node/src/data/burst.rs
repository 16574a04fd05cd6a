//! Pacing of a local writer's samples.
//!
//! [`Burst`] waits for acknowledgements of local readers, and [`Room`] tells whether a sample can be written at once.
//! Neither queues messages; [`crate::data::writer_queue`] does.

use std::sync::atomic::{AtomicU32, Ordering::Relaxed};
use std::sync::{Arc, Mutex, MutexGuard};
use std::thread;
use std::time::{Duration, Instant};

use sgc_ros::{RosWriter, UNACKNOWLEDGED_MIN};
use sgc_sync::lock;
use sgc_wire::SourceId;

use crate::data::spacing::Spacing;

/// Longest wait for acknowledgements of local readers.
const ACKNOWLEDGED_WAIT_MAX: Duration = Duration::from_secs(1);
/// Interval of looks for room during a wait, which otherwise lasts until all is acknowledged.
const LOOK_EVERY: Duration = Duration::from_millis(20);
/// Time after a wait in vain before a burst waits again.
const STALLED_READER_PAUSE: Duration = Duration::from_secs(10);

/// Holds back messages that would overwrite others. A reliable writer that keeps the last samples never blocks, so
/// messages that come in a burst, or while a reader pauses, would overwrite themselves before readers take them.
#[derive(Default)]
pub(crate) struct Burst {
    pub(crate) room: Arc<Room>,
    /// No message waits before this time, because a reader acknowledged nothing for so long.
    stalled_until: Option<Instant>,
}

/// How a message came to a writer.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Arrival {
    /// Others follow it at once.
    InBurst,
    Alone,
    /// Alone, and the caller may not wait.
    AtOnce,
}

/// Upper bound of a writer's unacknowledged samples. Only the holder of the consumer's lock changes it.
#[derive(Default)]
pub(crate) struct Room {
    unacknowledged: AtomicU32,
    /// The smallest number of samples that the writer kept at a write since none was unacknowledged.
    kept_min: AtomicU32,
    written: Mutex<Written>,
    spacing: Mutex<Spacing>,
}

/// Times of writes.
#[derive(Clone, Copy, Default)]
struct Written {
    /// When the last message was written, and its time stamp.
    last: Option<(Instant, i64)>,
    /// When the first one was written since readers were last seen to acknowledge.
    first: Option<Instant>,
}

impl Room {
    /// Returns `true` if a message of this size and time can be written without overwriting one that a reader may lack.
    /// Never waits.
    pub(crate) fn is_there(&self, writer: &impl RosWriter, bytes: usize, timestamp_ns: i64) -> bool {
        let Some(kept) = writer.kept(bytes) else { return true };
        let kept = self.kept(kept);
        self.unacknowledged.load(Relaxed) < kept
            || (!is_deep(kept) && self.is_in_its_time(timestamp_ns))
            || self.look(writer, kept) < kept
    }

    /// Looks how many samples are unacknowledged, without waiting.
    fn look(&self, writer: &impl RosWriter, kept: u32) -> u32 {
        let acknowledged = || writer.wait_acknowledged(Duration::ZERO).then_some(0);
        let Some(unacknowledged) = writer.unacknowledged().or_else(acknowledged) else { return u32::MAX };
        self.unacknowledged.store(unacknowledged, Relaxed);
        if unacknowledged < kept {
            self.written().first = None;
        }
        unacknowledged
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
        let Some((written, published_ns)) = self.written().last else { return false };
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

    fn written(&self) -> MutexGuard<'_, Written> {
        lock(&self.written)
    }
}

/// Returns `true` if a writer that keeps so many samples may have a publisher that keeps all: Fast DDS does not announce
/// that. Other writers keep as few as their publishers, which overwrite, too.
fn is_deep(kept: u32) -> bool {
    kept >= UNACKNOWLEDGED_MIN
}

impl Burst {
    /// Waits while a sample of this size would overwrite one that a reader may lack. A single sample of a writer that
    /// keeps few is written at once, as its publisher did.
    pub(crate) fn before_next(
        &mut self,
        writer: &impl RosWriter,
        arrival: Arrival,
        bytes: usize,
        timestamp_ns: i64,
    ) {
        let Some(of_next) = writer.kept(bytes) else { return };
        let room = &self.room;
        let kept = room.kept(of_next);
        let mut unacknowledged = room.unacknowledged.load(Relaxed);
        if unacknowledged >= kept {
            unacknowledged = room.look(writer, kept);
        }
        if unacknowledged >= kept {
            let mut left = self.wait_max(arrival, kept);
            let waits = !left.is_zero();
            while unacknowledged >= kept && !left.is_zero() {
                let is_all = writer.wait_acknowledged(left.min(LOOK_EVERY));
                unacknowledged = if is_all { 0 } else { room.look(writer, kept) };
                left = left.saturating_sub(LOOK_EVERY);
            }
            if waits {
                self.stalled_until = Some(Instant::now() + STALLED_READER_PAUSE);
            }
        }
        self.stalled_until = self.stalled_until.filter(|_| unacknowledged >= kept);

        let kept_min = if unacknowledged == 0 { of_next } else { kept };
        room.kept_min.store(kept_min, Relaxed);
        room.unacknowledged.store(unacknowledged.saturating_add(1), Relaxed);
        let (now, mut written) = (Instant::now(), room.written());
        written.last = Some((now, timestamp_ns));
        written.first = written.first.filter(|_| unacknowledged > 0).or(Some(now));
    }

    /// Returns the longest wait for room among so many samples. A message that came alone waits no longer than until
    /// readers have acknowledged nothing for [`ACKNOWLEDGED_WAIT_MAX`], so that a slow topic is not held up by a reader
    /// that stood still before.
    fn wait_max(&self, arrival: Arrival, kept: u32) -> Duration {
        let is_stalled = self.stalled_until.is_some_and(|until| Instant::now() < until);
        let may_wait = match arrival {
            Arrival::InBurst => true,
            Arrival::Alone => is_deep(kept),
            Arrival::AtOnce => false,
        };
        if is_stalled || !may_wait {
            return Duration::ZERO;
        }
        let first = self.room.written().first.filter(|_| arrival == Arrival::Alone);
        ACKNOWLEDGED_WAIT_MAX.saturating_sub(first.map_or(Duration::ZERO, |first| first.elapsed()))
    }
}

#[cfg(test)]
mod tests {
    use std::sync::atomic::{AtomicBool, AtomicUsize};

    use bytes::Bytes;
    use sgc_ros::{Guid, RosError, SampleHead};

    use super::*;

    /// Waits until a reader counts as stalled.
    const WAITS: usize = (ACKNOWLEDGED_WAIT_MAX.as_millis() / LOOK_EVERY.as_millis()) as usize;

    struct Slow {
        kept: Option<u32>,
        /// The count that it knows, if it knows one, before and after a wait.
        unacknowledged: [Option<u32>; 2],
        waited: AtomicUsize,
        /// Looks without a wait.
        asked: AtomicUsize,
        stands_still: AtomicBool,
    }

    impl Slow {
        fn new(kept: Option<u32>) -> Self {
            Self {
                kept,
                unacknowledged: [None; 2],
                waited: AtomicUsize::new(0),
                asked: AtomicUsize::new(0),
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

        fn wait_acknowledged(&self, max: Duration) -> bool {
            let counter = if max.is_zero() { &self.asked } else { &self.waited };
            counter.fetch_add(1, Relaxed);
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
        (0..100).for_each(|_| burst.before_next(&writer, Arrival::Alone, 8, 0));
        (0..100).for_each(|_| burst.before_next(&writer, Arrival::InBurst, 8, 0));
        assert_eq!(writer.asked.swap(0, Relaxed), 19);
        (0..100).for_each(|_| burst.before_next(&writer, Arrival::InBurst, 2000, 0));
        assert_eq!(writer.asked.load(Relaxed), 20, "fewer of long ones are kept");
        assert_eq!(writer.waited.load(Relaxed), 0, "all are acknowledged");
        writer.stands_still.store(true, Relaxed);
        (0..1000).for_each(|_| burst.before_next(&writer, Arrival::Alone, 8, 0));
        assert_eq!(writer.waited.load(Relaxed), 0, "each alone");
        (0..1000).for_each(|_| burst.before_next(&writer, Arrival::InBurst, 8, 0));
        assert_eq!(writer.waited.load(Relaxed), WAITS, "once");
        // After it has acknowledged, the next burst waits again.
        writer.stands_still.store(false, Relaxed);
        burst.before_next(&writer, Arrival::InBurst, 8, 0);
        writer.stands_still.store(true, Relaxed);
        (0..1000).for_each(|_| burst.before_next(&writer, Arrival::InBurst, 8, 0));
        assert_eq!(writer.waited.load(Relaxed), 2 * WAITS);
        // So does one that comes much later.
        burst.stalled_until = Some(Instant::now());
        (0..1000).for_each(|_| burst.before_next(&writer, Arrival::InBurst, 8, 0));
        assert_eq!(writer.waited.load(Relaxed), 3 * WAITS);
        // A burst does not wait for samples that were acknowledged meanwhile.
        let acknowledging = Slow { unacknowledged: [Some(3); 2], ..Slow::new(Some(10)) };
        let mut burst = Burst::default();
        (0..100).for_each(|_| burst.before_next(&acknowledging, Arrival::InBurst, 8, 0));
        assert_eq!((acknowledging.waited.load(Relaxed), acknowledging.asked.load(Relaxed)), (0, 0));
        // A reader that acknowledged some in the longest wait is slow, and not stalled.
        for (after, waits, is_stalled) in [(4, 1, false), (10, WAITS, true)] {
            let lagging = Slow { unacknowledged: [Some(10), Some(after)], ..Slow::new(Some(10)) };
            lagging.stands_still.store(true, Relaxed);
            let mut burst = Burst::default();
            (0..11).for_each(|_| burst.before_next(&lagging, Arrival::InBurst, 8, 0));
            assert_eq!((lagging.waited.load(Relaxed), burst.stalled_until.is_some()), (waits, is_stalled));
            assert_eq!(burst.room.unacknowledged.load(Relaxed), after + 1);
        }
        let (writer, mut other) = (Slow::new(None), Burst::default());
        (0..100).for_each(|_| other.before_next(&writer, Arrival::InBurst, 8, 0));
        assert_eq!(writer.waited.load(Relaxed), 0, "one that blocks by itself");
    }

    /// Its publisher may keep all.
    #[test]
    fn a_message_that_came_alone_waits_at_a_writer_that_keeps_many() {
        let writer = Slow::new(Some(1000));
        writer.stands_still.store(true, Relaxed);
        let mut burst = Burst::default();
        (0..1000).for_each(|_| burst.before_next(&writer, Arrival::Alone, 8, 0));
        assert_eq!(writer.waited.load(Relaxed), 0);
        thread::sleep(Duration::from_millis(1));
        assert!(!burst.room.is_there(&writer, 8, 1), "although its time has come");
        (0..100).for_each(|_| burst.before_next(&writer, Arrival::Alone, 8, 0));
        assert_eq!(writer.waited.load(Relaxed), WAITS, "once");
        // A reader that has stood still for longer than a message waits holds up nobody.
        let mut burst = Burst::default();
        (0..1000).for_each(|_| burst.before_next(&writer, Arrival::Alone, 8, 0));
        burst.room.written().first = Instant::now().checked_sub(ACKNOWLEDGED_WAIT_MAX);
        (0..100).for_each(|_| burst.before_next(&writer, Arrival::Alone, 8, 0));
        assert_eq!(writer.waited.load(Relaxed), WAITS);
        // Nor does it hold up a thread that may not wait.
        let mut burst = Burst::default();
        (0..1010).for_each(|_| burst.before_next(&writer, Arrival::AtOnce, 8, 0));
        assert_eq!(writer.waited.load(Relaxed), WAITS);
    }

    #[test]
    fn short_samples_overwrite_no_long_ones_that_are_unacknowledged() {
        let writer = Slow::new(Some(10));
        let mut burst = Burst::default();
        (0..5).for_each(|_| burst.before_next(&writer, Arrival::InBurst, 2000, 0));
        assert_eq!(writer.asked.load(Relaxed), 0);
        burst.before_next(&writer, Arrival::InBurst, 8, 0);
        assert_eq!(writer.asked.load(Relaxed), 1, "five long ones are kept");
        // The long ones are acknowledged, so ten short ones are kept again.
        (0..9).for_each(|_| burst.before_next(&writer, Arrival::InBurst, 8, 0));
        assert_eq!(writer.asked.load(Relaxed), 1);
        let stuck = Slow::new(Some(10));
        stuck.stands_still.store(true, Relaxed);
        let mut burst = Burst::default();
        (0..5).for_each(|_| burst.before_next(&stuck, Arrival::Alone, 2000, 0));
        assert!(!burst.room.is_there(&stuck, 8, 0));
    }

    #[test]
    fn there_is_room_while_what_was_written_is_acknowledged() {
        let writer = Slow::new(Some(10));
        let mut burst = Burst::default();
        for _ in 0..35 {
            assert!(burst.room.is_there(&writer, 8, 0));
            burst.before_next(&writer, Arrival::Alone, 8, 0);
        }
        assert_eq!(writer.asked.load(Relaxed), 3, "asked when as many were written as are kept");
        writer.stands_still.store(true, Relaxed);
        for _ in 0..5 {
            assert!(burst.room.is_there(&writer, 8, 0));
            burst.before_next(&writer, Arrival::Alone, 8, 0);
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
