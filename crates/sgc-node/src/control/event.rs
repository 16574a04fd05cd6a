//! Events of the control task: everything that other tasks and threads tell or ask it.

use std::sync::Arc;

use rand_chacha::ChaCha20Rng;
use sgc_config::RotationConfig;
use sgc_ros::{
    DiscoveryEvent, EndpointKind, EndpointSpec, Guid, RosClient, RosServer, Routes, ServiceSpec, ShareRule,
    ShownEndpoint, UseRule,
};
use sgc_router::{LinkId, PathKind, StoreEvent};
use sgc_transport::{AnyLink, CheckDatagram};
use sgc_trust::{CrlError, Grantees, Identity, NodeName, TrustAnchors};
use sgc_wire::{Control, Name, NodeId, Operation, OperationAnswer, Report, ReportQuestion, SourceId};
use tokio::sync::oneshot;

use crate::admin::graph::Graph;
use crate::admin::report::ReportRights;
use crate::admin::status::Status;
use crate::control::fleet::authority::DeskAnswers;
use crate::control::fleet::inquiries::{InquiryAnswer, InquiryTarget};
use crate::control::fleet::members::MemberNames;
use crate::control::fleet::operations::OperationError;
use crate::control::peers::control_queue::{FrameRoom, InboxShare};
use crate::control::types::type_jobs::TypeOutcome;
use crate::data::dataplane::DataPlane;
use crate::data::dead_man::ResumeError;
use crate::data::outflow::OutFlow;
use crate::data::sending::message_keys::MessageKeys;
use crate::data::tap::{Tap, TapError, TapRequest};
use crate::data::writer_queue::WriterQueue;
use crate::link::control_tx::ControlTx;
use crate::link::direct_address::HostAddress;
use crate::link::mapping_report::MappingReport;
use crate::metrics::readings::Readings;

/// Events that may wait for the control task. Senders wait while it is full.
pub(crate) const INBOX_MAX: usize = 4096;

