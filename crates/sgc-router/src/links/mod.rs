//! [`Links`]: the links of this node, the nodes at their other ends, and their costs.
//!
//! State of names and branches that belongs to a link is kept by those parts, which are told when a link ends.

pub(crate) mod cost;
mod link;
mod loss;
mod quality;

use std::collections::{BTreeMap, BTreeSet};
use std::time::{Duration, Instant};

use sgc_trust::{CLOCK_SKEW_MAX, CertId};
use sgc_wire::{Hello, NodeId, NodeTag, Now, PeerClock, UnixMillis};
use smallvec::SmallVec;

pub(crate) use self::link::Link;
pub use self::link::{DirectReach, Neighbour, PathKind};
pub use self::quality::LinkQuality;
use crate::link_id::LinkId;
use crate::output::LinkClose;

/// Links of one node; its link state must have room for each.
const LINKS_MAX: usize = sgc_wire::ADJACENCIES_MAX + sgc_wire::ATTACHED_MAX;
/// Least time until a neighbour is told everything once more because a clock was set.
const TELL_AGAIN_EVERY: Duration = Duration::from_secs(60);

/// Returns `true` if clocks differ so much that either node refuses the other's signed bodies.
pub fn clocks_differ(ahead_ms: i64) -> bool {
    ahead_ms.unsigned_abs() > CLOCK_SKEW_MAX.as_millis() as u64
}

/// The node at the other end of a link.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) struct Peer {
    pub(crate) node: NodeId,
    /// Whether it greeted as a router, and its certificate lets it be one.
    pub(crate) is_router: bool,
}

/// A link of an earlier run of a node.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) struct EarlierRun {
    pub(crate) link: LinkId,
    /// Whether that run is known to live.
    pub(crate) alive: bool,
}

/// The consequence of a greeting for the runs of a node.
#[derive(Debug, PartialEq, Eq)]
pub(crate) enum Greeting {
    /// The link stays; those of these runs end.
    Stays { earlier: SmallVec<[EarlierRun; 2]> },
    /// Another run has the place of the one that greeted: over this link, or at another router.
    GivesWay { to: Option<LinkId> },
}

/// All links that are up, the one to this node's own endpoint among them.
#[derive(Debug)]
pub(crate) struct Links {
    own: NodeId,
    links: BTreeMap<LinkId, Link>,
    /// The links to each neighbour, ascending.
    of_node: BTreeMap<NodeId, SmallVec<[LinkId; 2]>>,
}

impl Links {
    /// Returns the table with the link to this node's own endpoint, which has greeted.
    pub(crate) fn new(own: NodeId, hello: Hello) -> Self {
        let local = Link::local(own, hello);
        Self { own, links: BTreeMap::from([(LinkId::LOCAL, local)]), of_node: BTreeMap::new() }
    }

    /// Iterates over the direct links through the uplink.
    pub(crate) fn far(&self) -> impl Iterator<Item = (LinkId, &NodeId)> {
        let far = self.links.iter().filter(|(_, state)| state.direct() == Some(DirectReach::Far));
        far.map(|(link, state)| (*link, state.node()))
    }

    /// Returns `true` if a router is in reach that can copy what passes the uplink.
    pub(crate) fn has_copier(&self) -> bool {
        let copies = |state: &Link| state.direct() != Some(DirectReach::Far) && !state.cost().is_suspect();
        self.links.values().any(|state| state.is_router() && copies(state))
    }

    /// Returns `true` if what goes over a link passes the uplink.
    pub(crate) fn passes_uplink(&self, link: LinkId) -> bool {
        link != LinkId::LOCAL && self.get(link).is_some_and(|state| state.direct() != Some(DirectReach::Near))
    }

    // ---- Links that come and go.

    /// Returns the reason, other than its certificate, why a node gets no further link.
    pub(crate) fn refusal(&self, node: &NodeId, links_per_node_max: usize) -> Option<LinkClose> {
        let of_node = self.of_node.get(node).map_or(0, |links| links.len());
        if *node == self.own {
            Some(LinkClose::Loop)
        } else if of_node >= links_per_node_max || self.links.len() >= LINKS_MAX {
            Some(LinkClose::TooMany)
        } else {
            None
        }
    }

    /// Adds a link that is up.
    pub(crate) fn add(&mut self, now: Now, link: LinkId, neighbour: Neighbour) {
        let of_node = self.of_node.entry(neighbour.node).or_default();
        of_node.push(link);
        of_node.sort_unstable();
        self.links.insert(link, Link::new(now, neighbour));
    }

