//! Asking for names: questions that begin here, and those of other routers.

use std::collections::BTreeMap;
use std::time::{Duration, Instant};

use sgc_wire::{Control, HOP_LIMIT, NAMES_PER_FRAME_MAX, Name, NodeId};
use smallvec::SmallVec;

use super::Names;
use super::questions::{Asked, QUERY_AGAIN};
use crate::context::Context;
use crate::drops::DropReason;
use crate::limits::QUERY_EVERY;
use crate::limits::allowances::Turn;
use crate::link_id::LinkId;
use crate::mapping::{Ask, NameLocation};
use crate::store::{LookUpStart, Work};

/// Time for which the new place of an owner is waited for, before routers beside the store are asked for it.
const PLACE_WAIT: Duration = Duration::from_secs(2);

impl Names {
    /// Handles a question. The answer goes back over the link that brought the question first: copies over others are
    /// ignored, or every router would be told of every requested name.
    pub(crate) fn handle_query(
        &mut self,
        cx: &mut Context<'_>,
        link: LinkId,
        id: u64,
        hops: u8,
        names: &[Name],
    ) {
        let Some(peer) = cx.network.links.peer(link) else { return };
        if !self.transit || !peer.is_router {
            return cx.drop_frame(link, DropReason::NotRouter);
        }
        let now = cx.now.instant;
        if !cx.allowance(&peer.node).may_query(now, names.len(), true) {
            return cx.drop_frame(link, DropReason::Limit { what: "names asked for per second" });
        }
        self.questions.prune_later(now);
        let mut is_full = false;
        let (mut unknown, mut refresh) = (Vec::new(), BTreeMap::<LinkId, Vec<Name>>::new());
        for name in names {
            if self.questions.has_passed_on(name, id) {
                continue;
            }
            let next_hop = self.next_hop(cx.network, name).filter(|(next_hop, _)| *next_hop != link);
            if next_hop.is_some()
                && let Some(record) = self.records.of_name(name)
            {
                let (owner, from) = (record.owner_id(), record.link());
                let again = record.asked().filter(|at| *at + QUERY_AGAIN <= now).is_some();
                self.check_in_store(cx, name, &owner);
                self.answer(cx, link, &owner, &[*name]);
                self.tell_record(cx, link, name);
                if again && from != link {
                    refresh.entry(from).or_default().push(*name);
                    self.records.mark_asked(now, name);
                }
                continue;
            }
            match self.questions.ask(now, link, peer.node, *name) {
                Asked::PassOn => {
                    cx.look_up(*name);
                    unknown.push(*name);
                }
                Asked::UnderWay => {}
                Asked::TooMany => is_full = true,
            }
        }
        if is_full {
            cx.drop_frame(link, DropReason::Limit { what: "names asked for" });
        }
        if hops >= HOP_LIMIT - 1 {
            return cx.drop_frame(link, DropReason::HopLimit);
        }
        self.pass_on(cx, Some(link), id, hops + 1, &unknown);
        for (from, names) in refresh {
            cx.send(from, Control::Query { id, hops: hops + 1, names });
        }
    }

    /// Asks all routers but the asker.
    fn pass_on(&mut self, cx: &mut Context<'_>, asker: Option<LinkId>, id: u64, hops: u8, names: &[Name]) {
        if names.is_empty() {
            return;
        }
        let (now, links) = (cx.now.instant, cx.network.links);
        let by = asker.and_then(|link| links.peer(link)).map_or(self.own, |peer| peer.node);
        let (names, refused): (Vec<_>, Vec<_>) =
            names.iter().partition(|name| self.questions.pass_on(now, by, id, **name));
        if !refused.is_empty() {
            cx.drop_frame(asker.unwrap_or(LinkId::LOCAL), DropReason::QuestionsFull);
        }
        if names.is_empty() {
            return;
        }
        self.questions.prune_later(now);
        for link in links.routers().filter(|link| Some(*link) != asker) {
            for names in names.chunks(NAMES_PER_FRAME_MAX) {
                cx.send(link, Control::Query { id, hops, names: names.to_vec() });
            }
        }
    }

    /// Lets the store be searched for a name of a node that is attached here: another router did not find it there.
    fn check_in_store(&self, cx: &mut Context<'_>, name: &Name, owner: &NodeId) {
        if cx.network.links.is_attached(owner)
            && let Some(store) = &mut cx.store
        {
            store.add_work(Work::Check(*name));
        }
    }

