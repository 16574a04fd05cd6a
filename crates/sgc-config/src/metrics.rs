//! The `[metrics]` table.

use std::net::{Ipv4Addr, SocketAddr};

/// The port at which exporters for Prometheus usually listen, as the specification of OpenTelemetry has it
/// (`OTEL_EXPORTER_PROMETHEUS_PORT`).
const METRICS_PORT: u16 = 9464;

/// An HTTP server with the metrics and the health of the node.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct MetricsConfig {
    /// The listening address; port 0 lets the system choose.
    pub listen: SocketAddr,
}

impl MetricsConfig {
    /// Returns warnings for the operator, one sentence each.
    pub fn warnings(&self) -> Vec<String> {
        let Self { listen } = self;
        if listen.ip().to_canonical().is_loopback() {
            return Vec::new();
        }
        vec![format!(
            "metrics: http://{listen} is neither encrypted nor protected: whoever reaches it learns the names of topics, nodes \
             and routers, and how much flows. Let only the host of Prometheus in, by a firewall"
        )]
    }
}

impl Default for MetricsConfig {
    fn default() -> Self {
        Self { listen: (Ipv4Addr::LOCALHOST, METRICS_PORT).into() }
    }
}
