//! Links over QUIC: what of the API becomes which stream.
//!
//! The first bidirectional stream, opened by the dialer, is the control stream; each flow is a unidirectional
//! stream; datagrams are datagrams. How connections are made and authenticated is in the modules below.

mod config;
mod endpoint;
mod reserve;
mod verifier;

pub(crate) use endpoint::{QuicDialer, QuicListener};
use reserve::Reserve;

use std::fmt;
use std::future::{Future as _, poll_fn};
use std::net::SocketAddr;
use std::pin::pin;
use std::sync::{Arc, OnceLock};
use std::task::Poll;
use std::time::Duration;

use bytes::Bytes;
use quinn::{
    Connection, ConnectionError, ReadError, RecvStream, SendDatagramError, SendStream, StoppedError, VarInt,
    WriteError, Written,
};
use sgc_trust::VerifiedPeer;
use sgc_wire::{Class, DecodeError, Label, Name, Packet};
use tokio::sync::Mutex;

use crate::error::{CloseReason, FlowEnd, FlowError, LabelError, LinkError, ProtocolError};
use crate::flow::{self, Chunks, FlowRx, FlowTx};
use crate::framing::{CONTROL_FRAME_BYTES_MAX, Pieces, control_head, datagram};
use crate::labels::Labels;
use crate::link::{KeyExchange, Link, LinkStats};

const PRIORITY_CONTROL: i32 = 3;
/// How many pieces one read takes at most: it bounds what is received and not yet consumed.
const READ_PIECES: usize = 32;

/// A link over one QUIC connection.
#[derive(Clone)]
pub struct QuicLink {
    shared: Arc<Shared>,
}

struct Shared {
    connection: Connection,
    peer: VerifiedPeer,
    is_dialer: bool,
    key_exchange: KeyExchange,
    control_tx: Mutex<Outlet>,
    control_rx: Mutex<ControlRx>,
    labels: Arc<Labels>,
    fate: Arc<Fate>,
    reserve: Arc<Reserve>,
}

/// How the connection came to end, where this side knows better than QUIC.
#[derive(Debug)]
pub(crate) struct Fate {
    idle_timeout: Duration,
    ended_here: OnceLock<LinkError>,
}

impl Fate {
    fn new(idle_timeout: Duration) -> Arc<Self> {
        Arc::new(Self { idle_timeout, ended_here: OnceLock::new() })
    }

    fn explain(&self, error: &ConnectionError) -> LinkError {
        match (error, self.ended_here.get()) {
            (ConnectionError::LocallyClosed, Some(ours)) => ours.clone(),
            _ => LinkError::from_quinn(error, self.idle_timeout),
        }
    }
}

/// The sending half of a stream. What it was given goes out whole and in order, also when a writer is cancelled.
#[derive(Debug)]
pub(crate) struct Outlet {
    stream: SendStream,
    priority: i32,
    pending: Chunks,
    fate: Arc<Fate>,
    reserve: Arc<Reserve>,
}

impl Outlet {
    fn new(stream: SendStream, priority: i32, fate: &Arc<Fate>, reserve: &Arc<Reserve>) -> Self {
        // Fails only on a stream that is closed already, which the first write then says.
        let _ = stream.set_priority(priority);
        let (fate, reserve) = (Arc::clone(fate), Arc::clone(reserve));
        Self { stream, priority, pending: Vec::new(), fate, reserve }
    }

    pub(crate) fn queue(&mut self, chunks: impl Iterator<Item = Bytes>) {
        self.pending.extend(chunks);
    }

    pub(crate) async fn flush(&mut self) -> Result<(), LinkError> {
        while !self.pending.is_empty() {
            let written = self.write().await;
            match written {
                Ok(written) => drop(self.pending.drain(..written.chunks)),
                Err(error) => {
                    self.pending.clear();
                    return Err(self.explain(error));
                }
            }
        }
        Ok(())
    }

    /// Writes some of what is pending: into the send window if it has room, else into the reserve, else later.
    async fn write(&mut self) -> Result<Written, WriteError> {
        let Self { stream, priority, pending, reserve, .. } = self;
        let at_once = poll_fn(|cx| {
            let mut attempt = || match pin!(stream.write_chunks(pending)).poll(cx) {
                Poll::Ready(written) => Some(written),
                Poll::Pending => None,
            };
            let written = attempt();
            let opens = written.is_none() && *priority > 0;
            Poll::Ready(if opens { reserve.open(*priority, attempt) } else { written })
        });
        match at_once.await {
            Some(written) => written,
            None => self.stream.write_chunks(&mut self.pending).await,
        }
    }

