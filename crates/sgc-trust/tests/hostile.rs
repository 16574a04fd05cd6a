//! Files and certificates with random damage, from seeds: nothing panics, nothing forged is believed.
#![allow(clippy::unwrap_used, reason = "helpers of tests are tests")]

use std::sync::Arc;

use rand_chacha::ChaCha20Rng;
use rand_core::{RngCore as _, SeedableRng as _};
use rustls_pki_types::CertificateDer;
use sgc_trust::*;
use sgc_wire::UnixMillis;

const NOW: UnixMillis = UnixMillis(1_795_000_000_000);
const ROUNDS: usize = 3000;

/// One to four changes: bytes, cuts, repetitions.
fn damage(input: &[u8], rng: &mut ChaCha20Rng) -> Vec<u8> {
    let mut out = input.to_vec();
    for _ in 0..=rng.next_u32() % 4 {
        let at = rng.next_u32() as usize % out.len().max(1);
        match rng.next_u32() % 5 {
            0 => out.truncate(at),
            1 => drop(out.splice(at..at, input[..at.min(input.len())].iter().copied().take(40)).count()),
            2 => drop(out.drain(at..(at + 3).min(out.len())).count()),
            _ => {
                if let Some(byte) = out.get_mut(at) {
                    *byte = byte.wrapping_add(rng.next_u32() as u8);
                }
            }
        }
    }
    out
}

#[test]
fn damaged_files_and_certificates_never_panic() {
    let mut rng = ChaCha20Rng::seed_from_u64(7);
    let mut fleet = Fleet::create("acme".parse().unwrap(), NOW, &mut rng).unwrap();
    let request = EnrollRequest::new("arm-1".parse().unwrap(), NOW);
    let arm = fleet.enroll(&request, &mut rng).unwrap();
    fleet.rotate_secret(NOW, &mut rng).unwrap();
    let serial = Arc::clone(&arm.as_peer().cert.serial);
    let list = fleet.revocation_list_of(&[(serial, NOW)], 1, NOW).unwrap();
    let (identity, text, csr) = (arm.to_text(), fleet.to_text(), arm.csr());
    let mut keeper = Fleet::parse(&text).unwrap();
    for _ in 0..ROUNDS {
        let bad = |input: &[u8], rng: &mut ChaCha20Rng| damage(input, rng);
        if let Ok(read) = Identity::parse(&String::from_utf8_lossy(&bad(identity.as_bytes(), &mut rng))) {
            assert_eq!(read.node_id(), arm.node_id());
        }
        if let Ok(read) = Fleet::parse(&String::from_utf8_lossy(&bad(text.as_bytes(), &mut rng))) {
            assert!(read.nodes().eq(fleet.nodes()));
        }
        let _ = Membership::parse(&String::from_utf8_lossy(&bad(identity.as_bytes(), &mut rng)));
        let changed = bad(&list, &mut rng);
        assert!(changed == list || fleet.anchors().with_crl(&changed, NOW).is_err());
        let changed = bad(&arm.chain()[0], &mut rng);
        if changed != *arm.chain()[0] {
            let chain = [CertificateDer::from(changed.clone())];
            assert!(fleet.anchors().verify(&chain, NOW).is_err());
            let _ = TrustAnchors::new(chain.clone());
            let _ = Fleet::import("x".parse().unwrap(), chain[0].clone(), b"no key", NOW, &mut rng);
        }
        let changed = bad(&csr, &mut rng);
        let made = keeper.enroll_csr(&changed, &EnrollRequest { again: true, ..request.clone() }, &mut rng);
        assert_eq!(made.is_ok(), changed == csr);
    }
}
