//! NATs and firewalls: the ports that they map, and the packets that they let in (RFC 4787).
//!
//! A [`Nat`] knows neither hosts nor other NATs; `networks.rs` arranges them.

use std::collections::BTreeMap;
use std::net::{IpAddr, SocketAddr};
use std::time::{Duration, Instant};

/// Time after which common NATs forget an unused UDP mapping.
const IDLE_MAX: Duration = Duration::from_secs(30);
/// First port that a NAT maps.
const PORT_MIN: u16 = 20_000;

/// The part of a remote address on which a NAT's decision depends (RFC 4787, 4.1 and 5).
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub enum Dependence {
    /// None: endpoint-independent.
    Nothing,
    /// The address.
    Address,
    /// The address and the port.
    AddressAndPort,
}

impl Dependence {
    /// Returns the part of a remote address that counts.
    fn key(self, remote: SocketAddr) -> Option<SocketAddr> {
        match self {
            Self::Nothing => None,
            Self::Address => Some(SocketAddr::new(remote.ip(), 0)),
            Self::AddressAndPort => Some(remote),
        }
    }
}

/// The behaviour of a NAT or a firewall.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct NatKind {
    /// The remote addresses for which a socket inside has one port outside; `None` for a firewall, which translates
    /// nothing.
    pub mapping: Option<Dependence>,
    /// The remote addresses from which packets are let in after a packet was sent to one.
    pub filtering: Dependence,
    /// Hosts inside reach each other at their addresses outside.
    pub hairpins: bool,
    /// UDP does not pass at all.
    pub blocks_udp: bool,
    /// Time without a packet from inside after which a mapping is forgotten.
    pub idle_max: Duration,
}

impl NatKind {
    /// Endpoint-independent mapping and filtering.
    pub const FULL_CONE: Self = Self::of(Dependence::Nothing, Dependence::Nothing);
    /// Endpoint-independent mapping and address-dependent filtering.
    pub const ADDRESS_RESTRICTED: Self = Self::of(Dependence::Nothing, Dependence::Address);
    /// Endpoint-independent mapping, and filtering that depends on address and port.
    pub const PORT_RESTRICTED: Self = Self::of(Dependence::Nothing, Dependence::AddressAndPort);
    /// Mapping and filtering that depend on address and port.
    pub const SYMMETRIC: Self = Self::of(Dependence::AddressAndPort, Dependence::AddressAndPort);
    /// A stateful firewall in front of public addresses.
    pub const FIREWALL: Self = Self { mapping: None, ..Self::PORT_RESTRICTED };
    /// A NAT that lets no UDP pass.
    pub const UDP_BLOCKED: Self = Self { blocks_udp: true, ..Self::PORT_RESTRICTED };

    /// Returns a NAT without hairpinning that forgets after 30 s.
    pub const fn of(mapping: Dependence, filtering: Dependence) -> Self {
        Self { mapping: Some(mapping), filtering, hairpins: false, blocks_udp: false, idle_max: IDLE_MAX }
    }

    /// Lets hosts inside reach each other at their addresses outside.
    #[must_use]
    pub const fn hairpinning(self) -> Self {
        Self { hairpins: true, ..self }
    }
}

/// A mapping of a socket inside.
#[derive(Clone, Debug)]
struct Mapping {
    inside: SocketAddr,
    key: Option<SocketAddr>,
    outside: SocketAddr,
    used: Instant,
}

/// A NAT or a firewall, with its table.
#[derive(Clone, Debug)]
pub struct Nat {
    kind: NatKind,
    outside: IpAddr,
    next_port: u16,
    mappings: Vec<Mapping>,
    /// Time of the last packet from an outside address to a remote one, as far as the filter distinguishes those.
    sent: BTreeMap<(SocketAddr, Option<SocketAddr>), Instant>,
}

impl Nat {
    /// Returns a NAT with an empty table. A firewall has no use for the address outside.
    pub fn new(kind: NatKind, outside: IpAddr) -> Self {
        Self { kind, outside, next_port: PORT_MIN, mappings: Vec::new(), sent: BTreeMap::new() }
    }

    /// Returns the behaviour.
    pub fn kind(&self) -> NatKind {
        self.kind
    }

    /// Returns the address outside.
    pub fn outside(&self) -> IpAddr {
        self.outside
    }

    /// Loses the table, as a restart does. Sockets inside get other ports from here on.
    pub fn forget(&mut self) {
        self.mappings.clear();
        self.sent.clear();
    }

    /// Lets a packet out. Returns its source outside, or `None` if it does not pass.
    pub fn outward(&mut self, now: Instant, from: SocketAddr, to: SocketAddr) -> Option<SocketAddr> {
        if self.kind.blocks_udp {
            return None;
        }
        self.expire(now);
        let source = match self.kind.mapping {
            None => from,
            Some(mapping) => self.map(now, from, mapping.key(to)),
        };
        self.sent.insert((source, self.kind.filtering.key(to)), now);
        Some(source)
    }

