//! Tests how `sgc` finds and reaches programs of its own host, and reports where it cannot.

use std::time::{Duration, Instant};

use serde_json::Value;

use sgc_testkit::netsim::Namespace;

use crate::lab::{Lab, Site, robot_to_desk, share, uses};
use crate::support::{PATIENCE, Peer, eventually};
use crate::{EXCLUSIVE, PAIRS, PLAN, count};

const SERVER: &str = "ROS_DISCOVERY_SERVER=127.0.0.1:11811";

#[test]
fn a_discovery_server_of_programs_is_named() {
    let lab = Lab::real(PLAN, robot_to_desk("topic", ["/load"]));
    let before = lab.why(Site::Robot, "/load");
    assert!(!before.contains("ROS_DISCOVERY_SERVER"), "{before}");
    let variable = SERVER.split_once('=').unwrap();
    let arguments = ["pub", "--topic", "/load", "--timeout", PLAN.peer_life];
    let _talker = lab.load_within(Site::Robot, PAIRS[0][0], &[variable], &arguments);
    // Before it runs, the process is not the program's own.
    eventually("sgc why names the server", || lab.why(Site::Robot, "/load").contains(SERVER));
    eventually("the log names the server", || lab.log(Site::Robot).contains(SERVER));
    if lab.namespace(Site::Robot).is_some() {
        let elsewhere = lab.why(Site::Desk, "/load");
        assert!(!elsewhere.contains("ROS_DISCOVERY_SERVER"), "{elsewhere}");
    }
    let mut check = lab.sgc(None, &["check", "-c", "robot.toml"]);
    let checked = check.env(variable.0, variable.1).output().unwrap();
    let checked = String::from_utf8(checked.stdout).unwrap();
    assert!(checked.contains(&format!("{SERVER} is set")), "{checked}");
}

#[test]
fn packets_that_cannot_be_sent_are_reported() {
    let [jazzy, kilted] = PAIRS[0];
    let lab = Lab::real(PLAN, robot_to_desk("topic", ["/load"]));
    let Some(robot) = lab.namespace(Site::Robot) else { return };
    let talk = ["pub", "--topic", "/load", "--count", "0", "--rate", "20", "--timeout", PLAN.peer_life];
    let _talker = lab.load(Site::Robot, jazzy, &talk);
    let listen = ["sub", "--topic", "/load", "--verbose", "--timeout", PLAN.peer_life];
    let mut listener = lab.load(Site::Desk, kilted, &listen);
    listener.wait("a message", |event| event["event"] == "received");
    let before = lab.why(Site::Robot, "/load");
    assert!(!before.contains("cannot be sent"), "{before}");
    change(robot, "addr del 10.92.1.2/24 dev cloud");
    eventually("sgc why says so", || lab.why(Site::Robot, "/load").contains("cannot be sent"));
    let lines = lab.log(Site::Robot).lines().filter(|line| line.contains("ddsi_")).count();
    assert_eq!(lines, 0, "lines of Cyclone's own");
}

/// Bound on the time from the end of a change to the next message.
const RESUMED: Duration = Duration::from_secs(2);

/// Environment variables that set the discovery range of a program: the default of ROS 2, and two ways to limit it to
/// the host.
type Environment = &'static [(&'static str, &'static str)];
const SUBNET: Environment = &[];
const LOCALHOST: Environment = &[("ROS_AUTOMATIC_DISCOVERY_RANGE", "LOCALHOST")];
const RANGES: [(&str, Environment); 3] =
    [("subnet", SUBNET), ("localhost", LOCALHOST), ("localhost_only", &[("ROS_LOCALHOST_ONLY", "1")])];

/// A publisher and a subscriber at a site, and their counterparts at the desk.
struct Flow {
    name: String,
    listeners: [Peer; 2],
    _talkers: [Peer; 2],
}

/// Returns the topics of flows, from the site and to it.
fn topics<'a>(way: &str, labels: impl IntoIterator<Item = &'a str>) -> Vec<String> {
    labels.into_iter().map(|label| format!("/{way}_{label}")).collect()
}

