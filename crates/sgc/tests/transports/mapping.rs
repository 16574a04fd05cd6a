//! Port mappings: nodes behind symmetric NATs on both sides, and a gateway that maps ports on one of them.

use std::net::SocketAddrV4;
use std::time::Instant;

use serde_json::Value;

use crate::direct::{direct_links, judge, why_not};
use crate::igd::{Igd, OUTSIDE, Speaks};
use crate::lab::{Lab, Nat, RANGES};
use crate::node::Node;
use crate::support::{eventually, say};
use crate::{Pair, cable, can_run, shared_turn};

fn port_mapping(node: &Node) -> Value {
    node.status()["port_mapping"].clone()
}

/// Returns the external port of a node's mapping, if it has one by this protocol.
fn mapped_port(node: &Node, protocol: &str) -> Option<u16> {
    let mapping = port_mapping(node);
    if mapping["state"] != "mapped" {
        return None;
    }
    assert_eq!((&mapping["protocol"], &mapping["gateway"]), (&protocol.into(), &"10.1.0.1".into()));
    assert_eq!(mapping["behind_nat"], false);
    let external: SocketAddrV4 = mapping["external"].as_str().unwrap().parse().unwrap();
    assert_eq!(external.ip().to_string(), OUTSIDE);
    Some(external.port())
}

/// Two symmetric NATs, of which that of the robot is a gateway of this kind: there is no direct path without a mapping
/// (`nodes_behind_nats_get_a_direct_link_as_theory_says`).
fn meet_through(speaks: Speaks, protocol: &str, then: impl FnOnce(&mut Igd, &Node, u16)) {
    let lab = Lab::new(cable(), Nat::RandomPort(RANGES[0]));
    let mut igd = Igd::start(&lab, speaks);
    let _cloud = Node::start(&lab.cloud, &lab.router_config(), lab.enroll("cloud", true), None);
    let mut pair = Pair::start(&lab, "quic", &[&lab.url("quic")]);
    pair.wait_for("never begins", |_| 1);
    let begun = Instant::now();
    eventually(&format!("a mapping by {protocol}"), || mapped_port(&pair.robot, protocol).is_some());
    let mapped = begun.elapsed();
    let port = mapped_port(&pair.robot, protocol).unwrap();
    assert_eq!(igd.mapped(), [port]);
    for node in [&pair.robot, &pair.desk] {
        eventually("a direct link", || direct_links(node) == 1);
    }
    let (mapped, direct) = (mapped.as_millis(), begun.elapsed().as_millis());
    say(&format!("\nPort mapping by {protocol}: mapped after {mapped} ms, direct after {direct} ms"));
    // The gateway of the desk offers none.
    eventually("the desk says so", || port_mapping(&pair.desk)["state"] == "failed");
    let why = port_mapping(&pair.desk)["failures"].clone();
    assert_eq!(why["upnp_igd"], "no_answer", "{why}");
    pair.wait_for("does not go on", |flow| flow.said() + 1);
    then(&mut igd, &pair.robot, port);
    let wrong = judge(&pair);
    assert!(wrong.is_empty(), "{wrong:?}");
    pair.robot.stop();
    assert_eq!(igd.mapped(), [0; 0], "the mapping outlives the node");
}

#[test]
fn symmetric_nats_are_passed_by_a_mapping_by_pcp_that_is_asked_again_when_the_gateway_forgets() {
    if !can_run() || !Igd::is_installed() {
        return;
    }
    let _turn = shared_turn();
    meet_through(Speaks::Pcp(10), "pcp", |igd, robot, port| {
        igd.restart();
        eventually("the mapping is there again", || igd.mapped() == [port]);
        assert_eq!(mapped_port(robot, "pcp"), Some(port));
    });
}

#[test]
fn gateway_is_asked_only_while_the_configuration_permits_it() {
    if !can_run() || !Igd::is_installed() {
        return;
    }
    let _turn = shared_turn();
    let lab = Lab::new(cable(), Nat::RandomPort(RANGES[0]));
    let igd = Igd::start(&lab, Speaks::Pcp(7200));
    let _cloud = Node::start(&lab.cloud, &lab.router_config(), lab.enroll("cloud", true), None);
    let shares = |line: &str| {
        let of = |topic| format!("[[share]]\ntopic = \"/{topic}\"\nto = [\"desk\"]\n");
        format!("{line}\n[ros]\ndomain_id = 0\n{}{}", of("state"), of("video"))
    };
    let uses =
        "[[use]]\nfrom = \"robot\"\ntopic = \"/state\"\n[[use]]\nfrom = \"robot\"\ntopic = \"/video\"\n";
    let routers = [&*lab.url("quic")];
    let pair = Pair::with(&lab, "quic", ["robot", "desk"], [&shares("port_mapping = false"), uses], &routers);
    pair.wait_for("never begins", |_| 1);
    let blocked = |why: String| why.starts_with("no packet passes");
    eventually("there is no direct path", || why_not(&pair.desk).is_some_and(blocked));
    let off = port_mapping(&pair.robot);
    assert_eq!((&off["state"], igd.mapped()), (&"off".into(), Vec::new()), "{off}");
    assert!(off["why_off"].as_str().unwrap().contains("port_mapping"), "{off}");
    let reload = |line: &str| {
        lab.write_config("robot", &routers, &shares(line));
        pair.robot.reload();
    };
    reload("port_mapping = true");
    eventually("a mapping", || mapped_port(&pair.robot, "pcp").is_some());
    for node in [&pair.robot, &pair.desk] {
        eventually("a direct link", || direct_links(node) == 1);
    }
    assert_eq!(igd.mapped().len(), 1);
    reload("direct = \"never\"");
    eventually("the mapping is removed", || igd.mapped().is_empty());
    eventually("the node says so", || port_mapping(&pair.robot)["state"] == "off");
    pair.wait_for("does not go on", |flow| flow.said() + 1);
    let wrong = judge(&pair);
    assert!(wrong.is_empty(), "{wrong:?}");
}

#[test]
fn symmetric_nats_are_passed_by_a_mapping_by_nat_pmp() {
    if !can_run() || !Igd::is_installed() {
        return;
    }
    let _turn = shared_turn();
    meet_through(Speaks::NatPmp, "nat_pmp", |_, _, _| {});
}

#[test]
fn symmetric_nats_are_passed_by_a_mapping_by_upnp() {
    if !can_run() || !Igd::is_installed() {
        return;
    }
    let _turn = shared_turn();
    meet_through(Speaks::Upnp, "upnp_igd", |_, _, _| {});
}