    pub(crate) async fn finish(&mut self) -> Result<(), LinkError> {
        self.flush().await?;
        // It fails only where the stream has ended already.
        let _ = self.stream.finish();
        Ok(())
    }

    pub(crate) async fn delivered(&mut self) -> Result<(), LinkError> {
        match self.stream.stopped().await {
            Ok(_) => Ok(()),
            Err(StoppedError::ConnectionLost(e)) => Err(self.fate.explain(&e)),
            Err(e) => Err(LinkError::Transport(e.to_string())),
        }
    }

    pub(crate) fn reset(&mut self, end: FlowEnd) {
        self.pending.clear();
        let _ = self.stream.reset(VarInt::from_u32(end.to_wire()));
    }

    fn explain(&self, error: WriteError) -> LinkError {
        match error {
            WriteError::Stopped(code) => LinkError::FlowStopped(FlowEnd::from_wire(code.into_inner())),
            WriteError::ConnectionLost(e) => self.fate.explain(&e),
            WriteError::ClosedStream | WriteError::ZeroRttRejected => LinkError::Transport(error.to_string()),
        }
    }
}

impl Drop for Outlet {
    fn drop(&mut self) {
        // Quinn ends a dropped stream in good order, which would pass half a frame for a whole one.
        if !self.pending.is_empty() {
            self.reset(FlowEnd::Unwanted);
        }
    }
}

/// The receiving half of a stream.
#[derive(Debug)]
pub(crate) struct Inlet {
    stream: RecvStream,
    fate: Arc<Fate>,
}

impl Inlet {
    fn new(stream: RecvStream, fate: &Arc<Fate>) -> Self {
        Self { stream, fate: Arc::clone(fate) }
    }

    /// Waits for more of the stream and appends it; false at its end.
    pub(crate) async fn fill(&mut self, pieces: &mut Pieces) -> Result<bool, FlowError> {
        let mut chunks = [const { Bytes::new() }; READ_PIECES];
        match self.stream.read_chunks(&mut chunks).await {
            Ok(Some(n)) => {
                chunks.into_iter().take(n).for_each(|c| pieces.push(c));
                Ok(true)
            }
            Ok(None) => Ok(false),
            Err(ReadError::Reset(code)) => Err(FlowError::Ended(FlowEnd::from_wire(code.into_inner()))),
            Err(ReadError::ConnectionLost(e)) => Err(self.fate.explain(&e).into()),
            Err(e) => Err(LinkError::Transport(e.to_string()).into()),
        }
    }

    pub(crate) fn stop(&mut self, end: FlowEnd) {
        // It fails only where the stream has ended already.
        let _ = self.stream.stop(VarInt::from_u32(end.to_wire()));
    }
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
    /// Ends the link because of what the peer did, unless it has ended already.
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
        let Shared { connection, fate, reserve, .. } = &*self.shared;
        let stream = connection.open_uni().await.map_err(|e| fate.explain(&e))?;
        Ok(FlowTx::new(flow::Outlet::Quic(Outlet::new(stream, class as i32, fate, reserve))))
    }

    async fn accept_flow(&self) -> Result<FlowRx, LinkError> {
        let Shared { connection, fate, labels, .. } = &*self.shared;
        let stream = connection.accept_uni().await.map_err(|e| fate.explain(&e))?;
        Ok(FlowRx::new(flow::Inlet::Quic(Inlet::new(stream, fate)), Arc::clone(labels)))
    }

    fn datagram_max(&self) -> Option<usize> {
        self.shared.connection.max_datagram_size()
    }

    async fn send_datagram_as(&self, packet: &Packet, label: Option<Label>) -> Result<(), LinkError> {
        let Shared { connection, fate, .. } = &*self.shared;
        let bytes = packet.encoded_bytes_as(label);
        let max = connection.max_datagram_size().unwrap_or(0);
        if bytes > max {
            return Err(LinkError::DatagramTooLong { bytes, max });
        }
        connection.send_datagram_wait(datagram(packet, label)).await.map_err(|e| match e {
            SendDatagramError::ConnectionLost(e) => fate.explain(&e),
            // The path may have narrowed in between.
            _ => LinkError::DatagramTooLong { bytes, max: connection.max_datagram_size().unwrap_or(0) },
        })
    }

    async fn recv_datagram(&self) -> Result<Result<Packet, DecodeError>, LinkError> {
        let Shared { connection, fate, labels, .. } = &*self.shared;
        let datagram = connection.read_datagram().await.map_err(|e| fate.explain(&e))?;
        Ok(Packet::from_datagram_as(datagram, |label| labels.name_of(label)))
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

fn close(connection: &Connection, fate: &Fate, reason: &CloseReason, error: LinkError) {
    // The first reason stays, as it does in QUIC.
    let _ = fate.ended_here.set(error);
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
