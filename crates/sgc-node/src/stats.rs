//! Counters of the data path, and the drops that they count.

use std::collections::BTreeMap;
use std::fmt::Display;
use std::sync::atomic::{AtomicU64, Ordering::Relaxed};
use std::sync::{Mutex, MutexGuard, PoisonError};

/// Traffic of one name at this node.
#[derive(Debug, Default)]
pub(crate) struct NameStats {
    /// Packets accepted.
    pub packets: AtomicU64,
    /// Bytes of their payloads.
    pub bytes: AtomicU64,
    /// Packets dropped.
    pub dropped: AtomicU64,
    /// Packets and messages dropped, by reason.
    reasons: [AtomicU64; DataDrop::ALL.len()],
}

impl NameStats {
    /// Counts an accepted packet.
    pub(crate) fn count(&self, bytes: usize) {
        self.packets.fetch_add(1, Relaxed);
        self.bytes.fetch_add(bytes as u64, Relaxed);
    }

    /// Counts drops by their reason.
    pub(crate) fn count_drops(&self, reason: DataDrop, several: u64) {
        if let Some(count) = self.reasons.get(reason as usize) {
            count.fetch_add(several, Relaxed);
        }
    }

    /// Drops by reason, without those that there were none of.
    pub(crate) fn reasons(&self) -> BTreeMap<String, u64> {
        let all = DataDrop::ALL.into_iter().zip(&self.reasons);
        let all = all.map(|(reason, count)| (reason.key().to_owned(), count.load(Relaxed)));
        all.filter(|(_, count)| *count > 0).collect()
    }
}

/// Why the data path dropped something.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub(crate) enum DataDrop {
    /// No tree for the name: nobody asked.
    NoTree,
    /// It came over a link that is not on the tree towards its source.
    WrongWay,
    /// Too many hops.
    HopLimit,
    /// Addressed to a sink that is not here.
    NoSuchSink,
    /// A reliable consumer stood still for too long.
    Stalled,
    /// Best effort: a newer one took its place.
    Stale,
    /// The link ended.
    LinkClosed,
    /// Malformed.
    Malformed,
    /// Under a label that stands for no name.
    UnknownLabel,
    /// No grant for the name (yet).
    NotGranted,
    /// A sink refused it; the sink's own counter says why.
    Sink,
    /// Nobody on the local network is to get it.
    NoWriter,
    /// Too large to be carried.
    TooLarge,
    /// More of it came than the user lets on: a newer one took its place.
    Thinned,
    /// Older than the user lets on.
    TooOld,
    /// The publisher's history once more, after its node started anew.
    Repeated,
    /// A local publisher writes faster than this node can send: newer ones took its place.
    Overrun,
    /// It is, or was to become, JSON, and what its type looks like is not known here.
    NoDefinition,
    /// It was to become JSON, and is not what its type says.
    NotConverted,
}

impl DataDrop {
    /// All, in the order of their numbers.
    const ALL: [Self; 19] = [
        Self::NoTree,
        Self::WrongWay,
        Self::HopLimit,
        Self::NoSuchSink,
        Self::Stalled,
        Self::Stale,
        Self::LinkClosed,
        Self::Malformed,
        Self::UnknownLabel,
        Self::NotGranted,
        Self::Sink,
        Self::NoWriter,
        Self::TooLarge,
        Self::Thinned,
        Self::TooOld,
        Self::Repeated,
        Self::Overrun,
        Self::NoDefinition,
        Self::NotConverted,
    ];

    /// A short, stable name for counters.
    pub(crate) fn key(self) -> &'static str {
        match self {
            Self::NoTree => "no_subscriber",
            Self::WrongWay => "wrong_way",
            Self::HopLimit => "hop_limit",
            Self::NoSuchSink => "no_such_sink",
            Self::Stalled => "stalled",
            Self::Stale => "stale",
            Self::LinkClosed => "link_closed",
            Self::Malformed => "malformed",
            Self::UnknownLabel => "unknown_label",
            Self::NotGranted => "not_granted",
            Self::Sink => "sink",
            Self::NoWriter => "no_writer",
            Self::TooLarge => "too_large",
            Self::Thinned => "thinned",
            Self::TooOld => "too_old",
            Self::Repeated => "repeated",
            Self::Overrun => "overrun",
            Self::NoDefinition => "no_definition",
            Self::NotConverted => "not_converted",
        }
    }
}

/// Kinds of drops by culprit that are remembered; beyond it all are forgotten and begin anew.
const CULPRITS_MAX: usize = 512;

/// Counts by kind, and by kind and culprit. Written on the rare path only.
#[derive(Debug, Default)]
pub(crate) struct Drops(Mutex<Counts>);

#[derive(Debug, Default)]
struct Counts {
    kinds: BTreeMap<&'static str, u64>,
    culprits: BTreeMap<String, u64>,
}

impl Drops {
    /// Counts one; true if it is the first of its kind.
    pub(crate) fn count(&self, kind: &'static str) -> bool {
        let mut counts = self.lock();
        let n = counts.kinds.entry(kind).or_default();
        *n += 1;
        *n == 1
    }

    /// Counts several; true if they are the first of their kind.
    pub(crate) fn add(&self, kind: &'static str, several: u64) -> bool {
        let mut counts = self.lock();
        let n = counts.kinds.entry(kind).or_default();
        *n += several;
        *n == several
    }

    /// Counts one of somebody's; true if it is the first of its kind from there.
    pub(crate) fn count_from(&self, kind: &'static str, culprit: impl Display) -> bool {
        let mut counts = self.lock();
        *counts.kinds.entry(kind).or_default() += 1;
        let key = format!("{kind} from {culprit}");
        if counts.culprits.len() >= CULPRITS_MAX && !counts.culprits.contains_key(&key) {
            counts.culprits.clear();
        }
        let n = counts.culprits.entry(key).or_default();
        *n += 1;
        *n == 1
    }

    /// All counts.
    pub(crate) fn snapshot(&self) -> BTreeMap<String, u64> {
        let counts = self.lock();
        let kinds = counts.kinds.iter().map(|(kind, n)| ((*kind).to_owned(), *n));
        kinds.chain(counts.culprits.clone()).collect()
    }

    fn lock(&self) -> MutexGuard<'_, Counts> {
        self.0.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_reason_has_a_counter_of_its_own() {
        let stats = NameStats::default();
        for (place, reason) in DataDrop::ALL.into_iter().enumerate() {
            assert_eq!(reason as usize, place);
            stats.count_drops(reason, place as u64 + 1);
        }
        let reasons = stats.reasons();
        assert_eq!(reasons.len(), DataDrop::ALL.len());
        assert_eq!(reasons["not_converted"], DataDrop::ALL.len() as u64);
    }

    #[test]
    fn culprits_are_bounded_and_totals_are_not_lost() {
        let drops = Drops::default();
        assert!(drops.count_from("stale", 1));
        assert!(!drops.count_from("stale", 1));
        for link in 0..10_000 {
            drops.count_from("stale", link);
        }
        let snapshot = drops.snapshot();
        assert!(snapshot.len() <= CULPRITS_MAX + 1);
        assert_eq!(snapshot["stale"], 10_002);
    }
}
