//! Carries out the outputs of the route machine: shares, joins, readers, writers, and forwarding.

use std::collections::BTreeMap;
use std::sync::Arc;
use std::time::{Duration, Instant};

use sgc_endpoint::{JoinKind, RecoveryLimits, ShareSpec, Source, SourceConfig};
use sgc_ros::{Command, EndpointSpec, Guid, RosNetwork, Shaping, TF_MESSAGE, service_qos};
use sgc_router::{FibEntry, LinkId};
use sgc_wire::{Class, History, Kind, Name, Now, Qos, SourceId};
use tracing::{debug, error};

use super::{Core, HISTORY_BYTES_MAX, HISTORY_KEEP_ALL_MAX, KEYED_INSTANCES_KEPT, drop_elsewhere};
use crate::clock::now;
use crate::control::event::CoreEvent;
use crate::control::parts::network_ends::OpenEnd;
use crate::control::parts::publishers::Offer;
use crate::control::parts::sinks::HistoryRequest;
use crate::data::dataplane::{Forward, Out};
use crate::data::outflow::OUTFLOW_AGE_MAX;
use crate::data::sending::assertions;
use crate::data::sending::intake::Publisher;
use crate::data::sending::manual_lease::ManualLease;
use crate::data::sending::share::LocalShare;
use crate::data::sending::source_map::{SourceMap, SourceSlot};
use crate::data::writer_queue::WriterQueue;
use crate::drops::NodeDrop;

/// Least bytes of recovery kept for one of a topic's many publishers.
const RECOVERY_BYTES_MIN: usize = 1 << 20;

impl<N: RosNetwork> Core<N> {
    /// Carries out a command of the route machine.
    pub(super) fn carry_out(&mut self, command: Command) {
        let now = now();
        match command {
            Command::Share(spec) => self.share(now, spec),
            Command::Shape { name, shaping } => self.shape(name, shaping),
            Command::Frames { name, prefix } => {
                if let Some(sink) = self.sinks.get(&name) {
                    sink.set_frames(prefix);
                }
            }
            Command::DeadMan { name, rule } => {
                let sink = match self.shares.get(&name) {
                    // Messages of others on our own share come to a sink of ours.
                    Some(_) => Some(self.sinks.get_or_add_own(name)),
                    None => self.sinks.get(&name).cloned(),
                };
                if let Some(sink) = sink {
                    sink.set_dead_man(rule);
                }
            }
            Command::UpdateShare { name, qos, sources } => {
                self.endpoint.update_share(now, &name, qos, sources)
            }
            Command::Unshare { name } => self.unshare(now, name),
            Command::MapSources { name, class, own } => self.map_sources(name, class, own),
            Command::CloseSource { name, source } => self.close_source(now.instant, name, source),
            Command::OpenReader { name, spec } => self.open_reader(name, spec),
            Command::CloseReader { name } => self.close_reader(&name),
            Command::UpdatePolicy { name, policy } => self.endpoint.update_policy(now, &name, policy),
            Command::Follow { owner_name } => {
                self.endpoint.follow(now, &owner_name);
            }
            Command::Unfollow { owner } => self.endpoint.unfollow(now, &owner),
            Command::Join { name, owner, transient_local, describe } => {
                self.sinks.add(name, transient_local);
                self.endpoint.join(now, name, owner, JoinKind::Subscribe { describe });
            }
            Command::JoinAgain { name, owner } => {
                self.endpoint.leave(now, &name);
                self.endpoint.join(now, name, owner, JoinKind::Subscribe { describe: false });
            }
            Command::Publish { name, owner, suite, class, reliable } => {
                self.publish_under(
                    name,
                    Offer { owner, suite, class, reliable, shaping: Shaping::default(), calls: false },
                );
            }
            Command::WatchPublishers { name, publishers } => self.watch_publishers(name, publishers),
            Command::Call { name, owner, suite, class } => {
                let shaping = Shaping::default();
                self.publish_under(name, Offer { owner, suite, class, reliable: true, shaping, calls: true });
            }
            Command::OpenClient { name, spec } => self.open_client(name, spec),
            Command::CloseClient { name } => self.close_client(&name),
            Command::ServersGone { name } => {
                if let Some(served) = self.services.local(&name) {
                    served.servers_gone();
                }
            }
            Command::OpenServer { name, spec } => self.open_server(name, spec),
            Command::CloseServer { name } => self.close_service_end(&name),
            Command::Leave { name } => self.leave(now, name),
            Command::OpenWriter { name, source, spec } => {
                self.note_inbound_writer(now, &name, source);
                self.open_writer(name, source, spec);
            }
            Command::CloseWriter { name, source } => {
                self.note_inbound_writer(now, &name, source);
                self.close_writer(name, source);
            }
            Command::ResizeWriter { name, source, spec } => self.resize_writer(name, source, spec),
            Command::MoveWriter { name, from, to } => self.move_writer(name, from, to),
            Command::SetNode { name, source, owner, node } => {
                self.graph.set_node((name, source), owner, node)
            }
            Command::Report(problem) => self.problem_log.note(now.instant, &problem),
        }
    }

