//! [`Networks`]: hosts and NATs in a tree whose root is the internet, and the ways of UDP packets between the hosts.

use std::collections::{BTreeMap, BTreeSet};
use std::net::{IpAddr, SocketAddr};
use std::time::Instant;

use sgc_router::DirectReach;

use crate::ids::NodeKey;
use crate::nat::{Nat, NatKind};

/// Port of the links' socket of each host.
const PORT: u16 = 5000;
/// Networks inside of NATs have one of so many prefixes, so those of strangers coincide, as they do at home.
const PREFIXES: usize = 3;
/// Rounds in which two hosts that meet tell all addresses: one for each that a symmetric NAT may add.
const ROUNDS: usize = 6;

/// A NAT of a world.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub struct NatKey(pub usize);

#[derive(Clone, Debug)]
struct Host {
    /// The NAT before it; `None` for a host of the internet.
    behind: Option<NatKey>,
    address: SocketAddr,
}

#[derive(Clone, Debug)]
struct Site {
    nat: Nat,
    behind: Option<NatKey>,
    /// Number of hosts and NATs that ever got an address inside.
    addresses: u8,
}

/// A UDP packet that reached a host.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) struct Arrived {
    pub(crate) node: NodeKey,
    /// Its source, as the host sees it.
    pub(crate) from: SocketAddr,
    /// The address of the host at which it arrived.
    pub(crate) to: SocketAddr,
}

/// Hosts, and the NATs between them.
#[derive(Clone, Debug, Default)]
pub struct Networks {
    sites: Vec<Site>,
    hosts: BTreeMap<NodeKey, Host>,
    /// Hosts between which no packet passes.
    cut: BTreeSet<(NodeKey, NodeKey)>,
}

impl Networks {
    /// Adds a NAT before a new network. `behind` is the NAT between it and the internet.
    pub fn add_nat(&mut self, kind: NatKind, behind: Option<NatKey>) -> NatKey {
        let key = NatKey(self.sites.len());
        let outside = self.new_address(behind, key.0 as u8, 0);
        self.sites.push(Site { nat: Nat::new(kind, outside), behind, addresses: 0 });
        key
    }

    /// Gives a host an address in the network behind a NAT, or in the internet. It loses its earlier one.
    pub fn place(&mut self, node: NodeKey, behind: Option<NatKey>) {
        let ip = self.new_address(behind, node.0 as u8, 1);
        self.hosts.insert(node, Host { behind, address: SocketAddr::new(ip, PORT) });
    }

    /// Returns an address inside of a NAT. Those of the internet are in networks of their own.
    fn new_address(&mut self, behind: Option<NatKey>, number: u8, of_host: u8) -> IpAddr {
        let Some(NatKey(site)) = behind else { return [203, of_host, number, 1].into() };
        let Site { nat, addresses, behind, .. } = &mut self.sites[site];
        *addresses += 1;
        match (nat.kind().mapping, *behind) {
            (None, _) => [203, 2, site as u8, *addresses].into(),
            (Some(_), None) => [192, 168, (site % PREFIXES) as u8, *addresses].into(),
            (Some(_), Some(_)) => [192, 168, ((site + 1) % PREFIXES) as u8, *addresses].into(),
        }
    }

    /// Returns the address of a host.
    pub fn address(&self, node: NodeKey) -> Option<SocketAddr> {
        self.hosts.get(&node).map(|host| host.address)
    }

    /// Returns the NAT before a host.
    pub fn nat_of(&self, node: NodeKey) -> Option<NatKey> {
        self.hosts.get(&node)?.behind
    }

    /// Returns where an address is for a host: in a network to which the host is attached, or elsewhere.
    pub(crate) fn reach(&self, node: NodeKey, address: IpAddr) -> DirectReach {
        match (self.address(node).map(|own| own.ip()), address) {
            (Some(IpAddr::V4(own)), IpAddr::V4(other)) if own.octets()[..3] == other.octets()[..3] => {
                DirectReach::Near
            }
            _ => DirectReach::Far,
        }
    }

    /// Lets a NAT lose its table.
    pub fn forget(&mut self, NatKey(site): NatKey) {
        self.sites[site].nat.forget();
    }

