//! Parameters of endpoint announcements (SEDP): those that Cyclone omits, and one that it must not see.
//!
//! - The participant of each endpoint. Fast DDS 3 shows an endpoint without it as one of no ROS node.
//! - The request of a reader for inline QoS, if [`asking`] created it. With it come the key hashes, which Fast DDS 2
//!   sends only on request. Cyclone's writers refuse to match such a reader.
//! - The type identifiers (XTypes 1.3, 7.6.3.2.2) in received announcements. Cyclone asks for the types, considers
//!   those of Fast DDS 3 invalid, and then ignores all further endpoints with them. A network here needs only names and
//!   hashes of types.
//!
//! An announcement is a sample of a built-in type, which builds it from a list of parameters. [`complete`] gives the
//! two types of a domain another table of functions, which calls Cyclone's and adds to the result. It finds the types
//! by `struct ddsi_sertype_plist` of the Cyclone that `cyclors` =0.4.0 builds (`sample.rs`, `CYCLORS`). If they are
//! not found, announcements stay as Cyclone makes them.

use std::cell::Cell;
use std::ffi::{CStr, c_void};
use std::sync::OnceLock;
use std::sync::atomic::{AtomicPtr, Ordering};

use cyclors::{
    ddsi_domaingv, ddsi_keyhash, ddsi_rdata, ddsi_serdata, ddsi_serdata_kind, ddsi_serdata_kind_SDK_DATA,
    ddsi_serdata_ops, ddsi_serdata_unref, ddsi_sertype, ddsi_sertype_fini, ddsi_sertype_init_flags,
    ddsi_sertype_lookup_locked, ddsi_sertype_ops, ddsi_sertype_unref, ddsrt_iovec_t,
};

use crate::identity::{PID_SENTINEL, Parameters};
use crate::payload::HEADER_BYTES;

/// PID_PARTICIPANT_GUID, PID_ENDPOINT_GUID and PID_EXPECTS_INLINE_QOS (RTPS 2.5, table 9.14).
const PID_PARTICIPANT_GUID: u16 = 0x0050;
const PID_ENDPOINT_GUID: u16 = 0x005a;
const PID_EXPECTS_INLINE_QOS: u16 = 0x0043;

/// PID_TYPE_INFORMATION (XTypes 1.3, 7.6.3.2.2), and a parameter without a meaning, which readers ignore.
const PID_TYPE_INFORMATION: u16 = 0x0075;
const PID_IGNORED: u16 = 0x3f75;

/// The entity id of every participant (RTPS 2.5, table 9.2).
const ENTITYID_PARTICIPANT: [u8; 4] = [0x00, 0x00, 0x01, 0xc1];

/// `DDSI_RTPS_CDR_ENC_FORMAT_PL`: lists of parameters.
const ENCODING_FORMAT_PL: u16 = 2;

/// The types with which Cyclone announces readers and writers (`ddsi_init.c`).
const TYPES: [&CStr; 2] = [c"SubscriptionBuiltinTopicData", c"PublicationBuiltinTopicData"];

// Tables of functions in `ddsi__serdata_plist.h` for which `cyclors` has no binding.
#[allow(improper_ctypes)]
unsafe extern "C" {
    static ddsi_sertype_ops_plist: ddsi_sertype_ops;
    static ddsi_serdata_ops_plist: ddsi_serdata_ops;
}

/// `struct ddsi_sertype_plist`.
#[repr(C)]
struct ParameterListType {
    common: ddsi_sertype,
    encoding_format: u16,
    key: u16,
}

thread_local! {
    /// `true` while this thread creates a reader that expects inline QoS.
    static ASKS: Cell<bool> = const { Cell::new(false) };
}

/// Runs `make` to create a reader, which expects inline QoS if `asks`. Cyclone announces a reader on the thread that
/// creates it.
pub(crate) fn asking<T>(asks: bool, make: impl FnOnce() -> T) -> T {
    let before = ASKS.replace(asks);
    let made = make();
    ASKS.set(before);
    made
}

/// Completes the announcements of a domain from now on. Returns `false` if its types are not as expected.
///
/// # Safety
/// `sertype` must be registered in the domain, and no other thread may register types there meanwhile.
pub(crate) unsafe fn complete(sertype: *const ddsi_sertype) -> bool {
    // SAFETY: valid by contract.
    let domain = unsafe { (*sertype).gv.v } as *mut ddsi_domaingv;
    // SAFETY: by contract.
    !domain.is_null() && TYPES.into_iter().all(|name| unsafe { complete_type(domain, name) })
}

