//! Pauses between the fragments of a long message.
//!
//! Cyclone sends the fragments of a message without a pause. A ROS 2 subscriber has a receive buffer of the kernel's
//! default size (`net.core.rmem_default`, 208 KiB), which holds some twelve fragments, so of a megabyte it would lose
//! half and ask for it after the next heartbeat. A pause lets the subscriber's thread empty its buffer. Meanwhile the
//! lock under which acknowledgements are handled is free: `transmit_sample_lgmsg_unlocks_wr` of the Cyclone that
//! `cyclors` =0.4.0 builds sends fragments outside of it. Others of the same writer wait, as they do for each long
//! message. Readers of Cyclone ask for a larger buffer, so a writer that has no other readers pauses less often.

use std::cell::Cell;
use std::thread;
use std::time::Duration;

use crate::config::FRAGMENT_BYTES;

/// Bytes that are sent without a pause: eight fragments, so that other packets have room in the buffer, too.
const BURST_BYTES: usize = 8 * FRAGMENT_BYTES as usize;

/// The same if all readers ask for a larger buffer than the default, as Cyclone's do, of which the kernel grants twice
/// the default (`net.core.rmem_max`).
const LONG_BURST_BYTES: usize = 4 * BURST_BYTES;

/// Pause after a burst. A subscriber's thread takes a burst within it, and a megabyte leaves within two milliseconds,
/// faster than Ethernet at a gigabit a second carries it.
const PAUSE: Duration = Duration::from_micros(100);

thread_local! {
    /// The burst of the long message that this thread writes.
    static BURST: Cell<Option<Burst>> = const { Cell::new(None) };
}

/// The address and port of a receiver.
pub(crate) type Receiver = ([u8; 16], u32);

/// The bytes that may still be sent before a pause. Each fragment goes to all receivers in turn, so the packets to the
/// first one count for all.
#[derive(Clone, Copy, Debug)]
struct Burst {
    /// Bytes of a whole burst.
    bytes: usize,
    left: usize,
    first: Option<Receiver>,
}

impl Burst {
    fn begin(bytes: usize) -> Self {
        Self { bytes, left: bytes, first: None }
    }

    /// Records a packet of this length. Returns `true` if a pause is due before it.
    fn send(&mut self, to: Receiver, bytes: usize) -> bool {
        if *self.first.get_or_insert(to) != to {
            return false;
        }
        let is_over = bytes > self.left;
        let left = if is_over { self.bytes } else { self.left };
        self.left = left.saturating_sub(bytes);
        is_over
    }
}

/// Makes this thread send in bursts, until dropped.
#[derive(Debug)]
pub(crate) struct Bursts(());

impl Bursts {
    /// Begins a message of this length. Returns `None` if it is sent at once. `has_small_buffers` tells if a reader
    /// may have a receive buffer of the default size, and is called for messages longer than the shorter burst.
    pub(crate) fn begin(message_bytes: usize, has_small_buffers: impl FnOnce() -> bool) -> Option<Self> {
        if message_bytes <= BURST_BYTES {
            return None;
        }
        let bytes = if has_small_buffers() { BURST_BYTES } else { LONG_BURST_BYTES };
        (message_bytes > bytes).then(|| {
            BURST.set(Some(Burst::begin(bytes)));
            Self(())
        })
    }
}

impl Drop for Bursts {
    fn drop(&mut self) {
        BURST.set(None);
    }
}

/// Returns `true` if this thread sends in bursts.
pub(crate) fn is_bursting() -> bool {
    BURST.get().is_some()
}

/// Pauses before a packet of this length if the burst of this thread is over.
pub(crate) fn before_packet(to: Receiver, bytes: usize) {
    let Some(mut burst) = BURST.get() else { return };
    let is_over = burst.send(to, bytes);
    BURST.set(Some(burst));
    if is_over {
        thread::sleep(PAUSE);
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_pause_is_due_whenever_a_burst_is_full() {
        let fragment = FRAGMENT_BYTES as usize;
        let mut burst = Burst::begin(BURST_BYTES);
        let [first, second] = [1, 2].map(|last| ([last; 16], 7410));
        let due: Vec<usize> = (0..30)
            .filter(|_| {
                let is_due = burst.send(first, fragment);
                assert!(!burst.send(second, fragment), "packets to others come with those to the first");
                is_due
            })
            .collect();
        assert_eq!(due, [8, 16, 24]);
        // A packet longer than a burst is sent after a pause, and alone.
        assert_eq!([1, BURST_BYTES + 1, 1].map(|bytes| burst.send(first, bytes)), [false, true, true]);
    }

    #[test]
    fn only_the_thread_of_a_long_message_sends_in_bursts() {
        let begin = |bytes, is_small| Bursts::begin(bytes, || is_small);
        assert!(begin(BURST_BYTES, true).is_none() && begin(LONG_BURST_BYTES, false).is_none());
        assert!(!is_bursting());
        drop(begin(LONG_BURST_BYTES + 1, false).unwrap());
        let bursts = begin(BURST_BYTES + 1, true);
        assert!(is_bursting());
        assert!(!thread::spawn(is_bursting).join().unwrap());
        drop(bursts);
        assert!(!is_bursting());
    }
}
