//! [`LateHistory`]: the samples that a writer keeps for late joiners, and its answers to their queries.
//!
//! The queries are those of zenoh-ext's `AdvancedSubscriber` (1.10.2, `advanced_subscriber.rs`), for history and for
//! samples that it missed. Its own `AdvancedCache` keeps any number of bytes, and a depth that cannot change.

use std::collections::VecDeque;
use std::sync::{Arc, Mutex};

use bytes::Bytes;
use sgc_sync::{Work, lock};
use sgc_zenoh::{Attachment, TopicInfo};
use zenoh::Wait as _;
use zenoh::query::{Parameters, Query, Queryable};
use zenoh::sample::SourceInfo;
use zenoh::session::EntityGlobalId;
use zenoh::time::Timestamp;

use crate::participant::Participant;

/// Most samples that a writer keeps, also if its depth is not known.
pub(crate) const LATE_MAX: usize = 4096;
/// Most bytes of the samples that a writer keeps; a single sample may be longer.
const LATE_BYTES_MAX: usize = 64 << 20;
/// Most queries of one writer that wait for an answer. A late joiner beyond them gets no history.
const ANSWERS_MAX: usize = 64;

/// A sample for late joiners.
#[derive(Clone, Debug)]
struct Kept {
    payload: Bytes,
    attachment: Attachment,
    timestamp: Timestamp,
    number: u32,
}

/// A sample that is not published yet.
#[derive(Clone, Debug)]
pub(crate) struct Early {
    pub(crate) payload: Bytes,
    pub(crate) source_timestamp_ns: i64,
}

/// The samples of a writer, the oldest first.
#[derive(Debug)]
pub(crate) struct LateHistory {
    /// The samples that are to be published, before later ones.
    early: VecDeque<Early>,
    /// The samples that were published with the writer's present key.
    samples: VecDeque<Kept>,
    /// Of all.
    bytes: usize,
    depth: usize,
    /// The number of the next sample, as zenoh-ext counts.
    next: u32,
}

impl LateHistory {
    pub(crate) fn new(depth: usize) -> Self {
        let (early, samples) = (VecDeque::new(), VecDeque::new());
        Self { early, samples, bytes: 0, depth: depth.clamp(1, LATE_MAX), next: 0 }
    }

    /// Keeps a sample until it can be published. The oldest ones give way.
    pub(crate) fn push_early(&mut self, sample: Early) {
        self.bytes += sample.payload.len();
        self.early.push_back(sample);
        self.shorten();
    }

    /// Takes the next sample to be published.
    pub(crate) fn take_early(&mut self) -> Option<Early> {
        let sample = self.early.pop_front()?;
        self.bytes -= sample.payload.len();
        Some(sample)
    }

    /// Begins to count for another publisher, which has to publish all samples again.
    pub(crate) fn restart(&mut self) {
        self.next = 0;
        for Kept { payload, attachment, .. } in std::mem::take(&mut self.samples).into_iter().rev() {
            self.early.push_front(Early { payload, source_timestamp_ns: attachment.source_timestamp_ns });
        }
    }

    /// Keeps a sample that is published. The oldest ones give way.
    pub(crate) fn push(&mut self, payload: Bytes, attachment: Attachment, timestamp: Timestamp) {
        let number = self.next;
        self.next = number.wrapping_add(1);
        self.bytes += payload.len();
        self.samples.push_back(Kept { payload, attachment, timestamp, number });
        self.shorten();
    }

    /// Reduces the depth. It never grows.
    pub(crate) fn reduce_depth(&mut self, depth: usize) {
        self.depth = self.depth.min(depth.max(1));
        self.shorten();
    }

    fn shorten(&mut self) {
        let held = |history: &Self| history.samples.len() + history.early.len();
        while held(self) > self.depth || (self.bytes > LATE_BYTES_MAX && held(self) > 1) {
            // Early samples are newer than published ones.
            let oldest = self.samples.pop_front().map(|kept| kept.payload);
            let Some(oldest) = oldest.or_else(|| Some(self.early.pop_front()?.payload)) else { return };
            self.bytes -= oldest.len();
        }
    }

    /// Returns the samples that a query asks for, the oldest first.
    fn select(&self, wanted: &Wanted) -> Vec<Kept> {
        let newest = self.samples.iter().rev().filter(|kept| wanted.has(kept));
        let mut selected: Vec<_> = newest.take(wanted.max).cloned().collect();
        selected.reverse();
        selected
    }
}

