//! [`Subscriptions`]: the topics to which a client is subscribed.

use std::collections::BTreeMap;

use super::context::Context;
use crate::access::Right;
use crate::definitions::InterfaceType;
use crate::error::GatewayError;
use crate::rosbridge::op::{OpId, Refusal, SubscribeTopic};
use crate::rosbridge::topics::Topic;
use crate::session::Subscribe;

/// The topics to which a client is subscribed.
#[derive(Default)]
pub(super) struct Subscriptions(BTreeMap<String, Topic>);

impl Subscriptions {
    pub(super) async fn subscribe(
        &mut self,
        context: &Context,
        id: Option<OpId>,
        op: SubscribeTopic<'_>,
    ) -> Result<(), Refusal> {
        let SubscribeTopic { topic, type_name, qos, request } = op;
        let session = &context.session;
        self.0.retain(|_, topic| topic.is_alive());
        let count = self.0.values().map(Topic::len).sum();
        session.check_count("subscriptions", count, session.limits().subscriptions_max)?;
        if let Some(subscribed) = self.0.get_mut(&*topic) {
            let said = type_name.filter(|name| !name.is_empty() && name != "*");
            let full = said.map(|name| InterfaceType::Message.full_name(&name)).transpose()?;
            if let Some(wanted) = full.filter(|full| full != subscribed.type_name()) {
                let actual = subscribed.type_name().to_owned();
                return Err(GatewayError::OtherType { name: topic.into_owned(), actual, wanted }.into());
            }
            session.check(Right::Subscribe, &topic)?;
            subscribed.add(id, request);
            return Ok(());
        }
        let topic = topic.into_owned();
        let wanted = Subscribe {
            topic: topic.clone(),
            type_name: type_name.map(Into::into),
            qos,
            depth: request.depth(),
            ..Subscribe::default()
        };
        let subscription = session.subscribe(wanted).await?;
        self.0.insert(topic, Topic::new(subscription, id, request, context.outbox.clone()));
        Ok(())
    }

    /// Ends one subscription to a topic, or all without an id.
    pub(super) fn unsubscribe(&mut self, id: Option<&OpId>, topic: &str) -> Result<(), Refusal> {
        let Some(subscribed) = self.0.get_mut(topic) else {
            return Err(GatewayError::NotThere { name: topic.to_owned(), what: "subscribed to" }.into());
        };
        if !subscribed.remove(id) {
            self.0.remove(topic);
        }
        Ok(())
    }

    /// Ends the subscriptions to all other topics.
    pub(super) fn retain(&mut self, mut is_kept: impl FnMut(&str) -> bool) {
        self.0.retain(|topic, _| is_kept(topic));
    }
}
