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
use std::ffi::c_void;
use std::sync::atomic::{AtomicPtr, Ordering};

use cyclors::{
    DDS_BUILTIN_TOPIC_DCPSPUBLICATION, dds_create_reader, dds_durability_kind_DDS_DURABILITY_VOLATILE,
    dds_entity_t, dds_get_entity_sertype, dds_get_guid, dds_guid_t, dds_instance_handle_t, dds_listener_t,
    dds_lset_subscription_matched_arg, dds_qget_durability, dds_subscription_matched_status_t,
};

use crate::acknack::HeartbeatRequest;
use crate::backpressure::{self, RemoteWriters};
use crate::entity::{Entity, Time, check, monotonic_ns};
use crate::events::{ddsi_delete_xevent, ddsi_qxev_callback};
use crate::identity::FAST_DDS;
use crate::late_readers::{self, LateReaders, ProxyReaderState};
use crate::manual_leases::{self, Leases};
use crate::proxies::{
    EntityCommon, HAVE_SEEN_HEARTBEAT, Locator, PROXY_READER, PROXY_WRITER, ProxyEndpoint, ProxyWriterState,
    state_of,
};

/// Delays after a match with which a reader asks for a heartbeat, in nanoseconds. Cyclone reports the match a few
/// instructions before it would handle a heartbeat for the reader, so on a busy machine the first answer may come too
/// early. The second request is counted as if it were Cyclone's first ACKNACK, so Fast DDS ignores it once Cyclone
/// has sent one.
const ASK_DELAYS_NS: [i64; 2] = [1_000_000, 50_000_000];

/// Bytes of `struct dds_domain` before the structs that are examined here; there are some 600.
const DOMAIN_HEAD_BYTES_MAX: usize = 4096;

/// The bits of an entity id that mark endpoints of discovery and of vendors (RTPS 2.5, 9.3.1.2).
const NOT_OF_USERS: u32 = 0xc0;

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

type WriteEndpoint = unsafe extern "C" fn(*const EntityCommon, Time, bool, *mut c_void);

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
    pub(crate) writers: RemoteWriters,
    _late_readers: LateReaders,
}

impl EndpointWatch {
    /// `domain` is the address of its variables.
    fn of_domain(domain: usize) -> Self {
        Self { leases: Leases(domain), writers: RemoteWriters(domain), _late_readers: LateReaders(domain) }
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
        let (kind, gv, guid, instance) =
            unsafe { ((*entity).kind, (*entity).gv, (*entity).guid, (*entity).instance) };
        match kind {
            PROXY_READER => late_readers::forget(entity.cast()),
            _ => {
                manual_leases::forget(gv, guid);
                backpressure::forget(gv, instance);
            }
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
    let state = unsafe { state_of(endpoint, ProxyWriterState::is_new_and_reliable) }?;
    // SAFETY: the writer is new, as was just seen, and its lease and QoS live as long as it does.
    unsafe { manual_leases::keep(gv, guid, entity.cast(), qos, (*state).lease) };
    // SAFETY: as above.
    unsafe { backpressure::watch(gv, endpoint, state) };
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
        let request = HeartbeatRequest { reader, writer: writer.guid, to: writer.unicast, base: 0, count };
        // SAFETY: the queue of events lives as long as the domain; the argument is copied.
        unsafe {
            let at = Time(monotonic_ns().saturating_add(delay_ns));
            let arg = (&raw const request).cast();
            ddsi_qxev_callback(writer.events, at, ask, arg, size_of::<HeartbeatRequest>(), false);
        }
    }
}

/// Sends the request once.
unsafe extern "C" fn ask(gv: *mut c_void, event: *mut c_void, pack: *mut c_void, arg: *mut c_void, _: Time) {
    // SAFETY: the argument is the copy of what the event was made with, which has no alignment of its own. The event is
    // deleted once, by its own callback, as Cyclone's are.
    unsafe {
        arg.cast::<HeartbeatRequest>().read_unaligned().send(gv, pack);
        ddsi_delete_xevent(event);
    }
}
