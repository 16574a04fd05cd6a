//! Packets that came before the grant that explains their epoch or source.

use std::collections::{BTreeSet, VecDeque};

use bytes::Bytes;
use sgc_wire::{Packet, SourceId};

/// Most packets parked at one sink.
pub const PARKED_PACKETS_MAX: usize = 256;
/// Most bytes parked at one sink.
pub const PARKED_BYTES_MAX: usize = 4 << 20;
/// Grants that a packet waits for. Each new source has a grant of its own, so many may be in flight before that of the
/// packet's source.
pub const PARKED_LOOKS_MAX: u8 = 64;
/// Looks for which a grant of a later epoch than the packet's counts: a source is announced in the epoch in which it
/// begins.
const PAST_EPOCH_LOOKS: u8 = PARKED_LOOKS_MAX / 4;

/// A packet, and the number of looks in vain.
pub(crate) struct ParkedPacket {
    pub(crate) packet: Packet,
    looks: u8,
}

impl ParkedPacket {
    pub(crate) fn new(packet: &Packet) -> Self {
        // A copy, so that the bound holds: the payload may be a small piece of a large buffer of the
        // transport.
        let mut payload = Vec::with_capacity(packet.payload.len());
        packet.payload.copy_into(&mut payload);
        let packet = Packet { header: packet.header.clone(), payload: Bytes::from(payload).into() };
        Self { packet, looks: 0 }
    }

    /// Counts a look in vain at a grant of this epoch. Returns `true` if it was one too many.
    pub(crate) fn looked_in_vain(&mut self, epoch: u32) -> bool {
        self.looks += if epoch > self.packet.header.epoch { PAST_EPOCH_LOOKS } else { 1 };
        self.looks >= PARKED_LOOKS_MAX
    }
}

/// The parked packets of a sink, oldest first.
#[derive(Default)]
pub(crate) struct Parking {
    packets: VecDeque<ParkedPacket>,
    bytes: usize,
}

impl Parking {
    /// Parks a packet. Returns the number of older ones that were dropped for it.
    pub(crate) fn push(&mut self, parked: ParkedPacket) -> usize {
        self.bytes += parked.packet.encoded_bytes();
        self.packets.push_back(parked);
        let before = self.packets.len();
        while self.packets.len() > PARKED_PACKETS_MAX || self.bytes > PARKED_BYTES_MAX {
            let Some(oldest) = self.packets.pop_front() else { break };
            self.bytes -= oldest.packet.encoded_bytes();
        }
        before - self.packets.len()
    }

    /// Drops the packets of the sources that are passed over, and returns these sources.
    pub(crate) fn drop_of(&mut self, is_passed_over: impl Fn(&SourceId) -> bool) -> BTreeSet<SourceId> {
        let mut sources = BTreeSet::new();
        for parked in self.take() {
            let source = parked.packet.header.source;
            if is_passed_over(&source) {
                sources.insert(source);
            } else {
                self.push(parked);
            }
        }
        sources
    }

    /// Takes all packets.
    pub(crate) fn take(&mut self) -> VecDeque<ParkedPacket> {
        self.bytes = 0;
        std::mem::take(&mut self.packets)
    }

    pub(crate) fn len(&self) -> usize {
        self.packets.len()
    }
}
