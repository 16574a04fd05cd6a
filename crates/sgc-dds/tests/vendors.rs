//! Services of [`CycloneNetwork`] with programs of other DDS vendors: the peers of `tests/peers`, which put the
//! identity of requests where rmw_fastrtps and ros2-client do.

#![allow(clippy::unwrap_used)]
#![allow(clippy::print_stderr, reason = "a test that fails tells what its peers said")]

use std::io::{BufRead, BufReader};
use std::path::Path;
use std::process::{Child, Command, Stdio};
use std::sync::mpsc::{Receiver, channel};
use std::time::{Duration, Instant};

use bytes::Bytes;
use serde_json::Value;
use sgc_dds::{CycloneNetwork, DdsConfig, DiscoveryRange, unidentified_messages};
use sgc_ros::{
    EndpointSpec, RequestId, RosClient, RosError, RosNetwork, RosServer, Sample, ServiceSpec, ServiceTopic,
    service_qos,
};

/// Longest wait for an event, far beyond what any takes.
const PATIENCE: Duration = Duration::from_secs(60);

/// Wait for the answer to a request that a server may have answered before it knew the client.
const ANSWER_WAIT: Duration = Duration::from_secs(2);

/// Length of a message of several fragments, in bytes.
const LONG_BYTES: usize = 50_001;

fn open(domain: u32, tag: Option<&str>) -> CycloneNetwork {
    let tag = tag.map(str::to_owned);
    CycloneNetwork::open(&DdsConfig {
        domain,
        discovery: DiscoveryRange::LocalHost,
        tag,
        ..DdsConfig::default()
    })
    .unwrap()
}

fn spec(service: &str, ros_type: &str) -> ServiceSpec {
    let half = |half: ServiceTopic| EndpointSpec {
        topic: half.dds_topic(service),
        type_name: half.dds_type(ros_type),
        keyless: true,
        asks_key_hash: false,
        type_hash: None,
        qos: service_qos(),
    };
    ServiceSpec { request: half(ServiceTopic::Request), reply: half(ServiceTopic::Reply) }
}

fn add() -> ServiceSpec {
    spec("/add", "example_interfaces/srv/AddTwoInts")
}

fn blob() -> ServiceSpec {
    spec("/blob", "sgc_test_msgs/srv/Blob")
}

type CallReceiver = Receiver<(RequestId, Bytes)>;

fn server(
    network: &CycloneNetwork,
    spec: &ServiceSpec,
) -> (<CycloneNetwork as RosNetwork>::Server, CallReceiver) {
    let (tx, rx) = channel();
    let handler = Box::new(move |id, payload| drop(tx.send((id, payload))));
    (network.create_server(spec, handler).unwrap(), rx)
}

fn client(
    network: &CycloneNetwork,
    spec: &ServiceSpec,
) -> (<CycloneNetwork as RosNetwork>::Client, CallReceiver) {
    let (tx, rx) = channel();
    let handler = Box::new(move |id, payload| drop(tx.send((id, payload))));
    (network.create_client(spec, handler).unwrap(), rx)
}

fn next(heard: &CallReceiver) -> (RequestId, Bytes) {
    heard.recv_timeout(PATIENCE).expect("a request or a reply")
}

/// Sends a request once there is a server.
fn ask(client: &<CycloneNetwork as RosNetwork>::Client, payload: &[u8]) -> RequestId {
    let until = Instant::now() + PATIENCE;
    while Instant::now() < until {
        match client.request(Bytes::copy_from_slice(payload)) {
            Err(RosError::NoPeer { .. }) => {}
            asked => return asked.unwrap(),
        }
    }
    panic!("no server was found");
}

/// A peer program, ended with the test.
struct Peer {
    child: Child,
    lines: Receiver<String>,
}

