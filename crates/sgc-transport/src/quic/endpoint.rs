//! Making QUIC links: listening and dialling.
//!
//! A link is handed out only after both certificates were verified and the greetings were exchanged. The latter is
//! also how a dialer learns that it was accepted: in TLS 1.3 the client's handshake is over before the
//! server has looked at its certificate.

use std::net::{Ipv4Addr, Ipv6Addr, SocketAddr, UdpSocket};
use std::sync::{Arc, Mutex, PoisonError};
use std::time::{Duration, Instant};

use quinn::crypto::rustls::HandshakeData;
use quinn::{Connecting, Connection, ConnectionError, Endpoint, Incoming, TransportConfig, VarInt};
use rustls::NamedGroup;
use sgc_trust::CertError;
use sgc_wire::{Decode, DecodeError, Encode};
use tokio::task::JoinSet;
use tokio::time::{sleep, timeout};

use super::reserve::Reserve;
use super::verifier::Findings;
use super::{
    ControlRx, Fate, Inlet, Outlet, PRIORITY_CONTROL, QuicLink, Shared, canonical, close, config, send_frame,
};
use crate::credentials::CredentialStore;
use crate::error::{CloseReason, DialError, LinkError, PeerRefusal, ProtocolError, Refusal};
use crate::framing::{Greeting, Pieces};
use crate::link::KeyExchange;
use crate::metrics::TransportMetrics;
use crate::options::LinkOptions;
use crate::url::LinkUrl;

/// TLS requires a name; ours is neither sent nor compared.
const SERVER_NAME: &str = "sgc.invalid";
/// Most addresses of one host that are tried.
const ADDRESSES_MAX: usize = 8;
/// How long one address may be silent before the next is tried beside it (as in RFC 8305).
const STAGGER: Duration = Duration::from_millis(300);
/// How often refusals for want of capacity are reported one by one.
const OVERLOAD_REPORT_INTERVAL: Duration = Duration::from_secs(1);
/// How long a closing endpoint waits for its peers to have heard of it.
const DRAIN_TIMEOUT: Duration = Duration::from_secs(1);

/// Awaits QUIC links on one socket.
pub(crate) struct QuicListener {
    endpoint: Endpoint,
    local: SocketAddr,
    acceptor: Arc<Acceptor>,
    handshakes: JoinSet<(SocketAddr, Result<QuicLink, Refusal>)>,
    overload: Overload,
}

/// What every incoming handshake needs.
struct Acceptor {
    credentials: CredentialStore,
    options: LinkOptions,
    transport: Arc<TransportConfig>,
    metrics: Arc<TransportMetrics>,
}

/// Refusals for want of capacity come in floods; one report in a while tells as much.
#[derive(Default)]
struct Overload {
    last_report: Option<Instant>,
    unreported: u64,
}

impl Overload {
    fn note(&mut self, pending: usize) -> Option<Refusal> {
        self.unreported += 1;
        let is_due = self.last_report.is_none_or(|t| t.elapsed() >= OVERLOAD_REPORT_INTERVAL);
        is_due.then(|| {
            self.last_report = Some(Instant::now());
            Refusal::TooMany { pending, unreported: std::mem::take(&mut self.unreported) - 1 }
        })
    }
}

impl QuicListener {
    pub(crate) fn bind(
        addr: SocketAddr,
        credentials: CredentialStore,
        options: LinkOptions,
        metrics: Arc<TransportMetrics>,
    ) -> std::io::Result<Self> {
        let socket = UdpSocket::bind(addr)?;
        let local = socket.local_addr()?;
        let transport = config::transport(&options);
        let server = config::listener(&credentials, &options, &transport);
        let runtime = quinn::default_runtime().ok_or_else(|| std::io::Error::other("no tokio runtime"))?;
        let endpoint_config = config::endpoint(credentials.identity().reset_key(), local.port());
        let endpoint = Endpoint::new(endpoint_config, Some(server), socket, runtime)?;
        let acceptor = Arc::new(Acceptor { credentials, options, transport, metrics });
        Ok(Self { endpoint, local, acceptor, handshakes: JoinSet::new(), overload: Overload::default() })
    }

    pub(crate) fn local_addr(&self) -> SocketAddr {
        self.local
    }

    pub(crate) async fn accept(&mut self) -> Option<Result<QuicLink, (SocketAddr, Refusal)>> {
        loop {
            tokio::select! {
                Some(done) = self.handshakes.join_next() => match done {
                    Ok((_, Ok(link))) => return Some(Ok(link)),
                    Ok((remote, Err(refusal))) => return Some(Err((remote, refusal))),
                    Err(error) => tracing::error!(%error, "a handshake ended abnormally"),
                },
                incoming = self.endpoint.accept() => {
                    let incoming = incoming?;
                    let remote = canonical(incoming.remote_address());
                    if let Some(refusal) = self.admit(incoming) {
                        return Some(Err((remote, refusal)));
                    }
                }
            }
        }
    }

