//! Alerts for an operator, as this node comes to know of them.

use std::net::SocketAddr;
use std::time::Instant;

use sgc_endpoint::JoinStatus;
use sgc_ros::RosNetwork;
use sgc_router::{LinkId, clocks_differ};
use sgc_transport::{CloseReason, Link as _};
use sgc_wire::{Control, Place, UnixMillis};
use tracing::{debug, info, warn};

use super::{Core, now};
use crate::alerts::{Alert, clock_alert};
use crate::strangers;

/// The place of a process that is linked to another router of the mesh.
const ELSEWHERE: &str = "another router";

/// Seconds for which a failure to send to the local network is shown: longer than participants' announcements are apart.
const UNSENT_SHOWN_S: u64 = 60;

impl<N: RosNetwork> Core<N> {
    /// Closes the link of a run whose place another one has. One that came back after it was told so is a second
    /// process; the first is told of it, and whoever keeps this node.
    pub(super) fn close_superseded(&mut self, link: LinkId, by: Option<LinkId>, alive: bool) {
        let holder = by.and_then(|by| self.links.get(&by));
        let place = holder.map_or(ELSEWHERE.to_owned(), |entry| entry.link.remote().to_string());
        let Some(entry) = self.links.get_mut(&link) else { return };
        let (node, remote) = (entry.link.peer().node_id, entry.link.remote());
        let reason = CloseReason::InUse(place.clone());
        entry.closed_for = Some(reason.to_string());
        entry.link.close(reason);
        if !alive {
            info!(%link, peer = %node.short(), %remote, %place, "a newer process of the node takes the place of this link");
            return;
        }
        if let Some(holder) = by.and_then(|by| self.links.get(&by)) {
            // A peer that does not take frames finds its link closed for that elsewhere.
            holder.control.send(Control::IdentityInUse { place: Place::from(remote) });
        }
        self.control_drops.count_from("identity_in_use", node);
        let called = self.called(&node);
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

    /// A peer closed a link because another process with this node's identity has its place.
    pub(super) fn displaced(&mut self, place: &str) {
        self.router.handle_superseded();
        // Joins that the link carried are lost by now. What comes to them meanwhile comes to the other process, and
        // from there perhaps to the very same programs.
        self.drain();
        for (name, sink) in &self.sinks {
            if self.endpoint.join_status(name) != Some(JoinStatus::Granted) {
                sink.begin_anew();
            }
        }
        let node = self.identity.node_name();
        if self.alerts.displaced(place, Instant::now()) {
            warn!(
                "the identity {node} is in use at another place: {place}, which has the links of this node; it is tried \
                 again with growing patience"
            );
        }
    }

    /// A peer says that it keeps another process with this node's identity out.
    pub(super) fn kept_out(&mut self, link: LinkId, place: Place) {
        let Some(entry) = self.links.get(&link) else { return };
        // Others have no links to be kept out of.
        if !entry.link.peer().may_route && entry.url.is_none() {
            self.control_drops.count_from("unknown", link);
            return;
        }
        let (node, place) = (self.identity.node_name(), SocketAddr::from(place));
        if self.alerts.kept_out(place, Instant::now()) {
            warn!(
                "the identity {node} is in use at another place: {place}, which is kept out while this node has its links"
            );
        }
    }

    /// A peer told its time.
    pub(super) fn compare_clocks(&self, link: LinkId) {
        let Some(entry) = self.links.get(&link) else { return };
        let ahead_ms = self.router.clock_ahead_ms(link).filter(|ms| clocks_differ(*ms));
        let Some(ahead_ms) = ahead_ms else { return };
        if self.control_drops.count_from("clocks_differ", link) {
            let (peer, remote) = (self.called(&entry.link.peer().node_id), entry.link.remote().to_string());
            let alert = Alert::ClocksDiffer { peer, remote, ahead_ms };
            warn!("{alert}; {}", alert.fix());
        }
    }

    /// Looks whether the clock has come to where this node's certificate begins.
    pub(super) fn await_clock(&mut self, unix: UnixMillis) {
        if clock_alert(&self.identity, unix).is_none() {
            self.awaits_clock = false;
            info!("the clock is set: this node's certificate holds");
        }
    }

    /// Returns the alerts that an operator has to see to now.
    pub(super) fn alerts(&self) -> Vec<Alert> {
        let now = now();
        let mut alerts = Vec::from_iter(clock_alert(&self.identity, now.unix));
        let node = self.identity.node_name().as_str();
        alerts.extend(self.alerts.shown(node, |peer| self.called(peer), now.instant));
        alerts.extend(sgc_dds::unsent().and_then(|unsent| {
            let ago_s = now.instant.saturating_duration_since(unsent.last).as_secs();
            let (to, packets) = (unsent.to, unsent.packets);
            let is_of_before = self.reopening.last.is_some_and(|reopened| unsent.last < reopened);
            (ago_s < UNSENT_SHOWN_S && !is_of_before).then_some(Alert::LocalNetworkFails {
                to,
                packets,
                ago_s,
            })
        }));
        let closed = self.reopening.failed.clone();
        alerts.extend(closed.map(|reason| Alert::LocalNetworkClosed { reason }));
        alerts.extend(strangers::alerts());
        alerts.extend(self.links.iter().filter_map(|(id, entry)| {
            let ahead_ms = self.router.clock_ahead_ms(*id).filter(|ms| clocks_differ(*ms))?;
            let peer = self.called(&entry.link.peer().node_id);
            Some(Alert::ClocksDiffer { peer, remote: entry.link.remote().to_string(), ahead_ms })
        }));
        alerts
    }
}
