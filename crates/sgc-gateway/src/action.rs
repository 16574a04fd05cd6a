//! Actions (ROS 2 design article "Actions"): [`Goal`] is a goal that a client sent, [`ActionServing`] an action that
//! a client serves.
//!
//! An action consists of three services and two topics. The layers below treat these like any others.

use std::collections::BTreeMap;
use std::fmt;
use std::sync::{Arc, Mutex};
use std::time::Duration;

use aws_lc_rs::rand;
use bytes::Bytes;
use sgc_cdr::{Layout, Value};
use sgc_ros::RequestId;
use sgc_sync::lock;
use sgc_wire::{Durability, History, Qos};
use tokio::sync::mpsc;
use tokio::time::Instant;

use crate::access::Right;
use crate::content::{Content, Form, serialise, write};
use crate::definitions::InterfaceType;
use crate::error::GatewayError;
use crate::feed::Subscription;
use crate::hub::HubState;
use crate::offload::offload_if_long;
use crate::publisher::{Account, Publication};
use crate::quota::{Charge, PendingBytes, Quota, Resource};
use crate::service::{Caller, Replier, Request, Serving};
use crate::session::{Session, Subscribe};

/// Time within which a server must answer a goal or a cancel request.
const ANSWER_MAX: Duration = Duration::from_secs(10);
/// Feedback messages that may be queued for a client.
const FEEDBACK_DEPTH: usize = 100;
/// Events that may be queued for a client that serves an action.
const EVENTS_MAX: usize = 256;
/// Most goals of an action. The goal that ended first gives way.
const GOALS_MAX: usize = 1024;
/// Cost of a kept result in bytes, beside its payload.
const RESULT_COST_BYTES: usize = 256;
/// Time for which results are kept (the default of `rcl_action`).
const RESULT_KEPT: Duration = Duration::from_secs(900);
/// Time for which an action still answers requests for results after its client stopped serving.
const FAREWELL: Duration = Duration::from_secs(2);
/// Position of the goal id in a feedback message: behind the encapsulation header.
const GOAL_ID_AT: std::ops::Range<usize> = 4..20;

/// The id of a goal (`unique_identifier_msgs/msg/UUID`).
pub type GoalId = [u8; 16];

/// The status of a goal (`action_msgs/msg/GoalStatus`).
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
#[repr(i8)]
pub enum GoalStatus {
    /// The goal is not known.
    Unknown = 0,
    /// The server accepted the goal.
    Accepted = 1,
    /// The server executes the goal.
    Executing = 2,
    /// A client asked to cancel the goal.
    Canceling = 3,
    /// The goal succeeded.
    Succeeded = 4,
    /// The goal was cancelled on request.
    Canceled = 5,
    /// The server aborted the goal.
    Aborted = 6,
}

impl GoalStatus {
    /// Returns the status with this number, or [`Self::Unknown`].
    pub fn from_number(number: i64) -> Self {
        match number {
            1 => Self::Accepted,
            2 => Self::Executing,
            3 => Self::Canceling,
            4 => Self::Succeeded,
            5 => Self::Canceled,
            6 => Self::Aborted,
            _ => Self::Unknown,
        }
    }

    /// Returns `true` if the goal has ended.
    pub fn is_end(self) -> bool {
        self >= Self::Succeeded
    }
}

/// The answer to a cancel request (`action_msgs/srv/CancelGoal`).
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[repr(i8)]
pub enum CancelAnswer {
    /// The goal is being cancelled.
    Taken = 0,
    /// The request was rejected and the goal continues.
    Rejected = 1,
    /// The goal is not known.
    UnknownGoal = 2,
    /// The goal has ended.
    Ended = 3,
}

/// The outcome of a goal.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Outcome {
    /// The final status.
    pub status: GoalStatus,
    /// The result in the requested form.
    pub result: Bytes,
}

/// A goal that a client sent and a server accepted.
#[derive(Clone)]
pub struct Goal {
    shared: Arc<HubState>,
    action: Arc<str>,
    id: GoalId,
    result: Arc<Layout>,
    get_result: Arc<Caller>,
    quota: Quota,
    _charge: Arc<Charge>,
}

