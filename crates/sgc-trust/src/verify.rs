//! From a certificate chain to a verified peer: its node id, its groups and its signing key.
//!
//! The only way to a [`VerifiedPeer`] is [`TrustAnchors::verify`], so every [`VerifiedPeer`] is the result of a full
//! path validation. This module does not decide a peer's rights (the policy does) and reads no clock. No code looks at
//! host names: the certificate names the peer, wherever it is reached.

use std::collections::BTreeMap;
use std::fmt;
use std::sync::Arc;

use rustls_pki_types::{CertificateDer, SignatureVerificationAlgorithm, TrustAnchor, UnixTime};
use sgc_wire::{CERT_BYTES_MAX, CHAIN_CERTS_MAX, UnixMillis};
use webpki::{EndEntityCert, ExtendedKeyUsageValidator, KeyPurposeIdIter, aws_lc_rs as algs};

use crate::cert_error::CertError;
use crate::cert_id::{CaFingerprint, CertId, sha256};
use crate::chains::{ChainHash, KnownChains};
use crate::peer::VerifiedPeer;
use crate::revocations::CaLists;
use crate::x509::{Validity, names_certificate_signing, path_length};

/// Most CAs that one node trusts.
pub const ANCHORS_MAX: usize = 64;

/// Prefix of every URI that SGC reads in certificates.
const SGC_URI: &str = "sgc:";
/// Signature algorithms of certificates and revocation lists.
pub(crate) const CHAIN_ALGORITHMS: &[&dyn SignatureVerificationAlgorithm] = &[
    algs::ECDSA_P256_SHA256,
    algs::ECDSA_P256_SHA384,
    algs::ECDSA_P384_SHA256,
    algs::ECDSA_P384_SHA384,
    algs::ED25519,
    algs::RSA_PSS_2048_8192_SHA256_LEGACY_KEY,
    algs::RSA_PSS_2048_8192_SHA384_LEGACY_KEY,
    algs::RSA_PSS_2048_8192_SHA512_LEGACY_KEY,
    algs::RSA_PKCS1_2048_8192_SHA256,
    algs::RSA_PKCS1_2048_8192_SHA384,
    algs::RSA_PKCS1_2048_8192_SHA512,
];

/// The trusted CAs, and the revocations of each. Cloning shares.
#[derive(Clone)]
pub struct TrustAnchors {
    pub(crate) anchors: Arc<[Anchor]>,
    /// The same CAs in the form of path building.
    pub(crate) paths: Arc<[TrustAnchor<'static>]>,
    /// Revocation lists by the CA that signed them.
    pub(crate) lists: Arc<BTreeMap<CaFingerprint, CaLists>>,
    /// Chains that were verified with these CAs and lists, and with no others.
    pub(crate) chains: Arc<KnownChains>,
}

pub(crate) struct Anchor {
    pub(crate) der: CertificateDer<'static>,
    pub(crate) spki: Box<[u8]>,
    pub(crate) fingerprint: CaFingerprint,
    pub(crate) validity: Validity,
    /// Most intermediate CAs below the CA, if it limits them.
    path_length: Option<usize>,
}

impl TrustAnchors {
    /// Trusts the holders of these CA certificates; at least one, at most [`ANCHORS_MAX`].
    pub fn new(certificates: impl IntoIterator<Item = CertificateDer<'static>>) -> Result<Self, AnchorError> {
        let mut anchors = Vec::new();
        let mut paths = Vec::new();
        for (index, der) in certificates.into_iter().enumerate() {
            if index == ANCHORS_MAX {
                return Err(AnchorError::TooMany);
            }
            let (anchor, path) =
                Anchor::parse(der).map_err(|reason| AnchorError::Malformed { index, reason })?;
            anchors.push(anchor);
            paths.push(path);
        }
        if anchors.is_empty() {
            return Err(AnchorError::None);
        }
        let (lists, chains) = (Arc::default(), Arc::default());
        Ok(Self { anchors: anchors.into(), paths: paths.into(), lists, chains })
    }

