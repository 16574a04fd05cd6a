//! The content of a grant: a topic's key, an owner's catalogue, or the answer to a question.

use std::ops::RangeInclusive;

use bytes::Bytes;

use crate::codec::{Decode, DecodeError, Encode, Reader, Writer};
use crate::consumers::{CONSUMERS_MAX, Consumer};
use crate::control::{CERT_BYTES_MAX, CHAIN_CERTS_MAX, SOURCE_KEY_BYTES_MAX};
use crate::ids::{Blind, SecretBytes, SourceId, UnixMillis};
use crate::metadata::Metadata;
use crate::operation::OperationAnswer;
use crate::packet::Class;
use crate::path::PathOffer;
use crate::qos::Qos;
use crate::report::Report;
use crate::ros_node::RosNode;
use crate::type_descriptions::{DescribedType, TYPE_HASH_BYTES_MAX, TYPES_PER_QUESTION_MAX};
use crate::wish::{WISHES_MAX, Wish};

/// Most entries of one catalogue.
pub const CATALOGUE_ENTRIES_MAX: usize = 2048;
/// Most sources listed for one entry.
pub const ENTRY_SOURCES_MAX: usize = 128;

/// Most sources of one topic.
pub const GRANT_SOURCES_MAX: usize = 1024;
/// Most generations of a fleet's secret that are in use at one time.
pub const SECRET_GENERATIONS_MAX: usize = 8;

/// Ids of the cipher suites whose grants have a field for a receiver key.
pub const RECEIVER_KEY_SUITES: RangeInclusive<u8> = 9..=10;

/// The content of a grant.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum GrantContent {
    /// The key of a topic, and its publishers.
    Topic(TopicGrant),
    /// The list of the owner's shares for the requester.
    Catalogue(Catalogue),
    /// A member's fresh certificates and secrets; from its fleet's authority.
    Credentials(Credentials),
    /// Descriptions of the requested types, as far as they are known.
    Types(Vec<DescribedType>),
    /// The result of an operation on a fleet; from its authority.
    Operation(OperationAnswer),
    /// A node's consumers of the interfaces of the owner that asked.
    Consumers(Vec<Consumer>),
    /// A node's report for an observer.
    Report(Report),
    /// Where a node can be reached without a router.
    Path(PathOffer),
    /// The time by a node's clock.
    Clock(UnixMillis),
    /// The most that a node wants of the topics of the owner that asked.
    Wishes(Vec<Wish>),
}

/// One epoch of one topic.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct TopicGrant {
    /// Number of the epoch, from 1.
    pub epoch: u32,
    /// Cipher suite id.
    pub suite: u8,
    /// The topic key of the epoch.
    pub key: SecretBytes,
    /// The key that proves packets to the granted node; only in a suite of [`RECEIVER_KEY_SUITES`], and not for a node
    /// that receives no packets.
    pub receiver: Option<ReceiverKey>,
    /// The publishing sources: no other source counts.
    pub sources: Vec<SourceAnnounce>,
    /// The catalogue entry of the name, if it was requested.
    pub entry: Option<Box<CatalogueEntry>>,
}

/// The key that the owner of a topic shares with one receiving node, and with nobody else.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct ReceiverKey {
    /// Names the key in packets.
    pub id: [u8; 4],
    /// The key.
    pub key: SecretBytes,
}

/// A source, as its owner announces it.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct SourceAnnounce {
    /// Its id.
    pub source: SourceId,
    /// Public key of its signatures: an Ed25519 key of 32 bytes, or the SubjectPublicKeyInfo of an RSA key; empty if
    /// the suite has no signatures.
    pub key: Bytes,
    /// At the time of the grant, the oldest message that a late joiner may ask for; the next one if there is no
    /// history.
    pub oldest: u64,
    /// At the time of the grant, the number of its next message: older ones that were not asked for are replays.
    pub next: u64,
    /// The first message that the receiver may ever ask for again after a loss; 0 if lost messages of this source stay
    /// lost.
    pub recover: u64,
}

/// A member's fresh certificates and secrets.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Credentials {
    /// Its new certificates, leaf first, DER.
    pub chain: Vec<Bytes>,
    /// The fleet's naming secrets in use, newest first; none for a router.
    pub secrets: Vec<SecretGeneration>,
}

/// One generation of the secret that names are derived from.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct SecretGeneration {
    /// Its number, from 1.
    pub generation: u32,
    /// The secret.
    pub secret: SecretBytes,
}

/// An owner's shares, as one node may see them.
#[derive(Clone, Debug, PartialEq, Eq, Default)]
pub struct Catalogue {
    /// Grows with every change at the owner, within one incarnation of it.
    pub version: u64,
    /// The interfaces.
    pub entries: Vec<CatalogueEntry>,
}

