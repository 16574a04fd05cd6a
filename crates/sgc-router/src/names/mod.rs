//! [`Names`]: the owners of names, the routes to them, and the nodes to tell.
//!
//! The record of a name does not depend on links: an advertisement names its owner, and the topology has the owner's
//! place. So a robot that moves changes one entry, and a link that breaks none. A node that carries nobody else's names
//! sees no topology; it relies on its routers.
//!
//! This part verifies nothing: the router does that first. Methods return the names whose routes may have changed, and
//! the router lets the trees follow.

mod ask;
mod heard;
mod interests;
mod questions;
mod record;
mod records;
mod tell;
mod withheld;

use std::collections::BTreeSet;
use std::sync::Arc;
use std::time::Instant;

use sgc_trust::{CLOCK_SKEW_MAX, CertId, SignedError, VerifiedAdvert, VerifiedPeer};
use sgc_wire::{Control, Name, NodeId, SignedBody};

use self::heard::Heard;
use self::interests::Interests;
use self::questions::Questions;
use self::record::NewRecord;
pub(crate) use self::record::{Record, RecordEnd, RecordId, RecordKind};
use self::records::Records;
pub(crate) use self::withheld::Demand;
use self::withheld::Withheld;
use crate::config::RouterConfig;
use crate::context::Context;
use crate::drops::DropReason;
use crate::lease::lease_end;
use crate::limits::Limits;
use crate::link_id::LinkId;
use crate::links::{PathKind, Peer};
use crate::mapping::Mapping;
use crate::network::Network;

/// All records and routes of names.
#[derive(Debug)]
pub(crate) struct Names {
    own: NodeId,
    transit: bool,
    limits: Limits,
    mapping: Box<dyn Mapping>,
    records: Records,
    heard: Heard,
    interests: Interests,
    questions: Questions,
    /// Names that the store has and whose owners are out of reach: their new places may be on their way.
    unplaced: BTreeSet<Name>,
    /// Names of this node that are not told over a direct link, because more than one copy would pass the uplink.
    withheld: Withheld,
}

/// An announcement as its digest tells it.
#[derive(Debug)]
pub(crate) enum Recognised {
    /// It has to be verified.
    New,
    /// It is in force, with this number.
    Known { id: RecordId, owner: NodeId },
    /// It is no longer in force.
    Ended { owner: NodeId, seq: u64 },
}

/// A verified advertisement or withdrawal, and the link that brought it.
#[derive(Debug)]
pub(crate) struct Arrival {
    pub(crate) link: LinkId,
    pub(crate) from: Peer,
    pub(crate) cost: u32,
    pub(crate) signed: SignedBody,
    pub(crate) digest: [u8; 32],
    pub(crate) advert: VerifiedAdvert,
}

/// A record that was put into force.
#[derive(Debug)]
pub(crate) struct Admitted {
    pub(crate) id: RecordId,
    pub(crate) owner: NodeId,
    pub(crate) kind: RecordKind,
    /// Names whose routes may have changed.
    pub(crate) changed: Vec<Name>,
    /// The records that spoke for them before.
    pub(crate) before: NamesBefore,
}

/// The records that spoke for the names of a new one before.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum NamesBefore {
    /// At least one name has none.
    None,
    /// One with the same names.
    Same,
    /// One with other names.
    Other,
}

/// The consequence of a verified announcement.
#[derive(Debug)]
pub(crate) enum Admission {
    Admitted(Admitted),
    /// It changes nothing here, and whatever had to be said is said.
    Done,
    /// No time of its lease is left.
    Ended(SignedError),
}

impl Names {
    pub(crate) fn new(config: &RouterConfig) -> Self {
        let (own, limits) = (config.node, &config.limits);
        Self {
            own,
            transit: config.transit,
            limits: limits.clone(),
            mapping: config.mapping.build(),
            records: Records::new(own, config.transit, limits),
            heard: Heard::default(),
            interests: Interests::default(),
            questions: Questions::new(config.incarnation, limits),
            unplaced: BTreeSet::new(),
            withheld: Withheld::default(),
        }
    }

