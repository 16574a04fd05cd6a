//! [`Sinks`]: this node's ends of the names that it receives, with their timers: histories that make no progress, and
//! keys of past epochs.

use std::collections::HashMap;
use std::sync::Arc;
use std::time::Instant;

use sgc_endpoint::AskAgain;
use sgc_wire::{Name, SinkId, SourceId, TopicGrant};
use tokio::sync::mpsc;

use crate::control::parts::sink_timers::SinkTimers;
use crate::data::dataplane::DataPlane;
use crate::data::sinks::{LocalSink, SinkRequest};

/// Effect: a source is asked for all its messages from a number on.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) struct HistoryRequest {
    pub(crate) name: Name,
    pub(crate) source: SourceId,
    pub(crate) from: u64,
}

/// The names that this node receives.
pub(crate) struct Sinks {
    sinks: HashMap<Name, Arc<LocalSink>>,
    timers: SinkTimers,
    requests: mpsc::Sender<SinkRequest>,
    data: Arc<DataPlane>,
}

impl Sinks {
    /// Creates the part without sinks. The sinks send their requests to `requests`.
    pub(crate) fn new(requests: mpsc::Sender<SinkRequest>, data: Arc<DataPlane>) -> Self {
        Self { sinks: HashMap::new(), timers: SinkTimers::default(), requests, data }
    }

    /// Adds a sink without a grant. It replaces another one of the name.
    pub(crate) fn add(&mut self, name: Name, transient_local: bool) -> Arc<LocalSink> {
        let (requests, holds) = (self.requests.clone(), self.data.holds().clone());
        let sink = Arc::new(LocalSink::new(name, transient_local, requests, holds));
        self.sinks.insert(name, sink.clone());
        sink
    }

    /// Returns the sink of our own share, which takes the messages of other publishers. Adds it if there is none.
    pub(crate) fn get_or_add_own(&mut self, name: Name) -> Arc<LocalSink> {
        match self.sinks.get(&name) {
            Some(sink) => sink.clone(),
            None => self.add(name, false),
        }
    }

    /// Closes and removes a sink, and ends its timers.
    pub(crate) fn remove(&mut self, name: &Name) {
        if let Some(sink) = self.sinks.remove(name) {
            sink.close();
        }
        self.timers.forget(name);
    }

    /// Closes all sinks. They stay, and take nothing.
    pub(crate) fn close(&self) {
        self.sinks.values().for_each(|sink| sink.close());
    }

    pub(crate) fn get(&self, name: &Name) -> Option<&Arc<LocalSink>> {
        self.sinks.get(name)
    }

    pub(crate) fn iter(&self) -> impl Iterator<Item = (&Name, &Arc<LocalSink>)> {
        self.sinks.iter()
    }

    /// Passes a grant to the sink of a name. Keys of past epochs stay for a while.
    pub(crate) fn grant(&mut self, now: Instant, name: Name, id: SinkId, grant: TopicGrant) {
        if let Some(sink) = self.sinks.get(&name) {
            sink.grant(id, grant, &self.data);
            self.timers.epoch_ended(name, now);
        }
    }

    /// Removes the writer of a source, whose history is no longer wanted.
    pub(crate) fn writer_closed(&mut self, name: Name, source: Option<SourceId>) {
        if let Some(source) = source {
            self.timers.history_ended(name, source);
        }
        if let Some(sink) = self.sinks.get(&name) {
            sink.set_writer(source, None, &self.data);
        }
    }

    /// Moves a writer to another source of the same publisher. Returns `false` if there is none.
    pub(crate) fn move_writer(&mut self, name: Name, from: SourceId, to: SourceId) -> bool {
        self.timers.history_ended(name, from);
        self.sinks.get(&name).is_some_and(|sink| sink.move_writer(from, to))
    }

    /// Returns a request for the messages that the writer of a source lacks.
    pub(crate) fn ask(&mut self, now: Instant, name: Name, source: SourceId) -> Option<HistoryRequest> {
        let from = self.sinks.get(&name).and_then(|sink| sink.ask(source));
        self.request(now, name, source, from.map_or(AskAgain::No, AskAgain::From))
    }

    /// Returns requests for all messages that the writers of a name lack.
    pub(crate) fn ask_all(&mut self, now: Instant, name: Name) -> Vec<HistoryRequest> {
        let unsynced = self.sinks.get(&name).map(|sink| sink.unsynced()).unwrap_or_default();
        unsynced.into_iter().filter_map(|source| self.ask(now, name, source)).collect()
    }

