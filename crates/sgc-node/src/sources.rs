//! This node's own publishers: samples of the local network in, packets out.
//!
//! Samples are sealed on the thread of the local reader that took them and pushed straight into the queues of
//! the links: while a reliable one is full, that thread waits, and with it that topic alone.

use std::collections::{HashMap, VecDeque};
use std::sync::atomic::Ordering::{Relaxed, SeqCst};
use std::sync::atomic::{AtomicBool, AtomicU64, AtomicUsize, fence};
use std::sync::{Arc, Mutex, PoisonError};

use arc_swap::ArcSwap;
use sgc_endpoint::{PublishError, Source};
use sgc_ros::{Guid, Sample, SampleKind};
use sgc_router::LinkId;
use sgc_wire::{MessageHead, MessageKind, Name, Recover, SourceId};
use tokio::runtime::Handle;
use tokio::sync::{Semaphore, mpsc};

use crate::dataplane::DataPlane;
use crate::stats::DataDrop;

/// Histories that may be sent at once; a sink that comes too early asks again.
pub(crate) const REPLAYS_MAX: usize = 16;

/// Samples that may wait for their writer to be discovered.
const EARLY_SAMPLES_MAX: usize = 256;

/// A source and what it is for.
#[derive(Clone)]
pub(crate) struct SourceSlot {
    /// Its id.
    pub id: SourceId,
    /// The source; locked by the reader's thread for each message.
    pub source: Arc<Mutex<Source>>,
    /// True if late joiners may ask for its history.
    pub keeps_history: bool,
    /// True if its packets are reliable.
    pub reliable: bool,
}

/// Which source publishes for which writer.
#[derive(Default)]
pub(crate) struct SourceMap {
    /// For writers that have none of their own.
    pub shared: Option<SourceSlot>,
    /// True if each writer has a source of its own: a sample of a writer that is not listed yet waits until it is.
    pub(crate) per_writer: bool,
    /// By writer.
    pub own: HashMap<Guid, SourceSlot>,
}

impl SourceMap {
    /// The slot of a source, if it is of this map.
    pub(crate) fn slot(&self, id: &SourceId) -> Option<SourceSlot> {
        self.own.values().chain(&self.shared).find(|slot| slot.id == *id).cloned()
    }
}

/// A shared topic's end at this node.
pub(crate) struct LocalShare {
    name: Name,
    data: Arc<DataPlane>,
    runtime: Handle,
    alive: mpsc::Sender<()>,
    pub map: ArcSwap<SourceMap>,
    /// Samples of writers whose discovery is still under way: DDS may deliver a late joiner's history before it
    /// tells who wrote it.
    early: Mutex<VecDeque<Sample>>,
    /// How many those are, to be seen without the lock, which a publisher holds while it is pushed back.
    waiting: AtomicUsize,
    closed: AtomicBool,
    published: AtomicU64,
}

impl LocalShare {
    /// The sources; replaced as a whole by [`Self::set_map`].
    pub(crate) fn map(&self) -> Arc<SourceMap> {
        self.map.load_full()
    }

    /// A share without sources.
    pub(crate) fn new(name: Name, data: Arc<DataPlane>, alive: mpsc::Sender<()>) -> Self {
        Self {
            name,
            data,
            runtime: Handle::current(),
            alive,
            map: ArcSwap::default(),
            early: Mutex::default(),
            waiting: AtomicUsize::new(0),
            closed: AtomicBool::new(false),
            published: AtomicU64::new(0),
        }
    }

    /// Publishes a sample; called on the reader's thread.
    pub(crate) fn publish(&self, sample: Sample) {
        let mut early = self.early.lock().unwrap_or_else(PoisonError::into_inner);
        self.publish_early(&mut early);
        if let Err(sample) = self.try_publish(sample) {
            if early.len() >= EARLY_SAMPLES_MAX {
                early.pop_front();
                self.data.count(LinkId::LOCAL, &self.name, DataDrop::Stale);
            }
            early.push_back(sample);
            self.waiting.store(early.len(), SeqCst);
            // Its source may have come between the two looks; whoever puts a map in place after this one sees that
            // something waits.
            self.publish_early(&mut early);
        }
    }

