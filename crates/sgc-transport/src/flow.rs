//! Flows: one reliable, ordered sequence of packets, which no other flow of the link holds up.
//!
//! The framing is the same over every transport; the halves of the stream below are the transport's.

use std::sync::Arc;

use bytes::Bytes;
use sgc_wire::{Label, Packet, Slab};

use crate::error::{FlowEnd, FlowError, LinkError};
use crate::framing::{PieceJoiner, Pieces, packet_head};
use crate::labels::Labels;
use crate::quic::halves as quic;
use crate::stream::halves as stream;

/// Payloads up to this length are copied behind their header: the copy costs less than another piece of memory in the
/// transport (quinn looks through all unacknowledged pieces for each packet that it sends).
const JOINED_PAYLOAD_BYTES_MAX: usize = 2048;

/// The sending end of a flow. Dropping it ends the flow after the sent packets, or at once in the middle of a packet.
/// Queued packets are not sent.
#[derive(Debug)]
pub struct FlowTx {
    outlet: Outlet,
    has_begun: bool,
    /// Memory for headers.
    heads: Slab,
    /// The last piece of the queue.
    gathered: PieceJoiner,
    queued_bytes: usize,
}

#[derive(Debug)]
pub(crate) enum Outlet {
    Quic(quic::Outlet),
    Stream(stream::Outlet),
}

/// The halves of all transports' flows have the same methods.
macro_rules! each {
    ($half:ident, $self:expr, $inner:ident => $body:expr) => {
        match $self {
            $half::Quic($inner) => $body,
            $half::Stream($inner) => $body,
        }
    };
}

impl FlowTx {
    pub(crate) fn new(outlet: Outlet) -> Self {
        let (heads, gathered) = (Slab::default(), PieceJoiner::default());
        Self { outlet, has_begun: false, heads, gathered, queued_bytes: 0 }
    }

    /// Sends a packet; waits while the peer or the network takes no more. The payload is not copied, unless it is
    /// short.
    ///
    /// If the future is dropped, the packet is either not sent at all or sent as a whole before the next.
    pub async fn send(&mut self, packet: &Packet) -> Result<(), LinkError> {
        self.send_as(packet, None).await
    }

    /// Sends a packet with this label in place of its name, if there is one: the peer must have confirmed the label.
    /// Otherwise as [`Self::send`].
    pub async fn send_as(&mut self, packet: &Packet, label: Option<Label>) -> Result<(), LinkError> {
        self.flush().await?;
        self.queue_as(packet, label);
        self.flush().await
    }

    /// Keeps a packet, in the form of [`Self::send_as`], to be sent with others at the next [`Self::flush`]: many short
    /// ones take the transport hardly more work than one. The caller bounds the queue, by [`Self::queued_bytes`].
    pub fn queue_as(&mut self, packet: &Packet, label: Option<Label>) {
        let joined = packet.payload.len() <= JOINED_PAYLOAD_BYTES_MAX;
        let head = packet_head(packet, label, !self.has_begun, joined, &mut self.heads);
        self.has_begun = true;
        self.queued_bytes += head.len();
        let before = self.gathered.push(head);
        self.queue(before);
        if !joined {
            self.queued_bytes += packet.payload.len();
            self.settle();
            self.queue(packet.payload.0.iter().filter(|piece| !piece.is_empty()).cloned());
        }
    }

    /// Returns the bytes that were queued since the queue was last empty.
    pub fn queued_bytes(&self) -> usize {
        self.queued_bytes
    }

    /// Sends the queue; waits while the peer or the network takes no more. If the future is dropped, the next one
    /// continues where it stopped.
    pub async fn flush(&mut self) -> Result<(), LinkError> {
        self.settle();
        each!(Outlet, &mut self.outlet, outlet => outlet.flush().await?);
        self.queued_bytes = 0;
        Ok(())
    }

    fn settle(&mut self) {
        let gathered = self.gathered.take();
        self.queue(gathered);
    }

