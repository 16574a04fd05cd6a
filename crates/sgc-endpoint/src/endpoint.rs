//! The endpoint's state machine: the user's requests, the router's frames, and the time, in; frames and events out.
//!
//! `owner.rs` has its part as the owner of names, `joiner.rs` its part as the joiner of others' names.

use std::collections::{BTreeMap, BTreeSet, VecDeque};
use std::sync::Arc;
use std::time::{Duration, Instant};

use rand_chacha::ChaCha20Rng;
use rand_core::RngCore;
use sgc_trust::{
    GrantError, Identity, SignedError, TrustAnchors, name_of, next_seq, operations_blind, renewal_blind,
};
use sgc_wire::{
    ADVERT_NAMES_MAX, AdvertBody, Blind, Catalogue, ClockWatch, Consumer, Control, Credentials,
    DescribedType, Metadata, Name, NodeId, Now, OperationAnswer, Recover, RefuseReason, Role, SinkId,
    SourceId, TopicGrant,
};

use crate::advert_pace::AdvertPace;
use crate::consumers::{ConsumerAsker, consumers_name};
use crate::joins::{Join, JoinState, JoinStatus, LostReason, RefusedBy};
use crate::shares::{GrantedSink, Shares};
use crate::type_exchange::{TypeAsker, types_name};

/// Interval of looking for expired certificates, which no other event reports.
const ENFORCE_EVERY: Duration = Duration::from_secs(20);

/// Advertisements and withdrawals after which all names are advertised together again: routers keep 512 of an owner
/// (docs/spec/routing.md), and each takes memory there for as long as it speaks for one name.
const ADVERTS_APART_MAX: usize = 64;

/// Bounds and timers of an endpoint.
#[derive(Clone, Debug)]
pub struct Limits {
    /// Shared interfaces.
    pub shares_max: usize,
    /// Sinks granted per name.
    pub sinks_per_name_max: usize,
    /// Sinks of one node granted per name.
    pub sinks_per_peer_max: usize,
    /// Lifetime of an advertisement; it is renewed after a third of it.
    pub lease: Duration,
    /// Lifetime of an epoch if nothing ends it earlier.
    pub rotate_every: Duration,
    /// Time that a new epoch waits for sinks that have not acknowledged its key.
    pub rotate_wait: Duration,
}

impl Default for Limits {
    fn default() -> Self {
        Self {
            shares_max: 1024,
            sinks_per_name_max: 4096,
            sinks_per_peer_max: 16,
            lease: Duration::from_secs(300),
            rotate_every: Duration::from_secs(3600),
            rotate_wait: Duration::from_secs(1),
        }
    }
}

/// Parameters of an endpoint.
#[derive(Clone, Debug)]
pub struct EndpointConfig {
    /// This node's identity.
    pub identity: Arc<Identity>,
    /// Whether this node gives members their certificates.
    pub authority: bool,
    /// Whether this authority carries out operations for operators.
    pub operations: bool,
    /// Bounds and timers.
    pub limits: Limits,
}

/// Work for the driver.
#[derive(Clone, Debug)]
pub enum Output {
    /// Hand a frame to this node's router.
    Send(Control),
    /// An event for the user of this endpoint.
    Event(Event),
    /// A frame or body was dropped: count it and, where it matters, log it.
    Dropped(EndpointDrop),
    /// Nothing more to do until this time, or until something happens.
    Timeout(Option<Instant>),
}

