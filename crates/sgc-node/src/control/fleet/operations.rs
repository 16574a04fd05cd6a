//! Operations on the fleet that users of this node request from an authority: one at a time, each with a deadline.

use std::collections::VecDeque;
use std::time::{Duration, Instant};

use sgc_endpoint::RefusedBy;
use sgc_wire::{Challenge, Name, NodeId, Operation, OperationAnswer, OperationRequest, RefuseReason};
use tokio::sync::oneshot;

/// Most operations that wait for the one under way.
const WAITING_MAX: usize = 16;
/// Longest search for an authority.
const FIND_MAX: Duration = Duration::from_secs(10);
/// Longest total time of an operation, waiting included.
pub(crate) const OPERATION_MAX: Duration = Duration::from_secs(30);

/// Reasons why an operation was not carried out, or may not have been.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
pub enum OperationError {
    /// A router cannot derive a node's name.
    #[error("this node is a router: it holds no secret of the fleet and finds no node by its name")]
    NoSecret,
    /// The node is the authority itself.
    #[error("{at} is this node: use the fleet's file here, without `--at`")]
    OwnName {
        /// The name.
        at: String,
    },
    /// Too many operations wait.
    #[error("{WAITING_MAX} operations wait at this node already")]
    Full,
    /// The authority is out of reach.
    #[error(
        "no authority {at} is in reach of this node{hint}: it has to run, with the fleet's file in its [authority], and \
         that file names it by exactly that name (`sgc status` shows the links of this node)"
    )]
    NotFound {
        /// The name.
        at: String,
        /// The probable cause.
        hint: &'static str,
    },
    /// This node is no operator.
    #[error(
        "{at} does not take this node for an operator: `operators` in its [authority] has to name it or a group of it"
    )]
    NotOperator {
        /// The authority.
        at: String,
    },
    /// The authority or a router refused the request itself.
    #[error("{at} was not asked: {by}")]
    Denied {
        /// The authority.
        at: String,
        /// The refusing node, and its reason.
        by: RefusedBy,
    },
    /// The authority did not answer before it got the operation.
    #[error("{at} does not answer: nothing was done")]
    Silent {
        /// The authority.
        at: String,
    },
    /// The authority may have carried it out.
    #[error(
        "{at} has not answered in time, or was restarted meanwhile: the operation may have been carried out. See \
         `sgc fleet list --at {at}`, and repeat the command if it was not"
    )]
    OutcomeUnknown {
        /// The authority.
        at: String,
    },
    /// The authority that would redeem the invitation of this node is out of reach.
    #[error("no authority {at} is in reach: its node has to run. The code stays good")]
    AuthorityAway {
        /// The authority.
        at: String,
    },
    /// The authority is of a version before there were invitations.
    #[error("{at} takes no codes: it is of an earlier version")]
    NoInvitations {
        /// The authority.
        at: String,
    },
    /// The authority may have redeemed the invitation of this node.
    #[error(
        "{at} has not answered in time, or was restarted meanwhile: the code may be used up. Try it once more"
    )]
    MaybeJoined {
        /// The authority.
        at: String,
    },
    /// The node stops.
    #[error("the node is stopping")]
    Stopping,
}

impl OperationError {
    /// Returns the error in the words of the holder of an invitation.
    fn of_holder(self) -> Self {
        match self {
            Self::NotFound { at, .. } => Self::AuthorityAway { at },
            Self::NotOperator { at } => Self::NoInvitations { at },
            Self::OutcomeUnknown { at } => Self::MaybeJoined { at },
            other => other,
        }
    }
}

/// An operation that a user requests.
#[derive(Debug)]
pub(crate) struct UserOperation {
    /// The authority, by name and id.
    pub(crate) at: String,
    pub(crate) authority: NodeId,
    /// Whether this node's identity names that authority.
    pub(crate) is_named: bool,
    /// Whether this node holds an invitation.
    pub(crate) is_invited: bool,
    pub(crate) operation: Operation,
    pub(crate) reply: oneshot::Sender<Result<OperationAnswer, OperationError>>,
}

/// Next action of the node.
#[derive(Debug, PartialEq, Eq)]
pub(crate) enum Step {
    /// Ask this authority.
    Ask(NodeId, OperationRequest),
    /// Leave the name of the authority.
    Leave(Name),
}

/// Waiting operations, and the one under way.
#[derive(Debug, Default)]
pub(crate) struct Operations {
    waiting: VecDeque<(UserOperation, Instant)>,
    current: Option<Current>,
}

#[derive(Debug)]
struct Current {
    operation_request: UserOperation,
    /// Name at which the authority is asked, once it is.
    name: Option<Name>,
    find_until: Instant,
    until: Instant,
    state: State,
}

/// Event that the operation under way waits for.
#[derive(Debug)]
enum State {
    /// A challenge.
    ExpectChallenge,
    /// The outcome.
    ExpectOutcome,
}

