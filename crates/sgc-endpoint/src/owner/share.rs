//! [`Share`]: one shared interface with its sinks, its epochs, and its entry in the catalogue.

use std::collections::{BTreeMap, BTreeSet};
use std::sync::Arc;
use std::time::Instant;

use rand_core::RngCore;
use sgc_trust::{DenialReason, Policy, ReceiverSecret, Suite, VerifiedPeer};
use sgc_wire::{
    Blind, CatalogueEntry, CatalogueSource, Class, ENTRY_SOURCES_MAX, GRANT_SOURCES_MAX, GrantContent, Kind,
    Metadata, Name, NodeId, Qos, ReceiverKey, Recover, RefuseReason, Request, Role, SecretBytes, SinkId,
    SourceAnnounce, SourceId, TopicGrant,
};

use super::granted::{GrantedSink, is_older, place};
use crate::context::Context;
use crate::output::{Event, UnexpectedFrame};
use crate::packed_type::PackedType;
use crate::receivers::Receivers;
use crate::sink::SinkProgress;
use crate::source::SourceProgress;

/// Granted epochs that are not in use yet. Sinks hold [`crate::EPOCHS_MAX`] keys, some of them for epochs whose packets
/// are still in flight.
const EPOCHS_AHEAD_MAX: u32 = 3;

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

/// A share.
#[derive(Debug)]
pub(crate) struct Share {
    name: Name,
    spec: ShareSpec,
    blind: Blind,
    epoch: Epoch,
    rotation: Option<Rotation>,
    /// End of the epoch's lifetime.
    rotate_at: Instant,
    /// This node's own sources.
    own: Vec<Arc<SourceProgress>>,
    /// The secret of receiver keys, and the receivers of this node's sources.
    receiver_secret: ReceiverSecret,
    receivers: Arc<Receivers>,
    /// Progress of this node's sink with others' sources.
    heard: Option<Arc<SinkProgress>>,
    sinks: BTreeMap<SinkId, GrantedSink>,
    /// Set once this node's own sink was told of the share: it has to learn also that nobody may publish any more.
    told_own: bool,
    /// Nodes that receive or received it, and the messages that may be sent to them again.
    since: BTreeMap<NodeId, ReceiveStart>,
    /// Nodes that left and still have the newest key. If one of them loses its right, the key has to be replaced.
    left: BTreeMap<NodeId, (VerifiedPeer, Role)>,
    /// Description of its type, if known.
    described: Option<PackedType>,
}

/// A due step of a rotation. The new epochs of all shares begin before the next ones are made.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum RotationStep {
    /// Put the new epoch into use.
    Finish,
    /// Make the key of the next epoch.
    Begin,
}

/// The key of one epoch.
#[derive(Clone, Debug)]
struct Epoch {
    number: u32,
    key: SecretBytes,
}

impl Epoch {
    fn new(number: u32, rng: &mut impl RngCore) -> Self {
        let mut key = zeroize::Zeroizing::new([0; 32]);
        rng.fill_bytes(&mut *key);
        Self { number, key: SecretBytes::new(*key) }
    }
}

/// An epoch that was granted and is not in use yet.
#[derive(Debug)]
struct Rotation {
    epoch: Epoch,
    /// Sinks that have not acknowledged the key, each with the serial of its answer.
    waiting: BTreeMap<SinkId, u64>,
    /// Time at which the epoch begins without them.
    deadline: Instant,
    /// Whether another epoch has to follow at once.
    again: bool,
}

/// The point from which a node may receive a share: nothing older is sent to it again, on any route.
#[derive(Debug)]
struct ReceiveStart {
    peer: VerifiedPeer,
    /// Floors by source; a source that is not listed came later, and all its messages may be sent.
    floors: BTreeMap<SourceId, u64>,
}

impl Share {
    /// Begins a share, with its first key.
    pub(crate) fn new(cx: &mut Context, name: Name, blind: Blind, spec: ShareSpec) -> Self {
        Self {
            name,
            spec,
            blind,
            epoch: Epoch::new(1, cx.rng()),
            rotation: None,
            rotate_at: cx.instant() + cx.limits().rotate_every,
            own: Vec::new(),
            receiver_secret: ReceiverSecret::generate(cx.rng()),
            receivers: Arc::default(),
            heard: None,
            sinks: BTreeMap::new(),
            told_own: false,
            since: BTreeMap::new(),
            left: BTreeMap::new(),
            described: None,
        }
    }

    pub(crate) fn blind(&self) -> Blind {
        self.blind
    }

    pub(crate) fn policy(&self) -> &Policy {
        &self.spec.policy
    }

