//! Which certificates their CAs have taken back: X.509 revocation lists (RFC 5280, 5).
//!
//! A list is believed if a trusted CA signed it, whoever brought it, and replaces the one known of that CA if its
//! number is greater. A list whose time is over still counts: what it revokes stays revoked, and what it does not
//! name is believed. Whoever keeps newer lists from a node can so delay a revocation, and not undo one; refusing
//! everybody instead would stop a fleet whose keeper is away. It reads no clock and stores no file.

use std::collections::BTreeMap;
use std::sync::Arc;

use bytes::Bytes;
use sgc_wire::{CRL_BYTES_MAX, UnixMillis};
use webpki::BorrowedCertRevocationList;

use crate::signed::CLOCK_SKEW_MAX;
use crate::verify::{Anchor, CHAIN_ALGORITHMS, CaFingerprint, CertId, TrustAnchors, VerifiedPeer};
use crate::x509::{ListFields, may_sign_lists, split_spki, without_zeros};

/// A verified list of one CA.
#[derive(Clone)]
pub(crate) struct RevocationList {
    der: Bytes,
    /// Big-endian, without leading zeros.
    number: Box<[u8]>,
    /// Serial numbers without leading zeros, and since when.
    revoked: Arc<BTreeMap<Box<[u8]>, UnixMillis>>,
}

impl TrustAnchors {
    /// With one more list, if it verifies and is newer than the one known of its CA. `Ok(None)`: it is not newer.
    pub fn with_crl(&self, der: &[u8], now: UnixMillis) -> Result<Option<Self>, CrlError> {
        if self.crls().any(|known| known == der) {
            return Ok(None);
        }
        let (ca, list) = self.verify_list(der, now)?;
        if self.lists.get(&ca).is_some_and(|known| !is_greater(&list.number, &known.number)) {
            return Ok(None);
        }
        let mut lists = BTreeMap::clone(&self.lists);
        lists.insert(ca, list);
        Ok(Some(self.with_lists(Arc::new(lists))))
    }

    /// The same CAs, with the lists in force elsewhere of those of them that are known there, where they are newer.
    pub fn with_lists_of(&self, known: &Self) -> Self {
        let mut lists = BTreeMap::clone(&self.lists);
        let here = |ca: &CaFingerprint| self.ca_spki(ca).is_some();
        for (ca, list) in known.lists.iter().filter(|(ca, _)| here(ca)) {
            if lists.get(ca).is_none_or(|own| is_greater(&list.number, &own.number)) {
                lists.insert(*ca, list.clone());
            }
        }
        self.with_lists(Arc::new(lists))
    }

    /// The lists in force, DER, to be passed on; one for each CA at most.
    pub fn crls(&self) -> impl Iterator<Item = &Bytes> {
        self.lists.values().map(|list| &list.der)
    }

    /// The same, each with its CA.
    pub fn crls_by_ca(&self) -> impl Iterator<Item = (&CaFingerprint, &Bytes)> {
        self.lists.iter().map(|(ca, list)| (ca, &list.der))
    }

    /// True if this very certificate is revoked. A certificate below an intermediate CA is over also when the
    /// intermediate's is: see [`TrustAnchors::is_peer_revoked`].
    pub fn is_revoked(&self, cert: &CertId) -> bool {
        self.revoked_at(cert).is_some()
    }

    /// True if a certificate on the path to this peer is revoked.
    pub fn is_peer_revoked(&self, peer: &VerifiedPeer) -> bool {
        peer.path.iter().any(|cert| self.is_revoked(cert))
    }

    /// True if the key of the first CA made this signature, with any algorithm that it has.
    pub(crate) fn signed_by_first(&self, message: &[u8], signature: &[u8]) -> bool {
        let Some((key_algorithm, key)) = self.anchors.first().and_then(|a| split_spki(&a.spki)) else {
            return false;
        };
        let mut fitting = CHAIN_ALGORITHMS.iter().filter(|a| a.public_key_alg_id().as_ref() == key_algorithm);
        fitting.any(|a| a.verify_signature(key, message, signature).is_ok())
    }

    pub(crate) fn revoked_at(&self, cert: &CertId) -> Option<UnixMillis> {
        self.lists.get(&cert.ca)?.revoked.get(&*cert.serial).copied()
    }

