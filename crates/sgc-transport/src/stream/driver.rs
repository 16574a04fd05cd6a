//! The task of one link: it moves bytes between the socket and the machine, and decides nothing.

use std::collections::VecDeque;
use std::future::poll_fn;
use std::io::{self, IoSlice};
use std::pin::Pin;
use std::sync::Arc;
use std::task::{Context, Poll, ready};
use std::time::{Duration, Instant};

use bytes::{Buf as _, Bytes};
use tokio::io::{AsyncRead as _, AsyncReadExt as _, AsyncWrite as _, AsyncWriteExt as _, ReadBuf};
use tokio::time::{Sleep, sleep_until, timeout};

use super::halves::{LinkInner, State};
use super::record::RecordError;
use super::wire::Wire;
use crate::error::{CloseReason, LinkError, ProtocolError};

/// Bytes fetched from the machine at once, at least and at most; between, the bytes that the path delivers in little
/// time. Urgent packets wait for no more. Bytes written together become TLS records of up to 16 KB, which can be read
/// only when the last byte is there, and on a thin path that takes long.
const BATCH_BYTES: (u64, u64) = (2 << 10, 64 << 10);
/// Bytes read at once.
const READ_BYTES: usize = 64 << 10;
/// Rounds of one wake-up, so that one link leaves time for others.
const ROUNDS_MAX: usize = 16;
/// Pieces written at once.
const SLICES_MAX: usize = 64;
/// Time that a closed link has to tell its peer.
pub(super) const DRAIN_TIMEOUT: Duration = Duration::from_secs(1);
/// Most bytes read and thrown away while a connection ends.
const DRAIN_BYTES_MAX: u64 = 4 << 20;

/// Runs a link until it is over.
pub(super) async fn run(wire: Wire, shared: Arc<LinkInner>, idle_timeout: Duration) {
    let mut driver = Driver {
        wire,
        out: VecDeque::new(),
        buffer: vec![0; READ_BYTES].into_boxed_slice(),
        timer: Box::pin(sleep_until(tokio::time::Instant::now())),
        closing_since: None,
        needs_flush: false,
        idle_timeout,
    };
    let is_polite = poll_fn(|cx| driver.poll(cx, &shared)).await;
    if is_polite {
        part(driver.wire).await;
    }
    let mut state = shared.lock();
    state.is_drained = true;
    drop(state);
    shared.ended.notify_waiters();
}

/// Ends a connection so that the peer gets the last bytes: closing with unread input would make the kernel drop them.
pub(super) async fn part(mut wire: Wire) {
    let parting = async {
        wire.shutdown().await?;
        tokio::io::copy(&mut (&mut wire).take(DRAIN_BYTES_MAX), &mut tokio::io::sink()).await
    };
    // The connection is over either way.
    let _ = timeout(DRAIN_TIMEOUT, parting).await;
}

struct Driver {
    wire: Wire,
    out: VecDeque<Bytes>,
    buffer: Box<[u8]>,
    timer: Pin<Box<Sleep>>,
    closing_since: Option<Instant>,
    needs_flush: bool,
    idle_timeout: Duration,
}

impl Driver {
    /// Ready once nothing is left to do: `true` if the task has to wait for the peer.
    fn poll(&mut self, cx: &mut Context<'_>, shared: &LinkInner) -> Poll<bool> {
        for _ in 0..ROUNDS_MAX {
            let now = Instant::now();
            let has_read = match self.read(cx, shared, now) {
                Poll::Ready(Ok(())) => true,
                Poll::Ready(Err(error)) => {
                    shared.end(&mut shared.lock(), error);
                    return Poll::Ready(false);
                }
                Poll::Pending => false,
            };
            let (until, is_over) = {
                let mut state = shared.lock();
                if !state.mux.handle_timeout(now) && state.end.is_none() {
                    shared.end(&mut state, LinkError::TimedOut { after: self.idle_timeout });
                    return Poll::Ready(false);
                }
                if state.end.is_some() && self.closing_since.is_none() {
                    self.closing_since = Some(now);
                }
                if self.out.is_empty() {
                    let (least, most) = BATCH_BYTES;
                    let batch = state.mux.bytes_together().clamp(least, most);
                    state.mux.poll_transmit(now, batch, &mut self.out);
                    shared.drain_events(&mut state);
                }
                state.driver = Some(cx.waker().clone());
                let until = self.closing_since.map(|at| at + DRAIN_TIMEOUT);
                (until.unwrap_or_else(|| state.mux.poll_timeout(self.out.is_empty())), state.mux.is_over())
            };
            if self.closing_since.is_some() && now >= until {
                return Poll::Ready(false);
            }
            let has_written = match self.write(cx) {
                Poll::Ready(Ok(has_written)) => has_written,
                Poll::Ready(Err(error)) => {
                    shared.end(&mut shared.lock(), lost(error, self.idle_timeout));
                    return Poll::Ready(false);
                }
                Poll::Pending => false,
            };
            if is_over && self.out.is_empty() && !self.needs_flush {
                return Poll::Ready(true);
            }
            if !has_read && !has_written {
                self.timer.as_mut().reset(until.into());
                if self.timer.as_mut().poll_elapsed(cx).is_pending() {
                    return Poll::Pending;
                }
            }
        }
        cx.waker().wake_by_ref();
        Poll::Pending
    }

