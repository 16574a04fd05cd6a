//! Local subscribers: packets in, samples on the local network out.
//!
//! [`LocalSink::deliver`] opens packets on the task that received them and gives their messages to the queue of a local
//! writer ([`crate::data::writer_queue`]).

use std::collections::{BTreeMap, BTreeSet};
use std::sync::atomic::{AtomicBool, AtomicI64, AtomicU64, Ordering::Relaxed};
use std::sync::{Arc, Mutex};
use std::time::{Duration, Instant};

use arc_swap::{ArcSwap, ArcSwapOption};
use sgc_endpoint::{AskAgain, Delivery, Message, Receivers, Sink, SinkDrop, SinkLimits, SinkProgress};
use sgc_ros::{DeadManRule, Shaping};
use sgc_router::LinkId;
use sgc_sync::lock;
use sgc_wire::{MessageHead, MessageKind, Name, Packet, PayloadForm, SinkId, SourceId, TopicGrant};
use tokio::sync::{OwnedMutexGuard, mpsc};
use tokio::time::timeout_at;
use tracing::{debug, warn};

use crate::admin::graph;
use crate::clock::unix_ns;
use crate::data::conversion::{KnownType, TypeSlot};
use crate::data::dead_man::DeadManSwitch;
use crate::data::pending::{PendingBytes, PendingQueue};
use crate::data::source_clocks::SourceClocks;
use crate::data::stats::{CountDrops, DataDrop, Dropped, Drops};
use crate::data::tap::{TapMessage, Taps};
use crate::data::writer_queue::{FramePrefix, WRITER_MESSAGES_MAX, WriteOutcome, WriterQueue};
use crate::drops::NodeDrop;

/// Longest wait of new messages for a closed writer that still writes its queue.
const LAST_WRITES_MAX: Duration = Duration::from_secs(1);

/// Shortest time between two requests of a sink for a writer.
const ASK_WRITER_EVERY: Duration = Duration::from_secs(1);
/// Age of the last message before there is one.
const NO_AGE: i64 = i64::MIN;

/// Time from the publication of a message to its arrival.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) struct MessageAge {
    /// Microseconds; less than 0 if clocks differ in a way that is not known.
    pub(crate) age_us: i64,
    /// The greatest error of that by the clock of the owner's node; `None` while it is not known: then clocks count as equal.
    pub(crate) error_us: Option<i64>,
}

/// Request of a sink to the control task.
#[derive(Clone, Copy, Debug)]
pub(crate) enum SinkRequest {
    /// Ask a source for missing messages.
    History(Name, SourceId),
    /// The missing messages have arrived.
    Synced(Name, SourceId),
    /// Confirm that everything of a source up to this number has arrived.
    Confirm(Name, SourceId, u64),
    /// A message of another publisher on our share waits for a writer.
    Writer(Name),
}

/// Messages that wait for their type or a writer, and the messages behind them.
struct Held {
    queue: PendingQueue<Message>,
    /// The time at which a writer was asked for.
    asked: Option<Instant>,
}

struct State {
    sink: Option<Sink>,
    /// The keys of callers, if it is the sink of our own share.
    callers: Option<Arc<Receivers>>,
    /// Number of releases under way: messages that waited for a grant and are not written yet.
    releases: u32,
    /// Sources whose recoverable messages were skipped, because they had no writer.
    missed: BTreeSet<SourceId>,
    held: Held,
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
    /// Nanoseconds from the publication of the last message to its arrival, [`NO_AGE`] before the first.
    age_ns: AtomicI64,
    shaping: Mutex<Shaping>,
    taps: Taps,
    frames: FramePrefix,
    dead_man: ArcSwapOption<DeadManSwitch>,
    clocks: SourceClocks,
    types: Arc<TypeSlot>,
    /// Whether messages arrive as JSON.
    takes_json: AtomicBool,
    /// Whether a message without a writer asks for one.
    asks_for_writer: AtomicBool,
    /// The time of the last message of such a sink.
    last_message: Mutex<Option<Instant>>,
}

