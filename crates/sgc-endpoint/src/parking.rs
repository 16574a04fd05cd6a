//! Packets that came before the grant that explains them: of an epoch or a source that is not known yet.

use std::collections::VecDeque;

use bytes::Bytes;
use sgc_wire::Packet;

/// Most packets parked at one sink.
pub const PARKED_PACKETS_MAX: usize = 256;
/// Most bytes parked at one sink.
pub const PARKED_BYTES_MAX: usize = 4 << 20;
/// Grants that a packet waits for. One may have been under way when the packet's source came to be.
const LOOKS_MAX: u8 = 4;

/// A packet and how often it was looked at in vain.
pub(crate) struct Parked {
    pub(crate) packet: Packet,
    looks: u8,
}

impl Parked {
    pub(crate) fn new(packet: &Packet) -> Self {
        // A copy, so that the bound holds: the payload may be a small piece of a large buffer of the
        // transport.
        let mut payload = Vec::with_capacity(packet.payload.len());
        packet.payload.copy_into(&mut payload);
        let packet = Packet { header: packet.header.clone(), payload: Bytes::from(payload).into() };
        Self { packet, looks: 0 }
    }

    /// Counts a look in vain; true if there was one too many.
    pub(crate) fn looked_in_vain(&mut self) -> bool {
        self.looks += 1;
        self.looks >= LOOKS_MAX
    }
}

/// The parked packets of a sink, in the order in which they came.
#[derive(Default)]
pub(crate) struct Parking {
    packets: VecDeque<Parked>,
    bytes: usize,
}

impl Parking {
    /// Parks a packet; the number of those that had to make room for it, oldest first.
    pub(crate) fn push(&mut self, parked: Parked) -> usize {
        self.bytes += parked.packet.encoded_bytes();
        self.packets.push_back(parked);
        let before = self.packets.len();
        while self.packets.len() > PARKED_PACKETS_MAX || self.bytes > PARKED_BYTES_MAX {
            let Some(oldest) = self.packets.pop_front() else { break };
            self.bytes -= oldest.packet.encoded_bytes();
        }
        before - self.packets.len()
    }

    /// Takes all out.
    pub(crate) fn take(&mut self) -> VecDeque<Parked> {
        self.bytes = 0;
        std::mem::take(&mut self.packets)
    }

    pub(crate) fn len(&self) -> usize {
        self.packets.len()
    }
}
