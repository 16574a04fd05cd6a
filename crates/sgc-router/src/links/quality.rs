//! Measurements of a link.

use std::time::Duration;

/// Measurements of a link.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct LinkQuality {
    /// Its smoothed round trip.
    pub round_trip: Duration,
    /// Whether nothing at all arrives although something should. Such a link is used only where there is no other route.
    pub is_silent: bool,
    /// Packets that this end sent since the link came up.
    pub sent_packets: u64,
    /// Packets lost of these.
    pub lost_packets: u64,
}
