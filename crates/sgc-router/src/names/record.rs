//! A verified advertisement or withdrawal, and those of one owner.

use std::collections::BTreeSet;
use std::sync::Arc;
use std::time::Instant;

use sgc_trust::VerifiedPeer;
use sgc_wire::{Name, SignedBody, UnixMillis};

use crate::link_id::LinkId;

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

/// A verified advertisement or withdrawal.
#[derive(Debug)]
pub(super) struct Record {
    /// Shared with the branches of its names.
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
    /// Names that no newer one speaks for.
    pub(super) live: usize,
    /// The link that brought it first.
    pub(super) from: LinkId,
    /// Time of the question for it; `None` if it came unasked.
    pub(super) asked: Option<Instant>,
}

impl Record {
    /// Returns `true` for a withdrawal.
    pub(super) fn is_withdrawal(&self) -> bool {
        self.kind == RecordKind::Withdrawal
    }

    /// Returns its part of its owner's share of memory, bytes.
    pub(super) fn bytes(&self) -> usize {
        RECORD_BYTES + self.signed.body.len() + self.signed.signature.len() + self.names.len() * NAME_BYTES
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
    pub(super) records: BTreeSet<(u64, RecordId)>,
    /// Its withdrawals, by sequence number.
    pub(super) withdrawals: BTreeSet<(u64, RecordId)>,
    /// Names that advertisements speak for.
    pub(super) names: usize,
    /// Names that withdrawals speak for.
    pub(super) withdrawn: usize,
    /// Memory that both take.
    pub(super) bytes: usize,
}

impl OwnerRecords {
    /// Returns the records of a kind, and the number of names that they speak for.
    pub(super) fn of_kind(&mut self, kind: RecordKind) -> (&mut BTreeSet<(u64, RecordId)>, &mut usize) {
        match kind {
            RecordKind::Withdrawal => (&mut self.withdrawals, &mut self.withdrawn),
            RecordKind::Advert => (&mut self.records, &mut self.names),
        }
    }

    /// Returns the first record to give way: a withdrawal, because the memory keeps its number.
    pub(super) fn oldest(&self) -> Option<RecordId> {
        self.withdrawals.first().or(self.records.first()).map(|(_, id)| *id)
    }

    /// Returns the record with the greatest sequence number.
    pub(super) fn newest(&self) -> Option<(u64, RecordId)> {
        self.records.last().max(self.withdrawals.last()).copied()
    }

    /// Returns `true` if it has no record.
    pub(super) fn is_empty(&self) -> bool {
        self.records.is_empty() && self.withdrawals.is_empty()
    }
}
