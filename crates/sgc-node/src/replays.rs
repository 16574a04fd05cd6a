//! Answers to sinks that ask for messages again: a bounded number at once, the others in turn.

use std::collections::{BTreeMap, BTreeSet, VecDeque};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};

use sgc_wire::{Name, Recover, SinkId, SourceId};

use crate::sources::LocalShare;

/// Answers that may be sent at once.
pub(crate) const REPLAYS_MAX: usize = 16;
/// Requests that may wait; whose is refused asks again.
pub(crate) const REPLAYS_WAITING_MAX: usize = 4096;

/// Who asked which source.
type Key = (Name, SourceId, SinkId);

#[derive(Default)]
struct State {
    /// Sources that answer: one answer at a time, since each holds its source.
    running: BTreeSet<(Name, SourceId)>,
    order: VecDeque<Key>,
    waiting: BTreeMap<Key, (Arc<LocalShare>, Recover)>,
}

/// The answers of this node.
#[derive(Default)]
pub(crate) struct Replays(Mutex<State>);

impl Replays {
    /// Answers a request, at once or in its turn; one that waits already is replaced. False if too many wait.
    pub(crate) fn ask(self: &Arc<Self>, share: Arc<LocalShare>, recover: Recover) -> bool {
        {
            let mut state = self.lock();
            let key = (recover.name, recover.source, recover.sink);
            let known = state.waiting.contains_key(&key);
            if !known && state.waiting.len() >= REPLAYS_WAITING_MAX {
                return false;
            }
            state.waiting.insert(key, (share, recover));
            if !known {
                state.order.push_back(key);
            }
        }
        self.start();
        true
    }

    /// Starts what may run.
    fn start(self: &Arc<Self>) {
        while let Some((share, recover)) = self.take() {
            let this = self.clone();
            share.clone().run_blocking(move || {
                share.replay(&recover);
                this.lock().running.remove(&(recover.name, recover.source));
                this.start();
            });
        }
    }

    /// The next request that may be answered now.
    fn take(&self) -> Option<(Arc<LocalShare>, Recover)> {
        let mut state = self.lock();
        if state.running.len() >= REPLAYS_MAX {
            return None;
        }
        let idle = |(name, source, _): &Key| !state.running.contains(&(*name, *source));
        let at = state.order.iter().position(idle)?;
        let key = state.order.remove(at)?;
        state.running.insert((key.0, key.1));
        state.waiting.remove(&key)
    }

    fn lock(&self) -> MutexGuard<'_, State> {
        self.0.lock().unwrap_or_else(PoisonError::into_inner)
    }
}
