//! The first messages of Fast DDS writers.
//!
//! A Fast DDS writer sends its first message at the moment it matches a reader; a ROS client calls as soon as it sees
//! a service. The message and the preceding heartbeat may arrive before Cyclone knows the writer. Cyclone drops both.
//! It treats everything older than the first heartbeat that it handles as history, which a volatile reader does not
//! get (`handle_Heartbeat` in `ddsi_receive.c`). So the message is lost, although its writer keeps it until it is
//! acknowledged.
//!
//! This module does two things when Cyclone discovers a reliable writer of Fast DDS, see [`install`]:
//! - A volatile writer counts as one whose heartbeat was seen. Then the first heartbeat skips nothing, and Cyclone
//!   asks for all messages that it announces. Fast DDS answers with a GAP for those written before it matched the
//!   reader (`ReaderProxy::requested_changes_set`), as RTPS 2.5, 8.4.2.2.5 demands. Writers of Cyclone rely on the
//!   skip, and the answer of others is unknown, so both are left alone. So are transient-local writers: their readers
//!   ask for everything anyway, and Cyclone learns the end of history from the first heartbeat.
//! - Each reliable reader that matches the writer asks for a heartbeat at once, with an ACKNACK of base 0, as readers
//!   of Fast DDS do. Fast DDS answers that at once. It answers an ACKNACK of base 1, which is Cyclone's first, with its
//!   next periodic heartbeat, after up to three seconds.
//!
//! Discovered writers are also reported to [`manual_leases`], and discovered readers to [`late_readers`].
//!
//! This needs structs and functions of the C code of `cyclors` =0.4.0: `CYCLORS` in `sample.rs`. Each struct is
//! compared with its expected content at that moment, and everything is left alone if it differs.

use std::cell::Cell;
use std::ffi::{c_int, c_void};
use std::mem::offset_of;
use std::sync::OnceLock;
use std::sync::atomic::{AtomicPtr, Ordering};

use cyclors::{
    DDS_BUILTIN_TOPIC_DCPSPUBLICATION, dds_create_reader, dds_durability_kind_DDS_DURABILITY_VOLATILE,
    dds_entity_t, dds_get_entity_sertype, dds_get_guid, dds_guid_t, dds_instance_handle_t, dds_listener_t,
    dds_lset_subscription_matched_arg, dds_qget_durability, dds_qos_t, dds_subscription_matched_status_t,
    pthread_mutex_t,
};

use crate::entity::{Entity, check, monotonic_ns};
use crate::identity::FAST_DDS;
use crate::late_readers::{self, LateReaders, ProxyReaderState};
use crate::manual_leases::{self, Lease, Leases};

/// Delays after a match with which a reader asks for a heartbeat, in nanoseconds. Cyclone reports the match a few
/// instructions before it would handle a heartbeat for the reader, so on a busy machine the first answer may come too
/// early. The second request is counted as if it were Cyclone's first ACKNACK, so Fast DDS ignores it once Cyclone
/// has sent one.
const ASK_DELAYS_NS: [i64; 2] = [1_000_000, 50_000_000];

/// Bytes of `struct dds_domain` before the structs that are examined here; there are some 600.
const DOMAIN_HEAD_BYTES_MAX: usize = 4096;

/// `DDSI_EK_PROXY_WRITER` and `DDSI_EK_PROXY_READER` (`ddsi_entity.h`).
const PROXY_WRITER: c_int = 4;
const PROXY_READER: c_int = 6;

/// The bits of an entity id that mark endpoints of discovery and of vendors (RTPS 2.5, 9.3.1.2).
const NOT_OF_USERS: u32 = 0xc0;

/// Lengths of `struct ddsi_security_info` (`ddsi_plist.h`), without and with security in Cyclone, bytes.
const SECURITY_BYTES: [usize; 2] = [0, 8];

/// Flags of a proxy writer, in the order of its bit fields. Compilers begin with the lowest bit on little-endian
/// machines.
const HAVE_SEEN_HEARTBEAT: u32 = 1 << 1;
const LOCAL_MATCHING_IN_PROGRESS: u32 = 1 << 2;
const ALIVE: u32 = 1 << 3;
const FILTERED: u32 = 1 << 4;

/// `struct ddsi_builtin_topic_interface` (`ddsi_builtin_topic_if.h`), by which `ddsi` reports endpoints to `ddsc`.
#[repr(C)]
struct BuiltinTopics {
    domain: *mut c_void,
    is_builtin: *const c_void,
    is_visible: *const c_void,
    get_instance: *const c_void,
    write_endpoint: *mut c_void,
    write_topic: *const c_void,
}

