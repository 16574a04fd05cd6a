//! Two nodes, their routers and the NATs in front of them, on a virtual clock.

#![allow(clippy::unwrap_used)]

use std::collections::BTreeMap;
use std::net::{IpAddr, Ipv4Addr};

use rand_core::SeedableRng as _;
use sgc_wire::{CandidateKind, PathCandidate};

use super::*;

const STEP: Duration = Duration::from_millis(5);
/// One-way delay of packets between the networks, and of questions and answers through routers.
const PACKETS: Duration = Duration::from_millis(10);
const SIGNALS: Duration = Duration::from_millis(20);
/// The port of the links' socket in each network.
const PORT: u16 = 5000;

/// Whether something depends on the destination (RFC 4787, 4.1 and 5).
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum By {
    Nothing,
    Address,
    AddressAndPort,
}

/// A NAT: how it maps, and what it lets in.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
struct Nat {
    mapping: By,
    filtering: By,
}

const FULL_CONE: Nat = Nat { mapping: By::Nothing, filtering: By::Nothing };
const ADDRESS_RESTRICTED: Nat = Nat { mapping: By::Nothing, filtering: By::Address };
const PORT_RESTRICTED: Nat = Nat { mapping: By::Nothing, filtering: By::AddressAndPort };
const SYMMETRIC: Nat = Nat { mapping: By::AddressAndPort, filtering: By::AddressAndPort };

fn key(by: By, to: SocketAddr) -> Option<SocketAddr> {
    match by {
        By::Nothing => None,
        By::Address => Some(SocketAddr::new(to.ip(), 0)),
        By::AddressAndPort => Some(to),
    }
}

/// A network with one node.
struct Side {
    node: NodeId,
    machine: DirectPaths,
    inside: SocketAddr,
    /// The address in a second network.
    second: Option<SocketAddr>,
    outside: IpAddr,
    nat: Option<Nat>,
    /// Port outside for each key of the mapping.
    mapped: BTreeMap<Option<SocketAddr>, u16>,
    /// Addresses that were sent to from a port outside.
    sent: BTreeSet<(u16, Option<SocketAddr>)>,
    admitted: BTreeSet<SocketAddr>,
    dialled: Option<SocketAddr>,
    /// Bytes sent to an address.
    bytes_to: BTreeMap<SocketAddr, usize>,
    permits: bool,
}

impl Side {
    fn new(id: u8, nat: Option<Nat>) -> Self {
        let node = NodeId([id; 32]);
        let outside = IpAddr::from(Ipv4Addr::new(203, 0, 113, id));
        let inside = match nat {
            None => SocketAddr::new(outside, PORT),
            Some(_) => SocketAddr::from(([10, 0, id, 2], PORT)),
        };
        Self {
            node,
            machine: DirectPaths::new(node, ChaCha20Rng::seed_from_u64(id.into())),
            inside,
            second: None,
            outside,
            nat,
            mapped: BTreeMap::new(),
            sent: BTreeSet::new(),
            admitted: BTreeSet::new(),
            dialled: None,
            bytes_to: BTreeMap::new(),
            permits: true,
        }
    }

    /// Returns the address outside of a packet to `to`, which the NAT then lets answer.
    fn map(&mut self, to: SocketAddr) -> SocketAddr {
        let Some(nat) = self.nat else { return self.inside };
        let next = 40_000 + self.mapped.len() as u16;
        let port = *self.mapped.entry(key(nat.mapping, to)).or_insert(next);
        self.sent.insert((port, key(nat.filtering, to)));
        SocketAddr::new(self.outside, port)
    }

    /// Returns `true` if a packet to `to` reaches the node.
    fn lets_in(&self, from: SocketAddr, to: SocketAddr) -> bool {
        match self.nat {
            None => to == self.inside || self.second == Some(to),
            Some(nat) => {
                to.ip() == self.outside
                    && self.mapped.values().any(|port| *port == to.port())
                    && self.sent.contains(&(to.port(), key(nat.filtering, from)))
            }
        }
    }
}

enum Signal {
    Question(PathQuestion),
    Offer(PathOffer),
    Refusal { is_for_good: bool },
}

