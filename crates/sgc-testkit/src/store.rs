//! A store that all routers of a world share: a map that reports changes, and that can fail, forget and lie.

use std::collections::{BTreeMap, BTreeSet};
use std::time::{Duration, Instant};

use bytes::Bytes;
use sgc_router::{StoreAction, StoreFailure, StoreKey, StoreOp, StoreReply, WriteIf};

use crate::ids::NodeKey;

/// Time of an operation to the store, and of its result back.
pub(crate) const STORE_LATENCY: Duration = Duration::from_millis(1);

/// A run of a node that uses the store.
pub(crate) type Client = (NodeKey, u64);

#[derive(Clone, Debug)]
pub(crate) struct Value {
    pub(crate) bytes: Bytes,
    pub(crate) end: Option<Instant>,
}

/// The operations that a store has carried out.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct StoreCounts {
    /// Reads.
    pub reads: usize,
    /// Writes, of any key.
    pub writes: usize,
    /// Writes of names.
    pub name_writes: usize,
    /// Removals.
    pub removals: usize,
}

/// The store of a world.
#[derive(Debug, Default)]
pub(crate) struct SimStore {
    pub(crate) values: BTreeMap<StoreKey, Value>,
    /// Values of the past, for a store that replays them.
    pub(crate) past: Vec<(StoreKey, Bytes)>,
    pub(crate) readers: BTreeMap<StoreKey, BTreeSet<Client>>,
    pub(crate) is_down: bool,
    pub(crate) counts: StoreCounts,
}

impl SimStore {
    /// Carries an operation out. Returns its result, and the clients that are told of a change.
    pub(crate) fn apply(
        &mut self,
        now: Instant,
        client: Client,
        op: &StoreOp,
    ) -> (Result<StoreReply, StoreFailure>, BTreeSet<Client>) {
        if self.values.get(&op.key).is_some_and(|value| value.end.is_some_and(|end| end <= now)) {
            self.values.remove(&op.key);
        }
        let existed = self.values.contains_key(&op.key);
        match &op.action {
            StoreAction::Read => {
                self.counts.reads += 1;
                self.readers.entry(op.key).or_default().insert(client);
                let value = self.values.get(&op.key).map(|value| value.bytes.clone());
                (Ok(StoreReply::Value(value)), BTreeSet::new())
            }
            StoreAction::Write { value, lifetime, condition } => {
                self.counts.writes += 1;
                self.counts.name_writes += usize::from(matches!(op.key, StoreKey::Name(_)));
                let mut told = BTreeSet::new();
                if *condition == WriteIf::Always || !existed {
                    self.past.push((op.key, value.clone()));
                    let value = Value { bytes: value.clone(), end: lifetime.map(|lifetime| now + lifetime) };
                    told = self.set(op.key, Some(value));
                }
                (Ok(StoreReply::Written { existed }), told)
            }
            StoreAction::Remove { value } => {
                self.counts.removals += 1;
                let is_same = self.values.get(&op.key).is_some_and(|known| known.bytes == *value);
                let told = if is_same { self.set(op.key, None) } else { BTreeSet::new() };
                (Ok(StoreReply::Removed), told)
            }
        }
    }

    pub(crate) fn set(&mut self, key: StoreKey, value: Option<Value>) -> BTreeSet<Client> {
        match value {
            Some(value) => self.values.insert(key, value),
            None => self.values.remove(&key),
        };
        self.readers.remove(&key).unwrap_or_default()
    }
}
