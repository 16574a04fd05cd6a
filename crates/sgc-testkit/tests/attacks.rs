//! Attacks of untrusted nodes inside the network. Each achieves nothing and is counted.

use std::collections::BTreeSet;
use std::net::{IpAddr, SocketAddr};
use std::time::Duration;

use bytes::Bytes;
use sgc_endpoint::{Event, JoinStatus, RefusedBy};
use sgc_testkit::{CapturedFrame, DataDrop, Member, NatKind, NodeKey, Sharing, What, World, identity};
use sgc_trust::{Identity, Suite};
use sgc_wire::{
    AdvertBody, Answer, AnswerBody, CandidateKind, Class, Control, Decode, JoinBody, NodeId,
    PATH_CANDIDATES_MAX, PATH_OFFER_BYTES, Packet, PacketHeader, PathCandidate, PathOffer, RejectReason,
    Request, Role, SignedBody, SinkId, SourceId, SourceOffer,
};

const fn ms(n: u64) -> Duration {
    Duration::from_millis(n)
}

/// A robot, two routers and an operator in a line, and a malicious member of the fleet at the first router.
struct Scene {
    world: World,
    arm: NodeKey,
    east: NodeKey,
    west: NodeKey,
    desk: NodeKey,
    mallory: NodeKey,
}

fn scene(seed: u64) -> Scene {
    let mut world = World::new(seed);
    world.capture();
    let (arm, desk, mallory) = (world.proxy("arm-1"), world.proxy("desk"), world.proxy("mallory"));
    let (east, west) = (world.router("east"), world.router("west"));
    for (a, b) in [(arm, east), (east, west), (west, desk), (mallory, east)] {
        world.link(a, b);
    }
    world.share(arm, "/chatter", Sharing::to(&[desk]));
    world.use_topic(desk, arm, "/chatter");
    Scene { world, arm, east, west, desk, mallory }
}

fn assert_flows(scene: &mut Scene) {
    let Scene { world, arm, desk, .. } = scene;
    world.until_granted(*desk, *arm, "/chatter");
    world.run(ms(500));
    let id = world.publish(*arm, "/chatter");
    world.run(ms(1000));
    assert_eq!(world.received(*desk, *arm, "/chatter").last(), Some(&id), "{}", world.trace());
}

/// Returns the last frame from one node to another for which `is` holds.
fn last(world: &World, from: NodeKey, to: NodeKey, is: impl Fn(&Control) -> bool) -> Control {
    let of_link = |c: &&CapturedFrame| (c.from, c.to) == (from, to) && is(&c.frame);
    world.captured().iter().rev().find(of_link).expect("such a frame was sent").frame.clone()
}

fn is_advert_of(world: &World, owner: NodeKey, frame: &Control) -> bool {
    let Control::Advert { signed, .. } = frame else { return false };
    let body = AdvertBody::from_slice(&signed.body).expect("as its sender made it");
    body.chain == world.identity(owner).chain_bytes() && !body.withdraw
}

fn altered(signed: &SignedBody) -> SignedBody {
    let mut signature = signed.signature.to_vec();
    let at = signature.len() - 1;
    signature[at] ^= 1;
    SignedBody { body: signed.body.clone(), signature: signature.into() }
}

/// Returns the number of frames or packets that a node refused for that reason.
fn drops(world: &World, node: NodeKey, key: &str) -> usize {
    world.router_drops(node).iter().filter(|d| **d == key).count()
}

#[test]
fn a_proxy_cannot_advertise_anothers_names() {
    let mut scene = scene(1);
    assert_flows(&mut scene);
    let Scene { world, arm, east, mallory, .. } = &mut scene;
    let advert = last(world, *arm, *east, |f| is_advert_of(world, *arm, f));
    world.inject(*mallory, *east, &advert);
    world.run(ms(500));
    assert_eq!(drops(world, *east, "not_owner"), 1);
    assert_eq!(world.next_hop(*east, &world.name(*arm, "/chatter")), Some(*arm));
    // The same holds while the owner is away, and from farther than its own node.
    world.crash(*arm);
    world.run(ms(500));
    world.inject(*mallory, *east, &advert);
    let Control::Advert { signed, .. } = advert else { unreachable!("picked as one") };
    world.inject(*mallory, *east, &Control::Advert { cost: 3, signed });
    world.run(ms(500));
    assert_eq!(drops(world, *east, "not_owner"), 3);
    assert_eq!(world.distance(*east, &world.name(*arm, "/chatter")), None);
    world.start(*arm);
    assert_flows(&mut scene);
}

