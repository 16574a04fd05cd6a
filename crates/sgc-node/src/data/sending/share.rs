//! [`LocalShare`]: wires the stages that a sample passes from the local network to the links ([`super`]).
//!
//! A worker of the local reader seals the samples and pushes the packets into the queues of the links. While the
//! queue of a reliable topic is full, only this worker waits, so other topics flow on. Samples that are ready together
//! share a signature; none waits for a later one.

use std::collections::BTreeMap;
use std::sync::atomic::{AtomicBool, AtomicU64, Ordering::Relaxed, Ordering::SeqCst};
use std::sync::{Arc, MutexGuard, Weak};
use std::time::{Duration, Instant};

use arc_swap::ArcSwap;
use bytes::Bytes;
use sgc_endpoint::Source;
use sgc_ros::{Guid, Sample, SampleKind, Shaping};
use sgc_session::Wished;
use sgc_sync::lock;
use sgc_wire::{MessageHead, MessageKind, Name, Recover, SinkId, SourceId, TopicGrant};
use tokio::runtime::Handle;
use tokio::sync::{Notify, mpsc};

use crate::clock::unix_ns;
use crate::data::conversion::KnownType;
use crate::data::dataplane::DataPlane;
use crate::data::sending::emit::EmitStage;
use crate::data::sending::encode::{EncodeStage, EncodedPayload};
use crate::data::sending::hold::{Downstream, HoldStage, PassOutcome};
use crate::data::sending::manual_lease::ASSERTION_LOOK_MAX;
use crate::data::sending::seal::{self, Destination, SealStage};
use crate::data::sending::shape::{ShapeDecision, ShapeStage, Turn};
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

/// The longest message that the reader's worker sends by itself if no other follows.
pub(crate) const AT_HAND_BYTES_MAX: usize = 16 << 10;

/// This node's end of a topic that it shares or publishes on.
pub(crate) struct LocalShare {
    runtime: Handle,
    alive: mpsc::Sender<()>,
    map: ArcSwap<SourceMap>,
    shape: ShapeStage,
    hold: HoldStage,
    encode: EncodeStage,
    seal: SealStage,
    emit: EmitStage,
    taps: Taps,
    /// Whether a task looks for liveliness assertions.
    is_watched: AtomicBool,
    /// Whether the marks of a silence ask for confirmations.
    asks_in_marks: AtomicBool,
    /// Whether the reader's worker publishes a sample, or has another at hand.
    is_publishing: AtomicBool,
}

/// A source that has to announce its last message.
pub(crate) struct DueMark {
    share: Arc<LocalShare>,
    slot: SourceSlot,
    /// Whether it asks for confirmations.
    asks: bool,
}

impl DueMark {
    /// Publishes the marks. Those that need not wait for a link share a thread, because all topics of a program end at
    /// one moment, and may fall silent at one.
    pub(crate) fn publish_all(due: Vec<Self>) {
        let (ready, rest): (Vec<_>, Vec<_>) = due.into_iter().partition(|due| due.share.emit.has_headroom());
        if let Some(share) = ready.first().map(|due| due.share.clone()) {
            share.run_blocking(move || ready.iter().for_each(Self::publish));
        }
        for due in rest {
            let share = due.share.clone();
            share.run_blocking(move || due.publish());
        }
    }

