//! `sgc dashboard`: a page that shows the fleet as an observer sees it, live, in a browser.
//!
//! The program asks a node of its user through the status socket, as `sgc fleet status` does (`feed`), and serves the
//! page and its documents on loopback ([`sgc_http`]). It holds no key and joins no network. The page has a token in the
//! fragment of its URL, which browsers send to nobody; each request for a document has to show it, so other users of
//! the host see nothing.
//!
//! Whoever starts it may let the page revoke nodes. That takes another token than looking does, and the same node of the
//! user, which asks the fleet's authority as an operator. There is no other operation.
#![forbid(unsafe_code)]

mod feed;
mod view;

use std::convert::Infallible;
use std::net::{Ipv4Addr, SocketAddr};
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::time::Duration;

use aws_lc_rs::constant_time::verify_slices_are_equal;
use bytes::Bytes;
use rand_core::RngCore as _;
use serde::Deserialize;
use sgc_diagnosis::diagnose;
use sgc_diagnosis::fleet::{Members, ask_nodes};
use sgc_http::http::header::{AUTHORIZATION, CONTENT_SECURITY_POLICY, HeaderName, HeaderValue};
use sgc_http::http::{Method, Request, StatusCode};
use sgc_http::{Answer, PostBounds, TEXT, only_reads, response};
use sgc_node::graph::Graph;
use sgc_process::{ProcessError, system_rng};
use tokio::net::TcpListener;
use tokio::sync::Semaphore;

use self::feed::Feed;
use self::view::WhyView;

/// The port of the page.
pub const DASHBOARD_PORT: u16 = 7480;
/// Bytes of the token, before they become digits.
const TOKEN_BYTES: usize = 16;
/// Longest wait for news, before the last document is given again. A connection that ends completes an answer within
/// that time.
const NEWS_MAX: Duration = Duration::from_secs(8);
/// Most questions to single nodes at a time.
const WHYS_MAX: usize = 4;
/// Most operations at a time.
const OPERATIONS_MAX: usize = 1;
/// Most bytes of the body of an operation: names of nodes have at most 63.
const OPERATION_BYTES_MAX: usize = 256;
/// The place of the only operation.
const REVOKE: &str = "/api/revoke";

const JSON: &str = "application/json";
/// The page may load its own files and ask its own server, and no page may have it in a frame.
const POLICY: &str = "default-src 'none'; script-src 'self'; style-src 'self'; connect-src 'self'; img-src data:; \
                      frame-ancestors 'none'; base-uri 'none'; form-action 'none'";
/// The files of the page.
const FILES: [(&str, &str, &str); 3] = [
    ("/", "text/html; charset=utf-8", include_str!("page/index.html")),
    ("/app.js", "text/javascript; charset=utf-8", include_str!("page/app.js")),
    ("/app.css", "text/css; charset=utf-8", include_str!("page/app.css")),
];

/// Finds the members of the fleet of the node at a socket, or says why not.
pub type FindMembers = Box<dyn Fn(&Path) -> Result<Members, String> + Send + Sync>;

/// Has the node at a socket ask the fleet's authority to revoke the node of this name. Returns the number of the new
/// revocation list, or the reason why it was refused, with the remedy.
pub type Revoke = Box<dyn Fn(&Path, &str) -> Result<u64, String> + Send + Sync>;

/// The settings of the dashboard: the fleet to show, and the address of the page.
pub struct DashboardOptions {
    /// Status socket of the node that asks the others.
    pub socket: PathBuf,
    /// Finds the members of the fleet at each look.
    pub find_members: FindMembers,
    /// Address of the page, on loopback; port 0 lets the system choose.
    pub listen: SocketAddr,
    /// Revokes nodes; without it, the page only shows.
    pub revoke: Option<Revoke>,
}

/// The URLs of the page.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct PageUrls {
    /// The URL whose token lets the page read.
    pub look: String,
    /// The URL whose token also lets it revoke; `None` if nobody may.
    pub operate: Option<String>,
}

/// The right that a token gives.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Right {
    /// To read documents.
    Look,
    /// To read documents, and to revoke nodes.
    Operate,
}

impl DashboardOptions {
    /// Returns options for the usual address, and for members as the fleet's authority knows them.
    pub fn new(socket: PathBuf) -> Self {
        let find = |socket: &Path| Members::of_authority(socket).map_err(|error| error.to_string());
        let listen = (Ipv4Addr::LOCALHOST, DASHBOARD_PORT).into();
        Self { socket, find_members: Box::new(find), listen, revoke: None }
    }
}