/// Returns the tables of the robot and of the desk by which flows of these labels go both ways.
fn both_ways<'a>(labels: impl IntoIterator<Item = &'a str> + Clone) -> [String; 2] {
    let [mut robot, mut desk] = robot_to_desk("topic", topics("up", labels.clone()));
    for topic in topics("down", labels) {
        robot += &uses("topic", &topic, "desk");
        desk += &share("topic", &topic, "robot");
    }
    [robot, desk]
}

impl Flow {
    /// Starts both directions, with the environments of the programs at the site and of those at the desk.
    fn start(
        lab: &Lab,
        site: Site,
        [near, desk]: [&str; 2],
        label: &str,
        [at_site, at_desk]: [Environment; 2],
    ) -> Self {
        let topics = ["up", "down"].map(|way| format!("/{way}_{label}"));
        let talk =
            |topic| ["pub", "--topic", topic, "--count", "0", "--rate", "20", "--timeout", PLAN.peer_life];
        let listen = |topic| ["sub", "--topic", topic, "--verbose", "--timeout", PLAN.peer_life];
        Self {
            name: format!("{near} as {label} at the {}, {desk} at the desk", site.name()),
            listeners: [
                lab.load_within(Site::Desk, desk, at_desk, &listen(&topics[0])),
                lab.load_within(site, near, at_site, &listen(&topics[1])),
            ],
            _talkers: [
                lab.load_within(site, near, at_site, &talk(&topics[0])),
                lab.load_within(Site::Desk, desk, at_desk, &talk(&topics[1])),
            ],
        }
    }

    /// Asserts that both directions carry a message that arrives after `since`, in time.
    fn assert_goes_on(&mut self, since: Instant, bound: Duration, when: &str) {
        for (listener, way) in self.listeners.iter_mut().zip(["from", "to"]) {
            let deadline = since + bound;
            let in_time = since..=deadline;
            let is_message =
                |(at, event): (Instant, Value)| event["event"] == "received" && in_time.contains(&at);
            let heard = std::iter::from_fn(|| {
                listener.events.recv_timeout(deadline.saturating_duration_since(Instant::now())).ok()
            })
            .any(is_message);
            assert!(heard, "{way} {}: nothing within {bound:?}, {when}", self.name);
        }
    }
}

fn assert_all(flows: &mut [Flow], bound: Duration, when: &str) {
    let since = Instant::now();
    flows.iter_mut().for_each(|flow| flow.assert_goes_on(since, bound, when));
}

/// Changes the network of the robot, as `ip` does with these arguments.
fn change(robot: &Namespace, args: &str) {
    robot.ip(&args.split_whitespace().collect::<Vec<_>>()).unwrap();
}

#[test]
fn topics_of_programs_of_a_host_survive_its_addresses() {
    for pair in PAIRS {
        let lab = Lab::real(EXCLUSIVE, both_ways(RANGES.map(|(label, _)| label)));
        let mut flows =
            RANGES.map(|(label, range)| Flow::start(&lab, Site::Robot, pair, label, [range, SUBNET]));
        assert_all(&mut flows, PATIENCE, "at first");
        let Some(robot) = lab.namespace(Site::Robot) else { continue };
        change(robot, "addr del 10.92.1.2/24 dev cloud");
        change(robot, "addr add 10.92.1.3/24 dev cloud");
        assert_all(&mut flows, RESUMED, "with another address");
        change(robot, "link set cloud down");
        change(robot, "link set cloud up");
        assert_all(&mut flows, RESUMED, "after the interface was down");
    }
}

/// Longer than the leases of Fast DDS (20 s) and of Cyclone DDS (10 s).
const OUTAGE: Duration = Duration::from_secs(24);

