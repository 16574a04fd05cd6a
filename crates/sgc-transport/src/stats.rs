//! Measurements of a link, and its key exchange.

use std::time::{Duration, Instant};

/// Key exchange of the two ends of a link.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum KeyExchange {
    /// Not known.
    #[default]
    Unknown,
    /// X25519 alone.
    X25519,
    /// X25519 and ML-KEM-768, which also withstands quantum computers.
    X25519MlKem768,
}

impl KeyExchange {
    /// Returns the name in TLS (IANA, supported groups).
    pub fn label(self) -> &'static str {
        match self {
            Self::Unknown => "unknown",
            Self::X25519 => "X25519",
            Self::X25519MlKem768 => "X25519MLKEM768",
        }
    }
}

/// A transport's measurements of a link.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct LinkStats {
    /// Smoothed round-trip time.
    pub rtt: Duration,
    /// Shortest round-trip time seen on this path.
    pub rtt_min: Duration,
    /// Bytes sent, everything included.
    pub sent_bytes: u64,
    /// Bytes received, everything included.
    pub received_bytes: u64,
    /// Packets of the transport sent.
    pub sent_packets: u64,
    /// Packets lost of these. Their content is sent again, except for datagrams.
    pub lost_packets: u64,
    /// Bytes in those.
    pub lost_bytes: u64,
    /// Bytes that the congestion controller allows in flight.
    pub congestion_window_bytes: u64,
    /// Longest packet of the transport that the path carries, bytes.
    pub mtu_bytes: u16,
    /// Key exchange of the link.
    pub key_exchange: KeyExchange,
    /// Since when the peer owes an answer to a ping behind data; `None` if it owes none, or the transport has no such
    /// pings.
    pub waits_since: Option<Instant>,
}

impl LinkStats {
    /// Returns a total of sent and received bytes with those of this link added.
    #[must_use]
    pub fn added_to(&self, (sent, received): (u64, u64)) -> (u64, u64) {
        (sent.saturating_add(self.sent_bytes), received.saturating_add(self.received_bytes))
    }
}
