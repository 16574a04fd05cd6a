//! The number of allocations in Rust for a sample: one where it is received, for the reference to it, and none where
//! it is written. Allocations of Cyclone in C are not counted.
#![allow(clippy::unwrap_used)]

use std::sync::mpsc::{Sender, channel};
use std::time::{Duration, Instant};

use bytes::Bytes;
use sgc_dds::{CycloneNetwork, DdsConfig, DiscoveryRange};
use sgc_ros::{EndpointSpec, HandleSamples, RosNetwork as _, RosWriter as _, Sample, SampleKind};
use sgc_testkit::{CountingAllocator, allocated_since_last, allocations};
use sgc_wire::Qos;

#[global_allocator]
static COUNTING: CountingAllocator = CountingAllocator;

const DOMAIN: u32 = 99;
const PATIENCE: Duration = Duration::from_secs(30);
/// Allows for the lookup of the first sample's writer.
const WARM_UP: usize = 100;
const SAMPLES: usize = 1000;

fn open() -> CycloneNetwork {
    let config = DdsConfig { domain: DOMAIN, discovery: DiscoveryRange::LocalHost, ..DdsConfig::default() };
    CycloneNetwork::open(&config).unwrap()
}

/// A handler that reports the allocations of the receiving thread and of the workers since the sample before, including
/// blocks of the channel itself.
struct Tells {
    /// The receiving thread's count.
    receiving: usize,
    tell: Sender<usize>,
}

impl HandleSamples for Tells {
    fn handle(&mut self, _: Sample) {
        let _ = self.tell.send(std::mem::take(&mut self.receiving) + allocated_since_last().count);
    }

    fn handle_at_once(&mut self, sample: Sample) -> Option<Sample> {
        self.receiving += allocated_since_last().count;
        Some(sample)
    }
}

#[test]
fn a_sample_is_one_allocation_where_it_is_taken_and_none_where_it_is_written() {
    let spec = EndpointSpec {
        topic: "rt/allocations".into(),
        type_name: "std_msgs::msg::dds_::ByteMultiArray_".into(),
        keyless: true,
        asks_key_hash: false,
        type_hash: None,
        qos: Qos::default(),
    };
    let (near, far) = (open(), open());
    let (tell, told) = channel();
    let _reader = far.create_reader(&spec, Box::new(Tells { receiving: 0, tell })).unwrap();
    let writer = near.create_writer(&spec).unwrap();
    let deadline = Instant::now() + PATIENCE;
    while writer.matched_readers() == 0 {
        assert!(Instant::now() < deadline, "the reader does not match");
        std::thread::sleep(Duration::from_millis(2));
    }
    let payload = Bytes::from([&[0, 1, 0, 0][..], &[7; 1000]].concat());
    let (mut counts, mut written) = (Vec::new(), 0);
    for n in 0..WARM_UP + SAMPLES {
        let payload = payload.clone();
        let (taken, result) = allocations(|| writer.write(SampleKind::Write, 1_000_000_000, payload));
        result.unwrap();
        counts.push(told.recv_timeout(PATIENCE).expect("the sample arrives"));
        if n >= WARM_UP {
            written += taken.count;
        }
    }
    assert_eq!(written, 0);
    let taken: usize = counts[WARM_UP..].iter().sum();
    assert!(taken >= SAMPLES, "the allocator counts");
    assert!(taken <= SAMPLES + SAMPLES / 16, "{taken} for {SAMPLES} samples");
}
