//! Data packets: one sealed fragment of one message, under its name.
//!
//! Routers read the header and never see inside the payload. The seal (`sgc-trust`) authenticates all of the header but
//! the hop limit, so a router may lower that and change nothing else unnoticed. Layout: `docs/spec/wire.md`.

use bytes::{BufMut, Bytes};
use smallvec::SmallVec;

use crate::codec::{Decode, DecodeError, Encode, Reader, Writer};
use crate::ids::{Label, Name, SinkId, SourceId};

/// Version of the data packet, in the high half of the first byte.
pub const PACKET_VERSION: u8 = 1;
/// Longest header, bytes.
pub const HEADER_BYTES_MAX: usize = HEADER_BYTES + 16;
/// Header without an addressee, bytes.
pub const HEADER_BYTES: usize = 76;
/// Bytes that a label in place of the name saves.
pub const LABEL_SAVES_BYTES: usize = 32;
/// Longest payload of one packet, bytes: a fragment of 32 KiB and the additions of a suite, which are a message head
/// (12), a tag (16) and the trailer of a batch of 64 under RSA-3072 (6 · 32 + 4 + 384), rounded up.
pub const PAYLOAD_BYTES_MAX: usize = 32 * 1024 + 1024;
/// Longest message, bytes of plaintext.
pub const MESSAGE_BYTES_MAX: u32 = 64 * 1024 * 1024;
/// Hops that a packet may take.
pub const HOP_LIMIT: u8 = 64;

/// Priority of traffic (`docs/spec/wire.md`, classes).
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub enum Class {
    /// Large or patient.
    Bulk,
    /// Anything else.
    #[default]
    Default,
    /// Commands and state that are worthless when late.
    Realtime,
}

/// The header of a data packet.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct PacketHeader {
    /// Whether lost packets are sent again and full queues push back; otherwise the newest packet wins.
    pub reliable: bool,
    /// Class.
    pub class: Class,
    /// Hops left; not authenticated.
    pub hops: u8,
    /// Cipher suite id, as `sgc-trust` numbers them.
    pub suite: u8,
    /// Epoch of the topic key.
    pub epoch: u32,
    /// The name of the topic.
    pub name: Name,
    /// The publishing source.
    pub source: SourceId,
    /// Number of the message at its source, from 1.
    pub seq: u64,
    /// Bytes of the whole message, unsealed.
    pub total: u32,
    /// Number of the fragment, from 0.
    pub index: u16,
    /// Bytes of every fragment but the last, unsealed.
    pub grid: u16,
    /// The only sink it is for; `None` for all. Routers choose the branch by it, sinks the key.
    pub to: Option<SinkId>,
}

/// First byte of a header with its name.
const FORM_NAMED: u8 = PACKET_VERSION << 4;
/// First byte of a header with a label in place of the name.
const FORM_LABELLED: u8 = FORM_NAMED | 1;

const FLAG_RELIABLE: u8 = 0x01;
const FLAG_TO: u8 = 0x02;
const CLASS_SHIFT: u8 = 2;
const FLAGS_KNOWN: u8 = 0x0f;

impl PacketHeader {
    /// Returns the number of fragments of the message, at least one.
    pub fn fragments(&self) -> u32 {
        self.total.div_ceil(u32::from(self.grid)).max(1)
    }

    /// Returns the bytes of this fragment, unsealed.
    pub fn fragment_bytes(&self) -> usize {
        let start = u32::from(self.index) * u32::from(self.grid);
        (self.total - start).min(u32::from(self.grid)) as usize
    }

    /// Returns `true` for the fragment that ends its message.
    pub fn is_last(&self) -> bool {
        u32::from(self.index) + 1 == self.fragments()
    }

    /// Returns the bytes that the seal authenticates: the encoding with its name and with hop limit zero, whatever form
    /// links carry it in.
    pub fn associated_data(&self) -> AssociatedData {
        let mut bytes = [0; HEADER_BYTES_MAX];
        self.put(&mut &mut bytes[..], 0, None);
        AssociatedData { bytes, len: self.encoded_bytes() }
    }

    /// Appends the encoding.
    pub fn put_into(&self, out: &mut impl BufMut) {
        self.put(out, self.hops, None);
    }

    /// Appends the encoding with the label in place of the name, if there is one.
    pub fn put_as(&self, label: Option<Label>, out: &mut impl BufMut) {
        self.put(out, self.hops, label);
    }

    /// Returns the length of the encoding, bytes.
    pub fn encoded_bytes(&self) -> usize {
        if self.to.is_some() { HEADER_BYTES_MAX } else { HEADER_BYTES }
    }

    /// Returns the length of the output of [`Self::put_as`], bytes.
    pub fn encoded_bytes_as(&self, label: Option<Label>) -> usize {
        self.encoded_bytes() - if label.is_some() { LABEL_SAVES_BYTES } else { 0 }
    }