/// An event.
#[derive(Clone, Debug)]
pub enum Event {
    /// A sink of a share was granted.
    SinkJoined {
        /// The share.
        name: Name,
        /// The sink.
        sink: SinkId,
        /// The sink's node.
        peer: NodeId,
        /// Whether it receives or publishes.
        role: Role,
    },
    /// A sink of a share is gone.
    SinkLeft {
        /// The share.
        name: Name,
        /// The sink.
        sink: SinkId,
        /// The sink's node.
        peer: NodeId,
    },
    /// A sink of a share lost its right; a new epoch begins for the others.
    SinkCut {
        /// The share.
        name: Name,
        /// The sink.
        sink: SinkId,
        /// The sink's node.
        peer: NodeId,
        /// The reason.
        reason: RefuseReason,
    },
    /// An epoch of a share begins: its sources publish under this key from now on.
    Rekeyed {
        /// The share.
        name: Name,
        /// The new key.
        grant: TopicGrant,
    },
    /// Key and sources for this node's own sink of a share that others publish on.
    OwnGrant {
        /// The share.
        name: Name,
        /// Key and sources.
        grant: TopicGrant,
    },
    /// A member asks this authority for a certificate; [`Endpoint::answer_renewal`] answers.
    RenewAsked {
        /// The sink to answer.
        sink: SinkId,
        /// The member.
        peer: sgc_trust::VerifiedPeer,
        /// Signing request (PKCS #10), DER.
        csr: bytes::Bytes,
    },
    /// The authority sent credentials.
    Renewed {
        /// Certificate and secrets.
        credentials: Credentials,
    },
    /// The authority does not give this node credentials.
    RenewRefused {
        /// The refusing node, with the reason.
        by: RefusedBy,
    },
    /// A node of this fleet asks this authority for an operation; [`Endpoint::answer_operation`] answers.
    OperationAsked {
        /// The sink to answer.
        sink: SinkId,
        /// The node.
        peer: sgc_trust::VerifiedPeer,
        /// An encoded [`sgc_wire::OperationRequest`], not verified.
        request: bytes::Bytes,
    },
    /// An authority answered an operation.
    OperationAnswered {
        /// The name of the request.
        name: Name,
        /// The answer.
        answer: OperationAnswer,
    },
    /// An authority, or a router before it, refuses requests for operations.
    OperationDenied {
        /// The name of the request.
        name: Name,
        /// The refusing node, with the reason.
        by: RefusedBy,
    },
    /// A member asked to follow what this node shares. The event repeats with each request of that member.
    Followed {
        /// The member.
        peer: Box<sgc_trust::VerifiedPeer>,
    },
    /// A request to join a share was refused.
    SinkRefused {
        /// The share.
        name: Name,
        /// The requester.
        peer: NodeId,
        /// The reason.
        reason: RefuseReason,
    },
    /// A granted sink asks one of this node's sources for messages.
    Recover(Recover),
    /// A join was granted, or its grant changed.
    Granted {
        /// The name.
        name: Name,
        /// The granted sink; another one after the route to the owner changed.
        sink: SinkId,
        /// Key and sources.
        grant: TopicGrant,
    },
    /// A join was refused; it will be tried again.
    Refused {
        /// The name.
        name: Name,
        /// The refusing node, with the reason.
        by: RefusedBy,
    },
    /// A granted join carries nothing until it is granted again.
    Lost {
        /// The name.
        name: Name,
        /// The reason.
        reason: LostReason,
    },
    /// An owner's descriptions of requested types of its interfaces; not verified yet.
    Types {
        /// The owner.
        owner: NodeId,
        /// The types.
        types: Vec<DescribedType>,
    },
    /// A node's consumers of this node's interfaces, whenever they change; not limited to interfaces that were granted
    /// to it.
    Consumers {
        /// The node.
        peer: NodeId,
        /// Its consumers.
        consumers: Vec<Consumer>,
    },
    /// A node does not report its consumers any more, until the next [`Event::Consumers`].
    ConsumersLost {
        /// The node.
        peer: NodeId,
        /// The reason.
        reason: LostReason,
    },
    /// A followed owner's catalogue, whenever it changes.
    Catalogue {
        /// The owner.
        owner: NodeId,
        /// Its shares, as this node may see them.
        catalogue: Catalogue,
    },
    /// A followed owner is out of reach; its catalogue stands until the next one comes.
    OwnerLost {
        /// The owner.
        owner: NodeId,
        /// The reason.
        reason: LostReason,
    },
    /// A followed owner does not answer with a catalogue.
    OwnerRefused {
        /// The owner.
        owner: NodeId,
        /// The refusing node, with the reason.
        by: RefusedBy,
    },
}

/// The reason why a frame or body was dropped.
#[derive(Clone, Debug, thiserror::Error)]
pub enum EndpointDrop {
    /// A signed body that does not verify.
    #[error("{what} not believed: {why}")]
    NotVerified {
        /// Advertisement, join or answer.
        what: &'static str,
        /// The error of the verification.
        why: SignedError,
    },
    /// A grant that does not open.
    #[error("grant not usable: {0}")]
    Grant(#[from] GrantError),
    /// A frame without a purpose here.
    #[error("unexpected {what}")]
    Unexpected {
        /// Kind of frame.
        what: &'static str,
    },
    /// A catalogue too large to be sent; the requester got as many entries as fit.
    #[error("the catalogue for one node is too large: {left_out} entries left out")]
    CatalogueTooLarge {
        /// Number of missing entries.
        left_out: usize,
    },
}

impl EndpointDrop {
    /// Returns `true` if an operator should hear of it. Answers cross with repeated requests, so unexpected frames are
    /// ordinary while nodes start.
    pub fn is_suspicious(&self) -> bool {
        !matches!(self, Self::Unexpected { .. })
    }