    fn verify_list(&self, der: &[u8], now: UnixMillis) -> Result<(CaFingerprint, RevocationList), CrlError> {
        if der.len() > CRL_BYTES_MAX {
            return Err(CrlError::TooLong { bytes: der.len() });
        }
        // Webpki checks the form as a whole: versions, critical extensions, that both algorithms are the same.
        let list = BorrowedCertRevocationList::from_der(der).map_err(CrlError::from_webpki)?;
        let fields =
            ListFields::of(der).ok_or_else(|| CrlError::Malformed("its fields cannot be read".into()))?;
        if fields.is_scoped {
            return Err(CrlError::Partial);
        }
        let number = fields.number.ok_or(CrlError::NoNumber)?;
        let named = self.anchors.iter().zip(self.paths.iter());
        let mut named = named.filter(|(_, path)| *path.subject == *fields.issuer).peekable();
        if named.peek().is_none() {
            return Err(CrlError::UnknownIssuer);
        }
        // Several CAs may have one name; the signature tells whose list it is.
        let (anchor, _) = named.find(|(anchor, _)| anchor.signed(&fields)).ok_or(CrlError::BadSignature)?;
        if may_sign_lists(&anchor.der) != Some(true) {
            return Err(CrlError::NotAListSigner);
        }
        if fields.this_update.0 > now.0.saturating_add(CLOCK_SKEW_MAX.as_millis() as u64) {
            return Err(CrlError::NotYetValid { this_update: fields.this_update, now });
        }
        let mut revoked = BTreeMap::new();
        for entry in &list {
            let entry = entry.map_err(CrlError::from_webpki)?;
            let at = UnixMillis(entry.revocation_date.as_secs().saturating_mul(1000));
            revoked.insert(without_zeros(entry.serial_number).into(), at);
        }
        let list = RevocationList {
            der: Bytes::copy_from_slice(der),
            number: number.into(),
            revoked: Arc::new(revoked),
        };
        Ok((anchor.fingerprint, list))
    }
}

impl Anchor {
    /// True if this CA's key made the signature of the list.
    fn signed(&self, list: &ListFields<'_>) -> bool {
        let Some((key_algorithm, key)) = split_spki(&self.spki) else { return false };
        CHAIN_ALGORITHMS
            .iter()
            .filter(|a| a.signature_alg_id().as_ref() == list.algorithm)
            .filter(|a| a.public_key_alg_id().as_ref() == key_algorithm)
            .any(|a| a.verify_signature(key, list.tbs, list.signature).is_ok())
    }
}

fn is_greater(number: &[u8], than: &[u8]) -> bool {
    (number.len(), number) > (than.len(), than)
}

/// Why a revocation list is not believed.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
pub enum CrlError {
    /// It is too long.
    #[error("the revocation list has {bytes} bytes, at most {CRL_BYTES_MAX} are read")]
    TooLong {
        /// Its length.
        bytes: usize,
    },
    /// It is not the X.509 that we read.
    #[error("the revocation list cannot be read: {0}")]
    Malformed(String),
    /// It speaks of some certificates of its CA only, or of those of others.
    #[error(
        "the revocation list is a partial one (delta, indirect, or with an issuing distribution point): have the CA \
         write a full one"
    )]
    Partial,
    /// It has no number, so that nobody can tell which of two is newer.
    #[error("the revocation list has no CRL number: have the CA write one with it (RFC 5280, 5.2.3)")]
    NoNumber,
    /// No CA that is trusted here made it.
    #[error("the revocation list is from a CA that is not trusted here")]
    UnknownIssuer,
    /// It says that a trusted CA made it, and none did.
    #[error("the revocation list's signature is wrong: it was altered or forged")]
    BadSignature,
    /// Its CA's certificate has a key usage without cRLSign.
    #[error("the CA's certificate does not let it sign revocation lists (key usage cRLSign)")]
    NotAListSigner,
    /// It is from the future.
    #[error(
        "the revocation list begins at {this_update} and the clock here says {now}: which clock is wrong?"
    )]
    NotYetValid {
        /// Its beginning.
        this_update: UnixMillis,
        /// The time of the check.
        now: UnixMillis,
    },
}

impl CrlError {
    fn from_webpki(error: webpki::Error) -> Self {
        use webpki::Error as E;
        match error {
            E::UnsupportedDeltaCrl
            | E::UnsupportedIndirectCrl
            | E::UnsupportedCrlIssuingDistributionPoint
            | E::UnsupportedRevocationReasonsPartitioning => Self::Partial,
            other => Self::Malformed(other.to_string()),
        }
    }
}
