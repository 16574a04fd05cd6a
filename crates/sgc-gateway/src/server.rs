//! [`Server`]: the gateway's sockets. Accepts connections, terminates TLS, admits clients and starts their protocol.

use std::collections::BTreeMap;
use std::fmt;
use std::io;
use std::net::SocketAddr;
use std::pin::Pin;
use std::sync::Arc;
use std::task::{Context, Poll};
use std::time::Duration;

use rustls::ServerConfig;
use rustls::sign::CertifiedKey;
use rustls_pki_types::CertificateDer;
use sgc_trust::{TrustAnchors, VerifiedPeer};
use tokio::io::{AsyncRead, AsyncWrite, ReadBuf};
use tokio::net::{TcpListener, TcpStream};
use tokio::sync::{mpsc, watch};
use tokio::task::JoinSet;
use tokio::time::{Instant, Sleep};
use tokio_rustls::TlsAcceptor;
use tokio_stream::wrappers::ReceiverStream;

use crate::access::{Access, Denial};
use crate::admission::{Admission, Arrival, Engagement, GatewayStatus, Handshake, Handshakes, Place};
use crate::foxglove::{self, FoxgloveError};
use crate::grpc::{AcceptedStream, Connection, Grpc, GrpcOptions};
use crate::hub::Hub;
use crate::inflow::{Inflow, MeteredStream};
use crate::rosbridge::{self, Authenticate, RosbridgeError, RosbridgeOptions};
use crate::session::{Session, SessionLimits};
use crate::tls::{TlsError, server_config};
use crate::ws::{Upgrade, UpgradeError, upgrade};

/// Time for TLS and the WebSocket upgrade together, or for TLS and the first admitted call of gRPC.
const HANDSHAKE_MAX: Duration = Duration::from_secs(10);
/// Pause after the system refused to accept, for instance for lack of file descriptors.
const ACCEPT_RETRY: Duration = Duration::from_millis(100);
/// Time to deliver the last answers on a gRPC connection on which no client is admitted any more.
const GRPC_FAREWELL_MAX: Duration = Duration::from_secs(2);
/// Most connections that wait for the gRPC server.
const GRPC_WAITING_MAX: usize = 64;
/// Status key for messages that were not kept for later subscribers.
const HISTORY_DROPPED: &str = "messages not kept for later subscribers";

/// The protocol of a listening address.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub enum Protocol {
    /// WebSocket: the rosbridge protocol, or Foxglove's if the client requests its subprotocol.
    WebSocket,
    /// gRPC.
    Grpc,
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
    /// The certificate and key of the gateway for TLS.
    pub key: Option<Arc<CertifiedKey>>,
    /// Most clients at a time.
    pub clients_max: usize,
    /// The limits of each session.
    pub limits: SessionLimits,
}

/// The reason why a server does not start.
#[derive(Debug, thiserror::Error)]
pub enum ServerError {
    /// An address could not be bound.
    #[error("the gateway cannot listen on {at}: {source}")]
    Listen {
        /// The address.
        at: ListenAt,
        /// The error of the system.
        source: io::Error,
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
    /// The certificates of both, the gateway's own first.
    chain: Vec<CertificateDer<'static>>,
}

struct ServerState {
    hub: Hub,
    admission: Arc<Admission>,
    tls: watch::Sender<Option<Tls>>,
    limits: SessionLimits,
    foxglove: foxglove::Options,
    handshakes: Arc<Handshakes>,
    grpc: mpsc::Sender<AcceptedStream<GrpcStream>>,
}

/// Any stream of bytes.
trait ByteStream: AsyncRead + AsyncWrite + Send + Unpin {}

impl<S: AsyncRead + AsyncWrite + Send + Unpin> ByteStream for S {}

/// The byte stream of a gRPC connection. Its client must be admitted in time, and occupies a place while a client is
/// admitted on it.
struct GrpcStream {
    stream: Box<dyn ByteStream>,
    admission: Arc<Admission>,
    connection: Connection,
    standing: Standing,
}

/// The admission state of a gRPC connection.
enum Standing {
    /// The client has not been admitted yet and must be by the deadline.
    Unproven { deadline: Pin<Box<Sleep>>, handshake: Handshake },
    /// The client was admitted.
    Proven(#[expect(dead_code, reason = "it is for its end")] Place),
    /// No client is admitted any more. Until the deadline the client may read the refusal or show another credential.
    Denied { deadline: Pin<Box<Sleep>> },
    /// The connection must close. The reason has been counted.
    Refused,
}

impl GrpcStream {
    fn new(
        stream: Box<dyn ByteStream>,
        admission: Arc<Admission>,
        connection: Connection,
        deadline: Instant,
        handshake: Handshake,
    ) -> Self {
        let deadline = Box::pin(tokio::time::sleep_until(deadline));
        Self { stream, admission, connection, standing: Standing::Unproven { deadline, handshake } }
    }

