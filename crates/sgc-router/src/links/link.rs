//! One link: the node at its other end, its greeting, and its cost.

use std::sync::Arc;
use std::time::{Duration, Instant};

use sgc_trust::{CertId, VerifiedPeer};
use sgc_wire::{Hello, NodeId, Now, PeerClock, UnixMillis};

use crate::links::cost::Cost;
use crate::links::quality::LinkQuality;

/// The node at the other end of a link, as the handshake proved it.
#[derive(Clone, Debug)]
pub struct Neighbour {
    /// The node.
    pub node: NodeId,
    /// Its certificate, and those between it and the CA.
    pub certs: Arc<[CertId]>,
    /// Whether its certificate lets it carry others' names.
    pub may_route: bool,
    /// Last moment at which its certificate is valid.
    pub not_after: UnixMillis,
    /// Configured cost of the link, microseconds of round trip; `None` to measure it.
    pub cost: Option<u32>,
    /// Whether the link was found without configuration, and where it leads.
    pub direct: Option<DirectReach>,
}

/// Where a direct link leads.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum DirectReach {
    /// To a network to which this node is attached, so its packets do not pass the uplink.
    Near,
    /// Elsewhere, through the same uplink as the links to routers.
    Far,
}

/// Kinds of paths to the owner of a name.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum PathKind {
    /// Over a direct link, which was found without configuration.
    Direct,
    /// Over another link.
    Relayed,
}

impl From<&VerifiedPeer> for Neighbour {
    fn from(peer: &VerifiedPeer) -> Self {
        let VerifiedPeer { node_id, path, may_route, not_after, .. } = peer;
        Self {
            node: *node_id,
            certs: path.clone(),
            may_route: *may_route,
            not_after: *not_after,
            cost: None,
            direct: None,
        }
    }
}

/// A link that is up.
#[derive(Debug)]
pub(crate) struct Link {
    /// The authenticated node at the other end.
    node: NodeId,
    /// Its certificates; none for this node itself.
    certs: Arc<[CertId]>,
    may_route: bool,
    /// Last moment at which its certificate is valid.
    not_after: UnixMillis,
    /// The same by the monotonic clock; `None` for a certificate that outlasts the clock.
    expires: Option<Instant>,
    /// Its greeting; nothing else is accepted before it.
    hello: Option<Hello>,
    cost: Cost,
    direct: Option<DirectReach>,
    /// The neighbour's wall clock, from its own report.
    clock: Option<PeerClock>,
    /// Time at which it was last told everything again because a clock was set.
    repeated: Option<Instant>,
}

impl Link {
    pub(super) fn new(now: Now, neighbour: Neighbour) -> Self {
        let Neighbour { node, certs, may_route, not_after, cost, direct } = neighbour;
        let mut state = Self {
            node,
            certs,
            may_route,
            not_after,
            expires: None,
            hello: None,
            cost: if direct.is_some() { Cost::of_direct_link() } else { Cost::new(cost) },
            direct,
            clock: None,
            repeated: None,
        };
        state.set_expiry(now);
        state
    }

    /// Returns the link to this node's own endpoint.
    pub(super) fn local(node: NodeId, hello: Hello) -> Self {
        Self {
            node,
            certs: Arc::new([]),
            may_route: false,
            not_after: UnixMillis(u64::MAX),
            expires: None,
            hello: Some(hello),
            cost: Cost::new(Some(0)),
            direct: None,
            clock: None,
            repeated: None,
        }
    }

    /// Returns the node at the other end.
    pub(crate) fn node(&self) -> &NodeId {
        &self.node
    }

    /// Returns the certificates of the node.
    pub(crate) fn certs(&self) -> &[CertId] {
        &self.certs
    }

    /// Returns the greeting.
    pub(crate) fn hello(&self) -> Option<Hello> {
        self.hello
    }

    /// Returns where the link leads, if it was found without configuration.
    pub(crate) fn direct(&self) -> Option<DirectReach> {
        self.direct
    }

    /// Sets where a direct link leads. Returns `true` if that is elsewhere than before.
    pub(super) fn set_direct_reach(&mut self, reach: DirectReach) -> bool {
        self.direct.as_mut().is_some_and(|known| std::mem::replace(known, reach) != reach)
    }

    /// Returns the kind of the paths over the link.
    pub(crate) fn path_kind(&self) -> PathKind {
        if self.direct.is_some() { PathKind::Direct } else { PathKind::Relayed }
    }

    /// Returns the cost.
    pub(crate) fn cost(&self) -> &Cost {
        &self.cost
    }

    /// Returns the end of the node's certificate by the monotonic clock.
    pub(crate) fn expires(&self) -> Option<Instant> {
        self.expires
    }

    /// Returns the neighbour's wall clock, from its own report.
    pub(crate) fn clock(&self) -> Option<PeerClock> {
        self.clock
    }

    /// Returns `true` once it greeted as a router, if its certificate lets it.
    pub(crate) fn is_router(&self) -> bool {
        self.may_route && self.hello.is_some_and(|h| h.transit)
    }

    /// Takes its greeting.
    pub(super) fn greet(&mut self, hello: Hello) {
        self.hello = Some(hello);
    }

    /// Computes the end of the certificate by the present clocks.
    pub(super) fn set_expiry(&mut self, now: Now) {
        let left = Duration::from_millis(self.not_after.0.saturating_sub(now.unix.0));
        self.expires = now.instant.checked_add(left);
    }

    /// Takes a measurement. Returns `true` if it changes the cost.
    pub(super) fn measure(&mut self, now: Instant, quality: LinkQuality) -> bool {
        self.cost.measure(now, quality)
    }

    /// Takes a report of the neighbour's wall clock, and returns the one before.
    pub(super) fn replace_clock(&mut self, clock: PeerClock) -> Option<PeerClock> {
        self.clock.replace(clock)
    }

    /// Returns `true` if the last repetition was at least this long ago, and notes one.
    pub(super) fn take_repeat(&mut self, now: Instant, every: Duration) -> bool {
        if self.repeated.is_some_and(|at| now.saturating_duration_since(at) < every) {
            return false;
        }
        self.repeated = Some(now);
        true
    }
}
