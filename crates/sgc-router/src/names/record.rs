//! A verified advertisement or withdrawal, and those of one owner.

use std::collections::BTreeSet;
use std::sync::{Arc, OnceLock};
use std::time::Instant;

use sgc_trust::VerifiedPeer;
use sgc_wire::{Name, NodeId, Now, SignedBody, UnixMillis};

use crate::lease::verifies_elsewhere;
use crate::link_id::LinkId;
use crate::store::{BatchTag, NameEntry, batch_tag};

/// Approximate memory of a record beside its signed bytes, bytes.
const RECORD_BYTES: usize = 512;
/// Memory of each of its names, bytes.
const NAME_BYTES: usize = 128;

/// Number of a [`Record`]; never used again while the process lives.
pub(crate) type RecordId = u64;

/// The statement of a record about its names.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum RecordKind {
    /// The owner has them.
    Advert,
    /// The owner no longer has them.
    Withdrawal,
}

/// A verified advertisement or withdrawal as it came.
#[derive(Debug)]
pub(super) struct NewRecord {
    pub(super) owner: Arc<VerifiedPeer>,
    pub(super) seq: u64,
    pub(super) kind: RecordKind,
    pub(super) names: Box<[Name]>,
    pub(super) signed: SignedBody,
    pub(super) issued_at: UnixMillis,
    pub(super) digest: [u8; 32],
    /// End of its lease; for a withdrawal, the time from which no withdrawn advertisement verifies.
    pub(super) expires: Instant,
    /// The middle of its lease: owners renew after a third.
    pub(super) renewal_due: Instant,
    /// The link that brought it first.
    pub(super) from: LinkId,
    /// Time of the question for it; `None` if it came unasked.
    pub(super) asked: Option<Instant>,
}

/// A record in force.
#[derive(Debug)]
pub(crate) struct Record {
    announced: NewRecord,
    /// Names that no newer one speaks for.
    live: usize,
    /// The tag of its batch in a store.
    tag: OnceLock<BatchTag>,
}

impl Record {
    /// Returns a record that speaks for no name yet.
    pub(super) fn new(announced: NewRecord) -> Self {
        Self { announced, live: 0, tag: OnceLock::new() }
    }

    /// Returns the owner, which the branches of its names share.
    pub(super) fn owner(&self) -> &Arc<VerifiedPeer> {
        &self.announced.owner
    }

    /// Returns the id of the owner.
    pub(crate) fn owner_id(&self) -> NodeId {
        self.announced.owner.node_id
    }

    /// Returns its sequence number.
    pub(super) fn seq(&self) -> u64 {
        self.announced.seq
    }

    /// Returns its kind.
    pub(crate) fn kind(&self) -> RecordKind {
        self.announced.kind
    }

    /// Returns `true` for a withdrawal.
    pub(super) fn is_withdrawal(&self) -> bool {
        self.announced.kind == RecordKind::Withdrawal
    }

    /// Returns its names, also those that a newer one speaks for.
    pub(crate) fn names(&self) -> &[Name] {
        &self.announced.names
    }

    /// Returns the value of its names in a store.
    pub(crate) fn store_entry(&self) -> NameEntry {
        let tag = *self.tag.get_or_init(|| batch_tag(self.names()));
        NameEntry { owner: self.owner_id(), tag }
    }

    /// Returns it as its owner signed it.
    pub(crate) fn signed(&self) -> &SignedBody {
        &self.announced.signed
    }

    /// Returns the digest of the signed message.
    pub(super) fn digest(&self) -> &[u8; 32] {
        &self.announced.digest
    }

    /// Returns the end of its lease.
    pub(crate) fn expires(&self) -> Instant {
        self.announced.expires
    }

    /// Returns the middle of its lease.
    pub(super) fn renewal_due(&self) -> Instant {
        self.announced.renewal_due
    }

    /// Returns the link that brought it first.
    pub(super) fn link(&self) -> LinkId {
        self.announced.from
    }

    /// Returns the time of the question for it; `None` if it came unasked.
    pub(super) fn asked(&self) -> Option<Instant> {
        self.announced.asked
    }

    /// Notes that it was asked for.
    pub(super) fn mark_asked(&mut self, now: Instant) {
        self.announced.asked = Some(now);
    }

    /// Returns `true` if other nodes believe it now.
    pub(super) fn verifies_elsewhere(&self, now: Now) -> bool {
        verifies_elsewhere(now, self.announced.issued_at)
    }

