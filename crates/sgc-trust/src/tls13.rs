//! [`tls13_signatures`](crate::tls13_signatures): the methods that every verifier of certificates in TLS has in common.

/// Writes the three methods about signatures that rustls requires of a verifier of certificates.
///
/// Signatures are those of TLS 1.3 alone. The type needs a field `algorithms` of type
/// [`WebPkiSupportedAlgorithms`](rustls::crypto::WebPkiSupportedAlgorithms), and its crate the dependencies `rustls`
/// and `rustls-pki-types`.
#[macro_export]
macro_rules! tls13_signatures {
    () => {
        fn verify_tls12_signature(
            &self,
            _message: &[u8],
            _cert: &::rustls_pki_types::CertificateDer<'_>,
            _dss: &::rustls::DigitallySignedStruct,
        ) -> ::core::result::Result<::rustls::client::danger::HandshakeSignatureValid, ::rustls::Error> {
            ::core::result::Result::Err(::rustls::PeerIncompatible::Tls12NotOffered.into())
        }

        fn verify_tls13_signature(
            &self,
            message: &[u8],
            cert: &::rustls_pki_types::CertificateDer<'_>,
            dss: &::rustls::DigitallySignedStruct,
        ) -> ::core::result::Result<::rustls::client::danger::HandshakeSignatureValid, ::rustls::Error> {
            ::rustls::crypto::verify_tls13_signature(message, cert, dss, &self.algorithms)
        }

        fn supported_verify_schemes(&self) -> ::std::vec::Vec<::rustls::SignatureScheme> {
            self.algorithms.supported_schemes()
        }
    };
}
