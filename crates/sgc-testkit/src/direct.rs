//! Direct paths of a world: hosts behind NATs, checks between them, and connections that pass NATs.
//!
//! A connection is QUIC as far as it matters here: packets pass NATs in both directions or it is silent, reliable content
//! waits for the path, the node that was dialled follows the dialer's address, and each node ends it after a silence.

use std::collections::{BTreeMap, VecDeque};
use std::net::SocketAddr;
use std::time::Duration;

use sgc_router::{DirectReach, Neighbour};
use sgc_session::NoDirectPath;
use sgc_wire::{NodeId, PathOffer};

use crate::datagrams::router_address;
use crate::ids::NodeKey;
use crate::nat::NatKind;
use crate::networks::{Arrived, NatKey};
use crate::node::Arrival;
use crate::record::{PacketCopies, SentDatagram};
use crate::wires::{Cable, Content, Path, Wire, WireEnd};
use crate::world::{Dial, Pending, SUSPECT_AFTER, World};

/// Interval of looks at a connection, and of its keep-alives.
const PROBE_EVERY: Duration = Duration::from_millis(500);
/// Silence after which both nodes end a connection: a second before the first probe, and the time for its answer.
const DEAD_AFTER: Duration = Duration::from_millis(9500);
/// Time after which a handshake is sent again, doubled each time (RFC 9002, 6.2.2), and for which it is tried.
const HANDSHAKE_AGAIN: Duration = Duration::from_secs(1);
const HANDSHAKE_MAX: Duration = Duration::from_secs(5);

impl World {
    /// Adds a NAT before a new network. `behind` is the NAT between it and the internet.
    pub fn nat(&mut self, kind: NatKind, behind: Option<NatKey>) -> NatKey {
        let key = self.datagrams.networks.add_nat(kind, behind);
        self.note(format!("{key:?} behind {behind:?} is {kind:?}"));
        key
    }

    /// Gives a node an address behind a NAT, or in the internet, in place of an earlier one. It looks for direct paths from
    /// here on.
    pub fn place(&mut self, node: NodeKey, behind: Option<NatKey>) {
        self.note(format!("place {node:?} behind {behind:?}"));
        self.datagrams.begin(self.config.seed);
        self.datagrams.networks.place(node, behind);
        let now = self.now_at(node);
        let Self { nodes, config, .. } = self;
        nodes[node.0].is_direct = true;
        if let Some(running) = nodes[node.0].running.as_mut().filter(|running| running.direct.is_none()) {
            running.begin_direct(now, config.seed);
        }
        self.look_for_addresses(node);
        self.settle(node);
    }

    /// Lets a NAT lose its table, as a restart does.
    pub fn forget_mappings(&mut self, nat: NatKey) {
        self.note(format!("{nat:?} forgets"));
        self.datagrams.networks.forget(nat);
    }

    /// Lets no packet pass between two hosts but over routers, or heals their path.
    pub fn cut_direct(&mut self, a: NodeKey, b: NodeKey, is_cut: bool) {
        self.note(format!("{} the path {a:?} {b:?}", if is_cut { "cut" } else { "heal" }));
        self.datagrams.networks.cut(a, b, is_cut);
    }

    /// Sets the percentage of checks that are lost.
    pub fn lose_checks(&mut self, percent: usize) {
        self.datagrams.loss_percent = percent;
    }

    /// Returns `true` if a direct link connects two nodes and both know it.
    pub fn is_direct(&self, a: NodeKey, b: NodeKey) -> bool {
        self.direct_wires(a, b).any(|wire| wire.carries && wire.ends.iter().all(|end| end.up))
    }

    /// Returns `true` if one of two nodes has a direct link with the other, which may be silent.
    pub fn has_direct(&self, a: NodeKey, b: NodeKey) -> bool {
        self.direct_wires(a, b).any(|wire| wire.ends.iter().any(|end| end.up))
    }

    /// Returns why a node that exchanges data with another one has no direct link to it.
    pub fn why_not_direct(&self, node: NodeKey, other: NodeKey) -> Option<NoDirectPath> {
        let direct = self.nodes[node.0].running.as_ref()?.direct.as_ref()?;
        let id = self.identity(other).node_id();
        direct.paths.why_not(&id)
    }

