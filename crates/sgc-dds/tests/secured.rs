//! [`CycloneNetwork`] in a network that DDS Security protects: several participants of one process, with a keystore in
//! SROS2's layout that `tests/peers/keystore.sh` makes.

#![cfg(feature = "sros2")]
#![allow(clippy::unwrap_used)]

use std::path::{Path, PathBuf};
use std::process::Command;
use std::sync::mpsc::{Receiver, channel};
use std::time::Duration;

use bytes::Bytes;
use sgc_dds::{CycloneNetwork, DdsConfig, DiscoveryRange, Security};
use sgc_ros::{
    DiscoveryEvent, EndpointKind, EndpointSpec, RosError, RosNetwork, RosWriter, Sample, SampleHead,
    SampleKind,
};
use sgc_wire::{History, Qos, Reliability};
use tempfile::TempDir;

/// Longest wait for an event, far beyond what any takes.
const PATIENCE: Duration = Duration::from_secs(60);

const DOMAIN: u32 = 219;

/// Returns a keystore with the enclaves `/one` and `/two`, of which the first may use the partition of shown
/// endpoints.
fn keystore() -> TempDir {
    let directory = tempfile::tempdir().unwrap();
    let script = Path::new(env!("CARGO_MANIFEST_DIR")).join("../../tests/peers/keystore.sh");
    for (enclave, partition) in [("/one", "sgc/shown"), ("/two", "")] {
        let mut command = Command::new(&script);
        command.arg(directory.path()).args([enclave, "rt/chatter"]).env("PARTITION", partition);
        let made = command.output().unwrap();
        assert!(made.status.success(), "{}", String::from_utf8_lossy(&made.stderr));
    }
    directory
}

fn open(keystore: &TempDir, enclave: &str, tag: Option<&str>) -> CycloneNetwork {
    let security = Security { keystore: PathBuf::from(keystore.path()), enclave: enclave.to_owned() };
    let config = DdsConfig {
        domain: DOMAIN,
        discovery: DiscoveryRange::LocalHost,
        tag: tag.map(str::to_owned),
        security: Some(security),
        ..DdsConfig::default()
    };
    CycloneNetwork::open(&config).unwrap()
}

fn spec() -> EndpointSpec {
    let (history, reliability) = (History::KeepLast(1), Reliability::Reliable);
    EndpointSpec {
        topic: "rt/chatter".into(),
        type_name: "std_msgs::msg::dds_::String_".into(),
        keyless: true,
        asks_key_hash: false,
        type_hash: None,
        qos: Qos { history, reliability, ..Qos::default() },
    }
}

fn next<T>(receiver: &Receiver<T>) -> T {
    receiver.recv_timeout(PATIENCE).unwrap()
}

#[test]
fn several_participants_of_one_process_are_secured() {
    let keystore = keystore();
    let (one, two) = (open(&keystore, "/one", Some("arm-1")), open(&keystore, "/two", None));
    let (tx, seen) = channel();
    two.discover(Box::new(move |event| drop(tx.send(event)))).unwrap();

    // This endpoint is only shown.
    let shown = one.show(EndpointKind::Reader, &spec()).unwrap();
    let found = loop {
        if let DiscoveryEvent::Appeared(endpoint) = next(&seen) {
            break endpoint;
        }
    };
    assert_eq!((found.guid, found.qos.partitions), (shown.guid, vec!["sgc/shown".to_owned()]));
    let refused = two.show(EndpointKind::Reader, &spec()).unwrap_err();
    assert!(
        matches!(&refused, RosError::ForbiddenPartition { file, .. } if file.ends_with("/two/permissions.p7s")),
        "{refused}"
    );

    // Data flows from and to the network whose Cyclone domain has another number.
    for (from, to) in [(&two, &one), (&one, &two)] {
        let (tx, samples) = channel();
        let _reader =
            to.create_reader(&spec(), Box::new(move |sample: Sample| drop(tx.send(sample)))).unwrap();
        let writer = from.create_writer(&spec()).unwrap();
        let begun = std::time::Instant::now();
        while writer.matched_readers() == 0 {
            assert!(begun.elapsed() < PATIENCE, "they never match");
            std::thread::sleep(Duration::from_millis(2));
        }
        let payload = Bytes::from_static(&[0, 1, 0, 0, 2, 0, 0, 0, b'x', 0, 0, 0]);
        writer.write_ahead(SampleHead::new(SampleKind::Write, 1_000_000_000), payload.clone()).unwrap();
        writer.flush();
        assert_eq!(next(&samples).payload[4..10], payload[4..10]);
    }

    // The permissions name the ROS domain, not Cyclone's, and grant one topic.
    let other = EndpointSpec { topic: "rt/other".into(), ..spec() };
    for network in [&one, &two] {
        let error = network.create_writer(&other).err().unwrap().to_string();
        assert!(error.contains("permissions.p7s does not grant rt/other to enclave"), "{error}");
    }
}
