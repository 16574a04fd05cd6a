//! Actions of a client: [`pursue`] sends a goal, [`ServedAction`] is an action that the client serves.

use std::collections::BTreeMap;
use std::num::NonZeroUsize;
use std::sync::{Arc, Mutex};
use std::time::Duration;

use futures_util::FutureExt as _;
use serde_json::Value as Json;
use sgc_sync::lock;
use tokio::sync::{Notify, oneshot};
use tokio::task::JoinHandle;

use super::calls::ended;
use super::envelope::{Compression, Envelope, Frame};
use super::input;
use super::op::{OpId, told};
use super::outbox::{Level, Outbox};
use super::services::next_number;
use super::topics::fragment_id;
use crate::action::{ActionEvent, ActionReplier, ActionServing, Feedback, Goal, GoalId, GoalStatus};
use crate::content::{Content, Form};
use crate::error::GatewayError;
use crate::quota::ByteReservation;
use crate::session::Session;

/// Time to wait for a goal, practically forever.
const OUTCOME_MAX: Duration = Duration::from_secs(30 * 24 * 3600);
/// Time without a server after which an action's goals are given up. A restarted server no longer knows them, but
/// discovery may be late.
const SERVER_GONE_MAX: Duration = Duration::from_secs(5);
/// Most feedback messages that are sent after the outcome is known.
const FEEDBACK_REST_MAX: usize = 1024;
/// Most unfinished goals at a client that serves. Beyond that the oldest is forgotten.
const GOALS_MAX: usize = 1024;

/// A client's request to send a goal.
#[derive(Clone, Debug)]
pub(super) struct GoalRequest {
    pub(super) id: Option<OpId>,
    pub(super) action: String,
    pub(super) type_name: Option<String>,
    pub(super) has_feedback: bool,
    pub(super) fragment_size: Option<NonZeroUsize>,
    pub(super) compression: Compression,
}

impl GoalRequest {
    fn envelope(&self, op: &str, bytes: usize) -> Envelope {
        Envelope::new(op, self.compression, bytes).id(self.id.as_ref()).text("action", &self.action)
    }

    /// Sends the result of a goal that has no outcome.
    async fn fail(&self, why: &str, outbox: &Outbox) {
        let _ = outbox.say(failed(self.envelope("action_result", why.len()), why)).await;
    }
}

/// Answers a goal that is refused before it is sent.
pub(super) async fn refuse_goal(id: &OpId, action: &str, why: &str, outbox: &Outbox) {
    let refused = Envelope::json("action_result").id(Some(id)).text("action", action);
    let _ = outbox.say(failed(refused, why)).await;
}

/// Finishes the result of a goal that has no outcome.
fn failed(result: Envelope, why: &str) -> Frame {
    let failed = result.text("values", why).value("status", &Json::from(GoalStatus::Unknown as i8));
    failed.value("result", &Json::Bool(false)).finish()
}

/// Sends a goal and reports on it until it ends. `cancel` asks to cancel it; `end` means that the client may not have
/// it any more.
pub(super) async fn pursue(
    session: Arc<Session>,
    wanted: GoalRequest,
    args: (String, ByteReservation),
    (cancel, mut end): (Arc<Notify>, oneshot::Receiver<GatewayError>),
    outbox: Outbox,
) {
    let send = |goal: Content| {
        let (session, wanted) = (&session, &wanted);
        async move { session.send_goal(&wanted.action, wanted.type_name.as_deref(), &goal).await }
    };
    let sending = async {
        // The arguments are dropped once they are sent.
        let args = args;
        input::tolerate_later(&args.0, send).await
    };
    tokio::pin!(sending);
    let sent = tokio::select! {
        biased;
        why = ended(&mut end) => {
            let why = told(&why);
            // A goal accepted in the meantime is known only now.
            let (sent, ()) = tokio::join!(sending, wanted.fail(&why, &outbox));
            if let Ok((goal, _)) = sent {
                give_up(&wanted, &goal, &outbox).await;
            }
            return;
        }
        sent = &mut sending => sent,
    };
    let (goal, feedback) = match sent {
        Ok(sent) => sent,
        Err(error) => return wanted.fail(&told(&error), &outbox).await,
    };
    let followed = tokio::select! {
        biased;
        why = ended(&mut end) => {
            let why = told(&why);
            tokio::join!(give_up(&wanted, &goal, &outbox), wanted.fail(&why, &outbox));
            return;
        }
        followed = follow(&session, &wanted, &goal, feedback, &cancel, &outbox) => followed,
    };
    if let Err(error) = followed {
        wanted.fail(&told(&error), &outbox).await;
    }
}

async fn follow(
    session: &Session,
    wanted: &GoalRequest,
    goal: &Goal,
    mut feedback: Feedback,
    cancel: &Notify,
    outbox: &Outbox,
) -> Result<(), GatewayError> {
    let form = wanted.compression.form();
    let outcome = goal.outcome(form, OUTCOME_MAX);
    let gone = server_gone(session, &wanted.action);
    tokio::pin!(outcome, gone);
    let outcome = loop {
        tokio::select! {
            biased;
            () = cancel.notified() => give_up(wanted, goal, outbox).await,
            outcome = &mut outcome => break outcome?,
            Some(said) = feedback.next(form), if wanted.has_feedback => {
                let telling = tell(wanted, said, outbox);
                tokio::pin!(telling);
                // A client that does not read feedback can still cancel the goal.
                loop {
                    tokio::select! {
                        biased;
                        () = cancel.notified() => give_up(wanted, goal, outbox).await,
                        () = &mut telling => break,
                    }
                }
            }
            () = &mut gone => return Err(GatewayError::NoServer { name: wanted.action.clone() }),
        }
    };
    // Earlier feedback comes before the result.
    for _ in 0..FEEDBACK_REST_MAX {
        let Some(Some(said)) = feedback.next(form).now_or_never().filter(|_| wanted.has_feedback) else {
            break;
        };
        tell(wanted, said, outbox).await;
    }
    let result = wanted
        .envelope("action_result", outcome.result.len())
        .content("values", &outcome.result)
        .value("status", &Json::from(outcome.status as i8))
        .value("result", &Json::Bool(true));
    outbox.say_reply(result.finish_in_pieces(wanted.fragment_size, fragment_id)).await
}

