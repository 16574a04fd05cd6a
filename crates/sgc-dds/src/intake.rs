//! [`Intake`]: a DDS reader, and the queue between it and the receiver of its samples.
//!
//! Cyclone calls a listener on the thread that received a sample, which all readers of a domain share, with the
//! writer's lock held. The listener takes the sample. Work of a [`Receiver`] that needs no waiting is done right
//! there, because waking another thread takes longer than all the rest. Other samples are queued, within bounds, for
//! a [worker](sgc_sync::Workers) that hands them over. The worker may block for any time: no other reader waits for it,
//! and the order of samples stays.
//!
//! While a queue of a reliable topic is crowded, the receiving thread waits for the worker: briefly and at most half of
//! the time. So acknowledgements come later, and a `KEEP_ALL` writer becomes slower. Other readers lose at most half of
//! that thread's time to a slow one. If the queue grows all the same, the samples of its writers are
//! [refused](crate::backpressure) until there is room.

use std::cell::Cell;
use std::ffi::c_void;
use std::mem::MaybeUninit;
use std::sync::mpsc::{self, Sender};
use std::sync::{Arc, Condvar, Mutex, MutexGuard, PoisonError, Weak};
use std::time::Duration;

use cyclors::{
    DDS_ANY_STATE, dds_create_listener, dds_create_reader, dds_delete_listener, dds_entity_t,
    dds_liveliness_changed_status_t, dds_lset_data_available, dds_lset_liveliness_changed, dds_sample_info_t,
    dds_takecdr, ddsi_serdata,
};
use sgc_ros::{EndpointKind, EndpointSpec, Guid, RELIABLE_READER_DEPTH_MIN};
use sgc_sync::{Work, lock};

use crate::announced;
use crate::arrivals::{Arrival, FromSerdata, Level, LivelinessChange, Next, Queue, WriterState};
use crate::backpressure::Progress;
use crate::entity::{Entity, reason};
use crate::first_messages;
use crate::participant::Participant;
use crate::qos::history_of;

/// Samples taken from Cyclone at once.
const BATCH: usize = 16;

/// Shortest queue of a reliable reader that asks for [`RELIABLE_READER_DEPTH_MIN`] or more. Fast DDS does not
/// announce whether a publisher is `KEEP_ALL`. Such a publisher loses nothing to a reader on its own network, and may
/// be faster than the worker by the length of a burst.
const RELIABLE_WAITING_MIN: usize = 16_384;

/// Longest wait of the receiving thread for a worker at once while a queue is crowded.
const HOLD_MAX: Duration = Duration::from_millis(2);

/// Divisor: the receiving thread waits from time to time once a queue is full to one part in this many, until it has
/// sunk to half of that.
const CROWDED_PART: usize = 8;