    /// Returns the number of names that no newer record speaks for.
    pub(crate) fn live(&self) -> usize {
        self.live
    }

    /// Returns `true` if newer records speak for some of its names.
    pub(super) fn is_partly_void(&self) -> bool {
        self.live < self.announced.names.len()
    }

    /// Notes that it speaks for so many more names.
    pub(super) fn gain(&mut self, names: usize) {
        self.live += names;
    }

    /// Notes that newer records speak for so many of its names. Returns `true` if it speaks for none.
    pub(super) fn lose(&mut self, names: usize) -> bool {
        self.live = self.live.saturating_sub(names);
        self.live == 0
    }

    /// Returns its part of its owner's share of memory, bytes.
    fn bytes(&self) -> usize {
        let SignedBody { body, signature } = self.signed();
        RECORD_BYTES + body.len() + signature.len() + self.names().len() * NAME_BYTES
    }
}

/// The reason why a record no longer counts.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum RecordEnd {
    /// Newer records speak for its names.
    Superseded,
    /// Its lease has ended, its certificate is no longer believed, or it had to make room.
    Ended,
    /// This node does not want its names; it may come again.
    Unwanted,
}

/// The advertisements and withdrawals of one owner.
#[derive(Debug, Default)]
pub(super) struct OwnerRecords {
    /// Its advertisements, by sequence number.
    adverts: BTreeSet<(u64, RecordId)>,
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
    /// Adds a record.
    pub(super) fn insert(&mut self, id: RecordId, record: &Record) {
        self.bytes += record.bytes();
        self.of_kind(record.kind()).insert((record.seq(), id));
    }

    /// Removes a record.
    pub(super) fn remove(&mut self, id: RecordId, record: &Record) {
        self.of_kind(record.kind()).remove(&(record.seq(), id));
        self.bytes = self.bytes.saturating_sub(record.bytes());
    }

    fn of_kind(&mut self, kind: RecordKind) -> &mut BTreeSet<(u64, RecordId)> {
        match kind {
            RecordKind::Withdrawal => &mut self.withdrawals,
            RecordKind::Advert => &mut self.adverts,
        }
    }

    /// Changes the number of names that the records of a kind speak for. Returns the old one and the new one.
    pub(super) fn count(&mut self, kind: RecordKind, change: impl FnOnce(usize) -> usize) -> (usize, usize) {
        let count = match kind {
            RecordKind::Withdrawal => &mut self.withdrawn,
            RecordKind::Advert => &mut self.names,
        };
        let old = *count;
        *count = change(old);
        (old, *count)
    }

    /// Returns the number of names that its advertisements speak for.
    pub(crate) fn names(&self) -> usize {
        self.names
    }

    /// Returns the number of its records.
    pub(super) fn len(&self) -> usize {
        self.adverts.len() + self.withdrawals.len()
    }

    /// Returns the memory that its records take.
    pub(super) fn bytes(&self) -> usize {
        self.bytes
    }

    /// Iterates over its advertisements, by sequence number.
    pub(super) fn adverts(&self) -> impl Iterator<Item = RecordId> {
        self.adverts.iter().map(|(_, id)| *id)
    }

    /// Iterates over its advertisements and withdrawals.
    pub(super) fn ids(&self) -> impl Iterator<Item = RecordId> {
        self.adverts.iter().chain(&self.withdrawals).map(|(_, id)| *id)
    }

    /// Iterates over its advertisements with numbers below `floor`.
    pub(super) fn adverts_below(&self, floor: u64) -> impl Iterator<Item = RecordId> {
        self.adverts.range(..(floor, 0)).map(|(_, id)| *id)
    }

    /// Returns the first record to give way: a withdrawal, because the memory keeps its number.
    pub(super) fn oldest(&self) -> Option<RecordId> {
        self.oldest_withdrawal().or_else(|| self.adverts().next())
    }

    /// Returns its oldest withdrawal.
    pub(super) fn oldest_withdrawal(&self) -> Option<RecordId> {
        self.withdrawals.first().map(|(_, id)| *id)
    }

    /// Returns the record with the greatest sequence number, and the number.
    pub(super) fn newest(&self) -> Option<(u64, RecordId)> {
        self.adverts.last().max(self.withdrawals.last()).copied()
    }

    /// Returns `true` if it has no record.
    pub(super) fn is_empty(&self) -> bool {
        self.adverts.is_empty() && self.withdrawals.is_empty()
    }
}
