//! Invitations: who may use one, how often, and the errors of texts that are none.
#![allow(clippy::unwrap_used, reason = "helpers of tests are tests")]

use std::time::Duration;

use rand_chacha::ChaCha20Rng;
use rand_core::SeedableRng as _;
use sgc_trust::*;
use sgc_wire::{AdvertBody, Blind, UnixMillis};

const NOW: UnixMillis = UnixMillis(1_795_000_000_000);
const WITHIN: Duration = Duration::from_secs(900);
const VALID: Duration = Duration::from_secs(30 * 86_400);

fn rng(seed: u64) -> ChaCha20Rng {
    ChaCha20Rng::seed_from_u64(seed)
}

fn fleet() -> Fleet {
    let mut fleet = Fleet::create("acme".parse().unwrap(), NOW, &mut rng(1)).unwrap();
    fleet.set_authority(Some("keeper".parse().unwrap()), NOW).unwrap();
    fleet
}

fn request(node: &str) -> EnrollRequest {
    let groups = vec!["arms".parse().unwrap()];
    EnrollRequest { groups, valid: VALID, ..EnrollRequest::new(node.parse().unwrap(), NOW) }
}

fn routers() -> Vec<String> {
    vec!["quic://hub:7447".to_owned()]
}

fn invite(fleet: &mut Fleet, node: &str) -> Invitation {
    fleet.invite(&request(node), WITHIN, routers(), &mut rng(2)).unwrap()
}

fn key(seed: u64) -> KeyRequest {
    KeyRequest::generate(None, &mut rng(seed)).unwrap()
}

fn redeem(fleet: &mut Fleet, holder: &Identity, key: &KeyRequest) -> Result<Membership, FleetError> {
    fleet.redeem(key.csr(), holder.as_peer(), NOW, &mut rng(4))
}

#[test]
fn a_code_makes_its_node_once() {
    let mut fleet = fleet();
    let code = invite(&mut fleet, "arm-7").to_text();
    let read = Invitation::parse(&format!(" {}\n", *code)).unwrap();
    assert_eq!((read.node.as_str(), read.fleet.as_str()), ("arm-7", "acme"));
    assert_eq!((read.authority.as_str(), &read.routers[..]), ("keeper", &["quic://hub:7447".to_owned()][..]));
    assert_eq!(read.authority_id, fleet.node_id_of(&"keeper".parse().unwrap()));
    assert_eq!(read.validity().unwrap().1, UnixMillis(NOW.0 + 900_000));

    // The holder is nobody: no secret, no group, no role, and not the node.
    let holder = read.identity(&mut rng(3)).unwrap();
    assert_eq!(holder.as_peer().invitation, Some(VALID));
    assert!(holder.fleet_secret().is_none() && holder.groups().is_empty() && !holder.as_peer().may_route);
    assert_ne!(holder.node_id(), fleet.node_id_of(&"arm-7".parse().unwrap()));

    // The file is read again in between, as each operation does.
    let mut fleet = Fleet::parse(&fleet.to_text()).unwrap();
    let made = redeem(&mut fleet, &holder, &key(5)).unwrap();
    let arm = Identity::join(made, key(5).key(), &mut rng(6)).unwrap();
    assert_eq!(arm.node_id(), fleet.node_id_of(&"arm-7".parse().unwrap()));
    assert_eq!(arm.groups(), [fleet.secret().group_tag("arms")]);
    assert_eq!((arm.as_peer().invitation, arm.not_after()), (None, UnixMillis(NOW.0 + 30 * 86_400_000)));
    assert_eq!(arm.fleet_secret().unwrap().expose(), fleet.secret().expose());

    let mut fleet = Fleet::parse(&fleet.to_text()).unwrap();
    for seed in [5, 7] {
        let again = redeem(&mut fleet, &holder, &key(seed));
        assert!(matches!(again, Err(FleetError::InvitationUsed { at: NOW, .. })), "{again:?}");
    }
    // A member has no invitation to use.
    let member = redeem(&mut fleet, &arm, &key(7));
    assert!(matches!(member, Err(FleetError::NotInvited)), "{member:?}");
}

