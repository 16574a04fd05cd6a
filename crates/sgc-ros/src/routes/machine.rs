//! [`Routes`]: the state of the route machine, its inputs and its outputs.
//!
//! The files below have the handlers, each for one subject. Only they reach the fields.

mod checks;
mod consumers;
mod graph;
mod publish;
mod reconfigure;
mod selection;
mod services;
mod settling;
mod shares;
mod status;
mod tokens;
mod uses;
mod view;

use std::collections::{BTreeMap, BTreeSet, VecDeque};
use std::time::Instant;

use rand_core::RngCore;
use sgc_trust::FleetSecret;
use sgc_wire::{Name, NodeId};

use super::backlog::Backlog;
use super::command::Command;
use super::local_graph::LocalGraph;
use super::owners::Owners;
use super::problem::{Cause, Problem, Problems};
use super::rules::{Rules, ShareRule, ShareRules, UseRule, UseRules};
use super::share_route::ShareRoute;
use super::token_join::TokenJoin;
use super::use_route::UseRoute;
use crate::network::{DiscoveryEvent, EndpointKind};

pub use consumers::Consumers;
pub use status::{RouteKind, RouteState, RouteStatus};
pub use view::{OfferView, ShareRouteView, ShareView, UseRouteView, UseView};

/// The route machine.
pub struct Routes<R> {
    secret: FleetSecret,
    node: NodeId,
    rng: R,
    share_rules: ShareRules,
    use_rules: UseRules,
    local: LocalGraph,
    shares: BTreeMap<Name, ShareRoute>,
    uses: BTreeMap<Name, UseRoute>,
    tokens: BTreeMap<Name, TokenJoin>,
    owners: Owners,
    problems: Problems,
    backlog: Backlog,
    /// `true` if local consumers or the interfaces that they use may have changed.
    consumers_changed: bool,
    commands: VecDeque<Command>,
}

impl<R: RngCore> Routes<R> {
    /// Creates the machine. `node` is this node, `rng` provides source ids.
    pub fn new(
        secret: FleetSecret,
        node: NodeId,
        share_rules: Vec<ShareRule>,
        use_rules: Vec<UseRule>,
        rng: R,
    ) -> Self {
        let mut routes = Self {
            secret,
            node,
            rng,
            share_rules: Rules::new(share_rules),
            use_rules: Rules::new(use_rules),
            local: LocalGraph::default(),
            shares: BTreeMap::new(),
            uses: BTreeMap::new(),
            tokens: BTreeMap::new(),
            owners: Owners::default(),
            problems: Problems::default(),
            backlog: Backlog::default(),
            consumers_changed: false,
            commands: VecDeque::new(),
        };
        routes.join_tokens();
        routes.begin_inbound();
        routes
    }

    /// Sets the secret from which names of later shares are derived. Running shares keep their names.
    pub fn set_secret(&mut self, secret: FleetSecret) {
        self.secret = secret;
    }

    /// Handles a change of the local graph.
    pub fn handle_discovery(&mut self, now: Instant, event: DiscoveryEvent) {
        self.consumers_changed = true;
        match event {
            DiscoveryEvent::Appeared(endpoint) => {
                if self.local.is_full() {
                    return self.report(Cause::Network, Problem::TooManyEndpoints);
                }
                if let Some(old) = self.local.insert(endpoint.clone()) {
                    self.writer_gone(now, &old);
                }
                if self.service_end_there(&endpoint) {
                    return;
                }
                match endpoint.kind {
                    EndpointKind::Writer => self.writer_there(endpoint),
                    EndpointKind::Reader => self.check_local(&endpoint),
                }
            }
            DiscoveryEvent::Vanished { guid } => {
                if let Some(endpoint) = self.local.remove(&guid) {
                    self.service_end_gone(now, &endpoint);
                    self.settle(Cause::Network, BTreeSet::new());
                    self.settle(Cause::Endpoint(guid), BTreeSet::new());
                    self.settle(Cause::Unshared(guid), BTreeSet::new());
                    self.writer_gone(now, &endpoint);
                }
            }
            DiscoveryEvent::Liveliness { guid, is_alive } => self.handle_liveliness(guid, is_alive),
            DiscoveryEvent::HistoryDepth { guid, depth } => self.handle_depth(&guid, depth),
            DiscoveryEvent::Nodes { participant, nodes } => self.handle_nodes(participant, nodes),
        }
    }

    /// Handles the passing of time.
    pub fn handle_timeout(&mut self, now: Instant) {
        self.shares_time_out(now);
        self.owners_have_settled(now);
        self.uses_time_out(now);
        self.reconsider();
    }

    /// Returns the next command.
    pub fn poll_command(&mut self) -> Option<Command> {
        if self.commands.is_empty() {
            self.check_stale();
        }
        self.commands.pop_front()
    }

    /// Returns the time of the next timeout.
    pub fn poll_timeout(&self) -> Option<Instant> {
        let shares = self.shares.values().map(ShareRoute::deadline);
        let uses = self.uses.values().map(UseRoute::deadline);
        shares.chain(uses).chain([self.owners.deadline()]).flatten().min()
    }

    /// Returns the ROS topic of a name that is shared or used here.
    pub fn topic_of(&self, name: &Name) -> Option<&str> {
        let share = self.shares.get(name).map(ShareRoute::local_name);
        share.or_else(|| {
            let token = || Some(self.use_rules[self.tokens.get(name)?.rule()].topic.as_str());
            self.uses.get(name).map(UseRoute::local_name).or_else(token)
        })
    }

    /// Returns `true` if the traffic of a name that is shared or used here has a lane of its own.
    pub fn is_dedicated(&self, name: &Name) -> bool {
        let share = self.shares.get(name).map(|share| self.share_rules[share.rule()].dedicated);
        let used = self.uses.get(name).map(|route| self.use_rules[route.rule()].dedicated);
        share.or(used).unwrap_or(false)
    }
}
