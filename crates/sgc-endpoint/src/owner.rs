//! [`Owner`]: the part of the endpoint that owns names: shares, the catalogue, the questions of other nodes, and for an
//! authority the requests of members.

mod adverts;
mod askers;
mod catalogue;
mod granted;
mod member_requests;
mod news;
mod share;
mod shares;
mod types;

use std::collections::BTreeMap;
use std::sync::Arc;
use std::time::{Duration, Instant};

use bytes::Bytes;
use sgc_trust::{Kem, Policy, TopicSecret, VerifiedPeer, name_of, verify_join};
use sgc_wire::{
    CatalogueSource, Consumer, Credentials, Decode, GrantContent, JoinBody, Name, NodeId, OperationAnswer,
    PathOffer, Qos, Recover, RefuseReason, Report, Request, SignedBody, SinkId, SourceId, TopicGrant, Wish,
};

pub use self::adverts::{ADVERT_INTERVAL, ADVERTS_BURST};
pub use self::share::{ShareError, ShareSpec};

use self::adverts::Adverts;
use self::catalogue::CatalogueFeed;
use self::granted::GrantedSink;
use self::member_requests::{MemberRequest, MemberRequests};
use self::news::News;
use self::share::Share;
use self::shares::Shares;
use self::types::TypeAnswers;
use crate::context::Context;
use crate::names::BlindName;
use crate::output::{EndpointDrop, Event, SignedKind, UnexpectedFrame};
use crate::packed_type::PackedType;
use crate::receivers::Receivers;
use crate::sink::SinkProgress;
use crate::source::SourceProgress;

/// Interval of looking for expired certificates, which no other event reports.
const ENFORCE_EVERY: Duration = Duration::from_secs(20);

/// Nodes that have a place at the operations name of an authority: operators are few.
const OPERATIONS_ASKED_MAX: usize = 64;
/// Nodes that have a place at the name of this node's reports: observers are few, and leave once they are answered.
const REPORTS_ASKED_MAX: usize = 64;
/// Nodes that have a place at the name of this node's paths: they leave once they are answered.
const PATHS_ASKED_MAX: usize = 256;

/// The receiver of a request, by the name of the request.
#[derive(Clone, Copy, Debug)]
enum Desk {
    Catalogue,
    Renewals,
    Operations,
    Types,
    Consumers,
    Wishes,
    Reports,
    Paths,
    Clock,
    Share,
}

/// The services of an authority.
#[derive(Clone, Copy, Debug)]
pub(crate) struct AuthorityServices {
    /// Whether it gives members their certificates.
    pub(crate) renewals: bool,
    /// Whether it carries out operations for operators.
    pub(crate) operations: bool,
}

/// The owner of this node's names.
#[derive(Debug)]
pub(crate) struct Owner {
    adverts: Adverts,
    shares: Shares,
    catalogue: CatalogueFeed,
    renewals: MemberRequests,
    operations: MemberRequests,
    types: TypeAnswers,
    consumers: News<Consumer>,
    wishes: News<Wish>,
    reports: MemberRequests,
    paths: MemberRequests,
    /// The name at which this node tells the time, if it does.
    clock: Option<BlindName>,
    /// Time of the next look for expired certificates.
    enforce_at: Option<Instant>,
}

impl Owner {
    /// Returns an owner without shares. With a fleet secret it advertises its catalogue at once.
    pub(crate) fn new(cx: &Context, services: AuthorityServices) -> Self {
        let identity = cx.identity();
        let own = identity.node_id();
        let renewals = services.renewals.then(|| BlindName::renewal(&own, identity));
        let operations = services.operations.then(|| BlindName::operations(&own, identity));
        let mut owner = Self {
            adverts: Adverts::default(),
            shares: Shares::default(),
            catalogue: CatalogueFeed::new(own_catalogues(cx)),
            renewals: MemberRequests::new(renewals, cx.limits().sinks_per_name_max),
            operations: MemberRequests::new(operations, OPERATIONS_ASKED_MAX),
            types: TypeAnswers::new(&own),
            consumers: News::new(&own),
            wishes: News::new(&own),
            reports: MemberRequests::new(None, REPORTS_ASKED_MAX),
            paths: MemberRequests::new(None, PATHS_ASKED_MAX).with_partners(),
            clock: None,
            enforce_at: None,
        };
        owner.advertise_all();
        owner
    }

