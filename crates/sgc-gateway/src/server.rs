//! [`Server`]: the gateway's sockets. Accepts connections, terminates TLS, admits clients and starts their protocol.

#[cfg(feature = "grpc")]
mod grpc;
mod listening;
mod stream;
#[cfg(feature = "_websocket")]
mod websocket;

use std::collections::BTreeMap;
use std::fmt;
use std::net::SocketAddr;
use std::sync::{Arc, Mutex, MutexGuard};
use std::time::Duration;

use rustls::ServerConfig;
use rustls_pki_types::CertificateDer;
use sgc_sync::lock;
use sgc_trust::{TrustAnchors, VerifiedPeer};
use tokio::net::{TcpListener, TcpStream};
use tokio::sync::{Mutex as AsyncMutex, watch};
use tokio::task::JoinSet;
use tokio::time::Instant;
use tokio_rustls::TlsAcceptor;

use crate::access::Access;
use crate::admission::{Admission, Arrival, Engagement, GatewayStatus, Handshakes, ShownCertificate};
use crate::hub::Hub;
use crate::limits::SessionLimits;
use crate::refusal::ClientRefusal;
use crate::tls::{TlsError, TlsKeys, server_config};
#[cfg(feature = "grpc")]
use grpc::GrpcFront;
use listening::Listening;
pub use listening::NotListening;
use stream::ByteStream;
#[cfg(feature = "_websocket")]
use websocket::WebSocketFront;

/// Time for TLS and the WebSocket upgrade together, or for TLS and the first admitted call of gRPC.
const HANDSHAKE_MAX: Duration = Duration::from_secs(10);
/// Pause after the system refused to accept, for instance for lack of file descriptors.
const ACCEPT_RETRY: Duration = Duration::from_millis(100);
/// Status key for messages that were not kept for later subscribers.
const HISTORY_DROPPED: &str = "messages not kept for later subscribers";
/// Reasons of losses while the local network was closed, in the same counts.
const UNWRITTEN: &str = "messages published while the local network was closed";
const CALLS_CUT_OFF: &str = "calls not answered before the local network closed";

/// The protocol of a listening address.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub enum Protocol {
    /// WebSocket: the rosbridge protocol, or Foxglove's if the client requests its subprotocol.
    WebSocket,
    /// gRPC.
    Grpc,
}

impl Protocol {
    /// Checks that this build has the protocol.
    ///
    /// # Errors
    /// The build has none of the features that serve it.
    pub fn check_built(self) -> Result<(), ProtocolNotBuilt> {
        let is_built = match self {
            Self::WebSocket => cfg!(feature = "_websocket"),
            Self::Grpc => cfg!(feature = "grpc"),
        };
        if is_built { Ok(()) } else { Err(ProtocolNotBuilt { protocol: self }) }
    }

    /// Returns the cargo features that serve the protocol, any of which suffices.
    fn features(self) -> &'static str {
        match self {
            Self::WebSocket => "rosbridge,foxglove",
            Self::Grpc => "grpc",
        }
    }

    /// Returns the schemes of its addresses.
    fn schemes(self) -> &'static str {
        match self {
            Self::WebSocket => "ws:// and wss://",
            Self::Grpc => "grpc:// and grpcs://",
        }
    }
}

/// A protocol that this build lacks.
#[derive(Clone, Copy, Debug, PartialEq, Eq, thiserror::Error)]
#[error(
    "this sgc is built without {}: build it with `cargo build --release -p sgc --features {}`, or take the address out",
    protocol.schemes(),
    protocol.features()
)]
pub struct ProtocolNotBuilt {
    /// The protocol.
    pub protocol: Protocol,
}

/// A listening address and its protocol.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub struct ListenAt {
    /// The protocol.
    pub protocol: Protocol,
    /// `true` for TLS.
    pub is_encrypted: bool,
    /// The address; port 0 lets the system choose.
    pub addr: SocketAddr,
}

impl fmt::Display for ListenAt {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let scheme = match (self.protocol, self.is_encrypted) {
            (Protocol::WebSocket, false) => "ws",
            (Protocol::WebSocket, true) => "wss",
            (Protocol::Grpc, false) => "grpc",
            (Protocol::Grpc, true) => "grpcs",
        };
        write!(f, "{scheme}://{}", self.addr)
    }
}

