//! From a certificate chain to a verified peer: its node id, its groups and its signing key.
//!
//! The only way to a [`VerifiedPeer`] is [`TrustAnchors::verify`], so every [`VerifiedPeer`] is the result of a full
//! path validation. This module does not decide a peer's rights (the policy does) and reads no clock. No code looks at
//! host names: the certificate names the peer, wherever it is reached.

use std::collections::BTreeMap;
use std::fmt;
use std::sync::Arc;

use aws_lc_rs::digest;
use rustls_pki_types::{CertificateDer, SignatureVerificationAlgorithm, TrustAnchor, UnixTime};
use sgc_wire::{CERT_BYTES_MAX, CHAIN_CERTS_MAX, GroupTag, NodeId, Pseudonym, UnixMillis};
use webpki::{EndEntityCert, ExtendedKeyUsageValidator, KeyPurposeIdIter, aws_lc_rs as algs};

use crate::chains::{ChainHash, KnownChains};
use crate::revocations::CaLists;
use crate::x509::{Validity, names_certificate_signing, path_length, split_spki, without_zeros};

/// Most groups of one node: that many fit into [`CERT_BYTES_MAX`].
pub const GROUPS_MAX: usize = 32;
/// Most CAs that one node trusts.
pub const ANCHORS_MAX: usize = 64;

/// Prefix of every URI that SGC reads in certificates.
const SGC_URI: &str = "sgc:";
pub(crate) const NODE_URI: &str = "sgc:node:";
pub(crate) const GROUP_URI: &str = "sgc:group:";
/// URI in certificates of nodes that may carry others' names.
pub(crate) const ROUTER_URI: &str = "sgc:role:router";
/// URI in certificates of nodes that were enrolled again after a revocation; a certificate without it has incarnation
/// 0.
pub(crate) const INCARNATION_URI: &str = "sgc:incarnation:";

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

/// Signature algorithms of nodes for objects: one for each kind of key, so that a signature needs no algorithm field
/// that an attacker could change.
const OBJECT_ALGORITHMS: &[&dyn SignatureVerificationAlgorithm] = &[
    algs::ECDSA_P256_SHA256,
    algs::ECDSA_P384_SHA384,
    algs::ED25519,
    algs::RSA_PSS_2048_8192_SHA256_LEGACY_KEY,
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
        let peer = VerifiedPeer::from_leaf(&leaf, leaf_der, ca, certs)?;
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

/// A CA, by the SHA-256 of its public key (SubjectPublicKeyInfo, DER): renewing its certificate changes nothing.
#[derive(Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub struct CaFingerprint(pub [u8; 32]);

impl fmt::Display for CaFingerprint {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        self.0.iter().try_for_each(|byte| write!(f, "{byte:02x}"))
    }
}

impl fmt::Debug for CaFingerprint {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str("CaFingerprint(")?;
        self.0.iter().take(4).try_for_each(|byte| write!(f, "{byte:02x}"))?;
        f.write_str(")")
    }
}

/// One certificate in revocation lists: its CA and the serial number that the CA gave it.
#[derive(Clone, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub struct CertId {
    /// The CA that made it: an intermediate one, if there is one.
    pub ca: CaFingerprint,
    /// The serial number, big-endian, without leading zeros (RFC 5280, 4.1.2.2).
    pub serial: Arc<[u8]>,
    /// Node and incarnation, for a node's certificate.
    pub node: Option<NodeIncarnation>,
}

/// A node between two re-enrolments: all of its certificates are revoked together.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub struct NodeIncarnation {
    /// The node.
    pub pseudonym: Pseudonym,
    /// Grows when the node is enrolled again after a revocation, and not when it is renewed.
    pub incarnation: u32,
}

impl CertId {
    pub(crate) fn new(ca: CaFingerprint, serial: &[u8]) -> Self {
        Self { ca, serial: without_zeros(serial).into(), node: None }
    }
}

impl fmt::Debug for CertId {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "CertId({:?}, ", self.ca)?;
        self.serial.iter().take(4).try_for_each(|byte| write!(f, "{byte:02x}"))?;
        f.write_str(")")
    }
}

/// The node that a verified certificate chain speaks for. Cloning shares.
#[derive(Clone, Debug)]
pub struct VerifiedPeer {
    /// The node, also as owner of names.
    pub node_id: NodeId,
    /// The node's pseudonym in its certificate.
    pub pseudonym: Pseudonym,
    /// Number of times that it was enrolled again after a revocation.
    pub incarnation: u32,
    /// Its groups, sorted, each once.
    pub groups: Arc<[GroupTag]>,
    /// First moment at which its certificate is valid.
    pub not_before: UnixMillis,
    /// Last moment at which its certificate is valid.
    pub not_after: UnixMillis,
    /// The trusted CA at the end of its path.
    pub ca: CaFingerprint,
    /// Its certificate.
    pub cert: CertId,
    /// Whether its certificate lets it carry others' names (`sgc:role:router`).
    pub may_route: bool,
    /// All certificates of its path, from the one below the CA to its own.
    pub path: Arc<[CertId]>,
    key: Arc<[u8]>,
    algorithm: &'static dyn SignatureVerificationAlgorithm,
}