    /// Removes a link.
    pub(crate) fn remove(&mut self, link: LinkId) -> Option<Link> {
        let state = self.links.remove(&link)?;
        if let Some(of_node) = self.of_node.get_mut(state.node()) {
            of_node.retain(|l| *l != link);
            if of_node.is_empty() {
                self.of_node.remove(state.node());
            }
        }
        Some(state)
    }

    /// Takes the greeting over a link.
    pub(crate) fn greet(&mut self, link: LinkId, hello: Hello) -> Option<Peer> {
        let state = self.links.get_mut(&link)?;
        state.greet(hello);
        Some(Peer { node: *state.node(), is_router: state.is_router() })
    }

    /// Returns whether a link that greeted stays. `is_elsewhere` says whether a later run of the node is linked to
    /// another router.
    pub(crate) fn judge_greeting(
        &self,
        link: LinkId,
        node: &NodeId,
        hello: Hello,
        is_elsewhere: impl FnOnce() -> bool,
    ) -> Greeting {
        let is_other = |s: &Link| s.hello().is_some_and(|h| h.incarnation != hello.incarnation);
        let others: SmallVec<[LinkId; 2]> =
            self.of_node(node).filter(|l| *l != link && self.get(*l).is_some_and(is_other)).collect();
        // Greetings of two runs may cross; the newer link is that of the newer run, unless that run knows of another.
        let newest = others.iter().max().copied();
        let elsewhere = hello.yields && is_elsewhere();
        if elsewhere || newest.is_some_and(|newest| hello.yields || newest > link) {
            return Greeting::GivesWay { to: newest };
        }
        Greeting::Stays { earlier: others.into_iter().map(|link| self.earlier_run(link)).collect() }
    }

    /// Returns the links of a node's runs before the one with this floor.
    pub(crate) fn runs_before(&self, node: &NodeId, floor: u64) -> SmallVec<[EarlierRun; 2]> {
        let is_earlier = |link: &LinkId| {
            let hello = self.get(*link).and_then(Link::hello);
            hello.is_some_and(|h| h.started.0 < floor)
        };
        self.of_node(node).filter(is_earlier).map(|link| self.earlier_run(link)).collect()
    }

    fn earlier_run(&self, link: LinkId) -> EarlierRun {
        EarlierRun { link, alive: self.get(link).and_then(Link::hello).is_some_and(|h| h.yields) }
    }

    // ---- Looking links up.

    /// Returns a link that is up.
    pub(crate) fn get(&self, link: LinkId) -> Option<&Link> {
        self.links.get(&link)
    }

    /// Returns `true` if the link is up.
    pub(crate) fn contains(&self, link: LinkId) -> bool {
        self.links.contains_key(&link)
    }

    /// Returns the node at the other end of a link.
    pub(crate) fn peer(&self, link: LinkId) -> Option<Peer> {
        self.links.get(&link).map(|state| Peer { node: *state.node(), is_router: state.is_router() })
    }

    /// Returns the node at the other end of a link, unless that is this node's own endpoint.
    pub(crate) fn remote_peer(&self, link: LinkId) -> Option<Peer> {
        if link == LinkId::LOCAL { None } else { self.peer(link) }
    }

    /// Returns `true` if the link leads to this node.
    pub(crate) fn leads_to(&self, link: LinkId, node: &NodeId) -> bool {
        self.links.get(&link).is_some_and(|state| state.node() == node)
    }

    /// Returns `true` if the link leads to a router.
    pub(crate) fn is_router(&self, link: LinkId) -> bool {
        self.links.get(&link).is_some_and(Link::is_router)
    }

    /// Returns the cost of a link.
    pub(crate) fn cost(&self, link: LinkId) -> Option<u32> {
        self.links.get(&link).map(|state| state.cost().now())
    }

    /// Returns the part of a link's cost that is due to packets which this end sent and which were lost.
    pub(crate) fn cost_of_loss(&self, link: LinkId) -> u32 {
        self.links.get(&link).map_or(0, |state| state.cost().of_loss())
    }

    /// Iterates over all links, ascending.
    pub(crate) fn iter(&self) -> impl Iterator<Item = (LinkId, &Link)> {
        self.links.iter().map(|(link, state)| (*link, state))
    }

    /// Iterates over the links to other nodes, ascending.
    pub(crate) fn remote(&self) -> impl Iterator<Item = LinkId> {
        self.links.keys().copied().filter(|link| *link != LinkId::LOCAL)
    }

