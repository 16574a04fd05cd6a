//! Conversion of [`sgc_wire::Qos`] from and to Cyclone's QoS object.
//!
//! `sgc-ros` decides the policies; this module only translates them.

// Cyclone's constants appear in patterns under the names that bindgen gave them.
#![allow(non_upper_case_globals)]

use std::ffi::{CStr, CString, c_char, c_void};
use std::sync::Once;

use cyclors::*;
use sgc_ros::EndpointKind;
// Cyclone does not know the keys, and treats all samples of a keyed topic as one instance.
pub use sgc_ros::KEYED_INSTANCES_KEPT;
use sgc_ros::{KEYED_SAMPLES_MAX, UNACKNOWLEDGED_MIN};
use sgc_wire::{Durability, History, Liveliness, Qos, Reliability, Representations};

use crate::entity::{INFINITE, c_string};
use crate::identity::{CYCLONE, FAST_DDS};

/// Deepest history of an endpoint created here, and the depth of a reader that asks for `KEEP_ALL`. Cyclone's own
/// bound on a reader stops delivery to *every* reader of the domain while it is reached, so a stuck handler would
/// stop the others. A `KEEP_ALL` writer keeps everything unacknowledged and blocks beyond half a megabyte of it; of
/// acknowledged samples late joiners get this many.
pub const HISTORY_DEPTH_MAX: u32 = 4096;

/// Longest wait of a write for a reader that does not acknowledge, in milliseconds. Only `KEEP_ALL` writers wait;
/// others overwrite old samples.
pub const WRITE_BLOCK_MAX_MS: u64 = 2000;

/// Most unacknowledged samples of a writer, if they are short.
pub const UNACKNOWLEDGED_MAX: u32 = 1024;

/// Most unacknowledged bytes of a writer; [`UNACKNOWLEDGED_MIN`] samples may be more.
pub const UNACKNOWLEDGED_BYTES_MAX: usize = 32 << 20;

/// Most unacknowledged bytes of all writers of a network together.
pub const UNACKNOWLEDGED_BYTES_IN_ALL: usize = 256 << 20;

/// Depth of a volatile endpoint that does not announce it, ROS 2's default. With the specification's single sample a
/// writer here would overwrite samples that a slightly late reader has not acknowledged: of nine images of 1 MB from
/// Fast DDS to a stalled Fast DDS subscriber seven were lost, and with a depth of ten none are
/// (`sgc/tests/peers.rs`).
const UNSAID_DEPTH: i32 = 10;

/// Shortest liveliness lease of an endpoint created here, in nanoseconds. Cyclone renews leases after four fifths of
/// the shortest one, so a lease of zero would keep a processor and the network busy.
const LEASE_MIN_NS: i64 = 1_000_000;

/// Data representations by their numbers (XTypes 1.3, 7.6.3.1.1).
const XCDR1: i16 = DDS_DATA_REPRESENTATION_XCDR1 as i16;
const XCDR2: i16 = DDS_DATA_REPRESENTATION_XCDR2 as i16;

/// Cyclone's QoS object, deleted on drop.
pub(crate) struct NativeQos(*mut dds_qos_t);

/// Runs once when Cyclone's tables of policies are built.
static TABLES: Once = Once::new();

impl NativeQos {
    pub(crate) fn new() -> Result<Self, String> {
        // SAFETY: no arguments; allocates. The deleted object was just made.
        let qos = unsafe {
            // Cyclone builds its tables of policies when the first QoS object is deleted, without a lock: a second
            // thread that deletes another one would free parts twice. A domain builds them, too, but need not exist
            // yet.
            TABLES.call_once(|| dds_delete_qos(dds_create_qos()));
            dds_create_qos()
        };
        if qos.is_null() { Err("out of memory".into()) } else { Ok(Self(qos)) }
    }

