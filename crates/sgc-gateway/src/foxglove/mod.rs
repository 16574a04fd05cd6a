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
use sgc_websocket::{CloseFrame, Message as Frame, WebSocket, WebSocketError as SocketError};
use tokio::io::{AsyncRead, AsyncWrite};

use crate::quota::PendingBytes;
use crate::session::Session;
use crate::ws::close_reason;

use connection::Connection;
pub use options::{FoxgloveError, Options};
use outbox::Outbox;

/// WebSocket subprotocols of this protocol, the preferred one first.
pub const SUBPROTOCOLS: [&str; 2] = ["foxglove.sdk.v1", "foxglove.websocket.v1"];

/// Time in which queued answers may be written when the connection ends.
const FAREWELL_MAX: Duration = Duration::from_secs(1);

/// The close code for a client whose rights end (RFC 6455, 7.4.1).
const POLICY: u16 = 1008;

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
    let outbox = Outbox::new(waiting);
    let mut connection = Connection::new(Arc::clone(&session), options, &outbox);
    let ended = tokio::select! {
        biased;
        denied = session.until_denied() => Err(FoxgloveError::Denied(denied)),
        ended = connection.run(&mut frames) => ended,
        failed = write(&mut sink, &outbox) => Err(FoxgloveError::Socket(failed)),
    };
    drop(connection);
    let farewell = async {
        if let Err(FoxgloveError::Denied(denied)) = &ended {
            let reason =
                CloseFrame { code: POLICY, reason: close_reason(denied.client_message()).to_owned() };
            return sink.send(Frame::Close(Some(reason))).await;
        }
        while let Some(answer) = outbox.pop_answer() {
            sink.feed(answer).await?;
        }
        sink.send(Frame::Close(None)).await
    };
    let _ = tokio::time::timeout(FAREWELL_MAX, farewell).await;
    match ended {
        Err(FoxgloveError::Socket(SocketError::Closed)) => Ok(()),
        ended => ended,
    }
}

/// Writes queued frames until the socket fails.
async fn write<K>(sink: &mut K, outbox: &Outbox) -> SocketError
where
    K: Sink<Frame, Error = SocketError> + Unpin,
{
    loop {
        let written = match outbox.pop() {
            Some(frame) => sink.feed(frame).await,
            None => {
                let flushed = sink.flush().await;
                outbox.filled().await;
                flushed
            }
        };
        if let Err(error) = written {
            return error;
        }
    }
}
