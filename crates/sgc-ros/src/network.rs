//! The interface between SGC and a local ROS 2 network: discovery events in, raw samples in and out.
//!
//! Nothing here depends on a DDS implementation. `sgc-dds` implements [`RosNetwork`] with Cyclone DDS, `sgc-testkit`
//! in memory for tests. Payloads are serialised samples: the encapsulation header of four bytes (RTPS 2.5, 10.2) and
//! the body, unchanged.

use std::any::Any;
use std::collections::BTreeSet;
use std::fmt;
use std::sync::{Arc, Mutex};
use std::time::Duration;

use bytes::Bytes;
use sgc_sync::lock;
use sgc_wire::{Qos, RosNode};

/// The GUID of a DDS entity: 12 bytes of prefix, 4 of entity id (RTPS 2.5, 9.3.1).
#[derive(Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub struct Guid(pub [u8; 16]);

impl Guid {
    /// Returns `true` if the endpoint's type has no key: the entity kind ends in 3 (writer) or 4 (reader) (RTPS 2.5,
    /// table 9.1).
    pub fn is_keyless(&self) -> bool {
        matches!(self.0[15] & 0x0f, 3 | 4)
    }

    /// Returns the prefix that all entities of one participant share.
    pub fn prefix(&self) -> [u8; 12] {
        let mut prefix = [0; 12];
        prefix.copy_from_slice(&self.0[..12]);
        prefix
    }

    /// Returns `true` if the endpoint belongs to a participant of Cyclone DDS, by its [`Self::vendor`].
    pub fn is_of_cyclone(&self) -> bool {
        self.vendor() == [0x01, 0x10]
    }

    /// Returns the vendor id with which the prefix begins (RTPS 2.5, 9.3.1.1): `[1, 0x0f]` for Fast DDS, `[1, 0x10]`
    /// for Cyclone, `[1, 0x12]` for RustDDS.
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

/// The kind of a DDS endpoint.
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
    /// The GUID, unique on the network while the endpoint exists.
    pub guid: Guid,
    /// DDS topic name.
    pub topic: String,
    /// DDS type name.
    pub type_name: String,
    /// `true` if the type has no key.
    pub keyless: bool,
    /// `RIHS01_…` type hash from USER_DATA, if the endpoint carries one (REP 2016).
    pub type_hash: Option<String>,
    /// The offered or requested QoS.
    pub qos: Qos,
}

/// A ROS 2 node and its endpoints.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct GraphNode {
    /// The name of the node.
    pub node: RosNode,
    /// The data readers.
    pub readers: Vec<Guid>,
    /// The data writers.
    pub writers: Vec<Guid>,
}

/// A change of the local graph. Endpoints and nodes that SGC creates, in this process or another, never appear.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum DiscoveryEvent {
    /// An endpoint appeared.
    Appeared(DiscoveredEndpoint),
    /// An endpoint vanished.
    Vanished {
        /// The endpoint.
        guid: Guid,
    },
    /// A writer's liveliness lease expired, or the writer is alive again. Reported for writers that match a reader
    /// created here, and once for each writer that such a reader hears.
    Liveliness {
        /// The writer.
        guid: Guid,
        /// `true` if the writer is alive.
        is_alive: bool,
    },
    /// The history depth of a writer that announced none became known. Reported for writers that match a reader
    /// created here.
    HistoryDepth {
        /// The writer.
        guid: Guid,
        /// The number of samples that the writer keeps for late joiners.
        depth: u32,
    },
    /// A participant has these nodes from now on, none if it is gone. Their endpoints may appear before or after.
    Nodes {
        /// The participant.
        participant: Guid,
        /// The nodes.
        nodes: Vec<GraphNode>,
    },
}

/// The spec of an endpoint to create on the local network.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct EndpointSpec {
    /// DDS topic name.
    pub topic: String,
    /// DDS type name.
    pub type_name: String,
    /// `true` if the type has no key. The other side must agree, or the endpoints do not match.
    pub keyless: bool,
    /// `true` for a reader that asks writers for key hashes (RTPS 2.5, 9.6.4.8), which Fast DDS 2 sends only on
    /// request. Cyclone's writers always send them, and do not match a reader that asks in this way.
    pub asks_key_hash: bool,
    /// The type hash for USER_DATA, as rmw sets it since Iron.
    pub type_hash: Option<String>,
    /// The QoS to offer or request.
    pub qos: Qos,
}