struct World {
    begun: Instant,
    now: Instant,
    sides: [Side; 2],
    packets: Vec<(Instant, usize, SocketAddr, SocketAddr, Vec<u8>)>,
    signals: Vec<(Instant, usize, Signal)>,
    /// Decides which packets are lost, if some are: a third of them.
    loss: ChaCha20Rng,
    is_lossy: bool,
    /// An address to which packets take ten times as long.
    slow: Option<SocketAddr>,
    count: usize,
    linked: Option<Duration>,
}

impl World {
    fn new(nats: [Option<Nat>; 2]) -> Self {
        #[allow(clippy::disallowed_methods)]
        let begun = Instant::now();
        let [a, b] = nats;
        let mut world = Self {
            begun,
            now: begun,
            sides: [Side::new(1, a), Side::new(2, b)],
            packets: Vec::new(),
            signals: Vec::new(),
            loss: ChaCha20Rng::seed_from_u64(0),
            is_lossy: false,
            slow: None,
            count: 0,
            linked: None,
        };
        for side in &mut world.sides {
            // The router is asked first, as for a link.
            let router = SocketAddr::from(([198, 51, 100, 1], 7447));
            let reflexive = side.map(router);
            let host = LocalAddress { kind: CandidateKind::Host, address: side.inside, base: side.inside };
            let seen =
                LocalAddress { kind: CandidateKind::ServerReflexive, address: reflexive, base: side.inside };
            let local = if side.nat.is_some() { vec![host, seen] } else { vec![host] };
            side.machine.set_local(begun, local);
        }
        world
    }

    fn want(&mut self, at: usize) {
        let far = self.sides[1 - at].node;
        self.sides[at].machine.want(self.now, &[far].into());
    }

    /// Carries out the outputs of both machines.
    fn carry_out(&mut self) {
        for at in 0..2 {
            while let Some(output) = self.sides[at].machine.poll() {
                match output {
                    DirectOutput::Ask { question, .. } => {
                        self.signals.push((self.now + SIGNALS, 1 - at, Signal::Question(question)));
                    }
                    DirectOutput::Leave { .. } => {}
                    DirectOutput::Shut { .. } => {
                        self.sides[at].admitted.clear();
                        self.sides[at].dialled = None;
                    }
                    DirectOutput::Admit { from, .. } => {
                        self.sides[at].admitted.insert(from);
                    }
                    DirectOutput::Dial { to, .. } => self.sides[at].dialled = Some(to),
                    DirectOutput::Send { from, to, datagram } => {
                        let side = &mut self.sides[at];
                        assert!(from == side.inside || side.second == Some(from));
                        *side.bytes_to.entry(to).or_default() += datagram.len();
                        let source = if side.nat.is_some() { side.map(to) } else { from };
                        self.count += 1;
                        let is_lost = self.is_lossy && self.loss.next_u32().is_multiple_of(3);
                        if !is_lost {
                            let delay = if self.slow == Some(to) { 10 * PACKETS } else { PACKETS };
                            self.packets.push((self.now + delay, 1 - at, source, to, datagram));
                        }
                    }
                }
            }
        }
        // A link is made of packets like the checks.
        let [controlling, controlled] = &self.sides;
        if let Some(to) = controlling.dialled.filter(|_| self.linked.is_none()) {
            let mut nat = Side { nat: controlling.nat, ..Side::new(1, controlling.nat) };
            (nat.mapped, nat.sent) = (controlling.mapped.clone(), controlling.sent.clone());
            let source = nat.map(to);
            if controlled.lets_in(source, to) && controlled.admitted.contains(&source) {
                self.linked = Some(self.now - self.begun);
                let nodes = [controlling.node, controlled.node];
                assert!(self.sides[0].machine.is_expected(&nodes[1], to));
                assert!(self.sides[1].machine.is_expected(&nodes[0], source));
                for (side, far) in self.sides.iter_mut().zip([nodes[1], nodes[0]]) {
                    side.machine.linked(self.now, far);
                }
            }
        }
    }

