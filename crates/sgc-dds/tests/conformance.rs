//! [`CycloneNetwork`] behaves as every network does, between participants that talk over the loopback interface.

use std::sync::atomic::{AtomicU32, Ordering};

use sgc_dds::{CycloneNetwork, DdsConfig, DiscoveryRange};
use sgc_testkit::conformance::Site;
use sgc_wire::{Durability, History, Liveliness, Qos, Reliability, Representations};

/// ROS domains of these tests, which run side by side: from here on, each its own.
static NEXT_DOMAIN: AtomicU32 = AtomicU32::new(30);

/// A ROS domain. Each network is its own Cyclone domain, so everything crosses sockets.
struct Domain(u32);

impl Domain {
    fn open_as(&self, tag: Option<&str>, graph: bool) -> CycloneNetwork {
        let config = DdsConfig {
            domain: self.0,
            discovery: DiscoveryRange::LocalHost,
            tag: tag.map(str::to_owned),
            graph,
            ..DdsConfig::default()
        };
        CycloneNetwork::open(&config).expect("a network")
    }
}

impl Site for Domain {
    type Network = CycloneNetwork;

    const PROXIES_MATCH: bool = true;

    fn new() -> Self {
        Self(NEXT_DOMAIN.fetch_add(1, Ordering::Relaxed))
    }

    fn open(&self, tag: Option<&str>) -> CycloneNetwork {
        self.open_as(tag, false)
    }

    fn open_with_graph(&self, tag: Option<&str>) -> CycloneNetwork {
        self.open_as(tag, true)
    }

    /// With zeros up to a multiple of four, and their number in the pad bits.
    fn received(payload: &[u8]) -> Vec<u8> {
        let mut payload = payload.to_vec();
        let pad = payload.len().wrapping_neg() % 4;
        payload[3] = (payload[3] & !3) | pad as u8;
        payload.resize(payload.len() + pad, 0);
        payload
    }

    fn told_qos() -> Qos {
        Qos {
            reliability: Reliability::Reliable,
            durability: Durability::TransientLocal,
            history: History::KeepLast(70),
            deadline_ns: Some(1_500_000_000),
            lifespan_ns: Some(60_000_000_000),
            liveliness: Liveliness::ManualByTopic,
            lease_ns: Some(2_000_000_000),
            partitions: vec!["left".into(), "right".into()],
            representations: Representations::XCDR2,
        }
    }
}

sgc_testkit::conformance_tests!(Domain);
