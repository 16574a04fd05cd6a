//! Programs without ROS at the desk's gateway, with a robot on Zenoh and with a desk on either middleware.

use serde_json::Value;

use crate::lab::{Site, robot_to_desk, share, uses};
use crate::networks::Middleware::{Dds, Zenoh};
use crate::networks::Networks;

/// The protocols of `gateway.py`, with the gateway's addresses.
const PROGRAMS: [(&str, &str); 2] =
    [("grpc", "grpc://127.0.0.1:50051"), ("rosbridge", "ws://127.0.0.1:9090")];

fn is(kind: &str) -> impl Fn(&Value) -> bool {
    move |event| event["event"] == kind
}

#[test]
fn programs_without_ros_talk_with_a_robot_on_zenoh_and_with_programs_beside_them() {
    for on in [[Zenoh, Zenoh], [Zenoh, Dds("kilted")]] {
        let [robot, desk] = robot_to_desk("topic", ["/chatter"]);
        let [serves, calls] = robot_to_desk("service", ["/add_two_ints"]);
        let robot = robot + &serves + &uses("topic", "/command", "desk");
        let desk = desk + &calls + &share("topic", "/command", "robot") + "[gateway]\n";
        let Some(networks) = Networks::start(on, [robot, desk]) else { return };
        let _talker = networks.zenoh(Site::Robot, "pub", &["--topic", "/chatter", "--rate", "20"]);
        let _server = networks.zenoh(Site::Robot, "serve", &["--name", "/add_two_ints"]);
        let mut listener = networks.zenoh(Site::Robot, "sub", &["--topic", "/command", "--verbose"]);
        for (protocol, address) in PROGRAMS {
            let args = [protocol, address, "--publish", "/command"];
            let mut program = networks.python(Site::Desk, "gateway.py", &args);
            let what = format!("{protocol}, {on:?}");
            assert_eq!(program.wait("the sum", is("sum"))["sum"], 42, "{what}");
            program.wait("a text", is("heard"));
            listener.wait(&format!("a command, {what}"), is("received"));
            program.end();
        }
        if networks.at(Site::Desk) == Zenoh {
            let _near = networks.zenoh(Site::Desk, "pub", &["--topic", "/near", "--rate", "20"]);
            let mut hears = networks.zenoh(Site::Desk, "sub", &["--topic", "/command", "--verbose"]);
            for (protocol, address) in PROGRAMS {
                let args = [protocol, address, "--publish", "/command", "--topic", "/near"];
                let mut program = networks.python(Site::Desk, "gateway.py", &args);
                program.wait("a text", is("heard"));
                hears.wait(&format!("a command beside the program, {protocol}"), |event| {
                    event["event"] == "received"
                });
                program.end();
            }
        }
    }
}
