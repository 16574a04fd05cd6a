//! [`Feed`]: a reader of a topic, and all who hear it. Each topic is read once for everybody who takes it as it is offered.

use std::collections::{BTreeMap, VecDeque};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError, Weak};
use std::time::Duration;

use sgc_cdr::Layout;
use sgc_ros::{
    DiscoveredEndpoint, EndpointKind, EndpointSpec, Guid, HandleSamples, Sample, SampleKind, dds_topic,
    dds_type, reader_for, weakest,
};
use sgc_wire::{Durability, History, Qos, Reliability};
use tokio::time::Instant;

use crate::content::Form;
use crate::error::GatewayError;
use crate::graph::Graph;
use crate::hub::Shared;
use crate::message::Message;
use crate::queue::{Overflow, Queue};
use crate::quota::{Charge, Waiting};
use crate::ros::LocalReader;
use crate::session::Waits;

/// Messages of one writer that are kept for who subscribes later, of a topic whose writers do so too.
pub(crate) const LATCHED_DEPTH_MAX: usize = 100;
/// Bytes of them, of all writers of a topic.
const LATCHED_BYTES_MAX: usize = 64 << 20;

/// Which reader a subscriber shares.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(crate) struct FeedKey {
    pub(crate) topic: String,
    pub(crate) type_name: String,
    /// What to request; none takes each publisher as it is.
    pub(crate) qos: Option<Qos>,
    /// Whether its only subscriber is waited for.
    pub(crate) waits: bool,
}

/// A reader and its subscribers.
pub(crate) struct Feed {
    pub(crate) key: FeedKey,
    hub: Weak<Shared>,
    /// The charge of the client for which the reader was made, for as long as the reader is there.
    _charge: Charge,
    outlets: Mutex<Outlets>,
    /// The reader, and what it requests. Locked by who changes it, which may take a while.
    reader: Mutex<Option<(LocalReader, EndpointSpec)>>,
}

#[derive(Default)]
struct Outlets {
    queues: Vec<Weak<Queue>>,
    latched: Latched,
}

/// What is kept for who subscribes later.
#[derive(Default)]
struct Latched {
    is_on: bool,
    /// Messages of each writer, the newest last.
    writers: BTreeMap<Option<Guid>, VecDeque<Arc<Message>>>,
    bytes: usize,
    depth: usize,
}

impl Latched {
    fn add(&mut self, message: &Arc<Message>) {
        if !self.is_on {
            return;
        }
        let kept = self.writers.entry(message.writer).or_default();
        kept.push_back(Arc::clone(message));
        self.bytes += message.payload.len();
        let mut gone = 0;
        while kept.len() > self.depth || (self.bytes - gone > LATCHED_BYTES_MAX && kept.len() > 1) {
            gone += kept.pop_front().map_or(0, |old| old.payload.len());
        }
        self.bytes -= gone;
    }

    /// Whether it was heard before: a reader that is made anew hears again what writers kept. By time and content, since
    /// clocks are set back.
    fn has(&self, sample: &Sample) -> bool {
        let is_it = |message: &Arc<Message>| {
            message.source_timestamp_ns == sample.source_timestamp_ns && message.payload == sample.payload
        };
        self.is_on && self.writers.get(&sample.writer).is_some_and(|kept| kept.iter().any(is_it))
    }

    fn clear(&mut self) {
        self.writers.clear();
        self.bytes = 0;
    }

    fn retain(&mut self, is_there: impl Fn(&Guid) -> bool) {
        self.writers.retain(|writer, _| writer.as_ref().is_none_or(&is_there));
        self.bytes = self.writers.values().flatten().map(|message| message.payload.len()).sum();
    }
}

impl std::fmt::Debug for Feed {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.debug_tuple("Feed").field(&self.key).finish()
    }
}

/// What comes from a feed's reader.
struct Intake(Arc<Feed>);

