//! [`RosbridgeOptions`]: bounds of a connection and how clients say who they are; [`RosbridgeError`]: why one ended.

use std::fmt;
use std::sync::Arc;
use std::time::Duration;

use tokio_tungstenite::tungstenite;
use tokio_tungstenite::tungstenite::protocol::WebSocketConfig;

use crate::access::{Client, Denied};
use crate::error::GatewayError;

/// Longest message that a client may send, bytes, in one frame or in fragments.
pub const ROSBRIDGE_MESSAGE_BYTES_MAX: usize = 64 << 20;
/// How long a client may leave a ping without an answer, or a frame untaken.
pub const ROSBRIDGE_SILENCE_MAX: Duration = Duration::from_secs(60);
/// How long a call waits for its reply if the client says no time.
pub const ROSBRIDGE_CALL_MAX: Duration = Duration::from_secs(60);
/// How long a client has to say who it is, where it has to.
pub const ROSBRIDGE_ADMISSION_MAX: Duration = Duration::from_secs(10);

/// Says who a token is for; else why it is nobody's, in words for its user.
pub type Authenticate = Arc<dyn Fn(&str) -> Result<Client, String> + Send + Sync>;

/// Bounds of a connection, and how its client says who it is.
#[derive(Clone)]
pub struct RosbridgeOptions {
    /// Longest message that a client may send, bytes.
    pub message_bytes_max: usize,
    /// How long a client may leave a ping without an answer, or a frame untaken. It is pinged four times as often.
    pub silence_max: Duration,
    /// How long a call waits for its reply if the client says no time.
    pub call_max: Duration,
    /// What the op `auth` asks; none: it is refused.
    pub authenticate: Option<Authenticate>,
    /// Whether nothing but `auth` is taken until a token was shown. The session that it came with is not used then.
    pub is_token_needed: bool,
    /// What `/rosapi/get_ros_version` says.
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

impl RosbridgeOptions {
    /// What the WebSocket is to be accepted with: longer frames are refused by their heads, before they are there.
    pub fn websocket(&self) -> WebSocketConfig {
        WebSocketConfig::default()
            .max_message_size(Some(self.message_bytes_max))
            .max_frame_size(Some(self.message_bytes_max))
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

/// Why a connection ended, other than by its client's wish.
#[derive(Debug, thiserror::Error)]
pub enum RosbridgeError {
    /// The client sent what is no WebSocket, or the way to it broke.
    #[error("the WebSocket failed")]
    Socket(#[source] Box<tungstenite::Error>),
    /// A message is longer than what is taken.
    #[error("the client sent a message of more than {max} bytes")]
    TooLong {
        /// What is taken.
        max: usize,
    },
    /// No ping was answered, or no frame was taken.
    #[error("the client was silent for {} s", .0.as_secs_f32())]
    Silent(Duration),
    /// It did wrong too often.
    #[error("the client did wrong too often")]
    TooManyErrors,
    /// It has not said who it is, not in time or not rightly.
    #[error("the client was not admitted: {0}")]
    NotAdmitted(String),
    /// The credential that it showed in the session has no room for what the session has.
    #[error("the client's new credential has no room for what it has")]
    NoRoom(#[source] GatewayError),
    /// Its right has ended.
    #[error("the client's right has ended: {0}")]
    Denied(#[source] Denied),
}

impl RosbridgeError {
    /// How the client is told: a close code of RFC 6455, 7.4.1, and words.
    pub(super) fn close(&self) -> Option<(u16, String)> {
        Some(match self {
            Self::Socket(_) | Self::Silent(_) => return None,
            Self::TooLong { max } => (1009, format!("messages of {max} bytes at most")),
            Self::TooManyErrors => (1008, "too many errors".to_owned()),
            Self::NotAdmitted(why) => (1008, why.clone()),
            Self::NoRoom(why) => (1013, why.to_string()),
            Self::Denied(why) => (1008, why.told().to_owned()),
        })
    }

    pub(super) fn socket(error: tungstenite::Error, max: usize) -> Self {
        match error {
            tungstenite::Error::Capacity(_) => Self::TooLong { max },
            error => Self::Socket(Box::new(error)),
        }
    }
}
