//! Cables between nodes, and wires, the connections over them.

use std::collections::{BTreeMap, VecDeque};
use std::net::SocketAddr;
use std::time::{Duration, Instant};

use sgc_router::LinkId;
use sgc_wire::{Control, Name, Packet};

use crate::ids::NodeKey;

/// A function that replaces a frame by others, or by none.
pub(crate) type Tamper = Box<dyn FnMut(&Control) -> Vec<Control>>;

/// A cable between two nodes, which connect whenever both run and the cable is not cut.
pub(crate) struct Cable {
    pub(crate) ends: [NodeKey; 2],
    pub(crate) whole: bool,
    pub(crate) wire: Option<usize>,
    pub(crate) latency: Duration,
    /// The alterations that an evil node at one end makes to frames that it sends.
    pub(crate) tampers: [Option<Tamper>; 2],
    /// Ends whose packets are lost while their frames arrive, as behind a stalled queue.
    pub(crate) loses: [bool; 2],
    /// It stands for the path between two hosts. It is whole while a wire is there.
    pub(crate) is_direct: bool,
}

impl Cable {
    pub(crate) fn end_of(&self, node: NodeKey) -> Option<usize> {
        self.ends.iter().position(|n| *n == node)
    }
}

/// One connection, from its establishment to its end.
pub(crate) struct Wire {
    pub(crate) cable: usize,
    /// The wire still carries frames. It may have stopped before its ends notice.
    pub(crate) carries: bool,
    pub(crate) ends: [WireEnd; 2],
    /// Set for a connection whose packets pass NATs.
    pub(crate) path: Option<Path>,
}

/// The path of a connection through NATs, over UDP.
pub(crate) struct Path {
    /// The address to which each side sends.
    pub(crate) remotes: [SocketAddr; 2],
    /// The side that dialled. The other one follows its address (RFC 9000, 9).
    pub(crate) dialer: usize,
    /// Time since which packets do not pass in both directions.
    pub(crate) silent_since: Option<Instant>,
    /// Both nodes know of the silence.
    pub(crate) is_suspect: bool,
    /// Reliable content that waits for the path: it is sent again until it arrives.
    pub(crate) waiting: VecDeque<Content>,
}

/// The content of a connection, with the side that sends it.
pub(crate) enum Content {
    Frame(usize, Control),
    Packet(usize, Packet),
}

/// One side of a wire.
pub(crate) struct WireEnd {
    pub(crate) node: NodeKey,
    pub(crate) run: u64,
    pub(crate) link: LinkId,
    /// This side does not know yet that the link is down.
    pub(crate) up: bool,
    /// Arrival of the last frame from this side. Later frames arrive no earlier.
    pub(crate) control: Instant,
    /// Arrival of the last packet of each name.
    pub(crate) data: BTreeMap<Name, Instant>,
}