/// The feedback of a goal.
#[derive(Debug)]
pub struct Feedback {
    id: GoalId,
    subscription: Subscription,
    layout: Arc<Layout>,
}

impl Session {
    /// Returns the type of an action: the given one if it agrees with the network, else the one on the network.
    pub fn action_type(&self, action: &str, said: Option<&str>) -> Result<String, GatewayError> {
        let graph = self.hub().graph();
        let actual = graph.actions.get(action).map(|info| info.type_name.clone());
        match said.filter(|said| !said.is_empty()) {
            None => actual.ok_or_else(|| GatewayError::TypeUnknown { name: action.to_owned() }),
            Some(said) => {
                let wanted = InterfaceType::Action.full_name(said)?;
                match actual {
                    Some(actual) if actual != wanted => {
                        Err(GatewayError::OtherType { name: action.to_owned(), actual, wanted })
                    }
                    _ => Ok(wanted),
                }
            }
        }
    }

    /// Sends a goal and waits until a server accepts it. The subscription to feedback exists before that.
    pub async fn send_goal(
        &self,
        action: &str,
        type_name: Option<&str>,
        goal: &Content,
    ) -> Result<(Goal, Feedback), GatewayError> {
        self.check(Right::Call, action)?;
        let of = self.action_type(action, type_name)?;
        let charge = self.quota().take(Resource::Calls, self.limits())?;
        let quota = self.quota().clone();
        let shared = &self.hub().shared;
        let (name, service) = (of.clone(), action.to_owned());
        let (layouts, send, get_result) = shared
            .run(move |shared| {
                let layouts = Layouts::find(shared, &name)?;
                let caller = |part: &str, of: &str| shared.caller(&format!("{service}/_action/{part}"), of);
                let send = caller("send_goal", &format!("{name}_SendGoal"))?;
                Ok((layouts, send, caller("get_result", &format!("{name}_GetResult"))?))
            })
            .await?;
        let wanted = Subscribe {
            topic: format!("{action}/_action/feedback"),
            type_name: Some(format!("{of}_FeedbackMessage")),
            depth: FEEDBACK_DEPTH,
            ..Subscribe::default()
        };
        let subscription = self.subscribe_checked(wanted).await?;
        let mut id = [0; 16];
        rand::fill(&mut id).map_err(|_| GatewayError::Stopping)?;
        // The id is a random UUID (RFC 9562, 5.4).
        id[6] = id[6] & 0x0f | 0x40;
        id[8] = id[8] & 0x3f | 0x80;
        let goal = goal.value(&layouts.goal)?;
        let request = record([("goal_id", uuid(&id)), ("goal", goal)]);
        let payload = write(&send.halves.request, &request, Form::Cdr)?;
        let reply = send.call(payload, ANSWER_MAX, &quota).await?;
        let reply = send.halves.reply.decode(&reply).map_err(GatewayError::Decode)?;
        if reply.at("accepted") != Some(Value::Bool(true)) {
            return Err(GatewayError::GoalRejected { name: action.to_owned() });
        }
        let feedback = Feedback { id, subscription, layout: layouts.feedback };
        let goal = Goal {
            shared: Arc::clone(shared),
            action: action.into(),
            id,
            result: layouts.result,
            get_result,
            quota,
            _charge: Arc::new(charge),
        };
        Ok((goal, feedback))
    }

    /// Serves an action.
    pub async fn serve_action(
        &self,
        action: &str,
        type_name: Option<&str>,
    ) -> Result<ActionServing, GatewayError> {
        self.check(Right::Serve, action)?;
        let of = self.action_type(action, type_name)?;
        let charge = self.quota().take(Resource::Servings, self.limits())?;
        let quota = (self.quota().clone(), charge);
        ActionServing::new(&self.hub().shared, action, &of, quota, self.limits().waiting_bytes_max).await
    }
}

impl Goal {
    /// Returns the id of the goal.
    pub fn id(&self) -> &GoalId {
        &self.id
    }

