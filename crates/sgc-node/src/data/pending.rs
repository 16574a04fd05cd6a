//! [`PendingQueue`]: messages that wait until their type is known, or their writer open. It is bounded in items and in bytes, and the oldest
//! make room.
//!
//! It neither converts nor counts. The owner of the queue decides how a dropped message is counted.

use std::collections::VecDeque;
use std::sync::Arc;
use std::sync::atomic::{AtomicUsize, Ordering::Relaxed};
use std::time::{Duration, Instant};

/// Time after which a pending message that nobody keeps for late joiners is useless.
pub(crate) const PENDING_MAX: Duration = Duration::from_secs(5);
/// Bytes that one topic may keep pending. A single larger message is allowed alone.
pub(crate) const PENDING_BYTES_MAX: usize = 64 << 20;
/// Bytes that all topics of a node may keep pending together.
const PENDING_TOTAL_BYTES_MAX: usize = 256 << 20;
/// Bytes that one topic may always keep pending, however much others keep.
const PENDING_BYTES_MIN: usize = 64 << 10;

/// Counts the bytes that all topics of a node keep pending.
#[derive(Debug, Default)]
pub(crate) struct PendingBytes(AtomicUsize);

/// One pending message with its age and size.
#[derive(Debug)]
pub(crate) struct PendingItem<T> {
    /// Time at which it was queued.
    pub since: Instant,
    bytes: usize,
    /// The message itself.
    pub item: T,
}

impl<T> PendingItem<T> {
    /// Returns `true` if the item has waited longer than [`PENDING_MAX`].
    pub(crate) fn is_late(&self, now: Instant) -> bool {
        now.saturating_duration_since(self.since) > PENDING_MAX
    }
}

/// Pending items of one topic, the oldest first.
#[derive(Debug)]
pub(crate) struct PendingQueue<T> {
    items: VecDeque<PendingItem<T>>,
    bytes: usize,
    items_max: usize,
    holds: Arc<PendingBytes>,
}

impl<T> PendingQueue<T> {
    /// Creates an empty queue of at most `items_max` items.
    pub(crate) fn new(items_max: usize, holds: Arc<PendingBytes>) -> Self {
        Self { items: VecDeque::new(), bytes: 0, items_max, holds }
    }

    /// Queues an item. Returns the number of dropped items, including this one if all topics together are full.
    pub(crate) fn push(&mut self, now: Instant, bytes: usize, item: T) -> u64 {
        let mut given_up = 0;
        while self.items.len() >= self.items_max || !self.has_room(bytes) {
            if self.pop().is_none() {
                return given_up + 1;
            }
            given_up += 1;
        }
        self.push_back(PendingItem { since: now, bytes, item });
        given_up
    }

    fn has_room(&self, bytes: usize) -> bool {
        let (all, own) = (self.holds.0.load(Relaxed), self.bytes.saturating_add(bytes));
        let fits = own <= PENDING_BYTES_MAX || self.items.is_empty();
        own <= PENDING_BYTES_MIN || fits && all.saturating_add(bytes) <= PENDING_TOTAL_BYTES_MAX
    }

    /// Puts an item back at the end of the queue.
    pub(crate) fn push_back(&mut self, item: PendingItem<T>) {
        self.bytes += item.bytes;
        self.holds.0.fetch_add(item.bytes, Relaxed);
        self.items.push_back(item);
    }

    /// Drops the oldest items while they are late and `is_of_no_use`. Returns their number.
    pub(crate) fn give_up_late(&mut self, now: Instant, is_of_no_use: impl Fn(&T) -> bool) -> u64 {
        let mut given_up = 0;
        while self.items.front().is_some_and(|item| item.is_late(now) && is_of_no_use(&item.item)) {
            given_up += u64::from(self.pop().is_some());
        }
        given_up
    }

    /// Removes the oldest item.
    fn pop(&mut self) -> Option<PendingItem<T>> {
        let item = self.items.pop_front()?;
        self.bytes -= item.bytes;
        self.holds.0.fetch_sub(item.bytes, Relaxed);
        Some(item)
    }

    /// Removes all items.
    pub(crate) fn take(&mut self) -> VecDeque<PendingItem<T>> {
        self.holds.0.fetch_sub(std::mem::take(&mut self.bytes), Relaxed);
        std::mem::take(&mut self.items)
    }

    /// Iterates over the items, the oldest first.
    pub(crate) fn iter(&self) -> impl Iterator<Item = &T> {
        self.items.iter().map(|pending| &pending.item)
    }

    /// Returns the number of items.
    pub(crate) fn len(&self) -> usize {
        self.items.len()
    }

    /// Returns `true` if the queue is empty.
    pub(crate) fn is_empty(&self) -> bool {
        self.items.is_empty()
    }
}

impl<T> Drop for PendingQueue<T> {
    fn drop(&mut self) {
        drop(self.take());
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_oldest_give_way_by_number_and_by_bytes() {
        let (mut queue, now) = (PendingQueue::new(4, Arc::default()), Instant::now());
        assert_eq!((0..6).map(|n| queue.push(now, 10, n)).sum::<u64>(), 2);
        assert_eq!(queue.items.front().map(|item| item.item), Some(2));
        // An item that is larger than the bound is kept alone.
        assert_eq!(queue.push(now, PENDING_BYTES_MAX + 1, 6), 4);
        assert_eq!(queue.push(now, PENDING_BYTES_MAX / 2, 7), 1);
        assert_eq!(queue.push(now, PENDING_BYTES_MAX / 2, 8), 0);
        assert_eq!(queue.push(now, 1, 9), 1);
        assert_eq!(queue.take().into_iter().map(|item| item.item).collect::<Vec<_>>(), [8, 9]);
        assert!(queue.is_empty() && queue.push(now, PENDING_BYTES_MAX, 10) == 0);
    }

    #[test]
    fn large_queue_leaves_room_for_others_and_returns_all_bytes() {
        let (holds, now) = (Arc::<PendingBytes>::default(), Instant::now());
        let mut all: Vec<_> = (0..5).map(|_| PendingQueue::new(9, holds.clone())).collect();
        let given_up =
            all.iter_mut().map(|queue| queue.push(now, PENDING_BYTES_MAX, 'a')).collect::<Vec<_>>();
        assert_eq!(given_up, [0, 0, 0, 0, 1]);
        assert_eq!(all[4].push(now, PENDING_BYTES_MIN, 'b'), 0);
        assert_eq!(all[4].push(now, PENDING_BYTES_MIN + 1, 'c'), 2, "it, and what was to make room for it");
        // The oldest item of the same topic makes room.
        assert_eq!(all[0].push(now, PENDING_BYTES_MAX, 'd'), 1);
        assert!(all[1].pop().is_some() && all[4].push(now, PENDING_BYTES_MAX, 'e') == 0);
        drop(all);
        assert_eq!(holds.0.load(Relaxed), 0);
    }
}
