//! A fleet's record of its nodes: the roster, roles, renewal, generations of secrets, existing CAs.
#![allow(clippy::unwrap_used, reason = "helpers of tests are tests")]

use std::time::Duration;

use base64::Engine as _;
use base64::engine::general_purpose::STANDARD;
use bytes::Bytes;
use rand_chacha::ChaCha20Rng;
use rand_core::SeedableRng as _;
use rcgen::{
    BasicConstraints, CertificateParams, DnType, IsCa, Issuer, KeyPair, KeyUsagePurpose, SanType,
    SignatureAlgorithm,
};
use rustls_pki_types::CertificateDer;
use sgc_trust::*;
use sgc_wire::{Credentials, SECRET_GENERATIONS_MAX, SecretBytes, UnixMillis};
use zeroize::Zeroizing;

const NOW: UnixMillis = UnixMillis(1_795_000_000_000);
const DAY: u64 = 86_400_000;
const VALID: Duration = LEAF_VALIDITY_DEFAULT;
const KINDS: [&SignatureAlgorithm; 4] = [
    &rcgen::PKCS_ECDSA_P256_SHA256,
    &rcgen::PKCS_ECDSA_P384_SHA384,
    &rcgen::PKCS_ED25519,
    &rcgen::PKCS_RSA_SHA256,
];

fn rng(seed: u64) -> ChaCha20Rng {
    ChaCha20Rng::seed_from_u64(seed)
}

fn fleet() -> Fleet {
    Fleet::create("acme".parse().unwrap(), NOW, &mut rng(1)).unwrap()
}

fn request(node: &str) -> EnrollRequest {
    EnrollRequest::new(node.parse().unwrap(), NOW)
}

fn name(node: &str) -> NodeName {
    node.parse().unwrap()
}

fn at(days: u64) -> UnixMillis {
    UnixMillis(NOW.0 + days * DAY)
}

/// The anchors of the fleet with its newest list.
fn anchors(fleet: &Fleet, now: UnixMillis) -> TrustAnchors {
    let list = fleet.revocation_list(now).unwrap();
    fleet.anchors().with_crl(&list, now).unwrap().unwrap()
}

fn again(fleet: &Fleet) -> Fleet {
    let read = Fleet::parse(&fleet.to_text()).unwrap();
    assert_eq!(read.to_text(), fleet.to_text());
    read
}

fn block(label: &str, content: &[u8]) -> String {
    format!("-----BEGIN {label}-----\n{}\n-----END {label}-----\n", STANDARD.encode(content))
}

/// The content of the first block of that label, and the text without it.
fn take(text: &str, label: &str) -> (Vec<u8>, String) {
    let (begin, end) = (format!("-----BEGIN {label}-----"), format!("-----END {label}-----\n"));
    let (from, to) = (text.find(&begin).unwrap(), text.find(&end).unwrap());
    let content = text[from + begin.len()..to].split_whitespace().collect::<String>();
    (STANDARD.decode(content).unwrap(), format!("{}{}", &text[..from], &text[to + end.len()..]))
}

