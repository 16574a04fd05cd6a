//! This node's joins: one state per joined name, from waiting to granted and back.

use std::time::{Duration, Instant};

use bytes::Bytes;
use rand_core::RngCore;
use sgc_trust::{ReplyKey, VerifiedPeer};
use sgc_wire::{
    Encode, Name, NodeId, RefuseReason, RejectReason, Request, SinkId, SourceOffer, TypeQuestion,
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
}

impl JoinKind {
    pub(crate) fn request(&self) -> Request {
        match self {
            Self::Subscribe { describe } => Request::Subscribe { describe: *describe },
            Self::Follow => Request::Subscribe { describe: false },
            Self::Publish(offer) => Request::Publish { offer: offer.clone() },
            Self::Renew(what) | Self::Operate(what) => Request::Ask { what: what.clone() },
            Self::Types(names) => {
                let question = TypeQuestion { names: names.clone() };
                Request::Ask { what: question.to_vec().into() }
            }
            Self::Consumers => Request::Ask { what: Bytes::new() },
        }
    }

    /// Returns whether one answer ends the join: no data flows, and no better route is looked for.
    pub(crate) fn is_question(&self) -> bool {
        matches!(self, Self::Renew(_) | Self::Operate(_) | Self::Types(_))
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

/// State of a join, by the event that it waits for.
#[derive(Debug)]
pub(crate) enum JoinState {
    /// An advertisement.
    ExpectAdvert,
    /// The owner's answer.
    ExpectAnswer { sink: SinkId, reply_key: ReplyKey, deadline: Instant },
    /// The time to ask again.
    ExpectRetry { at: Instant, refused: Option<RefusedBy> },
    /// Nothing: granted. The reply key opens later answers too.
    Granted { sink: SinkId, reply_key: ReplyKey, serial: u64 },
}

/// State of a request over a better route, while the old grant serves.
#[derive(Debug)]
pub(crate) enum Rerouting {
    /// There is none.
    No,
    /// The owner's answer.
    ExpectAnswer { sink: SinkId, reply_key: ReplyKey, deadline: Instant },
    /// The time to ask again.
    ExpectRetry { at: Instant },
}

/// A joined name.
#[derive(Debug)]
pub(crate) struct Join {
    /// The owner that the name has to have.
    pub(crate) owner: NodeId,
    pub(crate) kind: JoinKind,
    /// The owner as its last advertisement proved it; `None` while there is none.
    pub(crate) reachable: Option<VerifiedPeer>,
    pub(crate) state: JoinState,
    /// Only while granted.
    pub(crate) rerouting: Rerouting,
    attempts: u32,
}

impl Join {
    pub(crate) fn new(owner: NodeId, kind: JoinKind) -> Self {
        let (state, rerouting) = (JoinState::ExpectAdvert, Rerouting::No);
        Self { owner, kind, reachable: None, state, rerouting, attempts: 0 }
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

    /// Returns the sink of the request or grant.
    pub(crate) fn sink(&self) -> Option<SinkId> {
        match &self.state {
            JoinState::ExpectAnswer { sink, .. } | JoinState::Granted { sink, .. } => Some(*sink),
            _ => None,
        }
    }

    /// Returns the sink of the request over a better route.
    pub(crate) fn rerouted_sink(&self) -> Option<SinkId> {
        match &self.rerouting {
            Rerouting::ExpectAnswer { sink, .. } => Some(*sink),
            Rerouting::No | Rerouting::ExpectRetry { .. } => None,
        }
    }

    /// Returns the time to act if nothing happens.
    pub(crate) fn deadline(&self) -> Option<Instant> {
        let state = match &self.state {
            JoinState::ExpectAnswer { deadline, .. } => Some(*deadline),
            JoinState::ExpectRetry { at, .. } => Some(*at),
            _ => None,
        };
        let rerouting = match (&self.state, &self.rerouting) {
            (JoinState::Granted { .. }, Rerouting::ExpectAnswer { deadline, .. }) => Some(*deadline),
            (JoinState::Granted { .. }, Rerouting::ExpectRetry { at }) => Some(*at),
            _ => None,
        };
        state.into_iter().chain(rerouting).min()
    }

    /// Asks now, with a fresh sink id and reply key.
    pub(crate) fn ask(
        &mut self,
        now: Instant,
        reply_key: ReplyKey,
        rng: &mut impl RngCore,
    ) -> (SinkId, Bytes) {
        let sink = fresh_sink(rng);
        let public = reply_key.public().clone();
        self.attempts = self.attempts.saturating_add(1);
        self.state = JoinState::ExpectAnswer { sink, reply_key, deadline: now + ANSWER_WAIT };
        (sink, public)
    }

    /// Asks over a better route, beside the grant.
    pub(crate) fn ask_beside(
        &mut self,
        now: Instant,
        reply_key: ReplyKey,
        rng: &mut impl RngCore,
    ) -> (SinkId, Bytes) {
        let sink = fresh_sink(rng);
        let public = reply_key.public().clone();
        self.rerouting = Rerouting::ExpectAnswer { sink, reply_key, deadline: now + ANSWER_WAIT };
        (sink, public)
    }

    /// Asks over a better route a little later: the route may not be complete yet.
    pub(crate) fn retry_beside(&mut self, now: Instant, rng: &mut impl RngCore) {
        let wait = REROUTE_RETRY.mul_f64(0.5 + f64::from(rng.next_u32() % 1000) / 2000.0);
        self.rerouting = Rerouting::ExpectRetry { at: now + wait };
    }

    /// Asks again later: soon and then after growing pauses, with jitter so that many do not ask at once.
    pub(crate) fn retry(&mut self, now: Instant, refused: Option<RefusedBy>, rng: &mut impl RngCore) {
        let wait = match refused {
            Some(RefusedBy::Owner(_)) => REFUSED_RETRY,
            None if self.attempts == 0 => RETRY_FIRST,
            _ => (RETRY_MIN * 2u32.saturating_pow(self.attempts.saturating_sub(1).min(16))).min(RETRY_MAX),
        };
        let jitter = wait.mul_f64(f64::from(rng.next_u32() % 1000) / 2000.0);
        self.state = JoinState::ExpectRetry { at: now + wait / 2 + jitter, refused };
    }

    /// Asks again now if the clocks were the reason of the refusal.
    pub(crate) fn retry_refused_by_time(&mut self, now: Instant) {
        if let JoinState::ExpectRetry { at, refused: Some(by) } = &mut self.state
            && by.is_about_time()
        {
            *at = now;
        }
    }

    /// Resets the pauses.
    pub(crate) fn succeeded(&mut self) {
        self.attempts = 0;
    }
}

fn fresh_sink(rng: &mut impl RngCore) -> SinkId {
    let mut id = [0; 16];
    rng.fill_bytes(&mut id);
    SinkId(id)
}
