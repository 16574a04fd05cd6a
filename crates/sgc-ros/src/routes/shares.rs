//! Share routes: from local writers to shares.

use std::collections::{BTreeMap, BTreeSet};
use std::time::Instant;

use rand_core::RngCore;
use sgc_trust::{FleetSecret, derive_name};
use sgc_wire::{CatalogueSource, ENTRY_SOURCES_MAX, Kind, Liveliness, Name, Qos, SinkId, SourceId};

use super::command::Command;
use super::machine::Routes;
use super::problem::{Cause, Problem, Way};
use super::readers::{asks_key_hash, same_reader};
use super::rules::{ROUTES_PER_WILDCARD_MAX, ShareRuleId};
use super::services::interface;
use super::share_route::{OwnSource, SINKLESS_HOLD, ShareRoute, WRITERLESS_HOLD};
use crate::names::{dds_topic, is_topic_name, ros_type};
use crate::network::{DiscoveredEndpoint, EndpointKind, EndpointSpec, Guid};
use crate::qos::{for_all_instances, reader_for, service_qos, weakest};

impl<R: RngCore> Routes<R> {
    /// Handles the grant of a share to a sink.
    pub fn handle_sink_joined(&mut self, name: &Name, sink: SinkId) {
        if let Some(share) = self.shares.get_mut(name) {
            share.sinks.insert(sink);
            self.refresh_share(*name);
        }
    }

    /// Handles the end of a sink of a share.
    pub fn handle_sink_left(&mut self, now: Instant, name: &Name, sink: &SinkId) {
        if let Some(share) = self.shares.get_mut(name)
            && share.sinks.remove(sink)
            && share.sinks.is_empty()
        {
            share.sinkless_until = Some(now + SINKLESS_HOLD);
        }
    }

    pub(super) fn writer_there(&mut self, writer: DiscoveredEndpoint) {
        if matches!(interface(&writer.topic), Some((Kind::Topic, _))) {
            self.check_local(&writer);
            self.publisher_there(&writer);
        }
        self.share_writer(writer);
    }

    /// Shares the topic of a local writer if a rule covers it.
    pub(super) fn share_writer(&mut self, writer: DiscoveredEndpoint) {
        let guid = writer.guid;
        let problem = self.share_or_say_why_not(writer);
        self.settle(Cause::Unshared(guid), problem.into_iter().collect());
    }

    fn share_or_say_why_not(&mut self, writer: DiscoveredEndpoint) -> Option<Problem> {
        let (kind, topic) = interface(&writer.topic)?;
        let topic = topic.to_owned();
        let found = ros_type(&writer.type_name);
        let Some(rule) = self.share_rule(kind, &topic, Some(&found)) else {
            let problem = self.why_not_shared(kind, &topic, &found);
            if problem.is_some() {
                self.backlog.wait();
            }
            return problem;
        };
        let share = &self.share_rules[rule];
        let expected = &share.metadata.type_name;
        // `check_local` has reported that.
        if !expected.is_empty() && *expected != found {
            return None;
        }
        // A running share keeps its name even after the secret was replaced.
        if let Some(route) =
            self.shares.values_mut().find(|s| s.rule == rule && s.fits(&topic, &writer.type_name))
        {
            route.writers.insert(writer.guid, writer);
            route.writerless_until = None;
            let name = route.name;
            self.refresh_share(name);
            return None;
        }
        self.begin_share(rule, &topic, writer.type_name.clone(), writer.keyless, Some(writer))
    }

    /// Begins a share with a first writer, or without one. Returns a problem if its name or the number of shares
    /// forbids it.
    pub(super) fn begin_share(
        &mut self,
        rule: ShareRuleId,
        topic: &str,
        type_name: String,
        keyless: bool,
        writer: Option<DiscoveredEndpoint>,
    ) -> Option<Problem> {
        let share = &self.share_rules[rule];
        let metadata = share.metadata_of(topic, &ros_type(&type_name));
        let name = derive_name(&self.secret, &self.node, &metadata);
        let problem = if !is_topic_name(&metadata.ros_name) {
            Some(Problem::NoSharedName { topic: topic.to_owned(), called: metadata.ros_name })
        } else if let Some(other) = self.shares.get(&name) {
            let (topic, other) = (topic.to_owned(), other.local_name.clone());
            Some(Problem::SharedAsOne { topic, called: metadata.ros_name, other })
        } else {
            let running = || self.shares.values().filter(|s| s.rule == rule).count();
            (share.is_pattern() && running() >= ROUTES_PER_WILDCARD_MAX)
                .then(|| Problem::TooManyMatches { topic: share.metadata.ros_name.clone(), way: Way::Shared })
        };
        if problem.is_some() {
            self.backlog.wait();
            return problem;
        }
        let shaping = share.shaping;
        let (spec, route) = ShareRoute::begin(name, rule, share, topic, &type_name, keyless, writer);
        self.shares.insert(name, route);
        self.commands.push_back(Command::Share(spec));
        self.shape(name, shaping);
        self.refresh_share(name);
        None
    }

