//! Use routes: from an owner's catalogue to local writers.

use std::collections::{BTreeMap, BTreeSet};
use std::time::Instant;

use rand_core::RngCore;
use sgc_endpoint::{LostReason, RefusedBy};
use sgc_trust::name_of;
use sgc_wire::{Catalogue, CatalogueEntry, Kind, Name, NodeId, Qos, SourceId};

use super::{
    Command, Direction, ENTRIES_PER_RULE_MAX, Problem, Routes, UNREACHABLE_HOLD, UseRoute, describe,
};
use crate::names::{dds_topic, dds_type, ros_topic, ros_type};
use crate::network::{DiscoveredEndpoint, EndpointKind, EndpointSpec};

impl<R: RngCore> Routes<R> {
    /// An owner's catalogue arrived or changed.
    pub fn handle_catalogue(&mut self, owner: NodeId, catalogue: Catalogue) {
        self.owners.remove(&owner);
        let mut listed = BTreeSet::new();
        self.catalogues.insert(owner, catalogue.clone());
        for entry in catalogue.entries {
            let Some(rule) = self.rule_for(owner, &entry) else { continue };
            let name = name_of(&owner, &entry.blind);
            let here = self.uses.iter().filter(|(n, u)| u.rule == rule && **n != name).count();
            if here >= ENTRIES_PER_RULE_MAX {
                let topic = self.use_rules[rule].topic.clone();
                let owner = self.use_rules[rule].owner_name.clone();
                self.report(Problem::TooManyEntries { topic, owner });
                continue;
            }
            listed.insert(name);
            self.entry_there(name, rule, entry);
        }
        let gone: Vec<_> = self
            .uses
            .iter()
            .filter(|(n, u)| self.use_rules[u.rule].is_of_catalogue(&owner) && !listed.contains(n))
            .map(|(n, _)| *n)
            .collect();
        for name in gone {
            self.drop_use(name);
        }
    }

    /// The way to an owner's catalogue is lost, or the owner has gone in good order. Its topics have ways of their own,
    /// which may well stand; what becomes of those [`Self::handle_lost`] is told.
    pub fn handle_owner_lost(&mut self, owner: NodeId, reason: LostReason) {
        if !matches!(reason, LostReason::Withdrawn | LostReason::Refused(_)) {
            self.owners.insert(owner, "is out of reach".into());
            return;
        }
        self.catalogues.remove(&owner);
        self.owners.insert(owner, "has gone".into());
        let names: Vec<_> = self
            .uses
            .iter()
            .filter(|(_, u)| self.use_rules[u.rule].is_of_catalogue(&owner))
            .map(|(n, _)| *n)
            .collect();
        for name in names {
            self.drop_use(name);
        }
    }

    /// An owner does not let this node follow it.
    pub fn handle_owner_refused(&mut self, owner: NodeId, by: RefusedBy) {
        self.owners.insert(owner, format!("refuses its catalogue: {by}"));
    }

