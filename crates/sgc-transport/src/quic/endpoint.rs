//! Making QUIC links: listening and dialling.
//!
//! A link is handed out only after both certificates were verified and the greetings were exchanged. The greeting is
//! also the dialer's proof that it was accepted: in TLS 1.3 the client's handshake is over before the server has looked
//! at its certificate.

use std::net::SocketAddr;
use std::sync::atomic::{AtomicBool, Ordering::Relaxed};
use std::sync::{Arc, Mutex, OnceLock};
use std::time::{Duration, Instant};

use quinn::crypto::rustls::HandshakeData;
use quinn::{AsyncUdpSocket, Connecting, Connection, ConnectionError, Endpoint, Incoming, VarInt};
use rustls::NamedGroup;
use sgc_sync::lock;
use sgc_trust::CertError;
use sgc_wire::{Decode, DecodeError, Encode, LaneToken};
use tokio::task::{AbortHandle, JoinSet};
use tokio::time::timeout;

use super::config::{Flavor, Parts};
use super::halves::{Inlet, LinkEnd, Outlet, Urgency};
use super::places::Places;
use super::{ControlRx, LinkInner, QuicLink, canonical, close, config, send_frame};
use crate::budget::WindowLease;
use crate::credentials::CredentialStore;
use crate::direct::DirectHandle;
use crate::dtls::{Claim, Mux};
use crate::error::{CloseReason, DialError, LinkError, PeerRefusal, ProtocolError, Refusal};
use crate::framing::{Greeting, Pieces};
use crate::handshakes::{Entry, Handshakes, Holder};
use crate::link::Link;
use crate::metrics::TransportMetrics;
use crate::options::{BulkLanes, LinkOptions};
use crate::quinn_runtime::PromptRuntime;
use crate::race;
use crate::socket;
use crate::stats::KeyExchange;
use crate::tls::Findings;
use crate::url::LinkUrl;

/// TLS requires a name; ours is neither sent nor compared.
pub(crate) const SERVER_NAME: &str = "sgc.invalid";
/// Time that a closing endpoint waits for its peers to hear of it.
pub(crate) const DRAIN_TIMEOUT: Duration = Duration::from_secs(1);

/// Awaits QUIC links on one socket.
pub(crate) struct QuicListener {
    endpoint: Endpoint,
    local: SocketAddr,
    acceptor: Arc<Acceptor>,
    /// Decides who may make links, if this is the socket of links that were dialled.
    guard: Option<DirectHandle>,
    handshakes: JoinSet<(SocketAddr, Result<QuicLink, Refusal>)>,
    places: Handshakes<Slot>,
}

/// A handshake under way.
struct Slot {
    remote: SocketAddr,
    task: AbortHandle,
    /// The peer is known to receive at its address.
    is_validated: Arc<AtomicBool>,
}

impl Holder for Slot {
    fn remote(&self) -> SocketAddr {
        self.remote
    }

    fn is_pending(&self) -> bool {
        !self.task.is_finished()
    }

    fn is_engaged(&self) -> bool {
        self.is_validated.load(Relaxed)
    }
}

/// State that every incoming handshake needs.
struct Acceptor {
    flavor: Flavor,
    credentials: CredentialStore,
    options: LinkOptions,
    metrics: Arc<TransportMetrics>,
    /// The associations below these links.
    dtls: Option<Arc<Mux>>,
    /// Whether bulk lanes of these links are taken.
    bulk_lanes: AtomicBool,
}

impl QuicListener {
    pub(crate) fn bind(
        flavor: Flavor,
        addr: SocketAddr,
        credentials: CredentialStore,
        options: LinkOptions,
        metrics: Arc<TransportMetrics>,
    ) -> std::io::Result<Self> {
        let (socket, _) = socket::bind(addr, &options)?;
        Self::on(flavor, socket, None, credentials, options, metrics)
    }

