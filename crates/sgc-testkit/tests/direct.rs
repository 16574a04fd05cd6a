//! Direct paths of whole nodes through simulated NATs.

use std::time::Duration;

use sgc_testkit::{MessageId, NatKind, NodeKey, PacketCopies, Sharing, World, WorldConfig};
use sgc_wire::Control;

const fn ms(n: u64) -> Duration {
    Duration::from_millis(n)
}

/// A talker and a listener behind NATs of their own, and a router in the internet.
struct Pair {
    world: World,
    talker: NodeKey,
    listener: NodeKey,
    hub: NodeKey,
    sent: Vec<MessageId>,
}

fn pair(seed: u64, nats: [Option<NatKind>; 2]) -> Pair {
    let mut world = World::with(WorldConfig { latency: ms(5)..=ms(20), ..WorldConfig::new(seed) });
    let hub = world.router("hub");
    let [talker, listener] = ["talker", "listener"].map(|name| world.proxy(name));
    for (node, kind) in [talker, listener].into_iter().zip(nats) {
        world.link_over(hub, node, ms(20));
        let nat = kind.map(|kind| world.nat(kind, None));
        world.place(node, nat);
    }
    world.share(talker, "/chatter", Sharing::to_fleet());
    world.use_topic(listener, talker, "/chatter");
    world.until_granted(listener, talker, "/chatter");
    Pair { world, talker, listener, hub, sent: Vec::new() }
}

impl Pair {
    fn is_direct(&self) -> bool {
        self.world.is_direct(self.talker, self.listener)
    }

    /// Publishes every 100 ms for a while.
    fn publish_for(&mut self, time: Duration) {
        let end = self.world.elapsed() + time;
        while self.world.elapsed() < end {
            self.sent.push(self.world.publish(self.talker, "/chatter"));
            self.world.run(ms(100));
        }
    }

    fn until_direct(&mut self, bound: Duration) {
        let (talker, listener) = (self.talker, self.listener);
        let found = self.world.run_until(bound, |world| world.is_direct(talker, listener));
        assert!(found, "no direct link after {bound:?}\n{}", self.world.trace());
    }

    /// Returns the node from which the listener gets the data.
    fn hop(&self) -> Option<NodeKey> {
        self.world.next_hop(self.listener, &self.world.name(self.talker, "/chatter"))
    }

    /// Checks that all messages arrived, once and in order.
    fn assert_whole(&mut self) {
        self.world.run(ms(3000));
        let received = self.world.received(self.listener, self.talker, "/chatter");
        assert_eq!(received, self.sent, "{}", self.world.trace());
    }
}

const KINDS: [Option<NatKind>; 7] = [
    None,
    Some(NatKind::FULL_CONE),
    Some(NatKind::ADDRESS_RESTRICTED),
    Some(NatKind::PORT_RESTRICTED),
    Some(NatKind::SYMMETRIC),
    Some(NatKind::FIREWALL),
    Some(NatKind::UDP_BLOCKED),
];

#[test]
fn pairs_meet_as_theory_says_within_a_second_and_lose_nothing() {
    for (seed, (a, b)) in KINDS.iter().flat_map(|a| KINDS.iter().map(move |b| (*a, *b))).enumerate() {
        let mut pair = pair(seed as u64, [a, b]);
        let theory = pair.world.lets_meet(pair.talker, pair.listener, false);
        pair.publish_for(ms(2000));
        assert_eq!(pair.is_direct(), theory, "{a:?} and {b:?}\n{}", pair.world.trace());
        pair.publish_for(ms(8000));
        let hop = if theory { pair.talker } else { pair.hub };
        assert_eq!(pair.hop(), Some(hop), "{a:?} and {b:?}");
        pair.assert_whole();
    }
}