    /// A join was granted. `entry` is what the name stands for, where that was asked for.
    pub fn handle_granted(&mut self, name: &Name, entry: Option<CatalogueEntry>) {
        if let (Some(entry), true) = (entry, self.tokens.contains_key(name)) {
            self.handle_described(*name, entry);
        }
        if let Some(route) = self.uses.get_mut(name) {
            route.granted = true;
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

    /// A join was refused.
    pub fn handle_refused(&mut self, name: &Name, by: RefusedBy) {
        if let Some(route) = self.uses.get_mut(name) {
            route.refused = Some(by);
        }
        if let Some(token) = self.tokens.get_mut(name) {
            token.refused = Some(by);
        }
    }

    /// A grant is void for now.
    pub fn handle_lost(&mut self, now: Instant, name: &Name) {
        self.hold_use(now, *name);
    }

    /// The rule that asks for a catalogue entry.
    pub(super) fn rule_for(&mut self, owner: NodeId, entry: &CatalogueEntry) -> Option<usize> {
        let metadata = &entry.metadata;
        let (index, rule) = self.use_rules.iter().enumerate().find(|(_, r)| {
            let may = match r.direction {
                Direction::Bring => entry.subscribe,
                Direction::Publish => entry.publish,
            };
            may && r.is_of_catalogue(&owner) && r.topic == metadata.ros_name && metadata.kind == Kind::Topic
        })?;
        match &rule.type_name {
            Some(expected) if *expected != metadata.type_name => {
                let problem = Problem::UseType {
                    topic: rule.topic.clone(),
                    owner: rule.owner_name.clone(),
                    expected: expected.clone(),
                    found: metadata.type_name.clone(),
                };
                self.report(problem);
                None
            }
            _ => Some(index),
        }
    }

    pub(super) fn entry_there(&mut self, name: Name, rule: usize, entry: CatalogueEntry) {
        let transient_local = entry.qos.is_transient_local();
        match self.uses.get_mut(&name) {
            Some(route) if self.use_rules[route.rule].direction == Direction::Publish => route.entry = entry,
            Some(route) if route.entry.qos.is_transient_local() == transient_local => {
                route.entry = entry;
                self.refresh_use(name);
            }
            // Another durability is another kind of sink: start over.
            Some(_) => {
                self.drop_use(name);
                self.entry_there(name, rule, entry);
            }
            None => {
                let owner = self.use_rules[rule].owner;
                let (suite, class, reliable) = (entry.suite, entry.class, entry.qos.is_reliable());
                self.uses.insert(name, UseRoute::new(rule, entry));
                if self.publishes(rule) {
                    self.commands.push_back(Command::Publish { name, owner, suite, class, reliable });
                    return self.find_publishers();
                }
                self.commands.push_back(Command::Join { name, owner, transient_local, describe: false });
                for endpoint in self.endpoints.values().cloned().collect::<Vec<_>>() {
                    self.check_local(&endpoint);
                }
            }
        }
    }

    pub(super) fn hold_use(&mut self, now: Instant, name: Name) {
        if let Some(route) = self.uses.get_mut(&name) {
            route.granted = false;
            if !route.writers.is_empty() || route.reader.is_some() {
                route.unreachable_until.get_or_insert(now + UNREACHABLE_HOLD);
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

    /// Ends what a use has on the local network; its name stays joined.
    pub(super) fn close_use(&mut self, name: Name) {
        if let Some(route) = self.uses.remove(&name) {
            for source in route.writers.into_keys() {
                self.commands.push_back(Command::CloseWriter { name, source });
            }
            if route.reader.is_some() {
                self.commands.push_back(Command::CloseReader { name });
            }
        }
    }

    /// Brings the local writers of a granted route in line with its catalogue entry: one for each transient-local
    /// source, so that each keeps its own history, and one for all others.
    pub(super) fn refresh_use(&mut self, name: Name) {
        let Some(route) = self.uses.get_mut(&name).filter(|u| u.granted) else { return };
        let entry = &route.entry;
        let spec = |qos: &Qos| EndpointSpec {
            topic: dds_topic(&entry.metadata.ros_name),
            type_name: dds_type(&entry.metadata.type_name),
            keyless: entry.keyless,
            type_hash: entry.type_hash.clone(),
            qos: qos.clone(),
        };
        let mut wanted: BTreeMap<Option<SourceId>, EndpointSpec> =
            entry.sources.iter().map(|s| (Some(s.source), spec(&s.qos))).collect();
        if wanted.is_empty() {
            wanted.insert(None, spec(&entry.qos));
        }
        for (source, old) in &route.writers {
            if wanted.get(source) != Some(old) {
                self.commands.push_back(Command::CloseWriter { name, source: *source });
            }
        }
        for (source, spec) in &wanted {
            if route.writers.get(source) != Some(spec) {
                let spec = spec.clone();
                self.commands.push_back(Command::OpenWriter { name, source: *source, spec });
            }
        }
        route.writers = wanted;
    }

    /// Says so if a local endpoint cannot talk to a used topic.
    pub(super) fn check_local(&mut self, endpoint: &DiscoveredEndpoint) {
        let Some(topic) = ros_topic(&endpoint.topic) else { return };
        let mut problems = Vec::new();
        let brought = |u: &&UseRoute| !self.publishes(u.rule) && u.entry.metadata.ros_name == topic;
        for route in self.uses.values().filter(brought) {
            let (topic, owner) = (topic.to_owned(), self.use_rules[route.rule].owner_name.clone());
            let (remote, local) = (route.entry.metadata.type_name.clone(), ros_type(&endpoint.type_name));
            let reader = endpoint.kind == EndpointKind::Reader;
            if remote != local {
                let end = if reader { "subscriber" } else { "publisher" };
                problems.push(Problem::LocalType { topic, owner, remote, end, local });
            } else if reader
                && (endpoint.qos.reliability > route.entry.qos.reliability
                    || endpoint.qos.durability > route.entry.qos.durability)
            {
                let (offered, requested) = (describe(&route.entry.qos), describe(&endpoint.qos));
                problems.push(Problem::LocalQos { topic, owner, offered, requested });
            }
        }
        for problem in problems {
            self.report(problem);
        }
    }
}
