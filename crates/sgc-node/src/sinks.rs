//! This node's own subscribers: packets in, samples on the local network out.
//!
//! [`LocalSink::deliver`] opens packets on the task that received them. Writing may block, so each local
//! writer has a thread, behind a bounded queue.

use std::collections::BTreeMap;
use std::sync::atomic::{AtomicU64, Ordering::Relaxed};
use std::sync::{Arc, Mutex, PoisonError};
use std::thread;
use std::time::Duration;

use arc_swap::ArcSwap;
use sgc_endpoint::{AskAgain, Delivery, Message, Sink, SinkDrop, SinkLimits, SinkProgress};
use sgc_ros::{RosError, RosWriter, SampleKind};
use sgc_router::LinkId;
use sgc_wire::{MessageKind, Name, Packet, SinkId, SourceId, TopicGrant};
use tokio::sync::mpsc;
use tracing::{debug, warn};

use crate::dataplane::DataPlane;
use crate::queue::Queue;
use crate::stats::{DataDrop, Drops};

/// Messages that may wait for one local writer.
const WRITER_MESSAGES_MAX: usize = 1024;
/// Bytes that may wait for one local writer.
const WRITER_BYTES_MAX: usize = 64 << 20;
/// How long the network is held back by a local writer that takes nothing.
const WRITER_PATIENCE: Duration = Duration::from_secs(5);

/// What a sink asks of the control task.
#[derive(Clone, Copy, Debug)]
pub(crate) enum SinkRequest {
    /// Ask a source for what is missing.
    History(Name, SourceId),
    /// It is here.
    Synced(Name, SourceId),
}

#[derive(Default)]
struct State {
    sink: Option<Sink>,
    /// Messages, one or several that waited for a grant, that are not written yet.
    releases: u32,
    /// True if something that can be asked for again was not taken, for want of a writer.
    missed: bool,
}

/// A joined name's end at this node.
pub(crate) struct LocalSink {
    name: Name,
    transient_local: bool,
    state: Mutex<State>,
    /// Held while messages are written that waited for a grant, or for their writer: what comes after them is written
    /// after them.
    releasing: Arc<tokio::sync::Mutex<()>>,
    writers: ArcSwap<BTreeMap<Option<SourceId>, Arc<WriterQueue>>>,
    requests: mpsc::Sender<SinkRequest>,
    delivered: AtomicU64,
}

impl LocalSink {
    /// A sink without a grant.
    pub(crate) fn new(name: Name, transient_local: bool, requests: mpsc::Sender<SinkRequest>) -> Self {
        Self {
            name,
            transient_local,
            state: Mutex::default(),
            releasing: Arc::default(),
            writers: ArcSwap::default(),
            requests,
            delivered: AtomicU64::new(0),
        }
    }

    /// Takes a grant. Packets that waited for it are written by a task of their own, since that may take a
    /// while.
    pub(crate) fn grant(self: &Arc<Self>, id: SinkId, grant: TopicGrant, data: &Arc<DataPlane>) {
        let mut released = Vec::new();
        let turn = {
            let mut state = self.lock();
            match &mut state.sink {
                Some(sink) => sink.regrant(id, grant, |result| released.push(result)),
                sink => {
                    let limits = SinkLimits::default();
                    *sink = Some(Sink::new(self.name, id, grant, self.transient_local, limits));
                }
            }
            if released.is_empty() {
                return;
            }
            state.releases += 1;
            self.releasing.clone().try_lock_owned().ok()
        };
        let (this, data) = (self.clone(), data.clone());
        tokio::spawn(async move {
            let releasing = Releasing(&this);
            let turn = match turn {
                Some(turn) => turn,
                None => this.releasing.clone().lock_owned().await,
            };
            for result in released {
                if let Some((reason, _)) = this.finish(result, data.drops()).await {
                    data.count(LinkId::LOCAL, &this.name, reason);
                }
            }
            drop(releasing);
            drop(turn);
        });
    }

    /// How far it is with each source; `None` before the first grant.
    pub(crate) fn progress(&self) -> Option<Arc<SinkProgress>> {
        self.lock().sink.as_ref().map(Sink::progress)
    }

    /// Drops the keys of all epochs but the present one.
    pub(crate) fn retire_epochs(&self) {
        if let Some(sink) = &mut self.lock().sink {
            sink.retire_epochs();
        }
    }