    /// Creates the QoS of an endpoint.
    pub(crate) fn endpoint(
        kind: EndpointKind,
        qos: &Qos,
        keyless: bool,
        user_data: &[u8],
    ) -> Result<Self, String> {
        let native = Self::new()?;
        let by_key = kind == EndpointKind::Writer && keys_kept(qos, keyless).is_some();
        let (history, depth) = history_of(kind, qos.history, keyless || by_key);
        // SAFETY: the object is valid and every setter copies its arguments.
        unsafe {
            dds_qset_reliability(
                native.0,
                match qos.reliability {
                    Reliability::BestEffort => dds_reliability_kind_DDS_RELIABILITY_BEST_EFFORT,
                    Reliability::Reliable => dds_reliability_kind_DDS_RELIABILITY_RELIABLE,
                },
                WRITE_BLOCK_MAX_MS as i64 * 1_000_000,
            );
            dds_qset_durability(
                native.0,
                match qos.durability {
                    Durability::Volatile => dds_durability_kind_DDS_DURABILITY_VOLATILE,
                    Durability::TransientLocal => dds_durability_kind_DDS_DURABILITY_TRANSIENT_LOCAL,
                    Durability::Transient => dds_durability_kind_DDS_DURABILITY_TRANSIENT,
                    Durability::Persistent => dds_durability_kind_DDS_DURABILITY_PERSISTENT,
                },
            );
            dds_qset_history(native.0, history, depth);
            if qos.is_transient_local() {
                // This policy, whose default is a single sample, decides how much late joiners get.
                let unlimited = DDS_LENGTH_UNLIMITED;
                let last = dds_history_kind_DDS_HISTORY_KEEP_LAST;
                dds_qset_durability_service(native.0, 0, last, depth, unlimited, unlimited, unlimited);
            }
            dds_qset_deadline(native.0, duration(qos.deadline_ns));
            dds_qset_liveliness(
                native.0,
                match qos.liveliness {
                    Liveliness::Automatic => dds_liveliness_kind_DDS_LIVELINESS_AUTOMATIC,
                    Liveliness::ManualByParticipant => {
                        dds_liveliness_kind_DDS_LIVELINESS_MANUAL_BY_PARTICIPANT
                    }
                    Liveliness::ManualByTopic => dds_liveliness_kind_DDS_LIVELINESS_MANUAL_BY_TOPIC,
                },
                duration(qos.lease_ns).max(LEASE_MIN_NS),
            );
            if kind == EndpointKind::Writer {
                dds_qset_lifespan(native.0, duration(qos.lifespan_ns));
                dds_qset_writer_data_lifecycle(native.0, false);
            }
        }
        if !user_data.is_empty() {
            native.set_user_data(user_data);
        }
        native.set_representations(kind, qos.representations);
        Ok(native)
    }

    /// Creates the QoS of a publisher or subscriber, which holds the partitions.
    pub(crate) fn group(partitions: &[String]) -> Result<Self, String> {
        let native = Self::new()?;
        let names: Vec<CString> = partitions.iter().map(|p| c_string(p)).collect::<Result<_, _>>()?;
        let mut pointers: Vec<*const c_char> = names.iter().map(|n| n.as_ptr()).collect();
        // SAFETY: `pointers` holds as many NUL-terminated strings as it says, and they are copied.
        unsafe { dds_qset_partition(native.0, pointers.len() as u32, pointers.as_mut_ptr()) };
        Ok(native)
    }

    /// Makes an endpoint match none of its own participant.
    pub(crate) fn set_ignores_own(&self) {
        // SAFETY: the object is valid; the call takes a number.
        unsafe { dds_qset_ignorelocal(self.0, dds_ignorelocal_kind_DDS_IGNORELOCAL_PARTICIPANT) };
    }

    /// Makes a writer keep this many unacknowledged samples of each instance. Late joiners get as many as before.
    pub(crate) fn set_unacknowledged(&self, kept: SendWindow) {
        // SAFETY: the object is valid.
        unsafe { dds_qset_history(self.0, dds_history_kind_DDS_HISTORY_KEEP_LAST, kept.depth as i32) };
    }

    /// Lets a writer gather samples in one packet until it is flushed.
    pub(crate) fn set_batching(&self) {
        // SAFETY: the object is valid.
        unsafe { dds_qset_writer_batching(self.0, true) };
    }

    pub(crate) fn set_user_data(&self, user_data: &[u8]) {
        // SAFETY: pointer and length are those of a slice, which is copied.
        unsafe { dds_qset_userdata(self.0, user_data.as_ptr().cast(), user_data.len()) };
    }

    /// Sets the data representations. A writer offers one: XCDR2 only if nothing else is allowed.
    fn set_representations(&self, kind: EndpointKind, representations: Representations) {
        let ids: &[i16] = match (kind, representations) {
            (EndpointKind::Reader, Representations::BOTH) => &[XCDR1, XCDR2],
            (_, all) if all.written() == Representations::XCDR2 => &[XCDR2],
            _ => &[XCDR1],
        };
        // SAFETY: the object is valid, and the ids are copied.
        unsafe { dds_qset_data_representation(self.0, ids.len() as u32, ids.as_ptr()) };
    }

