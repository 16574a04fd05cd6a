//! Everything that ends a link, a flow or an attempt at a link, each with its cause.
//!
//! The other side learns less than the log: only a TLS alert or a small code goes over the wire. Text from the other
//! side is shown only after it was shortened and stripped of control characters.

use std::fmt;
use std::io;
use std::net::SocketAddr;
use std::sync::Arc;
use std::time::Duration;

use quinn::{ConnectionError, TransportErrorCode};
use sgc_trust::{AddressPrefix, CertError};
use sgc_wire::DecodeError;

use crate::limits::CONTROL_FRAME_BYTES_MAX;
use crate::metrics::RefusalKind;
use crate::stream::StreamViolation;
use crate::url::{LinkUrl, UrlError};

const TEXT_CHARS_MAX: usize = 200;

/// A node's reason for closing a link, told to its peer.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
pub enum CloseReason {
    /// The node stops, or does not need the link any more.
    #[error("it says goodbye")]
    Goodbye,
    /// A newer link connects the same two nodes.
    #[error("a newer link took its place")]
    Replaced,
    /// The peer broke the protocol.
    #[error("protocol error: {0}")]
    Protocol(String),
    /// The peer may not have a link here.
    #[error("not permitted: {0}")]
    Denied(String),
    /// The node has too much to do.
    #[error("it is overloaded")]
    Overloaded,
    /// The receiver's certificate was revoked.
    #[error("the certificate was revoked")]
    Revoked,
    /// The receiver's certificate has expired.
    #[error("the certificate expired")]
    Expired,
    /// The receiver did not answer.
    #[error("no answer came")]
    Silent,
    /// Another process uses the receiver's identity at the named place and has its links.
    #[error("the identity is in use at another place: {0}")]
    InUse(String),
    /// A reason that this version does not know.
    #[error("reason {code}: {text}")]
    Other {
        /// The reason's code.
        code: u64,
        /// The peer's explanation.
        text: String,
    },
}

impl CloseReason {
    /// Returns the reason for a node whose CA is not among those that may attach.
    pub fn not_admitted() -> Self {
        Self::Denied("nodes of its CA may not attach here".into())
    }

    pub(crate) fn to_wire(&self) -> (u32, String) {
        let (code, text) = match self {
            Self::Goodbye => (0, ""),
            Self::Replaced => (1, ""),
            Self::Protocol(text) => (2, text.as_str()),
            Self::Denied(text) => (3, text.as_str()),
            Self::Overloaded => (4, ""),
            Self::Revoked => (5, ""),
            Self::Expired => (6, ""),
            Self::Silent => (7, ""),
            Self::InUse(place) => (8, place.as_str()),
            Self::Other { code, text } => (u32::try_from(*code).unwrap_or(u32::MAX), text.as_str()),
        };
        (code, printable(text.as_bytes()))
    }

    pub(crate) fn from_wire(code: u64, text: &[u8]) -> Self {
        match code {
            0 => Self::Goodbye,
            1 => Self::Replaced,
            2 => Self::Protocol(printable(text)),
            3 => Self::Denied(printable(text)),
            4 => Self::Overloaded,
            5 => Self::Revoked,
            6 => Self::Expired,
            7 => Self::Silent,
            8 => Self::InUse(printable(text)),
            code => Self::Other { code, text: printable(text) },
        }
    }
}

/// The reason why one end of a flow ends it early, told to the other.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum FlowEnd {
    /// Nobody needs the flow any more.
    Unwanted,
    /// Malformed input.
    Malformed,
    /// Unknown version of the flow.
    Version,
    /// The rest of the flow is out of date.
    Stale,
    /// A reason that this version does not know.
    Other(u64),
}

impl FlowEnd {
    pub(crate) fn to_wire(self) -> u32 {
        match self {
            Self::Unwanted => 0,
            Self::Malformed => 1,
            Self::Version => 2,
            Self::Stale => 3,
            Self::Other(code) => u32::try_from(code).unwrap_or(u32::MAX),
        }
    }

    pub(crate) fn from_wire(code: u64) -> Self {
        match code {
            0 => Self::Unwanted,
            1 => Self::Malformed,
            2 => Self::Version,
            3 => Self::Stale,
            code => Self::Other(code),
        }
    }
}

impl fmt::Display for FlowEnd {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Unwanted => f.write_str("no one needs it any more"),
            Self::Malformed => f.write_str("what it carried was malformed"),
            Self::Version => f.write_str("its version is not spoken there"),
            Self::Stale => f.write_str("what remained was out of date"),
            Self::Other(code) => write!(f, "reason {code}"),
        }
    }
}