    /// Sources with a writer here of which something is missing.
    pub(crate) fn unsynced(&self) -> Vec<SourceId> {
        let state = self.lock();
        let sources = state.sink.iter().flat_map(Sink::unsynced);
        sources.filter(|source| self.has_writer(source)).collect()
    }

    /// From which number on a source is to be asked for what is missing.
    pub(crate) fn ask(&self, source: SourceId) -> Option<u64> {
        // What came would go nowhere; it is asked for when there is a writer.
        self.has_writer(&source).then(|| self.lock().sink.as_mut()?.ask(source)).flatten()
    }

    /// The same, some time after it was asked.
    pub(crate) fn ask_again(&self, source: SourceId) -> AskAgain {
        if !self.has_writer(&source) {
            return AskAgain::No;
        }
        self.lock().sink.as_mut().map_or(AskAgain::No, |sink| sink.ask_again(source))
    }

    /// Adds, replaces or removes a writer; the old one ends after what is queued.
    pub(crate) fn set_writer(&self, source: Option<SourceId>, writer: Option<Arc<WriterQueue>>) {
        let mut writers = BTreeMap::clone(&self.writers.load());
        let old = match writer {
            Some(writer) => writers.insert(source, writer),
            None => {
                if let (Some(source), Some(sink)) = (source, &mut self.lock().sink) {
                    sink.forget(&source);
                }
                writers.remove(&source)
            }
        };
        let opened = writers.contains_key(&source);
        self.writers.store(Arc::new(writers));
        if opened {
            let state = &mut *self.lock();
            if let (Some(sink), true) = (&mut state.sink, std::mem::take(&mut state.missed)) {
                sink.suspect();
            }
        }
        if let Some(old) = old {
            old.queue.close();
        }
    }

    /// Ends all writers after what is queued.
    pub(crate) fn close(&self) {
        self.writers.load().values().for_each(|w| w.close());
    }

    /// Messages given to the local network.
    pub(crate) fn delivered(&self) -> u64 {
        self.delivered.load(Relaxed)
    }

    /// Takes a packet; says what was dropped. Waits while a reliable topic's local writer is full.
    pub(crate) async fn deliver(&self, packet: Packet, drops: &Drops) -> Option<(DataDrop, u64)> {
        let (result, behind, turn) = {
            let mut state = self.lock();
            let State { sink, releases, missed } = &mut *state;
            let Some(sink) = sink else { return Some((DataDrop::NotGranted, 1)) };
            let source = packet.header.source;
            if !self.has_writer(&source) && sink.recovers(&source) {
                *missed = true;
                return Some((DataDrop::NoWriter, 1));
            }
            let behind = *releases > 0;
            match sink.handle_packet(&packet) {
                // Under the lock, so that what comes over two links at once is written in the order of its numbers.
                Ok(Delivery::Message(message)) if !behind => match self.write_now(message) {
                    Ok(dropped) => return dropped,
                    Err(message) => {
                        *releases += 1;
                        let turn = (Releasing(self), self.releasing.clone().try_lock_owned().ok());
                        (Ok(Delivery::Message(message)), false, Some(turn))
                    }
                },
                result => (result, behind, None),
            }
        };
        let _turn = match turn {
            Some((releasing, Some(turn))) => Some((Some(releasing), turn)),
            Some((releasing, None)) => Some((Some(releasing), self.releasing.clone().lock_owned().await)),
            None if behind => Some((None, self.releasing.clone().lock_owned().await)),
            None => None,
        };
        self.finish(result, drops).await
    }

    /// Does what a packet came to.
    async fn finish(&self, result: Result<Delivery, SinkDrop>, drops: &Drops) -> Option<(DataDrop, u64)> {
        match result {
            Ok(Delivery::Incomplete | Delivery::Mark | Delivery::Parked) => None,
            Ok(Delivery::Message(message)) => self.write(message).await,
            Ok(Delivery::NeedsHistory(source)) => {
                let _ = self.requests.send(SinkRequest::History(self.name, source)).await;
                None
            }
            Ok(Delivery::Synced(source)) => {
                let _ = self.requests.send(SinkRequest::Synced(self.name, source)).await;
                None
            }
            Ok(Delivery::Lost(_, messages)) => {
                debug!(name = %self.name.short(), messages, "lost for good");
                if drops.add("sink_lost", messages) {
                    warn!(messages, "a source keeps no more what was lost on the way; counted from here on");
                }
                Some((DataDrop::Sink, messages))
            }
            Err(error) => {
                debug!(name = %self.name.short(), %error, "packet refused");
                drops.count(error.key());
                Some((DataDrop::Sink, 1))
            }
        }
    }

