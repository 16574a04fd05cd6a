//! The streams of bytes below a link: a common trait, counters, and the end of TLS on a stream that continues without
//! it.

use std::io::{self, IoSlice};
use std::pin::Pin;
use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering::Relaxed};
use std::task::{Context, Poll, ready};

use tokio::io::{AsyncRead, AsyncWrite, ReadBuf};
use tokio::net::TcpStream;

/// Any stream of bytes.
pub(super) type Wire = Box<dyn Io>;

/// The abilities of a stream of bytes.
pub(super) trait Io: AsyncRead + AsyncWrite + Send + Unpin {}

impl<T: AsyncRead + AsyncWrite + Send + Unpin> Io for T {}

/// Bytes of one TCP connection.
#[derive(Debug, Default)]
pub(super) struct Counters {
    sent: AtomicU64,
    received: AtomicU64,
}

impl Counters {
    /// Returns sent and received bytes.
    pub(super) fn read(&self) -> (u64, u64) {
        (self.sent.load(Relaxed), self.received.load(Relaxed))
    }
}

/// A TCP connection with counters.
pub(super) struct CountingTcp {
    pub(super) tcp: TcpStream,
    pub(super) counters: Arc<Counters>,
}

impl AsyncRead for CountingTcp {
    fn poll_read(
        mut self: Pin<&mut Self>,
        cx: &mut Context<'_>,
        buf: &mut ReadBuf<'_>,
    ) -> Poll<io::Result<()>> {
        let before = buf.filled().len();
        ready!(Pin::new(&mut self.tcp).poll_read(cx, buf))?;
        self.counters.received.fetch_add((buf.filled().len() - before) as u64, Relaxed);
        Poll::Ready(Ok(()))
    }
}

impl CountingTcp {
    fn count(&self, written: Poll<io::Result<usize>>) -> Poll<io::Result<usize>> {
        if let Poll::Ready(Ok(n)) = &written {
            self.counters.sent.fetch_add(*n as u64, Relaxed);
        }
        written
    }
}

impl AsyncWrite for CountingTcp {
    fn poll_write(mut self: Pin<&mut Self>, cx: &mut Context<'_>, buf: &[u8]) -> Poll<io::Result<usize>> {
        let written = Pin::new(&mut self.tcp).poll_write(cx, buf);
        self.count(written)
    }

    fn poll_write_vectored(
        mut self: Pin<&mut Self>,
        cx: &mut Context<'_>,
        bufs: &[IoSlice<'_>],
    ) -> Poll<io::Result<usize>> {
        let written = Pin::new(&mut self.tcp).poll_write_vectored(cx, bufs);
        self.count(written)
    }

    fn is_write_vectored(&self) -> bool {
        true
    }

    fn poll_flush(mut self: Pin<&mut Self>, cx: &mut Context<'_>) -> Poll<io::Result<()>> {
        Pin::new(&mut self.tcp).poll_flush(cx)
    }

    fn poll_shutdown(mut self: Pin<&mut Self>, cx: &mut Context<'_>) -> Poll<io::Result<()>> {
        Pin::new(&mut self.tcp).poll_shutdown(cx)
    }
}

const RECORD_HEAD_BYTES: usize = 5;

/// The stream below TLS. Where TLS ends before the stream does, it hands out one TLS record at a time and keeps the
/// stream open when TLS ends: so bytes behind the last record of TLS are never read as TLS.
pub(super) struct TlsIo {
    wire: Wire,
    /// `None` passes everything on as it is.
    records: Option<Records>,
}

#[derive(Default)]
struct Records {
    head: [u8; RECORD_HEAD_BYTES],
    /// Bytes of the head, received and handed out.
    filled: usize,
    handed: usize,
    /// Bytes of the body, still to come.
    left: usize,
}

impl TlsIo {
    /// Returns a stream that TLS uses to its end.
    pub(super) fn whole(wire: Wire) -> Self {
        Self { wire, records: None }
    }

    /// Returns a stream that goes on after TLS ends.
    pub(super) fn until_close_notify(wire: Wire) -> Self {
        Self { wire, records: Some(Records::default()) }
    }

