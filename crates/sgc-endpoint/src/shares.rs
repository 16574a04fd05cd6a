//! What this node owns: its shares, who was granted them, and what each asker sees in the catalogue.

use std::collections::BTreeMap;

use bytes::Bytes;
use sgc_trust::{Policy, Suite, VerifiedPeer};
use sgc_wire::{
    Blind, Catalogue, CatalogueEntry, CatalogueSource, Class, Metadata, Name, NodeId, Qos, Role, SinkId,
    TopicGrant,
};

/// What to share.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct ShareSpec {
    /// What the name is derived from.
    pub metadata: Metadata,
    /// Who may join.
    pub policy: Policy,
    /// How payloads are protected.
    pub suite: Suite,
    /// Class of its traffic.
    pub class: Class,
    /// True if the DDS type has no key.
    pub keyless: bool,
    /// `RIHS01_…` type hash, if known.
    pub type_hash: Option<String>,
    /// What the interface as a whole offers.
    pub qos: Qos,
    /// The publishers behind it that sinks must tell apart (transient-local ones).
    pub sources: Vec<CatalogueSource>,
}

/// Why something is not shared.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
pub enum ShareError {
    /// The identity has no fleet secret: it is a router's.
    #[error("this identity is a router's: it holds no fleet secret and can share nothing")]
    NoSecret,
    /// The name is shared already.
    #[error("{ros_name} [{type_name}] is shared already")]
    Duplicate {
        /// ROS name.
        ros_name: String,
        /// ROS type.
        type_name: String,
    },
    /// Too many.
    #[error("at most {max} interfaces can be shared by one node")]
    Limit {
        /// The bound.
        max: usize,
    },
}

/// One who was granted.
#[derive(Clone, Debug)]
pub(crate) struct GrantedSink {
    pub(crate) peer: VerifiedPeer,
    pub(crate) reply_key: Bytes,
    /// Serial of the last answer.
    pub(crate) serial: u64,
    /// Hash-free memory of what it was told last; only used for catalogues.
    pub(crate) told: Option<Catalogue>,
}

/// A share.
#[derive(Debug)]
pub(crate) struct Share {
    pub(crate) spec: ShareSpec,
    pub(crate) blind: Blind,
    pub(crate) grant: TopicGrant,
    pub(crate) sinks: BTreeMap<SinkId, GrantedSink>,
}

impl Share {
    fn entry(&self) -> CatalogueEntry {
        CatalogueEntry {
            metadata: self.spec.metadata.clone(),
            blind: self.blind,
            subscribe: true,
            publish: false,
            suite: self.grant.suite,
            keyless: self.spec.keyless,
            type_hash: self.spec.type_hash.clone(),
            qos: self.spec.qos.clone(),
            class: self.spec.class,
            sources: self.spec.sources.clone(),
        }
    }
}

/// All shares of a node, and those who follow its catalogue.
#[derive(Debug, Default)]
pub(crate) struct Shares {
    pub(crate) shares: BTreeMap<Name, Share>,
    pub(crate) followers: BTreeMap<SinkId, GrantedSink>,
    pub(crate) version: u64,
}

impl Shares {
    /// What `peer` may see.
    pub(crate) fn catalogue_for(&self, peer: &VerifiedPeer) -> Catalogue {
        let entries = self
            .shares
            .values()
            .filter(|s| s.spec.policy.permits(peer, Role::Subscribe).is_ok())
            .map(Share::entry)
            .collect();
        Catalogue { version: self.version, entries }
    }

    /// The nodes granted one name, each sink once.
    pub(crate) fn granted(&self, name: &Name) -> impl Iterator<Item = (SinkId, NodeId)> + '_ {
        self.shares.get(name).into_iter().flat_map(|s| s.sinks.iter().map(|(id, g)| (*id, g.peer.node_id)))
    }
}
