//! [`FarConsumers`]: far subscribers, publishers and service clients that the local network shows, and the schedule of
//! announcing the local ones.

use std::any::Any;
use std::collections::{BTreeMap, BTreeSet};
use std::time::{Duration, Instant};

use sgc_ros::{AnnouncedPublishers, EndpointKind, EndpointSpec, Guid, ShownEndpoint, weakest};
use sgc_wire::{CONSUMERS_PER_INTERFACE_MAX, Consumer, Liveliness, Name, NodeId, Qos, Role, RosNode, SinkId};

use crate::control::event::ConsumerKey;

/// Delay for gathering changes of local consumers before owners are told.
const TELL_AFTER: Duration = Duration::from_millis(100);
/// Delay for gathering changes of far consumers before they are shown.
const SHOW_AFTER: Duration = Duration::from_millis(100);
/// Delay of a node's next announcement for each new consumer, since showing one informs all programs of the local
/// network.
const SHOW_EACH: Duration = Duration::from_millis(20);
/// Most nodes that are asked for their consumers.
const ASKED_NODES_MAX: usize = 64;
/// Most far consumers that are shown, of all nodes and interfaces.
const SHOWN_MAX: usize = 512;

/// The local endpoints that stand for a far consumer.
struct ShownConsumer {
    node: RosNode,
    ends: Vec<(EndpointKind, EndpointSpec)>,
    /// The endpoints; `None` while they are being created.
    endpoints: Option<Vec<(EndpointKind, ShownEndpoint)>>,
}

/// The consumers that a node announced.
struct PeerConsumers {
    /// `None` until the first announcement is applied, and after the node was lost.
    current: Option<Vec<Consumer>>,
    /// Its last announcement, until that is applied.
    next: Option<Vec<Consumer>>,
    /// Time at which it may be applied.
    ready_at: Instant,
}

impl PeerConsumers {
    fn consumers(&self) -> impl Iterator<Item = &Consumer> {
        self.current.iter().flatten()
    }
}

/// The sinks of a node at one share.
#[derive(Default)]
struct Sinks {
    granted: BTreeSet<SinkId>,
    /// Time until which a node without sinks still counts as granted.
    until: Option<Instant>,
}

/// The far consumers, and the schedule of announcing the local ones.
#[derive(Default)]
pub(crate) struct FarConsumers {
    /// Time at which owners are told of local consumers.
    tell_due: Option<Instant>,
    /// Time at which far consumers are shown.
    show_due: Option<Instant>,
    sinks: BTreeMap<NodeId, BTreeMap<(Name, Role), Sinks>>,
    asked: BTreeSet<NodeId>,
    told: BTreeMap<NodeId, PeerConsumers>,
    /// Unreachable nodes, and the time until which their consumers stay.
    lost: BTreeMap<NodeId, Instant>,
    shown: BTreeMap<ConsumerKey, ShownConsumer>,
    left_out: LeftOut,
}

/// Numbers of consumers without room at the last attempt.
#[derive(Default)]
struct LeftOut {
    /// Local consumers to announce.
    untold: u64,
    /// Far consumers to show.
    unshown: u64,
}

impl FarConsumers {
    pub(crate) fn sink_joined(&mut self, now: Instant, peer: NodeId, name: Name, sink: SinkId, role: Role) {
        let sinks = self.sinks.entry(peer).or_default().entry((name, role)).or_default();
        sinks.granted.insert(sink);
        sinks.until = None;
        self.show_soon(now);
    }

    /// Removes a sink. Its node still counts as granted until `until`, so that a restart of a router changes nothing.
    pub(crate) fn sink_left(&mut self, peer: NodeId, name: Name, sink: SinkId, until: Instant) {
        let of_peer = self.sinks.get_mut(&peer).into_iter().flatten();
        for (_, sinks) in of_peer.filter(|((of, _), _)| *of == name) {
            if sinks.granted.remove(&sink) && sinks.granted.is_empty() {
                sinks.until = Some(until);
            }
        }
    }

    pub(crate) fn deadline(&self) -> Option<Instant> {
        let left = self.sinks.values().flat_map(BTreeMap::values).filter_map(|sinks| sinks.until);
        let told = self.told.values().filter(|told| told.next.is_some()).map(|told| told.ready_at);
        left.chain(told).chain(self.lost.values().copied()).chain(self.tell_due).chain(self.show_due).min()
    }

