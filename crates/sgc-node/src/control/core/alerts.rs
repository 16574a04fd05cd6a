//! Alerts for the operator, raised by events of the control task.

use std::collections::BTreeSet;
use std::net::SocketAddr;
use std::time::Instant;

use sgc_endpoint::JoinStatus;
use sgc_ros::RosNetwork;
use sgc_router::{DropReason, LinkId, clocks_differ};
use sgc_transport::CloseReason;
use sgc_wire::{Control, Place};
use tracing::{debug, info, warn};

use super::Core;
use crate::clock::now;
use crate::control::faults::alerts::{Alert, clock_alert};
use crate::drops::NodeDrop;
use crate::local::strangers;

/// Place of a process that is linked to another router.
const ELSEWHERE: &str = "another router";

/// Seconds for which a failure to send to the local network is shown. It exceeds the interval of participants'
/// announcements.
const UNSENT_SHOWN_S: u64 = 60;

/// Seconds without an answer after which the store counts as down: more than a router needs to connect to it, and than a
/// cluster needs to replace a server.
const STORE_DOWN_SHOWN_S: u64 = 5;
/// Seconds for which a refusal of the store is shown. It exceeds the pause before a write that failed is repeated.
const STORE_REFUSAL_SHOWN_S: u64 = 60;

impl<N: RosNetwork> Core<N> {
    /// Closes the link of a run that another run of the same node superseded. A run that returns after it was told so
    /// is a second process; both it and the operator are told.
    pub(super) fn close_superseded(&mut self, link: LinkId, by: Option<LinkId>, alive: bool) {
        let holder = by.and_then(|by| self.links.get(by));
        let place = holder.map_or(ELSEWHERE.to_owned(), |entry| entry.remote().to_string());
        let Some(entry) = self.links.get(link) else { return };
        let (node, remote) = (entry.peer().node_id, entry.remote());
        let reason = CloseReason::InUse(place.clone());
        self.links.close(link, reason.to_string(), reason);
        if !alive {
            info!(%link, peer = self.names.called(&node), %remote, %place, "a newer process of the node takes the place of this link");
            return;
        }
        if let Some(holder) = by.and_then(|by| self.links.get(by)) {
            holder.notify(Control::IdentityInUse { place: Place::from(remote) });
        }
        self.control_drops.count_from(NodeDrop::IdentityInUse, node);
        let called = self.names.called(&node);
        if self.alerts.peer_in_use(node, &place, remote, Instant::now()) {
            warn!(
                "the identity {called} is in use at two places: {place} has its links, {remote} is kept out"
            );
        } else {
            debug!(
                "the identity {called} is in use at two places: {place} has its links, {remote} is kept out"
            );
        }
    }

    /// Handles a link that a peer closed because another process with this node's identity took its place.
    pub(super) fn displaced(&mut self, place: &str) {
        self.router.handle_superseded();
        // Joins over that link are lost. Their data goes to the other process now, and from there perhaps to the same
        // programs.
        self.drain();
        for (name, sink) in self.sinks.iter() {
            if self.endpoint.join_status(name) != Some(JoinStatus::Granted) {
                sink.begin_anew();
            }
        }
        let node = self.certificates.identity().node_name();
        if self.alerts.displaced(place, Instant::now()) {
            warn!(
                "the identity {node} is in use at another place: {place}, which has the links of this node; it is tried \
                 again with growing patience"
            );
        }
    }

    /// Handles a peer's report that it keeps out another process with this node's identity.
    pub(super) fn kept_out(&mut self, link: LinkId, place: Place) {
        let Some(entry) = self.links.get(link) else { return };
        // Other peers have no links from which a process could be kept out.
        if (!entry.peer().may_route && entry.url().is_none()) || self.direct.is_direct(link) {
            self.control_drops.count_from(&DropReason::Unknown { what: "identity" }, link);
            return;
        }
        let (node, place) = (self.certificates.identity().node_name(), SocketAddr::from(place));
        if self.alerts.kept_out(place, Instant::now()) {
            warn!(
                "the identity {node} is in use at another place: {place}, which is kept out while this node has its links"
            );
        }
    }

