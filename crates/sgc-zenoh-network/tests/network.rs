//! Behaviour of [`ZenohNetwork`](sgc_zenoh_network::ZenohNetwork) beside that of every network (`conformance.rs`).

#![allow(clippy::unwrap_used)]

mod support;

use std::sync::Arc;
use std::sync::mpsc::channel;

use bytes::Bytes;
use sgc_ros::{
    DiscoveryEvent, EndpointSpec, RequestId, RosClient, RosError, RosNetwork, RosServer, RosWriter,
    ServiceSpec, ServiceTopic, service_qos,
};
use sgc_testkit::conformance::rig::{
    HASH, PATIENCE, discover, eventually, matched, next, quiet, read, spec, string_cdr, with, write,
};
use sgc_wire::{Durability, History};
use sgc_zenoh::{ATTACHMENT_BYTES, Attachment, Gid, TopicInfo};
use sgc_zenoh_network::{ZenohConfig, ZenohNetwork};
use zenoh::Wait as _;

use crate::support::{Router, config, free_endpoint, open, session};

/// The hash of `example_interfaces/srv/AddTwoInts`, and one that a DDS endpoint announces for its request.
const SERVICE_HASH: &str = "RIHS01_e118de6bf5eeb66a2491b5bda11202e7b68f198d6f67922cf30364858239c81a";
const REQUEST_HASH: &str = "RIHS01_d4b2b2d2b2d2b2d2b2d2b2d2b2d2b2d2b2d2b2d2b2d2b2d2b2d2b2d2b2d2b2d2";
const PAYLOAD: &[u8] = &[0, 1, 0, 0, 7, 7, 7, 7];

fn without_hash(topic: &str) -> EndpointSpec {
    EndpointSpec { type_hash: None, ..spec(topic) }
}

fn service(type_hash: Option<&str>) -> ServiceSpec {
    let half = |half: ServiceTopic, type_hash: Option<&str>| EndpointSpec {
        topic: half.dds_topic("/add"),
        type_name: half.dds_type("example_interfaces/srv/AddTwoInts"),
        keyless: true,
        asks_key_hash: false,
        type_hash: type_hash.map(str::to_owned),
        qos: service_qos(),
    };
    ServiceSpec { request: half(ServiceTopic::Request, type_hash), reply: half(ServiceTopic::Reply, None) }
}

#[test]
fn endpoints_without_a_hash_open_with_that_of_a_program() {
    let router = Router::start();
    let (sgc, ros) = (open(&router.endpoint, true), open(&router.endpoint, false));
    let (_early, heard_early) = read(&sgc, &without_hash("up"));
    let writer = sgc.create_writer(&without_hash("down")).unwrap();
    write(&writer, &string_cdr("nobody hears this"));
    let (_reader, heard) = read(&ros, &spec("down"));
    matched(&writer, 1);
    write(&writer, &string_cdr("down"));
    assert_eq!(next(&heard).payload, string_cdr("down"));
    let program = ros.create_writer(&spec("up")).unwrap();
    matched(&program, 1);
    write(&program, &string_cdr("up"));
    assert_eq!(next(&heard_early).payload, string_cdr("up"));
    // A program is there before the endpoint.
    let (_late, heard_late) = read(&sgc, &without_hash("up"));
    matched(&program, 2);
    write(&program, &string_cdr("late"));
    assert_eq!(next(&heard_late).payload, string_cdr("late"));
}

#[test]
fn late_joiners_get_what_was_written_before_the_hash_was_known() {
    let router = Router::start();
    let (sgc, ros) = (open(&router.endpoint, true), open(&router.endpoint, false));
    let latched = |spec: EndpointSpec| {
        with(spec, |qos| (qos.durability, qos.history) = (Durability::TransientLocal, History::KeepLast(2)))
    };
    let writer = sgc.create_writer(&latched(without_hash("map"))).unwrap();
    ["1", "2", "3"].into_iter().for_each(|text| write(&writer, &string_cdr(text)));
    let heard = [0, 1].map(|_| {
        let (reader, heard) = read(&ros, &latched(spec("map")));
        ["2", "3"].into_iter().for_each(|text| assert_eq!(next(&heard).payload, string_cdr(text)));
        (reader, heard)
    });
    write(&writer, &string_cdr("4"));
    for (_reader, heard) in &heard {
        assert_eq!(next(heard).payload, string_cdr("4"));
        quiet(heard);
    }
}

/// Answers one call of a program to a server of a proxy.
fn assert_called(sgc: &ZenohNetwork, ros: &ZenohNetwork, announced: Option<&str>) {
    let (requests, asked) = channel();
    let handler = Box::new(move |id: RequestId, payload| drop(requests.send((id, payload))));
    let server = sgc.create_server(&service(announced), handler).unwrap();
    let (replies, answered) = channel();
    let handler = Box::new(move |id: RequestId, payload| drop(replies.send((id, payload))));
    let client = ros.create_client(&service(Some(SERVICE_HASH)), handler).unwrap();
    eventually("the server has the program's hash", || client.matched_servers() == 1);
    let id = client.request(Bytes::from_static(PAYLOAD)).unwrap();
    let (request, _) = next(&asked);
    server.reply(&request, Bytes::from_static(PAYLOAD)).unwrap();
    assert_eq!(next(&answered), (id, Bytes::from_static(PAYLOAD)));
    assert!(matches!(server.reply(&request, Bytes::from_static(PAYLOAD)), Err(RosError::NoPeer { .. })));
}

