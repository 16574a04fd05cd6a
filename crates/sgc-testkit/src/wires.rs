//! Cables, which say who could be connected to whom, and wires, the connections over them.

use std::collections::BTreeMap;
use std::time::{Duration, Instant};

use sgc_router::LinkId;
use sgc_wire::{Control, Name};

use crate::NodeKey;

/// Replaces a frame by others, or by none.
pub(crate) type Tamper = Box<dyn FnMut(&Control) -> Vec<Control>>;

/// Two nodes that connect whenever both run and the cable is whole.
pub(crate) struct Cable {
    pub(crate) ends: [NodeKey; 2],
    pub(crate) whole: bool,
    pub(crate) wire: Option<usize>,
    pub(crate) latency: Duration,
    /// What an evil node at one end does to frames that it sends.
    pub(crate) tampers: [Option<Tamper>; 2],
    /// True for an end whose packets are lost while its frames arrive, as if a queue stood still for too long.
    pub(crate) loses: [bool; 2],
}

impl Cable {
    pub(crate) fn end_of(&self, node: NodeKey) -> Option<usize> {
        self.ends.iter().position(|n| *n == node)
    }
}

/// One connection, from its establishment to its end.
pub(crate) struct Wire {
    pub(crate) cable: usize,
    /// False once nothing gets through any more, whether or not its ends noticed.
    pub(crate) carries: bool,
    pub(crate) ends: [WireEnd; 2],
}

/// One side of a wire.
pub(crate) struct WireEnd {
    pub(crate) node: NodeKey,
    pub(crate) run: u64,
    pub(crate) link: LinkId,
    /// True until this side knows that the link is down.
    pub(crate) up: bool,
    /// When the last frame from this side arrives: those behind it arrive no earlier.
    pub(crate) control: Instant,
    /// The same for packets, by name.
    pub(crate) data: BTreeMap<Name, Instant>,
}
