//! Local subscribers: packets in, samples on the local network out.
//!
//! [`LocalSink::deliver`] opens packets on the task that received them. Writing may block, so each local writer has a
//! thread behind a bounded queue. If the writer cannot block and its queue is empty, the receiving task writes a short
//! message itself.

use std::collections::{BTreeMap, BTreeSet, VecDeque};
use std::num::NonZeroU64;
use std::sync::atomic::{AtomicBool, AtomicU32, AtomicU64, Ordering::Relaxed};
use std::sync::{Arc, Mutex, MutexGuard};
use std::thread;
use std::time::{Duration, Instant};

use arc_swap::{ArcSwap, ArcSwapOption};
use sgc_endpoint::{AskAgain, Decompressor, Delivery, Message, Sink, SinkDrop, SinkLimits, SinkProgress};
use sgc_ros::{
    EndpointSpec, Guid, RosError, RosWriter, SampleHead, SampleKind, Shaping, for_all_instances,
    prefix_frames,
};
use sgc_router::LinkId;
use sgc_session::Shaper;
use sgc_sync::lock;
use sgc_wire::{
    History, KEY_HASH_BYTES, Liveliness, MessageHead, MessageKind, Name, Packet, PayloadForm, SinkId,
    SourceId, TopicGrant,
};
use tokio::sync::{OwnedMutexGuard, mpsc};
use tokio::time::{sleep_until, timeout_at};
use tracing::{debug, warn};

use crate::data::conversion::{self, KnownType, TypeSlot};
use crate::data::pending::{PendingBytes, PendingQueue};
use crate::data::queue::Queue;
use crate::data::spacing::Spacing;
use crate::data::stats::{CountDrops, DataDrop, Drops};
use crate::data::tap::{TapMessage, Taps};

/// Most messages that wait for one local writer.
const WRITER_MESSAGES_MAX: usize = 1024;
/// Most bytes that wait for one local writer.
const WRITER_BYTES_MAX: usize = 64 << 20;
/// Longest wait of a burst for acknowledgements of local readers.
const ACKNOWLEDGED_WAIT_MAX: Duration = Duration::from_secs(1);
/// Time during which no burst waits again after a local reader acknowledged nothing.
const STALLED_READER_PAUSE: Duration = Duration::from_secs(10);
/// Longest wait of new messages for a closed writer that still writes its queue.
const LAST_WRITES_MAX: Duration = Duration::from_secs(1);
/// Most delay of a wake-up of a writer's thread; Linux's default is 50 µs.
const TIMER_SLACK_NS: u64 = 1_000;
/// Messages of a transient-local writer that are remembered, to recognise repetitions.
const RECENT_MAX: usize = 4096;
/// The longest message that the receiving task writes itself.
const AT_ONCE_BYTES_MAX: usize = 16 << 10;
/// Least time between two liveliness assertions of a writer. It is shorter than any lease that is asserted.
const ASSERTION_SPACING: Duration = Duration::from_millis(20);
/// Longest time that a local writer may block the network.
const WRITER_PATIENCE: Duration = Duration::from_secs(5);

/// Request of a sink to the control task.
#[derive(Clone, Copy, Debug)]
pub(crate) enum SinkRequest {
    /// Ask a source for missing messages.
    History(Name, SourceId),
    /// The missing messages have arrived.
    Synced(Name, SourceId),
}

struct State {
    sink: Option<Sink>,
    /// Number of releases under way: messages that waited for a grant and are not written yet.
    releases: u32,
    /// Sources whose recoverable messages were skipped, because they had no writer.
    missed: BTreeSet<SourceId>,
    /// Messages that wait for their type, and the messages behind them.
    held: PendingQueue<Message>,
}

/// This node's end of a joined name.
pub(crate) struct LocalSink {
    name: Name,
    transient_local: bool,
    state: Mutex<State>,
    /// Lock of a release: messages that waited for a grant or a writer are written before later ones.
    releasing: Arc<tokio::sync::Mutex<()>>,
    writers: ArcSwap<BTreeMap<Option<SourceId>, Arc<WriterQueue>>>,
    requests: mpsc::Sender<SinkRequest>,
    delivered: AtomicU64,
    shaping: Mutex<Shaping>,
    taps: Taps,
    frames: FramePrefix,
    types: Arc<TypeSlot>,
    /// Whether messages arrive as JSON.
    takes_json: AtomicBool,
}

/// Prefix of frame names, if there is one. Writers share it.
pub(crate) type FramePrefix = Arc<ArcSwapOption<String>>;

impl LocalSink {
    /// Creates a sink without a grant.
    pub(crate) fn new(
        name: Name,
        transient_local: bool,
        requests: mpsc::Sender<SinkRequest>,
        holds: Arc<PendingBytes>,
    ) -> Self {
        let held = PendingQueue::new(WRITER_MESSAGES_MAX, holds);
        let state = State { sink: None, releases: 0, missed: BTreeSet::new(), held };
        Self {
            name,
            transient_local,
            state: Mutex::new(state),
            releasing: Arc::default(),
            writers: ArcSwap::default(),
            requests,
            delivered: AtomicU64::new(0),
            shaping: Mutex::default(),
            taps: Taps::default(),
            frames: FramePrefix::default(),
            types: Arc::default(),
            takes_json: AtomicBool::new(false),
        }
    }

    /// Returns the taps of messages for the local network.
    pub(crate) fn taps(&self) -> &Taps {
        &self.taps
    }

    /// Returns the largest number of local readers that one of its writers matches.
    pub(crate) fn matched(&self) -> u32 {
        self.writers.load().values().map(|writer| (writer.info.matched)()).max().unwrap_or(0)
    }

    /// Applies a grant. A task writes the packets that waited for it, since that may take a while.
    pub(crate) fn grant(self: &Arc<Self>, id: SinkId, grant: TopicGrant, data: &Arc<impl CountDrops>) {
        let mut released = Vec::new();
        let turn = {
            let state = &mut *self.lock();
            match &mut state.sink {
                Some(sink) => {
                    // A new source has a grant before it has a writer.
                    let recovering = grant.sources.iter().filter(|announced| announced.recover > 0);
                    let sources: BTreeSet<_> = recovering.map(|announced| announced.source).collect();
                    let is_writerless =
                        |source: &SourceId| sources.contains(source) && !self.has_writer(source);
                    state.missed.extend(sink.pass_over(is_writerless));
                    sink.regrant(id, grant, |result| released.push(result));
                    // A sink forgets sources when it has too many.
                    state.missed.retain(|source| sink.recovers(source));
                }
                sink => {
                    let limits = SinkLimits::default();
                    *sink = Some(Sink::new(self.name, id, grant, self.transient_local, limits));
                }
            }
            if released.is_empty() {
                return;
            }
            self.begin_release(state)
        };
        let (this, data) = (self.clone(), data.clone());
        self.release(turn, async move {
            for result in released {
                if let Some((reason, _)) = this.finish(result, data.drops()).await {
                    data.count(LinkId::LOCAL, &this.name, reason);
                }
            }
        });
    }

