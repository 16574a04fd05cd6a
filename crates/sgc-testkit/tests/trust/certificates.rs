//! Time: certificates that have expired or have not begun, and wrong clocks.

use std::time::Duration;

use sgc_endpoint::{Event, JoinStatus, RefusedBy};
use sgc_router::LinkClose;
use sgc_testkit::{Member, NodeKey, Sharing, World, WorldConfig};
use sgc_wire::{Control, RefuseReason, RejectReason};

use crate::{Scene, assert_received, closed, drops, events, flowing, ms, publish_steadily, scene_with};

const DAY: Duration = Duration::from_secs(86_400);
const MINUTE: Duration = Duration::from_secs(60);

/// Returns the scene and a guest at the second router with this certificate; all may have `/chatter`.
fn with_guest(seed: u64, guest: Member) -> (Scene, NodeKey) {
    let mut scene = scene_with(WorldConfig::new(seed));
    let guest = scene.world.node(guest, false);
    scene.world.share(scene.arm, "/chatter", Sharing::to_fleet());
    for user in scene.users().into_iter().chain([guest]) {
        scene.world.use_topic(user, scene.arm, "/chatter");
    }
    for user in scene.users() {
        scene.world.until_granted(user, scene.arm, "/chatter");
    }
    (scene, guest)
}

fn short_lived() -> Member {
    Member { valid: Some(10 * MINUTE), ..Member::new("guest") }
}

#[test]
fn a_link_ends_with_the_certificate_and_so_does_the_key() {
    let (mut scene, guest) = with_guest(90, short_lived());
    let Scene { world, arm, west, .. } = &mut scene;
    world.link(*west, guest);
    world.until_granted(guest, *arm, "/chatter");
    world.run(ms(500));
    let good = publish_steadily(world, *arm, ms(5000), 9 * MINUTE, |_, _| ());
    assert_received(world, guest, *arm, &good);
    world.run(2 * MINUTE);
    assert_eq!(closed(world, *west), [LinkClose::Expired]);
    assert!(!world.granted(*arm, "/chatter").contains(&guest));
    assert_eq!(world.epoch(*arm, "/chatter"), Some(2), "it left with a key, which is replaced");
    let late = publish_steadily(world, *arm, ms(500), MINUTE, |_, _| ());
    world.run(ms(500));
    crate::assert_nothing_received(world, guest, *arm, &late);
    for user in scene.users() {
        assert_received(&scene.world, user, scene.arm, &late);
    }
}

#[test]
fn the_owner_cuts_an_expired_sink_although_the_router_before_it_does_not() {
    let (mut scene, guest) = with_guest(91, short_lived());
    let Scene { world, arm, west, .. } = &mut scene;
    // Its clock is wrong by too little to be noticed.
    world.set_behind(*west, 5 * MINUTE);
    world.link(*west, guest);
    world.until_granted(guest, *arm, "/chatter");
    let log = world.log().len();
    world.run(11 * MINUTE);
    assert!(closed(world, *west).is_empty());
    let cut = events(world, *arm, log).find_map(|(e, at)| match e {
        Event::SinkCut { reason, .. } => Some((*reason, at)),
        _ => None,
    });
    let (reason, at) = cut.expect("it is cut");
    assert_eq!(reason, RefuseReason::Expired);
    assert!(at >= 10 * MINUTE && at <= 10 * MINUTE + ms(20_500), "{at:?}");
    assert_eq!(world.epoch(*arm, "/chatter"), Some(2));
    let told = events(world, guest, log)
        .any(|(e, _)| matches!(e, Event::Refused { by: RefusedBy::Owner(RefuseReason::Expired), .. }));
    assert!(told);
}

