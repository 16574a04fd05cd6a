//! Trust across whole nodes over real QUIC: access is granted and revoked, and other nodes notice nothing.

#![allow(clippy::unwrap_used)]

#[path = "support/lab.rs"]
mod lab;
mod support;

use std::collections::BTreeSet;
use std::fs;
use std::os::unix::fs::PermissionsExt as _;
use std::sync::Arc;
use std::time::{Duration, Instant};

use bytes::Bytes;
use lab::*;
use rand_core::{OsRng, TryRngCore as _};
use sgc_node::admin::AdminRequest;
use sgc_node::audit::AuditRecord;
use sgc_node::config::{AuthorityConfig, Config, Recipient, TokenConfig, TokenSource, UseConfig};
use sgc_node::partners::{TokenRecord, TokenRecords};
use sgc_transport::{AnyLink, CloseReason, Dialer, Link as _, LinkOptions};
use sgc_trust::{
    EnrollRequest, Identity, Invitation, Kem, KeyRequest, Membership, ReplyKey, ShareToken, Suite,
    TopicSecret, derive_name, name_of, operations_blind, renewal_blind,
};
use sgc_wire::{
    Answer, AnswerBody, Control, Decode as _, Encode as _, GrantContent, Hello, JoinBody, Metadata, Name,
    Operation, OperationAnswer, OperationRefusal, OperationRequest, REDEEM_SINK, RefuseReason, Request,
    SignedBody, SinkId, UnixMillis,
};
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
    // Questions about types and clocks have branches for a moment.
    wait("two topics and two catalogues", || cloud.status()["router"]["branches"] == 4);
    let stream = Stream::start(talker);
    stream.more(200);

    let revoked = lab.id("desk1").to_string();
    let list = lab.revoke("desk1");
    let begun = Instant::now();
    assert_eq!(cloud.ask(&AdminRequest::Crl(list))["ok"]["news"], true);
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
    let refusal = |r: &AuditRecord| {
        r.event == "link_refused" && r.reason.as_ref().is_some_and(|reason| reason.contains("revoked"))
    };
    wait("which the log says", || lab.audit("cloud").iter().any(refusal));
    assert!(!cloud.peers().contains(&revoked));
    stream.more(500);
    let (talker, last) = stream.end();
    hears_each(&two, 1, last);
    two.hears_nothing();
    let one_heard = heard(&one);
    assert!(one_heard.iter().zip(1..).all(|(n, expected)| *n == expected), "{one_heard:?}");
    assert!(one_heard.last().is_some_and(|n| *n <= mark), "it heard {:?}, of {mark}", one_heard.last());

    // The router returns with its kept lists while no node is there to tell it.
    let kept = lab.state("cloud").join("crl");
    wait("the list is kept", || fs::read_dir(&kept).is_ok_and(|files| files.count() == 1));
    wait("the robot keeps it, too", || fs::read_dir(lab.state("robot").join("crl")).is_ok());
    robot.kill();
    desk2.kill();
    cloud.kill();
    let cloud = lab.cloud();
    wait("it is refused", || cloud.refused("revoked") > 0);
    assert_eq!(cloud.status()["links"].as_array().map(Vec::len), Some(0));

    // A router without lists gets them from the robot.
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
    let robot = lab.start("robot", |c| {
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
    let status = robot.status();
    for (suite, topic) in &topics {
        let route = status["routes"].as_array().unwrap().iter().find(|route| route["topic"] == **topic);
        let signs = route.unwrap()["signatures"].as_u64().unwrap() > 0;
        assert_eq!(signs, suite.is_signed() && !suite.is_pairwise(), "{suite}: {status}");
    }
}

#[test]
fn certificates_and_secrets_are_renewed_while_messages_flow() {
    let lab = Lab::new(&["robot"]);
    lab.with_fleet(|fleet| fleet.set_authority(Some("keeper".parse().unwrap()), unix_now()).unwrap());
    // The certificates are ten minutes old and valid for fifteen, so less than a third is left.
    for node in ["keeper", "robot", "desk", "thief"] {
        lab.enroll(node, |request| {
            request.valid = Duration::from_secs(900);
            request.now.0 -= 630_000;
        });
    }
    let mut old_copy = sgc_node::read_fleet(&lab.fleet_file()).unwrap();
    let cloud = lab.cloud();
    let share_it = |c: &mut Config| c.shares = vec![share("/chatter", &["desk"])];
    let use_it = |c: &mut Config| c.uses = vec![uses("/chatter")];
    let until = |node: &str| lab.identity(node).not_after();
    let (old, old_keeper) = (lab.identity("desk"), lab.identity("keeper"));
    let old_robot = lab.identity("robot");
    let (robot, desk) = (lab.start("robot", share_it), lab.start("desk", use_it));
    let talker = lab.talker("robot", "/chatter");
    let listener = lab.listener("desk", "/chatter");
    talker.wait_for_readers(1);
    warm_up(&talker, &[&listener]);
    let stream = Stream::start(talker);
    stream.more(100);
    assert_eq!((until("desk"), lab.identity("desk").chain()), (old.not_after(), old.chain()));

    let keeper = lab.start("keeper", |c| c.authority = Some(AuthorityConfig::new(lab.fleet_file())));
    wait("both have new certificates", || {
        lab.identity("desk").chain() != old.chain() && lab.identity("robot").chain() != old_robot.chain()
    });
    wait("the authority renews its own", || lab.identity("keeper").chain() != old_keeper.chain());
    let new = lab.identity("desk");
    assert_eq!(fs::metadata(lab.path("desk.identity")).unwrap().permissions().mode() & 0o7777, 0o600);
    // Renewal does not add the ten minutes each time.
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

    // A new certificate is not renewed again.
    let certificates = || {
        let read = sgc_node::read_fleet(&lab.fleet_file()).unwrap();
        read.nodes().map(|n| n.certificates.len()).collect::<Vec<_>>()
    };
    let before = certificates();
    stream.more(500);
    assert_eq!(certificates(), before);

    // A revoked node gets nothing more, although its certificate still admits it where the revocation is unknown.
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
    assert_eq!(keeper.ask(&AdminRequest::Crl(list))["ok"]["news"], true);
    wait("it is cut off", || cloud.refused("revoked") > 0);

    // A revocation covers renewed certificates, also if a copy of the fleet file made it that does not know them.
    let (_talker, last) = stream.end();
    // Two paths are rebuilt, each within a few round trips. Messages published meanwhile are not repeated.
    let lost = hears_some(&listener, 1, last);
    eprintln!("renewal: {lost} of {last} messages lost while the links were replaced");
    listener.hears_nothing();
    let desk_name = "desk".parse().unwrap();
    old_copy.revoke(std::slice::from_ref(&desk_name), unix_now()).unwrap();
    let list = old_copy.revocation_list(unix_now()).unwrap();
    let answer = cloud.ask(&AdminRequest::Crl(list));
    assert_eq!(answer["ok"]["news"], true);
    assert_eq!(answer["ok"]["lists"].as_array().map(Vec::len), Some(1), "the thief's");
    let id = lab.id("desk").to_string();
    wait("the renewed one is cut off, too", || !cloud.peers().contains(&id));
    // The authority's file learns the revocation and keeps its own entries.
    wait("the authority's file knows", || {
        let fleet = sgc_node::read_fleet(&lab.fleet_file()).unwrap();
        fleet.nodes().filter(|n| fleet.revoked_at(n).is_some()).count() == 2
    });
    drop((robot, desk, thief));
}

#[test]
fn a_reload_takes_the_identity_in_a_replaced_file_while_messages_flow() {
    let lab = Lab::new(&["robot", "desk", "other"]);
    let cloud = lab.cloud();
    let robot = lab.start("robot", |c| c.shares = vec![share("/chatter", &["desk"])]);
    let desk = lab.start("desk", |c| c.uses = vec![uses("/chatter")]);
    let talker = lab.talker("robot", "/chatter");
    let listener = lab.listener("desk", "/chatter");
    talker.wait_for_readers(1);
    warm_up(&talker, &[&listener]);
    let stream = Stream::start(talker);
    stream.more(100);
    assert_eq!(robot.reload(|_| {})["changed"].as_array().map(Vec::len), Some(0));

    // Another key, a later end and a group, at both ends and at the router.
    let is_shown = |node: &str| {
        let (id, until) = (lab.id(node).to_string(), lab.identity(node).not_after().to_string());
        let status = cloud.status();
        let links: Vec<_> = status["links"].as_array().unwrap().iter().filter(|l| l["peer"] == *id).collect();
        links.len() == 1 && links[0]["peer_until"] == *until
    };
    for (node, running) in [("robot", &robot), ("desk", &desk), ("cloud", &cloud)] {
        let before = lab.identity(node);
        std::thread::sleep(Duration::from_millis(1100));
        lab.enroll(node, |request| {
            request.valid += Duration::from_secs(86_400);
            request.router = node == "cloud";
            request.groups = vec!["arms".parse().unwrap()];
        });
        assert_ne!(lab.identity(node).chain(), before.chain());
        let report = running.reload(|_| {});
        let said = report["changed"][0].as_str().unwrap();
        assert!(said.starts_with("this node has the identity of its replaced file, until"), "{report}");
        assert_eq!(report["needs_restart"].as_array().map(Vec::len), Some(0), "{report}");
        if node != "cloud" {
            wait("one link, with the new certificate", || is_shown(node));
        }
        stream.more(200);
    }
    let by_file = |r: &AuditRecord| {
        r.event == "renewed"
            && r.reason.as_deref().is_some_and(|reason| reason.contains("by a replaced file"))
    };
    assert!(lab.audit("robot").iter().any(by_file));
    // The second reload finds what the first one took.
    assert_eq!(robot.reload(|_| {})["changed"].as_array().map(Vec::len), Some(0));

    // A file that this run cannot use is refused, and said.
    let kept = lab.identity("desk");
    fs::copy(lab.path("other.identity"), lab.path("desk.identity")).unwrap();
    let report = desk.reload(|_| {});
    let said = report["needs_restart"][0].as_str().unwrap();
    assert!(said.contains("the file is of another node, which needs a restart"), "{report}");
    let alerts = desk.status()["alerts"].to_string();
    assert!(alerts.contains("restart_pending"), "{alerts}");
    lab.enroll("desk", |request| request.now.0 -= 3_600_000);
    let report = desk.reload(|_| {});
    let said = report["warnings"][0].as_str().unwrap();
    assert!(said.contains("is older than what this node has"), "{report}");
    assert_eq!(report["needs_restart"].as_array().map(Vec::len), Some(0), "{report}");
    // Whatever is in the file, the rest of the configuration counts.
    fs::write(lab.path("desk.identity"), "nothing").unwrap();
    let report = desk.reload(|c| c.uses.push(uses("/other")));
    assert!(report["warnings"][0].as_str().unwrap().contains("desk.identity"), "{report}");
    assert_eq!(report["changed"].as_array().map(Vec::len), Some(1), "{report}");
    write_secret(&lab.path("desk.identity"), &kept.to_text());
    assert_eq!(desk.reload(|_| {})["needs_restart"].as_array().map(Vec::len), Some(0));
    stream.more(200);
    let (_talker, last) = stream.end();
    hears_each(&listener, 1, last);
    listener.hears_nothing();
}

#[test]
fn a_node_that_asks_again_gets_the_same_certificate() {
    let lab = Lab::new(&[]);
    lab.with_fleet(|fleet| fleet.set_authority(Some("keeper".parse().unwrap()), unix_now()).unwrap());
    lab.enroll("keeper", |_| {});
    // Less than a third of an hour is left.
    lab.enroll("desk", |request| {
        request.valid = Duration::from_secs(3600);
        request.now.0 -= 2_500_000;
    });
    let (_cloud, keeper) =
        (lab.cloud(), lab.start("keeper", |c| c.authority = Some(AuthorityConfig::new(lab.fleet_file()))));
    let old = lab.identity("desk");
    let desk = lab.start("desk", |_| {});
    wait("it is renewed", || lab.identity("desk").chain() != old.chain());
    let renewed = lab.identity("desk");
    drop(desk);
    let certificates = || {
        let read = sgc_node::read_fleet(&lab.fleet_file()).unwrap();
        read.node(&"desk".parse().unwrap()).unwrap().certificates.len()
    };
    assert_eq!(certificates(), 2);

    // A request for another key has to wait, and its node is told so.
    let request = EnrollRequest {
        valid: Duration::from_secs(3600),
        ..EnrollRequest::new("desk".parse().unwrap(), UnixMillis(unix_now().0 - 2_500_000))
    };
    let read = sgc_node::read_fleet(&lab.fleet_file()).unwrap();
    let other = read.issue(&request, &mut OsRng.unwrap_err()).unwrap();
    write_secret(&lab.path("desk.identity"), &other.to_text());
    let desk = lab.start("desk", |_| {});
    wait("it is refused", || desk.status()["drops"]["renewal_refused"].as_u64() >= Some(1));
    assert_eq!(keeper.status()["drops"]["renewal_too_soon"], 1, "{}", keeper.status());
    drop(desk);

    // A request for the same key gets the same certificate, as after a start from a copy.
    for _ in 0..2 {
        write_secret(&lab.path("desk.identity"), &old.to_text());
        let desk = lab.start("desk", |_| {});
        wait("it has the same certificate", || lab.identity("desk").chain() == renewed.chain());
        drop(desk);
    }
    assert_eq!(certificates(), 2);
}

impl Lab {
    /// Creates a fleet with an authority, `keeper`, and an operator, `desk`.
    fn with_operator(nodes: &[&str]) -> Self {
        let lab = Self::new(&[]);
        lab.with_fleet(|fleet| fleet.set_authority(Some("keeper".parse().unwrap()), unix_now()).unwrap());
        lab.enroll("keeper", |_| {});
        lab.enroll("desk", |request| request.groups.push("operators".parse().unwrap()));
        nodes.iter().for_each(|node| lab.enroll(node, |_| {}));
        lab
    }

    fn keeper(&self) -> Node {
        self.start("keeper", |c| {
            let operators = vec![Recipient::Group("operators".parse().unwrap())];
            c.authority = Some(AuthorityConfig { fleet: self.fleet_file(), operators });
        })
    }

    fn certificates(&self, node: &str) -> usize {
        let read = sgc_node::read_fleet(&self.fleet_file()).unwrap();
        read.node(&node.parse().unwrap()).map_or(0, |n| n.certificates.len())
    }
}

/// Requests an operation from an authority. Returns the answer, or the user's error message.
fn operate(node: &Node, at: &str, operation: Operation) -> Result<OperationAnswer, String> {
    use base64::Engine as _;
    let answer = node.ask(&AdminRequest::Operate { at: at.parse().unwrap(), operation });
    match answer["error"].as_str() {
        Some(error) => Err(error.to_owned()),
        None => {
            let encoded = answer["ok"]["answer"].as_str().unwrap();
            let bytes = base64::engine::general_purpose::STANDARD.decode(encoded).unwrap();
            Ok(OperationAnswer::from_slice(&bytes).unwrap())
        }
    }
}

fn revoke(node: &str) -> Operation {
    Operation::Revoke { nodes: vec![node.to_owned()] }
}

/// Returns a request for a certificate whose key is thrown away.
fn enroll(node: &str) -> Operation {
    let made = KeyRequest::generate(None, &mut OsRng.unwrap_err()).unwrap();
    Operation::Enroll {
        node: node.to_owned(),
        groups: vec!["arms".into()],
        router: false,
        may_route: false,
        again: false,
        valid_ms: 3_600_000,
        csr: Bytes::copy_from_slice(made.csr()),
    }
}

#[test]
fn an_operator_has_operations_carried_out_at_the_authority() {
    let lab = Lab::with_operator(&["thief", "guest"]);
    let (cloud, keeper) = (lab.cloud(), lab.keeper());
    let (desk, thief) = (lab.start("desk", |_| {}), lab.start("thief", |_| {}));
    wait("all are linked", || cloud.peers().len() == 3);

    let done = operate(&desk, "keeper", enroll("arm"));
    let Ok(OperationAnswer::Membership(text)) = done else { panic!("{done:?}") };
    let member = Membership::parse(text.expose()).unwrap();
    assert_eq!((member.node_name().as_str(), lab.certificates("arm")), ("arm", 1));
    let listed = operate(&desk, "keeper", Operation::List { after: None });
    let Ok(OperationAnswer::Roster(roster)) = listed else { panic!("{listed:?}") };
    let names: Vec<_> = roster.nodes.iter().map(|node| node.name.as_str()).collect();
    assert_eq!(names, ["arm", "cloud", "desk", "guest", "keeper", "thief"]);
    let of = |name: &str| roster.nodes.iter().find(|node| node.name == name).unwrap();
    assert_eq!((&of("arm").groups[..], roster.more), (&["arms".to_owned()][..], false));
    let rest = operate(&desk, "keeper", Operation::List { after: Some("guest".into()) });
    let Ok(OperationAnswer::Roster(rest)) = rest else { panic!("{rest:?}") };
    assert_eq!(rest.nodes.len(), 2);

    // A revoked node loses access everywhere at once.
    let id = lab.id("thief").to_string();
    let done = operate(&desk, "keeper", revoke("thief"));
    assert!(matches!(done, Ok(OperationAnswer::Revoked { list: 1.. })), "{done:?}");
    wait("the thief is cut off", || !cloud.peers().contains(&id));
    let said: Vec<_> = lab.audit("keeper").into_iter().filter(|r| r.event == "operation").collect();
    assert!(said.iter().all(|r| r.peer == Some(lab.id("desk").to_string())), "{said:?}");
    let said: Vec<_> = said.iter().map(|r| r.reason.as_deref().unwrap()).collect();
    assert_eq!(said, ["enroll arm: done", "list: done", "list: done", "revoke thief: done"]);

    // Impossible operations are refused with a reason.
    let refused = |done: Result<OperationAnswer, String>| match done {
        Ok(OperationAnswer::Refused { detail, .. }) => detail,
        other => panic!("{other:?}"),
    };
    assert!(refused(operate(&desk, "keeper", revoke("nobody"))).contains("has no node nobody"));
    assert!(refused(operate(&desk, "keeper", revoke("keeper"))).contains("does not revoke itself"));
    assert!(refused(operate(&desk, "keeper", enroll("thief"))).contains("was revoked at"));
    assert_eq!(keeper.drops("operation_refused"), 3);
    let own = operate(&keeper, "keeper", revoke("guest")).unwrap_err();
    assert!(own.contains("keeper is this node"), "{own}");
    let routers = operate(&cloud, "keeper", revoke("guest")).unwrap_err();
    assert!(routers.contains("this node is a router"), "{routers}");
    let wrong = operate(&desk, "keepr", revoke("guest")).unwrap_err();
    assert!(wrong.starts_with("no authority keepr is in reach of this node"), "{wrong}");
    assert!(wrong.contains("whose identity names another authority"), "{wrong}");
    drop((desk, thief));
}

#[test]
fn non_operator_changes_nothing() {
    let lab = Lab::with_operator(&["guest", "thief"]);
    let (_cloud, keeper) = (lab.cloud(), lab.keeper());
    let guest = lab.start("guest", |_| {});
    for operation in [revoke("desk"), enroll("mine"), Operation::List { after: None }] {
        let said = operate(&guest, "keeper", operation).unwrap_err();
        assert!(said.starts_with("keeper does not take this node for an operator"), "{said}");
    }
    assert!(keeper.drops("operation_not_permitted") >= 3);
    let refused = |r: &AuditRecord| {
        r.event == "refused" && r.reason.as_deref() == Some("an operation: it is no operator")
    };
    assert!(lab.audit("keeper").iter().any(refused));
    assert_eq!(lab.certificates("mine"), 0);

    // A reload makes it an operator, and takes that back.
    let set = |operators: &[&str]| {
        let operators = operators.iter().map(|node| Recipient::Node(node.parse().unwrap())).collect();
        let report = keeper.reload(|c| c.authority.as_mut().unwrap().operators = operators);
        assert_eq!(
            report["changed"],
            serde_json::json!(["who may change the fleet here changed"]),
            "{report}"
        );
        assert_eq!(report["needs_restart"], serde_json::json!([]));
    };
    set(&["guest"]);
    let listed = operate(&guest, "keeper", Operation::List { after: None });
    assert!(matches!(listed, Ok(OperationAnswer::Roster(_))), "{listed:?}");
    set(&[]);
    let said = operate(&guest, "keeper", Operation::List { after: None }).unwrap_err();
    assert!(said.starts_with("keeper does not take this node for an operator"), "{said}");
    drop(keeper);

    // Without operators, an authority answers the invited alone.
    let _keeper = lab.start("keeper", |c| c.authority = Some(AuthorityConfig::new(lab.fleet_file())));
    let desk = lab.start("desk", |_| {});
    let said = operate(&desk, "keeper", revoke("guest")).unwrap_err();
    assert!(said.starts_with("keeper does not take this node for an operator"), "{said}");
}

/// A member that speaks the protocol without a node.
struct ByHand {
    runtime: tokio::runtime::Runtime,
    dialer: Dialer,
    link: AnyLink,
    identity: Arc<Identity>,
}

impl ByHand {
    /// Links to the router and waits until it knows `name`.
    fn start(lab: &Lab, node: &str, name: Name) -> Self {
        Self::start_as(lab, lab.identity(node), name)
    }

    fn start_as(lab: &Lab, identity: Arc<Identity>, name: Name) -> Self {
        let runtime = tokio::runtime::Runtime::new().unwrap();
        let _enter = runtime.enter();
        let dialer = Dialer::new(identity.clone(), LinkOptions::default(), Arc::default());
        let link = runtime.block_on(dialer.dial(&lab.url().parse().unwrap())).unwrap();
        drop(_enter);
        let member = Self { runtime, dialer, link, identity };
        let (started, yields) = (unix_now(), false);
        let hello = Hello { minor: 0, incarnation: 7, transit: false, started, yields };
        member.send(&Control::Hello(hello));
        member.send(&Control::Interest { names: vec![name] });
        member.hear(|frame| matches!(frame, Control::Advert { .. }).then_some(()));
        member
    }

    fn send(&self, frame: &Control) {
        self.runtime.block_on(self.link.send_control(frame.to_bytes())).unwrap();
    }

    fn hear<T>(&self, wanted: impl Fn(Control) -> Option<T>) -> T {
        self.runtime.block_on(async {
            loop {
                let frame = tokio::time::timeout(PATIENCE, self.link.recv_control()).await;
                let frame = Control::from_slice(&frame.expect("a frame comes").unwrap()).unwrap();
                if let Some(found) = wanted(frame) {
                    return found;
                }
            }
        })
    }

    /// Returns a signed request to `name`, and the key that opens its answer.
    fn request(&self, name: Name, sink: u8, request: &OperationRequest) -> (SignedBody, ReplyKey) {
        let reply_key = ReplyKey::generate(Kem::X25519);
        let body = JoinBody {
            name,
            sink: SinkId([sink; 16]),
            request: Request::Ask { what: request.to_bytes() },
            issued_at: unix_now(),
            chain: self.identity.chain_bytes(),
            reply_key: reply_key.public().clone(),
        };
        (self.identity.sign_join(&body), reply_key)
    }

    /// Sends the request and opens its answer.
    fn ask(&self, name: Name, sink: u8, signed: &SignedBody, reply_key: &ReplyKey) -> OperationAnswer {
        let id = SinkId([sink; 16]);
        let body = loop {
            self.send(&Control::Join { signed: signed.clone() });
            let body = self.hear(|frame| match frame {
                Control::Answer { signed } => {
                    Some(Some(AnswerBody::from_slice(&signed.body).unwrap()).filter(|body| body.sink == id))
                }
                // For a while after its start, no route leads to the authority.
                Control::Reject { sink, .. } if sink == id => Some(None),
                _ => None,
            });
            match body {
                Some(body) => break body,
                None => std::thread::sleep(Duration::from_millis(50)),
            }
        };
        self.send(&Control::Leave { name, sink: id });
        let Answer::Grant { enc, sealed } = body.answer else { panic!("{:?}", body.answer) };
        match reply_key.open(&name, &id, body.serial, &enc, &sealed).unwrap() {
            GrantContent::Operation(answer) => answer,
            other => panic!("{other:?}"),
        }
    }
}

#[test]
fn a_request_that_was_recorded_and_comes_again_is_not_carried_out_again() {
    let lab = Lab::with_operator(&[]);
    let (_cloud, keeper) = (lab.cloud(), lab.keeper());
    let ca = lab.identity("keeper").as_peer().ca;
    let name = name_of(&lab.id("keeper"), &operations_blind(&ca));
    let desk = ByHand::start(&lab, "desk", name);
    let (asks, key) = desk.request(name, 1, &OperationRequest::Challenge);
    let OperationAnswer::Challenge(challenge) = desk.ask(name, 1, &asks, &key) else {
        panic!("no challenge")
    };
    let execute = OperationRequest::Execute { challenge, operation: enroll("arm") };
    let (recorded, key) = desk.request(name, 2, &execute);
    let first = desk.ask(name, 2, &recorded, &key);
    assert!(matches!(first, OperationAnswer::Membership(_)), "{first:?}");
    assert_eq!(lab.certificates("arm"), 1);

    // A router could replay the same frame, and another request of the same node could have its content.
    assert_eq!(desk.ask(name, 2, &recorded, &key), first);
    let (again, other_key) = desk.request(name, 3, &execute);
    assert_eq!(desk.ask(name, 3, &again, &other_key), first);
    // A request that a router rejects late may have arrived, and is sent once more.
    assert!(lab.certificates("arm") == 1 && keeper.drops("operation_repeated") >= 2);

    // Another run of the authority does not know the challenge and refuses.
    keeper.kill();
    let keeper = lab.keeper();
    desk.hear(|frame| matches!(frame, Control::Advert { .. }).then_some(()));
    let stale = desk.ask(name, 2, &recorded, &key);
    assert!(matches!(stale, OperationAnswer::Refused { why: OperationRefusal::Stale, .. }), "{stale:?}");
    assert!(lab.certificates("arm") == 1 && keeper.drops("operation_stale") >= 1);
    desk.runtime.block_on(desk.dialer.close(CloseReason::Goodbye));
}

#[test]
fn the_holder_of_an_invitation_gets_its_identity_once_and_nothing_else() {
    let lab = Lab::with_operator(&[]);
    let (cloud, keeper) = (lab.cloud(), lab.keeper());
    let desk = lab.start("desk", |_| {});
    let invite = Operation::Invite {
        node: "arm".into(),
        groups: vec!["arms".into()],
        router: false,
        may_route: false,
        again: false,
        valid_ms: 3_600_000,
        within_ms: 600_000,
        routers: vec![lab.url()],
    };
    let done = operate(&desk, "keeper", invite);
    let Ok(OperationAnswer::Invitation(code)) = done else { panic!("{done:?}") };
    // A member has nothing to redeem.
    let made = KeyRequest::generate(None, &mut OsRng.unwrap_err()).unwrap();
    let sealed_to = ReplyKey::generate(Kem::X25519);
    let redeem = || Operation::Redeem {
        csr: Bytes::copy_from_slice(made.csr()),
        reply_key: sealed_to.public().clone(),
    };
    let said = operate(&desk, "keeper", redeem()).unwrap_err();
    assert!(said.starts_with("keeper does not take this node for an operator"), "{said}");

    let invitation = Invitation::parse(code.expose()).unwrap();
    let holder = Arc::new(invitation.identity(&mut OsRng.unwrap_err()).unwrap());
    let ca = holder.as_peer().ca;
    let name = name_of(&lab.id("keeper"), &operations_blind(&ca));
    let guest = ByHand::start_as(&lab, holder, name);
    let challenge = |sink| {
        let (asks, key) = guest.request(name, sink, &OperationRequest::Challenge);
        match guest.ask(name, sink, &asks, &key) {
            OperationAnswer::Challenge(challenge) => challenge,
            other => panic!("{other:?}"),
        }
    };
    // It operates nothing, and reaches no other name.
    let (list, challenge_1) = (Operation::List { after: None }, challenge(1));
    let execute = OperationRequest::Execute { challenge: challenge_1, operation: list };
    let (asks, _) = guest.request(name, 2, &execute);
    guest.send(&Control::Join { signed: asks });
    guest.hear(|frame| match frame {
        Control::Answer { signed } => {
            let body = AnswerBody::from_slice(&signed.body).unwrap();
            (body.answer == Answer::Refuse { reason: RefuseReason::NotPermitted }).then_some(())
        }
        _ => None,
    });
    let renewals = name_of(&lab.id("keeper"), &renewal_blind(&ca));
    let (asks, _) = guest.request(renewals, 3, &OperationRequest::Challenge);
    guest.send(&Control::Join { signed: asks });
    let is_rejected = |frame| matches!(frame, Control::Reject { name, .. } if name == renewals).then_some(());
    guest.hear(is_rejected);
    assert_eq!(cloud.drops("invited"), 1);

    let execute = OperationRequest::Execute { challenge: challenge(4), operation: redeem() };
    let (recorded, key) = guest.request(name, 5, &execute);
    let first = guest.ask(name, 5, &recorded, &key);
    let OperationAnswer::Sealed { enc, sealed } = &first else { panic!("{first:?}") };
    // Another holder of the code may repeat the request, and gets an answer that it cannot open.
    let (again, other_key) = guest.request(name, 6, &execute);
    assert_eq!(guest.ask(name, 6, &again, &other_key), first);
    assert!(other_key.open(&name, &REDEEM_SINK, 0, enc, sealed).is_err());
    let opened = sealed_to.open(&name, &REDEEM_SINK, 0, enc, sealed).unwrap();
    let GrantContent::Operation(OperationAnswer::Membership(text)) = opened else { panic!("{opened:?}") };
    let arm = Identity::join(Membership::parse(text.expose()).unwrap(), made.key(), &mut OsRng.unwrap_err());
    let fleet = sgc_node::read_fleet(&lab.fleet_file()).unwrap();
    let arm = arm.unwrap().node_id();
    assert_eq!(arm, fleet.node_id_of(&"arm".parse().unwrap()));
    // Another request gets none, and only a few are looked at.
    let mut refusals = Vec::new();
    for sink in 7..20 {
        let execute = OperationRequest::Execute { challenge: challenge(sink), operation: redeem() };
        let (asks, key) = guest.request(name, sink + 20, &execute);
        match guest.ask(name, sink + 20, &asks, &key) {
            OperationAnswer::Refused { why, detail } => refusals.push((why, detail)),
            other => panic!("{other:?}"),
        }
    }
    let used = |(why, detail): &(OperationRefusal, String)| {
        *why == OperationRefusal::Fleet && detail.starts_with("the invitation of arm was used")
    };
    assert!(used(&refusals[0]), "{refusals:?}");
    let many = "too many attempts with this code: ask for another one";
    assert!(refusals[12] == (OperationRefusal::Fleet, many.to_owned()), "{refusals:?}");
    assert!(matches!(
        operate(&desk, "keeper", Operation::List { after: None }),
        Ok(OperationAnswer::Roster(_))
    ));
    let said: Vec<_> = lab.audit("keeper").into_iter().filter(|r| r.event == "operation").collect();
    assert_eq!(said[0].reason.as_deref(), Some("invite arm: done"));
    let joined = (Some(arm.to_string()), Some("redeem the invitation of arm: done".to_owned()));
    assert_eq!((said[1].peer.clone(), said[1].reason.clone()), joined);
    assert!(keeper.drops("operation_not_permitted") >= 2);
    guest.runtime.block_on(guest.dialer.close(CloseReason::Goodbye));
    drop(desk);
}

#[test]
fn an_authority_with_a_restored_file_learns_the_revocations_that_it_kept() {
    let lab = Lab::with_operator(&["thief"]);
    let copy = fs::read(lab.fleet_file()).unwrap();
    let (_cloud, keeper) = (lab.cloud(), lab.keeper());
    assert_eq!(keeper.ask(&AdminRequest::Crl(lab.revoke("thief")))["ok"]["news"], true);
    let kept = lab.state("keeper").join("crl");
    wait("the list is kept", || fs::read_dir(&kept).is_ok_and(|files| files.count() == 1));
    keeper.kill();
    fs::write(lab.fleet_file(), copy).unwrap();
    let _keeper = lab.keeper();
    let is_revoked = || {
        let fleet = sgc_node::read_fleet(&lab.fleet_file()).unwrap();
        fleet.nodes().any(|node| node.name.as_str() == "thief" && fleet.revoked_at(node).is_some())
    };
    wait("the file knows", is_revoked);
}

#[test]
fn telling_a_router_a_list_returns_those_that_it_has() {
    let lab = Lab::new(&["desk", "tab"]);
    let mut old_copy = sgc_node::read_fleet(&lab.fleet_file()).unwrap();
    let cloud = lab.cloud();
    let theirs = lab.revoke("desk");
    assert_eq!(cloud.ask(&AdminRequest::Crl(theirs.clone()))["ok"]["news"], true);

    old_copy.revoke(&["tab".parse().unwrap()], unix_now()).unwrap();
    let ours = old_copy.revocation_list(unix_now()).unwrap();
    let request = EnrollRequest { router: true, ..EnrollRequest::new("keeper".parse().unwrap(), unix_now()) };
    let keeper = Arc::new(old_copy.issue(&request, &mut OsRng.unwrap_err()).unwrap());
    let url = lab.url().parse().unwrap();
    let runtime = tokio::runtime::Runtime::new().unwrap();
    let heard = runtime.block_on(sgc_node::push_crl(&url, keeper, ours.into())).unwrap();
    assert_eq!(heard, [theirs]);
    // The copy knows now that it is outdated, and both nodes are revoked everywhere.
    let anchors = old_copy.anchors().with_crl(&heard[0], unix_now()).unwrap().unwrap();
    let absorbed = old_copy.absorb(&anchors, unix_now()).unwrap();
    assert_eq!(absorbed.revoked, ["desk"]);
    wait("the router has both", || {
        fs::read_dir(lab.state("cloud").join("crl")).is_ok_and(|d| d.count() == 2)
    });
}

#[test]
fn a_new_secret_reaches_everyone_but_the_thief() {
    let lab = Lab::new(&["thief"]);
    lab.with_fleet(|fleet| fleet.set_authority(Some("keeper".parse().unwrap()), unix_now()).unwrap());
    ["keeper", "robot", "desk", "late"].iter().for_each(|node| lab.enroll(node, |_| {}));
    let cloud = lab.cloud();
    let keeper = lab.start("keeper", |c| c.authority = Some(AuthorityConfig::new(lab.fleet_file())));
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
    assert_eq!(keeper.ask(&AdminRequest::Crl(list))["ok"]["news"], true);
    let generation = |node: &str| lab.identity(node).naming_secrets()[0].generation;
    wait("robot and desk hold generation 2", || generation("robot") == 2 && generation("desk") == 2);
    wait("the authority, too", || generation("keeper") == 2);
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

    // The new share's name is derived from the new secret, not from the old one.
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

    // A node that was off gets the secret when it returns.
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

    // The right to subscribe does not include the right to publish.
    let intruder = lab.talker("desk3", "/cmd");
    wait("it is told", || desk3.route_state().contains("does not let this node publish"));
    intruder.say("not a number");

    // Whichever node restarts, messages continue and none is repeated.
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

/// Returns an owner's token for a partner, as `sgc token share` makes it.
fn token_for(lab: &Lab, topic: &str, partner: &Lab, node: Option<&str>, recorded: bool) -> (ShareToken, u64) {
    let owner = lab.identity("robot");
    let mut share = share(topic, &["desk"]);
    share.type_name = Some("std_msgs/msg/String".into());
    let metadata = sgc_node::policy::metadata(&share, "robot");
    let token = ShareToken {
        owner: owner.node_id(),
        owner_name: owner.node_name().clone(),
        ca: owner.anchors().certificates().next().unwrap().clone(),
        secret: TopicSecret::derive(&owner.naming_secrets()[0].secret, &metadata),
        metadata,
        routers: vec![lab.url()],
        expires: UnixMillis(unix_now().0 + 3_600_000),
    };
    let record = TokenRecord {
        id: 0,
        topic: topic.to_owned(),
        type_name: "std_msgs/msg/String".to_owned(),
        name: token.name().to_string(),
        ca: partner.ca().1,
        ca_pem: fs::read_to_string(partner.ca().0).unwrap(),
        node: node.map(|node| partner.id(node).to_string()),
        created: unix_now().0,
        expires: token.expires.0,
    };
    let state = lab.state("robot");
    let id = recorded.then(|| TokenRecords::change(&state, |r| r.add(record, unix_now())).unwrap());
    (token, id.unwrap_or(0))
}

#[test]
fn a_partner_gets_what_its_token_is_for_until_it_is_withdrawn() {
    let lab = Lab::new(&["robot", "desk"]);
    let acme = lab.beside("acme");
    ["arm", "other"].iter().for_each(|node| acme.enroll(node, |_| {}));
    let cloud = lab.cloud();
    let robot =
        lab.start("robot", |c| c.shares = vec![share("/pose", &["desk"]), share("/private", &["desk"])]);
    let _desk = lab.start("desk", |c| c.uses = vec![uses("/pose")]);
    let (talker, private) = (lab.talker("robot", "/pose"), lab.talker("robot", "/private"));
    let (token, id) = token_for(&lab, "/pose", &acme, Some("arm"), true);
    // A leaked topic secret alone admits nobody.
    let (leaked, _) = token_for(&lab, "/private", &acme, Some("arm"), false);
    assert_eq!(robot.reload(|_| {})["changed"][0], "/pose: who may subscribe changed");
    let with = |tokens: &[&ShareToken]| {
        let by = |t: &&ShareToken| {
            let source = TokenSource::Text(Box::new((*t).clone()));
            TokenConfig {
                source,
                naming: Default::default(),
                frame_prefix: None,
                dead_man: None,
                qos: Default::default(),
                dedicated: false,
            }
        };
        let all: Vec<_> = tokens.iter().map(by).collect();
        move |c: &mut Config| c.tokens = all.clone()
    };
    let arm = acme.start("arm", with(&[&token, &leaked]));
    let other = acme.start("other", with(&[&token]));
    let (arm_id, other_id) = (acme.id("arm").to_string(), acme.id("other").to_string());

    // A router that does not trust that CA refuses its nodes until a reload adds the CA.
    wait("they are refused", || cloud.refused("other_ca") >= 2);
    assert!(cloud.peers().is_disjoint(&[arm_id.clone(), other_id.clone()].into()));
    let report = cloud.reload(|c| c.trust = vec![acme.ca().0]);
    assert_eq!(report["changed"][0], "nodes of another CA may link to this one");
    assert_eq!(report["needs_restart"].as_array().map(Vec::len), Some(0));
    wait("they are let in", || cloud.peers().is_superset(&[arm_id.clone(), other_id.clone()].into()));

    let (at_desk, at_arm) = (lab.listener("desk", "/pose"), acme.listener("arm", "/pose"));
    let (at_other, peeks) = (acme.listener("other", "/pose"), acme.listener("arm", "/private"));
    warm_up(&talker, &[&at_desk, &at_arm]);
    let stream = Stream::start(talker);
    stream.more(100);
    private.say("for the fleet alone");
    let state_of = |node: &Node, topic: &str| {
        let status = node.status();
        let route = status["routes"].as_array().unwrap().iter().find(|r| r["topic"] == *topic).cloned();
        route.unwrap()["state"].as_str().unwrap().to_owned()
    };
    wait("another node with the token is refused", || other.route_state().starts_with("refused"));
    wait("another topic is refused", || state_of(&arm, "/private").starts_with("refused"));
    let refused = |peer: &str| {
        let by = |r: &AuditRecord| r.event == "refused" && r.peer.as_deref() == Some(peer);
        lab.audit("robot").iter().any(by)
    };
    assert!(refused(&arm_id) && refused(&other_id));
    stream.more(100);

    // After a withdrawal the partner is cut off at once, and other nodes notice nothing.
    TokenRecords::change(&lab.state("robot"), |records| records.withdraw(id)).unwrap();
    robot.reload(|_| {});
    wait("a new epoch", || lab.epoch("robot") >= 2);
    let mark = stream.said();
    wait("it is told", || state_of(&arm, "/pose").contains("refused"));
    stream.more(300);
    let (_talker, last) = stream.end();
    hears_each(&at_desk, 1, last);
    at_desk.hears_nothing();
    let got = heard(&at_arm);
    assert!(got.iter().zip(1..).all(|(n, expected)| *n == expected), "{got:?}");
    assert!((100..=mark).contains(got.last().unwrap()), "it heard {:?}, of {mark}", got.last());
    at_other.hears_nothing();
    peeks.hears_nothing();

    // The router no longer trusts that CA: it cuts its nodes off and refuses them.
    let before = cloud.refused("other_ca");
    cloud.reload(|c| c.trust = vec![]);
    wait("they are cut off", || cloud.peers().is_disjoint(&[arm_id.clone(), other_id.clone()].into()));
    wait("they are refused", || cloud.refused("other_ca") > before);
    let closed = |r: &AuditRecord| r.event == "link_closed" && r.peer.as_deref() == Some(&arm_id);
    let reason = lab.audit("cloud").into_iter().rfind(closed).unwrap().reason.unwrap();
    assert!(reason.contains("no longer trusted"), "{reason}");
}

#[test]
fn the_audit_log_tells_what_happened_and_no_secret() {
    let lab = Lab::new(&["robot", "desk1", "desk2", "desk3"]);
    let acme = lab.beside("acme");
    acme.enroll("arm", |_| {});
    let cloud = lab.cloud_with(|c| c.trust = vec![acme.ca().0]);
    let robot = lab.start("robot", |c| {
        c.shares = vec![share("/pose", &["desk1", "desk2", "desk3"])];
        c.trust = vec![acme.ca().0];
    });
    let listeners = ["desk1", "desk2", "desk3"].map(|node| {
        let node_runs = lab.start(node, |c| c.uses = vec![uses("/pose")]);
        (node_runs, lab.listener(node, "/pose"))
    });
    let talker = lab.talker("robot", "/pose");
    warm_up(&talker, &[&listeners[0].1, &listeners[1].1, &listeners[2].1]);
    let (token, _) = token_for(&lab, "/pose", &acme, Some("arm"), false);
    let arm = acme.start("arm", |c| {
        c.tokens = vec![TokenConfig {
            source: TokenSource::Text(Box::new(token.clone())),
            naming: Default::default(),
            frame_prefix: None,
            dead_man: None,
            qos: Default::default(),
            dedicated: false,
        }]
    });
    wait("a refusal", || arm.route_state().starts_with("refused"));
    robot.reload(|c| c.shares[0].to = nodes(&["desk1", "desk3"]));
    let list = lab.revoke("desk3");
    assert_eq!(robot.ask(&AdminRequest::Crl(list))["ok"]["news"], true);
    wait("two new epochs", || lab.epoch("robot") == 3);
    wait("the router knows", || lab.audit("cloud").iter().any(|r| r.event == "crl"));
    // Queued records are written by the time the node has stopped.
    robot.stop();
    cloud.stop();

    let is = |event: &str, peer: &str| {
        let is = |r: &AuditRecord| r.event == event && r.peer.as_deref() == Some(peer);
        assert!(lab.audit("robot").iter().any(is), "{event} {peer} is not in the log");
    };
    let [one, two, three] = ["desk1", "desk2", "desk3"].map(|node| lab.id(node).to_string());
    is("granted", &one);
    is("granted", &two);
    is("refused", &acme.id("arm").to_string());
    is("cut", &two);
    is("revoked", &three);
    for event in ["started", "link_up", "epoch", "crl", "reload", "stopped"] {
        assert!(lab.audit("robot").iter().any(|r| r.event == event), "{event} is not in the log");
    }

    // The log contains nothing that looks like a key, except names of shares and ids of nodes.
    let mut known: BTreeSet<String> =
        ["robot", "cloud", "desk1", "desk2", "desk3"].map(|node| lab.id(node).to_string()).into();
    known.insert(acme.id("arm").to_string());
    known.insert(token.name().to_string());
    for node in ["robot", "cloud"] {
        let log = fs::read_to_string(lab.state(node).join("audit.jsonl")).unwrap();
        assert_eq!(
            fs::metadata(lab.state(node).join("audit.jsonl")).unwrap().permissions().mode() & 0o777,
            0o600
        );
        for line in log.lines() {
            serde_json::from_str::<serde_json::Value>(line).unwrap();
        }
        let is_key = |c: char| c.is_ascii_alphanumeric() || "+/-_=".contains(c);
        let long = log.split(|c| !is_key(c)).filter(|word| word.len() >= 32);
        for word in long {
            assert!(known.contains(word), "{node}: {word}");
        }
    }
}

#[test]
fn nodes_of_a_post_quantum_fleet_link_and_grant_so() {
    let lab = Lab::empty("lab", begin());
    lab.enroll("before", |_| {});
    lab.with_fleet(|fleet| fleet.set_post_quantum(true, unix_now()).unwrap());
    lab.enroll("cloud", |request| request.router = true);
    ["robot", "desk"].iter().for_each(|node| lab.enroll(node, |_| {}));
    let cloud = lab.cloud();
    let robot = lab.start("robot", |c| c.shares = vec![share("/chatter", &["*"])]);
    let desk = lab.start("desk", |c| c.uses = vec![uses("/chatter")]);
    let before = lab.start("before", |c| c.uses = vec![uses("/chatter")]);
    let talker = lab.talker("robot", "/chatter");
    let listener = lab.listener("desk", "/chatter");
    talker.wait_for_readers(1);
    warm_up(&talker, &[&listener]);
    for node in [&robot, &desk, &cloud] {
        let status = node.status();
        let links = status["links"].as_array().unwrap();
        assert!(!links.is_empty() && links.iter().all(|l| l["kex"] == "X25519MLKEM768"), "{links:?}");
    }
    // The identity of this node does not know of the requirement. A recording of its grants could be read later.
    wait("it gets nothing", || {
        cloud.refused("key_exchange") > 0
            || before.status()["routes"][0]["state"].as_str().unwrap().contains("refuse")
    });
    assert_eq!(writers(&lab.net("before"), "/chatter"), 0);
}
