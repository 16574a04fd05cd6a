//! Links over one ordered stream of bytes: TLS, TCP, WebSocket.
//!
//! A task per link moves bytes between the socket and the machine that multiplexes them (`mux.rs`). Users of the link
//! call that machine and its events wake them. `endpoint.rs` and `handshake.rs` make and authenticate the stream below.

#[cfg(feature = "benchmarks")]
mod conversation;
mod driver;
mod endpoint;
#[cfg(feature = "fuzzing")]
mod exercise;
mod frame;
pub(crate) mod halves;
mod handshake;
mod mux;
mod record;
mod window;
mod wire;

#[cfg(feature = "benchmarks")]
pub use conversation::Conversation;
pub(crate) use endpoint::{StreamDialer, StreamListener};
#[cfg(feature = "fuzzing")]
pub use exercise::DoorExercise;
pub use frame::StreamViolation;

/// Runs two machines with arbitrary operations of their users.
#[cfg(feature = "fuzzing")]
pub fn fuzz_operations(input: &[u8]) {
    mux::model::converse(input);
}

/// Runs a machine with arbitrary input of its peer.
#[cfg(feature = "fuzzing")]
pub fn fuzz_bytes(input: &[u8]) {
    mux::model::listen(input);
}

use std::fmt;
use std::net::SocketAddr;
use std::sync::Arc;

use bytes::Bytes;
use sgc_trust::VerifiedPeer;
use sgc_wire::{Class, Label, LaneToken, Name, Packet, Slab};

use self::frame::DATAGRAM_BYTES_MAX;
use self::halves::{Handle, Inlet, LinkInfo, LinkInner, Outlet};
use crate::error::{CloseReason, LabelError, LinkError, ProtocolError};
use crate::flow::{self, FlowRx, FlowTx};
use crate::framing::{Chunks, control_head, datagram};
use crate::limits::CONTROL_FRAME_BYTES_MAX;
use crate::link::{Link, ReceivedDatagram};
use crate::stats::LinkStats;

/// A link over one stream of bytes.
#[derive(Clone)]
pub struct StreamLink {
    handle: Arc<Handle>,
}

impl StreamLink {
    fn new(shared: Arc<LinkInner>, peer: VerifiedPeer, about: LinkInfo) -> Self {
        let handle = Handle {
            shared,
            peer,
            about,
            labels: Arc::default(),
            control_tx: tokio::sync::Mutex::default(),
            control_rx: tokio::sync::Mutex::default(),
        };
        Self { handle: Arc::new(handle) }
    }

    /// Ends the link because of the peer's mistake, unless it has ended already.
    fn fail(&self, why: ProtocolError) -> LinkError {
        let reason = CloseReason::Protocol(why.to_string());
        self.handle.shared.close(&reason, why.clone().into());
        why.into()
    }

    async fn write_control(&self, chunks: &mut Chunks) -> Result<(), LinkError> {
        if chunks.is_empty() {
            return Ok(());
        }
        let shared = &self.handle.shared;
        shared
            .until(&shared.control_tx, |state| {
                if let Some(end) = &state.end {
                    return Some(Err(end.clone()));
                }
                let is_all = state.mux.write_control(chunks);
                if let Some(driver) = state.driver.take() {
                    driver.wake();
                }
                is_all.then_some(Ok(()))
            })
            .await
    }
}

impl Link for StreamLink {
    fn peer(&self) -> &VerifiedPeer {
        &self.handle.peer
    }

    fn remote(&self) -> SocketAddr {
        self.handle.about.remote
    }

    fn is_dialer(&self) -> bool {
        self.handle.about.is_dialer
    }

    fn lane(&self) -> Option<LaneToken> {
        self.handle.about.lane
    }

    fn has_bulk_lanes(&self) -> bool {
        false
    }

    async fn send_control(&self, frame: Bytes) -> Result<(), LinkError> {
        if frame.len() > CONTROL_FRAME_BYTES_MAX {
            return Err(LinkError::FrameTooLong { bytes: frame.len() });
        }
        let mut pending = self.handle.control_tx.lock().await;
        self.write_control(&mut pending).await?;
        pending.push(control_head(frame.len()));
        pending.extend((!frame.is_empty()).then_some(frame));
        self.write_control(&mut pending).await
    }