    /// Listens on this socket, over these associations.
    pub(crate) fn on(
        flavor: Flavor,
        socket: Arc<dyn AsyncUdpSocket>,
        dtls: Option<Arc<Mux>>,
        credentials: CredentialStore,
        options: LinkOptions,
        metrics: Arc<TransportMetrics>,
    ) -> std::io::Result<Self> {
        let local = socket.local_addr()?;
        let server = config::listener(flavor, &credentials, &options);
        let endpoint_config = config::endpoint(flavor, credentials.identity().reset_key(), local.port());
        let runtime = Arc::new(PromptRuntime);
        let endpoint = Endpoint::new_with_abstract_socket(endpoint_config, Some(server), socket, runtime)?;
        Ok(Self::over(endpoint, local, flavor, dtls, credentials, options, metrics))
    }

    /// Listens at an endpoint.
    fn over(
        endpoint: Endpoint,
        local: SocketAddr,
        flavor: Flavor,
        dtls: Option<Arc<Mux>>,
        credentials: CredentialStore,
        options: LinkOptions,
        metrics: Arc<TransportMetrics>,
    ) -> Self {
        let places = Handshakes::new(&options);
        let acceptor = Arc::new(Acceptor {
            flavor,
            credentials,
            options,
            metrics,
            dtls,
            bulk_lanes: AtomicBool::new(false),
        });
        Self { endpoint, local, acceptor, guard: None, handshakes: JoinSet::new(), places }
    }

    pub(crate) fn local_addr(&self) -> SocketAddr {
        self.local
    }

    /// Tells the peers of links from here on that bulk lanes are taken at the TCP port of the same number.
    pub(crate) fn announce_bulk_lanes(&self) {
        self.acceptor.bulk_lanes.store(true, Relaxed);
    }

    pub(crate) async fn accept(&mut self) -> Option<Result<QuicLink, (SocketAddr, Refusal)>> {
        loop {
            tokio::select! {
                Some(done) = self.handshakes.join_next() => match done {
                    Ok((remote, Ok(link))) => match &self.guard {
                        // Its checks were authentic at another address.
                        Some(guard) if guard.expected(&remote) != Some(link.peer().node_id) => {
                            link.close(CloseReason::Denied("no link is expected from here".into()));
                        }
                        _ => return Some(Ok(link)),
                    },
                    Ok((remote, Err(refusal))) => return Some(Err((remote, refusal))),
                    Err(error) if error.is_cancelled() => {}
                    Err(error) => tracing::error!(%error, "a handshake ended abnormally"),
                },
                incoming = self.endpoint.accept() => {
                    let incoming = incoming?;
                    if let Some(refused) = self.admit(incoming) {
                        return Some(Err(refused));
                    }
                }
            }
        }
    }

    pub(crate) async fn close(&mut self, reason: &CloseReason) {
        self.handshakes.abort_all();
        // The dialer closes its own endpoints.
        if self.guard.is_none() {
            shut(&self.endpoint, reason).await;
        }
    }

    /// Starts the handshake of a peer that has a place, and returns its refusal.
    fn admit(&mut self, incoming: Incoming) -> Option<(SocketAddr, Refusal)> {
        let is_stranger =
            |guard: &DirectHandle| guard.expected(&canonical(incoming.remote_address())).is_none();
        if self.guard.as_ref().is_some_and(is_stranger) {
            // Strangers learn nothing of the socket.
            incoming.ignore();
            return None;
        }
        let LinkOptions { handshakes_max, handshakes_unvalidated_max, .. } = self.acceptor.options;
        let pending = self.places.pending();
        // A peer that cannot be asked for proof displaces nobody once all places are taken.
        if pending >= handshakes_unvalidated_max.min(handshakes_max) && incoming.may_retry() {
            // Cannot fail after `may_retry`.
            let _ = incoming.retry();
            return None;
        }
        let (remote, now) = (canonical(incoming.remote_address()), Instant::now());
        let Entry { is_admitted, evicted, refused } =
            self.places.make_room(remote, now, &self.acceptor.metrics);
        if let Some(slot) = evicted {
            // Quinn closes the connection when its last handle goes.
            slot.task.abort();
        }
        if !is_admitted {
            incoming.refuse();
            return refused;
        }
        let acceptor = Arc::clone(&self.acceptor);
        let pending = acceptor.metrics.pending();
        let is_validated = Arc::new(AtomicBool::new(incoming.remote_address_validated()));
        let validated = Arc::clone(&is_validated);
        let task = self.handshakes.spawn(async move {
            let _pending = pending;
            (remote, acceptor.handshake(incoming, &validated).await)
        });
        self.places.take(now, Slot { remote, task, is_validated });
        refused
    }
}

