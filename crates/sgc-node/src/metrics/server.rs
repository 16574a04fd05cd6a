//! The HTTP server of metrics.
//!
//! Prometheus scrapes `/metrics`. `/healthz` tells whether the control task answers, and `/readyz` whether the node can
//! carry something. Neither needs a token, so the server tells nothing else and listens on loopback unless told
//! otherwise. A web page of another site cannot read answers: the server allows no other origin, and over loopback it
//! answers only requests to the host by its address or as `localhost`, so a page cannot read them by DNS rebinding.
//!
//! Clients that send no request keep nobody out: at the limit, a connection that had none gives way to a new one, or else
//! that whose last one is longest ago.

use std::convert::Infallible;
use std::fmt;
use std::net::IpAddr;
use std::pin::pin;
use std::sync::{Arc, Mutex as SyncMutex, OnceLock};
use std::time::{Duration, Instant, SystemTime};

use bytes::Bytes;
use http::header::{ALLOW, CACHE_CONTROL, CONTENT_TYPE, HOST, HeaderValue};
use http::uri::Authority;
use http::{Method, Request, Response, StatusCode};
use http_body_util::Full;
use hyper::body::Incoming;
use hyper::server::conn::http1;
use hyper::service::service_fn;
use hyper_util::rt::{TokioIo, TokioTimer};
use sgc_sync::lock;
use tokio::net::{TcpListener, TcpStream};
use tokio::sync::{Mutex, mpsc, oneshot};
use tokio::task::{AbortHandle, JoinSet};
use tokio::time::timeout;
use tracing::debug;

use super::process::Process;
use super::readings::Readings;
use super::series::{self, Sample};
use crate::control::event::CoreEvent;
use crate::gateway::Gateway;

/// Most connections at a time.
const CONNECTIONS_MAX: usize = 32;
/// Longest time in which a request arrives, and in which a connection may be idle. Prometheus connects again.
const REQUEST_MAX: Duration = Duration::from_secs(10);
/// Longest life of a connection, so that a client that reads nothing keeps no place.
const CONNECTION_MAX: Duration = Duration::from_secs(120);
/// Most bytes of a request's head.
const HEAD_BYTES_MAX: usize = 16 << 10;
/// Longest wait for the control task.
const ANSWER_MAX: Duration = Duration::from_secs(5);
/// Time for which readings serve further requests, so that frequent ones do not burden the control task.
const FRESH: Duration = Duration::from_secs(1);
/// Pause after the system refused to accept a connection.
const ACCEPT_RETRY: Duration = Duration::from_millis(100);

const TEXT: &str = "text/plain; charset=utf-8";
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

/// A connection that is served.
struct Served {
    task: AbortHandle,
    activity: Arc<SyncMutex<Activity>>,
}

/// The activity of a connection. The least gives way first.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
struct Activity {
    is_answering: bool,
    had_request: bool,
    /// When it was accepted, or its last request came.
    at: Instant,
}

/// Serves connections until it is dropped.
pub(super) async fn serve(listener: TcpListener, source: Arc<Source>) {
    let mut tasks = JoinSet::new();
    let mut served: Vec<Served> = Vec::new();
    loop {
        let stream = match listener.accept().await {
            Ok((stream, _)) => stream,
            Err(error) => {
                // The process may have too many open files, for example.
                debug!(%error, "a connection for metrics is not accepted");
                tokio::time::sleep(ACCEPT_RETRY).await;
                continue;
            }
        };
        while tasks.try_join_next().is_some() {}
        served.retain(|one| !one.task.is_finished());
        if served.len() >= CONNECTIONS_MAX {
            let activity = |at: &usize| *lock(&served[*at].activity);
            match (0..served.len()).min_by_key(activity).filter(|at| !activity(at).is_answering) {
                Some(idlest) => served.swap_remove(idlest).task.abort(),
                None => continue,
            }
        }
        let activity = Activity { is_answering: false, had_request: false, at: Instant::now() };
        let activity = Arc::new(SyncMutex::new(activity));
        let (source, noted) = (source.clone(), activity.clone());
        let task = tasks.spawn(async move { serve_one(stream, &source, &noted).await });
        served.push(Served { task, activity });
    }
}

/// Serves a connection, and notes when requests come.
async fn serve_one(stream: TcpStream, source: &Source, activity: &SyncMutex<Activity>) {
    let is_local = stream.local_addr().is_ok_and(|at| at.ip().to_canonical().is_loopback());
    let answer = service_fn(async |request| {
        *lock(activity) = Activity { is_answering: true, had_request: true, at: Instant::now() };
        let answered = answer(request, source, is_local).await;
        lock(activity).is_answering = false;
        answered
    });
    let mut server = http1::Builder::new();
    server.timer(TokioTimer::new()).header_read_timeout(REQUEST_MAX).max_buf_size(HEAD_BYTES_MAX);
    let mut connection = pin!(server.serve_connection(TokioIo::new(stream), answer));
    let ended = match timeout(CONNECTION_MAX, &mut connection).await {
        Ok(ended) => ended,
        Err(_) => {
            // An answer under way is completed.
            connection.as_mut().graceful_shutdown();
            timeout(REQUEST_MAX, connection).await.unwrap_or(Ok(()))
        }
    };
    if let Err(error) = ended {
        debug!(%error, "a connection for metrics ended");
    }
}

/// Answers a request.
async fn answer(
    request: Request<Incoming>,
    source: &Source,
    is_local: bool,
) -> Result<Response<Full<Bytes>>, Infallible> {
    let host = request.headers().get(HOST);
    if is_local && host.is_some_and(|host| !names_this_host(host)) {
        let why = "this server answers only at its address and as localhost\n";
        return Ok(response(StatusCode::MISDIRECTED_REQUEST, TEXT, why));
    }
    if ![Method::GET, Method::HEAD].contains(request.method()) {
        let mut refused = response(StatusCode::METHOD_NOT_ALLOWED, TEXT, "GET or HEAD only\n");
        refused.headers_mut().insert(ALLOW, HeaderValue::from_static("GET, HEAD"));
        return Ok(refused);
    }
    Ok(match request.uri().path() {
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
    })
}

async fn metrics(source: &Source) -> Response<Full<Bytes>> {
    let Some(snapshot) = source.snapshot().await else { return unanswered() };
    match source.text(&snapshot) {
        Ok(text) => response(StatusCode::OK, series::CONTENT_TYPE, text),
        Err(fmt::Error) => {
            response(StatusCode::INTERNAL_SERVER_ERROR, TEXT, "the metrics cannot be written\n")
        }
    }
}

fn unanswered() -> Response<Full<Bytes>> {
    response(StatusCode::SERVICE_UNAVAILABLE, TEXT, "the control task does not answer\n")
}

fn response(status: StatusCode, content_type: &'static str, body: impl Into<Bytes>) -> Response<Full<Bytes>> {
    let mut response = Response::new(Full::new(body.into()));
    *response.status_mut() = status;
    let headers = response.headers_mut();
    headers.insert(CONTENT_TYPE, HeaderValue::from_static(content_type));
    headers.insert(CACHE_CONTROL, HeaderValue::from_static("no-store"));
    response
}

/// Returns `true` if the header names the host by an address or as `localhost`.
fn names_this_host(host: &HeaderValue) -> bool {
    let Ok(authority) = Authority::try_from(host.as_bytes()) else { return false };
    let host = authority.host();
    let bare = host.strip_prefix('[').and_then(|host| host.strip_suffix(']')).unwrap_or(host);
    bare.eq_ignore_ascii_case("localhost") || bare.parse::<IpAddr>().is_ok()
}