/// Computed with Python's library: `scripts/join-code-vector.py` prints it, given the CA of `tokens.rs` in base64. The
/// CA stands for both certificates.
#[test]
fn golden_vector() {
    let text = concat!(
        "sgc-join-1:AQAAAAVhcm0tNwAAAARhY21lAAAABmtlZXBlciIiIiIiIiIiIiIiIiIiIiIiIiIiIiIiIiIiIiIiIiI",
        "iAAAAAgAAAB5xdWljOi8vcm91dGVyLmxhYi5leGFtcGxlOjc0NDcAAAAHbWRuczovLwEAAAGDMIIBfzCCASWgAwIBA",
        "gIUI28IXvyZ7Gj2zMB3KCGFm5tjGvEwCgYIKoZIzj0EAwIwDDEKMAgGA1UEAwwBdjAgFw0yNjExMjExNTA4MDJaGA8",
        "yMTI2MTAyODE1MDgwMlowDDEKMAgGA1UEAwwBdjBZMBMGByqGSM49AgEGCCqGSM49AwEHA0IABHyMue33KfolwjYak",
        "54PA5JUnpz0lLOM3LBdhx5b8W2KeR7N3B0W2RBRL3Hthbdjx4H8Zyw8QuhvIAON6trqQfGjYzBhMB0GA1UdDgQWBBS",
        "Z_J0SKxg30CLP_9a99SAj6z-_RjAfBgNVHSMEGDAWgBSZ_J0SKxg30CLP_9a99SAj6z-_RjAPBgNVHRMBAf8EBTADA",
        "QH_MA4GA1UdDwEB_wQEAwICBDAKBggqhkjOPQQDAgNIADBFAiB66uLPBO-Muy_x07lck4JHO_NV8yJgloy4Hc4owYI",
        "yIgIhAMREfJaNdITzjq9bkR5nzPdhYceuL7MCLyDUdUH0Z3UAAAABgzCCAX8wggEloAMCAQICFCNvCF78mexo9szAd",
        "yghhZubYxrxMAoGCCqGSM49BAMCMAwxCjAIBgNVBAMMAXYwIBcNMjYxMTIxMTUwODAyWhgPMjEyNjEwMjgxNTA4MDJ",
        "aMAwxCjAIBgNVBAMMAXYwWTATBgcqhkjOPQIBBggqhkjOPQMBBwNCAAR8jLnt9yn6JcI2GpOeDwOSVJ6c9JSzjNywX",
        "YceW_FtinkezdwdFtkQUS9x7YW3Y8eB_GcsPELobyADjera6kHxo2MwYTAdBgNVHQ4EFgQUmfydEisYN9Aiz__WvfU",
        "gI-s_v0YwHwYDVR0jBBgwFoAUmfydEisYN9Aiz__WvfUgI-s_v0YwDwYDVR0TAQH_BAUwAwEB_zAOBgNVHQ8BAf8EB",
        "AMCAgQwCgYIKoZIzj0EAwIDSAAwRQIgeurizwTvjLsv8dO5XJOCRzvzVfMiYJaMuB3OKMGCMiICIQDERHyWjXSE846",
        "vW5EeZ8z3YWHHri-zAi8g1HVB9Gd1ADMzMzMzMzMzMzMzMzMzMzMzMzMzMzMzMzMzMzMzMzMzGGpLSA",
    );
    let read = Invitation::parse(text).unwrap();
    assert_eq!(read.to_text().as_str(), text);
    assert_eq!(
        (read.node.as_str(), read.fleet.as_str(), read.authority.as_str()),
        ("arm-7", "acme", "keeper")
    );
    assert_eq!((read.authority_id.0, read.post_quantum), ([0x22; 32], true));
    assert_eq!(read.routers, ["quic://router.lab.example:7447", "mdns://"]);
    // The certificate is none of an invitation, and not of that key.
    assert!(read.identity(&mut rng(1)).is_err());
}

#[test]
fn an_invited_node_may_be_revoked_and_invited_again() {
    let mut fleet = fleet();
    let first = invite(&mut fleet, "arm-7").identity(&mut rng(3)).unwrap();
    let arm: NodeName = "arm-7".parse().unwrap();
    fleet.revoke(std::slice::from_ref(&arm), NOW).unwrap();
    assert!(matches!(redeem(&mut fleet, &first, &key(5)), Err(FleetError::NodeRevoked { .. })));
    let refused = fleet.invite(&request("arm-7"), WITHIN, routers(), &mut rng(8));
    assert!(matches!(refused, Err(FleetError::NodeRevoked { .. })), "{refused:?}");
    let again = EnrollRequest { again: true, ..request("arm-7") };
    let second = fleet.invite(&again, WITHIN, routers(), &mut rng(8)).unwrap().identity(&mut rng(3)).unwrap();
    let late = redeem(&mut fleet, &first, &key(5));
    assert!(matches!(late, Err(FleetError::InvitationUsed { .. })), "the second one replaced it: {late:?}");
    let made = redeem(&mut fleet, &second, &key(5)).unwrap();
    assert_eq!(Identity::join(made, key(5).key(), &mut rng(6)).unwrap().as_peer().incarnation, 1);
}

