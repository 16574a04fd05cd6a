//! Events at one side.

use std::time::Instant;

use crate::words::{Channel, Frame};

/// Most events in the queue of one side.
pub(crate) const EVENTS_MAX: usize = 4096;

/// An event at one side.
#[derive(Debug)]
pub(crate) enum Event {
    /// A message arrived at this time.
    Frame(Channel, Frame, Instant),
    /// The user interrupted the program.
    Interrupted,
    /// The node ended.
    NodeEnded,
    /// The node is up and listens at these URLs.
    NodeReady(Vec<String>),
}
