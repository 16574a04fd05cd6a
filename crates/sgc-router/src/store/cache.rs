//! [`Cache`]: values of the store that were read lately, within a number of bytes.

use std::collections::BTreeMap;
use std::time::{Duration, Instant};

use bytes::Bytes;

use super::op::StoreKey;

/// Approximate memory of an entry beside its value, bytes.
const ENTRY_BYTES: usize = 192;
/// Time for which a key without a value is not read again. A change is reported before.
const ABSENT_FOR: Duration = Duration::from_secs(20);

#[derive(Debug)]
struct Entry {
    value: Option<Bytes>,
    read_at: Instant,
    /// Number of its last use.
    used: u64,
}

impl Entry {
    fn bytes(&self) -> usize {
        ENTRY_BYTES + self.value.as_ref().map_or(0, Bytes::len)
    }
}

/// Values by their keys. Without room, the value that was not used for longest gives way.
#[derive(Debug)]
pub(super) struct Cache {
    bytes_max: usize,
    entries: BTreeMap<StoreKey, Entry>,
    /// Keys by their last use.
    uses: BTreeMap<u64, StoreKey>,
    next_use: u64,
    bytes: usize,
}

impl Cache {
    pub(super) fn new(bytes_max: usize) -> Self {
        Self { bytes_max, entries: BTreeMap::new(), uses: BTreeMap::new(), next_use: 0, bytes: 0 }
    }

    /// Returns the value of a key, or that it has none; `None` if that is not known.
    pub(super) fn get(&mut self, now: Instant, key: &StoreKey) -> Option<Option<Bytes>> {
        let entry = self.entries.get_mut(key)?;
        if entry.value.is_none() && entry.read_at + ABSENT_FOR <= now {
            self.remove(key);
            return None;
        }
        self.uses.remove(&entry.used);
        entry.used = self.next_use;
        self.uses.insert(entry.used, *key);
        self.next_use += 1;
        Some(entry.value.clone())
    }

    /// Notes a value that was just read.
    pub(super) fn insert(&mut self, now: Instant, key: StoreKey, value: Option<Bytes>) {
        self.remove(&key);
        let entry = Entry { value, read_at: now, used: self.next_use };
        self.next_use += 1;
        self.bytes += entry.bytes();
        self.uses.insert(entry.used, key);
        self.entries.insert(key, entry);
        while self.bytes > self.bytes_max
            && let Some((_, oldest)) = self.uses.first_key_value()
        {
            let oldest = *oldest;
            self.remove(&oldest);
        }
    }

    /// Forgets the value of a key.
    pub(super) fn remove(&mut self, key: &StoreKey) {
        if let Some(entry) = self.entries.remove(key) {
            self.uses.remove(&entry.used);
            self.bytes -= entry.bytes();
        }
    }

    /// Forgets all values.
    pub(super) fn clear(&mut self) {
        *self = Self { next_use: self.next_use, ..Self::new(self.bytes_max) };
    }

    /// Returns the number of entries.
    pub(super) fn len(&self) -> usize {
        self.entries.len()
    }

    /// Returns their memory, bytes.
    pub(super) fn bytes(&self) -> usize {
        self.bytes
    }
}

#[cfg(test)]
mod tests {
    use sgc_testkit::Clock;
    use sgc_wire::Name;

    use super::*;

    fn key(number: u8) -> StoreKey {
        StoreKey::Name(Name([number; 32]))
    }

    #[test]
    fn value_that_was_not_used_for_longest_gives_way() {
        let now = Clock::default().now().instant;
        let mut cache = Cache::new(2 * (ENTRY_BYTES + 10));
        let value = Some(Bytes::from_static(b"0123456789"));
        cache.insert(now, key(1), value.clone());
        cache.insert(now, key(2), value.clone());
        assert_eq!(cache.get(now, &key(1)), Some(value.clone()));
        cache.insert(now, key(3), value.clone());
        assert_eq!(cache.get(now, &key(2)), None);
        assert_eq!(cache.get(now, &key(1)), Some(value.clone()));
        assert_eq!(cache.get(now, &key(3)), Some(value));
        assert_eq!((cache.len(), cache.bytes()), (2, 2 * (ENTRY_BYTES + 10)));
    }

    #[test]
    fn value_over_the_budget_is_not_kept() {
        let now = Clock::default().now().instant;
        let mut cache = Cache::new(ENTRY_BYTES + 9);
        cache.insert(now, key(1), Some(Bytes::from_static(b"0123456789")));
        assert_eq!((cache.len(), cache.bytes()), (0, 0));
    }

    #[test]
    fn absence_is_believed_for_a_while() {
        let now = Clock::default().now().instant;
        let mut cache = Cache::new(1000);
        cache.insert(now, key(1), None);
        assert_eq!(cache.get(now + ABSENT_FOR - Duration::from_millis(1), &key(1)), Some(None));
        assert_eq!(cache.get(now + ABSENT_FOR, &key(1)), None);
        assert_eq!(cache.bytes(), 0);
    }

    #[test]
    fn new_value_replaces_the_old_one() {
        let now = Clock::default().now().instant;
        let mut cache = Cache::new(1000);
        cache.insert(now, key(1), None);
        cache.insert(now, key(1), Some(Bytes::from_static(b"new")));
        assert_eq!((cache.len(), cache.bytes()), (1, ENTRY_BYTES + 3));
        cache.clear();
        assert_eq!((cache.len(), cache.bytes()), (0, 0));
    }
}
