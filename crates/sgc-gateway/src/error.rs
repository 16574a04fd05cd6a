//! [`GatewayError`]: the reason why a client's request fails, in words for its user.

use sgc_cdr::{DecodeError, TypeError, ValueError};
use sgc_ros::RosError;

use crate::access::Right;
use crate::pool::Pool;

/// The reason why a request fails.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
pub enum GatewayError {
    /// The name is not a valid ROS 2 name.
    #[error("{name:?} is no name of a topic, service or action: write an absolute one, such as /arm/state")]
    Name {
        /// The given name.
        name: String,
    },
    /// The name is not a type of this kind of interface.
    #[error("{name:?} is no type of a {what}: write one such as {example}")]
    TypeName {
        /// The given name.
        name: String,
        /// The kind of interface.
        what: &'static str,
        /// A valid example.
        example: &'static str,
    },
    /// The type is not given and not known.
    #[error("the type of {name} is not known, since nobody has it yet; give its type")]
    TypeUnknown {
        /// The topic, service or action.
        name: String,
    },
    /// The interface exists with another type.
    #[error("{name} is of type {actual}, not {wanted}")]
    OtherType {
        /// The topic, service or action.
        name: String,
        /// The type on the network.
        actual: String,
        /// The given type.
        wanted: String,
    },
    /// The client's scope does not include the right.
    #[error("{client} may not {} {name}: its scope does not have it", word(*right))]
    Denied {
        /// The client.
        client: String,
        /// The missing right.
        right: Right,
        /// The interface.
        name: String,
    },
    /// The client authenticated as another one after the request.
    #[error("you are {client} now, who may other things: ask again")]
    OtherClient {
        /// The current client.
        client: String,
    },
    /// The type definition is missing or invalid.
    #[error("no definition: {0}; name a directory that has it with `definitions` in [ros]")]
    Definition(TypeError),
    /// The client's message does not have the type.
    #[error("not a message of that type: {0}")]
    Value(ValueError),
    /// A message from the network does not have its type.
    #[error("a message is not what its type says: {0}")]
    Decode(DecodeError),
    /// A message is too long.
    #[error("a message of {bytes} bytes: at most {max}")]
    TooLong {
        /// The length in bytes.
        bytes: usize,
        /// The longest accepted length in bytes.
        max: usize,
    },
    /// The client has reached a bound.
    #[error("{max} {what} at most for a client")]
    TooMany {
        /// The bounded resource.
        what: &'static str,
        /// The bound.
        max: usize,
    },
    /// Clients that share a bound have reached it.
    #[error("{max} {what} at most for {pool}")]
    Crowded {
        /// The bounded resource.
        what: &'static str,
        /// The bound.
        max: usize,
        /// The clients that share the bound.
        pool: Pool,
    },
    /// No interface in the client's view has the type. The error does not reveal whether the type exists.
    #[error("nothing that this client may use has type {name}")]
    TypeNotSeen {
        /// The type.
        name: String,
    },
    /// The client repeats a request that is in effect.
    #[error("{name} is {what} by this client already")]
    Twice {
        /// The interface.
        name: String,
        /// The state of the interface.
        what: &'static str,
    },
    /// The client ends something that it did not begin.
    #[error("{name} is not {what} by this client")]
    NotThere {
        /// The interface.
        name: String,
        /// The state that the interface lacks.
        what: &'static str,
    },
    /// The service or action has no server.
    #[error("nobody serves {name}")]
    NoServer {
        /// The service or action.
        name: String,
    },
    /// No answer came in time.
    #[error("no answer of {name} within {waited_ms} ms")]
    Timeout {
        /// The service or action.
        name: String,
        /// The time waited.
        waited_ms: u64,
    },
    /// The local network was closed before the answer came.
    #[error(
        "the local ROS 2 network was opened again before {name} answered, because this host's addresses changed: \
         the call may have been carried out"
    )]
    CutOff {
        /// The service or action.
        name: String,
    },
    /// The server rejected the goal.
    #[error("the server of {name} rejected the goal")]
    GoalRejected {
        /// The action.
        name: String,
    },
    /// The local network failed.
    #[error(transparent)]
    Ros(#[from] RosError),
    /// The gateway is stopping.
    #[error("the gateway is stopping")]
    Stopping,
}

/// The kind of an error, which protocols map to their codes.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum ErrorKind {
    /// The request is invalid.
    Invalid,
    /// The interface does not exist.
    NotFound,
    /// The client has it already.
    Exists,
    /// The client lacks the right.
    Denied,
    /// A bound is reached.
    Exhausted,
    /// The server refused.
    Refused,
    /// No server or no gateway is available.
    Unavailable,
    /// The request timed out.
    Timeout,
    /// The network or the gateway failed.
    Internal,
}

impl GatewayError {
    /// Returns the kind of the error.
    pub fn kind(&self) -> ErrorKind {
        match self {
            Self::Name { .. } | Self::TypeName { .. } | Self::OtherType { .. } | Self::Value(_) => {
                ErrorKind::Invalid
            }
            Self::TypeUnknown { .. }
            | Self::TypeNotSeen { .. }
            | Self::Definition(_)
            | Self::NotThere { .. } => ErrorKind::NotFound,
            Self::Denied { .. } | Self::OtherClient { .. } => ErrorKind::Denied,
            Self::TooLong { .. } | Self::TooMany { .. } | Self::Crowded { .. } => ErrorKind::Exhausted,
            Self::Twice { .. } => ErrorKind::Exists,
            Self::NoServer { .. } | Self::CutOff { .. } | Self::Stopping | Self::Ros(RosError::Closed) => {
                ErrorKind::Unavailable
            }
            Self::GoalRejected { .. } => ErrorKind::Refused,
            Self::Timeout { .. } => ErrorKind::Timeout,
            Self::Decode(_) | Self::Ros(_) => ErrorKind::Internal,
        }
    }
}

fn word(right: Right) -> &'static str {
    match right {
        Right::Subscribe => "subscribe to",
        Right::Publish => "publish",
        Right::Call => "call",
        Right::Serve => "serve",
    }
}
