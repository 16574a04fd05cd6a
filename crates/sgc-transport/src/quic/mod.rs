//! Links over QUIC: what of the API becomes which stream.
//!
//! The first bidirectional stream, opened by the dialer, is the control stream; each flow is a unidirectional
//! stream; datagrams are datagrams. How connections are made and authenticated is in the modules below.

mod clear;
mod config;
mod endpoint;
pub(crate) mod halves;
mod places;

pub(crate) use config::Flavor;
#[cfg(test)]
pub(crate) use config::transport;
#[cfg(feature = "dtls")]
pub(crate) use config::{Parts, client, endpoint as endpoint_config};
#[cfg(feature = "dtls")]
pub(crate) use endpoint::{DRAIN_TIMEOUT, SERVER_NAME, finish, greet};
pub(crate) use endpoint::{QuicDialer, QuicListener};

use std::fmt;
use std::net::SocketAddr;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering::Relaxed};
use std::time::Duration;

use bytes::Bytes;
use quinn::{Connection, SendDatagramError, VarInt};
use sgc_sync::lock;
use sgc_trust::VerifiedPeer;
use sgc_wire::{Class, Label, LaneToken, Name, Packet, Slab};
use tokio::sync::Mutex;

use self::halves::{Inlet, LinkEnd, Outlet, Urgency};
use self::places::Places;
use crate::budget::WindowLease;
use crate::congestion::Gate;
use crate::dtls::Claim;
use crate::error::{CloseReason, FlowError, LabelError, LinkError, ProtocolError};
use crate::flow::{self, FlowRx, FlowTx};
use crate::framing::{Pieces, control_head, datagram};
use crate::labels::Labels;
use crate::limits::CONTROL_FRAME_BYTES_MAX;
use crate::link::{Link, ReceivedDatagram};
use crate::stats::{KeyExchange, LinkStats};

/// Time in which QUIC ends a connection by itself after the layer below has ended.
const LAST_WORD: Duration = Duration::from_millis(500);

/// A link over one QUIC connection.
#[derive(Clone)]
pub struct QuicLink {
    shared: Arc<LinkInner>,
}

struct LinkInner {
    connection: Connection,
    peer: VerifiedPeer,
    is_dialer: bool,
    lane: Option<LaneToken>,
    bulk_lanes: bool,
    key_exchange: KeyExchange,
    control_tx: Mutex<Outlet>,
    control_rx: Mutex<ControlRx>,
    labels: Arc<Labels>,
    /// Memory for outgoing datagrams.
    datagrams: std::sync::Mutex<Slab>,
    fate: Arc<LinkEnd>,
    gate: Arc<Gate>,
    places: Arc<Places>,
    _lease: WindowLease,
    /// Hold on the association below.
    _claim: Option<Claim>,
    uses_direct_socket: Arc<AtomicBool>,
}

/// The receiving half of the control stream.
struct ControlRx {
    inlet: Inlet,
    pieces: Pieces,
}

impl ControlRx {
    async fn recv(&mut self) -> Result<Bytes, LinkError> {
        loop {
            if let Some(frame) = self.pieces.next_control()? {
                return Ok(frame);
            }
            match self.inlet.fill(&mut self.pieces).await {
                Ok(true) => {}
                Ok(false) | Err(FlowError::Ended(_)) => return Err(ProtocolError::ControlEnded.into()),
                Err(FlowError::Link(e)) => return Err(e),
                Err(e) => return Err(LinkError::Transport(e.to_string())),
            }
        }
    }
}

impl QuicLink {
    /// Ends the link when the layer below ends first, with its error.
    pub(crate) fn end_with(&self, lower: impl Future<Output = LinkError> + Send + 'static) {
        let shared = Arc::downgrade(&self.shared);
        tokio::spawn(async move {
            let error = lower.await;
            if !matches!(error, LinkError::PeerRestarted) {
                // QUIC may have a close frame of the peer still to read.
                tokio::time::sleep(LAST_WORD).await;
            }
            // Closing what is closed would change the reason.
            if let Some(shared) = shared.upgrade()
                && shared.connection.close_reason().is_none()
            {
                close(&shared.connection, &shared.fate, &CloseReason::Goodbye, error);
            }
        });
    }

    /// Ends the link because of the peer's mistake, unless it has ended already.
    fn fail(&self, error: LinkError) -> LinkError {
        if let LinkError::Protocol(why) = &error {
            let reason = CloseReason::Protocol(why.to_string());
            close(&self.shared.connection, &self.shared.fate, &reason, error.clone());
        }
        error
    }
}

impl Link for QuicLink {
    fn peer(&self) -> &VerifiedPeer {
        &self.shared.peer
    }

    fn remote(&self) -> SocketAddr {
        canonical(self.shared.connection.remote_address())
    }

    fn is_dialer(&self) -> bool {
        self.shared.is_dialer
    }

    fn lane(&self) -> Option<LaneToken> {
        self.shared.lane
    }

    fn has_bulk_lanes(&self) -> bool {
        self.shared.bulk_lanes
    }

    fn uses_direct_socket(&self) -> bool {
        self.shared.uses_direct_socket.load(Relaxed)
    }

