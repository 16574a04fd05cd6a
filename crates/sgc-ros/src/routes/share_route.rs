//! [`ShareRoute`]: one shared interface with one type.

use std::collections::{BTreeMap, BTreeSet};
use std::time::{Duration, Instant};

use rand_core::RngCore;
use sgc_endpoint::ShareSpec;
use sgc_trust::FleetSecret;
use sgc_wire::{CatalogueSource, Consumer, ENTRY_SOURCES_MAX, History, Name, Qos, Role, SinkId, SourceId};

use super::command::Command;
use super::local_graph::LocalGraph;
use super::own_sources::{Hold, OwnSources};
use super::problem::Problem;
use super::readers::{asks_key_hash, replace_reader};
use super::rules::{ShareRule, ShareRuleId};
use super::service_ends::service_spec;
use crate::names::{dds_topic, ros_type};
use crate::network::{DiscoveredEndpoint, EndpointKind, EndpointSpec, Guid, ServiceSpec};
use crate::qos::{for_all_instances, reader_for, service_qos, weakest};

/// Time for which a local reader outlives its last remote sink, so that a router restart costs no sample.
pub const SINKLESS_HOLD: Duration = Duration::from_secs(10);

/// Longest time for which a share outlives its last writer while messages of that wait: 64 MiB pass a megabit a second.
const WRITERLESS_BUSY_MAX: Duration = Duration::from_secs(600);

/// Longest time for which a source outlives its writer while messages wait, if there are others, which may never pause.
const GONE_BUSY_MAX: Duration = Duration::from_secs(60);

/// Depth of the owner's local writer for messages of others. Writers wait for acknowledgements, some 15 ms with
/// Cyclone, once this many arrive at once. As many are kept for a reader that stands still.
const PUBLISHERS_DEPTH: u32 = 100;

/// A share route.
#[derive(Debug)]
pub(super) struct ShareRoute {
    name: Name,
    rule: ShareRuleId,
    /// The name on the local network.
    local_name: String,
    type_name: String,
    keyless: bool,
    writers: BTreeMap<Guid, DiscoveredEndpoint>,
    own: OwnSources,
    sinks: BTreeSet<SinkId>,
    reader: Option<EndpointSpec>,
    /// The writer for messages that others publish on the share.
    writer: Option<EndpointSpec>,
    /// The client that calls local servers, if it is a service. The servers are the route's writers.
    client: Option<ServiceSpec>,
    /// The hold of a share without a writer.
    writerless: Option<Hold>,
    sinkless_until: Option<Instant>,
}

/// The commands and problems of a share that was updated.
#[derive(Debug)]
pub(super) struct ShareUpdate {
    pub(super) commands: Vec<Command>,
    pub(super) problems: BTreeSet<Problem>,
}

/// The effect of a writer's removal on its share.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum WriterRemoval {
    /// The share has other writers or needs none. It has to be refreshed.
    Changed,
    /// The writer was the last one. The offer stands until the hold ends.
    Held,
}

/// The effect of the passing of time on a share.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum ShareTimeout {
    /// The share ends.
    Ends,
    /// The share has to be refreshed.
    Changed,
    /// The share stays as it is.
    Unchanged,
}

impl ShareRoute {
    /// Creates a share with a first writer, or without one.
    pub(super) fn begin(
        name: Name,
        rule: ShareRuleId,
        share: &ShareRule,
        local_name: &str,
        type_name: &str,
        keyless: bool,
        writer: Option<DiscoveredEndpoint>,
    ) -> (ShareSpec, Self) {
        let spec = ShareSpec {
            metadata: share.metadata_of(local_name, &ros_type(type_name)),
            policy: share.policy.clone(),
            suite: share.suite,
            class: share.class,
            keyless,
            type_hash: writer.as_ref().and_then(|w| w.type_hash.clone()),
            qos: writer.as_ref().map(|w| share.qos.apply(&w.qos)).unwrap_or_default(),
            sources: Vec::new(),
        };
        let route = Self {
            name,
            rule,
            local_name: local_name.to_owned(),
            type_name: type_name.to_owned(),
            keyless,
            own: OwnSources::default(),
            writers: writer.into_iter().map(|w| (w.guid, w)).collect(),
            sinks: BTreeSet::new(),
            reader: None,
            writer: None,
            client: None,
            writerless: None,
            sinkless_until: None,
        };
        (spec, route)
    }

    pub(super) fn name(&self) -> Name {
        self.name
    }

    pub(super) fn rule(&self) -> ShareRuleId {
        self.rule
    }

    pub(super) fn local_name(&self) -> &str {
        &self.local_name
    }

    /// Returns the ROS type.
    pub(super) fn type_name(&self) -> String {
        ros_type(&self.type_name)
    }

