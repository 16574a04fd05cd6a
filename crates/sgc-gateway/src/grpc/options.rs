//! [`GrpcOptions`]: the bounds of the front end.

use crate::limits::SessionLimits;

/// Longest gRPC message in either direction, in bytes. Images take 13 MB.
pub const MESSAGE_BYTES_MAX: usize = 64 << 20;

/// The options of the front end.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct GrpcOptions {
    /// The limits of one credential on one connection.
    pub session: SessionLimits,
    /// Most bytes of long messages that are sent to a client and unread, over all its streams. Further messages wait.
    pub unread_bytes_max: usize,
    /// Most bytes of long messages that a client sends at a time, over all its streams, from the head of each until
    /// it is handled. Streams that exceed it fail.
    pub incoming_bytes_max: usize,
}

impl Default for GrpcOptions {
    fn default() -> Self {
        Self {
            session: SessionLimits::default(),
            unread_bytes_max: 4 * MESSAGE_BYTES_MAX,
            incoming_bytes_max: 4 * MESSAGE_BYTES_MAX,
        }
    }
}
