//! [`UseRoute`]: one used interface of another node.

use std::collections::BTreeMap;
use std::time::{Duration, Instant};

use sgc_endpoint::RefusedBy;
use sgc_wire::{CatalogueEntry, ENTRY_SOURCES_MAX, Liveliness, Name, Qos, RosNode, SourceId};

use super::command::Command;
use super::readers::{asks_key_hash, replace_reader};
use super::rules::{Direction, UseRule, UseRuleId};
use super::service_ends::service_spec;
use super::use_writers::UseWriters;
use crate::names::{dds_topic, dds_type, ros_topic, ros_type};
use crate::network::{DiscoveredEndpoint, EndpointSpec, Guid, ServiceSpec};
use crate::qos::{reader_for, weakest};

/// Time for which a local writer outlives the path to its owner, so that the far network stays in the local graph
/// when a router restarts.
pub const UNREACHABLE_HOLD: Duration = Duration::from_secs(10);

/// The server that local clients of a far service call.
#[derive(Debug)]
struct LocalServer {
    spec: ServiceSpec,
    /// The far node that the server was announced as part of.
    node: Option<RosNode>,
}

/// A use route.
#[derive(Debug)]
pub(super) struct UseRoute {
    name: Name,
    rule: UseRuleId,
    /// The name on the local network.
    local_name: String,
    entry: CatalogueEntry,
    is_granted: bool,
    /// `false` while the owner, whose node restarted, does not list the entry yet.
    is_listed: bool,
    refused: Option<RefusedBy>,
    writers: UseWriters,
    /// The local writers, if the route publishes.
    publishers: BTreeMap<Guid, DiscoveredEndpoint>,
    /// The reader of their messages.
    reader: Option<EndpointSpec>,
    /// Those that may assert their liveliness without a message.
    watched: Vec<(Guid, Qos)>,
    server: Option<LocalServer>,
    unreachable_until: Option<Instant>,
}

impl UseRoute {
    pub(super) fn new(name: Name, rule: UseRuleId, local_name: String, entry: CatalogueEntry) -> Self {
        Self {
            name,
            rule,
            local_name,
            entry,
            is_granted: false,
            is_listed: true,
            refused: None,
            writers: UseWriters::default(),
            publishers: BTreeMap::new(),
            reader: None,
            watched: Vec::new(),
            server: None,
            unreachable_until: None,
        }
    }

    pub(super) fn rule(&self) -> UseRuleId {
        self.rule
    }

    pub(super) fn local_name(&self) -> &str {
        &self.local_name
    }

    pub(super) fn entry(&self) -> &CatalogueEntry {
        &self.entry
    }

    pub(super) fn is_granted(&self) -> bool {
        self.is_granted
    }

    /// Returns `true` if the interface is granted, or was until a moment ago.
    pub(super) fn is_up(&self) -> bool {
        self.is_granted || self.unreachable_until.is_some()
    }

    /// Returns `false` while the owner, whose node restarted, does not list the entry yet.
    pub(super) fn is_listed(&self) -> bool {
        self.is_listed
    }

    pub(super) fn refused(&self) -> Option<RefusedBy> {
        self.refused
    }

    pub(super) fn writer_count(&self) -> usize {
        self.writers.len()
    }

    /// Iterates over the far sources that have a local writer of their own.
    pub(super) fn sources(&self) -> impl Iterator<Item = SourceId> {
        self.writers.sources()
    }

    /// Returns the number of local publishers, if the route publishes.
    pub(super) fn publisher_count(&self) -> usize {
        self.publishers.len()
    }

    /// Returns `true` if the local publishers are read.
    pub(super) fn is_read(&self) -> bool {
        self.reader.is_some()
    }

    /// Returns `true` if local clients can call the service.
    pub(super) fn is_served(&self) -> bool {
        self.server.is_some()
    }

