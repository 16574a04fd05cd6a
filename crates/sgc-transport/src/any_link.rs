//! [`AnyLink`]: a link whose transport is chosen at run time.

use std::net::SocketAddr;

use bytes::Bytes;
use sgc_trust::VerifiedPeer;
use sgc_wire::{Class, Label, LaneToken, Name, Packet};

use crate::error::{CloseReason, LabelError, LinkError};
use crate::flow::{FlowRx, FlowTx};
use crate::link::{Link, ReceivedDatagram};
use crate::quic::QuicLink;
use crate::stats::LinkStats;
use crate::stream::StreamLink;

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

    fn has_bulk_lanes(&self) -> bool {
        each!(self, l => l.has_bulk_lanes())
    }

    fn uses_direct_socket(&self) -> bool {
        each!(self, l => l.uses_direct_socket())
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

    async fn recv_datagram(&self) -> Result<ReceivedDatagram, LinkError> {
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
