//! Names, metadata, packets and the bounded codec of SGC.
//!
//! Everything that two nodes must agree on byte for byte is here, and nothing else: no cryptography (that is
//! `sgc-trust`), no state (that is `sgc-router` and `sgc-endpoint`), no input or output. The normative
//! text is `docs/spec/wire.md` and `docs/spec/names.md`.
#![forbid(unsafe_code)]

mod catalogue;
mod clock;
mod codec;
mod consumers;
mod control;
mod ids;
mod message;
mod metadata;
mod operation;
mod packet;
mod path;
mod qos;
mod report;
mod ros_node;
mod slab;
mod type_descriptions;
mod wish;

pub use catalogue::{
    CATALOGUE_ENTRIES_MAX, Catalogue, CatalogueEntry, CatalogueSource, Credentials, ENTRY_SOURCES_MAX,
    GRANT_SOURCES_MAX, GrantContent, RECEIVER_KEY_SUITES, ReceiverKey, SECRET_GENERATIONS_MAX,
    SecretGeneration, SourceAnnounce, TopicGrant,
};
pub use clock::{ClockWatch, PeerClock};
pub use codec::{Decode, DecodeError, Encode, Reader, Writer};
pub use consumers::{CONSUMERS_MAX, CONSUMERS_PER_INTERFACE_MAX, Consumer};
pub use control::{
    ADJACENCIES_MAX, ADVERT_NAMES_MAX, ASK_BYTES_MAX, ATTACHED_MAX, Adjacency, AdvertBody, Answer,
    AnswerBody, CERT_BYTES_MAX, CHAIN_CERTS_MAX, CONTROL_FRAME_BYTES_MAX, CRL_BYTES_MAX, CSR_BYTES_MAX,
    Control, Hello, JoinBody, LinkStateBody, MINOR_OBSERVED_ADDRESS, MINOR_VERSION, NAMES_PER_FRAME_MAX,
    Place, REPLY_KEY_BYTES_MAX, Recover, RefuseReason, RejectReason, Request, Role, SEALED_BYTES_MAX,
    SIGNATURE_BYTES_MAX, SOURCE_KEY_BYTES_MAX, SignedBody, SourceOffer,
};
pub use ids::{
    Blind, GroupTag, LABELS_MAX, Label, LaneToken, Name, NodeId, NodeTag, Now, ParseIdError, Pseudonym,
    SecretBytes, SinkId, SourceId, UnixMillis,
};
pub use message::{
    KEY_HASH_BYTES, MESSAGE_HEAD_BYTES, MessageHead, MessageKind, PayloadEncoding, PayloadForm,
};
pub use metadata::{Kind, METADATA_FIELD_BYTES_MAX, METADATA_VERSION, Metadata};
pub use operation::{
    Challenge, INVITATION_ROUTERS_MAX, Operation, OperationAnswer, OperationRefusal, OperationRequest,
    REDEEM_SINK, REFUSAL_DETAIL_BYTES_MAX, REVOKED_AT_ONCE_MAX, ROSTER_ROWS_MAX, ROUTER_BYTES_MAX,
    ROW_CERTIFICATES_MAX, RosterPage, RosterRow, RowCertificate, SecretText,
};
pub use packet::{
    AssociatedData, Class, HEADER_BYTES, HEADER_BYTES_MAX, HOP_LIMIT, LABEL_SAVES_BYTES, MESSAGE_BYTES_MAX,
    PACKET_VERSION, PAYLOAD_BYTES_MAX, Packet, PacketHeader, Payload,
};
pub use path::{
    CandidateKind, PATH_CANDIDATES_MAX, PATH_OFFER_BYTES, PathCandidate, PathOffer, PathQuestion,
};
pub use qos::{Durability, History, Liveliness, Qos, Reliability, Representations};
pub use report::{
    REPORT_BYTES_MAX, REPORT_INTERFACE_BYTES_MAX, REPORT_PACKED_BYTES_MAX, Report, ReportQuestion,
};
pub use ros_node::RosNode;
pub use slab::Slab;
pub use type_descriptions::{
    DescribedType, TYPE_DESCRIPTION_BYTES_MAX, TYPE_HASH_BYTES_MAX, TYPES_PER_QUESTION_MAX, TypeQuestion,
};
pub use wish::{WISHES_MAX, Wish};