#[test]
fn the_roster_knows_who_was_enrolled_and_as_what() {
    let mut fleet = fleet();
    let groups = vec!["b".parse().unwrap(), "a".parse().unwrap(), "b".parse().unwrap()];
    let arm = fleet.enroll(&EnrollRequest { groups, ..request("arm-1") }, &mut rng(2)).unwrap();
    let cloud = fleet.enroll(&EnrollRequest { router: true, ..request("cloud") }, &mut rng(3)).unwrap();
    let relay = fleet.enroll(&EnrollRequest { may_route: true, ..request("relay") }, &mut rng(4)).unwrap();
    let fleet = again(&fleet);
    let nodes: Vec<_> = fleet.nodes().collect();
    assert_eq!(nodes.iter().map(|n| n.name.as_str()).collect::<Vec<_>>(), ["arm-1", "cloud", "relay"]);
    assert_eq!(nodes[0].groups.iter().map(|g| g.as_str()).collect::<Vec<_>>(), ["a", "b"]);
    assert_eq!(
        nodes.iter().map(|n| (n.router, n.may_route)).collect::<Vec<_>>(),
        [(false, false), (true, true), (false, true)]
    );
    for (node, identity) in nodes.iter().zip([&arm, &cloud, &relay]) {
        let peer = fleet.anchors().verify(identity.chain(), NOW).unwrap();
        assert_eq!(peer.may_route, node.may_route, "{}", node.name);
        assert_eq!(node.certificates[0].serial, peer.cert.serial);
        assert_eq!(node.expires(None), Some(peer.not_after));
        assert_eq!(fleet.node_by_pseudonym(&peer.pseudonym), Some(*node));
        assert_eq!(fleet.node_id_of(&node.name), peer.node_id);
    }
    assert!(cloud.naming_secrets().is_empty() && relay.naming_secrets().len() == 1);
    assert_eq!(fleet.crl_number(), 0);
    assert!(fleet.revocation_list(NOW).is_ok(), "a list that revokes nothing is a list");
}

#[test]
fn no_flipped_bit_of_a_roster_is_accepted() {
    let mut fleet = fleet();
    fleet.enroll(&request("arm-1"), &mut rng(2)).unwrap();
    let (roster, rest) = take(&fleet.to_text(), "SGC ROSTER");
    assert!(Fleet::parse(&format!("{rest}{}", block("SGC ROSTER", &roster))).is_ok());
    for bit in 0..roster.len() * 8 {
        let mut bad = roster.clone();
        bad[bit / 8] ^= 1 << (bit % 8);
        assert!(Fleet::parse(&format!("{rest}{}", block("SGC ROSTER", &bad))).is_err(), "bit {bit}");
    }
    assert!(matches!(Fleet::parse(&rest), Err(FleetError::Missing("SGC ROSTER"))));
    let other = Fleet::create("acme".parse().unwrap(), NOW, &mut rng(9)).unwrap();
    let (foreign, _) = take(&other.to_text(), "SGC ROSTER");
    let swapped = Fleet::parse(&format!("{rest}{}", block("SGC ROSTER", &foreign)));
    assert!(matches!(swapped, Err(FleetError::RosterSignature)));
}

#[test]
fn a_file_from_before_rosters_is_read_and_gets_one_when_it_changes() {
    let mut fleet = fleet();
    let old = fleet.issue(&request("arm-1"), &mut rng(5)).unwrap();
    let (_, rest) = take(&fleet.to_text(), "SGC ROSTER");
    let (about, rest) = take(&rest, "SGC FLEET");
    let version_1 = format!("{}{rest}", block("SGC FLEET", &[&[1], &about[1..]].concat()));
    fleet = Fleet::parse(&version_1).unwrap();
    assert!(!fleet.has_roster() && fleet.nodes().len() == 0);
    assert_eq!(again(&fleet).nodes().len(), 0);
    assert!(matches!(fleet.revoke(&[name("arm-1")], NOW), Err(FleetError::UnknownNode { .. })));
    // A certificate from before the roster can be entered and then revoked.
    let error = fleet.adopt(name("desk"), old.chain(), NOW).unwrap_err();
    assert!(matches!(error, FleetError::Adopt(_)), "{error}");
    fleet.adopt(name("arm-1"), old.chain(), NOW).unwrap();
    fleet.revoke(&[name("arm-1")], NOW).unwrap();
    let fleet = again(&fleet);
    assert!(fleet.has_roster());
    assert!(matches!(anchors(&fleet, NOW).verify(old.chain(), NOW), Err(CertError::Revoked { .. })));
}

