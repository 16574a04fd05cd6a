//! The seam between SGC and a local ROS 2 network: discovery in, raw samples in and out.
//!
//! Nothing here knows a DDS implementation; `sgc-dds` implements [`RosNetwork`] with Cyclone DDS,
//! `sgc-testkit` in memory for tests. Payloads are serialised samples: the four-byte encapsulation
//! header (RTPS 2.5, 10.2) and the body, untouched.

use std::any::Any;
use std::collections::BTreeSet;
use std::fmt;
use std::sync::Arc;
use std::time::Duration;

use bytes::Bytes;
use sgc_wire::{Qos, RosNode};

/// GUID of a DDS entity: 12 bytes of prefix, 4 of entity id (RTPS 2.5, 9.3.1).
#[derive(Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub struct Guid(pub [u8; 16]);

impl Guid {
    /// True if the endpoint's type has no key: entity kind ends in 3 (writer) or 4 (reader)
    /// (RTPS 2.5, table 9.1).
    pub fn is_keyless(&self) -> bool {
        matches!(self.0[15] & 0x0f, 3 | 4)
    }

    /// The prefix that all entities of one participant share.
    pub fn prefix(&self) -> [u8; 12] {
        let mut prefix = [0; 12];
        prefix.copy_from_slice(&self.0[..12]);
        prefix
    }

    /// True if the endpoint is of a participant of Cyclone DDS, by its [`Self::vendor`].
    pub fn is_of_cyclone(&self) -> bool {
        self.vendor() == [0x01, 0x10]
    }

    /// Vendor of the DDS implementation, as RTPS 2.5 (9.3.1.1) asks it to begin its prefixes: `[1, 0x0f]` is Fast DDS,
    /// `[1, 0x10]` Cyclone, `[1, 0x12]` RustDDS.
    pub fn vendor(&self) -> [u8; 2] {
        [self.0[0], self.0[1]]
    }
}

impl fmt::Debug for Guid {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        for (i, b) in self.0.iter().enumerate() {
            if i > 0 && i % 4 == 0 {
                f.write_str(".")?;
            }
            write!(f, "{b:02x}")?;
        }
        Ok(())
    }
}

/// Which end of a topic an endpoint is.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub enum EndpointKind {
    /// A DDS data reader.
    Reader,
    /// A DDS data writer.
    Writer,
}

/// A DDS endpoint seen on the local network. Topic and type are the DDS names
/// (`rt/chatter`, `std_msgs::msg::dds_::String_`).
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct DiscoveredEndpoint {
    /// Reader or writer.
    pub kind: EndpointKind,
    /// Its GUID, unique on the network while it lives.
    pub guid: Guid,
    /// DDS topic name.
    pub topic: String,
    /// DDS type name.
    pub type_name: String,
    /// True if the type has no key.
    pub keyless: bool,
    /// `RIHS01_…` type hash from USER_DATA, if the endpoint carries one (REP 2016).
    pub type_hash: Option<String>,
    /// What it offers or requests.
    pub qos: Qos,
}

/// A ROS 2 node and its endpoints.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct GraphNode {
    /// Its names.
    pub node: RosNode,
    /// Its data readers.
    pub readers: Vec<Guid>,
    /// Its data writers.
    pub writers: Vec<Guid>,
}

/// What happens in the local graph. Endpoints and nodes made by SGC, this process's or another's, never appear.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum DiscoveryEvent {
    /// An endpoint is there.
    Appeared(DiscoveredEndpoint),
    /// An endpoint is gone.
    Vanished {
        /// Which.
        guid: Guid,
    },
    /// A writer's lease ran out, or the writer lives again. Told of writers that a reader made here is matched with.
    Liveliness {
        /// The writer.
        guid: Guid,
        /// Whether it lives.
        is_alive: bool,
    },
    /// The depth of the history of a writer that announced none is known. Told of writers that a reader made here is matched with.
    HistoryDepth {
        /// The writer.
        guid: Guid,
        /// Messages that it keeps for late joiners.
        depth: u32,
    },
    /// All nodes that a participant has from now on; none if it is gone. Their endpoints may appear before or after.
    Nodes {
        /// The participant.
        participant: Guid,
        /// Its nodes.
        nodes: Vec<GraphNode>,
    },
}

/// What to create on the local network.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct EndpointSpec {
    /// DDS topic name.
    pub topic: String,
    /// DDS type name.
    pub type_name: String,
    /// True if the type has no key; must agree with the remote side or nothing matches.
    pub keyless: bool,
    /// True for a reader that asks writers for the hashes of keys (RTPS 2.5, 9.6.4.8), which those of Fast DDS 2 do not tell otherwise. Writers
    /// of Cyclone tell theirs anyway, and do not match a reader that asks in this way.
    pub asks_key_hash: bool,
    /// Type hash to put in USER_DATA, as rmw does from Iron on.
    pub type_hash: Option<String>,
    /// Quality of service to offer or request.
    pub qos: Qos,
}

