//! The part of an address that stands for one host.

use std::fmt;
use std::net::{IpAddr, Ipv6Addr};

/// Bits of an IPv6 address that name a network. One host may use every address of its network (RFC 4291, 2.5.4).
const NETWORK_BITS_V6: u32 = 64;

/// The source of a connection for every limit per address: one IPv4 address, or one IPv6 network of 64 bits.
///
/// An IPv4-mapped IPv6 address (`::ffff:10.0.0.1`) is the IPv4 address. Listeners and gateways share this type
/// (`sgc_trust::AddressPrefix`), so that a host is one source everywhere.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub struct AddressPrefix(IpAddr);

impl AddressPrefix {
    /// Returns the first address of the source.
    pub fn first_address(self) -> IpAddr {
        self.0
    }
}

impl From<IpAddr> for AddressPrefix {
    fn from(address: IpAddr) -> Self {
        Self(match address.to_canonical() {
            IpAddr::V4(v4) => v4.into(),
            IpAddr::V6(v6) => {
                let host_bits = u128::BITS - NETWORK_BITS_V6;
                Ipv6Addr::from_bits(v6.to_bits() >> host_bits << host_bits).into()
            }
        })
    }
}

impl fmt::Display for AddressPrefix {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self.0 {
            IpAddr::V4(v4) => v4.fmt(f),
            IpAddr::V6(v6) => write!(f, "{v6}/{NETWORK_BITS_V6}"),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn prefix(text: &str) -> AddressPrefix {
        text.parse::<IpAddr>().unwrap().into()
    }

    #[test]
    fn every_address_of_one_host_is_one_source() {
        assert_eq!(prefix("10.0.0.1"), prefix("::ffff:10.0.0.1"));
        assert_ne!(prefix("10.0.0.1"), prefix("10.0.0.2"));
        assert_eq!(prefix("2001:db8::1"), prefix("2001:db8::ffff:ffff:ffff:ffff"));
        assert_ne!(prefix("2001:db8::1"), prefix("2001:db8:0:1::1"));
        assert_eq!(prefix("::ffff:10.0.0.1").to_string(), "10.0.0.1");
        assert_eq!(prefix("2001:db8::1:2:3:4").to_string(), "2001:db8::/64");
    }
}