#[test]
fn revoking_a_node_takes_back_all_of_its_certificates() {
    let mut fleet = fleet();
    let first = fleet.enroll(&request("arm-1"), &mut rng(2)).unwrap();
    let second = fleet.renew(&name("arm-1"), VALID, at(1), &mut rng(3)).unwrap();
    let desk = fleet.enroll(&request("desk"), &mut rng(4)).unwrap();
    let error = fleet.revoke(&[name("desk"), name("nobody")], at(2)).unwrap_err();
    assert!(matches!(error, FleetError::UnknownNode { node } if node == "nobody"));
    assert!(fleet.nodes().all(|n| fleet.revoked_at(n).is_none()), "all or none");
    fleet.revoke(&[name("arm-1")], at(2)).unwrap();
    let mut fleet = again(&fleet);
    let number = fleet.crl_number();
    assert!(number >= at(2).secs());
    let now = at(2);
    let refused = |fleet: &Fleet, i: &Identity| anchors(fleet, now).verify(i.chain(), now).is_err();
    assert!(refused(&fleet, &first) && refused(&fleet, &second) && !refused(&fleet, &desk));
    // The node can neither be renewed nor be enrolled by mistake, and its revocation stays when it is enrolled on
    // purpose.
    let renewed = fleet.renew(&name("arm-1"), VALID, now, &mut rng(5)).unwrap_err();
    assert!(renewed.to_string().contains("was revoked at 2026-"), "{renewed}");
    let (csr, pseudonym) = (first.csr(), first.pseudonym());
    let renewed = fleet.renew_csr(&csr, &pseudonym, VALID, now, &mut rng(5));
    assert!(matches!(renewed, Err(FleetError::NodeRevoked { .. })));
    assert!(matches!(fleet.credentials_for(&name("arm-1"), vec![]), Err(FleetError::NodeRevoked { .. })));
    let enrolled = fleet.enroll(&request("arm-1"), &mut rng(5));
    assert!(matches!(enrolled, Err(FleetError::NodeRevoked { .. })));
    let third = fleet.enroll(&EnrollRequest { again: true, ..request("arm-1") }, &mut rng(5)).unwrap();
    assert!(refused(&fleet, &first) && refused(&fleet, &second) && !refused(&fleet, &third));
    // Numbers grow also where the clock was set back.
    fleet.revoke(&[name("desk")], NOW).unwrap();
    assert!(fleet.crl_number() > number);
    // Expired certificates need no list.
    fleet.revoke(&[name("desk")], at(100)).unwrap();
    assert!(fleet.nodes().all(|n| n.certificates.is_empty()));
}

#[test]
fn a_node_may_keep_its_key_to_itself() {
    let mut fleet = fleet();
    // The node: a key of its own, and a request with it. Any kind of key will do.
    for (i, kind) in KINDS.into_iter().enumerate() {
        let key = KeyPair::generate_for(kind).unwrap();
        let csr = CertificateParams::default().serialize_request(&key).unwrap();
        let node = format!("arm-{i}");
        let groups = vec!["operators".parse().unwrap()];
        let asked = EnrollRequest { groups, ..request(&node) };
        let member = fleet.enroll_csr(csr.der(), &asked, &mut rng(2)).unwrap();
        let text = member.to_text();
        assert!(!text.contains("PRIVATE KEY"), "the fleet has no key to give");
        let member = Membership::parse(&text).unwrap();
        assert_eq!(member.to_text(), text);
        let identity = Identity::join(member.clone(), key.serialized_der(), &mut rng(3)).unwrap();
        assert_eq!(Identity::parse(&identity.to_text()).unwrap().to_text(), identity.to_text());
        let peer = fleet.anchors().verify(identity.chain(), NOW).unwrap();
        assert!(peer.is_in(&fleet.secret().group_tag("operators")));
        assert_eq!(peer.verify_signature("x", b"y", &identity.sign("x", b"y")), Ok(()));
        assert_eq!(identity.transport_notes().is_empty(), i < 2, "DTLS needs ECDSA");
        let other = KeyPair::generate_for(kind).unwrap();
        let joined = Identity::join(member, other.serialized_der(), &mut rng(3));
        assert_eq!(joined.unwrap_err(), IdentityError::KeyMismatch);
        assert!(matches!(Membership::parse(&identity.to_text()), Err(IdentityError::HasKey)));
        // A request of the finished identity works as well as the first.
        assert!(fleet.enroll_csr(&identity.csr(), &asked, &mut rng(4)).is_ok());
    }
    let key = KeyPair::generate().unwrap();
    let csr = CertificateParams::default().serialize_request(&key).unwrap().der().to_vec();
    for bit in 0..csr.len() * 8 {
        let mut bad = csr.clone();
        bad[bit / 8] ^= 1 << (bit % 8);
        let made = fleet.enroll_csr(&bad, &request("x"), &mut rng(2));
        assert!(matches!(made, Err(FleetError::Request(_))), "bit {bit}");
    }
    assert!(fleet.node(&name("x")).is_none());
    let p521 = KeyPair::generate_for(&rcgen::PKCS_ECDSA_P521_SHA512).unwrap();
    let csr = CertificateParams::default().serialize_request(&p521).unwrap();
    assert!(matches!(fleet.enroll_csr(csr.der(), &request("x"), &mut rng(2)), Err(FleetError::Request(_))));
}

