//! Queues of control frames: [`ControlQueue`] in front of a link, and [`Inbox`] in front of the control task.
//!
//! The inbox is bounded in bytes per link and in total. A link beyond its share is not read, so flow control slows the
//! sending peer.

use std::sync::Arc;

use sgc_wire::{CONTROL_FRAME_BYTES_MAX, Control};
use tokio::sync::{OwnedSemaphorePermit, Semaphore, mpsc};

/// Most control frames that wait for one link. A peer that lags further loses its link.
pub(crate) const CONTROL_FRAMES_MAX: usize = 8192;
/// Most bytes of one link's frames that wait for the control task: room for one of the longest.
pub(crate) const LINK_INBOX_BYTES_MAX: usize = CONTROL_FRAME_BYTES_MAX + FRAME_BYTES;
/// Most bytes of all links' frames that wait for the control task.
pub(crate) const INBOX_BYTES_MAX: usize = 32 << 20;
/// Approximate memory of a frame beside its encoding.
const FRAME_BYTES: usize = 256;

/// An item that waits for a link.
#[derive(Debug)]
pub(crate) enum Outgoing {
    Frame(Control),
    /// Notify the control task when the link has taken everything before.
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

    /// Queues a frame. Returns `false` if the peer is too far behind, or the link has ended.
    pub(crate) fn push(&self, frame: Control) -> bool {
        self.0.try_send(Outgoing::Frame(frame)).is_ok()
    }

    /// Queues a frame once there is room. Returns `false` if the link has ended.
    pub(crate) async fn push_later(&self, frame: Control) -> bool {
        self.0.send(Outgoing::Frame(frame)).await.is_ok()
    }

    /// Queues a flush, which notifies the control task when the link has taken everything before. Returns `false` if
    /// the peer is too far behind.
    pub(crate) fn flush(&self) -> bool {
        self.0.try_send(Outgoing::Flush).is_ok()
    }
}

/// Room for control frames in the control task's inbox.
#[derive(Clone, Debug)]
pub(crate) struct Inbox(Arc<Semaphore>);

/// Room of one frame, held until the control task has handled it.
#[derive(Debug)]
pub(crate) struct FrameRoom {
    _of_link: OwnedSemaphorePermit,
    _of_all: OwnedSemaphorePermit,
}

/// One link's share of the inbox.
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
    /// Waits for room for a frame of this encoded length. Waiting links are served in order.
    pub(crate) async fn take(&self, encoded_bytes: usize) -> Option<FrameRoom> {
        let bytes = (encoded_bytes + FRAME_BYTES).min(LINK_INBOX_BYTES_MAX).try_into().unwrap_or(u32::MAX);
        let of_link = self.of_link.clone().acquire_many_owned(bytes).await.ok()?;
        let of_all = self.of_all.clone().acquire_many_owned(bytes).await.ok()?;
        Some(FrameRoom { _of_link: of_link, _of_all: of_all })
    }
}