#[test]
fn topics_survive_an_outage_longer_than_leases_and_reach_programs_that_start_later() {
    let early = ["early_subnet", "early_localhost"];
    let late = ["late_subnet", "late_localhost", "late_subnet_too"];
    let lab = Lab::real(PLAN, both_ways(early.into_iter().chain(late)));
    let [old, new] = PAIRS;
    let start = |pair, label, range| Flow::start(&lab, Site::Robot, pair, label, [range, SUBNET]);
    let mut flows = vec![start(old, early[0], SUBNET), start(new, early[1], LOCALHOST)];
    assert_all(&mut flows, PATIENCE, "at first");
    let Some(robot) = lab.namespace(Site::Robot) else { return };
    change(robot, "addr del 10.92.1.2/24 dev cloud");
    change(robot, "link set cloud down");
    // Without an interface nothing reaches the desk. Only the lease decides whether programs stay known.
    let until = Instant::now() + OUTAGE;
    while Instant::now() < until {
        let here = lab.status(Site::Robot)["routes"].to_string();
        assert!(here.matches("1 local publishers").count() >= 2, "a publisher was lost: {here}");
        std::thread::sleep(Duration::from_millis(500));
    }
    change(robot, "addr add 10.92.1.3/24 dev cloud");
    change(robot, "link set cloud up");
    eventually("the link to the cloud is back", || {
        lab.status(Site::Robot)["links"].as_array().is_some_and(|links| !links.is_empty())
    });
    assert_all(&mut flows, PATIENCE, "after a long outage");
    flows.push(start(old, late[0], SUBNET));
    flows.push(start(new, late[1], LOCALHOST));
    flows.push(start(new, late[2], SUBNET));
    assert_all(&mut flows, PATIENCE, "for programs that started after the change");
}

/// Bound on the time from a change of addresses to messages of programs of other hosts: until a packet to them fails,
/// addresses count as settled, and the network is open again.
const REOPENED: Duration = Duration::from_secs(30);

#[test]
fn programs_of_other_hosts_come_back_after_an_address_change() {
    for pair in PAIRS {
        let [mut robot, mut desk] = both_ways(["same", "other"]);
        for topic in ["/latched_same", "/latched_other"] {
            robot += &share("topic", topic, "desk");
            desk += &uses("topic", topic, "robot");
        }
        let mut lab = Lab::silent(EXCLUSIVE, [robot, desk]);
        lab.reconfigure(Site::Robot, "discovery_range = \"localhost\"", "discovery_range = \"subnet\"");
        lab.start_all();
        let (Some(robot), Some(cloud)) = (lab.namespace(Site::Robot), lab.namespace(Site::Cloud)) else {
            return;
        };
        // Multicast leaves by the interface that a route names, on hosts with several.
        change(cloud, "route add 239.0.0.0/8 dev robot");
        // The cloud's host is on the robot's network, too: its programs are those of a second computer.
        // The desk's programs do not hear this publisher.
        let mut flows = [
            Flow::start(&lab, Site::Robot, pair, "same", [LOCALHOST, LOCALHOST]),
            Flow::start(&lab, Site::Cloud, pair, "other", [SUBNET, LOCALHOST]),
        ];
        let latch = |site, topic| {
            let says = ["pub", "--topic", topic, "--transient-local", "--depth", "1", "--count", "1"];
            lab.load(site, pair[0], &[&says[..], &["--hold", "110", "--timeout", PLAN.peer_life]].concat())
        };
        let _latched = [latch(Site::Robot, "/latched_same"), latch(Site::Cloud, "/latched_other")];
        let hears = ["/latched_same", "/latched_other"].map(|topic| {
            let listens = ["sub", "--topic", topic, "--transient-local", "--verbose", "--linger", "100"];
            let listens = [&listens[..], &["--timeout", PLAN.peer_life]].concat();
            let mut hears = lab.load_within(Site::Desk, pair[1], LOCALHOST, &listens);
            hears.wait("what is latched", |event| event["event"] == "received");
            hears
        });
        assert_all(&mut flows, PATIENCE, "at first");
        assert_eq!(lab.status(Site::Robot)["local_network_reopened"], 0);
        change(robot, "addr del 10.92.1.2/24 dev cloud");
        change(robot, "addr add 10.92.1.3/24 dev cloud");
        let changed = Instant::now();
        eventually("the network is opened again", || lab.status(Site::Robot)["local_network_reopened"] == 1);
        flows[1].assert_goes_on(
            Instant::now(),
            (changed + REOPENED).saturating_duration_since(Instant::now()),
            "with another address",
        );
        assert_all(&mut flows, RESUMED, "once the network is open again");
        for topic in ["/up_same", "/up_other"] {
            let why = lab.why(Site::Robot, topic);
            assert!(!why.contains("cannot be sent"), "{why}");
        }
        assert!(lab.log(Site::Robot).contains("the local ROS 2 network was opened again"));
        for mut hears in hears {
            hears.end();
            let summary = hears.summary();
            assert_eq!([count(&summary, "received"), count(&summary, "duplicated")], [1, 0], "{summary}");
        }
        assert_eq!(lab.status(Site::Robot)["local_network_reopened"], 1, "once is enough");
    }
}

