//! [`Inflow`]: the bytes of unfinished WebSocket messages. They are charged to the client's quota from the first byte
//! on, so that many connections with unfinished long messages take no more memory than the quota allows.
//!
//! gRPC has its own accounting (`grpc::incoming`), because its messages begin with their length.

use std::io;
use std::pin::Pin;
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, Mutex, OnceLock};
use std::task::{Context, Poll, ready};

use sgc_sync::lock;
use tokio::io::{AsyncRead, AsyncWrite, ReadBuf};

use crate::error::GatewayError;
use crate::quota::{Permits, Quota, UNIT_BYTES};

/// The bytes of unfinished messages of one connection.
#[derive(Debug, Default)]
pub(crate) struct Inflow {
    /// The quota of the client after its admission. Before that the upgrade bounds the bytes.
    quota: OnceLock<Quota>,
    held: Mutex<UnfinishedBytes>,
    /// `true` once received bytes are discarded, which take no memory.
    is_discarded: AtomicBool,
}

#[derive(Debug, Default)]
struct UnfinishedBytes {
    bytes: usize,
    /// One unit for each [`UNIT_BYTES`] beyond the first.
    room: Vec<Permits>,
}

impl Inflow {
    /// Charges bytes to this quota from now on.
    pub(crate) fn admit(&self, quota: &Quota) {
        let _ = self.quota.set(quota.clone());
    }

    /// Charges received bytes.
    pub(crate) fn add(&self, bytes: usize) -> Result<(), GatewayError> {
        let Some(quota) = self.quota.get().filter(|_| !self.is_discarded.load(Ordering::Relaxed)) else {
            return Ok(());
        };
        let mut held = lock(&self.held);
        held.bytes += bytes;
        while held.room.len() < (held.bytes.saturating_sub(1)) / UNIT_BYTES {
            let room = quota.room_at_once(1)?;
            held.room.push(room);
        }
        Ok(())
    }

    /// Releases bytes that were kept.
    pub(crate) fn give_back(&self, bytes: usize) {
        let mut held = lock(&self.held);
        held.bytes = held.bytes.saturating_sub(bytes);
        let places = held.bytes.saturating_sub(1) / UNIT_BYTES;
        held.room.truncate(places);
    }

    /// Releases all bytes, and charges none from now on, because they are discarded.
    pub(crate) fn discard(&self) {
        self.is_discarded.store(true, Ordering::Relaxed);
        self.finish_keeping(0);
    }

    /// Releases the bytes of a finished message, except for `kept` bytes.
    pub(crate) fn finish_keeping(&self, kept: usize) {
        let mut held = lock(&self.held);
        held.bytes = kept;
        held.room.truncate(kept.saturating_sub(1) / UNIT_BYTES);
    }
}

/// A stream that charges the bytes that are read from it.
#[derive(Debug)]
pub(crate) struct MeteredStream<S> {
    stream: S,
    inflow: Arc<Inflow>,
}

impl<S> MeteredStream<S> {
    pub(crate) fn new(stream: S, inflow: Arc<Inflow>) -> Self {
        Self { stream, inflow }
    }
}

impl<S: AsyncRead + Unpin> AsyncRead for MeteredStream<S> {
    fn poll_read(
        mut self: Pin<&mut Self>,
        cx: &mut Context<'_>,
        buf: &mut ReadBuf<'_>,
    ) -> Poll<io::Result<()>> {
        let before = buf.filled().len();
        ready!(Pin::new(&mut self.stream).poll_read(cx, buf))?;
        let added = self.inflow.add(buf.filled().len() - before);
        Poll::Ready(added.map_err(io::Error::other))
    }
}

impl<S: AsyncWrite + Unpin> AsyncWrite for MeteredStream<S> {
    fn poll_write(mut self: Pin<&mut Self>, cx: &mut Context<'_>, buf: &[u8]) -> Poll<io::Result<usize>> {
        Pin::new(&mut self.stream).poll_write(cx, buf)
    }

    fn poll_flush(mut self: Pin<&mut Self>, cx: &mut Context<'_>) -> Poll<io::Result<()>> {
        Pin::new(&mut self.stream).poll_flush(cx)
    }

    fn poll_shutdown(mut self: Pin<&mut Self>, cx: &mut Context<'_>) -> Poll<io::Result<()>> {
        Pin::new(&mut self.stream).poll_shutdown(cx)
    }

    fn poll_write_vectored(
        mut self: Pin<&mut Self>,
        cx: &mut Context<'_>,
        bufs: &[io::IoSlice<'_>],
    ) -> Poll<io::Result<usize>> {
        Pin::new(&mut self.stream).poll_write_vectored(cx, bufs)
    }

    fn is_write_vectored(&self) -> bool {
        self.stream.is_write_vectored()
    }
}

#[cfg(test)]
mod tests {
    use tokio::io::AsyncReadExt as _;

    use super::*;
    use crate::access::Client;
    use crate::pool::Pool;
    use crate::quota::Quotas;

    #[tokio::test]
    async fn messages_that_do_not_end_take_no_more_than_the_quota_has() {
        const BEGUN: usize = 60 << 20;
        let quotas: Arc<Quotas> = Arc::default();
        let quota = quotas.quota(&Client::own("test"));
        let mut begun = Vec::new();
        let refused = loop {
            let inflow = Inflow::default();
            inflow.admit(&quota);
            let added = inflow.add(BEGUN);
            begun.push(inflow);
            if let Err(refused) = added {
                break refused;
            }
            assert!(begun.len() < 1000, "nothing stops it");
        };
        assert!(matches!(refused, GatewayError::Crowded { pool: Pool::Total, .. }), "{refused}");
        assert_eq!(begun.len(), (2048 << 20) / BEGUN + 1);
        // Short messages need no room, and finished ones release theirs.
        let short = Inflow::default();
        short.admit(&quota);
        short.add(UNIT_BYTES).unwrap();
        assert!(short.add(1 << 20).is_err());
        short.finish_keeping(0);
        begun.iter().for_each(|inflow| inflow.finish_keeping(0));
        let mut stream = MeteredStream::new(&[7; 200_000][..], Arc::new(short));
        assert_eq!(stream.read_to_end(&mut Vec::new()).await.unwrap(), 200_000);
        assert_eq!(lock(&stream.inflow.held).room.len(), (200_000 - 1) / UNIT_BYTES);
        stream.inflow.discard();
        stream.inflow.add(usize::MAX / 2).unwrap();
        assert!(lock(&stream.inflow.held).room.is_empty());
    }
}