    fn share(&mut self, now: Now, spec: ShareSpec) {
        let topic = spec.metadata.ros_name.clone();
        let (metadata, type_hash) = (spec.metadata.clone(), spec.type_hash.clone());
        let is_service = spec.metadata.kind == Kind::Service;
        match self.endpoint.share(now, spec) {
            Ok(name) => {
                debug!(%topic, %name, "shared");
                self.shares.add(name);
                self.need_type(name, &metadata, type_hash, None);
                if is_service {
                    self.begin_local(name);
                }
            }
            Err(why) => error!("{topic} is not shared: {why}"),
        }
    }

    fn shape(&mut self, name: Name, shaping: Shaping) {
        if let Some(share) = self.shares.get(&name) {
            let ages_as_before = share.shaping().max_age == shaping.max_age;
            share.set_shaping(shaping);
            if !ages_as_before {
                self.begin_flows_anew(name);
            }
        }
        self.publishers.set_shaping(&name, shaping);
        // Messages of other publishers on our share are shaped by those publishers.
        if let Some(sink) = self.sinks.get(&name).filter(|_| self.shares.get(&name).is_none()) {
            sink.set_shaping(shaping);
            if let Some(owner) = self.endpoint.owner_of(&name) {
                self.wishes.set_own(name, owner, &shaping);
            }
        }
    }

    fn unshare(&mut self, now: Now, name: Name) {
        self.endpoint.unshare(now, &name);
        self.consumers.show_soon(now.instant);
        self.forget_type(&name);
        self.shares.remove(&name);
        self.closings.retain(&name, |_| false);
        self.end_calls(&name);
        self.sinks.remove(&name);
    }

    /// Asks the sinks of a source whose publisher is gone to confirm its last message.
    fn close_source(&mut self, now: Instant, name: Name, source: SourceId) {
        let Some(share) = self.shares.get(&name) else { return };
        let Some(last) = share.last_to_confirm(&source) else { return };
        if self.closings.wait_for(now, name, source, last, self.endpoint.subscribers(&name)) {
            self.questions.extend(share.question(&source));
        }
    }

    /// Holds the shares of writers that are gone while messages of theirs wait here, or nodes have not confirmed the
    /// last ones.
    pub(super) fn hold_shares(&mut self, now: Instant) {
        let Some(routes) = &self.routes else { return };
        for name in routes.shares_without_writers(now) {
            if (self.has_waiting(&name) || self.awaits_confirmation(now, name))
                && let Some(routes) = &mut self.routes
            {
                routes.hold_share(now, &name);
            }
        }
    }

    /// Returns `true` if messages of local publishers wait here.
    fn has_waiting(&self, name: &Name) -> bool {
        self.shares.get(name).is_some_and(|share| share.has_waiting())
    }

    /// Returns `true` if the last messages of a publisher that is gone are not confirmed, and asks once more.
    fn awaits_confirmation(&mut self, now: Instant, name: Name) -> bool {
        let Some(routes) = &self.routes else { return false };
        // Another publisher may have taken a source over.
        self.closings.retain(&name, |source| !routes.has_writer_of(&name, source));
        // Messages may have come since the writer went, and a question may have been lost with a link.
        for source in self.closings.of(&name).collect::<Vec<_>>() {
            self.close_source(now, name, source);
        }
        self.closings.is_waiting(now, &name)
    }

