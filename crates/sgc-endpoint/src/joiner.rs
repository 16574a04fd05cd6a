//! The part of the endpoint that joins others' names: topics to receive or to publish on, catalogues, and the
//! authority.

use std::sync::Arc;

use bytes::Bytes;

use sgc_trust::{
    Identity, Kem, ReplyKey, TopicSecret, VerifiedPeer, name_of, operations_blind, renewal_blind,
    verify_advert, verify_answer,
};
use sgc_wire::{
    Answer, AnswerBody, Control, Decode, DescribedType, Encode as _, GrantContent, JoinBody, Metadata, Name,
    NodeId, Now, OperationRequest, Recover, RefuseReason, RejectReason, SignedBody, SinkId, SourceId,
};

use crate::endpoint::{Endpoint, EndpointDrop, Event, Output};
use crate::joins::{Join, JoinKind, JoinState, LostReason, RefusedBy, Rerouting};

impl Endpoint {
    /// Follows a fleet member's catalogue. Returns `false` if this identity has no fleet secret to find it with.
    pub fn follow(&mut self, now: Now, owner_name: &str) -> bool {
        self.now = now;
        let Some(owner) = self.config.identity.node_id_of(owner_name) else { return false };
        self.followed_names.insert(owner, owner_name.to_owned());
        self.refollow();
        true
    }

    /// Stops following a catalogue.
    pub fn unfollow(&mut self, now: Now, owner: &NodeId) {
        self.now = now;
        self.followed_names.remove(owner);
        self.refollow();
    }

    /// Follows the catalogues of all followed owners under all secrets in use, and no others: during a change of the
    /// secret, some owners are found under the old one and some under the new.
    pub(crate) fn refollow(&mut self) {
        let identity = self.config.identity.clone();
        let names = |(owner, owner_name): (&NodeId, &String)| {
            let metadata = Metadata::catalogue(owner_name);
            let secrets = identity.naming_secrets().iter();
            let blinds = secrets.map(|s| TopicSecret::derive(&s.secret, &metadata).blind());
            blinds.map(|blind| (name_of(owner, &blind), *owner)).collect::<Vec<_>>()
        };
        let wanted: Vec<_> = self.followed_names.iter().flat_map(names).collect();
        let gone: Vec<_> =
            self.followed.keys().filter(|n| wanted.iter().all(|(w, _)| w != *n)).copied().collect();
        for name in gone {
            self.leave(self.now, &name);
        }
        for (name, owner) in wanted {
            self.followed.insert(name, owner);
            self.join(self.now, name, owner, JoinKind::Follow);
        }
    }

    /// Asks the fleet's authority for credentials, in place of an earlier request. Returns `false` if the identity
    /// names no authority.
    pub fn renew(&mut self, now: Now, csr: Bytes) -> bool {
        let identity = &self.config.identity;
        let Some(authority) = identity.authority() else { return false };
        let name = name_of(&authority, &renewal_blind(&identity.as_peer().ca));
        self.leave(now, &name);
        self.join(now, name, authority, JoinKind::Renew(csr));
        true
    }

    /// Asks `authority` for an operation on this fleet, in place of an earlier request. Returns the name of the
    /// request, which the caller leaves after [`Event::OperationAnswered`] or [`Event::OperationDenied`].
    pub fn operate(&mut self, now: Now, authority: NodeId, request: &OperationRequest) -> Name {
        let name = name_of(&authority, &operations_blind(&self.config.identity.as_peer().ca));
        self.leave(now, &name);
        self.join(now, name, authority, JoinKind::Operate(request.to_bytes()));
        name
    }

    /// Joins a name of `owner`: waits for it if necessary, and joins again whenever it has to.
    pub fn join(&mut self, now: Now, name: Name, owner: NodeId, kind: JoinKind) {
        self.now = now;
        if self.joins.contains_key(&name) {
            return;
        }
        self.joins.insert(name, Join::new(owner, kind));
        self.send(Control::Interest { names: vec![name] });
    }

    /// Leaves a name.
    pub fn leave(&mut self, now: Now, name: &Name) {
        self.now = now;
        let Some(join) = self.joins.remove(name) else { return };
        self.followed.remove(name);
        for sink in join.sink().into_iter().chain(join.rerouted_sink()) {
            self.send(Control::Leave { name: *name, sink });
        }
        self.send(Control::Uninterest { names: vec![*name] });
    }

