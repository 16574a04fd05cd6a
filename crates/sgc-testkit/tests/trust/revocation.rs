//! Revocation of rights at run time, by a policy or a revocation list.

use std::time::Duration;

use sgc_endpoint::{Event, JoinStatus, RefusedBy, Sink, SinkDrop, SinkLimits};
use sgc_router::LinkClose;
use sgc_testkit::{Member, NodeKey, Sharing, World, WorldConfig, revocation_list, serial_list};
use sgc_trust::OpenError;
use sgc_wire::{RefuseReason, RejectReason};

use crate::{
    Scene, assert_nothing_received, assert_received, closed, events, flowing, flowing_with, grants, ms,
    packets, publish_steadily, slow,
};

/// Returns the times at which the owner cut a sink and began the epoch without it.
fn cut_and_rekeyed(world: &World, owner: NodeKey, from: usize) -> (Duration, Duration) {
    let cut = events(world, owner, from).find(|(e, _)| matches!(e, Event::SinkCut { .. }));
    let rekeyed = events(world, owner, from).find(|(e, _)| matches!(e, Event::Rekeyed { .. }));
    (cut.expect("someone is cut").1, rekeyed.expect("a new epoch begins").1)
}

#[test]
fn node_removed_from_policy_is_cut_at_once_and_others_lose_nothing() {
    for seed in 0..12 {
        let mut scene = flowing_with(slow(seed), |s| if seed % 2 == 0 { s.best_effort() } else { s });
        let users = scene.without(scene.tab);
        let Scene { world, arm, east, west, desk, lap, tab } = &mut scene;
        let name = world.name(*arm, "/chatter");
        let sinks = world.granted_sinks(*arm, "/chatter");
        let sink_of = |node| sinks.iter().find(|(_, n)| *n == node).expect("granted").0;
        let gone = sink_of(*tab);
        let (log, mut at, mut within) = (world.log().len(), None, 0);
        let sharing = Sharing { best_effort: seed % 2 == 0, ..Sharing::to(&[*desk, *lap]) };
        let published = publish_steadily(world, *arm, ms(7), ms(3000), |world, passed| {
            if passed >= ms(500) && at.is_none() {
                at = Some(world.elapsed());
                world.reshare(*arm, "/chatter", sharing.clone());
                assert!(!world.forwarding_sinks(*arm, &name).contains(&gone), "at the owner at once");
            }
            // Frames and packets keep no order between them: two links, of which each may be late by so much.
            within += usize::from(at.is_none_or(|at| world.elapsed() < at + ms(130)));
        });
        let at = at.expect("it was taken out");
        world.run(ms(2000));
        let (cut, rekeyed) = cut_and_rekeyed(world, *arm, log);
        assert_eq!(cut, at);
        assert!(rekeyed - at <= ms(1000), "{:?}", rekeyed - at);
        for router in [*east, *west] {
            let sinks = world.forwarding_sinks(router, &name);
            assert_eq!(sinks.len(), 2);
            assert!(!sinks.contains(&gone), "cut at {router:?}");
        }
        // Packets for all stop at the last router before it.
        let after = packets(world, *west, *tab).into_iter().filter(|p| p.header.epoch > 1).count();
        assert_eq!(after, 0, "nothing of the new epoch even reaches it");
        assert_nothing_received(world, *tab, *arm, &published[within..]);
        let refused = RefusedBy::Owner(RefuseReason::NotPermitted);
        let told =
            events(world, *tab, log).any(|(e, _)| matches!(e, Event::Refused { by, .. } if *by == refused));
        assert!(told, "it is told why");
        for user in users {
            assert_received(&scene.world, user, scene.arm, &published);
        }
    }
}