impl Operations {
    /// Queues an operation. [`Operations::next`] begins it.
    pub(crate) fn push(&mut self, now: Instant, operation_request: UserOperation) {
        if self.waiting.len() >= WAITING_MAX {
            let _ = operation_request.reply.send(Err(OperationError::Full));
            return;
        }
        self.waiting.push_back((operation_request, now + OPERATION_MAX));
    }

    /// Begins the next operation if none is under way.
    pub(crate) fn next(&mut self, now: Instant) -> Option<Step> {
        if self.current.is_some() {
            return None;
        }
        // Some clients have left.
        let next = std::iter::from_fn(|| self.waiting.pop_front())
            .find(|(operation_request, _)| !operation_request.reply.is_closed());
        let (operation_request, until) = next?;
        let step = Step::Ask(operation_request.authority, OperationRequest::Challenge);
        let (name, find_until) = (None, now + FIND_MAX);
        self.current =
            Some(Current { operation_request, name, find_until, until, state: State::ExpectChallenge });
        Some(step)
    }

    /// Notes the name at which the authority is asked.
    pub(crate) fn asked(&mut self, name: Name) {
        if let Some(current) = &mut self.current {
            current.name = Some(name);
        }
    }

    /// Handles an answer.
    pub(crate) fn answered(&mut self, name: Name, answer: OperationAnswer) -> Option<Step> {
        let current = self.current.as_mut().filter(|c| c.name == Some(name))?;
        match (&current.state, answer) {
            (State::ExpectChallenge, OperationAnswer::Challenge(challenge)) => {
                Some(current.execute(challenge))
            }
            (State::ExpectOutcome, OperationAnswer::Challenge(_)) => None,
            (_, answer) => self.end(Ok(answer)),
        }
    }

    /// Handles a refusal of the authority or of a router before it.
    pub(crate) fn denied(&mut self, name: Name, by: RefusedBy) -> Option<Step> {
        let current = self.current.as_ref().filter(|c| c.name == Some(name))?;
        let at = current.operation_request.at.clone();
        match (by, &current.state) {
            (RefusedBy::Owner(RefuseReason::NotPermitted), _) => {
                self.end(Err(OperationError::NotOperator { at }))
            }
            // Another request of this node replaced this one there, or a limit is reached.
            (_, State::ExpectOutcome) => self.end(Err(OperationError::OutcomeUnknown { at })),
            (by, State::ExpectChallenge) => self.end(Err(OperationError::Denied { at, by })),
        }
    }

    /// Returns the name at which the current authority is asked.
    pub(crate) fn name(&self) -> Option<Name> {
        self.current.as_ref()?.name
    }

    /// Returns the time at which to call [`Operations::look`].
    pub(crate) fn deadline(&self) -> Option<Instant> {
        self.current.as_ref().map(|current| match current.state {
            State::ExpectChallenge => current.find_until.min(current.until),
            State::ExpectOutcome => current.until,
        })
    }

    /// Ends the operation if its time is over, or if the authority's name is not advertised for too long.
    pub(crate) fn look(&mut self, now: Instant, is_found: bool) -> Option<Step> {
        let current = self.current.as_mut()?;
        let at = current.operation_request.at.clone();
        match current.state {
            State::ExpectChallenge if current.find_until <= now && !is_found => {
                let hint = match current.operation_request.is_named {
                    true => "",
                    false => ", whose identity names another authority or none",
                };
                self.end(Err(OperationError::NotFound { at, hint }))
            }
            State::ExpectChallenge if current.until <= now => self.end(Err(OperationError::Silent { at })),
            State::ExpectOutcome if current.until <= now => {
                self.end(Err(OperationError::OutcomeUnknown { at }))
            }
            State::ExpectChallenge => {
                // The name was found, so the authority has the rest of the time to answer.
                if current.find_until <= now {
                    current.find_until = current.until;
                }
                None
            }
            State::ExpectOutcome => None,
        }
    }

    /// Ends all operations, because the node stops.
    pub(crate) fn stop(&mut self) {
        let waiting = self.waiting.drain(..).map(|(operation_request, _)| operation_request);
        for operation_request in waiting.chain(self.current.take().map(|current| current.operation_request)) {
            let _ = operation_request.reply.send(Err(OperationError::Stopping));
        }
    }

    fn end(&mut self, result: Result<OperationAnswer, OperationError>) -> Option<Step> {
        let Current { operation_request, name, .. } = self.current.take()?;
        let result = match operation_request.is_invited {
            true => result.map_err(OperationError::of_holder),
            false => result,
        };
        let _ = operation_request.reply.send(result);
        name.map(Step::Leave)
    }
}