    fn step(&mut self) {
        self.now += STEP;
        let now = self.now;
        let arrived = self.packets.extract_if(.., |(at, ..)| *at <= now).collect::<Vec<_>>();
        for (_, at, from, to, datagram) in arrived {
            let side = &mut self.sides[at];
            if side.lets_in(from, to) {
                let to = if side.nat.is_some() { side.inside } else { to };
                side.machine.received(now, to, from, &datagram);
            }
        }
        let arrived = self.signals.extract_if(.., |(at, ..)| *at <= now).collect::<Vec<_>>();
        for (_, at, signal) in arrived {
            let far = self.sides[1 - at].node;
            let side = &mut self.sides[at];
            match signal {
                Signal::Question(question) => {
                    let offer = if side.permits { side.machine.asked(now, far, question) } else { None };
                    let refusal = Signal::Refusal { is_for_good: !side.permits };
                    let answer = offer.map_or(refusal, Signal::Offer);
                    self.signals.push((now + SIGNALS, 1 - at, answer));
                }
                Signal::Offer(offer) => side.machine.offered(now, far, &offer),
                Signal::Refusal { is_for_good } => side.machine.refused(now, far, is_for_good),
            }
        }
        for side in &mut self.sides {
            if side.machine.deadline().is_some_and(|at| at <= now) {
                side.machine.handle_timeout(now);
            }
        }
        self.carry_out();
    }

    fn run(&mut self, time: Duration) {
        let until = self.now + time;
        self.carry_out();
        while self.now < until {
            self.step();
        }
    }

    fn why_not(&self, at: usize) -> Option<NoDirectPath> {
        let far = self.sides[1 - at].node;
        self.sides[at].machine.why_not(&far)
    }
}

#[test]
fn nodes_behind_nats_find_a_path_as_theory_says() {
    let all = [None, Some(FULL_CONE), Some(ADDRESS_RESTRICTED), Some(PORT_RESTRICTED), Some(SYMMETRIC)];
    for (a, b) in all.iter().flat_map(|a| all.iter().map(move |b| (*a, *b))) {
        for wants in 0..2 {
            let mut world = World::new([a, b]);
            world.want(wants);
            world.run(2 * DIRECT_ATTEMPT_MAX);
            let strict = [Some(PORT_RESTRICTED), Some(SYMMETRIC)];
            let is_hopeless = (a == Some(SYMMETRIC) && strict.contains(&b))
                || (b == Some(SYMMETRIC) && strict.contains(&a));
            match world.linked {
                Some(after) => {
                    assert!(!is_hopeless, "{a:?} to {b:?}");
                    assert!(after < Duration::from_millis(600), "{a:?} to {b:?} after {after:?}");
                    assert_eq!((world.why_not(0), world.why_not(1)), (None, None));
                }
                None => {
                    assert!(is_hopeless, "{a:?} to {b:?}: {:?}", world.why_not(wants));
                    let why = world.why_not(wants);
                    assert_eq!(why, Some(NoDirectPath::Blocked));
                }
            }
        }
    }
}

#[test]
fn path_is_found_although_a_third_of_all_checks_is_lost() {
    for nats in [[Some(PORT_RESTRICTED); 2], [Some(SYMMETRIC), Some(FULL_CONE)]] {
        for seed in 0..50 {
            let mut world = World::new(nats);
            world.loss = ChaCha20Rng::seed_from_u64(seed);
            world.is_lossy = true;
            world.want(1);
            world.run(DIRECT_ATTEMPT_MAX);
            let why = [world.why_not(0), world.why_not(1)];
            assert!(
                world.linked.is_some_and(|after| after < Duration::from_secs(5)),
                "{seed}: {:?} {why:?}",
                world.linked
            );
        }
    }
}

#[test]
fn peer_that_names_the_addresses_of_others_makes_nobody_send_more_than_it_did() {
    let mut world = World::new([None, None]);
    let victim = |n: u16| SocketAddr::from(([198, 51, 100, 99], 1000 + n));
    let named: Vec<_> = (0..sgc_wire::PATH_CANDIDATES_MAX as u16)
        .map(|n| PathCandidate { kind: CandidateKind::Host, place: victim(n).into() })
        .collect();
    let mut refused = 0;
    for round in 0..20 {
        let (now, liar) = (world.now, world.sides[1].node);
        let machine = &mut world.sides[0].machine;
        let question = PathQuestion { attempt: round };
        if machine.asked(now, liar, question).is_some() {
            let offer = PathOffer {
                attempt: round,
                user: [7; 4],
                password: sgc_wire::SecretBytes::new([7; 32]),
                candidates: named.clone(),
            };
            machine.offered(now, liar, &offer);
        }
        let mut sent = 0;
        while let Some(output) = world.sides[0].machine.poll() {
            if let DirectOutput::Send { datagram, .. } = output {
                sent += datagram.len();
            }
        }
        for _ in 0..400 {
            world.now += STEP;
            world.sides[0].machine.handle_timeout(world.now);
            while let Some(output) = world.sides[0].machine.poll() {
                if let DirectOutput::Send { datagram, .. } = output {
                    sent += datagram.len();
                }
            }
        }
        refused += u32::from(sent == 0);
        assert!(sent <= sgc_wire::PATH_OFFER_BYTES, "{sent}");
    }
    assert!(refused > 0 && refused < 10, "{refused} of 20 rounds");
    assert!(world.sides[0].machine.refusals().0 > 0);
}

