//! The types known in this process, by name and hash: bounded in number and in bytes of descriptions.
//!
//! A full store takes nothing more in until its user removes unused types: a received type never displaces one that is
//! being decoded with.

use std::collections::BTreeMap;
use std::sync::{Arc, Mutex, MutexGuard};

use sgc_cdr::{Layout, TypeName};
use sgc_sync::lock;

use crate::ResolvedType;

/// Most types that are kept.
pub const TYPES_MAX: usize = 1024;
/// Most bytes of descriptions that are kept. The layouts take a few times as much.
pub const TYPES_BYTES_MAX: usize = 8 << 20;
/// Most types that are kept for the interfaces of one owner, so that no owner takes all the room.
pub const TYPES_PER_OWNER_MAX: usize = TYPES_MAX / 2;
/// Most bytes of their descriptions.
pub const TYPES_PER_OWNER_BYTES_MAX: usize = TYPES_BYTES_MAX / 2;

/// The known types. Shared: all of its calls are short.
#[derive(Debug)]
pub struct TypeStore {
    types_max: usize,
    bytes_max: usize,
    kept: Mutex<StoreState>,
}

#[derive(Debug, Default)]
struct StoreState {
    types: BTreeMap<(TypeName, String), Entry>,
    bytes: usize,
    taken_in: u64,
}

#[derive(Debug)]
struct Entry {
    described: Arc<ResolvedType>,
    /// Grows with each type taken in.
    at: u64,
}

/// No room is left for another type.
#[derive(Clone, Copy, Debug, PartialEq, Eq, thiserror::Error)]
#[error("{types} types with {bytes} bytes of descriptions are known already: there is no room for another")]
pub struct StoreFull {
    /// Types that are kept.
    pub types: usize,
    /// Bytes of their descriptions.
    pub bytes: usize,
}

impl Default for TypeStore {
    fn default() -> Self {
        Self::with_limits(TYPES_MAX, TYPES_BYTES_MAX)
    }
}

impl TypeStore {
    /// Returns a store of at most this many types, and bytes of descriptions.
    pub fn with_limits(types_max: usize, bytes_max: usize) -> Self {
        Self { types_max, bytes_max, kept: Mutex::default() }
    }

    /// Returns whether there is room for a type.
    pub fn has_room_for(&self, described: &ResolvedType) -> bool {
        let kept = self.lock();
        let key = (described.name().clone(), described.type_hash().to_owned());
        let bytes = kept.bytes + described.description().len();
        kept.types.contains_key(&key) || kept.types.len() < self.types_max && bytes <= self.bytes_max
    }

    /// Takes a type in; a known one stays as it is.
    pub fn insert(&self, described: ResolvedType) -> Result<Arc<ResolvedType>, StoreFull> {
        let mut kept = self.lock();
        let key = (described.name().clone(), described.type_hash().to_owned());
        if let Some(known) = kept.types.get(&key) {
            return Ok(known.described.clone());
        }
        let bytes = kept.bytes + described.description().len();
        if kept.types.len() >= self.types_max || bytes > self.bytes_max {
            return Err(StoreFull { types: kept.types.len(), bytes: kept.bytes });
        }
        kept.bytes = bytes;
        kept.taken_in += 1;
        let (at, described) = (kept.taken_in, Arc::new(described));
        kept.types.insert(key, Entry { described: described.clone(), at });
        Ok(described)
    }

    /// Forgets the types, by name and hash, that are not in use.
    pub fn retain(&self, mut is_used: impl FnMut(&TypeName, &str) -> bool) {
        let mut kept = self.lock();
        kept.types.retain(|(name, type_hash), _| is_used(name, type_hash));
        kept.bytes = kept.types.values().map(|entry| entry.described.description().len()).sum();
    }