/// One shared interface.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct CatalogueEntry {
    /// Its metadata.
    pub metadata: Metadata,
    /// The blind from which, with the owner, the name follows.
    pub blind: Blind,
    /// Whether the requester may subscribe to it.
    pub subscribe: bool,
    /// Whether the requester may publish on it.
    pub publish: bool,
    /// Cipher suite id.
    pub suite: u8,
    /// Whether the DDS type has no key.
    pub keyless: bool,
    /// `RIHS01_…` type hash, if the owner's side knows it.
    pub type_hash: Option<String>,
    /// QoS of the interface as a whole.
    pub qos: Qos,
    /// Class of its traffic.
    pub class: Class,
    /// The publishers behind it, one source each.
    pub sources: Vec<CatalogueSource>,
}

/// One publisher behind an interface.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct CatalogueSource {
    /// The source that its packets name.
    pub source: SourceId,
    /// QoS of this publisher.
    pub qos: Qos,
    /// The ROS 2 node that it belongs to, if its network says so.
    pub node: Option<RosNode>,
}

impl Encode for Class {
    fn encode(&self, w: &mut Writer) {
        w.u8(*self as u8);
    }
}

impl Decode for Class {
    fn decode(r: &mut Reader<'_>) -> Result<Self, DecodeError> {
        match r.u8()? {
            0 => Ok(Self::Bulk),
            1 => Ok(Self::Default),
            2 => Ok(Self::Realtime),
            v => Err(DecodeError::value("class", v.into())),
        }
    }
}

impl Encode for GrantContent {
    fn encode(&self, w: &mut Writer) {
        match self {
            Self::Topic(grant) => {
                w.u8(0);
                w.u32(grant.epoch);
                w.u8(grant.suite);
                grant.key.encode(w);
                if RECEIVER_KEY_SUITES.contains(&grant.suite) {
                    w.option(grant.receiver.as_ref(), |w, r| r.encode(w));
                }
                w.list(&grant.sources, |w, s| s.encode(w));
                w.option(grant.entry.as_ref(), |w, e| e.encode(w));
            }
            Self::Catalogue(catalogue) => {
                w.u8(1);
                w.u64(catalogue.version);
                w.list(&catalogue.entries, |w, e| e.encode(w));
            }
            Self::Credentials(credentials) => {
                w.u8(2);
                w.list(&credentials.chain, |w, c| w.bytes(c));
                w.list(&credentials.secrets, |w, s| {
                    w.u32(s.generation);
                    s.secret.encode(w);
                });
            }
            Self::Types(types) => {
                w.u8(3);
                w.list(types, |w, t| t.encode(w));
            }
            Self::Operation(answer) => {
                w.u8(4);
                answer.encode(w);
            }
            Self::Consumers(consumers) => {
                w.u8(5);
                w.list(consumers, |w, c| c.encode(w));
            }
            Self::Report(report) => {
                w.u8(6);
                report.encode(w);
            }
            Self::Path(offer) => {
                w.u8(7);
                offer.encode(w);
            }
            Self::Clock(time) => {
                w.u8(8);
                time.encode(w);
            }
            Self::Wishes(wishes) => {
                w.u8(9);
                w.list(wishes, |w, wish| wish.encode(w));
            }
        }
    }
}

impl Decode for GrantContent {
    fn decode(r: &mut Reader<'_>) -> Result<Self, DecodeError> {
        match r.u8()? {
            0 => Ok(Self::Topic({
                let (epoch, suite, key) = (r.u32()?, r.u8()?, SecretBytes::decode(r)?);
                let receiver = match RECEIVER_KEY_SUITES.contains(&suite) {
                    true => r.option("receiver key", ReceiverKey::decode)?,
                    false => None,
                };
                let sources = r.list("sources", GRANT_SOURCES_MAX, SourceAnnounce::decode)?;
                let entry = r.option("entry", |r| CatalogueEntry::decode(r).map(Box::new))?;
                TopicGrant { epoch, suite, key, receiver, sources, entry }
            })),
            1 => Ok(Self::Catalogue(Catalogue {
                version: r.u64()?,
                entries: r.list("catalogue", CATALOGUE_ENTRIES_MAX, CatalogueEntry::decode)?,
            })),
            2 => Ok(Self::Credentials(Credentials {
                chain: r.list("certificate chain", CHAIN_CERTS_MAX, |r| {
                    r.bytes("certificate", CERT_BYTES_MAX).map(Bytes::copy_from_slice)
                })?,
                secrets: r.list("secrets", SECRET_GENERATIONS_MAX, |r| {
                    Ok(SecretGeneration { generation: r.u32()?, secret: SecretBytes::decode(r)? })
                })?,
            })),
            3 => Ok(Self::Types(r.list("types", TYPES_PER_QUESTION_MAX, DescribedType::decode)?)),
            4 => Ok(Self::Operation(OperationAnswer::decode(r)?)),
            5 => Ok(Self::Consumers(r.list("consumers", CONSUMERS_MAX, Consumer::decode)?)),
            6 => Ok(Self::Report(Report::decode(r)?)),
            7 => Ok(Self::Path(PathOffer::decode(r)?)),
            8 => Ok(Self::Clock(UnixMillis::decode(r)?)),
            9 => Ok(Self::Wishes(r.list("wishes", WISHES_MAX, Wish::decode)?)),
            v => Err(DecodeError::value("grant content", v.into())),
        }
    }
}

