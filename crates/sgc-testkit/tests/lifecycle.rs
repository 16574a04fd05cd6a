//! The life of owners, users and routers: starts and ends in every order, cuts, leases, histories.

use std::time::Duration;

use sgc_endpoint::{Event, JoinStatus, LostReason, RefusedBy};
use sgc_router::{Limits, LinkClose};
use sgc_testkit::{DataDrop, Member, MessageId, Model, NodeKey, Sharing, What, World, WorldConfig};
use sgc_wire::{HOP_LIMIT, RefuseReason, RejectReason};

const fn ms(n: u64) -> Duration {
    Duration::from_millis(n)
}

/// A robot, a router and an operator in a line.
struct Line {
    world: World,
    arm: NodeKey,
    cloud: NodeKey,
    desk: NodeKey,
}

fn line(seed: u64) -> Line {
    line_with(WorldConfig::new(seed))
}

fn line_with(config: WorldConfig) -> Line {
    let mut world = World::with(config);
    let (arm, cloud, desk) = (world.proxy("arm-1"), world.router("cloud"), world.proxy("desk"));
    world.link(arm, cloud);
    world.link(cloud, desk);
    Line { world, arm, cloud, desk }
}

/// A robot, a router and an operator in a line, with `/chatter` flowing from robot to operator.
fn flowing(seed: u64) -> Line {
    let mut line = line(seed);
    line.world.share(line.arm, "/chatter", Sharing::to_fleet());
    line.world.use_topic(line.desk, line.arm, "/chatter");
    assert_flows(&mut line.world, line.arm, line.desk);
    line
}

/// Checks that `/chatter` of `owner` reaches `user` once.
fn assert_flows(world: &mut World, owner: NodeKey, user: NodeKey) {
    world.until_granted(user, owner, "/chatter");
    world.run(ms(500));
    let id = world.publish(owner, "/chatter");
    world.run(ms(1000));
    let received = world.received(user, owner, "/chatter");
    assert_eq!(received.iter().filter(|r| **r == id).count(), 1, "{}", world.trace());
    assert_no_duplicates(world);
}

fn assert_no_duplicates(world: &World) {
    let mut seen = std::collections::BTreeSet::new();
    for r in world.all_received() {
        assert!(seen.insert((r.node, r.run, r.use_number, r.id)), "twice: {r:?}\n{}", world.trace());
    }
}

fn permutations<T: Copy>(of: [T; 3]) -> [[T; 3]; 6] {
    [[0, 1, 2], [0, 2, 1], [1, 0, 2], [1, 2, 0], [2, 0, 1], [2, 1, 0]].map(|order| order.map(|i| of[i]))
}

#[test]
fn start_share_and_use_come_in_any_order() {
    for order in 0..6 {
        for wish_at in 0..4 {
            let Line { mut world, arm, cloud, desk } = line(1);
            for node in [arm, cloud, desk] {
                world.crash(node);
            }
            for (n, node) in permutations([arm, cloud, desk])[order].into_iter().enumerate() {
                if n == wish_at {
                    world.use_topic(desk, arm, "/chatter");
                } else if n == 3 - wish_at {
                    world.share(arm, "/chatter", Sharing::to_fleet());
                }
                world.start(node);
                world.run(ms(300));
            }
            world.share(arm, "/chatter", Sharing::to_fleet());
            world.use_topic(desk, arm, "/chatter");
            assert_flows(&mut world, arm, desk);
        }
    }
}

