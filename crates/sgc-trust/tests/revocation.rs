//! Revocations are permanent, however the lists arrive.
#![allow(clippy::unwrap_used, reason = "helpers of tests are tests")]

use std::sync::Arc;

use bytes::Bytes;
use rand_chacha::ChaCha20Rng;
use rand_core::SeedableRng as _;
use rcgen::{
    BasicConstraints, CertificateParams, CertificateRevocationListParams, CrlDistributionPoint,
    CrlIssuingDistributionPoint, DnType, IsCa, Issuer, KeyIdMethod, KeyPair, KeyUsagePurpose,
    RevokedCertParams, SanType, SerialNumber, SigningKey as _,
};
use rustls_pki_types::CertificateDer;
use sgc_trust::*;
use sgc_wire::{
    CRL_BYTES_MAX, DecodeError, JoinBody, Name, Pseudonym, RefuseReason, RejectReason, Request, SinkId,
    UnixMillis,
};

const NOW: UnixMillis = UnixMillis(1_795_000_000_000);
const MINUTE: u64 = 60_000;
const DAY: u64 = 24 * 60 * MINUTE;

fn rng(seed: u64) -> ChaCha20Rng {
    ChaCha20Rng::seed_from_u64(seed)
}

fn fleet(seed: u64) -> Fleet {
    Fleet::create("acme".parse().unwrap(), NOW, &mut rng(seed)).unwrap()
}

fn enroll(fleet: &Fleet, node: &str, seed: u64) -> Identity {
    fleet.issue(&EnrollRequest::new(node.parse().unwrap(), NOW), &mut rng(seed)).unwrap()
}

/// A list that revokes these.
fn list(fleet: &Fleet, number: u64, revoked: &[&Identity]) -> Vec<u8> {
    let serials: Vec<_> = revoked.iter().map(|i| (Arc::clone(&i.as_peer().cert.serial), NOW)).collect();
    fleet.revocation_list_of(&serials, number, NOW).unwrap()
}

fn with(anchors: &TrustAnchors, list: &[u8]) -> TrustAnchors {
    anchors.with_crl(list, NOW).unwrap().unwrap()
}

#[test]
fn a_revoked_certificate_is_refused_and_its_neighbours_are_not() {
    let fleet = fleet(1);
    let (arm, again, desk) =
        (enroll(&fleet, "arm-1", 1), enroll(&fleet, "arm-1", 2), enroll(&fleet, "desk", 3));
    assert!(fleet.anchors().verify(arm.chain(), NOW).is_ok());
    let anchors = with(fleet.anchors(), &list(&fleet, 1, &[&arm]));
    let error = anchors.verify(arm.chain(), NOW).unwrap_err();
    assert!(matches!(error, CertError::Revoked { at } if at.secs() == NOW.secs()), "{error}");
    assert!(error.to_string().contains("revoked by its CA at 2026-"), "{error}");
    // Another certificate of the same node, and another node.
    for identity in [&again, &desk] {
        assert_eq!(anchors.verify(identity.chain(), NOW).unwrap().node_id, identity.node_id());
        assert!(!anchors.is_peer_revoked(identity.as_peer()));
    }
    assert!(anchors.is_peer_revoked(arm.as_peer()));
    // The anchors from before are as they were: lists are values.
    assert!(fleet.anchors().verify(arm.chain(), NOW).is_ok() && fleet.anchors().crls().count() == 0);
    // A node can hold anchors that revoke itself.
    let arm = arm.with_anchors(anchors);
    assert!(arm.anchors().is_peer_revoked(arm.as_peer()));
}

#[test]
fn an_older_list_never_replaces_a_newer_one() {
    let fleet = fleet(1);
    let (arm, desk) = (enroll(&fleet, "arm-1", 1), enroll(&fleet, "desk", 2));
    let (first, second) = (list(&fleet, 255, &[&arm]), list(&fleet, 256, &[&arm, &desk]));
    let anchors = with(&with(fleet.anchors(), &first), &second);
    assert_eq!(anchors.crls().map(|c| c.as_ref()).collect::<Vec<_>>(), [&second[..]]);
    for old in [&first, &second, &list(&fleet, 256, &[])] {
        assert!(anchors.with_crl(old, NOW).unwrap().is_none());
    }
    assert!(anchors.is_peer_revoked(desk.as_peer()));
    // The keeper may take a certificate off the list again.
    let third = with(&anchors, &list(&fleet, 257, &[]));
    assert!(third.verify(arm.chain(), NOW).is_ok() && third.crls().count() == 1);
}

