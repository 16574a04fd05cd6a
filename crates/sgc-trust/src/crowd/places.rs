//! Places for handshakes: a bound for all, a bound for each address, and the rule for the handshake that gives way.

use std::collections::BTreeMap;
use std::time::{Duration, Instant};

use super::prefix::AddressPrefix;

/// Time that an engaged handshake keeps its place against others of sources that hold as many. It is longer than an
/// honest handshake takes, so that a herd of honest peers does not evict itself.
pub const PLACE_HELD_MIN: Duration = Duration::from_secs(1);

/// Bounds on the handshakes under way.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct PlaceLimits {
    /// From all addresses together.
    pub all: usize,
    /// From one [`AddressPrefix`].
    pub per_prefix: usize,
}

/// The reason why there is no place.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum PlaceRefusal {
    /// The peer's own address holds as many as one address may.
    Prefix {
        /// The address.
        prefix: AddressPrefix,
        /// Number of places that it holds.
        held: usize,
    },
    /// All places are taken.
    All {
        /// Number of places in all.
        held: usize,
    },
}

/// The decision on a peer that asks for a place.
#[derive(Debug, PartialEq, Eq)]
pub enum PlaceDecision<T> {
    /// There is room.
    Admit,
    /// There is room because this handshake gave way; the caller ends it.
    Evict(T, PlaceRefusal),
    /// There is none.
    Refuse(PlaceRefusal),
}

/// The handshakes under way at one listener, the oldest first. Each holds a `T`, by which the caller can end it.
///
/// An *engaged* handshake has cost its peer something: its address is proven, or bytes came. A newcomer of an address
/// at its bound displaces a handshake of the same address, and a newcomer that finds all places taken one of the
/// address that holds the most: the oldest that is not engaged, else the oldest. Engaged handshakes of an address that
/// holds no more than the newcomer's are displaced only after [`PLACE_HELD_MIN`].
#[derive(Debug)]
pub struct Places<T> {
    limits: PlaceLimits,
    held: Vec<Place<T>>,
}

#[derive(Debug)]
struct Place<T> {
    prefix: AddressPrefix,
    since: Instant,
    holder: T,
}

impl<T> Places<T> {
    /// Creates a table without handshakes.
    pub fn new(limits: PlaceLimits) -> Self {
        Self { limits, held: Vec::new() }
    }

    /// Returns the number of handshakes under way.
    pub fn len(&self) -> usize {
        self.held.len()
    }

    /// Returns `true` if no handshake is under way.
    pub fn is_empty(&self) -> bool {
        self.held.is_empty()
    }

    /// Iterates over the handshakes under way, the oldest first.
    pub fn iter(&self) -> impl Iterator<Item = (AddressPrefix, &T)> {
        self.held.iter().map(|place| (place.prefix, &place.holder))
    }

    /// Frees the places of handshakes for which `is_pending` returns `false`.
    pub fn retain(&mut self, mut is_pending: impl FnMut(&T) -> bool) {
        self.held.retain(|place| is_pending(&place.holder));
    }

    /// Makes room for a peer of this address, or returns the reason why there is none. The caller then passes the
    /// holder to [`Self::take`].
    pub fn make_room(
        &mut self,
        prefix: AddressPrefix,
        now: Instant,
        is_engaged: impl Fn(&T) -> bool,
    ) -> PlaceDecision<T> {
        let own = self.held.iter().filter(|place| place.prefix == prefix).count();
        if own >= self.limits.per_prefix {
            let crowded = PlaceRefusal::Prefix { prefix, held: own };
            return self.displace(|place| place.prefix == prefix, false, crowded, now, is_engaged);
        }
        if self.held.len() < self.limits.all {
            return PlaceDecision::Admit;
        }
        let mut counts = BTreeMap::<AddressPrefix, usize>::new();
        for place in &self.held {
            *counts.entry(place.prefix).or_default() += 1;
        }
        let most = counts.values().copied().max().unwrap_or(0);
        // Displacing one of theirs leaves them with as many as the newcomer's address, at least.
        let is_heavier = most > own + 1;
        let crowded = PlaceRefusal::All { held: self.held.len() };
        let is_heaviest = |place: &Place<T>| counts.get(&place.prefix) == Some(&most);
        self.displace(is_heaviest, is_heavier, crowded, now, is_engaged)
    }

    /// Gives a place to a peer for which [`Self::make_room`] made room.
    pub fn take(&mut self, prefix: AddressPrefix, now: Instant, holder: T) {
        self.held.push(Place { prefix, since: now, holder });
    }

    fn displace(
        &mut self,
        is_candidate: impl Fn(&Place<T>) -> bool,
        is_heavier: bool,
        crowded: PlaceRefusal,
        now: Instant,
        is_engaged: impl Fn(&T) -> bool,
    ) -> PlaceDecision<T> {
        let mut candidates = self.held.iter().enumerate().filter(|(_, place)| is_candidate(place));
        let Some((oldest, place)) = candidates.next() else { return PlaceDecision::Refuse(crowded) };
        let may_displace = is_heavier || now.saturating_duration_since(place.since) >= PLACE_HELD_MIN;
        let idle = if is_engaged(&place.holder) {
            candidates.find(|(_, place)| !is_engaged(&place.holder)).map(|(at, _)| at)
        } else {
            Some(oldest)
        };
        match idle.or(may_displace.then_some(oldest)) {
            Some(at) => PlaceDecision::Evict(self.held.remove(at).holder, crowded),
            None => PlaceDecision::Refuse(crowded),
        }
    }
}