#[test]
fn an_altered_or_ancient_advertisement_is_not_believed() {
    let Scene { mut world, arm, east, west, .. } = scene(2);
    world.run(ms(1000));
    let advert = last(&world, arm, east, |f| is_advert_of(&world, arm, f));
    world.crash(arm);
    world.run(ms(1000));
    let Control::Advert { signed, .. } = &advert else { unreachable!("picked as one") };
    world.inject(west, east, &Control::Advert { cost: 1, signed: altered(signed) });
    world.run(ms(500));
    assert_eq!(drops(&world, east, "not_verified"), 1);
    // Its lease is over, but it would verify.
    world.run(ms(9 * 60 * 1000));
    world.inject(west, east, &advert);
    world.run(ms(500));
    assert_eq!((drops(&world, east, "not_verified"), drops(&world, east, "stale")), (1, 1));
    assert_eq!(world.distance(east, &world.name(arm, "/chatter")), None);
    world.run(ms(21 * 60 * 1000));
    world.inject(west, east, &advert);
    world.run(ms(500));
    assert_eq!(
        (drops(&world, east, "not_verified"), drops(&world, east, "clock")),
        (1, 1),
        "signed too long ago"
    );
    assert_eq!(world.distance(east, &world.name(arm, "/chatter")), None);
}

#[test]
fn a_router_that_keeps_leaves_back_and_plays_requests_again_locks_nobody_out() {
    let mut scene = scene(31);
    let max = sgc_endpoint::Limits::default().sinks_per_peer_max;
    let (arm, east, west, desk) = (scene.arm, scene.east, scene.west, scene.desk);
    scene.world.tamper(west, east, |frame| match frame {
        Control::Leave { .. } => vec![],
        frame => vec![frame.clone()],
    });
    for _ in 0..max + 4 {
        assert_flows(&mut scene);
        scene.world.restart(desk);
    }
    assert_flows(&mut scene);
    let places = scene.world.granted(arm, "/chatter").iter().filter(|n| **n == desk).count();
    assert_eq!(places, max);
    let world = &mut scene.world;
    let joins: Vec<_> = world
        .captured()
        .iter()
        .filter(|c| (c.from, c.to) == (west, east) && matches!(c.frame, Control::Join { .. }))
        .map(|c| c.frame.clone())
        .collect();
    for join in &joins {
        world.inject(west, east, join);
    }
    world.run(ms(500));
    assert_flows(&mut scene);
}

#[test]
fn a_withdrawn_advertisement_cannot_be_replayed() {
    let Scene { mut world, arm, east, west, .. } = scene(3);
    world.run(ms(1000));
    let advert = last(&world, arm, east, |f| is_advert_of(&world, arm, f));
    world.shut_down(arm);
    world.run(ms(1000));
    for _ in 0..3 {
        // Well within the time in which it would verify.
        world.inject(west, east, &advert);
        world.run(ms(120_000));
    }
    assert_eq!(drops(&world, east, "stale"), 3);
    assert_eq!(world.distance(east, &world.name(arm, "/chatter")), None);
}

/// Replaces the answers that `west` passes on to the operator by the results of `forge`, and checks that none is
/// granted.
fn check_forged_answers(seed: u64, forge: impl Fn(AnswerBody) -> SignedBody + 'static) {
    let mut scene = scene(seed);
    let Scene { world, arm, west, desk, .. } = &mut scene;
    let (arm, west, desk) = (*arm, *west, *desk);
    world.tamper(west, desk, move |frame| match frame {
        Control::Answer { signed } => {
            let body = AnswerBody::from_slice(&signed.body).expect("as its sender made it");
            vec![Control::Answer { signed: forge(body) }]
        }
        frame => vec![frame.clone()],
    });
    world.run(ms(5000));
    assert!(drops(world, desk, "owner_key") > 0);
    let believed = world.log().iter().any(|l| {
        l.node == desk
            && matches!(
                l.what,
                What::Event(Event::Granted { .. } | Event::Catalogue { .. } | Event::OwnerRefused { .. })
            )
    });
    assert!(!believed, "nothing is believed of it");
    let owner = world.identity(arm).node_id();
    assert!(world.catalogue(desk, arm).is_none(), "{owner:?}");
    world.be_honest(west, desk);
    assert_flows(&mut scene);
}

