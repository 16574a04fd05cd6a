//! The router's state machine: frames and link changes in, frames and forwarding entries out.
//!
//! [`Router`] owns no state of the network itself. It verifies signed bodies, asks the parts ([`Links`], [`Topology`],
//! [`Names`], [`Trees`]), and passes the effects of one on to the next.

mod announcements;
mod branches;
mod lists;
mod neighbours;
mod store;
mod sync;
mod trust;

use std::sync::Arc;
use std::time::Instant;

use sgc_trust::Identity;
use sgc_wire::{ClockWatch, Control, Hello, MINOR_VERSION, Name, NodeId, Now};

use self::lists::ListAllowances;
use self::sync::Syncs;
use crate::config::RouterConfig;
use crate::context::Context;
use crate::drops::DropReason;
use crate::limits::allowances::Allowances;
use crate::link_id::LinkId;
use crate::links::{DirectReach, Link, LinkQuality, Links, Neighbour, PathKind};
use crate::mapping::MappingKind;
use crate::names::Names;
use crate::network::Network;
use crate::output::{LinkClose, Output, Outputs};
use crate::store::Store;
use crate::topology::{RouteStats, Topology};
use crate::trees::Trees;

/// Sizes of the router's tables, for status.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct RouterStats {
    /// Names with a route.
    pub routed_names: usize,
    /// Names in any state.
    pub names: usize,
    /// Nodes that described their links.
    pub nodes: usize,
    /// Branches, pending ones included.
    pub branches: usize,
    /// Withdrawn names remembered.
    pub tombstones: usize,
}

/// The claim of this run to its node's links.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Claim {
    /// It takes over from earlier runs.
    TakesOver,
    /// Another run of this node took over from this one, so it takes over from none.
    Yields,
}

/// The state machine.
#[derive(Debug)]
pub struct Router {
    config: RouterConfig,
    links: Links,
    allowances: Allowances,
    topology: Topology,
    names: Names,
    trees: Trees,
    syncs: Syncs,
    lists: ListAllowances,
    /// The store of names, at a router that has one.
    store: Option<Store>,
    outputs: Outputs,
    /// Time at which to pass on announcements beyond the allowance of their signer.
    late_at: Option<Instant>,
    claim: Claim,
    clock: ClockWatch,
    /// The driver's last time.
    now: Now,
}

impl Router {
    /// Returns a router with only its local link.
    pub fn new(config: RouterConfig, now: Now) -> Self {
        let local = Hello {
            minor: MINOR_VERSION,
            incarnation: config.incarnation,
            transit: false,
            yields: false,
            started: config.started,
        };
        Self {
            links: Links::new(config.node, local),
            allowances: Allowances::new(&config.limits),
            topology: Topology::new(now.instant, &config),
            names: Names::new(&config),
            trees: Trees::new(&config.limits),
            syncs: Syncs::default(),
            lists: ListAllowances::default(),
            store: (config.transit && config.mapping == MappingKind::Store)
                .then(|| Store::new(now.instant, config.limits.store_cache_bytes)),
            outputs: Outputs::default(),
            late_at: None,
            claim: Claim::TakesOver,
            clock: ClockWatch::new(now),
            now,
            config,
        }
    }

    /// Takes a new link to an authenticated node, and greets it.
    pub fn handle_link_up(&mut self, now: Now, link: LinkId, neighbour: Neighbour) {
        debug_assert_ne!(link, LinkId::LOCAL);
        self.now = now;
        self.add_link(link, neighbour);
    }

    /// Handles the end of a link: everything that depended on it is withdrawn.
    pub fn handle_link_down(&mut self, now: Now, link: LinkId) {
        debug_assert_ne!(link, LinkId::LOCAL);
        self.now = now;
        self.forget_link(link);
    }

    /// Takes the measurements of a link.
    pub fn handle_link_quality(&mut self, now: Now, link: LinkId, quality: LinkQuality) {
        self.now = now;
        let of_loss = self.links.cost_of_loss(link);
        if let Some(node) = self.links.measure(now.instant, link, quality) {
            self.topology.links_changed(now.instant, &node);
            self.spare_uplinks();
        }
        if self.links.cost_of_loss(link) != of_loss {
            self.names_part(|names, cx| names.loss_changed(cx, link));
        }
    }

    /// Takes the place to which a direct link leads now, since the addresses at both its ends may change. Has no effect on
    /// other links.
    pub fn handle_direct_reach(&mut self, now: Now, link: LinkId, reach: DirectReach) {
        self.now = now;
        if !self.links.set_direct_reach(link, reach) {
            return;
        }
        if reach == DirectReach::Near {
            self.names_part(|names, cx| names.end_withholding(cx, link));
        }
        self.spare_uplinks();
    }