#[test]
fn a_certificate_that_is_over_or_has_not_begun_gets_nothing() {
    for early in [false, true] {
        let member = Member {
            from: Some(if early { DAY } else { Duration::ZERO }),
            valid: Some(5 * MINUTE),
            ..Member::new("guest")
        };
        let (mut scene, guest) = with_guest(92, member);
        let Scene { world, arm, west, .. } = &mut scene;
        world.run(6 * MINUTE);
        // A router's clock may be wrong, so that it makes the link; requests are judged on their own.
        if !early {
            world.set_behind(*west, 5 * MINUTE);
        }
        world.link(*west, guest);
        world.run(MINUTE);
        assert_ne!(world.status(guest, *arm, "/chatter"), Some(JoinStatus::Granted));
        assert!(!world.granted(*arm, "/chatter").contains(&guest));
        let by = [RefusedBy::Router(RejectReason::Expired), RefusedBy::Owner(RefuseReason::Expired)];
        let told = events(world, guest, 0)
            .any(|(e, _)| matches!(e, Event::OwnerRefused { by: b, .. } if by.contains(b)));
        assert!(told, "it is told that its certificate does not hold now (early: {early})");
    }
}

#[test]
fn an_expired_certificate_does_not_keep_a_link() {
    let (mut scene, guest) = with_guest(93, short_lived());
    scene.world.run(11 * MINUTE);
    scene.world.link(scene.west, guest);
    scene.world.run(ms(1000));
    assert_eq!(closed(&scene.world, scene.west), [LinkClose::Expired]);
}

#[test]
fn an_owners_names_end_with_its_certificate() {
    let mut scene = scene_with(WorldConfig::new(94));
    let Scene { world, east, west, desk, .. } = &mut scene;
    let guest = world.node(short_lived(), false);
    // Its own router's clock is behind, and keeps the link.
    world.set_behind(*east, 5 * MINUTE);
    world.link(*east, guest);
    world.share(guest, "/chatter", Sharing::to(&[*desk]));
    world.use_topic(*desk, guest, "/chatter");
    world.until_granted(*desk, guest, "/chatter");
    world.run(12 * MINUTE);
    assert_eq!(world.distance(*west, &world.name(guest, "/chatter")), None);
    assert_ne!(world.status(*desk, guest, "/chatter"), Some(JoinStatus::Granted));
}

#[test]
fn a_renewed_certificate_carries_what_was_granted_past_the_end_of_the_old_one() {
    let (mut scene, guest) = with_guest(95, short_lived());
    let Scene { world, arm, west, .. } = &mut scene;
    // The driver makes a new link, so that it outlasts the old certificate.
    world.set_behind(*west, 9 * MINUTE);
    world.link(*west, guest);
    world.until_granted(guest, *arm, "/chatter");
    world.run(ms(500));
    let mut renewed = false;
    let log = world.log().len();
    let published = publish_steadily(world, *arm, ms(500), 14 * MINUTE, |world, passed| {
        if passed >= 5 * MINUTE && !renewed {
            renewed = true;
            world.renew(guest);
        }
    });
    world.run(ms(500));
    assert_received(world, guest, *arm, &published);
    let lost = events(world, guest, log).filter(|(e, _)| matches!(e, Event::Lost { .. })).count();
    assert_eq!(lost, 0, "nothing was interrupted");
    assert!(closed(world, *west).is_empty());
    assert_eq!(world.epoch(*arm, "/chatter"), Some(1), "nobody was cut");
}

fn assert_skewed_works(seed: u64, skew: impl Fn(&mut World, NodeKey)) {
    for who in 0..4 {
        let mut scene = scene_with(WorldConfig::new(seed));
        let Scene { world, arm, east, west, desk, .. } = &mut scene;
        skew(world, [*arm, *east, *west, *desk][who]);
        world.share(*arm, "/chatter", Sharing::to(&[*desk]));
        world.use_topic(*desk, *arm, "/chatter");
        world.until_granted(*desk, *arm, "/chatter");
        world.run(ms(500));
        // Longer than a lease, and over a new epoch.
        let published = publish_steadily(world, *arm, ms(500), 3 * MINUTE, |world, passed| {
            if passed == MINUTE {
                world.rotate(*arm, "/chatter");
            }
        });
        world.run(ms(1000));
        assert_received(world, *desk, *arm, &published);
        assert_eq!(world.epoch(*arm, "/chatter"), Some(2));
        for node in [*arm, *east, *west, *desk] {
            assert_eq!(drops(world, node, "not_verified"), 0);
        }
    }
}

