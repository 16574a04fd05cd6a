//! The record of a run, for tests to inspect.

use std::net::SocketAddr;
use std::time::Duration;

use sgc_endpoint::{Event, SinkDrop};
use sgc_router::{LinkClose, LinkId};
use sgc_wire::{Control, Name, Packet, SourceId};

use crate::ids::{MessageId, NodeKey};

/// A message that was published.
#[derive(Clone, Debug)]
pub struct PublishedMessage {
    /// The message's number.
    pub id: MessageId,
    /// Time since the world began.
    pub at: Duration,
    /// The topic's owner.
    pub owner: NodeKey,
    /// The publishing node: the owner, or another node that may publish.
    pub by: NodeKey,
    /// The run of that node.
    pub run: u64,
    /// The topic.
    pub topic: String,
    /// The source, which changes when the topic is shared anew.
    pub source: SourceId,
}

/// A message that was delivered.
#[derive(Clone, Debug)]
pub struct ReceivedMessage {
    /// The message's number.
    pub id: MessageId,
    /// Time since the world began.
    pub at: Duration,
    /// The receiving node.
    pub node: NodeKey,
    /// The run of that node.
    pub run: u64,
    /// The number of the use within that run. Leaving the topic and using it again begins another.
    pub use_number: u64,
    /// The topic's owner.
    pub owner: NodeKey,
    /// The topic.
    pub topic: String,
}

/// A frame that crossed a link while [`World::capture`](crate::World::capture) was on.
#[derive(Clone, Debug)]
pub struct CapturedFrame {
    /// The sender.
    pub from: NodeKey,
    /// The receiver.
    pub to: NodeKey,
    /// The frame.
    pub frame: Control,
}

/// A packet that crossed a link while [`World::capture`](crate::World::capture) was on.
#[derive(Clone, Debug)]
pub struct CapturedPacket {
    /// The sender.
    pub from: NodeKey,
    /// The receiver.
    pub to: NodeKey,
    /// Time since the world began.
    pub at: Duration,
    /// The packet.
    pub packet: Packet,
}

/// A UDP packet of no link that a node sent.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct SentDatagram {
    /// The sender.
    pub from: NodeKey,
    /// The address to which it was sent.
    pub to: SocketAddr,
    /// The node that it reached, and the source that this one saw.
    pub reached: Option<(NodeKey, SocketAddr)>,
    /// Its content.
    pub datagram: Vec<u8>,
}

/// The copies of one packet that a node sent.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct PacketCopies {
    /// Over links that were configured.
    pub configured: usize,
    /// Over direct links through the uplink: the nodes there.
    pub far: Vec<NodeKey>,
    /// Over direct links within a network.
    pub near: usize,
}

/// An event at a node, with its time.
#[derive(Clone, Debug)]
pub struct LogEntry {
    /// Time since the world began.
    pub at: Duration,
    /// The node.
    pub node: NodeKey,
    /// The event.
    pub what: What,
}

/// The kind of a log entry.
#[derive(Clone, Debug)]
pub enum What {
    /// The endpoint emitted an event.
    Event(Event),
    /// The router refused a frame.
    RouterDrop(sgc_router::RouterDrop),
    /// The endpoint refused a frame.
    EndpointDrop(sgc_endpoint::EndpointDrop),
    /// The data path refused a packet.
    DataDrop {
        /// Its name.
        name: Name,
        /// The link on which it arrived.
        ingress: LinkId,
        /// The reason.
        why: DataDrop,
    },
    /// A sink lost messages for good.
    SinkLost {
        /// The name.
        name: Name,
        /// The number of messages.
        messages: u64,
    },
    /// The router closed a link.
    Closed {
        /// The reason.
        reason: LinkClose,
    },
}

/// The reason for a drop on the data path.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub enum DataDrop {
    /// No node asked for the name.
    NoTree,
    /// Data of this name may not come over that link.
    WrongWay,
    /// The packet used up its hop limit.
    HopLimit,
    /// The packet's sink is not here.
    NoSuchSink,
    /// This node has no key for the packet.
    NotGranted,
    /// The sink refused the packet.
    Sink(SinkDrop),
    /// The network lost the packet.
    Lost,
}
