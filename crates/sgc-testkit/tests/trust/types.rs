//! A node gets type descriptions once, if it asks and may have the topic. No other node gets them.

use bytes::Bytes;
use sgc_endpoint::{Event, unpack_type};
use sgc_testkit::{Member, NodeKey, Sharing, World, WorldConfig, revocation_list};

use crate::{Scene, flowing, ms, scene_with};

const HASH: &str = "RIHS01_00";

fn description(n: u8) -> Bytes {
    vec![n; 3000].into()
}

/// Returns the type descriptions that a node got, answer by answer, for these topics of the owner.
fn told(world: &World, node: NodeKey, owner: NodeKey, topics: &[&str]) -> Vec<Vec<(String, Bytes)>> {
    let of_answer = |(event, _): (&Event, _)| {
        let Event::Types { types, .. } = event else { return None };
        let of_type = |described: &sgc_wire::DescribedType| {
            assert_eq!(described.type_hash, HASH);
            let topic = topics.iter().find(|topic| world.name(owner, topic) == described.name);
            ((*topic.expect("one that was asked for")).to_owned(), unpack_type(described).expect("as packed"))
        };
        Some(types.iter().map(of_type).collect())
    };
    crate::events(world, node, 0).filter_map(of_answer).collect()
}

#[test]
fn type_description_is_sent_once_and_not_again_with_each_epoch() {
    let mut scene = flowing(200);
    let Scene { world, arm, desk, lap, .. } = &mut scene;
    world.describe(*arm, "/chatter", HASH, &description(1));
    world.ask_types(*desk, *arm, &["/chatter"]);
    world.run(ms(1000));
    let all = [vec![("/chatter".to_owned(), description(1))]];
    assert_eq!(told(world, *desk, *arm, &["/chatter"]), all);
    for _ in 0..3 {
        world.rotate(*arm, "/chatter");
        world.run(ms(2000));
    }
    assert_eq!(world.epoch(*arm, "/chatter"), Some(4));
    assert_eq!(told(world, *desk, *arm, &["/chatter"]), all);
    assert!(told(world, *lap, *arm, &["/chatter"]).is_empty(), "it has not asked");
}

#[test]
fn unknown_type_description_follows_once_owner_has_it() {
    let mut scene = flowing(201);
    let Scene { world, arm, desk, .. } = &mut scene;
    let topics = ["/chatter", "/other"];
    world.share(*arm, "/other", Sharing::to_fleet());
    // Before the owner describes a type, no node can be asked.
    world.ask_types(*desk, *arm, &topics);
    world.run(ms(1000));
    assert!(told(world, *desk, *arm, &topics).is_empty());
    world.describe(*arm, "/other", HASH, &description(2));
    world.run(ms(1000));
    let first = vec![("/other".to_owned(), description(2))];
    assert_eq!(told(world, *desk, *arm, &topics), std::slice::from_ref(&first));
    world.describe(*arm, "/chatter", HASH, &description(1));
    world.run(ms(1000));
    let second = vec![("/chatter".to_owned(), description(1))];
    assert_eq!(told(world, *desk, *arm, &topics), [first, second]);
}

#[test]
fn simultaneous_type_descriptions_share_one_answer_and_are_repeated_on_request() {
    let mut scene = flowing(206);
    let Scene { world, arm, desk, .. } = &mut scene;
    let topics = ["/chatter", "/other"];
    world.share(*arm, "/other", Sharing::to_fleet());
    world.share(*arm, "/third", Sharing::to_fleet());
    world.describe(*arm, "/third", HASH, &description(3));
    world.ask_types(*desk, *arm, &topics);
    world.run(ms(1000));
    assert_eq!(told(world, *desk, *arm, &topics), [vec![]]);
    world.describe_all(*arm, &topics, HASH, &description(1));
    world.run(ms(1000));
    let sizes = |world: &World| told(world, *desk, *arm, &topics).iter().map(Vec::len).collect::<Vec<_>>();
    assert_eq!(sizes(world), [0, 2]);
    // For who had no room for it.
    world.ask_types(*desk, *arm, &topics);
    world.run(ms(1000));
    assert_eq!(sizes(world), [0, 2, 2]);
}

