//! Use routes: from an owner's catalogue to local writers.

use std::collections::{BTreeMap, BTreeSet};
use std::time::Instant;

use rand_core::RngCore;
use sgc_endpoint::{LostReason, RefusedBy};
use sgc_trust::name_of;
use sgc_wire::{
    Catalogue, CatalogueEntry, ENTRY_SOURCES_MAX, History, Metadata, Name, NodeId, Qos, SourceId,
};

use super::command::Command;
use super::machine::Routes;
use super::problem::{Cause, Problem, Way};
use super::rules::{Direction, ENTRIES_PER_RULE_MAX, ROUTES_PER_WILDCARD_MAX, UseRule, UseRuleId};
use super::use_route::{UNREACHABLE_HOLD, UseRoute};
use crate::names::{dds_topic, dds_type};
use crate::network::{DiscoveredEndpoint, EndpointKind, EndpointSpec};

impl<R: RngCore> Routes<R> {
    /// Handles a new or changed catalogue of an owner.
    pub fn handle_catalogue(&mut self, now: Instant, owner: NodeId, mut catalogue: Catalogue) {
        // Two entries with one name would replace each other's route with every catalogue.
        let mut blinds = BTreeSet::new();
        catalogue.entries.retain(|entry| blinds.insert(entry.blind));
        let rules = &self.use_rules;
        let of_owner = self.uses.values().filter(|u| rules[u.rule].is_of_catalogue(&owner));
        let known = of_owner.flat_map(|u| u.writers.keys().copied().flatten()).collect();
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
            *running.entry(route.rule).or_default() += 1;
        }
        for entry in catalogue.entries {
            let Some(rule) = self.rule_for(owner, &entry) else { continue };
            let name = name_of(&owner, &entry.blind);
            if self.uses.get(&name).is_none_or(|route| route.rule != rule) {
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
            .filter(|(n, u)| self.use_rules[u.rule].is_of_catalogue(&owner) && !listed.contains(n))
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
            .filter(|(_, u)| self.use_rules[u.rule].is_of_catalogue(&owner))
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
            route.granted = true;
            self.consumers_changed = true;
            route.refused = None;
            route.unreachable_until = None;
            let rule = route.rule;
            if self.publishes(rule) {
                self.refresh_publisher(*name);
            } else {
                self.refresh_use(*name);
            }
        }
    }

    /// Handles the refusal of a join.
    pub fn handle_refused(&mut self, name: &Name, by: RefusedBy) {
        if let Some(route) = self.uses.get_mut(name) {
            route.refused = Some(by);
        }
        if let Some(token) = self.tokens.get_mut(name) {
            token.refused = Some(by);
        }
    }

