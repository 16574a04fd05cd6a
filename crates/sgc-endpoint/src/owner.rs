//! The owner's part of the endpoint: shares, their sinks, epochs, the catalogue, and for an authority the credentials
//! of members.

use std::collections::{BTreeMap, BTreeSet};
use std::sync::Arc;
use std::time::{Duration, Instant};

use bytes::Bytes;
use sgc_trust::{DenialReason, Kem, Policy, TopicSecret, VerifiedPeer, name_of, seal_grant, verify_join};
use sgc_wire::{
    Answer, AnswerBody, Blind, CATALOGUE_ENTRIES_MAX, Catalogue, CatalogueEntry, CatalogueSource, Control,
    Credentials, Decode, Encode, GrantContent, JoinBody, Metadata, Name, NodeId, Now, OperationAnswer, Qos,
    Recover, RefuseReason, Request, Role, SEALED_BYTES_MAX, SignedBody, SinkId, SourceId, TopicGrant,
};

use crate::advert_pace::AdvertPace;
use crate::endpoint::{Endpoint, EndpointDrop, Event, Limits};
use crate::shares::{Epoch, GrantedSink, Rotation, Share, ShareError, ShareSpec};
use crate::{SinkProgress, SourceProgress};

/// Granted epochs that are not in use yet. Sinks hold [`crate::EPOCHS_MAX`] keys, some of them for epochs whose packets
/// are still in flight.
const EPOCHS_AHEAD_MAX: u32 = 3;

/// A request that is older than the one known of its sink or node.
pub(crate) const OLDER_REQUEST: &str = "older request";

/// Nodes that have a place at the operations name of an authority: operators are few.
const OPERATIONS_ASKED_MAX: usize = 64;

/// Time for which changes of the catalogue are collected after it was sent.
const CATALOGUE_REST: Duration = Duration::from_millis(100);

impl Endpoint {
    /// Shares an interface under the name that its metadata gives with the newest secret.
    pub fn share(&mut self, now: Now, spec: ShareSpec) -> Result<Name, ShareError> {
        self.now = now;
        let secrets = self.config.identity.naming_secrets();
        let secret = secrets.first().ok_or(ShareError::NoSecret)?;
        let blind = TopicSecret::derive(&secret.secret, &spec.metadata).blind();
        let name = name_of(&self.config.identity.node_id(), &blind);
        if self.shares.shares.contains_key(&name) {
            let Metadata { ros_name, type_name, .. } = spec.metadata;
            return Err(ShareError::Duplicate { ros_name, type_name });
        }
        if self.shares.shares.len() >= self.config.limits.shares_max {
            return Err(ShareError::Limit { max: self.config.limits.shares_max });
        }
        let share = Share {
            spec,
            blind,
            epoch: Epoch::new(1, &mut self.rng),
            rotation: None,
            rotate_at: now.instant + self.config.limits.rotate_every,
            own: Vec::new(),
            heard: None,
            sinks: BTreeMap::new(),
            since: BTreeMap::new(),
            left: BTreeMap::new(),
            told_own: false,
            described: None,
        };
        self.shares.shares.insert(name, share);
        self.withdrawn.remove(&blind);
        self.unadvertised.insert(blind);
        self.catalogue_dirty = true;
        self.tell_own(name);
        Ok(name)
    }

    /// Changes the offer of a share; its name and key stay.
    pub fn update_share(&mut self, now: Now, name: &Name, qos: Qos, sources: Vec<CatalogueSource>) {
        self.now = now;
        let Some(share) = self.shares.shares.get_mut(name) else { return };
        if share.spec.qos == qos && share.spec.sources == sources {
            return;
        }
        share.spec.qos = qos;
        share.spec.sources = sources;
        let described = |s: &&GrantedSink| matches!(s.request, Request::Subscribe { describe: true });
        let anyone = share.sinks.values().any(|s| described(&s));
        self.catalogue_dirty = true;
        if anyone {
            self.regrant(*name);
        }
    }

    /// Changes the policy of a share. Sinks without the right are cut at once, and the others get a new key.
    pub fn update_policy(&mut self, now: Now, name: &Name, policy: Policy) {
        self.now = now;
        let Some(share) = self.shares.shares.get_mut(name) else { return };
        if share.spec.policy == policy {
            return;
        }
        share.spec.policy = policy;
        self.catalogue_dirty = true;
        self.enforce();
    }

    /// Sets this node's sources of a share.
    pub fn set_sources(&mut self, now: Now, name: &Name, sources: Vec<Arc<SourceProgress>>) {
        self.now = now;
        let Some(share) = self.shares.shares.get_mut(name) else { return };
        let ids = |all: &[Arc<SourceProgress>]| all.iter().map(|s| s.announce().source).collect::<Vec<_>>();
        if ids(&share.own) == ids(&sources) {
            return;
        }
        share.own = sources;
        share.forget_floors();
        self.regrant(*name);
    }

