//! Other nodes that may publish on a topic: their messages reach all subscribers until the right ends.

use std::time::Duration;

use bytes::Bytes;
use sgc_endpoint::{Event, JoinStatus, RefusedBy};
use sgc_testkit::{MessageId, NodeKey, Sharing, World, WorldConfig, revocation_list};
use sgc_trust::{MessageKey, Suite};
use sgc_wire::{RefuseReason, SourceId, SourceOffer};

use crate::{Scene, assert_received, events, ms, packets, scene_with, sink_drops, slow};

/// `/chatter` of `arm`, on which `desk` publishes and which `lap` and `tab` receive.
fn scene(config: WorldConfig, suite: Option<Suite>) -> Scene {
    let mut scene = scene_with(config);
    scene.world.share(scene.arm, "/chatter", sharing(&scene, suite));
    let Scene { world, arm, desk, lap, tab, .. } = &mut scene;
    world.publish_on(*desk, *arm, "/chatter");
    for user in [*lap, *tab] {
        world.use_topic(user, *arm, "/chatter");
        world.until_granted(user, *arm, "/chatter");
    }
    world.until_granted(*desk, *arm, "/chatter");
    world.run(ms(1500));
    scene
}

fn sharing(scene: &Scene, suite: Option<Suite>) -> Sharing {
    let publishers = [scene.desk].into();
    Sharing { publishers, suite, ..Sharing::to(&[scene.lap, scene.tab]) }
}

/// `by` publishes every `every` for `time`; `at` is called before each.
fn publish_as(
    world: &mut World,
    by: NodeKey,
    owner: NodeKey,
    every: Duration,
    time: Duration,
    mut at: impl FnMut(&mut World, Duration),
) -> Vec<MessageId> {
    let begin = world.elapsed();
    let mut published = Vec::new();
    while world.elapsed() - begin < time {
        let passed = world.elapsed() - begin;
        at(world, passed);
        published.extend(world.publish_as(by, owner, "/chatter"));
        world.run(every);
    }
    published
}

#[test]
fn their_messages_reach_the_owner_and_the_subscribers_once_and_not_themselves() {
    for suite in [None, Some(Suite::Group)] {
        let mut scene = scene(WorldConfig::new(80), suite);
        let Scene { world, arm, desk, lap, tab, .. } = &mut scene;
        let theirs = publish_as(world, *desk, *arm, ms(10), ms(300), |_, _| ());
        world.run(ms(500));
        let own = world.publish(*arm, "/chatter");
        world.run(ms(500));
        assert_eq!(theirs.len(), 30);
        assert_eq!(world.received(*arm, *arm, "/chatter"), theirs, "and the owner hears not itself");
        for user in [*lap, *tab] {
            assert_received(world, user, *arm, &theirs);
            assert_eq!(world.received(user, *arm, "/chatter").last(), Some(&own));
        }
        assert!(world.all_received().iter().all(|r| r.node != *desk));
        assert!(world.data_drops(*arm).is_empty());
    }
}

#[test]
fn their_messages_survive_new_epochs() {
    for seed in 0..6 {
        let mut scene = scene(slow(seed), None);
        let Scene { world, arm, desk, lap, tab, .. } = &mut scene;
        let mut next = ms(300);
        let theirs = publish_as(world, *desk, *arm, ms(10), ms(6000), |world, passed| {
            if passed >= next {
                world.rotate(*arm, "/chatter");
                next += ms(1400);
            }
        });
        world.run(ms(4000));
        for user in [*arm, *lap, *tab] {
            assert_received(world, user, *arm, &theirs);
        }
        let epochs: std::collections::BTreeSet<_> =
            packets(world, *desk, world.nodes().nth(5).expect("west"))
                .iter()
                .map(|p| p.header.epoch)
                .collect();
        assert!(epochs.len() >= 4, "{epochs:?}");
    }
}

