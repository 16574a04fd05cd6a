//! [`Intake`]: a DDS reader, the queue between it and the receiver of its samples, and the thread that hands them
//! over.
//!
//! Cyclone calls a listener on the thread that received a sample, which all readers of a domain share, with the
//! writer's lock held. The listener takes the sample. Work of a [`Receiver`] that needs no waiting is done right
//! there, because waking another thread takes longer than all the rest. Other samples are queued, within bounds, for
//! the reader's thread. That thread may block for any time: no other reader waits for it, and the order of samples
//! stays.
//!
//! A `KEEP_ALL` writer waits for acknowledgements, and those for the receiving thread. So where many samples of a
//! reliable topic are queued, the receiving thread waits for the reader's thread: briefly and at most half of the
//! time while a queue is crowded; until there is room while the queue is half full of short samples. Other readers
//! thus lose at most half of that thread's time to a slow one.

use std::cell::Cell;
use std::collections::VecDeque;
use std::ffi::c_void;
use std::mem::MaybeUninit;
use std::sync::{Arc, Condvar, Mutex, MutexGuard, PoisonError};
use std::thread;
use std::time::{Duration, Instant};

use cyclors::{
    DDS_ANY_STATE, dds_create_listener, dds_create_reader, dds_delete_listener, dds_entity_t,
    dds_instance_handle_t, dds_liveliness_changed_status_t, dds_lset_data_available,
    dds_lset_liveliness_changed, dds_sample_info_t, dds_takecdr, ddsi_serdata,
};
use sgc_ros::{EndpointKind, EndpointSpec, Guid, RELIABLE_READER_DEPTH_MIN};
use sgc_sync::lock;

use crate::announced;
use crate::entity::{Entity, reason};
use crate::first_messages;
use crate::participant::Participant;
use crate::qos::history_of;
use crate::wait::join;

/// Samples taken from Cyclone at once.
const BATCH: usize = 16;

/// Most queued bytes of one reader; a single sample may be longer.
pub const WAITING_BYTES_MAX: usize = 64 << 20;

/// Shortest queue of a reliable reader that asks for [`RELIABLE_READER_DEPTH_MIN`] or more. Fast DDS does not
/// announce whether a publisher is `KEEP_ALL`. Such a publisher loses nothing to a reader on its own network, and may
/// be faster than this thread by the length of a burst.
const RELIABLE_WAITING_MIN: usize = 16_384;

/// Most queued liveliness changes of one reader. The oldest give way.
const LIVELINESS_CHANGES_MAX: usize = 1024;

/// Longest wait of the receiving thread for a reader's thread at once while a queue is crowded.
const HOLD_MAX: Duration = Duration::from_millis(2);

/// Longest wait of the receiving thread for room in a queue that is half full of samples. Fast DDS acknowledges late,
/// and a path may stand still for that long.
const ROOM_WAIT_MAX: Duration = Duration::from_millis(200);

/// Pause after a wait for room in vain, because the path is too slow for the publisher.
const ROOM_WAIT_PAUSE: Duration = Duration::from_millis(200);

/// Divisor: the receiving thread waits from time to time once a queue is full to one part in this many, until it has
/// sunk to half of that.
const CROWDED_PART: usize = 8;

/// Divisor: the receiving thread takes no more than the reader's thread while more than one part in this many of the
/// allowed samples is queued. Only short samples come by the thousand; other readers should not wait for long samples
/// of a camera.
const FULL_PART: usize = 2;

/// Fewest samples that the reader's thread takes before it wakes a receiving thread that waits for room.
const ROOM_SAMPLES: usize = 16;

thread_local! {
    /// `true` while this thread is in a listener.
    static IS_LISTENING: Cell<bool> = const { Cell::new(false) };
}