impl LocalSink {
    /// Creates a sink without a grant.
    pub(crate) fn new(
        name: Name,
        transient_local: bool,
        requests: mpsc::Sender<SinkRequest>,
        holds: Arc<PendingBytes>,
    ) -> Self {
        let held = Held { queue: PendingQueue::new(WRITER_MESSAGES_MAX, holds), asked: None };
        let state = State { sink: None, callers: None, releases: 0, missed: BTreeSet::new(), held };
        Self {
            name,
            transient_local,
            state: Mutex::new(state),
            releasing: Arc::default(),
            writers: ArcSwap::default(),
            requests,
            delivered: AtomicU64::new(0),
            age_ns: AtomicI64::new(NO_AGE),
            shaping: Mutex::default(),
            taps: Taps::default(),
            frames: FramePrefix::default(),
            dead_man: ArcSwapOption::empty(),
            clocks: SourceClocks::default(),
            types: Arc::default(),
            takes_json: AtomicBool::new(false),
            asks_for_writer: AtomicBool::new(false),
            last_message: Mutex::default(),
        }
    }

    /// Has messages without a writer ask for one, and wait for it.
    pub(crate) fn ask_for_writers(&self) {
        self.asks_for_writer.store(true, Relaxed);
    }

    /// Returns the time of the last message, if messages without a writer ask for one.
    pub(crate) fn last_message(&self) -> Option<Instant> {
        *lock(&self.last_message)
    }

    /// Drops the messages that wait for a writer, which is not to come soon.
    pub(crate) fn give_up_held(&self, data: &impl CountDrops) {
        let held = self.lock().held.queue.take().len();
        if held > 0 {
            data.count_here(&self.name, DataDrop::NoWriter, held as u64);
        }
    }

    /// Returns the taps of messages for the local network.
    pub(crate) fn taps(&self) -> &Taps {
        &self.taps
    }

    /// Returns the largest number of local readers that one of its writers matches.
    pub(crate) fn matched(&self) -> u32 {
        self.writers.load().values().map(|writer| writer.matched()).max().unwrap_or(0)
    }

    /// Returns the time since the last message was written to the local network.
    pub(crate) fn since_last(&self) -> Option<Duration> {
        let last = self.writers.load().values().filter_map(|writer| writer.last_written()).max();
        last.map(|last| last.elapsed())
    }

    /// Returns the time from the publication of the last message to its arrival.
    pub(crate) fn last_age(&self) -> Option<MessageAge> {
        let age_ns = Some(self.age_ns.load(Relaxed)).filter(|age| *age != NO_AGE)?;
        let known = self.clocks.owner().map(|bounds| bounds.offset(Instant::now(), unix_ns()));
        Some(match known {
            Some((ahead_ns, error_ns)) => {
                MessageAge { age_us: age_ns.saturating_add(ahead_ns) / 1000, error_us: Some(error_ns / 1000) }
            }
            None => MessageAge { age_us: age_ns / 1000, error_us: None },
        })
    }

    /// Notes how old a message is by the clocks of both hosts.
    fn note_age(&self, head: &MessageHead) {
        if head.kind == MessageKind::Write && head.source_timestamp_ns > 0 {
            self.age_ns.store(unix_ns().saturating_sub(head.source_timestamp_ns), Relaxed);
        }
    }

