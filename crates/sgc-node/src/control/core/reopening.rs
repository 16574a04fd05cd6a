//! Closing and reopening the local network: endpoints end with the old network and are created again on the new one.
//!
//! Routes, sources, sinks and calls stay, so other nodes notice only a pause.

use sgc_ros::{DiscoveryEvent, RosNetwork};
use tracing::debug;

use super::{Core, drop_elsewhere};
use crate::clock::now;
use crate::data::calls::Calls;
use crate::local::rediscovery::Rediscovery;

impl<N: RosNetwork> Core<N> {
    /// Ends all endpoints of the local network, which the caller has taken.
    pub(super) fn close_network(&mut self) {
        let (endpoints, participants) = match &self.routes {
            Some(routes) => {
                (routes.local_endpoints().cloned().collect(), routes.local_participants().collect())
            }
            None => (Vec::new(), Vec::new()),
        };
        self.reopening.closed(Rediscovery::new(endpoints, participants));
        let mut ending = self.ends.take_readers();
        for ((name, source), _) in self.ends.writers() {
            if let Some(sink) = self.sinks.get(&name) {
                sink.set_writer(source, None, &self.data);
            }
        }
        ending.extend(self.services.take_ends());
        ending.extend(self.consumers.take_shown());
        self.local_taps.drain(..).for_each(|tap| tap.close());
        self.graph.endpoints_gone();
        drop_elsewhere(Box::new(ending));
    }

    /// Creates the endpoints of the old network on the new one.
    pub(super) fn network_reopened(&mut self) {
        let now = now().instant;
        self.reopening.opened(now);
        self.newcomers.reopened(now);
        self.graph.endpoints_gone();
        let (readers, writers) = (self.ends.readers(), self.ends.writers());
        let services = self.services.ends();
        debug!(
            readers = readers.len(),
            writers = writers.len(),
            services = services.len(),
            "the local network is open again"
        );
        for (name, spec) in readers {
            self.open_reader(name, spec);
        }
        for ((name, source), spec) in writers {
            self.open_writer(name, source, spec);
        }
        for (name, spec) in services {
            match self.services.get(&name) {
                Some(Calls::LocalService(_)) => self.open_client(name, spec),
                Some(Calls::FarService(_)) => self.open_server(name, spec),
                None => {}
            }
        }
        self.consumers.show_soon(now);
    }

    /// Handles a discovery event, unless the network is closed.
    pub(super) fn discovered(&mut self, event: DiscoveryEvent) {
        if let Some(event) = self.reopening.news(event) {
            self.handle_discovery(event);
        }
    }

    /// Reports endpoints that the new network lacks as gone.
    pub(super) fn rediscovery_due(&mut self, now: std::time::Instant) {
        for event in self.reopening.handle_timeout(now) {
            self.handle_discovery(event);
        }
    }

    fn handle_discovery(&mut self, event: DiscoveryEvent) {
        self.newcomers.note(now().instant, &event);
        if let DiscoveryEvent::Vanished { guid } = &event {
            self.services.endpoint_gone(guid);
        }
        if let Some(routes) = &mut self.routes {
            routes.handle_discovery(now().instant, event);
        }
    }
}
