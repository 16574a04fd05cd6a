//! Prefixes for frames of `tf2_msgs/msg/TFMessage`, which distinguish the `base_link` of two robots on one network.
//!
//! This is the only CDR that SGC's routes look into: plain CDR (XCDR1, RTPS 2.5, 10.2) in both byte orders, which ROS
//! 2's middlewares write for this type. Other messages, which carry frames as well, are not rewritten.

/// The DDS name of the type that is rewritten.
pub const TF_MESSAGE: &str = "tf2_msgs::msg::dds_::TFMessage_";
/// Longest rewritten message, in bytes.
const REWRITTEN_BYTES_MAX: usize = sgc_wire::MESSAGE_BYTES_MAX as usize;
/// Length of a transform with two empty names: time, two strings, translation and rotation.
const TRANSFORM_BYTES_MIN: usize = 8 + 5 + 5 + POSE_BYTES;
/// Length of translation (3) and rotation (4).
const POSE_BYTES: usize = 7 * 8;
const HEADER_BYTES: usize = 4;

/// The reason why a message cannot be rewritten.
#[derive(Clone, Copy, Debug, PartialEq, Eq, thiserror::Error)]
pub enum FrameError {
    /// The encapsulation is not plain CDR.
    #[error("a tf message in encapsulation {0:#06x}, which is not plain CDR")]
    Encapsulation(u16),
    /// The message is truncated, has surplus bytes, or contains an unterminated string.
    #[error("a malformed tf message")]
    Malformed,
    /// The message would become too long.
    #[error("a tf message that would become too long")]
    TooLong,
}

/// Returns the message with `prefix` before the name of each frame. The prefix replaces a leading slash (as before
/// tf2), and an empty name stays empty.
pub fn prefix_frames(payload: &[u8], prefix: &str) -> Result<Vec<u8>, FrameError> {
    let (header, body) = payload.split_first_chunk::<HEADER_BYTES>().ok_or(FrameError::Malformed)?;
    let little = match u16::from_be_bytes([header[0], header[1]]) {
        0 => false,
        1 => true,
        other => return Err(FrameError::Encapsulation(other)),
    };
    // The last two bits of the options give the length of the padding at the end.
    let padding = usize::from(header[3] & 3);
    let body = body.get(..body.len().saturating_sub(padding)).ok_or(FrameError::Malformed)?;
    let mut read = Reader { body, at: 0, little };
    let mut write = Writer { out: Vec::with_capacity(payload.len() + 64), little };
    write.out.extend_from_slice(&[header[0], header[1], header[2], header[3] & !3]);
    let transforms = read.u32()?;
    if transforms as usize > body.len() / TRANSFORM_BYTES_MIN {
        return Err(FrameError::Malformed);
    }
    write.u32(transforms);
    for _ in 0..transforms {
        read.align(4)?;
        write.align(4);
        write.out.extend_from_slice(read.take(8)?);
        for _ in 0..2 {
            let name = read.string()?;
            let bare = name.strip_prefix(b"/").unwrap_or(name);
            let prefix = if bare.is_empty() { "" } else { prefix };
            write.string(&[prefix.as_bytes(), bare]);
        }
        read.align(8)?;
        write.align(8);
        write.out.extend_from_slice(read.take(POSE_BYTES)?);
        if write.out.len() > REWRITTEN_BYTES_MAX {
            return Err(FrameError::TooLong);
        }
    }
    // Writers may pad without saying so in the options.
    if read.body.len() - read.at >= HEADER_BYTES {
        return Err(FrameError::Malformed);
    }
    // A pose ends at a multiple of four, so no padding is needed.
    Ok(write.out)
}

struct Reader<'b> {
    body: &'b [u8],
    at: usize,
    little: bool,
}

impl<'b> Reader<'b> {
    fn take(&mut self, bytes: usize) -> Result<&'b [u8], FrameError> {
        let end = self.at.checked_add(bytes).ok_or(FrameError::Malformed)?;
        let taken = self.body.get(self.at..end).ok_or(FrameError::Malformed)?;
        self.at = end;
        Ok(taken)
    }

    fn align(&mut self, to: usize) -> Result<(), FrameError> {
        self.take(self.at.next_multiple_of(to) - self.at).map(drop)
    }

    fn u32(&mut self) -> Result<u32, FrameError> {
        self.align(4)?;
        let bytes = self.take(4)?.try_into().map_err(|_| FrameError::Malformed)?;
        Ok(if self.little { u32::from_le_bytes(bytes) } else { u32::from_be_bytes(bytes) })
    }

    /// Reads a string without its terminator. A string of no bytes at all, which some writers produce, is empty.
    fn string(&mut self) -> Result<&'b [u8], FrameError> {
        match self.u32()? as usize {
            0 => Ok(&[]),
            bytes => match self.take(bytes)?.split_last() {
                Some((0, text)) if !text.contains(&0) => Ok(text),
                _ => Err(FrameError::Malformed),
            },
        }
    }
}

