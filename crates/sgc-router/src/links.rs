//! One neighbour: who it is, what it said of itself, what its link costs, and what depends on it.

use std::collections::{BTreeMap, BTreeSet};
use std::sync::Arc;
use std::time::{Duration, Instant};

use sgc_trust::{CertId, VerifiedPeer};
use sgc_wire::{Hello, Name, NodeId, Now, PeerClock, SinkId, UnixMillis};

use crate::names::RecordId;
use crate::tell::SyncProgress;

/// What every link costs besides its round trip: among ways that are as quick, the one with fewer links is better.
const COST_OF_LINK: u32 = 1000;
/// Cost of a link whose round trip is not known.
const COST_UNKNOWN: u32 = 10_000;
/// What a link costs besides while it seems dead: it is a way only where there is no other.
pub(crate) const COST_SUSPECT: u32 = 1 << 28;
/// A measured round trip counts when it has been that far from the one that counts: by a quarter and by this.
const COST_CHANGE_MIN: u32 = 2000;
/// For how long it must have been so.
const COST_CHANGE_AFTER: Duration = Duration::from_secs(5);

/// What the handshake proved of the node at the other end of a link.
#[derive(Clone, Debug)]
pub struct Neighbour {
    /// Who it is.
    pub node: NodeId,
    /// Its certificate, and those between it and the CA.
    pub certs: Arc<[CertId]>,
    /// Whether its certificate lets it carry others' names.
    pub may_route: bool,
    /// Last moment at which its certificate holds.
    pub not_after: UnixMillis,
    /// What the link is to cost, microseconds of round trip; `None` if that is to be measured.
    pub cost: Option<u32>,
}

impl From<&VerifiedPeer> for Neighbour {
    fn from(peer: &VerifiedPeer) -> Self {
        let VerifiedPeer { node_id, path, may_route, not_after, .. } = peer;
        Self { node: *node_id, certs: path.clone(), may_route: *may_route, not_after: *not_after, cost: None }
    }
}

/// What a link was told of a name that it asked for: the record's number, and the cost.
pub(crate) type RecordCost = Option<(RecordId, u32)>;

/// State of a link that is up.
#[derive(Debug)]
pub(crate) struct LinkState {
    /// The authenticated node at the other end.
    pub(crate) node: NodeId,
    /// Its certificates; none for this node itself.
    pub(crate) certs: Arc<[CertId]>,
    may_route: bool,
    /// Last moment at which its certificate holds.
    not_after: UnixMillis,
    /// The same by the monotonic clock; a certificate that outlasts the clock never ends.
    pub(crate) expires: Option<Instant>,
    /// Its greeting; nothing else is accepted before it.
    pub(crate) hello: Option<Hello>,
    pub(crate) cost: Cost,
    /// Branches that it is an end of.
    pub(crate) branches: BTreeSet<(Name, SinkId)>,
    /// Names that it wants to hear of, and what it heard.
    pub(crate) interests: BTreeMap<Name, RecordCost>,
    /// Owners of names that its node asked for, and until when it is to be told of changes. Routers only.
    pub(crate) follows: BTreeMap<NodeId, Instant>,
    /// Names that are known over it.
    pub(crate) names: usize,
    /// Progress of telling it the state that was known when it greeted.
    pub(crate) sync: Option<SyncProgress>,
    /// Its wall clock, as it told it.
    pub(crate) told_clock: Option<PeerClock>,
    /// Time at which it was told everything once more because a clock was set.
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

    /// Reckons when the certificate ends, by the clocks as they are now.
    pub(crate) fn set_expiry(&mut self, now: Now) {
        let left = Duration::from_millis(self.not_after.0.saturating_sub(now.unix.0));
        self.expires = now.instant.checked_add(left);
    }

    /// The link to this node's own endpoint.
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

    /// Returns `true` once it said that it carries others' names, if its certificate lets it.
    pub(crate) fn is_transit(&self) -> bool {
        self.may_route && self.hello.is_some_and(|h| h.transit)
    }
}

/// What a link costs: a set figure, or its round trip, damped so that jitter moves nothing.
#[derive(Debug)]
pub(crate) struct Cost {
    set: Option<u32>,
    /// Smoothed round trip, microseconds.
    smoothed: Option<u32>,
    /// The round trip that counts.
    counts: Option<u32>,
    /// Since when the smoothed one is far from it.
    differs_since: Option<Instant>,
    /// True while nothing at all comes over the link.
    suspect: bool,
}

impl Cost {
    fn new(set: Option<u32>) -> Self {
        Self { set, smoothed: None, counts: None, differs_since: None, suspect: false }
    }

    /// What it is now.
    pub(crate) fn now(&self) -> u32 {
        let measured = || self.counts.map_or(COST_UNKNOWN, |rtt| rtt.saturating_add(COST_OF_LINK));
        let cost = self.set.unwrap_or_else(measured);
        if self.suspect { cost.saturating_add(COST_SUSPECT) } else { cost }
    }

    /// Returns `true` while nothing at all comes over the link.
    pub(crate) fn is_suspect(&self) -> bool {
        self.suspect
    }

    /// Takes a measurement; true if that changes the cost.
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
