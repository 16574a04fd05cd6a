//! Latched topics (`transient_local`), many to many, over real nodes with local networks in memory. However late a
//! subscriber is, and whatever restarts, it gets the messages that ROS 2 would give it, each once.

#![allow(clippy::unwrap_used)]

mod support;

use std::collections::BTreeMap;
use std::time::{Duration, Instant};

use bytes::Bytes;
use sgc_ros::{RosWriter as _, SampleKind};
use sgc_wire::{History, Qos};
use support::*;

const TOPIC: &str = "/tf_static";

fn deep(depth: u32) -> Qos {
    Qos { history: History::KeepLast(depth), ..latched() }
}

/// Payloads that a subscriber received, with counts.
#[derive(Default)]
struct Receptions(BTreeMap<String, usize>);

impl Receptions {
    fn take(&mut self, listener: &Listener) {
        for sample in listener.drain() {
            *self.0.entry(String::from_utf8(sample.to_vec()).unwrap()).or_default() += 1;
        }
    }

    /// Waits until all of these arrived. Fails on any other or repeated message.
    fn are(&mut self, listener: &Listener, expected: &[&str]) {
        let deadline = Instant::now() + PATIENCE;
        loop {
            self.take(listener);
            let missing: Vec<_> = expected.iter().filter(|e| !self.0.contains_key(**e)).collect();
            if missing.is_empty() {
                break;
            }
            assert!(Instant::now() < deadline, "missing {missing:?}, heard {:?}", self.0);
            std::thread::sleep(Duration::from_millis(5));
        }
        let twice: Vec<_> = self.0.iter().filter(|(_, n)| **n > 1).collect();
        assert!(twice.is_empty(), "more than once: {twice:?}");
        let others: Vec<_> = self.0.keys().filter(|k| !expected.contains(&k.as_str())).collect();
        assert!(others.is_empty(), "heard, but not to be: {others:?}");
    }
}

/// Checks that a subscriber that joins now receives exactly these. Returns it.
fn late_listener_hears(trio: &Trio, qos: Qos, expected: &[&str]) -> Listener {
    let listener = Listener::new(&trio.desk_net, TOPIC, qos);
    Receptions::default().are(&listener, expected);
    listener
}

/// Checks that no other message came before one that is published now.
fn and_nothing_more(talkers: &[&Talker], heard: &mut Receptions, listener: &Listener, before: &[&str]) {
    let fence: Vec<String> = (0..talkers.len()).map(|n| format!("fence {n} {}", heard.0.len())).collect();
    talkers.iter().zip(&fence).for_each(|(talker, text)| talker.say(text.clone()));
    let all: Vec<&str> = before.iter().copied().chain(fence.iter().map(String::as_str)).collect();
    heard.are(listener, &all);
}

#[test]
fn publishers_of_different_depths_each_give_their_own_history() {
    let trio = Trio::new();
    let _cloud = trio.cloud();
    let _robot = trio.robot(&[TOPIC], "desk");
    let shallow = Talker::new(&trio.robot_net, TOPIC, deep(1));
    let deeper = Talker::new(&trio.robot_net, TOPIC, deep(40));
    let all = Talker::new(&trio.robot_net, TOPIC, Qos { history: History::KeepAll, ..latched() });
    for n in 0..50 {
        shallow.say(format!("shallow {n}"));
        deeper.say(format!("deep {n}"));
        all.say(format!("all {n}"));
    }
    let texts: Vec<String> = std::iter::once("shallow 49".to_owned())
        .chain((10..50).map(|n| format!("deep {n}")))
        .chain((0..50).map(|n| format!("all {n}")))
        .collect();
    let expected: Vec<&str> = texts.iter().map(String::as_str).collect();
    let _desk = trio.desk(&[TOPIC]);
    wait("three writers", || writers(&trio.desk_net, TOPIC) == 3);
    let early = late_listener_hears(&trio, deep(100), &expected);
    // The late joiner comes when the writers at the desk have everything.
    late_listener_hears(&trio, deep(100), &expected);
    let mut heard = Receptions::default();
    and_nothing_more(&[&shallow, &deeper, &all], &mut heard, &early, &[]);
}

#[test]
fn latched_messages_end_with_their_publisher() {
    let trio = Trio::new();
    let _nodes = (trio.cloud(), trio.robot(&[TOPIC], "desk"), trio.desk(&[TOPIC]));
    let stays = Talker::new(&trio.robot_net, TOPIC, latched());
    let goes = Talker::new(&trio.robot_net, TOPIC, latched());
    stays.say("stays");
    goes.say("goes");
    late_listener_hears(&trio, latched(), &["stays", "goes"]);
    drop(goes);
    wait("one writer", || writers(&trio.desk_net, TOPIC) == 1);
    late_listener_hears(&trio, latched(), &["stays"]);
    drop(stays);
    wait("no writer", || writers(&trio.desk_net, TOPIC) == 0);
    // The publisher returns with other messages.
    let back = Talker::new(&trio.robot_net, TOPIC, latched());
    back.say("back");
    late_listener_hears(&trio, latched(), &["back"]);
}

