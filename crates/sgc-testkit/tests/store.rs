//! Routers that share a store of names: found names, roaming, lost and lying stores.

use std::time::Duration;

use sgc_router::{MappingKind, StoreKey};

use sgc_testkit::{Dice, NodeKey, Sharing, StoreCounts, What, World, WorldConfig};
use sgc_wire::Control;

const fn ms(n: u64) -> Duration {
    Duration::from_millis(n)
}

/// Two routers that share a store, a robot at one and a desk at the other.
struct Site {
    world: World,
    routers: [NodeKey; 2],
    robot: NodeKey,
    desk: NodeKey,
}

impl Site {
    fn with(mappings: [MappingKind; 2]) -> Self {
        let mut config = WorldConfig::new(7);
        config.mappings = vec![mappings[0]];
        config.latency = ms(5)..=ms(5);
        config.jitter = Duration::ZERO..=Duration::ZERO;
        let mut world = World::with(config);
        let first = world.router("first");
        world.set_mapping(mappings[1]);
        let second = world.router("second");
        world.set_mapping(MappingKind::Store);
        let (robot, desk) = (world.proxy("robot"), world.proxy("desk"));
        world.link(first, second);
        world.link(first, robot);
        world.link(second, desk);
        world.share(robot, "/chatter", Sharing::to_fleet());
        world.run(Duration::from_secs(2));
        Self { world, routers: [first, second], robot, desk }
    }

    fn new() -> Self {
        Self::with([MappingKind::Store; 2])
    }

    /// Lets the desk use a topic of the robot, and returns the time until it is granted.
    fn until_granted(&mut self, topic: &str) -> Duration {
        let begin = self.world.elapsed();
        self.world.use_topic(self.desk, self.robot, topic);
        self.world.until_granted(self.desk, self.robot, topic);
        self.world.elapsed() - begin
    }

    fn assert_delivers(&mut self, topic: &str) {
        let message = self.world.publish(self.robot, topic);
        self.world.run(Duration::from_secs(1));
        assert_eq!(self.world.received(self.desk, self.robot, topic).last(), Some(&message));
    }

    fn counts_of(&mut self, act: impl FnOnce(&mut Self)) -> StoreCounts {
        let before = self.world.store_counts();
        act(self);
        let after = self.world.store_counts();
        StoreCounts {
            reads: after.reads - before.reads,
            writes: after.writes - before.writes,
            name_writes: after.name_writes - before.name_writes,
            removals: after.removals - before.removals,
        }
    }

    fn questions(&self, node: NodeKey) -> usize {
        let captured = self.world.captured().iter();
        captured.filter(|c| c.to == node && matches!(c.frame, Control::Query { .. })).count()
    }
}

#[test]
fn name_is_found_through_the_store_without_a_question_to_a_router() {
    let mut site = Site::new();
    site.world.capture();
    site.until_granted("/chatter");
    site.assert_delivers("/chatter");
    assert_eq!(site.questions(site.routers[0]), 0);
    assert!(site.world.store_stats(site.routers[1]).found > 0);
}

#[test]
fn renewals_write_each_batch_once_and_no_name() {
    let mut site = Site::new();
    site.until_granted("/chatter");
    // The catalogue and the topic were advertised one after the other, and are renewed together.
    site.world.run(Duration::from_secs(110));
    let renewed = site.counts_of(|site| site.world.run(Duration::from_secs(100)));
    assert_eq!((renewed.writes, renewed.name_writes), (4, 0), "a batch and a link state of each node");
    assert_eq!(renewed.reads, 2, "the desk's router reads them again, because the desk uses the topic");
    site.world.run(Duration::from_secs(400));
    site.assert_delivers("/chatter");
}

