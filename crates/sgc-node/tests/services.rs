//! Services across whole nodes: real QUIC on the loopback interface, local networks in memory.

#![allow(clippy::unwrap_used)]

#[path = "support/lab.rs"]
mod lab;
mod support;

use std::collections::BTreeMap;
use std::sync::mpsc::{Receiver, channel};

use crate::lab::{Lab, all, share, uses};
use crate::support::{Listener, Node, PATIENCE, Talker, wait};
use bytes::Bytes;
use sgc_node::config::{Config, Interface, ShareConfig, UseConfig};
use sgc_ros::{
    EndpointKind, EndpointSpec, GraphNode, RequestId, RosClient, RosNetwork, RosServer, ServiceSpec,
    ServiceTopic, service_qos,
};
use sgc_testkit::{FakeClient, FakeDomain, FakeRos, FakeServer};
use sgc_wire::RosNode;

const TYPE: &str = "example_interfaces/srv/AddTwoInts";

fn service(name: &str) -> ServiceSpec {
    let half = |half: ServiceTopic| EndpointSpec {
        topic: half.dds_topic(name),
        type_name: half.dds_type(TYPE),
        keyless: true,
        asks_key_hash: false,
        type_hash: None,
        qos: service_qos(),
    };
    ServiceSpec { request: half(ServiceTopic::Request), reply: half(ServiceTopic::Reply) }
}

fn shares(name: &str, to: &[&str]) -> ShareConfig {
    ShareConfig { interface: Interface::Service, ..share(name, to) }
}

fn calls(name: &str) -> UseConfig {
    UseConfig { interface: Interface::Service, ..uses(name) }
}

/// Returns the number of servers of a service on a network.
fn servers(net: &FakeDomain, name: &str) -> usize {
    net.count(&ServiceTopic::Request.dds_topic(name), EndpointKind::Reader)
}

/// An application with a server, which answers on request of the test.
struct Server {
    end: FakeServer,
    asked: Receiver<(RequestId, Bytes)>,
    _net: FakeRos,
}

impl Server {
    fn new(domain: &FakeDomain, name: &str) -> Self {
        let net = domain.join(false);
        let (tx, asked) = channel();
        let handler = Box::new(move |id, payload| drop(tx.send((id, payload))));
        Self { end: net.create_server(&service(name), handler).unwrap(), asked, _net: net }
    }

    fn takes(&self) -> (RequestId, Bytes) {
        self.asked.recv_timeout(PATIENCE).expect("a request")
    }

    fn takes_nothing(&self) {
        assert!(self.asked.try_recv().is_err(), "a request too many");
    }

    /// Answers a request with its text and `mark`.
    fn answers(&self, (id, payload): &(RequestId, Bytes), mark: u8) {
        self.end.reply(id, [payload, &[mark][..]].concat().into()).unwrap();
    }
}

/// An application with a client.
struct Client {
    end: FakeClient,
    answers: Receiver<(RequestId, Bytes)>,
    _net: FakeRos,
}

impl Client {
    fn new(domain: &FakeDomain, name: &str) -> Self {
        let net = domain.join(false);
        let (tx, answers) = channel();
        let handler = Box::new(move |id, payload| drop(tx.send((id, payload))));
        Self { end: net.create_client(&service(name), handler).unwrap(), answers, _net: net }
    }

    /// Calls once there is a server.
    fn calls(&self, text: &str) -> RequestId {
        wait("a server is there", || self.end.matched_servers() > 0);
        self.end.request(body(text)).unwrap()
    }

    fn hears(&self) -> (RequestId, Bytes) {
        self.answers.recv_timeout(PATIENCE).expect("an answer")
    }

    fn is_answered(&self, call: RequestId, text: &str, mark: u8) {
        assert_eq!(self.hears(), (call, [&body(text)[..], &[mark]].concat().into()));
    }

    fn hears_nothing(&self) {
        assert!(self.answers.try_recv().is_err(), "an answer too many");
    }
}