    pub(crate) async fn close(&mut self, reason: &CloseReason) {
        self.handshakes.abort_all();
        shut(&self.endpoint, reason).await;
    }

    fn admit(&mut self, incoming: Incoming) -> Option<Refusal> {
        let pending = self.handshakes.len();
        let LinkOptions { handshakes_max, handshakes_unvalidated_max, .. } = self.acceptor.options;
        if pending >= handshakes_max {
            incoming.refuse();
            let refusal = Refusal::TooMany { pending, unreported: 0 };
            self.acceptor.metrics.count_refused(refusal.kind());
            return self.overload.note(pending);
        }
        if pending >= handshakes_unvalidated_max && incoming.may_retry() {
            // Cannot fail after `may_retry`.
            let _ = incoming.retry();
            return None;
        }
        let acceptor = Arc::clone(&self.acceptor);
        let pending = acceptor.metrics.pending();
        self.handshakes.spawn(async move {
            let _pending = pending;
            let remote = canonical(incoming.remote_address());
            (remote, acceptor.handshake(incoming).await)
        });
        None
    }
}

impl Acceptor {
    async fn handshake(&self, incoming: Incoming) -> Result<QuicLink, Refusal> {
        let after = self.options.handshake_timeout;
        let result = timeout(after, self.link(incoming)).await.unwrap_or(Err(Refusal::TimedOut { after }));
        match &result {
            Ok(_) => self.metrics.count_accepted(),
            Err(refusal) => self.metrics.count_refused(refusal.kind()),
        }
        result
    }

    async fn link(&self, incoming: Incoming) -> Result<QuicLink, Refusal> {
        let (server, findings) = config::server(&self.credentials, &self.options, &self.transport);
        let refusal = |e: ConnectionError| refusal(&findings, &e, &self.options);
        let connection = incoming.accept_with(Arc::new(server)).map_err(refusal)?.await.map_err(refusal)?;
        let fate = Fate::new(self.options.idle_timeout);
        let reserve = Arc::new(Reserve::new(&connection, self.options.send_window_bytes.into()));
        let greeted = async {
            let (tx, rx) = connection.accept_bi().await.map_err(|e| fate.explain(&e))?;
            let mut tx = Outlet::new(tx, PRIORITY_CONTROL, &fate, &reserve);
            let mut rx = ControlRx { inlet: Inlet::new(rx, &fate), pieces: Pieces::default() };
            hear_greeting(&mut rx).await?;
            send_frame(&mut tx, Greeting.to_bytes()).await?;
            Ok((tx, rx))
        };
        match greeted.await {
            Ok(control) => link(connection, &findings, false, control, fate).map_err(Refusal::Certificate),
            Err(error) => Err(ungreeted(&connection, &fate, error)),
        }
    }
}

/// Dials QUIC links, all from one socket for each address family.
pub(crate) struct QuicDialer {
    credentials: CredentialStore,
    options: LinkOptions,
    transport: Arc<TransportConfig>,
    metrics: Arc<TransportMetrics>,
    endpoints: Mutex<Endpoints>,
}

#[derive(Default)]
struct Endpoints {
    v4: Option<Endpoint>,
    v6: Option<Endpoint>,
}

impl QuicDialer {
    pub(crate) fn new(
        credentials: CredentialStore,
        options: LinkOptions,
        metrics: Arc<TransportMetrics>,
    ) -> Self {
        let transport = config::transport(&options);
        Self { credentials, options, transport, metrics, endpoints: Mutex::default() }
    }

    pub(crate) async fn dial(&self, url: &LinkUrl) -> Result<QuicLink, DialError> {
        let addresses = self.resolve(url).await?;
        self.dial_at(url, addresses).await
    }

    /// Dials these addresses in this order, and says `url` of them.
    pub(crate) async fn dial_at(
        &self,
        url: &LinkUrl,
        mut addresses: Vec<SocketAddr>,
    ) -> Result<QuicLink, DialError> {
        addresses.truncate(ADDRESSES_MAX);
        if addresses.is_empty() {
            return Err(DialError::NoAddress(url.clone()));
        }
        let failed = |attempts| DialError::Failed { url: url.clone(), attempts };
        let (remote, connection, findings) = self.connect(addresses).await.map_err(failed)?;
        let link = self.greet(connection, findings).await.map_err(|e| failed(vec![(remote, e)]))?;
        self.metrics.count_dialed();
        Ok(link)
    }

    pub(crate) async fn close(&self, reason: &CloseReason) {
        let Endpoints { v4, v6 } =
            std::mem::take(&mut *self.endpoints.lock().unwrap_or_else(PoisonError::into_inner));
        for endpoint in [v4, v6].into_iter().flatten() {
            shut(&endpoint, reason).await;
        }
    }

