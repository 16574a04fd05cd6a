//! Actions of nodes that break the protocol: they capture, inject and alter frames and packets.

use sgc_wire::{Control, Packet};

use crate::ids::NodeKey;
use crate::record::{CapturedFrame, CapturedPacket};
use crate::world::World;

impl World {
    /// Sends a frame from one node to a neighbour, as if its router sent it.
    pub fn inject(&mut self, from: NodeKey, to: NodeKey, frame: &Control) {
        let (wire, side) = self.wire_between(from, to);
        self.carry_frame(wire, side, frame);
    }

    /// Sends a packet from one node to a neighbour, as if its data path sent it.
    pub fn inject_packet(&mut self, from: NodeKey, to: NodeKey, packet: Packet) {
        let (wire, side) = self.wire_between(from, to);
        self.carry_packet(wire, side, packet);
    }

    /// Replaces every frame that `from` sends to `to` by the result of `tamper`.
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

    /// Starts to capture all frames and packets.
    pub fn capture(&mut self) {
        self.captured.get_or_insert_default();
    }

    /// Returns the captured frames.
    pub fn captured(&self) -> &[CapturedFrame] {
        self.captured.as_deref().unwrap_or_default()
    }

    /// Returns the captured packets in the order of sending, including those that the network loses.
    pub fn captured_packets(&self) -> &[CapturedPacket] {
        &self.captured_packets
    }
}
