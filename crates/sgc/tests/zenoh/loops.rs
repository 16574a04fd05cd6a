//! Networks that are joined more than once: two nodes of `sgc` on one Zenoh network, and one node on a DDS and a Zenoh
//! network of its robot.

use std::collections::BTreeSet;

use crate::lab::{Site, robot_to_desk, share, uses};
use crate::networks::Middleware::{Dds, Zenoh};
use crate::networks::Networks;
use crate::support::Peer;
use crate::{PLAN, counts, services};

const MESSAGES: u64 = 100;
/// The first number of the second publisher of a topic.
const SECOND: u64 = 1_000_000;

#[test]
fn two_nodes_on_one_network_make_no_loop() {
    let tables = robot_to_desk("topic", ["/load"]);
    let Some(mut networks) = Networks::silent([Zenoh, Zenoh], tables) else { return };
    // The desk's node moves into the robot's network.
    let [far, near] = [Site::Desk, Site::Robot].map(|site| networks.cloud_address(site));
    networks.reconfigure(Site::Desk, &far, &near);
    networks.start_routers();
    networks.start(Site::Cloud);
    networks.start(Site::Robot);
    networks.start_at(Site::Desk, Site::Robot);
    let topic = ["--topic", "/load", "--depth", "0"];
    let mut listener = networks.load_on(Site::Robot, "sub", "listener", &topic);
    let count = MESSAGES.to_string();
    let pace = ["--count", &count, "--rate", "50", "--wait-matched", "2", "--wait-go", "--hold", "1"];
    let mut talker = networks.load_on(Site::Robot, "pub", "talker", &[&topic[..], &pace].concat());
    // The talker itself and the desk's writer, the listener and the robot's reader.
    for (peer, what) in [(&mut listener, "both publishers"), (&mut talker, "both subscribers")] {
        peer.wait(what, |event| event["event"] == "matched" && event["count"].as_u64() >= Some(2));
    }
    talker.go();
    talker.summary();
    listener.end();
    let summary = listener.summary();
    // Each message comes directly and once more through the router, never a third time.
    let found = counts(&summary, ["received", "duplicated", "altered", "numbers_repeated"]);
    assert_eq!(found, [MESSAGES, MESSAGES, 0, 0], "{summary}");
    for site in [Site::Robot, Site::Desk] {
        let messages = &networks.status(site)["routes"][0]["messages"];
        assert_eq!(*messages, MESSAGES, "{}", networks.status(site));
    }
}

/// Reads reports until the last message of each publisher has come, which begin with these numbers. Asserts that each came
/// once, from the first one on. A reader of DDS may be matched too late for the first message, and on a busy machine also
/// for some of those that follow a second later.
fn assert_heard(listener: &mut Peer, firsts: &[u64], what: &str) {
    let ranges: Vec<_> = firsts.iter().map(|first| *first..first + MESSAGES).collect();
    let mut heard = BTreeSet::new();
    while !ranges.iter().all(|range| heard.contains(&(range.end - 1))) {
        let event =
            listener.wait(&format!("the last of {what}, after {heard:?}"), |e| e["event"] == "received");
        let seq = event["seq"].as_u64().unwrap();
        assert!(heard.insert(seq), "{what}: {seq} came twice");
    }
    for range in ranges {
        let of: Vec<_> = heard.range(range.clone()).copied().collect();
        let whole = of[0]..range.end;
        assert!(of.iter().copied().eq(whole.clone()), "{what}: {of:?}");
        assert!(whole.start < range.start + MESSAGES / 2, "{what}: {of:?}");
    }
}

/// Starts a publisher or a subscriber of one network of the robot.
fn at_robot(networks: &Networks, on_zenoh: bool, role: &str, args: &[&str]) -> Peer {
    match on_zenoh {
        true => networks.load_on(Site::Robot, role, "of_zenoh", args),
        false => {
            let node = ["--node", "of_dds", "--timeout", PLAN.peer_life];
            networks.load(Site::Robot, "jazzy", &[&[role], &node[..], args].concat())
        }
    }
}

#[test]
fn far_programs_hear_both_networks_of_a_robot_and_are_heard_on_both() {
    for desk in [Zenoh, Dds("kilted")] {
        let up = robot_to_desk("topic", ["/up"]);
        let down = [uses("topic", "/down", "desk"), share("topic", "/down", "robot")];
        let services = robot_to_desk("service", ["/on_dds", "/on_zenoh"]);
        let tables = [0, 1].map(|end| [&up[end], &*down[end], &services[end]].concat());
        let Some(mut networks) = Networks::silent([Zenoh, desk], tables) else { return };
        let both = "middleware = \"both\"\ndiscovery_range = \"subnet\"\n";
        networks.reconfigure(Site::Robot, "middleware = \"zenoh\"\n", both);
        networks.start_routers();
        networks.start_all();
        let what = format!("{desk:?}");
        let count = MESSAGES.to_string();

        let up = ["--topic", "/up", "--depth", "0"];
        let mut listener =
            networks.load_on(Site::Desk, "sub", "listener", &[&up[..], &["--verbose"]].concat());
        let pace = ["--count", &count, "--rate", "50", "--wait-go", "--begin", "1", "--hold", "1"];
        let second = SECOND.to_string();
        let starts: [&[&str]; 2] = [&[], &["--start", &second]];
        let mut talkers = [false, true].map(|on_zenoh| {
            let args = [&up, &pace[..], starts[usize::from(on_zenoh)]].concat();
            let mut talker = at_robot(&networks, on_zenoh, "pub", &args);
            talker.wait_matched("a match of each publisher");
            talker
        });
        listener.wait("both publishers", |event| event["event"] == "matched" && event["count"] == 2);
        talkers.iter_mut().for_each(Peer::go);
        assert_heard(&mut listener, &[0, SECOND], &what);
        talkers.iter_mut().for_each(|talker| drop(talker.summary()));
        listener.end();
        let summary = listener.summary();
        assert_eq!(summary["duplicated"], 0, "{what}: {summary}");

        let down = ["--topic", "/down", "--depth", "0"];
        let mut listeners = [false, true]
            .map(|on_zenoh| at_robot(&networks, on_zenoh, "sub", &[&down[..], &["--verbose"]].concat()));
        let mut talker = networks.load_on(Site::Desk, "pub", "talker", &[&down[..], &pace].concat());
        talker.wait_matched("a match at the publisher");
        listeners.iter_mut().for_each(|listener| listener.wait_matched("a match of each subscriber"));
        talker.go();
        for listener in &mut listeners {
            assert_heard(listener, &[0], &what);
        }
        talker.summary();
        for mut listener in listeners {
            listener.end();
            let summary = listener.summary();
            assert_eq!(summary["duplicated"], 0, "{what}: {summary}");
        }

        let _servers = [
            services::serve(&networks, Dds("jazzy"), "/on_dds"),
            services::serve(&networks, Zenoh, "/on_zenoh"),
        ];
        let clients = ["/on_dds", "/on_zenoh"].map(|name| services::call(&networks, name, "client"));
        clients.into_iter().for_each(|client| services::assert_answered(client, &what));
    }
}