    /// Sets the progress of this node's own sink of a share: later grants tell that received messages are past.
    pub fn set_own_sink(&mut self, name: &Name, progress: Arc<SinkProgress>) {
        if let Some(share) = self.shares.shares.get_mut(name) {
            share.heard = Some(progress);
        }
    }

    /// Ends a share: withdraws it everywhere, and tells its sinks.
    pub fn unshare(&mut self, now: Now, name: &Name) {
        self.now = now;
        let Some(share) = self.shares.shares.remove(name) else { return };
        for (sink, granted) in share.sinks {
            self.refuse(*name, sink, granted.serial + 1, RefuseReason::NotShared);
            self.event(Event::SinkLeft { name: *name, sink, peer: granted.peer.node_id });
        }
        self.unadvertised.remove(&share.blind);
        self.withdrawn.insert(share.blind);
        self.untold.remove(name);
        self.catalogue_dirty = true;
        if self.shares.shares.values().all(|share| share.described.is_none()) {
            self.withdraw_types();
        }
    }

    /// Returns the publishers of a share: by source, the sink that packets for it are addressed to.
    pub fn publishers(&self, name: &Name) -> BTreeMap<SourceId, SinkId> {
        let sinks = self.shares.shares.get(name).into_iter().flat_map(|share| &share.sinks);
        let publishers = sinks.filter_map(|(sink, granted)| match &granted.request {
            Request::Publish { offer } => Some((offer.source, *sink)),
            Request::Subscribe { .. } | Request::Ask { .. } => None,
        });
        publishers.collect()
    }

    /// Returns the key of a share, for its sources.
    pub fn share_grant(&self, name: &Name) -> Option<TopicGrant> {
        self.shares.shares.get(name).map(|s| s.grant(&s.epoch, None))
    }

    /// Returns `true` if the type of a share has a key, so that each of its instances has a history.
    pub fn is_keyed(&self, name: &Name) -> bool {
        self.shares.shares.get(name).is_some_and(|s| !s.spec.keyless)
    }

    /// Begins a new epoch of a share.
    pub fn rotate(&mut self, now: Now, name: &Name) {
        self.now = now;
        self.begin_epoch(*name);
    }

    /// Withdraws all names, for a clean shutdown.
    pub fn withdraw_all(&mut self, now: Now) {
        for name in self.shares.shares.keys().copied().collect::<Vec<_>>() {
            self.unshare(now, &name);
        }
        self.unadvertised.clear();
        // Nothing is collected any more.
        self.advert_pace = AdvertPace::default();
        for (name, blind) in std::mem::take(&mut self.catalogue_names) {
            self.end_catalogue(name, blind);
        }
        for name in [&mut self.renewal_name, &mut self.operations_name] {
            self.withdrawn.extend(name.take().map(|(_, blind)| blind));
        }
        self.withdraw_types();
        self.withdraw_consumers();
        self.renew_at = None;
        self.enforce_at = None;
        self.catalogue_rests = None;
    }

    /// Answers [`Event::RenewAsked`], once or again after a change.
    pub fn answer_renewal(&mut self, now: Now, sink: SinkId, answer: Result<Credentials, RefuseReason>) {
        self.now = now;
        let Some((name, _)) = self.renewal_name else { return };
        let Some(asked) = self.renewals.get_mut(&sink) else { return };
        asked.serial += 1;
        let (serial, reply_key) = (asked.serial, asked.reply_key.clone());
        let granted = match answer {
            Ok(credentials) => {
                self.grant(name, sink, serial, &reply_key, &GrantContent::Credentials(credentials))
            }
            Err(reason) => {
                self.refuse(name, sink, serial, reason);
                false
            }
        };
        if !granted {
            self.renewals.remove(&sink);
        }
    }

    /// Answers [`Event::OperationAsked`].
    pub fn answer_operation(
        &mut self,
        now: Now,
        sink: SinkId,
        answer: Result<OperationAnswer, RefuseReason>,
    ) {
        self.now = now;
        let Some((name, _)) = self.operations_name else { return };
        let Some(mut asked) = self.operations.remove(&sink) else { return };
        asked.serial += 1;
        match answer {
            Ok(answer) => {
                let (content, serial) = (GrantContent::Operation(answer), asked.serial);
                if self.grant(name, sink, serial, &asked.reply_key, &content) {
                    self.operations.insert(sink, asked);
                }
            }
            Err(reason) => self.refuse(name, sink, asked.serial, reason),
        }
    }

