//! [`Feed`]: a reader of a topic and its subscribers. Subscribers with the same requirements share one reader.

use std::collections::{BTreeMap, VecDeque};
use std::sync::atomic::{AtomicUsize, Ordering};
use std::sync::{Arc, Mutex, MutexGuard, Weak};
use std::time::Duration;

use sgc_cdr::Layout;
use sgc_ros::{
    DiscoveredEndpoint, EndpointKind, EndpointSpec, Guid, HandleSamples, Sample, SampleKind, dds_topic,
    dds_type, reader_for, weakest,
};
use sgc_sync::lock;
use sgc_wire::{Durability, History, Qos, Reliability};
use tokio::time::Instant;

use crate::content::Form;
use crate::error::GatewayError;
use crate::graph::Graph;
use crate::message::Message;
use crate::network::Network;
use crate::queue::{Overflow, Queue, cost};
use crate::quota::{ByteReservation, Charge, Payer, PendingBytes};
use crate::ros::LocalReader;

/// Most messages of one writer that are kept for later subscribers of a transient-local topic.
pub(crate) const LATCHED_DEPTH_MAX: usize = 100;
/// Most bytes of these messages over all writers of one reader, including the cost of each message.
const LATCHED_BYTES_MAX: usize = 64 << 20;

/// The properties by which subscribers share a reader.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(crate) struct FeedKey {
    pub(crate) topic: String,
    pub(crate) type_name: String,
    /// The requested QoS; `None` adapts to what the publishers offer.
    pub(crate) qos: Option<Qos>,
    /// `true` if writers wait for the only subscriber.
    pub(crate) waits: bool,
}

/// A reader and its subscribers.
pub(crate) struct Feed {
    pub(crate) key: FeedKey,
    network: Weak<Network>,
    outlets: Mutex<Outlets>,
    /// The reader and its request. The lock may be held for long while the reader changes.
    reader: Mutex<Option<(LocalReader, EndpointSpec)>>,
}

struct Outlets {
    subscribers: Vec<Subscriber>,
    /// The charge of the reader, paid by a session that subscribes, or by the last one that did.
    charge: Charge,
    /// The session that pays the charge.
    payer: Payer,
    latched: LatchedMessages,
}

/// A subscription that shares a reader.
struct Subscriber {
    queue: Weak<Queue>,
    payer: Payer,
}

impl Outlets {
    fn queues(&self) -> impl Iterator<Item = Arc<Queue>> {
        self.subscribers.iter().filter_map(|subscriber| subscriber.queue.upgrade())
    }

    /// Moves charges to sessions that subscribe, if there are any. Returns the number of messages that were dropped
    /// because no session has room for them.
    fn pass_charges(&mut self) -> u64 {
        let payers = || self.subscribers.iter().map(|subscriber| &subscriber.payer);
        let Some(first) = payers().next() else { return 0 };
        if !payers().any(|payer| payer.is_same(&self.payer)) {
            let taken = payers().find_map(|payer| Some((payer.take_reader_if_room()?, payer)));
            // Each of these sessions subscribes with this reader, and would have its own reader if it were alone.
            let (charge, payer) = taken.unwrap_or_else(|| (first.take_reader_anyway(), first));
            (self.charge, self.payer) = (charge, payer.clone());
        }
        self.latched.pass_charges(&self.subscribers)
    }
}

/// Messages that are kept for later subscribers.
#[derive(Default)]
struct LatchedMessages {
    /// Most messages of a writer, or `None` if none are kept.
    depth: Option<usize>,
    /// The messages of each writer, the newest last.
    writers: BTreeMap<Option<Guid>, VecDeque<KeptMessage>>,
    /// `true` if a message was left out because no subscriber had room for it.
    is_short: bool,
}

/// A message that is kept.
struct KeptMessage {
    message: Message,
    /// The reservation in the budget of the subscriber that pays for the message.
    room: ByteReservation,
}

impl LatchedMessages {
    fn bytes(&self) -> usize {
        self.writers.values().map(bytes_of).sum()
    }

    fn messages(&self) -> impl Iterator<Item = &Message> {
        self.writers.values().flatten().map(|kept| &kept.message)
    }

