//! [`PortMapper`]: when a port mapping is asked of the gateway, by which protocol, when it is renewed, and when it is
//! removed.
//!
//! The driver carries out one output at a time and reports the answer of each request. It also finds the gateway and
//! decides whether a mapping is of use.

use std::collections::{BTreeMap, VecDeque};
use std::fmt;
use std::net::{Ipv4Addr, SocketAddr, SocketAddrV4};
use std::num::NonZeroU16;
use std::time::{Duration, Instant};

use rand_chacha::ChaCha20Rng;

use crate::{doubled, is_checkable};

/// The lifetime that is asked for, as RFC 6886 (3.3) recommends.
pub const MAPPING_LIFETIME: Duration = Duration::from_secs(7200);
/// Shortest time until a mapping is renewed (RFC 6887, 11.2.1).
const RENEW_MIN: Duration = Duration::from_secs(4);
/// Longest time until a mapping is renewed: one of which a restarted gateway knows nothing comes back within it.
const RENEW_MAX: Duration = Duration::from_secs(600);
/// Shortest wait, before jitter, after all protocols failed. It is doubled each time.
const RETRY_MIN: Duration = Duration::from_secs(60);
/// Longest such wait.
const RETRY_MAX: Duration = Duration::from_secs(1800);
/// Shortest time between requests when the network changes again and again.
const AGAIN_MIN: Duration = Duration::from_secs(30);
/// Shortest time between two external addresses that are believed, because peers are told each.
const STABLE_MIN: Duration = Duration::from_secs(60);
/// Most mappings that wait to be removed.
const REMOVALS_MAX: usize = 4;

/// A protocol by which a gateway maps ports.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub enum MappingProtocol {
    /// Port Control Protocol (RFC 6887).
    Pcp,
    /// NAT Port Mapping Protocol (RFC 6886).
    NatPmp,
    /// The service WANIPConnection or WANPPPConnection of an Internet Gateway Device.
    UpnpIgd,
}

impl MappingProtocol {
    /// All protocols, in the order in which they are tried.
    pub const ALL: [Self; 3] = [Self::Pcp, Self::NatPmp, Self::UpnpIgd];

    /// Returns the name in documents.
    pub fn key(self) -> &'static str {
        match self {
            Self::Pcp => "pcp",
            Self::NatPmp => "nat_pmp",
            Self::UpnpIgd => "upnp_igd",
        }
    }
}

impl fmt::Display for MappingProtocol {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(match self {
            Self::Pcp => "PCP",
            Self::NatPmp => "NAT-PMP",
            Self::UpnpIgd => "UPnP-IGD",
        })
    }
}

/// A port of this host, and the gateway that is to map it.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct MappingTarget {
    /// The gateway.
    pub gateway: Ipv4Addr,
    /// The address of this host from which packets to the gateway leave.
    pub host: Ipv4Addr,
    /// The UDP port.
    pub port: NonZeroU16,
}

/// A mapping as the gateway granted it.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct GrantedMapping {
    /// The protocol.
    pub protocol: MappingProtocol,
    /// The gateway and the mapped port.
    pub target: MappingTarget,
    /// The address and port to which others send.
    pub external: SocketAddrV4,
    /// The lifetime, from the answer on.
    pub lifetime: Duration,
    /// The nonce of PCP, by which the mapping is renewed and removed.
    pub nonce: [u32; 3],
}

/// Reasons why a gateway mapped no port.
#[derive(Clone, Copy, Debug, PartialEq, Eq, thiserror::Error)]
pub enum MappingFailure {
    /// No answer came.
    #[error("no answer")]
    NoAnswer,
    /// The gateway does not know the protocol or the request.
    #[error("not supported")]
    Unsupported,
    /// The gateway does not permit it.
    #[error("not permitted")]
    NotPermitted,
    /// The gateway has no room, or no free port.
    #[error("no room for a mapping")]
    NoRoom,
    /// The gateway maps only for ever, so mappings would outlive nodes that lose their power.
    #[error("mappings without end only")]
    PermanentOnly,
    /// The external address is one that nobody can reach.
    #[error("no external address")]
    NoExternalAddress,
    /// The gateway names another external address each time.
    #[error("another external address each time")]
    Unstable,
    /// The answer is not one of the protocol.
    #[error("malformed answer")]
    Malformed,
    /// This host could not send the request.
    #[error("the request could not be sent")]
    NotSent,
}

