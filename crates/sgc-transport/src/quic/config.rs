//! The settings of QUIC; those of the TLS inside are in [`crate::tls`].

use std::sync::Arc;
use std::time::Duration;

use aws_lc_rs::{hmac, rand};
use quinn::crypto::rustls::{QuicClientConfig, QuicServerConfig};
use quinn::{
    ConnectionId, ConnectionIdGenerator, EndpointConfig, IdleTimeout, MtuDiscoveryConfig, TransportConfig,
    VarInt,
};

use super::clear::Clear;
use super::places;
use crate::budget::WindowLease;
use crate::congestion::Gate;
use crate::credentials::CredentialStore;
use crate::options::LinkOptions;
use crate::tls::{self, Findings};

/// The layer below QUIC, and whether its packets can be read. Each has an application protocol (RFC 7301) of its own,
/// so that none passes for another.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Flavor {
    /// Plain QUIC.
    Quic,
    /// Inside of DTLS.
    Dtls,
    /// Plain QUIC with packets that are authenticated and not encrypted.
    Udp,
}

impl Flavor {
    /// Returns the application protocol of version 1.
    fn alpn(self) -> &'static [u8] {
        match self {
            Self::Quic => b"sgc/1",
            Self::Dtls => b"sgc-dtls/1",
            Self::Udp => b"sgc-udp/1",
        }
    }
}

/// Most bytes that are kept of one peer before its handshake is worked on.
const INCOMING_BYTES_MAX: u64 = 64 << 10;
/// Most bytes that are kept of all peers together before their handshakes are worked on.
const INCOMING_BYTES_TOTAL_MAX: u64 = 8 << 20;
/// Packets that may overtake one before it counts as lost: the network reorders.
const PACKET_THRESHOLD: u32 = 16;
/// Assumed round trip before the first was seen: it sets the time after which a first packet is sent again.
const INITIAL_RTT: Duration = Duration::from_millis(150);
/// Longest QUIC packet inside of DTLS, bytes. With records, ids, UDP and IPv6 around it, it fits 1420 bytes, the MTU of
/// a WireGuard tunnel. MTU discovery starts at 1200, which fits 1280, and does not begin with this length: a packet
/// that does not fit is lost with its other content, and so quinn never sees that its length was the cause.
const DTLS_MTU: u16 = 1340;
const RESET_DOMAIN: &[u8] = b"sgc stateless reset v1";
const CONNECTION_ID_BYTES: usize = 8;

/// The state of one connection besides its settings.
pub(crate) struct Parts {
    pub(crate) findings: Arc<Findings>,
    pub(crate) gate: Arc<Gate>,
    /// Receive window of the connection, from its handshake on.
    pub(crate) lease: WindowLease,
}

/// Returns the settings of one connection that both sides share, and its gate.
pub(crate) fn transport(
    flavor: Flavor,
    options: &LinkOptions,
    lease: &WindowLease,
) -> (Arc<TransportConfig>, Arc<Gate>) {
    let millis = |d: Duration| VarInt::from_u32(u32::try_from(d.as_millis()).unwrap_or(u32::MAX));
    let mut config = TransportConfig::default();
    config
        // The control stream, opened by the dialer; listeners open none.
        .max_concurrent_bidi_streams(VarInt::from_u32(1))
        .max_concurrent_uni_streams(VarInt::from_u32(places::at_first(options.flows_max)))
        .max_idle_timeout(Some(IdleTimeout::from(millis(options.idle_timeout))))
        .keep_alive_interval(Some(options.keep_alive))
        .receive_window(VarInt::from_u32(lease.link_bytes()))
        .stream_receive_window(VarInt::from_u32(lease.flow_bytes(options.flow_window_bytes)))
        .send_window(options.send_window_bytes.into())
        .packet_threshold(PACKET_THRESHOLD)
        .initial_rtt(INITIAL_RTT)
        .datagram_send_buffer_size(options.datagram_send_bytes)
        .datagram_receive_buffer_size(Some(options.datagram_receive_bytes));
    config.enable_segmentation_offload(options.offload);
    let mut discovery = MtuDiscoveryConfig::default();
    if flavor == Flavor::Dtls {
        discovery.upper_bound(DTLS_MTU);
    }
    config.mtu_discovery_config(options.mtu_discovery.then_some(discovery));
    let (controllers, gate) = options.congestion.for_connection();
    config.congestion_controller_factory(controllers);
    (Arc::new(config), gate)
}

