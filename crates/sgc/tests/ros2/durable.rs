//! `transient_local`: late joiners on the far side get as much as natively, though Fast DDS announces no depth.

use rustix::process::Signal;
use serde_json::Value;

use crate::lab::{Lab, Site, robot_to_desk};
use crate::support::{Peer, eventually};
use crate::{PAIRS, PLAN, count};

const MESSAGES: u64 = 20;

/// Names of topics, the depths of their publishers (`load.c`: 0 keeps all), and the number of messages that late
/// joiners get.
const LATCHED: [(&str, &str, u64); 4] =
    [("last", "1", 1), ("five", "5", 5), ("ten", "10", 10), ("all", "0", MESSAGES)];

/// Starts a publisher that waits for readers, sends its messages and stays.
fn latch(
    lab: &Lab,
    site: Site,
    distribution: &str,
    topic: &str,
    depth: &str,
    count: u64,
    matched: &str,
) -> Peer {
    let count = count.to_string();
    let said = ["pub", "--topic", topic, "--transient-local", "--depth", depth, "--count", &count];
    let stays = ["--rate", "50", "--wait-matched", matched, "--hold", "110", "--timeout", PLAN.peer_life];
    started(lab.load(site, distribution, &[&said[..], &stays].concat()))
}

/// Waits until a program has joined its network. Fast DDS programs that join at the same instant may miss others.
fn started(mut program: Peer) -> Peer {
    program.wait("an endpoint", |event| event["event"] == "ready");
    program
}

fn has_sent(publisher: &mut Peer) {
    publisher.wait("all sent", |event| event["event"] == "all_sent");
}

/// Starts a subscriber at the desk that waits for so many messages, and then for more.
fn listen(lab: &Lab, distribution: &str, topic: &str, expected: u64) -> Peer {
    let expected = expected.to_string();
    let asks = ["sub", "--topic", topic, "--transient-local", "--depth", "0", "--count", &expected];
    let stays = ["--linger", "1", "--timeout", PLAN.peer_life];
    started(lab.load(Site::Desk, distribution, &[&asks[..], &stays].concat()))
}

/// Asserts that these messages came once each and in order.
fn assert_heard(summary: &Value, first: u64, expected: u64, what: &str) {
    let counts =
        ["received", "first", "last", "duplicated", "altered", "reordered"].map(|key| count(summary, key));
    assert_eq!(counts, [expected, first, MESSAGES - 1, 0, 0, 0], "{what}: {summary}");
}

/// Returns a topic that only these publishers have, because a killed one is missed later.
fn topic(under: &str, name: &str) -> String {
    format!("/{under}/{name}")
}

/// Starts publishers of all depths, which have sent all messages.
fn latch_all(lab: &Lab, site: Site, talks: &str, under: &str, matched: &str) -> [Peer; 4] {
    let latch = |(name, depth, _)| latch(lab, site, talks, &topic(under, name), depth, MESSAGES, matched);
    let mut publishers = LATCHED.map(latch);
    publishers.iter_mut().for_each(has_sent);
    publishers
}

/// Asserts that late joiners at the desk get as much as the publishers keep.
fn assert_late_joiners(lab: &Lab, listens: &str, under: &str, what: &str) {
    let late = LATCHED.map(|(name, _, expected)| listen(lab, listens, &topic(under, name), expected));
    for (mut late, (name, _, expected)) in late.into_iter().zip(LATCHED) {
        let what = format!("{what}, {under} to {listens}, {name}");
        assert_heard(&late.summary(), MESSAGES - expected, expected, &what);
    }
}

/// Waits until the last of so many messages has reached the desk.
fn wait_for_last(lab: &Lab, distribution: &str, topic: &str, count: u64) {
    let count = count.to_string();
    let ends = ["sub", "--topic", topic, "--transient-local", "--last", &count, "--timeout", PLAN.peer_life];
    lab.load(Site::Desk, distribution, &ends).summary();
}

