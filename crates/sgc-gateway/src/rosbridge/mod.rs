//! The rosbridge protocol, version 2, as `rosbridge_suite` of ROS 2 speaks it. Its clients are roslibjs and roslibpy.
//!
//! [`serve`] serves one WebSocket. It neither listens nor admits: the socket comes accepted, with the session of its
//! client. `docs/reference/gateway-rosbridge.md` describes the supported ops.

mod actions;
mod calls;
mod connection;
mod envelope;
mod fragments;
mod input;
mod op;
mod options;
mod outbox;
mod rosapi;
mod services;
mod topics;

use std::sync::Arc;
use std::time::Duration;

use futures_util::{FutureExt as _, StreamExt as _};
use sgc_websocket::{Message, WebSocket, WebSocketError};
use tokio::io::{AsyncRead, AsyncWrite};
use tokio::sync::watch;
use tokio::time::Instant;

use crate::access::Denial;
use crate::keep_alive::PingState;
use crate::session::Session;
use crate::ws::finish;
use connection::Connection;
pub use options::{
    Authenticate, ROSBRIDGE_ADMISSION_MAX, ROSBRIDGE_CALL_MAX, ROSBRIDGE_MESSAGE_BYTES_MAX,
    ROSBRIDGE_SILENCE_MAX, RosbridgeError, RosbridgeOptions,
};
use outbox::{Outbox, ping_interval, write_all, write_rest};

/// Most messages that are read before published messages are flushed and other events are handled.
const TOGETHER_MAX: usize = 64;
/// Time in which replies that wait are written when the connection ends.
const FAREWELL_MAX: Duration = Duration::from_secs(2);

/// Serves a client until it leaves, and ends everything that it has. Dropping the future is safe at any time.
///
/// # Errors
/// The reason why the connection ended without the client's wish.
pub async fn serve<S>(
    socket: WebSocket<S>,
    session: Arc<Session>,
    options: RosbridgeOptions,
) -> Result<(), RosbridgeError>
where
    S: AsyncRead + AsyncWrite + Unpin + Send,
{
    let options = Arc::new(options);
    let (outbox, mut outgoing) = Outbox::new(session.limits().waiting_bytes_max, session.quota().clone());
    let (pings, inflow) = (PingState::default(), session.inflow());
    let (mut sink, mut stream) = socket.split();
    let mut connection = Connection::new(session, Arc::clone(&options), outbox);
    let denied = until_denied(connection.sessions());
    let ended = {
        let reading = read_all(&mut stream, &mut connection, &pings, &options);
        let writing = write_all(&mut sink, &mut outgoing, &pings, options.silence_max);
        tokio::select! {
            biased;
            denied = denied => Err(RosbridgeError::Denied(denied)),
            ended = reading => ended,
            error = writing => Err(error),
        }
    };
    drop(connection);
    let close = ended.as_ref().err().and_then(RosbridgeError::close);
    if close.is_some() {
        if matches!(ended, Err(RosbridgeError::Denied(_))) {
            outgoing.clear();
        }
        let _ = tokio::time::timeout(FAREWELL_MAX, write_rest(&mut sink, &mut outgoing)).await;
    }
    // A client that failed hears nothing. One that has left gets the answer to its close.
    if (close.is_some() || ended.is_ok())
        && let Ok(socket) = stream.reunite(sink)
    {
        let close = close.as_ref().map(|(code, why)| (*code, why.as_str()));
        finish(socket, &inflow, close).await;
    }
    ended
}

/// Waits until the current rights of the client end.
async fn until_denied(mut sessions: watch::Receiver<Arc<Session>>) -> Denial {
    loop {
        let session = Arc::clone(&sessions.borrow_and_update());
        tokio::select! {
            denied = session.until_denied() => return denied,
            changed = sessions.changed() => {
                if changed.is_err() {
                    return session.until_denied().await;
                }
            }
        }
    }
}

/// Handles the client's messages until it leaves.
async fn read_all<R>(
    stream: &mut R,
    connection: &mut Connection,
    pings: &PingState,
    options: &RosbridgeOptions,
) -> Result<(), RosbridgeError>
where
    R: futures_util::Stream<Item = Result<Message, WebSocketError>> + Unpin,
{
    let begun = Instant::now();
    let mut looks = tokio::time::interval(ping_interval(options.silence_max));
    let mut together = 0;
    loop {
        // Messages that have already arrived are published together.
        let ready = if together < TOGETHER_MAX { stream.next().now_or_never() } else { None };
        together = if ready.is_some() { together + 1 } else { 0 };
        let message = match ready {
            Some(message) => message,
            None => {
                connection.flush().await?;
                tokio::select! {
                    message = stream.next() => message,
                    _ = looks.tick() => {
                        if pings.silence(options.silence_max, begun).is_some() {
                            return Err(RosbridgeError::Silent(options.silence_max));
                        }
                        continue;
                    }
                    () = sleep_until(connection.fragments_end()) => {
                        connection.give_up_fragments().await?;
                        continue;
                    }
                    () = tokio::time::sleep_until(begun + ROSBRIDGE_ADMISSION_MAX), if !connection.is_admitted() => {
                        return Err(RosbridgeError::NotAdmitted("no token was shown in time".to_owned()));
                    }
                }
            }
        };
        let Some(message) = message else { return Ok(()) };
        pings.heard();
        match message.map_err(RosbridgeError::socket)? {
            Message::Text(text) => connection.take(&text).await?,
            // JSON may also come as bytes, as in `rosbridge_suite`.
            Message::Binary(bytes) => match std::str::from_utf8(&bytes) {
                Ok(text) => connection.take(text).await?,
                // Bytes that are not UTF-8 are not JSON, and the error says so.
                Err(_) => connection.take("\u{fffd}").await?,
            },
            Message::Close(_) => return Ok(()),
            Message::Ping(_) | Message::Pong(_) => {}
        }
    }
}

/// Waits until a time, or forever without one.
async fn sleep_until(end: Option<Instant>) {
    match end {
        Some(end) => tokio::time::sleep_until(end).await,
        None => std::future::pending().await,
    }
}