#[test]
fn credentials_renew_an_identity_and_nothing_else() {
    let mut fleet = fleet();
    fleet.set_authority(Some(name("desk")), NOW).unwrap();
    fleet.set_post_quantum(true, NOW).unwrap();
    let groups = vec!["operators".parse().unwrap()];
    let arm = fleet.enroll(&EnrollRequest { groups, ..request("arm-1") }, &mut rng(2)).unwrap();
    let desk = fleet.enroll(&request("desk"), &mut rng(3)).unwrap();
    assert_eq!(arm.authority(), Some(desk.node_id()));
    assert!(arm.post_quantum());
    assert_eq!(fleet.rotate_secret(at(30), &mut rng(4)).unwrap(), 2);
    let mut fleet = again(&fleet);
    let short = Duration::from_secs(86_400);
    let credentials = fleet.renew_csr(&arm.csr(), &arm.pseudonym(), short, at(30), &mut rng(5)).unwrap();
    let renewed = arm.with_credentials(&credentials).unwrap();
    assert_eq!(renewed.not_after().secs(), at(31).secs());
    assert_eq!((renewed.node_id(), renewed.groups()), (arm.node_id(), arm.groups()));
    let peer = arm.anchors().verify(renewed.chain(), at(30)).unwrap();
    assert_eq!(peer.verify_signature("x", b"y", &arm.sign("x", b"y")), Ok(()), "the key is the same");
    let generations = |i: &Identity| i.naming_secrets().iter().map(|n| n.generation).collect::<Vec<_>>();
    assert_eq!((generations(&arm), generations(&renewed)), (vec![1], vec![2, 1]));
    assert_eq!(renewed.naming_secrets()[1].secret.expose(), fleet.secret().expose());
    let back = Identity::parse(&renewed.to_text()).unwrap();
    assert_eq!(back.to_text(), renewed.to_text());
    assert_eq!(
        (generations(&back), back.authority(), back.post_quantum()),
        (vec![2, 1], Some(desk.node_id()), true)
    );

    let with = |change: &dyn Fn(&mut Credentials)| {
        let mut credentials = credentials.clone();
        change(&mut credentials);
        renewed.with_credentials(&credentials).map(drop)
    };
    assert_eq!(with(&|_| {}), Ok(()));
    let foreign = fleet.renew_csr(&desk.csr(), &desk.pseudonym(), short, at(30), &mut rng(6)).unwrap();
    assert_eq!(with(&|c| c.chain = foreign.chain.clone()), Err(IdentityError::KeyMismatch));
    // Even with its own key a node cannot become another one.
    let other = fleet.renew_csr(&arm.csr(), &desk.pseudonym(), short, at(30), &mut rng(6)).unwrap();
    assert_eq!(
        with(&|c| c.chain = other.chain.clone()),
        Err(IdentityError::NameMismatch { node: name("arm-1") })
    );
    assert_eq!(with(&|c| drop(c.secrets.remove(0))), Err(IdentityError::OldSecrets));
    let secret = SecretBytes::new([7; 32]);
    assert_eq!(with(&|c| c.secrets[1].secret = secret.clone()), Err(IdentityError::Generations));
    assert_eq!(with(&|c| c.secrets.reverse()), Err(IdentityError::Generations));
    assert_eq!(with(&|c| c.secrets.clear()), Err(IdentityError::Generations));
    assert!(matches!(with(&|c| c.chain.clear()), Err(IdentityError::Missing(_))));
    assert!(matches!(with(&|c| c.chain = vec![Bytes::from_static(b"x")]), Err(IdentityError::Chain(_))));
    // A router gets certificates and no secret, and takes none.
    let cloud = fleet.enroll(&EnrollRequest { router: true, ..request("cloud") }, &mut rng(7)).unwrap();
    let own = fleet.renew_csr(&cloud.csr(), &cloud.pseudonym(), short, at(1), &mut rng(8)).unwrap();
    assert!(own.secrets.is_empty() && cloud.with_credentials(&own).is_ok());
    fleet.enroll(&EnrollRequest { router: true, ..request("other") }, &mut rng(7)).unwrap();
    let pseudonym = fleet.secret().pseudonym("other");
    let other = fleet.renew_csr(&cloud.csr(), &pseudonym, short, at(1), &mut rng(8)).unwrap();
    let error = cloud.with_credentials(&other).unwrap_err();
    assert_eq!(error, IdentityError::NameMismatch { node: name("cloud") });
    let given = Credentials { secrets: credentials.secrets.clone(), ..own };
    assert_eq!(cloud.with_credentials(&given).unwrap_err(), IdentityError::Generations);
}

