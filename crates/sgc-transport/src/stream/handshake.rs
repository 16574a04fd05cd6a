//! From a TCP connection to an authenticated stream: the layers of each scheme, and both ends' greetings.
//!
//! | scheme | from the outside in |
//! |---|---|
//! | `tls` | TCP, TLS |
//! | `tcp` | TCP, TLS until both ends are known, then records that are authenticated (`record.rs`) |
//! | `ws` | TCP, WebSocket, TLS |
//! | `wss` | TCP, TLS that authenticates nobody, WebSocket, TLS |
//!
//! The innermost TLS is the one that counts: both certificates, in every handshake. Each scheme has an application
//! protocol of its own there, so nobody between the two can talk them into the clear.

use std::io;
use std::sync::Arc;
use std::time::{Duration, Instant};

use rustls::pki_types::ServerName;
use rustls::{AlertDescription, NamedGroup};
use sgc_trust::{CertError, VerifiedPeer};
use sgc_websocket::UpgradeError;
use sgc_wire::{Decode, DecodeError, Encode, LaneToken};
use socket2::SockRef;
use tokio::io::{AsyncReadExt as _, AsyncWriteExt as _};
use tokio::net::TcpStream;
use tokio_rustls::{TlsAcceptor, TlsConnector, TlsStream};

use super::driver::part;
use super::record::{Keys, RecordError, RecordStream};
use super::wire::{Counters, CountingTcp, TlsIo, Wire};
use crate::credentials::CredentialStore;
use crate::error::{LinkError, PeerRefusal, ProtocolError, Refusal};
use crate::framing::{Greeting, control_head};
use crate::limits::CONTROL_FRAME_BYTES_MAX;
use crate::options::LinkOptions;
use crate::socket::mark;
use crate::stats::KeyExchange;
use crate::tls::{self, Findings};
use crate::url::{LinkUrl, Scheme};

/// TLS requires a name; ours is neither sent nor compared.
const SERVER_NAME: &str = "sgc.invalid";
/// Unsent bytes in the kernel: urgent packets can no longer overtake them.
const UNSENT_BYTES_MAX: u32 = 64 << 10;

/// Returns the application protocol (RFC 7301) of the innermost TLS. The two schemes of WebSocket share theirs: a web
/// proxy makes one of the other.
fn alpn(scheme: Scheme) -> &'static [u8] {
    match scheme {
        Scheme::Tcp => b"sgc-tcp/2",
        Scheme::Ws | Scheme::Wss => b"sgc-ws/1",
        _ => b"sgc-tls/1",
    }
}

/// A stream with the peer at its other end.
pub(super) struct EstablishedStream {
    pub(super) wire: Wire,
    pub(super) counters: Arc<Counters>,
    pub(super) peer: VerifiedPeer,
    pub(super) lane: Option<LaneToken>,
    /// Round trip of the handshake, with the computing time of both ends.
    pub(super) rtt: Duration,
    pub(super) key_exchange: KeyExchange,
    pub(super) mtu_bytes: u16,
}

/// A TLS connection over any stream below, with its findings.
pub(super) struct TlsConnection {
    tls: TlsStream<TlsIo>,
    findings: Arc<Findings>,
    counters: Arc<Counters>,
    mtu_bytes: u16,
    scheme: Scheme,
    /// Begin and length of the handshake's last round trip.
    asked: Instant,
    rtt: Duration,
}

/// The reason why a handshake failed.
enum Failure {
    Io(io::Error),
    Upgrade(UpgradeError),
    Protocol(ProtocolError),
    /// The peer agreed on no application protocol.
    Alpn,
    /// The peer's certificate is not accepted.
    Certificate(CertError),
}

impl From<RecordError> for Failure {
    fn from(error: RecordError) -> Self {
        Self::Io(error.into())
    }
}

impl From<io::Error> for Failure {
    fn from(error: io::Error) -> Self {
        Self::Io(error)
    }
}

/// Sets a fresh connection up: the kernel delays nothing and keeps little unsent.
fn prepare(tcp: TcpStream, options: &LinkOptions) -> io::Result<PreparedSocket> {
    tcp.set_nodelay(true)?;
    let socket = SockRef::from(&tcp);
    if let Some(dscp) = options.dscp {
        mark(&socket, tcp.local_addr()?.is_ipv6(), dscp)?;
    }
    socket.set_tcp_notsent_lowat(UNSENT_BYTES_MAX)?;
    let mtu_bytes = u16::try_from(socket.tcp_mss()?).unwrap_or(u16::MAX);
    let counters = Arc::<Counters>::default();
    let wire = Box::new(CountingTcp { tcp, counters: Arc::clone(&counters) });
    Ok((wire, counters, mtu_bytes))
}

