//! Problems between the two sides: derived from the current state, reported when they begin, and forgotten when they
//! end.
//!
//! Each problem has a cause, the endpoint or route that it concerns. When a cause changes, it is checked again, and
//! its new problems replace the old ones.

use std::collections::{BTreeMap, BTreeSet};

use rand_core::RngCore;
use sgc_wire::{Kind, Name, NodeId, Qos};

use super::{Command, Problem, Routes};
use crate::names::{ros_topic, ros_type};
use crate::network::{DiscoveredEndpoint, EndpointKind, Guid};
use crate::qos::mismatches;

/// Most problems that are tracked at once. Further ones are not reported.
const PROBLEMS_MAX: usize = 4096;

/// The cause of a problem.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub(super) enum Cause {
    /// The local network.
    Network,
    /// A local endpoint.
    Endpoint(Guid),
    /// A local publisher that a rule covers and that is not shared.
    Unshared(Guid),
    /// The shares that exist for messages of others.
    Inbound,
    /// A share route.
    Share(Name),
    /// An owner's catalogue.
    Catalogue(NodeId),
    /// The grant for a token.
    Token(Name),
}

/// The current problems.
#[derive(Debug, Default)]
pub(super) struct Problems {
    by_cause: BTreeMap<Cause, BTreeSet<Problem>>,
    /// The number of causes of each problem.
    holding: BTreeMap<Problem, usize>,
    /// `true` if the state that local endpoints are compared with has changed.
    is_stale: bool,
}

impl Problems {
    /// Adds a problem. Returns `true` if it is new.
    fn add(&mut self, cause: Cause, problem: Problem) -> bool {
        if !self.holding.contains_key(&problem) && self.holding.len() >= PROBLEMS_MAX {
            return false;
        }
        if !self.by_cause.entry(cause).or_default().insert(problem.clone()) {
            return false;
        }
        let holders = self.holding.entry(problem).or_default();
        *holders += 1;
        *holders == 1
    }

    /// Replaces the problems of a cause and returns the new ones.
    fn settle(&mut self, cause: Cause, problems: BTreeSet<Problem>) -> Vec<Problem> {
        let before = self.take(cause);
        let begun =
            problems.into_iter().filter(|p| self.add(cause, p.clone()) && !before.contains(p)).collect();
        self.release(before);
        begun
    }

    /// Removes and returns the problems of a cause. They hold until [`Self::release`], so that a problem added again
    /// meanwhile is not new.
    pub(super) fn take(&mut self, cause: Cause) -> BTreeSet<Problem> {
        self.by_cause.remove(&cause).unwrap_or_default()
    }

    /// Ends the taken problems, except those that were added again.
    pub(super) fn release(&mut self, taken: BTreeSet<Problem>) {
        for problem in taken {
            if let Some(holders) = self.holding.get_mut(&problem) {
                *holders -= 1;
                if *holders == 0 {
                    self.holding.remove(&problem);
                }
            }
        }
    }
}

impl<R: RngCore> Routes<R> {
    /// Returns the current problems, each once, in a fixed order.
    pub fn problems(&self) -> impl Iterator<Item = &Problem> {
        self.problems.holding.keys()
    }

    /// Adds a problem to a cause and reports it if it is new.
    pub(super) fn report(&mut self, cause: Cause, problem: Problem) {
        if self.problems.add(cause, problem.clone()) {
            self.commands.push_back(Command::Report(problem));
        }
    }

    /// Replaces the problems of a cause and reports the new ones.
    pub(super) fn settle(&mut self, cause: Cause, problems: BTreeSet<Problem>) {
        let begun = self.problems.settle(cause, problems);
        self.commands.extend(begun.into_iter().map(Command::Report));
    }

    /// Checks a local endpoint that is new or whose counterpart has changed.
    pub(super) fn check_local(&mut self, endpoint: &DiscoveredEndpoint) {
        let problems = self.problems_of(endpoint);
        self.settle(Cause::Endpoint(endpoint.guid), problems);
    }

    /// Schedules a check of all local endpoints, because routes have changed. It runs when the commands are
    /// exhausted.
    pub(super) fn check_later(&mut self) {
        self.problems.is_stale = true;
    }

    pub(super) fn check_stale(&mut self) {
        if std::mem::take(&mut self.problems.is_stale) {
            for endpoint in self.endpoints.values().cloned().collect::<Vec<_>>() {
                self.check_local(&endpoint);
            }
        }
    }

