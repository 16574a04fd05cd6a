//! Names: their owners, the routes to them, and the nodes to tell.
//!
//! The record of a name does not depend on links: an advertisement names its owner, and the topology has the owner's
//! place. So a robot that moves changes one entry, and a link that breaks none. A node that carries nobody else's names
//! sees no topology; it relies on its routers.

use std::collections::{BTreeMap, BTreeSet};
use std::sync::Arc;
use std::time::{Duration, Instant};

use sgc_trust::{CLOCK_SKEW_MAX, VerifiedPeer, signed_digest, verify_advert};
use sgc_wire::{Control, HOP_LIMIT, NAMES_PER_FRAME_MAX, Name, NodeId, Now, SignedBody, UnixMillis};
use smallvec::SmallVec;

use crate::limits::QUERY_EVERY;
use crate::links::{COST_SUSPECT, LinkState};
use crate::mapping::{Ask, NameLocation};
use crate::memory::Memory;
use crate::router::{DropReason, LinkId, Router};
use crate::shares::Shares;
use crate::topology::{NodeRecord, cost_differs};

/// Time for which a router that asked is told of new owners.
const QUERY_LEASE: Duration = Duration::from_secs(60);
/// Least time after which the same question is passed on again.
const QUERY_AGAIN: Duration = Duration::from_secs(5);

/// Approximate memory of a record beside its signed bytes, bytes.
const RECORD_BYTES: usize = 512;
/// Memory of each of its names, bytes.
const NAME_BYTES: usize = 128;

/// Number of a [`Record`]; never used again while the process lives.
pub(crate) type RecordId = u64;

/// A verified advertisement or withdrawal.
#[derive(Debug)]
pub(crate) struct Record {
    /// Shared with the branches of its names.
    pub(crate) owner: Arc<VerifiedPeer>,
    pub(crate) seq: u64,
    withdraw: bool,
    names: Box<[Name]>,
    signed: SignedBody,
    issued_at: UnixMillis,
    digest: [u8; 32],
    /// End of its lease; for a withdrawal, the time from which no withdrawn advertisement verifies.
    expires: Instant,
    /// The middle of its lease: owners renew after a third.
    renewal_due: Instant,
    /// Names that no newer one speaks for.
    live: usize,
    /// The link that brought it first.
    from: LinkId,
    /// Time of the question for it; `None` if it came unasked.
    asked: Option<Instant>,
}

impl Record {
    /// Returns its part of its owner's share of memory, bytes.
    fn bytes(&self) -> usize {
        RECORD_BYTES + self.signed.body.len() + self.signed.signature.len() + self.names.len() * NAME_BYTES
    }
}

/// The reason why a record no longer counts.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum RecordEnd {
    /// Newer records speak for its names.
    Superseded,
    /// Its lease has ended, its certificate is no longer believed, or it had to make room.
    Ended,
    /// This node does not want its names; it may come again.
    Unwanted,
}

/// The routes to a name, at a node that relies on its routers.
#[derive(Debug, Default)]
struct NameRoutes {
    /// Cost from the neighbour to the owner.
    over: SmallVec<[(LinkId, u32); 2]>,
    selected: Option<LinkId>,
}

/// The advertisements and withdrawals of one owner.
#[derive(Debug, Default)]
struct OwnerRecords {
    /// Its advertisements, by sequence number.
    records: BTreeSet<(u64, RecordId)>,
    /// Its withdrawals, by sequence number.
    withdrawals: BTreeSet<(u64, RecordId)>,
    /// Names that advertisements speak for.
    names: usize,
    /// Names that withdrawals speak for.
    withdrawn: usize,
    /// Memory that both take.
    bytes: usize,
}

impl OwnerRecords {
    fn records_of_kind(&mut self, withdraw: bool) -> (&mut BTreeSet<(u64, RecordId)>, &mut usize) {
        match withdraw {
            true => (&mut self.withdrawals, &mut self.withdrawn),
            false => (&mut self.records, &mut self.names),
        }
    }

    /// Returns the first record to give way: a withdrawal, because the memory keeps its number.
    fn oldest(&self) -> Option<RecordId> {
        self.withdrawals.first().or(self.records.first()).map(|(_, id)| *id)
    }

    fn newest(&self) -> Option<(u64, RecordId)> {
        self.records.last().max(self.withdrawals.last()).copied()
    }
}

/// A question that was passed on, or began here.
#[derive(Clone, Copy, Debug)]
struct Question {
    id: u64,
    at: Instant,
    /// Set until the answer is known.
    open: bool,
}

/// All records and routes of names.
#[derive(Debug, Default)]
pub(crate) struct Names {
    /// The newest record of each name: an advertisement or a withdrawal.
    words: BTreeMap<Name, RecordId>,
    records: BTreeMap<RecordId, Record>,
    expiries: BTreeSet<(Instant, RecordId)>,
    /// The middle of the lease of each advertisement.
    renewals: BTreeSet<(Instant, RecordId)>,
    seen: BTreeMap<[u8; 32], RecordId>,
    owners: BTreeMap<NodeId, OwnerRecords>,
    next_id: RecordId,
    /// Records that are no longer in force.
    memory: Memory,
    /// Names that withdrawals speak for, in all and by owner, the one with the most last.
    withdrawn: usize,
    most_withdrawn: BTreeSet<(usize, NodeId)>,
    /// Records that wait for the allowance of their owner to be passed on.
    waiting: BTreeMap<NodeId, BTreeSet<RecordId>>,
    heard: BTreeMap<Name, NameRoutes>,
    /// Links that want to know of a name: proxies, and this node's own endpoint.
    watchers: BTreeMap<Name, BTreeSet<LinkId>>,
    /// Names that are asked for, with the time of the next question.
    asking: BTreeMap<Name, Instant>,
    ask_at: BTreeSet<(Instant, Name)>,
    /// The last question for a name that was passed on, charged to its bringer.
    passed_on: Shares<Name, Question>,
    /// Unknown names that routers asked for over a link, with the end of their interest.
    asks: Shares<(LinkId, Name), Instant>,
    /// Questions that began here.
    questions: u64,
    pub(crate) prune_at: Option<Instant>,
}

impl Names {
    pub(crate) fn record(&self, name: &Name) -> Option<&Record> {
        self.records.get(&self.id(name)?)
    }

    /// Iterates over the owners of records.
    pub(crate) fn owners(&self) -> impl Iterator<Item = &NodeId> {
        self.owners.keys()
    }

