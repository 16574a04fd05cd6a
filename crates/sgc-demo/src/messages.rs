//! The demo's messages: real ROS 2 messages in CDR. The content of each holds a sequence number, the time of sending
//! and a checksum, so that a listener detects any alteration.
//!
//! Pure: times are arguments. This is no general CDR library: it knows three types (`std_msgs/String`,
//! `sensor_msgs/Image`, `geometry_msgs/Twist`) in plain CDR, little endian (RTPS 2.5, 10; XTypes 1.3, 7.4.1).

use aws_lc_rs::digest::{Context, SHA256, digest};
use bytes::Bytes;

use crate::topics::Topic;

/// Encapsulation of plain CDR, little endian, no options (RTPS 2.5, 10.2).
const ENCAPSULATION: [u8; ENCAPSULATION_BYTES] = [0, 1, 0, 0];
const ENCAPSULATION_BYTES: usize = 4;

/// Image size: 500 × 500 × 4 bytes are one megabyte.
const IMAGE_SIDE: u32 = 500;
const IMAGE_ENCODING: &str = "rgba8";
const IMAGE_PIXEL_BYTES: usize = 4;
/// The mark at the beginning of an image. The first pixels hold it, the number, the time and the checksum.
const IMAGE_MARK: &[u8; 8] = b"sgc-demo";
const IMAGE_STAMP_BYTES: usize = 24;
const IMAGE_PLAIN_FROM: usize = IMAGE_STAMP_BYTES + DIGEST_BYTES;
const DIGEST_BYTES: usize = 32;

/// Unit of the number in a Twist. It stands in components that hardly move a robot; a power of two avoids rounding.
const TWIST_SEQ_UNIT: f64 = 1.0 / (1_u64 << 40) as f64;
const TWIST_MICROS_UNIT: f64 = 1.0 / (1_u64 << 60) as f64;
const TWIST_SUM_UNIT: f64 = 1.0 / (1_u64 << 40) as f64;
/// Largest integer below which a double is exact.
const EXACT_MAX: f64 = (1_u64 << 53) as f64;

/// The number and time inside a message.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) struct Stamp {
    /// Sequence number from 1, or 0 for messages that are not counted.
    pub(crate) seq: u64,
    /// Time of sending, in nanoseconds of the monotonic clock that all processes of a host share. A Twist holds whole
    /// microseconds.
    pub(crate) sent_ns: u64,
}