    /// Adds a property of a participant, which is not announced.
    pub(crate) fn set_property(&self, name: &str, value: &str) -> Result<(), String> {
        let (name, value) = (c_string(name)?, c_string(value)?);
        // SAFETY: the object is valid, and the call copies both texts.
        unsafe { dds_qset_prop(self.0, name.as_ptr(), value.as_ptr()) };
        Ok(())
    }

    pub(crate) fn as_ptr(&self) -> *const dds_qos_t {
        self.0
    }
}

impl Drop for NativeQos {
    fn drop(&mut self) {
        // SAFETY: created by `dds_create_qos` and deleted once.
        unsafe { dds_delete_qos(self.0) }
    }
}

/// Returns Cyclone's kind and depth of a history.
pub(crate) fn history_of(kind: EndpointKind, history: History, keyless: bool) -> (dds_history_kind_t, i32) {
    let wanted = match history {
        History::KeepLast(n) => n.max(1),
        History::KeepAll => HISTORY_DEPTH_MAX,
    };
    let instances = if keyless { 1 } else { KEYED_INSTANCES_KEPT };
    let depth = wanted.saturating_mul(instances).min(HISTORY_DEPTH_MAX);
    let all = kind == EndpointKind::Writer && history == History::KeepAll;
    let native =
        if all { dds_history_kind_DDS_HISTORY_KEEP_ALL } else { dds_history_kind_DDS_HISTORY_KEEP_LAST };
    (native, depth as i32)
}

/// Returns the number of keys whose samples a writer keeps apart, so that late joiners get the last samples of each.
/// Returns `None` if it keeps the last samples of all keys together.
pub(crate) fn keys_kept(qos: &Qos, keyless: bool) -> Option<u32> {
    match qos.history {
        History::KeepLast(n) if !keyless && qos.is_transient_local() => {
            Some((KEYED_SAMPLES_MAX / n.max(1)).clamp(1, KEYED_INSTANCES_KEPT))
        }
        _ => None,
    }
}

/// The send window: the room for unacknowledged samples of a reliable `KEEP_LAST` writer. Such a writer never waits,
/// so the window depends on memory and not on the publisher's depth. Cyclone keeps `depth` samples of each instance,
/// and a writer spreads its samples over as many instances as their size allows.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) struct SendWindow {
    /// Samples of each instance.
    pub(crate) depth: u32,
    /// Most instances. It is 1 where more would give late joiners too much, miss deadlines, or change the meaning for
    /// readers.
    pub(crate) instances_max: u32,
}

impl SendWindow {
    /// Returns the window of a writer, or `None` if the writer keeps nothing or waits.
    pub(crate) fn for_writer(qos: &Qos, keyless: bool) -> Option<Self> {
        if qos.history == History::KeepAll || !qos.is_reliable() {
            return None;
        }
        let is_by_key = keys_kept(qos, keyless).is_some();
        let (_, depth) = history_of(EndpointKind::Writer, qos.history, keyless || is_by_key);
        let depth = u32::try_from(depth).unwrap_or(1);
        // Late joiners get everything from Cyclone that is kept for others.
        let depth = if qos.is_transient_local() { depth } else { depth.max(UNACKNOWLEDGED_MIN) };
        let is_one = qos.is_transient_local() || qos.deadline_ns.is_some() || !keyless;
        Some(Self { depth, instances_max: if is_one { 1 } else { (UNACKNOWLEDGED_MAX / depth).max(1) } })
    }

    /// Restricts the window to one instance, for a writer whose samples reach readers of its own participant
    /// unchanged.
    pub(crate) fn for_one_instance(self) -> Self {
        Self { instances_max: 1, ..self }
    }

    /// Returns the number of instances for samples of this size, given the number of writers.
    pub(crate) fn instances(self, bytes: usize, writers: usize) -> u32 {
        let allowed = (UNACKNOWLEDGED_BYTES_IN_ALL / writers.max(1)).min(UNACKNOWLEDGED_BYTES_MAX);
        let of_one = bytes.max(1).saturating_mul(self.depth as usize);
        u32::try_from(allowed / of_one).unwrap_or(u32::MAX).clamp(1, self.instances_max)
    }
}