fn body(text: &str) -> Bytes {
    [&[0, 1, 0, 0], text.as_bytes()].concat().into()
}

/// Starts the robot with a service for these nodes.
fn robot(lab: &Lab, to: &[&str]) -> Node {
    lab.start("robot", |c| c.shares = vec![shares("/add", to)])
}

fn caller(lab: &Lab, name: &str) -> Node {
    lab.start(name, |c| c.uses = vec![calls("/add")])
}

#[test]
fn every_client_anywhere_gets_its_own_answers_and_no_other() {
    const CALLS: usize = 25;
    let lab = Lab::new(&["robot", "desk", "tablet"]);
    let (_cloud, robot) = (lab.cloud(), robot(&lab, &["desk", "tablet"]));
    let (desk, tablet) = (caller(&lab, "desk"), caller(&lab, "tablet"));
    let server = Server::new(&lab.net("robot"), "/add");
    let clients = ["desk", "desk", "tablet"].map(|node| Client::new(&lab.net(node), "/add"));
    let mut open: [BTreeMap<RequestId, String>; 3] = Default::default();
    for n in 0..CALLS {
        for (which, client) in clients.iter().enumerate() {
            let text = format!("{which}:{n}");
            open[which].insert(client.calls(&text), text);
        }
    }
    // The answers leave in another order than the requests came.
    let mut asked: Vec<_> = (0..3 * CALLS).map(|_| server.takes()).collect();
    asked.reverse();
    asked.iter().for_each(|call| server.answers(call, b'!'));
    for (which, client) in clients.iter().enumerate() {
        for _ in 0..CALLS {
            let (id, answer) = client.hears();
            let text = open[which].remove(&id).expect("a call of this client");
            assert_eq!(answer, [&body(&text)[..], b"!"].concat());
        }
    }
    clients.iter().for_each(Client::hears_nothing);
    server.takes_nothing();
    // In the default suite, both ends of a call prove their messages without a signature.
    for node in [&robot, &desk, &tablet] {
        let status = node.status();
        let route =
            status["routes"].as_array().unwrap().iter().find(|route| route["topic"] == "/add").unwrap();
        assert!(route["messages"].as_u64() > Some(0) && route["signatures"] == 0, "{route}");
    }
}

#[test]
fn a_far_service_is_of_its_own_node_in_the_local_graph() {
    let lab = Lab::new(&["robot", "desk"]);
    let (_cloud, _robot, _desk) = (lab.cloud(), robot(&lab, &["desk"]), caller(&lab, "desk"));
    let shown = |node: &str| {
        let all = lab.net(node).mirrored();
        all.into_iter()
            .map(|(name, readers, writers)| format!("{name} {readers} {writers}"))
            .collect::<Vec<_>>()
    };
    let server = Server::new(&lab.net("robot"), "/add");
    wait("a server of nobody that is known", || shown("desk") == ["/sgc_desk 1 1"]);
    let [reader, writer] = server.end.guids();
    let node = RosNode::new("/arm", "adder", None).unwrap();
    server._net.announce(&[GraphNode { node, readers: vec![reader], writers: vec![writer] }]).unwrap();
    wait("a server of the adder", || shown("desk") == ["/arm/adder 1 1", "/sgc_desk 0 0"]);
    // The proxy's client calls the service there.
    assert_eq!(shown("robot"), ["/sgc_robot 1 1"]);
    drop(server);
    wait("nothing", || shown("desk") == ["/sgc_desk 0 0"]);
}

#[test]
fn large_requests_and_answers_arrive_whole() {
    let lab = Lab::new(&["robot", "desk"]);
    let (_cloud, _robot, desk) = (lab.cloud(), robot(&lab, &["desk"]), caller(&lab, "desk"));
    let server = Server::new(&lab.net("robot"), "/add");
    let client = Client::new(&lab.net("desk"), "/add");
    for bytes in [0, 1, 70_000, 3_000_000] {
        let text: String = (0..bytes).map(|n| char::from(b'a' + (n % 23) as u8)).collect();
        let call = client.calls(&text);
        let asked = server.takes();
        assert!(asked.1 == body(&text));
        server.answers(&asked, 7);
        client.is_answered(call, &text, 7);
    }
    let state = desk.route_state();
    assert!(state.contains("4 calls, 0 in progress, 4 answered, 0 refused, 0 lost"), "{state}");
}

