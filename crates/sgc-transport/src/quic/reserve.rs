//! Room in the send buffer of a connection for what is urgent. QUIC sends by priority what it was given, but it is given no
//! more than its send window, which patient flows fill: then an urgent one would wait among them for a place.

use std::sync::{Mutex, PoisonError};

use quinn::Connection;

/// What each class may have beyond the one below it, bytes.
const CLASS_BYTES: u64 = 1 << 20;

/// The send window of one connection, and what lies above it.
#[derive(Debug)]
pub(super) struct Reserve {
    connection: Connection,
    window_bytes: u64,
    /// One at a time: who ends first would take the room from the other.
    opening: Mutex<()>,
}

impl Reserve {
    /// Above this window.
    pub(super) fn new(connection: &Connection, window_bytes: u64) -> Self {
        Self { connection: connection.clone(), window_bytes, opening: Mutex::new(()) }
    }

    /// Attempts to write with the room that a stream of this priority has. It is there for so short a time that those
    /// who wait for the window itself do not find it.
    pub(super) fn open<T>(&self, priority: i32, attempt: impl FnOnce() -> T) -> T {
        let _opening = self.opening.lock().unwrap_or_else(PoisonError::into_inner);
        let more = CLASS_BYTES * u64::try_from(priority).unwrap_or(0);
        self.connection.set_send_window(self.window_bytes + more);
        let done = attempt();
        self.connection.set_send_window(self.window_bytes);
        done
    }
}
