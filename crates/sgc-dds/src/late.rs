//! Shortening of a writer's history for late joiners after its creation.
//!
//! A writer for a publisher that did not announce its depth keeps as much as it can until the depth is known. Cyclone
//! DDS 11 fixes both depths of a history at creation, and another writer could not repeat the samples without sending
//! them again to every reader. So this module reaches into `struct whc_impl` (`dds_whc.c`), the history cache, and
//! makes Cyclone's own code drop old samples. Each pointer and number on the way is compared with its expected value,
//! and nothing is touched if one differs. The structs are those of the Cyclone of `cyclors` =0.4.0, as in
//! [`crate::sample`].

use std::ffi::{c_int, c_void};
use std::ops::Range;

use cyclors::{dds_entity_t, dds_get_entity_sertype, dds_get_guid, dds_guid_t};

// Functions of Cyclone that `cyclors` has no binding for. `dds__entity.h`, `ddsrt/sync.h`, `ddsi__endpoint.h`.
unsafe extern "C" {
    fn dds_entity_pin(handle: dds_entity_t, entity: *mut *mut c_void) -> c_int;
    fn dds_entity_unpin(entity: *mut c_void);
    fn ddsrt_mutex_lock(mutex: *mut c_void);
    fn ddsrt_mutex_unlock(mutex: *mut c_void);
    fn ddsi_writer_max_drop_seq(writer: *const c_void) -> u64;
}

/// Bytes of a pointer on the supported platforms.
const WORD_BYTES: usize = 8;
/// The words of `struct dds_writer` (`dds__types.h`) among which the pointer to its topic is. The exact place depends
/// on the platform's mutexes.
const TOPIC_WORDS: Range<usize> = 60..88;
/// Words from that pointer to `m_wr` and to `m_whc`.
const TOPIC_TO_WRITER: usize = 2;
const TOPIC_TO_CACHE: usize = 3;
/// Bytes from the beginning of `struct ddsi_writer` to its GUID and to its lock (`struct ddsi_entity_common`).
const ENTITY_GUID: usize = 4;
const ENTITY_LOCK: usize = 48;
/// The words of `struct whc_impl` among which the pointer to its domain is.
const DOMAIN_WORDS: Range<usize> = 9..16;

/// `struct ddsi_whc_ops` (`ddsi_whc.h`) up to its third function.
#[repr(C)]
struct CacheOps {
    insert: *const c_void,
    remove_acked: unsafe extern "C" fn(*mut Cache, u64, *mut CacheState, *mut *mut c_void) -> u32,
    free_removed: unsafe extern "C" fn(*mut Cache, *mut c_void),
}

/// The beginning of `struct whc_impl`.
#[repr(C)]
struct Cache {
    ops: *const CacheOps,
    /// A mutex of the platform's length.
    lock: [u8; 0],
}

/// `struct ddsi_whc_state`.
#[repr(C)]
struct CacheState {
    min: u64,
    max: u64,
    unacknowledged_bytes: usize,
}

/// `struct whc_writer_info` and what follows it in `struct whc_impl`.
#[repr(C)]
struct Depths {
    writer: *mut c_void,
    flags: u32,
    history: u32,
    late: u32,
    longest: u32,
    /// The number up to which everything droppable was dropped.
    dropped: u64,
}

/// `is_transient_local`, the first of the flags.
const IS_TRANSIENT_LOCAL: u32 = 1;

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
struct LockGuard(*mut c_void);