    /// Handles the grant. The route has to be refreshed.
    pub(super) fn grant(&mut self) {
        self.is_granted = true;
        self.refused = None;
        self.unreachable_until = None;
    }

    /// Handles a refusal.
    pub(super) fn refuse(&mut self, by: RefusedBy) {
        self.refused = Some(by);
    }

    /// Handles the suspension of the grant. Local ends outlive it for [`UNREACHABLE_HOLD`].
    pub(super) fn hold(&mut self, now: Instant) {
        self.is_granted = false;
        if !self.writers.is_empty() || self.is_read() || self.is_served() {
            self.unreachable_until.get_or_insert(now + UNREACHABLE_HOLD);
        }
    }

    /// Suspends the route until its restarted owner lists the entry again.
    pub(super) fn unlist(&mut self) {
        self.is_granted = false;
        self.is_listed = false;
    }

    /// Handles an entry that is listed. Returns `true` if it was missing.
    pub(super) fn list(&mut self) -> bool {
        !std::mem::replace(&mut self.is_listed, true)
    }

    /// Replaces the catalogue entry. Returns `true` if it is another one. The route has to be refreshed.
    pub(super) fn set_entry(&mut self, entry: CatalogueEntry) -> bool {
        let is_news = self.entry != entry;
        self.entry = entry;
        is_news
    }

    /// Continues under another rule.
    pub(super) fn move_to(&mut self, rule: UseRuleId) {
        self.rule = rule;
    }

    /// Adds a local writer of the interface. Returns `true` if it is one, and the route has to be refreshed.
    pub(super) fn add_publisher(&mut self, writer: &DiscoveredEndpoint) -> bool {
        let is_of_it = ros_topic(&writer.topic) == Some(self.local_name())
            && ros_type(&writer.type_name) == self.entry.metadata.type_name;
        if is_of_it {
            self.publishers.insert(writer.guid, writer.clone());
        }
        is_of_it
    }

    /// Removes a local writer. Returns `true` if it was one of the route's, which has to be refreshed.
    pub(super) fn remove_publisher(&mut self, writer: &Guid) -> bool {
        self.publishers.remove(writer).is_some()
    }

    /// Updates the local ends to match the catalogue entry and the local publishers, once the interface is granted.
    /// While the owner settles, writers whose source is not listed stay open.
    pub(super) fn refresh(&mut self, rule: &UseRule, owner_settles: bool) -> Vec<Command> {
        match rule.direction {
            _ if !self.is_granted => Vec::new(),
            _ if rule.is_service() => self.refresh_server(rule),
            Direction::Publish => {
                let mut commands = self.refresh_reader();
                commands.extend(self.refresh_watched());
                commands
            }
            Direction::Bring => {
                let mut commands = self.writers.update(self.name, self.wanted_writers(rule), owner_settles);
                commands.extend(self.announce_nodes(rule));
                commands
            }
        }
    }

    /// Returns the writers for the catalogue entry: one for each listed publisher, with its QoS and history, and one
    /// for all others if there are any.
    fn wanted_writers(&self, rule: &UseRule) -> BTreeMap<Option<SourceId>, EndpointSpec> {
        let entry = &self.entry;
        let spec = |qos: &Qos| EndpointSpec {
            topic: dds_topic(&self.local_name),
            type_name: dds_type(&entry.metadata.type_name),
            keyless: entry.keyless,
            asks_key_hash: false,
            type_hash: entry.type_hash.clone(),
            qos: rule.qos.apply(qos),
        };
        // A writer without a valid lease is closed, so that subscribers that watch its liveliness notice at once.
        let alive = entry.sources.iter().filter(|listed| !listed.source.is_lapsed());
        let mut wanted: BTreeMap<_, _> =
            alive.map(|listed| (listed.source.told_apart(), spec(&listed.qos))).collect();
        if entry.sources.is_empty() || entry.sources.len() >= ENTRY_SOURCES_MAX {
            wanted.insert(None, spec(&entry.qos));
        }
        wanted
    }

