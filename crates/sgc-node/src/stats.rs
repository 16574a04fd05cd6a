//! Counters of the data path, and the drops that they count.

use std::collections::BTreeMap;
use std::sync::Mutex;
use std::sync::atomic::{AtomicU64, Ordering::Relaxed};

use serde::Serialize;

/// Traffic of one name at this node.
#[derive(Debug, Default)]
pub(crate) struct NameStats {
    /// Packets accepted.
    pub packets: AtomicU64,
    /// Bytes of their payloads.
    pub bytes: AtomicU64,
    /// Packets dropped.
    pub dropped: AtomicU64,
}

impl NameStats {
    /// Counts an accepted packet.
    pub(crate) fn count(&self, bytes: usize) {
        self.packets.fetch_add(1, Relaxed);
        self.bytes.fetch_add(bytes as u64, Relaxed);
    }
}

/// Why the data path dropped something.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Serialize)]
#[serde(rename_all = "snake_case")]
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
    /// No grant for the name (yet).
    NotGranted,
    /// A sink refused it; the sink's own counter says why.
    Sink,
    /// Nobody on the local network is to get it.
    NoWriter,
    /// Too large to be carried.
    TooLarge,
}

/// Counts by key. Written on the rare path only.
#[derive(Debug, Default)]
pub(crate) struct Drops(Mutex<BTreeMap<String, u64>>);

impl Drops {
    /// Counts one; true if it is the first of its kind.
    pub(crate) fn count(&self, key: &str) -> bool {
        let mut counts = self.0.lock().unwrap_or_else(std::sync::PoisonError::into_inner);
        match counts.get_mut(key) {
            Some(n) => {
                *n += 1;
                false
            }
            None => {
                counts.insert(key.to_owned(), 1);
                true
            }
        }
    }

    /// All counts.
    pub(crate) fn snapshot(&self) -> BTreeMap<String, u64> {
        self.0.lock().unwrap_or_else(std::sync::PoisonError::into_inner).clone()
    }
}