impl HandleSamples for Intake {
    fn handle(&mut self, sample: Sample) {
        self.0.hand_out(sample);
    }

    fn handle_at_once(&mut self, sample: Sample) -> Result<(), Sample> {
        let would_wait = {
            let outlets = self.0.outlets();
            let bytes = sample.payload.len();
            outlets.queues.iter().filter_map(Weak::upgrade).any(|queue| queue.would_wait(bytes))
        };
        if would_wait {
            return Err(sample);
        }
        self.0.hand_out(sample);
        Ok(())
    }

    fn overrun(&mut self, samples: u64) {
        self.0.outlets().queues.iter().filter_map(Weak::upgrade).for_each(|q| q.add_dropped(samples));
    }
}

impl Feed {
    pub(crate) fn new(key: FeedKey, hub: &Arc<Shared>, charge: Charge) -> Arc<Self> {
        let (outlets, reader) = (Mutex::default(), Mutex::new(None));
        Arc::new(Self { key, hub: Arc::downgrade(hub), _charge: charge, outlets, reader })
    }

    fn outlets(&self) -> MutexGuard<'_, Outlets> {
        self.outlets.lock().unwrap_or_else(PoisonError::into_inner)
    }

    fn hand_out(&self, sample: Sample) {
        if sample.kind != SampleKind::Write {
            return;
        }
        let mut outlets = self.outlets();
        if outlets.latched.has(&sample) {
            return;
        }
        let message = Arc::new(Message::new(sample.payload, sample.writer, sample.source_timestamp_ns));
        outlets.latched.add(&message);
        let queues: Vec<_> = outlets.queues.iter().filter_map(Weak::upgrade).collect();
        drop(outlets);
        queues.iter().for_each(|queue| queue.push(&message));
    }

    /// Adds a subscriber, who hears first what is kept.
    pub(crate) fn join(&self, queue: &Arc<Queue>) {
        let mut outlets = self.outlets();
        outlets.latched.writers.values().flatten().for_each(|message| queue.push(message));
        outlets.queues.push(Arc::downgrade(queue));
    }

    /// What is kept, once more.
    fn replay(&self, queue: &Queue) {
        self.outlets().latched.writers.values().flatten().for_each(|message| queue.push(message));
    }

    fn leave(&self, queue: &Arc<Queue>) {
        self.outlets().queues.retain(|other| !std::ptr::eq(other.as_ptr(), Arc::as_ptr(queue)));
    }

    /// What its reader is to request, as the graph is.
    fn wanted(&self, graph: &Graph) -> EndpointSpec {
        let FeedKey { topic, type_name, qos, waits } = &self.key;
        let info = graph.topics.get(topic);
        let of_type = |info: &&crate::graph::EndpointInfo| info.type_name == *type_name;
        let publishers: Vec<_> = info.iter().flat_map(|info| &info.publishers).filter(of_type).collect();
        let qos = qos.clone().unwrap_or_else(|| {
            let offers = weakest(publishers.iter().map(|publisher| &publisher.qos));
            match offers {
                // Heard are those who say so; with any other reliability, who comes first would not be.
                None => Qos {
                    reliability: Reliability::BestEffort,
                    history: History::KeepLast(10),
                    ..Qos::default()
                },
                Some(offer) => {
                    let taken = reader_for(&offer, publishers.len());
                    // Who waits for its subscriber leaves out nothing that it has room for.
                    let keeps_all = *waits && taken.is_reliable();
                    let history = if keeps_all { History::KeepAll } else { taken.history };
                    Qos { history, ..taken }
                }
            }
        });
        EndpointSpec {
            topic: dds_topic(topic),
            type_name: dds_type(type_name),
            keyless: publishers.first().is_none_or(|publisher| publisher.keyless),
            type_hash: info.and_then(|info| info.type_hash(type_name)).map(str::to_owned),
            qos,
        }
    }

    /// Makes the reader, or makes it anew if what is offered has changed. May block.
    pub(crate) fn adapt(self: &Arc<Self>) -> Result<(), GatewayError> {
        let hub = self.hub.upgrade().ok_or(GatewayError::Stopping)?;
        let mut reader = self.reader.lock().unwrap_or_else(PoisonError::into_inner);
        let wanted = self.wanted(&hub.graph());
        {
            let mut outlets = self.outlets();
            let latched = &mut outlets.latched;
            latched.retain(|writer| hub.is_there(writer));
            latched.is_on = wanted.qos.durability >= Durability::TransientLocal;
            if !latched.is_on {
                latched.clear();
            }
            latched.depth = match wanted.qos.history {
                History::KeepLast(depth) => (depth as usize).clamp(1, LATCHED_DEPTH_MAX),
                History::KeepAll => LATCHED_DEPTH_MAX,
            };
        }
        let is_as_wanted = |spec: &EndpointSpec| {
            spec.qos == wanted.qos && spec.keyless == wanted.keyless && spec.type_name == wanted.type_name
        };
        if reader.as_ref().is_some_and(|(_, spec)| is_as_wanted(spec)) {
            return Ok(());
        }
        if let Some((old, _)) = reader.take() {
            hub.forget(&[old.guid()]);
            // Its end waits for its thread, which may wait for a subscriber.
            let queues: Vec<_> = self.outlets().queues.iter().filter_map(Weak::upgrade).collect();
            queues.iter().for_each(|queue| queue.let_pass(true));
            drop(old);
            queues.iter().for_each(|queue| queue.let_pass(false));
        }
        let made = hub.ros.reader(&wanted, Box::new(Intake(Arc::clone(self))))?;
        hub.know(own_endpoint(EndpointKind::Reader, made.guid(), &wanted));
        *reader = Some((made, wanted));
        Ok(())
    }

    /// Ends the reader, which holds the feed. May block.
    pub(crate) fn end(&self) {
        // Who waits for room would be waited for.
        self.outlets().queues.drain(..).filter_map(|q| q.upgrade()).for_each(|queue| queue.close());
        let reader = self.reader.lock().unwrap_or_else(PoisonError::into_inner).take();
        if let Some(((reader, _), hub)) = reader.zip(self.hub.upgrade()) {
            hub.forget(&[reader.guid()]);
        }
    }

    pub(crate) fn is_unused(&self) -> bool {
        self.outlets().queues.iter().all(|queue| queue.strong_count() == 0)
    }
}

