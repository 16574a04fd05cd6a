//! Names of the counters of drops and refusals.
//!
//! [`NodeDrop`] has those of the driver itself. The machines and the data path have enums of their own, which implement
//! [`DropKind`], too. `sgc-diagnosis` explains each counter.

use sgc_endpoint::{CallLoss, EndpointDrop, SinkDrop};
use sgc_router::DropReason;
use sgc_wire::OperationRefusal;

/// Reasons of drops and refusals that are counted.
pub(crate) trait DropKind {
    /// Returns the counter's name.
    fn key(&self) -> &'static str;
}

/// Drops and refusals that the driver counts itself.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub enum NodeDrop {
    /// A neighbour's control frame is malformed.
    MalformedControl,
    /// A peer does not take its control frames.
    ControlQueueFull,
    /// Another process uses this node's identity.
    IdentityInUse,
    /// A peer's clock differs from the one here.
    ClocksDiffer,
    /// A node asked for a share that it may not have.
    JoinRefused,
    /// Too many sinks ask for a history at once.
    ReplaysFull,
    /// The authority gives this node no new certificate.
    RenewalRefused,
    /// The credentials from the authority do not match this node's key.
    CredentialsUnusable,
    /// A node asked this authority for credentials again too soon.
    RenewalTooSoon,
    /// Too many nodes wait for credentials of this authority.
    RenewalQueueFull,
    /// This authority could not use the fleet file for credentials.
    RenewalFleetFile,
    /// The roster lacks the node that asks for credentials.
    RenewalUnknownNode,
    /// The node that asks for credentials is revoked.
    RenewalRevoked,
    /// No certificate can be made for a request for credentials.
    RenewalUnusable,
    /// A node that is no operator requested an operation.
    OperationNotPermitted,
    /// A node that is no observer asked for a report.
    ReportNotPermitted,
    /// A node that may have no direct link asked for the addresses of this one.
    DirectNotPermitted,
    /// A peer named an address to which no checks go.
    CandidateRefused,
    /// A check was not sent, because the peer's offer was too short for more.
    CheckWithheld,
    /// A check arrived while too many waited.
    CheckOverflowed,
    /// A datagram of a DTLS link arrived while too many waited.
    DtlsOverflowed,
    /// An operation was requested again, and not carried out again.
    OperationRepeated,
    /// The local definition of a type differs from the announced one.
    TypeDiffers,
    /// An owner's description of a type does not match its hash.
    TypeRefused,
    /// A type is too large to be described.
    TypeNotDescribed,
    /// There is no room for another type.
    TypesFull,
    /// Descriptions of types come faster than they are verified.
    TypesBusy,
    /// The search for a type panicked.
    TypeFailed,
    /// A message is JSON, and its type is unknown here.
    JsonUnknownType,
    /// A message is JSON that does not match its type.
    JsonRefused,
    /// A message does not decompress.
    Decompress,
    /// A message is shorter than the hash of its key.
    KeyHash,
    /// A keyed message came without the hash of its key.
    KeyUnknown,
    /// A transform could not be given the prefix of its frames.
    Frames,
    /// The local network refused a reader.
    CreateReader,
    /// The local network refused a writer.
    CreateWriter,
    /// The local network refused an end of a service.
    CreateService,
    /// The local network could not be told of far nodes.
    AnnounceNodes,
    /// The local network could not be shown a far subscriber or client.
    ShowConsumer,
    /// The enclave may not show far subscribers and clients.
    ConsumersForbidden,
    /// More local subscribers and clients use an interface than its owner is told of.
    ConsumersUntold,
    /// More far subscribers and clients are known than the local graph shows.
    ConsumersUnshown,
    /// No local server or client was there for a call.
    NoLocalPeer,
    /// A reply belongs to no open call.
    ReplyToNothing,
    /// A message could not be given to the local network.
    WritePayload,
    /// A reliable local subscriber took nothing for too long.
    WriteTimeout,
    /// The local network did not take a message.
    WriteFailed,
    /// A source no longer keeps messages that were lost on the way.
    SinkLost,
    /// A peer sent more than its rate.
    OverRate,
    /// More nodes announce themselves on the local network than are remembered.
    MdnsCrowded,
    /// An announcement on the local network is of another version.
    MdnsUnknown,
    /// Announcements on the local network come faster than they are read.
    MdnsOverrun,
    /// Records could not be written into the audit log.
    AuditLost,
    /// Records of one peer came too fast for the audit log, which has their number.
    AuditSummedUp,
}