    /// Stores a node's announcement. It is applied soon, or later if the node announced many new consumers.
    fn tell(&mut self, now: Instant, peer: NodeId, consumers: Vec<Consumer>) {
        let soon = now + SHOW_AFTER;
        let new = || PeerConsumers { current: None, next: None, ready_at: soon };
        let told = self.told.entry(peer).or_insert_with(new);
        if told.next.replace(consumers).is_none() {
            told.ready_at = told.ready_at.max(soon);
        }
    }

    /// Applies the announcements that are due. Returns `true` if there was one.
    fn take_over(&mut self, now: Instant) -> bool {
        let mut took = false;
        for told in self.told.values_mut().filter(|told| told.ready_at <= now) {
            let Some(next) = told.next.take() else { continue };
            let is_new = |consumer: &&Consumer| !told.consumers().any(|known| known.is_shown_as(consumer));
            let added = next.iter().filter(is_new).count();
            told.ready_at = now + SHOW_EACH * u32::try_from(added).unwrap_or(u32::MAX);
            told.current = Some(next);
            took = true;
        }
        took
    }

    pub(crate) fn show_soon(&mut self, now: Instant) {
        self.show_due.get_or_insert(now + SHOW_AFTER);
    }

    /// Removes and returns the endpoints of all shown consumers.
    pub(crate) fn take_shown(&mut self) -> Vec<Box<dyn Any + Send>> {
        let shown = std::mem::take(&mut self.shown).into_values();
        shown.filter_map(|shown| Some(Box::new(shown.endpoints?) as _)).collect()
    }

    /// Returns the type hashes that a share's far subscribers or clients announce, with their SGC nodes.
    pub(crate) fn hashes(&self, interface: Name, role: Role) -> impl Iterator<Item = (NodeId, &str)> {
        let of = (interface, role);
        self.told
            .iter()
            .filter(move |(peer, _)| self.sinks.get(peer).is_some_and(|granted| granted.contains_key(&of)))
            .flat_map(move |(peer, told)| {
                let is_it = move |consumer: &&Consumer| (consumer.interface, consumer.role) == of;
                let of_it = told.consumers().filter(is_it);
                of_it.filter_map(|consumer| consumer.type_hash.as_deref()).map(|hash| (*peer, hash))
            })
    }

    /// Returns the publishers of other nodes on each share, as their nodes announced them.
    pub(crate) fn publishers(&self) -> BTreeMap<Name, AnnouncedPublishers> {
        let mut by_name = BTreeMap::<Name, (Vec<&Consumer>, bool)>::new();
        for (peer, names) in &self.sinks {
            let is_joined = |((_, role), sinks): &(&(Name, Role), &Sinks)| {
                *role == Role::Publish && !sinks.granted.is_empty()
            };
            for ((name, _), _) in names.iter().filter(is_joined) {
                let (publishers, is_unsaid) = by_name.entry(*name).or_default();
                let told = self.told.get(peer).filter(|told| told.current.is_some());
                *is_unsaid |= told.is_none();
                let is_it = |one: &&Consumer| (one.interface, one.role) == (*name, Role::Publish);
                publishers.extend(told.into_iter().flat_map(PeerConsumers::consumers).filter(is_it));
            }
        }
        let announced = by_name.into_iter().map(|(name, (publishers, is_unsaid))| {
            let (offer, is_one_alive) = combined(&publishers);
            (name, AnnouncedPublishers { offer, may_live: is_unsaid || is_one_alive })
        });
        announced.collect()
    }

    /// Forgets expired entries. Returns `true` if there was one.
    fn forget(&mut self, now: Instant) -> bool {
        let mut forgot = false;
        let mut is_over = |until: Option<Instant>| {
            let is_over = until.is_some_and(|until| until <= now);
            forgot |= is_over;
            is_over
        };
        self.lost.retain(|peer, until| {
            let is_over = is_over(Some(*until));
            if is_over && let Some(told) = self.told.get_mut(peer) {
                // The pace is kept, since the node may return at once.
                (told.current, told.next) = (None, None);
            }
            !is_over
        });
        for names in self.sinks.values_mut() {
            names.retain(|_, sinks| !is_over(sinks.until));
        }
        self.sinks.retain(|_, names| !names.is_empty());
        forgot
    }

