//! [`OwnSources`]: the sources that publish for the local writers of a share.

use std::collections::{BTreeMap, BTreeSet};
use std::time::{Duration, Instant};

use sgc_wire::{CatalogueSource, ENTRY_SOURCES_MAX, Liveliness, Qos, SourceId};

use super::local_graph::LocalGraph;
use crate::network::Guid;
use crate::qos::weakest;

/// Time for which a share outlives its last local writer, so that a restarted program finds its subscribers.
pub const WRITERLESS_HOLD: Duration = Duration::from_secs(2);

/// Most writers of a share, those that are gone among them, for whose messages sources are held.
const HELD_SOURCES_MAX: usize = 2 * ENTRY_SOURCES_MAX;

/// The time for which something outlives its writers.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub(super) struct Hold {
    until: Instant,
    /// The time at which the writers vanished.
    since: Instant,
}

impl Hold {
    /// Begins a hold.
    pub(super) fn begin(now: Instant) -> Self {
        Self { until: now + WRITERLESS_HOLD, since: now }
    }

    /// Returns a hold that ends at once.
    pub(super) fn over(now: Instant) -> Self {
        Self { until: now, since: now }
    }

    pub(super) fn until(&self) -> Instant {
        self.until
    }

    /// Starts the hold once more if it is over, because messages of the writers may still wait: until `max` after they
    /// vanished.
    pub(super) fn go_on(&mut self, now: Instant, max: Duration) {
        if self.until <= now && self.since + max > now {
            self.until = now + WRITERLESS_HOLD;
        }
    }
}

/// The source that publishes for a local writer.
#[derive(Clone, Debug)]
struct OwnSource {
    source: SourceId,
    /// The writer's offer, as far as it is carried.
    qos: Qos,
    /// The hold of a writer that vanished. The source of a volatile writer is kept for a while: for its last messages,
    /// and so that subscribers of a restarted program notice nothing.
    gone: Option<Hold>,
    /// `true` if the writer's liveliness lease has expired.
    is_lapsed: bool,
}

/// The sources of a share, at most [`ENTRY_SOURCES_MAX`], by their writers.
#[derive(Debug, Default)]
pub(super) struct OwnSources(BTreeMap<Guid, OwnSource>);

impl OwnSources {
    /// Gives a writer the source for its offer and the combined one: its own, that of a similar writer that is gone,
    /// or a new one. Returns `false` if there are too many, so that the writer shares a source with another one.
    pub(super) fn assign(
        &mut self,
        writer: &Guid,
        offered: &Qos,
        offer: &Qos,
        mut new: impl FnMut() -> SourceId,
    ) -> bool {
        let qos = carried(offered, offer);
        let passed_on = self.was_passed_on(writer);
        if let Some(own) = self.0.get_mut(writer)
            && !passed_on
            && same_kind(&own.qos, &qos)
        {
            own.qos = qos;
            own.gone = None;
            return true;
        }
        // A source of another kind must be a new one.
        let is_lapsed = self.0.remove(writer).is_some_and(|own| own.is_lapsed);
        let found = self.find(&qos, &mut new);
        let source = found.or_else(|| self.0.values().map(|own| own.source).max());
        let source = source.unwrap_or_else(new);
        self.0.insert(*writer, OwnSource { source, qos, gone: None, is_lapsed });
        found.is_some()
    }

    /// Returns the source for a writer without one: that of a similar volatile writer that is gone, or a new one.
    /// Returns `None` if there are too many.
    fn find(&mut self, qos: &Qos, new: impl FnOnce() -> SourceId) -> Option<SourceId> {
        let here = self.0.values().filter(|own| own.gone.is_none()).map(|own| own.source);
        let here: BTreeSet<_> = here.collect();
        let vacant = || self.0.values().filter(|own| !here.contains(&own.source));
        if let Some(own) = vacant().filter(|own| own.qos == *qos).max_by_key(|own| own.gone) {
            return Some(own.source);
        }
        let all: BTreeSet<_> = self.0.values().map(|own| own.source).collect();
        if all.len() >= ENTRY_SOURCES_MAX {
            let oldest = vacant().min_by_key(|own| own.gone)?.source;
            self.0.retain(|_, own| own.source != oldest);
        }
        Some(new())
    }

    /// Returns `true` if the writer vanished and its source passed to another.
    fn was_passed_on(&self, writer: &Guid) -> bool {
        let gone = self.0.get(writer).filter(|own| own.gone.is_some());
        gone.is_some_and(|gone| {
            self.0.values().any(|other| other.source == gone.source && other.gone.is_none())
        })
    }

