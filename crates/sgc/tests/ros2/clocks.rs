//! Hosts whose clocks differ: each node knows by how much, so that messages have an age and `max_age` holds.

use std::thread;
use std::time::Duration;

use rustix::process::Signal;
use serde_json::Value;

use crate::PLAN;
use crate::lab::{Lab, Site, share, uses};
use crate::support::eventually;
use crate::support::fake_clock::FakeClock;

const TOPIC: &str = "/stamped";
const SECOND_US: i64 = 1_000_000;
/// Most by which two programs differ that look at one file for their clock, and at the host's clock one after the other.
const SLACK_US: i64 = 100_000;

/// Returns how far the desk's clock is ahead as the robot's node knows it, with the error, in microseconds.
fn ahead(status: &Value) -> Option<(i64, i64)> {
    let clock = status["clocks"].as_array()?.iter().find(|clock| clock["name"] == "desk")?;
    Some((clock["ahead_us"].as_i64()?, clock["error_us"].as_i64()?))
}

/// Waits until the robot's node knows that the desk's clock is ahead by this.
fn expect_ahead(lab: &Lab, seconds: i64) {
    eventually(&format!("the desk's clock is {seconds} s ahead"), || {
        let known = ahead(&lab.status(Site::Robot));
        known.is_some_and(|(ahead, error)| (ahead - seconds * SECOND_US).abs() <= error + SLACK_US)
    });
}

fn too_old(lab: &Lab) -> u64 {
    lab.status(Site::Robot)["drops"]["too_old"].as_u64().unwrap_or(0)
}

#[test]
fn old_messages_are_dropped_although_the_clocks_of_the_hosts_differ() {
    let used = uses("topic", TOPIC, "desk") + "max_age = \"1s\"\n";
    let mut lab = Lab::silent_real(PLAN, [used, share("topic", TOPIC, "robot")]);
    let clock = FakeClock::new(lab.dir(), "+90");
    let environment = clock.environment();
    let environment = environment.each_ref().map(|(key, value)| (*key, value.as_str()));
    lab.start(Site::Cloud);
    lab.start(Site::Robot);
    lab.start_within(Site::Desk, &environment);
    let topic = ["--topic", TOPIC, "--depth", "0", "--timeout", PLAN.peer_life];
    let mut listener = lab.load(Site::Robot, "kilted", &[&["sub", "--verbose"], &topic[..]].concat());
    let talks = [&["pub", "--rate", "50"], &topic[..]].concat();
    let _talker = lab.load_within(Site::Desk, "jazzy", &environment, &talks);
    let newest = |event: &Value| event["seq"].as_u64().filter(|_| event["event"] == "received");
    let mut seq = newest(&listener.wait("a message", |event| event["event"] == "received")).unwrap();
    expect_ahead(&lab, 90);
    let why = lab.why(Site::Robot, TOPIC);
    assert!(why.contains("after its publication") && why.contains(" ± "), "{why}");

    // The way stands still, and what waited comes late.
    let router = lab.node(Site::Cloud);
    router.signal(Signal::STOP);
    thread::sleep(Duration::from_secs(3));
    router.signal(Signal::CONT);
    eventually("old messages are dropped", || too_old(&lab) > 20);
    seq += 150;
    listener.wait("new messages", |event| newest(event) > Some(seq));

    // The desk's clock is set back: its messages seem old, until the robot's node asks again.
    clock.set("-60");
    expect_ahead(&lab, -60);
    while listener.events.try_recv().is_ok() {}
    listener.wait("messages again", |event| newest(event).is_some());
}
