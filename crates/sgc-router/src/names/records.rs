//! [`Records`]: the newest record of each name, and those of each owner, within bounds.

use std::collections::{BTreeMap, BTreeSet};
use std::time::Instant;

use sgc_trust::{CLOCK_SKEW_MAX, CertId};
use sgc_wire::{Control, Name, NodeId, Now, SignedBody};

use super::NamesBefore;
use super::record::{NewRecord, OwnerRecords, Record, RecordEnd, RecordId, RecordKind};
use crate::limits::Limits;
use crate::link_id::LinkId;
use crate::memory::Memory;

/// Records that are in force, and the memory of those that were.
#[derive(Debug)]
pub(super) struct Records {
    own: NodeId,
    transit: bool,
    limits: Limits,
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
    /// Number of names that are known over each link that is up.
    over_link: BTreeMap<LinkId, usize>,
}

impl Records {
    pub(super) fn new(own: NodeId, transit: bool, limits: &Limits) -> Self {
        Self {
            own,
            transit,
            limits: limits.clone(),
            words: BTreeMap::new(),
            records: BTreeMap::new(),
            expiries: BTreeSet::new(),
            renewals: BTreeSet::new(),
            seen: BTreeMap::new(),
            owners: BTreeMap::new(),
            next_id: 0,
            memory: Memory::default(),
            withdrawn: 0,
            most_withdrawn: BTreeSet::new(),
            waiting: BTreeMap::new(),
            over_link: BTreeMap::from([(LinkId::LOCAL, 0), (LinkId::STORE, 0)]),
        }
    }

    /// Notes a link that is up.
    pub(super) fn link_up(&mut self, link: LinkId) {
        self.over_link.insert(link, 0);
    }

    /// Notes a link that is gone.
    pub(super) fn link_down(&mut self, link: LinkId) {
        self.over_link.remove(&link);
    }

    // ---- Looking records up.

    /// Returns a record in force.
    pub(super) fn get(&self, id: RecordId) -> Option<&Record> {
        self.records.get(&id)
    }

    /// Returns the number of the advertisement that speaks for a name.
    pub(super) fn id(&self, name: &Name) -> Option<RecordId> {
        let id = self.words.get(name)?;
        self.records.get(id).filter(|record| !record.is_withdrawal()).map(|_| *id)
    }

    /// Returns the advertisement that speaks for a name.
    pub(super) fn of_name(&self, name: &Name) -> Option<&Record> {
        self.records.get(&self.id(name)?)
    }

    /// Returns the record in force with this digest.
    pub(super) fn with_digest(&self, digest: &[u8; 32]) -> Option<(RecordId, &Record)> {
        let id = self.seen.get(digest)?;
        Some((*id, self.records.get(id)?))
    }

    /// Returns owner and sequence number of a record that is no longer in force, by its digest.
    pub(super) fn ended(&self, digest: &[u8; 32]) -> Option<(NodeId, u64)> {
        self.memory.known(digest)
    }

    /// Returns the number below which records of an owner are void; `run` is the floor in its link state.
    pub(super) fn floor(&self, owner: &NodeId, run: Option<u64>) -> u64 {
        let run = run.unwrap_or_else(|| self.memory.run_floor(owner));
        run.max(self.memory.floor(owner))
    }

    /// Returns the newest record of a name, an advertisement or a withdrawal.
    pub(super) fn last(&self, name: &Name) -> Option<&Record> {
        self.records.get(self.words.get(name)?)
    }

    /// Returns the records that spoke for `news` before, beside all names of the record that brings them.
    pub(super) fn names_before(&self, news: &[Name], names: &[Name]) -> NamesBefore {
        let mut before = NamesBefore::Same;
        let mut same: Option<&Record> = None;
        for name in news {
            match self.last(name) {
                None => before = NamesBefore::None,
                // Names of a renewal have one record, whose names are compared once.
                Some(record) if same.is_some_and(|same| std::ptr::eq(same, record)) => {}
                Some(record) if record.names() == names => same = Some(record),
                Some(_) => return NamesBefore::Other,
            }
        }
        before
    }

    /// Returns the newest known sequence number of a name, withdrawn or not.
    pub(super) fn known_seq(&self, name: &Name) -> Option<u64> {
        self.last(name).map(Record::seq)
    }

    /// Returns the last message of an owner, in force or not, and its number.
    pub(super) fn newest(&self, owner: &NodeId) -> Option<(u64, &SignedBody)> {
        let in_force = self.owners.get(owner).and_then(OwnerRecords::newest);
        let in_force = in_force.and_then(|(seq, id)| Some((seq, self.records.get(&id)?.signed())));
        in_force.into_iter().chain(self.memory.newest(owner)).max_by_key(|(seq, _)| *seq)
    }