    // ---- Looking names up.

    /// Returns the owner of a name as its advertisement proved it.
    pub(crate) fn owner(&self, name: &Name) -> Option<&Arc<VerifiedPeer>> {
        self.records.of_name(name).map(Record::owner)
    }

    /// Iterates over the owners of records.
    #[cfg(test)]
    pub(crate) fn owners(&self) -> impl Iterator<Item = &NodeId> {
        self.records.owners()
    }

    /// Iterates over the names that the advertisements of an owner speak for.
    pub(crate) fn names_of(&self, owner: &NodeId) -> impl Iterator<Item = &Name> {
        self.records.names_of(owner)
    }

    /// Returns the number of names that the advertisements of these owners speak for.
    pub(crate) fn count_of(&self, owners: &BTreeSet<NodeId>) -> usize {
        self.records.count_of(owners)
    }

    /// Returns the number of names that some link wants to know of.
    pub(crate) fn watched_len(&self) -> usize {
        self.interests.watched_len()
    }

    /// Iterates over the names that some link wants to know of.
    pub(crate) fn watched(&self) -> impl Iterator<Item = &Name> {
        self.interests.watched()
    }

    /// Returns `true` if some link wants to know of the name.
    pub(crate) fn is_watched(&self, name: &Name) -> bool {
        self.interests.is_watched(name)
    }

    /// Returns `true` if a link is interested in a name of this node.
    pub(crate) fn wants_own(&self, link: LinkId) -> bool {
        self.interests.names(link).iter().any(|name| self.is_own(name))
    }

    /// Returns the names of this node in which a link is interested.
    pub(crate) fn own_wanted_by(&self, link: LinkId) -> Vec<Name> {
        self.interests.names(link).into_iter().filter(|name| self.is_own(name)).collect()
    }

    /// Returns `true` for a name of this node.
    pub(crate) fn is_own(&self, name: &Name) -> bool {
        self.owner(name).is_some_and(|owner| owner.node_id == self.own)
    }

    /// Returns `true` for a name that a link is interested in, or that a router waits for.
    pub(crate) fn is_awaited(&self, name: &Name) -> bool {
        self.interests.is_watched(name) || self.questions.is_open(name)
    }

    /// Returns `true` if an advertisement or withdrawal of this owner speaks for the name.
    pub(crate) fn is_announced_by(&self, name: &Name, owner: &NodeId) -> bool {
        self.records.last(name).is_some_and(|record| record.owner_id() == *owner)
    }

    /// Returns a record in force.
    pub(crate) fn record(&self, id: RecordId) -> Option<&Record> {
        self.records.get(id)
    }

    /// Returns the advertisement that speaks for a name.
    pub(crate) fn record_of(&self, name: &Name) -> Option<&Record> {
        self.records.of_name(name)
    }

    /// Returns the names that a record still speaks for.
    pub(crate) fn live_names(&self, id: RecordId) -> Vec<Name> {
        self.records.live_names(id)
    }

    /// Iterates over the records of some owners.
    pub(crate) fn records_of(&self, is_wanted: impl Fn(&NodeId) -> bool) -> impl Iterator<Item = RecordId> {
        self.records.of_owners(is_wanted)
    }

    /// Returns `true` if routers are told of names that they did not ask for.
    pub(crate) fn tells_unasked(&self) -> bool {
        self.mapping.tells_unasked()
    }

    /// Returns `true` if the router behind a link is told of changes of the owner, because it asked.
    pub(crate) fn follows(&self, link: LinkId, owner: &NodeId) -> bool {
        self.questions.follows(link, owner)
    }

    /// Returns the link towards the owner of `name`, and the cost of the route.
    pub(crate) fn next_hop(&self, network: Network<'_>, name: &Name) -> Option<(LinkId, u32)> {
        self.next_hop_to(network, name, &self.records.of_name(name)?.owner_id())
    }