    /// Returns a short, stable name for counters.
    pub fn key(&self) -> &'static str {
        match self {
            Self::NotVerified { .. } => "endpoint_not_verified",
            Self::Grant(_) => "endpoint_grant",
            Self::Unexpected { .. } => "endpoint_unexpected",
            Self::CatalogueTooLarge { .. } => "endpoint_catalogue_too_large",
        }
    }
}

/// The state machine.
#[derive(Debug)]
pub struct Endpoint {
    pub(crate) config: EndpointConfig,
    pub(crate) anchors: Arc<TrustAnchors>,
    pub(crate) rng: ChaCha20Rng,
    /// One for each naming secret, the newest first.
    pub(crate) catalogue_names: Vec<(Name, Blind)>,
    /// Name under which members ask this authority.
    pub(crate) renewal_name: Option<(Name, Blind)>,
    pub(crate) renewals: BTreeMap<SinkId, GrantedSink>,
    /// Name under which operators ask this authority.
    pub(crate) operations_name: Option<(Name, Blind)>,
    pub(crate) operations: BTreeMap<SinkId, GrantedSink>,
    /// Name under which this owner is asked for its types.
    pub(crate) types_name: (Name, Blind),
    /// Set once it describes any type.
    pub(crate) describes: bool,
    pub(crate) questions: BTreeMap<SinkId, TypeAsker>,
    /// Described shares that were not yet reported to the requesters.
    pub(crate) untold: BTreeSet<Name>,
    /// Name under which owners ask for this node's consumers.
    pub(crate) consumers_name: (Name, Blind),
    /// The consumers, by the owner of the used interface; `None` until there is one.
    pub(crate) consumers: Option<BTreeMap<NodeId, Vec<Consumer>>>,
    pub(crate) consumer_askers: BTreeMap<SinkId, ConsumerAsker>,
    pub(crate) shares: Shares,
    pub(crate) joins: BTreeMap<Name, Join>,
    /// Catalogue names of followed owners.
    pub(crate) followed: BTreeMap<Name, NodeId>,
    pub(crate) followed_names: BTreeMap<NodeId, String>,
    pub(crate) catalogue_dirty: bool,
    /// End of the time in which changes of the catalogue are collected.
    pub(crate) catalogue_rests: Option<Instant>,
    pub(crate) unadvertised: BTreeSet<Blind>,
    pub(crate) withdrawn: BTreeSet<Blind>,
    advert_seq: u64,
    pub(crate) advert_pace: AdvertPace,
    /// Advertisements and withdrawals since all names were advertised together.
    adverts_apart: usize,
    pub(crate) renew_at: Option<Instant>,
    /// Time of the next look for expired certificates.
    pub(crate) enforce_at: Option<Instant>,
    pub(crate) outputs: VecDeque<Output>,
    clock: ClockWatch,
    pub(crate) now: Now,
}

impl Endpoint {
    /// Returns an endpoint that shares nothing yet. With a fleet secret it advertises its catalogue at once.
    pub fn new(config: EndpointConfig, rng: ChaCha20Rng, now: Now) -> Self {
        let identity = &config.identity;
        let own = identity.node_id();
        let at = |blind| (name_of(&own, &blind), blind);
        let renewal_name = config.authority.then(|| at(renewal_blind(&identity.as_peer().ca)));
        let operations_name = config.operations.then(|| at(operations_blind(&identity.as_peer().ca)));
        let catalogue_names = catalogue_names(identity);
        Self {
            unadvertised: catalogue_names
                .iter()
                .chain(&renewal_name)
                .chain(&operations_name)
                .map(|(_, b)| *b)
                .collect(),
            anchors: Arc::new(identity.anchors().clone()),
            config,
            rng,
            catalogue_names,
            renewal_name,
            renewals: BTreeMap::new(),
            operations_name,
            operations: BTreeMap::new(),
            types_name: types_name(&own),
            describes: false,
            questions: BTreeMap::new(),
            untold: BTreeSet::new(),
            consumers_name: consumers_name(&own),
            consumers: None,
            consumer_askers: BTreeMap::new(),
            shares: Shares::default(),
            joins: BTreeMap::new(),
            followed: BTreeMap::new(),
            followed_names: BTreeMap::new(),
            catalogue_dirty: false,
            catalogue_rests: None,
            withdrawn: BTreeSet::new(),
            advert_seq: 0,
            advert_pace: AdvertPace::default(),
            adverts_apart: 0,
            renew_at: None,
            enforce_at: None,
            outputs: VecDeque::new(),
            clock: ClockWatch::new(now),
            now,
        }
    }

