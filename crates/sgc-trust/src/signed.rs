//! Signed bodies of the control protocol, which count only after verification.
//!
//! Each body has a signing context of its own, so that none can pass for another. Bodies that carry a certificate chain
//! also carry the time of signing, which must be near the verifier's: minutes of skew work, days do not.

use std::time::Duration;

use bytes::Bytes;
use rustls_pki_types::CertificateDer;
use sgc_wire::{
    AdvertBody, AnswerBody, Decode, DecodeError, Encode, JoinBody, LinkStateBody, Name, RefuseReason,
    RejectReason, SignedBody, UnixMillis,
};

use crate::{CertError, Identity, SignatureError, TrustAnchors, VerifiedPeer, name_of};

/// Largest difference between a signer's and the verifier's clock.
pub const CLOCK_SKEW_MAX: Duration = Duration::from_secs(10 * 60);
/// Largest lead of a sequence number, which counts milliseconds, over the time of signing: ten years, more than any
/// clock that was once wrong. Without a bound, one number would leave its node no greater one.
pub const SEQ_AHEAD_MAX: Duration = Duration::from_secs(10 * 365 * 86_400);

const ADVERT: &str = "sgc advert v1";
const JOIN: &str = "sgc join v1";
const ANSWER: &str = "sgc answer v1";
const LINK_STATE: &str = "sgc link state v1";