    pub(super) fn writer_gone(&mut self, now: Instant, endpoint: &DiscoveredEndpoint) {
        if endpoint.kind != EndpointKind::Writer {
            return;
        }
        self.publisher_gone(endpoint);
        let names: Vec<_> =
            self.shares.values().filter(|s| s.writers.contains_key(&endpoint.guid)).map(|s| s.name).collect();
        for name in names {
            let Some(share) = self.shares.get_mut(&name) else { continue };
            share.writers.remove(&endpoint.guid);
            match share.own.get_mut(&endpoint.guid) {
                Some(own) if !own.qos.is_transient_local() => own.gone = Some(now),
                // Late joiners get no history of a publisher that is gone. The last one counts as gone only after the
                // hold.
                _ if !share.writers.is_empty() => drop(share.own.remove(&endpoint.guid)),
                _ => share.own.clear(),
            }
            if share.writers.is_empty() {
                // The offer stands until the hold ends, so that a restarted program finds the share unchanged. A
                // share for messages of others needs no writer.
                if !self.share_rules[share.rule].is_inbound() {
                    share.writerless_until = Some(now + WRITERLESS_HOLD);
                    if self.share_rules[share.rule].is_service() {
                        self.commands.push_back(Command::ServersGone { name });
                    }
                    continue;
                }
            }
            self.refresh_share(name);
        }
    }

    /// Handles the expiry of a local writer's lease, or its renewal. A far writer with liveliness manual by topic is
    /// renewed by messages and assertions and expires by itself. All others live as long as this node's writers.
    pub(super) fn handle_liveliness(&mut self, guid: Guid, is_alive: bool) {
        let is_concerned = |own: &OwnSource| {
            own.is_lapsed == is_alive && (is_alive || own.qos.liveliness != Liveliness::ManualByTopic)
        };
        let mut names = Vec::new();
        for (name, share) in &mut self.shares {
            if let Some(own) = share.own.get_mut(&guid).filter(|own| is_concerned(own)) {
                own.is_lapsed = !is_alive;
                names.push(*name);
            }
        }
        for name in names {
            self.refresh_share(name);
        }
    }

    /// Updates the depth of a local publisher that did not announce it.
    pub(super) fn handle_depth(&mut self, writer: &Guid, depth: u32) {
        let Some(history) = self.local.learn_depth(writer, depth) else { return };
        let mut names = Vec::new();
        for (name, share) in &mut self.shares {
            if let Some(endpoint) = share.writers.get_mut(writer) {
                endpoint.qos.history = history;
                names.push(*name);
            }
        }
        for name in names {
            self.refresh_share(name);
        }
    }

