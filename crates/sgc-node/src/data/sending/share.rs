//! Local publishers: samples of the local network in, packets out.
//!
//! The thread of the local reader seals the samples and pushes the packets into the queues of the links. While the
//! queue of a reliable topic is full, only this thread waits, so other topics flow on. Samples that are ready together
//! share a signature; none waits for a later one.

use std::sync::atomic::Ordering::{Relaxed, SeqCst};
use std::sync::atomic::{AtomicBool, AtomicUsize, fence};
use std::sync::{Arc, Condvar, Mutex, MutexGuard, PoisonError, Weak};
use std::time::{Duration, Instant};

use arc_swap::ArcSwap;
use bytes::Bytes;
use sgc_endpoint::Source;
use sgc_ros::{Guid, Sample, SampleKind, Shaping};
use sgc_session::Shaper;
use sgc_sync::lock;
use sgc_wire::{MessageHead, MessageKind, Name, PayloadEncoding, PayloadForm, Recover, SinkId, TopicGrant};
use tokio::runtime::Handle;
use tokio::sync::{Notify, mpsc};
use tracing::warn;

use crate::clock::unix_ns;
use crate::data::conversion::KnownType;
use crate::data::dataplane::DataPlane;
use crate::data::pending::PendingQueue;
use crate::data::sending::emit::EmitStage;
use crate::data::sending::encode::{EncodeStage, EncodedPayload};
use crate::data::sending::manual_lease::ASSERTION_LOOK_MAX;
use crate::data::sending::seal::{self, Destination, SealStage};
use crate::data::sending::source_map::{SourceChoice, SourceMap, SourceSlot};
use crate::data::stats::{DataDrop, Dropped};
use crate::data::tap::{TapMessage, Taps};

/// Whether a message exceeds the largest size that SGC carries.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum IsTooLarge {
    /// The message is too large and is never sent.
    Yes,
    /// The message was sent, or may be sent later.
    No,
}

/// Samples that may wait until their writer is discovered or their type is known.
pub(crate) const EARLY_SAMPLES_MAX: usize = 256;

/// The longest message that the reader's thread sends by itself if no other follows.
pub(crate) const AT_HAND_BYTES_MAX: usize = 16 << 10;

/// State of shaping: the sample that waits for its time.
#[derive(Default)]
struct DelayedSample {
    shaper: Shaper,
    /// The newest waiting sample.
    sample: Option<Sample>,
    /// Whether a task will publish it.
    is_timed: bool,
}

/// Samples and sources that wait.
struct Inbox {
    /// Samples without a source or a type. DDS may deliver a late joiner's history before it discovers the writer, and
    /// samples to convert to JSON wait for their type.
    early: PendingQueue<Sample>,
    /// Sources that expect more messages and keep an unfinished batch.
    open: Vec<SourceSlot>,
}

/// This node's end of a topic that it shares or publishes on.
pub(crate) struct LocalShare {
    name: Name,
    runtime: Handle,
    alive: mpsc::Sender<()>,
    map: ArcSwap<SourceMap>,
    inbox: Mutex<Inbox>,
    encode: EncodeStage,
    seal: SealStage,
    emit: EmitStage,
    /// Whether shaping is configured, readable without the lock.
    is_shaped: AtomicBool,
    held: Mutex<DelayedSample>,
    /// Notified when the share closes, to wake a thread that waits for a sample's time.
    ended: Condvar,
    /// Whether the log has said that reliable messages do not age.
    aged: AtomicBool,
    /// Number of waiting samples. It is readable without the lock, which a blocked publisher holds.
    waiting: AtomicUsize,
    taps: Taps,
    /// Whether a task looks for liveliness assertions.
    is_watched: AtomicBool,
}

impl LocalShare {
    /// Returns the sources. [`Self::set_map`] replaces them as a whole.
    pub(crate) fn map(&self) -> Arc<SourceMap> {
        self.map.load_full()
    }

