//! [`Publications`]: the topics that a client publishes.

use std::collections::{BTreeMap, BTreeSet};
use std::time::Duration;

use crate::definitions::InterfaceType;
use crate::error::GatewayError;
use crate::publisher::Publication;
use crate::rosbridge::input;
use crate::rosbridge::op::{AdvertiseTopic, OpId, Publish, Refusal};
use crate::session::{Advertise, Session};

/// Time for which a new publisher waits for the readers in the graph, so that these get its first message.
const SETTLE_MAX: Duration = Duration::from_millis(500);

/// A topic that a client publishes.
struct ClientPublication {
    publication: Publication,
    /// The ids of its advertisements. A topic published without one ends with any `unadvertise`.
    ids: BTreeSet<Option<OpId>>,
}

/// The topics that a client publishes.
#[derive(Default)]
pub(super) struct Publications {
    topics: BTreeMap<String, ClientPublication>,
    /// Topics with unsent messages.
    unflushed: Vec<String>,
}

impl Publications {
    pub(super) async fn advertise(
        &mut self,
        session: &Session,
        id: Option<OpId>,
        op: AdvertiseTopic<'_>,
    ) -> Result<(), Refusal> {
        let AdvertiseTopic { topic, type_name, qos } = op;
        let Some(published) = self.topics.get_mut(&*topic) else {
            let (topic, type_name) = (topic.into_owned(), type_name.map(Into::into));
            let wanted = Advertise { topic, type_name, qos };
            return Ok(self.begin(session, wanted, BTreeSet::from([id])).await?);
        };
        let full = type_name.map(|name| InterfaceType::Message.full_name(&name)).transpose()?;
        if let Some(wanted) = full.filter(|full| full != published.publication.type_name()) {
            let actual = published.publication.type_name().to_owned();
            return Err(GatewayError::OtherType { name: topic.into_owned(), actual, wanted }.into());
        }
        if !published.ids.contains(&id) {
            let max = session.limits().publications_max;
            session.check_count("advertisements of a topic", published.ids.len(), max)?;
            published.ids.insert(id);
        }
        Ok(())
    }

    async fn begin(
        &mut self,
        session: &Session,
        wanted: Advertise,
        ids: BTreeSet<Option<OpId>>,
    ) -> Result<(), GatewayError> {
        let max = session.limits().publications_max;
        session.check_count("topics that are published", self.topics.len(), max)?;
        let topic = wanted.topic.clone();
        let publication = session.advertise(wanted).await?;
        publication.settle(SETTLE_MAX).await;
        self.topics.insert(topic, ClientPublication { publication, ids });
        Ok(())
    }

    /// Ends one advertisement of a topic, or all without an id.
    pub(super) fn unadvertise(&mut self, id: Option<OpId>, topic: &str) -> Result<(), Refusal> {
        let Some(published) = self.topics.get_mut(topic) else {
            return Err(GatewayError::NotThere { name: topic.to_owned(), what: "advertised" }.into());
        };
        match id {
            Some(_) => drop(published.ids.remove(&id)),
            None => published.ids.clear(),
        }
        if published.ids.is_empty() {
            self.topics.remove(topic);
        }
        Ok(())
    }

    /// Publishes a message, which may be sent only with the next flush.
    pub(super) async fn publish(&mut self, session: &Session, op: Publish<'_>) -> Result<(), Refusal> {
        let Publish { topic, msg, advertisement } = op;
        if !self.topics.contains_key(&*topic) {
            let advertisement = advertisement?;
            let type_name = advertisement.type_name.map(Into::into);
            let wanted = Advertise { topic: topic.clone().into_owned(), type_name, qos: advertisement.qos };
            self.begin(session, wanted, BTreeSet::new()).await?;
        }
        let Some(published) = self.topics.get(&*topic) else { return Ok(()) };
        let publication = &published.publication;
        let done = match input::message(publication.layout(), msg) {
            Ok(value) => publication.publish_value_ahead(&value).await,
            Err(error) => Err(error),
        };
        let done = done.map_err(|error| unpublished(&topic, error));
        if !self.unflushed.iter().any(|unflushed| *unflushed == topic) {
            self.unflushed.push(topic.into_owned());
        }
        done
    }

    /// Sends the messages of a topic that were published since the last flush, or returns `None` if there are none.
    /// A topic that lost several messages is returned several times.
    pub(super) async fn flush_next(&mut self) -> Option<Result<(), Refusal>> {
        let topic = self.unflushed.pop()?;
        let Some(published) = self.topics.get(&topic) else { return Some(Ok(())) };
        let flushed = published.publication.flush().await.map_err(|error| unpublished(&topic, error));
        if published.publication.has_ahead() {
            self.unflushed.push(topic);
        }
        Some(flushed)
    }

    /// Ends the publications of all other topics.
    pub(super) fn retain(&mut self, mut is_kept: impl FnMut(&str) -> bool) {
        self.topics.retain(|topic, _| is_kept(topic));
    }
}

fn unpublished(topic: &str, error: GatewayError) -> Refusal {
    Refusal::Unpublished { topic: topic.to_owned(), error: Box::new(error) }
}
