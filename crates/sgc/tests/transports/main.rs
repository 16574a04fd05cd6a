//! Tests of every transport between real namespaces: NATs on both sides, a NAT that loses its state, an address that
//! changes, a route that moves, a small MTU, a bad path.
//!
//! A robot publishes a reliable and a best-effort topic, a desk receives them, and an event happens on the path. No
//! reliable message may be lost, repeated or reordered, and both topics must go on. The tests print outages and never
//! judge them, because they depend on the load of the machine.
//!
//! All transports run each scenario at the same time. `SGC_TRANSPORTS_LONG=1` (`make transports`) runs one at a time,
//! repeats the event, and has independent programs at both ends.

#![allow(clippy::unwrap_used)]

mod direct;
mod flow;
mod igd;
mod lab;
mod mapping;
mod node;
mod real;
mod shown;
mod store;
#[path = "../support/mod.rs"]
mod support;

use std::sync::{Arc, PoisonError, RwLock, RwLockReadGuard, RwLockWriteGuard};
use std::thread::sleep;
use std::time::{Duration, Instant};

use flow::{Flow, LATE, TOPICS};
use lab::{Lab, Lan, Nat, RANGES, schemes};
use node::Node;
use sgc_testkit::FakeDomain;
use sgc_testkit::netsim::{Loss, Profile, TunOptions, on_host};
use support::{eventually, say};

/// Time without an event, before and after each.
const CALM: Duration = Duration::from_millis(1000);
/// Number of events in the long run.
const ROUNDS_LONG: usize = 5;
/// Time before an event from which outages count, because a gap may begin just before the event.
const JUST_BEFORE: Duration = Duration::from_millis(200);

/// One scenario over all transports at a time, because each fills the processors. Tests with one pair of nodes mostly
/// wait, so several run together.
static TURN: RwLock<()> = RwLock::new(());

fn is_long() -> bool {
    std::env::var_os("SGC_TRANSPORTS_LONG").is_some_and(|value| value != "0")
}

fn turn() -> RwLockWriteGuard<'static, ()> {
    TURN.write().unwrap_or_else(PoisonError::into_inner)
}

fn shared_turn() -> RwLockReadGuard<'static, ()> {
    TURN.read().unwrap_or_else(PoisonError::into_inner)
}

/// A robot and a desk that talk by one transport.
struct Pair {
    scheme: &'static str,
    flows: Vec<Flow>,
    robot: Node,
    desk: Node,
    near: FakeDomain,
    far: FakeDomain,
}

impl Pair {
    /// The robot dials `routers`, the desk the router by `scheme`.
    fn start(lab: &Lab, scheme: &'static str, routers: &[&str]) -> Self {
        let (robot, desk) = (format!("robot-{scheme}"), format!("desk-{scheme}"));
        let [mut shares, mut uses] = ["[ros]\ndomain_id = 0\n".to_owned(), String::new()];
        for topic in TOPICS.into_iter().chain([LATE]) {
            shares += &format!("[[share]]\ntopic = \"{}\"\nto = [\"{desk}\", \"desk-2\"]\n", topic.name);
            uses += &format!("[[use]]\nfrom = \"{robot}\"\ntopic = \"{}\"\n", topic.name);
        }
        Self::with(lab, scheme, [&robot, &desk], [&shares, &uses], routers)
    }

    /// Starts both with these names and the rest of their configurations.
    fn with(
        lab: &Lab,
        scheme: &'static str,
        [robot, desk]: [&str; 2],
        [shares, uses]: [&str; 2],
        routers: &[&str],
    ) -> Self {
        Self::over(lab, scheme, [robot, desk], [shares, uses], [routers, &[&lab.url(scheme)]])
    }

    /// Starts both at a router each, by QUIC.
    fn between(lab: &Lab, names: [&str; 2], rest: [&str; 2], [near, far]: [&str; 2]) -> Self {
        Self::over(lab, "quic", names, rest, [&[near], &[far]])
    }

