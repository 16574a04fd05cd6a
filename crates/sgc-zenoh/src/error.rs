//! The reasons for which text or bytes are refused, or cannot be written.

use std::fmt;

/// A part of a key, a token or an attachment.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub enum Field {
    /// The key of a topic or service as a whole.
    Key,
    /// A liveliness token as a whole.
    Token,
    /// The ROS domain.
    Domain,
    /// The number of a node in its session.
    NodeId,
    /// The number of an endpoint in its session.
    EndpointId,
    /// The kind of what a token stands for.
    Kind,
    /// Namespace and name of a node.
    NodeName,
    /// The name of a topic or service.
    Name,
    /// The DDS name of a type.
    Type,
    /// The hash of a type.
    TypeHash,
    /// The buffer backends of an endpoint.
    Backends,
    /// Reliability.
    Reliability,
    /// Durability.
    Durability,
    /// The kind of history.
    History,
    /// The depth of the history.
    Depth,
    /// The deadline period.
    Deadline,
    /// The lifespan.
    Lifespan,
    /// The kind of liveliness.
    Liveliness,
    /// The lease of the liveliness.
    Lease,
}

impl fmt::Display for Field {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(match self {
            Self::Key => "key",
            Self::Token => "liveliness token",
            Self::Domain => "domain",
            Self::NodeId => "id of a node",
            Self::EndpointId => "id of an endpoint",
            Self::Kind => "kind",
            Self::NodeName => "name of a node",
            Self::Name => "name of a topic or service",
            Self::Type => "type",
            Self::TypeHash => "type hash",
            Self::Backends => "list of backends",
            Self::Reliability => "reliability",
            Self::Durability => "durability",
            Self::History => "history",
            Self::Depth => "depth",
            Self::Deadline => "deadline",
            Self::Lifespan => "lifespan",
            Self::Liveliness => "liveliness",
            Self::Lease => "lease",
        })
    }
}

/// The reason why a key, token or attachment is refused, or cannot be written. It holds nothing of unbounded length.
#[derive(Clone, Copy, Debug, PartialEq, Eq, thiserror::Error)]
pub enum CodecError {
    /// A text is longer than its bound.
    #[error("the {field} has {bytes} bytes, more than {bytes_max}")]
    TooLong {
        /// The text.
        field: Field,
        /// Its length in bytes.
        bytes: usize,
        /// The bound in bytes.
        bytes_max: usize,
    },
    /// A text, or a chunk of it, is empty.
    #[error("the {field} is empty or has an empty chunk")]
    Empty {
        /// The text.
        field: Field,
    },
    /// A text has a character that means something else there, or a control character.
    #[error("the {field} has the character {character:?}")]
    Reserved {
        /// The text.
        field: Field,
        /// The first such character.
        character: char,
    },
    /// A text has too few chunks.
    #[error("the {field} has {found} chunks, fewer than {chunks_min}")]
    Chunks {
        /// The text.
        field: Field,
        /// Its number of chunks.
        found: usize,
        /// The number that it needs.
        chunks_min: usize,
    },
    /// A text that should be a liveliness token is in another place of the key space.
    #[error("no liveliness token of rmw_zenoh")]
    NoToken,
    /// A field is no decimal number, or too large a one.
    #[error("the {field} is no number, or too large")]
    Number {
        /// The field.
        field: Field,
    },
    /// A field has a value without a meaning.
    #[error("the {field} has a value that rmw_zenoh does not know")]
    Unknown {
        /// The field.
        field: Field,
    },
    /// The id of a session is not what Zenoh writes.
    #[error("no id of a Zenoh session")]
    ZenohId,
    /// ROS accepts no such name. It is refused for the node of a token of a node, and for all that is written.
    #[error("ROS 2 accepts no such {field}")]
    RosName {
        /// [`Field::NodeName`] or [`Field::Name`].
        field: Field,
    },
    /// The endpoint has no type hash, without which it has no key.
    #[error("the hash of its type is not known")]
    NoTypeHash,
    /// The depth of a history is not known ([`History::UNSAID`](sgc_wire::History::UNSAID)); a token says it always.
    #[error("the depth of its history is not known")]
    NoDepth,
    /// An attachment is in the form of rmw_zenoh for Jazzy before 0.2.4 of April 2025.
    #[error("an attachment of a rmw_zenoh that is too old: update it to 0.2.4 (Jazzy) or later")]
    OldAttachment,
    /// An attachment has another length.
    #[error("an attachment of {bytes} bytes")]
    AttachmentLength {
        /// Its length in bytes.
        bytes: usize,
    },
    /// An attachment has an id of another length.
    #[error("an attachment whose id has {bytes} bytes")]
    GidLength {
        /// The length that it states, in bytes.
        bytes: u8,
    },
}
