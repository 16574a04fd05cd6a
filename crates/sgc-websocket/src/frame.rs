//! Frames (RFC 6455, 5.2): their heads and masks.

use std::io;

use aws_lc_rs::rand;
use bytes::{BufMut as _, BytesMut};

/// Longest frame that a stream of bytes accepts, bytes; its content is passed on as it comes.
pub const WS_FRAME_BYTES_MAX: u64 = 1 << 20;
/// Longest payload of a control frame (RFC 6455, 5.5).
pub(crate) const WS_CONTROL_BYTES_MAX: u64 = 125;
pub(crate) const WS_HEAD_BYTES_MAX: usize = 14;

pub(crate) const CONTINUATION: u8 = 0;
pub(crate) const TEXT: u8 = 1;
pub(crate) const BINARY: u8 = 2;
pub(crate) const CLOSE: u8 = 8;
pub(crate) const PING: u8 = 9;
pub(crate) const PONG: u8 = 10;

/// The head of a frame, and the part of its payload that has not been read.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) struct Frame {
    pub(crate) opcode: u8,
    pub(crate) is_final: bool,
    pub(crate) left: u64,
    pub(crate) mask: [u8; 4],
}

/// A breach of the rules of frames.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum FrameError {
    /// A reserved bit or opcode.
    Kind,
    /// Masked by a listener, or not masked by a dialer.
    Mask,
    /// A control frame that is too long or in pieces.
    Control,
    /// A frame of more bytes than are accepted.
    TooLong,
}

impl FrameError {
    pub(crate) fn as_str(self) -> &'static str {
        match self {
            Self::Kind => "a frame of an unknown kind",
            Self::Mask => "masked where it must not be, or not where it must",
            Self::Control | Self::TooLong => "a frame that is too long",
        }
    }
}

impl From<FrameError> for io::Error {
    fn from(error: FrameError) -> Self {
        Self::new(io::ErrorKind::InvalidData, format!("WebSocket: {}", error.as_str()))
    }
}

impl Frame {
    /// Reads the head of a frame. Returns it and its length, or nothing while more bytes are needed.
    pub(crate) fn read(
        bytes: &[u8],
        is_masked: bool,
        bytes_max: u64,
    ) -> Result<Option<(Self, usize)>, FrameError> {
        let [first, second, rest @ ..] = bytes else { return Ok(None) };
        let (opcode, is_final) = (first & 0x0f, first & 0x80 != 0);
        if first & 0x70 != 0 || !matches!(opcode, CONTINUATION | TEXT | BINARY | CLOSE | PING | PONG) {
            return Err(FrameError::Kind);
        }
        if (second & 0x80 != 0) != is_masked {
            return Err(FrameError::Mask);
        }
        let (left, rest) = match second & 0x7f {
            126 => match rest.split_first_chunk::<2>() {
                Some((length, rest)) => (u64::from(u16::from_be_bytes(*length)), rest),
                None => return Ok(None),
            },
            127 => match rest.split_first_chunk::<8>() {
                Some((length, rest)) => (u64::from_be_bytes(*length), rest),
                None => return Ok(None),
            },
            length => (u64::from(length), rest),
        };
        if opcode >= CLOSE && (left > WS_CONTROL_BYTES_MAX || !is_final) {
            return Err(FrameError::Control);
        }
        if left > bytes_max {
            return Err(FrameError::TooLong);
        }
        let (mask, rest) = match rest.split_first_chunk::<4>() {
            _ if !is_masked => ([0; 4], rest),
            Some((mask, rest)) => (*mask, rest),
            None => return Ok(None),
        };
        Ok(Some((Self { opcode, is_final, left, mask }, bytes.len() - rest.len())))
    }

    /// Removes the mask of the next bytes of the payload.
    pub(crate) fn unmask(&mut self, bytes: &mut [u8]) {
        apply(self.mask, bytes);
        self.mask.rotate_left(bytes.len() % 4);
        self.left -= bytes.len() as u64;
    }
}

/// Writes a whole message or control frame. Dialers mask their frames, listeners do not (RFC 6455, 5.3).
pub(crate) fn put_frame(output: &mut BytesMut, is_dialer: bool, opcode: u8, payload: &[u8]) {
    const FINAL: u8 = 0x80;
    const MASKED: u8 = 0x80;
    let mask_bit = if is_dialer { MASKED } else { 0 };
    output.reserve(WS_HEAD_BYTES_MAX + payload.len());
    output.put_u8(FINAL | opcode);
    match payload.len() {
        n @ 0..=125 => output.put_u8(mask_bit | n as u8),
        n @ 126..=0xffff => {
            output.put_u8(mask_bit | 126);
            output.put_u16(n as u16);
        }
        n => {
            output.put_u8(mask_bit | 127);
            output.put_u64(n as u64);
        }
    }
    if !is_dialer {
        output.extend_from_slice(payload);
        return;
    }
    let mut mask = [0; 4];
    fill(&mut mask);
    output.extend_from_slice(&mask);
    let start = output.len();
    output.extend_from_slice(payload);
    apply(mask, &mut output[start..]);
}

/// Masks, or removes the mask.
pub(crate) fn apply(mask: [u8; 4], bytes: &mut [u8]) {
    let [a, b, c, d] = mask;
    let wide = u64::from_ne_bytes([a, b, c, d, a, b, c, d]);
    let (words, rest) = bytes.as_chunks_mut::<8>();
    for word in words {
        *word = (u64::from_ne_bytes(*word) ^ wide).to_ne_bytes();
    }
    for (byte, mask) in rest.iter_mut().zip(mask.into_iter().cycle()) {
        *byte ^= mask;
    }
}

pub(crate) fn fill(bytes: &mut [u8]) {
    rand::fill(bytes).expect("the system has random numbers, or TLS had not started either");
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn impossible_frames_are_refused() {
        for bytes in [
            &[0x82, 0x00][..],
            &[0xc2, 0x80],
            &[0x89, 0xfe, 0, 126],
            &[0x09, 0x80],
            &[0x83, 0x80],
            &[0x82, 0xff, 0, 0, 0, 0, 0, 0x10, 0, 1],
            &[0x82, 0xff, 0xff, 0xff, 0xff, 0xff, 0xff, 0xff, 0xff, 0xff],
        ] {
            Frame::read(bytes, true, WS_FRAME_BYTES_MAX).unwrap_err();
        }
    }

    #[test]
    fn masks_apply_to_every_length_and_place() {
        let (mask, plain) = ([1, 2, 3, 4], (0..40).collect::<Vec<u8>>());
        for length in 0..plain.len() {
            let mut masked = plain[..length].to_vec();
            apply(mask, &mut masked);
            assert!(masked.iter().enumerate().all(|(at, byte)| *byte == plain[at] ^ mask[at % 4]));
            for cut in 0..length {
                let mut frame = Frame { opcode: BINARY, is_final: true, left: length as u64, mask };
                let mut unmasked = masked.clone();
                let (first, second) = unmasked.split_at_mut(cut);
                frame.unmask(first);
                frame.unmask(second);
                assert_eq!((unmasked.as_slice(), frame.left), (&plain[..length], 0));
            }
        }
    }
}
