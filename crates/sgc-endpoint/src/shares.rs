//! What this node owns: its shares, who was granted them, and what each asker sees in the catalogue.

use std::collections::{BTreeMap, BTreeSet};
use std::sync::Arc;
use std::time::Instant;

use bytes::Bytes;
use rand_core::RngCore;
use sgc_trust::{Policy, Suite, VerifiedPeer};
use sgc_wire::{
    Blind, Catalogue, CatalogueEntry, CatalogueSource, Class, ENTRY_SOURCES_MAX, GRANT_SOURCES_MAX, Kind,
    Metadata, Name, NodeId, Qos, Request, Role, SecretBytes, SinkId, SourceAnnounce, SourceId, TopicGrant,
    UnixMillis,
};

use crate::{PackedType, SinkProgress, SourceProgress};

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
    /// Whether the DDS type has no key.
    pub keyless: bool,
    /// `RIHS01_…` type hash, if known.
    pub type_hash: Option<String>,
    /// What the interface as a whole offers.
    pub qos: Qos,
    /// This node's publishers behind it, as far as sinks tell them apart.
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
    pub(crate) request: Request,
    pub(crate) reply_key: Bytes,
    /// Time at which the request was signed: of requests that are played again none is newer than the last of their node.
    pub(crate) issued_at: UnixMillis,
    /// Serial of the last answer.
    pub(crate) serial: u64,
    /// What it was told last, so that it is not told again; only used for catalogues.
    pub(crate) told: Option<Catalogue>,
}

/// The key of one epoch.
#[derive(Clone, Debug)]
pub(crate) struct Epoch {
    pub(crate) number: u32,
    pub(crate) key: SecretBytes,
}

impl Epoch {
    pub(crate) fn new(number: u32, rng: &mut impl RngCore) -> Self {
        let mut key = zeroize::Zeroizing::new([0; 32]);
        rng.fill_bytes(&mut *key);
        Self { number, key: SecretBytes::new(*key) }
    }
}

/// An epoch that its sinks were granted and that is not in use yet.
#[derive(Debug)]
pub(crate) struct Rotation {
    pub(crate) epoch: Epoch,
    /// Who has not said yet that it has the key, and with which answer it got it.
    pub(crate) waiting: BTreeMap<SinkId, u64>,
    /// When the epoch begins even if some have not.
    pub(crate) deadline: Instant,
    /// Whether another is to follow at once.
    pub(crate) again: bool,
}

/// Since when a node may receive a share: nothing older is sent to it again, on whatever way it asks.
#[derive(Debug)]
pub(crate) struct ReceiveStart {
    pub(crate) peer: VerifiedPeer,
    /// By source; of one that came later, all.
    floors: BTreeMap<SourceId, u64>,
}

/// A share.
#[derive(Debug)]
pub(crate) struct Share {
    pub(crate) spec: ShareSpec,
    pub(crate) blind: Blind,
    pub(crate) epoch: Epoch,
    pub(crate) rotation: Option<Rotation>,
    /// When the epoch has lasted long enough.
    pub(crate) rotate_at: Instant,
    /// This node's own sources.
    pub(crate) own: Vec<Arc<SourceProgress>>,
    /// What this node has heard of others' sources.
    pub(crate) heard: Option<Arc<SinkProgress>>,
    pub(crate) sinks: BTreeMap<SinkId, GrantedSink>,
    /// True once this node's own sink was told of it: it has to hear when nobody may publish any more, too.
    pub(crate) told_own: bool,
    /// Who receives it, or did, and what it may have sent to it again.
    pub(crate) since: BTreeMap<NodeId, ReceiveStart>,
    /// Who left and still has the newest key. If one of them loses its right, that key has to go.
    pub(crate) left: BTreeMap<NodeId, (VerifiedPeer, Role)>,
    /// What its type looks like, if that is known.
    pub(crate) described: Option<PackedType>,
}

impl Share {
    /// What is granted of an epoch to one who asked with `request`.
    pub(crate) fn grant(&self, epoch: &Epoch, peer: Option<&GrantedSink>) -> TopicGrant {
        let own = self.own.iter().map(|s| s.announce()).map(|announce| {
            let floor = match peer {
                Some(p) => self.floor(&p.peer.node_id, &announce.source).unwrap_or(announce.next),
                None => 1,
            };
            let recover = if announce.recover > 0 { floor } else { 0 };
            SourceAnnounce { recover, ..announce }
        });
        // By source: one that moved to another way may have two places for a while.
        let others: BTreeMap<_, _> = self
            .sinks
            .values()
            .filter_map(|s| match &s.request {
                Request::Publish { offer } => Some((offer.source, offer.key.clone())),
                Request::Subscribe { .. } | Request::Ask { .. } => None,
            })
            .collect();
        // They keep no history; what this node has heard of them is past to whoever is told of them now.
        let others = others.into_iter().map(|(source, key)| {
            let next = self.heard.as_ref().map_or(0, |heard| heard.newest(&source)).saturating_add(1);
            SourceAnnounce { source, key, oldest: next, next, recover: 0 }
        });
        // Who calls a service hears its owner alone, and who else calls it is nobody's business.
        let others = others.filter(|_| peer.is_none() || !self.is_service());
        let describe = peer.filter(|p| matches!(p.request, Request::Subscribe { describe: true }));
        TopicGrant {
            epoch: epoch.number,
            suite: self.spec.suite.id(),
            key: epoch.key.clone(),
            sources: own.chain(others).take(GRANT_SOURCES_MAX).collect(),
            entry: describe.map(|p| Box::new(self.entry(&p.peer))),
        }
    }