#[test]
fn secrets_rotate_and_nobody_becomes_another() {
    let mut fleet = fleet();
    let before = fleet.enroll(&request("arm-1"), &mut rng(2)).unwrap();
    assert!(matches!(fleet.retire_secrets(2), Err(FleetError::NewestGeneration { newest: 1 })));
    for generation in 2..=SECRET_GENERATIONS_MAX as u32 {
        assert_eq!(fleet.rotate_secret(NOW, &mut rng(10)).unwrap(), generation);
    }
    assert!(matches!(fleet.rotate_secret(NOW, &mut rng(10)), Err(FleetError::TooManyGenerations)));
    fleet.retire_secrets(7).unwrap();
    let mut fleet = again(&fleet);
    assert_eq!(fleet.generations().iter().map(|g| g.number).collect::<Vec<_>>(), [7, 8]);
    // Numbers are not used twice.
    assert_eq!(fleet.rotate_secret(NOW, &mut rng(10)).unwrap(), 9);
    let after = fleet.enroll(&request("arm-1"), &mut rng(3)).unwrap();
    let after = Identity::parse(&after.to_text()).unwrap();
    assert_eq!(after.naming_secrets().iter().map(|n| n.generation).collect::<Vec<_>>(), [9, 8, 7]);
    assert_eq!((after.node_id(), after.pseudonym()), (before.node_id(), before.pseudonym()));
    assert_eq!(after.fleet_secret().unwrap().expose(), before.fleet_secret().unwrap().expose());
    // The blocks of secrets are those of the roster.
    let (stored, rest) = take(&fleet.to_text(), "SGC NAMING SECRET");
    assert!(matches!(Fleet::parse(&rest), Err(FleetError::NamingSecret)));
    let mut other = stored.clone();
    other[10] ^= 1;
    let changed = format!("{rest}{}", block("SGC NAMING SECRET", &other));
    assert!(matches!(Fleet::parse(&changed), Err(FleetError::NamingSecret)));
    let shown = format!("{fleet:?} {:?} {:?}", fleet.naming_secrets(), fleet.generations());
    for secret in fleet.naming_secrets() {
        let list = format!("{:?}", &secret.secret.expose()[..4]);
        assert!(!shown.contains(list.trim_matches(['[', ']'])), "{shown}");
    }
}

