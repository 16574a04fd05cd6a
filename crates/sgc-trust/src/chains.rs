//! Chains that were verified before. Every advertisement and join of a node repeats its chain, and verifying the chain
//! takes as long as verifying the signed body.
//!
//! The table belongs to one value of [`crate::TrustAnchors`]: other CAs or newer revocation lists are another value,
//! with an empty table. Refusals are not remembered. The table affects only the time spent.

use std::collections::{BTreeMap, VecDeque};
use std::sync::{Mutex, MutexGuard};

use aws_lc_rs::digest;
use rustls_pki_types::CertificateDer;
use sgc_sync::lock;
use sgc_wire::UnixMillis;

use crate::peer::VerifiedPeer;
use crate::x509::Validity;

/// Most chains known of one set of CAs, some 600 bytes each. The oldest goes first.
pub(crate) const CHAINS_KNOWN_MAX: usize = 16_384;

/// Peers by the chains that they were verified with.
#[derive(Default)]
pub(crate) struct KnownChains(Mutex<ChainTable>);

#[derive(Default)]
struct ChainTable {
    peers: BTreeMap<ChainHash, KnownPeer>,
    /// Chains, the oldest first.
    order: VecDeque<ChainHash>,
}

struct KnownPeer {
    peer: VerifiedPeer,
    /// Time in which every certificate from the leaf to the CA is valid.
    validity: Validity,
}

/// A chain, by the SHA-256 of its certificates, each with its length in front.
#[derive(Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
pub(crate) struct ChainHash([u8; 32]);

impl ChainHash {
    pub(crate) fn from_chain(chain: &[CertificateDer<'_>]) -> Self {
        let mut context = digest::Context::new(&digest::SHA256);
        for certificate in chain {
            context.update(&(certificate.len() as u64).to_be_bytes());
            context.update(certificate);
        }
        let mut hash = [0; 32];
        hash.copy_from_slice(context.finish().as_ref());
        Self(hash)
    }
}

impl KnownChains {
    /// Returns the peer of a chain that was verified before and is still valid.
    pub(crate) fn find(&self, chain: &ChainHash, now: UnixMillis) -> Option<VerifiedPeer> {
        let known = self.lock();
        let known = known.peers.get(chain)?;
        known.validity.contains(now).then(|| known.peer.clone())
    }

    /// Remembers a peer whose chain was verified.
    pub(crate) fn remember(&self, chain: ChainHash, peer: VerifiedPeer, validity: Validity) {
        let mut known = self.lock();
        let ChainTable { peers, order } = &mut *known;
        if peers.insert(chain, KnownPeer { peer, validity }).is_none() {
            order.push_back(chain);
        }
        if order.len() > CHAINS_KNOWN_MAX
            && let Some(oldest) = order.pop_front()
        {
            peers.remove(&oldest);
        }
    }

    fn lock(&self) -> MutexGuard<'_, ChainTable> {
        lock(&self.0)
    }
}

#[cfg(test)]
mod tests {
    use rand_chacha::ChaCha20Rng;
    use rand_core::SeedableRng as _;
    use rcgen::{BasicConstraints, CertificateParams, IsCa, Issuer, KeyPair, SanType, date_time_ymd};

    use super::*;
    use crate::{CertError, EnrollRequest, Fleet, Identity, TrustAnchors};

    /// 2026-11-18.
    const NOW: UnixMillis = UnixMillis(1_795_000_000_000);
    const DAY: u64 = 86_400_000;

    fn rng(seed: u64) -> ChaCha20Rng {
        ChaCha20Rng::seed_from_u64(seed)
    }

    fn fleet(seed: u64) -> Fleet {
        Fleet::create("acme".parse().unwrap(), NOW, &mut rng(seed)).unwrap()
    }

    fn enroll(fleet: &Fleet, node: &str) -> Identity {
        // The serial number is drawn too: each node has its own.
        let seed = node.bytes().map(u64::from).sum();
        fleet.issue(&EnrollRequest::new(node.parse().unwrap(), NOW), &mut rng(seed)).unwrap()
    }

    fn count(anchors: &TrustAnchors) -> usize {
        anchors.chains.lock().order.len()
    }