#[test]
fn flow_resumes_after_any_node_ends_in_any_way_and_comes_back() {
    type End = fn(&mut World, NodeKey);
    let ends: [(&str, End); 5] = [
        ("restart", |w, n| w.restart(n)),
        ("superseded", |w, n| {
            w.crash_unseen(n, ms(20_000));
            w.run(ms(50));
            w.start(n);
        }),
        ("away for long", |w, n| {
            w.crash(n);
            w.run(ms(100_000));
            w.start(n);
        }),
        ("noticed late", |w, n| {
            w.crash_unseen(n, ms(8000));
            w.run(ms(30_000));
            w.start(n);
        }),
        ("shut down", |w, n| {
            w.shut_down(n);
            w.run(ms(2000));
            w.start(n);
        }),
    ];
    for (how, end) in ends {
        for who in 0..3 {
            let Line { mut world, arm, cloud, desk } = flowing(2);
            let node = [arm, cloud, desk][who];
            let others = [arm, cloud, desk].map(|n| world.runs(n));
            end(&mut world, node);
            let back = world.elapsed();
            assert_flows(&mut world, arm, desk);
            let took = world.elapsed() - back;
            assert!(took < ms(5000), "{how} of {node:?}: flows again only after {took:?}\n{}", world.trace());
            for (n, runs) in [arm, cloud, desk].into_iter().zip(others) {
                assert_eq!(world.runs(n), runs + u64::from(n == node), "{how}: only {node:?} was restarted");
            }
        }
    }
}

#[test]
fn flow_resumes_after_all_are_killed_and_restarted_in_any_order() {
    for order in 0..6 {
        for gap in [0, 40, 3000] {
            let Line { mut world, arm, cloud, desk } = flowing(3);
            for node in permutations([arm, cloud, desk])[order] {
                world.crash_unseen(node, ms(10_000));
                world.run(ms(5 + gap));
                world.start(node);
            }
            assert_flows(&mut world, arm, desk);
        }
    }
}

#[test]
fn a_restarted_neighbour_supersedes_its_old_link_at_once() {
    let Line { mut world, arm, cloud, .. } = flowing(4);
    world.crash_unseen(arm, ms(60_000));
    world.run(ms(10));
    world.start(arm);
    world.run(ms(500));
    let closed = |l: &&sgc_testkit::LogEntry| {
        l.node == cloud
            && matches!(l.what, What::Closed { reason: LinkClose::Superseded { alive: false, .. } })
    };
    assert_eq!(world.log().iter().filter(closed).count(), 1);
}

/// A router that restarted hears of the earlier run from another router, after the later one has greeted.
#[test]
fn run_whose_clock_is_behind_the_start_of_the_earlier_run_gets_its_link_back() {
    for behind in [Duration::from_secs(300), Duration::from_secs(5000)] {
        let mut world = World::new(8);
        let (arm, east, west) = (world.proxy("arm-1"), world.router("east"), world.router("west"));
        let desk = world.proxy("desk");
        for (a, b, latency) in [(arm, east, ms(5)), (east, west, ms(40)), (west, desk, ms(5))] {
            world.link_over(a, b, latency);
        }
        world.share(arm, "/chatter", Sharing::to_fleet());
        world.use_topic(desk, arm, "/chatter");
        world.until_granted(desk, arm, "/chatter");
        world.crash(arm);
        world.crash(east);
        world.set_behind(arm, behind);
        world.start(arm);
        world.start(east);
        world.run(ms(500));
        let closed = |l: &&sgc_testkit::LogEntry| {
            l.node == east && matches!(l.what, What::Closed { reason: LinkClose::Superseded { .. } })
        };
        assert_eq!(world.log().iter().filter(closed).count(), 1, "{}", world.trace());
        world.set_ahead(arm, Duration::ZERO);
        let granted = |world: &World| world.granted(arm, "/chatter") == [desk];
        assert!(world.run_until(ms(10_000), granted), "{}", world.trace());
    }
}

#[test]
fn greetings_of_two_runs_that_cross_leave_the_newer_link() {
    // The old run's greeting is still in flight when the new run's arrives.
    let mut config = WorldConfig::new(0);
    config.jitter = ms(0)..=ms(60);
    for seed in 0..40 {
        config.seed = seed;
        let Line { mut world, arm, cloud, .. } = line_with(config.clone());
        world.crash_unseen(arm, ms(10_000));
        world.run(ms(1));
        world.start(arm);
        world.run(ms(1000));
        assert_eq!(world.distance(cloud, &world.catalogue_name(arm)), Some(1), "{}", world.trace());
    }
}

