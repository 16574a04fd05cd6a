//! X-Wing (draft-connolly-cfrg-xwing-kem): X25519 and ML-KEM-768 joined, so that a secret is safe as long as one of the
//! two is.
//!
//! AWS-LC has both algorithms; this module combines them. Private keys live for one join, are never written down, and
//! so the two algorithms make them, not the draft's seed. AWS-LC clears them when it frees them.

use aws_lc_rs::agreement::{self, UnparsedPublicKey, X25519};
use aws_lc_rs::digest;
use aws_lc_rs::error::Unspecified;
use aws_lc_rs::kem::{self, ML_KEM_768};
use zeroize::Zeroizing;

/// Length of a public key.
pub(crate) const PUBLIC_BYTES: usize = KEM_PUBLIC_BYTES + CURVE_BYTES;
/// Length of an encapsulated secret.
pub(crate) const ENC_BYTES: usize = KEM_ENC_BYTES + CURVE_BYTES;

const KEM_PUBLIC_BYTES: usize = 1184;
const KEM_ENC_BYTES: usize = 1088;
const KEM_PRIVATE_BYTES: usize = 2400;
/// Offset of the public key in a private one.
const KEM_PUBLIC_AT: usize = 1152;
const CURVE_BYTES: usize = 32;
const LABEL: &[u8; 6] = br"\.//^\";

/// The secret of both sides.
pub(crate) type SharedSecret = Zeroizing<[u8; 32]>;

/// A key that opens secrets encapsulated to its public key.
pub(crate) struct PrivateKey {
    kem: kem::DecapsulationKey,
    curve: agreement::PrivateKey,
    curve_public: [u8; CURVE_BYTES],
}

impl PrivateKey {
    /// Makes a key and its public key. It fails only where the system has no randomness.
    pub(crate) fn generate() -> Result<(Self, Vec<u8>), Unspecified> {
        let kem = kem::DecapsulationKey::generate(&ML_KEM_768)?;
        let mut public = kem.encapsulation_key()?.key_bytes()?.as_ref().to_vec();
        let key = Self::new(kem, agreement::PrivateKey::generate(&X25519)?)?;
        public.extend_from_slice(&key.curve_public);
        Ok((key, public))
    }

    /// Reads a given key and returns it with its public key: the decapsulation key of ML-KEM-768 (FIPS 203, 7.1), which
    /// contains its encapsulation key, and X25519's.
    pub(crate) fn from_bytes(bytes: &[u8]) -> Option<(Self, Vec<u8>)> {
        let (kem, curve) = bytes.split_at_checked(KEM_PRIVATE_BYTES)?;
        let public = kem.get(KEM_PUBLIC_AT..KEM_PUBLIC_AT + KEM_PUBLIC_BYTES)?;
        let kem = kem::DecapsulationKey::new(&ML_KEM_768, kem).ok()?;
        let key = Self::new(kem, agreement::PrivateKey::from_private_key(&X25519, curve).ok()?).ok()?;
        let public = [public, &key.curve_public].concat();
        Some((key, public))
    }

    /// Returns the secret in `enc`. An altered secret, or one for another key, yields some other secret; a malformed
    /// one yields `None`.
    pub(crate) fn decapsulate(&self, enc: &[u8]) -> Option<SharedSecret> {
        if enc.len() != ENC_BYTES {
            return None;
        }
        let (kem_enc, curve_enc) = enc.split_at_checked(KEM_ENC_BYTES)?;
        let kem_secret = self.kem.decapsulate(kem_enc.into()).ok()?;
        combine(kem_secret.as_ref(), &self.curve, curve_enc, curve_enc, &self.curve_public)
    }

    fn new(kem: kem::DecapsulationKey, curve: agreement::PrivateKey) -> Result<Self, Unspecified> {
        let curve_public = curve.compute_public_key()?.as_ref().try_into().map_err(|_| Unspecified)?;
        Ok(Self { kem, curve, curve_public })
    }
}

/// Makes a secret, encapsulated to a public key; `None` if the public key is malformed.
pub(crate) fn encapsulate(public: &[u8]) -> Option<(Vec<u8>, SharedSecret)> {
    let (kem_public, curve_public) = public.split_at_checked(KEM_PUBLIC_BYTES)?;
    if curve_public.len() != CURVE_BYTES {
        return None;
    }
    let kem = kem::EncapsulationKey::new(&ML_KEM_768, kem_public).ok()?;
    let (kem_enc, kem_secret) = kem.encapsulate().ok()?;
    let curve = agreement::PrivateKey::generate(&X25519).ok()?;
    let curve_enc = curve.compute_public_key().ok()?;
    let secret = combine(kem_secret.as_ref(), &curve, curve_public, curve_enc.as_ref(), curve_public)?;
    Some(([kem_enc.as_ref(), curve_enc.as_ref()].concat(), secret))
}

