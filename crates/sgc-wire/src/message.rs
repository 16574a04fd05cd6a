//! What accompanies a message under the seal: what it is, and when it was published.

use crate::codec::{Decode, DecodeError, Encode, Reader, Writer};

/// Length of an encoded [`MessageHead`], bytes.
pub const MESSAGE_HEAD_BYTES: usize = 12;

/// What a message does to its instance (DDS 1.4, 2.2.2.4.2).
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum MessageKind {
    /// Data.
    Write,
    /// The instance is disposed of; the payload holds its key.
    Dispose,
    /// The writer no longer updates the instance; the payload holds its key.
    Unregister,
    /// No message: the history that a sink asked for has been sent. Sequence number 0, always the same bytes.
    Synced,
    /// No message, but numbered as one: what was published until here, and what can still be asked for. Its payload is the
    /// number of the oldest such message, 8 bytes.
    Mark,
}

/// Travels sealed, behind the first fragment of each message.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct MessageHead {
    /// Data, or the end of an instance.
    pub kind: MessageKind,
    /// Source time stamp, nanoseconds since the Unix epoch.
    pub source_timestamp_ns: i64,
}

impl Encode for MessageHead {
    fn encode(&self, w: &mut Writer) {
        w.u8(self.kind as u8);
        w.u8(0); // payload encoding: CDR with its encapsulation header
        w.u16(0);
        w.u64(self.source_timestamp_ns as u64);
    }
}

impl Decode for MessageHead {
    fn decode(r: &mut Reader<'_>) -> Result<Self, DecodeError> {
        let kind = match r.u8()? {
            0 => MessageKind::Write,
            1 => MessageKind::Dispose,
            2 => MessageKind::Unregister,
            3 => MessageKind::Synced,
            4 => MessageKind::Mark,
            v => return Err(DecodeError::value("message kind", v.into())),
        };
        match (r.u8()?, r.u16()?) {
            (0, 0) => Ok(Self { kind, source_timestamp_ns: r.u64()? as i64 }),
            (encoding, 0) => Err(DecodeError::value("payload encoding", encoding.into())),
            (_, reserved) => Err(DecodeError::value("reserved", reserved.into())),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn head_has_its_fixed_length_and_round_trips() {
        let head = MessageHead { kind: MessageKind::Dispose, source_timestamp_ns: -5 };
        let bytes = head.to_vec();
        assert_eq!(bytes.len(), MESSAGE_HEAD_BYTES);
        assert_eq!(MessageHead::from_slice(&bytes), Ok(head));
    }
}