/// The far side's reason for refusing this node, as far as the far side reveals it.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
pub enum PeerRefusal {
    /// The far side saw no certificate of ours.
    #[error("it saw no certificate: does this node have an identity?")]
    NoCertificate,
    /// The far side does not trust our CA.
    #[error("it does not trust our CA: are the two nodes of different fleets?")]
    OtherCa,
    /// The far side serves other CAs.
    #[error("it serves other fleets only: its keeper has to add our CA to `accept` in [router]")]
    NotAdmitted,
    /// The far side considers our certificate expired or not yet valid.
    #[error("to it our certificate is expired or not yet valid: enroll again, or compare the clocks")]
    Expired,
    /// Our certificate was revoked.
    #[error("our certificate was revoked: the keeper of the fleet has to enroll this node again")]
    Revoked,
    /// The far side cannot use our certificate.
    #[error("it cannot use our certificate (alert {0}); its log says why")]
    BadCertificate(u8),
    /// The far side speaks another version of the protocol, or another protocol.
    #[error("it does not speak this version of SGC: are both nodes of one release?")]
    Version,
    /// The far side accepts no key exchange that we offer.
    #[error(
        "it accepts no key exchange of ours: one of the two requires post-quantum X25519MLKEM768 and the other does \
         not have it; upgrade that one, or turn `post_quantum` off in both fleets"
    )]
    KeyExchange,
    /// The far side is overloaded.
    #[error("it is overloaded: try again later")]
    Overloaded,
    /// The far side gave up before the link was made.
    #[error("it gave up while connecting")]
    GaveUp,
    /// Another reason.
    #[error("{0}")]
    Other(String),
}

impl PeerRefusal {
    /// Reads the close frame of a peer's transport (RFC 9000, 20.1; TLS alerts: RFC 8446, 6.2).
    pub(crate) fn from_code(code: TransportErrorCode, text: &[u8]) -> Self {
        const TLS_ALERT: u64 = 0x100;
        match u64::from(code) {
            0x02 => Self::Overloaded,
            0x00 | 0x0c => Self::GaveUp,
            raw if raw & !0xff == TLS_ALERT => Self::from_alert(raw as u8),
            _ => Self::Other(format!("{code}: {}", printable(text))),
        }
    }

    /// Reads an alert of TLS or DTLS (RFC 8446, 6.2).
    pub(crate) fn from_alert(alert: u8) -> Self {
        match alert {
            116 => Self::NoCertificate,
            48 => Self::OtherCa,
            45 => Self::Expired,
            44 => Self::Revoked,
            49 => Self::NotAdmitted,
            42 | 43 | 46 | 51 => Self::BadCertificate(alert),
            70 | 120 => Self::Version,
            40 => Self::KeyExchange,
            alert => Self::Other(format!("TLS alert {alert}")),
        }
    }
}

