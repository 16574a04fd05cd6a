//! The HTTP server of metrics.
//!
//! Prometheus scrapes `/metrics`. `/healthz` tells whether the control task answers, and `/readyz` whether the node can
//! carry something. Neither needs a token, so the server tells nothing else and listens on loopback unless told
//! otherwise. `sgc-http` keeps pages of other sites and idle clients out.

use std::fmt;
use std::sync::{Arc, OnceLock};
use std::time::{Duration, Instant, SystemTime};

use bytes::Bytes;
use sgc_http::http::{Request, StatusCode};
use sgc_http::{Answer, TEXT, response};
use tokio::net::TcpListener;
use tokio::sync::{Mutex, mpsc, oneshot};
use tokio::time::timeout;

use super::process::Process;
use super::readings::Readings;
use super::series::{self, Sample};
use crate::control::event::CoreEvent;
use crate::gateway::Gateway;

/// Longest wait for the control task.
const ANSWER_MAX: Duration = Duration::from_secs(5);
/// Time for which readings serve further requests, so that frequent ones do not burden the control task.
const FRESH: Duration = Duration::from_secs(1);

const START_PAGE: &str = "sgc: /metrics for Prometheus, /healthz, /readyz\n";

/// The source of answers.
pub(super) struct Source {
    events: mpsc::Sender<CoreEvent>,
    gateway: Arc<Gateway>,
    /// The start of the node.
    started: SystemTime,
    last: Mutex<Option<Arc<Snapshot>>>,
}

/// The node at one moment.
struct Snapshot {
    /// The time of the question.
    at: Instant,
    readings: Arc<Readings>,
    /// The text of the metrics, once it was asked for.
    text: OnceLock<Bytes>,
}

impl Source {
    pub(super) fn new(events: mpsc::Sender<CoreEvent>, gateway: Arc<Gateway>) -> Self {
        Self { events, gateway, started: SystemTime::now(), last: Mutex::default() }
    }

    /// Returns a snapshot that is at most [`FRESH`] old, or `None` if the control task does not answer.
    async fn snapshot(&self) -> Option<Arc<Snapshot>> {
        let ask = async {
            let mut last = self.last.lock().await;
            if let Some(fresh) = last.as_ref().filter(|last| last.at.elapsed() < FRESH) {
                return Some(fresh.clone());
            }
            let at = Instant::now();
            let (reply, answer) = oneshot::channel();
            self.events.send(CoreEvent::Readings(reply)).await.ok()?;
            let mut readings = answer.await.ok()?;
            readings.gateway = self.gateway.status();
            readings.alerts.extend(self.gateway.alerts());
            let snapshot = Arc::new(Snapshot { at, readings: Arc::new(*readings), text: OnceLock::new() });
            *last = Some(snapshot.clone());
            Some(snapshot)
        };
        timeout(ANSWER_MAX, ask).await.ok().flatten()
    }

    /// Returns the metrics of a snapshot.
    fn text(&self, snapshot: &Snapshot) -> Result<Bytes, fmt::Error> {
        if let Some(text) = snapshot.text.get() {
            return Ok(text.clone());
        }
        let (readings, process) = (snapshot.readings.clone(), Process::read());
        let text = Bytes::from(series::text(Sample { readings, process, started: self.started })?);
        Ok(snapshot.text.get_or_init(|| text).clone())
    }
}

/// Serves connections until it is dropped.
pub(super) async fn serve(listener: TcpListener, source: Arc<Source>) {
    let answer = move |request: Request<()>| {
        let source = source.clone();
        async move { answer(&request, &source).await }
    };
    sgc_http::serve(listener, answer).await;
}

/// Answers a request.
async fn answer(request: &Request<()>, source: &Source) -> Answer {
    match request.uri().path() {
        "/" => response(StatusCode::OK, TEXT, START_PAGE),
        "/metrics" => metrics(source).await,
        "/healthz" => match source.snapshot().await {
            Some(_) => response(StatusCode::OK, TEXT, "ok\n"),
            None => unanswered(),
        },
        "/readyz" => match source.snapshot().await.map(|snapshot| snapshot.readings.obstacles()) {
            Some(obstacles) if obstacles.is_empty() => response(StatusCode::OK, TEXT, "ready\n"),
            Some(obstacles) => response(StatusCode::SERVICE_UNAVAILABLE, TEXT, obstacles.join("\n") + "\n"),
            None => unanswered(),
        },
        _ => response(StatusCode::NOT_FOUND, TEXT, START_PAGE),
    }
}

async fn metrics(source: &Source) -> Answer {
    let Some(snapshot) = source.snapshot().await else { return unanswered() };
    match source.text(&snapshot) {
        Ok(text) => response(StatusCode::OK, series::CONTENT_TYPE, text),
        Err(fmt::Error) => {
            response(StatusCode::INTERNAL_SERVER_ERROR, TEXT, "the metrics cannot be written\n")
        }
    }
}

fn unanswered() -> Answer {
    response(StatusCode::SERVICE_UNAVAILABLE, TEXT, "the control task does not answer\n")
}