    fn direct_wires(&self, a: NodeKey, b: NodeKey) -> impl Iterator<Item = &Wire> {
        let is_theirs = move |wire: &&Wire| {
            let nodes = [wire.ends[0].node, wire.ends[1].node];
            wire.path.is_some() && (nodes == [a, b] || nodes == [b, a])
        };
        self.wires.iter().filter(is_theirs)
    }

    /// Returns `true` if packets pass between two hosts when each tries all addresses of the other that can be known.
    /// Without `routers`, only addresses that present routers see are known.
    pub fn lets_meet(&self, a: NodeKey, b: NodeKey, routers: bool) -> bool {
        let seen = |node| self.router_of(node).or_else(|| routers.then(|| router_address(NodeKey(0))));
        self.datagrams.networks.lets_meet(self.clock.instant(), [a, b], [seen(a), seen(b)])
    }

    /// Returns the copies of each packet to all that a node sent since [`World::count_copies`].
    pub fn packet_copies(&self, node: NodeKey) -> Vec<PacketCopies> {
        let mut packets = BTreeMap::<_, PacketCopies>::new();
        for ((wire, side, source, seq, index, to), count) in self.copies.iter().flatten() {
            let Wire { ends, path, .. } = &self.wires[*wire];
            if ends[*side].node != node || to.is_some() {
                continue;
            }
            let copies = packets.entry((*source, *seq, *index)).or_default();
            let remote = path.as_ref().map(|path| path.remotes[*side].ip());
            match remote {
                None => copies.configured += count,
                Some(remote) if self.datagrams.networks.reach(node, remote) == DirectReach::Near => {
                    copies.near += count
                }
                Some(_) => copies.far.extend(std::iter::repeat_n(ends[1 - *side].node, *count)),
            }
        }
        packets.into_values().collect()
    }

    /// Returns the address of a host.
    pub fn address(&self, node: NodeKey) -> Option<SocketAddr> {
        self.datagrams.networks.address(node)
    }

    /// Returns the NAT before a host.
    pub fn nat_of(&self, node: NodeKey) -> Option<NatKey> {
        self.datagrams.networks.nat_of(node)
    }

    /// Returns the number of checks that a node did not send because the offers paid for no more, and that of candidates
    /// that it refused.
    pub fn direct_refusals(&self, node: NodeKey) -> (u64, u64) {
        let direct = self.nodes[node.0].running.as_ref().and_then(|running| running.direct.as_ref());
        direct.map_or((0, 0), |direct| direct.paths.refusals())
    }

    // ---- Nodes that lie.

    /// Starts to record all checks.
    pub fn record_checks(&mut self) {
        self.datagrams.sent.get_or_insert_default();
    }

    /// Returns the recorded checks.
    pub fn recorded_checks(&self) -> &[SentDatagram] {
        self.datagrams.sent.as_deref().unwrap_or_default()
    }

    /// Replaces the addresses that a node tells its peers.
    pub fn tamper_offers(&mut self, node: NodeKey, tamper: impl FnMut(PathOffer) -> PathOffer + 'static) {
        let running = self.nodes[node.0].running.as_mut().expect("only a running node lies");
        running.direct.as_mut().expect("it looks for direct paths").tamper = Some(Box::new(tamper));
    }

    /// Replaces every check that a node sends by others: their sources, if they are forged, their destinations and contents.
    pub fn tamper_checks(
        &mut self,
        node: NodeKey,
        tamper: impl FnMut(&SentDatagram) -> Vec<(Option<SocketAddr>, SocketAddr, Vec<u8>)> + 'static,
    ) {
        self.datagrams.tampers.insert(node, Box::new(tamper));
    }

    /// Sends a datagram of a node, with a forged source if one is given.
    pub fn inject_check(&mut self, by: NodeKey, from: Option<SocketAddr>, to: SocketAddr, datagram: Vec<u8>) {
        let now = self.clock.instant();
        let networks = &mut self.datagrams.networks;
        let arrived = match from {
            Some(from) => networks.carry_forged(now, from, to),
            None => networks.carry(now, by, to),
        };
        self.carry_datagram(by, to, arrived, datagram);
    }