    /// Returns the source of a writer.
    pub(super) fn source_of(&self, writer: &Guid) -> Option<SourceId> {
        Some(self.0.get(writer)?.source)
    }

    /// Returns `true` if a writer that is here has the source.
    pub(super) fn has_writer_of(&self, source: &SourceId) -> bool {
        self.0.values().any(|own| own.source == *source && own.gone.is_none())
    }

    /// Handles the end of a writer; `is_last` if the share has no other.
    pub(super) fn writer_gone(&mut self, now: Instant, writer: &Guid, is_last: bool) {
        match self.0.get_mut(writer) {
            Some(own) if !own.qos.is_transient_local() => own.gone = Some(Hold::begin(now)),
            // Late joiners get no history of a publisher that is gone. The last one counts as gone only after the
            // hold.
            _ if !is_last => drop(self.0.remove(writer)),
            _ => self.0.clear(),
        }
    }

    /// Forgets the sources of writers that are gone.
    pub(super) fn forget_gone(&mut self) {
        self.0.retain(|_, own| own.gone.is_none());
    }

    /// Handles the expiry of a writer's lease, or its renewal. Returns `true` if that changes what is listed. A far
    /// writer with liveliness manual by topic is renewed by messages and assertions and expires by itself. All others
    /// live as long as this node's writers.
    pub(super) fn set_alive(&mut self, writer: &Guid, is_alive: bool) -> bool {
        let is_concerned = |own: &&mut OwnSource| {
            own.is_lapsed == is_alive && (is_alive || own.qos.liveliness != Liveliness::ManualByTopic)
        };
        let Some(own) = self.0.get_mut(writer).filter(is_concerned) else { return false };
        own.is_lapsed = !is_alive;
        true
    }

    /// Forgets the sources of writers that have been gone for a while. Returns `true` if there were some.
    pub(super) fn time_out(&mut self, now: Instant) -> bool {
        let before = self.0.len();
        self.0.retain(|_, own| own.gone.is_none_or(|hold| hold.until > now));
        self.0.len() < before
    }

    /// Starts the holds that are over once more ([`Hold::go_on`]), while there are few sources.
    pub(super) fn hold_on(&mut self, now: Instant, max: Duration) {
        if self.0.len() <= HELD_SOURCES_MAX {
            self.0.values_mut().filter_map(|own| own.gone.as_mut()).for_each(|hold| hold.go_on(now, max));
        }
    }

    /// Returns the time of the next [`Self::time_out`].
    pub(super) fn deadline(&self) -> Option<Instant> {
        self.0.values().filter_map(|own| own.gone).map(|hold| hold.until).min()
    }

    /// Iterates over the writers, also those that are gone.
    pub(super) fn writers(&self) -> impl Iterator<Item = &Guid> {
        self.0.keys()
    }

    /// Returns the source and the offer of each writer.
    pub(super) fn mapping(&self) -> impl Iterator<Item = (Guid, SourceId, Qos)> {
        self.0.iter().map(|(writer, own)| (*writer, own.source, own.qos.clone()))
    }

    /// Returns the publishers for the catalogue, each source once.
    pub(super) fn listed(&self, local: &LocalGraph) -> Vec<CatalogueSource> {
        let mut listed = BTreeMap::<SourceId, Vec<(&Guid, &OwnSource)>>::new();
        for (guid, own) in &self.0 {
            listed.entry(own.source).or_default().push((guid, own));
        }
        let listed = listed.into_iter().filter_map(|(source, mut all)| {
            // A source that passed to another writer stands for that writer.
            if all.iter().any(|(_, own)| own.gone.is_none()) {
                all.retain(|(_, own)| own.gone.is_none());
            }
            let qos = weakest(all.iter().map(|(_, own)| &own.qos))?;
            let node = local.node_of(all.first()?.0);
            let is_same = all.iter().all(|(guid, _)| local.node_of(guid) == node);
            let is_lapsed = all.iter().all(|(_, own)| own.is_lapsed);
            let source = if is_lapsed { source.lapsed() } else { source };
            Some(CatalogueSource { source, qos, node: node.filter(|_| is_same).cloned() })
        });
        listed.collect()
    }
}

/// Returns the part of a writer's offer that is carried: the combined offer decides how it is read and kept for late
/// joiners.
fn carried(own: &Qos, offer: &Qos) -> Qos {
    Qos {
        reliability: own.reliability.min(offer.reliability),
        durability: own.durability.min(offer.durability),
        ..own.clone()
    }
}

