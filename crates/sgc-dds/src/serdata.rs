//! Ownership of Cyclone's reference-counted samples (`serdata`), in and out.
//!
//! A received sample becomes [`Bytes`] without a copy; a sample to write is copied once, into Cyclone.
//! Only serdata of the blob type of `cyclors` come here: always contiguous, and free of any reference to
//! the domain they came from, so the bytes may outlive it.

use std::ffi::c_void;

use bytes::Bytes;
use cyclors::{
    DDSI_STATUSINFO_DISPOSE, ddsi_serdata, ddsi_serdata_from_ser_iov, ddsi_serdata_kind_SDK_DATA,
    ddsi_serdata_kind_SDK_KEY, ddsi_serdata_size, ddsi_serdata_to_ser_ref, ddsi_serdata_to_ser_unref,
    ddsi_serdata_unref, ddsi_sertype, ddsrt_iovec_t,
};

use sgc_ros::SampleKind;

use crate::payload::Frame;
use crate::topic;

/// One reference to a sample.
#[derive(Debug)]
pub(crate) struct Serdata(*mut ddsi_serdata);

// SAFETY: the reference count is atomic, the content is never changed after construction, and freeing a
// blob is a plain `free` on any thread.
unsafe impl Send for Serdata {}

impl Serdata {
    /// Takes over a reference.
    ///
    /// # Safety
    /// `sample` must be a valid blob serdata of which the caller owns one reference.
    pub(crate) unsafe fn from_raw(sample: *mut ddsi_serdata) -> Self {
        Self(sample)
    }

    /// Copies a payload into a new sample: one of data, or of a key alone.
    ///
    /// # Safety
    /// `sertype` must be a valid blob sertype; Cyclone keeps it while the sample is in use.
    pub(crate) unsafe fn build(
        sertype: *const ddsi_sertype,
        key_only: bool,
        frame: &Frame<'_>,
    ) -> Option<Self> {
        const ZEROS: [u8; 4] = [0; 4];
        let piece = |bytes: &[u8]| ddsrt_iovec_t {
            iov_base: bytes.as_ptr().cast_mut().cast::<c_void>(),
            iov_len: bytes.len(),
        };
        let pieces = [
            piece(&frame.header),
            piece(&frame.prefix[..frame.prefix_bytes]),
            piece(frame.body),
            piece(&ZEROS[..frame.pad]),
        ];
        let kind = if key_only { ddsi_serdata_kind_SDK_KEY } else { ddsi_serdata_kind_SDK_DATA };
        // SAFETY: the sertype is valid by contract; the pieces are slices that live through the call, are
        // only read, and add up to the size given.
        let sample =
            unsafe { ddsi_serdata_from_ser_iov(sertype, kind, pieces.len(), pieces.as_ptr(), frame.bytes()) };
        (!sample.is_null()).then_some(Self(sample))
    }

    /// Stamps a sample that is not shared yet: source time in nanoseconds, RTPS status info bits.
    pub(crate) fn stamp(&mut self, source_timestamp_ns: i64, statusinfo: u32) {
        // SAFETY: valid while the reference is held, and `build` made the only one.
        unsafe {
            (*self.0).timestamp.v = source_timestamp_ns;
            (*self.0).statusinfo = statusinfo;
        }
    }

    /// What a received sample says of its instance.
    pub(crate) fn kind(&self) -> SampleKind {
        // SAFETY: valid while the reference is held.
        let (status, key_only) = unsafe { ((*self.0).statusinfo, topic::is_key_only(self.0)) };
        match key_only {
            true if status & DDSI_STATUSINFO_DISPOSE != 0 => SampleKind::Dispose,
            true => SampleKind::Unregister,
            false => SampleKind::Write,
        }
    }

    /// Gives the reference away, to a call that consumes it.
    pub(crate) fn into_raw(self) -> *mut ddsi_serdata {
        let sample = self.0;
        std::mem::forget(self);
        sample
    }

    /// The payload, which keeps the sample alive. The sample must hold data: what Cyclone makes up for
    /// changes of instance state has no payload.
    pub(crate) fn into_payload(self) -> Bytes {
        // SAFETY: valid while the reference is held.
        let size = unsafe { ddsi_serdata_size(self.0) } as usize;
        let mut view = ddsrt_iovec_t { iov_base: std::ptr::null_mut(), iov_len: 0 };
        // SAFETY: the whole sample is asked for; the call takes a reference of its own and fills `view`.
        let sample = unsafe { ddsi_serdata_to_ser_ref(self.0, 0, size, &mut view) };
        Bytes::from_owner(Payload { sample, view })
    }
}

impl Drop for Serdata {
    fn drop(&mut self) {
        // SAFETY: one reference is owned and given back once.
        unsafe { ddsi_serdata_unref(self.0) }
    }
}

/// The serialised form of a sample, held by reference.
struct Payload {
    sample: *mut ddsi_serdata,
    view: ddsrt_iovec_t,
}

// SAFETY: as for `Serdata`; the view points into memory that is read only and lives with the sample.
unsafe impl Send for Payload {}

impl AsRef<[u8]> for Payload {
    fn as_ref(&self) -> &[u8] {
        if self.view.iov_base.is_null() || self.view.iov_len == 0 {
            return &[];
        }
        // SAFETY: Cyclone returned this pointer and length, valid until the reference is given back, and
        // nobody writes to it.
        unsafe { std::slice::from_raw_parts(self.view.iov_base.cast(), self.view.iov_len) }
    }
}

impl Drop for Payload {
    fn drop(&mut self) {
        // SAFETY: gives back what `into_payload` took, once.
        unsafe { ddsi_serdata_to_ser_unref(self.sample, &self.view) }
    }
}