    fn problems_of(&self, endpoint: &DiscoveredEndpoint) -> BTreeSet<Problem> {
        let mut problems = BTreeSet::new();
        let Some(topic) = ros_topic(&endpoint.topic) else { return problems };
        let is_reader = endpoint.kind == EndpointKind::Reader;
        let local = ros_type(&endpoint.type_name);
        let end = if is_reader { "subscriber" } else { "publisher" };
        if !is_reader && let Some(rule) = self.share_rule(Kind::Topic, topic, None) {
            let expected = &self.share_rules[rule].metadata.type_name;
            if !expected.is_empty() && *expected != local {
                let (topic, expected, found) = (topic.to_owned(), expected.clone(), local.clone());
                problems.insert(Problem::ShareType { topic, expected, found });
            }
        }
        for route in self.uses.values() {
            let rule = &self.use_rules[route.rule];
            let entry = &route.entry;
            let publishes = self.publishes(route.rule);
            // An interface on which this node publishes elsewhere concerns local publishers only.
            if route.local_name != topic || rule.is_service() || (publishes && is_reader) {
                continue;
            }
            let (topic, owner) = (topic.to_owned(), rule.owner_name.clone());
            let remote = entry.metadata.type_name.clone();
            if remote != local {
                problems.insert(Problem::LocalType { topic, owner, remote, end, local: local.clone() });
                continue;
            }
            if let (Some(remote), Some(local)) = (&entry.type_hash, &endpoint.type_hash)
                && remote != local
            {
                problems.insert(Problem::LocalHash {
                    topic: topic.clone(),
                    owner: owner.clone(),
                    type_name: entry.metadata.type_name.clone(),
                    remote: remote.clone(),
                    end,
                    local: local.clone(),
                });
            }
            if !is_reader {
                continue;
            }
            // The offers of all present writers, or the expected one if there are none.
            let offers = entry.sources.iter().map(|source| &source.qos);
            let offers = offers.chain(entry.sources.is_empty().then_some(&entry.qos));
            let set = self.use_rules[route.rule].qos;
            for mismatch in offers.flat_map(|offer| mismatches(&set.apply(offer), &endpoint.qos)) {
                let (topic, owner) = (topic.clone(), owner.clone());
                problems.insert(Problem::LocalQos { topic, owner, mismatch });
            }
        }
        problems
            .extend(is_reader.then(|| self.problems_with_publishers(topic, endpoint)).into_iter().flatten());
        problems
    }

    /// Returns the problems of a local reader with messages that others publish on a share.
    fn problems_with_publishers(&self, topic: &str, reader: &DiscoveredEndpoint) -> BTreeSet<Problem> {
        let offers = |qos: &Qos| mismatches(qos, &reader.qos);
        let shares = self.shares.values().filter(|s| s.fits(topic, &reader.type_name));
        let found = shares.filter_map(|s| s.writer.as_ref()).flat_map(|spec| offers(&spec.qos));
        let owner = "the node that publishes on it";
        let problem =
            |mismatch| Problem::LocalQos { topic: topic.to_owned(), owner: owner.to_owned(), mismatch };
        found.map(problem).collect()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn problem(n: usize) -> Problem {
        Problem::TooManySources { topic: n.to_string() }
    }

    #[test]
    fn problem_holds_until_its_last_cause_ends_and_is_reported_again() {
        let mut problems = Problems::default();
        let [a, b] = [1, 2].map(|n| Cause::Endpoint(Guid([n; 16])));
        assert!(problems.add(a, problem(1)) && !problems.add(a, problem(1)));
        assert_eq!(problems.settle(b, [problem(1), problem(2)].into()), [problem(2)]);
        assert_eq!(problems.settle(a, BTreeSet::new()), []);
        assert_eq!(problems.settle(b, [problem(1)].into()), []);
        assert_eq!(problems.holding, [(problem(1), 1)].into());
        assert_eq!(problems.settle(b, BTreeSet::new()), []);
        assert_eq!((problems.holding.len(), problems.by_cause.len()), (0, 0));
        assert_eq!(problems.settle(b, [problem(1)].into()), [problem(1)]);
    }

    #[test]
    fn there_is_an_end_to_them() {
        let mut problems = Problems::default();
        for n in 0..2 * PROBLEMS_MAX {
            problems.add(Cause::Network, problem(n));
        }
        assert_eq!(problems.holding.len(), PROBLEMS_MAX);
        problems.settle(Cause::Network, BTreeSet::new());
        assert!(problems.add(Cause::Network, problem(0)));
    }
}