#[test]
fn a_server_that_dies_is_gone_for_remote_clients_too_and_may_come_back() {
    let lab = Lab::new(&["robot", "desk"]);
    let (_cloud, _robot, _desk) = (lab.cloud(), robot(&lab, &["desk"]), caller(&lab, "desk"));
    let client = Client::new(&lab.net("desk"), "/add");
    for round in 0..2 {
        let server = Server::new(&lab.net("robot"), "/add");
        let call = client.calls("x");
        server.answers(&server.takes(), round);
        client.is_answered(call, "x", round);
        // The service ends with an open call.
        client.calls("y");
        server.takes();
        drop(server);
        wait("the server is gone", || client.end.matched_servers() == 0);
    }
    client.hears_nothing();
    assert_eq!(servers(&lab.net("desk"), "/add"), 0);
}

#[test]
fn call_asked_of_a_server_that_was_replaced_is_counted_at_both_ends() {
    let lab = Lab::new(&["robot", "desk"]);
    let (_cloud, robot, desk) = (lab.cloud(), robot(&lab, &["desk"]), caller(&lab, "desk"));
    let first = Server::new(&lab.net("robot"), "/add");
    let client = Client::new(&lab.net("desk"), "/add");
    client.calls("lost");
    first.takes();
    // The second server exists before the end of the first is noticed, so the service always has one.
    let second = Server::new(&lab.net("robot"), "/add");
    drop(first);
    for node in [&robot, &desk] {
        wait("it is counted", || node.status()["drops"]["call_server_gone"] == 1);
        assert!(node.route_state().contains("0 in progress, 0 answered, 0 refused, 1 lost"));
    }
    let call = client.calls("new");
    second.answers(&second.takes(), 1);
    client.is_answered(call, "new", 1);
    client.hears_nothing();
}

#[test]
fn server_that_starts_while_another_takes_a_call_was_not_asked() {
    let lab = Lab::new(&["robot", "desk"]);
    let (_cloud, robot, desk) = (lab.cloud(), robot(&lab, &["desk"]), caller(&lab, "desk"));
    let (net, domain) = (lab.net("robot").join(false), lab.net("robot"));
    let (tx, started) = channel();
    // The second server appears before the owner's client knows that its request was sent.
    let handler = Box::new(move |_, _| drop(tx.send(Server::new(&domain, "/add"))));
    let first = net.create_server(&service("/add"), handler).unwrap();
    let client = Client::new(&lab.net("desk"), "/add");
    client.calls("lost");
    let second = started.recv_timeout(PATIENCE).expect("a second server");
    drop(first);
    for node in [&robot, &desk] {
        wait("it is counted", || node.status()["drops"]["call_server_gone"] == 1);
    }
    let call = client.calls("new");
    second.answers(&second.takes(), 1);
    client.is_answered(call, "new", 1);
    client.hears_nothing();
}

#[test]
fn call_that_waits_when_its_service_ends_is_counted_and_stays_so() {
    let lab = Lab::new(&["robot", "desk"]);
    let (_cloud, _robot, desk) = (lab.cloud(), robot(&lab, &["desk"]), caller(&lab, "desk"));
    let server = Server::new(&lab.net("robot"), "/add");
    let client = Client::new(&lab.net("desk"), "/add");
    wait("a server is there", || client.end.matched_servers() > 0);
    drop(server);
    wait("no server is there", || servers(&lab.net("robot"), "/add") == 0);
    // The service is still offered.
    client.end.request(body("lost")).unwrap();
    wait("it is counted", || desk.status()["drops"]["call_withdrawn"] == 1);
    // Until the desk's server ends, it takes calls and counts them as withdrawn.
    wait("the service is gone", || client.end.matched_servers() == 0);
    let server = Server::new(&lab.net("robot"), "/add");
    let call = client.calls("new");
    server.answers(&server.takes(), 1);
    client.is_answered(call, "new", 1);
    let state = desk.route_state();
    assert!(state.contains("2 calls, 0 in progress, 1 answered, 0 refused, 1 lost"), "{state}");
}

