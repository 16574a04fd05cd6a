//! Identities: enrolment, files, chains.
#![allow(clippy::unwrap_used, reason = "helpers of tests are tests")]

use std::time::Duration;

use rand_chacha::ChaCha20Rng;
use rand_core::SeedableRng as _;
use rcgen::{
    BasicConstraints, CertificateParams, DnType, ExtendedKeyUsagePurpose, IsCa, Issuer, KeyPair,
    KeyUsagePurpose, SanType, SigningKey,
};
use rustls_pki_types::CertificateDer;
use sgc_trust::*;
use sgc_wire::{CERT_BYTES_MAX, CHAIN_CERTS_MAX, Metadata, Pseudonym, UnixMillis};

const NOW: UnixMillis = UnixMillis(1_795_000_000_000);
const MINUTE: u64 = 60_000;
const DAY: u64 = 24 * 60 * MINUTE;

fn rng(seed: u64) -> ChaCha20Rng {
    ChaCha20Rng::seed_from_u64(seed)
}

fn fleet(seed: u64) -> Fleet {
    Fleet::create("acme".parse().unwrap(), NOW, &mut rng(seed)).unwrap()
}

fn request(node: &str) -> EnrollRequest {
    EnrollRequest::new(node.parse().unwrap(), NOW)
}

fn enroll(fleet: &Fleet, request: &EnrollRequest) -> Identity {
    fleet.issue(request, &mut rng(7)).unwrap()
}

fn at(offset: i64) -> UnixMillis {
    UnixMillis(NOW.0.checked_add_signed(offset).unwrap())
}

fn sha256(bytes: &[u8]) -> [u8; 32] {
    aws_lc_rs::digest::digest(&aws_lc_rs::digest::SHA256, bytes).as_ref().try_into().unwrap()
}

fn contains(haystack: &[u8], needle: &[u8]) -> bool {
    haystack.windows(needle.len()).any(|w| w == needle)
}