/// Reasons why there is no page.
#[derive(Debug, thiserror::Error)]
pub enum DashboardError {
    /// The address is not on loopback.
    #[error(
        "{0} is not an address of loopback, and the page is plain HTTP: forward the port by SSH (docs/how-to/fleet.md)"
    )]
    NotLoopback(SocketAddr),
    /// The address cannot be had.
    #[error("{at}: {source}")]
    Listen {
        /// The address.
        at: SocketAddr,
        /// The system's error.
        source: std::io::Error,
    },
    /// The system gives no randomness or no threads.
    #[error(transparent)]
    Process(#[from] ProcessError),
}

/// Answers the requests of pages.
struct Server {
    feed: Arc<Feed>,
    /// The token of each right that somebody has.
    tokens: Vec<(Right, String)>,
    socket: PathBuf,
    whys: Arc<Semaphore>,
    revoke: Option<Arc<Revoke>>,
    operations: Arc<Semaphore>,
}

/// The body of a request to revoke a node.
#[derive(Debug, Deserialize)]
#[serde(deny_unknown_fields)]
struct RevokeRequest {
    node: String,
}

/// Serves the page until the process ends. `ready` gets its URLs.
pub fn run(options: DashboardOptions, ready: impl FnOnce(&PageUrls)) -> Result<Infallible, DashboardError> {
    let at = options.listen;
    if !at.ip().to_canonical().is_loopback() {
        return Err(DashboardError::NotLoopback(at));
    }
    let look = new_token()?;
    let operate = options.revoke.is_some().then(new_token).transpose()?;
    let system = |source| ProcessError::System { what: "threads", source };
    let runtime = tokio::runtime::Builder::new_current_thread().enable_all().build().map_err(system)?;
    let listen = |source| DashboardError::Listen { at, source };
    let listener = runtime.block_on(TcpListener::bind(at)).map_err(listen)?;
    let local = listener.local_addr().map_err(listen)?;
    let url = |token: &String| format!("http://{local}/#{token}");
    ready(&PageUrls { look: url(&look), operate: operate.as_ref().map(url) });
    let feed = Feed::start(options.socket.clone(), options.find_members).map_err(system)?;
    let server = Arc::new(Server {
        feed,
        tokens: std::iter::once((Right::Look, look))
            .chain(operate.map(|token| (Right::Operate, token)))
            .collect(),
        socket: options.socket,
        whys: Arc::new(Semaphore::new(WHYS_MAX)),
        revoke: options.revoke.map(Arc::new),
        operations: Arc::new(Semaphore::new(OPERATIONS_MAX)),
    });
    let admitting = server.clone();
    let admit = move |head: &Request<()>| admitting.admit(head);
    let answer = move |request| {
        let server = server.clone();
        async move { server.answer(&request).await }
    };
    runtime.block_on(sgc_http::serve_posts(listener, admit, answer));
    unreachable!("the server ends with the process")
}

fn new_token() -> Result<String, ProcessError> {
    let mut bytes = [0; TOKEN_BYTES];
    system_rng()?.fill_bytes(&mut bytes);
    Ok(bytes.iter().map(|byte| format!("{byte:02x}")).collect())
}

impl Server {
    /// Returns the bounds of an operation, or its refusal. Its body is read only afterwards.
    fn admit(&self, head: &Request<()>) -> Result<PostBounds, Box<Answer>> {
        if head.uri().path() != REVOKE {
            return Err(only_reads().into());
        }
        match self.right(head) {
            None => Err(without_token().into()),
            Some(Right::Look) => {
                let why =
                    "this page only shows: start it with `sgc dashboard --operate` and open the first URL\n";
                Err(response(StatusCode::FORBIDDEN, TEXT, why).into())
            }
            Some(Right::Operate) => {
                Ok(PostBounds { content_type: JSON, body_bytes_max: OPERATION_BYTES_MAX })
            }
        }
    }