    /// Returns `true` if writers of this topic and DDS type belong to the route.
    pub(super) fn fits(&self, local_name: &str, type_name: &str) -> bool {
        self.local_name == local_name && self.type_name == type_name
    }

    /// Iterates over the local writers, or over the servers of a service.
    pub(super) fn writers(&self) -> impl ExactSizeIterator<Item = &Guid> {
        self.writers.keys()
    }

    pub(super) fn has_writer(&self, writer: &Guid) -> bool {
        self.writers.contains_key(writer)
    }

    /// Returns `true` if one of these endpoints is or was a writer of the share.
    pub(super) fn concerns(&self, endpoints: &BTreeSet<Guid>) -> bool {
        self.own.writers().chain(self.writers.keys()).any(|guid| endpoints.contains(guid))
    }

    /// Returns the combined offer of the local writers.
    pub(super) fn offer(&self) -> Option<Qos> {
        weakest(self.writers.values().map(|w| &w.qos))
    }

    pub(super) fn sink_count(&self) -> usize {
        self.sinks.len()
    }

    /// Returns `true` if the local writers are read.
    pub(super) fn is_read(&self) -> bool {
        self.reader.is_some()
    }

    /// Returns `true` if messages of others are written here; for a service, if others can call it.
    pub(super) fn is_written(&self) -> bool {
        self.writer.is_some() || self.client.is_some()
    }

    /// Returns the writer for messages that others publish on the share.
    pub(super) fn inbound_writer(&self) -> Option<&EndpointSpec> {
        self.writer.as_ref()
    }

    /// Adds a local writer. A share that waits for one goes on.
    pub(super) fn add_writer(&mut self, writer: DiscoveredEndpoint) {
        self.writers.insert(writer.guid, writer);
        self.writerless = None;
    }

    /// Removes a local writer. Returns `None` if it is not one of this share.
    pub(super) fn remove_writer(
        &mut self,
        now: Instant,
        writer: &Guid,
        rule: &ShareRule,
    ) -> Option<WriterRemoval> {
        self.writers.remove(writer)?;
        self.own.writer_gone(now, writer, self.writers.is_empty());
        // The offer stands until the hold ends, so that a restarted program finds the share unchanged. A share for
        // messages of others needs no writer.
        if !self.writers.is_empty() || rule.is_inbound() {
            return Some(WriterRemoval::Changed);
        }
        self.writerless = Some(Hold::begin(now));
        Some(WriterRemoval::Held)
    }

    /// Handles the expiry of a writer's lease, or its renewal. Returns `true` if the share has to be refreshed.
    pub(super) fn set_alive(&mut self, writer: &Guid, is_alive: bool) -> bool {
        self.own.set_alive(writer, is_alive)
    }

    /// Sets the history of a writer. Returns `true` if the share has to be refreshed.
    pub(super) fn set_history(&mut self, writer: &Guid, history: History) -> bool {
        let writer = self.writers.get_mut(writer);
        writer.map(|writer| writer.qos.history = history).is_some()
    }

    /// Adds a remote sink. The share has to be refreshed.
    pub(super) fn add_sink(&mut self, sink: SinkId) {
        self.sinks.insert(sink);
    }

    /// Removes a remote sink. The reader outlives the last one for a while.
    pub(super) fn remove_sink(&mut self, now: Instant, sink: &SinkId) {
        if self.sinks.remove(sink) && self.sinks.is_empty() {
            self.sinkless_until = Some(now + SINKLESS_HOLD);
        }
    }

    /// Continues under another rule, which may require a local writer where the former one did not.
    pub(super) fn move_to(&mut self, now: Instant, place: ShareRuleId, rule: &ShareRule) {
        self.rule = place;
        if self.writers.is_empty() && !rule.is_inbound() {
            self.writerless.get_or_insert(Hold::over(now));
        }
    }

    /// Opens the local writer for messages of others, or closes it. Returns `None` if nothing changes.
    pub(super) fn set_publishers(&mut self, any: bool, rule: &ShareRule) -> Option<Command> {
        if rule.is_service() || self.writer.is_some() == any {
            return None;
        }
        self.writer = any.then(|| EndpointSpec {
            topic: dds_topic(&self.local_name),
            type_name: self.type_name.clone(),
            keyless: self.keyless,
            asks_key_hash: false,
            type_hash: self.type_hash().map(str::to_owned),
            qos: rule.qos.apply(&Qos { history: History::KeepLast(PUBLISHERS_DEPTH), ..Qos::default() }),
        });
        let (name, source) = (self.name, None);
        Some(match &self.writer {
            Some(spec) => Command::OpenWriter { name, source, spec: spec.clone() },
            None => Command::CloseWriter { name, source },
        })
    }