impl Encode for ReceiverKey {
    fn encode(&self, w: &mut Writer) {
        w.raw(&self.id);
        self.key.encode(w);
    }
}

impl Decode for ReceiverKey {
    fn decode(r: &mut Reader<'_>) -> Result<Self, DecodeError> {
        Ok(Self { id: r.array("receiver key id")?, key: SecretBytes::decode(r)? })
    }
}

impl Encode for SourceAnnounce {
    fn encode(&self, w: &mut Writer) {
        self.source.encode(w);
        w.bytes(&self.key);
        w.u64(self.oldest);
        w.u64(self.next);
        w.u64(self.recover);
    }
}

impl Decode for SourceAnnounce {
    fn decode(r: &mut Reader<'_>) -> Result<Self, DecodeError> {
        Ok(Self {
            source: SourceId::decode(r)?,
            key: r.bytes("source key", SOURCE_KEY_BYTES_MAX).map(Bytes::copy_from_slice)?,
            oldest: r.u64()?,
            next: r.u64()?,
            recover: r.u64()?,
        })
    }
}

impl Encode for CatalogueEntry {
    fn encode(&self, w: &mut Writer) {
        self.metadata.encode(w);
        self.blind.encode(w);
        w.bool(self.subscribe);
        w.bool(self.publish);
        w.u8(self.suite);
        w.bool(self.keyless);
        w.option(self.type_hash.as_ref(), |w, h| w.str(h));
        self.qos.encode(w);
        self.class.encode(w);
        w.list(&self.sources, |w, s| {
            s.source.encode(w);
            s.qos.encode(w);
            w.option(s.node.as_ref(), |w, n| n.encode(w));
        });
    }
}

impl Decode for CatalogueEntry {
    fn decode(r: &mut Reader<'_>) -> Result<Self, DecodeError> {
        Ok(Self {
            metadata: Metadata::decode(r)?,
            blind: Blind::decode(r)?,
            subscribe: r.bool("subscribe")?,
            publish: r.bool("publish")?,
            suite: r.u8()?,
            keyless: r.bool("keyless")?,
            type_hash: r.option("type hash", |r| r.str("type hash", TYPE_HASH_BYTES_MAX))?,
            qos: Qos::decode(r)?,
            class: Class::decode(r)?,
            sources: r.list("sources", ENTRY_SOURCES_MAX, |r| {
                Ok(CatalogueSource {
                    source: SourceId::decode(r)?,
                    qos: Qos::decode(r)?,
                    node: r.option("node", RosNode::decode)?,
                })
            })?,
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::ids::Name;
    use crate::message::PayloadEncoding;

    /// The bytes are normative.
    #[test]
    fn a_time_has_these_bytes() {
        let content = GrantContent::Clock(UnixMillis(0x0102_0304_0506));
        assert_eq!(content.to_vec(), [8, 0, 0, 1, 2, 3, 4, 5, 6]);
        assert_eq!(GrantContent::from_slice(&content.to_vec()), Ok(content));
    }

    #[test]
    fn grants_round_trip_and_keys_stay_out_of_debug() {
        let entry = CatalogueEntry {
            metadata: Metadata::topic("arm-1", "/a", "p/msg/T"),
            blind: Blind([7; 32]),
            subscribe: true,
            publish: false,
            suite: 3,
            keyless: true,
            type_hash: Some("RIHS01_00".into()),
            qos: Qos { partitions: vec!["x".into()], ..Qos::default() },
            class: Class::Bulk,
            sources: vec![
                CatalogueSource { source: SourceId([1; 16]), qos: Qos::default(), node: None },
                CatalogueSource {
                    source: SourceId([2; 16]),
                    qos: Qos::default(),
                    node: RosNode::new("/robot", "talker", Some("/robot")),
                },
            ],
        };
        let announce = SourceAnnounce {
            source: SourceId([2; 16]),
            key: Bytes::from_static(&[5; 32]),
            oldest: 3,
            next: 9,
            recover: 2,
        };
        let topic = TopicGrant {
            epoch: 3,
            suite: 1,
            key: SecretBytes::new([0xab; 32]),
            receiver: None,
            sources: vec![announce],
            entry: Some(Box::new(entry.clone())),
        };
        let credentials = Credentials {
            chain: vec![Bytes::from_static(b"leaf")],
            secrets: vec![SecretGeneration { generation: 2, secret: SecretBytes::new([0xab; 32]) }],
        };
        assert!(!format!("{topic:?}{credentials:?}").contains("171"), "{topic:?}{credentials:?}");
        for content in [
            GrantContent::Topic(topic),
            GrantContent::Catalogue(Catalogue { version: 8, entries: vec![entry] }),
            GrantContent::Credentials(credentials),
            GrantContent::Types(vec![DescribedType {
                name: Name([3; 32]),
                type_hash: "RIHS01_00".into(),
                encoding: PayloadEncoding::Zstd,
                description: Bytes::from_static(b"packed"),
            }]),
        ] {
            assert_eq!(GrantContent::from_slice(&content.to_vec()), Ok(content));
        }
    }
}
