//! The settings of QUIC and TLS. One place for every number and every choice that security depends on.

use std::sync::{Arc, LazyLock};
use std::time::Duration;

use aws_lc_rs::{hmac, rand};
use quinn::crypto::rustls::{QuicClientConfig, QuicServerConfig};
use quinn::{ConnectionId, ConnectionIdGenerator, EndpointConfig, IdleTimeout, TransportConfig, VarInt};
use rustls::crypto::aws_lc_rs::kx_group;
use rustls::crypto::{CryptoProvider, SupportedKxGroup};
use rustls::server::NoServerSessionStorage;
use rustls::sign::SingleCertAndKey;

use super::verifier::{Findings, PeerVerifier, Presenter};
use crate::credentials::CredentialStore;
use crate::options::LinkOptions;

static CLASSICAL: LazyLock<Arc<CryptoProvider>> =
    LazyLock::new(|| provider_with(vec![kx_group::X25519, kx_group::X25519MLKEM768]));
static POST_QUANTUM: LazyLock<Arc<CryptoProvider>> =
    LazyLock::new(|| provider_with(vec![kx_group::X25519MLKEM768]));

/// The application protocol (RFC 7301) of version 1.
const ALPN: &[u8] = b"sgc/1";
/// Most bytes that are kept of one peer before its handshake is worked on.
const INCOMING_BYTES_MAX: u64 = 64 << 10;
/// The same for all peers together.
const INCOMING_BYTES_TOTAL_MAX: u64 = 8 << 20;
const RESET_DOMAIN: &[u8] = b"sgc stateless reset v1";
const CONNECTION_ID_BYTES: usize = 8;

fn provider_with(kx_groups: Vec<&'static dyn SupportedKxGroup>) -> Arc<CryptoProvider> {
    Arc::new(CryptoProvider { kx_groups, ..rustls::crypto::aws_lc_rs::default_provider() })
}

/// A node that does not require post-quantum key exchange still has it, second: so a fleet can be switched node by node,
/// and one that has not been reached yet is not locked out by those that have.
fn provider(post_quantum: bool) -> &'static Arc<CryptoProvider> {
    if post_quantum { &POST_QUANTUM } else { &CLASSICAL }
}

/// Everything that belongs to neither side's handshake.
pub(super) fn transport(options: &LinkOptions) -> Arc<TransportConfig> {
    let millis = |d: Duration| VarInt::from_u32(u32::try_from(d.as_millis()).unwrap_or(u32::MAX));
    let mut config = TransportConfig::default();
    config
        // The control stream, opened by the dialer; listeners open none.
        .max_concurrent_bidi_streams(VarInt::from_u32(1))
        .max_concurrent_uni_streams(VarInt::from_u32(options.flows_max))
        .max_idle_timeout(Some(IdleTimeout::from(millis(options.idle_timeout))))
        .keep_alive_interval(Some(options.keep_alive))
        .receive_window(VarInt::from_u32(options.receive_window_bytes))
        .stream_receive_window(VarInt::from_u32(options.flow_window_bytes))
        .send_window(options.send_window_bytes.into())
        .datagram_send_buffer_size(options.datagram_send_bytes)
        .datagram_receive_buffer_size(Some(options.datagram_receive_bytes));
    if let Some(factory) = &options.congestion {
        config.congestion_controller_factory(Arc::clone(factory));
    }
    Arc::new(config)
}

