//! A queue between two tasks, bounded in items and in bytes, for one consumer.
//!
//! The producer chooses the behaviour of a full queue: [`Queue::push`] waits for room (reliable traffic), and
//! [`Queue::push_evicting`] drops the oldest items (best effort).
//!
//! Memory follows the items. A router has a queue for each name and sink, and most are empty most of the time.

use std::collections::VecDeque;
use std::sync::Mutex;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::Duration;

use sgc_sync::lock;
use tokio::sync::Notify;

/// Items for which a queue keeps room, however few it has.
const ROOM_MIN: usize = 32;

/// Reasons why an item was not queued.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum PushError {
    /// The consumer is gone.
    Closed,
    /// The consumer took nothing during the producer's patience.
    Stalled,
}

/// Outcome of a push that does not wait.
#[derive(Debug, PartialEq, Eq)]
#[must_use]
pub(crate) enum PushOutcome<T> {
    /// The item is queued.
    Queued,
    /// The item is returned, because there is no room or the queue is closed.
    NotQueued(T),
}

/// A bounded queue with one consumer.
pub(crate) struct Queue<T> {
    items: Mutex<Items<T>>,
    items_max: usize,
    closed: AtomicBool,
    /// Set when a producer gave up waiting. Others do not wait until the consumer moves again.
    stalled: AtomicBool,
    filled: Notify,
    drained: Notify,
}

/// Queued items, the oldest first.
struct Items<T> {
    queue: VecDeque<(T, usize)>,
    bytes: usize,
    /// Most items at a time since there were none.
    most: usize,
}

impl<T> Items<T> {
    fn has_room(&self, bytes: usize, bytes_max: usize) -> bool {
        self.bytes == 0 || self.bytes.saturating_add(bytes) <= bytes_max
    }

    fn push(&mut self, item: T, bytes: usize) {
        self.queue.push_back((item, bytes));
        self.bytes += bytes;
        self.most = self.most.max(self.queue.len());
    }

    fn pop(&mut self) -> Option<T> {
        let (item, bytes) = self.queue.pop_front()?;
        self.bytes -= bytes;
        if self.queue.is_empty() {
            self.give_room_back();
        }
        Some(item)
    }

    /// Halves the room of an empty queue that needed less than a quarter of it. So the room of a burst goes, and that of
    /// steady traffic stays.
    fn give_room_back(&mut self) {
        let room = self.queue.capacity();
        if room > ROOM_MIN && self.most < room / 4 {
            self.queue.shrink_to((room / 2).max(ROOM_MIN));
        }
        self.most = 0;
    }
}

impl<T> Queue<T> {
    /// Creates a queue of at most `items_max` items. Each push bounds the bytes; one item may exceed the bound.
    pub(crate) fn new(items_max: usize) -> Self {
        Self {
            items: Mutex::new(Items { queue: VecDeque::new(), bytes: 0, most: 0 }),
            items_max,
            closed: AtomicBool::new(false),
            stalled: AtomicBool::new(false),
            filled: Notify::new(),
            drained: Notify::new(),
        }
    }

    /// Queues an item. Waits at most `patience` until everything fits into `bytes_max`.
    pub(crate) async fn push(
        &self,
        item: T,
        bytes: usize,
        bytes_max: usize,
        patience: Duration,
    ) -> Result<(), PushError> {
        let mut item = match self.try_push(item, bytes, bytes_max) {
            PushOutcome::Queued => return Ok(()),
            PushOutcome::NotQueued(item) => item,
        };
        let deadline = tokio::time::Instant::now() + patience;
        loop {
            if self.is_closed() {
                return Err(PushError::Closed);
            }
            let drained = self.drained.notified();
            tokio::pin!(drained);
            drained.as_mut().enable();
            // The consumer may have moved between the last attempt and `enable`.
            item = match self.try_push(item, bytes, bytes_max) {
                PushOutcome::Queued => return Ok(()),
                PushOutcome::NotQueued(item) => item,
            };
            if self.stalled.load(Ordering::Relaxed) {
                return Err(PushError::Stalled);
            }
            if tokio::time::timeout_at(deadline, drained).await.is_err() {
                self.stalled.store(true, Ordering::Relaxed);
                return Err(PushError::Stalled);
            }
        }
    }

    /// Queues an item. While there are more than `bytes_max`, the oldest items are passed to `evicted`.
    pub(crate) fn push_evicting(&self, item: T, bytes: usize, bytes_max: usize, mut evicted: impl FnMut(T)) {
        loop {
            let mut items = lock(&self.items);
            if items.queue.len() < self.items_max && items.has_room(bytes, bytes_max) {
                items.push(item, bytes);
                break;
            }
            let old = items.pop();
            drop(items);
            if let Some(old) = old {
                evicted(old);
            }
        }
        self.filled.notify_one();
    }

    /// Waits for the oldest item and removes it. Returns `None` once the queue is closed and empty.
    pub(crate) async fn pop(&self) -> Option<T> {
        loop {
            if let Some(item) = self.take() {
                return Some(item);
            }
            if self.is_closed() {
                return self.take();
            }
            self.filled.notified().await;
        }
    }

