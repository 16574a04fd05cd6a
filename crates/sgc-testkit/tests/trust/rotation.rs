//! New epochs: the remaining members get a new key, and no message is lost or repeated.

use std::time::Duration;

use sgc_endpoint::{EPOCHS_MAX, Event};
use sgc_testkit::{MessageId, NodeKey, World, WorldConfig};

use crate::{Scene, assert_received, events, flowing, flowing_with, grants, ms, publish_steadily, slow};

/// Returns the times at which epochs of `/chatter` began at its owner.
fn began(world: &World, owner: NodeKey) -> Vec<(u32, Duration)> {
    let rekeyed = |(event, at): (&Event, Duration)| match event {
        Event::Rekeyed { grant, .. } => Some((grant.epoch, at)),
        _ => None,
    };
    events(world, owner, 0).filter_map(rekeyed).collect()
}

#[test]
fn a_new_epoch_loses_and_doubles_nothing() {
    for seed in 0..12 {
        let mut scene = flowing_with(slow(seed), |s| if seed % 2 == 0 { s.best_effort() } else { s });
        let Scene { world, arm, .. } = &mut scene;
        let mut next = ms(200);
        let published = publish_steadily(world, *arm, ms(7), ms(6000), |world, passed| {
            if passed >= next {
                world.rotate(*arm, "/chatter");
                next += ms(1300);
            }
        });
        world.run(ms(3000));
        for user in scene.users() {
            assert_received(&scene.world, user, scene.arm, &published);
            let epochs: Vec<_> = grants(&scene.world, user, scene.arm).iter().map(|(_, g)| g.epoch).collect();
            assert_eq!(epochs.last(), Some(&6), "{epochs:?}");
        }
        assert_eq!(began(&scene.world, scene.arm).len(), 5);
        assert_eq!(scene.world.epoch(scene.arm, "/chatter"), Some(6));
        assert_eq!(crate::sink_drops(&scene.world, scene.desk).len(), 0);
    }
}

#[test]
fn a_message_of_many_packets_goes_on_over_a_new_epoch() {
    for seed in 0..4 {
        let mut scene = flowing_with(slow(seed), |s| s);
        let Scene { world, arm, .. } = &mut scene;
        let mut published = Vec::new();
        for n in 0..30 {
            if n % 5 == 2 {
                world.rotate(*arm, "/chatter");
            }
            published.push(world.publish_bytes(*arm, "/chatter", 200_000));
            world.run(ms(60));
        }
        world.run(ms(3000));
        for user in scene.users() {
            assert_received(&scene.world, user, scene.arm, &published);
        }
    }
}

#[test]
fn late_joiners_get_the_whole_history_across_epochs() {
    for seed in 0..6 {
        let mut scene = flowing_with(slow(seed), |s| s.transient_local(20));
        let Scene { world, arm, tab, .. } = &mut scene;
        world.stop_using(*tab, *arm, "/chatter");
        world.run(ms(500));
        let mut published = Vec::new();
        for n in 0..20 {
            if n % 6 == 5 {
                world.rotate(*arm, "/chatter");
            }
            published.push(world.publish(*arm, "/chatter"));
            world.run(ms(300));
            if n == 9 {
                // While an epoch is being replaced.
                world.rotate(*arm, "/chatter");
                world.use_topic(*tab, *arm, "/chatter");
            }
        }
        world.run(ms(5000));
        let before = received_by(world, *tab, *arm, &published).len();
        assert_eq!(before, 20, "{}", world.trace());
        // A node that joins at the end gets them once more.
        world.restart(*tab);
        world.until_granted(*tab, *arm, "/chatter");
        world.run(ms(3000));
        assert_eq!(received_by(world, *tab, *arm, &published).len(), 40, "each run gets each once");
    }
}

fn received_by(world: &World, user: NodeKey, owner: NodeKey, published: &[MessageId]) -> Vec<MessageId> {
    world.received(user, owner, "/chatter").into_iter().filter(|id| published.contains(id)).collect()
}

#[test]
fn a_sink_that_never_says_that_it_has_the_key_delays_by_rotate_wait_at_most() {
    let mut scene = flowing(7);
    let Scene { world, arm, tab, .. } = &mut scene;
    world.freeze(*tab);
    let begin = world.elapsed();
    world.rotate(*arm, "/chatter");
    let published = publish_steadily(world, *arm, ms(20), ms(3000), |_, _| ());
    let [(2, at)] = began(world, *arm)[..] else { panic!("{:?}", began(world, *arm)) };
    assert!(at - begin >= ms(950) && at - begin <= ms(1001), "{:?}", at - begin);
    world.run(ms(1000));
    for user in scene.without(scene.tab) {
        assert_received(&scene.world, user, scene.arm, &published);
    }
    // Nor does it lose anything itself once it goes on.
    scene.world.thaw(scene.tab);
    scene.world.run(ms(1000));
    assert_received(&scene.world, scene.tab, scene.arm, &published);
}

#[test]
fn an_epoch_begins_as_soon_as_all_have_its_key() {
    let mut scene = flowing(8);
    let Scene { world, arm, .. } = &mut scene;
    let begin = world.elapsed();
    world.rotate(*arm, "/chatter");
    world.run(ms(2000));
    let [(2, at)] = began(world, *arm)[..] else { panic!("{:?}", began(world, *arm)) };
    assert!(at - begin < ms(300), "one way and back: {:?}", at - begin);
}

