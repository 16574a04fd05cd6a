//! Ownership of DDS entities: [`Entity`] deletes on drop.
//!
//! Owners declare their fields so that children drop before parents, because Cyclone deletes the children of a
//! deleted entity, and a handle must not be deleted twice.

use std::ffi::{CStr, CString};

use cyclors::{
    dds_create_readcondition, dds_delete, dds_entity_t, dds_get_guid, dds_guid_t, dds_return_t,
    dds_strretcode,
};
use sgc_ros::Guid;

/// `ddsrt_wctime_t` and `ddsrt_mtime_t` (`ddsrt/time.h`), nanoseconds.
#[repr(C)]
#[derive(Clone, Copy)]
pub(crate) struct Time(pub(crate) i64);

// A function of Cyclone that `cyclors` has no binding for. `ddsrt/time.h`.
unsafe extern "C" {
    fn ddsrt_time_monotonic() -> Time;
}

/// Returns the time of Cyclone's monotonic clock, in nanoseconds.
pub(crate) fn monotonic_ns() -> i64 {
    // SAFETY: takes nothing.
    unsafe { ddsrt_time_monotonic() }.0
}

/// Cyclone's infinite duration.
pub(crate) const INFINITE: i64 = i64::MAX;

/// A DDS entity that is deleted when dropped.
#[derive(Debug)]
pub(crate) struct Entity(dds_entity_t);

impl Entity {
    /// Wraps the handle that a create function returned, or returns the reason why it failed.
    pub(crate) fn new(handle: dds_entity_t) -> Result<Self, String> {
        if handle > 0 { Ok(Self(handle)) } else { Err(reason(handle)) }
    }

    /// Returns the handle, for calls into Cyclone while `self` lives.
    pub(crate) fn handle(&self) -> dds_entity_t {
        self.0
    }

    /// Returns the GUID of a participant, reader or writer.
    pub(crate) fn guid(&self) -> Result<Guid, String> {
        let mut guid = dds_guid_t { v: [0; 16] };
        // SAFETY: the handle is checked by Cyclone, and `guid` is a valid place for the result.
        check(unsafe { dds_get_guid(self.0, &mut guid) })?;
        Ok(Guid(guid.v))
    }

    /// Returns a condition that is true while the reader `self` holds samples of any state.
    pub(crate) fn read_condition(&self) -> Result<Self, String> {
        // SAFETY: takes two numbers; the handle is checked by Cyclone.
        Self::new(unsafe { dds_create_readcondition(self.0, cyclors::DDS_ANY_STATE) })
    }
}

impl Drop for Entity {
    fn drop(&mut self) {
        // SAFETY: takes a number, checked by Cyclone; nothing refers to the entity any more.
        let ret = unsafe { dds_delete(self.0) };
        if ret < 0 {
            tracing::debug!(reason = reason(ret), "deleting a DDS entity failed");
        }
    }
}

/// Converts a negative return code to an error with the reason.
pub(crate) fn check(ret: dds_return_t) -> Result<(), String> {
    if ret < 0 { Err(reason(ret)) } else { Ok(()) }
}

/// Returns Cyclone's text for a return code.
pub(crate) fn reason(ret: dds_return_t) -> String {
    // SAFETY: returns a pointer to a string constant for every argument, never null.
    let text = unsafe { CStr::from_ptr(dds_strretcode(ret)) };
    text.to_string_lossy().into_owned()
}

/// Converts a text to a C string, or returns the reason why it cannot be one.
pub(crate) fn c_string(text: &str) -> Result<CString, String> {
    CString::new(text).map_err(|_| format!("{text:?} contains a NUL"))
}
