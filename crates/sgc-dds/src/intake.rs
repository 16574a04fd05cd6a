//! [`Intake`]: a DDS reader, the queue between it and the receiver of its samples, and the thread that hands them
//! over.
//!
//! Cyclone calls a listener on the thread that received a sample, which all readers of a domain share, with the
//! writer's lock held. The listener takes the sample. Work of a [`Receiver`] that needs no waiting is done right
//! there, because waking another thread takes longer than all the rest. Other samples are queued, within bounds, for
//! the reader's thread. That thread may block for any time: no other reader waits for it, and the order of samples
//! stays.
//!
//! While a queue of a reliable topic is crowded, the receiving thread waits for the reader's thread: briefly and at
//! most half of the time. So acknowledgements come later, and a `KEEP_ALL` writer becomes slower. Other readers lose at
//! most half of that thread's time to a slow one. If the queue grows all the same, the samples of its writers are
//! [refused](crate::backpressure) until there is room.

use std::cell::Cell;
use std::ffi::c_void;
use std::mem::MaybeUninit;
use std::sync::{Arc, Condvar, Mutex, MutexGuard, PoisonError};
use std::thread;
use std::time::Duration;

use cyclors::{
    DDS_ANY_STATE, dds_create_listener, dds_create_reader, dds_delete_listener, dds_entity_t,
    dds_liveliness_changed_status_t, dds_lset_data_available, dds_lset_liveliness_changed, dds_sample_info_t,
    dds_takecdr, ddsi_serdata,
};
use sgc_ros::{EndpointKind, EndpointSpec, Guid, RELIABLE_READER_DEPTH_MIN};
use sgc_sync::lock;

use crate::announced;
use crate::arrivals::{Arrival, FromSerdata, Level, LivelinessChange, Next, Queue, WriterState};
use crate::backpressure::Progress;
use crate::entity::{Entity, reason};
use crate::first_messages;
use crate::participant::Participant;
use crate::qos::history_of;
use crate::wait::join;

/// Samples taken from Cyclone at once.
const BATCH: usize = 16;

/// Shortest queue of a reliable reader that asks for [`RELIABLE_READER_DEPTH_MIN`] or more. Fast DDS does not
/// announce whether a publisher is `KEEP_ALL`. Such a publisher loses nothing to a reader on its own network, and may
/// be faster than this thread by the length of a burst.
const RELIABLE_WAITING_MIN: usize = 16_384;

/// Longest wait of the receiving thread for a reader's thread at once while a queue is crowded.
const HOLD_MAX: Duration = Duration::from_millis(2);

/// Divisor: the receiving thread waits from time to time once a queue is full to one part in this many, until it has
/// sunk to half of that.
const CROWDED_PART: usize = 8;

thread_local! {
    /// `true` while this thread is in a listener.
    static IS_LISTENING: Cell<bool> = const { Cell::new(false) };
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

/// The state that the listener and the reader's thread share.
struct IntakeState<R: Receiver> {
    queue: Mutex<Queue<R::Sample>>,
    filled: Condvar,
    /// Signals that the receiving thread may continue.
    eased: Condvar,
    /// `true` if writers should wait rather than lose samples.
    holds_back: bool,
    progress: Arc<Progress>,
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
        queue.count_arrival(arrival.writer);
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
        let writer = arrival.writer;
        queue.push(arrival);
        if self.holds_back
            && let Some(writers) = self.participant.remote_writers()
        {
            if self.progress.is_stuck() {
                self.accept(&mut queue);
            } else if let Some(tally) = queue.begin_to_refuse(writer, &self.progress) {
                writers.refuse(writer, &tally);
            }
        }
        if queue.begin_to_wake() {
            drop(queue);
            self.filled.notify_one();
        } else if self.holds_back && queue.is_full_to(CROWDED_PART) && !queue.is_stuck() {
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

    /// Waits until the queue has sunk to `level`, at most for the given time.
    fn wait_until<'a>(
        &self,
        mut queue: MutexGuard<'a, Queue<R::Sample>>,
        level: Level,
        at_most: Duration,
    ) -> MutexGuard<'a, Queue<R::Sample>> {
        queue.begin_hold(level);
        let waited = self.eased.wait_timeout_while(queue, at_most, |queue| queue.is_held());
        let mut queue = waited.unwrap_or_else(PoisonError::into_inner).0;
        queue.end_hold();
        queue
    }

    /// Hands queued samples over and waits for more, until it is stopped. Runs on the reader's thread.
    fn serve(&self, reader: dds_entity_t) {
        loop {
            if let Some(receiver) = lock(&self.receiver).as_mut() {
                loop {
                    let ((next, may_go_on), overrun, is_stopped) = {
                        let mut queue = lock(&self.queue);
                        let next = queue.next();
                        if let Some(Next::Sample(arrival)) = &next.0 {
                            self.progress.advance(arrival.sample.bytes());
                        }
                        self.accept(&mut queue);
                        (next, queue.take_overrun(), queue.is_stopped())
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
                queue.begin_to_wait();
                queue = self.filled.wait(queue).unwrap_or_else(PoisonError::into_inner);
            }
            if !queue.begin_to_work() {
                return;
            }
        }
    }

    /// Accepts the samples of writers again if there is room.
    fn accept(&self, queue: &mut Queue<R::Sample>) {
        if let Some(writers) = self.participant.remote_writers() {
            queue.accept(self.progress.is_stuck(), |writer, tally| writers.accept(writer, tally));
        }
    }

    fn stop(&self) {
        let mut queue = lock(&self.queue);
        queue.stop();
        self.accept(&mut queue);
        drop(queue);
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
            progress: Arc::default(),
            receiver: Mutex::new(None),
            participant: Arc::clone(participant),
        });
        let arg = Arc::as_ptr(&shared).cast_mut().cast::<c_void>();
        // SAFETY: the listener is copied by the call that makes the reader, as is the QoS, and deleted once. `arg`
        // outlives the reader, whose deletion waits for its listener: see `Entities`.
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