    /// Updates the reader of the local publishers.
    fn refresh_reader(&mut self) -> Vec<Command> {
        let CatalogueEntry { metadata, keyless, type_hash, .. } = &self.entry;
        let offer = weakest(self.publishers.values().map(|writer| &writer.qos));
        let spec = offer.map(|offer| EndpointSpec {
            topic: dds_topic(&self.local_name),
            type_name: dds_type(&metadata.type_name),
            keyless: *keyless,
            asks_key_hash: asks_key_hash(*keyless, self.publishers.keys()),
            type_hash: type_hash.clone(),
            qos: reader_for(&offer, self.publishers.len()),
        });
        replace_reader(self.name, &mut self.reader, spec)
    }

    /// Updates the local publishers whose assertions of liveliness are passed on.
    fn refresh_watched(&mut self) -> Option<Command> {
        let of_all = self.publishers.values();
        let manual = of_all.filter(|writer| writer.qos.liveliness == Liveliness::ManualByTopic);
        let publishers: Vec<_> = manual.map(|writer| (writer.guid, writer.qos.clone())).collect();
        if publishers == self.watched {
            return None;
        }
        self.watched.clone_from(&publishers);
        Some(Command::WatchPublishers { name: self.name, publishers })
    }

    /// Updates the local server of a called service.
    fn refresh_server(&mut self, rule: &UseRule) -> Vec<Command> {
        let (name, type_hash) = (self.name, self.entry.type_hash.as_deref());
        let spec = service_spec(&self.local_name, &self.entry.metadata.type_name, type_hash);
        let mut commands = Vec::new();
        if self.server.as_ref().is_none_or(|server| server.spec != spec) {
            commands.extend(self.server.is_some().then_some(Command::CloseServer { name }));
            commands.push(Command::OpenServer { name, spec: spec.clone() });
            self.server = Some(LocalServer { spec, node: None });
        }
        commands.extend(self.announce_nodes(rule));
        commands
    }

    /// Announces the far nodes that the local writers or the server represent, where they changed.
    fn announce_nodes(&mut self, rule: &UseRule) -> Vec<Command> {
        let (name, owner) = (self.name, rule.owner);
        let mut commands = Vec::new();
        for (place, listed) in self.entry.sources.iter().enumerate() {
            // One local server represents all far ones, and is shown as part of the first one's node.
            let source = listed.source.told_apart().filter(|_| self.server.is_none());
            if source.is_none() && place > 0 {
                continue;
            }
            let node = listed.node.as_ref().map(|node| rule.local_node(node));
            let is_news = match &mut self.server {
                Some(server) => std::mem::replace(&mut server.node, node.clone()) != node,
                None => self.writers.set_node(source, node.as_ref()),
            };
            if is_news {
                commands.push(Command::SetNode { name, source, owner, node });
            }
        }
        commands
    }

    /// Closes the local ends if the owner has been out of reach for too long.
    pub(super) fn time_out(&mut self, now: Instant) -> Vec<Command> {
        match self.unreachable_until.take_if(|at| *at <= now) {
            Some(_) => self.close(),
            None => Vec::new(),
        }
    }

    /// Returns the time of the next [`Self::time_out`].
    pub(super) fn deadline(&self) -> Option<Instant> {
        self.unreachable_until
    }

    /// Closes the local ends.
    pub(super) fn close(&mut self) -> Vec<Command> {
        let name = self.name;
        let mut commands: Vec<_> = self.writers.close(name).collect();
        commands.extend(self.reader.take().map(|_| Command::CloseReader { name }));
        commands.extend(self.server.take().map(|_| Command::CloseServer { name }));
        if !std::mem::take(&mut self.watched).is_empty() {
            commands.push(Command::WatchPublishers { name, publishers: Vec::new() });
        }
        commands
    }
}
