//! Foxglove's WebSocket protocol: Foxglove and Lichtblick show a robot, publish, call services and set parameters.
//!
//! [`serve`] is one client's connection, from the first message on: what leads to it, the upgrade, TLS and who is let in,
//! is for `server`. The protocol is spoken here rather than by the crate `foxglove`, which has a listener and a hub of
//! its own: neither a scope for each client nor bounds in bytes can be put into it, and schemas and MCAP come with it.
//!
//! A connection is one task. It holds nothing that grows with what a client does not take: answers bound what is read,
//! and messages give way, which the client is told ([`SessionLimits::waiting_bytes_max`](crate::SessionLimits)).
//!
//! `foxglove.sdk.v1` and `foxglove.websocket.v1` are the same on the wire but for the name: the former adds control of
//! playback, which is an offer of servers that play recordings.

mod connection;
mod connections;
mod listing;
mod outbox;
mod parameters;
mod protocol;
mod refusal;

use std::sync::Arc;
use std::time::{Duration, SystemTime, UNIX_EPOCH};

use futures_util::{Sink, SinkExt, StreamExt};
use tokio::io::{AsyncRead, AsyncWrite};
use tokio_tungstenite::WebSocketStream;
use tokio_tungstenite::tungstenite::Error as SocketError;
use tokio_tungstenite::tungstenite::Message as Frame;
use tokio_tungstenite::tungstenite::protocol::CloseFrame;
use tokio_tungstenite::tungstenite::protocol::frame::coding::CloseCode;

use crate::access::Denied;
use crate::quota::Waiting;
use crate::session::Session;
use crate::ws::close_reason;

use connection::Connection;
use outbox::Outbox;

/// WebSocket subprotocols that are this protocol, the one to prefer first.
pub const SUBPROTOCOLS: [&str; 2] = ["foxglove.sdk.v1", "foxglove.websocket.v1"];

/// How long a client has for what waits for it when the connection ends.
const FAREWELL_MAX: Duration = Duration::from_secs(1);

/// What connections are to be.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Options {
    /// What the server is called; shown beside its address.
    pub name: String,
    /// ROS 2 distribution that clients are told of: by it Studio knows that this is ROS 2, and the common types.
    pub ros_distro: String,
    /// By this a client knows again that it came back to the same server.
    pub session_id: String,
    /// Whether topics and services with a name that begins with `_` are shown, those of actions among them.
    pub shows_hidden: bool,
    /// How long a service may take for its reply.
    pub call_max: Duration,
    /// How often a client is asked whether it is there.
    pub ping_interval: Duration,
    /// How long nothing may come from a client.
    pub silence_max: Duration,
}

impl Default for Options {
    fn default() -> Self {
        let since = SystemTime::now().duration_since(UNIX_EPOCH).unwrap_or_default();
        Self {
            name: "sgc".to_owned(),
            ros_distro: "jazzy".to_owned(),
            session_id: since.as_nanos().to_string(),
            shows_hidden: false,
            call_max: Duration::from_secs(60),
            ping_interval: Duration::from_secs(15),
            silence_max: Duration::from_secs(60),
        }
    }
}

/// Why a connection ended that the client did not end.
#[derive(Debug, thiserror::Error)]
pub enum FoxgloveError {
    /// The WebSocket failed, or what came was none.
    #[error("the connection failed: {0}")]
    Socket(#[from] SocketError),
    /// The client neither sends nor takes anything.
    #[error("nothing came from the client for {silence_ms} ms")]
    Silent {
        /// For how long.
        silence_ms: u64,
    },
    /// The client's right has ended.
    #[error("the client's right has ended: {0}")]
    Denied(#[source] Denied),
}

/// Serves a client until it leaves. To end it earlier, drop the future: what the client had ends with it.
///
/// # Errors
/// If the connection fails or the client falls silent; that the client went is none.
pub async fn serve<S>(
    socket: WebSocketStream<S>,
    session: Arc<Session>,
    options: Options,
) -> Result<(), FoxgloveError>
where
    S: AsyncRead + AsyncWrite + Unpin + Send,
{
    let (mut sink, mut frames) = socket.split();
    let waiting = Waiting::new(session.limits().waiting_bytes_max, session.quota().clone());
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
            let reason = CloseFrame { code: CloseCode::Policy, reason: close_reason(denied.told()).into() };
            return sink.send(Frame::Close(Some(reason))).await;
        }
        while let Some(answer) = outbox.pop_answer() {
            sink.feed(answer).await?;
        }
        sink.send(Frame::Close(None)).await
    };
    let _ = tokio::time::timeout(FAREWELL_MAX, farewell).await;
    match ended {
        Err(FoxgloveError::Socket(SocketError::ConnectionClosed | SocketError::AlreadyClosed)) => Ok(()),
        ended => ended,
    }
}

/// Writes what waits, for as long as that can be.
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
