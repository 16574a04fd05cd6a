//! Discovery of endpoints and nodes: a thread that hands the graph's events to a handler.

use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, PoisonError};
use std::thread::JoinHandle;
use std::time::{Duration, Instant};

use sgc_ros::{DiscoveryEvent, DiscoveryHandler};

use crate::participant::Participant;

/// Time without a change after which nodes are reported. A node and its endpoints come in tokens of their own, one after
/// the other, so that each would be a change of the node.
const NODES_SETTLE: Duration = Duration::from_millis(20);
/// Longest time for which nodes are held back.
const NODES_WAIT_MAX: Duration = Duration::from_millis(200);

/// Running discovery. Dropping it ends it and waits for its thread.
#[derive(Debug)]
pub(crate) struct Running {
    participant: Arc<Participant>,
    is_stopped: Arc<AtomicBool>,
    thread: Option<JoinHandle<()>>,
}

/// Starts the thread, which first reports what is known. Nodes are reported only with `graph`.
pub(crate) fn start(
    participant: &Arc<Participant>,
    handler: DiscoveryHandler,
    graph: bool,
) -> Result<Running, String> {
    participant.graph().graph.watch();
    let is_stopped = Arc::new(AtomicBool::new(false));
    let (of_thread, stopped) = (Arc::clone(participant), Arc::clone(&is_stopped));
    let thread = std::thread::Builder::new()
        .name("sgc-zenoh-disc".into())
        .spawn(move || report(&of_thread, handler, graph, &stopped))
        .map_err(|error| error.to_string())?;
    Ok(Running { participant: Arc::clone(participant), is_stopped, thread: Some(thread) })
}

impl Drop for Running {
    fn drop(&mut self) {
        {
            let _graph = self.participant.graph();
            self.is_stopped.store(true, Ordering::Release);
        }
        self.participant.changed().notify_all();
        if let Some(thread) = self.thread.take()
            && thread.join().is_err()
        {
            tracing::error!("the thread of discovery panicked");
        }
        self.participant.graph().graph.unwatch();
    }
}

/// Reports events until discovery is stopped.
fn report(participant: &Participant, mut handler: DiscoveryHandler, graph: bool, stopped: &AtomicBool) {
    let mut nodes_since = None;
    while let Some(events) = next(participant, graph, stopped, &mut nodes_since) {
        for event in events {
            if stopped.load(Ordering::Acquire) {
                return;
            }
            handler(event);
        }
    }
}

/// Waits for the next events. Returns `None` if discovery is stopped. `nodes_since` is the time since which nodes wait.
fn next(
    participant: &Participant,
    graph: bool,
    stopped: &AtomicBool,
    nodes_since: &mut Option<Instant>,
) -> Option<Vec<DiscoveryEvent>> {
    let mut watched = participant.graph();
    loop {
        if stopped.load(Ordering::Acquire) {
            return None;
        }
        if watched.graph.has_changed_endpoints() {
            return Some(watched.graph.endpoint_events());
        }
        let due = if watched.graph.has_changed_nodes() {
            let since = *nodes_since.get_or_insert(watched.changed_at);
            Some((watched.changed_at + NODES_SETTLE).min(since + NODES_WAIT_MAX))
        } else {
            None
        };
        let now = Instant::now();
        watched = match due {
            Some(due) if due <= now => {
                *nodes_since = None;
                let events = watched.graph.node_events();
                return Some(if graph { events } else { Vec::new() });
            }
            Some(due) => {
                let waited = participant.changed().wait_timeout(watched, due - now);
                waited.unwrap_or_else(PoisonError::into_inner).0
            }
            None => participant.changed().wait(watched).unwrap_or_else(PoisonError::into_inner),
        };
    }
}