#[test]
fn pair_behind_one_nat_meets_inside_and_stays_together_without_the_router() {
    let mut pair = pair(1, [None, None]);
    let (talker, listener, hub) = (pair.talker, pair.listener, pair.hub);
    let nat = pair.world.nat(NatKind::SYMMETRIC, None);
    for node in [talker, listener] {
        pair.world.place(node, Some(nat));
    }
    pair.until_direct(Duration::from_secs(30));
    pair.publish_for(ms(3000));
    for node in [talker, listener] {
        pair.world.cut(hub, node);
    }
    pair.publish_for(Duration::from_secs(300));
    assert!(pair.is_direct());
    pair.assert_whole();
    pair.world.share(talker, "/new", Sharing::to_fleet());
    pair.world.use_topic(listener, talker, "/new");
    pair.world.until_granted(listener, talker, "/new");
}

#[test]
fn router_takes_over_while_the_direct_path_is_cut() {
    let mut pair = pair(2, [Some(NatKind::PORT_RESTRICTED); 2]);
    let (talker, listener, hub) = (pair.talker, pair.listener, pair.hub);
    pair.publish_for(Duration::from_secs(70));
    assert_eq!(pair.hop(), Some(talker));
    pair.world.cut_direct(talker, listener, true);
    pair.publish_for(ms(3500));
    assert_eq!(pair.hop(), Some(hub), "within the time of the keep-alive");
    pair.publish_for(Duration::from_secs(20));
    assert!(!pair.world.has_direct(talker, listener));
    pair.world.cut_direct(talker, listener, false);
    pair.until_direct(Duration::from_secs(310));
    pair.publish_for(ms(3000));
    assert_eq!(pair.hop(), Some(talker));
    pair.assert_whole();
}

#[test]
fn link_survives_or_comes_back_after_nats_forget() {
    for (seed, kinds) in
        KINDS[1..4].iter().flat_map(|a| KINDS[1..4].iter().map(move |b| [*a, *b])).enumerate()
    {
        for side in 0..2 {
            let mut pair = pair(seed as u64, kinds);
            let (talker, listener) = (pair.talker, pair.listener);
            pair.publish_for(Duration::from_secs(70));
            assert!(pair.is_direct());
            let nat = pair.world.nat_of([talker, listener][side]).unwrap();
            pair.world.forget_mappings(nat);
            pair.publish_for(Duration::from_secs(30));
            assert_eq!(
                (pair.is_direct(), pair.hop()),
                (true, Some(talker)),
                "{kinds:?}\n{}",
                pair.world.trace()
            );
            pair.assert_whole();
        }
    }
}

#[test]
fn node_that_roams_finds_its_peer_again() {
    let mut pair = pair(3, [Some(NatKind::PORT_RESTRICTED), Some(NatKind::ADDRESS_RESTRICTED)]);
    pair.publish_for(Duration::from_secs(5));
    let carrier = pair.world.nat(NatKind::PORT_RESTRICTED, None);
    for node in [pair.listener, pair.talker] {
        pair.publish_for(Duration::from_secs(70));
        assert!(pair.is_direct(), "{}", pair.world.trace());
        let home = pair.world.nat(NatKind::FULL_CONE, Some(carrier));
        pair.world.place(node, Some(home));
        pair.publish_for(Duration::from_secs(15));
    }
    // Both are behind one carrier now, which lets no host reach its own address outside.
    pair.publish_for(Duration::from_secs(20));
    assert!(!pair.is_direct());
    pair.assert_whole();
}

/// A camera and viewers behind NATs of their own, all linked to one router.
struct Viewing {
    world: World,
    hub: NodeKey,
    camera: NodeKey,
    viewers: Vec<NodeKey>,
}

fn viewing(seed: u64, viewers: usize) -> Viewing {
    viewing_over(seed, viewers, ms(20))
}