    /// Returns the same for a name whose owner is at hand.
    pub(crate) fn next_hop_to(
        &self,
        network: Network<'_>,
        name: &Name,
        owner: &NodeId,
    ) -> Option<(LinkId, u32)> {
        if *owner == self.own {
            return Some((LinkId::LOCAL, 0));
        }
        if self.transit { network.next_hop_to(owner) } else { self.heard.next_hop(network.links, name) }
    }

    /// Lets only one kind of path count for a name, or any.
    pub(crate) fn require_path(&mut self, name: Name, kind: Option<PathKind>) {
        self.heard.require(name, kind);
    }

    /// Returns the number of names whose owners are in reach.
    pub(crate) fn routed(&self, network: Network<'_>) -> usize {
        let names = |record: &Record| {
            let owner = record.owner_id();
            if owner == self.own {
                record.live()
            } else if self.transit {
                network.next_hop_to(&owner).map_or(0, |_| record.live())
            } else {
                record.names().iter().filter(|name| self.next_hop(network, name).is_some()).count()
            }
        };
        self.records.adverts().map(names).sum()
    }

    /// Returns the number of names that are advertised, asked for or heard of.
    pub(crate) fn known(&self) -> usize {
        let others = self.interests.watched().chain(self.heard.names());
        let unknown: BTreeSet<_> = others.filter(|n| self.records.id(n).is_none()).collect();
        self.records.live() + unknown.len()
    }

    /// Returns the number of withdrawn names.
    pub(crate) fn tombstones(&self) -> usize {
        self.records.withdrawn()
    }

    /// Returns the times of the next timeouts.
    pub(crate) fn deadlines(&self) -> impl Iterator<Item = Instant> {
        self.records.deadlines().chain(self.questions.deadlines()).chain(self.withheld.deadline())
    }

    // ---- Announcements.

    /// Returns the record with this digest.
    pub(crate) fn recognise(&self, digest: &[u8; 32]) -> Recognised {
        if let Some((id, record)) = self.records.with_digest(digest) {
            return Recognised::Known { id, owner: record.owner_id() };
        }
        match self.records.ended(digest) {
            Some((owner, seq)) => Recognised::Ended { owner, seq },
            None => Recognised::New,
        }
    }

    /// Takes a verified announcement.
    pub(crate) fn admit(&mut self, cx: &mut Context<'_>, arrival: Arrival) -> Admission {
        let Some(news) = self.news(cx, &arrival) else { return Admission::Done };
        let Arrival { link, from, signed, digest, advert, .. } = arrival;
        let now = cx.now;
        let owner = advert.owner.node_id;
        let kind = if advert.body.withdraw { RecordKind::Withdrawal } else { RecordKind::Advert };
        if let Some(what) = self.records.over_limit(link, &owner, &news, kind) {
            cx.charge_stale(link);
            cx.drop_frame(link, DropReason::Limit { what });
            return Admission::Done;
        }
        let lease = lease_end(now, advert.body.lease_ms, self.limits.lease_max, &advert.owner);
        let expires = match (kind, lease) {
            (RecordKind::Withdrawal, _) => now.instant + 2 * CLOCK_SKEW_MAX,
            (RecordKind::Advert, Ok(expires)) => expires,
            (RecordKind::Advert, Err(why)) => return Admission::Ended(why),
        };
        // Owners announce changes unasked.
        let is_answer = kind == RecordKind::Advert
            && from.is_router
            && link != LinkId::STORE
            && news.iter().any(|n| self.questions.is_open(n));
        let before = self.records.names_before(&news, &advert.names);
        let record = NewRecord {
            owner: Arc::new(advert.owner),
            seq: advert.body.seq,
            kind,
            names: advert.names.into(),
            signed,
            issued_at: advert.body.issued_at,
            digest,
            expires,
            renewal_due: now.instant + expires.saturating_duration_since(now.instant) / 2,
            from: link,
            asked: is_answer.then_some(now.instant),
        };
        let known: Vec<_> = match kind {
            RecordKind::Withdrawal => news.iter().copied().filter(|n| self.records.id(n).is_some()).collect(),
            RecordKind::Advert => Vec::new(),
        };
        let id = self.insert(now.instant, record, &news);
        let changed = if kind == RecordKind::Withdrawal { known } else { news };
        Admission::Admitted(Admitted { id, owner, kind, changed, before })
    }

