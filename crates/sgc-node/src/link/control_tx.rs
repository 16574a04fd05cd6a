//! The control task's end of a link: its frames, the labels of names, its lanes.

use std::sync::Arc;

use sgc_session::Activity;
use sgc_wire::{Control, Name};

use crate::control::peers::control_queue::ControlQueue;
use crate::data::labels::{LabelBook, NameLabel};
use crate::link::lanes::Lanes;

/// Sends frames of the control task over a link, in order.
pub(crate) struct ControlTx {
    frames: ControlQueue,
    labels: LabelBook,
    activity: Arc<Activity>,
    lanes: Arc<Lanes>,
}

impl ControlTx {
    /// Creates the sender of a link.
    pub(crate) fn new(
        frames: ControlQueue,
        labels: LabelBook,
        activity: Arc<Activity>,
        lanes: Arc<Lanes>,
    ) -> Self {
        Self { frames, labels, activity, lanes }
    }

    /// Returns the label of a name on this link, if it has one. A new label is announced to the peer.
    pub(crate) fn label(&mut self, name: Name) -> Option<NameLabel> {
        let frames = &self.frames;
        self.labels.label(name, |label| frames.push(Control::Label { label, name }))
    }

    /// Returns the flag of packets that crossed the link.
    pub(crate) fn activity(&self) -> &Arc<Activity> {
        &self.activity
    }

    /// Returns the lanes of the link.
    pub(crate) fn lanes(&self) -> &Arc<Lanes> {
        &self.lanes
    }

    /// Returns the number of labels that the peer knows.
    pub(crate) fn labels_known(&self) -> u32 {
        self.labels.known()
    }

    /// Queues a frame. Returns `false` if the peer is too far behind.
    pub(crate) fn send(&self, frame: Control) -> bool {
        self.frames.push(frame)
    }

    /// Queues a flush: the control task is notified when the link has taken all earlier frames. Returns `false` if the
    /// peer is too far behind.
    pub(crate) fn flush(&self) -> bool {
        self.frames.flush()
    }
}
