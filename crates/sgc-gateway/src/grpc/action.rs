//! `SendGoal` and `ServeAction`: goals that a client sends, and actions that it serves.

use std::sync::Arc;
use std::time::Duration;

use futures_util::FutureExt as _;
use tonic::{Response, Status, Streaming};

use super::conversation::{Conversation, Responder, begin, first};
use super::fault::Fault;
use super::guest::{Guest, Place, StreamKind};
use super::proto::send_goal_request::{Goal as GoalSaid, Kind as Asked};
use super::proto::send_goal_response as sent;
use super::proto::serve_action_request::{Finish, Kind as Said, Server};
use super::proto::serve_action_response as served;
use super::proto::{self, SendGoalRequest, SendGoalResponse, ServeActionRequest, ServeActionResponse};
use super::qos;
use super::slot::Responses;
use crate::action::{
    ActionEvent, ActionReplier, ActionServing, CancelAnswer, Feedback, Goal, GoalId, GoalStatus,
};
use crate::content::{Content, Form};
use crate::error::GatewayError;

/// Time for which the outcome of a goal is awaited.
const OUTCOME_WAIT_MAX: Duration = Duration::from_secs(30 * 24 * 3600);
/// Most feedback messages that are sent after the goal ended and before its outcome.
const LAST_FEEDBACK_MAX: usize = 64;
/// The required first requests of the streams.
const ORDER_GOAL: Fault = Fault::Order { what: "the goal" };
const ORDER_ACTION: Fault = Fault::Order { what: "the action" };