fn duration(ns: Option<u64>) -> i64 {
    ns.map_or(INFINITE, |ns| i64::try_from(ns).unwrap_or(INFINITE))
}

fn finite(ns: i64) -> Option<u64> {
    u64::try_from(ns).ok().filter(|_| ns != INFINITE)
}

/// Reads the QoS that a program of this vendor announced for an endpoint. Omitted policies have the defaults of the
/// specification (DDS 1.4, 2.2.3). Returns `None` if the QoS cannot be carried because of too many or too long
/// partitions.
///
/// Few vendors announce history, and Cyclone fills in a missing one, so that it looks like a history of a single
/// sample. Cyclone's own programs mean that. For others the depth of the durability service is taken for late
/// joiners, and [`UNSAID_DEPTH`] for volatile endpoints. Reliable writers of Fast DDS on topics without keys reveal
/// the depth later, with their messages ([`crate::fragments::kept_by_writer`]); until then it is [`History::UNSAID`].
///
/// # Safety
/// `qos` must be a valid QoS object.
pub(crate) unsafe fn discovered(
    kind: EndpointKind,
    vendor: [u8; 2],
    keyless: bool,
    qos: *const dds_qos_t,
) -> Option<Qos> {
    let mut reliability = match kind {
        EndpointKind::Reader => dds_reliability_kind_DDS_RELIABILITY_BEST_EFFORT,
        EndpointKind::Writer => dds_reliability_kind_DDS_RELIABILITY_RELIABLE,
    };
    let mut durability = dds_durability_kind_DDS_DURABILITY_VOLATILE;
    let (mut history, mut depth) = (dds_history_kind_DDS_HISTORY_KEEP_LAST, 1);
    let (mut deadline, mut lifespan, mut lease) = (INFINITE, INFINITE, INFINITE);
    let mut liveliness = dds_liveliness_kind_DDS_LIVELINESS_AUTOMATIC;
    let mut unused = [0_i64; 2];
    let mut limits = [0_i32; 3];
    let [max_samples, max_instances, max_per_instance] = &mut limits;
    let [blocking, cleanup] = &mut unused;
    let mut is_unsaid = false;
    // SAFETY: `qos` is valid by contract; getters write only to the places given, and only if the policy
    // is present.
    unsafe {
        dds_qget_reliability(qos, &mut reliability, blocking);
        dds_qget_durability(qos, &mut durability);
        dds_qget_history(qos, &mut history, &mut depth);
        let by_default = history == dds_history_kind_DDS_HISTORY_KEEP_LAST && depth == 1;
        if by_default && vendor != CYCLONE {
            if durability == dds_durability_kind_DDS_DURABILITY_VOLATILE {
                depth = UNSAID_DEPTH;
            } else {
                dds_qget_durability_service(
                    qos,
                    cleanup,
                    &mut history,
                    &mut depth,
                    max_samples,
                    max_instances,
                    max_per_instance,
                );
                // The kept messages of a keyed topic are not consecutive, so no depth follows from them.
                is_unsaid = kind == EndpointKind::Writer
                    && (vendor, keyless) == (FAST_DDS, true)
                    && reliability == dds_reliability_kind_DDS_RELIABILITY_RELIABLE
                    && history == dds_history_kind_DDS_HISTORY_KEEP_LAST
                    && depth == 1;
            }
        }
        dds_qget_deadline(qos, &mut deadline);
        dds_qget_lifespan(qos, &mut lifespan);
        dds_qget_liveliness(qos, &mut liveliness, &mut lease);
    }
    Some(Qos {
        reliability: reliability_from(reliability),
        durability: durability_from(durability),
        history: if is_unsaid {
            History::UNSAID
        } else if history == dds_history_kind_DDS_HISTORY_KEEP_ALL {
            History::KeepAll
        } else {
            History::KeepLast(u32::try_from(depth).unwrap_or(1).max(1))
        },
        deadline_ns: finite(deadline),
        lifespan_ns: finite(lifespan),
        liveliness: liveliness_from(liveliness),
        lease_ns: finite(lease),
        // SAFETY: as above.
        partitions: unsafe { partitions(qos) }?,
        // SAFETY: as above.
        representations: unsafe { representations(kind, qos) },
    })
}