    fn is_known(anchors: &TrustAnchors, chain: &[CertificateDer<'_>], now: UnixMillis) -> bool {
        anchors.chains.find(&ChainHash::from_chain(chain), now).is_some()
    }

    #[test]
    fn a_chain_is_known_once_it_was_verified_and_gives_the_same_peer() {
        let fleet = fleet(1);
        let (anchors, arm, desk) = (fleet.anchors(), enroll(&fleet, "arm-1"), enroll(&fleet, "desk"));
        let anchors = TrustAnchors::new(anchors.certificates().cloned()).unwrap();
        assert!(!is_known(&anchors, arm.chain(), NOW));
        let first = anchors.verify(arm.chain(), NOW).unwrap();
        assert!(is_known(&anchors, arm.chain(), NOW) && !is_known(&anchors, desk.chain(), NOW));
        let second = anchors.clone().verify(arm.chain(), NOW).unwrap();
        assert_eq!(format!("{first:?}"), format!("{second:?}"));
        assert_eq!(count(&anchors), 1, "clones share");
        assert_eq!(anchors.verify(desk.chain(), NOW).unwrap().node_id, desk.node_id());
        assert_eq!(count(&anchors), 2);
    }

    #[test]
    fn a_known_chain_ends_with_its_certificate_to_the_second() {
        let fleet = fleet(1);
        let arm = enroll(&fleet, "arm-1");
        let anchors = fleet.anchors();
        let peer = anchors.verify(arm.chain(), NOW).unwrap();
        assert!(is_known(anchors, arm.chain(), NOW));
        assert!(anchors.verify(arm.chain(), peer.not_after).is_ok());
        let after = anchors.verify(arm.chain(), UnixMillis(peer.not_after.0 + 1000));
        assert!(matches!(after, Err(CertError::Expired { .. })), "{after:?}");
        assert!(anchors.verify(arm.chain(), peer.not_before).is_ok());
        let before = anchors.verify(arm.chain(), UnixMillis(peer.not_before.0 - 1));
        assert!(matches!(before, Err(CertError::NotYetValid { .. })), "{before:?}");
        assert!(anchors.verify(arm.chain(), NOW).is_ok(), "it holds in between, as before");
    }

    #[test]
    fn a_known_chain_ends_with_its_intermediate_and_with_its_ca() {
        let spans = [
            // CA, intermediate, leaf: the years until which they are valid.
            [2040, 2028, 2035],
            [2028, 2040, 2035],
        ];
        for [ca_until, intermediate_until, leaf_until] in spans {
            let (anchors, chain) = made(ca_until, intermediate_until, leaf_until);
            anchors.verify(&chain, NOW).unwrap();
            assert!(is_known(&anchors, &chain, NOW));
            let later = UnixMillis(NOW.0 + 3 * 365 * DAY);
            let error = anchors.verify(&chain, later).unwrap_err();
            assert!(error.is_expiry(), "{error}");
        }
    }

    #[test]
    fn a_revoked_chain_is_not_known_any_more() {
        let fleet = fleet(1);
        let (arm, desk) = (enroll(&fleet, "arm-1"), enroll(&fleet, "desk"));
        let before = fleet.anchors();
        before.verify(arm.chain(), NOW).unwrap();
        let serial = arm.as_peer().cert.serial.clone();
        let list = fleet.revocation_list_of(&[(serial, NOW)], 1, NOW).unwrap();
        let by_list = before.with_crl(&list, NOW).unwrap().unwrap();
        let by_peer = before.with_lists_of(&by_list);
        for after in [by_list, by_peer] {
            let refused = after.verify(arm.chain(), NOW);
            assert!(matches!(refused, Err(CertError::Revoked { .. })), "{refused:?}");
            assert!(!is_known(&after, arm.chain(), NOW));
            assert!(after.verify(desk.chain(), NOW).is_ok());
        }
    }

    #[test]
    fn a_chain_verified_under_one_ca_is_unknown_under_another() {
        let (ours, theirs) = (fleet(1), fleet(2));
        let arm = enroll(&ours, "arm-1");
        ours.anchors().verify(arm.chain(), NOW).unwrap();
        let refused = theirs.anchors().verify(arm.chain(), NOW);
        assert!(matches!(refused, Err(CertError::UnknownIssuer)), "{refused:?}");
        let both = theirs.anchors().with_anchors([ours.ca_certificate().clone()]).unwrap();
        assert!(!is_known(&both, arm.chain(), NOW));
        both.verify(arm.chain(), NOW).unwrap();
        let without = TrustAnchors::new([theirs.ca_certificate().clone()]).unwrap();
        assert!(without.verify(arm.chain(), NOW).is_err());
    }

    #[test]
    fn no_other_chain_passes_for_a_known_one() {
        let (anchors, chain) = made(2040, 2040, 2035);
        anchors.verify(&chain, NOW).unwrap();
        for certificate in 0..chain.len() {
            for byte in 0..chain[certificate].len() {
                let mut bad: Vec<Vec<u8>> = chain.iter().map(|c| c.to_vec()).collect();
                bad[certificate][byte] ^= 1;
                let bad: Vec<_> = bad.into_iter().map(CertificateDer::from).collect();
                assert!(!is_known(&anchors, &bad, NOW), "byte {byte} of certificate {certificate}");
            }
        }
        assert!(!is_known(&anchors, &chain[..1], NOW));
        // The same bytes, cut in another place.
        let all = [&chain[0][..], &chain[1][..]].concat();
        let (head, tail) = all.split_at(chain[0].len() + 1);
        assert!(!is_known(
            &anchors,
            &[CertificateDer::from_slice(head), CertificateDer::from_slice(tail)],
            NOW
        ));
    }

    #[test]
    fn a_chain_with_certificates_that_it_does_not_need_is_believed_and_not_remembered() {
        let fleet = fleet(1);
        let (arm, desk) = (enroll(&fleet, "arm-1"), enroll(&fleet, "desk"));
        let longer = [arm.chain(), desk.chain()].concat();
        let anchors = TrustAnchors::new([fleet.ca_certificate().clone()]).unwrap();
        assert_eq!(anchors.verify(&longer, NOW).unwrap().node_id, arm.node_id());
        assert_eq!(count(&anchors), 0);
    }

    #[test]
    fn refusals_are_not_remembered() {
        let (ours, theirs) = (fleet(1), fleet(2));
        assert!(ours.anchors().verify(enroll(&theirs, "arm-1").chain(), NOW).is_err());
        assert_eq!(count(ours.anchors()), 0);
    }

    #[test]
    fn the_oldest_go_when_there_are_too_many() {
        let fleet = fleet(1);
        let peer = enroll(&fleet, "arm-1").as_peer().clone();
        let validity = Validity { not_before: peer.not_before, not_after: peer.not_after };
        let known = KnownChains::default();
        let hash = |n: usize| ChainHash::from_chain(&[CertificateDer::from(n.to_be_bytes().to_vec())]);
        for n in 0..CHAINS_KNOWN_MAX + 10 {
            known.remember(hash(n), peer.clone(), validity);
            known.remember(hash(n), peer.clone(), validity);
        }
        let ChainTable { peers, order } = &*known.lock();
        assert_eq!((peers.len(), order.len()), (CHAINS_KNOWN_MAX, CHAINS_KNOWN_MAX));
        let is_there = |n: usize| peers.contains_key(&hash(n));
        assert!(!is_there(9) && is_there(10) && is_there(CHAINS_KNOWN_MAX + 9));
    }

    /// Makes a chain of a leaf and an intermediate, which with their CA are valid until the ends of these years.
    fn made(
        ca_until: i32,
        intermediate_until: i32,
        leaf_until: i32,
    ) -> (TrustAnchors, Vec<CertificateDer<'static>>) {
        let authority = |name: &str, until| {
            let mut params = CertificateParams::default();
            params.distinguished_name.push(rcgen::DnType::CommonName, name);
            params.is_ca = IsCa::Ca(BasicConstraints::Unconstrained);
            (params.not_before, params.not_after) = (date_time_ymd(2026, 1, 1), date_time_ymd(until, 12, 31));
            (params, KeyPair::generate().unwrap())
        };
        let (ca, ca_key) = authority("ca", ca_until);
        let ca_der = ca.self_signed(&ca_key).unwrap().der().clone();
        let ca = Issuer::new(ca, ca_key);
        let (intermediate, key) = authority("intermediate", intermediate_until);
        let intermediate_der = intermediate.signed_by(&key, &ca).unwrap().der().clone();
        let intermediate = Issuer::new(intermediate, key);
        let mut leaf = CertificateParams::default();
        leaf.not_before = date_time_ymd(2026, 1, 1);
        leaf.not_after = date_time_ymd(leaf_until, 12, 31);
        let uri = format!("sgc:node:{}", "0a".repeat(32));
        leaf.subject_alt_names = vec![SanType::URI(uri.try_into().unwrap())];
        let leaf_der = leaf.signed_by(&KeyPair::generate().unwrap(), &intermediate).unwrap().der().clone();
        (TrustAnchors::new([ca_der]).unwrap(), vec![leaf_der, intermediate_der])
    }
}