    /// Creates a share without sources.
    pub(crate) fn new(
        name: Name,
        data: Arc<DataPlane>,
        alive: mpsc::Sender<()>,
        epoch_messages_max: u64,
        over: Arc<Notify>,
    ) -> Self {
        let runtime = Handle::current();
        let early = PendingQueue::new(EARLY_SAMPLES_MAX, data.holds().clone());
        Self {
            name,
            encode: EncodeStage::new(name),
            seal: SealStage::new(epoch_messages_max, over),
            emit: EmitStage::new(name, data, runtime.clone()),
            runtime,
            alive,
            map: ArcSwap::default(),
            inbox: Mutex::new(Inbox { early, open: Vec::new() }),
            is_shaped: AtomicBool::new(false),
            held: Mutex::default(),
            ended: Condvar::new(),
            aged: AtomicBool::new(false),
            waiting: AtomicUsize::new(0),
            taps: Taps::default(),
            is_watched: AtomicBool::new(false),
        }
    }

    /// Sets the number of messages that a source keeps for late joiners.
    pub(crate) fn set_history_depth(&self, slot: &SourceSlot, depth: usize) {
        let source = slot.source.clone();
        self.run_blocking(move || lock(&source).set_history_depth(depth));
    }

    /// Returns the taps of published messages.
    pub(crate) fn taps(&self) -> &Taps {
        &self.taps
    }

    /// Sets the limits of rate, bandwidth and age.
    pub(crate) fn set_shaping(self: &Arc<Self>, shaping: Shaping) {
        lock(&self.held).shaper.set(shaping);
        let (compression, form) = (PayloadEncoding::Plain, PayloadForm::Cdr);
        let limits = Shaping { compression, form, ..shaping };
        self.is_shaped.store(limits != Shaping::default(), SeqCst);
        if self.encode.configure(shaping.compression, shaping.form) {
            // Samples that waited for conversion need none any more.
            self.publish_waiting();
        }
    }

    /// Sets the state of the type. Samples that waited for it are published or dropped.
    pub(crate) fn set_type(self: &Arc<Self>, known: KnownType) {
        self.encode.set_type(known);
        self.publish_waiting();
    }

    /// Returns the limits of rate, bandwidth and age.
    pub(crate) fn shaping(&self) -> Shaping {
        *lock(&self.held).shaper.shaping()
    }

    /// Publishes a sample, at once or when its time has come. The reader's thread calls it.
    pub(crate) fn publish(self: &Arc<Self>, sample: Sample) {
        // If more samples follow or the sample is long, the runtime sends packets while this thread seals.
        let is_alone = !sample.more && sample.payload.len() <= AT_HAND_BYTES_MAX;
        let _at_hand = is_alone.then(|| self.emit.begin_batch());
        if !self.is_shaped.load(Relaxed) {
            return self.publish_now(sample);
        }
        let ends_batch = !sample.more;
        match self.shape(sample) {
            Some(sample) => self.publish_now(sample),
            // The last sample of the batch is not published, so the earlier ones must leave now.
            None if ends_batch => self.flush(&mut lock(&self.inbox)),
            None => {}
        }
    }

    /// Publishes a sample if that needs no waiting, or returns it. Receive threads of several readers call it.
    pub(crate) fn publish_at_once(&self, sample: Sample) -> Option<Sample> {
        let is_short = sample.payload.len() <= AT_HAND_BYTES_MAX;
        let is_changed = self.is_shaped.load(Relaxed) || self.encode.is_active();
        if !is_short || is_changed || !self.emit.has_headroom() {
            return Some(sample);
        }
        // The woken tasks run after the locks are released.
        let _at_hand = self.emit.begin_batch();
        // The holder of the lock may be blocked.
        let Ok(inbox) = self.inbox.try_lock() else { return Some(sample) };
        if !inbox.early.is_empty() || !inbox.open.is_empty() {
            return Some(sample);
        }
        match self.choose(sample.writer) {
            SourceChoice::UnknownWriter => return Some(sample),
            SourceChoice::NoSource => self.emit.count(Dropped::one(DataDrop::NotGranted)),
            SourceChoice::Source(slot) => {
                let Ok(source) = slot.source.try_lock() else { return Some(sample) };
                if !self.emit.is_closed()
                    && let Err(dropped) = self.send(&slot, Some(source), sample, false)
                {
                    self.emit.count(dropped);
                }
            }
        }
        None
    }

