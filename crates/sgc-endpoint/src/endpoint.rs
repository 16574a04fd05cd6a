//! The endpoint's state machine: the user's requests, the router's frames, and the time, in; frames and events out.
//!
//! [`Endpoint`] only routes: `owner.rs` has its part as the owner of names, `joiner.rs` its part as the joiner of
//! others' names. Both put their effects into one `Context`.

use std::collections::BTreeMap;
use std::sync::Arc;
use std::time::Duration;

use bytes::Bytes;
use rand_chacha::ChaCha20Rng;
use rand_core::RngCore;
use sgc_trust::{Identity, Policy, TrustAnchors, VerifiedPeer, verify_advert};
use sgc_wire::{
    CatalogueSource, ClockWatch, Consumer, Control, Credentials, Name, NodeId, Now, OperationAnswer,
    OperationRequest, PathOffer, PathQuestion, Qos, RefuseReason, Report, ReportQuestion, SignedBody, SinkId,
    SourceId, TopicGrant, Wish,
};

use crate::config::EndpointConfig;
use crate::context::Context;
use crate::joiner::Joiner;
use crate::joins::{JoinKind, JoinStatus, LostReason};
use crate::output::{EndpointDrop, Output, SignedKind, UnexpectedFrame};
use crate::owner::{AuthorityServices, Owner, ShareError, ShareSpec};
use crate::packed_type::PackedType;
use crate::receivers::Receivers;
use crate::sink::SinkProgress;
use crate::source::SourceProgress;

/// The state machine.
#[derive(Debug)]
pub struct Endpoint {
    cx: Context,
    owner: Owner,
    joiner: Joiner,
    clock: ClockWatch,
}

/// The machine's inputs and outputs.
impl Endpoint {
    /// Returns an endpoint that shares nothing yet. With a fleet secret it advertises its catalogue at once.
    pub fn new(config: EndpointConfig, rng: ChaCha20Rng, now: Now) -> Self {
        let EndpointConfig { identity, authority, operations, limits } = config;
        let cx = Context::new(identity, limits, rng, now);
        let owner = Owner::new(&cx, AuthorityServices { renewals: authority, operations });
        Self { cx, owner, joiner: Joiner::default(), clock: ClockWatch::new(now) }
    }

    /// Returns a fresh random id for a source.
    pub fn new_source_id(&mut self) -> SourceId {
        let mut id = [0; 16];
        self.cx.rng().fill_bytes(&mut id);
        SourceId(id)
    }

    /// Takes other CAs or revocations: nodes whose certificates are no longer valid lose their grants.
    pub fn set_anchors(&mut self, now: Now, anchors: Arc<TrustAnchors>) {
        self.cx.set_now(now);
        self.cx.set_anchors(anchors);
        self.owner.enforce(&mut self.cx);
    }

    /// Takes another certificate of this node, or other secrets. Everything is advertised anew. Grants are requested
    /// again under the new certificate, and serve meanwhile.
    pub fn set_identity(&mut self, now: Now, identity: Arc<Identity>) {
        self.cx.set_now(now);
        self.cx.set_identity(identity);
        self.owner.identity_changed(&mut self.cx);
        self.joiner.identity_changed(&mut self.cx);
    }

