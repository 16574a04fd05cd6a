//! [`Joiner`]: the part of the endpoint that joins others' names: topics to receive or to publish on, catalogues, and
//! the authority.

use std::collections::BTreeMap;
use std::time::Instant;

use bytes::Bytes;
use sgc_trust::{VerifiedAdvert, VerifiedPeer, verify_answer};
use sgc_wire::{
    AnswerBody, Control, Decode, DescribedType, Encode as _, GrantContent, JoinBody, Name, NodeId,
    OperationRequest, PathQuestion, Recover, RefuseReason, RejectReason, ReportQuestion, SignedBody, SinkId,
    SourceId, TYPES_PER_QUESTION_MAX,
};

use crate::context::Context;
use crate::joins::{
    AnswerEffect, Join, JoinKind, JoinRequest, JoinStatus, LostReason, RefusedBy, RejectEffect, TimeoutEffect,
};
use crate::names::BlindName;
use crate::output::{EndpointDrop, Event, SignedKind, UnexpectedFrame};

/// The joiner of others' names.
#[derive(Debug, Default)]
pub(crate) struct Joiner {
    joins: BTreeMap<Name, Join>,
    /// Catalogue names of followed owners.
    followed: BTreeMap<Name, NodeId>,
    followed_names: BTreeMap<NodeId, String>,
}

impl Joiner {
    /// Follows a fleet member's catalogue. Returns `false` if this identity has no fleet secret to find it with.
    pub(crate) fn follow(&mut self, cx: &mut Context, owner_name: &str) -> bool {
        let Some(owner) = cx.identity().node_id_of(owner_name) else { return false };
        self.followed_names.insert(owner, owner_name.to_owned());
        self.refollow(cx);
        true
    }

    /// Stops following a catalogue.
    pub(crate) fn unfollow(&mut self, cx: &mut Context, owner: &NodeId) {
        self.followed_names.remove(owner);
        self.refollow(cx);
    }

    /// Takes over another certificate of this node, or other secrets. Grants are requested again under the new
    /// certificate, and serve meanwhile.
    pub(crate) fn identity_changed(&mut self, cx: &mut Context) {
        self.refollow(cx);
        for (name, join) in &self.joins {
            if let Some(request) = join.refresh() {
                send_request(cx, *name, request);
            }
        }
    }

    /// Asks again now if the clocks were the reason of a refusal.
    pub(crate) fn clock_changed(&mut self, cx: &Context) {
        self.joins.values_mut().for_each(|join| join.retry_refused_by_time(cx.instant()));
    }

    /// Asks the fleet's authority for credentials, in place of an earlier request. Returns `false` if the identity
    /// names no authority.
    pub(crate) fn renew(&mut self, cx: &mut Context, csr: Bytes) -> bool {
        // The identity may have named another authority before.
        let asked = self.joins.iter().filter(|(_, join)| matches!(join.kind(), JoinKind::Renew(_)));
        let asked: Vec<_> = asked.map(|(name, _)| *name).collect();
        asked.iter().for_each(|name| self.leave(cx, name));
        let Some(authority) = cx.identity().authority() else { return false };
        let BlindName { name, .. } = BlindName::renewal(&authority, cx.identity());
        self.join(cx, name, authority, JoinKind::Renew(csr));
        true
    }

    /// Asks `authority` for an operation on this fleet, in place of an earlier request. Returns the name of the
    /// request.
    pub(crate) fn operate(
        &mut self,
        cx: &mut Context,
        authority: NodeId,
        request: &OperationRequest,
    ) -> Name {
        let BlindName { name, .. } = BlindName::operations(&authority, cx.identity());
        self.leave(cx, &name);
        self.join(cx, name, authority, JoinKind::Operate(request.to_bytes()));
        name
    }

    /// Asks an owner for the types of these interfaces, until the next question.
    pub(crate) fn ask_types(&mut self, cx: &mut Context, owner: NodeId, mut names: Vec<Name>) {
        names.truncate(TYPES_PER_QUESTION_MAX);
        let BlindName { name, .. } = BlindName::types(&owner);
        self.leave(cx, &name);
        if !names.is_empty() {
            self.join(cx, name, owner, JoinKind::Types(names));
        }
    }