    /// Ends the wait for a history, which has arrived.
    pub(crate) fn history_arrived(&mut self, name: Name, source: SourceId) {
        self.timers.history_ended(name, source);
    }

    /// Returns requests for histories that make no progress, and drops the keys of past epochs.
    pub(crate) fn handle_timeout(&mut self, now: Instant) -> Vec<HistoryRequest> {
        for name in self.timers.take_epochs(now) {
            if let Some(sink) = self.sinks.get(&name) {
                sink.retire_epochs();
            }
        }
        let due = self.timers.take_histories(now).into_iter();
        let again = due.filter_map(|(name, source)| {
            let again = self.sinks.get(&name).map_or(AskAgain::No, |sink| sink.ask_again(source));
            self.request(now, name, source, again)
        });
        again.collect()
    }

    fn request(
        &mut self,
        now: Instant,
        name: Name,
        source: SourceId,
        ask: AskAgain,
    ) -> Option<HistoryRequest> {
        let request = match ask {
            AskAgain::No => return None,
            AskAgain::Wait => None,
            AskAgain::From(from) => Some(HistoryRequest { name, source, from }),
        };
        self.timers.history_asked(name, source, now);
        request
    }

    /// Returns the time of the next timer.
    pub(crate) fn deadline(&self) -> Option<Instant> {
        self.timers.deadline()
    }
}

#[cfg(test)]
mod tests {
    use std::time::Duration;

    use bytes::Bytes;
    use sgc_trust::Suite;
    use sgc_wire::{SecretBytes, SourceAnnounce};

    use super::*;
    use crate::data::writer_queue::tests::taking;

    const NAME: Name = Name([1; 32]);
    const SOURCE: SourceId = SourceId([2; 16]);

    /// Returns sinks with one that lacks the history of a source, and the inbox of their requests.
    fn sinks() -> (Sinks, mpsc::Receiver<SinkRequest>) {
        let (requests, requested) = mpsc::channel(1);
        let mut sinks = Sinks::new(requests, Arc::default());
        let sink = sinks.add(NAME, true);
        sink.set_writer(Some(SOURCE), Some(taking(|_, _| ())), &sinks.data);
        let announce = SourceAnnounce { source: SOURCE, key: Bytes::new(), oldest: 3, next: 9, recover: 0 };
        let (suite, key) = (Suite::Group.id(), SecretBytes::new([3; 32]));
        let grant = TopicGrant { epoch: 1, suite, key, receiver: None, sources: vec![announce], entry: None };
        sinks.grant(Instant::now(), NAME, SinkId([4; 16]), grant);
        (sinks, requested)
    }

    #[tokio::test]
    async fn history_without_progress_is_asked_for_again_until_it_arrives() {
        let (mut sinks, _requested) = sinks();
        let begin = Instant::now();
        let at = |seconds| begin + Duration::from_secs(seconds);
        let asked = sinks.ask_all(at(0), NAME);
        assert!(matches!(asked[..], [HistoryRequest { name: NAME, source: SOURCE, .. }]), "{asked:?}");
        assert_eq!(sinks.handle_timeout(at(1)), []);
        assert_eq!(sinks.handle_timeout(at(3)), asked);
        assert_eq!(sinks.handle_timeout(at(6)), asked);
        sinks.history_arrived(NAME, SOURCE);
        assert_eq!(sinks.handle_timeout(at(60)), []);
        assert_eq!(sinks.deadline(), None);
    }

    #[tokio::test]
    async fn history_for_a_closed_writer_or_a_removed_sink_is_not_asked_for() {
        let (mut closed, _requested) = sinks();
        assert!(closed.ask(Instant::now(), NAME, SOURCE).is_some());
        closed.writer_closed(NAME, Some(SOURCE));
        assert_eq!(closed.ask(Instant::now(), NAME, SOURCE), None);
        assert_eq!(closed.handle_timeout(Instant::now() + Duration::from_secs(60)), []);
        let (mut removed, _requested) = sinks();
        assert!(removed.ask(Instant::now(), NAME, SOURCE).is_some());
        removed.remove(&NAME);
        assert_eq!(removed.deadline(), None);
        assert_eq!(removed.ask(Instant::now(), NAME, SOURCE), None);
    }
}