    /// Returns the consumers to show, and the number without room. All nodes have the same share of places.
    pub(crate) fn wanted(&self) -> (BTreeMap<ConsumerKey, &Consumer>, u64) {
        let (mut ranked, mut left_out) = (Vec::new(), 0);
        for (peer, told) in &self.told {
            let Some(granted) = self.sinks.get(peer) else { continue };
            let mut of_interface = BTreeMap::<Name, usize>::new();
            let is_granted =
                |consumer: &&Consumer| granted.contains_key(&(consumer.interface, consumer.role));
            let mut rank = 0;
            for consumer in told.consumers().filter(is_granted) {
                let known = of_interface.entry(consumer.interface).or_default();
                if *known >= CONSUMERS_PER_INTERFACE_MAX {
                    left_out += 1;
                    continue;
                }
                *known += 1;
                let key = ConsumerKey { interface: consumer.interface, peer: *peer, id: consumer.id };
                ranked.push((rank, key, consumer));
                rank += 1;
            }
        }
        ranked.sort_by_key(|(rank, key, _)| (*rank, *key));
        left_out += ranked.len().saturating_sub(SHOWN_MAX) as u64;
        ranked.truncate(SHOWN_MAX);
        (ranked.into_iter().map(|(_, key, consumer)| (key, consumer)).collect(), left_out)
    }
}

/// Changes of the nodes that are asked for their consumers.
#[derive(Default)]
pub(crate) struct AskChanges {
    /// Nodes that are asked no longer.
    pub(crate) leave: Vec<NodeId>,
    /// Nodes that are asked from here on.
    pub(crate) ask: Vec<NodeId>,
}

/// Endpoints of a consumer, and the kind of each.
pub(crate) type ConsumerEndpoints = Vec<(EndpointKind, ShownEndpoint)>;
/// Ids of a consumer's endpoints, and the kind of each.
pub(crate) type EndpointIds = Vec<(EndpointKind, Guid)>;
/// The endpoints that are wanted for a consumer.
pub(crate) type ConsumerSpecs = Vec<(EndpointKind, EndpointSpec)>;

/// Changes of the far consumers that are shown.
#[derive(Default)]
pub(crate) struct ShowChanges {
    /// Consumers that are gone, with their endpoints.
    pub(crate) gone: Vec<(ConsumerKey, Option<ConsumerEndpoints>)>,
    /// Shown consumers of which the node changed, with the ids of their endpoints.
    pub(crate) moved: Vec<(ConsumerKey, RosNode, EndpointIds)>,
    /// Consumers to show.
    pub(crate) fresh: Vec<(ConsumerKey, ConsumerSpecs)>,
}

/// Decision about created endpoints.
pub(crate) enum MadeEndpoints {
    /// They stand for a consumer of this node. Their ids follow.
    Shown(RosNode, EndpointIds),
    /// The consumer has changed meanwhile.
    Unwanted(ConsumerEndpoints),
}

/// The schedule, and the endpoints.
impl FarConsumers {
    /// Schedules an announcement of local consumers.
    pub(crate) fn tell_soon(&mut self) {
        self.tell_due.get_or_insert_with(|| Instant::now() + TELL_AFTER);
    }

    /// Returns `true` once if the announcement is due.
    pub(crate) fn take_tell_due(&mut self, now: Instant) -> bool {
        self.tell_due.take_if(|at| *at <= now).is_some()
    }

    /// Applies everything that is due. Returns `true` if far consumers may have changed.
    pub(crate) fn take_changes(&mut self, now: Instant) -> bool {
        let is_due = self.show_due.take_if(|at| *at <= now).is_some();
        let took_over = self.take_over(now);
        self.forget(now) || took_over || is_due
    }

    /// Handles a node's announcement, if the node was asked for it.
    pub(crate) fn peer_told(&mut self, now: Instant, peer: NodeId, consumers: Vec<Consumer>) {
        if self.asked.contains(&peer) {
            self.lost.remove(&peer);
            self.tell(now, peer, consumers);
        }
    }

    /// Handles that a node announces nothing more. Its consumers stay until `until`.
    pub(crate) fn peer_lost(&mut self, peer: NodeId, until: Instant) {
        if self.asked.contains(&peer) {
            self.lost.entry(peer).or_insert(until);
        }
    }

