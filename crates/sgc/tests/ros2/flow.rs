//! Messages at full speed, large messages, and stalled subscribers.

use std::fs;
use std::thread;
use std::time::Duration;

use rustix::process::Signal;
use serde_json::Value;

use crate::lab::{Lab, Site, robot_to_desk, share, uses};
use crate::support::{Peer, eventually};
use crate::{EXCLUSIVE, PAIRS, PLAN, count};

/// Bytes of a fragment (`sgc_dds::config::FRAGMENT_BYTES`).
const FRAGMENT_BYTES: u64 = 14_000;

/// Starts a publisher of so many messages, the second half a second after the first, and a subscriber that ends with
/// the last one, matched directly or through `sgc`. The publisher stays for `hold` seconds after its last message.
fn start(
    lab: &Lab,
    [talks, listens]: [&str; 2],
    sites: [Site; 2],
    messages: u64,
    hold: &str,
    extra: &[&str],
) -> (Peer, Peer) {
    // Otherwise the publisher may match the reader of an earlier one, which ends a moment later.
    if sites[0] == Site::Robot {
        eventually("no earlier publisher is left", || lab.status(Site::Robot)["routes"][0]["name"].is_null());
    }
    let messages = messages.to_string();
    let common = [&["--topic", "/load", "--timeout", PLAN.peer_life][..], extra].concat();
    let listen = [&["sub", "--last", &messages, "--linger", "0.5"], &common[..]].concat();
    let mut listener = lab.load(sites[1], listens, &listen);
    let talk =
        [&["pub", "--count", &messages, "--wait-go", "--begin", "0.5", "--hold", hold], &common[..]].concat();
    let mut talker = lab.load(sites[0], talks, &talk);
    talker.wait_matched("a match at the publisher");
    listener.wait_matched("a match at the subscriber");
    talker.go();
    (talker, listener)
}

/// Runs a publisher and a subscriber ([`start`]). Returns the subscriber's summary once it has the last message. The
/// publisher stays until then.
fn carry(lab: &Lab, pair: [&str; 2], sites: [Site; 2], messages: u64, extra: &[&str]) -> Value {
    let (mut talker, mut listener) = start(lab, pair, sites, messages, PLAN.peer_life, extra);
    let summary = listener.summary();
    talker.end();
    talker.summary();
    summary
}

/// Asserts that all messages came once each, unaltered and in order. The first may be lost, because a reader is matched
/// a moment before it knows (`tests/peers/README.md`).
fn assert_whole(summary: &Value, messages: u64, what: &str) {
    let counts = ["last", "lost", "duplicated", "altered", "reordered"].map(|key| count(summary, key));
    assert_eq!(counts, [messages - 1, 0, 0, 0, 0], "{what}: {summary}");
    assert!(count(summary, "first") <= 1, "{what}: {summary}");
}

#[test]
fn a_reliable_topic_that_keeps_all_arrives_whole_however_fast_it_is_published() {
    const MESSAGES: u64 = 10_000;
    let lab = Lab::real(EXCLUSIVE, robot_to_desk("topic", ["/load"]));
    // Fast DDS refuses a message if 5000 wait for a subscriber that gets no CPU for 100 ms.
    let extra = ["--depth", "0", "--rate", "0", "--size", "1000", "--insist"];
    for pair in PAIRS {
        let native = carry(&lab, pair, [Site::Desk, Site::Desk], MESSAGES, &extra);
        assert_whole(&native, MESSAGES, "with nothing in between");
    }
    for pair in PAIRS {
        let carried = carry(&lab, pair, [Site::Robot, Site::Desk], MESSAGES, &extra);
        assert_whole(&carried, MESSAGES, &format!("{pair:?}"));
    }
}

/// The subscriber's node has room for fewer messages than come meanwhile, and each comes alone.
#[test]
fn a_reliable_topic_that_keeps_all_arrives_whole_if_its_subscriber_pauses() {
    const MESSAGES: u64 = 4_000;
    const PAUSE: Duration = Duration::from_millis(700);
    let lab = Lab::real(EXCLUSIVE, robot_to_desk("topic", ["/load"]));
    let extra = ["--depth", "0", "--rate", "2000", "--size", "100", "--insist"];
    for pair in PAIRS {
        let (mut talker, mut listener) = start(&lab, pair, [Site::Robot, Site::Desk], MESSAGES, "1", &extra);
        thread::sleep(PAUSE);
        listener.signal(Signal::STOP);
        thread::sleep(PAUSE);
        listener.signal(Signal::CONT);
        assert_whole(&listener.summary(), MESSAGES, &format!("{pair:?}"));
        talker.summary();
    }
}

