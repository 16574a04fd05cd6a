//! Trust of whole nodes over real QUIC: who gets what, who no longer does, and that nobody else notices.

#![allow(clippy::unwrap_used)]

#[path = "support/lab.rs"]
mod lab;
mod support;

use std::fs;
use std::time::Instant;

use lab::*;
use sgc_node::admin::AdminRequest;
use sgc_trust::Suite;
use support::*;

#[test]
fn a_revoked_member_is_cut_off_everywhere_and_the_others_lose_nothing() {
    let lab = Lab::new(&["robot", "desk1", "desk2"]);
    let cloud = lab.cloud();
    let share_it = |c: &mut sgc_node::config::Config| c.shares = vec![share("/chatter", &["desk1", "desk2"])];
    let robot = lab.start("robot", share_it);
    let desk1 = lab.start("desk1", |c| c.uses = vec![uses("/chatter")]);
    let desk2 = lab.start("desk2", |c| c.uses = vec![uses("/chatter")]);
    let talker = lab.talker("robot", "/chatter");
    let (one, two) = (lab.listener("desk1", "/chatter"), lab.listener("desk2", "/chatter"));
    talker.wait_for_readers(1);
    warm_up(&talker, &[&one, &two]);
    assert_eq!(cloud.status()["router"]["branches"], 4);
    let stream = Stream::start(talker);
    stream.more(200);

    let revoked = lab.id("desk1").to_string();
    let list = lab.revoke("desk1");
    let begun = Instant::now();
    assert_eq!(cloud.ask(&AdminRequest::Crl(list))["ok"], true);
    let is_closed = |r: &sgc_node::audit::AuditRecord| {
        r.event == "link_closed" && r.peer.as_ref() == Some(&revoked) && r.reason.as_deref().is_some()
    };
    wait("its link is closed", || lab.audit("cloud").iter().any(is_closed));
    let closed = lab.audit("cloud").into_iter().find(is_closed).unwrap();
    assert!(closed.reason.unwrap().contains("revoked"));
    let cut = begun.elapsed();
    wait("a new epoch", || lab.epoch("robot") == 2);
    eprintln!("revocation: link cut after {cut:?}, new epoch at the owner after {:?}", begun.elapsed());
    let mark = stream.said();
    wait("its branches are gone", || cloud.status()["router"]["branches"] == 2);
    wait("it is refused when it dials again", || cloud.refused("revoked") > 0);
    assert!(!cloud.peers().contains(&revoked));
    stream.more(500);
    let (talker, last) = stream.end();
    hears_each(&two, 1, last);
    two.hears_nothing();
    let one_heard = heard(&one);
    assert!(one_heard.iter().zip(1..).all(|(n, expected)| *n == expected), "{one_heard:?}");
    assert!(one_heard.last().is_some_and(|n| *n <= mark), "it heard {:?}, of {mark}", one_heard.last());

    // The router comes back with what it kept, and nobody is there yet who could tell it.
    let kept = lab.state("cloud").join("crl");
    wait("the list is kept", || fs::read_dir(&kept).is_ok_and(|files| files.count() == 1));
    wait("the robot keeps it, too", || fs::read_dir(lab.state("robot").join("crl")).is_ok());
    robot.kill();
    desk2.kill();
    cloud.kill();
    let cloud = lab.cloud();
    wait("it is refused", || cloud.refused("revoked") > 0);
    assert_eq!(cloud.status()["links"].as_array().map(Vec::len), Some(0));

    // A router that knows nothing hears of it from the robot.
    cloud.kill();
    fs::remove_dir_all(lab.state("cloud")).unwrap();
    let cloud = lab.cloud();
    wait("it is let in where nobody knows", || cloud.peers().contains(&revoked));
    assert_eq!(cloud.refused("revoked"), 0);
    let robot = lab.start("robot", share_it);
    wait("it is cut off again", || !cloud.peers().contains(&revoked) && cloud.refused("revoked") > 0);
    assert!(cloud.peers().contains(&lab.id("robot").to_string()));
    talker.say("lost on it");
    one.hears_nothing();
    drop((robot, desk1));
}

