//! [`DeadManSwitch`]: the dead-man switch of a sink, with its stop message. [`sgc_session::DeadMan`] decides.

use std::sync::{Arc, Mutex, MutexGuard};
use std::time::{Duration, Instant};

use sgc_cdr::{Layout, Value, ValueError};
use sgc_endpoint::{Decompressor, Message};
use sgc_ros::{DeadManRule, Resume, StopMessage};
use sgc_session::{Command, CommandRefusal, DeadMan, StopCause};
use sgc_sync::lock;
use sgc_wire::{MessageHead, MessageKind, PayloadForm, SourceId};
use tokio::sync::Notify;
use tracing::{info, warn};

use crate::admin::graph;
use crate::clock::unix_ns;
use crate::data::conversion::TypeSlot;
use crate::data::stats::DataDrop;

/// Longest command that is compared with the stop message, in bytes.
const STOP_BYTES_MAX: usize = 4096;
/// Time after which a stop message that could not be published, or that nobody would have heard, is tried again.
const STOP_AGAIN: Duration = Duration::from_millis(200);
/// Interval of looking for local readers that have not heard the stop message.
const LOOK_EVERY: Duration = Duration::from_millis(500);

/// The dead-man switch of a topic that comes here.
pub(crate) struct DeadManSwitch {
    state: Mutex<State>,
    changed: Arc<Notify>,
}

struct State {
    switch: DeadMan,
    rule: DeadManRule,
    /// The last command that passed.
    last: Option<Message>,
    decompressor: Decompressor,
    counts: DeadManCounts,
    /// The last stop message that could be made.
    made: Option<Message>,
    /// Why no stop message can be made.
    failure: Option<String>,
    /// The local readers that there were at the last stop message.
    readers: u32,
}

/// The work of a dead-man switch since it was set.
#[derive(Clone, Copy, Debug, Default)]
struct DeadManCounts {
    stops: u64,
    late: u64,
    unjudged: u64,
    not_resumed: u64,
}

/// Why no dead-man switch was told to resume.
#[derive(Debug, thiserror::Error)]
pub(crate) enum ResumeError {
    #[error(
        "no [[use]] with `deadman` brings {topic} here, or its owner is out of reach: see `sgc why {topic}`"
    )]
    NoSwitch { topic: String },
    #[error("the dead-man switch of {topic} has not stopped the robot")]
    NotStopped { topic: String },
}

impl DeadManSwitch {
    pub(crate) fn new(rule: DeadManRule) -> Self {
        let state = State {
            switch: DeadMan::new(&rule, Instant::now()),
            rule,
            last: None,
            decompressor: Decompressor::default(),
            counts: DeadManCounts::default(),
            made: None,
            failure: None,
            readers: 0,
        };
        Self { state: state.into(), changed: Arc::default() }
    }

    /// Continues under another rule. If its stop message cannot be made, the one before does for it.
    pub(crate) fn set(&self, rule: DeadManRule, types: &TypeSlot) {
        let state = &mut *self.lock();
        if state.rule.stop != rule.stop {
            state.made = state.stop_message(types).ok().flatten();
        }
        state.switch.set(&rule);
        (state.rule, state.failure) = (rule, None);
        self.changed.notify_one();
    }

    /// Returns the sign that [`Self::due`] may have become earlier, or that the switch is gone.
    pub(crate) fn changed(&self) -> Arc<Notify> {
        self.changed.clone()
    }

    /// Returns when [`Self::tick`] has something to do.
    pub(crate) fn due(&self) -> Option<Instant> {
        let state = self.lock();
        let look = state.switch.stopped().map(|_| Instant::now() + LOOK_EVERY);
        state.switch.due().into_iter().chain(look).min()
    }

    /// Returns the state as the status socket shows it.
    pub(crate) fn view(&self) -> graph::DeadMan {
        let state = self.lock();
        let stopped = state.switch.stopped();
        let DeadManCounts { stops, late, unjudged, not_resumed } = state.counts;
        graph::DeadMan {
            stopped: stopped.map(|(cause, _)| cause_word(cause).to_owned()),
            stopped_s: stopped.map_or(0, |(_, since)| since.elapsed().as_secs()),
            no_stop_message: state.failure.clone(),
            is_manual: state.rule.resume == Resume::Manual,
            stops,
            late,
            unjudged,
            not_resumed,
        }
    }