#[test]
fn no_flipped_bit_of_a_list_is_accepted() {
    let fleet = fleet(1);
    let arm = enroll(&fleet, "arm-1", 1);
    let good = list(&fleet, 7, &[&arm]);
    for bit in 0..good.len() * 8 {
        let mut bad = good.clone();
        bad[bit / 8] ^= 1 << (bit % 8);
        assert!(fleet.anchors().with_crl(&bad, NOW).is_err(), "bit {bit}");
    }
    for length in 0..good.len() {
        assert!(fleet.anchors().with_crl(&good[..length], NOW).is_err(), "{length} bytes");
    }
    let longer = [&good[..], &[0]].concat();
    assert!(matches!(fleet.anchors().with_crl(&longer, NOW), Err(CrlError::Malformed(_))));
}

#[test]
fn the_list_of_another_ca_revokes_nothing_of_ours() {
    let (ours, theirs) = (fleet(1), fleet(2));
    let (arm, stranger) = (enroll(&ours, "arm-1", 1), enroll(&theirs, "arm-1", 1));
    assert_eq!(arm.as_peer().cert.serial, stranger.as_peer().cert.serial, "both have the same serial number");
    let foreign = list(&theirs, 9, &[&stranger]);
    assert_eq!(ours.anchors().with_crl(&foreign, NOW).unwrap_err(), CrlError::UnknownIssuer);
    let both = ours.anchors().with_anchors([theirs.ca_certificate().clone()]).unwrap();
    let both = with(&both, &foreign);
    assert!(both.verify(arm.chain(), NOW).is_ok());
    assert!(matches!(both.verify(stranger.chain(), NOW), Err(CertError::Revoked { .. })));
    // Each CA has lists of its own, independent of the numbers of others.
    let both = with(&both, &list(&ours, 1, &[&arm]));
    assert_eq!(both.crls().count(), 2);
    for identity in [&arm, &stranger] {
        assert!(both.is_peer_revoked(identity.as_peer()));
    }
    // They survive more anchors, and anchors are not taken twice.
    let more = both.with_anchors([ours.ca_certificate().clone(), theirs.ca_certificate().clone()]).unwrap();
    assert_eq!((more.certificates().count(), more.crls().count()), (2, 2));
}

#[test]
fn a_list_counts_before_its_time_and_for_ever() {
    let fleet = fleet(1);
    let arm = enroll(&fleet, "arm-1", 1);
    let list = list(&fleet, 1, &[&arm]);
    for now in [NOW.0 - 9 * MINUTE, NOW.0 + 31 * DAY] {
        let anchors = fleet.anchors().with_crl(&list, UnixMillis(now)).unwrap().unwrap();
        assert!(matches!(anchors.verify(arm.chain(), UnixMillis(now)), Err(CertError::Revoked { .. })));
        let desk = enroll(&fleet, "desk", 2);
        assert!(anchors.verify(desk.chain(), UnixMillis(now)).is_ok(), "what it does not name is believed");
    }
    // With a clock that is two days behind the list is taken, too, and counts when the clock is right.
    let anchors = fleet.anchors().with_crl(&list, UnixMillis(NOW.0 - 2 * DAY)).unwrap().unwrap();
    assert!(matches!(anchors.verify(arm.chain(), NOW), Err(CertError::Revoked { .. })));
}

