//! Replays of recorded packets and answers at every later occasion.

use sgc_endpoint::{Sink, SinkLimits};
use sgc_testkit::{Sharing, World, WorldConfig};
use sgc_wire::{AnswerBody, Control, Decode, Packet};

use crate::{
    Scene, assert_received, flowing, flowing_with, frames, grants, ms, packets, publish_steadily, sink_drops,
};

/// The scene after twenty messages, and the packets that brought them to `desk`.
fn recorded(seed: u64) -> (Scene, Vec<Packet>) {
    let mut scene = flowing(seed);
    let Scene { world, arm, west, desk, .. } = &mut scene;
    publish_steadily(world, *arm, ms(10), ms(200), |_, _| ());
    world.run(ms(500));
    assert_eq!(world.received(*desk, *arm, "/chatter").len(), 20);
    let recorded = packets(world, *west, *desk);
    assert_eq!(recorded.len(), 20);
    (scene, recorded)
}

/// Replays packets to `desk` and checks that none is delivered. Returns the reasons of the refusals.
fn play(scene: &mut Scene, recorded: &[Packet]) -> Vec<(&'static str, usize)> {
    let Scene { world, arm, west, desk, .. } = scene;
    let (received, before) = (world.received(*desk, *arm, "/chatter").len(), sink_drops(world, *desk));
    for packet in recorded {
        world.inject_packet(*west, *desk, packet.clone());
    }
    world.run(ms(500));
    assert_eq!(world.received(*desk, *arm, "/chatter").len(), received, "{}", world.trace());
    let new = sink_drops(world, *desk).into_iter().map(|(k, n)| (k, n - before.get(k).copied().unwrap_or(0)));
    new.filter(|(_, n)| *n > 0).collect()
}

/// Checks that the topic still flows.
fn assert_goes_on(scene: &mut Scene) {
    let Scene { world, arm, desk, .. } = scene;
    world.until_granted(*desk, *arm, "/chatter");
    world.run(ms(500));
    let published = publish_steadily(world, *arm, ms(10), ms(100), |_, _| ());
    world.run(ms(500));
    assert_received(world, *desk, *arm, &published);
}

#[test]
fn replay_in_same_session_is_refused() {
    let (mut scene, recorded) = recorded(50);
    assert_eq!(play(&mut scene, &recorded), [("sink_replayed", 20)]);
    // Long after, when they are older than any window.
    publish_steadily(&mut scene.world, scene.arm, ms(1), ms(1100), |_, _| ());
    scene.world.run(ms(500));
    assert_eq!(play(&mut scene, &recorded), [("sink_replayed", 20)]);
    assert_goes_on(&mut scene);
}

#[test]
fn replay_after_new_link_is_refused() {
    let (mut scene, recorded) = recorded(51);
    let Scene { world, arm, west, desk, .. } = &mut scene;
    world.cut(*west, *desk);
    world.run(ms(500));
    world.rejoin(*west, *desk);
    world.until_granted(*desk, *arm, "/chatter");
    world.run(ms(500));
    assert_eq!(play(&mut scene, &recorded), [("sink_replayed", 20)]);
    assert_goes_on(&mut scene);
}

#[test]
fn replay_after_restart_of_subscriber_is_refused() {
    let (mut scene, recorded) = recorded(52);
    scene.world.restart(scene.desk);
    scene.world.until_granted(scene.desk, scene.arm, "/chatter");
    scene.world.run(ms(500));
    assert_eq!(play(&mut scene, &recorded), [("sink_below_floor", 20)]);
    assert_goes_on(&mut scene);
    // The same to a use of the topic that begins in the same run.
    let Scene { world, arm, desk, .. } = &mut scene;
    world.stop_using(*desk, *arm, "/chatter");
    world.run(ms(500));
    world.use_topic(*desk, *arm, "/chatter");
    world.until_granted(*desk, *arm, "/chatter");
    world.run(ms(500));
    assert_eq!(play(&mut scene, &recorded), [("sink_below_floor", 20)]);
    assert_goes_on(&mut scene);
}

#[test]
fn replay_after_restart_of_owner_is_refused() {
    for both in [false, true] {
        let (mut scene, recorded) = recorded(53);
        scene.world.restart(scene.arm);
        if both {
            scene.world.restart(scene.desk);
        }
        scene.world.run(ms(1000));
        scene.world.until_granted(scene.desk, scene.arm, "/chatter");
        scene.world.run(ms(500));
        assert_eq!(play(&mut scene, &recorded), [("sink_forged", 20)], "another key, though also of epoch 1");
        assert_goes_on(&mut scene);
    }
}

#[test]
fn replay_of_past_epoch_is_refused() {
    let (mut scene, recorded) = recorded(54);
    scene.world.rotate(scene.arm, "/chatter");
    scene.world.run(ms(1000));
    assert_eq!(play(&mut scene, &recorded), [("sink_replayed", 20)], "what may still be under way opens");
    scene.world.run(ms(5000));
    assert_eq!(play(&mut scene, &recorded), [("sink_epoch", 20)], "its key is gone");
    assert_goes_on(&mut scene);
}

