//! Services, actions and parameters of real ROS 2: calls right after discovery of a server, slow servers, restarted
//! servers. Also the first messages of publishers, which the same fault of the transport affects.

use rustix::process::Signal;
use serde_json::Value;

use super::lab::{Lab, Site, robot_to_desk};
use super::support::{Peer, eventually};
use super::{EXCLUSIVE, PAIRS, PLAN, count};

const CLIENTS: u64 = 50;

const DISTRIBUTIONS: [&str; 2] = ["jazzy", "kilted"];

/// Seconds after which a program reports missing answers.
const TRIES_S: &str = "20";

/// Longest duration of a first call, in seconds. A Fast DDS writer sends heartbeats every three seconds, so a call that
/// waits for one takes longer.
const FIRST_CALL_MAX_S: f64 = 2.0;

fn program(lab: &Lab, site: Site, distribution: &str, args: &[&str]) -> Peer {
    let mut command = lab.ros(site, distribution, "calls.py");
    command.args(args).args(["--timeout", TRIES_S]);
    Peer::start(command)
}

fn serve(lab: &Lab, site: Site, distribution: &str, args: &[&str]) -> Peer {
    let life = [&["serve"], args, &["--timeout", PLAN.peer_life]].concat();
    let mut command = lab.ros(site, distribution, "calls.py");
    command.args(life);
    let mut server = Peer::start(command);
    server.wait("a server", |event| event["event"] == "ready");
    server
}

fn call(lab: &Lab, site: Site, distribution: &str, clients: u64, args: &[&str]) -> Peer {
    let clients = clients.to_string();
    program(lab, site, distribution, &[&["call", "--count", &clients], args].concat())
}

/// Asserts that every call was answered with the right value.
fn assert_answered(summary: &Value, calls: u64, of: &str) {
    let counts = ["asked", "answered", "wrong"].map(|key| count(summary, key));
    assert_eq!(counts, [calls, calls, 0], "{of}: {summary}");
}

fn assert_answered_at_once(summary: &Value, calls: u64, of: &str) {
    assert_answered(summary, calls, of);
    assert!(summary["slowest"].as_f64().unwrap() < FIRST_CALL_MAX_S, "{of}: {summary}");
}

#[test]
fn calls_made_when_a_service_is_first_seen_are_answered() {
    const PARTICIPANTS: u64 = 5;
    let lab = Lab::real(EXCLUSIVE, robot_to_desk("service", ["/jazzy", "/kilted"]));
    let both = ["--service", "/jazzy", "--service", "/kilted"];
    let serve_at =
        |site, [d, name]: [&str; 2]| serve(&lab, site, d, &["--node", "server", "--service", name]);
    let _servers = [["jazzy", "/jazzy"], ["kilted", "/kilted"]].map(|server| serve_at(Site::Robot, server));
    let mut clients = DISTRIBUTIONS.map(|d| call(&lab, Site::Desk, d, CLIENTS, &both));
    for (distribution, client) in DISTRIBUTIONS.into_iter().zip(&mut clients) {
        assert_answered_at_once(&client.summary(), 2 * CLIENTS, distribution);
    }
    // Each call is also made as the first of its participant.
    let participants = [&both[..], &["--participants"]].concat();
    let mut clients = DISTRIBUTIONS.map(|d| call(&lab, Site::Desk, d, PARTICIPANTS, &participants));
    for (distribution, client) in DISTRIBUTIONS.into_iter().zip(&mut clients) {
        assert_answered(&client.summary(), 2 * PARTICIPANTS, distribution);
    }
    // The same calls without sgc.
    let _native =
        [["jazzy", "/native_jazzy"], ["kilted", "/native_kilted"]].map(|server| serve_at(Site::Desk, server));
    let both = ["--service", "/native_jazzy", "--service", "/native_kilted"];
    let mut clients = DISTRIBUTIONS.map(|d| call(&lab, Site::Desk, d, CLIENTS, &both));
    for (distribution, client) in DISTRIBUTIONS.into_iter().zip(&mut clients) {
        assert_answered(&client.summary(), 2 * CLIENTS, &format!("{distribution}, natively"));
    }
}