    /// Takes a frame from this node's router.
    pub fn handle_frame(&mut self, now: Now, frame: Control) {
        let Self { cx, owner, joiner, .. } = self;
        cx.set_now(now);
        match frame {
            Control::Advert { signed, .. } => self.handle_advert(&signed),
            Control::Reroute { name, sink } => joiner.handle_reroute(cx, name, sink),
            Control::Unreach { names } => {
                for name in names {
                    joiner.lose(cx, name, LostReason::Unreachable);
                }
            }
            Control::Join { signed } => owner.handle_join(cx, &signed),
            Control::Leave { name, sink } => owner.handle_leave(cx, name, sink),
            Control::Answer { signed } => joiner.handle_answer(cx, &signed),
            Control::Reject { name, sink, reason } => joiner.handle_reject(cx, name, sink, reason),
            Control::Recover(recover) => owner.handle_recover(cx, recover),
            Control::Ack { name, sink, serial } => owner.handle_ack(cx, name, sink, serial),
            Control::Hello(_) => cx.unexpected(UnexpectedFrame::Hello),
            Control::Interest { .. } | Control::Uninterest { .. } => cx.unexpected(UnexpectedFrame::Interest),
            Control::Goodbye => cx.unexpected(UnexpectedFrame::Goodbye),
            Control::Crl { .. } => cx.unexpected(UnexpectedFrame::Crl),
            Control::LinkState { .. } => cx.unexpected(UnexpectedFrame::LinkState),
            Control::Query { .. } => cx.unexpected(UnexpectedFrame::Query),
            Control::Label { .. } | Control::LabelAck { .. } => cx.unexpected(UnexpectedFrame::Label),
            Control::Probe { .. } => cx.unexpected(UnexpectedFrame::Probe),
            Control::Clock { .. } => cx.unexpected(UnexpectedFrame::Clock),
            Control::IdentityInUse { .. } => cx.unexpected(UnexpectedFrame::IdentityInUse),
            Control::ObservedAddress { .. } => cx.unexpected(UnexpectedFrame::ObservedAddress),
            Control::LaneOffer { .. }
            | Control::LaneAnswer { .. }
            | Control::LaneWanted { .. }
            | Control::BulkLaneWanted { .. } => {
                cx.unexpected(UnexpectedFrame::Lane);
            }
        }
    }

    fn handle_advert(&mut self, signed: &SignedBody) {
        match verify_advert(self.cx.anchors(), signed, self.cx.now().unix) {
            Ok(advert) if advert.owner.node_id == self.cx.identity().node_id() => {
                self.owner.overtake(advert.body.seq);
            }
            Ok(advert) => self.joiner.handle_advert(&mut self.cx, advert),
            Err(why) => self.cx.drop_frame(EndpointDrop::NotVerified { what: SignedKind::Advert, why }),
        }
    }

    /// Acts on timers that are due.
    pub fn handle_timeout(&mut self, now: Now) {
        self.cx.set_now(now);
        if self.clock.was_set(now) {
            // Advertisements and requests with the old time may be refused.
            self.owner.advertise_all();
            self.joiner.clock_changed(&self.cx);
        }
        self.owner.handle_timeout(&mut self.cx);
        self.joiner.handle_timeout(&mut self.cx);
    }

    /// Returns the next output; call until it is [`Output::Timeout`].
    pub fn poll_output(&mut self) -> Output {
        if !self.cx.has_output() {
            self.owner.flush(&mut self.cx);
        }
        self.cx.take_output().unwrap_or_else(|| {
            let all = [self.owner.deadline(), self.joiner.deadline()];
            Output::Timeout(all.into_iter().flatten().min())
        })
    }
}

/// The user's part as an owner.
impl Endpoint {
    /// Shares an interface under the name that its metadata gives with the newest secret.
    pub fn share(&mut self, now: Now, spec: ShareSpec) -> Result<Name, ShareError> {
        self.cx.set_now(now);
        self.owner.share(&mut self.cx, spec)
    }

    /// Changes the offer of a share; its name and key stay.
    pub fn update_share(&mut self, now: Now, name: &Name, qos: Qos, sources: Vec<CatalogueSource>) {
        self.cx.set_now(now);
        self.owner.update_share(&mut self.cx, name, qos, sources);
    }

    /// Changes the policy of a share. Sinks without the right are cut at once, and the others get a new key.
    pub fn update_policy(&mut self, now: Now, name: &Name, policy: Policy) {
        self.cx.set_now(now);
        self.owner.update_policy(&mut self.cx, name, policy);
    }

    /// Sets this node's sources of a share.
    pub fn set_sources(&mut self, now: Now, name: &Name, sources: Vec<Arc<SourceProgress>>) {
        self.cx.set_now(now);
        self.owner.set_sources(&mut self.cx, name, sources);
    }

    /// Sets the progress of this node's own sink of a share: later grants tell that received messages are past.
    pub fn set_own_sink(&mut self, name: &Name, progress: Arc<SinkProgress>) {
        self.owner.set_own_sink(name, progress);
    }

