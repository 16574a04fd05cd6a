//! The stage that limits the rate, the bandwidth and the age of a topic's samples before they are numbered.
//!
//! [`Shaper`] computes the times. This stage keeps the newest sample whose time has not come, and blocks the reader's
//! thread with a sample that may be neither dropped nor overtaken. Its owner runs the timer and passes samples on.

use std::sync::atomic::{AtomicBool, Ordering::Relaxed, Ordering::SeqCst};
use std::sync::{Condvar, Mutex, PoisonError};
use std::time::{Duration, Instant};

use sgc_ros::{Sample, SampleKind, Shaping};
use sgc_session::{Shaper, Wished};
use sgc_sync::lock;
use sgc_wire::{Name, PayloadEncoding, PayloadForm};
use tracing::warn;

use crate::clock::unix_ns;
use crate::data::stats::{DataDrop, Dropped};

/// Limits the samples of one share.
pub(crate) struct ShapeStage {
    name: Name,
    /// Whether there are limits or a held sample, readable without the lock.
    is_active: AtomicBool,
    state: Mutex<State>,
    /// Notified when the share closes, to wake a thread that waits for a sample's time.
    closing: Condvar,
}

#[derive(Default)]
struct State {
    shaper: Shaper,
    /// The newest sample whose time has not come.
    held: Option<Sample>,
    /// Whether a timer will release it.
    is_timed: bool,
    /// Whether the log has said that reliable messages do not age.
    has_warned: bool,
    is_closed: bool,
    has_limits: bool,
}

/// The decision about a sample, and the drop of this one or of the held one.
#[must_use]
pub(crate) struct ShapeDecision {
    pub turn: Turn,
    pub dropped: Result<(), Dropped>,
}

/// The time at which a sample leaves.
#[derive(Debug)]
pub(crate) enum Turn {
    /// The sample leaves now.
    Now(Sample),
    /// The sample ends an instance and leaves now, after the held one.
    AfterHeld { held: Sample, sample: Sample },
    /// The stage holds the sample. If `starts_timer`, the caller has to start a timer, which releases it.
    Later { starts_timer: bool },
    /// The sample is dropped.
    Never,
}

impl ShapeStage {
    /// Creates a stage without limits.
    pub(crate) fn new(name: Name) -> Self {
        Self { name, is_active: AtomicBool::new(false), state: Mutex::default(), closing: Condvar::new() }
    }

    /// Sets the limits.
    pub(crate) fn configure(&self, shaping: Shaping) {
        let (compression, form) = (PayloadEncoding::Plain, PayloadForm::Cdr);
        let limits = Shaping { compression, form, ..shaping };
        let mut state = lock(&self.state);
        state.shaper.set(shaping);
        state.has_limits = limits != Shaping::default();
        self.note_active(&state);
    }

    /// Sets what the subscribers wish together.
    pub(crate) fn wish(&self, wished: Wished) {
        let mut state = lock(&self.state);
        state.shaper.wish(wished);
        self.note_active(&state);
    }

    /// Returns what the subscribers wish together.
    pub(crate) fn wished(&self) -> Wished {
        lock(&self.state).shaper.wished()
    }

    /// Makes later samples pass this stage, or not. They pass it after the limits as well while it holds a sample,
    /// which would otherwise leave behind them.
    fn note_active(&self, state: &State) {
        let is_limited = state.has_limits || state.shaper.wished() != Wished::default();
        self.is_active.store(is_limited || state.held.is_some(), SeqCst);
    }

    /// Returns the settings.
    pub(crate) fn shaping(&self) -> Shaping {
        *lock(&self.state).shaper.shaping()
    }

    /// Returns `true` if samples have to pass this stage.
    pub(crate) fn is_active(&self) -> bool {
        self.is_active.load(Relaxed)
    }