    /// Lets a node look for direct paths to others without data to exchange.
    pub fn want_paths(&mut self, node: NodeKey, peers: &[NodeKey]) {
        let peers = peers.iter().map(|peer| self.identity(*peer).node_id()).collect();
        let running = self.nodes[node.0].running.as_mut();
        running.and_then(|running| running.direct.as_mut()).expect("it looks for direct paths").forced =
            peers;
    }

    /// Returns the addresses from which a node accepts links, and the nodes whose they are.
    pub fn admitted(&self, node: NodeKey) -> Vec<(SocketAddr, NodeKey)> {
        let direct = self.nodes[node.0].running.as_ref().and_then(|running| running.direct.as_ref());
        let admitted = direct.into_iter().flat_map(|direct| &direct.expected);
        admitted.map(|(address, peer)| (*address, self.directory.by_id[peer])).collect()
    }

    /// Dials a host from an address that is not the dialer's, past all NATs. Returns `true` if that makes a link.
    pub fn dial_forged(&mut self, by: NodeKey, from: SocketAddr, at: NodeKey) -> bool {
        self.note(format!("{by:?} dials {at:?} from {from}"));
        let Some(to) = self.address(at) else { return false };
        let is_admitted = self.admits(&Arrived { node: at, from, to }, by);
        if is_admitted {
            self.connect_path([by, at], [to, from]);
        }
        is_admitted
    }

    // ---- Checks.

    /// Returns the address of a router to which a node has a link.
    fn router_of(&self, node: NodeKey) -> Option<SocketAddr> {
        self.routers_of(node).first().map(|(_, router)| router_address(*router))
    }

    /// Returns the links of a node to routers that see its address.
    fn routers_of(&self, node: NodeKey) -> Vec<(sgc_router::LinkId, NodeKey)> {
        let Some(running) = &self.nodes[node.0].running else { return Vec::new() };
        let mut routers = Vec::new();
        for (link, (wire, side)) in &running.links {
            let Wire { path, ends, .. } = &self.wires[*wire];
            let far = ends[1 - side].node;
            if path.is_none() && self.nodes[far.0].transit {
                routers.push((*link, far));
            }
        }
        routers
    }

    /// Lets a node learn its address and where its direct links lead, and later the addresses at which its routers see it.
    pub(crate) fn look_for_addresses(&mut self, node: NodeKey) {
        let (now, Some(host)) = (self.clock.instant(), self.datagrams.networks.address(node)) else { return };
        self.look_where_links_lead(node);
        for (link, router) in self.routers_of(node) {
            let seen = self.datagrams.networks.seen_from(now, node, router_address(router));
            let running = self.nodes[node.0].running.as_ref();
            let Some((run, (wire, _))) = running.map(|running| (running.run, running.links[&link])) else {
                return;
            };
            let round_trip = 2 * self.cables[self.wires[wire].cable].latency;
            if let Some(address) = seen {
                let arrival = Arrival::Observed(link, address);
                self.queue(now + round_trip, Pending::Input { node, run, arrival });
            }
        }
        if let Some(direct) = self.nodes[node.0].running.as_mut().and_then(|running| running.direct.as_mut())
        {
            direct.set_host(now, host);
        }
    }

    /// Lets a node learn where its direct links lead. Either end of a link may have moved.
    fn look_where_links_lead(&mut self, node: NodeKey) {
        let now = self.now_at(node);
        let Some(running) = &mut self.nodes[node.0].running else { return };
        for (link, (wire, side)) in &running.links {
            if let Some(path) = &self.wires[*wire].path {
                let reach = self.datagrams.networks.reach(node, path.remotes[*side].ip());
                running.router.handle_direct_reach(now, *link, reach);
            }
        }
    }

    pub(crate) fn send_check(&mut self, node: NodeKey, to: SocketAddr, datagram: Vec<u8>) {
        let Some(mut tamper) = self.datagrams.tampers.remove(&node) else {
            return self.inject_check(node, None, to, datagram);
        };
        let check = SentDatagram { from: node, to, reached: None, datagram };
        for (from, to, datagram) in tamper(&check) {
            self.inject_check(node, from, to, datagram);
        }
        self.datagrams.tampers.insert(node, tamper);
    }

