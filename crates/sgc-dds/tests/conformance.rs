//! [`CycloneNetwork`] behaves as every network does, between participants that talk over the loopback interface.

use std::sync::atomic::{AtomicU32, Ordering};

use sgc_dds::{CycloneNetwork, DdsConfig, DiscoveryRange};
use sgc_testkit::conformance::rig::padded;
use sgc_testkit::conformance::{Site, common_qos};
use sgc_wire::{Qos, Representations};

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

    fn received(payload: &[u8]) -> Vec<u8> {
        padded(payload)
    }

    fn told_qos() -> Qos {
        let partitions = vec!["left".into(), "right".into()];
        Qos { partitions, representations: Representations::XCDR2, ..common_qos() }
    }
}

sgc_testkit::conformance_tests!(Domain);