thread_local! {
    /// `true` while this thread is in a listener.
    static IS_LISTENING: Cell<bool> = const { Cell::new(false) };
    /// The state of the intake whose samples this thread hands over.
    static SERVED: Cell<*const c_void> = const { Cell::new(std::ptr::null()) };
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

/// The state that the listener and the worker share.
struct IntakeState<R: Receiver> {
    /// Dropped before what the listener uses, because that waits for the listener.
    entities: Mutex<Option<Entities>>,
    /// Itself, for the worker.
    this: Weak<Self>,
    queue: Mutex<Queue<R::Sample>>,
    /// Signals that the receiving thread may continue.
    eased: Condvar,
    /// `true` if writers should wait rather than lose samples.
    holds_back: bool,
    progress: Arc<Progress>,
    /// The receiver, `None` until the start. Locked while samples are handled, to keep their order. It is locked
    /// before the queue or by `try_lock` only.
    receiver: Mutex<Option<R>>,
    participant: Arc<Participant>,
    /// Dropped last.
    _alive: Sender<()>,
}

/// Cyclone's entities, whose listener has the state for its argument. They drop in this order, children first.
struct Entities {
    reader: Entity,
    _group: Option<Entity>,
    _topic: Entity,
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
        if queue.begin_to_work() {
            self.work(queue);
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
        if queue.begin_to_work() {
            self.work(queue);
        }
    }

    /// Has a worker hand over the samples. The worker holds the state from before the queue is unlocked, so a listener
    /// may go on to use it.
    fn work(&self, queue: MutexGuard<'_, Queue<R::Sample>>) {
        let this = self.this.upgrade();
        drop(queue);
        this.into_iter().for_each(run);
    }

    /// Makes the receiving thread, and so the writer, wait briefly for the worker.
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

    /// Hands queued samples over. Returns `true` if the intake is stopped.
    fn serve(&self) -> bool {
        loop {
            if let (Some(receiver), Some(reader)) = (lock(&self.receiver).as_mut(), self.reader()) {
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
            if queue.is_stopped() {
                return true;
            }
            if queue.begin_to_rest() {
                return false;
            }
        }
    }

    /// Returns the reader's handle, unless the intake has ended.
    fn reader(&self) -> Option<dds_entity_t> {
        lock(&self.entities).as_ref().map(|entities| entities.reader.handle())
    }

    /// Deletes the entities of a stopped intake, and then what receives their samples.
    fn let_go(&self) {
        // Deleting the reader waits for its listener, which may be at work with the receiver.
        let entities = lock(&self.entities).take();
        drop(entities);
        let receiver = lock(&self.receiver).take();
        drop(receiver);
    }

    /// Accepts the samples of writers again if there is room.
    fn accept(&self, queue: &mut Queue<R::Sample>) {
        if let Some(writers) = self.participant.remote_writers() {
            queue.accept(self.progress.is_stuck(), |writer, tally| writers.accept(writer, tally));
        }
    }

    /// Stops the intake. Returns `true` if a worker is to end it.
    fn stop(&self) -> bool {
        let mut queue = lock(&self.queue);
        let is_at_work = queue.stop();
        self.accept(&mut queue);
        drop(queue);
        self.eased.notify_one();
        is_at_work
    }
}

/// Has a worker hand over the samples of an intake, or end it.
fn run<R: Receiver>(state: Arc<IntakeState<R>>) {
    let participant = Arc::clone(&state.participant);
    participant.workers().run(state);
}

impl<R: Receiver> Work for IntakeState<R> {
    fn run(self: Arc<Self>) {
        SERVED.set(Arc::as_ptr(&self).cast());
        let is_stopped = self.serve();
        SERVED.set(std::ptr::null());
        if is_stopped {
            self.let_go();
        }
    }
}

/// A reader with its queue. Dropping it waits for a receiver at work, and deletes the entities.
pub(crate) struct Intake<R: Receiver> {
    guid: Guid,
    handle: dds_entity_t,
    /// The state, until the intake is dropped.
    state: Option<Arc<IntakeState<R>>>,
    is_started: bool,
    /// Disconnected once nothing holds the state.
    all_gone: Mutex<mpsc::Receiver<()>>,
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
        let (alive, all_gone) = mpsc::channel();
        let state = Arc::new_cyclic(|this| IntakeState {
            entities: Mutex::default(),
            this: Weak::clone(this),
            queue: Mutex::new(Queue::new(if is_deep { depth.max(RELIABLE_WAITING_MIN) } else { depth })),
            eased: Condvar::new(),
            holds_back: is_deep,
            progress: Arc::default(),
            receiver: Mutex::default(),
            participant: Arc::clone(participant),
            _alive: alive,
        });
        let arg = Arc::as_ptr(&state).cast_mut().cast::<c_void>();
        // SAFETY: the listener is copied by the call that makes the reader, as is the QoS, and deleted once. `arg`
        // outlives the reader, whose deletion waits for its listener: holders of `state` drop the entities.
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
        *lock(&state.entities) = Some(Entities { reader, _group: group, _topic: topic });
        Ok(Self { guid, handle, state: Some(state), is_started: false, all_gone: all_gone.into() })
    }

    /// Starts to receive samples.
    pub(crate) fn start(&mut self, receiver: R) -> Result<(), String> {
        if std::mem::replace(&mut self.is_started, true) {
            return Err("it is started".into());
        }
        if let Some(state) = &self.state {
            *lock(&state.receiver) = Some(receiver);
            run(Arc::clone(state));
        }
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
        let Some(state) = self.state.take() else { return };
        let is_served_here = std::ptr::eq(SERVED.get(), Arc::as_ptr(&state).cast());
        // Deleting the reader waits for its listener, so a listener that drops a reader leaves it to a worker.
        let may_wait = !IS_LISTENING.get() && !is_served_here;
        let is_at_work = state.stop() && self.is_started;
        match is_at_work {
            false if may_wait => state.let_go(),
            false => run(Arc::clone(&state)),
            true => {}
        }
        drop(state);
        if may_wait {
            // It never sends: it waits until a worker has let go of the state as well.
            let _ = lock(&self.all_gone).recv();
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
