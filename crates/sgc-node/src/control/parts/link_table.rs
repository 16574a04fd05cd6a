//! [`LinkTable`]: the links of this node with their keep-alive, their queues of packets, and the reasons for which this
//! node closes them.
//!
//! The router machine decides which links a name uses and which links end. [`sgc_session::KeepAlive`] decides when to
//! probe a peer. The looks measure links, so that the router machine can weigh them and leave silent ones before they
//! time out.

use std::collections::{BTreeMap, HashMap};
use std::net::SocketAddr;
use std::sync::Arc;
use std::time::{Duration, Instant};

use sgc_router::{LinkId, LinkQuality};
use sgc_session::{KeepAlive, KeepAlivePolicy, LinkObservation, is_of_host};
use sgc_transport::{AnyLink, CloseReason, Link, LinkStats};
use sgc_trust::VerifiedPeer;
use sgc_wire::{Control, Name, NodeId};
use tracing::info;

use crate::control::peers::peer_policies::PeerPolicies;
use crate::data::dataplane::Out;
use crate::data::outflow::OutFlow;
use crate::data::stats::CountDrops;
use crate::link::control_tx::ControlTx;
use crate::state::audit::PeerNames;

/// Interval of looks at the links.
const LOOK_EVERY: Duration = Duration::from_millis(500);

/// A link that is up.
pub(crate) struct LinkEntry {
    link: AnyLink,
    url: Option<String>,
    control: ControlTx,
    flows: HashMap<Name, Arc<OutFlow>>,
    /// Reason, if this node closed it.
    closed_for: Option<String>,
    keep_alive: KeepAlive,
    /// The address that the peer was told to come from.
    told: Option<SocketAddr>,
    /// The address from which this node comes, as the peer sees it.
    observed: Option<SocketAddr>,
}

/// All links that are up.
pub(crate) struct LinkTable {
    links: BTreeMap<LinkId, LinkEntry>,
    /// Number of the next link.
    next: u32,
    /// Time of the next look at the links; `None` while there are none.
    look_due: Option<Instant>,
    policies: PeerPolicies,
    names: PeerNames,
    /// Counts the packets that queues leave out.
    drops: Arc<dyn CountDrops>,
    /// Bytes that were sent and received over links that have ended.
    ended_bytes: (u64, u64),
}

/// A link that was removed.
pub(crate) struct EndedLink {
    pub(crate) node: NodeId,
    pub(crate) remote: SocketAddr,
    /// Reason, if this node closed it.
    pub(crate) closed_for: Option<String>,
}

impl LinkTable {
    /// Creates the table without links. New links use the keep-alive policy.
    pub(crate) fn new(policy: KeepAlivePolicy, names: PeerNames, drops: Arc<dyn CountDrops>) -> Self {
        let policies = PeerPolicies::new(policy);
        Self { links: BTreeMap::new(), next: 1, look_due: None, policies, names, drops, ended_bytes: (0, 0) }
    }

    /// Adds a link, and looks at it from here on.
    pub(crate) fn add(
        &mut self,
        now: Instant,
        link: AnyLink,
        url: Option<String>,
        control: ControlTx,
    ) -> LinkId {
        let id = LinkId(self.next);
        self.next += 1;
        let policy = self.policies.for_peer(&link.peer().node_id);
        let keep_alive = KeepAlive::new(now, policy, link.stats().received_bytes, link.remote());
        let (flows, closed_for, told, observed) = (HashMap::new(), None, None, None);
        self.links
            .insert(id, LinkEntry { link, url, control, flows, closed_for, keep_alive, told, observed });
        self.look_due.get_or_insert(now + LOOK_EVERY);
        id
    }

    /// Notes that a link is direct.
    pub(crate) fn set_direct(&mut self, id: LinkId) {
        if let Some(entry) = self.links.get_mut(&id) {
            entry.keep_alive.set_direct();
        }
    }

    /// Removes a link and closes its queues.
    pub(crate) fn remove(&mut self, id: LinkId) -> Option<EndedLink> {
        let entry = self.links.remove(&id)?;
        let (node, remote) = (entry.peer().node_id, entry.remote());
        self.ended_bytes = entry.stats().added_to(self.ended_bytes);
        self.policies.remember(node, entry.keep_alive.policy());
        entry.flows.values().for_each(|flow| flow.close());
        Some(EndedLink { node, remote, closed_for: entry.closed_for })
    }