/// `ddsrt_wctime_t` and `ddsrt_mtime_t`, nanoseconds.
#[repr(C)]
#[derive(Clone, Copy)]
struct Time(i64);

type WriteEndpoint = unsafe extern "C" fn(*const EntityCommon, Time, bool, *mut c_void);

/// `struct ddsi_entity_common` (`ddsi_entity.h`).
#[repr(C)]
struct EntityCommon {
    kind: c_int,
    /// The GUID, in the byte order of this machine.
    guid: [u32; 4],
    updated: i64,
    instance: u64,
    tkmap_instance: *const c_void,
    lock: pthread_mutex_t,
    only_local: bool,
    gv: *mut c_void,
    all_entities: AvlNode,
    qos_lock: pthread_mutex_t,
}

/// `ddsrt_avl_node_t`.
#[repr(C)]
struct AvlNode {
    children: [*const c_void; 2],
    parent: *const c_void,
    height: c_int,
}

/// `ddsi_xlocator_t`: an address, and the socket to send from.
#[repr(C)]
#[derive(Clone, Copy)]
struct Locator {
    kind: i32,
    port: u32,
    address: [u8; 16],
    connection: *const c_void,
}

/// The part of `struct ddsi_generic_proxy_endpoint` (`ddsi_proxy_endpoint.h`) that is the same with and without
/// security.
#[repr(C)]
struct ProxyEndpoint {
    common: EntityCommon,
    participant: *const c_void,
    next: *const c_void,
    previous: *const c_void,
    qos: *const dds_qos_t,
    addresses: *const c_void,
    unicast: Locator,
    group_guid: [u32; 4],
    vendor: [u8; 2],
    announcement_number: u64,
    type_pair: *const c_void,
}

/// The used part of the rest of `struct ddsi_proxy_writer`.
#[repr(C)]
struct ProxyWriterState {
    readers: *const c_void,
    reliable_readers: i32,
    readers_out_of_sync: i32,
    last_number: u64,
    last_fragment: u32,
    nackfrag_count: u32,
    next_number_to_deliver: u32,
    flags: u32,
    alive_changes: u32,
    defragmenter: *const c_void,
    reorder: *const c_void,
    delivery_queue: *const c_void,
    events: *mut c_void,
    local_readers: LocalReaders,
    lease: *const Lease,
}

/// `struct ddsi_local_reader_ary` (`ddsi_entity.h`).
#[repr(C)]
struct LocalReaders {
    lock: pthread_mutex_t,
    flags: u32,
    count: u32,
    readers: *const c_void,
}

/// `ddsi_protocol_version_t`.
#[repr(C)]
struct ProtocolVersion {
    major: u8,
    minor: u8,
}

type EventCallback =
    unsafe extern "C" fn(gv: *mut c_void, event: *mut c_void, pack: *mut c_void, arg: *mut c_void, now: Time);

// Functions of Cyclone that `cyclors` has no binding for. `ddsi__xmsg.h`, `ddsi__xevent.h`.
#[allow(improper_ctypes)]
unsafe extern "C" {
    fn ddsi_xmsgpool_new(version: ProtocolVersion) -> *mut c_void;
    fn ddsi_xmsg_new(
        pool: *mut c_void,
        source: *const [u32; 4],
        participant: *const c_void,
        bytes: usize,
        kind: c_int,
    ) -> *mut c_void;
    fn ddsi_xmsg_setdst1_generic(
        gv: *mut c_void,
        message: *mut c_void,
        prefix: *const [u32; 3],
        to: *const Locator,
    );
    fn ddsi_xmsg_append(message: *mut c_void, marker: *mut c_void, bytes: usize) -> *mut c_void;
    fn ddsi_xpack_addmsg(pack: *mut c_void, message: *mut c_void, flags: u32) -> c_int;
    fn ddsi_qxev_callback(
        events: *mut c_void,
        at: Time,
        callback: EventCallback,
        arg: *const c_void,
        arg_bytes: usize,
        sync_on_delete: bool,
    ) -> *mut c_void;
    fn ddsi_delete_xevent(event: *mut c_void);
}

/// The function `dds__builtin_write_endpoint` of Cyclone, which all its domains share.
static WRITE_ENDPOINT: AtomicPtr<c_void> = AtomicPtr::new(std::ptr::null_mut());

thread_local! {
    /// The writer that this thread of Cyclone discovered last.
    static DISCOVERED: Cell<Option<NewWriter>> = const { Cell::new(None) };
}