    fn over(
        lab: &Lab,
        scheme: &'static str,
        [robot, desk]: [&str; 2],
        [shares, uses]: [&str; 2],
        [routers, routers_of_desk]: [&[&str]; 2],
    ) -> Self {
        let [near, far] = [FakeDomain::default(), FakeDomain::default()];
        let desk_file = lab.write_config(desk, routers_of_desk, uses);
        let robot_file = lab.write_config(robot, routers, shares);
        let desk = Node::start(&lab.desk, &desk_file, lab.enroll(desk, false), Some(&far));
        let robot = Node::start(&lab.robot, &robot_file, lab.enroll(robot, false), Some(&near));
        let flows = TOPICS.into_iter().map(|topic| Flow::start(topic, &near, &far)).collect();
        Self { scheme, flows, robot, desk, near, far }
    }

    /// Ends the desk, and starts it again under the same name.
    fn restart_desk(&mut self, lab: &Lab) {
        let desk = format!("desk-{}", self.scheme);
        // Two runs at one time would take the place of each other.
        self.desk.stop();
        let file = lab.path(&format!("{desk}.toml"));
        self.desk = Node::start(&lab.desk, &file, lab.enroll(&desk, false), Some(&self.far));
    }

    fn wait_for(&self, what: &str, after: impl Fn(&Flow) -> u64) {
        for flow in &self.flows {
            let number = after(flow);
            let what = format!("{}: {} {what}", self.scheme, flow.topic.name);
            eventually(&what, || flow.has_heard(number));
        }
    }
}

/// The event of a round.
type Event<'a> = &'a dyn Fn(usize);