    /// Waits for the end of the goal, at most for `max`.
    pub async fn outcome(&self, form: Form, max: Duration) -> Result<Outcome, GatewayError> {
        let request = record([("goal_id", uuid(&self.id))]);
        let payload = write(&self.get_result.halves.request, &request, Form::Cdr)?;
        let reply = self.get_result.call(payload, max, &self.quota).await?;
        offload_if_long(reply.len(), || {
            let reply = self.get_result.halves.reply.decode(&reply).map_err(GatewayError::Decode)?;
            let status = GoalStatus::from_number(integer(&reply, "status"));
            let result = reply.at("result").unwrap_or(Value::Record(Vec::new()));
            Ok(Outcome { status, result: write(&self.result, &result, form)? })
        })
    }

    /// Asks the server to cancel the goal.
    pub async fn cancel(&self) -> Result<CancelAnswer, GatewayError> {
        let service = format!("{}/_action/cancel_goal", self.action);
        let caller =
            self.shared.run(move |shared| shared.caller(&service, "action_msgs/srv/CancelGoal")).await?;
        let info = record([("goal_id", uuid(&self.id)), ("stamp", stamp(0))]);
        let request = record([("goal_info", info)]);
        let payload = write(&caller.halves.request, &request, Form::Cdr)?;
        let reply = caller.call(payload, ANSWER_MAX, &self.quota).await?;
        let reply = caller.halves.reply.decode(&reply).map_err(GatewayError::Decode)?;
        Ok(match integer(&reply, "return_code") {
            0 => CancelAnswer::Taken,
            2 => CancelAnswer::UnknownGoal,
            3 => CancelAnswer::Ended,
            _ => CancelAnswer::Rejected,
        })
    }
}

impl fmt::Debug for Goal {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_struct("Goal").field("action", &self.action).field("id", &self.id).finish_non_exhaustive()
    }
}

impl Feedback {
    /// Waits for the next feedback of this goal. Returns `None` once the gateway stops.
    pub async fn next(&mut self, form: Form) -> Option<Result<Bytes, GatewayError>> {
        loop {
            let delivery = self.subscription.next().await?;
            let payload = &delivery.message.payload;
            // Feedback of other goals is skipped without decoding, except in encodings that put a size before the id.
            let is_delimited = payload.get(1).is_some_and(|id| *id >= 8);
            if !is_delimited && payload.get(GOAL_ID_AT) != Some(&self.id) {
                continue;
            }
            let read = || self.read(payload, form);
            if let Some(said) = offload_if_long(payload.len(), read) {
                return Some(said);
            }
        }
    }

    /// Returns the feedback in a message, or `None` if it belongs to another goal.
    fn read(&self, payload: &Bytes, form: Form) -> Option<Result<Bytes, GatewayError>> {
        let said = match self.subscription.layout().decode(payload) {
            Ok(said) => said,
            Err(error) => return Some(Err(GatewayError::Decode(error))),
        };
        if goal_id(&said, "goal_id") != Some(self.id) {
            return None;
        }
        let feedback = said.at("feedback").unwrap_or(Value::Record(Vec::new()));
        Some(write(&self.layout, &feedback, form))
    }
}

/// The layouts of an action's goals, results and feedback.
#[derive(Clone, Debug)]
struct Layouts {
    goal: Arc<Layout>,
    result: Arc<Layout>,
    feedback: Arc<Layout>,
}

impl Layouts {
    fn find(shared: &HubState, of: &str) -> Result<Self, GatewayError> {
        let layout = |part: &str| shared.network.types.layout(&format!("{of}_{part}"), None);
        Ok(Self { goal: layout("Goal")?, result: layout("Result")?, feedback: layout("Feedback")? })
    }
}

/// An event for a client that serves an action.
#[derive(Clone, Debug, PartialEq)]
pub enum ActionEvent {
    /// A goal to accept or reject.
    Goal {
        /// The id of the goal.
        id: GoalId,
        /// The goal itself.
        goal: Value,
    },
    /// A request to cancel an accepted goal, which the client then ends.
    Cancel {
        /// The id of the goal.
        id: GoalId,
    },
}

