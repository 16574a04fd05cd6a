//! Only the owner of a topic learns its consumers, sealed.

use sgc_endpoint::{Event, LostReason};
use sgc_testkit::{NodeKey, Sharing, World};
use sgc_wire::RefuseReason;

use crate::{Scene, flowing, ms};

/// Returns the names of ROS 2 nodes in each answer that a node got.
fn told(world: &World, node: NodeKey) -> Vec<Vec<String>> {
    let of_answer = |(event, _): (&Event, _)| {
        let Event::Consumers { consumers, .. } = event else { return None };
        Some(consumers.iter().map(|consumer| consumer.node.name().to_owned()).collect())
    };
    crate::events(world, node, 0).filter_map(of_answer).collect()
}

fn lost(world: &World, node: NodeKey) -> Vec<LostReason> {
    let of_loss = |(event, _): (&Event, _)| match event {
        Event::ConsumersLost { reason, .. } => Some(*reason),
        _ => None,
    };
    crate::events(world, node, 0).filter_map(of_loss).collect()
}

#[test]
fn owner_is_told_its_own_consumers_and_told_again_when_they_change() {
    let mut scene = flowing(210);
    let Scene { world, arm, desk, lap, .. } = &mut scene;
    world.share(*lap, "/map", Sharing::to_fleet());
    // Before there is a consumer, no node can be asked.
    for owner in [*arm, *lap] {
        world.ask_consumers(owner, *desk);
    }
    world.run(ms(1000));
    assert!(told(world, *arm).is_empty());
    world.set_consumers(*desk, &[(*arm, "/chatter", "view"), (*lap, "/map", "planner")]);
    world.run(ms(1000));
    assert_eq!(
        (told(world, *arm), told(world, *lap)),
        (vec![vec!["view".into()]], vec![vec!["planner".into()]])
    );
    let both = [(*arm, "/chatter", "view"), (*lap, "/map", "planner"), (*arm, "/chatter", "recorder")];
    world.set_consumers(*desk, &both);
    world.run(ms(1000));
    assert_eq!(told(world, *arm), [vec!["view".to_owned()], vec!["view".into(), "recorder".into()]]);
    assert_eq!(told(world, *lap).len(), 1, "nothing of its own changed");
    world.set_consumers(*desk, &[]);
    world.run(ms(1000));
    assert_eq!((told(world, *arm).pop(), told(world, *lap).pop()), (Some(vec![]), Some(vec![])));
}

#[test]
fn node_without_such_consumers_is_told_none() {
    let mut scene = flowing(211);
    let Scene { world, arm, desk, tab, west, .. } = &mut scene;
    world.set_consumers(*desk, &[(*arm, "/chatter", "view")]);
    for curious in [*tab, *west] {
        world.ask_consumers(curious, *desk);
    }
    world.run(ms(1000));
    assert_eq!((told(world, *tab), told(world, *west)), (vec![vec![]], vec![vec![]]));
}

#[test]
fn owner_hears_of_the_end_and_of_the_way_back() {
    let mut scene = flowing(212);
    let Scene { world, arm, west, desk, .. } = &mut scene;
    world.set_consumers(*desk, &[(*arm, "/chatter", "view")]);
    world.ask_consumers(*arm, *desk);
    world.run(ms(1000));
    world.cut(*west, *desk);
    world.run(ms(1000));
    let cut = lost(world, *arm);
    assert!(matches!(cut[..], [LostReason::Unreachable | LostReason::Cut(_)]), "{cut:?}");
    world.rejoin(*west, *desk);
    world.run(ms(5000));
    assert_eq!(told(world, *arm), [["view".to_owned()], ["view".to_owned()]]);
    world.shut_down(*desk);
    world.run(ms(1000));
    let ended = lost(world, *arm).pop();
    assert!(
        matches!(ended, Some(LostReason::Withdrawn | LostReason::Refused(RefuseReason::NotShared))),
        "{ended:?}"
    );
}