    /// Returns the sink under which a name is granted to this node.
    pub fn sink_of(&self, name: &Name) -> Option<SinkId> {
        self.is_granted(name).then(|| self.joins.get(name)?.sink()).flatten()
    }

    /// Asks a source of a granted name for its messages `from..=to`.
    pub fn recover(&mut self, name: Name, source: SourceId, from: u64, to: u64) {
        if let Some(JoinState::Granted { sink, .. }) = self.joins.get(&name).map(|j| &j.state) {
            let recover = Recover { name, sink: *sink, source, from, to };
            self.send(Control::Recover(recover));
        }
    }

    /// Asks for every grant once more, under the present certificate. Nothing is interrupted.
    pub(crate) fn refresh_joins(&mut self) {
        let identity = self.config.identity.clone();
        let frames: Vec<_> = self
            .joins
            .iter()
            .filter_map(|(name, join)| match &join.state {
                JoinState::Granted { sink, reply_key, .. } if !join.kind.is_question() => {
                    Some(self.join_frame(&identity, *name, *sink, &join.kind, reply_key.public().clone()))
                }
                _ => None,
            })
            .collect();
        frames.into_iter().for_each(|frame| self.send(frame));
    }

    fn join_frame(
        &self,
        identity: &Arc<Identity>,
        name: Name,
        sink: SinkId,
        kind: &JoinKind,
        reply_key: Bytes,
    ) -> Control {
        let body = JoinBody {
            name,
            sink,
            request: kind.request(),
            issued_at: self.now.unix,
            chain: identity.chain_bytes(),
            reply_key,
        };
        Control::Join { signed: identity.sign_join(&body) }
    }

    pub(crate) fn ask_due(&mut self) {
        let now = self.now.instant;
        let due: Vec<_> = self
            .joins
            .iter()
            .filter(|(_, j)| j.deadline().is_some_and(|at| at <= now))
            .map(|(n, _)| *n)
            .collect();
        for name in due {
            let Some(join) = self.joins.get(&name) else { continue };
            if let JoinState::Granted { .. } = join.state {
                if let Some(sink) = join.rerouted_sink() {
                    self.send(Control::Leave { name, sink });
                }
                self.ask_beside(name);
                continue;
            }
            if let JoinState::ExpectAnswer { sink, .. } = join.state {
                self.send(Control::Leave { name, sink });
            }
            self.ask(name);
        }
    }

    /// Handles a router's notice of a better route for this sink.
    pub(crate) fn handle_reroute(&mut self, name: Name, sink: SinkId) {
        let Some(join) = self.joins.get(&name).filter(|j| j.sink() == Some(sink)) else {
            return self.unexpected("reroute");
        };
        let asks = matches!((&join.state, &join.rerouting), (JoinState::Granted { .. }, Rerouting::No));
        if asks && !join.kind.is_question() {
            self.ask_beside(name);
        }
    }

    fn ask_beside(&mut self, name: Name) {
        let identity = self.config.identity.clone();
        let Some(join) = self.joins.get_mut(&name) else { return };
        let reply_key = ReplyKey::generate(Kem::for_fleet(identity.post_quantum()));
        let (sink, reply_key) = join.ask_beside(self.now.instant, reply_key, &mut self.rng);
        let kind = join.kind.clone();
        let frame = self.join_frame(&identity, name, sink, &kind, reply_key);
        self.send(frame);
    }

    /// Gives up the request beside a grant.
    fn leave_beside(&mut self, name: &Name) {
        let Some(join) = self.joins.get_mut(name) else { return };
        let sink = join.rerouted_sink();
        join.rerouting = Rerouting::No;
        if let Some(sink) = sink {
            self.send(Control::Leave { name: *name, sink });
        }
    }

    /// Replaces a lost grant by the request beside it. Returns `true` if there was one.
    fn fall_back(&mut self, name: &Name) -> bool {
        let Some(join) = self.joins.get_mut(name) else { return false };
        match std::mem::replace(&mut join.rerouting, Rerouting::No) {
            Rerouting::ExpectAnswer { sink, reply_key, deadline } => {
                join.state = JoinState::ExpectAnswer { sink, reply_key, deadline };
                true
            }
            Rerouting::No | Rerouting::ExpectRetry { .. } => false,
        }
    }

