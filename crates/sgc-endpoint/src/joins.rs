//! This node's joins: one state per joined name, from waiting to granted and back.

use std::time::{Duration, Instant};

use bytes::Bytes;
use rand_core::RngCore;
use sgc_trust::{GrantError, Kem, ReplyKey, VerifiedPeer};
use sgc_wire::{
    Answer, AnswerBody, Encode, GrantContent, Name, NodeId, RefuseReason, RejectReason, Request, SinkId,
    SourceOffer, TypeQuestion,
};

/// Wait before the first repeated request for a lost grant: the route may be another by now.
const RETRY_FIRST: Duration = Duration::from_millis(20);
/// Shortest wait before asking again after that.
const RETRY_MIN: Duration = Duration::from_millis(50);
/// Longest wait before asking again over a better way, while the old one still serves.
const REROUTE_RETRY: Duration = Duration::from_millis(500);
/// Longest wait before asking again.
const RETRY_MAX: Duration = Duration::from_secs(10);
/// Wait before asking an owner again that refused.
const REFUSED_RETRY: Duration = Duration::from_secs(30);
/// Time to wait for an answer; routers give up earlier and report it.
const ANSWER_WAIT: Duration = Duration::from_secs(15);

/// The refusing node.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum RefusedBy {
    /// The owner, by a signed answer.
    Owner(RefuseReason),
    /// A router on the way.
    Router(RejectReason),
}

impl RefusedBy {
    /// Returns `true` if a corrected clock may change the answer.
    pub(crate) fn is_about_time(self) -> bool {
        matches!(
            self,
            Self::Owner(RefuseReason::Clock | RefuseReason::Expired)
                | Self::Router(RejectReason::Clock | RejectReason::Expired)
        )
    }
}

impl std::fmt::Display for RefusedBy {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        match self {
            Self::Owner(reason) => reason.fmt(f),
            Self::Router(reason) => reason.fmt(f),
        }
    }
}

/// The reason why a grant no longer carries data.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum LostReason {
    /// The owner withdrew the name.
    Withdrawn,
    /// No router in reach knows a route to the owner.
    Unreachable,
    /// A router cut the branch; the join is repeated.
    Cut(RejectReason),
    /// The owner revoked the grant.
    Refused(RefuseReason),
}

/// Purpose of a join.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum JoinKind {
    /// To receive the messages of a name; `describe` if its owner's catalogue cannot be seen.
    Subscribe {
        /// Whether the grant has to contain the metadata of the name.
        describe: bool,
    },
    /// To publish under a name.
    Publish(SourceOffer),
    /// To receive the catalogue of an owner.
    Follow,
    /// To get a certificate for this signing request (PKCS #10, DER).
    Renew(Bytes),
    /// To request an operation on the fleet from its authority: an encoded [`sgc_wire::OperationRequest`].
    Operate(Bytes),
    /// To get the types of these interfaces of an owner.
    Types(Vec<Name>),
    /// To get a node's consumers of this node's interfaces.
    Consumers,
    /// To get a node's wishes about this node's topics.
    Wishes,
    /// To get a node's report: the answer to an encoded [`sgc_wire::ReportQuestion`].
    Report(Bytes),
    /// To get a node's addresses: the answer to an encoded [`sgc_wire::PathQuestion`].
    Path(Bytes),
    /// To get the time by a node's clock.
    Clock,
}

impl JoinKind {
    pub(crate) fn request(&self) -> Request {
        match self {
            Self::Subscribe { describe } => Request::Subscribe { describe: *describe },
            Self::Follow => Request::Subscribe { describe: false },
            Self::Publish(offer) => Request::Publish { offer: offer.clone() },
            Self::Renew(what) | Self::Operate(what) | Self::Report(what) | Self::Path(what) => {
                Request::Ask { what: what.clone() }
            }
            Self::Types(names) => {
                let question = TypeQuestion { names: names.clone() };
                Request::Ask { what: question.to_vec().into() }
            }
            Self::Consumers | Self::Wishes | Self::Clock => Request::Ask { what: Bytes::new() },
        }
    }

