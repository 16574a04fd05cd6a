//! Services, actions and parameters, each with its servers and clients on either middleware.

use serde_json::json;

use crate::lab::{Site, robot_to_desk};
use crate::networks::Middleware::{self, Dds, Zenoh};
use crate::networks::Networks;
use crate::support::Peer;
use crate::{CASES, PLAN};

/// The service and the action of which both middlewares have programs.
const SERVICE: [&str; 2] = ["--type", "test_msgs/srv/BasicTypes"];
const ACTION: [&str; 2] = ["--package", "test_msgs"];
const CALLS: u64 = 20;

/// Starts a server at the robot.
pub(crate) fn serve(networks: &Networks, on: Middleware, name: &str) -> Peer {
    let mut server = match on {
        Dds(distribution) => {
            let args = ["serve", "--node", "server", "--service", name, "--timeout", PLAN.peer_life];
            networks.rclpy(Site::Robot, distribution, "calls.py", &args)
        }
        Zenoh => networks.zenoh(
            Site::Robot,
            "serve",
            &[&["--node", "/server", "--name", name], &SERVICE[..]].concat(),
        ),
    };
    server.wait("a server", |event| event["event"] == "ready");
    server
}

/// Starts a client at the desk that calls as soon as it sees the server.
pub(crate) fn call(networks: &Networks, name: &str, node: &str) -> Peer {
    let count = CALLS.to_string();
    let mut client = match networks.at(Site::Desk) {
        Dds(distribution) => {
            let args = ["call", "--node", node, "--service", name, "--count", &count, "--timeout", "60"];
            networks.rclpy(Site::Desk, distribution, "calls.py", &args)
        }
        Zenoh => {
            let of = ["--node", &format!("/{node}"), "--name", name, "--count", &count];
            networks.zenoh(Site::Desk, "call", &[&of[..], &SERVICE].concat())
        }
    };
    client.wait("a client", |event| event["event"] == "ready");
    client
}

/// Starts a client at the desk that stays once it has an answer. Returns the name of its node as well.
pub(crate) fn call_and_stay(networks: &Networks, name: &str) -> (Peer, &'static str) {
    let (mut client, node) = match networks.at(Site::Desk) {
        Dds(distribution) => {
            // It calls again and again.
            (
                networks.rclpy(Site::Desk, distribution, "text.py", &["--call", name, "--timeout", "100"]),
                "/text",
            )
        }
        Zenoh => {
            let of = ["--node", "/caller", "--name", name, "--count", "1", "--stay"];
            (networks.zenoh(Site::Desk, "call", &[&of[..], &SERVICE].concat()), "/caller")
        }
    };
    client.wait("an answer", |event| event["event"] == "answer" || event["event"] == "answered");
    (client, node)
}

pub(crate) fn assert_answered(mut client: Peer, what: &str) {
    let summary = client.summary();
    let asked = if summary["asked"].is_null() { &summary["called"] } else { &summary["asked"] };
    let counts = [asked, &summary["answered"], &summary["wrong"]];
    assert_eq!(counts, [&json!(CALLS), &json!(CALLS), &json!(0)], "{what}: {summary}");
}

#[test]
fn calls_of_several_clients_are_answered_by_servers_old_and_new() {
    for on in CASES {
        let Some(networks) = Networks::start(on, robot_to_desk("service", ["/early", "/late"])) else {
            return;
        };
        let _early = serve(&networks, on[0], "/early");
        let clients = ["one", "two", "three"].map(|node| call(&networks, "/early", node));
        let before = call(&networks, "/late", "before");
        for client in clients {
            assert_answered(client, &format!("/early, {on:?}"));
        }
        let _late = serve(&networks, on[0], "/late");
        assert_answered(before, &format!("/late, {on:?}"));
    }
}

/// A program of the service `example_interfaces/srv/AddTwoInts`.
#[derive(Clone, Copy, PartialEq, Eq)]
pub(crate) enum AddRole {
    /// At the robot.
    Server,
    /// At the desk. Calls at each line.
    Client,
}