/// The peer has the password, so it can send checks in the name of any address.
#[test]
fn peer_that_forges_the_addresses_of_others_makes_nobody_send_more_than_it_did() {
    let mut world = World::new([None, None]);
    let (now, liar) = (world.now, world.sides[1].node);
    let inside = world.sides[0].inside;
    // The liar has a machine of its own, which makes checks for any destination.
    let mut forger = DirectPaths::new(liar, ChaCha20Rng::seed_from_u64(3));
    let own = world.sides[1].inside;
    forger.set_local(now, vec![LocalAddress { kind: CandidateKind::Host, address: own, base: own }]);
    forger.want(now, &[world.sides[0].node].into());
    forger.handle_timeout(now);
    let question = std::iter::from_fn(|| forger.poll()).find_map(|output| match output {
        DirectOutput::Ask { question, .. } => Some(question),
        _ => None,
    });
    let mut offer = world.sides[0].machine.asked(now, liar, question.unwrap()).unwrap();
    let theirs = forger.asked(now, world.sides[0].node, PathQuestion { attempt: offer.attempt }).unwrap();
    offer.candidates = vec![PathCandidate { kind: CandidateKind::Host, place: inside.into() }];
    forger.offered(now, world.sides[0].node, &offer);
    world.sides[0].machine.offered(now, liar, &PathOffer { candidates: Vec::new(), ..theirs });
    let (mut received, mut sent, mut victims) = (sgc_wire::PATH_OFFER_BYTES, 0, BTreeSet::new());
    for n in 0..2000u16 {
        world.now += STEP;
        forger.handle_timeout(world.now);
        while let Some(output) = forger.poll() {
            if let DirectOutput::Send { datagram, .. } = output {
                received += datagram.len();
                let victim = SocketAddr::from(([198, 51, 100, (n % 250) as u8], 1000 + n));
                world.sides[0].machine.received(world.now, inside, victim, &datagram);
            }
        }
        world.sides[0].machine.handle_timeout(world.now);
        while let Some(output) = world.sides[0].machine.poll() {
            if let DirectOutput::Send { to, datagram, .. } = output {
                sent += datagram.len();
                victims.insert(to);
            }
        }
        assert!(sent <= received, "{sent} bytes for {received}");
    }
    assert!(sent > 0 && victims.len() <= 32, "{sent} bytes to {} addresses", victims.len());
}

/// Only the destination of a check is known to be of the peer, from whatever address its answer seems to come.
#[test]
fn peer_that_answers_in_the_name_of_others_makes_nobody_send_more_than_it_did() {
    let mut world = World::new([None, None]);
    let (now, liar) = (world.now, world.sides[1].node);
    let (inside, own) = (world.sides[0].inside, world.sides[1].inside);
    let mut answerer = DirectPaths::new(liar, ChaCha20Rng::seed_from_u64(3));
    answerer.set_local(now, vec![LocalAddress { kind: CandidateKind::Host, address: own, base: own }]);
    answerer.want(now, &[world.sides[0].node].into());
    answerer.handle_timeout(now);
    let question = std::iter::from_fn(|| answerer.poll()).find_map(|output| match output {
        DirectOutput::Ask { question, .. } => Some(question),
        _ => None,
    });
    let offer = world.sides[0].machine.asked(now, liar, question.unwrap()).unwrap();
    let theirs = answerer.asked(now, world.sides[0].node, PathQuestion { attempt: offer.attempt }).unwrap();
    answerer.offered(now, world.sides[0].node, &offer);
    let victims: Vec<_> = (1..8).map(|n| SocketAddr::from(([198, 51, 100, n], 1000))).collect();
    let host = |address: &SocketAddr| PathCandidate { kind: CandidateKind::Host, place: (*address).into() };
    let candidates = victims.iter().chain([&own]).map(host).collect();
    world.sides[0].machine.offered(now, liar, &PathOffer { candidates, ..theirs });
    let (mut received, mut sent, mut answers) = (sgc_wire::PATH_OFFER_BYTES, 0, 0);
    while world.now < now + DIRECT_ATTEMPT_MAX {
        world.now += STEP;
        world.sides[0].machine.handle_timeout(world.now);
        while let Some(output) = world.sides[0].machine.poll() {
            let DirectOutput::Send { to, datagram, .. } = output else { continue };
            if to != own {
                sent += datagram.len();
                continue;
            }
            answerer.received(world.now, own, inside, &datagram);
            while let Some(output) = answerer.poll() {
                let DirectOutput::Send { datagram, .. } = output else { continue };
                if !StunMessage::parse(&datagram).unwrap().is_successful_binding_response() {
                    continue;
                }
                let victim = victims[answers % victims.len()];
                received += datagram.len();
                answers += 1;
                world.sides[0].machine.received(world.now, inside, victim, &datagram);
            }
        }
        assert!(sent <= received, "{sent} bytes for {received}");
    }
    assert!(sent > 0 && answers >= victims.len(), "{sent} bytes, {answers} answers");
}