/// The way in which a received message differs from a sent one.
#[derive(Clone, Copy, Debug, PartialEq, Eq, thiserror::Error)]
pub(crate) enum Damage {
    /// The bytes are no message of the type.
    #[error("not a message of its type: {0}")]
    Malformed(&'static str),
    /// The message does not come from a talker of the demo.
    #[error("not a message of the demo: {0}")]
    Foreign(&'static str),
    /// The checksum does not match the content.
    #[error("the checksum is wrong")]
    Checksum,
}

/// A message that lacks only its time, so that finishing it is fast.
pub(crate) enum Draft {
    /// A Text or Twist, which needs no preparation.
    Small {
        /// The topic.
        topic: Topic,
        /// The sequence number.
        seq: u64,
    },
    /// An image with room for the times and the checksum.
    Image(ImageDraft),
}

/// An image without times and checksum.
pub(crate) struct ImageDraft {
    payload: Vec<u8>,
    seq: u64,
    pixels_at: usize,
    plain_digest: [u8; DIGEST_BYTES],
}

impl Draft {
    /// Prepares message `seq` of a topic.
    pub(crate) fn new(topic: Topic, seq: u64) -> Self {
        match topic {
            Topic::Chatter | Topic::CmdVel => Self::Small { topic, seq },
            Topic::Image => Self::Image(ImageDraft::new(seq)),
        }
    }

    /// Returns the serialised message. `unix_ns` becomes the header stamp of an image.
    pub(crate) fn finish(self, sent_ns: u64, unix_ns: u64) -> Bytes {
        match self {
            Self::Small { topic: Topic::CmdVel, seq } => twist(seq, sent_ns).into(),
            Self::Small { seq, .. } => text(seq, sent_ns).into(),
            Self::Image(draft) => draft.finish(sent_ns, unix_ns).into(),
        }
    }
}

/// Parses a message and verifies its checksum.
pub(crate) fn decode(topic: Topic, payload: &[u8]) -> Result<Stamp, Damage> {
    let mut r = CdrReader::new(payload)?;
    let stamp = match topic {
        Topic::Chatter => read_text(&mut r),
        Topic::Image => read_image(&mut r),
        Topic::CmdVel => read_twist(&mut r),
    }?;
    r.finish().map(|()| stamp)
}

fn text(seq: u64, sent_ns: u64) -> Vec<u8> {
    let said = format!("Hello World: {seq} [t={sent_ns}");
    let sum = short_sum(said.as_bytes());
    let mut w = CdrWriter::new();
    w.string(&format!("{said} sum={sum:08x}]"));
    w.bytes
}

fn read_text(r: &mut CdrReader<'_>) -> Result<Stamp, Damage> {
    let text = std::str::from_utf8(r.string()?).map_err(|_| Damage::Malformed("its text is not UTF-8"))?;
    let foreign = Damage::Foreign("its text is another");
    let (said, sum) = text.strip_suffix(']').and_then(|t| t.rsplit_once(" sum=")).ok_or(foreign)?;
    if format!("{:08x}", short_sum(said.as_bytes())) != sum {
        return Err(Damage::Checksum);
    }
    let numbers = said.strip_prefix("Hello World: ").and_then(|t| t.split_once(" [t="));
    let (seq, sent_ns) = numbers.ok_or(foreign)?;
    let number = |digits: &str| digits.parse().map_err(|_| foreign);
    Ok(Stamp { seq: number(seq)?, sent_ns: number(sent_ns)? })
}

fn twist(seq: u64, sent_ns: u64) -> Vec<u8> {
    // A robot that obeys these commands moves slowly along a wave.
    let forward = 0.1 + (seq % 50) as f64 / 500.0;
    let turn = ((seq % 100) as f64 - 50.0) / 500.0;
    let linear = [forward, seq as f64 * TWIST_SEQ_UNIT, (sent_ns / 1000) as f64 * TWIST_MICROS_UNIT];
    let sum = twist_sum([linear[0], linear[1], linear[2], 0.0, turn]);
    let mut w = CdrWriter::new();
    for value in linear.into_iter().chain([f64::from(sum) * TWIST_SUM_UNIT, 0.0, turn]) {
        w.f64(value);
    }
    w.bytes
}

fn read_twist(r: &mut CdrReader<'_>) -> Result<Stamp, Damage> {
    let mut values = [0.0; 6];
    for value in &mut values {
        *value = r.f64()?;
    }
    let [forward, seq, micros, sum, pitch, turn] = values;
    if integer(sum, TWIST_SUM_UNIT) != Some(twist_sum([forward, seq, micros, pitch, turn]).into()) {
        return Err(Damage::Checksum);
    }
    let foreign = Damage::Foreign("its velocities are others");
    let seq = integer(seq, TWIST_SEQ_UNIT).ok_or(foreign)?;
    let micros = integer(micros, TWIST_MICROS_UNIT).ok_or(foreign)?;
    Ok(Stamp { seq, sent_ns: micros * 1000 })
}

fn twist_sum(others: [f64; 5]) -> u32 {
    short_sum(&others.map(f64::to_le_bytes).concat())
}

/// Returns the integer n with `value` = n × `unit`.
fn integer(value: f64, unit: f64) -> Option<u64> {
    let n = value / unit;
    (n.fract() == 0.0 && (0.0..EXACT_MAX).contains(&n)).then_some(n as u64)
}

impl ImageDraft {
    fn new(seq: u64) -> Self {
        let pixels_bytes = (IMAGE_SIDE * IMAGE_SIDE) as usize * IMAGE_PIXEL_BYTES;
        let mut w = CdrWriter::new();
        w.bytes.reserve(pixels_bytes + 64);
        w.u32(0);
        w.u32(0);
        w.string("camera");
        w.u32(IMAGE_SIDE);
        w.u32(IMAGE_SIDE);
        w.string(IMAGE_ENCODING);
        w.u8(0);
        w.u32(IMAGE_SIDE * IMAGE_PIXEL_BYTES as u32);
        w.u32(pixels_bytes as u32);
        let pixels_at = w.bytes.len();
        // A pattern that shifts with every image.
        let shift = seq as u32;
        for y in 0..IMAGE_SIDE {
            for x in 0..IMAGE_SIDE {
                let (a, b) = (x.wrapping_add(shift), y.wrapping_add(shift / 2));
                w.bytes.extend([a as u8, b as u8, (a ^ b) as u8, 0xff]);
            }
        }
        let plain_digest = sha256(&w.bytes[pixels_at + IMAGE_PLAIN_FROM..]);
        Self { payload: w.bytes, seq, pixels_at, plain_digest }
    }

    fn finish(mut self, sent_ns: u64, unix_ns: u64) -> Vec<u8> {
        const NS: u64 = 1_000_000_000;
        let (head, pixels) = self.payload.split_at_mut(self.pixels_at);
        let head = &mut head[ENCAPSULATION_BYTES..];
        head[..4].copy_from_slice(&((unix_ns / NS) as u32).to_le_bytes());
        head[4..8].copy_from_slice(&((unix_ns % NS) as u32).to_le_bytes());
        pixels[..8].copy_from_slice(IMAGE_MARK);
        pixels[8..16].copy_from_slice(&self.seq.to_le_bytes());
        pixels[16..24].copy_from_slice(&sent_ns.to_le_bytes());
        let sum = image_sum(head, &pixels[..IMAGE_STAMP_BYTES], &self.plain_digest);
        pixels[IMAGE_STAMP_BYTES..IMAGE_PLAIN_FROM].copy_from_slice(&sum);
        self.payload
    }
}

fn read_image(r: &mut CdrReader<'_>) -> Result<Stamp, Damage> {
    r.u32()?;
    r.u32()?;
    r.string()?;
    let (height, width) = (r.u32()?, r.u32()?);
    let encoding = r.string()?;
    r.u8()?;
    let step = r.u32()?;
    let length = r.u32()? as usize;
    let head = r.read();
    let pixels = r.take(length)?;
    let foreign = Damage::Foreign("the image is another");
    let [mark, seq, sent_ns] = std::array::from_fn(|i| pixels.get(8 * i..8 * (i + 1)).unwrap_or_default());
    let (Some(stamp), Some(sum), Some(plain)) = (
        pixels.get(..IMAGE_STAMP_BYTES),
        pixels.get(IMAGE_STAMP_BYTES..IMAGE_PLAIN_FROM),
        pixels.get(IMAGE_PLAIN_FROM..),
    ) else {
        return Err(foreign);
    };
    if mark != IMAGE_MARK {
        return Err(foreign);
    }
    if image_sum(head, stamp, &sha256(plain)) != sum {
        return Err(Damage::Checksum);
    }
    let rows = (height as usize).checked_mul(step as usize);
    if rows != Some(length) || encoding != IMAGE_ENCODING.as_bytes() || width != IMAGE_SIDE {
        return Err(foreign);
    }
    let number = |bytes: &[u8]| bytes.try_into().map(u64::from_le_bytes).map_err(|_| foreign);
    Ok(Stamp { seq: number(seq)?, sent_ns: number(sent_ns)? })
}

/// Computes the checksum of an image. The pixels enter by their digest, which is known before the time is.
fn image_sum(head: &[u8], stamp: &[u8], plain_digest: &[u8; DIGEST_BYTES]) -> [u8; DIGEST_BYTES] {
    let mut context = Context::new(&SHA256);
    for part in [head, stamp, plain_digest] {
        context.update(part);
    }
    let mut out = [0; DIGEST_BYTES];
    out.copy_from_slice(context.finish().as_ref());
    out
}

fn sha256(bytes: &[u8]) -> [u8; DIGEST_BYTES] {
    let mut out = [0; DIGEST_BYTES];
    out.copy_from_slice(digest(&SHA256, bytes).as_ref());
    out
}

fn short_sum(bytes: &[u8]) -> u32 {
    let [a, b, c, d, ..] = sha256(bytes);
    u32::from_be_bytes([a, b, c, d])
}

/// Writes plain CDR: a primitive of `n` bytes begins at a multiple of `n` after the encapsulation.
struct CdrWriter {
    bytes: Vec<u8>,
}

impl CdrWriter {
    fn new() -> Self {
        Self { bytes: ENCAPSULATION.to_vec() }
    }

    fn align(&mut self, to: usize) {
        while !(self.bytes.len() - ENCAPSULATION_BYTES).is_multiple_of(to) {
            self.bytes.push(0);
        }
    }

    fn u8(&mut self, value: u8) {
        self.bytes.push(value);
    }

    fn u32(&mut self, value: u32) {
        self.align(4);
        self.bytes.extend(value.to_le_bytes());
    }

    fn f64(&mut self, value: f64) {
        self.align(8);
        self.bytes.extend(value.to_le_bytes());
    }

    /// Writes a string. Its length includes the terminating zero.
    fn string(&mut self, text: &str) {
        self.u32(text.len() as u32 + 1);
        self.bytes.extend(text.as_bytes());
        self.bytes.push(0);
    }
}

/// Reads what [`CdrWriter`] writes.
struct CdrReader<'a> {
    body: &'a [u8],
    at: usize,
}

impl<'a> CdrReader<'a> {
    fn new(payload: &'a [u8]) -> Result<Self, Damage> {
        // The options may differ, because they hold the padding that is added on the way.
        match payload.split_first_chunk::<ENCAPSULATION_BYTES>() {
            Some(([0, 1, _, _], body)) => Ok(Self { body, at: 0 }),
            Some(_) => Err(Damage::Malformed("it is not plain CDR, little endian")),
            None => Err(Damage::Malformed("it has no encapsulation")),
        }
    }