    /// Returns whether one answer ends the join: no data flows, and no better route is looked for.
    pub(crate) fn is_question(&self) -> bool {
        match self {
            Self::Subscribe { .. } | Self::Publish(_) | Self::Follow | Self::Consumers | Self::Wishes => {
                false
            }
            Self::Renew(_)
            | Self::Operate(_)
            | Self::Types(_)
            | Self::Report(_)
            | Self::Path(_)
            | Self::Clock => true,
        }
    }
}

/// Status of a join.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum JoinStatus {
    /// Nobody in reach advertises the name.
    Waiting,
    /// Asked, not answered yet.
    Asked,
    /// Refused; the join is repeated later.
    Refused(RefusedBy),
    /// Granted.
    Granted,
}

/// A joined name.
#[derive(Debug)]
pub(crate) struct Join {
    /// The owner that the name has to have.
    owner: NodeId,
    kind: JoinKind,
    /// The owner as its last advertisement proved it; `None` while there is none.
    reachable: Option<VerifiedPeer>,
    state: JoinState,
    attempts: u32,
    /// Time of the last request.
    asked: Option<Instant>,
}

/// State of a join, by the event that it waits for.
#[derive(Debug)]
enum JoinState {
    /// An advertisement.
    ExpectAdvert,
    /// The owner's answer.
    ExpectAnswer { sink: SinkId, reply_key: ReplyKey, deadline: Instant },
    /// The time to ask again.
    ExpectRetry { at: Instant, refused: Option<RefusedBy> },
    /// Nothing: granted. The reply key opens later answers too.
    Granted { sink: SinkId, reply_key: ReplyKey, serial: u64, rerouting: Rerouting },
}

/// State of a request over a better route, while the old grant serves.
#[derive(Debug)]
enum Rerouting {
    /// There is none.
    No,
    /// The owner's answer.
    ExpectAnswer { sink: SinkId, reply_key: ReplyKey, deadline: Instant },
    /// The time to ask again.
    ExpectRetry { at: Instant },
}

impl Rerouting {
    /// Returns the sink of the request.
    fn sink(&self) -> Option<SinkId> {
        match self {
            Self::ExpectAnswer { sink, .. } => Some(*sink),
            Self::No | Self::ExpectRetry { .. } => None,
        }
    }

    /// Asks a little later: the route may not be complete yet.
    fn retry(now: Instant, rng: &mut impl RngCore) -> Self {
        let wait = REROUTE_RETRY.mul_f64(0.5 + f64::from(rng.next_u32() % 1000) / 2000.0);
        Self::ExpectRetry { at: now + wait }
    }
}

/// A request to send to the owner.
#[derive(Debug)]
pub(crate) struct JoinRequest {
    pub(crate) sink: SinkId,
    /// The public part of the reply key.
    pub(crate) reply_key: Bytes,
    pub(crate) request: Request,
}

/// The effects of a timer: a branch to leave, then a request to send.
#[derive(Debug)]
pub(crate) struct TimeoutEffect {
    pub(crate) leave: Option<SinkId>,
    pub(crate) ask: Option<JoinRequest>,
}

/// The effects of the loss of the route.
#[derive(Debug)]
pub(crate) struct LossEffect {
    /// The branches to leave, in this order.
    pub(crate) leave: Vec<SinkId>,
    /// Whether a grant was lost.
    pub(crate) was_granted: bool,
}

/// The effects of an owner's answer.
#[derive(Debug)]
pub(crate) enum AnswerEffect {
    /// It answers nothing.
    Unexpected,
    /// The old grant stands.
    Nothing,
    /// A grant, or another content of it; then a branch to leave.
    Granted { content: GrantContent, leave: Option<SinkId> },
    /// A refusal: first a branch to leave.
    Refused { reason: RefuseReason, leave: Option<SinkId>, was_granted: bool },
    /// A grant that does not open: the branches to leave, in this order.
    Unusable { why: GrantError, leave: Vec<SinkId> },
}

/// The effects of a router's rejection.
#[derive(Debug)]
pub(crate) enum RejectEffect {
    /// It rejects nothing.
    Unexpected,
    /// The grant still serves.
    Nothing,
    /// The request or the grant ended.
    Ended {
        /// A branch to leave first.
        leave: Option<SinkId>,
        /// Whether a grant was lost.
        was_granted: bool,
        /// Whether the user should see the refusal during retries.
        is_visible: bool,
    },
}