impl LockGuard {
    /// # Safety
    /// A valid mutex that outlives the guard, and that this thread has not locked.
    unsafe fn new(mutex: *mut c_void) -> Self {
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

/// Has a transient-local writer that keeps the last `history` samples, the first of `late` for late joiners, give late joiners the second of `late`
/// from here on, and drop all but the last `stay` samples, whether readers have acknowledged them or not. Returns `false`, and does nothing, if this
/// Cyclone is not the one that this was written for.
pub(crate) fn set_depth(
    writer: dds_entity_t,
    topic: dds_entity_t,
    history: u32,
    [before, late]: [u32; 2],
    stay: Option<u32>,
) -> bool {
    if size_of::<usize>() != WORD_BYTES {
        return false;
    }
    let late = late.clamp(1, history);
    let (Some(writer_there), Some(topic_there)) = (PinnedEntity::new(writer), PinnedEntity::new(topic))
    else {
        return false;
    };
    let mut guid = dds_guid_t { v: [0; 16] };
    let mut sertype = std::ptr::null();
    // SAFETY: the handle is checked by Cyclone, and both are valid places for results.
    let known =
        unsafe { dds_get_guid(writer, &mut guid) >= 0 && dds_get_entity_sertype(writer, &mut sertype) >= 0 };
    if !known || sertype.is_null() {
        return false;
    }
    // SAFETY: the sertype of a writer that is pinned.
    let domain = unsafe { (*sertype).gv.v } as usize;
    // SAFETY: both structures are longer than what is looked at, and live while the writer is pinned. A found word is a pointer of the kind
    // that it is used as, since its neighbours and its target are what they must be. The lock of the ddsi writer is held by all who change the
    // history cache, that of the cache by all who read it.
    unsafe {
        let in_writer = writer_there.0.cast::<usize>();
        let is_topic = |at: &usize| in_writer.add(*at).read_volatile() == topic_there.0 as usize;
        let Some(at) = TOPIC_WORDS.into_iter().find(is_topic) else { return false };
        let ddsi_writer = in_writer.add(at + TOPIC_TO_WRITER).read_volatile() as *mut u8;
        let cache = in_writer.add(at + TOPIC_TO_CACHE).read_volatile() as *mut Cache;
        let are_pointers =
            [ddsi_writer as usize, cache as usize].iter().all(|p| *p != 0 && p % WORD_BYTES == 0);
        if !are_pointers || guid.v[12..] != entity_id(ddsi_writer) {
            return false;
        }
        let _writer_lock = LockGuard::new(ddsi_writer.add(ENTITY_LOCK).cast());
        let in_cache = cache.cast::<usize>();
        let is_domain = |at: &usize| in_cache.add(*at).read_volatile() == domain;
        let Some(at) = DOMAIN_WORDS.into_iter().find(is_domain) else { return false };
        // The table of instances is in between.
        let depths = in_cache.add(at + 2).cast::<Depths>();
        let acknowledged = ddsi_writer_max_drop_seq(ddsi_writer.cast());
        {
            let _cache_lock = LockGuard::new((&raw mut (*cache).lock).cast());
            let found = &mut *depths;
            if found.writer != writer_there.0
                || found.flags & IS_TRANSIENT_LOCAL == 0
                || (found.history, found.late, found.longest) != (history, before, history)
            {
                return false;
            }
            found.late = late;
            // Cyclone considers only samples acknowledged since the last time. Zero makes it consider all.
            found.dropped = 0;
        }
        let newest = drop_up_to(cache, acknowledged);
        let gone = stay.and_then(|stay| newest.checked_sub(u64::from(stay.max(late))));
        if let Some(gone) = gone.filter(|gone| *gone > acknowledged) {
            drop_up_to(cache, gone);
            let _cache_lock = LockGuard::new((&raw mut (*cache).lock).cast());
            (*depths).dropped = acknowledged;
        }
    }
    true
}

/// Drops the samples up to this number that late joiners are not to get. Returns the number of the newest sample.
///
/// # Safety
/// A history cache whose writer's lock is held.
unsafe fn drop_up_to(cache: *mut Cache, number: u64) -> u64 {
    let mut state = CacheState { min: 0, max: 0, unacknowledged_bytes: 0 };
    let mut removed = std::ptr::null_mut();
    // SAFETY: by contract; what is removed is freed once.
    unsafe {
        let ops = &*(*cache).ops;
        (ops.remove_acked)(cache, number, &mut state, &mut removed);
        (ops.free_removed)(cache, removed);
    }
    state.max
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