    fn leave(&mut self, now: Now, name: Name) {
        self.endpoint.leave(now, &name);
        self.forget_type(&name);
        self.stop_publishing(&name);
        self.end_calls(&name);
        self.sinks.remove(&name);
        self.wishes.left(&name);
    }

    /// Takes a new reader into use, unless the wish has changed meanwhile.
    pub(super) fn reader_ready(&mut self, name: Name, spec: &EndpointSpec, guid: Guid, reader: OpenEnd) {
        let is_wanted = !self.reopening.is_closed() && self.ends.wants_reader(&name, spec);
        let unwanted = if is_wanted { self.ends.put_reader(&name, reader) } else { Some(reader) };
        match unwanted {
            Some(reader) => drop_elsewhere(reader),
            None => self.graph.reader_there(name, guid),
        }
    }

    fn close_reader(&mut self, name: &Name) {
        self.graph.reader_gone(name);
        if let Some(reader) = self.ends.forget_reader(name) {
            drop_elsewhere(reader);
        }
    }

    /// Takes a new writer into use, unless the wish has changed meanwhile.
    pub(super) fn writer_ready(
        &mut self,
        name: Name,
        source: Option<SourceId>,
        spec: &EndpointSpec,
        writer: Option<Arc<WriterQueue>>,
    ) {
        let wanted = !self.reopening.is_closed() && self.ends.wants_writer(&(name, source), spec);
        match (self.sinks.get(&name), writer) {
            (Some(sink), Some(writer)) if wanted => {
                self.graph.writer_there((name, source), writer.guid());
                sink.set_writer(source, Some(writer), &self.data);
                match source {
                    Some(source) => self.ask_history(name, source),
                    None => self.ask_histories(name),
                }
            }
            (_, Some(writer)) => writer.close(),
            (_, None) => {}
        }
    }

    /// Notes a change of the writer for messages of others on our share: its QoS is shown as theirs.
    fn note_inbound_writer(&mut self, now: Now, name: &Name, source: Option<SourceId>) {
        if source.is_none() && self.shares.get(name).is_some() {
            self.consumers.show_soon(now.instant);
        }
    }

    fn close_writer(&mut self, name: Name, source: Option<SourceId>) {
        self.ends.forget_writer(&(name, source));
        self.graph.writer_gone(&(name, source));
        self.sinks.writer_closed(name, source);
    }