    /// Compares the clock with the time that a peer told.
    pub(super) fn compare_clocks(&self, link: LinkId) {
        let Some(entry) = self.links.get(link) else { return };
        let ahead_ms = self.router.clock_ahead_ms(link).filter(|ms| clocks_differ(*ms));
        let Some(ahead_ms) = ahead_ms else { return };
        if self.control_drops.count_from(NodeDrop::ClocksDiffer, link) {
            let (peer, remote) = (self.names.called(&entry.peer().node_id), entry.remote().to_string());
            let alert = Alert::ClocksDiffer { peer, remote, ahead_ms };
            warn!("{alert}; {}", alert.fix());
        }
    }

    /// Returns the owners in use rules that are on this node's local network.
    fn owners_here(&self) -> BTreeSet<String> {
        let (Some(routes), Some(network)) = (&self.routes, self.network.get()) else {
            return BTreeSet::new();
        };
        let mut nodes = network.nodes_here();
        if !nodes.is_empty() {
            let owners: BTreeSet<&str> = routes.used_owners().collect();
            nodes.retain(|node| owners.contains(node.as_str()));
        }
        nodes
    }

    /// Warns of owners on this node's local network, of each once.
    pub(super) fn warn_of_owners_here(&mut self) {
        for node in self.owners_here() {
            if self.alerts.owner_here(&node) {
                let alert = Alert::SameLocalNetwork { node };
                warn!("{alert}; {}", alert.fix());
            }
        }
    }

    /// Returns the current alerts.
    pub(super) fn alerts(&self) -> Vec<Alert> {
        let now = now();
        let mut alerts = Vec::from_iter(clock_alert(self.certificates.identity(), now.unix));
        let node = self.certificates.identity().node_name().as_str();
        alerts.extend(self.alerts.shown(node, |peer| self.names.called(peer), now.instant));
        alerts.extend(sgc_dds::unsent().and_then(|unsent| {
            let ago_s = now.instant.saturating_duration_since(unsent.last).as_secs();
            let (to, packets) = (unsent.to, unsent.packets);
            let is_of_before = self.reopening.reopened_at().is_some_and(|reopened| unsent.last < reopened);
            (ago_s < UNSENT_SHOWN_S && !is_of_before).then_some(Alert::LocalNetworkFails {
                to,
                packets,
                ago_s,
            })
        }));
        let closed = self.reopening.failure().map(str::to_owned);
        alerts.extend(closed.map(|reason| Alert::LocalNetworkClosed { reason }));
        let router = self.network.get().and_then(|network| network.missing_router());
        alerts.extend(router.map(|router| Alert::ZenohRouterMissing { router }));
        alerts.extend(self.storage.alert().into_iter().chain(self.audit.alert()));
        if let Some(store) = self.router.store_stats() {
            let ago_s = |at: Instant| now.instant.saturating_duration_since(at).as_secs();
            let down = store.down_since.map(ago_s).filter(|ago_s| *ago_s >= STORE_DOWN_SHOWN_S);
            alerts.extend(down.map(|ago_s| Alert::StoreDown { ago_s }));
            let refused = store.refused_at.map(ago_s).filter(|ago_s| *ago_s < STORE_REFUSAL_SHOWN_S);
            alerts.extend(refused.map(|ago_s| Alert::StoreRefuses { ago_s }));
        }
        alerts.extend(strangers::alerts());
        alerts.extend(self.owners_here().into_iter().map(|node| Alert::SameLocalNetwork { node }));
        alerts.extend(self.links.iter().filter_map(|(id, entry)| {
            let ahead_ms = self.router.clock_ahead_ms(id).filter(|ms| clocks_differ(*ms))?;
            let peer = self.names.called(&entry.peer().node_id);
            Some(Alert::ClocksDiffer { peer, remote: entry.remote().to_string(), ahead_ms })
        }));
        alerts
    }
}