    /// Returns the number of links since the start.
    pub(crate) fn established(&self) -> u64 {
        u64::from(self.next) - 1
    }

    /// Returns the numbers of bytes that were sent and received over all links since the start.
    pub(crate) fn total_bytes(&self) -> (u64, u64) {
        self.links.values().fold(self.ended_bytes, |total, entry| entry.stats().added_to(total))
    }

    pub(crate) fn get(&self, id: LinkId) -> Option<&LinkEntry> {
        self.links.get(&id)
    }

    pub(crate) fn iter(&self) -> impl Iterator<Item = (LinkId, &LinkEntry)> {
        self.links.iter().map(|(id, entry)| (*id, entry))
    }

    /// Queues a frame of the router machine. Returns `false` if the peer is too far behind.
    pub(crate) fn send(&mut self, id: LinkId, frame: Control) -> bool {
        let Some(entry) = self.links.get_mut(&id) else { return true };
        entry.keep_alive.stir();
        entry.control.send(frame)
    }

    /// Queues a flush. Returns `false` if the peer is too far behind.
    pub(crate) fn flush(&self, id: LinkId) -> bool {
        self.links.get(&id).is_none_or(|entry| entry.control.flush())
    }

    /// Closes a link. The record of its end shows the reason as `because`.
    pub(crate) fn close(&mut self, id: LinkId, because: String, reason: CloseReason) {
        if let Some(entry) = self.links.get_mut(&id) {
            entry.closed_for = Some(because);
            entry.link.close(reason);
        }
    }

    /// Looks at all links, if that is due: probes peers, and closes links whose peer does not answer.
    pub(crate) fn look(&mut self, now: Instant) -> Vec<(LinkId, LinkQuality)> {
        if self.look_due.is_none_or(|due| due > now) {
            return Vec::new();
        }
        self.look_due = (!self.links.is_empty()).then_some(now + LOOK_EVERY);
        let looks = self.links.iter_mut().map(|(id, entry)| {
            let stats = entry.link.stats();
            entry.control.lanes().look(now, &stats);
            let is_silent = entry.look(now, stats.received_bytes, stats.rtt, &self.names);
            let LinkStats { rtt, sent_packets, lost_packets, .. } = stats;
            (*id, LinkQuality { round_trip: rtt, is_silent, sent_packets, lost_packets })
        });
        looks.collect()
    }

    /// Tells the peer that dialled a link from which address it comes, once for each address.
    pub(crate) fn tell_address(&mut self, id: LinkId) {
        let Some(entry) = self.links.get_mut(&id).filter(|entry| entry.url.is_none()) else { return };
        let remote = entry.link.remote();
        // An address that a full queue does not take is told at the next look.
        if entry.told != Some(remote) && entry.control.send(Control::ObservedAddress { place: remote.into() })
        {
            entry.told = Some(remote);
        }
    }

    /// Notes from which address this node comes, as the peer sees it. Returns `false` if the peer is none that this node
    /// dialled, or the address is none of a host.
    pub(crate) fn observe_address(&mut self, id: LinkId, address: SocketAddr) -> bool {
        let entry = self.links.get_mut(&id).filter(|entry| entry.url.is_some() && is_of_host(&address));
        entry.map(|entry| entry.observed = Some(address)).is_some()
    }

    /// Returns the time of the next look.
    pub(crate) fn deadline(&self) -> Option<Instant> {
        self.look_due
    }

    /// Returns the destination of packets of a name on a link. Its queue is created if there is none, and leaves out
    /// best-effort messages older than `max_age`.
    pub(crate) fn out(&mut self, id: LinkId, name: Name, max_age: Duration) -> Option<Out> {
        let LinkEntry { link, control, flows, .. } = self.links.get_mut(&id)?;
        let drops = &self.drops;
        let begin = || {
            let lanes = control.lanes().clone();
            OutFlow::spawn(link.clone(), name, control.label(name), lanes, max_age, drops.clone())
        };
        let flow = flows.entry(name).or_insert_with(begin).clone();
        Some(Out::Link(flow, control.activity().clone()))
    }