    pub(super) fn map_sources(&mut self, name: Name, class: Class, own: Vec<(Guid, SourceId, Qos)>) {
        let (Some(share), Some(grant)) = (self.shares.get(&name).cloned(), self.endpoint.share_grant(&name))
        else {
            return;
        };
        let Some(message_key) = self.publishers.key(grant.suite) else { return };
        let old = share.map();
        // A reply is for one caller, and the call machine remembers it.
        let is_service = self.services.get(&name).is_some();
        let recovery = if is_service { RecoveryLimits::NONE } else { RecoveryLimits::default() };
        // The memory of a topic must not grow with its publishers.
        let share_of = |bytes: usize, sources: usize| (bytes / sources).max(RECOVERY_BYTES_MIN);
        // Keys of instances are inside payloads, which are not parsed here, so all instances share one history as in
        // the local writers.
        let instances = if self.endpoint.is_keyed(&name) { KEYED_INSTANCES_KEPT } else { 1 };
        let depth_of = |qos: &Qos| match qos.history {
            _ if !qos.is_transient_local() => 0,
            History::KeepAll => HISTORY_KEEP_ALL_MAX,
            History::KeepLast(n) => (n as usize).saturating_mul(instances).min(HISTORY_KEEP_ALL_MAX),
        };
        let receivers = self.endpoint.receivers(&name);
        let slot = |id, qos: &Qos, sources: usize, is_new: bool| {
            let (keeps_history, depth) = (qos.is_transient_local(), depth_of(qos));
            let config = SourceConfig {
                name,
                id,
                class,
                reliable: qos.is_reliable(),
                history_depth: depth,
                history_bytes_max: HISTORY_BYTES_MAX,
                recovery: RecoveryLimits { bytes_max: share_of(recovery.bytes_max, sources), ..recovery },
                receivers: receivers.clone(),
            };
            let make = if is_new { Source::new } else { Source::midway };
            let source = make(config, &grant, message_key.clone())?;
            let manual = ManualLease::from_qos(qos, Instant::now());
            let slot = SourceSlot::new(source, keeps_history, qos.is_reliable());
            Some(SourceSlot { depth, manual, ..slot })
        };
        // Publishers that share a source keep the deepest of their histories.
        let mut depths = BTreeMap::<SourceId, usize>::new();
        for (_, id, qos) in &own {
            let depth = depths.entry(*id).or_default();
            *depth = depth_of(qos).max(*depth);
        }
        // No two sources have the same id, since sequence numbers are nonces.
        let mut map = SourceMap { per_writer: !own.is_empty(), ..SourceMap::default() };
        for (guid, id, qos) in own {
            let kept = map.slot(&id).or_else(|| old.slot(&id));
            let sources = map.own.len() + 1;
            if let Some(mut slot) = kept.or_else(|| slot(id, &qos, sources, self.newcomers.is_new(&guid))) {
                let depth = depths.get(&id).copied().unwrap_or_default();
                if slot.depth != depth {
                    share.set_history_depth(&slot, depth);
                    slot.depth = depth;
                }
                // The lifespan, unlike reliability and durability, can change while the source exists.
                slot.lifespan = qos.lifespan_ns.map(Duration::from_nanos);
                map.own.insert(guid, slot);
            }
        }
        if is_service {
            let mut id = || self.endpoint.new_source_id();
            map.shared = old.shared.clone().or_else(|| slot(id(), &service_qos(), 1, true));
        }
        if map.own.values().any(|slot| slot.manual.is_some()) {
            map.assertions = old.assertions.clone().or_else(|| {
                let id = self.endpoint.new_source_id();
                let recovery = RecoveryLimits::NONE;
                let (history_depth, history_bytes_max, reliable) = (0, 0, true);
                let receivers = receivers.clone();
                let config = SourceConfig {
                    name,
                    id,
                    class,
                    reliable,
                    history_depth,
                    history_bytes_max,
                    recovery,
                    receivers,
                };
                Some(SourceSlot::new(Source::new(config, &grant, message_key.clone())?, false, reliable))
            });
        }
        let sources: BTreeMap<_, _> = map.slots().map(|s| (s.id, s.progress.clone())).collect();
        self.closings.retain(&name, |source| sources.contains_key(source));
        self.endpoint.set_sources(now(), &name, sources.into_values().collect());
        self.set_map(&share, map);
    }

    /// Replaces the sources of a share, and begins to look for assertions if one of their publishers may make some.
    pub(super) fn set_map(&self, share: &Arc<LocalShare>, map: SourceMap) {
        share.set_map(map);
        if share.begins_watch() {
            tokio::spawn(assertions::watch(Arc::downgrade(share), self.network.clone()));
        }
    }

    /// Creates a reader. While the network is closed, it is only noted. A reader that replaces another skips samples
    /// that the other took.
    pub(super) fn open_reader(&mut self, name: Name, spec: EndpointSpec) {
        let Some(share) = self.shares.get(&name).cloned() else { return };
        let newest = self.ends.want_reader(name, spec.clone());
        let (Some(network), Some(events)) = (self.network.get(), self.events.upgrade()) else { return };
        let publisher = Box::new(Publisher::new(share, newest));
        let alive = self.alive.clone();
        let failures = self.ros_failures.clone();
        tokio::task::spawn_blocking(move || match network.create_reader(&spec, publisher) {
            Ok(reader) => {
                let _ = events.blocking_send(CoreEvent::ReaderReady {
                    name,
                    spec,
                    guid: network.reader_guid(&reader),
                    reader: Box::new((reader, alive)),
                });
            }
            Err(why) => {
                failures.count(NodeDrop::CreateReader);
                error!("{why}");
            }
        });
    }

    pub(super) fn open_writer(&mut self, name: Name, source: Option<SourceId>, spec: EndpointSpec) {
        self.ends.want_writer((name, source), spec.clone());
        let (Some(network), Some(events)) = (self.network.get(), self.events.upgrade()) else { return };
        let (context, failures) = (self.writers.clone(), self.ros_failures.clone());
        let shaping = self.sinks.get(&name).map(|sink| sink.shaping()).unwrap_or_default();
        let frames = self.sinks.get(&name).map(|sink| sink.frames()).filter(|_| spec.type_name == TF_MESSAGE);
        let types = self.sinks.get(&name).map(|sink| sink.types().clone()).unwrap_or_default();
        tokio::task::spawn_blocking(move || {
            let writer = network
                .create_writer(&spec)
                .inspect_err(|why| {
                    failures.count(NodeDrop::CreateWriter);
                    error!("{why}");
                })
                .ok()
                .map(|writer| WriterQueue::of_writer(context, writer, &spec, shaping, frames, types));
            let _ = events.blocking_send(CoreEvent::WriterReady { name, source, spec, writer });
        });
    }