/// A sample converted from Cyclone's.
pub(crate) trait FromSerdata: Send + Sized {
    /// Takes over a reference. Returns `None` for an unusable sample.
    ///
    /// # Safety
    /// The caller owns one reference to `sample`, which is of the type that `Self` is made of.
    unsafe fn from_raw(sample: *mut ddsi_serdata) -> Option<Self>;

    /// Returns the length of the payload in bytes.
    fn bytes(&self) -> usize;
}

/// A sample with the reader's information on it.
#[derive(Debug)]
pub(crate) struct Arrival<S> {
    pub(crate) sample: S,
    /// The writer, by the reader's handle.
    pub(crate) writer: dds_instance_handle_t,
    pub(crate) source_timestamp_ns: i64,
}

/// A change of a writer's liveliness.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) struct LivelinessChange {
    pub(crate) writer: dds_instance_handle_t,
    pub(crate) now: WriterState,
}

/// The state of a writer.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum WriterState {
    Alive,
    /// The lease expired.
    Lapsed,
    /// The writer is no longer matched.
    Gone,
}

/// An entry of a queue.
#[derive(Debug)]
enum Next<S> {
    Sample(Arrival<S>),
    Liveliness(LivelinessChange),
}

/// A receiver of an intake's samples, one after the other.
pub(crate) trait Receiver: Send + 'static {
    /// The samples of the reader's topic.
    type Sample: FromSerdata;

    /// Receives a sample of this reader. May block.
    fn receive(&mut self, reader: dds_entity_t, arrival: Arrival<Self::Sample>);

    /// Receives a sample if that needs neither waiting nor a call into Cyclone. Returns it otherwise.
    fn receive_at_once(&mut self, arrival: Arrival<Self::Sample>) -> Option<Arrival<Self::Sample>> {
        Some(arrival)
    }

    /// Receives a change of a writer's liveliness, after the samples that came before it.
    fn receive_liveliness(&mut self, reader: dds_entity_t, change: LivelinessChange) {
        let _ = (reader, change);
    }

    /// Signals that no more samples are at hand.
    fn rest(&mut self) {}

    /// Reports samples that were dropped because newer ones arrived faster than they were received.
    fn overrun(&mut self, samples: u64);
}

/// The queue of a reader.
#[derive(Debug)]
struct Queue<S> {
    arrivals: VecDeque<Arrival<S>>,
    bytes: usize,
    /// Most queued samples.
    depth: usize,
    /// The numbers of samples that were queued so far, and that left the queue.
    pushed: u64,
    popped: u64,
    /// Changes of liveliness, each with the number of samples before it.
    changes: VecDeque<(u64, LivelinessChange)>,
    overrun: u64,
    thread: ThreadState,
    receiving: ReceivingState,
    /// The time before which the receiving thread does not wait for room again.
    no_wait_before: Option<Instant>,
}

/// The state of a reader's thread.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum ThreadState {
    Working,
    /// The thread sleeps until an entry is queued.
    Waiting,
    /// The thread ends and takes nothing more.
    Stopped,
}

/// The state of the receiving thread towards one reader.
#[derive(Clone, Copy, Debug)]
enum ReceivingState {
    Free,
    /// The receiving thread waits until the queue has sunk to the level.
    Held {
        until: Level,
        is_stuck: bool,
    },
    /// The receiving thread waited in vain, and nothing was taken since.
    Stuck,
}

/// An amount of samples in a queue.
#[derive(Clone, Copy, Debug)]
struct Level {
    samples: usize,
    bytes: usize,
}

impl<S: FromSerdata> Queue<S> {
    fn new(depth: usize) -> Self {
        Self {
            arrivals: VecDeque::new(),
            bytes: 0,
            depth,
            pushed: 0,
            popped: 0,
            changes: VecDeque::new(),
            overrun: 0,
            thread: ThreadState::Working,
            receiving: ReceivingState::Free,
            no_wait_before: None,
        }
    }

    /// Returns one part in `part` of the allowed amount.
    fn level(&self, part: usize) -> Level {
        Level { samples: self.depth / part, bytes: WAITING_BYTES_MAX / part }
    }

