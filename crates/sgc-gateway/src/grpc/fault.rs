//! [`Fault`]: why a call fails, and by which status of gRPC that is told.

use tonic::{Code, Status};

use crate::access::Denied;
use crate::error::{ErrorKind, GatewayError};

/// Why a call fails.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
pub enum Fault {
    /// Who calls is not admitted, or no more.
    #[error("{}", .0.told())]
    Denied(Denied),
    /// Metadata that are no text of that form.
    #[error("`authorization` is not of the form `Bearer TOKEN`")]
    Authorization,
    /// An `origin` that no browser sends.
    #[error("`origin` has {max} bytes at most")]
    Origin {
        /// The bound.
        max: usize,
    },
    /// Too many credentials are in use on one connection.
    #[error("{max} credentials at most are used on one connection at a time")]
    Credentials {
        /// The bound.
        max: usize,
    },
    /// A stream that begins with something else, or goes on with a second beginning.
    #[error("the first request of this stream, and no other, names {what}")]
    Order {
        /// What is named.
        what: &'static str,
    },
    /// A number of an enumeration that this gateway does not know.
    #[error("{number} is no {what} that this gateway knows")]
    Enumeration {
        /// Of which.
        what: &'static str,
        /// What was said.
        number: i32,
    },
    /// Contradicts itself.
    #[error("a quality of service either keeps all or has a depth")]
    KeepAllWithDepth,
    /// More may not wait.
    #[error("a depth of {depth}: at most {max} messages may wait")]
    Depth {
        /// What was said.
        depth: u32,
        /// The bound.
        max: u32,
    },
    /// No rate.
    #[error("{rate} is no rate: write how many messages a second at most, from {min} on, or 0 for all")]
    Rate {
        /// What was said.
        rate: f64,
        /// The least.
        min: f64,
    },
    /// A call is answered that is not open.
    #[error("call {id} is not open: it was answered, or is too old")]
    NotOpen {
        /// What was said.
        id: u64,
    },
    /// Not the id of a goal.
    #[error("an id of a goal has 16 bytes, not {bytes}")]
    GoalId {
        /// What was said.
        bytes: usize,
    },
    /// Which message of a stream it was.
    #[error("message {number} of this stream: {error}")]
    Message {
        /// The first is 1.
        number: u64,
        /// What is wrong with it.
        error: Box<GatewayError>,
    },
    /// The hub refuses.
    #[error(transparent)]
    Gateway(Box<GatewayError>),
    /// What serves these requests does not say where they come from.
    #[error("the gateway does not know where this call comes from")]
    NoConnection,
    /// The committed descriptor cannot be read.
    #[error("the description of the protocol: {0}")]
    Descriptor(String),
    /// HTTP/2 cannot be served.
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
