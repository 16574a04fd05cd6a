//! RESP3, as far as a client of few commands needs it: [`encode`] writes a command, [`Decoder`] reads what a server sends.
//!
//! The server is not trusted. The decoder keeps no more than [`Limits`] allow, whatever lengths a server states, nests
//! arrays on a stack of its own, and reads each byte once. Streamed strings and attributes, which no server sends
//! unasked, end the connection.

use std::fmt;

use bytes::{Buf as _, Bytes, BytesMut};
use thiserror::Error;

/// Most bytes of a line: an error, a status, a number or a length.
const LINE_BYTES_MAX: usize = 4096;
/// Most arrays in each other. `CLUSTER SLOTS` has four.
const DEPTH_MAX: usize = 6;
/// Memory that a frame is counted with besides its bytes.
const FRAME_COST: usize = 64;
/// The longest string that a server can have (`proto-max-bulk-len`).
const STRING_BYTES_MAX: u64 = 512 << 20;

/// A reply or a push of a server.
#[derive(Clone, PartialEq, Eq)]
pub(crate) enum Frame {
    /// A string, a status, a big number or a double.
    Text(Bytes),
    /// A string longer than [`Limits::string_bytes_max`], of which nothing was kept.
    TooLong,
    /// An integer or a Boolean.
    Integer(i64),
    Null,
    Error(Bytes),
    /// An array, a set, or a map as keys and values in turn.
    Array(Vec<Self>),
    /// A push: no reply to a command.
    Push(Vec<Self>),
}

impl Frame {
    /// Returns a string.
    pub(crate) fn text(&self) -> Option<&[u8]> {
        match self {
            Self::Text(text) => Some(text),
            _ => None,
        }
    }

    /// Returns the elements of an array.
    pub(crate) fn array(&self) -> Option<&[Self]> {
        match self {
            Self::Array(elements) => Some(elements),
            _ => None,
        }
    }
}

impl fmt::Debug for Frame {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Text(text) => write!(f, "{:?}", String::from_utf8_lossy(text)),
            Self::TooLong => f.write_str("TooLong"),
            Self::Integer(number) => write!(f, "{number}"),
            Self::Null => f.write_str("Null"),
            Self::Error(text) => write!(f, "Error({:?})", String::from_utf8_lossy(text)),
            Self::Array(elements) => f.debug_list().entries(elements).finish(),
            Self::Push(elements) => f.debug_set().entries(elements).finish(),
        }
    }
}

/// Bounds of what a [`Decoder`] keeps.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Limits {
    /// Longest string that is kept.
    pub(crate) string_bytes_max: usize,
    /// Most bytes of a frame, each of its elements counted with [`FRAME_COST`].
    pub(crate) frame_bytes_max: usize,
}

/// The rule of the protocol that a server broke.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Error)]
pub(crate) enum RespError {
    #[error("the server sent a frame of unknown type {0:#04x}")]
    Type(u8),
    #[error("the server sent a line of more than {LINE_BYTES_MAX} bytes")]
    Line,
    #[error("the server sent a number that is none")]
    Number,
    #[error("the server sent a string or frame without its end")]
    End,
    #[error("the server sent more than {DEPTH_MAX} arrays in each other")]
    Depth,
    #[error("the server sent a frame that is too large")]
    Size,
}

/// An array whose elements are being read.
struct Open {
    is_push: bool,
    missing: u64,
    elements: Vec<Frame>,
}

/// A string behind its length.
#[derive(Clone, Copy)]
enum Pending {
    Keep {
        length: usize,
        is_error: bool,
    },
    /// The rest of a string that is too long, with its line break.
    Skip {
        left: u64,
    },
}

/// Reads frames from the bytes of a server.
pub(crate) struct Decoder {
    limits: Limits,
    buffer: BytesMut,
    /// Bytes of the buffer that hold no line break.
    scanned: usize,
    open: Vec<Open>,
    pending: Option<Pending>,
    /// Bytes that the frame is counted with so far.
    cost: usize,
}