/// Event for the control task.
pub(crate) enum CoreEvent {
    /// A link was made.
    LinkUp {
        /// The link.
        link: AnyLink,
        /// URL, if this node dialled.
        url: Option<String>,
        /// Queue of its control frames.
        control: ControlTx,
        /// Receives the link's place, or `None` if the node is stopping.
        reply: oneshot::Sender<Option<LinkPlace>>,
    },
    /// The configuration was read again.
    ConfigurationRead {
        /// The changes that need a restart, or the mistakes for which it was refused.
        outcome: Result<Vec<String>, String>,
    },
    /// A link ended.
    LinkDown {
        /// The link.
        id: LinkId,
        /// Place of another process with this node's identity, if the peer closed the link for it.
        in_use: Option<String>,
        /// How it ended, in words.
        end: Option<String>,
    },
    /// A control frame arrived.
    Frame {
        /// The link.
        link: LinkId,
        /// The frame.
        frame: Control,
        /// Its room in the inbox.
        room: FrameRoom,
    },
    /// A datagram that looks like a connectivity check arrived.
    Check(CheckDatagram),
    /// The addresses of this host changed, or are known for the first time.
    HostAddresses(Vec<HostAddress>),
    /// The state of the port mapping changed.
    PortMapping(MappingReport),
    /// News from the store of names.
    Store(StoreEvent),
    /// No direct link to this peer was made.
    NotDialled(NodeId),
    /// A link has taken all control frames before a flush.
    Flushed {
        /// The link.
        link: LinkId,
    },
    /// A malformed control frame arrived.
    Malformed {
        /// The link.
        link: LinkId,
    },
    /// The local graph changed.
    Discovery(DiscoveryEvent),
    /// The local network is about to close and to open again. Answered once the control task holds nothing of it.
    CloseNetwork(oneshot::Sender<()>),
    /// The local network is open again. Its discovery events follow.
    NetworkReopened,
    /// The local network could not be opened again so far, for this reason.
    NetworkStaysClosed(String),
    /// A local writer was created, or failed.
    WriterReady {
        /// The joined name.
        name: Name,
        /// The source whose messages it writes.
        source: Option<SourceId>,
        /// The requested endpoint.
        spec: EndpointSpec,
        /// Its queue.
        writer: Option<Arc<WriterQueue>>,
    },
    /// A local reader was created.
    ReaderReady {
        /// The share.
        name: Name,
        /// The requested endpoint.
        spec: EndpointSpec,
        /// Its GUID on the local network.
        guid: Guid,
        /// Owner of the reader. Dropping it closes the reader.
        reader: Box<dyn std::any::Any + Send>,
    },
    /// The local endpoints that stand for a far consumer were created, or failed.
    ConsumerShown {
        /// The consumer.
        key: ConsumerKey,
        /// The requested endpoints with the created ones.
        ends: Vec<(EndpointKind, EndpointSpec, ShownEndpoint)>,
    },
    /// A service's local client or server was created.
    ServiceReady {
        /// The share or the joined name.
        name: Name,
        /// The requested service.
        spec: ServiceSpec,
        /// The client or server.
        end: ServiceEnd,
    },
    /// The node joined the local network after its start. The rules follow.
    NetworkJoined(Box<Routes<ChaCha20Rng>>),
    /// The configuration changed. Answered when the change is under way.
    Reload {
        /// The identity in the replaced file, if it was replaced.
        identity: Option<Arc<Identity>>,
        /// The new shares.
        shares: Vec<ShareRule>,
        /// The new uses.
        uses: Vec<UseRule>,
        /// The new trust anchors with kept revocation lists, if they change.
        anchors: Option<TrustAnchors>,
        /// Keys for suites that were not in use.
        message_keys: MessageKeys,
        /// The names of members in these rules.
        member_names: MemberNames,
        /// The peers that may ask this node how it is doing.
        observers: Grantees,
        /// The peers that may have direct links.
        direct: Grantees,
        /// Whether the gateway is asked to map a port for these.
        port_mapping: bool,
        /// The peers that may change the fleet of which this node is the authority.
        operators: Grantees,
        /// The rate that each peer may send, bits a second; `None` for no limit.
        peer_rate: Option<u64>,
        /// The ends of epochs.
        rotation: RotationConfig,
        /// The rights that it tells them.
        rights: Arc<ReportRights>,
        /// Notified when the change is under way.
        reply: oneshot::Sender<()>,
    },
    /// The authority's desk answered requests for renewal and carried out operations.
    DeskAnswered(DeskAnswers),
    /// A user asks an authority for an operation on the fleet.
    Operate {
        /// The authority's name.
        at: NodeName,
        /// The operation.
        operation: Operation,
        /// The channel for the answer.
        reply: oneshot::Sender<Result<OperationAnswer, OperationError>>,
    },
    /// A user asks a node of the fleet for a report.
    Inquire {
        /// The node.
        at: InquiryTarget,
        /// The question.
        question: ReportQuestion,
        /// The only kind of path to take; `None` for any.
        over: Option<PathKind>,
        /// The channel for the document.
        reply: oneshot::Sender<InquiryAnswer>,
    },
    /// A report for observers was made; `None` if it is too long.
    ReportMade(ReportQuestion, Option<Report>),
    /// A user brings a revocation list. Answered with whether it is new, and with the lists that were in force before.
    Crl {
        /// The list, DER.
        der: bytes::Bytes,
        /// The channel for the answer.
        reply: oneshot::Sender<Result<(bool, Vec<bytes::Bytes>), CrlError>>,
    },
    /// Signing keys of these suites were created.
    MessageKeys(MessageKeys),
    /// A search for a type ended.
    TypeLookedFor(TypeOutcome),
    /// Asks whether the control task still works. The answer comes behind everything that came before.
    Ping(oneshot::Sender<()>),
    /// Metrics are asked for.
    Readings(oneshot::Sender<Box<Readings>>),
    /// Asks for the status.
    Status(oneshot::Sender<Status>),
    /// Asks for the graph, also of a name that is not in use here.
    Graph(Option<Name>, oneshot::Sender<Graph>),
    /// Lets commands pass the dead-man switches of this topic.
    Resume(String, oneshot::Sender<Result<(), ResumeError>>),
    /// Asks for a tap.
    Tap(TapRequest, oneshot::Sender<Result<Tap, TapError>>),
    /// Stop receiving. Answered with the queues that still have to drain.
    Quiesce(oneshot::Sender<Vec<Arc<OutFlow>>>),
    /// Withdraw the shares and say goodbye. Answered with the links, which the peers then close.
    Stop(oneshot::Sender<Vec<AnyLink>>),
}

/// The place of a link at this node.
pub(crate) struct LinkPlace {
    /// Its number.
    pub(crate) id: LinkId,
    /// Data path for its packets.
    pub(crate) data: Arc<DataPlane>,
    /// Its share of the inbox.
    pub(crate) inbox: InboxShare,
}

/// This node's end of a service on the local network.
pub(crate) enum ServiceEnd {
    /// A client that calls local servers.
    Client(Arc<dyn RosClient>),
    /// A server that local clients call.
    Server(Arc<dyn RosServer>),
}

/// Key of a far consumer.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub(crate) struct ConsumerKey {
    /// The share that it uses.
    pub(crate) interface: Name,
    /// SGC node of the consumer.
    pub(crate) peer: NodeId,
    /// Id of the consumer at its node.
    pub(crate) id: [u8; 8],
}