/// The samples that a query asks for. Programs of rmw_zenoh do not ask by time, and Zenoh 1.10.2 panics on some ranges of it
/// (`zenoh-util/src/time_range.rs`: `parse_duration("s")`).
#[derive(Debug)]
struct Wanted {
    /// The first and the last number.
    numbers: Option<(u32, u32)>,
    max: usize,
}

impl Wanted {
    fn read(parameters: &Parameters<'_>) -> Self {
        let numbers = parameters.get("_sn").map(|range| {
            let (first, last) = range.split_once("..").unwrap_or((range, range));
            (first.parse().unwrap_or(0), last.parse().unwrap_or(u32::MAX))
        });
        let max = parameters.get("_max").and_then(|max| max.parse().ok()).unwrap_or(LATE_MAX);
        Self { numbers, max }
    }

    fn has(&self, kept: &Kept) -> bool {
        self.numbers.is_none_or(|(first, last)| (first..=last).contains(&kept.number))
    }
}

/// Answers the queries for a writer's history until it is dropped.
#[derive(Debug)]
pub(crate) struct Answers {
    _queryable: Queryable<()>,
}

impl Answers {
    /// Starts to answer. `publisher` is the writer's publisher of Zenoh, whose samples have numbers if `numbered`.
    pub(crate) fn start(
        participant: &Arc<Participant>,
        topic: &TopicInfo,
        publisher: EntityGlobalId,
        numbered: bool,
        history: &Arc<Mutex<LateHistory>>,
    ) -> Result<Self, String> {
        let key = topic.key(participant.domain());
        let count = if numbered { publisher.eid().to_string() } else { "uhlc".to_owned() };
        let asked_at = format!("{key}/@adv/pub/{}/{count}/_", publisher.zid());
        let source = numbered.then_some(publisher);
        let answering =
            Arc::new(Answering { key, source, history: Arc::clone(history), asked: Mutex::default() });
        let (workers, weak) = (participant.workers().clone(), Arc::downgrade(participant));
        let answer = move |mut query: Query| {
            let is_fine = weak.upgrade().is_some_and(|participant| participant.accepts_parameters(&query));
            // Late joiners send neither of these, which would stay with the query until its answer.
            query.payload_mut().map(std::mem::take);
            query.attachment_mut().map(std::mem::take);
            if is_fine && answering.note(query) {
                // Sending may wait for the late joiner.
                workers.run(Arc::clone(&answering) as Arc<dyn Work>);
            }
        };
        let queryable = participant.session().declare_queryable(asked_at);
        let queryable = queryable.allowed_origin(participant.locality()).callback(answer).wait();
        Ok(Self { _queryable: queryable.map_err(|error| error.to_string())? })
    }
}

/// The queries of a writer, which are answered one after the other.
///
/// A late joiner asks twice: once for all publishers, and once for each that it sees. If the first answer ended between two
/// samples of the second one, `AdvancedSubscriber` would take the next sample for the first and drop all older ones.
struct Answering {
    key: String,
    /// The publisher, if its samples have numbers.
    source: Option<EntityGlobalId>,
    history: Arc<Mutex<LateHistory>>,
    asked: Mutex<Asked>,
}

/// Queries without an answer, the oldest first.
#[derive(Default)]
struct Asked {
    queries: VecDeque<Query>,
    /// A worker answers, or is about to.
    is_at_work: bool,
}

impl Answering {
    /// Notes a query. Returns `true` if a worker is needed.
    fn note(&self, query: Query) -> bool {
        let mut asked = lock(&self.asked);
        if asked.queries.len() >= ANSWERS_MAX {
            tracing::debug!("a late joiner gets no history: too many ask for it");
            return false;
        }
        asked.queries.push_back(query);
        !std::mem::replace(&mut asked.is_at_work, true)
    }

    /// Returns the next query, or ends the work.
    fn next(&self) -> Option<Query> {
        let mut asked = lock(&self.asked);
        let next = asked.queries.pop_front();
        asked.is_at_work = next.is_some();
        next
    }

