//! Copies of one fleet's file that go their own ways: nothing that one of them revoked is undone by another, in
//! whatever order lists come and copies are merged.
#![allow(clippy::unwrap_used, reason = "helpers of tests are tests")]

use std::collections::BTreeMap;

use bytes::Bytes;
use rand_chacha::ChaCha20Rng;
use rand_core::{RngCore as _, SeedableRng as _};
use sgc_trust::*;
use sgc_wire::{Pseudonym, UnixMillis};

const NOW: UnixMillis = UnixMillis(1_795_000_000_000);
const HOUR: u64 = 3_600_000;
const YEAR: u64 = 366 * 24 * HOUR;
const VALID: std::time::Duration = LEAF_VALIDITY_DEFAULT;

fn rng(seed: u64) -> ChaCha20Rng {
    ChaCha20Rng::seed_from_u64(seed)
}

fn name(node: &str) -> NodeName {
    node.parse().unwrap()
}

fn at(hours: u64) -> UnixMillis {
    UnixMillis(NOW.0 + hours * HOUR)
}

fn request(node: &str, hours: u64) -> EnrollRequest {
    EnrollRequest::new(name(node), at(hours))
}

/// Another copy of the file, as it is now.
fn copy(fleet: &Fleet) -> Fleet {
    Fleet::parse(&fleet.to_text()).unwrap()
}

/// A fleet with these nodes, and an older copy of its file.
fn two_copies(nodes: &[&str]) -> (Fleet, Fleet) {
    let mut fleet = Fleet::create("acme".parse().unwrap(), NOW, &mut rng(1)).unwrap();
    for (seed, node) in nodes.iter().enumerate() {
        fleet.enroll(&request(node, 0), &mut rng(10 + seed as u64)).unwrap();
    }
    let old = copy(&fleet);
    (fleet, old)
}

/// Returns the anchors with a list, if it is news.
fn with(anchors: &TrustAnchors, list: &[u8], hours: u64) -> TrustAnchors {
    anchors.with_crl(list, at(hours)).unwrap().unwrap_or_else(|| anchors.clone())
}

fn is_revoked(anchors: &TrustAnchors, identity: &Identity, hours: u64) -> bool {
    match anchors.verify(identity.chain(), at(hours)) {
        Ok(peer) => {
            assert!(!anchors.is_peer_revoked(&peer));
            false
        }
        Err(CertError::Revoked { .. }) => true,
        Err(other) => panic!("{other}"),
    }
}

fn revoked(anchors: &TrustAnchors) -> BTreeMap<Pseudonym, (u32, UnixMillis)> {
    let ca = anchors.fingerprints().next().unwrap();
    anchors.revoked_nodes(&ca).map(|(node, r)| (node, (r.incarnation, r.at))).collect()
}

#[test]
fn a_certificate_that_an_old_copy_does_not_know_is_revoked_with_its_node() {
    let (mut new, mut old) = two_copies(&["va", "vb"]);
    let renewed = new.renew(&name("va"), VALID, at(1), &mut rng(2)).unwrap();
    old.revoke(&[name("va")], at(2)).unwrap();
    let anchors = with(old.anchors(), &old.revocation_list(at(2)).unwrap(), 2);
    assert!(is_revoked(&anchors, &renewed, 2));
    assert!(
        anchors.is_node_revoked(&renewed.node_id()) && !old.anchors().is_node_revoked(&renewed.node_id())
    );
    // Nor is one that the other copy makes from now on.
    let later = new.renew(&name("va"), VALID, at(3), &mut rng(3)).unwrap();
    assert!(is_revoked(&anchors, &later, 3));
    let other = new.renew(&name("vb"), VALID, at(3), &mut rng(4)).unwrap();
    assert!(!is_revoked(&anchors, &other, 3) && !anchors.is_node_revoked(&other.node_id()));
}