#[test]
fn parameters_and_goals_asked_for_when_first_seen_are_answered() {
    let mut tables = robot_to_desk("parameters", DISTRIBUTIONS.map(|d| format!("/server_{d}")));
    let actions = robot_to_desk("action", DISTRIBUTIONS.map(|d| format!("/act_{d}")));
    tables.iter_mut().zip(actions).for_each(|(table, more)| *table += &more);
    let lab = Lab::real(PLAN, tables);
    let _servers = DISTRIBUTIONS.map(|d| {
        let (node, action) = (format!("server_{d}"), format!("/act_{d}"));
        serve(&lab, Site::Robot, d, &["--node", &node, "--action", &action])
    });
    let mut clients = PAIRS.map(|[serves, calls]| {
        let (node, action) = (format!("/server_{serves}"), format!("/act_{serves}"));
        call(&lab, Site::Desk, calls, CLIENTS, &["--parameters", &node, "--action", &action])
    });
    for (pair, client) in PAIRS.into_iter().zip(&mut clients) {
        assert_answered(&client.summary(), 2 * CLIENTS, &format!("{pair:?}"));
    }
}

/// eclipse-zenoh/zenoh-plugin-ros2dds #413 and #367: its queries end after five seconds.
#[test]
fn calls_and_goals_that_take_longer_than_five_seconds_are_answered() {
    const GOALS: u64 = 1;
    let mut tables = robot_to_desk("service", DISTRIBUTIONS.map(|d| format!("/{d}")));
    let actions = robot_to_desk("action", DISTRIBUTIONS.map(|d| format!("/act_{d}")));
    tables.iter_mut().zip(actions).for_each(|(table, more)| *table += &more);
    let lab = Lab::real(PLAN, tables);
    let _servers = DISTRIBUTIONS.map(|d| {
        let (service, action) = (format!("/{d}"), format!("/act_{d}"));
        let slow = ["--delay", "6", "--threads", "60"];
        serve(&lab, Site::Robot, d, &[&["--service", &service, "--action", &action], &slow[..]].concat())
    });
    let mut clients = PAIRS.map(|[serves, calls]| {
        let (service, action) = (format!("/{serves}"), format!("/act_{serves}"));
        [(CLIENTS, ["--service", &*service]), (GOALS, ["--action", &action])]
            .map(|(n, what)| (n, call(&lab, Site::Desk, calls, n, &[&what[..], &["--overlap"]].concat())))
    });
    for (pair, clients) in PAIRS.into_iter().zip(&mut clients) {
        for (calls, client) in clients {
            let summary = client.summary();
            assert_answered(&summary, *calls, &format!("{pair:?}"));
            assert!(summary["slowest"].as_f64().unwrap() > 5.0, "{summary}");
        }
    }
}

#[test]
fn calls_of_a_server_that_was_started_again_are_answered() {
    let lab = Lab::real(PLAN, robot_to_desk("service", ["/jazzy", "/kilted"]));
    let start = |d| serve(&lab, Site::Robot, d, &["--node", "server", "--service", &format!("/{d}")]);
    let call_all = |calls| {
        let mut clients =
            PAIRS.map(|[serves, d]| call(&lab, Site::Desk, d, calls, &["--service", &format!("/{serves}")]));
        for (pair, client) in PAIRS.into_iter().zip(&mut clients) {
            assert_answered(&client.summary(), calls, &format!("{pair:?}"));
        }
    };
    let servers = DISTRIBUTIONS.map(start);
    call_all(1);
    for mut server in servers {
        server.end();
        server.summary();
    }
    let without = || {
        let routes = lab.status(Site::Robot)["routes"].take();
        let states = routes.as_array().into_iter().flatten().filter_map(|route| route["state"].as_str());
        // The second state comes once the service is no longer offered.
        let is_without = |state: &&str| {
            state.starts_with("0 local servers") || state.starts_with("waits for a local server")
        };
        states.filter(is_without).count()
    };
    eventually("both are gone", || without() == 2);
    let _servers = DISTRIBUTIONS.map(start);
    eventually("both are back", || without() == 0);
    call_all(CLIENTS);
}

