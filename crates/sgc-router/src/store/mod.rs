//! The mapping `store`: the owners of names in an outside store that many routers share.
//!
//! [`Store`] decides which keys to read and write: it joins look-ups of one name, keeps values that were read lately,
//! bounds the operations under way, and repeats writes that failed. It knows neither records nor links, and believes no
//! value: the router verifies what is found, and says what to write.

mod cache;
mod op;
mod value;

use std::collections::{BTreeMap, BTreeSet, VecDeque};
use std::time::{Duration, Instant};

use bytes::Bytes;
use sgc_wire::{Decode, Encode, Name, NodeId};

use self::cache::Cache;
pub use self::op::{
    BATCH_TAG_LEN, BatchTag, StoreAction, StoreEvent, StoreFailure, StoreKey, StoreOp, StoreOpId, StoreReply,
    WriteIf,
};
pub use self::value::STORE_VALUE_BYTES_MAX;
pub(crate) use self::value::{NameEntry, batch_tag, decode_signed, encode_signed};
use crate::names::RecordId;

/// Operations under way at one time.
const OPS_MAX: usize = 1024;
/// Writes under way or waiting beyond which no further work begins.
const WRITES_MAX: usize = 512;
/// Look-ups under way at one time.
const LOOK_UPS_MAX: usize = 16_384;
/// Time after which an operation without a result counts as failed.
const OP_TIMEOUT: Duration = Duration::from_secs(10);
/// Least and longest time after which a write that failed is repeated.
const RETRY_MIN: Duration = Duration::from_secs(1);
const RETRY_MAX: Duration = Duration::from_secs(32);
/// Time between two steps of the work that a store needs when it answers again.
const PACE: Duration = Duration::from_micros(500);
/// Time for each name that is written again when a store answers again although it has the batch of the name.
const NAME_PACE: Duration = Duration::from_millis(2);
/// Batches whose first write may have reached the store although it failed. Names of further ones are written when a
/// question shows that the store lacks them.
const UNSURE_MAX: usize = 16_384;

/// The state of a router's store, for status.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct StoreStats {
    /// Time since which the store does not answer; `None` while it does.
    pub down_since: Option<Instant>,
    /// Time of the last operation that the store refused; `None` if it carried out a write since.
    pub refused_at: Option<Instant>,
    /// Values that are kept.
    pub cached: usize,
    /// Memory of them, bytes.
    pub cached_bytes: usize,
    /// Operations and steps of work that are under way or wait.
    pub pending: usize,
    /// Operations so far.
    pub operations: u64,
    /// Operations that failed.
    pub failures: u64,
    /// Look-ups that found a name.
    pub found: u64,
    /// Look-ups of names that the store does not have.
    pub absent: u64,
    /// Values that were not what their key says.
    pub refused: u64,
    /// Names that the store had lost, and that were written again.
    pub healed: u64,
    /// Names without a batch that were removed.
    pub orphans: u64,
}

/// Work that ends in writes, or in a look-up.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub(crate) enum Work {
    /// Write a node's link state.
    Node(NodeId),
    /// Look a name up again.
    LookUp(Name),
    /// Write a record of names that had none here, as [`Work::Record`] does.
    NewRecord(RecordId),
    /// Write a record, and its names if the store did not have the record's batch.
    Record(RecordId),
    /// Write the names of a record.
    NamesOf(RecordId),
    /// Write the names of a record that the store does not have.
    Refill(RecordId),
    /// Write one name if the store has lost it.
    Check(Name),
}

/// The result of a look-up.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum LookUpEnd {
    /// The record of this batch was handed over.
    Found(NameEntry),
    /// The store does not have the name.
    Absent,
    /// The store did not answer.
    Unavailable,
}

/// The beginning of a look-up.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum LookUpStart {
    /// It is under way.
    UnderWay,
    /// There is no store, it does not answer, or too many look-ups are under way. One may be under way all the same.
    Unavailable,
}

/// News for the router.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(crate) enum Finding {
    /// The store answers; it may have lost everything.
    Up,
    /// A key that was read has another value.
    Changed(StoreKey),
    /// A signed body, not verified.
    Signed { key: StoreKey, value: Bytes },
    /// A look-up ended.
    LookedUp {
        name: Name,
        end: LookUpEnd,
        /// Whether the router was told not to wait for it.
        others_asked: bool,
    },
}