#[derive(Clone, Copy)]
struct NewWriter {
    instance: dds_instance_handle_t,
    guid: [u32; 4],
    unicast: Locator,
    events: *mut c_void,
}

/// The watch of the endpoints that a domain discovers. Dropped after the domain, which may end without reporting their
/// end.
#[derive(Debug)]
pub(crate) struct EndpointWatch {
    pub(crate) leases: Leases,
    _late_readers: LateReaders,
}

impl EndpointWatch {
    /// `domain` is the address of its variables.
    fn of_domain(domain: usize) -> Self {
        Self { leases: Leases(domain), _late_readers: LateReaders(domain) }
    }
}

/// Makes Cyclone report the endpoints that it discovers in a domain to this module, by replacing the function with
/// which it publishes them to the built-in topics. Cyclone calls that function once a writer is known, under the
/// writer's lock, before it matches readers and before it handles a heartbeat.
pub(crate) fn install(domain: &Entity, participant: &Entity) -> Result<EndpointWatch, String> {
    // SAFETY: the topic is a constant of Cyclone's; null means its own QoS and no listener.
    let reader = Entity::new(unsafe {
        dds_create_reader(
            participant.handle(),
            DDS_BUILTIN_TOPIC_DCPSPUBLICATION,
            std::ptr::null(),
            std::ptr::null(),
        )
    })?;
    let mut sertype = std::ptr::null();
    // SAFETY: the handle is checked by Cyclone, and `sertype` is a valid place for the result.
    check(unsafe { dds_get_entity_sertype(reader.handle(), &mut sertype) })?;
    // SAFETY: the type of a reader lives as long as the reader, and the built-in types were registered with the domain.
    let gv = unsafe { (*sertype).gv.v };
    if gv <= DOMAIN_HEAD_BYTES_MAX {
        return Err("the domain's variables are nowhere".into());
    }
    // `struct dds_domain` (`dds__types.h`) holds both, one behind the other.
    let topics = (gv - size_of::<BuiltinTopics>()) as *mut BuiltinTopics;
    // SAFETY: `gv` is inside of `struct dds_domain`, far behind its beginning, which outlives the participant.
    let (of, write_endpoint) = unsafe { ((*topics).domain, (*topics).write_endpoint) };
    let distance = gv.wrapping_sub(of as usize);
    if distance > DOMAIN_HEAD_BYTES_MAX || of.align_offset(align_of::<u64>()) != 0 {
        return Err("the domain does not hold its variables".into());
    }
    // SAFETY: it is in the same struct, which begins with the handle of the domain.
    if unsafe { *of.cast::<dds_entity_t>() } != domain.handle() || write_endpoint.is_null() {
        return Err("the domain is not where it should be".into());
    }
    let ours = endpoint_changed as WriteEndpoint as *mut c_void;
    if write_endpoint == ours {
        return Ok(EndpointWatch::of_domain(gv));
    }
    let known = WRITE_ENDPOINT.compare_exchange(
        std::ptr::null_mut(),
        write_endpoint,
        Ordering::AcqRel,
        Ordering::Acquire,
    );
    if known.is_err_and(|known| known != write_endpoint) {
        return Err("domains publish endpoints in different ways".into());
    }
    // SAFETY: the field is aligned, lives as long as the domain, and Cyclone's other threads read it whole; either
    // function does for them.
    unsafe { AtomicPtr::from_ptr(&raw mut (*topics).write_endpoint) }.store(ours, Ordering::Release);
    Ok(EndpointWatch::of_domain(gv))
}

/// Makes the listener of a reliable reader ask writers for a heartbeat.
///
/// # Safety
/// The listener must be valid.
pub(crate) unsafe fn listen(listener: *mut dds_listener_t) {
    // The status stays set for threads that wait for it.
    // SAFETY: valid by contract; the function takes no argument.
    unsafe { dds_lset_subscription_matched_arg(listener, Some(matched), std::ptr::null_mut(), false) };
}

/// Replaces `dds__builtin_write_endpoint`.
unsafe extern "C" fn endpoint_changed(
    entity: *const EntityCommon,
    time: Time,
    alive: bool,
    domain: *mut c_void,
) {
    if alive {
        // SAFETY: Cyclone calls this with an entity that it has locked or that no other thread knows.
        DISCOVERED.set(unsafe { discover(entity, domain) });
    } else {
        // SAFETY: every entity begins with these.
        let (kind, gv, guid) = unsafe { ((*entity).kind, (*entity).gv, (*entity).guid) };
        match kind {
            PROXY_READER => late_readers::forget(entity.cast()),
            _ => manual_leases::forget(gv, guid),
        }
    }
    let original = WRITE_ENDPOINT.load(Ordering::Acquire);
    if !original.is_null() {
        // SAFETY: it is the function that was there, with its own arguments.
        unsafe { std::mem::transmute::<*mut c_void, WriteEndpoint>(original)(entity, time, alive, domain) };
    }
}

