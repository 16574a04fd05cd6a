//! The network in memory behaves as every network does.

use sgc_testkit::conformance::Site;
use sgc_testkit::{FakeDomain, FakeRos};

struct Memory(FakeDomain);

impl Site for Memory {
    type Network = FakeRos;

    const PROXIES_MATCH: bool = false;

    fn new() -> Self {
        Self(FakeDomain::default())
    }

    fn open(&self, tag: Option<&str>) -> FakeRos {
        self.0.join(tag.is_some())
    }
}

sgc_testkit::conformance_tests!(Memory);
