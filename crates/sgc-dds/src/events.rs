//! Timed events of Cyclone, whose callbacks one thread of the domain runs (`ddsi__xevent.h`).

use std::ffi::{c_int, c_void};

use crate::entity::Time;

/// The callback of an event. It gets the domain's variables, the event, the packets to send, a copy of its argument
/// without alignment of its own, and the time. It runs without the queue's lock, and entities that exist meanwhile are
/// not freed.
pub(crate) type EventCallback =
    unsafe extern "C" fn(gv: *mut c_void, event: *mut c_void, pack: *mut c_void, arg: *mut c_void, now: Time);

// Functions of Cyclone that `cyclors` has no binding for.
unsafe extern "C" {
    /// Makes an event and copies its argument.
    pub(crate) fn ddsi_qxev_callback(
        events: *mut c_void,
        at: Time,
        callback: EventCallback,
        arg: *const c_void,
        arg_bytes: usize,
        sync_on_delete: bool,
    ) -> *mut c_void;
    /// Deletes an event. Its callback may be running, and may still ask for another run in vain.
    pub(crate) fn ddsi_delete_xevent(event: *mut c_void);
    /// Makes an event happen at this time, unless it happens before or is deleted.
    pub(crate) fn ddsi_resched_xevent_if_earlier(event: *mut c_void, at: Time) -> c_int;
}