    /// Shares an interface under the name that its metadata gives with the newest secret.
    pub(crate) fn share(&mut self, cx: &mut Context, spec: ShareSpec) -> Result<Name, ShareError> {
        let secret = cx.identity().naming_secrets().first().ok_or(ShareError::NoSecret)?;
        let blind = TopicSecret::derive(&secret.secret, &spec.metadata).blind();
        let name = name_of(&cx.identity().node_id(), &blind);
        self.shares.begin(cx, name, blind, spec)?;
        self.adverts.add(blind);
        self.catalogue.changed();
        Ok(name)
    }

    /// Changes the offer of a share; its name and key stay.
    pub(crate) fn update_share(
        &mut self,
        cx: &mut Context,
        name: &Name,
        qos: Qos,
        sources: Vec<CatalogueSource>,
    ) {
        if self.shares.get_mut(name).is_some_and(|share| share.update(cx, qos, sources)) {
            self.catalogue.changed();
        }
    }

    /// Changes the policy of a share. Sinks without the right are cut at once, and the others get a new key.
    pub(crate) fn update_policy(&mut self, cx: &mut Context, name: &Name, policy: Policy) {
        if self.shares.get_mut(name).is_some_and(|share| share.set_policy(policy)) {
            self.catalogue.changed();
            self.enforce(cx);
        }
    }

    /// Sets this node's sources of a share.
    pub(crate) fn set_sources(&mut self, cx: &mut Context, name: &Name, sources: Vec<Arc<SourceProgress>>) {
        if let Some(share) = self.shares.get_mut(name) {
            share.set_sources(cx, sources);
        }
    }

    /// Sets the progress of this node's own sink of a share: later grants tell that received messages are past.
    pub(crate) fn set_own_sink(&mut self, name: &Name, progress: Arc<SinkProgress>) {
        if let Some(share) = self.shares.get_mut(name) {
            share.set_own_sink(progress);
        }
    }

    /// Ends a share: withdraws it everywhere, and tells its sinks.
    pub(crate) fn unshare(&mut self, cx: &mut Context, name: &Name) {
        let Some(share) = self.shares.remove(name) else { return };
        self.adverts.withdraw(share.blind());
        share.end(cx);
        self.types.unshared(name);
        self.catalogue.changed();
        if self.shares.iter().all(|share| share.described().is_none()) {
            self.types.withdraw(&mut self.adverts);
        }
    }

    /// Iterates over the nodes that receive a share.
    pub(crate) fn subscribers(&self, name: &Name) -> impl Iterator<Item = NodeId> {
        self.shares.get(name).into_iter().flat_map(Share::subscribers)
    }

    /// Ends the epochs of all shares at a time, unless they end before.
    pub(crate) fn end_epochs_by(&mut self, at: Instant) {
        self.shares.end_epochs_by(at);
    }

    /// Begins a new epoch of a share.
    pub(crate) fn rotate(&mut self, cx: &mut Context, name: &Name) {
        if let Some(share) = self.shares.get_mut(name) {
            share.begin_epoch(cx);
        }
    }