/// More than a node has room for comes while the router stands still.
#[test]
fn a_publisher_that_keeps_all_waits_while_the_path_stands_still() {
    const MESSAGES: u64 = 2_000;
    const PAUSE: Duration = Duration::from_secs(1);
    let lab = Lab::real(EXCLUSIVE, robot_to_desk("topic", ["/load"]));
    let extra = ["--depth", "0", "--rate", "0", "--size", "65536", "--insist"];
    for pair in PAIRS {
        let carried = thread::scope(|scope| {
            let carried = scope.spawn(|| carry(&lab, pair, [Site::Robot, Site::Desk], MESSAGES, &extra));
            let router = lab.node(Site::Cloud);
            while !carried.is_finished() {
                router.signal(Signal::STOP);
                thread::sleep(PAUSE);
                router.signal(Signal::CONT);
                thread::sleep(PAUSE / 4);
            }
            carried.join().unwrap()
        });
        assert_whole(&carried, MESSAGES, &format!("{pair:?}"));
    }
}

/// Most of the messages wait at the robot's node when their publisher ends, for longer than its share would.
#[test]
fn last_messages_of_a_publisher_that_ended_arrive_over_a_path_that_stood_still() {
    const MESSAGES: u64 = 200;
    const PAUSE: Duration = Duration::from_secs(5);
    let lab = Lab::real(EXCLUSIVE, robot_to_desk("topic", ["/load"]));
    let extra = ["--depth", "0", "--rate", "0", "--size", "65536"];
    for pair in PAIRS {
        let (mut talker, mut listener) = start(&lab, pair, [Site::Robot, Site::Desk], MESSAGES, "0", &extra);
        thread::sleep(Duration::from_millis(300));
        let router = lab.node(Site::Cloud);
        router.signal(Signal::STOP);
        talker.summary();
        thread::sleep(PAUSE);
        router.signal(Signal::CONT);
        assert_whole(&listener.summary(), MESSAGES, &format!("{pair:?}"));
    }
}

/// All messages have left the robot's node when their publisher ends, and wait at the router.
#[test]
fn messages_on_the_way_survive_the_end_of_their_publisher() {
    const MESSAGES: u64 = 60;
    const PAUSE: Duration = Duration::from_secs(5);
    let lab = Lab::real(EXCLUSIVE, robot_to_desk("topic", ["/load"]));
    let extra = ["--depth", "0", "--rate", "0", "--size", "65536"];
    for pair in PAIRS {
        let (mut talker, mut listener) = start(&lab, pair, [Site::Robot, Site::Desk], MESSAGES, "0", &extra);
        let desk = lab.node(Site::Desk);
        desk.signal(Signal::STOP);
        talker.summary();
        thread::sleep(PAUSE);
        desk.signal(Signal::CONT);
        assert_whole(&listener.summary(), MESSAGES, &format!("{pair:?}"));
    }
}

#[test]
fn large_messages_of_real_ros_2_arrive_whole() {
    const MESSAGES: u64 = 10;
    let lab = Lab::real(EXCLUSIVE, robot_to_desk("topic", ["/load"]));
    for (pair, size) in PAIRS.into_iter().zip([1_000_000, 6_000_000]) {
        let (text, before) = (size.to_string(), dropped_at_full_buffers(&lab));
        let extra = ["--rate", "5", "--size", &text];
        let carried = carry(&lab, pair, [Site::Robot, Site::Desk], MESSAGES, &extra);
        assert_whole(&carried, MESSAGES, &format!("{pair:?}, {size} bytes"));
        // Without pauses between bursts, as many packets were dropped as fragments were written.
        let (dropped, fragments) = (dropped_at_full_buffers(&lab) - before, MESSAGES * size / FRAGMENT_BYTES);
        assert!(dropped < fragments / 4, "{pair:?}, {size} bytes: {dropped} of {fragments} dropped");
    }
}