#[test]
fn an_identity_from_before_generations_is_read() {
    let arm = fleet().enroll(&request("arm-1"), &mut rng(2)).unwrap();
    let (about, rest) = take(&arm.to_text(), "SGC IDENTITY");
    let version_1 = [&[1], &about[1..about.len() - 2]].concat();
    let old = Identity::parse(&format!("{}{rest}", block("SGC IDENTITY", &version_1))).unwrap();
    assert_eq!(old.naming_secrets().iter().map(|n| n.generation).collect::<Vec<_>>(), [1]);
    assert_eq!((old.authority(), old.post_quantum(), old.node_id()), (None, false, arm.node_id()));
}

/// A CA of the kind that a company has already: certificate and key.
fn company_ca(
    kind: &'static SignatureAlgorithm,
    usages: &[KeyUsagePurpose],
    ca: IsCa,
) -> (CertificateParams, KeyPair) {
    let mut params = CertificateParams::default();
    params.is_ca = ca;
    params.key_usages = usages.to_vec();
    params.distinguished_name.push(DnType::CountryName, "DE");
    params.distinguished_name.push(DnType::OrganizationName, "Füchse & Söhne");
    params.distinguished_name.push(DnType::CommonName, "Company CA");
    (params, KeyPair::generate_for(kind).unwrap())
}

#[test]
fn a_fleet_can_be_made_around_a_ca_that_exists() {
    let ca = IsCa::Ca(BasicConstraints::Unconstrained);
    for kind in KINDS {
        let (params, key) = company_ca(kind, &[KeyUsagePurpose::KeyCertSign, KeyUsagePurpose::CrlSign], ca);
        let certificate: CertificateDer<'_> = params.self_signed(&key).unwrap().into();
        let import = |certificate: &CertificateDer<'static>, key: &KeyPair| {
            Fleet::import(
                "acme".parse().unwrap(),
                certificate.clone(),
                key.serialized_der(),
                NOW,
                &mut rng(1),
            )
        };
        let mut fleet = again(&import(&certificate, &key).unwrap());
        let arm = fleet.enroll(&request("arm-1"), &mut rng(2)).unwrap();
        assert!(fleet.anchors().verify(arm.chain(), NOW).is_ok());
        fleet.revoke(&[name("arm-1")], NOW).unwrap();
        let fleet = again(&fleet);
        assert!(matches!(anchors(&fleet, NOW).verify(arm.chain(), NOW), Err(CertError::Revoked { .. })));
        let other = KeyPair::generate_for(kind).unwrap();
        assert!(matches!(import(&certificate, &other), Err(FleetError::KeyMismatch)));
    }
    let refused = |usages: &[KeyUsagePurpose], ca: IsCa| {
        let (params, key) = company_ca(KINDS[0], usages, ca);
        let certificate = params.self_signed(&key).unwrap().into();
        let made =
            Fleet::import("acme".parse().unwrap(), certificate, key.serialized_der(), NOW, &mut rng(1));
        made.unwrap_err().to_string()
    };
    assert!(refused(&[], IsCa::ExplicitNoCa).contains("basic constraints"));
    assert!(refused(&[KeyUsagePurpose::CrlSign], ca).contains("keyCertSign"));
    assert!(refused(&[KeyUsagePurpose::KeyCertSign], ca).contains("cRLSign"));
}