    /// Returns `true` if those who publish on it call a service.
    pub(crate) fn is_service(&self) -> bool {
        self.spec.metadata.kind == Kind::Service
    }

    /// Remembers since when a node receives the share, if it did not before; at most `max` nodes, beside those that
    /// receive it now.
    pub(crate) fn note_since(&mut self, peer: &VerifiedPeer, max: usize) {
        if let Some(known) = self.since.get_mut(&peer.node_id) {
            // It may have another certificate by now.
            known.peer = peer.clone();
            return;
        }
        if self.since.len() >= max {
            let here: BTreeSet<_> = self.sinks.values().map(|s| s.peer.node_id).collect();
            if let Some(gone) = self.since.keys().find(|node| !here.contains(*node)).copied() {
                self.since.remove(&gone);
            }
        }
        let floors = self.own.iter().map(|s| s.announce()).map(|a| (a.source, a.oldest)).collect();
        self.since.insert(peer.node_id, ReceiveStart { peer: peer.clone(), floors });
    }

    /// The first message of a source that a node may have sent to it again.
    pub(crate) fn floor(&self, node: &NodeId, source: &SourceId) -> Option<u64> {
        self.since.get(node).map(|since| since.floors.get(source).copied().unwrap_or(1))
    }

    /// Forgets the floors of sources that are no more.
    pub(crate) fn forget_floors(&mut self) {
        let own: BTreeSet<_> = self.own.iter().map(|s| s.id()).collect();
        self.since.values_mut().for_each(|since| since.floors.retain(|source, _| own.contains(source)));
    }

    /// The epoch that sinks were told last.
    pub(crate) fn newest(&self) -> &Epoch {
        self.rotation.as_ref().map_or(&self.epoch, |r| &r.epoch)
    }

    /// Returns `true` if `source` publishes here already, other than by the request of `sink`.
    pub(crate) fn has_source(&self, source: &SourceId, sink: &SinkId) -> bool {
        let offered =
            |s: &GrantedSink| matches!(&s.request, Request::Publish { offer } if offer.source == *source);
        self.own.iter().any(|s| s.id() == *source)
            || self.sinks.iter().any(|(id, s)| id != sink && offered(s))
    }

    /// The share as `peer` may see it.
    pub(crate) fn entry(&self, peer: &VerifiedPeer) -> CatalogueEntry {
        let policy = &self.spec.policy;
        CatalogueEntry {
            metadata: self.spec.metadata.clone(),
            blind: self.blind,
            subscribe: policy.permits(peer, Role::Subscribe).is_ok(),
            publish: policy.permits(peer, Role::Publish).is_ok(),
            suite: self.spec.suite.id(),
            keyless: self.spec.keyless,
            type_hash: self.spec.type_hash.clone(),
            qos: self.spec.qos.clone(),
            class: self.spec.class,
            sources: self.listed_sources(),
        }
    }

    /// This node's publishers behind it; and one for all others, where others may publish. They are not told apart: each would
    /// be listed after its first messages. A transient-local topic has no others, since those keep no history; and who calls a
    /// service is nobody else's business.
    fn listed_sources(&self) -> Vec<CatalogueSource> {
        let has_others =
            !self.spec.policy.publish.is_empty() && !self.spec.qos.is_transient_local() && !self.is_service();
        let others = CatalogueSource { source: SourceId::OTHERS, qos: self.spec.qos.clone(), node: None };
        let own = self.spec.sources.iter().take(ENTRY_SOURCES_MAX - 1).cloned();
        own.chain(has_others.then_some(others)).collect()
    }
}

/// All shares of a node, and those who follow its catalogue.
#[derive(Debug, Default)]
pub(crate) struct Shares {
    pub(crate) shares: BTreeMap<Name, Share>,
    /// By the name of the catalogue, of which there is one for each secret that names are derived from.
    pub(crate) followers: BTreeMap<(Name, SinkId), GrantedSink>,
    pub(crate) version: u64,
}

impl Shares {
    /// What `peer` may see.
    pub(crate) fn catalogue_for(&self, peer: &VerifiedPeer) -> Catalogue {
        let entries = self.shares.values().map(|s| s.entry(peer)).filter(|e| e.subscribe || e.publish);
        Catalogue { version: self.version, entries: entries.collect() }
    }

    /// The nodes granted one name, each sink once.
    pub(crate) fn granted(&self, name: &Name) -> impl Iterator<Item = (SinkId, NodeId)> + '_ {
        self.shares.get(name).into_iter().flat_map(|s| s.sinks.iter().map(|(id, g)| (*id, g.peer.node_id)))
    }
}