    /// Delivers each kept message again. The copies cache their encodings only while they are queued.
    fn replay(&self, queue: &Queue) {
        self.messages().for_each(|message| queue.push(&Arc::new(message.unwritten())));
    }

    /// Keeps a message in the room of one of the sessions. Returns the number of messages left out for lack of room:
    /// the oldest ones of the writer with the most bytes, or the message itself.
    fn add<'p, P: Iterator<Item = &'p Payer>>(
        &mut self,
        message: &Arc<Message>,
        payers: impl Fn() -> P,
    ) -> u64 {
        let Some(depth) = self.depth else { return 0 };
        let bytes = cost(message);
        let own = self.writers.entry(message.writer).or_default();
        let beyond = (own.len() + 1).saturating_sub(depth);
        own.drain(..beyond);
        let mut dropped = 0;
        loop {
            let is_within = self.bytes() + bytes <= LATCHED_BYTES_MAX;
            if is_within && let Some(room) = payers().find_map(|payer| payer.take_history(bytes)) {
                let kept = KeptMessage { message: message.unwritten(), room };
                self.writers.entry(message.writer).or_default().push_back(kept);
                return dropped;
            }
            self.is_short |= is_within;
            dropped += 1;
            let with_new = |(writer, kept): &(&Option<Guid>, &mut VecDeque<KeptMessage>)| {
                bytes_of(kept) + if **writer == message.writer { bytes } else { 0 }
            };
            let heaviest = self.writers.iter_mut().max_by_key(with_new);
            if heaviest.and_then(|(_, kept)| kept.pop_front()).is_none() {
                return dropped;
            }
        }
    }

    /// Moves charges from sessions that left to sessions that subscribe, the newest messages first. Returns the
    /// number of messages dropped because no session has room: the message that does not fit and older ones of the
    /// same writer.
    fn pass_charges(&mut self, subscribers: &[Subscriber]) -> u64 {
        let mut dropped = 0;
        for kept in self.writers.values_mut() {
            let has_room = |kept: &mut KeptMessage| {
                if !subscribers.iter().any(|subscriber| subscriber.payer.has_room(&kept.room)) {
                    let bytes = kept.room.bytes();
                    let room = subscribers.iter().find_map(|subscriber| subscriber.payer.take_history(bytes));
                    let Some(room) = room else { return false };
                    kept.room = room;
                }
                true
            };
            let newest = kept.iter_mut().rev().map(has_room).take_while(|has_room| *has_room).count();
            let gone = kept.len() - newest;
            kept.drain(..gone);
            dropped += gone as u64;
        }
        self.is_short |= dropped > 0;
        dropped
    }

    /// Returns `true` for a message that is kept already, because a recreated reader receives again what writers
    /// keep. Compares time and content, because clocks may be set back.
    fn has(&self, sample: &Sample) -> bool {
        let is_it = |kept: &KeptMessage| {
            kept.message.source_timestamp_ns == sample.source_timestamp_ns
                && kept.message.payload == sample.payload
        };
        self.depth.is_some() && self.writers.get(&sample.writer).is_some_and(|kept| kept.iter().any(is_it))
    }

    fn retain(&mut self, is_there: impl Fn(&Guid) -> bool) {
        self.writers.retain(|writer, _| writer.as_ref().is_none_or(&is_there));
    }
}

fn bytes_of(kept: &VecDeque<KeptMessage>) -> usize {
    kept.iter().map(|kept| kept.room.bytes()).sum()
}

impl std::fmt::Debug for Feed {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.debug_tuple("Feed").field(&self.key).finish()
    }
}

/// The handler of samples from a feed's reader.
struct FeedHandler(Arc<Feed>);

impl HandleSamples for FeedHandler {
    fn handle(&mut self, sample: Sample) {
        self.0.hand_out(sample);
    }

    fn handle_at_once(&mut self, sample: Sample) -> Option<Sample> {
        let bytes = sample.payload.len();
        let would_wait = self.0.outlets().queues().any(|queue| queue.would_wait(bytes));
        if would_wait {
            return Some(sample);
        }
        self.0.hand_out(sample);
        None
    }

    fn overrun(&mut self, samples: u64) {
        self.0.outlets().queues().for_each(|queue| queue.add_dropped(samples));
    }
}

