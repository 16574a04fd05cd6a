//! TLS 1.3 as every transport uses it: both ends show certificates, nothing is resumed, nothing is sent early.

mod verifier;

use std::sync::{Arc, LazyLock};

use rustls::crypto::aws_lc_rs::kx_group;
use rustls::crypto::{CryptoProvider, SupportedKxGroup};
use rustls::server::NoServerSessionStorage;
use rustls::sign::SingleCertAndKey;

use crate::credentials::CredentialStore;
use crate::options::LinkOptions;
pub(crate) use verifier::Findings;
use verifier::{AcceptAnyCertificate, ListenerCertResolver, PeerVerifier};
#[cfg(feature = "dtls")]
pub(crate) use verifier::{alert, judge};

/// Application protocol that web proxies expect in TLS.
const HTTP_ALPN: &[u8] = b"http/1.1";

static CLASSICAL: LazyLock<Arc<CryptoProvider>> =
    LazyLock::new(|| provider_with(vec![kx_group::X25519, kx_group::X25519MLKEM768]));
static POST_QUANTUM: LazyLock<Arc<CryptoProvider>> =
    LazyLock::new(|| provider_with(vec![kx_group::X25519MLKEM768]));

fn provider_with(kx_groups: Vec<&'static dyn SupportedKxGroup>) -> Arc<CryptoProvider> {
    Arc::new(CryptoProvider { kx_groups, ..rustls::crypto::aws_lc_rs::default_provider() })
}

/// A node that does not require post-quantum key exchange still offers it, second: so a fleet can be switched node by
/// node, and switched nodes do not lock out the others.
fn provider(post_quantum: bool) -> &'static Arc<CryptoProvider> {
    if post_quantum { &POST_QUANTUM } else { &CLASSICAL }
}

/// Returns the configuration for one incoming connection with this application protocol (RFC 7301), with a verdict of
/// its own.
pub(crate) fn server(
    credentials: &CredentialStore,
    options: &LinkOptions,
    alpn: &[u8],
) -> (rustls::ServerConfig, Arc<Findings>) {
    let identity = credentials.identity();
    let post_quantum = options.post_quantum || identity.post_quantum();
    let provider = provider(post_quantum);
    let (verifier, findings) = PeerVerifier::new(credentials, provider, post_quantum);
    let presenter = ListenerCertResolver {
        key: identity.certified_key(),
        accepted: provider.kx_groups.iter().map(|g| g.name()).collect(),
        findings: Arc::clone(&findings),
    };
    let mut tls = rustls::ServerConfig::builder_with_provider(Arc::clone(provider))
        .with_protocol_versions(&[&rustls::version::TLS13])
        .expect("the provider has cipher suites of TLS 1.3")
        .with_client_cert_verifier(verifier)
        .with_cert_resolver(Arc::new(presenter));
    tls.alpn_protocols = vec![alpn.to_vec()];
    // A resumed session would skip the certificate, and with it expiry and revocation.
    tls.session_storage = Arc::new(NoServerSessionStorage {});
    tls.send_tls13_tickets = 0;
    tls.max_early_data_size = 0;
    (tls, findings)
}

/// Returns the configuration for one outgoing connection with this application protocol, with a verdict of its own.
pub(crate) fn client(
    credentials: &CredentialStore,
    options: &LinkOptions,
    alpn: &[u8],
) -> (rustls::ClientConfig, Arc<Findings>) {
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
    tls.alpn_protocols = vec![alpn.to_vec()];
    tls.resumption = rustls::client::Resumption::disabled();
    tls.enable_early_data = false;
    // No node routes by the server name, and it would reveal the dialled node to the network.
    tls.enable_sni = false;
    (tls, findings)
}

/// Returns the configuration for the TLS around WebSocket, which a web proxy may end in this node's place. It hides the
/// traffic from onlookers and proves nothing to either end.
pub(crate) fn outer_server(credentials: &CredentialStore) -> rustls::ServerConfig {
    let key = SingleCertAndKey::from(credentials.identity().certified_key());
    let mut tls = rustls::ServerConfig::builder_with_provider(Arc::clone(&CLASSICAL))
        .with_protocol_versions(&[&rustls::version::TLS13])
        .expect("the provider has cipher suites of TLS 1.3")
        .with_no_client_auth()
        .with_cert_resolver(Arc::new(key));
    tls.alpn_protocols = vec![HTTP_ALPN.to_vec()];
    tls.session_storage = Arc::new(NoServerSessionStorage {});
    tls.send_tls13_tickets = 0;
    tls
}

/// Returns the configuration for the other end of [`outer_server`], or of a web proxy's. It authenticates nobody,
/// because the nodes' own TLS is within. It names the host, because web proxies choose by the name.
pub(crate) fn outer_client() -> rustls::ClientConfig {
    let mut tls = rustls::ClientConfig::builder_with_provider(Arc::clone(&CLASSICAL))
        .with_protocol_versions(&[&rustls::version::TLS13])
        .expect("the provider has cipher suites of TLS 1.3")
        .dangerous()
        .with_custom_certificate_verifier(Arc::new(AcceptAnyCertificate::new(&CLASSICAL)))
        .with_no_client_auth();
    tls.alpn_protocols = vec![HTTP_ALPN.to_vec()];
    tls.resumption = rustls::client::Resumption::disabled();
    tls
}