    async fn answer(&self, request: &Request<Bytes>) -> Answer {
        let path = request.uri().path();
        if let Some((_, content_type, text)) = FILES.iter().find(|(file, ..)| *file == path) {
            return guarded(response(StatusCode::OK, content_type, *text));
        }
        if !path.starts_with("/api/") {
            return response(StatusCode::NOT_FOUND, TEXT, "there is no such page\n");
        }
        let Some(right) = self.right(request) else { return without_token() };
        if request.method() == Method::POST {
            // Only an admitted one comes here.
            return self.revoke(request.body()).await;
        }
        let parameter = |name: &str| {
            let query = form_urlencoded::parse(request.uri().query().unwrap_or_default().as_bytes());
            query.into_iter().find(|(key, _)| key == name).map(|(_, value)| value.into_owned())
        };
        match path {
            "/api/fleet" => {
                let after = parameter("after").and_then(|after| after.parse().ok()).unwrap_or_default();
                response(
                    StatusCode::OK,
                    JSON,
                    self.feed.next_after(after, NEWS_MAX, right == Right::Operate).await,
                )
            }
            "/api/why" => match parameter("node").zip(parameter("interface")) {
                Some((node, interface)) => self.why(node, interface).await,
                None => response(StatusCode::BAD_REQUEST, TEXT, "a node and an interface are needed\n"),
            },
            _ => response(StatusCode::NOT_FOUND, TEXT, "there is no such document\n"),
        }
    }

    /// Returns the right of the token that a request shows.
    fn right<B>(&self, request: &Request<B>) -> Option<Right> {
        let shown = request.headers().get(AUTHORIZATION).map(HeaderValue::as_bytes);
        let shown = shown.and_then(|shown| shown.strip_prefix(b"Bearer "))?;
        let is_shown = |token: &str| verify_slices_are_equal(shown, token.as_bytes()).is_ok();
        self.tokens.iter().find(|(_, token)| is_shown(token)).map(|(right, _)| *right)
    }

    /// Revokes a node, if the authority takes the node here for an operator.
    async fn revoke(&self, body: &Bytes) -> Answer {
        let Some(revoke) = self.revoke.clone() else { return only_reads() };
        let Ok(RevokeRequest { node }) = serde_json::from_slice(body) else {
            return response(StatusCode::BAD_REQUEST, TEXT, "the name of a node is needed\n");
        };
        let Ok(place) = self.operations.clone().try_acquire_owned() else {
            let why = "another operation is under way: wait until it has ended\n";
            return response(StatusCode::SERVICE_UNAVAILABLE, TEXT, why);
        };
        let socket = self.socket.clone();
        let done = tokio::task::spawn_blocking(move || {
            // Also if the page has left meanwhile.
            let _place = place;
            revoke(&socket, &node)
        });
        match done
            .await
            .unwrap_or_else(|_| Err("the request failed: see whether it was carried out".to_owned()))
        {
            Ok(list) => response(StatusCode::OK, JSON, format!("{{\"list\":{list}}}")),
            Err(why) => response(StatusCode::CONFLICT, TEXT, why + "\n"),
        }
    }

    /// Explains why an interface of a node does not flow.
    async fn why(&self, node: String, interface: String) -> Answer {
        let Ok(place) = self.whys.clone().acquire_owned().await else {
            return response(StatusCode::SERVICE_UNAVAILABLE, TEXT, "");
        };
        let socket = self.socket.clone();
        let view = tokio::task::spawn_blocking(move || {
            // Also if the page has left meanwhile.
            let _place = place;
            let answer = ask_nodes(&socket, &[node], Some(&interface))
                .map_err(|error| error.to_string())?
                .pop()
                .unwrap_or_default();
            let Some(graph) = answer.graph else {
                return Err(format!("{}. {}", answer.error.unwrap_or_default(), answer.fix));
            };
            let unreadable = |_| "its report cannot be read: compare the versions of sgc".to_owned();
            let graph: Graph = serde_json::from_str(&graph).map_err(unreadable)?;
            Ok(diagnose::interface(&graph, &interface))
        });
        let view = view.await.unwrap_or_else(|_| Err("the question failed".to_owned()));
        let json = serde_json::to_string(&WhyView::new(view)).unwrap_or_default();
        response(StatusCode::OK, JSON, json)
    }
}

/// Returns the refusal of a request that shows no valid token.
fn without_token() -> Answer {
    response(StatusCode::UNAUTHORIZED, TEXT, "open the URL that `sgc dashboard` printed\n")
}

/// Adds the headers that keep other pages away from this one.
fn guarded(mut answer: Answer) -> Answer {
    let headers = answer.headers_mut();
    headers.insert(CONTENT_SECURITY_POLICY, HeaderValue::from_static(POLICY));
    for (name, value) in [
        ("x-content-type-options", "nosniff"),
        ("referrer-policy", "no-referrer"),
        ("cross-origin-opener-policy", "same-origin"),
        ("cross-origin-resource-policy", "same-origin"),
    ] {
        headers.insert(HeaderName::from_static(name), HeaderValue::from_static(value));
    }
    answer
}