impl Feed {
    pub(crate) fn new(key: FeedKey, network: &Arc<Network>, charge: Charge, payer: Payer) -> Arc<Self> {
        let outlets = Outlets { subscribers: Vec::new(), charge, payer, latched: LatchedMessages::default() };
        let (outlets, reader) = (Mutex::new(outlets), Mutex::new(None));
        Arc::new(Self { key, network: Arc::downgrade(network), outlets, reader })
    }

    fn outlets(&self) -> MutexGuard<'_, Outlets> {
        lock(&self.outlets)
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
        let Outlets { subscribers, payer, latched, .. } = &mut *outlets;
        let last = subscribers.is_empty().then_some(&*payer);
        let dropped = latched.add(&message, || subscribers.iter().map(|other| &other.payer).chain(last));
        let queues: Vec<_> = outlets.queues().collect();
        drop(outlets);
        self.count_dropped(dropped);
        queues.iter().for_each(|queue| queue.push(&message));
    }

    /// Counts messages that were not kept for later subscribers.
    fn count_dropped(&self, messages: u64) {
        if messages > 0
            && let Some(network) = self.network.upgrade()
        {
            network.quotas.count_history_dropped(messages);
        }
    }

    /// Adds a subscriber, which gets the kept messages first.
    fn join(&self, queue: &Arc<Queue>, payer: Payer) {
        let mut outlets = self.outlets();
        outlets.latched.replay(queue);
        outlets.subscribers.push(Subscriber { queue: Arc::downgrade(queue), payer });
        let dropped = outlets.pass_charges();
        drop(outlets);
        self.count_dropped(dropped);
    }

    /// Delivers the kept messages again.
    fn replay(&self, queue: &Queue) {
        self.outlets().latched.replay(queue);
    }

    fn leave(&self, queue: &Arc<Queue>) {
        let mut outlets = self.outlets();
        outlets.subscribers.retain(|other| !std::ptr::eq(other.queue.as_ptr(), Arc::as_ptr(queue)));
        let dropped = outlets.pass_charges();
        drop(outlets);
        self.count_dropped(dropped);
    }

    /// Returns `true` if the history is complete, or if the session subscribes already.
    pub(crate) fn has_history_for(&self, payer: &Payer) -> bool {
        let outlets = self.outlets();
        !outlets.latched.is_short || outlets.subscribers.iter().any(|other| other.payer.is_same(payer))
    }

    /// Returns the reader that suits the current graph.
    fn wanted(&self, graph: &Graph) -> EndpointSpec {
        let FeedKey { topic, type_name, qos, waits } = &self.key;
        let info = graph.topics.get(topic);
        let of_type = |info: &&crate::graph::EndpointInfo| info.type_name == *type_name;
        let publishers: Vec<_> = info.iter().flat_map(|info| &info.publishers).filter(of_type).collect();
        let qos = qos.clone().unwrap_or_else(|| {
            let offers = weakest(publishers.iter().map(|publisher| &publisher.qos));
            match offers {
                // A best-effort reader matches every publisher; with another reliability the first one might not
                // match.
                None => Qos {
                    reliability: Reliability::BestEffort,
                    history: History::KeepLast(10),
                    ..Qos::default()
                },
                Some(offer) => {
                    let taken = reader_for(&offer, publishers.len());
                    // A writer that waits for its subscriber must not lose messages for which the subscriber has
                    // room.
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
            asks_key_hash: false,
            type_hash: info.and_then(|info| info.type_hash(type_name)).map(str::to_owned),
            qos,
        }
    }

    /// Creates the reader, or recreates it if the offers have changed. May block.
    pub(crate) fn adapt(self: &Arc<Self>) -> Result<(), GatewayError> {
        let network = self.network.upgrade().ok_or(GatewayError::Stopping)?;
        let mut reader = lock(&self.reader);
        let wanted = self.wanted(&network.graph());
        {
            let mut outlets = self.outlets();
            let latched = &mut outlets.latched;
            latched.retain(|writer| network.is_there(writer));
            let is_kept = wanted.qos.durability >= Durability::TransientLocal;
            latched.depth = is_kept.then(|| match wanted.qos.history {
                History::KeepLast(depth) => (depth as usize).clamp(1, LATCHED_DEPTH_MAX),
                History::KeepAll => LATCHED_DEPTH_MAX,
            });
            if latched.depth.is_none() {
                latched.writers.clear();
            }
        }
        let is_as_wanted = |spec: &EndpointSpec| {
            spec.qos == wanted.qos && spec.keyless == wanted.keyless && spec.type_name == wanted.type_name
        };
        if reader.as_ref().is_some_and(|(_, spec)| is_as_wanted(spec)) {
            return Ok(());
        }
        if let Some((old, _)) = reader.take() {
            network.forget(&[old.guid()]);
            // Dropping the reader waits for its thread, which may wait for a subscriber.
            let queues: Vec<_> = self.outlets().queues().collect();
            queues.iter().for_each(|queue| queue.let_pass(true));
            drop(old);
            queues.iter().for_each(|queue| queue.let_pass(false));
        }
        // Writers send what they keep again.
        self.outlets().latched.is_short = false;
        let made = network.ros.reader(&wanted, Box::new(FeedHandler(Arc::clone(self))))?;
        network.know(own_endpoint(EndpointKind::Reader, made.guid(), &wanted));
        *reader = Some((made, wanted));
        Ok(())
    }

    /// Drops the reader, which holds the feed. May block.
    pub(crate) fn end(&self) {
        // A subscriber without room would hold up the reader's worker.
        let subscribers = std::mem::take(&mut self.outlets().subscribers);
        subscribers.iter().filter_map(|other| other.queue.upgrade()).for_each(|queue| queue.close());
        let reader = lock(&self.reader).take();
        if let Some(((reader, _), network)) = reader.zip(self.network.upgrade()) {
            network.forget(&[reader.guid()]);
        }
    }

    pub(crate) fn is_unused(&self) -> bool {
        self.outlets().subscribers.iter().all(|subscriber| subscriber.queue.strong_count() == 0)
    }
}

/// Describes an endpoint of the gateway as discovery would.
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
    /// The message, shared with other subscribers.
    pub message: Arc<Message>,
    /// Messages that this subscriber has lost so far because it reads too slowly.
    pub dropped: u64,
}

/// A place among subscriptions that hold up writers, returned on drop.
#[derive(Debug)]
pub(crate) struct WaitPlace {
    waits: Arc<AtomicUsize>,
    _charge: Charge,
}

impl WaitPlace {
    /// Takes over a place that is counted in `waits`.
    pub(crate) fn new(waits: Arc<AtomicUsize>, charge: Charge) -> Self {
        Self { waits, _charge: charge }
    }
}

impl Drop for WaitPlace {
    fn drop(&mut self) {
        self.waits.fetch_sub(1, Ordering::Relaxed);
    }
}

/// The options of a new subscription.
#[derive(Debug)]
pub(crate) struct SubscriptionOptions {
    pub(crate) depth: usize,
    /// Most queued bytes of a subscription that holds up writers. It has a bound of its own, because no other queue
    /// makes room for it.
    pub(crate) bytes_max: usize,
    /// The bytes that are queued for the client in all its subscriptions.
    pub(crate) waiting: Arc<PendingBytes>,
    pub(crate) interval_min: Option<Duration>,
    pub(crate) overflow: Overflow,
    /// The place among subscriptions that hold up writers, if it is one.
    pub(crate) waits: Option<WaitPlace>,
    /// The charge of the subscription to the client's credential.
    pub(crate) charge: Charge,
    /// The session that can be charged for the reader.
    pub(crate) payer: Payer,
}

/// A client's subscription to a topic, ended by dropping it.
pub struct Subscription {
    feed: Arc<Feed>,
    queue: Arc<Queue>,
    layout: Arc<Layout>,
    interval_min: Option<Duration>,
    not_before: Option<Instant>,
    _waits: Option<WaitPlace>,
    _charge: Charge,
}

impl Subscription {
    pub(crate) fn new(feed: Arc<Feed>, layout: Arc<Layout>, options: SubscriptionOptions) -> Self {
        let queue = Arc::new(Queue::new(options.depth, options.bytes_max, options.waiting, options.overflow));
        feed.join(&queue, options.payer);
        Self {
            feed,
            queue,
            layout,
            interval_min: options.interval_min,
            not_before: None,
            _waits: options.waits,
            _charge: options.charge,
        }
    }

    /// Returns the topic.
    pub fn topic(&self) -> &str {
        &self.feed.key.topic
    }

    /// Returns the ROS type.
    pub fn type_name(&self) -> &str {
        &self.feed.key.type_name
    }

    /// Returns the layout of the messages.
    pub fn layout(&self) -> &Arc<Layout> {
        &self.layout
    }

    /// Converts a message to a form.
    pub fn write(&self, message: &Message, form: Form) -> Result<bytes::Bytes, GatewayError> {
        message.written(form, &self.layout)
    }

    /// Waits for the next message and for the minimum interval. Returns `None` once the gateway stops. Cancelling
    /// loses no message.
    pub async fn next(&mut self) -> Option<Delivery> {
        if let Some(at) = self.not_before {
            tokio::time::sleep_until(at).await;
        }
        let (message, dropped) = self.queue.next().await?;
        self.not_before = self.interval_min.map(|interval| Instant::now() + interval);
        Some(Delivery { message, dropped })
    }

    /// Returns a handle that ends the subscription.
    pub(crate) fn ender(&self) -> SubscriptionEnd {
        SubscriptionEnd { feed: Arc::downgrade(&self.feed), queue: Arc::downgrade(&self.queue) }
    }

    /// Returns the number of messages lost so far.
    pub fn dropped(&self) -> u64 {
        self.queue.dropped()
    }

    /// Sets depth and interval, as in [`Subscribe`](crate::Subscribe).
    pub fn set_pace(&mut self, depth: usize, interval_min: Option<Duration>) {
        self.queue.set_depth(depth);
        let before = std::mem::replace(&mut self.interval_min, interval_min);
        let last = self.not_before.zip(before).and_then(|(at, before)| at.checked_sub(before));
        self.not_before = last.zip(interval_min).map(|(last, interval)| last + interval);
    }

    /// Delivers the kept messages again, for another part of the same client.
    pub fn replay(&self) {
        self.feed.replay(&self.queue);
    }
}

/// A handle that ends a [`Subscription`] held elsewhere, for example one whose holder does not read it.
#[derive(Debug)]
pub(crate) struct SubscriptionEnd {
    feed: Weak<Feed>,
    queue: Weak<Queue>,
}

impl SubscriptionEnd {
    /// Ends delivery and drops queued messages.
    pub(crate) fn end(&self) {
        if let (Some(feed), Some(queue)) = (self.feed.upgrade(), self.queue.upgrade()) {
            feed.leave(&queue);
            queue.close();
            queue.clear();
            if let Some(network) = feed.network.upgrade() {
                network.sweep();
            }
        }
    }

    /// Returns `true` if the subscription was dropped.
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
        if let Some(network) = self.feed.network.upgrade() {
            network.sweep();
        }
    }
}

