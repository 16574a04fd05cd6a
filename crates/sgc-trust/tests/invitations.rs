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

fn invite(fleet: &mut Fleet, node: &str) -> Invitation {
    fleet.invite(&request(node), WITHIN, vec!["quic://hub:7447".into()], &mut rng(2)).unwrap()
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

#[test]
fn an_invited_node_may_be_revoked_and_invited_again() {
    let mut fleet = fleet();
    let first = invite(&mut fleet, "arm-7").identity(&mut rng(3)).unwrap();
    let arm: NodeName = "arm-7".parse().unwrap();
    fleet.revoke(std::slice::from_ref(&arm), NOW).unwrap();
    assert!(matches!(redeem(&mut fleet, &first, &key(5)), Err(FleetError::NodeRevoked { .. })));
    let refused = fleet.invite(&request("arm-7"), WITHIN, Vec::new(), &mut rng(8));
    assert!(matches!(refused, Err(FleetError::NodeRevoked { .. })), "{refused:?}");
    let again = EnrollRequest { again: true, ..request("arm-7") };
    let second =
        fleet.invite(&again, WITHIN, Vec::new(), &mut rng(8)).unwrap().identity(&mut rng(3)).unwrap();
    assert!(
        matches!(redeem(&mut fleet, &first, &key(5)), Err(FleetError::InvitationUsed { .. })),
        "revoked with its node"
    );
    let made = redeem(&mut fleet, &second, &key(5)).unwrap();
    assert_eq!(Identity::join(made, key(5).key(), &mut rng(6)).unwrap().as_peer().incarnation, 1);
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
    let made = lonely.invite(&request("arm-7"), WITHIN, Vec::new(), &mut rng(2));
    assert!(matches!(made, Err(FleetError::NoAuthority)), "{made:?}");
    let mut fleet = fleet();
    for within in [Duration::ZERO, INVITATION_TIME_MAX + Duration::from_secs(1)] {
        let made = fleet.invite(&request("arm-7"), within, Vec::new(), &mut rng(2));
        assert!(matches!(made, Err(FleetError::InvitationTime)), "{made:?}");
    }
    for routers in [vec!["quic://r:1".to_owned(); INVITATION_ROUTERS_MAX + 1], vec!["r".repeat(301)]] {
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
