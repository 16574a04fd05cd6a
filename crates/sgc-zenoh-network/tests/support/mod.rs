//! A router of Zenoh, and networks that meet at it.

#![allow(dead_code, reason = "each test program uses a part")]

use std::net::TcpListener;

use sgc_zenoh_network::{ZenohConfig, ZenohNetwork};
use zenoh::{Session, Wait as _};

/// Returns an endpoint with a port that is free now.
pub(crate) fn free_endpoint() -> String {
    let port = TcpListener::bind("127.0.0.1:0").and_then(|listener| listener.local_addr());
    format!("tcp/127.0.0.1:{}", port.expect("a port").port())
}

/// Opens a session in a mode, which listens or connects at an endpoint.
pub(crate) fn session(mode: &str, at: &str, endpoint: &str) -> zenoh::Result<Session> {
    let mut config = zenoh::Config::default();
    for (key, value) in [
        ("mode", format!("\"{mode}\"")),
        (at, format!("[\"{endpoint}\"]")),
        ("scouting/multicast/enabled", "false".to_owned()),
    ] {
        config.insert_json5(key, &value)?;
    }
    zenoh::open(config).wait()
}

/// A router of its own. Its sessions are peers, as programs of rmw_zenoh are.
pub(crate) struct Router {
    /// Its endpoint.
    pub(crate) endpoint: String,
    _session: Session,
}

impl Router {
    /// Starts a router at a free port.
    pub(crate) fn start() -> Self {
        // Another program may take the port before the router listens.
        for _ in 0..10 {
            let endpoint = free_endpoint();
            if let Ok(session) = session("router", "listen/endpoints", &endpoint) {
                return Self { endpoint, _session: session };
            }
        }
        panic!("no port for a router");
    }
}

/// Returns the settings of a proxy's network at a router, or of a program's.
pub(crate) fn config(endpoint: &str, is_proxy: bool) -> ZenohConfig {
    ZenohConfig { router: Some(endpoint.to_owned()), is_proxy, graph: true, ..ZenohConfig::default() }
}

/// Opens the network of a proxy at a router, or that of a program.
pub(crate) fn open(endpoint: &str, is_proxy: bool) -> ZenohNetwork {
    ZenohNetwork::open(&config(endpoint, is_proxy)).expect("a network")
}