#[test]
fn a_node_that_was_enrolled_again_leaves_its_old_invitation_behind() {
    let mut fleet = fleet();
    let holder = invite(&mut fleet, "arm-7").identity(&mut rng(3)).unwrap();
    fleet.revoke(&["arm-7".parse().unwrap()], NOW).unwrap();
    fleet.enroll(&EnrollRequest { again: true, ..request("arm-7") }, &mut rng(8)).unwrap();
    let late = redeem(&mut fleet, &holder, &key(5));
    assert!(matches!(late, Err(FleetError::InvitationRevoked { .. })), "{late:?}");
    // The list of the revocation names the certificate, so that routers cut its link.
    let list = fleet.revocation_list(NOW).unwrap();
    let anchors = fleet.anchors().with_crl(&list, NOW).unwrap().unwrap();
    assert!(matches!(anchors.verify(holder.chain(), NOW), Err(CertError::Revoked { .. })));
}

#[test]
fn a_later_invitation_ends_an_earlier_one() {
    let mut fleet = fleet();
    let first = invite(&mut fleet, "arm-7").identity(&mut rng(3)).unwrap();
    let other = EnrollRequest { groups: vec!["guests".parse().unwrap()], ..request("arm-7") };
    let second = fleet.invite(&other, WITHIN, routers(), &mut rng(8)).unwrap().identity(&mut rng(3)).unwrap();
    assert!(matches!(redeem(&mut fleet, &first, &key(5)), Err(FleetError::InvitationUsed { .. })));
    redeem(&mut fleet, &second, &key(5)).unwrap();
}

/// The certificate of an invitation is none of its node: it does not make a node look enrolled, and keeps no old secret
/// in use.
#[test]
fn an_open_invitation_does_not_count_as_a_certificate_of_its_node() {
    let mut fleet = fleet();
    invite(&mut fleet, "arm-7");
    let node = fleet.node(&"arm-7".parse().unwrap()).unwrap();
    assert!(node.certificates[0].is_invitation() && node.expires(None).is_none());
    let newest = fleet.rotate_secret(NOW, &mut rng(7)).unwrap();
    assert_eq!(fleet.lacking(newest, NOW).count(), 0);
}

#[test]
fn a_certificate_holds_no_longer_than_the_ca_and_an_hour_stays_an_hour() {
    let (mut fleet, mut codes) = (fleet(), rng(8));
    for valid in [Duration::from_secs(3600), Duration::from_secs(200 * 365 * 86_400)] {
        let request = EnrollRequest { valid, ..request("arm-7") };
        let holder = fleet.invite(&request, WITHIN, routers(), &mut codes).unwrap();
        let holder = holder.identity(&mut rng(3)).unwrap();
        let made = redeem(&mut fleet, &holder, &key(5)).unwrap();
        let arm = Identity::join(made, key(5).key(), &mut rng(6)).unwrap();
        let end = UnixMillis(NOW.0 + valid.as_millis() as u64).min(fleet.not_after());
        assert_eq!(arm.not_after().0 / 1000, end.0 / 1000);
    }
    let request = EnrollRequest { valid: Duration::from_millis(900), ..request("arm-7") };
    let made = fleet.invite(&request, WITHIN, routers(), &mut rng(2));
    assert!(matches!(made, Err(FleetError::InvitationTime)), "{made:?}");
}

#[test]
fn copies_of_a_file_know_each_others_invitations_after_a_merge() {
    let mut fleet = fleet();
    let mut old = Fleet::parse(&fleet.to_text()).unwrap();
    let holder = invite(&mut fleet, "arm-7").identity(&mut rng(3)).unwrap();
    assert!(matches!(redeem(&mut old, &holder, &key(5)), Err(FleetError::NotInvited)));
    old.merge(&fleet, NOW).unwrap();
    redeem(&mut old, &holder, &key(5)).unwrap();
    fleet.merge(&old, NOW).unwrap();
    assert!(matches!(redeem(&mut fleet, &holder, &key(5)), Err(FleetError::InvitationUsed { .. })));
}

#[test]
fn a_node_that_is_invited_again_keeps_its_certificate_and_its_place_in_the_roster() {
    let mut fleet = fleet();
    let arm = fleet.enroll(&request("arm-7"), &mut rng(9)).unwrap();
    let before = fleet.node(arm.node_name()).unwrap().clone();
    invite(&mut fleet, "arm-7");
    let after = fleet.node(arm.node_name()).unwrap();
    assert_eq!(
        (after.seen, after.generation, after.changed),
        (before.seen, before.generation, before.changed)
    );
    assert_eq!((before.certificates.len(), after.certificates.len()), (1, 2));
    assert!(fleet.anchors().verify(arm.chain(), NOW).is_ok());
    // Only invited, a node was handed no secret and was not seen.
    invite(&mut fleet, "arm-8");
    let new = fleet.node(&"arm-8".parse().unwrap()).unwrap();
    assert_eq!((new.seen, new.generation), (None, 0));
}

