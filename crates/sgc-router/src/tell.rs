//! Telling neighbours: the whole state for one that greets, in parts, and announcements beyond their signers'
//! allowances.
//!
//! The driver's queue for a link is bounded, and a full one ends the link. So a router hands out a part, waits until
//! the link has taken it, and continues. News that come meanwhile go out at once.

use std::collections::VecDeque;
use std::ops::Bound;
use std::time::Duration;

use sgc_wire::{Control, NodeId, Now, SignedBody};

use crate::names::RecordId;
use crate::router::{LinkId, Output, Router};

/// Frames handed out before the link has to have taken them: far fewer than the queue of a link holds.
const TELL_FRAMES_MAX: usize = 256;
/// Bytes of them; one frame may exceed it.
const TELL_BYTES_MAX: usize = 1 << 20;
/// Interval of looks at announcements beyond the allowance of their signer.
const LATE_EVERY: Duration = Duration::from_millis(100);

/// Progress of telling a neighbour the state at the time of its greeting.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum SyncProgress {
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

impl Router {
    /// Begins to tell a router that just greeted the state of the network and of names.
    pub(crate) fn begin_sync(&mut self, link: LinkId) {
        // This node's own link state comes first: routes to it wait for that.
        if let Some(record) = self.topology.node(&self.config.node) {
            let signed = record.signed.clone();
            self.send(link, Control::LinkState { signed });
        }
        let end = self.names.next_id();
        if let Some(state) = self.links.get_mut(&link) {
            state.sync = Some(SyncProgress::Nodes { after: None, end });
        }
        self.continue_sync(link);
    }

    /// Tells the next part, and asks for a notice when the link has taken it if there is more.
    pub(crate) fn continue_sync(&mut self, link: LinkId) {
        let Some(mut sync) = self.links.get_mut(&link).and_then(|state| state.sync.take()) else {
            return;
        };
        let mut room = Room { frames: TELL_FRAMES_MAX, bytes: TELL_BYTES_MAX };
        while room.is_left() {
            let next = match sync {
                SyncProgress::Nodes { after, end } => match self.next_node(after) {
                    Some((node, signed)) => {
                        room.take(&signed);
                        self.send(link, Control::LinkState { signed });
                        SyncProgress::Nodes { after: Some(node), end }
                    }
                    None => SyncProgress::Adverts { next: 0, end },
                },
                SyncProgress::Adverts { next, end } => match self.next_advert(next, end) {
                    Some(id) => {
                        for frame in self.record_frames(id, 0) {
                            if let Control::Advert { signed, .. } = &frame {
                                room.take(signed);
                            }
                            self.send(link, frame);
                        }
                        SyncProgress::Adverts { next: id + 1, end }
                    }
                    None => return,
                },
            };
            sync = next;
        }
        if let Some(state) = self.links.get_mut(&link) {
            state.sync = Some(sync);
            self.outputs.push_back(Output::Flush { link });
        }
    }

    /// Returns the next link state for a neighbour that did not ask.
    fn next_node(&self, after: Option<NodeId>) -> Option<(NodeId, SignedBody)> {
        if !self.config.transit {
            return None;
        }
        let unasked = self.mapping.tells_unasked();
        let from = after.map_or(Bound::Unbounded, Bound::Excluded);
        let mut nodes = self.topology.nodes_from(from);
        let told = nodes.find(|(node, record)| {
            **node != self.config.node
                && (record.transit || unasked)
                && self.verifies_elsewhere(record.issued_at)
        });
        told.map(|(node, record)| (*node, record.signed.clone()))
    }

    /// Passes on a new advertisement or withdrawal, now or when the allowance of its owner permits.
    pub(crate) fn pass_on_or_wait(&mut self, link: LinkId, owner: &NodeId, id: RecordId) {
        let now = self.now.instant;
        if link == LinkId::LOCAL || self.allowance(owner).may_announce(now) {
            self.tell_record_to_routers(link, owner, id);
        } else {
            self.charge_stale(link);
            self.names.wait(owner, id);
            self.late_at.get_or_insert(now + LATE_EVERY);
        }
    }

    /// Passes on a new link state, now or when the allowance of its node permits.
    pub(crate) fn pass_on_node_or_wait(&mut self, link: LinkId, node: &NodeId) {
        let now = self.now.instant;
        if self.allowance(node).may_announce(now) {
            self.tell_link_state(link, node);
        } else {
            self.charge_stale(link);
            self.topology.late.insert(*node);
            self.late_at.get_or_insert(now + LATE_EVERY);
        }
    }

    /// Passes on announcements that waited for the allowance of their signer.
    pub(crate) fn pass_on_late(&mut self, now: Now) {
        if self.late_at.take_if(|at| *at <= now.instant).is_none() {
            return;
        }
        for node in std::mem::take(&mut self.topology.late) {
            if self.allowance(&node).may_announce(now.instant) {
                self.tell_link_state(LinkId::LOCAL, &node);
            } else {
                self.topology.late.insert(node);
            }
        }
        let mut owners: VecDeque<_> = self.names.waiting().into();
        while let Some(owner) = owners.pop_front() {
            while let Some((id, from)) = self.names.first_waiting(&owner) {
                if !self.allowance(&owner).may_announce(now.instant) {
                    break;
                }
                self.names.waits_no_more(&owner, id);
                self.tell_record_to_routers(from, &owner, id);
            }
        }
        if !self.topology.late.is_empty() || !self.names.waiting().is_empty() {
            self.late_at = Some(now.instant + LATE_EVERY);
        }
    }
}
