//! The machine: shares and joins of one node, catalogues of the owners it follows.

use std::collections::{BTreeMap, BTreeSet, VecDeque};
use std::sync::Arc;
use std::time::{Duration, Instant};

use rand_chacha::ChaCha20Rng;
use rand_core::RngCore;
use sgc_trust::{
    Denied, GrantError, Identity, SignedError, VerifiedPeer, derive_name, name_of, seal_grant, verify_advert,
    verify_answer, verify_join,
};
use sgc_wire::{
    ADVERT_NAMES_MAX, AdvertBody, Answer, AnswerBody, Blind, CATALOGUE_ENTRIES_MAX, Catalogue,
    CatalogueSource, Control, Decode, Encode, GrantContent, JoinBody, Metadata, Name, NodeId, Now, Qos,
    Recover, RefuseReason, RejectReason, Request, Role, SEALED_BYTES_MAX, SecretBytes, Signed, SinkId,
    SourceId, TopicGrant,
};

use crate::joins::{Join, JoinState, JoinStatus, LostReason, RefusedBy};
use crate::shares::{GrantedSink, Share, ShareError, ShareSpec, Shares};

/// Bounds and timers of an endpoint.
#[derive(Clone, Debug)]
pub struct Limits {
    /// Interfaces shared.
    pub shares_max: usize,
    /// Sinks granted per name.
    pub sinks_per_name_max: usize,
    /// How long an advertisement holds without being renewed; it is renewed after a third of it.
    pub lease: Duration,
}

impl Default for Limits {
    fn default() -> Self {
        Self { shares_max: 1024, sinks_per_name_max: 4096, lease: Duration::from_secs(60) }
    }
}

/// What an endpoint is made of.
#[derive(Clone, Debug)]
pub struct EndpointConfig {
    /// Who this node is.
    pub identity: Arc<Identity>,
    /// Bounds and timers.
    pub limits: Limits,
}

/// What the driver has to do.
#[derive(Clone, Debug)]
pub enum Output {
    /// Hand a frame to this node's router.
    Send(Control),
    /// Something happened that concerns the user of this endpoint.
    Event(Event),
    /// Something was refused; count it and, where it matters, say it.
    Dropped(Dropped),
    /// Nothing more to do until then, or until something happens.
    Timeout(Option<Instant>),
}

/// What happened.
#[derive(Clone, Debug)]
pub enum Event {
    /// A sink of a share was granted.
    SinkJoined {
        /// The share.
        name: Name,
        /// The sink.
        sink: SinkId,
        /// Whose it is.
        peer: NodeId,
    },
    /// A sink of a share is gone.
    SinkLeft {
        /// The share.
        name: Name,
        /// The sink.
        sink: SinkId,
    },
    /// A request to join a share was refused.
    SinkRefused {
        /// The share.
        name: Name,
        /// Who asked.
        peer: NodeId,
        /// Why not.
        reason: RefuseReason,
    },
    /// A granted sink asks one of this node's sources for messages.
    Recover(Recover),
    /// A join was granted.
    Granted {
        /// The name.
        name: Name,
        /// Its key.
        grant: TopicGrant,
    },
    /// A join was refused; it will be tried again.
    Refused {
        /// The name.
        name: Name,
        /// By whom and why.
        by: RefusedBy,
    },
    /// A granted join carries nothing until it is granted again.
    Lost {
        /// The name.
        name: Name,
        /// Why.
        reason: LostReason,
    },
    /// A followed owner's catalogue, whenever it changes.
    Catalogue {
        /// The owner.
        owner: NodeId,
        /// What it shares with this node.
        catalogue: Catalogue,
    },
    /// A followed owner is out of reach; its catalogue stands until it says otherwise.
    OwnerLost {
        /// The owner.
        owner: NodeId,
        /// Why.
        reason: LostReason,
    },
    /// A followed owner does not answer with a catalogue.
    OwnerRefused {
        /// The owner.
        owner: NodeId,
        /// By whom and why.
        by: RefusedBy,
    },
}

