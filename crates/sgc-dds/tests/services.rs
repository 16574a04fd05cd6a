//! Services of [`CycloneNetwork`] between participants that talk over the loopback interface, beside those of every
//! network (`conformance.rs`). An untagged network stands for a plain ROS 2 process.

#![allow(clippy::unwrap_used)]

use std::sync::mpsc::{Receiver, RecvTimeoutError, channel};
use std::time::Duration;

use bytes::Bytes;
use sgc_dds::{CycloneClient, CycloneNetwork, CycloneServer, DdsConfig, DiscoveryRange};
use sgc_ros::{
    EndpointSpec, RequestId, RosClient, RosError, RosNetwork, RosServer, RosWriter, Sample, SampleKind,
    ServiceSpec, ServiceTopic, service_qos,
};

/// Longest wait for an event, far beyond what any takes.
const PATIENCE: Duration = Duration::from_secs(30);
/// Time for which nothing must happen.
const QUIET: Duration = Duration::from_millis(300);

fn open(domain: u32, tag: Option<&str>) -> CycloneNetwork {
    open_with(domain, tag, None)
}

fn open_with(domain: u32, tag: Option<&str>, cyclonedds_uri: Option<&str>) -> CycloneNetwork {
    CycloneNetwork::open(&DdsConfig {
        domain,
        discovery: DiscoveryRange::LocalHost,
        tag: tag.map(str::to_owned),
        cyclonedds_uri: cyclonedds_uri.map(str::to_owned),
        ..DdsConfig::default()
    })
    .unwrap()
}

fn spec() -> ServiceSpec {
    let half = |half: ServiceTopic| EndpointSpec {
        topic: half.dds_topic("/add"),
        type_name: half.dds_type("example_interfaces/srv/AddTwoInts"),
        keyless: true,
        asks_key_hash: false,
        type_hash: None,
        qos: service_qos(),
    };
    ServiceSpec { request: half(ServiceTopic::Request), reply: half(ServiceTopic::Reply) }
}

type CallReceiver = Receiver<(RequestId, Bytes)>;

fn client(network: &CycloneNetwork) -> (CycloneClient, CallReceiver) {
    let (tx, rx) = channel();
    let handler = Box::new(move |id, payload| drop(tx.send((id, payload))));
    (network.create_client(&spec(), handler).unwrap(), rx)
}

fn server(network: &CycloneNetwork) -> (CycloneServer, CallReceiver) {
    let (tx, rx) = channel();
    let handler = Box::new(move |id, payload| drop(tx.send((id, payload))));
    (network.create_server(&spec(), handler).unwrap(), rx)
}

fn next(heard: &CallReceiver) -> (RequestId, Bytes) {
    heard.recv_timeout(PATIENCE).expect("a request or a reply")
}

fn quiet(heard: &CallReceiver) {
    assert_eq!(heard.recv_timeout(QUIET), Err(RecvTimeoutError::Timeout));
}

/// Sends a request once there is a server.
fn ask(client: &CycloneClient, payload: &[u8]) -> RequestId {
    for _ in 0..PATIENCE.as_secs() {
        match client.request(Bytes::copy_from_slice(payload)) {
            Err(RosError::NoPeer { .. }) => {}
            asked => return asked.unwrap(),
        }
    }
    panic!("no server was found");
}

#[test]
fn requests_and_replies_find_each_other_in_either_byte_order() {
    let (ros, sgc) = (open(120, None), open(120, Some("arm-1")));
    for (asker, answerer) in [(&ros, &sgc), (&sgc, &ros)] {
        let (server, requests) = server(answerer);
        let clients = [client(asker), client(asker)];
        for order in [0, 1] {
            let asked: Vec<_> = clients.iter().map(|(c, _)| ask(c, &[0, order, 0, 0, 1, 2, 3, 4])).collect();
            let mut got = [next(&requests), next(&requests)];
            got.sort_by_key(|(id, _)| asked.iter().position(|a| a.client == id.client));
            for (n, (id, payload)) in got.into_iter().enumerate() {
                assert_eq!((id.client, id.number), (asked[n].client, asked[n].number));
                assert_eq!(payload, [0, order, 0, 0, 1, 2, 3, 4].as_slice());
                server.reply(&id, Bytes::copy_from_slice(&[0, order, 0, 0, n as u8])).unwrap();
            }
            for (n, (_, replies)) in clients.iter().enumerate() {
                assert_eq!(
                    next(replies),
                    (asked[n], Bytes::copy_from_slice(&[0, order, 0, 3, n as u8, 0, 0, 0]))
                );
            }
        }
        quiet(&clients[0].1);
        assert_eq!(clients[1].0.matched_servers(), 1);
    }
}

#[test]
fn content_that_is_traced_ends_nobody() {
    let trace = "<Tracing><Category>trace,content</Category><OutputFile>/dev/null</OutputFile></Tracing>";
    let (ros, sgc) = (open_with(125, None, Some(trace)), open_with(125, Some("arm-1"), Some(trace)));
    let (server, requests) = server(&sgc);
    let (client, replies) = client(&ros);
    let asked = ask(&client, &[0, 1, 0, 0, 1, 2, 3, 4]);
    let (id, payload) = next(&requests);
    server.reply(&id, payload.clone()).unwrap();
    assert_eq!(next(&replies), (asked, payload));
}

/// The bytes of rmw_cyclonedds: behind the encapsulation header the client's id and the number, then the body.
#[test]
fn the_header_is_that_of_rmw_cyclonedds() {
    let (ros, sgc) = (open(121, None), open(121, Some("arm-1")));
    let (server, requests) = server(&sgc);
    let (tx, replies) = channel();
    let on_reply = Box::new(move |sample: Sample| drop(tx.send(sample.payload)));
    let _reader = ros.create_reader(&spec().reply, on_reply).unwrap();
    let writer = ros.create_writer(&spec().request).unwrap();
    let end = std::time::Instant::now() + PATIENCE;
    while writer.matched_readers() == 0 {
        assert!(std::time::Instant::now() < end);
        std::thread::sleep(Duration::from_millis(2));
    }
    let header = |little: bool| {
        let bytes = |n: u64| if little { n.to_le_bytes() } else { n.to_be_bytes() };
        [[0, u8::from(little), 0, 0].as_slice(), &bytes(0x1122_3344_5566_7788), &bytes(u64::MAX - 6)].concat()
    };
    for little in [true, false] {
        let request = [header(little), vec![9, 9, 9, 9]].concat();
        writer.write(SampleKind::Write, 1, request.into()).unwrap();
        let (id, payload) = next(&requests);
        assert_eq!(
            (id.number, &id.client[..9]),
            (-7, &[0x11, 0x22, 0x33, 0x44, 0x55, 0x66, 0x77, 0x88, 0][..])
        );
        assert_eq!(
            (id.asker, payload),
            (Some(writer.guid()), vec![0, u8::from(little), 0, 0, 9, 9, 9, 9].into())
        );
        server.reply(&id, vec![0, u8::from(little), 0, 0, 5, 5, 5, 5].into()).unwrap();
        assert_eq!(replies.recv_timeout(PATIENCE).unwrap(), [header(little), vec![5; 4]].concat());
    }
    // A payload that is too short for an id is dropped.
    writer.write(SampleKind::Write, 1, vec![0, 1, 0, 0, 1, 2, 3, 4].into()).unwrap();
    quiet(&requests);
}
