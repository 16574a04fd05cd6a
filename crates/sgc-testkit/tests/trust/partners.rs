//! A node of another fleet whose CA is trusted gets only the topics that name it.

use bytes::Bytes;
use sgc_endpoint::{Event, JoinStatus, RefusedBy};
use sgc_testkit::{Member, NodeKey, Sharing, World, WorldConfig, revocation_list, serial_list};
use sgc_wire::{Control, RefuseReason};

use crate::{Scene, assert_received, drops, events, frames, grants, ms, publish_steadily, scene_with};

/// The scene with `/chatter` for its own fleet as `sharing` says, and a node of another fleet that everyone trusts.
fn scene(seed: u64, sharing: impl FnOnce(Sharing) -> Sharing) -> (Scene, NodeKey) {
    let mut scene = scene_with(WorldConfig::new(seed));
    let member =
        Member { fleet: "umbrella".to_owned(), groups: vec!["crew".to_owned()], ..Member::new("visitor") };
    let visitor = scene.world.node(member, false);
    for node in [scene.arm, scene.east, scene.west] {
        scene.world.trust_fleet(node, "umbrella");
    }
    scene.world.trust_fleet(visitor, "acme");
    scene.world.link(scene.west, visitor);
    scene.world.share(scene.arm, "/chatter", sharing(Sharing::to(&[scene.desk])));
    scene.world.share(scene.arm, "/secret", Sharing::to_fleet());
    scene.world.use_topic(scene.desk, scene.arm, "/chatter");
    scene.world.until_granted(scene.desk, scene.arm, "/chatter");
    (scene, visitor)
}

fn with_umbrella(sharing: Sharing) -> Sharing {
    Sharing { partners: ["umbrella".to_owned()].into(), ..sharing }
}

#[test]
fn a_partner_gets_the_topic_that_it_was_given_and_is_told_what_it_is() {
    let (mut scene, visitor) = scene(100, with_umbrella);
    let Scene { world, arm, .. } = &mut scene;
    world.join_blindly(visitor, *arm, "/chatter");
    world.until_granted(visitor, *arm, "/chatter");
    let (_, grant) = grants(world, visitor, *arm).pop().expect("granted");
    let entry = grant.entry.expect("a partner sees no catalogue");
    assert_eq!(entry.metadata.ros_name, "/chatter");
    // Knowing the name of another topic does not help.
    world.join_blindly(visitor, *arm, "/secret");
    world.run(ms(1000));
    let by = RefusedBy::Owner(RefuseReason::NotPermitted);
    assert_eq!(world.status(visitor, *arm, "/secret"), Some(JoinStatus::Refused(by)));
}

#[test]
fn a_trusted_ca_alone_opens_nothing() {
    // Its members may be called what they like: groups count with the CA that certified them.
    let (mut scene, visitor) =
        scene(101, |sharing| Sharing { groups: ["crew".to_owned()].into(), ..sharing });
    let Scene { world, arm, .. } = &mut scene;
    world.join_blindly(visitor, *arm, "/chatter");
    world.run(ms(1000));
    let by = RefusedBy::Owner(RefuseReason::NotPermitted);
    assert_eq!(world.status(visitor, *arm, "/chatter"), Some(JoinStatus::Refused(by)));
    assert_eq!(world.granted(*arm, "/chatter"), [scene.desk]);
}

#[test]
fn a_partner_sees_no_catalogue() {
    let (mut scene, visitor) = scene(102, with_umbrella);
    let Scene { world, arm, .. } = &mut scene;
    let name = world.catalogue_name(*arm);
    world.join_name(visitor, *arm, name);
    world.run(ms(1000));
    let refused = events(world, visitor, 0).any(|(e, _)| {
        let owner = RefusedBy::Owner(RefuseReason::NotPermitted);
        matches!(e, Event::Refused { name: n, by } if *n == name && *by == owner)
    });
    assert!(refused, "even if it is told its name");
}