    fn take(&mut self, count: usize) -> Result<&'a [u8], Damage> {
        let end = self.at.checked_add(count);
        let taken = end.and_then(|end| self.body.get(self.at..end));
        let taken = taken.ok_or(Damage::Malformed("it ends early"))?;
        self.at += count;
        Ok(taken)
    }

    fn primitive<const N: usize>(&mut self) -> Result<[u8; N], Damage> {
        self.take(self.at.wrapping_neg() % N)?;
        self.take(N)?.try_into().map_err(|_| Damage::Malformed("it ends early"))
    }

    fn u8(&mut self) -> Result<u8, Damage> {
        self.primitive().map(u8::from_le_bytes)
    }

    fn u32(&mut self) -> Result<u32, Damage> {
        self.primitive().map(u32::from_le_bytes)
    }

    fn f64(&mut self) -> Result<f64, Damage> {
        self.primitive().map(f64::from_le_bytes)
    }

    fn string(&mut self) -> Result<&'a [u8], Damage> {
        let length = self.u32()? as usize;
        match self.take(length)?.split_last() {
            Some((0, text)) => Ok(text),
            _ => Err(Damage::Malformed("a text does not end with a zero")),
        }
    }

    /// Returns the bytes read so far, without the encapsulation.
    fn read(&self) -> &'a [u8] {
        &self.body[..self.at]
    }

    /// Checks that only padding to a multiple of four is left.
    fn finish(self) -> Result<(), Damage> {
        let rest = &self.body[self.at..];
        if rest.len() < 4 && rest.iter().all(|b| *b == 0) {
            Ok(())
        } else {
            Err(Damage::Malformed("something follows its end"))
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const SENT_NS: u64 = 1_234_567_891_000;
    const UNIX_NS: u64 = 1_753_000_000_000_000_042;

    fn made(topic: Topic, seq: u64) -> Vec<u8> {
        Draft::new(topic, seq).finish(SENT_NS, UNIX_NS).to_vec()
    }

    #[test]
    fn messages_survive_encoding() {
        for topic in Topic::ALL {
            for seq in [0, 1, 42, 1 << 33] {
                assert_eq!(
                    decode(topic, &made(topic, seq)),
                    Ok(Stamp { seq, sent_ns: SENT_NS }),
                    "{topic:?}"
                );
            }
        }
    }

    #[test]
    fn padding_does_not_damage_message() {
        for topic in Topic::ALL {
            let mut payload = made(topic, 7);
            let pad = payload.len().wrapping_neg() % 4;
            payload[3] |= pad as u8;
            payload.resize(payload.len() + pad, 0);
            assert!(decode(topic, &payload).is_ok());
            payload.extend([0; 4]);
            assert_eq!(decode(topic, &payload), Err(Damage::Malformed("something follows its end")));
        }
    }

    /// Alters every byte after the encapsulation except padding between fields.
    #[test]
    fn altered_byte_is_detected() {
        for topic in [Topic::Chatter, Topic::CmdVel] {
            let good = made(topic, 7);
            for at in ENCAPSULATION_BYTES..good.len() {
                for bit in 0..8 {
                    let mut bad = good.clone();
                    bad[at] ^= 1 << bit;
                    assert!(decode(topic, &bad).is_err(), "{topic:?}: bit {bit} of byte {at}");
                }
            }
        }
        let good = made(Topic::Image, 7);
        let ends = (ENCAPSULATION_BYTES..200).chain(good.len() - 100..good.len());
        for at in ends.chain((200..good.len() - 100).step_by(9973)) {
            let mut bad = good.clone();
            bad[at] ^= 0x10;
            assert!(decode(Topic::Image, &bad).is_err(), "byte {at}");
        }
    }

    #[test]
    fn truncation_is_detected() {
        for topic in [Topic::Chatter, Topic::CmdVel] {
            let good = made(topic, 7);
            for end in 0..good.len() {
                assert!(decode(topic, &good[..end]).is_err(), "{topic:?}: {end}");
            }
        }
        let good = made(Topic::Image, 7);
        for end in (0..200).chain([500_000, good.len() - 1]) {
            assert!(decode(Topic::Image, &good[..end]).is_err(), "{end}");
        }
    }

    #[test]
    fn text_has_layout_of_ros() {
        let payload = made(Topic::Chatter, 42);
        let text = String::from_utf8(payload[8..payload.len() - 1].to_vec()).unwrap();
        assert!(text.starts_with("Hello World: 42 [t=1234567891000 sum="), "{text}");
        assert_eq!(payload[4..8], (text.len() as u32 + 1).to_le_bytes());
    }

    #[test]
    fn image_has_layout_of_ros() {
        let payload = made(Topic::Image, 1);
        let expected: Vec<u8> = [
            &ENCAPSULATION[..],
            &1_753_000_000_u32.to_le_bytes(),
            &42_u32.to_le_bytes(),
            &7_u32.to_le_bytes(),
            b"camera\0\0",
            &500_u32.to_le_bytes(),
            &500_u32.to_le_bytes(),
            &6_u32.to_le_bytes(),
            b"rgba8\0",
            &[0, 0],
            &2000_u32.to_le_bytes(),
            &1_000_000_u32.to_le_bytes(),
            b"sgc-demo",
        ]
        .concat();
        assert_eq!(payload[..expected.len()], expected);
        assert_eq!(payload.len(), expected.len() - 8 + 1_000_000);
    }

    #[test]
    fn twist_hardly_moves_robot_sideways() {
        let payload = made(Topic::CmdVel, 1_000_000);
        assert_eq!(payload.len(), ENCAPSULATION_BYTES + 48);
        let values: Vec<f64> = payload[ENCAPSULATION_BYTES..]
            .chunks_exact(8)
            .map(|b| f64::from_le_bytes(b.try_into().unwrap()))
            .collect();
        assert!((0.1..0.2).contains(&values[0]) && values[5].abs() <= 0.1);
        assert!(values[1..5].iter().all(|v| (0.0..0.01).contains(v)), "{values:?}");
    }

    #[test]
    fn foreign_messages_are_recognised() {
        let mut w = CdrWriter::new();
        w.string("Hello World: 1");
        assert_eq!(decode(Topic::Chatter, &w.bytes), Err(Damage::Foreign("its text is another")));
        assert!(matches!(decode(Topic::Image, &made(Topic::Chatter, 1)), Err(Damage::Malformed(_))));
    }
}