    /// Returns a fresh random id for a source.
    pub fn new_source_id(&mut self) -> SourceId {
        let mut id = [0; 16];
        self.rng.fill_bytes(&mut id);
        SourceId(id)
    }

    /// Takes other CAs or revocations: nodes whose certificates are no longer valid lose their grants.
    pub fn set_anchors(&mut self, now: Now, anchors: Arc<TrustAnchors>) {
        self.now = now;
        self.anchors = anchors;
        self.enforce();
    }

    /// Takes another certificate of this node, or other secrets. Everything is advertised anew. Grants are requested
    /// again under the new certificate, and serve meanwhile.
    pub fn set_identity(&mut self, now: Now, identity: Arc<Identity>) {
        self.now = now;
        let names = catalogue_names(&identity);
        self.config.identity = identity;
        let gone: Vec<_> = self.catalogue_names.iter().filter(|n| !names.contains(n)).copied().collect();
        for (name, blind) in gone {
            self.end_catalogue(name, blind);
        }
        self.catalogue_names = names;
        self.advertise_all();
        self.refollow();
        self.refresh_joins();
    }

    /// Takes a frame from this node's router.
    pub fn handle_frame(&mut self, now: Now, frame: Control) {
        self.now = now;
        match frame {
            Control::Advert { signed, .. } => self.handle_advert(&signed),
            Control::Reroute { name, sink } => self.handle_reroute(name, sink),
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
            Control::Ack { name, sink, serial } => self.handle_ack(name, sink, serial),
            Control::Hello(_) => self.unexpected("hello"),
            Control::Interest { .. } | Control::Uninterest { .. } => self.unexpected("interest"),
            Control::Goodbye => self.unexpected("goodbye"),
            Control::Crl { .. } => self.unexpected("revocation list"),
            Control::LinkState { .. } => self.unexpected("link state"),
            Control::Query { .. } => self.unexpected("query"),
            Control::Label { .. } | Control::LabelAck { .. } => self.unexpected("label"),
            Control::Probe { .. } => self.unexpected("probe"),
            Control::Clock { .. } => self.unexpected("clock"),
            Control::IdentityInUse { .. } => self.unexpected("identity"),
            Control::LaneOffer { .. } | Control::LaneAnswer { .. } | Control::LaneWanted { .. } => {
                self.unexpected("lane");
            }
        }
    }

    /// Acts on timers that are due.
    pub fn handle_timeout(&mut self, now: Now) {
        self.now = now;
        if self.clock.was_set(now) {
            // Advertisements and requests with the old time may be refused.
            self.advertise_all();
            self.joins.values_mut().for_each(|join| join.retry_refused_by_time(now.instant));
        }
        if self.renew_at.is_some_and(|at| at <= now.instant) {
            self.advertise_all();
            self.renew_at = None;
        }
        if self.enforce_at.is_some_and(|at| at <= now.instant) {
            self.enforce_at = Some(now.instant + ENFORCE_EVERY);
            self.enforce();
        }
        self.rotate_due();
        self.ask_due();
    }

    /// Returns the next output; call until it is [`Output::Timeout`].
    pub fn poll_output(&mut self) -> Output {
        if self.outputs.is_empty() {
            self.advertise();
            self.tell_followers();
        }
        self.outputs.pop_front().unwrap_or_else(|| {
            let joins = self.joins.values().filter_map(Join::deadline);
            let own = [
                self.renew_at,
                self.enforce_at,
                self.rotation_deadline(),
                self.catalogue_deadline(),
                self.advert_deadline(),
            ];
            Output::Timeout(joins.chain(own.into_iter().flatten()).min())
        })
    }

    /// Returns the name of this node's catalogue; `None` for a router's identity, or after shutdown.
    pub fn catalogue_name(&self) -> Option<Name> {
        self.catalogue_names.first().map(|(name, _)| *name)
    }

    /// Returns the status of a join.
    pub fn join_status(&self, name: &Name) -> Option<JoinStatus> {
        self.joins.get(name).map(Join::status)
    }