    fn read(
        &mut self,
        cx: &mut Context<'_>,
        shared: &LinkInner,
        now: Instant,
    ) -> Poll<Result<(), LinkError>> {
        let mut buffer = ReadBuf::new(&mut self.buffer);
        let result = ready!(Pin::new(&mut self.wire).poll_read(cx, &mut buffer));
        let result = result.and_then(|()| match buffer.filled().len() {
            0 => Err(io::ErrorKind::UnexpectedEof.into()),
            _ => Ok(()),
        });
        let mut state = shared.lock();
        if let Err(error) = result {
            return Poll::Ready(Err(lost(error, self.idle_timeout)));
        }
        let State { mux, end, .. } = &mut *state;
        if end.is_none()
            && let Err(violation) = mux.handle_input(now, buffer.filled())
        {
            let why = ProtocolError::Stream(violation);
            let (code, text) = CloseReason::Protocol(why.to_string()).to_wire();
            mux.close(code.into(), Bytes::from(text));
            shared.end(&mut state, why.into());
        }
        shared.drain_events(&mut state);
        Poll::Ready(Ok(()))
    }

    /// Writes waiting bytes. Ready with `true` if that made room for more.
    fn write(&mut self, cx: &mut Context<'_>) -> Poll<io::Result<bool>> {
        let mut has_written = false;
        while !self.out.is_empty() {
            let mut slices = [IoSlice::new(&[]); SLICES_MAX];
            let count = self.out.len().min(SLICES_MAX);
            for (slice, chunk) in slices.iter_mut().zip(&self.out) {
                *slice = IoSlice::new(chunk);
            }
            let mut n = match Pin::new(&mut self.wire).poll_write_vectored(cx, &slices[..count])? {
                Poll::Ready(0) => return Poll::Ready(Err(io::ErrorKind::WriteZero.into())),
                Poll::Ready(n) => n,
                Poll::Pending => return Poll::Pending,
            };
            self.needs_flush = true;
            while let Some(front) = self.out.front_mut() {
                if front.len() > n {
                    front.advance(n);
                    break;
                }
                n -= front.len();
                self.out.pop_front();
            }
            has_written = true;
        }
        if self.needs_flush {
            ready!(Pin::new(&mut self.wire).poll_flush(cx))?;
            self.needs_flush = false;
        }
        Poll::Ready(Ok(has_written))
    }
}

trait PollTimer {
    fn poll_elapsed(self, cx: &mut Context<'_>) -> Poll<()>;
}

impl PollTimer for Pin<&mut Sleep> {
    fn poll_elapsed(self, cx: &mut Context<'_>) -> Poll<()> {
        std::future::Future::poll(self, cx)
    }
}

/// Returns the reason why an established connection is gone.
pub(super) fn lost(error: io::Error, idle_timeout: Duration) -> LinkError {
    match error.kind() {
        io::ErrorKind::UnexpectedEof
        | io::ErrorKind::ConnectionReset
        | io::ErrorKind::ConnectionAborted
        | io::ErrorKind::BrokenPipe
        | io::ErrorKind::WriteZero => LinkError::Cut,
        io::ErrorKind::TimedOut => LinkError::TimedOut { after: idle_timeout },
        io::ErrorKind::InvalidData => match error.get_ref().and_then(|e| e.downcast_ref()) {
            Some(RecordError::Altered) => LinkError::Altered,
            _ => LinkError::Transport(error.to_string()),
        },
        _ => error.into(),
    }
}