    fn queue(&mut self, pieces: impl IntoIterator<Item = Bytes>) {
        each!(Outlet, &mut self.outlet, outlet => outlet.queue(pieces.into_iter()));
    }

    /// Ends the flow after the sent and queued packets, which the transport still delivers.
    pub async fn finish(mut self) -> Result<(), LinkError> {
        self.settle();
        each!(Outlet, &mut self.outlet, outlet => outlet.finish().await)
    }

    /// Ends the flow after the sent and queued packets. The result waits until the far side has all of it, or stopped
    /// it.
    pub async fn finish_slowly(mut self) -> Result<Delivery, LinkError> {
        self.settle();
        each!(Outlet, &mut self.outlet, outlet => outlet.finish().await?);
        Ok(Delivery { outlet: self.outlet })
    }

    /// Ends the flow at once; data in flight is lost.
    pub fn reset(mut self, end: FlowEnd) {
        each!(Outlet, &mut self.outlet, outlet => outlet.reset(end));
    }
}

/// A flow that was ended in good order and may still be in flight. It arrives even if this is dropped.
#[derive(Debug)]
pub struct Delivery {
    outlet: Outlet,
}

impl Delivery {
    /// Waits until the far side's transport has all of it, or refused the rest.
    pub async fn done(&mut self) -> Result<(), LinkError> {
        each!(Outlet, &mut self.outlet, outlet => outlet.delivered().await)
    }
}

/// The receiving end of a flow. Dropping it tells the sender that nobody needs the flow any more.
#[derive(Debug)]
pub struct FlowRx {
    inlet: Inlet,
    labels: Arc<Labels>,
    pieces: Pieces,
    state: State,
}

#[derive(Debug)]
pub(crate) enum Inlet {
    Quic(quic::Inlet),
    Stream(stream::Inlet),
}

#[derive(Debug, PartialEq, Eq)]
enum State {
    ExpectVersion,
    ExpectPacket,
    Ended,
}

impl FlowRx {
    pub(crate) fn new(inlet: Inlet, labels: Arc<Labels>) -> Self {
        Self { inlet, labels, pieces: Pieces::default(), state: State::ExpectVersion }
    }

    /// Receives the next packet, `None` once the flow is over. The payload consists of slices of the transport's memory
    /// (quinn itself joins pieces where many small ones would hold much memory). An error ends this flow, is told to
    /// the sender, and leaves the link alone. Dropping the future loses nothing.
    pub async fn recv(&mut self) -> Result<Option<Packet>, FlowError> {
        let result = self.next().await;
        match &result {
            Ok(Some(_)) => {}
            Ok(None) => self.state = State::Ended,
            Err(error) => {
                self.state = State::Ended;
                if let Some(end) = error.stop_code() {
                    self.tell(end);
                }
            }
        }
        result
    }

    /// Stops the flow and tells the sender the reason.
    pub fn stop(mut self, end: FlowEnd) {
        self.tell(end);
    }

    /// Returns `true` if no part of the next packet has arrived.
    pub fn is_at_rest(&self) -> bool {
        self.pieces.is_empty()
    }

    async fn next(&mut self) -> Result<Option<Packet>, FlowError> {
        loop {
            match self.state {
                State::Ended => return Ok(None),
                State::ExpectVersion => {
                    if self.pieces.next_flow_version()?.is_some() {
                        self.state = State::ExpectPacket;
                        continue;
                    }
                }
                State::ExpectPacket => {
                    if let Some(packet) = self.pieces.next_packet(&self.labels)? {
                        return Ok(Some(packet));
                    }
                }
            }
            let has_more = each!(Inlet, &mut self.inlet, inlet => inlet.fill(&mut self.pieces).await?);
            if !has_more {
                return if self.pieces.is_empty() { Ok(None) } else { Err(FlowError::Truncated) };
            }
        }
    }

    fn tell(&mut self, end: FlowEnd) {
        each!(Inlet, &mut self.inlet, inlet => inlet.stop(end));
    }
}
