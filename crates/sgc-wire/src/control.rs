//! Control frames between neighbours, and the signed bodies that travel in them from end to end.
//!
//! A frame is one type byte and its fields. A signed body is kept as the bytes that were signed ([`SignedBody`]), so
//! that no re-encoding can change the signed content. `sgc-trust` checks signatures, `sgc-router` and `sgc-endpoint`
//! act on frames.

use std::net::{IpAddr, Ipv6Addr, SocketAddr};

use bytes::Bytes;

use crate::codec::{Decode, DecodeError, Encode, Reader, Writer};
use crate::ids::{Blind, Label, LaneToken, Name, NodeId, NodeTag, SinkId, SourceId, UnixMillis};

/// Longest control frame, bytes.
pub const CONTROL_FRAME_BYTES_MAX: usize = 1024 * 1024;
/// Most names in one advertisement.
pub const ADVERT_NAMES_MAX: usize = 256;
/// Most routers that one node is linked to.
pub const ADJACENCIES_MAX: usize = 1024;
/// Most other nodes that are linked to one router.
pub const ATTACHED_MAX: usize = 16_384;
/// Most names in one interest or query, or in one notice of unreachable names.
pub const NAMES_PER_FRAME_MAX: usize = 4096;
/// Most certificates in a chain, leaf first.
pub const CHAIN_CERTS_MAX: usize = 4;
/// Longest certificate, bytes.
pub const CERT_BYTES_MAX: usize = 4096;
/// Longest signature, bytes (RSA 4096).
pub const SIGNATURE_BYTES_MAX: usize = 512;
/// Longest public key for replies, bytes (room for hybrid post-quantum keys).
pub const REPLY_KEY_BYTES_MAX: usize = 2048;
/// Longest certificate revocation list, bytes: some 6000 entries.
pub const CRL_BYTES_MAX: usize = 256 * 1024;
/// Longest certificate signing request, bytes.
pub const CSR_BYTES_MAX: usize = 4096;
/// Longest question to an owner, bytes: a signing request is one.
pub const ASK_BYTES_MAX: usize = 2 * CSR_BYTES_MAX;
/// Longest public key of message signatures, bytes (SubjectPublicKeyInfo of RSA 4096).
pub const SOURCE_KEY_BYTES_MAX: usize = 640;
/// Longest sealed content of an answer, bytes.
pub const SEALED_BYTES_MAX: usize = 768 * 1024;

