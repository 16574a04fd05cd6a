//! The addresses between which checks go.

use std::collections::BTreeSet;
use std::net::{IpAddr, SocketAddr};

use sgc_wire::{CandidateKind, PATH_CANDIDATES_MAX};

use crate::is_of_host;

/// Most reflexive addresses that peers are told; routers at several places may see several.
pub const REFLEXIVE_MAX: usize = 3;

/// An address at which this node may be reached.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub struct LocalAddress {
    /// Its origin.
    pub kind: CandidateKind,
    /// The address.
    pub address: SocketAddr,
    /// The address of the interface and the socket from which its packets leave; `address` itself for a host address.
    pub base: SocketAddr,
}

/// Returns the addresses that peers are told: that of the port mapping, which admits every peer, those that routers see,
/// then `hosts`, those of the sockets on this host's interfaces. `mapped` has the address of the interface, too.
pub fn local_addresses(
    hosts: &[SocketAddr],
    mapped: Option<(SocketAddr, IpAddr)>,
    reflexive: &BTreeSet<SocketAddr>,
) -> Vec<LocalAddress> {
    let translated = |address: &SocketAddr, base: Option<&SocketAddr>| {
        let is_translated = !hosts.contains(address);
        let (kind, address, base) = (CandidateKind::ServerReflexive, *address, *base?);
        is_translated.then_some(LocalAddress { kind, address, base })
    };
    // The first interface of its family stands for all: the socket is the same.
    let seen = |address: &SocketAddr| {
        translated(address, hosts.iter().find(|host| host.is_ipv4() == address.is_ipv4()))
    };
    let external = mapped.map(|(external, _)| external);
    let mapped =
        mapped.and_then(|(external, ip)| translated(&external, hosts.iter().find(|host| host.ip() == ip)));
    let of_host =
        |address: &SocketAddr| LocalAddress { kind: CandidateKind::Host, address: *address, base: *address };
    let others = reflexive.iter().filter(|address| Some(**address) != external);
    let reflexive = others.filter_map(seen).take(REFLEXIVE_MAX);
    mapped.into_iter().chain(reflexive).chain(hosts.iter().map(of_host)).take(PATH_CANDIDATES_MAX).collect()
}

/// Returns `true` for an address to which checks may go: of one host, and neither of this host itself nor of a single
/// network segment.
pub fn is_checkable(address: &SocketAddr) -> bool {
    let is_near = match address.ip().to_canonical() {
        IpAddr::V4(v4) => v4.is_loopback() || v4.is_link_local(),
        IpAddr::V6(v6) => v6.is_loopback() || v6.is_unicast_link_local(),
    };
    let canonical = SocketAddr::new(address.ip().to_canonical(), address.port());
    !is_near && is_of_host(&canonical)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn checks_go_to_other_hosts_alone() {
        let checkable = |text: &str| is_checkable(&text.parse().unwrap());
        for good in ["10.0.0.7:1", "203.0.113.7:4000", "[2001:db8::7]:4000", "[fd00::7]:1"] {
            assert!(checkable(good), "{good}");
        }
        for bad in [
            "127.0.0.1:1",
            "[::ffff:127.0.0.1]:1",
            "169.254.1.1:1",
            "224.0.0.251:5353",
            "[::ffff:224.0.0.251]:5353",
            "255.255.255.255:1",
            "0.0.0.0:1",
            "10.0.0.7:0",
            "[::1]:1",
            "[fe80::7]:1",
            "[ff02::fb]:5353",
            "[::]:1",
        ] {
            assert!(!checkable(bad), "{bad}");
        }
    }
}
