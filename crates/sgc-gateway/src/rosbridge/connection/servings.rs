//! [`Servings`]: the services and actions that a client serves.

use std::collections::BTreeMap;
use std::sync::Arc;

use super::context::Context;
use crate::access::Right;
use crate::action::GoalId;
use crate::content::Content;
use crate::error::GatewayError;
use crate::rosbridge::actions::ServedAction;
use crate::rosbridge::input;
use crate::rosbridge::op::{
    ActionFeedback, ActionResult, OpId, Refusal, ServiceOutcome, ServiceResponse, ServingAdvertisement, short,
};
use crate::rosbridge::services::ServedService;
use crate::session::{Session, action_of};

/// The services and actions that a client serves.
#[derive(Default)]
pub(super) struct Servings {
    services: BTreeMap<String, ServedService>,
    actions: BTreeMap<String, ServedAction>,
}

impl Servings {
    fn check_count(&self, session: &Session) -> Result<(), GatewayError> {
        let (now, max) = (self.services.len() + self.actions.len(), session.limits().servings_max);
        session.check_count("services and actions that are served", now, max)
    }

    /// Serves a service. A second advertisement replaces the first.
    pub(super) async fn advertise_service(
        &mut self,
        context: &Context,
        op: ServingAdvertisement<'_>,
    ) -> Result<(), Refusal> {
        let ServingAdvertisement { name: service, type_name } = op;
        self.check_count(&context.session)?;
        self.services.remove(&*service);
        let serving = context.session.serve(&service, Some(&type_name)).await?;
        self.services.insert(service.into_owned(), ServedService::new(serving, context.outbox.clone()));
        Ok(())
    }

    pub(super) fn unadvertise_service(&mut self, service: &str) -> Result<(), Refusal> {
        self.services.remove(service).map(drop).ok_or_else(|| not_served(service))
    }

    pub(super) async fn service_response(
        &self,
        id: Option<&OpId>,
        op: ServiceResponse<'_>,
    ) -> Result<(), Refusal> {
        let ServiceResponse { service, outcome } = op;
        let served = self.services.get(&*service).ok_or_else(|| not_served(&service))?;
        let unknown = || Refusal::rule(format!("{service}: no request waits under that id"));
        let request = served.request(id).ok_or_else(unknown)?;
        match outcome {
            ServiceOutcome::Failure(why) => {
                // ROS 2 has no reply for failures, so the caller gets none.
                let why = why.map_or_else(|| "no reason given".to_owned(), short);
                tracing::debug!(%service, %why, "a client failed to answer");
            }
            ServiceOutcome::Reply(values) => {
                let replier = served.replier();
                let values = input::arguments(values, || Ok(Arc::clone(replier.reply_layout())))?;
                let reply = |content: Content| async move { replier.reply(request, &content).await };
                input::tolerate_later(&values, reply).await?;
            }
        }
        served.answered(id);
        Ok(())
    }

    /// Serves an action. A second advertisement replaces the first.
    pub(super) async fn advertise_action(
        &mut self,
        context: &Context,
        op: ServingAdvertisement<'_>,
    ) -> Result<(), Refusal> {
        let ServingAdvertisement { name: action, type_name } = op;
        let session = &context.session;
        self.check_count(session)?;
        session.check(Right::Serve, &action)?;
        self.actions.remove(&*action);
        let full = session.action_type(&action, Some(&type_name))?;
        let serving = session.serve_action(&action, Some(&full)).await?;
        self.actions.insert(action.into_owned(), ServedAction::new(serving, full, context.outbox.clone()));
        Ok(())
    }

    pub(super) fn unadvertise_action(&mut self, action: &str) -> Result<(), Refusal> {
        self.actions.remove(action).map(drop).ok_or_else(|| not_served(action))
    }

    /// Returns a goal, and its action, which the client must serve.
    fn goal(&self, id: Option<&OpId>, action: &str) -> Result<(&ServedAction, GoalId), Refusal> {
        let served = self.actions.get(action).ok_or_else(|| not_served(action))?;
        let goal = served.goal(id).ok_or(Refusal::rule("no goal of that id is under way"))?;
        Ok((served, goal))
    }

    pub(super) async fn action_feedback(
        &self,
        id: Option<&OpId>,
        op: ActionFeedback<'_>,
    ) -> Result<(), Refusal> {
        let (served, goal) = self.goal(id, &op.action)?;
        let (replier, goal) = (served.replier(), &goal);
        let report = |content: Content| async move { replier.feedback(goal, &content).await };
        Ok(input::tolerate_later(op.values, report).await?)
    }

    pub(super) async fn action_result(&self, id: Option<&OpId>, op: ActionResult<'_>) -> Result<(), Refusal> {
        let (served, goal) = self.goal(id, &op.action)?;
        let (replier, goal) = (served.replier(), &goal);
        let finish = |content: Content| async move { replier.finish(goal, op.status, &content).await };
        input::tolerate_later(op.values, finish).await?;
        served.forget(id);
        Ok(())
    }

    /// Checks that a goal whose status a client reports is under way. The gateway itself reports to ROS 2.
    pub(super) fn action_status(&self, id: Option<&OpId>, action: &str) -> Result<(), Refusal> {
        self.goal(id, action).map(drop)
    }

    /// Ends the services and actions of all other names. A service of an action has the action's name.
    pub(super) fn retain(&mut self, mut is_kept: impl FnMut(&str) -> bool) {
        self.services.retain(|name, _| is_kept(action_of(name)));
        self.actions.retain(|name, _| is_kept(name));
    }
}

fn not_served(name: &str) -> Refusal {
    GatewayError::NotThere { name: name.to_owned(), what: "served" }.into()
}
