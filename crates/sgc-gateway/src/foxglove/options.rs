//! [`Options`]: the bounds of a connection; [`FoxgloveError`]: the reason for its end.

use std::time::{Duration, SystemTime, UNIX_EPOCH};

use sgc_websocket::WebSocketError as SocketError;

use crate::access::Denial;

/// The options of connections.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Options {
    /// The name of the server, shown beside its address.
    pub name: String,
    /// The ROS 2 distribution that clients are told. Foxglove learns from it that this is ROS 2, and which common
    /// types exist.
    pub ros_distro: String,
    /// An id by which a client recognises the same server after it reconnects.
    pub session_id: String,
    /// `true` if topics and services whose name has a part that begins with `_` are shown, such as those of actions.
    pub shows_hidden: bool,
    /// Time within which a service must reply.
    pub call_max: Duration,
    /// Interval of pings to the client.
    pub ping_interval: Duration,
    /// Time for which a client may leave a ping unanswered or a frame unread.
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

/// The reason why a connection ended without the client's wish.
#[derive(Debug, thiserror::Error)]
pub enum FoxgloveError {
    /// The WebSocket failed, or the data was not a WebSocket message.
    #[error("the connection failed: {0}")]
    Socket(#[from] SocketError),
    /// A ping was not answered, or a frame was not read, in time.
    #[error("the client was silent for {silence_ms} ms")]
    Silent {
        /// The duration of the silence.
        silence_ms: u64,
    },
    /// The client's rights ended.
    #[error("the client's right has ended: {0}")]
    Denied(#[source] Denial),
}

impl FoxgloveError {
    pub(super) fn silent(silence: Duration) -> Self {
        Self::Silent { silence_ms: u64::try_from(silence.as_millis()).unwrap_or(u64::MAX) }
    }

    /// Returns the close code (RFC 6455, 7.4.1) and the text for the client, or `None` if there is nothing to say.
    pub(super) fn close(&self) -> Option<(u16, String)> {
        match self {
            Self::Socket(error) => Some((error.close_code()?, error.to_string())),
            Self::Silent { .. } => None,
            Self::Denied(denied) => Some((1008, denied.client_message().to_owned())),
        }
    }
}
