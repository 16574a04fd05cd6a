//! What those do who do not follow the protocol: listen, inject, and alter what they send.

use std::time::Duration;

use sgc_wire::{Control, Packet};

use crate::NodeKey;
use crate::world::World;

/// A frame that crossed a link while [`World::capture`] was on.
#[derive(Clone, Debug)]
pub struct Captured {
    /// Who sent it.
    pub from: NodeKey,
    /// To whom.
    pub to: NodeKey,
    /// What.
    pub frame: Control,
}

/// A packet that crossed a link while [`World::capture`] was on.
#[derive(Clone, Debug)]
pub struct CapturedPacket {
    /// Who sent it.
    pub from: NodeKey,
    /// To whom.
    pub to: NodeKey,
    /// When, since the world began.
    pub at: Duration,
    /// What.
    pub packet: Packet,
}

impl World {
    /// Sends a frame from one node to a neighbour, as if its router had.
    pub fn inject(&mut self, from: NodeKey, to: NodeKey, frame: &Control) {
        let (wire, side) = self.wire_between(from, to);
        self.carry_frame(wire, side, frame);
    }

    /// Sends a packet from one node to a neighbour, as if its data path had.
    pub fn inject_packet(&mut self, from: NodeKey, to: NodeKey, packet: Packet) {
        let (wire, side) = self.wire_between(from, to);
        self.carry_packet(wire, side, packet);
    }

    /// Replaces every frame that `from` sends to `to` by what `tamper` makes of it.
    pub fn tamper(
        &mut self,
        from: NodeKey,
        to: NodeKey,
        tamper: impl FnMut(&Control) -> Vec<Control> + 'static,
    ) {
        let cable = self.cable(from, to);
        let side = self.cables[cable].end_of(from).expect("the cable of both");
        self.cables[cable].tampers[side] = Some(Box::new(tamper));
    }

    /// Ends [`World::tamper`].
    pub fn be_honest(&mut self, from: NodeKey, to: NodeKey) {
        let cable = self.cable(from, to);
        let side = self.cables[cable].end_of(from).expect("the cable of both");
        self.cables[cable].tampers[side] = None;
    }

    /// Keeps all frames and packets from here on.
    pub fn capture(&mut self) {
        self.captured.get_or_insert_default();
    }

    /// The frames kept.
    pub fn captured(&self) -> &[Captured] {
        self.captured.as_deref().unwrap_or_default()
    }

    /// The packets kept, in the order in which they were sent; those that the network loses among them.
    pub fn captured_packets(&self) -> &[CapturedPacket] {
        &self.captured_packets
    }
}
