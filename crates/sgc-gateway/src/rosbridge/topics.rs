//! [`Topic`]: a client's subscriptions to one topic. They share one subscription at the hub, and the client gets each
//! message once.

use std::collections::BTreeMap;
use std::num::NonZeroUsize;
use std::sync::atomic::{AtomicU64, Ordering};
use std::time::Duration;

use futures_util::FutureExt as _;
use tokio::sync::watch;
use tokio::task::JoinHandle;
use tokio::time::Instant;

use super::envelope::{Compression, Envelope, Frame};
use super::op::OpId;
use super::outbox::{Level, Outbox};
use crate::error::GatewayError;
use crate::feed::{Delivery, Subscription};

/// Queued messages for a client that gives neither a number nor a rate.
const QUEUE_DEFAULT: usize = 1000;
/// The largest queue length that a client can give.
const QUEUE_MAX: usize = 10_000;
/// Most messages and bytes that are encoded at once.
const BATCH_MAX: usize = 64;
const BATCH_BYTES: usize = 64 << 10;
/// Shortest time between warnings about lost messages of a topic.
const WARN_INTERVAL: Duration = Duration::from_secs(1);

/// The request of one subscription.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub(super) struct SubscriptionRequest {
    pub(super) throttle: Duration,
    pub(super) queue_length: usize,
    pub(super) fragment_size: Option<NonZeroUsize>,
    pub(super) compression: Compression,
}

/// The settings that suit all subscriptions of a client to a topic.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
struct Pace {
    interval_min: Option<Duration>,
    depth: usize,
    fragment_size: Option<NonZeroUsize>,
    compression: Compression,
    /// The number of replays of kept messages so far.
    replays: u64,
}

/// A client's subscriptions to a topic.
#[derive(Debug)]
pub(super) struct Topic {
    type_name: String,
    wishes: BTreeMap<Option<OpId>, SubscriptionRequest>,
    pace: watch::Sender<Pace>,
    task: JoinHandle<()>,
}

impl Drop for Topic {
    fn drop(&mut self) {
        self.task.abort();
    }
}

impl Topic {
    pub(super) fn new(
        subscription: Subscription,
        id: Option<OpId>,
        wish: SubscriptionRequest,
        outbox: Outbox,
    ) -> Self {
        let wishes = BTreeMap::from([(id, wish)]);
        let (pace, followed) = watch::channel(pace(wishes.values(), 0));
        let type_name = subscription.type_name().to_owned();
        let task = tokio::spawn(pump(subscription, followed, outbox));
        Self { type_name, wishes, pace, task }
    }

    pub(super) fn type_name(&self) -> &str {
        &self.type_name
    }

    /// Returns `true` until the gateway stops.
    pub(super) fn is_alive(&self) -> bool {
        !self.task.is_finished()
    }

    /// Returns the number of subscriptions.
    pub(super) fn len(&self) -> usize {
        self.wishes.len()
    }

    /// Adds a subscription, or changes the request of one.
    pub(super) fn add(&mut self, id: Option<OpId>, wish: SubscriptionRequest) {
        let is_new = self.wishes.insert(id, wish).is_none();
        self.change(u64::from(is_new));
    }

    /// Removes a subscription, or all without an id. Returns `false` if none is left.
    pub(super) fn remove(&mut self, id: Option<&OpId>) -> bool {
        match id {
            Some(_) => drop(self.wishes.remove(&id.cloned())),
            None => self.wishes.clear(),
        }
        self.change(0);
        !self.wishes.is_empty()
    }

    fn change(&self, replays: u64) {
        self.pace.send_modify(|now| *now = pace(self.wishes.values(), now.replays + replays));
    }
}

impl SubscriptionRequest {
    /// Returns the queue length.
    pub(super) fn depth(&self) -> usize {
        match self.queue_length {
            0 if self.throttle.is_zero() => QUEUE_DEFAULT,
            // Only the latest message matters when its time has come.
            0 => 1,
            length => length.min(QUEUE_MAX),
        }
    }
}

/// Returns the shortest interval, the smallest fragments and the longest queue, and prefers CBOR to JSON.
fn pace<'w>(wishes: impl Iterator<Item = &'w SubscriptionRequest> + Clone, replays: u64) -> Pace {
    let throttle = wishes.clone().map(|wish| wish.throttle).min().unwrap_or_default();
    Pace {
        interval_min: (!throttle.is_zero()).then_some(throttle),
        depth: wishes.clone().map(SubscriptionRequest::depth).max().unwrap_or(1),
        fragment_size: wishes.clone().filter_map(|wish| wish.fragment_size).min(),
        compression: wishes.map(|wish| wish.compression).max().unwrap_or_default(),
        replays,
    }
}