    /// Returns a type with its description; without a hash, the newest one with this name.
    pub fn described(&self, name: &TypeName, type_hash: Option<&str>) -> Option<Arc<ResolvedType>> {
        let kept = self.lock();
        let named = || {
            let named = kept.types.range((name.clone(), String::new())..).take_while(|((n, _), _)| n == name);
            named.map(|(_, entry)| entry)
        };
        let found = match type_hash {
            Some(type_hash) => kept.types.get(&(name.clone(), type_hash.to_owned())).or_else(|| {
                named()
                    .filter(|_| name.kind() != "msg")
                    .find(|entry| entry.described.is_announced_as(type_hash))
            }),
            None => named().max_by_key(|entry| entry.at),
        };
        found.map(|entry| entry.described.clone())
    }

    /// Returns the layout of messages of a type. The request and the response of a service are found by each hash that
    /// its endpoints announce ([`ResolvedType::is_announced_as`]).
    pub fn layout(&self, name: &TypeName, type_hash: Option<&str>) -> Option<Arc<Layout>> {
        if let Some(described) = self.described(name, type_hash) {
            return Some(described.layout().clone());
        }
        let service = self.described(&name.service()?, type_hash)?;
        service.layout().part(name).map(Arc::new)
    }

    fn lock(&self) -> MutexGuard<'_, StoreState> {
        lock(&self.kept)
    }
}

#[cfg(test)]
mod tests {
    use sgc_cdr::Library;

    use super::*;

    fn described(name: &str, text: &str) -> ResolvedType {
        let mut look_up = |_: &TypeName| Some(text.to_owned()).filter(|text| !text.is_empty());
        ResolvedType::from_layout(Library::empty().layout(&name.parse().unwrap(), &mut look_up).unwrap())
            .unwrap()
    }

    #[test]
    fn types_are_found_by_name_and_hash_or_the_last_of_a_name() {
        let store = TypeStore::default();
        let (old, new) = (described("p/msg/A", "int8 old"), described("p/msg/A", "int8 new"));
        let name = old.name().clone();
        assert!(store.layout(&name, None).is_none());
        let (old, new) = (store.insert(old).unwrap(), store.insert(new).unwrap());
        store.insert(described("p/msg/AB", "int8 other")).unwrap();
        let hash = |found: Option<Arc<ResolvedType>>| found.unwrap().type_hash().to_owned();
        assert_eq!(hash(store.described(&name, Some(old.type_hash()))), old.type_hash());
        assert_eq!(hash(store.described(&name, None)), new.type_hash());
        assert!(store.described(&name, Some("RIHS01_00")).is_none());
    }

    #[test]
    fn messages_of_a_service_are_found_by_its_hash() {
        let store = TypeStore::default();
        let service = store.insert(described("std_srvs/srv/SetBool", "")).unwrap();
        let request = "std_srvs/srv/SetBool_Request".parse().unwrap();
        let of_request = service.layout().part(&request).unwrap().type_hash();
        for hash in [None, Some(service.type_hash()), Some(&*of_request)] {
            let layout = store.layout(&request, hash).unwrap();
            assert_eq!(layout.from_json(br#"{"data": true}"#).unwrap().to_json(), r#"{"data":true}"#);
        }
        assert!(store.layout(&request, Some("RIHS01_00")).is_none());
        assert!(store.layout(&"std_srvs/srv/Empty_Request".parse().unwrap(), None).is_none());
    }

    #[test]
    fn a_full_store_takes_nothing_in_before_unused_types_are_removed() {
        let of = |n: usize| described(&format!("p/msg/A{n}"), "int8 a");
        let bytes = of(0).description().len();
        for store in [TypeStore::with_limits(2, usize::MAX), TypeStore::with_limits(9, 2 * bytes + bytes / 2)]
        {
            let first = store.insert(of(0)).unwrap();
            store.insert(of(1)).unwrap();
            assert!(!store.has_room_for(&of(2)) && store.has_room_for(&of(0)));
            assert_eq!(store.insert(of(2)).map(|_| ()), Err(StoreFull { types: 2, bytes: 2 * bytes }));
            // A known type needs no room.
            assert!(Arc::ptr_eq(&store.insert(of(0)).unwrap(), &first));
            store.retain(|name, _| name.name() == "A0");
            store.insert(of(2)).unwrap();
            assert!(store.described(of(1).name(), None).is_none());
            assert!(store.described(of(0).name(), None).is_some());
        }
    }
}