#[test]
fn replay_of_history_to_same_or_other_sink_is_refused() {
    let mut scene = flowing_with(WorldConfig::new(55), |s| s.transient_local(10));
    let Scene { world, arm, west, desk, .. } = &mut scene;
    publish_steadily(world, *arm, ms(10), ms(100), |_, _| ());
    world.run(ms(500));
    world.restart(*desk);
    world.until_granted(*desk, *arm, "/chatter");
    world.run(ms(1000));
    let history: Vec<_> =
        packets(world, *west, *desk).into_iter().filter(|p| p.header.to.is_some()).collect();
    assert!(history.len() > 10, "ten messages and a mark");
    let of_mark = history.iter().filter(|p| p.header.seq == 0).count();
    let again = play(&mut scene, &history);
    let replayed = again.iter().find(|(k, _)| *k == "sink_replayed").map_or(0, |(_, n)| *n);
    assert!(replayed >= 10 && replayed <= history.len() - of_mark, "{again:?}");
    scene.world.restart(scene.desk);
    scene.world.until_granted(scene.desk, scene.arm, "/chatter");
    scene.world.run(ms(1000));
    let all = scene.world.received(scene.desk, scene.arm, "/chatter").len();
    assert_eq!(all, 30, "each run got each message once");
    // To the sink of the run before: for nobody who is here.
    assert_eq!(play(&mut scene, &history), []);
    assert_goes_on(&mut scene);
}

/// Returns the answers that went over a link, with their serials.
fn answers(world: &World, scene: (sgc_testkit::NodeKey, sgc_testkit::NodeKey)) -> Vec<(AnswerBody, Control)> {
    let all = frames(world, scene.0, scene.1).into_iter();
    all.filter_map(|frame| match &frame {
        Control::Answer { signed } => Some((AnswerBody::from_slice(&signed.body).expect("as sent"), frame)),
        _ => None,
    })
    .collect()
}

#[test]
fn replay_of_earlier_grant_is_refused() {
    let (mut scene, _) = recorded(56);
    let Scene { world, arm, west, desk, .. } = &mut scene;
    for _ in 0..3 {
        world.rotate(*arm, "/chatter");
        world.run(ms(2000));
    }
    let name = world.name(*arm, "/chatter");
    let mut old = answers(world, (*west, *desk));
    old.retain(|(body, _)| body.name == name);
    assert_eq!(old.iter().map(|(body, _)| body.serial).collect::<Vec<_>>(), [1, 2, 3, 4]);
    let granted = grants(world, *desk, *arm).len();
    for (_, answer) in &old {
        world.inject(*west, *desk, answer);
    }
    world.run(ms(500));
    assert_eq!(grants(world, *desk, *arm).len(), granted, "each is taken once, in its order");
    assert_goes_on(&mut scene);
}

#[test]
fn a_router_that_swaps_epochs_harms_only_those_behind_it() {
    let (mut scene, _) = recorded(57);
    let others = scene.without(scene.desk);
    let Scene { world, arm, west, desk, .. } = &mut scene;
    let mut held = None;
    world.tamper(*west, *desk, move |frame| match (frame, held.take()) {
        (Control::Answer { .. }, None) => {
            held = Some(frame.clone());
            vec![]
        }
        (Control::Answer { .. }, Some(older)) => vec![frame.clone(), older],
        (_, older) => {
            held = older;
            vec![frame.clone()]
        }
    });
    let mut rotations = 0;
    let published = publish_steadily(world, *arm, ms(10), ms(4000), |world, passed| {
        if passed >= ms(500) + ms(1600) * rotations && rotations < 2 {
            world.rotate(*arm, "/chatter");
            rotations += 1;
        }
    });
    world.run(ms(1000));
    assert_eq!(world.epoch(*arm, "/chatter"), Some(3));
    let epochs: Vec<_> = grants(world, *desk, *arm).iter().map(|(_, g)| g.epoch).collect();
    assert_eq!(epochs, [1, 3], "the older answer is not taken after the newer");
    for user in others {
        assert_received(world, user, *arm, &published);
    }
    world.be_honest(*west, *desk);
    assert_goes_on(&mut scene);
}

#[test]
fn packets_of_a_later_epoch_that_come_first_are_each_delivered_once_and_in_order() {
    let mut scene = flowing_with(WorldConfig::new(58), Sharing::best_effort);
    let Scene { world, arm, west, desk, .. } = &mut scene;
    let mut published = publish_steadily(world, *arm, ms(10), ms(100), |_, _| ());
    world.rotate(*arm, "/chatter");
    world.run(ms(1000));
    published.extend(publish_steadily(world, *arm, ms(10), ms(100), |_, _| ()));
    world.run(ms(500));
    let granted = grants(world, *desk, *arm);
    let (id, first) = granted[0].clone();
    let mut sink = Sink::new(world.name(*arm, "/chatter"), id, first, false, SinkLimits::default());
    let mut mixed = packets(world, *west, *desk);
    assert_eq!(mixed.len(), 20);
    mixed.rotate_left(10);
    mixed.extend(mixed.clone());
    let mut delivered = 0;
    for packet in &mixed {
        delivered +=
            usize::from(matches!(sink.handle_packet(packet), Ok(sgc_endpoint::Delivery::Message(_))));
    }
    assert_eq!(delivered, 10, "those of the epoch that it knows");
    sink.regrant(id, granted[1].1.clone(), |d| {
        delivered += usize::from(matches!(d, Ok(sgc_endpoint::Delivery::Message(_))));
    });
    assert_eq!(delivered, published.len(), "the others waited for its key");
}