/// An action that a client serves. Dropping it aborts accepted goals; clients that ask for their results within two
/// seconds learn of that.
#[derive(Debug)]
pub struct ActionServing {
    events: mpsc::Receiver<ActionEvent>,
    server: Arc<ActionServer>,
}

/// The handle that answers goals of a served action.
#[derive(Clone, Debug)]
pub struct ActionReplier(Arc<ActionServer>);

#[derive(Debug)]
struct ActionServer {
    action: String,
    layouts: Layouts,
    goals: Mutex<Goals>,
    /// The bytes of kept results.
    kept: Arc<PendingBytes>,
    send_goal: Replier,
    get_result: Replier,
    cancel_goal: Replier,
    feedback: Publication,
    status: Publication,
    telling: tokio::sync::Mutex<()>,
}

type Goals = BTreeMap<GoalId, GoalState>;

#[derive(Debug)]
struct GoalState {
    status: GoalStatus,
    /// The goal request that has not been answered yet.
    asked: Option<RequestId>,
    taken_ns: i64,
    result: Option<KeptResult>,
    /// Requests that wait for the result.
    waiting: Vec<RequestId>,
    ended: Option<Instant>,
}

/// The result of a goal, kept for later requests. It counts as queued bytes of the client that serves the action.
#[derive(Debug)]
struct KeptResult {
    /// The serialised result.
    payload: Bytes,
    waiting: Arc<PendingBytes>,
}

impl Drop for KeptResult {
    fn drop(&mut self) {
        self.waiting.sub(self.payload.len() + RESULT_COST_BYTES);
    }
}

impl ActionServing {
    async fn new(
        shared: &Arc<HubState>,
        action: &str,
        of: &str,
        (quota, charge): (Quota, Charge),
        results_bytes_max: usize,
    ) -> Result<Self, GatewayError> {
        let name = of.to_owned();
        let layouts = shared.run(move |shared| Layouts::find(shared, &name)).await?;
        let part = |part: &str| format!("{action}/_action/{part}");
        let goals =
            Serving::new(&shared.network, part("send_goal"), format!("{of}_SendGoal"), Some(charge)).await?;
        let results =
            Serving::new(&shared.network, part("get_result"), format!("{of}_GetResult"), None).await?;
        let cancel_type = "action_msgs/srv/CancelGoal".to_owned();
        let cancels = Serving::new(&shared.network, part("cancel_goal"), cancel_type, None).await?;
        let feedback_type = format!("{of}_FeedbackMessage");
        let account = || Account { quota: quota.clone(), charge: None, kept: None };
        let feedback =
            Publication::new(&shared.network, part("feedback"), feedback_type, Qos::default(), account())
                .await?;
        let kept = Arc::new(PendingBytes::new(results_bytes_max, quota.clone()));
        let latched =
            Qos { durability: Durability::TransientLocal, history: History::KeepLast(1), ..Qos::default() };
        let status_type = "action_msgs/msg/GoalStatusArray".to_owned();
        let status =
            Publication::new(&shared.network, part("status"), status_type, latched, account()).await?;
        let server = Arc::new(ActionServer {
            action: action.to_owned(),
            layouts,
            goals: Mutex::default(),
            kept,
            send_goal: goals.replier(),
            get_result: results.replier(),
            cancel_goal: cancels.replier(),
            feedback,
            status,
            telling: tokio::sync::Mutex::default(),
        });
        let (send, events) = mpsc::channel(EVENTS_MAX);
        tokio::spawn(serve(Arc::clone(&server), [goals, results, cancels], send));
        Ok(Self { events, server })
    }

    /// Returns the name of the action.
    pub fn action(&self) -> &str {
        &self.server.action
    }

    /// Waits for the next event. Returns `None` once the gateway stops.
    pub async fn next(&mut self) -> Option<ActionEvent> {
        self.events.recv().await
    }

    /// Converts a goal to a form.
    pub fn write(&self, goal: &Value, form: Form) -> Result<Bytes, GatewayError> {
        write(&self.server.layouts.goal, goal, form)
    }