    /// Asks a node for its consumers of this node's interfaces, until [`Self::leave_consumers`].
    pub(crate) fn ask_consumers(&mut self, cx: &mut Context, peer: NodeId) {
        self.join(cx, BlindName::consumers(&peer).name, peer, JoinKind::Consumers);
    }

    /// Stops asking a node.
    pub(crate) fn leave_consumers(&mut self, cx: &mut Context, peer: &NodeId) {
        self.leave(cx, &BlindName::consumers(peer).name);
    }

    /// Asks a node for its wishes about this node's topics, until [`Self::leave_wishes`].
    pub(crate) fn ask_wishes(&mut self, cx: &mut Context, peer: NodeId) {
        self.join(cx, BlindName::wishes(&peer).name, peer, JoinKind::Wishes);
    }

    /// Stops asking a node.
    pub(crate) fn leave_wishes(&mut self, cx: &mut Context, peer: &NodeId) {
        self.leave(cx, &BlindName::wishes(peer).name);
    }

    /// Asks a node of this fleet for a report, in place of an earlier question. Returns the name of the question.
    pub(crate) fn ask_report(&mut self, cx: &mut Context, peer: NodeId, question: &ReportQuestion) -> Name {
        let BlindName { name, .. } = BlindName::reports(&peer);
        self.leave(cx, &name);
        self.join(cx, name, peer, JoinKind::Report(question.to_bytes()));
        name
    }

    /// Asks a node of this fleet for its addresses, in place of an earlier question.
    pub(crate) fn ask_path(&mut self, cx: &mut Context, peer: NodeId, question: &PathQuestion) {
        let BlindName { name, .. } = BlindName::paths(&peer);
        self.leave(cx, &name);
        self.join(cx, name, peer, JoinKind::Path(question.to_bytes()));
    }

    /// Ends a question for a node's addresses.
    pub(crate) fn leave_path(&mut self, cx: &mut Context, peer: &NodeId) {
        self.leave(cx, &BlindName::paths(peer).name);
    }

    /// Asks a node for the time by its clock, in place of an earlier question.
    pub(crate) fn ask_clock(&mut self, cx: &mut Context, peer: NodeId) {
        let BlindName { name, .. } = BlindName::clock(&peer);
        let (now, post_quantum) = (cx.instant(), cx.identity().post_quantum());
        let Some(join) = self.joins.get_mut(&name) else {
            return self.join(cx, name, peer, JoinKind::Clock);
        };
        let leave = join.sink();
        let request = join.ask(now, post_quantum, cx.rng());
        send_leaves(cx, name, leave);
        if let Some(request) = request {
            send_request(cx, name, request);
        }
    }

    /// Asks a node for its time no more.
    pub(crate) fn leave_clock(&mut self, cx: &mut Context, peer: &NodeId) {
        self.leave(cx, &BlindName::clock(peer).name);
    }

    /// Iterates over the owners of the topics and services that this node joined.
    pub(crate) fn data_owners(&self) -> impl Iterator<Item = &VerifiedPeer> {
        let carries = |join: &&Join| {
            matches!(join.kind(), JoinKind::Subscribe { .. } | JoinKind::Publish(_))
                && join.granted_sink().is_some()
        };
        self.joins.values().filter(carries).filter_map(Join::reachable)
    }

    /// Joins a name of `owner`: waits for it if necessary, and joins again whenever it has to.
    pub(crate) fn join(&mut self, cx: &mut Context, name: Name, owner: NodeId, kind: JoinKind) {
        if self.joins.contains_key(&name) {
            return;
        }
        self.joins.insert(name, Join::new(owner, kind));
        cx.send(Control::Interest { names: vec![name] });
    }

    /// Leaves a name.
    pub(crate) fn leave(&mut self, cx: &mut Context, name: &Name) {
        let Some(join) = self.joins.remove(name) else { return };
        self.followed.remove(name);
        for sink in join.sink().into_iter().chain(join.rerouted_sink()) {
            cx.send(Control::Leave { name: *name, sink });
        }
        cx.send(Control::Uninterest { names: vec![*name] });
    }

    /// Returns the sink under which a name is granted to this node.
    pub(crate) fn sink_of(&self, name: &Name) -> Option<SinkId> {
        self.joins.get(name)?.granted_sink()
    }