    /// Lets a packet in. Returns its destination inside, or `None` if it does not pass.
    pub fn inward(&mut self, now: Instant, from: SocketAddr, to: SocketAddr) -> Option<SocketAddr> {
        if self.kind.blocks_udp {
            return None;
        }
        self.expire(now);
        if !self.sent.contains_key(&(to, self.kind.filtering.key(from))) {
            return None;
        }
        match self.kind.mapping {
            None => Some(to),
            Some(_) => {
                self.mappings.iter().find(|mapping| mapping.outside == to).map(|mapping| mapping.inside)
            }
        }
    }

    /// Forgets what was not used for too long.
    fn expire(&mut self, now: Instant) {
        let idle_max = self.kind.idle_max;
        self.mappings.retain(|mapping| now.saturating_duration_since(mapping.used) < idle_max);
        self.sent.retain(|_, at| now.saturating_duration_since(*at) < idle_max);
    }

    fn map(&mut self, now: Instant, inside: SocketAddr, key: Option<SocketAddr>) -> SocketAddr {
        let known = self.mappings.iter_mut().find(|known| (known.inside, known.key) == (inside, key));
        if let Some(known) = known {
            known.used = now;
            return known.outside;
        }
        let outside = SocketAddr::new(self.outside, self.next_port);
        self.next_port = self.next_port.checked_add(1).unwrap_or(PORT_MIN);
        self.mappings.push(Mapping { inside, key, outside, used: now });
        outside
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::clock::Clock;

    const INSIDE: &str = "192.168.1.2:5000";
    const OUTSIDE: [u8; 4] = [203, 1, 0, 1];

    fn at(text: &str) -> SocketAddr {
        text.parse().unwrap()
    }

    fn nat(kind: NatKind) -> (Nat, Instant) {
        (Nat::new(kind, OUTSIDE.into()), Clock::default().instant())
    }

    /// Remote addresses: one, its other port, and another address.
    const REMOTES: [&str; 3] = ["198.18.0.1:1", "198.18.0.1:2", "198.18.0.2:1"];

    #[test]
    fn ports_depend_on_what_the_mapping_says() {
        let all = [Dependence::Nothing, Dependence::Address, Dependence::AddressAndPort];
        for (mapping, ports) in all.into_iter().zip([1, 2, 3]) {
            let (mut nat, now) = nat(NatKind::of(mapping, Dependence::Nothing));
            let mut sources: Vec<_> =
                REMOTES.iter().filter_map(|to| nat.outward(now, at(INSIDE), at(to))).collect();
            assert!(sources.iter().all(|source| source.ip() == IpAddr::from(OUTSIDE)));
            sources.dedup();
            assert_eq!(sources.len(), ports, "{mapping:?}");
            let other = nat.outward(now, at("192.168.1.3:5000"), at(REMOTES[0]));
            assert!(!sources.contains(&other.unwrap()));
        }
    }

    #[test]
    fn packets_come_in_as_the_filter_says() {
        let all = [Dependence::Nothing, Dependence::Address, Dependence::AddressAndPort];
        for (filtering, lets_in) in
            all.into_iter().zip([[true; 3], [true, true, false], [true, false, false]])
        {
            for kind in
                [NatKind::of(Dependence::Nothing, filtering), NatKind { filtering, ..NatKind::FIREWALL }]
            {
                let (mut nat, now) = nat(kind);
                let to = if kind.mapping.is_some() { at("203.1.0.1:20000") } else { at(INSIDE) };
                assert_eq!(nat.inward(now, at(REMOTES[0]), to), None, "nothing was sent");
                assert_eq!(nat.outward(now, at(INSIDE), at(REMOTES[0])), Some(to));
                let came = REMOTES.map(|from| nat.inward(now, at(from), to));
                assert_eq!(came, lets_in.map(|lets| lets.then(|| at(INSIDE))), "{kind:?}");
            }
        }
    }

    #[test]
    fn unused_and_lost_mappings_are_replaced() {
        let (mut nat, now) = nat(NatKind::PORT_RESTRICTED);
        let first = nat.outward(now, at(INSIDE), at(REMOTES[0])).unwrap();
        let nearly = now + IDLE_MAX - Duration::from_millis(1);
        assert_eq!(nat.outward(nearly, at(INSIDE), at(REMOTES[1])), Some(first), "kept in use");
        let (open, closed) = (at(REMOTES[1]), at(REMOTES[0]));
        assert_eq!(nat.inward(now + IDLE_MAX, open, first), Some(at(INSIDE)));
        assert_eq!(nat.inward(now + IDLE_MAX, closed, first), None, "nothing was sent to it for too long");
        let second = nat.outward(nearly + IDLE_MAX, at(INSIDE), open).unwrap();
        assert_ne!(first, second);
        nat.forget();
        assert_eq!(nat.inward(nearly + IDLE_MAX, open, second), None);
        assert_ne!(nat.outward(nearly + IDLE_MAX, at(INSIDE), open), Some(second));
    }

    #[test]
    fn no_udp_passes_where_it_is_blocked() {
        let (mut nat, now) = nat(NatKind::UDP_BLOCKED);
        assert_eq!(nat.outward(now, at(INSIDE), at(REMOTES[0])), None);
    }
}
