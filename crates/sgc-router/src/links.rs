//! One neighbour: its identity, its greeting, the cost of its link, and the state that depends on the link.

use std::collections::{BTreeMap, BTreeSet};
use std::sync::Arc;
use std::time::{Duration, Instant};

use sgc_trust::{CertId, VerifiedPeer};
use sgc_wire::{Hello, Name, NodeId, Now, PeerClock, SinkId, UnixMillis};

use crate::names::RecordId;
use crate::tell::SyncProgress;

/// Cost of every link besides its round trip: of equally quick routes, the one with fewer links is better.
const COST_OF_LINK: u32 = 1000;
/// Cost of a link whose round trip is not known.
const COST_UNKNOWN: u32 = 10_000;
/// Further cost of a link that seems dead: it serves only where there is no other route.
pub(crate) const COST_SUSPECT: u32 = 1 << 28;
/// A measured round trip counts once it has differed by a quarter and by this from the present one.
const COST_CHANGE_MIN: u32 = 2000;
/// Time for which it must have differed.
const COST_CHANGE_AFTER: Duration = Duration::from_secs(5);

/// The node at the other end of a link, as the handshake proved it.
#[derive(Clone, Debug)]
pub struct Neighbour {
    /// The node.
    pub node: NodeId,
    /// Its certificate, and those between it and the CA.
    pub certs: Arc<[CertId]>,
    /// Whether its certificate lets it carry others' names.
    pub may_route: bool,
    /// Last moment at which its certificate is valid.
    pub not_after: UnixMillis,
    /// Configured cost of the link, microseconds of round trip; `None` to measure it.
    pub cost: Option<u32>,
}

impl From<&VerifiedPeer> for Neighbour {
    fn from(peer: &VerifiedPeer) -> Self {
        let VerifiedPeer { node_id, path, may_route, not_after, .. } = peer;
        Self { node: *node_id, certs: path.clone(), may_route: *may_route, not_after: *not_after, cost: None }
    }
}

/// The last record of a requested name that a link was told, by its number, and the cost.
pub(crate) type RecordCost = Option<(RecordId, u32)>;

/// State of a link that is up.
#[derive(Debug)]
pub(crate) struct LinkState {
    /// The authenticated node at the other end.
    pub(crate) node: NodeId,
    /// Its certificates; none for this node itself.
    pub(crate) certs: Arc<[CertId]>,
    may_route: bool,
    /// Last moment at which its certificate is valid.
    not_after: UnixMillis,
    /// The same by the monotonic clock; `None` for a certificate that outlasts the clock.
    pub(crate) expires: Option<Instant>,
    /// Its greeting; nothing else is accepted before it.
    pub(crate) hello: Option<Hello>,
    pub(crate) cost: Cost,
    /// Branches that end at this link.
    pub(crate) branches: BTreeSet<(Name, SinkId)>,
    /// Names that the neighbour wants to know of, and the records that it was told.
    pub(crate) interests: BTreeMap<Name, RecordCost>,
    /// Owners of names that its node asked for, and the end of its interest in changes. Routers only.
    pub(crate) follows: BTreeMap<NodeId, Instant>,
    /// Names that are known over this link.
    pub(crate) names: usize,
    /// Progress of telling it the state at the time of its greeting.
    pub(crate) sync: Option<SyncProgress>,
    /// The neighbour's wall clock, from its own report.
    pub(crate) told_clock: Option<PeerClock>,
    /// Time at which it was last told everything again because a clock was set.
    pub(crate) told_again: Option<Instant>,
}

impl LinkState {
    pub(crate) fn new(now: Now, neighbour: Neighbour) -> Self {
        let mut state = Self {
            certs: neighbour.certs,
            may_route: neighbour.may_route,
            not_after: neighbour.not_after,
            cost: Cost::new(neighbour.cost),
            ..Self::local(neighbour.node)
        };
        state.set_expiry(now);
        state
    }

    /// Computes the end of the certificate by the present clocks.
    pub(crate) fn set_expiry(&mut self, now: Now) {
        let left = Duration::from_millis(self.not_after.0.saturating_sub(now.unix.0));
        self.expires = now.instant.checked_add(left);
    }

