//! Invitations: what a new node needs to ask its fleet's authority for an identity, in one text.
//!
//! An invitation holds a certificate for a short time, with its key. The certificate is that of no node, and its holder
//! may do nothing but ask the authority once ([`crate::Fleet::redeem`]). `docs/spec/trust.md` defines text and bytes.

use std::fmt;

use rand_core::CryptoRng;
use rustls_pki_types::CertificateDer;
use sgc_wire::{CERT_BYTES_MAX, DecodeError, Encode as _, NodeId, Reader, UnixMillis, Writer};
use zeroize::Zeroizing;

use crate::code_text::{CodeForm, TextFault};
use crate::identity::Identity;
use crate::identity_error::IdentityError;
use crate::invitation_bounds::{INVITATION_ROUTERS_MAX, ROUTER_BYTES_MAX};
use crate::key::Key;
use crate::label::{FleetName, LABEL_BYTES_MAX, NodeName};
use crate::member::Membership;
use crate::verify::{AnchorError, TrustAnchors};
use crate::x509::Validity;

/// Beginning of an invitation's text; the number is the version.
pub const INVITATION_PREFIX: &str = "sgc-join-1:";
/// Longest text of an invitation, bytes: one with every field at its bound fits.
pub const INVITATION_TEXT_BYTES_MAX: usize = 16 * 1024;

/// A forged invitation passes the checksum, and no router takes its certificate.
const FORM: CodeForm = CodeForm {
    prefix: INVITATION_PREFIX,
    any_prefix: "sgc-join-",
    domain: b"sgc join code v1",
    bytes_max: INVITATION_TEXT_BYTES_MAX,
};
const VERSION: u8 = 1;

/// An invitation of a node to a fleet. Debug shows nothing secret.
pub struct Invitation {
    /// Name of the invited node.
    pub node: NodeName,
    /// Name of the fleet.
    pub fleet: FleetName,
    /// Name of the node that answers.
    pub authority: NodeName,
    /// Its id.
    pub authority_id: NodeId,
    /// Routers at which it can be reached, as URLs; hints, not checked here.
    pub routers: Vec<String>,
    /// Whether the fleet wants links and grants that a quantum computer does not open later.
    pub post_quantum: bool,
    pub(crate) ca: CertificateDer<'static>,
    pub(crate) certificate: CertificateDer<'static>,
    pub(crate) scalar: Zeroizing<[u8; 32]>,
}

impl Invitation {
    /// Reads an invitation; white space around it does not count.
    pub fn parse(text: &str) -> Result<Self, InvitationError> {
        Self::decode(&FORM.parse(text)?)
    }

    /// Returns the text of the invitation. It is a secret: whoever uses it first becomes the node.
    pub fn to_text(&self) -> Zeroizing<String> {
        FORM.to_text(&Zeroizing::new(self.encode()))
    }

    /// Returns the first and the last moment at which it is valid.
    pub fn validity(&self) -> Result<(UnixMillis, UnixMillis), InvitationError> {
        let found = Validity::from_certificate(&self.certificate);
        found.map(|v| (v.not_before, v.not_after)).ok_or(InvitationError::Certificate)
    }

    /// Returns the identity with which the holder asks the authority. It has no secret of the fleet.
    pub fn identity(&self, rng: &mut impl CryptoRng) -> Result<Identity, InvitationError> {
        let key = Key::from_scalar(&self.scalar).ok_or(InvitationError::Key)?;
        let member = Membership {
            node: self.node.clone(),
            fleet: self.fleet.clone(),
            chain: vec![self.certificate.clone()],
            anchors: TrustAnchors::new([self.ca.clone()]).map_err(InvitationError::Ca)?,
            secret: None,
            naming: Vec::new(),
            authority: Some(self.authority_id),
            post_quantum: self.post_quantum,
            observers: None,
        };
        let identity = Identity::join(member, key.pkcs8(), rng)?;
        identity.as_peer().invitation.map(|_| identity).ok_or(InvitationError::Certificate)
    }

    /// Returns `true` if an invitation may name these routers, so that it can be read.
    pub(crate) fn fits(routers: &[String]) -> bool {
        (1..=INVITATION_ROUTERS_MAX).contains(&routers.len())
            && routers.iter().all(|url| url.len() <= ROUTER_BYTES_MAX)
    }