    /// Updates catalogue entry, sources and local ends of the share to match its writers and sinks. Returns `None` if
    /// it waits for a writer.
    pub(super) fn refresh(
        &mut self,
        rule: &ShareRule,
        local: &LocalGraph,
        secret: &FleetSecret,
        rng: &mut impl RngCore,
    ) -> Option<ShareUpdate> {
        let offers: Vec<_> = self.writers.values().map(|w| rule.qos.apply(&w.qos)).collect();
        let offer = match weakest(&offers) {
            Some(offer) => offer,
            None if !rule.is_inbound() => return None,
            // The offers of remote publishers are unknown here. ROS 2's default serves commands well.
            None => Qos::default(),
        };
        let mut problems = self.assign_sources(rule, &offer, secret, rng);
        let (name, class) = (self.name, rule.class);
        let key = |qos: &Qos| (qos.reliability, qos.durability, qos.representations);
        if offers.iter().any(|qos| key(qos) != key(&offer)) {
            let topic = self.local_name.clone();
            problems.insert(Problem::MixedQos { topic, offered: describe(&offer) });
        }
        problems.extend(self.hashes_differ());
        let sources = match rule.is_service() {
            true => self.listed_servers(local, secret),
            false => self.own.listed(local),
        };
        let kept = |qos: Qos| match self.keyless {
            true => qos,
            false => Qos { history: for_all_instances(qos.history), ..qos },
        };
        let own = self.own.mapping().map(|(writer, source, qos)| (writer, source, kept(qos))).collect();
        let mut commands = vec![
            Command::UpdateShare { name, qos: offer.clone(), sources },
            Command::MapSources { name, class, own },
        ];
        if !self.sinks.is_empty() {
            self.sinkless_until = None;
        }
        match rule.is_service() {
            true => commands.extend(self.refresh_client()),
            false => commands.extend(self.refresh_reader(offer)),
        }
        Some(ShareUpdate { commands, problems })
    }

    /// Assigns a source to each local writer and returns the problems with that.
    fn assign_sources(
        &mut self,
        rule: &ShareRule,
        offer: &Qos,
        secret: &FleetSecret,
        rng: &mut impl RngCore,
    ) -> BTreeSet<Problem> {
        if offer.is_transient_local() {
            self.own.forget_gone();
        }
        let mut problems = BTreeSet::new();
        // All servers answer under one source.
        for (guid, writer) in self.writers.iter().filter(|_| !rule.is_service()) {
            let new = || source_of(secret, guid, rng);
            if !self.own.assign(guid, &rule.qos.apply(&writer.qos), offer, new) {
                problems.insert(Problem::TooManySources { topic: self.local_name.clone() });
            }
        }
        problems
    }

    /// Opens, replaces or closes the reader of the local writers.
    fn refresh_reader(&mut self, offer: Qos) -> Vec<Command> {
        // Messages of writers that are gone may wait at the reader, which ends with their sources.
        if self.writers.is_empty() && self.own.writers().next().is_some() {
            return Vec::new();
        }
        // The reader requests no more than the writers offer. The rule's policies are offered elsewhere.
        let found = self.offer();
        // A transient-local topic is read from the start, because late joiners are promised its history.
        let wanted = (offer.is_transient_local() || self.has_sinks()) && !self.writers.is_empty();
        let read = Qos {
            reliability: found.as_ref().map_or(offer.reliability, |found| found.reliability),
            durability: found
                .as_ref()
                .map_or(offer.durability, |found| found.durability.min(offer.durability)),
            ..offer
        };
        let spec = wanted.then(|| EndpointSpec {
            topic: dds_topic(&self.local_name),
            type_name: self.type_name.clone(),
            keyless: self.keyless,
            asks_key_hash: asks_key_hash(self.keyless, self.writers.keys()),
            type_hash: self.type_hash().map(str::to_owned),
            qos: reader_for(&read, self.writers.len()),
        });
        replace_reader(self.name, &mut self.reader, spec)
    }

    /// Opens the local client of a shared service for its callers, or closes it.
    fn refresh_client(&mut self) -> Option<Command> {
        let wanted = self.has_sinks();
        if self.client.is_some() == wanted {
            return None;
        }
        let name = self.name;
        self.client = wanted.then(|| service_spec(&self.local_name, &self.type_name(), self.type_hash()));
        Some(match &self.client {
            Some(spec) => Command::OpenClient { name, spec: spec.clone() },
            None => Command::CloseClient { name },
        })
    }

    /// Returns `true` if the share has sinks, or had some a moment ago.
    fn has_sinks(&self) -> bool {
        !self.sinks.is_empty() || self.sinkless_until.is_some()
    }

    fn type_hash(&self) -> Option<&str> {
        self.writers.values().find_map(|w| w.type_hash.as_deref())
    }