    /// Returns a sample that may leave now, or holds it until its time comes or a newer one replaces it. Blocks with a
    /// sample that may be neither dropped nor overtaken.
    fn shape(self: &Arc<Self>, sample: Sample) -> Option<Sample> {
        let mut held = lock(&self.held);
        if sample.kind != SampleKind::Write {
            // The end of an instance follows its last sample and is never dropped.
            if let Some(before) = held.sample.take() {
                drop(held);
                self.publish_now(Sample { more: true, ..before });
            }
            return Some(sample);
        }
        let reliable = self.map.load().slots().any(|slot| slot.reliable);
        if held.shaper.shaping().max_age.is_some() && reliable {
            if !self.aged.swap(true, Relaxed) {
                let topic = self.name.short();
                warn!(%topic, "`max_age` is set for a topic that is reliable: none of its messages may be left out, and it has no effect");
            }
        } else if held.shaper.is_too_old(unix_ns(), sample.source_timestamp_ns) {
            self.emit.count(Dropped::one(DataDrop::TooOld));
            return None;
        }
        let mut now = Instant::now();
        while !held.shaper.is_due(now) && !self.emit.is_closed() {
            if held.shaper.gives_way(now, reliable) {
                if held.sample.replace(sample).is_some() {
                    self.emit.count(Dropped::one(DataDrop::Thinned));
                }
                if !std::mem::replace(&mut held.is_timed, true) {
                    self.runtime.spawn(let_go(Arc::downgrade(self)));
                }
                return None;
            }
            let wait = held.shaper.due().map_or(Duration::ZERO, |due| due.saturating_duration_since(now));
            held = self.ended.wait_timeout(held, wait).unwrap_or_else(PoisonError::into_inner).0;
            now = Instant::now();
        }
        if held.sample.take().is_some() {
            self.emit.count(Dropped::one(DataDrop::Thinned));
        }
        held.shaper.takes(now, sample.payload.len());
        Some(sample)
    }

    /// Returns the held sample if its time has come.
    fn take_held(&self) -> Option<Sample> {
        let mut held = lock(&self.held);
        let now = Instant::now();
        let sample = if held.shaper.is_due(now) { held.sample.take() } else { None }?;
        held.shaper.takes(now, sample.payload.len());
        Some(Sample { more: false, ..sample })
    }

    /// Publishes a sample without shaping.
    fn publish_now(&self, sample: Sample) {
        let more = sample.more;
        let mut inbox = lock(&self.inbox);
        self.publish_early(&mut inbox);
        if let Err(sample) = self.try_publish(sample, more, &mut inbox.open) {
            let reason = if self.encode.awaits_type() { DataDrop::NoDefinition } else { DataDrop::Stale };
            let given_up = inbox.early.push(Instant::now(), sample.payload.len(), sample);
            if given_up > 0 {
                self.emit.count_here(Dropped { reason, messages: given_up });
            }
            self.waiting.store(inbox.early.len(), SeqCst);
            // The source may have been added between the two checks. A later `set_map` sees the waiting sample.
            self.publish_early(&mut inbox);
        }
        if !more {
            self.flush(&mut inbox);
        }
    }

    /// Replaces the sources, and publishes samples that waited for them.
    pub(crate) fn set_map(self: &Arc<Self>, map: SourceMap) {
        self.map.store(Arc::new(map));
        self.publish_waiting();
    }

    /// Publishes samples that need not wait any more, on a blocking thread.
    fn publish_waiting(self: &Arc<Self>) {
        fence(SeqCst);
        if self.waiting.load(SeqCst) == 0 {
            return;
        }
        let (share, alive) = (self.clone(), self.alive.clone());
        self.runtime.spawn_blocking(move || {
            let _alive = alive;
            let mut inbox = lock(&share.inbox);
            share.publish_early(&mut inbox);
            share.flush(&mut inbox);
        });
    }

