//! When a source that fell silent says what it published last, so that who lost it notices. Whether anybody listens,
//! and the clock, are the driver's.

use std::time::{Duration, Instant};

use crate::SourceProgress;

/// How long after its last message a source says so: more than once, since that may be lost too.
pub const MARK_AFTER: [Duration; 3] =
    [Duration::from_secs(1), Duration::from_secs(4), Duration::from_secs(15)];

/// What was seen of one source.
#[derive(Clone, Copy, Debug, Default)]
pub struct Marks {
    last_message: u64,
    /// When that was seen first.
    since: Option<Instant>,
    said: usize,
}

impl Marks {
    /// Looks at how far the source is; true if it is to say so now ([`crate::Source::mark`]).
    pub fn is_due(&mut self, now: Instant, progress: &SourceProgress) -> bool {
        let last_message = progress.last_message();
        if !progress.recovers() || last_message == 0 {
            return false;
        }
        if last_message != self.last_message {
            *self = Self { last_message, since: Some(now), said: 0 };
        }
        let due = self.deadline().is_some_and(|at| at <= now);
        self.said += usize::from(due);
        due
    }

    /// When to look again; `None` until there is another message.
    pub fn deadline(&self) -> Option<Instant> {
        Some(self.since? + *MARK_AFTER.get(self.said)?)
    }
}