#[test]
fn an_answer_signed_by_a_router_is_not_believed() {
    let router = identity(&Member { router: true, ..Member::new("west") });
    check_forged_answers(4, move |body| router.sign_answer(&body));
}

#[test]
fn an_answer_of_another_owner_is_not_believed() {
    let other = identity(&Member::new("mallory"));
    check_forged_answers(5, move |body| other.sign_answer(&body));
}

#[test]
fn a_refusal_forged_by_a_router_is_not_believed() {
    let router = identity(&Member { router: true, ..Member::new("west") });
    check_forged_answers(6, move |body| {
        let reason = sgc_wire::RefuseReason::NotPermitted;
        router.sign_answer(&AnswerBody { answer: Answer::Refuse { reason }, ..body })
    });
}

#[test]
fn a_grant_for_another_request_does_not_open() {
    let mut scene = scene(7);
    assert_flows(&mut scene);
    let Scene { world, west, desk, arm, .. } = &mut scene;
    // A replay of the owner's answer to an earlier request.
    let old = last(world, *west, *desk, |f| matches!(f, Control::Answer { .. }));
    let granted =
        |w: &World| w.log().iter().filter(|l| matches!(l.what, What::Event(Event::Granted { .. }))).count();
    world.restart(*desk);
    world.tamper(*west, *desk, move |frame| match frame {
        Control::Answer { .. } => vec![old.clone()],
        frame => vec![frame.clone()],
    });
    let before = granted(world);
    world.run(ms(20_000));
    assert_eq!(granted(world), before);
    assert_ne!(world.status(*desk, *arm, "/chatter"), Some(JoinStatus::Granted));
    world.be_honest(*west, *desk);
    assert_flows(&mut scene);
}

#[test]
fn a_join_with_a_forged_signature_is_refused_by_the_first_router() {
    let mut scene = scene(8);
    let Scene { world, arm, west, desk, .. } = &mut scene;
    world.tamper(*desk, *west, |frame| match frame {
        Control::Join { signed } => vec![Control::Join { signed: altered(signed) }],
        frame => vec![frame.clone()],
    });
    let by = RefusedBy::Router(RejectReason::NotVerified);
    world.until_event(*desk, "refusal", |e| matches!(e, Event::OwnerRefused { by: b, .. } if *b == by));
    assert!(drops(world, *west, "not_verified") > 0);
    assert_eq!(world.granted(*arm, "/chatter"), []);
    world.be_honest(*desk, *west);
    assert_flows(&mut scene);
}

fn join(identity: &Identity, world: &World, owner: NodeKey, sink: SinkId, role: Role) -> Control {
    let body = JoinBody {
        name: world.name(owner, "/chatter"),
        sink,
        request: match role {
            Role::Subscribe => Request::Subscribe { describe: false },
            Role::Publish => {
                Request::Publish { offer: SourceOffer { source: SourceId([9; 16]), key: Bytes::new() } }
            }
        },
        issued_at: world.now().unix,
        chain: identity.chain_bytes(),
        reply_key: sgc_trust::ReplyKey::generate(sgc_trust::Kem::default()).public().clone(),
    };
    Control::Join { signed: identity.sign_join(&body) }
}

#[test]
fn a_node_of_another_fleet_is_refused_by_routers_and_owner() {
    let mut scene = scene(9);
    assert_flows(&mut scene);
    let Scene { world, arm, east, mallory, desk, .. } = &mut scene;
    let stranger = identity(&Member { fleet: "umbrella".to_owned(), ..Member::new("desk") });
    let forged = join(&stranger, world, *arm, SinkId([7; 16]), Role::Subscribe);
    world.inject(*mallory, *east, &forged);
    world.run(ms(500));
    assert_eq!(drops(world, *east, "not_verified"), 1);
    let answered = last(world, *east, *mallory, |f| matches!(f, Control::Reject { .. }));
    assert!(matches!(answered, Control::Reject { reason: RejectReason::NotVerified, .. }), "{answered:?}");
    // Even with a router that lets it pass, the owner's own node does not.
    world.inject(*east, *arm, &forged);
    world.run(ms(500));
    assert_eq!(drops(world, *arm, "not_verified"), 1);
    assert_eq!(world.granted(*arm, "/chatter"), [*desk]);
}

