//! HPKE (RFC 9180) in base mode, for one message, over a key encapsulation that rustls' HPKE does not have.
//!
//! It begins after the encapsulation, with a shared secret, and derives with HKDF-SHA256; every output is at most one
//! block of the hash. No exporter, no sequence of messages.

use aws_lc_rs::aead::{self, Aad, LessSafeKey, NONCE_LEN, Nonce, UnboundKey};
use aws_lc_rs::error::Unspecified;
use aws_lc_rs::{hkdf, hmac};
use zeroize::Zeroizing;

const MODE_BASE: u8 = 0;
const KDF_HKDF_SHA256: u16 = 1;
const VERSION: &[u8] = b"HPKE-v1";
/// Key length of both AEADs.
const KEY_BYTES: usize = 32;

/// The algorithms of a context.
pub(crate) struct Suite {
    /// The key encapsulation's number in HPKE's registry.
    pub(crate) kem: u16,
    /// The AEAD's number; its key has 32 bytes.
    pub(crate) aead: u16,
    /// The AEAD.
    pub(crate) cipher: &'static aead::Algorithm,
}

/// X-Wing, HKDF-SHA256, AES-256-GCM.
pub(crate) const XWING: Suite = Suite { kem: 0x647a, aead: 2, cipher: &aead::AES_256_GCM };

/// Key and nonce of one message.
pub(crate) struct Context {
    key: LessSafeKey,
    nonce: [u8; NONCE_LEN],
}

impl Context {
    /// Derives a context: RFC 9180, 5.1, without a pre-shared key.
    pub(crate) fn new(suite: &Suite, secret: &[u8; 32], info: &[u8]) -> Result<Self, Unspecified> {
        let Schedule { key, nonce } = Schedule::new(suite, secret, info)?;
        Ok(Self { key: LessSafeKey::new(UnboundKey::new(suite.cipher, &key[..])?), nonce })
    }

    /// Seals the one message. It takes `self` by value: a second message under the same nonce would reveal both.
    pub(crate) fn seal(self, aad: &[u8], plain: &[u8]) -> Result<Vec<u8>, Unspecified> {
        let mut sealed = Vec::with_capacity(plain.len() + self.key.algorithm().tag_len());
        sealed.extend_from_slice(plain);
        let nonce = Nonce::assume_unique_for_key(self.nonce);
        self.key.seal_in_place_append_tag(nonce, Aad::from(aad), &mut sealed)?;
        Ok(sealed)
    }

    /// Opens the one message.
    pub(crate) fn open(self, aad: &[u8], sealed: &[u8]) -> Result<Zeroizing<Vec<u8>>, Unspecified> {
        let mut plain = Zeroizing::new(sealed.to_vec());
        let nonce = Nonce::assume_unique_for_key(self.nonce);
        let length = self.key.open_in_place(nonce, Aad::from(aad), &mut plain)?.len();
        plain.truncate(length);
        Ok(plain)
    }
}

struct Schedule {
    key: Zeroizing<[u8; KEY_BYTES]>,
    nonce: [u8; NONCE_LEN],
}

impl Schedule {
    fn new(suite: &Suite, secret: &[u8; 32], info: &[u8]) -> Result<Self, Unspecified> {
        let [kem, kdf, aead] = [suite.kem, KDF_HKDF_SHA256, suite.aead].map(u16::to_be_bytes);
        let id = [b"HPKE".as_slice(), &kem, &kdf, &aead].concat();
        // LabeledExtract without a salt, of public values.
        let hash = |label: &[u8], value: &[u8]| {
            let key = hmac::Key::new(hmac::HMAC_SHA256, &[0; 32]);
            hmac::sign(&key, &[VERSION, &id, label, value].concat())
        };
        let id_hash = hash(b"psk_id_hash", b"");
        let info_hash = hash(b"info_hash", info);
        let context = [&[MODE_BASE], id_hash.as_ref(), info_hash.as_ref()].concat();
        let secret = hkdf::Salt::new(hkdf::HKDF_SHA256, secret)
            .extract(&[VERSION, &id, b"secret".as_slice()].concat());
        let expand = |label: &[u8], out: &mut [u8]| {
            let length = u16::try_from(out.len()).map_err(|_| Unspecified)?.to_be_bytes();
            let info = [&length, VERSION, &id, label, &context];
            secret.expand(&info, Length(out.len()))?.fill(out)
        };
        let mut schedule = Self { key: Zeroizing::default(), nonce: [0; NONCE_LEN] };
        expand(b"key", &mut schedule.key[..])?;
        expand(b"base_nonce", &mut schedule.nonce)?;
        Ok(schedule)
    }
}

struct Length(usize);

impl hkdf::KeyType for Length {
    fn len(&self) -> usize {
        self.0
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::xwing::tests::{private_key, vectors};

    #[test]
    fn the_drafts_vector_comes_out() {
        let vectors = vectors();
        let vector = vectors.last().unwrap();
        let suite = Suite { aead: 3, cipher: &aead::CHACHA20_POLY1305, ..XWING };
        let secret = private_key(vector).decapsulate(&vector["ct"]).unwrap();
        let schedule = Schedule::new(&suite, &secret, &vector["info"]).unwrap();
        assert_eq!(schedule.key[..], vector["aead_key"][..]);
        assert_eq!(schedule.nonce[..], vector["base_nonce"][..]);
        let context = || Context::new(&suite, &secret, &vector["info"]).unwrap();
        assert_eq!(context().seal(&vector["aad"], &vector["plain"]).unwrap(), vector["sealed"]);
        assert_eq!(context().open(&vector["aad"], &vector["sealed"]).unwrap()[..], vector["plain"][..]);
    }

    /// The same key schedule over the other KEM: it opens the output of rustls.
    #[test]
    fn it_agrees_with_rustls() {
        use aws_lc_rs::agreement::{self, UnparsedPublicKey, X25519};
        use rustls::crypto::aws_lc_rs::hpke::DH_KEM_X25519_HKDF_SHA256_AES_256 as THEIRS;
        use rustls::crypto::hpke::{Hpke as _, HpkePublicKey};

        let private = agreement::PrivateKey::generate(&X25519).unwrap();
        let public = private.compute_public_key().unwrap().as_ref().to_vec();
        let (enc, sealed) = THEIRS.seal(b"info", b"aad", b"plain", &HpkePublicKey(public.clone())).unwrap();
        // DHKEM(X25519, HKDF-SHA256), RFC 9180, 4.1.
        let id = b"KEM\x00\x20";
        let theirs = UnparsedPublicKey::new(&X25519, &enc.0);
        let secret = agreement::agree(&private, theirs, Unspecified, |dh| {
            let prk =
                hkdf::Salt::new(hkdf::HKDF_SHA256, &[]).extract(&[VERSION, id, b"eae_prk", dh].concat());
            let mut secret = [0; 32];
            let info: [&[u8]; 6] = [&[0, 32], VERSION, id, b"shared_secret", &enc.0, &public];
            prk.expand(&info, Length(32))?.fill(&mut secret)?;
            Ok(secret)
        });
        let suite = Suite { kem: 0x20, ..XWING };
        let context = Context::new(&suite, &secret.unwrap(), b"info").unwrap();
        assert_eq!(context.open(b"aad", &sealed).unwrap()[..], *b"plain");
    }
}
