//! Backpressure to reliable writers: a reader without room refuses their samples.
//!
//! A reliable writer keeps a sample until each reader has acknowledged it, and sends it again when a reader asks. A
//! `KEEP_ALL` writer waits once it keeps as much as it may. So a reader without room need only not receive a sample,
//! and ask for it when there is room: that holds back this writer and nobody else, and loses nothing. A `KEEP_LAST`
//! writer goes on and keeps its newest samples, as towards any slow reader.
//!
//! Cyclone acknowledges a sample before its reader has seen it, and cannot refuse one. But it ignores the samples of a
//! writer whose local readers it is matching, before it notes their numbers (`handle_regular` in `ddsi_receive.c`).
//! This module sets that flag of a writer, under its lock. Meanwhile heartbeats are answered, and keep leases alive,
//! but no sample is asked for: it would be refused. When the last reader has room again, the flag is cleared. Each
//! reader asks for what it lacks, and for a heartbeat, because a writer that waits may send its next one seconds later.
//!
//! The flag concerns all readers of a participant, so a writer with several of them here is not refused. A network that
//! DDS Security protects may ignore the request for a heartbeat; then the next one comes when the writer sends it.
//!
//! All changes happen in an event of the writer. Cyclone runs the events of a domain one after the other, and frees no
//! entity meanwhile.
//!
//! This needs structs of the C code of `cyclors` =0.4.0: [`crate::proxies`]. A writer whose struct differs is never
//! refused; then the oldest samples of a full queue give way.

use std::collections::BTreeMap;
use std::ffi::c_void;
use std::sync::atomic::{AtomicBool, AtomicU64, AtomicUsize, Ordering::Relaxed};
use std::sync::{Arc, Mutex, MutexGuard};

use cyclors::dds_instance_handle_t;
use sgc_sync::lock;

use crate::acknack::HeartbeatRequest;
use crate::entity::{Time, monotonic_ns};
use crate::events::{ddsi_delete_xevent, ddsi_qxev_callback, ddsi_resched_xevent_if_earlier};
use crate::identity::FAST_DDS;
use crate::proxies::{
    LOCAL_MATCHING_IN_PROGRESS, NACK_SENT_ON_DELAY, Nacked, ProxyEndpoint, ProxyWriterState, ReaderMatch,
};
use crate::writer_inside::{ddsrt_mutex_lock, ddsrt_mutex_unlock};

/// Most writers in a process that can be refused.
const WRITERS_MAX: usize = 16_384;

/// Time between two looks at a reader that refuses samples, in nanoseconds.
const LOOK_NS: i64 = 500_000_000;

/// Longest time for which a reader may refuse samples without taking any from its queue, in nanoseconds. It is longer
/// than a link without progress may block a publisher. A long sample has more time: see [`STUCK_NS_PER_BYTE`].
const STUCK_NS: i64 = 10_000_000_000;

/// The time by which this is longer for each byte of the sample that the reader took last: as on a path of a megabit a
/// second.
const STUCK_NS_PER_BYTE: i64 = 8_000;

/// Time for which the numbers of a writer are looked at after its samples are accepted again, in nanoseconds.
const COUNTED_NS: i64 = 10_000_000_000;

/// `DDS_NEVER`: an event at this time never happens.
const NEVER: Time = Time(i64::MAX);

// A function of Cyclone that `cyclors` has no binding for. `ddsi__radmin.h`.
unsafe extern "C" {
    /// Returns the number of the first sample that was not received.
    fn ddsi_reorder_next_seq(reorder: *const c_void) -> u64;
}

/// The progress of a reader that may refuse samples.
#[derive(Debug, Default)]
pub(crate) struct Progress {
    taken: AtomicU64,
    /// Length of the sample that was taken last.
    bytes: AtomicUsize,
    is_stuck: AtomicBool,
}

impl Progress {
    /// Records that the reader took a sample of this length from its queue.
    pub(crate) fn advance(&self, bytes: usize) {
        self.bytes.store(bytes, Relaxed);
        self.taken.fetch_add(1, Relaxed);
        if self.is_stuck.load(Relaxed) {
            self.is_stuck.store(false, Relaxed);
        }
    }

