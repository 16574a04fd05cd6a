//! Publishing: local publishers on names of other nodes, and remote publishers on shares of this node.
//!
//! A use route whose rule publishes carries local messages to the owner, while the owner permits it. A share route on
//! which others may publish has a local writer while at least one of them is present.

use rand_core::RngCore;
use sgc_wire::{Metadata, Name};

use super::command::Command;
use super::machine::Routes;
use super::problem::Cause;
use super::readers::{asks_key_hash, same_reader};
use super::rules::{Direction, Shaping, ShareRuleId, UseRuleId};
use crate::names::{dds_topic, dds_type, ros_topic, ros_type};
use crate::network::{DiscoveredEndpoint, EndpointKind, EndpointSpec};
use crate::qos::{reader_for, weakest};

impl<R: RngCore> Routes<R> {
    /// Handles the arrival of the first other publisher on a share, or the end of the last.
    pub fn handle_publishers(&mut self, name: &Name, any: bool) {
        let Some(share) = self.shares.get_mut(name) else { return };
        if let Some(command) = share.set_publishers(any, &self.share_rules[share.rule()]) {
            self.commands.push_back(command);
            self.check_later();
        }
    }

    /// Begins the shares that exist for messages of others. Their rules must give the type, because no local
    /// publisher shows it.
    pub(super) fn begin_inbound(&mut self) {
        for rule in self.share_rules.with_ids().map(|(rule, _)| rule).collect::<Vec<ShareRuleId>>() {
            let share = &self.share_rules[rule];
            let Metadata { type_name, ros_name, .. } = &share.metadata;
            let known = self.shares.values().any(|s| s.rule() == rule && s.type_name() == *type_name);
            if known || type_name.is_empty() || !share.is_inbound() || share.is_pattern() {
                continue;
            }
            let (topic, type_name) = (ros_name.clone(), dds_type(type_name));
            if let Some(problem) = self.begin_share(rule, &topic, type_name, true, None) {
                self.report(Cause::Inbound, problem);
            }
        }
    }

    /// Shapes a name. A new name has no limits, so the default needs no command.
    pub(super) fn shape(&mut self, name: Name, shaping: Shaping) {
        if shaping != Shaping::default() {
            self.commands.push_back(Command::Shape { name, shaping });
        }
    }

    /// Sets the prefix of frames. A new name has none, so `None` needs no command.
    pub(super) fn frames(&mut self, name: Name, prefix: Option<String>) {
        if prefix.is_some() {
            self.commands.push_back(Command::Frames { name, prefix });
        }
    }

    /// Adds a local writer to the routes that publish its topic elsewhere.
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

    /// Adds the existing local writers to routes that have just begun.
    pub(super) fn find_publishers(&mut self) {
        for endpoint in self.local.endpoints().cloned().collect::<Vec<_>>() {
            if endpoint.kind == EndpointKind::Writer {
                self.publisher_there(&endpoint);
            }
        }
    }

    pub(super) fn publishes(&self, rule: UseRuleId) -> bool {
        self.use_rules[rule].direction == Direction::Publish
    }

    /// Updates the local reader of a publishing route to match its local writers.
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
