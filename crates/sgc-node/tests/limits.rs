//! What happens where there is more to carry than may be, or can be, carried: whole nodes over real QUIC.

#![allow(clippy::unwrap_used)]

mod support;

use std::time::{Duration, Instant};

use sgc_node::config::Config;
use sgc_wire::{History, Qos, Reliability};
use support::*;

/// Reliable, and nothing is forgotten.
fn all() -> Qos {
    Qos { history: History::KeepAll, ..Qos::default() }
}

fn best_effort() -> Qos {
    Qos { reliability: Reliability::BestEffort, ..all() }
}

/// What a node counts for its links to a peer.
fn of_peer(node: &Node, peer: &str, what: &str) -> u64 {
    let status = node.status();
    let links = status["links"].as_array().unwrap().iter();
    links.filter(|l| l["peer"] == peer).map(|l| l[what].as_u64().unwrap()).sum()
}

#[test]
fn a_peer_over_its_rate_is_slowed_where_it_can_wait_and_loses_what_cannot() {
    const RATE: u64 = 2_000_000;
    let trio = Trio::new();
    let cloud = trio.cloud_with(|config: &mut Config| config.peer_rate = Some(RATE));
    let _robot = trio.robot(&["/slow", "/fast"], "desk");
    let _desk = trio.desk(&["/slow", "/fast"]);
    let slow = Talker::new(&trio.robot_net, "/slow", all());
    let fast = Talker::new(&trio.robot_net, "/fast", best_effort());
    let hears_slow = Listener::new(&trio.desk_net, "/slow", all());
    let hears_fast = Listener::new(&trio.desk_net, "/fast", best_effort());
    for (talker, listener) in [(&slow, &hears_slow), (&fast, &hears_fast)] {
        talker.wait_for_readers(1);
        listener.hears_at_last(|n| talker.say(format!("warm {n}")));
    }
    let [robots, desks] = ["robot", "desk"].map(|node| identity(node, false).node_id().to_string());
    let over = |peer: &str| (of_peer(&cloud, peer, "peer_slowed"), of_peer(&cloud, peer, "peer_dropped"));
    assert_eq!((over(&robots), over(&desks)), ((0, 0), (0, 0)));

    // Reliable: all of it, in order, and not before its time. Half a second's worth may have been saved up.
    let begun = Instant::now();
    let payload = |n: u8| vec![n; 25_000];
    (0..40).for_each(|n| slow.say(payload(n)));
    let mut next = 0;
    while next < 40 {
        let heard = hears_slow.samples.recv_timeout(PATIENCE).expect("all arrive");
        if heard.len() == 25_000 {
            assert_eq!(heard[0], next);
            next += 1;
        }
    }
    let least = Duration::from_millis((1_000_000 - 262_144) * 8000 / RATE);
    assert!(begun.elapsed() >= least, "1 MB in {:?}", begun.elapsed());
    let (slowed, dropped) = over(&robots);
    assert!(slowed > 0 && dropped == 0, "{slowed} slowed, {dropped} dropped");

    // Best effort: what is over it is gone, and counted under the peer's name.
    let deadline = Instant::now() + PATIENCE;
    let mut said = 0;
    while over(&robots).1 == 0 {
        assert!(Instant::now() < deadline, "nothing is dropped");
        for _ in 0..100 {
            fast.say(vec![9; 1000]);
            said += 1;
        }
    }
    let dropped = over(&robots).1;
    assert!(hears_fast.drain().len() as u64 + dropped <= said + 100);
    let drops = cloud.status()["drops"].clone();
    assert!(drops["over_rate"].as_u64().unwrap() >= dropped, "{drops}");
    assert!(drops[format!("over_rate from {}", &robots[..8])].as_u64().unwrap() >= dropped, "{drops}");
    assert_eq!(over(&desks), (0, 0));
}
