//! What the links measure: the router machine weighs ways by it, and leaves those that have fallen silent before
//! their time-outs end them.

use std::time::{Duration, Instant};

use sgc_ros::RosNetwork;
use sgc_router::LinkId;
use sgc_transport::{AnyLink, Link};

use super::{Core, now};

/// How often links are looked at.
const LOOK_EVERY: Duration = Duration::from_millis(500);
/// After how long of silence a link seems dead. Each side sends something every second
/// (`sgc_transport::LinkOptions::keep_alive`), and one of two may be lost.
const SILENT_AFTER: Duration = Duration::from_millis(2500);

/// When something came over a link last.
pub(super) struct Pulse {
    received_bytes: u64,
    at: Instant,
}

impl Pulse {
    pub(super) fn new(link: &AnyLink) -> Self {
        Self { received_bytes: link.stats().received_bytes, at: Instant::now() }
    }
}

impl<N: RosNetwork> Core<N> {
    /// Looks at all links, if that is due.
    pub(super) fn look_at_links(&mut self, at: Instant) {
        if self.look_due.is_none_or(|due| due > at) {
            return;
        }
        self.look_due = (!self.links.is_empty()).then_some(at + LOOK_EVERY);
        let now = now();
        for (id, entry) in &mut self.links {
            let stats = entry.link.stats();
            if stats.received_bytes != entry.pulse.received_bytes {
                entry.pulse = Pulse { received_bytes: stats.received_bytes, at };
            }
            let silent = at.saturating_duration_since(entry.pulse.at) >= SILENT_AFTER;
            self.router.handle_link_quality(now, *id, stats.rtt, silent);
        }
    }

    /// A link is up: its handshake has measured it, and it is looked at from here on.
    pub(super) fn begin_to_look(&mut self, id: LinkId) {
        self.look_due.get_or_insert_with(|| Instant::now() + LOOK_EVERY);
        if let Some(entry) = self.links.get(&id) {
            self.router.handle_link_quality(now(), id, entry.link.stats().rtt, false);
        }
    }
}
