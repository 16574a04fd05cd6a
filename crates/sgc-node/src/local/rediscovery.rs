//! [`Rediscovery`]: the endpoints and nodes that were known before the local network was reopened, until they are found
//! again.
//!
//! A pure machine. An unchanged endpoint that is found again is no news, so its routes, sources and calls continue.
//! Endpoints that are not found in time are reported as gone.

use std::collections::{BTreeMap, BTreeSet};
use std::time::Instant;

use sgc_ros::{DiscoveredEndpoint, DiscoveryEvent, Guid, REDISCOVERY_HOLD};

/// Endpoints and nodes that were known and are not found again yet.
#[derive(Debug, Default)]
pub(crate) struct Rediscovery {
    endpoints: BTreeMap<Guid, DiscoveredEndpoint>,
    participants: BTreeSet<Guid>,
    until: Option<Instant>,
}

impl Rediscovery {
    /// Starts with the endpoints and nodes of a closed network.
    pub(crate) fn new(
        endpoints: impl IntoIterator<Item = DiscoveredEndpoint>,
        participants: impl IntoIterator<Item = Guid>,
    ) -> Self {
        let endpoints = endpoints.into_iter().map(|endpoint| (endpoint.guid, endpoint)).collect();
        Self { endpoints, participants: participants.into_iter().collect(), until: None }
    }

    /// Notes that the network is open.
    pub(crate) fn opened(&mut self, now: Instant) {
        self.until = Some(now + REDISCOVERY_HOLD);
    }

    /// Handles a discovery event. Returns it if it is news.
    pub(crate) fn news(&mut self, event: DiscoveryEvent) -> Option<DiscoveryEvent> {
        match &event {
            DiscoveryEvent::Appeared(endpoint) => {
                let known = self.endpoints.remove(&endpoint.guid);
                if known.is_some_and(|known| is_same(&known, endpoint)) {
                    return None;
                }
            }
            DiscoveryEvent::Vanished { guid } => drop(self.endpoints.remove(guid)),
            DiscoveryEvent::Nodes { participant, .. } => drop(self.participants.remove(participant)),
            DiscoveryEvent::Liveliness { .. } | DiscoveryEvent::HistoryDepth { .. } => {}
        }
        Some(event)
    }

    /// Returns the time at which missing endpoints count as gone.
    pub(crate) fn deadline(&self) -> Option<Instant> {
        self.until
    }

    /// Returns the missing endpoints once their time is over.
    pub(crate) fn handle_timeout(&mut self, now: Instant) -> Vec<DiscoveryEvent> {
        if self.until.take_if(|until| *until <= now).is_none() {
            return Vec::new();
        }
        let endpoints = std::mem::take(&mut self.endpoints).into_keys();
        let gone = endpoints.map(|guid| DiscoveryEvent::Vanished { guid });
        let participants = std::mem::take(&mut self.participants).into_iter();
        let nodes = participants.map(|participant| DiscoveryEvent::Nodes { participant, nodes: Vec::new() });
        gone.chain(nodes).collect()
    }
}

/// Returns `true` if an endpoint is unchanged. The depth of its history may have been learned beyond its announcement.
fn is_same(known: &DiscoveredEndpoint, found: &DiscoveredEndpoint) -> bool {
    let mut found = found.clone();
    if found.qos.history.is_unsaid() {
        found.qos.history = known.qos.history;
    }
    *known == found
}

#[cfg(test)]
mod tests {
    use std::time::Duration;

    use sgc_ros::EndpointKind;
    use sgc_wire::{Durability, History, Qos};

    use super::*;

    fn endpoint(n: u8) -> DiscoveredEndpoint {
        DiscoveredEndpoint {
            kind: EndpointKind::Writer,
            guid: Guid([n; 16]),
            topic: "rt/chatter".into(),
            type_name: "std_msgs::msg::dds_::String_".into(),
            keyless: true,
            type_hash: None,
            qos: Qos::default(),
        }
    }

    #[test]
    fn endpoint_that_is_found_as_it_was_is_no_news() {
        let mut known = endpoint(1);
        known.qos =
            Qos { durability: Durability::TransientLocal, history: History::KeepLast(5), ..Qos::default() };
        let mut found = known.clone();
        found.qos.history = History::UNSAID;
        let mut rediscovery = Rediscovery::new([known, endpoint(2)], []);
        assert_eq!(rediscovery.news(DiscoveryEvent::Appeared(found.clone())), None);
        // The second time, it is news.
        let again = DiscoveryEvent::Appeared(found);
        assert_eq!(rediscovery.news(again.clone()), Some(again));
        let changed = DiscoveredEndpoint { type_hash: Some("RIHS01_0".into()), ..endpoint(2) };
        let changed = DiscoveryEvent::Appeared(changed);
        assert_eq!(rediscovery.news(changed.clone()), Some(changed));
    }

    #[test]
    fn endpoints_and_nodes_that_are_not_found_are_gone_after_a_while() {
        let (start, soon) = (Instant::now(), Duration::from_secs(1));
        let participants = [7, 8].map(|n| Guid([n; 16]));
        let mut rediscovery = Rediscovery::new([1, 2, 3].map(endpoint), participants);
        assert_eq!(rediscovery.handle_timeout(start + 2 * REDISCOVERY_HOLD), [], "it is not open yet");
        rediscovery.opened(start);
        assert_eq!(rediscovery.news(DiscoveryEvent::Appeared(endpoint(1))), None);
        let vanished = DiscoveryEvent::Vanished { guid: Guid([2; 16]) };
        assert_eq!(rediscovery.news(vanished.clone()), Some(vanished));
        let nodes = DiscoveryEvent::Nodes { participant: participants[0], nodes: Vec::new() };
        assert!(rediscovery.news(nodes).is_some());
        assert_eq!(rediscovery.handle_timeout(start + REDISCOVERY_HOLD - soon), []);
        let gone = [
            DiscoveryEvent::Vanished { guid: Guid([3; 16]) },
            DiscoveryEvent::Nodes { participant: participants[1], nodes: Vec::new() },
        ];
        assert_eq!(rediscovery.handle_timeout(start + REDISCOVERY_HOLD), gone);
        assert_eq!(
            (rediscovery.deadline(), rediscovery.handle_timeout(start + 2 * REDISCOVERY_HOLD)),
            (None, vec![])
        );
    }
}