impl Decoder {
    pub(crate) fn new(limits: Limits) -> Self {
        Self { limits, buffer: BytesMut::new(), scanned: 0, open: Vec::new(), pending: None, cost: 0 }
    }

    /// Returns the buffer, to which the caller appends the bytes of the server.
    pub(crate) fn buffer(&mut self) -> &mut BytesMut {
        &mut self.buffer
    }

    /// Returns the next frame, or `None` until there are more bytes. After an error, the bytes have no meaning any more.
    pub(crate) fn next_frame(&mut self) -> Result<Option<Frame>, RespError> {
        loop {
            let Some(mut frame) = self.next_element()? else { return Ok(None) };
            // Closes all arrays whose last element this is.
            loop {
                let Some(open) = self.open.last_mut() else {
                    self.cost = 0;
                    return Ok(Some(frame));
                };
                open.elements.push(frame);
                open.missing -= 1;
                if open.missing > 0 {
                    break;
                }
                let Some(Open { is_push, elements, .. }) = self.open.pop() else {
                    return Err(RespError::Depth);
                };
                frame = if is_push { Frame::Push(elements) } else { Frame::Array(elements) };
            }
        }
    }

    /// Returns the next frame that is no array with elements; such arrays become [`Open`].
    fn next_element(&mut self) -> Result<Option<Frame>, RespError> {
        loop {
            if let Some(pending) = self.pending {
                return self.rest_of_string(pending);
            }
            let Some(line) = self.take_line()? else { return Ok(None) };
            let Some((&kind, rest)) = line.split_first() else { return Err(RespError::End) };
            self.charge(FRAME_COST)?;
            return Ok(Some(match kind {
                b'$' | b'=' | b'!' => {
                    let Some(length) = length(rest)? else { return Ok(Some(Frame::Null)) };
                    self.pending = Some(self.pending_string(length, kind == b'!')?);
                    continue;
                }
                b'*' | b'~' | b'>' | b'%' => {
                    let Some(length) = length(rest)? else { return Ok(Some(Frame::Null)) };
                    let missing = if kind == b'%' { length.saturating_mul(2) } else { length };
                    let is_push = kind == b'>';
                    // A push within a reply would be taken for none.
                    if is_push && !self.open.is_empty() {
                        return Err(RespError::Type(kind));
                    }
                    match missing {
                        0 if is_push => Frame::Push(Vec::new()),
                        0 => Frame::Array(Vec::new()),
                        _ if self.open.len() >= DEPTH_MAX => return Err(RespError::Depth),
                        _ => {
                            self.open.push(Open { is_push, missing, elements: Vec::new() });
                            continue;
                        }
                    }
                }
                b'+' | b',' | b'(' => {
                    let text = Bytes::copy_from_slice(rest);
                    self.charge(text.len())?;
                    Frame::Text(text)
                }
                b'-' => {
                    let text = Bytes::copy_from_slice(rest);
                    self.charge(text.len())?;
                    Frame::Error(text)
                }
                b':' => Frame::Integer(number(rest)?),
                b'#' => Frame::Integer(i64::from(rest == b"t")),
                b'_' => Frame::Null,
                _ => return Err(RespError::Type(kind)),
            }));
        }
    }

    fn pending_string(&mut self, length: u64, is_error: bool) -> Result<Pending, RespError> {
        if length > STRING_BYTES_MAX {
            return Err(RespError::Size);
        }
        match usize::try_from(length) {
            Ok(length) if length <= self.limits.string_bytes_max => {
                self.charge(length)?;
                Ok(Pending::Keep { length, is_error })
            }
            _ => Ok(Pending::Skip { left: length + 2 }),
        }
    }