    /// Returns the stream below.
    pub(super) fn into_wire(self) -> Wire {
        self.wire
    }
}

impl AsyncRead for TlsIo {
    fn poll_read(self: Pin<&mut Self>, cx: &mut Context<'_>, buf: &mut ReadBuf<'_>) -> Poll<io::Result<()>> {
        let Self { wire, records } = self.get_mut();
        let Some(records) = records else { return Pin::new(wire).poll_read(cx, buf) };
        if buf.remaining() == 0 {
            return Poll::Ready(Ok(()));
        }
        if records.left == 0 && records.handed == RECORD_HEAD_BYTES {
            *records = Records::default();
        }
        while records.filled < RECORD_HEAD_BYTES {
            let mut head = ReadBuf::new(&mut records.head[records.filled..]);
            ready!(Pin::new(&mut *wire).poll_read(cx, &mut head))?;
            let n = head.filled().len();
            if n == 0 {
                return Poll::Ready(Ok(()));
            }
            records.filled += n;
            if records.filled == RECORD_HEAD_BYTES {
                records.left = usize::from(u16::from_be_bytes([records.head[3], records.head[4]]));
            }
        }
        if records.handed < RECORD_HEAD_BYTES {
            let n = buf.remaining().min(RECORD_HEAD_BYTES - records.handed);
            buf.put_slice(&records.head[records.handed..records.handed + n]);
            records.handed += n;
            return Poll::Ready(Ok(()));
        }
        let most = buf.remaining().min(records.left);
        let mut body = ReadBuf::new(buf.initialize_unfilled_to(most));
        ready!(Pin::new(wire).poll_read(cx, &mut body))?;
        let n = body.filled().len();
        buf.advance(n);
        records.left -= n;
        Poll::Ready(Ok(()))
    }
}

impl AsyncWrite for TlsIo {
    fn poll_write(self: Pin<&mut Self>, cx: &mut Context<'_>, buf: &[u8]) -> Poll<io::Result<usize>> {
        Pin::new(&mut self.get_mut().wire).poll_write(cx, buf)
    }

    fn poll_write_vectored(
        self: Pin<&mut Self>,
        cx: &mut Context<'_>,
        bufs: &[IoSlice<'_>],
    ) -> Poll<io::Result<usize>> {
        Pin::new(&mut self.get_mut().wire).poll_write_vectored(cx, bufs)
    }

    fn is_write_vectored(&self) -> bool {
        self.wire.is_write_vectored()
    }

    fn poll_flush(self: Pin<&mut Self>, cx: &mut Context<'_>) -> Poll<io::Result<()>> {
        Pin::new(&mut self.get_mut().wire).poll_flush(cx)
    }

    fn poll_shutdown(self: Pin<&mut Self>, cx: &mut Context<'_>) -> Poll<io::Result<()>> {
        let Self { wire, records } = self.get_mut();
        match records {
            Some(_) => Pin::new(wire).poll_flush(cx),
            None => Pin::new(wire).poll_shutdown(cx),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use tokio::io::{AsyncReadExt as _, AsyncWriteExt as _};

    #[tokio::test]
    async fn records_are_handed_out_one_by_one_in_any_division_of_the_stream() {
        let record = |body: &[u8]| [&[23, 3, 3, 0, body.len() as u8], body].concat();
        let stream = [record(b"first"), record(b""), record(b"second"), b"clear".to_vec()].concat();
        for size in [1, 2, 5, 6, 11, stream.len()] {
            let (mut tx, rx) = tokio::io::duplex(size);
            let sent = stream.clone();
            let writer = tokio::spawn(async move { tx.write_all(&sent).await });
            let mut below = TlsIo::until_close_notify(Box::new(rx));
            for record in [record(b"first"), record(b""), record(b"second")] {
                let mut got = Vec::new();
                while got.len() < record.len() {
                    let mut buffer = [0; 64];
                    let n = below.read(&mut buffer).await.unwrap();
                    got.extend_from_slice(&buffer[..n]);
                }
                assert_eq!(got, record);
            }
            let mut rest = String::new();
            below.into_wire().read_to_string(&mut rest).await.unwrap();
            assert_eq!(rest, "clear");
            writer.await.unwrap().unwrap();
        }
    }
}
