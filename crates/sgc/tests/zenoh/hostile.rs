//! A hostile program on a Zenoh network: floods of tokens, malformed tokens, attachments and payloads, and wildcards.
//!
//! `SGC_ZENOH_TOKENS` is the number of its tokens, for a longer run.

use crate::faults::{assert_once, heard_now, talk};
use crate::lab::{Site, robot_to_desk};
use crate::networks::Middleware::Zenoh;
use crate::networks::Networks;
use crate::services::{self, AddRole};
use crate::support::{environment, say};

const TOKENS: u64 = 2_000;
/// Bounds of the memory that a node may hold for each of them, most of which Zenoh holds, and for everything else.
const TOKEN_KB_MAX: u64 = 14;
const RESIDENT_MORE_KB_MAX: u64 = 60_000;
const ROUNDS: usize = 20;

#[test]
fn hostile_program_neither_stops_a_node_nor_interrupts_others() {
    let topics = robot_to_desk("topic", ["/load"]);
    let services = robot_to_desk("service", ["/add"]);
    let tables = [0, 1].map(|end| [&*topics[end], &services[end]].concat());
    let Some(networks) = Networks::start([Zenoh, Zenoh], tables) else { return };
    let _server = services::add(&networks, AddRole::Server);
    let mut client = services::add(&networks, AddRole::Client);
    let _talker = talk(&networks, 0);
    let mut listener = crate::faults::hear(&networks);
    heard_now(&mut listener);
    let before = networks.node(Site::Robot).held();
    let tokens = environment("SGC_ZENOH_TOKENS", TOKENS);
    let args = ["--topic", "/load", "--name", "/add", "--tokens", &tokens.to_string()];
    let mut hostile = networks.zenoh(Site::Robot, "hostile", &args);
    let declared = loop {
        let event = hostile.wait("its tokens", |e| e["event"] == "declaring" || e["event"] == "declared");
        if event["event"] == "declared" {
            break event;
        }
    };
    for _ in 0..ROUNDS {
        hostile.go();
        hostile.wait("its messages", |event| event["event"] == "sent");
    }
    heard_now(&mut listener);
    client.go();
    let answer = client.wait("an answer", |event| event["event"] == "answer");
    assert_eq!(answer["right"], true, "{answer}");
    let after = networks.node(Site::Robot).held();
    say(&format!("zenoh: {declared}, held {before:?}, then {after:?}"));
    let more_kb_max = tokens * TOKEN_KB_MAX + RESIDENT_MORE_KB_MAX;
    assert!(after.resident_kb < before.resident_kb + more_kb_max, "{before:?}, {after:?}");
    drop(hostile);
    heard_now(&mut listener);
    assert_eq!(assert_once(listener, "a subscriber all along"), 0);
    for site in [Site::Robot, Site::Desk] {
        assert!(!networks.log(site).contains("panicked"), "{}", networks.log(site));
    }
}