    async fn recv_control(&self) -> Result<Bytes, LinkError> {
        let mut pieces = self.handle.control_rx.lock().await;
        let shared = &self.handle.shared;
        loop {
            if let Some(frame) = pieces.next_control().map_err(|why| self.fail(why))? {
                return Ok(frame);
            }
            shared
                .until(&shared.control_rx, |state| {
                    let is_some = state.mux.read_control(|piece| pieces.push(piece));
                    if state.mux.has_news()
                        && let Some(driver) = state.driver.take()
                    {
                        driver.wake();
                    }
                    is_some.then_some(Ok(()))
                })
                .await?;
        }
    }

    async fn open_flow(&self, class: Class) -> Result<FlowTx, LinkError> {
        let shared = &self.handle.shared;
        let opened = shared.until(&shared.flows, |state| match &state.end {
            Some(end) => Some(Err(end.clone())),
            None => state.mux.open(class).map(Ok),
        });
        let id = opened.await?;
        let handle = Arc::clone(&self.handle);
        Ok(FlowTx::new(flow::Outlet::Stream(Outlet { handle, id, pending: Vec::new() })))
    }

    async fn accept_flow(&self) -> Result<FlowRx, LinkError> {
        let Handle { shared, labels, .. } = &*self.handle;
        let id = shared.until(&shared.incoming, |state| state.mux.accept().map(Ok)).await?;
        let handle = Arc::clone(&self.handle);
        Ok(FlowRx::new(flow::Inlet::Stream(Inlet { handle, id }), Arc::clone(labels)))
    }

    fn datagram_max(&self) -> Option<usize> {
        Some(DATAGRAM_BYTES_MAX)
    }

    async fn send_datagram_as(&self, packet: &Packet, label: Option<Label>) -> Result<(), LinkError> {
        let (bytes, max) = (packet.encoded_bytes_as(label), DATAGRAM_BYTES_MAX);
        if bytes > max {
            return Err(LinkError::DatagramTooLong { bytes, max });
        }
        let (shared, datagram) = (&self.handle.shared, datagram(packet, label, &mut Slab::default()));
        shared
            .until(&shared.datagrams_tx, |state| {
                if let Some(end) = &state.end {
                    return Some(Err(end.clone()));
                }
                let is_sent = state.mux.send_datagram(&datagram);
                if let Some(driver) = state.driver.take() {
                    driver.wake();
                }
                is_sent.then_some(Ok(()))
            })
            .await
    }

    async fn recv_datagram(&self) -> Result<ReceivedDatagram, LinkError> {
        let Handle { shared, labels, .. } = &*self.handle;
        let datagram =
            shared.until(&shared.datagrams_rx, |state| state.mux.receive_datagram().map(Ok)).await?;
        Ok(ReceivedDatagram::read(datagram, labels))
    }

    fn define_label(&self, label: Label, name: Name) -> Result<(), LabelError> {
        self.handle.labels.define(label, name)
    }

    fn labels_defined(&self) -> u32 {
        self.handle.labels.count()
    }

    fn stats(&self) -> LinkStats {
        let Handle { shared, about, .. } = &*self.handle;
        let (sent_bytes, received_bytes) = shared.counters.read();
        let state = shared.lock();
        let (rtt, rtt_min) = state.mux.rtt();
        let waits_since = state.mux.waits_since();
        LinkStats {
            rtt,
            rtt_min,
            sent_bytes,
            received_bytes,
            // The kernel resends lost packets and reports none.
            sent_packets: 0,
            lost_packets: 0,
            lost_bytes: 0,
            congestion_window_bytes: state.mux.window_bytes(),
            mtu_bytes: about.mtu_bytes,
            key_exchange: about.key_exchange,
            waits_since,
        }
    }

    fn close(&self, reason: CloseReason) {
        let error = LinkError::Closed { by_peer: false, reason: reason.clone() };
        self.handle.shared.close(&reason, error);
    }

    async fn closed(&self) -> LinkError {
        let shared = &self.handle.shared;
        match shared.until(&shared.ended, |state| state.end.clone().map(Ok)).await {
            Ok(error) | Err(error) => error,
        }
    }
}

impl fmt::Debug for StreamLink {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_struct("StreamLink")
            .field("peer", &self.handle.peer.node_id)
            .field("about", &self.handle.about)
            .finish_non_exhaustive()
    }
}
