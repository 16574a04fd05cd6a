//! The private key of an identity, for `dimpl`, which expects to read it. It gets a number instead, and signatures
//! under that number.

use std::collections::HashMap;
use std::panic::AssertUnwindSafe;
use std::sync::atomic::{AtomicU64, Ordering::Relaxed};
use std::sync::{Arc, LazyLock, Mutex, MutexGuard};

use dimpl::DtlsCertificate;
use dimpl::crypto::{Buf, HashAlgorithm, KeyProvider, SignatureAlgorithm, SigningKey};
use dimpl::{CryptoError, CryptoOperation};
use rustls::SignatureScheme;
use rustls::sign::CertifiedKey;
use sgc_sync::lock;
use sgc_wire::CERT_BYTES_MAX;

static NEXT: AtomicU64 = AtomicU64::new(0);
static LENT: LazyLock<Mutex<HashMap<u64, Arc<CertifiedKey>>>> = LazyLock::new(Mutex::default);

fn lent() -> MutexGuard<'static, HashMap<u64, Arc<CertifiedKey>>> {
    lock(&LENT)
}

/// A registered signing key, for as long as this lives.
#[derive(Debug)]
pub(super) struct SigningKeyLease {
    number: u64,
    certificate: DtlsCertificate,
}

impl SigningKeyLease {
    /// Registers the key. Returns `None` if DTLS cannot use it, or the certificate is longer than the limit.
    pub(super) fn new(key: Arc<CertifiedKey>) -> Option<Self> {
        scheme(&key)?;
        let leaf = key.cert.first().filter(|leaf| leaf.len() <= CERT_BYTES_MAX)?.to_vec();
        let number = NEXT.fetch_add(1, Relaxed);
        lent().insert(number, key);
        let certificate = DtlsCertificate { certificate: leaf, private_key: number.to_be_bytes().to_vec() };
        Some(Self { number, certificate })
    }

    /// Returns the certificate, with the number of its key.
    pub(super) fn certificate(&self) -> DtlsCertificate {
        self.certificate.clone()
    }
}

impl Drop for SigningKeyLease {
    fn drop(&mut self) {
        lent().remove(&self.number);
    }
}

/// Returns the signature scheme of the key, if DTLS knows it.
pub(super) fn scheme(key: &CertifiedKey) -> Option<SignatureScheme> {
    let known = [SignatureScheme::ECDSA_NISTP256_SHA256, SignatureScheme::ECDSA_NISTP384_SHA384];
    key.key.choose_scheme(&known).map(|signer| signer.scheme())
}

/// Finds keys by their numbers.
#[derive(Debug)]
pub(super) struct Keys;

impl KeyProvider for Keys {
    fn load_private_key(&self, number: &[u8]) -> Result<Box<dyn SigningKey>, CryptoError> {
        let failed = CryptoError::OperationFailed(CryptoOperation::Sign);
        let number = number.try_into().map(u64::from_be_bytes).map_err(|_| failed.clone())?;
        let key = lent().get(&number).cloned().ok_or_else(|| failed.clone())?;
        let hash = match scheme(&key).ok_or(failed)? {
            SignatureScheme::ECDSA_NISTP384_SHA384 => HashAlgorithm::SHA384,
            _ => HashAlgorithm::SHA256,
        };
        Ok(Box::new(Signer { key: AssertUnwindSafe(key), hashes: [hash] }))
    }
}

#[derive(Debug)]
struct Signer {
    key: AssertUnwindSafe<Arc<CertifiedKey>>,
    hashes: [HashAlgorithm; 1],
}

impl SigningKey for Signer {
    fn sign(&mut self, data: &[u8], hash: HashAlgorithm, out: &mut Buf) -> Result<(), CryptoError> {
        let [key_hash] = self.hashes;
        if hash != key_hash {
            return Err(CryptoError::SigningKeyHashMismatch { key_hash, requested: hash });
        }
        let failed = CryptoError::OperationFailed(CryptoOperation::Sign);
        let signer = scheme(&self.key).and_then(|scheme| self.key.key.choose_scheme(&[scheme]));
        let signature = signer.and_then(|signer| signer.sign(data).ok()).ok_or(failed)?;
        out.clear();
        out.extend_from_slice(&signature);
        Ok(())
    }

    fn algorithm(&self) -> SignatureAlgorithm {
        SignatureAlgorithm::ECDSA
    }

    fn hash_algorithm(&self) -> HashAlgorithm {
        self.hashes[0]
    }

    fn supported_hash_algorithms(&self) -> &[HashAlgorithm] {
        &self.hashes
    }
}