/// `DC=com, DC=example, CN=Company CA`, as Active Directory names its CAs; made with OpenSSL.
const DOMAIN_CA: &str = "MIIB7TCCAZOgAwIBAgIUZHv8fzvf6HV5QlQk/9w0JeXKtoAwCgYIKoZIzj0EAwIwQzETMBEGCgmSJomT8ixkARkWA2NvbTEX\
    MBUGCgmSJomT8ixkARkWB2V4YW1wbGUxEzARBgNVBAMMCkNvbXBhbnkgQ0EwIBcNMjYxMTIxMTUyMTIzWhgPMjEyNjEwMjgx\
    NTIxMjNaMEMxEzARBgoJkiaJk/IsZAEZFgNjb20xFzAVBgoJkiaJk/IsZAEZFgdleGFtcGxlMRMwEQYDVQQDDApDb21wYW55\
    IENBMFkwEwYHKoZIzj0CAQYIKoZIzj0DAQcDQgAE6uXTkU5V1qpMxi2PvL4RlqH8wJVCh7hzaBGzY9NiuSHHjI8+dsO2UCJZ\
    A2HB0eYVqwh3oPz2qq7cCTd3g7xrzKNjMGEwHQYDVR0OBBYEFMYWPWZxPUmdkxomqRLLD2RfLZGBMB8GA1UdIwQYMBaAFMYW\
    PWZxPUmdkxomqRLLD2RfLZGBMA8GA1UdEwEB/wQFMAMBAf8wDgYDVR0PAQH/BAQDAgEGMAoGCCqGSM49BAMCA0gAMEUCIFBK\
    QDNeX7nlAbKPy2G47E7Bp5Xra+KEv27kqa9O6tGmAiEAzR4s1Lccmqcu+hFCkVLaN/y9IyNlicU8wAifxZIrGew=";
const DOMAIN_CA_KEY: &str = "MIGHAgEAMBMGByqGSM49AgEGCCqGSM49AwEHBG0wawIBAQQgiygFb+2mkVKOleUgvOm/bPCjeOFUDbH6EKyAb9eVUPChRANC\
    AATq5dORTlXWqkzGLY+8vhGWofzAlUKHuHNoEbNj02K5IceMjz52w7ZQIlkDYcHR5hWrCHeg/PaqrtwJN3eDvGvM";

#[test]
fn a_ca_whose_name_cannot_be_written_is_refused_and_not_misnamed() {
    let certificate = CertificateDer::from(STANDARD.decode(DOMAIN_CA).unwrap());
    let key = STANDARD.decode(DOMAIN_CA_KEY).unwrap();
    let made = Fleet::import("acme".parse().unwrap(), certificate, &key, at(30), &mut rng(1));
    assert!(matches!(made, Err(FleetError::CaName)), "{made:?}");
}