/// A frame between neighbours.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum Control {
    /// First on every link, both ways.
    Hello(Hello),
    /// A signed advertisement, and the sender's distance from its owner.
    Advert {
        /// Cost of the route from the sender to the owner, microseconds of round trip; the owner's own node sends 0.
        /// Between routers it means nothing: they know the topology.
        cost: u32,
        /// An [`AdvertBody`].
        signed: SignedBody,
    },
    /// The sender can no longer reach these names.
    Unreach {
        /// The names.
        names: Vec<Name>,
    },
    /// The sender wants to know the places of these names.
    Interest {
        /// The names.
        names: Vec<Name>,
    },
    /// The sender no longer wants to know the places of these names.
    Uninterest {
        /// The names.
        names: Vec<Name>,
    },
    /// A signed request to join a name's tree; travels towards the owner.
    Join {
        /// Name and sink as in the body, for routers that only pass it on.
        signed: SignedBody,
    },
    /// A sink has left; travels towards the owner.
    Leave {
        /// Name.
        name: Name,
        /// Sink.
        sink: SinkId,
    },
    /// The owner's signed answer to a join; travels along the branch to the sink.
    Answer {
        /// An [`AnswerBody`].
        signed: SignedBody,
    },
    /// A router refuses a join, or cuts a branch.
    Reject {
        /// Name.
        name: Name,
        /// Sink.
        sink: SinkId,
        /// The reason.
        reason: RejectReason,
    },
    /// A sink asks a source of its name for lost messages; travels towards the owner.
    Recover(Recover),
    /// The sender closes in good order: all its advertisements are withdrawn.
    Goodbye,
    /// A certificate revocation list (RFC 5280, 5), DER, signed by its CA. Sent first behind the greeting, and again
    /// whenever a newer one is known.
    Crl {
        /// The list.
        der: Bytes,
    },
    /// A sink holds the grant of the answer with this serial; travels towards the owner.
    Ack {
        /// Name.
        name: Name,
        /// Sink.
        sink: SinkId,
        /// Serial of the answer.
        serial: u64,
    },
    /// The links of a node with their costs; travels from router to router.
    LinkState {
        /// A [`LinkStateBody`].
        signed: SignedBody,
    },
    /// A question for the owners of these names, from router to router; answered with advertisements, now or when they
    /// become known.
    Query {
        /// Random number of the question, from its first sender: copies over other links are the same question.
        id: u64,
        /// Links crossed so far.
        hops: u8,
        /// The names.
        names: Vec<Name>,
    },
    /// There is a better route to the owner than that of this branch: the sink has to ask again, and has a while until
    /// the branch is cut. Travels along the branch to the sink.
    Reroute {
        /// Name.
        name: Name,
        /// Sink.
        sink: SinkId,
    },
    /// From here on the sender may put this label in place of this name, in packets over this link. Only between the
    /// two nodes of a link; labels are given in order, from 0, and stand for one name as long as the link lives.
    Label {
        /// Label.
        label: Label,
        /// Name.
        name: Name,
    },
    /// The sender knows the names of this label and all before it: packets under them may come.
    LabelAck {
        /// Label.
        label: Label,
    },
    /// A question whether the other end is there, only between the two nodes of a link. The receiver answers at once.
    Probe {
        /// Whether this is the answer.
        answers: bool,
    },
    /// The sender, which dialled this link, wants to dial another connection for packets of this name alone, both ways.
    LaneOffer {
        /// The token that the connection will show.
        token: LaneToken,
        /// Name.
        name: Name,
    },
    /// The answer to a lane offer.
    LaneAnswer {
        /// The offered token.
        token: LaneToken,
        /// Whether the sender awaits a connection with this token.
        accepted: bool,
    },
    /// The sender, which cannot dial, wants a lane for this name.
    LaneWanted {
        /// Name.
        name: Name,
    },
    /// The sender, which cannot dial, wants a bulk lane for this name.
    BulkLaneWanted {
        /// Name.
        name: Name,
    },
    /// The sender's wall clock. Only between the two nodes of a link: first behind the greeting, and again after the
    /// clock was set. It is a hint for operators; nothing is set or believed by it.
    Clock {
        /// The time at which the frame was made.
        time: UnixMillis,
    },
    /// Another process uses the receiver's identity, and was refused. Only between the two nodes of a link. It is a
    /// hint for operators.
    IdentityInUse {
        /// The place of the other process, as the sender sees it.
        place: Place,
    },
    /// The address from which the receiver's packets come: another than its own behind a NAT (RFC 4787). Only between
    /// the two nodes of a link, to the one that dialled, if its [minor version](Hello::minor) is at least
    /// [`MINOR_OBSERVED_ADDRESS`].
    ObservedAddress {
        /// The address, as the sender sees it.
        place: Place,
    },
}

/// The minor version of this protocol.
pub const MINOR_VERSION: u16 = MINOR_OBSERVED_ADDRESS;
/// The first minor version that knows [`Control::ObservedAddress`].
pub const MINOR_OBSERVED_ADDRESS: u16 = 1;

/// An address and a port of a node.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub struct Place {
    /// The address; IPv4 addresses are mapped into IPv6 (RFC 4291, 2.5.5.2).
    pub ip: [u8; 16],
    /// The port.
    pub port: u16,
}

impl Encode for Place {
    fn encode(&self, w: &mut Writer) {
        w.raw(&self.ip);
        w.u16(self.port);
    }
}

impl Decode for Place {
    fn decode(r: &mut Reader<'_>) -> Result<Self, DecodeError> {
        Ok(Self { ip: r.array("address")?, port: r.u16()? })
    }
}

impl From<SocketAddr> for Place {
    fn from(address: SocketAddr) -> Self {
        let ip = match address.ip() {
            IpAddr::V4(v4) => v4.to_ipv6_mapped(),
            IpAddr::V6(v6) => v6,
        };
        Self { ip: ip.octets(), port: address.port() }
    }
}

impl From<Place> for SocketAddr {
    fn from(place: Place) -> Self {
        Self::new(Ipv6Addr::from(place.ip).to_canonical(), place.port)
    }
}

/// The first frame of a link.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Hello {
    /// Minor version of the protocol ([`MINOR_VERSION`]); the transport negotiates the major one.
    pub minor: u16,
    /// Random number of this run of the process: another number voids all state of the last run.
    pub incarnation: u64,
    /// `true` for a router, which carries others' names; `false` for a node that only serves itself.
    pub transit: bool,
    /// Whether another run of this node has taken over a link of this one: this run takes over from nobody.
    pub yields: bool,
    /// Beginning of this run, by its own clock: the floor in its link states.
    pub started: UnixMillis,
}

