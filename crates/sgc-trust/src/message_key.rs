//! The keys with which sources sign, and their public halves, which verify the signatures.
//!
//! The owner of a name announces the keys of its sources in its signed answer.

use std::fmt;
use std::sync::Arc;

use aws_lc_rs::encoding::{AsDer, PublicKeyX509Der};
use aws_lc_rs::rand::SystemRandom;
use aws_lc_rs::rsa;
use aws_lc_rs::signature::{
    ED25519, Ed25519KeyPair, KeyPair as _, ParsedPublicKey, RSA_PSS_2048_8192_SHA256, RSA_PSS_SHA256,
};
use bytes::Bytes;
use sgc_wire::SOURCE_KEY_BYTES_MAX;

use crate::Suite;
use crate::suite::Scheme;

/// A key that signs messages. Cloning shares.
///
/// One key may serve several sources, names, epochs and suites: a signature covers the packets' headers, which hold all
/// of these. RSA keys take a tenth of a second and more to make, so a node makes one of each kind that it needs.
#[derive(Clone)]
pub struct MessageKey {
    inner: Arc<Inner>,
    public: Bytes,
}

enum Inner {
    Unsigned,
    Ed25519(Ed25519KeyPair),
    Rsa(rsa::KeyPair),
}

/// A given key that cannot be used.
#[derive(Clone, Copy, Debug, PartialEq, Eq, thiserror::Error)]
#[error("not a message key of the suite {suite}")]
pub struct MessageKeyError {
    suite: Suite,
}

impl MessageKey {
    /// Makes a key for a suite, an empty one if its messages are not signed. The provider draws the randomness.
    ///
    /// # Panics
    /// If the provider cannot make keys: it has no randomness or no memory.
    pub fn generate(suite: Suite) -> Self {
        let rsa = |size| rsa::KeyPair::generate(size).map(Inner::Rsa);
        let inner = match suite.scheme() {
            Scheme::Unsigned => Ok(Inner::Unsigned),
            Scheme::Ed25519 => Ed25519KeyPair::generate().map(Inner::Ed25519),
            Scheme::RsaPss(256) => rsa(rsa::KeySize::Rsa2048),
            Scheme::RsaPss(_) => rsa(rsa::KeySize::Rsa3072),
        };
        Self::new(inner.expect("the provider makes keys or the machine has no randomness"))
            .expect("a key that was just made has a public half")
    }

    /// Reads a stored key, PKCS #8; for tests and vectors. Sources never outlive their process, nor do their keys.
    pub fn from_pkcs8(suite: Suite, pkcs8: &[u8]) -> Result<Self, MessageKeyError> {
        let error = MessageKeyError { suite };
        let inner = match suite.scheme() {
            Scheme::Unsigned => return Err(error),
            Scheme::Ed25519 => Ed25519KeyPair::from_pkcs8_maybe_unchecked(pkcs8).map(Inner::Ed25519),
            Scheme::RsaPss(_) => rsa::KeyPair::from_pkcs8(pkcs8).map(Inner::Rsa),
        };
        inner.ok().and_then(Self::new).filter(|key| key.fits(suite)).ok_or(error)
    }

    fn new(inner: Inner) -> Option<Self> {
        let public = match &inner {
            Inner::Unsigned => Bytes::new(),
            Inner::Ed25519(pair) => Bytes::copy_from_slice(pair.public_key().as_ref()),
            Inner::Rsa(pair) => {
                let der: PublicKeyX509Der<'_> = pair.public_key().as_der().ok()?;
                Bytes::copy_from_slice(der.as_ref())
            }
        };
        Some(Self { inner: Arc::new(inner), public })
    }

    /// Returns the public key as announcements carry it: 32 bytes for Ed25519, a SubjectPublicKeyInfo for RSA, nothing
    /// for suites without signatures.
    pub fn public(&self) -> &Bytes {
        &self.public
    }

    /// Returns `true` if the key is of the suite's kind.
    pub fn fits(&self, suite: Suite) -> bool {
        match (&*self.inner, suite.scheme()) {
            (Inner::Unsigned, Scheme::Unsigned) | (Inner::Ed25519(_), Scheme::Ed25519) => true,
            (Inner::Rsa(pair), Scheme::RsaPss(bytes)) => pair.public_modulus_len() == bytes,
            _ => false,
        }
    }

    /// Writes the signature of a message to `signature`; empty if the suite has none.
    pub(crate) fn sign(&self, message: &[u8], signature: &mut Vec<u8>) {
        signature.clear();
        match &*self.inner {
            Inner::Unsigned => {}
            Inner::Ed25519(pair) => signature.extend_from_slice(pair.sign(message).as_ref()),
            Inner::Rsa(pair) => {
                signature.resize(pair.public_modulus_len(), 0);
                pair.sign(&RSA_PSS_SHA256, &SystemRandom::new(), message, signature)
                    .expect("a key of 2048 bits or more signs SHA-256 digests");
            }
        }
    }
}

impl fmt::Debug for MessageKey {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str("MessageKey(..)")
    }
}

/// The public key of a source, parsed once.
pub(crate) struct VerifyKey {
    key: ParsedPublicKey,
    scheme: Scheme,
}

impl VerifyKey {
    /// Parses an announced key. Returns `None` if it does not fit the suite, or the suite has no signatures.
    pub(crate) fn new(suite: Suite, public: &[u8]) -> Option<Self> {
        if public.len() > SOURCE_KEY_BYTES_MAX {
            return None;
        }
        let scheme = suite.scheme();
        let key = match scheme {
            Scheme::Unsigned => return None,
            Scheme::Ed25519 if public.len() != 32 => return None,
            Scheme::Ed25519 => ParsedPublicKey::new(&ED25519, public),
            Scheme::RsaPss(_) => ParsedPublicKey::new(&RSA_PSS_2048_8192_SHA256, public),
        };
        Some(Self { key: key.ok()?, scheme })
    }

    /// Returns the length of its signatures, bytes. A signature of another length does not verify, nor does an RSA key
    /// of another size than the suite's.
    pub(crate) fn signature_bytes(&self) -> usize {
        self.scheme.signature_bytes()
    }

    pub(crate) fn verify(&self, message: &[u8], signature: &[u8]) -> bool {
        signature.len() == self.signature_bytes() && self.key.verify_sig(message, signature).is_ok()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Signs the message "m".
    fn signature(key: &MessageKey) -> Vec<u8> {
        let mut signature = Vec::new();
        key.sign(b"m", &mut signature);
        signature
    }

    #[test]
    fn keys_sign_for_their_suites_and_no_other() {
        let keys = [Suite::Group, Suite::Standard, Suite::Paper, Suite::Paper3072]
            .map(|suite| (suite, MessageKey::generate(suite)));
        for (made_for, key) in &keys {
            for suite in Suite::ALL {
                assert_eq!(key.fits(suite), suite.scheme() == made_for.scheme(), "{made_for} for {suite}");
                let verifies =
                    VerifyKey::new(suite, key.public()).is_some_and(|v| v.verify(b"m", &signature(key)));
                assert_eq!(verifies, suite.is_signed() && key.fits(suite), "{made_for} for {suite}");
            }
        }
        let (_, key) = &keys[1];
        let verify = VerifyKey::new(Suite::Standard, key.public()).unwrap();
        assert!(!verify.verify(b"n", &signature(key)) && !verify.verify(b"m", b""));
        assert!(VerifyKey::new(Suite::Standard, b"").is_none());
        assert!(VerifyKey::new(Suite::Paper, b"no key").is_none());
        assert_eq!(format!("{key:?}"), "MessageKey(..)");
    }
}