impl NodeDrop {
    /// Returns a short, stable name for counters.
    pub const fn key(self) -> &'static str {
        match self {
            Self::MalformedControl => "malformed_control",
            Self::ControlQueueFull => "control_queue_full",
            Self::IdentityInUse => "identity_in_use",
            Self::ClocksDiffer => "clocks_differ",
            Self::JoinRefused => "join_refused",
            Self::ReplaysFull => "replays_full",
            Self::RenewalRefused => "renewal_refused",
            Self::CredentialsUnusable => "credentials_unusable",
            Self::RenewalTooSoon => "renewal_too_soon",
            Self::RenewalQueueFull => "renewal_queue_full",
            Self::RenewalFleetFile => "renewal_fleet_file",
            Self::RenewalUnknownNode => "renewal_unknown_node",
            Self::RenewalRevoked => "renewal_revoked",
            Self::RenewalUnusable => "renewal_unusable",
            Self::OperationNotPermitted => "operation_not_permitted",
            Self::ReportNotPermitted => "report_not_permitted",
            Self::DirectNotPermitted => "direct_not_permitted",
            Self::CandidateRefused => "candidate_refused",
            Self::CheckWithheld => "check_withheld",
            Self::CheckOverflowed => "check_overflowed",
            Self::DtlsOverflowed => "dtls_overflowed",
            Self::OperationRepeated => "operation_repeated",
            Self::TypeDiffers => "type_differs",
            Self::TypeRefused => "type_refused",
            Self::TypeNotDescribed => "type_not_described",
            Self::TypesFull => "types_full",
            Self::TypesBusy => "types_busy",
            Self::TypeFailed => "type_failed",
            Self::JsonUnknownType => "json_unknown_type",
            Self::JsonRefused => "json_refused",
            Self::Decompress => "decompress",
            Self::KeyHash => "key_hash",
            Self::KeyUnknown => "key_unknown",
            Self::Frames => "frames",
            Self::CreateReader => "create_reader",
            Self::CreateWriter => "create_writer",
            Self::CreateService => "create_service",
            Self::AnnounceNodes => "announce_nodes",
            Self::ShowConsumer => "show_consumer",
            Self::ConsumersForbidden => "consumers_forbidden",
            Self::ConsumersUntold => "consumers_untold",
            Self::ConsumersUnshown => "consumers_unshown",
            Self::NoLocalPeer => "no_local_peer",
            Self::ReplyToNothing => "reply_to_nothing",
            Self::WritePayload => "write_payload",
            Self::WriteTimeout => "write_timeout",
            Self::WriteFailed => "write_failed",
            Self::SinkLost => "sink_lost",
            Self::OverRate => "over_rate",
            Self::MdnsCrowded => "mdns_crowded",
            Self::MdnsUnknown => "mdns_unknown",
            Self::MdnsOverrun => "mdns_overrun",
            Self::AuditLost => "audit_lost",
            Self::AuditSummedUp => "audit_summed_up",
        }
    }
}

impl DropKind for NodeDrop {
    fn key(&self) -> &'static str {
        NodeDrop::key(*self)
    }
}

impl DropKind for &DropReason {
    fn key(&self) -> &'static str {
        DropReason::key(self)
    }
}

impl DropKind for &EndpointDrop {
    fn key(&self) -> &'static str {
        EndpointDrop::key(self)
    }
}

impl DropKind for SinkDrop {
    fn key(&self) -> &'static str {
        SinkDrop::key(self)
    }
}

impl DropKind for CallLoss {
    fn key(&self) -> &'static str {
        CallLoss::key(*self)
    }
}

impl DropKind for OperationRefusal {
    fn key(&self) -> &'static str {
        OperationRefusal::key(*self)
    }
}