impl MappingFailure {
    /// Returns the name in documents.
    pub fn key(self) -> &'static str {
        match self {
            Self::NoAnswer => "no_answer",
            Self::Unsupported => "unsupported",
            Self::NotPermitted => "not_permitted",
            Self::NoRoom => "no_room",
            Self::PermanentOnly => "permanent_only",
            Self::NoExternalAddress => "no_external_address",
            Self::Unstable => "unstable",
            Self::Malformed => "malformed",
            Self::NotSent => "not_sent",
        }
    }
}

/// Work for the driver.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum MapperOutput {
    /// Ask for a mapping, and report the answer.
    Ask {
        /// The protocol.
        protocol: MappingProtocol,
        /// The gateway and the port.
        target: MappingTarget,
        /// The mapping that is renewed.
        renews: Option<GrantedMapping>,
    },
    /// Remove a mapping.
    Remove(GrantedMapping),
}

#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Phase {
    /// No mapping is wanted.
    Idle,
    /// The next request of a round is due.
    Due,
    /// A request is under way. It is never given up, because the gateway may grant it.
    Asking { protocol: MappingProtocol, target: MappingTarget },
    /// The next round begins at this time.
    Waiting { at: Instant },
}

/// The mapping of one port. See the module documentation.
#[derive(Debug)]
pub struct PortMapper {
    rng: ChaCha20Rng,
    target: Option<MappingTarget>,
    phase: Phase,
    /// The mapping in force, and its end.
    held: Option<(GrantedMapping, Instant)>,
    /// The last external address, and the time since which it is known.
    told: Option<(SocketAddrV4, Instant)>,
    removals: VecDeque<GrantedMapping>,
    /// Failures of this round.
    round: BTreeMap<MappingProtocol, MappingFailure>,
    /// Failures of the last round that failed.
    failures: BTreeMap<MappingProtocol, MappingFailure>,
    rounds_failed: u32,
    asked: Option<Instant>,
}

impl PortMapper {
    /// Creates a machine that wants no mapping.
    pub fn new(rng: ChaCha20Rng) -> Self {
        Self {
            rng,
            target: None,
            phase: Phase::Idle,
            held: None,
            told: None,
            removals: VecDeque::new(),
            round: BTreeMap::new(),
            failures: BTreeMap::new(),
            rounds_failed: 0,
            asked: None,
        }
    }

    /// Sets the port that is to be mapped, or none.
    pub fn set_target(&mut self, target: Option<MappingTarget>) {
        if self.target == target {
            return;
        }
        self.target = target;
        self.told = None;
        self.round.clear();
        self.failures.clear();
        self.rounds_failed = 0;
        if let Some((held, _)) = self.held.take_if(|(held, _)| Some(held.target) != target) {
            self.remove(held);
        }
        if !matches!(self.phase, Phase::Asking { .. }) {
            self.phase = self.fresh_phase();
        }
    }

    /// Asks again soon, because the network changed: the gateway may be another, or may have restarted.
    pub fn network_changed(&mut self, now: Instant) {
        if let Phase::Waiting { at } = self.phase {
            let soon = self.asked.map_or(now, |asked| asked + AGAIN_MIN).max(now);
            self.phase = Phase::Waiting { at: at.min(soon) };
            self.rounds_failed = 0;
        }
    }