#[test]
fn addresses_of_this_host_and_of_one_segment_are_refused() {
    let mut world = World::new([None, None]);
    let named =
        ["127.0.0.1:22", "[::1]:22", "169.254.169.254:80", "224.0.0.251:5353", "[fe80::1]:1", "0.0.0.0:9"];
    let candidates = named.map(|text| PathCandidate {
        kind: CandidateKind::Host,
        place: text.parse::<SocketAddr>().unwrap().into(),
    });
    let (now, liar) = (world.now, world.sides[1].node);
    let machine = &mut world.sides[0].machine;
    machine.asked(now, liar, PathQuestion { attempt: 1 }).unwrap();
    let password = sgc_wire::SecretBytes::new([7; 32]);
    let offer = PathOffer { attempt: 1, user: [7; 4], password, candidates: candidates.to_vec() };
    machine.offered(now, liar, &offer);
    for _ in 0..400 {
        world.now += STEP;
        world.sides[0].machine.handle_timeout(world.now);
    }
    let sends = std::iter::from_fn(|| world.sides[0].machine.poll());
    assert_eq!(sends.filter(|output| matches!(output, DirectOutput::Send { .. })).count(), 0);
    assert_eq!(world.sides[0].machine.refusals().1, named.len() as u64);
}

#[test]
fn stranger_finds_no_attempt_and_gets_no_answer() {
    let mut world = World::new([None, None]);
    world.want(0);
    world.run(Duration::from_millis(45));
    let machine = &mut world.sides[0].machine;
    let stranger = "192.0.2.9:9".parse().unwrap();
    for datagram in [&[][..], &[0; 20], b"\x00\x01\x00\x00\x21\x12\xa4\x42aaaaaaaaaaaa"] {
        assert!(!machine.received(world.now, world.sides[0].inside, stranger, datagram));
    }
    // A check of another attempt has another password.
    let mut other = World::new([None, None]);
    other.sides[1].machine = DirectPaths::new(other.sides[1].node, ChaCha20Rng::seed_from_u64(99));
    let host = LocalAddress { kind: CandidateKind::Host, address: stranger, base: stranger };
    other.sides[1].machine.set_local(other.now, vec![host]);
    other.want(1);
    other.sides[1].machine.handle_timeout(other.now);
    let mut offer =
        other.sides[0].machine.asked(other.now, other.sides[1].node, PathQuestion { attempt: 5 }).unwrap();
    offer.password = sgc_wire::SecretBytes::new([1; 32]);
    other.sides[1].machine.offered(other.now, other.sides[0].node, &offer);
    let check = std::iter::from_fn(|| other.sides[1].machine.poll()).find_map(|output| match output {
        DirectOutput::Send { datagram, .. } => Some(datagram),
        _ => None,
    });
    let (inside, check) = (other.sides[0].inside, check.unwrap());
    assert!(!other.sides[0].machine.received(other.now, inside, stranger, &check));
}