#[test]
fn pseudonyms_tags_and_node_ids_are_what_the_specification_says() {
    // Computed with Python's hmac and hashlib.
    let secret = FleetSecret::from_bytes(std::array::from_fn(|i| i as u8));
    let pseudonym = secret.pseudonym("arm-1");
    assert_eq!(pseudonym.to_string(), "35cfe4dbd58268ed66a35a9d31970b71c1924b1f868abc11bb0c3de8a6dad380");
    assert_eq!(
        secret.group_tag("operators").to_string(),
        "fd07842555f47b1a744689f2cab99ce38dd9e62f916589055a6c679aea52306c"
    );
    let mut spki = vec![
        0x30, 0x59, 0x30, 0x13, 0x06, 0x07, 0x2a, 0x86, 0x48, 0xce, 0x3d, 0x02, 0x01, 0x06, 0x08, 0x2a, 0x86,
        0x48, 0xce, 0x3d, 0x03, 0x01, 0x07, 0x03, 0x42, 0x00, 0x04,
    ];
    spki.extend(0..64);
    assert_eq!(
        node_id(&spki, &pseudonym).to_string(),
        "0ab23d5bda0052488b9dafdaf8a676fbeb840fe6043e5e4f91a41173c4d5ccdf"
    );
    assert_ne!(secret.pseudonym("operators").0, secret.group_tag("operators").0);
    // `scripts/pki-vectors.py` prints these and those above: a node's id follows from the first secret, the names of
    // its shares from each generation.
    let owner = node_id(&spki, &pseudonym);
    let topic = Metadata::topic("arm-1", "/camera/image", "sensor_msgs/msg/Image");
    let named = |secret: &FleetSecret| derive_name(secret, &owner, &topic).to_string();
    assert_eq!(named(&secret), "c2d1e2ccc66628a53e5d64e052bc756df604d7706f928b133b6a5117fe0108cf");
    let rotated = FleetSecret::from_bytes(std::array::from_fn(|i| i as u8 + 32));
    assert_eq!(named(&rotated), "174148a916325a353c7cf2df75e9484666a5d8bbc5ec1a6d8596aef1de3456da");
    let ca = CaFingerprint(sha256(&spki));
    assert_eq!(ca.to_string(), "0131dda9654fef86d57812b9960f260523c27a40c3a18fa8ecc7303510e78c22");
    assert_eq!(
        renewal_blind(&ca).to_string(),
        "367b4a3010a84d06b4ee2a8a0f11a7f82db8a69b16f24f8a390455ad1513195b"
    );
    assert_eq!(
        name_of(&owner, &renewal_blind(&ca)).to_string(),
        "3d8e6a2cd48f7918a009a78f8c0ba2cc2ce2f3f5dd728d4fc34edc9aa74775a5"
    );
    assert_eq!(
        types_blind(&owner).to_string(),
        "fd92810b48e39dd4a076573b4418575b788a5f19529a381762edf7525aa49e1c"
    );
    assert_eq!(
        name_of(&owner, &types_blind(&owner)).to_string(),
        "828a47618f81d5ed681ad75af94f07541a24253de14f409ec53ef1c6582055bd"
    );
    assert_eq!(
        consumers_blind(&owner).to_string(),
        "6a52dcc61d5d19fbb977128454aa4bd13e5b887e11d1b9f98c4e17c372e9659f"
    );
    assert_eq!(
        name_of(&owner, &consumers_blind(&owner)).to_string(),
        "234f5f5f41edbac0aa1df4fcc86e1890821e5266cf5685428698337c34faaff5"
    );
    assert_eq!(
        reports_blind(&owner).to_string(),
        "a6069a78a02e76e7389f6902de2903be68d7f3ab8e620873e3e519b0ad915c1b"
    );
    assert_eq!(
        name_of(&owner, &reports_blind(&owner)).to_string(),
        "a51d8957bcee62f91c39f990fc8cfac2ca7b602dcf775061ecf3a02157bb5363"
    );
    assert_eq!(
        paths_blind(&owner).to_string(),
        "3228a42645607adeef0f3729d6394f4d887ba2b7719476e9d2c9c2a019e7c51f"
    );
    assert_eq!(
        name_of(&owner, &paths_blind(&owner)).to_string(),
        "79ba6d7f59ef5801396d45bb59b96e1892070495b1e9c27d9f5a768c901b4df2"
    );
    assert_eq!(
        clock_blind(&owner).to_string(),
        "35ee76155e29ba1dac7c4c94a0a4acdfc360442893a5c2b75bade00f0e575e76"
    );
    assert_eq!(
        name_of(&owner, &clock_blind(&owner)).to_string(),
        "26150ea05f92931e372e3b3227e64e7b399bd4122e6576104a2b507e33def622"
    );
    assert_eq!(
        wishes_blind(&owner).to_string(),
        "05f8514905585ad0fc74ff2698f03a14e24cdf70bc5ef71a734d7a30a20eb357"
    );
    assert_eq!(
        name_of(&owner, &wishes_blind(&owner)).to_string(),
        "8bbbe9a5f3ed904eb23cd15d66c1660bdedfc610563ad0d35046b36a93d798ef"
    );
}

#[test]
fn members_of_a_fleet_verify_and_name_each_other() {
    let fleet = fleet(1);
    let groups = vec!["operators".parse().unwrap(), "night".parse().unwrap(), "night".parse().unwrap()];
    let arm = enroll(&fleet, &EnrollRequest { groups, ..request("arm-1") });
    let desk = enroll(&fleet, &request("desk"));
    let peer = desk.anchors().verify(arm.chain(), NOW).unwrap();
    assert_eq!(peer.node_id, arm.node_id());
    assert_eq!(Some(peer.node_id), desk.node_id_of("arm-1"));
    assert_eq!(arm.node_id_of("arm-1"), Some(arm.node_id()));
    assert_eq!(peer.pseudonym, fleet.secret().pseudonym("arm-1"));
    assert_eq!(peer.groups.len(), 2);
    assert!(peer.is_in(&fleet.secret().group_tag("operators")));
    assert!(!peer.is_in(&fleet.secret().group_tag("arm-1")));
    assert_eq!(arm.groups(), &*peer.groups);
    assert!(desk.groups().is_empty());
    assert_eq!(peer.not_after.secs(), at(90 * DAY as i64).secs());
}

