//! Fragments of received samples, as Cyclone hands them to a type of samples.
//!
//! Cyclone takes a sample for complete once its fragments reach the length that the first one announces. It does not compare
//! that length with the other fragments, which announce one each: a fragment that announces more may reach beyond it. What
//! compares them in Cyclone are assertions, which are not compiled in. [`cover_exactly`] does it here.
//!
//! The structs are those of the C code of `cyclors` =0.4.0: `CYCLORS` in `sample.rs`.

use std::ffi::c_void;

use cyclors::ddsi_rdata;

/// The beginning of `struct ddsi_rdata` (`ddsi_radmin.h`), a fragment of a received sample.
#[repr(C)]
pub(crate) struct ReceivedFragment {
    pub(crate) message: *const ReceivedMessage,
    pub(crate) next: *const ReceivedFragment,
    pub(crate) first: u32,
    pub(crate) end: u32,
    pub(crate) submessage_offset: u16,
    pub(crate) payload_offset: u16,
}

/// `struct ddsi_rmsg` (`ddsi_radmin.h`); the packet follows it.
#[repr(C)]
pub(crate) struct ReceivedMessage {
    references: u32,
    last_chunk: *mut c_void,
    trace: bool,
    chunk_buffer: *mut c_void,
    chunk_next: *mut c_void,
    chunk_bytes: u64,
}

/// Returns `true` if the fragments cover a sample of this length without a gap, and no fragment reaches beyond it.
///
/// # Safety
/// `fragments` must be a chain of fragments that Cyclone hands to a type of samples.
pub(crate) unsafe fn cover_exactly(fragments: *const ddsi_rdata, bytes: usize) -> bool {
    let mut covered = 0;
    let mut at = fragments.cast::<ReceivedFragment>();
    // SAFETY: a chain that ends with null, by contract.
    while let Some(fragment) = unsafe { at.as_ref() } {
        let (first, end) = (fragment.first as usize, fragment.end as usize);
        if first > covered || first > end || end > bytes {
            return false;
        }
        covered = covered.max(end);
        at = fragment.next;
    }
    covered == bytes
}
