//! Members, and routers that help them, act as other nodes.

use std::sync::Arc;

use bytes::Bytes;
use sgc_endpoint::{JoinStatus, PARKED_PACKETS_MAX, Receivers, RecoveryLimits, Source, SourceConfig};
use sgc_testkit::{DataDrop, Member, NodeKey, World, WorldConfig, identity};
use sgc_trust::{MessageKey, Suite};
use sgc_wire::{
    AdvertBody, Class, Control, Decode, Hello, MessageHead, MessageKind, NodeId, Packet, SinkId, SourceId,
    TopicGrant,
};

use crate::{
    Scene, assert_received, closed, drops, flowing, flowing_with, frames, grants, ms, publish_steadily,
    scene_with, sink_drops,
};

/// Returns packets that a member seals under its grant, as `source`, from message `from` on. It signs with a key of its
/// own, or makes MACs under its receiver key, if it has one.
fn forged(world: &World, owner: NodeKey, grant: &TopicGrant, source: SourceId, from: u64) -> Vec<Packet> {
    let receivers = grant.receiver.clone().map(|own| {
        let all = Arc::<Receivers>::default();
        all.add(SinkId([1; 16]), NodeId([1; 32]), || own);
        all
    });
    let config = SourceConfig {
        name: world.name(owner, "/chatter"),
        id: source,
        class: Class::Default,
        reliable: true,
        history_depth: 0,
        history_bytes_max: 0,
        recovery: RecoveryLimits::default(),
        receivers,
    };
    let suite = Suite::from_id(grant.suite).expect("a suite of this build");
    let mut source = Source::new(config, grant, MessageKey::generate(suite)).expect("a key that fits");
    let head = MessageHead::new(MessageKind::Write, 0);
    let mut packets = Vec::new();
    for _ in 0..from + 10 {
        let command = Bytes::from_static(&[0xff; 8]);
        source.publish(&head, command, false, |p| packets.push(p)).expect("small");
    }
    packets.split_off(from as usize)
}

/// Delivers packets that a member forged with the topic's key, with a router's help. Returns the refusals at each other
/// member.
fn play_forged(scene: &mut Scene, source: SourceId) -> Vec<Vec<(&'static str, usize)>> {
    let Scene { world, arm, west, desk, lap, tab, .. } = scene;
    publish_steadily(world, *arm, ms(10), ms(50), |_, _| ());
    world.run(ms(500));
    let (_, grant) = grants(world, *desk, *arm).pop().expect("granted");
    let forged = forged(world, *arm, &grant, source, 100);
    // Over its own link nothing gets past the first router.
    let before = world.all_received().len();
    for packet in &forged {
        world.inject_packet(*desk, *west, packet.clone());
    }
    world.run(ms(500));
    assert_eq!(world.data_drops(*west), [DataDrop::WrongWay; 10]);
    for victim in [*lap, *tab] {
        for packet in &forged {
            world.inject_packet(*west, victim, packet.clone());
        }
    }
    world.run(ms(500));
    assert_eq!(world.all_received().len(), before, "no forged message is delivered");
    [*lap, *tab].iter().map(|v| sink_drops(world, *v).into_iter().collect()).collect()
}

fn source_of(scene: &mut Scene) -> SourceId {
    scene.world.publish(scene.arm, "/chatter");
    scene.world.run(ms(500));
    scene.world.all_published()[0].source
}

fn assert_goes_on(scene: &mut Scene) {
    let Scene { world, arm, .. } = scene;
    let published = publish_steadily(world, *arm, ms(10), ms(200), |_, _| ());
    world.run(ms(500));
    for user in scene.users() {
        assert_received(&scene.world, user, scene.arm, &published);
    }
}

#[test]
fn a_member_that_forges_anothers_message_is_detected_by_every_other_member() {
    for (suite, reason) in [
        (Suite::Standard, "sink_signature"),
        (Suite::StandardChacha, "sink_signature"),
        (Suite::Paper, "sink_signature"),
        (Suite::Pairwise, "sink_no_mac"),
        (Suite::PairwiseChacha, "sink_no_mac"),
    ] {
        let mut scene =
            flowing_with(WorldConfig::new(60), |s| sgc_testkit::Sharing { suite: Some(suite), ..s });
        let source = source_of(&mut scene);
        let found = play_forged(&mut scene, source);
        assert_eq!(found, vec![vec![(reason, 10)]; 2], "{suite}");
        assert_goes_on(&mut scene);
    }
}

