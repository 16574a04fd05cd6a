//! The measured figures, one number a row, so that every table, plot and goal derives from the same file.

use serde::{Deserialize, Serialize};

/// One number.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub(crate) struct Figure {
    /// The table that it belongs to: `round-trip`, `throughput`, `real-ros2`, `rmw-zenoh` and those that begin so,
    /// `start-up`, `applications`, `fleet-step`, `fan-out`, `multi-hop`, `teleop`, `roaming`, `footprint`.
    pub(crate) table: String,
    /// The measured system: `direct`, `wireguard`, `dds-security`, `zenoh-tcp`, `zenoh-tls`, `sgc-quic-group`,
    /// `sgc-dtls-standard`, …; `sgc-quic-group-router` with a router process between the proxies; `ssh`; `tcp`.
    pub(crate) system: String,
    /// Over which path: `bare`, `paper` (76 ms round trip, 5 Mbit/s), `lossy` (40 ms, 50 Mbit/s, 2 %), `jazzy-kilted`
    /// and `kilted-jazzy` over `bare` between programs of these distributions, or what a table says.
    pub(crate) path: String,
    /// At what: bytes of a message, messages a second, sinks, routers, records, runs, by the table.
    pub(crate) at: f64,
    /// The metric, with its unit last: `p50_us`, `p99_us`, `max_us`, `per_second`, `cpu_us_per_message`,
    /// `rss_bytes`, `lost`, …
    pub(crate) metric: String,
    /// The number.
    pub(crate) value: f64,
}

/// All that a run measured, in the order in which it was.
#[derive(Clone, Debug, Default, Serialize, Deserialize)]
pub(crate) struct Figures {
    /// The numbers.
    pub(crate) figures: Vec<Figure>,
    /// Measurements that were impossible here, with the reasons, which the report shows.
    pub(crate) left_out: Vec<String>,
}

impl Figures {
    /// Adds a number.
    pub(crate) fn push(&mut self, table: &str, system: &str, path: &str, at: f64, metric: &str, value: f64) {
        self.figures.push(Figure {
            table: table.into(),
            system: system.into(),
            path: path.into(),
            at,
            metric: metric.into(),
            value,
        });
    }

    /// Adds all of others.
    pub(crate) fn append(&mut self, others: Self) {
        self.figures.extend(others.figures);
        self.left_out.extend(others.left_out);
    }

    /// Says that something is missing.
    pub(crate) fn leave_out(&mut self, what: &str, why: impl std::fmt::Display) {
        self.left_out.push(format!("{what}: {why}"));
    }

    /// A number, if it was measured.
    pub(crate) fn value(&self, table: &str, system: &str, path: &str, at: f64, metric: &str) -> Option<f64> {
        let is_it = |f: &&Figure| {
            (&*f.table, &*f.system, &*f.path, f.at, &*f.metric) == (table, system, path, at, metric)
        };
        self.figures.iter().rev().find(is_it).map(|f| f.value)
    }
}