impl Acceptor {
    async fn handshake(&self, incoming: Incoming, validated: &AtomicBool) -> Result<QuicLink, Refusal> {
        let after = self.options.handshake_timeout;
        let result = timeout(after, self.link(incoming, validated)).await;
        let result = result.unwrap_or(Err(Refusal::TimedOut { after }));
        match &result {
            Ok(_) => self.metrics.count_accepted(),
            Err(refusal) => self.metrics.count_refused(refusal.kind()),
        }
        result
    }

    async fn link(&self, incoming: Incoming, validated: &AtomicBool) -> Result<QuicLink, Refusal> {
        let (server, Parts { findings, gate, lease }) =
            config::server(self.flavor, &self.credentials, &self.options);
        let refusal = |e: ConnectionError| refusal(&findings, &e, &self.options);
        let connection = incoming.accept_with(Arc::new(server)).map_err(refusal)?.await.map_err(refusal)?;
        validated.store(true, Relaxed);
        let fate = LinkEnd::new(self.options.idle_timeout);
        let claim = match &self.dtls {
            None => None,
            Some(mux) => {
                let peer = findings.verdict().and_then(|verdict| verdict.as_ref().ok());
                let claim = peer.and_then(|peer| mux.claim(connection.remote_address(), peer));
                let other = || ungreeted(&connection, &fate, ProtocolError::OtherNode.into());
                Some(claim.ok_or_else(other)?)
            }
        };
        let greeted = async {
            let (tx, rx) = connection.accept_bi().await.map_err(|e| fate.explain(&e))?;
            let mut tx = Outlet::new(tx, Urgency::Control, &fate, &gate);
            let mut rx = ControlRx { inlet: Inlet::new(rx, &fate, None), pieces: Pieces::default() };
            let greeting = hear_greeting(&mut rx).await?;
            let own = Greeting { lane: None, bulk_lanes: self.bulk_lanes.load(Relaxed) };
            send_frame(&mut tx, own.to_bytes()).await?;
            Ok((greeting, (tx, rx)))
        };
        match greeted.await {
            Ok((greeting, control)) => {
                let ended = claim.as_ref().map(Claim::ended);
                let places = Places::new(self.options.flows_max);
                let held = LinkResources { fate, places, lease, claim, uses_direct_socket: Arc::default() };
                let link = link(connection, &findings, false, greeting, control, held);
                let link = link.map_err(Refusal::Certificate)?;
                if let Some(ended) = ended {
                    link.end_with(ended);
                }
                Ok(link)
            }
            Err(error) => Err(ungreeted(&connection, &fate, error)),
        }
    }
}

/// Dials QUIC links, all from one socket for each address family.
pub(crate) struct QuicDialer {
    flavor: Flavor,
    credentials: CredentialStore,
    options: LinkOptions,
    metrics: Arc<TransportMetrics>,
    endpoints: Mutex<Endpoints>,
    /// Set if the sockets take checks and links, too.
    direct: OnceLock<DirectHandle>,
}

#[derive(Default)]
struct Endpoints {
    v4: Option<Endpoint>,
    v6: Option<Endpoint>,
}

impl QuicDialer {
    pub(crate) fn new(
        flavor: Flavor,
        credentials: CredentialStore,
        options: LinkOptions,
        metrics: Arc<TransportMetrics>,
    ) -> Self {
        Self { flavor, credentials, options, metrics, endpoints: Mutex::default(), direct: OnceLock::new() }
    }

