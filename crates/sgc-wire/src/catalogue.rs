//! What a grant holds once it is unsealed: a topic's key, or an owner's catalogue.

use std::fmt;

use crate::codec::{Decode, DecodeError, Encode, Reader, Writer};
use crate::ids::SourceId;
use crate::metadata::Metadata;
use crate::packet::Class;
use crate::qos::Qos;

/// Most entries of one catalogue.
pub const CATALOGUE_ENTRIES_MAX: usize = 2048;
/// Most sources listed for one entry.
pub const ENTRY_SOURCES_MAX: usize = 128;

/// The content of a grant.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum GrantContent {
    /// The key of a topic.
    Topic(TopicGrant),
    /// The list of what its owner shares with the one who asked.
    Catalogue(Catalogue),
}

/// The key of one epoch of one topic.
#[derive(Clone, PartialEq, Eq)]
pub struct TopicGrant {
    /// Epoch that the key is for.
    pub epoch: u32,
    /// Cipher suite id.
    pub suite: u8,
    /// The key.
    pub key: [u8; 32],
}

impl fmt::Debug for TopicGrant {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_struct("TopicGrant")
            .field("epoch", &self.epoch)
            .field("suite", &self.suite)
            .finish_non_exhaustive()
    }
}

/// What an owner shares with one node.
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
    /// Metadata; the name follows from it and the topic secret.
    pub metadata: Metadata,
    /// True if the DDS type has no key.
    pub keyless: bool,
    /// `RIHS01_…` type hash, if the owner's side knows it.
    pub type_hash: Option<String>,
    /// What the interface as a whole offers.
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
    /// What this publisher offers.
    pub qos: Qos,
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
                w.raw(&grant.key);
            }
            Self::Catalogue(catalogue) => {
                w.u8(1);
                w.u64(catalogue.version);
                w.list(&catalogue.entries, |w, e| e.encode(w));
            }
        }
    }
}

impl Decode for GrantContent {
    fn decode(r: &mut Reader<'_>) -> Result<Self, DecodeError> {
        match r.u8()? {
            0 => Ok(Self::Topic(TopicGrant { epoch: r.u32()?, suite: r.u8()?, key: r.array("key")? })),
            1 => Ok(Self::Catalogue(Catalogue {
                version: r.u64()?,
                entries: r.list("catalogue", CATALOGUE_ENTRIES_MAX, CatalogueEntry::decode)?,
            })),
            v => Err(DecodeError::value("grant content", v.into())),
        }
    }
}

impl Encode for CatalogueEntry {
    fn encode(&self, w: &mut Writer) {
        self.metadata.encode(w);
        w.bool(self.keyless);
        w.option(self.type_hash.as_ref(), |w, h| w.str(h));
        self.qos.encode(w);
        self.class.encode(w);
        w.list(&self.sources, |w, s| {
            s.source.encode(w);
            s.qos.encode(w);
        });
    }
}

impl Decode for CatalogueEntry {
    fn decode(r: &mut Reader<'_>) -> Result<Self, DecodeError> {
        Ok(Self {
            metadata: Metadata::decode(r)?,
            keyless: r.bool("keyless")?,
            type_hash: r.option("type hash", |r| r.str("type hash", 128))?,
            qos: Qos::decode(r)?,
            class: Class::decode(r)?,
            sources: r.list("sources", ENTRY_SOURCES_MAX, |r| {
                Ok(CatalogueSource { source: SourceId::decode(r)?, qos: Qos::decode(r)? })
            })?,
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn grants_round_trip_and_keys_stay_out_of_debug() {
        let topic = TopicGrant { epoch: 3, suite: 1, key: [0xab; 32] };
        assert!(!format!("{topic:?}").contains("171"), "{topic:?}");
        let entry = CatalogueEntry {
            metadata: Metadata::topic("arm-1", "/a", "p/msg/T"),
            keyless: true,
            type_hash: Some("RIHS01_00".into()),
            qos: Qos { partitions: vec!["x".into()], ..Qos::default() },
            class: Class::Bulk,
            sources: vec![CatalogueSource { source: SourceId([1; 16]), qos: Qos::default() }],
        };
        for content in [
            GrantContent::Topic(topic),
            GrantContent::Catalogue(Catalogue { version: 8, entries: vec![entry] }),
        ] {
            assert_eq!(GrantContent::from_slice(&content.to_vec()), Ok(content));
        }
    }
}