    /// Starts anew with the next grant, like a process that just started: messages published until then are not
    /// recovered.
    pub(crate) fn begin_anew(&self) {
        let mut state = self.lock();
        state.sink = None;
        state.missed.clear();
        self.writers.load().values().for_each(|writer| writer.begin_again());
    }

    /// Makes later messages wait behind a release. Returns the lock of the release, unless another holds it.
    fn begin_release(&self, state: &mut State) -> Option<OwnedMutexGuard<()>> {
        state.releases += 1;
        self.releasing.clone().try_lock_owned().ok()
    }

    /// Writes the released messages once the lock is free.
    fn release(
        self: &Arc<Self>,
        turn: Option<OwnedMutexGuard<()>>,
        writing: impl Future<Output = ()> + Send + 'static,
    ) {
        let this = self.clone();
        tokio::spawn(async move {
            let releasing = Releasing(&this);
            let turn = match turn {
                Some(turn) => turn,
                None => this.releasing.clone().lock_owned().await,
            };
            writing.await;
            drop(releasing);
            drop(turn);
        });
    }

    /// Returns the progress of each source; `None` before the first grant.
    pub(crate) fn progress(&self) -> Option<Arc<SinkProgress>> {
        self.lock().sink.as_ref().map(Sink::progress)
    }

    /// Drops the keys of all epochs but the current one.
    pub(crate) fn retire_epochs(&self) {
        if let Some(sink) = &mut self.lock().sink {
            sink.retire_epochs();
        }
    }

    /// Returns the sources with a local writer that lack messages.
    pub(crate) fn unsynced(&self) -> Vec<SourceId> {
        let state = self.lock();
        let sources = state.sink.iter().flat_map(Sink::unsynced);
        sources.filter(|source| self.has_writer(source)).collect()
    }

    /// Returns the number from which a source is to be asked for missing messages.
    pub(crate) fn ask(&self, source: SourceId) -> Option<u64> {
        // Without a writer the messages would be dropped, so asking waits for one.
        self.has_writer(&source).then(|| self.lock().sink.as_mut()?.ask(source)).flatten()
    }

    /// Returns whether to ask a source again, some time after it was asked.
    pub(crate) fn ask_again(&self, source: SourceId) -> AskAgain {
        if !self.has_writer(&source) {
            return AskAgain::No;
        }
        self.lock().sink.as_mut().map_or(AskAgain::No, |sink| sink.ask_again(source))
    }

    /// Adds, replaces or removes a writer. The old one ends after its queue. Later messages are written after that,
    /// since their source may have replaced the old one's.
    pub(crate) fn set_writer(self: &Arc<Self>, source: Option<SourceId>, writer: Option<Arc<WriterQueue>>) {
        let mut state = self.lock();
        let mut writers = BTreeMap::clone(&self.writers.load());
        let old = match writer {
            Some(writer) => writers.insert(source, writer),
            None => {
                if let (Some(source), Some(sink)) = (source, &mut state.sink) {
                    sink.forget(&source);
                }
                writers.remove(&source)
            }
        };
        let opened = writers.contains_key(&source);
        self.writers.store(Arc::new(writers));
        if opened {
            self.ask_for_missed(&mut state);
        }
        let Some(old) = old else { return };
        old.close();
        let (turn, deadline) = (self.begin_release(&mut state), Instant::now() + LAST_WRITES_MAX);
        self.release(turn, async move {
            let _ = timeout_at(deadline.into(), old.ended()).await;
        });
    }

    /// Moves a writer to another source of the same publisher. Returns `false` if there is none. Messages in the new
    /// source's history that were written already are not written again.
    pub(crate) fn move_writer(&self, from: SourceId, to: SourceId) -> bool {
        let mut writers = BTreeMap::clone(&self.writers.load());
        let Some(writer) = writers.remove(&Some(from)) else { return false };
        writer.begin_again();
        writers.insert(Some(to), writer);
        self.writers.store(Arc::new(writers));
        let state = &mut *self.lock();
        if let Some(sink) = &mut state.sink {
            sink.forget(&from);
        }
        self.ask_for_missed(state);
        true
    }

    /// Returns the writer that was opened for this source, or for all sources without their own.
    pub(crate) fn open_writer(&self, source: Option<SourceId>) -> Option<Arc<WriterQueue>> {
        self.writers.load().get(&source).cloned()
    }

    /// Asks for messages that were skipped for want of a writer, if there is a writer now.
    fn ask_for_missed(&self, state: &mut State) {
        for source in std::mem::take(&mut state.missed) {
            match &mut state.sink {
                Some(sink) if self.has_writer(&source) => sink.suspect(&source),
                Some(sink) if sink.recovers(&source) => drop(state.missed.insert(source)),
                _ => {}
            }
        }
    }

    /// Sets the limits of rate, bandwidth and age.
    pub(crate) fn set_shaping(&self, shaping: Shaping) {
        *lock(&self.shaping) = shaping;
        self.writers.load().values().for_each(|writer| writer.set_shaping(shaping));
    }

    /// Returns the limits of rate, bandwidth and age.
    pub(crate) fn shaping(&self) -> Shaping {
        *lock(&self.shaping)
    }

    /// Sets the prefix of frame names in tf messages.
    pub(crate) fn set_frames(&self, prefix: Option<String>) {
        self.frames.store(prefix.map(Arc::new));
    }

    /// Returns the shared prefix of frame names.
    pub(crate) fn frames(&self) -> FramePrefix {
        self.frames.clone()
    }

    /// Sets the state of the type. Messages that waited for it are written or dropped.
    pub(crate) fn set_type(self: &Arc<Self>, known: KnownType, data: &Arc<impl CountDrops>) {
        let (held, turn) = {
            let mut state = self.lock();
            self.types.set(known);
            if state.held.is_empty() || self.types.now().is_awaited() {
                return;
            }
            (state.held.take(), self.begin_release(&mut state))
        };
        let (this, data) = (self.clone(), data.clone());
        self.release(turn, async move {
            let now = Instant::now();
            for held in held {
                let is_late = held.is_late(now) && this.is_given_up(&held.item);
                let dropped = match is_late {
                    true => Some((DataDrop::NoDefinition, 1)),
                    false => this.write(held.item).await,
                };
                if let Some((reason, several)) = dropped {
                    data.count_here(&this.name, reason, several);
                }
            }
        });
    }

    /// Returns `true` if a message is useless when late, because it is not kept for late joiners.
    fn is_given_up(&self, message: &Message) -> bool {
        !self.transient_local && message.head.kind == MessageKind::Write
    }

    /// Returns the state of the type.
    pub(crate) fn types(&self) -> &Arc<TypeSlot> {
        &self.types
    }

    /// Returns `true` if messages arrive as JSON and their type is unknown.
    pub(crate) fn lacks_definition(&self) -> bool {
        self.takes_json.load(Relaxed) && self.types.now().is_lacking()
    }

