//! Types over the wire: a question for the types of interfaces, and their descriptions.
//!
//! Descriptions are bytes here, compressed or not. `sgc-cdr` reads them, and checks that each is of the type that it
//! claims.

use bytes::Bytes;

use crate::codec::{Decode, DecodeError, Encode, Reader, Writer};
use crate::ids::Name;
use crate::message::PayloadEncoding;

/// Most interfaces in one question, and types in one answer: as many names as a question has room for.
pub const TYPES_PER_QUESTION_MAX: usize = 127;
/// Longest description of a type, bytes, before it is compressed.
pub const TYPE_DESCRIPTION_BYTES_MAX: usize = 256 * 1024;
/// Longest hash of a type, bytes.
pub const TYPE_HASH_BYTES_MAX: usize = 128;

/// A question at the name of an owner's types.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct TypeQuestion {
    /// Its interfaces whose types are requested.
    pub names: Vec<Name>,
}

/// A type, as an owner describes it.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct DescribedType {
    /// The interface whose type it is.
    pub name: Name,
    /// `RIHS01_…` hash of the described type.
    pub type_hash: String,
    /// Compression of the description: none, or Zstandard.
    pub encoding: PayloadEncoding,
    /// A serialised `type_description_interfaces/msg/TypeDescription` (REP 2016).
    pub description: Bytes,
}

impl Encode for TypeQuestion {
    fn encode(&self, w: &mut Writer) {
        w.list(&self.names, |w, name| name.encode(w));
    }
}

impl Decode for TypeQuestion {
    fn decode(r: &mut Reader<'_>) -> Result<Self, DecodeError> {
        Ok(Self { names: r.list("names", TYPES_PER_QUESTION_MAX, Name::decode)? })
    }
}

impl Encode for DescribedType {
    fn encode(&self, w: &mut Writer) {
        self.name.encode(w);
        w.str(&self.type_hash);
        w.u8(self.encoding as u8);
        w.bytes(&self.description);
    }
}

impl Decode for DescribedType {
    fn decode(r: &mut Reader<'_>) -> Result<Self, DecodeError> {
        Ok(Self {
            name: Name::decode(r)?,
            type_hash: r.str("type hash", TYPE_HASH_BYTES_MAX)?,
            encoding: match r.u8()? {
                0 => PayloadEncoding::Plain,
                1 => PayloadEncoding::Zstd,
                v => return Err(DecodeError::value("encoding of a description", v.into())),
            },
            description: r
                .bytes("type description", TYPE_DESCRIPTION_BYTES_MAX)
                .map(Bytes::copy_from_slice)?,
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::control::ASK_BYTES_MAX;

    /// The bytes are normative.
    #[test]
    fn questions_and_types_have_these_bytes() {
        let question = TypeQuestion { names: vec![Name([7; 32])] };
        assert_eq!(question.to_vec(), [&[0, 0, 0, 1][..], &[7; 32]].concat());
        assert_eq!(TypeQuestion::from_slice(&question.to_vec()), Ok(question));
        let described = DescribedType {
            name: Name([7; 32]),
            type_hash: "RIHS01_ab".into(),
            encoding: PayloadEncoding::Zstd,
            description: Bytes::from_static(b"xy"),
        };
        let bytes = [&[7; 32][..], &[0, 0, 0, 9], b"RIHS01_ab", &[1, 0, 0, 0, 2], b"xy"].concat();
        assert_eq!(described.to_vec(), bytes);
        assert_eq!(DescribedType::from_slice(&bytes), Ok(described));
    }

    #[test]
    fn the_longest_question_has_room_and_a_longer_one_is_refused() {
        let names = vec![Name([1; 32]); TYPES_PER_QUESTION_MAX + 1];
        let longest = TypeQuestion { names: names[1..].to_vec() }.to_vec();
        assert!(longest.len() <= ASK_BYTES_MAX && TypeQuestion::from_slice(&longest).is_ok());
        let refused = TypeQuestion::from_slice(&TypeQuestion { names }.to_vec());
        assert!(matches!(refused, Err(DecodeError::TooLong { field: "names", .. })), "{refused:?}");
    }

    #[test]
    fn no_other_compression_is_taken() {
        let mut bytes = [&[7; 32][..], &[0, 0, 0, 0], &[2, 0, 0, 0, 0]].concat();
        assert!(DescribedType::from_slice(&bytes).is_err());
        bytes[36] = 0;
        assert!(DescribedType::from_slice(&bytes).is_ok());
    }
}