    fn rest_of_string(&mut self, pending: Pending) -> Result<Option<Frame>, RespError> {
        match pending {
            Pending::Keep { length, is_error } => {
                if self.buffer.len() < length + 2 {
                    return Ok(None);
                }
                // A copy, so that a small string does not keep a large buffer.
                let text = Bytes::copy_from_slice(&self.buffer[..length]);
                if &self.buffer[length..length + 2] != b"\r\n" {
                    return Err(RespError::End);
                }
                self.buffer.advance(length + 2);
                self.pending = None;
                Ok(Some(if is_error { Frame::Error(text) } else { Frame::Text(text) }))
            }
            Pending::Skip { left } => {
                let here = usize::try_from(left).unwrap_or(usize::MAX).min(self.buffer.len());
                self.buffer.advance(here);
                let left = left - here as u64;
                self.pending = (left > 0).then_some(Pending::Skip { left });
                Ok((left == 0).then_some(Frame::TooLong))
            }
        }
    }

    /// Takes a line without its break.
    fn take_line(&mut self) -> Result<Option<Bytes>, RespError> {
        let found = self.buffer[self.scanned..].windows(2).position(|two| two == b"\r\n");
        let Some(length) = found.map(|at| self.scanned + at) else {
            if self.buffer.len() > LINE_BYTES_MAX {
                return Err(RespError::Line);
            }
            self.scanned = self.buffer.len().saturating_sub(1);
            return Ok(None);
        };
        if length > LINE_BYTES_MAX {
            return Err(RespError::Line);
        }
        self.scanned = 0;
        let line = self.buffer.split_to(length).freeze();
        self.buffer.advance(2);
        Ok(Some(line))
    }

    fn charge(&mut self, bytes: usize) -> Result<(), RespError> {
        self.cost += bytes;
        if self.cost > self.limits.frame_bytes_max { Err(RespError::Size) } else { Ok(()) }
    }
}

fn number(text: &[u8]) -> Result<i64, RespError> {
    std::str::from_utf8(text).ok().and_then(|text| text.parse().ok()).ok_or(RespError::Number)
}

/// Returns a length; `None` is the null of RESP2.
fn length(text: &[u8]) -> Result<Option<u64>, RespError> {
    match number(text)? {
        -1 => Ok(None),
        length => u64::try_from(length).map(Some).map_err(|_| RespError::Number),
    }
}