    /// Iterates over the links to other nodes that have greeted, ascending.
    pub(crate) fn greeted(&self) -> impl Iterator<Item = (LinkId, &Link)> {
        self.iter().filter(|(link, state)| *link != LinkId::LOCAL && state.hello().is_some())
    }

    /// Iterates over the links to routers, ascending.
    pub(crate) fn routers(&self) -> impl Iterator<Item = LinkId> {
        self.iter().filter(|(_, state)| state.is_router()).map(|(link, _)| link)
    }

    /// Iterates over the links to a neighbour, ascending.
    pub(crate) fn of_node(&self, node: &NodeId) -> impl DoubleEndedIterator<Item = LinkId> {
        self.of_node.get(node).into_iter().flatten().copied()
    }

    /// Returns `true` for a node that greeted over a link of this one, and is no router.
    pub(crate) fn is_attached(&self, node: &NodeId) -> bool {
        self.of_node(node).any(|link| {
            self.links.get(&link).is_some_and(|state| state.hello().is_some() && !state.is_router())
        })
    }

    /// Iterates over the nodes that greeted over a link of this one, and are no routers.
    pub(crate) fn attached(&self) -> impl Iterator<Item = NodeId> {
        self.of_node.keys().copied().filter(|node| self.is_attached(node))
    }

    /// Returns the best link to a neighbour: the cheapest, of about equal ones the newest.
    pub(crate) fn best_to(&self, node: &NodeId) -> Option<(LinkId, u32)> {
        let up = self.of_node(node).rev().filter_map(|link| {
            let state = self.links.get(&link).filter(|s| s.hello().is_some())?;
            Some((link, state.cost().now()))
        });
        let mut best: Option<(LinkId, u32)> = None;
        for (link, cost) in up {
            if best.is_none_or(|(_, known)| cost.saturating_mul(2).saturating_add(5000) < known) {
                best = Some((link, cost));
            }
        }
        best
    }

    /// Returns the neighbours for this node's link state: routers with the cost of the cheapest link, and other nodes.
    pub(crate) fn neighbours(&self) -> (BTreeMap<NodeId, u32>, BTreeSet<NodeTag>) {
        let (mut routers, mut others) = (BTreeMap::new(), BTreeSet::new());
        for (_, state) in self.greeted() {
            if state.is_router() {
                let cost = routers.entry(*state.node()).or_insert(u32::MAX);
                *cost = state.cost().now().min(*cost);
            } else {
                others.insert(state.node().tag());
            }
        }
        (routers, others)
    }

    // ---- Measurements, clocks and certificates.

    /// Sets where a direct link leads. Returns `true` if that is elsewhere than before.
    pub(crate) fn set_direct_reach(&mut self, link: LinkId, reach: DirectReach) -> bool {
        self.links.get_mut(&link).is_some_and(|state| state.set_direct_reach(reach))
    }

    /// Takes a measurement of a link. Returns the node at its other end if the cost changed.
    pub(crate) fn measure(&mut self, now: Instant, link: LinkId, quality: LinkQuality) -> Option<NodeId> {
        let state = self.links.get_mut(&link)?;
        state.measure(now, quality).then_some(*state.node())
    }

    /// Takes the time of a neighbour's wall clock. Returns `true` if the clocks of the two nodes no longer differ as
    /// they did.
    pub(crate) fn note_clock(&mut self, now: Now, link: LinkId, time: UnixMillis) -> bool {
        let Some(state) = self.links.get_mut(&link).filter(|_| link != LinkId::LOCAL) else { return false };
        let clock = PeerClock::new(time, now);
        let was_wrong = state.replace_clock(clock).is_some_and(|old| clocks_differ(old.ahead_ms(now)));
        was_wrong && !clocks_differ(clock.ahead_ms(now))
    }

    /// Computes the end of a neighbour's certificate anew, because the wall clock here was set.
    pub(crate) fn set_expiry(&mut self, now: Now, link: LinkId) {
        if let Some(state) = self.links.get_mut(&link) {
            state.set_expiry(now);
        }
    }

    /// Returns `true` if the neighbour may be told everything again now: at most once in [`TELL_AGAIN_EVERY`].
    pub(crate) fn may_tell_again(&mut self, now: Instant, link: LinkId) -> bool {
        let state = self.links.get_mut(&link).filter(|s| s.hello().is_some());
        state.is_some_and(|state| state.take_repeat(now, TELL_AGAIN_EVERY))
    }