    /// Returns the handle that answers goals.
    pub fn replier(&self) -> ActionReplier {
        ActionReplier(Arc::clone(&self.server))
    }
}

impl ActionReplier {
    /// Accepts a goal, which is then executing, or rejects it.
    pub async fn answer(&self, id: &GoalId, is_taken: bool) -> Result<(), GatewayError> {
        let server = &self.0;
        let (asked, taken_ns) = {
            let mut goals = lock(&server.goals);
            let goal = goals.get_mut(id).ok_or_else(|| server.no_goal())?;
            let asked = goal.asked.take().ok_or_else(|| server.no_goal())?;
            goal.status = GoalStatus::Executing;
            let taken_ns = goal.taken_ns;
            if !is_taken {
                goals.remove(id);
            }
            (asked, taken_ns)
        };
        let reply = record([("accepted", Value::Bool(is_taken)), ("stamp", stamp(taken_ns))]);
        server.send_goal.reply_value(asked, &reply).await?;
        if is_taken { server.publish_status().await } else { Ok(()) }
    }

    /// Publishes feedback of an executing goal.
    pub async fn feedback(&self, id: &GoalId, content: &Content) -> Result<(), GatewayError> {
        let server = &self.0;
        if lock(&server.goals).get(id).is_none_or(|goal| goal.status.is_end()) {
            return Err(server.no_goal());
        }
        let feedback = content.value(&server.layouts.feedback)?;
        server.feedback.publish_value(&record([("goal_id", uuid(id)), ("feedback", feedback)])).await
    }

    /// Ends a goal.
    pub async fn finish(
        &self,
        id: &GoalId,
        status: GoalStatus,
        content: &Content,
    ) -> Result<(), GatewayError> {
        let server = &self.0;
        let result = content.value(&server.layouts.result)?;
        server.finish(id, status, result).await
    }
}

impl ActionServer {
    fn no_goal(&self) -> GatewayError {
        GatewayError::NotThere { name: self.action.clone(), what: "asked for such a goal" }
    }

    fn no_result(&self) -> Value {
        self.layouts.result.from_json(b"{}").unwrap_or(Value::Record(Vec::new()))
    }

    async fn finish(&self, id: &GoalId, status: GoalStatus, result: Value) -> Result<(), GatewayError> {
        let status = if status.is_end() { status } else { GoalStatus::Aborted };
        let payload = serialise(&self.layouts.result, &result)?;
        let waiting = {
            let mut goals = lock(&self.goals);
            let goal = goals.get_mut(id).filter(|goal| !goal.status.is_end() && goal.asked.is_none());
            let goal = goal.ok_or_else(|| self.no_goal())?;
            goal.status = status;
            goal.ended = Some(Instant::now());
            let waiting = std::mem::take(&mut goal.waiting);
            let kept = self.keep(&mut goals, id, payload);
            if let Some(goal) = goals.get_mut(id) {
                goal.result = kept;
            }
            waiting
        };
        // A client that has the result must find the status that matches it.
        let published = self.publish_status().await;
        for asked in waiting {
            self.reply_result(asked, status, result.clone()).await;
        }
        published
    }

    /// Keeps the result of a goal if there is room. Results of goals that ended earlier give way.
    fn keep(&self, goals: &mut Goals, id: &GoalId, payload: Bytes) -> Option<KeptResult> {
        let bytes = payload.len() + RESULT_COST_BYTES;
        while !self.kept.has_room(bytes) {
            let ended = |(other, goal): (&GoalId, &GoalState)| {
                Some((goal.ended?, *other)).filter(|(_, other)| other != id && goal.result.is_some())
            };
            let (_, oldest) = goals.iter().filter_map(ended).min()?;
            goals.remove(&oldest);
        }
        self.kept.add(bytes);
        Some(KeptResult { payload, waiting: Arc::clone(&self.kept) })
    }

    async fn reply_result(&self, asked: RequestId, status: GoalStatus, result: Value) {
        let reply = record([("status", Value::Int(status as i64)), ("result", result)]);
        if let Err(error) = self.get_result.reply_value(asked, &reply).await {
            tracing::debug!(%error, "the result of a goal could not be said");
        }
    }