    /// Takes the answer to the request that is under way.
    pub fn answered(&mut self, now: Instant, answer: Result<GrantedMapping, MappingFailure>) {
        let Phase::Asking { protocol, target } = self.phase else { return };
        let answer = answer.and_then(usable);
        if self.target != Some(target) {
            self.phase = self.fresh_phase();
            if let Ok(late) = answer {
                self.remove(late);
            }
            return;
        }
        match answer.and_then(|mapping| self.believe(now, mapping)) {
            Ok(mapping) => {
                // It stands until it is renewed, however short a time the gateway says.
                self.held = Some((mapping, now + mapping.lifetime.max(2 * RENEW_MIN)));
                self.round.clear();
                self.failures.clear();
                self.rounds_failed = 0;
                self.phase = Phase::Waiting { at: now + (mapping.lifetime / 2).clamp(RENEW_MIN, RENEW_MAX) };
            }
            Err(failure) => {
                self.round.insert(protocol, failure);
                self.phase = Phase::Due;
                if self.next_protocol().is_none() {
                    self.failures = std::mem::take(&mut self.round);
                    self.rounds_failed = self.rounds_failed.saturating_add(1);
                    let wait = doubled(RETRY_MIN, self.rounds_failed, RETRY_MAX, &mut self.rng);
                    self.phase = Phase::Waiting { at: now + wait };
                }
            }
        }
    }

    /// Returns the next work. The driver calls this again when it has carried out the last.
    pub fn poll(&mut self, now: Instant) -> Option<MapperOutput> {
        if let Some(mapping) = self.removals.pop_front() {
            return Some(MapperOutput::Remove(mapping));
        }
        let (target, Phase::Due) = (self.target?, self.phase) else { return None };
        let protocol = self.next_protocol()?;
        self.phase = Phase::Asking { protocol, target };
        self.asked = Some(now);
        let renews = self.held.map(|(held, _)| held).filter(|held| held.protocol == protocol);
        Some(MapperOutput::Ask { protocol, target, renews })
    }

    /// Returns the time of the next call of [`PortMapper::handle_timeout`].
    pub fn deadline(&self) -> Option<Instant> {
        let end = self.held.map(|(_, end)| end);
        match self.phase {
            Phase::Waiting { at } => Some(end.map_or(at, |end| end.min(at))),
            Phase::Idle | Phase::Due | Phase::Asking { .. } => end,
        }
    }

    /// Begins the round that is due, and forgets a mapping that ended.
    pub fn handle_timeout(&mut self, now: Instant) {
        self.held.take_if(|(_, end)| *end <= now);
        if matches!(self.phase, Phase::Waiting { at } if at <= now) {
            self.phase = Phase::Due;
        }
    }

    /// Returns the mapping in force, and its end.
    pub fn mapping(&self) -> Option<(GrantedMapping, Instant)> {
        self.held
    }

    /// Returns `true` while the first answer is awaited.
    pub fn is_looking(&self) -> bool {
        self.held.is_none() && self.failures.is_empty() && self.phase != Phase::Idle
    }

    /// Returns the failures of the last round, if it failed.
    pub fn failures(&self) -> &BTreeMap<MappingProtocol, MappingFailure> {
        &self.failures
    }

    /// Refuses an external address that follows another too soon.
    fn believe(&mut self, now: Instant, mapping: GrantedMapping) -> Result<GrantedMapping, MappingFailure> {
        match self.told {
            Some((external, _)) if external == mapping.external => {}
            Some((_, since)) if now < since + STABLE_MIN => return Err(MappingFailure::Unstable),
            _ => self.told = Some((mapping.external, now)),
        }
        Ok(mapping)
    }

    fn fresh_phase(&self) -> Phase {
        if self.target.is_some() { Phase::Due } else { Phase::Idle }
    }

    /// Removes a mapping, unless this host has left the gateway or changed its address: then it ends with its lifetime,
    /// because gateways let each address remove its own mappings alone.
    fn remove(&mut self, mapping: GrantedMapping) {
        let is_here = self.target.is_none_or(|target| {
            (target.gateway, target.host) == (mapping.target.gateway, mapping.target.host)
        });
        if is_here && self.removals.len() < REMOVALS_MAX {
            self.removals.push_back(mapping);
        }
    }

