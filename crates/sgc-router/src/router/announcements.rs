//! Link states and advertisements: verified, taken by their part, and passed on within the allowance of their signer.

use std::collections::BTreeSet;
use std::time::Duration;

use sgc_trust::{signed_digest, verify_advert, verify_link_state};
use sgc_wire::{Control, Name, NodeId, SignedBody};

use super::Router;
use crate::drops::DropReason;
use crate::lease::verifies_elsewhere;
use crate::link_id::LinkId;
use crate::links::EarlierRun;
use crate::names::{self, Admitted, Arrival, RecordEnd, RecordId, RecordKind};
use crate::topology;

/// Interval of looks at announcements beyond the allowance of their signer.
const LATE_EVERY: Duration = Duration::from_millis(100);

impl Router {
    // ---- Names.

    pub(super) fn handle_advert(&mut self, link: LinkId, cost: u32, signed: SignedBody) {
        let Some(from) = self.bringer(link) else { return };
        let now = self.now;
        let digest = signed_digest(&signed);
        match self.names.recognise(&digest) {
            names::Recognised::New => {}
            // A node that was told an old record tells its owner the newest.
            names::Recognised::Known { owner, .. }
                if !from.is_router && owner != from.node && owner != self.config.node =>
            {
                return self.drop_frame(link, DropReason::NotOwner { owner });
            }
            names::Recognised::Known { id, .. } => return self.hear(link, cost, id),
            names::Recognised::Ended { owner, seq } => {
                return self.names_part(|names, cx| names.answer_stale(cx, link, &owner, seq));
            }
        }
        if !self.may_bring(link) {
            return;
        }
        let advert = match verify_advert(&self.config.anchors, &signed, now.unix) {
            Ok(advert) => advert,
            Err(why) => return self.not_verified(link, "advertisement", why),
        };
        let arrival = Arrival { link, from, cost, signed, digest, advert };
        match self.names_part(|names, cx| names.admit(cx, arrival)) {
            names::Admission::Done => {}
            names::Admission::Ended(why) => self.not_verified(link, "advertisement", why),
            names::Admission::Admitted(admitted) => self.pass_on_record(link, cost, admitted),
        }
    }

    /// Passes on a record that was just put into force, and lets everything else follow it.
    fn pass_on_record(&mut self, link: LinkId, cost: u32, admitted: Admitted) {
        let Admitted { id, owner, kind, mut changed, before } = admitted;
        self.store_record(&owner, id, before);
        match kind {
            RecordKind::Advert => {
                // A node that only listens may learn of known names from another neighbour.
                self.hear(link, cost, id);
                self.pass_on_or_wait(link, &owner, id);
            }
            // Neighbours that never heard of the names need no withdrawal.
            RecordKind::Withdrawal if changed.is_empty() => self.charge_stale(link),
            RecordKind::Withdrawal => {
                self.pass_on_or_wait(link, &owner, id);
                self.names_part(|names, cx| names.tell_withdrawal(cx, link, id, &changed));
            }
        }
        changed.extend(self.names.make_room(self.now.instant, &owner));
        self.routes_changed(&changed);
    }

    fn hear(&mut self, link: LinkId, cost: u32, id: RecordId) {
        let names = self.names.hear(self.now.instant, link, cost, id);
        self.routes_changed(&names);
    }

    pub(super) fn handle_unreach(&mut self, link: LinkId, names: &[Name]) {
        let lost = self.names_part(|part, cx| part.unreach(cx, link, names));
        self.routes_changed(&lost);
    }

    /// Passes on a new advertisement or withdrawal, now or when the allowance of its owner permits.
    fn pass_on_or_wait(&mut self, link: LinkId, owner: &NodeId, id: RecordId) {
        let now = self.now.instant;
        if link == LinkId::LOCAL || self.allowances.node(now, owner).may_announce(now) {
            self.names_part(|names, cx| names.tell_routers(cx, link, owner, id));
        } else {
            self.charge_stale(link);
            self.names.wait(owner, id);
            self.late_at.get_or_insert(now + LATE_EVERY);
        }
    }

    /// Ends the records of an owner's earlier run.
    fn void_names(&mut self, owner: &NodeId, floor: u64) {
        for id in self.names.records_before(owner, floor) {
            let names = self.names.forget(self.now.instant, id, RecordEnd::Superseded);
            self.routes_changed(&names);
        }
    }

    /// Ends the records whose leases are over, and asks for those that should have been renewed.
    pub(super) fn expire_names(&mut self) {
        let now = self.now.instant;
        self.names_part(|names, cx| names.ask_for_renewals(cx));
        while let Some(names) = self.names.expire_next(now) {
            self.routes_changed(&names);
        }
        self.names.prune(now);
    }

    // ---- Link states.

    pub(super) fn handle_link_state(&mut self, link: LinkId, signed: SignedBody) {
        let Some(from) = self.bringer(link).filter(|_| link != LinkId::LOCAL) else { return };
        let now = self.now;
        let digest = signed_digest(&signed);
        match self.topology.recognise(&digest) {
            topology::Recognised::New => {}
            topology::Recognised::InForce => return,
            topology::Recognised::Ended { node, seq } => return self.stale_link_state(link, &node, seq),
        }
        if !self.may_bring(link) {
            return;
        }
        let verified = match verify_link_state(&self.config.anchors, &signed, now.unix) {
            Ok(verified) => verified,
            Err(why) => return self.not_verified(link, "link state", why),
        };
        match self.topology.admit(now, from, signed, digest, verified) {
            topology::Admission::Own => {}
            topology::Admission::OwnStale => self.charge_stale(link),
            topology::Admission::Stale { node, seq } => {
                self.charge_stale(link);
                self.stale_link_state(link, &node, seq);
            }
            topology::Admission::Refused(reason) => {
                self.charge_stale(link);
                self.drop_frame(link, reason);
            }
            topology::Admission::Ended(why) => self.not_verified(link, "link state", why),
            topology::Admission::Admitted { node, floor } => {
                self.void_names(&node, floor);
                if node != from.node {
                    self.supersede_runs_before(&node, floor);
                }
                self.pass_on_node_or_wait(link, &node);
                self.store_link_state(&node);
            }
        }
    }

