//! Encoding of the frames of a multiplexed stream (`docs/spec/wire.md`, stream links). Pure: it reads and writes heads;
//! the machine gives them their meaning.

use bytes::{BufMut as _, BytesMut};

/// Longest piece of a flow in one frame that is accepted, bytes.
pub(crate) const PIECE_BYTES_LIMIT: u64 = 16 << 10;
/// Longest datagram, bytes.
pub(crate) const DATAGRAM_BYTES_MAX: usize = 16 << 10;
/// Longest text of a close frame, bytes: 200 characters of UTF-8.
pub(crate) const CLOSE_TEXT_BYTES_MAX: usize = 800;
/// Longest head of a frame: the type and three numbers.
pub(crate) const HEAD_BYTES_MAX: usize = 1 + 3 * 8;

const NUMBER_MAX: u64 = (1 << 62) - 1;

/// The head of a frame, or the whole frame.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Head {
    /// The first frame: first credit of one flow, credit of all flows, and their number.
    Settings { flow_credit: u64, link_credit: u64, flows: u64 },
    /// This many bytes of a flow follow.
    Data { flow: u64, length: u64 },
    /// The flow is over, in good order.
    Finish { flow: u64 },
    /// The flow ends early.
    Reset { flow: u64, code: u64 },
    /// A flow of the receiver is not wanted any more.
    Stop { flow: u64, code: u64 },
    /// A flow of the receiver may have this many bytes in all.
    Credit { flow: u64, bytes: u64 },
    /// All flows of the receiver together may have this many bytes in all.
    LinkCredit { bytes: u64 },
    /// The receiver may open this many flows in all.
    Flows { count: u64 },
    /// A flow of the receiver has arrived completely.
    Done { flow: u64 },
    /// This many bytes of a datagram follow.
    Datagram { length: u64 },
    /// Asks for a [`Head::Pong`] of this number.
    Ping { number: u64 },
    /// All pings up to this one have arrived.
    Pong { number: u64 },
    /// The link is over; this many bytes of text follow.
    Close { code: u64, length: u64 },
}

/// A peer's breach of the rules of the multiplexed stream.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
pub enum StreamViolation {
    /// No frame has this type.
    #[error("no frame of a stream link has type {0}")]
    FrameType(u8),
    /// The first frame is another than the settings, or they come twice.
    #[error("the settings come first and once")]
    Settings,
    /// A piece, a datagram or a text is longer than allowed, or empty.
    #[error("a {what} of {bytes} bytes, 1 to {max} are allowed")]
    Length {
        /// The kind of content.
        what: &'static str,
        /// The claimed length.
        bytes: u64,
        /// The limit.
        max: u64,
    },
    /// The named flow is not open: over already, or not the next one.
    #[error("flow {0} is not open")]
    Flow(u64),
    /// More flows than were permitted.
    #[error("flow {0} is one more than is permitted")]
    TooManyFlows(u64),
    /// More bytes than were permitted.
    #[error("more bytes than were permitted on {}", if *.0 == 0 { "the control stream" } else { "a flow" })]
    Credit(u64),
    /// The answer to a ping that was not sent.
    #[error("a ping was answered that was not sent")]
    Pong,
}

/// Reads a head. Returns it and its length, or nothing while more bytes are needed.
pub(crate) fn read_head(bytes: &[u8]) -> Result<Option<(Head, usize)>, StreamViolation> {
    let Some((&kind, rest)) = bytes.split_first() else { return Ok(None) };
    let mut numbers = Numbers { rest };
    let head = match kind {
        0 => numbers.three().map(|[flow_credit, link_credit, flows]| Head::Settings {
            flow_credit,
            link_credit,
            flows,
        }),
        1 => numbers.two().map(|[flow, length]| Head::Data { flow, length }),
        2 => numbers.next().map(|flow| Head::Finish { flow }),
        3 => numbers.two().map(|[flow, code]| Head::Reset { flow, code }),
        4 => numbers.two().map(|[flow, code]| Head::Stop { flow, code }),
        5 => numbers.two().map(|[flow, bytes]| Head::Credit { flow, bytes }),
        6 => numbers.next().map(|bytes| Head::LinkCredit { bytes }),
        7 => numbers.next().map(|count| Head::Flows { count }),
        8 => numbers.next().map(|flow| Head::Done { flow }),
        9 => numbers.next().map(|length| Head::Datagram { length }),
        10 => numbers.next().map(|number| Head::Ping { number }),
        11 => numbers.next().map(|number| Head::Pong { number }),
        12 => numbers.two().map(|[code, length]| Head::Close { code, length }),
        kind => return Err(StreamViolation::FrameType(kind)),
    };
    let used = bytes.len() - numbers.rest.len();
    match head {
        Some(head) => check_length(head).map(|()| Some((head, used))),
        None => Ok(None),
    }
}

