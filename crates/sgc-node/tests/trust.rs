//! Trust of whole nodes over real QUIC: who gets what, who no longer does, and that nobody else notices.

#![allow(clippy::unwrap_used)]

#[path = "support/lab.rs"]
mod lab;
mod support;

use std::fs;
use std::os::unix::fs::PermissionsExt as _;
use std::time::{Duration, Instant};

use lab::*;
use rand_core::{OsRng, TryRngCore as _};
use sgc_node::admin::AdminRequest;
use sgc_node::audit::AuditRecord;
use sgc_node::config::{Config, UseConfig};
use sgc_trust::{Identity, Suite, derive_name};
use sgc_wire::Metadata;
use support::*;

#[test]
fn a_revoked_member_is_cut_off_everywhere_and_the_others_lose_nothing() {
    let lab = Lab::new(&["robot", "desk1", "desk2"]);
    let cloud = lab.cloud();
    let share_it = |c: &mut Config| c.shares = vec![share("/chatter", &["desk1", "desk2"])];
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
    let is_closed = |r: &AuditRecord| {
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
    let cut = |r: &AuditRecord| r.event == "cut" && r.peer.as_ref() == Some(&desk);
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

#[test]
fn certificates_and_secrets_are_renewed_while_messages_flow() {
    let lab = Lab::new(&["robot"]);
    lab.with_fleet(|fleet| fleet.set_authority(Some("keeper".parse().unwrap()), unix_now()).unwrap());
    lab.enroll("keeper", |_| {});
    // Certificates begin ten minutes before they are made: less than a third of their time is left.
    lab.enroll("robot", |request| request.valid = Duration::from_secs(240));
    lab.enroll("desk", |request| request.valid = Duration::from_secs(240));
    lab.enroll("thief", |request| request.valid = Duration::from_secs(240));
    let cloud = lab.cloud();
    let share_it = |c: &mut Config| c.shares = vec![share("/chatter", &["desk"])];
    let use_it = |c: &mut Config| c.uses = vec![uses("/chatter")];
    let until = |node: &str| lab.identity(node).not_after();
    let old = lab.identity("desk");
    let (robot, desk) = (lab.start("robot", share_it), lab.start("desk", use_it));
    let talker = lab.talker("robot", "/chatter");
    let listener = lab.listener("desk", "/chatter");
    talker.wait_for_readers(1);
    warm_up(&talker, &[&listener]);
    let stream = Stream::start(talker);
    stream.more(100);
    assert_eq!((until("desk"), lab.identity("desk").chain()), (old.not_after(), old.chain()));

    let keeper = lab.start("keeper", |c| c.authority = Some(lab.fleet_file()));
    wait("both have new certificates", || {
        until("desk") > old.not_after() && until("robot") > old.not_after()
    });
    let new = lab.identity("desk");
    assert_eq!(fs::metadata(lab.path("desk.identity")).unwrap().permissions().mode() & 0o7777, 0o600);
    // Ten minutes are not added to it each time.
    let lasts = |i: &Identity| i.not_after().0 - i.as_peer().not_before.0;
    assert!(lasts(&new).abs_diff(lasts(&old)) <= 2000, "{} and {} ms", lasts(&new), lasts(&old));
    let shown = |node: &str| {
        let (id, until) = (lab.id(node).to_string(), until(node).to_string());
        let status = cloud.status();
        let links: Vec<_> = status["links"].as_array().unwrap().iter().filter(|l| l["peer"] == *id).collect();
        links.len() == 1 && links[0]["peer_until"] == *until
    };
    wait("one link each, with the new certificate", || shown("desk") && shown("robot"));
    stream.more(300);
    let known = |node: &str, serial: &[u8]| {
        let read = sgc_node::read_fleet(&lab.fleet_file()).unwrap();
        read.node(&node.parse().unwrap()).unwrap().certificates.iter().any(|c| *c.serial == *serial)
    };
    assert!(known("desk", &new.as_peer().cert.serial) && known("desk", &old.as_peer().cert.serial));

    // Whoever was revoked gets nothing more, although its certificate still lets it in where nobody knows.
    let list = lab.revoke("thief");
    let thief = lab.start("thief", use_it);
    wait("it is refused", || {
        lab.audit("keeper").iter().any(|r| {
            r.event == "refused"
                && r.peer == Some(lab.id("thief").to_string())
                && r.reason.as_deref().unwrap_or_default().contains("revoked")
        })
    });
    wait("it says why", || thief.status()["drops"]["renewal_refused"].as_u64() >= Some(1));
    assert_eq!(keeper.ask(&AdminRequest::Crl(list))["ok"], true);
    wait("it is cut off", || cloud.refused("revoked") > 0);

    // A revocation covers what was renewed.
    let (_talker, last) = stream.end();
    // Two ways are made anew, each within a few round trips; what is said meanwhile is not said again.
    let lost = hears_some(&listener, 1, last);
    eprintln!("renewal: {lost} of {last} messages lost while the links were replaced");
    listener.hears_nothing();
    let list = lab.revoke("desk");
    assert_eq!(keeper.ask(&AdminRequest::Crl(list))["ok"], true);
    let id = lab.id("desk").to_string();
    wait("the renewed one is cut off, too", || !cloud.peers().contains(&id));
    drop((robot, desk, thief));
}

#[test]
fn a_new_secret_reaches_everyone_but_the_thief() {
    let lab = Lab::new(&["thief"]);
    lab.with_fleet(|fleet| fleet.set_authority(Some("keeper".parse().unwrap()), unix_now()).unwrap());
    ["keeper", "robot", "desk", "late"].iter().for_each(|node| lab.enroll(node, |_| {}));
    let cloud = lab.cloud();
    let keeper = lab.start("keeper", |c| c.authority = Some(lab.fleet_file()));
    let robot = lab.start("robot", |c| c.shares = vec![share("/chatter", &["*"])]);
    let both = |c: &mut Config| c.uses = vec![uses("/chatter"), uses("/later")];
    let desk = lab.start("desk", both);
    let thief = lab.start("thief", both);
    let talker = lab.talker("robot", "/chatter");
    let listener = lab.listener("desk", "/chatter");
    talker.wait_for_readers(1);
    warm_up(&talker, &[&listener]);
    let name_of = |node: &Node, topic: &str| {
        let status = node.status();
        let routes = status["routes"].as_array().unwrap();
        let route = routes.iter().find(|r| r["topic"] == *topic && r["name"].is_string());
        route.map(|r| r["name"].as_str().unwrap().to_owned())
    };
    let before = name_of(&robot, "/chatter").unwrap();
    let stream = Stream::start(talker);
    stream.more(100);

    let list = lab.revoke("thief");
    lab.with_fleet(|fleet| fleet.rotate_secret(unix_now(), &mut OsRng.unwrap_err()).unwrap());
    assert_eq!(keeper.ask(&AdminRequest::Crl(list))["ok"], true);
    let generation = |node: &str| lab.identity(node).naming_secrets()[0].generation;
    wait("robot and desk hold generation 2", || generation("robot") == 2 && generation("desk") == 2);
    wait("the thief is out", || cloud.refused("revoked") > 0);
    robot.reload(|c| c.shares.push(share("/later", &["*"])));
    let later = lab.talker("robot", "/later");
    let hears_later = lab.listener("desk", "/later");
    later.wait_for_readers(1);
    warm_up(&later, &[&hears_later]);
    stream.more(200);
    let (_talker, last) = stream.end();
    hears_each(&listener, 1, last);
    assert_eq!(name_of(&robot, "/chatter"), Some(before.clone()));
    assert_eq!(name_of(&desk, "/chatter"), Some(before));

    // The name of the new share follows from the new secret, and not from the old one.
    let metadata = Metadata::topic("robot", "/later", "std_msgs/msg/String");
    let derived = |node: &str| {
        let secret = lab.identity(node).naming_secrets()[0].secret.clone();
        derive_name(&secret, &lab.id("robot"), &metadata).to_string()
    };
    let found = name_of(&robot, "/later").unwrap();
    assert_eq!((derived("robot"), derived("desk")), (found.clone(), found.clone()));
    assert_eq!(generation("thief"), 1);
    assert_ne!(derived("thief"), found);
    assert_eq!(writers(&lab.net("thief"), "/later"), 0);

    // One that was off meanwhile gets it when it is back.
    assert_eq!(generation("late"), 1);
    let _late = lab.start("late", both);
    wait("it holds generation 2", || generation("late") == 2);
    let late_hears = lab.listener("late", "/later");
    warm_up(&later, &[&late_hears]);
    drop((cloud, keeper, desk, thief));
}

#[test]
fn a_member_publishes_on_a_topic_of_another() {
    let lab = Lab::new(&["robot", "desk1", "desk2", "desk3"]);
    let share_it = |c: &mut Config| {
        let mut share = share("/cmd", &["desk2", "desk3"]);
        share.publish = nodes(&["desk1"]);
        share.type_name = Some("std_msgs/msg/String".into());
        c.shares = vec![share];
    };
    let publish = |c: &mut Config| c.uses = vec![UseConfig { publish: true, ..uses("/cmd") }];
    let mut cloud = lab.cloud();
    let mut robot = lab.start("robot", share_it);
    let mut desk1 = lab.start("desk1", publish);
    let _desk2 = lab.start("desk2", |c| c.uses = vec![uses("/cmd")]);
    let desk3 = lab.start("desk3", publish);
    let talker = lab.talker("desk1", "/cmd");
    let [at_home, at_robot, at_desk2] = ["desk1", "robot", "desk2"].map(|node| lab.listener(node, "/cmd"));
    warm_up(&talker, &[&at_robot, &at_desk2]);
    let stream = Stream::start(talker);
    stream.more(300);
    let (talker, last) = stream.end();
    hears_each(&at_robot, 1, last);
    hears_each(&at_desk2, 1, last);
    hears_each(&at_home, 1, last);

    // Who may subscribe may not publish.
    let intruder = lab.talker("desk3", "/cmd");
    wait("it is told", || desk3.route_state().contains("does not let this node publish"));
    intruder.say("not a number");

    // Whoever comes back, it goes on, and nothing comes twice.
    let mut talker = Some(talker);
    let mut first = last + 1;
    for round in ["robot", "desk1", "cloud"] {
        match round {
            "robot" => {
                robot.kill();
                robot = lab.start("robot", share_it);
            }
            "desk1" => {
                desk1.kill();
                desk1 = lab.start("desk1", publish);
            }
            _ => {
                cloud.kill();
                cloud = lab.cloud();
            }
        }
        let stream = Stream::start_from(talker.take().unwrap(), first);
        for listener in [&at_robot, &at_desk2] {
            let n = listener.samples.recv_timeout(PATIENCE);
            assert!(n.is_ok(), "it does not go on after a restart of {round}");
        }
        stream.more(200);
        let (back, last) = stream.end();
        hears_some(&at_robot, first, last);
        hears_some(&at_desk2, first, last);
        hears_each(&at_home, first, last);
        (talker, first) = (Some(back), last + 1);
    }
    at_home.hears_nothing();
    drop((cloud, robot, desk1));
}
