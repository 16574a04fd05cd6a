//! The queue in front of a local writer.
//!
//! Writing may block, so a [worker](sgc_sync::Workers) writes the messages of a bounded queue. If the writer cannot
//! block and its queue is empty, the receiving task writes a short message itself. [`crate::data::sinks`] opens packets
//! and chooses the queue; [`crate::data::burst`] paces the writes.

use std::collections::VecDeque;
use std::num::NonZeroU64;
use std::sync::atomic::{AtomicBool, Ordering::Relaxed, Ordering::SeqCst};
use std::sync::{Arc, Mutex, MutexGuard, Weak};
use std::time::{Duration, Instant};

use arc_swap::ArcSwapOption;
use sgc_endpoint::{Decompressor, Message};
use sgc_ros::{
    EndpointSpec, Guid, RosError, RosWriter, SampleHead, SampleKind, Shaping, for_all_instances,
    prefix_frames,
};
use sgc_session::Shaper;
use sgc_sync::{Work, Workers, lock};
use sgc_wire::{History, KEY_HASH_BYTES, Liveliness, MessageHead, MessageKind, PayloadForm};
use tokio::runtime::Handle;
use tokio::sync::mpsc;
use tokio::time::sleep_until;
use tracing::warn;

use crate::data::burst::{Arrival, Burst};
use crate::data::conversion::{self, TypeSlot};
use crate::data::queue::{PushError, PushOutcome, Queue};
use crate::data::stats::{DataDrop, Drops};
use crate::drops::NodeDrop;

/// Most messages that wait for one local writer.
pub(crate) const WRITER_MESSAGES_MAX: usize = 1024;
/// Most bytes that wait for one local writer.
const WRITER_BYTES_MAX: usize = 16 << 20;
/// Most delay of a wake-up of a worker; Linux's default is 50 µs.
const TIMER_SLACK_NS: u64 = 1_000;
/// Messages of a transient-local writer that are remembered, to recognise repetitions.
const RECENT_MAX: usize = 4096;
/// The longest message that the receiving task writes itself.
pub(crate) const AT_ONCE_BYTES_MAX: usize = 16 << 10;
/// Least time between two liveliness assertions of a writer. It is shorter than any lease that is asserted.
const ASSERTION_SPACING: Duration = Duration::from_millis(20);
/// Longest time for which messages of a reliable writer wait for a local reader, if the writer is new or [was
/// silent](SILENCE_MIN). DDS programs that start together find each other within about a second.
const FIRST_READER_WAIT_MAX: Duration = Duration::from_secs(2);
/// Messages do not wait for the first reader once they fill half of this, or half of the places in the queue.
const FIRST_READER_BYTES_MAX: usize = 2 << 20;
/// Time between two looks for the first reader, at first and at most.
const FIRST_READER_LOOK: Duration = Duration::from_millis(5);
const FIRST_READER_LOOK_MAX: Duration = Duration::from_millis(50);
/// Silence after which a writer that lost its readers counts as new. A publisher that is restarted publishes through
/// the writer of the one before, and its subscriber may be restarted with it.
const SILENCE_MIN: Duration = Duration::from_millis(200);
/// Longest time that a local writer may block the network.
const WRITER_PATIENCE: Duration = Duration::from_secs(5);

/// The threads, counters and sign of life that all writers of a node share.
#[derive(Clone, Debug)]
pub(crate) struct WriterContext {
    workers: Workers,
    /// Counts messages that are not written.
    drops: Arc<Drops>,
    /// Dropped with the last writer.
    alive: mpsc::Sender<()>,
}

impl WriterContext {
    pub(crate) fn new(workers: Workers, drops: Arc<Drops>, alive: mpsc::Sender<()>) -> Self {
        Self { workers, drops, alive }
    }
}

/// Starts the threads that write to the local network.
///
/// # Errors
/// The system has no room for a thread.
pub(crate) fn start_workers() -> std::io::Result<Workers> {
    Workers::start("sgc-write", || {
        // Without it, the pauses of a burst overrun by as much as they are long.
        let _ = rustix::thread::set_current_timer_slack(NonZeroU64::new(TIMER_SLACK_NS));
    })
}

/// The queue in front of a local writer.
pub(crate) struct WriterQueue {
    /// Itself, for the worker.
    this: Weak<Self>,
    queue: Queue<Message>,
    shaper: Mutex<Shaper>,
    /// Whether no shaping is configured, readable without the lock.
    is_unshaped: AtomicBool,
    /// Held by the worker from before it takes a message until it has consumed it, so that no other message overtakes.
    consumer: Mutex<Consumer>,
    workers: Workers,
    drops: Arc<Drops>,
    /// Whether a worker is at work or about to begin.
    is_at_work: AtomicBool,
    /// Whether there may be something to do that the worker has not looked at.
    is_told: AtomicBool,
    /// Whether messages wait for the next look for the first reader.
    awaits_look: AtomicBool,
    runtime: Handle,
    info: WriterInfo,
    /// Whether messages wait until the writer has a reader, and since when.
    awaits_reader: AtomicBool,
    awaits_since: Mutex<Instant>,
    /// Whether the writer ever had a reader, as far as that was seen.
    had_reader: AtomicBool,
    /// Whether messages never wait for a reader.
    is_hurried: AtomicBool,
    /// Whether liveliness was asserted just now, or is being asserted.
    is_asserted: Arc<AtomicBool>,
    /// Closed once everything is consumed.
    ended: mpsc::Sender<()>,
}

