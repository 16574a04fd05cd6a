//! Telling names: routers, all or those that asked, and links with an interest.

use std::collections::{BTreeMap, BTreeSet};

use sgc_wire::{Control, NAMES_PER_FRAME_MAX, Name, NodeId, Now};

use super::{Demand, Names, RecordId};
use crate::context::Context;
use crate::drops::DropReason;
use crate::lease::verifies_elsewhere;
use crate::limits::QUERY_EVERY;
use crate::limits::allowances::Turn;
use crate::link_id::LinkId;
use crate::links::cost::{COST_SUSPECT, cost_differs};
use crate::topology::NodeRecord;

impl Names {
    // ---- Routers.

    /// Passes on a record that came over `ingress`: to all routers, or to those that asked.
    pub(crate) fn tell_routers(
        &mut self,
        cx: &mut Context<'_>,
        ingress: LinkId,
        owner: &NodeId,
        id: RecordId,
    ) {
        let own = *owner == self.own;
        // A record in force speaks for at least one name.
        if self.records.get(id).is_none() || !(self.transit || own) {
            return;
        }
        let everyone = if self.transit { self.mapping.tells_unasked() } else { own };
        let names = if everyone { Vec::new() } else { self.records.live_names(id) };
        let is_told = |link: &LinkId| {
            let asked = || {
                self.questions.follows(*link, owner)
                    || names.iter().any(|name| self.questions.asks(*link, name))
            };
            *link != ingress && (everyone || asked())
        };
        let targets: Vec<_> = cx.network.links.routers().filter(is_told).collect();
        for link in targets {
            if !everyone {
                self.answer(cx, link, owner, &names);
            }
            for frame in self.records.frames(cx.now, id, 0) {
                cx.send(link, frame);
            }
        }
    }

    /// Tells a router that asked the owner's place, now and after each change.
    pub(super) fn answer(&mut self, cx: &mut Context<'_>, link: LinkId, owner: &NodeId, names: &[Name]) {
        if !cx.network.links.contains(link) {
            return;
        }
        let now = cx.now;
        let new = self.questions.follow(now.instant, link, owner, names);
        // All routers are known to it, and it learns of changes because it follows the owner.
        let is_told = |r: &&NodeRecord| new && !r.is_transit() && verifies_elsewhere(now, r.issued_at());
        if let Some(record) = cx.network.topology.node(owner).filter(is_told) {
            let signed = record.signed().clone();
            cx.send(link, Control::LinkState { signed });
        }
    }

    /// Tells a router the record of a name.
    pub(super) fn tell_record(&self, cx: &mut Context<'_>, link: LinkId, name: &Name) {
        if let Some(id) = self.records.id(name) {
            for frame in self.records.frames(cx.now, id, 0) {
                cx.send(link, frame);
            }
        }
    }

    /// Answers open questions for the names of these owners.
    pub(crate) fn answer_asks(&mut self, cx: &mut Context<'_>, owners: &BTreeSet<NodeId>) {
        let links =
            cx.network.links.iter().map(|(link, state)| (link, self.questions.asked_by(state.node())));
        let waiting: Vec<_> = links.filter(|(_, asked)| *asked > 0).collect();
        let asked: usize = waiting.iter().map(|(_, asked)| asked).sum();
        let mut open = Vec::new();
        if asked < self.records.count_of(owners) {
            for (link, _) in waiting {
                let named = self
                    .questions
                    .asked_over(link)
                    .filter_map(|name| Some((self.owner(name)?.node_id, *name)));
                open.extend(
                    named
                        .filter(|(owner, _)| owners.contains(owner))
                        .map(|(owner, name)| (link, owner, name)),
                );
            }
        } else {
            for owner in owners {
                for name in self.records.names_of(owner) {
                    let by = waiting.iter().filter(|(link, _)| self.questions.asks(*link, name));
                    open.extend(by.map(|(link, _)| (*link, *owner, *name)));
                }
            }
        }
        for (link, owner, name) in open {
            if self.next_hop(cx.network, &name).is_none_or(|(next_hop, _)| next_hop == link) {
                continue;
            }
            self.answer(cx, link, &owner, &[name]);
            self.tell_record(cx, link, &name);
        }
    }

    /// Tells a router on the route the owner's record, which it needs before it can take a request for a name.
    pub(crate) fn introduce(&mut self, cx: &mut Context<'_>, link: LinkId, name: &Name) {
        if self.mapping.tells_unasked() || !self.transit || !cx.network.links.is_router(link) {
            return;
        }
        let Some(owner) = self.owner(name).map(|owner| owner.node_id) else { return };
        self.answer(cx, link, &owner, &[]);
        self.tell_record(cx, link, name);
    }

    /// Returns the number of the next record.
    pub(crate) fn next_id(&self) -> RecordId {
        self.records.next_id()
    }