/// Keeps the lease of a new reliable writer if necessary, and spares a new reader old samples. Returns the writer if it
/// is one of Fast DDS, whose first heartbeat then skips nothing.
///
/// # Safety
/// `entity` must be a `struct ddsi_entity_common` that may be written to, `domain` the `struct dds_domain` that it
/// belongs to.
unsafe fn discover(entity: *const EntityCommon, domain: *mut c_void) -> Option<NewWriter> {
    // SAFETY: valid by contract, and every entity begins with these.
    let (kind, guid, gv) = unsafe { ((*entity).kind, (*entity).guid, (*entity).gv) };
    let is_of_domain = (gv as usize).wrapping_sub(domain as usize) <= DOMAIN_HEAD_BYTES_MAX;
    let is_endpoint = matches!(kind, PROXY_WRITER | PROXY_READER) && guid[3] & NOT_OF_USERS == 0;
    if !is_endpoint || !is_of_domain || cfg!(target_endian = "big") {
        return None;
    }
    let endpoint = entity.cast::<ProxyEndpoint>();
    // SAFETY: these kinds of entities are endpoints, and the fields in front were where they should be.
    let (vendor, qos, unicast, instance) =
        unsafe { ((*endpoint).vendor, (*endpoint).qos, (*endpoint).unicast, (*endpoint).common.instance) };
    if qos.is_null() {
        return None;
    }
    if kind == PROXY_READER {
        // SAFETY: the reader is new, and the places are inside of its struct.
        unsafe {
            let state = state_of(endpoint, |state: &ProxyReaderState| state.is_new());
            late_readers::spare(gv, entity.cast(), vendor, qos, state);
        }
        return None;
    }
    // SAFETY: the places are inside of the struct.
    let state = unsafe { state_of(endpoint, is_new_and_reliable) }?;
    // SAFETY: the writer is new, as was just seen, and its lease and QoS live as long as it does.
    unsafe { manual_leases::keep(gv, guid, entity.cast(), qos, (*state).lease) };
    if vendor != FAST_DDS {
        return None;
    }
    let mut durability = dds_durability_kind_DDS_DURABILITY_VOLATILE;
    // SAFETY: the QoS of a writer that its lock is held of; a place for the result. Without a durability it is
    // volatile.
    unsafe { dds_qget_durability(qos, &mut durability) };
    if durability == dds_durability_kind_DDS_DURABILITY_VOLATILE {
        // SAFETY: the flags are where they should be, and the writer's lock is held.
        unsafe { (*state).flags |= HAVE_SEEN_HEARTBEAT };
    }
    // SAFETY: as above.
    let events = unsafe { (*state).events };
    Some(NewWriter { instance, guid, unicast, events })
}

/// Returns the place of the rest of an endpoint's struct: the first of the possible ones whose content is as expected.
///
/// # Safety
/// The struct of the endpoint must be at least as long as the rest at its last possible place.
unsafe fn state_of<T>(endpoint: *const ProxyEndpoint, is_expected: impl Fn(&T) -> bool) -> Option<*mut T> {
    SECURITY_BYTES.into_iter().find_map(|security| {
        // SAFETY: inside of the struct by contract.
        let state = unsafe { endpoint.add(1).byte_add(security) }.cast::<T>().cast_mut();
        // SAFETY: as above; any content is a valid value.
        unsafe { is_expected(&*state) }.then_some(state)
    })
}

/// Returns `true` for exactly the state that `ddsi_new_proxy_writer` writes for a reliable writer.
fn is_new_and_reliable(state: &ProxyWriterState) -> bool {
    let flags = state.flags & (HAVE_SEEN_HEARTBEAT | LOCAL_MATCHING_IN_PROGRESS | ALIVE | FILTERED);
    let queues = [state.defragmenter, state.reorder, state.delivery_queue, state.events.cast_const()];
    state.readers.is_null()
        && (state.reliable_readers, state.readers_out_of_sync, state.last_number) == (0, 0, 0)
        && (state.last_fragment, state.nackfrag_count) == (u32::MAX, 1)
        && (state.next_number_to_deliver, state.alive_changes) == (1, 0)
        && flags == LOCAL_MATCHING_IN_PROGRESS | ALIVE
        && queues.iter().all(|queue| !queue.is_null())
}