#[test]
fn unauthorised_publisher_is_refused() {
    let mut scene = scene(WorldConfig::new(82), None);
    let Scene { world, arm, desk, tab, .. } = &mut scene;
    world.stop_using(*tab, *arm, "/chatter");
    // Names of others are for subscribers; one topic names publishers, another nobody.
    let key = MessageKey::generate(Suite::DEFAULT).public().clone();
    let offer = SourceOffer { source: SourceId([5; 16]), key };
    world.share(*arm, "/quiet", Sharing::to_fleet());
    for (topic, reason) in
        [("/chatter", RefuseReason::NotPermitted), ("/quiet", RefuseReason::RoleNotOffered)]
    {
        world.publish_blindly(*tab, *arm, topic, offer.clone());
        world.run(ms(1000));
        let by = RefusedBy::Owner(reason);
        assert_eq!(world.status(*tab, *arm, topic), Some(JoinStatus::Refused(by)));
        assert_eq!(world.publish_as(*tab, *arm, topic), None);
    }
    // Nor is it shown the topic as one that it may publish on.
    world.publish_on(*tab, *arm, "/quiet");
    world.run(ms(1000));
    assert!(world.catalogue(*tab, *arm).is_none_or(|c| c.entries.iter().all(|e| !e.publish)));
    assert!(world.catalogue(*desk, *arm).is_some_and(|c| c.entries.iter().any(|e| e.publish)));
}

#[test]
fn a_source_id_that_is_taken_is_refused() {
    let mut scene = scene(WorldConfig::new(83), None);
    let own = scene.world.publish(scene.arm, "/chatter");
    let theirs = scene.world.publish_as(scene.desk, scene.arm, "/chatter").expect("granted");
    let taken = [own, theirs].map(|id| scene.world.all_published()[id.0 as usize].source);
    for (n, source) in taken.into_iter().enumerate() {
        let guest = scene.world.proxy(&format!("guest-{n}"));
        scene.world.link(scene.west, guest);
        let mut sharing = sharing(&scene, None);
        sharing.publishers.insert(guest);
        scene.world.reshare(scene.arm, "/chatter", sharing);
        let key = MessageKey::generate(Suite::DEFAULT).public().clone();
        scene.world.publish_blindly(guest, scene.arm, "/chatter", SourceOffer { source, key });
        scene.world.run(ms(1500));
        let by = RefusedBy::Owner(RefuseReason::NotPermitted);
        assert_eq!(scene.world.status(guest, scene.arm, "/chatter"), Some(JoinStatus::Refused(by)));
    }
    // A key that is none, or one where the suite has none.
    let guest = scene.world.proxy("guest-9");
    scene.world.link(scene.west, guest);
    let mut sharing = sharing(&scene, None);
    sharing.publishers.insert(guest);
    scene.world.reshare(scene.arm, "/chatter", sharing);
    let offer = SourceOffer { source: SourceId([6; 16]), key: Bytes::new() };
    scene.world.publish_blindly(guest, scene.arm, "/chatter", offer);
    scene.world.run(ms(1500));
    let by = RefusedBy::Owner(RefuseReason::NotVerified);
    assert_eq!(scene.world.status(guest, scene.arm, "/chatter"), Some(JoinStatus::Refused(by)));
}

#[test]
fn publisher_that_loses_its_right_is_cut_and_its_key_distrusted() {
    for revoked in [false, true] {
        let mut scene = scene(WorldConfig::new(84), None);
        let Scene { world, arm, west, desk, lap, tab, .. } = &mut scene;
        let before = publish_as(world, *desk, *arm, ms(10), ms(200), |_, _| ());
        world.run(ms(500));
        let (kept, log) = (world.elapsed(), world.log().len());
        if revoked {
            let list = revocation_list("acme", &[world.member(*desk).clone()], 1);
            world.hand_crl(*arm, &list);
        } else {
            world.reshare(*arm, "/chatter", Sharing::to(&[*lap, *tab]));
        }
        // It publishes on; nobody told its data path.
        world.tamper(*west, *desk, |_| vec![]);
        let after = publish_as(world, *desk, *arm, ms(10), ms(1500), |_, _| ());
        let rekeyed = events(world, *arm, log).find(|(e, _)| matches!(e, Event::Rekeyed { .. }));
        assert!(rekeyed.expect("a new epoch").1 - kept < ms(1001));
        world.run(ms(500));
        let told = events(world, *arm, log).filter_map(|(e, _)| match e {
            Event::OwnGrant { grant, .. } => Some((grant.epoch, grant.sources.len())),
            _ => None,
        });
        assert_eq!(told.last(), Some((2, 1)), "its own sink hears of it too");
        for user in [*arm, *lap, *tab] {
            assert_received(world, user, *arm, &before);
            let received = world.received(user, *arm, "/chatter");
            let late = after.iter().filter(|id| received.contains(id)).count();
            assert!(late <= 15, "{late} came through at {user:?}, more than were under way");
        }
        if revoked {
            assert_eq!(crate::closed(world, *west), [sgc_router::LinkClose::Revoked]);
            continue;
        }
        // A router that colludes hands its packets to the others once their grace is over.
        world.run(ms(5000));
        let sealed = packets(world, *desk, *west).into_iter().rev().take(30).collect::<Vec<_>>();
        for packet in &sealed {
            world.inject_packet(*west, *tab, packet.clone());
        }
        world.run(ms(500));
        assert_eq!(sink_drops(world, *tab).get("sink_epoch"), Some(&30), "{:?}", sink_drops(world, *tab));
    }
}