    /// Cuts or heals all paths between two hosts but those over routers.
    pub fn cut(&mut self, a: NodeKey, b: NodeKey, is_cut: bool) {
        let pair = (a.min(b), a.max(b));
        if is_cut {
            self.cut.insert(pair)
        } else {
            self.cut.remove(&pair)
        };
    }

    /// Carries a packet from the socket of a host. Returns the host that it reaches.
    pub(crate) fn carry(&mut self, now: Instant, from: NodeKey, to: SocketAddr) -> Option<Arrived> {
        let Host { behind, address } = self.hosts.get(&from)?.clone();
        let arrived = self.rise(now, behind, address, to)?;
        let pair = (from.min(arrived.node), from.max(arrived.node));
        (!self.cut.contains(&pair)).then_some(arrived)
    }

    /// Carries a packet with a forged source from the internet.
    pub(crate) fn carry_forged(&mut self, now: Instant, from: SocketAddr, to: SocketAddr) -> Option<Arrived> {
        self.descend(now, None, from, to)
    }

    /// Sends a packet to an address of the internet that is no host's. Returns the source that is seen there.
    pub(crate) fn seen_from(&mut self, now: Instant, node: NodeKey, by: SocketAddr) -> Option<SocketAddr> {
        let Host { mut behind, address: mut source } = self.hosts.get(&node)?.clone();
        while let Some(NatKey(site)) = behind {
            source = self.sites[site].nat.outward(now, source, by)?;
            behind = self.sites[site].behind;
        }
        Some(source)
    }

    /// Carries a packet from a network outwards, as far as it has to go.
    fn rise(
        &mut self,
        now: Instant,
        mut here: Option<NatKey>,
        mut from: SocketAddr,
        to: SocketAddr,
    ) -> Option<Arrived> {
        loop {
            if self.is_inside(here, to.ip()) {
                return self.descend(now, here, from, to);
            }
            let Site { nat, behind, .. } = &mut self.sites[here?.0];
            if nat.kind().mapping.is_some() && nat.outside() == to.ip() {
                if !nat.kind().hairpins {
                    return None;
                }
                // The receiver sees the address outside (RFC 4787, 6).
                from = nat.outward(now, from, to)?;
                let inside = nat.inward(now, from, to)?;
                return self.descend(now, here, from, inside);
            }
            from = nat.outward(now, from, to)?;
            here = *behind;
        }
    }

    /// Carries a packet inwards from a network.
    fn descend(
        &mut self,
        now: Instant,
        mut here: Option<NatKey>,
        from: SocketAddr,
        mut to: SocketAddr,
    ) -> Option<Arrived> {
        loop {
            let mut hosts = self.hosts.iter().filter(|(_, host)| host.behind == here);
            if let Some((node, _)) = hosts.find(|(_, host)| host.address == to) {
                return Some(Arrived { node: *node, from, to });
            }
            let next = (0..self.sites.len()).find(|site| self.leads_to(*site, here, to.ip()))?;
            to = self.sites[next].nat.inward(now, from, to)?;
            here = Some(NatKey(next));
        }
    }

    /// Returns `true` if an address is of a host or a NAT of this network.
    fn is_inside(&self, here: Option<NatKey>, ip: IpAddr) -> bool {
        self.hosts.values().any(|host| host.behind == here && host.address.ip() == ip)
            || (0..self.sites.len()).any(|site| self.leads_to(site, here, ip))
    }

    /// Returns `true` if packets to an address go through this NAT of the network `here`.
    fn leads_to(&self, site: usize, here: Option<NatKey>, ip: IpAddr) -> bool {
        let Site { nat, behind, .. } = &self.sites[site];
        *behind == here
            && match nat.kind().mapping {
                Some(_) => nat.outside() == ip,
                None => self.is_inside(Some(NatKey(site)), ip),
            }
    }