/// Forwards messages from a subscription to the client, as fast as it reads them.
async fn pump(mut subscription: Subscription, mut followed: watch::Receiver<Pace>, outbox: Outbox) {
    let mut pace = *followed.borrow_and_update();
    subscription.set_pace(pace.depth, pace.interval_min);
    let mut told = WarningState::default();
    let begin_of =
        |pace: &Pace, topic: &str| Envelope::new("publish", pace.compression, 0).text("topic", topic);
    let mut begin = begin_of(&pace, subscription.topic());
    loop {
        let first = tokio::select! {
            biased;
            changed = followed.changed() => {
                if changed.is_err() {
                    return;
                }
                let next = *followed.borrow_and_update();
                subscription.set_pace(next.depth, next.interval_min);
                if next.replays != pace.replays {
                    subscription.replay();
                }
                pace = next;
                begin = begin_of(&pace, subscription.topic());
                continue;
            }
            first = subscription.next() => first,
        };
        let Some(first) = first else {
            let ended = format!("{}: the gateway is stopping", subscription.topic());
            outbox.try_status(Level::Warning, &ended, None);
            return;
        };
        let Ok(place) = outbox.place().await else { return };
        let mut batch = Vec::new();
        let mut bytes = 0;
        let mut next = Some(first);
        while let Some(delivery) = next {
            match frame(&subscription, &delivery, &pace, &begin) {
                Ok(frame) => {
                    bytes += frame.bytes();
                    batch.push(frame);
                }
                Err(error) => told.wrong(&subscription, &error, &outbox),
            }
            if pace.interval_min.is_none() {
                told.dropped(&subscription, delivery.dropped, &outbox);
            }
            next = match batch.len() < BATCH_MAX && bytes < BATCH_BYTES && pace.interval_min.is_none() {
                true => subscription.next().now_or_never().flatten(),
                false => None,
            };
        }
        place.send(batch);
    }
}

/// Encodes a message for the client.
fn frame(
    subscription: &Subscription,
    delivery: &Delivery,
    pace: &Pace,
    begin: &Envelope,
) -> Result<Frame, GatewayError> {
    let compression = pace.compression;
    let message = &delivery.message;
    let content = subscription.write(message, compression.form())?;
    let envelope = begin.again(content.len());
    let envelope = match compression {
        Compression::CborRaw => {
            let received = Duration::from_nanos(message.received_ns.max(0).unsigned_abs());
            envelope.raw_message("msg", &content, received)
        }
        _ => envelope.content("msg", &content),
    };
    Ok(envelope.finish_in_pieces(pace.fragment_size, fragment_id))
}

/// Returns an id for the fragments of a message that is unique in the process.
pub(super) fn fragment_id() -> String {
    static NEXT: AtomicU64 = AtomicU64::new(0);
    format!("fragment:{}", NEXT.fetch_add(1, Ordering::Relaxed))
}

/// The warnings sent for a topic, kept to limit their rate.
#[derive(Debug, Default)]
struct WarningState {
    dropped: u64,
    at: Option<Instant>,
}

impl WarningState {
    fn may(&mut self) -> bool {
        let may = self.at.is_none_or(|at| at.elapsed() >= WARN_INTERVAL);
        if may {
            self.at = Some(Instant::now());
        }
        may
    }

    fn dropped(&mut self, subscription: &Subscription, dropped: u64, outbox: &Outbox) {
        if dropped > self.dropped && self.may() {
            let more = dropped - self.dropped;
            self.dropped = dropped;
            let text = format!(
                "{}: {more} messages were left out, since they were not taken fast enough",
                subscription.topic()
            );
            outbox.try_status(Level::Warning, &text, None);
        }
    }

    fn wrong(&mut self, subscription: &Subscription, error: &GatewayError, outbox: &Outbox) {
        if self.may() {
            outbox.try_status(Level::Error, &format!("{}: {error}", subscription.topic()), None);
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn pace_suits_all_requests() {
        let wish = |throttle, queue_length, fragment_size: usize, compression| SubscriptionRequest {
            throttle: Duration::from_millis(throttle),
            queue_length,
            fragment_size: NonZeroUsize::new(fragment_size),
            compression,
        };
        let slow = wish(500, 0, 1000, Compression::None);
        assert_eq!(
            (pace([&slow].into_iter(), 0).depth, SubscriptionRequest::default().depth()),
            (1, QUEUE_DEFAULT)
        );
        let queued = wish(100, 5, 300, Compression::Cbor);
        let both = pace([&slow, &queued].into_iter(), 0);
        assert_eq!((both.interval_min, both.depth), (Some(Duration::from_millis(100)), 5));
        assert_eq!((both.fragment_size, both.compression), (NonZeroUsize::new(300), Compression::Cbor));
        let fast = wish(0, 0, 0, Compression::CborRaw);
        let all = pace([&slow, &queued, &fast].into_iter(), 0);
        assert_eq!(
            (all.interval_min, all.depth, all.compression),
            (None, QUEUE_DEFAULT, Compression::CborRaw)
        );
        assert_eq!(wish(0, usize::MAX, 0, Compression::None).depth(), QUEUE_MAX);
    }
}