    async fn abort_all(&self) {
        let open: Vec<GoalId> =
            lock(&self.goals).iter().filter(|(_, goal)| !goal.status.is_end()).map(|(id, _)| *id).collect();
        for id in open {
            let _ = self.finish(&id, GoalStatus::Aborted, self.no_result()).await;
        }
    }

    async fn publish_status(&self) -> Result<(), GatewayError> {
        // Publications take turns, so that the last one has the current state.
        let _turn = self.telling.lock().await;
        let list = lock(&self.goals)
            .iter()
            .filter(|(_, goal)| goal.asked.is_none())
            .map(|(id, goal)| {
                let info = record([("goal_id", uuid(id)), ("stamp", stamp(goal.taken_ns))]);
                record([("goal_info", info), ("status", Value::Int(goal.status as i64))])
            })
            .collect();
        self.status.publish_value(&record([("status_list", Value::List(list))])).await
    }

    /// Makes room for one more goal. Returns `false` if all goals are active.
    fn has_room(goals: &mut Goals) -> bool {
        let is_old = |goal: &GoalState| goal.ended.is_some_and(|ended| ended.elapsed() >= RESULT_KEPT);
        goals.retain(|_, goal| !is_old(goal));
        if goals.len() >= GOALS_MAX
            && let Some((_, oldest)) = goals.iter().filter_map(|(id, goal)| Some((goal.ended?, *id))).min()
        {
            goals.remove(&oldest);
        }
        goals.len() < GOALS_MAX
    }

    async fn take_goal(&self, serving: &Serving, request: Request, events: &mpsc::Sender<ActionEvent>) {
        let said = serving.request_layout().decode(&request.payload);
        let found = said.ok().and_then(|said| Some((goal_id(&said, "goal_id")?, said.at("goal")?)));
        let is_new = found.as_ref().is_some_and(|(id, _)| {
            let mut goals = lock(&self.goals);
            let is_new = !goals.contains_key(id) && Self::has_room(&mut goals);
            if is_new {
                let taken_ns = now_ns();
                let (asked, status) = (Some(request.id), GoalStatus::Unknown);
                let (result, waiting, ended) = (None, Vec::new(), None);
                goals.insert(*id, GoalState { status, asked, taken_ns, result, waiting, ended });
            }
            is_new
        });
        match found {
            Some((id, goal)) if is_new => {
                if events.send(ActionEvent::Goal { id, goal }).await.is_err() {
                    lock(&self.goals).remove(&id);
                    self.reject(request.id).await;
                }
            }
            _ => self.reject(request.id).await,
        }
    }

    async fn reject(&self, asked: RequestId) {
        let reply = record([("accepted", Value::Bool(false)), ("stamp", stamp(0))]);
        let _ = self.send_goal.reply_value(asked, &reply).await;
    }

    async fn take_result(&self, serving: &Serving, request: Request) {
        let said = serving.request_layout().decode(&request.payload);
        let id = said.ok().and_then(|said| goal_id(&said, "goal_id"));
        let ended = {
            let mut goals = lock(&self.goals);
            match id.and_then(|id| goals.get_mut(&id)) {
                None => Some((GoalStatus::Unknown, self.no_result())),
                Some(goal) if goal.ended.is_some() => {
                    let kept = goal.result.as_ref();
                    let result = kept.and_then(|kept| self.layouts.result.decode(&kept.payload).ok());
                    // A result without room is forgotten together with its goal.
                    let forgotten = || (GoalStatus::Unknown, self.no_result());
                    Some(result.map_or_else(forgotten, |result| (goal.status, result)))
                }
                Some(goal) => {
                    if goal.waiting.len() < EVENTS_MAX {
                        goal.waiting.push(request.id);
                    }
                    None
                }
            }
        };
        if let Some((status, result)) = ended {
            self.reply_result(request.id, status, result).await;
        }
    }

