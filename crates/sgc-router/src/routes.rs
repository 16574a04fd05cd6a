//! Routes: which neighbour is on the way to the owner of a name, and who is told of it.

use std::collections::BTreeSet;
use std::sync::Arc;
use std::time::Duration;

use sgc_trust::{CLOCK_SKEW_MAX, verify_advert};
use sgc_wire::{Control, HOP_LIMIT, NAMES_PER_FRAME_MAX, Name, Now, RejectReason, Signed};

use crate::rib::{AdvertRecord, NameState, Route};
use crate::router::{DropReason, LinkId, Output, Router};

/// What choosing a route anew came to.
pub(crate) enum Selection {
    /// The link in use is the same, or there still is none.
    Same,
    /// There was a route and there is none.
    Lost,
    /// Another link is in use.
    Moved,
}

impl Router {
    /// Tells a router that just greeted what is reachable here, each advertisement once.
    pub(crate) fn send_routes(&mut self, link: LinkId) {
        let mut sent = BTreeSet::new();
        let mut frames = Vec::new();
        for route in self.names.values().filter_map(NameState::route) {
            if self.may_tell(route, link) && sent.insert(Arc::as_ptr(&route.advert)) {
                frames.extend(self.route_frames(route));
            }
        }
        for frame in frames {
            self.send(link, frame);
        }
    }

    /// Asks a neighbour for the names that are wanted here.
    pub(crate) fn send_interests(&mut self, link: LinkId) {
        if self.config.transit {
            return; // a router is told everything
        }
        let wanted: Vec<_> = self.links[&LinkId::LOCAL].interests.iter().copied().collect();
        for names in wanted.chunks(NAMES_PER_FRAME_MAX) {
            self.send(link, Control::Interest { names: names.to_vec() });
        }
    }

    /// True if `route` may be told over `link`: not back where it came from, and others' names only by routers.
    pub(crate) fn may_tell(&self, route: &Route, link: LinkId) -> bool {
        route.link != link && (route.link == LinkId::LOCAL || link == LinkId::LOCAL || self.config.transit)
    }

    pub(crate) fn handle_advert(&mut self, now: Now, link: LinkId, hops: u8, signed: Signed) {
        // Data must reach wherever a route does; a packet that comes with its last hop goes no further.
        if hops >= HOP_LIMIT - 1 {
            return self.drop_frame(link, DropReason::HopLimit);
        }
        let advert = match verify_advert(&self.config.anchors, &signed, now.unix) {
            Ok(advert) => advert,
            Err(why) => {
                return self.not_verified(now, link, "advertisement", why);
            }
        };
        let Some(state) = self.links.get(&link) else { return };
        let owner = advert.owner.node_id;
        if !state.is_transit() && (owner != state.node || hops != 0) {
            return self.drop_frame(link, DropReason::NotOwner { owner });
        }
        let seq = advert.body.seq;
        let lease = Duration::from_millis(advert.body.lease_ms.into()).min(self.config.limits.lease_max);
        let expires = now.instant + lease;
        let withdraw = advert.body.withdraw;
        let record = Arc::new(AdvertRecord { owner: advert.owner, seq, names: advert.names, signed });
        let mut news = Vec::new();
        let mut elsewhere = Vec::new();
        let mut stale = None;
        for name in record.names.iter().copied() {
            let known = self.known_seq(name);
            if withdraw {
                if known.is_none_or(|k| seq > k) {
                    if self.withdraw(now, name, seq) {
                        news.push(name);
                    }
                } else {
                    stale = known;
                }
                continue;
            }
            // The same advertisement over another link is another route; an older one is a replay or late.
            if known.is_some_and(|k| seq < k) || self.tombstones.contains_key(&name) && known >= Some(seq) {
                stale = known;
                continue;
            }
            self.remove_tombstone(name);
            if !self.put_route(name, Route { link, hops, advert: record.clone(), expires }) {
                self.drop_frame(link, DropReason::Limit { what: "routes per link" });
                break;
            }
            let lost = matches!(self.reselect(name, None), Selection::Lost);
            if self.names.get_mut(&name).is_some_and(NameState::take_news) {
                let here = self.route(&name).is_some_and(|(up, _)| up == link);
                if here { &mut news } else { &mut elsewhere }.push(name);
            } else if lost {
                self.tell_unreach(name);
            }
        }
        if let Some(known) = stale {
            self.drop_frame(link, DropReason::Stale { seq, known });
        }
        if withdraw && !news.is_empty() {
            let route = Route { link, hops, advert: record, expires };
            self.flood(link, &news, &[advert_frame(&route)]);
        } else if !news.is_empty() {
            self.tell(&Route { link, hops, advert: record, expires }, &news);
        }
        for name in elsewhere {
            self.tell_route(name);
        }
    }

