//! One neighbour: who it is, what it said of itself, and what depends on it.

use std::collections::BTreeSet;
use std::sync::Arc;
use std::time::{Duration, Instant};

use sgc_trust::{CertId, VerifiedPeer};
use sgc_wire::{Hello, Name, NodeId, Now, UnixMillis};

use crate::Limits;

/// How many times as many requests a router may bring as a proxy.
const ROUTER_FACTOR: u32 = 16;

/// What the handshake proved of the node at the other end of a link.
#[derive(Clone, Debug)]
pub struct Neighbour {
    /// Who it is.
    pub node: NodeId,
    /// Its certificate, and those between it and the CA.
    pub certs: Arc<[CertId]>,
    /// True if its certificate lets it carry others' names.
    pub may_route: bool,
    /// Last moment at which its certificate holds.
    pub not_after: UnixMillis,
}

impl From<&VerifiedPeer> for Neighbour {
    fn from(peer: &VerifiedPeer) -> Self {
        let VerifiedPeer { node_id, path, may_route, not_after, .. } = peer;
        Self { node: *node_id, certs: path.clone(), may_route: *may_route, not_after: *not_after }
    }
}

/// State of a link that is up.
#[derive(Debug)]
pub(crate) struct LinkState {
    /// The authenticated node at the other end.
    pub(crate) node: NodeId,
    /// Its certificates; none for this node itself.
    pub(crate) certs: Arc<[CertId]>,
    may_route: bool,
    /// When its certificate ends.
    pub(crate) expires: Option<Instant>,
    /// Its greeting; nothing else is accepted before it.
    pub(crate) hello: Option<Hello>,
    /// Names with a route or a branch over this link.
    pub(crate) names: BTreeSet<Name>,
    /// Names that it wants to hear of.
    pub(crate) interests: BTreeSet<Name>,
    /// Number of routes learned over it.
    pub(crate) routes: usize,
    /// Number of branches over it.
    pub(crate) branches: usize,
    joins: Budget,
    forgeries: Budget,
}

impl LinkState {
    pub(crate) fn new(now: Now, neighbour: Neighbour, limits: &Limits) -> Self {
        let left = Duration::from_millis(neighbour.not_after.0.saturating_sub(now.unix.0));
        Self {
            certs: neighbour.certs,
            may_route: neighbour.may_route,
            // One that outlasts the clock never ends.
            expires: now.instant.checked_add(left),
            ..Self::local(neighbour.node, limits)
        }
    }

    /// The link to this node's own endpoint.
    pub(crate) fn local(node: NodeId, limits: &Limits) -> Self {
        Self {
            node,
            certs: Arc::new([]),
            may_route: false,
            expires: None,
            hello: None,
            names: BTreeSet::new(),
            interests: BTreeSet::new(),
            routes: 0,
            branches: 0,
            joins: Budget::new(limits.joins_burst, limits.joins_burst / 8),
            forgeries: Budget::new(limits.forgeries_max, 1),
        }
    }

    /// True once it said that it carries others' names, if its certificate lets it.
    pub(crate) fn is_transit(&self) -> bool {
        self.may_route && self.hello.is_some_and(|h| h.transit)
    }

    /// Takes one from what the link may ask for; false if there is none left. This node asks as it likes.
    pub(crate) fn may_ask(&mut self, now: Instant) -> bool {
        let factor = if self.is_transit() { ROUTER_FACTOR } else { 1 };
        self.certs.is_empty() || self.joins.take(now, factor)
    }

    /// Takes one from what the link may get wrong; false if there is none left.
    pub(crate) fn may_err(&mut self, now: Instant) -> bool {
        self.forgeries.take(now, 1)
    }
}

/// A bucket of tokens that refills with time.
#[derive(Debug)]
struct Budget {
    burst: u32,
    /// Tokens a second.
    rate: u32,
    used: f64,
    at: Option<Instant>,
}

impl Budget {
    fn new(burst: u32, rate: u32) -> Self {
        Self { burst, rate: rate.max(1), used: 0.0, at: None }
    }

    fn take(&mut self, now: Instant, factor: u32) -> bool {
        let elapsed = self.at.map_or(Duration::ZERO, |at| now.saturating_duration_since(at));
        self.at = Some(now);
        self.used = (self.used - elapsed.as_secs_f64() * f64::from(self.rate) * f64::from(factor)).max(0.0);
        let room = self.used + 1.0 <= f64::from(self.burst) * f64::from(factor);
        if room {
            self.used += 1.0;
        }
        room
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_budget_is_spent_and_comes_back_with_time() {
        #[allow(clippy::disallowed_methods)]
        let start = Instant::now();
        let mut budget = Budget::new(4, 2);
        let taken = |budget: &mut Budget, at| (0..10).filter(|_| budget.take(at, 1)).count();
        assert_eq!(taken(&mut budget, start), 4);
        assert_eq!(taken(&mut budget, start + Duration::from_secs(1)), 2);
        assert_eq!(taken(&mut budget, start + Duration::from_secs(60)), 4);
        assert_eq!((0..100).filter(|_| Budget::new(4, 2).take(start, 16)).count(), 100);
        let mut shared = Budget::new(4, 2);
        assert_eq!((0..100).filter(|_| shared.take(start, 16)).count(), 64);
    }
}