/// A sink's request for messages, or its confirmation. A source does not send messages that it no longer has.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Recover {
    /// Name.
    pub name: Name,
    /// The requesting sink; the answer goes to it alone.
    pub sink: SinkId,
    /// The source.
    pub source: SourceId,
    /// First message.
    pub from: u64,
    /// Last message; 0 in a confirmation.
    pub to: u64,
}

impl Recover {
    /// Returns the confirmation that a sink has all numbers of a source up to `seq`.
    pub fn confirmation(name: Name, sink: SinkId, source: SourceId, seq: u64) -> Self {
        Self { name, sink, source, from: seq.saturating_add(1), to: 0 }
    }

    /// Returns the number up to which the sink has all, if this is a confirmation.
    pub fn confirmed(&self) -> Option<u64> {
        if self.to == 0 { self.from.checked_sub(1) } else { None }
    }
}

/// The reason why a router refuses a join.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub enum RejectReason {
    /// The name is not reachable from here.
    NoRoute,
    /// The request's certificate, signature or time does not verify.
    NotVerified,
    /// A limit of the router is reached.
    Limit,
    /// The owner or a router on the way took too long.
    TimedOut,
    /// The branch is cut because the route to the owner changed or broke.
    RouteLost,
    /// The clocks of requester and router are too far apart.
    Clock,
    /// The requester's certificate has expired, or is not valid yet.
    Expired,
    /// The requester's certificate is revoked.
    Revoked,
}

/// Bytes and a signature over them.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct SignedBody {
    /// The signed bytes.
    pub body: Bytes,
    /// Signature by the key of the first certificate in the body's chain or of the name's owner.
    pub signature: Bytes,
}

/// Content of an advertisement.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct AdvertBody {
    /// Certificates of the owner, leaf first, DER.
    pub chain: Vec<Bytes>,
    /// Grows with every advertisement of the owner.
    pub seq: u64,
    /// Time of signing.
    pub issued_at: UnixMillis,
    /// Lifetime, milliseconds from its arrival.
    pub lease_ms: u32,
    /// Whether these names are withdrawn.
    pub withdraw: bool,
    /// One per name: `name = SHA-256("sgc name v1" ‖ owner id ‖ blind)`.
    pub blinds: Vec<Blind>,
}

/// The links of a node. Routers compute the topology from these; an edge counts if both its ends list it.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct LinkStateBody {
    /// Certificates of the node, leaf first, DER.
    pub chain: Vec<Bytes>,
    /// Grows with every link state of the node.
    pub seq: u64,
    /// Time of signing.
    pub issued_at: UnixMillis,
    /// Lifetime, milliseconds from its arrival.
    pub lease_ms: u32,
    /// Advertisements of this node with lower sequence numbers are void: they are of an earlier run.
    pub floor: u64,
    /// Whether the node carries others' names.
    pub transit: bool,
    /// The routers that it is linked to, ascending by node.
    pub routers: Vec<Adjacency>,
    /// The other nodes that it is linked to, ascending; only a router lists them.
    pub attached: Vec<NodeTag>,
}

/// A link to a router.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Adjacency {
    /// The router.
    pub node: NodeId,
    /// Cost of the link, microseconds of round trip.
    pub cost: u32,
}

/// Role of a joiner.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub enum Role {
    /// Receives the messages under the name.
    Subscribe,
    /// Publishes under the name.
    Publish,
}

/// A joiner's request.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum Request {
    /// To receive the messages under the name.
    Subscribe {
        /// Whether the grant has to contain the metadata: for a joiner that cannot see the owner's catalogue.
        describe: bool,
    },
    /// To publish under the name.
    Publish {
        /// The source with which it will publish.
        offer: SourceOffer,
    },
    /// To get an answer. The name tells the kind of question: that of a fleet's authority takes certificate signing
    /// requests (PKCS #10, DER), that of its operations an [`OperationRequest`](crate::OperationRequest), that of an
    /// owner's types a [`TypeQuestion`](crate::TypeQuestion).
    Ask {
        /// The question.
        what: Bytes,
    },
}

impl Request {
    /// Returns the direction of data over the branch.
    pub fn role(&self) -> Role {
        match self {
            Self::Publish { .. } => Role::Publish,
            Self::Subscribe { .. } | Self::Ask { .. } => Role::Subscribe,
        }
    }
}

