//! [`Syncs`]: telling routers that greet the whole state, in parts.
//!
//! The driver's queue for a link is bounded, and a full one ends the link. So a router hands out a part, waits until
//! the link has taken it, and continues. News that come meanwhile go out at once.

use std::collections::BTreeMap;

use sgc_wire::{Control, NodeId, Now, SignedBody};

use crate::lease::verifies_elsewhere;
use crate::link_id::LinkId;
use crate::names::{Names, RecordId};
use crate::topology::Topology;

/// Frames handed out before the link has to have taken them: far fewer than the queue of a link holds.
const TELL_FRAMES_MAX: usize = 256;
/// Bytes of them; one frame may exceed it.
const TELL_BYTES_MAX: usize = 1 << 20;

/// Progress of telling a neighbour the state at the time of its greeting.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Progress {
    /// Link states, in the order of their nodes.
    Nodes { after: Option<NodeId>, end: RecordId },
    /// Advertisements and withdrawals, in the order in which they came, up to the first after the greeting.
    Adverts { next: RecordId, end: RecordId },
}

/// The room for frames that may still be handed out.
struct Room {
    frames: usize,
    bytes: usize,
}

impl Room {
    fn is_left(&self) -> bool {
        self.frames > 0 && self.bytes > 0
    }

    fn take(&mut self, signed: &SignedBody) {
        self.frames = self.frames.saturating_sub(1);
        self.bytes = self.bytes.saturating_sub(signed.body.len() + signed.signature.len());
    }
}

/// A part of the state.
#[derive(Debug)]
pub(crate) struct Part {
    pub(crate) frames: Vec<Control>,
    /// Whether the link has to take these before the next part.
    pub(crate) has_more: bool,
}

/// The parts that routers have not been told yet.
#[derive(Debug, Default)]
pub(crate) struct Syncs {
    of_link: BTreeMap<LinkId, Progress>,
}

impl Syncs {
    /// Begins to tell a router that just greeted the state up to, not including, the record `end`.
    pub(crate) fn begin(&mut self, link: LinkId, end: RecordId) {
        self.of_link.insert(link, Progress::Nodes { after: None, end });
    }

    /// Forgets a link that is gone.
    pub(crate) fn link_down(&mut self, link: LinkId) {
        self.of_link.remove(&link);
    }

    /// Returns the next part for a link.
    pub(crate) fn next_part(
        &mut self,
        now: Now,
        link: LinkId,
        topology: &Topology,
        names: &Names,
    ) -> Option<Part> {
        let mut progress = self.of_link.remove(&link)?;
        let mut frames = Vec::new();
        let mut room = Room { frames: TELL_FRAMES_MAX, bytes: TELL_BYTES_MAX };
        while room.is_left() {
            progress = match progress {
                Progress::Nodes { after, end } => match next_node(now, after, topology, names) {
                    Some((node, signed)) => {
                        room.take(&signed);
                        frames.push(Control::LinkState { signed });
                        Progress::Nodes { after: Some(node), end }
                    }
                    None => Progress::Adverts { next: 0, end },
                },
                Progress::Adverts { next, end } => match names.next_for_router(now, next, end) {
                    Some(id) => {
                        for frame in names.frames(now, id) {
                            if let Control::Advert { signed, .. } = &frame {
                                room.take(signed);
                            }
                            frames.push(frame);
                        }
                        Progress::Adverts { next: id + 1, end }
                    }
                    None => return Some(Part { frames, has_more: false }),
                },
            };
        }
        self.of_link.insert(link, progress);
        Some(Part { frames, has_more: true })
    }
}

/// Returns the next link state for a neighbour that did not ask.
fn next_node(
    now: Now,
    after: Option<NodeId>,
    topology: &Topology,
    names: &Names,
) -> Option<(NodeId, SignedBody)> {
    if !topology.is_transit() {
        return None;
    }
    let unasked = names.tells_unasked();
    let told = topology
        .others_after(after)
        .find(|(_, record)| (record.is_transit() || unasked) && verifies_elsewhere(now, record.issued_at()));
    told.map(|(node, record)| (*node, record.signed().clone()))
}