    /// Fails once the client may not stay. Called before reads and writes, because a client that does not read its
    /// answers must not send either.
    fn check(&mut self, cx: &mut Context<'_>) -> io::Result<()> {
        let admitted = self.connection.poll_admitted(cx);
        let (standing, result) = match (&mut self.standing, admitted) {
            (Standing::Refused, _) => return Err(io::ErrorKind::ConnectionAborted.into()),
            (Standing::Proven(_), Some(_)) => return Ok(()),
            (Standing::Proven(_), None) => {
                self.admission.count("no longer admitted");
                let deadline = Box::pin(tokio::time::sleep(GRPC_FAREWELL_MAX));
                self.standing = Standing::Denied { deadline };
                return self.check(cx);
            }
            (_, Some(client)) => match self.admission.enter(&client, "grpc", self.connection.peer()) {
                Some(place) => (Standing::Proven(place), Ok(())),
                None => (Standing::Refused, Err(io::Error::other("too many clients"))),
            },
            (Standing::Unproven { deadline, handshake }, None) => {
                if handshake.poll_evicted(cx).is_ready() {
                    self.admission.count("handshake gave way");
                    (Standing::Refused, Err(io::ErrorKind::ConnectionAborted.into()))
                } else if deadline.as_mut().poll(cx).is_ready() {
                    self.admission.count("handshake too slow");
                    (Standing::Refused, Err(io::ErrorKind::TimedOut.into()))
                } else {
                    return Ok(());
                }
            }
            (Standing::Denied { deadline }, None) => match deadline.as_mut().poll(cx) {
                Poll::Pending => return Ok(()),
                Poll::Ready(()) => (Standing::Refused, Err(io::ErrorKind::ConnectionAborted.into())),
            },
        };
        self.standing = standing;
        result
    }
}

impl AsyncRead for GrpcStream {
    fn poll_read(
        mut self: Pin<&mut Self>,
        cx: &mut Context<'_>,
        buf: &mut ReadBuf<'_>,
    ) -> Poll<io::Result<()>> {
        self.check(cx)?;
        Pin::new(&mut self.stream).poll_read(cx, buf)
    }
}

impl AsyncWrite for GrpcStream {
    fn poll_write(mut self: Pin<&mut Self>, cx: &mut Context<'_>, buf: &[u8]) -> Poll<io::Result<usize>> {
        self.check(cx)?;
        Pin::new(&mut self.stream).poll_write(cx, buf)
    }

    fn poll_flush(mut self: Pin<&mut Self>, cx: &mut Context<'_>) -> Poll<io::Result<()>> {
        self.check(cx)?;
        Pin::new(&mut self.stream).poll_flush(cx)
    }

    fn poll_shutdown(mut self: Pin<&mut Self>, cx: &mut Context<'_>) -> Poll<io::Result<()>> {
        // A connection that must close does not wait until its farewell is sent.
        self.check(cx)?;
        Pin::new(&mut self.stream).poll_shutdown(cx)
    }