fn viewing_over(seed: u64, viewers: usize, latency: Duration) -> Viewing {
    let mut world = World::with(WorldConfig { latency: ms(30)..=ms(30), ..WorldConfig::new(seed) });
    let hub = world.router("hub");
    let camera = world.proxy("camera");
    let viewers: Vec<_> = (0..viewers).map(|n| world.proxy(&format!("viewer-{n}"))).collect();
    for node in [camera].iter().chain(&viewers) {
        world.link_over(hub, *node, latency);
        let nat = world.nat(NatKind::PORT_RESTRICTED, None);
        world.place(*node, Some(nat));
    }
    Viewing { world, hub, camera, viewers }
}

impl Viewing {
    fn view(&mut self, viewer: usize, topic: &str) {
        self.world.use_topic(self.viewers[viewer], self.camera, topic);
        self.world.until_granted(self.viewers[viewer], self.camera, topic);
        self.world.run(Duration::from_secs(10));
        assert!(self.world.is_direct(self.camera, self.viewers[viewer]));
    }

    /// Publishes a message, which all viewers have to get. Returns the copies that leave the camera: over the router, over
    /// direct links through the uplink, and within its network.
    fn publish(&mut self, topic: &str) -> [usize; 3] {
        self.world.count_copies();
        let id = self.world.publish(self.camera, topic);
        self.world.run(ms(400));
        let copies = self.world.packet_copies(self.camera);
        assert_eq!((copies.len(), self.world.copied()), (1, Vec::new()));
        for viewer in self.world.granted(self.camera, topic) {
            assert_eq!(self.world.received(viewer, self.camera, topic).last(), Some(&id));
        }
        let PacketCopies { configured, far, near } = &copies[0];
        [*configured, far.len(), *near]
    }
}

#[test]
fn camera_with_several_viewers_sends_one_copy_over_its_uplink() {
    let mut viewing = viewing(4, 3);
    let home = viewing.world.nat(NatKind::PORT_RESTRICTED, None);
    for node in [viewing.camera, viewing.viewers[2]] {
        viewing.world.place(node, Some(home));
    }
    viewing.world.share(viewing.camera, "/image", Sharing::to_fleet());
    viewing.view(0, "/image");
    assert_eq!(viewing.publish("/image"), [0, 1, 0]);
    viewing.view(1, "/image");
    assert_eq!(viewing.publish("/image"), [1, 0, 0], "the router copies");
    viewing.view(2, "/image");
    assert_eq!(viewing.publish("/image"), [1, 0, 1]);
}

/// A direct link goes with the node that dialled it. Its packets pass the uplink from here on, and later no more.
#[test]
fn camera_that_leaves_the_network_of_its_viewers_sends_one_copy_over_its_uplink_until_it_returns() {
    let mut viewing = viewing(10, 2);
    let mut nodes = [viewing.camera, viewing.viewers[0], viewing.viewers[1]];
    // The node with the lesser id dials.
    nodes.sort_by_key(|node| viewing.world.identity(*node).node_id());
    (viewing.camera, viewing.viewers) = (nodes[0], nodes[1..].to_vec());
    let home = viewing.world.nat(NatKind { mapping: None, ..NatKind::FULL_CONE }, None);
    for node in nodes {
        viewing.world.place(node, Some(home));
    }
    viewing.world.share(viewing.camera, "/image", Sharing::to_fleet());
    viewing.view(0, "/image");
    viewing.view(1, "/image");
    assert_eq!(viewing.publish("/image"), [0, 0, 2]);
    viewing.world.lose_checks(100);
    for (place, copies) in [(None, [1, 0, 0]), (Some(home), [0, 0, 2])] {
        viewing.world.place(viewing.camera, place);
        viewing.world.run(Duration::from_secs(20));
        assert_eq!(viewing.publish("/image"), copies);
    }
}