    /// Returns the protocol of the next request of this round: that of the mapping in force first.
    fn next_protocol(&self) -> Option<MappingProtocol> {
        let known = self.held.map(|(held, _)| held.protocol);
        let order = known.into_iter().chain(MappingProtocol::ALL);
        order.into_iter().find(|protocol| !self.round.contains_key(protocol))
    }
}

/// Refuses a mapping that no peer could use. A private address is one behind another NAT, which may be the peer's, too.
fn usable(mapping: GrantedMapping) -> Result<GrantedMapping, MappingFailure> {
    if !is_checkable(&SocketAddr::V4(mapping.external)) {
        return Err(MappingFailure::NoExternalAddress);
    }
    if mapping.lifetime.is_zero() {
        return Err(MappingFailure::Malformed);
    }
    Ok(mapping)
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used, clippy::disallowed_methods)]

    use rand_core::SeedableRng as _;

    use super::*;

    const SECOND: Duration = Duration::from_secs(1);

    fn target(gateway: u8, port: u16) -> MappingTarget {
        MappingTarget {
            gateway: [192, 168, gateway, 1].into(),
            host: [192, 168, gateway, 7].into(),
            port: NonZeroU16::new(port).unwrap(),
        }
    }

    fn granted(protocol: MappingProtocol, target: MappingTarget, lifetime: Duration) -> GrantedMapping {
        let external = SocketAddrV4::new([203, 0, 113, 9].into(), target.port.get());
        GrantedMapping { protocol, target, external, lifetime, nonce: [1, 2, 3] }
    }

    /// A machine and the present time.
    struct Bench {
        mapper: PortMapper,
        now: Instant,
    }

    impl Bench {
        fn new(target: MappingTarget) -> Self {
            let mut mapper = PortMapper::new(ChaCha20Rng::seed_from_u64(1));
            assert_eq!(mapper.poll(Instant::now()), None);
            mapper.set_target(Some(target));
            Self { mapper, now: Instant::now() }
        }

        /// Takes the request that is due.
        fn asked(&mut self) -> (MappingProtocol, Option<GrantedMapping>) {
            let Some(MapperOutput::Ask { protocol, target, renews }) = self.mapper.poll(self.now) else {
                panic!("nothing is asked: {:?}", self.mapper)
            };
            assert_eq!((Some(target), self.mapper.poll(self.now)), (self.mapper.target, None));
            (protocol, renews)
        }

        /// Lets all requests of a round fail. Returns their protocols.
        fn fail_round(&mut self) -> Vec<MappingProtocol> {
            let mut asked = Vec::new();
            while matches!(self.mapper.phase, Phase::Due) {
                asked.push(self.asked().0);
                self.mapper.answered(self.now, Err(MappingFailure::NoAnswer));
            }
            asked
        }

        fn grant(&mut self, lifetime: Duration) -> GrantedMapping {
            let (protocol, _) = self.asked();
            let mapping = granted(protocol, self.mapper.target.unwrap(), lifetime);
            self.mapper.answered(self.now, Ok(mapping));
            mapping
        }

        /// Lets time pass to the deadline. Returns the time that passed.
        fn wait(&mut self) -> Duration {
            let before = self.now;
            self.now = self.mapper.deadline().unwrap();
            self.mapper.handle_timeout(self.now);
            self.now - before
        }
    }

    #[test]
    fn protocols_are_tried_in_turn_and_rounds_become_rare() {
        let mut bench = Bench::new(target(0, 5000));
        assert!(bench.mapper.is_looking());
        let mut waits = Vec::new();
        for _ in 0..8 {
            assert_eq!(bench.fail_round(), MappingProtocol::ALL);
            assert_eq!(bench.mapper.failures().len(), 3);
            assert!(!bench.mapper.is_looking() && bench.mapper.poll(bench.now).is_none());
            waits.push(bench.wait());
        }
        for (n, wait) in waits.iter().enumerate() {
            let most = (RETRY_MIN * (1 << n.min(6))).min(RETRY_MAX);
            assert!((most / 2..=most).contains(wait), "{n}: {waits:?}");
        }
        // The second protocol has it now.
        assert_eq!(bench.asked().0, MappingProtocol::Pcp);
        bench.mapper.answered(bench.now, Err(MappingFailure::Unsupported));
        let mapping = bench.grant(MAPPING_LIFETIME);
        assert_eq!(mapping.protocol, MappingProtocol::NatPmp);
        assert_eq!(bench.mapper.mapping(), Some((mapping, bench.now + MAPPING_LIFETIME)));
        assert!(bench.mapper.failures().is_empty());
    }

    #[test]
    fn mapping_is_renewed_at_half_its_lifetime_within_bounds() {
        for (lifetime, after) in [(MAPPING_LIFETIME, 600), (60 * SECOND, 30), (SECOND * 10, 5)] {
            let mut bench = Bench::new(target(0, 5000));
            let mapping = bench.grant(lifetime);
            assert_eq!(bench.wait(), after * SECOND);
            let (protocol, renews) = bench.asked();
            assert_eq!((protocol, renews), (MappingProtocol::Pcp, Some(mapping)));
            bench.mapper.answered(bench.now, Ok(mapping));
            assert_eq!(bench.mapper.mapping().unwrap().1, bench.now + lifetime);
        }
        // A gateway that lies about lifetimes is not asked more often than every four seconds.
        let mut bench = Bench::new(target(0, 5000));
        let mapping = bench.grant(SECOND);
        assert_eq!((bench.wait(), bench.mapper.mapping().unwrap().0), (RENEW_MIN, mapping));
        bench.asked();
    }

    #[test]
    fn gateway_that_names_other_addresses_again_and_again_is_not_believed() {
        let mut bench = Bench::new(target(0, 5000));
        let first = bench.grant(SECOND);
        bench.wait();
        let (protocol, _) = bench.asked();
        let other = GrantedMapping { external: "203.0.113.9:7777".parse().unwrap(), ..first };
        bench.mapper.answered(bench.now, Ok(other));
        assert_eq!(bench.mapper.round.get(&protocol), Some(&MappingFailure::Unstable));
        assert_eq!(bench.mapper.mapping().unwrap().0, first);
        // A gateway that restarted may have given the port to another host.
        bench.fail_round();
        bench.now += STABLE_MIN;
        bench.mapper.handle_timeout(bench.now);
        bench.asked();
        bench.mapper.answered(bench.now, Ok(other));
        assert_eq!(bench.mapper.mapping().unwrap().0, other);
    }

    #[test]
    fn mapping_that_is_not_renewed_stands_to_its_end_and_other_protocols_are_tried() {
        let mut bench = Bench::new(target(0, 5000));
        bench.asked();
        bench.mapper.answered(bench.now, Err(MappingFailure::NoAnswer));
        let mapping = bench.grant(100 * SECOND);
        let end = bench.now + 100 * SECOND;
        bench.wait();
        assert_eq!(
            bench.fail_round(),
            [MappingProtocol::NatPmp, MappingProtocol::Pcp, MappingProtocol::UpnpIgd]
        );
        assert_eq!(bench.mapper.mapping(), Some((mapping, end)));
        while bench.now < end {
            bench.wait();
            bench.fail_round();
        }
        assert_eq!(bench.mapper.mapping(), None);
        assert!(bench.mapper.poll(bench.now).is_none(), "nothing is left to be removed");
    }

    #[test]
    fn mapping_is_removed_when_it_is_not_wanted_and_at_another_port() {
        let mut bench = Bench::new(target(0, 5000));
        let first = bench.grant(MAPPING_LIFETIME);
        bench.mapper.set_target(Some(target(0, 6000)));
        assert_eq!(bench.mapper.mapping(), None);
        assert_eq!(bench.mapper.poll(bench.now), Some(MapperOutput::Remove(first)));
        let second = bench.grant(MAPPING_LIFETIME);
        bench.mapper.set_target(None);
        assert_eq!(bench.mapper.poll(bench.now), Some(MapperOutput::Remove(second)));
        assert_eq!((bench.mapper.poll(bench.now), bench.mapper.deadline()), (None, None));
        // The next network has another gateway, which cannot remove it.
        bench.mapper.set_target(Some(target(0, 6000)));
        bench.grant(MAPPING_LIFETIME);
        bench.mapper.set_target(Some(target(1, 6000)));
        assert_eq!(bench.asked(), (MappingProtocol::Pcp, None));
    }

    #[test]
    fn answer_that_comes_too_late_is_removed() {
        let mut bench = Bench::new(target(0, 5000));
        bench.asked();
        let late = granted(MappingProtocol::Pcp, target(0, 5000), MAPPING_LIFETIME);
        bench.mapper.set_target(Some(target(0, 6000)));
        assert_eq!(bench.mapper.poll(bench.now), None, "one request at a time");
        bench.mapper.answered(bench.now, Ok(late));
        assert_eq!(bench.mapper.poll(bench.now), Some(MapperOutput::Remove(late)));
        assert_eq!(bench.asked(), (MappingProtocol::Pcp, None));
        bench.mapper.set_target(None);
        bench.mapper.answered(bench.now, Err(MappingFailure::NoAnswer));
        assert_eq!((bench.mapper.poll(bench.now), bench.mapper.deadline()), (None, None));
    }

    #[test]
    fn change_of_the_network_asks_again_soon_but_not_at_each_change() {
        let mut bench = Bench::new(target(0, 5000));
        bench.grant(MAPPING_LIFETIME);
        bench.now += 10 * SECOND;
        for _ in 0..3 {
            bench.mapper.network_changed(bench.now);
        }
        assert_eq!(bench.wait(), 20 * SECOND);
        assert!(bench.asked().1.is_some());
        bench.mapper.answered(bench.now, Err(MappingFailure::NoAnswer));
        bench.fail_round();
        bench.now += 40 * SECOND;
        bench.mapper.network_changed(bench.now);
        assert_eq!(bench.wait(), Duration::ZERO);
        bench.asked();
    }

    #[test]
    fn mapping_that_nobody_could_use_counts_as_a_failure() {
        for (external, lifetime, failure) in [
            ("0.0.0.0:5000", MAPPING_LIFETIME, MappingFailure::NoExternalAddress),
            ("127.0.0.1:5000", MAPPING_LIFETIME, MappingFailure::NoExternalAddress),
            ("169.254.0.1:5000", MAPPING_LIFETIME, MappingFailure::NoExternalAddress),
            ("224.0.0.1:5000", MAPPING_LIFETIME, MappingFailure::NoExternalAddress),
            ("203.0.113.9:0", MAPPING_LIFETIME, MappingFailure::NoExternalAddress),
            ("203.0.113.9:5000", Duration::ZERO, MappingFailure::Malformed),
        ] {
            let mut bench = Bench::new(target(0, 5000));
            let (protocol, _) = bench.asked();
            let mapping = granted(protocol, target(0, 5000), lifetime);
            let mapping = GrantedMapping { external: external.parse().unwrap(), ..mapping };
            bench.mapper.answered(bench.now, Ok(mapping));
            assert_eq!(bench.mapper.round.get(&protocol), Some(&failure), "{external}");
            assert_eq!(bench.mapper.mapping(), None);
            assert_eq!(bench.asked().0, MappingProtocol::NatPmp);
        }
        // Behind another NAT, peers on the same network could still use it.
        let mut bench = Bench::new(target(0, 5000));
        let (protocol, _) = bench.asked();
        let external = "10.0.0.9:5000".parse().unwrap();
        let mapping = GrantedMapping { external, ..granted(protocol, target(0, 5000), MAPPING_LIFETIME) };
        bench.mapper.answered(bench.now, Ok(mapping));
        assert_eq!(bench.mapper.mapping().unwrap().0, mapping);
    }
}
