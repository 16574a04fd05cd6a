//! The effects of an endpoint: frames, events and drops.

use std::fmt;
use std::time::Instant;

use sgc_trust::{GrantError, SignedError};
use sgc_wire::{
    Catalogue, Consumer, Control, Credentials, DescribedType, Name, NodeId, OperationAnswer, PathOffer,
    Recover, RefuseReason, Report, Role, SinkId, SourceId, TopicGrant, UnixMillis, Wish,
};

use crate::joins::{LostReason, RefusedBy};

/// Work for the driver.
#[derive(Clone, Debug)]
pub enum Output {
    /// Hand a frame to this node's router.
    Send(Control),
    /// An event for the user of this endpoint.
    Event(Event),
    /// A frame or body was dropped: count it and, where it matters, log it.
    Dropped(EndpointDrop),
    /// Nothing more to do until this time, or until something happens.
    Timeout(Option<Instant>),
}

/// An event.
#[derive(Clone, Debug)]
pub enum Event {
    /// A sink of a share was granted.
    SinkJoined {
        /// The share.
        name: Name,
        /// The sink.
        sink: SinkId,
        /// The sink's node.
        peer: NodeId,
        /// Whether it receives or publishes.
        role: Role,
    },
    /// A sink of a share is gone.
    SinkLeft {
        /// The share.
        name: Name,
        /// The sink.
        sink: SinkId,
        /// The sink's node.
        peer: NodeId,
    },
    /// A sink of a share lost its right; a new epoch begins for the others.
    SinkCut {
        /// The share.
        name: Name,
        /// The sink.
        sink: SinkId,
        /// The sink's node.
        peer: NodeId,
        /// The reason.
        reason: RefuseReason,
    },
    /// An epoch of a share begins: its sources publish under this key from now on.
    Rekeyed {
        /// The share.
        name: Name,
        /// The new key.
        grant: TopicGrant,
    },
    /// Key and sources for this node's own sink of a share that others publish on.
    OwnGrant {
        /// The share.
        name: Name,
        /// Key and sources.
        grant: TopicGrant,
    },
    /// A member asks this authority for a certificate; [`crate::Endpoint::answer_renewal`] answers.
    RenewAsked {
        /// The sink to answer.
        sink: SinkId,
        /// The member.
        peer: sgc_trust::VerifiedPeer,
        /// Signing request (PKCS #10), DER.
        csr: bytes::Bytes,
    },
    /// The authority sent credentials.
    Renewed {
        /// Certificate and secrets.
        credentials: Credentials,
    },
    /// The authority does not give this node credentials.
    RenewRefused {
        /// The refusing node, with the reason.
        by: RefusedBy,
    },
    /// A node of this fleet asks this authority for an operation; [`crate::Endpoint::answer_operation`] answers.
    OperationAsked {
        /// The sink to answer.
        sink: SinkId,
        /// The node.
        peer: sgc_trust::VerifiedPeer,
        /// An encoded [`sgc_wire::OperationRequest`], not verified.
        request: bytes::Bytes,
    },
    /// An authority answered an operation.
    OperationAnswered {
        /// The name of the request.
        name: Name,
        /// The answer.
        answer: OperationAnswer,
    },
    /// An authority, or a router before it, refuses requests for operations.
    OperationDenied {
        /// The name of the request.
        name: Name,
        /// The refusing node, with the reason.
        by: RefusedBy,
    },
    /// A node of this fleet asks for a report; [`crate::Endpoint::answer_report`] answers.
    ReportAsked {
        /// The sink to answer.
        sink: SinkId,
        /// The node.
        peer: sgc_trust::VerifiedPeer,
        /// An encoded [`sgc_wire::ReportQuestion`], not verified.
        question: bytes::Bytes,
    },
    /// A node sent a report.
    Report {
        /// The name of the question.
        name: Name,
        /// The report.
        report: Report,
    },
    /// A node, or a router before it, refuses a report.
    ReportRefused {
        /// The name of the question.
        name: Name,
        /// The refusing node, with the reason.
        by: RefusedBy,
    },
    /// A node of this fleet asks for the addresses of this one; [`crate::Endpoint::answer_path`] answers.
    PathAsked {
        /// The sink to answer.
        sink: SinkId,
        /// The node.
        peer: sgc_trust::VerifiedPeer,
        /// An encoded [`sgc_wire::PathQuestion`], not verified.
        question: bytes::Bytes,
    },
    /// A node told its addresses.
    PathOffered {
        /// The node.
        peer: NodeId,
        /// Its addresses, and what checks of them need.
        offer: PathOffer,
    },
    /// A node, or a router before it, refuses its addresses.
    PathRefused {
        /// The node.
        peer: NodeId,
        /// The refusing node, with the reason.
        by: RefusedBy,
    },
    /// A node told the time by its clock, some time between the question and now.
    Time {
        /// The node.
        peer: NodeId,
        /// Time of the question.
        asked: Instant,
        /// The time by the node's clock.
        time: UnixMillis,
    },
    /// A member asked to follow what this node shares. The event repeats with each request of that member.
    Followed {
        /// The member.
        peer: Box<sgc_trust::VerifiedPeer>,
    },
    /// A request to join a share was refused.
    SinkRefused {
        /// The share.
        name: Name,
        /// The requester.
        peer: NodeId,
        /// The reason.
        reason: RefuseReason,
    },
    /// A granted sink asks one of this node's sources for messages.
    Recover(Recover),
    /// A granted sink confirms that it has everything of one of this node's sources up to a number.
    Confirmed {
        /// The name.
        name: Name,
        /// The source.
        source: SourceId,
        /// The node of the sink.
        peer: NodeId,
        /// The number.
        seq: u64,
    },
    /// A join was granted, or its grant changed.
    Granted {
        /// The name.
        name: Name,
        /// The granted sink; another one after the route to the owner changed.
        sink: SinkId,
        /// Key and sources.
        grant: TopicGrant,
    },
    /// A join was refused; it will be tried again.
    Refused {
        /// The name.
        name: Name,
        /// The refusing node, with the reason.
        by: RefusedBy,
    },
    /// A granted join carries nothing until it is granted again.
    Lost {
        /// The name.
        name: Name,
        /// The reason.
        reason: LostReason,
    },
    /// An owner's descriptions of requested types of its interfaces; not verified yet.
    Types {
        /// The owner.
        owner: NodeId,
        /// The types.
        types: Vec<DescribedType>,
    },
    /// A node's consumers of this node's interfaces, whenever they change; not limited to interfaces that were granted
    /// to it.
    Consumers {
        /// The node.
        peer: NodeId,
        /// Its consumers.
        consumers: Vec<Consumer>,
    },
    /// A node does not report its consumers any more, until the next [`Event::Consumers`].
    ConsumersLost {
        /// The node.
        peer: NodeId,
        /// The reason.
        reason: LostReason,
    },
    /// A node told its wishes about this node's topics: all of them, and again after each change.
    Wishes {
        /// The node.
        peer: NodeId,
        /// Its wishes.
        wishes: Vec<Wish>,
    },
    /// A node does not tell its wishes any more, until the next [`Event::Wishes`].
    WishesLost {
        /// The node.
        peer: NodeId,
        /// The reason.
        reason: LostReason,
    },
    /// A followed owner's catalogue, whenever it changes.
    Catalogue {
        /// The owner.
        owner: NodeId,
        /// Its shares, as this node may see them.
        catalogue: Catalogue,
    },
    /// A followed owner is out of reach; its catalogue stands until the next one comes.
    OwnerLost {
        /// The owner.
        owner: NodeId,
        /// The reason.
        reason: LostReason,
    },
    /// A followed owner does not answer with a catalogue.
    OwnerRefused {
        /// The owner.
        owner: NodeId,
        /// The refusing node, with the reason.
        by: RefusedBy,
    },
}