/// Returns the number of datagrams that the kernel has dropped at the desk because a receive buffer was full.
fn dropped_at_full_buffers(lab: &Lab) -> u64 {
    let counters = fs::read_to_string(format!("/proc/{}/net/snmp", lab.node(Site::Desk).pid())).unwrap();
    let [names, values] = [0, 1].map(|line| {
        let line = counters.lines().filter(|line| line.starts_with("Udp: ")).nth(line).unwrap();
        line.split_whitespace()
    });
    names
        .zip(values)
        .find_map(|(name, value)| (name == "RcvbufErrors").then(|| value.parse().unwrap()))
        .unwrap()
}

/// A subscriber with default QoS keeps ten messages. Hundreds that come at once after a router stalled would overwrite
/// each other there.
#[test]
fn subscriber_with_default_qos_receives_a_burst() {
    const MESSAGES: u64 = 2_000;
    const PAUSE: Duration = Duration::from_millis(400);
    let lab = Lab::real(EXCLUSIVE, robot_to_desk("topic", ["/load"]));
    let (extra, mut lost) = (["--rate", "1000"], 0);
    for pair in PAIRS {
        let (mut talker, mut listener) = start(&lab, pair, [Site::Robot, Site::Desk], MESSAGES, "1", &extra);
        thread::sleep(Duration::from_secs(1));
        let router = lab.node(Site::Cloud);
        router.signal(Signal::STOP);
        thread::sleep(PAUSE);
        router.signal(Signal::CONT);
        let summary = listener.summary();
        talker.summary();
        assert_eq!(["duplicated", "reordered"].map(|key| count(&summary, key)), [0, 0], "{summary}");
        lost += count(&summary, "lost");
    }
    // A message each millisecond. Written without pauses, a fifth to a half of each burst were lost.
    let gathered = u64::try_from(PAUSE.as_millis()).unwrap() * PAIRS.len() as u64;
    assert!(lost < gathered / 10, "{lost} of {gathered}");
}

/// A stalled subscriber holds up no other, and gets the publisher's history when it goes on.
#[test]
fn a_subscriber_that_stands_still_holds_up_nobody_else() {
    const MESSAGES: u64 = 500;
    let lab = Lab::real(EXCLUSIVE, robot_to_desk("topic", ["/load"]));
    let sub = |distribution| {
        lab.load(
            Site::Desk,
            distribution,
            &["sub", "--topic", "/load", "--depth", "0", "--last", "500", "--timeout", "120"],
        )
    };
    let (mut quick, mut frozen) = (sub("kilted"), sub("jazzy"));
    let talk = [
        "pub",
        "--topic",
        "/load",
        "--count",
        "500",
        "--rate",
        "200",
        "--wait-go",
        "--begin",
        "0.5",
        "--hold",
        "1",
    ];
    let mut talker = lab.load(Site::Robot, "jazzy", &talk);
    talker.wait_matched("a match at the robot");
    quick.wait_matched("a match at the desk");
    frozen.wait_matched("another match at the desk");
    talker.go();
    // Waits until it has the first message.
    thread::sleep(Duration::from_millis(300));
    frozen.signal(Signal::STOP);
    assert_whole(&quick.summary(), MESSAGES, "the other");
    frozen.signal(Signal::CONT);
    assert_whole(&frozen.summary(), MESSAGES, "the one that stood still");
    talker.summary();
}

#[test]
fn a_far_subscriber_that_wants_less_spares_the_wire() {
    const MESSAGES: u64 = 1_000;
    let used = uses("topic", "/load", "robot") + "max_rate = \"5Hz\"\n";
    let lab = Lab::real(PLAN, [share("topic", "/load", "desk"), used]);
    let topic = ["--topic", "/load", "--depth", "0", "--timeout", PLAN.peer_life];
    let mut listener = lab.load(Site::Desk, "kilted", &[&["sub", "--verbose"], &topic[..]].concat());
    let messages = MESSAGES.to_string();
    let talk =
        [&["pub", "--rate", "200", "--count", &messages, "--hold", PLAN.peer_life], &topic[..]].concat();
    let mut talker = lab.load(Site::Robot, "jazzy", &talk);
    talker.wait("all messages", |event| event["event"] == "all_sent");
    // The newest one always comes.
    listener.wait("the last message", |event| event["event"] == "received" && event["seq"] == MESSAGES - 1);
    let sent = lab.status(Site::Robot)["routes"][0]["messages"].as_u64().unwrap();
    assert!(sent < MESSAGES / 4, "{sent} messages left the robot");
    let why = lab.why(Site::Robot, "/load");
    assert!(
        why.contains("no more than 5 messages a second is sent, because no subscriber wants more"),
        "{why}"
    );
}
