//! Cyclone's log, turned into `tracing` events and into the reasons of errors.
//!
//! Cyclone reports *why* a domain cannot be created only to its log. It also prints there what no operator
//! needs to see on stderr. Tracing to a file, if the user's `CYCLONEDDS_URI` asks for it, is not touched.

use std::cell::RefCell;
use std::ffi::{CStr, c_void};
use std::sync::Once;

use cyclors::{DDS_LC_ERROR, DDS_LC_FATAL, DDS_LC_WARNING, dds_log_data_t, dds_set_log_sink};

/// Bound on what one failure may say, bytes.
const REASON_BYTES_MAX: usize = 1024;

thread_local! {
    static HEARD: RefCell<Option<String>> = const { RefCell::new(None) };
}

/// Sends Cyclone's log to `tracing`, for the whole process and for ever.
pub(crate) fn install() {
    static INSTALLED: Once = Once::new();
    // SAFETY: the sink is a function that is valid for ever and ignores its user data.
    INSTALLED.call_once(|| unsafe { dds_set_log_sink(Some(sink), std::ptr::null_mut()) });
}

/// Runs `f` and returns what Cyclone logged as errors on this thread meanwhile, on one line.
pub(crate) fn listen<T>(f: impl FnOnce() -> T) -> (T, String) {
    HEARD.set(Some(String::new()));
    let result = f();
    (result, HEARD.take().unwrap_or_default())
}

unsafe extern "C" fn sink(_: *mut c_void, data: *const dds_log_data_t) {
    // SAFETY: Cyclone passes a valid record for the duration of the call.
    let Some(data) = (unsafe { data.as_ref() }) else { return };
    if data.message.is_null() {
        return;
    }
    // SAFETY: the message is a NUL-terminated string, valid for the duration of the call.
    let message = unsafe { CStr::from_ptr(data.message) }.to_string_lossy();
    let message = message.trim_end();
    if data.priority & (DDS_LC_FATAL | DDS_LC_ERROR) != 0 {
        let heard = HEARD.with_borrow_mut(|heard| match heard {
            Some(text) => {
                if !text.is_empty() {
                    text.push_str("; ");
                }
                let room = REASON_BYTES_MAX.saturating_sub(text.len());
                text.extend(message.chars().take(room));
                true
            }
            None => false,
        });
        if !heard {
            tracing::warn!(target: "cyclonedds", "{message}");
        }
    } else if data.priority & DDS_LC_WARNING != 0 {
        // Cyclone's warnings name topics and types.
        tracing::debug!(target: "cyclonedds", "{message}");
    } else {
        tracing::trace!(target: "cyclonedds", "{message}");
    }
}