fn reliability_from(kind: dds_reliability_kind_t) -> Reliability {
    if kind == dds_reliability_kind_DDS_RELIABILITY_RELIABLE {
        Reliability::Reliable
    } else {
        Reliability::BestEffort
    }
}

fn durability_from(kind: dds_durability_kind_t) -> Durability {
    match kind {
        dds_durability_kind_DDS_DURABILITY_TRANSIENT_LOCAL => Durability::TransientLocal,
        dds_durability_kind_DDS_DURABILITY_TRANSIENT => Durability::Transient,
        dds_durability_kind_DDS_DURABILITY_PERSISTENT => Durability::Persistent,
        _ => Durability::Volatile,
    }
}

fn liveliness_from(kind: dds_liveliness_kind_t) -> Liveliness {
    match kind {
        dds_liveliness_kind_DDS_LIVELINESS_MANUAL_BY_PARTICIPANT => Liveliness::ManualByParticipant,
        dds_liveliness_kind_DDS_LIVELINESS_MANUAL_BY_TOPIC => Liveliness::ManualByTopic,
        _ => Liveliness::Automatic,
    }
}

/// Returns the representations that an endpoint accepts or offers. The first entry of a writer's list counts (XTypes
/// 1.3, 7.6.3.1.1).
///
/// # Safety
/// `qos` must be a valid QoS object.
unsafe fn representations(kind: EndpointKind, qos: *const dds_qos_t) -> Representations {
    let (mut n, mut values) = (0_u32, std::ptr::null_mut::<dds_data_representation_id_t>());
    // SAFETY: `qos` is valid by contract; on success `values` is an array of `n` numbers that is ours to free.
    if !unsafe { dds_qget_data_representation(qos, &mut n, &mut values) } || values.is_null() {
        return Representations::default();
    }
    let looked_at = if kind == EndpointKind::Writer { n.min(1) } else { n };
    // SAFETY: the array has at least that many entries.
    let ids = unsafe { std::slice::from_raw_parts(values, looked_at as usize) };
    let known = ids.iter().filter_map(|id| match *id {
        XCDR1 => Some(Representations::XCDR1),
        XCDR2 => Some(Representations::XCDR2),
        _ => None,
    });
    let all = known.reduce(Representations::or).unwrap_or_default();
    // SAFETY: allocated by the getter for the caller, freed once.
    unsafe { dds_free(values.cast()) };
    all
}

/// # Safety
/// `qos` must be a valid QoS object.
unsafe fn partitions(qos: *const dds_qos_t) -> Option<Vec<String>> {
    let (mut n, mut names) = (0_u32, std::ptr::null_mut::<*mut c_char>());
    // SAFETY: `qos` is valid by contract; on success `names` is an array of `n` strings, all ours to free.
    if !unsafe { dds_qget_partition(qos, &mut n, &mut names) } || names.is_null() {
        return Some(Vec::new());
    }
    let mut partitions = Some(Vec::new());
    for i in 0..n as usize {
        // SAFETY: `i` is below `n`, so this is one of the strings.
        let name = unsafe { *names.add(i) };
        // SAFETY: a NUL-terminated string that lives until it is freed below.
        let text = unsafe { CStr::from_ptr(name) }.to_str();
        partitions = match (partitions, text) {
            (Some(mut list), Ok(text))
                if text.len() <= Qos::PARTITION_BYTES_MAX && list.len() < Qos::PARTITIONS_MAX =>
            {
                list.push(text.to_owned());
                Some(list)
            }
            _ => None,
        };
        // SAFETY: allocated by the getter for the caller, freed once.
        unsafe { dds_free(name.cast()) };
    }
    // SAFETY: allocated by the getter for the caller, freed once.
    unsafe { dds_free(names.cast()) };
    // One empty name is the default partition (DDS 1.4, 2.2.3.13).
    partitions.map(|list| if list == [""] { Vec::new() } else { list })
}