fn below(scheme: Scheme, wire: Wire) -> TlsIo {
    if scheme == Scheme::Tcp { TlsIo::until_close_notify(wire) } else { TlsIo::whole(wire) }
}

/// Accepts on a TCP connection: all of the handshake.
pub(super) async fn accept(
    tcp: TcpStream,
    scheme: Scheme,
    path: &str,
    credentials: &CredentialStore,
    options: &LinkOptions,
) -> Result<EstablishedStream, Refusal> {
    let prepared = prepare(tcp, options).map_err(|e| refusal(&Findings::default(), e.into()))?;
    accept_on(prepared, scheme, path, credentials, options).await
}

/// A fresh connection: itself, its counters and its longest packet.
pub(super) type PreparedSocket = (Wire, Arc<Counters>, u16);

/// Accepts on any stream of bytes.
pub(super) async fn accept_on(
    (mut wire, counters, mtu_bytes): PreparedSocket,
    scheme: Scheme,
    path: &str,
    credentials: &CredentialStore,
    options: &LinkOptions,
) -> Result<EstablishedStream, Refusal> {
    let nothing = Findings::default();
    let refused = |failure| refusal(&nothing, failure);
    if scheme == Scheme::Wss {
        let acceptor = TlsAcceptor::from(Arc::new(tls::outer_server(credentials)));
        match acceptor.accept(wire).into_fallible().await {
            Ok(outer) => wire = Box::new(outer),
            Err((error, wire)) => {
                part(wire).await;
                return Err(refused(error.into()));
            }
        }
    }
    if matches!(scheme, Scheme::Ws | Scheme::Wss) {
        match sgc_websocket::accept(wire, path).await {
            Ok(stream) => wire = Box::new(stream),
            Err((error, wire)) => {
                part(wire).await;
                return Err(refused(Failure::Upgrade(error)));
            }
        }
    }
    let asked = Instant::now();
    let (config, findings) = tls::server(credentials, options, alpn(scheme));
    let acceptor = TlsAcceptor::from(Arc::new(config));
    let tls = match acceptor.accept(below(scheme, wire)).into_fallible().await {
        Ok(tls) => TlsStream::Server(tls),
        Err((error, below)) => {
            part(below.into_wire()).await;
            return Err(refusal(&findings, error.into()));
        }
    };
    let rtt = Duration::ZERO;
    let mut secured = TlsConnection { tls, findings, counters, mtu_bytes, scheme, asked, rtt };
    match secured.be_greeted().await {
        Ok(greeting) => secured.made(greeting).map_err(refused),
        Err(failure) => {
            let refusal = refusal(&secured.findings, failure);
            part(Box::new(secured.tls)).await;
            Err(refusal)
        }
    }
}

/// Dials on a TCP connection, up to the listener's certificate; [`TlsConnection::greet`] tells whether the listener
/// accepts ours.
pub(super) async fn dial(
    tcp: TcpStream,
    url: &LinkUrl,
    credentials: &CredentialStore,
    options: &LinkOptions,
) -> Result<TlsConnection, LinkError> {
    dial_on(prepare(tcp, options)?, url, credentials, options).await
}

/// Dials on any stream of bytes.
pub(super) async fn dial_on(
    (mut wire, counters, mtu_bytes): PreparedSocket,
    url: &LinkUrl,
    credentials: &CredentialStore,
    options: &LinkOptions,
) -> Result<TlsConnection, LinkError> {
    let nothing = Findings::default();
    let failed = |failure| link_error(&nothing, failure);
    if url.scheme == Scheme::Wss {
        let connector = TlsConnector::from(Arc::new(tls::outer_client()));
        // Web proxies choose by the name.
        let name = ServerName::try_from(url.host.clone()).map_err(|e| LinkError::Transport(e.to_string()))?;
        wire = Box::new(connector.connect(name, wire).await.map_err(|e| failed(e.into()))?);
    }
    if matches!(url.scheme, Scheme::Ws | Scheme::Wss) {
        let upgraded = sgc_websocket::dial(wire, &url.authority(), url.path()).await;
        wire = Box::new(upgraded.map_err(|e| failed(Failure::Upgrade(e)))?);
    }
    let (config, findings) = tls::client(credentials, options, alpn(url.scheme));
    let connector = TlsConnector::from(Arc::new(config));
    let name = ServerName::try_from(SERVER_NAME).map_err(|e| LinkError::Transport(e.to_string()))?;
    match connector.connect(name, below(url.scheme, wire)).into_fallible().await {
        Ok(tls) => {
            let (tls, scheme) = (TlsStream::Client(tls), url.scheme);
            let (asked, rtt) = (Instant::now(), Duration::ZERO);
            Ok(TlsConnection { tls, findings, counters, mtu_bytes, scheme, asked, rtt })
        }
        Err((error, below)) => {
            // Sends the alert before the end.
            part(below.into_wire()).await;
            Err(link_error(&findings, error.into()))
        }
    }
}

