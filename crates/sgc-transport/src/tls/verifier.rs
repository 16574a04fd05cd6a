//! Judgement of the peer's certificate inside of the TLS handshake, the same for dialers and listeners.
//!
//! Each connection has a verifier, which keeps its verdict, so that the log can say in full what the TLS alert only
//! hints at. The server name is not compared: a URL says where a node is, its certificate says which node it is, and
//! users of the link judge by the certificate.

use std::fmt;
use std::sync::{Arc, OnceLock};

use rustls::client::danger::{ServerCertVerified, ServerCertVerifier};
use rustls::crypto::{CryptoProvider, WebPkiSupportedAlgorithms};
use rustls::server::danger::{ClientCertVerified, ClientCertVerifier};
use rustls::server::{ClientHello, ResolvesServerCert};
use rustls::sign::CertifiedKey;
use rustls::{CertificateError, DistinguishedName, Error, NamedGroup};
use rustls_pki_types::{CertificateDer, ServerName, UnixTime};
use sgc_trust::{CertError, VerifiedPeer, tls13_signatures};
use sgc_wire::UnixMillis;

use crate::credentials::CredentialStore;

/// A handshake's findings about the peer.
#[derive(Debug, Default)]
pub(crate) struct Findings {
    /// Empty until a certificate came.
    verdict: OnceLock<Result<VerifiedPeer, CertError>>,
    /// Whether only post-quantum key exchanges are accepted.
    pub(crate) post_quantum: bool,
    /// Whether a dialer's groups include an accepted one; empty until it offered some.
    offers_group: OnceLock<bool>,
}

impl Findings {
    /// Returns the peer, or the reason why its certificate is not believed.
    pub(crate) fn verdict(&self) -> Option<&Result<VerifiedPeer, CertError>> {
        self.verdict.get()
    }

    /// Returns `true` if the dialer has sent its groups and none of them is accepted here.
    pub(crate) fn lacks_key_exchange(&self) -> bool {
        self.offers_group.get() == Some(&false)
    }
}

pub(crate) struct PeerVerifier {
    credentials: CredentialStore,
    algorithms: WebPkiSupportedAlgorithms,
    findings: Arc<Findings>,
}

impl PeerVerifier {
    pub(crate) fn new(
        credentials: &CredentialStore,
        provider: &CryptoProvider,
        post_quantum: bool,
    ) -> (Arc<Self>, Arc<Findings>) {
        let (credentials, findings) =
            (credentials.clone(), Arc::new(Findings { post_quantum, ..Findings::default() }));
        let algorithms = provider.signature_verification_algorithms;
        (Arc::new(Self { credentials, algorithms, findings: Arc::clone(&findings) }), findings)
    }