    /// Withdraws all names, for a clean shutdown.
    pub(crate) fn withdraw_all(&mut self, cx: &mut Context) {
        for name in self.shares.names().collect::<Vec<_>>() {
            self.unshare(cx, &name);
        }
        self.adverts.end();
        let catalogue = self.catalogue.set_names(cx, Vec::new());
        let ended = catalogue.into_iter().chain(self.renewals.end()).chain(self.operations.end());
        ended.for_each(|blind| self.adverts.withdraw(blind));
        self.types.withdraw(&mut self.adverts);
        self.consumers.withdraw(&mut self.adverts);
        self.wishes.withdraw(&mut self.adverts);
        self.withhold_reports();
        self.withhold_paths();
        self.clock.take().into_iter().for_each(|name| self.adverts.withdraw(name.blind));
        self.enforce_at = None;
        self.catalogue.end_rest();
    }

    /// Sets the description of a share's type. [`Self::tell_types`] tells the askers, so that descriptions that become
    /// known at about one time travel together.
    pub(crate) fn describe(&mut self, name: &Name, described: PackedType) {
        if let Some(share) = self.shares.get_mut(name) {
            share.describe(described);
            self.types.described(&mut self.adverts, *name);
        }
    }

    /// Tells the askers the types described since the last call.
    pub(crate) fn tell_types(&mut self, cx: &mut Context) {
        self.types.tell(cx, &self.shares);
    }

    /// Sets the consumers of this node, by the owner of the used interface.
    pub(crate) fn set_consumers(&mut self, cx: &mut Context, consumers: BTreeMap<NodeId, Vec<Consumer>>) {
        self.consumers.set(cx, &mut self.adverts, consumers);
    }

    /// Sets the most that this node wants of the topics of each owner.
    pub(crate) fn set_wishes(&mut self, cx: &mut Context, wishes: BTreeMap<NodeId, Vec<Wish>>) {
        self.wishes.set(cx, &mut self.adverts, wishes);
    }

    /// Answers a member that asks for a certificate, once or again after a change.
    pub(crate) fn answer_renewal(
        &mut self,
        cx: &mut Context,
        sink: SinkId,
        answer: Result<Credentials, RefuseReason>,
    ) {
        self.renewals.answer(cx, sink, answer.map(GrantContent::Credentials));
    }

    /// Answers a node that asks for an operation.
    pub(crate) fn answer_operation(
        &mut self,
        cx: &mut Context,
        sink: SinkId,
        answer: Result<OperationAnswer, RefuseReason>,
    ) {
        self.operations.answer(cx, sink, answer.map(GrantContent::Operation));
    }

    /// Answers a node that asks for a report.
    pub(crate) fn answer_report(
        &mut self,
        cx: &mut Context,
        sink: SinkId,
        answer: Result<Report, RefuseReason>,
    ) {
        self.reports.answer(cx, sink, answer.map(GrantContent::Report));
    }

    /// Takes questions for reports from here on.
    pub(crate) fn offer_reports(&mut self, cx: &Context) {
        let name = BlindName::reports(&cx.identity().node_id());
        self.reports.begin(name).into_iter().for_each(|blind| self.adverts.add(blind));
    }

    /// Takes no more questions for reports.
    pub(crate) fn withhold_reports(&mut self) {
        self.reports.end().into_iter().for_each(|blind| self.adverts.withdraw(blind));
    }

    /// Answers a node that asks for the addresses of this one.
    pub(crate) fn answer_path(
        &mut self,
        cx: &mut Context,
        sink: SinkId,
        answer: Result<PathOffer, RefuseReason>,
    ) {
        self.paths.answer(cx, sink, answer.map(GrantContent::Path));
    }

    /// Takes questions for addresses from here on.
    pub(crate) fn offer_paths(&mut self, cx: &Context) {
        let name = BlindName::paths(&cx.identity().node_id());
        self.paths.begin(name).into_iter().for_each(|blind| self.adverts.add(blind));
    }

    /// Takes no more questions for addresses.
    pub(crate) fn withhold_paths(&mut self) {
        self.paths.end().into_iter().for_each(|blind| self.adverts.withdraw(blind));
    }

