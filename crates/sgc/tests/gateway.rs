//! Programs without ROS at one node, ROS 2 programs that are not ours at another, a router between them: by gRPC, by
//! the rosbridge protocol and from the shell, with processes that are killed, and with a token that is taken back.

#![allow(clippy::unwrap_used)]

#[path = "support/lab.rs"]
mod lab;
mod support;

use std::fs;
use std::process::{Command, Output};

use lab::{Lab, Plan, Site, share, uses};
use rustix::process::Signal;
use serde_json::Value;
use support::turn::TurnKind;
use support::{Peer, eventually};

const PLAN: Plan = Plan { name: "sgcgw", domains: ["97", "98"], peer_life: "180", turn: TurnKind::Exclusive };

/// The robot talks and adds; it hears what the desk commands. At the desk nobody has ROS.
fn lab(gateway: &str) -> Lab {
    let robot = share("topic", "/chatter", "desk")
        + &share("service", "/add_two_ints", "desk")
        + &uses("topic", "/command", "desk");
    let desk = uses("topic", "/chatter", "robot")
        + &uses("service", "/add_two_ints", "robot")
        + &share("topic", "/command", "robot")
        + gateway;
    let mut lab = Lab::silent(PLAN, [robot, desk]);
    lab.reconfigure(Site::Desk, "[node]\n", "[node]\nstate = \"desk.state\"\n");
    lab.start_all();
    lab
}

fn talker(lab: &Lab) -> Peer {
    lab.peer(Site::Robot, "cyclone", "pub", &["--topic", "/chatter", "--rate", "20"])
}

fn server(lab: &Lab) -> Peer {
    let domain = lab.domain(Site::Robot);
    lab.python(Site::Robot, "services.py", &["server", "--localhost", "--domain", domain, "--timeout", "180"])
}

fn heard(peer: &mut Peer) -> String {
    let event = peer.wait("it hears", |event| event["event"] == "heard");
    event["text"].as_str().unwrap().to_owned()
}

/// `sgc` at the desk, about its node.
fn shell(lab: &Lab, args: &[&str]) -> Output {
    lab.sgc(Some(Site::Desk), &[args, &["--socket", "desk.sock"]].concat()).output().unwrap()
}

fn said(output: &Output) -> String {
    assert!(output.status.success(), "{output:?}");
    String::from_utf8_lossy(&output.stdout).trim().to_owned()
}

fn clients(lab: &Lab) -> Vec<(String, String)> {
    let status = lab.status(Site::Desk);
    let text = |client: &Value, key: &str| client[key].as_str().unwrap_or_default().to_owned();
    let all = status["gateway"]["clients"].as_array().cloned().unwrap_or_default();
    all.iter().map(|client| (text(client, "protocol"), text(client, "name"))).collect()
}

