//! Ports for listeners that a test starts later, or never.

use std::net::{Ipv4Addr, TcpListener, UdpSocket};
use std::sync::atomic::{AtomicU16, Ordering};

/// The first port above those that Linux gives to sockets that ask for any (`ip_local_port_range`, by default 32768 to 60999).
const FIRST: u16 = 61_000;
const COUNT: u16 = u16::MAX - FIRST;

/// Returns a port that no socket of this host has, neither of TCP nor of UDP, and that no later call in this process returns.
///
/// A port that a socket had a moment ago does not do: the system soon gives it to another test, which then answers there. These
/// ports are given to nobody who does not name them.
///
/// # Panics
///
/// If every such port is taken.
pub fn unused_port() -> u16 {
    static GIVEN: AtomicU16 = AtomicU16::new(0);
    // Processes that run at the same time begin far apart.
    let start = (std::process::id() % 64) as u16 * (COUNT / 64);
    for _ in 0..COUNT {
        let given = GIVEN.fetch_add(1, Ordering::Relaxed);
        let port = FIRST + start.wrapping_add(given) % COUNT;
        let here = (Ipv4Addr::UNSPECIFIED, port);
        if TcpListener::bind(here).is_ok() && UdpSocket::bind(here).is_ok() {
            return port;
        }
    }
    panic!("every port from {FIRST} is taken");
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn port_is_given_once_and_not_while_a_socket_has_it() {
        let first = unused_port();
        let next = if first == FIRST + COUNT - 1 { FIRST } else { first + 1 };
        let _taken = UdpSocket::bind((Ipv4Addr::LOCALHOST, next)).unwrap();
        let second = unused_port();
        assert!(second != first && second != next, "{first} {next} {second}");
    }
}