    /// Closes all writers. They end after their queues.
    pub(crate) fn close(&self) {
        // The type can no longer become known.
        drop(self.lock().held.take());
        self.writers.load().values().for_each(|w| w.close());
        self.taps.close();
    }

    /// Returns the number of messages written to the local network.
    pub(crate) fn delivered(&self) -> u64 {
        self.delivered.load(Relaxed)
    }

    /// Delivers a packet. Returns the drop, if there is one. Waits while the local writer of a reliable topic is full.
    pub(crate) async fn deliver(&self, packet: Packet, drops: &Drops) -> Option<(DataDrop, u64)> {
        let (result, behind, turn) = {
            let mut state = self.lock();
            let State { sink, releases, missed, held } = &mut *state;
            let Some(sink) = sink else { return Some((DataDrop::NotGranted, 1)) };
            let source = packet.header.source;
            if !self.has_writer(&source) && sink.recovers(&source) {
                // The sink bounds its sources, so this set is small.
                missed.insert(source);
                return Some((DataDrop::NoWriter, 1));
            }
            let behind = *releases > 0;
            match sink.handle_packet(&packet) {
                // Writing happens under the lock, so that messages from two links keep the order of their numbers.
                Ok(Delivery::Message(message)) if !behind => match self.write_now(message, held) {
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

    /// Completes a delivery after the lock is released.
    async fn finish(&self, result: Result<Delivery, SinkDrop>, drops: &Drops) -> Option<(DataDrop, u64)> {
        match result {
            Ok(Delivery::Incomplete | Delivery::Mark | Delivery::Parked) => None,
            Ok(Delivery::Message(message)) => self.write(message).await,
            Ok(Delivery::Asserted(source)) => {
                if let Some(writer) = self.open_writer(Some(source)) {
                    writer.assert_liveliness();
                }
                None
            }
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
                    warn!(messages, "a source no longer keeps messages that were lost; counted from here on");
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
        let written = self.write_now(message, &mut self.lock().held);
        let message = match written {
            Ok(dropped) => return dropped,
            Err(message) => message,
        };
        let Some(writer) = self.writer(&message.source) else { return Some((DataDrop::NoWriter, 1)) };
        let (bytes, head) = (message.payload.len(), message.head);
        self.delivered.fetch_add(1, Relaxed);
        self.taps.offer(|| self.tapped(&message));
        match writer.queue.push(message, bytes, WRITER_BYTES_MAX, WRITER_PATIENCE).await {
            Ok(()) => {
                writer.remember(&head);
                None
            }
            Err(_) => Some((DataDrop::Stalled, 1)),
        }
    }

    /// Queues a message for its writer, or holds it until its type is known. Returns the drop, or the message if it has
    /// to wait for room.
    fn write_now(
        &self,
        message: Message,
        held: &mut PendingQueue<Message>,
    ) -> Result<Option<(DataDrop, u64)>, Message> {
        let Some(writer) = self.writer(&message.source) else { return Ok(Some((DataDrop::NoWriter, 1))) };
        let (bytes, head) = (message.payload.len(), message.head);
        let mut waits = !held.is_empty();
        if head.form == PayloadForm::Json {
            self.takes_json.store(true, Relaxed);
            match self.types.now() {
                KnownType::Known(_) => {}
                KnownType::Awaited | KnownType::Asked => waits = true,
                KnownType::Lacking => return Ok(Some((DataDrop::NoDefinition, 1))),
            }
        }
        if waits {
            return Ok(self.hold(message, held));
        }
        if writer.has_written(&head) {
            return Ok(Some((DataDrop::Repeated, 1)));
        }
        let mut evicted = 0;
        let tapped = self.taps.is_any().then(|| self.tapped(&message));
        // Converting takes time, and may have to wait for the type.
        let at_once = head.form != PayloadForm::Json;
        let at_once = at_once.then(|| writer.at_once(&message)).flatten();
        if let Some(mut take) = at_once {
            take(message, NextMessage::Nothing);
        } else if message.reliable {
            writer.queue.try_push(message, bytes, WRITER_BYTES_MAX)?;
        } else {
            writer.queue.push_evicting(message, bytes, WRITER_BYTES_MAX, |_| evicted += 1);
        }
        writer.remember(&head);
        self.delivered.fetch_add(1, Relaxed);
        if let Some(tapped) = tapped {
            self.taps.offer(|| tapped);
        }
        Ok((evicted > 0).then_some((DataDrop::Stale, evicted)))
    }

    /// Holds a message until its type is known or given up. The oldest messages make room.
    fn hold(&self, message: Message, held: &mut PendingQueue<Message>) -> Option<(DataDrop, u64)> {
        let now = Instant::now();
        let late = held.give_up_late(now, |message| self.is_given_up(message));
        let given_up = late + held.push(now, message.payload.len(), message);
        (given_up > 0).then_some((DataDrop::NoDefinition, given_up))
    }

    fn tapped(&self, message: &Message) -> TapMessage {
        TapMessage::from_message(message, self.types.now().layout())
    }

    fn has_writer(&self, source: &SourceId) -> bool {
        let writers = self.writers.load();
        writers.contains_key(&Some(*source)) || writers.contains_key(&None)
    }

    /// Returns the writer for a source's messages.
    fn writer(&self, source: &SourceId) -> Option<Arc<WriterQueue>> {
        let writers = self.writers.load();
        writers.get(&Some(*source)).or_else(|| writers.get(&None)).cloned()
    }

    fn lock(&self) -> std::sync::MutexGuard<'_, State> {
        lock(&self.state)
    }
}

impl Drop for LocalSink {
    /// Closes the writers when a node stops without leaving its topics.
    fn drop(&mut self) {
        self.close();
    }
}

/// Guard of a release under way. It decrements the count even if the waiting task is cancelled.
struct Releasing<'a>(&'a LocalSink);

impl Drop for Releasing<'_> {
    fn drop(&mut self) {
        self.0.lock().releases -= 1;
    }
}

/// State of the queue behind a message that is taken.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum NextMessage {
    /// The queue is empty.
    Nothing,
    /// The next message waits for its time.
    Later,
    /// The next message follows at once.
    AtOnce,
    /// The next message follows at once, and the queue is closed: messages of another writer wait for it.
    Last,
}

impl NextMessage {
    /// Returns `true` if the next message is taken without a pause.
    fn is_at_once(self) -> bool {
        matches!(self, Self::AtOnce | Self::Last)
    }
}

/// Consumes the messages of a queue one by one.
type MessageConsumer = Box<dyn FnMut(Message, NextMessage) + Send>;

/// The queue in front of a local writer's thread.
pub(crate) struct WriterQueue {
    queue: Queue<Message>,
    shaper: Mutex<Shaper>,
    /// Whether no shaping is configured, readable without the lock.
    is_unshaped: AtomicBool,
    /// Held by the thread from before it takes a message until it has consumed it, so that no other message overtakes.
    take: Mutex<MessageConsumer>,
    info: WriterInfo,
    /// Whether liveliness was asserted just now, or is being asserted.
    is_asserted: Arc<AtomicBool>,
    /// Closed once the thread has consumed everything.
    thread: mpsc::Sender<()>,
}

/// Properties of the writer behind a queue.
pub(crate) struct WriterInfo {
    guid: Guid,
    recent: Option<Mutex<Recent>>,
    /// Returns the number of matched local readers.
    matched: Box<dyn Fn() -> u32 + Send + Sync>,
    /// Returns `true` if a short message can be written now without blocking and without overwriting one that a reader
    /// may lack.
    is_free: Box<dyn Fn(&Message) -> bool + Send + Sync>,
    /// Sets the number of messages that late joiners get. May block.
    resize: Box<dyn Fn(u32) + Send + Sync>,
    /// Asserts liveliness without a message, if it is manual by topic. May block.
    assert: Option<Box<dyn Fn() + Send + Sync>>,
}

impl Default for WriterInfo {
    fn default() -> Self {
        Self {
            guid: Guid([0; 16]),
            recent: None,
            matched: Box::new(|| 0),
            is_free: Box::new(|_| false),
            resize: Box::new(|_| ()),
            assert: None,
        }
    }
}

/// Heads of the messages that a transient-local writer wrote last, as many as late joiners get.
struct Recent {
    depth: usize,
    heads: VecDeque<MessageHead>,
    /// Whether messages may repeat: they come from the history of a source that replaced another.
    again: bool,
}

impl Recent {
    fn new(spec: &EndpointSpec) -> Option<Mutex<Self>> {
        let history = spec.qos.history;
        let depth = match if spec.keyless { history } else { for_all_instances(history) } {
            _ if !spec.qos.is_transient_local() => return None,
            History::KeepAll => RECENT_MAX,
            History::KeepLast(n) => (n as usize).min(RECENT_MAX),
        };
        Some(Mutex::new(Self { depth, heads: VecDeque::new(), again: false }))
    }