/// For one incoming connection, with a verdict of its own.
pub(super) fn server(
    credentials: &CredentialStore,
    options: &LinkOptions,
    transport: &Arc<TransportConfig>,
) -> (quinn::ServerConfig, Arc<Findings>) {
    let identity = credentials.identity();
    let post_quantum = options.post_quantum || identity.post_quantum();
    let provider = provider(post_quantum);
    let (verifier, findings) = PeerVerifier::new(credentials, provider, post_quantum);
    let presenter = Presenter {
        key: identity.certified_key(),
        accepted: provider.kx_groups.iter().map(|g| g.name()).collect(),
        findings: Arc::clone(&findings),
    };
    let mut tls = rustls::ServerConfig::builder_with_provider(Arc::clone(provider))
        .with_protocol_versions(&[&rustls::version::TLS13])
        .expect("the provider has cipher suites of TLS 1.3")
        .with_client_cert_verifier(verifier)
        .with_cert_resolver(Arc::new(presenter));
    tls.alpn_protocols = vec![ALPN.to_vec()];
    // A resumed session would skip the certificate, and with it expiry and revocation.
    tls.session_storage = Arc::new(NoServerSessionStorage {});
    tls.send_tls13_tickets = 0;
    tls.max_early_data_size = 0;
    let crypto =
        QuicServerConfig::try_from(tls).expect("the provider has the cipher suite of QUIC's first packets");
    let mut config = quinn::ServerConfig::with_crypto(Arc::new(crypto));
    config.transport_config(Arc::clone(transport));
    // Retry makes its own tokens; those for later connections are not worth their state.
    config.validation_token.sent(0);
    (config, findings)
}

/// For the listening endpoint itself.
pub(super) fn listener(
    credentials: &CredentialStore,
    options: &LinkOptions,
    transport: &Arc<TransportConfig>,
) -> quinn::ServerConfig {
    let (mut config, _) = server(credentials, options, transport);
    config
        .max_incoming(options.handshakes_max)
        .incoming_buffer_size(INCOMING_BYTES_MAX)
        .incoming_buffer_size_total(INCOMING_BYTES_TOTAL_MAX);
    config
}

/// For one outgoing connection, with a verdict of its own.
pub(super) fn client(
    credentials: &CredentialStore,
    options: &LinkOptions,
    transport: &Arc<TransportConfig>,
) -> (quinn::ClientConfig, Arc<Findings>) {
    let identity = credentials.identity();
    let post_quantum = options.post_quantum || identity.post_quantum();
    let provider = provider(post_quantum);
    let (verifier, findings) = PeerVerifier::new(credentials, provider, post_quantum);
    let key = identity.certified_key();
    let mut tls = rustls::ClientConfig::builder_with_provider(Arc::clone(provider))
        .with_protocol_versions(&[&rustls::version::TLS13])
        .expect("the provider has cipher suites of TLS 1.3")
        .dangerous()
        .with_custom_certificate_verifier(verifier)
        .with_client_cert_resolver(Arc::new(SingleCertAndKey::from(key)));
    tls.alpn_protocols = vec![ALPN.to_vec()];
    tls.resumption = rustls::client::Resumption::disabled();
    tls.enable_early_data = false;
    // No one routes by it, and it would tell the network where a node thinks it is going.
    tls.enable_sni = false;
    let crypto =
        QuicClientConfig::try_from(tls).expect("the provider has the cipher suite of QUIC's first packets");
    let mut config = quinn::ClientConfig::new(Arc::new(crypto));
    config.transport_config(Arc::clone(transport));
    config.token_store(Arc::new(quinn::NoneTokenStore));
    (config, findings)
}

/// For the socket of a listener. With the identity's reset key, peers of a listener that was killed and started again on
/// the same port learn it from the first packet that they send (RFC 9000, 10.3), instead of by a time-out. The port is
/// part of the derivation, so that two listeners of one identity cannot be used against each other (21.11).
pub(super) fn endpoint(reset_key: Option<&[u8; 32]>, port: u16) -> EndpointConfig {
    let Some(key) = reset_key else { return EndpointConfig::default() };
    let key = hmac::Key::new(hmac::HMAC_SHA256, key);
    let derived = hmac::sign(&key, &[RESET_DOMAIN, &port.to_be_bytes()].concat());
    let mut config = EndpointConfig::new(Arc::new(hmac::Key::new(hmac::HMAC_SHA256, derived.as_ref())));
    config.cid_generator(|| Box::new(RandomIds));
    config
}

/// Connection ids that say nothing, also not by whom they were made: quinn's own are recognised only by the run of a
/// program that made them, and packets with others are not answered, so the next run would keep silent.
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
