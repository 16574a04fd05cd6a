//! [`GrpcFront`]: gRPC connections, from the end of the TLS handshake to the gRPC server.

use std::io;
use std::pin::Pin;
use std::sync::Arc;
use std::task::{Context, Poll};
use std::time::Duration;

use tokio::io::{AsyncRead, AsyncWrite, ReadBuf};
use tokio::sync::{mpsc, watch};
use tokio::task::JoinSet;
use tokio::time::{Instant, Sleep};
use tokio_stream::wrappers::ReceiverStream;

use super::stream::ByteStream;
use crate::admission::{Admission, Arrival, Handshake, Place};
use crate::grpc::{AcceptedStream, Connection, Grpc, GrpcOptions};
use crate::hub::Hub;
use crate::limits::SessionLimits;
use crate::refusal::ClientRefusal;

/// Time to deliver the last answers on a gRPC connection on which no client is admitted any more.
const GRPC_FAREWELL_MAX: Duration = Duration::from_secs(2);
/// Most connections that wait for the gRPC server.
const GRPC_WAITING_MAX: usize = 64;

/// The front end for gRPC.
pub(super) struct GrpcFront {
    admission: Arc<Admission>,
    accepted: mpsc::Sender<AcceptedStream<GrpcStream>>,
}

impl GrpcFront {
    /// Starts the gRPC server among `tasks`.
    pub(super) fn start(
        hub: Hub,
        admission: Arc<Admission>,
        limits: SessionLimits,
        tasks: &mut JoinSet<()>,
    ) -> Self {
        let (sender, accepted) = mpsc::channel(GRPC_WAITING_MAX);
        let options = GrpcOptions { session: limits, ..GrpcOptions::default() };
        let front = Grpc::new(hub, admission.rules().clone(), options);
        tasks.spawn(async move {
            if let Err(error) = front.serve(ReceiverStream::new(accepted)).await {
                tracing::error!(%error, "gRPC is not served any more");
            }
        });
        Self { admission, accepted: sender }
    }

    /// Hands a connection over to the gRPC server. Its client shows a credential with each call and must be admitted
    /// by the deadline.
    pub(super) async fn serve(
        &self,
        stream: Box<dyn ByteStream>,
        arrival: Arrival,
        deadline: Instant,
        handshake: Handshake,
        open: watch::Receiver<()>,
    ) {
        let Arrival { peer, is_encrypted, certificate } = arrival;
        let connection =
            if is_encrypted { Connection::encrypted(peer, certificate) } else { Connection::plain(peer) };
        let admission = Arc::clone(&self.admission);
        let placed = GrpcStream::new(stream, admission, connection.clone(), deadline, handshake, open);
        let _ = self.accepted.send(AcceptedStream::new(placed, connection)).await;
    }
}

/// The byte stream of a gRPC connection. Its client must be admitted in time, and occupies a place while a client is
/// admitted on it.
struct GrpcStream {
    stream: Box<dyn ByteStream>,
    admission: Arc<Admission>,
    connection: Connection,
    standing: Standing,
    /// Ends when the address over which the connection came is closed.
    closing: Pin<Box<dyn Future<Output = ()> + Send>>,
}

/// The admission state of a gRPC connection.
enum Standing {
    /// The client has not been admitted yet and must be by the deadline.
    Unproven { deadline: Pin<Box<Sleep>>, handshake: Handshake },
    /// The client was admitted.
    Proven(#[expect(dead_code, reason = "it is for its end")] Place),
    /// No client is admitted any more. Until the deadline the client may read the refusal or show another credential.
    Denied { deadline: Pin<Box<Sleep>> },
    /// The connection must close. The reason has been counted.
    Refused,
}

impl GrpcStream {
    fn new(
        stream: Box<dyn ByteStream>,
        admission: Arc<Admission>,
        connection: Connection,
        deadline: Instant,
        handshake: Handshake,
        mut open: watch::Receiver<()>,
    ) -> Self {
        let deadline = Box::pin(tokio::time::sleep_until(deadline));
        let standing = Standing::Unproven { deadline, handshake };
        let closing = Box::pin(async move { while open.changed().await.is_ok() {} });
        Self { stream, admission, connection, standing, closing }
    }