    async fn resolve(&self, url: &LinkUrl) -> Result<Vec<SocketAddr>, DialError> {
        let lookup = tokio::net::lookup_host((url.host.as_str(), url.port));
        let late = || std::io::Error::new(std::io::ErrorKind::TimedOut, "the resolver does not answer");
        let found = timeout(self.options.resolve_timeout, lookup).await.unwrap_or_else(|_| Err(late()));
        let found = found.map_err(|source| DialError::Resolve { url: url.clone(), source })?;
        let mut addresses: Vec<SocketAddr> = Vec::new();
        for address in found.take(ADDRESSES_MAX) {
            if !addresses.contains(&address) {
                addresses.push(address);
            }
        }
        if addresses.is_empty() { Err(DialError::NoAddress(url.clone())) } else { Ok(addresses) }
    }

    /// Connects to the first address that answers. A later one is tried when an earlier fails or is silent.
    async fn connect(
        &self,
        addresses: Vec<SocketAddr>,
    ) -> Result<(SocketAddr, Connection, Arc<Findings>), Vec<(SocketAddr, LinkError)>> {
        let mut rest = addresses.into_iter();
        let mut racing = JoinSet::new();
        let mut failed = Vec::new();
        loop {
            match rest.next() {
                Some(address) => match self.start(address) {
                    Ok((connecting, findings)) => {
                        let options = self.options.clone();
                        racing.spawn(async move {
                            (address, finish(connecting, &findings, &options).await.map(|c| (c, findings)))
                        });
                    }
                    Err(error) => {
                        failed.push((address, error));
                        continue;
                    }
                },
                None if racing.is_empty() => return Err(failed),
                None => {}
            }
            let has_more = rest.len() > 0;
            tokio::select! {
                Some(done) = racing.join_next() => match done {
                    // The others are dropped with the set, before any of them has become a link over there.
                    Ok((address, Ok((connection, findings)))) => return Ok((address, connection, findings)),
                    Ok((address, Err(error))) => failed.push((address, error)),
                    Err(error) => tracing::error!(%error, "an attempt to connect ended abnormally"),
                },
                () = sleep(STAGGER), if has_more => {}
            }
        }
    }

    fn start(&self, address: SocketAddr) -> Result<(Connecting, Arc<Findings>), LinkError> {
        let (client, findings) = config::client(&self.credentials, &self.options, &self.transport);
        let endpoint = self.endpoint(address)?;
        let connecting = endpoint
            .connect_with(client, address, SERVER_NAME)
            .map_err(|e| LinkError::Transport(e.to_string()))?;
        Ok((connecting, findings))
    }

    fn endpoint(&self, remote: SocketAddr) -> Result<Endpoint, LinkError> {
        let mut endpoints = self.endpoints.lock().unwrap_or_else(PoisonError::into_inner);
        let (slot, any) = match remote {
            SocketAddr::V4(_) => (&mut endpoints.v4, SocketAddr::from((Ipv4Addr::UNSPECIFIED, 0))),
            SocketAddr::V6(_) => (&mut endpoints.v6, SocketAddr::from((Ipv6Addr::UNSPECIFIED, 0))),
        };
        match slot {
            Some(endpoint) => Ok(endpoint.clone()),
            None => Ok(slot.insert(Endpoint::client(any)?).clone()),
        }
    }

    async fn greet(&self, connection: Connection, findings: Arc<Findings>) -> Result<QuicLink, LinkError> {
        let fate = Fate::new(self.options.idle_timeout);
        let reserve = Arc::new(Reserve::new(&connection, self.options.send_window_bytes.into()));
        let after = self.options.handshake_timeout;
        let greeted = async {
            let (tx, rx) = connection.open_bi().await.map_err(|e| fate.explain(&e))?;
            let mut tx = Outlet::new(tx, PRIORITY_CONTROL, &fate, &reserve);
            let mut rx = ControlRx { inlet: Inlet::new(rx, &fate), pieces: Pieces::default() };
            // At once: the listener learns of the stream from what is sent on it.
            send_frame(&mut tx, Greeting.to_bytes()).await?;
            hear_greeting(&mut rx).await?;
            Ok((tx, rx))
        };
        match timeout(after, greeted).await.unwrap_or(Err(LinkError::HandshakeTimedOut { after })) {
            Ok(control) => link(connection, &findings, true, control, fate).map_err(LinkError::RefusedHere),
            Err(error) => {
                if let LinkError::Protocol(why) = &error {
                    close(&connection, &fate, &CloseReason::Protocol(why.to_string()), error.clone());
                }
                Err(error)
            }
        }
    }
}

