//! Access tokens: what a program without a certificate shows to the gateway of one node.
//!
//! A token holds what it permits and is signed by the node that it is for, with the key of the node's identity: there is no
//! other secret, and nothing has to be kept for a token to hold. Text and bytes are those of `docs/spec/gateway.md`. Which
//! tokens were made, and which were taken back, is kept by the node.

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

/// What the text of an access token begins with; the number is the version.
pub const ACCESS_TOKEN_PREFIX: &str = "sgc-access-1:";
/// Longest text of an access token, bytes: one with every field at its bound fits, and HTTP servers take it as a header.
pub const ACCESS_TOKEN_TEXT_BYTES_MAX: usize = 8 * 1024;
/// Longest label, bytes.
pub const ACCESS_LABEL_BYTES_MAX: usize = 64;
/// Longest time for which a token may be made, milliseconds: 3650 days.
pub const ACCESS_VALID_MS_MAX: u64 = 3650 * 86_400_000;

/// What access tokens of any version begin with.
const ANY_PREFIX: &str = "sgc-access-";
const VERSION: u8 = 1;
/// Keeps the signature from passing for one of another purpose.
const CONTEXT: &str = "sgc access token v1";

/// Which token it is: random, shown as 32 hexadecimal digits. No secret.
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

/// No id of a token.
#[derive(Clone, Copy, Debug, PartialEq, Eq, thiserror::Error)]
#[error("the id of a token is 32 hexadecimal digits in small letters: `sgc token list` shows them")]
pub struct TokenIdError;

/// What a token says.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct AccessGrant {
    /// Which token it is.
    pub id: TokenId,
    /// The node at whose gateway it holds.
    pub gateway: NodeId,
    /// For whom it is, for people: 1 to [`ACCESS_LABEL_BYTES_MAX`] bytes without control characters.
    pub label: String,
    /// What it permits; not empty.
    pub scope: Scope,
    /// When it was made.
    pub issued: UnixMillis,
    /// Last moment at which it holds; at most [`ACCESS_VALID_MS_MAX`] after it was made.
    pub expires: UnixMillis,
}

/// A token: what it says, and who says so. Debug shows nothing secret.
#[derive(Clone, PartialEq, Eq)]
pub struct AccessToken {
    grant: AccessGrant,
    signature: Zeroizing<Vec<u8>>,
}

impl AccessGrant {
    /// The token that says this, signed by the gateway's own identity.
    pub fn sign(self, identity: &Identity) -> Result<AccessToken, AccessTokenError> {
        self.check()?;
        if self.gateway != identity.node_id() {
            return Err(AccessTokenError::Elsewhere { gateway: self.gateway });
        }
        let signature = Zeroizing::new(identity.sign(CONTEXT, &self.encode()));
        Ok(AccessToken { grant: self, signature })
    }

    /// Whether the fields are those of a token; what is refused when read must not be written.
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
    /// Reads a token; white space around it does not count. Nothing is believed by that: see [`AccessToken::verify`].
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

    /// What it says, if `gateway` signed it and it is for there. Whether it ended or was taken back is not asked.
    pub fn verify(&self, gateway: &VerifiedPeer) -> Result<&AccessGrant, AccessTokenError> {
        if self.grant.gateway != gateway.node_id {
            return Err(AccessTokenError::Elsewhere { gateway: self.grant.gateway });
        }
        let signed = gateway.verify_signature(CONTEXT, &self.grant.encode(), &self.signature);
        signed.map(|()| &self.grant).map_err(|_| AccessTokenError::Signature)
    }

    /// The text of the token. It is a secret: whoever holds it may do what it permits.
    pub fn to_text(&self) -> Zeroizing<String> {
        // Capacity up front: what grows leaves copies of the secret behind.
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

    /// Which token it says it is, unverified.
    pub fn id(&self) -> TokenId {
        self.grant.id
    }
}

impl fmt::Debug for AccessToken {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_struct("AccessToken").field("grant", &self.grant).finish_non_exhaustive()
    }
}

/// Whether somebody can be called so: in lists, in the log, in status.
pub fn check_access_label(label: &str) -> Result<(), AccessTokenError> {
    let fits = (1..=ACCESS_LABEL_BYTES_MAX).contains(&label.len());
    match fits && label.trim() == label && !label.chars().any(char::is_control) {
        true => Ok(()),
        false => Err(AccessTokenError::Label),
    }
}

/// Why a text is no token, or not one of this gateway. None of them repeats the text, which may be one but for a letter.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
pub enum AccessTokenError {
    /// Too long.
    #[error("it has {bytes} bytes, a token has at most {ACCESS_TOKEN_TEXT_BYTES_MAX}")]
    TooLong {
        /// Its length.
        bytes: usize,
    },
    /// Something else altogether.
    #[error("it is no access token: one begins with \"{ACCESS_TOKEN_PREFIX}\"")]
    Prefix,
    /// Of a version that is not known here.
    #[error("its version is not known here: \"{ACCESS_TOKEN_PREFIX}\" is")]
    Version,
    /// Characters that tokens do not have.
    #[error("it was cut or mistyped: behind \"{ACCESS_TOKEN_PREFIX}\" are letters, digits, '-' and '_' only")]
    NotBase64,
    /// Bytes that are not the fields of a token.
    #[error("it was cut or mistyped: {0}")]
    Malformed(#[from] DecodeError),
    /// No label.
    #[error(
        "its label is not 1 to {ACCESS_LABEL_BYTES_MAX} bytes of text on one line without space around it, such as \"dashboard\""
    )]
    Label,
    /// It ends before it begins, or too long after.
    #[error("it ends before it was made, or more than 3650 days after")]
    Time,
    /// What it permits is no scope.
    #[error("its scope is wrong: {0}")]
    Scope(ScopeError),
    /// It is for another gateway.
    #[error("it is for the gateway of node {gateway}, not for this one: `sgc token create` there made it")]
    Elsewhere {
        /// Whose.
        gateway: NodeId,
    },
    /// This gateway did not make it.
    #[error(
        "this node did not sign it: it was altered or forged, or the node has had another key since: make a new one with \
         `sgc token create`"
    )]
    Signature,
}