    fn publish(&self) {
        // The holder of the source is about to publish, and marks are repeated.
        let Ok(mut source) = self.slot.source.try_lock() else { return };
        match self.asks {
            true => source.ask_for_confirmation(self.share.emit.packets()),
            false => source.mark(self.share.emit.packets()),
        }
    }
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
        epoch_messages_max: Arc<AtomicU64>,
        over: Arc<Notify>,
    ) -> Self {
        let runtime = Handle::current();
        Self {
            shape: ShapeStage::new(name),
            hold: HoldStage::new(data.holds().clone()),
            encode: EncodeStage::new(name),
            seal: SealStage::new(epoch_messages_max, over),
            emit: EmitStage::new(name, data, runtime.clone()),
            runtime,
            alive,
            map: ArcSwap::default(),
            taps: Taps::default(),
            is_watched: AtomicBool::new(false),
            asks_in_marks: AtomicBool::new(false),
            is_publishing: AtomicBool::new(false),
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
        self.shape.configure(shaping);
        if self.encode.configure(shaping.compression, shaping.form) {
            // Samples that waited for conversion need none any more.
            self.publish_waiting();
        }
    }

    /// Sets what the subscribers wish together.
    pub(crate) fn wish(&self, wished: Wished) {
        self.shape.wish(wished);
    }

    /// Returns what the subscribers wish together.
    pub(crate) fn wished(&self) -> Wished {
        self.shape.wished()
    }

    /// Sets the state of the type. Samples that waited for it are published or dropped.
    pub(crate) fn set_type(self: &Arc<Self>, known: KnownType) {
        self.encode.set_type(known);
        self.publish_waiting();
    }

    /// Returns the limits of rate, bandwidth and age.
    pub(crate) fn shaping(&self) -> Shaping {
        self.shape.shaping()
    }

    /// Publishes a sample, at once or when its time has come. The reader's worker calls it.
    pub(crate) fn publish(self: &Arc<Self>, sample: Sample) {
        let more = sample.more;
        self.is_publishing.store(true, Relaxed);
        self.publish_now(sample);
        self.is_publishing.store(more, Relaxed);
    }

    /// Records that the reader's worker left a sample out, and whether it has another at hand.
    pub(crate) fn left_out(&self, more: bool) {
        self.is_publishing.store(more, Relaxed);
    }

    /// Returns `true` if messages of local publishers wait here or for links.
    pub(crate) fn has_waiting(&self) -> bool {
        let waits_here = self.is_publishing.load(Relaxed) || self.hold.has_waiting() || self.shape.has_held();
        waits_here || self.emit.has_waiting()
    }

    fn publish_now(self: &Arc<Self>, sample: Sample) {
        // If more samples follow or the sample is long, the runtime sends packets while this thread seals.
        let is_alone = !sample.more && sample.payload.len() <= AT_HAND_BYTES_MAX;
        let _at_hand = is_alone.then(|| self.emit.begin_batch());
        if self.shape.is_active() { self.publish_shaped(sample) } else { self.hold.publish(sample, &**self) }
    }

    /// Publishes a sample if that needs no waiting, or returns it. Receive threads of several readers call it.
    pub(crate) fn publish_at_once(&self, sample: Sample) -> Option<Sample> {
        let is_short = sample.payload.len() <= AT_HAND_BYTES_MAX;
        let is_changed = self.shape.is_active() || self.encode.is_active();
        if !is_short || is_changed || !self.emit.has_headroom() {
            return Some(sample);
        }
        // The woken tasks run after the locks are released.
        let _at_hand = self.emit.begin_batch();
        let Some(_bypass) = self.hold.try_bypass() else { return Some(sample) };
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

    /// Publishes a sample of a topic with limits, at once or when its time has come.
    fn publish_shaped(self: &Arc<Self>, sample: Sample) {
        let ends_batch = !sample.more;
        let reliable = self.map.load().slots().any(|slot| slot.reliable);
        let ShapeDecision { turn, dropped } = self.shape.shape(sample, reliable);
        if let Err(dropped) = dropped {
            self.emit.count(dropped);
        }
        match turn {
            Turn::Now(sample) => return self.hold.publish(sample, &**self),
            Turn::AfterHeld { held, sample } => {
                self.hold.publish(held, &**self);
                return self.hold.publish(sample, &**self);
            }
            Turn::Later { starts_timer: true } => {
                self.runtime.spawn(release_held(Arc::downgrade(self)));
            }
            Turn::Later { starts_timer: false } | Turn::Never => {}
        }
        if ends_batch {
            // The last sample of the batch is not published, so the earlier ones must leave now.
            self.hold.finish_batches(&**self);
        }
    }

    /// Replaces the sources, and publishes samples that waited for them.
    pub(crate) fn set_map(self: &Arc<Self>, map: SourceMap) {
        self.map.store(Arc::new(map));
        self.publish_waiting();
    }

    /// Publishes samples that need not wait any more, on a blocking thread.
    fn publish_waiting(self: &Arc<Self>) {
        if self.hold.has_waiting() {
            let share = self.clone();
            self.run_blocking(move || share.hold.publish_early(&*share));
        }
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
            if kind == SampleKind::Write {
                self.shape.correct(taken, encoded.payload.len());
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
        // Publishers that share a source are asserted together.
        let mut by_publisher = BTreeMap::<_, Vec<_>>::new();
        for (_, slot, lease) in news {
            by_publisher.entry(slot.id.publisher()).or_default().push(lease.clone());
        }
        if let Some(slot) = map.assertions.clone().filter(|_| !by_publisher.is_empty()) {
            let share = self.clone();
            self.run_blocking(move || {
                // The holder of the source is blocked.
                let Ok(mut source) = slot.source.try_lock() else { return };
                for (publisher, leases) in by_publisher {
                    if source.assert_publisher(publisher, share.emit.packets()).is_ok() {
                        leases.iter().for_each(|lease| lease.note_heard(now));
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

    /// Returns the last message of a source, if its sinks could ask for it again and so can confirm it.
    pub(crate) fn last_to_confirm(&self, source: &SourceId) -> Option<u64> {
        let progress = self.map.load().slot(source)?.progress;
        Some(progress.last_message()).filter(|last| progress.recovers() && *last > 0)
    }

    /// Returns the mark by which a source asks its sinks to confirm that they have everything, if there is a path to
    /// any.
    pub(crate) fn question(self: &Arc<Self>, source: &SourceId) -> Option<DueMark> {
        let slot = self.map.load().slot(source).filter(|_| self.emit.is_wanted())?;
        Some(DueMark { share: self.clone(), slot, asks: true })
    }

    /// Has the marks of a silence ask for confirmations, or not: so it becomes known which nodes give any.
    pub(crate) fn ask_in_marks(&self, asks: bool) {
        self.asks_in_marks.store(asks, Relaxed);
    }

    /// Adds to `due` the marks of sources that have been silent. Returns `false` if none will have one before the next
    /// message.
    pub(crate) fn look_for_silence(self: &Arc<Self>, now: Instant, due: &mut Vec<DueMark>) -> bool {
        let asks = self.asks_in_marks.load(Relaxed);
        self.seal.look_for_silence(now, &self.map.load(), |slot| {
            if self.emit.is_wanted() {
                due.push(DueMark { share: self.clone(), slot: slot.clone(), asks });
            }
        })
    }

    /// Closes the share. A publishing worker of the reader stops at the next packet.
    pub(crate) fn close(&self) {
        self.emit.close();
        self.taps.close();
        self.shape.close();
    }

    /// Returns the number of signatures of its present sources, one for each batch.
    pub(crate) fn signatures(&self) -> u64 {
        let map = self.map.load();
        let by_id: BTreeMap<_, _> = map.slots().map(|slot| (slot.id, slot.progress.signatures())).collect();
        by_id.into_values().sum()
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

impl Downstream for LocalShare {
    fn pass(&self, sample: Sample, more: bool) -> PassOutcome {
        let awaits_type = self.encode.awaits_type();
        match self.choose(sample.writer) {
            SourceChoice::UnknownWriter => return PassOutcome::Waits(sample),
            SourceChoice::Source(_) if awaits_type => return PassOutcome::Waits(sample),
            SourceChoice::Source(_) if self.emit.is_closed() => {}
            SourceChoice::Source(slot) => match self.send(&slot, None, sample, more) {
                Ok(()) if more => return PassOutcome::Open(slot),
                Ok(()) => {}
                Err(dropped) => self.emit.count(dropped),
            },
            SourceChoice::NoSource => self.emit.count(Dropped::one(DataDrop::NotGranted)),
        }
        PassOutcome::Done
    }

    fn finish_batch(&self, source: &SourceSlot) {
        seal::finish_batch(source, &self.emit);
    }

    fn awaits_type(&self) -> bool {
        self.encode.awaits_type()
    }

    /// Returns `true` for data that is not kept for late joiners, if it waits for its type.
    fn is_useless_late(&self, sample: &Sample) -> bool {
        self.encode.is_json()
            && sample.kind == SampleKind::Write
            && matches!(self.choose(sample.writer), SourceChoice::Source(slot) if !slot.keeps_history)
    }

    fn count_given_up(&self, dropped: Dropped) {
        self.emit.count_here(dropped);
    }
}

/// Publishes held samples when their time comes, until none is left.
async fn release_held(share: Weak<LocalShare>) {
    loop {
        let due = {
            let Some(share) = share.upgrade() else { return };
            let Some(due) = share.shape.due(Instant::now()) else { return };
            due
        };
        tokio::time::sleep_until(due.into()).await;
        let Some(share) = share.upgrade() else { return };
        let (runtime, alive) = (share.runtime.clone(), share.alive.clone());
        let publish = move || {
            let _alive = alive;
            if let Some(sample) = share.shape.release(Instant::now()) {
                share.hold.publish(sample, &*share);
            }
        };
        // Publishing may block.
        let _ = runtime.spawn_blocking(publish).await;
    }
}
