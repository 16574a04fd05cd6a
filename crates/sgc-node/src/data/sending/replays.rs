//! Answers to sinks that ask for missing messages: a bounded number at once, the others in turn.

use std::collections::{BTreeMap, BTreeSet, VecDeque};
use std::sync::{Arc, Mutex, MutexGuard};

use sgc_sync::lock;
use sgc_wire::{Name, Recover, SinkId, SourceId};

use crate::data::sending::share::LocalShare;

/// Answers that may be sent at once.
pub(crate) const REPLAYS_MAX: usize = 16;
/// Requests that may wait. A sink whose request is refused asks again.
pub(crate) const REPLAYS_WAITING_MAX: usize = 4096;

/// A sink and the source that it asks.
type Key = (Name, SourceId, SinkId);

#[derive(Default)]
struct State {
    /// Sources that are answering. Each sends one answer at a time, since the answer locks the source.
    running: BTreeSet<(Name, SourceId)>,
    order: VecDeque<Key>,
    waiting: BTreeMap<Key, (Arc<LocalShare>, Recover)>,
}

/// The answers of this node.
#[derive(Default)]
pub(crate) struct Replays(Mutex<State>);

impl Replays {
    /// Answers a request, at once or in its turn. It replaces a waiting request of the same sink. Returns `false` if
    /// too many wait.
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

    /// Starts the requests that may run.
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

    /// Removes and returns the next request that may run.
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
        lock(&self.0)
    }
}

#[cfg(test)]
mod tests {
    use std::time::Duration;

    use super::*;
    use crate::data::sending::fixtures::{self, NAME};
    use crate::data::sending::source_map::{SourceMap, SourceSlot};

    /// Returns a share with one source for all writers.
    fn share() -> (Arc<LocalShare>, SourceSlot) {
        let (_, share, slot) = fixtures::share();
        share.set_map(SourceMap { shared: Some(slot.clone()), ..SourceMap::default() });
        (share, slot)
    }

    fn recover(sink: u16, from: u64) -> Recover {
        let mut id = [0; 16];
        id[..2].copy_from_slice(&sink.to_be_bytes());
        Recover { name: NAME, sink: SinkId(id), source: SourceId([1; 16]), from, to: u64::MAX }
    }

    fn under_way(replays: &Replays) -> (usize, usize) {
        let state = replays.lock();
        assert_eq!(state.order.len(), state.waiting.len());
        (state.running.len(), state.waiting.len())
    }

    #[test]
    fn all_are_answered_in_turn_and_who_asks_again_takes_no_second_place() {
        let runtime = tokio::runtime::Runtime::new().unwrap();
        let _inside = runtime.enter();
        let (share, slot) = share();
        let replays = Arc::new(Replays::default());
        {
            let _busy = slot.source.lock().unwrap();
            for from in 1..=3 {
                for sink in 0..100 {
                    assert!(replays.ask(share.clone(), recover(sink, from)));
                }
            }
            // The first request runs; later ones of the same sink wait.
            assert_eq!(under_way(&replays), (1, 100));
            assert!(replays.lock().waiting.values().all(|(_, r)| r.from == 3));
            for sink in 100..REPLAYS_WAITING_MAX as u16 {
                assert!(replays.ask(share.clone(), recover(sink, 1)));
            }
            assert!(!replays.ask(share.clone(), recover(u16::MAX, 1)), "it is asked again");
        }
        let deadline = std::time::Instant::now() + Duration::from_secs(30);
        while under_way(&replays) != (0, 0) {
            assert!(std::time::Instant::now() < deadline, "{:?}", under_way(&replays));
            std::thread::yield_now();
        }
    }
}
