//! [`ClientRefusal`]: the names of the counters of refused clients.

use crate::pool::Pool;

/// A refusal of a client, as the status counts it.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub enum ClientRefusal {
    /// The places of the pool are taken.
    TooManyClients(Pool),
    /// The clients of the pool have all the resources that they may have.
    TooMuch(Pool),
    /// Too many clients of its address are in their handshake.
    TooManyHandshakes,
    /// Its handshake made room for another one.
    HandshakeGaveWay,
    /// Its handshake took too long.
    HandshakeTooSlow,
    /// It showed no token, certificate or origin that is accepted.
    NotAdmitted,
    /// Its token or certificate ended while it was connected.
    NoLongerAdmitted,
    /// It does not speak WebSocket, or none of the subprotocols.
    NoWebSocket,
    /// Its TLS handshake failed.
    TlsFailed,
    /// Its certificate is not accepted.
    CertificateDoesNotHold,
}

impl ClientRefusal {
    /// All refusals.
    pub const ALL: [Self; 14] = [
        Self::TooManyClients(Pool::Total),
        Self::TooManyClients(Pool::Remote),
        Self::TooManyClients(Pool::Credential),
        Self::TooMuch(Pool::Credential),
        Self::TooMuch(Pool::Remote),
        Self::TooMuch(Pool::Total),
        Self::TooManyHandshakes,
        Self::HandshakeGaveWay,
        Self::HandshakeTooSlow,
        Self::NotAdmitted,
        Self::NoLongerAdmitted,
        Self::NoWebSocket,
        Self::TlsFailed,
        Self::CertificateDoesNotHold,
    ];

    /// Returns a stable name for counters, in words.
    pub const fn key(self) -> &'static str {
        match self {
            Self::TooManyClients(Pool::Credential) => "too many clients of one credential",
            Self::TooManyClients(Pool::Remote) => "too many clients of other hosts",
            Self::TooManyClients(Pool::Total) => "too many clients",
            Self::TooMuch(Pool::Credential) => {
                "too much for all clients with this token, certificate or address"
            }
            Self::TooMuch(Pool::Remote) => "too much for all clients of other hosts",
            Self::TooMuch(Pool::Total) => "too much for all clients",
            Self::TooManyHandshakes => "too many handshakes",
            Self::HandshakeGaveWay => "handshake gave way",
            Self::HandshakeTooSlow => "handshake too slow",
            Self::NotAdmitted => "not admitted",
            Self::NoLongerAdmitted => "no longer admitted",
            Self::NoWebSocket => "no WebSocket",
            Self::TlsFailed => "TLS failed",
            Self::CertificateDoesNotHold => "certificate does not hold",
        }
    }
}
