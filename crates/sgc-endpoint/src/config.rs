//! Parameters of an endpoint.

use std::sync::Arc;
use std::time::Duration;

use sgc_trust::Identity;

/// Bounds and timers of an endpoint.
#[derive(Clone, Debug)]
pub struct Limits {
    /// Shared interfaces.
    pub shares_max: usize,
    /// Sinks granted per name.
    pub sinks_per_name_max: usize,
    /// Sinks of one node granted per name.
    pub sinks_per_peer_max: usize,
    /// Lifetime of an advertisement; it is renewed after a third of it.
    pub lease: Duration,
    /// Lifetime of an epoch if nothing ends it earlier.
    pub rotate_every: Duration,
    /// Time that a new epoch waits for sinks that have not acknowledged its key.
    pub rotate_wait: Duration,
}

impl Default for Limits {
    fn default() -> Self {
        Self {
            shares_max: 1024,
            sinks_per_name_max: 4096,
            sinks_per_peer_max: 16,
            lease: Duration::from_secs(300),
            rotate_every: Duration::from_secs(3600),
            rotate_wait: Duration::from_secs(1),
        }
    }
}

/// Parameters of an endpoint.
#[derive(Clone, Debug)]
pub struct EndpointConfig {
    /// This node's identity.
    pub identity: Arc<Identity>,
    /// Whether this node gives members their certificates.
    pub authority: bool,
    /// Whether this authority carries out operations for operators.
    pub operations: bool,
    /// Bounds and timers.
    pub limits: Limits,
}