    /// Iterates over the names that the advertisements of an owner speak for.
    fn names_of(&self, owner: &NodeId) -> impl Iterator<Item = &Name> {
        let records = self.owners.get(owner).into_iter().flat_map(|of_owner| &of_owner.records);
        let named = records.filter_map(|(_, id)| Some((id, self.records.get(id)?)));
        named.flat_map(move |(id, r)| r.names.iter().filter(move |n| self.words.get(*n) == Some(id)))
    }

    /// Returns the advertisement that speaks for a name.
    fn id(&self, name: &Name) -> Option<RecordId> {
        let id = self.words.get(name)?;
        self.records.get(id).filter(|record| !record.withdraw).map(|_| *id)
    }

    /// Returns the number of advertised names.
    fn live(&self) -> usize {
        self.words.len().saturating_sub(self.withdrawn)
    }

    /// Returns the number of names that are advertised, asked for or heard of.
    pub(crate) fn known(&self) -> usize {
        let others = self.watchers.keys().chain(self.heard.keys());
        let unknown: BTreeSet<_> = others.filter(|n| self.id(n).is_none()).collect();
        self.live() + unknown.len()
    }

    pub(crate) fn tombstones(&self) -> usize {
        self.withdrawn
    }

    pub(crate) fn deadlines(&self) -> impl Iterator<Item = Instant> {
        let expiry = self.expiries.first().map(|(at, _)| *at);
        let ask = self.ask_at.first().map(|(at, _)| *at);
        let renewal = self.renewals.first().map(|(at, _)| *at);
        [expiry, ask, renewal, self.memory.deadline(), self.prune_at].into_iter().flatten()
    }

    /// Returns the number of the next record.
    pub(crate) fn next_id(&self) -> RecordId {
        self.next_id
    }

    /// Returns the newest known sequence number of a name, withdrawn or not.
    fn known_seq(&self, name: &Name) -> Option<u64> {
        self.records.get(self.words.get(name)?).map(|record| record.seq)
    }

    /// Returns the last message of an owner, in force or not, and its number.
    fn newest(&self, owner: &NodeId) -> Option<(u64, &SignedBody)> {
        let in_force = self.owners.get(owner).and_then(OwnerRecords::newest);
        let in_force = in_force.and_then(|(seq, id)| Some((seq, &self.records.get(&id)?.signed)));
        in_force.into_iter().chain(self.memory.newest(owner)).max_by_key(|(seq, _)| *seq)
    }

    /// Notes that a node's link state ended, with this floor.
    pub(crate) fn run_ended(&mut self, now: Instant, node: &NodeId, floor: u64, max: usize) {
        self.memory.run_ended(now, node, floor, max);
    }

    // ---- Records that wait to be passed on.

    pub(crate) fn wait(&mut self, owner: &NodeId, id: RecordId) {
        if self.records.contains_key(&id) {
            self.waiting.entry(*owner).or_default().insert(id);
        }
    }

    pub(crate) fn waits_no_more(&mut self, owner: &NodeId, id: RecordId) {
        if let Some(waiting) = self.waiting.get_mut(owner) {
            waiting.remove(&id);
            if waiting.is_empty() {
                self.waiting.remove(owner);
            }
        }
    }

    /// Returns the owners of waiting records.
    pub(crate) fn waiting(&self) -> Vec<NodeId> {
        self.waiting.keys().copied().collect()
    }

    /// Returns the owner's record that has waited for longest, and the link that brought it.
    pub(crate) fn first_waiting(&self, owner: &NodeId) -> Option<(RecordId, LinkId)> {
        let id = self.waiting.get(owner)?.first()?;
        self.records.get(id).map(|record| (*id, record.from))
    }

    /// Forgets the questions of a link.
    pub(crate) fn forget_asks(&mut self, link: LinkId) {
        self.asks.remove_range((link, Name([0; 32]))..=(link, Name([0xff; 32])));
    }

    fn stop_asking(&mut self, name: &Name) {
        if let Some(at) = self.asking.remove(name) {
            self.ask_at.remove(&(at, *name));
        }
    }

    fn ask_again(&mut self, name: Name, at: Instant) {
        self.stop_asking(&name);
        self.asking.insert(name, at);
        self.ask_at.insert((at, name));
    }
}

impl Router {
    /// Returns the link towards the owner of `name`, and the cost of the route.
    pub(crate) fn next_hop(&self, name: &Name) -> Option<(LinkId, u32)> {
        let record = self.names.record(name)?;
        let owner = &record.owner.node_id;
        if *owner == self.config.node {
            return Some((LinkId::LOCAL, 0));
        }
        if self.config.transit {
            return self.next_hop_to(owner);
        }
        let heard = self.names.heard.get(name)?;
        let over = |(link, cost): &(LinkId, u32)| {
            let own = self.links.get(link)?.cost.now();
            Some((cost.saturating_add(own), *link))
        };
        let best = heard.over.iter().filter_map(over).min()?;
        // Another link is taken only if that is clearly better.
        let kept = heard.over.iter().filter(|(l, _)| Some(*l) == heard.selected).find_map(over);
        let (cost, link) = kept.filter(|(cost, _)| !cost_differs(best.0, *cost)).unwrap_or(best);
        Some((link, cost))
    }

    /// Returns the link towards a node, and the cost of the route, from the topology or from a link of this node
    /// itself.
    fn next_hop_to(&self, node: &NodeId) -> Option<(LinkId, u32)> {
        let direct = self.link_to(node);
        let next_hop = self.topology.next_hop(&self.config.node, node);
        match (next_hop, direct) {
            (Some((cost, first)), _) if first == *node => Some((direct?.0, cost)),
            (Some((cost, first)), direct) => match (self.link_to(&first), direct) {
                (Some((link, _)), Some((straight, own))) => {
                    Some(if own <= cost { (straight, own) } else { (link, cost) })
                }
                (Some((link, _)), None) => Some((link, cost)),
                (None, direct) => direct,
            },
            (None, direct) => direct,
        }
    }

    /// Returns `true` if `name` may be told over `link`: not back where it is, and others' names only by routers.
    fn may_tell(&self, next_hop: LinkId, link: LinkId) -> bool {
        next_hop != link && (next_hop == LinkId::LOCAL || link == LinkId::LOCAL || self.config.transit)
    }