    /// Publishes in order the waiting samples whose writers have a source now. The caller flushes, or publishes more.
    fn publish_early(&self, inbox: &mut Inbox) {
        if inbox.early.is_empty() {
            return;
        }
        fence(SeqCst);
        let (now, mut late) = (Instant::now(), 0);
        if self.encode.awaits_type() {
            late = inbox.early.give_up_late(now, |sample| self.is_given_up(sample));
        } else {
            for mut held in inbox.early.take() {
                if held.is_late(now) && self.is_given_up(&held.item) {
                    late += 1;
                    continue;
                }
                if let Err(sample) = self.try_publish(held.item, true, &mut inbox.open) {
                    held.item = sample;
                    inbox.early.push_back(held);
                }
            }
        }
        if late > 0 {
            self.emit.count_here(Dropped { reason: DataDrop::NoDefinition, messages: late });
        }
        self.waiting.store(inbox.early.len(), SeqCst);
    }

    /// Returns `true` if a waiting sample is useless when late, because it is not kept for late joiners.
    fn is_given_up(&self, sample: &Sample) -> bool {
        self.encode.is_json()
            && sample.kind == SampleKind::Write
            && matches!(self.choose(sample.writer), SourceChoice::Source(slot) if !slot.keeps_history)
    }

    /// Publishes a sample, or returns it if its source or its type is unknown. With `more`, the source may keep an
    /// unfinished batch and is then in `open`.
    fn try_publish(&self, sample: Sample, more: bool, open: &mut Vec<SourceSlot>) -> Result<(), Sample> {
        let awaits_type = self.encode.awaits_type();
        match self.choose(sample.writer) {
            SourceChoice::UnknownWriter => return Err(sample),
            SourceChoice::Source(_) if awaits_type => return Err(sample),
            SourceChoice::NoSource => self.emit.count(Dropped::one(DataDrop::NotGranted)),
            SourceChoice::Source(slot) => {
                if self.emit.is_closed() {
                    return Ok(());
                }
                match self.send(&slot, None, sample, more) {
                    Ok(()) if more && open.iter().all(|o| o.id != slot.id) => open.push(slot),
                    Ok(()) => {}
                    Err(dropped) => self.emit.count(dropped),
                }
            }
        }
        Ok(())
    }

    /// Chooses the source for a sample of a writer.
    fn choose(&self, writer: Option<Guid>) -> SourceChoice {
        self.map.load().choose(writer)
    }

    /// Encodes, seals and emits a sample. Its source may be locked already. With `more`, the source may keep an
    /// unfinished batch.
    fn send(
        &self,
        slot: &SourceSlot,
        source: Option<MutexGuard<'_, Source>>,
        sample: Sample,
        more: bool,
    ) -> Result<(), Dropped> {
        let wanted = self.emit.is_wanted();
        if !wanted && !slot.keeps_history && !slot.progress.recovers() {
            return Err(Dropped::one(DataDrop::NoTree));
        }
        self.taps.offer(|| TapMessage::from_sample(&sample));
        let Sample { kind, source_timestamp_ns, key_hash, payload, .. } = sample;
        let EncodedPayload { form, encoding, payload } = if wanted || slot.keeps_history {
            let taken = payload.len();
            let encoded = self.encode.encode(kind, key_hash, payload)?;
            if kind == SampleKind::Write && self.is_shaped.load(Relaxed) {
                lock(&self.held).shaper.corrects(taken, encoded.payload.len());
            }
            encoded
        } else {
            EncodedPayload::unchanged(payload)
        };
        let kind = match kind {
            SampleKind::Write => MessageKind::Write,
            SampleKind::Dispose => MessageKind::Dispose,
            SampleKind::Unregister => MessageKind::Unregister,
        };
        let head = MessageHead { form, encoding, ..MessageHead::new(kind, source_timestamp_ns) };
        if let Some(manual) = slot.manual.as_ref().filter(|_| wanted) {
            manual.note_heard(Instant::now());
        }
        let to = if wanted { Destination::Everyone { more } } else { Destination::History };
        let source = source.unwrap_or_else(|| lock(&slot.source));
        self.seal.seal(slot, source, &head, payload, to, &self.emit)
    }

