//! Checks: the problems between the two sides, derived from the current state.

use std::collections::BTreeSet;

use rand_core::RngCore;
use sgc_wire::{Kind, Qos};

use super::Routes;
use crate::names::{ros_topic, ros_type};
use crate::network::{DiscoveredEndpoint, EndpointKind};
use crate::qos::mismatches;
use crate::routes::command::Command;
use crate::routes::problem::{Cause, LocalEnd, Offerer, Problem};

impl<R: RngCore> Routes<R> {
    /// Returns the current problems, each once, in a fixed order.
    pub fn problems(&self) -> impl Iterator<Item = &Problem> {
        self.problems.iter()
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
        self.problems.mark_stale();
    }

    pub(super) fn check_stale(&mut self) {
        if self.problems.take_stale() {
            for endpoint in self.local.endpoints().cloned().collect::<Vec<_>>() {
                self.check_local(&endpoint);
            }
        }
    }

    fn problems_of(&self, endpoint: &DiscoveredEndpoint) -> BTreeSet<Problem> {
        let mut problems = BTreeSet::new();
        let Some(topic) = ros_topic(&endpoint.topic) else { return problems };
        let is_reader = endpoint.kind == EndpointKind::Reader;
        let local = ros_type(&endpoint.type_name);
        let end = if is_reader { LocalEnd::Subscriber } else { LocalEnd::Publisher };
        if !is_reader && let Some(rule) = self.share_rule(Kind::Topic, topic, None) {
            let expected = &self.share_rules[rule].metadata.type_name;
            if !expected.is_empty() && *expected != local {
                let (topic, expected, found) = (topic.to_owned(), expected.clone(), local.clone());
                problems.insert(Problem::ShareType { topic, expected, found });
            }
        }
        for route in self.uses.values() {
            let rule = &self.use_rules[route.rule()];
            let entry = route.entry();
            let publishes = self.publishes(route.rule());
            // An interface on which this node publishes elsewhere concerns local publishers only.
            if route.local_name() != topic || rule.is_service() || (publishes && is_reader) {
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
            for mismatch in offers.flat_map(|offer| mismatches(&rule.qos.apply(offer), &endpoint.qos)) {
                let (topic, offerer) = (topic.clone(), Offerer::Owner(owner.clone()));
                problems.insert(Problem::LocalQos { topic, offerer, mismatch });
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
        let found = shares.filter_map(|s| s.inbound_writer()).flat_map(|spec| offers(&spec.qos));
        let problem =
            |mismatch| Problem::LocalQos { topic: topic.to_owned(), offerer: Offerer::Publisher, mismatch };
        found.map(problem).collect()
    }
}