#[test]
fn clean_shutdown_withdraws_names_at_once() {
    let Line { mut world, arm, cloud, desk } = flowing(5);
    let begin = world.elapsed();
    world.shut_down(arm);
    let at = world.until_event(desk, "loss", |e| {
        matches!(
            e,
            Event::Lost { reason: LostReason::Withdrawn | LostReason::Refused(RefuseReason::NotShared), .. }
        )
    });
    assert!(at - begin < ms(300), "{:?}", at - begin);
    world.run(ms(500));
    // Only the operator's own catalogue is left.
    let stats = world.stats(cloud);
    assert_eq!((stats.routed_names, stats.branches, stats.tombstones), (1, 0, 2));
    assert_eq!(world.status(desk, arm, "/chatter"), Some(JoinStatus::Waiting));
    let left = world
        .log()
        .iter()
        .any(|l| l.node == cloud && matches!(l.what, What::Closed { reason: LinkClose::Goodbye }));
    assert!(left, "the router was told goodbye");
}

#[test]
fn an_owner_that_falls_silent_is_forgotten_when_its_lease_ends() {
    let Line { mut world, arm, cloud, desk } = flowing(6);
    world.freeze(arm);
    world.run(ms(150_000));
    assert_eq!(world.status(desk, arm, "/chatter"), Some(JoinStatus::Granted), "its lease still holds");
    world.run(ms(152_000));
    assert_eq!(world.status(desk, arm, "/chatter"), Some(JoinStatus::Waiting));
    let stats = world.stats(cloud);
    assert_eq!((stats.routed_names, stats.branches), (1, 0));
    assert!(world.forwarding(cloud).is_empty());
    world.thaw(arm);
    assert_flows(&mut world, arm, desk);
}

#[test]
fn unlisted_node_is_refused_with_reason_and_sees_nothing() {
    let Line { mut world, arm, desk, .. } = line(7);
    world.share(arm, "/secret", Sharing::to(&[arm]));
    world.share(arm, "/chatter", Sharing::to(&[desk]));
    world.use_topic(desk, arm, "/secret");
    world.use_topic(desk, arm, "/chatter");
    assert_flows(&mut world, arm, desk);
    assert_eq!(world.catalogue_topics(desk, arm), ["/chatter"]);
    world.join_blindly(desk, arm, "/secret");
    let name = world.name(arm, "/secret");
    let by = RefusedBy::Owner(RefuseReason::NotPermitted);
    world.until_event(
        desk,
        "refusal",
        |e| matches!(e, Event::Refused { name: n, by: b } if *n == name && *b == by),
    );
    assert_eq!(world.status(desk, arm, "/secret"), Some(JoinStatus::Refused(by)));
    let peer = world.identity(desk).node_id();
    let said = world.log().iter().any(|l| {
        let reason = RefuseReason::NotPermitted;
        l.node == arm
            && matches!(&l.what, What::Event(Event::SinkRefused { name: n, peer: p, reason: r })
                if (n, p, r) == (&name, &peer, &reason))
    });
    assert!(said, "the owner learns whom it refused");
    world.publish(arm, "/secret");
    world.run(ms(1000));
    assert_eq!(world.received(desk, arm, "/secret"), []);
}

#[test]
fn members_of_a_listed_group_are_permitted_and_others_are_not() {
    let mut world = World::new(8);
    let (arm, cloud) = (world.proxy("arm-1"), world.router("cloud"));
    let operator = Member { groups: vec!["operators".to_owned()], ..Member::new("operator") };
    let (desk, guest) = (world.node(operator, false), world.proxy("guest"));
    for node in [arm, desk, guest] {
        world.link(node, cloud);
    }
    world.share(arm, "/chatter", Sharing::to_groups(&["operators"]));
    world.use_topic(desk, arm, "/chatter");
    world.use_topic(guest, arm, "/chatter");
    assert_flows(&mut world, arm, desk);
    assert_eq!(world.granted(arm, "/chatter"), [desk]);
    assert_eq!(world.catalogue_topics(guest, arm), Vec::<String>::new());
}