/// Returns the USER_DATA of a discovered endpoint, or nothing if it has none.
///
/// # Safety
/// `qos` must be a valid QoS object.
pub(crate) unsafe fn user_data(qos: *const dds_qos_t) -> Vec<u8> {
    let (mut data, mut bytes) = (std::ptr::null_mut::<c_void>(), 0_usize);
    // SAFETY: `qos` is valid by contract; on success `data` is a copy that is ours to free.
    if !unsafe { dds_qget_userdata(qos, &mut data, &mut bytes) } || data.is_null() {
        return Vec::new();
    }
    // SAFETY: the getter returned that many bytes.
    let copy = unsafe { std::slice::from_raw_parts(data.cast::<u8>(), bytes) }.to_vec();
    // SAFETY: allocated by the getter for the caller, freed once.
    unsafe { dds_free(data) };
    copy
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Sets a QoS and reads it back, as discovery does with an announced one.
    fn round_trip(kind: EndpointKind, qos: &Qos, keyless: bool) -> Qos {
        let native = NativeQos::endpoint(kind, qos, keyless, b"sgc=x;").unwrap();
        // SAFETY: a valid object that outlives the calls.
        unsafe {
            assert_eq!(user_data(native.as_ptr()), b"sgc=x;");
            discovered(kind, CYCLONE, keyless, native.as_ptr()).unwrap()
        }
    }

    #[test]
    fn every_policy_survives() {
        for reliability in [Reliability::BestEffort, Reliability::Reliable] {
            for durability in [
                Durability::Volatile,
                Durability::TransientLocal,
                Durability::Transient,
                Durability::Persistent,
            ] {
                for liveliness in
                    [Liveliness::Automatic, Liveliness::ManualByParticipant, Liveliness::ManualByTopic]
                {
                    let qos = Qos {
                        reliability,
                        durability,
                        history: History::KeepLast(7),
                        deadline_ns: Some(1_000),
                        lifespan_ns: Some(2_000),
                        liveliness,
                        lease_ns: Some(3_000_000),
                        partitions: vec![],
                        representations: Representations::XCDR2,
                    };
                    assert_eq!(round_trip(EndpointKind::Writer, &qos, true), qos);
                }
            }
        }
        assert_eq!(round_trip(EndpointKind::Reader, &Qos::default(), true), Qos::default());
    }

    #[test]
    fn partitions_survive_and_the_empty_one_is_none() {
        let read = |names: &[String]| {
            let native = NativeQos::group(names).unwrap();
            // SAFETY: a valid object that outlives the call.
            unsafe { partitions(native.as_ptr()) }
        };
        let names = ["a".to_owned(), "b*".to_owned()];
        assert_eq!(read(&names).unwrap(), names);
        assert_eq!(read(&[]).unwrap(), Vec::<String>::new());
        assert_eq!(read(&[String::new()]).unwrap(), Vec::<String>::new());
        assert_eq!(read(&vec!["x".to_owned(); Qos::PARTITIONS_MAX + 1]), None);
        assert_eq!(read(&["x".repeat(Qos::PARTITION_BYTES_MAX + 1)]), None);
        assert!(NativeQos::group(&["a\0b".to_owned()]).is_err());
    }

    #[test]
    fn silence_means_the_defaults_of_the_specification_and_of_ros_2() {
        let native = NativeQos::new().unwrap();
        // SAFETY: a valid object that outlives the calls.
        let (reader, writer) = unsafe {
            (
                discovered(EndpointKind::Reader, FAST_DDS, true, native.as_ptr()).unwrap(),
                discovered(EndpointKind::Writer, FAST_DDS, true, native.as_ptr()).unwrap(),
            )
        };
        assert_eq!(reader.reliability, Reliability::BestEffort);
        assert_eq!(writer.reliability, Reliability::Reliable);
        assert_eq!(writer.history, History::KeepLast(UNSAID_DEPTH as u32));
        assert_eq!((writer.durability, writer.lease_ns), (Durability::Volatile, None));
    }

    /// An endpoint that omits its history appears with the default of the specification, which Cyclone fills in.
    #[test]
    fn a_single_sample_of_another_vendor_is_no_depth() {
        let read_of = |keyless, vendor, durability, history, service_depth| {
            let native = NativeQos::endpoint(
                EndpointKind::Writer,
                &Qos { durability, history, ..Qos::default() },
                true,
                &[],
            )
            .unwrap();
            let (last, unlimited) = (dds_history_kind_DDS_HISTORY_KEEP_LAST, DDS_LENGTH_UNLIMITED);
            // SAFETY: a valid object that outlives the calls.
            unsafe {
                dds_qset_durability_service(
                    native.0,
                    0,
                    last,
                    service_depth,
                    unlimited,
                    unlimited,
                    unlimited,
                );
                discovered(EndpointKind::Writer, vendor, keyless, native.as_ptr()).unwrap().history
            }
        };
        let (volatile, latched) = (Durability::Volatile, Durability::TransientLocal);
        let last = History::KeepLast;
        let read = |vendor, durability, history, depth| read_of(true, vendor, durability, history, depth);
        assert_eq!(read(FAST_DDS, volatile, last(1), 1), last(UNSAID_DEPTH as u32));
        assert_eq!(read(FAST_DDS, volatile, last(5), 1), last(5));
        assert_eq!(read(FAST_DDS, volatile, History::KeepAll, 1), History::KeepAll);
        assert_eq!(read(FAST_DDS, latched, last(1), 1), History::UNSAID);
        assert_eq!(read_of(false, FAST_DDS, latched, last(1), 1), last(1));
        assert_eq!(read([0x01, 0x12], latched, last(1), 1), last(1));
        assert_eq!(read(FAST_DDS, latched, last(1), 7), last(7));
        assert_eq!(read(CYCLONE, volatile, last(1), 1), last(1));
        assert_eq!(read(CYCLONE, latched, last(1), 7), last(1));
    }

    #[test]
    fn history_is_bounded_and_deeper_for_keyed_topics() {
        let depth = |kind, history, keyless| history_of(kind, history, keyless).1;
        let (reader, writer) = (EndpointKind::Reader, EndpointKind::Writer);
        let last = dds_history_kind_DDS_HISTORY_KEEP_LAST;
        assert_eq!(history_of(reader, History::KeepAll, true), (last, HISTORY_DEPTH_MAX as i32));
        assert_eq!(depth(writer, History::KeepLast(u32::MAX), false), HISTORY_DEPTH_MAX as i32);
        assert_eq!(depth(writer, History::KeepLast(0), true), 1);
        assert_eq!(depth(writer, History::KeepLast(2), false), 2 * KEYED_INSTANCES_KEPT as i32);
        let all = Qos { history: History::KeepAll, ..Qos::default() };
        assert_eq!(round_trip(writer, &all, true), all);
    }

    #[test]
    fn unacknowledged_samples_are_kept_within_memory() {
        let reliable = |n| Qos { history: History::KeepLast(n), ..Qos::default() };
        let of = |n| SendWindow::for_writer(&reliable(n), true).unwrap();
        let window = |n, bytes, writers| of(n).depth * of(n).instances(bytes, writers);
        assert_eq!(window(1, 100, 1), UNACKNOWLEDGED_MAX);
        assert_eq!(window(1, UNACKNOWLEDGED_BYTES_MAX / 64, 1), 64);
        assert_eq!(window(1, usize::MAX, 1), UNACKNOWLEDGED_MIN, "no fewer");
        assert_eq!(window(2000, 100, 1), 2000, "what its publisher keeps is kept");
        let bytes = UNACKNOWLEDGED_BYTES_IN_ALL / 1000 / 32;
        assert_eq!(
            (window(1, bytes, 1), window(1, bytes, 1000)),
            (UNACKNOWLEDGED_MAX, 32),
            "all share the room"
        );
        let latched = Qos { durability: Durability::TransientLocal, ..reliable(1) };
        let timed = Qos { deadline_ns: Some(1), ..reliable(1) };
        for (qos, keyless) in [(latched, true), (timed, true), (reliable(1), false)] {
            assert_eq!(SendWindow::for_writer(&qos, keyless).unwrap().instances_max, 1, "{qos:?}");
        }
        let waits = Qos { history: History::KeepAll, ..Qos::default() };
        let best_effort = Qos { reliability: Reliability::BestEffort, ..Qos::default() };
        assert_eq!([waits, best_effort].map(|qos| SendWindow::for_writer(&qos, true)), [None, None]);
    }

    #[test]
    fn a_lease_has_a_least_length() {
        let leased = |ns| Qos { lease_ns: Some(ns), ..Qos::default() };
        let least = LEASE_MIN_NS as u64;
        assert_eq!(round_trip(EndpointKind::Writer, &leased(0), true), leased(least));
        assert_eq!(round_trip(EndpointKind::Writer, &leased(least + 1), true), leased(least + 1));
    }

    #[test]
    fn durations_beyond_what_dds_can_say_are_infinite() {
        assert_eq!(duration(None), INFINITE);
        assert_eq!(duration(Some(u64::MAX)), INFINITE);
        assert_eq!((finite(INFINITE), finite(-1), finite(5)), (None, None, Some(5)));
    }
}
