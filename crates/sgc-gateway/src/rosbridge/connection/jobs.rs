//! [`Jobs`]: the calls and goals of a client that are in progress.

use std::collections::BTreeMap;
use std::sync::Arc;
use std::time::Duration;

use tokio::sync::{Notify, oneshot};
use tokio::task::JoinSet;

use super::context::Context;
use crate::access::Right;
use crate::error::GatewayError;
use crate::rosbridge::actions::{GoalRequest, pursue};
use crate::rosbridge::calls::{Call, End, answer};
use crate::rosbridge::input;
use crate::rosbridge::op::{CallService, OpId, Refusal, SendActionGoal};
use crate::session::Session;

/// Longest wait for a reply, whatever the client asks for.
const TIMEOUT_MAX: Duration = Duration::from_secs(3600);

/// A call or goal in progress.
struct PendingJob {
    /// The name of the service or action.
    name: String,
    end: End,
}

/// The calls and goals of a client that are in progress. They are tasks, and are aborted when dropped.
#[derive(Default)]
pub(super) struct Jobs {
    /// Each task returns its number and the id of its goal.
    tasks: JoinSet<(u64, Option<OpId>)>,
    pending: BTreeMap<u64, PendingJob>,
    /// The goals with an id, which a notification cancels.
    goals: BTreeMap<OpId, Arc<Notify>>,
    next_number: u64,
}

impl Jobs {
    /// Forgets the jobs that have ended.
    pub(super) fn reap(&mut self) {
        while let Some(ended) = self.tasks.try_join_next() {
            let Ok((number, goal)) = ended else { continue };
            self.pending.remove(&number);
            if let Some(id) = goal {
                self.goals.remove(&id);
            }
        }
    }

    /// Returns `true` if a goal of that id is in progress.
    pub(super) fn has_goal(&self, id: &OpId) -> bool {
        self.goals.contains_key(id)
    }

    fn check_count(&self, session: &Session) -> Result<(), GatewayError> {
        session.check_count("calls and goals under way", self.tasks.len(), session.limits().calls_max)
    }

    /// Registers a call or goal. Returns its number and the receiver that tells it to end.
    fn begin(&mut self, name: &str) -> (u64, oneshot::Receiver<GatewayError>) {
        self.next_number += 1;
        let (end, ended) = oneshot::channel();
        self.pending.insert(self.next_number, PendingJob { name: name.to_owned(), end });
        (self.next_number, ended)
    }

    /// Begins a call, which answers the client itself.
    pub(super) fn call(
        &mut self,
        context: &Context,
        id: Option<OpId>,
        op: &CallService<'_>,
    ) -> Result<(), Refusal> {
        let Context { session, options, outbox } = context;
        self.check_count(session)?;
        let room = session.hold_arguments(op.args.map_or(0, str::len))?;
        let call = Call {
            id,
            service: op.service.to_string(),
            type_name: op.type_name.as_deref().map(str::to_owned),
            args: op.args.map(str::to_owned),
            max: op.timeout.map_or(options.call_max, |said| said.min(TIMEOUT_MAX)),
            fragment_size: op.fragment_size,
            compression: op.compression,
        };
        let (session, options, outbox) = (Arc::clone(session), Arc::clone(options), outbox.clone());
        let (number, end) = self.begin(&call.service);
        self.tasks.spawn(async move {
            answer(session, options, call, end, outbox).await;
            drop(room);
            (number, None)
        });
        Ok(())
    }

    /// Begins a goal, which sends its result to the client itself.
    pub(super) fn send_goal(
        &mut self,
        context: &Context,
        id: Option<OpId>,
        op: &SendActionGoal<'_>,
    ) -> Result<(), Refusal> {
        let Context { session, outbox, .. } = context;
        if id.as_ref().is_some_and(|id| self.has_goal(id)) {
            return Err(Refusal::rule("a goal of that id is under way"));
        }
        self.check_count(session)?;
        let room = session.hold_arguments(op.args.map_or(0, str::len))?;
        session.check(Right::Call, &op.action)?;
        let layout = || {
            let of = session.action_type(&op.action, op.type_name.as_deref())?;
            session.hub().types().layout(&format!("{of}_Goal"), None)
        };
        let args = input::arguments(op.args, layout)?;
        let request = GoalRequest {
            id: id.clone(),
            action: op.action.to_string(),
            type_name: op.type_name.as_deref().map(str::to_owned),
            has_feedback: op.has_feedback,
            fragment_size: op.fragment_size,
            compression: op.compression,
        };
        let cancel: Arc<Notify> = Arc::default();
        if let Some(id) = &id {
            self.goals.insert(id.clone(), Arc::clone(&cancel));
        }
        let (session, outbox) = (Arc::clone(session), outbox.clone());
        let (number, end) = self.begin(&request.action);
        self.tasks.spawn(async move {
            pursue(session, request, (args, room), (cancel, end), outbox).await;
            (number, id)
        });
        Ok(())
    }

    /// Asks the server of a goal to cancel it.
    pub(super) fn cancel_goal(&self, id: Option<&OpId>) -> Result<(), Refusal> {
        let goal = id.and_then(|id| self.goals.get(id));
        goal.ok_or(Refusal::rule("no goal of that id is under way"))?.notify_one();
        Ok(())
    }

    /// Ends the jobs for whose service or action there is a reason. They report it themselves.
    pub(super) fn end_where(&mut self, reason: impl Fn(&str) -> Option<GatewayError>) {
        let of = |(number, job): (&u64, &PendingJob)| Some((*number, reason(&job.name)?));
        let ended: Vec<_> = self.pending.iter().filter_map(of).collect();
        for (number, why) in ended {
            if let Some(job) = self.pending.remove(&number) {
                // A job that has ended no longer listens.
                let _ = job.end.send(why);
            }
        }
    }
}