#[test]
fn a_removed_member_opens_nothing_of_the_new_epoch_with_the_keys_that_it_kept() {
    let mut scene = flowing(21);
    let Scene { world, arm, west, desk, lap, tab, .. } = &mut scene;
    world.publish(*arm, "/chatter");
    world.run(ms(300));
    world.reshare(*arm, "/chatter", Sharing::to(&[*desk, *lap]));
    world.run(ms(1500));
    let kept = grants(world, *tab, *arm);
    assert_eq!(kept.len(), 1, "it was granted once and never again");
    let (id, grant) = kept.into_iter().next().expect("one");
    let of_new_epoch: Vec<_> = (0..50)
        .map(|_| {
            let id = world.publish(*arm, "/chatter");
            world.run(ms(20));
            id
        })
        .collect();
    world.run(ms(500));
    // A colluding router passes all packets to it.
    let seen: Vec<_> = packets(world, *west, *desk).into_iter().filter(|p| p.header.epoch == 2).collect();
    assert!(seen.len() >= of_new_epoch.len(), "messages, and marks");
    let mut sink = Sink::new(world.name(*arm, "/chatter"), id, grant.clone(), false, SinkLimits::default());
    for packet in &seen {
        let _ = sink.handle_packet(packet);
    }
    assert_eq!((sink.parked(), sink.epochs().collect::<Vec<_>>()), (seen.len(), vec![1]), "none opens");
    // Nor if it takes its key for that of the new epoch.
    let guess = sgc_wire::TopicGrant { epoch: 2, ..grant };
    let mut sink = Sink::new(world.name(*arm, "/chatter"), id, guess, false, SinkLimits::default());
    for packet in &seen {
        assert_eq!(sink.handle_packet(packet), Err(SinkDrop::Open(OpenError::Forged)));
    }
    // Its own node, which believes that it was refused, is no other.
    for packet in seen {
        world.inject_packet(*west, *tab, packet);
    }
    world.run(ms(500));
    assert_nothing_received(world, *tab, *arm, &of_new_epoch);
}

#[test]
fn node_removed_during_rotation_cannot_use_the_pending_key() {
    // The epoch that was being granted when it was cut never begins: it has its key.
    let mut scene = flowing(22);
    let Scene { world, arm, desk, lap, tab, .. } = &mut scene;
    world.freeze(*lap); // so that the first waits
    world.rotate(*arm, "/chatter");
    world.run(ms(300));
    let kept = grants(world, *tab, *arm).last().expect("granted").1.clone();
    assert_eq!((kept.epoch, world.epoch(*arm, "/chatter")), (2, Some(1)));
    let (at, log) = (world.elapsed(), world.log().len());
    world.reshare(*arm, "/chatter", Sharing::to(&[*desk, *lap]));
    let published = publish_steadily(world, *arm, ms(10), ms(3000), |_, _| ());
    let (_, rekeyed) = cut_and_rekeyed(world, *arm, log);
    assert!(rekeyed - at <= ms(1000), "{:?}", rekeyed - at);
    let used: std::collections::BTreeSet<_> = world
        .captured_packets()
        .iter()
        .filter(|c| c.from == *arm && c.at > at)
        .map(|c| c.packet.header.epoch)
        .collect();
    assert_eq!(used, [1, 3].into(), "and never 2");
    world.thaw(*lap);
    world.run(ms(1000));
    for user in scene.without(scene.tab) {
        assert_received(&scene.world, user, scene.arm, &published);
    }
}

#[test]
fn node_that_left_before_its_removal_does_not_keep_the_key_in_use() {
    for revoked in [true, false] {
        let mut scene = flowing(24);
        let Scene { world, arm, desk, lap, tab, .. } = &mut scene;
        world.stop_using(*tab, *arm, "/chatter");
        world.run(ms(1000));
        assert_eq!(world.epoch(*arm, "/chatter"), Some(1), "leaving alone costs nothing");
        let at = world.elapsed();
        if revoked {
            let list = revoke(world, &[*tab], 1);
            world.hand_crl(*arm, &list);
        } else {
            world.reshare(*arm, "/chatter", Sharing::to(&[*desk, *lap]));
        }
        world.run(ms(2000));
        let rekeyed = events(world, *arm, 0).find(|(e, _)| matches!(e, Event::Rekeyed { .. }));
        assert!(rekeyed.expect("a new epoch").1 - at <= ms(1000));
        // Once, and not again for one who never had the newer key.
        world.reshare(*arm, "/chatter", Sharing::to(&[*desk, *lap, *tab]));
        world.reshare(*arm, "/chatter", Sharing::to(&[*desk, *lap]));
        world.run(ms(2000));
        assert_eq!(world.epoch(*arm, "/chatter"), Some(2));
    }
}