#[test]
fn a_topic_shared_while_running_appears_and_one_unshared_is_cut() {
    let Line { mut world, arm, cloud, desk } = line(9);
    world.use_topic(desk, arm, "/chatter");
    world.run(ms(3000));
    assert_eq!(world.catalogue_topics(desk, arm), Vec::<String>::new());
    let begin = world.elapsed();
    world.share(arm, "/chatter", Sharing::to_fleet());
    world.until_granted(desk, arm, "/chatter");
    assert!(world.elapsed() - begin < ms(1000), "it does not wait for a renewal or a retry");
    assert_flows(&mut world, arm, desk);
    world.unshare(arm, "/chatter");
    world.run(ms(500));
    assert_eq!(world.catalogue_topics(desk, arm), Vec::<String>::new());
    assert_eq!((world.status(desk, arm, "/chatter"), world.granted(arm, "/chatter")), (None, vec![]));
    assert!(!world.forwarding(cloud).contains(&world.name(arm, "/chatter")));
    assert_eq!(world.distance(cloud, &world.name(arm, "/chatter")), None);
    world.share(arm, "/chatter", Sharing::to_fleet());
    assert_flows(&mut world, arm, desk);
}

#[test]
fn a_withdrawn_name_does_not_come_back_with_a_router_that_connects_later() {
    let Line { mut world, arm, cloud, desk } = flowing(10);
    world.share(arm, "/old", Sharing::to_fleet());
    // A renewal puts both topics into one advertisement.
    world.run(ms(25_000));
    world.unshare(arm, "/old");
    world.run(ms(1000));
    let late = world.router("late");
    world.link(cloud, late);
    world.run(ms(1000));
    assert_eq!(world.distance(late, &world.name(arm, "/chatter")), Some(2), "it hears what there is");
    assert_eq!(world.distance(late, &world.name(arm, "/old")), None, "and not what there was");
    let _ = desk;
}

#[test]
fn a_late_joiner_gets_the_history_once_also_when_the_way_breaks() {
    let Line { mut world, arm, cloud, desk } = line(11);
    world.share(arm, "/map", Sharing::to_fleet().transient_local(3));
    let mut published: Vec<MessageId> = (0..5).map(|_| world.publish(arm, "/map")).collect();
    world.run(ms(1000));
    world.use_topic(desk, arm, "/map");
    world.until_granted(desk, arm, "/map");
    world.run(ms(1000));
    assert_eq!(world.received(desk, arm, "/map"), published[2..]);
    published.push(world.publish(arm, "/map"));
    world.run(ms(500));
    world.crash(cloud);
    world.run(ms(500));
    // No path carries this message. It comes from the history once there is a path again.
    published.push(world.publish(arm, "/map"));
    world.run(ms(500));
    world.start(cloud);
    world.until_granted(desk, arm, "/map");
    world.run(ms(1000));
    published.push(world.publish(arm, "/map"));
    world.run(ms(1000));
    assert_eq!(world.received(desk, arm, "/map"), published[2..], "{}", world.trace());
    // Another run of the sink knows nothing and gets the history again.
    world.restart(desk);
    world.until_granted(desk, arm, "/map");
    world.run(ms(1000));
    assert_eq!(world.received(desk, arm, "/map")[6..], published[5..]);
}