/// A map in either direction, between programs of Python that discover as ROS 2 does by default.
#[test]
fn nodes_with_defaults_are_found_by_a_proxy_that_keeps_to_its_host() {
    let [mut robot, mut desk] = robot_to_desk("topic", ["/up"]);
    robot += &uses("topic", "/down", "desk");
    desk += &share("topic", "/down", "robot");
    let mut lab = Lab::silent(PLAN, [robot, desk]);
    lab.start_all();
    for pair in PAIRS {
        for (topic, sites) in [("/up", [Site::Robot, Site::Desk]), ("/down", [Site::Desk, Site::Robot])] {
            let program = |site, distribution, role| {
                let arguments = [role, "--topic", topic, "--timeout", PLAN.peer_life];
                lab.rclpy(site, distribution, "latched.py", &arguments)
            };
            let mut hears = program(sites[1], pair[1], "hear");
            let mut map = program(sites[0], pair[0], "map");
            hears.wait("the last map", |event| event["event"] == "received" && event["seq"] == 2);
            for program in [&mut hears, &mut map] {
                program.end();
                program.summary();
            }
        }
    }
}

/// Program of a robot's gateway, by its protocol, whose subscriptions and publications have to outlast the change.
fn without_ros(lab: &Lab, protocol: &str, address: &str) -> Peer {
    let args =
        [protocol, address, "--topic", "/text_out", "--publish", "/text_in", "--serve", "/add_two_ints"];
    // A second server of a service is no help.
    let args = if protocol == "grpc" { &args[..] } else { &args[..6] };
    lab.python(Site::Robot, "gateway.py", &[args, &["--timeout", PLAN.peer_life]].concat())
}

/// Asserts that an event of this kind comes within the bound after `since`.
fn assert_event(peer: &mut Peer, kind: &str, since: Instant, bound: Duration, what: &str) {
    let deadline = since + bound;
    let is_one = |(at, event): (Instant, Value)| {
        assert_ne!(event["event"], "failed", "{what}: {event}");
        event["event"] == kind && (since..=deadline).contains(&at)
    };
    let came = std::iter::from_fn(|| {
        peer.events.recv_timeout(deadline.saturating_duration_since(Instant::now())).ok()
    })
    .any(is_one);
    assert!(came, "{what}: nothing within {bound:?}");
}

#[test]
fn programs_of_the_gateway_keep_their_topics_after_an_address_change() {
    let mut lab = Lab::silent(PLAN, ["[gateway]\n", ""].map(str::to_owned));
    lab.reconfigure(Site::Robot, "discovery_range = \"localhost\"", "discovery_range = \"subnet\"");
    lab.start_all();
    let (Some(robot), Some(cloud)) = (lab.namespace(Site::Robot), lab.namespace(Site::Cloud)) else {
        return;
    };
    // The cloud's host is a second computer of the robot's network.
    change(cloud, "route add 239.0.0.0/8 dev robot");
    let mut clients = [("grpc", "grpc://127.0.0.1:50051"), ("rosbridge", "ws://127.0.0.1:9090")]
        .map(|(protocol, address)| (protocol, without_ros(&lab, protocol, address)));
    let text = ["--timeout", PLAN.peer_life];
    let mut program = lab.rclpy(Site::Cloud, "jazzy", "text.py", &text);
    let sees_all = |clients: &mut [(&str, Peer)], program: &mut Peer, bound, when: &str| {
        let since = Instant::now();
        for (protocol, client) in clients {
            assert_event(client, "heard", since, bound, &format!("{protocol} {when}"));
        }
        assert_event(program, "received", since, bound, &format!("ROS {when}"));
    };
    sees_all(&mut clients, &mut program, PATIENCE, "at first");
    let since = |lab: &Lab| {
        let status = lab.status(Site::Robot);
        let all = status["gateway"]["clients"].as_array().cloned().unwrap_or_default();
        all.iter().map(|client| client["since"].as_u64().unwrap()).collect::<Vec<_>>()
    };
    let before = since(&lab);
    change(robot, "addr del 10.92.1.2/24 dev cloud");
    change(robot, "addr add 10.92.1.3/24 dev cloud");
    eventually("the network is opened again", || lab.status(Site::Robot)["local_network_reopened"] == 1);
    sees_all(&mut clients, &mut program, REOPENED, "with another address");
    assert_eq!((before.len(), since(&lab)), (2, before), "the clients stay connected");
}

