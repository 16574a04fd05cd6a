//! The number of flows that a peer may have open: a few at first, and more as it opens them. QUIC keeps a place for
//! each permitted flow, used or not. QUIC knows the flows themselves.

use std::sync::Arc;
use std::sync::atomic::{AtomicU32, Ordering::Relaxed};

use quinn::{Connection, VarInt};

/// Flows that a peer may have open at first. A peer that wants more waits a round trip for each doubling.
const FLOWS_AT_FIRST: u32 = 256;

/// Returns the number of flows at first, for this number in the end.
pub(super) fn at_first(flows_max: u32) -> u32 {
    flows_max.min(FLOWS_AT_FIRST)
}

/// The places of one link.
#[derive(Debug)]
pub(crate) struct Places {
    open: AtomicU32,
    permitted: AtomicU32,
    max: u32,
}

/// A flow's place, for as long as somebody reads it.
#[derive(Debug)]
pub(crate) struct Place(Arc<Places>);

impl Places {
    /// Returns the places of a link that was made with [`at_first`].
    pub(super) fn new(flows_max: u32) -> Arc<Self> {
        let permitted = at_first(flows_max).into();
        Arc::new(Self { open: AtomicU32::new(0), permitted, max: flows_max })
    }

    /// Gives an accepted flow its place. The peer may open more once it uses half of its places.
    pub(super) fn take(self: &Arc<Self>, connection: &Connection) -> Place {
        if let Some(more) = self.note_taken() {
            connection.set_max_concurrent_uni_streams(VarInt::from_u32(more));
        }
        Place(Arc::clone(self))
    }

    /// Returns the new number of permitted flows, if it changes.
    fn note_taken(&self) -> Option<u32> {
        let open = self.open.fetch_add(1, Relaxed).saturating_add(1);
        let permitted = self.permitted.load(Relaxed);
        if permitted >= self.max || open.saturating_mul(2) <= permitted {
            return None;
        }
        let more = permitted.saturating_mul(2).min(self.max);
        self.permitted.compare_exchange(permitted, more, Relaxed, Relaxed).ok().map(|_| more)
    }
}

impl Drop for Place {
    fn drop(&mut self) {
        self.0.open.fetch_sub(1, Relaxed);
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_peer_that_opens_many_flows_may_open_more_up_to_the_bound() {
        let places = Places::new(1000);
        let given: Vec<_> = (0..1000).filter_map(|n| Some((n, places.note_taken()?))).collect();
        assert_eq!(given, [(128, 512), (256, 1000)]);
        let few = Places::new(10);
        assert!((0..10).all(|_| few.note_taken().is_none()));
    }

    #[test]
    fn a_peer_that_ends_its_flows_needs_no_more_places() {
        let places = Places::new(1000);
        for _ in 0..1000 {
            assert_eq!(places.note_taken(), None);
            drop(Place(places.clone()));
        }
    }
}
