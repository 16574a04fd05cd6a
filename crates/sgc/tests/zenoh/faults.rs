//! Zenoh routers, nodes of `sgc` and programs that are killed and started again: no message comes twice, the graph has no
//! endpoint of a program that is gone, and a node does not grow.
//!
//! `SGC_ZENOH_RESTARTS` is the number of restarts of programs, for a longer run.

use rustix::process::Signal;

use crate::graph::end;
use crate::lab::{Site, robot_to_desk};
use crate::networks::Middleware::Zenoh;
use crate::networks::{ENDS, Networks};
use crate::support::{Peer, environment, eventually, say};
use crate::{CASES, counts};

const RESTARTS: u64 = 10;
/// Bound of the memory that a node may hold beyond that after its first programs.
const RESIDENT_MORE_KB_MAX: u64 = 20_000;
/// Numbers of a publisher's run begin at its count times this.
const RUN_NUMBERS: u64 = 100_000;

/// Starts a publisher that publishes until it is ended, from this number on.
pub(crate) fn talk(networks: &Networks, first: u64) -> Peer {
    let pace = ["--topic", "/load", "--rate", "20", "--wait-matched", "0", "--depth", "0"];
    // The load generator on DDS begins at 0.
    let begin: &[&str] = if first == 0 { &[] } else { &["--start", &first.to_string()] };
    networks.load_on(Site::Robot, "pub", "talker", &[&pace, begin].concat())
}

/// Starts a subscriber.
pub(crate) fn hear(networks: &Networks) -> Peer {
    networks.load_on(Site::Desk, "sub", "listener", &["--topic", "/load", "--depth", "0", "--verbose"])
}

/// Returns the number of the next message beyond one.
fn heard_beyond(listener: &mut Peer, seq: u64) -> u64 {
    let is_beyond = |event: &serde_json::Value| event["seq"].as_u64() > Some(seq);
    let event = listener
        .wait(&format!("a message beyond {seq}"), |event| event["event"] == "received" && is_beyond(event));
    event["seq"].as_u64().unwrap()
}

/// Returns the number of the first message that comes from now on.
pub(crate) fn heard_now(listener: &mut Peer) -> u64 {
    let reported = listener.events.try_iter().filter_map(|(_, event)| event["seq"].as_u64()).max();
    let next = listener.wait("a message", |event| event["event"] == "received")["seq"].as_u64().unwrap();
    assert!(Some(next) > reported, "{next} after {reported:?}");
    next
}

/// Asserts that no message came twice or late to a subscriber that is ended now. Returns the number of missing ones.
pub(crate) fn assert_once(mut listener: Peer, what: &str) -> u64 {
    listener.end();
    let summary = listener.summary();
    let [lost, faults @ ..] = counts(&summary, ["lost", "duplicated", "altered", "reordered"]);
    assert_eq!(faults, [0; 3], "{what}: {summary}");
    lost
}

/// Waits until the graphs at both sites have the publisher and the subscriber, and no others.
fn assert_both_shown(networks: &Networks) {
    let both = [end("publisher", "talker"), end("subscription", "listener")];
    networks.assert_ends(Site::Desk, "/load", both.to_vec());
    let and_sgc = both.into_iter().chain([end("subscription", "sgc_robot")]).collect();
    networks.assert_ends(Site::Robot, "/load", and_sgc);
}

/// Returns whether a node reports that its Zenoh router is missing.
pub(crate) fn misses_router(networks: &Networks, site: Site) -> bool {
    let status = networks.status(site);
    status["alerts"].as_array().into_iter().flatten().any(|alert| alert["kind"] == "zenoh_router_missing")
}

#[test]
fn killed_routers_interrupt_no_topic_and_new_programs_join_after_their_restart() {
    let tables = robot_to_desk("topic", ["/load"]);
    let Some(mut networks) = Networks::start([Zenoh, Zenoh], tables) else { return };
    let (_talker, mut listener) = (talk(&networks, 0), hear(&networks));
    heard_now(&mut listener);
    networks.routers = [None, None];
    for site in ENDS {
        eventually("the router is missed", || misses_router(&networks, site));
    }
    // Programs of one host reach each other without their router.
    let before = heard_now(&mut listener);
    ENDS.into_iter().for_each(|site| networks.start_router(site));
    for site in ENDS {
        eventually("the router is back", || !misses_router(&networks, site));
    }
    let mut late = hear(&networks);
    heard_now(&mut late);
    heard_beyond(&mut listener, before);
    assert_once(late, "a subscriber after the restart");
    assert_eq!(assert_once(listener, "a subscriber all along"), 0);
    let mut listener = hear(&networks);
    heard_now(&mut listener);
    assert_both_shown(&networks);
}

#[test]
fn topics_continue_once_a_killed_node_is_back() {
    for on in CASES {
        let Some(mut networks) = Networks::start(on, robot_to_desk("topic", ["/load"])) else { return };
        let (_talker, mut listener) = (talk(&networks, 0), hear(&networks));
        let sites: Vec<_> = ENDS.into_iter().filter(|site| networks.at(*site) == Zenoh).collect();
        for site in sites {
            heard_now(&mut listener);
            networks.end(site, Signal::KILL);
            networks.start(site);
            // Messages before the restart are reported already, or come at most until then.
            eventually("a route", || networks.status(site)["routes"][0]["messages"].as_u64() > Some(0));
            heard_now(&mut listener);
        }
        assert_once(listener, &format!("{on:?}"));
        let mut listener = hear(&networks);
        heard_now(&mut listener);
        assert_both_shown(&networks);
    }
}

#[test]
fn killed_programs_leave_neither_endpoints_nor_memory() {
    let restarts = environment("SGC_ZENOH_RESTARTS", RESTARTS);
    let tables = robot_to_desk("topic", ["/load"]);
    let Some(networks) = Networks::start([Zenoh, Zenoh], tables) else { return };
    let (mut talker, mut listener) = (talk(&networks, RUN_NUMBERS), hear(&networks));
    heard_now(&mut listener);
    let held = || ENDS.map(|site| networks.node(site).held());
    let mut begun = held();
    for restart in 2..2 + restarts {
        if restart % 2 == 0 {
            drop(talker);
            talker = talk(&networks, restart * RUN_NUMBERS);
            heard_beyond(&mut listener, restart * RUN_NUMBERS);
        } else {
            drop(listener);
            listener = hear(&networks);
            heard_now(&mut listener);
        }
        if restart == 5 {
            begun = held();
        }
    }
    assert_both_shown(&networks);
    assert_once(listener, "the last subscriber");
    drop(talker);
    ENDS.into_iter().for_each(|site| networks.assert_ends(site, "/load", vec![]));
    for (before, after) in begun.iter().zip(held()) {
        say(&format!("zenoh: {restarts} restarts, held {before:?}, then {after:?}"));
        assert!(after.resident_kb < before.resident_kb + RESIDENT_MORE_KB_MAX, "{before:?}, {after:?}");
    }
    for site in ENDS {
        assert!(!networks.log(site).contains("panicked"), "{}", networks.log(site));
    }
}
