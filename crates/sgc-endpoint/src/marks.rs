//! The times at which a silent source repeats its last number, so that sinks notice a loss. The driver has the clock,
//! and knows whether anybody listens.

use std::time::{Duration, Instant};

use crate::SourceProgress;

/// Times after its last message at which a source sends a mark: several, because marks may be lost, too.
pub const MARK_AFTER: [Duration; 3] =
    [Duration::from_secs(1), Duration::from_secs(4), Duration::from_secs(15)];

/// Progress of one source at the last look.
#[derive(Clone, Copy, Debug, Default)]
pub struct Marks {
    last_message: u64,
    /// Time of the first look at that progress.
    since: Option<Instant>,
    said: usize,
}

impl Marks {
    /// Looks at the source's progress. Returns `true` if it has to send a mark now ([`crate::Source::mark`]).
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

    /// Returns the time of the next look; `None` until there is another message.
    pub fn deadline(&self) -> Option<Instant> {
        Some(self.since? + *MARK_AFTER.get(self.said)?)
    }
}