#[test]
fn certificates_tell_no_name() {
    let fleet = fleet(1);
    let groups = vec!["operators".parse().unwrap()];
    let arm = enroll(&fleet, &EnrollRequest { groups, ..request("arm-1") });
    for certificate in [&arm.chain()[0], fleet.ca_certificate()] {
        for name in ["arm-1", "operators", "acme"] {
            assert!(!contains(certificate, name.as_bytes()), "{name} is in a certificate");
        }
        assert!(!contains(certificate, fleet.secret().expose()));
    }
}

#[test]
fn a_certificate_with_all_groups_fits() {
    let fleet = fleet(1);
    let groups = |n: usize| (0..n).map(|i| format!("group-{i}").parse().unwrap()).collect();
    let full = enroll(&fleet, &EnrollRequest { groups: groups(GROUPS_MAX), ..request("a") });
    assert_eq!(full.groups().len(), GROUPS_MAX);
    assert!(full.chain()[0].len() <= CERT_BYTES_MAX, "{}", full.chain()[0].len());
    let over = EnrollRequest { groups: groups(GROUPS_MAX + 1), ..request("a") };
    assert!(matches!(fleet.issue(&over, &mut rng(1)), Err(FleetError::TooManyGroups { groups: 33 })));
}

#[test]
fn a_fleet_follows_its_seed() {
    let ids = |seed| {
        let fleet = fleet(seed);
        (fleet.secret().expose().to_vec(), enroll(&fleet, &request("a")).node_id())
    };
    assert_eq!(ids(1), ids(1));
    assert_ne!(ids(1), ids(2));
}

#[test]
fn clock_skew_of_minutes_works_and_of_days_is_named() {
    let fleet = fleet(1);
    let arm = enroll(&fleet, &request("arm-1"));
    let verify = |now| fleet.anchors().verify(arm.chain(), now);
    assert!(verify(at(-9 * MINUTE as i64)).is_ok());
    let early = verify(at(-(DAY as i64))).unwrap_err();
    assert!(matches!(early, CertError::NotYetValid { now, .. } if now.secs() == at(-(DAY as i64)).secs()));
    assert!(early.to_string().contains("clock"), "{early}");
    assert!(verify(at(90 * DAY as i64)).is_ok());
    let late = verify(at(91 * DAY as i64)).unwrap_err();
    let CertError::Expired { not_after, now } = late else { panic!("{late}") };
    assert_eq!((not_after, now), (arm.not_after(), at(91 * DAY as i64)));
    assert!(late.to_string().contains("expired"), "{late}");
}

#[test]
fn a_leaf_never_outlives_its_ca_and_an_expired_ca_is_not_believed() {
    let fleet = fleet(1);
    let valid = Duration::from_secs(20 * 365 * 86_400);
    let arm = enroll(&fleet, &EnrollRequest { valid, ..request("arm-1") });
    assert_eq!(arm.not_after(), fleet.not_after());
    let after = UnixMillis(fleet.not_after().0 + 1000);
    assert!(matches!(
        fleet.issue(&EnrollRequest { now: after, ..request("b") }, &mut rng(1)),
        Err(FleetError::CaExpired { .. })
    ));
    assert!(matches!(
        Fleet::create("x".parse().unwrap(), UnixMillis(u64::MAX), &mut rng(1)),
        Err(FleetError::Time(_))
    ));
}

