//! Bounds on the new revocation lists of one CA that are taken from neighbours.
//!
//! A new list is verified, stored and passed on to every neighbour, so the holder of a partner's CA key could make the
//! whole mesh do that without end. This module decides when a list is due; `trust.rs` verifies it and passes it on.

use std::collections::BTreeMap;
use std::time::{Duration, Instant};

use bytes::Bytes;
use sgc_trust::{CaFingerprint, CrlNumber};

use crate::limits::budget::Budget;
use crate::link_id::LinkId;

/// Lists of a CA that are taken in a second, once its burst is used.
const LISTS_PER_SECOND: u32 = 1;
/// Shortest time until a waiting list is looked at again.
const RETRY_MIN: Duration = Duration::from_millis(10);

/// The remaining allowance of each CA, except the node's own fleet. The caller names trusted CAs only, which bounds it.
#[derive(Debug, Default)]
pub(crate) struct ListAllowances {
    cas: BTreeMap<CaFingerprint, ListAllowance>,
}

#[derive(Debug)]
struct ListAllowance {
    budget: Budget,
    waiting: Option<WaitingList>,
    retry_at: Instant,
}

/// The newest list that came beyond the allowance of its CA.
#[derive(Clone, Debug)]
pub(crate) struct WaitingList {
    /// The link that brought it.
    pub(crate) from: LinkId,
    /// Its content.
    pub(crate) der: Bytes,
    number: CrlNumber,
}

impl ListAllowances {
    /// Takes one list of `ca`. Returns `false` if none is left.
    pub(crate) fn take(&mut self, now: Instant, ca: CaFingerprint, burst: u32) -> bool {
        let budget = || Budget::new(burst, LISTS_PER_SECOND);
        let new = || ListAllowance { budget: budget(), waiting: None, retry_at: now };
        self.cas.entry(ca).or_insert_with(new).budget.take(now, 1, 1)
    }

    /// Keeps a list until its CA has room, unless a newer one of that CA waits.
    pub(crate) fn wait(
        &mut self,
        now: Instant,
        ca: &CaFingerprint,
        number: CrlNumber,
        from: LinkId,
        der: Bytes,
    ) {
        let Some(allowance) = self.cas.get_mut(ca) else { return };
        if allowance.waiting.as_ref().is_none_or(|waiting| number > waiting.number) {
            allowance.waiting = Some(WaitingList { from, der, number });
            allowance.retry_at = allowance.budget.next_at(now).max(now + RETRY_MIN);
        }
    }

    /// Returns `true` if this very list waits.
    pub(crate) fn awaits(&self, der: &Bytes) -> bool {
        self.cas.values().filter_map(|ca| ca.waiting.as_ref()).any(|waiting| waiting.der == *der)
    }

    /// Returns the time of the next look at a waiting list.
    pub(crate) fn next_at(&self) -> Option<Instant> {
        self.cas.values().filter(|ca| ca.waiting.is_some()).map(|ca| ca.retry_at).min()
    }

    /// Removes and returns the lists that are due for another look.
    pub(crate) fn due(&mut self, now: Instant) -> Vec<WaitingList> {
        let due = self.cas.values_mut().filter(|ca| ca.retry_at <= now);
        due.filter_map(|ca| ca.waiting.take()).collect()
    }

    /// Forgets the CAs that are no longer trusted.
    pub(crate) fn retain(&mut self, is_trusted: impl Fn(&CaFingerprint) -> bool) {
        self.cas.retain(|ca, _| is_trusted(ca));
    }
}