#[test]
fn rotations_that_overlap_do_not_put_each_other_off() {
    // With a node that never answers, each rotation alone would wait its full time.
    let mut scene = flowing(9);
    let Scene { world, arm, tab, .. } = &mut scene;
    world.freeze(*tab);
    let mut next = Duration::ZERO;
    let begin = world.elapsed();
    let published = publish_steadily(world, *arm, ms(10), ms(6000), |world, passed| {
        if passed >= next {
            world.rotate(*arm, "/chatter");
            next += ms(50);
        }
    });
    let mut last = begin;
    for (epoch, at) in began(world, *arm) {
        assert!(at - last <= ms(1050), "epoch {epoch} came {:?} after the one before", at - last);
        last = at;
    }
    assert!(world.elapsed() - last <= ms(1100), "the last at {last:?} of {:?}", world.elapsed());
    world.run(ms(3000));
    for user in scene.without(scene.tab) {
        assert_received(&scene.world, user, scene.arm, &published);
    }
}

#[test]
fn more_rotations_at_once_than_keys_are_held_lose_nothing() {
    for seed in 0..6 {
        let mut scene = flowing_with(slow(seed), |s| s);
        let Scene { world, arm, .. } = &mut scene;
        let mut left = 2 * EPOCHS_MAX;
        let published = publish_steadily(world, *arm, ms(10), ms(5000), |world, _| {
            if left > 0 {
                world.rotate(*arm, "/chatter");
                left -= 1;
            }
        });
        world.run(ms(3000));
        for user in scene.users() {
            assert_received(&scene.world, user, scene.arm, &published);
        }
        let epoch = scene.world.epoch(scene.arm, "/chatter");
        let granted = grants(&scene.world, scene.desk, scene.arm).last().map(|(_, g)| g.epoch);
        assert_eq!(epoch, granted, "no rotation is left hanging");
    }
}

#[test]
fn a_new_epoch_while_the_way_moves_leaves_all_with_its_key() {
    for seed in 0..20 {
        let mut scene = flowing_with(slow(seed), |s| s.transient_local(1000));
        let Scene { world, arm, east, west, .. } = &mut scene;
        // There are two paths, and the first is cut while keys are in flight.
        let north = world.router("north");
        world.link(*east, north);
        world.link(north, *west);
        world.run(ms(1500));
        let (east, west) = (*east, *west);
        let mut cut = false;
        let mut rotated = 0;
        let published = publish_steadily(world, *arm, ms(20), ms(4000), |world, passed| {
            if passed >= ms(500) + ms(seed * 23) && !cut {
                world.cut(east, west);
                cut = true;
            }
            if passed >= ms(400) + ms(200) * rotated && rotated < 3 {
                world.rotate(*arm, "/chatter");
                rotated += 1;
            }
        });
        for user in scene.users() {
            scene.world.until_granted(user, scene.arm, "/chatter");
        }
        scene.world.run(ms(6000));
        // Packets in flight on a cut cable come again from the history; each message arrives exactly once.
        for user in scene.users() {
            let mut received = received_by(&scene.world, user, scene.arm, &published);
            received.sort_unstable();
            assert_eq!(received, published, "{user:?}\n{}", scene.world.trace());
        }
        assert_eq!(scene.world.epoch(scene.arm, "/chatter"), Some(4));
    }
}

#[test]
fn node_that_joins_between_epochs_gets_all_later_messages() {
    for seed in 0..8 {
        let mut scene = flowing(seed);
        let Scene { world, arm, lap, tab, .. } = &mut scene;
        world.stop_using(*tab, *arm, "/chatter");
        world.run(ms(1000));
        // One that stands still keeps the next epoch waiting, so that the joiner comes in between.
        world.freeze(*lap);
        world.rotate(*arm, "/chatter");
        world.use_topic(*tab, *arm, "/chatter");
        let begin = world.elapsed();
        while !world.granted(*arm, "/chatter").contains(tab) {
            world.run(ms(5));
            assert!(world.elapsed() - begin < ms(5000));
        }
        assert_eq!(world.epoch(*arm, "/chatter"), Some(1), "it came in between");
        world.run(ms(100)); // the branch gets into place
        let published = publish_steadily(world, *arm, ms(10), ms(2500), |_, _| ());
        world.run(ms(2000));
        assert_received(&scene.world, scene.tab, scene.arm, &published);
        let granted = grants(&scene.world, scene.tab, scene.arm);
        let epochs: Vec<_> = granted.iter().rev().map(|(_, g)| g.epoch).take(2).collect();
        assert_eq!(epochs, [2, 1], "granted both");
        assert_eq!(scene.world.epoch(scene.arm, "/chatter"), Some(2));
    }
}

#[test]
fn epochs_end_by_time() {
    let mut config = WorldConfig::new(11);
    config.endpoint_limits.rotate_every = ms(60_000);
    let mut scene = flowing_with(config, |s| s);
    let Scene { world, arm, .. } = &mut scene;
    let begin = world.elapsed();
    let published = publish_steadily(world, *arm, ms(500), ms(200_000), |_, _| ());
    let epochs = began(world, *arm);
    assert_eq!(epochs.iter().map(|(n, _)| *n).collect::<Vec<_>>(), [2, 3, 4], "since {begin:?}");
    for pair in epochs.windows(2) {
        let lasted = pair[1].1 - pair[0].1;
        assert!(lasted > ms(59_000) && lasted < ms(61_500), "{lasted:?}");
    }
    world.run(ms(1000));
    for user in scene.users() {
        assert_received(&scene.world, user, scene.arm, &published);
    }
}
