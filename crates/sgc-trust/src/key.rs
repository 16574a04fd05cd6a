//! P-256 keys made from the caller's random generator, so that a seeded test fleet is the same on each run.
//!
//! It holds keys only while they are made and while a CA signs; [`crate::Identity`] signs with what it read.

use aws_lc_rs::rand::SystemRandom;
use aws_lc_rs::signature::{ECDSA_P256_SHA256_ASN1_SIGNING, EcdsaKeyPair, KeyPair as _};
use rand_core::CryptoRng;
use zeroize::Zeroizing;

const POINT_BYTES: usize = 65;

/// Everything of an ECPrivateKey (RFC 5915) before the scalar, in a PKCS #8 (RFC 5958) wrapper for P-256.
const PKCS8_HEAD: [u8; 36] = [
    0x30, 0x81, 0x87, 0x02, 0x01, 0x00, 0x30, 0x13, 0x06, 0x07, 0x2a, 0x86, 0x48, 0xce, 0x3d, 0x02, 0x01,
    0x06, 0x08, 0x2a, 0x86, 0x48, 0xce, 0x3d, 0x03, 0x01, 0x07, 0x04, 0x6d, 0x30, 0x6b, 0x02, 0x01, 0x01,
    0x04, 0x20,
];
/// What stands between the scalar and the public point.
const PKCS8_POINT: [u8; 5] = [0xa1, 0x44, 0x03, 0x42, 0x00];
/// A bare ECPrivateKey with the curve and without the point, around the scalar.
const SEC1_HEAD: [u8; 7] = [0x30, 0x31, 0x02, 0x01, 0x01, 0x04, 0x20];
const SEC1_TAIL: [u8; 12] = [0xa0, 0x0a, 0x06, 0x08, 0x2a, 0x86, 0x48, 0xce, 0x3d, 0x03, 0x01, 0x07];

/// A P-256 key pair that rcgen can sign with. Unlike rcgen's own it leaves no copy of the key in plain memory.
pub(crate) struct P256Key {
    pair: EcdsaKeyPair,
    pkcs8: Zeroizing<Vec<u8>>,
}

impl P256Key {
    /// A new key.
    pub(crate) fn generate(rng: &mut impl CryptoRng) -> Self {
        let mut scalar = Zeroizing::new([0; 32]);
        loop {
            rng.fill_bytes(&mut *scalar);
            // Refused are zero and what exceeds the group order: once in 2^32 draws.
            if let Some(key) = Self::from_scalar(&scalar) {
                return key;
            }
        }
    }

    /// A key that was stored.
    pub(crate) fn from_pkcs8(pkcs8: &[u8]) -> Option<Self> {
        let pair = EcdsaKeyPair::from_private_key_der(&ECDSA_P256_SHA256_ASN1_SIGNING, pkcs8).ok()?;
        Some(Self { pair, pkcs8: Zeroizing::new(pkcs8.to_vec()) })
    }

    /// For storing.
    pub(crate) fn pkcs8(&self) -> &[u8] {
        &self.pkcs8
    }

    fn from_scalar(scalar: &[u8; 32]) -> Option<Self> {
        let mut sec1 = Zeroizing::new(Vec::with_capacity(SEC1_HEAD.len() + 32 + SEC1_TAIL.len()));
        sec1.extend_from_slice(&SEC1_HEAD);
        sec1.extend_from_slice(scalar);
        sec1.extend_from_slice(&SEC1_TAIL);
        let pair = EcdsaKeyPair::from_private_key_der(&ECDSA_P256_SHA256_ASN1_SIGNING, &sec1).ok()?;
        let length = PKCS8_HEAD.len() + 32 + PKCS8_POINT.len() + POINT_BYTES;
        let mut pkcs8 = Zeroizing::new(Vec::with_capacity(length));
        pkcs8.extend_from_slice(&PKCS8_HEAD);
        pkcs8.extend_from_slice(scalar);
        pkcs8.extend_from_slice(&PKCS8_POINT);
        pkcs8.extend_from_slice(pair.public_key().as_ref());
        Some(Self { pair, pkcs8 })
    }
}

impl rcgen::PublicKeyData for P256Key {
    fn der_bytes(&self) -> &[u8] {
        self.pair.public_key().as_ref()
    }

    fn algorithm(&self) -> &'static rcgen::SignatureAlgorithm {
        &rcgen::PKCS_ECDSA_P256_SHA256
    }
}

impl rcgen::SigningKey for P256Key {
    fn sign(&self, message: &[u8]) -> Result<Vec<u8>, rcgen::Error> {
        // The generator only blinds here; aws-lc has no other way to be called.
        let signature = self.pair.sign(&SystemRandom::new(), message);
        signature.map(|s| s.as_ref().to_vec()).map_err(|_| rcgen::Error::RingUnspecified)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use rand_chacha::ChaCha20Rng;
    use rand_core::SeedableRng as _;
    use rcgen::PublicKeyData as _;

    #[test]
    fn keys_follow_the_seed_and_survive_storing() {
        let key = P256Key::generate(&mut ChaCha20Rng::seed_from_u64(1));
        let same = P256Key::generate(&mut ChaCha20Rng::seed_from_u64(1));
        let other = P256Key::generate(&mut ChaCha20Rng::seed_from_u64(2));
        assert_eq!(key.der_bytes(), same.der_bytes());
        assert_ne!(key.der_bytes(), other.der_bytes());
        assert_eq!(key.pkcs8().len(), 138);
        assert_eq!(P256Key::from_pkcs8(key.pkcs8()).unwrap().der_bytes(), key.der_bytes());
    }

    #[test]
    fn impossible_scalars_are_refused() {
        assert!(P256Key::from_scalar(&[0; 32]).is_none());
        assert!(P256Key::from_scalar(&[0xff; 32]).is_none());
        assert!(P256Key::from_pkcs8(b"no key").is_none());
    }
}
