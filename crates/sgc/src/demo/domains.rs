//! Two ROS domains that nobody else uses, so that two demos on one host, or a demo and a robot, do not meet.
//!
//! A demo holds its domains by abstract Unix sockets, which vanish with it whatever way it ends and which have the
//! scope of the loopback interface that the domains live on: the network namespace.

use std::io;
use std::net::{Ipv4Addr, UdpSocket};
use std::ops::RangeInclusive;
use std::os::linux::net::SocketAddrExt;
use std::os::unix::net::{SocketAddr, UnixListener};

/// Domains to choose from: people use small numbers, and above 101 the ports are the system's to give away.
const DOMAINS: RangeInclusive<u32> = 20..=69;

/// A domain, held until dropped.
#[derive(Debug)]
pub(crate) struct HeldDomain {
    id: u32,
    _lock: UnixListener,
}

impl HeldDomain {
    /// Its number.
    pub(crate) fn id(&self) -> u32 {
        self.id
    }
}

/// Finds and holds two free domains; the search begins at a place that differs from process to process.
pub(crate) fn hold_two(seed: u32) -> Option<[HeldDomain; 2]> {
    let mut free = free(seed);
    Some([free.next()?, free.next()?])
}

/// Finds and holds one.
pub(crate) fn hold_one(seed: u32) -> Option<HeldDomain> {
    free(seed).next()
}

fn free(seed: u32) -> impl Iterator<Item = HeldDomain> {
    let count = DOMAINS.end() - DOMAINS.start() + 1;
    (0..count).map(move |i| DOMAINS.start() + (seed.wrapping_add(i)) % count).filter_map(hold)
}

fn hold(id: u32) -> Option<HeldDomain> {
    let lock = lock(id).ok()?;
    is_quiet(id).then_some(HeldDomain { id, _lock: lock })
}

fn lock(id: u32) -> io::Result<UnixListener> {
    UnixListener::bind_addr(&SocketAddr::from_abstract_name(format!("sgc-demo-domain-{id}"))?)
}

/// True if no participant of this host is in the domain: nobody has its multicast port, nor the ports of the first
/// few participants (RTPS 2.5, 9.6.2.3).
fn is_quiet(id: u32) -> bool {
    let base = 7400 + 250 * id;
    [0, 10, 11, 12, 13].into_iter().all(|offset| {
        u16::try_from(base + offset).is_ok_and(|port| UdpSocket::bind((Ipv4Addr::UNSPECIFIED, port)).is_ok())
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_held_domain_is_not_given_twice() {
        let [a, b] = hold_two(1).unwrap();
        assert_ne!(a.id(), b.id());
        let others = hold_two(1).unwrap();
        assert!(others.iter().all(|other| other.id() != a.id() && other.id() != b.id()));
        drop(a);
        drop(b);
    }

    #[test]
    fn a_domain_with_a_participant_is_left_alone() {
        let [a, _b] = hold_two(17).unwrap();
        let id = a.id();
        drop(a);
        let port = u16::try_from(7400 + 250 * id + 10).unwrap();
        let _participant = UdpSocket::bind((Ipv4Addr::LOCALHOST, port)).unwrap();
        assert!(hold(id).is_none());
    }
}