    /// Returns the time at which the first certificate of a neighbour ends.
    pub(crate) fn next_expiry(&self) -> Option<Instant> {
        self.links.values().filter_map(Link::expires).min()
    }

    /// Returns the links of nodes whose certificates have ended.
    pub(crate) fn expired(&self, now: Instant) -> Vec<LinkId> {
        let is_over = |at: Instant| at <= now;
        self.iter().filter(|(_, s)| s.expires().is_some_and(is_over)).map(|(link, _)| link).collect()
    }

    /// Returns the links of nodes whose certificates are no longer believed.
    pub(crate) fn untrusted(&self, is_untrusted: impl Fn(&[CertId]) -> bool) -> Vec<LinkId> {
        let is_gone = |(link, state): &(LinkId, &Link)| *link != LinkId::LOCAL && is_untrusted(state.certs());
        self.iter().filter(is_gone).map(|(link, _)| link).collect()
    }
}

#[cfg(test)]
mod tests {
    use std::sync::Arc;

    use super::*;

    fn node(n: u8) -> NodeId {
        NodeId([n; 32])
    }

    fn hello(incarnation: u64, transit: bool, yields: bool) -> Hello {
        Hello { minor: 0, incarnation, transit, yields, started: UnixMillis(incarnation) }
    }

    /// Returns the links of node 0 to these nodes, numbered from 1; the cost of each is 1000 times its number.
    fn links(nodes: &[u8]) -> Links {
        #[allow(clippy::disallowed_methods)]
        let now = Now { instant: Instant::now(), unix: UnixMillis(0) };
        let mut links = Links::new(node(0), hello(0, false, false));
        for (link, n) in (1..).zip(nodes) {
            let neighbour = Neighbour {
                node: node(*n),
                certs: Arc::new([]),
                may_route: true,
                not_after: UnixMillis(60_000),
                cost: Some(1000 * link),
                direct: None,
            };
            links.add(now, LinkId(link), neighbour);
        }
        links
    }

    fn greet(links: &mut Links, link: u32, hello: Hello) -> Option<Greeting> {
        let peer = links.greet(LinkId(link), hello)?;
        Some(links.judge_greeting(LinkId(link), &peer.node, hello, || false))
    }

    #[test]
    fn later_run_takes_over_unless_it_yields() {
        let mut links = links(&[1, 1]);
        assert_eq!(greet(&mut links, 9, hello(1, true, false)), None);
        let first = greet(&mut links, 1, hello(1, true, false));
        assert_eq!(first, Some(Greeting::Stays { earlier: SmallVec::new() }));
        let earlier = EarlierRun { link: LinkId(1), alive: false };
        let second = greet(&mut links, 2, hello(2, true, false));
        assert_eq!(second, Some(Greeting::Stays { earlier: [earlier].into_iter().collect() }));
        let yielding = greet(&mut links, 2, hello(2, true, true));
        assert_eq!(yielding, Some(Greeting::GivesWay { to: Some(LinkId(1)) }));
        assert_eq!(links.runs_before(&node(1), 2)[..], [earlier]);
    }

    #[test]
    fn best_link_to_a_node_is_the_cheapest_that_greeted() {
        let mut links = links(&[1, 2, 1]);
        assert_eq!(links.best_to(&node(1)), None);
        for link in [1, 2, 3] {
            links.greet(LinkId(link), hello(link.into(), link != 2, false));
        }
        assert_eq!(links.best_to(&node(1)), Some((LinkId(3), 3000)), "about equal: the newest");
        assert_eq!(links.routers().collect::<Vec<_>>(), [LinkId(1), LinkId(3)]);
        let (routers, others) = links.neighbours();
        assert_eq!(routers, BTreeMap::from([(node(1), 1000)]));
        assert_eq!(others, BTreeSet::from([node(2).tag()]));
        assert!(links.remove(LinkId(3)).is_some() && links.remove(LinkId(3)).is_none());
        assert_eq!(links.best_to(&node(1)), Some((LinkId(1), 1000)));
    }

    #[test]
    fn node_has_no_link_to_itself_and_few_to_each_other_node() {
        let links = links(&[1, 1]);
        assert_eq!(links.refusal(&node(0), 3), Some(LinkClose::Loop));
        assert_eq!(links.refusal(&node(1), 2), Some(LinkClose::TooMany));
        assert_eq!(links.refusal(&node(1), 3), None);
    }
}
