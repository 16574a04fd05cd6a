//! Framing of control frames and packets in a stream of bytes (`docs/spec/wire.md`, links). Pure: it sees pieces of the
//! stream as the transport received them and hands out slices of the same pieces.
//!
//! Control stream: frames of `u32 length | body`; the first in each direction is a greeting. Flow: one byte of version,
//! then packets of `u32 length | header | payload`. Lengths are checked before anything waits for the bytes they
//! announce.

use std::collections::VecDeque;

use bytes::{Buf as _, BufMut as _, Bytes, BytesMut};
use sgc_wire::{
    Decode, DecodeError, Encode, HEADER_BYTES_MAX, Label, LaneToken, Packet, PacketHeader, Payload, Reader,
    Slab, Writer,
};

use crate::error::{FlowError, ProtocolError};
use crate::labels::Labels;
use crate::limits::{CONTROL_FRAME_BYTES_MAX, FLOW_PACKET_BYTES_MAX, FLOW_VERSION, LINK_VERSION};

const LENGTH_BYTES: usize = 4;
const EXTENSIONS_MAX: usize = 16;
const EXTENSION_BYTES_MAX: usize = 1024;
const EXTENSION_LANE: u16 = 1;
const EXTENSION_BULK_LANES: u16 = 2;

/// Pieces of one frame that are to be written in order.
pub(crate) type Chunks = Vec<Bytes>;

/// Bytes of a stream that were received and not yet consumed.
#[derive(Debug, Default)]
pub(crate) struct Pieces {
    pieces: VecDeque<Bytes>,
    bytes: usize,
}

impl Pieces {
    /// Appends received bytes.
    pub(crate) fn push(&mut self, piece: Bytes) {
        if !piece.is_empty() {
            self.bytes += piece.len();
            self.pieces.push_back(piece);
        }
    }

    /// Takes the next control frame, if it is complete. A frame that came in one piece is not copied.
    pub(crate) fn next_control(&mut self) -> Result<Option<Bytes>, ProtocolError> {
        let Some(length) = self.peek_length() else { return Ok(None) };
        if length as usize > CONTROL_FRAME_BYTES_MAX {
            return Err(ProtocolError::ControlFrameTooLong { bytes: length.into() });
        }
        let length = length as usize;
        if self.bytes < LENGTH_BYTES + length {
            return Ok(None);
        }
        self.skip(LENGTH_BYTES);
        let mut payload = self.take(length);
        if payload.0.len() == 1 {
            return Ok(payload.0.pop());
        }
        let mut frame = BytesMut::with_capacity(length);
        payload.copy_into(&mut frame);
        Ok(Some(frame.freeze()))
    }

    /// Takes the version that begins a flow.
    pub(crate) fn next_flow_version(&mut self) -> Result<Option<()>, FlowError> {
        match self.pieces.front().and_then(|p| p.first()) {
            None => Ok(None),
            Some(&FLOW_VERSION) => {
                self.skip(1);
                Ok(Some(()))
            }
            Some(&found) => Err(FlowError::Version { found }),
        }
    }

    /// Takes the next packet of a flow, if it is complete. The payload is never copied.
    pub(crate) fn next_packet(&mut self, labels: &Labels) -> Result<Option<Packet>, FlowError> {
        let Some(length) = self.peek_length() else { return Ok(None) };
        if length as usize > FLOW_PACKET_BYTES_MAX {
            return Err(FlowError::PacketTooLong { bytes: length.into() });
        }
        let length = length as usize;
        if self.bytes < LENGTH_BYTES + length {
            return Ok(None);
        }
        self.skip(LENGTH_BYTES);
        let mut header = [0; HEADER_BYTES_MAX];
        let header = &mut header[..length.min(HEADER_BYTES_MAX)];
        self.copy_front(header);
        let mut reader = Reader::new(header);
        let decoded = PacketHeader::read(&mut reader, |label| labels.name_of(label));
        let decoded = decoded.map_err(FlowError::Packet)?;
        let header_bytes = header.len() - reader.remaining();
        self.skip(header_bytes);
        let payload = self.take(length - header_bytes);
        Packet::new(decoded, payload).map(Some).map_err(FlowError::Packet)
    }