/// The reason why a signed body is not believed.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
pub enum SignedError {
    /// The body is malformed.
    #[error("malformed: {0}")]
    Decode(#[from] DecodeError),
    /// The signer's certificate does not verify.
    #[error("signer not verified: {0}")]
    Cert(#[from] CertError),
    /// The signature does not verify.
    #[error("{0}")]
    Signature(#[from] SignatureError),
    /// Signer and verifier disagree on the time by more than [`CLOCK_SKEW_MAX`].
    #[error("signed at {signed}, which is not near {now}: one of the two clocks is wrong, or it is a replay")]
    Clock {
        /// Time in the body.
        signed: UnixMillis,
        /// The verifier's time.
        now: UnixMillis,
    },
    /// The signer only holds an invitation: it owns no names and has no place in the mesh.
    #[error("its signer only holds an invitation to the fleet")]
    Invited,
    /// The sequence number is ahead of the time of signing by more than [`SEQ_AHEAD_MAX`].
    #[error("sequence number {seq} is too far ahead of {signed}, when it was signed")]
    Sequence {
        /// The sequence number.
        seq: u64,
        /// Time in the body.
        signed: UnixMillis,
    },
}

impl SignedError {
    /// Returns the reason that a router tells the requester. A wrong clock and an expired certificate have other cures
    /// than a forged request; a stranger learns no more than that.
    pub fn reject_reason(&self) -> RejectReason {
        match self {
            Self::Clock { .. } => RejectReason::Clock,
            Self::Cert(error) if error.is_expiry() => RejectReason::Expired,
            Self::Cert(CertError::Revoked { .. }) => RejectReason::Revoked,
            _ => RejectReason::NotVerified,
        }
    }

    /// Returns the reason that an owner tells the requester.
    pub fn refuse_reason(&self) -> RefuseReason {
        match self {
            Self::Clock { .. } => RefuseReason::Clock,
            Self::Cert(error) if error.is_expiry() => RefuseReason::Expired,
            Self::Cert(CertError::Revoked { .. }) => RefuseReason::Revoked,
            _ => RefuseReason::NotVerified,
        }
    }
}

/// An advertisement whose owner and names are proven.
#[derive(Clone, Debug)]
pub struct VerifiedAdvert {
    /// The owner.
    pub owner: VerifiedPeer,
    /// The content.
    pub body: AdvertBody,
    /// The names of `body.blinds`, each once.
    pub names: Vec<Name>,
}

/// A join whose requester is proven.
#[derive(Clone, Debug)]
pub struct VerifiedJoin {
    /// The requester.
    pub peer: VerifiedPeer,
    /// The request.
    pub body: JoinBody,
}

/// A link state whose node is proven.
#[derive(Clone, Debug)]
pub struct VerifiedLinkState {
    /// The node whose links they are.
    pub node: VerifiedPeer,
    /// The content.
    pub body: LinkStateBody,
}

impl Identity {
    /// Returns the certificate chain as signed bodies carry it.
    pub fn chain_bytes(&self) -> Vec<Bytes> {
        self.chain().iter().map(|c| Bytes::copy_from_slice(c)).collect()
    }

    /// Signs an advertisement of this node.
    pub fn sign_advert(&self, body: &AdvertBody) -> SignedBody {
        self.signed(ADVERT, body)
    }

    /// Signs a join of this node.
    pub fn sign_join(&self, body: &JoinBody) -> SignedBody {
        self.signed(JOIN, body)
    }

    /// Signs a link state of this node.
    pub fn sign_link_state(&self, body: &LinkStateBody) -> SignedBody {
        self.signed(LINK_STATE, body)
    }

    /// Signs an answer of this node, the owner of the name.
    pub fn sign_answer(&self, body: &AnswerBody) -> SignedBody {
        self.signed(ANSWER, body)
    }

    fn signed(&self, context: &str, body: &impl Encode) -> SignedBody {
        let body = body.to_bytes();
        let signature = self.sign(context, &body).into();
        SignedBody { body, signature }
    }
}

/// Verifies an advertisement: chain, time, signature, sequence number, and that its owner is more than invited; and
/// derives the names it may claim.
pub fn verify_advert(
    anchors: &TrustAnchors,
    signed: &SignedBody,
    now: UnixMillis,
) -> Result<VerifiedAdvert, SignedError> {
    let body = AdvertBody::from_slice(&signed.body)?;
    let owner = verify_chain(anchors, &body.chain, body.issued_at, now)?;
    owner.verify_signature(ADVERT, &signed.body, &signed.signature)?;
    if owner.invitation.is_some() {
        return Err(SignedError::Invited);
    }
    verify_seq(body.seq, body.issued_at)?;
    let mut names: Vec<_> = body.blinds.iter().map(|b| name_of(&owner.node_id, b)).collect();
    // A signer may repeat a name, and callers that count names rely on each being there once.
    names.sort_unstable();
    names.dedup();
    Ok(VerifiedAdvert { owner, body, names })
}

/// Verifies a join: chain, time, signature.
pub fn verify_join(
    anchors: &TrustAnchors,
    signed: &SignedBody,
    now: UnixMillis,
) -> Result<VerifiedJoin, SignedError> {
    let body = JoinBody::from_slice(&signed.body)?;
    let peer = verify_chain(anchors, &body.chain, body.issued_at, now)?;
    peer.verify_signature(JOIN, &signed.body, &signed.signature)?;
    Ok(VerifiedJoin { peer, body })
}

/// Verifies a link state: chain, time, signature, sequence number, and that its signer is more than invited. The caller
/// checks whether the node may carry others' names.
pub fn verify_link_state(
    anchors: &TrustAnchors,
    signed: &SignedBody,
    now: UnixMillis,
) -> Result<VerifiedLinkState, SignedError> {
    let body = LinkStateBody::from_slice(&signed.body)?;
    let node = verify_chain(anchors, &body.chain, body.issued_at, now)?;
    node.verify_signature(LINK_STATE, &signed.body, &signed.signature)?;
    if node.invitation.is_some() {
        return Err(SignedError::Invited);
    }
    verify_seq(body.seq, body.issued_at)?;
    Ok(VerifiedLinkState { node, body })
}

/// Returns a fingerprint of a signed body and its signature, so that no body is verified twice.
pub fn signed_digest(signed: &SignedBody) -> [u8; 32] {
    let length = (signed.body.len() as u64).to_be_bytes();
    crate::cert_id::sha256(&[&length, &signed.body, &signed.signature])
}

/// Returns a digest of names, in their order.
pub fn names_digest(names: &[Name]) -> [u8; 32] {
    crate::cert_id::sha256(&names.iter().map(|name| name.0.as_slice()).collect::<Vec<_>>())
}

/// Verifies an answer by the owner of the name.
pub fn verify_answer(owner: &VerifiedPeer, signed: &SignedBody) -> Result<AnswerBody, SignedError> {
    let body = AnswerBody::from_slice(&signed.body)?;
    owner.verify_signature(ANSWER, &signed.body, &signed.signature)?;
    Ok(body)
}

/// Returns the sequence number that follows `last`: the time in milliseconds, so that numbers grow over restarts, or
/// `last + 1`. A number beyond [`SEQ_AHEAD_MAX`], which nobody believes, is not continued.
pub fn next_seq(last: u64, now: UnixMillis) -> u64 {
    let next = now.0.max(last.saturating_add(1));
    if verify_seq(next, now).is_ok() { next } else { now.0 }
}

fn verify_seq(seq: u64, signed: UnixMillis) -> Result<(), SignedError> {
    let ahead = seq.saturating_sub(signed.0);
    if ahead > SEQ_AHEAD_MAX.as_millis() as u64 {
        return Err(SignedError::Sequence { seq, signed });
    }
    Ok(())
}

fn verify_chain(
    anchors: &TrustAnchors,
    chain: &[Bytes],
    signed: UnixMillis,
    now: UnixMillis,
) -> Result<VerifiedPeer, SignedError> {
    if signed.0.abs_diff(now.0) > CLOCK_SKEW_MAX.as_millis() as u64 {
        return Err(SignedError::Clock { signed, now });
    }
    let chain: Vec<_> = chain.iter().map(|c| CertificateDer::from_slice(c)).collect();
    Ok(anchors.verify(&chain, now)?)
}