/// Judges lengths with the head, before anything waits for the bytes that they announce.
fn check_length(head: Head) -> Result<(), StreamViolation> {
    let (what, bytes, min, max) = match head {
        Head::Data { length, .. } => ("piece", length, 1, PIECE_BYTES_LIMIT),
        Head::Datagram { length } => ("datagram", length, 1, DATAGRAM_BYTES_MAX as u64),
        Head::Close { length, .. } => ("text", length, 0, CLOSE_TEXT_BYTES_MAX as u64),
        _ => return Ok(()),
    };
    if (min..=max).contains(&bytes) { Ok(()) } else { Err(StreamViolation::Length { what, bytes, max }) }
}

impl Head {
    /// Appends the head.
    pub(crate) fn write(self, out: &mut BytesMut) {
        let (kind, numbers): (u8, &[u64]) = match &self {
            Self::Settings { flow_credit, link_credit, flows } => (0, &[*flow_credit, *link_credit, *flows]),
            Self::Data { flow, length } => (1, &[*flow, *length]),
            Self::Finish { flow } => (2, &[*flow]),
            Self::Reset { flow, code } => (3, &[*flow, *code]),
            Self::Stop { flow, code } => (4, &[*flow, *code]),
            Self::Credit { flow, bytes } => (5, &[*flow, *bytes]),
            Self::LinkCredit { bytes } => (6, &[*bytes]),
            Self::Flows { count } => (7, &[*count]),
            Self::Done { flow } => (8, &[*flow]),
            Self::Datagram { length } => (9, &[*length]),
            Self::Ping { number } => (10, &[*number]),
            Self::Pong { number } => (11, &[*number]),
            Self::Close { code, length } => (12, &[*code, *length]),
        };
        out.put_u8(kind);
        for number in numbers {
            write_number(*number, out);
        }
    }
}

/// Writes a number as in QUIC (RFC 9000, 16): the first two bits tell its length.
fn write_number(number: u64, out: &mut BytesMut) {
    match number {
        0..=0x3f => out.put_u8(number as u8),
        0x40..=0x3fff => out.put_u16(0x4000 | number as u16),
        0x4000..=0x3fff_ffff => out.put_u32(0x8000_0000 | number as u32),
        _ => out.put_u64(0xc000_0000_0000_0000 | number.min(NUMBER_MAX)),
    }
}

struct Numbers<'a> {
    rest: &'a [u8],
}

impl Numbers<'_> {
    fn next(&mut self) -> Option<u64> {
        let first = *self.rest.first()?;
        let length = 1 << (first >> 6);
        let (bytes, rest) = self.rest.split_at_checked(length)?;
        self.rest = rest;
        let start = u64::from(first & 0x3f);
        Some(bytes.iter().skip(1).fold(start, |number, byte| number << 8 | u64::from(*byte)))
    }

    fn two(&mut self) -> Option<[u64; 2]> {
        Some([self.next()?, self.next()?])
    }

    fn three(&mut self) -> Option<[u64; 3]> {
        Some([self.next()?, self.next()?, self.next()?])
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn heads_survive_the_wire_and_any_cut() {
        for n in [0, 1, 63, 64, 16_383, 16_384, (1 << 30) - 1, 1 << 30, NUMBER_MAX] {
            for head in [
                Head::Settings { flow_credit: n, link_credit: 7, flows: n },
                Head::Data { flow: n, length: 4096 },
                Head::Finish { flow: n },
                Head::Reset { flow: n, code: 3 },
                Head::Stop { flow: 3, code: n },
                Head::Credit { flow: n, bytes: n },
                Head::LinkCredit { bytes: n },
                Head::Flows { count: n },
                Head::Done { flow: n },
                Head::Datagram { length: 1 },
                Head::Ping { number: n },
                Head::Pong { number: n },
                Head::Close { code: n, length: 0 },
            ] {
                let mut out = BytesMut::new();
                head.write(&mut out);
                assert!(out.len() <= HEAD_BYTES_MAX);
                for cut in 0..out.len() {
                    assert_eq!(read_head(&out[..cut]), Ok(None), "{head:?}");
                }
                let length = out.len();
                out.put_u8(0xff);
                assert_eq!(read_head(&out), Ok(Some((head, length))));
            }
        }
    }

    #[test]
    fn impossible_heads_are_refused() {
        assert_eq!(read_head(&[13]), Err(StreamViolation::FrameType(13)));
        assert_eq!(read_head(&[255, 1]), Err(StreamViolation::FrameType(255)));
        for head in [
            Head::Data { flow: 1, length: 0 },
            Head::Data { flow: 1, length: PIECE_BYTES_LIMIT + 1 },
            Head::Datagram { length: 0 },
            Head::Datagram { length: NUMBER_MAX },
            Head::Close { code: 0, length: CLOSE_TEXT_BYTES_MAX as u64 + 1 },
        ] {
            let mut out = BytesMut::new();
            head.write(&mut out);
            assert!(matches!(read_head(&out), Err(StreamViolation::Length { .. })), "{head:?}");
        }
    }
}