    /// Answers an old link state of a node: if it comes from the node itself, the node should learn the newer number.
    fn stale_link_state(&mut self, link: LinkId, node: &NodeId, seq: u64) {
        let known = self.topology.known_seq(node).unwrap_or(seq);
        if self.links.leads_to(link, node)
            && let Some((_, newer)) = self.topology.newest(node).filter(|(newer, _)| *newer > seq)
        {
            let signed = newer.clone();
            self.send(link, Control::LinkState { signed });
        }
        self.drop_frame(link, DropReason::Stale { seq, known });
    }

    /// Closes the links of earlier runs of a node whose latest run is linked to another router.
    fn supersede_runs_before(&mut self, node: &NodeId, floor: u64) {
        for EarlierRun { link, alive } in self.links.runs_before(node, floor) {
            self.supersede(link, None, alive);
        }
    }

    /// Passes on a new link state, now or when the allowance of its node permits.
    fn pass_on_node_or_wait(&mut self, link: LinkId, node: &NodeId) {
        let now = self.now.instant;
        if self.allowances.node(now, node).may_announce(now) {
            self.tell_link_state(link, node);
        } else {
            self.charge_stale(link);
            self.topology.wait(*node);
            self.late_at.get_or_insert(now + LATE_EVERY);
        }
    }

    /// Signs this node's link state, if that is due, and sends it to all neighbouring routers.
    pub(super) fn originate_due(&mut self) {
        let links = &self.links;
        if self.topology.originate_due(self.now, &self.config.identity, || links.neighbours()) {
            let node = self.config.node;
            self.tell_link_state(LinkId::LOCAL, &node);
        }
    }

    /// Passes on a link state: a router's to all routers, others as the mapping says.
    fn tell_link_state(&mut self, ingress: LinkId, node: &NodeId) {
        let now = self.now;
        let record = self.topology.node(node).filter(|record| verifies_elsewhere(now, record.issued_at()));
        let Some(record) = record else { return };
        let (everyone, signed) = (record.is_transit() || *node == self.config.node, record.signed().clone());
        let everyone = everyone || self.names.tells_unasked();
        let is_told = |link: &LinkId| *link != ingress && (everyone || self.names.follows(*link, node));
        for link in self.links.routers().filter(is_told).collect::<Vec<_>>() {
            self.send(link, Control::LinkState { signed: signed.clone() });
        }
    }

    // ---- Announcements that waited.

    /// Passes on announcements that waited for the allowance of their signer.
    pub(super) fn pass_on_late(&mut self) {
        let now = self.now.instant;
        if self.late_at.take_if(|at| *at <= now).is_none() {
            return;
        }
        for node in self.topology.take_waiting() {
            if self.allowances.node(now, &node).may_announce(now) {
                self.tell_link_state(LinkId::LOCAL, &node);
            } else {
                self.topology.wait(node);
            }
        }
        self.names_part(|names, cx| names.tell_late(cx));
        if self.topology.has_waiting() || self.names.has_waiting() {
            self.late_at = Some(now + LATE_EVERY);
        }
    }

    // ---- Routes.

    /// Searches for routes, and updates everything that takes another route now.
    pub(super) fn search(&mut self) {
        if !self.config.transit {
            self.topology.skip_search();
            let names = self.names.watched().chain(self.trees.names()).copied().collect();
            return self.check_next_hops(names);
        }
        let owners = self.topology.search(self.now.instant);
        self.check_next_hops(self.used_names_of(&owners));
        self.names_part(|names, cx| names.answer_asks(cx, &owners));
    }

    /// Returns the names of these owners that somebody uses. Names without an advertisement have no route before or after.
    /// Owners can have many names and a router few that are used, or the other way round.
    fn used_names_of(&self, owners: &BTreeSet<NodeId>) -> BTreeSet<Name> {
        if self.names.watched_len() + self.trees.names_len() < self.names.count_of(owners) {
            let is_theirs =
                |name: &&Name| self.names.owner(name).is_some_and(|owner| owners.contains(&owner.node_id));
            return self.names.watched().chain(self.trees.names()).filter(is_theirs).copied().collect();
        }
        let is_used = |name: &&Name| self.names.is_watched(name) || self.trees.contains(name);
        owners.iter().flat_map(|owner| self.names.names_of(owner).filter(is_used)).copied().collect()
    }

    fn check_next_hops(&mut self, names: BTreeSet<Name>) {
        self.topology.count_checked(names.len());
        self.routes_changed(&names.into_iter().collect::<Vec<_>>());
    }

    /// Updates trees and interested neighbours after the routes to these names may have changed.
    pub(super) fn routes_changed(&mut self, names: &[Name]) {
        if names.is_empty() {
            return;
        }
        for name in names {
            let network = super::Network { links: &self.links, topology: &self.topology };
            self.names.select(network, name);
            if self.trees.contains(name) {
                let next_hop = self.names.next_hop(network, name).map(|(link, _)| link);
                let is_known = self.names.owner(name).is_some();
                let effects = self.trees.follow(self.now.instant, name, is_known, next_hop);
                self.perform(effects);
            }
        }
        self.names_part(|part, cx| part.routes_changed(cx, names));
    }
}
