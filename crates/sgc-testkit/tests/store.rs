//! Routers that share a store of names: found names, roaming, lost and lying stores.

use std::time::Duration;

use sgc_router::{MappingKind, StoreKey};

use sgc_testkit::{NodeKey, Sharing, StoreCounts, World, WorldConfig};
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
