//! Identity and fleet files, invitations, revocation lists, certificate chains and requests: no input panics.
use std::sync::OnceLock;

use rand_chacha::ChaCha20Rng;
use rand_core::SeedableRng;
use rustls_pki_types::CertificateDer;
use sgc_trust::{EnrollRequest, Fleet, Identity, Invitation, Membership, TrustAnchors, pem_contents};
use sgc_wire::UnixMillis;

const NOW: UnixMillis = UnixMillis(1_795_000_000_000);

fn fleet() -> &'static Fleet {
    static FLEET: OnceLock<Fleet> = OnceLock::new();
    FLEET.get_or_init(|| {
        Fleet::create("acme".parse().unwrap(), NOW, &mut ChaCha20Rng::seed_from_u64(1)).unwrap()
    })
}

/// Runs one input of the target.
pub fn run(input: &[u8]) {
    let Some((which, input)) = input.split_first() else { return };
    let text = || String::from_utf8_lossy(input);
    match which % 7 {
        0 => drop(Identity::parse(&text())),
        1 => {
            drop(Membership::parse(&text()));
            if let Ok(invitation) = Invitation::parse(&text()) {
                drop(invitation.identity(&mut ChaCha20Rng::seed_from_u64(3)));
            }
        }
        2 => drop(Fleet::parse(&text())),
        3 => drop(pem_contents(&text(), &["CERTIFICATE"])),
        4 => drop(fleet().anchors().with_crl(input, NOW)),
        5 => {
            let chain = [CertificateDer::from(input)];
            drop(fleet().anchors().verify(&chain, NOW));
            drop(TrustAnchors::new(chain.map(CertificateDer::into_owned)));
        }
        _ => {
            let rng = &mut ChaCha20Rng::seed_from_u64(2);
            let mut fleet = Fleet::create("acme".parse().unwrap(), NOW, rng).unwrap();
            drop(fleet.enroll_csr(input, &EnrollRequest::new("arm-1".parse().unwrap(), NOW), rng));
        }
    }
}