    async fn take_cancel(&self, serving: &Serving, request: Request, events: &mpsc::Sender<ActionEvent>) {
        let said = serving.request_layout().decode(&request.payload).ok();
        let id = said.as_ref().and_then(|said| goal_id(said, "goal_info.goal_id")).unwrap_or_default();
        let until = said.as_ref().map_or(0, |said| {
            integer(said, "goal_info.stamp.sec") * 1_000_000_000 + integer(said, "goal_info.stamp.nanosec")
        });
        let (answer, canceling) = {
            let mut goals = lock(&self.goals);
            let is_all = id == GoalId::default();
            let mut chosen = Vec::new();
            for (goal, served) in goals.iter_mut() {
                // An empty request means all goals; a time alone means all goals until then; an id means one goal;
                // both mean the goal and all until then.
                let is_meant = if is_all && until == 0 {
                    true
                } else {
                    *goal == id || (until > 0 && served.taken_ns <= until)
                };
                let is_active = served.asked.is_none() && !served.status.is_end();
                if is_meant && is_active {
                    served.status = GoalStatus::Canceling;
                    chosen.push((*goal, served.taken_ns));
                }
            }
            let answer = match (chosen.is_empty(), goals.get(&id)) {
                (false, _) => CancelAnswer::Taken,
                (true, _) if is_all => CancelAnswer::Taken,
                (true, Some(_)) => CancelAnswer::Ended,
                (true, None) => CancelAnswer::UnknownGoal,
            };
            (answer, chosen)
        };
        let list = canceling.iter().map(|(id, ns)| record([("goal_id", uuid(id)), ("stamp", stamp(*ns))]));
        let reply = record([
            ("return_code", Value::Int(answer as i64)),
            ("goals_canceling", Value::List(list.collect())),
        ]);
        let _ = self.cancel_goal.reply_value(request.id, &reply).await;
        for (id, _) in canceling {
            let _ = events.send(ActionEvent::Cancel { id }).await;
        }
        let _ = self.publish_status().await;
    }
}

/// Handles the three services of an action until the client stops serving, and answers requests for results a little
/// longer.
async fn serve(
    server: Arc<ActionServer>,
    [mut goals, mut results, mut cancels]: [Serving; 3],
    events: mpsc::Sender<ActionEvent>,
) {
    loop {
        tokio::select! {
            Some(request) = goals.next() => server.take_goal(&goals, request, &events).await,
            Some(request) = results.next() => server.take_result(&results, request).await,
            Some(request) = cancels.next() => server.take_cancel(&cancels, request, &events).await,
            () = events.closed() => break,
            else => return,
        }
    }
    server.abort_all().await;
    let end = Instant::now() + FAREWELL;
    loop {
        tokio::select! {
            Some(request) = results.next() => server.take_result(&results, request).await,
            () = tokio::time::sleep_until(end) => return,
            else => return,
        }
    }
}

fn record<const N: usize>(members: [(&str, Value); N]) -> Value {
    Value::Record(members.into_iter().map(|(name, value)| (Arc::from(name), value)).collect())
}

fn uuid(id: &GoalId) -> Value {
    record([("uuid", Value::Octets(Bytes::copy_from_slice(id)))])
}

/// Returns a `builtin_interfaces/msg/Time`.
fn stamp(ns: i64) -> Value {
    let (sec, nanosec) = (ns.div_euclid(1_000_000_000), ns.rem_euclid(1_000_000_000));
    record([("sec", Value::Int(sec)), ("nanosec", Value::Uint(nanosec.unsigned_abs()))])
}

fn goal_id(value: &Value, path: &str) -> Option<GoalId> {
    match value.at(&format!("{path}.uuid")) {
        Some(Value::Octets(id)) => id.as_ref().try_into().ok(),
        _ => None,
    }
}

fn integer(value: &Value, path: &str) -> i64 {
    match value.at(path) {
        Some(Value::Int(number)) => number,
        Some(Value::Uint(number)) => i64::try_from(number).unwrap_or(i64::MAX),
        _ => 0,
    }
}

fn now_ns() -> i64 {
    let since = std::time::SystemTime::now().duration_since(std::time::UNIX_EPOCH);
    since.map_or(0, |since| since.as_nanos().try_into().unwrap_or(i64::MAX))
}