    /// Returns `true` if the reader refused samples for too long without taking any, and took none since.
    pub(crate) fn is_stuck(&self) -> bool {
        self.is_stuck.load(Relaxed)
    }

    /// Returns the longest time until the reader takes the next sample, in nanoseconds.
    fn patience_ns(&self) -> i64 {
        let bytes = i64::try_from(self.bytes.load(Relaxed)).unwrap_or(i64::MAX);
        bytes.saturating_mul(STUCK_NS_PER_BYTE).saturating_add(STUCK_NS)
    }
}

/// The samples of a writer for a reader that has refused some. The reader counts those that arrive, in its listener.
#[derive(Debug)]
pub(crate) struct Tally {
    reader: Arc<Progress>,
    arrived: AtomicU64,
    lost: AtomicU64,
}

impl Tally {
    pub(crate) fn new(reader: Arc<Progress>) -> Self {
        Self { reader, arrived: AtomicU64::new(0), lost: AtomicU64::new(0) }
    }

    /// Counts a sample that the listener got.
    pub(crate) fn count_arrival(&self) {
        self.arrived.fetch_add(1, Relaxed);
    }

    /// Returns the number of samples that the writer no longer had when they were asked for, since the last call.
    pub(crate) fn take_lost(&self) -> u64 {
        if self.lost.load(Relaxed) == 0 { 0 } else { self.lost.swap(0, Relaxed) }
    }
}

/// A reader that refuses, or refused before, the samples of a writer.
struct Refusal {
    tally: Arc<Tally>,
    refuses: bool,
    /// The progress that was seen last, and when it was seen first.
    taken: u64,
    since_ns: i64,
    /// The number behind the last delivered sample, and the count of arrivals, at the last look.
    seen: Option<(u32, u64)>,
    /// Numbers that Cyclone delivered or skipped, less those that arrived and those that were counted as lost.
    missing: i64,
}

impl Refusal {
    /// Stops to refuse if the reader made no progress for too long.
    fn look_at_progress(&mut self, now_ns: i64) {
        let taken = self.tally.reader.taken.load(Relaxed);
        if taken != self.taken {
            (self.taken, self.since_ns) = (taken, now_ns);
        }
        if self.refuses && now_ns.saturating_sub(self.since_ns) >= self.tally.reader.patience_ns() {
            self.tally.reader.is_stuck.store(true, Relaxed);
            self.refuses = false;
        }
    }

    /// Counts samples as lost that Cyclone skipped. `delivered` is the low word of the number behind the last sample
    /// that it delivered.
    fn look_at_numbers(&mut self, delivered: u32) {
        let arrived = self.tally.arrived.load(Relaxed);
        if let Some((delivered_before, arrived_before)) = self.seen {
            self.missing += i64::from(delivered.wrapping_sub(delivered_before));
            self.missing -= arrived.wrapping_sub(arrived_before) as i64;
        }
        self.seen = Some((delivered, arrived));
        if let Ok(lost @ 1..) = u64::try_from(self.missing) {
            self.tally.lost.fetch_add(lost, Relaxed);
            self.missing = 0;
        }
    }
}

/// A reliable writer that Cyclone discovered.
struct RemoteWriter {
    endpoint: *const ProxyEndpoint,
    state: *mut ProxyWriterState,
    /// The event that applies a change, `null` before the first one.
    event: *mut c_void,
    refusals: Vec<Refusal>,
    /// `true` if the flag is set.
    is_refused: bool,
    /// The time until which its numbers are looked at.
    counted_until_ns: i64,
}

// SAFETY: the pointers are used under the writer's lock only, while Cyclone frees no entity.
unsafe impl Send for RemoteWriter {}

/// Identifies a writer: the domain that discovered it, and its instance handle.
type Key = (usize, dds_instance_handle_t);

/// The writers. One is removed before Cyclone frees it. This may be locked while a writer's lock is held, not the other
/// way round.
static WRITERS: Mutex<BTreeMap<Key, RemoteWriter>> = Mutex::new(BTreeMap::new());

fn writers() -> MutexGuard<'static, BTreeMap<Key, RemoteWriter>> {
    lock(&WRITERS)
}