#[test]
fn node_that_restarts_in_the_middle_of_an_attempt_finds_the_path_all_the_same() {
    for restarts in 0..2 {
        let mut world = World::new([Some(PORT_RESTRICTED), Some(PORT_RESTRICTED)]);
        world.want(0);
        world.run(Duration::from_millis(60));
        assert_eq!(world.linked, None);
        let side = &mut world.sides[restarts];
        let local = side.machine.local.clone();
        side.machine = DirectPaths::new(side.node, ChaCha20Rng::seed_from_u64(77));
        side.machine.set_local(world.now, local);
        (side.dialled, side.admitted) = (None, BTreeSet::new());
        world.want(restarts);
        world.run(2 * DIRECT_ATTEMPT_MAX);
        assert!(world.linked.is_some(), "{restarts}: {:?}", [world.why_not(0), world.why_not(1)]);
    }
}

#[test]
fn address_that_becomes_known_in_the_middle_of_an_attempt_is_used_at_once() {
    for late in 0..2 {
        let mut world = World::new([Some(PORT_RESTRICTED), Some(PORT_RESTRICTED)]);
        let local = world.sides[late].machine.local.clone();
        let hosts = local.iter().filter(|local| local.kind == CandidateKind::Host).copied().collect();
        world.sides[late].machine.set_local(world.now, hosts);
        world.want(0);
        world.run(Duration::from_millis(1200));
        assert_eq!(world.linked, None);
        world.sides[late].machine.set_local(world.now, local);
        world.run(Duration::from_millis(600));
        assert!(world.linked.is_some(), "{late}");
    }
}

#[test]
fn quicker_of_two_paths_is_dialled() {
    for is_first_slow in [true, false] {
        let mut world = World::new([None, None]);
        let desk = &mut world.sides[1];
        let (first, second) = (desk.inside, SocketAddr::from(([203, 0, 113, 77], PORT)));
        desk.second = Some(second);
        let host = |address| LocalAddress { kind: CandidateKind::Host, address, base: address };
        desk.machine.set_local(world.now, vec![host(first), host(second)]);
        let (slow, quick) = if is_first_slow { (first, second) } else { (second, first) };
        world.slow = Some(slow);
        world.want(0);
        let mut dialled = None;
        while world.now < world.begun + DIRECT_ATTEMPT_MAX && dialled.is_none() {
            world.step();
            dialled = world.sides[0].dialled;
        }
        assert_eq!(dialled, Some(quick));
    }
}

#[test]
fn better_path_is_looked_for_when_addresses_change_while_the_link_stays() {
    let mut world = World::new([None, None]);
    world.want(0);
    world.run(Duration::from_secs(1));
    assert!(world.linked.take().is_some());
    world.sides[0].dialled = None;
    let far = world.sides[1].node;
    let dials = |world: &mut World| {
        world.sides[0].machine.set_local(world.now, Vec::new());
        let inside = world.sides[0].inside;
        let host = LocalAddress { kind: CandidateKind::Host, address: inside, base: inside };
        world.sides[0].machine.set_local(world.now, vec![host]);
        world.run(DIRECT_ATTEMPT_MAX + Duration::from_secs(1));
        world.sides[0].dialled = None;
        world.linked.take().is_some()
    };
    assert!(dials(&mut world));
    // One attempt that fails. The link stays, and nothing more is tried.
    world.sides[1].permits = false;
    assert!(!dials(&mut world));
    assert_eq!(world.why_not(0), None);
    assert_eq!(world.sides[0].machine.deadline(), None);
    // The old link ends during an attempt, whose link is still awaited.
    world.sides[1].permits = true;
    world.sides[0].machine.set_local(world.now, Vec::new());
    let inside = world.sides[0].inside;
    let host = LocalAddress { kind: CandidateKind::Host, address: inside, base: inside };
    world.sides[0].machine.set_local(world.now, vec![host]);
    world.run(Duration::from_millis(50));
    world.sides[0].machine.ended(world.now, far);
    let near = world.sides[0].node;
    world.sides[1].machine.ended(world.now, near);
    world.run(Duration::from_secs(1));
    assert!(world.linked.is_some());
}

#[test]
fn nodes_without_an_address_of_one_family_give_up_at_once() {
    let mut world = World::new([None, None]);
    let address = "[2001:db8::7]:5000".parse().unwrap();
    let v6 = LocalAddress { kind: CandidateKind::Host, address, base: address };
    world.sides[0].machine.set_local(world.now, vec![v6]);
    world.want(1);
    world.run(Duration::from_millis(200));
    assert_eq!(world.why_not(1), Some(NoDirectPath::NoCommonFamily));
    assert_eq!(world.count, 0);
}