/// A look-up under way.
#[derive(Debug)]
struct LookUp {
    /// Whether the router was told not to wait for it.
    others_asked: bool,
    state: LookUpState,
}

#[derive(Debug)]
enum LookUpState {
    ExpectEntry,
    ExpectBatch(ExpectBatch),
}

/// A look-up that knows the batch of its name. Values are `None` until they are read.
#[derive(Debug)]
struct ExpectBatch {
    entry: NameEntry,
    batch: Option<Option<Bytes>>,
    node: Option<Option<Bytes>>,
}

/// The reasons for a read.
#[derive(Debug, Default)]
struct Readers {
    look_ups: BTreeSet<Name>,
    /// The value is wanted by the router.
    refresh: bool,
    /// The value that the key should have.
    expected: Option<NameEntry>,
    /// Names that were removed because this batch had no value.
    orphans: Vec<(Name, NameEntry)>,
    /// The key changed since the read began.
    is_outdated: bool,
}

/// The reason for an operation.
#[derive(Clone, Debug)]
enum Purpose {
    Read,
    /// The work to repeat if it fails, and its following step if the key had no value.
    Write {
        work: Work,
        then: Option<Work>,
    },
    /// Remove a name whose batch has no value.
    RemoveOrphan {
        name: Name,
        entry: NameEntry,
    },
    /// Write a name again whose batch has a value after all.
    Restore,
}

#[derive(Debug)]
struct Operation {
    key: StoreKey,
    began: Instant,
    purpose: Purpose,
}

/// The store as the router sees it.
#[derive(Debug)]
pub(crate) struct Store {
    cache: Cache,
    next_op: u64,
    under_way: BTreeMap<StoreOpId, Operation>,
    waiting: VecDeque<(StoreKey, StoreAction, Purpose)>,
    /// Writes under way and waiting.
    writes: usize,
    reads: BTreeMap<StoreKey, Readers>,
    look_ups: BTreeMap<Name, LookUp>,
    work: BTreeSet<Work>,
    /// Work that is due at a time.
    later: BTreeSet<(Instant, Work)>,
    /// Records whose names are written again one after another, with the number of these, and the time of the next.
    refills: BTreeMap<RecordId, usize>,
    refill_at: Instant,
    /// Work to be repeated because a write failed.
    repetitions: BTreeMap<Work, Instant>,
    /// Batches that the store may have got from a first write that failed, without their names.
    unsure: BTreeSet<StoreKey>,
    /// Repetitions since the last write that succeeded.
    failures_in_row: u32,
    findings: VecDeque<Finding>,
    stats: StoreStats,
}

impl Store {
    pub(crate) fn new(now: Instant, cache_bytes_max: usize) -> Self {
        Self {
            cache: Cache::new(cache_bytes_max),
            next_op: 0,
            under_way: BTreeMap::new(),
            waiting: VecDeque::new(),
            writes: 0,
            reads: BTreeMap::new(),
            look_ups: BTreeMap::new(),
            work: BTreeSet::new(),
            later: BTreeSet::new(),
            refills: BTreeMap::new(),
            refill_at: now,
            repetitions: BTreeMap::new(),
            unsure: BTreeSet::new(),
            failures_in_row: 0,
            findings: VecDeque::new(),
            stats: StoreStats { down_since: Some(now), ..StoreStats::default() },
        }
    }

    /// Returns the state for status.
    pub(crate) fn stats(&self) -> StoreStats {
        StoreStats {
            cached: self.cache.len(),
            cached_bytes: self.cache.bytes(),
            pending: self.under_way.len()
                + self.waiting.len()
                + self.work.len()
                + self.later.len()
                + self.refills.len(),
            ..self.stats
        }
    }

    // ---- News from the driver.

    /// Takes news from the driver.
    pub(crate) fn handle(&mut self, now: Instant, event: StoreEvent) {
        match event {
            StoreEvent::Up => {
                self.stats.down_since = None;
                self.failures_in_row = 0;
                self.cache.clear();
                self.reads.values_mut().for_each(|readers| readers.is_outdated = true);
                self.findings.push_back(Finding::Up);
            }
            StoreEvent::Down => {
                self.stats.down_since.get_or_insert(now);
            }
            StoreEvent::Changed(key) => {
                self.cache.remove(&key);
                if let Some(readers) = self.reads.get_mut(&key) {
                    readers.is_outdated = true;
                }
                self.findings.push_back(Finding::Changed(key));
            }
            StoreEvent::Reply { id, result } => {
                if let Some(operation) = self.under_way.remove(&id) {
                    self.end_operation(now, operation, result);
                }
            }
        }
    }