    fn keep(&mut self, depth: usize) {
        self.depth = depth.clamp(1, RECENT_MAX);
        self.heads.drain(..self.heads.len().saturating_sub(self.depth));
    }
}

impl WriterQueue {
    /// Starts the thread. It ends, and the writer with it, once the queue is closed and empty. `frames` applies to tf
    /// messages, `types` to messages that arrive as JSON.
    pub(crate) fn spawn<W: RosWriter>(
        writer: W,
        spec: &EndpointSpec,
        shaping: Shaping,
        frames: Option<FramePrefix>,
        types: Arc<TypeSlot>,
        failures: Arc<Drops>,
        alive: mpsc::Sender<()>,
    ) -> std::io::Result<Arc<Self>> {
        let (counted, topic) = (failures.clone(), spec.topic.clone());
        let in_topic = topic.clone();
        let writer = Arc::new(writer);
        // Only the thread owns the writer, so the writer is dropped where it may block.
        let weak = Arc::downgrade(&writer);
        let mut burst = Burst::default();
        // Cyclone's writers block only if they have to keep all samples until they are acknowledged.
        let never_blocks = !spec.qos.is_reliable() || matches!(spec.qos.history, History::KeepLast(_));
        let (room, of_room) = (burst.room.clone(), weak.clone());
        let is_free = Box::new(move |message: &Message| {
            let (bytes, published_ns) = (message.payload.len(), message.head.source_timestamp_ns);
            never_blocks
                && room.spacing().wait(Instant::now(), message.source, published_ns).is_none()
                && of_room.upgrade().is_some_and(|writer| room.is_there(&*writer, bytes, published_ns))
        });
        let to_resize = weak.clone();
        let resize = Box::new(move |depth| {
            if let Some(writer) = to_resize.upgrade() {
                writer.set_late_depth(depth);
            }
        });
        let to_assert = weak.clone();
        let assert = Box::new(move || {
            if let Some(writer) = to_assert.upgrade() {
                writer.assert_liveliness();
            }
        });
        let is_manual = spec.qos.liveliness == Liveliness::ManualByTopic && spec.qos.lease_ns.is_some();
        let assert = is_manual.then_some(assert as Box<dyn Fn() + Send + Sync>);
        let matched = Box::new(move || weak.upgrade().map_or(0, |writer| writer.matched_readers()));
        let info =
            WriterInfo { guid: writer.guid(), recent: Recent::new(spec), matched, is_free, resize, assert };
        let (mut decompressor, offered) = (Decompressor::default(), spec.qos.representations);
        let mut prepare = move |message: Message| {
            let mut key_hash = None;
            let kind = match message.head.kind {
                MessageKind::Write => SampleKind::Write,
                MessageKind::Dispose => SampleKind::Dispose,
                MessageKind::Unregister => SampleKind::Unregister,
                // Topics carry no calls.
                _ => return None,
            };
            let payload = match decompressor.decompress(message.head.encoding, message.payload) {
                Ok(payload) => payload,
                Err(error) => {
                    if counted.count("decompress") {
                        warn!(%in_topic, %error, "a message is not written to the local network; counted from here on");
                    }
                    return None;
                }
            };
            let payload = match message.head.form {
                PayloadForm::Cdr => payload,
                PayloadForm::KeyedCdr => {
                    let Some(hash) = payload.first_chunk::<KEY_HASH_BYTES>().copied() else {
                        counted.count("key_hash");
                        return None;
                    };
                    key_hash = Some(hash);
                    payload.slice(KEY_HASH_BYTES..)
                }
                PayloadForm::Json => {
                    let known = types.now();
                    let Some(layout) = known.layout() else {
                        // The type was known when the message was queued.
                        counted.count("json_unknown_type");
                        return None;
                    };
                    match conversion::from_json(layout, &payload, offered) {
                        Ok(payload) => payload,
                        Err(error) => {
                            if counted.count("json_refused") {
                                warn!(%in_topic, %error, "a message is not written to the local network; counted from here on");
                            }
                            return None;
                        }
                    }
                }
            };
            let prefix = frames.as_ref().and_then(|frames| frames.load_full());
            let payload = match prefix.filter(|_| kind == SampleKind::Write) {
                None => payload,
                Some(prefix) => match prefix_frames(&payload, &prefix) {
                    Ok(rewritten) => rewritten.into(),
                    Err(error) => {
                        if counted.count("frames") {
                            warn!(%in_topic, %error, "a message is not written to the local network; counted from here on");
                        }
                        return None;
                    }
                },
            };
            let source_timestamp_ns = message.head.source_timestamp_ns;
            Some((SampleHead { kind, source_timestamp_ns, key_hash }, payload))
        };
        let refused = failures.clone();
        Self::spawn_with("sgc-write", info, shaping, failures, alive, move |message, next| {
            let source = message.source;
            let Some((head, payload)) = prepare(message) else {
                return if !next.is_at_once() {
                    writer.flush()
                };
            };
            if next != NextMessage::Last {
                burst.room.space(&*writer, source, head.source_timestamp_ns);
            }
            burst.before_next(
                &*writer,
                next == NextMessage::Nothing,
                payload.len(),
                head.source_timestamp_ns,
            );
            let written = writer.write_ahead(head, payload);
            if !next.is_at_once() {
                writer.flush();
            }
            if let Err(error) = written
                && refused.count(failure_key(&error))
            {
                warn!(%topic, %error, "a message could not be given to the local network; counted from here on");
            }
        })
    }

