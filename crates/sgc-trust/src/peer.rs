//! [`VerifiedPeer`]: the node of a verified certificate chain, and the check of its signatures.

use std::sync::Arc;
use std::time::Duration;

use rustls_pki_types::SignatureVerificationAlgorithm;
use sgc_wire::{GroupTag, NodeId, Pseudonym, UnixMillis};
use webpki::{EndEntityCert, aws_lc_rs as algs};

use crate::cert_error::CertError;
use crate::cert_id::{CaFingerprint, CertId, NodeIncarnation, sha256};
use crate::label::GROUPS_MAX;
use crate::x509::{Validity, split_spki};

pub(crate) const NODE_URI: &str = "sgc:node:";
pub(crate) const GROUP_URI: &str = "sgc:group:";
/// URI in certificates of nodes that may carry others' names.
pub(crate) const ROUTER_URI: &str = "sgc:role:router";
/// URI in certificates of nodes that were enrolled again after a revocation; a certificate without it has incarnation
/// 0.
pub(crate) const INCARNATION_URI: &str = "sgc:incarnation:";
/// URI in certificates of invitations, followed by the validity in seconds of the certificate to which it entitles.
pub(crate) const INVITATION_URI: &str = "sgc:invitation:";

/// Signature algorithms of nodes for objects: one for each kind of key, so that a signature needs no algorithm field
/// that an attacker could change.
const OBJECT_ALGORITHMS: &[&dyn SignatureVerificationAlgorithm] = &[
    algs::ECDSA_P256_SHA256,
    algs::ECDSA_P384_SHA384,
    algs::ED25519,
    algs::RSA_PSS_2048_8192_SHA256_LEGACY_KEY,
];

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
    /// `Some` if the certificate is that of an invitation: its holder may ask the authority for the identity of the
    /// invited node, and may do nothing else. The certificate of that node is valid for this time.
    pub invitation: Option<Duration>,
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

    /// Reads a certificate whose path was validated.
    pub(crate) fn from_leaf(
        leaf: &EndEntityCert<'_>,
        der: &[u8],
        (ca, ca_spki): (CaFingerprint, &[u8]),
        mut path: Vec<CertId>,
    ) -> Result<Self, CertError> {
        let mut pseudonym = None;
        let mut incarnation = None;
        let mut groups = Vec::new();
        let mut may_route = false;
        let mut invitation = None;
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
            } else if let Some(number) = uri.strip_prefix(INCARNATION_URI) {
                let number = read_number(number)
                    .ok_or_else(|| CertError::Malformed("its incarnation is no number from 1 on".into()))?;
                if incarnation.replace(number).is_some() {
                    return Err(CertError::Malformed("it names two incarnations".into()));
                }
            } else if let Some(secs) = uri.strip_prefix(INVITATION_URI) {
                let secs = read_number(secs)
                    .ok_or_else(|| CertError::Malformed("its invitation is no number from 1 on".into()))?;
                if invitation.replace(Duration::from_secs(secs.into())).is_some() {
                    return Err(CertError::Malformed("it is two invitations".into()));
                }
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
            node_id: node_id(ca_spki, &pseudonym),
            pseudonym,
            incarnation,
            groups: groups.into(),
            not_before,
            not_after,
            ca,
            cert,
            may_route,
            invitation,
            path: path.into(),
            key: key.into(),
            algorithm,
        })
    }
}

/// Parses a number in certificates: decimal, from 1, in its shortest form.
fn read_number(number: &str) -> Option<u32> {
    number.parse::<u32>().ok().filter(|n| *n > 0 && n.to_string() == number)
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

/// A signature that its alleged signer did not make over this message in this context.
#[derive(Clone, Copy, Debug, PartialEq, Eq, thiserror::Error)]
#[error("the signature is not one of node {} over this message", signer.short())]
pub struct SignatureError {
    /// The alleged signer.
    pub signer: NodeId,
}