impl Join {
    pub(crate) fn new(owner: NodeId, kind: JoinKind) -> Self {
        Self { owner, kind, reachable: None, state: JoinState::ExpectAdvert, attempts: 0, asked: None }
    }

    pub(crate) fn owner(&self) -> NodeId {
        self.owner
    }

    pub(crate) fn kind(&self) -> &JoinKind {
        &self.kind
    }

    /// Returns the time of the last request over the present route.
    pub(crate) fn asked(&self) -> Option<Instant> {
        self.asked
    }

    /// Returns the owner as its last advertisement proved it.
    pub(crate) fn reachable(&self) -> Option<&VerifiedPeer> {
        self.reachable.as_ref()
    }

    pub(crate) fn status(&self) -> JoinStatus {
        match &self.state {
            JoinState::ExpectAdvert => JoinStatus::Waiting,
            JoinState::ExpectAnswer { .. } => JoinStatus::Asked,
            JoinState::ExpectRetry { refused: Some(by), .. } => JoinStatus::Refused(*by),
            JoinState::ExpectRetry { refused: None, .. } => JoinStatus::Waiting,
            JoinState::Granted { .. } => JoinStatus::Granted,
        }
    }

    /// Returns the sink of the grant.
    pub(crate) fn granted_sink(&self) -> Option<SinkId> {
        match &self.state {
            JoinState::Granted { sink, .. } => Some(*sink),
            _ => None,
        }
    }

    /// Returns the sink of the request or grant.
    pub(crate) fn sink(&self) -> Option<SinkId> {
        match &self.state {
            JoinState::ExpectAnswer { sink, .. } | JoinState::Granted { sink, .. } => Some(*sink),
            _ => None,
        }
    }

    /// Returns the sink of the request over a better route.
    pub(crate) fn rerouted_sink(&self) -> Option<SinkId> {
        match &self.state {
            JoinState::Granted { rerouting, .. } => rerouting.sink(),
            _ => None,
        }
    }

    /// Returns the time to act if nothing happens.
    pub(crate) fn deadline(&self) -> Option<Instant> {
        match &self.state {
            JoinState::ExpectAnswer { deadline: at, .. }
            | JoinState::ExpectRetry { at, .. }
            | JoinState::Granted {
                rerouting: Rerouting::ExpectAnswer { deadline: at, .. } | Rerouting::ExpectRetry { at },
                ..
            } => Some(*at),
            JoinState::ExpectAdvert | JoinState::Granted { rerouting: Rerouting::No, .. } => None,
        }
    }

    /// Notes an advertisement of the owner. Returns `true` if the join has to ask now.
    pub(crate) fn advertised(&mut self, owner: VerifiedPeer) -> bool {
        self.reachable = Some(owner);
        matches!(self.state, JoinState::ExpectAdvert | JoinState::ExpectRetry { refused: None, .. })
    }

    /// Asks now, with a fresh sink id and reply key, if there is a route to the owner.
    pub(crate) fn ask(
        &mut self,
        now: Instant,
        post_quantum: bool,
        rng: &mut impl RngCore,
    ) -> Option<JoinRequest> {
        if self.reachable.is_none() {
            self.state = JoinState::ExpectAdvert;
            return None;
        }
        let (sink, reply_key) = self.fresh_request(post_quantum, rng);
        let request = self.request(sink, &reply_key);
        self.attempts = self.attempts.saturating_add(1);
        self.asked = Some(now);
        self.state = JoinState::ExpectAnswer { sink, reply_key, deadline: now + ANSWER_WAIT };
        Some(request)
    }

    /// Asks over a better route, beside the grant, unless it does so already.
    pub(crate) fn reroute(
        &mut self,
        now: Instant,
        post_quantum: bool,
        rng: &mut impl RngCore,
    ) -> Option<JoinRequest> {
        let is_idle = matches!(self.state, JoinState::Granted { rerouting: Rerouting::No, .. });
        (is_idle && !self.kind.is_question()).then(|| self.ask_beside(now, post_quantum, rng))?
    }

    /// Acts at the [`Self::deadline`].
    pub(crate) fn handle_timeout(
        &mut self,
        now: Instant,
        post_quantum: bool,
        rng: &mut impl RngCore,
    ) -> TimeoutEffect {
        match &self.state {
            JoinState::Granted { rerouting, .. } => {
                let leave = rerouting.sink();
                TimeoutEffect { leave, ask: self.ask_beside(now, post_quantum, rng) }
            }
            _ => {
                let leave = self.sink();
                TimeoutEffect { leave, ask: self.ask(now, post_quantum, rng) }
            }
        }
    }