#[test]
fn request_to_publish_is_refused_where_it_is_not_offered() {
    let mut scene = scene(10);
    assert_flows(&mut scene);
    let Scene { world, arm, west, desk, .. } = &mut scene;
    let asked = join(world.identity(*desk), world, *arm, SinkId([8; 16]), Role::Publish);
    world.inject(*desk, *west, &asked);
    world.run(ms(500));
    let refused = world.log().iter().any(|l| {
        let reason = sgc_wire::RefuseReason::RoleNotOffered;
        l.node == *arm && matches!(&l.what, What::Event(Event::SinkRefused { reason: r, .. }) if *r == reason)
    });
    assert!(refused);
    assert_flows(&mut scene);
}

#[test]
fn a_captured_join_does_not_move_or_take_a_sinks_place() {
    let mut scene = scene(11);
    assert_flows(&mut scene);
    let Scene { world, arm, east, west, desk, mallory } = &mut scene;
    let name = world.name(*arm, "/chatter");
    let captured = last(world, *west, *east, |f| match f {
        Control::Join { signed } => JoinBody::from_slice(&signed.body).unwrap().name == name,
        _ => false,
    });
    let Control::Join { signed } = &captured else { unreachable!("picked as one") };
    let sink = JoinBody::from_slice(&signed.body).unwrap().sink;
    world.inject(*mallory, *east, &captured);
    // A join of its own under the same sink id does not help either.
    let own = join(world.identity(*mallory), world, *arm, sink, Role::Subscribe);
    world.inject(*mallory, *east, &own);
    world.inject(*mallory, *east, &Control::Leave { name, sink });
    world.run(ms(500));
    assert_eq!(world.granted(*arm, "/chatter"), [*desk]);
    assert_eq!(world.forwarding_sinks(*east, &name), [sink]);
    let before = world.received(*desk, *arm, "/chatter").len();
    world.publish(*arm, "/chatter");
    world.run(ms(500));
    assert_eq!(world.received(*desk, *arm, "/chatter").len(), before + 1, "the flow was not disturbed");
    assert!(world.all_received().iter().all(|r| r.node == *desk));
}

fn packet(world: &World, owner: NodeKey, source: SourceId, to: Option<SinkId>) -> Packet {
    let header = PacketHeader {
        reliable: true,
        class: Class::Default,
        hops: 30,
        suite: Suite::DEFAULT.id(),
        epoch: 1,
        name: world.name(owner, "/chatter"),
        source,
        seq: 1,
        total: 8,
        index: 0,
        grid: 16 * 1024,
        to,
    };
    Packet::new(header, Bytes::from(vec![0; 8 + 12 + 16 + 4 + 64]).into()).expect("far below the bound")
}

#[test]
fn data_is_accepted_from_the_owners_side_only() {
    let mut scene = scene(12);
    assert_flows(&mut scene);
    let Scene { world, arm, east, west, desk, mallory } = &mut scene;
    let (count, sink) = (world.all_received().len(), world.granted_sinks(*arm, "/chatter")[0].0);
    for to in [None, Some(sink)] {
        let forged = packet(world, *arm, SourceId([9; 16]), to);
        world.inject_packet(*desk, *west, forged.clone());
        world.inject_packet(*mallory, *east, forged.clone());
        // Upstream, against the tree.
        world.inject_packet(*west, *east, forged);
    }
    world.run(ms(500));
    assert_eq!(world.data_drops(*west), [DataDrop::WrongWay; 2]);
    assert_eq!(world.data_drops(*east), [DataDrop::WrongWay; 4]);
    assert_eq!(world.all_received().len(), count);
    assert_flows(&mut scene);
}