    /// Starts a queue with another consumer, which also learns the state of the queue behind each message. The consumer
    /// may block, except for a short message that `info` declares free.
    pub(crate) fn spawn_with(
        thread_name: &str,
        info: WriterInfo,
        shaping: Shaping,
        drops: Arc<Drops>,
        alive: mpsc::Sender<()>,
        take: impl FnMut(Message, NextMessage) + Send + 'static,
    ) -> std::io::Result<Arc<Self>> {
        let mut shaper = Shaper::default();
        shaper.set(shaping);
        let (running, in_thread) = mpsc::channel(1);
        let this = Arc::new(Self {
            queue: Queue::new(WRITER_MESSAGES_MAX),
            shaper: shaper.into(),
            is_unshaped: AtomicBool::new(shaping == Shaping::default()),
            take: Mutex::new(Box::new(take)),
            info,
            is_asserted: Arc::default(),
            thread: running,
        });
        let (task, runtime) = (this.clone(), tokio::runtime::Handle::current());
        thread::Builder::new().name(thread_name.into()).spawn(move || {
            let _alive = alive;
            // Without it, the pauses of a burst overrun by as much as they are long.
            let _ = rustix::thread::set_current_timer_slack(NonZeroU64::new(TIMER_SLACK_NS));
            while runtime.block_on(task.queue.wait()) {
                let mut take = lock(&task.take);
                let mut behind = None;
                while let Some(message) = runtime.block_on(task.next(&mut behind, &drops)) {
                    let next = match behind.is_none() && task.queue.is_empty() {
                        true => NextMessage::Nothing,
                        false if task.queue.is_closed() => NextMessage::Last,
                        false if task.is_unshaped.load(Relaxed) => NextMessage::AtOnce,
                        false => NextMessage::Later,
                    };
                    take(message, next);
                }
            }
            drop(in_thread);
            // Dropping the consumer drops a writer, which may block.
            let end: MessageConsumer = Box::new(|_, _| ());
            drop(std::mem::replace(&mut *lock(&task.take), end));
        })?;
        Ok(this)
    }

    /// Returns the consumer if it takes a message now without blocking and the queue is empty. Only one caller queues
    /// at a time.
    fn at_once(&self, message: &Message) -> Option<MutexGuard<'_, MessageConsumer>> {
        let may = message.payload.len() <= AT_ONCE_BYTES_MAX && self.is_unshaped.load(Relaxed);
        let take = if may { self.take.try_lock().ok() } else { None };
        take.filter(|_| self.queue.is_empty() && !self.queue.is_closed() && (self.info.is_free)(message))
    }

    /// Returns the writer's GUID.
    pub(crate) fn guid(&self) -> Guid {
        self.info.guid
    }

    /// Sets the limits of rate, bandwidth and age.
    pub(crate) fn set_shaping(&self, shaping: Shaping) {
        self.is_unshaped.store(shaping == Shaping::default(), Relaxed);
        self.shaper().set(shaping);
    }

    /// Waits for the time of the next message and returns it, or the newest one if later messages replace it. `behind`
    /// is a message that was taken after it and must not overtake it.
    async fn next(&self, behind: &mut Option<Message>, drops: &Drops) -> Option<Message> {
        let mut message = match behind.take() {
            Some(message) => message,
            None => self.queue.try_pop()?,
        };
        loop {
            let now = Instant::now();
            let (due, gives_way) = {
                let mut shaper = self.shaper();
                let is_shaped = message.head.kind == MessageKind::Write;
                if !is_shaped || shaper.is_due(now) || self.queue.is_closed() {
                    if is_shaped {
                        shaper.takes(now, message.payload.len());
                    }
                    return Some(message);
                }
                (shaper.due().unwrap_or(now), shaper.gives_way(now, message.reliable))
            };
            if !gives_way {
                sleep_until(due.into()).await;
                continue;
            }
            match timeout_at(due.into(), self.queue.pop()).await {
                Ok(Some(newer)) if newer.head.kind == MessageKind::Write => {
                    drops.count(DataDrop::Thinned.key());
                    message = newer;
                }
                // The end of an instance is never skipped, nor is the message before it.
                Ok(Some(end)) => {
                    *behind = Some(end);
                    return Some(message);
                }
                Ok(None) => return Some(message),
                Err(_) => {}
            }
        }
    }

    /// Sets the number of messages that late joiners get. May block.
    pub(crate) fn resize(&self, depth: u32) {
        self.with_recent(|recent| recent.keep(depth as usize));
        (self.info.resize)(depth);
    }

    /// Asserts the writer's liveliness, at most once in [`ASSERTION_SPACING`].
    fn assert_liveliness(self: &Arc<Self>) {
        if self.info.assert.is_none() || self.is_asserted.swap(true, Relaxed) {
            return;
        }
        let (this, is_asserted) = (self.clone(), self.is_asserted.clone());
        tokio::spawn(async move {
            let assert = move || this.info.assert.as_ref().map(|assert| assert());
            let _ = tokio::task::spawn_blocking(assert).await;
            tokio::time::sleep(ASSERTION_SPACING).await;
            is_asserted.store(false, Relaxed);
        });
    }

    /// Expects repetitions of written messages from here on.
    fn begin_again(&self) {
        self.with_recent(|recent| recent.again = true);
    }

    /// Returns `true` if a message was written before. Its time stamp tells, since a publisher never uses one twice.
    /// After the first new message, all are new.
    fn has_written(&self, head: &MessageHead) -> bool {
        let is_known = |recent: &mut Recent| {
            let is_it =
                |h: &MessageHead| h.kind == head.kind && h.source_timestamp_ns == head.source_timestamp_ns;
            recent.again = recent.again && recent.heads.iter().any(is_it);
            recent.again
        };
        self.with_recent(is_known).unwrap_or(false)
    }

    fn remember(&self, head: &MessageHead) {
        self.with_recent(|recent| {
            if recent.heads.len() >= recent.depth {
                recent.heads.pop_front();
            }
            recent.heads.push_back(*head);
        });
    }

    /// Returns `None` if the publisher keeps nothing for late joiners.
    fn with_recent<T>(&self, look: impl FnOnce(&mut Recent) -> T) -> Option<T> {
        let recent = self.info.recent.as_ref()?;
        Some(look(&mut lock(recent)))
    }

    fn shaper(&self) -> std::sync::MutexGuard<'_, Shaper> {
        lock(&self.shaper)
    }

    /// Closes the queue. The thread ends after it is empty.
    pub(crate) fn close(&self) {
        self.queue.close();
    }

    /// Waits until the thread has consumed everything.
    async fn ended(&self) {
        self.thread.closed().await;
    }
}

