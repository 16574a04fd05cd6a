//! The inside of a writer: `struct ddsi_writer` and its history cache, which Cyclone's interface does not reach.
//!
//! Each pointer on the way is compared with its expected value, and nothing is touched if one differs. The structs are
//! those of the Cyclone of `cyclors` =0.4.0, as in [`crate::sample`].

use std::ffi::{c_int, c_void};
use std::ops::Range;

use cyclors::{dds_entity_t, dds_get_entity_sertype, dds_get_guid, dds_guid_t};

use crate::entity::monotonic_ns;

// Functions of Cyclone that `cyclors` has no binding for. `dds__entity.h`, `ddsrt/sync.h`, `ddsi__endpoint.h`.
unsafe extern "C" {
    fn dds_entity_pin(handle: dds_entity_t, entity: *mut *mut c_void) -> c_int;
    fn dds_entity_unpin(entity: *mut c_void);
    pub(crate) fn ddsrt_mutex_lock(mutex: *mut c_void);
    pub(crate) fn ddsrt_mutex_unlock(mutex: *mut c_void);
    fn ddsi_writer_max_drop_seq(writer: *const c_void) -> u64;
}

/// Bytes of a pointer on the supported platforms.
pub(crate) const WORD_BYTES: usize = 8;
/// The words of `struct dds_writer` (`dds__types.h`) among which the pointer to its topic is. The exact place depends
/// on the platform's mutexes.
const TOPIC_WORDS: Range<usize> = 60..88;
/// Words from that pointer to `m_wr` and to `m_whc`.
const TOPIC_TO_WRITER: usize = 2;
const TOPIC_TO_CACHE: usize = 3;
/// Bytes from the beginning of `struct ddsi_writer` to its GUID and to its lock (`struct ddsi_entity_common`).
const ENTITY_GUID: usize = 4;
const ENTITY_LOCK: usize = 48;

/// The words of `struct ddsi_writer` among which `status_cb_entity`, the pointer to the `struct dds_writer`, is. The
/// exact place depends on the platform's mutexes.
const OWNER_WORDS: Range<usize> = 16..48;
/// Words from that pointer over the condition `throttle_cond` (48 bytes on Linux) to [`Progress`], and to `whc`. Small
/// numbers are everywhere in a writer, so [`Progress`] is not looked for by its content.
const OWNER_TO_PROGRESS: usize = 7;
const OWNER_TO_CACHE: usize = 25;
/// Most samples that are written and not sent yet, of those that are written together.
const UNSENT_MAX: u64 = 1 << 16;

/// Time in which Fast DDS answers a heartbeat (`heartbeatResponseDelay`, 5 ms), with a reserve, nanoseconds.
const ANSWER_NS: i64 = 7_000_000;

/// `seq` and the fields behind it in `struct ddsi_writer` (`ddsi_endpoint.h`), with `struct ddsi_hbcontrol`. Times are
/// monotonic, in nanoseconds.
#[repr(C)]
struct Progress {
    written: u64,
    sent: u64,
    reject: u64,
    heartbeats: [u32; 2],
    throttling: c_int,
    last_write: i64,
    last_heartbeat: i64,
    last_request: i64,
    next_heartbeat: i64,
}

impl Progress {
    /// Returns `true` for a possible state of a writer that has written so many samples.
    fn is_of(&self, written: u64, now: i64) -> bool {
        self.written == written
            && self.sent <= written
            && written - self.sent <= UNSENT_MAX
            && matches!(self.throttling, 0 | 1)
            && (1..=now).contains(&self.last_write)
            && (0..=now + ANSWER_NS).contains(&self.last_heartbeat)
            && (0..=now).contains(&self.last_request)
            && self.next_heartbeat > 0
    }
}