    /// Closes the queues of a name, except on the links to keep. Queued packets are still sent.
    pub(crate) fn end_flows(&mut self, name: &Name, keep: &[LinkId]) {
        for (id, entry) in &mut self.links {
            if !keep.contains(id)
                && let Some(flow) = entry.flows.remove(name)
            {
                flow.close();
            }
        }
    }

    /// Closes all queues, and returns them. Queued packets are still sent.
    pub(crate) fn close_flows(&self) -> Vec<Arc<OutFlow>> {
        let flows: Vec<_> = self.links.values().flat_map(|entry| entry.flows.values().cloned()).collect();
        flows.iter().for_each(|flow| flow.close());
        flows
    }

    /// Sets on which links a name has a lane of its own.
    pub(crate) fn set_lanes(&self, name: Name, is_wanted: impl Fn(LinkId) -> bool) {
        for (id, entry) in &self.links {
            entry.control.lanes().set_wanted(name, is_wanted(*id));
        }
    }

    /// Says goodbye on all links, and returns them.
    pub(crate) fn say_goodbye(&self) -> Vec<AnyLink> {
        let leave = |entry: &LinkEntry| {
            entry.control.send(Control::Goodbye);
            entry.link.clone()
        };
        self.links.values().map(leave).collect()
    }
}

impl LinkEntry {
    pub(crate) fn peer(&self) -> &VerifiedPeer {
        self.link.peer()
    }

    pub(crate) fn remote(&self) -> SocketAddr {
        self.link.remote()
    }

    /// Returns the URL that this node dialled; `None` if the peer dialled.
    pub(crate) fn url(&self) -> Option<&str> {
        self.url.as_deref()
    }

    /// Returns the address from which this node comes, as the peer that it dialled says.
    pub(crate) fn observed(&self) -> Option<SocketAddr> {
        self.observed
    }

    /// Returns `true` if that is the address from which direct links of this node come, too.
    pub(crate) fn uses_direct_socket(&self) -> bool {
        self.link.uses_direct_socket()
    }

    /// Returns the measurements of the link, with the bytes of its lanes.
    pub(crate) fn stats(&self) -> LinkStats {
        let (stats, (sent, received)) = (self.link.stats(), self.control.lanes().bytes());
        LinkStats {
            sent_bytes: stats.sent_bytes.saturating_add(sent),
            received_bytes: stats.received_bytes.saturating_add(received),
            ..stats
        }
    }

    /// Returns the present interval of the keep-alive.
    pub(crate) fn keep_alive_interval(&self) -> Duration {
        self.keep_alive.step()
    }

    /// Returns the numbers of lanes: all, and bulk lanes of these.
    pub(crate) fn lanes(&self) -> (usize, usize) {
        self.control.lanes().count()
    }

    /// Returns the number of labels that the peer knows.
    pub(crate) fn labels_sent(&self) -> u32 {
        self.control.labels_known()
    }

    /// Returns the number of labels that the peer defined.
    pub(crate) fn labels_received(&self) -> u32 {
        self.link.labels_defined()
    }

    /// Queues a frame that calls for no answer. If the queue is full, the link closes for that reason elsewhere.
    pub(crate) fn notify(&self, frame: Control) {
        self.control.send(frame);
    }

    /// Closes the link because the peer does not take its frames.
    pub(crate) fn close_overloaded(&self) {
        self.link.close(CloseReason::Overloaded);
    }

    /// Looks at a link, and probes the peer or marks it silent if needed. Returns `true` if the link seems dead.
    fn look(&mut self, now: Instant, received_bytes: u64, rtt: Duration, names: &PeerNames) -> bool {
        let (activity, remote) = (self.control.activity(), self.link.remote());
        let verdict = self.keep_alive.look(now, LinkObservation { received_bytes, activity, remote, rtt });
        if verdict.asks {
            // A full queue means that the peer takes nothing, which is detected elsewhere.
            self.control.send(Control::Probe { answers: false });
        }
        if verdict.is_dead() && self.closed_for.is_none() {
            let peer = names.called(&self.link.peer().node_id);
            info!(%remote, peer, "the peer does not answer; its link is closed");
            self.closed_for = Some(CloseReason::Silent.to_string());
            self.link.close(CloseReason::Silent);
        }
        verdict.is_silent()
    }
}