#[cfg(test)]
mod tests {
    use sgc_testkit::FakeDomain;
    use sgc_wire::UnixMillis;

    use super::*;
    use crate::access::{Access, AccessRules, AdmissionRequest, Anonymous, Client};
    use crate::definitions::{ShippedDefinitions, Types};
    use crate::hub::{Hub, HubOptions};
    use crate::limits::SessionLimits;
    use crate::quota::{Quota, Resource};

    const MESSAGE_BYTES: usize = 1000;
    const COST: usize = MESSAGE_BYTES + crate::queue::MESSAGE_COST_BYTES;
    /// Messages for which one session has room.
    const ROOM: usize = 10;
    const LIMITS: SessionLimits = SessionLimits {
        waiting_bytes_max: ROOM * COST,
        subscriptions_max: 2,
        publications_max: 2,
        servings_max: 2,
        calls_max: 2,
        waits_max: 2,
    };

    /// One session of a client and its accounts.
    struct Viewer {
        quota: Quota,
        history: Arc<PendingBytes>,
        payer: Payer,
    }

    impl Viewer {
        fn new(hub: &Hub, peer: &str) -> Self {
            let access = Access::new(AccessRules { anonymous: Anonymous::All, ..AccessRules::default() });
            let (peer, now) = (peer.parse().unwrap(), UnixMillis(1_795_000_000_000));
            let admission =
                AdmissionRequest { peer, encrypted: true, origin: None, token: None, certificate: None, now };
            let client: Client = access.admit(&admission).unwrap();
            let quota = hub.shared.network.quotas.quota(&client);
            let history = Arc::new(PendingBytes::new(LIMITS.waiting_bytes_max, quota.clone()));
            let payer = Payer::new(quota.clone(), LIMITS, Arc::clone(&history));
            Self { quota, history, payer }
        }

