//! Counters of links, for `sgc status` and the metrics page. This module logs nothing.

use std::sync::atomic::{AtomicU64, Ordering::Relaxed};

/// The kind of refusal that is counted; [`crate::Refusal`] has the details.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub enum RefusalKind {
    /// No certificate was presented.
    NoCertificate,
    /// The certificate is from a CA that is not trusted, there or here.
    OtherCa,
    /// The certificate is from a CA whose nodes may not attach here.
    NotAdmitted,
    /// The certificate, or its CA, has expired.
    Expired,
    /// The certificate is not yet valid.
    NotYetValid,
    /// The certificate was revoked.
    Revoked,
    /// The certificate is altered, malformed or for another purpose.
    BadCertificate,
    /// The peer speaks another version of the protocol, or another protocol.
    Version,
    /// The peer offers no key exchange that is accepted here.
    KeyExchange,
    /// The peer's handshake is longer than the limit.
    HandshakeTooLong,
    /// The peer connected and sent no valid greeting.
    BadGreeting,
    /// The peer wants a link where only lanes are taken.
    NoLane,
    /// The peer did not finish in time.
    TimedOut,
    /// Too many were connecting at once.
    TooMany,
    /// Too many were connecting at once from the peer's address.
    TooManyFromAddress,
    /// The peer refused us, or gave up.
    ByPeer,
    /// The transport failed.
    Transport,
}

impl RefusalKind {
    /// Every kind, in the order of the counters.
    pub const ALL: [Self; 17] = [
        Self::NoCertificate,
        Self::OtherCa,
        Self::NotAdmitted,
        Self::Expired,
        Self::NotYetValid,
        Self::Revoked,
        Self::BadCertificate,
        Self::Version,
        Self::KeyExchange,
        Self::HandshakeTooLong,
        Self::BadGreeting,
        Self::NoLane,
        Self::TimedOut,
        Self::TooMany,
        Self::TooManyFromAddress,
        Self::ByPeer,
        Self::Transport,
    ];

    /// Returns the label of the metric.
    pub const fn label(self) -> &'static str {
        match self {
            Self::NoCertificate => "no_certificate",
            Self::OtherCa => "other_ca",
            Self::NotAdmitted => "not_admitted",
            Self::Expired => "expired",
            Self::NotYetValid => "not_yet_valid",
            Self::Revoked => "revoked",
            Self::BadCertificate => "bad_certificate",
            Self::Version => "version",
            Self::KeyExchange => "key_exchange",
            Self::HandshakeTooLong => "handshake_too_long",
            Self::BadGreeting => "bad_greeting",
            Self::NoLane => "no_lane",
            Self::TimedOut => "timed_out",
            Self::TooMany => "too_many",
            Self::TooManyFromAddress => "too_many_from_address",
            Self::ByPeer => "by_peer",
            Self::Transport => "transport",
        }
    }
}

/// Counters of all listeners and dialers that share them.
#[derive(Debug, Default)]
pub struct TransportMetrics {
    accepted: AtomicU64,
    dialed: AtomicU64,
    pending: AtomicU64,
    refused: [AtomicU64; RefusalKind::ALL.len()],
}

impl TransportMetrics {
    /// Links that came in.
    pub fn accepted(&self) -> u64 {
        self.accepted.load(Relaxed)
    }

    /// Links that were dialled.
    pub fn dialed(&self) -> u64 {
        self.dialed.load(Relaxed)
    }

    /// Incoming handshakes under way now.
    pub fn handshakes_pending(&self) -> u64 {
        self.pending.load(Relaxed)
    }

    /// Peers that were refused at a listener, for one kind of reason.
    pub fn refused(&self, kind: RefusalKind) -> u64 {
        self.refused[kind as usize].load(Relaxed)
    }

    pub(crate) fn count_accepted(&self) {
        self.accepted.fetch_add(1, Relaxed);
    }

    pub(crate) fn count_dialed(&self) {
        self.dialed.fetch_add(1, Relaxed);
    }

    pub(crate) fn count_refused(&self, kind: RefusalKind) {
        self.refused[kind as usize].fetch_add(1, Relaxed);
    }

    /// Counts a handshake as pending for as long as the result lives.
    pub(crate) fn pending(self: &std::sync::Arc<Self>) -> Pending {
        self.pending.fetch_add(1, Relaxed);
        Pending(std::sync::Arc::clone(self))
    }
}

pub(crate) struct Pending(std::sync::Arc<TransportMetrics>);

impl Drop for Pending {
    fn drop(&mut self) {
        self.0.pending.fetch_sub(1, Relaxed);
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn each_kind_has_its_own_counter() {
        for (index, kind) in RefusalKind::ALL.into_iter().enumerate() {
            assert_eq!(kind as usize, index);
        }
    }
}