    /// Judges the chain. `attaches`: the peer came to a listener of this node.
    fn judge(
        &self,
        leaf: &CertificateDer<'_>,
        intermediates: &[CertificateDer<'_>],
        now: UnixTime,
        attaches: bool,
    ) -> Result<(), Error> {
        let chain: Vec<CertificateDer<'_>> = std::iter::once(leaf).chain(intermediates).cloned().collect();
        let result = judge(&self.credentials, &chain, now, attaches);
        let answer = result.as_ref().map(drop).map_err(|e| Error::InvalidCertificate(alert(e)));
        // The first verdict stands: a handshake asks once.
        let _ = self.findings.verdict.set(result);
        answer
    }
}

/// Returns the node of this chain, leaf first, or the reason why it is not believed now. `attaches`: the peer came to a
/// listener of this node.
pub(crate) fn judge(
    credentials: &CredentialStore,
    chain: &[CertificateDer<'_>],
    now: UnixTime,
    attaches: bool,
) -> Result<VerifiedPeer, CertError> {
    // Read here and not when the handshake began, so that revocations since then count.
    let anchors = credentials.anchors();
    let peer = anchors.verify(chain, UnixMillis(now.as_secs().saturating_mul(1000)))?;
    if attaches && !credentials.admits(&peer) {
        return Err(CertError::NotAdmitted { ca: peer.ca });
    }
    Ok(peer)
}

/// Shows the listener's certificate, and notes the dialer's groups, because an alert does not tell them.
#[derive(Debug)]
pub(crate) struct ListenerCertResolver {
    pub(crate) key: Arc<CertifiedKey>,
    pub(crate) accepted: Vec<NamedGroup>,
    pub(crate) findings: Arc<Findings>,
}

impl ResolvesServerCert for ListenerCertResolver {
    fn resolve(&self, hello: ClientHello<'_>) -> Option<Arc<CertifiedKey>> {
        if let Some(offered) = hello.named_groups() {
            let _ = self.findings.offers_group.set(offered.iter().any(|g| self.accepted.contains(g)));
        }
        Some(Arc::clone(&self.key))
    }
}

impl fmt::Debug for PeerVerifier {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_tuple("PeerVerifier").field(&self.credentials).finish()
    }
}

impl ServerCertVerifier for PeerVerifier {
    fn verify_server_cert(
        &self,
        end_entity: &CertificateDer<'_>,
        intermediates: &[CertificateDer<'_>],
        _server_name: &ServerName<'_>,
        _ocsp_response: &[u8],
        now: UnixTime,
    ) -> Result<ServerCertVerified, Error> {
        self.judge(end_entity, intermediates, now, false).map(|()| ServerCertVerified::assertion())
    }

    tls13_signatures!();
}

impl ClientCertVerifier for PeerVerifier {
    /// Empty: peers do not learn which CAs are trusted here before they have shown a certificate.
    fn root_hint_subjects(&self) -> &[DistinguishedName] {
        &[]
    }

    fn verify_client_cert(
        &self,
        end_entity: &CertificateDer<'_>,
        intermediates: &[CertificateDer<'_>],
        now: UnixTime,
    ) -> Result<ClientCertVerified, Error> {
        self.judge(end_entity, intermediates, now, true).map(|()| ClientCertVerified::assertion())
    }

    tls13_signatures!();
}

/// Accepts any certificate, for TLS that only hides: the nodes authenticate each other within it.
#[derive(Debug)]
pub(crate) struct AcceptAnyCertificate {
    algorithms: WebPkiSupportedAlgorithms,
}

impl AcceptAnyCertificate {
    pub(crate) fn new(provider: &CryptoProvider) -> Self {
        Self { algorithms: provider.signature_verification_algorithms }
    }
}

impl ServerCertVerifier for AcceptAnyCertificate {
    fn verify_server_cert(
        &self,
        _end_entity: &CertificateDer<'_>,
        _intermediates: &[CertificateDer<'_>],
        _server_name: &ServerName<'_>,
        _ocsp_response: &[u8],
        _now: UnixTime,
    ) -> Result<ServerCertVerified, Error> {
        Ok(ServerCertVerified::assertion())
    }

    tls13_signatures!();
}

/// Returns the alert for the peer, and no more than that.
pub(crate) fn alert(error: &CertError) -> CertificateError {
    match error {
        CertError::UnknownIssuer => CertificateError::UnknownIssuer,
        CertError::NotAdmitted { .. } => CertificateError::ApplicationVerificationFailure,
        CertError::Revoked { .. } => CertificateError::Revoked,
        CertError::BadSignature => CertificateError::BadSignature,
        CertError::Expired { .. } | CertError::CaExpired { .. } => CertificateError::Expired,
        CertError::NotYetValid { .. } => CertificateError::NotValidYet,
        CertError::WrongUsage
        | CertError::NoPseudonym
        | CertError::KeyUnsupported
        | CertError::NodeIsCa
        | CertError::PathTooLong { .. } => CertificateError::InvalidPurpose,
        CertError::NoCertificate
        | CertError::ChainTooLong { .. }
        | CertError::CertificateTooLong { .. }
        | CertError::Malformed(_)
        | CertError::TooManyGroups => CertificateError::BadEncoding,
    }
}