        /// Returns the number of messages kept in the session's room.
        fn keeps(&self) -> usize {
            assert_eq!(self.history.bytes() % COST, 0);
            self.history.bytes() / COST
        }

        fn feed(&self, hub: &Hub) -> Arc<Feed> {
            let (topic, type_name) = ("/map".to_owned(), "std_msgs/msg/String".to_owned());
            let key = FeedKey { topic, type_name, qos: None, waits: false };
            let feed =
                Feed::new(key, &hub.shared.network, self.payer.take_reader().unwrap(), self.payer.clone());
            feed.outlets().latched.depth = Some(LATCHED_DEPTH_MAX);
            feed
        }

        /// Returns the number of further readers that the session may have created.
        fn readers_left(&self) -> usize {
            let mut held = Vec::new();
            while let Some(charge) = self.payer.take_reader_if_room() {
                held.push(charge);
                assert!(held.len() < 100, "nothing stops it");
            }
            held.len()
        }
    }

    /// Creates a queue whose messages are not charged to a session.
    fn queue() -> Arc<Queue> {
        Arc::new(Queue::new(1000, 1 << 20, PendingBytes::for_own_client(1 << 20), Overflow::DropOldest))
    }

    async fn hub() -> Hub {
        let own = Arc::new(FakeDomain::default().join(false));
        Hub::start(own, Types::new(ShippedDefinitions), HubOptions::default()).await.unwrap()
    }

