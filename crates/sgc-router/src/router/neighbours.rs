//! Links that come and go, greetings, and the clocks of neighbours.

use sgc_wire::{Control, Hello, MINOR_VERSION, UnixMillis};

use super::{Claim, Router};
use crate::drops::DropReason;
use crate::link_id::LinkId;
use crate::links::{EarlierRun, Greeting, Neighbour};
use crate::output::{LinkClose, Output};

impl Router {
    /// Adds a link and greets over it, unless there is a reason against it.
    pub(super) fn add_link(&mut self, link: LinkId, neighbour: Neighbour) {
        let now = self.now;
        let refusal = self.links.refusal(&neighbour.node, self.config.limits.links_per_node_max);
        let refusal = match refusal {
            Some(LinkClose::Loop) => refusal,
            _ if self.is_untrusted(&neighbour.certs) => Some(LinkClose::Revoked),
            _ => refusal,
        };
        if let Some(reason) = refusal {
            self.outputs.push(Output::Close { link, reason });
            return;
        }
        self.links.add(now, link, neighbour);
        self.names.link_up(link);
        let hello = Hello {
            minor: MINOR_VERSION,
            incarnation: self.config.incarnation,
            transit: self.config.transit,
            yields: self.claim == Claim::Yields,
            started: self.config.started,
        };
        self.send(link, Control::Hello(hello));
        self.send(link, Control::Clock { time: now.unix });
        // Lists go first, before everything that they bear on.
        for der in self.config.anchors.crls().cloned().collect::<Vec<_>>() {
            self.send(link, Control::Crl { der });
        }
    }

    /// Withdraws everything that came over or goes over `link`.
    pub(super) fn forget_link(&mut self, link: LinkId) {
        let Some(state) = self.links.remove(link) else { return };
        self.names_part(|names, cx| names.link_down(cx, link));
        self.syncs.link_down(link);
        let effects = self.trees.link_down(link);
        self.perform(effects);
        let lost = self.names.lose_link(link);
        self.routes_changed(&lost);
        self.spare_uplinks();
        if state.hello().is_some() {
            self.topology.links_changed(self.now.instant, state.node());
        }
    }

    pub(super) fn handle_hello(&mut self, link: LinkId, hello: Hello) {
        let Some(peer) = self.links.greet(link, hello) else { return };
        if hello.transit && !peer.is_router {
            self.drop_frame(link, DropReason::NotRouter);
        }
        let is_elsewhere = || self.topology.is_elsewhere(&peer.node, hello.started);
        match self.links.judge_greeting(link, &peer.node, hello, is_elsewhere) {
            Greeting::GivesWay { to } => self.supersede(link, to, hello.yields),
            Greeting::Stays { earlier } => {
                for EarlierRun { link: old, alive } in earlier {
                    self.supersede(old, Some(link), alive);
                }
                self.tell_all(link);
                self.spare_uplinks();
                self.topology.links_changed(self.now.instant, &peer.node);
            }
        }
    }

    /// Closes the link of a run that another one supersedes.
    pub(super) fn supersede(&mut self, link: LinkId, by: Option<LinkId>, alive: bool) {
        self.close(link, LinkClose::Superseded { by, alive });
    }

    /// Tells a neighbour this node's state, and that of the network if it is a router.
    fn tell_all(&mut self, link: LinkId) {
        if self.links.is_router(link) {
            // This node's own link state comes first: routes to it wait for that.
            if let Some(record) = self.topology.own() {
                let signed = record.signed().clone();
                self.send(link, Control::LinkState { signed });
            }
            self.syncs.begin(link, self.names.next_id());
            self.continue_sync(link);
        }
        self.names_part(|names, cx| names.send_interests(cx, link));
    }

    /// Tells a router the next part of the state, and asks for a notice when the link has taken it if there is more.
    pub(super) fn continue_sync(&mut self, link: LinkId) {
        let Some(part) = self.syncs.next_part(self.now, link, &self.topology, &self.names) else { return };
        for frame in part.frames {
            self.send(link, frame);
        }
        if part.has_more {
            self.outputs.push(Output::Flush { link });
        }
    }

    pub(super) fn handle_clock(&mut self, link: LinkId, time: UnixMillis) {
        // One of the two refused the other's bodies until now, and would get new ones with the next lease only.
        if self.links.note_clock(self.now, link, time) {
            self.tell_again(link);
        }
    }

    /// Handles a new setting of the wall clock here: tells peers, and signs own bodies anew.
    pub(super) fn clock_was_set(&mut self) {
        let now = self.now;
        for link in self.links.remote().collect::<Vec<_>>() {
            self.links.set_expiry(now, link);
            self.send(link, Control::Clock { time: now.unix });
            self.tell_again(link);
        }
        self.topology.touch_own(now.instant);
    }

    /// Tells a neighbour everything again, unless that was a moment ago.
    fn tell_again(&mut self, link: LinkId) {
        if self.links.may_tell_again(self.now.instant, link) {
            self.tell_all(link);
            self.names_part(|names, cx| names.tell_interested_again(cx, link));
        }
    }
}