    /// Iterates over the members that ask this authority: sink, node, and signing request.
    pub fn renewing(&self) -> impl Iterator<Item = (SinkId, &VerifiedPeer, &Bytes)> {
        self.renewals.iter().filter_map(|(sink, asked)| match &asked.request {
            Request::Ask { what: csr } => Some((*sink, &asked.peer, csr)),
            Request::Subscribe { .. } | Request::Publish { .. } => None,
        })
    }

    pub(crate) fn end_catalogue(&mut self, name: Name, blind: Blind) {
        self.unadvertised.remove(&blind);
        self.withdrawn.insert(blind);
        let sinks: Vec<_> =
            self.shares.followers.keys().filter(|(n, _)| *n == name).map(|(_, s)| *s).collect();
        for sink in sinks {
            if let Some(granted) = self.shares.followers.remove(&(name, sink)) {
                self.refuse(name, sink, granted.serial + 1, RefuseReason::NotShared);
            }
        }
    }

    /// Cuts every node that has lost the right to its grant, and begins new epochs for the others.
    pub(crate) fn enforce(&mut self) {
        let mut cut = Vec::new();
        let mut names = BTreeSet::new();
        for (name, share) in &self.shares.shares {
            let denied = |peer: &VerifiedPeer, role| {
                let policy = &share.spec.policy;
                self.standing(peer).or_else(|| policy.permits(peer, role).err().map(refusal))
            };
            for (sink, granted) in &share.sinks {
                let denied = denied(&granted.peer, granted.request.role());
                cut.extend(denied.map(|reason| (*name, *sink, reason)));
            }
            // A node that left, or that a router cut off first, still knows the key.
            if share.left.values().any(|(peer, role)| denied(peer, *role).is_some()) {
                names.insert(*name);
            }
        }
        for (name, sink, reason) in cut {
            let Some(share) = self.shares.shares.get_mut(&name) else { continue };
            let Some(granted) = share.sinks.remove(&sink) else { continue };
            self.refuse(name, sink, granted.serial + 1, reason);
            self.event(Event::SinkCut { name, sink, peer: granted.peer.node_id, reason });
            names.insert(name);
        }
        self.forget_denied();
        for name in names {
            self.begin_epoch(name);
        }
        let lost = |(key, granted): (&(Name, SinkId), &GrantedSink)| {
            self.standing(&granted.peer).map(|reason| (*key, granted.serial + 1, reason))
        };
        let followers: Vec<_> = self.shares.followers.iter().filter_map(lost).collect();
        for ((name, sink), serial, reason) in followers {
            self.shares.followers.remove(&(name, sink));
            self.refuse(name, sink, serial, reason);
        }
        let standing: Vec<_> = self.renewals.keys().copied().collect();
        for sink in standing {
            let reason = self.renewals.get(&sink).and_then(|asked| self.standing(&asked.peer));
            if let Some(reason) = reason {
                self.answer_renewal(self.now, sink, Err(reason));
            }
        }
        let lost: Vec<_> = self
            .operations
            .iter()
            .filter_map(|(sink, asked)| Some((*sink, self.standing(&asked.peer)?)))
            .collect();
        for (sink, reason) in lost {
            self.answer_operation(self.now, sink, Err(reason));
        }
        self.enforce_types();
        self.enforce_consumers();
    }

    /// Forgets the history rights of peers that lost the right to a share: they begin anew if they get it back.
    fn forget_denied(&mut self) {
        let (anchors, now) = (self.anchors.clone(), self.now.unix);
        for share in self.shares.shares.values_mut() {
            let policy = &share.spec.policy;
            share.since.retain(|_, since| {
                let stands = anchors.stands(&since.peer) && since.peer.not_after >= now;
                stands && policy.permits(&since.peer, Role::Subscribe).is_ok()
            });
        }
    }

    /// Returns the reason why a peer with a once valid certificate may not have anything any more.
    pub(crate) fn standing(&self, peer: &VerifiedPeer) -> Option<RefuseReason> {
        if self.anchors.is_peer_revoked(peer) {
            Some(RefuseReason::Revoked)
        } else if !self.anchors.stands(peer) {
            // This node no longer trusts the peer's CA.
            Some(RefuseReason::NotVerified)
        } else if peer.not_after < self.now.unix {
            Some(RefuseReason::Expired)
        } else {
            None
        }
    }