/// Why something was refused.
#[derive(Clone, Debug, thiserror::Error)]
pub enum Dropped {
    /// A signed body that does not verify.
    #[error("{what} not believed: {why}")]
    NotVerified {
        /// Advertisement, join or answer.
        what: &'static str,
        /// What is wrong with it.
        why: SignedError,
    },
    /// A grant that does not open.
    #[error("grant not usable: {0}")]
    Grant(#[from] GrantError),
    /// A frame that concerns nothing here.
    #[error("{what} that concerns nothing here")]
    Unexpected {
        /// Kind of frame.
        what: &'static str,
    },
    /// A catalogue too large to be sent; the asker got as many entries as fit.
    #[error("the catalogue for one node is too large: {left_out} entries left out")]
    CatalogueTooLarge {
        /// How many entries it lacks.
        left_out: usize,
    },
}

impl Dropped {
    /// A short, stable name for counters.
    pub fn key(&self) -> &'static str {
        match self {
            Self::NotVerified { .. } => "endpoint_not_verified",
            Self::Grant(_) => "endpoint_grant",
            Self::Unexpected { .. } => "endpoint_unexpected",
            Self::CatalogueTooLarge { .. } => "endpoint_catalogue_too_large",
        }
    }
}

/// The machine.
#[derive(Debug)]
pub struct Endpoint {
    config: EndpointConfig,
    rng: ChaCha20Rng,
    catalogue_name: Option<(Name, Blind)>,
    shares: Shares,
    joins: BTreeMap<Name, Join>,
    /// Catalogue names of followed owners.
    followed: BTreeMap<Name, NodeId>,
    catalogue_dirty: bool,
    unadvertised: BTreeSet<Blind>,
    withdrawn: BTreeSet<Blind>,
    advert_seq: u64,
    renew_at: Option<Instant>,
    outputs: VecDeque<Output>,
    now: Now,
}

impl Endpoint {
    /// An endpoint that shares nothing yet. With a fleet secret it advertises its catalogue at once.
    pub fn new(config: EndpointConfig, rng: ChaCha20Rng, now: Now) -> Self {
        let identity = &config.identity;
        let catalogue_name = identity.fleet_secret().map(|secret| {
            let metadata = Metadata::catalogue(identity.node_name().as_str());
            let blind = sgc_trust::TopicSecret::derive(secret, &metadata).blind();
            (name_of(&identity.node_id(), &blind), blind)
        });
        Self {
            unadvertised: catalogue_name.iter().map(|(_, b)| *b).collect(),
            config,
            rng,
            catalogue_name,
            shares: Shares::default(),
            joins: BTreeMap::new(),
            followed: BTreeMap::new(),
            catalogue_dirty: false,
            withdrawn: BTreeSet::new(),
            advert_seq: 0,
            renew_at: None,
            outputs: VecDeque::new(),
            now,
        }
    }

    /// Shares an interface under the name that its metadata gives.
    pub fn share(&mut self, now: Now, spec: ShareSpec) -> Result<Name, ShareError> {
        self.now = now;
        let secret = self.config.identity.fleet_secret().ok_or(ShareError::NoSecret)?;
        let blind = sgc_trust::TopicSecret::derive(secret, &spec.metadata).blind();
        let name = name_of(&self.config.identity.node_id(), &blind);
        if self.shares.shares.contains_key(&name) {
            let Metadata { ros_name, type_name, .. } = spec.metadata;
            return Err(ShareError::Duplicate { ros_name, type_name });
        }
        if self.shares.shares.len() >= self.config.limits.shares_max {
            return Err(ShareError::Limit { max: self.config.limits.shares_max });
        }
        let mut key = [0; 32];
        self.rng.fill_bytes(&mut key);
        let grant = TopicGrant {
            epoch: 1,
            suite: spec.suite.id(),
            key: SecretBytes::new(key),
            sources: Vec::new(),
            entry: None,
        };
        self.shares.shares.insert(name, Share { spec, blind, grant, sinks: BTreeMap::new() });
        self.withdrawn.remove(&blind);
        self.unadvertised.insert(blind);
        self.catalogue_dirty = true;
        Ok(name)
    }

    /// Changes what a share offers; its name and key stay.
    pub fn update_share(&mut self, now: Now, name: &Name, qos: Qos, sources: Vec<CatalogueSource>) {
        self.now = now;
        if let Some(share) = self.shares.shares.get_mut(name)
            && (share.spec.qos != qos || share.spec.sources != sources)
        {
            share.spec.qos = qos;
            share.spec.sources = sources;
            self.catalogue_dirty = true;
        }
    }