    fn say(feed: &Feed, writer: u8, numbers: std::ops::Range<i64>) {
        for number in numbers {
            feed.hand_out(Sample {
                kind: SampleKind::Write,
                source_timestamp_ns: number,
                key_hash: None,
                payload: vec![0; MESSAGE_BYTES].into(),
                writer: Some(Guid([writer; 16])),
                more: false,
            });
        }
    }

    /// Returns the messages that a later subscriber would get first.
    fn heard(feed: &Feed) -> Vec<i64> {
        feed.outlets().latched.messages().map(|message| message.source_timestamp_ns).collect()
    }

    #[tokio::test]
    async fn messages_that_are_kept_take_room_of_a_subscriber_and_the_oldest_go() {
        let hub = hub().await;
        let sessions: Vec<_> = (0..5).map(|_| Viewer::new(&hub, "10.0.0.1:1")).collect();
        // One session subscribes to many topics.
        let queues: Vec<_> = sessions.iter().map(|_| queue()).collect();
        let feeds: Vec<_> = (0..3).map(|_| sessions[0].feed(&hub)).collect();
        for feed in &feeds {
            feed.join(&queues[0], sessions[0].payer.clone());
        }
        say(&feeds[0], 1, 0..6);
        say(&feeds[1], 1, 0..6);
        assert_eq!((sessions[0].keeps(), heard(&feeds[1])), (ROOM, vec![2, 3, 4, 5]));
        assert_eq!(hub.shared.network.quotas.history_dropped(), 2);
        // A further topic has no room left and takes none from the others.
        say(&feeds[2], 1, 0..3);
        assert_eq!((heard(&feeds[2]), heard(&feeds[0]).len()), (vec![], 6));
        assert_eq!(hub.shared.network.quotas.history_dropped(), 5);
        // Within a topic the writer with the most bytes gives way.
        say(&feeds[0], 2, 10..11);
        assert_eq!(heard(&feeds[0]), [1, 2, 3, 4, 5, 10]);
        // The sessions of one credential together have the room of four.
        let more: Vec<_> = sessions[1..].iter().map(|session| session.feed(&hub)).collect();
        for ((feed, session), queue) in more.iter().zip(&sessions[1..]).zip(&queues[1..]) {
            feed.join(queue, session.payer.clone());
            say(feed, 1, 0..20);
        }
        let kept: Vec<_> = sessions.iter().map(Viewer::keeps).collect();
        assert_eq!(kept, [ROOM, ROOM, ROOM, ROOM, 0]);
        drop((feeds, more));
        assert!(sessions.iter().all(|session| session.keeps() == 0));
    }