/// Returns the settings of one incoming connection, with a verdict of its own.
pub(super) fn server(
    flavor: Flavor,
    credentials: &CredentialStore,
    options: &LinkOptions,
) -> (quinn::ServerConfig, Parts) {
    let (tls, findings) = tls::server(credentials, options, flavor.alpn());
    let crypto =
        QuicServerConfig::try_from(tls).expect("the provider has the cipher suite of QUIC's first packets");
    let crypto: Arc<dyn quinn::crypto::ServerConfig> = match flavor {
        Flavor::Quic | Flavor::Dtls => Arc::new(crypto),
        Flavor::Udp => Arc::new(Clear(Arc::new(crypto))),
    };
    let mut config = quinn::ServerConfig::with_crypto(crypto);
    let lease = options.receive_budget.lease(options.receive_window_bytes);
    let (transport, gate) = transport(flavor, options, &lease);
    config.transport_config(transport);
    // Retry makes its own tokens; tokens for later connections are not worth their state.
    config.validation_token.sent(0);
    (config, Parts { findings, gate, lease })
}

/// Returns the settings of the listening endpoint itself.
pub(super) fn listener(
    flavor: Flavor,
    credentials: &CredentialStore,
    options: &LinkOptions,
) -> quinn::ServerConfig {
    let (mut config, ..) = server(flavor, credentials, options);
    config
        .max_incoming(options.handshakes_max)
        .incoming_buffer_size(INCOMING_BYTES_MAX)
        .incoming_buffer_size_total(INCOMING_BYTES_TOTAL_MAX);
    config
}

/// Returns the settings of one outgoing connection, with a verdict of its own.
pub(crate) fn client(
    flavor: Flavor,
    credentials: &CredentialStore,
    options: &LinkOptions,
) -> (quinn::ClientConfig, Parts) {
    let (tls, findings) = tls::client(credentials, options, flavor.alpn());
    let crypto =
        QuicClientConfig::try_from(tls).expect("the provider has the cipher suite of QUIC's first packets");
    let crypto: Arc<dyn quinn::crypto::ClientConfig> = match flavor {
        Flavor::Quic | Flavor::Dtls => Arc::new(crypto),
        Flavor::Udp => Arc::new(Clear(Arc::new(crypto))),
    };
    let mut config = quinn::ClientConfig::new(crypto);
    let lease = options.receive_budget.lease(options.receive_window_bytes);
    let (transport, gate) = transport(flavor, options, &lease);
    config.transport_config(transport);
    config.token_store(Arc::new(quinn::NoneTokenStore));
    (config, Parts { findings, gate, lease })
}

/// Returns the settings of a listener's socket. With the identity's reset key, peers of a listener that was killed and
/// restarted on the same port learn it from the first packet that they send (RFC 9000, 10.3), instead of by a time-out.
/// The port is part of the derivation, so that two listeners of one identity cannot be used against each other (21.11).
pub(crate) fn endpoint(flavor: Flavor, reset_key: Option<&[u8; 32]>, port: u16) -> EndpointConfig {
    let mut config = match reset_key {
        None => EndpointConfig::default(),
        Some(key) => {
            let key = hmac::Key::new(hmac::HMAC_SHA256, key);
            let derived = hmac::sign(&key, &[RESET_DOMAIN, &port.to_be_bytes()].concat());
            let mut config =
                EndpointConfig::new(Arc::new(hmac::Key::new(hmac::HMAC_SHA256, derived.as_ref())));
            config.cid_generator(|| Box::new(RandomIds));
            config
        }
    };
    // Inside of DTLS the bit tells packets from other messages.
    config.grease_quic_bit(flavor != Flavor::Dtls);
    config
}

/// Random connection ids that carry nothing, not even their maker. Only the run of a program that made quinn's own ids
/// recognises them, and leaves packets with others unanswered, so the next run would stay silent.
struct RandomIds;

impl ConnectionIdGenerator for RandomIds {
    fn generate_cid(&mut self) -> ConnectionId {
        let mut id = [0; CONNECTION_ID_BYTES];
        rand::fill(&mut id).expect("the system has random numbers, or TLS had not started either");
        ConnectionId::new(&id)
    }

    fn cid_len(&self) -> usize {
        CONNECTION_ID_BYTES
    }

    fn cid_lifetime(&self) -> Option<Duration> {
        None
    }
}
