//! Access tokens: proofs that a program without a certificate shows to the gateway of one node.
//!
//! A token contains its rights. The node signs it with the key of its identity, so tokens need no other secret and no
//! storage to be valid. `docs/spec/gateway.md` specifies text and bytes. The node keeps the lists of issued and
//! revoked tokens.

use std::fmt;
use std::str::FromStr;

use base64::Engine as _;
use base64::engine::general_purpose::URL_SAFE_NO_PAD;
use sgc_trust::{Identity, VerifiedPeer};
use sgc_wire::{
    Decode as _, DecodeError, Encode as _, NodeId, Reader, SIGNATURE_BYTES_MAX, UnixMillis, Writer,
};
use zeroize::Zeroizing;

use super::scope::{Scope, ScopeError};

/// Prefix of an access token's text. The number is the version.
pub const ACCESS_TOKEN_PREFIX: &str = "sgc-access-1:";
/// Longest text of an access token, in bytes. A token with every field at its bound fits, and HTTP servers accept it
/// as a header.
pub const ACCESS_TOKEN_TEXT_BYTES_MAX: usize = 8 * 1024;
/// Longest label, in bytes.
pub const ACCESS_LABEL_BYTES_MAX: usize = 64;
/// Longest validity of a token, in milliseconds: 3650 days.
pub const ACCESS_VALID_MS_MAX: u64 = 3650 * 86_400_000;

/// Prefix of access tokens of any version.
const ANY_PREFIX: &str = "sgc-access-";
const VERSION: u8 = 1;
/// Signature context. It keeps a signature of another purpose from being accepted here.
const CONTEXT: &str = "sgc access token v1";

/// The random id of a token, shown as 32 hexadecimal digits. It is not secret.
#[derive(Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub struct TokenId(pub [u8; 16]);

impl fmt::Display for TokenId {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        self.0.iter().try_for_each(|byte| write!(f, "{byte:02x}"))
    }
}

impl fmt::Debug for TokenId {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "TokenId({self})")
    }
}

impl FromStr for TokenId {
    type Err = TokenIdError;

    fn from_str(text: &str) -> Result<Self, TokenIdError> {
        let is_hex = text.len() == 32 && text.bytes().all(|b| matches!(b, b'0'..=b'9' | b'a'..=b'f'));
        let number = u128::from_str_radix(text, 16).ok().filter(|_| is_hex).ok_or(TokenIdError)?;
        Ok(Self(number.to_be_bytes()))
    }
}

/// The text is not a token id.
#[derive(Clone, Copy, Debug, PartialEq, Eq, thiserror::Error)]
#[error("the id of a token is 32 hexadecimal digits in small letters: `sgc token access list` shows them")]
pub struct TokenIdError;

/// The content of a token.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct AccessGrant {
    /// The id of the token.
    pub id: TokenId,
    /// The node whose gateway accepts the token.
    pub gateway: NodeId,
    /// A label for people, 1 to [`ACCESS_LABEL_BYTES_MAX`] bytes without control characters.
    pub label: String,
    /// The rights of the token; not empty.
    pub scope: Scope,
    /// The time of issue.
    pub issued: UnixMillis,
    /// The time of expiry, at most [`ACCESS_VALID_MS_MAX`] after the issue.
    pub expires: UnixMillis,
}

/// A token: its content and its signature. `Debug` shows nothing secret.
#[derive(Clone, PartialEq, Eq)]
pub struct AccessToken {
    grant: AccessGrant,
    signature: Zeroizing<Vec<u8>>,
}

impl AccessGrant {
    /// Signs the grant with the gateway's identity.
    pub fn sign(self, identity: &Identity) -> Result<AccessToken, AccessTokenError> {
        self.check()?;
        if self.gateway != identity.node_id() {
            return Err(AccessTokenError::Elsewhere { gateway: self.gateway });
        }
        let signature = Zeroizing::new(identity.sign(CONTEXT, &self.encode()));
        Ok(AccessToken { grant: self, signature })
    }

    /// Fails if a field is invalid. A token that a reader would refuse must not be written.
    pub fn check(&self) -> Result<(), AccessTokenError> {
        check_access_label(&self.label)?;
        let valid = self.expires.0.checked_sub(self.issued.0).filter(|ms| *ms <= ACCESS_VALID_MS_MAX);
        if valid.is_none() {
            return Err(AccessTokenError::Time);
        }
        self.scope.check().map_err(AccessTokenError::Scope)
    }

    fn encode(&self) -> Vec<u8> {
        let mut w = Writer::default();
        w.u8(VERSION);
        w.raw(&self.id.0);
        self.gateway.encode(&mut w);
        w.str(&self.label);
        self.scope.encode(&mut w);
        self.issued.encode(&mut w);
        self.expires.encode(&mut w);
        w.into_vec()
    }

    fn decode(r: &mut Reader<'_>) -> Result<Self, AccessTokenError> {
        if r.u8()? != VERSION {
            return Err(AccessTokenError::Version);
        }
        let grant = Self {
            id: TokenId(r.array("token id")?),
            gateway: NodeId::decode(r)?,
            label: r.str("label", ACCESS_LABEL_BYTES_MAX)?,
            scope: Scope::decode(r)?,
            issued: UnixMillis::decode(r)?,
            expires: UnixMillis::decode(r)?,
        };
        grant.check()?;
        Ok(grant)
    }
}