/// Paces messages that arrive in a burst after an interruption. A reliable writer that keeps the last samples never
/// blocks, so a burst would overwrite itself before readers take it. Its publisher spread the messages over time.
#[derive(Default)]
struct Burst {
    room: Arc<Room>,
    /// No wait before this time, because a reader is stalled.
    not_before: Option<Instant>,
}

/// Upper bound of a writer's unacknowledged samples. Only the holder of the consumer's lock changes it.
#[derive(Default)]
struct Room {
    unacknowledged: AtomicU32,
    /// When the last message was written, and its time stamp.
    last: Mutex<Option<(Instant, i64)>>,
    spacing: Mutex<Spacing>,
}

impl Room {
    /// Returns `true` if a message of this size and time can be written without overwriting one that a reader may lack.
    /// Never waits.
    fn is_there(&self, writer: &impl RosWriter, bytes: usize, timestamp_ns: i64) -> bool {
        let Some(kept) = writer.kept(bytes) else { return true };
        if self.unacknowledged.load(Relaxed) < kept || self.is_in_its_time(timestamp_ns) {
            return true;
        }
        let acknowledged = || writer.wait_acknowledged(Duration::ZERO).then_some(0);
        let Some(unacknowledged) = writer.unacknowledged().or_else(acknowledged) else { return false };
        self.unacknowledged.store(unacknowledged, Relaxed);
        unacknowledged < kept
    }

    /// Returns `true` if the time since the last write is about the publisher's interval. Readers then have the time
    /// that the publisher would have given them, and acknowledge no more often.
    fn is_in_its_time(&self, timestamp_ns: i64) -> bool {
        let Some((written, published_ns)) = *self.last() else { return false };
        let apart = timestamp_ns.checked_sub(published_ns).and_then(|ns| u64::try_from(ns).ok());
        apart.is_some_and(|ns| ns > 0 && written.elapsed() >= Duration::from_nanos(ns / 2))
    }

    /// Waits until a message may be written, and records the write.
    fn space(&self, writer: &impl RosWriter, source: SourceId, published_ns: i64) {
        let wait = self.spacing().wait(Instant::now(), source, published_ns);
        if let Some(wait) = wait {
            writer.flush();
            thread::sleep(wait);
        }
        self.spacing().note(Instant::now(), source, published_ns);
    }

    fn spacing(&self) -> MutexGuard<'_, Spacing> {
        lock(&self.spacing)
    }

    fn last(&self) -> MutexGuard<'_, Option<(Instant, i64)>> {
        lock(&self.last)
    }
}

impl Burst {
    /// Waits while a sample of this size would overwrite one that a reader may lack. A single sample is written at
    /// once, as its publisher did.
    fn before_next(&mut self, writer: &impl RosWriter, is_alone: bool, bytes: usize, timestamp_ns: i64) {
        let Some(kept) = writer.kept(bytes) else { return };
        let mut unacknowledged = self.room.unacknowledged.load(Relaxed);
        if unacknowledged >= kept {
            unacknowledged = writer.unacknowledged().unwrap_or(unacknowledged);
        }
        // A single sample is acknowledged, or waited for, before the next burst.
        let waits = !is_alone && self.not_before.is_none_or(|at| Instant::now() >= at);
        if waits && unacknowledged >= kept {
            let acknowledged = writer.wait_acknowledged(ACKNOWLEDGED_WAIT_MAX);
            // A slow reader that acknowledged some is not stalled.
            let left = writer.unacknowledged().filter(|_| !acknowledged);
            let is_stalled = !acknowledged && left.is_none_or(|left| left >= kept);
            self.not_before = is_stalled.then(|| Instant::now() + STALLED_READER_PAUSE);
            unacknowledged = left.unwrap_or(0);
        }
        self.room.unacknowledged.store(unacknowledged.saturating_add(1), Relaxed);
        *self.room.last() = Some((Instant::now(), timestamp_ns));
    }
}

/// Returns a short, stable name of a failure for counters.
pub(crate) fn failure_key(error: &RosError) -> &'static str {
    match error {
        RosError::Payload { .. } => "write_payload",
        RosError::WriteTimeout { .. } => "write_timeout",
        RosError::NoPeer { .. } => "no_local_peer",
        RosError::KeyUnknown => "key_unknown",
        _ => "write_failed",
    }
}

#[cfg(test)]
mod tests {
    use std::sync::atomic::AtomicUsize;

    use bytes::Bytes;
    use sgc_endpoint::{RecoveryLimits, Source, SourceConfig};
    use sgc_trust::{MessageKey, Suite};
    use sgc_wire::{Class, SecretBytes};

    use super::*;
    use crate::data::dataplane::DataPlane;
    use crate::data::pending::PENDING_BYTES_MAX;

    struct Slow {
        kept: Option<u32>,
        /// The count that it knows, if it knows one, before and after a wait.
        unacknowledged: [Option<u32>; 2],
        waited: AtomicUsize,
        stands_still: AtomicBool,
    }

    impl Slow {
        fn new(kept: Option<u32>) -> Self {
            Self {
                kept,
                unacknowledged: [None; 2],
                waited: AtomicUsize::new(0),
                stands_still: AtomicBool::new(false),
            }
        }
    }

    impl RosWriter for Slow {
        fn write_ahead(&self, _: SampleHead, _: Bytes) -> Result<(), RosError> {
            Ok(())
        }

        fn kept(&self, bytes: usize) -> Option<u32> {
            // Half as many long messages are kept.
            self.kept.map(|kept| if bytes > 1000 { kept / 2 } else { kept })
        }

        fn unacknowledged(&self) -> Option<u32> {
            let [before, after] = self.unacknowledged;
            if self.waited.load(Relaxed) == 0 { before } else { after }
        }

        fn wait_acknowledged(&self, _: Duration) -> bool {
            self.waited.fetch_add(1, Relaxed);
            !self.stands_still.load(Relaxed)
        }

        fn matched_readers(&self) -> u32 {
            1
        }

        fn wait_matched(&self, _: u32, _: Duration) -> u32 {
            1
        }

        fn guid(&self) -> Guid {
            Guid([0; 16])
        }
    }

