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
    /// Who is at the other end, proven before anything of it is believed.
    fn peer(&self) -> &VerifiedPeer;

    /// Its address now; it changes when the peer roams.
    fn remote(&self) -> SocketAddr;

    /// True if this node dialled.
    fn is_dialer(&self) -> bool;

    /// What it showed if it is no link but a lane of one, as the nodes agreed on that link. Whoever accepts it judges it:
    /// only its peer is proven here.
    fn lane(&self) -> Option<LaneToken>;

    /// Sends a control frame of at most [`crate::CONTROL_FRAME_BYTES_MAX`]: reliable, in order, not copied. If the
    /// future is dropped, the frame is either not sent or sent as a whole.
    fn send_control(&self, frame: Bytes) -> impl Future<Output = Result<(), LinkError>> + Send;

    /// Receives the next control frame. Dropping the future loses nothing.
    fn recv_control(&self) -> impl Future<Output = Result<Bytes, LinkError>> + Send;

    /// Opens a flow of this class; waits while the peer has as many open as it permits.
    fn open_flow(&self, class: Class) -> impl Future<Output = Result<FlowTx, LinkError>> + Send;

    /// The next flow that the peer opened. Dropping the future loses nothing.
    fn accept_flow(&self) -> impl Future<Output = Result<FlowRx, LinkError>> + Send;

    /// The longest packet ([`Packet::encoded_bytes`]) that fits a datagram now; `None` if the link has none.
    fn datagram_max(&self) -> Option<usize>;

    /// Sends a packet that may be lost; waits while those before it have not left.
    fn send_datagram(&self, packet: &Packet) -> impl Future<Output = Result<(), LinkError>> + Send {
        self.send_datagram_as(packet, None)
    }

    /// The same with this label in place of the packet's name, if there is one: the peer must have said that it knows
    /// what it stands for.
    fn send_datagram_as(
        &self,
        packet: &Packet,
        label: Option<Label>,
    ) -> impl Future<Output = Result<(), LinkError>> + Send;

    /// Receives the next packet that came as a datagram. The inner error is one datagram that was malformed
    /// and is dropped; the outer one is the end of the link. Dropping the future loses nothing.
    fn recv_datagram(&self) -> impl Future<Output = Result<Result<Packet, DecodeError>, LinkError>> + Send;

    /// From here on packets of the peer under this label are of this name. The error is the peer's mistake.
    fn define_label(&self, label: Label, name: Name) -> Result<(), LabelError>;

    /// How many labels of the peer stand for names.
    fn labels_defined(&self) -> u32;

    /// What the transport measured so far.
    fn stats(&self) -> LinkStats;

    /// Closes it and tells the peer why; every pending operation ends with that reason.
    fn close(&self, reason: CloseReason);

    /// Waits for its end and says why it came.
    fn closed(&self) -> impl Future<Output = LinkError> + Send;
}

/// How the two ends of a link agreed on its keys.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum KeyExchange {
    /// Not known.
    #[default]
    Unknown,
    /// X25519 alone.
    X25519,
    /// X25519 and ML-KEM-768, which also stands against quantum computers.
    X25519MlKem768,
}

impl KeyExchange {
    /// Its name in TLS (IANA, supported groups).
    pub fn label(self) -> &'static str {
        match self {
            Self::Unknown => "unknown",
            Self::X25519 => "X25519",
            Self::X25519MlKem768 => "X25519MLKEM768",
        }
    }
}

/// What a transport measures of a link.
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
    /// Of these, lost. What was in them is sent again, unless it was a datagram.
    pub lost_packets: u64,
    /// Bytes in those.
    pub lost_bytes: u64,
    /// How many bytes the congestion controller lets be under way.
    pub congestion_window_bytes: u64,
    /// Longest packet of the transport that the path carries, bytes.
    pub mtu_bytes: u16,
    /// How its keys were agreed on.
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
