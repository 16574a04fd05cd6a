//! Nodes tell each other the time by their clocks, and what they want of each other's topics.

use std::time::Duration;

use sgc_endpoint::{Event, LostReason};
use sgc_testkit::{NodeKey, World};
use sgc_wire::UnixMillis;

use crate::{Scene, flowing, ms};

const AHEAD: Duration = Duration::from_secs(120);

/// Returns the times that a node was told: by how many milliseconds each is ahead of the time of its arrival, and how long
/// the node waited for it.
fn told(world: &World, node: NodeKey) -> Vec<(i64, Duration)> {
    let of_answer = |(event, at): (&Event, Duration)| {
        let Event::Time { asked, time, .. } = event else { return None };
        let (now, since) = (world.now(), world.elapsed() - at);
        let arrived = now.unix.0 as i64 - since.as_millis() as i64;
        let UnixMillis(time) = *time;
        Some((time as i64 - arrived, now.instant - since - *asked))
    };
    crate::events(world, node, 0).filter_map(of_answer).collect()
}

#[test]
fn nodes_learn_the_time_of_others_as_often_as_they_ask() {
    let mut scene = flowing(220);
    let Scene { world, arm, desk, .. } = &mut scene;
    world.ask_clock(*desk, *arm);
    world.run(ms(1000));
    assert!(told(world, *desk).is_empty(), "it does not tell its time yet");
    world.offer_clock(*arm);
    world.set_ahead(*arm, AHEAD);
    for asked in 1..=3 {
        world.run(ms(1000));
        let told = told(world, *desk);
        assert_eq!(told.len(), asked);
        // It read its clock between the question and the answer.
        for (ahead, waited) in told {
            let most = AHEAD.as_millis() as i64;
            // Each of the two times is cut to a millisecond.
            let (most, least) = (most + 1, most - waited.as_millis() as i64 - 1);
            assert!((least..=most).contains(&ahead), "{ahead} after {waited:?}");
        }
        world.ask_clock(*desk, *arm);
    }
}

/// Returns the least times between two messages that a node is wished, in each answer that it got.
fn wished(world: &World, node: NodeKey) -> Vec<Vec<Option<Duration>>> {
    let of_answer = |(event, _): (&Event, _)| {
        let Event::Wishes { wishes, .. } = event else { return None };
        Some(wishes.iter().map(|wish| wish.interval).collect())
    };
    crate::events(world, node, 0).filter_map(of_answer).collect()
}

#[test]
fn an_owner_learns_what_others_want_of_its_topics_and_of_no_others() {
    let mut scene = flowing(221);
    let Scene { world, arm, desk, lap, .. } = &mut scene;
    for owner in [*arm, *lap] {
        world.ask_wishes(owner, *desk);
    }
    world.run(ms(1000));
    assert!(wished(world, *arm).is_empty(), "it wishes nothing");
    world.set_wishes(*desk, &[(*arm, "/chatter", ms(200))]);
    world.run(ms(1000));
    assert_eq!((wished(world, *arm), wished(world, *lap)), (vec![vec![Some(ms(200))]], vec![vec![]]));
    world.set_wishes(*desk, &[(*arm, "/chatter", ms(500))]);
    world.run(ms(1000));
    world.set_wishes(*desk, &[]);
    world.run(ms(1000));
    assert_eq!(wished(world, *arm)[1..], [vec![Some(ms(500))], vec![]]);
    assert_eq!(wished(world, *lap).len(), 1, "nothing of its own changed");
    world.shut_down(*desk);
    world.run(ms(1000));
    let lost = crate::events(world, *arm, 0).filter_map(|(event, _)| match event {
        Event::WishesLost { reason, .. } => Some(*reason),
        _ => None,
    });
    assert!(lost.into_iter().any(|reason| reason == LostReason::Withdrawn));
}