    /// Asks the granted nodes other than `own`, and no others. Without a graph to show, it asks no more nodes.
    pub(crate) fn ask(&mut self, has_graph: bool, own: NodeId) -> AskChanges {
        let leave: Vec<_> =
            self.asked.iter().filter(|peer| !self.sinks.contains_key(peer)).copied().collect();
        for peer in &leave {
            self.asked.remove(peer);
            self.told.remove(peer);
            self.lost.remove(peer);
        }
        let mut ask = Vec::new();
        for peer in self.sinks.keys().filter(|peer| has_graph && **peer != own) {
            if self.asked.len() < ASKED_NODES_MAX && self.asked.insert(*peer) {
                ask.push(*peer);
            }
        }
        AskChanges { leave, ask }
    }

    /// Replaces the consumers that are shown.
    pub(crate) fn show(&mut self, wanted: BTreeMap<ConsumerKey, (RosNode, ConsumerSpecs)>) -> ShowChanges {
        let mut changes = ShowChanges::default();
        let is_gone = |key: &ConsumerKey, shown: &ShownConsumer| {
            wanted.get(key).is_none_or(|(_, ends)| *ends != shown.ends)
        };
        let gone: Vec<_> =
            self.shown.iter().filter(|(key, shown)| is_gone(key, shown)).map(|(key, _)| *key).collect();
        for key in gone {
            changes.gone.push((key, self.shown.remove(&key).and_then(|shown| shown.endpoints)));
        }
        for (key, (node, ends)) in wanted {
            if let Some(shown) = self.shown.get_mut(&key) {
                if std::mem::replace(&mut shown.node, node.clone()) != node
                    && let Some(endpoints) = &shown.endpoints
                {
                    changes.moved.push((key, node, guids(endpoints)));
                }
                continue;
            }
            self.shown.insert(key, ShownConsumer { node, ends: ends.clone(), endpoints: None });
            changes.fresh.push((key, ends));
        }
        changes
    }

    /// Handles new endpoints of a consumer, which may have changed meanwhile.
    pub(crate) fn made(
        &mut self,
        key: &ConsumerKey,
        ends: &ConsumerSpecs,
        made: ConsumerEndpoints,
    ) -> MadeEndpoints {
        match self.shown.get_mut(key) {
            Some(shown) if shown.ends == *ends && shown.endpoints.is_none() => {
                let ids = guids(&made);
                shown.endpoints = Some(made);
                MadeEndpoints::Shown(shown.node.clone(), ids)
            }
            _ => MadeEndpoints::Unwanted(made),
        }
    }

    /// Notes the number of local consumers without room, and returns its increase.
    pub(crate) fn more_untold(&mut self, left_out: u64) -> u64 {
        left_out.saturating_sub(std::mem::replace(&mut self.left_out.untold, left_out))
    }

    /// Notes the number of far consumers without room, and returns its increase.
    pub(crate) fn more_unshown(&mut self, left_out: u64) -> u64 {
        left_out.saturating_sub(std::mem::replace(&mut self.left_out.unshown, left_out))
    }
}

/// Returns the weakest offer of the publishers that may be alive, and `true`; or that of all, and `false`. A publisher
/// that is manual by topic may be, since it can assert that without being heard, if its far writer expires by itself.
fn combined(publishers: &[&Consumer]) -> (Option<Qos>, bool) {
    let is_manual = |qos: &Qos| qos.liveliness == Liveliness::ManualByTopic;
    let weakest_of = |is_it: &dyn Fn(&Consumer) -> bool| {
        weakest(publishers.iter().filter(|one| is_it(one)).map(|one| &one.qos))
    };
    let expiring = weakest_of(&|one| one.is_alive || is_manual(&one.qos)).filter(is_manual);
    let living = expiring.or_else(|| weakest_of(&|one| one.is_alive));
    let is_one_alive = living.is_some();
    (living.or_else(|| weakest_of(&|_| true)), is_one_alive)
}

fn guids(endpoints: &[(EndpointKind, ShownEndpoint)]) -> EndpointIds {
    endpoints.iter().map(|(kind, endpoint)| (*kind, endpoint.guid)).collect()
}

#[cfg(test)]
mod tests {
    use sgc_wire::CONSUMERS_MAX;

    use super::*;