#[test]
fn many_who_are_taken_out_one_by_one_are_out_within_two_seconds_each() {
    let mut config = slow(23);
    config.seed = 23;
    let mut scene = flowing_with(config, |s| s);
    let guests: Vec<_> = (0..12).map(|n| scene.world.proxy(&format!("guest-{n}"))).collect();
    let staff = scene.users();
    let all: Vec<_> = staff.iter().chain(&guests).copied().collect();
    let Scene { world, arm, west, tab, .. } = &mut scene;
    world.reshare(*arm, "/chatter", Sharing::to(&all));
    for guest in &guests {
        world.link(*west, *guest);
        world.use_topic(*guest, *arm, "/chatter");
    }
    for guest in &guests {
        world.until_granted(*guest, *arm, "/chatter");
    }
    world.run(ms(1000));
    world.freeze(*tab);
    let mut left = all.clone();
    let mut next = Duration::ZERO;
    let mut cut_at = Vec::new();
    let published = publish_steadily(world, *arm, ms(10), ms(6000), |world, passed| {
        if passed >= next && left.len() > staff.len() {
            let out = left.pop().expect("more than the staff");
            cut_at.push((out, world.elapsed()));
            world.reshare(*arm, "/chatter", Sharing::to(&left));
            next += ms(60);
        }
    });
    assert_eq!(cut_at.len(), guests.len());
    for (guest, at) in cut_at {
        let newest = grants(world, guest, *arm).iter().map(|(_, g)| g.epoch).max().expect("granted");
        let late = world.captured_packets().iter().filter(|c| c.from == *arm && c.at > at + ms(2000));
        assert!(late.clone().count() > 0);
        let known = late.filter(|c| c.packet.header.epoch <= newest).count();
        assert_eq!(known, 0, "{guest:?} could open {known} packets sent 2 s after it was cut");
    }
    world.thaw(*tab);
    world.run(ms(2000));
    for user in staff {
        assert_received(&scene.world, user, scene.arm, &published);
    }
}

fn revoke(world: &World, nodes: &[NodeKey], number: u64) -> bytes::Bytes {
    let members: Vec<Member> = nodes.iter().map(|n| world.member(*n).clone()).collect();
    revocation_list("acme", &members, number)
}

#[test]
fn a_revocation_list_handed_to_any_node_takes_effect_everywhere() {
    for hand_to in 0..5 {
        let mut scene = flowing(30 + hand_to as u64);
        let staying = scene.without(scene.tab);
        let Scene { world, arm, east, west, desk, lap, tab } = &mut scene;
        let handed = [*arm, *east, *west, *desk, *lap][hand_to];
        let (name, log) = (world.name(*arm, "/chatter"), world.log().len());
        let list = revoke(world, &[*tab], 1);
        let (mut at, mut within) = (None, 0);
        let published = publish_steadily(world, *arm, ms(10), ms(3000), |world, passed| {
            if passed >= ms(300) && at.is_none() {
                at = Some(world.elapsed());
                assert!(world.hand_crl(handed, &list));
            }
            within += usize::from(at.is_none_or(|at| world.elapsed() < at + ms(160)));
        });
        world.run(ms(500));
        let at = at.expect("it was handed over");
        // Three links of at most 43 ms each.
        // Its router may have heard of it before the owner: then it has left already.
        let gone = events(world, *arm, log)
            .find(|(e, _)| matches!(e, Event::SinkCut { .. } | Event::SinkLeft { .. }));
        let rekeyed = events(world, *arm, log).find(|(e, _)| matches!(e, Event::Rekeyed { .. }));
        let (gone, rekeyed) = (gone.expect("it is cut").1, rekeyed.expect("a new epoch begins").1);
        assert!(gone - at <= ms(130), "{:?}", gone - at);
        assert!(rekeyed - at <= ms(1130), "{:?}", rekeyed - at);
        assert_eq!(closed(world, *west), [LinkClose::Revoked]);
        assert!(closed(world, *east).is_empty());
        for router in [*east, *west] {
            assert_eq!(world.forwarding_sinks(router, &name).len(), 2, "branch cut at {router:?}");
            assert_eq!(world.distance(router, &world.catalogue_name(*tab)), None, "its names are gone");
        }
        assert_nothing_received(world, *tab, *arm, &published[within..]);
        for user in staying {
            assert_received(&scene.world, user, scene.arm, &published);
        }
    }
}

