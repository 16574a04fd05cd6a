//! Share tokens: one interface of an owner, for a partner whose nodes belong to another fleet.
//!
//! A token holds the values that a member of the fleet would derive: owner, metadata and topic secret, which leads to
//! its name and to no other. It admits nobody by itself: the owner's policy names the partner's CA.
//! `docs/spec/trust.md` defines text and bytes. The node stores tokens.

use std::fmt;

use rustls_pki_types::CertificateDer;
use sgc_wire::{
    CERT_BYTES_MAX, Decode as _, DecodeError, Encode as _, Kind, Metadata, Name, NodeId, Reader, UnixMillis,
    Writer,
};
use zeroize::Zeroizing;

use crate::code_text::{CodeForm, TextFault};
use crate::label::LABEL_BYTES_MAX;
use crate::{AnchorError, CaFingerprint, NodeName, TopicSecret, TrustAnchors, name_of};

/// Beginning of a token's text; the number is the version.
pub const TOKEN_PREFIX: &str = "sgc-token-1:";
/// Most routers that one token names.
pub const TOKEN_ROUTERS_MAX: usize = 16;
/// Longest text of a token, bytes: one with every field at its bound fits.
pub const TOKEN_TEXT_BYTES_MAX: usize = 28 * 1024;

/// A forged token passes the checksum, and the owner refuses the name that it leads to.
const FORM: CodeForm = CodeForm {
    prefix: TOKEN_PREFIX,
    any_prefix: "sgc-token-",
    domain: b"sgc token v1",
    bytes_max: TOKEN_TEXT_BYTES_MAX,
};
const VERSION: u8 = 1;
const ROUTER_BYTES_MAX: usize = 300;

/// One interface, handed to a partner. Secrets are compared in constant time; Debug shows nothing secret.
#[derive(Clone, PartialEq, Eq)]
pub struct ShareToken {
    /// Owner of the interface.
    pub owner: NodeId,
    /// The owner's name in its fleet, for people; also in the metadata.
    pub owner_name: NodeName,
    /// The CA of the owner's fleet, which the partner has to trust to reach the owner.
    pub ca: CertificateDer<'static>,
    /// Metadata of the interface; a topic with a type.
    pub metadata: Metadata,
    /// Secret from which the name follows.
    pub secret: TopicSecret,
    /// Routers at which the owner can be reached, as URLs; hints, not checked here.
    pub routers: Vec<String>,
    /// Last moment at which the owner admits the partner.
    pub expires: UnixMillis,
}

impl ShareToken {
    /// Reads a token; white space around it does not count.
    pub fn parse(text: &str) -> Result<Self, TokenError> {
        Self::decode(&FORM.parse(text)?)
    }

    /// Returns the text of the token. It is a secret: everyone with it can derive the name.
    pub fn to_text(&self) -> Zeroizing<String> {
        FORM.to_text(&Zeroizing::new(self.encode()))
    }

    /// Returns the name of the interface.
    pub fn name(&self) -> Name {
        name_of(&self.owner, &self.secret.blind())
    }

    /// Returns the CA of the owner's fleet.
    pub fn ca_fingerprint(&self) -> Result<CaFingerprint, TokenError> {
        let anchors = TrustAnchors::new([self.ca.clone()]).map_err(TokenError::Ca)?;
        anchors.fingerprints().next().ok_or(TokenError::Ca(AnchorError::None))
    }

    fn encode(&self) -> Vec<u8> {
        // Capacity up front: a growing vector leaves copies of the secret behind.
        let mut head = Writer::default();
        head.u8(VERSION);
        self.owner.encode(&mut head);
        head.str(self.owner_name.as_str());
        head.bytes(&self.ca);
        self.metadata.encode(&mut head);
        let mut tail = Writer::default();
        tail.list(&self.routers, |w, url| w.str(url));
        self.expires.encode(&mut tail);
        let (head, tail) = (head.into_vec(), tail.into_vec());
        let mut content = Vec::with_capacity(head.len() + self.secret.expose().len() + tail.len());
        content.extend_from_slice(&head);
        content.extend_from_slice(self.secret.expose());
        content.extend_from_slice(&tail);
        content
    }