    /// Puts new sources in place, and publishes what waited for them.
    pub(crate) fn set_map(self: &Arc<Self>, map: SourceMap) {
        self.map.store(Arc::new(map));
        fence(SeqCst);
        if self.waiting.load(SeqCst) == 0 {
            return;
        }
        let (share, alive) = (self.clone(), self.alive.clone());
        self.runtime.spawn_blocking(move || {
            let _alive = alive;
            let mut early = share.early.lock().unwrap_or_else(PoisonError::into_inner);
            share.publish_early(&mut early);
        });
    }

    /// Publishes, in their order, the samples whose writers have a source by now.
    fn publish_early(&self, early: &mut VecDeque<Sample>) {
        if early.is_empty() {
            return;
        }
        fence(SeqCst);
        for sample in std::mem::take(early) {
            early.extend(self.try_publish(sample).err());
        }
        self.waiting.store(early.len(), SeqCst);
    }

    /// Publishes a sample, or gives it back if its writer's source is not known yet.
    fn try_publish(&self, sample: Sample) -> Result<(), Sample> {
        if self.closed.load(Relaxed) {
            return Ok(());
        }
        let slot = {
            let map = self.map.load();
            match sample.writer.and_then(|w| map.own.get(&w)) {
                Some(slot) => Some(slot.clone()),
                None if map.per_writer && sample.writer.is_some() => return Err(sample),
                None => map.shared.clone(),
            }
        };
        match slot {
            None => self.data.count(LinkId::LOCAL, &self.name, DataDrop::NotGranted),
            Some(slot) if !slot.keeps_history && !self.data.is_wanted(&self.name) => {
                self.data.count(LinkId::LOCAL, &self.name, DataDrop::NoTree);
            }
            Some(slot) => self.seal_and_send(&slot, &sample),
        }
        Ok(())
    }

    fn seal_and_send(&self, slot: &SourceSlot, sample: &Sample) {
        let head = MessageHead {
            kind: match sample.kind {
                SampleKind::Write => MessageKind::Write,
                SampleKind::Dispose => MessageKind::Dispose,
                SampleKind::Unregister => MessageKind::Unregister,
            },
            source_timestamp_ns: sample.source_timestamp_ns,
        };
        let mut source = lock(&slot.source);
        // Fragments leave as they are sealed: a large message is under way before its end is read. A history
        // without anyone to get it stays here.
        let wanted = self.data.is_wanted(&self.name);
        let result = source.publish(&head, &sample.payload, |packet| {
            if wanted && !self.closed.load(Relaxed) {
                self.runtime.block_on(self.data.forward(LinkId::LOCAL, packet));
            }
        });
        match result {
            Ok(()) => {
                self.published.fetch_add(1, Relaxed);
            }
            Err(PublishError::TooLarge { .. }) => {
                self.data.count(LinkId::LOCAL, &self.name, DataDrop::TooLarge);
            }
        }
    }

    /// Sends a sink what it asks for, in order with what is published meanwhile.
    pub(crate) fn replay(self: &Arc<Self>, recover: Recover, permits: &Arc<Semaphore>) {
        let Some(slot) = self.map.load().slot(&recover.source) else { return };
        let Ok(permit) = permits.clone().try_acquire_owned() else { return };
        let (share, alive) = (self.clone(), self.alive.clone());
        self.runtime.spawn_blocking(move || {
            let _alive = alive;
            let source = lock(&slot.source);
            source.replay(recover.sink, recover.from, recover.to, |packet| {
                if !share.closed.load(Relaxed) {
                    share.runtime.block_on(share.data.forward(LinkId::LOCAL, packet));
                }
            });
            drop(permit);
        });
    }

    /// Ends it: a reader's thread that is publishing stops at the next packet.
    pub(crate) fn close(&self) {
        self.closed.store(true, Relaxed);
    }

    /// Messages published.
    pub(crate) fn published(&self) -> u64 {
        self.published.load(Relaxed)
    }
}

fn lock(source: &Mutex<Source>) -> std::sync::MutexGuard<'_, Source> {
    source.lock().unwrap_or_else(PoisonError::into_inner)
}