/// The options of a server.
pub struct ServerOptions {
    /// The name that programs display.
    pub name: String,
    /// The listening addresses.
    pub listen: Vec<ListenAt>,
    /// The access rules.
    pub access: Access,
    /// The certificates and keys of the gateway for TLS.
    pub keys: Option<TlsKeys>,
    /// Most clients at a time.
    pub clients_max: usize,
    /// The limits of each session.
    pub limits: SessionLimits,
}

/// The reason why a server does not start.
#[derive(Debug, thiserror::Error)]
pub enum ServerError {
    /// This build lacks the protocol of an address.
    #[error("the gateway cannot listen on {at}: {source}")]
    NotBuilt {
        /// The address.
        at: ListenAt,
        /// The protocol.
        source: ProtocolNotBuilt,
    },
    /// The certificate is missing or unusable.
    #[error("the gateway's certificate: {0}")]
    Tls(#[from] TlsError),
    /// A TLS address is configured without a certificate.
    #[error("the gateway is to listen with TLS, and has no certificate")]
    NoKey,
}

/// The TLS configurations of both protocols.
#[derive(Clone)]
struct Tls {
    ws: Arc<ServerConfig>,
    grpc: Arc<ServerConfig>,
    /// The certificates of both.
    keys: TlsKeys,
}

struct ServerState {
    hub: Hub,
    admission: Arc<Admission>,
    tls: watch::Sender<Option<Tls>>,
    handshakes: Arc<Handshakes>,
    #[cfg(feature = "grpc")]
    grpc: GrpcFront,
    #[cfg(feature = "_websocket")]
    websocket: WebSocketFront,
}

/// The gateway's sockets and connections. All of them end when it is dropped.
pub struct Server {
    shared: Arc<ServerState>,
    listening: Mutex<Vec<Listening>>,
    /// Held while the addresses change.
    changing: AsyncMutex<()>,
    _tasks: JoinSet<()>,
}

fn tls_config(keys: Option<TlsKeys>, access: &Access) -> Result<Option<Tls>, TlsError> {
    let asks = access.takes_certificates();
    keys.map(|keys| {
        let ws = server_config(&keys, asks, &[b"http/1.1"])?;
        Ok(Tls { ws, grpc: server_config(&keys, asks, &[b"h2"])?, keys })
    })
    .transpose()
}

impl Server {
    /// Serves clients at all addresses. One that cannot be bound is tried again ([`Self::not_listening`]).
    pub async fn start(hub: Hub, options: ServerOptions) -> Result<Self, ServerError> {
        let tls = tls_config(options.keys, &options.access)?;
        let admission = Admission::new(options.access, options.clients_max);
        #[cfg_attr(not(feature = "grpc"), expect(unused_mut, reason = "only gRPC has a task here"))]
        let mut tasks = JoinSet::new();
        let shared = Arc::new(ServerState {
            tls: watch::Sender::new(tls),
            handshakes: Arc::default(),
            #[cfg(feature = "grpc")]
            grpc: GrpcFront::start(hub.clone(), Arc::clone(&admission), options.limits, &mut tasks),
            #[cfg(feature = "_websocket")]
            websocket: WebSocketFront::new(hub.clone(), Arc::clone(&admission), options.limits, options.name),
            hub,
            admission,
        });
        let (listening, changing) = (Mutex::default(), AsyncMutex::default());
        let server = Self { shared, listening, changing, _tasks: tasks };
        server.listen(options.listen).await?;
        Ok(server)
    }

    /// Listens at these addresses from here on, and at no others. Clients of addresses that stay notice nothing; those
    /// of others are disconnected.
    ///
    /// # Errors
    /// This build lacks a protocol, or there is no certificate for TLS. Nothing has changed then.
    pub async fn listen(&self, wanted: Vec<ListenAt>) -> Result<(), ServerError> {
        let _changing = self.changing.lock().await;
        for at in &wanted {
            at.protocol.check_built().map_err(|source| ServerError::NotBuilt { at: *at, source })?;
        }
        if self.shared.tls.borrow().is_none() && wanted.iter().any(|at| at.is_encrypted) {
            return Err(ServerError::NoKey);
        }
        let known = std::mem::take(&mut *self.lock());
        let (kept, ended): (Vec<_>, Vec<_>) =
            known.into_iter().partition(|one| wanted.contains(&one.wanted()));
        let new: Vec<_> =
            wanted.into_iter().filter(|at| kept.iter().all(|one| one.wanted() != *at)).collect();
        *self.lock() = kept;
        // A new address may have the port of an old one.
        for one in ended {
            one.end().await;
        }
        for at in new {
            let begun = Listening::begin(at, Arc::clone(&self.shared)).await;
            self.lock().push(begun);
        }
        Ok(())
    }