    fn poll_write_vectored(
        mut self: Pin<&mut Self>,
        cx: &mut Context<'_>,
        bufs: &[io::IoSlice<'_>],
    ) -> Poll<io::Result<usize>> {
        self.check(cx)?;
        Pin::new(&mut self.stream).poll_write_vectored(cx, bufs)
    }

    fn is_write_vectored(&self) -> bool {
        self.stream.is_write_vectored()
    }
}

/// The gateway's sockets and connections. All of them end when it is dropped.
pub struct Server {
    shared: Arc<ServerState>,
    local: Vec<ListenAt>,
    _tasks: JoinSet<()>,
}

fn tls_config(key: Option<&Arc<CertifiedKey>>, access: &Access) -> Result<Option<Tls>, TlsError> {
    let asks = access.takes_certificates();
    key.map(|key| {
        let ws = server_config(key, asks, &[b"http/1.1"])?;
        Ok(Tls { ws, grpc: server_config(key, asks, &[b"h2"])?, chain: key.cert.clone() })
    })
    .transpose()
}

impl Server {
    /// Binds all addresses and serves clients.
    pub async fn start(hub: Hub, options: ServerOptions) -> Result<Self, ServerError> {
        let tls = tls_config(options.key.as_ref(), &options.access)?;
        if tls.is_none() && options.listen.iter().any(|at| at.is_encrypted) {
            return Err(ServerError::NoKey);
        }
        let admission = Admission::new(options.access, options.clients_max);
        let (grpc, accepted) = mpsc::channel(GRPC_WAITING_MAX);
        let mut tasks = JoinSet::new();
        let grpc_options = GrpcOptions { session: options.limits, ..GrpcOptions::default() };
        let front = Grpc::new(hub.clone(), admission.rules().clone(), grpc_options);
        tasks.spawn(async move {
            if let Err(error) = front.serve(ReceiverStream::new(accepted)).await {
                tracing::error!(%error, "gRPC is not served any more");
            }
        });
        let shared = Arc::new(ServerState {
            hub,
            admission,
            tls: watch::Sender::new(tls),
            limits: options.limits,
            foxglove: foxglove::Options { name: options.name, ..foxglove::Options::default() },
            handshakes: Arc::default(),
            grpc,
        });
        let mut local = Vec::new();
        for at in options.listen {
            let bound = TcpListener::bind(at.addr).await.and_then(|listener| {
                let addr = listener.local_addr()?;
                Ok((listener, ListenAt { addr, ..at }))
            });
            let (listener, at) = bound.map_err(|source| ServerError::Listen { at, source })?;
            tracing::info!("programs without ROS may connect at {at}");
            local.push(at);
            tasks.spawn(keep_accepting(listener, at, Arc::clone(&shared)));
        }
        Ok(Self { shared, local, _tasks: tasks })
    }

    /// Returns the listening addresses.
    pub fn local(&self) -> &[ListenAt] {
        &self.local
    }

    /// Applies other rules and another certificate. Clients that the rules no longer admit are disconnected.
    pub fn reconfigure(&self, access: Access, key: Option<&Arc<CertifiedKey>>) -> Result<(), ServerError> {
        let tls = tls_config(key, &access)?;
        if tls.is_none() && self.local.iter().any(|at| at.is_encrypted) {
            return Err(ServerError::NoKey);
        }
        self.shared.tls.send_replace(tls);
        self.shared.admission.rules().change(|before| access.after(before));
        Ok(())
    }

    /// Shows another certificate to new connections. Existing connections stay.
    pub fn show(&self, key: &Arc<CertifiedKey>) -> Result<(), ServerError> {
        let tls = tls_config(Some(key), &self.shared.admission.access())?;
        self.shared.tls.send_replace(tls);
        Ok(())
    }

    /// Returns the certificates for new connections, the gateway's own first. The list is empty without TLS.
    pub fn shown(&self) -> Vec<CertificateDer<'static>> {
        self.shared.tls.borrow().as_ref().map(|tls| tls.chain.clone()).unwrap_or_default()
    }

    /// Verifies tokens with this certificate of the gateway from now on.
    pub fn set_gateway(&self, gateway: VerifiedPeer) {
        self.shared.admission.rules().change(|access| access.clone().with_gateway(gateway));
    }

    /// Verifies certificates against other CAs or revocation lists from now on.
    pub fn set_anchors(&self, anchors: TrustAnchors) {
        self.shared.admission.rules().change(|access| access.clone().with_anchors(anchors));
    }

    /// Returns the status of the gateway.
    pub fn status(&self) -> GatewayStatus {
        GatewayStatus {
            listen: self.local.iter().map(ToString::to_string).collect(),
            clients: self.shared.admission.clients(),
            refused: self.refused(),
            readers: self.shared.hub.readers(),
        }
    }

    /// Returns the number of refusals by reason.
    fn refused(&self) -> BTreeMap<String, u64> {
        let mut refused = self.shared.admission.refused();
        let crowded = self.shared.hub.shared.quotas.refused();
        refused.extend(crowded.into_iter().map(|(pool, count)| (format!("too much for {pool}"), count)));
        let not_kept = self.shared.hub.shared.quotas.history_dropped();
        refused.extend((not_kept > 0).then(|| (HISTORY_DROPPED.to_owned(), not_kept)));
        refused
    }