#[test]
fn each_user_gets_the_history_alone() {
    let Line { mut world, arm, cloud, desk } = line(12);
    let other = world.proxy("other");
    world.link(cloud, other);
    world.share(arm, "/map", Sharing::to_fleet().transient_local(5));
    let published: Vec<_> = (0..4).map(|_| world.publish(arm, "/map")).collect();
    world.use_topic(desk, arm, "/map");
    world.until_granted(desk, arm, "/map");
    world.run(ms(1000));
    world.use_topic(other, arm, "/map");
    world.until_granted(other, arm, "/map");
    world.run(ms(1000));
    assert_eq!(world.received(desk, arm, "/map"), published);
    assert_eq!(world.received(other, arm, "/map"), published);
    let replayed = |n| world.data_drops(n).iter().filter(|d| matches!(d, DataDrop::Sink(_))).count();
    assert_eq!((replayed(desk), replayed(other)), (0, 0), "nothing is sent to one who did not ask");
}

#[test]
fn a_megabyte_arrives_over_two_routers() {
    let mut world = World::new(13);
    let (arm, desk) = (world.proxy("arm-1"), world.proxy("desk"));
    let (east, west) = (world.router("east"), world.router("west"));
    world.link(arm, east);
    world.link(east, west);
    world.link(west, desk);
    world.share(arm, "/chatter", Sharing::to_fleet());
    world.use_topic(desk, arm, "/chatter");
    assert_flows(&mut world, arm, desk);
    let id = world.publish_bytes(arm, "/chatter", 1_000_003);
    world.run(ms(1000));
    assert_eq!(world.received(desk, arm, "/chatter").last(), Some(&id));
}

#[test]
fn best_effort_loses_what_the_network_loses_and_nothing_comes_twice() {
    let mut config = WorldConfig::new(14);
    config.loss_percent = 20;
    let Line { mut world, arm, desk, .. } = line_with(config);
    world.share(arm, "/chatter", Sharing::to_fleet().best_effort());
    world.use_topic(desk, arm, "/chatter");
    world.until_granted(desk, arm, "/chatter");
    world.run(ms(500));
    for _ in 0..200 {
        world.publish(arm, "/chatter");
        world.run(ms(5));
    }
    world.run(ms(500));
    let received = world.received(desk, arm, "/chatter");
    assert!((90..170).contains(&received.len()), "{} of 200 over two links that lose 20 %", received.len());
    assert!(received.is_sorted());
    assert_no_duplicates(&world);
}

/// Four routers in a ring with a chord; owner and user at opposite corners of it, the user at two.
struct Ring {
    world: World,
    arm: NodeKey,
    desk: NodeKey,
    routers: [NodeKey; 4],
    cables: Vec<(NodeKey, NodeKey)>,
}

fn ring(seed: u64) -> Ring {
    let mut world = World::new(seed);
    let routers = ["north", "east", "south", "west"].map(|n| world.router(n));
    let [north, east, south, west] = routers;
    let (arm, desk) = (world.proxy("arm-1"), world.proxy("desk"));
    let cables = vec![(north, east), (east, south), (south, west), (west, north), (north, south)];
    for (a, b) in cables.iter().chain(&[(north, arm), (south, desk), (west, desk)]) {
        world.link(*a, *b);
    }
    world.share(arm, "/chatter", Sharing::to_fleet());
    world.use_topic(desk, arm, "/chatter");
    assert_flows(&mut world, arm, desk);
    Ring { world, arm, desk, routers, cables }
}

fn assert_no_circle(world: &World, owner: NodeKey) {
    for name in [world.name(owner, "/chatter"), world.catalogue_name(owner)] {
        assert_eq!(world.circle(&name), None, "{}", world.trace());
    }
}