    /// Makes the key of the next epoch and grants it. Sources use it once all sinks have it, or after a while.
    fn begin_epoch(&mut self, name: Name) {
        let limits = &self.config.limits;
        let (wait, every) = (limits.rotate_wait, limits.rotate_every);
        let Some(share) = self.shares.shares.get_mut(&name) else { return };
        // An epoch that never began is skipped, if some sinks have its key: a cut node may be one of them. The time
        // runs on from the first of these, or a series of them would delay the new key for ever. Sinks hold few keys,
        // so beyond that number the next epoch waits for its turn.
        let ahead = share.newest().number - share.epoch.number;
        let deadline = match &mut share.rotation {
            Some(rotation) if ahead >= EPOCHS_AHEAD_MAX => {
                rotation.again = true;
                return;
            }
            Some(rotation) => rotation.deadline,
            None => self.now.instant + wait,
        };
        let epoch = Epoch::new(share.newest().number.saturating_add(1), &mut self.rng);
        share.rotate_at = self.now.instant + every;
        share.left.clear();
        share.rotation = Some(Rotation { epoch, waiting: BTreeMap::new(), deadline, again: false });
        self.regrant(name);
        if let Some(Share { rotation: Some(rotation), sinks, .. }) = self.shares.shares.get_mut(&name) {
            rotation.waiting = sinks.iter().map(|(sink, s)| (*sink, s.serial)).collect();
        }
        self.finish_epoch(name);
    }

    /// Puts a new epoch into use if nothing keeps it waiting.
    fn finish_epoch(&mut self, name: Name) {
        let now = self.now.instant;
        let Some(share) = self.shares.shares.get_mut(&name) else { return };
        let ready = |r: &Rotation| r.waiting.is_empty() || r.deadline <= now;
        let Some(rotation) = share.rotation.take_if(|r| ready(r)) else { return };
        share.epoch = rotation.epoch;
        let grant = share.grant(&share.epoch, None);
        self.event(Event::Rekeyed { name, grant });
        if rotation.again {
            self.begin_epoch(name);
        }
    }

    pub(crate) fn rotation_deadline(&self) -> Option<Instant> {
        let of = |s: &Share| s.rotation.as_ref().map_or(s.rotate_at, |r| r.deadline);
        self.shares.shares.values().map(of).min()
    }

    pub(crate) fn rotate_due(&mut self) {
        let now = self.now.instant;
        let ended = |s: &Share| s.rotation.as_ref().is_some_and(|r| r.deadline <= now);
        let over = |s: &Share| s.rotation.is_none() && s.rotate_at <= now;
        let shares = &self.shares.shares;
        let ended: Vec<_> = shares.iter().filter(|(_, s)| ended(s)).map(|(n, _)| *n).collect();
        let over: Vec<_> = shares.iter().filter(|(_, s)| over(s)).map(|(n, _)| *n).collect();
        ended.into_iter().for_each(|name| self.finish_epoch(name));
        over.into_iter().for_each(|name| self.begin_epoch(name));
    }

    /// Grants the newest epoch to every sink again, because key or sources changed.
    fn regrant(&mut self, name: Name) {
        let Some(share) = self.shares.shares.get(&name) else { return };
        for sink in share.sinks.keys().copied().collect::<Vec<_>>() {
            self.grant_again(name, sink);
        }
        self.tell_own(name);
    }

    /// Tells every receiver of a share its publishers; this node alone receives those of a service.
    fn publishers_changed(&mut self, name: Name) {
        if self.shares.shares.get(&name).is_some_and(Share::is_service) {
            self.tell_own(name);
        } else {
            self.regrant(name);
        }
    }

    fn grant_again(&mut self, name: Name, sink: SinkId) {
        let Some(share) = self.shares.shares.get_mut(&name) else { return };
        let Some(granted) = share.sinks.get_mut(&sink) else { return };
        granted.serial += 1;
        let (serial, reply_key) = (granted.serial, granted.reply_key.clone());
        let content = GrantContent::Topic(share.grant(share.newest(), share.sinks.get(&sink)));
        if !self.grant(name, sink, serial, &reply_key, &content)
            && let Some(share) = self.shares.shares.get_mut(&name)
        {
            share.sinks.remove(&sink);
        }
    }

    /// Updates this node's own sink of a share on which others may publish.
    fn tell_own(&mut self, name: Name) {
        let Some(share) = self.shares.shares.get_mut(&name) else { return };
        share.told_own |= !share.spec.policy.publish.is_empty();
        if share.told_own {
            let grant = share.grant(share.newest(), None);
            self.event(Event::OwnGrant { name, grant });
        }
    }

    pub(crate) fn handle_ack(&mut self, name: Name, sink: SinkId, serial: u64) {
        let Some(share) = self.shares.shares.get_mut(&name) else {
            return self.unexpected("acknowledgement");
        };
        if let Some(rotation) = &mut share.rotation
            && rotation.waiting.get(&sink).is_some_and(|granted| *granted <= serial)
        {
            rotation.waiting.remove(&sink);
            self.finish_epoch(name);
        }
    }

    /// Returns the time at which followers get the collected changes.
    pub(crate) fn catalogue_deadline(&self) -> Option<Instant> {
        self.catalogue_rests.filter(|_| self.catalogue_dirty)
    }