    /// Judges a message on its way to the local network. `least_age` is its age in ns at least, if that is known.
    ///
    /// # Errors
    /// It is a command that must not reach the robot.
    pub(crate) fn judge(
        &self,
        now: Instant,
        message: &Message,
        least_age: Option<i64>,
        types: &TypeSlot,
    ) -> Result<(), DataDrop> {
        // The end of an instance moves nothing.
        if message.head.kind != MessageKind::Write {
            return Ok(());
        }
        let state = &mut *self.lock();
        let before = state.switch.stopped();
        let (source, seq, stamp_ns) = (message.source, message.seq, message.head.source_timestamp_ns);
        let is_stop = before.is_some() && state.is_stop(message, types);
        let judged = state.switch.judge(now, Command { source, seq, stamp_ns, least_age, is_stop });
        if state.tell_stop(before.is_none()) {
            self.changed.notify_one();
        }
        match judged {
            Ok(()) => {
                state.last = Some(message.clone());
                if before.is_some() {
                    info!("commands pass the dead-man switch again");
                    self.changed.notify_one();
                }
                Ok(())
            }
            Err(refusal) => {
                let counts = &mut state.counts;
                let (count, reason) = match refusal {
                    CommandRefusal::Late => (&mut counts.late, DataDrop::LateCommand),
                    CommandRefusal::Unjudged => (&mut counts.unjudged, DataDrop::UnjudgedCommand),
                    CommandRefusal::NotResumed => (&mut counts.not_resumed, DataDrop::NotResumed),
                };
                *count += 1;
                Err(reason)
            }
        }
    }

    /// Returns whether the stop message is to be published now, to so many local readers: it is due, or one of them is new
    /// to the stopped robot.
    pub(crate) fn tick(&self, now: Instant, readers: u32) -> bool {
        let state = &mut *self.lock();
        let is_due = state.tell(|switch| switch.tick(now));
        let is_stopped = state.switch.stopped().is_some();
        let has_new = is_stopped && readers > state.readers;
        // One that is gone may come back.
        state.readers = state.readers.min(readers);
        is_due || has_new
    }

    /// Returns whether the stop message is to be published because the last local writer closes.
    pub(crate) fn close(&self, now: Instant) -> bool {
        self.lock().tell(|switch| switch.close(now))
    }

    /// Has a stop message that waits published at once: there is a writer or a type.
    pub(crate) fn try_again(&self) {
        self.lock().switch.try_again(Instant::now());
        self.changed.notify_one();
    }

    /// Lets the next command in time pass. Returns `false` if the robot is not stopped.
    pub(crate) fn resume(&self) -> bool {
        self.lock().switch.resume()
    }

    /// Returns the source of the last command that passed.
    pub(crate) fn last_source(&self) -> Option<SourceId> {
        self.lock().last.as_ref().map(|last| last.source)
    }

    /// Notes that so many local readers got what there is of a stop message.
    pub(crate) fn note_published(&self, readers: u32, is_message: bool) {
        let mut state = self.lock();
        state.counts.stops += u64::from(is_message);
        state.readers = readers;
    }

    /// Notes that the stop message has to be tried again.
    pub(crate) fn note_not_published(&self) {
        self.lock().switch.not_published(Instant::now() + STOP_AGAIN);
    }

    /// Makes the stop message, or returns the last one that could be made. Returns `None` if there is none: no command
    /// passed that could be repeated.
    ///
    /// # Errors
    /// The type is not known yet, or the message does not fit it.
    pub(crate) fn stop_message(&self, types: &TypeSlot) -> Result<Option<Message>, NoStopMessage> {
        let state = &mut *self.lock();
        let made = match (state.stop_message(types), &state.made) {
            (Err(error), Some(before)) => {
                warn!(%error, "a dead-man switch publishes an earlier stop message, because it cannot make the configured one");
                return Ok(Some(before.clone()));
            }
            (made, _) => made,
        };
        if let Ok(Some(message)) = &made {
            state.made = Some(message.clone());
        }
        let failure = made.as_ref().err().map(ToString::to_string);
        if state.failure != failure {
            if let Some(error) = &failure {
                warn!(%error, "no command passes, because the stop message of a dead-man switch cannot be published");
            }
            state.failure = failure;
        }
        made
    }