#[cfg(test)]
mod tests {
    use bytes::Bytes;
    use rand_core::{OsRng, TryRngCore as _};
    use sgc_transport::{CredentialStore, Dialer, LinkOptions, LinkUrl, Listener};
    use sgc_trust::{EnrollRequest, Fleet};
    use sgc_wire::{Class, HOP_LIMIT, Packet, PacketHeader, SourceId};
    use tokio::sync::mpsc;

    use super::*;
    use crate::clock;
    use crate::control::peers::control_queue::{CONTROL_FRAMES_MAX, ControlQueue, Outgoing};
    use crate::data::dataplane::DataPlane;
    use crate::data::labels::LabelBook;
    use crate::data::outflow::OUTFLOW_AGE_MAX;
    use crate::link::lanes::{LaneAdmission, Lanes};

    const NAME: Name = Name([1; 32]);
    const OTHER: Name = Name([2; 32]);

    /// Two nodes with links between them.
    struct Bench {
        dialer: Dialer,
        listener: Listener,
        url: LinkUrl,
        /// The node at the other end.
        dialled: NodeId,
        /// The far ends of the links.
        far: Vec<AnyLink>,
        table: LinkTable,
        data: Arc<DataPlane>,
    }

    impl Bench {
        fn new() -> Self {
            let rng = &mut OsRng.unwrap_err();
            let now = clock::now().unix;
            let fleet = Fleet::create("lab".parse().unwrap(), now, rng).unwrap();
            let mut enroll = |node: &str| {
                let request = EnrollRequest::new(node.parse().unwrap(), now);
                CredentialStore::new(Arc::new(fleet.issue(&request, rng).unwrap()))
            };
            let (arm, cloud) = (enroll("arm"), enroll("cloud"));
            let dialled = cloud.identity().node_id();
            let addr = "quic://127.0.0.1:0".parse().unwrap();
            let listener = Listener::bind(&addr, cloud, LinkOptions::default(), Arc::default()).unwrap();
            let url = listener.local().to_string().parse().unwrap();
            let dialer = Dialer::new(arm, LinkOptions::default(), Arc::default());
            let data = Arc::<DataPlane>::default();
            let table = LinkTable::new(KeepAlivePolicy::default(), PeerNames::default(), data.clone());
            Self { dialer, listener, url, dialled, far: Vec::new(), table, data }
        }

        /// Adds a link. Returns its number and its control frames.
        async fn add(&mut self, now: Instant) -> (LinkId, mpsc::Receiver<Outgoing>) {
            let (near, far) = tokio::join!(self.dialer.dial(&self.url), self.listener.accept());
            let near = near.unwrap();
            self.far.push(far.unwrap().unwrap());
            let (frames, outgoing) = ControlQueue::new();
            let lanes = Lanes::new(near.clone(), frames.clone(), None, LaneAdmission::default());
            let control = ControlTx::new(frames, LabelBook::new(Arc::default()), Arc::default(), lanes);
            (self.table.add(now, near, Some(self.url.to_string()), control), outgoing)
        }
    }

    #[tokio::test]
    async fn number_of_a_link_is_never_used_again() {
        let (mut bench, now) = (Bench::new(), Instant::now());
        let (first, _frames) = bench.add(now).await;
        let remote = bench.table.get(first).unwrap().remote();
        let ended = bench.table.remove(first).unwrap();
        assert_eq!((ended.node, ended.remote), (bench.dialled, remote));
        assert!(bench.table.remove(first).is_none() && bench.table.get(first).is_none());
        let (second, _frames) = bench.add(now).await;
        assert_eq!((first, second), (LinkId(1), LinkId(2)));
        assert_eq!(bench.table.iter().map(|(id, _)| id).collect::<Vec<_>>(), [second]);
    }

