//! Bounds on the memory and work that neighbours may cause at a router.

use std::time::{Duration, Instant};

/// Longest route of data, in links.
pub(crate) const HOPS_MAX: u8 = sgc_wire::HOP_LIMIT - 3;
/// Interval at which a name that somebody waits for is asked for again.
pub(crate) const QUERY_EVERY: Duration = Duration::from_secs(20);
/// Multiple of a proxy's requests that a router may bring.
const ROUTER_FACTOR: u32 = 16;

/// Bounds on the memory that neighbours may take at this node.
#[derive(Clone, Debug)]
pub struct Limits {
    /// Names known in all.
    pub names_max: usize,
    /// Names of one owner.
    pub names_per_owner_max: usize,
    /// Names that are known over one link to a router.
    pub names_per_router_max: usize,
    /// Nodes whose links are known.
    pub nodes_max: usize,
    /// Branches that one node may have here.
    pub branches_per_peer_max: usize,
    /// Branches of one name.
    pub branches_per_name_max: usize,
    /// Names that one node may be interested in, over all its links; also the unknown names that a router may have
    /// asked for.
    pub interests_per_peer_max: usize,
    /// Unknown names that all routers are asked for on behalf of one node within 20 s, counted separately for first and
    /// repeated questions. Others wait for their turn. A router has sixteen times as many.
    pub unknown_per_peer_max: u32,
    /// Advertisements and withdrawals of one owner that are in force; beyond it the oldest are void.
    pub adverts_per_owner_max: usize,
    /// Bytes of them.
    pub advert_bytes_per_owner_max: usize,
    /// Unknown names that all routers together may have asked for. Beyond it the router with the most loses its oldest
    /// question.
    pub asks_max: usize,
    /// Questions remembered after passing them on. Beyond it the neighbour that brought the most loses its oldest; that
    /// neighbour itself brings more only when that one is 5 s old.
    pub questions_max: usize,
    /// Withdrawn names remembered against replay. Beyond it the owner with the most loses its oldest withdrawal, and
    /// with it every earlier advertisement.
    pub tombstones_max: usize,
    /// Time that an owner may take to answer a join, and a sink to ask over a better route.
    pub answer_wait: Duration,
    /// Longest lease of an advertisement or link state that is honoured.
    pub lease_max: Duration,
    /// Links of one node at one time.
    pub links_per_node_max: usize,
    /// Requests to join that a proxy may bring at once; refilled by an eighth of it a second. A router, which brings
    /// those of many, may bring sixteen times as many.
    pub joins_burst: u32,
    /// Names that a neighbour may ask for at once; refilled by an eighth of it a second. A router may ask for sixteen times as
    /// many.
    pub queries_burst: u32,
    /// Advertisements and link states of a node that are passed on at once, each to all routers; refilled by an eighth
    /// of it a second. Further ones wait, and only the newest of them is passed on.
    pub announcements_burst: u32,
    /// Verified announcements without news, or beyond their signer's allowance, that a neighbour may bring at once;
    /// refilled by an eighth of it a second. A router may bring sixteen times as many.
    pub stale_burst: u32,
    /// New revocation lists of one CA that are taken from neighbours at once; refilled by one a second. Further ones
    /// wait, and only the newest of them is taken. The CA of this node's own fleet has no such bound. Greater than
    /// [`sgc_trust::FLEET_LISTS_MAX`], so that all lists in force fit.
    pub lists_burst: u32,
    /// Unverifiable bodies that a node may bring before its link is closed; one is forgiven a second.
    pub forgeries_max: u32,
}

impl Default for Limits {
    fn default() -> Self {
        Self {
            names_max: 16_000_000,
            names_per_owner_max: 16_384,
            names_per_router_max: 4_000_000,
            nodes_max: 1_000_000,
            branches_per_peer_max: 65_536,
            branches_per_name_max: 4096,
            interests_per_peer_max: 65_536,
            unknown_per_peer_max: 1024,
            adverts_per_owner_max: 512,
            advert_bytes_per_owner_max: 4 << 20,
            asks_max: 262_144,
            questions_max: 100_000,
            tombstones_max: 100_000,
            answer_wait: Duration::from_secs(10),
            lease_max: Duration::from_secs(600),
            links_per_node_max: 8,
            joins_burst: 1024,
            queries_burst: 65_536,
            announcements_burst: 256,
            stale_burst: 256,
            lists_burst: 64,
            forgeries_max: 64,
        }
    }
}

/// The remaining allowance of one node, over all its links.
#[derive(Debug)]
pub(crate) struct Allowance {
    joins: Budget,
    queries: Budget,
    announcements: Budget,
    stale: Budget,
    forgeries: Budget,
    /// First questions for names.
    first: TurnBudget,
    /// Repeated questions for names.
    again: TurnBudget,
    /// Branches that it has here.
    pub(crate) branches: usize,
}

impl Allowance {
    pub(crate) fn new(limits: &Limits) -> Self {
        Self {
            joins: Budget::new(limits.joins_burst, limits.joins_burst / 8),
            queries: Budget::new(limits.queries_burst, limits.queries_burst / 8),
            announcements: Budget::new(limits.announcements_burst, limits.announcements_burst / 8),
            stale: Budget::new(limits.stale_burst, limits.stale_burst / 8),
            forgeries: Budget::new(limits.forgeries_max, 1),
            first: TurnBudget::new(limits.unknown_per_peer_max),
            again: TurnBudget::new(limits.unknown_per_peer_max),
            branches: 0,
        }
    }