    /// Returns other consumers at each call, as many as a node may announce.
    fn all_places(telling: u8) -> Vec<Consumer> {
        let node = RosNode::new("/", "view", None).unwrap();
        let consumer = |n: usize| {
            let interface = Name([(n / CONSUMERS_PER_INTERFACE_MAX) as u8; 32]);
            let mut id = [telling; 8];
            id[..2].copy_from_slice(&(n as u16).to_be_bytes());
            Consumer {
                interface,
                id,
                role: Role::Subscribe,
                is_alive: true,
                node: node.clone(),
                type_hash: None,
                qos: Qos::default(),
            }
        };
        (0..CONSUMERS_MAX).map(consumer).collect()
    }

    fn granted_all(consumers: &mut FarConsumers, now: Instant, peer: NodeId) {
        for consumer in all_places(0) {
            consumers.sink_joined(now, peer, consumer.interface, SinkId([0; 16]), Role::Subscribe);
        }
    }

    #[test]
    fn node_that_tells_others_all_the_time_is_shown_at_a_bounded_pace() {
        let (mut consumers, start, peer) = (FarConsumers::default(), Instant::now(), NodeId([1; 32]));
        granted_all(&mut consumers, start, peer);
        let mut shown = BTreeSet::new();
        let (mut made, lasts) = (0, Duration::from_secs(60));
        for n in 0..600_u32 {
            let now = start + n * lasts / 600;
            consumers.tell(now, peer, all_places(n as u8));
            if consumers.take_over(now) {
                let wanted: BTreeSet<_> = consumers.wanted().0.into_keys().collect();
                made += wanted.difference(&shown).count();
                shown = wanted;
                // A node that withdraws its consumers does not start over.
                consumers.lost.insert(peer, now);
                assert!(consumers.forget(now));
                consumers.lost.clear();
            }
        }
        let bound = (lasts.as_millis() / SHOW_EACH.as_millis()) as usize + CONSUMERS_MAX;
        assert!((CONSUMERS_MAX..=bound).contains(&made), "{made} made, {bound} may be");
    }

    #[test]
    fn change_of_one_consumer_is_shown_without_delay() {
        let (mut consumers, start, peer) = (FarConsumers::default(), Instant::now(), NodeId([1; 32]));
        // Nothing is granted yet; a grant alone would cause a change soon.
        for n in 0..20_u8 {
            let now = start + u32::from(n) * 2 * SHOW_AFTER;
            consumers.tell(now, peer, all_places(n).into_iter().take(1).collect());
            assert!(!consumers.take_over(now), "changes are gathered");
            assert_eq!(consumers.deadline(), Some(now + SHOW_AFTER));
            assert!(consumers.take_over(now + SHOW_AFTER));
        }
    }

    #[test]
    fn node_with_many_consumers_leaves_places_to_others() {
        let (mut consumers, now) = (FarConsumers::default(), Instant::now());
        let peers = [NodeId([1; 32]), NodeId([2; 32])];
        for (peer, count) in peers.into_iter().zip([CONSUMERS_MAX, 1]) {
            granted_all(&mut consumers, now, peer);
            consumers.tell(now, peer, all_places(0).into_iter().take(count).collect());
        }
        assert!(consumers.take_over(now + SHOW_AFTER));
        let (wanted, left_out) = consumers.wanted();
        assert_eq!((wanted.len(), left_out), (SHOWN_MAX, 1));
        assert!(wanted.keys().any(|key| key.peer == peers[1]));
    }

    /// A share with publishers at other nodes, and what these nodes say of them.
    struct Publishers {
        far: FarConsumers,
        now: Instant,
    }

    const SHARE: Name = Name([2; 32]);

    fn publisher(lease_ns: u64, liveliness: Liveliness, is_alive: bool) -> Consumer {
        let (id, node) = (lease_ns.to_be_bytes(), RosNode::new("/", "teleop", None).unwrap());
        let qos = Qos { lease_ns: Some(lease_ns), liveliness, ..Qos::default() };
        Consumer { interface: SHARE, id, role: Role::Publish, is_alive, node, type_hash: None, qos }
    }

    impl Publishers {
        fn join(&mut self, peer: u8, role: Role) {
            self.far.sink_joined(self.now, NodeId([peer; 32]), SHARE, SinkId([peer; 16]), role);
            self.far.ask(true, NodeId([0; 32]));
        }

        fn passes(&mut self, time: Duration) -> (Option<u64>, bool) {
            self.now += time;
            self.far.take_changes(self.now);
            let AnnouncedPublishers { offer, may_live } = self.far.publishers().remove(&SHARE).unwrap();
            (offer.and_then(|offer| offer.lease_ns), may_live)
        }

