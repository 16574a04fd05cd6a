//! [`RosbridgeOptions`]: the bounds of a connection and the authentication of its client; [`RosbridgeError`]: the
//! reason for its end.

use std::fmt;
use std::sync::Arc;
use std::time::Duration;

use sgc_websocket::WebSocketError;

use crate::access::{Client, Denial};
use crate::error::GatewayError;

/// Longest message of a client, in bytes, in one frame or in fragments.
pub const ROSBRIDGE_MESSAGE_BYTES_MAX: usize = 64 << 20;
/// Time for which a client may leave a ping unanswered or a frame unread.
pub const ROSBRIDGE_SILENCE_MAX: Duration = Duration::from_secs(60);
/// Time to wait for a reply if the client gives no time.
pub const ROSBRIDGE_CALL_MAX: Duration = Duration::from_secs(60);
/// Time within which a client must authenticate, if it must.
pub const ROSBRIDGE_ADMISSION_MAX: Duration = Duration::from_secs(10);

/// A function that returns the client of a token, or the reason why the token is invalid, in words for its user.
pub type Authenticate = Arc<dyn Fn(&str) -> Result<Client, String> + Send + Sync>;

/// The bounds of a connection and the authentication of its client.
#[derive(Clone)]
pub struct RosbridgeOptions {
    /// Longest message of a client, in bytes. The WebSocket must have the same bound, so that it holds from the first
    /// byte.
    pub message_bytes_max: usize,
    /// Time for which a client may leave a ping unanswered or a frame unread. Pings are sent four times as often.
    pub silence_max: Duration,
    /// Time to wait for a reply if the client gives no time.
    pub call_max: Duration,
    /// The check for the op `auth`; without one the op is refused.
    pub authenticate: Option<Authenticate>,
    /// `true` if only `auth` is accepted until a token was shown. The initial session is not used then.
    pub is_token_needed: bool,
    /// The answer to `/rosapi/get_ros_version`.
    pub ros_distro: String,
}

impl Default for RosbridgeOptions {
    fn default() -> Self {
        Self {
            message_bytes_max: ROSBRIDGE_MESSAGE_BYTES_MAX,
            silence_max: ROSBRIDGE_SILENCE_MAX,
            call_max: ROSBRIDGE_CALL_MAX,
            authenticate: None,
            is_token_needed: false,
            ros_distro: "unknown".to_owned(),
        }
    }
}

impl fmt::Debug for RosbridgeOptions {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_struct("RosbridgeOptions")
            .field("message_bytes_max", &self.message_bytes_max)
            .field("silence_max", &self.silence_max)
            .field("is_token_needed", &self.is_token_needed)
            .finish_non_exhaustive()
    }
}

/// The reason why a connection ended without the client's wish.
#[derive(Debug, thiserror::Error)]
pub enum RosbridgeError {
    /// The socket failed, or the client sent something that is not a WebSocket message.
    #[error("the WebSocket failed")]
    Socket(#[source] WebSocketError),
    /// A message is too long.
    #[error("the client sent a message of more than {max} bytes")]
    TooLong {
        /// The longest accepted length in bytes.
        max: usize,
    },
    /// A ping was not answered, or a frame was not read, in time.
    #[error("the client was silent for {} s", .0.as_secs_f32())]
    Silent(Duration),
    /// The client made too many errors.
    #[error("the client did wrong too often")]
    TooManyErrors,
    /// The client did not authenticate, or not in time.
    #[error("the client was not admitted: {0}")]
    NotAdmitted(String),
    /// The new credential has no room for what the session holds.
    #[error("the client's new credential has no room for what it has")]
    NoRoom(#[source] GatewayError),
    /// The client's rights ended.
    #[error("the client's right has ended: {0}")]
    Denied(#[source] Denial),
}

impl RosbridgeError {
    /// Returns the close code (RFC 6455, 7.4.1) and the text for the client, or `None` if it would not hear them.
    pub(super) fn close(&self) -> Option<(u16, String)> {
        Some(match self {
            Self::Socket(error) => (error.close_code()?, error.to_string()),
            Self::Silent(_) => return None,
            Self::TooLong { max } => (1009, format!("messages of {max} bytes at most")),
            Self::TooManyErrors => (1008, "too many errors".to_owned()),
            Self::NotAdmitted(why) => (1008, why.clone()),
            Self::NoRoom(why) => (1013, why.to_string()),
            Self::Denied(why) => (1008, why.client_message().to_owned()),
        })
    }

    pub(super) fn socket(error: WebSocketError) -> Self {
        match error {
            WebSocketError::TooLong { max } => Self::TooLong { max },
            error => Self::Socket(error),
        }
    }
}