    /// Returns the hub.
    pub fn hub(&self) -> &Hub {
        &self.shared.hub
    }
}

impl fmt::Debug for Server {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_struct("Server").field("local", &self.local).finish_non_exhaustive()
    }
}

async fn keep_accepting(listener: TcpListener, at: ListenAt, shared: Arc<ServerState>) {
    // The set ends all connections when the listener ends.
    let mut connections = JoinSet::new();
    loop {
        tokio::select! {
            accepted = listener.accept() => match accepted {
                Ok((stream, peer)) => {
                    let _ = stream.set_nodelay(true);
                    connections.spawn(serve(stream, peer, at, Arc::clone(&shared)));
                }
                Err(error) => {
                    tracing::warn!(%error, "the gateway could not accept a connection");
                    tokio::time::sleep(ACCEPT_RETRY).await;
                }
            },
            Some(_) = connections.join_next(), if !connections.is_empty() => {}
        }
    }
}

async fn serve(stream: TcpStream, peer: SocketAddr, at: ListenAt, shared: Arc<ServerState>) {
    let admission = &shared.admission;
    let Some(mut handshake) = Handshakes::begin(&shared.handshakes, peer.ip()) else {
        return admission.count("too many handshakes");
    };
    let deadline = Instant::now() + HANDSHAKE_MAX;
    let engagement = handshake.engagement();
    let arriving = arrive(stream, peer, at, &shared, &engagement);
    let arrived = tokio::select! {
        arrived = tokio::time::timeout_at(deadline, arriving) => arrived,
        () = handshake.evicted() => return admission.count("handshake gave way"),
    };
    let (stream, arrival) = match arrived {
        Ok(Some(arrived)) => arrived,
        Ok(None) => return,
        Err(_) => return admission.count("handshake too slow"),
    };
    match at.protocol {
        Protocol::Grpc => {
            // A gRPC client shows its credential with each call.
            let Arrival { peer, is_encrypted, certificate } = arrival;
            let connection =
                if is_encrypted { Connection::encrypted(peer, certificate) } else { Connection::plain(peer) };
            let placed =
                GrpcStream::new(stream, Arc::clone(admission), connection.clone(), deadline, handshake);
            let _ = shared.grpc.send(AcceptedStream::new(placed, connection)).await;
        }
        Protocol::WebSocket => {
            let inflow: Arc<Inflow> = Arc::default();
            let stream = MeteredStream::new(stream, Arc::clone(&inflow));
            let upgraded = tokio::select! {
                upgraded = tokio::time::timeout_at(deadline, upgrade(stream, &arrival, admission, &foxglove::SUBPROTOCOLS)) => upgraded,
                () = handshake.evicted() => return admission.count("handshake gave way"),
            };
            drop(handshake);
            match upgraded {
                Ok(Ok(upgraded)) => speak(upgraded, arrival, inflow, &shared).await,
                Ok(Err(UpgradeError::NotAdmitted)) => {}
                Ok(Err(UpgradeError::Socket(error))) => {
                    tracing::debug!(%peer, %error, "no WebSocket");
                    admission.count("no WebSocket");
                }
                Err(_) => admission.count("handshake too slow"),
            }
        }
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
            shared.admission.count("TLS failed");
            tracing::debug!(%peer, %error, "a client's TLS failed");
            return None;
        }
    };
    let chain = stream.get_ref().1.peer_certificates().unwrap_or_default();
    let access = shared.admission.access();
    let certificate = match Admission::judge_certificate(access.rules().anchors.as_ref(), chain) {
        Ok(certificate) => certificate,
        Err(error) => {
            shared.admission.count("certificate does not hold");
            tracing::debug!(%peer, %error, "a client's certificate does not hold");
            None
        }
    };
    Some((Box::new(stream), Arrival { peer, is_encrypted: true, certificate }))
}