#[test]
fn a_member_that_publishes_as_a_source_of_its_own_is_not_believed() {
    for suite in [Suite::Standard, Suite::Group] {
        let mut scene =
            flowing_with(WorldConfig::new(61), |s| sgc_testkit::Sharing { suite: Some(suite), ..s });
        source_of(&mut scene);
        let found = play_forged(&mut scene, SourceId([0xbb; 16]));
        assert_eq!(found, vec![vec![]; 2], "they wait for a grant that announces their source");
        for _ in 0..4 {
            scene.world.rotate(scene.arm, "/chatter");
            scene.world.run(ms(1500));
        }
        for victim in [scene.lap, scene.tab] {
            let found = sink_drops(&scene.world, victim);
            assert_eq!(found.into_iter().collect::<Vec<_>>(), [("sink_unknown_source", 10)]);
        }
        assert_goes_on(&mut scene);
    }
}

#[test]
fn packets_waiting_for_announcement_are_bounded_and_harmless() {
    let mut scene = flowing(62);
    source_of(&mut scene);
    let Scene { world, arm, west, desk, lap, .. } = &mut scene;
    let (_, grant) = grants(world, *desk, *arm).pop().expect("granted");
    for n in 0..40 {
        for packet in forged(world, *arm, &grant, SourceId([n; 16]), 0) {
            world.inject_packet(*west, *lap, packet);
        }
    }
    world.run(ms(500));
    let found = sink_drops(world, *lap);
    assert_eq!(found.into_iter().collect::<Vec<_>>(), [("sink_parking_full", 400 - PARKED_PACKETS_MAX)]);
    assert_goes_on(&mut scene);
}

#[test]
fn nobody_claims_the_names_of_another_owner() {
    let mut scene = flowing(63);
    let Scene { world, arm, east, west, desk, .. } = &mut scene;
    let name = world.name(*arm, "/chatter");
    // With the owner's own blinds, which any member can derive, under its own certificate.
    let thief = world.identity(*desk);
    let body = AdvertBody {
        chain: thief.chain_bytes(),
        seq: world.now().unix.0 + 1_000_000,
        issued_at: world.now().unix,
        lease_ms: 600_000,
        withdraw: false,
        blinds: vec![world.blind(*arm, "/chatter")],
    };
    let advert = Control::Advert { cost: 0, signed: thief.sign_advert(&body) };
    let withdrawal = AdvertBody { withdraw: true, seq: body.seq + 1, ..body.clone() };
    let withdrawal = Control::Advert { cost: 0, signed: thief.sign_advert(&withdrawal) };
    // With the owner's certificate, which is public, and another key.
    let borrowed = AdvertBody { chain: world.identity(*arm).chain_bytes(), ..body };
    let borrowed = Control::Advert { cost: 0, signed: thief.sign_advert(&borrowed) };
    for frame in [advert, withdrawal, borrowed] {
        world.inject(*desk, *west, &frame);
        world.inject(*west, *east, &frame);
    }
    world.run(ms(500));
    assert_eq!(drops(world, *west, "not_verified"), 1, "the borrowed certificate");
    assert_eq!(world.next_hop(*west, &name), Some(*east));
    assert_eq!(world.next_hop(*east, &name), Some(*arm));
    assert_goes_on(&mut scene);
}

#[test]
fn a_grant_for_another_or_for_an_altered_one_is_not_taken() {
    let mut scene = flowing(64);
    let Scene { world, arm, west, desk, lap, .. } = &mut scene;
    let name = world.name(*arm, "/chatter");
    let to_lap = frames(world, *west, *lap).into_iter().rev().find(|f| match f {
        Control::Answer { signed } => {
            sgc_wire::AnswerBody::from_slice(&signed.body).is_ok_and(|body| body.name == name)
        }
        _ => false,
    });
    let to_lap = to_lap.expect("it was granted");
    let before = grants(world, *desk, *arm).len();
    world.inject(*west, *desk, &to_lap);
    // Every byte of it altered, sealed content and signature alike.
    let Control::Answer { signed } = &to_lap else { unreachable!("picked as one") };
    let altered = sgc_wire::AnswerBody::from_slice(&signed.body).expect("as it was made").sink;
    for at in (0..signed.body.len()).step_by(7) {
        let mut body = signed.body.to_vec();
        body[at] ^= 0x20;
        let signed = sgc_wire::SignedBody { body: body.into(), signature: signed.signature.clone() };
        world.inject(*west, *lap, &Control::Answer { signed });
    }
    let granted_to_lap = grants(world, *lap, *arm).len();
    world.run(ms(500));
    assert_eq!(grants(world, *desk, *arm).len(), before);
    assert!(drops(world, *lap, "owner_key") > 0);
    // A sink that gets such a packet asks again, and the owner grants it. The altered packets have no effect.
    let sinks = world.granted_sinks(*arm, "/chatter");
    let again = &grants(world, *lap, *arm)[granted_to_lap..];
    assert!(again.iter().all(|(sink, _)| *sink != altered && sinks.contains(&(*sink, *lap))), "{again:?}");
    for user in [*desk, *lap] {
        assert_eq!(
            world.status(user, *arm, "/chatter"),
            Some(JoinStatus::Granted),
            "nor anything lost by it"
        );
    }
}