    /// Sets where the keys of callers are, for the sink of our own service.
    pub(crate) fn set_callers(&self, callers: Arc<Receivers>) {
        let state = &mut *self.lock();
        if let Some(sink) = &mut state.sink {
            sink.set_callers(callers.clone());
        }
        state.callers = Some(callers);
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
                    let mut new = Sink::new(self.name, id, grant, self.transient_local, limits);
                    if let Some(callers) = state.callers.clone() {
                        new.set_callers(callers);
                    }
                    *sink = Some(new);
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
                if let Err(dropped) = this.finish(result, data.drops()).await {
                    data.count(LinkId::LOCAL, &this.name, dropped.reason);
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
    pub(crate) fn set_writer(
        self: &Arc<Self>,
        source: Option<SourceId>,
        writer: Option<Arc<WriterQueue>>,
        data: &Arc<impl CountDrops>,
    ) {
        let mut state = self.lock();
        state.held.asked = None;
        let mut writers = BTreeMap::clone(&self.writers.load());
        if writer.is_none() && writers.len() == 1 && writers.contains_key(&source) {
            self.stop_before_close();
        }
        let old = match writer {
            Some(writer) => {
                if self.dead_man.load().is_some() {
                    writer.wait_for_no_reader();
                }
                writers.insert(source, writer)
            }
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
            if let Some(switch) = &*self.dead_man.load() {
                switch.try_again();
            }
        }
        let Some(old) = old else {
            drop(state);
            return self.release_held(data);
        };
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

    /// Returns the clocks of those that publish to it.
    pub(crate) fn clocks(&self) -> &SourceClocks {
        &self.clocks
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
        let is_awaited = {
            let _state = self.lock();
            self.types.set(known);
            self.types.now().is_awaited()
        };
        if !is_awaited {
            self.release_held(data);
        }
        if let Some(switch) = &*self.dead_man.load() {
            switch.try_again();
        }
    }

    /// Writes or drops the messages that waited for their type or a writer, if there is a writer. Those whose type is
    /// still awaited wait again.
    fn release_held(self: &Arc<Self>, data: &Arc<impl CountDrops>) {
        let turn = {
            let mut state = self.lock();
            if state.held.queue.is_empty() || self.writers.load().is_empty() {
                return;
            }
            self.begin_release(&mut state)
        };
        let (this, data) = (self.clone(), data.clone());
        self.release(turn, async move {
            // Until here, messages that come line up behind those that wait.
            let (now, held) = (Instant::now(), this.lock().held.queue.take());
            for held in held {
                let is_late = held.is_late(now) && this.is_given_up(&held.item);
                let written = match (is_late, held.item.head.form) {
                    (true, PayloadForm::Json) => Err(Dropped::one(DataDrop::NoDefinition)),
                    (true, _) => Err(Dropped::one(DataDrop::NoWriter)),
                    (false, _) => this.write(held.item).await,
                };
                if let Err(Dropped { reason, messages }) = written {
                    data.count_here(&this.name, reason, messages);
                }
            }
        });
    }

    /// Returns `true` if a message is useless when late, because it is not kept for late joiners.
    fn is_given_up(&self, message: &Message) -> bool {
        !self.transient_local && message.head.kind == MessageKind::Write
    }

    /// Sets the dead-man switch, or removes it. A new one stops the robot as soon as there is a writer.
    pub(crate) fn set_dead_man(self: &Arc<Self>, rule: Option<DeadManRule>) {
        let Some(rule) = rule else { return self.dead_man.store(None) };
        if let Some(switch) = &*self.dead_man.load() {
            return switch.set(rule, &self.types);
        }
        self.writers.load().values().for_each(|writer| writer.wait_for_no_reader());
        let switch = Arc::new(DeadManSwitch::new(rule));
        self.dead_man.store(Some(switch.clone()));
        let (changed, switch, sink) = (switch.changed(), Arc::downgrade(&switch), Arc::downgrade(self));
        tokio::spawn(async move {
            while let Some(due) = switch.upgrade().map(|switch| switch.due()) {
                match due {
                    Some(due) => drop(timeout_at(due.into(), changed.notified()).await),
                    None => changed.notified().await,
                }
                if let Some(sink) = sink.upgrade() {
                    sink.tick_dead_man();
                }
            }
        });
    }

    /// Returns the state of the dead-man switch.
    pub(crate) fn dead_man(&self) -> Option<graph::DeadMan> {
        self.dead_man.load().as_ref().map(|switch| switch.view())
    }

    /// Lets the next command in time pass the dead-man switch. Returns `false` if it has not stopped the robot, and
    /// `None` if there is no switch.
    pub(crate) fn resume_dead_man(&self) -> Option<bool> {
        self.dead_man.load().as_ref().map(|switch| switch.resume())
    }

    /// Publishes the stop message if it is due. The lock keeps commands that are judged now from overtaking it.
    fn tick_dead_man(&self) {
        let Some(switch) = self.dead_man.load_full() else { return };
        let _state = self.lock();
        if switch.tick(Instant::now(), self.matched()) {
            self.publish_stop(&switch);
        }
    }

    /// Publishes the stop message before the last writer closes, if the robot may be moving.
    fn stop_before_close(&self) {
        if let Some(switch) = self.dead_man.load_full()
            && switch.close(Instant::now())
        {
            self.publish_stop(&switch);
        }
    }

    /// Gives the stop message to the writer of the last command, or any.
    fn publish_stop(&self, switch: &DeadManSwitch) {
        let writers = self.writers.load();
        let last = switch.last_source().and_then(|source| writers.get(&Some(source)));
        let Some(writer) = last.or_else(|| writers.values().next()) else {
            return switch.note_not_published();
        };
        // Nobody would hear it. A reader on its way would not learn that the robot is to stop.
        let readers = self.matched();
        if readers == 0 {
            return switch.note_not_published();
        }
        let Ok(message) = switch.stop_message(&self.types) else { return switch.note_not_published() };
        let Some(message) = message else { return switch.note_published(readers, false) };
        self.taps.offer(|| self.tapped(&message));
        // It makes room for itself, so that it is never returned.
        match writer.try_push(message, true) {
            WriteOutcome::Taken { .. } => switch.note_published(readers, true),
            WriteOutcome::Full(_) => switch.note_not_published(),
        }
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
        // Neither a type nor a writer will come.
        {
            let mut state = self.lock();
            drop(state.held.queue.take());
            self.stop_before_close();
        }
        self.writers.load().values().for_each(|w| w.close());
        self.taps.close();
    }

    /// Returns the number of messages written to the local network.
    pub(crate) fn delivered(&self) -> u64 {
        self.delivered.load(Relaxed)
    }

    /// Delivers a packet, or fails with the drop. Waits while the local writer of a reliable topic is full.
    pub(crate) async fn deliver(&self, packet: Packet, drops: &Drops) -> Result<(), Dropped> {
        let (result, behind, turn) = {
            let mut state = self.lock();
            let State { sink, releases, missed, held, .. } = &mut *state;
            let Some(sink) = sink else { return Err(Dropped::one(DataDrop::NotGranted)) };
            let source = packet.header.source;
            if !self.has_writer(&source) && sink.recovers(&source) {
                // The sink bounds its sources, so this set is small.
                missed.insert(source);
                return Err(Dropped::one(DataDrop::NoWriter));
            }
            let behind = *releases > 0;
            match sink.handle_packet(&packet) {
                // Writing happens under the lock, so that messages from two links keep the order of their numbers.
                Ok(Delivery::Message(message)) if !behind => match self.write_now(message, held) {
                    Handover::Queued => return Ok(()),
                    Handover::Dropped(dropped) => return Err(dropped),
                    Handover::Full(message) => {
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
    async fn finish(&self, result: Result<Delivery, SinkDrop>, drops: &Drops) -> Result<(), Dropped> {
        match result {
            Ok(Delivery::Incomplete | Delivery::Mark | Delivery::Parked) => Ok(()),
            Ok(Delivery::Message(message)) => self.write(message).await,
            Ok(Delivery::Asserted(source)) => {
                if let Some(writer) = self.writer(&source) {
                    writer.assert_liveliness();
                }
                Ok(())
            }
            Ok(Delivery::NeedsHistory(source)) => {
                let _ = self.requests.send(SinkRequest::History(self.name, source)).await;
                Ok(())
            }
            Ok(Delivery::Confirm(source, seq)) => {
                let _ = self.requests.send(SinkRequest::Confirm(self.name, source, seq)).await;
                Ok(())
            }
            Ok(Delivery::Synced(source)) => {
                let _ = self.requests.send(SinkRequest::Synced(self.name, source)).await;
                Ok(())
            }
            Ok(Delivery::Lost(_, messages)) => {
                debug!(name = %self.name.short(), messages, "lost for good");
                if drops.add(NodeDrop::SinkLost, messages) {
                    warn!(messages, "a source no longer keeps messages that were lost; counted from here on");
                }
                Dropped::check(DataDrop::Sink, messages)
            }
            Err(error) => {
                debug!(name = %self.name.short(), %error, "packet refused");
                drops.count(error);
                Err(Dropped::one(DataDrop::Sink))
            }
        }
    }

    async fn write(&self, message: Message) -> Result<(), Dropped> {
        let written = self.write_now(message, &mut self.lock().held);
        let message = match written {
            Handover::Queued => return Ok(()),
            Handover::Dropped(dropped) => return Err(dropped),
            Handover::Full(message) => message,
        };
        let Some(writer) = self.writer(&message.source) else { return Err(Dropped::one(DataDrop::NoWriter)) };
        self.delivered.fetch_add(1, Relaxed);
        self.taps.offer(|| self.tapped(&message));
        writer.push(message).await.map_err(|_| Dropped::one(DataDrop::Stalled))
    }

    /// Queues a message for its writer without waiting, or holds it until its type or a writer is known.
    fn write_now(&self, message: Message, held: &mut Held) -> Handover {
        if self.asks_for_writer.load(Relaxed) {
            *lock(&self.last_message) = Some(Instant::now());
        }
        let Some(writer) = self.writer(&message.source) else {
            if !self.asks_for_writer.load(Relaxed) {
                return Handover::dropped(DataDrop::NoWriter);
            }
            let now = Instant::now();
            if held.asked.is_none_or(|at| now >= at + ASK_WRITER_EVERY)
                && self.requests.try_send(SinkRequest::Writer(self.name)).is_ok()
            {
                held.asked = Some(now);
            }
            return self.hold(message, held, DataDrop::NoWriter).into();
        };
        let head = message.head;
        let mut waits = !held.queue.is_empty();
        if head.form == PayloadForm::Json {
            self.takes_json.store(true, Relaxed);
            match self.types.now() {
                KnownType::Known(_) => {}
                KnownType::Awaited | KnownType::Asked => waits = true,
                KnownType::Lacking => return Handover::dropped(DataDrop::NoDefinition),
            }
        }
        if waits {
            return self.hold(message, held, DataDrop::NoDefinition).into();
        }
        self.note_age(&head);
        if writer.has_written(&head) {
            return Handover::dropped(DataDrop::Repeated);
        }
        if writer.limits_age() && head.kind == MessageKind::Write {
            let least_age = self.least_age(Instant::now(), &message);
            if writer.is_too_old(unix_ns(), &head, least_age) {
                return Handover::dropped(DataDrop::TooOld);
            }
        }
        let switch = self.dead_man.load();
        if let Some(switch) = &*switch {
            let now = Instant::now();
            let least_age = self.least_age(now, &message);
            if let Err(reason) = switch.judge(now, &message, least_age, &self.types) {
                return Handover::dropped(reason);
            }
        }
        let tapped = self.taps.is_any().then(|| self.tapped(&message));
        // Converting takes time, and may have to wait for the type.
        let evicted = match writer.try_push(message, head.form != PayloadForm::Json) {
            WriteOutcome::Taken { evicted } => evicted,
            // A command that waited could overtake the stop message.
            WriteOutcome::Full(_) if switch.is_some() => return Handover::dropped(DataDrop::Stalled),
            WriteOutcome::Full(message) => return Handover::Full(message),
        };
        self.delivered.fetch_add(1, Relaxed);
        if let Some(tapped) = tapped {
            self.taps.offer(|| tapped);
        }
        Dropped::check(DataDrop::Stale, evicted).into()
    }

    /// Holds a message until its type or a writer is known, or it is given up. The oldest messages make room, and are
    /// counted as `lost`.
    fn hold(&self, message: Message, held: &mut Held, lost: DataDrop) -> Result<(), Dropped> {
        let now = Instant::now();
        let late = held.queue.give_up_late(now, |message| self.is_given_up(message));
        let given_up = late + held.queue.push(now, message.payload.len(), message);
        Dropped::check(lost, given_up)
    }

    /// Returns the least age of a message by its publisher's clock, in ns, if that is known.
    fn least_age(&self, now: Instant, message: &Message) -> Option<i64> {
        let Message { source, head, .. } = message;
        // The owner's own sources have writers of their own.
        let is_owner = self.writers.load().contains_key(&Some(*source));
        self.clocks.least_age(now, source, is_owner, head.source_timestamp_ns)
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

/// Outcome of handing a message to its writer without waiting.
enum Handover {
    /// The message is written, queued or held.
    Queued,
    /// The message, or older ones for it, were dropped.
    Dropped(Dropped),
    /// The message has to wait for room in the queue.
    Full(Message),
}

impl Handover {
    fn dropped(reason: DataDrop) -> Self {
        Self::Dropped(Dropped::one(reason))
    }
}

impl From<Result<(), Dropped>> for Handover {
    fn from(result: Result<(), Dropped>) -> Self {
        result.map_or_else(Self::Dropped, |()| Self::Queued)
    }
}

/// Guard of a release under way. It decrements the count even if the waiting task is cancelled.
struct Releasing<'a>(&'a LocalSink);

impl Drop for Releasing<'_> {
    fn drop(&mut self) {
        self.0.lock().releases -= 1;
    }
}

#[cfg(test)]
mod tests {
    use bytes::Bytes;
    use sgc_endpoint::{RecoveryLimits, Source, SourceConfig};
    use sgc_ros::{Resume, StopMessage};
    use sgc_trust::{MessageKey, Suite};
    use sgc_wire::{Class, MessageHead, SecretBytes};

    use super::*;
    use crate::data::dataplane::DataPlane;
    use crate::data::pending::PENDING_BYTES_MAX;
    use crate::data::writer_queue::tests::{WriteLog, message, noting, taking, wait_until};
    use crate::data::writer_queue::{AT_ONCE_BYTES_MAX, NextMessage};

    fn sink(transient_local: bool) -> (Arc<LocalSink>, Arc<DataPlane>, WriteLog) {
        let (requests, _) = mpsc::channel(1);
        let sink = Arc::new(LocalSink::new(Name([1; 32]), transient_local, requests, Arc::default()));
        let (queue, taken) = noting(&Arc::default());
        let data = Arc::default();
        sink.set_writer(None, Some(queue), &data);
        (sink, data, taken)
    }

    fn json(seq: u64, bytes: usize) -> Message {
        let plain = message(seq, bytes);
        Message { head: MessageHead { form: PayloadForm::Json, ..plain.head }, ..plain }
    }

    fn undefined(messages: u64) -> Result<(), Dropped> {
        Dropped::check(DataDrop::NoDefinition, messages)
    }

    fn any_type() -> KnownType {
        let mut text = |_: &sgc_cdr::TypeName| Some("string a".to_owned());
        let layout = sgc_cdr::Library::empty().layout(&"p/msg/M".parse().unwrap(), &mut text);
        KnownType::Known(Arc::new(layout.unwrap()))
    }

    #[tokio::test]
    async fn received_json_waits_until_the_owner_describes_its_type() {
        let (sink, data, taken) = sink(false);
        let seqs = || taken.lock().unwrap().iter().map(|(seq, _)| *seq).collect::<Vec<_>>();
        sink.set_type(KnownType::Asked, &data);
        for seq in 0..WRITER_MESSAGES_MAX as u64 + 3 {
            let lost = sink.write(json(seq, 8)).await;
            assert_eq!(lost, undefined(u64::from(seq >= WRITER_MESSAGES_MAX as u64)));
        }
        assert!(sink.lacks_definition());
        // Large messages are bounded by their bytes, and later ones do not overtake them.
        let lost = sink.write(json(5000, PENDING_BYTES_MAX)).await;
        assert_eq!(lost, undefined(WRITER_MESSAGES_MAX as u64));
        assert_eq!(sink.write(json(5001, 8)).await, undefined(1));
        assert_eq!(sink.write(message(5002, 8)).await, Ok(()));
        assert!(seqs().is_empty());
        sink.set_type(any_type(), &data);
        wait_until(|| seqs().len() == 2).await;
        assert_eq!((seqs(), sink.delivered(), sink.lacks_definition()), (vec![5001, 5002], 2, false));
        // If the type stays unknown, messages that need no conversion are written.
        sink.set_type(KnownType::Asked, &data);
        assert_eq!(sink.write(json(5003, 8)).await, Ok(()));
        assert_eq!(sink.write(message(5004, 8)).await, Ok(()));
        sink.set_type(KnownType::Lacking, &data);
        wait_until(|| seqs().len() == 3).await;
        assert_eq!((seqs()[2], data.drops().snapshot()["no_definition"]), (5004, 1));
        sink.close();
    }

    #[tokio::test]
    async fn message_of_another_publisher_waits_for_the_writer_that_it_asks_for() {
        let (requests, mut requested) = mpsc::channel(1);
        let sink = Arc::new(LocalSink::new(Name([1; 32]), false, requests, Arc::default()));
        let data = Arc::<DataPlane>::default();
        let no_writer = |messages| Dropped::check(DataDrop::NoWriter, messages);
        assert_eq!(sink.write(message(1, 8)).await, no_writer(1), "only shares of this node ask");
        sink.ask_for_writers();
        for seq in 0..WRITER_MESSAGES_MAX as u64 + 2 {
            let lost = sink.write(message(seq, 8)).await;
            assert_eq!(lost, no_writer(u64::from(seq >= WRITER_MESSAGES_MAX as u64)));
        }
        assert!(matches!(requested.try_recv(), Ok(SinkRequest::Writer(Name(name))) if name == [1; 32]));
        assert!(requested.try_recv().is_err(), "it asks once");
        let (queue, taken) = noting(&Arc::default());
        sink.set_writer(None, Some(queue), &data);
        wait_until(|| taken.lock().unwrap().len() == WRITER_MESSAGES_MAX).await;
        assert_eq!(taken.lock().unwrap()[0].0, 2, "the newest are kept, in order");
        // The writer closes, and the next message asks again.
        sink.set_writer(None, None, &data);
        wait_until(|| sink.lock().releases == 0).await;
        assert_eq!(sink.write(message(9999, 8)).await, Ok(()));
        assert!(requested.try_recv().is_ok());
        // No writer comes: it asks again after a while, and may give up.
        assert_eq!(sink.write(message(10_000, 8)).await, Ok(()));
        assert!(requested.try_recv().is_err());
        sink.lock().held.asked = Instant::now().checked_sub(ASK_WRITER_EVERY);
        assert_eq!(sink.write(message(10_001, 8)).await, Ok(()));
        assert!(requested.try_recv().is_ok());
        let dropped = || data.drops().snapshot().get("no_writer").copied().unwrap_or(0);
        let before = dropped();
        sink.give_up_held(&*data);
        assert_eq!(dropped() - before, 3);
        sink.close();
    }

    #[tokio::test]
    async fn long_pending_message_is_written_only_if_kept_for_late_joiners() {
        for transient_local in [true, false] {
            let (sink, data, taken) = sink(transient_local);
            sink.set_type(KnownType::Asked, &data);
            let long_ago = Instant::now().checked_sub(Duration::from_secs(60)).unwrap();
            sink.lock().held.queue.push(long_ago, 8, json(1, 8));
            let lost = sink.write(json(2, 8)).await;
            assert_eq!(lost, undefined(u64::from(!transient_local)));
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
            assert!(matches!(written, Handover::Queued));
        };
        let (sink, data, _) = sink(false);
        let [killed, restarted] = [[1; 16], [2; 16]].map(SourceId);
        // The consumer blocks until the sender is dropped.
        let (stuck, gate) = std::sync::mpsc::channel::<()>();
        let wait = move || {
            let _ = gate.recv();
        };
        sink.set_writer(Some(killed), Some(noted(Box::new(wait))), &data);
        // The long message keeps the worker busy, so the others queue up.
        write(&sink, message(0, AT_ONCE_BYTES_MAX + 1));
        (1..50).for_each(|seq| write(&sink, message(seq, 16)));
        sink.set_writer(Some(killed), None, &data);
        sink.set_writer(Some(restarted), Some(noted(Box::new(|| ()))), &data);
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

    fn dead_man(after: Duration, stop: StopMessage) -> Option<DeadManRule> {
        Some(DeadManRule { after, stop, repeat: None, resume: Resume::Auto })
    }

    /// Returns a sink whose dead-man switch has stopped the robot, with the payloads that were written.
    async fn stopped_sink(
        stop: StopMessage,
    ) -> (Arc<LocalSink>, Arc<DataPlane>, Arc<Mutex<Vec<bytes::Bytes>>>) {
        let (requests, _) = mpsc::channel(1);
        let (sink, data) =
            (Arc::new(LocalSink::new(Name([1; 32]), false, requests, Arc::default())), Arc::default());
        sink.set_dead_man(dead_man(Duration::from_millis(200), stop));
        let payloads = Arc::<Mutex<Vec<_>>>::default();
        let written = payloads.clone();
        let queue = taking(move |message, _| written.lock().unwrap().push(message.payload));
        sink.set_writer(None, Some(queue), &data);
        (sink, data, payloads)
    }

    /// Writes a command that is published now.
    async fn command(sink: &LocalSink, seq: u64, payload: &[u8]) -> Result<(), Dropped> {
        let head = MessageHead::new(MessageKind::Write, unix_ns());
        sink.write(Message { head, payload: bytes::Bytes::copy_from_slice(payload), ..message(seq, 0) }).await
    }

    /// Writes commands until one passes, and returns its number.
    async fn commands_until_one_passes(sink: &LocalSink) -> u64 {
        for seq in 1.. {
            match command(sink, seq, b"go").await {
                Ok(()) => return seq,
                Err(dropped) => assert_eq!(dropped.reason, DataDrop::UnjudgedCommand),
            }
            tokio::time::sleep(Duration::from_millis(20)).await;
            assert!(seq < 100, "none passes");
        }
        unreachable!()
    }

    #[tokio::test]
    async fn a_stop_message_waits_for_a_writer_and_the_type() {
        let stop = StopMessage::Json("{\"a\": \"stop\"}".into());
        let (sink, data, payloads) = stopped_sink(stop).await;
        tokio::time::sleep(Duration::from_millis(100)).await;
        assert!(payloads.lock().unwrap().is_empty(), "its type is unknown");
        sink.set_type(any_type(), &data);
        wait_until(|| payloads.lock().unwrap().len() == 1).await;
        assert_eq!(payloads.lock().unwrap()[0][..], *b"\0\x01\0\0\x05\0\0\0stop\0");
        let view = sink.dead_man().unwrap();
        assert_eq!((view.stopped.as_deref(), view.stops), (Some("start"), 1));
        // A stop message that is none of the type does not replace it.
        let wrong = StopMessage::Json("{\"c\": 1}".into());
        sink.set_dead_man(dead_man(Duration::from_millis(200), wrong));
        commands_until_one_passes(&sink).await;
        wait_until(|| payloads.lock().unwrap().len() == 3).await;
        {
            let payloads = payloads.lock().unwrap();
            assert_eq!(payloads[2], payloads[0]);
        }
        // Without a switch, everything passes.
        sink.set_dead_man(None);
        assert_eq!(command(&sink, 1, b"go").await, Ok(()));
        assert_eq!(sink.resume_dead_man(), None);
        sink.close();
    }

    #[tokio::test]
    async fn the_last_command_is_published_again_when_none_comes_or_the_writer_closes() {
        let (sink, data, payloads) = stopped_sink(StopMessage::Last).await;
        let first = commands_until_one_passes(&sink).await;
        assert_eq!(sink.resume_dead_man(), Some(false));
        wait_until(|| payloads.lock().unwrap().len() == 2).await;
        assert_eq!(*payloads.lock().unwrap(), [&b"go"[..]; 2]);
        assert_eq!(sink.resume_dead_man(), Some(true));
        for seq in first + 1..first + 100 {
            if command(&sink, seq, b"on").await.is_ok() {
                break;
            }
            tokio::time::sleep(Duration::from_millis(20)).await;
        }
        sink.set_writer(None, None, &data);
        wait_until(|| payloads.lock().unwrap().len() == 4).await;
        assert_eq!(payloads.lock().unwrap()[2..], [&b"on"[..]; 2]);
        assert_eq!(sink.dead_man().unwrap().stopped.as_deref(), Some("closed"));
        sink.close();
    }

    #[tokio::test]
    async fn writers_end_with_their_sink() {
        let (sink, _, _) = sink(false);
        let writer = sink.writer(&SourceId([1; 16])).unwrap();
        drop(sink);
        let ended = tokio::time::timeout(Duration::from_secs(20), writer.ended()).await;
        assert!(ended.is_ok(), "its worker goes on");
    }

    #[tokio::test]
    async fn sources_that_never_had_a_writer_are_forgotten_with_those_of_the_sink() {
        let (requests, _receiver) = mpsc::channel(1);
        let sink = Arc::new(LocalSink::new(Name([1; 32]), false, requests, Arc::default()));
        let (id, key, suite) = (SinkId([9; 16]), SecretBytes::new([3; 32]), Suite::Group);
        let data = Arc::<DataPlane>::default();
        let grant =
            TopicGrant { epoch: 1, suite: suite.id(), key, receiver: None, sources: Vec::new(), entry: None };
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
                receivers: None,
            };
            let mut source = Source::new(config, &grant, MessageKey::generate(suite)).unwrap();
            let mut packets = Vec::new();
            let head = MessageHead::new(MessageKind::Write, 1);
            source
                .publish(&head, Bytes::from_static(b"first"), false, |packet| packets.push(packet))
                .unwrap();
            for packet in packets {
                assert_eq!(sink.deliver(packet, data.drops()).await, Ok(()), "it is parked");
            }
            sink.grant(id, TopicGrant { sources: vec![source.announce()], ..grant.clone() }, &data);
        }
        let missed = sink.lock().missed.len();
        assert!((1..=sources_max).contains(&missed), "{missed} sources are remembered");
    }
}
