//! [`Queue`]: the messages queued for one subscriber, bounded by number and bytes.

use std::collections::VecDeque;
use std::sync::atomic::{AtomicUsize, Ordering};
use std::sync::{Arc, Condvar, Mutex, MutexGuard, PoisonError};

use sgc_sync::lock;
use tokio::sync::Notify;

use crate::message::Message;
use crate::quota::PendingBytes;

/// Cost of a message in bytes beside its payload, because queues of very short messages are not free.
pub(crate) const MESSAGE_COST_BYTES: usize = 256;

/// The treatment of a message without room.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub(crate) enum Overflow {
    /// The oldest message is dropped and counted.
    #[default]
    DropOldest,
    /// The reader waits, and all its subscribers with it. Only for a subscriber that has its own reader.
    Wait,
}

#[derive(Debug, Default)]
struct State {
    messages: VecDeque<Arc<Message>>,
    bytes: usize,
    dropped: u64,
    is_closed: bool,
    /// `true` while a full queue does not hold up its reader.
    lets_pass: bool,
}

/// The messages queued for one subscriber.
#[derive(Debug)]
pub(crate) struct Queue {
    state: Mutex<State>,
    filled: Notify,
    room: Condvar,
    depth: AtomicUsize,
    bytes_max: usize,
    /// The bytes in all queues of the client, including this one.
    waiting: Arc<PendingBytes>,
    overflow: Overflow,
}

impl Queue {
    /// Creates a queue that shares `waiting` with the client's other queues. `bytes_max` bounds a queue that holds up
    /// its reader, because no other queue makes room for it.
    pub(crate) fn new(
        depth: usize,
        bytes_max: usize,
        waiting: Arc<PendingBytes>,
        overflow: Overflow,
    ) -> Self {
        let (state, filled, room) = (Mutex::default(), Notify::new(), Condvar::new());
        let depth = AtomicUsize::new(depth.max(1));
        Self { state, filled, room, depth, bytes_max, waiting, overflow }
    }

    /// Sets the number of messages that may be queued.
    pub(crate) fn set_depth(&self, depth: usize) {
        self.depth.store(depth.max(1), Ordering::Relaxed);
    }

    fn lock(&self) -> MutexGuard<'_, State> {
        lock(&self.state)
    }

    fn has_room(&self, state: &State, bytes: usize) -> bool {
        let has_bytes = match self.overflow {
            Overflow::DropOldest => self.waiting.has_room(bytes),
            Overflow::Wait => state.bytes.saturating_add(bytes) <= self.bytes_max,
        };
        let depth = self.depth.load(Ordering::Relaxed);
        let fits = state.messages.len() < depth && has_bytes;
        // A message longer than the bound passes alone.
        fits || state.messages.is_empty()
    }

    /// Returns `true` if a message of this length would have to wait.
    pub(crate) fn would_wait(&self, bytes: usize) -> bool {
        if self.overflow == Overflow::DropOldest {
            return false;
        }
        let state = self.lock();
        !state.is_closed && !state.lets_pass && !self.has_room(&state, bytes + MESSAGE_COST_BYTES)
    }

    /// Sets whether messages without room are queued all the same instead of waiting.
    pub(crate) fn let_pass(&self, lets_pass: bool) {
        self.lock().lets_pass = lets_pass;
        self.room.notify_all();
    }

    /// Appends a message.
    pub(crate) fn push(&self, message: &Arc<Message>) {
        let bytes = cost(message);
        let mut state = self.lock();
        while !state.is_closed && !self.has_room(&state, bytes) {
            match self.overflow {
                Overflow::Wait if state.lets_pass => break,
                Overflow::Wait => state = self.room.wait(state).unwrap_or_else(PoisonError::into_inner),
                Overflow::DropOldest => {
                    if let Some(oldest) = state.messages.pop_front() {
                        state.bytes -= cost(&oldest);
                        self.waiting.sub(cost(&oldest));
                        state.dropped += 1;
                    }
                }
            }
        }
        if state.is_closed {
            return;
        }
        state.bytes += bytes;
        self.waiting.add(bytes);
        state.messages.push_back(Arc::clone(message));
        drop(state);
        self.filled.notify_one();
    }

    /// Counts messages lost before they reached the queue.
    pub(crate) fn add_dropped(&self, messages: u64) {
        self.lock().dropped += messages;
    }

    /// Returns the oldest message, if any, and the number of dropped messages so far.
    pub(crate) fn pop(&self) -> Option<(Arc<Message>, u64)> {
        let mut state = self.lock();
        let message = state.messages.pop_front()?;
        state.bytes -= cost(&message);
        self.waiting.sub(cost(&message));
        let dropped = state.dropped;
        drop(state);
        if self.overflow == Overflow::Wait {
            self.room.notify_one();
        }
        Some((message, dropped))
    }

    /// Waits for a message. Returns `None` once the queue is closed and empty.
    pub(crate) async fn next(&self) -> Option<(Arc<Message>, u64)> {
        loop {
            let filled = self.filled.notified();
            if let Some(next) = self.pop() {
                return Some(next);
            }
            if self.lock().is_closed {
                return None;
            }
            filled.await;
        }
    }

    pub(crate) fn dropped(&self) -> u64 {
        self.lock().dropped
    }

    /// Drops all queued messages.
    pub(crate) fn clear(&self) {
        let mut state = self.lock();
        self.waiting.sub(state.bytes);
        (state.messages, state.bytes) = (VecDeque::new(), 0);
    }

    /// Closes the queue. A reader that waits for room continues.
    pub(crate) fn close(&self) {
        self.lock().is_closed = true;
        self.room.notify_all();
        self.filled.notify_one();
    }
}