    pub(crate) fn handle_advert(&mut self, signed: &SignedBody) {
        let advert = match verify_advert(&self.anchors, signed, self.now.unix) {
            Ok(advert) => advert,
            Err(why) => return self.drop_frame(EndpointDrop::NotVerified { what: "advertisement", why }),
        };
        if advert.owner.node_id == self.config.identity.node_id() {
            return self.overtake(advert.body.seq);
        }
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

    /// Handles the loss of the route to a name's owner.
    pub(crate) fn lose(&mut self, name: Name, reason: LostReason, withdrawn: bool) {
        self.leave_beside(&name);
        let Some(join) = self.joins.get_mut(&name) else { return };
        join.reachable = None;
        // Routers keep a branch for as long as its links are there.
        if let Some(sink) = join.sink() {
            self.outputs.push_back(Output::Send(Control::Leave { name, sink }));
        }
        let was = std::mem::replace(&mut join.state, JoinState::ExpectAdvert);
        join.succeeded();
        if let JoinState::Granted { .. } = was {
            self.lost(name, reason);
        } else if withdrawn && let Some(owner) = self.followed.get(&name) {
            self.owner_lost(*owner, reason);
        }
    }

    fn lost(&mut self, name: Name, reason: LostReason) {
        match (self.followed.get(&name), self.joins.get(&name).map(|j| &j.kind)) {
            (Some(owner), _) => self.owner_lost(*owner, reason),
            (None, Some(JoinKind::Consumers)) => self.consumers_lost(name, reason),
            (None, Some(JoinKind::Renew(_) | JoinKind::Operate(_) | JoinKind::Types(_))) => {}
            (None, _) => self.event(Event::Lost { name, reason }),
        }
    }

    /// Notes that one catalogue of an owner is lost; the owner is lost once all are.
    fn owner_lost(&mut self, owner: NodeId, reason: LostReason) {
        if !self.hears(&owner) {
            self.event(Event::OwnerLost { owner, reason });
        }
    }

    fn hears(&self, owner: &NodeId) -> bool {
        self.followed.iter().any(|(name, o)| o == owner && self.is_granted(name))
    }

    fn refused(&mut self, name: Name, by: RefusedBy) {
        match (self.followed.get(&name).copied(), self.joins.get(&name).map(|j| &j.kind)) {
            (Some(owner), _) if self.hears(&owner) => {}
            (Some(owner), _) => self.event(Event::OwnerRefused { owner, by }),
            (None, Some(JoinKind::Renew(_))) => self.event(Event::RenewRefused { by }),
            (None, Some(JoinKind::Operate(_))) => self.event(Event::OperationDenied { name, by }),
            // A missing description shows where it is needed.
            (None, Some(JoinKind::Types(_) | JoinKind::Consumers)) => {}
            (None, _) => self.event(Event::Refused { name, by }),
        }
    }

    /// Asks the owner of `name`, if there is a route to it.
    fn ask(&mut self, name: Name) {
        let identity = self.config.identity.clone();
        let Some(join) = self.joins.get_mut(&name) else { return };
        if join.reachable.is_none() {
            join.state = JoinState::ExpectAdvert;
            return;
        }
        // An authority may require post-quantum keys before this node's identity says so.
        let of_authority = matches!(join.kind, JoinKind::Renew(_) | JoinKind::Operate(_));
        let reply_key = ReplyKey::generate(Kem::for_fleet(of_authority || identity.post_quantum()));
        let (sink, reply_key) = join.ask(self.now.instant, reply_key, &mut self.rng);
        let kind = join.kind.clone();
        let frame = self.join_frame(&identity, name, sink, &kind, reply_key);
        self.send(frame);
    }

    pub(crate) fn handle_answer(&mut self, signed: &SignedBody) {
        let Ok(claimed) = AnswerBody::from_slice(&signed.body) else {
            return self.unexpected("answer");
        };
        let Some(owner) = self.joins.get(&claimed.name).and_then(|j| j.reachable.clone()) else {
            return self.unexpected("answer");
        };
        match verify_answer(&owner, signed) {
            Ok(body) => self.handle_verified_answer(&owner, body),
            Err(why) => self.drop_frame(EndpointDrop::NotVerified { what: "answer", why }),
        }
    }

    fn handle_verified_answer(&mut self, owner: &VerifiedPeer, body: AnswerBody) {
        let AnswerBody { name, sink, serial, answer } = body;
        let Some(join) = self.joins.get_mut(&name) else { return self.unexpected("answer") };
        if join.rerouted_sink() == Some(sink) {
            return self.handle_answer_beside(owner, AnswerBody { name, sink, serial, answer });
        }
        if join.sink() != Some(sink) {
            return self.unexpected("answer");
        }
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
                self.leave_beside(&name);
                if was_granted {
                    self.lost(name, LostReason::Refused(reason));
                }
                // The end of a share is no refusal: the owner wanted it.
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
                self.granted_content(owner.node_id, name, sink, serial, content);
            }
            Err(why) => {
                join.retry(self.now.instant, None, &mut self.rng);
                self.leave_beside(&name);
                self.send(Control::Leave { name, sink });
                self.drop_frame(why.into());
            }
        }
    }

    /// Takes the answer to the request over a better route: it replaces the old grant.
    fn handle_answer_beside(&mut self, owner: &VerifiedPeer, body: AnswerBody) {
        let AnswerBody { name, sink, serial, answer } = body;
        let Some(join) = self.joins.get_mut(&name) else { return };
        let Rerouting::ExpectAnswer { reply_key, .. } = std::mem::replace(&mut join.rerouting, Rerouting::No)
        else {
            return;
        };
        let (enc, sealed) = match answer {
            Answer::Grant { enc, sealed } => (enc, sealed),
            // A refusal here leads to the loss of the old grant by the owner itself.
            Answer::Refuse { .. } => return,
        };
        match reply_key.open(&name, &sink, serial, &enc, &sealed) {
            Ok(content) => {
                let old = join.sink();
                join.state = JoinState::Granted { sink, reply_key, serial };
                self.granted_content(owner.node_id, name, sink, serial, content);
                if let Some(old) = old {
                    self.send(Control::Leave { name, sink: old });
                }
            }
            Err(why) => {
                join.retry_beside(self.now.instant, &mut self.rng);
                self.send(Control::Leave { name, sink });
                self.drop_frame(why.into());
            }
        }
    }

    fn granted_content(
        &mut self,
        owner: NodeId,
        name: Name,
        sink: SinkId,
        serial: u64,
        content: GrantContent,
    ) {
        let kind = self.joins.get(&name).map(|j| &j.kind);
        match (content, kind) {
            (GrantContent::Catalogue(catalogue), Some(JoinKind::Follow)) => {
                self.event(Event::Catalogue { owner, catalogue });
            }
            (GrantContent::Topic(grant), Some(JoinKind::Subscribe { .. } | JoinKind::Publish(_))) => {
                self.event(Event::Granted { name, sink, grant });
                if serial > 1 {
                    // A new epoch waits for the acknowledgement.
                    self.send(Control::Ack { name, sink, serial });
                }
            }
            (GrantContent::Credentials(credentials), Some(JoinKind::Renew(_))) => {
                self.event(Event::Renewed { credentials });
            }
            (GrantContent::Operation(answer), Some(JoinKind::Operate(_))) => {
                self.event(Event::OperationAnswered { name, answer });
            }
            (GrantContent::Types(types), Some(JoinKind::Types(names))) => {
                let asked = |t: &DescribedType| names.contains(&t.name);
                let types: Vec<_> = types.into_iter().filter(asked).collect();
                self.event(Event::Types { owner, types });
            }
            (GrantContent::Consumers(consumers), Some(JoinKind::Consumers)) => {
                self.event(Event::Consumers { peer: owner, consumers });
            }
            _ => self.unexpected("kind of grant"),
        }
    }

    pub(crate) fn handle_reject(&mut self, name: Name, sink: SinkId, reason: RejectReason) {
        let Some(join) = self.joins.get_mut(&name) else { return self.unexpected("reject") };
        if join.rerouted_sink() == Some(sink) {
            // The old grant still serves; if it does not, the answer is here already or will be asked for.
            return join.retry_beside(self.now.instant, &mut self.rng);
        }
        if join.sink() != Some(sink) {
            return self.unexpected("reject");
        }
        let was_granted = matches!(join.state, JoinState::Granted { .. });
        let by = RefusedBy::Router(reason);
        // A broken route mends by itself; the user should see any other reason during retries.
        let visible = !matches!(reason, RejectReason::RouteLost | RejectReason::NoRoute);
        if was_granted && !visible && self.fall_back(&name) {
            return self.lost(name, LostReason::Cut(reason));
        }
        self.leave_beside(&name);
        let Some(join) = self.joins.get_mut(&name) else { return };
        join.retry(self.now.instant, visible.then_some(by), &mut self.rng);
        if was_granted {
            self.lost(name, LostReason::Cut(reason));
        }
        if visible {
            self.refused(name, by);
        }
    }
}