    /// Acts on operations whose results are overdue, and on work that is due.
    pub(crate) fn handle_timeout(&mut self, now: Instant) {
        while let Some(overdue) = self.under_way.first_entry().filter(|op| op.get().began + OP_TIMEOUT <= now)
        {
            let operation = overdue.remove();
            self.end_operation(now, operation, Err(StoreFailure::Unreachable));
        }
        while let Some((at, work)) = self.later.first().copied().filter(|(at, _)| *at <= now) {
            self.later.remove(&(at, work));
            if self.repetitions.get(&work) == Some(&at) {
                self.repetitions.remove(&work);
            }
            self.work.insert(work);
        }
        if self.refill_at <= now
            && let Some((id, names)) = self.refills.pop_first()
        {
            self.refill_at = now + NAME_PACE * u32::try_from(names).unwrap_or(u32::MAX);
            self.work.insert(Work::Refill(id));
        }
    }

    /// Returns the times of the next timeouts.
    pub(crate) fn deadlines(&self) -> impl Iterator<Item = Instant> {
        let overdue = self.under_way.first_key_value().map(|(_, op)| op.began + OP_TIMEOUT);
        let refill = (!self.refills.is_empty()).then_some(self.refill_at);
        overdue.into_iter().chain(self.later.first().map(|(at, _)| *at)).chain(refill)
    }

    /// Returns the next news for the router.
    pub(crate) fn take_finding(&mut self) -> Option<Finding> {
        self.findings.pop_front()
    }

    /// Returns the next operation for the driver.
    pub(crate) fn take_operation(&mut self, now: Instant) -> Option<StoreOp> {
        if self.under_way.len() >= OPS_MAX {
            return None;
        }
        let (key, action, purpose) = self.waiting.pop_front()?;
        let id = StoreOpId(self.next_op);
        self.next_op += 1;
        self.stats.operations += 1;
        self.under_way.insert(id, Operation { key, began: now, purpose });
        Some(StoreOp { id, key, action })
    }

    fn end_operation(
        &mut self,
        now: Instant,
        operation: Operation,
        result: Result<StoreReply, StoreFailure>,
    ) {
        let Operation { key, purpose, .. } = operation;
        if result.is_err() {
            self.stats.failures += 1;
        }
        match &result {
            Err(StoreFailure::Refused) => self.stats.refused_at = Some(now),
            // Rights and memory may suffice for reading, and not for writing.
            Ok(StoreReply::Written { .. }) => self.stats.refused_at = None,
            _ => {}
        }
        match purpose {
            Purpose::Read => match result {
                Ok(StoreReply::Value(value)) => self.end_read(now, key, value),
                _ => self.fail_read(&key),
            },
            Purpose::Write { work, then } => {
                self.writes -= 1;
                match result {
                    Ok(StoreReply::Written { existed }) => {
                        self.failures_in_row = 0;
                        let is_new = self.unsure.remove(&key) || !existed;
                        self.work.extend(then.filter(|_| is_new));
                    }
                    _ => {
                        if matches!(work, Work::NewRecord(_)) && self.unsure.len() < UNSURE_MAX {
                            self.unsure.insert(key);
                        }
                        self.repeat(now, work);
                    }
                }
            }
            Purpose::RemoveOrphan { name, entry } => {
                self.writes -= 1;
                if result.is_ok() {
                    self.stats.orphans += 1;
                    self.read(entry.batch(), |readers| readers.orphans.push((name, entry)));
                }
            }
            Purpose::Restore => self.writes -= 1,
        }
    }

    // ---- Looking names up.

    /// Begins to look a name up, unless that is under way.
    pub(crate) fn look_up(&mut self, now: Instant, name: Name) -> LookUpStart {
        if !self.look_ups.contains_key(&name) {
            if self.look_ups.len() >= LOOK_UPS_MAX {
                return LookUpStart::Unavailable;
            }
            self.look_ups.insert(name, LookUp { others_asked: false, state: LookUpState::ExpectEntry });
            self.want(now, name, StoreKey::Name(name));
        }
        if self.stats.down_since.is_none() {
            return LookUpStart::UnderWay;
        }
        if let Some(look_up) = self.look_ups.get_mut(&name) {
            look_up.others_asked = true;
        }
        LookUpStart::Unavailable
    }