#[test]
fn a_recipient_is_taken_out_and_put_back_and_the_other_loses_nothing() {
    let lab = Lab::new(&["robot", "desk1", "desk2"]);
    let _cloud = lab.cloud();
    let robot = lab.start("robot", |c| c.shares = vec![share("/chatter", &["desk1", "desk2"])]);
    let _desk1 = lab.start("desk1", |c| c.uses = vec![uses("/chatter")]);
    let desk2 = lab.start("desk2", |c| c.uses = vec![uses("/chatter")]);
    let talker = lab.talker("robot", "/chatter");
    let (one, two) = (lab.listener("desk1", "/chatter"), lab.listener("desk2", "/chatter"));
    talker.wait_for_readers(1);
    warm_up(&talker, &[&one, &two]);
    let stream = Stream::start(talker);
    stream.more(100);

    let report = robot.reload(|c| c.shares[0].to = nodes(&["desk1"]));
    assert_eq!(report["changed"][0], "/chatter: who may subscribe changed");
    wait("a new epoch", || lab.epoch("robot") == 2);
    let (first_mark, desk) = (stream.said(), lab.id("desk2").to_string());
    let cut = |r: &sgc_node::audit::AuditRecord| r.event == "cut" && r.peer.as_ref() == Some(&desk);
    assert!(lab.audit("robot").iter().any(cut));
    let denied = || desk2.route_state().contains("does not share it with this node");
    wait("it is told", denied);
    stream.more(300);
    let second_mark = stream.said();
    robot.reload(|c| c.shares[0].to = nodes(&["desk1", "desk2"]));
    let mut back = Vec::new();
    wait("it is back", || writers(&lab.net("desk2"), "/chatter") == 1);
    stream.more(300);
    let (_talker, last) = stream.end();
    hears_each(&one, 1, last);
    one.hears_nothing();
    while back.last() != Some(&last) {
        back.push(
            two.samples
                .recv_timeout(PATIENCE)
                .map(|b| std::str::from_utf8(&b).unwrap().parse().unwrap())
                .unwrap(),
        );
    }
    assert!(back.windows(2).all(|w| w[0] < w[1] || w[1] == 0), "twice or out of order: {back:?}");
    let between = back.iter().find(|n| (first_mark + 1..=second_mark).contains(*n));
    assert_eq!(between, None, "it heard something while it had no right to");
}

#[test]
fn a_stream_goes_through_many_epochs_unharmed() {
    let lab = Lab::new(&["robot", "desk"]);
    let _cloud = lab.cloud();
    let _robot = lab.start("robot", |c| {
        c.shares = vec![share("/chatter", &["desk"])];
        c.rotation.messages = 1024;
    });
    let _desk = lab.start("desk", |c| c.uses = vec![uses("/chatter")]);
    let talker = lab.talker("robot", "/chatter");
    let listener = lab.listener("desk", "/chatter");
    talker.wait_for_readers(1);
    warm_up(&talker, &[&listener]);
    let stream = Stream::start(talker);
    stream.more(5000);
    let (_talker, last) = stream.end();
    hears_each(&listener, 1, last);
    listener.hears_nothing();
    let epochs = lab.epoch("robot");
    assert!((3..=6).contains(&epochs), "{epochs} epochs for {last} messages");
}

#[test]
fn every_suite_carries_messages() {
    let lab = Lab::new(&["robot", "desk"]);
    let topic = |suite: Suite| format!("/{}", suite.name().replace('-', "_"));
    let topics = Suite::ALL.map(|suite| (suite, topic(suite)));
    let _cloud = lab.cloud();
    let _robot = lab.start("robot", |c| {
        let in_suite = |(suite, topic): &(Suite, String)| {
            let mut share = share(topic, &["desk"]);
            share.suite = *suite;
            share
        };
        c.shares = topics.iter().map(in_suite).collect();
    });
    let _desk = lab.start("desk", |c| c.uses = topics.iter().map(|(_, topic)| uses(topic)).collect());
    for (suite, topic) in &topics {
        let (talker, listener) = (lab.talker("robot", topic), lab.listener("desk", topic));
        talker.wait_for_readers(1);
        warm_up(&talker, &[&listener]);
        let large = bytes::Bytes::from(vec![suite.id(); 300_000]);
        talker.say(large.clone());
        let deadline = Instant::now() + PATIENCE;
        while listener.samples.recv_timeout(PATIENCE).is_ok_and(|b| b != large) {
            assert!(Instant::now() < deadline, "{suite}: it never comes whole");
        }
    }
}