/// A peer's breach of the protocol. It ends the link.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
pub enum ProtocolError {
    /// A control frame claims to be too long.
    #[error("control frame of {bytes} bytes, at most {CONTROL_FRAME_BYTES_MAX} are allowed")]
    ControlFrameTooLong {
        /// The claimed length.
        bytes: u64,
    },
    /// The control stream ended while the link lives.
    #[error("the control stream ended before the link did")]
    ControlEnded,
    /// The first control frame is no greeting.
    #[error("the greeting is malformed: {0}")]
    Greeting(#[source] DecodeError),
    /// A breach of the rules of a multiplexed stream.
    #[error("{0}")]
    Stream(#[source] StreamViolation),
    /// The certificates of DTLS and of the TLS inside belong to different nodes.
    #[error("its certificate in DTLS is not that of the node inside")]
    OtherNode,
}

/// The reason why a link ended or could not be made.
#[derive(Clone, Debug, thiserror::Error)]
pub enum LinkError {
    /// One side closed the link.
    #[error("{}", Closing(*by_peer, reason))]
    Closed {
        /// Whether the peer closed it.
        by_peer: bool,
        /// The reason.
        reason: CloseReason,
    },
    /// Nothing came for too long.
    #[error("nothing arrived for {} s: the network is down or the peer is gone", after.as_secs_f32())]
    TimedOut {
        /// The time without input.
        after: Duration,
    },
    /// The peer did not finish its part of connecting.
    #[error(
        "no answer within {} s: is a node listening there, and does UDP get through, or TCP for tls, tcp, ws and wss?",
        after.as_secs_f32()
    )]
    HandshakeTimedOut {
        /// The time that the peer had.
        after: Duration,
    },
    /// The host is there, and no program listens on that port for TCP.
    #[error(
        "the host is there and nobody listens for TCP on that port: is the node running, with this transport?"
    )]
    NobodyListens,
    /// The connection ended without a word: its peer was killed or restarted, or something between the two cut it.
    #[error(
        "the connection was cut: the peer was stopped or restarted, or something between the two ended it"
    )]
    Cut,
    /// Somebody altered the bytes on the way.
    #[error(
        "received bytes were altered on the way: an attacker or a broken device is between the two nodes"
    )]
    Altered,
    /// The peer is there but has forgotten the link.
    #[error("the peer restarted and no longer knows this link")]
    PeerRestarted,
    /// This node refuses the peer's certificate.
    #[error("refused: {0}")]
    RefusedHere(#[source] CertError),
    /// The peer refused us.
    #[error("the peer refused this node: {0}")]
    RefusedByPeer(#[source] PeerRefusal),
    /// The peer broke the protocol.
    #[error("protocol error: {0}")]
    Protocol(#[from] ProtocolError),
    /// The peer ended the flow that was to be sent on; the link lives.
    #[error("the peer stopped this flow: {0}")]
    FlowStopped(FlowEnd),
    /// A control frame that is too long to be sent; the link lives.
    #[error("a control frame of {bytes} bytes cannot be sent, at most {CONTROL_FRAME_BYTES_MAX} can")]
    FrameTooLong {
        /// Its length.
        bytes: usize,
    },
    /// The peer's handshake is longer than the limit.
    #[error("its handshake is longer than any that nodes read: is a node listening there?")]
    HandshakeTooLong,
    /// The listener has no DTLS 1.3.
    #[error(
        "the listener speaks DTLS 1.2 only, in which everyone on the way sees both certificates: upgrade it, or set \
         `dtls_1_2 = true` in [transport]"
    )]
    DtlsVersion,
    /// A packet that is too long to be sent as a datagram; the link lives, and a flow would take it.
    #[error("a datagram of {bytes} bytes cannot be sent, at most {max} can")]
    DatagramTooLong {
        /// Its length.
        bytes: usize,
        /// The longest datagram that fits now; 0 if this link has no datagrams.
        max: usize,
    },
    /// DTLS cannot sign with the key of this node's identity.
    #[error(
        "DTLS needs an identity with a P-256 or P-384 key, which this node's is not; quic:// and tls:// can use it"
    )]
    KeyUnsupported,
    /// The socket failed.
    #[error("socket: {0}")]
    Io(#[source] Arc<io::Error>),
    /// The transport failed in another way.
    #[error("transport: {0}")]
    Transport(String),
}

impl LinkError {
    /// Returns `true` if the link lives on.
    pub fn is_link_alive(&self) -> bool {
        matches!(self, Self::FlowStopped(_) | Self::FrameTooLong { .. } | Self::DatagramTooLong { .. })
    }

    pub(crate) fn from_quinn(error: &ConnectionError, idle_timeout: Duration) -> Self {
        match error {
            ConnectionError::VersionMismatch => Self::RefusedByPeer(PeerRefusal::Version),
            ConnectionError::TransportError(e) => Self::Transport(e.to_string()),
            ConnectionError::ConnectionClosed(c) => {
                Self::RefusedByPeer(PeerRefusal::from_code(c.error_code, &c.reason))
            }
            ConnectionError::ApplicationClosed(c) => Self::Closed {
                by_peer: true,
                reason: CloseReason::from_wire(c.error_code.into_inner(), &c.reason),
            },
            ConnectionError::Reset => Self::PeerRestarted,
            ConnectionError::TimedOut => Self::TimedOut { after: idle_timeout },
            ConnectionError::LocallyClosed => Self::Closed { by_peer: false, reason: CloseReason::Goodbye },
            ConnectionError::CidsExhausted => Self::Transport(error.to_string()),
        }
    }
}

impl From<io::Error> for LinkError {
    fn from(error: io::Error) -> Self {
        Self::Io(Arc::new(error))
    }
}