    /// Returns these anchors with more CAs, such as a partner's; known ones are not added twice. Revocation lists stay.
    pub fn with_anchors(
        &self,
        more: impl IntoIterator<Item = CertificateDer<'static>>,
    ) -> Result<Self, AnchorError> {
        let mut certificates: Vec<_> = self.certificates().cloned().collect();
        for certificate in more {
            if !certificates.contains(&certificate) {
                certificates.push(certificate);
            }
        }
        Ok(Self::new(certificates)?.with_lists(Arc::clone(&self.lists)))
    }

    /// Returns the same CAs with these lists.
    pub(crate) fn with_lists(&self, lists: Arc<BTreeMap<CaFingerprint, CaLists>>) -> Self {
        let (anchors, paths) = (Arc::clone(&self.anchors), Arc::clone(&self.paths));
        Self { anchors, paths, lists, chains: Arc::default() }
    }

    /// Verifies a chain, leaf first, at the time `now`: path to one of the CAs, signatures, validity, key usage,
    /// that no certificate of it is revoked, and that the leaf names a node of SGC.
    pub fn verify(&self, chain: &[CertificateDer<'_>], now: UnixMillis) -> Result<VerifiedPeer, CertError> {
        let (leaf_der, intermediates) = chain.split_first().ok_or(CertError::NoCertificate)?;
        if chain.len() > CHAIN_CERTS_MAX {
            return Err(CertError::ChainTooLong { certificates: chain.len() });
        }
        if let Some(long) = chain.iter().find(|c| c.len() > CERT_BYTES_MAX) {
            return Err(CertError::CertificateTooLong { bytes: long.len() });
        }
        let hash = ChainHash::from_chain(chain);
        if let Some(peer) = self.chains.find(&hash, now) {
            return Ok(peer);
        }
        let leaf = EndEntityCert::try_from(leaf_der).map_err(CertError::from_webpki)?;
        let time = UnixTime::since_unix_epoch(std::time::Duration::from_secs(now.secs()));
        let path = leaf
            .verify_for_usage(CHAIN_ALGORITHMS, &self.paths, intermediates, time, PeerUsage, None, None)
            .map_err(CertError::from_webpki)?;
        let ca = self
            .paths
            .iter()
            .position(|a| std::ptr::eq(a, path.anchor()))
            .and_then(|index| self.anchors.get(index))
            .ok_or(CertError::UnknownIssuer)?;
        ca.check_validity(now)?;
        // From the CA down: each certificate by the key that made it.
        let mut issuer = ca.fingerprint;
        let mut certs = Vec::with_capacity(chain.len());
        let mut between: Vec<_> = path.intermediate_certificates().collect();
        between.reverse();
        // Path validation ignores the path length of a trusted CA.
        if ca.path_length.is_some_and(|most| between.len() > most) {
            return Err(CertError::PathTooLong { intermediates: between.len() });
        }
        if names_certificate_signing(leaf_der) != Some(false)
            || between.iter().any(|c| c.valid_uri_names().any(|uri| uri.starts_with(SGC_URI)))
        {
            return Err(CertError::NodeIsCa);
        }
        for certificate in between {
            certs.push(CertId::new(issuer, certificate.serial()));
            issuer = CaFingerprint(sha256(&[&certificate.subject_public_key_info()]));
        }
        certs.push(CertId::new(issuer, leaf.serial()));
        // With certificates that its path does not need, one chain could be varied without end.
        let is_minimal = certs.len() == chain.len();
        let peer = VerifiedPeer::from_leaf(&leaf, leaf_der, (ca.fingerprint, &ca.spki), certs)?;
        if let Some(at) = self.path_revoked_at(&peer.path) {
            return Err(CertError::Revoked { at });
        }
        if is_minimal && let Some(validity) = ca.validity_with(chain) {
            self.chains.remember(hash, peer.clone(), validity);
        }
        Ok(peer)
    }

    /// Returns the CA certificates, DER.
    pub fn certificates(&self) -> impl Iterator<Item = &CertificateDer<'static>> {
        self.anchors.iter().map(|a| &a.der)
    }