impl TlsConnection {
    /// Returns the innermost TLS, for tests that write their own bytes into it.
    #[cfg(feature = "fuzzing")]
    pub(super) fn into_stream(self) -> TlsStream<TlsIo> {
        self.tls
    }

    /// Sends the dialer's greeting; the listener's answer shows that it accepts us.
    pub(super) async fn greet(mut self, greeting: Greeting) -> Result<EstablishedStream, LinkError> {
        match self.exchange(&greeting).await {
            Ok(()) => self.made(greeting).map_err(|failure| link_error(&Findings::default(), failure)),
            Err(failure) => {
                let error = link_error(&self.findings, failure);
                part(Box::new(self.tls)).await;
                Err(error)
            }
        }
    }

    async fn exchange(&mut self, greeting: &Greeting) -> Result<(), Failure> {
        self.check_alpn()?;
        self.asked = Instant::now();
        self.send_greeting(greeting).await?;
        self.hear_greeting().await?;
        if self.scheme == Scheme::Tcp {
            self.hear_end().await?;
            self.tls.shutdown().await?;
        }
        Ok(())
    }

    async fn be_greeted(&mut self) -> Result<Greeting, Failure> {
        self.check_alpn()?;
        let heard = self.hear_greeting().await;
        let version = |f: &Failure| {
            matches!(f, Failure::Protocol(ProtocolError::Greeting(DecodeError::Version { .. })))
        };
        // Our greeting tells the dialer the version that is spoken here, also if it is another.
        if heard.as_ref().err().is_none_or(version) {
            self.send_greeting(&Greeting::default()).await?;
        }
        let greeting = heard?;
        if self.scheme == Scheme::Tcp {
            self.tls.shutdown().await?;
            self.hear_end().await?;
        }
        Ok(greeting)
    }

    /// Checks the application protocol: TLS accepts a peer that names none, a link does not.
    fn check_alpn(&self) -> Result<(), Failure> {
        let (_, common) = self.tls.get_ref();
        if common.alpn_protocol() == Some(alpn(self.scheme)) { Ok(()) } else { Err(Failure::Alpn) }
    }

    async fn send_greeting(&mut self, greeting: &Greeting) -> Result<(), Failure> {
        let body = greeting.to_bytes();
        self.tls.write_all(&[&control_head(body.len())[..], &body].concat()).await?;
        Ok(self.tls.flush().await?)
    }

    /// Reads exactly the greeting: later bytes belong to the link.
    async fn hear_greeting(&mut self) -> Result<Greeting, Failure> {
        let mut length = [0; 4];
        self.tls.read_exact(&mut length).await?;
        self.rtt = self.asked.elapsed();
        let bytes = u32::from_be_bytes(length);
        if bytes as usize > CONTROL_FRAME_BYTES_MAX {
            return Err(Failure::Protocol(ProtocolError::ControlFrameTooLong { bytes: bytes.into() }));
        }
        let mut body = Vec::new();
        (&mut self.tls).take(bytes.into()).read_to_end(&mut body).await?;
        if body.len() < bytes as usize {
            return Err(io::Error::from(io::ErrorKind::UnexpectedEof).into());
        }
        Greeting::from_slice(&body).map_err(ProtocolError::Greeting).map_err(Failure::Protocol)
    }

    /// Waits for the authenticated end of TLS, behind which the stream continues without it.
    async fn hear_end(&mut self) -> Result<(), Failure> {
        match self.tls.read(&mut [0]).await? {
            0 => Ok(()),
            _ => Err(Failure::Protocol(ProtocolError::ControlEnded)),
        }
    }