#[test]
fn robot_that_roams_rewrites_no_name() {
    let mut site = Site::new();
    let third = site.world.router("third");
    site.world.link(third, site.routers[1]);
    site.until_granted("/chatter");
    site.world.run(Duration::from_secs(220));
    site.world.capture();
    let roamed = site.counts_of(|site| {
        site.world.cut(site.routers[0], site.robot);
        site.world.link(third, site.robot);
        site.world.run(Duration::from_secs(5));
    });
    assert_eq!(roamed.name_writes, 0);
    assert!((1..=4).contains(&roamed.writes), "its link state as it changes, and its batches: {roamed:?}");
    let asked =
        |site: &Site| site.routers.iter().chain([&third]).map(|node| site.questions(*node)).sum::<usize>();
    assert_eq!(asked(&site), 0, "the store tells its new place");
    site.assert_delivers("/chatter");
    assert_eq!(site.world.next_hop(site.routers[1], &site.world.name(site.robot, "/chatter")), Some(third));
}

#[test]
fn lost_store_ends_no_flow_and_routers_find_new_names_by_asking() {
    let mut site = Site::new();
    let second_desk = site.world.proxy("second-desk");
    site.world.link(site.routers[1], second_desk);
    site.until_granted("/chatter");
    site.world.stop_store();
    site.world.run(Duration::from_secs(3));
    site.assert_delivers("/chatter");
    let known = site.counts_of(|site| {
        site.world.use_topic(second_desk, site.robot, "/chatter");
        site.world.until_granted(second_desk, site.robot, "/chatter");
    });
    assert_eq!(known, StoreCounts::default(), "the name is known");
    site.world.share(site.robot, "/new", Sharing::to_fleet());
    let took = site.until_granted("/new");
    assert!(took < Duration::from_secs(1), "routers are asked at once: {took:?}");
    site.world.run(Duration::from_secs(600));
    site.assert_delivers("/chatter");
    site.assert_delivers("/new");
}

#[test]
fn store_that_returns_empty_is_filled_again() {
    let mut site = Site::new();
    site.until_granted("/chatter");
    site.world.run(Duration::from_secs(1));
    let before = site.world.stored();
    site.world.stop_store();
    site.world.run(Duration::from_secs(30));
    site.world.start_store(false);
    site.world.run(Duration::from_secs(2));
    assert_eq!(site.world.stored(), before);
    // Another router has no other source than the store.
    let (third, late_desk) = (site.world.router("third"), site.world.proxy("late-desk"));
    site.world.link(third, site.routers[1]);
    site.world.link(third, late_desk);
    site.world.run(Duration::from_secs(1));
    site.world.capture();
    site.world.use_topic(late_desk, site.robot, "/chatter");
    site.world.until_granted(late_desk, site.robot, "/chatter");
    assert_eq!(site.questions(site.routers[0]) + site.questions(site.routers[1]), 0);
}

#[test]
fn store_that_returns_without_names_of_a_batch_that_it_has_gets_them_again() {
    let mut site = Site::new();
    site.until_granted("/chatter");
    site.world.run(Duration::from_secs(1));
    let name = StoreKey::Name(site.world.name(site.robot, "/chatter"));
    let (before, value) = (site.world.stored(), site.world.stored_value(&name).map(<[u8]>::to_vec));
    site.world.stop_store();
    site.world.run(Duration::from_secs(1));
    site.world.forget_stored(&name);
    site.world.start_store(true);
    // Names that are still there are not written: nobody hears of a change.
    let counts = site.counts_of(|site| site.world.run(Duration::from_secs(2)));
    assert_eq!((site.world.stored(), site.world.stored_value(&name)), (before, value.as_deref()));
    assert!(counts.name_writes > 0, "{counts:?}");
    assert_eq!(site.counts_of(|site| site.world.run(Duration::from_secs(20))).name_writes, 0);
}

#[test]
fn names_that_the_store_lost_are_found_by_asking_and_written_again() {
    let mut site = Site::new();
    let name = StoreKey::Name(site.world.name(site.robot, "/chatter"));
    assert!(site.world.stored_value(&name).is_some());
    site.world.forget_stored(&name);
    site.until_granted("/chatter");
    site.world.run(Duration::from_secs(1));
    assert!(site.world.stored_value(&name).is_some());
    assert_eq!(site.world.store_stats(site.routers[0]).healed, 1);
}

