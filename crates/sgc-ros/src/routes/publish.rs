//! The other way: local publishers on a name that another node owns, and remote publishers on one of ours.
//!
//! A use route whose rule says so does not bring a topic here but takes local messages there, while its owner lets
//! this node publish. A share route on which others may publish has a local writer while any of them is there.

use rand_core::RngCore;
use sgc_wire::{History, Metadata, Name, Qos};

use super::{Cause, Command, Direction, Routes, Shaping, asks_key_hash, same_reader};
use crate::names::{dds_topic, dds_type, ros_topic, ros_type};
use crate::network::{DiscoveredEndpoint, EndpointKind, EndpointSpec};
use crate::qos::{reader_for, weakest};

/// Messages of others that the owner's local writer keeps for reliable readers. Whoever writes waits for acknowledgements once
/// so many came at once, some 15 ms with Cyclone; and so many are held for a reader that stands still.
const PUBLISHERS_DEPTH: u32 = 100;

impl<R: RngCore> Routes<R> {
    /// Others than this node publish on one of its shares, or none any more.
    pub fn handle_publishers(&mut self, name: &Name, any: bool) {
        let Some(share) = self.shares.get_mut(name) else { return };
        if self.share_rules[share.rule].is_service() {
            return;
        }
        let spec = any.then(|| EndpointSpec {
            topic: dds_topic(&share.local_name),
            type_name: share.type_name.clone(),
            keyless: share.keyless,
            asks_key_hash: false,
            type_hash: share.writers.values().find_map(|w| w.type_hash.clone()),
            qos: self.share_rules[share.rule]
                .qos
                .apply(&Qos { history: History::KeepLast(PUBLISHERS_DEPTH), ..Qos::default() }),
        });
        if share.writer.is_some() == spec.is_some() {
            return;
        }
        self.commands.push_back(match &spec {
            Some(spec) => Command::OpenWriter { name: *name, source: None, spec: spec.clone() },
            None => Command::CloseWriter { name: *name, source: None },
        });
        share.writer = spec;
        self.check_later();
    }

    /// Begins the shares that are there for what others publish, whether anyone here does or not. Their type has to be
    /// given, since no local publisher shows it.
    pub(super) fn begin_inbound(&mut self) {
        for rule in 0..self.share_rules.len() {
            let share = &self.share_rules[rule];
            let Metadata { type_name, ros_name, .. } = &share.metadata;
            let known = self.shares.values().any(|s| s.rule == rule && ros_type(&s.type_name) == *type_name);
            if known || type_name.is_empty() || !share.is_inbound() || share.is_pattern() {
                continue;
            }
            let (topic, type_name) = (ros_name.clone(), dds_type(type_name));
            if let Some(problem) = self.begin_share(rule, &topic, type_name, true, None) {
                self.report(Cause::Inbound, problem);
            }
        }
    }

    /// What begins goes unshaped unless it is told otherwise.
    pub(super) fn shape(&mut self, name: Name, shaping: Shaping) {
        if shaping != Shaping::default() {
            self.commands.push_back(Command::Shape { name, shaping });
        }
    }

    /// Frames have no prefix unless it is told.
    pub(super) fn frames(&mut self, name: Name, prefix: Option<String>) {
        if prefix.is_some() {
            self.commands.push_back(Command::Frames { name, prefix });
        }
    }

    /// A local writer may be one whose messages another node's topic is for.
    pub(super) fn publisher_there(&mut self, writer: &DiscoveredEndpoint) {
        let names: Vec<_> =
            self.uses.iter().filter(|(_, u)| self.publishes(u.rule)).map(|(n, _)| *n).collect();
        for name in names {
            let Some(route) = self.uses.get_mut(&name) else { continue };
            if ros_topic(&writer.topic) == Some(route.local_name.as_str())
                && ros_type(&writer.type_name) == route.entry.metadata.type_name
            {
                route.local.insert(writer.guid, writer.clone());
                self.refresh_publisher(name);
            }
        }
    }

    pub(super) fn publisher_gone(&mut self, writer: &DiscoveredEndpoint) {
        let with = self.uses.iter().filter(|(_, u)| u.local.contains_key(&writer.guid));
        for name in with.map(|(n, _)| *n).collect::<Vec<_>>() {
            if let Some(route) = self.uses.get_mut(&name) {
                route.local.remove(&writer.guid);
                self.refresh_publisher(name);
            }
        }
    }

    /// Looks for the local writers of a route that just began.
    pub(super) fn find_publishers(&mut self) {
        for endpoint in self.endpoints.values().cloned().collect::<Vec<_>>() {
            if endpoint.kind == EndpointKind::Writer {
                self.publisher_there(&endpoint);
            }
        }
    }

    pub(super) fn publishes(&self, rule: usize) -> bool {
        self.use_rules[rule].direction == Direction::Publish
    }

    /// Brings the local reader of a route that publishes in line with its local writers.
    pub(super) fn refresh_publisher(&mut self, name: Name) {
        let Some(route) = self.uses.get_mut(&name).filter(|u| u.granted) else { return };
        if self.use_rules[route.rule].is_service() {
            return self.refresh_server(name);
        }
        let offer = weakest(route.local.values().map(|w| &w.qos));
        let metadata = &route.entry.metadata;
        let spec = offer.map(|offer| EndpointSpec {
            topic: dds_topic(&route.local_name),
            type_name: dds_type(&metadata.type_name),
            keyless: route.entry.keyless,
            asks_key_hash: asks_key_hash(route.entry.keyless, route.local.keys()),
            type_hash: route.entry.type_hash.clone(),
            qos: reader_for(&offer, route.local.len()),
        });
        if same_reader(route.reader.as_ref(), spec.as_ref()) {
            return;
        }
        if route.reader.is_some() {
            self.commands.push_back(Command::CloseReader { name });
        }
        if let Some(spec) = &spec {
            self.commands.push_back(Command::OpenReader { name, spec: spec.clone() });
        }
        route.reader = spec;
    }
}