#[test]
fn a_ring_with_a_chord_carries_each_message_once_and_heals_after_every_cut() {
    for seed in 20..24 {
        let Ring { mut world, arm, desk, cables, .. } = ring(seed);
        for (a, b) in cables {
            world.cut(a, b);
            for _ in 0..40 {
                world.run(ms(100));
                assert_no_circle(&world, arm);
            }
            let begin = world.elapsed();
            assert_flows(&mut world, arm, desk);
            // At worst the next renewal opens another way.
            assert!(world.elapsed() - begin < ms(25_000));
            world.rejoin(a, b);
            world.run(ms(2000));
            assert_flows(&mut world, arm, desk);
        }
        let refused: Vec<_> = world.nodes().flat_map(|n| world.router_drops(n)).collect();
        assert!(!refused.contains(&"hop_limit") && !refused.contains(&"not_verified"), "{refused:?}");
    }
}

#[test]
fn a_ring_survives_the_loss_of_each_router_that_is_not_the_only_way() {
    let Ring { mut world, arm, desk, routers: [_, east, south, west], .. } = ring(25);
    for router in [east, south, west] {
        world.crash(router);
        assert_flows(&mut world, arm, desk);
        world.start(router);
        world.run(ms(1000));
        assert_flows(&mut world, arm, desk);
    }
}

#[test]
fn a_flow_moves_to_a_shorter_way_and_back_without_a_circle() {
    // The advertisement of a new topic together with an old one must not say anything false about the old one.
    let Ring { mut world, arm, desk, routers: [north, _, south, _], .. } = ring(26);
    for round in 0..4 {
        world.cut(north, south);
        world.run(ms(500));
        world.share(arm, &format!("/new-{round}"), Sharing::to_fleet());
        for _ in 0..100 {
            world.run(ms(50));
            assert_no_circle(&world, arm);
        }
        world.rejoin(north, south);
        assert_flows(&mut world, arm, desk);
        world.run(ms(25_000));
        assert_eq!(world.distance(south, &world.name(arm, "/chatter")), Some(2), "{}", world.trace());
        assert_flows(&mut world, arm, desk);
    }
}

/// Owner and user at opposite corners of four routers, with two equal ways and a cable for a shorter one.
fn diamond(seed: u64) -> (World, [NodeKey; 6]) {
    let mut world = World::with(WorldConfig { latency: ms(10)..=ms(10), ..WorldConfig::new(seed) });
    let [north, east, south, west] = ["north", "east", "south", "west"].map(|n| world.router(n));
    let (arm, desk) = (world.proxy("arm-1"), world.proxy("desk"));
    for (a, b) in [(north, east), (east, south), (south, west), (west, north), (north, south)] {
        world.link(a, b);
    }
    world.cut(north, south);
    world.link(arm, north);
    world.link(south, desk);
    world.share(arm, "/chatter", Sharing::to_fleet());
    world.use_topic(desk, arm, "/chatter");
    assert_flows(&mut world, arm, desk);
    (world, [north, east, south, west, arm, desk])
}

#[test]
fn an_equally_short_way_is_taken_at_once() {
    for seed in 50..60 {
        let (mut world, [_, _, south, _, arm, desk]) = diamond(seed);
        let used = world.next_hop(south, &world.name(arm, "/chatter")).expect("it flows");
        world.cut(used, south);
        let begin = world.elapsed();
        world.run(ms(200));
        world.until_granted(desk, arm, "/chatter");
        let took = world.elapsed() - begin;
        assert!(took < ms(2000), "it took {took:?}, as if it had waited for a renewal\n{}", world.trace());
        assert_flows(&mut world, arm, desk);
    }
}

#[test]
fn a_flow_moves_to_a_shorter_way_without_a_gap() {
    for seed in 60..70 {
        let (mut world, [north, _, south, _, arm, desk]) = diamond(seed);
        let name = world.name(arm, "/chatter");
        let mut published = Vec::new();
        let mut steadily = |world: &mut World, time: u64| {
            for _ in 0..time / 10 {
                published.push(world.publish(arm, "/chatter"));
                world.run(ms(10));
            }
        };
        steadily(&mut world, 500);
        world.rejoin(north, south);
        steadily(&mut world, 3000);
        assert_eq!(world.next_hop(south, &name), Some(north), "{}", world.trace());
        world.run(ms(500));
        let received = world.received(desk, arm, "/chatter");
        assert_eq!(received[received.len() - published.len()..], published, "{}", world.trace());
        assert_eq!(Model::from_world(&world).check(&world), Ok(()), "{}", world.trace());
    }
}