/// An endpoint of the gateway's own, as discovery would tell of it.
pub(crate) fn own_endpoint(kind: EndpointKind, guid: Guid, spec: &EndpointSpec) -> DiscoveredEndpoint {
    DiscoveredEndpoint {
        kind,
        guid,
        topic: spec.topic.clone(),
        type_name: spec.type_name.clone(),
        keyless: spec.keyless,
        type_hash: spec.type_hash.clone(),
        qos: spec.qos.clone(),
    }
}

/// A message for one subscriber.
#[derive(Clone, Debug)]
pub struct Delivery {
    /// The message, shared with others.
    pub message: Arc<Message>,
    /// How many were left out for this subscriber until now: it took them too slowly.
    pub dropped: u64,
}

/// How much one subscriber takes.
#[derive(Debug)]
pub(crate) struct Intaking {
    pub(crate) depth: usize,
    /// Bytes that may wait of one that is waited for: it does not share its bound, since nobody else makes room for it.
    pub(crate) bytes_max: usize,
    /// Bytes that wait for the client in all its subscriptions.
    pub(crate) waiting: Arc<Waiting>,
    pub(crate) interval_min: Option<Duration>,
    pub(crate) overflow: Overflow,
    /// Its place among those that are waited for, if it is.
    pub(crate) waits: Option<Waits>,
    /// Its place among the subscriptions of its client's credential.
    pub(crate) charge: Charge,
}