    /// Tells the time by this node's clock to all who ask from here on.
    pub(crate) fn offer_clock(&mut self, cx: &Context) {
        let name = BlindName::clock(&cx.identity().node_id());
        if self.clock.replace(name).is_none() {
            self.adverts.add(name.blind);
        }
    }

    /// Iterates over the members that ask this authority: sink, node, and signing request.
    pub(crate) fn renewing(&self) -> impl Iterator<Item = (SinkId, &VerifiedPeer, &Bytes)> {
        self.renewals.iter()
    }

    /// Returns the name of the catalogue under the newest secret.
    pub(crate) fn catalogue_name(&self) -> Option<Name> {
        self.catalogue.name()
    }

    /// Returns the sinks of a share, with their nodes.
    pub(crate) fn granted(&self, name: &Name) -> Vec<(SinkId, NodeId)> {
        self.shares.get(name).into_iter().flat_map(Share::granted).collect()
    }

    /// Returns the publishers of a share: by source, the sink that packets for it are addressed to.
    pub(crate) fn publishers(&self, name: &Name) -> BTreeMap<SourceId, SinkId> {
        self.shares.get(name).map(Share::publishers).unwrap_or_default()
    }

    /// Returns the key of a share, for its sources.
    pub(crate) fn share_grant(&self, name: &Name) -> Option<TopicGrant> {
        self.shares.get(name).map(Share::own_grant)
    }

    /// Returns the receivers of a share, for its sources.
    pub(crate) fn receivers(&self, name: &Name) -> Option<Arc<Receivers>> {
        self.shares.get(name).map(Share::receivers)
    }

    /// Returns `true` if the type of a share has a key, so that each of its instances has a history.
    pub(crate) fn is_keyed(&self, name: &Name) -> bool {
        self.shares.get(name).is_some_and(Share::is_keyed)
    }

    /// Takes over another certificate of this node, or other secrets: everything is advertised anew.
    pub(crate) fn identity_changed(&mut self, cx: &mut Context) {
        let gone = self.catalogue.set_names(cx, own_catalogues(cx));
        gone.into_iter().for_each(|blind| self.adverts.withdraw(blind));
        self.advertise_all();
    }

    /// Advertises all names together.
    pub(crate) fn advertise_all(&mut self) {
        let types = self.types.is_advertised().then(|| self.types.name().blind);
        let consumers = self.consumers.is_advertised().then(|| self.consumers.name().blind);
        let wishes = self.wishes.is_advertised().then(|| self.wishes.name().blind);
        let asked = [&self.renewals, &self.operations, &self.reports, &self.paths];
        let asked = asked.into_iter().filter_map(MemberRequests::blind);
        let clock = self.clock.map(|name| name.blind);
        let fixed =
            self.catalogue.blinds().chain(asked).chain(types).chain(consumers).chain(wishes).chain(clock);
        self.adverts.add_all(fixed.chain(self.shares.iter().map(Share::blind)));
    }

    /// Skips to this number of advertisements: an earlier run of this node used it.
    pub(crate) fn overtake(&mut self, seq: u64) {
        if self.adverts.overtake(seq) {
            self.advertise_all();
        }
    }

    /// Acts on timers that are due.
    pub(crate) fn handle_timeout(&mut self, cx: &mut Context) {
        let now = cx.instant();
        if self.adverts.take_renewal(now) {
            self.advertise_all();
        }
        if self.enforce_at.is_some_and(|at| at <= now) {
            self.enforce_at = Some(now + ENFORCE_EVERY);
            self.enforce(cx);
        }
        self.shares.rotate_due(cx);
    }

    /// Sends what was collected: advertisements, withdrawals, and changes of the catalogue.
    pub(crate) fn flush(&mut self, cx: &mut Context) {
        if self.adverts.may_send(cx.instant()) {
            if self.adverts.is_scattered() {
                self.advertise_all();
            }
            if self.adverts.send(cx) {
                self.enforce_at.get_or_insert(cx.instant() + ENFORCE_EVERY);
            }
        }
        self.catalogue.tell_followers(cx, &self.shares);
    }

