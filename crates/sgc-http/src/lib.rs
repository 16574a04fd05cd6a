//! A small HTTP server for documents: hyper's, with the bounds and checks that every server of this workspace wants.
//!
//! Clients that send no request keep nobody out: at the limit, a connection that had none gives way to a new one, or
//! else that whose last one is longest ago. A web page of another site cannot read answers: the server allows no other
//! origin, and over loopback it answers only requests to the host by its address or as `localhost`, so a page cannot
//! read them by DNS rebinding.
//!
//! A server answers GET and HEAD. One on loopback may take POST at chosen places ([`serve_posts`]), whose body is read
//! only after the server admitted the head and this crate found that no other site sent it.
#![forbid(unsafe_code)]

use std::convert::Infallible;
use std::net::IpAddr;
use std::pin::pin;
use std::sync::{Arc, Mutex};
use std::time::{Duration, Instant};

use bytes::Bytes;
pub use http;
use http::header::{ALLOW, CACHE_CONTROL, CONTENT_TYPE, HOST, HeaderMap, HeaderName, HeaderValue, ORIGIN};
use http::uri::Authority;
use http::{Method, Request, Response, StatusCode};
use http_body_util::{BodyExt as _, Full, LengthLimitError, Limited};
use hyper::body::Incoming;
use hyper::server::conn::http1;
use hyper::service::service_fn;
use hyper_util::rt::{TokioIo, TokioTimer};
use sgc_sync::lock;
use tokio::net::{TcpListener, TcpStream};
use tokio::task::{AbortHandle, JoinSet};
use tokio::time::timeout;
use tracing::debug;

/// Most connections at a time.
const CONNECTIONS_MAX: usize = 32;
/// Longest time in which a request arrives, and in which a connection may be idle. Clients connect again.
const REQUEST_MAX: Duration = Duration::from_secs(10);
/// Longest life of a connection, so that a client that reads nothing keeps no place.
const CONNECTION_MAX: Duration = Duration::from_secs(120);
/// Most bytes of a request's head.
const HEAD_BYTES_MAX: usize = 16 << 10;
/// Pause after the system refused to accept a connection.
const ACCEPT_RETRY: Duration = Duration::from_millis(100);

/// An answer to a request.
pub type Answer = Response<Full<Bytes>>;

/// The header by which browsers tell which site a request is from (W3C Fetch Metadata).
const SEC_FETCH_SITE: HeaderName = HeaderName::from_static("sec-fetch-site");

/// The bounds of a POST that a server takes.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct PostBounds {
    /// The content type, without parameters.
    pub content_type: &'static str,
    /// Most bytes of the body.
    pub body_bytes_max: usize,
}

/// The content type of plain text.
pub const TEXT: &str = "text/plain; charset=utf-8";

/// A connection that is connections.
struct Connection {
    task: AbortHandle,
    activity: Arc<Mutex<Activity>>,
}

/// The activity of a connection. The least gives way first.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
struct Activity {
    is_answering: bool,
    had_request: bool,
    /// When it was accepted, or its last request came.
    at: Instant,
}

/// Serves connections until it is dropped. `answer` answers a request by GET or HEAD, whose body is not read.
pub async fn serve<A, F>(listener: TcpListener, answer: A)
where
    A: Fn(Request<()>) -> F + Clone + Send + Sync + 'static,
    F: Future<Output = Answer> + Send,
{
    let answer = move |request: Request<Bytes>| answer(request.map(drop));
    serve_posts(listener, |_: &Request<()>| Err(only_reads().into()), answer).await;
}

/// Serves connections until it is dropped, also POST over loopback. `admit` sees the head of a POST before its body is
/// read, and returns the bounds of the body or the refusal; [`only_reads`] is that of a place without POST. `answer` gets
/// a body only with POST.
pub async fn serve_posts<P, A, F>(listener: TcpListener, admit: P, answer: A)
where
    P: Fn(&Request<()>) -> Result<PostBounds, Box<Answer>> + Clone + Send + Sync + 'static,
    A: Fn(Request<Bytes>) -> F + Clone + Send + Sync + 'static,
    F: Future<Output = Answer> + Send,
{
    let mut tasks = JoinSet::new();
    let mut connections: Vec<Connection> = Vec::new();
    loop {
        let stream = match listener.accept().await {
            Ok((stream, _)) => stream,
            Err(error) => {
                // The process may have too many open files, for example.
                debug!(%error, "a connection is not accepted");
                tokio::time::sleep(ACCEPT_RETRY).await;
                continue;
            }
        };
        while tasks.try_join_next().is_some() {}
        connections.retain(|one| !one.task.is_finished());
        if connections.len() >= CONNECTIONS_MAX {
            let activity = |at: &usize| *lock(&connections[*at].activity);
            match (0..connections.len()).min_by_key(activity).filter(|at| !activity(at).is_answering) {
                Some(idlest) => connections.swap_remove(idlest).task.abort(),
                None => continue,
            }
        }
        let activity = Activity { is_answering: false, had_request: false, at: Instant::now() };
        let activity = Arc::new(Mutex::new(activity));
        let (admit, answer, noted) = (admit.clone(), answer.clone(), activity.clone());
        let task = tasks.spawn(async move { serve_one(stream, &admit, &answer, &noted).await });
        connections.push(Connection { task, activity });
    }
}

