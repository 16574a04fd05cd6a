//! A started system with a program at each site, and the plan by which it is measured.

use std::time::Duration;

use anyhow::Result;

/// Two programs that exchange messages through a system, until they are dropped.
pub(super) trait Pair {
    /// Sends messages of this size, one at a time. Returns the round trips, µs.
    fn round_trips(&mut self, size: usize, plan: &Plan) -> Result<Vec<f64>>;

    /// Sends from the left site to the right one, as fast as it goes. Returns the bytes of content that arrived in a
    /// second.
    fn throughput(&mut self, plan: &Plan) -> Result<f64>;
}

/// How long a system took to start. Absent where there is nothing to wait for.
#[derive(Clone, Copy, Debug, Default)]
pub(super) struct Start {
    /// From the start of the second site's program to the first message there and back, ms.
    pub(super) first_ms: Option<f64>,
    /// From the start of the second site's program until data takes the direct path, ms.
    pub(super) direct_ms: Option<f64>,
    /// The same from the moment at which the two know of each other: the first grant of SGC, the call that connects of
    /// iroh, both interfaces being up of WireGuard; ms.
    pub(super) known_to_direct_ms: Option<f64>,
}

/// The size of a measurement.
#[derive(Clone, Copy, Debug)]
pub(super) struct Plan {
    /// Most counted round trips of a size.
    pub(super) count: usize,
    /// Time after which no further one begins.
    pub(super) seconds: f64,
    /// Uncounted round trips before.
    pub(super) warm_up: usize,
    /// Duration of a transfer.
    pub(super) flow_seconds: f64,
    /// Duration of the transfer before, which does not count.
    pub(super) flow_warm_up_seconds: f64,
}

impl Plan {
    /// Returns the longest time that a measurement takes, waits excluded.
    pub(super) fn most(&self) -> Duration {
        Duration::from_secs_f64(self.seconds.max(self.flow_seconds + self.flow_warm_up_seconds)) + SPARE
    }
}

/// How much longer than planned an answer is waited for.
const SPARE: Duration = Duration::from_secs(20);
/// How long a system may take until the first message has arrived and the path is direct.
pub(super) const START_MAX: Duration = Duration::from_secs(60);

/// Returns a duration in milliseconds.
pub(super) fn ms(duration: Duration) -> f64 {
    duration.as_secs_f64() * 1e3
}