    /// Returns the names of a verified announcement that it has news of. Without any, whatever has to be said is said.
    fn news(&self, cx: &mut Context<'_>, arrival: &Arrival) -> Option<Vec<Name>> {
        let Arrival { link, from, cost, signed, advert, .. } = arrival;
        let (link, is_local) = (*link, *link == LinkId::LOCAL);
        let (owner, seq) = (advert.owner.node_id, advert.body.seq);
        if owner == self.own && !is_local {
            if self.records.newest(&owner).is_some_and(|(newest, _)| seq <= newest) {
                cx.charge_stale(link);
                self.answer_stale(cx, link, &owner, seq);
            } else {
                // This node's own record, perhaps of a run whose clock was ahead: its endpoint has to continue from
                // there.
                cx.send(LinkId::LOCAL, Control::Advert { cost: *cost, signed: signed.clone() });
            }
            return None;
        }
        if !from.is_router && owner != from.node {
            cx.charge_stale(link);
            cx.drop_frame(link, DropReason::NotOwner { owner });
            return None;
        }
        let floor = self.records.floor(&owner, cx.network.topology.floor(&owner));
        let is_news = |n: &Name| self.records.known_seq(n).is_none_or(|known| seq > known);
        // This node's own record is always the newest.
        let mut news: Vec<_> =
            advert.names.iter().copied().filter(|n| is_local || seq >= floor && is_news(n)).collect();
        if news.is_empty() {
            cx.charge_stale(link);
            self.answer_stale(cx, link, &owner, seq);
            return None;
        }
        if !self.transit && !is_local {
            // A node that carries nothing need not know names that nobody here wants.
            news.retain(|n| self.interests.is_watched(n));
            if news.is_empty() {
                cx.charge_stale(link);
                return None;
            }
        }
        Some(news)
    }

    fn insert(&mut self, now: Instant, record: NewRecord, names: &[Name]) -> RecordId {
        for name in names {
            match record.kind {
                RecordKind::Withdrawal => self.heard.remove(name),
                RecordKind::Advert => self.questions.answered(name),
            }
        }
        self.records.insert(now, record, names)
    }

    /// Answers an old advertisement: if it comes from the owner itself, the owner should learn the newer number.
    pub(crate) fn answer_stale(&self, cx: &mut Context<'_>, link: LinkId, owner: &NodeId, seq: u64) {
        let newest = self.records.newest(owner).filter(|(newest, _)| *newest > seq);
        let known = newest.map_or(seq, |(newest, _)| newest);
        if let Some((_, signed)) = newest
            && cx.network.links.leads_to(link, owner)
        {
            let signed = signed.clone();
            cx.send(link, Control::Advert { cost: 0, signed });
        }
        cx.drop_frame(link, DropReason::Stale { seq, known });
    }

    /// Voids the oldest records of an owner that has too many, and the oldest withdrawals of the owner with the most if
    /// there are too many in all. Returns the names that are no longer advertised.
    pub(crate) fn make_room(&mut self, now: Instant, owner: &NodeId) -> Vec<Name> {
        let mut gone = Vec::new();
        while let Some(oldest) = self.records.surplus_of_owner(owner) {
            gone.extend(self.forget(now, oldest, RecordEnd::Ended));
        }
        while let Some(oldest) = self.records.surplus_of_withdrawals() {
            self.forget(now, oldest, RecordEnd::Ended);
        }
        gone
    }

    /// Notes, at a node that relies on its routers, that the owner of a record is in reach over this link.
    pub(crate) fn hear(&mut self, now: Instant, link: LinkId, cost: u32, id: RecordId) -> Vec<Name> {
        if self.transit || link == LinkId::LOCAL {
            return Vec::new();
        }
        let Some(record) = self.records.get(id).filter(|record| !record.is_withdrawal()) else {
            return Vec::new();
        };
        let names: Vec<_> = record.names().iter().copied().filter(|n| self.interests.is_watched(n)).collect();
        for name in &names {
            // It may have been without interest when the record came.
            self.records.speak_for(now, id, name);
            self.heard.hear(name, link, cost);
        }
        names
    }