/// A kind of signed body.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum SignedKind {
    /// An advertisement.
    Advert,
    /// A request to join a name.
    Join,
    /// An owner's answer.
    Answer,
}

impl fmt::Display for SignedKind {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(match self {
            Self::Advert => "advertisement",
            Self::Join => "join",
            Self::Answer => "answer",
        })
    }
}

/// A kind of frame that has no purpose here, or not now.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum UnexpectedFrame {
    /// A greeting of a link.
    Hello,
    /// An interest in names, or its end.
    Interest,
    /// The end of a link.
    Goodbye,
    /// A revocation list.
    Crl,
    /// A router's links.
    LinkState,
    /// A query for names.
    Query,
    /// A label of a link, or its acknowledgement.
    Label,
    /// A probe of a link.
    Probe,
    /// A router's clock.
    Clock,
    /// A notice that another node uses the identity.
    IdentityInUse,
    /// An observed address, which goes over one link.
    ObservedAddress,
    /// A frame about lanes.
    Lane,
    /// A notice of a better route for a sink that this node does not have.
    Reroute,
    /// An answer to no request of this node.
    Answer,
    /// A rejection of no request of this node.
    Reject,
    /// A grant of another kind than the request.
    GrantKind,
    /// A request that is older than the one known of its sink or node.
    OlderRequest,
    /// An acknowledgement for a name that this node does not share.
    Ack,
    /// A request for messages from a sink that receives none.
    Recover,
}

