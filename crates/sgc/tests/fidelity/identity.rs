//! One identity runs in two networks at a time, each with an independent program.

use std::collections::BTreeSet;
use std::fs;

use serde_json::Value;

use crate::lab::{Lab, Site};
use crate::support::{self, Peer, Running, eventually};
use crate::{EXCLUSIVE, PLAN};

const COMMON: [&str; 4] = ["--type", "string", "--topic", "/chatter"];
/// The ROS domain of the second process, which is in the robot's network.
const DOMAIN: &str = "95";

/// Starts a subscriber at a site that reports each message.
fn listener(lab: &Lab, site: Site, domain: &str) -> Peer {
    let mut command = support::command(lab.namespace(site), lab.dir(), &Peer::program("cyclone"));
    command.args(["sub", "--domain", domain, "--localhost", "--timeout", PLAN.peer_life, "--verbose"]);
    command.args(COMMON);
    Peer::start(command)
}

/// Starts the second process of `desk`, with copies of all its files, in the robot's network.
fn start_twin(lab: &Lab) -> Running {
    fs::copy(lab.dir().join("desk.identity"), lab.dir().join("twin.identity")).unwrap();
    let text = fs::read_to_string(lab.dir().join("desk.toml")).unwrap();
    let text = text
        .replace("desk.identity", "twin.identity")
        .replace("desk.sock", "twin.sock")
        .replace(&lab.cloud_address(Site::Desk), &lab.cloud_address(Site::Robot))
        .replace(&format!("domain_id = {}", lab.domain(Site::Desk)), &format!("domain_id = {DOMAIN}"));
    fs::write(lab.dir().join("twin.toml"), text).unwrap();
    let command = lab.sgc(Some(Site::Robot), &["run", "-c", "twin.toml"]);
    Running::start(command, &lab.dir().join("twin.log"))
}

/// Returns `true` if a node shows an alert of this kind about another place that begins so.
fn alerts(lab: &Lab, socket: &str, kind: &str, place: &str) -> bool {
    let output = lab.sgc(None, &["status", "--json", "--socket", socket]).output().unwrap();
    let status: Value = serde_json::from_slice(&output.stdout).unwrap_or_default();
    let all = status["alerts"].as_array().cloned().unwrap_or_default();
    all.iter()
        .any(|alert| alert["kind"] == kind && alert["place"].as_str().is_some_and(|at| at.starts_with(place)))
}

/// Hears until the subscriber has had this many, and adds their numbers.
fn hear(listener: &mut Peer, what: &str, count: usize, heard: &mut Vec<u64>) {
    let until = heard.len() + count;
    while heard.len() < until {
        heard.push(listener.wait(what, |event| event["event"] == "received")["seq"].as_u64().unwrap());
    }
}

/// Ends a subscriber and adds what it had besides.
fn end(mut listener: Peer, heard: &mut Vec<u64>) {
    listener.end();
    loop {
        let (_, event) = listener.events.recv_timeout(support::PATIENCE).unwrap();
        match event["event"].as_str() {
            Some("received") => heard.push(event["seq"].as_u64().unwrap()),
            Some("summary") => {
                assert_eq!((&event["duplicated"], &event["altered"]), (&0.into(), &0.into()), "{event}");
                return;
            }
            _ => {}
        }
    }
}

#[test]
fn identity_in_two_networks_delivers_nothing_twice_and_is_named_on_all_sides() {
    let lab = Lab::with_topics(EXCLUSIVE, ["/chatter"]);
    let mut at_desk = listener(&lab, Site::Desk, lab.domain(Site::Desk));
    let mut at_twin = listener(&lab, Site::Robot, DOMAIN);
    let sends = ["--count", "1000000", "--rate", "50"];
    let mut talker = lab.peer(Site::Robot, "fastdds", "pub", &[&COMMON[..], &sends].concat());
    let (mut of_desk, mut of_twin) = (Vec::new(), Vec::new());
    hear(&mut at_desk, "messages at the desk", 50, &mut of_desk);

    let twin = start_twin(&lab);
    let here = |site: Site| match lab.namespace(site) {
        Some(_) => ["10.92.1.2:", "", "10.92.2.2:"][site as usize],
        None => "127.0.0.1:",
    };
    // Each process learns the place of the other; the twin is in the robot's network.
    eventually("the desk names the cause", || alerts(&lab, "desk.sock", "displaced", here(Site::Robot)));
    eventually("the cloud names the cause", || {
        alerts(&lab, "cloud.sock", "peer_identity_in_use", here(Site::Robot))
    });
    eventually("the twin names the cause", || alerts(&lab, "twin.sock", "identity_in_use", here(Site::Desk)));
    for (socket, code) in [("desk.sock", 1), ("twin.sock", 0)] {
        let output = lab.sgc(None, &["why", "/chatter", "--socket", socket]).output().unwrap();
        let said = String::from_utf8(output.stdout).unwrap();
        assert!(said.contains("the identity desk is in use at another place: "), "{said}");
        assert_eq!(output.status.code(), Some(code), "{said}");
    }
    assert!(lab.log(Site::Cloud).contains("is in use at two places: "), "{}", lab.log(Site::Cloud));

    hear(&mut at_twin, "messages at the twin", 400, &mut of_twin);
    let linked = lab.log(Site::Desk).matches("link is up").count();
    assert!((2..=8).contains(&linked), "{linked} links in ten seconds");

    // Messages that the desk heard until it was displaced.
    while let Ok((_, event)) = at_desk.events.try_recv() {
        of_desk.extend(event["seq"].as_u64().filter(|_| event["event"] == "received"));
    }
    // The twin ends, and the desk goes on by itself. The twin had the messages that the desk missed meanwhile.
    drop(twin);
    hear(&mut at_desk, "messages at the desk again", 100, &mut of_desk);
    talker.end();
    talker.summary();
    end(at_desk, &mut of_desk);
    end(at_twin, &mut of_twin);
    let all: BTreeSet<_> = of_desk.iter().chain(&of_twin).collect();
    let twice = of_desk.len() + of_twin.len() - all.len();
    assert_eq!(twice, 0, "of {} messages at the desk and {} at the twin", of_desk.len(), of_twin.len());
}
