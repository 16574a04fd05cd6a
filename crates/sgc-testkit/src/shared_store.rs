//! The store of a world: it can stop, forget and lie.

use std::collections::BTreeSet;
use std::time::Duration;

use sgc_router::{MappingKind, StoreEvent, StoreFailure, StoreKey, StoreOp, StoreStats};

use crate::ids::NodeKey;
use crate::node::Arrival;
use crate::rng::Dice;
use crate::store::{Client, STORE_LATENCY, StoreCounts, Value};
use crate::world::{Pending, World};

/// Time after which an operation without an answer fails.
const OPERATION_MAX: Duration = Duration::from_secs(2);

impl World {
    /// Takes an operation of a node to the store.
    pub(crate) fn operate_store(&mut self, node: NodeKey, op: StoreOp) {
        let run = self.runs(node);
        self.queue(self.clock.instant() + STORE_LATENCY, Pending::Store { node, run, op });
    }

    /// Lets the store carry out an operation.
    pub(crate) fn serve_store(&mut self, client: Client, op: &StoreOp) {
        let now = self.clock.instant();
        if self.store.is_down {
            let result = Err(StoreFailure::Unreachable);
            return self.tell_of_store(client, StoreEvent::Reply { id: op.id, result }, OPERATION_MAX);
        }
        let (result, told) = self.store.apply(now, client, op);
        self.tell_of_store(client, StoreEvent::Reply { id: op.id, result }, STORE_LATENCY);
        self.tell_changed(op.key, told);
    }

    fn tell_changed(&mut self, key: StoreKey, told: BTreeSet<Client>) {
        for client in told {
            self.tell_of_store(client, StoreEvent::Changed(key), STORE_LATENCY);
        }
    }

    fn tell_of_store(&mut self, (node, run): Client, event: StoreEvent, after: Duration) {
        let arrival = Arrival::Store(event);
        self.queue(self.clock.instant() + after, Pending::Input { node, run, arrival });
    }

    /// Connects a router that just started to the store.
    pub(crate) fn connect_store(&mut self, node: NodeKey) {
        let has_store = self.nodes[node.0].transit && self.nodes[node.0].mapping == MappingKind::Store;
        if has_store && !self.store.is_down {
            self.tell_of_store((node, self.runs(node)), StoreEvent::Up, STORE_LATENCY);
        }
    }

    fn tell_all_of_store(&mut self, event: &StoreEvent) {
        for node in self.nodes().collect::<Vec<_>>() {
            if self.nodes[node.0].transit && self.nodes[node.0].mapping == MappingKind::Store {
                self.tell_of_store((node, self.runs(node)), event.clone(), STORE_LATENCY);
            }
        }
    }

    /// Stops the store: it answers nothing.
    pub fn stop_store(&mut self) {
        self.note("stop the store".to_owned());
        self.store.is_down = true;
        self.store.readers.clear();
        self.tell_all_of_store(&StoreEvent::Down);
    }

    /// Starts the store again, with its values or without.
    pub fn start_store(&mut self, keeps_values: bool) {
        self.note(format!("start the store, {}", if keeps_values { "with its values" } else { "empty" }));
        self.store.is_down = false;
        self.store.readers.clear();
        if !keeps_values {
            self.store.values.clear();
        }
        self.tell_all_of_store(&StoreEvent::Up);
    }

    /// Returns `true` if the store does not answer.
    pub fn is_store_down(&self) -> bool {
        self.store.is_down
    }

    /// Has the store lose, replay, swap or invent some values, with or without telling their readers.
    pub fn corrupt_store(&mut self, dice: &mut Dice) {
        let keys: Vec<_> = self.store.values.keys().copied().collect();
        for _ in 0..dice.within(1..=4) {
            let Some(key) = dice.pick(&keys) else { return };
            let other = dice.pick(&keys).and_then(|key| self.store.values.get(&key)).map(|v| v.bytes.clone());
            let past = (!self.store.past.is_empty()).then(|| dice.below(self.store.past.len()));
            let (key, bytes) = match (dice.below(5), past.map(|past| self.store.past[past].clone())) {
                (0 | 1, _) => (key, None),
                (2, Some((key, bytes))) => (key, Some(bytes)),
                (3, _) => (key, other),
                _ => {
                    let length = dice.below(100);
                    (key, Some((0..length).map(|_| dice.below(256) as u8).collect()))
                }
            };
            self.note(format!("the store lies about {key}"));
            let told = self.store.set(key, bytes.map(|bytes| Value { bytes, end: None }));
            if dice.chance(50) {
                self.tell_changed(key, told);
            }
        }
    }

    /// Has the store lose the value of a key, without telling its readers.
    pub fn forget_stored(&mut self, key: &StoreKey) {
        self.note(format!("the store forgets {key}"));
        self.store.set(*key, None);
    }

    /// Returns the number of values in the store.
    pub fn stored(&self) -> usize {
        self.store.values.len()
    }

    /// Returns the value of a key in the store.
    pub fn stored_value(&self, key: &StoreKey) -> Option<&[u8]> {
        self.store.values.get(key).map(|value| value.bytes.as_ref())
    }

    /// Returns the operations that the store has carried out.
    pub fn store_counts(&self) -> StoreCounts {
        self.store.counts
    }

    /// Returns the state of the store as a router sees it.
    ///
    /// # Panics
    /// If the node does not run, or is no router with a store.
    pub fn store_stats(&self, node: NodeKey) -> StoreStats {
        let running = self.nodes[node.0].running.as_ref();
        running.and_then(|running| running.router.store_stats()).expect("a running router with a store")
    }
}