/// A server that is killed is missed when its lease ends, after 20 s; until then its service is offered, natively as
/// well.
#[test]
fn calls_of_a_server_that_was_killed_are_counted_and_explained_until_calls_are_answered() {
    let lab = Lab::real(PLAN, robot_to_desk("service", ["/jazzy", "/kilted"]));
    let start = |d| serve(&lab, Site::Robot, d, &["--node", "server", "--service", &format!("/{d}")]);
    let call_one = |[serves, d]: [&str; 2], node: &str, patience: &str| {
        let args = ["call", "--service", &format!("/{serves}"), "--node", node, "--timeout", patience];
        lab.rclpy(Site::Desk, d, "calls.py", &args)
    };
    let servers = DISTRIBUTIONS.map(start);
    for pair in PAIRS {
        assert_answered(&call_one(pair, "first", TRIES_S).summary(), 1, &format!("{pair:?}"));
    }
    servers.iter().for_each(|server| server.signal(Signal::KILL));
    let waiting = PAIRS.map(|pair| call_one(pair, "left_alone", PLAN.peer_life));
    eventually("both calls are counted at the desk", || {
        lab.status(Site::Desk)["drops"]["call_server_gone"] == 2
    });
    for pair in PAIRS {
        let why = lab.why(Site::Desk, &format!("/{}", pair[0]));
        for part in [
            "1 calls of clients here got no answer",
            "1 of /left_alone",
            "call_server_gone",
            "start the server again",
        ] {
            assert!(why.contains(part), "{pair:?}: no {part} in {why}");
        }
        assert!(why.contains('✗'), "{why}");
        let why = lab.why(Site::Robot, &format!("/{}", pair[0]));
        assert!(why.contains("1 calls of others to the server here got no answer"), "{why}");
    }
    drop(waiting);
    let _servers = DISTRIBUTIONS.map(start);
    for pair in PAIRS {
        assert_answered(&call_one(pair, "again", TRIES_S).summary(), 1, &format!("{pair:?}"));
        eventually("nothing is wrong", || {
            [Site::Robot, Site::Desk].into_iter().all(|site| {
                let why = lab.why(site, &format!("/{}", pair[0]));
                why.contains("call_server_gone") && !why.contains('✗')
            })
        });
    }
}

/// eclipse-zenoh/zenoh-plugin-ros2dds #382: a client that leaves while there is no server stops the bridge.
#[test]
fn clients_that_leave_before_a_server_is_there_stop_nothing() {
    let lab = Lab::real(PLAN, robot_to_desk("service", ["/early", "/other"]));
    let _other = serve(&lab, Site::Robot, "jazzy", &["--node", "other", "--service", "/other"]);
    for distribution in DISTRIBUTIONS {
        let leave = ["leave", "--service", "/early", "--count", "20", "--delay", "0.05"];
        program(&lab, Site::Desk, distribution, &leave).summary();
    }
    let mut client = call(&lab, Site::Desk, "kilted", 1, &["--service", "/other"]);
    assert_answered(&client.summary(), 1, "another service");
    let _server = serve(&lab, Site::Robot, "kilted", &["--node", "early", "--service", "/early"]);
    for distribution in DISTRIBUTIONS {
        let mut client = call(&lab, Site::Desk, distribution, 5, &["--service", "/early"]);
        assert_answered(&client.summary(), 5, distribution);
    }
}

#[test]
fn first_messages_of_publishers_reach_far_subscribers() {
    const TOGETHER: u64 = 50;
    const LONE: u64 = 3;
    let topics = DISTRIBUTIONS.map(|d| format!("/first_{d}"));
    let lab = Lab::real(PLAN, robot_to_desk("topic", &topics));
    for pair in PAIRS {
        let topic = format!("/first_{}", pair[0]);
        let publish = |count: u64, first: u64| {
            let [count, first] = [count, first].map(|number| number.to_string());
            let args = ["publish", "--topic", &topic, "--count", &count, "--first", &first];
            let mut talker = program(&lab, Site::Robot, pair[0], &args);
            talker.wait("all", |e| e["event"] == "all_sent");
            let end = first.parse::<u64>().unwrap() + count.parse::<u64>().unwrap();
            eventually("all are taken", || {
                let routes = lab.status(Site::Robot)["routes"].take();
                routes.as_array().unwrap().iter().any(|r| r["topic"] == *topic && r["messages"] == end)
            });
            talker
        };
        let end = |mut talker: Peer| {
            talker.go();
            talker.summary();
        };
        let all = TOGETHER + LONE;
        let args = ["listen", "--topic", &topic, "--count", &all.to_string()];
        let mut listener = program(&lab, Site::Desk, pair[1], &args);
        // A publisher waits for a subscriber that `sgc` stands for, wherever the use of the topic is.
        eventually("the subscriber is found", || {
            lab.asked(Site::Desk, &["topic", "info", &topic]).contains("Subscribers on the local network: 1")
        });
        let together = publish(TOGETHER, 0);
        // As `ros2 topic pub --once`, which ends once its only message is sent.
        (TOGETHER..all).for_each(|number| end(publish(1, number)));
        let heard = listener.summary();
        eprintln!("\nDESK {}\nROBOT {}", lab.status(Site::Desk), lab.status(Site::Robot));
        assert_eq!([count(&heard, "received"), count(&heard, "duplicated")], [all, 0], "{pair:?}: {heard}");
        end(together);
    }
}
