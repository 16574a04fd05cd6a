//! Ports for listeners that a test starts later, or never.

use std::net::{Ipv4Addr, TcpListener, UdpSocket};
use std::sync::atomic::{AtomicU16, Ordering};

/// The first port above Linux's ephemeral range (`ip_local_port_range`, by default 32768 to 60999).
const PORT_FIRST: u16 = 61_000;
/// The number of ports that [`unused_port`] gives, from the first one on.
const PORT_COUNT: u16 = u16::MAX - PORT_FIRST;

/// Returns a port above the ephemeral range that is free on IPv4. Repeats only after all ports were given.
///
/// The port is free for TCP and for UDP. Linux soon reuses an ephemeral port, so that another test would answer there.
/// It gives a port above the range only to a socket that asks for this port.
///
/// # Panics
///
/// If every such port is taken.
pub fn unused_port() -> u16 {
    static GIVEN: AtomicU16 = AtomicU16::new(0);
    // Processes that run at the same time mostly start far apart.
    let start = (std::process::id() % 64) as u16 * (PORT_COUNT / 64);
    for _ in 0..PORT_COUNT {
        let given = GIVEN.fetch_add(1, Ordering::Relaxed);
        let port = PORT_FIRST + start.wrapping_add(given) % PORT_COUNT;
        let here = (Ipv4Addr::UNSPECIFIED, port);
        if TcpListener::bind(here).is_ok() && UdpSocket::bind(here).is_ok() {
            return port;
        }
    }
    panic!("every port from {PORT_FIRST} is taken");
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn port_is_given_once_and_not_while_a_socket_has_it() {
        let first = unused_port();
        let next = if first == PORT_FIRST + PORT_COUNT - 1 { PORT_FIRST } else { first + 1 };
        // Another process may have the port, and may close it at any time.
        let taken = UdpSocket::bind((Ipv4Addr::LOCALHOST, next)).ok();
        let second = unused_port();
        assert!(second != first && (second != next || taken.is_none()), "{first} {next} {second}");
    }
}