    /// Returns the description of the type, if known.
    pub(crate) fn described(&self) -> Option<&PackedType> {
        self.described.as_ref()
    }

    pub(crate) fn describe(&mut self, described: PackedType) {
        self.described = Some(described);
    }

    /// Returns `true` if the type has a key.
    pub(crate) fn is_keyed(&self) -> bool {
        !self.spec.keyless
    }

    /// Sets the progress of this node's own sink.
    pub(crate) fn set_own_sink(&mut self, progress: Arc<SinkProgress>) {
        self.heard = Some(progress);
    }

    /// Iterates over the granted sinks, with their nodes.
    pub(crate) fn granted(&self) -> impl Iterator<Item = (SinkId, NodeId)> {
        self.sinks.iter().map(|(id, granted)| (*id, granted.peer.node_id))
    }

    /// Returns the publishers: by source, the sink that packets for it are addressed to.
    pub(crate) fn publishers(&self) -> BTreeMap<SourceId, SinkId> {
        let publishers = self.sinks.iter().filter_map(|(sink, granted)| match &granted.request {
            Request::Publish { offer } => Some((offer.source, *sink)),
            Request::Subscribe { .. } | Request::Ask { .. } => None,
        });
        publishers.collect()
    }

    /// Returns the receivers of this node's sources.
    pub(crate) fn receivers(&self) -> Arc<Receivers> {
        self.receivers.clone()
    }

    /// Returns the key in use, for this node's sources.
    pub(crate) fn own_grant(&self) -> TopicGrant {
        self.grant(&self.epoch, None)
    }

    /// Changes the offer. Returns `true` if it is another.
    pub(crate) fn update(&mut self, cx: &mut Context, qos: Qos, sources: Vec<CatalogueSource>) -> bool {
        if self.spec.qos == qos && self.spec.sources == sources {
            return false;
        }
        self.spec.qos = qos;
        self.spec.sources = sources;
        let described = |s: &GrantedSink| matches!(s.request, Request::Subscribe { describe: true });
        if self.sinks.values().any(described) {
            self.regrant(cx);
        }
        true
    }

    /// Changes the policy. Returns `true` if it is another; then the caller has to enforce it.
    pub(crate) fn set_policy(&mut self, policy: Policy) -> bool {
        let is_new = self.spec.policy != policy;
        self.spec.policy = policy;
        is_new
    }

    /// Sets this node's sources.
    pub(crate) fn set_sources(&mut self, cx: &mut Context, sources: Vec<Arc<SourceProgress>>) {
        let ids = |all: &[Arc<SourceProgress>]| all.iter().map(|s| s.announce().source).collect::<Vec<_>>();
        if ids(&self.own) == ids(&sources) {
            return;
        }
        self.own = sources;
        self.forget_floors();
        self.regrant(cx);
    }

    /// Ends the share, and tells its sinks.
    pub(crate) fn end(self, cx: &mut Context) {
        let name = self.name;
        for (sink, granted) in self.sinks {
            let peer = granted.peer.node_id;
            granted.refuse(cx, name, sink, RefuseReason::NotShared);
            cx.event(Event::SinkLeft { name, sink, peer });
        }
    }

    /// Cuts the sinks that have lost the right to their grant. Returns `true` if the others need another key.
    pub(crate) fn cut_denied(&mut self, cx: &mut Context) -> bool {
        let policy = &self.spec.policy;
        let denied = |peer: &VerifiedPeer, role| {
            cx.standing(peer).or_else(|| policy.permits(peer, role).err().map(refusal))
        };
        let cut = self
            .sinks
            .iter()
            .filter_map(|(sink, granted)| Some((*sink, denied(&granted.peer, granted.request.role())?)));
        let cut: Vec<_> = cut.collect();
        // A node that left, or that a router cut off first, still knows the key.
        let left = self.left.values().any(|(peer, role)| denied(peer, *role).is_some());
        let any = left || !cut.is_empty();
        for (sink, reason) in cut {
            let Some(granted) = self.remove_sink(&sink) else { continue };
            let (name, peer) = (self.name, granted.peer.node_id);
            granted.refuse(cx, name, sink, reason);
            cx.event(Event::SinkCut { name, sink, peer, reason });
        }
        any
    }

    /// Forgets the history rights of peers that lost the right to the share: they begin anew if they get it back.
    pub(crate) fn forget_denied(&mut self, cx: &Context) {
        let policy = &self.spec.policy;
        self.since.retain(|_, since| {
            cx.standing(&since.peer).is_none() && policy.permits(&since.peer, Role::Subscribe).is_ok()
        });
    }

