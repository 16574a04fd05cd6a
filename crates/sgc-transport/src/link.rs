//! The one API of all transports.

use std::future::Future;
use std::net::SocketAddr;
use std::time::Duration;

use bytes::Bytes;
use sgc_trust::VerifiedPeer;
use sgc_wire::{Class, DecodeError, Label, LaneToken, Name, Packet};

use crate::error::{CloseReason, LabelError, LinkError};
use crate::flow::{FlowRx, FlowTx};
use crate::quic::QuicLink;
use crate::stream::StreamLink;

/// An authenticated connection to one node. Clones share it; when the last is dropped it closes.
///
/// Priorities: control before realtime before default before bulk flows; datagrams before all flows.
pub trait Link: Clone + Send + Sync + 'static {
    /// Returns the node at the other end, which has proven its identity.
    fn peer(&self) -> &VerifiedPeer;

    /// Returns the peer's present address; it changes when the peer roams.
    fn remote(&self) -> SocketAddr;

    /// Returns `true` if this node dialled.
    fn is_dialer(&self) -> bool;

    /// Returns the token that the peer showed if this connection is a lane of a link, as the nodes agreed on that link.
    /// The accepting side has to judge the token: only the peer's identity is proven here.
    fn lane(&self) -> Option<LaneToken>;

    /// Sends a control frame of at most [`crate::CONTROL_FRAME_BYTES_MAX`]: reliable, in order, not copied. If the
    /// future is dropped, the frame is either not sent or sent as a whole.
    fn send_control(&self, frame: Bytes) -> impl Future<Output = Result<(), LinkError>> + Send;

    /// Receives the next control frame. Dropping the future loses nothing.
    fn recv_control(&self) -> impl Future<Output = Result<Bytes, LinkError>> + Send;

    /// Opens a flow of this class; waits while the peer has as many open as it permits.
    fn open_flow(&self, class: Class) -> impl Future<Output = Result<FlowTx, LinkError>> + Send;

    /// Waits for the next flow that the peer opened. Dropping the future loses nothing.
    fn accept_flow(&self) -> impl Future<Output = Result<FlowRx, LinkError>> + Send;

    /// Returns the longest packet ([`Packet::encoded_bytes`]) that fits a datagram now; `None` if the link has none.
    fn datagram_max(&self) -> Option<usize>;

    /// Sends a packet that may be lost; waits while earlier datagrams have not left.
    fn send_datagram(&self, packet: &Packet) -> impl Future<Output = Result<(), LinkError>> + Send {
        self.send_datagram_as(packet, None)
    }

    /// Sends a datagram with this label in place of the packet's name, if there is one: the peer must have confirmed
    /// the label.
    fn send_datagram_as(
        &self,
        packet: &Packet,
        label: Option<Label>,
    ) -> impl Future<Output = Result<(), LinkError>> + Send;

    /// Receives the next packet that came as a datagram. The inner error is one malformed datagram, which is dropped;
    /// the outer one is the end of the link. Dropping the future loses nothing.
    fn recv_datagram(&self) -> impl Future<Output = Result<Result<Packet, DecodeError>, LinkError>> + Send;

    /// Defines a label: from here on the peer's packets under it have this name. The error is the peer's mistake.
    fn define_label(&self, label: Label, name: Name) -> Result<(), LabelError>;

    /// Returns the number of labels of the peer that stand for names.
    fn labels_defined(&self) -> u32;

    /// Returns the measurements so far.
    fn stats(&self) -> LinkStats;

    /// Closes the link and tells the peer the reason; every pending operation ends with it.
    fn close(&self, reason: CloseReason);

    /// Waits for the end of the link and returns its cause.
    fn closed(&self) -> impl Future<Output = LinkError> + Send;
}

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
}

/// A link over any transport.
#[derive(Clone, Debug)]
pub enum AnyLink {
    /// Over QUIC.
    Quic(QuicLink),
    /// Over a stream of bytes: TLS, TCP, WebSocket.
    Stream(StreamLink),
}

macro_rules! each {
    ($self:ident, $link:ident => $body:expr) => {
        match $self {
            AnyLink::Quic($link) => $body,
            AnyLink::Stream($link) => $body,
        }
    };
}

impl Link for AnyLink {
    fn peer(&self) -> &VerifiedPeer {
        each!(self, l => l.peer())
    }

    fn remote(&self) -> SocketAddr {
        each!(self, l => l.remote())
    }

    fn is_dialer(&self) -> bool {
        each!(self, l => l.is_dialer())
    }

    fn lane(&self) -> Option<LaneToken> {
        each!(self, l => l.lane())
    }

    async fn send_control(&self, frame: Bytes) -> Result<(), LinkError> {
        each!(self, l => l.send_control(frame).await)
    }

    async fn recv_control(&self) -> Result<Bytes, LinkError> {
        each!(self, l => l.recv_control().await)
    }

    async fn open_flow(&self, class: Class) -> Result<FlowTx, LinkError> {
        each!(self, l => l.open_flow(class).await)
    }

    async fn accept_flow(&self) -> Result<FlowRx, LinkError> {
        each!(self, l => l.accept_flow().await)
    }

    fn datagram_max(&self) -> Option<usize> {
        each!(self, l => l.datagram_max())
    }

    async fn send_datagram_as(&self, packet: &Packet, label: Option<Label>) -> Result<(), LinkError> {
        each!(self, l => l.send_datagram_as(packet, label).await)
    }

    async fn recv_datagram(&self) -> Result<Result<Packet, DecodeError>, LinkError> {
        each!(self, l => l.recv_datagram().await)
    }

    fn define_label(&self, label: Label, name: Name) -> Result<(), LabelError> {
        each!(self, l => l.define_label(label, name))
    }

    fn labels_defined(&self) -> u32 {
        each!(self, l => l.labels_defined())
    }

    fn stats(&self) -> LinkStats {
        each!(self, l => l.stats())
    }

    fn close(&self, reason: CloseReason) {
        each!(self, l => l.close(reason));
    }

    async fn closed(&self) -> LinkError {
        each!(self, l => l.closed().await)
    }
}
