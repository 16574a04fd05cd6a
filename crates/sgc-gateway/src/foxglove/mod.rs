//! Foxglove's WebSocket protocol, by which Foxglove and Lichtblick show a robot, publish, call services and set
//! parameters.
//!
//! [`serve`] runs one client's connection from the first message on. The module `server` does the upgrade, TLS and
//! admission. The crate `foxglove` is not used: it has its own listener and hub, offers neither a scope for each
//! client nor bounds in bytes, and brings schemas and MCAP with it.
//!
//! A connection is one task with bounded memory. Unsent answers stop it from reading more requests. Messages beyond
//! [`SessionLimits::waiting_bytes_max`](crate::SessionLimits) are dropped, and the client learns of that.
//!
//! `foxglove.sdk.v1` and `foxglove.websocket.v1` differ on the wire only by name: the former adds playback control,
//! which servers of recordings offer.

mod connection;
mod connections;
mod listing;
mod options;
mod outbox;
mod parameters;
mod protocol;
mod refusal;

use std::sync::Arc;
use std::time::Duration;

use futures_util::{Sink, SinkExt, StreamExt};
use sgc_websocket::{Message as Frame, WebSocket, WebSocketError as SocketError};
use tokio::io::{AsyncRead, AsyncWrite};

use crate::keep_alive::{PingState, TooSlow, write_paced};
use crate::quota::PendingBytes;
use crate::session::Session;
use crate::ws::finish;

use connection::Connection;
pub use options::{FoxgloveError, Options};
use outbox::Outbox;

/// WebSocket subprotocols of this protocol, the preferred one first.
pub const SUBPROTOCOLS: [&str; 2] = ["foxglove.sdk.v1", "foxglove.websocket.v1"];

/// Most bytes that are written before a flush.
const FLUSH_BYTES: usize = 256 << 10;

/// Time in which queued answers may be written when the connection ends.
const FAREWELL_MAX: Duration = Duration::from_secs(1);

/// Serves a client until it leaves. Dropping the future ends the connection and everything that the client has.
///
/// # Errors
/// The connection failed, the client fell silent or its rights ended. A client that leaves is no error.
pub async fn serve<S>(
    socket: WebSocket<S>,
    session: Arc<Session>,
    options: Options,
) -> Result<(), FoxgloveError>
where
    S: AsyncRead + AsyncWrite + Unpin + Send,
{
    let (mut sink, mut frames) = socket.split();
    let waiting = PendingBytes::new(session.limits().waiting_bytes_max, session.quota().clone());
    let (outbox, inflow) = (Outbox::new(waiting), session.inflow());
    let (pings, silence_max) = (PingState::default(), options.silence_max);
    let mut connection = Connection::new(Arc::clone(&session), options, &outbox);
    let ended = tokio::select! {
        biased;
        denied = session.until_denied() => Err(FoxgloveError::Denied(denied)),
        ended = connection.run(&mut frames, &pings) => ended,
        failed = write(&mut sink, &outbox, &pings, silence_max) => Err(failed),
    };
    drop(connection);
    let close = ended.as_ref().err().and_then(FoxgloveError::close);
    if !matches!(ended, Err(FoxgloveError::Denied(_))) {
        let _ = tokio::time::timeout(FAREWELL_MAX, write_answers(&mut sink, &outbox)).await;
    }
    if let Ok(socket) = frames.reunite(sink) {
        finish(socket, &inflow, close.as_ref().map(|(code, why)| (*code, why.as_str()))).await;
    }
    match ended {
        Err(FoxgloveError::Socket(SocketError::Closed)) => Ok(()),
        ended => ended,
    }
}

/// Writes the queued answers, and no messages of topics.
async fn write_answers<K>(sink: &mut K, outbox: &Outbox) -> Result<(), SocketError>
where
    K: Sink<Frame, Error = SocketError> + Unpin,
{
    while let Some(answer) = outbox.pop_answer() {
        sink.feed(answer).await?;
    }
    sink.flush().await
}

/// Writes queued frames until the socket fails, or the client does not take them.
async fn write<K>(sink: &mut K, outbox: &Outbox, pings: &PingState, silence_max: Duration) -> FoxgloveError
where
    K: Sink<Frame, Error = SocketError> + Unpin,
{
    // Bytes that have not been flushed.
    let mut waiting_bytes = 0;
    loop {
        let frame = outbox.pop();
        let (is_empty, is_ping) = (frame.is_none(), matches!(frame, Some(Frame::Ping(_))));
        let bytes = frame.as_ref().map_or(0, Frame::payload_bytes);
        waiting_bytes += bytes;
        pings.wrote(bytes);
        let is_flushed = is_empty || is_ping || waiting_bytes >= FLUSH_BYTES;
        let written = write_paced(silence_max, waiting_bytes, async {
            if let Some(frame) = frame {
                sink.feed(frame).await?;
            }
            if is_flushed { sink.flush().await } else { Ok(()) }
        });
        match written.await {
            Ok(Ok(())) => {}
            Ok(Err(error)) => return error.into(),
            Err(TooSlow(max)) => return FoxgloveError::silent(max),
        }
        if is_flushed {
            waiting_bytes = 0;
        }
        if is_ping {
            pings.asked();
        }
        if is_empty {
            outbox.filled().await;
        }
    }
}
