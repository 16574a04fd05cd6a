//! Shortening of a writer's history for late joiners after its creation.
//!
//! A writer for a publisher that did not announce its depth keeps as much as it can until the depth is known. Cyclone
//! DDS 11 fixes both depths of a history at creation, and another writer could not repeat the samples without sending
//! them again to every reader. So this module reaches into `struct whc_impl` (`dds_whc.c`), the history cache, and
//! makes Cyclone's own code drop old samples. Each number on the way is compared with its expected value, and nothing
//! is touched if one differs.

use std::ffi::c_void;
use std::ops::Range;

use cyclors::dds_entity_t;

use crate::writer_inside::{Cache, CacheState, LockGuard, WriterInside};

/// The words of `struct whc_impl` among which the pointer to its domain is.
const DOMAIN_WORDS: Range<usize> = 9..16;

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

/// Has a transient-local writer that keeps the last `history` samples, the first of `late` for late joiners, give late
/// joiners the second of `late` from here on, and drop all but the last `stay` samples, whether readers have
/// acknowledged them or not. Returns `false`, and does nothing, if this Cyclone is not the one that this was written
/// for.
pub(crate) fn set_depth(
    writer: dds_entity_t,
    topic: dds_entity_t,
    history: u32,
    [before, late]: [u32; 2],
    stay: Option<u32>,
) -> bool {
    let late = late.clamp(1, history);
    let Some(inside) = WriterInside::find(writer, topic) else { return false };
    let cache = inside.cache();
    // SAFETY: the structure is longer than what is looked at, and lives while the writer is pinned. The lock of the
    // writer is held by all who change the history cache, that of the cache by all who read it.
    unsafe {
        let writer_lock = inside.lock();
        let in_cache = cache.cast::<usize>();
        let is_domain = |at: &usize| in_cache.add(*at).read_volatile() == inside.domain();
        let Some(at) = DOMAIN_WORDS.into_iter().find(is_domain) else { return false };
        // The table of instances is in between.
        let depths = in_cache.add(at + 2).cast::<Depths>();
        let acknowledged = inside.acknowledged(&writer_lock);
        {
            let _cache_lock = LockGuard::new((&raw mut (*cache).lock).cast());
            let found = &mut *depths;
            if found.writer != inside.dds_writer()
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
    let mut state = CacheState::default();
    let mut removed = std::ptr::null_mut();
    // SAFETY: by contract; what is removed is freed once.
    unsafe {
        let ops = &*(*cache).ops;
        (ops.remove_acked)(cache, number, &mut state, &mut removed);
        (ops.free_removed)(cache, removed);
    }
    state.max
}