#[test]
fn a_revoked_node_that_was_off_is_refused_when_it_returns() {
    let mut scene = flowing(40);
    let Scene { world, arm, east, west, tab, .. } = &mut scene;
    world.crash(*tab);
    world.run(ms(500));
    let list = revoke(world, &[*tab], 1);
    assert!(world.hand_crl(*east, &list));
    world.run(ms(500));
    world.start(*tab);
    let published = publish_steadily(world, *arm, ms(50), ms(40_000), |_, _| ());
    assert_eq!(closed(world, *west), [LinkClose::Revoked]);
    assert_ne!(world.status(*tab, *arm, "/chatter"), Some(JoinStatus::Granted));
    assert_nothing_received(world, *tab, *arm, &published);
    // Nor at another router.
    world.link(*tab, *east);
    world.run(ms(1000));
    assert_eq!(closed(world, *east), [LinkClose::Revoked]);
    assert_eq!(world.distance(*west, &world.catalogue_name(*tab)), None);
}

#[test]
fn a_router_that_was_off_too_learns_of_it_before_it_serves() {
    for disk in [true, false] {
        let mut scene = flowing(41);
        let Scene { world, arm, east, west, tab, .. } = &mut scene;
        if disk {
            // It knew the revocation, lost it with its state, and starts without a node in reach that could tell it
            // again.
            let list = revoke(world, &[*tab], 1);
            world.hand_crl(*arm, &list);
            world.run(ms(500));
            world.cut(*east, *west);
            world.restart(*west);
            world.run(ms(2000));
            world.rejoin(*tab, *west);
            world.run(ms(1000));
            assert_eq!(closed(world, *west).iter().filter(|c| **c == LinkClose::Revoked).count(), 3);
            continue;
        }
        world.crash(*west);
        world.crash(*tab);
        world.run(ms(500));
        let list = revoke(world, &[*tab], 1);
        world.hand_crl(*arm, &list);
        world.run(ms(500));
        world.forget_disk(*west);
        world.start(*tab);
        world.start(*west);
        let published = publish_steadily(world, *arm, ms(50), ms(5000), |_, _| ());
        assert_eq!(closed(world, *west), [LinkClose::Revoked]);
        assert_ne!(world.status(*tab, *arm, "/chatter"), Some(JoinStatus::Granted));
        assert_nothing_received(world, *tab, *arm, &published);
        assert!(!world.granted(*arm, "/chatter").contains(tab));
    }
}