    /// Iterates over the owners of records.
    #[cfg(test)]
    pub(super) fn owners(&self) -> impl Iterator<Item = &NodeId> {
        self.owners.keys()
    }

    /// Iterates over the records of some owners.
    pub(super) fn of_owners(&self, is_wanted: impl Fn(&NodeId) -> bool) -> impl Iterator<Item = RecordId> {
        let owners = self.owners.iter().filter(move |(owner, _)| is_wanted(owner));
        owners.flat_map(|(_, of_owner)| of_owner.ids())
    }

    /// Iterates over the advertisements.
    pub(super) fn adverts(&self) -> impl Iterator<Item = &Record> {
        self.records.values().filter(|record| !record.is_withdrawal())
    }

    /// Iterates over the names that the advertisements of an owner speak for.
    pub(super) fn names_of(&self, owner: &NodeId) -> impl Iterator<Item = &Name> {
        let adverts = self.owners.get(owner).into_iter().flat_map(OwnerRecords::adverts);
        let named = adverts.filter_map(|id| Some((id, self.records.get(&id)?)));
        named.flat_map(move |(id, r)| r.names().iter().filter(move |n| self.words.get(*n) == Some(&id)))
    }

    /// Returns the number of names that the advertisements of these owners speak for.
    pub(super) fn count_of(&self, owners: &BTreeSet<NodeId>) -> usize {
        owners.iter().filter_map(|owner| self.owners.get(owner)).map(OwnerRecords::names).sum()
    }

    /// Returns the names that a record still speaks for.
    pub(super) fn live_names(&self, id: RecordId) -> Vec<Name> {
        let Some(record) = self.records.get(&id) else { return Vec::new() };
        if !record.is_partly_void() {
            return record.names().to_vec();
        }
        record.names().iter().copied().filter(|name| self.words.get(name) == Some(&id)).collect()
    }

    /// Returns the number of advertised names.
    pub(super) fn live(&self) -> usize {
        self.words.len().saturating_sub(self.withdrawn)
    }

    /// Returns the number of withdrawn names.
    pub(super) fn withdrawn(&self) -> usize {
        self.withdrawn
    }

    /// Returns the number of the next record.
    pub(super) fn next_id(&self) -> RecordId {
        self.next_id
    }

    /// Returns the times of the next expiries and renewal.
    pub(super) fn deadlines(&self) -> impl Iterator<Item = Instant> {
        let expiry = self.expiries.first().map(|(at, _)| *at);
        let renewal = self.renewals.first().map(|(at, _)| *at);
        [expiry, renewal, self.memory.deadline()].into_iter().flatten()
    }

    // ---- Frames of records.

    /// Returns an advertisement, and the withdrawals of those of its names that are void; nothing if the receiver would
    /// not believe it.
    pub(super) fn frames(&self, now: Now, id: RecordId, cost: u32) -> Vec<Control> {
        let record = self.records.get(&id).filter(|record| record.verifies_elsewhere(now));
        let Some(record) = record else { return Vec::new() };
        let mut frames = vec![Control::Advert { cost, signed: record.signed().clone() }];
        if record.is_partly_void() {
            let mut withdrawals = BTreeMap::new();
            for name in record.names() {
                let word = self.words.get(name).and_then(|id| self.records.get(id));
                let is_newer = |word: &&Record| {
                    word.is_withdrawal() && word.seq() > record.seq() && word.verifies_elsewhere(now)
                };
                if let Some(newer) = word.filter(is_newer) {
                    withdrawals.insert(newer.seq(), newer.signed().clone());
                }
            }
            frames.extend(withdrawals.into_values().map(|signed| Control::Advert { cost: 0, signed }));
        }
        frames
    }

    /// Returns the next record, between two numbers, for a router that did not ask: those of this node, or all. The
    /// router may have missed withdrawals, so it gets those, too.
    pub(super) fn next_for_router(
        &self,
        now: Instant,
        from: RecordId,
        end: RecordId,
        all: bool,
    ) -> Option<RecordId> {
        // Advertisements that an older withdrawal ended have no lease left.
        let oldest = now + 2 * CLOCK_SKEW_MAX - self.limits.lease_max;
        let is_told = |record: &Record| match record.kind() {
            RecordKind::Withdrawal => all && record.expires() > oldest,
            RecordKind::Advert => all || record.owner_id() == self.own,
        };
        self.records.range(from..end).find(|(_, record)| is_told(record)).map(|(id, _)| *id)
    }

    // ---- Records that come.