#[test]
fn first_call_after_a_start_finds_the_type_of_the_service() {
    let lab = lab("");
    let _server = server(&lab);
    eventually("the service is here", || shell(&lab, &["why", "/add_two_ints"]).status.success());
    // Nothing opened the gateway's network before.
    let reply = said(&shell(&lab, &["service", "call", "/add_two_ints", "{a: 2, b: 3}"]));
    assert_eq!(reply, r#"{"sum":5}"#);
    let nobody = shell(&lab, &["service", "call", "/add_three_ints", "{a: 2, b: 3}"]);
    let text = String::from_utf8_lossy(&nobody.stderr).into_owned();
    assert!(text.contains("the type of /add_three_ints is not known"), "{text}");
}

#[test]
fn number_of_messages_counts_for_standard_input_too() {
    let lab = lab("");
    fs::write(lab.dir().join("lines"), "data: a\ndata: b\nno message\n").unwrap();
    let publish = |number: &[&str]| {
        let args =
            ["topic", "pub", "/lines", "std_msgs/String", "--wait-subscribers", "0", "--socket", "desk.sock"];
        let mut command = lab.sgc(Some(Site::Desk), &[&args, number].concat());
        command.stdin(fs::File::open(lab.dir().join("lines")).unwrap()).output().unwrap()
    };
    for number in [&["--once"][..], &["-n", "2"]] {
        said(&publish(number));
    }
    for number in [&["-n", "3"][..], &[]] {
        let output = publish(number);
        assert_eq!(output.status.code(), Some(1), "the third line is no message: {output:?}");
    }
}

#[test]
fn programs_without_ros_talk_with_ros_2_nodes_at_the_other_end_of_the_mesh() {
    let mut lab = lab("[gateway]\n");
    let _talker = talker(&lab);
    let _server = server(&lab);
    let mut listener = lab.peer(Site::Robot, "cyclone", "sub", &["--topic", "/command", "--verbose"]);
    for (protocol, address) in [("grpc", "grpc://127.0.0.1:50051"), ("rosbridge", "ws://127.0.0.1:9090")] {
        let args = [protocol, address, "--publish", "/command"];
        let mut program = lab.python(Site::Desk, "gateway.py", &args);
        assert_eq!(program.wait("the sum", |event| event["event"] == "sum")["sum"], 42, "{protocol}");
        assert!(!heard(&mut program).is_empty());
        listener.wait("what it publishes", |event| event["event"] == "received");
        assert_eq!(clients(&lab).len(), 1);
        assert_eq!(clients(&lab)[0].0, protocol);
        program.end();
        eventually("the client is gone", || clients(&lab).is_empty());
    }

    let reply = said(&shell(&lab, &["service", "call", "/add_two_ints", "{a: 2, b: 3}"]));
    assert_eq!(reply, r#"{"sum":5}"#);
    said(&shell(&lab, &["topic", "pub", "--once", "/command", "std_msgs/String", "data: from the shell"]));
    let wrong = shell(&lab, &["topic", "pub", "--once", "/command", "date: x"]);
    assert_eq!(wrong.status.code(), Some(1), "{wrong:?}");
    assert!(String::from_utf8_lossy(&wrong.stderr).contains("date"), "{wrong:?}");

    // Programs of one gateway hear and call each other, as ROS 2 nodes do.
    let args = ["grpc", "grpc://127.0.0.1:50051", "--serve", "/add_here", "--publish", "/between"];
    let mut one = lab.python(Site::Desk, "gateway.py", &args);
    one.wait("it serves", |event| event["event"] == "served");
    let mut other =
        lab.python(Site::Desk, "gateway.py", &["rosbridge", "ws://127.0.0.1:9090", "--topic", "/between"]);
    assert!(heard(&mut other).starts_with("without ROS"));
    let reply = said(&shell(&lab, &["service", "call", "/add_here", "{a: 20, b: 3}"]));
    assert_eq!(reply, r#"{"sum":23}"#);
    one.end();
    other.end();

    // Whatever is killed, who hears goes on as soon as it can.
    let mut program = lab.python(Site::Desk, "gateway.py", &["grpc", "grpc://127.0.0.1:50051", "--hear"]);
    heard(&mut program);
    lab.kill(Site::Cloud);
    lab.start(Site::Cloud);
    for _ in 0..50 {
        heard(&mut program);
    }
    lab.kill(Site::Desk);
    program.wait("it is told", |event| event["event"] == "failed");
    lab.start(Site::Desk);
    heard(&mut program);
    assert!(lab.end(Site::Desk, Signal::TERM).success());
}

#[test]
fn a_token_opens_what_it_says_until_it_is_taken_back() {
    let keys = tempfile::tempdir().unwrap();
    let [certificate, key] = ["gateway.pem", "gateway.key"].map(|name| keys.path().join(name));
    let (certificate, key) = (certificate.to_str().unwrap(), key.to_str().unwrap());
    let made = Command::new("openssl")
        .args([
            "req",
            "-x509",
            "-newkey",
            "ec",
            "-pkeyopt",
            "ec_paramgen_curve:prime256v1",
            "-nodes",
            "-days",
            "2",
        ])
        .args(["-subj", "/CN=gateway", "-addext", "subjectAltName=IP:10.92.2.2"])
        .args(["-keyout", key, "-out", certificate])
        .output();
    assert!(made.unwrap().status.success());
    let lab = lab(&format!(
        "[gateway]\nlisten = [\"grpcs://0.0.0.0:50443\"]\ncertificate = \"{certificate}\"\nkey = \"{key}\"\n"
    ));
    if lab.namespace(Site::Desk).is_none() {
        // On this host alone nobody is elsewhere, and the ports are everybody's.
        return support::say("without namespaces nobody is elsewhere: the token is not tried");
    }
    let _talker = talker(&lab);
    let create = ["token", "access", "create", "-c", "desk.toml", "--for", "dashboard", "--valid", "1h"];
    let token = said(
        &lab.sgc(Some(Site::Desk), &[&create[..], &["--subscribe", "/chatter"]].concat()).output().unwrap(),
    );
    let address = "grpcs://10.92.2.2:50443";
    let common = ["grpc", address, "--ca", certificate];
    let mut stranger = lab.python(Site::Cloud, "gateway.py", &common);
    let refused = stranger.wait("it is refused", |event| event["event"] == "failed");
    assert_eq!(refused["code"], "UNAUTHENTICATED", "{refused}");

    let mut program = lab.python(Site::Cloud, "gateway.py", &[&common[..], &["--token", &token]].concat());
    assert_eq!(program.wait("topics", |e| e["event"] == "topics")["topics"], serde_json::json!(["/chatter"]));
    assert!(!heard(&mut program).is_empty());
    let listed =
        said(&lab.sgc(Some(Site::Desk), &["token", "access", "list", "-c", "desk.toml"]).output().unwrap());
    let id = listed.lines().last().unwrap().split_whitespace().next().unwrap().to_owned();
    said(
        &lab.sgc(Some(Site::Desk), &["token", "access", "revoke", "-c", "desk.toml", &id]).output().unwrap(),
    );
    let ended = program.wait("it is told", |event| event["event"] == "failed");
    assert_eq!(ended["code"], "UNAUTHENTICATED", "{ended}");
}