    /// Returns `true` if the queue holds more than `level`.
    fn is_above(&self, level: Level) -> bool {
        self.arrivals.len() > level.samples || self.bytes > level.bytes
    }

    fn is_full_to(&self, part: usize) -> bool {
        self.is_above(self.level(part))
    }

    /// Appends a sample. The oldest samples give way if there is no room.
    fn push(&mut self, arrival: Arrival<S>) {
        let bytes = arrival.sample.bytes();
        while (self.arrivals.len() >= self.depth || self.bytes + bytes > WAITING_BYTES_MAX)
            && self.pop().is_some()
        {
            self.overrun += 1;
        }
        self.bytes += bytes;
        self.pushed += 1;
        self.arrivals.push_back(arrival);
    }

    /// Appends a change of liveliness behind the queued samples.
    fn push_change(&mut self, change: LivelinessChange) {
        if self.changes.len() >= LIVELINESS_CHANGES_MAX {
            self.changes.pop_front();
            tracing::debug!("a change of liveliness is dropped: too many wait");
        }
        self.changes.push_back((self.pushed, change));
    }

    fn is_stopped(&self) -> bool {
        self.thread == ThreadState::Stopped
    }

    /// Returns `true` if the thread sleeps. The caller wakes it.
    fn begin_to_wake(&mut self) -> bool {
        let is_waiting = self.thread == ThreadState::Waiting;
        if is_waiting {
            self.thread = ThreadState::Working;
        }
        is_waiting
    }

    fn is_empty(&self) -> bool {
        self.arrivals.is_empty() && self.changes.is_empty()
    }

    fn pop(&mut self) -> Option<Arrival<S>> {
        let arrival = self.arrivals.pop_front()?;
        self.bytes -= arrival.sample.bytes();
        self.popped += 1;
        Some(arrival)
    }

    /// Takes the oldest entry, and tells whether the receiving thread may continue.
    fn next(&mut self) -> (Option<Next<S>>, bool) {
        let is_due = self.changes.front().is_some_and(|(behind, _)| *behind <= self.popped);
        if let Some((_, change)) = is_due.then(|| self.changes.pop_front()).flatten() {
            return (Some(Next::Liveliness(change)), false);
        }
        let next = self.pop().map(Next::Sample);
        let may_go_on = match self.receiving {
            ReceivingState::Held { until, .. } => !self.is_above(until),
            ReceivingState::Free | ReceivingState::Stuck => false,
        };
        self.receiving = match self.receiving {
            ReceivingState::Held { until, .. } if !may_go_on => {
                ReceivingState::Held { until, is_stuck: false }
            }
            _ => ReceivingState::Free,
        };
        (next, may_go_on)
    }
}

/// The state that the listener and the reader's thread share.
struct IntakeState<R: Receiver> {
    queue: Mutex<Queue<R::Sample>>,
    filled: Condvar,
    /// Signals that the receiving thread may continue.
    eased: Condvar,
    /// `true` if writers should wait rather than lose samples.
    holds_back: bool,
    /// The receiver, `None` until the start. Locked while samples are handled, to keep their order. It is locked
    /// before the queue or by `try_lock` only.
    receiver: Mutex<Option<R>>,
    participant: Arc<Participant>,
}