async fn give_up(wanted: &GoalRequest, goal: &Goal, outbox: &Outbox) {
    if let Err(error) = goal.cancel().await {
        // Nothing waits here, because the client may not read.
        outbox.try_status(Level::Error, &told(&format!("cancel_action_goal: {error}")), wanted.id.as_ref());
    }
}

async fn tell(wanted: &GoalRequest, said: Result<bytes::Bytes, GatewayError>, outbox: &Outbox) {
    match said {
        Ok(values) => {
            let said = wanted.envelope("action_feedback", values.len()).content("values", &values);
            let said = said.finish_in_pieces(wanted.fragment_size, fragment_id);
            if let Err(error) = outbox.say_reply(said).await {
                let why = format!("feedback of {} is left out: {error}", wanted.action);
                outbox.try_status(Level::Error, &told(&why), wanted.id.as_ref());
            }
        }
        Err(error) => outbox.try_status(Level::Error, &error.to_string(), wanted.id.as_ref()),
    }
}

/// Waits until an action has had no server for a while.
async fn server_gone(session: &Session, action: &str) {
    let mut changes = session.hub().graph_changes();
    let is_served = || session.hub().graph().actions.get(action).is_some_and(|info| !info.servers.is_empty());
    loop {
        if !is_served() {
            tokio::time::sleep(SERVER_GONE_MAX).await;
            if !is_served() {
                return;
            }
        }
        if changes.changed().await.is_err() {
            return;
        }
    }
}

/// The goals that were forwarded to a client, by number.
type Goals = BTreeMap<u64, GoalId>;

/// An action that a client serves, until dropped.
#[derive(Debug)]
pub(super) struct ServedAction {
    replier: ActionReplier,
    goals: Arc<Mutex<Goals>>,
    prefix: Arc<str>,
    task: JoinHandle<()>,
}

impl Drop for ServedAction {
    fn drop(&mut self) {
        self.task.abort();
    }
}

impl ServedAction {
    pub(super) fn new(serving: ActionServing, type_name: String, outbox: Outbox) -> Self {
        let replier = serving.replier();
        let goals = Arc::default();
        let prefix: Arc<str> = format!("action_goal:{}:", serving.action()).into();
        let told =
            GoalForwarder { type_name, goals: Arc::clone(&goals), prefix: Arc::clone(&prefix), outbox };
        let task = tokio::spawn(told.pass_on(serving));
        Self { replier, goals, prefix, task }
    }

    pub(super) fn replier(&self) -> &ActionReplier {
        &self.replier
    }

    fn number(&self, id: Option<&OpId>) -> Option<u64> {
        let Some(OpId::Text(id)) = id else { return None };
        id.strip_prefix(&*self.prefix)?.parse().ok()
    }

    /// Returns the goal with an id.
    pub(super) fn goal(&self, id: Option<&OpId>) -> Option<GoalId> {
        lock(&self.goals).get(&self.number(id)?).copied()
    }

    /// Removes a goal that has ended.
    pub(super) fn forget(&self, id: Option<&OpId>) {
        if let Some(number) = self.number(id) {
            lock(&self.goals).remove(&number);
        }
    }
}

/// The task that forwards goals to a client.
struct GoalForwarder {
    type_name: String,
    goals: Arc<Mutex<Goals>>,
    prefix: Arc<str>,
    outbox: Outbox,
}

impl GoalForwarder {
    async fn pass_on(self, mut serving: ActionServing) {
        let replier = serving.replier();
        while let Some(event) = serving.next().await {
            let _turn = self.outbox.turn().await;
            let frame = match event {
                ActionEvent::Goal { id, goal } => {
                    let Ok(args) = serving.write(&goal, Form::Json) else { continue };
                    // Clients of this protocol accept every goal.
                    if replier.answer(&id, true).await.is_err() {
                        continue;
                    }
                    let number = self.remember(id);
                    Envelope::json("send_action_goal")
                        .text("id", &format!("{}{number}", self.prefix))
                        .text("action", serving.action())
                        .text("action_type", &self.type_name)
                        .content("args", &args)
                        .value("feedback", &Json::Bool(true))
                }
                ActionEvent::Cancel { id } => {
                    let Some(number) = self.number_of(&id) else { continue };
                    Envelope::json("cancel_action_goal")
                        .text("id", &format!("{}{number}", self.prefix))
                        .text("action", serving.action())
                }
            };
            if self.outbox.say(frame.finish()).await.is_err() {
                return;
            }
        }
    }

    fn remember(&self, id: GoalId) -> u64 {
        let mut goals = lock(&self.goals);
        let number = next_number();
        goals.insert(number, id);
        if goals.len() > GOALS_MAX {
            goals.pop_first();
        }
        number
    }

    fn number_of(&self, id: &GoalId) -> Option<u64> {
        lock(&self.goals).iter().find(|(_, known)| *known == id).map(|(number, _)| *number)
    }
}
