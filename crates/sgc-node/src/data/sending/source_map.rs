//! The sources of a share, by the writers whose samples they publish.
//!
//! A map never changes. The control task replaces it as a whole when writers come and go. This module publishes
//! nothing.

use std::collections::HashMap;
use std::sync::{Arc, Mutex};
use std::time::{Duration, Instant};

use sgc_endpoint::{Source, SourceProgress};
use sgc_ros::Guid;
use sgc_wire::{Qos, SourceId};

use crate::data::sending::manual_lease::ManualLease;

/// The sources of a share by writer.
#[derive(Default)]
pub(crate) struct SourceMap {
    /// The one source of all writers, if writers are not distinguished.
    pub shared: Option<SourceSlot>,
    /// Whether each writer has its own source. Samples of an unlisted writer then wait until it is listed.
    pub(crate) per_writer: bool,
    /// Sources by writer. Several writers may have one source.
    pub own: HashMap<Guid, SourceSlot>,
    /// The source that asserts the liveliness of writers without messages. It keeps no history.
    pub assertions: Option<SourceSlot>,
}

impl SourceMap {
    /// Creates the map of one source for all writers, which also makes the assertions of the writers in `manual`. It
    /// keeps no history. `before` is the former map of these writers.
    pub(crate) fn of_one(slot: SourceSlot, manual: &[(Guid, Qos)], before: &Self, now: Instant) -> Self {
        let leased = |(writer, qos): &(Guid, Qos)| {
            let known = before.own.get(writer).and_then(|slot| slot.manual.clone());
            let known = known.filter(|lease| lease.is_of(qos));
            let manual = Some(known.or_else(|| ManualLease::from_qos(qos, now))?);
            Some((*writer, SourceSlot { manual, ..slot.clone() }))
        };
        let own: HashMap<_, _> = manual.iter().filter_map(leased).collect();
        let assertions = (!own.is_empty()).then(|| slot.clone());
        Self { shared: Some(slot), per_writer: false, own, assertions }
    }

    /// Returns the slot of a source.
    pub(crate) fn slot(&self, id: &SourceId) -> Option<SourceSlot> {
        self.slots().find(|slot| slot.id == *id).cloned()
    }

    /// Returns the ids of all sources.
    pub(crate) fn ids(&self) -> Vec<SourceId> {
        self.slots().map(|slot| slot.id).collect()
    }

    /// Iterates over all slots.
    pub(crate) fn slots(&self) -> impl Iterator<Item = &SourceSlot> {
        self.own.values().chain(&self.shared).chain(&self.assertions)
    }

    /// Chooses the source for a sample of a writer.
    pub(crate) fn choose(&self, writer: Option<Guid>) -> SourceChoice {
        match writer.and_then(|writer| self.own.get(&writer)) {
            Some(slot) => SourceChoice::Source(slot.clone()),
            None if self.per_writer && writer.is_some() => SourceChoice::UnknownWriter,
            // The writer is gone and was never identified, so any source serves.
            None => {
                let any = self.shared.as_ref().or_else(|| self.own.values().min_by_key(|slot| slot.id));
                any.cloned().map_or(SourceChoice::NoSource, SourceChoice::Source)
            }
        }
    }
}

/// The source for a sample.
pub(crate) enum SourceChoice {
    /// This source publishes the sample.
    Source(SourceSlot),
    /// The writer is not listed yet, so its samples wait.
    UnknownWriter,
    /// The share has no source, because the name has no grant yet.
    NoSource,
}

/// A source with the properties of its publisher.
#[derive(Clone)]
pub(crate) struct SourceSlot {
    /// Source id.
    pub id: SourceId,
    /// The source. The reader's worker locks it for each message.
    pub source: Arc<Mutex<Source>>,
    /// Progress of the source, readable without the lock.
    pub progress: Arc<SourceProgress>,
    /// Whether late joiners may ask for its history.
    pub keeps_history: bool,
    /// Whether its packets are reliable.
    pub reliable: bool,
    /// Time after which its messages expire.
    pub lifespan: Option<Duration>,
    /// Number of messages kept for late joiners.
    pub depth: usize,
    /// Lease of a publisher that asserts its liveliness without messages.
    pub manual: Option<Arc<ManualLease>>,
}

impl SourceSlot {
    /// Creates the slot of a source.
    pub(crate) fn new(source: Source, keeps_history: bool, reliable: bool) -> Self {
        let (id, progress) = (source.id(), source.progress());
        let source = Arc::new(Mutex::new(source));
        Self { id, source, progress, keeps_history, reliable, lifespan: None, depth: 0, manual: None }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::data::sending::fixtures::{KNOWN, STRANGER, slot_with_id};

    #[test]
    fn writers_with_a_manual_lease_share_the_one_source_that_asserts_them() {
        let (slot, none, now) = (slot_with_id(7), SourceMap::default(), Instant::now());
        let liveliness = sgc_wire::Liveliness::ManualByTopic;
        let manual = Qos { liveliness, lease_ns: Some(2_000_000_000), ..Qos::default() };
        let map = SourceMap::of_one(
            slot.clone(),
            &[(KNOWN, manual.clone()), (STRANGER, Qos::default())],
            &none,
            now,
        );
        assert_eq!(map.own.keys().collect::<Vec<_>>(), [&KNOWN]);
        assert!(map.own[&KNOWN].manual.is_some() && map.assertions.is_some());
        assert!(map.slots().all(|one| Arc::ptr_eq(&one.source, &slot.source)), "numbers are nonces");
        let again = SourceMap::of_one(slot_with_id(8), &[(KNOWN, manual)], &map, now);
        let lease = |map: &SourceMap| map.own[&KNOWN].manual.clone().unwrap();
        assert!(Arc::ptr_eq(&lease(&again), &lease(&map)), "what was heard is not forgotten");
        let map = SourceMap::of_one(slot, &[(STRANGER, Qos::default())], &map, now);
        assert!(map.own.is_empty() && map.assertions.is_none());
    }

    #[test]
    fn writer_has_its_own_source_and_waits_until_it_is_listed() {
        let chosen = |map: &SourceMap, writer| match map.choose(writer) {
            SourceChoice::Source(slot) => Ok(slot.id.0[0]),
            SourceChoice::UnknownWriter => Err("unknown writer"),
            SourceChoice::NoSource => Err("no source"),
        };
        assert_eq!(chosen(&SourceMap::default(), Some(KNOWN)), Err("no source"));
        let own = HashMap::from([(KNOWN, slot_with_id(2)), (Guid([3; 16]), slot_with_id(1))]);
        let map = SourceMap { per_writer: true, own, ..SourceMap::default() };
        assert_eq!(chosen(&map, Some(KNOWN)), Ok(2));
        assert_eq!(chosen(&map, Some(STRANGER)), Err("unknown writer"));
        assert_eq!(chosen(&map, None), Ok(1), "the choice is the same each time");
        let map = SourceMap { shared: Some(slot_with_id(7)), per_writer: false, ..map };
        assert_eq!(
            [Some(KNOWN), Some(STRANGER), None].map(|writer| chosen(&map, writer)),
            [Ok(2), Ok(7), Ok(7)]
        );
    }
}
