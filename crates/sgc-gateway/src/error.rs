//! [`GatewayError`]: why a client does not get what it asks for, in words for its user.

use sgc_cdr::{DecodeError, TypeError, ValueError};
use sgc_ros::RosError;

use crate::access::Right;
use crate::quota::Pool;

/// Why a client does not get what it asks for.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
pub enum GatewayError {
    /// No name of ROS 2.
    #[error("{name:?} is no name of a topic, service or action: write an absolute one, such as /arm/state")]
    Name {
        /// What was said.
        name: String,
    },
    /// No type of ROS 2, or of the wrong kind.
    #[error("{name:?} is no type of a {what}: write one such as {example}")]
    TypeName {
        /// What was said.
        name: String,
        /// What it was to be of.
        what: &'static str,
        /// One that is right.
        example: &'static str,
    },
    /// Nobody has said what type it is.
    #[error("the type of {name} is not known, since nobody has it yet: say it")]
    TypeUnknown {
        /// The topic, service or action.
        name: String,
    },
    /// It is there with another type.
    #[error("{name} is of type {actual}, not {wanted}")]
    OtherType {
        /// The topic, service or action.
        name: String,
        /// What the network has.
        actual: String,
        /// What was said.
        wanted: String,
    },
    /// The scope does not have it.
    #[error("{client} may not {} {name}: its scope does not have it", word(*right))]
    Denied {
        /// Who.
        client: String,
        /// What.
        right: Right,
        /// With what.
        name: String,
    },
    /// It was asked for by who the client was then.
    #[error("you are {client} now, who may other things: ask again")]
    OtherClient {
        /// Who the client is now.
        client: String,
    },
    /// The definition is not found, or not right.
    #[error("no definition: {0}; name a directory that has it with `definitions` in [ros]")]
    Definition(TypeError),
    /// What the client sent is no such message.
    #[error("not a message of that type: {0}")]
    Value(ValueError),
    /// What came is not what its type says.
    #[error("a message is not what its type says: {0}")]
    Decode(DecodeError),
    /// A payload of the wrong kind or length.
    #[error("a message of {bytes} bytes: at most {max}")]
    TooLong {
        /// Its length.
        bytes: usize,
        /// What is taken.
        max: usize,
    },
    /// A client wants more than one is given.
    #[error("{max} {what} at most for a client")]
    TooMany {
        /// Of what.
        what: &'static str,
        /// The bound.
        max: usize,
    },
    /// Clients that share a bound have reached it.
    #[error("{max} {what} at most for {pool}")]
    Crowded {
        /// Of what.
        what: &'static str,
        /// The bound.
        max: usize,
        /// Whose it is.
        pool: Pool,
    },
    /// Nothing in the client's view of the graph has the type, whether there is such a type or not.
    #[error("nothing that this client may use has type {name}")]
    TypeNotSeen {
        /// The type.
        name: String,
    },
    /// Something is asked for twice.
    #[error("{name} is {what} by this client already")]
    Twice {
        /// With what.
        name: String,
        /// What is.
        what: &'static str,
    },
    /// Something was not asked for.
    #[error("{name} is not {what} by this client")]
    NotThere {
        /// With what.
        name: String,
        /// What is not.
        what: &'static str,
    },
    /// Nobody serves it.
    #[error("nobody serves {name}")]
    NoServer {
        /// The service or action.
        name: String,
    },
    /// Nobody answered in time.
    #[error("no answer of {name} within {waited_ms} ms")]
    Timeout {
        /// The service or action.
        name: String,
        /// How long was waited.
        waited_ms: u64,
    },
    /// Its server does not take a goal.
    #[error("the server of {name} rejected the goal")]
    GoalRejected {
        /// The action.
        name: String,
    },
    /// The local network refused.
    #[error(transparent)]
    Ros(#[from] RosError),
    /// The gateway is going down.
    #[error("the gateway is stopping")]
    Stopping,
}

/// What sort of refusal it is: protocols have codes for these.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum ErrorKind {
    /// What was asked for cannot be right.
    Invalid,
    /// It is not there.
    NotFound,
    /// It is there already.
    Exists,
    /// The client may not.
    Denied,
    /// The client has too much.
    Exhausted,
    /// Who was asked does not want to.
    Refused,
    /// Nobody is there to do it.
    Unavailable,
    /// It took too long.
    Timeout,
    /// The network or the gateway failed.
    Internal,
}

impl GatewayError {
    /// What sort it is.
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
            Self::NoServer { .. } | Self::Stopping => ErrorKind::Unavailable,
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