/// An advertisement speaks for all names of its owner, also for those that are not told over a link.
#[test]
fn topic_of_one_viewer_brings_none_of_several_viewers_to_a_direct_link() {
    let mut viewing = viewing(5, 2);
    viewing.world.share(viewing.camera, "/image", Sharing::to_fleet());
    viewing.world.share(viewing.camera, "/state", Sharing::to_fleet());
    viewing.world.restart(viewing.camera);
    viewing.view(0, "/image");
    viewing.view(1, "/image");
    viewing.view(1, "/state");
    assert_eq!(viewing.publish("/image"), [1, 0, 0]);
    assert_eq!(viewing.publish("/state"), [0, 1, 0]);
}

#[test]
fn end_of_a_topic_with_several_viewers_looks_like_no_attack() {
    // The withdrawal overtakes the last advertisement.
    let mut viewing = viewing_over(6, 2, ms(5));
    viewing.world.share(viewing.camera, "/image", Sharing::to_fleet());
    viewing.view(0, "/image");
    viewing.view(1, "/image");
    viewing.world.unshare(viewing.camera, "/image");
    viewing.world.run(ms(2000));
    let drops = viewing.world.router_drops(viewing.camera);
    assert!(!drops.contains(&"not_owner"), "{drops:?}");
}

#[test]
fn all_viewers_get_the_camera_directly_while_it_reaches_no_router() {
    let mut viewing = viewing(7, 2);
    viewing.world.share(viewing.camera, "/image", Sharing::to_fleet());
    viewing.view(0, "/image");
    viewing.view(1, "/image");
    let (hub, camera) = (viewing.hub, viewing.camera);
    viewing.world.cut_unseen(hub, camera, ms(9000), ms(9000));
    viewing.world.run(ms(3500));
    assert_eq!(viewing.publish("/image")[1], 2, "once the router is silent");
    viewing.world.run(ms(7000));
    assert_eq!(viewing.publish("/image"), [0, 2, 0]);
    viewing.world.rejoin(hub, camera);
    viewing.world.run(ms(10_000));
    assert_eq!(viewing.publish("/image"), [1, 0, 0]);
    let all: Vec<_> = viewing.world.all_published().iter().map(|published| published.id).collect();
    for viewer in viewing.viewers {
        let received = viewing.world.received(viewer, camera, "/image");
        assert_eq!(received[..], all[all.len() - received.len()..]);
    }
}

#[test]
fn viewer_that_reaches_no_router_gets_the_camera_beside_another_copy() {
    let mut viewing = viewing(8, 2);
    viewing.world.share(viewing.camera, "/image", Sharing::to_fleet());
    viewing.view(0, "/image");
    viewing.view(1, "/image");
    let (hub, camera, viewer) = (viewing.hub, viewing.camera, viewing.viewers[1]);
    viewing.world.cut(hub, viewer);
    viewing.world.run(ms(7000));
    assert_eq!(viewing.world.granted(camera, "/image"), viewing.viewers);
    assert_eq!(viewing.publish("/image"), [1, 1, 0]);
    viewing.world.run(Duration::from_secs(60));
    assert_eq!(viewing.publish("/image"), [1, 1, 0], "it stays so");
}

#[test]
fn viewers_that_come_at_one_time_settle_at_once() {
    let mut viewing = viewing(9, 2);
    viewing.world.share(viewing.camera, "/state", Sharing::to_fleet());
    viewing.view(0, "/state");
    viewing.view(1, "/state");
    viewing.world.share(viewing.camera, "/image", Sharing::to_fleet());
    viewing.world.capture();
    for viewer in viewing.viewers.clone() {
        viewing.world.use_topic(viewer, viewing.camera, "/image");
    }
    viewing.world.run(Duration::from_secs(10));
    assert_eq!(viewing.publish("/image"), [1, 0, 0]);
    let to_camera = viewing.world.captured().iter().filter(|frame| frame.to == viewing.camera);
    let joins = to_camera.filter(|captured| matches!(captured.frame, Control::Join { .. })).count();
    assert!(joins <= 12, "{joins} requests");
}