    /// Returns `true` if nothing is left.
    pub(crate) fn is_empty(&self) -> bool {
        self.bytes == 0
    }

    fn peek_length(&self) -> Option<u32> {
        let mut length = [0; LENGTH_BYTES];
        if self.bytes < LENGTH_BYTES {
            return None;
        }
        self.copy_front(&mut length);
        Some(u32::from_be_bytes(length))
    }

    /// Copies the first bytes without consuming them; there must be enough.
    fn copy_front(&self, mut out: &mut [u8]) {
        for piece in &self.pieces {
            let n = piece.len().min(out.len());
            let (head, tail) = out.split_at_mut(n);
            head.copy_from_slice(&piece[..n]);
            out = tail;
        }
        debug_assert!(out.is_empty(), "callers check the length first");
    }

    fn skip(&mut self, mut n: usize) {
        self.bytes -= n;
        while let Some(front) = self.pieces.front_mut() {
            if front.len() > n {
                front.advance(n);
                return;
            }
            n -= front.len();
            self.pieces.pop_front();
        }
    }

    fn take(&mut self, mut n: usize) -> Payload {
        self.bytes -= n;
        let mut out = Payload::default();
        let mut ahead = 0;
        let pieces = self.pieces.iter().take_while(|piece| {
            let is_part = ahead < n;
            ahead += piece.len();
            is_part
        });
        // At once, where there are more than it holds by itself.
        out.0.reserve(pieces.count());
        while n > 0 {
            let Some(mut front) = self.pieces.pop_front() else { break };
            if front.len() > n {
                let head = front.split_to(n);
                self.pieces.push_front(front);
                front = head;
            }
            n -= front.len();
            out.0.push(front);
        }
        out
    }
}

/// Returns the head of a control frame.
pub(crate) fn control_head(length: usize) -> Bytes {
    Bytes::copy_from_slice(&u32::try_from(length).unwrap_or(u32::MAX).to_be_bytes())
}

/// Returns the bytes before the payload of a packet in a flow, with the flow's version if it is the first; `joined`
/// appends the payload. They lie in memory of `slab`.
pub(crate) fn packet_head(
    packet: &Packet,
    label: Option<Label>,
    is_first: bool,
    joined: bool,
    slab: &mut Slab,
) -> BytesMut {
    let payload_bytes = if joined { packet.payload.len() } else { 0 };
    let header_bytes = packet.header.encoded_bytes_as(label);
    let mut head = slab.room(usize::from(is_first) + LENGTH_BYTES + header_bytes + payload_bytes);
    if is_first {
        head.put_u8(FLOW_VERSION);
    }
    head.put_u32(u32::try_from(packet.encoded_bytes_as(label)).unwrap_or(u32::MAX));
    packet.header.put_as(label, &mut head);
    if joined {
        packet.payload.copy_into(&mut head);
    }
    head
}

/// Joins byte strings that are written in sequence: neighbours in memory become one piece.
#[derive(Debug, Default)]
pub(crate) struct PieceJoiner(BytesMut);

impl PieceJoiner {
    /// Adds the next bytes. Returns the earlier piece if the next bytes lie elsewhere.
    pub(crate) fn push(&mut self, next: BytesMut) -> Option<Bytes> {
        let before = if self.0.as_ptr_range().end == next.as_ptr() { None } else { self.take() };
        self.0.unsplit(next);
        before
    }

    /// Takes the piece, if there is one.
    pub(crate) fn take(&mut self) -> Option<Bytes> {
        (!self.0.is_empty()).then(|| std::mem::take(&mut self.0).freeze())
    }
}

/// Returns a packet in one piece, as a datagram carries it, in memory of `slab`.
pub(crate) fn datagram(packet: &Packet, label: Option<Label>, slab: &mut Slab) -> Bytes {
    let mut out = slab.room(packet.encoded_bytes_as(label));
    packet.header.put_as(label, &mut out);
    packet.payload.copy_into(&mut out);
    out.freeze()
}

/// The first control frame in each direction: the version, then extensions, of which unknown ones are skipped.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub(crate) struct Greeting {
    /// Set if this connection is a lane that was agreed on over a link.
    pub(crate) lane: Option<LaneToken>,
    /// Whether the sender dials or takes bulk lanes of this link.
    pub(crate) bulk_lanes: bool,
}