    /// Publishes a request or a reply. It has no effect while nobody would receive it. May block.
    pub(crate) fn publish_call(&self, head: &MessageHead, payload: Bytes, to: Option<SinkId>) -> IsTooLarge {
        let Some(slot) = self.map.load().shared.clone() else { return IsTooLarge::No };
        if self.emit.is_closed() || !self.emit.is_wanted() {
            return IsTooLarge::No;
        }
        let to = to.map_or(Destination::Everyone { more: false }, Destination::Sink);
        match self.seal.seal(&slot, lock(&slot.source), head, payload, to, &self.emit) {
            Ok(()) => IsTooLarge::No,
            Err(dropped) => {
                self.emit.count(dropped);
                if dropped.reason == DataDrop::TooLarge { IsTooLarge::Yes } else { IsTooLarge::No }
            }
        }
    }

    /// Counts samples that were dropped before they came to the share.
    pub(crate) fn count_here(&self, dropped: Dropped) {
        self.emit.count_here(dropped);
    }

    /// Returns the bytes before and after compression; `None` before the first message.
    pub(crate) fn compressed(&self) -> Option<(u64, u64)> {
        self.encode.compressed()
    }

    /// Finishes open batches, because no more messages follow.
    fn flush(&self, inbox: &mut Inbox) {
        for slot in inbox.open.drain(..) {
            seal::finish_batch(&slot, &self.emit);
        }
    }

    /// Publishes under the key of a new epoch from here on. A blocked publisher takes it up after its message.
    pub(crate) fn rekey(self: &Arc<Self>, grant: TopicGrant) {
        let share = self.clone();
        self.run_blocking(move || share.seal.rekey(&share.map.load(), &grant, &share.emit));
    }

    /// Returns `true` once per epoch, when a source has reached the message limit.
    pub(crate) fn is_epoch_over(&self) -> bool {
        self.seal.is_epoch_over()
    }

    /// Sends a sink the requested history, in order with new messages. Blocks until it is sent.
    pub(crate) fn replay(&self, recover: &Recover) {
        let Some(slot) = self.map.load().slot(&recover.source) else { return };
        let mut source = lock(&slot.source);
        if let Some(lifespan) = slot.lifespan {
            source.expire(unix_ns().saturating_sub(lifespan.as_nanos().try_into().unwrap_or(i64::MAX)));
        }
        source.replay(recover.sink, recover.from, recover.to, self.emit.requested_packets());
    }

    /// Returns `true` once if a task has to look for liveliness assertions ([`super::assertions::watch`]).
    pub(crate) fn begins_watch(&self) -> bool {
        self.map.load().assertions.is_some() && !self.is_watched.swap(true, SeqCst)
    }

    /// Passes on liveliness assertions of publishers without messages. Returns the wait until the next look; `None` if
    /// no such publisher is left.
    pub(crate) fn look_for_assertions(
        self: &Arc<Self>,
        now: Instant,
        renewed_ago: impl Fn(&Guid) -> Option<Duration>,
    ) -> Option<Duration> {
        if self.emit.is_closed() {
            return None;
        }
        let mut map = self.map();
        if map.assertions.is_none() {
            self.is_watched.store(false, SeqCst);
            // A publisher may have been added between the two checks.
            if !self.begins_watch() {
                return None;
            }
            map = self.map();
        }
        let manual =
            || map.own.iter().filter_map(|(writer, slot)| Some((writer, slot, slot.manual.as_ref()?)));
        let wait = manual().map(|(_, _, lease)| lease.look_every()).min().unwrap_or(ASSERTION_LOOK_MAX);
        if !self.emit.is_wanted() {
            return Some(wait);
        }
        let news = manual()
            .filter(|(writer, _, lease)| renewed_ago(writer).is_some_and(|ago| lease.is_news(now, ago)));
        let news: Vec<_> = news.map(|(_, slot, lease)| (slot.id.publisher(), lease.clone())).collect();
        if let Some(slot) = map.assertions.clone().filter(|_| !news.is_empty()) {
            let share = self.clone();
            self.run_blocking(move || {
                // The holder of the source is blocked.
                let Ok(mut source) = slot.source.try_lock() else { return };
                for (publisher, lease) in news {
                    if source.assert_publisher(publisher, share.emit.packets()).is_ok() {
                        lease.note_heard(now);
                    }
                }
            });
        }
        Some(wait)
    }