    /// Returns the addresses at which it listens.
    pub fn local(&self) -> Vec<ListenAt> {
        self.lock().iter().filter_map(Listening::local).collect()
    }

    /// Returns the addresses at which it should listen and does not.
    pub fn not_listening(&self) -> Vec<NotListening> {
        self.lock().iter().filter_map(Listening::fault).collect()
    }

    fn lock(&self) -> MutexGuard<'_, Vec<Listening>> {
        lock(&self.listening)
    }

    /// Applies other rules and other certificates. Clients that the rules no longer admit are disconnected.
    pub fn reconfigure(&self, access: Access, keys: Option<TlsKeys>) -> Result<(), ServerError> {
        let tls = tls_config(keys, &access)?;
        if tls.is_none() && self.lock().iter().any(|one| one.wanted().is_encrypted) {
            return Err(ServerError::NoKey);
        }
        self.shared.tls.send_replace(tls);
        self.shared.admission.rules().change(|before| access.after(before));
        Ok(())
    }

    /// Shows other certificates to new connections. Existing connections stay.
    pub fn show(&self, keys: TlsKeys) -> Result<(), ServerError> {
        let tls = tls_config(Some(keys), &self.shared.admission.access())?;
        self.shared.tls.send_replace(tls);
        Ok(())
    }

    /// Returns the certificates and keys for new connections; `None` without TLS.
    pub fn keys(&self) -> Option<TlsKeys> {
        self.shared.tls.borrow().as_ref().map(|tls| tls.keys.clone())
    }

    /// Returns the certificates for new connections, the gateway's own first. The list is empty without TLS.
    pub fn shown(&self) -> Vec<CertificateDer<'static>> {
        self.keys().map(|keys| keys.shown.cert.clone()).unwrap_or_default()
    }

    /// Verifies tokens with this certificate of the gateway from now on.
    pub fn set_gateway(&self, gateway: VerifiedPeer) {
        self.shared.admission.rules().change(|access| access.clone().with_gateway(gateway));
    }

    /// Changes the number of clients that may be connected at once. Those that are stay.
    pub fn set_clients_max(&self, clients_max: usize) {
        self.shared.admission.set_clients_max(clients_max);
    }

    /// Verifies certificates against other CAs or revocation lists from now on.
    pub fn set_anchors(&self, anchors: TrustAnchors) {
        self.shared.admission.rules().change(|access| access.clone().with_anchors(anchors));
    }

    /// Returns the status of the gateway.
    pub fn status(&self) -> GatewayStatus {
        GatewayStatus {
            listen: self.local().iter().map(ToString::to_string).collect(),
            clients: self.shared.admission.clients(),
            refused: self.refused(),
            readers: self.shared.hub.readers(),
            certificate: self.shown().first().and_then(|shown| ShownCertificate::of(shown)),
        }
    }

    /// Returns the number of refusals by reason.
    fn refused(&self) -> BTreeMap<String, u64> {
        let mut refused = self.shared.admission.refused();
        let crowded = self.shared.hub.shared.network.quotas.refused();
        let crowded = crowded.into_iter().map(|(pool, count)| (ClientRefusal::TooMuch(pool), count));
        refused.extend(crowded.map(|(why, count)| (why.key().to_owned(), count)));
        let quotas = &self.shared.hub.shared.network.quotas;
        let losses = [
            (HISTORY_DROPPED, quotas.history_dropped()),
            (UNWRITTEN, quotas.unwritten()),
            (CALLS_CUT_OFF, quotas.calls_cut_off()),
        ];
        let losses = losses.into_iter().filter(|(_, count)| *count > 0);
        refused.extend(losses.map(|(reason, count)| (reason.to_owned(), count)));
        refused
    }

    /// Returns the hub.
    pub fn hub(&self) -> &Hub {
        &self.shared.hub
    }
}