impl<R: Receiver> IntakeState<R> {
    /// Takes the reader's samples. Called in its listener.
    fn take(&self, reader: dds_entity_t) {
        let mut samples: [*mut ddsi_serdata; BATCH] = [std::ptr::null_mut(); BATCH];
        let mut infos: [MaybeUninit<dds_sample_info_t>; BATCH] = [const { MaybeUninit::uninit() }; BATCH];
        loop {
            // SAFETY: both arrays have room for so many; the samples' references become ours.
            let taken = unsafe {
                dds_takecdr(
                    reader,
                    samples.as_mut_ptr(),
                    BATCH as u32,
                    infos.as_mut_ptr().cast(),
                    DDS_ANY_STATE,
                )
            };
            let Ok(taken) = usize::try_from(taken) else {
                tracing::error!(reason = reason(taken), "taking samples failed");
                return;
            };
            for (sample, info) in samples.iter().zip(&infos).take(taken) {
                // SAFETY: Cyclone filled the first `taken` of both arrays and gave us a reference to each sample, whose
                // type is that of this reader's topic.
                let (sample, info) = unsafe { (R::Sample::from_raw(*sample), info.assume_init_ref()) };
                // Cyclone makes up changes of instance state, without a payload.
                if let Some(sample) = sample.filter(|_| info.valid_data) {
                    let (writer, source_timestamp_ns) = (info.publication_handle, info.source_timestamp);
                    self.arrive(Arrival { sample, writer, source_timestamp_ns });
                }
            }
            if taken < BATCH {
                return;
            }
        }
    }

    /// Lets the receiver handle a sample at once, or queues it.
    fn arrive(&self, arrival: Arrival<R::Sample>) {
        let mut queue = lock(&self.queue);
        let mut arrival = Some(arrival);
        if queue.is_empty()
            && !queue.is_stopped()
            && let Some(began) = self.participant.pace().begin()
            && let Ok(mut receiver) = self.receiver.try_lock()
            && let Some(receiver) = receiver.as_mut()
        {
            drop(queue);
            arrival = arrival.and_then(|a| receiver.receive_at_once(a));
            self.participant.pace().end(began);
            // Cyclone calls one listener of a reader at a time, so no sample came in between.
            queue = lock(&self.queue);
        }
        let Some(arrival) = arrival.filter(|_| !queue.is_stopped()) else { return };
        if self.holds_back {
            queue = self.wait_for_room(queue);
        }
        queue.push(arrival);
        if queue.begin_to_wake() {
            drop(queue);
            self.filled.notify_one();
        } else if self.holds_back
            && queue.is_full_to(CROWDED_PART)
            && !matches!(queue.receiving, ReceivingState::Stuck)
        {
            self.hold_back(queue);
        }
    }

    /// Queues a change of liveliness. Called in the listener.
    fn change_liveliness(&self, change: LivelinessChange) {
        let mut queue = lock(&self.queue);
        if queue.is_stopped() {
            return;
        }
        queue.push_change(change);
        if queue.begin_to_wake() {
            drop(queue);
            self.filled.notify_one();
        }
    }

    /// Makes the receiving thread, and so the writer, wait briefly for the reader's thread.
    fn hold_back(&self, queue: MutexGuard<'_, Queue<R::Sample>>) {
        let Some(began) = self.participant.holds().begin() else { return };
        let until = queue.level(2 * CROWDED_PART);
        drop(self.wait_until(queue, until, HOLD_MAX));
        self.participant.holds().end(began);
    }