#[test]
fn impossible_invitations_are_not_made() {
    let mut lonely = Fleet::create("acme".parse().unwrap(), NOW, &mut rng(1)).unwrap();
    let made = lonely.invite(&request("arm-7"), WITHIN, routers(), &mut rng(2));
    assert!(matches!(made, Err(FleetError::NoAuthority)), "{made:?}");
    let mut fleet = fleet();
    for within in [Duration::ZERO, INVITATION_TIME_MAX + Duration::from_secs(1)] {
        let made = fleet.invite(&request("arm-7"), within, routers(), &mut rng(2));
        assert!(matches!(made, Err(FleetError::InvitationTime)), "{made:?}");
    }
    let crowd = vec!["quic://r:1".to_owned(); INVITATION_ROUTERS_MAX + 1];
    for routers in [crowd, vec!["r".repeat(301)], Vec::new()] {
        let made = fleet.invite(&request("arm-7"), WITHIN, routers, &mut rng(2));
        assert!(matches!(made, Err(FleetError::InvitationRouters)), "{made:?}");
    }
    assert_eq!(fleet.nodes().len(), 0, "no node is left behind");
}

#[test]
fn the_holder_of_an_invitation_is_believed_nothing() {
    let mut fleet = fleet();
    let holder = invite(&mut fleet, "arm-7").identity(&mut rng(3)).unwrap();
    let everyone = Grantees { fleets: [holder.as_peer().ca].into(), ..Grantees::default() };
    assert_eq!(everyone.find(holder.as_peer()), None);
    let itself = Grantees { nodes: [holder.node_id()].into(), ..Grantees::default() };
    assert_eq!(itself.find(holder.as_peer()), None);
    let body = AdvertBody {
        chain: holder.chain_bytes(),
        seq: NOW.0,
        issued_at: NOW,
        lease_ms: 1000,
        withdraw: false,
        blinds: vec![Blind([1; 32])],
    };
    let advert = verify_advert(fleet.anchors(), &holder.sign_advert(&body), NOW);
    assert!(matches!(advert, Err(SignedError::Invited)), "{advert:?}");
    // It ends with its time.
    let later = UnixMillis(NOW.0 + 901_000);
    assert!(matches!(fleet.anchors().verify(holder.chain(), later), Err(CertError::Expired { .. })));
}

#[test]
fn other_texts_are_no_codes() {
    let text = invite(&mut fleet(), "arm-7").to_text();
    assert!(text.len() < 1600, "{}", text.len());
    let said = |text: &str| Invitation::parse(text).unwrap_err();
    assert!(matches!(said(""), InvitationError::Prefix));
    assert!(matches!(said("sgc-token-1:AAAA"), InvitationError::Prefix));
    assert!(matches!(said("sgc-join-2:AAAA"), InvitationError::Version));
    assert!(matches!(said("sgc-join-1:AA=A"), InvitationError::NotBase64));
    assert!(matches!(said("sgc-join-1:AAAAAAAA"), InvitationError::Checksum));
    assert!(matches!(said(&text[..text.len() - 4]), InvitationError::NotBase64 | InvitationError::Checksum));
    let long = format!("{INVITATION_PREFIX}{}", "A".repeat(INVITATION_TEXT_BYTES_MAX));
    assert!(matches!(said(&long), InvitationError::TooLong { .. }));
    for at in INVITATION_PREFIX.len()..text.len() {
        let mut altered = text.as_bytes().to_vec();
        altered[at] = if altered[at] == b'A' { b'B' } else { b'A' };
        assert!(Invitation::parse(std::str::from_utf8(&altered).unwrap()).is_err(), "at {at}");
    }
}

/// The longest code that can be made is not too long to be read.
#[test]
fn a_code_with_every_field_at_its_bound_fits() {
    let mut fleet = Fleet::create("f".repeat(64).parse().unwrap(), NOW, &mut rng(1)).unwrap();
    fleet.set_authority(Some("k".repeat(64).parse().unwrap()), NOW).unwrap();
    let routers = vec!["r".repeat(300); INVITATION_ROUTERS_MAX];
    let code = fleet.invite(&request(&"n".repeat(64)), INVITATION_TIME_MAX, routers, &mut rng(2)).unwrap();
    assert!(Invitation::parse(&code.to_text()).is_ok());
}
