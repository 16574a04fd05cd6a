//! What a run leaves for a test to look at.

use std::time::Duration;

use sgc_endpoint::{Event, SinkDrop};
use sgc_router::{LinkClose, LinkId};
use sgc_wire::{Name, SourceId};

use crate::NodeKey;

/// Number of a published message, unique in its world.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub struct MessageId(pub u64);

/// A message that was published.
#[derive(Clone, Debug)]
pub struct Published {
    /// Its number.
    pub id: MessageId,
    /// When, since the world began.
    pub at: Duration,
    /// Whose topic.
    pub owner: NodeKey,
    /// By whom; another node than the owner where that may publish.
    pub by: NodeKey,
    /// In which run of that node.
    pub run: u64,
    /// Under which topic.
    pub topic: String,
    /// By which source; another one after the topic was shared anew.
    pub source: SourceId,
}

/// A message that was delivered.
#[derive(Clone, Debug)]
pub struct Received {
    /// Its number.
    pub id: MessageId,
    /// When, since the world began.
    pub at: Duration,
    /// To whom.
    pub node: NodeKey,
    /// To which run of that node.
    pub run: u64,
    /// Which use of the topic within that run: leaving and using it again begins another.
    pub use_number: u64,
    /// Whose topic.
    pub owner: NodeKey,
    /// Which.
    pub topic: String,
}

/// Something that happened at a node.
#[derive(Clone, Debug)]
pub struct Logged {
    /// When, since the world began.
    pub at: Duration,
    /// Where.
    pub node: NodeKey,
    /// What.
    pub what: What,
}

/// What happened.
#[derive(Clone, Debug)]
pub enum What {
    /// The endpoint said so.
    Event(Event),
    /// The router refused a frame.
    RouterDrop(sgc_router::RouterDrop),
    /// The endpoint refused a frame.
    EndpointDrop(sgc_endpoint::EndpointDrop),
    /// The data path refused a packet.
    DataDrop {
        /// Its name.
        name: Name,
        /// Where it came from.
        ingress: LinkId,
        /// Why.
        why: DataDrop,
    },
    /// Messages that a sink will never get.
    SinkLost {
        /// Their name.
        name: Name,
        /// How many.
        messages: u64,
    },
    /// The router closed a link.
    Closed {
        /// Why.
        reason: LinkClose,
    },
}

/// Why the data path drops.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub enum DataDrop {
    /// Nobody asked for the name.
    NoTree,
    /// Data of this name may not come from there.
    WrongWay,
    /// It went too far.
    HopLimit,
    /// It is for a sink that is not here.
    NoSuchSink,
    /// This node has no key for it.
    NotGranted,
    /// The sink refused it.
    Sink(SinkDrop),
    /// The network lost it.
    Lost,
}
