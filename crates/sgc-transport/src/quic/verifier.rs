//! The judgement over the peer's certificate inside of the TLS handshake, the same for dialers and listeners.
//!
//! Made anew for each connection, it keeps its verdict, so that the log can say in full what the TLS alert only
//! hints at. The server name is not compared: a URL says where a node is, its certificate says who it is, and
//! whoever uses the link judges by the latter.

use std::fmt;
use std::sync::{Arc, OnceLock};

use rustls::client::danger::{HandshakeSignatureValid, ServerCertVerified, ServerCertVerifier};
use rustls::crypto::WebPkiSupportedAlgorithms;
use rustls::server::danger::{ClientCertVerified, ClientCertVerifier};
use rustls::{
    CertificateError, DigitallySignedStruct, DistinguishedName, Error, PeerIncompatible, SignatureScheme,
};
use rustls_pki_types::{CertificateDer, ServerName, UnixTime};
use sgc_trust::{CertError, TrustAnchors, VerifiedPeer};
use sgc_wire::UnixMillis;

use super::config::PROVIDER;

/// What was found of the peer; empty as long as no certificate came.
pub(super) type Verdict = Arc<OnceLock<Result<VerifiedPeer, CertError>>>;

pub(super) struct PeerVerifier {
    anchors: TrustAnchors,
    algorithms: WebPkiSupportedAlgorithms,
    verdict: Verdict,
}

impl PeerVerifier {
    pub(super) fn new(anchors: &TrustAnchors) -> (Arc<Self>, Verdict) {
        let verdict = Verdict::default();
        let algorithms = PROVIDER.signature_verification_algorithms;
        (Arc::new(Self { anchors: anchors.clone(), algorithms, verdict: Arc::clone(&verdict) }), verdict)
    }

    fn judge(
        &self,
        leaf: &CertificateDer<'_>,
        intermediates: &[CertificateDer<'_>],
        now: UnixTime,
    ) -> Result<(), Error> {
        let chain: Vec<CertificateDer<'_>> = std::iter::once(leaf).chain(intermediates).cloned().collect();
        let result = self.anchors.verify(&chain, UnixMillis(now.as_secs().saturating_mul(1000)));
        let answer = result.as_ref().map(drop).map_err(|e| Error::InvalidCertificate(alert(e)));
        // The first verdict stands: a handshake asks once.
        let _ = self.verdict.set(result);
        answer
    }
}

impl fmt::Debug for PeerVerifier {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_tuple("PeerVerifier").field(&self.anchors).finish()
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
        self.judge(end_entity, intermediates, now).map(|()| ServerCertVerified::assertion())
    }

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
        self.judge(end_entity, intermediates, now).map(|()| ClientCertVerified::assertion())
    }

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
}

/// What the peer is told: the alert that fits, and no more.
fn alert(error: &CertError) -> CertificateError {
    match error {
        CertError::UnknownIssuer => CertificateError::UnknownIssuer,
        CertError::BadSignature => CertificateError::BadSignature,
        CertError::Expired { .. } | CertError::CaExpired { .. } => CertificateError::Expired,
        CertError::NotYetValid { .. } => CertificateError::NotValidYet,
        CertError::WrongUsage | CertError::NoPseudonym | CertError::KeyUnsupported => {
            CertificateError::InvalidPurpose
        }
        CertError::NoCertificate
        | CertError::ChainTooLong { .. }
        | CertError::CertificateTooLong { .. }
        | CertError::Malformed(_)
        | CertError::TooManyGroups => CertificateError::BadEncoding,
    }
}