#[test]
fn another_fleet_is_refused() {
    let (ours, theirs) = (fleet(1), fleet(2));
    let stranger = enroll(&theirs, &request("arm-1"));
    assert_eq!(ours.anchors().verify(stranger.chain(), NOW).unwrap_err(), CertError::UnknownIssuer);
    let both = TrustAnchors::new([ours.ca_certificate().clone(), theirs.ca_certificate().clone()]).unwrap();
    assert_eq!(both.verify(stranger.chain(), NOW).unwrap().node_id, stranger.node_id());
    // The same name and even the same secret under another CA is another node.
    assert_ne!(enroll(&ours, &request("arm-1")).node_id(), stranger.node_id());
}

#[test]
fn no_flipped_bit_of_a_certificate_is_accepted() {
    let fleet = fleet(1);
    let arm = enroll(&fleet, &request("arm-1"));
    for index in 0..arm.chain()[0].len() {
        let mut der = arm.chain()[0].to_vec();
        der[index] ^= 1;
        assert!(fleet.anchors().verify(&[CertificateDer::from(der)], NOW).is_err(), "byte {index}");
    }
    let mut der = arm.chain()[0].to_vec();
    let pseudonym = arm.pseudonym().to_string();
    let start = der.windows(64).rposition(|w| w == pseudonym.as_bytes()).unwrap();
    der[start] = if der[start] == b'0' { b'1' } else { b'0' };
    let forged = fleet.anchors().verify(&[CertificateDer::from(der)], NOW);
    assert_eq!(forged.unwrap_err(), CertError::BadSignature);
}

