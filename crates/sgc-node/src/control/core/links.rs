//! Links that come and go, and their frames.

use std::net::SocketAddr;
use std::time::Instant;

use sgc_ros::RosNetwork;
use sgc_router::{DropReason, LinkId, LinkQuality, Neighbour};
use sgc_transport::{AnyLink, CloseReason, Link, LinkUrl};
use sgc_trust::VerifiedPeer;
use sgc_wire::{Control, MINOR_OBSERVED_ADDRESS, NodeId, Place};
use tokio::sync::oneshot;
use tracing::{debug, info, warn};

use super::Core;
use crate::clock::now;
use crate::control::event::LinkPlace;
use crate::control::parts::link_table::{EndedLink, LinkEntry};
use crate::control::peers::control_queue::FrameRoom;
use crate::data::stats::CountDrops;
use crate::link::control_tx::ControlTx;
use crate::state::audit::{AuditEvent, AuditRecord};

impl<N: RosNetwork> Core<N> {
    /// Gives a new link its place.
    pub(super) fn link_up(
        &mut self,
        link: AnyLink,
        url: Option<String>,
        control: ControlTx,
        reply: oneshot::Sender<Option<LinkPlace>>,
    ) {
        let set = url.as_deref().and_then(|url| url.parse::<LinkUrl>().ok()).and_then(|url| url.cost_ms);
        let cost = set.map(|ms| ms.saturating_mul(1000));
        let remote = link.remote();
        self.hear_of(link.peer());
        let record = AuditRecord::new(AuditEvent::LinkUp).peer(&link.peer().node_id).remote(remote);
        self.audit.write(record.by(url.as_deref().unwrap_or("the peer")));
        let quality = LinkQuality { round_trip: link.stats().rtt, ..LinkQuality::default() };
        let id = self.links.add(Instant::now(), link.clone(), url, control);
        let direct = self.direct.link_up(Instant::now(), id, link.peer().node_id, remote);
        let what = match direct {
            Some(_) => {
                self.links.set_direct(id);
                "direct link is up"
            }
            None => "link is up",
        };
        info!(link = id.0, %remote, peer = self.names.called(&link.peer().node_id), "{what}");
        let neighbour = Neighbour { cost, direct, ..Neighbour::from(link.peer()) };
        self.control_drops.link_up(id);
        self.data.drops().link_up(id);
        let place = LinkPlace { id, data: self.data.clone(), inbox: self.inbox.share() };
        let is_abandoned = reply.send(Some(place)).is_err();
        self.router.handle_link_up(now(), id, neighbour);
        self.router.handle_link_quality(now(), id, quality);
        if direct.is_some() && !self.direct.may_meet(link.peer()) {
            self.close_not_permitted(id);
        }
        if is_abandoned {
            // Its task ended meanwhile, so nobody would report the end of the link.
            debug!(%remote, "the link's task is gone");
            link.close(CloseReason::Goodbye);
            self.link_down(id, None, None);
        }
    }

    /// Forgets a link. `in_use` is the place of another process with this node's identity, if the peer closed the link
    /// for it; `end` tells how the link ended.
    pub(super) fn link_down(&mut self, id: LinkId, in_use: Option<String>, end: Option<String>) {
        self.router.handle_link_down(now(), id);
        self.direct.link_down(Instant::now(), id);
        self.control_drops.link_down(id);
        self.data.drops().link_down(id);
        if let Some(EndedLink { node, remote, closed_for }) = self.links.remove(id) {
            let end = end.as_deref().or(closed_for.as_deref()).unwrap_or("its task ended");
            info!(link = id.0, %remote, peer = self.names.called(&node), "link ended: {end}");
            let record = AuditRecord::new(AuditEvent::LinkClosed).peer(&node).remote(remote);
            self.audit.write(match closed_for {
                Some(reason) => record.reason(reason),
                None => record,
            });
        }
        if let Some(place) = in_use {
            self.displaced(&place);
        }
    }

    /// Looks at the links, and passes the measurements to the router.
    pub(super) fn look_at_links(&mut self, at: Instant) {
        let now = now();
        for (link, quality) in self.links.look(at) {
            self.router.handle_link_quality(now, link, quality);
            self.direct.link_looked_at(at, link, quality.is_silent);
            // Either end of a direct link may have moved.
            let remote = self.links.get(link).map(LinkEntry::remote);
            if let Some(reach) = remote.and_then(|remote| self.direct.reach(link, remote)) {
                self.router.handle_direct_reach(now, link, reach);
            }
            self.tell_address(link);
        }
        self.look_at_direct(at);
        self.look_at_clocks(at);
        self.warn_of_owners_here();
        self.warn_of_misspelt(now.instant);
    }

    /// Tells the peer of a link its address, if its version knows the frame.
    fn tell_address(&mut self, link: LinkId) {
        if self.router.minor(link) >= Some(MINOR_OBSERVED_ADDRESS) {
            self.links.tell_address(link);
        }
    }

    /// Passes a control frame to the router.
    pub(super) fn handle_frame(&mut self, link: LinkId, frame: Control, room: FrameRoom) {
        let (tells_time, greets) =
            (matches!(frame, Control::Clock { .. }), matches!(frame, Control::Hello(_)));
        self.router.handle_frame(now(), link, frame);
        drop(room);
        if greets {
            self.tell_address(link);
        }
        if tells_time {
            self.compare_clocks(link);
        }
    }

    /// Handles a peer's report of the address from which this node comes.
    pub(super) fn address_observed(&mut self, link: LinkId, place: Place) {
        let address = SocketAddr::from(place);
        if self.links.observe_address(link, address) {
            debug!(link = link.0, %address, "the peer sees this node at an address");
            self.reflexive_changed();
        } else {
            self.control_drops.count_from(&DropReason::Unknown { what: "address" }, link);
        }
    }

    /// Notes a member that was heard.
    pub(super) fn hear_of(&mut self, peer: &VerifiedPeer) {
        self.members.heard(peer, self.certificates.identity(), Instant::now());
    }

    /// Notes a node whose catalogue has come.
    pub(super) fn hear_of_owner(&mut self, owner: NodeId) {
        self.members.heard_owner(owner, self.certificates.identity(), Instant::now());
    }

    /// Reports names in rules that are probably misspellings of heard members.
    fn warn_of_misspelt(&mut self, now: Instant) {
        for (written, meant) in self.members.take_misspelt(now) {
            warn!(
                "a rule names \"{written}\", which nobody here is called; \"{meant}\" is here and may be meant"
            );
        }
    }
}