/// A subscriber that begins anew takes recorded packets of a publisher at another node than the owner's for past ones,
/// even in the epoch in which they were sealed.
#[test]
fn fresh_subscriber_ignores_recorded_packets_of_other_publishers() {
    for suite in [None, Some(Suite::Group)] {
        let mut scene = scene(WorldConfig::new(86), suite);
        let Scene { world, arm, west, desk, lap, tab, .. } = &mut scene;
        let theirs = publish_as(world, *desk, *arm, ms(10), ms(200), |_, _| ());
        world.run(ms(500));
        let recorded = packets(world, *west, *tab);
        assert_eq!(recorded.len(), 20);
        // One that begins anew in its process, and one whose process does.
        for restarted in [false, true] {
            if restarted {
                world.restart(*tab);
            } else {
                world.stop_using(*tab, *arm, "/chatter");
                world.run(ms(500));
                world.use_topic(*tab, *arm, "/chatter");
            }
            world.until_granted(*tab, *arm, "/chatter");
            world.run(ms(500));
            let (received, before) = (world.received(*tab, *arm, "/chatter").len(), sink_drops(world, *tab));
            for packet in &recorded {
                world.inject_packet(*west, *tab, packet.clone());
            }
            world.run(ms(500));
            assert_eq!(world.received(*tab, *arm, "/chatter").len(), received);
            let below = |drops: &std::collections::BTreeMap<_, _>| {
                drops.get("sink_below_floor").copied().unwrap_or(0)
            };
            assert_eq!(below(&sink_drops(world, *tab)) - below(&before), 20, "{:?}", sink_drops(world, *tab));
            // And it hears what comes.
            let next = publish_as(world, *desk, *arm, ms(10), ms(100), |_, _| ());
            world.run(ms(500));
            assert_received(world, *tab, *arm, &next);
            assert_received(world, *lap, *arm, &next);
        }
        assert_eq!(theirs.len(), 20);
    }
}

#[test]
fn a_publisher_whose_way_moves_goes_on_under_the_same_source() {
    for seed in 0..8 {
        let mut scene = scene(WorldConfig::new(seed), None);
        let Scene { world, arm, east, west, desk, lap, tab } = &mut scene;
        // A second way, and the old place that nobody gives up for a long time.
        world.link(*east, *desk);
        world.run(ms(1500));
        let first = world.publish_as(*desk, *arm, "/chatter").expect("granted");
        world.run(ms(500));
        let name = world.name(*arm, "/chatter");
        let used = world.next_hop(*desk, &name).expect("it flows");
        assert!([*east, *west].contains(&used));
        world.cut_unseen(used, *desk, ms(60_000), ms(0));
        let begin = world.elapsed();
        world.run(ms(100));
        world.until_granted(*desk, *arm, "/chatter");
        assert!(world.elapsed() - begin < ms(5000), "{:?}", world.elapsed() - begin);
        world.run(ms(1500));
        let theirs = publish_as(world, *desk, *arm, ms(10), ms(300), |_, _| ());
        world.run(ms(500));
        for user in [*arm, *lap, *tab] {
            assert_received(world, user, *arm, &theirs);
        }
        let source = |id: MessageId| world.all_published()[id.0 as usize].source;
        assert_eq!(source(first), source(theirs[0]));
    }
}

#[test]
fn a_publisher_goes_on_after_the_owner_started_anew() {
    let mut scene = scene(WorldConfig::new(85), None);
    let Scene { world, arm, desk, lap, tab, .. } = &mut scene;
    publish_as(world, *desk, *arm, ms(10), ms(100), |_, _| ());
    world.rotate(*arm, "/chatter");
    world.run(ms(1500));
    world.restart(*arm);
    world.run(ms(2000));
    for user in [*desk, *lap, *tab] {
        world.until_granted(user, *arm, "/chatter");
    }
    world.run(ms(1500));
    let theirs = publish_as(world, *desk, *arm, ms(10), ms(300), |_, _| ());
    world.run(ms(500));
    for user in [*arm, *lap, *tab] {
        assert_received(world, user, *arm, &theirs);
    }
}