/// The robot's programs are on a second computer of its network; calls go on across the change, either way.
#[test]
fn services_of_other_hosts_go_on_after_an_address_change() {
    for pair in PAIRS {
        let [mut robot, mut desk] = robot_to_desk("service", ["/near"]);
        robot += &uses("service", "/far", "desk");
        desk += &share("service", "/far", "robot");
        let mut lab = Lab::silent(PLAN, [robot, desk]);
        lab.reconfigure(Site::Robot, "discovery_range = \"localhost\"", "discovery_range = \"subnet\"");
        lab.start_all();
        let (Some(robot), Some(cloud)) = (lab.namespace(Site::Robot), lab.namespace(Site::Cloud)) else {
            return;
        };
        change(cloud, "route add 239.0.0.0/8 dev robot");
        let program = |site, distribution, range: Environment, args: &[&str]| {
            let mut command = lab.ros(site, distribution, "text.py");
            command.args(args).args(["--patience", "8", "--delay", "0.5", "--timeout", PLAN.peer_life]);
            Peer::start({
                command.envs(range.iter().copied());
                command
            })
        };
        let mut robots = program(Site::Cloud, pair[0], SUBNET, &["--serve", "/near", "--call", "/far"]);
        let mut desks = program(Site::Desk, pair[1], LOCALHOST, &["--serve", "/far", "--call", "/near"]);
        let both = |robots: &mut Peer, desks: &mut Peer, bound, when: &str| {
            let since = Instant::now();
            assert_event(
                robots,
                "answered",
                since,
                bound,
                &format!("{pair:?}, a call of the desk's server {when}"),
            );
            assert_event(
                desks,
                "answered",
                since,
                bound,
                &format!("{pair:?}, a call of the robot's server {when}"),
            );
        };
        both(&mut robots, &mut desks, PATIENCE, "at first");
        change(robot, "addr del 10.92.1.2/24 dev cloud");
        change(robot, "addr add 10.92.1.3/24 dev cloud");
        eventually("the network is opened again", || lab.status(Site::Robot)["local_network_reopened"] == 1);
        both(&mut robots, &mut desks, REOPENED, "with another address");
    }
}

/// The local ROS 2 network is IPv4, as that of Fast DDS with its defaults.
#[test]
fn host_without_ipv4_is_pointed_out_until_it_has_an_address() {
    let mut lab = Lab::silent(PLAN, robot_to_desk("topic", ["/text_out"]));
    lab.reconfigure(Site::Robot, "discovery_range = \"localhost\"", "discovery_range = \"subnet\"");
    let Some(robot) = lab.namespace(Site::Robot) else { return };
    const SAID: &str = "this host has no IPv4 address besides loopback";
    let check = |lab: &Lab| {
        let output = lab.sgc(Some(Site::Robot), &["check", "-c", "robot.toml"]).output().unwrap();
        String::from_utf8(output.stdout).unwrap()
    };
    assert!(!check(&lab).contains(SAID));
    change(robot, "addr del 10.92.1.2/24 dev cloud");
    change(robot, "-6 addr add fd00:92::2/64 dev cloud");
    assert!(check(&lab).contains(SAID), "{}", check(&lab));
    lab.start(Site::Robot);
    let _talker = lab.rclpy(Site::Robot, "jazzy", "text.py", &["--timeout", PLAN.peer_life]);
    eventually("programs of this host are found", || {
        lab.why(Site::Robot, "/text_out").contains("1 local publishers of /text_out")
    });
    eventually("the log says so", || lab.log(Site::Robot).contains(SAID));
    assert!(lab.why(Site::Robot, "/text_out").contains(SAID));
    let Some(robot) = lab.namespace(Site::Robot) else { return };
    change(robot, "addr add 10.92.1.2/24 dev cloud");
    eventually("the network is opened again", || lab.status(Site::Robot)["local_network_reopened"] == 1);
    assert!(!lab.why(Site::Robot, "/text_out").contains(SAID));
}