    /// Runs work that may block on a blocking thread.
    pub(crate) fn run_blocking(&self, work: impl FnOnce() + Send + 'static) {
        let alive = self.alive.clone();
        self.runtime.spawn_blocking(move || {
            let _alive = alive;
            work();
        });
    }

    /// Lets silent sources announce their last message. Returns `false` if none has to before the next message.
    pub(crate) fn look_for_silence(self: &Arc<Self>, now: Instant) -> bool {
        self.seal.look_for_silence(now, &self.map.load(), |slot| {
            if self.emit.is_wanted() {
                let (share, slot) = (self.clone(), slot.clone());
                self.run_blocking(move || {
                    // The holder of the source is about to publish.
                    if let Ok(mut source) = slot.source.try_lock() {
                        source.mark(share.emit.packets());
                    }
                });
            }
        })
    }

    /// Closes the share. A publishing reader's thread stops at the next packet.
    pub(crate) fn close(&self) {
        self.emit.close();
        self.taps.close();
        let _held = lock(&self.held);
        self.ended.notify_all();
    }

    /// Returns the number of signatures of its present sources, one for each batch.
    pub(crate) fn signatures(&self) -> u64 {
        self.map.load().slots().map(|slot| slot.progress.signatures()).sum()
    }

    /// Returns `true` if messages have to leave as JSON and their type is unknown.
    pub(crate) fn lacks_definition(&self) -> bool {
        self.encode.lacks_definition()
    }

    /// Returns the number of published messages.
    pub(crate) fn published(&self) -> u64 {
        self.seal.published()
    }
}

/// Publishes held samples when their time comes, until none is left.
async fn let_go(share: Weak<LocalShare>) {
    loop {
        let due = {
            let Some(share) = share.upgrade() else { return };
            let mut held = lock(&share.held);
            held.is_timed = held.sample.is_some() && !share.emit.is_closed();
            if !held.is_timed {
                return;
            }
            held.shaper.due()
        };
        if let Some(due) = due {
            tokio::time::sleep_until(due.into()).await;
        }
        let Some(share) = share.upgrade() else { return };
        let (runtime, alive) = (share.runtime.clone(), share.alive.clone());
        let publish = move || {
            let _alive = alive;
            if let Some(sample) = share.take_held() {
                share.publish_now(sample);
            }
        };
        // Publishing may block.
        let _ = runtime.spawn_blocking(publish).await;
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::data::sending::fixtures::{KNOWN, add_tree, map_of, sample, share, text_type, wait_until};
    use crate::data::stats::CountDrops;

    #[test]
    fn late_sample_is_dropped_unless_it_is_kept_for_late_joiners() {
        let runtime = tokio::runtime::Runtime::new().unwrap();
        let _inside = runtime.enter();
        let (data, share, mut slot) = share();
        add_tree(&data);
        let (layout, payload) = text_type();
        let sample = || Sample { payload: payload.clone(), ..sample(KNOWN, false) };
        share.set_shaping(Shaping { form: PayloadForm::Json, ..Shaping::default() });
        let lost = || data.drops().snapshot().get("no_definition").copied().unwrap_or_default();
        for keeps_history in [true, false] {
            slot.keeps_history = keeps_history;
            share.set_map(map_of(slot.clone()));
            share.set_type(KnownType::Asked);
            let long_ago = Instant::now().checked_sub(Duration::from_secs(60)).unwrap();
            lock(&share.inbox).early.push(long_ago, 1, sample());
            let (before, lost_before) = (share.published(), lost());
            share.publish(sample());
            share.set_type(KnownType::Known(layout.clone()));
            let left = if keeps_history { 2 } else { 1 };
            wait_until(|| share.published() == before + left);
            assert_eq!(lost(), lost_before + 2 - left);
        }
    }
}