    /// Takes a frame from a link.
    pub fn handle_frame(&mut self, now: Now, link: LinkId, frame: Control) {
        self.now = now;
        let Some(state) = self.links.get(link) else {
            self.drop_frame(link, DropReason::NoLink);
            return;
        };
        if state.hello().is_some() == matches!(frame, Control::Hello(_)) {
            self.close(link, LinkClose::Greeting);
            return;
        }
        match frame {
            Control::Hello(hello) => self.handle_hello(link, hello),
            Control::Advert { cost, signed } => self.handle_advert(link, cost, signed),
            Control::Unreach { names } => self.handle_unreach(link, &names),
            Control::Interest { names } => {
                self.names.begin_interests(link, &names);
                names.iter().for_each(|name| self.spare_uplink_at(link, *name));
                self.names_part(|part, cx| part.add_interests(cx, link, &names));
            }
            Control::Uninterest { names } => {
                self.names_part(|part, cx| part.remove_interests(cx, link, &names));
            }
            Control::Join { signed } => self.handle_join(link, signed),
            Control::Leave { name, sink } => self.handle_leave(link, name, sink),
            Control::Answer { signed } => self.handle_answer(link, signed),
            Control::Reject { name, sink, reason } => self.handle_reject(link, name, sink, reason),
            Control::Recover(recover) => self.handle_recover(link, recover),
            Control::Crl { der } => self.handle_crl(link, &der),
            Control::Ack { name, sink, serial } => self.handle_ack(link, name, sink, serial),
            Control::LinkState { signed } => self.handle_link_state(link, signed),
            Control::Query { id, hops, names } => {
                self.names_part(|part, cx| part.handle_query(cx, link, id, hops, &names));
            }
            Control::Reroute { name, sink } => self.handle_reroute(link, name, sink),
            Control::Label { .. } | Control::LabelAck { .. } => {
                self.drop_frame(link, DropReason::Unknown { what: "label" });
            }
            Control::Probe { .. } => self.drop_frame(link, DropReason::Unknown { what: "probe" }),
            Control::Clock { time } => self.handle_clock(link, time),
            // Its content is for the operator alone.
            Control::IdentityInUse { .. } => self.drop_frame(link, DropReason::Unknown { what: "identity" }),
            // Its driver takes those that it expects.
            Control::ObservedAddress { .. } => self.drop_frame(link, DropReason::Unknown { what: "address" }),
            Control::LaneOffer { .. }
            | Control::LaneAnswer { .. }
            | Control::LaneWanted { .. }
            | Control::BulkLaneWanted { .. } => {
                self.drop_frame(link, DropReason::Unknown { what: "lane" });
            }
            Control::Goodbye => self.close(link, LinkClose::Goodbye),
        }
    }

    /// Notes that the link has taken all frames before an [`Output::Flush`].
    pub fn handle_flushed(&mut self, now: Now, link: LinkId) {
        self.now = now;
        self.continue_sync(link);
    }

    /// Acts on timers that are due.
    pub fn handle_timeout(&mut self, now: Now) {
        self.now = now;
        if self.clock.was_set(now) {
            self.clock_was_set();
        }
        self.close_expired();
        for ended in self.topology.expire(now.instant) {
            self.names.run_ended(now.instant, &ended.node, ended.floor);
        }
        self.expire_names();
        self.pass_on_late();
        self.take_waiting_lists();
        self.names_part(Names::release_withheld);
        if let Some(store) = &mut self.store {
            store.handle_timeout(now.instant);
        }
        let effects = self.trees.handle_timeout(now.instant);
        self.perform(effects);
    }

    /// Returns the next output; call until it is [`Output::Timeout`].
    pub fn poll_output(&mut self) -> Output {
        if self.outputs.is_empty() {
            let now = self.now.instant;
            self.originate_due();
            if self.topology.is_search_due(now) {
                self.search();
            }
            if self.names.is_ask_due(now) {
                self.names_part(Names::ask_due);
            }
            self.follow_store();
        }
        self.outputs.pop().unwrap_or_else(|| {
            let deadlines =
                [self.trees.next_deadline(), self.links.next_expiry(), self.late_at, self.lists.next_at()];
            let store = self.store.iter().flat_map(Store::deadlines);
            let parts = self.topology.deadlines().chain(self.names.deadlines()).chain(store);
            Output::Timeout(deadlines.into_iter().flatten().chain(parts).min())
        })
    }