    /// Asks other routers for names that somebody here waits for, if that is due.
    pub(crate) fn ask_due(&mut self, cx: &mut Context<'_>) {
        let now = cx.now.instant;
        let mut everyone = Vec::new();
        let mut one = BTreeMap::<LinkId, Vec<Name>>::new();
        while let Some(name) = self.questions.take_due(now) {
            let location = self.location(cx, &name);
            match self.mapping.ask(location) {
                Ask::Nobody => self.questions.stop_asking(&name),
                Ask::Everyone => {
                    if cx.look_up(name) == LookUpStart::Unavailable {
                        everyone.push(name);
                    }
                    let turn = self.turn(cx, &name, Turn::Again);
                    self.questions.ask_again(name, turn + QUERY_EVERY);
                }
                Ask::One(link) => {
                    one.entry(link).or_default().push(name);
                    self.questions.ask_again(name, now + QUERY_EVERY);
                }
            }
        }
        let id = self.questions.next_id();
        self.pass_on(cx, None, id, 0, &everyone);
        for (link, names) in one {
            for chunk in names.chunks(NAMES_PER_FRAME_MAX) {
                chunk.iter().for_each(|name| self.records.mark_asked(now, name));
                let id = self.questions.next_id();
                cx.send(link, Control::Query { id, hops: 0, names: chunk.to_vec() });
            }
        }
    }

    /// Notes that a name was found in the store. Returns `true` if other routers are to be asked all the same: its owner
    /// is out of reach, and was so a moment ago.
    pub(crate) fn found_in_store(&mut self, cx: &Context<'_>, name: Name) -> bool {
        let was_unplaced = self.unplaced.remove(&name);
        if was_unplaced || self.questions.due(&name).is_none() || self.next_hop(cx.network, &name).is_some() {
            return was_unplaced;
        }
        self.unplaced.insert(name);
        self.questions.ask_again(name, cx.now.instant + PLACE_WAIT);
        false
    }

    /// Asks all routers for names that the store does not have, or did not tell in time, if somebody here waits for
    /// them.
    pub(crate) fn ask_others(&mut self, cx: &mut Context<'_>, names: &[Name]) {
        let is_unknown = |name: &Name| {
            self.questions.due(name).is_some() && self.mapping.ask(self.location(cx, name)) == Ask::Everyone
        };
        let names: Vec<_> = names.iter().copied().filter(is_unknown).collect();
        let id = self.questions.next_id();
        self.pass_on(cx, None, id, 0, &names);
    }

    /// Returns `true` if a question is due.
    pub(crate) fn is_ask_due(&self, now: Instant) -> bool {
        self.questions.is_due(now)
    }

    fn location(&self, cx: &Context<'_>, name: &Name) -> NameLocation {
        let record = self.records.of_name(name).filter(|_| self.next_hop(cx.network, name).is_some());
        match record {
            None => NameLocation::Unknown,
            // A router that answered, or told the record unasked, may withhold a later one.
            Some(record) if record.renewal_due() <= cx.now.instant => NameLocation::Unknown,
            Some(record) => match record.asked() {
                Some(_) if cx.network.links.contains(record.link()) => NameLocation::Answered(record.link()),
                Some(_) => NameLocation::Unknown,
                None => NameLocation::Told,
            },
        }
    }

    /// Asks one router for its newest record of a name.
    pub(crate) fn ask_neighbour(&mut self, cx: &mut Context<'_>, link: LinkId, name: Name) {
        if self.transit && cx.network.links.is_router(link) {
            let id = self.questions.next_id();
            cx.send(link, Control::Query { id, hops: 0, names: vec![name] });
        }
    }

    /// Asks all routers for the wanted names of advertisements in the second half of their lease: owners renew after a
    /// third, so the router that told them may withhold the renewal.
    pub(crate) fn ask_for_renewals(&mut self, cx: &mut Context<'_>) {
        while let Some(id) = self.records.take_renewal(cx.now.instant) {
            let is_wanted = |n: &Name| self.interests.is_watched(n) && self.questions.due(n).is_none();
            let names: Vec<_> = self.records.live_names(id).into_iter().filter(is_wanted).collect();
            for name in names {
                let turn = self.turn(cx, &name, Turn::First);
                self.questions.ask_again(name, turn);
            }
        }
    }

    /// Returns the time at which all routers may be asked for a name on behalf of its waiting nodes: the first turn of
    /// any of them. This node's own endpoint need not wait.
    pub(super) fn turn(&self, cx: &mut Context<'_>, name: &Name, turn: Turn) -> Instant {
        let now = cx.now.instant;
        let watchers: SmallVec<[LinkId; 8]> = self.interests.watchers(name).collect();
        let mut first: Option<(Instant, NodeId, bool)> = None;
        for link in watchers {
            if link == LinkId::LOCAL || first.is_some_and(|(at, ..)| at <= now) {
                break;
            }
            let Some(peer) = cx.network.links.peer(link) else { continue };
            let at = cx.allowance(&peer.node).turns(turn).next(now, peer.is_router);
            if first.is_none_or(|(known, ..)| at < known) {
                first = Some((at, peer.node, peer.is_router));
            }
        }
        let Some((_, node, is_router)) = first else { return now };
        cx.allowance(&node).turns(turn).take(now, is_router)
    }
}