    /// The newest sequence number known of a name, withdrawn or not.
    pub(crate) fn known_seq(&self, name: Name) -> Option<u64> {
        let live = self.names.get(&name).and_then(NameState::newest_seq);
        live.max(self.tombstones.get(&name).map(|(seq, _)| *seq))
    }

    /// Passes an advertisement on: to all other routers, and to those who asked for one of `names`.
    pub(crate) fn flood(&mut self, ingress: LinkId, names: &[Name], frames: &[Control]) {
        let carries = ingress == LinkId::LOCAL || self.config.transit;
        let targets: Vec<_> = self
            .links
            .iter()
            .filter(|(l, s)| {
                **l != ingress
                    && s.hello.is_some()
                    && (carries || **l == LinkId::LOCAL)
                    && (s.is_transit() || names.iter().any(|n| s.interests.contains(n)))
            })
            .map(|(l, _)| *l)
            .collect();
        for link in targets {
            for frame in frames {
                self.send(link, frame.clone());
            }
        }
    }

    /// Forgets a withdrawn name and remembers that it was; false if it was not known.
    pub(crate) fn withdraw(&mut self, now: Now, name: Name, seq: u64) -> bool {
        self.remove_tombstone(name);
        if self.tombstones.len() >= self.config.limits.tombstones_max
            && let Some((_, oldest)) = self.forgets.pop_first()
        {
            self.tombstones.remove(&oldest);
        }
        let until = now.instant + 2 * CLOCK_SKEW_MAX;
        self.tombstones.insert(name, (seq, until));
        self.forgets.insert((until, name));
        let Some(state) = self.names.get(&name) else { return false };
        let links = state.route_links();
        for link in &links {
            self.remove_route(name, *link);
        }
        self.reselect(name, None);
        // The sequence number alone tells what is old.
        self.forget(name);
        !links.is_empty()
    }

    pub(crate) fn remove_tombstone(&mut self, name: Name) {
        if let Some((_, until)) = self.tombstones.remove(&name) {
            self.forgets.remove(&(until, name));
        }
    }

    pub(crate) fn handle_unreach(&mut self, link: LinkId, names: &[Name]) {
        for name in names {
            self.lose_route(*name, link);
        }
    }

    pub(crate) fn handle_interest(&mut self, link: LinkId, names: &[Name]) {
        // One advertisement speaks for many names; it is sent once.
        let mut sent = BTreeSet::new();
        for name in names {
            let Some(state) = self.links.get_mut(&link) else { return };
            if state.interests.len() >= self.config.limits.interests_per_link_max {
                return self.drop_frame(link, DropReason::Limit { what: "interests per link" });
            }
            if !state.interests.insert(*name) {
                continue;
            }
            let entry = self.names.entry(*name).or_default();
            entry.interested.insert(link);
            let known = entry.route().cloned();
            let told = known.filter(|r| self.may_tell(r, link));
            if let Some(route) = told.filter(|r| sent.insert(Arc::as_ptr(&r.advert))) {
                for frame in self.route_frames(&route) {
                    self.send(link, frame);
                }
            }
            if link == LinkId::LOCAL {
                self.ask(&Control::Interest { names: vec![*name] });
            }
        }
    }

