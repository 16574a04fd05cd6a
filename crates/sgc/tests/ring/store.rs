//! The store of names of the routers as processes: a cluster in a namespace of its own, with a cable to each router.

use std::collections::BTreeSet;
use std::path::Path;
use std::sync::Arc;

use sgc_testkit::netsim::Namespace;
use sgc_testkit::redis::{Redis, RedisOptions, is_redis_installed};

use crate::graph::{End, Node};
use crate::store_faults::{SERVERS, StoreFault};

/// The network of the servers' addresses.
const NETWORK: &str = "10.93.0.0/24";
/// The interface of a router's cable, at the router.
const INTERFACE: &str = "store";
/// Keys of names, under the prefix that routers have without another one.
const NAMES: &str = "sgc:n:*";
/// Servers that routers know from their configuration.
const SEEDS: usize = 2;

pub(crate) struct Store {
    redis: Redis,
    namespace: Arc<Namespace>,
}

impl Store {
    /// Starts the servers, and lays a cable to each router's namespace.
    pub(crate) fn start<'a>(
        name: String,
        folder: &Path,
        routers: impl IntoIterator<Item = (Node, &'a Namespace)>,
    ) -> Self {
        assert!(is_redis_installed(), "no redis-server: scripts/install-deps.sh test");
        let namespace = Arc::new(Namespace::create(name).unwrap());
        let hosts: Vec<_> = (1..=SERVERS).map(|number| format!("10.93.0.{number}")).collect();
        for host in &hosts {
            namespace.ip(&["address", "add", &format!("{host}/32"), "dev", "lo"]).unwrap();
        }
        for (router, of_router) in routers {
            let [ours, theirs] = [1, 2].map(|end| format!("10.93.{}.{end}/24", router.0 + 1));
            namespace.veth((&cable(router), &[&ours]), of_router, (INTERFACE, &[&theirs])).unwrap();
            set_route(of_router);
        }
        // As docs/how-to/store-of-names.md advises.
        let settings = ["--cluster-require-full-coverage", "no"].map(str::to_owned).to_vec();
        let options = RedisOptions { settings, ..RedisOptions::default() };
        let hosts: Vec<_> = hosts.iter().map(String::as_str).collect();
        let redis = Redis::cluster(namespace.clone(), folder, &hosts, options);
        Self { redis, namespace }
    }

    /// Returns the keys of a router's configuration.
    pub(crate) fn config(&self) -> String {
        format!("mapping = \"store\"\nstore = {:?}\n", &self.redis.urls()[..SEEDS])
    }

    /// Breaks servers or cables. `routers` has the namespace of each router at its number.
    pub(crate) fn inflict(&mut self, fault: &StoreFault, routers: &[Namespace]) {
        match fault {
            StoreFault::Kill { servers } => servers.iter().for_each(|server| self.redis.kill(*server)),
            StoreFault::Stop { server } => self.redis.freeze(*server),
            StoreFault::Cut { routers: cut, end } => {
                cut.iter().for_each(|router| self.set_cable(*router, *end, routers, "down"));
            }
        }
    }

    /// Ends what [`Self::inflict`] did.
    pub(crate) fn mend(&mut self, fault: &StoreFault, routers: &[Namespace]) {
        match fault {
            StoreFault::Kill { servers } => servers.iter().for_each(|server| self.redis.restart(*server)),
            StoreFault::Stop { server } => self.redis.thaw(*server),
            StoreFault::Cut { routers: cut, end } => {
                cut.iter().for_each(|router| self.set_cable(*router, *end, routers, "up"));
            }
        }
    }

    fn set_cable(&self, router: Node, end: End, routers: &[Namespace], state: &str) {
        match end {
            End::Listening => drop(self.namespace.ip(&["link", "set", &cable(router), state]).unwrap()),
            End::Dialling => {
                routers[router.0].ip(&["link", "set", INTERFACE, state]).unwrap();
                // The kernel removes the route with the interface.
                if state == "up" {
                    set_route(&routers[router.0]);
                }
            }
        }
    }

    /// Returns the names that the servers have. Waits for servers that are stopped.
    pub(crate) fn names(&self) -> BTreeSet<String> {
        self.redis.keys(NAMES)
    }
}

/// Leads packets for the servers over the cable, in a router's namespace.
fn set_route(router: &Namespace) {
    router.ip(&["route", "replace", NETWORK, "dev", INTERFACE]).unwrap();
}

/// The name of a router's cable at the store.
fn cable(router: Node) -> String {
    format!("cable{}", router.0)
}