/// Appends a command.
pub(crate) fn encode(command: &[&[u8]], to: &mut Vec<u8>) {
    to.extend_from_slice(format!("*{}\r\n", command.len()).as_bytes());
    for part in command {
        to.extend_from_slice(format!("${}\r\n", part.len()).as_bytes());
        to.extend_from_slice(part);
        to.extend_from_slice(b"\r\n");
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::fuzzing::decode_in_pieces;

    const LIMITS: Limits = Limits { string_bytes_max: 16, frame_bytes_max: 1024 };

    fn text(text: &'static str) -> Frame {
        Frame::Text(Bytes::from_static(text.as_bytes()))
    }

    fn decode(bytes: &[u8]) -> Result<Vec<Frame>, RespError> {
        decode_in_pieces(bytes, LIMITS)
    }

    #[test]
    fn random_bytes_are_read_alike_in_all_pieces() {
        const PIECES: [&[u8]; 12] = [
            b"*2\r\n",
            b"$3\r\nabc\r\n",
            b":7\r\n",
            b"_\r\n",
            b"%1\r\n",
            b">2\r\n",
            b"-ERR x\r\n",
            b"=7\r\ntxt:abc\r\n",
            b"$99999999999\r\n",
            b"*-1\r\n",
            b"\r\n",
            b"#t\r\n",
        ];
        let mut dice = sgc_testkit::Dice::new(1);
        for _ in 0..20_000 {
            let mut bytes = Vec::new();
            for _ in 0..dice.within(1..=8) {
                bytes.extend_from_slice(PIECES[dice.below(PIECES.len())]);
            }
            if dice.chance(50) {
                let at = dice.below(bytes.len());
                bytes[at] = dice.below(256) as u8;
            }
            // Panics and differences between pieces are the failures.
            let _ = decode(&bytes);
        }
    }

    #[test]
    fn frames_of_all_types_are_read() {
        let bytes = b"+OK\r\n:-7\r\n$3\r\na\r\n\r\n$-1\r\n_\r\n#t\r\n#f\r\n,1.5\r\n-ERR no\r\n!5\r\nERR x\r\n=5\r\ntxt:a\r\n";
        let expected = [
            text("OK"),
            Frame::Integer(-7),
            text("a\r\n"),
            Frame::Null,
            Frame::Null,
            Frame::Integer(1),
            Frame::Integer(0),
            text("1.5"),
            Frame::Error(Bytes::from_static(b"ERR no")),
            Frame::Error(Bytes::from_static(b"ERR x")),
            text("txt:a"),
        ];
        assert_eq!(decode(bytes).unwrap(), expected);
    }

    #[test]
    fn arrays_nest_and_maps_are_flat() {
        let bytes =
            b"*3\r\n*0\r\n*2\r\n:1\r\n~1\r\n+a\r\n%1\r\n+k\r\n*-1\r\n>2\r\n+invalidate\r\n_\r\n*0\r\n";
        let expected = [
            Frame::Array(vec![
                Frame::Array(vec![]),
                Frame::Array(vec![Frame::Integer(1), Frame::Array(vec![text("a")])]),
                Frame::Array(vec![text("k"), Frame::Null]),
            ]),
            Frame::Push(vec![text("invalidate"), Frame::Null]),
            Frame::Array(vec![]),
        ];
        assert_eq!(decode(bytes).unwrap(), expected);
    }

    #[test]
    fn long_strings_are_skipped_and_the_next_frame_is_read() {
        let bytes = [b"*2\r\n$17\r\n".as_slice(), &[b'x'; 17], b"\r\n+a\r\n:1\r\n"].concat();
        assert_eq!(
            decode(&bytes).unwrap(),
            [Frame::Array(vec![Frame::TooLong, text("a")]), Frame::Integer(1)]
        );
    }

    #[test]
    fn hostile_bytes_are_refused() {
        for (bytes, error) in [
            (b"*1\r\n".repeat(100_000), RespError::Depth),
            (
                b"*9223372036854775807\r\n".iter().copied().chain(b":1\r\n".repeat(1000)).collect(),
                RespError::Size,
            ),
            (
                b"%9223372036854775807\r\n".iter().copied().chain(b":1\r\n".repeat(1000)).collect(),
                RespError::Size,
            ),
            (b"$9223372036854775807\r\n".to_vec(), RespError::Size),
            (b"$-2\r\n".to_vec(), RespError::Number),
            (b"$?\r\n".to_vec(), RespError::Number),
            (b"$18446744073709551616\r\n".to_vec(), RespError::Number),
            (b":\r\n".to_vec(), RespError::Number),
            (b"$1\r\nabc".to_vec(), RespError::End),
            (b"\r\n".to_vec(), RespError::End),
            (b"HTTP/1.1 400 Bad Request\r\n".to_vec(), RespError::Type(b'H')),
            (b"|1\r\n+a\r\n+b\r\n".to_vec(), RespError::Type(b'|')),
            (b"*1\r\n>1\r\n".to_vec(), RespError::Type(b'>')),
            (vec![b'+'; LINE_BYTES_MAX + 1], RespError::Line),
        ] {
            assert_eq!(decode(&bytes), Err(error), "{:?}", bytes.get(..20));
        }
    }

    #[test]
    fn commands_are_arrays_of_strings() {
        let mut bytes = Vec::new();
        encode(&[b"GET", b"a\r\n\0"], &mut bytes);
        assert_eq!(bytes, b"*2\r\n$3\r\nGET\r\n$4\r\na\r\n\0\r\n");
        assert!(matches!(decode(&bytes).unwrap().as_slice(), [Frame::Array(parts)] if parts.len() == 2));
    }
}
