//! Fleets, links over loopback, and peers that are bare quinn.
#![allow(dead_code, unreachable_pub, reason = "shared by test programs of which each uses a part")]

use std::future::Future;
use std::net::SocketAddr;
use std::sync::Arc;
use std::time::{Duration, SystemTime, UNIX_EPOCH};

use bytes::{Bytes, BytesMut};
use quinn::crypto::rustls::QuicClientConfig;
use quinn::{Connection, ConnectionError, Endpoint};
use rand_chacha::ChaCha20Rng;
use rand_core::SeedableRng as _;
use rustls::client::danger::{HandshakeSignatureValid, ServerCertVerified, ServerCertVerifier};
use rustls::sign::SingleCertAndKey;
use rustls_pki_types::{CertificateDer, ServerName, UnixTime};
use sgc_transport::*;
use sgc_trust::{EnrollRequest, Fleet, Identity};
use sgc_wire::{Class, HOP_LIMIT, Name, Packet, PacketHeader, Payload, SourceId, UnixMillis};
use tokio::sync::mpsc;

/// Makes a test of each function for each transport.
#[allow(unused_macros)]
macro_rules! each_transport {
    ($tests:tt: $($scheme:ident)*) => { $(mod $scheme { each_transport!(@ $scheme $tests); })* };
    (@ $scheme:ident [$($test:ident)*]) => { $(
        #[tokio::test(flavor = "multi_thread", worker_threads = 2)]
        async fn $test() {
            super::$test(stringify!($scheme)).await;
        }
    )* };
}

pub const MINUTE: u64 = 60_000;

pub fn now() -> UnixMillis {
    UnixMillis(SystemTime::now().duration_since(UNIX_EPOCH).unwrap().as_millis() as u64)
}

pub fn fleet(seed: u64) -> Fleet {
    let created = UnixMillis(now().0 - 100 * 24 * 60 * MINUTE);
    Fleet::create("acme".parse().unwrap(), created, &mut ChaCha20Rng::seed_from_u64(seed)).unwrap()
}

pub fn enroll(fleet: &Fleet, node: &str) -> Arc<Identity> {
    enroll_at(fleet, node, now())
}

pub fn enroll_at(fleet: &Fleet, node: &str, now: UnixMillis) -> Arc<Identity> {
    let valid = Duration::from_secs(3600);
    let request = EnrollRequest { valid, ..EnrollRequest::new(node.parse().unwrap(), now) };
    Arc::new(fleet.issue(&request, &mut ChaCha20Rng::seed_from_u64(node.len() as u64)).unwrap())
}

/// A whole message in one reliable packet.
pub fn packet(seq: u64, payload: Bytes) -> Packet {
    packet_of(Class::Default, seq, payload)
}

/// Returns a whole message in one reliable packet of a class.
pub fn packet_of(class: Class, seq: u64, payload: Bytes) -> Packet {
    let header = PacketHeader {
        reliable: true,
        class,
        hops: HOP_LIMIT,
        suite: 1,
        epoch: 1,
        name: Name([1; 32]),
        source: SourceId([2; 16]),
        seq,
        total: payload.len() as u32,
        index: 0,
        grid: 16_384,
        to: None,
    };
    Packet::new(header, payload.into()).unwrap()
}

/// A payload in one piece.
pub fn joined(payload: &Payload) -> Bytes {
    let mut out = BytesMut::new();
    payload.copy_into(&mut out);
    out.freeze()
}

/// Fails if the future hangs.
pub async fn soon<T>(future: impl Future<Output = T>) -> T {
    tokio::time::timeout(Duration::from_secs(30), future).await.expect("it hangs")
}

/// A listener whose results come by a channel.
pub struct Server {
    pub url: LinkUrl,
    pub addr: SocketAddr,
    pub metrics: Arc<TransportMetrics>,
    pub results: mpsc::Receiver<Result<AnyLink, RefusedPeer>>,
}

/// A router of this fleet that listens for DTLS.
pub fn dtls_router(fleet: &Fleet) -> Server {
    Server::start_on("dtls", enroll(fleet, "router"), LinkOptions::default())
}

impl Server {
    pub fn start(identity: impl Into<CredentialStore>, options: LinkOptions) -> Self {
        Self::start_at("quic://127.0.0.1:0", identity, options)
    }