    fn carry_datagram(&mut self, by: NodeKey, to: SocketAddr, arrived: Option<Arrived>, datagram: Vec<u8>) {
        let is_lost = self.datagrams.is_lost();
        let arrived = arrived.filter(|_| !is_lost);
        if let Some(sent) = &mut self.datagrams.sent {
            let reached = arrived.map(|there| (there.node, there.from));
            sent.push(SentDatagram { from: by, to, reached, datagram: datagram.clone() });
        }
        let Some(Arrived { node, from, to }) = arrived else { return };
        let at = self.clock.instant() + self.path_latency(by, node);
        let Some(run) = self.nodes[node.0].running.as_ref().map(|running| running.run) else { return };
        self.queue(at, Pending::Input { node, run, arrival: Arrival::Check(to, from, datagram) });
    }

    fn path_latency(&mut self, a: NodeKey, b: NodeKey) -> Duration {
        let range = self.config.latency.clone();
        self.datagrams.latency(a, b, &range)
    }

    // ---- Connections.

    pub(crate) fn dial(&mut self, node: NodeKey, peer: NodeId, to: SocketAddr) {
        let Some(run) = self.nodes[node.0].running.as_ref().map(|running| running.run) else { return };
        let far = self.directory.by_id.get(&peer).copied().unwrap_or(node);
        let now = self.clock.instant();
        let at = now + 2 * self.path_latency(node, far);
        let (again_after, until) = (HANDSHAKE_AGAIN, now + HANDSHAKE_MAX);
        self.queue(at, Pending::Dial(Dial { node, run, peer, to, again_after, until }));
    }

    /// Makes the link of a dial if its packets reach the peer, and the peer's answers this node.
    pub(crate) fn try_dial(&mut self, dial: Dial) {
        let (now, Dial { node, run, peer, to, again_after, until }) = (self.clock.instant(), dial);
        if self.nodes[node.0].running.as_ref().is_none_or(|running| running.run != run) {
            return;
        }
        let networks = &mut self.datagrams.networks;
        let there = networks.carry(now, node, to);
        let there = there.filter(|there| {
            let back = networks.carry(now, there.node, there.from);
            back.is_some_and(|back| (back.node, back.from) == (node, to))
        });
        let is_peer = |there: &Arrived| self.directory.by_id.get(&peer) == Some(&there.node);
        if let Some(there) = there.filter(|there| is_peer(there) && self.admits(there, node)) {
            self.connect_path([node, there.node], [to, there.from]);
        } else if now + again_after < until {
            let again = Dial { again_after: 2 * again_after, ..dial };
            self.queue(now + again_after, Pending::Dial(again));
        } else {
            self.arrive(node, Arrival::NotDialled(peer));
        }
    }

    /// Returns `true` if a host accepts a link of a node. It tells nodes apart by their certificates.
    fn admits(&self, there: &Arrived, node: NodeKey) -> bool {
        let running = self.nodes[there.node.0].running.as_ref().filter(|_| !self.is_frozen(there.node));
        let direct = running.and_then(|running| running.direct.as_ref());
        direct.is_some_and(|direct| direct.expects(there.from, &self.identity(node).node_id()))
    }

    /// Connects the dialer and the other node, each with the address to which it sends.
    fn connect_path(&mut self, nodes: [NodeKey; 2], remotes: [SocketAddr; 2]) {
        self.note(format!("direct link {:?} {:?} at {}", nodes[0], nodes[1], remotes[0]));
        let (wire, cable) = (self.wires.len(), self.path_cable(nodes));
        let cable_ends = self.cables[cable].ends;
        (self.cables[cable].wire, self.cables[cable].whole) = (Some(wire), true);
        let instant = self.clock.instant();
        let ends = [0, 1].map(|side| {
            let (node, now) = (nodes[side], self.now_at(nodes[side]));
            let peer = Neighbour::from(self.identity(nodes[1 - side]).as_peer());
            let remote = (remotes[side], self.datagrams.networks.reach(node, remotes[side].ip()));
            let running = self.nodes[node.0].running.as_mut().expect("both nodes run");
            let link = running.new_found_link(now, wire, side, peer, remote);
            WireEnd { node, run: running.run, link, up: true, control: instant, data: BTreeMap::new() }
        });
        debug_assert!(nodes.iter().all(|node| cable_ends.contains(node)));
        let path =
            Path { remotes, dialer: 0, silent_since: None, is_suspect: false, waiting: VecDeque::new() };
        self.wires.push(Wire { cable, carries: true, ends, path: Some(path) });
        for (to, node) in nodes.into_iter().enumerate() {
            self.settle(node);
            self.queue(instant, Pending::Quality { wire, to, suspect: false });
        }
        self.queue(instant + PROBE_EVERY, Pending::Probe { wire });
    }