/// A source that wants to publish under another's name.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct SourceOffer {
    /// Its random id.
    pub source: SourceId,
    /// Public key of its signatures; empty if the suite has no signatures.
    pub key: Bytes,
}

/// A request to join.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct JoinBody {
    /// The name.
    pub name: Name,
    /// This incarnation of the joiner.
    pub sink: SinkId,
    /// The request.
    pub request: Request,
    /// Time of signing.
    pub issued_at: UnixMillis,
    /// Certificates of the joiner, leaf first, DER.
    pub chain: Vec<Bytes>,
    /// Fresh HPKE public key, to which the answer is sealed.
    pub reply_key: Bytes,
}

/// An owner's answer.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct AnswerBody {
    /// The name.
    pub name: Name,
    /// The sink that it answers.
    pub sink: SinkId,
    /// Grows with every answer to that sink.
    pub serial: u64,
    /// Yes or no.
    pub answer: Answer,
}

/// A grant, or a refusal with its reason.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum Answer {
    /// Granted; the content is sealed to the request's reply key (HPKE, RFC 9180).
    Grant {
        /// Encapsulated key.
        enc: Bytes,
        /// Sealed content.
        sealed: Bytes,
    },
    /// Refused, or a grant revoked.
    Refuse {
        /// The reason.
        reason: RefuseReason,
    },
}

/// The reason why an owner refuses.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub enum RefuseReason {
    /// The requester is not in the share's `to`.
    NotPermitted,
    /// The owner does not share that name (any more).
    NotShared,
    /// The request's certificate, signature or time does not verify at the owner.
    NotVerified,
    /// The share does not offer that role.
    RoleNotOffered,
    /// A limit of the owner is reached.
    Limit,
    /// The clocks of requester and owner are too far apart.
    Clock,
    /// The requester's certificate has expired, or is not valid yet.
    Expired,
    /// The requester's certificate is revoked.
    Revoked,
}

macro_rules! tags {
    ($type:ident, $field:literal, $($variant:ident = $tag:literal),+ $(,)?) => {
        impl Encode for $type {
            fn encode(&self, w: &mut Writer) {
                w.u8(match self { $(Self::$variant => $tag),+ });
            }
        }

        impl Decode for $type {
            fn decode(r: &mut Reader<'_>) -> Result<Self, DecodeError> {
                match r.u8()? {
                    $($tag => Ok(Self::$variant),)+
                    v => Err(DecodeError::value($field, v.into())),
                }
            }
        }
    };
}

tags!(
    RejectReason,
    "reject reason",
    NoRoute = 0,
    NotVerified = 1,
    Limit = 2,
    TimedOut = 3,
    RouteLost = 4,
    Clock = 5,
    Expired = 6,
    Revoked = 7
);
tags!(
    RefuseReason,
    "refuse reason",
    NotPermitted = 0,
    NotShared = 1,
    NotVerified = 2,
    RoleNotOffered = 3,
    Limit = 4,
    Clock = 5,
    Expired = 6,
    Revoked = 7
);

impl std::fmt::Display for RejectReason {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.write_str(match self {
            Self::NoRoute => "the router knows no way to the owner",
            Self::NotVerified => "the router could not verify the request",
            Self::Limit => "a limit of the router is reached",
            Self::TimedOut => "the owner did not answer in time",
            Self::RouteLost => "the way to the owner broke",
            Self::Clock => "the clocks of this node and the router are more than ten minutes apart: set them",
            Self::Expired => "the certificate of this node does not hold now, says the router",
            Self::Revoked => "the certificate of this node is revoked, says the router",
        })
    }
}

impl std::fmt::Display for RefuseReason {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.write_str(match self {
            Self::NotPermitted => "the owner does not share it with this node",
            Self::NotShared => "the owner does not share it",
            Self::NotVerified => "the owner could not verify the request",
            Self::RoleNotOffered => "the owner does not offer that role",
            Self::Limit => "a limit of the owner is reached",
            Self::Clock => "the clocks of this node and the owner are more than ten minutes apart: set them",
            Self::Expired => "the certificate of this node does not hold now, says the owner",
            Self::Revoked => "the certificate of this node is revoked, says the owner",
        })
    }
}

fn encode_chain(w: &mut Writer, chain: &[Bytes]) {
    w.list(chain, |w, c| w.bytes(c));
}

