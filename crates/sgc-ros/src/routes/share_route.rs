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

/// Shortest time between two changes of what other nodes announce of their publishers. Each may replace a writer.
pub const ANNOUNCED_EVERY: Duration = Duration::from_millis(500);

/// Bounds of the time for which a message shows that its publisher lives, though none was announced. Between them it is
/// the longest lease or deadline.
pub const HEARD_MIN: Duration = Duration::from_secs(1);
const HEARD_MAX: Duration = Duration::from_secs(10);

/// Depth of the owner's local writer for messages of others. Writers wait for acknowledgements, some 15 ms with
/// Cyclone, once this many arrive at once. As many are kept for a reader that stands still.
const PUBLISHERS_DEPTH: u32 = 100;

/// The remote publishers on a share, as their nodes announce them.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct AnnouncedPublishers {
    /// Their combined offer; `None` if none is announced.
    pub offer: Option<Qos>,
    /// `true` if one of them may be alive: an announced one whose lease has not run out, or one of a node that has
    /// announced nothing yet.
    pub may_live: bool,
}

/// The remote publishers on a share, as their nodes announced them and as they are heard.
#[derive(Debug, Default)]
struct Announced {
    /// The combined offer of the last ones that were announced.
    offer: Option<Qos>,
    /// `true` if all that were announced are gone.
    are_silent: bool,
    /// The time until which a publisher that was heard meanwhile counts as living.
    heard_until: Option<Instant>,
    /// An announcement that is not taken over yet.
    next: Option<AnnouncedPublishers>,
    /// The time of the last change.
    changed: Option<Instant>,
}

impl Announced {
    /// Takes over the last announcement, if the one before stood for a while. Returns `true` if it says something new.
    fn take_over(&mut self, now: Instant) -> bool {
        if self.changed.is_some_and(|at| now < at + ANNOUNCED_EVERY) {
            return false;
        }
        let Some(AnnouncedPublishers { offer, may_live }) = self.next.take() else { return false };
        let offer = offer.or_else(|| self.offer.clone());
        if (&offer, !may_live) == (&self.offer, self.are_silent) {
            return false;
        }
        (self.offer, self.are_silent) = (offer, !may_live);
        self.heard_until = None;
        self.changed = Some(now);
        true
    }

    /// Forgets what was said of publishers that have all left. Their offer stands for the next ones.
    fn begin_again(&mut self) {
        *self = Self { offer: self.offer.take(), changed: self.changed, ..Self::default() };
    }

    /// Returns `true` if no publisher lives, and subscribers may watch for that.
    fn are_gone(&self) -> bool {
        let is_watched = |offer: &Qos| offer.lease_ns.is_some() || offer.deadline_ns.is_some();
        self.are_silent && self.heard_until.is_none() && self.offer.as_ref().is_some_and(is_watched)
    }

    /// Returns the time for which one message shows a living publisher.
    fn span(&self) -> Duration {
        let offered =
            |ns: fn(&Qos) -> Option<u64>| self.offer.as_ref().and_then(ns).map(Duration::from_nanos);
        let longest = offered(|offer| offer.lease_ns).max(offered(|offer| offer.deadline_ns));
        longest.unwrap_or(HEARD_MIN).clamp(HEARD_MIN, HEARD_MAX)
    }

    /// Handles the passing of time. Returns `true` if something changed.
    fn time_out(&mut self, now: Instant) -> bool {
        let is_silent = self.heard_until.take_if(|at| *at <= now).is_some();
        self.take_over(now) || is_silent
    }