#[test]
fn a_list_of_another_copy_takes_nothing_away() {
    let (mut a, mut b) = two_copies(&["va", "vb"]);
    let (va, vb) = (
        a.renew(&name("va"), VALID, at(1), &mut rng(2)).unwrap(),
        b.renew(&name("vb"), VALID, at(1), &mut rng(3)).unwrap(),
    );
    a.revoke(&[name("vb")], at(2)).unwrap();
    b.revoke(&[name("va")], at(3)).unwrap();
    let lists = [a.revocation_list(at(2)).unwrap(), b.revocation_list(at(3)).unwrap()];
    for order in [[0, 1], [1, 0]] {
        let anchors = order.iter().fold(a.anchors().clone(), |known, n| with(&known, &lists[*n], 3));
        assert!(is_revoked(&anchors, &va, 3) && is_revoked(&anchors, &vb, 3), "{order:?}");
        // A fresh node learns the same from the passed lists.
        let passed: Vec<Bytes> = anchors.crls().cloned().collect();
        assert_eq!(passed.len(), 2);
        let fresh = passed.iter().fold(a.anchors().clone(), |known, list| with(&known, list, 3));
        assert_eq!(revoked(&fresh), revoked(&anchors));
        // Neither is news any more, alone or in shorter lists.
        for list in lists.iter().chain(&[a.revocation_list_of_nodes(&[], 1 << 40, at(3)).unwrap()]) {
            assert!(anchors.with_crl(list, at(3)).unwrap().is_none());
        }
    }
}

#[test]
fn the_list_of_merged_copies_takes_the_place_of_all_others() {
    let (mut a, mut b) = two_copies(&["va", "vb"]);
    a.revoke(&[name("vb")], at(2)).unwrap();
    b.revoke(&[name("va")], at(3)).unwrap();
    let both = [&a, &b]
        .iter()
        .fold(a.anchors().clone(), |known, fleet| with(&known, &fleet.revocation_list(at(3)).unwrap(), 3));
    a.merge(&b, at(4)).unwrap();
    let merged = a.revocation_list(at(4)).unwrap();
    let anchors = both.with_crl(&merged, at(4)).unwrap().expect("one list instead of two is news");
    assert_eq!(anchors.crls().map(|c| c.as_ref()).collect::<Vec<_>>(), [&merged[..]]);
    assert_eq!(revoked(&anchors), revoked(&both));
    assert!(anchors.with_crl(&b.revocation_list(at(3)).unwrap(), at(4)).unwrap().is_none());
}

#[test]
fn only_enrolling_again_makes_a_node_of_a_revoked_one() {
    let (mut fleet, _) = two_copies(&["va"]);
    let first = fleet.renew(&name("va"), VALID, at(1), &mut rng(2)).unwrap();
    assert_eq!(first.as_peer().incarnation, 0);
    fleet.revoke(&[name("va")], at(2)).unwrap();
    let again = EnrollRequest { again: true, ..request("va", 3) };
    let second = fleet.enroll(&again, &mut rng(3)).unwrap();
    let fleet = &mut copy(&fleet);
    let third = fleet.renew(&name("va"), VALID, at(4), &mut rng(4)).unwrap();
    assert_eq!((second.as_peer().incarnation, third.as_peer().incarnation), (1, 1));
    assert_eq!(second.node_id(), first.node_id(), "it is the same node");
    let anchors = with(fleet.anchors(), &fleet.revocation_list(at(4)).unwrap(), 4);
    assert!(is_revoked(&anchors, &first, 4));
    assert!(!is_revoked(&anchors, &second, 4) && !is_revoked(&anchors, &third, 4));
    // Enrolling it once more changes nothing, as long as it is not revoked.
    let fourth = fleet.enroll(&EnrollRequest { again: true, ..request("va", 5) }, &mut rng(5)).unwrap();
    assert_eq!(fourth.as_peer().incarnation, 1);
    fleet.revoke(&[name("va")], at(6)).unwrap();
    let anchors = with(&anchors, &fleet.revocation_list(at(6)).unwrap(), 6);
    assert!([second, third, fourth].iter().all(|i| is_revoked(&anchors, i, 6)));
}

#[test]
fn a_node_takes_no_certificate_of_an_earlier_incarnation() {
    let (mut new, mut old) = two_copies(&["va"]);
    new.revoke(&[name("va")], at(1)).unwrap();
    let va = new.enroll(&EnrollRequest { again: true, ..request("va", 2) }, &mut rng(3)).unwrap();
    let behind = old.renew_csr(&va.csr(), &va.pseudonym(), VALID, at(3), &mut rng(4)).unwrap();
    assert_eq!(va.with_credentials(&behind).unwrap_err(), IdentityError::OldIncarnation);
    let member = old.renew_member(&va.csr(), &name("va"), VALID, at(3), &mut rng(4)).unwrap();
    assert_eq!(va.with_membership(member).unwrap_err(), IdentityError::OldIncarnation);
    old.merge(&new, at(4)).unwrap();
    let renewed = old.renew_csr(&va.csr(), &va.pseudonym(), VALID, at(5), &mut rng(6)).unwrap();
    assert_eq!(va.with_credentials(&renewed).unwrap().as_peer().incarnation, 1);
}