#[cfg(test)]
mod tests {
    use std::net::{IpAddr, Ipv4Addr};

    use super::*;

    /// A handshake: its number, and whether it is engaged.
    type Handshake = (u32, bool);

    const LIMITS: PlaceLimits = PlaceLimits { all: 8, per_prefix: 3 };

    fn host(number: u32) -> AddressPrefix {
        IpAddr::V4(Ipv4Addr::from_bits(0x0a00_0000 + number)).into()
    }

    struct Bench {
        places: Places<Handshake>,
        now: Instant,
        next: u32,
    }

    impl Bench {
        fn new() -> Self {
            #[allow(clippy::disallowed_methods)]
            let now = Instant::now();
            Self { places: Places::new(LIMITS), now, next: 0 }
        }

        fn ask(&mut self, from: u32, engaged: bool) -> PlaceDecision<Handshake> {
            let decision = self.places.make_room(host(from), self.now, |(_, engaged)| *engaged);
            if !matches!(decision, PlaceDecision::Refuse(_)) {
                self.places.take(host(from), self.now, (self.next, engaged));
            }
            self.next += 1;
            decision
        }

        fn held_by(&self, from: u32) -> Vec<u32> {
            self.places.iter().filter(|(prefix, _)| *prefix == host(from)).map(|(_, (n, _))| *n).collect()
        }
    }

    #[test]
    fn an_address_has_no_more_than_its_share_however_often_it_asks() {
        let mut bench = Bench::new();
        let mut refused = 0;
        for _ in 0..100 {
            refused += usize::from(matches!(bench.ask(1, true), PlaceDecision::Refuse(_)));
        }
        assert_eq!(refused, 97);
        assert_eq!(bench.held_by(1), [0, 1, 2], "engaged handshakes are not displaced at once");
        assert_eq!(bench.ask(2, true), PlaceDecision::Admit);
        bench.now += PLACE_HELD_MIN;
        let crowded = PlaceRefusal::Prefix { prefix: host(1), held: 3 };
        assert_eq!(bench.ask(1, true), PlaceDecision::Evict((0, true), crowded));
    }

    #[test]
    fn an_idle_handshake_of_the_same_address_gives_way_first() {
        let mut bench = Bench::new();
        for engaged in [true, false, false] {
            assert_eq!(bench.ask(1, engaged), PlaceDecision::Admit);
        }
        let crowded = PlaceRefusal::Prefix { prefix: host(1), held: 3 };
        assert_eq!(bench.ask(1, true), PlaceDecision::Evict((1, false), crowded));
        assert_eq!(bench.ask(1, true), PlaceDecision::Evict((2, false), crowded));
        assert_eq!(bench.ask(1, true), PlaceDecision::Refuse(crowded));
    }

    #[test]
    fn the_address_that_holds_the_most_makes_room_for_others() {
        let mut bench = Bench::new();
        for from in [1, 1, 1, 2, 2, 2, 3, 3] {
            assert_eq!(bench.ask(from, true), PlaceDecision::Admit);
        }
        let crowded = PlaceRefusal::All { held: 8 };
        assert_eq!(
            bench.ask(4, true),
            PlaceDecision::Evict((0, true), crowded),
            "the oldest of the heaviest"
        );
        assert_eq!(bench.ask(4, true), PlaceDecision::Evict((3, true), crowded));
        // Each holds two now: nobody has more than the newcomer would.
        assert_eq!(bench.ask(3, true), PlaceDecision::Refuse(crowded));
        assert_eq!(bench.ask(5, true), PlaceDecision::Evict((1, true), crowded));
    }

    #[test]
    fn many_addresses_with_one_place_each_keep_newcomers_out_for_a_second_at_most() {
        let mut bench = Bench::new();
        for from in 1..=8 {
            assert_eq!(bench.ask(from, true), PlaceDecision::Admit);
        }
        let crowded = PlaceRefusal::All { held: 8 };
        assert_eq!(bench.ask(9, true), PlaceDecision::Refuse(crowded));
        bench.now += PLACE_HELD_MIN;
        assert_eq!(bench.ask(9, true), PlaceDecision::Evict((0, true), crowded));
    }

    #[test]
    fn a_place_is_free_again_when_its_handshake_has_ended() {
        let mut bench = Bench::new();
        for _ in 0..3 {
            bench.ask(1, true);
        }
        bench.places.retain(|(number, _)| *number != 1);
        assert_eq!(bench.ask(1, true), PlaceDecision::Admit);
        assert_eq!(bench.held_by(1), [0, 2, 3]);
    }
}