    /// Handles a neighbour's notice that it can no longer reach these names.
    pub(crate) fn unreach(&mut self, cx: &mut Context<'_>, link: LinkId, names: &[Name]) -> Vec<Name> {
        if self.transit {
            cx.drop_frame(link, DropReason::Unknown { what: "unreach" });
            return Vec::new();
        }
        names.iter().copied().filter(|name| self.heard.lose(name, link)).collect()
    }

    /// Notes the next hop of a name at a node that relies on its routers.
    pub(crate) fn select(&mut self, network: Network<'_>, name: &Name) {
        if !self.transit {
            let next_hop = self.next_hop(network, name).map(|(link, _)| link);
            self.heard.select(name, next_hop);
        }
    }

    // ---- Records that end.

    /// Ends a record. Returns the names that it still spoke for.
    pub(crate) fn forget(&mut self, now: Instant, id: RecordId, end: RecordEnd) -> Vec<Name> {
        let names = self.records.forget(now, id, end);
        for name in &names {
            self.heard.remove(name);
        }
        names
    }

    /// Returns the advertisements of an owner with numbers below `floor`: those of an earlier run.
    pub(crate) fn records_before(&self, owner: &NodeId, floor: u64) -> Vec<RecordId> {
        self.records.before(owner, floor)
    }

    /// Returns the records under certificates that are no longer believed.
    pub(crate) fn untrusted(&self, is_untrusted: impl Fn(&[CertId]) -> bool) -> Vec<RecordId> {
        self.records.untrusted(is_untrusted)
    }

    /// Ends one record whose lease is over. Returns the names whose routes may have changed.
    pub(crate) fn expire_next(&mut self, now: Instant) -> Option<Vec<Name>> {
        let id = self.records.take_expired(now)?;
        if self.records.get(id).is_some_and(Record::is_withdrawal) {
            // No advertisement that it voids verifies any more.
            self.forget(now, id, RecordEnd::Superseded);
            return Some(Vec::new());
        }
        Some(self.forget(now, id, RecordEnd::Ended))
    }

    /// Forgets the numbers of records that cannot verify any more, and questions that are over.
    pub(crate) fn prune(&mut self, now: Instant) {
        self.records.expire_memory(now);
        self.questions.prune(now);
    }

    /// Notes that a node's link state ended, with this floor.
    pub(crate) fn run_ended(&mut self, now: Instant, node: &NodeId, floor: u64) {
        self.records.run_ended(now, node, floor);
    }

    // ---- Links that come and go.

    /// Notes a link that is up.
    pub(crate) fn link_up(&mut self, link: LinkId) {
        self.records.link_up(link);
    }

    /// Forgets the interests and questions of a link that is gone.
    pub(crate) fn link_down(&mut self, cx: &Context<'_>, link: LinkId) {
        for name in self.interests.names(link) {
            self.unwatch(cx, link, &name);
        }
        self.questions.link_down(link);
        self.records.link_down(link);
        self.withheld.forget_link(link);
    }

    /// Forgets every route over a link. Returns their names.
    pub(crate) fn lose_link(&mut self, link: LinkId) -> Vec<Name> {
        self.heard.lose_link(link)
    }

    fn unwatch(&mut self, cx: &Context<'_>, link: LinkId, name: &Name) {
        if !self.interests.remove(link, name) {
            return;
        }
        self.withheld.forget(link, name);
        self.questions.stop_asking(name);
        self.unplaced.remove(name);
        let next_hop = |names: &Self| names.next_hop(cx.network, name);
        if !self.transit && next_hop(self).is_none_or(|(link, _)| link != LinkId::LOCAL) {
            self.heard.remove(name);
            self.records.forget_unwanted(cx.now.instant, name);
        }
    }
}

#[cfg(test)]
mod tests;