impl Peer {
    fn start(vendor: &str, role: &str, domain: u32, args: &[&str]) -> Self {
        let program = Path::new(env!("CARGO_MANIFEST_DIR")).join("../../.peers").join(vendor);
        assert!(program.exists(), "{} is missing: run `make peers`", program.display());
        let mut child = Command::new(program)
            .args([role, "--domain", &domain.to_string(), "--localhost", "--timeout", "60"])
            .args(args)
            .stdin(Stdio::null())
            .stdout(Stdio::piped())
            .spawn()
            .unwrap();
        let (tx, lines) = channel();
        let stdout = BufReader::new(child.stdout.take().unwrap());
        std::thread::spawn(move || stdout.lines().map_while(Result::ok).for_each(|line| drop(tx.send(line))));
        Self { child, lines }
    }

    /// Returns the peer's first line of this kind.
    fn line(&self, event: &str) -> Value {
        loop {
            let line = self.lines.recv_timeout(PATIENCE).expect(event);
            let line: Value = serde_json::from_str(&line).unwrap();
            if line["event"] == event {
                return line;
            }
        }
    }
}

impl Drop for Peer {
    /// Ends the peer. If the test has failed, prints what the peer said, which often tells why.
    fn drop(&mut self) {
        let _ = self.child.kill();
        let _ = self.child.wait();
        if std::thread::panicking() {
            self.lines.iter().for_each(|line| eprintln!("{line}"));
        }
    }
}

fn i64s(values: &[i64]) -> Vec<u8> {
    let bytes = values.iter().flat_map(|v| v.to_le_bytes());
    [0, 1, 0, 0].into_iter().chain(bytes).collect()
}

fn read_i64s(payload: &[u8]) -> Vec<i64> {
    payload[4..].chunks_exact(8).map(|v| i64::from_le_bytes(v.try_into().unwrap())).collect()
}

fn noise(seq: u64, data: &[u8]) -> Vec<u8> {
    let length = data.len() as u32;
    [&[0, 1, 0, 0][..], &seq.to_le_bytes(), &length.to_le_bytes(), data].concat()
}

fn read_noise(payload: &[u8]) -> (u64, &[u8]) {
    let seq = u64::from_le_bytes(payload[4..12].try_into().unwrap());
    let length = u32::from_le_bytes(payload[12..16].try_into().unwrap()) as usize;
    (seq, &payload[16..16 + length])
}

/// Checks two simultaneous clients of a vendor, whose GUIDs begin with `id`. Each also reads the replies to the other one,
/// so with a history of limited depth, one that gets no time on a busy machine would lose its own.
fn clients_are_answered(vendor: &str, id: [u8; 2], domain: u32) {
    let network = open(domain, Some("arm-1"));
    let (server, requests) = server(&network, &add());
    let peers = ["100", "200"].map(|start| {
        let args = ["--topic", "/add", "--count", "40", "--rate", "0", "--depth", "0", "--start", start];
        Peer::start(vendor, "client", domain, &args)
    });
    for _ in 0..80 {
        let (id_of, payload) = next(&requests);
        let [a, b] = read_i64s(&payload)[..] else { panic!("{payload:?}") };
        assert_eq!(id_of.asker.unwrap().vendor(), id);
        server.reply(&id_of, i64s(&[a + b]).into()).unwrap();
    }
    for peer in &peers {
        assert_answered(&peer.line("summary"), 40);
    }
    assert_eq!(unidentified_messages(), 0);
}

fn servers_are_called(vendor: &str, domain: u32) {
    let network = open(domain, Some("arm-1"));
    let peer = Peer::start(vendor, "server", domain, &["--topic", "/add", "--count", "40"]);
    let (client, replies) = client(&network, &add());
    let mut unanswered = Vec::new();
    let mut answered = 0;
    for n in 0..40 {
        let asked = ask(&client, &i64s(&[n, 7]));
        // A server of RustDDS answers at once, also if it has not yet matched the client's reader, which then hears nothing.
        let patience = if answered == 0 { ANSWER_WAIT } else { PATIENCE };
        loop {
            match replies.recv_timeout(patience) {
                Ok((id, _)) if unanswered.contains(&id) => {}
                Ok((id, reply)) => {
                    assert_eq!((id, read_i64s(&reply)), (asked, vec![n + 7]));
                    answered += 1;
                    break;
                }
                Err(_) => {
                    assert_eq!(answered, 0, "request {n} was not answered");
                    unanswered.push(asked);
                    break;
                }
            }
        }
    }
    assert!(answered > 0, "no request was answered");
    assert_eq!(peer.line("summary")["served"], 40);
}

