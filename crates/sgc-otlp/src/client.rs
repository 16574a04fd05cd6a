//! [`Client`]: one request over a connection of its own.
//!
//! Requests are a minute apart, so a connection is not worth keeping. A new one follows the collector's DNS name.

use std::fmt;
use std::io;
use std::net::SocketAddr;
use std::sync::Arc;
use std::time::Duration;

use bytes::Bytes;
use http::header::{
    ACCEPT, CONTENT_LENGTH, CONTENT_TYPE as CONTENT_TYPE_HEADER, HOST, HeaderMap, HeaderName, HeaderValue,
    LOCATION, RETRY_AFTER, USER_AGENT,
};
use http::{Method, Request};
use http_body_util::{BodyExt as _, Full};
use hyper::body::{Body as _, Incoming};
use hyper::client::conn::http1;
use hyper_util::rt::TokioIo;
use rustls::{ClientConfig, RootCertStore};
use rustls_pki_types::{CertificateDer, ServerName};
use tokio::io::{AsyncRead, AsyncWrite};
use tokio::net::TcpStream;
use tokio::task::JoinSet;
use tokio::time::timeout;
use tokio_rustls::TlsConnector;

use crate::answer::{Answer, BODY_BYTES_MAX};
use crate::fault::Fault;
use crate::request::CONTENT_TYPE;

/// The longest time of a request, from the look-up of the host to the end of the answer: the default of
/// `OTEL_EXPORTER_OTLP_TIMEOUT`.
pub const REQUEST_MAX: Duration = Duration::from_secs(10);
/// The longest wait for one of several addresses.
const CONNECT_MAX: Duration = Duration::from_secs(3);
/// Most addresses of the host that are tried.
const ADDRESSES_MAX: usize = 4;
/// Most bytes of an answer's head, and most headers.
const HEAD_BYTES_MAX: usize = 16 << 10;
const HEADERS_MAX: usize = 64;

/// The place of a collector.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Endpoint {
    /// Whether the connection has TLS.
    pub is_encrypted: bool,
    /// A name, an IPv4 address, or an IPv6 address without brackets.
    pub host: String,
    /// The port.
    pub port: u16,
    /// The `Host` of requests.
    pub authority: String,
    /// The path of requests for metrics.
    pub path: String,
}

/// The CAs that vouch for a collector.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum TrustedRoots {
    /// Those of the operating system, or of the file that `SSL_CERT_FILE` names.
    System,
    /// These alone.
    Certificates(Vec<CertificateDer<'static>>),
}

/// Sends requests to a collector.
pub struct Client {
    endpoint: Endpoint,
    /// `None` without TLS.
    tls: Option<(TlsConnector, ServerName<'static>)>,
    user_agent: HeaderValue,
}

impl fmt::Debug for Client {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_struct("Client").field("endpoint", &self.endpoint).finish_non_exhaustive()
    }
}

impl Client {
    /// Creates a client that calls itself `sgc/VERSION`. Reads the roots of the system if they are wanted, which blocks.
    pub fn new(endpoint: Endpoint, roots: TrustedRoots, version: &str) -> Result<Self, Fault> {
        let failed = |error: &dyn fmt::Display| Fault::Tls { reason: error.to_string() };
        let tls = match endpoint.is_encrypted {
            false => None,
            true => {
                let name = ServerName::try_from(endpoint.host.clone()).map_err(|error| failed(&error))?;
                Some((TlsConnector::from(Arc::new(tls_config(roots)?)), name))
            }
        };
        let user_agent = HeaderValue::try_from(format!("sgc/{version}")).map_err(|error| failed(&error))?;
        Ok(Self { endpoint, tls, user_agent })
    }

    /// Sends a request, and returns the answer with any status.
    pub async fn push(&self, body: Vec<u8>, headers: HeaderMap) -> Result<Answer, Fault> {
        match timeout(REQUEST_MAX, self.push_on_time(body, headers)).await {
            Ok(result) => result,
            Err(_) => Err(Fault::TimedOut { within: REQUEST_MAX }),
        }
    }

    async fn push_on_time(&self, body: Vec<u8>, headers: HeaderMap) -> Result<Answer, Fault> {
        let request = self.request(body, headers)?;
        let stream = self.connect().await?;
        match &self.tls {
            None => exchange(stream, request).await,
            Some((tls, name)) => {
                let stream = tls
                    .connect(name.clone(), stream)
                    .await
                    .map_err(|error| Fault::Tls { reason: error.to_string() })?;
                exchange(stream, request).await
            }
        }
    }