impl Drop for Queue {
    fn drop(&mut self) {
        let bytes = self.lock().bytes;
        self.waiting.sub(bytes);
    }
}

/// Returns the bytes for which a message counts.
pub(crate) fn cost(message: &Message) -> usize {
    message.payload.len() + MESSAGE_COST_BYTES
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Room for 100 bytes in two messages.
    const ROOM: usize = 100 + 2 * MESSAGE_COST_BYTES;

    fn message(bytes: usize) -> Arc<Message> {
        Arc::new(Message::new(vec![0; bytes].into(), None, 0))
    }

    #[test]
    fn queues_of_a_client_share_what_may_wait() {
        let waiting = PendingBytes::for_own_client(ROOM);
        let queue = || Queue::new(9, ROOM, Arc::clone(&waiting), Overflow::DropOldest);
        let (one, other) = (queue(), queue());
        one.push(&message(80));
        for _ in 0..3 {
            other.push(&message(30));
        }
        // Each queue may hold one message in any case.
        assert_eq!((one.dropped(), other.dropped(), waiting.bytes()), (0, 2, 110 + 2 * MESSAGE_COST_BYTES));
        drop(one);
        other.push(&message(30));
        assert_eq!((other.dropped(), waiting.bytes()), (2, 60 + 2 * MESSAGE_COST_BYTES));
    }

    #[tokio::test]
    async fn the_oldest_gives_way_and_is_counted() {
        let queue = Queue::new(2, ROOM, PendingBytes::for_own_client(ROOM), Overflow::DropOldest);
        for bytes in [10, 20, 30] {
            queue.push(&message(bytes));
        }
        let lengths = |next: Option<(Arc<Message>, u64)>| next.map(|(m, dropped)| (m.payload.len(), dropped));
        assert_eq!(lengths(queue.next().await), Some((20, 1)));
        // The bound in bytes holds, too. A message longer than the bound passes alone.
        queue.push(&message(90));
        assert_eq!((lengths(queue.pop()), queue.dropped()), (Some((90, 2)), 2));
        queue.push(&message(1));
        queue.push(&message(1000));
        assert_eq!(lengths(queue.pop()), Some((1000, 3)));
        queue.close();
        assert!(queue.next().await.is_none());
    }

    #[test]
    fn waiting_push_continues_with_room_or_at_the_end() {
        let queue = Arc::new(Queue::new(1, ROOM, PendingBytes::for_own_client(ROOM), Overflow::Wait));
        queue.push(&message(1));
        assert!(queue.would_wait(1));
        let pusher = {
            let queue = queue.clone();
            std::thread::spawn(move || {
                queue.push(&message(2));
                queue.push(&message(3));
            })
        };
        assert_eq!(queue.pop().unwrap().0.payload.len(), 1);
        queue.close();
        pusher.join().unwrap();
        assert!(!queue.would_wait(1));
    }

    #[test]
    fn waiting_push_can_be_let_pass() {
        let queue = Arc::new(Queue::new(1, ROOM, PendingBytes::for_own_client(ROOM), Overflow::Wait));
        queue.push(&message(1));
        let pusher = {
            let queue = queue.clone();
            std::thread::spawn(move || queue.push(&message(2)))
        };
        queue.let_pass(true);
        pusher.join().unwrap();
        queue.let_pass(false);
        assert!(queue.would_wait(1));
        assert_eq!([queue.pop(), queue.pop()].map(|next| next.unwrap().0.payload.len()), [1, 2]);
    }
}