#[test]
fn attempts_that_fail_become_rare_until_the_network_changes() {
    let mut world = World::new([Some(SYMMETRIC), Some(SYMMETRIC)]);
    world.want(0);
    world.run(Duration::from_secs(1200));
    let first = world.count;
    world.run(Duration::from_secs(600));
    let later = world.count - first;
    assert!(later > 0 && later * 3 < first, "{first} checks in 20 minutes, then {later} in 10");
    assert_eq!(world.why_not(0), Some(NoDirectPath::Blocked));
    // It moves to a network without a NAT.
    let side = &mut world.sides[0];
    (side.nat, side.inside) = (None, SocketAddr::new(side.outside, PORT));
    let host = LocalAddress { kind: CandidateKind::Host, address: side.inside, base: side.inside };
    side.machine.set_local(world.now, vec![host]);
    world.run(Duration::from_secs(1));
    assert!(world.linked.is_some());
}

#[test]
fn path_that_is_lost_soon_is_tried_again_later_and_later() {
    let mut world = World::new([None, None]);
    let far = world.sides[1].node;
    let mut waits = Vec::new();
    for _ in 0..6 {
        world.linked = None;
        world.want(0);
        let begun = world.now;
        while world.linked.is_none() {
            assert!(world.now < begun + RETRY_MAX);
            world.step();
        }
        waits.push(world.now - begun);
        world.run(Duration::from_secs(3));
        let near = world.sides[0].node;
        world.sides[0].machine.ended(world.now, far);
        world.sides[1].machine.ended(world.now, near);
        assert_eq!(world.why_not(0), Some(NoDirectPath::Lost));
    }
    assert!(waits[0] < Duration::from_secs(1) && waits[5] > Duration::from_secs(8), "{waits:?}");
    assert!(waits[1] < Duration::from_secs(4), "{waits:?}");
}

#[test]
fn peer_without_addresses_is_asked_again_and_not_called_unwilling() {
    let mut world = World::new([None, None]);
    let local = world.sides[1].machine.local.clone();
    world.sides[1].machine.set_local(world.now, Vec::new());
    world.want(0);
    world.run(Duration::from_millis(200));
    assert_eq!(world.why_not(0), Some(NoDirectPath::Unready));
    world.sides[1].machine.set_local(world.now, local);
    world.run(Duration::from_secs(3));
    assert!(world.linked.is_some());
}

#[test]
fn peer_that_permits_nothing_is_left_alone_and_one_that_is_not_wanted_is_forgotten() {
    let mut world = World::new([None, None]);
    world.sides[1].permits = false;
    world.want(0);
    world.run(Duration::from_secs(1));
    assert_eq!((world.why_not(0), world.linked), (Some(NoDirectPath::Refused), None));
    assert_eq!(world.sides[1].machine.peers.len(), 0);
    world.sides[0].machine.want(world.now, &BTreeSet::new());
    world.run(RETRY_MAX);
    world.sides[0].machine.want(world.now, &BTreeSet::new());
    assert_eq!(world.sides[0].machine.peers.len(), 0);
    assert_eq!(world.sides[0].machine.deadline(), None);
}

#[test]
fn peers_and_attempts_are_bounded() {
    let mut world = World::new([None, None]);
    let node = |n: usize| NodeId(std::array::from_fn(|at| if at < 2 { (n >> (8 * at)) as u8 } else { 9 }));
    let wanted: BTreeSet<_> = (0..2 * DIRECT_PEERS_MAX).map(node).collect();
    let machine = &mut world.sides[0].machine;
    machine.want(world.now, &wanted);
    machine.handle_timeout(world.now);
    assert_eq!((machine.peers.len(), machine.attempts()), (DIRECT_PEERS_MAX, DIRECT_ATTEMPTS_MAX));
    let one_more = node(3 * DIRECT_PEERS_MAX);
    assert_eq!(machine.asked(world.now, one_more, PathQuestion { attempt: 1 }), None);
    let waiting = wanted.iter().filter(|node| machine.why_not(node) == Some(NoDirectPath::Busy)).count();
    assert_eq!(waiting, DIRECT_PEERS_MAX - DIRECT_ATTEMPTS_MAX);
}
