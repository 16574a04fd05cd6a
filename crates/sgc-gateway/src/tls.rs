//! TLS of the gateway: its certificates, and the request for client certificates.
//!
//! A client that asks for the server name [`NODE_SERVER_NAME`] is shown the node's certificate, which members of the
//! fleet verify by their CA. All others are shown the certificate for programs.
//!
//! Client certificates belong to fleets. [`sgc_trust::TrustAnchors`] verifies them after the handshake has proven
//! that the client has the key.

use std::fmt;
use std::sync::Arc;

use rustls::crypto::{CryptoProvider, WebPkiSupportedAlgorithms};
use rustls::server::danger::{ClientCertVerified, ClientCertVerifier};
use rustls::server::{ClientHello, ResolvesServerCert};
use rustls::sign::CertifiedKey;
use rustls::{DistinguishedName, Error, ServerConfig};
use rustls_pki_types::pem::PemObject as _;
use rustls_pki_types::{CertificateDer, PrivateKeyDer, UnixTime};

/// The server name (SNI) by which a client asks for the certificate of the node. The name is reserved (RFC 2606), so it
/// names no host.
pub const NODE_SERVER_NAME: &str = "node.sgc.invalid";

/// The certificates of a gateway with their keys.
#[derive(Clone)]
pub struct TlsKeys {
    /// The certificate that clients are shown.
    pub shown: Arc<CertifiedKey>,
    /// The certificate for clients that ask for [`NODE_SERVER_NAME`]; without it, they are shown the other.
    pub node: Option<Arc<CertifiedKey>>,
}

impl From<Arc<CertifiedKey>> for TlsKeys {
    fn from(shown: Arc<CertifiedKey>) -> Self {
        Self { shown, node: None }
    }
}

/// The reason why a certificate and key cannot be used.
#[derive(Debug, thiserror::Error)]
pub enum TlsError {
    /// The certificate is not PEM.
    #[error("the certificate is not PEM: {0}")]
    Certificate(rustls_pki_types::pem::Error),
    /// The file contains no certificate.
    #[error("there is no certificate in it")]
    NoCertificate,
    /// The key is not PEM.
    #[error("the private key is not PEM: {0}")]
    Key(rustls_pki_types::pem::Error),
    /// The certificate and key do not match, or TLS does not support them.
    #[error("the certificate and its key cannot be used: {0}")]
    Unusable(Error),
}

fn provider() -> Arc<CryptoProvider> {
    Arc::new(rustls::crypto::aws_lc_rs::default_provider())
}

/// Parses a certificate with its chain and its key from PEM texts.
pub fn certified_key(certificate: &[u8], key: &[u8]) -> Result<Arc<CertifiedKey>, TlsError> {
    let chain: Vec<CertificateDer<'static>> = CertificateDer::pem_slice_iter(certificate)
        .collect::<Result<_, _>>()
        .map_err(TlsError::Certificate)?;
    if chain.is_empty() {
        return Err(TlsError::NoCertificate);
    }
    let key = PrivateKeyDer::from_pem_slice(key).map_err(TlsError::Key)?;
    CertifiedKey::from_der(chain, key, &provider()).map(Arc::new).map_err(TlsError::Unusable)
}

/// Creates a configuration of TLS 1.3 with these certificates. `asks` requests a client certificate.
pub(crate) fn server_config(
    keys: &TlsKeys,
    asks: bool,
    protocols: &[&[u8]],
) -> Result<Arc<ServerConfig>, TlsError> {
    let provider = provider();
    let algorithms = provider.signature_verification_algorithms;
    let builder = ServerConfig::builder_with_provider(provider)
        .with_protocol_versions(&[&rustls::version::TLS13])
        .map_err(TlsError::Unusable)?;
    let builder = if asks {
        builder.with_client_cert_verifier(Arc::new(KeyProofVerifier { algorithms }))
    } else {
        builder.with_no_client_auth()
    };
    let mut config = builder.with_cert_resolver(Arc::new(KeysBySni(keys.clone())));
    config.alpn_protocols = protocols.iter().map(|protocol| protocol.to_vec()).collect();
    Ok(Arc::new(config))
}

/// A resolver that returns the node's certificate for its server name, and the other for every other name or none.
struct KeysBySni(TlsKeys);

impl fmt::Debug for KeysBySni {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_tuple("KeysBySni").finish_non_exhaustive()
    }
}

impl ResolvesServerCert for KeysBySni {
    fn resolve(&self, hello: ClientHello<'_>) -> Option<Arc<CertifiedKey>> {
        let TlsKeys { shown, node } = &self.0;
        let wants_node = hello.server_name().is_some_and(|name| name.eq_ignore_ascii_case(NODE_SERVER_NAME));
        Some(Arc::clone(node.as_ref().filter(|_| wants_node).unwrap_or(shown)))
    }
}

/// A verifier that makes a client prove possession of the key of its certificate, if it shows one.
#[derive(Debug)]
struct KeyProofVerifier {
    algorithms: WebPkiSupportedAlgorithms,
}

impl ClientCertVerifier for KeyProofVerifier {
    fn client_auth_mandatory(&self) -> bool {
        false
    }

    fn root_hint_subjects(&self) -> &[DistinguishedName] {
        &[]
    }

    fn verify_client_cert(
        &self,
        _end_entity: &CertificateDer<'_>,
        _intermediates: &[CertificateDer<'_>],
        _now: UnixTime,
    ) -> Result<ClientCertVerified, Error> {
        Ok(ClientCertVerified::assertion())
    }

    sgc_trust::tls13_signatures!();
}