fn assert_answered(summary: &Value, count: u64) {
    assert_eq!(
        (&summary["sent"], &summary["answered"], &summary["wrong"]),
        (&count.into(), &count.into(), &0.into())
    );
}

#[test]
fn fast_dds_clients_are_answered() {
    clients_are_answered("fastdds", [0x01, 0x0f], 130);
}

#[test]
fn fast_dds_servers_are_called() {
    servers_are_called("fastdds", 131);
}

#[test]
fn rustdds_clients_are_answered() {
    clients_are_answered("rustdds", [0x01, 0x12], 134);
}

#[test]
fn rustdds_servers_are_called() {
    servers_are_called("rustdds", 135);
}

#[test]
fn messages_of_many_fragments_keep_their_identity() {
    let network = open(132, Some("arm-1"));
    let (server, requests) = server(&network, &blob());
    let size = LONG_BYTES.to_string();
    let args = ["--topic", "/blob", "--type", "blob", "--size", &size, "--count", "5", "--rate", "0"];
    let asker = Peer::start("fastdds", "client", 132, &args);
    for _ in 0..5 {
        let (id, payload) = next(&requests);
        let (seq, data) = read_noise(&payload);
        assert_eq!(data.len(), LONG_BYTES);
        let reversed: Vec<u8> = data.iter().rev().copied().collect();
        server.reply(&id, noise(!seq, &reversed).into()).unwrap();
    }
    assert_answered(&asker.line("summary"), 5);
    drop((server, asker));

    let _peer = Peer::start("fastdds", "server", 132, &["--topic", "/blob", "--type", "blob"]);
    let (client, replies) = client(&network, &blob());
    for seq in 0..5 {
        let data = vec![seq as u8; LONG_BYTES];
        let asked = ask(&client, &noise(seq, &data));
        let (id, reply) = next(&replies);
        assert_eq!((id, read_noise(&reply)), (asked, (!seq, &data[..])));
    }
}

/// Each client gets the replies to its own requests, in its own mapping. A Cyclone reader does not see replies in the
/// other one, whose first bytes it would take for an id.
#[test]
fn clients_of_both_kinds_share_a_server() {
    let (ros, sgc) = (open(133, None), open(133, Some("arm-1")));
    let (server, requests) = server(&sgc, &add());
    let (cyclone, replies) = client(&ros, &add());
    let (tx, seen) = channel();
    let on_reply = Box::new(move |sample: Sample| drop(tx.send(sample.payload)));
    let reader = ros.create_reader(&add().reply, on_reply).unwrap();
    let fast = Peer::start("fastdds", "client", 133, &["--topic", "/add", "--count", "30", "--rate", "50"]);
    let mut asked = Vec::new();
    let mut answered = 0;
    while answered < 60 {
        // Both kinds send the same number of requests, so that they run at the same time.
        if asked.len() < 30 && asked.len() * 2 <= answered {
            asked.push(ask(&cyclone, &i64s(&[asked.len() as i64, -1])));
        }
        let (id, payload) = next(&requests);
        let [a, b] = read_i64s(&payload)[..] else { panic!("{payload:?}") };
        server.reply(&id, i64s(&[a + b]).into()).unwrap();
        answered += 1;
    }
    for (n, asked) in asked.iter().enumerate() {
        let (id, reply) = next(&replies);
        assert_eq!((&id, read_i64s(&reply)), (asked, vec![n as i64 - 1]));
    }
    assert_answered(&fast.line("summary"), 30);
    // This request is behind all others, so earlier replies have arrived.
    ask(&cyclone, &i64s(&[5, 6]));
    let (id, _) = next(&requests);
    server.reply(&id, i64s(&[11]).into()).unwrap();
    for _ in 0..31 {
        let reply = seen.recv_timeout(PATIENCE).expect("a reply");
        assert_eq!(reply.len(), 4 + 16 + 8);
    }
    drop(reader);
    assert_eq!(seen.iter().count(), 0);
}