    /// Returns the fingerprints of the CAs, in the order of [`TrustAnchors::certificates`].
    pub fn fingerprints(&self) -> impl Iterator<Item = CaFingerprint> {
        self.anchors.iter().map(|a| a.fingerprint)
    }

    /// Returns the public key (SubjectPublicKeyInfo, DER) of a trusted CA.
    pub fn ca_spki(&self, ca: &CaFingerprint) -> Option<&[u8]> {
        self.anchors.iter().find(|a| a.fingerprint == *ca).map(|a| &*a.spki)
    }
}

impl fmt::Debug for TrustAnchors {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_list().entries(self.anchors.iter().map(|a| a.fingerprint)).finish()
    }
}

impl Anchor {
    fn parse(der: CertificateDer<'static>) -> Result<(Self, TrustAnchor<'static>), String> {
        if der.len() > CERT_BYTES_MAX {
            return Err(format!("{} bytes, at most {CERT_BYTES_MAX} are read", der.len()));
        }
        let reason = |e: webpki::Error| e.to_string();
        let path = webpki::anchor_from_trusted_cert(&der).map_err(reason)?.to_owned();
        let spki: Box<[u8]> =
            EndEntityCert::try_from(&der).map_err(reason)?.subject_public_key_info().as_ref().into();
        let validity = Validity::from_certificate(&der).ok_or("its validity cannot be read")?;
        let path_length = path_length(&der).ok_or("its path length cannot be read")?;
        let fingerprint = CaFingerprint(sha256(&[&spki]));
        Ok((Self { der, spki, fingerprint, validity, path_length }, path))
    }

    /// Returns the time in which this CA and all of these certificates are valid.
    fn validity_with(&self, chain: &[CertificateDer<'_>]) -> Option<Validity> {
        chain.iter().try_fold(self.validity, |all, certificate| {
            Some(all.overlap(Validity::from_certificate(certificate)?))
        })
    }

    /// Checks that the CA has not expired: path validation does not check it.
    fn check_validity(&self, now: UnixMillis) -> Result<(), CertError> {
        let Validity { not_before, not_after } = self.validity;
        if now.secs() > not_after.secs() {
            Err(CertError::CaExpired { not_after, now })
        } else if now < not_before {
            Err(CertError::NotYetValid { not_before, now })
        } else {
            Ok(())
        }
    }
}

/// The key usages of nodes. They dial and are dialled with one certificate, so either usage will do; a certificate for
/// other purposes, such as signing mail, will not.
struct PeerUsage;

impl ExtendedKeyUsageValidator for PeerUsage {
    fn validate(&self, purposes: KeyPurposeIdIter<'_, '_>) -> Result<(), webpki::Error> {
        let mut names_any = false;
        for purpose in purposes {
            let oid = purpose?.to_decoded_oid();
            if oid == webpki::KeyUsage::SERVER_AUTH_REPR || oid == webpki::KeyUsage::CLIENT_AUTH_REPR {
                return Ok(());
            }
            names_any = true;
        }
        // Webpki calls this also where the extension is absent, which restricts nothing.
        if names_any { Err(webpki::Error::EmptyEkuExtension) } else { Ok(()) }
    }
}

/// The reason why CA certificates cannot be trusted as given.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
pub enum AnchorError {
    /// No certificate.
    #[error("no CA certificate is given: at least one is needed")]
    None,
    /// Too many certificates.
    #[error("more than {ANCHORS_MAX} CA certificates are given")]
    TooMany,
    /// A certificate that cannot be read.
    #[error("CA certificate {} cannot be read: {reason}", index + 1)]
    Malformed {
        /// Its index, from 0.
        index: usize,
        /// The parser's error.
        reason: String,
    },
}