    /// Sends each follower its catalogue if its visible part changed, at once the first time and then after a while: a
    /// network that starts makes hundreds of changes.
    pub(crate) fn tell_followers(&mut self) {
        if self.catalogue_rests.is_some_and(|until| self.now.instant < until)
            || !std::mem::take(&mut self.catalogue_dirty)
        {
            return;
        }
        self.catalogue_rests = Some(self.now.instant + CATALOGUE_REST);
        self.shares.version += 1;
        for (name, sink) in self.shares.followers.keys().copied().collect::<Vec<_>>() {
            self.tell_follower(name, sink);
        }
    }

    fn tell_follower(&mut self, name: Name, sink: SinkId) {
        let Some(follower) = self.shares.followers.get(&(name, sink)) else { return };
        let mut catalogue = self.shares.catalogue_for(&follower.peer);
        let left_out = fit(&mut catalogue);
        if follower.told.as_ref().is_some_and(|t| t.entries == catalogue.entries) {
            return;
        }
        if left_out > 0 {
            self.drop_frame(EndpointDrop::CatalogueTooLarge { left_out });
        }
        let Some(follower) = self.shares.followers.get_mut(&(name, sink)) else { return };
        follower.serial += 1;
        let (reply_key, serial) = (follower.reply_key.clone(), follower.serial);
        let content = GrantContent::Catalogue(catalogue.clone());
        follower.told = Some(catalogue);
        if !self.grant(name, sink, serial, &reply_key, &content) {
            self.shares.followers.remove(&(name, sink));
        }
    }

    /// Grants a request. Returns `false` if its reply key is unusable; the request is then refused.
    pub(crate) fn grant(
        &mut self,
        name: Name,
        sink: SinkId,
        serial: u64,
        reply_key: &[u8],
        content: &GrantContent,
    ) -> bool {
        match seal_grant(reply_key, &name, &sink, serial, content) {
            Ok((enc, sealed)) => {
                self.answer(AnswerBody { name, sink, serial, answer: Answer::Grant { enc, sealed } });
                true
            }
            Err(why) => {
                self.drop_frame(why.into());
                self.refuse(name, sink, serial, RefuseReason::NotVerified);
                false
            }
        }
    }

    pub(crate) fn refuse(&mut self, name: Name, sink: SinkId, serial: u64, reason: RefuseReason) {
        self.answer(AnswerBody { name, sink, serial, answer: Answer::Refuse { reason } });
    }

    fn answer(&mut self, body: AnswerBody) {
        let signed = self.config.identity.sign_answer(&body);
        self.send(Control::Answer { signed });
    }

    fn is_catalogue(&self, name: &Name) -> bool {
        self.catalogue_names.iter().any(|(n, _)| n == name)
    }

    fn is_renewal(&self, name: &Name) -> bool {
        self.renewal_name.is_some_and(|(n, _)| n == *name)
    }

    fn is_operations(&self, name: &Name) -> bool {
        self.operations_name.is_some_and(|(n, _)| n == *name)
    }

    pub(crate) fn handle_join(&mut self, signed: &SignedBody) {
        let join = match verify_join(&self.anchors, signed, self.now.unix) {
            Ok(join) => join,
            Err(why) => {
                // A malformed body may still contain name and sink for an answer. Only names of this node are answered,
                // or anybody could have anything signed.
                if let Ok(JoinBody { name, sink, .. }) = JoinBody::from_slice(&signed.body)
                    && (self.shares.shares.contains_key(&name)
                        || self.is_catalogue(&name)
                        || self.is_renewal(&name)
                        || self.is_operations(&name)
                        || self.is_types(&name)
                        || self.is_consumers(&name))
                {
                    self.refuse(name, sink, 1, why.refuse_reason());
                }
                self.drop_frame(EndpointDrop::NotVerified { what: "join", why });
                return;
            }
        };
        let JoinBody { name, sink, request, reply_key, issued_at, .. } = join.body;
        // In a post-quantum fleet nothing is granted that a recording could reveal later.
        let identity = &self.config.identity;
        let own_fleet = join.peer.ca == identity.as_peer().ca;
        if identity.post_quantum() && own_fleet && reply_key.len() != Kem::XWing.reply_key_bytes() {
            return self.refuse(name, sink, 1, RefuseReason::NotVerified);
        }
        let asked = GrantedSink { peer: join.peer, request, reply_key, issued_at, serial: 0, told: None };
        if self.is_catalogue(&name) {
            self.handle_follow(name, sink, asked);
        } else if self.is_renewal(&name) {
            self.handle_renew(name, sink, asked);
        } else if self.is_operations(&name) {
            self.handle_operation(name, sink, asked);
        } else if self.is_types(&name) {
            self.handle_type_question(name, sink, asked);
        } else if self.is_consumers(&name) {
            self.handle_consumer_question(name, sink, asked);
        } else {
            self.handle_subscribe_or_publish(name, sink, asked);
        }
    }