/// # Safety
/// `domain` must be valid, and no other thread may register types there meanwhile.
unsafe fn complete_type(domain: *mut ddsi_domaingv, name: &CStr) -> bool {
    // SAFETY: all zeros is a valid value of this plain C struct, which the call fills; the name is copied, and both
    // tables live for ever. The type that is found is compared with functions of the first table, which read no more
    // than the struct has.
    let found = unsafe {
        let mut like = ParameterListType {
            common: std::mem::zeroed(),
            encoding_format: ENCODING_FORMAT_PL,
            key: PID_ENDPOINT_GUID,
        };
        let (ops, original) = (&raw const ddsi_sertype_ops_plist, &raw const ddsi_serdata_ops_plist);
        ddsi_sertype_init_flags(&raw mut like.common, name.as_ptr(), ops, original, 0);
        let found = ddsi_sertype_lookup_locked(domain, &raw const like.common);
        like.common.flags_refc.v = 0;
        ddsi_sertype_fini(&raw mut like.common);
        found
    };
    if found.is_null() {
        return false;
    }
    // SAFETY: a type of the domain, of which the look-up gave a reference; threads of Cyclone's read the pointer
    // meanwhile, and do alike with either table.
    unsafe {
        let table = std::ptr::from_ref(table()).cast_mut();
        AtomicPtr::from_ptr((&raw mut (*found).serdata_ops).cast::<*mut ddsi_serdata_ops>())
            .store(table, Ordering::Release);
        ddsi_sertype_unref(found);
    }
    true
}

/// Returns Cyclone's functions, with replacements for those that make samples.
fn table() -> &'static ddsi_serdata_ops {
    struct Table(ddsi_serdata_ops);
    // SAFETY: function pointers, which are never written to.
    unsafe impl Send for Table {}
    // SAFETY: as above.
    unsafe impl Sync for Table {}
    static TABLE: OnceLock<Table> = OnceLock::new();
    let table = TABLE.get_or_init(|| {
        Table(ddsi_serdata_ops {
            from_ser: Some(from_ser),
            from_keyhash: Some(from_keyhash),
            from_sample: Some(from_sample),
            ..original()
        })
    });
    &table.0
}

/// Returns Cyclone's own table.
fn original() -> ddsi_serdata_ops {
    // SAFETY: a constant of Cyclone's.
    unsafe { ddsi_serdata_ops_plist }
}

/// Gives a received sample Cyclone's own table, because Cyclone adds the sender's vendor only to samples with that
/// one. Sent samples keep the table of their type, because Cyclone compares it with that of the sample that it makes
/// to keep their key.
///
/// # Safety
/// `sample` must be null, or valid and not shared yet.
unsafe fn finish(sample: *mut ddsi_serdata) -> *mut ddsi_serdata {
    // SAFETY: by contract.
    unsafe {
        if let Some(sample) = sample.as_mut() {
            sample.ops = &raw const ddsi_serdata_ops_plist;
        }
    }
    sample
}

// Cyclone calls the functions below, from its own threads, with arguments that are valid as its headers say.

unsafe extern "C" fn from_ser(
    sertype: *const ddsi_sertype,
    kind: ddsi_serdata_kind,
    fragments: *const ddsi_rdata,
    bytes: usize,
) -> *mut ddsi_serdata {
    let Some(call) = original().from_ser else { return std::ptr::null_mut() };
    // SAFETY: Cyclone's arguments for Cyclone's function, then a sample that it made.
    unsafe {
        let made = call(sertype, kind, fragments, bytes);
        if made.is_null() || kind != ddsi_serdata_kind_SDK_DATA {
            return finish(made);
        }
        finish(changed(sertype, made, |list| hide_type(list)).unwrap_or(made))
    }
}

unsafe extern "C" fn from_keyhash(
    sertype: *const ddsi_sertype,
    hash: *const ddsi_keyhash,
) -> *mut ddsi_serdata {
    let Some(call) = original().from_keyhash else { return std::ptr::null_mut() };
    // SAFETY: Cyclone's arguments for Cyclone's function.
    unsafe { finish(call(sertype, hash)) }
}

