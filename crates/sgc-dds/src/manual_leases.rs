//! The times at which writers with liveliness manual by topic renewed their leases.
//!
//! Such a writer asserts its liveliness by a message, or by a heartbeat with the liveliness flag (RTPS 2.5, 8.3.8.6).
//! A DDS reader is told only whether a writer is alive. Cyclone records each assertion by moving the end of the
//! writer's lease (`ddsi_lease_renew`), but ignores heartbeats once a lease has expired: then its reader waits for a
//! message.
//!
//! So when these writers are discovered, their leases are made too long to expire, see [`keep`]. The end of a lease
//! then gives the time of its last renewal, and readers here are not told of an expiry. The place where the writer's
//! messages go decides on its liveliness.
//!
//! This needs structs of the C code of `cyclors` =0.4.0, as [`crate::first_messages`] does. A lease is compared with
//! its expected writer, and left alone if it belongs to another.

use std::collections::BTreeMap;
use std::ffi::c_void;
use std::sync::atomic::{AtomicI64, Ordering};
use std::sync::{Mutex, MutexGuard};
use std::time::Duration;

use cyclors::{dds_liveliness_kind_DDS_LIVELINESS_MANUAL_BY_TOPIC, dds_qget_liveliness, dds_qos_t};
use sgc_ros::Guid;
use sgc_sync::lock;

use crate::entity::INFINITE;

/// Length of a kept lease, in nanoseconds: 73 years.
const LEASE_KEPT_NS: i64 = 1 << 61;

/// Most kept leases in a process. Beyond that only messages show that a writer is alive.
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
    /// Returns the nanoseconds since the machine started.
    fn ddsrt_time_elapsed() -> i64;
}

/// A kept lease, and its end when it was kept.
struct KeptLease {
    lease: *const Lease,
    end_ns: i64,
}

// SAFETY: of a lease nothing but its end is looked at, which is atomic.
unsafe impl Send for KeptLease {}

/// Identifies a writer: the domain that discovered it, and its GUID.
type Key = (usize, [u32; 4]);

/// The kept leases. A lease is removed before Cyclone frees it, so it is valid while this is locked.
static LEASES: Mutex<BTreeMap<Key, KeptLease>> = Mutex::new(BTreeMap::new());

fn leases() -> MutexGuard<'static, BTreeMap<Key, KeptLease>> {
    lock(&LEASES)
}

/// Keeps the lease of a new reliable writer from running out, if the writer is manual by topic.
///
/// # Safety
/// `entity` is the writer, which no reader is matched with yet, `qos` its QoS and `lease` what it has for a lease; all
/// live at least until [`forget`] is told of it.
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
    // Cyclone checks again when the lease would have expired, and finds that it has not. Meanwhile only Cyclone's own
    // renewal moves it.
    let end_ns =
        found.end_ns.load(Ordering::Relaxed).saturating_sub(duration_ns).saturating_add(LEASE_KEPT_NS);
    let end_ns = found.end_ns.fetch_max(end_ns, Ordering::Relaxed).max(end_ns);
    all.insert((domain as usize, guid), KeptLease { lease, end_ns });
}

/// Forgets a writer that is about to go.
pub(crate) fn forget(domain: *const c_void, guid: [u32; 4]) {
    leases().remove(&(domain as usize, guid));
}

/// The leases of a domain's writers. Dropping forgets them.
#[derive(Debug)]
pub(crate) struct Leases(pub(crate) usize);

impl Leases {
    /// Returns the time since a writer renewed its lease. Returns `None` if it has not since its discovery, or if its
    /// lease is not kept.
    pub(crate) fn renewed_ago(&self, writer: &Guid) -> Option<Duration> {
        let word = |at: usize| u32::from_be_bytes([0, 1, 2, 3].map(|byte| writer.0[at + byte]));
        let renewed_ns = {
            let all = leases();
            let KeptLease { lease, end_ns } = all.get(&(self.0, [word(0), word(4), word(8), word(12)]))?;
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
