//! A bounded queue between two tasks: bounded in items and in bytes, lock-free in the common case.
//!
//! Who pushes decides what a full queue means: [`Queue::push`] waits for room (reliable traffic),
//! [`Queue::push_evicting`] makes room by dropping the oldest (best effort). One consumer.

use std::sync::atomic::{AtomicBool, AtomicUsize, Ordering};
use std::time::Duration;

use crossbeam_queue::ArrayQueue;
use tokio::sync::Notify;

/// Why an item was not queued.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum PushError {
    /// The consumer is gone.
    Closed,
    /// The consumer took nothing for as long as the producer may wait.
    Stalled,
}

/// The queue.
pub(crate) struct Queue<T> {
    items: ArrayQueue<(T, usize)>,
    bytes: AtomicUsize,
    closed: AtomicBool,
    /// Set when a producer gave up waiting; the next does not wait until the consumer moves again.
    stalled: AtomicBool,
    filled: Notify,
    drained: Notify,
}

impl<T> Queue<T> {
    /// A queue of at most `items_max` items. Bytes are bounded at each push; one item may exceed the bound.
    pub(crate) fn new(items_max: usize) -> Self {
        Self {
            items: ArrayQueue::new(items_max),
            bytes: AtomicUsize::new(0),
            closed: AtomicBool::new(false),
            stalled: AtomicBool::new(false),
            filled: Notify::new(),
            drained: Notify::new(),
        }
    }

    /// Queues an item, waiting for at most `patience` until it and what is queued are within `bytes_max`.
    pub(crate) async fn push(
        &self,
        item: T,
        bytes: usize,
        bytes_max: usize,
        patience: Duration,
    ) -> Result<(), PushError> {
        let Err(mut item) = self.try_push(item, bytes, bytes_max) else { return Ok(()) };
        let deadline = tokio::time::Instant::now() + patience;
        loop {
            if self.is_closed() {
                return Err(PushError::Closed);
            }
            let drained = self.drained.notified();
            tokio::pin!(drained);
            drained.as_mut().enable();
            // Between the last try and `enable` the consumer may have moved.
            match self.try_push(item, bytes, bytes_max) {
                Ok(()) => return Ok(()),
                Err(back) => item = back,
            }
            if self.stalled.load(Ordering::Relaxed) {
                return Err(PushError::Stalled);
            }
            if tokio::time::timeout_at(deadline, drained).await.is_err() {
                self.stalled.store(true, Ordering::Relaxed);
                return Err(PushError::Stalled);
            }
        }
    }

    /// Queues an item; while there are more than `bytes_max`, what has waited longest makes room and is handed to
    /// `evicted`.
    pub(crate) fn push_evicting(&self, item: T, bytes: usize, bytes_max: usize, mut evicted: impl FnMut(T)) {
        while !self.has_room(bytes, bytes_max) {
            let Some(old) = self.take() else { break };
            evicted(old);
        }
        self.bytes.fetch_add(bytes, Ordering::AcqRel);
        if let Some((old, old_bytes)) = self.items.force_push((item, bytes)) {
            self.bytes.fetch_sub(old_bytes, Ordering::AcqRel);
            evicted(old);
        }
        self.filled.notify_one();
    }

    /// Takes the oldest item, waiting for one; `None` once the queue is closed and empty.
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

    /// Waits until an item is there; false once the queue is closed and empty.
    pub(crate) async fn wait(&self) -> bool {
        loop {
            let is_closed = self.is_closed();
            if !self.is_empty() {
                return true;
            }
            if is_closed {
                return false;
            }
            self.filled.notified().await;
        }
    }

    /// Takes the oldest item, if there is one.
    pub(crate) fn try_pop(&self) -> Option<T> {
        self.take()
    }

    /// Ends the queue: nothing more is accepted, what is in it can still be taken.
    pub(crate) fn close(&self) {
        self.closed.store(true, Ordering::Release);
        self.filled.notify_one();
        self.drained.notify_waiters();
    }

    /// True if nothing waits.
    pub(crate) fn is_empty(&self) -> bool {
        self.items.is_empty()
    }

    /// True while it is less than half full.
    pub(crate) fn has_headroom(&self, bytes_max: usize) -> bool {
        self.items.len() < self.items.capacity() / 2 && self.bytes.load(Ordering::Acquire) < bytes_max / 2
    }

    /// Bytes that wait.
    #[cfg(test)]
    pub(crate) fn bytes(&self) -> usize {
        self.bytes.load(Ordering::Acquire)
    }

    /// True once closed.
    pub(crate) fn is_closed(&self) -> bool {
        self.closed.load(Ordering::Acquire)
    }

    /// Queues an item if there is room; else gives it back.
    pub(crate) fn try_push(&self, item: T, bytes: usize, bytes_max: usize) -> Result<(), T> {
        if self.is_closed() || !self.has_room(bytes, bytes_max) {
            return Err(item);
        }
        self.bytes.fetch_add(bytes, Ordering::AcqRel);
        match self.items.push((item, bytes)) {
            Ok(()) => {
                self.filled.notify_one();
                Ok(())
            }
            Err((item, _)) => {
                self.bytes.fetch_sub(bytes, Ordering::AcqRel);
                Err(item)
            }
        }
    }

    fn has_room(&self, bytes: usize, bytes_max: usize) -> bool {
        let used = self.bytes.load(Ordering::Acquire);
        used == 0 || used + bytes <= bytes_max
    }

    fn take(&self) -> Option<T> {
        let (item, bytes) = self.items.pop()?;
        self.bytes.fetch_sub(bytes, Ordering::AcqRel);
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
        // It may have failed fast on the stall before the pop; after the pop it must succeed.
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
}
