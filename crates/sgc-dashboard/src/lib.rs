//! `sgc dashboard`: a page that shows the fleet as an observer sees it, live, in a browser.
//!
//! The program asks a node of its user through the status socket, as `sgc fleet status` does (`feed`), and serves the
//! page and its documents on loopback ([`sgc_http`]). It holds no key and joins no network. The page has a token in the
//! fragment of its URL, which browsers send to nobody; each request for a document has to show it, so other users of
//! the host see nothing.
#![forbid(unsafe_code)]

mod feed;
mod view;

use std::convert::Infallible;
use std::net::{Ipv4Addr, SocketAddr};
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::time::Duration;

use aws_lc_rs::constant_time::verify_slices_are_equal;
use rand_core::RngCore as _;
use sgc_diagnosis::diagnose;
use sgc_diagnosis::fleet::{Members, ask_nodes};
use sgc_http::http::header::{AUTHORIZATION, CONTENT_SECURITY_POLICY, HeaderName, HeaderValue};
use sgc_http::http::{Request, StatusCode};
use sgc_http::{Answer, TEXT, response};
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

/// The settings of the dashboard: the fleet to show, and the address of the page.
pub struct DashboardOptions {
    /// Status socket of the node that asks the others.
    pub socket: PathBuf,
    /// Finds the members of the fleet at each look.
    pub find_members: FindMembers,
    /// Address of the page, on loopback; port 0 lets the system choose.
    pub listen: SocketAddr,
}

impl DashboardOptions {
    /// Returns options for the usual address, and for members as the fleet's authority knows them.
    pub fn new(socket: PathBuf) -> Self {
        let find = |socket: &Path| Members::of_authority(socket).map_err(|error| error.to_string());
        Self { socket, find_members: Box::new(find), listen: (Ipv4Addr::LOCALHOST, DASHBOARD_PORT).into() }
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
    token: String,
    socket: PathBuf,
    whys: Arc<Semaphore>,
}

/// Serves the page until the process ends. `ready` gets its URL.
pub fn run(options: DashboardOptions, ready: impl FnOnce(&str)) -> Result<Infallible, DashboardError> {
    let at = options.listen;
    if !at.ip().to_canonical().is_loopback() {
        return Err(DashboardError::NotLoopback(at));
    }
    let token = new_token()?;
    let system = |source| ProcessError::System { what: "threads", source };
    let runtime = tokio::runtime::Builder::new_current_thread().enable_all().build().map_err(system)?;
    let listen = |source| DashboardError::Listen { at, source };
    let listener = runtime.block_on(TcpListener::bind(at)).map_err(listen)?;
    ready(&format!("http://{}/#{token}", listener.local_addr().map_err(listen)?));
    let feed = Feed::start(options.socket.clone(), options.find_members).map_err(system)?;
    let whys = Arc::new(Semaphore::new(WHYS_MAX));
    let server = Arc::new(Server { feed, token, socket: options.socket, whys });
    let answer = move |request| {
        let server = server.clone();
        async move { server.answer(&request).await }
    };
    runtime.block_on(sgc_http::serve(listener, answer));
    unreachable!("the server ends with the process")
}

fn new_token() -> Result<String, ProcessError> {
    let mut bytes = [0; TOKEN_BYTES];
    system_rng()?.fill_bytes(&mut bytes);
    Ok(bytes.iter().map(|byte| format!("{byte:02x}")).collect())
}

impl Server {
    async fn answer(&self, request: &Request<()>) -> Answer {
        let path = request.uri().path();
        if let Some((_, content_type, text)) = FILES.iter().find(|(file, ..)| *file == path) {
            return guarded(response(StatusCode::OK, content_type, *text));
        }
        if !path.starts_with("/api/") {
            return response(StatusCode::NOT_FOUND, TEXT, "there is no such page\n");
        }
        if !self.is_permitted(request) {
            return response(StatusCode::UNAUTHORIZED, TEXT, "open the URL that `sgc dashboard` printed\n");
        }
        let parameter = |name: &str| {
            let query = form_urlencoded::parse(request.uri().query().unwrap_or_default().as_bytes());
            query.into_iter().find(|(key, _)| key == name).map(|(_, value)| value.into_owned())
        };
        match path {
            "/api/fleet" => {
                let after = parameter("after").and_then(|after| after.parse().ok()).unwrap_or_default();
                response(StatusCode::OK, JSON, self.feed.next_after(after, NEWS_MAX).await)
            }
            "/api/why" => match parameter("node").zip(parameter("interface")) {
                Some((node, interface)) => self.why(node, interface).await,
                None => response(StatusCode::BAD_REQUEST, TEXT, "a node and an interface are needed\n"),
            },
            _ => response(StatusCode::NOT_FOUND, TEXT, "there is no such document\n"),
        }
    }

    fn is_permitted(&self, request: &Request<()>) -> bool {
        let shown = request.headers().get(AUTHORIZATION).map(HeaderValue::as_bytes);
        let token = shown.and_then(|shown| shown.strip_prefix(b"Bearer "));
        token.is_some_and(|token| verify_slices_are_equal(token, self.token.as_bytes()).is_ok())
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
