//! The other way: local publishers on a name that another node owns, and remote publishers on one of ours.
//!
//! A use route whose rule says so does not bring a topic here but takes local messages there, while its owner lets
//! this node publish. A share route on which others may publish has a local writer while any of them is there.

use rand_core::RngCore;
use sgc_trust::derive_name;
use sgc_wire::{Metadata, Name, Qos};

use super::{Command, Direction, Routes, ShareRoute, same_reader};
use crate::names::{dds_topic, dds_type, ros_topic, ros_type};
use crate::network::{DiscoveredEndpoint, EndpointKind, EndpointSpec};
use crate::qos::{reader_for, weakest};

impl<R: RngCore> Routes<R> {
    /// Others than this node publish on one of its shares, or none any more.
    pub fn handle_publishers(&mut self, name: &Name, any: bool) {
        let Some(share) = self.shares.get_mut(name) else { return };
        let spec = any.then(|| EndpointSpec {
            topic: dds_topic(&self.share_rules[share.rule].metadata.ros_name),
            type_name: share.type_name.clone(),
            keyless: share.keyless,
            type_hash: share.writers.values().find_map(|w| w.type_hash.clone()),
            qos: Qos::default(),
        });
        if share.writer.is_some() == spec.is_some() {
            return;
        }
        self.commands.push_back(match &spec {
            Some(spec) => Command::OpenWriter { name: *name, source: None, spec: spec.clone() },
            None => Command::CloseWriter { name: *name, source: None },
        });
        share.writer = spec;
    }

    /// Begins the shares that are there for what others publish, whether anyone here does or not. Their type has to be
    /// given, since no local publisher shows it.
    pub(super) fn begin_inbound(&mut self) {
        for (rule, share) in self.share_rules.iter().enumerate() {
            let Metadata { type_name, .. } = &share.metadata;
            let known = self.shares.values().any(|s| s.rule == rule && ros_type(&s.type_name) == *type_name);
            if known || type_name.is_empty() || share.policy.publish.is_empty() {
                continue;
            }
            let name = derive_name(&self.secret, &self.node, &share.metadata);
            let (spec, route) = ShareRoute::begin(name, rule, share, &dds_type(type_name), true, None);
            self.shares.insert(name, route);
            self.commands.push_back(Command::Share(spec));
            self.refresh_share(name);
            return self.begin_inbound();
        }
    }

    /// A local writer may be one whose messages another node's topic is for.
    pub(super) fn publisher_there(&mut self, writer: &DiscoveredEndpoint) {
        let names: Vec<_> =
            self.uses.iter().filter(|(_, u)| self.publishes(u.rule)).map(|(n, _)| *n).collect();
        for name in names {
            let Some(route) = self.uses.get_mut(&name) else { continue };
            let metadata = &route.entry.metadata;
            if ros_topic(&writer.topic) == Some(&metadata.ros_name)
                && ros_type(&writer.type_name) == metadata.type_name
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
        let offer = weakest(route.local.values().map(|w| &w.qos));
        let metadata = &route.entry.metadata;
        let spec = offer.map(|offer| EndpointSpec {
            topic: dds_topic(&metadata.ros_name),
            type_name: dds_type(&metadata.type_name),
            keyless: route.entry.keyless,
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