/// Serves a client until it leaves or its rights end.
async fn speak(
    upgraded: Upgrade<MeteredStream<Box<dyn ByteStream>>>,
    arrival: Arrival,
    inflow: Arc<Inflow>,
    shared: &ServerState,
) {
    let (admission, peer, client) = (&shared.admission, arrival.peer, upgraded.client);
    let protocol = if upgraded.subprotocol.is_some() { "foxglove" } else { "rosbridge" };
    let Some(place) = admission.enter(&client, protocol, peer) else { return };
    let place = Arc::new(place);
    let name = Arc::clone(&client.name);
    let session = Session::new(&shared.hub, client, shared.limits).admitted_by(admission.rules().clone());
    let session = session.metered_by(inflow);
    let ended = if upgraded.subprotocol.is_some() {
        let served = foxglove::serve(upgraded.socket, Arc::new(session), shared.foxglove.clone());
        served.await.map_err(EndReason::from)
    } else {
        let (asked, place) = (Arc::clone(admission), Arc::clone(&place));
        // A token after the upgrade changes the credential of the client.
        let authenticate: Authenticate = Arc::new(move |token| {
            let admitted = asked.admit(&arrival, None, Some(token));
            let client = admitted.map_err(|denied| denied.client_message().to_owned())?;
            place.rename(&client).map_err(|why| why.to_string())?;
            Ok(client)
        });
        let options = RosbridgeOptions { authenticate: Some(authenticate), ..RosbridgeOptions::default() };
        let served = rosbridge::serve(upgraded.socket, Arc::new(session), options);
        served.await.map_err(EndReason::from)
    };
    match ended {
        Ok(()) => {}
        Err(EndReason::Denied(denied)) => {
            admission.count("no longer admitted");
            tracing::info!(client = %name, %denied, "a client is disconnected");
        }
        Err(EndReason::Failed(error)) => tracing::debug!(%peer, %error, "a client's connection failed"),
    }
}

/// The reason why a connection ended without the client's wish.
enum EndReason {
    /// The client's rights ended.
    Denied(Denial),
    /// The connection failed.
    Failed(String),
}

impl From<RosbridgeError> for EndReason {
    fn from(error: RosbridgeError) -> Self {
        match error {
            RosbridgeError::Denied(denied) => Self::Denied(denied),
            error => Self::Failed(error.to_string()),
        }
    }
}

impl From<FoxgloveError> for EndReason {
    fn from(error: FoxgloveError) -> Self {
        match error {
            FoxgloveError::Denied(denied) => Self::Denied(denied),
            error => Self::Failed(error.to_string()),
        }
    }
}

#[cfg(test)]
mod tests {
    use tokio::io::{AsyncReadExt as _, AsyncWriteExt as _, duplex};

    use super::*;
    use crate::access::Access;

    /// Returns a gRPC stream from another host and its far end.
    fn placed(
        admission: &Arc<Admission>,
        handshakes: &Arc<Handshakes>,
    ) -> (GrpcStream, tokio::io::DuplexStream) {
        let peer: SocketAddr = "192.0.2.1:1000".parse().unwrap();
        let (near, far) = duplex(16);
        let handshake = Handshakes::begin(handshakes, peer.ip()).unwrap();
        let (admission, deadline) = (Arc::clone(admission), Instant::now() + HANDSHAKE_MAX);
        (GrpcStream::new(Box::new(near), admission, Connection::plain(peer), deadline, handshake), far)
    }

    #[tokio::test(start_paused = true)]
    async fn unproven_client_is_disconnected_without_a_place() {
        let (admission, handshakes) = (Admission::new(Access::default(), 1), Arc::default());
        let (mut silent, _far) = placed(&admission, &handshakes);
        let (mut deaf, _other) = placed(&admission, &handshakes);
        let began = Instant::now();
        let mut buf = [0; 16];
        let read = silent.read(&mut buf);
        let written = async {
            // These bytes exceed the buffer.
            deaf.write_all(&[0; 64]).await
        };
        let (read, written) = tokio::join!(read, written);
        assert_eq!(read.unwrap_err().kind(), io::ErrorKind::TimedOut);
        assert_eq!(written.unwrap_err().kind(), io::ErrorKind::TimedOut);
        assert!(began.elapsed() >= HANDSHAKE_MAX && began.elapsed() < 2 * HANDSHAKE_MAX);
        assert!(silent.read(&mut buf).await.is_err() && silent.shutdown().await.is_err());
        assert_eq!(admission.refused(), [("handshake too slow".to_owned(), 2)].into());
        assert!(admission.clients().is_empty());
    }
}