impl fmt::Display for UnexpectedFrame {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(match self {
            Self::Hello => "hello",
            Self::Interest => "interest",
            Self::Goodbye => "goodbye",
            Self::Crl => "revocation list",
            Self::LinkState => "link state",
            Self::Query => "query",
            Self::Label => "label",
            Self::Probe => "probe",
            Self::Clock => "clock",
            Self::IdentityInUse => "identity",
            Self::ObservedAddress => "address",
            Self::Lane => "lane",
            Self::Reroute => "reroute",
            Self::Answer => "answer",
            Self::Reject => "reject",
            Self::GrantKind => "kind of grant",
            Self::OlderRequest => "older request",
            Self::Ack => "acknowledgement",
            Self::Recover => "recover",
        })
    }
}

/// The reason why a frame or body was dropped.
#[derive(Clone, Debug, thiserror::Error)]
pub enum EndpointDrop {
    /// A signed body that does not verify.
    #[error("{what} not believed: {why}")]
    NotVerified {
        /// The kind of the body.
        what: SignedKind,
        /// The error of the verification.
        why: SignedError,
    },
    /// A grant that does not open.
    #[error("grant not usable: {0}")]
    Grant(#[from] GrantError),
    /// A frame without a purpose here.
    #[error("unexpected {what}")]
    Unexpected {
        /// Kind of frame.
        what: UnexpectedFrame,
    },
    /// A catalogue too large to be sent; the requester got as many entries as fit.
    #[error("the catalogue for one node is too large: {left_out} entries left out")]
    CatalogueTooLarge {
        /// Number of missing entries.
        left_out: usize,
    },
    /// The holder of an invitation asks for more than its identity.
    #[error("node {} holds an invitation, and asks for more than its identity", peer.short())]
    Invited {
        /// The holder.
        peer: NodeId,
    },
}

impl EndpointDrop {
    /// Returns `true` if an operator should hear of it. Answers cross with repeated requests, so unexpected frames are
    /// ordinary while nodes start.
    pub fn is_suspicious(&self) -> bool {
        !matches!(self, Self::Unexpected { .. })
    }

    /// Returns a short, stable name for counters.
    pub fn key(&self) -> &'static str {
        match self {
            Self::NotVerified { .. } => "endpoint_not_verified",
            Self::Grant(_) => "endpoint_grant",
            Self::Unexpected { .. } => "endpoint_unexpected",
            Self::CatalogueTooLarge { .. } => "endpoint_catalogue_too_large",
            Self::Invited { .. } => "endpoint_invited",
        }
    }
}