    pub(crate) fn handle_uninterest(&mut self, link: LinkId, names: &[Name]) {
        for name in names {
            let Some(state) = self.links.get_mut(&link) else { return };
            if !state.interests.remove(name) {
                continue;
            }
            if let Some(entry) = self.names.get_mut(name) {
                entry.interested.remove(&link);
            }
            if link == LinkId::LOCAL {
                self.ask(&Control::Uninterest { names: vec![*name] });
            }
            self.tidy(*name);
        }
    }

    /// Sends an interest of this node to its neighbours; a router is told everything anyway.
    pub(crate) fn ask(&mut self, frame: &Control) {
        let targets: Vec<_> = self
            .links
            .iter()
            .filter(|(l, s)| **l != LinkId::LOCAL && s.hello.is_some() && !self.config.transit)
            .map(|(l, _)| *l)
            .collect();
        for link in targets {
            self.send(link, frame.clone());
        }
    }

    /// Removes the route over `link`, falls back on another, and tells whoever needs to know.
    pub(crate) fn lose_route(&mut self, name: Name, link: LinkId) {
        if !self.remove_route(name, link) {
            return;
        }
        match self.reselect(name, None) {
            Selection::Same => {}
            Selection::Lost => self.tell_unreach(name),
            Selection::Moved => self.tell_route(name),
        }
        self.tidy(name);
    }

    /// Chooses the route of a name anew. If the link in use changed, the tree over the old one is cut and its
    /// sinks are told, so that they join again.
    pub(crate) fn reselect(&mut self, name: Name, must: Option<LinkId>) -> Selection {
        let Some(state) = self.names.get_mut(&name) else { return Selection::Same };
        let Some(before) = state.select(must) else { return Selection::Same };
        let moved = state.route().is_some();
        let cut = std::mem::take(&mut state.branches);
        if cut.values().any(|b| b.pending.is_none()) {
            self.refresh_fib(name);
        }
        for (sink, branch) in cut {
            self.detach(name, sink, &branch);
            self.send(branch.link, Control::Reject { name, sink, reason: RejectReason::RouteLost });
            if let Some(old) = before {
                self.send(old, Control::Leave { name, sink });
            }
        }
        if moved { Selection::Moved } else { Selection::Lost }
    }

    /// Tells everyone who was told of a route to `name` that there is none.
    pub(crate) fn tell_unreach(&mut self, name: Name) {
        let targets: Vec<_> = self
            .links
            .iter()
            .filter(|(_, s)| s.hello.is_some() && (s.is_transit() || s.interests.contains(&name)))
            .map(|(l, _)| *l)
            .collect();
        for link in targets {
            let names = self.unreached.entry(link).or_default();
            names.push(name);
            if names.len() >= NAMES_PER_FRAME_MAX {
                self.flush_unreached(link);
            }
        }
    }

    /// Sends what [`Self::tell_unreach`] gathered for a link.
    pub(crate) fn flush_unreached(&mut self, link: LinkId) {
        if let Some(names) = self.unreached.remove(&link)
            && self.links.contains_key(&link)
        {
            self.outputs.push_back(Output::Send { link, frame: Control::Unreach { names } });
        }
    }

    /// Tells the route now in use, after another one was lost.
    pub(crate) fn tell_route(&mut self, name: Name) {
        let Some(state) = self.names.get_mut(&name) else { return };
        state.take_news();
        let Some(route) = state.route().cloned() else { return };
        self.tell(&route, &[name]);
    }

