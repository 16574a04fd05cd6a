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
use sgc_endpoint::{Delivery, Message, Sink, SinkDrop, SinkLimits, SinkProgress};
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
    /// Ask for a source's history.
    History(Name, SourceId),
    /// It is here.
    Synced(Name, SourceId),
}

#[derive(Default)]
struct State {
    sink: Option<Sink>,
    /// Releases that are not written yet.
    releases: u32,
}

/// A joined name's end at this node.
pub(crate) struct LocalSink {
    name: Name,
    transient_local: bool,
    state: Mutex<State>,
    /// Held while messages are written that waited for a grant: what comes after them is written after them.
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
            let turn = match turn {
                Some(turn) => turn,
                None => this.releasing.clone().lock_owned().await,
            };
            for result in released {
                if let Some((reason, _)) = this.finish(result, data.drops()).await {
                    data.count(LinkId::LOCAL, &this.name, reason);
                }
            }
            this.lock().releases -= 1;
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

    /// Sources with a writer here whose history must be asked for.
    pub(crate) fn unsynced(&self) -> Vec<SourceId> {
        let writers = self.writers.load();
        let mut state = self.lock();
        let Some(sink) = &mut state.sink else { return Vec::new() };
        writers.keys().flatten().copied().filter(|source| sink.expect(*source)).collect()
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
        self.writers.store(Arc::new(writers));
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
        let (result, behind) = {
            let mut state = self.lock();
            let Some(sink) = &mut state.sink else { return Some((DataDrop::NotGranted, 1)) };
            (sink.handle_packet(&packet), state.releases > 0)
        };
        if behind {
            drop(self.releasing.lock().await);
        }
        self.finish(result, drops).await
    }

    /// Does what a packet came to.
    async fn finish(&self, result: Result<Delivery, SinkDrop>, drops: &Drops) -> Option<(DataDrop, u64)> {
        match result {
            Ok(Delivery::Incomplete | Delivery::Parked) => None,
            Ok(Delivery::Message(message)) => self.write(message).await,
            Ok(Delivery::NeedsHistory(source)) => {
                // If the control task is busy, the next packet or the retry timer asks again.
                let _ = self.requests.try_send(SinkRequest::History(self.name, source));
                None
            }
            Ok(Delivery::Synced(source)) => {
                let _ = self.requests.send(SinkRequest::Synced(self.name, source)).await;
                None
            }
            Err(error) => {
                debug!(name = %self.name.short(), %error, "packet refused");
                drops.count(error.key());
                Some((DataDrop::Sink, 1))
            }
        }
    }

    async fn write(&self, message: Message) -> Option<(DataDrop, u64)> {
        let writer = {
            let writers = self.writers.load();
            writers.get(&Some(message.source)).or_else(|| writers.get(&None)).cloned()
        };
        let Some(writer) = writer else { return Some((DataDrop::NoWriter, 1)) };
        self.delivered.fetch_add(1, Relaxed);
        let bytes = message.payload.len();
        if message.reliable {
            match writer.queue.push(message, bytes, WRITER_BYTES_MAX, WRITER_PATIENCE).await {
                Ok(()) => None,
                Err(_) => Some((DataDrop::Stalled, 1)),
            }
        } else {
            let mut evicted = 0;
            writer.queue.push_evicting(message, bytes, WRITER_BYTES_MAX, |_| evicted += 1);
            (evicted > 0).then_some((DataDrop::Stale, evicted))
        }
    }

    fn lock(&self) -> std::sync::MutexGuard<'_, State> {
        self.state.lock().unwrap_or_else(PoisonError::into_inner)
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
                    MessageKind::Synced => continue,
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
