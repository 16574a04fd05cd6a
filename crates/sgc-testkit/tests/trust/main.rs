//! Keys that change, rights that end, and recorded, forged and foreign frames: the machines in a
//! network with a virtual clock.
//!
//! Links, handshakes and files are tested where they are made; here a "router that colludes" is one whose links
//! the test uses as it likes.

mod certificates;
mod clocks;
mod consumers;
mod floods;
mod identity_in_use;
mod members;
mod nonces;
mod partners;
mod publishers;
mod replay;
mod reports;
mod revocation;
mod rotation;
mod types;

use std::collections::BTreeMap;
use std::time::Duration;

use sgc_endpoint::Event;
use sgc_testkit::{CapturedFrame, LogEntry, MessageId, NodeKey, Sharing, What, World, WorldConfig};
use sgc_wire::{Control, Packet, SinkId, TopicGrant};

const fn ms(n: u64) -> Duration {
    Duration::from_millis(n)
}

/// A robot and three operators, with two routers between: arm – east – west – {desk, lap, tab}.
struct Scene {
    world: World,
    arm: NodeKey,
    east: NodeKey,
    west: NodeKey,
    /// Returns the receivers of `/chatter`.
    desk: NodeKey,
    lap: NodeKey,
    tab: NodeKey,
}

impl Scene {
    fn users(&self) -> [NodeKey; 3] {
        [self.desk, self.lap, self.tab]
    }

    /// Returns the users except one.
    fn without(&self, node: NodeKey) -> Vec<NodeKey> {
        self.users().into_iter().filter(|n| *n != node).collect()
    }
}

/// Returns the scene without any topic.
fn scene_with(config: WorldConfig) -> Scene {
    let mut world = World::with(config);
    world.capture();
    let arm = world.proxy("arm-1");
    let [desk, lap, tab] = ["desk", "lap", "tab"].map(|name| world.proxy(name));
    let (east, west) = (world.router("east"), world.router("west"));
    for (a, b) in [(arm, east), (east, west), (west, desk), (west, lap), (west, tab)] {
        world.link(a, b);
    }
    Scene { world, arm, east, west, desk, lap, tab }
}

/// Returns the scene with `/chatter`, shared with the three and granted to them.
fn flowing_with(config: WorldConfig, sharing: impl FnOnce(Sharing) -> Sharing) -> Scene {
    let mut scene = scene_with(config);
    let users = scene.users();
    scene.world.share(scene.arm, "/chatter", sharing(Sharing::to(&users)));
    for user in users {
        scene.world.use_topic(user, scene.arm, "/chatter");
    }
    for user in users {
        scene.world.until_granted(user, scene.arm, "/chatter");
    }
    scene.world.run(ms(500));
    scene
}

fn flowing(seed: u64) -> Scene {
    flowing_with(WorldConfig::new(seed), |sharing| sharing)
}

/// Returns a configuration with slow links whose latencies differ widely.
fn slow(seed: u64) -> WorldConfig {
    let mut config = WorldConfig::new(seed);
    config.latency = ms(2)..=ms(300);
    config.jitter = ms(0)..=ms(60);
    config
}

/// Publishes `/chatter` of `owner` every `every`, for `time`; `at` is called before each with the time passed.
fn publish_steadily(
    world: &mut World,
    owner: NodeKey,
    every: Duration,
    time: Duration,
    mut at: impl FnMut(&mut World, Duration),
) -> Vec<MessageId> {
    let begin = world.elapsed();
    let mut published = Vec::new();
    while world.elapsed() - begin < time {
        let passed = world.elapsed() - begin;
        at(world, passed);
        published.push(world.publish(owner, "/chatter"));
        world.run(every);
    }
    published
}

/// Asserts that `user` got each of these messages exactly once and in order.
fn assert_received(world: &World, user: NodeKey, owner: NodeKey, published: &[MessageId]) {
    let received: Vec<_> =
        world.received(user, owner, "/chatter").into_iter().filter(|id| published.contains(id)).collect();
    assert_eq!(received, published, "at {user:?}\n{}", world.trace());
}

/// Asserts that `user` got none of these messages.
fn assert_nothing_received(world: &World, user: NodeKey, owner: NodeKey, published: &[MessageId]) {
    let received = world.received(user, owner, "/chatter");
    let leaked: Vec<_> = published.iter().filter(|id| received.contains(id)).collect();
    assert!(leaked.is_empty(), "{user:?} got {leaked:?}\n{}", world.trace());
}

/// Returns the events at a node since a line of the log.
fn events(world: &World, node: NodeKey, from: usize) -> impl Iterator<Item = (&Event, Duration)> {
    world.log()[from..].iter().filter(move |l| l.node == node).filter_map(|l: &LogEntry| match &l.what {
        What::Event(event) => Some((event, l.at)),
        _ => None,
    })
}

/// Returns the grants that a node got of a name's topic, oldest first, with their sinks.
fn grants(world: &World, node: NodeKey, owner: NodeKey) -> Vec<(SinkId, TopicGrant)> {
    let wanted = world.name(owner, "/chatter");
    let of_topic = |(event, _): (&Event, Duration)| match event {
        Event::Granted { name, sink, grant } if *name == wanted => Some((*sink, grant.clone())),
        _ => None,
    };
    events(world, node, 0).filter_map(of_topic).collect()
}

/// Returns the packets that went from one node to another, in order.
fn packets(world: &World, from: NodeKey, to: NodeKey) -> Vec<Packet> {
    let of_link = world.captured_packets().iter().filter(|c| (c.from, c.to) == (from, to));
    of_link.map(|c| c.packet.clone()).collect()
}

/// Returns the frames that went from one node to another, in order.
fn frames(world: &World, from: NodeKey, to: NodeKey) -> Vec<Control> {
    let of_link = |c: &&CapturedFrame| (c.from, c.to) == (from, to);
    world.captured().iter().filter(of_link).map(|c| c.frame.clone()).collect()
}

/// Returns the number of frames that a node's router refused for that reason.
fn drops(world: &World, node: NodeKey, key: &str) -> usize {
    world.router_drops(node).iter().filter(|d| **d == key).count()
}

/// Returns how often a node's sinks refused packets, by counter.
fn sink_drops(world: &World, node: NodeKey) -> BTreeMap<&'static str, usize> {
    let mut counts = BTreeMap::new();
    for dropped in world.data_drops(node) {
        if let sgc_testkit::DataDrop::Sink(why) = dropped {
            *counts.entry(why.key()).or_default() += 1;
        }
    }
    counts
}

/// Returns the reasons for which a node closed links.
fn closed(world: &World, node: NodeKey) -> Vec<sgc_router::LinkClose> {
    let of_node = world.log().iter().filter(|l| l.node == node);
    of_node
        .filter_map(|l| match &l.what {
            What::Closed { reason } => Some(reason.clone()),
            _ => None,
        })
        .collect()
}