#[test]
fn an_acknowledgement_that_a_router_forges_harms_only_those_behind_it() {
    let mut scene = flowing(65);
    let others = scene.without(scene.tab);
    let Scene { world, arm, east, west, lap, tab, .. } = &mut scene;
    let name = world.name(*arm, "/chatter");
    let sinks = world.granted_sinks(*arm, "/chatter");
    let sink = sinks.iter().find(|(_, n)| n == tab).expect("granted").0;
    // The router in front of it keeps the new key from it and says that it has it.
    world.tamper(*west, *tab, |frame| match frame {
        Control::Answer { .. } => vec![],
        frame => vec![frame.clone()],
    });
    let begin = world.elapsed();
    world.rotate(*arm, "/chatter");
    let ack = Control::Ack { name, sink, serial: 2 };
    world.inject(*west, *east, &ack);
    let published = publish_steadily(world, *arm, ms(10), ms(2000), |_, _| ());
    world.run(ms(500));
    let rekeyed = crate::events(world, *arm, 0)
        .find_map(|(e, at)| matches!(e, sgc_endpoint::Event::Rekeyed { .. }).then_some(at));
    assert!(rekeyed.expect("it begins") - begin < ms(400), "the forged one was taken");
    for user in others {
        assert_received(world, user, *arm, &published);
    }
    // From anywhere else it is not: another member, and a neighbour that is not on the way.
    let refused = drops(world, *west, "unknown");
    world.inject(*lap, *west, &ack);
    world.inject(*arm, *east, &ack);
    world.run(ms(500));
    assert_eq!(drops(world, *west, "unknown"), refused + 1);
    assert!(drops(world, *east, "unknown") >= 1);
}

#[test]
fn uncertified_router_counts_as_proxy() {
    let mut scene = scene_with(WorldConfig::new(66));
    let Scene { world, arm, east, desk, .. } = &mut scene;
    let liar = world.proxy("liar");
    let honest = world.node(Member::new("both"), true);
    world.share(*arm, "/chatter", sgc_testkit::Sharing::to(&[*desk]));
    world.run(ms(1000));
    world.link(*east, liar);
    world.cut(*east, liar);
    let claim = |frame: &Control| match frame {
        Control::Hello(hello) => vec![Control::Hello(Hello { transit: true, ..*hello })],
        frame => vec![frame.clone()],
    };
    world.tamper(liar, *east, claim);
    world.rejoin(*east, liar);
    world.link(*east, honest);
    world.run(ms(1000));
    assert_eq!(drops(world, *east, "not_router"), 1);
    let own = world.identity(liar).chain_bytes();
    let told = |to| {
        let of_others = |f: &Control| match f {
            Control::Advert { signed, .. } => {
                AdvertBody::from_slice(&signed.body).expect("as sent").chain != own
            }
            _ => false,
        };
        frames(world, *east, to).iter().filter(|f| of_others(f)).count()
    };
    assert_eq!(told(liar), 0, "it is told of nobody");
    assert!(told(honest) > 0, "one that is certified is");
    // Nor is it believed that it leads to others.
    let advert = frames(world, *arm, *east).into_iter().rfind(|f| matches!(f, Control::Advert { .. }));
    let Some(Control::Advert { signed, .. }) = advert else { panic!("it advertised") };
    world.inject(liar, *east, &Control::Advert { cost: 0, signed: signed.clone() });
    world.inject(honest, *east, &Control::Advert { cost: 7, signed });
    world.run(ms(500));
    assert_eq!(drops(world, *east, "not_owner"), 1);
    assert_eq!(world.next_hop(*east, &world.name(*arm, "/chatter")), Some(*arm));
}

#[test]
fn a_stranger_that_is_linked_all_the_same_is_cut_off() {
    // The handshake refuses it; should its CA go between handshake and here, the router does.
    let mut scene = scene_with(WorldConfig::new(67));
    let stranger = scene.world.node(Member { fleet: "umbrella".to_owned(), ..Member::new("desk") }, false);
    assert_ne!(identity(scene.world.member(stranger)).node_id(), scene.world.identity(scene.desk).node_id());
    scene.world.link(scene.east, stranger);
    scene.world.run(ms(500));
    assert_eq!(closed(&scene.world, scene.east), [sgc_router::LinkClose::Revoked]);
}
