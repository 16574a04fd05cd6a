//! [`ZenohNetwork`] behaves as every network does, between sessions that a router on the loopback interface connects.

mod support;

use sgc_testkit::conformance::Site;
use sgc_zenoh_network::ZenohNetwork;

use crate::support::{Router, open};

impl Site for Router {
    type Network = ZenohNetwork;

    // Zenoh itself matches by keys alone; the count is that of tokens, which SGC marks.
    const PROXIES_MATCH: bool = false;

    fn new() -> Self {
        Self::start()
    }

    fn open(&self, tag: Option<&str>) -> ZenohNetwork {
        open(&self.endpoint, tag.is_some())
    }
}

sgc_testkit::conformance_tests!(Router);
