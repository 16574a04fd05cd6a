//! Answers to joins: a grant's content sealed to the fresh key that the request carried (HPKE, RFC 9180).

use bytes::Bytes;
use rustls::crypto::aws_lc_rs::hpke::DH_KEM_X25519_HKDF_SHA256_AES_256 as HPKE;
use rustls::crypto::hpke::{EncapsulatedSecret, Hpke, HpkePrivateKey, HpkePublicKey};
use sgc_wire::{Decode, DecodeError, Encode, GrantContent, Name, SinkId};
use zeroize::Zeroizing;

/// Why a grant could not be sealed or opened.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
pub enum GrantError {
    /// The request's reply key is not an X25519 public key.
    #[error("the request's reply key is not usable")]
    ReplyKey,
    /// The seal does not verify: altered, or for another request.
    #[error("the grant was not sealed to this request")]
    NotForUs,
    /// What was sealed is no grant.
    #[error("the grant's content is malformed: {0}")]
    Content(#[from] DecodeError),
}

/// A fresh key pair of one join.
pub struct ReplyKey {
    public: Bytes,
    private: HpkePrivateKey,
}

impl ReplyKey {
    /// Makes a key pair. The provider draws the randomness.
    pub fn generate() -> Self {
        let (public, private) = HPKE.generate_key_pair().expect("the provider makes X25519 keys or aborts");
        Self { public: public.0.into(), private }
    }

    /// The public key, as it goes into the request.
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
        let plain = HPKE
            .open(
                &EncapsulatedSecret(enc.to_vec()),
                &info(name, sink),
                &serial.to_be_bytes(),
                sealed,
                &self.private,
            )
            .map_err(|_| GrantError::NotForUs)?;
        Ok(GrantContent::from_slice(&Zeroizing::new(plain))?)
    }
}

impl std::fmt::Debug for ReplyKey {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.write_str("ReplyKey(..)")
    }
}

/// Seals a grant's content to a request: the encapsulated key and the sealed content.
pub fn seal_grant(
    reply_key: &[u8],
    name: &Name,
    sink: &SinkId,
    serial: u64,
    content: &GrantContent,
) -> Result<(Bytes, Bytes), GrantError> {
    let plain = Zeroizing::new(content.to_vec());
    let (enc, sealed) = HPKE
        .seal(&info(name, sink), &serial.to_be_bytes(), &plain, &HpkePublicKey(reply_key.to_vec()))
        .map_err(|_| GrantError::ReplyKey)?;
    Ok((enc.0.into(), sealed.into()))
}

fn info(name: &Name, sink: &SinkId) -> Vec<u8> {
    [b"sgc grant v1".as_slice(), name.as_bytes(), sink.as_bytes()].concat()
}

#[cfg(test)]
mod tests {
    use sgc_wire::{SecretBytes, TopicGrant};

    use super::*;

    #[test]
    fn only_the_request_that_asked_opens_the_grant() {
        let (name, sink) = (Name([1; 32]), SinkId([2; 16]));
        let content = GrantContent::Topic(TopicGrant {
            epoch: 1,
            suite: 1,
            key: SecretBytes::new([9; 32]),
            sources: Vec::new(),
            entry: None,
        });
        let asked = ReplyKey::generate();
        let (enc, sealed) = seal_grant(asked.public(), &name, &sink, 4, &content).unwrap();
        assert_eq!(asked.open(&name, &sink, 4, &enc, &sealed), Ok(content.clone()));
        let refused = |k: &ReplyKey, n: Name, s: SinkId, serial| {
            assert_eq!(k.open(&n, &s, serial, &enc, &sealed), Err(GrantError::NotForUs));
        };
        refused(&ReplyKey::generate(), name, sink, 4);
        refused(&asked, Name([3; 32]), sink, 4);
        refused(&asked, name, SinkId([3; 16]), 4);
        refused(&asked, name, sink, 5);
        assert_eq!(seal_grant(b"short", &name, &sink, 4, &content), Err(GrantError::ReplyKey));
    }
}
