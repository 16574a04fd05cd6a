//! One identity in two processes: the process that started last keeps the links, the other waits, and no message
//! reaches both.

use std::collections::BTreeMap;
use std::time::Duration;

use sgc_endpoint::JoinStatus;
use sgc_router::LinkClose;
use sgc_testkit::{MessageId, NodeKey, Sharing, What, World};

use crate::ms;

/// Interval at which a node that lost its link dials again: no patience at all.
const REDIAL: Duration = ms(250);

/// A robot behind `east`, and two processes of `desk`, of which only the first runs and is linked to `east`.
struct Twins {
    world: World,
    arm: NodeKey,
    east: NodeKey,
    west: NodeKey,
    desk: NodeKey,
    twin: NodeKey,
}

/// `at_west` says that the second process dials the other router.
fn twins(seed: u64, at_west: bool) -> Twins {
    let mut world = World::new(seed);
    let (arm, east, west) = (world.proxy("arm-1"), world.router("east"), world.router("west"));
    let (desk, twin) = (world.proxy("desk"), world.proxy("desk"));
    for (a, b) in [(arm, east), (east, west), (east, desk)] {
        world.link(a, b);
    }
    world.crash(twin);
    world.link(if at_west { west } else { east }, twin);
    world.share(arm, "/chatter", Sharing::to_fleet().recovering(1000));
    for node in [desk, twin] {
        world.use_topic(node, arm, "/chatter");
    }
    let granted = |world: &World| world.status(desk, arm, "/chatter") == Some(JoinStatus::Granted);
    assert!(world.run_until(ms(10_000), granted));
    world.run(ms(2000));
    Twins { world, arm, east, west, desk, twin }
}

impl Twins {
    /// Publishes for a while. A process without a link keeps dialling.
    fn publish(&mut self, time: Duration, routers: [NodeKey; 2]) -> Vec<MessageId> {
        let Self { world, arm, desk, twin, .. } = self;
        crate::publish_steadily(world, *arm, REDIAL, time, |world, _| {
            for (node, router) in [*desk, *twin].into_iter().zip(routers) {
                if world.is_running(node) && !world.is_linked(node, router) {
                    world.rejoin(router, node);
                }
            }
        })
    }

    /// Returns `true` if one process has its link to `east`, and the other none. A dial of the other may be under way.
    fn has_link_alone(&mut self, holder: NodeKey, other: NodeKey) -> bool {
        let east = self.east;
        self.world.run_until(REDIAL, |world| world.is_linked(east, holder) && !world.is_linked(east, other))
    }

    /// Counts the links that a router closed for another run, by whether the closed one was known to live.
    fn superseded(&self, router: NodeKey) -> BTreeMap<bool, usize> {
        let mut closed = BTreeMap::new();
        for logged in self.world.log().iter().filter(|logged| logged.node == router) {
            if let What::Closed { reason: LinkClose::Superseded { alive, .. } } = &logged.what {
                *closed.entry(*alive).or_default() += 1;
            }
        }
        closed
    }

    fn received(&self, node: NodeKey) -> Vec<MessageId> {
        self.world.received(node, self.arm, "/chatter")
    }

    /// Checks that no message reached both processes, or one of them twice.
    fn assert_each_once(&self) {
        let mut times = BTreeMap::<MessageId, usize>::new();
        for id in self.received(self.desk).into_iter().chain(self.received(self.twin)) {
            *times.entry(id).or_default() += 1;
        }
        let twice: Vec<_> = times.iter().filter(|(_, n)| **n > 1).collect();
        assert!(twice.is_empty(), "{} of {} came twice", twice.len(), times.len());
    }
}

#[test]
fn the_process_that_was_started_last_keeps_the_link_and_no_message_comes_twice() {
    let mut twins = twins(210, false);
    let (east, desk, twin) = (twins.east, twins.desk, twins.twin);
    let routers = [east, east];
    twins.publish(ms(5000), routers);
    twins.world.start(twin);
    let both = twins.publish(ms(30_000), routers);
    let closed = twins.superseded(east);
    assert_eq!(closed.get(&false), Some(&1), "one took over, once: {closed:?}");
    assert!(closed.get(&true) > Some(&50), "the other came back in vain: {closed:?}");
    let of_twin = twins.received(twin);
    assert!(of_twin.len() >= both.len() - 5 && of_twin.windows(2).all(|two| two[0] < two[1]));
    twins.assert_each_once();

    // It is let in again after the other has gone, and the other keeps its messages.
    twins.world.crash(twin);
    let after = twins.publish(ms(10_000), routers);
    twins.world.run(ms(2000));
    assert!(twins.received(desk).ends_with(&after[after.len() - 20..]));
    twins.assert_each_once();

    // A restart takes over at once, from a process that lives too.
    twins.world.start(twin);
    twins.publish(ms(5000), routers);
    assert!(twins.has_link_alone(twin, desk));
    twins.world.restart(desk);
    assert!(twins.world.run_until(ms(1000), |world| world.is_linked(east, desk)));
    twins.publish(ms(5000), routers);
    assert!(twins.has_link_alone(desk, twin));
    twins.assert_each_once();
}

#[test]
fn a_process_at_another_router_takes_over_as_well() {
    let mut twins = twins(211, true);
    let (east, west, desk, twin) = (twins.east, twins.west, twins.desk, twins.twin);
    let routers = [east, west];
    twins.publish(ms(5000), routers);
    twins.world.start(twin);
    twins.publish(ms(10_000), routers);
    let closed = twins.superseded(east);
    assert_eq!(closed.get(&false), Some(&1), "{closed:?}");
    assert!(closed.get(&true) > Some(&10), "{closed:?}");
    assert!(twins.superseded(west).is_empty());
    assert!(twins.world.is_linked(west, twin));
    let before = twins.received(twin).len();
    let both = twins.publish(ms(10_000), routers);
    assert!(twins.received(twin).len() >= before + both.len() - 1);
    twins.world.crash(twin);
    let after = twins.publish(ms(10_000), routers);
    twins.world.run(ms(2000));
    assert!(twins.received(desk).ends_with(&after[after.len() - 20..]));
}
