//! Topics: all messages once and in order, large ones whole, and to late joiners as many as their publishers keep.

use serde_json::Value;

use crate::lab::{Site, robot_to_desk};
use crate::networks::Networks;
use crate::support::Peer;
use crate::{CASES, counts};

/// Asserts that the messages up to a number came once each and in order. The first ones may be missing if a reader of DDS
/// was matched too late for them, though the second one comes a second later.
fn assert_whole(summary: &Value, sent: u64, missing_max: u64, what: &str) {
    let [received, first, last] = counts(summary, ["received", "first", "last"]);
    assert!(first <= missing_max && last == sent - 1 && received == sent - first, "{what}: {summary}");
    let faults = counts(summary, ["lost", "duplicated", "altered", "reordered"]);
    assert_eq!(faults, [0; 4], "{what}: {summary}");
    // Only the Zenoh peer looks at the numbers of attachments.
    if summary["numbers_repeated"].is_u64() {
        assert_eq!(counts(summary, ["numbers_skipped", "numbers_repeated"]), [0, 0], "{what}: {summary}");
    }
}

/// A topic from the robot to the desk.
struct Stream {
    talker: Peer,
    listener: Peer,
    sent: u64,
}

impl Stream {
    /// Starts a subscriber and a publisher with the same options, which are matched then.
    fn start(networks: &Networks, topic: &str, common: &[&str], pace: &[&str], sent: u64) -> Self {
        let common = [&["--topic", topic], common].concat();
        let hear = [&common[..], &["--verbose"]].concat();
        let mut listener = networks.load_on(Site::Desk, "sub", "listener", &hear);
        let count = sent.to_string();
        let stays = ["--count", &count, "--wait-go", "--begin", "1", "--hold", "1"];
        let talk = [&common, pace, &stays].concat();
        let mut talker = networks.load_on(Site::Robot, "pub", "talker", &talk);
        talker.wait_matched("a match at the publisher");
        listener.wait_matched("a match at the subscriber");
        Self { talker, listener, sent }
    }

    /// Waits for the last message. Returns the subscriber's summary.
    fn finish(mut self, what: &str) -> Value {
        let last = self.sent - 1;
        self.listener
            .wait(&format!("the last message, {what}"), |e| e["event"] == "received" && e["seq"] == last);
        // Later copies of messages would arrive before the end of the publisher.
        self.talker.summary();
        self.listener.end();
        self.listener.summary()
    }
}

#[test]
fn numbers_arrive_complete_and_in_order() {
    const MESSAGES: u64 = 500;
    /// Topics, and how many of the first messages may be missing on DDS, where a writer may be matched after its reader.
    const QOS: [(&str, [&str; 3], u64); 2] = [
        ("/reliable", ["--reliable", "--depth", "0"], 1),
        ("/best_effort", ["--best-effort", "--depth", "1000"], 40),
    ];
    for on in CASES {
        let tables = robot_to_desk("topic", QOS.map(|(topic, ..)| topic));
        let Some(networks) = Networks::start(on, tables) else { return };
        let streams = QOS.map(|(topic, qos, missing_max)| {
            let mut stream = Stream::start(&networks, topic, &qos, &["--rate", "200"], MESSAGES);
            stream.talker.go();
            (topic, stream, missing_max)
        });
        for (topic, stream, missing_max) in streams {
            let what = format!("{on:?} {topic}");
            assert_whole(&stream.finish(&what), MESSAGES, missing_max, &what);
        }
    }
}

#[test]
fn messages_of_one_and_thirteen_megabytes_arrive_whole() {
    const MESSAGES: u64 = 3;
    for on in CASES {
        let Some(networks) = Networks::start(on, robot_to_desk("topic", ["/large"])) else { return };
        for size in ["1000000", "13000000"] {
            let pace = ["--size", size, "--rate", "4"];
            // On Zenoh, only a publisher that keeps all waits for room in its queue.
            let mut stream = Stream::start(&networks, "/large", &["--depth", "0"], &pace, MESSAGES);
            stream.talker.go();
            let what = format!("{on:?} {size}");
            assert_whole(&stream.finish(&what), MESSAGES, 1, &what);
        }
    }
}

#[test]
fn late_joiners_get_as_many_messages_as_the_publisher_keeps() {
    const MESSAGES: u64 = 20;
    const LATCHED: [(&str, &str, u64); 2] = [("/last", "1", 1), ("/five", "5", 5)];
    for on in CASES {
        let tables = robot_to_desk("topic", LATCHED.map(|(topic, ..)| topic));
        let Some(networks) = Networks::start(on, tables) else { return };
        let mut talkers = LATCHED.map(|(topic, depth, _)| {
            let qos = ["--topic", topic, "--transient-local", "--depth", depth];
            let pace = ["--count", "20", "--rate", "50", "--wait-matched", "0", "--hold", "100"];
            networks.load_on(Site::Robot, "pub", "talker", &[&qos[..], &pace].concat())
        });
        talkers.iter_mut().for_each(|talker| {
            talker.wait("all messages", |event| event["event"] == "all_sent");
        });
        // A subscriber of zenoh-ext drops history that is older than the first live message. So the subscribers that
        // are looked at join once others have the last message.
        for is_late in [false, true] {
            let listeners = LATCHED.map(|(topic, ..)| {
                let hear = ["--topic", topic, "--transient-local", "--depth", "100", "--verbose"];
                networks.load_on(Site::Desk, "sub", "listener", &hear)
            });
            for (mut listener, (topic, _, kept)) in listeners.into_iter().zip(LATCHED) {
                let last = MESSAGES - 1;
                listener.wait("the last message", |e| e["event"] == "received" && e["seq"] == last);
                listener.end();
                let summary = listener.summary();
                let found = counts(&summary, ["received", "first", "duplicated", "reordered", "altered"]);
                if is_late {
                    assert_eq!(found, [kept, MESSAGES - kept, 0, 0, 0], "{topic}, {on:?}: {summary}");
                }
            }
        }
    }
}
