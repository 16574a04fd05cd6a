//! Addresses of direct links: those of this host, and those of peers to dial.

use std::net::{IpAddr, SocketAddr};

use sgc_wire::NodeId;

/// Most dials that wait for their task.
pub(crate) const DIRECT_DIALS_MAX: usize = 64;

/// A peer to dial.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) struct DirectDial {
    pub(crate) peer: NodeId,
    pub(crate) to: SocketAddr,
}

/// An address of this host, and the network to which it is attached by it.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub(crate) struct HostAddress {
    pub(crate) ip: IpAddr,
    /// Length of the network's prefix, bits.
    pub(crate) prefix: u8,
}

impl HostAddress {
    /// Returns `true` if the other address is of the same network.
    pub(crate) fn is_near(&self, other: IpAddr) -> bool {
        let shared = match (self.ip, other) {
            (IpAddr::V4(own), IpAddr::V4(other)) => (own.to_bits() ^ other.to_bits()).leading_zeros(),
            (IpAddr::V6(own), IpAddr::V6(other)) => (own.to_bits() ^ other.to_bits()).leading_zeros(),
            _ => return false,
        };
        shared >= u32::from(self.prefix)
    }
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]

    use super::*;

    #[test]
    fn address_is_near_within_the_prefix_of_an_interface() {
        let host = |ip: &str, prefix| HostAddress { ip: ip.parse().unwrap(), prefix };
        let is_near = |host: HostAddress, other: &str| host.is_near(other.parse().unwrap());
        assert!(is_near(host("10.1.2.3", 16), "10.1.255.9") && !is_near(host("10.1.2.3", 24), "10.1.255.9"));
        assert!(is_near(host("2001:db8::1", 64), "2001:db8::ffff"));
        assert!(!is_near(host("2001:db8::1", 64), "2001:db8:0:1::1") && !is_near(host("10.1.2.3", 0), "::1"));
        assert!(is_near(host("10.1.2.3", 32), "10.1.2.3") && !is_near(host("10.1.2.3", 32), "10.1.2.2"));
    }
}