#[test]
fn servers_take_the_hash_of_programs_or_of_the_definition() {
    for announced in [None, Some(REQUEST_HASH), Some(SERVICE_HASH)] {
        let router = Router::start();
        assert_called(&open(&router.endpoint, true), &open(&router.endpoint, false), announced);
    }
    let router = Router::start();
    let found = |name: &str, announced: &str| {
        (name == "example_interfaces/srv/AddTwoInts" && announced == REQUEST_HASH)
            .then(|| SERVICE_HASH.to_owned())
    };
    let config = ZenohConfig { service_hash: Some(Arc::new(found)), ..config(&router.endpoint, true) };
    let sgc = ZenohNetwork::open(&config).unwrap();
    let ros = open(&router.endpoint, false);
    let events = discover(&ros);
    let _server = sgc.create_server(&service(Some(REQUEST_HASH)), Box::new(|_, _| {})).unwrap();
    let DiscoveryEvent::Appeared(told) = next(&events) else { panic!("an appearance was expected") };
    assert_eq!(told.type_hash.as_deref(), Some(SERVICE_HASH), "no program needs to have it first");
}

#[test]
fn a_network_opens_without_its_router_and_finds_it_later() {
    let endpoint = free_endpoint();
    let (sgc, ros) = (open(&endpoint, true), open(&endpoint, false));
    let events = discover(&sgc);
    let _writer = ros.create_writer(&spec("chatter")).unwrap();
    assert_eq!(sgc.missing_router(), Some(endpoint.clone()));
    let alone = ZenohNetwork::open(&ZenohConfig { without_router: true, ..config(&endpoint, true) }).unwrap();
    assert_eq!(alone.missing_router(), None);
    drop(alone);
    quiet(&events);
    let router = session("router", "listen/endpoints", &endpoint).unwrap();
    assert!(matches!(next(&events), DiscoveryEvent::Appeared(_)));
    eventually("the router is connected", || sgc.missing_router().is_none());
    router.close().wait().unwrap();
    eventually("the router is missed", || sgc.missing_router().is_some());
}

#[tokio::test]
async fn a_network_opens_and_closes_on_a_runtime_with_one_thread() {
    // The router's session cannot start or end on such a runtime.
    let router = std::thread::spawn(Router::start).join().unwrap();
    let network = Arc::new(open(&router.endpoint, true));
    let writer = network.create_writer(&spec("a")).unwrap();
    drop(writer);
    assert!(network.close(PATIENCE));
    std::thread::spawn(move || drop(router)).join().unwrap();
}

#[test]
fn messages_that_are_not_those_of_rmw_zenoh_are_dropped() {
    let router = Router::start();
    let sgc = open(&router.endpoint, true);
    let (_reader, heard) = read(&sgc, &spec("odd"));
    let program = session("client", "connect/endpoints", &router.endpoint).unwrap();
    let key = TopicInfo::new("/odd", "std_msgs::msg::dds_::String_", HASH).unwrap().key(0);
    let publisher = program.declare_publisher(key.clone()).wait().unwrap();
    let right = Attachment { sequence: 1, source_timestamp_ns: 2, gid: Gid([3; 16]) }.encode();
    eventually("the reader is found", || publisher.matching_status().wait().unwrap().matching());
    publisher.put(PAYLOAD).wait().unwrap();
    for attachment in [&[][..], &right[..ATTACHMENT_BYTES - 1], &[0; 4096], b"\x0fsequence_number"] {
        publisher.put(PAYLOAD).attachment(attachment).wait().unwrap();
    }
    publisher.put(&PAYLOAD[..3]).attachment(right).wait().unwrap();
    publisher.delete().attachment(right).wait().unwrap();
    publisher.put(PAYLOAD).attachment(right).wait().unwrap();
    let sample = next(&heard);
    assert_eq!((sample.payload, sample.source_timestamp_ns), (PAYLOAD.into(), 2));
    assert_eq!(sample.writer, None, "no token has this id");
    quiet(&heard);
}

#[test]
fn the_depth_that_becomes_known_holds_for_late_joiners() {
    let router = Router::start();
    let (sgc, ros) = (open(&router.endpoint, true), open(&router.endpoint, false));
    let latched = |history| {
        with(spec("map"), |qos| {
            qos.durability = Durability::TransientLocal;
            qos.history = history;
        })
    };
    let writer = sgc.create_writer(&latched(History::UNSAID)).unwrap();
    (0..5).for_each(|i| write(&writer, &string_cdr(&i.to_string())));
    let (_all, heard) = read(&ros, &latched(History::KeepLast(10)));
    (0..5).for_each(|i: u32| assert_eq!(next(&heard).payload, string_cdr(&i.to_string())));
    writer.set_late_depth(2);
    let (_late, heard) = read(&ros, &latched(History::KeepLast(10)));
    (3..5).for_each(|i: u32| assert_eq!(next(&heard).payload, string_cdr(&i.to_string())));
    quiet(&heard);
}
