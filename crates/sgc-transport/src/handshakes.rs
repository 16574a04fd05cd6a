//! Places for the handshakes of one listener. The rule for which handshake gives way is in `sgc-trust`.

use std::net::SocketAddr;
use std::time::Instant;

use sgc_trust::{PlaceDecision, PlaceLimits, PlaceRefusal, Places};

use crate::error::Refusal;
use crate::metrics::TransportMetrics;
use crate::options::LinkOptions;

/// A handshake that holds a place.
pub(crate) trait Holder {
    /// Returns the address of the peer.
    fn remote(&self) -> SocketAddr;

    /// Returns `true` until the handshake has ended.
    fn is_pending(&self) -> bool;

    /// Returns `true` if the handshake has cost the peer something: it receives at its address, or said something.
    fn is_engaged(&self) -> bool;
}

/// The handshakes under way at one listener, in any transport.
pub(crate) struct Handshakes<T> {
    places: Places<T>,
}

/// A listener's decision on a newcomer.
pub(crate) struct Entry<T> {
    /// The newcomer has a place; else it is to be turned away.
    pub(crate) is_admitted: bool,
    /// The handshake that gave way, which the listener ends.
    pub(crate) evicted: Option<T>,
    /// The newcomer's refusal, or that of the handshake that gave way to it.
    pub(crate) refused: Option<(SocketAddr, Refusal)>,
}

impl<T: Holder> Handshakes<T> {
    pub(crate) fn new(options: &LinkOptions) -> Self {
        let limits =
            PlaceLimits { all: options.handshakes_max, per_prefix: options.handshakes_per_address_max };
        Self { places: Places::new(limits) }
    }

    /// Returns the number of handshakes under way.
    pub(crate) fn pending(&mut self) -> usize {
        self.places.retain(Holder::is_pending);
        self.places.len()
    }

    /// Iterates over the handshakes under way.
    #[cfg(feature = "dtls")]
    pub(crate) fn iter(&self) -> impl Iterator<Item = (sgc_trust::AddressPrefix, &T)> {
        self.places.iter().filter(|(_, holder)| holder.is_pending())
    }

    /// Makes room for a peer at this address, and counts the handshake that gives way to it or the peer itself.
    pub(crate) fn make_room(
        &mut self,
        remote: SocketAddr,
        now: Instant,
        metrics: &TransportMetrics,
    ) -> Entry<T> {
        self.places.retain(Holder::is_pending);
        let (evicted, crowded) = match self.places.make_room(remote.ip().into(), now, T::is_engaged) {
            PlaceDecision::Admit => return Entry { is_admitted: true, evicted: None, refused: None },
            PlaceDecision::Evict(holder, crowded) => (Some(holder), crowded),
            PlaceDecision::Refuse(crowded) => (None, crowded),
        };
        let refusal = match crowded {
            PlaceRefusal::All { held } => Refusal::TooMany { pending: held },
            PlaceRefusal::Prefix { prefix, held } => Refusal::TooManyFromAddress { prefix, pending: held },
        };
        metrics.count_refused(refusal.kind());
        let remote = evicted.as_ref().map_or(remote, Holder::remote);
        Entry { is_admitted: evicted.is_some(), evicted, refused: Some((remote, refusal)) }
    }

    /// Gives the place that was made to a handshake.
    pub(crate) fn take(&mut self, now: Instant, holder: T) {
        self.places.take(holder.remote().ip().into(), now, holder);
    }
}