    /// Dials these addresses in this order; errors name `url`.
    pub(crate) async fn dial_at(
        &self,
        url: &LinkUrl,
        addresses: Vec<SocketAddr>,
        lane: Option<LaneToken>,
    ) -> Result<QuicLink, DialError> {
        let has_lanes = self.options.bulk_lanes != BulkLanes::Off && self.flavor == Flavor::Quic;
        let bulk_lanes = has_lanes && lane.is_none();
        let greeting = Greeting { lane, bulk_lanes };
        let failed = |attempts| DialError::Failed { url: url.clone(), attempts };
        let connect = |address| {
            let started = self.start(address);
            let options = self.options.clone();
            async move {
                let (connecting, parts) = started?;
                Ok((finish(connecting, &parts.findings, &options).await?, parts))
            }
        };
        let (remote, (connection, parts)) = race::first(addresses, connect).await.map_err(failed)?;
        let uses_direct_socket = Arc::new(AtomicBool::new(self.direct.get().is_some()));
        let greeted = greet(connection, parts, greeting, &self.options, uses_direct_socket).await;
        let link = greeted.map_err(|e| failed(vec![(remote, e)]))?;
        self.metrics.count_dialed();
        Ok(link)
    }

    pub(crate) async fn close(&self, reason: &CloseReason) {
        let Endpoints { v4, v6 } = std::mem::take(&mut *lock(&self.endpoints));
        for endpoint in [v4, v6].into_iter().flatten() {
            shut(&endpoint, reason).await;
        }
    }

    fn start(&self, address: SocketAddr) -> Result<(Connecting, Parts), LinkError> {
        let (client, parts) = config::client(self.flavor, &self.credentials, &self.options);
        let endpoint = self.endpoint(address)?;
        let connecting = endpoint
            .connect_with(client, address, SERVER_NAME)
            .map_err(|e| LinkError::Transport(e.to_string()))?;
        Ok((connecting, parts))
    }

    fn endpoint(&self, remote: SocketAddr) -> Result<Endpoint, LinkError> {
        let mut endpoints = lock(&self.endpoints);
        let slot = match remote {
            SocketAddr::V4(_) => &mut endpoints.v4,
            SocketAddr::V6(_) => &mut endpoints.v6,
        };
        if let Some(endpoint) = slot {
            return Ok(endpoint.clone());
        }
        let socket = self.bind(remote)?;
        let mut config = config::endpoint(self.flavor, None, 0);
        if self.direct.get().is_some() {
            // The bit tells QUIC from DTLS and checks at this socket (RFC 9443, 4).
            config.grease_quic_bit(false);
        }
        let server =
            self.direct.get().map(|_| config::listener(self.flavor, &self.credentials, &self.options));
        let endpoint = Endpoint::new_with_abstract_socket(config, server, socket, Arc::new(PromptRuntime))?;
        Ok(slot.insert(endpoint).clone())
    }

    fn bind(&self, remote: SocketAddr) -> std::io::Result<Arc<dyn AsyncUdpSocket>> {
        let (socket, _) = socket::bind(socket::any_like(remote), &self.options)?;
        match self.direct.get() {
            Some(direct) => direct.wrap(socket),
            None => Ok(socket),
        }
    }

    /// Opens the sockets of both families, as far as the system has them, for checks and for links of expected peers.
    /// Returns the listeners of such links. Call it before the first dial.
    pub(crate) fn open_direct(&self, direct: &DirectHandle) -> Vec<QuicListener> {
        let _ = self.direct.set(direct.clone());
        let families = [SocketAddr::from(([0, 0, 0, 0], 0)), SocketAddr::from(([0; 16], 0))];
        let listen = |any| {
            let endpoint = self.endpoint(any).ok()?;
            let local = endpoint.local_addr().ok()?;
            let (credentials, options) = (self.credentials.clone(), self.options.clone());
            let metrics = Arc::clone(&self.metrics);
            let mut listener =
                QuicListener::over(endpoint, local, self.flavor, None, credentials, options, metrics);
            listener.guard = Some(direct.clone());
            Some(listener)
        };
        families.into_iter().filter_map(listen).collect()
    }