    /// Ends a share: withdraws it everywhere, and tells its sinks.
    pub fn unshare(&mut self, now: Now, name: &Name) {
        self.cx.set_now(now);
        self.owner.unshare(&mut self.cx, name);
    }

    /// Sets the longest time of an epoch, for those that have begun, too.
    pub fn set_rotate_every(&mut self, now: Now, every: Duration) {
        self.cx.set_now(now);
        self.cx.limits_mut().rotate_every = every;
        self.owner.end_epochs_by(now.instant + every);
    }

    /// Begins a new epoch of a share.
    pub fn rotate(&mut self, now: Now, name: &Name) {
        self.cx.set_now(now);
        self.owner.rotate(&mut self.cx, name);
    }

    /// Withdraws all names, for a clean shutdown.
    pub fn withdraw_all(&mut self, now: Now) {
        self.cx.set_now(now);
        self.owner.withdraw_all(&mut self.cx);
    }

    /// Sets the description of a share's type. [`Self::tell_types`] tells the askers, so that descriptions that become
    /// known at about one time travel together.
    pub fn describe(&mut self, now: Now, name: &Name, described: PackedType) {
        self.cx.set_now(now);
        self.owner.describe(name, described);
    }

    /// Tells the askers the types described since the last call.
    pub fn tell_types(&mut self, now: Now) {
        self.cx.set_now(now);
        self.owner.tell_types(&mut self.cx);
    }

    /// Sets the consumers of this node, by the owner of the used interface; each owner gets its own when it asks and
    /// when they change. Those beyond [`sgc_wire::CONSUMERS_MAX`] of an owner are left out. The name of the question is
    /// advertised from the first consumer on.
    pub fn set_consumers(&mut self, now: Now, consumers: BTreeMap<NodeId, Vec<Consumer>>) {
        self.cx.set_now(now);
        self.owner.set_consumers(&mut self.cx, consumers);
    }

    /// Sets the most that this node wants of the topics of each owner. The owners that ask are told.
    pub fn set_wishes(&mut self, now: Now, wishes: BTreeMap<NodeId, Vec<Wish>>) {
        self.cx.set_now(now);
        self.owner.set_wishes(&mut self.cx, wishes);
    }

    /// Answers [`crate::Event::RenewAsked`], once or again after a change.
    pub fn answer_renewal(&mut self, now: Now, sink: SinkId, answer: Result<Credentials, RefuseReason>) {
        self.cx.set_now(now);
        self.owner.answer_renewal(&mut self.cx, sink, answer);
    }

    /// Answers [`crate::Event::OperationAsked`].
    pub fn answer_operation(
        &mut self,
        now: Now,
        sink: SinkId,
        answer: Result<OperationAnswer, RefuseReason>,
    ) {
        self.cx.set_now(now);
        self.owner.answer_operation(&mut self.cx, sink, answer);
    }

    /// Answers [`crate::Event::ReportAsked`].
    pub fn answer_report(&mut self, now: Now, sink: SinkId, answer: Result<Report, RefuseReason>) {
        self.cx.set_now(now);
        self.owner.answer_report(&mut self.cx, sink, answer);
    }

    /// Takes questions for reports, or no more of them. Before the first call, none are taken.
    pub fn offer_reports(&mut self, now: Now, is_offered: bool) {
        self.cx.set_now(now);
        match is_offered {
            true => self.owner.offer_reports(&self.cx),
            false => self.owner.withhold_reports(),
        }
    }

    /// Answers [`crate::Event::PathAsked`].
    pub fn answer_path(&mut self, now: Now, sink: SinkId, answer: Result<PathOffer, RefuseReason>) {
        self.cx.set_now(now);
        self.owner.answer_path(&mut self.cx, sink, answer);
    }

    /// Takes questions for the addresses of this node, or no more of them. Before the first call, none are taken.
    pub fn offer_paths(&mut self, now: Now, is_offered: bool) {
        self.cx.set_now(now);
        match is_offered {
            true => self.owner.offer_paths(&self.cx),
            false => self.owner.withhold_paths(),
        }
    }

    /// Tells the time by this node's clock to all who ask from here on.
    pub fn offer_clock(&mut self, now: Now) {
        self.cx.set_now(now);
        self.owner.offer_clock(&self.cx);
    }