/// What one client hears of a topic; ends when dropped.
pub struct Subscription {
    feed: Arc<Feed>,
    queue: Arc<Queue>,
    layout: Arc<Layout>,
    interval_min: Option<Duration>,
    not_before: Option<Instant>,
    _waits: Option<Waits>,
    _charge: Charge,
}

impl Subscription {
    pub(crate) fn new(feed: Arc<Feed>, layout: Arc<Layout>, taking: Intaking) -> Self {
        let queue = Arc::new(Queue::new(taking.depth, taking.bytes_max, taking.waiting, taking.overflow));
        feed.join(&queue);
        Self {
            feed,
            queue,
            layout,
            interval_min: taking.interval_min,
            not_before: None,
            _waits: taking.waits,
            _charge: taking.charge,
        }
    }

    /// The topic.
    pub fn topic(&self) -> &str {
        &self.feed.key.topic
    }

    /// Its ROS type.
    pub fn type_name(&self) -> &str {
        &self.feed.key.type_name
    }

    /// What its messages look like.
    pub fn layout(&self) -> &Arc<Layout> {
        &self.layout
    }

    /// A message in a form.
    pub fn write(&self, message: &Message, form: Form) -> Result<bytes::Bytes, GatewayError> {
        message.written(form, &self.layout)
    }

    /// Waits for the next message, and for the time at which one may come; `None` once the gateway stops. It may be given up
    /// at any time, and nothing is lost.
    pub async fn next(&mut self) -> Option<Delivery> {
        if let Some(at) = self.not_before {
            tokio::time::sleep_until(at).await;
        }
        let (message, dropped) = self.queue.next().await?;
        self.not_before = self.interval_min.map(|interval| Instant::now() + interval);
        Some(Delivery { message, dropped })
    }

    /// What ends it whoever holds it.
    pub(crate) fn ender(&self) -> SubscriptionEnd {
        SubscriptionEnd { feed: Arc::downgrade(&self.feed), queue: Arc::downgrade(&self.queue) }
    }

    /// How many messages were left out until now.
    pub fn dropped(&self) -> u64 {
        self.queue.dropped()
    }

    /// Takes messages at another pace from now on, as [`Subscribe`](crate::Subscribe) has it.
    pub fn set_pace(&mut self, depth: usize, interval_min: Option<Duration>) {
        self.queue.set_depth(depth);
        let before = std::mem::replace(&mut self.interval_min, interval_min);
        let last = self.not_before.zip(before).and_then(|(at, before)| at.checked_sub(before));
        self.not_before = last.zip(interval_min).map(|(last, interval)| last + interval);
    }

    /// Has what is kept for who subscribes later come once more, for another part of the same client.
    pub fn replay(&self) {
        self.feed.replay(&self.queue);
    }
}

/// Ends a [`Subscription`] that somebody else holds: one that is waited for, for example, by who does not look at it.
#[derive(Debug)]
pub(crate) struct SubscriptionEnd {
    feed: Weak<Feed>,
    queue: Weak<Queue>,
}

impl SubscriptionEnd {
    /// Nothing comes any more, and nothing waits any more.
    pub(crate) fn end(&self) {
        if let (Some(feed), Some(queue)) = (self.feed.upgrade(), self.queue.upgrade()) {
            feed.leave(&queue);
            queue.close();
            queue.clear();
            if let Some(hub) = feed.hub.upgrade() {
                hub.sweep();
            }
        }
    }

    /// Whether the subscription is dropped.
    pub(crate) fn has_ended(&self) -> bool {
        self.queue.strong_count() == 0
    }
}

impl std::fmt::Debug for Subscription {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.debug_struct("Subscription").field("key", &self.feed.key).finish_non_exhaustive()
    }
}

impl Drop for Subscription {
    fn drop(&mut self) {
        self.feed.leave(&self.queue);
        self.queue.close();
        if let Some(hub) = self.feed.hub.upgrade() {
            hub.sweep();
        }
    }
}
