//! The cipher suites: the AEAD that seals, and the signature of sealed packets (`docs/spec/trust.md`, suites).

use std::fmt;
use std::str::FromStr;

use aws_lc_rs::aead::{AES_256_GCM, Algorithm, CHACHA20_POLY1305};

/// Protection of a topic's payloads.
///
/// The `group` suites keep out every node without a grant of the topic; granted nodes trust each other not to forge
/// messages. In all others only a source can make its messages: it signs them, or, in the `pairwise` suites and as long
/// as receivers are few, proves them to each receiver with a MAC.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub enum Suite {
    /// AES-256-GCM.
    Group,
    /// ChaCha20-Poly1305, for CPUs without AES instructions.
    GroupChacha,
    /// AES-256-GCM and Ed25519.
    Standard,
    /// ChaCha20-Poly1305 and Ed25519.
    StandardChacha,
    /// AES-256-GCM and RSASSA-PSS of 2048 bits with SHA-256, the choice of the paper.
    Paper,
    /// AES-256-GCM and RSASSA-PSS of 3072 bits with SHA-256.
    Paper3072,
    /// ChaCha20-Poly1305 and RSASSA-PSS of 2048 bits with SHA-256.
    PaperChacha,
    /// ChaCha20-Poly1305 and RSASSA-PSS of 3072 bits with SHA-256.
    Paper3072Chacha,
    /// AES-256-GCM, and a MAC for each receiver or Ed25519.
    #[default]
    Pairwise,
    /// ChaCha20-Poly1305, and a MAC for each receiver or Ed25519.
    PairwiseChacha,
}

/// Signature scheme of messages.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Scheme {
    /// Nothing.
    Unsigned,
    /// Ed25519 (RFC 8032).
    Ed25519,
    /// RSASSA-PSS, SHA-256, MGF1 with SHA-256, salt of 32 bytes (RFC 8017, 8.1), with a modulus of this many
    /// bytes.
    RsaPss(usize),
}

impl Scheme {
    /// Length of a signature, bytes.
    pub(crate) fn signature_bytes(self) -> usize {
        match self {
            Self::Unsigned => 0,
            Self::Ed25519 => 64,
            Self::RsaPss(modulus) => modulus,
        }
    }
}

impl Suite {
    /// The suite of topics without a setting.
    pub const DEFAULT: Self = Self::Pairwise;

    /// All suites, in the order of their ids.
    pub const ALL: [Self; 10] = [
        Self::Group,
        Self::GroupChacha,
        Self::Standard,
        Self::StandardChacha,
        Self::Paper,
        Self::Paper3072,
        Self::PaperChacha,
        Self::Paper3072Chacha,
        Self::Pairwise,
        Self::PairwiseChacha,
    ];

    /// Returns the id on the wire, from 1.
    pub fn id(self) -> u8 {
        self as u8 + 1
    }

    /// Returns the suite with that id, if this build has it.
    pub fn from_id(id: u8) -> Option<Self> {
        Self::ALL.into_iter().find(|s| s.id() == id)
    }

    /// Returns the name in configuration files and logs.
    pub fn name(self) -> &'static str {
        match self {
            Self::Group => "group",
            Self::GroupChacha => "group-chacha",
            Self::Standard => "standard",
            Self::StandardChacha => "standard-chacha",
            Self::Paper => "paper",
            Self::Paper3072 => "paper-3072",
            Self::PaperChacha => "paper-chacha",
            Self::Paper3072Chacha => "paper-3072-chacha",
            Self::Pairwise => "pairwise",
            Self::PairwiseChacha => "pairwise-chacha",
        }
    }

    /// Returns `true` if sources sign their messages, at least where they have no MAC for each receiver. Members cannot
    /// forge one another.
    pub fn is_signed(self) -> bool {
        self.scheme() != Scheme::Unsigned
    }

    /// Returns `true` if a source proves its packets by a MAC for each receiver, as long as these are few.
    pub fn is_pairwise(self) -> bool {
        matches!(self, Self::Pairwise | Self::PairwiseChacha)
    }

    pub(crate) fn scheme(self) -> Scheme {
        match self {
            Self::Group | Self::GroupChacha => Scheme::Unsigned,
            Self::Standard | Self::StandardChacha | Self::Pairwise | Self::PairwiseChacha => Scheme::Ed25519,
            Self::Paper | Self::PaperChacha => Scheme::RsaPss(256),
            Self::Paper3072 | Self::Paper3072Chacha => Scheme::RsaPss(384),
        }
    }

    pub(crate) fn cipher(self) -> &'static Algorithm {
        match self {
            Self::Group | Self::Standard | Self::Paper | Self::Paper3072 | Self::Pairwise => &AES_256_GCM,
            Self::GroupChacha
            | Self::StandardChacha
            | Self::PaperChacha
            | Self::Paper3072Chacha
            | Self::PairwiseChacha => &CHACHA20_POLY1305,
        }
    }
}

impl fmt::Display for Suite {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(self.name())
    }
}

/// Text that names no suite.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
#[error("{found:?} is no cipher suite; there are {}", Suite::ALL.map(Suite::name).join(", "))]
pub struct ParseSuiteError {
    found: String,
}

impl FromStr for Suite {
    type Err = ParseSuiteError;

    fn from_str(s: &str) -> Result<Self, Self::Err> {
        let found = Self::ALL.into_iter().find(|suite| suite.name() == s);
        found.ok_or_else(|| ParseSuiteError { found: s.chars().take(80).collect() })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn ids_and_names_round_trip() {
        for (suite, id) in Suite::ALL.into_iter().zip(1..) {
            assert_eq!((suite.id(), Suite::from_id(id)), (id, Some(suite)));
            assert_eq!(suite.to_string().parse(), Ok(suite));
        }
        assert_eq!((Suite::from_id(0), Suite::from_id(11)), (None, None));
        assert_eq!((Suite::DEFAULT, Suite::default()), (Suite::Pairwise, Suite::Pairwise));
        let with_key = |suite: &Suite| sgc_wire::RECEIVER_KEY_SUITES.contains(&suite.id());
        assert!(Suite::ALL.iter().all(|suite| suite.is_pairwise() == with_key(suite)));
        let error = "Standard".parse::<Suite>().unwrap_err().to_string();
        assert!(error.contains("standard-chacha"), "{error}");
    }
}