    /// Returns the time of the next [`Self::handle_timeout`] or [`Self::flush`].
    pub(crate) fn deadline(&self) -> Option<Instant> {
        let all = [
            self.adverts.renew_at(),
            self.enforce_at,
            self.shares.rotation_deadline(),
            self.catalogue.deadline(),
            self.adverts.deadline(),
        ];
        all.into_iter().flatten().min()
    }

    /// Cuts every node that has lost the right to its grant, and begins new epochs for the others.
    pub(crate) fn enforce(&mut self, cx: &mut Context) {
        self.shares.enforce(cx);
        self.catalogue.enforce(cx);
        self.renewals.enforce(cx);
        self.operations.enforce(cx);
        self.types.enforce(cx);
        self.consumers.enforce(cx);
        self.wishes.enforce(cx);
        self.reports.enforce(cx);
        self.paths.enforce(cx);
    }

    pub(crate) fn handle_join(&mut self, cx: &mut Context, signed: &SignedBody) {
        let join = match verify_join(cx.anchors(), signed, cx.now().unix) {
            Ok(join) => join,
            Err(why) => {
                // A malformed body may still contain name and sink for an answer. Only names of this node are answered,
                // or anybody could have anything signed.
                if let Ok(JoinBody { name, sink, .. }) = JoinBody::from_slice(&signed.body)
                    && self.desk(&name).is_some()
                {
                    cx.refuse(name, sink, 1, why.refuse_reason());
                }
                return cx.drop_frame(EndpointDrop::NotVerified { what: SignedKind::Join, why });
            }
        };
        let JoinBody { name, sink, request, reply_key, issued_at, .. } = join.body;
        // In a post-quantum fleet nothing is granted that a recording could reveal later.
        let needs_post_quantum = cx.identity().post_quantum() && cx.is_own_fleet(&join.peer);
        if needs_post_quantum && reply_key.len() != Kem::XWing.reply_key_bytes() {
            return cx.refuse(name, sink, 1, RefuseReason::NotVerified);
        }
        // The holder of an invitation is no member yet, and asks the authority for an operation only.
        if join.peer.invitation.is_some() && !self.operations.is_at(&name) {
            if self.desk(&name).is_some() {
                cx.refuse(name, sink, 1, RefuseReason::NotPermitted);
            }
            return cx.drop_frame(EndpointDrop::Invited { peer: join.peer.node_id });
        }
        let asked = GrantedSink { peer: join.peer, request, reply_key, issued_at, serial: 0 };
        match self.desk(&name) {
            Some(Desk::Catalogue) => self.catalogue.handle_follow(cx, &self.shares, (name, sink), asked),
            Some(Desk::Renewals) => {
                let request = self.renewals.handle_request(cx, name, sink, asked);
                if let Some(MemberRequest { peer, what: csr }) = request {
                    cx.event(Event::RenewAsked { sink, peer, csr });
                }
            }
            Some(Desk::Operations) => {
                let request = self.operations.handle_request(cx, name, sink, asked);
                if let Some(MemberRequest { peer, what: request }) = request {
                    cx.event(Event::OperationAsked { sink, peer, request });
                }
            }
            Some(Desk::Reports) => {
                let request = self.reports.handle_request(cx, name, sink, asked);
                if let Some(MemberRequest { peer, what: question }) = request {
                    cx.event(Event::ReportAsked { sink, peer, question });
                }
            }
            Some(Desk::Paths) => {
                let request = self.paths.handle_request(cx, name, sink, asked);
                if let Some(MemberRequest { peer, what: question }) = request {
                    cx.event(Event::PathAsked { sink, peer, question });
                }
            }
            Some(Desk::Clock) => tell_time(cx, name, sink, asked),
            Some(Desk::Types) => self.types.handle_question(cx, &self.shares, sink, asked),
            Some(Desk::Consumers) => self.consumers.handle_question(cx, sink, asked),
            Some(Desk::Wishes) => self.wishes.handle_question(cx, sink, asked),
            Some(Desk::Share) => {
                if let Some(share) = self.shares.get_mut(&name) {
                    share.handle_request(cx, sink, asked);
                }
            }
            None => {
                let (peer, reason) = (asked.peer.node_id, RefuseReason::NotShared);
                cx.refuse(name, sink, 1, reason);
                cx.event(Event::SinkRefused { name, peer, reason });
            }
        }
    }