#[test]
fn late_joiners_get_as_much_as_their_publishers_keep() {
    let topics: Vec<_> =
        PAIRS.iter().flat_map(|[talks, _]| LATCHED.map(|(name, ..)| topic(talks, name))).collect();
    let mut lab = Lab::real(PLAN, robot_to_desk("topic", topics));
    for [talks, listens] in PAIRS {
        // Topics that `sgc` does not carry.
        let under = format!("native/{talks}");
        let _publishers = latch_all(&lab, Site::Desk, talks, &under, "0");
        assert_late_joiners(&lab, listens, &under, "natively");
    }
    for [talks, listens] in PAIRS {
        let mut early = listen(&lab, listens, &topic(talks, "five"), MESSAGES + 1);
        let _publishers = latch_all(&lab, Site::Robot, talks, talks, "1");
        for (name, ..) in LATCHED {
            wait_for_last(&lab, listens, &topic(talks, name), MESSAGES);
        }
        assert_late_joiners(&lab, listens, talks, "late");
        // The node at the robot comes back. A subscriber that had all messages gets none again; a late one gets them.
        let repeated = || lab.status(Site::Desk)["drops"]["repeated"].as_u64().unwrap_or(0);
        let wanted = repeated() + LATCHED.iter().map(|(.., expected)| expected).sum::<u64>();
        lab.end(Site::Robot, Signal::KILL);
        lab.start(Site::Robot);
        eventually("the history is known again", || {
            lab.status(Site::Desk)["drops"]["repeated"].as_u64() >= Some(wanted)
        });
        assert_late_joiners(&lab, listens, talks, "after a restart");
        early.end();
        // It may have been matched after the first messages.
        let summary = early.summary();
        let first = count(&summary, "first");
        assert_heard(&summary, first, MESSAGES - first, "all along");
    }
}

/// As natively of a latched publisher that starts again: the far node's writer is another one to a subscriber that has
/// it all.
#[test]
fn restart_beside_a_latched_subscriber_repeats_what_is_kept_once_and_loses_nothing() {
    let pairs = PAIRS.iter().flat_map(|pair| [(pair, 1), (pair, 5)]);
    let topics = pairs.clone().map(|([talks, _], depth)| topic(talks, &format!("kept_{depth}")));
    let mut lab = Lab::real(PLAN, robot_to_desk("topic", topics.clone()));
    let mut all: Vec<_> = pairs
        .zip(topics)
        .map(|(([talks, listens], depth), topic)| {
            let latched = ["--transient-local", "--topic", &topic];
            let hears = [&["sub", "--depth", "100"][..], &latched].concat();
            let listener = started(lab.rclpy(Site::Desk, listens, "events.py", &hears));
            let count = depth.to_string();
            let says =
                [&["pub", "--depth", &count, "--count", &count, "--rate", "20"][..], &latched].concat();
            (started(lab.rclpy(Site::Robot, talks, "events.py", &says)), listener, depth)
        })
        .collect();
    // Reads all messages up to this number.
    let heard = |listener: &mut Peer, last: u64| {
        let mut seqs = Vec::new();
        while seqs.last() != Some(&last) {
            let event = listener.wait(&format!("message {last}"), |event| event["event"] == "received");
            seqs.push(count(&event, "seq"));
        }
        seqs
    };
    for (_, listener, depth) in &mut all {
        assert_eq!(heard(listener, *depth - 1), Vec::from_iter(0..*depth));
    }
    lab.end(Site::Desk, Signal::KILL);
    lab.start(Site::Desk);
    for (talker, listener, depth) in &mut all {
        assert_eq!(heard(listener, *depth - 1), Vec::from_iter(0..*depth), "repeated");
        talker.tell("1");
        assert_eq!(heard(listener, *depth), [*depth], "and no more");
    }
    lab.end(Site::Desk, Signal::TERM);
    // As many as the publisher keeps are said meanwhile, or a moment later.
    all.iter_mut().for_each(|(talker, _, depth)| talker.tell(&depth.to_string()));
    lab.start(Site::Desk);
    for (talker, listener, depth) in &mut all {
        let (first_new, last) = (*depth + 1, 2 * *depth);
        let seqs = heard(listener, last);
        assert!(seqs[0] <= first_new, "{seqs:?}");
        assert_eq!(seqs, Vec::from_iter(seqs[0]..=last), "once each, in their order");
        talker.tell("1");
        assert_eq!(heard(listener, last + 1), [last + 1], "and no more");
    }
}