    /// Tells `route`, which `names` now use. Its advertisement speaks for more names than those; whatever it says
    /// of them must be true, or routes could go in a circle: so they take the same route, unless they are told
    /// better already.
    pub(crate) fn tell(&mut self, route: &Route, names: &[Name]) {
        // Names that had to move to yet another link, whose advertisements speak for further names in turn: a
        // list and not a recursion, since a peer decides how long the chain gets.
        let mut todo = vec![(route.clone(), names.to_vec())];
        while let Some((route, names)) = todo.pop() {
            let (link, seq) = (route.link, route.advert.seq);
            let tells_all = link == LinkId::LOCAL || self.config.transit;
            for name in route.advert.names.iter().copied().filter(|_| tells_all) {
                if !self.names.get_mut(&name).is_some_and(|s| s.promise(seq, route.distance())) {
                    continue;
                }
                match self.reselect(name, Some(link)) {
                    Selection::Same => {}
                    Selection::Lost => self.tell_unreach(name),
                    Selection::Moved => {
                        let Some(state) = self.names.get_mut(&name) else { continue };
                        let news = state.take_news();
                        if let Some(other) = state.route().filter(|r| news && r.link != link) {
                            todo.push((other.clone(), vec![name]));
                        }
                    }
                }
            }
            self.flood(link, &names, &self.route_frames(&route));
        }
    }

    /// The frames that tell a route: its advertisement, and which of its names are out of reach from here by now.
    pub(crate) fn route_frames(&self, route: &Route) -> Vec<Control> {
        let known = |name: &Name| self.names.get(name).is_some_and(|s| s.route().is_some());
        let gone: Vec<_> = route.advert.names.iter().copied().filter(|n| !known(n)).collect();
        let unreach = (!gone.is_empty()).then_some(Control::Unreach { names: gone });
        std::iter::once(advert_frame(route)).chain(unreach).collect()
    }

    /// Adds a route; false if the link has too many.
    pub(crate) fn put_route(&mut self, name: Name, route: Route) -> bool {
        let Some(link) = self.links.get_mut(&route.link) else { return false };
        let limits = &self.config.limits;
        let max = match (route.link, link.is_transit()) {
            (LinkId::LOCAL, _) => usize::MAX,
            (_, true) => limits.routes_per_router_max,
            (_, false) => limits.routes_per_proxy_max,
        };
        let entry = self.names.entry(name).or_default();
        let old = entry.route_over(route.link).map(|r| r.expires);
        if old.is_none() && link.routes >= max {
            self.tidy(name);
            return false;
        }
        if let Some(old) = old {
            self.expiries.remove(&(old, name, route.link));
        }
        self.expiries.insert((route.expires, name, route.link));
        link.names.insert(name);
        if entry.put_route(route) {
            link.routes += 1;
        }
        if let Some(until) = entry.resume() {
            self.memories.remove(&(until, name));
        }
        true
    }

    /// Removes the route over `link`; true if there was one. The caller selects anew.
    pub(crate) fn remove_route(&mut self, name: Name, link: LinkId) -> bool {
        let Some(entry) = self.names.get_mut(&name) else { return false };
        let Some(route) = entry.remove_route(link) else { return false };
        self.expiries.remove(&(route.expires, name, link));
        if entry.remember(route.expires) {
            let full = self.memories.len() >= self.config.limits.tombstones_max;
            let oldest = self.memories.first().filter(|_| full).map(|(_, oldest)| *oldest);
            self.memories.insert((route.expires, name));
            if let Some(oldest) = oldest {
                self.forget(oldest);
            }
        }
        if let Some(state) = self.links.get_mut(&link) {
            state.routes -= 1;
        }
        self.release(name, link);
        true
    }

    /// Forgets what was told of a name that has no route.
    pub(crate) fn forget(&mut self, name: Name) {
        if let Some(until) = self.names.get_mut(&name).and_then(NameState::forget) {
            self.memories.remove(&(until, name));
        }
        self.tidy(name);
    }
}

fn advert_frame(route: &Route) -> Control {
    Control::Advert { hops: route.distance(), signed: route.advert.signed.clone() }
}