/// `struct ddsi_whc_ops` (`ddsi_whc.h`) up to its fourth function.
#[repr(C)]
pub(crate) struct CacheOps {
    insert: *const c_void,
    pub(crate) remove_acked: unsafe extern "C" fn(*mut Cache, u64, *mut CacheState, *mut *mut c_void) -> u32,
    pub(crate) free_removed: unsafe extern "C" fn(*mut Cache, *mut c_void),
    state: unsafe extern "C" fn(*const Cache, *mut CacheState),
}

/// The beginning of `struct whc_impl`.
#[repr(C)]
pub(crate) struct Cache {
    pub(crate) ops: *const CacheOps,
    /// A mutex of the platform's length.
    pub(crate) lock: [u8; 0],
}

/// `struct ddsi_whc_state`. The numbers are zero if the cache is empty.
#[repr(C)]
#[derive(Default)]
pub(crate) struct CacheState {
    pub(crate) min: u64,
    pub(crate) max: u64,
    pub(crate) unacknowledged_bytes: usize,
}

/// A pinned entity of Cyclone, which is not deleted meanwhile.
struct PinnedEntity(*mut c_void);

impl PinnedEntity {
    fn new(handle: dds_entity_t) -> Option<Self> {
        let mut entity = std::ptr::null_mut();
        // SAFETY: takes a number, checked by Cyclone, and a valid place for the result.
        (unsafe { dds_entity_pin(handle, &mut entity) } >= 0 && !entity.is_null()).then_some(Self(entity))
    }
}

impl Drop for PinnedEntity {
    fn drop(&mut self) {
        // SAFETY: pinned once.
        unsafe { dds_entity_unpin(self.0) }
    }
}

/// A locked mutex of Cyclone.
pub(crate) struct LockGuard(*mut c_void);

impl LockGuard {
    /// # Safety
    /// A valid mutex that outlives the guard, and that this thread has not locked.
    pub(crate) unsafe fn new(mutex: *mut c_void) -> Self {
        // SAFETY: by contract.
        unsafe { ddsrt_mutex_lock(mutex) };
        Self(mutex)
    }
}

impl Drop for LockGuard {
    fn drop(&mut self) {
        // SAFETY: locked by this guard.
        unsafe { ddsrt_mutex_unlock(self.0) }
    }
}

/// The inside of a writer, which lives as long.
pub(crate) struct WriterInside {
    dds_writer: PinnedEntity,
    _topic: PinnedEntity,
    ddsi_writer: *mut u8,
    cache: *mut Cache,
    domain: usize,
}

impl WriterInside {
    /// Returns `None` if this Cyclone is not the one that this was written for.
    pub(crate) fn find(writer: dds_entity_t, topic: dds_entity_t) -> Option<Self> {
        if size_of::<usize>() != WORD_BYTES {
            return None;
        }
        let (dds_writer, topic) = (PinnedEntity::new(writer)?, PinnedEntity::new(topic)?);
        let mut guid = dds_guid_t { v: [0; 16] };
        let mut sertype = std::ptr::null();
        // SAFETY: the handle is checked by Cyclone, and both are valid places for results.
        let known = unsafe {
            dds_get_guid(writer, &mut guid) >= 0 && dds_get_entity_sertype(writer, &mut sertype) >= 0
        };
        if !known || sertype.is_null() {
            return None;
        }
        // SAFETY: the sertype of a writer that is pinned.
        let domain = unsafe { (*sertype).gv.v } as usize;
        // SAFETY: the structure is longer than what is looked at, and lives while the writer is pinned. A found word is
        // a pointer of the kind that it is used as, since its neighbours and its target are what they must be.
        unsafe {
            let in_writer = dds_writer.0.cast::<usize>();
            let is_topic = |at: &usize| in_writer.add(*at).read_volatile() == topic.0 as usize;
            let at = TOPIC_WORDS.into_iter().find(is_topic)?;
            let ddsi_writer = in_writer.add(at + TOPIC_TO_WRITER).read_volatile() as *mut u8;
            let cache = in_writer.add(at + TOPIC_TO_CACHE).read_volatile() as *mut Cache;
            let are_pointers =
                [ddsi_writer as usize, cache as usize].iter().all(|p| *p != 0 && p % WORD_BYTES == 0);
            let is_found = are_pointers && guid.v[12..] == entity_id(ddsi_writer);
            is_found.then_some(Self { dds_writer, _topic: topic, ddsi_writer, cache, domain })
        }
    }