#[test]
fn an_owner_cut_off_from_a_ring_is_lost_at_once_without_counting_up() {
    for seed in 30..40 {
        let Ring { mut world, arm, desk, routers, .. } = ring(seed);
        world.cut(arm, routers[0]);
        for _ in 0..20 {
            world.run(ms(50));
            assert_no_circle(&world, arm);
        }
        for router in routers {
            assert_eq!(world.distance(router, &world.name(arm, "/chatter")), None, "{}", world.trace());
            assert!(!world.router_drops(router).contains(&"hop_limit"), "{}", world.trace());
        }
        assert_eq!(world.status(desk, arm, "/chatter"), Some(JoinStatus::Waiting));
        world.rejoin(arm, routers[0]);
        assert_flows(&mut world, arm, desk);
    }
}

#[test]
fn only_nodes_within_hop_limit_are_granted_and_others_have_no_route() {
    let mut world = World::new(40);
    let arm = world.proxy("arm-1");
    let mut chain = vec![arm];
    for n in 0..HOP_LIMIT + 2 {
        let router = world.router(&format!("router-{n}"));
        world.link(chain[chain.len() - 1], router);
        chain.push(router);
    }
    world.share(arm, "/chatter", Sharing::to_fleet());
    let users: Vec<_> = (60..67)
        .map(|far: usize| {
            let user = world.proxy(&format!("user-{far}"));
            world.link(chain[far - 1], user);
            world.use_topic(user, arm, "/chatter");
            (far, user)
        })
        .collect();
    world.run(ms(20_000));
    let id = world.publish(arm, "/chatter");
    world.run(ms(3000));
    for (far, user) in users {
        let granted = world.status(user, arm, "/chatter") == Some(JoinStatus::Granted);
        assert_eq!(granted, far < usize::from(HOP_LIMIT), "at {far} links");
        let received = world.received(user, arm, "/chatter");
        assert_eq!(received, if granted { vec![id] } else { vec![] }, "at {far} links");
    }
    let drops: Vec<_> = world.nodes().flat_map(|n| world.data_drops(n)).collect();
    assert!(!drops.contains(&DataDrop::HopLimit));
}

#[test]
fn branches_beyond_a_links_limit_are_refused_and_others_unharmed() {
    let mut config = WorldConfig::new(41);
    // The catalogue and one topic.
    config.router_limits = Limits { branches_per_peer_max: 2, ..Limits::default() };
    let Line { mut world, arm, cloud, desk } = line_with(config);
    let other = world.proxy("other");
    world.link(cloud, other);
    world.share(arm, "/chatter", Sharing::to_fleet());
    world.share(arm, "/more", Sharing::to_fleet());
    world.use_topic(desk, arm, "/chatter");
    assert_flows(&mut world, arm, desk);
    world.use_topic(desk, arm, "/more");
    let by = RefusedBy::Router(RejectReason::Limit);
    let name = world.name(arm, "/more");
    world.until_event(
        desk,
        "refusal",
        |e| matches!(e, Event::Refused { name: n, by: b } if *n == name && *b == by),
    );
    assert!(
        world.router_drops(arm).contains(&"limit")
            || world.router_drops(cloud).contains(&"limit")
            || world.router_drops(desk).contains(&"limit")
    );
    assert_flows(&mut world, arm, desk);
    world.stop_using(desk, arm, "/chatter");
    world.until_granted(desk, arm, "/more");
}