impl fmt::Debug for Server {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_struct("Server").field("local", &self.local()).finish_non_exhaustive()
    }
}

/// Accepts connections at an address. `open` tells those that outlive this task of its end.
async fn keep_accepting(
    listener: TcpListener,
    at: ListenAt,
    shared: Arc<ServerState>,
    open: watch::Receiver<()>,
) {
    // The set ends all connections when the listener ends.
    let mut connections = JoinSet::new();
    let mut is_failing = false;
    loop {
        tokio::select! {
            accepted = listener.accept() => match accepted {
                Ok((stream, peer)) => {
                    is_failing = false;
                    let _ = stream.set_nodelay(true);
                    connections.spawn(serve(stream, peer, at, Arc::clone(&shared), open.clone()));
                }
                Err(error) => {
                    if !std::mem::replace(&mut is_failing, true) {
                        tracing::warn!(%error, "the gateway cannot accept connections; it tries again");
                    }
                    tokio::time::sleep(ACCEPT_RETRY).await;
                }
            },
            Some(_) = connections.join_next(), if !connections.is_empty() => {}
        }
    }
}

async fn serve(
    stream: TcpStream,
    peer: SocketAddr,
    at: ListenAt,
    shared: Arc<ServerState>,
    open: watch::Receiver<()>,
) {
    let admission = &shared.admission;
    let Some(mut handshake) = Handshakes::begin(&shared.handshakes, peer.ip()) else {
        return admission.count(ClientRefusal::TooManyHandshakes);
    };
    let deadline = Instant::now() + HANDSHAKE_MAX;
    let engagement = handshake.engagement();
    let arriving = arrive(stream, peer, at, &shared, &engagement);
    let arrived = tokio::select! {
        arrived = tokio::time::timeout_at(deadline, arriving) => arrived,
        () = handshake.evicted() => return admission.count(ClientRefusal::HandshakeGaveWay),
    };
    let (stream, arrival) = match arrived {
        Ok(Some(arrived)) => arrived,
        Ok(None) => return,
        Err(_) => return admission.count(ClientRefusal::HandshakeTooSlow),
    };
    #[cfg(not(feature = "grpc"))]
    drop(open);
    match at.protocol {
        #[cfg(feature = "grpc")]
        Protocol::Grpc => shared.grpc.serve(stream, arrival, deadline, handshake, open).await,
        #[cfg(feature = "_websocket")]
        Protocol::WebSocket => shared.websocket.serve(stream, arrival, deadline, handshake).await,
        #[cfg(not(all(feature = "grpc", feature = "_websocket")))]
        // `Server::listen` refuses addresses of other protocols.
        _ => drop((stream, arrival)),
    }
}

/// Waits for the first bytes and completes the TLS handshake.
async fn arrive(
    stream: TcpStream,
    peer: SocketAddr,
    at: ListenAt,
    shared: &ServerState,
    engagement: &Engagement,
) -> Option<(Box<dyn ByteStream>, Arrival)> {
    // In every protocol of the gateway the client speaks first.
    stream.readable().await.ok()?;
    engagement.begin();
    if !at.is_encrypted {
        return Some((Box::new(stream), Arrival { peer, is_encrypted: false, certificate: None }));
    }
    let tls = shared.tls.borrow().clone()?;
    let config = match at.protocol {
        Protocol::WebSocket => tls.ws,
        Protocol::Grpc => tls.grpc,
    };
    let stream = match TlsAcceptor::from(config).accept(stream).await {
        Ok(stream) => stream,
        Err(error) => {
            shared.admission.count(ClientRefusal::TlsFailed);
            tracing::debug!(%peer, %error, "a client's TLS failed");
            return None;
        }
    };
    let chain = stream.get_ref().1.peer_certificates().unwrap_or_default();
    let access = shared.admission.access();
    let certificate = match Admission::judge_certificate(access.rules().anchors.as_ref(), chain) {
        Ok(certificate) => certificate,
        Err(error) => {
            shared.admission.count(ClientRefusal::CertificateDoesNotHold);
            tracing::debug!(%peer, %error, "a client's certificate does not hold");
            None
        }
    };
    Some((Box::new(stream), Arrival { peer, is_encrypted: true, certificate }))
}
