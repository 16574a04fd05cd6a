//! The head of a message under the seal: its kind, and its time of publication.

use crate::codec::{Decode, DecodeError, Encode, Reader, Writer};

/// Length of an encoded [`MessageHead`], bytes.
pub const MESSAGE_HEAD_BYTES: usize = 12;

/// Effect of a message on its instance (DDS 1.4, 2.2.2.4.2), or its part in a call.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum MessageKind {
    /// Data.
    Write,
    /// The instance is disposed of; the payload holds its key.
    Dispose,
    /// The writer no longer updates the instance; the payload holds its key.
    Unregister,
    /// No message: the requested history has been sent. Sequence number 0, always the same bytes.
    Synced,
    /// No message, but numbered as one: tells the last number, and the oldest message that can still be asked for. Its
    /// payload is the number of that message, 8 bytes.
    Mark,
    /// A call of a service: the request.
    Request,
    /// The reply of a call.
    Reply,
    /// Asks for the state of a call; without payload, as all that follow.
    Ask,
    /// The caller has finished the call.
    Forget,
    /// The owner has never heard of the call.
    Unknown,
    /// The call will not be answered any more.
    Gone,
}

/// Length of the hash of a key, bytes (RTPS 2.5, 9.6.4.8).
pub const KEY_HASH_BYTES: usize = 16;

/// Format of a message, before it is compressed.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub enum PayloadForm {
    /// The format of the local network: CDR with its encapsulation header.
    #[default]
    Cdr,
    /// JSON (docs/spec/json.md).
    Json,
    /// The hash of the sample's key ([`KEY_HASH_BYTES`]), and CDR as above.
    KeyedCdr,
}

/// Compression of a payload, before it is sealed.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub enum PayloadEncoding {
    /// None.
    #[default]
    Plain,
    /// Its length (4 bytes, big-endian), and a frame of Zstandard (RFC 8878).
    Zstd,
    /// Its length (4 bytes, big-endian), and a block of LZ4.
    Lz4,
}

/// Time stamp of a mark that asks for a confirmation.
const CONFIRM: i64 = 1;

/// Travels sealed, behind the first fragment of each message.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct MessageHead {
    /// Data, or the end of an instance.
    pub kind: MessageKind,
    /// Compression of the payload.
    pub encoding: PayloadEncoding,
    /// Format of the payload.
    pub form: PayloadForm,
    /// Source time stamp, nanoseconds since the Unix epoch. For the kinds from [`MessageKind::Request`] on, the number
    /// of the call at its source.
    pub source_timestamp_ns: i64,
}

impl MessageHead {
    /// Returns the head of a message in CDR that is not compressed.
    pub const fn new(kind: MessageKind, source_timestamp_ns: i64) -> Self {
        Self { kind, encoding: PayloadEncoding::Plain, form: PayloadForm::Cdr, source_timestamp_ns }
    }

    /// Returns the head of a message about a call.
    pub fn for_call(kind: MessageKind, number: u64) -> Self {
        Self::new(kind, number as i64)
    }

    /// Returns the head of a mark by which a node reports that this local publisher asserted its liveliness.
    pub const fn for_assertion(publisher: [u8; 8]) -> Self {
        Self::new(MessageKind::Mark, i64::from_be_bytes(publisher))
    }

    /// Returns the beginning of the source ids of the publisher that asserted its liveliness, if this is such a mark.
    pub fn asserted(&self) -> Option<[u8; 8]> {
        let says_so = self.kind == MessageKind::Mark && self.source_timestamp_ns != 0;
        says_so.then(|| self.source_timestamp_ns.to_be_bytes())
    }

    /// Returns the head of a mark that asks all sinks of its source to confirm that they have all numbers up to it.
    pub const fn for_confirmation() -> Self {
        Self::new(MessageKind::Mark, CONFIRM)
    }

    /// Returns `true` for a mark that asks for a confirmation, if its source recovers: others assert a liveliness.
    pub fn asks_for_confirmation(&self) -> bool {
        self.kind == MessageKind::Mark && self.source_timestamp_ns == CONFIRM
    }

    /// Returns the encoding.
    pub fn to_array(self) -> [u8; MESSAGE_HEAD_BYTES] {
        let mut out = [0; MESSAGE_HEAD_BYTES];
        out[0] = self.kind as u8;
        out[1] = self.encoding as u8;
        out[2] = self.form as u8;
        out[4..].copy_from_slice(&self.source_timestamp_ns.to_be_bytes());
        out
    }

    /// Returns the number of the call.
    pub fn call(&self) -> u64 {
        self.source_timestamp_ns as u64
    }
}