    /// Returns the request for the present grant once more, to be signed with another certificate.
    pub(crate) fn refresh(&self) -> Option<JoinRequest> {
        match &self.state {
            JoinState::Granted { sink, reply_key, .. } if !self.kind.is_question() => {
                Some(self.request(*sink, reply_key))
            }
            _ => None,
        }
    }

    /// Asks again now if the clocks were the reason of the refusal.
    pub(crate) fn retry_refused_by_time(&mut self, now: Instant) {
        if let JoinState::ExpectRetry { at, refused: Some(by) } = &mut self.state
            && by.is_about_time()
        {
            *at = now;
        }
    }

    /// Notes the loss of the route to the owner.
    pub(crate) fn lose(&mut self) -> LossEffect {
        self.reachable = None;
        // Routers keep a branch for as long as its links are there.
        let leave = self.rerouted_sink().into_iter().chain(self.sink()).collect();
        let was = std::mem::replace(&mut self.state, JoinState::ExpectAdvert);
        self.attempts = 0;
        LossEffect { leave, was_granted: matches!(was, JoinState::Granted { .. }) }
    }

    /// Takes a verified answer of the owner.
    pub(crate) fn handle_answer(
        &mut self,
        now: Instant,
        body: AnswerBody,
        rng: &mut impl RngCore,
    ) -> AnswerEffect {
        let AnswerBody { name, sink, serial, answer } = body;
        if self.rerouted_sink() == Some(sink) {
            return self.handle_answer_beside(now, AnswerBody { name, sink, serial, answer }, rng);
        }
        if self.sink() != Some(sink) {
            return AnswerEffect::Unexpected;
        }
        let beside = self.rerouted_sink();
        let state = std::mem::replace(&mut self.state, JoinState::ExpectAdvert);
        let (reply_key, last, rerouting, was_granted) = match state {
            JoinState::ExpectAnswer { reply_key, .. } => (reply_key, 0, Rerouting::No, false),
            JoinState::Granted { reply_key, serial, rerouting, .. } => (reply_key, serial, rerouting, true),
            state @ (JoinState::ExpectAdvert | JoinState::ExpectRetry { .. }) => {
                self.state = state;
                return AnswerEffect::Nothing;
            }
        };
        if serial <= last {
            self.state = JoinState::Granted { sink, reply_key, serial: last, rerouting };
            return AnswerEffect::Unexpected;
        }
        let (enc, sealed) = match answer {
            Answer::Grant { enc, sealed } => (enc, sealed),
            Answer::Refuse { reason } => {
                self.retry(now, Some(RefusedBy::Owner(reason)), rng);
                return AnswerEffect::Refused { reason, leave: beside, was_granted };
            }
        };
        match reply_key.open(&name, &sink, serial, &enc, &sealed) {
            Ok(content) => {
                self.attempts = 0;
                self.state = JoinState::Granted { sink, reply_key, serial, rerouting };
                AnswerEffect::Granted { content, leave: None }
            }
            Err(why) => {
                self.retry(now, None, rng);
                AnswerEffect::Unusable { why, leave: beside.into_iter().chain([sink]).collect() }
            }
        }
    }

    /// Takes the answer to the request over a better route: it replaces the old grant.
    fn handle_answer_beside(
        &mut self,
        now: Instant,
        body: AnswerBody,
        rng: &mut impl RngCore,
    ) -> AnswerEffect {
        let AnswerBody { name, sink, serial, answer } = body;
        let JoinState::Granted { sink: old, rerouting, .. } = &mut self.state else {
            return AnswerEffect::Nothing;
        };
        let (old, was) = (*old, std::mem::replace(rerouting, Rerouting::No));
        let (Rerouting::ExpectAnswer { reply_key, .. }, Answer::Grant { enc, sealed }) = (was, answer) else {
            // A refusal here leads to the loss of the old grant by the owner itself.
            return AnswerEffect::Nothing;
        };
        match reply_key.open(&name, &sink, serial, &enc, &sealed) {
            Ok(content) => {
                self.state = JoinState::Granted { sink, reply_key, serial, rerouting: Rerouting::No };
                AnswerEffect::Granted { content, leave: Some(old) }
            }
            Err(why) => {
                *rerouting = Rerouting::retry(now, rng);
                AnswerEffect::Unusable { why, leave: vec![sink] }
            }
        }
    }

