//! What waits for its type to be known: bounded in items and in bytes, the oldest of which make room.
//!
//! It neither converts nor counts; whoever holds things says what becomes of those that are given up.

use std::collections::VecDeque;
use std::sync::Arc;
use std::sync::atomic::{AtomicUsize, Ordering::Relaxed};
use std::time::{Duration, Instant};

/// How long what nobody keeps for late joiners is of use to those who hear of it late.
pub(crate) const HOLD_MAX: Duration = Duration::from_secs(5);
/// Bytes that are held of one topic, but for one message that is larger alone.
pub(crate) const HOLD_BYTES_MAX: usize = 64 << 20;
/// Bytes that are held of all topics of a node.
const HOLDS_BYTES_MAX: usize = 256 << 20;
/// Bytes of one topic that are held however much others hold.
const HOLD_BYTES_MIN: usize = 64 << 10;

/// What all topics of a node hold, bytes.
#[derive(Debug, Default)]
pub(crate) struct Holds(AtomicUsize);

/// Something that is held.
#[derive(Debug)]
pub(crate) struct Held<T> {
    /// Since when.
    pub since: Instant,
    bytes: usize,
    /// What it is.
    pub item: T,
}

impl<T> Held<T> {
    /// Whether it is too late for it.
    pub(crate) fn is_late(&self, now: Instant) -> bool {
        now.saturating_duration_since(self.since) > HOLD_MAX
    }
}

/// What is held, the oldest first.
#[derive(Debug)]
pub(crate) struct Hold<T> {
    items: VecDeque<Held<T>>,
    bytes: usize,
    items_max: usize,
    holds: Arc<Holds>,
}

impl<T> Hold<T> {
    /// Holds nothing yet, and never more than so many.
    pub(crate) fn new(items_max: usize, holds: Arc<Holds>) -> Self {
        Self { items: VecDeque::new(), bytes: 0, items_max, holds }
    }

    /// Takes something in; says how many gave way, it being one of them where all topics hold too much.
    pub(crate) fn push(&mut self, now: Instant, bytes: usize, item: T) -> u64 {
        let mut given_up = 0;
        while self.items.len() >= self.items_max || !self.has_room(bytes) {
            if self.pop().is_none() {
                return given_up + 1;
            }
            given_up += 1;
        }
        self.push_back(Held { since: now, bytes, item });
        given_up
    }

    fn has_room(&self, bytes: usize) -> bool {
        let (all, own) = (self.holds.0.load(Relaxed), self.bytes.saturating_add(bytes));
        let fits = own <= HOLD_BYTES_MAX || self.items.is_empty();
        own <= HOLD_BYTES_MIN || fits && all.saturating_add(bytes) <= HOLDS_BYTES_MAX
    }

    /// Holds on to something, behind the others.
    pub(crate) fn push_back(&mut self, held: Held<T>) {
        self.bytes += held.bytes;
        self.holds.0.fetch_add(held.bytes, Relaxed);
        self.items.push_back(held);
    }

    /// Gives up the oldest for as long as it is late for them and they are of no use then; says how many.
    pub(crate) fn give_up_late(&mut self, now: Instant, is_of_no_use: impl Fn(&T) -> bool) -> u64 {
        let mut given_up = 0;
        while self.items.front().is_some_and(|held| held.is_late(now) && is_of_no_use(&held.item)) {
            given_up += u64::from(self.pop().is_some());
        }
        given_up
    }

    /// Takes the oldest out.
    fn pop(&mut self) -> Option<Held<T>> {
        let held = self.items.pop_front()?;
        self.bytes -= held.bytes;
        self.holds.0.fetch_sub(held.bytes, Relaxed);
        Some(held)
    }

    /// Takes all out.
    pub(crate) fn take(&mut self) -> VecDeque<Held<T>> {
        self.holds.0.fetch_sub(std::mem::take(&mut self.bytes), Relaxed);
        std::mem::take(&mut self.items)
    }

    /// How many there are.
    pub(crate) fn len(&self) -> usize {
        self.items.len()
    }

    /// Whether there are none.
    pub(crate) fn is_empty(&self) -> bool {
        self.items.is_empty()
    }
}

impl<T> Drop for Hold<T> {
    fn drop(&mut self) {
        drop(self.take());
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_oldest_give_way_by_number_and_by_bytes() {
        let (mut hold, now) = (Hold::new(4, Arc::default()), Instant::now());
        assert_eq!((0..6).map(|n| hold.push(now, 10, n)).sum::<u64>(), 2);
        assert_eq!(hold.items.front().map(|held| held.item), Some(2));
        // One that is larger alone is held alone.
        assert_eq!(hold.push(now, HOLD_BYTES_MAX + 1, 6), 4);
        assert_eq!(hold.push(now, HOLD_BYTES_MAX / 2, 7), 1);
        assert_eq!(hold.push(now, HOLD_BYTES_MAX / 2, 8), 0);
        assert_eq!(hold.push(now, 1, 9), 1);
        assert_eq!(hold.take().into_iter().map(|held| held.item).collect::<Vec<_>>(), [8, 9]);
        assert!(hold.is_empty() && hold.push(now, HOLD_BYTES_MAX, 10) == 0);
    }

    #[test]
    fn who_holds_much_leaves_others_a_little_and_gives_all_of_it_back() {
        let (holds, now) = (Arc::<Holds>::default(), Instant::now());
        let mut all: Vec<_> = (0..5).map(|_| Hold::new(9, holds.clone())).collect();
        let given_up = all.iter_mut().map(|hold| hold.push(now, HOLD_BYTES_MAX, 'a')).collect::<Vec<_>>();
        assert_eq!(given_up, [0, 0, 0, 0, 1]);
        assert_eq!(all[4].push(now, HOLD_BYTES_MIN, 'b'), 0);
        assert_eq!(all[4].push(now, HOLD_BYTES_MIN + 1, 'c'), 2, "it, and what was to make room for it");
        // What was held longest makes room in its own topic.
        assert_eq!(all[0].push(now, HOLD_BYTES_MAX, 'd'), 1);
        assert!(all[1].pop().is_some() && all[4].push(now, HOLD_BYTES_MAX, 'e') == 0);
        drop(all);
        assert_eq!(holds.0.load(Relaxed), 0);
    }
}
