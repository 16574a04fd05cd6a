//! [`CallLedger`]: the calls of one service that got no answer, by reason and by caller. It outlives the route, since a
//! service whose server stays away has none. Callers are known by id; the reader finds their names.

use std::collections::BTreeMap;
use std::sync::{Arc, Mutex, MutexGuard};
use std::time::Instant;

use sgc_endpoint::{CallLoss, CallStats};
use sgc_ros::Guid;
use sgc_sync::lock;
use sgc_wire::SourceId;
use tracing::{debug, warn};

use crate::data::stats::Drops;

/// Most services whose calls are remembered after their routes ended.
pub(crate) const LEDGERS_MAX: usize = 1024;
/// Most callers that are distinguished for each reason.
const CALLERS_MAX: usize = 64;

/// The caller.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub(crate) enum CallerId {
    /// A client of the local network, by its request writer.
    Client(Guid),
    /// A node, by its source.
    Source(SourceId),
}

/// Calls that were lost for one reason.
#[derive(Clone, Debug)]
pub(crate) struct Losses {
    /// Number of lost calls.
    pub(crate) count: u64,
    /// Number of lost calls since a call was last answered.
    pub(crate) since_answer: u64,
    /// Lost calls by caller, if known.
    pub(crate) by: BTreeMap<CallerId, u64>,
    /// The time of the last one.
    pub(crate) last: Instant,
}

#[derive(Debug, Default)]
struct State {
    topic: String,
    /// Calls of earlier routes.
    past: CallStats,
    losses: BTreeMap<CallLoss, Losses>,
    /// Whether a call was lost since one was last answered.
    is_lossy: bool,
}

/// The lost calls of one service at this node.
#[derive(Debug)]
pub(crate) struct CallLedger {
    /// Whether the service's servers are here.
    pub(crate) is_served: bool,
    failures: Arc<Drops>,
    state: Mutex<State>,
}

impl CallLedger {
    /// Creates a ledger without losses.
    pub(crate) fn new(is_served: bool, failures: Arc<Drops>) -> Self {
        Self { is_served, failures, state: Mutex::default() }
    }

    /// Counts lost calls.
    pub(crate) fn count(&self, loss: CallLoss, of: Option<CallerId>, calls: u64) {
        // The data path counts overruns itself.
        let is_first = loss != CallLoss::Overrun && self.failures.add(loss, calls);
        let mut state = self.lock();
        state.is_lossy = true;
        let none = Losses { count: 0, since_answer: 0, by: BTreeMap::new(), last: Instant::now() };
        let losses = state.losses.entry(loss).or_insert(none);
        losses.count += calls;
        losses.since_answer += calls;
        losses.last = Instant::now();
        if let Some(of) = of.filter(|of| losses.by.len() < CALLERS_MAX || losses.by.contains_key(of)) {
            *losses.by.entry(of).or_default() += calls;
        }
        let service = &state.topic;
        if is_first && loss != CallLoss::ClientGone {
            warn!(%service, reason = loss.key(), "a call gets no answer; counted from here on, `sgc why {service}` says more");
        } else {
            debug!(%service, reason = loss.key(), calls, "calls get no answer");
        }
    }

    /// Notes that a call was answered.
    pub(crate) fn answered(&self) {
        let mut state = self.lock();
        if std::mem::take(&mut state.is_lossy) {
            state.losses.values_mut().for_each(|losses| losses.since_answer = 0);
        }
    }

    /// Sets the service's name on the local network.
    pub(crate) fn set_topic(&self, topic: &str) {
        topic.clone_into(&mut self.lock().topic);
    }

    /// Adds the calls of a route that ends.
    pub(crate) fn add_past(&self, stats: CallStats) {
        let past = &mut self.lock().past;
        past.calls += stats.calls;
        past.answered += stats.answered;
    }

    /// Returns the service's name, the calls of earlier routes, and the losses.
    pub(crate) fn read(&self) -> (String, CallStats, BTreeMap<CallLoss, Losses>) {
        let state = self.lock();
        (state.topic.clone(), state.past, state.losses.clone())
    }

    fn lock(&self) -> MutexGuard<'_, State> {
        lock(&self.state)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn losses_are_counted_by_caller_until_calls_are_answered_again() {
        let ledger = CallLedger::new(false, Arc::default());
        let client = |n: u8| CallerId::Client(Guid([n; 16]));
        (0..200).for_each(|n| ledger.count(CallLoss::ServerGone, Some(client(n)), 1));
        ledger.count(CallLoss::ServerGone, Some(client(0)), 2);
        ledger.count(CallLoss::Overrun, None, 7);
        let (_, _, losses) = ledger.read();
        let gone = &losses[&CallLoss::ServerGone];
        assert_eq!((gone.count, gone.since_answer, gone.by.len()), (202, 202, CALLERS_MAX));
        assert_eq!(gone.by[&client(0)], 3);
        ledger.answered();
        ledger.count(CallLoss::ServerGone, None, 1);
        let (_, _, losses) = ledger.read();
        let [gone, overrun] = [&losses[&CallLoss::ServerGone], &losses[&CallLoss::Overrun]];
        assert_eq!((gone.count, gone.since_answer), (203, 1));
        assert_eq!((overrun.count, overrun.since_answer), (7, 0));
        let counted = ledger.failures.snapshot();
        assert_eq!(counted.into_iter().collect::<Vec<_>>(), [("call_server_gone".to_owned(), 203)]);
    }

    /// Checks that each key of the specification has a sentence in `sgc why` and `sgc status`.
    #[test]
    fn every_reason_is_in_the_specification() {
        let spec = include_str!("../../../../docs/spec/routing.md");
        for loss in CallLoss::ALL {
            let key = loss.key();
            assert!(spec.contains(&format!("`{key}`")), "{key}");
        }
    }
}