#[test]
fn data_that_a_router_forges_reaches_the_sink_and_no_further() {
    let mut scene = scene(13);
    assert_flows(&mut scene);
    let Scene { world, arm, west, desk, .. } = &mut scene;
    let count = world.all_received().len();
    let source = world.all_published()[0].source;
    let mut forged = packet(world, *arm, source, None);
    forged.header.seq = 100;
    world.inject_packet(*west, *desk, forged);
    world.run(ms(500));
    let why = sgc_endpoint::SinkDrop::Open(sgc_trust::OpenError::Forged);
    assert_eq!(world.data_drops(*desk), [DataDrop::Sink(why)]);
    let mut unknown = packet(world, *arm, SourceId([9; 16]), None);
    world.inject_packet(*west, *desk, unknown.clone());
    world.run(ms(500));
    assert_eq!(world.data_drops(*desk), [why; 2].map(DataDrop::Sink));
    // Packets of an unknown epoch wait for its grant, within a small bound.
    unknown.header.epoch = 2;
    for _ in 0..sgc_endpoint::PARKED_PACKETS_MAX {
        world.inject_packet(*west, *desk, unknown.clone());
    }
    world.run(ms(500));
    assert_eq!(world.data_drops(*desk).len(), 2);
    world.inject_packet(*west, *desk, unknown);
    world.run(ms(500));
    assert_eq!(world.data_drops(*desk)[2..], [DataDrop::Sink(sgc_endpoint::SinkDrop::ParkingFull)]);
    assert_eq!(world.all_received().len(), count);
}

#[test]
fn data_under_a_name_that_nobody_asked_for_goes_nowhere() {
    let mut scene = scene(14);
    assert_flows(&mut scene);
    let Scene { world, arm, east, mallory, .. } = &mut scene;
    let mut unknown = packet(world, *arm, SourceId([9; 16]), None);
    unknown.header.name = sgc_wire::Name([3; 32]);
    world.inject_packet(*mallory, *east, unknown);
    world.run(ms(500));
    assert_eq!(world.data_drops(*east), [DataDrop::NoTree]);
}

#[test]
fn a_neighbour_that_cuts_what_is_not_its_own_is_ignored() {
    let mut scene = scene(15);
    assert_flows(&mut scene);
    let Scene { world, arm, east, west, desk, mallory } = &mut scene;
    let (name, sink) = (world.name(*arm, "/chatter"), world.granted_sinks(*arm, "/chatter")[0].0);
    let reason = RejectReason::RouteLost;
    for frame in [
        Control::Unreach { names: vec![name] },
        Control::Reject { name, sink, reason },
        Control::Leave { name, sink },
        Control::Recover(sgc_wire::Recover { name, sink, source: SourceId([1; 16]), from: 0, to: u64::MAX }),
        last(world, *arm, *east, |f| matches!(f, Control::Answer { .. })),
    ] {
        world.inject(*mallory, *east, &frame);
    }
    world.run(ms(1000));
    let mut refused = world.router_drops(*east);
    refused.sort_unstable();
    assert_eq!(refused, ["unknown", "unknown", "unknown", "wrong_way", "wrong_way"]);
    assert_eq!(world.status(*desk, *arm, "/chatter"), Some(JoinStatus::Granted));
    assert_eq!(world.next_hop(*west, &name), Some(*east));
    assert_flows(&mut scene);
}

#[test]
fn frames_before_the_greeting_and_a_second_greeting_close_the_link() {
    let Scene { mut world, east, mallory, .. } = scene(16);
    world.run(ms(1000));
    let hello = last(&world, mallory, east, |f| matches!(f, Control::Hello(_)));
    world.inject(mallory, east, &hello);
    world.run(ms(500));
    let closed = |l: &&sgc_testkit::LogEntry| {
        l.node == east && matches!(l.what, What::Closed { reason: sgc_router::LinkClose::Greeting })
    };
    assert_eq!(world.log().iter().filter(closed).count(), 1);
    assert_eq!(world.distance(east, &world.catalogue_name(mallory)), None, "all that it said is forgotten");
    world.tamper(mallory, east, |frame| match frame {
        Control::Hello(_) => vec![Control::Goodbye],
        frame => vec![frame.clone()],
    });
    world.rejoin(mallory, east);
    world.run(ms(500));
    assert_eq!(world.log().iter().filter(closed).count(), 2);
}

