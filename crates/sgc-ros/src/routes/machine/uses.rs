//! Use routes: from an owner's catalogue to local writers.

use std::collections::{BTreeMap, BTreeSet};
use std::time::Instant;

use rand_core::RngCore;
use sgc_endpoint::{LostReason, RefusedBy};
use sgc_trust::name_of;
use sgc_wire::{Catalogue, CatalogueEntry, Metadata, Name, NodeId};

use super::Routes;
use crate::network::{DiscoveredEndpoint, EndpointKind};
use crate::routes::command::Command;
use crate::routes::problem::{Cause, Problem, Way};
use crate::routes::rules::{Direction, ENTRIES_PER_RULE_MAX, ROUTES_PER_WILDCARD_MAX, UseRule, UseRuleId};
use crate::routes::use_route::UseRoute;

impl<R: RngCore> Routes<R> {
    /// Handles a new or changed catalogue of an owner.
    pub fn handle_catalogue(&mut self, now: Instant, owner: NodeId, mut catalogue: Catalogue) {
        // Two entries with one name would replace each other's route with every catalogue.
        let mut blinds = BTreeSet::new();
        catalogue.entries.retain(|entry| blinds.insert(entry.blind));
        let rules = &self.use_rules;
        let of_owner = self.uses.values().filter(|u| rules[u.rule()].is_of_catalogue(&owner));
        let known = of_owner.flat_map(UseRoute::sources).collect();
        self.owners.list(now, owner, catalogue.clone(), &known);
        self.list(owner, catalogue);
        self.reconsider();
    }

    /// Updates the routes to an owner's interfaces to match its catalogue.
    pub(super) fn list(&mut self, owner: NodeId, catalogue: Catalogue) {
        let mut listed = BTreeSet::new();
        let said = self.problems.take(Cause::Catalogue(owner));
        let mut running: BTreeMap<UseRuleId, usize> = BTreeMap::new();
        for route in self.uses.values() {
            *running.entry(route.rule()).or_default() += 1;
        }
        for entry in catalogue.entries {
            let Some(rule) = self.rule_for(owner, &entry) else { continue };
            let name = name_of(&owner, &entry.blind);
            if self.uses.get(&name).is_none_or(|route| route.rule() != rule) {
                let here = running.entry(rule).or_default();
                let is_pattern = self.use_rules[rule].is_pattern();
                if *here >= if is_pattern { ROUTES_PER_WILDCARD_MAX } else { ENTRIES_PER_RULE_MAX } {
                    self.too_many(owner, rule);
                    continue;
                }
                if let Some(problem) = self.why_not_used(rule, &entry.metadata) {
                    self.backlog.wait();
                    self.report(Cause::Catalogue(owner), problem);
                    continue;
                }
                *here += 1;
            }
            listed.insert(name);
            self.check_merged(rule, &entry.metadata);
            self.listed_again(name);
            self.entry_there(name, rule, entry);
        }
        self.problems.release(said);
        let gone: Vec<_> = self
            .uses
            .iter()
            .filter(|(n, u)| self.use_rules[u.rule()].is_of_catalogue(&owner) && !listed.contains(n))
            .map(|(n, _)| *n)
            .collect();
        for name in gone {
            self.not_listed(name);
        }
    }

    fn too_many(&mut self, owner_id: NodeId, rule: UseRuleId) {
        let rule = &self.use_rules[rule];
        let (topic, owner) = (rule.topic.clone(), rule.owner_name.clone());
        let problem = match rule.is_pattern() {
            true => Problem::TooManyMatches { topic, way: Way::Brought },
            false => Problem::TooManyEntries { topic, owner },
        };
        self.backlog.wait();
        self.report(Cause::Catalogue(owner_id), problem);
    }