    fn lock(&self) -> MutexGuard<'_, State> {
        lock(&self.state)
    }
}

impl Drop for DeadManSwitch {
    /// Ends the task that waits.
    fn drop(&mut self) {
        self.changed.notify_one();
    }
}

/// Why there is no stop message.
#[derive(Debug, thiserror::Error)]
pub(crate) enum NoStopMessage {
    #[error("the type of the topic is not known here")]
    UnknownType,
    #[error("the stop message is none of the topic's type: {0}")]
    Value(#[from] ValueError),
}

impl State {
    fn tell(&mut self, is_due: impl FnOnce(&mut DeadMan) -> bool) -> bool {
        let was_moving = self.switch.stopped().is_none();
        let is_due = is_due(&mut self.switch);
        self.tell_stop(was_moving);
        is_due
    }

    /// Logs that the robot is stopped, and returns `true`, if it was moving before.
    fn tell_stop(&self, was_moving: bool) -> bool {
        let Some((cause, _)) = self.switch.stopped().filter(|_| was_moving) else { return false };
        warn!(cause = cause_word(cause), "a dead-man switch stops the robot");
        true
    }

    fn stop_message(&mut self, types: &TypeSlot) -> Result<Option<Message>, NoStopMessage> {
        let now_ns = unix_ns();
        let head = MessageHead::new(MessageKind::Write, now_ns);
        let last = self.last.as_ref();
        let source = last.map_or(SourceId([0; 16]), |last| last.source);
        if self.rule.stop == StopMessage::Last {
            return Ok(last.map(|last| {
                let head = MessageHead { source_timestamp_ns: now_ns, ..last.head };
                Message { head, reliable: false, ..last.clone() }
            }));
        }
        let known = types.now();
        let layout = known.layout().ok_or(NoStopMessage::UnknownType)?;
        let mut value = self.stop_value(layout)?;
        if layout.begins_with_header() {
            set_stamp(&mut value, now_ns);
        }
        let payload = layout.encode(&value)?.into();
        Ok(Some(Message { source, seq: 0, head, reliable: false, payload }))
    }

    /// Returns the stop message without its time.
    fn stop_value(&self, layout: &Layout) -> Result<Value, ValueError> {
        match &self.rule.stop {
            StopMessage::Json(text) => layout.from_json(text.as_bytes()),
            StopMessage::Zero | StopMessage::Last => layout.from_json(b"{}"),
        }
    }

    /// Returns whether a message is the stop message itself, whatever its header.
    fn is_stop(&mut self, message: &Message, types: &TypeSlot) -> bool {
        let known = types.now();
        let (Some(layout), PayloadForm::Cdr) = (known.layout(), message.head.form) else { return false };
        if self.rule.stop == StopMessage::Last
            || Decompressor::original_bytes(message.head.encoding, &message.payload) > STOP_BYTES_MAX
        {
            return false;
        }
        let payload = self.decompressor.decompress(message.head.encoding, message.payload.clone());
        let Some(found) = payload.ok().and_then(|payload| layout.decode(&payload).ok()) else { return false };
        let has_header = layout.begins_with_header();
        let content = |value: Value| match value {
            Value::Record(members) => members.into_iter().skip(usize::from(has_header)).collect(),
            _ => Vec::new(),
        };
        self.stop_value(layout).is_ok_and(|stop| content(stop) == content(found))
    }
}

/// Sets the time in the header of a message that begins with one, if there is none.
fn set_stamp(value: &mut Value, now_ns: i64) {
    let Value::Record(members) = value else { return };
    let Some((_, Value::Record(header))) = members.first_mut() else { return };
    let Some((_, Value::Record(stamp))) = header.first_mut() else { return };
    if let [(_, sec @ Value::Int(0)), (_, nanosec @ Value::Uint(0))] = &mut stamp[..] {
        *sec = Value::Int(now_ns / 1_000_000_000);
        *nanosec = Value::Uint((now_ns % 1_000_000_000).unsigned_abs());
    }
}

/// Returns a cause in the words of documents and logs.
pub(crate) fn cause_word(cause: StopCause) -> &'static str {
    match cause {
        StopCause::Start => "start",
        StopCause::Silence => "silence",
        StopCause::Late => "late",
        StopCause::Closed => "closed",
    }
}