fn decode_chain(r: &mut Reader<'_>) -> Result<Vec<Bytes>, DecodeError> {
    r.list("certificate chain", CHAIN_CERTS_MAX, |r| blob(r, "certificate", CERT_BYTES_MAX))
}

fn blob(r: &mut Reader<'_>, field: &'static str, max: usize) -> Result<Bytes, DecodeError> {
    r.bytes(field, max).map(Bytes::copy_from_slice)
}

fn encode_names(w: &mut Writer, names: &[Name]) {
    w.list(names, |w, n| n.encode(w));
}

fn decode_names(r: &mut Reader<'_>) -> Result<Vec<Name>, DecodeError> {
    r.list("names", NAMES_PER_FRAME_MAX, Name::decode)
}

impl Encode for SignedBody {
    fn encode(&self, w: &mut Writer) {
        w.bytes(&self.body);
        w.bytes(&self.signature);
    }
}

impl Decode for SignedBody {
    fn decode(r: &mut Reader<'_>) -> Result<Self, DecodeError> {
        Ok(Self {
            body: blob(r, "signed body", CONTROL_FRAME_BYTES_MAX)?,
            signature: blob(r, "signature", SIGNATURE_BYTES_MAX)?,
        })
    }
}

impl Encode for Request {
    fn encode(&self, w: &mut Writer) {
        match self {
            Self::Subscribe { describe } => {
                w.u8(0);
                w.bool(*describe);
            }
            Self::Publish { offer } => {
                w.u8(1);
                offer.source.encode(w);
                w.bytes(&offer.key);
            }
            Self::Ask { what } => {
                w.u8(2);
                w.bytes(what);
            }
        }
    }
}

impl Decode for Request {
    fn decode(r: &mut Reader<'_>) -> Result<Self, DecodeError> {
        Ok(match r.u8()? {
            0 => Self::Subscribe { describe: r.bool("describe")? },
            1 => Self::Publish {
                offer: SourceOffer {
                    source: SourceId::decode(r)?,
                    key: blob(r, "source key", SOURCE_KEY_BYTES_MAX)?,
                },
            },
            2 => Self::Ask { what: blob(r, "question", ASK_BYTES_MAX)? },
            v => return Err(DecodeError::value("request", v.into())),
        })
    }
}

impl Encode for AdvertBody {
    fn encode(&self, w: &mut Writer) {
        encode_chain(w, &self.chain);
        w.u64(self.seq);
        self.issued_at.encode(w);
        w.u32(self.lease_ms);
        w.bool(self.withdraw);
        w.list(&self.blinds, |w, b| b.encode(w));
    }
}

impl Decode for AdvertBody {
    fn decode(r: &mut Reader<'_>) -> Result<Self, DecodeError> {
        Ok(Self {
            chain: decode_chain(r)?,
            seq: r.u64()?,
            issued_at: UnixMillis::decode(r)?,
            lease_ms: r.u32()?,
            withdraw: r.bool("withdraw")?,
            blinds: r.list("advertised names", ADVERT_NAMES_MAX, Blind::decode)?,
        })
    }
}

impl Encode for LinkStateBody {
    fn encode(&self, w: &mut Writer) {
        encode_chain(w, &self.chain);
        w.u64(self.seq);
        self.issued_at.encode(w);
        w.u32(self.lease_ms);
        w.u64(self.floor);
        w.bool(self.transit);
        w.list(&self.routers, |w, a| {
            a.node.encode(w);
            w.u32(a.cost);
        });
        w.list(&self.attached, |w, tag| tag.encode(w));
    }
}

impl Decode for LinkStateBody {
    fn decode(r: &mut Reader<'_>) -> Result<Self, DecodeError> {
        let body = Self {
            chain: decode_chain(r)?,
            seq: r.u64()?,
            issued_at: UnixMillis::decode(r)?,
            lease_ms: r.u32()?,
            floor: r.u64()?,
            transit: r.bool("transit")?,
            routers: r.list("adjacencies", ADJACENCIES_MAX, |r| {
                Ok(Adjacency { node: NodeId::decode(r)?, cost: r.u32()? })
            })?,
            attached: r.list("attached nodes", ATTACHED_MAX, NodeTag::decode)?,
        };
        // Each set has one encoding, and lists can be searched as they are.
        if !body.routers.is_sorted_by(|a, b| a.node < b.node) {
            return Err(DecodeError::value("order of adjacencies", 0));
        }
        if !body.attached.is_sorted_by(|a, b| a < b) {
            return Err(DecodeError::value("order of attached nodes", 0));
        }
        Ok(body)
    }
}