#[test]
fn a_router_that_knows_no_list_does_not_help_a_revoked_member_past_the_owner() {
    // The router never learns it: whatever brings lists to it is dropped on the way.
    let mut scene = flowing(42);
    let Scene { world, arm, east, west, tab, .. } = &mut scene;
    world.tamper(*east, *west, |frame| match frame {
        sgc_wire::Control::Crl { .. } => vec![],
        frame => vec![frame.clone()],
    });
    let list = revoke(world, &[*tab], 1);
    let log = world.log().len();
    world.hand_crl(*arm, &list);
    let published = publish_steadily(world, *arm, ms(20), ms(35_000), |_, _| ());
    world.run(ms(500));
    assert!(closed(world, *west).is_empty(), "it does not know");
    assert_nothing_received(world, *tab, *arm, &published[10..]);
    let refused = [RefusedBy::Owner(RefuseReason::Revoked), RefusedBy::Router(RejectReason::Revoked)];
    let told = events(world, *tab, log).filter(|(e, _)| {
        matches!(e, Event::Refused { by, .. } | Event::OwnerRefused { by, .. } if refused.contains(by))
    });
    assert!(told.count() > 1, "it is told why, again when it asks again");
    for user in scene.without(scene.tab) {
        assert_received(&scene.world, user, scene.arm, &published);
    }
}

#[test]
fn an_older_list_and_one_of_another_ca_change_nothing() {
    let mut scene = flowing(43);
    let umbrella = scene.world.node(Member { fleet: "umbrella".to_owned(), ..Member::new("desk") }, false);
    let Scene { world, arm, west, desk, lap, tab, .. } = &mut scene;
    let newer = revoke(world, &[*tab], 5);
    assert!(world.hand_crl(*arm, &newer));
    world.run(ms(500));
    // Nor does a list with a greater number that leaves it out.
    for number in [1, 4, 5, 99] {
        for who in [&[][..], &[*tab]] {
            let list = revoke(world, who, number);
            assert!(!world.hand_crl(*arm, &list));
            world.inject(*west, *desk, &sgc_wire::Control::Crl { der: list });
        }
    }
    // A list of serial numbers stands beside those of the fleet, and only a newer one takes its place.
    let on_hold = serial_list("acme", &[world.member(*lap).clone()], 7);
    assert!(world.hand_crl(*arm, &serial_list("acme", &[], 8)));
    assert!(!world.hand_crl(*arm, &on_hold));
    world.inject(*west, *desk, &sgc_wire::Control::Crl { der: on_hold });
    // The list of another fleet's CA, which names serial numbers of ours as well.
    let members = [world.member(*desk).clone(), world.member(umbrella).clone()];
    let foreign = revocation_list("umbrella", &members, 99);
    world.inject(*desk, *west, &sgc_wire::Control::Crl { der: foreign });
    // An altered list.
    let list = revoke(world, &[*tab, *desk], 6);
    let mut altered = list.to_vec();
    let at = altered.len() - 3;
    altered[at] ^= 1;
    world.inject(*desk, *west, &sgc_wire::Control::Crl { der: altered.into() });
    let published = publish_steadily(world, *arm, ms(20), ms(1000), |_, _| ());
    world.run(ms(500));
    assert_eq!(crate::drops(world, *west, "crl"), 2);
    for user in scene.without(scene.tab) {
        assert_received(&scene.world, user, scene.arm, &published);
    }
    assert_nothing_received(&scene.world, scene.tab, scene.arm, &published);
}

#[test]
fn a_revoked_owners_names_vanish() {
    let mut scene = flowing(44);
    let Scene { world, arm, east, west, desk, .. } = &mut scene;
    let names = [world.name(*arm, "/chatter"), world.catalogue_name(*arm)];
    let advert = crate::frames(world, *arm, *east)
        .into_iter()
        .rfind(|f| matches!(f, sgc_wire::Control::Advert { .. }))
        .expect("it advertised");
    let list = revoke(world, &[*arm], 1);
    world.hand_crl(*desk, &list);
    world.run(ms(500));
    for router in [*east, *west] {
        for name in &names {
            assert_eq!(world.distance(router, name), None);
            assert!(world.forwarding_sinks(router, name).is_empty());
        }
    }
    assert_ne!(world.status(*desk, *arm, "/chatter"), Some(JoinStatus::Granted));
    // Nor does it come back by what it said before.
    world.inject(*east, *west, &advert);
    world.run(ms(500));
    assert_eq!(world.distance(*west, &names[0]), None);
    assert!(crate::drops(world, *west, "not_verified") > 0);
}