#[test]
fn clocks_that_differ_by_minutes_work() {
    assert_skewed_works(96, |world, node| world.set_ahead(node, 5 * MINUTE));
    assert_skewed_works(96, |world, node| world.set_behind(node, 5 * MINUTE));
}

#[test]
fn a_clock_that_is_wrong_by_days_is_refused_with_a_reason_that_says_so() {
    for ahead in [true, false] {
        // Set wrong while it runs: it knows of the owner, and asks again for whatever reason.
        let mut scene = flowing(97);
        let Scene { world, arm, west, tab, .. } = &mut scene;
        let skew = if ahead { World::set_ahead } else { World::set_behind };
        skew(world, *tab, 2 * DAY);
        let log = world.log().len();
        let sinks = world.granted_sinks(*arm, "/chatter");
        let sink = sinks.iter().find(|(_, n)| n == tab).expect("granted").0;
        let (name, reason) = (world.name(*arm, "/chatter"), RejectReason::RouteLost);
        world.inject(*west, *tab, &Control::Reject { name, sink, reason });
        world.run(ms(1000));
        let by = RefusedBy::Router(RejectReason::Clock);
        let told =
            events(world, *tab, log).any(|(e, _)| matches!(e, Event::Refused { by: b, .. } if *b == by));
        assert!(told, "{}", world.trace());
        assert!(closed(world, *west).is_empty(), "a wrong clock is no forgery");
        // Wrong from the start: nothing that others sign is believed here, and the log says that it is the time.
        world.restart(*tab);
        world.run(MINUTE);
        assert_ne!(world.status(*tab, *arm, "/chatter"), Some(JoinStatus::Granted));
        let clock = world.log().iter().any(|l| {
            l.node == *tab
                && matches!(&l.what, sgc_testkit::What::RouterDrop(d) if d.reason.to_string().contains("clocks is wrong"))
        });
        assert!(clock);
        // Set right, it works.
        skew(world, *tab, Duration::ZERO);
        world.until_granted(*tab, *arm, "/chatter");
    }
}

#[test]
fn a_clock_two_hours_off_is_known_on_both_sides_and_works_soon_after_it_is_set() {
    const TWO_HOURS: Duration = Duration::from_secs(7200);
    let ms_of = |time: Duration| i64::try_from(time.as_millis()).expect("two hours");
    for ahead in [true, false] {
        let skew = if ahead { World::set_ahead } else { World::set_behind };
        let sign = if ahead { 1 } else { -1 };
        // For the owner and for a user: no node believes it, and it believes no other.
        for who in 0..2 {
            let mut scene = scene_with(WorldConfig::new(98));
            let Scene { world, arm, east, west, tab, .. } = &mut scene;
            let (node, router) = [(*arm, *east), (*tab, *west)][who];
            skew(world, node, TWO_HOURS);
            world.restart(node);
            world.share(*arm, "/chatter", Sharing::to(&[*tab]));
            world.use_topic(*tab, *arm, "/chatter");
            world.run(MINUTE);
            assert_ne!(world.status(*tab, *arm, "/chatter"), Some(JoinStatus::Granted));
            assert!(drops(world, router, "clock") > 0, "the router counts it");
            assert!(closed(world, router).is_empty(), "a wrong clock is no forgery");
            let (there, here) = (world.clock_ahead_ms(router, node), world.clock_ahead_ms(node, router));
            let off = there.expect("the router was told");
            assert!((off - sign * ms_of(TWO_HOURS)).abs() < 1000, "{off}");
            assert!((here.expect("the node was told") + off).abs() < 1000, "{here:?}");

            // NTP corrects the clock.
            skew(world, node, Duration::ZERO);
            let granted = |world: &World| world.status(*tab, *arm, "/chatter") == Some(JoinStatus::Granted);
            assert!(world.run_until(ms(5000), granted), "{}", world.trace());
            assert!(world.clock_ahead_ms(router, node).expect("told anew").abs() < 1000);
            assert!(world.clock_ahead_ms(node, router).expect("told").abs() < 1000);
        }
    }
}