#[test]
fn withdrawn_name_ends_and_can_be_shared_again() {
    let mut site = Site::new();
    site.world.share(site.robot, "/kept", Sharing::to_fleet());
    site.until_granted("/chatter");
    site.until_granted("/kept");
    // Both are in one batch from here on.
    site.world.run(Duration::from_secs(110));
    site.world.unshare(site.robot, "/chatter");
    site.world.run(Duration::from_secs(30));
    assert_eq!(site.world.granted(site.robot, "/chatter"), []);
    let name = site.world.name(site.robot, "/chatter");
    assert_eq!(site.world.next_hop(site.routers[1], &name), None);
    site.world.share(site.robot, "/chatter", Sharing::to_fleet());
    site.world.until_granted(site.desk, site.robot, "/chatter");
    site.assert_delivers("/chatter");
    site.assert_delivers("/kept");
}

#[test]
fn name_of_a_node_that_is_gone_leaves_the_store_when_it_is_looked_up() {
    let mut site = Site::new();
    site.world.crash(site.robot);
    site.world.run(Duration::from_secs(310));
    site.world.use_topic(site.desk, site.robot, "/chatter");
    site.world.run(Duration::from_secs(30));
    // The desk asks for topics once it has the catalogue.
    let catalogue = StoreKey::Name(site.world.catalogue_name(site.robot));
    assert_eq!(site.world.stored_value(&catalogue), None);
    assert_eq!(site.world.store_stats(site.routers[1]).orphans, 1);
    site.world.start(site.robot);
    site.world.until_granted(site.desk, site.robot, "/chatter");
    site.assert_delivers("/chatter");
}

#[test]
fn nodes_that_want_one_name_cause_one_look_up() {
    let mut site = Site::new();
    let desks: Vec<_> = (0..20).map(|n| site.world.proxy(&format!("desk-{n}"))).collect();
    for desk in &desks {
        site.world.link(site.routers[1], *desk);
    }
    site.world.run(Duration::from_secs(3));
    let one = site.counts_of(|site| {
        site.until_granted("/chatter");
    });
    let more = site.counts_of(|site| {
        for desk in &desks {
            site.world.use_topic(*desk, site.robot, "/chatter");
        }
        site.world.run(Duration::from_secs(2));
    });
    assert_eq!(site.world.granted(site.robot, "/chatter").len(), 21);
    assert_eq!((one.writes, more.reads, more.writes), (0, 0, 0));
}

#[test]
fn store_works_beside_other_mappings_in_one_mesh() {
    let (flood, query, store) = (MappingKind::Flood, MappingKind::Query, MappingKind::Store);
    for mappings in [[store, query], [query, store], [store, flood], [flood, store]] {
        let mut site = Site::with(mappings);
        let took = site.until_granted("/chatter");
        assert!(took < Duration::from_secs(1), "{mappings:?}: {took:?}");
        site.assert_delivers("/chatter");
    }
}

#[test]
fn question_of_a_router_without_the_store_is_answered_from_it() {
    let mut site = Site::new();
    // The router that asks is linked to one that does not know the name, and nobody else.
    site.world.set_mapping(MappingKind::Query);
    let (far, far_desk) = (site.world.router("far"), site.world.proxy("far-desk"));
    site.world.link(far, site.routers[1]);
    site.world.link(far, far_desk);
    let [first, second] = site.routers;
    let is_question = |frame: &Control| matches!(frame, Control::Query { .. });
    site.world
        .tamper(second, first, move |f| Some(f.clone()).filter(|f| !is_question(f)).into_iter().collect());
    site.world.run(Duration::from_secs(1));
    site.world.use_topic(far_desk, site.robot, "/chatter");
    site.world.until_granted(far_desk, site.robot, "/chatter");
}

#[test]
fn lying_store_delays_names_and_nothing_else() {
    for seed in 0..40 {
        let mut site = Site::new();
        let mut dice = Dice::new(seed);
        site.until_granted("/chatter");
        site.world.share(site.robot, "/new", Sharing::to_fleet());
        site.world.run(ms(500));
        for _ in 0..10 {
            site.world.corrupt_store(&mut dice);
            site.world.run(ms(200));
        }
        site.assert_delivers("/chatter");
        let took = site.until_granted("/new");
        assert!(took < Duration::from_secs(25), "seed {seed}: {took:?}");
        site.assert_delivers("/new");
        assert!(site.world.log().iter().all(|entry| !matches!(entry.what, What::Closed { .. })));
    }
}
