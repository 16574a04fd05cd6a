//! Paths break and heal while a reliable topic flows. Every message arrives once and in order.

use std::collections::BTreeMap;
use std::time::Duration;

use sgc_testkit::{DataDrop, MessageId, NodeKey, Sharing, World, WorldConfig};
use sgc_trust::Suite;
use sgc_wire::{Control, Recover};

const TOPIC: &str = "/chatter";
/// Longest recovery after a cut: the longest wait for another path.
const HEALED: Duration = Duration::from_secs(30);

const fn ms(n: u64) -> Duration {
    Duration::from_millis(n)
}

/// A robot behind `north`, operators behind `south`, and two paths between them, over `east` and `west`.
struct Diamond {
    world: World,
    arm: NodeKey,
    north: NodeKey,
    east: NodeKey,
    west: NodeKey,
    south: NodeKey,
    users: Vec<NodeKey>,
    published: Vec<MessageId>,
}

fn diamond(seed: u64, users: usize, sharing: Sharing) -> Diamond {
    diamond_with(WorldConfig::new(seed), users, sharing)
}

fn diamond_with(config: WorldConfig, users: usize, sharing: Sharing) -> Diamond {
    let mut world = World::with(config);
    let [north, east, south, west] = ["north", "east", "south", "west"].map(|n| world.router(n));
    let arm = world.proxy("arm-1");
    for (a, b) in [(arm, north), (north, east), (east, south), (south, west), (west, north)] {
        world.link(a, b);
    }
    let users: Vec<_> = (0..users).map(|n| world.proxy(&format!("desk-{n}"))).collect();
    // Without signatures, which would take most of the time and do not matter here.
    world.share(arm, TOPIC, Sharing { suite: Some(Suite::Group), ..sharing });
    for user in &users {
        world.link(south, *user);
        world.use_topic(*user, arm, TOPIC);
    }
    for user in &users {
        world.until_granted(*user, arm, TOPIC);
    }
    world.run(ms(500));
    Diamond { world, arm, north, east, west, south, users, published: Vec::new() }
}

impl Diamond {
    /// Publishes messages of that size every `every` for `time`.
    fn publish(&mut self, every: Duration, time: Duration, bytes: usize) {
        let begin = self.world.elapsed();
        while self.world.elapsed() - begin < time {
            self.published.push(self.world.publish_bytes(self.arm, TOPIC, bytes));
            self.world.run(every);
        }
    }

    /// Returns the router between `north` and `south` over which the topic flows.
    fn used(&self) -> NodeKey {
        self.world.next_hop(self.south, &self.world.name(self.arm, TOPIC)).expect("it flows")
    }

    /// Waits until every user has all messages, and checks that each has them once and in order.
    fn assert_all(&mut self) {
        let Self { world, arm, users, published, .. } = self;
        let has_all = |w: &World, user: NodeKey| w.received(user, *arm, TOPIC).len() >= published.len();
        world.run_until(HEALED, |w| users.iter().all(|user| has_all(w, *user)));
        world.run(ms(1000));
        for user in users.iter() {
            let received = world.received(*user, *arm, TOPIC);
            let missing: Vec<_> = published.iter().filter(|id| !received.contains(id)).collect();
            assert!(missing.is_empty(), "{user:?} lacks {missing:?}\n{}", world.trace());
            assert_eq!(received, *published, "{user:?}\n{}", world.trace());
            assert_eq!(world.lost(*user), 0);
        }
    }
}

/// Breaks the path in one of several ways, which its ends see at once or late.
fn breaks(diamond: &mut Diamond, how: usize) {
    let (used, north, south) = (diamond.used(), diamond.north, diamond.south);
    let world = &mut diamond.world;
    match how {
        0 => world.cut(north, used),
        1 => world.cut(used, south),
        2 => world.cut_unseen(used, south, ms(3000), ms(700)),
        3 => world.cut_unseen(north, used, ms(200), ms(4000)),
        4 => world.crash(used),
        _ => world.crash_unseen(used, ms(2500)),
    }
}

fn mends(diamond: &mut Diamond) {
    let Diamond { world, north, east, west, south, .. } = diamond;
    for router in [*east, *west] {
        world.start(router);
        world.rejoin(*north, router);
        world.rejoin(router, *south);
    }
}

fn survives_every_break(seed: u64, sharing: Sharing, every: Duration, bytes: usize) {
    for how in 0..6 {
        let mut diamond = diamond(seed + how as u64, 2, sharing.clone());
        diamond.publish(every, ms(500), bytes);
        for _ in 0..2 {
            breaks(&mut diamond, how);
            diamond.publish(every, ms(6000), bytes);
            mends(&mut diamond);
            diamond.publish(every, ms(2000), bytes);
        }
        diamond.assert_all();
    }
}