#[test]
fn a_copy_learns_from_a_list_what_another_one_revoked() {
    let (mut new, mut old) = two_copies(&["va"]);
    new.enroll(&request("vc", 1), &mut rng(2)).unwrap();
    new.revoke(&[name("va"), name("vc")], at(2)).unwrap();
    let anchors = with(old.anchors(), &new.revocation_list(at(2)).unwrap(), 2);
    let told = old.absorb(&anchors, at(3)).unwrap();
    let vc = new.secret().pseudonym("vc").short();
    assert!(told.is_behind && told.revoked.len() == 2, "{told:?}");
    assert!(told.revoked.contains(&"va".to_owned()) && told.revoked.contains(&vc), "{told:?}");
    let mut old = copy(&old);
    assert_eq!(old.absorb(&anchors, at(3)).unwrap(), CrlReport::default());
    // Its own next list has it too, and it makes no certificate of either.
    old.revoke(&[], at(4)).unwrap();
    let own = with(old.anchors(), &old.revocation_list(at(4)).unwrap(), 4);
    assert_eq!(revoked(&own), revoked(&anchors));
    for node in ["va", "vc"] {
        let made = old.enroll(&request(node, 5), &mut rng(6));
        assert!(matches!(made, Err(FleetError::NodeRevoked { .. })), "{node}");
        let made = old.enroll(&EnrollRequest { again: true, ..request(node, 5) }, &mut rng(6)).unwrap();
        assert!(!is_revoked(&own, &made, 5));
    }
}

/// One operation of a keeper on a copy, drawn at random.
fn do_something(fleet: &mut Fleet, seed: u64, hours: u64) {
    let rng = &mut rng(seed);
    let node = format!("n{}", rng.next_u32() % 5);
    match rng.next_u32() % 9 {
        0..=2 => drop(fleet.enroll(&EnrollRequest { again: true, ..request(&node, hours) }, rng)),
        3 => drop(
            fleet.enroll(&EnrollRequest { groups: vec!["g".parse().unwrap()], ..request(&node, hours) }, rng),
        ),
        4 => drop(fleet.renew(&name(&node), VALID, at(hours), rng)),
        5 | 6 => drop(fleet.revoke(&[name(&node)], at(hours))),
        7 => drop(fleet.rotate_secret(at(hours), rng)),
        _ => {
            let newest = fleet.generations().last().unwrap().number;
            fleet.retire_secrets(newest.saturating_sub(rng.next_u32() % 3)).unwrap();
        }
    }
}

/// Everything that a copy knows, but for the number of its next list.
fn knows(fleet: &Fleet) -> impl PartialEq + std::fmt::Debug + use<> {
    let nodes: Vec<_> = fleet.nodes().cloned().collect();
    let revoked: Vec<_> = fleet.revoked_nodes().map(|(n, r)| (*n, *r)).collect();
    let secrets: Vec<_> = fleet.naming_secrets().iter().map(|n| *n.secret.expose()).collect();
    (nodes, revoked, fleet.generations().to_vec(), secrets)
}

#[test]
fn merging_is_commutative_associative_and_idempotent_and_loses_nothing() {
    for seed in 0..40_u64 {
        let (origin, _) = two_copies(&["n0", "n1"]);
        let mut copies = [copy(&origin), copy(&origin), copy(&origin)];
        for step in 0..24 {
            let which = (rng(seed * 1000 + step).next_u32() % 3) as usize;
            do_something(&mut copies[which], seed * 1000 + step, step);
        }
        let [a, b, c] = &copies;
        let merged = |first: &Fleet, rest: &[&Fleet]| {
            let mut all = copy(first);
            rest.iter().for_each(|other| drop(all.merge(other, at(100)).unwrap()));
            copy(&all)
        };
        let all = merged(a, &[b, c]);
        let orders: [(&Fleet, [&Fleet; 2]); 5] =
            [(a, [c, b]), (b, [a, c]), (b, [c, a]), (c, [a, b]), (c, [b, a])];
        for (first, rest) in orders {
            assert_eq!(knows(&merged(first, &rest)), knows(&all), "seed {seed}");
        }
        assert_eq!(knows(&merged(a, &[&merged(b, &[c])])), knows(&all), "seed {seed}");
        assert_eq!(knows(&merged(&all, &[&all, a, b, c])), knows(&all), "seed {seed}");
        for one in &copies {
            for (node, revocation) in one.revoked_nodes() {
                let (_, kept) = all.revoked_nodes().find(|(n, _)| *n == node).expect("it stays revoked");
                assert!(kept.covers(revocation.incarnation), "seed {seed}");
            }
            for node in one.nodes() {
                let kept = all.node(&node.name).expect("it stays enrolled");
                assert!(kept.incarnation >= node.incarnation);
                let known = |c: &IssuedCertificate| kept.certificates.iter().any(|k| k.serial == c.serial);
                assert!(node.certificates.iter().all(known), "seed {seed}");
            }
        }
    }
}