    fn handle_subscribe_or_publish(&mut self, name: Name, sink: SinkId, asked: GrantedSink) {
        let peer = asked.peer.node_id;
        let known = self.shares.shares.get(&name).and_then(|share| share.sinks.get(&sink));
        if known.is_some_and(|known| is_older(&asked, known)) {
            return self.unexpected(OLDER_REQUEST);
        }
        self.replace_publisher(&name, &sink, &asked);
        match self.admit(&name, &sink, &asked) {
            Ok(None) => {}
            Ok(Some(oldest)) => self.give_up_place(name, oldest),
            Err(reason) => {
                self.refuse(name, sink, 1, reason);
                self.event(Event::SinkRefused { name, peer, reason });
                return;
            }
        }
        let max = self.config.limits.sinks_per_name_max;
        let Some(share) = self.shares.shares.get_mut(&name) else { return };
        let reply_key = asked.reply_key.clone();
        let role = asked.request.role();
        let publishes = role == Role::Publish;
        // A request may come twice, on another route or under a new certificate: the serials of its answers keep
        // growing.
        let serial = share.sinks.get(&sink).map_or(0, |s| s.serial) + 1;
        if role == Role::Subscribe {
            share.note_since(&asked.peer, max);
        }
        let known = share.sinks.insert(sink, GrantedSink { serial, ..asked }).is_some();
        share.left.remove(&peer);
        let content = GrantContent::Topic(share.grant(&share.epoch, share.sinks.get(&sink)));
        if !self.grant(name, sink, serial, &reply_key, &content) {
            if let Some(share) = self.shares.shares.get_mut(&name) {
                share.sinks.remove(&sink);
            }
            return;
        }
        // The sink came between two epochs: it needs both keys.
        let between = self.shares.shares.get_mut(&name).and_then(|s| s.rotation.as_mut());
        if let Some(rotation) = between {
            rotation.waiting.insert(sink, serial + 1);
            self.grant_again(name, sink);
        }
        if !known {
            self.event(Event::SinkJoined { name, sink, peer, role });
        }
        if publishes && !known {
            self.publishers_changed(name);
        }
    }

    /// Replaces a publisher that asks again after a route change, which may come before its old sink has left.
    fn replace_publisher(&mut self, name: &Name, sink: &SinkId, asked: &GrantedSink) {
        let Some(share) = self.shares.shares.get_mut(name) else { return };
        let Request::Publish { offer } = &asked.request else { return };
        let same = |s: &GrantedSink| {
            let peer = s.peer.node_id == asked.peer.node_id;
            peer && matches!(&s.request, Request::Publish { offer: o } if o.source == offer.source)
        };
        let old = share.sinks.iter().find(|(id, s)| *id != sink && same(s)).map(|(id, _)| *id);
        if let Some(old) = old {
            self.handle_leave(*name, old);
        }
    }

    /// Decides whether a request for a share may be granted, and names the sink that has to give up its place for it.
    fn admit(&self, name: &Name, sink: &SinkId, asked: &GrantedSink) -> Result<Option<SinkId>, RefuseReason> {
        let share = self.shares.shares.get(name).ok_or(RefuseReason::NotShared)?;
        share.spec.policy.permits(&asked.peer, asked.request.role()).map_err(refusal)?;
        match &asked.request {
            Request::Ask { .. } => return Err(RefuseReason::RoleNotOffered),
            Request::Publish { offer } if offer.key.is_empty() == share.spec.suite.is_signed() => {
                return Err(RefuseReason::NotVerified);
            }
            // Two sources under one id would use one nonce twice.
            Request::Publish { offer } if share.has_source(&offer.source, sink) => {
                return Err(RefuseReason::NotPermitted);
            }
            Request::Publish { .. } | Request::Subscribe { .. } => {}
        }
        if let Some(known) = share.sinks.get(sink) {
            let same = known.peer.node_id == asked.peer.node_id && known.request == asked.request;
            return if same { Ok(None) } else { Err(RefuseReason::NotPermitted) };
        }
        place(share.sinks.iter(), asked, &self.config.limits)
    }

    /// Ends the oldest sink of a node that is at its limit.
    fn give_up_place(&mut self, name: Name, sink: SinkId) {
        let granted = self.shares.shares.get(&name).and_then(|share| share.sinks.get(&sink));
        let Some(serial) = granted.map(|granted| granted.serial + 1) else { return };
        self.handle_leave(name, sink);
        self.refuse(name, sink, serial, RefuseReason::Limit);
    }