    /// Asks a source of a granted name for its messages `from..=to`.
    pub(crate) fn recover(&mut self, cx: &mut Context, name: Name, source: SourceId, from: u64, to: u64) {
        if let Some(sink) = self.sink_of(&name) {
            cx.send(Control::Recover(Recover { name, sink, source, from, to }));
        }
    }

    /// Confirms to the owner of a granted name that everything of a source up to `seq` is here.
    pub(crate) fn confirm(&mut self, cx: &mut Context, name: Name, source: SourceId, seq: u64) {
        if let Some(sink) = self.sink_of(&name) {
            cx.send(Control::Recover(Recover::confirmation(name, sink, source, seq)));
        }
    }

    /// Returns the owner of a joined name.
    pub(crate) fn owner_of(&self, name: &Name) -> Option<NodeId> {
        self.joins.get(name).map(Join::owner)
    }

    /// Returns the status of a join.
    pub(crate) fn status(&self, name: &Name) -> Option<JoinStatus> {
        self.joins.get(name).map(Join::status)
    }

    /// Returns the status of following an owner: the best of its catalogues.
    pub(crate) fn follow_status(&self, owner: &NodeId) -> Option<JoinStatus> {
        let names = self.followed.iter().filter(|(_, o)| *o == owner);
        let all: Vec<_> = names.filter_map(|(name, _)| self.status(name)).collect();
        all.iter().find(|s| **s == JoinStatus::Granted).or(all.first()).copied()
    }

    /// Returns the time of the next [`Self::handle_timeout`].
    pub(crate) fn deadline(&self) -> Option<Instant> {
        self.joins.values().filter_map(Join::deadline).min()
    }

    /// Acts on timers that are due.
    pub(crate) fn handle_timeout(&mut self, cx: &mut Context) {
        let (now, post_quantum) = (cx.instant(), cx.identity().post_quantum());
        for (name, join) in &mut self.joins {
            if join.deadline().is_none_or(|at| at > now) {
                continue;
            }
            let TimeoutEffect { leave, ask } = join.handle_timeout(now, post_quantum, cx.rng());
            send_leaves(cx, *name, leave);
            if let Some(request) = ask {
                send_request(cx, *name, request);
            }
        }
    }

    /// Handles a router's notice of a better route for this sink.
    pub(crate) fn handle_reroute(&mut self, cx: &mut Context, name: Name, sink: SinkId) {
        let (now, post_quantum) = (cx.instant(), cx.identity().post_quantum());
        let Some(join) = self.joins.get_mut(&name).filter(|j| j.sink() == Some(sink)) else {
            return cx.unexpected(UnexpectedFrame::Reroute);
        };
        if let Some(request) = join.reroute(now, post_quantum, cx.rng()) {
            send_request(cx, name, request);
        }
    }

    /// Takes the advertisement of another node.
    pub(crate) fn handle_advert(&mut self, cx: &mut Context, advert: VerifiedAdvert) {
        for name in advert.names {
            let Some(join) = self.joins.get_mut(&name).filter(|j| j.owner() == advert.owner.node_id) else {
                continue; // another name of the same batch
            };
            if advert.body.withdraw {
                self.lose(cx, name, LostReason::Withdrawn);
            } else if join.advertised(advert.owner.clone()) {
                let (now, post_quantum) = (cx.instant(), cx.identity().post_quantum());
                if let Some(request) = join.ask(now, post_quantum, cx.rng()) {
                    send_request(cx, name, request);
                }
            }
        }
    }

    /// Handles the loss of the route to a name's owner.
    pub(crate) fn lose(&mut self, cx: &mut Context, name: Name, reason: LostReason) {
        let Some(join) = self.joins.get_mut(&name) else { return };
        let loss = join.lose();
        send_leaves(cx, name, loss.leave);
        if loss.was_granted {
            self.lost(cx, name, reason);
        } else if reason == LostReason::Withdrawn
            && let Some(owner) = self.followed.get(&name)
        {
            self.owner_lost(cx, *owner, reason);
        }
    }

    pub(crate) fn handle_answer(&mut self, cx: &mut Context, signed: &SignedBody) {
        let Ok(claimed) = AnswerBody::from_slice(&signed.body) else {
            return cx.unexpected(UnexpectedFrame::Answer);
        };
        let Some(owner) = self.joins.get(&claimed.name).and_then(|j| j.reachable().cloned()) else {
            return cx.unexpected(UnexpectedFrame::Answer);
        };
        match verify_answer(&owner, signed) {
            Ok(body) => self.handle_verified_answer(cx, &owner, body),
            Err(why) => cx.drop_frame(EndpointDrop::NotVerified { what: SignedKind::Answer, why }),
        }
    }

