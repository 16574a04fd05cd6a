//! [`Outbox`]: the frames queued for one client. Answers go first and limit how much is read. Messages of topics wait
//! in one lane per subscription and may be dropped.

use std::collections::{BTreeMap, VecDeque};
use std::sync::{Arc, Mutex, MutexGuard};

use sgc_sync::lock;
use sgc_websocket::Message as Frame;
use tokio::sync::Notify;

use crate::message::Message;
use crate::queue::MESSAGE_COST_BYTES;
use crate::quota::PendingBytes;

use super::protocol::message_data;

/// Most queued answers. At the bound nothing more is read from the client.
const ANSWERS_MAX: usize = 256;
/// Most bytes of queued answers.
const ANSWER_BYTES_MAX: usize = 4 << 20;
/// Most queued messages of one subscription.
pub(super) const LANE_MESSAGES_MAX: usize = 1024;

/// The frames queued for one client.
#[derive(Debug)]
pub(super) struct Outbox {
    state: Mutex<State>,
    /// Notified when there is a frame to write.
    filled: Notify,
    /// Notified when there is room for answers again.
    drained: Notify,
}

#[derive(Debug)]
struct State {
    answers: VecDeque<Frame>,
    answer_bytes: usize,
    /// Messages in the order of their arrival.
    messages: BTreeMap<u64, QueuedMessage>,
    lanes: BTreeMap<u32, Lane>,
    next: u64,
    message_bytes: PendingBytes,
}

impl Drop for State {
    fn drop(&mut self) {
        self.message_bytes.sub(self.message_bytes.bytes());
    }
}

#[derive(Debug)]
struct QueuedMessage {
    subscription: u32,
    message: Arc<Message>,
}

/// The messages queued for one subscription.
#[derive(Debug, Default)]
struct Lane {
    numbers: VecDeque<u64>,
    bytes: usize,
    dropped: u64,
}

impl Outbox {
    /// Creates an outbox whose messages are bounded by `message_bytes`.
    pub(super) fn new(message_bytes: PendingBytes) -> Self {
        let state = State {
            answers: VecDeque::new(),
            answer_bytes: 0,
            messages: BTreeMap::new(),
            lanes: BTreeMap::new(),
            next: 0,
            message_bytes,
        };
        Self { state: Mutex::new(state), filled: Notify::new(), drained: Notify::new() }
    }

    fn lock(&self) -> MutexGuard<'_, State> {
        lock(&self.state)
    }

    /// Appends an answer even without room. The reader checks for room before it reads.
    pub(super) fn answer(&self, frame: Frame) {
        let mut state = self.lock();
        state.answer_bytes += frame.payload_bytes();
        state.answers.push_back(frame);
        drop(state);
        self.filled.notify_one();
    }

    /// Returns `true` if requests may be read that need answers.
    pub(super) fn has_room(&self) -> bool {
        let state = self.lock();
        state.answers.len() < ANSWERS_MAX && state.answer_bytes < ANSWER_BYTES_MAX
    }

    /// Waits until there is room.
    pub(super) async fn room(&self) {
        while !self.has_room() {
            self.drained.notified().await;
        }
    }

    /// Appends a message of a subscription. For lack of room the lane with the most bytes loses its oldest message.
    pub(super) fn message(&self, subscription: u32, message: Arc<Message>) {
        let cost = cost(&message);
        let mut state = self.lock();
        if state.lanes.get(&subscription).is_some_and(|lane| lane.numbers.len() >= LANE_MESSAGES_MAX) {
            state.drop_oldest(subscription);
        }
        while !state.message_bytes.has_room(cost) {
            let most = state.lanes.iter().max_by_key(|(_, lane)| lane.bytes);
            match most.filter(|(_, lane)| lane.bytes > 0).map(|(fullest, _)| *fullest) {
                Some(fullest) => state.drop_oldest(fullest),
                // A message longer than the bound passes alone.
                None => break,
            }
        }
        let number = state.next;
        state.next += 1;
        state.message_bytes.add(cost);
        let lane = state.lanes.entry(subscription).or_default();
        lane.numbers.push_back(number);
        lane.bytes += cost;
        state.messages.insert(number, QueuedMessage { subscription, message });
        drop(state);
        self.filled.notify_one();
    }

    /// Drops all messages of a subscription.
    pub(super) fn forget(&self, subscription: u32) {
        let mut state = self.lock();
        let Some(lane) = state.lanes.remove(&subscription) else { return };
        state.message_bytes.sub(lane.bytes);
        for number in lane.numbers {
            state.messages.remove(&number);
        }
    }

    /// Returns the number of dropped messages of a subscription.
    pub(super) fn dropped(&self, subscription: u32) -> u64 {
        self.lock().lanes.get(&subscription).map_or(0, |lane| lane.dropped)
    }

    /// Returns the next frame to write, if any.
    pub(super) fn pop(&self) -> Option<Frame> {
        let mut state = self.lock();
        if let Some(answer) = state.answers.pop_front() {
            state.answer_bytes -= answer.payload_bytes();
            drop(state);
            self.drained.notify_one();
            return Some(answer);
        }
        let (_, QueuedMessage { subscription, message }) = state.messages.pop_first()?;
        let cost = cost(&message);
        state.message_bytes.sub(cost);
        if let Some(lane) = state.lanes.get_mut(&subscription) {
            lane.numbers.pop_front();
            lane.bytes -= cost;
        }
        drop(state);
        Some(Frame::Binary(message_data(subscription, message.received_ns, &message.payload)))
    }

    /// Returns the next answer, if any.
    pub(super) fn pop_answer(&self) -> Option<Frame> {
        let mut state = self.lock();
        let answer = state.answers.pop_front()?;
        state.answer_bytes -= answer.payload_bytes();
        Some(answer)
    }

    /// Waits until a frame may have been queued since the last call. Only one task may wait.
    pub(super) async fn filled(&self) {
        self.filled.notified().await;
    }
}