/// Makes a new reliable writer one that can be refused.
///
/// # Safety
/// `endpoint` is the writer, and `state` the rest of it. They live, and only threads that hold its lock use them, at
/// least until [`forget`] is told of it.
pub(crate) unsafe fn watch(
    domain: *const c_void,
    endpoint: *const ProxyEndpoint,
    state: *mut ProxyWriterState,
) {
    // SAFETY: valid by contract; the handle of an entity does not change.
    let instance = unsafe { (*endpoint).common.instance };
    let mut all = writers();
    if all.len() >= WRITERS_MAX {
        tracing::debug!("too many writers: this one is not held back");
        return;
    }
    let writer = RemoteWriter {
        endpoint,
        state,
        event: std::ptr::null_mut(),
        refusals: Vec::new(),
        is_refused: false,
        counted_until_ns: 0,
    };
    all.insert((domain as usize, instance), writer);
}

/// Forgets a writer that is about to go.
pub(crate) fn forget(domain: *const c_void, instance: dds_instance_handle_t) {
    let forgotten = writers().remove(&(domain as usize, instance));
    if let Some(writer) = forgotten.filter(|writer| !writer.event.is_null()) {
        // SAFETY: the event is deleted once, because its writer is no longer listed.
        unsafe { ddsi_delete_xevent(writer.event) };
    }
}

/// The writers of a domain. Dropping forgets them.
#[derive(Debug)]
pub(crate) struct RemoteWriters(pub(crate) usize);

impl RemoteWriters {
    /// Makes Cyclone refuse the samples of a writer, until the reader accepts them again or is stuck. Some may still
    /// arrive, because that happens on another thread. Has no effect for a writer that cannot be refused.
    pub(crate) fn refuse(&self, writer: dds_instance_handle_t, reader: &Arc<Tally>) {
        let key = (self.0, writer);
        if let Some(writer) = writers().get_mut(&key) {
            let (taken, since_ns) = (reader.reader.taken.load(Relaxed), monotonic_ns());
            match writer.refusal(reader) {
                Some(known) => (known.refuses, known.taken, known.since_ns) = (true, taken, since_ns),
                None => writer.refusals.push(Refusal {
                    tally: Arc::clone(reader),
                    refuses: true,
                    taken,
                    since_ns,
                    seen: None,
                    missing: 0,
                }),
            }
            writer.change(key);
        }
    }

    /// Ends the refusal of a writer's samples by the reader.
    pub(crate) fn accept(&self, writer: dds_instance_handle_t, reader: &Arc<Tally>) {
        let key = (self.0, writer);
        if let Some(writer) = writers().get_mut(&key)
            && let Some(known) = writer.refusal(reader)
        {
            known.refuses = false;
            writer.change(key);
        }
    }
}

impl Drop for RemoteWriters {
    fn drop(&mut self) {
        // Cyclone freed the events with the domain.
        writers().retain(|(domain, _), _| *domain != self.0);
    }
}

impl RemoteWriter {
    fn refusal(&mut self, reader: &Arc<Tally>) -> Option<&mut Refusal> {
        self.refusals.iter_mut().find(|refusal| Arc::ptr_eq(&refusal.tally, reader))
    }

    fn has_to_be_refused(&self) -> bool {
        self.refusals.iter().any(|refusal| refusal.refuses)
    }

    /// Looks at all readers that refuse, or refused before. The writer's lock must be held, so that no sample arrives.
    /// `readers` is the number of matched readers, and `delivered` as in [`Refusal::look_at_numbers`]. Returns the next
    /// step, and whether to look again.
    fn step(&mut self, readers: usize, delivered: u32, now_ns: i64) -> (Step, bool) {
        // A reader that is gone has left its tally.
        self.refusals.retain(|refusal| refusal.refuses || Arc::strong_count(&refusal.tally) > 1);
        for refusal in &mut self.refusals {
            refusal.look_at_progress(now_ns);
            refusal.look_at_numbers(delivered);
        }
        let refuses = self.has_to_be_refused();
        // Other readers would get nothing either.
        let is_refused = refuses && readers <= 1;
        let step = match (std::mem::replace(&mut self.is_refused, is_refused), is_refused) {
            (_, true) => Step::Refuse,
            (true, false) => Step::Accept,
            (false, false) => Step::Rest,
        };
        if matches!(step, Step::Accept) {
            self.counted_until_ns = now_ns.saturating_add(COUNTED_NS);
        }
        (step, refuses || now_ns < self.counted_until_ns)
    }