#[test]
fn a_publisher_that_restarts_while_the_router_is_away_replaces_what_it_said() {
    let trio = Trio::new();
    let cloud = trio.cloud();
    let _nodes = (trio.robot(&[TOPIC], "desk"), trio.desk(&[TOPIC]));
    let other = Talker::new(&trio.robot_net, TOPIC, latched());
    let first = Talker::new(&trio.robot_net, TOPIC, latched());
    other.say("other");
    first.say("first run");
    let early = late_listener_hears(&trio, latched(), &["other", "first run"]);
    let mut heard = Receptions::default();
    cloud.kill();
    drop(first);
    let second = Talker::new(&trio.robot_net, TOPIC, latched());
    second.say("second run");
    let _cloud = trio.cloud();
    heard.are(&early, &["second run"]);
    wait("two writers", || writers(&trio.desk_net, TOPIC) == 2);
    let late = late_listener_hears(&trio, latched(), &["other", "second run"]);
    and_nothing_more(&[&other, &second], &mut heard, &early, &["second run"]);
    drop(late);
}

#[test]
fn an_owners_node_that_restarts_makes_nobody_hear_it_again() {
    for kill in [true, false] {
        let trio = Trio::new();
        let _cloud = trio.cloud();
        let robot = trio.robot(&[TOPIC], "desk");
        let desk = trio.desk(&[TOPIC]);
        let talkers: Vec<_> = (0..5).map(|_| Talker::new(&trio.robot_net, TOPIC, deep(2))).collect();
        let texts: Vec<String> = (0..5).flat_map(|n| [format!("{n}: one"), format!("{n}: two")]).collect();
        let expected: Vec<&str> = texts.iter().map(String::as_str).collect();
        for (n, talker) in talkers.iter().enumerate() {
            talker.say(format!("{n}: one"));
            talker.say(format!("{n}: two"));
        }
        let early = late_listener_hears(&trio, deep(100), &expected);
        if kill {
            robot.kill();
        } else {
            robot.stop();
        }
        let _robot = trio.robot(&[TOPIC], "desk");
        let mut heard = Receptions::default();
        let all: Vec<&Talker> = talkers.iter().collect();
        if kill {
            wait("the history, known again", || desk.status()["drops"]["repeated"] == 10);
            heard.take(&early);
            assert!(heard.0.is_empty(), "{:?}", heard.0);
            and_nothing_more(&all, &mut heard, &early, &[]);
        } else {
            // A node that stops orderly withdraws its messages, as if all its publishers had ended.
            heard.are(&early, &expected);
            and_nothing_more(&all, &mut heard, &early, &expected);
        }
        wait("five writers", || writers(&trio.desk_net, TOPIC) == 5);
    }
}

#[test]
fn a_late_node_and_a_restarted_one_give_the_history_once() {
    let trio = Trio::new();
    let _cloud = trio.cloud();
    let _robot = trio.robot(&[TOPIC], "desk");
    let talker = Talker::new(&trio.robot_net, TOPIC, deep(3));
    (0..5).for_each(|n| talker.say(format!("{n}")));
    for _ in 0..3 {
        let desk = trio.desk(&[TOPIC]);
        let listener = late_listener_hears(&trio, deep(10), &["2", "3", "4"]);
        let mut heard = Receptions::default();
        heard.are(&listener, &[]);
        desk.stop();
        wait("no writer", || writers(&trio.desk_net, TOPIC) == 0);
    }
}

#[test]
fn late_joiner_gets_no_expired_message() {
    let trio = Trio::new();
    let _cloud = trio.cloud();
    let _robot = trio.robot(&[TOPIC], "desk");
    let lifespan_ns = 3_600_000_000_000;
    let qos = Qos { lifespan_ns: Some(lifespan_ns), ..deep(10) };
    let talker = Talker::new(&trio.robot_net, TOPIC, qos);
    let now = unix_now().0 as i64 * 1_000_000;
    let say = |age_ns: i64, text: &'static str| {
        talker.writer.write(SampleKind::Write, now - age_ns, Bytes::from_static(text.as_bytes())).unwrap();
    };
    say(3 * lifespan_ns as i64, "long ago");
    say(2 * lifespan_ns as i64, "too long ago");
    let desk = trio.desk(&[TOPIC]);
    wait("a writer", || writers(&trio.desk_net, TOPIC) == 1);
    let early = Listener::new(&trio.desk_net, TOPIC, deep(10));
    say(lifespan_ns as i64 / 2, "a while ago");
    say(0, "now");
    Receptions::default().are(&early, &["a while ago", "now"]);
    desk.stop();
    let _desk = trio.desk(&[TOPIC]);
    late_listener_hears(&trio, deep(10), &["a while ago", "now"]);
}

#[test]
fn changed_lifespan_counts_for_messages_that_are_kept() {
    let trio = Trio::new();
    let _cloud = trio.cloud();
    let robot = trio.robot(&[TOPIC], "desk");
    let talker = Talker::new(&trio.robot_net, TOPIC, deep(10));
    let (now, hour_ns) = (unix_now().0 as i64 * 1_000_000, 3_600_000_000_000);
    let say = |age_ns: i64, text: &'static str| {
        talker.writer.write(SampleKind::Write, now - age_ns, Bytes::from_static(text.as_bytes())).unwrap();
    };
    say(2 * hour_ns, "too long ago");
    say(0, "now");
    let desk = trio.desk(&[TOPIC]);
    let early = late_listener_hears(&trio, deep(10), &["too long ago", "now"]);
    desk.stop();
    drop(early);
    robot.reload(|config| config.shares[0].qos.lifespan_ns = Some(hour_ns as u64));
    let _desk = trio.desk(&[TOPIC]);
    late_listener_hears(&trio, deep(10), &["now"]);
}
