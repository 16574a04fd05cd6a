//! [`Fault`]: the reason why a call fails, with its gRPC status.

use tonic::{Code, Status};

use crate::access::Denial;
use crate::error::{ErrorKind, GatewayError};

/// The reason why a call fails.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
pub enum Fault {
    /// The client is not admitted, or no longer.
    #[error("{}", .0.client_message())]
    Denied(Denial),
    /// The `authorization` header is malformed.
    #[error("`authorization` is not of the form `Bearer TOKEN`")]
    Authorization,
    /// The `origin` is longer than any browser sends.
    #[error("`origin` has {max} bytes at most")]
    Origin {
        /// The bound in bytes.
        max: usize,
    },
    /// Too many credentials are in use on one connection.
    #[error("{max} credentials at most are used on one connection at a time")]
    Credentials {
        /// The bound.
        max: usize,
    },
    /// The stream begins with the wrong request, or repeats its first request.
    #[error("the first request of this stream, and no other, names {what}")]
    Order {
        /// The subject of the first request.
        what: &'static str,
    },
    /// The number is not one of the enumeration.
    #[error("{number} is no {what} that this gateway knows")]
    Enumeration {
        /// The enumeration.
        what: &'static str,
        /// The given number.
        number: i32,
    },
    /// A QoS has both `keep_all` and a depth.
    #[error("a quality of service either keeps all or has a depth")]
    KeepAllWithDepth,
    /// The depth exceeds the bound.
    #[error("a depth of {depth}: at most {max} messages may wait")]
    Depth {
        /// The given depth.
        depth: u32,
        /// The bound.
        max: u32,
    },
    /// The rate is invalid.
    #[error("{rate} is no rate: write how many messages a second at most, from {min} on, or 0 for all")]
    Rate {
        /// The given rate.
        rate: f64,
        /// The lowest rate.
        min: f64,
    },
    /// The answered call is not open.
    #[error("call {id} is not open: it was answered, or is too old")]
    NotOpen {
        /// The given id.
        id: u64,
    },
    /// The length of a goal id is wrong.
    #[error("an id of a goal has 16 bytes, not {bytes}")]
    GoalId {
        /// The given length in bytes.
        bytes: usize,
    },
    /// A message of a stream failed.
    #[error("message {number} of this stream: {error}")]
    Message {
        /// The number of the message, from 1.
        number: u64,
        /// The error.
        error: Box<GatewayError>,
    },
    /// The hub refuses the call.
    #[error(transparent)]
    Gateway(Box<GatewayError>),
    /// The server lacks the [`Connection`](super::Connection) of a request.
    #[error("the gateway does not know where this call comes from")]
    NoConnection,
    /// The embedded descriptor is invalid.
    #[error("the description of the protocol: {0}")]
    Descriptor(String),
    /// HTTP/2 failed.
    #[error("HTTP/2: {0}")]
    Transport(String),
}

impl Fault {
    fn code(&self) -> Code {
        match self {
            Self::Denied(_) | Self::Authorization | Self::Origin { .. } => Code::Unauthenticated,
            Self::Credentials { .. } => Code::ResourceExhausted,
            Self::Order { .. }
            | Self::Enumeration { .. }
            | Self::KeepAllWithDepth
            | Self::Depth { .. }
            | Self::GoalId { .. }
            | Self::Rate { .. } => Code::InvalidArgument,
            Self::NotOpen { .. } => Code::NotFound,
            Self::Message { error, .. } | Self::Gateway(error) => match error.kind() {
                ErrorKind::Invalid => Code::InvalidArgument,
                ErrorKind::NotFound => Code::NotFound,
                ErrorKind::Exists => Code::AlreadyExists,
                ErrorKind::Denied => Code::PermissionDenied,
                ErrorKind::Exhausted => Code::ResourceExhausted,
                ErrorKind::Refused => Code::FailedPrecondition,
                ErrorKind::Unavailable => Code::Unavailable,
                ErrorKind::Timeout => Code::DeadlineExceeded,
                ErrorKind::Internal => Code::Internal,
            },
            Self::NoConnection | Self::Descriptor(_) | Self::Transport(_) => Code::Internal,
        }
    }
}

impl From<GatewayError> for Fault {
    fn from(error: GatewayError) -> Self {
        Self::Gateway(Box::new(error))
    }
}

impl From<Fault> for Status {
    fn from(fault: Fault) -> Self {
        Self::new(fault.code(), fault.to_string())
    }
}