    /// Reconsiders interfaces that were left out because of a route that has ended since.
    pub(super) fn reconsider(&mut self) {
        if !self.backlog.take_due() {
            return;
        }
        let shared: BTreeSet<_> = self.shares.values().flat_map(|s| s.writers().copied()).collect();
        let is_new = |e: &&DiscoveredEndpoint| e.kind == EndpointKind::Writer && !shared.contains(&e.guid);
        for writer in self.local.endpoints().filter(is_new).cloned().collect::<Vec<_>>() {
            if !self.service_end_there(&writer) {
                self.share_writer(writer);
            }
        }
        let catalogues = self.owners.catalogues().map(|(owner, catalogue)| (*owner, catalogue.clone()));
        for (owner, catalogue) in catalogues.collect::<Vec<_>>() {
            self.list(owner, catalogue);
        }
    }

    /// Handles the loss of the path to an owner's catalogue, or an owner that leaves. Its topics have paths of their
    /// own, which may still work; [`Self::handle_lost`] reports their loss.
    pub fn handle_owner_lost(&mut self, owner: NodeId, reason: LostReason) {
        if !matches!(reason, LostReason::Withdrawn | LostReason::Refused(_)) {
            return self.owners.lose(owner);
        }
        self.settle(Cause::Catalogue(owner), BTreeSet::new());
        self.owners.end(owner);
        let names: Vec<_> = self
            .uses
            .iter()
            .filter(|(_, u)| self.use_rules[u.rule()].is_of_catalogue(&owner))
            .map(|(n, _)| *n)
            .collect();
        for name in names {
            self.drop_use(name);
        }
        self.reconsider();
    }

    /// Handles an owner's refusal of its catalogue.
    pub fn handle_owner_refused(&mut self, owner: NodeId, by: RefusedBy) {
        self.owners.refuse(owner, by);
    }

    /// Handles the grant of a join. `entry` describes the interface if the join asked for that.
    pub fn handle_granted(&mut self, name: &Name, entry: Option<CatalogueEntry>) {
        if let (Some(entry), true) = (entry, self.tokens.contains_key(name)) {
            self.handle_described(*name, entry);
        }
        if let Some(route) = self.uses.get_mut(name) {
            route.grant();
            self.consumers_changed = true;
            self.refresh_use(*name);
        }
    }

    /// Handles the refusal of a join.
    pub fn handle_refused(&mut self, name: &Name, by: RefusedBy) {
        if let Some(route) = self.uses.get_mut(name) {
            route.refuse(by);
        }
        if let Some(token) = self.tokens.get_mut(name) {
            token.refuse(by);
        }
    }

    /// Handles the suspension of a grant.
    pub fn handle_lost(&mut self, now: Instant, name: &Name) {
        if let Some(route) = self.uses.get_mut(name) {
            route.hold(now);
        }
    }

    /// Returns the rule that asks for a catalogue entry.
    pub(super) fn rule_for(&mut self, owner: NodeId, entry: &CatalogueEntry) -> Option<UseRuleId> {
        let metadata = &entry.metadata;
        let index = self.use_rule(&owner, entry)?;
        let rule = &self.use_rules[index];
        match &rule.type_name {
            Some(expected) if *expected != metadata.type_name => {
                let problem = Problem::UseType {
                    topic: rule.topic.clone(),
                    owner: rule.owner_name.clone(),
                    expected: expected.clone(),
                    found: metadata.type_name.clone(),
                };
                self.report(Cause::Catalogue(owner), problem);
                None
            }
            _ => Some(index),
        }
    }