/// Sends a goal and streams its progress until it ends.
pub(super) async fn send_goal(
    guest: Arc<Guest>,
    mut requests: Streaming<SendGoalRequest>,
) -> Result<Response<Responses<SendGoalResponse>>, Status> {
    let place = guest.take(StreamKind::Goal)?;
    let Some(SendGoalRequest { kind: Some(Asked::Goal(said)) }) = first(&guest, &mut requests).await? else {
        return Err(ORDER_GOAL.into());
    };
    let GoalSaid { action, r#type, encoding, payload } = said;
    let form = qos::form(encoding)?;
    let said = Some(&*r#type).filter(|name| !name.is_empty());
    let content = Content { form, bytes: payload };
    let sent = async {
        let taken = guest.session.send_goal(&action, said, &content).await?;
        Ok((guest.session.action_type(&action, said)?, taken))
    };
    let (type_name, (goal, feedback)) = guest.admitted(sent).await?;
    let taken = sent::Taken { goal_id: goal.id().to_vec().into(), r#type: type_name };
    let taken = SendGoalResponse { kind: Some(sent::Kind::Taken(taken)) };
    Ok(begin(GoalConversation { place, goal, feedback, form }, requests, taken))
}

/// A goal that a server has accepted.
struct GoalConversation {
    place: Place,
    goal: Goal,
    feedback: Feedback,
    form: Form,
}

impl Conversation for GoalConversation {
    type Request = SendGoalRequest;
    type Response = SendGoalResponse;

    fn place(&self) -> &Place {
        &self.place
    }

    async fn work(
        &mut self,
        mut requests: Streaming<SendGoalRequest>,
        told: &Responder<SendGoalResponse>,
    ) -> Result<(), Status> {
        let Self { place, goal, feedback, form } = self;
        let tell = async |kind: sent::Kind| {
            let bytes = match &kind {
                sent::Kind::Feedback(feedback) => feedback.payload.len(),
                sent::Kind::Result(result) => result.payload.len(),
                sent::Kind::Taken(_) | sent::Kind::CancelAnswer(_) => 0,
            };
            let room = place.guest.unread.take(bytes).await;
            let _ = told.send((Ok(SendGoalResponse { kind: Some(kind) }), room)).await;
        };
        let ended = goal.outcome(*form, OUTCOME_WAIT_MAX);
        tokio::pin!(ended);
        let mut is_asking = true;
        loop {
            tokio::select! {
                outcome = &mut ended => {
                    let outcome = outcome.map_err(Fault::from)?;
                    for _ in 0..LAST_FEEDBACK_MAX {
                        let Some(Some(next)) = feedback.next(*form).now_or_never() else { break };
                        if let Ok(payload) = next {
                            tell(sent::Kind::Feedback(sent::Feedback { payload })).await;
                        }
                    }
                    let (status, payload) = (to_proto(outcome.status).into(), outcome.result);
                    tell(sent::Kind::Result(sent::Result { status, payload })).await;
                    return Ok(());
                }
                next = feedback.next(*form) => match next {
                    None => return Err(Fault::from(GatewayError::Stopping).into()),
                    Some(Ok(payload)) => tell(sent::Kind::Feedback(sent::Feedback { payload })).await,
                    Some(Err(error)) => tracing::debug!(%error, "feedback that cannot be read is left out"),
                },
                asked = requests.message(), if is_asking => match asked? {
                    None => is_asking = false,
                    Some(SendGoalRequest { kind: Some(Asked::Cancel(_)) }) => {
                        let answer = goal.cancel().await.map_err(Fault::from)?;
                        let is_taken = answer == CancelAnswer::Taken;
                        tell(sent::Kind::CancelAnswer(sent::CancelAnswer { is_taken })).await;
                    }
                    Some(_) => return Err(ORDER_GOAL.into()),
                },
            }
        }
    }
}

fn to_proto(status: GoalStatus) -> proto::GoalStatus {
    match status {
        GoalStatus::Succeeded => proto::GoalStatus::Succeeded,
        GoalStatus::Canceled => proto::GoalStatus::Canceled,
        GoalStatus::Aborted => proto::GoalStatus::Aborted,
        _ => proto::GoalStatus::Unspecified,
    }
}

/// Serves an action until its client closes the stream.
pub(super) async fn serve(
    guest: Arc<Guest>,
    mut requests: Streaming<ServeActionRequest>,
) -> Result<Response<Responses<ServeActionResponse>>, Status> {
    let place = guest.take(StreamKind::Serving)?;
    let Some(ServeActionRequest { kind: Some(Said::Server(server)) }) = first(&guest, &mut requests).await?
    else {
        return Err(ORDER_ACTION.into());
    };
    let Server { action, r#type, encoding } = server;
    let form = qos::form(encoding)?;
    let said = Some(&*r#type).filter(|name| !name.is_empty());
    let serving = async {
        let serving = guest.session.serve_action(&action, said).await?;
        Ok((guest.session.action_type(&action, said)?, serving))
    };
    let (type_name, serving) = guest.admitted(serving).await?;
    let replier = serving.replier();
    let taken = served::Kind::Served(served::Served { r#type: type_name });
    let taken = ServeActionResponse { kind: Some(taken) };
    Ok(begin(ActionConversation { place, serving, replier, form }, requests, taken))
}

/// An action that a client serves.
struct ActionConversation {
    place: Place,
    serving: ActionServing,
    replier: ActionReplier,
    form: Form,
}

impl Conversation for ActionConversation {
    type Request = ServeActionRequest;
    type Response = ServeActionResponse;

    fn place(&self) -> &Place {
        &self.place
    }

    async fn work(
        &mut self,
        mut requests: Streaming<ServeActionRequest>,
        told: &Responder<ServeActionResponse>,
    ) -> Result<(), Status> {
        loop {
            tokio::select! {
                said = requests.message() => {
                    let Some(said) = said? else { return Ok(()) };
                    let Some(kind) = said.kind else { return Err(ORDER_ACTION.into()) };
                    let goal_id = match &kind {
                        Said::Server(_) => return Err(ORDER_ACTION.into()),
                        Said::Answer(said) => said.goal_id.clone(),
                        Said::Feedback(said) => said.goal_id.clone(),
                        Said::Finish(said) => said.goal_id.clone(),
                    };
                    if let Err(why) = self.hear(kind).await {
                        let refused = served::Kind::Refused(served::Refused { goal_id, reason: why.to_string() });
                        let _ = told.send((Ok(ServeActionResponse { kind: Some(refused) }), None)).await;
                    }
                }
                event = async {
                    let permit = told.reserve().await.ok()?;
                    Some((permit, self.serving.next().await))
                } => {
                    let Some((permit, event)) = event else { return Ok(()) };
                    let mut room = None;
                    let kind = match event.ok_or(Fault::from(GatewayError::Stopping))? {
                        ActionEvent::Goal { id, goal } => {
                            let payload = self.serving.write(&goal, self.form).map_err(Fault::from)?;
                            room = self.place.guest.unread.take(payload.len()).await;
                            served::Kind::Goal(served::Goal { goal_id: id.to_vec().into(), payload })
                        }
                        ActionEvent::Cancel { id } => {
                            served::Kind::Cancel(served::Cancel { goal_id: id.to_vec().into() })
                        }
                    };
                    permit.send((Ok(ServeActionResponse { kind: Some(kind) }), room));
                }
            }
        }
    }
}

impl ActionConversation {
    async fn hear(&self, said: Said) -> Result<(), Fault> {
        let content = |bytes| Content { form: self.form, bytes };
        match said {
            Said::Server(_) => return Err(ORDER_ACTION),
            Said::Answer(said) => self.replier.answer(&goal_id(&said.goal_id)?, said.is_taken).await?,
            Said::Feedback(said) => {
                self.replier.feedback(&goal_id(&said.goal_id)?, &content(said.payload)).await?;
            }
            Said::Finish(Finish { goal_id: id, status, payload }) => {
                let status = match proto::GoalStatus::try_from(status) {
                    Ok(proto::GoalStatus::Unspecified | proto::GoalStatus::Succeeded) => {
                        GoalStatus::Succeeded
                    }
                    Ok(proto::GoalStatus::Canceled) => GoalStatus::Canceled,
                    Ok(proto::GoalStatus::Aborted) => GoalStatus::Aborted,
                    Err(_) => return Err(Fault::Enumeration { what: "status of a goal", number: status }),
                };
                self.replier.finish(&goal_id(&id)?, status, &content(payload)).await?;
            }
        }
        Ok(())
    }
}

fn goal_id(said: &[u8]) -> Result<GoalId, Fault> {
    said.try_into().map_err(|_| Fault::GoalId { bytes: said.len() })
}
