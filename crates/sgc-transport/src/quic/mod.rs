//! Links over QUIC: what of the API becomes which stream.
//!
//! The first bidirectional stream, opened by the dialer, is the control stream; each flow is a unidirectional
//! stream; datagrams are datagrams. How connections are made and authenticated is in the modules below.

mod clear;
mod config;
mod endpoint;
mod places;

#[cfg(test)]
pub(crate) use config::transport;
pub(crate) use config::{Flavor, Parts, client, endpoint as endpoint_config};
pub(crate) use endpoint::{DRAIN_TIMEOUT, QuicDialer, QuicListener, SERVER_NAME, finish, greet};

use std::fmt;
use std::future::{Future as _, poll_fn};
use std::net::SocketAddr;
use std::pin::pin;
use std::sync::{Arc, OnceLock};
use std::task::Poll;
use std::time::Duration;

use bytes::{Buf as _, Bytes};
use quinn::{
    Connection, ConnectionError, ReadError, RecvStream, SendDatagramError, SendStream, StoppedError, VarInt,
    WriteError,
};
use sgc_sync::lock;
use sgc_trust::VerifiedPeer;
use sgc_wire::{Class, DecodeError, Label, LaneToken, Name, Packet, Slab};
use tokio::sync::Mutex;

use self::places::{Place, Places};
use crate::budget::WindowLease;
use crate::congestion::Gate;
use crate::dtls::Claim;
use crate::error::{CloseReason, FlowEnd, FlowError, LabelError, LinkError, ProtocolError};
use crate::flow::{self, Chunks, FlowRx, FlowTx};
use crate::framing::{CONTROL_FRAME_BYTES_MAX, Pieces, control_head, datagram};
use crate::labels::Labels;
use crate::link::{KeyExchange, Link, LinkStats};

/// Time in which QUIC ends a connection by itself after the layer below has ended.
const LAST_WORD: Duration = Duration::from_millis(500);
/// Most pieces of one read: it bounds received and unconsumed data.
const READ_PIECES: usize = 32;

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
}

/// The cause of a connection's end, where this side knows it better than QUIC.
#[derive(Debug)]
pub(crate) struct LinkEnd {
    idle_timeout: Duration,
    ended_here: OnceLock<LinkError>,
}

impl LinkEnd {
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

/// Order of priorities on a link.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Urgency {
    Of(Class),
    /// Always at once.
    Control,
}

impl Urgency {
    fn priority(self) -> i32 {
        match self {
            Self::Of(class) => class as i32,
            Self::Control => Class::Realtime as i32 + 1,
        }
    }
}

/// The sending half of a stream. Its bytes go out whole and in order, also when a writer is cancelled.
#[derive(Debug)]
pub(crate) struct Outlet {
    stream: SendStream,
    urgency: Urgency,
    pending: Chunks,
    /// The part that is being written.
    piece: Chunks,
    fate: Arc<LinkEnd>,
    gate: Arc<Gate>,
}

impl Outlet {
    fn new(stream: SendStream, urgency: Urgency, fate: &Arc<LinkEnd>, gate: &Arc<Gate>) -> Self {
        // Fails only on a stream that is closed already, which the first write then reports.
        let _ = stream.set_priority(urgency.priority());
        let (fate, gate) = (Arc::clone(fate), Arc::clone(gate));
        Self { stream, urgency, pending: Vec::new(), piece: Vec::new(), fate, gate }
    }

    pub(crate) fn queue(&mut self, chunks: impl Iterator<Item = Bytes>) {
        self.pending.extend(chunks);
    }

    pub(crate) async fn flush(&mut self) -> Result<(), LinkError> {
        while !self.pending.is_empty() {
            let written = match self.urgency {
                Urgency::Control => self.write_all().await,
                Urgency::Of(class) => self.write_piece(class).await,
            };
            if let Err(error) = written {
                self.pending.clear();
                return Err(self.explain(error));
            }
        }
        Ok(())
    }

    /// Writes everything pending, without waiting for the gate.
    async fn write_all(&mut self) -> Result<(), WriteError> {
        let written = self.stream.write_chunks(&mut self.pending).await?;
        self.pending.drain(..written.chunks);
        self.gate.note_written(written.bytes);
        Ok(())
    }

    /// Writes a piece of the pending bytes, as soon as the gate admits it.
    async fn write_piece(&mut self, class: Class) -> Result<(), WriteError> {
        let want = self.pending.iter().map(Bytes::len).sum();
        let permit = match self.gate.try_admit(class, want) {
            Some(permit) => permit,
            None => tokio::select! {
                permit = self.gate.admit(class, want) => permit,
                // The stream stops before its end only if the peer or the connection ends it.
                ended = self.stream.stopped() => return Err(match ended {
                    Ok(Some(code)) => WriteError::Stopped(code),
                    Ok(None) | Err(StoppedError::ZeroRttRejected) => WriteError::ClosedStream,
                    Err(StoppedError::ConnectionLost(e)) => WriteError::ConnectionLost(e),
                }),
            },
        };
        front(&self.pending, permit.bytes(), &mut self.piece);
        let mut permit = Some(permit);
        let (stream, gate) = (&mut self.stream, &self.gate);
        let written = {
            let mut write = pin!(stream.write_chunks(&mut self.piece));
            poll_fn(|cx| {
                let result = write.as_mut().poll(cx);
                // The peer takes no more of this flow: others need not wait for it.
                let leave = permit.take();
                match (&result, leave) {
                    (Poll::Ready(Ok(written)), Some(leave)) => leave.written(written.bytes),
                    (Poll::Ready(Ok(written)), None) => gate.note_written(written.bytes),
                    _ => {}
                }
                result
            })
            .await
        };
        // The rest is in `pending`, too; references here would keep memory of sent bytes.
        self.piece.clear();
        skip(&mut self.pending, written?.bytes);
        Ok(())
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
        self.gate.forget_unsent();
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

/// Makes `out` the first `bytes` of these, or all.
fn front(chunks: &[Bytes], mut bytes: usize, out: &mut Chunks) {
    out.clear();
    for chunk in chunks {
        let n = chunk.len().min(bytes);
        out.push(chunk.slice(..n));
        bytes -= n;
        if bytes == 0 {
            break;
        }
    }
}

/// Drops the first `bytes` of these, and empty pieces.
fn skip(chunks: &mut Chunks, mut bytes: usize) {
    let whole = chunks
        .iter()
        .take_while(|c| {
            c.len() <= bytes && {
                bytes -= c.len();
                true
            }
        })
        .count();
    chunks.drain(..whole);
    if let Some(first) = chunks.first_mut() {
        first.advance(bytes);
    }
}

/// The receiving half of a stream.
#[derive(Debug)]
pub(crate) struct Inlet {
    stream: RecvStream,
    fate: Arc<LinkEnd>,
    /// None for the control stream, which is no flow.
    _place: Option<Place>,
}

impl Inlet {
    fn new(stream: RecvStream, fate: &Arc<LinkEnd>, place: Option<Place>) -> Self {
        Self { stream, fate: Arc::clone(fate), _place: place }
    }

    /// Waits for more of the stream and appends it. Returns `false` at the end.
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

    async fn recv_datagram(&self) -> Result<Result<Packet, DecodeError>, LinkError> {
        let LinkInner { connection, fate, labels, .. } = &*self.shared;
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

fn close(connection: &Connection, fate: &LinkEnd, reason: &CloseReason, error: LinkError) {
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
