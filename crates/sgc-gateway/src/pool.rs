//! [`Pool`]: clients that share a bound.

use std::fmt;

/// Clients that share a bound.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub enum Pool {
    /// All clients that show the same token or certificate, or that come from the same address without one.
    Credential,
    /// All clients of other hosts.
    Remote,
    /// All clients.
    Total,
}

impl fmt::Display for Pool {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(match self {
            Self::Credential => "all clients with this token, certificate or address",
            Self::Remote => "all clients of other hosts",
            Self::Total => "all clients",
        })
    }
}