    /// Updates catalogue entry, sources and reader of a share to match its writers and sinks.
    pub(super) fn refresh_share(&mut self, name: Name) {
        let Some(share) = self.shares.get_mut(&name) else { return };
        let wanted = self.share_rules[share.rule].qos;
        // The reader requests no more than the writers offer. The rule's policies are offered elsewhere.
        let found = weakest(share.writers.values().map(|w| &w.qos));
        let offers: Vec<_> = share.writers.values().map(|w| wanted.apply(&w.qos)).collect();
        let offer = match weakest(&offers) {
            Some(offer) => offer,
            None if !self.share_rules[share.rule].is_inbound() => return,
            // The offers of remote publishers are unknown here. ROS 2's default serves commands well.
            None => Qos::default(),
        };
        let transient_local = offer.is_transient_local();
        // All servers answer under one source.
        let is_service = self.share_rules[share.rule].is_service();
        share.own.retain(|_, own| own.gone.is_none() || !transient_local);
        let mut problems = BTreeSet::new();
        for (guid, writer) in share.writers.iter().filter(|_| !is_service) {
            let qos = carried(&wanted.apply(&writer.qos), &offer);
            let passed_on = was_passed_on(&share.own, guid);
            match share.own.get_mut(guid) {
                // A source of another kind must be a new one.
                Some(own) if !passed_on && same_kind(&own.qos, &qos) => {
                    own.qos = qos;
                    own.gone = None;
                }
                _ => {
                    let is_lapsed = share.own.remove(guid).is_some_and(|own| own.is_lapsed);
                    let mut new = || source_of(&self.secret, guid, &mut self.rng);
                    let found = own_source(&mut share.own, &qos, &mut new);
                    if found.is_none() {
                        problems.insert(Problem::TooManySources { topic: share.local_name.clone() });
                    }
                    let source = found.or_else(|| share.own.values().map(|own| own.source).max());
                    let source = source.unwrap_or_else(new);
                    share.own.insert(*guid, OwnSource { source, qos, gone: None, is_lapsed });
                }
            }
        }
        let Some(share) = self.shares.get(&name) else { return };
        if offers.iter().any(|qos| {
            (qos.reliability, qos.durability, qos.representations)
                != (offer.reliability, offer.durability, offer.representations)
        }) {
            let topic = share.local_name.clone();
            problems.insert(Problem::MixedQos { topic, offered: describe(&offer) });
        }
        problems.extend(share.hashes_differ());
        let own: Vec<_> = share.own.iter().map(|(g, own)| (*g, own.source, own.qos.clone())).collect();
        let sources = if is_service { self.listed_servers(share) } else { self.listed(share) };
        self.commands.push_back(Command::UpdateShare { name, qos: offer.clone(), sources });
        let Some(share) = self.shares.get_mut(&name) else { return };
        let class = self.share_rules[share.rule].class;
        let keyless = share.keyless;
        let kept = |qos: Qos| match keyless {
            true => qos,
            false => Qos { history: for_all_instances(qos.history), ..qos },
        };
        let own = own.into_iter().map(|(writer, source, qos)| (writer, source, kept(qos))).collect();
        self.commands.push_back(Command::MapSources { name, class, own });
        if is_service {
            self.settle(Cause::Share(name), problems);
            return self.refresh_client(name);
        }
        // A transient-local topic is read from the start, because late joiners are promised its history.
        let wanted = offer.is_transient_local() || !share.sinks.is_empty() || share.sinkless_until.is_some();
        let wanted = wanted && !share.writers.is_empty();
        let read = Qos {
            reliability: found.as_ref().map_or(offer.reliability, |found| found.reliability),
            durability: found
                .as_ref()
                .map_or(offer.durability, |found| found.durability.min(offer.durability)),
            ..offer
        };
        if !share.sinks.is_empty() {
            share.sinkless_until = None;
        }
        let spec = wanted.then(|| EndpointSpec {
            topic: dds_topic(&share.local_name),
            type_name: share.type_name.clone(),
            keyless: share.keyless,
            asks_key_hash: asks_key_hash(share.keyless, share.writers.keys()),
            type_hash: share.writers.values().find_map(|w| w.type_hash.clone()),
            qos: reader_for(&read, share.writers.len()),
        });
        if !same_reader(share.reader.as_ref(), spec.as_ref()) {
            if share.reader.is_some() {
                self.commands.push_back(Command::CloseReader { name });
            }
            if let Some(spec) = &spec {
                self.commands.push_back(Command::OpenReader { name, spec: spec.clone() });
            }
            share.reader = spec;
        }
        self.settle(Cause::Share(name), problems);
    }

    /// Returns the publishers behind a share, each source once.
    fn listed(&self, share: &ShareRoute) -> Vec<CatalogueSource> {
        let mut listed = BTreeMap::<SourceId, Vec<(&Guid, &OwnSource)>>::new();
        for (guid, own) in &share.own {
            listed.entry(own.source).or_default().push((guid, own));
        }
        let listed = listed.into_iter().filter_map(|(source, mut all)| {
            // A source that passed to another writer stands for that writer.
            if all.iter().any(|(_, own)| own.gone.is_none()) {
                all.retain(|(_, own)| own.gone.is_none());
            }
            let qos = weakest(all.iter().map(|(_, own)| &own.qos))?;
            let node = self.node_of(all.first()?.0);
            let is_same = all.iter().all(|(guid, _)| self.node_of(guid) == node);
            let is_lapsed = all.iter().all(|(_, own)| own.is_lapsed);
            let source = if is_lapsed { source.lapsed() } else { source };
            Some(CatalogueSource { source, qos, node: node.filter(|_| is_same).cloned() })
        });
        listed.collect()
    }

