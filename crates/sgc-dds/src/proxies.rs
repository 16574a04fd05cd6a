//! Remote endpoints as Cyclone keeps them: its proxy readers and proxy writers, which its interface does not reach.
//!
//! The structs are those of the C code of `cyclors` =0.4.0: `CYCLORS` in `sample.rs`. A new endpoint is compared with
//! its expected content ([`state_of`]), and left alone if it differs.

use std::ffi::{c_int, c_void};
use std::sync::atomic::{AtomicU32, Ordering::Relaxed};

use cyclors::{dds_qos_t, pthread_mutex_t};

use crate::manual_leases::Lease;

/// `DDSI_EK_PROXY_WRITER` and `DDSI_EK_PROXY_READER` (`ddsi_entity.h`).
pub(crate) const PROXY_WRITER: c_int = 4;
pub(crate) const PROXY_READER: c_int = 6;

/// Lengths of `struct ddsi_security_info` (`ddsi_plist.h`), without and with security in Cyclone, bytes.
const SECURITY_BYTES: [usize; 2] = [0, 8];

/// Flags of a proxy writer, in the order of its bit fields. Compilers begin with the lowest bit on little-endian
/// machines.
pub(crate) const HAVE_SEEN_HEARTBEAT: u32 = 1 << 1;
pub(crate) const LOCAL_MATCHING_IN_PROGRESS: u32 = 1 << 2;
const ALIVE: u32 = 1 << 3;
const FILTERED: u32 = 1 << 4;

/// Flag of a match: samples were asked for again after a delay. Then a heartbeat for this reader alone, as Cyclone
/// sends one behind each repetition, makes it ask after a further delay only.
pub(crate) const NACK_SENT_ON_DELAY: u32 = 1 << 4;

/// Kinds of readers in entity ids, with and without a key (RTPS 2.5, 9.3.1.2).
const READER_KINDS: [u32; 2] = [0x07, 0x04];

/// Most readers that are looked at for one writer. A proxy has one for a topic, and taps beside it.
const MATCHES_MAX: usize = 64;

/// `struct ddsi_entity_common` (`ddsi_entity.h`).
#[repr(C)]
pub(crate) struct EntityCommon {
    pub(crate) kind: c_int,
    /// The GUID, in the byte order of this machine.
    pub(crate) guid: [u32; 4],
    updated: i64,
    pub(crate) instance: u64,
    tkmap_instance: *const c_void,
    pub(crate) lock: pthread_mutex_t,
    only_local: bool,
    pub(crate) gv: *mut c_void,
    all_entities: AvlNode,
    qos_lock: pthread_mutex_t,
}

/// `ddsrt_avl_node_t`.
#[repr(C)]
struct AvlNode {
    children: [*mut c_void; 2],
    parent: *const c_void,
    height: c_int,
}

/// `ddsi_xlocator_t`: an address, and the socket to send from.
#[repr(C)]
#[derive(Clone, Copy)]
pub(crate) struct Locator {
    kind: i32,
    port: u32,
    address: [u8; 16],
    connection: *const c_void,
}

/// The part of `struct ddsi_generic_proxy_endpoint` (`ddsi_proxy_endpoint.h`) that is the same with and without
/// security.
#[repr(C)]
pub(crate) struct ProxyEndpoint {
    pub(crate) common: EntityCommon,
    participant: *const c_void,
    next: *const c_void,
    previous: *const c_void,
    pub(crate) qos: *const dds_qos_t,
    addresses: *const c_void,
    pub(crate) unicast: Locator,
    group_guid: [u32; 4],
    pub(crate) vendor: [u8; 2],
    announcement_number: u64,
    type_pair: *const c_void,
}

/// The used part of the rest of `struct ddsi_proxy_writer`.
#[repr(C)]
pub(crate) struct ProxyWriterState {
    /// The root of the tree of matched readers.
    readers: *mut c_void,
    reliable_readers: i32,
    readers_out_of_sync: i32,
    last_number: u64,
    last_fragment: u32,
    nackfrag_count: u32,
    next_number_to_deliver: AtomicU32,
    pub(crate) flags: u32,
    alive_changes: u32,
    defragmenter: *const c_void,
    pub(crate) reorder: *const c_void,
    delivery_queue: *const c_void,
    pub(crate) events: *mut c_void,
    local_readers: LocalReaders,
    pub(crate) lease: *const Lease,
}

/// `struct ddsi_local_reader_ary` (`ddsi_entity.h`).
#[repr(C)]
struct LocalReaders {
    lock: pthread_mutex_t,
    flags: u32,
    count: u32,
    readers: *const c_void,
}