    /// Makes the key of the next epoch and grants it. Sources use it once all sinks have it, or after a while.
    pub(crate) fn begin_epoch(&mut self, cx: &mut Context) {
        // An epoch that never began is skipped, if some sinks have its key: a cut node may be one of them. The time
        // runs on from the first of these, or a series of them would delay the new key for ever. Sinks hold few keys,
        // so beyond that number the next epoch waits for its turn.
        let ahead = self.newest().number - self.epoch.number;
        let deadline = match &mut self.rotation {
            Some(rotation) if ahead >= EPOCHS_AHEAD_MAX => {
                rotation.again = true;
                return;
            }
            Some(rotation) => rotation.deadline,
            None => cx.instant() + cx.limits().rotate_wait,
        };
        let epoch = Epoch::new(self.newest().number.saturating_add(1), cx.rng());
        self.rotate_at = cx.instant() + cx.limits().rotate_every;
        self.left.clear();
        self.rotation = Some(Rotation { epoch, waiting: BTreeMap::new(), deadline, again: false });
        self.regrant(cx);
        if let Some(rotation) = &mut self.rotation {
            rotation.waiting = self.sinks.iter().map(|(sink, s)| (*sink, s.serial)).collect();
        }
        self.finish_epoch(cx);
    }

    /// Puts a new epoch into use if nothing keeps it waiting.
    fn finish_epoch(&mut self, cx: &mut Context) {
        let now = cx.instant();
        let ready = |r: &Rotation| r.waiting.is_empty() || r.deadline <= now;
        let Some(rotation) = self.rotation.take_if(|r| ready(r)) else { return };
        self.epoch = rotation.epoch;
        cx.event(Event::Rekeyed { name: self.name, grant: self.own_grant() });
        if rotation.again {
            self.begin_epoch(cx);
        }
    }

    /// Ends the epoch at a time, unless it ends before.
    pub(crate) fn end_epoch_by(&mut self, at: Instant) {
        self.rotate_at = self.rotate_at.min(at);
    }

    /// Returns the time at which the new epoch begins, or the next one has to be made.
    pub(crate) fn rotation_deadline(&self) -> Instant {
        self.rotation.as_ref().map_or(self.rotate_at, |r| r.deadline)
    }

    /// Returns the step of the rotation that is due.
    pub(crate) fn rotation_due(&self, now: Instant) -> Option<RotationStep> {
        match &self.rotation {
            Some(rotation) => (rotation.deadline <= now).then_some(RotationStep::Finish),
            None => (self.rotate_at <= now).then_some(RotationStep::Begin),
        }
    }

    /// Carries out a step of the rotation.
    pub(crate) fn rotate(&mut self, cx: &mut Context, step: RotationStep) {
        match step {
            RotationStep::Finish => self.finish_epoch(cx),
            RotationStep::Begin => self.begin_epoch(cx),
        }
    }

    /// Grants the newest epoch to every sink again, because key or sources changed.
    fn regrant(&mut self, cx: &mut Context) {
        for sink in self.sinks.keys().copied().collect::<Vec<_>>() {
            self.grant_again(cx, sink);
        }
        self.tell_own(cx);
    }

    /// Tells every receiver its publishers; this node alone receives those of a service.
    fn publishers_changed(&mut self, cx: &mut Context) {
        if self.is_service() {
            self.tell_own(cx);
        } else {
            self.regrant(cx);
        }
    }

    fn grant_again(&mut self, cx: &mut Context, sink: SinkId) {
        let Some(granted) = self.sinks.get(&sink) else { return };
        let content = GrantContent::Topic(self.grant(self.newest(), Some(granted)));
        self.answer(cx, sink, &content);
    }

    /// Answers a sink under the next serial. Returns that serial; `None` if its reply key is unusable, so that it is
    /// removed.
    fn answer(&mut self, cx: &mut Context, sink: SinkId, content: &GrantContent) -> Option<u64> {
        let granted = self.sinks.get_mut(&sink)?;
        if granted.grant(cx, self.name, sink, content) {
            return Some(granted.serial);
        }
        self.remove_sink(&sink);
        None
    }

    /// Adds a sink, or renews it. Returns `true` if it was known. The packets of every message that begins after its
    /// grant has left have a MAC for it.
    fn insert_sink(&mut self, sink: SinkId, granted: GrantedSink) -> bool {
        if let Some(key) = self.receiver_key(&granted) {
            self.receivers.add(sink, granted.peer.node_id, || key);
            if let Request::Publish { offer } = &granted.request {
                self.receivers.set_caller(offer.source, sink);
            }
        }
        self.sinks.insert(sink, granted).is_some()
    }

