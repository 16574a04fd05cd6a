//! Keys as bytes, and the slots of a cluster that they belong to.

use sgc_router::{BATCH_TAG_LEN, BatchTag, StoreKey};
use sgc_wire::{Name, NodeId};

use crate::config::StorePrefix;

/// Slots of a cluster.
pub(crate) const SLOTS: usize = 16_384;

const ID_LEN: usize = 32;

/// Writes and reads the keys of one prefix.
#[derive(Clone, Debug)]
pub(crate) struct Keys {
    /// The prefix with the colon behind it.
    prefix: Vec<u8>,
}

impl Keys {
    pub(crate) fn new(prefix: &StorePrefix) -> Self {
        Self { prefix: format!("{prefix}:").into_bytes() }
    }

    /// Returns the bytes of a key.
    pub(crate) fn encode(&self, key: &StoreKey) -> Vec<u8> {
        let parts: [&[u8]; 3] = match key {
            StoreKey::Name(name) => [b"n:", &name.0, b""],
            StoreKey::Batch { owner, tag } => [b"b:", &owner.0, &tag.0],
            StoreKey::Node(node) => [b"l:", &node.0, b""],
        };
        [&self.prefix, parts[0], parts[1], parts[2]].concat()
    }

    /// Returns the key that bytes mean, or `None` if they are of other programs or another fleet.
    pub(crate) fn decode(&self, bytes: &[u8]) -> Option<StoreKey> {
        let (kind, id) = bytes.strip_prefix(self.prefix.as_slice())?.split_at_checked(2)?;
        match kind {
            b"n:" => Some(StoreKey::Name(Name(id.try_into().ok()?))),
            b"b:" => {
                let (owner, tag) = id.split_at_checked(ID_LEN)?;
                let tag: [u8; BATCH_TAG_LEN] = tag.try_into().ok()?;
                Some(StoreKey::Batch { owner: NodeId(owner.try_into().ok()?), tag: BatchTag(tag) })
            }
            b"l:" => Some(StoreKey::Node(NodeId(id.try_into().ok()?))),
            _ => None,
        }
    }
}

/// Returns the slot of a key: CRC-16/XMODEM modulo the number of slots, over the part in braces, if there is one
/// ([cluster specification](https://valkey.io/topics/cluster-spec/#key-distribution-model)).
pub(crate) fn slot(key: &[u8]) -> u16 {
    let tag = key.iter().position(|byte| *byte == b'{').and_then(|open| {
        let rest = &key[open + 1..];
        let length = rest.iter().position(|byte| *byte == b'}').filter(|length| *length > 0)?;
        Some(&rest[..length])
    });
    crc16(tag.unwrap_or(key)) % SLOTS as u16
}

fn crc16(bytes: &[u8]) -> u16 {
    bytes.iter().fold(0, |crc, byte| {
        (0..8).fold(
            crc ^ u16::from(*byte) << 8,
            |crc, _| {
                if crc & 0x8000 == 0 { crc << 1 } else { crc << 1 ^ 0x1021 }
            },
        )
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn keys_keep_their_meaning() {
        let keys = Keys::new(&StorePrefix::new("fleet-a").unwrap());
        for (key, start, length) in [
            (StoreKey::Name(Name([7; 32])), b"fleet-a:n:", 42),
            (StoreKey::Batch { owner: NodeId([8; 32]), tag: BatchTag([9; 12]) }, b"fleet-a:b:", 54),
            (StoreKey::Node(NodeId([6; 32])), b"fleet-a:l:", 42),
        ] {
            let bytes = keys.encode(&key);
            assert!(bytes.starts_with(start));
            assert_eq!(bytes.len(), length);
            assert_eq!(keys.decode(&bytes), Some(key));
        }
    }

    #[test]
    fn foreign_keys_mean_nothing() {
        let keys = Keys::new(&StorePrefix::new("a").unwrap());
        for foreign in [
            b"".as_slice(),
            b"a",
            b"a:",
            b"a:n",
            b"a:n:short",
            &[b"a:n:".as_slice(), &[0; 33]].concat(),
            &[b"a:b:".as_slice(), &[0; 32]].concat(),
            &[b"a:x:".as_slice(), &[0; 32]].concat(),
            &[b"ab:n:".as_slice(), &[0; 32]].concat(),
        ] {
            assert_eq!(keys.decode(foreign), None, "{foreign:?}");
        }
    }

    /// Values of the cluster specification, and of `CLUSTER KEYSLOT`.
    #[test]
    fn slots_are_those_of_the_cluster_specification() {
        assert_eq!(crc16(b"123456789"), 0x31c3);
        assert_eq!(slot(b"foo"), 12_182);
        assert_eq!(slot(b"{user1000}.following"), slot(b"user1000"));
        assert_eq!(slot(b"foo{}{bar}"), crc16(b"foo{}{bar}") % SLOTS as u16);
        assert_eq!(slot(b"foo{{bar}}zap"), slot(b"{bar"));
        assert_eq!(slot(b"a}b{c"), crc16(b"a}b{c") % SLOTS as u16);
    }
}
