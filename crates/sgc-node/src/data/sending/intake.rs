//! The consumer of a local reader: it skips samples that an earlier reader took, and publishes the others on a share.
//!
//! A reader of a transient-local topic that replaces another gets the history of its writers again.

use std::collections::BTreeMap;
use std::sync::{Arc, Mutex};

use sgc_ros::{Guid, HandleSamples, Sample};
use sgc_sync::lock;

use crate::data::sending::share::LocalShare;
use crate::data::stats::{DataDrop, Dropped};

/// Writers of a topic whose newest time stamps are remembered.
const NEWEST_WRITERS_MAX: usize = 1024;

/// The consumer of a local reader, which publishes its samples on a share.
pub(crate) struct Publisher {
    share: Arc<LocalShare>,
    /// Time stamps of the newest samples before this reader, since its writers deliver them again.
    past: BTreeMap<Guid, i64>,
    newest: Option<Arc<NewestSamples>>,
}

impl Publisher {
    /// Creates the consumer of a reader. `newest` holds the time stamps of earlier readers and is updated from here on.
    pub(crate) fn new(share: Arc<LocalShare>, newest: Option<Arc<NewestSamples>>) -> Self {
        let past = newest.as_ref().map(|newest| lock(&newest.0).clone()).unwrap_or_default();
        Self { share, past, newest }
    }

    /// Returns `true` for a sample that an earlier reader took. A writer never gives two samples the same time stamp.
    fn is_past(&self, sample: &Sample) -> bool {
        let newest = sample.writer.and_then(|writer| self.past.get(&writer));
        newest.is_some_and(|newest| sample.source_timestamp_ns <= *newest)
    }

    /// Skips a sample that was taken before. Otherwise it notes the sample and passes it to the share.
    fn take(
        &self,
        sample: Sample,
        publish: impl FnOnce(&Arc<LocalShare>, Sample) -> Option<Sample>,
    ) -> Option<Sample> {
        if self.is_past(&sample) {
            self.share.count_here(Dropped::one(DataDrop::Repeated));
            self.share.left_out(sample.more);
            return None;
        }
        let (writer, timestamp_ns) = (sample.writer, sample.source_timestamp_ns);
        let refused = publish(&self.share, sample);
        if refused.is_none()
            && let (Some(newest), Some(writer)) = (&self.newest, writer)
        {
            newest.note(writer, timestamp_ns);
        }
        refused
    }
}

impl HandleSamples for Publisher {
    fn handle(&mut self, sample: Sample) {
        let _ = self.take(sample, |share, sample| {
            share.publish(sample);
            None
        });
    }

    fn handle_at_once(&mut self, sample: Sample) -> Option<Sample> {
        self.take(sample, |share, sample| share.publish_at_once(sample))
    }

    fn overrun(&mut self, samples: u64) {
        self.share.count_here(Dropped { reason: DataDrop::Overrun, messages: samples });
    }
}

/// Time stamps of the newest samples that readers of a transient-local topic took, by writer.
#[derive(Debug, Default)]
pub(crate) struct NewestSamples(Mutex<BTreeMap<Guid, i64>>);

impl NewestSamples {
    fn note(&self, writer: Guid, timestamp_ns: i64) {
        let mut newest = lock(&self.0);
        if newest.len() < NEWEST_WRITERS_MAX || newest.contains_key(&writer) {
            let known = newest.entry(writer).or_insert(timestamp_ns);
            *known = timestamp_ns.max(*known);
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::data::sending::fixtures::{KNOWN, sample, share};
    use crate::data::stats::CountDrops;

    #[test]
    fn reader_in_the_place_of_another_takes_nothing_twice() {
        let runtime = tokio::runtime::Runtime::new().unwrap();
        let _inside = runtime.enter();
        let (data, share, _) = share();
        let newest = Some(Arc::default());
        let dated = |timestamp| Sample { source_timestamp_ns: timestamp, ..sample(KNOWN, false) };
        let mut first = Publisher::new(share.clone(), newest.clone());
        [1, 2, 3].into_iter().for_each(|timestamp| first.handle(dated(timestamp)));
        assert_eq!(share.published(), 3);
        // The writer delivers the same samples again, and new ones.
        let mut second = Publisher::new(share.clone(), newest);
        [1, 2, 3, 4, 5].into_iter().for_each(|timestamp| second.handle(dated(timestamp)));
        assert_eq!(share.published(), 5);
        assert_eq!(data.drops().snapshot()["repeated"], 3);
        // A reader does not skip samples that it took itself.
        second.handle(dated(5));
        assert_eq!(share.published(), 6);
        second.overrun(7);
        assert_eq!(data.drops().snapshot()["overrun"], 7);
    }

    #[test]
    fn newest_samples_are_kept_of_a_bounded_number_of_writers() {
        let newest = NewestSamples::default();
        for n in 0..2 * NEWEST_WRITERS_MAX {
            let mut guid = [0; 16];
            guid[..8].copy_from_slice(&n.to_be_bytes());
            newest.note(Guid(guid), 7);
            newest.note(Guid(guid), 6);
        }
        let newest = lock(&newest.0);
        assert_eq!(newest.len(), NEWEST_WRITERS_MAX);
        assert!(newest.values().all(|timestamp| *timestamp == 7));
    }
}
