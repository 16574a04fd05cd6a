//! The one API of all transports.

use std::future::Future;
use std::net::SocketAddr;

use bytes::Bytes;
use sgc_trust::VerifiedPeer;
use sgc_wire::{Class, DecodeError, Label, LaneToken, Name, Packet};

use crate::error::{CloseReason, LabelError, LinkError};
use crate::flow::{FlowRx, FlowTx};
use crate::labels::Labels;
use crate::stats::LinkStats;

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

    /// Returns `true` if the peer dials or takes bulk lanes of this link ([`crate::LinkOptions::bulk_lanes`]).
    fn has_bulk_lanes(&self) -> bool;

    /// Returns `true` if this node dialled from a socket of [`crate::Dialer::open_direct`], so that the peer sees the
    /// address that direct links have. It may become so after a while.
    fn uses_direct_socket(&self) -> bool {
        false
    }

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

    /// Receives the next datagram. A malformed one does not end the link. Dropping the future loses nothing.
    fn recv_datagram(&self) -> impl Future<Output = Result<ReceivedDatagram, LinkError>> + Send;

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

/// A datagram that the peer sent.
#[derive(Debug)]
pub enum ReceivedDatagram {
    /// The packet in it.
    Packet(Packet),
    /// The datagram holds no packet, and is dropped.
    Malformed(DecodeError),
}

impl ReceivedDatagram {
    /// Returns the packet in it.
    pub fn packet(self) -> Option<Packet> {
        match self {
            Self::Packet(packet) => Some(packet),
            Self::Malformed(_) => None,
        }
    }

    pub(crate) fn read(datagram: Bytes, labels: &Labels) -> Self {
        match Packet::from_datagram_as(datagram, |label| labels.name_of(label)) {
            Ok(packet) => Self::Packet(packet),
            Err(error) => Self::Malformed(error),
        }
    }
}