/// The kind of a sample.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum SampleKind {
    /// Data.
    Write,
    /// The instance was disposed of; the payload holds the key.
    Dispose,
    /// The writer unregistered the instance; the payload holds the key.
    Unregister,
}

/// The hash of a sample's key (RTPS 2.5, 9.6.4.8).
pub type KeyHash = [u8; 16];

/// A sample without its payload.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct SampleHead {
    /// The kind of the sample.
    pub kind: SampleKind,
    /// Source timestamp, nanoseconds since the Unix epoch.
    pub source_timestamp_ns: i64,
    /// The hash of the key, if the topic has a key and the writer sent the hash.
    pub key_hash: Option<KeyHash>,
}

impl SampleHead {
    /// Creates the head of a sample without a key.
    pub const fn new(kind: SampleKind, source_timestamp_ns: i64) -> Self {
        Self { kind, source_timestamp_ns, key_hash: None }
    }
}

/// One serialised sample taken from a reader.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Sample {
    /// The kind of the sample.
    pub kind: SampleKind,
    /// The GUID of the writer, if the network provides it.
    pub writer: Option<Guid>,
    /// Source timestamp, nanoseconds since the Unix epoch.
    pub source_timestamp_ns: i64,
    /// The hash of the key, if the topic has a key and the writer sent the hash.
    pub key_hash: Option<KeyHash>,
    /// Encapsulation header and body.
    pub payload: Bytes,
    /// `true` if the handler gets another sample at once, so that it may defer work that is cheaper for several
    /// samples. It is `false` for the last sample at hand.
    pub more: bool,
}

/// A handler that receives the samples of one reader in order. Closures that take samples implement it.
pub trait HandleSamples: Send {
    /// Handles a sample. It may block, which holds up only this reader.
    fn handle(&mut self, sample: Sample);

    /// Handles a sample on the thread that receives for all readers. Returns the sample if that could block; it is then
    /// handled by [`Self::handle`]. No other sample is at hand behind it.
    fn handle_at_once(&mut self, sample: Sample) -> Option<Sample> {
        Some(sample)
    }

    /// Reports samples that were dropped because newer ones arrived faster than they were handled.
    fn overrun(&mut self, samples: u64) {
        let _ = samples;
    }
}

impl<F: FnMut(Sample) + Send> HandleSamples for F {
    fn handle(&mut self, sample: Sample) {
        self(sample);
    }
}

/// The handler of a reader's samples.
pub type SampleHandler = Box<dyn HandleSamples>;

/// A handler of several readers, which takes their samples one at a time.
#[derive(Clone)]
pub struct SharedSamples(Arc<Mutex<SampleHandler>>);

impl SharedSamples {
    /// Shares a handler among readers, each of which has a clone of this.
    pub fn new(handler: SampleHandler) -> Self {
        Self(Arc::new(Mutex::new(handler)))
    }
}

impl HandleSamples for SharedSamples {
    fn handle(&mut self, sample: Sample) {
        lock(&self.0).handle(sample);
    }

    fn handle_at_once(&mut self, sample: Sample) -> Option<Sample> {
        // Another reader may hold it.
        match self.0.try_lock() {
            Ok(mut handler) => handler.handle_at_once(sample),
            Err(_) => Some(sample),
        }
    }

    fn overrun(&mut self, samples: u64) {
        lock(&self.0).overrun(samples);
    }
}

/// The client of a service and the number of its request: the sample identity of RPC over DDS 1.0 (7.5.1.1.1).
///
/// It holds everything that a reply needs, so that one server may answer a request that another server of the same
/// service received.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub struct RequestId {
    /// The GUID of the client's request writer, or the id in its place in the client's RPC mapping.
    pub client: [u8; 16],
    /// The number of the request.
    pub number: i64,
    /// At a server, the endpoint whose end in discovery means the end of the client, if the network provides it.
    pub asker: Option<Guid>,
}