    /// Fails once the client may not stay. Called before reads and writes, because a client that does not read its
    /// answers must not send either.
    fn check(&mut self, cx: &mut Context<'_>) -> io::Result<()> {
        if matches!(self.standing, Standing::Refused) || self.closing.as_mut().poll(cx).is_ready() {
            self.standing = Standing::Refused;
            return Err(io::ErrorKind::ConnectionAborted.into());
        }
        let admitted = self.connection.poll_admitted(cx);
        let (standing, result) = match (&mut self.standing, admitted) {
            (Standing::Refused, _) => return Err(io::ErrorKind::ConnectionAborted.into()),
            (Standing::Proven(_), Some(_)) => return Ok(()),
            (Standing::Proven(_), None) => {
                self.admission.count(ClientRefusal::NoLongerAdmitted);
                let deadline = Box::pin(tokio::time::sleep(GRPC_FAREWELL_MAX));
                self.standing = Standing::Denied { deadline };
                return self.check(cx);
            }
            (_, Some(client)) => match self.admission.enter(&client, "grpc", self.connection.peer()) {
                Ok(place) => (Standing::Proven(place), Ok(())),
                Err(why) => (Standing::Refused, Err(io::Error::other(why))),
            },
            (Standing::Unproven { deadline, handshake }, None) => {
                if handshake.poll_evicted(cx).is_ready() {
                    self.admission.count(ClientRefusal::HandshakeGaveWay);
                    (Standing::Refused, Err(io::ErrorKind::ConnectionAborted.into()))
                } else if deadline.as_mut().poll(cx).is_ready() {
                    self.admission.count(ClientRefusal::HandshakeTooSlow);
                    (Standing::Refused, Err(io::ErrorKind::TimedOut.into()))
                } else {
                    return Ok(());
                }
            }
            (Standing::Denied { deadline }, None) => match deadline.as_mut().poll(cx) {
                Poll::Pending => return Ok(()),
                Poll::Ready(()) => (Standing::Refused, Err(io::ErrorKind::ConnectionAborted.into())),
            },
        };
        self.standing = standing;
        result
    }
}

impl AsyncRead for GrpcStream {
    fn poll_read(
        mut self: Pin<&mut Self>,
        cx: &mut Context<'_>,
        buf: &mut ReadBuf<'_>,
    ) -> Poll<io::Result<()>> {
        self.check(cx)?;
        Pin::new(&mut self.stream).poll_read(cx, buf)
    }
}

impl AsyncWrite for GrpcStream {
    fn poll_write(mut self: Pin<&mut Self>, cx: &mut Context<'_>, buf: &[u8]) -> Poll<io::Result<usize>> {
        self.check(cx)?;
        Pin::new(&mut self.stream).poll_write(cx, buf)
    }

    fn poll_flush(mut self: Pin<&mut Self>, cx: &mut Context<'_>) -> Poll<io::Result<()>> {
        self.check(cx)?;
        Pin::new(&mut self.stream).poll_flush(cx)
    }

    fn poll_shutdown(mut self: Pin<&mut Self>, cx: &mut Context<'_>) -> Poll<io::Result<()>> {
        // A connection that must close does not wait until its farewell is sent.
        self.check(cx)?;
        Pin::new(&mut self.stream).poll_shutdown(cx)
    }

    fn poll_write_vectored(
        mut self: Pin<&mut Self>,
        cx: &mut Context<'_>,
        bufs: &[io::IoSlice<'_>],
    ) -> Poll<io::Result<usize>> {
        self.check(cx)?;
        Pin::new(&mut self.stream).poll_write_vectored(cx, bufs)
    }

    fn is_write_vectored(&self) -> bool {
        self.stream.is_write_vectored()
    }
}

#[cfg(test)]
mod tests {
    use std::net::SocketAddr;

    use tokio::io::{AsyncReadExt as _, AsyncWriteExt as _, duplex};

    use super::*;
    use crate::access::Access;
    use crate::admission::Handshakes;

    /// Time for the handshake.
    const TIME: Duration = Duration::from_secs(10);

    /// Returns a gRPC stream from another host and its far end.
    fn placed(
        admission: &Arc<Admission>,
        handshakes: &Arc<Handshakes>,
        open: &watch::Sender<()>,
    ) -> (GrpcStream, tokio::io::DuplexStream) {
        let peer: SocketAddr = "192.0.2.1:1000".parse().unwrap();
        let (near, far) = duplex(16);
        let handshake = Handshakes::begin(handshakes, peer.ip()).unwrap();
        let (admission, deadline) = (Arc::clone(admission), Instant::now() + TIME);
        let (plain, open) = (Connection::plain(peer), open.subscribe());
        (GrpcStream::new(Box::new(near), admission, plain, deadline, handshake, open), far)
    }

    #[tokio::test(start_paused = true)]
    async fn unproven_client_is_disconnected_without_a_place() {
        let (admission, handshakes) = (Admission::new(Access::default(), 1), Arc::default());
        let open = watch::Sender::new(());
        let (mut silent, _far) = placed(&admission, &handshakes, &open);
        let (mut deaf, _other) = placed(&admission, &handshakes, &open);
        let began = Instant::now();
        let mut buf = [0; 16];
        let read = silent.read(&mut buf);
        let written = async {
            // These bytes exceed the buffer.
            deaf.write_all(&[0; 64]).await
        };
        let (read, written) = tokio::join!(read, written);
        assert_eq!(read.unwrap_err().kind(), io::ErrorKind::TimedOut);
        assert_eq!(written.unwrap_err().kind(), io::ErrorKind::TimedOut);
        assert!(began.elapsed() >= TIME && began.elapsed() < 2 * TIME);
        assert!(silent.read(&mut buf).await.is_err() && silent.shutdown().await.is_err());
        assert_eq!(admission.refused(), [("handshake too slow".to_owned(), 2)].into());
        assert!(admission.clients().is_empty());
    }

    #[tokio::test(start_paused = true)]
    async fn connection_ends_with_its_address() {
        let (admission, handshakes) = (Admission::new(Access::default(), 1), Arc::default());
        let open = watch::Sender::new(());
        let (mut stream, _far) = placed(&admission, &handshakes, &open);
        let (began, mut buf) = (Instant::now(), [0; 16]);
        let close = async {
            tokio::time::sleep(TIME / 4).await;
            drop(open);
        };
        let (read, ()) = tokio::join!(stream.read(&mut buf), close);
        assert_eq!(read.unwrap_err().kind(), io::ErrorKind::ConnectionAborted);
        assert!(began.elapsed() < TIME / 2);
        assert!(stream.write(&[0]).await.is_err() && stream.read(&mut buf).await.is_err());
    }
}