    /// Iterates over the members that ask this authority: sink, node, and signing request.
    pub fn renewing(&self) -> impl Iterator<Item = (SinkId, &VerifiedPeer, &Bytes)> {
        self.owner.renewing()
    }

    /// Returns the name of this node's catalogue; `None` for a router's identity, or after shutdown.
    pub fn catalogue_name(&self) -> Option<Name> {
        self.owner.catalogue_name()
    }

    /// Returns the sinks of a share, with their nodes.
    pub fn granted(&self, name: &Name) -> Vec<(SinkId, NodeId)> {
        self.owner.granted(name)
    }

    /// Returns the publishers of a share: by source, the sink that packets for it are addressed to.
    pub fn publishers(&self, name: &Name) -> BTreeMap<SourceId, SinkId> {
        self.owner.publishers(name)
    }

    /// Returns the key of a share, for its sources.
    pub fn share_grant(&self, name: &Name) -> Option<TopicGrant> {
        self.owner.share_grant(name)
    }

    /// Returns the receivers of a share, for its sources. The set changes with the grants.
    pub fn receivers(&self, name: &Name) -> Option<Arc<Receivers>> {
        self.owner.receivers(name)
    }

    /// Returns `true` if the type of a share has a key, so that each of its instances has a history.
    pub fn is_keyed(&self, name: &Name) -> bool {
        self.owner.is_keyed(name)
    }
}

/// The user's part as a joiner.
impl Endpoint {
    /// Follows a fleet member's catalogue. Returns `false` if this identity has no fleet secret to find it with.
    pub fn follow(&mut self, now: Now, owner_name: &str) -> bool {
        self.cx.set_now(now);
        self.joiner.follow(&mut self.cx, owner_name)
    }

    /// Stops following a catalogue.
    pub fn unfollow(&mut self, now: Now, owner: &NodeId) {
        self.cx.set_now(now);
        self.joiner.unfollow(&mut self.cx, owner);
    }

    /// Asks the fleet's authority for credentials, in place of an earlier request. Returns `false` if the identity
    /// names no authority.
    pub fn renew(&mut self, now: Now, csr: Bytes) -> bool {
        self.cx.set_now(now);
        self.joiner.renew(&mut self.cx, csr)
    }

    /// Asks `authority` for an operation on this fleet, in place of an earlier request. Returns the name of the
    /// request, which the caller leaves after [`crate::Event::OperationAnswered`] or [`crate::Event::OperationDenied`].
    pub fn operate(&mut self, now: Now, authority: NodeId, request: &OperationRequest) -> Name {
        self.cx.set_now(now);
        self.joiner.operate(&mut self.cx, authority, request)
    }

    /// Asks an owner for the types of these interfaces, the first [`sgc_wire::TYPES_PER_QUESTION_MAX`] of them, until
    /// the next question, or for none. Each question is answered in full, also with types told before. An owner that
    /// describes none, or of a version that cannot, does not advertise the name of the question: then nothing happens.
    pub fn ask_types(&mut self, now: Now, owner: NodeId, names: Vec<Name>) {
        self.cx.set_now(now);
        self.joiner.ask_types(&mut self.cx, owner, names);
    }

    /// Asks a node for its consumers of this node's interfaces, until [`Self::leave_consumers`]. A node that reports
    /// none, or of a version that cannot, does not advertise the name of the question: then nothing happens.
    pub fn ask_consumers(&mut self, now: Now, peer: NodeId) {
        self.cx.set_now(now);
        self.joiner.ask_consumers(&mut self.cx, peer);
    }

    /// Stops asking a node.
    pub fn leave_consumers(&mut self, now: Now, peer: &NodeId) {
        self.cx.set_now(now);
        self.joiner.leave_consumers(&mut self.cx, peer);
    }

    /// Asks a node for its wishes about this node's topics, until [`Self::leave_wishes`]. A node without wishes, or of a
    /// version that has none, does not advertise the name of the question: then nothing happens.
    pub fn ask_wishes(&mut self, now: Now, peer: NodeId) {
        self.cx.set_now(now);
        self.joiner.ask_wishes(&mut self.cx, peer);
    }