    /// Makes the event happen at once if the flag has to change.
    fn change(&mut self, key: Key) {
        if self.is_refused == self.has_to_be_refused() {
            return;
        }
        // SAFETY: the writer is listed, so its domain has a queue of events; the argument is copied. The event is not
        // deleted while its writer is listed.
        unsafe {
            if self.event.is_null() {
                let arg = (&raw const key).cast();
                self.event =
                    ddsi_qxev_callback((*self.state).events, NEVER, apply, arg, size_of::<Key>(), false);
            }
            ddsi_resched_xevent_if_earlier(self.event, Time(monotonic_ns()));
        }
    }
}

/// Sets or clears the flag of a writer, and counts its lost samples.
unsafe extern "C" fn apply(
    gv: *mut c_void,
    event: *mut c_void,
    pack: *mut c_void,
    arg: *mut c_void,
    now: Time,
) {
    // SAFETY: the copy of what the event was made with, which has no alignment of its own.
    let key = unsafe { arg.cast::<Key>().read_unaligned() };
    let Some((endpoint, state)) = writers().get(&key).map(|writer| (writer.endpoint, writer.state)) else {
        return;
    };
    let mut requests = Vec::new();
    // SAFETY: the writer was listed when this event ran, and no entity is freed meanwhile. Its lock is held, and the
    // callback is lent the event and the packets.
    unsafe {
        let mutex = (&raw const (*endpoint).common.lock).cast_mut().cast();
        ddsrt_mutex_lock(mutex);
        let (readers, delivered) = ((*state).count_readers(), (*state).next_number_to_deliver());
        let (step, looks_again) = match writers().get_mut(&key) {
            Some(writer) => writer.step(readers, delivered, now.0),
            None => (Step::Rest, false),
        };
        match step {
            Step::Refuse => {
                (*state).flags |= LOCAL_MATCHING_IN_PROGRESS;
                (*state).for_each_reader(|found| ask_for_nothing(found, now));
            }
            Step::Accept => {
                (*state).flags &= !LOCAL_MATCHING_IN_PROGRESS;
                let next = ddsi_reorder_next_seq((*state).reorder);
                (*state).for_each_reader(|found| {
                    requests.extend(ask_again(found, &*endpoint, next));
                    ddsi_resched_xevent_if_earlier(found.acknack, now);
                });
            }
            Step::Rest => {}
        }
        ddsrt_mutex_unlock(mutex);
        // To send may block.
        requests.iter().for_each(|request: &HeartbeatRequest| request.send(gv, pack));
        if looks_again {
            ddsi_resched_xevent_if_earlier(event, Time(now.0.saturating_add(LOOK_NS)));
        }
    }
}

/// The step of an event for a writer.
enum Step {
    /// Its samples are refused, from here on or still.
    Refuse,
    /// Its samples are accepted from here on.
    Accept,
    /// Its samples were accepted before.
    Rest,
}

/// Makes a reader answer heartbeats without asking for samples.
fn ask_for_nothing(found: &mut ReaderMatch, now: Time) {
    found.nacked = Nacked::ALL;
    found.flags |= NACK_SENT_ON_DELAY;
    // Cyclone asks again for what it asked for before, after a delay from this time on.
    found.last_nack = now.0.saturating_add(2 * LOOK_NS);
}

/// Makes a reader ask for all samples that it lacks, and returns a request for a heartbeat.
fn ask_again(found: &mut ReaderMatch, writer: &ProxyEndpoint, next: u64) -> Option<HeartbeatRequest> {
    found.nacked = Nacked::default();
    found.flags &= !NACK_SENT_ON_DELAY;
    found.last_nack = 0;
    // Fast DDS answers an ACKNACK of base 0 at once, and others with a heartbeat after up to three seconds.
    let base = match writer.vendor {
        FAST_DDS => 0,
        _ if found.is_in_sync() => next,
        _ => return None,
    };
    let (reader, count) = (found.reader, found.count);
    found.count = count.wrapping_add(1);
    Some(HeartbeatRequest { reader, writer: writer.common.guid, to: writer.unicast, base, count })
}
