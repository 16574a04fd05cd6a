//! When writers whose liveliness is manual by topic renewed their leases.
//!
//! Such a writer asserts that it lives by a message, or by a heartbeat with the liveliness flag (RTPS 2.5, 8.3.8.6), of which a DDS
//! reader is told nothing: it says that a writer lives or does not. Cyclone takes note of each by moving the end of the writer's lease
//! (`ddsi_lease_renew`), but of no heartbeat once a lease ran out: then its reader waits for a message.
//!
//! So the leases of these writers are made too long to run out when they are discovered, see [`keep`]. Where a lease ends then says when it was
//! renewed last, and readers here do not hear that such a writer's lease ran out. What becomes of that is decided where the writer's messages go.
//!
//! That takes structs of the C code of `cyclors` =0.4.0, as [`crate::first_messages`] does. A lease is compared with the writer that it must be of,
//! and left alone where it is another.

use std::collections::BTreeMap;
use std::ffi::c_void;
use std::sync::atomic::{AtomicI64, Ordering};
use std::sync::{Mutex, MutexGuard, PoisonError};
use std::time::Duration;

use cyclors::{dds_liveliness_kind_DDS_LIVELINESS_MANUAL_BY_TOPIC, dds_qget_liveliness, dds_qos_t};
use sgc_ros::Guid;

use crate::entity::INFINITE;

/// How long the lease of a writer lasts that is looked at here, nanoseconds: 73 years.
const LEASE_KEPT_NS: i64 = 1 << 61;

/// Writers whose leases are looked at in a process. Beyond it a writer's messages alone say that it lives.
const LEASES_MAX: usize = 4096;

/// `ddsrt_fibheap_node_t`.
#[repr(C)]
struct HeapNode {
    links: [*const c_void; 4],
    mark_and_degree: u32,
}

/// `struct ddsi_lease` (`ddsi_lease.h`).
#[repr(C)]
pub(crate) struct Lease {
    heap: HeapNode,
    participant_heap: HeapNode,
    scheduled_ns: i64,
    end_ns: AtomicI64,
    duration_ns: AtomicI64,
    entity: *const c_void,
}

// `ddsrt/time.h`.
unsafe extern "C" {
    /// Nanoseconds since the machine was started.
    fn ddsrt_time_elapsed() -> i64;
}

/// A lease that is kept, and where it ended then.
struct Kept {
    lease: *const Lease,
    end_ns: i64,
}

// SAFETY: of a lease nothing but its end is looked at, which is atomic.
unsafe impl Send for Kept {}

/// Identifies a writer: the domain that discovered it, and its GUID.
type Key = (usize, [u32; 4]);

/// Those that are there. One that goes is taken out before Cyclone frees it, so that a lease is there while this is locked.
static LEASES: Mutex<BTreeMap<Key, Kept>> = Mutex::new(BTreeMap::new());

fn leases() -> MutexGuard<'static, BTreeMap<Key, Kept>> {
    LEASES.lock().unwrap_or_else(PoisonError::into_inner)
}

/// Keeps the lease of a new reliable writer from running out, if the writer is manual by topic.
///
/// # Safety
/// `entity` is the writer, which no reader is matched with yet, `qos` its QoS and `lease` what it has for a lease; all live at least until
/// [`forget`] is told of it.
pub(crate) unsafe fn keep(
    domain: *const c_void,
    guid: [u32; 4],
    entity: *const c_void,
    qos: *const dds_qos_t,
    lease: *const Lease,
) {
    let (mut kind, mut duration_ns) = (0, INFINITE);
    // SAFETY: valid by contract; both are places for the result.
    let is_said = unsafe { dds_qget_liveliness(qos, &mut kind, &mut duration_ns) };
    let is_manual = is_said && kind == dds_liveliness_kind_DDS_LIVELINESS_MANUAL_BY_TOPIC;
    let is_pointer = !lease.is_null() && lease.is_aligned() && size_of::<usize>() == 8;
    if !is_manual || duration_ns == INFINITE || !is_pointer {
        return;
    }
    // SAFETY: a writer with a finite lease has one, which lives as long as the writer.
    let found = unsafe { &*lease };
    if found.entity != entity || found.duration_ns.load(Ordering::Relaxed) != duration_ns {
        tracing::warn!("this Cyclone DDS is another one: publishers live by their messages alone");
        return;
    }
    let mut all = leases();
    if all.len() >= LEASES_MAX {
        tracing::debug!("too many writers are manual by topic: this one lives by its messages alone");
        return;
    }
    found.duration_ns.store(LEASE_KEPT_NS, Ordering::Relaxed);
    // Cyclone looks again when the lease would have run out, and finds that it did not. Nothing but its own renewal moves it meanwhile.
    let end_ns =
        found.end_ns.load(Ordering::Relaxed).saturating_sub(duration_ns).saturating_add(LEASE_KEPT_NS);
    let end_ns = found.end_ns.fetch_max(end_ns, Ordering::Relaxed).max(end_ns);
    all.insert((domain as usize, guid), Kept { lease, end_ns });
}

/// Forgets a writer that goes.
pub(crate) fn forget(domain: *const c_void, guid: [u32; 4]) {
    leases().remove(&(domain as usize, guid));
}

/// The leases of a domain's writers. Dropped behind the domain, which may end without a word of its writers.
#[derive(Debug)]
pub(crate) struct Leases(pub(crate) usize);

impl Leases {
    /// Returns how long ago a writer renewed its lease. None if it did not since it was discovered, or is none of those that are looked at.
    pub(crate) fn renewed_ago(&self, writer: &Guid) -> Option<Duration> {
        let word = |at: usize| u32::from_be_bytes([0, 1, 2, 3].map(|byte| writer.0[at + byte]));
        let renewed_ns = {
            let all = leases();
            let Kept { lease, end_ns } = all.get(&(self.0, [word(0), word(4), word(8), word(12)]))?;
            // SAFETY: it is not freed while it is listed and its domain lives.
            let now_ns = unsafe { &**lease }.end_ns.load(Ordering::Relaxed);
            (now_ns > *end_ns).then(|| now_ns.saturating_sub(LEASE_KEPT_NS))?
        };
        // SAFETY: takes nothing.
        let ago_ns = unsafe { ddsrt_time_elapsed() }.saturating_sub(renewed_ns);
        Some(Duration::from_nanos(ago_ns.try_into().unwrap_or(0)))
    }
}

impl Drop for Leases {
    fn drop(&mut self) {
        leases().retain(|(domain, _), _| *domain != self.0);
    }
}