    #[tokio::test]
    async fn reason_of_an_end_is_that_for_which_this_node_closed_the_link() {
        let (mut bench, now) = (Bench::new(), Instant::now());
        let (closed, _frames) = bench.add(now).await;
        let (lost, _frames) = bench.add(now).await;
        bench.table.close(closed, "revoked here".into(), CloseReason::Revoked);
        bench.table.close(LinkId(9), "there is none".into(), CloseReason::Revoked);
        assert_eq!(bench.table.remove(closed).unwrap().closed_for.as_deref(), Some("revoked here"));
        assert_eq!(bench.table.remove(lost).unwrap().closed_for, None);
        assert!(bench.far[0].recv_control().await.is_err(), "the far end hears of it");
    }

    #[tokio::test]
    async fn peer_that_dialled_is_told_each_of_its_addresses_once() {
        let mut bench = Bench::new();
        let (link, mut frames) = bench.add(Instant::now()).await;
        bench.table.tell_address(link);
        assert!(frames.try_recv().is_err(), "this node dialled");
        let entry = bench.table.links.get_mut(&link).unwrap();
        entry.url = None;
        let remote = entry.remote();
        bench.table.tell_address(link);
        bench.table.tell_address(link);
        let is_told = |told: Outgoing| match told {
            Outgoing::Frame(Control::ObservedAddress { place }) => SocketAddr::from(place) == remote,
            _ => false,
        };
        assert!(is_told(frames.try_recv().unwrap()) && frames.try_recv().is_err());
        // The peer came from elsewhere before.
        bench.table.links.get_mut(&link).unwrap().told = Some("192.0.2.1:7".parse().unwrap());
        bench.table.tell_address(link);
        assert!(is_told(frames.try_recv().unwrap()));
    }

    #[tokio::test]
    async fn address_of_a_host_is_taken_from_dialled_peers_alone() {
        let mut bench = Bench::new();
        let (link, _frames) = bench.add(Instant::now()).await;
        let mut take = |address: &str| bench.table.observe_address(link, address.parse().unwrap());
        for none in
            ["0.0.0.0:1", "203.0.113.7:0", "255.255.255.255:1", "224.0.0.1:1", "[::]:1", "[ff02::1]:1"]
        {
            assert!(!take(none), "{none}");
        }
        assert!(take("203.0.113.7:4000") && take("[2001:db8::7]:4001"));
        assert_eq!(bench.table.get(link).unwrap().observed(), Some("[2001:db8::7]:4001".parse().unwrap()));
        bench.table.links.get_mut(&link).unwrap().url = None;
        assert!(!bench.table.observe_address(link, "203.0.113.7:4000".parse().unwrap()));
    }

    #[tokio::test]
    async fn links_are_measured_every_half_second_while_there_are_any() {
        let (mut bench, begin) = (Bench::new(), Instant::now());
        let at = |ms| begin + Duration::from_millis(ms);
        assert_eq!(bench.table.deadline(), None);
        assert!(bench.table.look(at(0)).is_empty());
        let (first, _frames) = bench.add(at(0)).await;
        let (second, _frames) = bench.add(at(300)).await;
        assert_eq!(bench.table.deadline(), Some(at(500)), "the second link does not move the look");
        assert!(bench.table.look(at(499)).is_empty());
        let measured: Vec<_> = bench.table.look(at(500)).iter().map(|(link, _)| *link).collect();
        assert_eq!((measured, bench.table.deadline()), (vec![first, second], Some(at(1000))));
        bench.table.remove(first);
        bench.table.remove(second);
        assert!(bench.table.look(at(1000)).is_empty());
        assert_eq!(bench.table.deadline(), None);
    }

    #[tokio::test]
    async fn link_of_a_peer_that_does_not_answer_is_closed_after_probes() {
        let (mut bench, begin) = (Bench::new(), Instant::now());
        let (link, mut frames) = bench.add(begin).await;
        // The transport may still count late packets of the handshake, which are signs of life.
        let mut looks = (1..).map(|n| begin + n * LOOK_EVERY);
        let closed = looks.by_ref().take(100).find(|now| {
            let seen = bench.table.look(*now);
            assert!(seen.len() == 1 && seen[0].0 == link);
            bench.table.links[&link].closed_for.is_some() && seen[0].1.is_silent
        });
        assert!(closed.is_some(), "a silent peer is given up");
        assert!(matches!(frames.recv().await, Some(Outgoing::Frame(Control::Probe { answers: false }))));
        let ended = bench.table.remove(link).unwrap();
        assert_eq!(ended.closed_for, Some(CloseReason::Silent.to_string()));
    }