/// Returns `true` if one source can stand for both.
fn same_kind(a: &Qos, b: &Qos) -> bool {
    (a.reliability, a.is_transient_local()) == (b.reliability, b.is_transient_local())
}

#[cfg(test)]
#[allow(clippy::disallowed_methods)]
mod tests {
    use sgc_wire::Durability;

    use super::*;

    /// Assigns sources to writers with default QoS and numbers new sources.
    #[derive(Default)]
    struct Bench {
        own: OwnSources,
        made: u8,
    }

    impl Bench {
        fn assign(&mut self, writer: u8, qos: &Qos) -> bool {
            let made = &mut self.made;
            self.own.assign(&guid(writer), qos, qos, || {
                *made += 1;
                SourceId([*made; 16])
            })
        }

        fn source(&self, writer: u8) -> Option<u8> {
            let (_, source, _) = self.own.mapping().find(|(guid, ..)| guid.0[0] == writer)?;
            Some(source.0[0])
        }
    }

    fn guid(n: u8) -> Guid {
        Guid([n; 16])
    }

    #[test]
    fn vacant_source_passes_to_a_similar_writer_and_is_listed_once() {
        let now = Instant::now();
        let mut b = Bench::default();
        assert!(b.assign(1, &Qos::default()) && b.assign(2, &Qos::default()));
        b.own.writer_gone(now, &guid(1), false);
        assert_eq!(b.own.deadline(), Some(now + WRITERLESS_HOLD));
        assert!(b.assign(3, &Qos::default()));
        assert_eq!((b.source(1), b.source(2), b.source(3)), (Some(1), Some(2), Some(1)));
        assert_eq!(b.own.listed(&LocalGraph::default()).len(), 2);
        // The former writer returns and finds its source taken.
        assert!(b.assign(1, &Qos::default()));
        assert_eq!((b.source(1), b.own.deadline()), (Some(3), None));
    }

    #[test]
    fn source_of_a_vanished_writer_is_kept_for_the_hold_only() {
        let now = Instant::now();
        let mut b = Bench::default();
        let latched = Qos { durability: Durability::TransientLocal, ..Qos::default() };
        b.assign(1, &Qos::default());
        b.assign(2, &latched);
        b.own.writer_gone(now, &guid(2), false);
        assert_eq!(b.source(2), None, "nobody has the history of a publisher that is gone");
        b.own.writer_gone(now, &guid(1), true);
        assert!(!b.own.time_out(now + WRITERLESS_HOLD - Duration::from_millis(1)));
        assert!(b.own.time_out(now + WRITERLESS_HOLD) && !b.own.time_out(now + WRITERLESS_HOLD));
        assert_eq!((b.own.writers().count(), b.own.deadline()), (0, None));
    }

    #[test]
    fn writers_beyond_the_limit_share_a_source_until_one_is_vacant() {
        let now = Instant::now();
        let mut b = Bench::default();
        let most = u8::try_from(ENTRY_SOURCES_MAX).unwrap();
        assert!((1..=most).all(|n| b.assign(n, &Qos::default())));
        assert!(!b.assign(most + 1, &Qos::default()));
        assert_eq!(b.own.listed(&LocalGraph::default()).len(), ENTRY_SOURCES_MAX);
        b.own.writer_gone(now, &guid(1), false);
        // Its source does not fit another kind of writer, but makes room for a new one.
        let latched = Qos { durability: Durability::TransientLocal, ..Qos::default() };
        assert!(b.assign(most + 2, &latched));
        assert_eq!((b.source(1), b.source(most + 2)), (None, Some(most + 1)));
        assert_eq!(b.own.listed(&LocalGraph::default()).len(), ENTRY_SOURCES_MAX);
    }

    #[test]
    fn expired_lease_is_listed_unless_the_far_writer_notices_by_itself() {
        let mut b = Bench::default();
        b.assign(1, &Qos::default());
        b.assign(2, &Qos { liveliness: Liveliness::ManualByTopic, ..Qos::default() });
        assert!(b.own.set_alive(&guid(1), false) && !b.own.set_alive(&guid(1), false));
        assert!(!b.own.set_alive(&guid(2), false) && !b.own.set_alive(&guid(3), false));
        let lapsed =
            |b: &Bench| b.own.listed(&LocalGraph::default()).iter().filter(|s| s.source.is_lapsed()).count();
        assert_eq!(lapsed(&b), 1);
        assert!(b.own.set_alive(&guid(1), true));
        assert_eq!(lapsed(&b), 0);
    }
}