    fn remove_sink(&mut self, sink: &SinkId) -> Option<GrantedSink> {
        self.receivers.remove(sink);
        self.sinks.remove(sink)
    }

    /// Returns the key that proves packets to a sink, if it receives any. Of publishers only the callers of a service
    /// do, and it also proves their requests.
    fn receiver_key(&self, granted: &GrantedSink) -> Option<ReceiverKey> {
        let receives = granted.request.role() == Role::Subscribe || self.is_service();
        let key = || self.receiver_secret.derive_key(&self.name, &granted.peer.node_id);
        (self.spec.suite.is_pairwise() && receives).then(key)
    }

    /// Updates this node's own sink of a share on which others may publish.
    pub(crate) fn tell_own(&mut self, cx: &mut Context) {
        self.told_own |= !self.spec.policy.publish.is_empty();
        if self.told_own {
            cx.event(Event::OwnGrant { name: self.name, grant: self.grant(self.newest(), None) });
        }
    }

    pub(crate) fn handle_ack(&mut self, cx: &mut Context, sink: SinkId, serial: u64) {
        if let Some(rotation) = &mut self.rotation
            && rotation.waiting.get(&sink).is_some_and(|granted| *granted <= serial)
        {
            rotation.waiting.remove(&sink);
            self.finish_epoch(cx);
        }
    }

    /// Takes a request to receive the share or to publish on it.
    pub(crate) fn handle_request(&mut self, cx: &mut Context, sink: SinkId, asked: GrantedSink) {
        let (name, peer, role) = (self.name, asked.peer.node_id, asked.request.role());
        if self.sinks.get(&sink).is_some_and(|known| is_older(&asked, known)) {
            return cx.unexpected(UnexpectedFrame::OlderRequest);
        }
        self.replace_publisher(cx, &sink, &asked);
        match self.admit(cx, &sink, &asked) {
            Ok(None) => {}
            Ok(Some(oldest)) => self.give_up_place(cx, oldest),
            Err(reason) => {
                cx.refuse(name, sink, 1, reason);
                return cx.event(Event::SinkRefused { name, peer, reason });
            }
        }
        if role == Role::Subscribe {
            self.note_since(&asked.peer, cx.limits().sinks_per_name_max);
        }
        // A request may come twice, on another route or under a new certificate: the serials of its answers keep
        // growing.
        let serial = self.sinks.get(&sink).map_or(0, |s| s.serial);
        let is_known = self.insert_sink(sink, GrantedSink { serial, ..asked });
        self.left.remove(&peer);
        let content = GrantContent::Topic(self.grant(&self.epoch, self.sinks.get(&sink)));
        let Some(serial) = self.answer(cx, sink, &content) else { return };
        // The sink came between two epochs: it needs both keys.
        if let Some(rotation) = &mut self.rotation {
            rotation.waiting.insert(sink, serial + 1);
            self.grant_again(cx, sink);
        }
        if !is_known {
            cx.event(Event::SinkJoined { name, sink, peer, role });
            if role == Role::Publish {
                self.publishers_changed(cx);
            }
        }
    }

    /// Replaces a publisher that asks again after a route change, which may come before its old sink has left.
    fn replace_publisher(&mut self, cx: &mut Context, sink: &SinkId, asked: &GrantedSink) {
        let Request::Publish { offer } = &asked.request else { return };
        let same = |s: &GrantedSink| {
            let peer = s.peer.node_id == asked.peer.node_id;
            peer && matches!(&s.request, Request::Publish { offer: o } if o.source == offer.source)
        };
        let old = self.sinks.iter().find(|(id, s)| *id != sink && same(s)).map(|(id, _)| *id);
        if let Some(old) = old {
            self.handle_leave(cx, old);
        }
    }

    /// Decides whether a request may be granted, and names the sink that has to give up its place for it.
    fn admit(
        &self,
        cx: &Context,
        sink: &SinkId,
        asked: &GrantedSink,
    ) -> Result<Option<SinkId>, RefuseReason> {
        self.spec.policy.permits(&asked.peer, asked.request.role()).map_err(refusal)?;
        match &asked.request {
            Request::Ask { .. } => return Err(RefuseReason::RoleNotOffered),
            Request::Publish { offer } if offer.key.is_empty() == self.spec.suite.is_signed() => {
                return Err(RefuseReason::NotVerified);
            }
            // Two sources under one id would use one nonce twice.
            Request::Publish { offer } if self.has_source(&offer.source, sink) => {
                return Err(RefuseReason::NotPermitted);
            }
            Request::Publish { .. } | Request::Subscribe { .. } => {}
        }
        if let Some(known) = self.sinks.get(sink) {
            let same = known.peer.node_id == asked.peer.node_id && known.request == asked.request;
            return if same { Ok(None) } else { Err(RefuseReason::NotPermitted) };
        }
        place(self.sinks.iter(), asked, cx.limits())
    }

