//! Readers of local topics.

use crate::network::{EndpointSpec, Guid};

/// Returns `true` if the reader of a topic asks writers for key hashes. It must not if a writer would then not match.
pub(super) fn asks_key_hash<'a>(keyless: bool, mut writers: impl Iterator<Item = &'a Guid>) -> bool {
    !keyless && !writers.any(Guid::is_of_cyclone)
}

/// Returns `true` if two readers differ at most in depth, for which a reader is not recreated.
pub(super) fn same_reader(a: Option<&EndpointSpec>, b: Option<&EndpointSpec>) -> bool {
    let key = |s: &EndpointSpec| {
        (
            (s.qos.reliability, s.qos.durability, s.qos.partitions.clone()),
            (s.keyless, s.asks_key_hash, s.type_name.clone()),
        )
    };
    a.map(key) == b.map(key)
}