#[test]
fn a_list_goes_over_a_net_with_rings_once_over_each_link_and_way() {
    let mut world = World::with(WorldConfig::new(45));
    world.capture();
    let routers: Vec<_> = (0..6).map(|n| world.router(&format!("r{n}"))).collect();
    for n in 0..6 {
        world.link(routers[n], routers[(n + 1) % 6]);
    }
    world.link(routers[0], routers[3]);
    let thief = world.proxy("thief");
    world.link(routers[2], thief);
    world.run(ms(500));
    let list = revoke(&world, &[thief], 1);
    world.hand_crl(routers[5], &list);
    world.run(ms(1000));
    let sent = world.captured().iter().filter(|c| matches!(c.frame, sgc_wire::Control::Crl { .. })).count();
    assert!(sent <= 2 * 7, "{sent}");
    assert_eq!(closed(&world, routers[2]), [LinkClose::Revoked]);
}

/// Links `node` to another router and lets it try to join. Returns `true` if it got the topic of `owner`.
fn comes_back(world: &mut World, node: NodeKey, owner: NodeKey) -> bool {
    let published = publish_steadily(world, owner, ms(50), ms(20_000), |_, _| ());
    let heard = world.received(node, owner, "/chatter").iter().any(|id| published.contains(id));
    heard || world.status(node, owner, "/chatter") == Some(JoinStatus::Granted)
}

#[test]
fn a_certificate_that_was_renewed_elsewhere_is_revoked_with_its_node() {
    for linked in [true, false] {
        let mut scene = flowing(48);
        let staying = scene.without(scene.tab);
        let Scene { world, arm, east, west, tab, .. } = &mut scene;
        let before = world.identity(*tab).as_peer().cert.clone();
        // The copy of the fleet file that revokes the node does not know this certificate.
        world.renew(*tab);
        assert_ne!(world.identity(*tab).as_peer().cert, before);
        if linked {
            world.restart(*tab);
            world.run(ms(5000));
            assert_eq!(world.status(*tab, *arm, "/chatter"), Some(JoinStatus::Granted));
        } else {
            world.crash(*tab);
        }
        let list = revoke(world, &[*tab], 1);
        assert!(world.hand_crl(*east, &list));
        world.run(ms(500));
        world.start(*tab);
        assert!(!comes_back(world, *tab, *arm));
        assert!(closed(world, *west).contains(&LinkClose::Revoked));
        // Nor does the next renewal help it.
        world.renew(*tab);
        world.restart(*tab);
        let published = publish_steadily(world, *arm, ms(50), ms(5000), |_, _| ());
        world.run(ms(500));
        assert_nothing_received(world, *tab, *arm, &published);
        for user in staying {
            assert_received(&scene.world, user, scene.arm, &published);
        }
    }
}

#[test]
fn lists_of_two_copies_of_a_fleet_add_up_everywhere() {
    for order in [[0, 1], [1, 0]] {
        let mut scene = flowing(49);
        let Scene { world, arm, east, west, desk, lap, tab, .. } = &mut scene;
        let lists = [revoke(world, &[*tab], 1), revoke(world, &[*lap], 2)];
        for (at, which) in [*east, *west].into_iter().zip(order) {
            assert!(world.hand_crl(at, &lists[which]));
            world.run(ms(500));
        }
        // Also one that was off and has no disk is told both.
        world.crash(*west);
        world.forget_disk(*west);
        world.start(*west);
        world.run(ms(2000));
        for node in [*arm, *east, *west, *desk] {
            assert!(!world.believes(node, *tab) && !world.believes(node, *lap), "{order:?} {node:?}");
            assert_eq!(world.revocations(node).len(), 2);
        }
        for revoked in [*tab, *lap] {
            world.restart(revoked);
        }
        let published = publish_steadily(world, *arm, ms(50), ms(20_000), |_, _| ());
        world.run(ms(500));
        for revoked in [*tab, *lap] {
            assert_nothing_received(world, revoked, *arm, &published);
        }
        let late = &published[published.len() / 2..];
        assert_received(world, *desk, *arm, late);
        // The list of the merged file takes the place of both.
        let merged = revoke(world, &[*tab, *lap], 3);
        assert!(world.hand_crl(*arm, &merged));
        world.run(ms(500));
        for node in [*arm, *east, *west, *desk] {
            assert_eq!(world.revocations(node), std::slice::from_ref(&merged), "{node:?}");
        }
    }
}

