//! The names that this node owns: its shares, their sinks, and the part of the catalogue that each node sees.

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

/// Parameters of a share.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct ShareSpec {
    /// The metadata from which the name derives.
    pub metadata: Metadata,
    /// The nodes that may join.
    pub policy: Policy,
    /// Protection of payloads.
    pub suite: Suite,
    /// Class of its traffic.
    pub class: Class,
    /// Whether the DDS type has no key.
    pub keyless: bool,
    /// `RIHS01_…` type hash, if known.
    pub type_hash: Option<String>,
    /// QoS of the interface as a whole.
    pub qos: Qos,
    /// This node's publishers behind it, as far as sinks tell them apart.
    pub sources: Vec<CatalogueSource>,
}

/// The reason why an interface is not shared.
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
    /// Too many shares.
    #[error("at most {max} interfaces can be shared by one node")]
    Limit {
        /// The bound.
        max: usize,
    },
}

/// A granted sink.
#[derive(Clone, Debug)]
pub(crate) struct GrantedSink {
    pub(crate) peer: VerifiedPeer,
    pub(crate) request: Request,
    pub(crate) reply_key: Bytes,
    /// Time at which the request was signed: a replayed request is never newer than the last of its node.
    pub(crate) issued_at: UnixMillis,
    /// Serial of the last answer.
    pub(crate) serial: u64,
    /// The last catalogue sent to it, so that it is not sent again.
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

/// An epoch that was granted and is not in use yet.
#[derive(Debug)]
pub(crate) struct Rotation {
    pub(crate) epoch: Epoch,
    /// Sinks that have not acknowledged the key, each with the serial of its answer.
    pub(crate) waiting: BTreeMap<SinkId, u64>,
    /// Time at which the epoch begins without them.
    pub(crate) deadline: Instant,
    /// Whether another epoch has to follow at once.
    pub(crate) again: bool,
}

/// The point from which a node may receive a share: nothing older is sent to it again, on any route.
#[derive(Debug)]
pub(crate) struct ReceiveStart {
    pub(crate) peer: VerifiedPeer,
    /// Floors by source; a source that is not listed came later, and all its messages may be sent.
    floors: BTreeMap<SourceId, u64>,
}

/// A share.
#[derive(Debug)]
pub(crate) struct Share {
    pub(crate) spec: ShareSpec,
    pub(crate) blind: Blind,
    pub(crate) epoch: Epoch,
    pub(crate) rotation: Option<Rotation>,
    /// End of the epoch's lifetime.
    pub(crate) rotate_at: Instant,
    /// This node's own sources.
    pub(crate) own: Vec<Arc<SourceProgress>>,
    /// Progress of this node's sink with others' sources.
    pub(crate) heard: Option<Arc<SinkProgress>>,
    pub(crate) sinks: BTreeMap<SinkId, GrantedSink>,
    /// Set once this node's own sink was told of the share: it has to learn also that nobody may publish any more.
    pub(crate) told_own: bool,
    /// Nodes that receive or received it, and the messages that may be sent to them again.
    pub(crate) since: BTreeMap<NodeId, ReceiveStart>,
    /// Nodes that left and still have the newest key. If one of them loses its right, the key has to be replaced.
    pub(crate) left: BTreeMap<NodeId, (VerifiedPeer, Role)>,
    /// Description of its type, if known.
    pub(crate) described: Option<PackedType>,
}

impl Share {
    /// Returns the grant of an epoch for this request.
    pub(crate) fn grant(&self, epoch: &Epoch, peer: Option<&GrantedSink>) -> TopicGrant {
        let own = self.own.iter().map(|s| s.announce()).map(|announce| {
            let floor = match peer {
                Some(p) => self.floor(&p.peer.node_id, &announce.source).unwrap_or(announce.next),
                None => 1,
            };
            let recover = if announce.recover > 0 { floor } else { 0 };
            SourceAnnounce { recover, ..announce }
        });
        // By source: after a route change a source may have two sinks for a while.
        let others: BTreeMap<_, _> = self
            .sinks
            .values()
            .filter_map(|s| match &s.request {
                Request::Publish { offer } => Some((offer.source, offer.key.clone())),
                Request::Subscribe { .. } | Request::Ask { .. } => None,
            })
            .collect();
        // They keep no history; messages that this node has received are past for new sinks.
        let others = others.into_iter().map(|(source, key)| {
            let next = self.heard.as_ref().map_or(0, |heard| heard.newest(&source)).saturating_add(1);
            SourceAnnounce { source, key, oldest: next, next, recover: 0 }
        });
        // A service's client receives from its owner alone, and does not learn of other clients.
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

    /// Returns `true` if its publishers call a service.
    pub(crate) fn is_service(&self) -> bool {
        self.spec.metadata.kind == Kind::Service
    }

    /// Remembers from when on a node receives the share, if it is new; at most `max` nodes, beside those that receive
    /// it now.
    pub(crate) fn note_since(&mut self, peer: &VerifiedPeer, max: usize) {
        if let Some(known) = self.since.get_mut(&peer.node_id) {
            // The node may have another certificate by now.
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

    /// Returns the first message of a source that may be sent to a node again.
    pub(crate) fn floor(&self, node: &NodeId, source: &SourceId) -> Option<u64> {
        self.since.get(node).map(|since| since.floors.get(source).copied().unwrap_or(1))
    }

    /// Forgets the floors of sources that no longer exist.
    pub(crate) fn forget_floors(&mut self) {
        let own: BTreeSet<_> = self.own.iter().map(|s| s.id()).collect();
        self.since.values_mut().for_each(|since| since.floors.retain(|source, _| own.contains(source)));
    }

    /// Returns the epoch of the last grants.
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

    /// Returns the share's entry in the catalogue for `peer`.
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

    /// Returns this node's publishers, and one entry for all others, where others may publish. These are not told
    /// apart: each would be listed after its first messages. A transient-local topic has no others, because they keep
    /// no history; and a service's clients are hidden from each other.
    fn listed_sources(&self) -> Vec<CatalogueSource> {
        let has_others =
            !self.spec.policy.publish.is_empty() && !self.spec.qos.is_transient_local() && !self.is_service();
        let others = CatalogueSource { source: SourceId::OTHERS, qos: self.spec.qos.clone(), node: None };
        let own = self.spec.sources.iter().take(ENTRY_SOURCES_MAX - 1).cloned();
        own.chain(has_others.then_some(others)).collect()
    }
}

/// All shares of a node, and the followers of its catalogue.
#[derive(Debug, Default)]
pub(crate) struct Shares {
    pub(crate) shares: BTreeMap<Name, Share>,
    /// Followers by the name of the catalogue, of which there is one for each naming secret.
    pub(crate) followers: BTreeMap<(Name, SinkId), GrantedSink>,
    pub(crate) version: u64,
}

impl Shares {
    /// Returns the catalogue for `peer`.
    pub(crate) fn catalogue_for(&self, peer: &VerifiedPeer) -> Catalogue {
        let entries = self.shares.values().map(|s| s.entry(peer)).filter(|e| e.subscribe || e.publish);
        Catalogue { version: self.version, entries: entries.collect() }
    }

    /// Iterates over the nodes granted one name, each sink once.
    pub(crate) fn granted(&self, name: &Name) -> impl Iterator<Item = (SinkId, NodeId)> + '_ {
        self.shares.get(name).into_iter().flat_map(|s| s.sinks.iter().map(|(id, g)| (*id, g.peer.node_id)))
    }
}