    /// Returns the next record, between two numbers, for a router that did not ask: those of this node, and if the
    /// mapping says so all.
    pub(crate) fn next_for_router(&self, now: Now, from: RecordId, end: RecordId) -> Option<RecordId> {
        let all = self.transit && self.mapping.tells_unasked();
        self.records.next_for_router(now.instant, from, end, all)
    }

    /// Returns the frames of a record for a router.
    pub(crate) fn frames(&self, now: Now, id: RecordId) -> Vec<Control> {
        self.records.frames(now, id, 0)
    }

    // ---- Records that wait for the allowance of their owner.

    /// Lets a record wait.
    pub(crate) fn wait(&mut self, owner: &NodeId, id: RecordId) {
        self.records.wait(owner, id);
    }

    /// Returns `true` if a record waits.
    pub(crate) fn has_waiting(&self) -> bool {
        self.records.has_waiting()
    }

    /// Passes on the records that waited for the allowance of their owners.
    pub(crate) fn tell_late(&mut self, cx: &mut Context<'_>) {
        let now = cx.now.instant;
        for owner in self.records.waiting() {
            while let Some((id, from)) = self.records.first_waiting(&owner) {
                if !cx.allowance(&owner).may_announce(now) {
                    break;
                }
                self.records.waits_no_more(&owner, id);
                self.tell_routers(cx, from, &owner, id);
            }
        }
    }

    // ---- Links with an interest.

    /// Takes an interest of a link.
    pub(crate) fn add_interests(&mut self, cx: &mut Context<'_>, link: LinkId, names: &[Name]) {
        let Some(peer) = cx.network.links.peer(link) else { return };
        let now = cx.now.instant;
        if link != LinkId::LOCAL && !cx.allowance(&peer.node).may_query(now, names.len(), peer.is_router) {
            return cx.drop_frame(link, DropReason::Limit { what: "names asked for per second" });
        }
        let others = cx.network.links.of_node(&peer.node).filter(|l| *l != link);
        let others: usize = others.map(|link| self.interests.len(link)).sum();
        let mut news = Vec::new();
        for name in names {
            if self.interests.contains(link, name) {
                continue;
            }
            if others + self.interests.len(link) >= self.limits.interests_per_peer_max {
                cx.drop_frame(link, DropReason::Limit { what: "interests of a node" });
                break;
            }
            self.interests.add(link, *name);
            news.push(*name);
        }
        if link == LinkId::LOCAL && !self.transit && !news.is_empty() {
            send_to_neighbours(cx, &Control::Interest { names: news.clone() });
        }
        self.tell_interested(cx, link, &news);
        if self.transit {
            for name in news {
                self.ask_for_interest(cx, name);
            }
        }
    }

    /// Asks all routers for a name that somebody here just asked for, unless it is known well enough.
    fn ask_for_interest(&mut self, cx: &mut Context<'_>, name: Name) {
        let now = cx.now.instant;
        let is_late = |name: &Name| {
            self.records.of_name(name).is_some_and(|record| {
                let is_late = record.asked().is_some() || record.renewal_due() <= now;
                is_late && record.owner_id() != self.own
            })
        };
        let needs = self.next_hop(cx.network, &name).is_none() || is_late(&name);
        // Another waiting node may have an earlier turn, behind many others.
        let due = self.questions.due(&name);
        if needs && due.is_none_or(|at| at > now + QUERY_EVERY) {
            let turn = self.turn(cx, &name, Turn::First);
            self.questions.ask_again(name, due.map_or(turn, |at| at.min(turn)));
        }
    }

    /// Ends interests of a link.
    pub(crate) fn remove_interests(&mut self, cx: &mut Context<'_>, link: LinkId, names: &[Name]) {
        for name in names {
            self.unwatch(cx, link, name);
        }
        if link == LinkId::LOCAL && !self.transit {
            send_to_neighbours(cx, &Control::Uninterest { names: names.to_vec() });
        }
    }

    /// Asks a neighbour that just greeted for the wanted names.
    pub(crate) fn send_interests(&self, cx: &mut Context<'_>, link: LinkId) {
        if self.transit {
            return;
        }
        for names in self.interests.names(LinkId::LOCAL).chunks(NAMES_PER_FRAME_MAX) {
            cx.send(link, Control::Interest { names: names.to_vec() });
        }
    }

    /// Hands a withdrawal to the links that were told of one of the names.
    pub(crate) fn tell_withdrawal(
        &mut self,
        cx: &mut Context<'_>,
        ingress: LinkId,
        id: RecordId,
        names: &[Name],
    ) {
        let Some(record) = self.records.get(id) else { return };
        for link in self.interests.take_told(ingress, names) {
            cx.send(link, Control::Advert { cost: 0, signed: record.signed().clone() });
        }
    }