    /// Moves every link to a fresh socket, so that it leaves by the interface that the system would choose now.
    pub(crate) fn rebind(&self) -> std::io::Result<()> {
        let endpoints = lock(&self.endpoints);
        for endpoint in [&endpoints.v4, &endpoints.v6].into_iter().flatten() {
            endpoint.rebind_abstract(self.bind(endpoint.local_addr()?)?)?;
        }
        Ok(())
    }
}

/// Makes a link of an outgoing connection, which tells by the flag whether it uses a socket of direct links.
pub(crate) async fn greet(
    connection: Connection,
    Parts { findings, gate, lease }: Parts,
    greeting: Greeting,
    options: &LinkOptions,
    uses_direct_socket: Arc<AtomicBool>,
) -> Result<QuicLink, LinkError> {
    let fate = LinkEnd::new(options.idle_timeout);
    let after = options.handshake_timeout;
    let greeted = async {
        let (tx, rx) = connection.open_bi().await.map_err(|e| fate.explain(&e))?;
        let mut tx = Outlet::new(tx, Urgency::Control, &fate, &gate);
        let mut rx = ControlRx { inlet: Inlet::new(rx, &fate, None), pieces: Pieces::default() };
        // Sent at once: the listener learns of the stream from its first bytes.
        send_frame(&mut tx, greeting.to_bytes()).await?;
        let heard = hear_greeting(&mut rx).await?;
        Ok((Greeting { lane: greeting.lane, ..heard }, (tx, rx)))
    };
    match timeout(after, greeted).await.unwrap_or(Err(LinkError::HandshakeTimedOut { after })) {
        Ok((agreed, control)) => {
            let places = Places::new(options.flows_max);
            let held = LinkResources { fate, places, lease, claim: None, uses_direct_socket };
            link(connection, &findings, true, agreed, control, held).map_err(LinkError::RefusedHere)
        }
        Err(error) => {
            if let LinkError::Protocol(why) = &error {
                close(&connection, &fate, &CloseReason::Protocol(why.to_string()), error.clone());
            }
            Err(error)
        }
    }
}

/// Waits for an outgoing handshake.
pub(crate) async fn finish(
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

async fn hear_greeting(rx: &mut ControlRx) -> Result<Greeting, LinkError> {
    let frame = rx.recv().await?;
    Ok(Greeting::from_slice(&frame).map_err(ProtocolError::Greeting)?)
}

/// Resources that a link keeps until it ends.
struct LinkResources {
    fate: Arc<LinkEnd>,
    places: Arc<Places>,
    lease: WindowLease,
    claim: Option<Claim>,
    uses_direct_socket: Arc<AtomicBool>,
}

fn link(
    connection: Connection,
    findings: &Findings,
    is_dialer: bool,
    Greeting { lane, bulk_lanes }: Greeting,
    (control_tx, control_rx): (Outlet, ControlRx),
    LinkResources { fate, places, lease, claim, uses_direct_socket }: LinkResources,
) -> Result<QuicLink, CertError> {
    // TLS with mandatory certificates ends no handshake without a verdict. If it ever did, no link comes of it.
    let peer = findings.verdict().cloned().unwrap_or(Err(CertError::NoCertificate))?;
    let key_exchange = key_exchange(&connection);
    let gate = Arc::clone(&control_tx.gate);
    let (control_tx, control_rx) = (control_tx.into(), control_rx.into());
    let labels = Arc::default();
    let shared = LinkInner {
        connection,
        peer,
        is_dialer,
        lane,
        bulk_lanes,
        key_exchange,
        control_tx,
        control_rx,
        labels,
        datagrams: std::sync::Mutex::default(),
        fate,
        gate,
        places,
        _lease: lease,
        _claim: claim,
        uses_direct_socket,
    };
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

/// Returns the reason why an incoming handshake failed.
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

/// Returns the reason why an authenticated peer has no link after all.
fn ungreeted(connection: &Connection, fate: &LinkEnd, error: LinkError) -> Refusal {
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
    // The other peers notice the end by their own time-outs.
    let _ = timeout(DRAIN_TIMEOUT, endpoint.wait_idle()).await;
}