    /// Returns the cable that stands for the path between two hosts.
    fn path_cable(&mut self, nodes: [NodeKey; 2]) -> usize {
        let is_theirs = |cable: &Cable| cable.is_direct && nodes.iter().all(|node| cable.ends.contains(node));
        if let Some(cable) = self.cables.iter().position(is_theirs) {
            return cable;
        }
        let latency = self.path_latency(nodes[0], nodes[1]);
        self.cables.push(Cable {
            ends: nodes,
            whole: false,
            wire: None,
            latency,
            tampers: [None, None],
            loses: [false; 2],
            is_direct: true,
        });
        self.cables.len() - 1
    }

    /// Returns `true` if the content of a connection arrives when this side sends it now.
    pub(crate) fn passes(&mut self, wire: usize, side: usize) -> bool {
        let is_silent = |path: &Path| path.silent_since.is_some() || !path.waiting.is_empty();
        match &self.wires[wire].path {
            Some(path) if is_silent(path) => false,
            Some(_) => self.reaches(wire, side),
            None => true,
        }
    }

    /// Returns `true` if a packet of this side reaches the other one, which takes it.
    fn reaches(&mut self, wire: usize, side: usize) -> bool {
        let now = self.clock.instant();
        let Wire { ends, path: Some(path), .. } = &mut self.wires[wire] else { return true };
        let (near, far) = (ends[side].node, ends[1 - side].node);
        let arrived = self.datagrams.networks.carry(now, near, path.remotes[side]);
        let Some(there) = arrived.filter(|there| there.node == far) else { return false };
        if path.dialer == side {
            path.remotes[1 - side] = there.from;
        }
        path.remotes[1 - side] == there.from
    }

    /// Lets reliable content wait until the path is back.
    pub(crate) fn wait_for_path(&mut self, wire: usize, content: Content) {
        if let Some(path) = &mut self.wires[wire].path {
            path.waiting.push_back(content);
        }
    }

    /// Sends keep-alives over a connection, and draws conclusions from silence.
    pub(crate) fn probe(&mut self, wire: usize) {
        let now = self.clock.instant();
        let Wire { carries, ends, .. } = &self.wires[wire];
        let up = [ends[0].up, ends[1].up];
        if !carries || up == [false; 2] {
            return;
        }
        let dialer = self.wires[wire].path.as_ref().map_or(0, |path| path.dialer);
        let passes = self.reaches(wire, dialer) && self.reaches(wire, 1 - dialer);
        let Some(path) = &mut self.wires[wire].path else { return };
        let silent = match (passes, path.silent_since) {
            (true, _) => Duration::ZERO,
            (false, since) => now - *path.silent_since.insert(since.unwrap_or(now)),
        };
        let is_suspect = !passes && silent + PROBE_EVERY >= SUSPECT_AFTER;
        let changed = std::mem::replace(&mut path.is_suspect, is_suspect) != is_suspect;
        // A node that closed its end answers the other one that the connection is over.
        let is_over = silent >= DEAD_AFTER || (passes && up.contains(&false));
        let waiting = if passes { std::mem::take(&mut path.waiting) } else { VecDeque::new() };
        if passes {
            path.silent_since = None;
        }
        for content in waiting {
            match content {
                Content::Frame(side, frame) => self.carry_frame(wire, side, &frame),
                Content::Packet(side, packet) => self.carry_packet(wire, side, packet),
            }
        }
        for to in 0..2 {
            if changed {
                self.queue(now, Pending::Quality { wire, to, suspect: is_suspect });
            }
            if is_over {
                self.queue(now, Pending::LinkDown { wire, to, superseded: false });
            }
        }
        if is_over {
            self.wires[wire].carries = false;
            self.unplug(wire);
        } else {
            self.queue(now + PROBE_EVERY, Pending::Probe { wire });
        }
    }
}
