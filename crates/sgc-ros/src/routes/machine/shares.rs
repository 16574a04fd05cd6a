//! Share routes: from local writers to shares.

use std::collections::BTreeSet;
use std::time::Instant;

use rand_core::RngCore;
use sgc_trust::derive_name;
use sgc_wire::{Kind, Name, SinkId, SourceId};

use super::Routes;
use crate::names::{is_topic_name, ros_type};
use crate::network::{DiscoveredEndpoint, EndpointKind, Guid};
use crate::routes::command::Command;
use crate::routes::problem::{Cause, Problem, Way};
use crate::routes::rules::{ROUTES_PER_WILDCARD_MAX, ShareRuleId};
use crate::routes::service_ends::interface;
use crate::routes::share_route::{ShareRoute, ShareTimeout, ShareUpdate, WriterRemoval};

impl<R: RngCore> Routes<R> {
    /// Handles the grant of a share to a sink.
    pub fn handle_sink_joined(&mut self, name: &Name, sink: SinkId) {
        if let Some(share) = self.shares.get_mut(name) {
            share.add_sink(sink);
            self.refresh_share(*name);
        }
    }

    /// Handles the end of a sink of a share.
    pub fn handle_sink_left(&mut self, now: Instant, name: &Name, sink: &SinkId) {
        if let Some(share) = self.shares.get_mut(name) {
            share.remove_sink(now, sink);
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
            self.shares.values_mut().find(|s| s.rule() == rule && s.fits(&topic, &writer.type_name))
        {
            route.add_writer(writer);
            let name = route.name();
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
            let (topic, other) = (topic.to_owned(), other.local_name().to_owned());
            Some(Problem::SharedAsOne { topic, called: metadata.ros_name, other })
        } else {
            let running = || self.shares.values().filter(|s| s.rule() == rule).count();
            (share.is_pattern() && running() >= ROUTES_PER_WILDCARD_MAX)
                .then(|| Problem::TooManyMatches { topic: share.metadata.ros_name.clone(), way: Way::Shared })
        };
        if problem.is_some() {
            self.backlog.wait();
            return problem;
        }
        let (shaping, dead_man) = (share.shaping, share.dead_man.clone());
        let (spec, route) = ShareRoute::begin(name, rule, share, topic, &type_name, keyless, writer);
        self.shares.insert(name, route);
        self.commands.push_back(Command::Share(spec));
        self.shape(name, shaping);
        if dead_man.is_some() {
            self.dead_man(name, dead_man);
            self.change_writer(&name, ShareRoute::refresh_writer);
        }
        self.refresh_share(name);
        None
    }

    pub(super) fn writer_gone(&mut self, now: Instant, endpoint: &DiscoveredEndpoint) {
        if endpoint.kind != EndpointKind::Writer {
            return;
        }
        self.publisher_gone(endpoint);
        let with = self.shares.values().filter(|s| s.has_writer(&endpoint.guid));
        for name in with.map(ShareRoute::name).collect::<Vec<_>>() {
            let Some(share) = self.shares.get_mut(&name) else { continue };
            let rule = &self.share_rules[share.rule()];
            let source = share.source_of(&endpoint.guid).filter(|_| !rule.is_service());
            let removal = share.remove_writer(now, &endpoint.guid, rule);
            if let Some(source) = source.filter(|source| !share.has_writer_of(source)) {
                self.commands.push_back(Command::CloseSource { name, source });
            }
            match removal {
                Some(WriterRemoval::Changed) => self.refresh_share(name),
                Some(WriterRemoval::Held) if rule.is_service() => {
                    self.commands.push_back(Command::ServersGone { name });
                }
                Some(WriterRemoval::Held) | None => {}
            }
        }
    }

    /// Handles the expiry of a local writer's lease, or its renewal.
    pub(super) fn handle_liveliness(&mut self, guid: Guid, is_alive: bool) {
        self.local.set_alive(&guid, is_alive);
        self.refresh_where(|share| share.set_alive(&guid, is_alive));
    }

    /// Updates the depth of a local publisher that did not announce it.
    pub(super) fn handle_depth(&mut self, writer: &Guid, depth: u32) {
        if let Some(history) = self.local.learn_depth(writer, depth) {
            self.refresh_where(|share| share.set_history(writer, history));
        }
    }

    /// Changes shares and refreshes those for which `change` returns `true`.
    fn refresh_where(&mut self, mut change: impl FnMut(&mut ShareRoute) -> bool) {
        let changed = self.shares.values_mut().filter_map(|share| change(share).then(|| share.name()));
        for name in changed.collect::<Vec<_>>() {
            self.refresh_share(name);
        }
    }

    /// Updates catalogue entry, sources and local ends of a share to match its writers and sinks.
    pub(super) fn refresh_share(&mut self, name: Name) {
        let Some(share) = self.shares.get_mut(&name) else { return };
        let rule = &self.share_rules[share.rule()];
        let update = share.refresh(rule, &self.local, &self.secret, &mut self.rng);
        if let Some(ShareUpdate { commands, problems }) = update {
            let is_of_writer =
                |c: &Command| matches!(c, Command::OpenWriter { .. } | Command::CloseWriter { .. });
            let has_other_writer = commands.iter().any(is_of_writer);
            self.commands.extend(commands);
            self.settle(Cause::Share(name), problems);
            if has_other_writer {
                self.check_later();
            }
        }
    }

    /// Returns the shares that [`Self::handle_timeout`] ends, or that lose a source, because their writers are gone.
    pub fn shares_without_writers(&self, now: Instant) -> Vec<Name> {
        let due = self.shares.values().filter(|share| share.outlives_writers(now));
        due.map(ShareRoute::name).collect()
    }

    /// Returns `true` if a local writer that is here has a source of a share.
    pub fn has_writer_of(&self, name: &Name, source: &SourceId) -> bool {
        self.shares.get(name).is_some_and(|share| share.has_writer_of(source))
    }

    /// Keeps a share and its sources for a while longer, within bounds, because messages of its writers wait to be
    /// sent.
    pub fn hold_share(&mut self, now: Instant, name: &Name) {
        if let Some(share) = self.shares.get_mut(name) {
            share.hold_on(now);
        }
    }

    /// Ends shares whose last writer has been gone for a while, and forgets sources and sinks that are gone.
    pub(super) fn shares_time_out(&mut self, now: Instant) {
        let due: Vec<_> = self.shares.values_mut().map(|share| (share.name(), share.time_out(now))).collect();
        for (name, timeout) in due {
            match timeout {
                ShareTimeout::Ends => self.drop_share(name),
                ShareTimeout::Changed => self.refresh_share(name),
                ShareTimeout::Unchanged => {}
            }
        }
    }

    pub(super) fn drop_share(&mut self, name: Name) {
        if let Some(share) = self.shares.remove(&name) {
            self.settle(Cause::Share(name), BTreeSet::new());
            self.backlog.free();
            self.commands.extend(share.close());
        }
    }
}