    fn decode(content: &[u8]) -> Result<Self, TokenError> {
        let mut r = Reader::new(content);
        if r.u8()? != VERSION {
            return Err(TokenError::Version);
        }
        let owner = NodeId::decode(&mut r)?;
        let owner_name = r.str("owner name", LABEL_BYTES_MAX)?;
        let ca = CertificateDer::from(r.bytes("CA certificate", CERT_BYTES_MAX)?.to_vec());
        let metadata = Metadata::decode(&mut r)?;
        let secret = TopicSecret::from_bytes(r.array("topic secret")?);
        let routers = r.list("routers", TOKEN_ROUTERS_MAX, |r| r.str("router", ROUTER_BYTES_MAX))?;
        let expires = UnixMillis::decode(&mut r)?;
        r.finish()?;
        let owner_name: NodeName = owner_name.parse().map_err(|_| TokenError::Owner)?;
        let token = Self { owner, owner_name, ca, metadata, secret, routers, expires };
        token.check()?;
        Ok(token)
    }

    /// Checks the fields; a token that parsing would refuse must not be written.
    pub fn check(&self) -> Result<(), TokenError> {
        let Metadata { kind, owner, ros_name, type_name, .. } = &self.metadata;
        if owner != self.owner_name.as_str() {
            return Err(TokenError::Owner);
        }
        if *kind != Kind::Topic || ros_name.is_empty() || type_name.is_empty() {
            return Err(TokenError::Interface);
        }
        let long = self.routers.iter().find(|url| url.len() > ROUTER_BYTES_MAX);
        if self.routers.len() > TOKEN_ROUTERS_MAX || long.is_some() {
            return Err(TokenError::Routers);
        }
        self.ca_fingerprint().map(drop)
    }
}

impl fmt::Debug for ShareToken {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_struct("ShareToken")
            .field("owner", &self.owner)
            .field("owner_name", &self.owner_name)
            .field("metadata", &self.metadata)
            .field("routers", &self.routers)
            .field("expires", &self.expires)
            .finish_non_exhaustive()
    }
}

impl From<TextFault> for TokenError {
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

/// The reason why a text is no token. No error repeats the text, which may be a token but for a letter.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
pub enum TokenError {
    /// Too long.
    #[error("it has {bytes} bytes, a token has at most {TOKEN_TEXT_BYTES_MAX}")]
    TooLong {
        /// Its length.
        bytes: usize,
    },
    /// The text is no token at all.
    #[error("it is no token: one begins with \"{TOKEN_PREFIX}\"")]
    Prefix,
    /// A version that is not known here.
    #[error("its version is not known here: \"{TOKEN_PREFIX}\" is")]
    Version,
    /// Characters that tokens do not have.
    #[error("it was cut or mistyped: behind \"{TOKEN_PREFIX}\" are letters, digits, '-' and '_' only")]
    NotBase64,
    /// Cut or mistyped.
    #[error("it was cut or mistyped: its checksum is wrong")]
    Checksum,
    /// Bytes that are not the fields of a token.
    #[error("its content cannot be read: {0}")]
    Malformed(#[from] DecodeError),
    /// No valid name of an owner, or two.
    #[error("it names its owner wrongly")]
    Owner,
    /// Not a topic with a type.
    #[error("it stands for no topic with a type")]
    Interface,
    /// Invalid CA certificate.
    #[error("its CA certificate is of no use: {0}")]
    Ca(AnchorError),
    /// Too many routers, or too long.
    #[error("it names more than {TOKEN_ROUTERS_MAX} routers, or one of more than {ROUTER_BYTES_MAX} bytes")]
    Routers,
}