    /// Starts a listener of this scheme.
    pub fn start_on(scheme: &str, identity: impl Into<CredentialStore>, options: LinkOptions) -> Self {
        Self::start_at(&format!("{scheme}://127.0.0.1:0"), identity, options)
    }

    pub fn start_at(addr: &str, identity: impl Into<CredentialStore>, options: LinkOptions) -> Self {
        let metrics = Arc::new(TransportMetrics::default());
        let mut listener =
            Listener::bind(&addr.parse().unwrap(), identity, options, Arc::clone(&metrics)).unwrap();
        let url = listener.local().to_string().parse().unwrap();
        let addr = listener.local().addr;
        let (tx, results) = mpsc::channel(16);
        tokio::spawn(async move {
            while let Some(result) = listener.accept().await {
                if tx.send(result).await.is_err() {
                    break;
                }
            }
        });
        Self { url, addr, metrics, results }
    }

    pub async fn link(&mut self) -> AnyLink {
        soon(self.results.recv()).await.unwrap().unwrap()
    }

    pub async fn refusal(&mut self) -> RefusedPeer {
        soon(self.results.recv()).await.unwrap().unwrap_err()
    }
}

pub fn dialer(identity: impl Into<CredentialStore>) -> Dialer {
    Dialer::new(identity, LinkOptions::default(), Arc::new(TransportMetrics::default()))
}

pub async fn dial(identity: impl Into<CredentialStore>, url: &LinkUrl) -> Result<AnyLink, LinkError> {
    dial_with(&dialer(identity), url).await
}

/// One attempt, at one address.
pub async fn dial_with(dialer: &Dialer, url: &LinkUrl) -> Result<AnyLink, LinkError> {
    match soon(dialer.dial(url)).await {
        Ok(link) => Ok(link),
        Err(DialError::Failed { mut attempts, .. }) => Err(attempts.pop().unwrap().1),
        Err(other) => panic!("{other}"),
    }
}

/// A dialled link and its other end.
pub async fn pair(options: LinkOptions) -> (AnyLink, AnyLink) {
    pair_on("quic", options).await
}

/// Makes a link by the transport of this scheme.
pub async fn pair_on(scheme: &str, options: LinkOptions) -> (AnyLink, AnyLink) {
    let fleet = fleet(1);
    let mut server = Server::start_on(scheme, enroll(&fleet, "router"), options.clone());
    let dialer = Dialer::new(enroll(&fleet, "arm-1"), options, Arc::default());
    let near = soon(dialer.dial(&server.url)).await.unwrap();
    (near, server.link().await)
}

#[derive(Debug)]
pub struct TrustAnyone;

