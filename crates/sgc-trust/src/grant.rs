//! Answers to joins: a grant's content sealed to the fresh key that the request carried (HPKE, RFC 9180).

use aws_lc_rs::agreement;
use bytes::Bytes;
use rustls::crypto::aws_lc_rs::hpke::DH_KEM_X25519_HKDF_SHA256_AES_256 as HPKE;
use rustls::crypto::hpke::{EncapsulatedSecret, Hpke, HpkePrivateKey, HpkePublicKey};
use sgc_wire::{Decode, DecodeError, Encode, GrantContent, Name, SinkId};
use zeroize::Zeroizing;

use crate::{hpke, xwing};

/// The reason why a grant could not be sealed or opened.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
pub enum GrantError {
    /// The request's reply key is neither an X25519 nor an X-Wing public key.
    #[error("the request's reply key is not usable")]
    ReplyKey,
    /// The seal does not verify: altered, or for another request.
    #[error("the grant was not sealed to this request")]
    NotForUs,
    /// The sealed content is no grant.
    #[error("the grant's content is malformed: {0}")]
    Content(#[from] DecodeError),
}

/// Key encapsulation of a grant. The requester chooses; the owner answers in kind.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum Kem {
    /// X25519.
    #[default]
    X25519,
    /// X-Wing: X25519 and ML-KEM-768, which also withstands quantum computers.
    XWing,
}

impl Kem {
    /// Returns the choice of a fleet with or without post-quantum cryptography.
    pub fn for_fleet(post_quantum: bool) -> Self {
        if post_quantum { Self::XWing } else { Self::X25519 }
    }

    /// Returns the length of a reply key, by which a request shows its choice.
    pub fn reply_key_bytes(self) -> usize {
        match self {
            Self::X25519 => 32,
            Self::XWing => xwing::PUBLIC_BYTES,
        }
    }

    fn from_reply_key(key: &[u8]) -> Option<Self> {
        [Self::X25519, Self::XWing].into_iter().find(|kem| kem.reply_key_bytes() == key.len())
    }
}

/// A fresh key pair of one join. Both private keys are cleared when dropped.
pub struct ReplyKey {
    public: Bytes,
    private: Private,
}

enum Private {
    X25519(HpkePrivateKey),
    XWing(Box<xwing::PrivateKey>),
}

impl ReplyKey {
    /// Makes a key pair. The provider draws the randomness.
    pub fn generate(kem: Kem) -> Self {
        match kem {
            Kem::X25519 => {
                let (public, private) =
                    HPKE.generate_key_pair().expect("the provider makes X25519 keys or aborts");
                Self { public: public.0.into(), private: Private::X25519(private) }
            }
            Kem::XWing => {
                let (private, public) =
                    xwing::PrivateKey::generate().expect("the provider makes X-Wing keys or aborts");
                Self { public: public.into(), private: Private::XWing(Box::new(private)) }
            }
        }
    }

    /// Reads a given key, for tests and vectors; joins make fresh ones. X25519: its 32 bytes. X-Wing: the decapsulation
    /// key of ML-KEM-768 (FIPS 203, 7.1; 2400 bytes), then the 32 of X25519. `None` if it is no such key.
    pub fn from_private(kem: Kem, private: &[u8]) -> Option<Self> {
        match kem {
            Kem::X25519 => {
                let key = agreement::PrivateKey::from_private_key(&agreement::X25519, private).ok()?;
                let public = Bytes::copy_from_slice(key.compute_public_key().ok()?.as_ref());
                Some(Self { public, private: Private::X25519(private.to_vec().into()) })
            }
            Kem::XWing => {
                let (key, public) = xwing::PrivateKey::from_bytes(private)?;
                Some(Self { public: public.into(), private: Private::XWing(Box::new(key)) })
            }
        }
    }

    /// Returns the public key, as it goes into the request.
    pub fn public(&self) -> &Bytes {
        &self.public
    }

    /// Opens a grant's content.
    pub fn open(
        &self,
        name: &Name,
        sink: &SinkId,
        serial: u64,
        enc: &[u8],
        sealed: &[u8],
    ) -> Result<GrantContent, GrantError> {
        let (info, aad) = (info(name, sink), serial.to_be_bytes());
        let plain = match &self.private {
            Private::X25519(private) => HPKE
                .open(&EncapsulatedSecret(enc.to_vec()), &info, &aad, sealed, private)
                .map(Zeroizing::new)
                .ok(),
            Private::XWing(private) => private
                .decapsulate(enc)
                .and_then(|secret| hpke::Context::new(&hpke::XWING, &secret, &info).ok())
                .and_then(|context| context.open(&aad, sealed).ok()),
        };
        Ok(GrantContent::from_slice(&plain.ok_or(GrantError::NotForUs)?)?)
    }
}

impl std::fmt::Debug for ReplyKey {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.write_str("ReplyKey(..)")
    }
}