    async fn send_control(&self, frame: Bytes) -> Result<(), LinkError> {
        if frame.len() > CONTROL_FRAME_BYTES_MAX {
            return Err(LinkError::FrameTooLong { bytes: frame.len() });
        }
        let mut outlet = self.shared.control_tx.lock().await;
        send_frame(&mut outlet, frame).await.map_err(|e| match e {
            LinkError::FlowStopped(_) => self.fail(ProtocolError::ControlEnded.into()),
            e => e,
        })
    }

    async fn recv_control(&self) -> Result<Bytes, LinkError> {
        self.shared.control_rx.lock().await.recv().await.map_err(|e| self.fail(e))
    }

    async fn open_flow(&self, class: Class) -> Result<FlowTx, LinkError> {
        let LinkInner { connection, fate, gate, .. } = &*self.shared;
        let stream = connection.open_uni().await.map_err(|e| fate.explain(&e))?;
        Ok(FlowTx::new(flow::Outlet::Quic(Outlet::new(stream, Urgency::Of(class), fate, gate))))
    }

    async fn accept_flow(&self) -> Result<FlowRx, LinkError> {
        let LinkInner { connection, fate, labels, places, .. } = &*self.shared;
        let stream = connection.accept_uni().await.map_err(|e| fate.explain(&e))?;
        let inlet = Inlet::new(stream, fate, Some(places.take(connection)));
        Ok(FlowRx::new(flow::Inlet::Quic(inlet), Arc::clone(labels)))
    }

    fn datagram_max(&self) -> Option<usize> {
        self.shared.connection.max_datagram_size()
    }

    async fn send_datagram_as(&self, packet: &Packet, label: Option<Label>) -> Result<(), LinkError> {
        let LinkInner { connection, fate, gate, datagrams, .. } = &*self.shared;
        let bytes = packet.encoded_bytes_as(label);
        let max = connection.max_datagram_size().unwrap_or(0);
        if bytes > max {
            return Err(LinkError::DatagramTooLong { bytes, max });
        }
        let permit = match gate.try_admit(packet.header.class, bytes) {
            Some(permit) => permit,
            None => tokio::select! {
                permit = gate.admit(packet.header.class, bytes) => permit,
                error = connection.closed() => return Err(fate.explain(&error)),
            },
        };
        permit.written(bytes);
        let datagram = datagram(packet, label, &mut lock(datagrams));
        connection.send_datagram_wait(datagram).await.map_err(|e| match e {
            SendDatagramError::ConnectionLost(e) => fate.explain(&e),
            // The path may have narrowed in between.
            _ => LinkError::DatagramTooLong { bytes, max: connection.max_datagram_size().unwrap_or(0) },
        })
    }

    async fn recv_datagram(&self) -> Result<ReceivedDatagram, LinkError> {
        let LinkInner { connection, fate, labels, .. } = &*self.shared;
        let datagram = connection.read_datagram().await.map_err(|e| fate.explain(&e))?;
        Ok(ReceivedDatagram::read(datagram, labels))
    }

    fn define_label(&self, label: Label, name: Name) -> Result<(), LabelError> {
        self.shared.labels.define(label, name)
    }

    fn labels_defined(&self) -> u32 {
        self.shared.labels.count()
    }

    fn stats(&self) -> LinkStats {
        let stats = self.shared.connection.stats();
        LinkStats {
            rtt: stats.path.rtt,
            rtt_min: stats.path.min_rtt,
            sent_bytes: stats.udp_tx.bytes,
            received_bytes: stats.udp_rx.bytes,
            sent_packets: stats.path.sent_packets,
            lost_packets: stats.path.lost_packets,
            lost_bytes: stats.path.lost_bytes,
            congestion_window_bytes: stats.path.cwnd,
            mtu_bytes: stats.path.current_mtu,
            key_exchange: self.shared.key_exchange,
            waits_since: None,
        }
    }

    fn close(&self, reason: CloseReason) {
        let error = LinkError::Closed { by_peer: false, reason: reason.clone() };
        close(&self.shared.connection, &self.shared.fate, &reason, error);
    }

    async fn closed(&self) -> LinkError {
        self.shared.fate.explain(&self.shared.connection.closed().await)
    }
}

impl fmt::Debug for QuicLink {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_struct("QuicLink")
            .field("peer", &self.shared.peer.node_id)
            .field("remote", &self.remote())
            .field("is_dialer", &self.shared.is_dialer)
            .finish_non_exhaustive()
    }
}

fn close(connection: &Connection, fate: &LinkEnd, reason: &CloseReason, error: LinkError) {
    fate.set(error);
    let (code, text) = reason.to_wire();
    connection.close(VarInt::from_u32(code), text.as_bytes());
}

async fn send_frame(outlet: &mut Outlet, frame: Bytes) -> Result<(), LinkError> {
    outlet.flush().await?;
    outlet.queue(std::iter::once(control_head(frame.len())).chain((!frame.is_empty()).then_some(frame)));
    outlet.flush().await
}

/// IPv4 peers of a socket for both families appear as IPv6 addresses otherwise.
fn canonical(address: SocketAddr) -> SocketAddr {
    SocketAddr::new(address.ip().to_canonical(), address.port())
}