unsafe extern "C" fn from_sample(
    sertype: *const ddsi_sertype,
    kind: ddsi_serdata_kind,
    sample: *const c_void,
) -> *mut ddsi_serdata {
    let Some(call) = original().from_sample else { return std::ptr::null_mut() };
    // SAFETY: Cyclone's arguments for Cyclone's function, then a sample that it made.
    unsafe {
        let made = call(sertype, kind, sample);
        if made.is_null() || kind != ddsi_serdata_kind_SDK_DATA {
            return made;
        }
        changed(sertype, made, |list| add_missing(list, ASKS.get())).unwrap_or(made)
    }
}

/// Replaces an announcement by one with another list of parameters.
///
/// # Safety
/// `made` must be a sample of `sertype`, of Cyclone's own making.
unsafe fn changed(
    sertype: *const ddsi_sertype,
    made: *mut ddsi_serdata,
    change: impl FnOnce(&mut Vec<u8>) -> Option<()>,
) -> Option<*mut ddsi_serdata> {
    let ops = original();
    let (get_size, to_ser, from_ser_iov) = (ops.get_size?, ops.to_ser?, ops.from_ser_iov?);
    // SAFETY: by contract; `list` has room for the sample, header included.
    let mut list = unsafe {
        let mut list = vec![0; get_size(made) as usize];
        to_ser(made, 0, list.len(), list.as_mut_ptr().cast());
        list
    };
    change(&mut list)?;
    let piece = ddsrt_iovec_t { iov_base: list.as_mut_ptr().cast(), iov_len: list.len() };
    let bytes = list.len() - HEADER_BYTES;
    // SAFETY: one piece, which lives until the call returns, and its length without the header.
    let changed = unsafe { from_ser_iov(sertype, ddsi_serdata_kind_SDK_DATA, 1, &raw const piece, bytes) };
    if changed.is_null() {
        return None;
    }
    // SAFETY: the only reference to a sample that nobody has seen.
    unsafe { ddsi_serdata_unref(made) };
    Some(changed)
}

/// Renumbers each type identifier to a parameter that is ignored. Returns `None` if there is none.
fn hide_type(list: &mut [u8]) -> Option<()> {
    let big = list.get(1)? & 1 == 0;
    let (mut at, mut found) = (HEADER_BYTES, Vec::new());
    for parameter in Parameters::new(list.get(HEADER_BYTES..)?, big) {
        let (pid, value) = parameter?;
        if pid == PID_TYPE_INFORMATION {
            found.push(at);
        }
        at += 4 + value.len();
    }
    let number = if big { PID_IGNORED.to_be_bytes() } else { PID_IGNORED.to_le_bytes() };
    for at in &found {
        list.get_mut(*at..)?.get_mut(..2)?.copy_from_slice(&number);
    }
    (!found.is_empty()).then_some(())
}

/// Adds to the list of parameters of an announcement, in the byte order of this machine. Returns `None` if there is
/// nothing to add, or if it is not such a list.
fn add_missing(list: &mut Vec<u8>, expects_inline_qos: bool) -> Option<()> {
    let (mut endpoint, mut has_participant, mut bytes) = (None, false, HEADER_BYTES);
    for parameter in Parameters::new(list.get(HEADER_BYTES..)?, cfg!(target_endian = "big")) {
        let (pid, value) = parameter?;
        match pid {
            PID_ENDPOINT_GUID => endpoint = value.first_chunk::<16>().copied(),
            PID_PARTICIPANT_GUID => has_participant = true,
            _ => {}
        }
        bytes += 4 + value.len();
    }
    let mut participant = endpoint.filter(|_| !has_participant)?;
    participant[12..].copy_from_slice(&ENTITYID_PARTICIPANT);
    list.truncate(bytes);
    let mut add = |pid: u16, value: &[u8]| {
        list.extend_from_slice(&pid.to_ne_bytes());
        list.extend_from_slice(&(value.len() as u16).to_ne_bytes());
        list.extend_from_slice(value);
    };
    add(PID_PARTICIPANT_GUID, &participant);
    if expects_inline_qos {
        add(PID_EXPECTS_INLINE_QOS, &[1, 0, 0, 0]);
    }
    add(PID_SENTINEL, &[]);
    Some(())
}

#[cfg(test)]
mod tests {
    use rand_chacha::ChaCha8Rng;
    use rand_core::{RngCore, SeedableRng};

    use super::*;