/// Starts a program of the service `/add`, on Cyclone DDS or Zenoh. A client sees the server then.
pub(crate) fn add(networks: &Networks, of: AddRole) -> Peer {
    const NAME: [&str; 2] = ["--name", "/add"];
    let (site, on_zenoh, on_dds) = match of {
        AddRole::Server => (Site::Robot, "serve", "server"),
        AddRole::Client => (Site::Desk, "call", "client"),
    };
    let mut program = match networks.at(site) {
        Zenoh => networks.zenoh(site, on_zenoh, &NAME),
        Dds(_) => {
            let args = [&[on_dds], &NAME[..], &["--timeout", PLAN.peer_life]].concat();
            networks.python(site, "services.py", &args)
        }
    };
    program.wait("a program", |event| event["event"] == "ready");
    if of == AddRole::Client {
        program.wait("the server", |event| event["event"] == "service" && event["there"] == true);
    }
    program
}

/// Nothing at SGC has the definition of the service, and Cyclone DDS announces no hash of it. Only programs on Zenoh have
/// the hash.
#[test]
fn services_without_a_definition_have_the_hash_that_programs_on_zenoh_have() {
    for on in [[Zenoh, Dds("jazzy")], [Dds("jazzy"), Zenoh], [Zenoh, Zenoh]] {
        let Some(networks) = Networks::start(on, robot_to_desk("service", ["/add"])) else { return };
        let _server = add(&networks, AddRole::Server);
        let mut client = add(&networks, AddRole::Client);
        (0..3).for_each(|_| client.go());
        for _ in 0..3 {
            let answer = client.wait("an answer", |event| event["event"] == "answer");
            assert_eq!(answer["right"], true, "{on:?}");
        }
    }
}

/// Starts a role of the action, which programs of both middlewares have.
fn act(networks: &Networks, site: Site, role: &str, args: &[&str]) -> Peer {
    let node = format!("/{role}").replace('-', "_");
    let common = [&["--node", &node], args].concat();
    match networks.at(site) {
        Dds(distribution) => {
            let args = [&[role, "--timeout", PLAN.peer_life], &common[..]].concat();
            networks.rclpy(site, distribution, "actions.py", &args)
        }
        Zenoh if role.starts_with("action") => networks.zenoh(site, role, &[&ACTION, &common[..]].concat()),
        Zenoh => networks.zenoh(site, role, &common),
    }
}

#[test]
fn goals_have_feedback_and_a_result_and_can_be_cancelled() {
    const SUCCEEDED: u64 = 4;
    const CANCELED: u64 = 5;
    for on in CASES {
        let tables = robot_to_desk("action", ["/fibonacci"]);
        let Some(networks) = Networks::start(on, tables) else { return };
        let mut server = act(&networks, Site::Robot, "action-serve", &["--step", "0.1"]);
        server.wait("a server", |event| event["event"] == "ready");
        let mut goals = [(&["--order", "8"][..], SUCCEEDED), (&["--order", "200", "--cancel"], CANCELED)]
            .map(|(args, status)| (act(&networks, Site::Desk, "action-call", args), status));
        for (goal, status) in &mut goals {
            let summary = goal.summary();
            let found = ["right", "grows", "last_status", "cancelling"].map(|key| summary[key].clone());
            let cancelling = u64::from(*status == CANCELED);
            assert_eq!(
                found,
                [json!(true), json!(true), json!(status), json!(cancelling)],
                "{on:?}: {summary}"
            );
            let feedback = summary["feedback"].as_u64().unwrap();
            assert!(if *status == CANCELED { feedback >= 2 } else { feedback == 9 }, "{on:?}: {summary}");
        }
    }
}

#[test]
fn parameters_of_a_far_node_are_set_listed_described_and_read() {
    for on in CASES {
        let tables = robot_to_desk("parameters", ["/params"]);
        let Some(networks) = Networks::start(on, tables) else { return };
        let mut node = act(&networks, Site::Robot, "params", &[]);
        node.wait("a node", |event| event["event"] == "ready");
        let mut asks = act(&networks, Site::Desk, "params-call", &["--of", "/params", "--set", "answer=7"]);
        let summary = asks.summary();
        assert_eq!(summary["good"], true, "{on:?}: {summary}");
        let values = &summary["values"];
        let found = ["answer", "ratio", "robot.name"].map(|name| values[name].clone());
        assert_eq!(found, [json!(7), json!(0.5), json!("arm")], "{on:?}: {summary}");
        node.end();
        assert_eq!(node.summary()["values"]["answer"], 7, "{on:?}");
    }
}