    /// Decodes a header of either form; `name_of` returns the names of the link's labels.
    pub fn read(
        r: &mut Reader<'_>,
        name_of: impl FnOnce(Label) -> Option<Name>,
    ) -> Result<Self, DecodeError> {
        let first = r.u8()?;
        if first != FORM_NAMED && first != FORM_LABELLED {
            return Err(DecodeError::Version {
                what: "data packet",
                found: first.into(),
                known: FORM_NAMED.into(),
            });
        }
        let flags = r.u8()?;
        if flags & !FLAGS_KNOWN != 0 {
            return Err(DecodeError::value("packet flags", flags.into()));
        }
        let mut header = Self {
            reliable: flags & FLAG_RELIABLE != 0,
            class: match (flags >> CLASS_SHIFT) & 3 {
                0 => Class::Bulk,
                1 => Class::Default,
                2 => Class::Realtime,
                v => return Err(DecodeError::value("class", v.into())),
            },
            hops: r.u8()?,
            suite: r.u8()?,
            epoch: r.u32()?,
            name: if first == FORM_NAMED { Name::decode(r)? } else { Name([0; 32]) },
            source: SourceId::decode(r)?,
            seq: r.u64()?,
            total: r.u32()?,
            index: r.u16()?,
            grid: r.u16()?,
            to: None,
        };
        let label = r.u32()?;
        if first == FORM_LABELLED {
            let name = Label::new(label).and_then(name_of);
            header.name = name.ok_or(DecodeError::UnknownLabel { label })?;
        } else if label != 0 {
            return Err(DecodeError::value("reserved", label.into()));
        }
        if flags & FLAG_TO != 0 {
            header.to = Some(SinkId::decode(r)?);
        }
        if header.total > MESSAGE_BYTES_MAX {
            return Err(DecodeError::TooLong {
                field: "message",
                value: header.total as usize,
                max: MESSAGE_BYTES_MAX as usize,
            });
        }
        if header.grid == 0 || usize::from(header.grid) > PAYLOAD_BYTES_MAX {
            return Err(DecodeError::value("fragment grid", header.grid.into()));
        }
        if u32::from(header.index) >= header.fragments() {
            return Err(DecodeError::value("fragment index", header.index.into()));
        }
        Ok(header)
    }

    fn put(&self, out: &mut impl BufMut, hops: u8, label: Option<Label>) {
        let flags = (if self.reliable { FLAG_RELIABLE } else { 0 })
            | (if self.to.is_some() { FLAG_TO } else { 0 })
            | ((self.class as u8) << CLASS_SHIFT);
        out.put_u8(if label.is_some() { FORM_LABELLED } else { FORM_NAMED });
        out.put_u8(flags);
        out.put_u8(hops);
        out.put_u8(self.suite);
        out.put_u32(self.epoch);
        if label.is_none() {
            out.put_slice(&self.name.0);
        }
        out.put_slice(&self.source.0);
        out.put_u64(self.seq);
        out.put_u32(self.total);
        out.put_u16(self.index);
        out.put_u16(self.grid);
        out.put_u32(label.map_or(0, Label::index));
        if let Some(to) = self.to {
            out.put_slice(&to.0);
        }
    }
}

/// The bytes of a header that a seal authenticates; see [`PacketHeader::associated_data`].
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct AssociatedData {
    bytes: [u8; HEADER_BYTES_MAX],
    len: usize,
}

impl AsRef<[u8]> for AssociatedData {
    fn as_ref(&self) -> &[u8] {
        &self.bytes[..self.len]
    }
}

impl Encode for PacketHeader {
    fn encode(&self, w: &mut Writer) {
        let mut out = Vec::with_capacity(HEADER_BYTES_MAX);
        self.put_into(&mut out);
        w.raw(&out);
    }
}

/// Decodes a header with its name, and none with a label.
impl Decode for PacketHeader {
    fn decode(r: &mut Reader<'_>) -> Result<Self, DecodeError> {
        Self::read(r, |_| None)
    }
}

/// The sealed payload of a packet as the transport received it: one piece, or a few where it lay across the transport's
/// buffers. Cloning shares.
#[derive(Clone, Debug, Default)]
pub struct Payload(pub SmallVec<[Bytes; 2]>);

impl Payload {
    /// Returns the length, bytes.
    pub fn len(&self) -> usize {
        self.0.iter().map(Bytes::len).sum()
    }

    /// Returns `true` if there is nothing.
    pub fn is_empty(&self) -> bool {
        self.len() == 0
    }

    /// Appends all pieces to `out`.
    pub fn copy_into(&self, out: &mut impl BufMut) {
        for piece in &self.0 {
            out.put_slice(piece);
        }
    }
}

impl From<Bytes> for Payload {
    fn from(bytes: Bytes) -> Self {
        Self(SmallVec::from_iter([bytes]))
    }
}

/// A data packet.
#[derive(Clone, Debug)]
pub struct Packet {
    /// The header, which routers read.
    pub header: PacketHeader,
    /// Sealed fragment.
    pub payload: Payload,
}

impl Packet {
    /// Returns the length of the encoding, bytes.
    pub fn encoded_bytes(&self) -> usize {
        self.header.encoded_bytes() + self.payload.len()
    }