    /// Waits until there is room for a sample in a queue of many.
    fn wait_for_room<'a>(&self, queue: MutexGuard<'a, Queue<R::Sample>>) -> MutexGuard<'a, Queue<R::Sample>> {
        let full = Level { bytes: usize::MAX, ..queue.level(FULL_PART) };
        let waits = queue.no_wait_before.is_none_or(|at| Instant::now() >= at);
        if !queue.is_above(full) || !waits || queue.is_stopped() {
            return queue;
        }
        let room = Level { samples: full.samples.saturating_sub(ROOM_SAMPLES), ..full };
        let mut queue = self.wait_until(queue, room, ROOM_WAIT_MAX);
        queue.no_wait_before = queue.is_above(room).then(|| Instant::now() + ROOM_WAIT_PAUSE);
        queue
    }

    /// Waits until the queue has sunk to `level`, at most for the given time.
    fn wait_until<'a>(
        &self,
        mut queue: MutexGuard<'a, Queue<R::Sample>>,
        level: Level,
        at_most: Duration,
    ) -> MutexGuard<'a, Queue<R::Sample>> {
        queue.receiving = ReceivingState::Held { until: level, is_stuck: true };
        let waited = self.eased.wait_timeout_while(queue, at_most, |q| {
            matches!(q.receiving, ReceivingState::Held { .. }) && !q.is_stopped()
        });
        let mut queue = waited.unwrap_or_else(PoisonError::into_inner).0;
        queue.receiving = match queue.receiving {
            ReceivingState::Held { is_stuck: true, .. } | ReceivingState::Stuck => ReceivingState::Stuck,
            ReceivingState::Held { is_stuck: false, .. } | ReceivingState::Free => ReceivingState::Free,
        };
        queue
    }

    /// Hands queued samples over and waits for more, until it is stopped. Runs on the reader's thread.
    fn serve(&self, reader: dds_entity_t) {
        loop {
            if let Some(receiver) = lock(&self.receiver).as_mut() {
                loop {
                    let ((next, may_go_on), overrun, is_stopped) = {
                        let mut queue = lock(&self.queue);
                        (queue.next(), std::mem::take(&mut queue.overrun), queue.is_stopped())
                    };
                    if may_go_on {
                        self.eased.notify_one();
                    }
                    if overrun > 0 {
                        receiver.overrun(overrun);
                    }
                    match next {
                        _ if is_stopped => break,
                        Some(Next::Sample(arrival)) => receiver.receive(reader, arrival),
                        Some(Next::Liveliness(change)) => receiver.receive_liveliness(reader, change),
                        None => break,
                    }
                }
                receiver.rest();
            }
            let mut queue = lock(&self.queue);
            while queue.is_empty() && !queue.is_stopped() {
                queue.thread = ThreadState::Waiting;
                queue = self.filled.wait(queue).unwrap_or_else(PoisonError::into_inner);
            }
            if queue.is_stopped() {
                return;
            }
            queue.thread = ThreadState::Working;
        }
    }

    fn stop(&self) {
        lock(&self.queue).thread = ThreadState::Stopped;
        self.filled.notify_one();
        self.eased.notify_one();
    }
}

/// Cyclone's entities and the argument of their listener. They drop in this order: children first, then the
/// listener's argument when nothing calls it any more.
struct Entities<R: Receiver> {
    reader: Entity,
    _group: Option<Entity>,
    _topic: Entity,
    shared: Arc<IntakeState<R>>,
}

impl<R: Receiver> Entities<R> {
    /// Hands samples over until it is stopped. It takes `self` whole, because a closure would capture single fields.
    fn serve(self) {
        self.shared.serve(self.reader.handle());
    }
}

/// A reader and its thread. Dropping it ends the thread, waits for a receiver at work, and deletes the entities.
pub(crate) struct Intake<R: Receiver> {
    guid: Guid,
    handle: dds_entity_t,
    shared: Arc<IntakeState<R>>,
    /// The entities, which the thread takes over.
    entities: Option<Entities<R>>,
    thread: Option<thread::JoinHandle<()>>,
}