/// The reason why a flow yields nothing more. Only [`FlowError::Link`] concerns the link.
#[derive(Clone, Debug, thiserror::Error)]
pub enum FlowError {
    /// A flow of a version that is not spoken here.
    #[error("a flow of version {found}, {} is spoken here", crate::limits::FLOW_VERSION)]
    Version {
        /// Its version.
        found: u8,
    },
    /// A packet claims to be too long.
    #[error("a packet of {bytes} bytes, at most {} are allowed", crate::limits::FLOW_PACKET_BYTES_MAX)]
    PacketTooLong {
        /// The claimed length.
        bytes: u64,
    },
    /// A packet's header is malformed, or of an unknown version.
    #[error("malformed packet: {0}")]
    Packet(#[source] DecodeError),
    /// The flow ended inside of a packet.
    #[error("the flow ended inside of a packet")]
    Truncated,
    /// The sender ended the flow early.
    #[error("the sender ended the flow: {0}")]
    Ended(FlowEnd),
    /// The link ended.
    #[error(transparent)]
    Link(#[from] LinkError),
}

impl FlowError {
    /// Returns the reason to tell the sender, if there is anything left to stop.
    pub(crate) fn stop_code(&self) -> Option<FlowEnd> {
        match self {
            Self::Version { .. } | Self::Packet(DecodeError::Version { .. }) => Some(FlowEnd::Version),
            Self::PacketTooLong { .. } | Self::Packet(_) | Self::Truncated => Some(FlowEnd::Malformed),
            Self::Ended(_) | Self::Link(_) => None,
        }
    }
}

/// A label out of order, or one given twice.
#[derive(Clone, Copy, Debug, PartialEq, Eq, thiserror::Error)]
#[error("label {found} was given where {expected} comes next")]
pub struct LabelError {
    /// The label that the peer gave.
    pub found: u32,
    /// The next in order; the number of labels if there may be no more.
    pub expected: u32,
}

/// The reason why an incoming peer has no link.
#[derive(Clone, Debug, thiserror::Error)]
pub enum Refusal {
    /// This node does not accept the peer's certificate.
    #[error("{0}")]
    Certificate(#[source] CertError),
    /// The peer speaks another version, or another protocol.
    #[error("it does not speak this version of SGC: {0}")]
    Version(String),
    /// The peer offers no key exchange that is accepted here.
    #[error(
        "it offers no key exchange that this node accepts{}",
        if *post_quantum { ": post-quantum X25519MLKEM768 is required here and it does not have it; upgrade it, or \
         turn `post_quantum` off in this fleet" } else { "" }
    )]
    KeyExchange {
        /// Whether this node accepts only post-quantum ones.
        post_quantum: bool,
    },
    /// The peer's handshake is longer than the limit.
    #[error("its handshake is longer than any that is read")]
    HandshakeTooLong,
    /// The peer's first frame is no greeting.
    #[error("{0}")]
    Greeting(#[source] ProtocolError),
    /// The peer wants a link where only lanes are taken.
    #[error("only lanes of QUIC links are taken at this TCP port: dial quic://, or listen on tls:// as well")]
    NoLane,
    /// The peer did not finish in time.
    #[error("it did not finish connecting within {} s", after.as_secs_f32())]
    TimedOut {
        /// The time that the peer had.
        after: Duration,
    },
    /// Too many peers connect at once.
    #[error("{pending} nodes are connecting already")]
    TooMany {
        /// Number of connection attempts.
        pending: usize,
    },
    /// Too many connect at once from the peer's address.
    #[error("{pending} connections from {prefix} are connecting already")]
    TooManyFromAddress {
        /// The address.
        prefix: AddressPrefix,
        /// Number of connection attempts from it.
        pending: usize,
    },
    /// The peer refused us, or gave up.
    #[error("{0}")]
    ByPeer(#[source] PeerRefusal),
    /// The transport failed.
    #[error("transport: {0}")]
    Transport(String),
}

impl Refusal {
    /// Returns the kind under which the refusal is counted.
    pub fn kind(&self) -> RefusalKind {
        match self {
            Self::Certificate(CertError::NoCertificate) => RefusalKind::NoCertificate,
            // A dialer of another fleet looks at our certificate before we see its own.
            Self::Certificate(CertError::UnknownIssuer) | Self::ByPeer(PeerRefusal::OtherCa) => {
                RefusalKind::OtherCa
            }
            Self::Certificate(CertError::NotAdmitted { .. }) => RefusalKind::NotAdmitted,
            Self::Certificate(CertError::Expired { .. } | CertError::CaExpired { .. }) => {
                RefusalKind::Expired
            }
            Self::Certificate(CertError::NotYetValid { .. }) => RefusalKind::NotYetValid,
            Self::Certificate(CertError::Revoked { .. }) => RefusalKind::Revoked,
            Self::Certificate(_) => RefusalKind::BadCertificate,
            Self::Version(_) => RefusalKind::Version,
            Self::KeyExchange { .. } => RefusalKind::KeyExchange,
            Self::HandshakeTooLong => RefusalKind::HandshakeTooLong,
            Self::Greeting(_) => RefusalKind::BadGreeting,
            Self::NoLane => RefusalKind::NoLane,
            Self::TimedOut { .. } => RefusalKind::TimedOut,
            Self::TooMany { .. } => RefusalKind::TooMany,
            Self::TooManyFromAddress { .. } => RefusalKind::TooManyFromAddress,
            Self::ByPeer(_) => RefusalKind::ByPeer,
            Self::Transport(_) => RefusalKind::Transport,
        }
    }
}

/// The reason why dialling led to no link.
#[derive(Debug, thiserror::Error)]
pub enum DialError {
    /// The host name could not be looked up.
    #[error("{url}: the host name cannot be looked up: {source}")]
    Resolve {
        /// The dialled URL.
        url: LinkUrl,
        /// The resolver's error.
        source: io::Error,
    },
    /// The host name has no address.
    #[error("{0}: the host name has no address")]
    NoAddress(LinkUrl),
    /// This build lacks the transport.
    #[error("{url}: {source}")]
    NotBuilt {
        /// The dialled URL.
        url: LinkUrl,
        /// The missing feature.
        source: UrlError,
    },
    /// Every address failed.
    #[error("{url}: {}", Attempts(attempts))]
    Failed {
        /// The dialled URL.
        url: LinkUrl,
        /// The tried addresses, each with its error.
        attempts: Vec<(SocketAddr, LinkError)>,
    },
}

impl DialError {
    /// Returns `true` if a peer answered and either certificate or the version was refused: trying again soon is of no
    /// use.
    pub fn is_refusal(&self) -> bool {
        let refused = |error: &LinkError| match error {
            LinkError::RefusedHere(_) => true,
            LinkError::RefusedByPeer(why) => !matches!(why, PeerRefusal::Overloaded | PeerRefusal::GaveUp),
            _ => false,
        };
        matches!(self, Self::Failed { attempts, .. } if attempts.iter().any(|(_, error)| refused(error)))
    }
}

struct Attempts<'a>(&'a [(SocketAddr, LinkError)]);

impl fmt::Display for Attempts<'_> {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        for (index, (address, error)) in self.0.iter().enumerate() {
            write!(f, "{}{address}: {error}", if index > 0 { "; " } else { "" })?;
        }
        Ok(())
    }
}