    /// Returns the times of the next [`Self::time_out`].
    fn deadlines(&self) -> [Option<Instant>; 2] {
        let next = self.next.as_ref().and(self.changed).map(|at| at + ANNOUNCED_EVERY);
        [self.heard_until, next]
    }
}

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
    /// Whether others publish on the share.
    has_publishers: bool,
    /// Those publishers, as their nodes announced them.
    announced: Announced,
    /// The writer for their messages.
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
            has_publishers: false,
            announced: Announced::default(),
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

    /// Returns the source of a writer of a topic.
    pub(super) fn source_of(&self, writer: &Guid) -> Option<SourceId> {
        self.own.source_of(writer)
    }

    /// Returns `true` if a writer that is here has the source.
    pub(super) fn has_writer_of(&self, source: &SourceId) -> bool {
        !self.writers.is_empty() && self.own.has_writer_of(source)
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

    /// Handles the arrival of the first other publisher, or the end of the last. Returns `None` if nothing changes.
    pub(super) fn set_publishers(&mut self, any: bool, rule: &ShareRule) -> Option<Command> {
        if std::mem::replace(&mut self.has_publishers, any) != any {
            self.announced.begin_again();
        }
        self.refresh_writer(rule)
    }

    /// Handles what the nodes of the others say of their publishers.
    pub(super) fn set_announced(
        &mut self,
        now: Instant,
        publishers: AnnouncedPublishers,
        rule: &ShareRule,
    ) -> Option<Command> {
        self.announced.next = Some(publishers);
        self.announced.take_over(now);
        self.refresh_writer(rule)
    }

    /// Handles that one of the others published at this time, whatever their nodes say.
    pub(super) fn hear_publisher(&mut self, at: Instant, rule: &ShareRule) -> Option<Command> {
        self.announced.heard_until = Some(at + self.announced.span());
        self.refresh_writer(rule)
    }

    /// Returns the time within which a message must have come for the writer to stay open, if that is due.
    pub(super) fn doubts_writer(&self, now: Instant) -> Option<Duration> {
        self.announced.heard_until.filter(|at| *at <= now).map(|_| self.announced.span())
    }

    /// Opens, replaces or closes the local writer for messages of others. A new writer takes the place of the old one,
    /// so no message is without a writer meanwhile.
    pub(super) fn refresh_writer(&mut self, rule: &ShareRule) -> Option<Command> {
        let wanted = self.wanted_writer(rule);
        if self.writer == wanted {
            return None;
        }
        self.writer = wanted;
        let (name, source) = (self.name, None);
        Some(match &self.writer {
            Some(spec) => Command::OpenWriter { name, source, spec: spec.clone() },
            None => Command::CloseWriter { name, source },
        })
    }

    /// Returns the writer for messages of others: with ROS 2's default QoS, and the deadline, lifespan and liveliness
    /// that they announced. There is none while all of them are known to be gone, if subscribers may watch for that, except
    /// for the stop message of a dead-man switch.
    fn wanted_writer(&self, rule: &ShareRule) -> Option<EndpointSpec> {
        let are_gone = !self.has_publishers || self.announced.are_gone();
        if rule.is_service() || (are_gone && rule.dead_man.is_none()) {
            return None;
        }
        let mut qos = Qos { history: History::KeepLast(PUBLISHERS_DEPTH), ..Qos::default() };
        if let Some(offer) = self.announced.offer.as_ref().filter(|_| !are_gone) {
            qos.deadline_ns = offer.deadline_ns;
            qos.lifespan_ns = offer.lifespan_ns;
            qos.liveliness = offer.liveliness;
            qos.lease_ns = offer.lease_ns;
        }
        let type_hash = match &self.writer {
            Some(open) => open.type_hash.clone(),
            None => self.type_hash().map(str::to_owned),
        };
        Some(EndpointSpec {
            topic: dds_topic(&self.local_name),
            type_name: self.type_name.clone(),
            keyless: self.keyless,
            asks_key_hash: false,
            type_hash,
            qos: rule.qos.apply(&qos),
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
            // ROS 2's default serves commands well.
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
            false => {
                commands.extend(self.refresh_reader(offer));
                commands.extend(self.refresh_writer(rule));
            }
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
        match self.own.time_out(now) | self.announced.time_out(now) || sinkless {
            true => ShareTimeout::Changed,
            false => ShareTimeout::Unchanged,
        }
    }

    /// Returns the time of the next [`Self::time_out`].
    pub(super) fn deadline(&self) -> Option<Instant> {
        let own = [self.writerless_until(), self.sinkless_until, self.own.deadline()];
        own.into_iter().chain(self.announced.deadlines()).flatten().min()
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