    /// Takes a request to join. Returns `false` if none is left.
    pub(crate) fn may_join(&mut self, now: Instant, is_router: bool) -> bool {
        self.joins.take(now, 1, if is_router { ROUTER_FACTOR } else { 1 })
    }

    /// Takes a question for this many names. Returns `false` if that is too many.
    pub(crate) fn may_query(&mut self, now: Instant, names: usize, is_router: bool) -> bool {
        let names = names.max(1).try_into().unwrap_or(u32::MAX);
        self.queries.take(now, names, if is_router { ROUTER_FACTOR } else { 1 })
    }

    /// Returns the turns of questions on its behalf.
    pub(crate) fn turns(&mut self, again: bool) -> &mut TurnBudget {
        if again { &mut self.again } else { &mut self.first }
    }

    /// Takes an announcement. Returns `false` if that is too much to pass on now.
    pub(crate) fn may_announce(&mut self, now: Instant) -> bool {
        self.announcements.take(now, 1, 1)
    }

    /// Returns `true` if it may bring another announcement that has to be verified and may be no news.
    pub(crate) fn may_bring(&self, now: Instant, is_router: bool) -> bool {
        self.stale.has_room(now, 1, if is_router { ROUTER_FACTOR } else { 1 })
    }

    /// Takes an announcement that was verified in vain.
    pub(crate) fn brought_stale(&mut self, now: Instant, is_router: bool) {
        self.stale.take(now, 1, if is_router { ROUTER_FACTOR } else { 1 });
    }

    /// Takes an error. Returns `false` if none is left.
    pub(crate) fn may_err(&mut self, now: Instant) -> bool {
        self.forgeries.take(now, 1, 1)
    }

    /// Returns `true` if nothing is used, so that forgetting it gives nothing back.
    pub(crate) fn is_whole(&self, now: Instant) -> bool {
        let budgets = [&self.joins, &self.queries, &self.announcements, &self.stale, &self.forgeries];
        let turns = [&self.first, &self.again];
        self.branches == 0
            && turns.iter().all(|t| t.next.is_none_or(|at| at <= now))
            && budgets.iter().all(|b| b.used_at(now, 1) <= 0.0)
    }
}

/// Turns in order: a fixed number in each [`QUERY_EVERY`].
#[derive(Debug)]
pub(crate) struct TurnBudget {
    max: u32,
    /// Time at which the turns taken so far are used up.
    next: Option<Instant>,
}

impl TurnBudget {
    fn new(max: u32) -> Self {
        Self { max: max.max(1), next: None }
    }

    fn interval(&self, is_router: bool) -> Duration {
        QUERY_EVERY / self.max.saturating_mul(if is_router { ROUTER_FACTOR } else { 1 })
    }

    /// Returns the time of the next one.
    pub(crate) fn next(&self, now: Instant, is_router: bool) -> Instant {
        let ahead = QUERY_EVERY - self.interval(is_router);
        self.next.and_then(|next| next.checked_sub(ahead)).map_or(now, |at| at.max(now))
    }

    /// Takes the next turn.
    pub(crate) fn take(&mut self, now: Instant, is_router: bool) -> Instant {
        let at = self.next(now, is_router);
        self.next = Some(self.next.map_or(now, |next| next.max(now)) + self.interval(is_router));
        at
    }
}

/// A bucket of tokens that refills with time.
#[derive(Debug)]
pub(crate) struct Budget {
    burst: u32,
    /// Tokens a second.
    rate: u32,
    used: f64,
    at: Option<Instant>,
}

impl Budget {
    pub(crate) fn new(burst: u32, rate: u32) -> Self {
        Self { burst, rate: rate.max(1), used: 0.0, at: None }
    }

    pub(crate) fn used_at(&self, now: Instant, factor: u32) -> f64 {
        let elapsed = self.at.map_or(Duration::ZERO, |at| now.saturating_duration_since(at));
        (self.used - elapsed.as_secs_f64() * f64::from(self.rate) * f64::from(factor)).max(0.0)
    }

    fn has_room(&self, now: Instant, tokens: u32, factor: u32) -> bool {
        self.used_at(now, factor) + f64::from(tokens) <= f64::from(self.burst) * f64::from(factor)
    }

    /// Returns the time of the next token.
    pub(crate) fn next_at(&self, now: Instant) -> Instant {
        let missing = (self.used_at(now, 1) + 1.0 - f64::from(self.burst)).max(0.0);
        now + Duration::from_secs_f64(missing / f64::from(self.rate))
    }

    pub(crate) fn take(&mut self, now: Instant, tokens: u32, factor: u32) -> bool {
        let room = self.has_room(now, tokens, factor);
        self.used = self.used_at(now, factor);
        self.at = Some(now);
        if room {
            self.used += f64::from(tokens);
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
        let taken = |budget: &mut Budget, at| (0..10).filter(|_| budget.take(at, 1, 1)).count();
        assert_eq!(taken(&mut budget, start), 4);
        assert_eq!(taken(&mut budget, start + Duration::from_secs(1)), 2);
        assert_eq!(taken(&mut budget, start + Duration::from_secs(60)), 4);
        assert!(!budget.take(start + Duration::from_secs(70), 5, 1));
        assert!(budget.take(start + Duration::from_secs(70), 4, 1));
        let mut shared = Budget::new(4, 2);
        assert_eq!((0..100).filter(|_| shared.take(start, 1, 16)).count(), 64);
    }
}