impl<R: Receiver> Intake<R> {
    /// Creates a reader of `topic`, whose samples are `R::Sample`. `user_data` is added to its USER_DATA. Samples are
    /// queued until the start.
    pub(crate) fn new(
        participant: &Arc<Participant>,
        spec: &EndpointSpec,
        topic: Entity,
        user_data: &str,
    ) -> Result<Self, String> {
        let qos = participant.endpoint_qos(EndpointKind::Reader, spec, user_data)?;
        let group = participant.group(EndpointKind::Reader, spec)?;
        let parent = group.as_ref().unwrap_or(participant.entity()).handle();
        let (_, depth) = history_of(EndpointKind::Reader, spec.qos.history, spec.keyless);
        let (depth, deep) = (usize::try_from(depth).unwrap_or(1), RELIABLE_READER_DEPTH_MIN as usize);
        // A reader that asks for less wants the newest samples only.
        let is_deep = spec.qos.is_reliable() && depth >= deep;
        let shared = Arc::new(IntakeState {
            queue: Mutex::new(Queue::new(if is_deep { depth.max(RELIABLE_WAITING_MIN) } else { depth })),
            filled: Condvar::new(),
            eased: Condvar::new(),
            holds_back: is_deep,
            receiver: Mutex::new(None),
            participant: Arc::clone(participant),
        });
        let arg = Arc::as_ptr(&shared).cast_mut().cast::<c_void>();
        // SAFETY: the listener is copied by the call that makes the reader, as is the QoS, and deleted once. `arg` outlives
        // the reader, whose deletion waits for its listener: see `Entities`.
        let reader = unsafe {
            let listener = dds_create_listener(arg);
            dds_lset_data_available(listener, Some(arrived::<R>));
            dds_lset_liveliness_changed(listener, Some(liveliness_changed::<R>));
            if spec.qos.is_reliable() {
                first_messages::listen(listener);
            }
            let reader = announced::asking(spec.asks_key_hash, || {
                dds_create_reader(parent, topic.handle(), qos.as_ptr(), listener)
            });
            dds_delete_listener(listener);
            Entity::new(reader)?
        };
        let (guid, handle) = (reader.guid()?, reader.handle());
        let entities = Entities { reader, _group: group, _topic: topic, shared: Arc::clone(&shared) };
        Ok(Self { guid, handle, shared, entities: Some(entities), thread: None })
    }

    /// Starts to receive samples, by a thread with this name unless it happens at once.
    pub(crate) fn start(&mut self, name: &str, receiver: R) -> Result<(), String> {
        let Some(entities) = self.entities.take() else { return Err("it is started".into()) };
        *lock(&self.shared.receiver) = Some(receiver);
        let thread = thread::Builder::new()
            .name(name.into())
            .spawn(move || entities.serve())
            .map_err(|e| e.to_string())?;
        self.thread = Some(thread);
        Ok(())
    }

    /// Returns the GUID of the reader, as others discover it.
    pub(crate) fn guid(&self) -> Guid {
        self.guid
    }

    /// Returns the reader's handle, for calls into Cyclone while `self` lives.
    pub(crate) fn handle(&self) -> dds_entity_t {
        self.handle
    }
}

impl<R: Receiver> Drop for Intake<R> {
    fn drop(&mut self) {
        self.shared.stop();
        // The thread waits for the listener, so a listener that drops its own reader must not wait for the thread.
        if let Some(thread) = self.thread.take()
            && !IS_LISTENING.get()
        {
            join(thread);
        }
    }
}

impl<R: Receiver> std::fmt::Debug for Intake<R> {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.debug_struct("Intake").field("guid", &self.guid).finish_non_exhaustive()
    }
}

/// The listener.
unsafe extern "C" fn arrived<R: Receiver>(reader: dds_entity_t, arg: *mut c_void) {
    // SAFETY: what the listener was made with, which lives until the reader is deleted.
    let shared = unsafe { &*arg.cast::<IntakeState<R>>() };
    IS_LISTENING.set(true);
    shared.take(reader);
    IS_LISTENING.set(false);
}

/// The listener of liveliness. Cyclone calls it for each change of one writer.
unsafe extern "C" fn liveliness_changed<R: Receiver>(
    _: dds_entity_t,
    status: dds_liveliness_changed_status_t,
    arg: *mut c_void,
) {
    // SAFETY: what the listener was made with, which lives until the reader is deleted.
    let shared = unsafe { &*arg.cast::<IntakeState<R>>() };
    let now = match (status.alive_count_change, status.not_alive_count_change) {
        (1.., _) => WriterState::Alive,
        (_, 1..) => WriterState::Lapsed,
        _ => WriterState::Gone,
    };
    shared.change_liveliness(LivelinessChange { writer: status.last_publication_handle, now });
}

