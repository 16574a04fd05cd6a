//! The operations of a store, each on one key, and their results.
//!
//! The router decides which keys to read and write. The driver carries the operations out, in any order, and answers
//! each once. A store is a map from keys to bytes that reports changes of keys that were read. It is not trusted.

use std::fmt;
use std::time::Duration;

use bytes::Bytes;
use sgc_wire::{Name, NodeId};

/// Length of a [`BatchTag`], bytes. With the owner's id, a tag fills the 44 bytes that Valkey keeps in the entry of a
/// key.
pub const BATCH_TAG_LEN: usize = 12;

/// The part of an owner's names that one advertisement speaks for: the beginning of a digest of these names.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub struct BatchTag(pub [u8; BATCH_TAG_LEN]);

/// A key of a store.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub enum StoreKey {
    /// A name. The value is the batch of its owner that has it.
    Name(Name),
    /// A batch of names. The value is the owner's signed advertisement or withdrawal.
    Batch {
        /// The owner.
        owner: NodeId,
        /// The batch.
        tag: BatchTag,
    },
    /// A node. The value is its signed link state.
    Node(NodeId),
}

/// The number of an operation; never used again while the process lives.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub struct StoreOpId(pub u64);

/// The condition of a write.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum WriteIf {
    /// None.
    Always,
    /// The key has no value.
    Absent,
}

/// An operation on one key.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum StoreAction {
    /// Read the value, and report its next change by [`StoreEvent::Changed`].
    Read,
    /// Set the value.
    Write {
        /// The value.
        value: Bytes,
        /// Time after which the key ends by itself.
        lifetime: Option<Duration>,
        /// The condition.
        condition: WriteIf,
    },
    /// Remove the key if it has this value.
    Remove {
        /// The value.
        value: Bytes,
    },
}

/// An operation for the driver.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct StoreOp {
    /// Its number.
    pub id: StoreOpId,
    /// The key.
    pub key: StoreKey,
    /// The operation.
    pub action: StoreAction,
}

/// The reason why an operation failed.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, thiserror::Error)]
pub enum StoreFailure {
    /// No server that has the key could be reached in time.
    #[error("the store did not answer in time")]
    Unreachable,
    /// The server refused it: the user's rights, memory, or its state.
    #[error("the store refused the operation")]
    Refused,
}

/// The result of an operation.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum StoreReply {
    /// Of [`StoreAction::Read`]: the value, if there is one.
    Value(Option<Bytes>),
    /// Of [`StoreAction::Write`]: whether the key had a value before.
    Written {
        /// Whether it had one.
        existed: bool,
    },
    /// Of [`StoreAction::Remove`].
    Removed,
}

/// News from the store.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum StoreEvent {
    /// The store answers. Changes before this event may have gone unreported, also if it answered before.
    Up,
    /// The store, or a part of it, does not answer any more. Operations may still succeed.
    Down,
    /// The result of an operation.
    Reply {
        /// The operation.
        id: StoreOpId,
        /// The result.
        result: Result<StoreReply, StoreFailure>,
    },
    /// A key that was read has another value now, or none.
    Changed(StoreKey),
}

impl fmt::Display for StoreKey {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Name(name) => write!(f, "name {name}"),
            Self::Batch { owner, .. } => write!(f, "names of {owner}"),
            Self::Node(node) => write!(f, "node {node}"),
        }
    }
}