#[test]
fn requesters_hear_what_they_can_do_something_about() {
    let fleet = fleet(1);
    let arm = enroll(&fleet, "arm-1", 1);
    let anchors = with(fleet.anchors(), &list(&fleet, 1, &[&arm]));
    let reasons = |e: SignedError| (e.reject_reason(), e.refuse_reason());
    let (expired, not_verified) = (
        (RejectReason::Expired, RefuseReason::Expired),
        (RejectReason::NotVerified, RefuseReason::NotVerified),
    );
    let cert = |anchors: &TrustAnchors, days: u64| {
        let now = UnixMillis(NOW.0 + days * DAY);
        SignedError::Cert(anchors.verify(arm.chain(), now).unwrap_err())
    };
    assert_eq!(reasons(cert(&anchors, 0)), (RejectReason::Revoked, RefuseReason::Revoked));
    assert_eq!(reasons(cert(fleet.anchors(), 91)), expired);
    assert_eq!(reasons(cert(fleet.anchors(), 11 * 366)), expired);
    let (not_before, now) = (UnixMillis(1), UnixMillis(0));
    assert_eq!(reasons(CertError::NotYetValid { not_before, now }.into()), expired);
    assert_eq!(reasons(SignedError::Clock { signed: now, now }), (RejectReason::Clock, RefuseReason::Clock));
    for error in [CertError::UnknownIssuer.into(), DecodeError::value("x", 0).into()] {
        assert_eq!(reasons(error), not_verified);
    }
}

/// A CA as a company already has.
struct ForeignCa {
    params: CertificateParams,
    key: KeyPair,
    certificate: CertificateDer<'static>,
}

impl ForeignCa {
    fn new(name: &str, usages: &[KeyUsagePurpose]) -> Self {
        let mut params = CertificateParams::default();
        params.is_ca = IsCa::Ca(BasicConstraints::Unconstrained);
        params.key_usages = usages.to_vec();
        params.distinguished_name.push(DnType::CommonName, name);
        let key = KeyPair::generate_for(&rcgen::PKCS_ED25519).unwrap();
        let certificate = params.self_signed(&key).unwrap().into();
        Self { params, key, certificate }
    }

    fn anchors(&self) -> TrustAnchors {
        TrustAnchors::new([self.certificate.clone()]).unwrap()
    }

    fn crl(
        &self,
        number: &[u8],
        serials: &[u8],
        distribution: Option<CrlIssuingDistributionPoint>,
    ) -> Vec<u8> {
        let entry = |serial: &u8| RevokedCertParams {
            serial_number: SerialNumber::from_slice(&[0, *serial]),
            revocation_time: rcgen::date_time_ymd(2026, 1, 2),
            reason_code: None,
            invalidity_date: None,
        };
        let list = CertificateRevocationListParams {
            this_update: rcgen::date_time_ymd(2026, 1, 2),
            next_update: rcgen::date_time_ymd(2026, 2, 2),
            crl_number: SerialNumber::from_slice(number),
            issuing_distribution_point: distribution,
            revoked_certs: serials.iter().map(entry).collect(),
            key_identifier_method: KeyIdMethod::Sha256,
        };
        // The verifier checks whether the CA's own certificate permits it.
        let mut params = self.params.clone();
        params.key_usages = Vec::new();
        list.signed_by(&Issuer::from_params(&params, &self.key)).unwrap().der().to_vec()
    }
}

