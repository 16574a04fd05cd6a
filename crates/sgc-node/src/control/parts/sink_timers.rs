//! Timers of the sinks: histories that make no progress, and keys of past epochs.

use std::collections::BTreeMap;
use std::time::{Duration, Instant};

use sgc_wire::{Name, SourceId};

/// Time without progress after which a history is asked for again.
const HISTORY_RETRY: Duration = Duration::from_secs(2);
/// Time for which packets of past epochs may be under way.
const EPOCH_GRACE: Duration = Duration::from_secs(5);

/// Timers of all sinks.
#[derive(Default)]
pub(crate) struct SinkTimers {
    /// Times at which histories are asked for again.
    histories: BTreeMap<(Name, SourceId), Instant>,
    /// Times at which the keys of past epochs are dropped.
    epochs: BTreeMap<Name, Instant>,
}

impl SinkTimers {
    /// Starts the timer of a history that was asked for.
    pub(crate) fn history_asked(&mut self, name: Name, source: SourceId, now: Instant) {
        self.histories.insert((name, source), now + HISTORY_RETRY);
    }

    /// Ends the timer of a history.
    pub(crate) fn history_ended(&mut self, name: Name, source: SourceId) {
        self.histories.remove(&(name, source));
    }

    /// Starts the timer of a past epoch.
    pub(crate) fn epoch_ended(&mut self, name: Name, now: Instant) {
        self.epochs.insert(name, now + EPOCH_GRACE);
    }

    /// Ends all timers of a name.
    pub(crate) fn forget(&mut self, name: &Name) {
        self.histories.retain(|(of, _), _| of != name);
        self.epochs.remove(name);
    }

    /// Returns the histories to ask for again, and ends their timers.
    pub(crate) fn take_histories(&mut self, now: Instant) -> Vec<(Name, SourceId)> {
        let due: Vec<_> = self.histories.iter().filter(|(_, at)| **at <= now).map(|(key, _)| *key).collect();
        for key in &due {
            self.histories.remove(key);
        }
        due
    }

    /// Returns the names whose past epochs are over, and ends their timers.
    pub(crate) fn take_epochs(&mut self, now: Instant) -> Vec<Name> {
        let over: Vec<_> = self.epochs.iter().filter(|(_, at)| **at <= now).map(|(name, _)| *name).collect();
        for name in &over {
            self.epochs.remove(name);
        }
        over
    }

    /// Returns the time of the next timer.
    pub(crate) fn deadline(&self) -> Option<Instant> {
        self.histories.values().chain(self.epochs.values()).min().copied()
    }
}