    /// Changes who may join a share.
    pub fn update_policy(&mut self, now: Now, name: &Name, policy: sgc_trust::Policy) {
        self.now = now;
        if let Some(share) = self.shares.shares.get_mut(name)
            && share.spec.policy != policy
        {
            share.spec.policy = policy;
            self.catalogue_dirty = true;
        }
    }

    /// Ends a share: withdrawn everywhere, its sinks told.
    pub fn unshare(&mut self, now: Now, name: &Name) {
        self.now = now;
        let Some(share) = self.shares.shares.remove(name) else { return };
        for (sink, granted) in share.sinks {
            self.refuse(*name, sink, granted.serial + 1, RefuseReason::NotShared);
            self.outputs.push_back(Output::Event(Event::SinkLeft { name: *name, sink }));
        }
        self.unadvertised.remove(&share.blind);
        self.withdrawn.insert(share.blind);
        self.catalogue_dirty = true;
    }

    /// The key of a share, for its sources.
    pub fn share_grant(&self, name: &Name) -> Option<&TopicGrant> {
        self.shares.shares.get(name).map(|s| &s.grant)
    }

    /// A fresh random id for a source.
    pub fn new_source_id(&mut self) -> SourceId {
        let mut id = [0; 16];
        self.rng.fill_bytes(&mut id);
        SourceId(id)
    }

    /// Follows a fleet member's catalogue; false if this identity holds no fleet secret to find it with.
    pub fn follow(&mut self, now: Now, owner_name: &str) -> bool {
        let identity = self.config.identity.clone();
        let (Some(secret), Some(owner)) = (identity.fleet_secret(), identity.node_id_of(owner_name)) else {
            return false;
        };
        let name = derive_name(secret, &owner, &Metadata::catalogue(owner_name));
        self.followed.insert(name, owner);
        self.join(now, name, owner);
        true
    }

    /// Follows an owner no longer.
    pub fn unfollow(&mut self, now: Now, owner: &NodeId) {
        let names: Vec<_> = self.followed.iter().filter(|(_, o)| *o == owner).map(|(n, _)| *n).collect();
        names.iter().for_each(|name| self.leave(now, name));
    }

    /// Joins a name of `owner`; waits for it if need be, and joins again whenever it must.
    pub fn join(&mut self, now: Now, name: Name, owner: NodeId) {
        self.now = now;
        if self.joins.contains_key(&name) {
            return;
        }
        self.joins.insert(name, Join::new(owner));
        self.outputs.push_back(Output::Send(Control::Interest { names: vec![name] }));
    }

    /// Leaves a name.
    pub fn leave(&mut self, now: Now, name: &Name) {
        self.now = now;
        let Some(join) = self.joins.remove(name) else { return };
        self.followed.remove(name);
        if let Some(sink) = join.sink() {
            self.outputs.push_back(Output::Send(Control::Leave { name: *name, sink }));
        }
        self.outputs.push_back(Output::Send(Control::Uninterest { names: vec![*name] }));
    }

    /// Asks a source of a granted name for its messages `from..=to`.
    pub fn recover(&mut self, name: Name, source: SourceId, from: u64, to: u64) {
        if let Some(JoinState::Granted { sink, .. }) = self.joins.get(&name).map(|j| &j.state) {
            let recover = Recover { name, sink: *sink, source, from, to };
            self.outputs.push_back(Output::Send(Control::Recover(recover)));
        }
    }

    /// Takes back all names, for a clean shutdown.
    pub fn withdraw_all(&mut self, now: Now) {
        for name in self.shares.shares.keys().copied().collect::<Vec<_>>() {
            self.unshare(now, &name);
        }
        self.unadvertised.clear();
        if let Some((name, blind)) = self.catalogue_name.take() {
            self.withdrawn.insert(blind);
            for (sink, granted) in std::mem::take(&mut self.shares.followers) {
                self.refuse(name, sink, granted.serial + 1, RefuseReason::NotShared);
            }
        }
        self.renew_at = None;
    }

