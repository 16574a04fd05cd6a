//! Topics with keys, which Kilted has and Jazzy does not. A Kilted subscriber ends with a segmentation fault at a
//! message without the hash of its key (`docs/reference/compatibility.md`).

use serde_json::{Value, json};

use crate::lab::{Lab, Site, robot_to_desk};
use crate::support::Peer;
use crate::{PLAN, count};

const TOPICS: [&str; 3] = ["/keyed_long", "/keyed_string", "/complex_nested_key"];

fn keyed(lab: &Lab, site: Site, role: &str, args: &[&str]) -> Peer {
    lab.rclpy(site, "kilted", "keyed.py", &[&[role, "--timeout", PLAN.peer_life], args].concat())
}

/// Returns the summary of a subscriber that starts with the publisher.
fn live(lab: &Lab, talks: Site) -> Value {
    let mut listener = keyed(lab, Site::Desk, "sub", &[]);
    let talker = keyed(lab, talks, "pub", &[]);
    let summary = listener.summary();
    drop(talker);
    summary
}

/// Returns the summary of a subscriber that starts after all messages are published.
fn late(lab: &Lab, talks: Site) -> Value {
    let mut talker = keyed(lab, talks, "pub", &["--transient-local"]);
    talker.wait("messages", |event| event["event"] == "all_sent");
    keyed(lab, Site::Desk, "sub", &["--transient-local"]).summary()
}

fn assert_whole(summary: &Value, what: &str) {
    assert_eq!(summary["complete"], json!(true), "{what}: {summary}");
    assert_eq!(count(summary, "altered"), 0, "{what}: {summary}");
}

#[test]
fn messages_with_keys_arrive_by_value() {
    let lab = Lab::real(PLAN, robot_to_desk("topic", TOPICS));
    assert_whole(&live(&lab, Site::Desk), "with nothing in between");
    assert_whole(&live(&lab, Site::Robot), "through sgc");
}

#[test]
fn late_subscriber_gets_the_last_message_of_each_instance() {
    let lab = Lab::real(PLAN, robot_to_desk("topic", TOPICS));
    for (site, what) in [(Site::Desk, "with nothing in between"), (Site::Robot, "through sgc")] {
        let summary = late(&lab, site);
        assert_whole(&summary, what);
        assert_eq!(count(&summary, "older"), 0, "{what}: {summary}");
        assert_eq!(summary["heard"], json!({TOPICS[0]: 5, TOPICS[1]: 5, TOPICS[2]: 5}), "{what}: {summary}");
    }
}
