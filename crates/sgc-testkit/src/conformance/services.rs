//! Calls between programs and proxies.

use std::collections::BTreeMap;
use std::sync::mpsc::{Receiver, channel};
use std::sync::{Arc, Mutex};
use std::time::{Duration, Instant};

use bytes::Bytes;
use sgc_ros::{
    EndpointSpec, RequestId, RosClient, RosError, RosNetwork, RosServer, ServiceSpec, ServiceTopic,
    service_qos,
};

use super::Site;
use super::rig::{PATIENCE, next, quiet};

/// The hash of `example_interfaces/srv/AddTwoInts`.
const HASH: &str = "RIHS01_e118de6bf5eeb66a2491b5bda11202e7b68f198d6f67922cf30364858239c81a";
/// A payload without a body.
const EMPTY: &[u8] = &[0, 1, 0, 0];
const ANSWER: &[u8] = &[0, 1, 0, 0, 7, 7, 7, 7];

type Calls = Receiver<(RequestId, Bytes)>;

fn spec() -> ServiceSpec {
    let half = |half: ServiceTopic, type_hash: Option<&str>| EndpointSpec {
        topic: half.dds_topic("/add"),
        type_name: half.dds_type("example_interfaces/srv/AddTwoInts"),
        keyless: true,
        asks_key_hash: false,
        type_hash: type_hash.map(str::to_owned),
        qos: service_qos(),
    };
    // The request has the hash of the service as a whole.
    ServiceSpec { request: half(ServiceTopic::Request, Some(HASH)), reply: half(ServiceTopic::Reply, None) }
}

fn client<N: RosNetwork>(network: &N) -> (N::Client, Calls) {
    let (tx, rx) = channel();
    let handler = Box::new(move |id, payload| drop(tx.send((id, payload))));
    (network.create_client(&spec(), handler).expect("a client"), rx)
}

fn server<N: RosNetwork>(network: &N) -> (N::Server, Calls) {
    let (tx, rx) = channel();
    let handler = Box::new(move |id, payload| drop(tx.send((id, payload))));
    (network.create_server(&spec(), handler).expect("a server"), rx)
}

/// Sends a request once there is a server.
fn ask(client: &impl RosClient, payload: &[u8]) -> RequestId {
    for _ in 0..PATIENCE.as_secs() {
        match client.request(Bytes::copy_from_slice(payload)) {
            Err(RosError::NoPeer { .. }) => {}
            asked => return asked.expect("the request is taken"),
        }
    }
    panic!("no server was found");
}

/// Lets each client call the server: it gets the request with its id, and this client alone the reply.
fn assert_each_is_answered<C: RosClient>(clients: &[(C, Calls)], server: &impl RosServer, requests: &Calls) {
    for (n, (client, replies)) in clients.iter().enumerate() {
        let asked = ask(client, &[0, 1, 0, 0, 1, 2, 3, n as u8]);
        let (id, payload) = next(requests);
        assert_eq!((id.client, id.number), (asked.client, asked.number));
        assert_eq!(payload, [0, 1, 0, 0, 1, 2, 3, n as u8].as_slice());
        server.reply(&id, Bytes::from_static(ANSWER)).expect("the reply is taken");
        assert_eq!(next(replies), (asked, Bytes::from_static(ANSWER)));
    }
    clients.iter().for_each(|(_, replies)| quiet(replies));
}

/// Requests of several clients reach the server with their ids, and each reply reaches its client alone.
pub fn requests_and_replies_find_each_other<S: Site>() {
    let site = S::new();
    let (ros, sgc) = (site.open(None), site.open(Some("arm-1")));
    for (asker, answerer) in [(&ros, &sgc), (&sgc, &ros)] {
        let (server, requests) = server(answerer);
        let clients = [client(asker), client(asker)];
        assert_each_is_answered(&clients, &server, &requests);
        assert_eq!(clients[1].0.matched_servers(), 1);
    }
}

/// A client of a proxy finds no server of another one, and says that there is none.
pub fn request_without_a_server_says_so_and_proxies_do_not_call_each_other<S: Site>() {
    let site = S::new();
    let (first, second) = (site.open(Some("a")), site.open(Some("b")));
    let (client, _replies) = client(&first);
    let (_server, requests) = server(&second);
    let refused = client.request(Bytes::from_static(EMPTY));
    assert!(matches!(refused, Err(RosError::NoPeer { .. })), "{refused:?}");
    assert_eq!(client.matched_servers(), 0);
    quiet(&requests);
}

/// The programs behind a gateway share one participant.
pub fn programs_behind_one_network_without_tag_call_each_other<S: Site>() {
    let ros = S::new().open(None);
    let (server, requests) = server(&ros);
    let clients = [client(&ros), client(&ros)];
    assert_each_is_answered(&clients, &server, &requests);
    quiet(&requests);
}

/// A request that one server got may be answered by another, until its client is gone.
pub fn server_made_anew_answers_what_the_one_before_was_asked<S: Site>() {
    let site = S::new();
    let (ros, sgc) = (site.open(None), site.open(Some("arm-1")));
    let (client, replies) = client(&ros);
    let (first, requests) = server(&sgc);
    let asked = ask(&client, EMPTY);
    let (id, _) = next(&requests);
    drop(first);
    let (second, _requests) = server(&sgc);
    second.reply(&id, Bytes::from_static(ANSWER)).expect("the reply is taken");
    assert_eq!(next(&replies), (asked, Bytes::from_static(ANSWER)));
    drop(client);
    // The end of the client may not be known yet.
    let end = Instant::now() + PATIENCE;
    let gone = loop {
        match second.reply(&id, Bytes::from_static(EMPTY)) {
            Ok(()) if Instant::now() < end => std::thread::sleep(Duration::from_millis(2)),
            answer => break answer,
        }
    };
    assert!(matches!(gone, Err(RosError::NoPeer { .. })), "{gone:?}");
}

/// Requests are sent on the caller's thread while replies arrive on another.
pub fn many_calls_at_once_are_each_answered_once<S: Site>() {
    const CALLS: usize = 300;
    let site = S::new();
    let (ros, sgc) = (site.open(None), site.open(Some("arm-1")));
    let (answering, requests) = server(&ros);
    let answering = Arc::new(Mutex::new(answering));
    let echoing = Arc::clone(&answering);
    let echo = std::thread::spawn(move || {
        for (id, payload) in requests.iter().take(CALLS) {
            echoing.lock().expect("the server").reply(&id, payload).expect("the reply is taken");
        }
    });
    let (client, replies) = client(&sgc);
    let payload = |n: usize| [EMPTY, &(n as u32).to_le_bytes()].concat();
    let mut open: BTreeMap<_, _> = (0..CALLS).map(|n| (ask(&client, &payload(n)), payload(n))).collect();
    for _ in 0..CALLS {
        let (id, reply) = next(&replies);
        assert_eq!(open.remove(&id).as_deref(), Some(&reply[..]));
    }
    echo.join().expect("every request was answered");
    quiet(&replies);
}
