//! The values of the store. They come from outside, so nothing about them is believed.

use bytes::Bytes;
use sgc_wire::{Decode, DecodeError, Encode, Name, NodeId, Reader, SignedBody, Writer};

use super::op::{BATCH_TAG_LEN, BatchTag, StoreKey};

/// Longest value that is read or written, bytes: more than any advertisement or link state of a node that is no router.
pub const STORE_VALUE_BYTES_MAX: usize = 64 * 1024;

/// The value of [`StoreKey::Name`]: the batch of an owner that has the name.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) struct NameEntry {
    pub(crate) owner: NodeId,
    pub(crate) tag: BatchTag,
}

impl NameEntry {
    /// Returns the key of the batch.
    pub(crate) fn batch(&self) -> StoreKey {
        StoreKey::Batch { owner: self.owner, tag: self.tag }
    }
}

impl Encode for NameEntry {
    fn encode(&self, w: &mut Writer) {
        self.owner.encode(w);
        w.raw(&self.tag.0);
    }
}

impl Decode for NameEntry {
    fn decode(r: &mut Reader<'_>) -> Result<Self, DecodeError> {
        let owner = NodeId::decode(r)?;
        let tag = BatchTag(r.array::<BATCH_TAG_LEN>("batch")?);
        Ok(Self { owner, tag })
    }
}

/// Returns the tag of a batch with these names.
pub(crate) fn batch_tag(names: &[Name]) -> BatchTag {
    let mut names = names.to_vec();
    names.sort_unstable();
    let digest = sgc_trust::names_digest(&names);
    let mut tag = [0; BATCH_TAG_LEN];
    tag.copy_from_slice(&digest[..BATCH_TAG_LEN]);
    BatchTag(tag)
}

/// Returns the value for a signed body.
pub(crate) fn encode_signed(signed: &SignedBody) -> Bytes {
    signed.to_bytes()
}

/// Reads the value of a signed body.
pub(crate) fn decode_signed(value: &[u8]) -> Result<SignedBody, DecodeError> {
    SignedBody::from_slice(value)
}