    #[tokio::test]
    async fn charges_of_a_reader_pass_to_those_who_remain() {
        let hub = hub().await;
        let [first, second] = ["10.0.0.1:1", "10.0.0.2:1"].map(|peer| Viewer::new(&hub, peer));
        let all = first.readers_left();
        let feed = first.feed(&hub);
        let queues = [queue(), queue()];
        feed.join(&queues[0], first.payer.clone());
        feed.join(&queues[1], second.payer.clone());
        say(&feed, 1, 0..4);
        assert_eq!([first.keeps(), second.keeps()], [4, 0]);
        feed.leave(&queues[0]);
        assert_eq!([first.keeps(), second.keeps()], [0, 4]);
        assert_eq!([first.readers_left(), second.readers_left()], [all, all - 1]);
        // The last subscriber pays until the reader ends or another session subscribes.
        feed.leave(&queues[1]);
        say(&feed, 1, 4..5);
        assert_eq!((second.keeps(), second.readers_left()), (5, all - 1));
        feed.join(&queues[0], first.payer.clone());
        assert_eq!([first.keeps(), second.keeps()], [5, 0]);
        assert_eq!([first.readers_left(), second.readers_left()], [all - 1, all]);
        assert_eq!((heard(&feed).len(), hub.shared.network.quotas.history_dropped()), (5, 0));
        drop(feed);
        assert_eq!((first.keeps(), first.readers_left()), (0, all));
    }

    #[tokio::test]
    async fn a_subscriber_that_leaves_pushes_nobody_beyond_its_room_for_history() {
        let hub = hub().await;
        let [leaver, victim, third] =
            ["10.0.0.1:1", "10.0.0.2:1", "10.0.0.3:1"].map(|peer| Viewer::new(&hub, peer));
        let (own, shared) = (victim.feed(&hub), leaver.feed(&hub));
        let queues = [queue(), queue(), queue()];
        own.join(&queues[1], victim.payer.clone());
        say(&own, 1, 0..7);
        shared.join(&queues[0], leaver.payer.clone());
        shared.join(&queues[2], victim.payer.clone());
        say(&shared, 1, 0..9);
        assert_eq!([leaver.keeps(), victim.keeps()], [9, 7]);
        shared.leave(&queues[0]);
        // The newest messages have room, and the victim's own messages stay.
        assert_eq!((leaver.keeps(), victim.keeps()), (0, ROOM));
        assert_eq!((heard(&shared), heard(&own).len()), (vec![6, 7, 8], 7));
        assert_eq!(hub.shared.network.quotas.history_dropped(), 6);
        // Other clients do not suffer: they have their own readers.
        assert!(shared.has_history_for(&victim.payer) && !shared.has_history_for(&third.payer));
        assert!(own.has_history_for(&third.payer));
    }

    #[tokio::test]
    async fn nobody_stays_charged_with_a_reader_that_it_has_left() {
        let hub = hub().await;
        let [victim, other] = ["10.0.0.1:1", "10.0.0.2:1"].map(|peer| Viewer::new(&hub, peer));
        let all = victim.readers_left();
        let feed = victim.feed(&hub);
        let queues = [queue(), queue()];
        feed.join(&queues[0], victim.payer.clone());
        feed.join(&queues[1], other.payer.clone());
        // Readers that linger after their use take all places of the other session.
        let mut lingering = Vec::new();
        while let Some(charge) = other.payer.take_reader_if_room() {
            lingering.push(charge);
        }
        feed.leave(&queues[0]);
        assert_eq!([victim.readers_left(), other.readers_left()], [all, 0]);
        lingering.truncate(1);
        assert_eq!(other.readers_left(), all - 2);
        assert!(other.quota.take(Resource::Subscriptions, &LIMITS).is_ok());
    }
}