    /// Returns the nodes of the servers, each under an id that no message uses.
    fn listed_servers(&self, share: &ShareRoute) -> Vec<CatalogueSource> {
        let server = |guid: &Guid| CatalogueSource {
            source: SourceId::from_publisher(self.secret.publisher_tag(&guid.0), [0; 8]),
            qos: service_qos(),
            node: self.node_of(guid).cloned(),
        };
        share.writers.keys().take(ENTRY_SOURCES_MAX).map(server).collect()
    }

    /// Ends shares whose last writer has been gone for a while, and forgets sources and sinks that are gone.
    pub(super) fn shares_time_out(&mut self, now: Instant) {
        let due = |at: Option<Instant>| at.is_some_and(|at| at <= now);
        for name in self.shares.keys().copied().collect::<Vec<_>>() {
            let Some(share) = self.shares.get_mut(&name) else { continue };
            if due(share.writerless_until) {
                self.drop_share(name);
                continue;
            }
            let gone = |own: &OwnSource| due(own.gone.map(|at| at + WRITERLESS_HOLD));
            let sinkless = share.sinkless_until.take_if(|at| *at <= now).is_some();
            let sources = share.own.len();
            share.own.retain(|_, own| !gone(own));
            if sinkless || share.own.len() < sources {
                self.refresh_share(name);
            }
        }
    }

    pub(super) fn drop_share(&mut self, name: Name) {
        if let Some(share) = self.shares.remove(&name) {
            self.settle(Cause::Share(name), BTreeSet::new());
            self.backlog.free();
            if share.reader.is_some() {
                self.commands.push_back(Command::CloseReader { name });
            }
            if share.writer.is_some() {
                self.commands.push_back(Command::CloseWriter { name, source: None });
            }
            if share.client.is_some() {
                self.commands.push_back(Command::CloseClient { name });
            }
            self.commands.push_back(Command::Unshare { name });
        }
    }
}

/// Returns the source for a writer without one: that of a similar volatile writer that is gone, or a new one. Returns
/// `None` if there are too many.
fn own_source(
    known: &mut BTreeMap<Guid, OwnSource>,
    qos: &Qos,
    new: impl FnOnce() -> SourceId,
) -> Option<SourceId> {
    let here = known.values().filter(|own| own.gone.is_none()).map(|own| own.source);
    let here: BTreeSet<_> = here.collect();
    let vacant = || known.values().filter(|own| !here.contains(&own.source));
    if let Some(own) = vacant().filter(|own| own.qos == *qos).max_by_key(|own| own.gone) {
        return Some(own.source);
    }
    let all: BTreeSet<_> = known.values().map(|own| own.source).collect();
    if all.len() >= ENTRY_SOURCES_MAX {
        let oldest = vacant().min_by_key(|own| own.gone)?.source;
        known.retain(|_, own| own.source != oldest);
    }
    Some(new())
}

/// Returns `true` if the writer vanished and its source passed to another.
fn was_passed_on(own: &BTreeMap<Guid, OwnSource>, writer: &Guid) -> bool {
    let Some(source) = own.get(writer).filter(|own| own.gone.is_some()).map(|own| own.source) else {
        return false;
    };
    own.values().any(|other| other.source == source && other.gone.is_none())
}

/// Returns the part of a writer's offer that is carried: the combined offer decides how it is read and kept for late
/// joiners.
fn carried(own: &Qos, offer: &Qos) -> Qos {
    Qos {
        reliability: own.reliability.min(offer.reliability),
        durability: own.durability.min(offer.durability),
        ..own.clone()
    }
}

/// Returns `true` if one source can stand for both.
fn same_kind(a: &Qos, b: &Qos) -> bool {
    (a.reliability, a.is_transient_local()) == (b.reliability, b.is_transient_local())
}

/// Returns a new source id for a local writer, by which receivers recognise the writer's earlier sources.
fn source_of(secret: &FleetSecret, writer: &Guid, rng: &mut impl RngCore) -> SourceId {
    let mut random = [0; 8];
    rng.fill_bytes(&mut random);
    SourceId::from_publisher(secret.publisher_tag(&writer.0), random)
}

fn describe(qos: &Qos) -> String {
    format!("{:?}, {:?}, {:?}", qos.reliability, qos.durability, qos.representations)
}