    #[tokio::test]
    async fn only_a_peer_with_a_full_queue_is_too_far_behind() {
        let (mut bench, now) = (Bench::new(), Instant::now());
        let (link, mut frames) = bench.add(now).await;
        for _ in 0..CONTROL_FRAMES_MAX {
            assert!(bench.table.send(link, Control::Goodbye));
        }
        assert!(!bench.table.send(link, Control::Goodbye) && !bench.table.flush(link));
        assert!(matches!(frames.recv().await, Some(Outgoing::Frame(Control::Goodbye))));
        assert!(bench.table.flush(link) && !bench.table.flush(link));
        let gone = LinkId(9);
        assert!(bench.table.send(gone, Control::Goodbye) && bench.table.flush(gone), "it has ended");
    }

    #[tokio::test]
    async fn name_has_one_queue_on_each_link_until_its_flows_end() {
        let (mut bench, now) = (Bench::new(), Instant::now());
        let (first, _frames) = bench.add(now).await;
        let (second, _frames) = bench.add(now).await;
        let mut flow = |id, name| match bench.table.out(id, name, OUTFLOW_AGE_MAX) {
            Some(Out::Link(flow, _)) => flow,
            _ => panic!("the link is up"),
        };
        let (kept, ended, other) = (flow(first, NAME), flow(second, NAME), flow(second, OTHER));
        assert!(Arc::ptr_eq(&kept, &flow(first, NAME)) && !Arc::ptr_eq(&ended, &other));
        bench.table.end_flows(&NAME, &[first]);
        tokio::time::timeout(Duration::from_secs(20), ended.ended()).await.expect("its queue is closed");
        let mut left = bench.table.close_flows();
        assert_eq!(left.len(), 2);
        left.retain(|flow| !Arc::ptr_eq(flow, &kept) && !Arc::ptr_eq(flow, &other));
        assert!(left.is_empty());
        for flow in [kept, other] {
            tokio::time::timeout(Duration::from_secs(20), flow.ended()).await.expect("its queue is closed");
        }
        assert!(bench.table.out(LinkId(9), NAME, OUTFLOW_AGE_MAX).is_none(), "it has ended");
    }

    #[tokio::test]
    async fn packets_that_a_queue_leaves_out_are_counted_by_their_reason() {
        let (mut bench, now) = (Bench::new(), Instant::now());
        let (link, _frames) = bench.add(now).await;
        let packet = |name, seq, index| {
            let header = PacketHeader {
                reliable: false,
                class: Class::Bulk,
                hops: HOP_LIMIT,
                suite: 1,
                epoch: 1,
                name,
                source: SourceId([2; 16]),
                seq,
                total: 2000,
                index,
                grid: 1000,
                to: None,
            };
            Packet::new(header, Bytes::from(vec![0; 1000]).into()).unwrap()
        };
        // Both queues are full before their tasks begin. One allows no age, the other has a newer message.
        for (name, max_age) in [(NAME, Duration::ZERO), (OTHER, OUTFLOW_AGE_MAX)] {
            let Some(Out::Link(flow, _)) = bench.table.out(link, name, max_age) else {
                panic!("the link is up")
            };
            for (seq, index) in [(1, 0), (1, 1), (2, 0), (2, 1)] {
                flow.push(packet(name, seq, index)).await.expect("there is room");
            }
            flow.close();
            tokio::time::timeout(Duration::from_secs(20), flow.ended()).await.expect("its queue is closed");
        }
        // Of the first queue, the first message gives way to the second, which is too old.
        let counted = bench.data.drops().snapshot();
        assert_eq!(counted, BTreeMap::from([("stale".to_owned(), 4), ("too_old".to_owned(), 2)]));
    }

    #[tokio::test]
    async fn goodbye_goes_out_on_every_link() {
        let (mut bench, now) = (Bench::new(), Instant::now());
        let (_, mut first) = bench.add(now).await;
        let (_, mut second) = bench.add(now).await;
        assert_eq!(bench.table.say_goodbye().len(), 2);
        for frames in [&mut first, &mut second] {
            assert!(matches!(frames.recv().await, Some(Outgoing::Frame(Control::Goodbye))));
        }
    }
}