#[test]
fn a_volatile_topic_loses_nothing_whatever_breaks() {
    survives_every_break(100, Sharing::to_fleet(), ms(10), 8);
}

#[test]
fn a_transient_local_topic_loses_nothing_whatever_breaks() {
    survives_every_break(110, Sharing::to_fleet().transient_local(3), ms(10), 8);
}

#[test]
fn messages_of_many_packets_lose_nothing_whatever_breaks() {
    survives_every_break(120, Sharing::to_fleet(), ms(60), 100_000);
}

#[test]
fn links_that_hurry_and_lag_lose_and_double_nothing() {
    for seed in 130..134 {
        let mut config = WorldConfig::new(seed);
        config.latency = ms(1)..=ms(200);
        config.jitter = ms(0)..=ms(50);
        let mut diamond = diamond_with(config, 2, Sharing::to_fleet());
        for how in [0, 5, 1] {
            breaks(&mut diamond, how);
            diamond.publish(ms(7), ms(5000), 8);
            mends(&mut diamond);
            diamond.publish(ms(7), ms(1500), 8);
        }
        diamond.assert_all();
    }
}

#[test]
fn the_last_messages_before_a_silence_arrive_over_another_way() {
    for how in 0..6 {
        for sharing in [Sharing::to_fleet(), Sharing::to_fleet().transient_local(1)] {
            let mut diamond = diamond(140 + how as u64, 2, sharing);
            diamond.publish(ms(5), ms(200), 8);
            // Packets in flight are lost with the path, and no later message follows.
            breaks(&mut diamond, how);
            diamond.publish(ms(1), ms(3), 8);
            diamond.assert_all();
        }
    }
}

#[test]
fn the_last_messages_before_a_silence_arrive_though_no_way_changed() {
    for (held, within) in [(ms(100), ms(2500)), (ms(2000), ms(5500)), (ms(6000), ms(17_000))] {
        let mut diamond = diamond(150, 3, Sharing::to_fleet());
        diamond.publish(ms(10), ms(100), 8);
        diamond.world.run(ms(500));
        let (south, user) = (diamond.south, diamond.users[0]);
        diamond.world.lose_packets(south, user, true);
        diamond.publish(ms(10), ms(50), 8);
        diamond.world.run(held);
        diamond.world.lose_packets(south, user, false);
        diamond.world.run(within - held);
        let received = diamond.world.received(user, diamond.arm, TOPIC);
        assert_eq!(received, diamond.published, "the source said what it published last");
        diamond.assert_all();
    }
}

#[test]
fn the_way_of_the_owner_itself_may_break() {
    for (seed, away) in [(160, ms(300)), (161, ms(6000))] {
        let mut diamond = diamond(seed, 2, Sharing::to_fleet());
        diamond.publish(ms(10), ms(200), 8);
        let (arm, north) = (diamond.arm, diamond.north);
        diamond.world.cut(arm, north);
        diamond.publish(ms(10), away, 8);
        diamond.world.rejoin(arm, north);
        diamond.publish(ms(10), ms(500), 8);
        diamond.assert_all();
    }
}

#[test]
fn expired_messages_are_counted_as_lost_and_the_rest_goes_on() {
    let mut diamond = diamond(170, 2, Sharing::to_fleet().recovering(20));
    diamond.publish(ms(10), ms(200), 8);
    diamond.world.run(ms(200));
    let (south, user) = (diamond.south, diamond.users[0]);
    diamond.world.cut(south, user);
    diamond.publish(ms(10), ms(1000), 8);
    diamond.world.rejoin(south, user);
    diamond.publish(ms(10), ms(6000), 8);
    diamond.world.run(ms(2000));
    let Diamond { world, arm, users, published, .. } = &mut diamond;
    assert_eq!(world.received(users[1], *arm, TOPIC), *published, "the other one missed nothing");
    let received = world.received(user, *arm, TOPIC);
    assert!(received.is_sorted(), "in order");
    let (missing, lost) = (published.len() - received.len(), world.lost(user));
    assert!(missing > 50 && lost >= missing as u64, "{missing} missing, {lost} told");
    // One or two of the numbers are marks.
    assert!(lost <= missing as u64 + 10, "{missing} missing, {lost} told");
    let gap: Vec<_> = published.iter().filter(|id| !received.contains(id)).collect();
    assert_eq!(gap.len() as u64, gap[gap.len() - 1].0 - gap[0].0 + 1, "one gap");
}