struct Writer {
    out: Vec<u8>,
    little: bool,
}

impl Writer {
    fn align(&mut self, to: usize) {
        let bytes = self.out.len() - HEADER_BYTES;
        self.out.resize(HEADER_BYTES + bytes.next_multiple_of(to), 0);
    }

    fn u32(&mut self, value: u32) {
        self.align(4);
        self.out.extend(if self.little { value.to_le_bytes() } else { value.to_be_bytes() });
    }

    fn string(&mut self, parts: &[&[u8]]) {
        self.u32(parts.iter().map(|part| part.len() as u32).sum::<u32>() + 1);
        parts.iter().for_each(|part| self.out.extend_from_slice(part));
        self.out.push(0);
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Returns a message with these frames, written by hand in XCDR1.
    fn message(little: bool, frames: &[(&str, &str)]) -> Vec<u8> {
        let mut write = Writer { out: vec![0, u8::from(little), 0, 0], little };
        write.u32(frames.len() as u32);
        for (index, (frame, child)) in frames.iter().enumerate() {
            write.u32(1_700_000_000);
            write.u32(index as u32);
            for name in [frame, child] {
                write.string(&[name.as_bytes()]);
            }
            write.align(8);
            for value in 0..7 {
                let bytes = (f64::from(value) + index as f64 / 10.0).to_bits();
                write.out.extend(if little { bytes.to_le_bytes() } else { bytes.to_be_bytes() });
            }
        }
        write.out
    }

    #[test]
    fn both_names_of_every_transform_get_the_prefix() {
        for little in [false, true] {
            let before = [("map", "odom"), ("/odom", "base_link"), ("", "a"), ("ab", "abc")];
            let after =
                [("r1/map", "r1/odom"), ("r1/odom", "r1/base_link"), ("", "r1/a"), ("r1/ab", "r1/abc")];
            for n in 0..=before.len() {
                let rewritten = prefix_frames(&message(little, &before[..n]), "r1/");
                assert_eq!(rewritten, Ok(message(little, &after[..n])), "{little} {n}");
            }
        }
        // The exact bytes of one transform, little endian.
        let bytes = prefix_frames(&message(true, &[("a", "b")]), "r/").unwrap();
        assert_eq!(bytes[..8], [0, 1, 0, 0, 1, 0, 0, 0]);
        assert_eq!(bytes[16..32], [4, 0, 0, 0, b'r', b'/', b'a', 0, 4, 0, 0, 0, b'r', b'/', b'b', 0]);
        assert_eq!(bytes.len(), 4 + 4 + 8 + 16 + 4 + 56);
    }

    #[test]
    fn padding_is_not_content() {
        let mut padded = message(true, &[("a", "b")]);
        let expected = prefix_frames(&padded, "r/").unwrap();
        padded.extend([0, 0, 0]);
        assert_eq!(prefix_frames(&padded, "r/"), Ok(expected.clone()));
        padded[3] = 3;
        assert_eq!(prefix_frames(&padded, "r/"), Ok(expected));
        padded.push(0);
        assert_eq!(
            prefix_frames(&padded, "r/"),
            Ok(prefix_frames(&message(true, &[("a", "b")]), "r/").unwrap())
        );
        padded.push(0);
        padded.push(0);
        padded.push(0);
        assert_eq!(prefix_frames(&padded, "r/"), Err(FrameError::Malformed));
    }

    #[test]
    fn malformed_messages_are_refused_wherever_they_end() {
        let whole = message(true, &[("map", "odom"), ("odom", "base_link")]);
        for end in 0..whole.len() {
            assert_eq!(prefix_frames(&whole[..end], "r/"), Err(FrameError::Malformed), "{end}");
        }
        let changed = |at: usize, value: u8| {
            let mut bytes = whole.clone();
            bytes[at] = value;
            prefix_frames(&bytes, "r/")
        };
        assert_eq!(changed(1, 7), Err(FrameError::Encapsulation(7)), "XCDR2");
        assert_eq!(changed(1, 3), Err(FrameError::Encapsulation(3)), "a parameter list");
        for (at, value) in [(4, 3), (7, 0xff), (16, 0xff), (19, 0x7f), (16, 5), (20, 0)] {
            assert_eq!(changed(at, value), Err(FrameError::Malformed), "{at} {value}");
        }
        // No changed byte makes it panic or allocate much.
        for at in 0..whole.len() {
            for value in [0, 1, 2, 0x7f, 0x80, 0xff] {
                let _ = changed(at, value);
            }
        }
    }

    #[test]
    fn messages_that_become_too_long_are_refused() {
        let frames = vec![("a", "b"); 600_000];
        let prefix = "p".repeat(64);
        assert_eq!(prefix_frames(&message(true, &frames), &prefix), Err(FrameError::TooLong));
    }
}