#[test]
fn no_order_of_lists_takes_a_revocation_away() {
    for seed in 0..30_u64 {
        let (origin, _) = two_copies(&["n0", "n1", "n2"]);
        let mut copies = [copy(&origin), copy(&origin), copy(&origin)];
        let mut lists: Vec<Vec<u8>> = Vec::new();
        for step in 0..30 {
            let which = (rng(seed * 1000 + step).next_u32() % 3) as usize;
            do_something(&mut copies[which], seed * 1000 + step, step);
            lists.push(copies[which].revocation_list(at(step)).unwrap());
        }
        let mut expected: BTreeMap<Pseudonym, Revocation> = BTreeMap::new();
        for one in &copies {
            for (node, r) in one.revoked_nodes() {
                let known = expected.entry(*node).or_insert(*r);
                if r.incarnation > known.incarnation
                    || (r.incarnation == known.incarnation && r.at < known.at)
                {
                    *known = *r;
                }
            }
        }
        let expected: BTreeMap<_, _> =
            expected.into_iter().map(|(node, r)| (node, (r.incarnation, r.at))).collect();
        for order in 0..4 {
            let mut shuffled = lists.clone();
            let mut dice = rng(seed * 100 + order);
            for n in (1..shuffled.len()).rev() {
                shuffled.swap(n, dice.next_u32() as usize % (n + 1));
            }
            let mut anchors = origin.anchors().clone();
            for list in &shuffled {
                let before = revoked(&anchors);
                anchors = with(&anchors, list, 100);
                let after = revoked(&anchors);
                let kept = |(node, (incarnation, _)): (&Pseudonym, &(u32, UnixMillis))| {
                    after.get(node).is_some_and(|(now, _)| now >= incarnation)
                };
                assert!(before.iter().all(kept), "seed {seed}");
            }
            assert_eq!(revoked(&anchors), expected, "seed {seed}, order {order}");
            assert!(anchors.crls().count() <= copies.len(), "one list of each copy does");
            // Two halves of a network that meet know it all.
            let half = |lists: &[Vec<u8>]| {
                lists.iter().fold(origin.anchors().clone(), |known, list| with(&known, list, 100))
            };
            let (left, right) = shuffled.split_at(shuffled.len() / 2);
            assert_eq!(revoked(&half(left).with_lists_of(&half(right))), expected);
        }
    }
}

#[test]
fn a_list_that_would_be_one_too_many_is_refused_until_the_copies_are_merged() {
    let (fleet, _) = two_copies(&[]);
    let revocation = Revocation { incarnation: 0, at: NOW };
    let list = |node: u8, number| {
        fleet.revocation_list_of_nodes(&[(Pseudonym([node; 32]), revocation)], number, NOW).unwrap()
    };
    let mut anchors = fleet.anchors().clone();
    for n in 0..FLEET_LISTS_MAX {
        anchors = with(&anchors, &list(n as u8, 1 + n as u64), 0);
    }
    assert_eq!(anchors.crls().count(), FLEET_LISTS_MAX);
    let refused = anchors.with_crl(&list(99, 50), NOW).unwrap_err();
    assert_eq!(refused, CrlError::TooManyLists);
    assert!(!refused.is_forgery());
    assert_eq!(revoked(&anchors).len(), FLEET_LISTS_MAX, "what was revoked stays revoked");
    let all: Vec<_> =
        (0..FLEET_LISTS_MAX as u8).chain([99]).map(|n| (Pseudonym([n; 32]), revocation)).collect();
    let merged = fleet.revocation_list_of_nodes(&all, 51, NOW).unwrap();
    let anchors = with(&anchors, &merged, 0);
    assert_eq!((anchors.crls().count(), revoked(&anchors).len()), (1, FLEET_LISTS_MAX + 1));
}

/// Revokes a node by its number, an hour after the one before.
fn numbered(n: usize) -> (Pseudonym, Revocation) {
    let mut pseudonym = [0xff; 32];
    pseudonym[..8].copy_from_slice(&(n as u64).wrapping_mul(0x9e37_79b9_7f4a_7c15).to_be_bytes());
    (Pseudonym(pseudonym), Revocation { incarnation: u32::MAX, at: at(n as u64) })
}