    /// Decides when a sample leaves. Blocks with one that may be neither dropped nor overtaken. `reliable` is the
    /// reliability of the topic.
    pub(crate) fn shape(&self, sample: Sample, reliable: bool) -> ShapeDecision {
        let mut state = lock(&self.state);
        if sample.kind != SampleKind::Write {
            // The end of an instance follows its last sample and is never dropped.
            let turn = match state.held.take() {
                Some(held) => Turn::AfterHeld { held: Sample { more: true, ..held }, sample },
                None => Turn::Now(sample),
            };
            self.note_active(&state);
            return ShapeDecision { turn, dropped: Ok(()) };
        }
        if state.shaper.shaping().max_age.is_some() && reliable {
            if !std::mem::replace(&mut state.has_warned, true) {
                let topic = self.name.short();
                warn!(%topic, "`max_age` is set for a topic that is reliable: none of its messages may be left out, and it has no effect");
            }
        } else if state.shaper.is_too_old(unix_ns(), sample.source_timestamp_ns) {
            return ShapeDecision { turn: Turn::Never, dropped: Err(Dropped::one(DataDrop::TooOld)) };
        }
        let mut now = Instant::now();
        while !state.shaper.is_due(now) && !state.is_closed {
            if state.shaper.gives_way(now, reliable) {
                let replaced = state.held.replace(sample);
                let starts_timer = !std::mem::replace(&mut state.is_timed, true);
                return ShapeDecision { turn: Turn::Later { starts_timer }, dropped: thinned(replaced) };
            }
            let wait = state.shaper.due().map_or(Duration::ZERO, |due| due.saturating_duration_since(now));
            state = self.closing.wait_timeout(state, wait).unwrap_or_else(PoisonError::into_inner).0;
            now = Instant::now();
        }
        let overtaken = state.held.take();
        state.shaper.takes(now, sample.payload.len());
        self.note_active(&state);
        ShapeDecision { turn: Turn::Now(sample), dropped: thinned(overtaken) }
    }

    /// Returns the time at which the timer has to release the held sample; `None` if there is none, and the timer ends.
    pub(crate) fn due(&self, now: Instant) -> Option<Instant> {
        let mut state = lock(&self.state);
        state.is_timed = state.held.is_some() && !state.is_closed;
        state.is_timed.then(|| state.shaper.due().unwrap_or(now))
    }

    /// Returns `true` if a sample waits for its time.
    pub(crate) fn has_held(&self) -> bool {
        self.is_active() && lock(&self.state).held.is_some()
    }

    /// Returns the held sample if its time has come.
    pub(crate) fn release(&self, now: Instant) -> Option<Sample> {
        let mut state = lock(&self.state);
        let sample = if state.shaper.is_due(now) { state.held.take() } else { None }?;
        state.shaper.takes(now, sample.payload.len());
        self.note_active(&state);
        Some(Sample { more: false, ..sample })
    }

    /// Corrects the bandwidth that a sample took, because its encoded length differs.
    pub(crate) fn correct(&self, taken: usize, encoded: usize) {
        if self.is_active() {
            lock(&self.state).shaper.corrects(taken, encoded);
        }
    }

    /// Ends all waiting. Samples leave at once from here on.
    pub(crate) fn close(&self) {
        lock(&self.state).is_closed = true;
        self.closing.notify_all();
    }
}