impl AccessToken {
    /// Parses a token and ignores white space around it. The result is not verified; see [`AccessToken::verify`].
    pub fn parse(text: &str) -> Result<Self, AccessTokenError> {
        let text = text.trim();
        if text.len() > ACCESS_TOKEN_TEXT_BYTES_MAX {
            return Err(AccessTokenError::TooLong { bytes: text.len() });
        }
        let Some(base64) = text.strip_prefix(ACCESS_TOKEN_PREFIX) else {
            return Err(match text.starts_with(ANY_PREFIX) {
                true => AccessTokenError::Version,
                false => AccessTokenError::Prefix,
            });
        };
        let decoded = URL_SAFE_NO_PAD.decode(base64);
        let bytes = decoded.map(Zeroizing::new).map_err(|_| AccessTokenError::NotBase64)?;
        let mut r = Reader::new(&bytes);
        let grant = AccessGrant::decode(&mut r)?;
        let signature = Zeroizing::new(r.bytes("signature", SIGNATURE_BYTES_MAX)?.to_vec());
        r.finish()?;
        Ok(Self { grant, signature })
    }

    /// Returns the content if `gateway` signed the token and is its audience. Expiry and revocation are not checked.
    pub fn verify(&self, gateway: &VerifiedPeer) -> Result<&AccessGrant, AccessTokenError> {
        if self.grant.gateway != gateway.node_id {
            return Err(AccessTokenError::Elsewhere { gateway: self.grant.gateway });
        }
        let signed = gateway.verify_signature(CONTEXT, &self.grant.encode(), &self.signature);
        signed.map(|()| &self.grant).map_err(|_| AccessTokenError::Signature)
    }

    /// Returns the text of the token. It is a secret: its holder has all rights of the token.
    pub fn to_text(&self) -> Zeroizing<String> {
        // The capacity is reserved up front, because reallocation would leave copies of the secret behind.
        let head = self.grant.encode();
        let mut bytes = Zeroizing::new(Vec::with_capacity(head.len() + 4 + self.signature.len()));
        bytes.extend_from_slice(&head);
        bytes.extend_from_slice(&(self.signature.len() as u32).to_be_bytes());
        bytes.extend_from_slice(&self.signature);
        let mut text = Zeroizing::new(String::with_capacity(ACCESS_TOKEN_TEXT_BYTES_MAX));
        text.push_str(ACCESS_TOKEN_PREFIX);
        URL_SAFE_NO_PAD.encode_string(bytes.as_slice(), &mut text);
        text
    }

    /// Returns the unverified id of the token.
    pub fn id(&self) -> TokenId {
        self.grant.id
    }
}

impl fmt::Debug for AccessToken {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_struct("AccessToken").field("grant", &self.grant).finish_non_exhaustive()
    }
}

/// Fails if the text is not valid as a label in lists, the log and status.
pub fn check_access_label(label: &str) -> Result<(), AccessTokenError> {
    let fits = (1..=ACCESS_LABEL_BYTES_MAX).contains(&label.len());
    match fits && label.trim() == label && !label.chars().any(char::is_control) {
        true => Ok(()),
        false => Err(AccessTokenError::Label),
    }
}

/// The reason why a text is not a valid token of this gateway. No variant repeats the text, which may be a mistyped
/// secret.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
pub enum AccessTokenError {
    /// The text is too long.
    #[error("it has {bytes} bytes, a token has at most {ACCESS_TOKEN_TEXT_BYTES_MAX}")]
    TooLong {
        /// The length in bytes.
        bytes: usize,
    },
    /// The text lacks the prefix of a token.
    #[error("it is no access token: one begins with \"{ACCESS_TOKEN_PREFIX}\"")]
    Prefix,
    /// The version is unknown.
    #[error("its version is not known here: \"{ACCESS_TOKEN_PREFIX}\" is")]
    Version,
    /// The text contains characters that tokens do not have.
    #[error("it was cut or mistyped: behind \"{ACCESS_TOKEN_PREFIX}\" are letters, digits, '-' and '_' only")]
    NotBase64,
    /// The bytes are not the fields of a token.
    #[error("it was cut or mistyped: {0}")]
    Malformed(#[from] DecodeError),
    /// The label is invalid.
    #[error(
        "its label is not 1 to {ACCESS_LABEL_BYTES_MAX} bytes of text on one line without space around it, such as \"dashboard\""
    )]
    Label,
    /// The token expires before its issue or too long after.
    #[error("it ends before it was made, or more than 3650 days after")]
    Time,
    /// The scope is invalid.
    #[error("its scope is wrong: {0}")]
    Scope(ScopeError),
    /// The token is for another gateway.
    #[error(
        "it is for the gateway of node {gateway}, not for this one: `sgc token access create` there made it"
    )]
    Elsewhere {
        /// The node of that gateway.
        gateway: NodeId,
    },
    /// The signature is not one of this gateway.
    #[error(
        "this node did not sign it: it was altered or forged, or the node has had another key since: make a new one with \
         `sgc token access create`"
    )]
    Signature,
}
