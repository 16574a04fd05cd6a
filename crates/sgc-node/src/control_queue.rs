//! Control frames that wait: [`ControlQueue`] for a link to send them, [`Inbox`] for the control task to take them.
//!
//! The inbox is bounded in bytes, for each link and in all. A link beyond its share is not read, so flow control holds back
//! the peer that sends.

use std::sync::Arc;

use sgc_wire::{CONTROL_FRAME_BYTES_MAX, Control};
use tokio::sync::{OwnedSemaphorePermit, Semaphore, mpsc};

/// Control frames that may wait for one link. A peer that takes so long is not one to keep in step with.
pub(crate) const CONTROL_FRAMES_MAX: usize = 8192;
/// Bytes of control frames of one link that may wait for the control task: one of the longest, at least.
pub(crate) const LINK_INBOX_BYTES_MAX: usize = CONTROL_FRAME_BYTES_MAX + FRAME_BYTES;
/// The same of all links.
pub(crate) const INBOX_BYTES_MAX: usize = 32 << 20;
/// Bytes that a frame takes beside its encoding, about.
const FRAME_BYTES: usize = 256;

/// An item that waits for a link.
#[derive(Debug)]
pub(crate) enum Outgoing {
    Frame(Control),
    /// The control task is to hear that the link has taken everything before.
    Flush,
}

/// Queues control frames for one link.
#[derive(Clone, Debug)]
pub(crate) struct ControlQueue(mpsc::Sender<Outgoing>);

impl ControlQueue {
    pub(crate) fn new() -> (Self, mpsc::Receiver<Outgoing>) {
        let (queue, outgoing) = mpsc::channel(CONTROL_FRAMES_MAX);
        (Self(queue), outgoing)
    }

    /// Queues a frame; false if the peer is too far behind, or the link has ended.
    pub(crate) fn push(&self, frame: Control) -> bool {
        self.0.try_send(Outgoing::Frame(frame)).is_ok()
    }

    /// Queues a frame once there is room; false if the link has ended.
    pub(crate) async fn push_later(&self, frame: Control) -> bool {
        self.0.send(Outgoing::Frame(frame)).await.is_ok()
    }

    /// Has the control task told when the link has taken what is queued; false if the peer is too far behind.
    pub(crate) fn flush(&self) -> bool {
        self.0.try_send(Outgoing::Flush).is_ok()
    }
}

/// Room for control frames in the inbox of the control task.
#[derive(Clone, Debug)]
pub(crate) struct Inbox(Arc<Semaphore>);

/// The room that a frame takes, until the control task has handled it.
#[derive(Debug)]
pub(crate) struct FrameRoom {
    _of_link: OwnedSemaphorePermit,
    _of_all: OwnedSemaphorePermit,
}

/// The part of it that one link may use.
#[derive(Debug)]
pub(crate) struct InboxShare {
    of_link: Arc<Semaphore>,
    of_all: Arc<Semaphore>,
}

impl Default for Inbox {
    fn default() -> Self {
        Self(Arc::new(Semaphore::new(INBOX_BYTES_MAX)))
    }
}

impl Inbox {
    pub(crate) fn share(&self) -> InboxShare {
        InboxShare { of_link: Arc::new(Semaphore::new(LINK_INBOX_BYTES_MAX)), of_all: self.0.clone() }
    }
}

impl InboxShare {
    /// Waits until there is room for a frame of so many bytes. Links that wait are served in their order.
    pub(crate) async fn take(&self, encoded_bytes: usize) -> Option<FrameRoom> {
        let bytes = (encoded_bytes + FRAME_BYTES).min(LINK_INBOX_BYTES_MAX).try_into().unwrap_or(u32::MAX);
        let of_link = self.of_link.clone().acquire_many_owned(bytes).await.ok()?;
        let of_all = self.of_all.clone().acquire_many_owned(bytes).await.ok()?;
        Some(FrameRoom { _of_link: of_link, _of_all: of_all })
    }
}