#[test]
fn nobody_passes_as_a_node_by_its_name_alone() {
    // The same node name in another fleet is another owner with other names.
    let stranger = identity(&Member { fleet: "umbrella".to_owned(), ..Member::new("arm-1") });
    let arm = identity(&Member::new("arm-1"));
    let ids: [NodeId; 2] = [stranger.node_id(), arm.node_id()];
    assert_ne!(ids[0], ids[1]);
    assert_ne!(stranger.pseudonym(), arm.pseudonym());
}

/// Addresses that no host of a world has.
fn victim(n: u16) -> SocketAddr {
    SocketAddr::from(([198, 18, (n >> 8) as u8, n as u8], 5353))
}

fn candidate(address: SocketAddr) -> PathCandidate {
    PathCandidate { kind: CandidateKind::Host, place: address.into() }
}

/// Two honest members that exchange data, and a lying one, each behind a NAT of its own.
struct Liar {
    world: World,
    honest: [NodeKey; 2],
    mallory: NodeKey,
}

fn liar(seed: u64) -> Liar {
    let mut world = World::new(seed);
    world.record_checks();
    let hub = world.router("hub");
    let [arm, desk, mallory] = ["arm-1", "desk", "mallory"].map(|name| {
        let node = world.proxy(name);
        world.link(hub, node);
        let nat = world.nat(NatKind::PORT_RESTRICTED, None);
        world.place(node, Some(nat));
        node
    });
    world.share(arm, "/chatter", Sharing::to(&[desk]));
    world.use_topic(desk, arm, "/chatter");
    world.until_granted(desk, arm, "/chatter");
    world.run(ms(3000));
    assert!(world.is_direct(arm, desk));
    Liar { world, honest: [arm, desk], mallory }
}

impl Liar {
    /// Has the liar look for paths to the honest members for a while, anew after each failure.
    fn lie_for(&mut self, seconds: u64, lie: impl FnMut(PathOffer) -> PathOffer + Clone + 'static) {
        for _ in 0..seconds / 15 {
            self.world.restart(self.mallory);
            self.world.tamper_offers(self.mallory, lie.clone());
            self.world.want_paths(self.mallory, &self.honest);
            self.world.run(ms(15_000));
        }
    }

    /// Returns the bytes of checks that an honest node sent to victims.
    fn bytes_to_victims(&self, node: NodeKey) -> usize {
        let checks = self.world.recorded_checks().iter();
        checks.filter(|c| c.from == node && is_victim(c.to)).map(|c| c.datagram.len()).sum()
    }

    /// Returns the bytes of offers and checks of the liar that reached an honest node.
    fn bytes_of_liar(&self, node: NodeKey) -> usize {
        let liar = self.world.identity(self.mallory).node_id();
        let offered = |l: &&sgc_testkit::LogEntry| {
            l.node == node && matches!(l.what, What::Event(Event::PathOffered { peer, .. }) if peer == liar)
        };
        let checks = self.world.recorded_checks().iter();
        let from_liar =
            checks.filter(|c| c.from == self.mallory && c.reached.is_some_and(|(there, _)| there == node));
        self.world.log().iter().filter(offered).count() * PATH_OFFER_BYTES
            + from_liar.map(|c| c.datagram.len()).sum::<usize>()
    }

    /// Checks that the honest members still exchange data directly.
    fn assert_unharmed(&mut self) {
        let [arm, desk] = self.honest;
        assert!(self.world.is_direct(arm, desk), "{}", self.world.trace());
        let id = self.world.publish(arm, "/chatter");
        self.world.run(ms(1000));
        assert_eq!(self.world.received(desk, arm, "/chatter").last(), Some(&id));
    }
}

fn is_victim(address: SocketAddr) -> bool {
    matches!(address.ip(), IpAddr::V4(ip) if ip.octets()[..2] == [198, 18])
}

#[test]
fn addresses_of_a_victim_in_offers_cause_no_more_bytes_than_the_offers_have() {
    let mut scene = liar(30);
    scene.lie_for(300, |offer| PathOffer {
        candidates: (0..PATH_CANDIDATES_MAX as u16).map(|n| candidate(victim(n))).collect(),
        ..offer
    });
    for node in scene.honest {
        let (sent, caused) = (scene.bytes_to_victims(node), scene.bytes_of_liar(node));
        assert!(sent > 0 && sent <= caused, "{sent} bytes for {caused}");
        assert!(scene.world.direct_refusals(node).0 > 0, "checks are withheld");
    }
    scene.assert_unharmed();
}