#[test]
fn a_call_under_way_is_answered_once_though_the_router_restarts() {
    let lab = Lab::new(&["robot", "desk"]);
    let (cloud, _robot, desk) = (lab.cloud(), robot(&lab, &["desk"]), caller(&lab, "desk"));
    let server = Server::new(&lab.net("robot"), "/add");
    let client = Client::new(&lab.net("desk"), "/add");
    let before = client.calls("answered before the way is back");
    let after = client.calls("answered after it");
    let asked = [server.takes(), server.takes()];
    cloud.kill();
    wait("the router is missed", || desk.status()["links"].as_array().unwrap().is_empty());
    server.answers(&asked[0], 1);
    let meanwhile = client.end.request(body("asked meanwhile")).unwrap();
    let _cloud = lab.cloud();
    let third = server.takes();
    server.answers(&asked[1], 2);
    server.answers(&third, 3);
    let mut answers = [client.hears(), client.hears(), client.hears()];
    answers.sort();
    let marks = answers.each_ref().map(|(id, answer)| (*id, *answer.last().unwrap()));
    assert_eq!(marks, [(before, 1), (after, 2), (meanwhile, 3)]);
    // A repeated request would arrive before this one.
    let last = client.calls("last");
    server.answers(&server.takes(), 4);
    client.is_answered(last, "last", 4);
    client.hears_nothing();
    server.takes_nothing();
}

#[test]
fn call_is_not_repeated_after_the_owner_restarts() {
    let lab = Lab::new(&["robot", "desk"]);
    let (_cloud, first, desk) = (lab.cloud(), robot(&lab, &["desk"]), caller(&lab, "desk"));
    let server = Server::new(&lab.net("robot"), "/add");
    let client = Client::new(&lab.net("desk"), "/add");
    client.calls("lost");
    let lost = server.takes();
    first.kill();
    wait("the owner is missed", || !desk.route_state().starts_with("granted"));
    let _second = robot(&lab, &["desk"]);
    wait("the owner is back", || desk.route_state().starts_with("granted"));
    let call = client.calls("new");
    let new = server.takes();
    assert_eq!(new.1, body("new"));
    let _ = server.end.reply(&lost.0, body("for nobody"));
    server.answers(&new, 5);
    client.is_answered(call, "new", 5);
    client.hears_nothing();
    let state = desk.route_state();
    assert!(state.contains("2 calls, 0 in progress, 1 answered, 0 refused, 1 lost"), "{state}");
}

#[test]
fn the_call_of_a_client_that_is_gone_is_forgotten_at_both_ends() {
    let lab = Lab::new(&["robot", "desk"]);
    let (_cloud, robot, desk) = (lab.cloud(), robot(&lab, &["desk"]), caller(&lab, "desk"));
    let server = Server::new(&lab.net("robot"), "/add");
    let client = Client::new(&lab.net("desk"), "/add");
    client.calls("never mind");
    let asked = server.takes();
    drop(client);
    for node in [&robot, &desk] {
        // The loss is counted once the call is no longer open.
        wait("it is forgotten", || {
            let state = node.route_state();
            state.contains("0 in progress") && state.contains("1 lost")
        });
    }
    server.answers(&asked, 1);
    wait("the answer is for nobody", || robot.status()["drops"]["reply_to_nothing"] == 1);
}