#[test]
fn certificates_of_another_pki_make_identities() {
    let (params, ca_key) = company_ca(KINDS[1], &[], IsCa::Ca(BasicConstraints::Unconstrained));
    let ca: CertificateDer<'_> = params.self_signed(&ca_key).unwrap().into();
    let secret = FleetSecret::from_bytes([5; 32]);
    let uri = |s: &str| SanType::URI(s.try_into().unwrap());
    let import = |kind, sans: Vec<SanType>, secret: Option<&FleetSecret>| {
        let key = KeyPair::generate_for(kind).unwrap();
        let mut leaf = CertificateParams::default();
        leaf.subject_alt_names = sans;
        let leaf = leaf.signed_by(&key, &Issuer::from_params(&params, &ca_key)).unwrap();
        let import = Import {
            node: name("arm-1"),
            fleet: "acme".parse().unwrap(),
            chain: vec![leaf.into()],
            key: Zeroizing::new(key.serialize_der()),
            cas: vec![ca.clone()],
            secret: secret.cloned(),
            groups: vec![],
            may_route: false,
        };
        Identity::import(import, &mut rng(1))
    };
    let node = uri(&format!("sgc:node:{}", secret.pseudonym("arm-1")));
    for kind in KINDS {
        let arm = import(kind, vec![node.clone()], Some(&secret)).unwrap();
        assert_eq!(Identity::parse(&arm.to_text()).unwrap().node_id(), arm.node_id());
        assert_eq!(arm.node_id_of("arm-1"), Some(arm.node_id()));
        assert_eq!(arm.naming_secrets().len(), 1);
    }
    let router = import(KINDS[0], vec![node, uri("sgc:role:router")], None).unwrap();
    assert!(router.as_peer().may_route && router.naming_secrets().is_empty());
    let nameless = import(KINDS[0], vec![uri("https://example.com")], Some(&secret)).unwrap_err();
    let IdentityError::Chain(cause) = &nameless else { panic!("{nameless}") };
    assert!(cause.to_string().contains("sgc fleet request"), "{cause}");
    let other = uri(&format!("sgc:node:{}", secret.pseudonym("desk")));
    let named = import(KINDS[0], vec![other], Some(&secret)).unwrap_err();
    assert!(matches!(named, IdentityError::NameMismatch { .. }));
}

#[test]
fn a_roster_knows_who_was_handed_which_secret() {
    let (mut fleet, now) = (fleet(), at);
    let enroll = |fleet: &mut Fleet, node: &str, router| {
        let request = EnrollRequest { router, ..EnrollRequest::new(name(node), NOW) };
        fleet.enroll(&request, &mut rng(2)).unwrap();
    };
    enroll(&mut fleet, "arm-1", false);
    enroll(&mut fleet, "desk", false);
    enroll(&mut fleet, "gone", false);
    enroll(&mut fleet, "cloud", true);
    let generation = fleet.rotate_secret(now(1), &mut rng(3)).unwrap();
    fleet.revoke(&[name("gone")], now(1)).unwrap();
    let lacking = |fleet: &Fleet, days| {
        fleet.lacking(generation, now(days)).map(|n| n.name.to_string()).collect::<Vec<_>>()
    };
    assert_eq!(lacking(&fleet, 1), ["arm-1", "desk"], "neither the router nor who is revoked");
    assert!(fleet.note_handed(&name("arm-1"), now(1)).unwrap(), "news");
    assert!(!fleet.note_handed(&name("arm-1"), now(1)).unwrap(), "told a moment ago");
    assert!(!fleet.note_handed(&name("nobody"), now(1)).unwrap());
    assert_eq!(lacking(&fleet, 1), ["desk"]);
    assert!(fleet.note_handed(&name("arm-1"), now(3)).unwrap(), "seen again");
    let kept = Fleet::parse(&fleet.to_text()).unwrap();
    let arm = kept.node(&name("arm-1")).unwrap();
    assert_eq!((arm.generation, arm.seen), (2, Some(now(3))));
    assert_eq!(kept.node(&name("cloud")).unwrap().generation, 0);
    // Nodes that were not seen for long, or have no valid certificate, need not be waited for.
    assert_eq!(lacking(&fleet, 30), ["desk"]);
    assert!(lacking(&fleet, 31).is_empty());
    fleet.renew(&name("desk"), Duration::from_secs(86_400), now(40), &mut rng(4)).unwrap();
    assert!(lacking(&fleet, 40).is_empty(), "it has the newest now");

    // Another copy knows of a later hand-out, and of no other change.
    let mut copy = Fleet::parse(&fleet.to_text()).unwrap();
    copy.note_handed(&name("arm-1"), now(41)).unwrap();
    let merged = fleet.merge(&copy, now(42)).unwrap();
    assert!(merged.changed.is_empty(), "{merged:?}");
    assert_eq!(fleet.node(&name("arm-1")).unwrap().seen, Some(now(41)));
}