    pub(crate) fn handle_leave(&mut self, cx: &mut Context, name: Name, sink: SinkId) {
        match self.desk(&name) {
            Some(Desk::Catalogue) => self.catalogue.handle_leave(name, sink),
            Some(Desk::Renewals) => self.renewals.handle_leave(sink),
            Some(Desk::Operations) => self.operations.handle_leave(sink),
            Some(Desk::Reports) => self.reports.handle_leave(sink),
            Some(Desk::Paths) => self.paths.handle_leave(sink),
            // Each question was answered at once.
            Some(Desk::Clock) => {}
            Some(Desk::Types) => self.types.handle_leave(sink),
            Some(Desk::Consumers) => self.consumers.handle_leave(sink),
            Some(Desk::Wishes) => self.wishes.handle_leave(sink),
            Some(Desk::Share) => {
                if let Some(share) = self.shares.get_mut(&name) {
                    share.handle_leave(cx, sink);
                }
            }
            None => {}
        }
    }

    pub(crate) fn handle_ack(&mut self, cx: &mut Context, name: Name, sink: SinkId, serial: u64) {
        match self.shares.get_mut(&name) {
            Some(share) => share.handle_ack(cx, sink, serial),
            None => cx.unexpected(UnexpectedFrame::Ack),
        }
    }

    pub(crate) fn handle_recover(&mut self, cx: &mut Context, recover: Recover) {
        match self.shares.get(&recover.name) {
            Some(share) => share.handle_recover(cx, recover),
            None => cx.unexpected(UnexpectedFrame::Recover),
        }
    }

    /// Returns the receiver of requests for a name; `None` for a name that is not this node's.
    fn desk(&self, name: &Name) -> Option<Desk> {
        if self.catalogue.is_at(name) {
            Some(Desk::Catalogue)
        } else if self.renewals.is_at(name) {
            Some(Desk::Renewals)
        } else if self.operations.is_at(name) {
            Some(Desk::Operations)
        } else if self.reports.is_at(name) {
            Some(Desk::Reports)
        } else if self.paths.is_at(name) {
            Some(Desk::Paths)
        } else if self.clock.is_some_and(|own| own.name == *name) {
            Some(Desk::Clock)
        } else if self.types.name().name == *name {
            Some(Desk::Types)
        } else if self.consumers.name().name == *name {
            Some(Desk::Consumers)
        } else if self.wishes.name().name == *name {
            Some(Desk::Wishes)
        } else {
            self.shares.contains(name).then_some(Desk::Share)
        }
    }
}

/// Answers a question for the time. No asker has a place, since nothing follows.
fn tell_time(cx: &mut Context, name: Name, sink: SinkId, mut asked: GrantedSink) {
    let Request::Ask { .. } = asked.request else {
        return cx.refuse(name, sink, 1, RefuseReason::RoleNotOffered);
    };
    let time = GrantContent::Clock(cx.now().unix);
    asked.grant(cx, name, sink, &time);
}

/// Returns the names of this node's catalogue.
fn own_catalogues(cx: &Context) -> Vec<BlindName> {
    let identity = cx.identity();
    BlindName::catalogues(identity, &identity.node_id(), identity.node_name().as_str())
}