#[test]
fn a_topic_is_no_service_and_a_service_no_topic() {
    let lab = Lab::new(&["robot", "desk", "tablet"]);
    let _cloud = lab.cloud();
    let _robot = lab.start("robot", |c| {
        c.shares = vec![shares("/add", &["tablet"]), share("/add", &["desk"])];
    });
    let both = |c: &mut Config| c.uses = vec![calls("/add"), uses("/add")];
    let (desk, tablet) = (lab.start("desk", both), lab.start("tablet", both));
    let server = Server::new(&lab.net("robot"), "/add");
    let talker = Talker::new(&lab.net("robot"), "/add", all());
    let listeners = ["desk", "tablet"].map(|node| Listener::new(&lab.net(node), "/add", all()));
    let client = Client::new(&lab.net("tablet"), "/add");
    let call = client.calls("x");
    server.answers(&server.takes(), 1);
    client.is_answered(call, "x", 1);
    listeners[0].hears_at_last(|_| talker.say("hello"));
    let state = |node: &Node, n: usize| node.status()["routes"][n]["state"].as_str().unwrap().to_owned();
    assert!(state(&desk, 0).contains("has no such service"), "{}", state(&desk, 0));
    assert!(state(&tablet, 1).contains("does not share it"), "{}", state(&tablet, 1));
    assert_eq!(servers(&lab.net("desk"), "/add"), 0);
    assert_eq!(support::writers(&lab.net("tablet"), "/add"), 0);
    listeners[1].hears_nothing();
}

#[test]
fn an_action_is_carried_whole() {
    const ACTION: &str = "example_interfaces/action/Fibonacci";
    let lab = Lab::new(&["robot", "desk"]);
    let _cloud = lab.cloud();
    let action = Interface::Action;
    let _robot = lab
        .start("robot", |c| c.shares = vec![ShareConfig { interface: action, ..share("/fib", &["desk"]) }]);
    let _desk = lab.start("desk", |c| c.uses = vec![UseConfig { interface: action, ..uses("/fib") }]);
    let parts = |kind| action.parts().iter().filter(move |p| p.kind == kind);
    let spec = |name: &str, of: &str| {
        let half = |half: ServiceTopic| EndpointSpec {
            topic: half.dds_topic(name),
            type_name: half.dds_type(of),
            ..service(name).request
        };
        ServiceSpec { request: half(ServiceTopic::Request), reply: half(ServiceTopic::Reply) }
    };
    for part in parts(sgc_wire::Kind::Service) {
        let spec = spec(&part.name("/fib"), &part.type_name(Some(ACTION)).unwrap());
        let (robot, desk) = (lab.net("robot").join(false), lab.net("desk").join(false));
        let (asked, requests) = channel();
        let server = robot.create_server(&spec, Box::new(move |id, p| drop(asked.send((id, p))))).unwrap();
        let (answered, answers) = channel();
        let client = desk.create_client(&spec, Box::new(move |id, p| drop(answered.send((id, p))))).unwrap();
        wait("the action's server is there", || client.matched_servers() > 0);
        let call = client.request(body("goal")).unwrap();
        let (id, payload) = requests.recv_timeout(PATIENCE).unwrap();
        server.reply(&id, payload).unwrap();
        assert_eq!(answers.recv_timeout(PATIENCE).unwrap(), (call, body("goal")));
    }
    for part in parts(sgc_wire::Kind::Topic) {
        let name = part.name("/fib");
        let (robot, desk) = (lab.net("robot").join(false), lab.net("desk").join(false));
        let type_name = sgc_ros::dds_type(&part.type_name(Some(ACTION)).unwrap());
        let topic = EndpointSpec { type_name, ..support::spec(&name, support::latched()) };
        let writer = robot.create_writer(&topic).unwrap();
        let (heard, samples) = channel();
        let _reader = desk
            .create_reader(&topic, Box::new(move |s: sgc_ros::Sample| drop(heard.send(s.payload))))
            .unwrap();
        sgc_ros::RosWriter::write(&writer, sgc_ros::SampleKind::Write, 1, body("status")).unwrap();
        assert_eq!(samples.recv_timeout(PATIENCE).unwrap(), body("status"));
    }
}