/// A request that a client sent.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct SentRequest {
    /// The id under which the reply comes.
    pub id: RequestId,
    /// The request readers of the servers that got the request. A server that appears after the request was written is
    /// not among them, even if it appears before the sender returns.
    pub servers: BTreeSet<Guid>,
}

/// Both topics of a service, at its client or at its server.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct ServiceSpec {
    /// The topic of requests.
    pub request: EndpointSpec,
    /// The topic of replies.
    pub reply: EndpointSpec,
}

/// The reason for which a request or a reply of the local network is not handed over.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum UnhandledCall {
    /// Newer messages took its place, because they arrived faster than they were handled.
    Overrun,
    /// The message does not name its call.
    Unreadable,
}

/// A handler of requests at a server, or of replies at a client. Closures with both arguments of [`Self::handle`]
/// implement it.
pub trait HandleCalls: Send {
    /// Handles a message: encapsulation header and body, without the request id, which vendors encode in different
    /// places. It may block, which holds up no others.
    fn handle(&mut self, id: RequestId, payload: Bytes);

    /// Reports messages that are not handed over.
    fn unhandled(&mut self, why: UnhandledCall, messages: u64) {
        let _ = (why, messages);
    }

    /// Reports at a client that its network closed. Requests sent before get no answer.
    fn network_closed(&mut self) {}
}

impl<F: FnMut(RequestId, Bytes) + Send> HandleCalls for F {
    fn handle(&mut self, id: RequestId, payload: Bytes) {
        self(id, payload);
    }
}

/// The handler of a server's requests, or of the replies to a client.
pub type RequestHandler = Box<dyn HandleCalls>;

/// A client of a local service, until dropped. Calls may block, like those of [`RosWriter`].
pub trait RosClient: Send + Sync + 'static {
    /// Sends a request. The handler gets the reply under the returned id, possibly before this function returns.
    /// Waits briefly for a server, and fails with [`RosError::NoPeer`] if there is none.
    fn send(&self, payload: Bytes) -> Result<SentRequest, RosError>;

    /// Sends a request as [`Self::send`] does, and returns its id.
    fn request(&self, payload: Bytes) -> Result<RequestId, RosError> {
        self.send(payload).map(|sent| sent.id)
    }

    /// Returns the request readers of the current servers.
    fn servers(&self) -> BTreeSet<Guid>;

    /// Returns the current number of servers.
    fn matched_servers(&self) -> u32 {
        self.servers().len() as u32
    }

    /// Returns the GUIDs of the reader and the writer.
    fn guids(&self) -> [Guid; 2];
}

/// A server for local clients, until dropped. Calls may block, like those of [`RosWriter`].
pub trait RosServer: Send + Sync + 'static {
    /// Answers a request. Waits briefly until the client can receive the reply.
    fn reply(&self, request: &RequestId, payload: Bytes) -> Result<(), RosError>;

    /// Returns the GUIDs of the reader and the writer.
    fn guids(&self) -> [Guid; 2];
}

/// An endpoint that is shown in the local graph and matches no other, until dropped, which may block.
pub struct ShownEndpoint {
    /// The GUID.
    pub guid: Guid,
    _endpoint: Box<dyn Any + Send>,
}

impl ShownEndpoint {
    /// Wraps the entities that keep the endpoint in the graph until they are dropped.
    pub fn new(guid: Guid, entities: impl Any + Send) -> Self {
        Self { guid, _endpoint: Box::new(entities) }
    }
}

impl fmt::Debug for ShownEndpoint {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_struct("ShownEndpoint").field("guid", &self.guid).finish_non_exhaustive()
    }
}

/// A handler of discovery events. It runs on a thread of the network and must not block.
pub type DiscoveryHandler = Box<dyn FnMut(DiscoveryEvent) + Send>;