    fn parameter(pid: u16, value: &[u8]) -> Vec<u8> {
        [&pid.to_ne_bytes()[..], &(value.len() as u16).to_ne_bytes(), value].concat()
    }

    fn list(parameters: &[Vec<u8>]) -> Vec<u8> {
        [&[0, 3, 0, 0][..], &parameters.concat(), &parameter(PID_SENTINEL, &[])].concat()
    }

    #[test]
    fn announcements_get_the_participant_and_what_is_asked() {
        let endpoint = parameter(PID_ENDPOINT_GUID, &[7; 16]);
        let participant = parameter(PID_PARTICIPANT_GUID, &[&[7; 12][..], &[0, 0, 1, 0xc1]].concat());
        let asks = parameter(PID_EXPECTS_INLINE_QOS, &[1, 0, 0, 0]);
        for expects in [false, true] {
            let mut made = list(&[parameter(5, &[1; 8]), endpoint.clone()]);
            assert!(add_missing(&mut made, expects).is_some());
            let asks = if expects { asks.clone() } else { Vec::new() };
            assert_eq!(made, list(&[parameter(5, &[1; 8]), endpoint.clone(), participant.clone(), asks]));
        }
    }

    #[test]
    fn types_are_hidden_and_all_else_stays() {
        let endpoint = parameter(PID_ENDPOINT_GUID, &[7; 16]);
        let type_of = |pid| list(&[endpoint.clone(), parameter(pid, &[5; 12])]);
        let mut received = type_of(PID_TYPE_INFORMATION);
        assert!(hide_type(&mut received).is_some());
        assert_eq!(received, type_of(PID_IGNORED));
        assert!(hide_type(&mut received).is_none());
        let twice = |pid| list(&[parameter(pid, &[5; 12]), endpoint.clone(), parameter(pid, &[6; 12])]);
        let mut received = twice(PID_TYPE_INFORMATION);
        assert!(hide_type(&mut received).is_some());
        assert_eq!(received, twice(PID_IGNORED));
        let mut cut = type_of(PID_TYPE_INFORMATION);
        cut.truncate(HEADER_BYTES + 22);
        assert!(hide_type(&mut cut).is_none());
    }

    #[test]
    fn other_lists_stay_as_they_are() {
        let (endpoint, participant) =
            (parameter(PID_ENDPOINT_GUID, &[7; 16]), parameter(PID_PARTICIPANT_GUID, &[8; 16]));
        for mut made in [list(&[]), list(&[endpoint.clone(), participant]), vec![0, 3], endpoint] {
            let before = made.clone();
            assert!(add_missing(&mut made, true).is_none());
            assert_eq!(made, before);
        }
    }

    /// Panics if an announcement is hidden in part, or completed twice.
    fn check(list: &[u8], expects_inline_qos: bool) {
        let pids = |list: &[u8], big| -> Vec<_> {
            Parameters::new(&list[HEADER_BYTES..], big).map(|p| p.expect("a whole list").0).collect()
        };
        let mut hidden = list.to_vec();
        if hide_type(&mut hidden).is_some() {
            assert!(!pids(&hidden, hidden[1] & 1 == 0).contains(&PID_TYPE_INFORMATION));
            assert_eq!(hidden.len(), list.len());
        }
        let mut complete = list.to_vec();
        if add_missing(&mut complete, expects_inline_qos).is_some() {
            assert!(pids(&complete, cfg!(target_endian = "big")).contains(&PID_PARTICIPANT_GUID));
            assert_eq!(add_missing(&mut complete.clone(), expects_inline_qos), None, "it is added twice");
        }
    }

    #[test]
    fn altered_announcements_are_dealt_with_whole_or_not_at_all() {
        let mut random = ChaCha8Rng::seed_from_u64(1);
        let mut below = |bound: usize| random.next_u32() as usize % bound;
        let parts = [(PID_ENDPOINT_GUID, 16), (PID_TYPE_INFORMATION, 12), (5, 8), (PID_TYPE_INFORMATION, 4)];
        let whole = list(&parts.map(|(pid, bytes)| parameter(pid, &[7; 16][..bytes])));
        for n in 0..20_000 {
            let mut altered = whole.clone();
            for _ in 0..below(4) {
                let at = below(altered.len());
                altered[at] = below(256) as u8;
            }
            altered.truncate(whole.len() - below(1 + n % 16));
            check(&altered, n % 2 == 0);
        }
    }
}