    /// Takes a value for a look-up from the cache, or reads it.
    fn want(&mut self, now: Instant, name: Name, key: StoreKey) {
        match self.cache.get(now, &key) {
            Some(value) => self.advance(now, name, &key, value),
            None => self.read(key, |readers| {
                readers.look_ups.insert(name);
            }),
        }
    }

    /// Gives a look-up the value of a key.
    fn advance(&mut self, now: Instant, name: Name, key: &StoreKey, value: Option<Bytes>) {
        match self.look_ups.get_mut(&name).map(|look_up| &mut look_up.state) {
            Some(LookUpState::ExpectEntry) => self.take_entry(now, name, key, value),
            Some(LookUpState::ExpectBatch(expected)) => {
                if *key == expected.entry.batch() {
                    expected.batch = Some(value);
                } else if *key == StoreKey::Node(expected.entry.owner) {
                    expected.node = Some(value);
                }
                let ExpectBatch { entry, batch: Some(batch), node: Some(node) } = expected else { return };
                let (entry, batch, node) = (*entry, batch.take(), node.take());
                self.take_batch(name, entry, batch, node);
            }
            None => {}
        }
    }

    fn take_entry(&mut self, now: Instant, name: Name, key: &StoreKey, value: Option<Bytes>) {
        let Some(value) = value else { return self.end_look_up(name, LookUpEnd::Absent) };
        let Ok(entry) = NameEntry::from_slice(&value) else {
            self.refuse(&[*key]);
            return self.end_look_up(name, LookUpEnd::Absent);
        };
        if let Some(look_up) = self.look_ups.get_mut(&name) {
            look_up.state = LookUpState::ExpectBatch(ExpectBatch { entry, batch: None, node: None });
        }
        self.want(now, name, entry.batch());
        self.want(now, name, StoreKey::Node(entry.owner));
    }

    fn take_batch(&mut self, name: Name, entry: NameEntry, batch: Option<Bytes>, node: Option<Bytes>) {
        let Some(batch) = batch else {
            self.remove_orphan(name, entry);
            return self.end_look_up(name, LookUpEnd::Absent);
        };
        // The owner's place first, so that there is a route when the name is known.
        if let Some(value) = node {
            self.findings.push_back(Finding::Signed { key: StoreKey::Node(entry.owner), value });
        }
        self.findings.push_back(Finding::Signed { key: entry.batch(), value: batch });
        self.end_look_up(name, LookUpEnd::Found(entry));
    }

    fn end_look_up(&mut self, name: Name, end: LookUpEnd) {
        let others_asked = self.look_ups.remove(&name).is_some_and(|look_up| look_up.others_asked);
        match end {
            LookUpEnd::Found(_) => self.stats.found += 1,
            LookUpEnd::Absent => self.stats.absent += 1,
            LookUpEnd::Unavailable => {}
        }
        self.findings.push_back(Finding::LookedUp { name, end, others_asked });
    }

    /// Reads a key whose value is wanted, as a [`Finding::Signed`].
    pub(crate) fn refresh(&mut self, key: StoreKey) {
        self.read(key, |readers| readers.refresh = true);
    }

    /// Counts values that are not what their keys say, and forgets them.
    pub(crate) fn refuse(&mut self, keys: &[StoreKey]) {
        self.stats.refused += 1;
        keys.iter().for_each(|key| self.cache.remove(key));
    }

    fn read(&mut self, key: StoreKey, join: impl FnOnce(&mut Readers)) {
        let is_new = !self.reads.contains_key(&key);
        join(self.reads.entry(key).or_default());
        if is_new {
            self.waiting.push_back((key, StoreAction::Read, Purpose::Read));
        }
    }

    fn end_read(&mut self, now: Instant, key: StoreKey, value: Option<Bytes>) {
        let Some(readers) = self.reads.get_mut(&key) else { return };
        if std::mem::take(&mut readers.is_outdated) {
            self.waiting.push_back((key, StoreAction::Read, Purpose::Read));
            return;
        }
        let Some(readers) = self.reads.remove(&key) else { return };
        self.cache.insert(now, key, value.clone());
        if let Some(expected) = readers.expected {
            self.heal(key, expected, value.as_ref());
        }
        for (name, entry) in readers.orphans {
            if value.is_some() {
                let action = StoreAction::Write {
                    value: entry.to_bytes(),
                    lifetime: None,
                    condition: WriteIf::Absent,
                };
                self.push_write(StoreKey::Name(name), action, Purpose::Restore);
            }
        }
        if readers.refresh
            && let Some(value) = value.clone()
        {
            self.findings.push_back(Finding::Signed { key, value });
        }
        for name in readers.look_ups {
            self.advance(now, name, &key, value.clone());
        }
    }