    /// Handles the suspension of a grant.
    pub fn handle_lost(&mut self, now: Instant, name: &Name) {
        self.hold_use(now, *name);
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

    pub(super) fn entry_there(&mut self, name: Name, rule: UseRuleId, entry: CatalogueEntry) {
        let transient_local = entry.qos.is_transient_local();
        let local_name = self.use_rules[rule].local_name(&entry.metadata);
        self.consumers_changed = true;
        let goes_on = |route: &UseRoute| {
            self.use_rules[route.rule].direction == self.use_rules[rule].direction
                && route.local_name == local_name
        };
        if self.uses.get(&name).is_some_and(|route| !goes_on(route)) {
            self.drop_use(name);
        }
        match self.uses.get_mut(&name) {
            Some(route) if self.use_rules[route.rule].direction == Direction::Publish => {
                if std::mem::replace(&mut route.entry, entry.clone()) != entry {
                    self.check_later();
                }
                self.refresh_server(name);
            }
            Some(route) if route.entry.qos.is_transient_local() == transient_local => {
                let is_news = std::mem::replace(&mut route.entry, entry.clone()) != entry;
                self.refresh_use(name);
                if is_news {
                    self.check_later();
                }
            }
            // Another durability needs another kind of sink, so the route starts over.
            Some(_) => {
                self.drop_use(name);
                self.entry_there(name, rule, entry);
            }
            None => {
                let UseRule { owner, class, shaping, frame_prefix, .. } = self.use_rules[rule].clone();
                let (suite, reliable) = (entry.suite, entry.qos.is_reliable());
                let class = class.unwrap_or(entry.class);
                self.uses.insert(name, UseRoute::new(rule, local_name, entry));
                if self.use_rules[rule].is_service() {
                    return self.commands.push_back(Command::Call { name, owner, suite, class });
                }
                if self.publishes(rule) {
                    self.commands.push_back(Command::Publish { name, owner, suite, class, reliable });
                    self.shape(name, shaping);
                    self.check_later();
                    return self.find_publishers();
                }
                self.commands.push_back(Command::Join { name, owner, transient_local, describe: false });
                self.shape(name, shaping);
                self.frames(name, frame_prefix);
                self.check_later();
            }
        }
    }

    pub(super) fn hold_use(&mut self, now: Instant, name: Name) {
        if let Some(route) = self.uses.get_mut(&name) {
            route.granted = false;
            if !route.writers.is_empty() || route.reader.is_some() || route.server.is_some() {
                route.unreachable_until.get_or_insert(now + UNREACHABLE_HOLD);
            }
        }
    }

    /// Closes the local endpoints of uses whose owner has been out of reach for too long.
    pub(super) fn uses_time_out(&mut self, now: Instant) {
        for (name, route) in &mut self.uses {
            if route.unreachable_until.take_if(|at| *at <= now).is_none() {
                continue;
            }
            route.nodes.clear();
            for source in std::mem::take(&mut route.writers).into_keys() {
                self.commands.push_back(Command::CloseWriter { name: *name, source });
            }
            if route.reader.take().is_some() {
                self.commands.push_back(Command::CloseReader { name: *name });
            }
            if route.server.take().is_some() {
                self.commands.push_back(Command::CloseServer { name: *name });
            }
        }
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
        if let Some(route) = self.uses.remove(&name) {
            self.backlog.free();
            self.consumers_changed = true;
            for source in route.writers.into_keys() {
                self.commands.push_back(Command::CloseWriter { name, source });
            }
            if route.reader.is_some() {
                self.commands.push_back(Command::CloseReader { name });
            }
            if route.server.is_some() {
                self.commands.push_back(Command::CloseServer { name });
            }
            self.check_later();
        }
    }

    /// Updates the local writers of a granted route to match its catalogue entry: one for each listed publisher, with
    /// its QoS, history and node, and one for all others if there are any.
    pub(super) fn refresh_use(&mut self, name: Name) {
        let Some(route) = self.uses.get_mut(&name).filter(|u| u.granted) else { return };
        // A route that publishes or calls has no writers.
        if self.use_rules[route.rule].direction == Direction::Publish {
            return;
        }
        let entry = &route.entry;
        let set = self.use_rules[route.rule].qos;
        let spec = |qos: &Qos| EndpointSpec {
            topic: dds_topic(&route.local_name),
            type_name: dds_type(&entry.metadata.type_name),
            keyless: entry.keyless,
            asks_key_hash: false,
            type_hash: entry.type_hash.clone(),
            qos: set.apply(qos),
        };
        // A writer without a valid lease is closed, so that subscribers that watch its liveliness notice at once.
        let alive = entry.sources.iter().filter(|s| !s.source.is_lapsed());
        let mut wanted: BTreeMap<Option<SourceId>, EndpointSpec> =
            alive.map(|s| (s.source.told_apart(), spec(&s.qos))).collect();
        if entry.sources.is_empty() || entry.sources.len() >= ENTRY_SOURCES_MAX {
            wanted.insert(None, spec(&entry.qos));
        }
        // A publisher whose node restarted has a new source. Locally it keeps its writer.
        let (mut moved, mut resized) = (BTreeSet::new(), BTreeSet::new());
        let mut stand_ins = BTreeMap::new();
        for (to, spec) in wanted.iter().filter_map(|(to, spec)| Some(((*to)?, spec))) {
            let is_gone = |from: &SourceId| {
                !wanted.contains_key(&Some(*from))
                    && from.publisher() == to.publisher()
                    && !moved.contains(from)
            };
            let mut alike =
                route.writers.iter().filter(|(_, old)| serves(old, spec)).filter_map(|(from, _)| *from);
            let from = alike.find(is_gone);
            if let Some(from) = from.filter(|_| !route.writers.contains_key(&Some(to))) {
                moved.extend([from, to]);
                stand_ins.insert(Some(to), Some(from));
                self.commands.push_back(Command::MoveWriter { name, from, to });
            }
        }
        for (source, spec) in &mut wanted {
            let old = route.writers.get(stand_ins.get(source).unwrap_or(source));
            let Some(old) = old.filter(|old| *old != spec && serves(old, spec)) else { continue };
            if spec.qos.history.is_unsaid() {
                // The depth of a publisher is constant and was known before its node restarted.
                spec.qos.history = old.qos.history;
            } else {
                let (source, spec) = (*source, spec.clone());
                self.commands.push_back(Command::ResizeWriter { name, source, spec });
            }
            resized.insert(*source);
        }
        // Writers that a restarted owner may still rediscover stay as they are.
        if self.owners.is_settling(&self.use_rules[route.rule].owner) {
            for (source, old) in &route.writers {
                if source.is_some_and(|source| !moved.contains(&source)) {
                    wanted.entry(*source).or_insert_with(|| old.clone());
                }
            }
        }
        let has_moved = |source: &Option<SourceId>| source.is_some_and(|source| moved.contains(&source));
        for (source, old) in &route.writers {
            if wanted.get(source) != Some(old) && !has_moved(source) && !resized.contains(source) {
                route.nodes.remove(source);
                self.commands.push_back(Command::CloseWriter { name, source: *source });
            }
        }
        for (source, spec) in &wanted {
            if route.writers.get(source) != Some(spec) && !has_moved(source) && !resized.contains(source) {
                let spec = spec.clone();
                self.commands.push_back(Command::OpenWriter { name, source: *source, spec });
            }
        }
        route.writers = wanted;
        self.name_writers(name);
    }

    /// Reports a problem if interfaces of several owners under one name have different types.
    fn check_merged(&mut self, rule: UseRuleId, metadata: &Metadata) {
        let found = &metadata.type_name;
        let local_name = self.use_rules[rule].local_name(metadata);
        let differs = |u: &&UseRoute| {
            let other = &u.entry.metadata;
            !self.publishes(u.rule)
                && u.local_name == local_name
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
                other: self.use_rules[other.rule].owner_name.clone(),
                known: other.entry.metadata.type_name.clone(),
            };
            self.report(Cause::Catalogue(self.use_rules[rule].owner), problem);
        }
    }
}

/// Returns `true` if an open writer can serve as the wanted one: both are the same, or one of them has an unknown
/// depth.
fn serves(open: &EndpointSpec, wanted: &EndpointSpec) -> bool {
    let differ_in_depth = open.qos.history.is_unsaid() && matches!(wanted.qos.history, History::KeepLast(_))
        || wanted.qos.history.is_unsaid() && matches!(open.qos.history, History::KeepLast(_));
    let as_open = || {
        let qos = Qos { history: open.qos.history, ..wanted.qos.clone() };
        EndpointSpec { qos, ..wanted.clone() }
    };
    open == wanted || (wanted.qos.is_transient_local() && differ_in_depth && *open == as_open())
}