    fn answer(&self, query: &Query) {
        let selected = lock(&self.history).select(&Wanted::read(query.parameters()));
        for Kept { payload, attachment, timestamp, number } in selected {
            let source = self.source.map(|publisher| SourceInfo::new(publisher, number));
            let reply = query.reply(self.key.as_str(), payload).attachment(attachment.encode());
            if let Err(error) = reply.timestamp(timestamp).source_info(source).wait() {
                tracing::debug!(%error, "a late joiner did not get its history");
                return;
            }
        }
    }
}

impl Work for Answering {
    fn run(self: Arc<Self>) {
        // A query that is dropped is answered.
        while let Some(query) = self.next() {
            self.answer(&query);
        }
    }
}

#[cfg(test)]
mod tests {
    use std::str::FromStr as _;

    use sgc_zenoh::Gid;

    use super::*;

    fn attachment() -> Attachment {
        Attachment { sequence: 1, source_timestamp_ns: 0, gid: Gid([0; 16]) }
    }

    fn early(bytes: usize) -> Early {
        Early { payload: vec![0; bytes].into(), source_timestamp_ns: 0 }
    }

    fn history(depth: usize, bytes: impl IntoIterator<Item = usize>) -> LateHistory {
        let mut history = LateHistory::new(depth);
        let time = Timestamp::from_str("7386690599959157260/33").unwrap();
        for bytes in bytes {
            history.push(vec![0; bytes].into(), attachment(), time);
        }
        history
    }

    fn asked(history: &LateHistory, query: &str) -> Vec<u32> {
        let wanted = Wanted::read(&Parameters::from(query.to_owned()));
        history.select(&wanted).iter().map(|kept| kept.number).collect()
    }

    #[test]
    fn queries_get_the_newest_samples_in_their_order() {
        let history = history(5, [4; 10]);
        for (query, numbers) in [
            ("", vec![5, 6, 7, 8, 9]),
            ("_max=2", vec![8, 9]),
            ("_max=0", vec![]),
            ("_sn=6..7", vec![6, 7]),
            ("_sn=8..", vec![8, 9]),
            ("_sn=..6", vec![5, 6]),
            ("_sn=7", vec![7]),
            ("_sn=..", vec![5, 6, 7, 8, 9]),
            ("_sn=9..8", vec![]),
            ("_sn=5..9;_max=1", vec![9]),
            ("_max=x;_sn=y", vec![5, 6, 7, 8, 9]),
            ("_time=[now(s)..]", vec![5, 6, 7, 8, 9]),
        ] {
            assert_eq!(asked(&history, query), numbers, "{query}");
        }
    }

    #[test]
    fn samples_are_bounded_by_depth_and_bytes() {
        assert_eq!(asked(&history(usize::MAX, [4; LATE_MAX + 1]), "").len(), LATE_MAX);
        assert_eq!(asked(&history(0, [4; 3]), ""), [2]);
        let half = LATE_BYTES_MAX / 2;
        assert_eq!(asked(&history(9, [half, half, 4]), ""), [1, 2]);
        assert_eq!(asked(&history(9, [4, LATE_BYTES_MAX + 1]), ""), [1]);
        let mut deep = history(9, [4; 9]);
        deep.reduce_depth(3);
        assert_eq!((asked(&deep, ""), deep.bytes), (vec![6, 7, 8], 12));
        deep.reduce_depth(9);
        deep.push(vec![0; 4].into(), attachment(), deep.samples[0].timestamp);
        assert_eq!(asked(&deep, ""), [7, 8, 9]);
    }

    #[test]
    fn samples_wait_for_a_publisher_and_move_to_the_next_one() {
        let lengths = |history: &mut LateHistory| {
            std::iter::from_fn(|| history.take_early()).map(|sample| sample.payload.len()).collect::<Vec<_>>()
        };
        let mut history = history(3, [1, 2]);
        history.push_early(early(3));
        history.push_early(early(4));
        assert_eq!((asked(&history, ""), history.bytes), (vec![1], 9), "the oldest has given way");
        history.restart();
        assert_eq!((asked(&history, ""), history.bytes), (vec![], 9));
        assert_eq!((lengths(&mut history), history.bytes), (vec![2, 3, 4], 0));
        (5..9).for_each(|bytes| history.push_early(early(bytes)));
        assert_eq!(lengths(&mut history), [6, 7, 8]);
        let time = Timestamp::from_str("7386690599959157260/33").unwrap();
        history.push(vec![0].into(), attachment(), time);
        assert_eq!(asked(&history, ""), [0], "numbers begin anew");
    }
}