impl ProxyWriterState {
    /// Returns `true` for exactly the state that `ddsi_new_proxy_writer` writes for a reliable writer.
    pub(crate) fn is_new_and_reliable(&self) -> bool {
        let flags = self.flags & (HAVE_SEEN_HEARTBEAT | LOCAL_MATCHING_IN_PROGRESS | ALIVE | FILTERED);
        let queues = [self.defragmenter, self.reorder, self.delivery_queue, self.events.cast_const()];
        self.readers.is_null()
            && (self.reliable_readers, self.readers_out_of_sync, self.last_number) == (0, 0, 0)
            && (self.last_fragment, self.nackfrag_count) == (u32::MAX, 1)
            && (self.next_number_to_deliver(), self.alive_changes) == (1, 0)
            && flags == LOCAL_MATCHING_IN_PROGRESS | ALIVE
            && queues.iter().all(|queue| !queue.is_null())
    }

    /// Returns the low word of the number behind the last sample that was delivered.
    pub(crate) fn next_number_to_deliver(&self) -> u32 {
        self.next_number_to_deliver.load(Relaxed)
    }

    /// Returns the number of matched readers, as far as [`MATCHES_MAX`].
    ///
    /// # Safety
    /// The writer's lock must be held.
    pub(crate) unsafe fn count_readers(&mut self) -> usize {
        let mut readers = 0;
        // SAFETY: the lock is held by contract.
        unsafe { self.for_each_match(|_| readers += 1) };
        readers
    }

    /// Calls `visit` with each matched reliable reader.
    ///
    /// # Safety
    /// The writer's lock must be held.
    pub(crate) unsafe fn for_each_reader(&mut self, mut visit: impl FnMut(&mut ReaderMatch)) {
        // SAFETY: the lock is held by contract.
        unsafe {
            self.for_each_match(|found| {
                if found.is_reliable() {
                    visit(found);
                }
            });
        }
    }

    /// Calls `visit` with each matched reader.
    ///
    /// # Safety
    /// The writer's lock must be held.
    unsafe fn for_each_match(&mut self, mut visit: impl FnMut(&mut ReaderMatch)) {
        let mut next = vec![self.readers];
        for _ in 0..MATCHES_MAX {
            let Some(node) = next.pop() else { return };
            // SAFETY: the nodes of the tree are matches, which live while the lock is held.
            let Some(found) = (unsafe { node.cast::<ReaderMatch>().as_mut() }) else { continue };
            next.extend(found.node.children.iter().filter(|child| !child.is_null()));
            visit(found);
        }
    }
}

/// The used part of `struct ddsi_pwr_rd_match` (`ddsi__endpoint_match.h`). Times are monotonic, in nanoseconds.
#[repr(C)]
pub(crate) struct ReaderMatch {
    node: AvlNode,
    pub(crate) reader: [u32; 4],
    created: i64,
    /// The number of the last ACKNACK.
    pub(crate) count: u32,
    heartbeat: u32,
    heartbeat_stamp: i64,
    heartbeat_accepted: i64,
    pub(crate) last_nack: i64,
    last_ack: i64,
    last_number: u64,
    pub(crate) nacked: Nacked,
    /// The event that sends the next ACKNACK, `null` for a best-effort reader.
    pub(crate) acknack: *mut c_void,
    sync: c_int,
    /// Flags in the order of the bit fields.
    pub(crate) flags: u32,
}

/// `struct ddsi_last_nack_summary`: the samples that were asked for again last.
#[repr(C)]
#[derive(Default)]
pub(crate) struct Nacked {
    end: u64,
    base: u64,
    fragment_end: u32,
    fragment_base: u32,
}

impl Nacked {
    /// Everything: a reader does not ask again until some time has passed.
    pub(crate) const ALL: Self = Self { end: u64::MAX, base: 0, fragment_end: 0, fragment_base: 0 };
}

impl ReaderMatch {
    /// Returns `true` if the reader receives what the writer sends to all. Otherwise it still catches up with history.
    pub(crate) fn is_in_sync(&self) -> bool {
        self.sync == 0
    }

    fn is_reliable(&self) -> bool {
        READER_KINDS.contains(&(self.reader[3] & 0xff))
            && matches!(self.sync, 0..=2)
            && self.acknack.is_aligned()
            && !self.acknack.is_null()
    }
}

/// Returns the place of the rest of an endpoint's struct: the first of the possible ones whose content is as expected.
///
/// # Safety
/// The struct of the endpoint must be at least as long as the rest at its last possible place.
pub(crate) unsafe fn state_of<T>(
    endpoint: *const ProxyEndpoint,
    is_expected: impl Fn(&T) -> bool,
) -> Option<*mut T> {
    SECURITY_BYTES.into_iter().find_map(|security| {
        // SAFETY: inside of the struct by contract.
        let state = unsafe { endpoint.add(1).byte_add(security) }.cast::<T>().cast_mut();
        // SAFETY: as above; any content is a valid value.
        unsafe { is_expected(&*state) }.then_some(state)
    })
}
