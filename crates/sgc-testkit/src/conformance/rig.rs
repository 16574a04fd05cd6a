//! Readers, writers and waits of tests of a [`RosNetwork`].

use std::sync::mpsc::{Receiver, RecvTimeoutError, channel};
use std::time::{Duration, Instant};

use bytes::Bytes;
use sgc_ros::{DiscoveryEvent, EndpointSpec, RosNetwork, RosWriter, Sample, SampleHead, SampleKind};
use sgc_wire::Qos;

/// Longest wait for an event, far beyond what any takes.
pub const PATIENCE: Duration = Duration::from_secs(30);
/// Time for which nothing must happen. Wrong events would come within milliseconds.
pub const QUIET: Duration = Duration::from_millis(300);
/// The hash of `std_msgs/msg/String`.
pub const HASH: &str = "RIHS01_df668c740482bbd48fb39d76a70dfd4bd59db1288021743503259e948f6b1a18";

/// Returns the spec of an endpoint for strings.
pub fn spec(topic: &str) -> EndpointSpec {
    EndpointSpec {
        topic: format!("rt/{topic}"),
        type_name: "std_msgs::msg::dds_::String_".into(),
        keyless: true,
        asks_key_hash: false,
        type_hash: Some(HASH.into()),
        qos: Qos::default(),
    }
}

/// Changes the QoS of a spec.
pub fn with(mut spec: EndpointSpec, change: impl FnOnce(&mut Qos)) -> EndpointSpec {
    change(&mut spec.qos);
    spec
}

/// A `std_msgs/String` as CDR, little endian, unpadded.
pub fn string_cdr(text: &str) -> Bytes {
    let mut payload = vec![0, 1, 0, 0];
    payload.extend((text.len() as u32 + 1).to_le_bytes());
    payload.extend(text.as_bytes());
    payload.push(0);
    payload.into()
}

/// Returns a payload as a reader of DDS gets it: with zeros up to a multiple of four, and their number in the pad bits.
pub fn padded(payload: &[u8]) -> Vec<u8> {
    let mut payload = payload.to_vec();
    let pad = payload.len().wrapping_neg() % 4;
    payload[3] = (payload[3] & !3) | pad as u8;
    payload.resize(payload.len() + pad, 0);
    payload
}

/// Creates a reader whose samples arrive at the receiver.
pub fn read<N: RosNetwork>(network: &N, spec: &EndpointSpec) -> (N::Reader, Receiver<Sample>) {
    let (tx, rx) = channel();
    let handler = Box::new(move |sample: Sample| drop(tx.send(sample)));
    (network.create_reader(spec, handler).expect("a reader"), rx)
}

/// Returns a writer that matches this many readers.
pub fn writer<N: RosNetwork>(network: &N, spec: &EndpointSpec, readers: u32) -> N::Writer {
    let writer = network.create_writer(spec).expect("a writer");
    matched(&writer, readers);
    writer
}

/// Waits until a writer matches this many readers.
pub fn matched(writer: &impl RosWriter, readers: u32) {
    eventually("the readers match", || writer.matched_readers() == readers);
}

/// Waits until something is so.
pub fn eventually(what: &str, mut done: impl FnMut() -> bool) {
    let deadline = Instant::now() + PATIENCE;
    while !done() {
        assert!(Instant::now() < deadline, "waited in vain: {what}");
        std::thread::sleep(Duration::from_millis(2));
    }
}

/// Writes a payload, and flushes.
pub fn write(writer: &impl RosWriter, payload: &Bytes) {
    // Writers send no key hash on a topic without keys.
    let head = SampleHead { key_hash: Some([1; 16]), ..SampleHead::new(SampleKind::Write, 1_000_000_000) };
    writer.write_ahead(head, payload.clone()).expect("the sample is taken");
    writer.flush();
}

/// Waits for the next event.
pub fn next<T>(events: &Receiver<T>) -> T {
    events.recv_timeout(PATIENCE).expect("an event")
}

/// Panics if an event comes within [`QUIET`].
pub fn quiet<T: std::fmt::Debug>(events: &Receiver<T>) {
    match events.recv_timeout(QUIET) {
        Err(RecvTimeoutError::Timeout) => {}
        other => panic!("nothing was to happen: {other:?}"),
    }
}

/// Starts discovery, whose events arrive at the receiver.
pub fn discover(network: &impl RosNetwork) -> Receiver<DiscoveryEvent> {
    let (tx, rx) = channel();
    let handler = Box::new(move |event| drop(tx.send(event)));
    network.discover(handler).expect("discovery");
    rx
}