impl Encode for JoinBody {
    fn encode(&self, w: &mut Writer) {
        self.name.encode(w);
        self.sink.encode(w);
        self.request.encode(w);
        self.issued_at.encode(w);
        encode_chain(w, &self.chain);
        w.bytes(&self.reply_key);
    }
}

impl Decode for JoinBody {
    fn decode(r: &mut Reader<'_>) -> Result<Self, DecodeError> {
        Ok(Self {
            name: Name::decode(r)?,
            sink: SinkId::decode(r)?,
            request: Request::decode(r)?,
            issued_at: UnixMillis::decode(r)?,
            chain: decode_chain(r)?,
            reply_key: blob(r, "reply key", REPLY_KEY_BYTES_MAX)?,
        })
    }
}

impl Encode for AnswerBody {
    fn encode(&self, w: &mut Writer) {
        self.name.encode(w);
        self.sink.encode(w);
        w.u64(self.serial);
        match &self.answer {
            Answer::Grant { enc, sealed } => {
                w.u8(0);
                w.bytes(enc);
                w.bytes(sealed);
            }
            Answer::Refuse { reason } => {
                w.u8(1);
                reason.encode(w);
            }
        }
    }
}

impl Decode for AnswerBody {
    fn decode(r: &mut Reader<'_>) -> Result<Self, DecodeError> {
        Ok(Self {
            name: Name::decode(r)?,
            sink: SinkId::decode(r)?,
            serial: r.u64()?,
            answer: match r.u8()? {
                0 => Answer::Grant {
                    enc: blob(r, "encapsulated key", REPLY_KEY_BYTES_MAX)?,
                    sealed: blob(r, "sealed content", SEALED_BYTES_MAX)?,
                },
                1 => Answer::Refuse { reason: RefuseReason::decode(r)? },
                v => return Err(DecodeError::value("answer", v.into())),
            },
        })
    }
}

impl Encode for Control {
    fn encode(&self, w: &mut Writer) {
        match self {
            Self::Hello(hello) => {
                w.u8(1);
                w.u16(hello.minor);
                w.u64(hello.incarnation);
                w.bool(hello.transit);
                w.bool(hello.yields);
                hello.started.encode(w);
            }
            Self::Advert { cost, signed } => {
                w.u8(2);
                w.u32(*cost);
                signed.encode(w);
            }
            Self::Unreach { names } => {
                w.u8(3);
                encode_names(w, names);
            }
            Self::Interest { names } => {
                w.u8(4);
                encode_names(w, names);
            }
            Self::Uninterest { names } => {
                w.u8(5);
                encode_names(w, names);
            }
            Self::Join { signed } => {
                w.u8(6);
                signed.encode(w);
            }
            Self::Leave { name, sink } => {
                w.u8(7);
                name.encode(w);
                sink.encode(w);
            }
            Self::Answer { signed } => {
                w.u8(8);
                signed.encode(w);
            }
            Self::Reject { name, sink, reason } => {
                w.u8(9);
                name.encode(w);
                sink.encode(w);
                reason.encode(w);
            }
            Self::Recover(recover) => {
                w.u8(10);
                recover.name.encode(w);
                recover.sink.encode(w);
                recover.source.encode(w);
                w.u64(recover.from);
                w.u64(recover.to);
            }
            Self::Goodbye => w.u8(11),
            Self::Crl { der } => {
                w.u8(12);
                w.bytes(der);
            }
            Self::Ack { name, sink, serial } => {
                w.u8(13);
                name.encode(w);
                sink.encode(w);
                w.u64(*serial);
            }
            Self::LinkState { signed } => {
                w.u8(14);
                signed.encode(w);
            }
            Self::Query { id, hops, names } => {
                w.u8(15);
                w.u64(*id);
                w.u8(*hops);
                encode_names(w, names);
            }
            Self::Reroute { name, sink } => {
                w.u8(16);
                name.encode(w);
                sink.encode(w);
            }
            Self::Label { label, name } => {
                w.u8(20);
                label.encode(w);
                name.encode(w);
            }
            Self::LabelAck { label } => {
                w.u8(21);
                label.encode(w);
            }
            Self::Probe { answers } => {
                w.u8(22);
                w.bool(*answers);
            }
            Self::LaneOffer { token, name } => {
                w.u8(23);
                token.encode(w);
                name.encode(w);
            }
            Self::LaneAnswer { token, accepted } => {
                w.u8(24);
                token.encode(w);
                w.bool(*accepted);
            }
            Self::LaneWanted { name } => {
                w.u8(25);
                name.encode(w);
            }
            Self::BulkLaneWanted { name } => {
                w.u8(28);
                name.encode(w);
            }
            Self::Clock { time } => {
                w.u8(26);
                time.encode(w);
            }
            Self::IdentityInUse { place } => {
                w.u8(27);
                place.encode(w);
            }
            Self::ObservedAddress { place } => {
                w.u8(29);
                place.encode(w);
            }
        }
    }
}