/// The reason why the local network failed.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
pub enum RosError {
    /// The DDS domain could not be joined.
    #[error("cannot join ROS domain {domain}: {reason}")]
    Domain {
        /// The domain id.
        domain: u32,
        /// The error of the implementation.
        reason: String,
    },
    /// An endpoint could not be created.
    #[error("cannot create a {kind} on {topic} [{type_name}]: {reason}")]
    Create {
        /// `"reader"` or `"writer"`.
        kind: &'static str,
        /// The DDS topic.
        topic: String,
        /// The DDS type.
        type_name: String,
        /// The error of the implementation.
        reason: String,
    },
    /// DDS Security forbids an endpoint that is shown in the graph.
    #[error("{file} grants enclave {enclave} no partition {partition} on {topic}")]
    ForbiddenPartition {
        /// The permissions file.
        file: String,
        /// The enclave.
        enclave: String,
        /// The partition of endpoints that are only shown.
        partition: &'static str,
        /// The DDS topic.
        topic: String,
    },
    /// The payload is not a serialised sample: it is shorter than its header or too long.
    #[error("a payload of {bytes} bytes is not a serialised sample")]
    Payload {
        /// The length in bytes.
        bytes: usize,
    },
    /// A reliable write was not accepted in time, because a local reader does not acknowledge.
    #[error("the local network accepted no sample for {waited_ms} ms")]
    WriteTimeout {
        /// The time for which the write blocked.
        waited_ms: u64,
    },
    /// The sample of a keyed topic lacks its key hash. Subscribers of ROS 2 Kilted crash with a segmentation fault
    /// without it.
    #[error(
        "the hash of its key is not known, without which subscribers of Fast DDS 3 end with a segmentation fault"
    )]
    KeyUnknown,
    /// The network is closed and is to be opened again.
    #[error("the local ROS 2 network is closed, and is opened again because this host's addresses changed")]
    Closed,
    /// No endpoint is there to receive a request or a reply.
    #[error("nobody on the local network was there to hear it for {waited_ms} ms")]
    NoPeer {
        /// The time waited.
        waited_ms: u64,
    },
    /// A write failed for another reason.
    #[error("write failed: {reason}")]
    Write {
        /// The error of the implementation.
        reason: String,
    },
}

/// The reach of a network, compared with the time when it was opened.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub enum Reach {
    /// The reach is unchanged.
    Whole,
    /// The reach may be smaller, because this host's addresses have changed. No program on another host is known to
    /// be cut off, or the addresses are still changing.
    Doubtful,
    /// Programs on other hosts are or may be cut off until the network is reopened.
    CutOff,
}