/// Waits for an outgoing handshake.
async fn finish(
    connecting: Connecting,
    findings: &Findings,
    options: &LinkOptions,
) -> Result<Connection, LinkError> {
    let after = options.handshake_timeout;
    match timeout(after, connecting).await {
        Ok(Ok(connection)) => Ok(connection),
        Ok(Err(error)) => Err(match findings.verdict() {
            Some(Err(cert)) => LinkError::RefusedHere(cert.clone()),
            _ => LinkError::from_quinn(&error, options.idle_timeout),
        }),
        Err(_) => Err(LinkError::HandshakeTimedOut { after }),
    }
}

async fn hear_greeting(rx: &mut ControlRx) -> Result<(), LinkError> {
    let frame = rx.recv().await?;
    Greeting::from_slice(&frame).map_err(ProtocolError::Greeting)?;
    Ok(())
}

fn link(
    connection: Connection,
    findings: &Findings,
    is_dialer: bool,
    (control_tx, control_rx): (Outlet, ControlRx),
    fate: Arc<Fate>,
) -> Result<QuicLink, CertError> {
    // TLS with mandatory certificates ends no handshake without a verdict. If it ever did, no link comes of it.
    let peer = findings.verdict().cloned().unwrap_or(Err(CertError::NoCertificate))?;
    let key_exchange = key_exchange(&connection);
    let reserve = Arc::clone(&control_tx.reserve);
    let (control_tx, control_rx) = (control_tx.into(), control_rx.into());
    let labels = Arc::default();
    let shared =
        Shared { connection, peer, is_dialer, key_exchange, control_tx, control_rx, labels, fate, reserve };
    Ok(QuicLink { shared: Arc::new(shared) })
}

fn key_exchange(connection: &Connection) -> KeyExchange {
    let data = connection.handshake_data().and_then(|data| data.downcast::<HandshakeData>().ok());
    match data.map(|data| data.negotiated_key_exchange_group) {
        Some(NamedGroup::X25519) => KeyExchange::X25519,
        Some(NamedGroup::X25519MLKEM768) => KeyExchange::X25519MlKem768,
        _ => KeyExchange::Unknown,
    }
}

/// Why an incoming handshake failed.
fn refusal(findings: &Findings, error: &ConnectionError, options: &LinkOptions) -> Refusal {
    const ALERT_CERTIFICATE_REQUIRED: u64 = 0x100 + 116;
    const ALERT_PROTOCOL_VERSION: u64 = 0x100 + 70;
    const ALERT_NO_APPLICATION_PROTOCOL: u64 = 0x100 + 120;
    if let Some(Err(cert)) = findings.verdict() {
        return Refusal::Certificate(cert.clone());
    }
    match error {
        ConnectionError::TransportError(_) if findings.lacks_key_exchange() => {
            Refusal::KeyExchange { post_quantum: findings.post_quantum }
        }
        ConnectionError::TransportError(e) => match u64::from(e.code) {
            ALERT_CERTIFICATE_REQUIRED => Refusal::Certificate(CertError::NoCertificate),
            ALERT_PROTOCOL_VERSION | ALERT_NO_APPLICATION_PROTOCOL => Refusal::Version(e.reason.clone()),
            _ => Refusal::Transport(e.to_string()),
        },
        ConnectionError::VersionMismatch => Refusal::Version("another version of QUIC".into()),
        ConnectionError::ConnectionClosed(c) => {
            Refusal::ByPeer(PeerRefusal::from_code(c.error_code, &c.reason))
        }
        ConnectionError::ApplicationClosed(_) => Refusal::ByPeer(PeerRefusal::GaveUp),
        ConnectionError::TimedOut => Refusal::TimedOut { after: options.idle_timeout },
        other => Refusal::Transport(other.to_string()),
    }
}

/// Why an authenticated peer has no link after all.
fn ungreeted(connection: &Connection, fate: &Fate, error: LinkError) -> Refusal {
    match error {
        LinkError::Protocol(why) => {
            close(connection, fate, &CloseReason::Protocol(why.to_string()), why.clone().into());
            match why {
                ProtocolError::Greeting(e @ DecodeError::Version { .. }) => Refusal::Version(e.to_string()),
                why => Refusal::Greeting(why),
            }
        }
        LinkError::RefusedByPeer(why) => Refusal::ByPeer(why),
        LinkError::Closed { .. } => Refusal::ByPeer(PeerRefusal::GaveUp),
        other => Refusal::Transport(other.to_string()),
    }
}

async fn shut(endpoint: &Endpoint, reason: &CloseReason) {
    let (code, text) = reason.to_wire();
    endpoint.close(VarInt::from_u32(code), text.as_bytes());
    // Whoever has not heard by then learns it from its own time-out.
    let _ = timeout(DRAIN_TIMEOUT, endpoint.wait_idle()).await;
}