    pub(crate) fn handle_advert(&mut self, now: Now, link: LinkId, cost: u32, signed: SignedBody) {
        let Some(state) = self.links.get(&link) else { return };
        let (neighbour, from_router, is_local) = (state.node, state.is_transit(), link == LinkId::LOCAL);
        let digest = signed_digest(&signed);
        if let Some((id, known)) =
            self.names.seen.get(&digest).and_then(|id| Some((*id, self.names.records.get(id)?)))
        {
            let owner = known.owner.node_id;
            if !from_router && owner != neighbour {
                return self.drop_frame(link, DropReason::NotOwner { owner });
            }
            return self.hear(link, cost, id);
        }
        if let Some((owner, seq)) = self.names.memory.known(&digest) {
            return self.stale_advert(link, &owner, seq);
        }
        if !self.may_bring(link) {
            return;
        }
        let advert = match verify_advert(&self.config.anchors, &signed, now.unix) {
            Ok(advert) => advert,
            Err(why) => return self.not_verified(now, link, "advertisement", why),
        };
        let owner = advert.owner.node_id;
        let (seq, withdraw) = (advert.body.seq, advert.body.withdraw);
        if owner == self.config.node && !is_local {
            if self.names.newest(&owner).is_some_and(|(newest, _)| seq <= newest) {
                self.charge_stale(link);
                return self.stale_advert(link, &owner, seq);
            }
            // This node's own record, perhaps of a run whose clock was ahead: its endpoint has to continue from there.
            return self.send(LinkId::LOCAL, Control::Advert { cost, signed });
        }
        if !from_router && owner != neighbour {
            self.charge_stale(link);
            return self.drop_frame(link, DropReason::NotOwner { owner });
        }
        let run = self.topology.node(&owner).map(|n| n.floor);
        let run = run.unwrap_or_else(|| self.names.memory.run_floor(&owner));
        let floor = run.max(self.names.memory.floor(&owner));
        let is_news = |n: &Name| self.names.known_seq(n).is_none_or(|known| seq > known);
        // This node's own record is always the newest.
        let mut news: Vec<_> =
            advert.names.iter().copied().filter(|n| is_local || seq >= floor && is_news(n)).collect();
        if news.is_empty() {
            self.charge_stale(link);
            return self.stale_advert(link, &owner, seq);
        }
        if !self.config.transit && !is_local {
            // A node that carries nothing need not know names that nobody here wants.
            news.retain(|n| self.names.watchers.contains_key(n));
            if news.is_empty() {
                return self.charge_stale(link);
            }
        }
        if let Some(what) = self.over_limit(link, &owner, &news, withdraw) {
            self.charge_stale(link);
            return self.drop_frame(link, DropReason::Limit { what });
        }
        let expires = match (withdraw, self.lease_end(now, advert.body.lease_ms, &advert.owner)) {
            (true, _) => now.instant + 2 * CLOCK_SKEW_MAX,
            (false, Ok(expires)) => expires,
            (false, Err(why)) => return self.not_verified(now, link, "advertisement", why),
        };
        let open = |n| self.names.passed_on.get(n).is_some_and(|q| q.open);
        let asked = news.iter().any(|n| self.names.asking.contains_key(n) || open(n));
        let record = Record {
            owner: Arc::new(advert.owner),
            seq,
            withdraw,
            names: advert.names.into(),
            signed: signed.clone(),
            issued_at: advert.body.issued_at,
            digest,
            expires,
            renewal_due: now.instant + expires.saturating_duration_since(now.instant) / 2,
            live: 0,
            from: link,
            // Owners announce changes unasked.
            asked: (asked && from_router && !withdraw).then_some(now.instant),
        };
        if withdraw {
            return self.withdraw(link, &owner, record, &news);
        }
        let id = self.insert(record, &news);
        // A node that only listens may learn of known names from another neighbour.
        self.hear(link, cost, id);
        self.pass_on_or_wait(link, &owner, id);
        news.extend(self.make_room(&owner));
        self.routes_changed(&news);
    }

    /// Answers an old advertisement: if it comes from the owner itself, the owner should learn the newer number.
    fn stale_advert(&mut self, link: LinkId, owner: &NodeId, seq: u64) {
        let newest = self.names.newest(owner).filter(|(newest, _)| *newest > seq);
        let known = newest.map_or(seq, |(newest, _)| newest);
        if let Some((_, signed)) = newest
            && self.links.get(&link).is_some_and(|state| state.node == *owner)
        {
            let signed = signed.clone();
            self.send(link, Control::Advert { cost: 0, signed });
        }
        self.drop_frame(link, DropReason::Stale { seq, known });
    }

