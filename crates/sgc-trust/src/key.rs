//! Private keys: new P-256 ones made from the caller's random generator, so that a seeded test fleet is the same on
//! each run, and stored ones of every kind that certificates may have.
//!
//! They sign certificates, requests and lists; [`crate::Identity`] signs for a running node.

use aws_lc_rs::rand::SystemRandom;
use aws_lc_rs::signature::{
    ECDSA_P256_SHA256_ASN1_SIGNING, ECDSA_P384_SHA384_ASN1_SIGNING, EcdsaKeyPair, Ed25519KeyPair,
    KeyPair as _, RSA_PKCS1_SHA256, RsaKeyPair,
};
use rand_core::CryptoRng;
use zeroize::Zeroizing;

const POINT_BYTES: usize = 65;

/// Everything of an ECPrivateKey (RFC 5915) before the scalar, in a PKCS #8 (RFC 5958) wrapper for P-256.
const PKCS8_HEAD: [u8; 36] = [
    0x30, 0x81, 0x87, 0x02, 0x01, 0x00, 0x30, 0x13, 0x06, 0x07, 0x2a, 0x86, 0x48, 0xce, 0x3d, 0x02, 0x01,
    0x06, 0x08, 0x2a, 0x86, 0x48, 0xce, 0x3d, 0x03, 0x01, 0x07, 0x04, 0x6d, 0x30, 0x6b, 0x02, 0x01, 0x01,
    0x04, 0x20,
];
/// Bytes between the scalar and the public point.
const PKCS8_POINT: [u8; 5] = [0xa1, 0x44, 0x03, 0x42, 0x00];
/// A bare ECPrivateKey with the curve and without the point, around the scalar.
const SEC1_HEAD: [u8; 7] = [0x30, 0x31, 0x02, 0x01, 0x01, 0x04, 0x20];
const SEC1_TAIL: [u8; 12] = [0xa0, 0x0a, 0x06, 0x08, 0x2a, 0x86, 0x48, 0xce, 0x3d, 0x03, 0x01, 0x07];

/// Shortest RSA key that is accepted, bytes: 2048 bits, as in every verifier here.
const RSA_BYTES_MIN: usize = 256;

/// A key pair that rcgen can sign with. Unlike rcgen's own it leaves no copy of the key in plain memory.
pub(crate) struct Key {
    pair: Pair,
    pkcs8: Zeroizing<Vec<u8>>,
}

enum Pair {
    P256(EcdsaKeyPair),
    P384(EcdsaKeyPair),
    Ed25519(Ed25519KeyPair),
    Rsa(RsaKeyPair),
}

impl Key {
    /// Makes a P-256 key, which every transport can use.
    pub(crate) fn generate(rng: &mut impl CryptoRng) -> Self {
        Self::generate_with_scalar(rng).0
    }

    /// Makes a P-256 key, and returns it with its scalar, from which [`Key::from_scalar`] makes it again.
    pub(crate) fn generate_with_scalar(rng: &mut impl CryptoRng) -> (Self, Zeroizing<[u8; 32]>) {
        let mut scalar = Zeroizing::new([0; 32]);
        loop {
            rng.fill_bytes(&mut *scalar);
            // Zero and numbers above the group order are refused: once in 2^32 draws.
            if let Some(key) = Self::from_scalar(&scalar) {
                return (key, scalar);
            }
        }
    }

    /// Reads a stored key: P-256, P-384, Ed25519, or RSA of 2048 bits and more.
    pub(crate) fn from_pkcs8(pkcs8: &[u8]) -> Option<Self> {
        let ecdsa = |algorithm| EcdsaKeyPair::from_pkcs8(algorithm, pkcs8).ok();
        let pair = None
            .or_else(|| ecdsa(&ECDSA_P256_SHA256_ASN1_SIGNING).map(Pair::P256))
            .or_else(|| ecdsa(&ECDSA_P384_SHA384_ASN1_SIGNING).map(Pair::P384))
            .or_else(|| Ed25519KeyPair::from_pkcs8(pkcs8).ok().map(Pair::Ed25519))
            .or_else(|| {
                let pair = RsaKeyPair::from_pkcs8(pkcs8).ok()?;
                (pair.public_modulus_len() >= RSA_BYTES_MIN).then_some(Pair::Rsa(pair))
            })?;
        Some(Self { pair, pkcs8: Zeroizing::new(pkcs8.to_vec()) })
    }

    /// Returns the key for storing.
    pub(crate) fn pkcs8(&self) -> &[u8] {
        &self.pkcs8
    }

    /// Returns the P-256 key with this scalar; `None` if there is none.
    pub(crate) fn from_scalar(scalar: &[u8; 32]) -> Option<Self> {
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
        Some(Self { pair: Pair::P256(pair), pkcs8 })
    }
}

impl rcgen::PublicKeyData for Key {
    fn der_bytes(&self) -> &[u8] {
        match &self.pair {
            Pair::P256(pair) | Pair::P384(pair) => pair.public_key().as_ref(),
            Pair::Ed25519(pair) => pair.public_key().as_ref(),
            Pair::Rsa(pair) => pair.public_key().as_ref(),
        }
    }

    fn algorithm(&self) -> &'static rcgen::SignatureAlgorithm {
        match &self.pair {
            Pair::P256(_) => &rcgen::PKCS_ECDSA_P256_SHA256,
            Pair::P384(_) => &rcgen::PKCS_ECDSA_P384_SHA384,
            Pair::Ed25519(_) => &rcgen::PKCS_ED25519,
            Pair::Rsa(_) => &rcgen::PKCS_RSA_SHA256,
        }
    }
}

impl rcgen::SigningKey for Key {
    fn sign(&self, message: &[u8]) -> Result<Vec<u8>, rcgen::Error> {
        // The generator only blinds here; aws-lc has no other way to be called.
        let rng = SystemRandom::new();
        let signature = match &self.pair {
            Pair::P256(pair) | Pair::P384(pair) => pair.sign(&rng, message).map(|s| s.as_ref().to_vec()),
            Pair::Ed25519(pair) => Ok(pair.sign(message).as_ref().to_vec()),
            Pair::Rsa(pair) => {
                let mut signature = vec![0; pair.public_modulus_len()];
                pair.sign(&RSA_PKCS1_SHA256, &rng, message, &mut signature).map(|()| signature)
            }
        };
        signature.map_err(|_| rcgen::Error::RingUnspecified)
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
        let key = Key::generate(&mut ChaCha20Rng::seed_from_u64(1));
        let same = Key::generate(&mut ChaCha20Rng::seed_from_u64(1));
        let other = Key::generate(&mut ChaCha20Rng::seed_from_u64(2));
        assert_eq!(key.der_bytes(), same.der_bytes());
        assert_ne!(key.der_bytes(), other.der_bytes());
        assert_eq!(key.pkcs8().len(), 138);
        assert_eq!(Key::from_pkcs8(key.pkcs8()).unwrap().der_bytes(), key.der_bytes());
    }

    #[test]
    fn impossible_scalars_are_refused() {
        assert!(Key::from_scalar(&[0; 32]).is_none());
        assert!(Key::from_scalar(&[0xff; 32]).is_none());
        assert!(Key::from_pkcs8(b"no key").is_none());
    }
}