    /// Tells interested neighbours after the routes to these names may have changed, and asks for lost names.
    pub(crate) fn routes_changed(&mut self, cx: &mut Context<'_>, names: &[Name]) {
        if self.interests.is_empty() {
            return;
        }
        let mut watched = BTreeMap::<LinkId, Vec<Name>>::new();
        for name in names {
            for link in self.interests.watchers(name) {
                watched.entry(link).or_default().push(*name);
            }
        }
        for (link, names) in watched {
            self.tell_interested(cx, link, &names);
        }
        if self.transit {
            let waited = names.iter().filter(|n| self.interests.is_watched(n));
            let lost: Vec<_> = waited
                .filter(|n| self.questions.due(n).is_none() && self.next_hop(cx.network, n).is_none())
                .copied()
                .collect();
            for name in lost {
                let turn = self.turn(cx, &name, Turn::First);
                self.questions.ask_again(name, turn);
            }
        }
    }

    /// Lets the time begin in which the node of a link finds the names among these that it did not want so far.
    pub(crate) fn begin_interests(&mut self, link: LinkId, names: &[Name]) {
        for name in names.iter().filter(|name| !self.interests.contains(link, name)) {
            self.withheld.forget(link, name);
        }
    }

    /// Withholds a name of this node from a direct link, or tells it there again.
    pub(crate) fn withhold(&mut self, cx: &mut Context<'_>, link: LinkId, name: Name, demand: Demand) {
        if self.withheld.set(cx.now.instant, (link, name), demand) {
            self.tell_interested(cx, link, &[name]);
        }
    }

    /// Tells over a link the names that were withheld from it.
    pub(crate) fn end_withholding(&mut self, cx: &mut Context<'_>, link: LinkId) {
        self.withheld.forget_link(link);
        let names = self.interests.names(link);
        self.tell_interested(cx, link, &names);
    }

    /// Tells names after all to nodes that did not find another path to them in time.
    pub(crate) fn release_withheld(&mut self, cx: &mut Context<'_>) {
        for (link, name) in self.withheld.release_due(cx.now.instant) {
            if self.interests.contains(link, &name) {
                self.tell_interested(cx, link, &[name]);
            } else {
                self.withheld.forget(link, &name);
            }
        }
    }

    /// Tells a neighbour the names of its interest again, because it did not believe the last records.
    pub(crate) fn tell_interested_again(&mut self, cx: &mut Context<'_>, link: LinkId) {
        self.interests.forget_told(link);
        let names = self.interests.names(link);
        self.tell_interested(cx, link, &names);
    }

    /// Tells an interested neighbour the names of its interest if their cost changed with the loss of the link.
    pub(crate) fn loss_changed(&mut self, cx: &mut Context<'_>, link: LinkId) {
        let names = self.interests.names(link);
        self.tell_interested(cx, link, &names);
    }

    /// Tells an interested neighbour the news of these names: each advertisement once.
    fn tell_interested(&mut self, cx: &mut Context<'_>, link: LinkId, names: &[Name]) {
        // The neighbour measures the packets that it sends, and these are the others.
        let of_loss = cx.network.links.cost_of_loss(link);
        let mut adverts = BTreeMap::new();
        let mut gone = Vec::new();
        for name in names {
            let Some(told) = self.interests.told(link, name) else { continue };
            let is_told = |next_hop| self.may_tell(next_hop, link) && !self.withheld.contains(link, name);
            let next_hop = self.next_hop(cx.network, name).filter(|(next_hop, _)| is_told(*next_hop));
            let next_hop = next_hop.map(|(next_hop, cost)| (next_hop, cost.saturating_add(of_loss)));
            let id = self.records.id(name);
            let news = match (told, next_hop.zip(id)) {
                (None, None) => continue,
                (Some(_), None) => {
                    gone.push(*name);
                    None
                }
                (Some((known, old)), Some(((_, new), id))) if known == id && !cost_differs(old, new) => {
                    continue;
                }
                (_, Some(((_, cost), id))) => {
                    adverts.insert(id, cost);
                    Some((id, cost))
                }
            };
            self.interests.tell(link, name, news);
        }
        for (id, cost) in adverts {
            for frame in self.records.frames(cx.now, id, cost.min(COST_SUSPECT)) {
                cx.send(link, frame);
            }
            // The record speaks for names that are withheld, too.
            let spoken_for = self.records.live_names(id).into_iter();
            let is_withheld =
                |name: &Name| self.withheld.contains(link, name) && self.interests.contains(link, name);
            gone.extend(spoken_for.filter(is_withheld));
        }
        gone.sort_unstable();
        gone.dedup();
        for names in gone.chunks(NAMES_PER_FRAME_MAX) {
            cx.send(link, Control::Unreach { names: names.to_vec() });
        }
    }

    /// Returns `true` if a name may be told over `link`: not back where it is, and others' names only by routers.
    fn may_tell(&self, next_hop: LinkId, link: LinkId) -> bool {
        next_hop != link && (next_hop == LinkId::LOCAL || link == LinkId::LOCAL || self.transit)
    }
}

/// Sends a frame to all neighbours that have greeted.
fn send_to_neighbours(cx: &mut Context<'_>, frame: &Control) {
    let targets: Vec<_> = cx.network.links.greeted().map(|(link, _)| link).collect();
    for link in targets {
        cx.send(link, frame.clone());
    }
}