/// What a received sample says about its instance.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum SampleKind {
    /// Data.
    Write,
    /// The instance was disposed of; the payload holds the key.
    Dispose,
    /// The writer unregistered the instance; the payload holds the key.
    Unregister,
}

/// The key of a sample, hashed (RTPS 2.5, 9.6.4.8).
pub type KeyHash = [u8; 16];

/// A sample without its payload.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct SampleHead {
    /// Data or the end of an instance.
    pub kind: SampleKind,
    /// Source time stamp, nanoseconds since the Unix epoch.
    pub source_timestamp_ns: i64,
    /// The hash of its key, where the topic has one and its writer told.
    pub key_hash: Option<KeyHash>,
}

impl SampleHead {
    /// The head of a sample without a key.
    pub const fn new(kind: SampleKind, source_timestamp_ns: i64) -> Self {
        Self { kind, source_timestamp_ns, key_hash: None }
    }
}

/// One serialised sample taken from a reader.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Sample {
    /// Data or the end of an instance.
    pub kind: SampleKind,
    /// GUID of the writer, if the network tells.
    pub writer: Option<Guid>,
    /// Source time stamp, nanoseconds since the Unix epoch.
    pub source_timestamp_ns: i64,
    /// The hash of its key, where the topic has one and the writer told.
    pub key_hash: Option<KeyHash>,
    /// Encapsulation header and body.
    pub payload: Bytes,
    /// True if the handler gets another sample at once: it may then put off what is cheaper for several.
    /// After the last one that is at hand it is false.
    pub more: bool,
}

/// Receives the samples of one reader, one after the other. A closure that takes samples is one.
pub trait HandleSamples: Send {
    /// Handles a sample on a thread of that reader alone: it may block, and while it does nothing but that reader waits.
    fn handle(&mut self, sample: Sample);

    /// Handles a sample on a thread that receives for all readers of the network if that needs no waiting, or else gives
    /// it back, to be handled on the reader's own. None is at hand behind it.
    fn handle_at_once(&mut self, sample: Sample) -> Result<(), Sample> {
        Err(sample)
    }

    /// So many samples gave way to newer ones, since they came faster than they were handled.
    fn overrun(&mut self, samples: u64) {
        let _ = samples;
    }
}

impl<F: FnMut(Sample) + Send> HandleSamples for F {
    fn handle(&mut self, sample: Sample) {
        self(sample);
    }
}

/// Handles the samples of a reader.
pub type SampleHandler = Box<dyn HandleSamples>;

/// Who asked a service, and the number of its request: the sample identity of RPC over DDS 1.0 (7.5.1.1.1).
///
/// It holds all that a reply needs, so that one server may answer what another of the same service was asked.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub struct RequestId {
    /// The client: GUID of its request writer, or what stands in its place in the mapping that it uses.
    pub client: [u8; 16],
    /// Its number there.
    pub number: i64,
    /// At a server, the endpoint of the client that its end is to be noticed by, if the network tells: one that
    /// discovery says is gone.
    pub asker: Option<Guid>,
}

/// Both topics of a service, at its client or at its server.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct ServiceSpec {
    /// Where requests go.
    pub request: EndpointSpec,
    /// Where replies go.
    pub reply: EndpointSpec,
}

/// The reason for which a request or a reply of the local network is not handed over.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum UnhandledCall {
    /// Newer ones took its place, since they came faster than they were handled.
    Overrun,
    /// It does not say to which call it belongs.
    Unreadable,
}

/// Receives requests at a server, replies at a client. A closure that takes both arguments of [`Self::handle`] is one.
pub trait HandleCalls: Send {
    /// Handles a message: encapsulation header and body, without the request's id, which vendors put in different places.
    /// On a thread of its own: it may block.
    fn handle(&mut self, id: RequestId, payload: Bytes);

    /// So many messages are not handed over.
    fn unhandled(&mut self, why: UnhandledCall, messages: u64) {
        let _ = (why, messages);
    }
}

impl<F: FnMut(RequestId, Bytes) + Send> HandleCalls for F {
    fn handle(&mut self, id: RequestId, payload: Bytes) {
        self(id, payload);
    }
}

/// Handles the requests of a server, or the replies to a client.
pub type RequestHandler = Box<dyn HandleCalls>;