    /// Returns the bound that these names would exceed.
    fn over_limit(
        &self,
        link: LinkId,
        owner: &NodeId,
        news: &[Name],
        withdraw: bool,
    ) -> Option<&'static str> {
        let (names, limits) = (&self.names, &self.config.limits);
        if link == LinkId::LOCAL {
            return None;
        }
        if !names.owners.contains_key(owner) && names.owners.len() >= limits.nodes_max {
            return Some("owners");
        }
        let more = news.iter().filter(|n| names.id(n).is_none()).count();
        let of_owner = names.owners.get(owner).map_or(0, |o| o.names);
        let over_link = self.links.get(&link).map_or(0, |l| l.names);
        if withdraw || more == 0 {
            None
        } else if of_owner + more > limits.names_per_owner_max {
            Some("names of an owner")
        } else if over_link + more > limits.names_per_router_max {
            Some("names over a link")
        } else if names.live() + more > limits.names_max {
            Some("names")
        } else {
            None
        }
    }

    /// Voids the oldest records of an owner that has too many, and the oldest withdrawals of the owner with the most if
    /// there are too many in all. Returns the names that are no longer advertised.
    fn make_room(&mut self, owner: &NodeId) -> Vec<Name> {
        let mut gone = Vec::new();
        let limits = &self.config.limits;
        let (most, bytes_max) = (limits.adverts_per_owner_max, limits.advert_bytes_per_owner_max);
        let tombstones_max = limits.tombstones_max;
        while *owner != self.config.node
            && let Some(of_owner) = self.names.owners.get(owner)
            && (of_owner.records.len() + of_owner.withdrawals.len() > most || of_owner.bytes > bytes_max)
            && let Some(oldest) = of_owner.oldest()
        {
            gone.extend(self.forget_record(oldest, RecordEnd::Ended));
        }
        while self.names.withdrawn > tombstones_max
            && let Some((_, owner)) = self.names.most_withdrawn.last().copied()
            && let Some((_, oldest)) =
                self.names.owners.get(&owner).and_then(|o| o.withdrawals.first()).copied()
        {
            self.forget_record(oldest, RecordEnd::Ended);
        }
        gone
    }

    fn insert(&mut self, record: Record, names: &[Name]) -> RecordId {
        let id = self.names.next_id;
        self.names.next_id += 1;
        self.names.seen.insert(record.digest, id);
        self.names.expiries.insert((record.expires, id));
        if self.config.transit && !record.withdraw && record.owner.node_id != self.config.node {
            self.names.renewals.insert((record.renewal_due, id));
        }
        let of_owner = self.names.owners.entry(record.owner.node_id).or_default();
        of_owner.records_of_kind(record.withdraw).0.insert((record.seq, id));
        of_owner.bytes += record.bytes();
        let withdraw = record.withdraw;
        self.names.records.insert(id, record);
        for name in names {
            if withdraw {
                self.names.heard.remove(name);
            } else if let Some(question) = self.names.passed_on.get_mut(name) {
                question.open = false;
            }
            if let Some(old) = self.names.words.insert(*name, id) {
                self.release(old, 1, RecordEnd::Superseded);
            }
        }
        self.hold(id, names.len());
        id
    }

    fn hold(&mut self, id: RecordId, names: usize) {
        let Some(record) = self.names.records.get_mut(&id) else { return };
        record.live += names;
        let (owner, withdraw, from) = (record.owner.node_id, record.withdraw, record.from);
        self.count(&owner, withdraw, from, names, usize::saturating_add);
        self.release(id, 0, RecordEnd::Unwanted);
    }

    /// Counts names that a record gains or loses.
    fn count(
        &mut self,
        owner: &NodeId,
        withdraw: bool,
        from: LinkId,
        names: usize,
        change: fn(usize, usize) -> usize,
    ) {
        let Some(of_owner) = self.names.owners.get_mut(owner) else { return };
        let (_, count) = of_owner.records_of_kind(withdraw);
        let old = std::mem::replace(count, change(*count, names));
        let new = *count;
        if withdraw {
            self.names.withdrawn = self.names.withdrawn + new - old;
            self.names.most_withdrawn.remove(&(old, *owner));
            if new > 0 {
                self.names.most_withdrawn.insert((new, *owner));
            }
        } else if let Some(link) = self.links.get_mut(&from) {
            link.names = change(link.names, names);
        }
    }

    /// Takes names from a record; without any it is removed.
    fn release(&mut self, id: RecordId, names: usize, gone: RecordEnd) {
        let Some(record) = self.names.records.get_mut(&id) else { return };
        record.live = record.live.saturating_sub(names);
        let is_gone = record.live == 0;
        let (owner, withdraw, from) = (record.owner.node_id, record.withdraw, record.from);
        self.count(&owner, withdraw, from, names, usize::saturating_sub);
        if !is_gone {
            return;
        }
        let Some(record) = self.names.records.remove(&id) else { return };
        self.names.seen.remove(&record.digest);
        self.names.expiries.remove(&(record.expires, id));
        self.names.renewals.remove(&(record.renewal_due, id));
        self.names.waits_no_more(&owner, id);
        if let Some(of_owner) = self.names.owners.get_mut(&owner) {
            of_owner.records_of_kind(withdraw).0.remove(&(record.seq, id));
            of_owner.bytes = of_owner.bytes.saturating_sub(record.bytes());
            if of_owner.records.is_empty() && of_owner.withdrawals.is_empty() {
                self.names.owners.remove(&owner);
            }
        }
        let (now, max) = (self.now.instant, self.config.limits.nodes_max);
        let Record { seq, digest, signed, .. } = record;
        match gone {
            RecordEnd::Superseded => self.names.memory.superseded(now, &owner, seq, digest, max),
            RecordEnd::Ended => self.names.memory.ended(now, &owner, seq, digest, &signed, max),
            RecordEnd::Unwanted => {}
        }
    }

    /// Forgets all names that a record still speaks for.
    fn forget_record(&mut self, id: RecordId, gone: RecordEnd) -> Vec<Name> {
        let Some(record) = self.names.records.get(&id) else { return Vec::new() };
        let names: Vec<_> =
            record.names.iter().copied().filter(|n| self.names.words.get(n) == Some(&id)).collect();
        for name in &names {
            self.names.words.remove(name);
            self.names.heard.remove(name);
        }
        self.release(id, names.len(), gone);
        names
    }

    /// Forgets the advertisements of an owner's earlier run.
    pub(crate) fn void_names(&mut self, owner: &NodeId, floor: u64) {
        let old = self.names.owners.get(owner).into_iter().flat_map(|o| o.records.range(..(floor, 0)));
        for id in old.map(|(_, id)| *id).collect::<Vec<_>>() {
            let names = self.forget_record(id, RecordEnd::Superseded);
            self.routes_changed(&names);
        }
    }

    fn withdraw(&mut self, link: LinkId, owner: &NodeId, record: Record, names: &[Name]) {
        let mut known: Vec<_> = names.iter().copied().filter(|n| self.names.id(n).is_some()).collect();
        let frame = Control::Advert { cost: 0, signed: record.signed.clone() };
        let id = self.insert(record, names);
        // Neighbours that never heard of the names need no withdrawal.
        if known.is_empty() {
            self.charge_stale(link);
        } else {
            self.pass_on_or_wait(link, owner, id);
            self.tell_watchers(link, &known, &frame);
        }
        known.extend(self.make_room(owner));
        self.routes_changed(&known);
    }

    /// Notes, at a node that relies on its routers, that the owner of a record is in reach over this link.
    fn hear(&mut self, link: LinkId, cost: u32, id: RecordId) {
        if self.config.transit || link == LinkId::LOCAL {
            return;
        }
        let Some(record) = self.names.records.get(&id).filter(|record| !record.withdraw) else { return };
        let seq = record.seq;
        let names: Vec<_> =
            record.names.iter().copied().filter(|n| self.names.watchers.contains_key(n)).collect();
        for name in &names {
            // It may have been without interest when the record came.
            if self.names.known_seq(name).is_none_or(|known| known < seq) {
                if let Some(old) = self.names.words.insert(*name, id) {
                    self.release(old, 1, RecordEnd::Superseded);
                }
                self.hold(id, 1);
            }
            let heard = self.names.heard.entry(*name).or_default();
            match heard.over.iter_mut().find(|(l, _)| *l == link) {
                Some(known) => known.1 = cost,
                None => heard.over.push((link, cost)),
            }
        }
        self.routes_changed(&names);
    }

    /// Handles a neighbour's notice that it can no longer reach these names.
    pub(crate) fn handle_unreach(&mut self, link: LinkId, names: &[Name]) {
        if self.config.transit {
            return self.drop_frame(link, DropReason::Unknown { what: "unreach" });
        }
        let mut lost = Vec::new();
        for name in names {
            if let Some(heard) = self.names.heard.get_mut(name) {
                heard.over.retain(|(l, _)| *l != link);
                lost.push(*name);
            }
        }
        self.routes_changed(&lost);
    }

    /// Forgets every route over a link.
    pub(crate) fn forget_via(&mut self, link: LinkId) {
        let mut lost = Vec::new();
        for (name, heard) in &mut self.names.heard {
            if heard.over.iter().any(|(l, _)| *l == link) {
                heard.over.retain(|(l, _)| *l != link);
                lost.push(*name);
            }
        }
        self.routes_changed(&lost);
    }

    pub(crate) fn handle_interest(&mut self, now: Now, link: LinkId, names: &[Name]) {
        let Some((node, is_router)) = self.links.get(&link).map(|l| (l.node, l.is_transit())) else { return };
        if link != LinkId::LOCAL && !self.allowance(&node).may_query(now.instant, names.len(), is_router) {
            return self.drop_frame(link, DropReason::Limit { what: "names asked for per second" });
        }
        let others = self.links_of.get(&node).into_iter().flatten().filter(|l| **l != link);
        let others: usize = others.filter_map(|l| self.links.get(l)).map(|l| l.interests.len()).sum();
        let mut news = Vec::new();
        for name in names {
            let Some(state) = self.links.get_mut(&link) else { return };
            if state.interests.contains_key(name) {
                continue;
            }
            if others + state.interests.len() >= self.config.limits.interests_per_peer_max {
                self.drop_frame(link, DropReason::Limit { what: "interests of a node" });
                break;
            }
            state.interests.insert(*name, None);
            self.names.watchers.entry(*name).or_default().insert(link);
            news.push(*name);
        }
        if link == LinkId::LOCAL && !self.config.transit && !news.is_empty() {
            self.ask_routers(&Control::Interest { names: news.clone() });
        }
        self.tell_interested(link, &news);
        if self.config.transit {
            for name in news {
                let record = self.names.record(&name);
                let is_late = |r: &Record| r.asked.is_some() || r.renewal_due <= now.instant;
                let needs = self.next_hop(&name).is_none()
                    || record.is_some_and(|r| is_late(r) && r.owner.node_id != self.config.node);
                // Another waiting node may have an earlier turn, behind many others.
                let due = self.names.asking.get(&name).copied();
                if needs && due.is_none_or(|at| at > now.instant + QUERY_EVERY) {
                    let turn = self.turn(&name, false);
                    self.names.ask_again(name, due.map_or(turn, |at| at.min(turn)));
                }
            }
        }
    }

    /// Returns the time at which all routers may be asked for a name on behalf of its waiting nodes: the first turn of
    /// any of them. This node's own endpoint need not wait.
    fn turn(&mut self, name: &Name, again: bool) -> Instant {
        let now = self.now.instant;
        let watchers: SmallVec<[LinkId; 8]> =
            self.names.watchers.get(name).into_iter().flatten().copied().collect();
        let mut first: Option<(Instant, NodeId, bool)> = None;
        for link in watchers {
            if link == LinkId::LOCAL || first.is_some_and(|(at, ..)| at <= now) {
                break;
            }
            let Some((node, is_router)) = self.links.get(&link).map(|l| (l.node, l.is_transit())) else {
                continue;
            };
            let at = self.allowance(&node).turns(again).next(now, is_router);
            if first.is_none_or(|(known, ..)| at < known) {
                first = Some((at, node, is_router));
            }
        }
        let Some((_, node, is_router)) = first else { return now };
        self.allowance(&node).turns(again).take(now, is_router)
    }

    pub(crate) fn handle_uninterest(&mut self, link: LinkId, names: &[Name]) {
        for name in names {
            let Some(state) = self.links.get_mut(&link) else { return };
            if state.interests.remove(name).is_none() {
                continue;
            }
            self.unwatch(link, name);
        }
        if link == LinkId::LOCAL && !self.config.transit {
            self.ask_routers(&Control::Uninterest { names: names.to_vec() });
        }
    }

    pub(crate) fn unwatch(&mut self, link: LinkId, name: &Name) {
        let Some(watchers) = self.names.watchers.get_mut(name) else { return };
        watchers.remove(&link);
        if !watchers.is_empty() {
            return;
        }
        self.names.watchers.remove(name);
        self.names.stop_asking(name);
        if !self.config.transit && self.next_hop(name).is_none_or(|(link, _)| link != LinkId::LOCAL) {
            self.names.heard.remove(name);
            if let Some(id) = self.names.id(name) {
                self.names.words.remove(name);
                self.release(id, 1, RecordEnd::Unwanted);
            }
        }
    }

    /// Sends an interest of this node to its neighbours.
    fn ask_routers(&mut self, frame: &Control) {
        let greeted = |(l, s): &(&LinkId, &LinkState)| **l != LinkId::LOCAL && s.hello.is_some();
        let targets: Vec<_> = self.links.iter().filter(greeted).map(|(l, _)| *l).collect();
        for link in targets {
            self.send(link, frame.clone());
        }
    }

    /// Asks a neighbour that just greeted for the wanted names.
    pub(crate) fn send_interests(&mut self, link: LinkId) {
        if self.config.transit {
            return;
        }
        let wanted: Vec<_> = self.links[&LinkId::LOCAL].interests.keys().copied().collect();
        for names in wanted.chunks(NAMES_PER_FRAME_MAX) {
            self.send(link, Control::Interest { names: names.to_vec() });
        }
    }

    /// Returns the next record, between two numbers, for a router that did not ask: those of this node, and if the
    /// mapping says so all. The router may have missed withdrawals, so it gets those, too.
    pub(crate) fn next_advert(&self, from: RecordId, end: RecordId) -> Option<RecordId> {
        let all = self.config.transit && self.mapping.tells_unasked();
        let own = self.config.node;
        // Advertisements that an older withdrawal ended have no lease left.
        let oldest = self.now.instant + 2 * CLOCK_SKEW_MAX - self.config.limits.lease_max;
        let told = |record: &Record| match record.withdraw {
            true => all && record.expires > oldest,
            false => all || record.owner.node_id == own,
        };
        self.names.records.range(from..end).find(|(_, record)| told(record)).map(|(id, _)| *id)
    }

    /// Returns an advertisement, and the withdrawals of those of its names that are void; nothing if the receiver would
    /// not believe it.
    pub(crate) fn record_frames(&self, id: RecordId, cost: u32) -> Vec<Control> {
        let record = self.names.records.get(&id).filter(|record| self.verifies_elsewhere(record.issued_at));
        let Some(record) = record else { return Vec::new() };
        let mut frames = vec![Control::Advert { cost, signed: record.signed.clone() }];
        if record.live < record.names.len() {
            let mut withdrawals = BTreeMap::new();
            for name in &record.names {
                let word = self.names.words.get(name).and_then(|id| self.names.records.get(id));
                let is_newer = |word: &&Record| {
                    word.withdraw && word.seq > record.seq && self.verifies_elsewhere(word.issued_at)
                };
                if let Some(newer) = word.filter(is_newer) {
                    withdrawals.insert(newer.seq, newer.signed.clone());
                }
            }
            frames.extend(withdrawals.into_values().map(|signed| Control::Advert { cost: 0, signed }));
        }
        frames
    }

    /// Passes on a record that came over `ingress`: to all routers, or to those that asked.
    pub(crate) fn tell_record_to_routers(&mut self, ingress: LinkId, owner: &NodeId, id: RecordId) {
        let Some(record) = self.names.records.get(&id) else { return };
        let names: Vec<_> =
            record.names.iter().copied().filter(|n| self.names.words.get(n) == Some(&id)).collect();
        let own = *owner == self.config.node;
        if names.is_empty() || !(self.config.transit || own) {
            return;
        }
        let everyone = if self.config.transit { self.mapping.tells_unasked() } else { own };
        let targets: Vec<_> = self
            .links
            .iter()
            .filter(|(l, s)| {
                let asked = || {
                    s.follows.contains_key(owner)
                        || names.iter().any(|n| self.names.asks.contains(&(**l, *n)))
                };
                **l != ingress && s.is_transit() && (everyone || asked())
            })
            .map(|(l, _)| *l)
            .collect();
        for link in targets {
            if !everyone {
                self.answer(link, owner, &names);
            }
            for frame in self.record_frames(id, 0) {
                self.send(link, frame);
            }
        }
    }

    /// Hands a withdrawal to the links that were told of one of the names.
    fn tell_watchers(&mut self, ingress: LinkId, names: &[Name], frame: &Control) {
        let told = |link: &LinkState| names.iter().any(|n| matches!(link.interests.get(n), Some(Some(_))));
        let targets: Vec<_> =
            self.links.iter().filter(|(l, s)| **l != ingress && told(s)).map(|(l, _)| *l).collect();
        for link in targets {
            self.send(link, frame.clone());
            if let Some(state) = self.links.get_mut(&link) {
                for name in names {
                    if let Some(told) = state.interests.get_mut(name) {
                        *told = None;
                    }
                }
            }
        }
    }

    /// Updates trees and interested neighbours after the routes to these names may have changed.
    pub(crate) fn routes_changed(&mut self, names: &[Name]) {
        let mut watched = BTreeMap::<LinkId, Vec<Name>>::new();
        for name in names {
            self.select(name);
            self.follow_next_hop(name);
            for link in self.names.watchers.get(name).into_iter().flatten() {
                watched.entry(*link).or_default().push(*name);
            }
        }
        for (link, names) in watched {
            self.tell_interested(link, &names);
        }
        if self.config.transit {
            let waited = names.iter().filter(|n| self.names.watchers.contains_key(*n));
            let lost: Vec<_> = waited
                .filter(|n| !self.names.asking.contains_key(*n) && self.next_hop(n).is_none())
                .copied()
                .collect();
            for name in lost {
                let turn = self.turn(&name, false);
                self.names.ask_again(name, turn);
            }
        }
    }

    /// Handles possible route changes to these owners. Names without an advertisement have no route before or after.
    pub(crate) fn owner_routes_changed(&mut self, owners: &[NodeId]) {
        let counts = |n: &&Name| self.names.watchers.contains_key(*n) || self.trees.contains_key(*n);
        let names: BTreeSet<_> =
            owners.iter().flat_map(|owner| self.names.names_of(owner).filter(counts)).copied().collect();
        self.check_next_hops(names);
        self.answer_asks(owners);
    }

    /// Handles changed links of a node that carries nobody else's names.
    pub(crate) fn own_links_changed(&mut self) {
        self.check_next_hops(self.names.watchers.keys().chain(self.trees.keys()).copied().collect());
    }

    fn check_next_hops(&mut self, names: BTreeSet<Name>) {
        self.topology.names_checked += names.len() as u64;
        self.routes_changed(&names.into_iter().collect::<Vec<_>>());
    }

    fn select(&mut self, name: &Name) {
        if !self.config.transit {
            let next_hop = self.next_hop(name).map(|(link, _)| link);
            if let Some(heard) = self.names.heard.get_mut(name) {
                heard.selected = next_hop;
            }
        }
    }

    /// Tells a neighbour the names of its interest again, because it did not believe the last records.
    pub(crate) fn tell_interested_again(&mut self, link: LinkId) {
        let Some(state) = self.links.get_mut(&link) else { return };
        let names: Vec<_> = state.interests.keys().copied().collect();
        state.interests.values_mut().for_each(|told| *told = None);
        self.tell_interested(link, &names);
    }

    /// Tells an interested neighbour the news of these names: each advertisement once.
    fn tell_interested(&mut self, link: LinkId, names: &[Name]) {
        let mut adverts = BTreeMap::new();
        let mut gone = Vec::new();
        for name in names {
            let Some(told) = self.links.get(&link).and_then(|l| l.interests.get(name)).copied() else {
                continue;
            };
            let next_hop = self.next_hop(name).filter(|(next_hop, _)| self.may_tell(*next_hop, link));
            let id = self.names.id(name);
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
            if let Some(told) = self.links.get_mut(&link).and_then(|l| l.interests.get_mut(name)) {
                *told = news;
            }
        }
        for (id, cost) in adverts {
            for frame in self.record_frames(id, cost.min(COST_SUSPECT)) {
                self.send(link, frame);
            }
        }
        for names in gone.chunks(NAMES_PER_FRAME_MAX) {
            self.send(link, Control::Unreach { names: names.to_vec() });
        }
    }

    // ---- Questions among routers.

    /// Handles a question. The answer goes back over the link that brought the question first: copies over others are
    /// ignored, or every router would be told of every requested name.
    pub(crate) fn handle_query(&mut self, now: Now, link: LinkId, id: u64, hops: u8, names: &[Name]) {
        let Some(state) = self.links.get(&link) else { return };
        if !self.config.transit || !state.is_transit() {
            return self.drop_frame(link, DropReason::NotRouter);
        }
        let node = state.node;
        if !self.allowance(&node).may_query(now.instant, names.len(), true) {
            return self.drop_frame(link, DropReason::Limit { what: "names asked for per second" });
        }
        let mut is_full = false;
        let until = now.instant + QUERY_LEASE;
        self.names.prune_at.get_or_insert(until);
        let (mut unknown, mut refresh) = (Vec::new(), BTreeMap::<LinkId, Vec<Name>>::new());
        for name in names {
            let before = self.names.passed_on.get(name).copied();
            if before.is_some_and(|q| q.id == id) {
                continue;
            }
            let next_hop = self.next_hop(name).filter(|(next_hop, _)| *next_hop != link);
            if next_hop.is_some()
                && let Some(record) = self.names.record(name)
            {
                let (owner, from) = (record.owner.node_id, record.from);
                let again = record.asked.filter(|at| *at + QUERY_AGAIN <= now.instant).is_some();
                self.answer(link, &owner, &[*name]);
                self.tell_record(link, name);
                if again && from != link {
                    refresh.entry(from).or_default().push(*name);
                    self.mark_asked(now.instant, name);
                }
                continue;
            }
            let (asks, limits) = (&mut self.names.asks, &self.config.limits);
            let ask = (link, *name);
            if !asks.contains(&ask) && asks.held_by(&node) >= limits.interests_per_peer_max {
                is_full = true;
                continue;
            }
            asks.insert(node, ask, until, limits.asks_max, |_| true);
            if before.is_none_or(|q| !q.open || q.at + QUERY_AGAIN <= now.instant) {
                unknown.push(*name);
            }
        }
        if is_full {
            self.drop_frame(link, DropReason::Limit { what: "names asked for" });
        }
        if hops >= HOP_LIMIT - 1 {
            return self.drop_frame(link, DropReason::HopLimit);
        }
        self.pass_on(now.instant, Some(link), id, hops + 1, &unknown);
        for (from, names) in refresh {
            self.send(from, Control::Query { id, hops: hops + 1, names });
        }
    }

    /// Asks all routers but the asker.
    fn pass_on(&mut self, now: Instant, asker: Option<LinkId>, id: u64, hops: u8, names: &[Name]) {
        if names.is_empty() {
            return;
        }
        let by = asker.and_then(|link| self.links.get(&link)).map_or(self.config.node, |state| state.node);
        let max = self.config.limits.questions_max;
        let question = Question { id, at: now, open: true };
        // If a question were forgotten while copies of it are in flight, those would be passed on again.
        let is_settled = |q: &Question| q.at + QUERY_AGAIN <= now;
        let passed_on = &mut self.names.passed_on;
        let (names, refused): (Vec<_>, Vec<_>) =
            names.iter().partition(|name| passed_on.insert(by, **name, question, max, is_settled));
        if !refused.is_empty() {
            self.drop_frame(asker.unwrap_or(LinkId::LOCAL), DropReason::QuestionsFull);
        }
        if names.is_empty() {
            return;
        }
        self.names.prune_at.get_or_insert(now + QUERY_LEASE);
        let targets: Vec<_> = self
            .links
            .iter()
            .filter(|(l, s)| Some(**l) != asker && s.is_transit())
            .map(|(l, _)| *l)
            .collect();
        for link in targets {
            for names in names.chunks(NAMES_PER_FRAME_MAX) {
                self.send(link, Control::Query { id, hops, names: names.to_vec() });
            }
        }
    }

    /// Returns the number of a new question: unique, and without a trace of the asker.
    fn question(&mut self) -> u64 {
        self.names.questions += 1;
        // The odd factor gives different numbers to runs whose own numbers are near each other.
        let spread = self.names.questions.wrapping_mul(0x9e37_79b9_7f4a_7c15);
        self.config.incarnation.wrapping_add(spread)
    }

    fn mark_asked(&mut self, now: Instant, name: &Name) {
        let record = self.names.id(name).and_then(|id| self.names.records.get_mut(&id));
        if let Some(record) = record {
            record.asked = Some(now);
        }
    }

    /// Tells a router that asked the owner's place, now and after each change.
    fn answer(&mut self, link: LinkId, owner: &NodeId, names: &[Name]) {
        let until = self.now.instant + QUERY_LEASE;
        for name in names {
            self.names.asks.remove(&(link, *name));
        }
        let Some(state) = self.links.get_mut(&link) else { return };
        let new = state.follows.insert(*owner, until).is_none();
        self.names.prune_at.get_or_insert(until);
        // All routers are known to it, and it learns of changes because it follows the owner.
        let is_told = |r: &&NodeRecord| new && !r.transit && self.verifies_elsewhere(r.issued_at);
        if let Some(record) = self.topology.node(owner).filter(is_told) {
            let signed = record.signed.clone();
            self.send(link, Control::LinkState { signed });
        }
    }

    fn tell_record(&mut self, link: LinkId, name: &Name) {
        if let Some(id) = self.names.id(name) {
            for frame in self.record_frames(id, 0) {
                self.send(link, frame);
            }
        }
    }

    /// Answers open questions for the names of these owners.
    fn answer_asks(&mut self, owners: &[NodeId]) {
        let waits = |s: &LinkState| self.names.asks.held_by(&s.node) > 0;
        let waiting: Vec<_> = self.links.iter().filter(|(_, s)| waits(s)).map(|(l, _)| *l).collect();
        let mut open = Vec::new();
        for owner in owners {
            for name in self.names.names_of(owner) {
                let by = waiting.iter().filter(|link| self.names.asks.contains(&(**link, *name)));
                open.extend(by.map(|link| (*link, *owner, *name)));
            }
        }
        for (link, owner, name) in open {
            if self.next_hop(&name).is_none_or(|(next_hop, _)| next_hop == link) {
                continue;
            }
            self.answer(link, &owner, &[name]);
            self.tell_record(link, &name);
        }
    }

    /// Tells a router on the route the owner's record, which it needs before it can take a request for a name.
    pub(crate) fn introduce(&mut self, link: LinkId, name: &Name) {
        let transit = self.links.get(&link).is_some_and(|l| l.is_transit());
        if self.mapping.tells_unasked() || !self.config.transit || !transit {
            return;
        }
        let Some(record) = self.names.record(name) else { return };
        let owner = record.owner.node_id;
        self.answer(link, &owner, &[]);
        self.tell_record(link, name);
    }

    /// Asks other routers for names that somebody here waits for, if that is due.
    pub(crate) fn ask_due(&mut self, now: Now) {
        // Checked whenever the machine is drained, so usually nothing is due.
        if self.names.ask_at.first().is_none_or(|(at, _)| *at > now.instant) {
            return;
        }
        let mut everyone = Vec::new();
        let mut one = BTreeMap::<LinkId, Vec<Name>>::new();
        while let Some((at, name)) = self.names.ask_at.first().copied().filter(|(at, _)| *at <= now.instant) {
            self.names.ask_at.remove(&(at, name));
            let known = match self.names.record(&name).filter(|_| self.next_hop(&name).is_some()) {
                None => NameLocation::Unknown,
                // A router that answered, or told the record unasked, may withhold a later one.
                Some(record) if record.renewal_due <= now.instant => NameLocation::Unknown,
                Some(record) => match record.asked {
                    Some(_) if self.links.contains_key(&record.from) => NameLocation::Answered(record.from),
                    Some(_) => NameLocation::Unknown,
                    None => NameLocation::Flooded,
                },
            };
            match self.mapping.ask(known) {
                Ask::Nobody => {
                    self.names.asking.remove(&name);
                    continue;
                }
                Ask::Everyone => {
                    everyone.push(name);
                    let turn = self.turn(&name, true);
                    self.names.ask_again(name, turn + QUERY_EVERY);
                }
                Ask::One(link) => {
                    one.entry(link).or_default().push(name);
                    self.names.ask_again(name, now.instant + QUERY_EVERY);
                }
            }
        }
        let id = self.question();
        self.pass_on(now.instant, None, id, 0, &everyone);
        for (link, names) in one {
            for chunk in names.chunks(NAMES_PER_FRAME_MAX) {
                chunk.iter().for_each(|name| self.mark_asked(now.instant, name));
                let id = self.question();
                self.send(link, Control::Query { id, hops: 0, names: chunk.to_vec() });
            }
        }
    }

    /// Asks one router for its newest record of a name.
    pub(crate) fn ask_neighbour(&mut self, link: LinkId, name: Name) {
        if self.config.transit && self.links.get(&link).is_some_and(LinkState::is_transit) {
            let id = self.question();
            self.send(link, Control::Query { id, hops: 0, names: vec![name] });
        }
    }

    // ---- Time and trust.

    /// Asks all routers for the wanted names of advertisements in the second half of their lease: owners renew after a
    /// third, so the router that told them may withhold the renewal.
    fn ask_for_renewals(&mut self, now: Instant) {
        while let Some((at, id)) = self.names.renewals.first().copied().filter(|(at, _)| *at <= now) {
            self.names.renewals.remove(&(at, id));
            let Some(record) = self.names.records.get(&id) else { continue };
            let is_wanted = |n: &&Name| {
                self.names.words.get(*n) == Some(&id)
                    && self.names.watchers.contains_key(*n)
                    && !self.names.asking.contains_key(*n)
            };
            for name in record.names.iter().filter(is_wanted).copied().collect::<Vec<_>>() {
                let turn = self.turn(&name, false);
                self.names.ask_again(name, turn);
            }
        }
    }

    pub(crate) fn names_timeout(&mut self, now: Now) {
        self.ask_for_renewals(now.instant);
        while let Some((at, id)) = self.names.expiries.first().copied().filter(|(at, _)| *at <= now.instant) {
            self.names.expiries.remove(&(at, id));
            let withdraw = self.names.records.get(&id).is_some_and(|record| record.withdraw);
            // No advertisement that an expired withdrawal voids verifies any more.
            let names =
                self.forget_record(id, if withdraw { RecordEnd::Superseded } else { RecordEnd::Ended });
            if !withdraw {
                self.routes_changed(&names);
            }
        }
        self.names.memory.expire(now.instant);
        if self.names.prune_at.is_some_and(|at| at <= now.instant) {
            for state in self.links.values_mut() {
                state.follows.retain(|_, until| *until > now.instant);
            }
            self.names.asks.retain(|until| *until > now.instant);
            self.names.passed_on.retain(|q| q.at + QUERY_LEASE > now.instant);
            let all_idle = self.names.passed_on.is_empty()
                && self.names.asks.is_empty()
                && self.links.values().all(|s| s.follows.is_empty());
            self.names.prune_at = (!all_idle).then(|| now.instant + QUERY_LEASE);
        }
    }

    /// Forgets advertisements under certificates that are no longer believed.
    pub(crate) fn distrust_names(&mut self) {
        let untrusted = |(_, r): &(&RecordId, &Record)| self.is_untrusted(&r.owner.path);
        let gone: Vec<_> = self.names.records.iter().filter(untrusted).map(|(id, _)| *id).collect();
        for id in gone {
            // It counts again if its certificate does.
            let names = self.forget_record(id, RecordEnd::Unwanted);
            self.routes_changed(&names);
        }
    }

    /// Returns the number of names whose owners are in reach.
    pub(crate) fn routed_names(&self) -> usize {
        let reached = |r: &&Record| {
            let owner = &r.owner.node_id;
            *owner == self.config.node || !self.config.transit || self.next_hop_to(owner).is_some()
        };
        let heard = |r: &Record| {
            if self.config.transit || r.owner.node_id == self.config.node {
                return r.live;
            }
            r.names.iter().filter(|n| self.next_hop(n).is_some()).count()
        };
        self.names.records.values().filter(|r| !r.withdraw).filter(reached).map(heard).sum()
    }
}