    #[test]
    fn a_burst_waits_for_its_readers_but_not_for_one_that_stands_still() {
        let writer = Slow::new(Some(10));
        let mut burst = Burst::default();
        (0..100).for_each(|_| burst.before_next(&writer, true, 8, 0));
        assert_eq!(writer.waited.load(Relaxed), 0, "each alone");
        (0..100).for_each(|_| burst.before_next(&writer, false, 8, 0));
        assert_eq!(writer.waited.load(Relaxed), 10);
        (0..100).for_each(|_| burst.before_next(&writer, false, 2000, 0));
        assert_eq!(writer.waited.load(Relaxed), 30, "fewer of long ones are kept");
        writer.stands_still.store(true, Relaxed);
        (0..1000).for_each(|_| burst.before_next(&writer, false, 8, 0));
        assert!(writer.waited.load(Relaxed) <= 32, "once in a while");
        // A burst does not wait for samples that were acknowledged meanwhile.
        let acknowledging = Slow { unacknowledged: [Some(3); 2], ..Slow::new(Some(10)) };
        let mut burst = Burst::default();
        (0..100).for_each(|_| burst.before_next(&acknowledging, false, 8, 0));
        assert_eq!(acknowledging.waited.load(Relaxed), 0);
        // A reader that acknowledged some in the longest wait is slow, and not stalled.
        for (after, is_stalled) in [(4, false), (10, true)] {
            let lagging = Slow { unacknowledged: [Some(10), Some(after)], ..Slow::new(Some(10)) };
            lagging.stands_still.store(true, Relaxed);
            let mut burst = Burst::default();
            (0..11).for_each(|_| burst.before_next(&lagging, false, 8, 0));
            assert_eq!((lagging.waited.load(Relaxed), burst.not_before.is_some()), (1, is_stalled));
            assert_eq!(burst.room.unacknowledged.load(Relaxed), after + 1);
        }
        let (writer, mut other) = (Slow::new(None), Burst::default());
        (0..100).for_each(|_| other.before_next(&writer, false, 8, 0));
        assert_eq!(writer.waited.load(Relaxed), 0, "one that blocks by itself");
    }

    #[test]
    fn there_is_room_while_what_was_written_is_acknowledged() {
        let writer = Slow::new(Some(10));
        let mut burst = Burst::default();
        for _ in 0..35 {
            assert!(burst.room.is_there(&writer, 8, 0));
            burst.before_next(&writer, true, 8, 0);
        }
        assert_eq!(writer.waited.load(Relaxed), 3, "asked when as many were written as are kept");
        writer.stands_still.store(true, Relaxed);
        for _ in 0..5 {
            assert!(burst.room.is_there(&writer, 8, 0));
            burst.before_next(&writer, true, 8, 0);
        }
        assert!(!burst.room.is_there(&writer, 8, 0), "ten are under way");
        assert!(Burst::default().room.is_there(&Slow::new(None), 8, 0));
        // Messages at their publisher's pace need no more room than it had; messages in a burst do.
        let hour_ns = 3_600_000_000_000;
        assert!(!burst.room.is_there(&writer, 8, hour_ns) && !burst.room.is_there(&writer, 8, -1));
        let begun = Instant::now();
        while !burst.room.is_there(&writer, 8, 1_000_000) {
            assert!(begun.elapsed() < Duration::from_secs(20));
            thread::yield_now();
        }
        assert!(!burst.room.is_there(&writer, 8, hour_ns));
    }

    /// Number and thread of each written message.
    type WriteLog = Arc<Mutex<Vec<(u64, thread::ThreadId)>>>;

    /// Creates a queue that records the thread of each message. Each write lasts until the gate opens.
    fn noting(gate: &Arc<Mutex<()>>) -> (Arc<WriterQueue>, WriteLog) {
        let taken = WriteLog::default();
        let (note, gate) = (taken.clone(), gate.clone());
        let queue = taking(move |message, _| {
            drop(gate.lock().unwrap());
            note.lock().unwrap().push((message.seq, thread::current().id()));
        });
        (queue, taken)
    }

    fn taking(take: impl FnMut(Message, NextMessage) + Send + 'static) -> Arc<WriterQueue> {
        let info = WriterInfo { is_free: Box::new(|_| true), ..WriterInfo::default() };
        let (alive, _) = mpsc::channel(1);
        WriterQueue::spawn_with("test", info, Shaping::default(), Arc::default(), alive, take).unwrap()
    }

    fn message(seq: u64, bytes: usize) -> Message {
        let head = MessageHead::new(MessageKind::Write, 1);
        Message { source: SourceId([1; 16]), seq, head, reliable: true, payload: vec![0; bytes].into() }
    }

    /// Queues a message as a sink does.
    fn give(queue: &WriterQueue, message: Message) {
        let bytes = message.payload.len();
        match queue.at_once(&message) {
            Some(mut take) => take(message, NextMessage::Nothing),
            None => queue.queue.try_push(message, bytes, WRITER_BYTES_MAX).unwrap(),
        }
    }

    fn sink(transient_local: bool) -> (Arc<LocalSink>, Arc<DataPlane>, WriteLog) {
        let (requests, _) = mpsc::channel(1);
        let sink = Arc::new(LocalSink::new(Name([1; 32]), transient_local, requests, Arc::default()));
        let (queue, taken) = noting(&Arc::default());
        sink.set_writer(None, Some(queue));
        (sink, Arc::default(), taken)
    }

    fn json(seq: u64, bytes: usize) -> Message {
        let plain = message(seq, bytes);
        Message { head: MessageHead { form: PayloadForm::Json, ..plain.head }, ..plain }
    }

    fn any_type() -> KnownType {
        let mut text = |_: &sgc_cdr::TypeName| Some("string a".to_owned());
        let layout = sgc_cdr::Library::empty().layout(&"p/msg/M".parse().unwrap(), &mut text);
        KnownType::Known(Arc::new(layout.unwrap()))
    }

    /// Waits until `is_so`, with a bound.
    async fn wait_until(is_so: impl Fn() -> bool) {
        let begun = Instant::now();
        while !is_so() {
            assert!(begun.elapsed() < Duration::from_secs(20), "it does not come");
            tokio::task::yield_now().await;
        }
    }

    #[tokio::test]
    async fn received_json_waits_until_the_owner_describes_its_type() {
        let (sink, data, taken) = sink(false);
        let seqs = || taken.lock().unwrap().iter().map(|(seq, _)| *seq).collect::<Vec<_>>();
        sink.set_type(KnownType::Asked, &data);
        for seq in 0..WRITER_MESSAGES_MAX as u64 + 3 {
            let lost = sink.write(json(seq, 8)).await;
            assert_eq!(lost, (seq >= WRITER_MESSAGES_MAX as u64).then_some((DataDrop::NoDefinition, 1)));
        }
        assert!(sink.lacks_definition());
        // Large messages are bounded by their bytes, and later ones do not overtake them.
        let lost = sink.write(json(5000, PENDING_BYTES_MAX)).await;
        assert_eq!(lost, Some((DataDrop::NoDefinition, WRITER_MESSAGES_MAX as u64)));
        assert_eq!(sink.write(json(5001, 8)).await, Some((DataDrop::NoDefinition, 1)));
        assert_eq!(sink.write(message(5002, 8)).await, None);
        assert!(seqs().is_empty());
        sink.set_type(any_type(), &data);
        wait_until(|| seqs().len() == 2).await;
        assert_eq!((seqs(), sink.delivered(), sink.lacks_definition()), (vec![5001, 5002], 2, false));
        // If the type stays unknown, messages that need no conversion are written.
        sink.set_type(KnownType::Asked, &data);
        assert_eq!(sink.write(json(5003, 8)).await, None);
        assert_eq!(sink.write(message(5004, 8)).await, None);
        sink.set_type(KnownType::Lacking, &data);
        wait_until(|| seqs().len() == 3).await;
        assert_eq!((seqs()[2], data.drops().snapshot()["no_definition"]), (5004, 1));
        sink.close();
    }