/// The consumer of a queue, with what it has taken and not consumed.
struct Consumer {
    take: MessageConsumer,
    held: Option<Held>,
    /// The time until the next look for the first reader.
    look: Duration,
    /// When the timer runs out.
    rings_at: Option<Instant>,
    /// Dropped once everything is consumed.
    keeps_open: Option<mpsc::Receiver<()>>,
    /// Dropped behind what consumes.
    alive: Option<mpsc::Sender<()>>,
}

/// The next message, which has left the queue.
struct Held {
    message: Message,
    /// Whether newer messages replaced it while it waited.
    gave_way: bool,
}

/// The wait of a message for its time.
#[derive(Clone, Copy)]
struct Later {
    due: Instant,
    /// Whether newer messages replace it.
    gives_way: bool,
}

/// The state of a writer's wait for its first reader.
enum FirstReader {
    /// Messages wait until this time, when it is looked for again.
    LookAt(Instant),
    /// Messages wait no longer, or none did. So many waited in vain.
    WaitIsOver { unheard: usize },
}

/// The next step of a consumer.
enum Step {
    Take(Message),
    /// The next message waits for this time.
    Later(Instant),
    Rest,
}

/// Prefix of frame names, if there is one. Writers share it.
pub(crate) type FramePrefix = Arc<ArcSwapOption<String>>;

/// State of the queue behind a message that is taken.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum NextMessage {
    /// The queue is empty.
    Nothing,
    /// The queue is empty, and the consumer may not wait.
    NothingAtOnce,
    /// The next message waits for its time.
    Later,
    /// The next message follows at once.
    AtOnce,
    /// The next message follows at once, and the queue is closed: messages of another writer wait for it.
    Last,
    /// The next message follows at once. Neither has a reader, so they need no pause between them.
    Unheard,
}

impl NextMessage {
    /// Returns `true` if the next message is taken without a pause.
    fn is_at_once(self) -> bool {
        matches!(self, Self::AtOnce | Self::Last | Self::Unheard)
    }

    /// Returns `true` if the publisher's pace is kept for the readers.
    fn keeps_pace(self) -> bool {
        !matches!(self, Self::Last | Self::Unheard)
    }
}

/// Outcome of handing a message to a queue without waiting.
#[derive(Debug, PartialEq, Eq)]
#[must_use]
pub(crate) enum WriteOutcome {
    /// The message is written or queued; so many best-effort messages were evicted for it.
    Taken { evicted: u64 },
    /// The message is returned: it has to wait for room.
    Full(Message),
}

/// Consumes the messages of a queue one by one.
type MessageConsumer = Box<dyn FnMut(Message, NextMessage) + Send>;