/// Serves a connection, and notes when requests come.
async fn serve_one<P, A, F>(stream: TcpStream, admit: &P, answer: &A, activity: &Mutex<Activity>)
where
    P: Fn(&Request<()>) -> Result<PostBounds, Box<Answer>>,
    A: Fn(Request<Bytes>) -> F,
    F: Future<Output = Answer>,
{
    let is_local = stream.local_addr().is_ok_and(|at| at.ip().to_canonical().is_loopback());
    let service = service_fn(async |request: Request<Incoming>| {
        *lock(activity) = Activity { is_answering: true, had_request: true, at: Instant::now() };
        let response = match accepted(request, is_local, admit).await {
            Err(refused) => *refused,
            Ok(request) => answer(request).await,
        };
        lock(activity).is_answering = false;
        Ok::<_, Infallible>(response)
    });
    let mut server = http1::Builder::new();
    server.timer(TokioTimer::new()).header_read_timeout(REQUEST_MAX).max_buf_size(HEAD_BYTES_MAX);
    let mut connection = pin!(server.serve_connection(TokioIo::new(stream), service));
    let ended = match timeout(CONNECTION_MAX, &mut connection).await {
        Ok(ended) => ended,
        Err(_) => {
            // An answer under way is completed.
            connection.as_mut().graceful_shutdown();
            timeout(REQUEST_MAX, connection).await.unwrap_or(Ok(()))
        }
    };
    if let Err(error) = ended {
        debug!(%error, "a connection ended");
    }
}

/// Returns a request with its body, or the refusal of one that no server here answers.
async fn accepted(
    request: Request<Incoming>,
    is_local: bool,
    admit: impl Fn(&Request<()>) -> Result<PostBounds, Box<Answer>>,
) -> Result<Request<Bytes>, Box<Answer>> {
    let host = request.headers().get(HOST);
    if is_local && host.is_some_and(|host| !names_this_host(host)) {
        let why = "this server answers only at its address and as localhost\n";
        return Err(response(StatusCode::MISDIRECTED_REQUEST, TEXT, why).into());
    }
    let (head, body) = request.into_parts();
    let head = Request::from_parts(head, ());
    match *head.method() {
        Method::GET | Method::HEAD => return Ok(head.map(|()| Bytes::new())),
        Method::POST if is_local => {}
        _ => return Err(only_reads().into()),
    }
    let bounds = admit(&head)?;
    if !is_of_own_page(head.headers()) {
        return Err(
            response(StatusCode::FORBIDDEN, TEXT, "only the page of this server may send this\n").into()
        );
    }
    if head.headers().get(CONTENT_TYPE).is_none_or(|sent| sent != bounds.content_type) {
        let why = format!("the content type has to be {}\n", bounds.content_type);
        return Err(response(StatusCode::UNSUPPORTED_MEDIA_TYPE, TEXT, why).into());
    }
    match timeout(REQUEST_MAX, Limited::new(body, bounds.body_bytes_max).collect()).await {
        Ok(Ok(body)) => Ok(head.map(|()| body.to_bytes())),
        Ok(Err(error)) if error.is::<LengthLimitError>() => {
            let why = format!("at most {} bytes are taken\n", bounds.body_bytes_max);
            Err(response(StatusCode::PAYLOAD_TOO_LARGE, TEXT, why).into())
        }
        Ok(Err(_)) => Err(response(StatusCode::BAD_REQUEST, TEXT, "the body cannot be read\n").into()),
        Err(_) => {
            Err(response(StatusCode::REQUEST_TIMEOUT, TEXT, "the body did not arrive in time\n").into())
        }
    }
}

/// Returns the refusal of a method other than GET and HEAD.
pub fn only_reads() -> Answer {
    let mut refused = response(StatusCode::METHOD_NOT_ALLOWED, TEXT, "GET or HEAD only\n");
    refused.headers_mut().insert(ALLOW, HeaderValue::from_static("GET, HEAD"));
    refused
}

/// Returns `true` if the headers of a POST are those of a page that this server served. Browsers name the origin of
/// every POST (WHATWG Fetch), and newer ones its relation to this server.
fn is_of_own_page(headers: &HeaderMap) -> bool {
    let only = |name: &HeaderName| {
        let mut all = headers.get_all(name).iter();
        all.next().filter(|_| all.next().is_none()).map(HeaderValue::as_bytes)
    };
    let origin = only(&ORIGIN).and_then(|origin| origin.strip_prefix(b"http://"));
    let is_own = origin.is_some() && origin == only(&HOST);
    is_own && (!headers.contains_key(&SEC_FETCH_SITE) || only(&SEC_FETCH_SITE) == Some(b"same-origin"))
}

/// Returns a response that is not stored anywhere.
pub fn response(status: StatusCode, content_type: &'static str, body: impl Into<Bytes>) -> Answer {
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