    /// Reduces the number of messages that a writer gives late joiners.
    fn resize_writer(&mut self, name: Name, source: Option<SourceId>, spec: EndpointSpec) {
        let History::KeepLast(depth) = spec.qos.history else { return };
        let Some(writer) = self.sinks.get(&name).and_then(|sink| sink.open_writer(source)) else {
            // The writer does not exist yet. When it is ready, it is found to be outdated.
            return self.open_writer(name, source, spec);
        };
        self.ends.want_writer((name, source), spec);
        let alive = self.alive.clone();
        tokio::task::spawn_blocking(move || {
            let _alive = alive;
            writer.resize(depth);
        });
    }

    /// Moves a writer to another source of the same publisher.
    fn move_writer(&mut self, name: Name, from: SourceId, to: SourceId) {
        let Some(spec) = self.ends.forget_writer(&(name, Some(from))) else { return };
        if self.sinks.move_writer(name, from, to) {
            self.graph.writer_moved(name, from, to);
            self.ends.want_writer((name, Some(to)), spec);
            return self.ask_history(name, to);
        }
        // The writer does not exist yet. When it is ready, it is found to be outdated.
        self.open_writer(name, Some(to), spec);
    }

    /// Asks for all messages that a sink's writers lack.
    pub(super) fn ask_histories(&mut self, name: Name) {
        let requests = self.sinks.ask_all(now().instant, name);
        self.recover(requests);
    }

    pub(super) fn ask_history(&mut self, name: Name, source: SourceId) {
        let request = self.sinks.ask(now().instant, name, source);
        self.recover(request);
    }

    /// Asks sources for histories.
    pub(super) fn recover(&mut self, requests: impl IntoIterator<Item = HistoryRequest>) {
        for HistoryRequest { name, source, from } in requests {
            self.endpoint.recover(name, source, from, u64::MAX);
        }
    }

    /// Applies new settings to the queues of a name. Queued packets are still sent.
    fn begin_flows_anew(&mut self, name: Name) {
        let Some((entry, _)) = self.forwards.get(&name) else { return };
        let entry = entry.clone();
        self.links.end_flows(&name, &[]);
        self.set_forward(name, Some(entry));
    }

    pub(super) fn set_forward(&mut self, name: Name, entry: Option<FibEntry>) {
        let Some(entry) = entry else {
            self.forwards.remove(&name);
            self.want_lanes(name);
            self.data.set(name, None);
            self.links.end_flows(&name, &[]);
            return;
        };
        let wanted = entry.links();
        let max_age = self.shares.get(&name).and_then(|share| share.shaping().max_age);
        let max_age = max_age.map_or(OUTFLOW_AGE_MAX, |max_age| max_age.min(OUTFLOW_AGE_MAX));
        let mut outs = Vec::new();
        for id in &wanted {
            let out = if *id == LinkId::LOCAL {
                self.sinks.get(&name).cloned().map(Out::Local)
            } else {
                self.links.out(*id, name, max_age)
            };
            outs.extend(out.map(|out| (*id, out)));
        }
        self.links.end_flows(&name, &wanted);
        let stats = self.forwards.set(name, entry.clone());
        self.data.set(name, Some(Forward::new(entry, outs, stats)));
        self.want_lanes(name);
    }

    /// Adjusts the lanes of a name to its links and to the configuration.
    fn want_lanes(&self, name: Name) {
        let dedicated = self.routes.as_ref().is_some_and(|routes| routes.is_dedicated(&name));
        self.links.set_lanes(name, |id| dedicated && self.forwards.uses_link(&name, id));
    }

    /// Adjusts the lanes of all names.
    pub(super) fn want_all_lanes(&self) {
        self.forwards.names().for_each(|name| self.want_lanes(*name));
    }
}