    fn made(self, Greeting { lane, .. }: Greeting) -> Result<EstablishedStream, Failure> {
        // TLS with mandatory certificates ends no handshake without a verdict. If it ever did, no link comes of it.
        let verdict = self.findings.verdict().cloned().unwrap_or(Err(CertError::NoCertificate));
        let peer = verdict.map_err(Failure::Certificate)?;
        let group = self.tls.get_ref().1.negotiated_key_exchange_group().map(|group| group.name());
        let key_exchange = match group {
            Some(NamedGroup::X25519) => KeyExchange::X25519,
            Some(NamedGroup::X25519MLKEM768) => KeyExchange::X25519MlKem768,
            _ => KeyExchange::Unknown,
        };
        let wire: Wire = match (self.scheme, self.tls) {
            (Scheme::Tcp, TlsStream::Client(tls)) => {
                let (below, tls) = tls.into_inner();
                let keys = Keys::export(&tls, tls.negotiated_cipher_suite().map(|s| s.suite()), true)?;
                Box::new(RecordStream::new(below.into_wire(), keys))
            }
            (Scheme::Tcp, TlsStream::Server(tls)) => {
                let (below, tls) = tls.into_inner();
                let keys = Keys::export(&tls, tls.negotiated_cipher_suite().map(|s| s.suite()), false)?;
                Box::new(RecordStream::new(below.into_wire(), keys))
            }
            (_, tls) => Box::new(tls),
        };
        Ok(EstablishedStream {
            wire,
            counters: self.counters,
            peer,
            lane,
            rtt: self.rtt,
            key_exchange,
            mtu_bytes: self.mtu_bytes,
        })
    }
}

/// Returns the TLS error in an error of the stream.
fn tls_error(error: &io::Error) -> Option<&rustls::Error> {
    error.get_ref().and_then(|inner| inner.downcast_ref())
}

fn is_gone(error: &io::Error) -> bool {
    use io::ErrorKind::{BrokenPipe, ConnectionAborted, ConnectionReset, NotConnected, UnexpectedEof};
    matches!(error.kind(), UnexpectedEof | ConnectionReset | ConnectionAborted | BrokenPipe | NotConnected)
}

/// Returns the reason why an incoming peer has no link.
fn refusal(findings: &Findings, failure: Failure) -> Refusal {
    if let Some(Err(cert)) = findings.verdict() {
        return Refusal::Certificate(cert.clone());
    }
    let error = match failure {
        Failure::Alpn => return Refusal::Version("it names no application protocol".into()),
        Failure::Certificate(why) => return Refusal::Certificate(why),
        Failure::Protocol(ProtocolError::Greeting(e @ DecodeError::Version { .. })) => {
            return Refusal::Version(e.to_string());
        }
        Failure::Protocol(why) => return Refusal::Greeting(why),
        Failure::Upgrade(UpgradeError::Io(error)) | Failure::Io(error) => error,
        Failure::Upgrade(why) => return Refusal::Version(why.to_string()),
    };
    match tls_error(&error) {
        Some(rustls::Error::AlertReceived(alert)) => Refusal::ByPeer(peer_refusal(*alert)),
        Some(rustls::Error::NoCertificatesPresented) => Refusal::Certificate(CertError::NoCertificate),
        Some(rustls::Error::PeerIncompatible(_)) if findings.lacks_key_exchange() => {
            Refusal::KeyExchange { post_quantum: findings.post_quantum }
        }
        Some(
            e @ (rustls::Error::NoApplicationProtocol
            | rustls::Error::PeerIncompatible(_)
            | rustls::Error::InvalidMessage(_)),
        ) => Refusal::Version(e.to_string()),
        Some(e) => Refusal::Transport(e.to_string()),
        None if is_gone(&error) => Refusal::ByPeer(PeerRefusal::GaveUp),
        None => Refusal::Transport(error.to_string()),
    }
}

/// Returns the reason why dialling led to no link.
fn link_error(findings: &Findings, failure: Failure) -> LinkError {
    if let Some(Err(cert)) = findings.verdict() {
        return LinkError::RefusedHere(cert.clone());
    }
    let error = match failure {
        Failure::Alpn => return LinkError::RefusedByPeer(PeerRefusal::Version),
        Failure::Certificate(why) => return LinkError::RefusedHere(why),
        Failure::Protocol(why) => return why.into(),
        Failure::Upgrade(UpgradeError::Io(error)) | Failure::Io(error) => error,
        Failure::Upgrade(UpgradeError::Status(503)) => {
            return LinkError::RefusedByPeer(PeerRefusal::Overloaded);
        }
        Failure::Upgrade(why) => return LinkError::RefusedByPeer(PeerRefusal::Other(why.to_string())),
    };
    match tls_error(&error) {
        Some(rustls::Error::AlertReceived(alert)) => LinkError::RefusedByPeer(peer_refusal(*alert)),
        Some(rustls::Error::InvalidMessage(_)) => LinkError::RefusedByPeer(PeerRefusal::Version),
        Some(e) => LinkError::Transport(e.to_string()),
        None if is_gone(&error) => LinkError::RefusedByPeer(PeerRefusal::GaveUp),
        None => error.into(),
    }
}

fn peer_refusal(alert: AlertDescription) -> PeerRefusal {
    match alert {
        // `endpoint` answers with it when there is no time for a handshake.
        AlertDescription::InternalError => PeerRefusal::Overloaded,
        alert => PeerRefusal::from_alert(alert.into()),
    }
}