    /// Ends the oldest sink of a node that is at its limit.
    fn give_up_place(&mut self, cx: &mut Context, sink: SinkId) {
        let Some(granted) = self.sinks.get(&sink) else { return };
        let serial = granted.serial + 1;
        self.handle_leave(cx, sink);
        cx.refuse(self.name, sink, serial, RefuseReason::Limit);
    }

    pub(crate) fn handle_leave(&mut self, cx: &mut Context, sink: SinkId) {
        let Some(granted) = self.remove_sink(&sink) else { return };
        if let Some(rotation) = &mut self.rotation {
            rotation.waiting.remove(&sink);
        }
        let (peer, role) = (granted.peer.node_id, granted.request.role());
        self.left.insert(peer, (granted.peer, role));
        let too_many = self.left.len() > cx.limits().sinks_per_name_max;
        cx.event(Event::SinkLeft { name: self.name, sink, peer });
        self.finish_epoch(cx);
        if too_many {
            self.begin_epoch(cx);
        } else if role == Role::Publish {
            self.publishers_changed(cx);
        }
    }

    /// Handles a sink's request for messages, or its confirmation. Of messages published before it had the right it gets
    /// at most the history.
    pub(crate) fn handle_recover(&self, cx: &mut Context, mut recover: Recover) {
        let granted = self.sinks.get(&recover.sink);
        let Some(granted) = granted.filter(|granted| granted.request.role() == Role::Subscribe) else {
            return cx.unexpected(UnexpectedFrame::Recover);
        };
        if let Some(seq) = recover.confirmed() {
            let (peer, Recover { name, source, .. }) = (granted.peer.node_id, recover);
            return cx.event(Event::Confirmed { name, source, peer, seq });
        }
        if recover.from > 0 {
            let floor = self.floor(&granted.peer.node_id, &recover.source);
            recover.from = recover.from.max(floor.unwrap_or(u64::MAX));
        }
        cx.event(Event::Recover(recover));
    }

    /// Iterates over the nodes that receive it.
    pub(crate) fn subscribers(&self) -> impl Iterator<Item = NodeId> {
        let subscribes = |granted: &&GrantedSink| granted.request.role() == Role::Subscribe;
        self.sinks.values().filter(subscribes).map(|granted| granted.peer.node_id)
    }

    /// Returns the grant of an epoch for this request.
    fn grant(&self, epoch: &Epoch, peer: Option<&GrantedSink>) -> TopicGrant {
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
            receiver: peer.and_then(|granted| self.receiver_key(granted)),
            sources: own.chain(others).take(GRANT_SOURCES_MAX).collect(),
            entry: describe.map(|p| Box::new(self.entry(&p.peer))),
        }
    }

    /// Returns `true` if its publishers call a service.
    fn is_service(&self) -> bool {
        self.spec.metadata.kind == Kind::Service
    }

    /// Remembers from when on a node receives the share, if it is new; at most `max` nodes, beside those that receive
    /// it now.
    fn note_since(&mut self, peer: &VerifiedPeer, max: usize) {
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
    fn floor(&self, node: &NodeId, source: &SourceId) -> Option<u64> {
        self.since.get(node).map(|since| since.floors.get(source).copied().unwrap_or(1))
    }

    /// Forgets the floors of sources that no longer exist.
    fn forget_floors(&mut self) {
        let own: BTreeSet<_> = self.own.iter().map(|s| s.id()).collect();
        self.since.values_mut().for_each(|since| since.floors.retain(|source, _| own.contains(source)));
    }

    /// Returns the epoch of the last grants.
    fn newest(&self) -> &Epoch {
        self.rotation.as_ref().map_or(&self.epoch, |r| &r.epoch)
    }

    /// Returns `true` if `source` publishes here already, other than by the request of `sink`.
    fn has_source(&self, source: &SourceId, sink: &SinkId) -> bool {
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

fn refusal(denied: DenialReason) -> RefuseReason {
    match denied {
        DenialReason::NotListed => RefuseReason::NotPermitted,
        DenialReason::Role => RefuseReason::RoleNotOffered,
    }
}