    /// Returns `true` if two hosts have a path when each tries all addresses of the other: its own, the one that its router
    /// sees, and those from which its packets come. It is the theory to which the product is held, and knows no ICE.
    pub fn lets_meet(&self, now: Instant, pair: [NodeKey; 2], routers: [Option<SocketAddr>; 2]) -> bool {
        let mut fresh = self.clone();
        fresh.sites.iter_mut().for_each(|site| site.nat.forget());
        let mut known = [BTreeSet::new(), BTreeSet::new()];
        for (side, node) in pair.into_iter().enumerate() {
            let seen = routers[side].and_then(|router| fresh.seen_from(now, node, router));
            known[1 - side].extend(fresh.address(node).into_iter().chain(seen));
        }
        for _ in 0..ROUNDS {
            for (side, node) in pair.into_iter().enumerate() {
                for to in known[side].clone() {
                    let Some(there) = fresh.carry(now, node, to).filter(|there| there.node == pair[1 - side])
                    else {
                        continue;
                    };
                    let back = fresh.carry(now, there.node, there.from);
                    if back.is_some_and(|back| (back.node, back.from) == (node, to)) {
                        return true;
                    }
                    known[1 - side].insert(there.from);
                }
            }
        }
        false
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::clock::Clock;
    use crate::nat::Dependence;

    const A: NodeKey = NodeKey(0);
    const B: NodeKey = NodeKey(1);
    const ROUTER: SocketAddr = SocketAddr::new(IpAddr::V4(std::net::Ipv4Addr::new(198, 51, 100, 1)), 7447);

    fn meet(networks: &Networks) -> bool {
        let now = Clock::default().instant();
        let meets = [[A, B], [B, A]].map(|pair| networks.lets_meet(now, pair, [Some(ROUTER); 2]));
        assert_eq!(meets[0], meets[1]);
        meets[0]
    }

    #[test]
    fn hosts_meet_through_nats_as_the_textbook_says() {
        let kinds = [
            None,
            Some(NatKind::FULL_CONE),
            Some(NatKind::ADDRESS_RESTRICTED),
            Some(NatKind::PORT_RESTRICTED),
            Some(NatKind::SYMMETRIC),
            Some(NatKind::FIREWALL),
            Some(NatKind::UDP_BLOCKED),
        ];
        for (a, b) in kinds.iter().flat_map(|a| kinds.iter().map(move |b| (*a, *b))) {
            let mut networks = Networks::default();
            for (node, kind) in [(A, a), (B, b)] {
                let nat = kind.map(|kind| networks.add_nat(kind, None));
                networks.place(node, nat);
            }
            let strict = [Some(NatKind::PORT_RESTRICTED), Some(NatKind::SYMMETRIC), Some(NatKind::FIREWALL)];
            let is_hopeless = |one, other| {
                one == Some(NatKind::UDP_BLOCKED)
                    || (one == Some(NatKind::SYMMETRIC) && strict.contains(&other))
            };
            assert_eq!(meet(&networks), !is_hopeless(a, b) && !is_hopeless(b, a), "{a:?} and {b:?}");
        }
    }

    #[test]
    fn hosts_behind_one_nat_meet_inside() {
        for kind in [NatKind::SYMMETRIC, NatKind::UDP_BLOCKED] {
            let mut networks = Networks::default();
            let nat = networks.add_nat(kind, None);
            networks.place(A, Some(nat));
            networks.place(B, Some(nat));
            assert!(meet(&networks));
            networks.cut(B, A, true);
            assert!(!meet(&networks));
        }
    }

    #[test]
    fn homes_behind_one_carrier_meet_only_if_it_hairpins() {
        for (carrier, home, meets) in [
            (NatKind::FULL_CONE, NatKind::FULL_CONE, false),
            (NatKind::FULL_CONE.hairpinning(), NatKind::PORT_RESTRICTED, true),
            (NatKind::PORT_RESTRICTED.hairpinning(), NatKind::PORT_RESTRICTED, true),
            (NatKind::SYMMETRIC.hairpinning(), NatKind::PORT_RESTRICTED, false),
        ] {
            let mut networks = Networks::default();
            let carrier = networks.add_nat(carrier, None);
            for node in [A, B] {
                let home = networks.add_nat(home, Some(carrier));
                networks.place(node, Some(home));
            }
            assert_eq!(meet(&networks), meets);
        }
    }

    #[test]
    fn strictest_nat_on_the_way_decides() {
        for (carrier, meets) in [(NatKind::PORT_RESTRICTED, true), (NatKind::SYMMETRIC, false)] {
            let mut networks = Networks::default();
            let carrier = networks.add_nat(carrier, None);
            let home = networks.add_nat(NatKind::of(Dependence::Nothing, Dependence::Address), Some(carrier));
            let other = networks.add_nat(NatKind::PORT_RESTRICTED, None);
            networks.place(A, Some(home));
            networks.place(B, Some(other));
            assert_eq!(meet(&networks), meets);
        }
    }
}
