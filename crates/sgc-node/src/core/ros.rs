//! What the routes want done: shares, joins, readers, writers, and the forwarding of their names.

use std::sync::Arc;
use std::time::Instant;

use sgc_endpoint::{AskAgain, RecoveryLimits, Source, SourceConfig, Wish};
use sgc_ros::{Command, EndpointSpec, Guid, RosNetwork, Sample, SampleHandler};
use sgc_router::{FibEntry, LinkId};
use sgc_trust::{MessageKey, Suite};
use sgc_wire::{Class, History, Name, Qos, SourceId};
use tracing::{debug, error, warn};

use super::publish::Offer;
use super::{Core, CoreEvent, HISTORY_BYTES_MAX, HISTORY_KEEP_ALL_MAX, HISTORY_RETRY, drop_elsewhere, now};
use crate::dataplane::{Forward, Out};
use crate::outflow::OutFlow;
use crate::sinks::{LocalSink, WriterQueue};
use crate::sources::{LocalShare, SourceMap, SourceSlot};

impl<N: RosNetwork> Core<N> {
    pub(super) fn carry_out(&mut self, command: Command) {
        let now = now();
        match command {
            Command::Share(spec) => {
                let topic = spec.metadata.ros_name.clone();
                match self.endpoint.share(now, spec) {
                    Ok(name) => {
                        debug!(%topic, %name, "shared");
                        let share = LocalShare::new(
                            name,
                            self.data.clone(),
                            self.alive.clone(),
                            self.epoch_messages_max,
                            self.epoch_over.clone(),
                        );
                        self.shares.insert(name, Arc::new(share));
                    }
                    Err(why) => error!("{topic} is not shared: {why}"),
                }
            }
            Command::UpdateShare { name, qos, sources } => {
                self.endpoint.update_share(now, &name, qos, sources)
            }
            Command::Unshare { name } => {
                self.endpoint.unshare(now, &name);
                if let Some(share) = self.shares.remove(&name) {
                    share.close();
                }
                if let Some(sink) = self.sinks.remove(&name) {
                    sink.close();
                }
            }
            Command::MapSources { name, qos, class, own } => self.map_sources(name, &qos, class, own),
            Command::OpenReader { name, spec } => self.open_reader(name, spec),
            Command::CloseReader { name } => {
                if let Some((_, Some(reader))) = self.readers.remove(&name) {
                    drop_elsewhere(reader);
                }
            }
            Command::UpdatePolicy { name, policy } => self.endpoint.update_policy(now, &name, policy),
            Command::Follow { owner_name } => {
                self.endpoint.follow(now, &owner_name);
            }
            Command::Unfollow { owner } => self.endpoint.unfollow(now, &owner),
            Command::Join { name, owner, transient_local, describe } => {
                let sink = LocalSink::new(name, transient_local, self.requests.clone());
                self.sinks.insert(name, Arc::new(sink));
                self.endpoint.join(now, name, owner, Wish::Subscribe { describe });
            }
            Command::Publish { name, owner, suite, class, reliable } => {
                self.publish_under(name, Offer { owner, suite, class, reliable });
            }
            Command::Leave { name } => {
                self.endpoint.leave(now, &name);
                self.stop_publishing(&name);
                if let Some(sink) = self.sinks.remove(&name) {
                    sink.close();
                }
                self.history_due.retain(|(n, _), _| *n != name);
                self.retire_due.remove(&name);
            }
            Command::OpenWriter { name, source, spec } => self.open_writer(name, source, spec),
            Command::CloseWriter { name, source } => {
                self.writers.remove(&(name, source));
                if let Some(source) = source {
                    self.history_due.remove(&(name, source));
                }
                if let Some(sink) = self.sinks.get(&name) {
                    sink.set_writer(source, None);
                }
            }
            Command::Report(problem) => warn!("{problem}"),
        }
    }

    pub(super) fn map_sources(
        &mut self,
        name: Name,
        qos: &Qos,
        class: Class,
        own: Vec<(Guid, SourceId, Qos)>,
    ) {
        let (Some(share), Some(grant)) = (self.shares.get(&name).cloned(), self.endpoint.share_grant(&name))
        else {
            return;
        };
        let Some(message_key) = self.message_key(grant.suite) else { return };
        let old = share.map();
        let slot = |id, qos: &Qos, keeps_history: bool| {
            let depth = match qos.history {
                _ if !keeps_history => 0,
                History::KeepAll => HISTORY_KEEP_ALL_MAX,
                History::KeepLast(n) => n as usize,
            };
            let config = SourceConfig {
                name,
                id,
                class,
                reliable: qos.is_reliable(),
                history_depth: depth,
                history_bytes_max: HISTORY_BYTES_MAX,
                recovery: RecoveryLimits::default(),
            };
            let source = Source::new(config, &grant, message_key.clone())?;
            Some(SourceSlot::new(source, keeps_history, qos.is_reliable()))
        };
        // A source is never made twice under one id: its sequence numbers are nonces.
        let mut map = SourceMap { per_writer: qos.is_transient_local(), ..SourceMap::default() };
        for (guid, id, qos) in own {
            let kept = map.slot(&id).or_else(|| old.slot(&id));
            if let Some(slot) = kept.or_else(|| slot(id, &qos, true)) {
                map.own.insert(guid, slot);
            }
        }
        let kept = old.shared.clone().filter(|s| s.reliable == qos.is_reliable());
        map.shared = kept.or_else(|| slot(self.endpoint.new_source_id(), qos, false));
        self.endpoint.set_sources(now(), &name, map.slots().map(|s| s.progress.clone()).collect());
        share.set_map(map);
    }