    /// Removes the oldest item, if there is one.
    pub(crate) fn try_pop(&self) -> Option<T> {
        self.take()
    }

    /// Closes the queue. It accepts no more items, and queued ones can still be taken.
    pub(crate) fn close(&self) {
        self.closed.store(true, Ordering::Release);
        self.filled.notify_one();
        self.drained.notify_waiters();
    }

    /// Returns `true` if the queue is empty.
    pub(crate) fn is_empty(&self) -> bool {
        lock(&self.items).queue.is_empty()
    }

    /// Returns the number of queued items.
    pub(crate) fn len(&self) -> usize {
        lock(&self.items).queue.len()
    }

    /// Returns `true` if the queue is less than half full.
    pub(crate) fn has_headroom(&self, bytes_max: usize) -> bool {
        let items = lock(&self.items);
        items.queue.len() < self.items_max / 2 && items.bytes < bytes_max / 2
    }

    /// Returns the number of queued bytes.
    #[cfg(test)]
    pub(crate) fn bytes(&self) -> usize {
        lock(&self.items).bytes
    }

    /// Returns `true` if the queue is closed.
    pub(crate) fn is_closed(&self) -> bool {
        self.closed.load(Ordering::Acquire)
    }

    /// Queues an item if there is room.
    pub(crate) fn try_push(&self, item: T, bytes: usize, bytes_max: usize) -> PushOutcome<T> {
        let mut items = lock(&self.items);
        if self.is_closed() || items.queue.len() >= self.items_max || !items.has_room(bytes, bytes_max) {
            return PushOutcome::NotQueued(item);
        }
        items.push(item, bytes);
        drop(items);
        self.filled.notify_one();
        PushOutcome::Queued
    }

    fn take(&self) -> Option<T> {
        let item = lock(&self.items).pop()?;
        self.stalled.store(false, Ordering::Relaxed);
        self.drained.notify_waiters();
        Some(item)
    }
}

#[cfg(test)]
mod tests {
    use std::sync::Arc;

    use super::*;

    const PATIENCE: Duration = Duration::from_millis(20);

    #[tokio::test]
    async fn a_full_queue_pushes_back_until_the_consumer_moves() {
        let queue = Arc::new(Queue::new(100));
        queue.push(1, 6, 10, PATIENCE).await.unwrap();
        assert_eq!(queue.push(2, 6, 10, PATIENCE).await, Err(PushError::Stalled));
        let waiting = tokio::spawn({
            let queue = queue.clone();
            async move { queue.push(3, 6, 10, Duration::from_secs(60)).await }
        });
        assert_eq!(queue.pop().await, Some(1));
        // This push may have failed at once, because of the stall before the pop. After the pop, one must succeed.
        if waiting.await.unwrap().is_err() {
            queue.push(3, 6, 10, Duration::from_secs(60)).await.unwrap();
        }
        assert_eq!(queue.pop().await, Some(3));
    }

    #[tokio::test]
    async fn best_effort_keeps_the_newest() {
        let queue = Queue::new(3);
        let mut evicted = Vec::new();
        for n in 0..10 {
            queue.push_evicting(n, 1, 1000, |old| evicted.push(old));
        }
        assert_eq!(evicted, [0, 1, 2, 3, 4, 5, 6]);
        queue.push_evicting(10, 2000, 1000, |old| evicted.push(old));
        assert_eq!(evicted, [0, 1, 2, 3, 4, 5, 6, 7, 8, 9]);
        assert_eq!(queue.pop().await, Some(10));
    }

    #[tokio::test]
    async fn closed_queue_keeps_queued_items_and_takes_no_new_ones() {
        let queue = Queue::new(3);
        queue.push(1, 1, 10, PATIENCE).await.unwrap();
        queue.close();
        assert_eq!(queue.push(2, 1, 10, PATIENCE).await, Err(PushError::Closed));
        assert_eq!((queue.pop().await, queue.pop().await), (Some(1), None));
    }

    #[tokio::test]
    async fn a_large_item_passes_an_empty_queue() {
        let queue = Queue::new(3);
        queue.push(1, 1_000_000, 10, PATIENCE).await.unwrap();
        assert_eq!(queue.pop().await, Some(1));
    }

    #[test]
    fn room_of_a_burst_is_given_back_and_that_of_steady_traffic_is_kept() {
        let queue = Queue::new(1024);
        let room = || lock(&queue.items).queue.capacity();
        let pass = |burst: usize| {
            for n in 0..burst {
                assert_eq!(queue.try_push(n, 1, 10_000), PushOutcome::Queued);
            }
            (0..burst).for_each(|n| assert_eq!(queue.try_pop(), Some(n)));
        };
        assert_eq!(room(), 0, "an unused queue has none");
        pass(1024);
        (0..9).for_each(|_| pass(300));
        assert!(room() >= 1024, "{}", room());
        (0..9).for_each(|_| pass(1));
        assert!(room() <= 2 * ROOM_MIN, "{}", room());
    }
}