    /// Returns the bound that these names would exceed.
    pub(super) fn over_limit(
        &self,
        link: LinkId,
        owner: &NodeId,
        news: &[Name],
        kind: RecordKind,
    ) -> Option<&'static str> {
        let limits = &self.limits;
        if link == LinkId::LOCAL {
            return None;
        }
        if !self.owners.contains_key(owner) && self.owners.len() >= limits.nodes_max {
            return Some("owners");
        }
        let more = news.iter().filter(|n| self.id(n).is_none()).count();
        let of_owner = self.owners.get(owner).map_or(0, OwnerRecords::names);
        let over_link = self.over_link.get(&link).copied().unwrap_or_default();
        if kind == RecordKind::Withdrawal || more == 0 {
            None
        } else if of_owner + more > limits.names_per_owner_max {
            Some("names of an owner")
        } else if over_link + more > limits.names_per_router_max {
            Some("names over a link")
        } else if self.live() + more > limits.names_max {
            Some("names")
        } else {
            None
        }
    }

    /// Puts a record into force; it speaks for these names.
    pub(super) fn insert(&mut self, now: Instant, record: NewRecord, names: &[Name]) -> RecordId {
        let record = Record::new(record);
        let id = self.next_id;
        self.next_id += 1;
        self.seen.insert(*record.digest(), id);
        self.expiries.insert((record.expires(), id));
        if self.transit && !record.is_withdrawal() && record.owner_id() != self.own {
            self.renewals.insert((record.renewal_due(), id));
        }
        self.owners.entry(record.owner_id()).or_default().insert(id, &record);
        self.records.insert(id, record);
        for name in names {
            if let Some(old) = self.words.insert(*name, id) {
                self.release(now, old, 1, RecordEnd::Superseded);
            }
        }
        self.hold(now, id, names.len());
        id
    }

    /// Lets a record speak for one more of its names, unless a record that is as new does.
    pub(super) fn speak_for(&mut self, now: Instant, id: RecordId, name: &Name) {
        let Some(seq) = self.records.get(&id).map(Record::seq) else { return };
        if self.known_seq(name).is_none_or(|known| known < seq) {
            if let Some(old) = self.words.insert(*name, id) {
                self.release(now, old, 1, RecordEnd::Superseded);
            }
            self.hold(now, id, 1);
        }
    }

    /// Notes that the record of a name was asked for.
    pub(super) fn mark_asked(&mut self, now: Instant, name: &Name) {
        let record = self.id(name).and_then(|id| self.records.get_mut(&id));
        if let Some(record) = record {
            record.mark_asked(now);
        }
    }

    fn hold(&mut self, now: Instant, id: RecordId, names: usize) {
        let Some(record) = self.records.get_mut(&id) else { return };
        record.gain(names);
        let (owner, kind, from) = (record.owner_id(), record.kind(), record.link());
        self.count(&owner, kind, from, names, usize::saturating_add);
        self.release(now, id, 0, RecordEnd::Unwanted);
    }

    /// Counts names that a record gains or loses.
    fn count(
        &mut self,
        owner: &NodeId,
        kind: RecordKind,
        from: LinkId,
        names: usize,
        change: fn(usize, usize) -> usize,
    ) {
        let Some(of_owner) = self.owners.get_mut(owner) else { return };
        let (old, new) = of_owner.count(kind, |count| change(count, names));
        if kind == RecordKind::Withdrawal {
            self.withdrawn = self.withdrawn + new - old;
            self.most_withdrawn.remove(&(old, *owner));
            if new > 0 {
                self.most_withdrawn.insert((new, *owner));
            }
        } else if let Some(over_link) = self.over_link.get_mut(&from) {
            *over_link = change(*over_link, names);
        }
    }

    // ---- Records that go.

    /// Takes names from a record; without any it is removed.
    fn release(&mut self, now: Instant, id: RecordId, names: usize, end: RecordEnd) {
        let Some(record) = self.records.get_mut(&id) else { return };
        let is_gone = record.lose(names);
        let (owner, kind, from) = (record.owner_id(), record.kind(), record.link());
        self.count(&owner, kind, from, names, usize::saturating_sub);
        if !is_gone {
            return;
        }
        let Some(record) = self.records.remove(&id) else { return };
        self.seen.remove(record.digest());
        self.expiries.remove(&(record.expires(), id));
        self.renewals.remove(&(record.renewal_due(), id));
        self.waits_no_more(&owner, id);
        if let Some(of_owner) = self.owners.get_mut(&owner) {
            of_owner.remove(id, &record);
            if of_owner.is_empty() {
                self.owners.remove(&owner);
            }
        }
        let max = self.limits.nodes_max;
        let (seq, digest) = (record.seq(), *record.digest());
        match end {
            RecordEnd::Superseded => self.memory.superseded(now, &owner, seq, digest, max),
            RecordEnd::Ended => self.memory.ended(now, &owner, seq, digest, record.signed(), max),
            RecordEnd::Unwanted => {}
        }
    }

    /// Ends a record. Returns the names that it still spoke for.
    pub(super) fn forget(&mut self, now: Instant, id: RecordId, end: RecordEnd) -> Vec<Name> {
        let names = self.live_names(id);
        for name in &names {
            self.words.remove(name);
        }
        self.release(now, id, names.len(), end);
        names
    }

    /// Forgets the advertisement of a name that nobody here wants.
    pub(super) fn forget_unwanted(&mut self, now: Instant, name: &Name) {
        if let Some(id) = self.id(name) {
            self.words.remove(name);
            self.release(now, id, 1, RecordEnd::Unwanted);
        }
    }

    /// Returns the next record that has to make room: the oldest of an owner that has too many, then the oldest
    /// withdrawal of the owner with the most if there are too many in all.
    pub(super) fn surplus_of_owner(&self, owner: &NodeId) -> Option<RecordId> {
        let limits = &self.limits;
        let of_owner = self.owners.get(owner).filter(|_| *owner != self.own)?;
        let is_over = of_owner.len() > limits.adverts_per_owner_max
            || of_owner.bytes() > limits.advert_bytes_per_owner_max;
        if is_over { of_owner.oldest() } else { None }
    }

    /// Returns the oldest withdrawal of the owner with the most, if there are too many in all.
    pub(super) fn surplus_of_withdrawals(&self) -> Option<RecordId> {
        if self.withdrawn <= self.limits.tombstones_max {
            return None;
        }
        let (_, owner) = self.most_withdrawn.last()?;
        self.owners.get(owner)?.oldest_withdrawal()
    }

    /// Returns the advertisements of an owner with numbers below `floor`.
    pub(super) fn before(&self, owner: &NodeId, floor: u64) -> Vec<RecordId> {
        self.owners.get(owner).into_iter().flat_map(|of_owner| of_owner.adverts_below(floor)).collect()
    }

    /// Returns the records under certificates that are no longer believed.
    pub(super) fn untrusted(&self, is_untrusted: impl Fn(&[CertId]) -> bool) -> Vec<RecordId> {
        let gone = self.records.iter().filter(|(_, record)| is_untrusted(&record.owner().path));
        gone.map(|(id, _)| *id).collect()
    }

    /// Returns a record whose lease has ended, each once.
    pub(super) fn take_expired(&mut self, now: Instant) -> Option<RecordId> {
        let (at, id) = self.expiries.first().copied().filter(|(at, _)| *at <= now)?;
        self.expiries.remove(&(at, id));
        Some(id)
    }

    /// Returns an advertisement in the middle of its lease, each once.
    pub(super) fn take_renewal(&mut self, now: Instant) -> Option<RecordId> {
        let (at, id) = self.renewals.first().copied().filter(|(at, _)| *at <= now)?;
        self.renewals.remove(&(at, id));
        Some(id)
    }

    /// Forgets the numbers of records that cannot verify any more.
    pub(super) fn expire_memory(&mut self, now: Instant) {
        self.memory.expire(now);
    }

    /// Notes that a node's link state ended, with this floor.
    pub(super) fn run_ended(&mut self, now: Instant, node: &NodeId, floor: u64) {
        self.memory.run_ended(now, node, floor, self.limits.nodes_max);
    }

    // ---- Records that wait to be passed on.

    /// Lets a record wait.
    pub(super) fn wait(&mut self, owner: &NodeId, id: RecordId) {
        if self.records.contains_key(&id) {
            self.waiting.entry(*owner).or_default().insert(id);
        }
    }

    /// Ends the wait of a record.
    pub(super) fn waits_no_more(&mut self, owner: &NodeId, id: RecordId) {
        if let Some(waiting) = self.waiting.get_mut(owner) {
            waiting.remove(&id);
            if waiting.is_empty() {
                self.waiting.remove(owner);
            }
        }
    }

    /// Returns the owners of waiting records.
    pub(super) fn waiting(&self) -> Vec<NodeId> {
        self.waiting.keys().copied().collect()
    }

    /// Returns `true` if a record waits.
    pub(super) fn has_waiting(&self) -> bool {
        !self.waiting.is_empty()
    }

    /// Returns the owner's record that has waited for longest, and the link that brought it.
    pub(super) fn first_waiting(&self, owner: &NodeId) -> Option<(RecordId, LinkId)> {
        let id = self.waiting.get(owner)?.first()?;
        self.records.get(id).map(|record| (*id, record.link()))
    }
}