#[test]
fn a_node_that_was_enrolled_again_is_one_again_and_its_old_certificates_are_not() {
    let mut scene = flowing(50);
    let Scene { world, arm, east, tab, .. } = &mut scene;
    let old = world.identity(*tab).as_peer().clone();
    let list = revoke(world, &[*tab], 1);
    world.hand_crl(*east, &list);
    world.run(ms(500));
    world.enroll_again(*tab);
    assert!(comes_back(world, *tab, *arm));
    let anchors = world.identity(*tab).anchors().with_crl(&list, old.not_after).unwrap().unwrap();
    assert!(anchors.is_peer_revoked(&old) && !anchors.is_peer_revoked(world.identity(*tab).as_peer()));
    // It can be revoked in its new incarnation as in the old one.
    let list = revoke(world, &[*tab], 2);
    assert!(world.hand_crl(*east, &list));
    world.run(ms(500));
    world.restart(*tab);
    assert!(!comes_back(world, *tab, *arm));
}

/// Keeps revocation lists from crossing a link.
fn deafen(world: &mut World, from: NodeKey, to: NodeKey) {
    world.tamper(from, to, |frame| match frame {
        sgc_wire::Control::Crl { .. } => vec![],
        frame => vec![frame.clone()],
    });
}

#[test]
fn single_informed_router_cuts_revoked_branch() {
    let mut scene = flowing(46);
    let Scene { world, arm, east, west, tab, .. } = &mut scene;
    // Neither the owner nor the router in front of the thief hears of it.
    deafen(world, *east, *arm);
    deafen(world, *east, *west);
    let name = world.name(*arm, "/chatter");
    let list = revoke(world, &[*tab], 1);
    world.hand_crl(*east, &list);
    assert_eq!(world.forwarding_sinks(*east, &name).len(), 2, "at once");
    let log = world.log().len();
    let published = publish_steadily(world, *arm, ms(20), ms(3000), |_, _| ());
    world.run(ms(500));
    assert_nothing_received(world, *tab, *arm, &published);
    assert_eq!(world.granted(*arm, "/chatter").len(), 2);
    let by = RefusedBy::Router(RejectReason::Revoked);
    let told = events(world, *tab, log).any(|(e, _)| matches!(e, Event::Refused { by: b, .. } if *b == by));
    assert!(told);
    for user in scene.without(scene.tab) {
        assert_received(&scene.world, user, scene.arm, &published);
    }
}

#[test]
fn a_router_that_ignores_the_list_does_not_lead_others_to_a_revoked_owner() {
    let mut scene = flowing(47);
    let Scene { world, arm, east, west, desk, .. } = &mut scene;
    deafen(world, *west, *east);
    let name = world.name(*arm, "/chatter");
    let list = revoke(world, &[*arm], 1);
    world.hand_crl(*west, &list);
    assert_eq!(world.distance(*west, &name), None, "at once");
    let published = publish_steadily(world, *arm, ms(500), ms(60_000), |_, _| ());
    assert!(closed(world, *east).is_empty());
    assert_eq!(world.distance(*west, &name), None, "nor by what it says later");
    assert_nothing_received(world, *desk, *arm, &published);
    assert_ne!(world.status(*desk, *arm, "/chatter"), Some(JoinStatus::Granted));
}
