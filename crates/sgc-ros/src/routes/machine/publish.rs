//! Publishing: local publishers on names of other nodes, and remote publishers on shares of this node.
//!
//! A use route whose rule publishes carries local messages to the owner, while the owner permits it. A share route on
//! which others may publish has a local writer while at least one of them is present, unless all their publishers are
//! known to be gone.

use std::collections::BTreeMap;
use std::time::{Duration, Instant};

use rand_core::RngCore;
use sgc_wire::{Metadata, Name};

use super::Routes;
use crate::names::dds_type;
use crate::network::{DiscoveredEndpoint, EndpointKind};
use crate::routes::command::Command;
use crate::routes::problem::Cause;
use crate::routes::rules::{DeadManRule, Direction, Shaping, ShareRule, ShareRuleId, UseRule, UseRuleId};
use crate::routes::share_route::{AnnouncedPublishers, ShareRoute};
use crate::routes::use_route::UseRoute;

impl<R: RngCore> Routes<R> {
    /// Handles the arrival of the first other publisher on a share, or the end of the last.
    pub fn handle_publishers(&mut self, name: &Name, any: bool) {
        self.change_writer(name, |share, rule| share.set_publishers(any, rule));
    }

    /// Handles what other nodes say of their publishers on shares of this node.
    pub fn handle_announced(&mut self, now: Instant, announced: BTreeMap<Name, AnnouncedPublishers>) {
        for (name, publishers) in announced {
            self.change_writer(&name, |share, rule| share.set_announced(now, publishers, rule));
        }
    }

    /// Handles a message of a remote publisher, which came at this time and waits for a writer, or has one in doubt: that
    /// publisher lives, whatever was announced.
    pub fn handle_unwritten(&mut self, at: Instant, name: &Name) {
        self.change_writer(name, |share, rule| share.hear_publisher(at, rule));
    }

    /// Changes a share, and carries out the effect on its writer for messages of others.
    pub(super) fn change_writer(
        &mut self,
        name: &Name,
        change: impl FnOnce(&mut ShareRoute, &ShareRule) -> Option<Command>,
    ) {
        let Some(share) = self.shares.get_mut(name) else { return };
        if let Some(command) = change(share, &self.share_rules[share.rule()]) {
            self.commands.push_back(command);
            self.check_later();
        }
    }

    /// Returns the shares of which [`Self::handle_timeout`] closes the writer for messages of others unless one came
    /// within the given time. Nobody announced their publishers as living.
    pub fn writers_in_doubt(&self, now: Instant) -> Vec<(Name, Duration)> {
        let due = self.shares.values().filter_map(|share| Some((share.name(), share.doubts_writer(now)?)));
        due.collect()
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

    /// Sets the dead-man switch. A new name has none, so `None` needs no command.
    pub(super) fn dead_man(&mut self, name: Name, rule: Option<DeadManRule>) {
        if rule.is_some() {
            self.commands.push_back(Command::DeadMan { name, rule });
        }
    }

    /// Adds a local writer to the routes that publish its topic elsewhere.
    pub(super) fn publisher_there(&mut self, writer: &DiscoveredEndpoint) {
        self.refresh_uses_where(|route, rule| {
            rule.direction == Direction::Publish && route.add_publisher(writer)
        });
    }

    pub(super) fn publisher_gone(&mut self, writer: &DiscoveredEndpoint) {
        self.refresh_uses_where(|route, _| route.remove_publisher(&writer.guid));
    }

    /// Changes uses and refreshes those for which `change` returns `true`.
    fn refresh_uses_where(&mut self, mut change: impl FnMut(&mut UseRoute, &UseRule) -> bool) {
        let rules = &self.use_rules;
        let changed = self.uses.iter_mut().filter_map(|(name, route)| {
            let rule = &rules[route.rule()];
            change(route, rule).then_some(*name)
        });
        for name in changed.collect::<Vec<_>>() {
            self.refresh_use(name);
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
}