impl Encode for Greeting {
    fn encode(&self, w: &mut Writer) {
        w.u16(LINK_VERSION);
        let lane = self.lane.as_ref().map(|token| (EXTENSION_LANE, token.0.as_slice()));
        let bulk_lanes = self.bulk_lanes.then_some((EXTENSION_BULK_LANES, [].as_slice()));
        let extensions: Vec<_> = lane.into_iter().chain(bulk_lanes).collect();
        w.list(&extensions, |w, (id, content)| {
            w.u16(*id);
            w.bytes(content);
        });
    }
}

impl Decode for Greeting {
    fn decode(r: &mut Reader<'_>) -> Result<Self, DecodeError> {
        let found = r.u16()?;
        if found != LINK_VERSION {
            return Err(DecodeError::Version { what: "link", found, known: LINK_VERSION });
        }
        let mut greeting = Self::default();
        r.list("extensions", EXTENSIONS_MAX, |r| {
            let id = r.u16()?;
            let content = r.bytes("extension", EXTENSION_BYTES_MAX)?;
            match id {
                EXTENSION_LANE => greeting.lane = Some(LaneToken::from_slice(content)?),
                EXTENSION_BULK_LANES => {
                    Reader::new(content).finish()?;
                    greeting.bulk_lanes = true;
                }
                _ => {}
            }
            Ok(())
        })?;
        Ok(greeting)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use sgc_wire::{Class, HOP_LIMIT, Name, SinkId, SourceId};

    fn packet(payload: &[u8], to: Option<SinkId>) -> Packet {
        let header = PacketHeader {
            reliable: true,
            class: Class::Default,
            hops: HOP_LIMIT,
            suite: 1,
            epoch: 1,
            name: Name([1; 32]),
            source: SourceId([2; 16]),
            seq: 3,
            total: payload.len() as u32,
            index: 0,
            grid: 16_384,
            to,
        };
        Packet::new(header, Bytes::copy_from_slice(payload).into()).unwrap()
    }

    /// Returns the stream in pieces of `size` bytes.
    fn pieces(stream: &[u8], size: usize) -> Pieces {
        let mut out = Pieces::default();
        stream.chunks(size).for_each(|c| out.push(Bytes::copy_from_slice(c)));
        out
    }

    #[test]
    fn packets_survive_any_division_of_the_stream() {
        let sent = [packet(b"", None), packet(&[7; 300], Some(SinkId([5; 16]))), packet(b"x", None)];
        let sent: Vec<_> = sent.iter().chain(&sent).collect();
        let labels = Labels::default();
        labels.define(Label::new(0).unwrap(), sent[0].header.name).unwrap();
        let (mut stream, mut slab) = (Vec::new(), Slab::default());
        for (index, p) in sent.iter().enumerate() {
            let label = Label::new(0).filter(|_| index > 2);
            stream.extend_from_slice(&packet_head(p, label, index == 0, index == 1, &mut slab));
            if index != 1 {
                p.payload.copy_into(&mut stream);
            }
        }
        for size in 1..=stream.len() {
            let mut pieces = pieces(&stream, size);
            assert!(matches!(pieces.next_flow_version(), Ok(Some(()))));
            for p in &sent {
                let got = pieces.next_packet(&labels).unwrap().unwrap();
                assert_eq!(got.header, p.header);
                assert_eq!(datagram(&got, None, &mut slab), datagram(p, None, &mut slab));
            }
            assert!(pieces.is_empty() && pieces.next_packet(&labels).unwrap().is_none());
        }
        for cut in 1..stream.len() {
            let mut pieces = pieces(&stream[..cut], 50);
            pieces.next_flow_version().unwrap();
            while pieces.next_packet(&labels).unwrap().is_some() {}
        }
    }

    #[test]
    fn payloads_are_slices_of_what_was_received() {
        let p = packet(&[7; 300], None);
        let stream =
            Bytes::from([&packet_head(&p, None, false, false, &mut Slab::default())[..], &[7; 300]].concat());
        let (mut pieces, labels) = (Pieces::default(), Labels::default());
        pieces.push(stream.slice(..200));
        pieces.push(stream.slice(200..));
        let got = pieces.next_packet(&labels).unwrap().unwrap();
        assert_eq!(got.payload.0.len(), 2);
        let inside = stream.as_ptr() as usize..stream.as_ptr() as usize + stream.len();
        assert!(got.payload.0.iter().all(|b| inside.contains(&(b.as_ptr() as usize))));
    }

    #[test]
    fn short_packets_behind_each_other_are_one_piece() {
        let p = packet(&[7; 300], None);
        let (mut slab, mut gathered, mut pieces) = (Slab::default(), PieceJoiner::default(), Vec::new());
        let mut stream = Vec::new();
        for n in 0..100 {
            let head = packet_head(&p, None, n == 0, true, &mut slab);
            stream.extend_from_slice(&head);
            pieces.extend(gathered.push(head));
        }
        pieces.extend(gathered.take());
        assert!(gathered.take().is_none());
        assert_eq!(pieces.concat(), stream);
        // One piece for all that share memory.
        assert!(pieces.len() <= 100 / 8 + 2, "{}", pieces.len());
        // The allocator may place new memory where other memory ends: that is one piece as well.
        let mut apart = PieceJoiner::default();
        assert!(apart.push(BytesMut::from(&b"a"[..])).is_none());
        let before = apart.push(BytesMut::from(&b"b"[..]));
        assert_eq!([before.unwrap_or_default(), apart.take().unwrap()].concat(), b"ab");
    }

    #[test]
    fn impossible_lengths_are_refused_before_their_bytes_come() {
        let mut control = pieces(&u32::MAX.to_be_bytes(), 4);
        let bytes = u32::MAX.into();
        assert_eq!(control.next_control(), Err(ProtocolError::ControlFrameTooLong { bytes }));
        let labels = Labels::default();
        let mut flow = pieces(&(FLOW_PACKET_BYTES_MAX as u32 + 1).to_be_bytes(), 4);
        assert!(matches!(flow.next_packet(&labels), Err(FlowError::PacketTooLong { .. })));
        assert!(matches!(pieces(&[9], 1).next_flow_version(), Err(FlowError::Version { found: 9 })));
        let mut short = pieces(&[0, 0, 0, 2, 0x10, 0], 6);
        assert!(matches!(short.next_packet(&labels), Err(FlowError::Packet(DecodeError::Truncated { .. }))));
        let mut empty = pieces(&[0; 4], 4);
        assert!(matches!(empty.next_packet(&labels), Err(FlowError::Packet(DecodeError::Truncated { .. }))));
    }

    #[test]
    fn control_frames_survive_any_division_of_the_stream() {
        let mut stream = Vec::new();
        for frame in [&b""[..], b"abc", &[9; 100]] {
            stream.extend_from_slice(&control_head(frame.len()));
            stream.extend_from_slice(frame);
        }
        for size in 1..=stream.len() {
            let mut pieces = pieces(&stream, size);
            for frame in [&b""[..], b"abc", &[9; 100]] {
                assert_eq!(pieces.next_control().unwrap().unwrap(), frame);
            }
            assert_eq!(pieces.next_control(), Ok(None));
        }
    }

    #[test]
    fn greetings_leave_room() {
        let lane = Some(LaneToken([7; 16]));
        for greeting in [
            Greeting::default(),
            Greeting { lane, bulk_lanes: false },
            Greeting { lane: None, bulk_lanes: true },
            Greeting { lane, bulk_lanes: true },
        ] {
            assert_eq!(Greeting::from_slice(&greeting.to_vec()), Ok(greeting));
        }
        let mut later = Writer::default();
        later.u16(LINK_VERSION);
        later.list(&[7u16, 8], |w, id| {
            w.u16(*id);
            w.bytes(b"something");
        });
        assert_eq!(Greeting::from_slice(&later.into_vec()), Ok(Greeting::default()));
        let mut short = Writer::default();
        short.u16(LINK_VERSION);
        short.list(&[EXTENSION_LANE], |w, id| {
            w.u16(*id);
            w.bytes(b"short");
        });
        assert!(Greeting::from_slice(&short.into_vec()).is_err());
        assert!(matches!(Greeting::from_slice(&[0, 2]), Err(DecodeError::Version { found: 2, .. })));
    }
}