    fn handle_verified_answer(&mut self, cx: &mut Context, owner: &VerifiedPeer, body: AnswerBody) {
        let AnswerBody { name, sink, serial, .. } = body;
        let now = cx.instant();
        let Some(join) = self.joins.get_mut(&name) else {
            return cx.unexpected(UnexpectedFrame::Answer);
        };
        match join.handle_answer(now, body, cx.rng()) {
            AnswerEffect::Unexpected => cx.unexpected(UnexpectedFrame::Answer),
            AnswerEffect::Nothing => {}
            AnswerEffect::Granted { content, leave } => {
                self.granted_content(cx, owner.node_id, name, sink, serial, content);
                send_leaves(cx, name, leave);
                // The next question for the time may come much later.
                let clock = self.joins.get_mut(&name).filter(|join| matches!(join.kind(), JoinKind::Clock));
                send_leaves(cx, name, clock.and_then(Join::finish));
            }
            AnswerEffect::Refused { reason, leave, was_granted } => {
                send_leaves(cx, name, leave);
                if was_granted {
                    self.lost(cx, name, LostReason::Refused(reason));
                }
                // The end of a share is no refusal: the owner wanted it.
                if !(was_granted && reason == RefuseReason::NotShared) {
                    self.refused(cx, name, RefusedBy::Owner(reason));
                }
            }
            AnswerEffect::Unusable { why, leave } => {
                send_leaves(cx, name, leave);
                cx.drop_frame(why.into());
            }
        }
    }

    pub(crate) fn handle_reject(&mut self, cx: &mut Context, name: Name, sink: SinkId, reason: RejectReason) {
        let now = cx.instant();
        let Some(join) = self.joins.get_mut(&name) else {
            return cx.unexpected(UnexpectedFrame::Reject);
        };
        match join.handle_reject(now, sink, reason, cx.rng()) {
            RejectEffect::Unexpected => cx.unexpected(UnexpectedFrame::Reject),
            RejectEffect::Nothing => {}
            RejectEffect::Ended { leave, was_granted, is_visible } => {
                send_leaves(cx, name, leave);
                if was_granted {
                    self.lost(cx, name, LostReason::Cut(reason));
                }
                if is_visible {
                    self.refused(cx, name, RefusedBy::Router(reason));
                }
            }
        }
    }

    /// Follows the catalogues of all followed owners under all secrets in use, and no others: during a change of the
    /// secret, some owners are found under the old one and some under the new.
    fn refollow(&mut self, cx: &mut Context) {
        let names = |(owner, owner_name): (&NodeId, &String)| {
            let names = BlindName::catalogues(cx.identity(), owner, owner_name).into_iter();
            names.map(|own| (own.name, *owner)).collect::<Vec<_>>()
        };
        let wanted: Vec<_> = self.followed_names.iter().flat_map(names).collect();
        let gone: Vec<_> =
            self.followed.keys().filter(|n| wanted.iter().all(|(w, _)| w != *n)).copied().collect();
        for name in gone {
            self.leave(cx, &name);
        }
        for (name, owner) in wanted {
            self.followed.insert(name, owner);
            self.join(cx, name, owner, JoinKind::Follow);
        }
    }

    fn lost(&self, cx: &mut Context, name: Name, reason: LostReason) {
        let join = self.joins.get(&name);
        match (self.followed.get(&name), join.map(|j| (j.kind(), j.owner()))) {
            (Some(owner), _) => self.owner_lost(cx, *owner, reason),
            (None, Some((JoinKind::Consumers, peer))) => cx.event(Event::ConsumersLost { peer, reason }),
            (None, Some((JoinKind::Wishes, peer))) => cx.event(Event::WishesLost { peer, reason }),
            (None, Some((kind, _))) if kind.is_question() => {}
            (None, _) => cx.event(Event::Lost { name, reason }),
        }
    }