/// A client of a local service; lives until dropped. Calls may block, like those of [`RosWriter`].
pub trait RosClient: Send + Sync + 'static {
    /// Sends a request; its reply comes to the handler under the id that this returns, maybe before this does. Waits
    /// a little for a server, and is [`RosError::NoPeer`] if there is none.
    fn request(&self, payload: Bytes) -> Result<RequestId, RosError>;

    /// Returns the request readers of the servers that there are at present. A request reaches no other than those that are there
    /// before it is sent.
    fn servers(&self) -> BTreeSet<Guid>;

    /// How many servers there are at present.
    fn matched_servers(&self) -> u32 {
        self.servers().len() as u32
    }

    /// GUIDs of its reader and its writer.
    fn guids(&self) -> [Guid; 2];
}

/// A server for local clients; lives until dropped. Calls may block, like those of [`RosWriter`].
pub trait RosServer: Send + Sync + 'static {
    /// Answers the request of this id. Waits a little for the client to be able to hear it.
    fn reply(&self, request: &RequestId, payload: Bytes) -> Result<(), RosError>;

    /// GUIDs of its reader and its writer.
    fn guids(&self) -> [Guid; 2];
}

/// An endpoint that the local graph shows and that no other matches; lives until dropped, which may block.
pub struct ShownEndpoint {
    /// Its GUID.
    pub guid: Guid,
    _endpoint: Box<dyn Any + Send>,
}

impl ShownEndpoint {
    /// Wraps the entities that have the endpoint shown until they are dropped.
    pub fn new(guid: Guid, entities: impl Any + Send) -> Self {
        Self { guid, _endpoint: Box::new(entities) }
    }
}

impl fmt::Debug for ShownEndpoint {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_struct("ShownEndpoint").field("guid", &self.guid).finish_non_exhaustive()
    }
}

/// Receives discovery events on a thread of the network; must not block.
pub type DiscoveryHandler = Box<dyn FnMut(DiscoveryEvent) + Send>;

/// Why the local network refused.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
pub enum RosError {
    /// The DDS domain could not be joined.
    #[error("cannot join ROS domain {domain}: {reason}")]
    Domain {
        /// Domain id.
        domain: u32,
        /// What the implementation said.
        reason: String,
    },
    /// An endpoint could not be made.
    #[error("cannot create a {kind} on {topic} [{type_name}]: {reason}")]
    Create {
        /// `"reader"` or `"writer"`.
        kind: &'static str,
        /// DDS topic.
        topic: String,
        /// DDS type.
        type_name: String,
        /// What the implementation said.
        reason: String,
    },
    /// DDS Security forbids an endpoint of the graph.
    #[error("{file} grants enclave {enclave} no partition {partition} on {topic}")]
    ForbiddenPartition {
        /// The permissions.
        file: String,
        /// The enclave.
        enclave: String,
        /// The partition of endpoints that are only shown.
        partition: &'static str,
        /// DDS topic.
        topic: String,
    },
    /// A payload that is no serialised sample: shorter than its header, or too large.
    #[error("a payload of {bytes} bytes is not a serialised sample")]
    Payload {
        /// Its length.
        bytes: usize,
    },
    /// A reliable write was not accepted in time: a local reader does not acknowledge.
    #[error("the local network accepted no sample for {waited_ms} ms")]
    WriteTimeout {
        /// How long the write blocked.
        waited_ms: u64,
    },
    /// A sample of a topic with a key whose hash nobody told: subscribers of ROS 2 Kilted end with a segmentation fault at one.
    #[error(
        "the hash of its key is not known, without which subscribers of Fast DDS 3 end with a segmentation fault"
    )]
    KeyUnknown,
    /// Nobody is there to hear a request or a reply.
    #[error("nobody on the local network was there to hear it for {waited_ms} ms")]
    NoPeer {
        /// How long was waited.
        waited_ms: u64,
    },
    /// Any other failure of a write.
    #[error("write failed: {reason}")]
    Write {
        /// What the implementation said.
        reason: String,
    },
}

/// How far a network reaches, compared with when it was opened.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Reach {
    /// As far.
    Whole,
    /// Perhaps not as far: this host's addresses are others. No program of another host is known to be cut off, or they still change.
    Doubtful,
    /// Programs of other hosts are cut off, or may be, until the network is opened again.
    CutOff,
}