/// A late joiner gets messages of each latched publisher of a topic, not only of the last one.
#[test]
fn late_joiners_hear_each_latched_publisher_of_a_topic() {
    let topics = PAIRS.map(|[talks, _]| topic(talks, "tf_static"));
    let lab = Lab::real(PLAN, robot_to_desk("topic", &topics));
    for ([talks, listens], topic) in PAIRS.into_iter().zip(&topics) {
        // Their last messages are those with the numbers 2, 4 and 6, and the first of them may be lost on their own
        // network.
        let _publishers = [3, 5, 7].map(|count| {
            let publisher = latch(&lab, Site::Robot, talks, topic, "1", count, "1");
            wait_for_last(&lab, listens, topic, count);
            publisher
        });
        let mut late = listen(&lab, listens, topic, 3);
        let summary = late.summary();
        let counts = ["received", "first", "last", "duplicated"].map(|key| count(&summary, key));
        assert_eq!(counts, [3, 2, 6, 0], "{talks} to {listens}: {summary}");
    }
}

/// A map, and what nodes log, reach a late subscriber as they would on the publisher's network.
#[test]
fn late_joiners_get_the_map_and_the_log() {
    for [talks, listens] in PAIRS {
        // Anew: the log of the other pair is of use for a while.
        let lab = Lab::real(PLAN, robot_to_desk("topic", ["/map", "/rosout"]));
        let rclpy = |site, distribution, role, topic| {
            let extra = ["--topic", topic, "--timeout", PLAN.peer_life];
            lab.rclpy(site, distribution, "latched.py", &[&[role][..], &extra].concat())
        };
        let mut map = rclpy(Site::Robot, talks, "map", "/map");
        has_sent(&mut map);
        let sees = || {
            let mut sees = rclpy(Site::Desk, listens, "hear", "/map");
            sees.wait("the last map", |event| event["event"] == "received" && event["seq"] == 2);
            sees.end();
            sees.summary()
        };
        // The first one may come while maps are sent.
        sees();
        let summary = sees();
        assert_eq!([count(&summary, "received"), count(&summary, "duplicated")], [1, 0], "{summary}");
        // Lines are of use for ten seconds.
        let before = messages(&lab, Site::Desk, "/rosout");
        let mut log = rclpy(Site::Robot, talks, "log", "/rosout");
        has_sent(&mut log);
        eventually("the lines have come", || messages(&lab, Site::Desk, "/rosout") >= before + 3);
        let mut reads = rclpy(Site::Desk, listens, "hear", "/rosout");
        for seq in 0..3 {
            reads.wait("a line", |event| event["event"] == "received" && event["seq"] == seq);
        }
        reads.end();
        assert_eq!(count(&reads.summary(), "duplicated"), 0);
        map.end();
        map.summary();
    }
}

fn messages(lab: &Lab, site: Site, topic: &str) -> u64 {
    let status = lab.status(site);
    let routes = status["routes"].as_array().cloned().unwrap_or_default();
    let of_topic = routes.iter().filter(|route| route["topic"] == topic);
    of_topic.filter_map(|route| route["messages"].as_u64()).sum()
}

/// Policies of a share and of a use hold in the place of those that publishers have.
#[test]
fn late_joiners_get_what_a_share_says() {
    let [shared, used] = robot_to_desk("topic", ["/kept"]);
    let lab = Lab::real(PLAN, [shared + "durability = \"transient_local\"\ndepth = 3\n", used]);
    let talk =
        ["pub", "--topic", "/kept", "--count", "20", "--rate", "50", "--hold", "60", "--timeout", "90"];
    // A volatile publisher.
    let mut publisher = started(lab.load(Site::Robot, "jazzy", &talk));
    has_sent(&mut publisher);
    // It may have sent all before the desk was granted the topic.
    eventually("the history has come", || messages(&lab, Site::Desk, "/kept") >= 3);
    assert_heard(&listen(&lab, "kilted", "/kept", 3).summary(), MESSAGES - 3, 3, "of a volatile publisher");
}