impl Encode for MessageHead {
    fn encode(&self, w: &mut Writer) {
        w.raw(&self.to_array());
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
            5 => MessageKind::Request,
            6 => MessageKind::Reply,
            7 => MessageKind::Ask,
            8 => MessageKind::Forget,
            9 => MessageKind::Unknown,
            10 => MessageKind::Gone,
            v => return Err(DecodeError::value("message kind", v.into())),
        };
        let encoding = match (r.u8()?, kind) {
            (0, _) => PayloadEncoding::Plain,
            // Keys and marks are small.
            (1, MessageKind::Write) => PayloadEncoding::Zstd,
            (2, MessageKind::Write) => PayloadEncoding::Lz4,
            (v, _) => return Err(DecodeError::value("payload encoding", v.into())),
        };
        let form = match (r.u8()?, kind) {
            (0, _) => PayloadForm::Cdr,
            // Keys and marks are no messages.
            (1, MessageKind::Write) => PayloadForm::Json,
            (2, MessageKind::Write | MessageKind::Dispose | MessageKind::Unregister) => PayloadForm::KeyedCdr,
            (v, _) => return Err(DecodeError::value("payload form", v.into())),
        };
        match r.u8()? {
            0 => Ok(Self { kind, encoding, form, source_timestamp_ns: r.u64()? as i64 }),
            reserved => Err(DecodeError::value("reserved", reserved.into())),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn head_has_its_fixed_length_and_round_trips() {
        for (kind, encoding, form) in [
            (MessageKind::Dispose, PayloadEncoding::Plain, PayloadForm::Cdr),
            (MessageKind::Write, PayloadEncoding::Zstd, PayloadForm::Cdr),
            (MessageKind::Write, PayloadEncoding::Plain, PayloadForm::Json),
            (MessageKind::Write, PayloadEncoding::Lz4, PayloadForm::KeyedCdr),
            (MessageKind::Dispose, PayloadEncoding::Plain, PayloadForm::KeyedCdr),
            (MessageKind::Write, PayloadEncoding::Lz4, PayloadForm::Json),
        ] {
            let head = MessageHead { kind, encoding, form, source_timestamp_ns: -5 };
            let bytes = head.to_vec();
            assert_eq!(bytes.len(), MESSAGE_HEAD_BYTES);
            assert_eq!(MessageHead::from_slice(&bytes), Ok(head));
        }
    }

    #[test]
    fn only_messages_with_data_are_compressed_or_json() {
        let decode = |kind: u8, encoding: u8, form: u8| {
            MessageHead::from_slice(&[kind, encoding, form, 0, 0, 0, 0, 0, 0, 0, 0, 0])
        };
        for kind in 1..=10 {
            assert!(decode(kind, 0, 0).is_ok() && decode(kind, 1, 0).is_err() && decode(kind, 2, 0).is_err());
            assert!(decode(kind, 0, 1).is_err());
            assert_eq!(decode(kind, 0, 2).is_ok(), kind <= 2, "keys are of data and of the end of instances");
        }
        assert!(decode(0, 2, 0).is_ok() && decode(0, 3, 0).is_err());
        assert!(decode(0, 2, 1).is_ok() && decode(0, 0, 2).is_ok() && decode(0, 0, 3).is_err());
    }

    #[test]
    fn mark_with_a_time_stamp_names_the_publisher_that_asserted_its_liveliness() {
        let publisher = [0xff, 2, 3, 4, 5, 6, 7, 8];
        let bytes = MessageHead::for_assertion(publisher).to_vec();
        assert_eq!(bytes, [&[4, 0, 0, 0][..], &publisher].concat());
        assert_eq!(MessageHead::from_slice(&bytes).unwrap().asserted(), Some(publisher));
        assert_eq!(MessageHead::new(MessageKind::Mark, 0).asserted(), None);
        assert_eq!(MessageHead::new(MessageKind::Write, 7).asserted(), None);
    }

    #[test]
    fn mark_with_time_stamp_1_asks_for_a_confirmation() {
        let bytes = MessageHead::for_confirmation().to_vec();
        assert_eq!(bytes, [4, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 1]);
        assert!(MessageHead::from_slice(&bytes).unwrap().asks_for_confirmation());
        assert!(!MessageHead::new(MessageKind::Mark, 0).asks_for_confirmation());
        assert!(!MessageHead::new(MessageKind::Write, 1).asks_for_confirmation());
    }

    /// The bytes are normative.
    #[test]
    fn every_kind_has_its_number() {
        for kind in 0..=10_u8 {
            let bytes = [kind, 0, 0, 0, 0xff, 0, 0, 0, 0, 0, 0, 9];
            let head = MessageHead::from_slice(&bytes).unwrap();
            assert_eq!((head.kind as u8, head.call()), (kind, 0xff00_0000_0000_0009));
            assert_eq!((head, head.to_vec()), (MessageHead::for_call(head.kind, head.call()), bytes.into()));
        }
        assert!(MessageHead::from_slice(&[11; 12]).is_err());
    }
}