    /// Notes that one catalogue of an owner is lost; the owner is lost once all are.
    fn owner_lost(&self, cx: &mut Context, owner: NodeId, reason: LostReason) {
        if !self.hears(&owner) {
            cx.event(Event::OwnerLost { owner, reason });
        }
    }

    fn hears(&self, owner: &NodeId) -> bool {
        self.followed.iter().any(|(name, o)| o == owner && self.sink_of(name).is_some())
    }

    fn refused(&self, cx: &mut Context, name: Name, by: RefusedBy) {
        match (self.followed.get(&name).copied(), self.joins.get(&name).map(Join::kind)) {
            (Some(owner), _) if self.hears(&owner) => {}
            (Some(owner), _) => cx.event(Event::OwnerRefused { owner, by }),
            (None, Some(JoinKind::Renew(_))) => cx.event(Event::RenewRefused { by }),
            (None, Some(JoinKind::Operate(_))) => cx.event(Event::OperationDenied { name, by }),
            (None, Some(JoinKind::Report(_))) => cx.event(Event::ReportRefused { name, by }),
            (None, Some(JoinKind::Path(_))) => {
                if let Some(peer) = self.owner_of(&name) {
                    cx.event(Event::PathRefused { peer, by });
                }
            }
            // A missing answer shows where it is needed.
            (None, Some(JoinKind::Types(_) | JoinKind::Consumers | JoinKind::Wishes | JoinKind::Clock)) => {}
            (None, _) => cx.event(Event::Refused { name, by }),
        }
    }

    fn granted_content(
        &self,
        cx: &mut Context,
        owner: NodeId,
        name: Name,
        sink: SinkId,
        serial: u64,
        content: GrantContent,
    ) {
        match (content, self.joins.get(&name).map(Join::kind)) {
            (GrantContent::Catalogue(catalogue), Some(JoinKind::Follow)) => {
                cx.event(Event::Catalogue { owner, catalogue });
            }
            (GrantContent::Topic(grant), Some(JoinKind::Subscribe { .. } | JoinKind::Publish(_))) => {
                cx.event(Event::Granted { name, sink, grant });
                if serial > 1 {
                    // A new epoch waits for the acknowledgement.
                    cx.send(Control::Ack { name, sink, serial });
                }
            }
            (GrantContent::Credentials(credentials), Some(JoinKind::Renew(_))) => {
                cx.event(Event::Renewed { credentials });
            }
            (GrantContent::Operation(answer), Some(JoinKind::Operate(_))) => {
                cx.event(Event::OperationAnswered { name, answer });
            }
            (GrantContent::Report(report), Some(JoinKind::Report(_))) => {
                cx.event(Event::Report { name, report });
            }
            (GrantContent::Path(offer), Some(JoinKind::Path(_))) => {
                cx.event(Event::PathOffered { peer: owner, offer });
            }
            (GrantContent::Clock(time), Some(JoinKind::Clock)) => {
                if let Some(asked) = self.joins.get(&name).and_then(Join::asked) {
                    cx.event(Event::Time { peer: owner, asked, time });
                }
            }
            (GrantContent::Types(types), Some(JoinKind::Types(names))) => {
                let asked = |t: &DescribedType| names.contains(&t.name);
                let types: Vec<_> = types.into_iter().filter(asked).collect();
                cx.event(Event::Types { owner, types });
            }
            (GrantContent::Consumers(consumers), Some(JoinKind::Consumers)) => {
                cx.event(Event::Consumers { peer: owner, consumers });
            }
            (GrantContent::Wishes(wishes), Some(JoinKind::Wishes)) => {
                cx.event(Event::Wishes { peer: owner, wishes });
            }
            _ => cx.unexpected(UnexpectedFrame::GrantKind),
        }
    }
}

/// Sends a request to join a name.
fn send_request(cx: &mut Context, name: Name, request: JoinRequest) {
    let JoinRequest { sink, reply_key, request } = request;
    let (issued_at, chain) = (cx.now().unix, cx.identity().chain_bytes());
    let body = JoinBody { name, sink, request, issued_at, chain, reply_key };
    let signed = cx.identity().sign_join(&body);
    cx.send(Control::Join { signed });
}

/// Leaves branches of a name.
fn send_leaves(cx: &mut Context, name: Name, sinks: impl IntoIterator<Item = SinkId>) {
    sinks.into_iter().for_each(|sink| cx.send(Control::Leave { name, sink }));
}