    /// Returns the length of the encoding with the label in place of the name, if there is one, bytes.
    pub fn encoded_bytes_as(&self, label: Option<Label>) -> usize {
        self.header.encoded_bytes_as(label) + self.payload.len()
    }

    /// Reads a packet that came in one piece (a datagram) and without a label; the payload shares `datagram`.
    pub fn from_datagram(datagram: Bytes) -> Result<Self, DecodeError> {
        Self::from_datagram_as(datagram, |_| None)
    }

    /// Reads a packet of either form that came in one piece; `name_of` returns the names of the link's labels.
    pub fn from_datagram_as(
        datagram: Bytes,
        name_of: impl FnOnce(Label) -> Option<Name>,
    ) -> Result<Self, DecodeError> {
        let mut r = Reader::new(&datagram);
        let header = PacketHeader::read(&mut r, name_of)?;
        let payload = datagram.slice(datagram.len() - r.remaining()..);
        Self::new(header, payload.into())
    }

    /// Joins header and payload; the payload must be within its bound.
    pub fn new(header: PacketHeader, payload: Payload) -> Result<Self, DecodeError> {
        match payload.len() {
            value if value > PAYLOAD_BYTES_MAX => {
                Err(DecodeError::TooLong { field: "payload", value, max: PAYLOAD_BYTES_MAX })
            }
            _ => Ok(Self { header, payload }),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn header() -> PacketHeader {
        PacketHeader {
            reliable: true,
            class: Class::Realtime,
            hops: HOP_LIMIT,
            suite: 1,
            epoch: 7,
            name: Name([0xaa; 32]),
            source: SourceId([0xbb; 16]),
            seq: 42,
            total: 40_000,
            index: 2,
            grid: 16_384,
            to: None,
        }
    }

    #[test]
    fn header_round_trips() {
        for to in [None, Some(SinkId([3; 16]))] {
            let h = PacketHeader { to, ..header() };
            let bytes = h.to_vec();
            assert_eq!(bytes.len(), h.encoded_bytes());
            assert_eq!(PacketHeader::from_slice(&bytes), Ok(h));
        }
    }

    #[test]
    fn a_label_stands_for_the_name_and_for_nothing_else() {
        let label = Label::new(0x0102).unwrap();
        let name_of = |l: Label| (l == label).then_some(Name([0xaa; 32]));
        for to in [None, Some(SinkId([3; 16]))] {
            let h = PacketHeader { to, ..header() };
            let mut bytes = Vec::new();
            h.put_as(Some(label), &mut bytes);
            assert_eq!((bytes.len(), h.encoded_bytes_as(Some(label))), (h.to_vec().len() - 32, bytes.len()));
            let mut r = Reader::new(&bytes);
            let read = PacketHeader::read(&mut r, name_of).unwrap();
            assert_eq!((r.remaining(), read.associated_data()), (0, h.associated_data()));
            assert_eq!(read, h);
            let unknown = |bytes: &[u8]| PacketHeader::read(&mut Reader::new(bytes), name_of).unwrap_err();
            bytes[43] = 3;
            assert_eq!(unknown(&bytes), DecodeError::UnknownLabel { label: 0x0103 });
            bytes[40] = 1;
            assert_eq!(unknown(&bytes), DecodeError::UnknownLabel { label: 0x0100_0103 });
            bytes.truncate(43);
            assert!(matches!(unknown(&bytes), DecodeError::Truncated { .. }));
        }
    }

    #[test]
    fn only_the_hops_are_outside_the_seal() {
        let a = header();
        assert_eq!(a.associated_data().as_ref().len(), HEADER_BYTES);
        assert_eq!(a.associated_data(), PacketHeader { hops: 3, ..header() }.associated_data());
        assert_ne!(a.associated_data(), PacketHeader { seq: 43, ..header() }.associated_data());
        let addressed = |n| PacketHeader { to: Some(SinkId([n; 16])), ..header() }.associated_data();
        assert_eq!(addressed(9).as_ref().len(), HEADER_BYTES_MAX);
        assert_ne!(addressed(9), addressed(8));
    }

    #[test]
    fn fragments_cover_the_message() {
        assert_eq!(header().fragments(), 3);
        assert_eq!(header().fragment_bytes(), 40_000 - 2 * 16_384);
        assert!(header().is_last());
        assert!(PacketHeader { total: 0, index: 0, ..header() }.is_last());
    }

    #[test]
    fn impossible_headers_are_refused() {
        let refused = |h: PacketHeader| PacketHeader::from_slice(&h.to_vec()).unwrap_err();
        assert!(matches!(refused(PacketHeader { index: 3, ..header() }), DecodeError::Value { .. }));
        assert!(matches!(refused(PacketHeader { grid: 0, index: 0, ..header() }), DecodeError::Value { .. }));
        let oversized = PacketHeader { total: MESSAGE_BYTES_MAX + 1, ..header() };
        assert!(matches!(refused(oversized), DecodeError::TooLong { .. }));
        let mut unknown = header().to_vec();
        unknown[0] = 0x20;
        assert!(matches!(PacketHeader::from_slice(&unknown), Err(DecodeError::Version { .. })));
    }
}