impl ServerCertVerifier for TrustAnyone {
    fn verify_server_cert(
        &self,
        _: &CertificateDer<'_>,
        _: &[CertificateDer<'_>],
        _: &ServerName<'_>,
        _: &[u8],
        _: UnixTime,
    ) -> Result<ServerCertVerified, rustls::Error> {
        Ok(ServerCertVerified::assertion())
    }

    fn verify_tls12_signature(
        &self,
        _: &[u8],
        _: &CertificateDer<'_>,
        _: &rustls::DigitallySignedStruct,
    ) -> Result<HandshakeSignatureValid, rustls::Error> {
        Ok(HandshakeSignatureValid::assertion())
    }

    fn verify_tls13_signature(
        &self,
        _: &[u8],
        _: &CertificateDer<'_>,
        _: &rustls::DigitallySignedStruct,
    ) -> Result<HandshakeSignatureValid, rustls::Error> {
        Ok(HandshakeSignatureValid::assertion())
    }

    fn supported_verify_schemes(&self) -> Vec<rustls::SignatureScheme> {
        vec![rustls::SignatureScheme::ECDSA_NISTP256_SHA256]
    }
}

/// The TLS of a dialer that accepts any certificate.
pub fn bare_tls(identity: Option<&Identity>, alpn: &str, groups: Option<Groups>) -> rustls::ClientConfig {
    let mut provider = rustls::crypto::aws_lc_rs::default_provider();
    provider.kx_groups = groups.unwrap_or(provider.kx_groups);
    let tls = rustls::ClientConfig::builder_with_provider(Arc::new(provider))
        .with_protocol_versions(&[&rustls::version::TLS13])
        .unwrap()
        .dangerous()
        .with_custom_certificate_verifier(Arc::new(TrustAnyone));
    let mut tls = match identity {
        None => tls.with_no_client_auth(),
        Some(i) => tls.with_client_cert_resolver(Arc::new(SingleCertAndKey::from(i.certified_key()))),
    };
    tls.alpn_protocols = vec![alpn.into()];
    tls
}

/// Key exchanges.
pub type Groups = Vec<&'static dyn rustls::crypto::SupportedKxGroup>;

/// A bare QUIC connection, as yet without greeting.
pub async fn bare(
    addr: SocketAddr,
    identity: Option<&Identity>,
    alpn: &str,
) -> Result<Connection, ConnectionError> {
    bare_with(addr, bare_tls(identity, alpn, None)).await
}

/// Makes a bare QUIC connection with the given TLS.
pub async fn bare_with(addr: SocketAddr, tls: rustls::ClientConfig) -> Result<Connection, ConnectionError> {
    let config = quinn::ClientConfig::new(Arc::new(QuicClientConfig::try_from(tls).unwrap()));
    let endpoint = Endpoint::client("127.0.0.1:0".parse().unwrap()).unwrap();
    soon(endpoint.connect_with(config, addr, "x.invalid").unwrap()).await
}

pub fn frame(body: &[u8]) -> Vec<u8> {
    [&(body.len() as u32).to_be_bytes(), body].concat()
}

pub const GREETING: [u8; 6] = [0, 1, 0, 0, 0, 0];

/// A bare connection that has greeted, with its control stream, and the link at the listener.
pub async fn greeted(server: &mut Server, identity: &Identity) -> (Connection, quinn::SendStream, AnyLink) {
    let connection = bare(server.addr, Some(identity), "sgc/1").await.unwrap();
    greet(connection, server).await
}

/// Greets on a bare connection.
pub async fn greet(connection: Connection, server: &mut Server) -> (Connection, quinn::SendStream, AnyLink) {
    let (mut tx, mut rx) = soon(connection.open_bi()).await.unwrap();
    tx.write_all(&frame(&GREETING)).await.unwrap();
    let mut answer = [0; 10];
    soon(rx.read_exact(&mut answer)).await.unwrap();
    assert_eq!(answer[..], frame(&GREETING));
    (connection, tx, server.link().await)
}

/// A hello as a bare DTLS client sends it, each another.
pub fn hello(number: u32) -> Vec<u8> {
    let extensions: &[u8] = &[
        0, 10, 0, 4, 0, 2, 0, 23, // groups: P-256
        0, 11, 0, 2, 1, 0, // points: uncompressed
        0, 13, 0, 4, 0, 2, 4, 3, // signatures: ECDSA P-256
        0, 23, 0, 0, // extended master secret
    ];
    let mut body = vec![0xfe, 0xfd];
    body.extend((0..8).flat_map(|i| (number.wrapping_mul(2_654_435_761) ^ i).to_be_bytes()));
    body.extend([0, 0, 0, 2, 0xc0, 0x2b, 1, 0]);
    body.extend((extensions.len() as u16).to_be_bytes());
    body.extend(extensions);
    let len = body.len() as u8;
    let mut handshake = vec![1, 0, 0, len, 0, 0, 0, 0, 0, 0, 0, len];
    handshake.extend(body);
    let mut record = vec![22, 0xfe, 0xfd, 0, 0, 0, 0, 0, 0, 0, 0];
    record.extend((handshake.len() as u16).to_be_bytes());
    record.extend(handshake);
    record
}

/// Begins a DTLS handshake from this socket, proves its address by the received ticket, and stays silent.
pub fn prove_and_stall(socket: &std::net::UdpSocket, listener: SocketAddr, number: u32) {
    const CHALLENGE: u8 = 0xc2;
    const TICKET: u8 = 0xc3;
    socket.set_read_timeout(Some(Duration::from_secs(30))).unwrap();
    socket.send_to(&hello(number), listener).unwrap();
    let mut challenge = [0; 2048];
    let bytes = socket.recv(&mut challenge).unwrap();
    assert!(bytes > 17 && challenge[0] == CHALLENGE, "no challenge: {:?}", &challenge[..bytes]);
    let answer = [&[TICKET], &challenge[1..17], &hello(number)[..]].concat();
    socket.send_to(&answer, listener).unwrap();
}