    fn handle_follow(&mut self, name: Name, sink: SinkId, asked: GrantedSink) {
        let own_fleet = asked.peer.ca == self.config.identity.as_peer().ca;
        let place = if !matches!(asked.request, Request::Subscribe { .. }) {
            Err(RefuseReason::RoleNotOffered)
        } else if !own_fleet {
            Err(RefuseReason::NotPermitted)
        } else if let Some(known) = self.shares.followers.get(&(name, sink)) {
            if is_older(&asked, known) {
                return self.unexpected(OLDER_REQUEST);
            }
            if known.peer.node_id == asked.peer.node_id { Ok(None) } else { Err(RefuseReason::Limit) }
        } else {
            place(self.shares.followers.iter(), &asked, &self.config.limits)
        };
        match place {
            Err(reason) => return self.refuse(name, sink, 1, reason),
            Ok(None) => {}
            Ok(Some((name, oldest))) => {
                if let Some(granted) = self.shares.followers.remove(&(name, oldest)) {
                    self.refuse(name, oldest, granted.serial + 1, RefuseReason::Limit);
                }
            }
        }
        self.event(Event::Followed { peer: Box::new(asked.peer.clone()) });
        let serial = self.shares.followers.get(&(name, sink)).map_or(0, |f| f.serial);
        self.shares.followers.insert((name, sink), GrantedSink { serial, ..asked });
        self.tell_follower(name, sink);
    }

    fn handle_renew(&mut self, name: Name, sink: SinkId, asked: GrantedSink) {
        let own_fleet = asked.peer.ca == self.config.identity.as_peer().ca;
        let Request::Ask { what: csr } = asked.request.clone() else {
            return self.refuse(name, sink, 1, RefuseReason::RoleNotOffered);
        };
        if !own_fleet {
            return self.refuse(name, sink, 1, RefuseReason::NotPermitted);
        }
        let peer = asked.peer.clone();
        if is_of_another(&self.renewals, &sink, &peer.node_id) {
            return self.refuse(name, sink, 1, RefuseReason::NotPermitted);
        }
        let Ok(older) = take_older(&mut self.renewals, &sink, &asked) else {
            return self.unexpected(OLDER_REQUEST);
        };
        if let Some((older, serial)) = older {
            self.refuse(name, older, serial, RefuseReason::Limit);
        }
        if self.renewals.len() >= self.config.limits.sinks_per_name_max {
            return self.refuse(name, sink, 1, RefuseReason::Limit);
        }
        let serial = self.renewals.get(&sink).map_or(0, |s| s.serial);
        self.renewals.insert(sink, GrantedSink { serial, ..asked });
        self.event(Event::RenewAsked { sink, peer, csr });
    }

    fn handle_operation(&mut self, name: Name, sink: SinkId, asked: GrantedSink) {
        let own_fleet = asked.peer.ca == self.config.identity.as_peer().ca;
        let Request::Ask { what: request } = asked.request.clone() else {
            return self.refuse(name, sink, 1, RefuseReason::RoleNotOffered);
        };
        if !own_fleet {
            return self.refuse(name, sink, 1, RefuseReason::NotPermitted);
        }
        let peer = asked.peer.clone();
        if is_of_another(&self.operations, &sink, &peer.node_id) {
            return self.refuse(name, sink, 1, RefuseReason::NotPermitted);
        }
        let Ok(older) = take_older(&mut self.operations, &sink, &asked) else {
            return self.unexpected(OLDER_REQUEST);
        };
        if let Some((older, serial)) = older {
            self.refuse(name, older, serial, RefuseReason::Limit);
        }
        if self.operations.len() >= OPERATIONS_ASKED_MAX {
            return self.refuse(name, sink, 1, RefuseReason::Limit);
        }
        let serial = self.operations.get(&sink).map_or(0, |s| s.serial);
        self.operations.insert(sink, GrantedSink { serial, ..asked });
        self.event(Event::OperationAsked { sink, peer, request });
    }

    pub(crate) fn handle_leave(&mut self, name: Name, sink: SinkId) {
        if self.is_catalogue(&name) {
            self.shares.followers.remove(&(name, sink));
        } else if self.is_renewal(&name) {
            self.renewals.remove(&sink);
        } else if self.is_operations(&name) {
            self.operations.remove(&sink);
        } else if self.is_types(&name) {
            self.questions.remove(&sink);
        } else if self.is_consumers(&name) {
            self.consumer_askers.remove(&sink);
        } else if let Some(share) = self.shares.shares.get_mut(&name)
            && let Some(granted) = share.sinks.remove(&sink)
        {
            if let Some(rotation) = &mut share.rotation {
                rotation.waiting.remove(&sink);
            }
            let (peer, role) = (granted.peer.node_id, granted.request.role());
            share.left.insert(peer, (granted.peer, role));
            let too_many = share.left.len() > self.config.limits.sinks_per_name_max;
            self.event(Event::SinkLeft { name, sink, peer });
            self.finish_epoch(name);
            if too_many {
                self.begin_epoch(name);
            } else if role == Role::Publish {
                self.publishers_changed(name);
            }
        }
    }

