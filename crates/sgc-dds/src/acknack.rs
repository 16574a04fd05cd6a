//! ACKNACKs that acknowledge what is known, and ask for a heartbeat.

use std::ffi::{c_int, c_void};
use std::mem::offset_of;
use std::sync::OnceLock;

use crate::proxies::Locator;

/// An ACKNACK (RTPS 2.5, 9.4.5.3) that asks for no sample. Its writer has to answer it.
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

/// `ddsi_protocol_version_t`.
#[repr(C)]
struct ProtocolVersion {
    major: u8,
    minor: u8,
}

// Functions of Cyclone that `cyclors` has no binding for. `ddsi__xmsg.h`.
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
}

/// A request of a reader to a writer for a heartbeat.
#[derive(Clone, Copy)]
#[repr(C)]
pub(crate) struct HeartbeatRequest {
    pub(crate) reader: [u32; 4],
    pub(crate) writer: [u32; 4],
    pub(crate) to: Locator,
    /// The first sample that is not acknowledged. 0 acknowledges nothing.
    pub(crate) base: u64,
    /// The number of the ACKNACK. Writers ignore one that is not greater than the last.
    pub(crate) count: u32,
}

impl HeartbeatRequest {
    /// Adds the ACKNACK to the packets of an event.
    ///
    /// # Safety
    /// `gv` and `pack` are the arguments of an event's callback.
    pub(crate) unsafe fn send(&self, gv: *mut c_void, pack: *mut c_void) {
        /// The pool of messages. It is never freed, because messages may be in transit at any time.
        struct Pool(*mut c_void);
        // SAFETY: Cyclone locks it for every use.
        unsafe impl Send for Pool {}
        // SAFETY: as above.
        unsafe impl Sync for Pool {}
        static POOL: OnceLock<Pool> = OnceLock::new();

        let acknack = AckNack {
            kind: ACKNACK,
            flags: LITTLE_ENDIAN,
            bytes: (size_of::<AckNack>() - SUBMESSAGE_HEAD_BYTES) as u16,
            reader: self.reader[3].to_be_bytes(),
            writer: self.writer[3].to_be_bytes(),
            base: [(self.base >> 32) as u32, self.base as u32],
            bits: 0,
            count: self.count,
        };
        // SAFETY: takes a version of RTPS: 2.1, as Cyclone's own.
        let pool =
            POOL.get_or_init(|| Pool(unsafe { ddsi_xmsgpool_new(ProtocolVersion { major: 2, minor: 1 }) }));
        let (bytes, prefix) = (size_of::<AckNack>(), [self.writer[0], self.writer[1], self.writer[2]]);
        // SAFETY: arguments are copied; a message that there is memory for has room for what is appended, and is the
        // pack's then.
        unsafe {
            let message = ddsi_xmsg_new(pool.0, &self.reader, std::ptr::null(), bytes, CONTROL);
            if message.is_null() {
                return;
            }
            ddsi_xmsg_setdst1_generic(gv, message, &prefix, &self.to);
            let mut marker = 0_usize;
            let place = ddsi_xmsg_append(message, (&raw mut marker).cast(), bytes);
            place.cast::<AckNack>().write_unaligned(acknack);
            ddsi_xpack_addmsg(pack, message, 0);
        }
    }
}
