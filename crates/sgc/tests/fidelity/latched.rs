//! Latched topics many to many, between programs that are not ours.

use std::collections::BTreeMap;

use crate::PLAN;
use crate::lab::{Lab, Site};
use crate::support::{Peer, eventually};

const COMMON: [&str; 5] = ["--type", "string", "--topic", "/tf_static", "--transient-local"];

/// A publisher that says `count` messages from the number `start` on, which the node near it has in its hands then, and
/// stays. Were the node only about to meet it, what it is given as history and what it hears live would depend on
/// who is quicker.
fn talker(lab: &Lab, vendor: &str, depth: &str, start: &str, count: &str) -> Peer {
    let said = ["--depth", depth, "--start", start, "--count", count, "--rate", "0"];
    let stays = ["--wait-matched", "1", "--hold", "2000"];
    let mut talker = lab.peer(Site::Robot, vendor, "pub", &[&COMMON[..], &said, &stays].concat());
    let sent = talker.wait("all sent", |e| e["event"] == "all_sent");
    assert_eq!(sent["acknowledged"], true, "{sent}");
    talker
}

fn listener(lab: &Lab, vendor: &str) -> Peer {
    lab.peer(Site::Desk, vendor, "sub", &[&COMMON[..], &["--depth", "100", "--verbose"]].concat())
}

/// Waits until each of these numbers was heard, and fails if one was twice.
fn hears(listener: &mut Peer, expected: impl Iterator<Item = u64>) {
    let mut missing: BTreeMap<u64, bool> = expected.map(|seq| (seq, true)).collect();
    let all = missing.len();
    for n in 0..all {
        let event = listener.wait(&format!("{n} of {all}"), |e| e["event"] == "received");
        let seq = event["seq"].as_u64().unwrap();
        assert_eq!(
            missing.insert(seq, false),
            Some(true),
            "{seq} is none of those that are missing: {missing:?}"
        );
    }
}

/// Ends a listener, of which all that it heard has been looked at.
fn heard_nothing_else(mut listener: Peer, expected: usize) {
    listener.end();
    let summary = listener.summary();
    let count = |key: &str| summary[key].as_u64().unwrap();
    assert_eq!(
        (count("received"), count("duplicated"), count("altered")),
        (expected as u64, 0, 0),
        "{summary}"
    );
}

#[test]
fn five_nodes_and_two_vendors_latch_on_one_topic() {
    let mut lab = Lab::with_topics(PLAN, ["/tf_static"]);
    let mut talkers: Vec<_> = ["cyclone", "fastdds", "cyclone", "fastdds", "cyclone"]
        .into_iter()
        .enumerate()
        .map(|(n, vendor)| talker(&lab, vendor, "1", &format!("{}", n * 1000), "3"))
        .collect();
    let last = |n: u64| n * 1000 + 2;
    let mut early = listener(&lab, "cyclone");
    hears(&mut early, (0..5).map(last));
    // The node of those who publish is killed and comes back: who heard it does not hear it again, who is late does.
    lab.kill(Site::Robot);
    lab.start(Site::Robot);
    eventually("the history is known again", || {
        lab.status(Site::Desk)["drops"]["repeated"].as_u64() >= Some(5)
    });
    let mut late = listener(&lab, "fastdds");
    hears(&mut late, (0..5).map(last));
    // So it is with a router.
    lab.kill(Site::Cloud);
    // One publisher ends while it is away, and what it latched with it; another takes its place.
    let mut gone = talkers.remove(2);
    gone.end();
    gone.summary();
    talkers.push(talker(&lab, "fastdds", "1", "9000", "1"));
    lab.start(Site::Cloud);
    hears(&mut early, std::iter::once(9000));
    hears(&mut late, std::iter::once(9000));
    let now = [0, 1, 3, 4].map(last).into_iter().chain(std::iter::once(9000));
    let mut last_of_all = listener(&lab, "cyclone");
    hears(&mut last_of_all, now);
    for (listener, heard) in [(early, 6), (late, 6), (last_of_all, 5)] {
        heard_nothing_else(listener, heard);
    }
}

#[test]
fn histories_are_as_deep_as_their_publishers() {
    let mut lab = Lab::with_topics(PLAN, ["/tf_static"]);
    lab.kill(Site::Desk);
    let _deep = talker(&lab, "cyclone", "40", "0", "60");
    let _map = talker(&lab, "cyclone", "1", "1000", "10");
    let _all = talker(&lab, "cyclone", "0", "2000", "30");
    let expected = || (20..60).chain([1009]).chain(2000..2030);
    eventually("the robot's node has it", || {
        lab.status(Site::Robot)["routes"][0]["messages"].as_u64() >= Some(71)
    });
    lab.start(Site::Desk);
    for vendor in ["cyclone", "fastdds"] {
        let mut listener = listener(&lab, vendor);
        hears(&mut listener, expected());
        heard_nothing_else(listener, 71);
    }
}