/// Text for a closed link: the side that closed it and the reason. Where one side caused it, the text names that side.
struct Closing<'a>(bool, &'a CloseReason);

impl fmt::Display for Closing<'_> {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let Self(by_peer, reason) = self;
        let what = match reason {
            CloseReason::Revoked => "certificate was revoked",
            CloseReason::Expired => "certificate expired",
            CloseReason::InUse(place) if *by_peer => {
                return write!(
                    f,
                    "closed by the peer: this node's identity is in use at another place: {place}; stop one of the two, or \
                     enroll its machine under a name of its own"
                );
            }
            reason if *by_peer => return write!(f, "closed by the peer: {reason}"),
            reason => return write!(f, "closed by this node: {reason}"),
        };
        if *by_peer {
            write!(f, "closed by the peer: this node's {what}; renew it, or have it enrolled again")
        } else {
            write!(f, "closed by this node: the peer's {what}")
        }
    }
}

/// Makes a peer's text fit for a log.
fn printable(text: &[u8]) -> String {
    let text = String::from_utf8_lossy(text);
    text.chars().filter(|c| !c.is_control()).take(TEXT_CHARS_MAX).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn reasons_survive_the_wire() {
        for reason in [
            CloseReason::Goodbye,
            CloseReason::Replaced,
            CloseReason::Protocol("x".into()),
            CloseReason::Denied("y".into()),
            CloseReason::Overloaded,
            CloseReason::Revoked,
            CloseReason::Expired,
            CloseReason::Silent,
            CloseReason::InUse("203.0.113.5:7447".into()),
            CloseReason::Other { code: 77, text: "z".into() },
        ] {
            let (code, text) = reason.to_wire();
            assert_eq!(CloseReason::from_wire(code.into(), text.as_bytes()), reason);
        }
        for end in
            [FlowEnd::Unwanted, FlowEnd::Malformed, FlowEnd::Version, FlowEnd::Stale, FlowEnd::Other(9)]
        {
            assert_eq!(FlowEnd::from_wire(end.to_wire().into()), end);
        }
    }

    #[test]
    fn foreign_text_cannot_draw_on_the_terminal() {
        let long = [b"\x1b[2J\n\xff".as_slice(), &[b'a'; 500]].concat();
        let CloseReason::Denied(text) = CloseReason::from_wire(3, &long) else { panic!() };
        assert!(text.starts_with("[2J\u{fffd}aaa"), "{text}");
        assert_eq!(text.chars().count(), TEXT_CHARS_MAX);
    }
}