    /// Returns the link to this node's own endpoint.
    pub(crate) fn local(node: NodeId) -> Self {
        Self {
            node,
            certs: Arc::new([]),
            may_route: false,
            not_after: UnixMillis(u64::MAX),
            expires: None,
            hello: None,
            cost: Cost::new(Some(0)),
            branches: BTreeSet::new(),
            interests: BTreeMap::new(),
            follows: BTreeMap::new(),
            names: 0,
            sync: None,
            told_clock: None,
            told_again: None,
        }
    }

    /// Returns `true` once it greeted as a router, if its certificate lets it.
    pub(crate) fn is_transit(&self) -> bool {
        self.may_route && self.hello.is_some_and(|h| h.transit)
    }
}

/// The cost of a link: a configured figure, or its round trip, damped so that jitter does not change it.
#[derive(Debug)]
pub(crate) struct Cost {
    set: Option<u32>,
    /// Smoothed round trip, microseconds.
    smoothed: Option<u32>,
    /// The round trip that counts.
    counts: Option<u32>,
    /// Time since which the smoothed one differs much.
    differs_since: Option<Instant>,
    /// Set while nothing at all arrives over the link.
    suspect: bool,
}

impl Cost {
    fn new(set: Option<u32>) -> Self {
        Self { set, smoothed: None, counts: None, differs_since: None, suspect: false }
    }

    /// Returns the present cost.
    pub(crate) fn now(&self) -> u32 {
        let measured = || self.counts.map_or(COST_UNKNOWN, |rtt| rtt.saturating_add(COST_OF_LINK));
        let cost = self.set.unwrap_or_else(measured);
        if self.suspect { cost.saturating_add(COST_SUSPECT) } else { cost }
    }

    /// Returns `true` while nothing at all arrives over the link.
    pub(crate) fn is_suspect(&self) -> bool {
        self.suspect
    }

    /// Takes a measurement. Returns `true` if it changes the cost.
    pub(crate) fn measure(&mut self, now: Instant, rtt: Duration, suspect: bool) -> bool {
        let before = self.now();
        self.suspect = suspect;
        let rtt = u32::try_from(rtt.as_micros()).unwrap_or(u32::MAX).min(COST_SUSPECT / 2);
        let smoothed = self.smoothed.map_or(rtt, |old| old - old / 8 + rtt / 8);
        self.smoothed = Some(smoothed);
        let counts = *self.counts.get_or_insert(smoothed);
        if smoothed.abs_diff(counts) <= (counts / 4).max(COST_CHANGE_MIN) {
            self.differs_since = None;
        } else if now.saturating_duration_since(*self.differs_since.get_or_insert(now)) >= COST_CHANGE_AFTER {
            self.counts = Some(smoothed);
            self.differs_since = None;
        }
        self.now() != before
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn ms(n: u64) -> Duration {
        Duration::from_millis(n)
    }

    #[test]
    fn jitter_does_not_move_a_cost_and_a_lasting_change_does() {
        #[allow(clippy::disallowed_methods)]
        let start = Instant::now();
        let mut cost = Cost::new(None);
        assert_eq!(cost.now(), COST_UNKNOWN);
        assert!(cost.measure(start, ms(20), false));
        let first = cost.now();
        assert_eq!(first, 20_000 + COST_OF_LINK);
        for n in 0..600 {
            let rtt = ms([12, 30, 21, 19, 25, 14][n as usize % 6]);
            assert!(!cost.measure(start + ms(100 * n), rtt, false), "moved by jitter");
        }
        let later = start + ms(60_000);
        let moved = (0..600).find(|n| cost.measure(later + ms(100 * n), ms(60), false)).unwrap();
        assert!(moved * 100 >= 5000, "moved after {moved} tenths of a second");
        assert!(cost.now() > 2 * first && (0..600).all(|n| !cost.measure(later + ms(n), ms(60), false)));
    }

    #[test]
    fn a_link_that_seems_dead_is_the_last_choice_and_a_set_cost_is_not_measured() {
        #[allow(clippy::disallowed_methods)]
        let start = Instant::now();
        let mut cost = Cost::new(Some(7));
        assert!(!cost.measure(start, ms(900), false));
        assert_eq!(cost.now(), 7);
        assert!(cost.measure(start, ms(900), true) && cost.now() == 7 + COST_SUSPECT);
        assert!(cost.measure(start, ms(900), false) && cost.now() == 7);
    }
}