    /// Begins the use of a listed entry, or updates it.
    pub(super) fn entry_there(&mut self, name: Name, rule: UseRuleId, entry: CatalogueEntry) {
        let local_name = self.use_rules[rule].local_name(&entry.metadata);
        self.consumers_changed = true;
        let goes_on = |route: &UseRoute| {
            let direction = self.use_rules[rule].direction;
            // Another durability needs another kind of sink.
            let needs_other_sink = direction == Direction::Bring
                && route.entry().qos.is_transient_local() != entry.qos.is_transient_local();
            self.use_rules[route.rule()].direction == direction
                && route.local_name() == local_name
                && !needs_other_sink
        };
        if self.uses.get(&name).is_some_and(|route| !goes_on(route)) {
            self.drop_use(name);
        }
        let Some(route) = self.uses.get_mut(&name) else { return self.begin_use(name, rule, entry) };
        if route.set_entry(entry) {
            self.check_later();
        }
        self.refresh_use(name);
    }

    fn begin_use(&mut self, name: Name, rule_id: UseRuleId, entry: CatalogueEntry) {
        let rule = &self.use_rules[rule_id];
        let UseRule { owner, class, shaping, frame_prefix, dead_man, .. } = rule.clone();
        let (suite, class) = (entry.suite, class.unwrap_or(entry.class));
        let (reliable, transient_local) = (entry.qos.is_reliable(), entry.qos.is_transient_local());
        let (is_service, direction) = (rule.is_service(), rule.direction);
        let route = UseRoute::new(name, rule_id, rule.local_name(&entry.metadata), entry);
        self.uses.insert(name, route);
        if is_service {
            return self.commands.push_back(Command::Call { name, owner, suite, class });
        }
        self.commands.push_back(match direction {
            Direction::Publish => Command::Publish { name, owner, suite, class, reliable },
            Direction::Bring => Command::Join { name, owner, transient_local, describe: false },
        });
        self.shape(name, shaping);
        match direction {
            Direction::Publish => self.find_publishers(),
            Direction::Bring => {
                self.frames(name, frame_prefix);
                self.dead_man(name, dead_man);
            }
        }
        self.check_later();
    }

    /// Closes the local endpoints of uses whose owner has been out of reach for too long.
    pub(super) fn uses_time_out(&mut self, now: Instant) {
        self.commands.extend(self.uses.values_mut().flat_map(|route| route.time_out(now)));
    }

    pub(super) fn drop_use(&mut self, name: Name) {
        let is_token = self.tokens.remove(&name).is_some();
        let joined = is_token || self.uses.contains_key(&name);
        self.close_use(name);
        if joined {
            self.commands.push_back(Command::Leave { name });
        }
    }

    /// Closes the local endpoints of a use. Its name stays joined.
    pub(super) fn close_use(&mut self, name: Name) {
        if let Some(mut route) = self.uses.remove(&name) {
            self.backlog.free();
            self.consumers_changed = true;
            self.commands.extend(route.close());
            self.check_later();
        }
    }

    /// Updates the local ends of a granted use to match its catalogue entry and its local publishers.
    pub(super) fn refresh_use(&mut self, name: Name) {
        let Some(route) = self.uses.get_mut(&name) else { return };
        let rule = &self.use_rules[route.rule()];
        self.commands.extend(route.refresh(rule, self.owners.is_settling(&rule.owner)));
    }

    /// Reports a problem if interfaces of several owners under one name have different types.
    fn check_merged(&mut self, rule: UseRuleId, metadata: &Metadata) {
        let found = &metadata.type_name;
        let local_name = self.use_rules[rule].local_name(metadata);
        let differs = |u: &&UseRoute| {
            let other = &u.entry().metadata;
            !self.publishes(u.rule())
                && u.local_name() == local_name
                && other.kind == metadata.kind
                && other.type_name != *found
        };
        if self.publishes(rule) {
            return;
        }
        if let Some(other) = self.uses.values().find(differs) {
            let problem = Problem::MergedTypes {
                topic: local_name,
                owner: self.use_rules[rule].owner_name.clone(),
                found: found.clone(),
                other: self.use_rules[other.rule()].owner_name.clone(),
                known: other.entry().metadata.type_name.clone(),
            };
            self.report(Cause::Catalogue(self.use_rules[rule].owner), problem);
        }
    }
}