/// Seals a grant's content to a request, in the kind of its reply key. Returns the encapsulated key and the sealed
/// content.
pub fn seal_grant(
    reply_key: &[u8],
    name: &Name,
    sink: &SinkId,
    serial: u64,
    content: &GrantContent,
) -> Result<(Bytes, Bytes), GrantError> {
    let plain = Zeroizing::new(content.to_vec());
    let (info, aad) = (info(name, sink), serial.to_be_bytes());
    match Kem::from_reply_key(reply_key).ok_or(GrantError::ReplyKey)? {
        Kem::X25519 => {
            let (enc, sealed) = HPKE
                .seal(&info, &aad, &plain, &HpkePublicKey(reply_key.to_vec()))
                .map_err(|_| GrantError::ReplyKey)?;
            Ok((enc.0.into(), sealed.into()))
        }
        Kem::XWing => {
            let (enc, secret) = xwing::encapsulate(reply_key).ok_or(GrantError::ReplyKey)?;
            let sealed = hpke::Context::new(&hpke::XWING, &secret, &info)
                .and_then(|context| context.seal(&aad, &plain))
                .map_err(|_| GrantError::ReplyKey)?;
            Ok((enc.into(), sealed.into()))
        }
    }
}

fn info(name: &Name, sink: &SinkId) -> Vec<u8> {
    [b"sgc grant v1".as_slice(), name.as_bytes(), sink.as_bytes()].concat()
}

#[cfg(test)]
mod tests {
    use sgc_wire::{SecretBytes, TopicGrant};

    use super::*;

    const NAME: Name = Name([1; 32]);
    const SINK: SinkId = SinkId([2; 16]);

    fn content() -> GrantContent {
        GrantContent::Topic(TopicGrant {
            epoch: 1,
            suite: 1,
            key: SecretBytes::new([9; 32]),
            receiver: None,
            sources: Vec::new(),
            entry: None,
        })
    }

    #[test]
    fn only_the_request_that_asked_opens_the_grant() {
        for kem in [Kem::X25519, Kem::XWing] {
            let asked = ReplyKey::generate(kem);
            assert_eq!(asked.public().len(), kem.reply_key_bytes());
            let (enc, sealed) = seal_grant(asked.public(), &NAME, &SINK, 4, &content()).unwrap();
            assert_eq!(asked.open(&NAME, &SINK, 4, &enc, &sealed), Ok(content()));
            let refused = |k: &ReplyKey, n: Name, s: SinkId, serial| {
                assert_eq!(k.open(&n, &s, serial, &enc, &sealed), Err(GrantError::NotForUs));
            };
            refused(&ReplyKey::generate(Kem::X25519), NAME, SINK, 4);
            refused(&ReplyKey::generate(Kem::XWing), NAME, SINK, 4);
            refused(&asked, Name([3; 32]), SINK, 4);
            refused(&asked, NAME, SinkId([3; 16]), 4);
            refused(&asked, NAME, SINK, 5);
        }
    }

    #[test]
    fn an_altered_grant_does_not_open() {
        for kem in [Kem::X25519, Kem::XWing] {
            let asked = ReplyKey::generate(kem);
            let (enc, sealed) = seal_grant(asked.public(), &NAME, &SINK, 4, &content()).unwrap();
            let refused = |enc: &[u8], sealed: &[u8]| {
                assert_eq!(asked.open(&NAME, &SINK, 4, enc, sealed), Err(GrantError::NotForUs), "{kem:?}");
            };
            // X25519 ignores the topmost bit of a point (RFC 7748, 5), yet HPKE binds it.
            for at in 0..enc.len() * 8 {
                let mut altered = enc.to_vec();
                altered[at / 8] ^= 1 << (at % 8);
                refused(&altered, &sealed);
            }
            for at in 0..sealed.len() * 8 {
                let mut altered = sealed.to_vec();
                altered[at / 8] ^= 1 << (at % 8);
                refused(&enc, &altered);
            }
            refused(&enc[1..], &sealed);
            refused(&[&enc[..], &[0]].concat(), &sealed);
            refused(&enc, &sealed[1..]);
            refused(&enc, b"");
        }
    }

    #[test]
    fn a_reply_key_that_is_none_is_refused() {
        for bytes in [0, 5, 31, 33, 1184, 1215, 1217, 2048] {
            let key = vec![1; bytes];
            assert_eq!(seal_grant(&key, &NAME, &SINK, 4, &content()), Err(GrantError::ReplyKey), "{bytes}");
        }
        assert_eq!(seal_grant(&[0xff; 1216], &NAME, &SINK, 4, &content()), Err(GrantError::ReplyKey));
        assert_eq!(seal_grant(&[0; 32], &NAME, &SINK, 4, &content()), Err(GrantError::ReplyKey));
    }
}