/// A local ROS 2 network.
///
/// Dropping the network ends discovery and waits for its threads; dropping a reader or writer deletes
/// the entity and its topic, and waits for the thread that served it.
pub trait RosNetwork: Send + Sync + 'static {
    /// A reader; lives until dropped.
    type Reader: Send + 'static;
    /// A writer; lives until dropped.
    type Writer: RosWriter;
    /// A client of a service; lives until dropped.
    type Client: RosClient;
    /// A server of a service; lives until dropped.
    type Server: RosServer;

    /// Starts discovery; each endpoint already there is told as an appearance. Call once.
    fn discover(&self, handler: DiscoveryHandler) -> Result<(), RosError>;

    /// Creates a reader whose samples go to `handler`. Samples of writers made by SGC, this process's or
    /// another's, never do: what they wrote came through SGC already.
    fn create_reader(&self, spec: &EndpointSpec, handler: SampleHandler) -> Result<Self::Reader, RosError>;

    /// Creates a writer.
    fn create_writer(&self, spec: &EndpointSpec) -> Result<Self::Writer, RosError>;

    /// Creates a client, which calls local servers; their replies go to `handler`. Servers made by SGC are none.
    fn create_client(&self, spec: &ServiceSpec, handler: RequestHandler) -> Result<Self::Client, RosError>;

    /// Creates a server; requests of local clients go to `handler`, those of clients made by SGC do not.
    fn create_server(&self, spec: &ServiceSpec, handler: RequestHandler) -> Result<Self::Server, RosError>;

    /// GUID of a reader made here.
    fn reader_guid(&self, reader: &Self::Reader) -> Guid;

    /// How long ago a writer of the local network renewed its liveliness lease, by a message or without one. None if it did not yet, and of
    /// writers that are not reliable, not manual by topic, or made by SGC. Does not block.
    fn renewed_ago(&self, writer: &Guid) -> Option<Duration> {
        let _ = writer;
        None
    }

    /// Returns `true` if nodes are told of and announced.
    fn has_graph(&self) -> bool;

    /// Has the local graph show an endpoint that stands for one elsewhere: with its type, type hash and QoS but for history and
    /// partitions. No endpoint matches it, so that it takes nothing, acknowledges nothing and gives nothing. May block.
    fn show(&self, kind: EndpointKind, spec: &EndpointSpec) -> Result<ShownEndpoint, RosError>;

    /// Has the local graph show these nodes, and no others, as this participant's. May block.
    fn announce(&self, nodes: &[GraphNode]) -> Result<(), RosError>;

    /// Returns how far it reaches at present.
    fn reach(&self) -> Reach {
        Reach::Whole
    }

    /// Returns `true` if a network opened now, as this one was, would reach programs that this one does not. After `false` the network is
    /// [`Reach::Whole`] until something changes. May block.
    ///
    /// # Errors
    /// The reason why none could be opened.
    fn gains_by_reopening(&self) -> Result<bool, RosError> {
        Ok(true)
    }

    /// Ends discovery and the network, and waits until all that was made on it is dropped: so long at most, `false` if something is
    /// left. May block.
    fn close(self: Arc<Self>, max: Duration) -> bool {
        let _ = max;
        true
    }
}

/// A raw writer. Calls may block (DDS reliability), so they belong on a thread of the writer's own.
pub trait RosWriter: Send + Sync + 'static {
    /// Writes, disposes or unregisters. It need not leave before the next call of this kind, or of [`Self::flush`]: short samples
    /// share packets.
    fn write_ahead(&self, head: SampleHead, payload: Bytes) -> Result<(), RosError>;

    /// The same, with the given source time stamp (nanoseconds since the Unix epoch), and at once.
    fn write(&self, kind: SampleKind, source_timestamp_ns: i64, payload: Bytes) -> Result<(), RosError> {
        let written = self.write_ahead(SampleHead::new(kind, source_timestamp_ns), payload);
        self.flush();
        written
    }

    /// Lets leave what was written ahead.
    fn flush(&self) {}

    /// Renews its liveliness lease at its readers without a sample, if it is manual by topic. May block.
    fn assert_liveliness(&self) {}

    /// Gives late joiners the last samples, so many, from here on. Only a writer made with [`sgc_wire::History::UNSAID`] does, and never more
    /// than before.
    fn set_late_depth(&self, depth: u32) {
        let _ = depth;
    }

    /// Returns the number of samples of so many bytes that it keeps for reliable readers that have not acknowledged them yet. Beyond it each write
    /// takes the place of the oldest, whether somebody lacks that or not. None if it waits for its readers rather.
    fn kept(&self, bytes: usize) -> Option<u32> {
        let _ = bytes;
        None
    }

    /// Waits until all reliable readers have what was written; false if they have not after `max`.
    fn wait_acknowledged(&self, max: Duration) -> bool {
        let _ = max;
        true
    }

    /// How many local readers are matched at present.
    fn matched_readers(&self) -> u32;

    /// Waits until so many local readers are matched, or for so long; says how many are.
    fn wait_matched(&self, readers: u32, max: Duration) -> u32;

    /// Its GUID.
    fn guid(&self) -> Guid;
}
