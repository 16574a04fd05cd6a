//! Serialised samples for Cyclone: checked, padded, and marked as padded.
//!
//! The module is pure and copies nothing: a [`Frame`] lists the pieces to write. It reads only the four bytes of the
//! encapsulation header (RTPS 2.5, 10.2).

use sgc_ros::RosError;

/// Longest payload written or received, in bytes, including header and padding.
pub const PAYLOAD_BYTES_MAX: usize = 64 << 20;

/// Length of the encapsulation header, bytes.
pub const HEADER_BYTES: usize = 4;

/// Length of a prefix between the header and the body, in bytes.
pub const PREFIX_BYTES: usize = 16;

/// A payload in pieces for Cyclone: a new header, a prefix, the body, and zeros up to a multiple of four.
///
/// Cyclone sends samples in multiples of four bytes. It would read a sample of another length past the end of the
/// buffer and send those bytes.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Frame<'a> {
    /// The encapsulation header. Its two pad bits hold the number of padding bytes.
    pub header: [u8; HEADER_BYTES],
    /// The prefix of the body, a multiple of eight bytes, so that the alignment of the body does not change.
    pub prefix: [u8; PREFIX_BYTES],
    /// The length of the prefix: 0 or all of it.
    pub prefix_bytes: usize,
    /// The body, unchanged.
    pub body: &'a [u8],
    /// The number of zero bytes to append, 0 to 3.
    pub pad: usize,
}

impl<'a> Frame<'a> {
    /// Checks a payload and frames it.
    ///
    /// # Errors
    /// [`RosError::Payload`] if it is shorter than its header, longer than [`PAYLOAD_BYTES_MAX`] or of an
    /// encapsulation that no specification defines.
    pub fn new(payload: &'a [u8]) -> Result<Self, RosError> {
        Self::with(payload, 0, |_| [0; PREFIX_BYTES])
    }

    /// Frames a payload with a prefix. The prefix is made for the payload's byte order, big endian (`false`) or
    /// little endian (`true`).
    ///
    /// # Errors
    /// The errors of [`Self::new`].
    pub fn with_prefix(
        payload: &'a [u8],
        prefix: impl FnOnce(bool) -> [u8; PREFIX_BYTES],
    ) -> Result<Self, RosError> {
        Self::with(payload, PREFIX_BYTES, prefix)
    }

    fn with(
        payload: &'a [u8],
        prefix_bytes: usize,
        prefix: impl FnOnce(bool) -> [u8; PREFIX_BYTES],
    ) -> Result<Self, RosError> {
        // Made only when returned: a value made here would be dropped on the way of every good payload.
        let refused = || RosError::Payload { bytes: payload.len() };
        let Some((&header, body)) = payload.split_first_chunk::<HEADER_BYTES>() else {
            return Err(refused());
        };
        let pad = payload.len().wrapping_neg() & 3;
        if payload.len() + prefix_bytes + pad > PAYLOAD_BYTES_MAX
            || !is_encapsulation(u16::from_be_bytes([header[0], header[1]]))
        {
            return Err(refused());
        }
        let mut frame = Self { header, prefix: prefix(is_little_endian(header)), prefix_bytes, body, pad };
        if pad > 0 {
            // Former pad bits described the padding of an aligned payload and have no meaning here.
            frame.header[3] = (frame.header[3] & !3) | pad as u8;
        }
        Ok(frame)
    }

    /// Returns the length of header, prefix, body and padding in bytes, a multiple of four.
    pub fn bytes(&self) -> usize {
        HEADER_BYTES + self.prefix_bytes + self.body.len() + self.pad
    }
}

/// Returns `true` for a little-endian payload, whose encapsulation identifier is odd (RTPS 2.5, 10.2).
pub fn is_little_endian(header: [u8; HEADER_BYTES]) -> bool {
    header[1] & 1 == 1
}

/// Encapsulation identifiers: 0 to 4 of RTPS 2.5 table 10.1 (CDR, PL_CDR, XML), 6 to 11 of XTypes 1.3
/// table 60 (XCDR2), 16 to 21 as RTPS 2.5 numbers XCDR2.
fn is_encapsulation(id: u16) -> bool {
    matches!(id, 0x0000..=0x0004 | 0x0006..=0x000b | 0x0010..=0x0015)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn aligned_payloads_are_left_alone() {
        let frame = Frame::new(&[0, 1, 0, 2, 9, 9, 0, 0]).unwrap();
        assert_eq!((frame.header, frame.body, frame.pad), ([0, 1, 0, 2], &[9, 9, 0, 0][..], 0));
        assert_eq!(Frame::new(&[0, 1, 0, 0]).unwrap().bytes(), 4);
    }

    #[test]
    fn others_are_padded_and_say_so() {
        for (body, pad) in [(1, 3), (2, 2), (3, 1), (5, 3)] {
            let payload = [vec![0, 1, 0, 0xf0], vec![7; body]].concat();
            let frame = Frame::new(&payload).unwrap();
            assert_eq!((frame.pad, frame.header[3]), (pad, 0xf0 | pad as u8));
            assert_eq!(frame.bytes() % 4, 0);
        }
    }

    #[test]
    fn a_prefix_is_in_the_byte_order_of_its_payload() {
        for (id, little) in [(0, false), (1, true), (6, false), (7, true)] {
            let payload = [0, id, 0, 0, 5];
            let frame = Frame::with_prefix(&payload, |found| [u8::from(found == little); 16]).unwrap();
            assert_eq!((frame.prefix, frame.pad, frame.bytes()), ([1; 16], 3, 24));
        }
    }

    #[test]
    fn invalid_payloads_are_refused() {
        for bytes in [&[][..], &[0], &[0, 1, 0], &[0x12, 0x34, 0, 0], &[0, 5, 0, 0]] {
            assert_eq!(Frame::new(bytes), Err(RosError::Payload { bytes: bytes.len() }));
        }
        let large = vec![0; PAYLOAD_BYTES_MAX + 1];
        assert_eq!(Frame::new(&large), Err(RosError::Payload { bytes: large.len() }));
        assert!(Frame::new(&large[1..]).is_ok());
    }
}