    /// Locks the writer. All who change the history cache hold this lock.
    pub(crate) fn lock(&self) -> LockGuard {
        // SAFETY: the lock of a writer that lives as long as `self`; no caller holds it already.
        unsafe { LockGuard::new(self.ddsi_writer.add(ENTITY_LOCK).cast()) }
    }

    /// Returns the number of the last sample that all reliable readers have acknowledged.
    pub(crate) fn acknowledged(&self, _lock: &LockGuard) -> u64 {
        // SAFETY: a writer that lives, whose lock is held.
        unsafe { ddsi_writer_max_drop_seq(self.ddsi_writer.cast()) }
    }

    /// Returns the number of samples that a reliable reader has not acknowledged.
    pub(crate) fn unacknowledged(&self) -> u64 {
        let lock = self.lock();
        let mut state = CacheState::default();
        // SAFETY: Cyclone's own function on the cache of a writer that lives, whose lock is held.
        unsafe { ((*(*self.cache).ops).state)(self.cache, &mut state) };
        state.max.saturating_sub(self.acknowledged(&lock))
    }

    /// Makes the next sample carry a heartbeat that readers answer with an acknowledgement. Cyclone asks for one after
    /// a pause of 4 ms only, so a writer that never pauses hears none.
    pub(crate) fn ask_for_acknowledgement(&self) {
        // The time of the last write is used for nothing else.
        self.change_progress(|progress, _| progress.last_write = 1);
    }

    /// Sends no heartbeat for a moment after one that asks for an acknowledgement. Fast DDS answers 5 ms later, and not
    /// at all if a heartbeat that asks for nothing comes in between (`WriterProxy::process_heartbeat`).
    pub(crate) fn await_acknowledgement(&self) {
        self.change_progress(|progress, now| progress.last_heartbeat = now + ANSWER_NS);
    }

    /// Changes the progress, unless nothing is unacknowledged or this Cyclone is not the one that this was written for.
    fn change_progress(&self, change: impl FnOnce(&mut Progress, i64)) {
        let _lock = self.lock();
        let mut state = CacheState::default();
        // SAFETY: as above. The structure is longer than what is looked at, any content is a valid value, and the lock
        // is held by all who change it.
        unsafe {
            ((*(*self.cache).ops).state)(self.cache, &mut state);
            let now = monotonic_ns();
            let in_writer = self.ddsi_writer.cast::<usize>();
            let is_owner = |at: &usize| {
                in_writer.add(*at).read_volatile() == self.dds_writer.0 as usize
                    && in_writer.add(at + OWNER_TO_CACHE).read_volatile() == self.cache as usize
            };
            let Some(at) = OWNER_WORDS.into_iter().find(is_owner) else { return };
            let progress = &mut *in_writer.add(at + OWNER_TO_PROGRESS).cast::<Progress>();
            if state.max > 0 && progress.is_of(state.max, now) {
                change(progress, now);
            }
        }
    }

    /// Returns the history cache.
    pub(crate) fn cache(&self) -> *mut Cache {
        self.cache
    }

    /// Returns the address of `struct dds_writer`.
    pub(crate) fn dds_writer(&self) -> *mut c_void {
        self.dds_writer.0
    }

    /// Returns the address of the domain.
    pub(crate) fn domain(&self) -> usize {
        self.domain
    }
}

/// The last four bytes of the GUID of a `struct ddsi_writer`, as RTPS writes them.
///
/// # Safety
/// A pointer to at least so many bytes.
unsafe fn entity_id(ddsi_writer: *const u8) -> [u8; 4] {
    // SAFETY: by contract.
    let id = unsafe { ddsi_writer.add(ENTITY_GUID + 12).cast::<u32>().read() };
    id.to_be_bytes()
}