    #[tokio::test]
    async fn long_pending_message_is_written_only_if_kept_for_late_joiners() {
        for transient_local in [true, false] {
            let (sink, data, taken) = sink(transient_local);
            sink.set_type(KnownType::Asked, &data);
            let long_ago = Instant::now().checked_sub(Duration::from_secs(60)).unwrap();
            sink.lock().held.push(long_ago, 8, json(1, 8));
            let lost = sink.write(json(2, 8)).await;
            assert_eq!(lost, (!transient_local).then_some((DataDrop::NoDefinition, 1)));
            sink.set_type(any_type(), &data);
            let left = if transient_local { 2 } else { 1 };
            wait_until(|| taken.lock().unwrap().len() == left).await;
            assert_eq!(sink.delivered(), left as u64);
            sink.close();
        }
    }

    #[tokio::test]
    async fn messages_of_a_successor_are_written_after_the_backlog_of_its_predecessor() {
        let taken = Arc::<Mutex<Vec<_>>>::default();
        let noted = |before: Box<dyn Fn() + Send>| {
            let taken = taken.clone();
            taking(move |message, next| {
                before();
                taken.lock().unwrap().push((message.seq, next));
            })
        };
        let write = |sink: &Arc<LocalSink>, message| {
            let written = sink.write_now(message, &mut sink.lock().held);
            assert_eq!(written.ok(), Some(None));
        };
        let (sink, _, _) = sink(false);
        let [killed, restarted] = [[1; 16], [2; 16]].map(SourceId);
        // The consumer blocks until the sender is dropped.
        let (stuck, gate) = std::sync::mpsc::channel::<()>();
        let wait = move || {
            let _ = gate.recv();
        };
        sink.set_writer(Some(killed), Some(noted(Box::new(wait))));
        // The long message keeps the thread busy, so the others queue up.
        write(&sink, message(0, AT_ONCE_BYTES_MAX + 1));
        (1..50).for_each(|seq| write(&sink, message(seq, 16)));
        sink.set_writer(Some(killed), None);
        sink.set_writer(Some(restarted), Some(noted(Box::new(|| ()))));
        for _ in 0..10 {
            tokio::task::yield_now().await;
            assert_eq!(sink.lock().releases, 1, "messages that come now wait");
        }
        drop(stuck);
        wait_until(|| sink.lock().releases == 0).await;
        write(&sink, Message { source: restarted, ..message(50, 16) });
        let taken = taken.lock().unwrap();
        assert!(taken.iter().map(|(seq, _)| *seq).eq(0..=50), "{taken:?}");
        // The first message may be taken before the queue is closed, and the last one has none behind it.
        assert!(taken[1..49].iter().all(|(_, next)| *next == NextMessage::Last), "{taken:?}");
        sink.close();
    }

    #[tokio::test]
    async fn liveliness_of_a_writer_is_asserted_once_in_a_while() {
        let count = Arc::new(AtomicUsize::new(0));
        let counted = count.clone();
        let assert = Box::new(move || {
            counted.fetch_add(1, Relaxed);
        });
        let info = WriterInfo { assert: Some(assert), ..WriterInfo::default() };
        let (alive, _) = mpsc::channel(1);
        let (shaping, drops) = (Shaping::default(), Arc::default());
        let queue = WriterQueue::spawn_with("test", info, shaping, drops, alive, |_, _| ()).unwrap();
        let begun = Instant::now();
        wait_until(|| {
            queue.assert_liveliness();
            count.load(Relaxed) == 3
        })
        .await;
        assert!(begun.elapsed() >= 2 * ASSERTION_SPACING);
        queue.close();
    }

    #[tokio::test]
    async fn writers_end_with_their_sink() {
        let (sink, _, _) = sink(false);
        let writer = sink.writer(&SourceId([1; 16])).unwrap();
        drop(sink);
        let ended = tokio::time::timeout(Duration::from_secs(20), writer.ended()).await;
        assert!(ended.is_ok(), "its thread goes on");
    }

    #[tokio::test]
    async fn receiving_task_writes_a_message_unless_others_are_ahead() {
        let gate = Arc::default();
        let (queue, taken) = noting(&gate);
        give(&queue, message(0, 16));
        assert_eq!(*taken.lock().unwrap(), [(0, thread::current().id())]);
        let is_stuck = gate.lock().unwrap();
        // The thread writes the long message, and later ones do not overtake it.
        give(&queue, message(1, AT_ONCE_BYTES_MAX + 1));
        (2..100).for_each(|seq| give(&queue, message(seq, 16)));
        drop(is_stuck);
        let begun = Instant::now();
        while taken.lock().unwrap().len() < 100 {
            assert!(begun.elapsed() < Duration::from_secs(20));
            thread::yield_now();
        }
        let taken = taken.lock().unwrap();
        assert!(taken.iter().map(|(seq, _)| *seq).eq(0..100));
        assert!(taken[1..].iter().all(|(_, by)| *by != thread::current().id()));
        queue.close();
    }

    #[tokio::test]
    async fn sources_that_never_had_a_writer_are_forgotten_with_those_of_the_sink() {
        let (requests, _receiver) = mpsc::channel(1);
        let sink = Arc::new(LocalSink::new(Name([1; 32]), false, requests, Arc::default()));
        let (id, key, suite) = (SinkId([9; 16]), SecretBytes::new([3; 32]), Suite::Group);
        let data = Arc::<DataPlane>::default();
        let grant = TopicGrant { epoch: 1, suite: suite.id(), key, sources: Vec::new(), entry: None };
        sink.grant(id, grant.clone(), &data);
        let sources_max = SinkLimits::default().sources_max;
        for n in 0..2 * sources_max as u128 {
            let config = SourceConfig {
                name: sink.name,
                id: SourceId(n.to_be_bytes()),
                class: Class::Default,
                reliable: true,
                history_depth: 1,
                history_bytes_max: 1 << 10,
                recovery: RecoveryLimits::default(),
            };
            let mut source = Source::new(config, &grant, MessageKey::generate(suite)).unwrap();
            let mut packets = Vec::new();
            let head = MessageHead::new(MessageKind::Write, 1);
            source
                .publish(&head, Bytes::from_static(b"first"), false, |packet| packets.push(packet))
                .unwrap();
            for packet in packets {
                assert_eq!(sink.deliver(packet, data.drops()).await, None, "it is parked");
            }
            sink.grant(id, TopicGrant { sources: vec![source.announce()], ..grant.clone() }, &data);
        }
        let missed = sink.lock().missed.len();
        assert!((1..=sources_max).contains(&missed), "{missed} sources are remembered");
    }
}
