//! The halves of QUIC's streams, and the cause of their connection's end.

use std::future::{Future as _, poll_fn};
use std::pin::pin;
use std::sync::{Arc, OnceLock};
use std::task::Poll;
use std::time::Duration;

use bytes::{Buf as _, Bytes};
use quinn::{ConnectionError, ReadError, RecvStream, SendStream, StoppedError, VarInt, WriteError};
use sgc_wire::Class;

use super::places::Place;
use crate::congestion::Gate;
use crate::error::{FlowEnd, FlowError, LinkError};
use crate::framing::{Chunks, Pieces};

/// Most pieces of one read: it bounds received and unconsumed data.
const READ_PIECES: usize = 32;

/// The cause of a connection's end, where this side knows it better than QUIC.
#[derive(Debug)]
pub(crate) struct LinkEnd {
    idle_timeout: Duration,
    ended_here: OnceLock<LinkError>,
}

impl LinkEnd {
    pub(super) fn new(idle_timeout: Duration) -> Arc<Self> {
        Arc::new(Self { idle_timeout, ended_here: OnceLock::new() })
    }

    /// Records this side's cause. The first one stays, as it does in QUIC.
    pub(super) fn set(&self, error: LinkError) {
        let _ = self.ended_here.set(error);
    }

    pub(super) fn explain(&self, error: &ConnectionError) -> LinkError {
        match (error, self.ended_here.get()) {
            (ConnectionError::LocallyClosed, Some(ours)) => ours.clone(),
            _ => LinkError::from_quinn(error, self.idle_timeout),
        }
    }
}

/// Order of priorities on a link.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Urgency {
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
    pub(super) gate: Arc<Gate>,
}

impl Outlet {
    pub(super) fn new(stream: SendStream, urgency: Urgency, fate: &Arc<LinkEnd>, gate: &Arc<Gate>) -> Self {
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
    pub(super) fn new(stream: RecvStream, fate: &Arc<LinkEnd>, place: Option<Place>) -> Self {
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