#[test]
fn branches_beyond_a_names_limit_are_refused_and_a_place_that_gets_free_is_taken() {
    let mut config = WorldConfig::new(45);
    config.router_limits = Limits { branches_per_name_max: 1, ..Limits::default() };
    let Line { mut world, arm, cloud, desk } = line_with(config);
    let other = world.proxy("other");
    world.link(cloud, other);
    world.share(arm, "/chatter", Sharing::to_fleet());
    for user in [desk, other] {
        world.join_blindly(user, arm, "/chatter");
    }
    world.run(ms(5000));
    let granted =
        |w: &World| [desk, other].map(|n| w.status(n, arm, "/chatter") == Some(JoinStatus::Granted));
    let first = granted(&world);
    assert!(first == [true, false] || first == [false, true], "{first:?}");
    assert!(world.router_drops(cloud).contains(&"limit"));
    let (lucky, waiting) = if first[0] { (desk, other) } else { (other, desk) };
    let by = RefusedBy::Router(RejectReason::Limit);
    world.until_event(waiting, "refusal", |e| matches!(e, Event::Refused { by: b, .. } if *b == by));
    world.crash(lucky);
    world.until_granted(waiting, arm, "/chatter");
}

#[test]
fn routes_beyond_a_proxys_limit_are_refused_and_others_unharmed() {
    let mut config = WorldConfig::new(42);
    config.router_limits = Limits { names_per_owner_max: 3, ..Limits::default() };
    let Line { mut world, arm, cloud, desk } = line_with(config);
    let greedy = world.proxy("greedy");
    world.link(cloud, greedy);
    for n in 0..10 {
        world.share(greedy, &format!("/{n}"), Sharing::to_fleet());
    }
    world.share(arm, "/chatter", Sharing::to_fleet());
    world.use_topic(desk, arm, "/chatter");
    assert_flows(&mut world, arm, desk);
    assert!(world.router_drops(cloud).contains(&"limit"));
    // Three names of the greedy node, two of the robot, one of the operator.
    assert_eq!(world.stats(cloud).routed_names, 3 + 2 + 1);
    world.run(ms(50_000));
    assert_eq!(world.stats(cloud).routed_names, 3 + 2 + 1, "renewals do not get around it");
    assert_flows(&mut world, arm, desk);
}

#[test]
fn interests_beyond_a_links_limit_are_refused_and_others_unharmed() {
    let mut config = WorldConfig::new(43);
    config.router_limits = Limits { interests_per_peer_max: 4, ..Limits::default() };
    let Line { mut world, arm, cloud, desk } = line_with(config);
    world.share(arm, "/chatter", Sharing::to_fleet());
    world.use_topic(desk, arm, "/chatter");
    assert_flows(&mut world, arm, desk);
    let names: Vec<_> = (0..100).map(|n| sgc_wire::Name([n; 32])).collect();
    world.inject(desk, cloud, &sgc_wire::Control::Interest { names });
    world.run(ms(500));
    assert_eq!(world.router_drops(cloud).iter().filter(|d| **d == "limit").count(), 1);
    // Two names of the robot, one of the operator, and two requested names that do not exist.
    assert_eq!(world.stats(cloud).names, 3 + 2);
    assert_flows(&mut world, arm, desk);
}

#[test]
fn a_slow_owner_is_given_up_in_time_and_asked_again() {
    let Line { mut world, arm, desk, .. } = line(44);
    world.share(arm, "/chatter", Sharing::to_fleet());
    world.run(ms(1000));
    world.freeze(arm);
    world.use_topic(desk, arm, "/chatter");
    let by = RefusedBy::Router(RejectReason::TimedOut);
    let begin = world.elapsed();
    let at =
        world.until_event(desk, "refusal", |e| matches!(e, Event::OwnerRefused { by: b, .. } if *b == by));
    assert!((ms(10_000)..ms(11_000)).contains(&(at - begin)), "{:?}", at - begin);
    world.thaw(arm);
    assert_flows(&mut world, arm, desk);
    world.run(ms(20_000));
    assert_eq!(Model::from_world(&world).check(&world), Ok(()));
}
