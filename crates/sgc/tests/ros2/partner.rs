//! Tests two companies with a fleet each: only the topics of their tokens cross, as in `docs/how-to/sharing.md`.

use std::fs;
use std::io::Write;
use std::process::{Output, Stdio};

use serde_json::{Value, json};

use crate::lab::{Lab, Site, robot_to_desk, share};
use crate::support::{eventually, say};
use crate::why::{everything, node, wait};
use crate::{PAIRS, PLAN};

/// The topic that the robot's company gives.
const CHATTER: &str = "/robot/chatter";
/// The topic that the cart's company gives.
const STATE: &str = "/cart/state";

/// Returns a lab with a robot of the fleet `lab`, and a cart of the fleet `acme` in the place of the desk, whose node
/// knows no router yet. Each company has the CA of the other (`acme.pem`, `lab.pem`). Returns `None` if networks are
/// not separate.
fn companies([robot, cart]: [&str; 2]) -> Option<Lab> {
    let lab = Lab::silent(PLAN, [robot.to_owned(), String::new()]);
    if lab.namespace(Site::Desk).is_none() {
        say("two domains of one host are no two default networks: nothing is shown");
        return None;
    }
    let good = |command: &str| {
        let output = run(&lab, &command.split_whitespace().collect::<Vec<_>>(), &[]);
        assert!(output.status.success(), "{command}: {output:?}");
        output.stdout
    };
    good("fleet create acme");
    good("fleet enroll cart --fleet acme.fleet");
    for fleet in ["lab", "acme"] {
        let certificate = good(&format!("fleet ca --fleet {fleet}.fleet"));
        fs::write(lab.dir().join(format!("{fleet}.pem")), certificate).unwrap();
    }
    let head = "identity = \"cart.identity\"\nnode.routers = [\"quic://127.0.0.1:9\"]\nnode.state = \"cart.state\"\n";
    let text = format!("{head}admin.socket = \"desk.sock\"\n{cart}");
    fs::write(lab.dir().join("desk.toml"), text).unwrap();
    lab.reconfigure(Site::Robot, "discovery_range = \"localhost\"", "discovery_range = \"subnet\"");
    lab.reconfigure(Site::Robot, "[node]\n", "[node]\nstate = \"robot.state\"\n");
    lab.configure(Site::Cloud, "[node]\ntrust = [\"acme.pem\"]\n");
    Some(lab)
}

/// Runs `sgc` with this on its standard input.
fn run(lab: &Lab, args: &[&str], input: &[u8]) -> Output {
    let mut command = lab.sgc(None, args);
    command.stdin(Stdio::piped()).stdout(Stdio::piped()).stderr(Stdio::piped());
    let mut child = command.spawn().unwrap();
    child.stdin.take().unwrap().write_all(input).unwrap();
    child.wait_with_output().unwrap()
}

/// Makes a token of a topic for the other company, once the node knows the type.
fn give(lab: &Lab, site: Site, topic: &str) -> Vec<u8> {
    let (other, to) = match site {
        Site::Robot => (Site::Desk, "acme.pem"),
        _ => (Site::Robot, "lab.pem"),
    };
    let router = format!("quic://{}", lab.cloud_address(other));
    let config = format!("{}.toml", site.name());
    let args = ["token", "share", "create", "-c", &config, "--topic", topic, "--to", to, "--via", &router];
    let mut token = Vec::new();
    eventually(&format!("{config} gives {topic}"), || {
        let output = run(lab, &args, &[]);
        token = output.stdout;
        output.status.success()
    });
    token
}

/// Takes a token while the node runs. Returns the output of the command line.
fn take(lab: &Lab, site: Site, token: &[u8]) -> String {
    let config = format!("{}.toml", site.name());
    let output = run(lab, &["token", "use", "-", "-c", &config], token);
    assert!(output.status.success(), "{output:?}");
    String::from_utf8(output.stdout).unwrap()
}

#[test]
fn token_takes_its_type_from_the_robot_and_the_partner_needs_no_restart() {
    let [robot, _] = robot_to_desk("topic", [CHATTER]);
    let Some(mut lab) = companies([&robot, ""]) else { return };
    lab.start_all();
    let _robot = node(&lab, Site::Robot, "jazzy", "robot");
    let mut desk = node(&lab, Site::Desk, "kilted", "desk");
    let token = give(&lab, Site::Robot, CHATTER);
    let said = take(&lab, Site::Desk, &token);
    assert!(said.contains("[std_msgs/msg/String] of robot") && !said.contains("restart"), "{said}");
    desk.wait("a message", |event| event["event"] == "received");
}

/// Returns the names with this beginning that a site knows: nodes, and topics and services of some node. Waits until
/// the topic has only the publishers of this node.
fn seen(lab: &Lab, site: Site, distribution: &str, [topic, node, begin]: [&str; 3]) -> [Vec<Value>; 3] {
    let args = ["--topic", topic, "--publishers", "1", "--node", node, "--timeout", "30"];
    let found = lab.rclpy(site, distribution, "graph.py", &args).summary();
    let is_below = |name: &&Value| name.as_str().unwrap().starts_with(begin);
    ["nodes", "published", "served"].map(|key| {
        let mut names: Vec<_> = found[key].as_array().unwrap().iter().filter(is_below).cloned().collect();
        // A killed node may still be listed beside the next one of its name.
        names.dedup();
        names
    })
}

#[test]
fn partners_hear_the_topics_of_their_tokens_each_way_and_nothing_else() {
    // Each company shares more with its own nodes, including services, actions and parameters.
    let [all, _] = everything();
    let cart = all.replace("\"desk\"", "\"*\"").replace("/robot/fibonacci", "/cart/fibonacci");
    let [robot, cart] = [(all, CHATTER), (cart, STATE)].map(|(all, topic)| all + &share("topic", topic, "*"));
    let Some(mut lab) = companies([&robot, &cart]) else { return };
    lab.start_all();
    for (at, [there, here]) in PAIRS.into_iter().enumerate() {
        let _robot = node(&lab, Site::Robot, there, "robot");
        let publish = |topic, node| {
            lab.rclpy(Site::Desk, here, "events.py", &["pub", "--topic", topic, "--node", node])
        };
        let _published = [publish(STATE, "cart_driver"), publish("/cart/private", "cart_planner")];
        let mut desk = node(&lab, Site::Desk, here, "desk");
        let hear = ["sub", "--topic", STATE, "--node", "dispatcher"];
        let mut dispatcher = lab.rclpy(Site::Robot, there, "events.py", &hear);
        if at == 0 {
            for (owner, partner, topic) in
                [(Site::Robot, Site::Desk, CHATTER), (Site::Desk, Site::Robot, STATE)]
            {
                take(&lab, partner, &give(&lab, owner, topic));
            }
        }
        desk.wait("a message of the robot", |event| event["event"] == "received");
        dispatcher.wait("a message of the cart", |event| event["event"] == "received");
        let at_robot = seen(&lab, Site::Robot, there, [STATE, "cart_driver", "/cart"]);
        assert_eq!(at_robot, [vec![json!("/cart_driver")], vec![json!(STATE)], vec![]], "{here} to {there}");
        let at_cart = seen(&lab, Site::Desk, here, [CHATTER, "talker", "/robot"]);
        assert_eq!(
            at_cart,
            [vec![json!("/robot/talker")], vec![json!(CHATTER)], vec![]],
            "{there} to {here}"
        );
        for (site, topic) in [(Site::Desk, CHATTER), (Site::Robot, STATE)] {
            wait(&lab, site, topic, 0, "");
        }
    }
}