impl State {
    fn drop_oldest(&mut self, subscription: u32) {
        let Some(lane) = self.lanes.get_mut(&subscription) else { return };
        let Some(number) = lane.numbers.pop_front() else { return };
        lane.dropped += 1;
        if let Some(waiting) = self.messages.remove(&number) {
            let cost = cost(&waiting.message);
            lane.bytes -= cost;
            self.message_bytes.sub(cost);
        }
    }
}

fn cost(message: &Message) -> usize {
    message.payload.len() + MESSAGE_COST_BYTES
}

#[cfg(test)]
mod tests {
    use super::*;

    fn message(bytes: usize) -> Arc<Message> {
        Arc::new(Message::new(vec![0; bytes].into(), None, 0))
    }

    fn outbox(message_bytes_max: usize) -> Outbox {
        let quotas: Arc<crate::quota::Quotas> = Arc::default();
        let quota = quotas.quota(&crate::access::Client::own("test"));
        Outbox::new(PendingBytes::new(message_bytes_max, quota))
    }

    fn popped(outbox: &Outbox) -> Option<(u8, usize)> {
        outbox.pop().map(|frame| {
            let Frame::Binary(bytes) = frame else { panic!() };
            (bytes[1], bytes.len() - 13)
        })
    }

    #[test]
    fn messages_go_in_the_order_in_which_they_came_and_answers_before_them() {
        let outbox = outbox(10_000);
        outbox.message(1, message(10));
        outbox.message(2, message(20));
        outbox.message(1, message(30));
        outbox.answer(Frame::text("answer"));
        assert_eq!(outbox.pop(), Some(Frame::text("answer")));
        assert_eq!([popped(&outbox), popped(&outbox)], [Some((1, 10)), Some((2, 20))]);
        outbox.forget(1);
        assert_eq!(outbox.pop(), None);
        assert_eq!(outbox.lock().message_bytes.bytes(), 0);
    }

    #[test]
    fn longest_lane_gives_way() {
        let outbox = outbox(4 * (1000 + MESSAGE_COST_BYTES));
        outbox.message(7, message(10));
        for _ in 0..5 {
            outbox.message(1, message(1000));
        }
        assert_eq!((outbox.dropped(1), outbox.dropped(7)), (2, 0));
        // A message longer than the bound passes alone.
        outbox.message(2, message(100_000));
        assert_eq!((outbox.dropped(1), outbox.dropped(7)), (5, 1));
        assert_eq!(popped(&outbox), Some((2, 100_000)));
        assert_eq!(outbox.pop(), None);
    }

    #[test]
    fn messages_of_a_subscription_are_bounded() {
        let outbox = outbox(usize::MAX);
        for _ in 0..LANE_MESSAGES_MAX + 3 {
            outbox.message(1, message(0));
        }
        assert_eq!((outbox.dropped(1), outbox.lock().messages.len()), (3, LANE_MESSAGES_MAX));
    }

    #[tokio::test]
    async fn answers_that_nobody_takes_leave_no_room_until_they_are() {
        let outbox = outbox(1);
        for _ in 0..ANSWERS_MAX {
            outbox.answer(Frame::text("x"));
        }
        assert!(!outbox.has_room());
        let waits = outbox.room();
        tokio::pin!(waits);
        tokio::select! {
            biased;
            () = waits.as_mut() => panic!("there is no room"),
            () = std::future::ready(()) => {}
        }
        assert!(outbox.pop().is_some());
        waits.await;
    }
}