    /// Stops asking a node for its wishes.
    pub fn leave_wishes(&mut self, now: Now, peer: &NodeId) {
        self.cx.set_now(now);
        self.joiner.leave_wishes(&mut self.cx, peer);
    }

    /// Asks a node of this fleet for a report, in place of an earlier question to it. Returns the name of the question,
    /// which the caller leaves after [`crate::Event::Report`] or [`crate::Event::ReportRefused`]. A node that gives no
    /// reports, or of a version that cannot, does not advertise the name: then nothing happens.
    pub fn ask_report(&mut self, now: Now, peer: NodeId, question: &ReportQuestion) -> Name {
        self.cx.set_now(now);
        self.joiner.ask_report(&mut self.cx, peer, question)
    }

    /// Asks a node of this fleet for its addresses, in place of an earlier question to it, until
    /// [`Self::leave_path`]. A node that has no direct links, or of a version that cannot, does not advertise the name of
    /// the question: then nothing happens.
    pub fn ask_path(&mut self, now: Now, peer: NodeId, question: &PathQuestion) {
        self.cx.set_now(now);
        self.joiner.ask_path(&mut self.cx, peer, question);
    }

    /// Ends a question for a node's addresses.
    pub fn leave_path(&mut self, now: Now, peer: &NodeId) {
        self.cx.set_now(now);
        self.joiner.leave_path(&mut self.cx, peer);
    }

    /// Asks a node for the time by its clock, in place of an earlier question to it, until [`Self::leave_clock`]. A node
    /// of a version that cannot tell it does not advertise the name of the question: then nothing happens.
    pub fn ask_clock(&mut self, now: Now, peer: NodeId) {
        self.cx.set_now(now);
        self.joiner.ask_clock(&mut self.cx, peer);
    }

    /// Asks a node for its time no more.
    pub fn leave_clock(&mut self, now: Now, peer: &NodeId) {
        self.cx.set_now(now);
        self.joiner.leave_clock(&mut self.cx, peer);
    }

    /// Iterates over the owners of the topics and services that this node joined and was granted, once for each of them.
    pub fn data_owners(&self) -> impl Iterator<Item = &VerifiedPeer> {
        self.joiner.data_owners()
    }

    /// Joins a name of `owner`: waits for it if necessary, and joins again whenever it has to.
    pub fn join(&mut self, now: Now, name: Name, owner: NodeId, kind: JoinKind) {
        self.cx.set_now(now);
        self.joiner.join(&mut self.cx, name, owner, kind);
    }

    /// Leaves a name.
    pub fn leave(&mut self, now: Now, name: &Name) {
        self.cx.set_now(now);
        self.joiner.leave(&mut self.cx, name);
    }

    /// Returns the sink under which a name is granted to this node.
    pub fn sink_of(&self, name: &Name) -> Option<SinkId> {
        self.joiner.sink_of(name)
    }

    /// Asks a source of a granted name for its messages `from..=to`.
    pub fn recover(&mut self, name: Name, source: SourceId, from: u64, to: u64) {
        self.joiner.recover(&mut self.cx, name, source, from, to);
    }

    /// Confirms to the owner of a granted name that everything of a source up to `seq` is here
    /// ([`crate::Delivery::Confirm`]).
    pub fn confirm(&mut self, name: Name, source: SourceId, seq: u64) {
        self.joiner.confirm(&mut self.cx, name, source, seq);
    }

    /// Iterates over the nodes that receive a share of this node; a node comes once for each of its sinks.
    pub fn subscribers(&self, name: &Name) -> impl Iterator<Item = NodeId> {
        self.owner.subscribers(name)
    }

    /// Returns the owner of a name that this node has joined.
    pub fn owner_of(&self, name: &Name) -> Option<NodeId> {
        self.joiner.owner_of(name)
    }

    /// Returns the status of a join.
    pub fn join_status(&self, name: &Name) -> Option<JoinStatus> {
        self.joiner.status(name)
    }

    /// Returns the status of following an owner: the best of its catalogues.
    pub fn follow_status(&self, owner: &NodeId) -> Option<JoinStatus> {
        self.joiner.follow_status(owner)
    }
}
