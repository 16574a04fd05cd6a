//! The judgement over the peer's certificate inside of the TLS handshake, the same for dialers and listeners.
//!
//! Made anew for each connection, it keeps its verdict, so that the log can say in full what the TLS alert only
//! hints at. The server name is not compared: a URL says where a node is, its certificate says who it is, and
//! whoever uses the link judges by the latter.

use std::fmt;
use std::sync::{Arc, OnceLock};

use rustls::client::danger::{HandshakeSignatureValid, ServerCertVerified, ServerCertVerifier};
use rustls::crypto::{CryptoProvider, WebPkiSupportedAlgorithms};
use rustls::server::danger::{ClientCertVerified, ClientCertVerifier};
use rustls::server::{ClientHello, ResolvesServerCert};
use rustls::sign::CertifiedKey;
use rustls::{
    CertificateError, DigitallySignedStruct, DistinguishedName, Error, NamedGroup, PeerIncompatible,
    SignatureScheme,
};
use rustls_pki_types::{CertificateDer, ServerName, UnixTime};
use sgc_trust::{CertError, VerifiedPeer};
use sgc_wire::UnixMillis;

use crate::credentials::CredentialStore;

/// What a handshake found out about the peer.
#[derive(Debug, Default)]
pub(crate) struct Findings {
    /// Empty as long as no certificate came.
    verdict: OnceLock<Result<VerifiedPeer, CertError>>,
    /// Whether only post-quantum key exchanges are accepted.
    pub(crate) post_quantum: bool,
    /// Whether a dialer's groups hold one that is accepted here; empty as long as it offered none.
    offers_group: OnceLock<bool>,
}

impl Findings {
    /// Who the peer is, or why it is not believed.
    pub(crate) fn verdict(&self) -> Option<&Result<VerifiedPeer, CertError>> {
        self.verdict.get()
    }

    /// True if it was heard out and offers no key exchange that is accepted here.
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

    /// `attaches`: the peer came to a listener of this node.
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

/// Who shows this chain, leaf first, or why it is not believed now. `attaches`: the peer came to a listener of this node.
pub(crate) fn judge(
    credentials: &CredentialStore,
    chain: &[CertificateDer<'_>],
    now: UnixTime,
    attaches: bool,
) -> Result<VerifiedPeer, CertError> {
    // Read here and not when the handshake began: what was revoked since counts.
    let anchors = credentials.anchors();
    let peer = anchors.verify(chain, UnixMillis(now.as_secs().saturating_mul(1000)))?;
    if attaches && !credentials.admits(&peer) {
        return Err(CertError::NotAdmitted { ca: peer.ca });
    }
    Ok(peer)
}

/// Shows the listener's certificate, and notes what the dialer offers: an alert says nothing of it.
#[derive(Debug)]
pub(crate) struct Presenter {
    pub(crate) key: Arc<CertifiedKey>,
    pub(crate) accepted: Vec<NamedGroup>,
    pub(crate) findings: Arc<Findings>,
}

impl ResolvesServerCert for Presenter {
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

/// Rustls asks both of its verifiers for the same three things. Signatures are those of TLS 1.3, by the provider.
macro_rules! handshake_signatures {
    () => {
        fn verify_tls12_signature(
            &self,
            _message: &[u8],
            _cert: &CertificateDer<'_>,
            _dss: &DigitallySignedStruct,
        ) -> Result<HandshakeSignatureValid, Error> {
            Err(PeerIncompatible::Tls12NotOffered.into())
        }

        fn verify_tls13_signature(
            &self,
            message: &[u8],
            cert: &CertificateDer<'_>,
            dss: &DigitallySignedStruct,
        ) -> Result<HandshakeSignatureValid, Error> {
            rustls::crypto::verify_tls13_signature(message, cert, dss, &self.algorithms)
        }

        fn supported_verify_schemes(&self) -> Vec<SignatureScheme> {
            self.algorithms.supported_schemes()
        }
    };
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

    handshake_signatures!();
}

impl ClientCertVerifier for PeerVerifier {
    /// None: which CAs are trusted here is no one's business before they have shown a certificate.
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

    handshake_signatures!();
}

/// Believes whatever certificate, for TLS that only hides: what it carries is authenticated within.
#[derive(Debug)]
pub(crate) struct Anyone {
    algorithms: WebPkiSupportedAlgorithms,
}

impl Anyone {
    pub(crate) fn new(provider: &CryptoProvider) -> Self {
        Self { algorithms: provider.signature_verification_algorithms }
    }
}

impl ServerCertVerifier for Anyone {
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

    handshake_signatures!();
}

/// What the peer is told: the alert that fits, and no more.
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