    /// Ends a question that is answered, until it is asked again. Returns the branch to leave.
    pub(crate) fn finish(&mut self) -> Option<SinkId> {
        let sink = self.granted_sink()?;
        self.state = JoinState::ExpectAdvert;
        Some(sink)
    }

    /// Takes a router's rejection of the request or grant.
    pub(crate) fn handle_reject(
        &mut self,
        now: Instant,
        sink: SinkId,
        reason: RejectReason,
        rng: &mut impl RngCore,
    ) -> RejectEffect {
        if let JoinState::Granted { rerouting, .. } = &mut self.state
            && rerouting.sink() == Some(sink)
        {
            // The old grant still serves; if it does not, the answer is here already or will be asked for.
            *rerouting = Rerouting::retry(now, rng);
            return RejectEffect::Nothing;
        }
        if self.sink() != Some(sink) {
            return RejectEffect::Unexpected;
        }
        let was_granted = self.granted_sink().is_some();
        // A broken route mends by itself; the user should see any other reason during retries.
        let is_visible = !matches!(reason, RejectReason::RouteLost | RejectReason::NoRoute);
        if was_granted && !is_visible && self.fall_back() {
            return RejectEffect::Ended { leave: None, was_granted, is_visible };
        }
        let leave = self.rerouted_sink();
        self.retry(now, is_visible.then_some(RefusedBy::Router(reason)), rng);
        RejectEffect::Ended { leave, was_granted, is_visible }
    }

    /// Asks over a better route, beside the grant.
    fn ask_beside(
        &mut self,
        now: Instant,
        post_quantum: bool,
        rng: &mut impl RngCore,
    ) -> Option<JoinRequest> {
        let (sink, reply_key) = self.fresh_request(post_quantum, rng);
        let request = self.request(sink, &reply_key);
        let JoinState::Granted { rerouting, .. } = &mut self.state else { return None };
        *rerouting = Rerouting::ExpectAnswer { sink, reply_key, deadline: now + ANSWER_WAIT };
        Some(request)
    }

    /// Replaces a lost grant by the request beside it. Returns `true` if there was one.
    fn fall_back(&mut self) -> bool {
        let JoinState::Granted { rerouting, .. } = &mut self.state else { return false };
        match std::mem::replace(rerouting, Rerouting::No) {
            Rerouting::ExpectAnswer { sink, reply_key, deadline } => {
                self.state = JoinState::ExpectAnswer { sink, reply_key, deadline };
                true
            }
            Rerouting::No | Rerouting::ExpectRetry { .. } => false,
        }
    }

    /// Asks again later: soon and then after growing pauses, with jitter so that many do not ask at once.
    fn retry(&mut self, now: Instant, refused: Option<RefusedBy>, rng: &mut impl RngCore) {
        let wait = match refused {
            Some(RefusedBy::Owner(_)) => REFUSED_RETRY,
            None if self.attempts == 0 => RETRY_FIRST,
            _ => (RETRY_MIN * 2u32.saturating_pow(self.attempts.saturating_sub(1).min(16))).min(RETRY_MAX),
        };
        let jitter = wait.mul_f64(f64::from(rng.next_u32() % 1000) / 2000.0);
        self.state = JoinState::ExpectRetry { at: now + wait / 2 + jitter, refused };
    }

    fn fresh_request(&self, post_quantum: bool, rng: &mut impl RngCore) -> (SinkId, ReplyKey) {
        // An authority may require post-quantum keys before this node's identity says so.
        let of_authority = matches!(self.kind, JoinKind::Renew(_) | JoinKind::Operate(_));
        let reply_key = ReplyKey::generate(Kem::for_fleet(of_authority || post_quantum));
        let mut id = [0; 16];
        rng.fill_bytes(&mut id);
        (SinkId(id), reply_key)
    }

    fn request(&self, sink: SinkId, reply_key: &ReplyKey) -> JoinRequest {
        JoinRequest { sink, reply_key: reply_key.public().clone(), request: self.kind.request() }
    }
}