#[test]
fn a_partner_that_is_taken_out_or_revoked_by_its_own_ca_is_cut() {
    for revoked in [false, true] {
        let (mut scene, visitor) = scene(103, with_umbrella);
        let Scene { world, arm, east, desk, .. } = &mut scene;
        world.join_blindly(visitor, *arm, "/chatter");
        world.until_granted(visitor, *arm, "/chatter");
        if revoked {
            let list = revocation_list("umbrella", &[world.member(visitor).clone()], 1);
            world.hand_crl(*east, &list);
        } else {
            world.reshare(*arm, "/chatter", Sharing::to(&[*desk]));
        }
        let published = publish_steadily(world, *arm, ms(10), ms(2000), |_, _| ());
        world.run(ms(500));
        assert_eq!(world.granted(*arm, "/chatter"), [*desk]);
        assert_eq!(world.epoch(*arm, "/chatter"), Some(2));
        assert!(grants(world, visitor, *arm).iter().all(|(_, g)| g.epoch == 1));
        assert_received(world, *desk, *arm, &published);
    }
}

#[test]
fn a_partner_whose_ca_is_no_longer_trusted_loses_the_key_though_a_policy_still_names_it() {
    let (mut scene, visitor) = scene(104, with_umbrella);
    let Scene { world, arm, desk, .. } = &mut scene;
    world.join_blindly(visitor, *arm, "/chatter");
    world.until_granted(visitor, *arm, "/chatter");
    let published = publish_steadily(world, *arm, ms(10), ms(2000), |_, _| ());
    world.trust_own_fleet_only(*arm);
    world.run(ms(1500));
    assert_eq!(world.granted(*arm, "/chatter"), [*desk]);
    assert_eq!(world.epoch(*arm, "/chatter"), Some(2));
    assert!(grants(world, visitor, *arm).iter().all(|(_, g)| g.epoch == 1));
    world.run(ms(1000));
    assert_received(world, *desk, *arm, &published);
}

#[test]
fn new_lists_of_a_partners_ca_are_passed_on_at_its_allowance_and_the_newest_counts() {
    let (mut scene, visitor) = scene(110, |sharing| sharing);
    let Scene { world, east, west, desk, .. } = &mut scene;
    let ghosts = |fleet: &str| -> Vec<Member> {
        (0..200).map(|n| Member { fleet: fleet.into(), ..Member::new(&format!("ghost-{n}")) }).collect()
    };
    let (foreign, own) = (ghosts("umbrella"), ghosts("acme"));
    let lists = |fleet: &str, members: &[Member]| -> Vec<Bytes> {
        (1..=200).map(|n| revocation_list(fleet, &members[..n], n as u64)).collect()
    };
    let (foreign_lists, own_lists) = (lists("umbrella", &foreign), lists("acme", &own));
    for (foreign, own) in foreign_lists.iter().zip(&own_lists) {
        world.inject(visitor, *west, &Control::Crl { der: foreign.clone() });
        world.inject(*desk, *west, &Control::Crl { der: own.clone() });
        world.run(ms(2));
    }
    let (newest, newest_of_fleet) = (foreign_lists[199].clone(), own_lists[199].clone());
    let passed_on = |world: &World| {
        let frames = frames(world, *west, *east);
        let of = |lists: &[Bytes]| {
            let is_one = |frame: &&Control| matches!(frame, Control::Crl { der } if lists.contains(der));
            frames.iter().filter(is_one).count()
        };
        (of(&foreign_lists), of(&own_lists))
    };
    world.run(ms(100));
    let (of_partner, of_fleet) = passed_on(world);
    assert_eq!(of_partner, 64, "of 200 in half a second");
    assert_eq!(of_fleet, 200, "its own fleet's are never held back");
    assert_eq!(drops(world, *west, "crl_flood"), 136);
    assert!(!world.revocations(*west).contains(&newest));
    world.run(ms(3000));
    assert_eq!(passed_on(world).0, of_partner + 1, "of those that waited, the newest");
    for router in [*west, *east] {
        let known = world.revocations(router);
        assert!(known.contains(&newest) && known.contains(&newest_of_fleet));
    }
    // Once it has been quiet, the next list is taken at once.
    world.run(ms(2000));
    let serials = serial_list("umbrella", &foreign[..1], 202);
    world.inject(visitor, *west, &Control::Crl { der: serials.clone() });
    world.run(ms(200));
    assert!(world.revocations(*east).contains(&serials));
}
