//! [`Source`]: the node at one moment, for the server of metrics and for pushes.

use std::fmt;
use std::sync::{Arc, OnceLock};
use std::time::{Duration, Instant, SystemTime};

use bytes::Bytes;
use tokio::sync::{Mutex, mpsc, oneshot};
use tokio::time::timeout;

use super::Metrics;
use super::process::Process;
use super::series::{self, Sample};
use crate::control::event::CoreEvent;
use crate::gateway::Gateway;

/// Longest wait for the control task.
const ANSWER_MAX: Duration = Duration::from_secs(5);
/// Time for which a snapshot serves further requests, so that frequent ones do not burden the control task.
const FRESH: Duration = Duration::from_secs(1);

/// The source of snapshots.
pub(super) struct Source {
    events: mpsc::Sender<CoreEvent>,
    gateway: Arc<Gateway>,
    metrics: Arc<Metrics>,
    /// The start of the node.
    started: SystemTime,
    last: Mutex<Option<Arc<Snapshot>>>,
}

/// The node at one moment.
pub(super) struct Snapshot {
    /// The time of the question.
    asked: Instant,
    pub(super) sample: Sample,
    /// The text of the metrics, once it was asked for.
    text: OnceLock<Bytes>,
}

impl Source {
    pub(super) fn new(events: mpsc::Sender<CoreEvent>, gateway: Arc<Gateway>, metrics: Arc<Metrics>) -> Self {
        Self { events, gateway, metrics, started: SystemTime::now(), last: Mutex::default() }
    }

    /// Returns the start of the node.
    #[cfg(feature = "otlp")]
    pub(super) fn started(&self) -> SystemTime {
        self.started
    }

    /// Returns a snapshot that is at most [`FRESH`] old, or `None` if the control task does not answer.
    pub(super) async fn snapshot(&self) -> Option<Arc<Snapshot>> {
        let ask = async {
            let mut last = self.last.lock().await;
            if let Some(fresh) = last.as_ref().filter(|last| last.asked.elapsed() < FRESH) {
                return Some(fresh.clone());
            }
            let asked = Instant::now();
            let (reply, answer) = oneshot::channel();
            self.events.send(CoreEvent::Readings(reply)).await.ok()?;
            let mut readings = answer.await.ok()?;
            readings.gateway = self.gateway.status();
            readings.pushes = self.metrics.push_status();
            readings.alerts.extend(self.gateway.alerts());
            readings.alerts.extend(self.metrics.alerts());
            let (process, started, at) = (Process::read(), self.started, SystemTime::now());
            let sample = Sample { readings: *readings, process, started, at };
            let snapshot = Arc::new(Snapshot { asked, sample, text: OnceLock::new() });
            *last = Some(snapshot.clone());
            Some(snapshot)
        };
        timeout(ANSWER_MAX, ask).await.ok().flatten()
    }
}

impl Snapshot {
    /// Returns the metrics in the text format of Prometheus.
    pub(super) fn text(&self) -> Result<Bytes, fmt::Error> {
        if let Some(text) = self.text.get() {
            return Ok(text.clone());
        }
        let text = Bytes::from(series::text(self.sample.clone())?);
        Ok(self.text.get_or_init(|| text).clone())
    }
}