        fn tell(&mut self, peer: u8, publishers: Vec<Consumer>) -> (Option<u64>, bool) {
            self.far.peer_told(self.now, NodeId([peer; 32]), publishers);
            self.passes(SHOW_AFTER + SHOW_EACH)
        }
    }

    #[test]
    fn publishers_of_a_share_may_live_until_all_nodes_have_said_that_theirs_do_not() {
        let automatic = |lease_ns, is_alive| publisher(lease_ns, Liveliness::Automatic, is_alive);
        let mut p = Publishers { far: FarConsumers::default(), now: Instant::now() };
        p.join(1, Role::Publish);
        assert_eq!(p.passes(SHOW_AFTER), (None, true), "it said nothing yet");
        p.far.peer_told(p.now, NodeId([1; 32]), vec![automatic(5, true)]);
        assert_eq!(p.passes(SHOW_AFTER / 2), (None, true), "that is not taken over yet");
        assert_eq!(p.passes(SHOW_AFTER), (Some(5), true));
        p.join(2, Role::Publish);
        assert_eq!(p.tell(1, vec![automatic(5, false)]), (Some(5), true), "the other one said nothing");
        assert_eq!(p.tell(2, vec![]), (Some(5), false));
        assert_eq!(p.tell(2, vec![automatic(3, true)]), (Some(3), true), "those that are gone offer nothing");
        assert_eq!(p.tell(2, vec![automatic(3, false)]), (Some(5), false));
        assert_eq!(p.tell(1, vec![]), (Some(3), false));
        // A subscriber's word is none about publishers.
        p.join(3, Role::Subscribe);
        assert_eq!(p.passes(SHOW_AFTER), (Some(3), false));
        // A node that is lost says nothing any more. One that left does not count, though it is shown for a while.
        assert_eq!(p.tell(1, vec![automatic(7, true)]), (Some(7), true));
        p.far.sink_left(NodeId([1; 32]), SHARE, SinkId([1; 16]), p.now + Duration::from_secs(10));
        assert_eq!(p.passes(SHOW_AFTER), (Some(3), false));
        p.far.peer_lost(NodeId([2; 32]), p.now);
        assert_eq!(p.passes(SHOW_AFTER), (None, true));
    }

    #[test]
    fn publisher_that_is_manual_by_topic_may_live_while_its_far_writer_expires_by_itself() {
        let mut p = Publishers { far: FarConsumers::default(), now: Instant::now() };
        p.join(1, Role::Publish);
        let manual = publisher(5, Liveliness::ManualByTopic, false);
        let automatic = |is_alive| publisher(9, Liveliness::Automatic, is_alive);
        assert_eq!(p.tell(1, vec![manual.clone()]), (Some(5), true));
        assert_eq!(p.tell(1, vec![manual.clone(), automatic(true)]), (Some(9), true));
        assert_eq!(p.tell(1, vec![manual, automatic(false)]), (Some(5), true));
    }

    #[test]
    fn consumers_are_shown_in_a_role_that_their_node_was_granted() {
        let (peer, interface, now) = (NodeId([1; 32]), Name([2; 32]), Instant::now());
        let consumer = |role| Consumer {
            interface,
            id: [role as u8; 8],
            role,
            is_alive: true,
            node: RosNode::new("/", "teleop", None).unwrap(),
            type_hash: None,
            qos: Qos::default(),
        };
        let mut far = FarConsumers::default();
        far.tell(now, peer, [Role::Subscribe, Role::Publish].map(consumer).into());
        assert!(far.take_over(now + SHOW_AFTER));
        let wanted = |far: &FarConsumers| far.wanted().0.values().map(|one| one.role).collect::<Vec<_>>();
        assert_eq!(wanted(&far), []);
        far.sink_joined(now, peer, interface, SinkId([3; 16]), Role::Subscribe);
        assert_eq!(wanted(&far), [Role::Subscribe]);
        far.sink_joined(now, peer, interface, SinkId([4; 16]), Role::Publish);
        assert_eq!(wanted(&far), [Role::Subscribe, Role::Publish]);
        far.sink_left(peer, interface, SinkId([4; 16]), now);
        assert!(far.forget(now));
        assert_eq!(wanted(&far), [Role::Subscribe]);
    }
}