#[test]
fn chains_are_bounded() {
    let fleet = fleet(1);
    let leaf = enroll(&fleet, &request("arm-1")).chain()[0].clone();
    let verify = |chain: &[CertificateDer<'_>]| fleet.anchors().verify(chain, NOW).unwrap_err();
    assert_eq!(verify(&[]), CertError::NoCertificate);
    let long = vec![leaf.clone(); CHAIN_CERTS_MAX + 1];
    assert_eq!(verify(&long), CertError::ChainTooLong { certificates: CHAIN_CERTS_MAX + 1 });
    let big = CertificateDer::from(vec![0; CERT_BYTES_MAX + 1]);
    assert_eq!(verify(&[leaf, big]), CertError::CertificateTooLong { bytes: CERT_BYTES_MAX + 1 });
    assert!(matches!(verify(&[CertificateDer::from(vec![0x30; 9])]), CertError::Malformed(_)));
    // The CA is no node.
    assert_eq!(verify(&[fleet.ca_certificate().clone()]), CertError::NodeIsCa);
    assert_eq!(TrustAnchors::new([]).unwrap_err(), AnchorError::None);
    let many = vec![fleet.ca_certificate().clone(); ANCHORS_MAX + 1];
    assert_eq!(TrustAnchors::new(many).unwrap_err(), AnchorError::TooMany);
}

/// A CA as a company already has, and its certificates.
struct ForeignCa {
    params: CertificateParams,
    key: KeyPair,
    anchors: TrustAnchors,
}

impl ForeignCa {
    fn new() -> Self {
        let mut params = CertificateParams::default();
        params.is_ca = IsCa::Ca(rcgen::BasicConstraints::Unconstrained);
        params.distinguished_name.push(DnType::CommonName, "Company CA");
        let key = KeyPair::generate_for(&rcgen::PKCS_ECDSA_P384_SHA384).unwrap();
        let certificate = params.self_signed(&key).unwrap();
        Self { params, key, anchors: TrustAnchors::new([certificate.into()]).unwrap() }
    }

    fn issue(
        &self,
        uris: &[String],
        usage: Option<ExtendedKeyUsagePurpose>,
        algorithm: &'static rcgen::SignatureAlgorithm,
    ) -> Result<VerifiedPeer, CertError> {
        let mut params = CertificateParams::default();
        params.subject_alt_names =
            uris.iter().map(|u| SanType::URI(u.as_str().try_into().unwrap())).collect();
        params.extended_key_usages = usage.into_iter().collect();
        let key = KeyPair::generate_for(algorithm).unwrap();
        let leaf = params.signed_by(&key, &Issuer::from_params(&self.params, &self.key)).unwrap();
        self.anchors.verify(&[leaf.into()], NOW)
    }
}

#[test]
fn leaves_of_an_existing_pki_are_judged_by_what_they_say() {
    let ca = ForeignCa::new();
    let node = format!("sgc:node:{}", Pseudonym([0xab; 32]));
    let group = |i: u8| format!("sgc:group:{}", Pseudonym([i; 32]));
    let p256 = &rcgen::PKCS_ECDSA_P256_SHA256;
    let judge = |uris: &[String]| ca.issue(uris, None, p256);
    let uris = [node.clone(), "https://example.com/x".into(), "sgc:later:1".into(), group(2), group(1)];
    let peer = judge(&uris).unwrap();
    assert_eq!(peer.pseudonym, Pseudonym([0xab; 32]));
    assert_eq!(peer.groups.iter().map(|g| g.0[0]).collect::<Vec<_>>(), [1, 2]);
    assert_eq!(judge(&[]).unwrap_err(), CertError::NoPseudonym);
    assert_eq!(judge(&["sgc:node:arm-1".into()]).unwrap_err(), CertError::NoPseudonym);
    assert!(matches!(judge(&[node.clone(), node.clone()]), Err(CertError::Malformed(_))));
    assert!(matches!(judge(&[node.clone(), "sgc:group:x".into()]), Err(CertError::Malformed(_))));
    let many: Vec<_> = std::iter::once(node.clone()).chain((0..33).map(group)).collect();
    assert_eq!(judge(&many).unwrap_err(), CertError::TooManyGroups);

    let mail = Some(ExtendedKeyUsagePurpose::EmailProtection);
    assert_eq!(ca.issue(std::slice::from_ref(&node), mail, p256).unwrap_err(), CertError::WrongUsage);
    for usage in [ExtendedKeyUsagePurpose::ClientAuth, ExtendedKeyUsagePurpose::ServerAuth] {
        assert!(ca.issue(std::slice::from_ref(&node), Some(usage), p256).is_ok());
    }
    for algorithm in [&rcgen::PKCS_ECDSA_P384_SHA384, &rcgen::PKCS_ED25519] {
        assert!(ca.issue(std::slice::from_ref(&node), None, algorithm).is_ok());
    }
    let p521 = &rcgen::PKCS_ECDSA_P521_SHA512;
    assert_eq!(ca.issue(&[node], None, p521).unwrap_err(), CertError::KeyUnsupported);
}

/// A CA below `issuer`, with these URIs in its certificate.
fn ca_below(
    issuer: &Issuer<'_, impl SigningKey>,
    uris: &[&str],
) -> (CertificateDer<'static>, Issuer<'static, KeyPair>) {
    let mut params = CertificateParams::default();
    params.is_ca = IsCa::Ca(BasicConstraints::Unconstrained);
    params.distinguished_name.push(DnType::CommonName, "below");
    params.subject_alt_names = uris.iter().map(|u| SanType::URI((*u).try_into().unwrap())).collect();
    let key = KeyPair::generate().unwrap();
    let made = params.signed_by(&key, issuer).unwrap();
    (made.into(), Issuer::new(params, key))
}

#[test]
fn a_node_whose_certificate_is_a_cas_is_refused_and_so_is_what_it_signs() {
    let ca = ForeignCa::new();
    let node = format!("sgc:node:{}", Pseudonym([0xab; 32]));
    let victim = format!("sgc:node:{}", Pseudonym([1; 32]));
    let top = Issuer::from_params(&ca.params, &ca.key);
    // The certificate that `openssl x509 -req -copy_extensions copyall` makes of a request with CA:TRUE.
    let key = KeyPair::generate().unwrap();
    let mut params = CertificateParams::default();
    params.is_ca = IsCa::Ca(BasicConstraints::Unconstrained);
    params.distinguished_name.push(DnType::CommonName, "robot");
    params.subject_alt_names = vec![SanType::URI(node.as_str().try_into().unwrap())];
    let robot: CertificateDer<'_> = params.signed_by(&key, &top).unwrap().into();
    assert_eq!(ca.anchors.verify(std::slice::from_ref(&robot), NOW).unwrap_err(), CertError::NodeIsCa);

    let robot_as_ca = Issuer::from_params(&params, &key);
    let mut leaf = CertificateParams::default();
    leaf.subject_alt_names = vec![SanType::URI(victim.as_str().try_into().unwrap())];
    let forged = leaf.signed_by(&KeyPair::generate().unwrap(), &robot_as_ca).unwrap().into();
    assert_eq!(ca.anchors.verify(&[forged, robot], NOW).unwrap_err(), CertError::NodeIsCa);

    // The owner of a CA that names no node may have made it.
    let (below, below_as_ca) = ca_below(&top, &["https://example.com"]);
    let good = leaf.signed_by(&KeyPair::generate().unwrap(), &below_as_ca).unwrap().into();
    assert_eq!(ca.anchors.verify(&[good, below], NOW).unwrap().pseudonym, Pseudonym([1; 32]));
    for role in ["sgc:role:router", "sgc:group:x", "sgc:later"] {
        let (below, below_as_ca) = ca_below(&top, &[role]);
        let forged = leaf.signed_by(&KeyPair::generate().unwrap(), &below_as_ca).unwrap().into();
        assert_eq!(ca.anchors.verify(&[forged, below], NOW).unwrap_err(), CertError::NodeIsCa, "{role}");
    }

    // The right to sign certificates without basic constraints is void, and no node requests it.
    leaf.key_usages = vec![KeyUsagePurpose::DigitalSignature, KeyUsagePurpose::KeyCertSign];
    let signer = leaf.signed_by(&KeyPair::generate().unwrap(), &top).unwrap().into();
    assert_eq!(ca.anchors.verify(&[signer], NOW).unwrap_err(), CertError::NodeIsCa);
}

#[test]
fn the_path_length_of_a_trusted_ca_is_kept_to() {
    for (length, permits) in [(None, true), (Some(1), true), (Some(0), false)] {
        let mut params = CertificateParams::default();
        let constraints = length.map_or(BasicConstraints::Unconstrained, BasicConstraints::Constrained);
        params.is_ca = IsCa::Ca(constraints);
        params.distinguished_name.push(DnType::CommonName, "Company CA");
        let key = KeyPair::generate().unwrap();
        let anchors = TrustAnchors::new([params.self_signed(&key).unwrap().into()]).unwrap();
        let top = Issuer::new(params, key);
        let (below, below_as_ca) = ca_below(&top, &[]);
        let mut leaf = CertificateParams::default();
        let node = format!("sgc:node:{}", Pseudonym([1; 32]));
        leaf.subject_alt_names = vec![SanType::URI(node.as_str().try_into().unwrap())];
        let node_key = KeyPair::generate().unwrap();
        let direct = leaf.signed_by(&node_key, &top).unwrap().into();
        assert!(anchors.verify(&[direct], NOW).is_ok());
        let chain = [leaf.signed_by(&node_key, &below_as_ca).unwrap().into(), below];
        match anchors.verify(&chain, NOW) {
            Ok(_) => assert!(permits),
            Err(why) => assert_eq!((why, permits), (CertError::PathTooLong { intermediates: 1 }, false)),
        }
    }
}

#[test]
fn signatures_hold_for_their_signer_message_and_context_only() {
    let fleet = fleet(1);
    let arm = enroll(&fleet, &request("arm-1"));
    let desk = fleet.issue(&request("desk"), &mut rng(8)).unwrap();
    let peer = fleet.anchors().verify(arm.chain(), NOW).unwrap();
    let signature = arm.sign("test v1", b"message");
    assert_eq!(peer.verify_signature("test v1", b"message", &signature), Ok(()));
    let error = Err(SignatureError { signer: arm.node_id() });
    assert_eq!(peer.verify_signature("test v2", b"message", &signature), error);
    assert_eq!(peer.verify_signature("test v1", b"massage", &signature), error);
    assert_eq!(peer.verify_signature("test v1", b"message", &desk.sign("test v1", b"message")), error);
    assert_eq!(peer.verify_signature("test v1", b"message", b""), error);
}

#[test]
fn identities_and_fleets_survive_their_files() {
    let fleet = fleet(1);
    let read = Fleet::parse(&fleet.to_text()).unwrap();
    assert_eq!(read.name(), fleet.name());
    assert_eq!(read.secret().expose(), fleet.secret().expose());
    assert_eq!(read.to_text(), fleet.to_text());
    let arm = enroll(&read, &request("arm-1"));
    let text = arm.to_text();
    for line in ["# node:    arm-1\n", "# fleet:   acme\n", "# expires: 2027-", "KEEP IT SECRET"] {
        assert!(text.contains(line), "{line} is not in {}", &text[..300]);
    }
    let back = Identity::parse(&text).unwrap();
    assert_eq!(back.to_text(), text);
    assert_eq!((back.node_id(), back.node_name()), (arm.node_id(), arm.node_name()));
    assert_eq!(back.fleet_secret().unwrap().expose(), fleet.secret().expose());
    assert_eq!(back.reset_key(), arm.reset_key());
    let peer = fleet.anchors().verify(back.chain(), NOW).unwrap();
    assert_eq!(peer.verify_signature("x", b"y", &back.sign("x", b"y")), Ok(()));
}

#[test]
fn a_router_has_no_secret() {
    let fleet = fleet(1);
    let router = enroll(&fleet, &EnrollRequest { router: true, ..request("router") });
    assert!(router.fleet_secret().is_none());
    assert_eq!(router.node_id_of("arm-1"), None);
    let text = router.to_text();
    let secret = base64::Engine::encode(&base64::engine::general_purpose::STANDARD, fleet.secret().expose());
    assert!(fleet.to_text().contains(&secret[..40]));
    assert!(!text.contains(&secret[..40]) && !text.contains("FLEET SECRET"));
    let back = Identity::parse(&text).unwrap();
    assert!(back.fleet_secret().is_none());
    assert_eq!(back.node_id(), router.node_id());
    let arm = enroll(&fleet, &request("arm-1"));
    assert_eq!(back.anchors().verify(arm.chain(), NOW).unwrap().node_id, arm.node_id());
    // It recognises observers, and no other group.
    assert_eq!(back.group_tag("observers"), arm.group_tag("observers"));
    assert!(arm.group_tag("observers").is_some() && back.group_tag("operators").is_none());
}

#[test]
fn debug_output_tells_no_secret() {
    let fleet = fleet(1);
    let arm = enroll(&fleet, &request("arm-1"));
    let text = arm.to_text();
    let shown = format!("{fleet:?} {fleet:#?} {arm:?} {arm:#?} {:?} {:?}", fleet.secret(), arm.as_peer());
    let list = |bytes: &[u8]| format!("{:?}", &bytes[..4]).trim_matches(['[', ']']).to_owned();
    let hex = |bytes: &[u8]| bytes[..4].iter().map(|b| format!("{b:02x}")).collect::<String>();
    for secret in [&fleet.secret().expose()[..], arm.reset_key().unwrap()] {
        assert!(!shown.contains(&list(secret)) && !shown.contains(&hex(secret)));
    }
    for line in text.lines().filter(|l| l.len() == 64) {
        assert!(!shown.contains(line));
    }
    // Errors of broken files reveal no secret either.
    let broken = text.replace("SGC FLEET SECRET", "SGC NOBODY KNOWS");
    let error = format!("{:?}", Identity::parse(&broken).unwrap_err());
    assert_eq!(error, "UnknownBlock(\"SGC NOBODY KNOWS\")");
}

/// The file without its first block of that label.
fn without(text: &str, label: &str) -> String {
    let (begin, end) = (format!("-----BEGIN {label}-----"), format!("-----END {label}-----\n"));
    let (start, stop) = (text.find(&begin).unwrap(), text.find(&end).unwrap() + end.len());
    format!("{}{}", &text[..start], &text[stop..])
}

/// The first block of that label.
fn block<'a>(text: &'a str, label: &str) -> &'a str {
    let (begin, end) = (format!("-----BEGIN {label}-----"), format!("-----END {label}-----\n"));
    &text[text.find(&begin).unwrap()..text.find(&end).unwrap() + end.len()]
}