    /// A frame from this node's router.
    pub fn handle_frame(&mut self, now: Now, frame: Control) {
        self.now = now;
        match frame {
            Control::Advert { signed, .. } => self.handle_advert(&signed),
            Control::Unreach { names } => {
                for name in names {
                    self.lose(name, LostReason::Unreachable, false);
                }
            }
            Control::Join { signed } => self.handle_join(&signed),
            Control::Leave { name, sink } => self.handle_leave(name, sink),
            Control::Answer { signed } => self.handle_answer(&signed),
            Control::Reject { name, sink, reason } => self.handle_reject(name, sink, reason),
            Control::Recover(recover) => self.handle_recover(recover),
            Control::Hello(_) => self.unexpected("hello"),
            Control::Interest { .. } | Control::Uninterest { .. } => self.unexpected("interest"),
            Control::Goodbye => self.unexpected("goodbye"),
            Control::Crl { .. } => self.unexpected("revocation list"),
            Control::Ack { .. } => self.unexpected("acknowledgement"),
        }
    }

    /// Time passed.
    pub fn handle_timeout(&mut self, now: Now) {
        self.now = now;
        if self.renew_at.is_some_and(|at| at <= now.instant) {
            self.unadvertised.extend(self.catalogue_name.iter().map(|(_, b)| *b));
            self.unadvertised.extend(self.shares.shares.values().map(|s| s.blind));
            self.renew_at = None;
        }
        let due: Vec<_> = self
            .joins
            .iter()
            .filter(|(_, j)| j.deadline().is_some_and(|at| at <= now.instant))
            .map(|(n, _)| *n)
            .collect();
        for name in due {
            if let Some(Join { state: JoinState::ExpectAnswer { sink, .. }, .. }) = self.joins.get(&name) {
                let sink = *sink;
                self.outputs.push_back(Output::Send(Control::Leave { name, sink }));
            }
            self.ask(name);
        }
    }

    /// The next thing to do; call until it is [`Output::Timeout`].
    pub fn poll_output(&mut self) -> Output {
        if self.outputs.is_empty() {
            self.advertise();
            self.tell_followers();
        }
        self.outputs.pop_front().unwrap_or_else(|| {
            let joins = self.joins.values().filter_map(Join::deadline);
            Output::Timeout(joins.chain(self.renew_at).min())
        })
    }

    /// The name of this node's catalogue; `None` for a router's identity, or after shutdown.
    pub fn catalogue_name(&self) -> Option<Name> {
        self.catalogue_name.map(|(name, _)| name)
    }

    /// Where a join stands.
    pub fn join_status(&self, name: &Name) -> Option<JoinStatus> {
        self.joins.get(name).map(Join::status)
    }

    /// Where the following of an owner stands.
    pub fn follow_status(&self, owner: &NodeId) -> Option<JoinStatus> {
        let (name, _) = self.followed.iter().find(|(_, o)| *o == owner)?;
        self.join_status(name)
    }

    /// Who was granted a share.
    pub fn granted(&self, name: &Name) -> Vec<(SinkId, NodeId)> {
        self.shares.granted(name).collect()
    }

    /// Sends what is due of advertisements and withdrawals, as many names in one as fit.
    fn advertise(&mut self) {
        for withdraw in [true, false] {
            let due = std::mem::take(if withdraw { &mut self.withdrawn } else { &mut self.unadvertised });
            let due: Vec<_> = due.into_iter().collect();
            for blinds in due.chunks(ADVERT_NAMES_MAX) {
                // The clock keeps sequence numbers growing over restarts.
                self.advert_seq = self.now.unix.0.max(self.advert_seq + 1);
                let body = AdvertBody {
                    chain: self.config.identity.chain_bytes(),
                    seq: self.advert_seq,
                    issued_at: self.now.unix,
                    lease_ms: self.config.limits.lease.as_millis().try_into().unwrap_or(u32::MAX),
                    withdraw,
                    blinds: blinds.to_vec(),
                };
                let signed = self.config.identity.sign_advert(&body);
                self.outputs.push_back(Output::Send(Control::Advert { hops: 0, signed }));
                if !withdraw {
                    self.renew_at.get_or_insert(self.now.instant + self.config.limits.lease / 3);
                }
            }
        }
    }

    /// Sends each follower its catalogue if what it may see changed.
    fn tell_followers(&mut self) {
        if !std::mem::take(&mut self.catalogue_dirty) {
            return;
        }
        self.shares.version += 1;
        for sink in self.shares.followers.keys().copied().collect::<Vec<_>>() {
            self.tell_follower(sink);
        }
    }