    /// Returns a problem if two local publishers have different definitions of the type.
    fn hashes_differ(&self) -> Option<Problem> {
        let mut hashes = self.writers.values().filter_map(|writer| writer.type_hash.as_ref());
        let one = hashes.next()?;
        let other = hashes.find(|hash| *hash != one)?;
        let (mut first, mut second) = (one.clone(), other.clone());
        // The order does not depend on which publisher came first.
        if first > second {
            std::mem::swap(&mut first, &mut second);
        }
        let (topic, type_name) = (self.local_name.clone(), self.type_name());
        Some(Problem::ShareHash { topic, type_name, first, second })
    }

    /// Returns the nodes of the servers, each under an id that no message uses.
    fn listed_servers(&self, local: &LocalGraph, secret: &FleetSecret) -> Vec<CatalogueSource> {
        let server = |guid: &Guid| CatalogueSource {
            source: SourceId::from_publisher(secret.publisher_tag(&guid.0), [0; 8]),
            qos: service_qos(),
            node: local.node_of(guid).cloned(),
        };
        self.writers.keys().take(ENTRY_SOURCES_MAX).map(server).collect()
    }

    /// Returns `true` if writers have been gone for a while: unless messages of theirs still wait, they are forgotten.
    pub(super) fn outlives_writers(&self, now: Instant) -> bool {
        [self.writerless_until(), self.own.deadline()].into_iter().flatten().any(|at| at <= now)
    }

    /// Starts the holds of writers that are gone once more, because messages of the share wait to be sent. Has no
    /// effect once they have been gone for too long.
    pub(super) fn hold_on(&mut self, now: Instant) {
        let max = if self.writerless.is_some() { WRITERLESS_BUSY_MAX } else { GONE_BUSY_MAX };
        self.writerless.iter_mut().for_each(|hold| hold.go_on(now, max));
        self.own.hold_on(now, max);
    }

    fn writerless_until(&self) -> Option<Instant> {
        self.writerless.as_ref().map(Hold::until)
    }

    /// Handles the passing of time: ends a share whose last writer has been gone for a while, and forgets sources and
    /// sinks that are gone.
    pub(super) fn time_out(&mut self, now: Instant) -> ShareTimeout {
        if self.writerless_until().is_some_and(|at| at <= now) {
            return ShareTimeout::Ends;
        }
        let sinkless = self.sinkless_until.take_if(|at| *at <= now).is_some();
        match self.own.time_out(now) || sinkless {
            true => ShareTimeout::Changed,
            false => ShareTimeout::Unchanged,
        }
    }

    /// Returns the time of the next [`Self::time_out`].
    pub(super) fn deadline(&self) -> Option<Instant> {
        [self.writerless_until(), self.sinkless_until, self.own.deadline()].into_iter().flatten().min()
    }

    /// Ends the share.
    pub(super) fn close(self) -> impl Iterator<Item = Command> {
        let name = self.name;
        let reader = self.reader.map(|_| Command::CloseReader { name });
        let writer = self.writer.map(|_| Command::CloseWriter { name, source: None });
        let client = self.client.map(|_| Command::CloseClient { name });
        [reader, writer, client, Some(Command::Unshare { name })].into_iter().flatten()
    }

    /// Returns the endpoints that represent a remote consumer: a reader, a writer, or both ends of a service client.
    /// The list is empty for a publisher without the writer for messages of others.
    pub(super) fn consumer_ends(
        &self,
        rule: &ShareRule,
        consumer: &Consumer,
    ) -> Vec<(EndpointKind, EndpointSpec)> {
        // The hash goes into a text of `key=value;` elements.
        let is_plain = |hash: &&String| hash.bytes().all(|byte| byte.is_ascii_alphanumeric() || byte == b'_');
        let type_hash = consumer.type_hash.as_ref().filter(is_plain);
        if rule.is_service() {
            let spec = service_spec(&self.local_name, &self.type_name(), type_hash.map(String::as_str));
            return vec![(EndpointKind::Writer, spec.request), (EndpointKind::Reader, spec.reply)];
        }
        if consumer.role == Role::Publish {
            // The consumer's messages come from that writer with its QoS.
            let spec =
                |writer: &EndpointSpec| EndpointSpec { type_hash: type_hash.cloned(), ..writer.clone() };
            return self.writer.iter().map(|writer| (EndpointKind::Writer, spec(writer))).collect();
        }
        let spec = EndpointSpec {
            topic: dds_topic(&self.local_name),
            type_name: self.type_name.clone(),
            keyless: self.keyless,
            asks_key_hash: false,
            type_hash: type_hash.cloned(),
            qos: Qos { history: History::KeepLast(1), partitions: Vec::new(), ..consumer.qos.clone() },
        };
        vec![(EndpointKind::Reader, spec)]
    }
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
