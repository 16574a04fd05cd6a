//! Measures links, so that the router machine can weigh them and leave silent ones before they time out.
//! [`sgc_session::KeepAlive`] decides when to probe a peer.

use std::time::{Duration, Instant};

use sgc_ros::RosNetwork;
use sgc_router::LinkId;
use sgc_session::{KeepAlive, LinkObservation};
use sgc_transport::{AnyLink, CloseReason, Link};
use sgc_wire::Control;
use tracing::info;

use super::{Core, LinkEntry};
use crate::clock::now;

/// Interval of looks at the links.
const LOOK_EVERY: Duration = Duration::from_millis(500);

impl<N: RosNetwork> Core<N> {
    /// Starts the keep-alive of a link to this peer.
    pub(super) fn keep_alive_for(&self, link: &AnyLink) -> KeepAlive {
        let policy = self.keep_alive_policies.for_peer(&link.peer().node_id);
        KeepAlive::new(Instant::now(), policy, link.stats().received_bytes, link.remote())
    }

    /// Looks at all links, if that is due.
    pub(super) fn look_at_links(&mut self, at: Instant) {
        if self.look_due.is_none_or(|due| due > at) {
            return;
        }
        self.look_due = (!self.links.is_empty()).then_some(at + LOOK_EVERY);
        let now = now();
        for (id, entry) in &mut self.links {
            let stats = entry.link.stats();
            let verdict = entry.look(at, stats.received_bytes, stats.rtt);
            self.router.handle_link_quality(now, *id, stats.rtt, verdict);
        }
    }

    /// Measures a link that is up, and looks at it from here on.
    pub(super) fn begin_to_look(&mut self, id: LinkId) {
        self.look_due.get_or_insert_with(|| Instant::now() + LOOK_EVERY);
        if let Some(entry) = self.links.get(&id) {
            self.router.handle_link_quality(now(), id, entry.link.stats().rtt, false);
        }
    }
}

impl LinkEntry {
    /// Looks at a link, and probes the peer or marks it silent if needed. Returns `true` if the link seems dead.
    fn look(&mut self, at: Instant, received_bytes: u64, rtt: Duration) -> bool {
        let (activity, remote) = (self.control.activity(), self.link.remote());
        let verdict = self.keep_alive.look(at, LinkObservation { received_bytes, activity, remote, rtt });
        if verdict.asks {
            // A full queue means that the peer takes nothing, which is detected elsewhere.
            self.control.send(Control::Probe { answers: false });
        }
        if verdict.is_dead() && self.closed_for.is_none() {
            info!(%remote, peer = %self.link.peer().node_id.short(), "the peer does not answer; its link is closed");
            self.closed_for = Some(CloseReason::Silent.to_string());
            self.link.close(CloseReason::Silent);
        }
        verdict.is_silent()
    }
}
