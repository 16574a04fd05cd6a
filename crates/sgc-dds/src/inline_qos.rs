//! Additional parameters in the inline QoS of a message under construction, for which Cyclone has no call.
//!
//! Cyclone asks a sample for its payload after it has written the header of the submessage with its own parameters,
//! and before it sets the length of the submessage. At that point parameters can still be added. This needs `struct
//! ddsi_xmsg` of the Cyclone that `cyclors` =0.4.0 builds (`sample.rs`, `CYCLORS`). [`add`] states its assumptions,
//! and leaves the message alone if they do not hold.

use std::ffi::{c_int, c_void};
use std::mem::offset_of;

use cyclors::{ddsi_serdata, ddsrt_iovec_t};

use crate::identity::{PID_KEY_HASH, PID_STATUS_INFO, Parameters};

/// One parameter: its id, and a value whose length is a multiple of four.
pub(crate) type Parameter<'a> = (u16, &'a [u8]);

// Functions of Cyclone that `cyclors` has no binding for. `ddsi__xmsg.h`.
#[allow(improper_ctypes)]
unsafe extern "C" {
    fn ddsi_xmsg_addpar(message: *mut Xmsg, pid: u16, bytes: usize) -> *mut c_void;
    fn ddsi_xmsg_addpar_sentinel(message: *mut Xmsg);
    fn ddsi_xmsg_submsg_from_marker(message: *mut Xmsg, marker: XmsgMarker) -> *mut c_void;
}

/// The beginning of `struct ddsi_xmsg` (`ddsi_xmsg.c`), a message under construction.
#[repr(C)]
struct Xmsg {
    pool: *mut c_void,
    bytes_max: usize,
    bytes: usize,
    have_parameters: c_int,
    payload: *mut ddsi_serdata,
    payload_view: ddsrt_iovec_t,
}

/// `struct ddsi_xmsg_marker`: the beginning of a submessage in a message.
#[repr(C)]
struct XmsgMarker {
    offset: usize,
}

/// RTPS submessage kinds and their lengths up to the inline QoS, bytes (RTPS 2.5, 9.4.5.4 and 9.4.5.5).
pub(crate) const DATA: (u8, usize) = (0x15, 24);
pub(crate) const DATA_FRAG: (u8, usize) = (0x16, 36);

/// Position from which `octetsToInlineQos` counts, in bytes from the beginning of the submessage.
pub(crate) const INLINE_QOS_BASE: usize = 8;

/// The flag of submessages with inline QoS (RTPS 2.5, 9.4.5.4.1).
pub(crate) const FLAG_INLINE_QOS: u8 = 0x02;

/// The flag of submessages in little-endian byte order (RTPS 2.5, 9.4.5.1.2).
pub(crate) const FLAG_LITTLE_ENDIAN: u8 = 0x01;

/// Length of the sentinel that ends a list of parameters, bytes.
const SENTINEL_BYTES: usize = 4;

/// Lengths of the lists that Cyclone writes: none; its status info, its key hash, or both, with the sentinel, in
/// bytes.
const LIST_BYTES: [usize; 4] = [0, 8 + SENTINEL_BYTES, 20 + SENTINEL_BYTES, 28 + SENTINEL_BYTES];

/// A submessage whose header is at the end of a message.
struct Submessage {
    offset: usize,
    /// `true` if Cyclone began its inline QoS.
    has_list: bool,
    has_key_hash: bool,
}

/// Adds parameters to a message that ends with the header of a sample's submessage. `view` is the place of the
/// payload in the message. A key hash that Cyclone has written stays.
///
/// # Safety
/// `view` must be the `refd_payload_iov` of a `struct ddsi_xmsg` of Cyclone DDS 11 as `cyclors` =0.4.0 builds it:
/// `ddsi_xmsg_serdata` is the only function there that asks for the payload of a sample of this crate's sertype.
/// (Others ask for keys, or copy samples for readers of the same participant with another sertype. Those of a proxy are
/// ignored, and in any other network all endpoints of a topic are of one sertype: those that [`crate::sample::topic`]
/// makes are equal, so that Cyclone keeps one of them.)
pub(crate) unsafe fn add(view: *mut ddsrt_iovec_t, parameters: &[Parameter<'_>]) -> bool {
    // SAFETY: by contract the view is that field of that struct.
    let message = unsafe { view.cast::<u8>().sub(offset_of!(Xmsg, payload_view)).cast::<Xmsg>() };
    // SAFETY: valid by contract.
    let Some(Submessage { offset, has_list, has_key_hash }) = (unsafe { submessage(message) }) else {
        return false;
    };
    if has_list {
        // The added parameters replace the sentinel.
        // SAFETY: valid by contract; the list is in the message and ends with it.
        unsafe { (*message).bytes -= SENTINEL_BYTES };
    }
    for (pid, value) in parameters.iter().filter(|(pid, _)| !(has_key_hash && *pid == PID_KEY_HASH)) {
        // SAFETY: returns room for as many bytes as asked for.
        unsafe {
            let place = ddsi_xmsg_addpar(message, *pid, value.len()).cast::<u8>();
            place.copy_from_nonoverlapping(value.as_ptr(), value.len());
        }
    }
    // SAFETY: as above; the header is looked up again, since adding may have moved the message.
    unsafe {
        ddsi_xmsg_addpar_sentinel(message);
        let header = ddsi_xmsg_submsg_from_marker(message, XmsgMarker { offset }).cast::<u8>();
        *header.add(1) |= FLAG_INLINE_QOS;
    }
    true
}

/// Finds the submessage that a message ends with, by its header and by the absence of parameters other than Cyclone's
/// own.
///
/// # Safety
/// `message` must be valid.
unsafe fn submessage(message: *mut Xmsg) -> Option<Submessage> {
    // SAFETY: valid by contract.
    let (bytes, has_parameters, has_payload) = unsafe {
        let message = &*message;
        (message.bytes, message.have_parameters != 0, !message.payload.is_null())
    };
    if has_payload {
        return None;
    }
    let lists = LIST_BYTES.into_iter().filter(|bytes| (*bytes > 0) == has_parameters);
    let both = lists.flat_map(|list| [DATA, DATA_FRAG].map(|submessage| (list, submessage)));
    both.into_iter().find_map(|(list, (kind, length))| {
        let offset = bytes.checked_sub(length + list).filter(|at| at % 4 == 0)?;
        // SAFETY: the offset is in the message, so many bytes from its end.
        let submessage = unsafe {
            let at = ddsi_xmsg_submsg_from_marker(message, XmsgMarker { offset }).cast::<u8>();
            std::slice::from_raw_parts(at, length + list)
        };
        let to_inline_qos = usize::from(u16::from_ne_bytes([submessage[6], submessage[7]]));
        let has_list = submessage[1] & FLAG_INLINE_QOS != 0;
        if submessage[0] != kind || INLINE_QOS_BASE + to_inline_qos != length || has_list != (list > 0) {
            return None;
        }
        let (mut expected, mut has_key_hash) = (SENTINEL_BYTES, false);
        let list_of = if has_list { &submessage[length..] } else { &[] };
        for parameter in Parameters::new(list_of, cfg!(target_endian = "big")).take_while(|_| has_list) {
            let (pid, value) = parameter?;
            if !matches!(pid, PID_KEY_HASH | PID_STATUS_INFO) {
                return None;
            }
            has_key_hash |= pid == PID_KEY_HASH;
            expected += 4 + value.len();
        }
        (!has_list || expected == list).then_some(Submessage { offset, has_list, has_key_hash })
    })
}