    fn encode(&self) -> Vec<u8> {
        let mut w = Writer::default();
        w.u8(VERSION);
        w.str(self.node.as_str());
        w.str(self.fleet.as_str());
        w.str(self.authority.as_str());
        self.authority_id.encode(&mut w);
        w.list(&self.routers, |w, url| w.str(url));
        w.bool(self.post_quantum);
        w.bytes(&self.ca);
        w.bytes(&self.certificate);
        let head = w.into_vec();
        // Capacity up front: a growing vector leaves copies of the key behind.
        let mut content = Vec::with_capacity(head.len() + self.scalar.len());
        content.extend_from_slice(&head);
        content.extend_from_slice(&*self.scalar);
        content
    }

    fn decode(content: &[u8]) -> Result<Self, InvitationError> {
        let mut r = Reader::new(content);
        if r.u8()? != VERSION {
            return Err(InvitationError::Version);
        }
        let node = r.str("node name", LABEL_BYTES_MAX)?;
        let fleet = r.str("fleet name", LABEL_BYTES_MAX)?;
        let authority = r.str("authority name", LABEL_BYTES_MAX)?;
        let authority_id = NodeId(r.array("authority")?);
        let routers = r.list("routers", INVITATION_ROUTERS_MAX, |r| r.str("router", ROUTER_BYTES_MAX))?;
        let post_quantum = r.bool("post-quantum")?;
        let ca = CertificateDer::from(r.bytes("CA certificate", CERT_BYTES_MAX)?.to_vec());
        let certificate = CertificateDer::from(r.bytes("certificate", CERT_BYTES_MAX)?.to_vec());
        let scalar = Zeroizing::new(r.array("key")?);
        r.finish()?;
        let node = node.parse().map_err(|_| InvitationError::Name)?;
        let fleet = fleet.parse().map_err(|_| InvitationError::Name)?;
        let authority = authority.parse().map_err(|_| InvitationError::Name)?;
        Ok(Self { node, fleet, authority, authority_id, routers, post_quantum, ca, certificate, scalar })
    }
}

impl fmt::Debug for Invitation {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_struct("Invitation")
            .field("node", &self.node)
            .field("fleet", &self.fleet)
            .field("authority", &self.authority)
            .field("routers", &self.routers)
            .finish_non_exhaustive()
    }
}

impl From<TextFault> for InvitationError {
    fn from(fault: TextFault) -> Self {
        match fault {
            TextFault::TooLong { bytes } => Self::TooLong { bytes },
            TextFault::Prefix => Self::Prefix,
            TextFault::Version => Self::Version,
            TextFault::NotBase64 => Self::NotBase64,
            TextFault::Checksum => Self::Checksum,
        }
    }
}

/// The reason why a text is no invitation. No error repeats the text, which may be an invitation but for a letter.
#[derive(Debug, thiserror::Error)]
pub enum InvitationError {
    /// Too long.
    #[error("it has {bytes} bytes, a code has at most {INVITATION_TEXT_BYTES_MAX}")]
    TooLong {
        /// Its length.
        bytes: usize,
    },
    /// The text is no invitation at all.
    #[error("it is no code of `sgc fleet invite`: one begins with \"{INVITATION_PREFIX}\"")]
    Prefix,
    /// A version that is not known here.
    #[error("its version is not known here: \"{INVITATION_PREFIX}\" is")]
    Version,
    /// Characters that invitations do not have.
    #[error("it was cut or mistyped: behind \"{INVITATION_PREFIX}\" are letters, digits, '-' and '_' only")]
    NotBase64,
    /// Cut or mistyped.
    #[error("it was cut or mistyped: its checksum is wrong")]
    Checksum,
    /// Bytes that are not the fields of an invitation.
    #[error("its content cannot be read: {0}")]
    Malformed(#[from] DecodeError),
    /// An invalid name.
    #[error("it holds an illegal name")]
    Name,
    /// Invalid CA certificate.
    #[error("its CA certificate is of no use: {0}")]
    Ca(AnchorError),
    /// The certificate is not that of an invitation, or cannot be read.
    #[error("its certificate is not that of an invitation")]
    Certificate,
    /// Invalid key.
    #[error("its key is of no use")]
    Key,
    /// Certificate, CA and key do not belong together.
    #[error("its parts do not belong together: {0}")]
    Identity(#[from] IdentityError),
}