    /// Handles a sink's request for messages. Of those published before it had the right it gets at most the history.
    pub(crate) fn handle_recover(&mut self, mut recover: Recover) {
        let share = self.shares.shares.get(&recover.name);
        let granted = share.and_then(|s| Some((s, s.sinks.get(&recover.sink)?)));
        match granted {
            Some((share, sink)) if sink.request.role() == Role::Subscribe => {
                if recover.from > 0 {
                    let floor = share.floor(&sink.peer.node_id, &recover.source);
                    recover.from = recover.from.max(floor.unwrap_or(u64::MAX));
                }
                self.event(Event::Recover(recover));
            }
            _ => self.unexpected("recover"),
        }
    }
}

/// Returns `true` if a request of a node was signed before another one of it, and so is a replay.
pub(crate) fn is_older(asked: &GrantedSink, known: &GrantedSink) -> bool {
    asked.peer.node_id == known.peer.node_id && asked.issued_at < known.issued_at
}

/// Returns the place that a request takes from its own node, if the node is at its limit: that of the request signed
/// first. Routers on the way may withhold leaves and replay requests, but sign none.
pub(crate) fn place<'a, K: Copy + 'a>(
    granted: impl ExactSizeIterator<Item = (&'a K, &'a GrantedSink)>,
    asked: &GrantedSink,
    limits: &Limits,
) -> Result<Option<K>, RefuseReason> {
    let all = granted.len();
    let of_peer: Vec<_> = granted
        .filter(|(_, s)| s.peer.node_id == asked.peer.node_id)
        .map(|(key, s)| (s.issued_at, *key))
        .collect();
    if of_peer.len() >= limits.sinks_per_peer_max {
        let oldest = of_peer.iter().min_by_key(|(issued_at, _)| *issued_at);
        let oldest = oldest.filter(|(issued_at, _)| *issued_at < asked.issued_at);
        return oldest.map(|(_, key)| Some(*key)).ok_or(RefuseReason::Limit);
    }
    if all >= limits.sinks_per_name_max { Err(RefuseReason::Limit) } else { Ok(None) }
}

/// Returns `true` if another node has the place of this sink.
fn is_of_another(granted: &BTreeMap<SinkId, GrantedSink>, sink: &SinkId, peer: &NodeId) -> bool {
    granted.get(sink).is_some_and(|known| known.peer.node_id != *peer)
}

/// A request that was signed before the known one of its node.
struct OlderRequest;

/// Gives the one place of a node to a request: the newer one is of the newer run, or of a newer certificate. Returns
/// the sink that had it, and the serial of its refusal; an error if that one was signed later, so that this one is a
/// replay.
fn take_older(
    granted: &mut BTreeMap<SinkId, GrantedSink>,
    sink: &SinkId,
    asked: &GrantedSink,
) -> Result<Option<(SinkId, u64)>, OlderRequest> {
    let other = granted.iter().find(|(id, s)| *id != sink && s.peer.node_id == asked.peer.node_id);
    let known = other.map(|(_, other)| other).or_else(|| granted.get(sink));
    if known.is_some_and(|known| is_older(asked, known)) {
        return Err(OlderRequest);
    }
    let other = other.map(|(id, s)| (*id, s.serial + 1));
    if let Some((older, _)) = &other {
        granted.remove(older);
    }
    Ok(other)
}

fn refusal(denied: DenialReason) -> RefuseReason {
    match denied {
        DenialReason::NotListed => RefuseReason::NotPermitted,
        DenialReason::Role => RefuseReason::RoleNotOffered,
    }
}

/// Makes a catalogue small enough to be sent: first without the nodes of its publishers, then without telling volatile
/// publishers apart, and last by leaving out entries. Returns the number of those.
fn fit(catalogue: &mut Catalogue) -> usize {
    let all = catalogue.entries.len();
    let room = SEALED_BYTES_MAX - 1024;
    catalogue.entries.truncate(CATALOGUE_ENTRIES_MAX);
    let fits = |entries: &[CatalogueEntry]| entries.iter().map(|e| e.to_vec().len()).sum::<usize>() <= room;
    if !fits(&catalogue.entries) {
        catalogue.entries.iter_mut().flat_map(|e| &mut e.sources).for_each(|s| s.node = None);
    }
    if !fits(&catalogue.entries) {
        let volatile = catalogue.entries.iter_mut().filter(|e| !e.qos.is_transient_local());
        volatile.for_each(|e| e.sources.clear());
    }
    let mut bytes = 0;
    catalogue.entries.retain(|e| {
        bytes += e.to_vec().len();
        bytes <= room
    });
    all - catalogue.entries.len()
}