    async fn connect(&self) -> Result<TcpStream, Fault> {
        let Endpoint { host, port, .. } = &self.endpoint;
        let unreachable = |reason: String| Fault::Unreachable { reason };
        let found = tokio::net::lookup_host((host.as_str(), *port))
            .await
            .map_err(|error| unreachable(format!("{host} cannot be looked up: {error}")))?;
        let mut last = format!("{host} has no address");
        for address in found.take(ADDRESSES_MAX) {
            match connect_to(address).await {
                Ok(stream) => return Ok(stream),
                Err(error) => last = format!("{address}: {error}"),
            }
        }
        Err(unreachable(last))
    }

    fn request(&self, body: Vec<u8>, headers: HeaderMap) -> Result<Request<Full<Bytes>>, Fault> {
        let broken = |error: &dyn fmt::Display| Fault::Broken { reason: error.to_string() };
        let host = HeaderValue::try_from(&self.endpoint.authority).map_err(|error| broken(&error))?;
        let length = body.len();
        let mut request = Request::builder()
            .method(Method::POST)
            .uri(self.endpoint.path.as_str())
            .body(Full::new(Bytes::from(body)))
            .map_err(|error| broken(&error))?;
        let all = request.headers_mut();
        // Those of the protocol last: none of the others may replace them.
        all.extend(headers);
        all.insert(HOST, host);
        all.insert(CONTENT_TYPE_HEADER, HeaderValue::from_static(CONTENT_TYPE));
        all.insert(ACCEPT, HeaderValue::from_static(CONTENT_TYPE));
        all.insert(CONTENT_LENGTH, HeaderValue::from(length));
        all.insert(USER_AGENT, self.user_agent.clone());
        Ok(request)
    }
}

async fn connect_to(address: SocketAddr) -> io::Result<TcpStream> {
    timeout(CONNECT_MAX, TcpStream::connect(address))
        .await
        .unwrap_or_else(|_| Err(io::ErrorKind::TimedOut.into()))
}

/// Sends a request over a connection, and reads the answer within its bounds.
async fn exchange<S>(stream: S, request: Request<Full<Bytes>>) -> Result<Answer, Fault>
where
    S: AsyncRead + AsyncWrite + Unpin + Send + 'static,
{
    let broken = |error: hyper::Error| Fault::Broken { reason: with_cause(&error) };
    let mut builder = http1::Builder::new();
    builder.max_buf_size(HEAD_BYTES_MAX).max_headers(HEADERS_MAX);
    let (mut sender, connection) = builder.handshake(TokioIo::new(stream)).await.map_err(broken)?;
    // Ends with this function, whatever the collector goes on to send.
    let mut tasks = JoinSet::new();
    tasks.spawn(connection);
    let (head, mut body) = sender.send_request(request).await.map_err(broken)?.into_parts();
    let text = |name: HeaderName| Some(head.headers.get(name)?.to_str().ok()?.to_owned());
    let mut answer = Answer {
        status: head.status.as_u16(),
        content_type: text(CONTENT_TYPE_HEADER),
        retry_after: text(RETRY_AFTER),
        location: text(LOCATION),
        ..Answer::default()
    };
    read_body(&mut body, &mut answer).await.map_err(broken)?;
    Ok(answer)
}

async fn read_body(body: &mut Incoming, answer: &mut Answer) -> Result<(), hyper::Error> {
    while !body.is_end_stream() {
        let Some(frame) = body.frame().await else { return Ok(()) };
        let Ok(data) = frame?.into_data() else { continue };
        let room = BODY_BYTES_MAX - answer.body.len();
        answer.body.extend_from_slice(&data[..data.len().min(room)]);
        if data.len() > room {
            answer.is_cut = true;
            return Ok(());
        }
    }
    Ok(())
}

/// Returns an error of hyper with its cause, which its own text lacks.
fn with_cause(error: &hyper::Error) -> String {
    match std::error::Error::source(error) {
        Some(cause) => format!("{error}: {cause}"),
        None => error.to_string(),
    }
}

fn tls_config(roots: TrustedRoots) -> Result<ClientConfig, Fault> {
    let failed = |reason: String| Fault::Tls { reason };
    let mut store = RootCertStore::empty();
    match roots {
        TrustedRoots::Certificates(certificates) => {
            for certificate in certificates {
                store.add(certificate).map_err(|error| failed(error.to_string()))?;
            }
        }
        TrustedRoots::System => {
            // One bad file among hundreds must not hide the others.
            store.add_parsable_certificates(rustls_native_certs::load_native_certs().certs);
        }
    }
    if store.is_empty() {
        return Err(failed(
            "this system has no CA certificates: install them (`ca-certificates`), or name a file".into(),
        ));
    }
    let provider = Arc::new(rustls::crypto::aws_lc_rs::default_provider());
    let config = ClientConfig::builder_with_provider(provider)
        .with_safe_default_protocol_versions()
        .map_err(|error| failed(error.to_string()))?;
    let mut config = config.with_root_certificates(store).with_no_client_auth();
    config.alpn_protocols = vec![b"http/1.1".to_vec()];
    Ok(config)
}