#[test]
fn revoking_an_intermediate_ca_revokes_what_it_made() {
    let root = ForeignCa::new("root", &[]);
    let mut params = CertificateParams::default();
    params.is_ca = IsCa::Ca(BasicConstraints::Unconstrained);
    params.distinguished_name.push(DnType::CommonName, "department");
    params.serial_number = Some(SerialNumber::from_slice(&[5]));
    let key = KeyPair::generate().unwrap();
    let middle = params.signed_by(&key, &Issuer::from_params(&root.params, &root.key)).unwrap();
    let mut leaf = CertificateParams::default();
    let uri = format!("sgc:node:{}", Pseudonym([1; 32]));
    leaf.subject_alt_names = vec![SanType::URI(uri.as_str().try_into().unwrap())];
    leaf.serial_number = Some(SerialNumber::from_slice(&[6]));
    let leaf = leaf.signed_by(&KeyPair::generate().unwrap(), &Issuer::from_params(&params, &key)).unwrap();
    let chain: [CertificateDer<'_>; 2] = [leaf.into(), middle.into()];
    let peer = root.anchors().verify(&chain, NOW).unwrap();
    // Serial 6 of the root is another certificate than serial 6 of the department.
    let other = with(&root.anchors(), &root.crl(&[1], &[6], None));
    assert!(other.verify(&chain, NOW).is_ok() && !other.is_peer_revoked(&peer));
    let anchors = with(&root.anchors(), &root.crl(&[2], &[5], None));
    assert!(matches!(anchors.verify(&chain, NOW), Err(CertError::Revoked { .. })));
    assert!(anchors.is_peer_revoked(&peer) && !anchors.is_path_revoked(std::slice::from_ref(&peer.cert)));
}

#[test]
fn lists_that_decide_nothing_are_refused_with_the_cause() {
    let ca = ForeignCa::new("company", &[KeyUsagePurpose::KeyCertSign, KeyUsagePurpose::CrlSign]);
    let refused = |crl: &[u8]| ca.anchors().with_crl(crl, NOW).unwrap_err();
    assert_eq!(refused(&vec![0; CRL_BYTES_MAX + 1]), CrlError::TooLong { bytes: CRL_BYTES_MAX + 1 });
    assert!(matches!(refused(b"no list"), CrlError::Malformed(_)));
    let uris = vec!["http://example.com/crl".to_owned()];
    let point =
        CrlIssuingDistributionPoint { distribution_point: CrlDistributionPoint { uris }, scope: None };
    assert_eq!(refused(&ca.crl(&[1], &[5], Some(point))), CrlError::Partial);
    // Numbers of up to 20 bytes are compared as numbers.
    let large = with(&ca.anchors(), &ca.crl(&[9; 20], &[], None));
    assert!(large.with_crl(&ca.crl(&[0xff; 2], &[], None), NOW).unwrap().is_none());
    // Two CAs of one name: the signature tells them apart.
    let namesake = ForeignCa::new("company", &[]);
    assert_eq!(refused(&namesake.crl(&[1], &[5], None)), CrlError::BadSignature);
    let both = ca.anchors().with_anchors([namesake.certificate.clone()]).unwrap();
    assert_eq!(with(&both, &namesake.crl(&[1], &[5], None)).crls().count(), 1);
    // Without a number nobody could tell which of two lists is newer.
    let mut unnumbered = ca.crl(&[1], &[5], None);
    let at = unnumbered.windows(3).rposition(|w| w == [0x55, 0x1d, 0x14]).unwrap();
    unnumbered[at + 2] = 0x7f;
    let head = if unnumbered[1] == 0x82 { 4 } else { 3 };
    // Behind the signed part: the algorithm (7 bytes), the head of the signature (3) and the signature.
    let end = unnumbered.len() - 7 - 3 - 64;
    let signature = ca.key.sign(&unnumbered[head..end]).unwrap();
    unnumbered[end + 10..].copy_from_slice(&signature);
    assert_eq!(refused(&unnumbered), CrlError::NoNumber);
    // A CA's certificate may forbid it to sign lists.
    let other = ForeignCa::new("other", &[KeyUsagePurpose::KeyCertSign]);
    assert_eq!(
        other.anchors().with_crl(&other.crl(&[1], &[], None), NOW).unwrap_err(),
        CrlError::NotAListSigner
    );
}

#[test]
fn a_join_of_a_revoked_node_is_refused_as_such() {
    let fleet = fleet(1);
    let arm = enroll(&fleet, "arm-1", 1);
    let body = JoinBody {
        chain: arm.chain_bytes(),
        issued_at: NOW,
        name: Name([1; 32]),
        sink: SinkId([2; 16]),
        request: Request::Subscribe { describe: false },
        reply_key: Bytes::from_static(&[3; 32]),
    };
    let signed = arm.sign_join(&body);
    assert!(verify_join(fleet.anchors(), &signed, NOW).is_ok());
    let anchors = with(fleet.anchors(), &list(&fleet, 1, &[&arm]));
    assert_eq!(verify_join(&anchors, &signed, NOW).unwrap_err().reject_reason(), RejectReason::Revoked);
}