/// Properties of the writer behind a queue.
pub(crate) struct WriterInfo {
    guid: Guid,
    recent: Option<Mutex<Recent>>,
    /// `true` if the first messages wait for a reader: it could not get them later.
    awaits_reader: bool,
    /// Returns the number of matched local readers.
    matched: Box<dyn Fn() -> u32 + Send + Sync>,
    /// Returns the time of the last write.
    last_written: Box<dyn Fn() -> Option<Instant> + Send + Sync>,
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
            awaits_reader: false,
            matched: Box::new(|| 0),
            last_written: Box::new(|| None),
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
    /// Creates the queue of a writer, which is dropped once the queue is closed and empty. `frames` applies to tf
    /// messages, `types` to messages that arrive as JSON.
    pub(crate) fn of_writer<W: RosWriter>(
        context: WriterContext,
        writer: W,
        spec: &EndpointSpec,
        shaping: Shaping,
        frames: Option<FramePrefix>,
        types: Arc<TypeSlot>,
    ) -> Arc<Self> {
        let (counted, topic) = (context.drops.clone(), spec.topic.clone());
        let in_topic = topic.clone();
        let writer = Arc::new(writer);
        // Only the consumer owns the writer, so the writer is dropped where it may block.
        let weak = Arc::downgrade(&writer);
        let mut burst = Burst::default();
        // Cyclone's writers block only if they have to keep all samples until they are acknowledged.
        let never_blocks = !spec.qos.is_reliable() || matches!(spec.qos.history, History::KeepLast(_));
        let (room, of_room) = (burst.room.clone(), weak.clone());
        let noted = room.clone();
        let last_written = Box::new(move || noted.spacing().last_written());
        let is_free = Box::new(move |message: &Message| {
            let (bytes, published_ns) = (written_bytes(message), message.head.source_timestamp_ns);
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
        let awaits_reader = spec.qos.is_reliable() && !spec.qos.is_transient_local();
        let (guid, recent) = (writer.guid(), Recent::new(spec));
        let info = WriterInfo { guid, recent, awaits_reader, matched, last_written, is_free, resize, assert };
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
                    if counted.count(NodeDrop::Decompress) {
                        warn!(%in_topic, %error, "a message is not written to the local network; counted from here on");
                    }
                    return None;
                }
            };
            let payload = match message.head.form {
                PayloadForm::Cdr => payload,
                PayloadForm::KeyedCdr => {
                    let Some(hash) = payload.first_chunk::<KEY_HASH_BYTES>().copied() else {
                        counted.count(NodeDrop::KeyHash);
                        return None;
                    };
                    key_hash = Some(hash);
                    payload.slice(KEY_HASH_BYTES..)
                }
                PayloadForm::Json => {
                    let known = types.now();
                    let Some(layout) = known.layout() else {
                        // The type was known when the message was queued.
                        counted.count(NodeDrop::JsonUnknownType);
                        return None;
                    };
                    match conversion::from_json(layout, &payload, offered) {
                        Ok(payload) => payload,
                        Err(error) => {
                            if counted.count(NodeDrop::JsonRefused) {
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
                        if counted.count(NodeDrop::Frames) {
                            warn!(%in_topic, %error, "a message is not written to the local network; counted from here on");
                        }
                        return None;
                    }
                },
            };
            let source_timestamp_ns = message.head.source_timestamp_ns;
            Some((SampleHead { kind, source_timestamp_ns, key_hash }, payload))
        };
        let refused = context.drops.clone();
        Self::new(context, info, shaping, move |message, next| {
            let source = message.source;
            let Some((head, payload)) = prepare(message) else {
                return if !next.is_at_once() {
                    writer.flush()
                };
            };
            if next.keeps_pace() {
                burst.room.space(&*writer, source, head.source_timestamp_ns);
            }
            let arrival = match next {
                NextMessage::Nothing => Arrival::Alone,
                NextMessage::NothingAtOnce => Arrival::AtOnce,
                NextMessage::Later | NextMessage::AtOnce | NextMessage::Last | NextMessage::Unheard => {
                    Arrival::InBurst
                }
            };
            burst.before_next(&*writer, arrival, payload.len(), head.source_timestamp_ns);
            let written = writer.write_ahead(head, payload);
            if !next.is_at_once() {
                writer.flush();
            }
            if let Err(error) = written
                && refused.count(write_drop(&error))
            {
                warn!(%topic, %error, "a message could not be given to the local network; counted from here on");
            }
        })
    }

    /// Creates a queue with another consumer, which also learns the state of the queue behind each message. The
    /// consumer may block, except for a short message that `info` declares free.
    pub(crate) fn new(
        context: WriterContext,
        info: WriterInfo,
        shaping: Shaping,
        take: impl FnMut(Message, NextMessage) + Send + 'static,
    ) -> Arc<Self> {
        let mut shaper = Shaper::default();
        shaper.set(shaping);
        let WriterContext { workers, drops, alive } = context;
        let (ended, keeps_open) = mpsc::channel(1);
        let consumer = Consumer {
            take: Box::new(take),
            held: None,
            look: FIRST_READER_LOOK,
            rings_at: None,
            keeps_open: Some(keeps_open),
            alive: Some(alive),
        };
        Arc::new_cyclic(|this| Self {
            this: this.clone(),
            queue: Queue::new(WRITER_MESSAGES_MAX),
            shaper: shaper.into(),
            is_unshaped: AtomicBool::new(shaping == Shaping::default()),
            consumer: consumer.into(),
            workers,
            drops,
            is_at_work: AtomicBool::new(false),
            is_told: AtomicBool::new(false),
            awaits_look: AtomicBool::new(false),
            runtime: Handle::current(),
            awaits_reader: AtomicBool::new(info.awaits_reader),
            awaits_since: Mutex::new(Instant::now()),
            had_reader: AtomicBool::new(false),
            is_hurried: AtomicBool::new(false),
            info,
            is_asserted: Arc::default(),
            ended,
        })
    }

    /// Has a worker consume what is queued, unless that waits for the next look for the first reader.
    fn wake(&self) {
        if !(self.awaits_look.load(SeqCst) && self.queue.has_headroom(FIRST_READER_BYTES_MAX)) {
            self.work();
        }
    }

    fn work(&self) {
        self.is_told.store(true, SeqCst);
        if !self.is_at_work.swap(true, SeqCst)
            && let Some(this) = self.this.upgrade()
        {
            self.workers.run(this);
        }
    }

    /// Consumes what is queued and due. Returns when a timer has to run out, if one has to be set.
    fn consume(&self) -> Option<Instant> {
        let mut consumer = lock(&self.consumer);
        let consumer = &mut *consumer;
        self.is_told.swap(false, SeqCst);
        // A timer that runs out tells later than its time, and never earlier.
        consumer.rings_at = consumer.rings_at.filter(|at| *at > Instant::now());
        self.awaits_look.store(false, SeqCst);
        let later = match self.await_first_reader(consumer) {
            FirstReader::LookAt(at) => {
                self.awaits_look.store(true, SeqCst);
                Some(at)
            }
            FirstReader::WaitIsOver { unheard } => self.take_all(consumer, unheard),
        };
        if later.is_none() && self.queue.is_closed() && self.queue.is_empty() {
            consumer.keeps_open = None;
            // This drops a writer, which may block.
            consumer.take = Box::new(|_, _| ());
            consumer.alive = None;
        }
        let is_set = |later: &Instant| consumer.rings_at.is_some_and(|at| at <= *later);
        let rings_at = later.filter(|later| !is_set(later));
        consumer.rings_at = rings_at.or(consumer.rings_at);
        rings_at
    }

    /// Consumes all messages, up to one that waits for the time that is returned.
    fn take_all(&self, consumer: &mut Consumer, mut unheard: usize) -> Option<Instant> {
        loop {
            let message = match self.next(&mut consumer.held) {
                Step::Take(message) => message,
                Step::Later(at) => return Some(at),
                Step::Rest => return None,
            };
            let next = match consumer.held.is_none() && self.queue.is_empty() {
                true => NextMessage::Nothing,
                false if unheard > 1 => NextMessage::Unheard,
                false if self.queue.is_closed() => NextMessage::Last,
                false if self.is_unshaped.load(Relaxed) => NextMessage::AtOnce,
                false => NextMessage::Later,
            };
            unheard = unheard.saturating_sub(1);
            (consumer.take)(message, next);
        }
    }

    /// Looks for the first reader, for a bounded time, if the writer is new or was silent and messages wait.
    fn await_first_reader(&self, consumer: &mut Consumer) -> FirstReader {
        let nothing_waits = FirstReader::WaitIsOver { unheard: 0 };
        if !self.awaits_reader.load(Relaxed) || self.queue.is_empty() {
            return nothing_waits;
        }
        let has_reader = self.matched() > 0;
        let may_wait = lock(&self.awaits_since).elapsed() < FIRST_READER_WAIT_MAX
            && self.queue.has_headroom(FIRST_READER_BYTES_MAX)
            && !self.queue.is_closed();
        if !has_reader && may_wait {
            let look = consumer.look;
            consumer.look = (look * 2).min(FIRST_READER_LOOK_MAX);
            return FirstReader::LookAt(Instant::now() + look);
        }
        consumer.look = FIRST_READER_LOOK;
        self.awaits_reader.store(false, Relaxed);
        if has_reader {
            self.had_reader.store(true, Relaxed);
            return nothing_waits;
        }
        FirstReader::WaitIsOver { unheard: self.queue.len() }
    }

    /// Lets messages wait for a reader again, if the writer has lost its readers and was silent.
    fn note_silence(&self) {
        if !self.info.awaits_reader || self.is_hurried.load(Relaxed) {
            return;
        }
        if self.matched() > 0 {
            if !self.had_reader.load(Relaxed) {
                self.had_reader.store(true, Relaxed);
            }
            return;
        }
        let was_silent = || self.last_written().is_some_and(|at| at.elapsed() >= SILENCE_MIN);
        if self.had_reader.load(Relaxed) && !self.awaits_reader.load(Relaxed) && was_silent() {
            *lock(&self.awaits_since) = Instant::now();
            self.awaits_reader.store(true, Relaxed);
        }
    }

    /// Returns the consumer if it takes a message now without blocking and the queue is empty. Only one caller queues
    /// at a time.
    fn at_once(&self, message: &Message) -> Option<MutexGuard<'_, Consumer>> {
        let may = written_bytes(message) <= AT_ONCE_BYTES_MAX && self.is_unshaped.load(Relaxed);
        let consumer = if may { self.consumer.try_lock().ok() } else { None };
        let is_free = |consumer: &MutexGuard<'_, Consumer>| {
            consumer.held.is_none()
                && !self.awaits_reader.load(Relaxed)
                && self.queue.is_empty()
                && !self.queue.is_closed()
                && (self.info.is_free)(message)
        };
        consumer.filter(is_free)
    }

    /// Writes a message on the caller's thread if `may_write` and nothing is ahead of it, or queues it if there is
    /// room.
    pub(crate) fn try_push(&self, message: Message, may_write: bool) -> WriteOutcome {
        let (bytes, head) = (message.payload.len(), message.head);
        self.note_silence();
        let mut evicted = 0;
        let at_once = may_write.then(|| self.at_once(&message)).flatten();
        if let Some(mut consumer) = at_once {
            (consumer.take)(message, NextMessage::NothingAtOnce);
        } else if message.reliable {
            match self.queue.try_push(message, bytes, WRITER_BYTES_MAX) {
                PushOutcome::Queued => self.wake(),
                PushOutcome::NotQueued(message) => return WriteOutcome::Full(message),
            }
        } else {
            self.queue.push_evicting(message, bytes, WRITER_BYTES_MAX, |_| evicted += 1);
            self.wake();
        }
        self.remember(&head);
        WriteOutcome::Taken { evicted }
    }

    /// Queues a message once there is room. Fails if there is none for too long.
    pub(crate) async fn push(&self, message: Message) -> Result<(), PushError> {
        let (bytes, head) = (message.payload.len(), message.head);
        self.note_silence();
        self.queue.push(message, bytes, WRITER_BYTES_MAX, WRITER_PATIENCE).await?;
        self.wake();
        self.remember(&head);
        Ok(())
    }

    /// Has messages never wait for a local reader, because those that waited would be late.
    pub(crate) fn wait_for_no_reader(&self) {
        self.is_hurried.store(true, Relaxed);
        self.awaits_reader.store(false, Relaxed);
    }

    /// Returns the number of matched local readers.
    pub(crate) fn matched(&self) -> u32 {
        (self.info.matched)()
    }

    /// Returns the time of the last write.
    pub(crate) fn last_written(&self) -> Option<Instant> {
        (self.info.last_written)()
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

    /// Returns `true` if there is a limit of age.
    pub(crate) fn limits_age(&self) -> bool {
        !self.is_unshaped.load(Relaxed) && self.shaper().shaping().max_age.is_some()
    }

    /// Returns `true` if a message is too old by its least age in ns, or while that is not known by the clock of this node,
    /// where the fastest message of the publisher counts as new.
    pub(crate) fn is_too_old(&self, now_ns: i64, head: &MessageHead, least_age: Option<i64>) -> bool {
        let mut shaper = self.shaper();
        match (least_age, shaper.shaping().max_age) {
            (_, None) => false,
            (Some(age), Some(max)) => Duration::from_nanos(age.max(0).unsigned_abs()) > max,
            (None, Some(_)) => shaper.is_too_old(now_ns, head.source_timestamp_ns),
        }
    }

    /// Takes the next message if it is due, or the newest one if later messages replace it.
    fn next(&self, held: &mut Option<Held>) -> Step {
        let of_queue = || Some(Held { message: self.queue.try_pop()?, gave_way: false });
        let Some(Held { mut message, gave_way }) = held.take().or_else(of_queue) else { return Step::Rest };
        loop {
            let later = self.later(&message);
            let gives_way = match later {
                Some(later) => later.gives_way,
                // Those that came while it waited replace it, unless it waits no more for another reason.
                None => gave_way && !self.queue.is_closed() && self.shaper().thins(message.reliable),
            };
            match if gives_way { self.queue.try_pop() } else { None } {
                Some(newer) if newer.head.kind == MessageKind::Write => {
                    self.drops.count(DataDrop::Thinned);
                    message = newer;
                    continue;
                }
                // The end of an instance is never skipped, nor is the message before it.
                Some(end) => *held = Some(Held { message: end, gave_way: false }),
                None => {
                    if let Some(Later { due, .. }) = later {
                        *held = Some(Held { message, gave_way: gives_way });
                        return Step::Later(due);
                    }
                }
            }
            if message.head.kind == MessageKind::Write {
                self.shaper().takes(Instant::now(), message.payload.len());
            }
            return Step::Take(message);
        }
    }

    /// Returns until when a message waits, unless it is due.
    fn later(&self, message: &Message) -> Option<Later> {
        if message.head.kind != MessageKind::Write || self.queue.is_closed() {
            return None;
        }
        let (now, shaper) = (Instant::now(), self.shaper());
        let due = shaper.due().filter(|_| !shaper.is_due(now))?;
        Some(Later { due, gives_way: shaper.gives_way(now, message.reliable) })
    }

    /// Sets the number of messages that late joiners get. May block.
    pub(crate) fn resize(&self, depth: u32) {
        self.with_recent(|recent| recent.keep(depth as usize));
        (self.info.resize)(depth);
    }

    /// Asserts the writer's liveliness, at most once in [`ASSERTION_SPACING`].
    pub(crate) fn assert_liveliness(self: &Arc<Self>) {
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
    pub(crate) fn begin_again(&self) {
        self.with_recent(|recent| recent.again = true);
    }

    /// Returns `true` if a message was written before. Its time stamp tells, since a publisher never uses one twice.
    /// After the first new message, all are new.
    pub(crate) fn has_written(&self, head: &MessageHead) -> bool {
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

    /// Closes the queue. What consumes it is dropped after it is empty.
    pub(crate) fn close(&self) {
        self.queue.close();
        self.work();
    }

    /// Waits until everything is consumed.
    pub(crate) async fn ended(&self) {
        self.ended.closed().await;
    }

    /// Returns `true` if a worker may have something to do.
    fn has_work(&self) -> bool {
        self.is_told.load(SeqCst) || (self.queue.is_closed() && !self.ended.is_closed())
    }

    /// Lets a worker begin at this time.
    fn set_timer(&self, at: Instant) {
        let this = self.this.clone();
        self.runtime.spawn(async move {
            sleep_until(at.into()).await;
            if let Some(this) = this.upgrade() {
                this.work();
            }
        });
    }
}

impl Work for WriterQueue {
    fn run(self: Arc<Self>) {
        loop {
            if let Some(at) = self.consume() {
                self.set_timer(at);
            }
            self.is_at_work.swap(false, SeqCst);
            // A message may have come, or the queue may have been closed, while nobody was told.
            if !self.has_work() || self.is_at_work.swap(true, SeqCst) {
                return;
            }
        }
    }
}

/// Returns the length of the payload that the writer writes. A compressed message is decompressed first.
fn written_bytes(message: &Message) -> usize {
    let bytes = Decompressor::original_bytes(message.head.encoding, &message.payload);
    let is_keyed = message.head.form == PayloadForm::KeyedCdr;
    if is_keyed { bytes.saturating_sub(KEY_HASH_BYTES) } else { bytes }
}

/// Returns the counter of a failure.
pub(crate) fn write_drop(error: &RosError) -> NodeDrop {
    match error {
        RosError::Payload { .. } => NodeDrop::WritePayload,
        RosError::WriteTimeout { .. } => NodeDrop::WriteTimeout,
        RosError::NoPeer { .. } => NodeDrop::NoLocalPeer,
        RosError::KeyUnknown => NodeDrop::KeyUnknown,
        _ => NodeDrop::WriteFailed,
    }
}

#[cfg(test)]
pub(crate) mod tests {
    use std::sync::atomic::{AtomicU32, AtomicUsize, Ordering::Relaxed};
    use std::thread;

    use sgc_wire::{PayloadEncoding, SourceId};

    use super::*;

    /// Number and thread of each written message.
    pub(crate) type WriteLog = Arc<Mutex<Vec<(u64, thread::ThreadId)>>>;

    /// Creates a queue that records the thread of each message. Each write lasts until the gate opens.
    pub(crate) fn noting(gate: &Arc<Mutex<()>>) -> (Arc<WriterQueue>, WriteLog) {
        let taken = WriteLog::default();
        let (note, gate) = (taken.clone(), gate.clone());
        let queue = taking(move |message, _| {
            drop(gate.lock().unwrap());
            note.lock().unwrap().push((message.seq, thread::current().id()));
        });
        (queue, taken)
    }

    pub(crate) fn taking(take: impl FnMut(Message, NextMessage) + Send + 'static) -> Arc<WriterQueue> {
        let (is_free, matched) = (Box::new(|_: &_| true), Box::new(|| 1));
        let info = WriterInfo { is_free, matched, ..WriterInfo::default() };
        WriterQueue::new(context(), info, Shaping::default(), take)
    }

    /// Returns a context for queues of one test.
    pub(crate) fn context() -> WriterContext {
        let (alive, _) = mpsc::channel(1);
        WriterContext::new(start_workers().unwrap(), Arc::default(), alive)
    }

    pub(crate) fn message(seq: u64, bytes: usize) -> Message {
        let head = MessageHead::new(MessageKind::Write, 1);
        Message { source: SourceId([1; 16]), seq, head, reliable: true, payload: vec![0; bytes].into() }
    }

    /// Queues a message as a sink does.
    fn give(queue: &WriterQueue, message: Message) {
        assert_eq!(queue.try_push(message, true), WriteOutcome::Taken { evicted: 0 });
    }

    /// Waits until `is_so`, with a bound.
    pub(crate) async fn wait_until(is_so: impl Fn() -> bool) {
        let begun = Instant::now();
        while !is_so() {
            assert!(begun.elapsed() < Duration::from_secs(20), "it does not come");
            tokio::task::yield_now().await;
        }
    }

    #[tokio::test]
    async fn liveliness_of_a_writer_is_asserted_once_in_a_while() {
        let count = Arc::new(AtomicUsize::new(0));
        let counted = count.clone();
        let assert = Box::new(move || {
            counted.fetch_add(1, Relaxed);
        });
        let info = WriterInfo { assert: Some(assert), ..WriterInfo::default() };
        let queue = WriterQueue::new(context(), info, Shaping::default(), |_, _| ());
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
    async fn receiving_task_writes_a_message_unless_others_are_ahead() {
        let gate = Arc::default();
        let (queue, taken) = noting(&gate);
        give(&queue, message(0, 16));
        assert_eq!(*taken.lock().unwrap(), [(0, thread::current().id())]);
        let is_stuck = gate.lock().unwrap();
        // A worker writes the long message, and later ones do not overtake it.
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

    /// The numbers of the written messages, with the state of the queue behind each.
    type OrderLog = Arc<Mutex<Vec<(u64, NextMessage)>>>;

    /// Creates a queue whose messages wait for a reader, with the number of readers, and a log of what is written.
    fn awaiting() -> (Arc<WriterQueue>, Arc<AtomicU32>, OrderLog) {
        let (readers, written) = (Arc::new(AtomicU32::new(0)), OrderLog::default());
        let (matched, log) = (readers.clone(), written.clone());
        let last = Arc::new(Mutex::new(None));
        let noted = last.clone();
        let info = WriterInfo {
            awaits_reader: true,
            matched: Box::new(move || matched.load(Relaxed)),
            is_free: Box::new(|_| true),
            last_written: Box::new(move || *last.lock().unwrap()),
            ..WriterInfo::default()
        };
        let take = move |message: Message, next| {
            *noted.lock().unwrap() = Some(Instant::now());
            log.lock().unwrap().push((message.seq, next));
        };
        let queue = WriterQueue::new(context(), info, Shaping::default(), take);
        (queue, readers, written)
    }

    #[tokio::test]
    async fn first_messages_wait_for_the_first_reader() {
        let (queue, readers, written) = awaiting();
        (0..3).for_each(|seq| give(&queue, message(seq, 16)));
        tokio::time::sleep(4 * FIRST_READER_LOOK).await;
        assert_eq!(*written.lock().unwrap(), []);
        readers.store(1, Relaxed);
        wait_until(|| written.lock().unwrap().len() == 3).await;
        assert!(queue.awaits_since.lock().unwrap().elapsed() < FIRST_READER_WAIT_MAX);
        let order = [(0, NextMessage::AtOnce), (1, NextMessage::AtOnce), (2, NextMessage::Nothing)];
        assert_eq!(*written.lock().unwrap(), order, "in order and at the publisher's pace");
        // Later messages wait no more, even without readers.
        readers.store(0, Relaxed);
        wait_until(|| {
            queue.try_push(message(3, 16), true) == WriteOutcome::Taken { evicted: 0 }
                && written.lock().unwrap().iter().any(|(seq, _)| *seq == 3)
        })
        .await;
        queue.close();
    }

    #[tokio::test]
    async fn first_messages_after_a_silence_wait_for_a_reader_that_comes_again() {
        let (queue, readers, written) = awaiting();
        readers.store(1, Relaxed);
        give(&queue, message(0, 16));
        wait_until(|| written.lock().unwrap().len() == 1).await;
        // The publisher and its subscriber are restarted.
        readers.store(0, Relaxed);
        tokio::time::sleep(SILENCE_MIN).await;
        (1..3).for_each(|seq| give(&queue, message(seq, 16)));
        tokio::time::sleep(4 * FIRST_READER_LOOK).await;
        assert_eq!(written.lock().unwrap().len(), 1);
        readers.store(1, Relaxed);
        wait_until(|| written.lock().unwrap().len() == 3).await;
        assert!(queue.awaits_since.lock().unwrap().elapsed() < FIRST_READER_WAIT_MAX);
        // A publisher that goes on does not wait for subscribers.
        readers.store(0, Relaxed);
        wait_until(|| {
            give(&queue, message(3, 16));
            written.lock().unwrap().iter().any(|(seq, _)| *seq == 3)
        })
        .await;
        queue.close();
    }

    #[tokio::test]
    async fn writer_that_never_had_a_reader_waits_once() {
        let (queue, _, written) = awaiting();
        give(&queue, message(0, 16));
        wait_until(|| written.lock().unwrap().len() == 1).await;
        tokio::time::sleep(SILENCE_MIN).await;
        give(&queue, message(1, 16));
        assert_eq!(written.lock().unwrap().len(), 2, "the receiving task writes it");
        queue.close();
    }

    #[tokio::test]
    async fn messages_that_nobody_hears_are_written_without_a_pause() {
        let (queue, _, written) = awaiting();
        (0..3).for_each(|seq| give(&queue, message(seq, 16)));
        wait_until(|| written.lock().unwrap().len() == 3).await;
        assert!(queue.awaits_since.lock().unwrap().elapsed() >= FIRST_READER_WAIT_MAX);
        let order = [(0, NextMessage::Unheard), (1, NextMessage::Unheard), (2, NextMessage::Nothing)];
        assert_eq!(*written.lock().unwrap(), order);
        queue.close();
    }

    #[tokio::test]
    async fn no_message_waits_for_a_reader_in_a_crowded_or_closed_queue() {
        let (queue, _, written) = awaiting();
        give(&queue, message(0, FIRST_READER_BYTES_MAX / 2));
        wait_until(|| written.lock().unwrap().len() == 1).await;
        assert!(queue.awaits_since.lock().unwrap().elapsed() < FIRST_READER_WAIT_MAX);
        queue.close();
        let (queue, _, written) = awaiting();
        give(&queue, message(0, 16));
        queue.close();
        wait_until(|| written.lock().unwrap().len() == 1).await;
        assert!(queue.awaits_since.lock().unwrap().elapsed() < FIRST_READER_WAIT_MAX);
    }

    /// Creates a queue that takes a message in each period, and a log of what is written.
    fn shaped(shaping: Shaping) -> (Arc<WriterQueue>, OrderLog) {
        let written = OrderLog::default();
        let log = written.clone();
        let take = move |message: Message, next| log.lock().unwrap().push((message.seq, next));
        (WriterQueue::new(context(), WriterInfo::default(), shaping, take), written)
    }

    #[tokio::test]
    async fn messages_of_a_shaped_queue_wait_for_their_time() {
        let (queue, written) = shaped(Shaping { bits_per_s: Some(16 * 8), ..Shaping::default() });
        let begun = Instant::now();
        (0..3).for_each(|seq| give(&queue, message(seq, 16)));
        wait_until(|| !written.lock().unwrap().is_empty()).await;
        // The queue has no worker while a message waits, and messages that come meanwhile are not written either.
        (3..5).for_each(|seq| give(&queue, message(seq, 16)));
        wait_until(|| !queue.is_at_work.load(SeqCst)).await;
        wait_until(|| written.lock().unwrap().len() == 2).await;
        assert!(begun.elapsed() >= Duration::from_millis(900), "{:?}", begun.elapsed());
        queue.close();
        queue.ended().await;
        assert!(begun.elapsed() < Duration::from_millis(1900), "a closed queue waits for nothing");
        let numbers: Vec<_> = written.lock().unwrap().iter().map(|(seq, _)| *seq).collect();
        assert_eq!(numbers, [0, 1, 2, 3, 4], "reliable messages are not thinned");
    }

    #[tokio::test]
    async fn newest_message_of_a_thinned_queue_replaces_those_before() {
        let interval = Some(Duration::from_millis(500));
        let (queue, written) = shaped(Shaping { interval, ..Shaping::default() });
        give(&queue, message(0, 16));
        wait_until(|| !written.lock().unwrap().is_empty()).await;
        (1..5).for_each(|seq| give(&queue, message(seq, 16)));
        wait_until(|| written.lock().unwrap().len() == 2).await;
        let numbers: Vec<_> = written.lock().unwrap().iter().map(|(seq, _)| *seq).collect();
        assert_eq!(numbers, [0, 4]);
        assert_eq!(queue.drops.snapshot().into_values().collect::<Vec<_>>(), [3]);
        queue.close();
    }

    #[tokio::test]
    async fn messages_that_wait_in_a_thinned_queue_are_written_when_it_is_closed() {
        let interval = Some(Duration::from_secs(60));
        let (queue, written) = shaped(Shaping { interval, ..Shaping::default() });
        give(&queue, message(0, 16));
        wait_until(|| !written.lock().unwrap().is_empty()).await;
        give(&queue, message(1, 16));
        wait_until(|| queue.consumer.lock().unwrap().held.is_some()).await;
        {
            // The worker looks at all of these at once.
            let _held_up = queue.consumer.lock().unwrap();
            (2..4).for_each(|seq| give(&queue, message(seq, 16)));
            queue.close();
        }
        queue.ended().await;
        let numbers: Vec<_> = written.lock().unwrap().iter().map(|(seq, _)| *seq).collect();
        assert_eq!(numbers, [0, 1, 2, 3]);
    }

    #[tokio::test]
    async fn messages_go_on_after_a_timer_that_ran_out_while_a_worker_was_busy() {
        const INTERVAL: Duration = Duration::from_millis(200);
        let (written, is_blocked) = (OrderLog::default(), Arc::new(AtomicBool::new(false)));
        let (log, blocks) = (written.clone(), is_blocked.clone());
        let shaping = Shaping { interval: Some(INTERVAL), ..Shaping::default() };
        let queue = WriterQueue::new(context(), WriterInfo::default(), shaping, move |message, next| {
            log.lock().unwrap().push((message.seq, next));
            while blocks.load(Relaxed) {
                thread::sleep(Duration::from_millis(1));
            }
        });
        let count = |messages| written.lock().unwrap().len() == messages;
        give(&queue, message(0, 16));
        wait_until(|| count(1)).await;
        give(&queue, message(1, 16));
        wait_until(|| queue.consumer.lock().unwrap().held.is_some()).await;
        // The end of an instance lets the message before it go, which takes until after its time.
        is_blocked.store(true, Relaxed);
        let mut end = message(2, 16);
        end.head.kind = MessageKind::Dispose;
        give(&queue, end);
        wait_until(|| count(2)).await;
        give(&queue, message(3, 16));
        tokio::time::sleep(2 * INTERVAL).await;
        give(&queue, message(4, 16));
        is_blocked.store(false, Relaxed);
        wait_until(|| written.lock().unwrap().last().is_some_and(|(seq, _)| *seq == 4)).await;
        queue.close();
    }

    #[tokio::test]
    async fn closed_queue_writes_everything_and_then_drops_its_writer() {
        let gate = Arc::new(Mutex::new(()));
        let held = gate.lock().unwrap();
        let (queue, taken) = noting(&gate);
        (0..3).for_each(|seq| give(&queue, message(seq, AT_ONCE_BYTES_MAX + 1)));
        queue.close();
        assert!(!queue.ended.is_closed());
        drop(held);
        queue.ended().await;
        assert_eq!(taken.lock().unwrap().len(), 3);
        wait_until(|| Arc::strong_count(&taken) == 1).await;
        let (idle, taken) = noting(&Arc::default());
        idle.close();
        idle.ended().await;
        wait_until(|| Arc::strong_count(&taken) == 1).await;
    }

    #[tokio::test]
    async fn receiving_task_judges_compressed_messages_by_the_length_that_is_written() {
        let (queue, _) = noting(&Arc::default());
        let compressed = |original: usize, form| {
            let mut message = message(0, 100);
            let length = u32::try_from(original).unwrap().to_be_bytes();
            (message.head.encoding, message.head.form) = (PayloadEncoding::Zstd, form);
            message.payload = [&length[..], &[0; 96]].concat().into();
            message
        };
        for (original, form, is_short) in [
            (AT_ONCE_BYTES_MAX, PayloadForm::Cdr, true),
            (AT_ONCE_BYTES_MAX + 1, PayloadForm::Cdr, false),
            (AT_ONCE_BYTES_MAX + KEY_HASH_BYTES, PayloadForm::KeyedCdr, true),
            (AT_ONCE_BYTES_MAX + KEY_HASH_BYTES + 1, PayloadForm::KeyedCdr, false),
        ] {
            assert_eq!(queue.at_once(&compressed(original, form)).is_some(), is_short, "{original} {form:?}");
        }
        queue.close();
    }
}