    async fn write(&self, message: Message) -> Option<(DataDrop, u64)> {
        let message = match self.write_now(message) {
            Ok(dropped) => return dropped,
            Err(message) => message,
        };
        let Some(writer) = self.writer(&message.source) else { return Some((DataDrop::NoWriter, 1)) };
        let bytes = message.payload.len();
        self.delivered.fetch_add(1, Relaxed);
        match writer.queue.push(message, bytes, WRITER_BYTES_MAX, WRITER_PATIENCE).await {
            Ok(()) => None,
            Err(_) => Some((DataDrop::Stalled, 1)),
        }
    }

    /// Queues a message for its writer and says what was dropped; gives it back if it has to wait for room.
    fn write_now(&self, message: Message) -> Result<Option<(DataDrop, u64)>, Message> {
        let Some(writer) = self.writer(&message.source) else { return Ok(Some((DataDrop::NoWriter, 1))) };
        let bytes = message.payload.len();
        let mut evicted = 0;
        if message.reliable {
            writer.queue.try_push(message, bytes, WRITER_BYTES_MAX)?;
        } else {
            writer.queue.push_evicting(message, bytes, WRITER_BYTES_MAX, |_| evicted += 1);
        }
        self.delivered.fetch_add(1, Relaxed);
        Ok((evicted > 0).then_some((DataDrop::Stale, evicted)))
    }

    fn has_writer(&self, source: &SourceId) -> bool {
        let writers = self.writers.load();
        writers.contains_key(&Some(*source)) || writers.contains_key(&None)
    }

    /// The writer for a source's messages.
    fn writer(&self, source: &SourceId) -> Option<Arc<WriterQueue>> {
        let writers = self.writers.load();
        writers.get(&Some(*source)).or_else(|| writers.get(&None)).cloned()
    }

    fn lock(&self) -> std::sync::MutexGuard<'_, State> {
        self.state.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

/// Counts a release that is under way; the count holds whatever becomes of who waits.
struct Releasing<'a>(&'a LocalSink);

impl Drop for Releasing<'_> {
    fn drop(&mut self) {
        self.0.lock().releases -= 1;
    }
}

/// The queue before a local writer's thread.
pub(crate) struct WriterQueue {
    queue: Queue<Message>,
}

impl WriterQueue {
    /// Starts the thread; it ends, and the writer with it, once the queue is closed and empty.
    pub(crate) fn spawn<W: RosWriter>(
        writer: W,
        topic: String,
        failures: Arc<Drops>,
        alive: mpsc::Sender<()>,
    ) -> std::io::Result<Arc<Self>> {
        let this = Arc::new(Self { queue: Queue::new(WRITER_MESSAGES_MAX) });
        let (task, runtime) = (this.clone(), tokio::runtime::Handle::current());
        thread::Builder::new().name("sgc-write".into()).spawn(move || {
            let _alive = alive;
            while let Some(message) = runtime.block_on(task.queue.pop()) {
                let kind = match message.head.kind {
                    MessageKind::Write => SampleKind::Write,
                    MessageKind::Dispose => SampleKind::Dispose,
                    MessageKind::Unregister => SampleKind::Unregister,
                    MessageKind::Synced | MessageKind::Mark => continue,
                };
                if let Err(error) = writer.write(kind, message.head.source_timestamp_ns, message.payload)
                    && failures.count(failure_key(&error))
                {
                    warn!(%topic, %error, "a message could not be given to the local network; counted from here on");
                }
            }
        })?;
        Ok(this)
    }

    /// Ends the thread after what is queued.
    pub(crate) fn close(&self) {
        self.queue.close();
    }
}

fn failure_key(error: &RosError) -> &'static str {
    match error {
        RosError::Payload { .. } => "write_payload",
        RosError::WriteTimeout { .. } => "write_timeout",
        _ => "write_failed",
    }
}