#[test]
fn checks_from_forged_addresses_cause_no_more_bytes_than_they_have() {
    let mut scene = liar(31);
    let mut next = 0_u16;
    // Each check comes ten times, from ten addresses that are not the liar's.
    scene.world.tamper_checks(scene.mallory, move |check| {
        let copy = |n: u16| (Some(victim(next + n)), check.to, check.datagram.clone());
        let copies = (0..10).map(copy).collect();
        next = (next + 10) % 50_000;
        copies
    });
    // Behind the hosts' NATs, where the forger's packets pass.
    for node in scene.honest {
        scene.world.place(node, None);
    }
    scene.lie_for(300, |offer| PathOffer { candidates: Vec::new(), ..offer });
    for node in scene.honest {
        let (sent, caused) = (scene.bytes_to_victims(node), scene.bytes_of_liar(node));
        assert!(sent > 0 && sent <= caused, "{sent} bytes for {caused}");
        let checks = scene.world.recorded_checks().iter().filter(|c| c.from == node && is_victim(c.to));
        let victims: BTreeSet<_> = checks.map(|c| c.to).collect();
        assert!(victims.len() > 1);
    }
    scene.assert_unharmed();
}

#[test]
fn addresses_of_this_host_and_its_segment_get_no_check() {
    let mut scene = liar(32);
    let bad = ["127.0.0.1:22", "169.254.169.254:80", "224.0.0.251:5353", "255.255.255.255:9", "10.0.0.7:0"];
    let bad = bad.map(|text| text.parse::<SocketAddr>().expect("an address"));
    scene.lie_for(60, move |offer| PathOffer { candidates: bad.map(candidate).to_vec(), ..offer });
    assert!(!scene.world.recorded_checks().iter().any(|check| bad.contains(&check.to)));
    for node in scene.honest {
        assert!(scene.world.direct_refusals(node).1 >= bad.len() as u64);
    }
    scene.assert_unharmed();
}

#[test]
fn answers_of_other_attempts_cause_few_questions() {
    let mut scene = liar(33);
    let liar = scene.world.identity(scene.mallory).node_id();
    let mut number = 0;
    scene.lie_for(300, move |offer| {
        number += 1;
        PathOffer { attempt: number, ..offer }
    });
    for node in scene.honest {
        let offers = scene.world.log().iter().filter(
            |l| matches!(l.what, What::Event(Event::PathOffered { peer, .. }) if l.node == node && peer == liar),
        );
        // Two in each attempt of the liar, which may begin four in ten seconds.
        let offers = offers.count();
        assert!((1..=2 * 4 * 30).contains(&offers), "{offers} offers in 300 s");
    }
    scene.assert_unharmed();
}

#[test]
fn checks_that_are_sent_again_after_the_attempt_get_no_answer() {
    let mut scene = liar(34);
    let recorded = scene.world.recorded_checks().to_vec();
    assert!(recorded.iter().any(|check| check.reached.is_some()));
    for check in &recorded {
        let from = [None, Some(victim(1)), check.reached.map(|(_, from)| from)];
        for from in from {
            scene.world.inject_check(scene.mallory, from, check.to, check.datagram.clone());
        }
    }
    let before = scene.world.recorded_checks().len();
    scene.world.run(ms(10_000));
    assert_eq!(scene.world.recorded_checks()[before..], [], "no node answers");
    scene.assert_unharmed();
}

#[test]
fn another_node_at_the_admitted_address_gets_no_link() {
    let mut scene = liar(35);
    let mut tried = 0;
    for node in scene.honest {
        for (from, peer) in scene.world.admitted(node) {
            assert!(scene.honest.contains(&peer));
            assert!(!scene.world.dial_forged(scene.mallory, from, node));
            tried += 1;
        }
        // The peer itself gets one there, which is no crime.
        assert!(!scene.world.has_direct(scene.mallory, node));
    }
    assert!(tried > 0);
    scene.assert_unharmed();
}
