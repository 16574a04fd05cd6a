//! [`Memory`]: announcements that are no longer in force, so that none of them becomes news again.
//!
//! A signed announcement verifies for minutes after it was superseded or its lease ended. The memory keeps a few
//! digests and one number for each signer, so no signer can displace the memory of another.

use std::collections::{BTreeMap, BTreeSet, VecDeque};
use std::time::Instant;

use sgc_trust::CLOCK_SKEW_MAX;
use sgc_wire::{NodeId, SignedBody};

/// Digests remembered of one signer. Neighbours repeat the last few announcements of a node when paths differ in speed
/// or a partition ends; they are recognised without verifying them again.
const DIGESTS_MAX: usize = 8;

/// The memory of one signer.
#[derive(Debug)]
struct SignerMemory {
    /// Announcements with lower numbers are void.
    floor: u64,
    /// The floor in the signer's last link state, which ended.
    run_floor: u64,
    /// The announcement with the greatest number that ended without a newer one; its signer has to exceed the number.
    newest: Option<(u64, SignedBody)>,
    digests: VecDeque<[u8; 32]>,
    /// Time after which no earlier announcement verifies any more.
    until: Instant,
}

/// Announcements of all signers that are no longer in force.
#[derive(Debug, Default)]
pub(crate) struct Memory {
    signers: BTreeMap<NodeId, SignerMemory>,
    digests: BTreeMap<[u8; 32], (NodeId, u64)>,
    forgets: BTreeSet<(Instant, NodeId)>,
}

impl Memory {
    /// Returns signer and sequence number of a remembered announcement, by its digest.
    pub(crate) fn known(&self, digest: &[u8; 32]) -> Option<(NodeId, u64)> {
        self.digests.get(digest).copied()
    }

    /// Returns the number below which announcements of a signer are void; 0 if nothing is remembered.
    pub(crate) fn floor(&self, signer: &NodeId) -> u64 {
        self.signers.get(signer).map_or(0, |past| past.floor)
    }

    /// Returns the announcement with the greatest number that ended, and the number.
    pub(crate) fn newest(&self, signer: &NodeId) -> Option<(u64, &SignedBody)> {
        self.signers.get(signer)?.newest.as_ref().map(|(seq, signed)| (*seq, signed))
    }

    /// Returns the time of the next expiry.
    pub(crate) fn deadline(&self) -> Option<Instant> {
        self.forgets.first().map(|(at, _)| *at)
    }

    /// Remembers an announcement that a newer one replaced. At most `max` signers are remembered; with more, the one
    /// that was quiet for longest is forgotten.
    pub(crate) fn superseded(
        &mut self,
        now: Instant,
        signer: &NodeId,
        seq: u64,
        digest: [u8; 32],
        max: usize,
    ) {
        let past = self.past(now, signer, max);
        past.digests.push_back(digest);
        let oldest = if past.digests.len() > DIGESTS_MAX { past.digests.pop_front() } else { None };
        self.digests.insert(digest, (*signer, seq));
        if let Some(oldest) = oldest {
            self.digests.remove(&oldest);
        }
    }

    /// Remembers an announcement that ended without a newer one: neither it nor an older one of its signer counts
    /// again.
    pub(crate) fn ended(
        &mut self,
        now: Instant,
        signer: &NodeId,
        seq: u64,
        digest: [u8; 32],
        signed: &SignedBody,
        max: usize,
    ) {
        self.superseded(now, signer, seq, digest, max);
        let past = self.past(now, signer, max);
        past.floor = past.floor.max(seq.saturating_add(1));
        if past.newest.as_ref().is_none_or(|(known, _)| *known < seq) {
            past.newest = Some((seq, signed.clone()));
        }
    }

    /// Remembers the floor in a signer's link state, which has ended.
    pub(crate) fn run_ended(&mut self, now: Instant, signer: &NodeId, floor: u64, max: usize) {
        self.past(now, signer, max).run_floor = floor;
    }

    /// Returns the floor of [`Self::run_ended`].
    pub(crate) fn run_floor(&self, signer: &NodeId) -> u64 {
        self.signers.get(signer).map_or(0, |past| past.run_floor)
    }

    /// Returns the memory of a signer, kept from now on for as long as any earlier announcement may verify.
    fn past(&mut self, now: Instant, signer: &NodeId, max: usize) -> &mut SignerMemory {
        if !self.signers.contains_key(signer)
            && self.signers.len() >= max
            && let Some((_, quietest)) = self.forgets.first().copied()
        {
            self.forget(&quietest);
        }
        let until = now + 2 * CLOCK_SKEW_MAX;
        let empty = || SignerMemory { floor: 0, run_floor: 0, newest: None, digests: VecDeque::new(), until };
        let past = self.signers.entry(*signer).or_insert_with(empty);
        self.forgets.remove(&(past.until, *signer));
        self.forgets.insert((until, *signer));
        past.until = until;
        past
    }

    /// Forgets announcements that cannot verify any more.
    pub(crate) fn expire(&mut self, now: Instant) {
        while let Some((_, signer)) = self.forgets.first().copied().filter(|(at, _)| *at <= now) {
            self.forget(&signer);
        }
    }

    fn forget(&mut self, signer: &NodeId) {
        let Some(past) = self.signers.remove(signer) else { return };
        self.forgets.remove(&(past.until, *signer));
        for digest in past.digests {
            self.digests.remove(&digest);
        }
    }
}

#[cfg(test)]
mod tests {
    use std::time::Duration;

    use bytes::Bytes;

    use super::*;

    fn digest(n: u64) -> [u8; 32] {
        let mut digest = [0; 32];
        digest[..8].copy_from_slice(&n.to_be_bytes());
        digest
    }

    #[test]
    fn a_signer_displaces_only_what_is_remembered_of_itself() {
        #[allow(clippy::disallowed_methods)]
        let start = Instant::now();
        let signed = SignedBody { body: Bytes::from_static(b"body"), signature: Bytes::new() };
        let (quiet, busy) = (NodeId([1; 32]), NodeId([2; 32]));
        let mut memory = Memory::default();
        memory.ended(start, &quiet, 7, digest(0), &signed, 10);
        for n in 1..1000 {
            memory.ended(start + Duration::from_secs(n / 10), &busy, n, digest(n), &signed, 10);
        }
        assert_eq!((memory.floor(&quiet), memory.known(&digest(0))), (8, Some((quiet, 7))));
        assert_eq!((memory.floor(&busy), memory.known(&digest(1)), memory.digests.len()), (1000, None, 9));
        memory.expire(start + 2 * CLOCK_SKEW_MAX);
        assert_eq!((memory.floor(&quiet), memory.floor(&busy)), (0, 1000));
        memory.expire(start + 2 * CLOCK_SKEW_MAX + Duration::from_secs(100));
        assert!(memory.digests.is_empty() && memory.deadline().is_none());
    }

    #[test]
    fn with_too_many_signers_the_one_that_was_quiet_for_longest_is_forgotten() {
        #[allow(clippy::disallowed_methods)]
        let start = Instant::now();
        let mut memory = Memory::default();
        for n in 0..5_u8 {
            memory.superseded(
                start + Duration::from_secs(n.into()),
                &NodeId([n; 32]),
                1,
                digest(n.into()),
                3,
            );
        }
        let known: Vec<_> = (0..5).map(|n| memory.known(&digest(n)).is_some()).collect();
        assert_eq!(known, [false, false, true, true, true]);
    }
}