#[test]
fn no_more_nodes_are_revoked_than_there_is_room_for() {
    let (fleet, _) = two_copies(&[]);
    let hours = 2 * REVOKED_NODES_MAX as u64;
    let list = |numbers: std::ops::Range<usize>| {
        let nodes: Vec<_> = numbers.map(numbered).collect();
        fleet.revocation_list_of_nodes(&nodes, 1 + nodes.len() as u64, at(hours)).unwrap()
    };
    let mut anchors = fleet.anchors().clone();
    for first in (0..REVOKED_NODES_MAX).step_by(LIST_NODES_MAX) {
        let full = list(first..first + LIST_NODES_MAX);
        assert!(full.len() <= sgc_wire::CRL_BYTES_MAX);
        anchors = with(&anchors, &full, hours);
    }
    assert_eq!(revoked(&anchors).len(), REVOKED_NODES_MAX);
    let one_more = list(REVOKED_NODES_MAX..REVOKED_NODES_MAX + 1);
    assert_eq!(anchors.with_crl(&one_more, at(hours)).unwrap_err(), CrlError::TooManyNodes);
    assert_eq!(revoked(&anchors).len(), REVOKED_NODES_MAX, "what was revoked stays revoked");
}

#[test]
fn a_list_names_the_nodes_that_were_revoked_last_and_the_lists_before_it_stay() {
    let (fleet, _) = two_copies(&[]);
    let count = 2 * LIST_NODES_MAX + 7;
    let mut anchors = fleet.anchors().clone();
    for n in (1..=count).step_by(509).chain([count]) {
        let all: Vec<_> = (0..n).map(numbered).collect();
        let list = fleet.revocation_list_of_nodes(&all, n as u64, at(n as u64)).unwrap();
        anchors = with(&anchors, &list, n as u64);
        let known = revoked(&anchors);
        assert!(all.iter().all(|(node, _)| known.contains_key(node)), "{n} nodes");
        assert!(anchors.crls().count() <= 2 + n / (LIST_NODES_MAX - 509), "{} lists", anchors.crls().count());
    }
    // A fresh node learns all of them from the passed lists.
    let fresh = anchors.crls().fold(fleet.anchors().clone(), |known, list| with(&known, list, count as u64));
    assert_eq!(revoked(&fresh).len(), count);
}

#[test]
fn the_longest_list_of_a_fleet_is_one_that_nodes_take() {
    let (mut fleet, _) = two_copies(&["va"]);
    // Certificates without number: their serial numbers do not all fit, the node does.
    for n in 0..NODE_CERTIFICATES_MAX as u64 + 10 {
        fleet.renew(&name("va"), VALID, at(n), &mut rng(n)).unwrap();
    }
    assert_eq!(fleet.node(&name("va")).unwrap().certificates.len(), NODE_CERTIFICATES_MAX);
    let newest = fleet.renew(&name("va"), VALID, at(300), &mut rng(300)).unwrap();
    fleet.revoke(&[name("va")], at(300)).unwrap();
    let anchors = with(fleet.anchors(), &fleet.revocation_list(at(300)).unwrap(), 300);
    assert!(is_revoked(&anchors, &newest, 300));
}

#[test]
fn revocations_end_with_their_ca() {
    let (mut fleet, _) = two_copies(&["va"]);
    let va = fleet.renew(&name("va"), 20 * 366 * VALID, NOW, &mut rng(2)).unwrap();
    fleet.revoke(&[name("va")], NOW).unwrap();
    let list = fleet.revocation_list(NOW).unwrap();
    // As long as any certificate of the node can be valid, the list is taken and counts.
    let last = fleet.not_after();
    assert_eq!(va.not_after().secs(), last.secs());
    assert!(last.0 > NOW.0 + 9 * YEAR);
    let anchors = fleet.anchors().with_crl(&list, last).unwrap().unwrap();
    assert!(matches!(anchors.verify(va.chain(), last), Err(CertError::Revoked { .. })));
    let over = UnixMillis(last.0 + 1000);
    assert!(matches!(fleet.anchors().with_crl(&list, over), Err(CrlError::CaExpired { .. })));
    assert!(fleet.anchors().verify(va.chain(), over).unwrap_err().is_expiry());
}

#[test]
fn files_of_two_fleets_do_not_merge() {
    let (mut ours, _) = two_copies(&["va"]);
    let theirs = Fleet::create("acme".parse().unwrap(), NOW, &mut rng(2)).unwrap();
    let before = ours.to_text();
    assert!(matches!(ours.merge(&theirs, NOW), Err(FleetError::OtherFleet { .. })));
    assert_eq!(*ours.to_text(), *before);
}
