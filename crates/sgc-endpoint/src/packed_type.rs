//! Descriptions of types as they travel: packed, because they are long and repetitive. The reader checks that a
//! description matches its type.

use bytes::Bytes;
use sgc_wire::{DescribedType, Name, PayloadEncoding, TYPE_DESCRIPTION_BYTES_MAX, TYPE_HASH_BYTES_MAX};

use crate::compression::{CompressionError, pack, unpack};

/// The description of a type as it travels.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct PackedType {
    /// `RIHS01_…` hash of the described type.
    type_hash: String,
    encoding: PayloadEncoding,
    bytes: Bytes,
}

impl PackedType {
    /// Packs a description. Returns `None` if it, or the hash, is too long.
    pub fn new(type_hash: &str, description: &Bytes) -> Option<Self> {
        if description.len() > TYPE_DESCRIPTION_BYTES_MAX || type_hash.len() > TYPE_HASH_BYTES_MAX {
            return None;
        }
        let (encoding, bytes) = pack(description);
        Some(Self { type_hash: type_hash.to_owned(), encoding, bytes })
    }

    pub(crate) fn describe(&self, name: Name) -> DescribedType {
        let (encoding, description) = (self.encoding, self.bytes.clone());
        DescribedType { name, type_hash: self.type_hash.clone(), encoding, description }
    }
}

/// Unpacks a received description. It takes no more memory than a description may have.
pub fn unpack_type(described: &DescribedType) -> Result<Bytes, CompressionError> {
    unpack(described.encoding, &described.description, TYPE_DESCRIPTION_BYTES_MAX)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::compression::Compressor;

    fn described(encoding: PayloadEncoding, description: impl Into<Bytes>) -> DescribedType {
        DescribedType {
            name: Name([1; 32]),
            type_hash: "RIHS01_00".into(),
            encoding,
            description: description.into(),
        }
    }

    #[test]
    fn a_description_comes_back_whether_it_shrinks_or_not() {
        for bytes in [Bytes::from_static(b"short"), vec![7; TYPE_DESCRIPTION_BYTES_MAX].into()] {
            let packed = PackedType::new("RIHS01_00", &bytes).unwrap();
            assert_eq!(unpack_type(&packed.describe(Name([1; 32]))), Ok(bytes));
        }
        let long = Bytes::from(vec![0; TYPE_DESCRIPTION_BYTES_MAX + 1]);
        assert_eq!(PackedType::new("RIHS01_00", &long), None);
        assert_eq!(PackedType::new(&"x".repeat(TYPE_HASH_BYTES_MAX + 1), &Bytes::new()), None);
    }

    #[test]
    fn a_bomb_is_refused_by_what_it_claims() {
        let bomb = Compressor::default().compress(PayloadEncoding::Zstd, &vec![0; 8 << 20]).unwrap();
        let refused = unpack_type(&described(PayloadEncoding::Zstd, bomb.clone()));
        assert_eq!(refused, Err(CompressionError::TooLong(8 << 20)));
        let mut lies = bomb.to_vec();
        lies[..4].copy_from_slice(&1000_u32.to_be_bytes());
        assert_eq!(unpack_type(&described(PayloadEncoding::Zstd, lies)), Err(CompressionError::Malformed));
        let cut = unpack_type(&described(PayloadEncoding::Zstd, &b"abc"[..]));
        assert_eq!(cut, Err(CompressionError::Malformed));
    }
}