    /// The key that messages are signed with in this suite: one for the whole node. Those that take long to make are
    /// there before they are needed.
    pub(super) fn message_key(&mut self, suite: u8) -> Option<MessageKey> {
        let suite = Suite::from_id(suite)?;
        Some(self.message_keys.entry(suite).or_insert_with(|| MessageKey::generate(suite)).clone())
    }

    pub(super) fn open_reader(&mut self, name: Name, spec: EndpointSpec) {
        let (Some(network), Some(share)) = (self.network.clone(), self.shares.get(&name).cloned()) else {
            return;
        };
        let Some(events) = self.events.upgrade() else { return };
        self.readers.insert(name, (spec.clone(), None));
        let alive = self.alive.clone();
        let failures = self.ros_failures.clone();
        tokio::task::spawn_blocking(move || {
            let handler: SampleHandler = Box::new(move |sample: Sample| share.publish(sample));
            match network.create_reader(&spec, handler) {
                Ok(reader) => {
                    let _ = events.blocking_send(CoreEvent::ReaderReady {
                        name,
                        spec,
                        reader: Box::new((reader, alive)),
                    });
                }
                Err(why) => {
                    failures.count("create_reader");
                    error!("{why}");
                }
            }
        });
    }

    pub(super) fn open_writer(&mut self, name: Name, source: Option<SourceId>, spec: EndpointSpec) {
        let Some(network) = self.network.clone() else { return };
        let Some(events) = self.events.upgrade() else { return };
        self.writers.insert((name, source), spec.clone());
        let alive = self.alive.clone();
        let failures = self.ros_failures.clone();
        tokio::task::spawn_blocking(move || {
            let writer = network.create_writer(&spec).map_err(|e| e.to_string()).and_then(|writer| {
                WriterQueue::spawn(writer, spec.topic.clone(), failures.clone(), alive)
                    .map_err(|e| e.to_string())
            });
            let writer = writer
                .inspect_err(|why| {
                    failures.count("create_writer");
                    error!("{why}");
                })
                .ok();
            let _ = events.blocking_send(CoreEvent::WriterReady { name, source, spec, writer });
        });
    }

    /// Asks for all that a sink's writers still lack.
    pub(super) fn ask_histories(&mut self, name: Name) {
        let Some(sink) = self.sinks.get(&name) else { return };
        for source in sink.unsynced() {
            self.ask_history(name, source);
        }
    }

    pub(super) fn ask_history(&mut self, name: Name, source: SourceId) {
        let from = self.sinks.get(&name).and_then(|sink| sink.ask(source));
        self.recover(name, source, from.map_or(AskAgain::No, AskAgain::From));
    }

    /// The same, a while later.
    pub(super) fn ask_history_again(&mut self, name: Name, source: SourceId) {
        let again = self.sinks.get(&name).map_or(AskAgain::No, |sink| sink.ask_again(source));
        self.recover(name, source, again);
    }

    fn recover(&mut self, name: Name, source: SourceId, ask: AskAgain) {
        match ask {
            AskAgain::No => return,
            AskAgain::Wait => {}
            AskAgain::From(from) => self.endpoint.recover(name, source, from, u64::MAX),
        }
        self.history_due.insert((name, source), Instant::now() + HISTORY_RETRY);
    }

    pub(super) fn set_forward(&mut self, name: Name, entry: Option<FibEntry>) {
        let Some(entry) = entry else {
            self.entries.remove(&name);
            self.data.set(name, None);
            for link in self.links.values_mut() {
                if let Some(flow) = link.flows.remove(&name) {
                    flow.close();
                }
            }
            return;
        };
        let stats = self.entries.get(&name).map(|(_, stats)| stats.clone()).unwrap_or_default();
        let wanted = entry.links();
        let mut outs = Vec::new();
        for id in &wanted {
            if *id == LinkId::LOCAL {
                if let Some(sink) = self.sinks.get(&name) {
                    outs.push((*id, Out::Local(sink.clone())));
                }
            } else if let Some(link) = self.links.get_mut(id) {
                let (to, control) = (&link.link, &mut link.control);
                let begin = || OutFlow::spawn(to.clone(), name, control.label(name));
                let flow = link.flows.entry(name).or_insert_with(begin).clone();
                outs.push((*id, Out::Link(flow)));
            }
        }
        for (id, link) in &mut self.links {
            if !wanted.contains(id)
                && let Some(flow) = link.flows.remove(&name)
            {
                flow.close();
            }
        }
        self.data.set(name, Some(Forward::new(entry.clone(), outs, stats.clone())));
        self.entries.insert(name, (entry, stats));
    }
}