    fn tell_follower(&mut self, sink: SinkId) {
        let Some((name, _)) = self.catalogue_name else { return };
        let Some(follower) = self.shares.followers.get(&sink) else { return };
        let mut catalogue = self.shares.catalogue_for(&follower.peer);
        let left_out = fit(&mut catalogue);
        if follower.told.as_ref().is_some_and(|t| t.entries == catalogue.entries) {
            return;
        }
        if left_out > 0 {
            self.outputs.push_back(Output::Dropped(Dropped::CatalogueTooLarge { left_out }));
        }
        let Some(follower) = self.shares.followers.get_mut(&sink) else { return };
        follower.serial += 1;
        let (reply_key, serial) = (follower.reply_key.clone(), follower.serial);
        let content = GrantContent::Catalogue(catalogue.clone());
        follower.told = Some(catalogue);
        if !self.grant(name, sink, serial, &reply_key, &content) {
            self.shares.followers.remove(&sink);
        }
    }

    /// Answers yes; false if the request's reply key is unusable, which is answered with no.
    fn grant(
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
                self.outputs.push_back(Output::Dropped(why.into()));
                self.refuse(name, sink, serial, RefuseReason::NotVerified);
                false
            }
        }
    }

    fn refuse(&mut self, name: Name, sink: SinkId, serial: u64, reason: RefuseReason) {
        self.answer(AnswerBody { name, sink, serial, answer: Answer::Refuse { reason } });
    }

    fn answer(&mut self, body: AnswerBody) {
        let signed = self.config.identity.sign_answer(&body);
        self.outputs.push_back(Output::Send(Control::Answer { signed }));
    }

    fn handle_join(&mut self, signed: &Signed) {
        let join = match verify_join(self.config.identity.anchors(), signed, self.now.unix) {
            Ok(join) => join,
            Err(why) => {
                // Answered as well as can be: the body may at least say whom to answer. Only for a name of ours, or
                // anybody could have anything signed.
                if let Ok(JoinBody { name, sink, .. }) = JoinBody::from_slice(&signed.body)
                    && (self.shares.shares.contains_key(&name)
                        || self.catalogue_name.is_some_and(|(n, _)| n == name))
                {
                    self.refuse(name, sink, 1, RefuseReason::NotVerified);
                }
                self.outputs.push_back(Output::Dropped(Dropped::NotVerified { what: "join", why }));
                return;
            }
        };
        let JoinBody { name, sink, request, reply_key, .. } = join.body;
        let role = request.role();
        let granted = GrantedSink { peer: join.peer, reply_key, serial: 0, told: None };
        if self.catalogue_name.is_some_and(|(n, _)| n == name) {
            self.handle_follow(name, sink, role, granted);
            return;
        }
        let peer = granted.peer.node_id;
        let refused = match self.shares.shares.get(&name) {
            None => Some(RefuseReason::NotShared),
            Some(share) => match share.spec.policy.permits(&granted.peer, role) {
                Err(Denied::NotListed) => Some(RefuseReason::NotPermitted),
                Err(Denied::Role) => Some(RefuseReason::RoleNotOffered),
                Ok(_) if share.sinks.len() >= self.config.limits.sinks_per_name_max => {
                    Some(RefuseReason::Limit)
                }
                Ok(_) => None,
            },
        };
        if let Some(reason) = refused {
            self.refuse(name, sink, 1, reason);
            self.outputs.push_back(Output::Event(Event::SinkRefused { name, peer, reason }));
            return;
        }
        let Some(share) = self.shares.shares.get_mut(&name) else { return };
        let content = GrantContent::Topic(share.grant.clone());
        let reply_key = granted.reply_key.clone();
        // A request may come twice, on another way or replayed: its answers keep growing numbers.
        let serial = share.sinks.get(&sink).map_or(0, |s| s.serial) + 1;
        share.sinks.insert(sink, GrantedSink { serial, ..granted });
        if self.grant(name, sink, serial, &reply_key, &content) {
            self.outputs.push_back(Output::Event(Event::SinkJoined { name, sink, peer }));
        } else if let Some(share) = self.shares.shares.get_mut(&name) {
            share.sinks.remove(&sink);
        }
    }

    fn handle_follow(&mut self, name: Name, sink: SinkId, role: Role, granted: GrantedSink) {
        let own_fleet = granted.peer.ca == self.config.identity.as_peer().ca;
        let refused = if role != Role::Subscribe {
            Some(RefuseReason::RoleNotOffered)
        } else if !own_fleet {
            Some(RefuseReason::NotPermitted)
        } else if self.shares.followers.len() >= self.config.limits.sinks_per_name_max {
            Some(RefuseReason::Limit)
        } else {
            None
        };
        match refused {
            Some(reason) => self.refuse(name, sink, 1, reason),
            None => {
                let serial = self.shares.followers.get(&sink).map_or(0, |f| f.serial);
                self.shares.followers.insert(sink, GrantedSink { serial, ..granted });
                self.tell_follower(sink);
            }
        }
    }

    fn handle_leave(&mut self, name: Name, sink: SinkId) {
        if self.catalogue_name.is_some_and(|(n, _)| n == name) {
            self.shares.followers.remove(&sink);
        } else if let Some(share) = self.shares.shares.get_mut(&name)
            && share.sinks.remove(&sink).is_some()
        {
            self.outputs.push_back(Output::Event(Event::SinkLeft { name, sink }));
        }
    }

    fn handle_recover(&mut self, recover: Recover) {
        let granted =
            self.shares.shares.get(&recover.name).is_some_and(|s| s.sinks.contains_key(&recover.sink));
        if granted {
            self.outputs.push_back(Output::Event(Event::Recover(recover)));
        } else {
            self.unexpected("recover");
        }
    }

    fn handle_advert(&mut self, signed: &Signed) {
        let advert = match verify_advert(self.config.identity.anchors(), signed, self.now.unix) {
            Ok(advert) => advert,
            Err(why) => {
                let dropped = Dropped::NotVerified { what: "advertisement", why };
                self.outputs.push_back(Output::Dropped(dropped));
                return;
            }
        };
        for name in advert.names {
            let Some(join) = self.joins.get_mut(&name).filter(|j| j.owner == advert.owner.node_id) else {
                continue; // another name of the same batch
            };
            if advert.body.withdraw {
                self.lose(name, LostReason::Withdrawn, true);
                continue;
            }
            join.reachable = Some(advert.owner.clone());
            match join.state {
                JoinState::ExpectAdvert | JoinState::ExpectRetry { refused: None, .. } => self.ask(name),
                _ => {}
            }
        }
    }

    /// The way to a name's owner is gone.
    fn lose(&mut self, name: Name, reason: LostReason, withdrawn: bool) {
        let Some(join) = self.joins.get_mut(&name) else { return };
        join.reachable = None;
        let was = std::mem::replace(&mut join.state, JoinState::ExpectAdvert);
        join.succeeded();
        if let JoinState::Granted { .. } = was {
            self.lost(name, reason);
        } else if withdrawn && let Some(owner) = self.followed.get(&name) {
            let owner = *owner;
            self.outputs.push_back(Output::Event(Event::OwnerLost { owner, reason }));
        }
    }

    fn lost(&mut self, name: Name, reason: LostReason) {
        let event = match self.followed.get(&name) {
            Some(owner) => Event::OwnerLost { owner: *owner, reason },
            None => Event::Lost { name, reason },
        };
        self.outputs.push_back(Output::Event(event));
    }

    fn refused(&mut self, name: Name, by: RefusedBy) {
        let event = match self.followed.get(&name) {
            Some(owner) => Event::OwnerRefused { owner: *owner, by },
            None => Event::Refused { name, by },
        };
        self.outputs.push_back(Output::Event(event));
    }

    /// Asks the owner of `name`, if there is a way to it.
    fn ask(&mut self, name: Name) {
        let Some(join) = self.joins.get_mut(&name) else { return };
        if join.reachable.is_none() {
            join.state = JoinState::ExpectAdvert;
            return;
        }
        let (sink, reply_key) = join.ask(self.now.instant, &mut self.rng);
        let body = JoinBody {
            name,
            sink,
            request: Request::Subscribe { describe: false },
            issued_at: self.now.unix,
            chain: self.config.identity.chain_bytes(),
            reply_key,
        };
        let signed = self.config.identity.sign_join(&body);
        self.outputs.push_back(Output::Send(Control::Join { signed }));
    }

    fn handle_answer(&mut self, signed: &Signed) {
        let Ok(claimed) = AnswerBody::from_slice(&signed.body) else {
            return self.unexpected("answer");
        };
        let Some(owner) = self.joins.get(&claimed.name).and_then(|j| j.reachable.clone()) else {
            return self.unexpected("answer");
        };
        match verify_answer(&owner, signed) {
            Ok(body) => self.handle_verified_answer(&owner, body),
            Err(why) => {
                self.outputs.push_back(Output::Dropped(Dropped::NotVerified { what: "answer", why }));
            }
        }
    }

    fn handle_verified_answer(&mut self, owner: &VerifiedPeer, body: AnswerBody) {
        let AnswerBody { name, sink, serial, answer } = body;
        let Some(join) = self.joins.get_mut(&name).filter(|j| j.sink() == Some(sink)) else {
            return self.unexpected("answer");
        };
        let state = std::mem::replace(&mut join.state, JoinState::ExpectAdvert);
        let (reply_key, last, was_granted) = match state {
            JoinState::ExpectAnswer { reply_key, .. } => (reply_key, 0, false),
            JoinState::Granted { reply_key, serial, .. } => (reply_key, serial, true),
            other => {
                join.state = other;
                return;
            }
        };
        if serial <= last {
            join.state = JoinState::Granted { sink, reply_key, serial: last };
            return self.unexpected("answer");
        }
        let (enc, sealed) = match answer {
            Answer::Grant { enc, sealed } => (enc, sealed),
            Answer::Refuse { reason } => {
                let by = RefusedBy::Owner(reason);
                join.retry(self.now.instant, Some(by), &mut self.rng);
                if was_granted {
                    self.lost(name, LostReason::Refused(reason));
                }
                // That a share has ended is no refusal: it is what the owner wanted.
                if !(was_granted && reason == RefuseReason::NotShared) {
                    self.refused(name, by);
                }
                return;
            }
        };
        match reply_key.open(&name, &sink, serial, &enc, &sealed) {
            Ok(content) => {
                join.succeeded();
                join.state = JoinState::Granted { sink, reply_key, serial };
                match (content, self.followed.get(&name)) {
                    (GrantContent::Catalogue(catalogue), Some(_)) => {
                        let owner = owner.node_id;
                        self.outputs.push_back(Output::Event(Event::Catalogue { owner, catalogue }));
                    }
                    (GrantContent::Topic(grant), None) => {
                        self.outputs.push_back(Output::Event(Event::Granted { name, grant }));
                    }
                    _ => self.unexpected("kind of grant"),
                }
            }
            Err(why) => {
                join.retry(self.now.instant, None, &mut self.rng);
                self.outputs.push_back(Output::Send(Control::Leave { name, sink }));
                self.outputs.push_back(Output::Dropped(why.into()));
            }
        }
    }

    fn handle_reject(&mut self, name: Name, sink: SinkId, reason: RejectReason) {
        let Some(join) = self.joins.get_mut(&name).filter(|j| j.sink() == Some(sink)) else {
            return self.unexpected("reject");
        };
        let was_granted = matches!(join.state, JoinState::Granted { .. });
        let by = RefusedBy::Router(reason);
        // A broken way mends by itself; anything else the user should see while it is retried.
        let visible = !matches!(reason, RejectReason::RouteLost | RejectReason::NoRoute);
        join.retry(self.now.instant, visible.then_some(by), &mut self.rng);
        if was_granted {
            self.lost(name, LostReason::Cut(reason));
        }
        if visible {
            self.refused(name, by);
        }
    }

    fn unexpected(&mut self, what: &'static str) {
        self.outputs.push_back(Output::Dropped(Dropped::Unexpected { what }));
    }
}

/// Leaves out entries until the catalogue can be sent; returns how many.
fn fit(catalogue: &mut Catalogue) -> usize {
    let all = catalogue.entries.len();
    let mut bytes = 0;
    let room = SEALED_BYTES_MAX - 1024;
    catalogue.entries.truncate(CATALOGUE_ENTRIES_MAX);
    catalogue.entries.retain(|e| {
        bytes += e.to_vec().len();
        bytes <= room
    });
    all - catalogue.entries.len()
}