impl Current {
    fn execute(&mut self, challenge: Challenge) -> Step {
        self.state = State::ExpectOutcome;
        let operation = self.operation_request.operation.clone();
        Step::Ask(self.operation_request.authority, OperationRequest::Execute { challenge, operation })
    }
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]

    use sgc_wire::RejectReason;
    use tokio::sync::oneshot::Receiver;

    use super::*;

    const KEEPER: NodeId = NodeId([1; 32]);
    const NAME: Name = Name([2; 32]);
    const CHALLENGE: Challenge = Challenge([3; 16]);

    type Reply = Receiver<Result<OperationAnswer, OperationError>>;

    fn list() -> Operation {
        Operation::List { after: None }
    }

    fn operation_request() -> (UserOperation, Reply) {
        let (reply, replied) = oneshot::channel();
        let at = "keeper".to_owned();
        let operation_request = UserOperation {
            at,
            authority: KEEPER,
            is_named: true,
            is_invited: false,
            operation: list(),
            reply,
        };
        (operation_request, replied)
    }

    /// Returns an operation under way that waits for a challenge.
    fn begun(now: Instant) -> (Operations, Reply) {
        let mut operations = Operations::default();
        let (operation_request, replied) = operation_request();
        operations.push(now, operation_request);
        assert_eq!(operations.next(now), Some(Step::Ask(KEEPER, OperationRequest::Challenge)));
        operations.asked(NAME);
        (operations, replied)
    }

    fn end(mut replied: Reply) -> Result<OperationAnswer, OperationError> {
        replied.try_recv().unwrap()
    }

    #[test]
    fn an_operation_takes_a_challenge_and_is_asked_for_with_it() {
        let now = Instant::now();
        let (mut operations, replied) = begun(now);
        let (second, waits) = operation_request();
        operations.push(now, second);
        assert_eq!(operations.next(now), None, "one at a time");
        let other = OperationAnswer::Challenge(Challenge([9; 16]));
        assert_eq!(operations.answered(Name([7; 32]), other.clone()), None, "of another name");
        let step = operations.answered(NAME, OperationAnswer::Challenge(CHALLENGE));
        let execute = OperationRequest::Execute { challenge: CHALLENGE, operation: list() };
        assert_eq!(step, Some(Step::Ask(KEEPER, execute)));
        assert_eq!(operations.answered(NAME, other), None, "a challenge again");
        let answer = OperationAnswer::Revoked { list: 1 };
        assert_eq!(operations.answered(NAME, answer.clone()), Some(Step::Leave(NAME)));
        assert_eq!(end(replied), Ok(answer));
        assert!(operations.next(now).is_some());
        operations.stop();
        assert_eq!(end(waits), Err(OperationError::Stopping));
    }

    #[test]
    fn unanswered_operation_times_out_and_says_if_it_may_have_run() {
        let begin = Instant::now();
        let at = || "keeper".to_owned();
        let (mut operations, replied) = begun(begin);
        assert_eq!(operations.deadline(), Some(begin + FIND_MAX));
        assert_eq!(operations.look(begin + FIND_MAX, false), Some(Step::Leave(NAME)));
        assert_eq!(end(replied), Err(OperationError::NotFound { at: at(), hint: "" }));

        let (mut operations, replied) = begun(begin);
        assert_eq!(operations.look(begin + FIND_MAX, true), None);
        assert_eq!(operations.deadline(), Some(begin + OPERATION_MAX));
        assert_eq!(operations.look(begin + OPERATION_MAX, true), Some(Step::Leave(NAME)));
        assert_eq!(end(replied), Err(OperationError::Silent { at: at() }));

        let (mut operations, replied) = begun(begin);
        operations.answered(NAME, OperationAnswer::Challenge(CHALLENGE)).unwrap();
        assert_eq!(operations.look(begin + FIND_MAX, false), None, "the authority may come back");
        assert_eq!(operations.look(begin + OPERATION_MAX, false), Some(Step::Leave(NAME)));
        assert_eq!(end(replied), Err(OperationError::OutcomeUnknown { at: at() }));
    }

    #[test]
    fn refusals_say_who_refused_and_whether_something_may_have_been_done() {
        let now = Instant::now();
        let at = || "keeper".to_owned();
        let (mut operations, replied) = begun(now);
        operations.denied(NAME, RefusedBy::Owner(RefuseReason::NotPermitted)).unwrap();
        assert_eq!(end(replied), Err(OperationError::NotOperator { at: at() }));
        let (mut operations, replied) = begun(now);
        let by = RefusedBy::Router(RejectReason::Limit);
        operations.denied(NAME, by).unwrap();
        assert_eq!(end(replied), Err(OperationError::Denied { at: at(), by }));
        let (mut operations, replied) = begun(now);
        operations.answered(NAME, OperationAnswer::Challenge(CHALLENGE)).unwrap();
        operations.denied(NAME, by).unwrap();
        assert_eq!(end(replied), Err(OperationError::OutcomeUnknown { at: at() }));
    }

    #[test]
    fn waiting_operations_are_bounded_and_abandoned_ones_are_skipped() {
        let now = Instant::now();
        let (mut operations, replied) = begun(now);
        let waiting: Vec<_> = (0..WAITING_MAX)
            .map(|_| {
                let (operation_request, replied) = operation_request();
                operations.push(now, operation_request);
                replied
            })
            .collect();
        let (one_more, refused) = operation_request();
        operations.push(now, one_more);
        assert_eq!(end(refused), Err(OperationError::Full));
        drop((replied, waiting));
        operations.answered(NAME, OperationAnswer::Revoked { list: 1 });
        assert_eq!(operations.next(now), None);
    }
}