    fn fail_read(&mut self, key: &StoreKey) {
        let Some(readers) = self.reads.remove(key) else { return };
        for name in readers.look_ups {
            if self.look_ups.contains_key(&name) {
                self.end_look_up(name, LookUpEnd::Unavailable);
            }
        }
    }

    // ---- Writing.

    /// Adds work, unless it waits already.
    pub(crate) fn add_work(&mut self, work: Work) {
        self.work.insert(work);
    }

    /// Adds work that is done little by little.
    pub(crate) fn add_paced(&mut self, now: Instant, work: impl IntoIterator<Item = Work>) {
        let mut at = now;
        for work in work {
            self.later.insert((at, work));
            at += PACE;
        }
    }

    /// Lets the names of these records be written again, those that the store does not have: a server that lost them may
    /// not be the one with their batch. Each record comes with the number of its names.
    pub(crate) fn refill(&mut self, records: impl IntoIterator<Item = (RecordId, usize)>) {
        self.refills = records.into_iter().collect();
    }

    /// Notes that all names of a record are written.
    pub(crate) fn need_not_refill(&mut self, id: RecordId) {
        self.refills.remove(&id);
    }

    /// Returns the next work, if there is room for its writes.
    pub(crate) fn take_work(&mut self) -> Option<Work> {
        if self.writes >= WRITES_MAX { None } else { self.work.pop_first() }
    }

    /// Writes a value for `work`, which is repeated if the write fails. `then` follows if the key had no value.
    pub(crate) fn write(
        &mut self,
        key: StoreKey,
        value: Bytes,
        lifetime: Option<Duration>,
        work: Work,
        then: Option<Work>,
    ) {
        if value.len() > STORE_VALUE_BYTES_MAX {
            return self.refuse(&[]);
        }
        // A name that is there keeps its value, so that no router that read it hears of a change.
        let condition = if matches!(work, Work::Refill(_)) { WriteIf::Absent } else { WriteIf::Always };
        let action = StoreAction::Write { value, lifetime, condition };
        self.push_write(key, action, Purpose::Write { work, then });
    }

    /// Writes the batch of a name, unless the store has it.
    pub(crate) fn check(&mut self, now: Instant, name: Name, expected: NameEntry) {
        let key = StoreKey::Name(name);
        match self.cache.get(now, &key) {
            Some(value) => self.heal(key, expected, value.as_ref()),
            None => self.read(key, |readers| readers.expected = Some(expected)),
        }
    }

    fn heal(&mut self, key: StoreKey, expected: NameEntry, value: Option<&Bytes>) {
        let StoreKey::Name(name) = key else { return };
        let expected = expected.to_bytes();
        if value != Some(&expected) {
            self.stats.healed += 1;
            self.write(key, expected, None, Work::Check(name), None);
        }
    }

    fn remove_orphan(&mut self, name: Name, entry: NameEntry) {
        let key = StoreKey::Name(name);
        self.cache.remove(&key);
        self.cache.remove(&entry.batch());
        let action = StoreAction::Remove { value: entry.to_bytes() };
        self.push_write(key, action, Purpose::RemoveOrphan { name, entry });
    }

    fn push_write(&mut self, key: StoreKey, action: StoreAction, purpose: Purpose) {
        self.cache.remove(&key);
        if let Some(readers) = self.reads.get_mut(&key) {
            readers.is_outdated = true;
        }
        self.writes += 1;
        self.waiting.push_back((key, action, purpose));
    }

    fn repeat(&mut self, now: Instant, work: Work) {
        // One repetition serves all writes of the work that failed.
        if self.repetitions.contains_key(&work) {
            return;
        }
        let wait = (RETRY_MIN * 2u32.saturating_pow(self.failures_in_row.min(5))).min(RETRY_MAX);
        self.failures_in_row = self.failures_in_row.saturating_add(1);
        self.repetitions.insert(work, now + wait);
        self.later.insert((now + wait, work));
    }
}

#[cfg(test)]
mod tests;
