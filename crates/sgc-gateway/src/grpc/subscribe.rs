//! `Subscribe`: a topic as a stream. The connection polls for a message only if at most one is unsent, so that
//! messages queue in the subscription alone.

use std::collections::BTreeMap;
use std::sync::Arc;
use std::time::Duration;

use futures_util::stream;
use sgc_ros::Guid;
use tokio::sync::watch;
use tonic::{Response, Status};

use super::fault::Fault;
use super::guest::{Guest, Place, StreamKind};
use super::proto::subscribe_response::{Kind, Message, Subscribed, Unreadable};
use super::proto::{SubscribeRequest, SubscribeResponse};
use super::qos;
use super::slot::{Responses, Slot, with_slot};
use crate::content::Form;
use crate::error::GatewayError;
use crate::feed::{Delivery, Subscription};
use crate::hub::Hub;
use crate::session::Subscribe;

/// Queued messages for a client that sets no depth.
const DEPTH_DEFAULT: u32 = 10;
/// Most queued messages for a client.
const DEPTH_MAX: u32 = 10_000;
/// Lowest rate in messages per second: about one a day.
const RATE_MIN_HZ: f64 = 1e-5;

/// A client's stream of a topic.
struct TopicStream {
    place: Place,
    subscription: Subscription,
    form: Form,
    sources: Sources,
    /// The response before the first message.
    first: Option<Subscribed>,
    /// The slot for the room of the next message.
    slot: Slot,
}

/// Converts a request.
fn wanted(request: SubscribeRequest) -> Result<(Subscribe, Form), Fault> {
    let form = qos::form(request.encoding)?;
    let depth = if request.depth == 0 { DEPTH_DEFAULT } else { request.depth };
    if depth > DEPTH_MAX {
        return Err(Fault::Depth { depth, max: DEPTH_MAX });
    }
    let rate = request.max_rate_hz;
    let interval_min = match rate {
        0.0 => None,
        rate if rate >= RATE_MIN_HZ && rate.is_finite() => Some(Duration::from_secs_f64(1.0 / rate)),
        _ => return Err(Fault::Rate { rate, min: RATE_MIN_HZ }),
    };
    let wanted = Subscribe {
        topic: request.topic,
        type_name: Some(request.r#type).filter(|name| !name.is_empty()),
        qos: request.qos.as_ref().map(qos::from_proto).transpose()?,
        depth: depth as usize,
        interval_min,
        waits: request.waits,
    };
    Ok((wanted, form))
}

/// Subscribes to a topic for a client.
pub(super) async fn subscribe(
    guest: Arc<Guest>,
    request: SubscribeRequest,
) -> Result<Response<Responses<SubscribeResponse>>, Fault> {
    let (wanted, form) = wanted(request)?;
    let place = guest.take(StreamKind::Subscription)?;
    let subscribed = async { Ok(guest.session.subscribe(wanted).await?) };
    let subscription = guest.admitted(subscribed).await?;
    guest.holds(&subscription);
    let first = Subscribed {
        r#type: subscription.type_name().to_owned(),
        type_hash: subscription.layout().type_hash(),
    };
    let sources = Sources::new(guest.session.hub());
    let slot = Slot::default();
    let hearing = TopicStream { place, subscription, form, sources, first: Some(first), slot: slot.clone() };
    let responses: Responses<_> = Box::pin(stream::unfold(Some(hearing), |hearing| async {
        let mut hearing = hearing?;
        match hearing.next().await {
            Ok(kind) => Some((Ok(SubscribeResponse { kind: Some(kind) }), Some(hearing))),
            Err(why) => Some((Err(Status::from(why)), None)),
        }
    }));
    Ok(with_slot(responses, slot))
}

impl TopicStream {
    async fn next(&mut self) -> Result<Kind, Fault> {
        if let Some(first) = self.first.take() {
            return Ok(Kind::Subscribed(first));
        }
        let delivery = tokio::select! {
            biased;
            why = self.place.guest.ended() => return Err(why),
            delivery = self.subscription.next() => delivery,
        };
        let Some(Delivery { message, dropped }) = delivery else {
            return Err(GatewayError::Stopping.into());
        };
        let node = message.writer.and_then(|writer| self.sources.node(self.subscription.topic(), &writer));
        let node = node.unwrap_or_default();
        let payload = match self.subscription.write(&message, self.form) {
            Ok(payload) => payload,
            Err(error) => return Ok(Kind::Unreadable(Unreadable { reason: error.to_string(), node })),
        };
        let guest = &self.place.guest;
        let room = async { Ok(guest.unread.take(payload.len()).await) };
        self.slot.put(guest.admitted(room).await?);
        Ok(Kind::Message(Message {
            payload,
            source_time_ns: message.source_timestamp_ns,
            received_time_ns: message.received_ns,
            node,
            dropped,
        }))
    }
}

/// The nodes of the topic's publishers, from the graph.
struct Sources {
    hub: Hub,
    changes: watch::Receiver<u64>,
    /// The nodes in the last graph.
    nodes: BTreeMap<Guid, Option<String>>,
}

impl Sources {
    fn new(hub: &Hub) -> Self {
        Self { hub: hub.clone(), changes: hub.graph_changes(), nodes: BTreeMap::new() }
    }

    fn node(&mut self, topic: &str, writer: &Guid) -> Option<String> {
        if self.changes.has_changed().unwrap_or(false) {
            self.changes.mark_unchanged();
            self.nodes.clear();
        }
        let hub = &self.hub;
        let node = self.nodes.entry(*writer).or_insert_with(|| {
            let graph = hub.graph();
            let publishers = graph.topics.get(topic).map(|info| &info.publishers[..]).unwrap_or_default();
            publishers.iter().find(|publisher| publisher.guid == *writer)?.node.clone()
        });
        node.clone()
    }
}