#[test]
fn a_source_that_publishes_faster_than_is_kept_stalls_nobody() {
    let mut diamond = diamond(180, 2, Sharing::to_fleet().recovering(2));
    for how in [1, 4] {
        breaks(&mut diamond, how);
        diamond.publish(ms(1), ms(4000), 8);
        mends(&mut diamond);
        diamond.publish(ms(1), ms(500), 8);
    }
    let last = diamond.world.publish(diamond.arm, TOPIC);
    diamond.world.run(ms(3000));
    for user in &diamond.users {
        let received = diamond.world.received(*user, diamond.arm, TOPIC);
        assert!(received.is_sorted() && received.last() == Some(&last), "{}", diamond.world.trace());
    }
}

#[test]
fn many_sinks_recover_from_one_cut() {
    let mut diamond = diamond(190, 40, Sharing::to_fleet());
    diamond.publish(ms(20), ms(200), 8);
    breaks(&mut diamond, 2);
    diamond.publish(ms(20), ms(2000), 8);
    let begin = diamond.world.elapsed();
    diamond.assert_all();
    assert!(diamond.world.elapsed() - begin < ms(5000), "{:?}", diamond.world.elapsed() - begin);
}

#[test]
fn a_way_that_changes_sends_no_history_twice() {
    let mut diamond = diamond(200, 1, Sharing::to_fleet().transient_local(50));
    diamond.publish(ms(5), ms(250), 8);
    diamond.world.run(ms(500));
    diamond.world.capture();
    breaks(&mut diamond, 4);
    diamond.assert_all();
    diamond.world.run(ms(20_000));
    let to_user = diamond.world.captured_packets().iter().filter(|c| c.to == diamond.users[0]);
    let replayed = to_user.filter(|c| c.packet.header.to.is_some_and(|_| c.packet.header.seq > 0)).count();
    assert_eq!(replayed, 0, "nothing was lost");
}

/// A late subscriber of a volatile topic gets no earlier message, whatever it asks for and over whatever path.
#[test]
fn nothing_older_than_the_grant_is_sent_again() {
    let mut diamond = diamond(210, 1, Sharing::to_fleet());
    diamond.publish(ms(5), ms(100), 8);
    let Diamond { world, arm, north, south, .. } = &mut diamond;
    let guest = world.proxy("guest");
    world.link(*south, guest);
    world.capture();
    world.use_topic(guest, *arm, TOPIC);
    world.until_granted(guest, *arm, TOPIC);
    world.run(ms(500));
    let source = world.all_published()[0].source;
    let ask = |world: &mut World| {
        let name = world.name(*arm, TOPIC);
        let sinks = world.granted_sinks(*arm, TOPIC);
        let (sink, _) = *sinks.iter().find(|(_, node)| *node == guest).expect("granted");
        for from in [0, 1, 5] {
            let recover = Recover { name, sink, source, from, to: u64::MAX };
            world.inject(guest, *south, &Control::Recover(recover));
            world.run(ms(300));
        }
    };
    let sent = |world: &World| {
        let mut seqs = BTreeMap::<u64, usize>::new();
        for c in world.captured_packets().iter().filter(|c| c.to == guest && c.packet.header.to.is_some()) {
            *seqs.entry(c.packet.header.seq).or_default() += 1;
        }
        seqs
    };
    ask(world);
    let all = sent(world);
    assert!(all.keys().all(|seq| *seq == 0 || *seq > 20) && all[&0] == 3, "{all:?}");
    // It may get later messages again, also over another path.
    let first = world.publish(*arm, TOPIC);
    world.run(ms(300));
    for _ in 0..2 {
        ask(world);
        assert!(sent(world).keys().all(|seq| *seq == 0 || *seq > 20), "{:?}", sent(world));
        assert!(sent(world).keys().any(|seq| *seq > 20), "{:?}", sent(world));
        world.cut(*south, guest);
        world.run(ms(500));
        world.rejoin(*south, guest);
        world.until_granted(guest, *arm, TOPIC);
        world.run(ms(500));
    }
    assert_eq!(world.received(guest, *arm, TOPIC), [first]);
    assert!(!world.data_drops(*north).contains(&DataDrop::WrongWay));
}

#[test]
fn a_best_effort_topic_goes_on_and_asks_for_nothing() {
    let mut diamond = diamond(220, 2, Sharing::to_fleet().best_effort());
    diamond.world.capture();
    breaks(&mut diamond, 2);
    diamond.publish(ms(10), ms(3000), 8);
    mends(&mut diamond);
    diamond.publish(ms(10), ms(3000), 8);
    diamond.world.run(ms(20_000));
    for user in &diamond.users {
        let received = diamond.world.received(*user, diamond.arm, TOPIC);
        assert!(received.last() == diamond.published.last(), "it flows again");
        let mut once = received.clone();
        once.sort_unstable();
        once.dedup();
        assert_eq!(once.len(), received.len());
    }
    let asked = diamond.world.captured().iter().any(|c| matches!(c.frame, Control::Recover(_)));
    assert!(!asked);
}