/// Runs a scenario with all transports, prints its cost, and asserts that no reliable message was affected.
fn scenario(name: &str, lab: &Lab, event: Event<'_>) {
    let router = Node::start(&lab.cloud, &lab.router_config(), lab.enroll("cloud", true), None);
    let schemes = schemes();
    let turns: Vec<&[&'static str]> = if is_long() { schemes.chunks(1).collect() } else { vec![&schemes] };
    let rounds = if is_long() { ROUNDS_LONG } else { 1 };
    let mut wrong = Vec::new();
    for (turn, schemes) in turns.into_iter().enumerate() {
        let pairs: Vec<_> = schemes.iter().map(|s| Pair::start(lab, s, &[&lab.url(s)])).collect();
        wrong.extend(drive(name, &pairs, |round| event(turn * rounds + round), rounds));
    }
    drop(router);
    assert!(wrong.is_empty(), "{name}: {wrong:#?}");
}

/// Drives a scenario. Returns its failures.
fn drive(name: &str, pairs: &[Pair], event: impl Fn(usize), rounds: usize) -> Vec<String> {
    for pair in pairs {
        pair.wait_for("never begins", |_| 1);
    }
    sleep(CALM);
    let mut outages = vec![Vec::new(); pairs.len() * TOPICS.len()];
    for round in 0..rounds {
        let begun = Instant::now();
        event(round);
        for pair in pairs {
            pair.wait_for("does not go on", |flow| flow.said() + 1);
        }
        sleep(CALM);
        // A stop that begins late counts as well.
        for pair in pairs {
            pair.wait_for("does not stay", |flow| flow.said() + 1);
        }
        let flows = pairs.iter().flat_map(|pair| &pair.flows);
        for (flow, outages) in flows.zip(&mut outages) {
            outages.push(flow.judge(begun - JUST_BEFORE).outage.as_millis());
        }
    }
    let mut wrong = Vec::new();
    for pair in pairs {
        for flow in &pair.flows {
            flow.end();
        }
    }
    say(&format!("\n{name}\n  transport topic    outage, ms (median, max)   lost of"));
    let mut outages = outages.into_iter();
    for pair in pairs {
        for flow in &pair.flows {
            if flow.topic.reliable {
                // The one after the last that was begun may have been begun as well.
                let what = format!("{}: the last of {}", pair.scheme, flow.topic.name);
                eventually(&what, || flow.has_heard(flow.said()));
            }
            let verdict = flow.judge(Instant::now());
            let mut outages = outages.next().unwrap();
            outages.sort_unstable();
            say(&format!(
                "  {:<9} {:<8} {:>10} {:>10} {:>10} {:>6}",
                pair.scheme,
                flow.topic.name,
                outages[outages.len() / 2],
                outages[outages.len() - 1],
                verdict.lost,
                verdict.heard + verdict.lost
            ));
            let mut blame = |what: &str, count: u64| {
                if count > 0 {
                    wrong.push(format!("{} {}: {count} {what}", pair.scheme, flow.topic.name));
                }
            };
            blame("doubled", verdict.doubled);
            blame("out of order", verdict.late);
            if flow.topic.reliable {
                blame("lost", verdict.lost);
            }
        }
    }
    wrong
}

/// Returns `true` if the tests can run on this machine.
fn can_run() -> bool {
    match on_host() {
        Ok(()) => true,
        Err(why) => {
            say(&format!("NO NAMESPACES OR TUN DEVICES ({why}): transports are not tested between networks"));
            false
        }
    }
}

fn cable() -> Lan {
    Lan::Cable
}

fn path(profile: Profile, mtu: u16) -> Lan {
    Lan::Path(TunOptions { mtu, profiles: [profile; 2], seed: 11 })
}

#[test]
fn full_cone_nats_on_both_sides_take_outgoing_links() {
    if can_run() {
        let _turn = turn();
        scenario("full cone NAT on both sides", &Lab::new(cable(), Nat::FullCone), &|_| {});
    }
}

#[test]
fn nats_with_random_ports_on_both_sides_take_outgoing_links() {
    if can_run() {
        let _turn = turn();
        let lab = Lab::new(cable(), Nat::RandomPort(RANGES[0]));
        scenario("random-port NAT on both sides", &lab, &|_| {});
    }
}

#[test]
fn flows_survive_a_nat_that_forgets() {
    if can_run() {
        let _turn = turn();
        let lab = Lab::new(cable(), Nat::RandomPort(RANGES[1]));
        scenario("the robot's NAT forgets its ports", &lab, &|n| lab.rebind(RANGES[n % 2]));
    }
}

#[test]
fn flows_survive_an_interface_that_goes_while_another_comes() {
    if can_run() {
        let _turn = turn();
        let lab = Lab::new(cable(), Nat::RandomPort(RANGES[0]));
        lab.add_lte();
        lab.robot.ip(&["link", "set", "lte", "down"]).unwrap();
        scenario("one interface goes down, another comes up", &lab, &|n| {
            let (goes, comes, gateway) =
                if n % 2 == 0 { ("eth0", "lte", "10.3.0.1") } else { ("lte", "eth0", "10.1.0.1") };
            lab.robot.ip(&["link", "set", goes, "down"]).unwrap();
            lab.robot.ip(&["link", "set", comes, "up"]).unwrap();
            lab.route_by(gateway);
        });
    }
}

#[test]
fn flows_survive_a_default_route_that_moves() {
    if can_run() {
        let _turn = turn();
        let lab = Lab::new(cable(), Nat::RandomPort(RANGES[0]));
        lab.add_lte();
        scenario("the default route moves to another interface", &lab, &|n| {
            lab.route_by(if n % 2 == 0 { "10.3.0.1" } else { "10.1.0.1" });
        });
    }
}

#[test]
fn flows_pass_where_packets_are_short() {
    if can_run() {
        let _turn = turn();
        let lab = Lab::new(path(Profile::default(), 1280), Nat::RandomPort(RANGES[0]));
        scenario("MTU 1280", &lab, &|_| {});
    }
}

#[test]
fn flows_pass_over_the_path_of_the_paper() {
    if can_run() {
        let _turn = turn();
        let profile = Profile {
            rate: Some(5_000_000),
            delay: Duration::from_millis(38),
            loss: Loss::Random(0.02),
            ..Profile::default()
        };
        let lab = Lab::new(path(profile, 1500), Nat::RandomPort(RANGES[0]));
        scenario("76 ms round trip, 5 Mbit/s, 2 % loss", &lab, &|_| sleep(CALM));
    }
}

#[test]
fn a_robot_whose_udp_is_blocked_falls_back_to_tls() {
    if can_run() {
        let _turn = turn();
        let lab = Lab::new(cable(), Nat::RandomPort(RANGES[0]));
        lab.block_udp();
        let _router = Node::start(&lab.cloud, &lab.router_config(), lab.enroll("cloud", true), None);
        let begun = Instant::now();
        // The desk's network lets UDP out.
        let pair = Pair::start(&lab, "quic", &[&lab.url("quic"), &lab.url("tls")]);
        pair.wait_for("never begins", |_| 1);
        say(&format!("\nUDP blocked: the first messages after {} ms", begun.elapsed().as_millis()));
        let links = pair.robot.status()["links"].clone();
        let urls: Vec<_> = links.as_array().unwrap().iter().filter_map(|link| link["url"].as_str()).collect();
        assert_eq!(urls, [lab.url("tls")]);
        let wrong = drive("UDP blocked, quic then tls", &[pair], |_| {}, 1);
        assert!(wrong.is_empty(), "{wrong:#?}");
    }
}

#[test]
fn a_robot_that_comes_to_a_network_without_udp_goes_on_by_tls() {
    if can_run() {
        let _turn = turn();
        let lab = Lab::new(cable(), Nat::RandomPort(RANGES[0]));
        lab.add_lte();
        let _router = Node::start(&lab.cloud, &lab.router_config(), lab.enroll("cloud", true), None);
        let pairs = [Pair::start(&lab, "quic", &[&lab.url("quic"), &lab.url("tls")])];
        let wrong = drive(
            "the default route moves to a network without UDP",
            &pairs,
            |_| {
                lab.block_udp();
                lab.route_by("10.3.0.1");
            },
            1,
        );
        assert!(wrong.is_empty(), "{wrong:#?}");
        eventually("a link by tls alone", || {
            let links = pairs[0].robot.status()["links"].clone();
            let urls = links.as_array().unwrap().iter().filter_map(|link| link["url"].as_str());
            urls.map(str::to_owned).collect::<Vec<_>>() == [lab.url("tls")]
        });
    }
}

/// The lab is what it says: a NAT that forgets shows another port, and an address that is not of a network is not let
/// out.
#[test]
fn the_lab_is_as_bad_as_it_says() {
    if !can_run() {
        return;
    }
    let _turn = turn();
    let lab = Lab::new(cable(), Nat::RandomPort(RANGES[0]));
    let server = bind(&lab.cloud, "0.0.0.0:9");
    let client = bind(&lab.robot, "0.0.0.0:9");
    let seen = || {
        client.send_to(b"?", "10.10.0.1:9").unwrap();
        server.recv_from(&mut [0; 8]).unwrap().1
    };
    let before = seen();
    assert_eq!(before.ip().to_string(), "10.10.1.2");
    assert!((20_000..30_000).contains(&before.port()), "{before}");
    lab.rebind(RANGES[1]);
    eventually("another port", || (30_000..40_000).contains(&seen().port()));

    lab.add_lte();
    let bound = bind(&lab.robot, "10.1.0.2:10");
    lab.route_by("10.3.0.1");
    bound.send_to(b"spoofed", "10.10.0.1:9").unwrap();
    client.send_to(b"own", "10.10.0.1:9").unwrap();
    let mut buffer = [0; 8];
    assert_eq!(server.recv(&mut buffer).unwrap(), 3, "{buffer:?}");
    lab.block_udp();
    lab.route_by("10.1.0.1");
    client.send_to(b"blocked", "10.10.0.1:9").unwrap();
    server.set_read_timeout(Some(JUST_BEFORE)).unwrap();
    assert!(server.recv(&mut buffer).is_err(), "UDP passes");
}

fn bind(namespace: &Arc<sgc_testkit::netsim::Namespace>, address: &str) -> std::net::UdpSocket {
    let socket = namespace.within(|| std::net::UdpSocket::bind(address).unwrap()).unwrap();
    socket.set_read_timeout(Some(support::PATIENCE)).unwrap();
    socket
}