impl Decode for Control {
    fn decode(r: &mut Reader<'_>) -> Result<Self, DecodeError> {
        Ok(match r.u8()? {
            1 => Self::Hello(Hello {
                minor: r.u16()?,
                incarnation: r.u64()?,
                transit: r.bool("transit")?,
                yields: r.bool("yields")?,
                started: UnixMillis::decode(r)?,
            }),
            2 => Self::Advert { cost: r.u32()?, signed: SignedBody::decode(r)? },
            3 => Self::Unreach { names: decode_names(r)? },
            4 => Self::Interest { names: decode_names(r)? },
            5 => Self::Uninterest { names: decode_names(r)? },
            6 => Self::Join { signed: SignedBody::decode(r)? },
            7 => Self::Leave { name: Name::decode(r)?, sink: SinkId::decode(r)? },
            8 => Self::Answer { signed: SignedBody::decode(r)? },
            9 => Self::Reject {
                name: Name::decode(r)?,
                sink: SinkId::decode(r)?,
                reason: RejectReason::decode(r)?,
            },
            10 => Self::Recover(Recover {
                name: Name::decode(r)?,
                sink: SinkId::decode(r)?,
                source: SourceId::decode(r)?,
                from: r.u64()?,
                to: r.u64()?,
            }),
            11 => Self::Goodbye,
            12 => Self::Crl { der: blob(r, "revocation list", CRL_BYTES_MAX)? },
            13 => Self::Ack { name: Name::decode(r)?, sink: SinkId::decode(r)?, serial: r.u64()? },
            14 => Self::LinkState { signed: SignedBody::decode(r)? },
            15 => Self::Query { id: r.u64()?, hops: r.u8()?, names: decode_names(r)? },
            16 => Self::Reroute { name: Name::decode(r)?, sink: SinkId::decode(r)? },
            20 => Self::Label { label: Label::decode(r)?, name: Name::decode(r)? },
            21 => Self::LabelAck { label: Label::decode(r)? },
            22 => Self::Probe { answers: r.bool("answers")? },
            23 => Self::LaneOffer { token: LaneToken::decode(r)?, name: Name::decode(r)? },
            24 => Self::LaneAnswer { token: LaneToken::decode(r)?, accepted: r.bool("accepted")? },
            25 => Self::LaneWanted { name: Name::decode(r)? },
            28 => Self::BulkLaneWanted { name: Name::decode(r)? },
            26 => Self::Clock { time: UnixMillis::decode(r)? },
            27 => Self::IdentityInUse { place: Place::decode(r)? },
            29 => Self::ObservedAddress { place: Place::decode(r)? },
            v => return Err(DecodeError::value("control frame", v.into())),
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::ids::LABELS_MAX;

    fn frames() -> Vec<Control> {
        let signed = SignedBody { body: Bytes::from_static(b"body"), signature: Bytes::from_static(b"sig") };
        let (name, sink) = (Name([1; 32]), SinkId([2; 16]));
        let label = Label::new(LABELS_MAX - 1).unwrap();
        vec![
            Control::Hello(Hello {
                minor: 3,
                incarnation: 9,
                transit: true,
                yields: false,
                started: UnixMillis(78),
            }),
            Control::Advert { cost: 2, signed: signed.clone() },
            Control::Unreach { names: vec![name; 3] },
            Control::Interest { names: vec![name] },
            Control::Uninterest { names: vec![] },
            Control::Join { signed: signed.clone() },
            Control::Leave { name, sink },
            Control::Answer { signed: signed.clone() },
            Control::Reject { name, sink, reason: RejectReason::RouteLost },
            Control::Recover(Recover { name, sink, source: SourceId([3; 16]), from: 1, to: 9 }),
            Control::Recover(Recover::confirmation(name, sink, SourceId([3; 16]), 9)),
            Control::Goodbye,
            Control::Crl { der: Bytes::from_static(b"list") },
            Control::Ack { name, sink, serial: 7 },
            Control::LinkState { signed },
            Control::Query { id: 7, hops: 1, names: vec![name; 2] },
            Control::Reroute { name, sink },
            Control::Label { label, name },
            Control::LabelAck { label },
            Control::Probe { answers: true },
            Control::LaneOffer { token: LaneToken([4; 16]), name },
            Control::LaneAnswer { token: LaneToken([4; 16]), accepted: true },
            Control::LaneWanted { name },
            Control::BulkLaneWanted { name },
            Control::Clock { time: UnixMillis(79) },
            Control::IdentityInUse { place: Place { ip: [5; 16], port: 7447 } },
            Control::ObservedAddress { place: Place { ip: [6; 16], port: 40_123 } },
        ]
    }

    #[test]
    fn frames_round_trip_and_no_prefix_is_a_frame() {
        for frame in frames() {
            let bytes = frame.to_vec();
            assert_eq!(Control::from_slice(&bytes).as_ref(), Ok(&frame));
            for cut in 0..bytes.len() {
                assert!(Control::from_slice(&bytes[..cut]).is_err(), "{frame:?} cut at {cut}");
            }
            let mut longer = bytes;
            longer.push(0);
            assert_eq!(Control::from_slice(&longer), Err(DecodeError::Trailing { extra: 1 }));
        }
    }

    #[test]
    fn bodies_round_trip() {
        let chain = vec![Bytes::from_static(b"leaf"), Bytes::from_static(b"ca")];
        let advert = AdvertBody {
            chain: chain.clone(),
            seq: 5,
            issued_at: UnixMillis(77),
            lease_ms: 60_000,
            withdraw: false,
            blinds: vec![Blind([4; 32]); 2],
        };
        assert_eq!(AdvertBody::from_slice(&advert.to_vec()), Ok(advert));
        let link_state = LinkStateBody {
            chain: chain.clone(),
            seq: 6,
            issued_at: UnixMillis(78),
            lease_ms: 300_000,
            floor: 5,
            transit: true,
            routers: [1, 2].map(|n| Adjacency { node: NodeId([n; 32]), cost: 7 }).into(),
            attached: [3, 4].map(|n| NodeTag([n; 8])).into(),
        };
        assert_eq!(LinkStateBody::from_slice(&link_state.to_vec()), Ok(link_state.clone()));
        let mut unordered = link_state.clone();
        unordered.routers.reverse();
        assert!(LinkStateBody::from_slice(&unordered.to_vec()).is_err());
        let mut twice = link_state;
        twice.attached[1] = twice.attached[0];
        assert!(LinkStateBody::from_slice(&twice.to_vec()).is_err());
        let offer = SourceOffer { source: SourceId([6; 16]), key: Bytes::from_static(b"public") };
        for request in [
            Request::Subscribe { describe: true },
            Request::Publish { offer },
            Request::Ask { what: Bytes::from_static(b"csr") },
        ] {
            let join = JoinBody {
                name: Name([1; 32]),
                sink: SinkId([2; 16]),
                request,
                issued_at: UnixMillis(78),
                chain: chain.clone(),
                reply_key: Bytes::from_static(b"key"),
            };
            assert_eq!(JoinBody::from_slice(&join.to_vec()), Ok(join));
        }
        for answer in [
            Answer::Grant { enc: Bytes::from_static(b"e"), sealed: Bytes::from_static(b"s") },
            Answer::Refuse { reason: RefuseReason::NotPermitted },
        ] {
            let body = AnswerBody { name: Name([1; 32]), sink: SinkId([2; 16]), serial: 1, answer };
            assert_eq!(AnswerBody::from_slice(&body.to_vec()), Ok(body));
        }
    }

    #[test]
    fn claims_beyond_the_bounds_are_refused_before_memory_is_taken() {
        let mut w = Writer::default();
        w.u8(4);
        w.u32(u32::MAX);
        let frame = w.into_vec();
        assert!(matches!(Control::from_slice(&frame), Err(DecodeError::TooLong { field: "names", .. })));
        let mut w = Writer::default();
        w.u8(21);
        w.u32(LABELS_MAX);
        let frame = w.into_vec();
        assert!(matches!(Control::from_slice(&frame), Err(DecodeError::Value { field: "label", .. })));
    }
}