#[cfg(test)]
mod tests {
    use super::*;

    impl FromSerdata for usize {
        unsafe fn from_raw(sample: *mut ddsi_serdata) -> Option<Self> {
            Some(sample as Self)
        }

        fn bytes(&self) -> usize {
            *self
        }
    }

    /// Returns the lengths of the queued samples, and the number of dropped ones.
    fn waits(depth: usize, all: impl IntoIterator<Item = usize>) -> (Vec<usize>, u64) {
        let mut queue = Queue::new(depth);
        for bytes in all {
            queue.push(Arrival { sample: bytes, writer: 1, source_timestamp_ns: 0 });
            assert!(queue.bytes <= WAITING_BYTES_MAX.max(bytes));
        }
        let waits = std::iter::from_fn(|| queue.pop()).map(|a| a.sample).collect();
        assert_eq!(queue.bytes, 0);
        (waits, queue.overrun)
    }

    #[test]
    fn queue_is_bounded_in_samples_and_bytes() {
        assert_eq!(waits(3, 10..15), (vec![12, 13, 14], 2));
        const HALF: usize = WAITING_BYTES_MAX / 2;
        assert_eq!(waits(9, [5, HALF, HALF]), (vec![HALF, HALF], 1));
        assert_eq!(waits(9, [5, 7, WAITING_BYTES_MAX + 1]), (vec![WAITING_BYTES_MAX + 1], 2));
        assert_eq!(waits(9, [WAITING_BYTES_MAX + 1, 6]), (vec![6], 1));
    }

    #[test]
    fn held_reader_continues_once_half_of_the_queue_is_gone() {
        let mut queue = Queue::new(16 * CROWDED_PART);
        let push = |queue: &mut Queue<usize>, bytes| {
            queue.push(Arrival { sample: bytes, writer: 1, source_timestamp_ns: 0 });
            queue.is_full_to(CROWDED_PART)
        };
        assert!((0..16).all(|_| !push(&mut queue, 1)) && push(&mut queue, 1));
        queue.receiving = ReceivingState::Held { until: queue.level(2 * CROWDED_PART), is_stuck: true };
        for _ in 0..8 {
            assert!(!queue.next().1);
        }
        assert!(queue.next().1 && matches!(queue.receiving, ReceivingState::Free));
        assert!(!queue.next().1, "it was told");
        assert!(push(&mut queue, WAITING_BYTES_MAX / CROWDED_PART), "bytes count as well");
    }

    #[test]
    fn changes_of_liveliness_keep_their_place_among_samples_and_have_a_bound() {
        let mut queue = Queue::new(3);
        let change = |writer| LivelinessChange { writer, now: WriterState::Lapsed };
        let sample = |bytes| Arrival { sample: bytes, writer: 1, source_timestamp_ns: 0 };
        queue.push_change(change(1));
        (0..2).for_each(|bytes| queue.push(sample(bytes)));
        queue.push_change(change(2));
        // The first sample gives way.
        (2..4).for_each(|bytes| queue.push(sample(bytes)));
        let order = std::iter::from_fn(|| match queue.next().0? {
            Next::Sample(arrival) => Some(format!("sample {}", arrival.sample)),
            Next::Liveliness(change) => Some(format!("change {}", change.writer)),
        });
        assert_eq!(order.collect::<Vec<_>>(), ["change 1", "sample 1", "change 2", "sample 2", "sample 3"]);
        let many = LIVELINESS_CHANGES_MAX as u64 + 7;
        (0..many).for_each(|writer| queue.push_change(change(writer)));
        assert_eq!(queue.changes.len(), LIVELINESS_CHANGES_MAX);
        assert!(matches!(queue.next().0, Some(Next::Liveliness(c)) if c.writer == 7));
    }
}