/// The arguments of an event that asks for a heartbeat.
#[derive(Clone, Copy)]
#[repr(C)]
struct AskArguments {
    reader: [u32; 4],
    writer: [u32; 4],
    to: Locator,
    count: u32,
}

/// The listener for matches. Cyclone calls it on the thread that discovered the writer, while the writer cannot be
/// deleted.
unsafe extern "C" fn matched(
    reader: dds_entity_t,
    status: dds_subscription_matched_status_t,
    _: *mut c_void,
) {
    let Some(writer) = DISCOVERED.get().filter(|w| w.instance == status.last_publication_handle) else {
        return;
    };
    let mut guid = dds_guid_t { v: [0; 16] };
    // SAFETY: the handle is checked by Cyclone, and `guid` is a valid place for the result. A reader that is being made
    // has no handle yet; the writer's periodic heartbeat does for it.
    if check(unsafe { dds_get_guid(reader, &mut guid) }).is_err() {
        return;
    }
    let word = |at: usize| u32::from_be_bytes([guid.v[at], guid.v[at + 1], guid.v[at + 2], guid.v[at + 3]]);
    let reader = [word(0), word(4), word(8), word(12)];
    for (count, delay_ns) in (0..).zip(ASK_DELAYS_NS) {
        let asking = AskArguments { reader, writer: writer.guid, to: writer.unicast, count };
        // SAFETY: the queue of events lives as long as the domain; the argument is copied.
        unsafe {
            let at = Time(monotonic_ns().saturating_add(delay_ns));
            let arg = (&raw const asking).cast();
            ddsi_qxev_callback(writer.events, at, ask, arg, size_of::<AskArguments>(), false);
        }
    }
}

/// An ACKNACK (RTPS 2.5, 9.4.5.3) that acknowledges nothing and asks for nothing but an answer.
#[repr(C)]
struct AckNack {
    kind: u8,
    flags: u8,
    bytes: u16,
    reader: [u8; 4],
    writer: [u8; 4],
    base: [u32; 2],
    bits: u32,
    count: u32,
}

/// `DDSI_XMSG_KIND_CONTROL`.
const CONTROL: c_int = 0;
const ACKNACK: u8 = 0x06;
const LITTLE_ENDIAN: u8 = 0x01;
const SUBMESSAGE_HEAD_BYTES: usize = offset_of!(AckNack, reader);

/// Sends the ACKNACK once.
unsafe extern "C" fn ask(gv: *mut c_void, event: *mut c_void, pack: *mut c_void, arg: *mut c_void, _: Time) {
    /// The pool of messages. It is never freed, because messages may be in transit at any time.
    struct Pool(*mut c_void);
    // SAFETY: Cyclone locks it for every use.
    unsafe impl Send for Pool {}
    // SAFETY: as above.
    unsafe impl Sync for Pool {}
    static POOL: OnceLock<Pool> = OnceLock::new();

    // SAFETY: the copy of what the event was made with, which has no alignment of its own.
    let AskArguments { reader, writer, to, count } = unsafe { arg.cast::<AskArguments>().read_unaligned() };
    let acknack = AckNack {
        kind: ACKNACK,
        flags: LITTLE_ENDIAN,
        bytes: (size_of::<AckNack>() - SUBMESSAGE_HEAD_BYTES) as u16,
        reader: reader[3].to_be_bytes(),
        writer: writer[3].to_be_bytes(),
        base: [0, 0],
        bits: 0,
        count,
    };
    // SAFETY: takes a version of RTPS: 2.1, as Cyclone's own.
    let pool =
        POOL.get_or_init(|| Pool(unsafe { ddsi_xmsgpool_new(ProtocolVersion { major: 2, minor: 1 }) }));
    let (bytes, prefix) = (size_of::<AckNack>(), [writer[0], writer[1], writer[2]]);
    // SAFETY: arguments are copied; a message that there is memory for has room for what is appended, and is the pack's
    // then. The event is deleted once, by its own callback, as Cyclone's are.
    unsafe {
        let message = ddsi_xmsg_new(pool.0, &reader, std::ptr::null(), bytes, CONTROL);
        if !message.is_null() {
            ddsi_xmsg_setdst1_generic(gv, message, &prefix, &to);
            let mut marker = 0_usize;
            let place = ddsi_xmsg_append(message, (&raw mut marker).cast(), bytes);
            place.cast::<AckNack>().write_unaligned(acknack);
            ddsi_xpack_addmsg(pack, message, 0);
        }
        ddsi_delete_xevent(event);
    }
}
