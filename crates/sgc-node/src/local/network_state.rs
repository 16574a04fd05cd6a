//! Whether the local network is open, and its discovery after it was opened again.

use std::time::Instant;

use sgc_ros::DiscoveryEvent;

use crate::local::rediscovery::Rediscovery;

/// State of closing the local network and opening it again.
#[derive(Default)]
pub(crate) struct NetworkState {
    is_closed: bool,
    /// Reason of the last failure to open it.
    failed: Option<String>,
    rediscovery: Rediscovery,
    /// Time of the last reopening.
    last: Option<Instant>,
    times: u64,
}

impl NetworkState {
    /// Notes that the network is closed. `rediscovery` knows its endpoints.
    pub(crate) fn closed(&mut self, rediscovery: Rediscovery) {
        self.is_closed = true;
        self.rediscovery = rediscovery;
    }

    /// Notes that the network is open again.
    pub(crate) fn opened(&mut self, now: Instant) {
        self.is_closed = false;
        self.failed = None;
        self.last = Some(now);
        self.times += 1;
        self.rediscovery.opened(now);
    }

    /// Notes the reason why the network could not be opened.
    pub(crate) fn stays_closed(&mut self, reason: String) {
        self.failed = Some(reason);
    }

    /// Returns `true` if the network is closed and not open again yet.
    pub(crate) fn is_closed(&self) -> bool {
        self.is_closed
    }

    /// Returns the reason of the last failure to open the network.
    pub(crate) fn failure(&self) -> Option<&str> {
        self.failed.as_deref()
    }

    /// Returns the time of the last reopening.
    pub(crate) fn reopened_at(&self) -> Option<Instant> {
        self.last
    }

    /// Returns the number of reopenings.
    pub(crate) fn reopenings(&self) -> u64 {
        self.times
    }

    /// Returns a discovery event if it is news. There is none while the network is closed.
    pub(crate) fn news(&mut self, event: DiscoveryEvent) -> Option<DiscoveryEvent> {
        if self.is_closed { None } else { self.rediscovery.news(event) }
    }

    /// Returns the time at which endpoints that are missing are reported as gone.
    pub(crate) fn deadline(&self) -> Option<Instant> {
        self.rediscovery.deadline()
    }

    /// Returns events about endpoints that the new network lacks.
    pub(crate) fn handle_timeout(&mut self, now: Instant) -> Vec<DiscoveryEvent> {
        self.rediscovery.handle_timeout(now)
    }
}