    /// Takes another certificate of this node, which then signs its link state anew.
    pub fn set_identity(&mut self, now: Now, identity: Arc<Identity>) {
        self.now = now;
        self.config.identity = identity;
        self.topology.touch_own(now.instant);
    }

    /// Notes that a peer closed a link because another run of this node has its place. From here on this run takes over
    /// from no other: where two processes have one identity, the one that was started last keeps its links, and the
    /// other gets them when that one is gone.
    pub fn handle_superseded(&mut self) {
        self.claim = Claim::Yields;
    }

    /// Returns `true` once another run of this node has superseded this one.
    pub fn yields(&self) -> bool {
        self.claim == Claim::Yields
    }

    /// Returns by how many milliseconds the clock of a link's peer is ahead of the one here, from the peer's own
    /// report.
    pub fn clock_ahead_ms(&self, link: LinkId) -> Option<i64> {
        Some(self.links.get(link)?.clock()?.ahead_ms(self.now))
    }

    /// Returns `true` if the node forwards for others.
    pub fn is_transit(&self) -> bool {
        self.config.transit
    }

    /// Returns the sizes of the tables.
    pub fn stats(&self) -> RouterStats {
        RouterStats {
            routed_names: self.names.routed(self.network()),
            names: self.names.known(),
            nodes: self.topology.len(),
            branches: self.trees.len(),
            tombstones: self.names.tombstones(),
        }
    }

    /// Returns the link towards the owner of `name`, and the cost of the route, microseconds of round trip.
    pub fn route(&self, name: &Name) -> Option<(LinkId, u32)> {
        self.names.next_hop(self.network(), name)
    }

    /// Lets only one kind of path count for a name of another node, or any, until the next call for the name. Has no effect
    /// at a node that carries others' names.
    pub fn require_path(&mut self, name: Name, kind: Option<PathKind>) {
        self.names.require_path(name, kind);
    }

    /// Returns the cost of the route to a router, microseconds of round trip; `None` if it is out of reach.
    pub fn cost_to(&self, router: &NodeId) -> Option<u32> {
        self.topology.next_hop(router).map(|(cost, _)| cost)
    }

    /// Returns the results of the route searches.
    pub fn route_stats(&self) -> RouteStats {
        self.topology.route_stats()
    }

    /// Returns the minor version of the protocol with which the node of a link greeted; `None` before it did.
    pub fn minor(&self, link: LinkId) -> Option<u16> {
        Some(self.links.get(link)?.hello()?.minor)
    }

    /// Returns `true` if a branch of some name uses a link, or the node there is interested in a name of this one.
    pub fn is_used(&self, link: LinkId) -> bool {
        self.trees.uses(link) || self.names.wants_own(link)
    }

    /// Returns `true` if another link to the same node is better, and no branch uses this one.
    pub fn is_superseded(&self, link: LinkId) -> bool {
        let best = self.links.get(link).and_then(|state| self.links.best_to(state.node()));
        best.is_some_and(|(best, _)| best != link) && !self.trees.uses(link)
    }

    /// Returns the cost of a link, microseconds of round trip, and whether it seems dead.
    pub fn link_cost(&self, link: LinkId) -> Option<(u32, bool)> {
        let cost = self.links.get(link).map(Link::cost)?;
        Some((cost.now(), cost.is_suspect()))
    }

    // ---- The parts and their surroundings.

    fn network(&self) -> Network<'_> {
        Network { links: &self.links, topology: &self.topology }
    }

    /// Lets the part of names handle something in its surroundings.
    fn names_part<T>(&mut self, handle: impl FnOnce(&mut Names, &mut Context<'_>) -> T) -> T {
        let mut cx = Context {
            now: self.now,
            network: Network { links: &self.links, topology: &self.topology },
            allowances: &mut self.allowances,
            outputs: &mut self.outputs,
            store: self.store.as_mut(),
        };
        handle(&mut self.names, &mut cx)
    }

    fn send(&mut self, link: LinkId, frame: Control) {
        if self.links.contains(link) {
            self.outputs.push(Output::Send { link, frame });
        }
    }

    fn drop_frame(&mut self, link: LinkId, reason: DropReason) {
        self.names_part(|_, cx| cx.drop_frame(link, reason));
    }

    fn may_bring(&mut self, link: LinkId) -> bool {
        self.names_part(|_, cx| cx.may_bring(link))
    }

    fn charge_stale(&mut self, link: LinkId) {
        self.names_part(|_, cx| cx.charge_stale(link));
    }

    /// Closes a link from this side.
    fn close(&mut self, link: LinkId, reason: LinkClose) {
        self.outputs.push(Output::Close { link, reason });
        self.forget_link(link);
    }
}