/// Returns the drop of a held sample that a newer one replaces.
fn thinned(held: Option<Sample>) -> Result<(), Dropped> {
    Dropped::check(DataDrop::Thinned, held.is_some().into())
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::data::sending::fixtures::{KNOWN, NAME, sample};

    const HOUR: Duration = Duration::from_secs(3600);

    fn stage(shaping: Shaping) -> ShapeStage {
        let stage = ShapeStage::new(NAME);
        stage.configure(shaping);
        stage
    }

    fn dated(source_timestamp_ns: i64) -> Sample {
        Sample { source_timestamp_ns, ..sample(KNOWN, true) }
    }

    #[test]
    fn newest_sample_is_held_until_its_time_and_replaces_older_ones() {
        let stage = stage(Shaping { interval: Some(HOUR), ..Shaping::default() });
        assert!(stage.is_active());
        let first = stage.shape(dated(1), true);
        assert!(matches!(first.turn, Turn::Now(_)) && first.dropped.is_ok());
        for n in 2..5 {
            let ShapeDecision { turn, dropped } = stage.shape(dated(n), true);
            assert!(matches!(turn, Turn::Later { starts_timer } if starts_timer == (n == 2)), "{turn:?}");
            assert_eq!(dropped.is_err(), n > 2);
        }
        let now = Instant::now();
        let due = stage.due(now).unwrap();
        assert!(due > now + HOUR / 2 && stage.release(now).is_none());
        let released = stage.release(due).unwrap();
        assert_eq!((released.source_timestamp_ns, released.more), (4, false), "nothing follows it");
        // The timer ends, and the next sample needs another.
        assert!(stage.due(due).is_none());
        assert!(matches!(stage.shape(dated(5), true).turn, Turn::Later { starts_timer: true }));
        // Without limits, the next sample leaves, and the older one does not follow it.
        stage.configure(Shaping::default());
        assert!(stage.is_active(), "the next sample finds the older one here");
        let ShapeDecision { turn, dropped } = stage.shape(dated(6), true);
        assert!(!stage.is_active() && matches!(turn, Turn::Now(_)));
        assert_eq!(dropped, Err(Dropped::one(DataDrop::Thinned)));
    }

    #[test]
    fn end_of_an_instance_leaves_at_once_behind_the_held_sample() {
        let stage = stage(Shaping { interval: Some(HOUR), ..Shaping::default() });
        let end = || Sample { kind: SampleKind::Dispose, ..dated(9) };
        assert!(matches!(stage.shape(end(), true).turn, Turn::Now(_)));
        let _ = (stage.shape(dated(1), true), stage.shape(dated(2), true));
        let Turn::AfterHeld { held, sample } = stage.shape(end(), true).turn else { panic!("it is alone") };
        assert_eq!((held.source_timestamp_ns, held.more, sample.source_timestamp_ns), (2, true, 9));
    }

    #[test]
    fn old_sample_is_dropped_unless_the_topic_is_reliable() {
        let stage = stage(Shaping { max_age: Some(HOUR), ..Shaping::default() });
        let (new, old) = (unix_ns(), unix_ns() - 2 * HOUR.as_nanos() as i64);
        assert!(matches!(stage.shape(dated(new), false).turn, Turn::Now(_)));
        let ShapeDecision { turn, dropped } = stage.shape(dated(old), false);
        assert!(matches!(turn, Turn::Never));
        assert_eq!(dropped, Err(Dropped::one(DataDrop::TooOld)));
        assert!(matches!(stage.shape(dated(old), true).turn, Turn::Now(_)));
    }

    #[test]
    fn reliable_sample_blocks_until_its_time_or_until_the_stage_is_closed() {
        // A sample takes 50 ms.
        let bits = 8 * sample(KNOWN, true).payload.len() as u64;
        let timed = stage(Shaping { bits_per_s: Some(20 * bits), ..Shaping::default() });
        let begun = Instant::now();
        let _ = timed.shape(dated(1), true);
        assert!(matches!(timed.shape(dated(2), true).turn, Turn::Now(_)));
        assert!(begun.elapsed() >= Duration::from_millis(40), "{:?}", begun.elapsed());
        let stage = stage(Shaping { bits_per_s: Some(1), ..Shaping::default() });
        let _ = stage.shape(dated(1), true);
        std::thread::scope(|scope| {
            let blocked = scope.spawn(|| stage.shape(dated(2), true));
            assert!(stage.due(Instant::now()).is_none(), "it is not held");
            stage.close();
            assert!(matches!(blocked.join().unwrap().turn, Turn::Now(_)));
        });
        // A best-effort one gives way, but not to a closed stage.
        assert!(matches!(stage.shape(dated(3), false).turn, Turn::Now(_)));
    }

    #[test]
    fn bandwidth_counts_the_encoded_length() {
        let stage = stage(Shaping { bits_per_s: Some(8), ..Shaping::default() });
        let bytes = sample(KNOWN, false).payload.len();
        let _ = (stage.shape(dated(1), false), stage.shape(dated(2), false));
        let now = Instant::now();
        let before = stage.due(now).unwrap();
        stage.correct(bytes, bytes + 60);
        assert_eq!(stage.due(now), Some(before + Duration::from_secs(60)));
    }
}