#[test]
fn broken_identity_files_name_the_block() {
    let (ours, theirs) = (fleet(1), fleet(2));
    let text = enroll(&ours, &request("arm-1")).to_text();
    let foreign = theirs.issue(&request("arm-1"), &mut rng(9)).unwrap().to_text();
    let refused = |text: &str| Identity::parse(text).unwrap_err();
    for label in ["SGC IDENTITY", "CERTIFICATE", "PRIVATE KEY", "SGC CA CERTIFICATE"] {
        let error = refused(&without(&text, label));
        assert!(matches!(error, IdentityError::Missing(l) if l == label), "{error}");
        assert!(error.to_string().contains(label));
    }
    let swap = |label| text.replace(block(&text, label), block(&foreign, label));
    assert_eq!(refused(&swap("CERTIFICATE")), IdentityError::Chain(CertError::UnknownIssuer));
    assert_eq!(refused(&swap("SGC CA CERTIFICATE")), IdentityError::Chain(CertError::UnknownIssuer));
    assert_eq!(refused(&swap("PRIVATE KEY")), IdentityError::KeyMismatch);
    assert!(matches!(refused(&swap("SGC FLEET SECRET")), IdentityError::NameMismatch { .. }));
    let desk = ours.issue(&request("desk"), &mut rng(9)).unwrap().to_text();
    let renamed = text.replace(block(&text, "SGC IDENTITY"), block(&desk, "SGC IDENTITY"));
    assert!(matches!(refused(&renamed), IdentityError::NameMismatch { node } if node.as_str() == "desk"));
    let twice = format!("{}{}", text.as_str(), block(&text, "PRIVATE KEY"));
    assert_eq!(refused(&twice), IdentityError::Repeated("PRIVATE KEY"));
    assert_eq!(refused(""), IdentityError::Missing("SGC IDENTITY"));
    let garbage = "-----BEGIN PRIVATE KEY-----\nAAAA\n-----END PRIVATE KEY-----\n";
    assert_eq!(refused(&text.replace(block(&text, "PRIVATE KEY"), garbage)), IdentityError::Key);
    let about = |base64| format!("-----BEGIN SGC IDENTITY-----\n{base64}\n-----END SGC IDENTITY-----\n");
    let with_about = |base64| refused(&text.replace(block(&text, "SGC IDENTITY"), &about(base64)));
    assert!(matches!(
        with_about("CQ=="),
        IdentityError::About(sgc_wire::DecodeError::Version { found: 9, .. })
    ));
    assert!(matches!(with_about("AQ=="), IdentityError::About(sgc_wire::DecodeError::Truncated { .. })));
    assert!(matches!(refused("-----BEGIN X-----"), IdentityError::File(PemError::Unterminated { .. })));
}

#[test]
fn broken_fleet_files_name_the_block() {
    let (ours, theirs) = (fleet(1), fleet(2));
    let (text, foreign) = (ours.to_text(), theirs.to_text());
    for label in ["SGC FLEET", "CERTIFICATE", "PRIVATE KEY", "SGC FLEET SECRET"] {
        let error = Fleet::parse(&without(&text, label)).unwrap_err();
        assert!(matches!(error, FleetError::Missing(l) if l == label), "{error}");
    }
    let swapped = text.replace(block(&text, "PRIVATE KEY"), block(&foreign, "PRIVATE KEY"));
    assert!(matches!(Fleet::parse(&swapped), Err(FleetError::KeyMismatch)));
    let identity = enroll(&ours, &request("a")).to_text();
    assert!(matches!(Fleet::parse(&identity), Err(FleetError::UnknownBlock(l)) if l == "SGC IDENTITY"));
}