/// A local ROS 2 network.
///
/// Dropping the network ends discovery and waits for its threads. Dropping a reader or writer deletes the entity and
/// its topic, and waits for a handler at work.
pub trait RosNetwork: Send + Sync + 'static {
    /// A reader, until dropped.
    type Reader: Send + 'static;
    /// A writer, until dropped.
    type Writer: RosWriter;
    /// A client of a service, until dropped.
    type Client: RosClient;
    /// A server of a service, until dropped.
    type Server: RosServer;

    /// Starts discovery, and reports existing endpoints as appearances. Call once.
    fn discover(&self, handler: DiscoveryHandler) -> Result<(), RosError>;

    /// Creates a reader whose samples go to `handler`. Samples of writers that SGC created, in this process or
    /// another, are skipped, because they came through SGC already.
    fn create_reader(&self, spec: &EndpointSpec, handler: SampleHandler) -> Result<Self::Reader, RosError>;

    /// Creates a writer.
    fn create_writer(&self, spec: &EndpointSpec) -> Result<Self::Writer, RosError>;

    /// Creates a client that calls local servers. Replies go to `handler`. Servers that SGC created are ignored.
    fn create_client(&self, spec: &ServiceSpec, handler: RequestHandler) -> Result<Self::Client, RosError>;

    /// Creates a server. Requests of local clients go to `handler`, except those of clients that SGC created.
    fn create_server(&self, spec: &ServiceSpec, handler: RequestHandler) -> Result<Self::Server, RosError>;

    /// Returns the GUID of a reader created here.
    fn reader_guid(&self, reader: &Self::Reader) -> Guid;

    /// Returns the time since a local writer renewed its liveliness lease, by a message or without one. Returns
    /// `None` if it has not yet, and for writers that are not reliable, not manual by topic, or created by SGC. Does
    /// not block.
    fn renewed_ago(&self, writer: &Guid) -> Option<Duration> {
        let _ = writer;
        None
    }

    /// Returns `true` if nodes are reported and announced.
    fn has_graph(&self) -> bool;

    /// Returns the names of other SGC nodes that are on this network as well, as far as they are known.
    fn nodes_here(&self) -> BTreeSet<String> {
        BTreeSet::new()
    }

    /// Returns the router that the network needs and is not connected to, if its programs need one.
    fn missing_router(&self) -> Option<String> {
        None
    }

    /// Shows an endpoint that represents a remote one in the local graph, with its type, type hash and QoS except for
    /// history and partitions. It matches no endpoint, so it exchanges no data. May block.
    fn show(&self, kind: EndpointKind, spec: &EndpointSpec) -> Result<ShownEndpoint, RosError>;

    /// Announces these nodes in the local graph as this participant's, and no others. May block.
    fn announce(&self, nodes: &[GraphNode]) -> Result<(), RosError>;

    /// Returns the current reach.
    fn reach(&self) -> Reach {
        Reach::Whole
    }

    /// Returns `true` if a network that is opened now in the same way would reach programs that this one does not.
    /// After `false` the network is [`Reach::Whole`] until something changes. May block.
    ///
    /// # Errors
    /// The reason why no network could be opened.
    fn gains_by_reopening(&self) -> Result<bool, RosError> {
        Ok(true)
    }

    /// Ends discovery and the network, and waits, at most for `max`, until everything that was created on it is
    /// dropped. Returns `false` if something is left. May block.
    fn close(self: Arc<Self>, max: Duration) -> bool {
        let _ = max;
        true
    }
}

/// A raw writer. Calls may block (DDS reliability), so they belong on a thread that others do not wait for.
pub trait RosWriter: Send + Sync + 'static {
    /// Writes, disposes or unregisters. The sample may stay queued until the next call or [`Self::flush`], so that
    /// short samples share packets.
    fn write_ahead(&self, head: SampleHead, payload: Bytes) -> Result<(), RosError>;

    /// Writes, disposes or unregisters at once, with this source timestamp in nanoseconds since the Unix epoch.
    fn write(&self, kind: SampleKind, source_timestamp_ns: i64, payload: Bytes) -> Result<(), RosError> {
        let written = self.write_ahead(SampleHead::new(kind, source_timestamp_ns), payload);
        self.flush();
        written
    }

    /// Sends queued samples.
    fn flush(&self) {}

    /// Renews the liveliness lease without a sample, if it is manual by topic. May block.
    fn assert_liveliness(&self) {}

    /// Sets the number of samples that late joiners get from now on. Only a writer created with
    /// [`sgc_wire::History::UNSAID`] obeys, and never with more samples than before.
    fn set_late_depth(&self, depth: u32) {
        let _ = depth;
    }

    /// Returns the number of samples of this size that the writer keeps unacknowledged for reliable readers. Beyond
    /// it each write replaces the oldest sample, even if a reader lacks it. Returns `None` if the writer waits for
    /// its readers instead.
    fn kept(&self, bytes: usize) -> Option<u32> {
        let _ = bytes;
        None
    }

    /// Returns the number of written samples that a reliable reader has not acknowledged. Returns `None` if only
    /// waiting shows that.
    fn unacknowledged(&self) -> Option<u32> {
        None
    }

    /// Waits until all reliable readers have acknowledged everything. Returns `false` after `max`.
    fn wait_acknowledged(&self, max: Duration) -> bool {
        let _ = max;
        true
    }

    /// Returns the current number of matched local readers.
    fn matched_readers(&self) -> u32;

    /// Waits until this many local readers are matched, at most for `max`, and returns their number.
    fn wait_matched(&self, readers: u32, max: Duration) -> u32;

    /// Returns the GUID.
    fn guid(&self) -> Guid;
}