#[test]
fn unauthorised_node_gets_no_type_description() {
    let mut scene = scene_with(WorldConfig::new(202));
    let Scene { world, arm, desk, lap, .. } = &mut scene;
    world.share(*arm, "/chatter", Sharing::to(&[*desk]));
    world.describe(*arm, "/chatter", HASH, &description(1));
    world.ask_types(*lap, *arm, &["/chatter"]);
    world.run(ms(1000));
    assert_eq!(told(world, *lap, *arm, &["/chatter"]), [vec![]]);
    // It is told once it may.
    world.reshare(*arm, "/chatter", Sharing::to_fleet());
    world.ask_types(*lap, *arm, &[]);
    world.ask_types(*lap, *arm, &["/chatter"]);
    world.run(ms(1000));
    assert_eq!(told(world, *lap, *arm, &["/chatter"]).len(), 2);
}

#[test]
fn a_partner_is_told_of_its_topic_alone() {
    let mut scene = scene_with(WorldConfig::new(203));
    let Scene { world, arm, east, west, desk, .. } = &mut scene;
    let visitor = world.node(Member { fleet: "umbrella".to_owned(), ..Member::new("visitor") }, false);
    [*arm, *east, *west].into_iter().for_each(|node| world.trust_fleet(node, "umbrella"));
    world.trust_fleet(visitor, "acme");
    world.link(*west, visitor);
    let partner = Sharing { partners: ["umbrella".to_owned()].into(), ..Sharing::to(&[*desk]) };
    world.share(*arm, "/chatter", partner);
    world.share(*arm, "/secret", Sharing::to_fleet());
    for topic in ["/chatter", "/secret"] {
        world.describe(*arm, topic, HASH, &description(1));
    }
    world.ask_types(visitor, *arm, &["/chatter", "/secret"]);
    world.run(ms(1000));
    assert_eq!(told(world, visitor, *arm, &["/chatter"]), [vec![("/chatter".to_owned(), description(1))]]);
}

#[test]
fn node_revoked_while_it_waits_gets_no_type_description() {
    let mut scene = flowing(204);
    let Scene { world, arm, east, lap, .. } = &mut scene;
    world.share(*arm, "/other", Sharing::to_fleet());
    world.describe(*arm, "/other", HASH, &description(2));
    world.ask_types(*lap, *arm, &["/chatter"]);
    world.run(ms(1000));
    assert_eq!(told(world, *lap, *arm, &["/chatter"]), [vec![]]);
    let list = revocation_list("acme", &[world.member(*lap).clone()], 1);
    world.hand_crl(*east, &list);
    world.run(ms(1000));
    world.describe(*arm, "/chatter", HASH, &description(1));
    world.run(ms(1000));
    assert_eq!(told(world, *lap, *arm, &["/chatter"]), [vec![]]);
}

#[test]
fn the_owner_can_be_asked_while_it_shares_something_that_it_describes() {
    let mut scene = scene_with(WorldConfig::new(205));
    let Scene { world, arm, east, .. } = &mut scene;
    world.run(ms(1000));
    let names = |world: &World| world.stats(*east).routed_names;
    let before = names(world);
    for topic in ["/chatter", "/other"] {
        world.share(*arm, topic, Sharing::to_fleet());
        world.describe(*arm, topic, HASH, &description(1));
    }
    world.run(ms(1000));
    assert_eq!(names(world), before + 3);
    for (topic, left) in [("/chatter", 2), ("/other", 0)] {
        world.unshare(*arm, topic);
        world.run(ms(1000));
        assert_eq!(names(world), before + left);
    }
}
