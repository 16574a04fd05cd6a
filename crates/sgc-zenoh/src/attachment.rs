//! Attachments: number, time and sender of each message, request and reply.
//!
//! Sources: rmw_zenoh `attachment_helpers.cpp`@534747dc, and @038b5a4f for the form before. The bytes are those of
//! zenoh-ext's serializer: integers little endian, arrays with their length as LEB128 in front.

use crate::error::CodecError;
use crate::gid::Gid;

/// Length of an attachment, bytes.
pub const ATTACHMENT_BYTES: usize = 33;

/// Length of an id, bytes.
const GID_BYTES: u8 = 16;
/// The first text of the form with keys: its length and `sequence_number`.
const OLD_START: &[u8] = b"\x0fsequence_number";

/// The attachment of a sample, request or reply.
///
/// Any numbers are read. rmw_zenoh's clients refuse a reply with a negative one (`rmw_client_data.cpp`@03470ce8,
/// `take_response`); its numbers start at 1.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Attachment {
    /// The number of the message among those of its publisher or client. A reply has that of its request.
    pub sequence: i64,
    /// The time at which it was sent, nanoseconds since the Unix epoch.
    pub source_timestamp_ns: i64,
    /// The publisher or client. A reply has the client of its request.
    pub gid: Gid,
}

impl Attachment {
    /// Returns the bytes.
    pub fn encode(&self) -> [u8; ATTACHMENT_BYTES] {
        let mut bytes = [0; ATTACHMENT_BYTES];
        bytes[..8].copy_from_slice(&self.sequence.to_le_bytes());
        bytes[8..16].copy_from_slice(&self.source_timestamp_ns.to_le_bytes());
        bytes[16] = GID_BYTES;
        bytes[17..].copy_from_slice(&self.gid.0);
        bytes
    }

    /// Reads an attachment. Its length decides about the form, because the first byte of a number may be any.
    ///
    /// # Errors
    /// [`CodecError::OldAttachment`], [`CodecError::AttachmentLength`], [`CodecError::GidLength`].
    pub fn decode(bytes: &[u8]) -> Result<Self, CodecError> {
        let (sequence, source_timestamp_ns, gid_bytes, gid) = fields(bytes).ok_or_else(|| {
            if bytes.starts_with(OLD_START) {
                CodecError::OldAttachment
            } else {
                CodecError::AttachmentLength { bytes: bytes.len() }
            }
        })?;
        if gid_bytes != GID_BYTES {
            return Err(CodecError::GidLength { bytes: gid_bytes });
        }
        Ok(Self { sequence, source_timestamp_ns, gid: Gid(gid) })
    }
}

/// Returns number, time, stated length of the id, and the id. Returns `None` for another length than
/// [`ATTACHMENT_BYTES`].
fn fields(bytes: &[u8]) -> Option<(i64, i64, u8, [u8; 16])> {
    let (sequence, rest) = bytes.split_first_chunk()?;
    let (source_timestamp_ns, rest) = rest.split_first_chunk()?;
    let (gid_bytes, gid) = rest.split_first()?;
    Some((
        i64::from_le_bytes(*sequence),
        i64::from_le_bytes(*source_timestamp_ns),
        *gid_bytes,
        gid.try_into().ok()?,
    ))
}

#[cfg(test)]
mod tests {
    use sgc_testkit::Dice;

    use super::*;

    fn attachment() -> Attachment {
        let gid = 0x936d_9a80_a8f5_0fa4_8d7c_c63d_bf60_6fb3_u128.to_be_bytes();
        Attachment { sequence: 1, source_timestamp_ns: 1_700_000_000_123_456_789, gid: Gid(gid) }
    }

    /// The bytes of zenoh-ext's serializer for (int64, int64, 16 bytes).
    #[test]
    fn attachments_have_these_bytes() {
        let bytes = attachment().encode();
        let digits: String = bytes.iter().map(|byte| format!("{byte:02x}")).collect();
        assert_eq!(digits, "010000000000000015cd853dfe9c971710936d9a80a8f50fa48d7cc63dbf606fb3");
        assert_eq!(Attachment::decode(&bytes), Ok(attachment()));
    }

    #[test]
    fn numbers_that_begin_as_the_old_form_does_are_read() {
        let attachment = Attachment { sequence: i64::from_le_bytes(*b"\x0fsequenc"), ..attachment() };
        assert_eq!(Attachment::decode(&attachment.encode()), Ok(attachment));
        let extremes = Attachment { sequence: i64::MIN, source_timestamp_ns: -1, ..attachment };
        assert_eq!(Attachment::decode(&extremes.encode()), Ok(extremes));
    }

    #[test]
    fn the_form_with_keys_is_too_old() {
        let parts: [&[u8]; 6] = [
            b"\x0fsequence_number",
            &[1; 8],
            b"\x10source_timestamp",
            &[2; 8],
            b"\x0asource_gid\x10",
            &[3; 16],
        ];
        let old = parts.concat();
        assert_eq!(old.len(), 77);
        assert_eq!(Attachment::decode(&old), Err(CodecError::OldAttachment));
        assert_eq!(Attachment::decode(&old[..40]), Err(CodecError::OldAttachment));
    }

    #[test]
    fn other_lengths_are_refused() {
        let whole = attachment().encode();
        for bytes in 0..ATTACHMENT_BYTES {
            let refusal = Err(CodecError::AttachmentLength { bytes });
            assert_eq!(Attachment::decode(&whole[..bytes]), refusal);
        }
        let longer = [whole.as_slice(), &[0]].concat();
        assert_eq!(Attachment::decode(&longer), Err(CodecError::AttachmentLength { bytes: 34 }));
        for bytes in [0, 15, 17, 0x90] {
            let mut other = whole;
            other[16] = bytes;
            assert_eq!(Attachment::decode(&other), Err(CodecError::GidLength { bytes }));
        }
    }

    #[test]
    fn random_attachments_round_trip() {
        let mut dice = Dice::new(1);
        for _ in 0..1000 {
            let [sequence, source_timestamp_ns] = [dice.number() as i64, dice.number() as i64];
            let mut gid = [0; 16];
            gid.fill_with(|| dice.number() as u8);
            let attachment = Attachment { sequence, source_timestamp_ns, gid: Gid(gid) };
            assert_eq!(Attachment::decode(&attachment.encode()), Ok(attachment));
        }
    }

    #[test]
    fn random_bytes_are_read_or_refused() {
        let mut dice = Dice::new(2);
        for _ in 0..10_000 {
            let mut bytes = vec![0; dice.within(0..=80)];
            bytes.fill_with(|| dice.number() as u8);
            if let Some(length) = bytes.get_mut(16).filter(|_| dice.chance(50)) {
                *length = GID_BYTES;
            }
            if let Ok(attachment) = Attachment::decode(&bytes) {
                assert_eq!(attachment.encode().as_slice(), bytes);
            }
        }
    }
}
