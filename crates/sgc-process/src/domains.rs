//! Reserves ROS domains that no other program uses, so that two demos on one host, or a demo and a robot, do not meet.
//!
//! A reservation is an abstract Unix socket. It vanishes with the process, however that ends, and has the same scope as
//! the domain's loopback interface: the network namespace.

use std::io;
use std::net::{Ipv4Addr, UdpSocket};
use std::ops::RangeInclusive;
use std::os::linux::net::SocketAddrExt;
use std::os::unix::net::{SocketAddr, UnixListener};

/// Domains to choose from. Users take small numbers, and the ports of domains above 101 are ephemeral ports of the
/// system.
const DOMAINS: RangeInclusive<u32> = 20..=69;

/// The reservation of a domain, released when it is dropped.
#[derive(Debug)]
pub struct DomainLock {
    id: u32,
    _lock: UnixListener,
}

impl DomainLock {
    /// Returns the domain's number.
    pub fn id(&self) -> u32 {
        self.id
    }
}

/// Finds and reserves two free domains. `seed` selects where the search begins, so that processes rarely collide.
pub fn lock_two(seed: u32) -> Option<[DomainLock; 2]> {
    let mut free = free(seed);
    Some([free.next()?, free.next()?])
}

/// Finds and reserves one free domain.
pub fn lock_one(seed: u32) -> Option<DomainLock> {
    free(seed).next()
}

fn free(seed: u32) -> impl Iterator<Item = DomainLock> {
    let count = DOMAINS.end() - DOMAINS.start() + 1;
    (0..count).map(move |i| DOMAINS.start() + (seed.wrapping_add(i)) % count).filter_map(hold)
}

fn hold(id: u32) -> Option<DomainLock> {
    let lock = lock(id).ok()?;
    is_quiet(id).then_some(DomainLock { id, _lock: lock })
}

fn lock(id: u32) -> io::Result<UnixListener> {
    UnixListener::bind_addr(&SocketAddr::from_abstract_name(format!("sgc-demo-domain-{id}"))?)
}

/// Returns `true` if no participant of this host is in the domain: its multicast port and the ports of the first few
/// participants are free (RTPS 2.5, 9.6.2.3).
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
    fn reserved_domain_is_not_given_twice() {
        let [a, b] = lock_two(1).unwrap();
        assert_ne!(a.id(), b.id());
        let others = lock_two(1).unwrap();
        assert!(others.iter().all(|other| other.id() != a.id() && other.id() != b.id()));
        drop(a);
        drop(b);
    }

    #[test]
    fn domain_with_participant_is_skipped() {
        let [a, _b] = lock_two(17).unwrap();
        let id = a.id();
        drop(a);
        let port = u16::try_from(7400 + 250 * id + 10).unwrap();
        let _participant = UdpSocket::bind((Ipv4Addr::LOCALHOST, port)).unwrap();
        assert!(hold(id).is_none());
    }
}
