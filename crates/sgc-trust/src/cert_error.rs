//! [`CertError`]: the reason why a certificate chain is refused.

use rustls_pki_types::UnixTime;
use sgc_wire::{CERT_BYTES_MAX, CHAIN_CERTS_MAX, UnixMillis};

use crate::cert_id::CaFingerprint;
use crate::label::GROUPS_MAX;

/// The reason why a certificate chain is refused.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
pub enum CertError {
    /// No certificate came.
    #[error("no certificate was presented: the peer needs an identity (`sgc fleet enroll`)")]
    NoCertificate,
    /// Too many certificates came.
    #[error("the chain has {certificates} certificates, at most {CHAIN_CERTS_MAX} are read")]
    ChainTooLong {
        /// Their number.
        certificates: usize,
    },
    /// A certificate is too long.
    #[error("a certificate has {bytes} bytes, at most {CERT_BYTES_MAX} are read")]
    CertificateTooLong {
        /// Its length.
        bytes: usize,
    },
    /// A certificate cannot be read as X.509.
    #[error("the certificate cannot be used: {0}")]
    Malformed(String),
    /// The leaf does not name its node.
    #[error(
        "the certificate names no SGC node (URI sgc:node:…): make it with `sgc fleet enroll`, or have its CA sign the \
         request of `sgc fleet request` with the extensions that `sgc fleet extensions` writes"
    )]
    NoPseudonym,
    /// A certificate names a node and may sign certificates.
    #[error(
        "a node's certificate is that of a CA as well (basic constraints, or key usage keyCertSign), and could make any \
         node: its CA has to sign the request again with the extensions that `sgc fleet extensions` writes"
    )]
    NodeIsCa,
    /// The path has more intermediate CAs than the trusted one permits.
    #[error(
        "there are {intermediates} CAs between the certificate and the trusted CA, which permits fewer (path length)"
    )]
    PathTooLong {
        /// Certificates between the leaf and the trusted CA.
        intermediates: usize,
    },
    /// The leaf names too many groups.
    #[error("the certificate names more than {GROUPS_MAX} groups")]
    TooManyGroups,
    /// The key is of a kind that nodes do not sign with.
    #[error("the certificate's key is not supported: P-256, P-384, Ed25519 and RSA are")]
    KeyUnsupported,
    /// The certificate is for another purpose.
    #[error("the certificate is for neither clients nor servers (extended key usage)")]
    WrongUsage,
    /// No CA that is trusted here made the certificate.
    #[error("the certificate is from a CA that is not trusted here: is the peer of another fleet?")]
    UnknownIssuer,
    /// The CA is trusted here, but its nodes may not attach.
    #[error(
        "the certificate is from CA {ca}, which is not among those whose nodes may attach here: add that CA's file to \
         `accept` in [router], or leave it out if this is as it should be"
    )]
    NotAdmitted {
        /// The CA.
        ca: CaFingerprint,
    },
    /// The certificate names a trusted CA, which did not sign it.
    #[error("the certificate's signature is wrong: it was altered or forged")]
    BadSignature,
    /// The certificate has expired.
    #[error(
        "the certificate expired at {not_after} and the clock here says {now}: enroll again, or set the clock"
    )]
    Expired {
        /// Its end.
        not_after: UnixMillis,
        /// The time of the check.
        now: UnixMillis,
    },
    /// The certificate is not yet valid.
    #[error("the certificate begins at {not_before} and the clock here says {now}: which clock is wrong?")]
    NotYetValid {
        /// Its beginning.
        not_before: UnixMillis,
        /// The time of the check.
        now: UnixMillis,
    },
    /// The CA revoked the certificate.
    #[error(
        "the certificate was revoked by its CA at {at}: if that is a mistake, the keeper of the fleet has to enroll \
         the node again"
    )]
    Revoked {
        /// Time of the revocation, as the CA gives it.
        at: UnixMillis,
    },
    /// The CA's own certificate has expired.
    #[error("the fleet's CA expired at {not_after} and the clock here says {now}")]
    CaExpired {
        /// Its end.
        not_after: UnixMillis,
        /// The time of the check.
        now: UnixMillis,
    },
}

impl CertError {
    /// Returns `true` if the certificate, or its CA's, is not valid at the time of the check.
    pub fn is_expiry(&self) -> bool {
        matches!(self, Self::Expired { .. } | Self::NotYetValid { .. } | Self::CaExpired { .. })
    }

    pub(crate) fn from_webpki(error: webpki::Error) -> Self {
        use webpki::Error as E;
        let millis = |t: UnixTime| UnixMillis(t.as_secs().saturating_mul(1000));
        match error {
            E::CertExpired { time, not_after } => {
                Self::Expired { not_after: millis(not_after), now: millis(time) }
            }
            E::CertNotValidYet { time, not_before } => {
                Self::NotYetValid { not_before: millis(not_before), now: millis(time) }
            }
            E::UnknownIssuer => Self::UnknownIssuer,
            E::InvalidSignatureForPublicKey => Self::BadSignature,
            E::CaUsedAsEndEntity => Self::NodeIsCa,
            E::EmptyEkuExtension | E::RequiredEkuNotFoundContext(_) => Self::WrongUsage,
            other => Self::Malformed(other.to_string()),
        }
    }
}
