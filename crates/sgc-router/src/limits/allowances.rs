//! The allowance of each node: the work that it may still cause here.

use std::collections::BTreeMap;
use std::time::Instant;

use sgc_wire::NodeId;

use crate::limits::budget::{Budget, TurnBudget};
use crate::limits::{Limits, ROUTER_FACTOR};

/// Number of allowances below which unused ones are kept.
const ALLOWANCES_MIN: usize = 1024;

/// The remaining allowances of all nodes.
#[derive(Debug)]
pub(crate) struct Allowances {
    nodes: BTreeMap<NodeId, Allowance>,
    /// Number of allowances at which unused ones are looked for.
    nodes_max: usize,
    limits: Limits,
}

impl Allowances {
    pub(crate) fn new(limits: &Limits) -> Self {
        Self { nodes: BTreeMap::new(), nodes_max: 2 * ALLOWANCES_MIN, limits: limits.clone() }
    }

    /// Returns the remaining allowance of a node.
    pub(crate) fn node(&mut self, now: Instant, node: &NodeId) -> &mut Allowance {
        if self.nodes.len() >= self.nodes_max {
            // A node that has used nothing lately gets the same allowance when it comes back.
            self.nodes.retain(|_, allowance| !allowance.is_whole(now));
            self.nodes_max = 2 * self.nodes.len().max(ALLOWANCES_MIN);
        }
        let limits = &self.limits;
        self.nodes.entry(*node).or_insert_with(|| Allowance::new(limits))
    }
}

/// The kind of a question for a name; each has turns of its own.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Turn {
    First,
    Again,
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
}

impl Allowance {
    fn new(limits: &Limits) -> Self {
        Self {
            joins: Budget::new(limits.joins_burst, limits.joins_burst / 8),
            queries: Budget::new(limits.queries_burst, limits.queries_burst / 8),
            announcements: Budget::new(limits.announcements_burst, limits.announcements_burst / 8),
            stale: Budget::new(limits.stale_burst, limits.stale_burst / 8),
            forgeries: Budget::new(limits.forgeries_max, 1),
            first: TurnBudget::new(limits.unknown_per_peer_max),
            again: TurnBudget::new(limits.unknown_per_peer_max),
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
    pub(crate) fn turns(&mut self, turn: Turn) -> &mut TurnBudget {
        match turn {
            Turn::First => &mut self.first,
            Turn::Again => &mut self.again,
        }
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
    fn is_whole(&self, now: Instant) -> bool {
        let budgets = [&self.joins, &self.queries, &self.announcements, &self.stale, &self.forgeries];
        let turns = [&self.first, &self.again];
        turns.iter().all(|t| t.is_whole(now)) && budgets.iter().all(|b| b.used_at(now, 1) <= 0.0)
    }
}