/// The draft's combiner, 5.3. `None` where X25519 gives zero, which the draft lets pass and RFC 9180 (7.1.4) does not.
fn combine(
    kem_secret: &[u8],
    ours: &agreement::PrivateKey,
    theirs: &[u8],
    curve_enc: &[u8],
    curve_public: &[u8],
) -> Option<SharedSecret> {
    let theirs = UnparsedPublicKey::new(&X25519, theirs);
    agreement::agree(ours, theirs, Unspecified, |curve_secret| {
        let mut hash = digest::Context::new(&digest::SHA3_256);
        for part in [kem_secret, curve_secret, curve_enc, curve_public, LABEL] {
            hash.update(part);
        }
        let mut secret = SharedSecret::default();
        secret.copy_from_slice(hash.finish().as_ref());
        Ok(secret)
    })
    .ok()
}

#[cfg(test)]
pub(crate) mod tests {
    use std::collections::BTreeMap;

    use super::*;

    /// Returns the blocks of `tests/vectors/xwing.txt`.
    pub(crate) fn vectors() -> Vec<BTreeMap<&'static str, Vec<u8>>> {
        let mut blocks: Vec<BTreeMap<_, _>> = Vec::new();
        for line in include_str!("../tests/vectors/xwing.txt").lines() {
            match line.split_once(" = ") {
                Some((name, hex)) => {
                    if name == "sk_m_s" {
                        blocks.push(BTreeMap::new());
                    }
                    let byte = |i| u8::from_str_radix(&hex[2 * i..2 * i + 2], 16).unwrap();
                    blocks.last_mut().unwrap().insert(name, (0..hex.len() / 2).map(byte).collect());
                }
                None => assert!(line.is_empty() || line.starts_with('#')),
            }
        }
        blocks
    }

    pub(crate) fn private_key(vector: &BTreeMap<&str, Vec<u8>>) -> PrivateKey {
        let kem_public = &vector["pk"][..KEM_PUBLIC_BYTES];
        let hash = digest::digest(&digest::SHA3_256, kem_public);
        let kem = [&vector["sk_m_s"], kem_public, hash.as_ref(), &vector["sk_m_z"]].concat();
        let (key, public) = PrivateKey::from_bytes(&[kem, vector["sk_x"].clone()].concat()).unwrap();
        assert_eq!(public, vector["pk"]);
        key
    }

    #[test]
    fn the_drafts_vectors_come_out() {
        let vectors = vectors();
        assert_eq!(vectors.len(), 4);
        for vector in &vectors {
            let key = private_key(vector);
            assert_eq!(key.curve_public, vector["pk"][KEM_PUBLIC_BYTES..]);
            assert_eq!(key.decapsulate(&vector["ct"]).unwrap()[..], vector["ss"][..]);
        }
    }

    #[test]
    fn a_secret_encapsulated_to_a_published_key_opens_with_it() {
        for vector in &vectors() {
            let (enc, secret) = encapsulate(&vector["pk"]).unwrap();
            assert_eq!(private_key(vector).decapsulate(&enc).unwrap(), secret);
        }
    }

    #[test]
    fn fresh_keys_open_what_is_theirs_and_nothing_altered() {
        let (key, public) = PrivateKey::generate().unwrap();
        let (other, _) = PrivateKey::generate().unwrap();
        let (enc, secret) = encapsulate(&public).unwrap();
        assert_eq!((public.len(), enc.len()), (PUBLIC_BYTES, ENC_BYTES));
        assert_eq!(key.decapsulate(&enc).unwrap(), secret);
        assert_ne!(other.decapsulate(&enc).unwrap(), secret);
        for at in [0, KEM_ENC_BYTES - 1, KEM_ENC_BYTES, ENC_BYTES - 2] {
            let mut altered = enc.clone();
            altered[at] ^= 1;
            assert_ne!(key.decapsulate(&altered), Some(secret.clone()), "byte {at}");
        }
    }

    #[test]
    fn malformed_keys_and_secrets_are_refused() {
        let (key, public) = PrivateKey::generate().unwrap();
        let (enc, _) = encapsulate(&public).unwrap();
        for bytes in [&enc[..0], &enc[..ENC_BYTES - 1], &[&enc[..], &[0]].concat()] {
            assert!(key.decapsulate(bytes).is_none());
        }
        for bytes in [&public[..0], &public[..PUBLIC_BYTES - 1], &[&public[..], &[0]].concat()] {
            assert!(encapsulate(bytes).is_none());
        }
        // A coefficient that is not below the modulus (FIPS 203, 7.2).
        let beyond = [&[0xff, 0xff, 0xff], &public[3..]].concat();
        assert!(encapsulate(&beyond).is_none());
        // A point of small order: X25519 would give zero to everyone.
        let zero = [&public[..KEM_PUBLIC_BYTES], &[0; CURVE_BYTES]].concat();
        assert!(encapsulate(&zero).is_none());
        let zero = [&enc[..KEM_ENC_BYTES], &[0; CURVE_BYTES]].concat();
        assert!(key.decapsulate(&zero).is_none());
    }
}
