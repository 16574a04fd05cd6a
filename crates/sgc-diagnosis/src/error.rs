//! The errors of questions to nodes.

use std::path::PathBuf;

/// A node that cannot be asked, or an answer that cannot be used.
#[derive(Debug, thiserror::Error)]
pub enum DiagnosisError {
    /// No node answers at a status socket.
    #[error("no node runs at {}: {reason}", path.display())]
    NoNode {
        /// The socket.
        path: PathBuf,
        /// The system's error.
        reason: String,
    },
    /// An answer from a status socket that is no status.
    #[error("what answers at {} is not a node's status: {reason}", path.display())]
    NotAStatus {
        /// The socket.
        path: PathBuf,
        /// The parser's error.
        reason: String,
    },
    /// A running node cannot answer a request.
    #[error("{reason}")]
    NotSeen {
        /// The cause.
        reason: String,
    },
    /// A router's identity where names are to be derived.
    #[error(
        "{} is a router's identity: it holds no fleet secret, so that a router can derive no name; use a member's \
         identity",
        path.display()
    )]
    RouterCannotName {
        /// The identity file.
        path: PathBuf,
    },
    /// A fleet file cannot be read.
    #[error(transparent)]
    Fleet(#[from] sgc_node::FleetFileError),
    /// A fleet file whose CA did not certify the node.
    #[error("{} is the file of another fleet than that of {node}", path.display())]
    OtherFleet {
        /// The fleet file.
        path: PathBuf,
        /// The node.
        node: String,
    },
}
