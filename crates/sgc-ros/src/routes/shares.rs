//! Share routes: from local writers to what is shared.

use std::collections::{BTreeMap, BTreeSet};
use std::time::Instant;

use rand_core::RngCore;
use sgc_trust::derive_name;
use sgc_wire::{CatalogueSource, ENTRY_SOURCES_MAX, Metadata, Name, Qos, SinkId};

use super::{
    Command, Problem, Routes, SINKLESS_HOLD, ShareRoute, WRITERLESS_HOLD, describe, random_source,
    same_reader,
};
use crate::names::{dds_topic, ros_topic, ros_type};
use crate::network::{DiscoveredEndpoint, EndpointKind, EndpointSpec};
use crate::qos::{reader_for, weakest};

impl<R: RngCore> Routes<R> {
    /// A sink was granted one of our shares.
    pub fn handle_sink_joined(&mut self, name: &Name, sink: SinkId) {
        if let Some(share) = self.shares.get_mut(name) {
            share.sinks.insert(sink);
            self.refresh_share(*name);
        }
    }

    /// A sink of one of our shares is gone.
    pub fn handle_sink_left(&mut self, now: Instant, name: &Name, sink: &SinkId) {
        if let Some(share) = self.shares.get_mut(name)
            && share.sinks.remove(sink)
            && share.sinks.is_empty()
        {
            share.sinkless_until = Some(now + SINKLESS_HOLD);
        }
    }

    pub(super) fn writer_there(&mut self, writer: DiscoveredEndpoint) {
        self.check_local(&writer);
        self.publisher_there(&writer);
        let Some(topic) = ros_topic(&writer.topic) else { return };
        let found = ros_type(&writer.type_name);
        let Some((rule, share)) =
            self.share_rules.iter().enumerate().find(|(_, s)| s.metadata.ros_name == topic)
        else {
            return;
        };
        let expected = &share.metadata.type_name;
        if !expected.is_empty() && *expected != found {
            let problem = Problem::ShareType { topic: topic.to_owned(), expected: expected.clone(), found };
            return self.report(problem);
        }
        // One that runs keeps its name, also after the secret that names come from was replaced.
        if let Some(route) =
            self.shares.values_mut().find(|s| s.rule == rule && s.type_name == writer.type_name)
        {
            route.writers.insert(writer.guid, writer);
            route.writerless_until = None;
            let name = route.name;
            return self.refresh_share(name);
        }
        let metadata = Metadata { type_name: found, ..share.metadata.clone() };
        let name = derive_name(&self.secret, &self.node, &metadata);
        let (type_name, keyless) = (writer.type_name.clone(), writer.keyless);
        let (spec, route) = ShareRoute::begin(name, rule, share, &type_name, keyless, Some(writer));
        self.shares.insert(name, route);
        self.commands.push_back(Command::Share(spec));
        self.refresh_share(name);
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
            if share.writers.is_empty() {
                // What was offered stands until the hold ends: a restarted program finds it as it was.
                share.own.clear();
                // One that others publish on is there without.
                if self.share_rules[share.rule].policy.publish.is_empty() {
                    share.writerless_until = Some(now + WRITERLESS_HOLD);
                    continue;
                }
            }
            self.refresh_share(name);
        }
    }

    /// Brings catalogue, sources and reader of a share in line with its writers and sinks.
    pub(super) fn refresh_share(&mut self, name: Name) {
        let Some(share) = self.shares.get_mut(&name) else { return };
        let offer = match weakest(share.writers.values().map(|w| &w.qos)) {
            Some(offer) => offer,
            None if self.share_rules[share.rule].policy.publish.is_empty() => return,
            // What the publishers elsewhere offer is not known here; ROS 2's default serves commands well.
            None => Qos::default(),
        };
        share.own.retain(|guid, _| share.writers.contains_key(guid));
        let mut problem = None;
        if offer.is_transient_local() {
            let mut known: BTreeSet<_> = share.own.values().copied().collect();
            for guid in
                share.writers.keys().filter(|guid| !share.own.contains_key(guid)).copied().collect::<Vec<_>>()
            {
                let source = match known.last() {
                    Some(last) if known.len() >= ENTRY_SOURCES_MAX => {
                        let topic = self.share_rules[share.rule].metadata.ros_name.clone();
                        problem = Some(Problem::TooManySources { topic });
                        *last
                    }
                    _ => random_source(&mut self.rng),
                };
                known.insert(source);
                share.own.insert(guid, source);
            }
        } else {
            share.own.clear();
        }
        if share
            .writers
            .values()
            .any(|w| (w.qos.reliability, w.qos.durability) != (offer.reliability, offer.durability))
        {
            let topic = self.share_rules[share.rule].metadata.ros_name.clone();
            problem = Some(Problem::MixedQos { topic, offered: describe(&offer) });
        }
        let own: Vec<_> = share.own.iter().map(|(g, s)| (*g, *s, share.writers[g].qos.clone())).collect();
        let listed: BTreeMap<_, _> = own.iter().map(|(_, source, qos)| (*source, qos)).collect();
        let sources =
            listed.into_iter().map(|(source, qos)| CatalogueSource { source, qos: qos.clone() }).collect();
        self.commands.push_back(Command::UpdateShare { name, qos: offer.clone(), sources });
        let class = self.share_rules[share.rule].class;
        self.commands.push_back(Command::MapSources { name, qos: offer.clone(), class, own });
        // A transient-local topic is read from the start: late joiners are promised its history.
        let wanted = offer.is_transient_local() || !share.sinks.is_empty() || share.sinkless_until.is_some();
        let wanted = wanted && !share.writers.is_empty();
        if !share.sinks.is_empty() {
            share.sinkless_until = None;
        }
        let spec = wanted.then(|| EndpointSpec {
            topic: dds_topic(&self.share_rules[share.rule].metadata.ros_name),
            type_name: share.type_name.clone(),
            keyless: share.keyless,
            type_hash: share.writers.values().find_map(|w| w.type_hash.clone()),
            qos: reader_for(&offer, share.writers.len()),
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
        if let Some(problem) = problem {
            self.report(problem);
        }
    }

    pub(super) fn drop_share(&mut self, name: Name) {
        if let Some(share) = self.shares.remove(&name) {
            if share.reader.is_some() {
                self.commands.push_back(Command::CloseReader { name });
            }
            if share.writer.is_some() {
                self.commands.push_back(Command::CloseWriter { name, source: None });
            }
            self.commands.push_back(Command::Unshare { name });
        }
    }
}