impl VerifiedPeer {
    /// Checks a signature that this peer made with [`crate::Identity::sign`] in the same context.
    pub fn verify_signature(
        &self,
        context: &str,
        message: &[u8],
        signature: &[u8],
    ) -> Result<(), SignatureError> {
        self.algorithm
            .verify_signature(&self.key, &signature_input(context, message), signature)
            .map_err(|_| SignatureError { signer: self.node_id })
    }

    /// Returns `true` if its certificate puts it into this group.
    pub fn is_in(&self, group: &GroupTag) -> bool {
        self.groups.binary_search(group).is_ok()
    }

    fn from_leaf(
        leaf: &EndEntityCert<'_>,
        der: &[u8],
        ca: &Anchor,
        mut path: Vec<CertId>,
    ) -> Result<Self, CertError> {
        let mut pseudonym = None;
        let mut incarnation = None;
        let mut groups = Vec::new();
        let mut may_route = false;
        // Unknown URIs are for later versions.
        for uri in leaf.valid_uri_names() {
            if let Some(hex) = uri.strip_prefix(NODE_URI) {
                let id = hex.parse::<Pseudonym>().map_err(|_| CertError::NoPseudonym)?;
                if pseudonym.replace(id).is_some() {
                    return Err(CertError::Malformed("it names two nodes".into()));
                }
            } else if let Some(hex) = uri.strip_prefix(GROUP_URI) {
                if groups.len() == GROUPS_MAX {
                    return Err(CertError::TooManyGroups);
                }
                let tag = hex.parse::<GroupTag>();
                groups.push(tag.map_err(|_| CertError::Malformed("a group tag is no hash".into()))?);
            } else if uri == ROUTER_URI {
                may_route = true;
            } else if let Some(number) = uri.strip_prefix(INCARNATION_URI)
                && incarnation.replace(read_incarnation(number)?).is_some()
            {
                return Err(CertError::Malformed("it names two incarnations".into()));
            }
        }
        groups.sort_unstable();
        groups.dedup();
        let pseudonym = pseudonym.ok_or(CertError::NoPseudonym)?;
        let incarnation = incarnation.unwrap_or(0);
        let cert = path.last_mut().ok_or(CertError::NoCertificate)?;
        cert.node = Some(NodeIncarnation { pseudonym, incarnation });
        let cert = cert.clone();
        let Validity { not_before, not_after } = Validity::from_certificate(der)
            .ok_or_else(|| CertError::Malformed("its validity cannot be read".into()))?;
        let spki = leaf.subject_public_key_info();
        let (algorithm_id, key) = split_spki(&spki).ok_or(CertError::KeyUnsupported)?;
        let algorithm = *OBJECT_ALGORITHMS
            .iter()
            .find(|a| a.public_key_alg_id().as_ref() == algorithm_id)
            .ok_or(CertError::KeyUnsupported)?;
        Ok(Self {
            node_id: node_id(&ca.spki, &pseudonym),
            pseudonym,
            incarnation,
            groups: groups.into(),
            not_before,
            not_after,
            ca: ca.fingerprint,
            cert,
            may_route,
            path: path.into(),
            key: key.into(),
            algorithm,
        })
    }
}

/// Parses an incarnation in certificates: decimal, from 1, in its shortest form.
fn read_incarnation(number: &str) -> Result<u32, CertError> {
    let read = number.parse::<u32>().ok().filter(|n| *n > 0 && n.to_string() == number);
    read.ok_or_else(|| CertError::Malformed("its incarnation is no number from 1 on".into()))
}

/// Returns `SHA-256(CA public key ‖ pseudonym)`, the CA's key as DER SubjectPublicKeyInfo (`docs/spec/names.md`).
pub fn node_id(ca_spki: &[u8], pseudonym: &Pseudonym) -> NodeId {
    NodeId(sha256(&[ca_spki, pseudonym.as_bytes()]))
}

/// Returns the signed bytes: the context keeps a signature for one purpose from passing for another.
pub(crate) fn signature_input(context: &str, message: &[u8]) -> Vec<u8> {
    let mut input = Vec::with_capacity(context.len() + 1 + message.len());
    input.extend_from_slice(context.as_bytes());
    input.push(0);
    input.extend_from_slice(message);
    input
}

pub(crate) fn sha256(parts: &[&[u8]]) -> [u8; 32] {
    let mut context = digest::Context::new(&digest::SHA256);
    parts.iter().for_each(|part| context.update(part));
    let mut out = [0; 32];
    out.copy_from_slice(context.finish().as_ref());
    out
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

/// A signature that its alleged signer did not make over this message in this context.
#[derive(Clone, Copy, Debug, PartialEq, Eq, thiserror::Error)]
#[error("the signature is not one of node {} over this message", signer.short())]
pub struct SignatureError {
    /// The alleged signer.
    pub signer: NodeId,
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

    fn from_webpki(error: webpki::Error) -> Self {
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