    /// Returns the status of following an owner: the best of its catalogues.
    pub fn follow_status(&self, owner: &NodeId) -> Option<JoinStatus> {
        let names = self.followed.iter().filter(|(_, o)| *o == owner);
        let all: Vec<_> = names.filter_map(|(name, _)| self.join_status(name)).collect();
        all.iter().find(|s| **s == JoinStatus::Granted).or(all.first()).copied()
    }

    /// Returns the sinks of a share, with their nodes.
    pub fn granted(&self, name: &Name) -> Vec<(SinkId, NodeId)> {
        self.shares.granted(name).collect()
    }

    pub(crate) fn advertise_all(&mut self) {
        self.adverts_apart = 0;
        let types = self.describes.then_some(&self.types_name);
        let of_authority = self.renewal_name.iter().chain(&self.operations_name);
        let consumers = self.consumers.is_some().then_some(&self.consumers_name);
        let fixed = self.catalogue_names.iter().chain(of_authority).chain(types).chain(consumers);
        let fixed = fixed.map(|(_, blind)| *blind);
        self.unadvertised.extend(fixed.chain(self.shares.shares.values().map(|s| s.blind)));
    }

    /// Returns the time at which due advertisements may be sent, if that is later.
    fn advert_deadline(&self) -> Option<Instant> {
        let is_due = !self.withdrawn.is_empty() || !self.unadvertised.is_empty();
        self.advert_pace.opens_at().filter(|_| is_due)
    }

    /// Sends due advertisements and withdrawals, with as many names in one as fit, unless they are collected.
    fn advertise(&mut self) {
        if self.advert_deadline().is_some_and(|at| at > self.now.instant) {
            return;
        }
        let is_due = !self.withdrawn.is_empty() || !self.unadvertised.is_empty();
        if is_due && self.adverts_apart >= ADVERTS_APART_MAX {
            self.advertise_all();
        }
        for withdraw in [true, false] {
            let due = std::mem::take(if withdraw { &mut self.withdrawn } else { &mut self.unadvertised });
            let due: Vec<_> = due.into_iter().collect();
            for blinds in due.chunks(ADVERT_NAMES_MAX) {
                // The clock keeps sequence numbers growing over restarts.
                self.advert_seq = next_seq(self.advert_seq, self.now.unix);
                let body = AdvertBody {
                    chain: self.config.identity.chain_bytes(),
                    seq: self.advert_seq,
                    issued_at: self.now.unix,
                    lease_ms: self.config.limits.lease.as_millis().try_into().unwrap_or(u32::MAX),
                    withdraw,
                    blinds: blinds.to_vec(),
                };
                let signed = self.config.identity.sign_advert(&body);
                self.outputs.push_back(Output::Send(Control::Advert { cost: 0, signed }));
                self.advert_pace.sent(self.now.instant);
                self.adverts_apart += 1;
                if !withdraw {
                    self.renew_at.get_or_insert(self.now.instant + self.config.limits.lease / 3);
                    self.enforce_at.get_or_insert(self.now.instant + ENFORCE_EVERY);
                }
            }
        }
    }

    /// Skips to this number: an earlier run of this node used it, and routers ignore lower ones.
    pub(crate) fn overtake(&mut self, seq: u64) {
        if seq > self.advert_seq {
            self.advert_seq = seq;
            self.advertise_all();
        }
    }

    pub(crate) fn drop_frame(&mut self, why: EndpointDrop) {
        self.outputs.push_back(Output::Dropped(why));
    }

    pub(crate) fn unexpected(&mut self, what: &'static str) {
        self.drop_frame(EndpointDrop::Unexpected { what });
    }

    pub(crate) fn event(&mut self, event: Event) {
        self.outputs.push_back(Output::Event(event));
    }

    pub(crate) fn send(&mut self, frame: Control) {
        self.outputs.push_back(Output::Send(frame));
    }

    pub(crate) fn is_granted(&self, name: &Name) -> bool {
        matches!(self.joins.get(name), Some(Join { state: JoinState::Granted { .. }, .. }))
    }
}

/// Returns the names of `identity`'s catalogue: one for each of its secrets, the newest first.
fn catalogue_names(identity: &Identity) -> Vec<(Name, Blind)> {
    let metadata = Metadata::catalogue(identity.node_name().as_str());
    identity
        .naming_secrets()
        .iter()
        .map(|s| sgc_trust::TopicSecret::derive(&s.secret, &metadata).blind())
        .map(|blind| (name_of(&identity.node_id(), &blind), blind))
        .collect()
}
