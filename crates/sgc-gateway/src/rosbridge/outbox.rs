//! [`Outbox`]: the frames queued for a client in two lanes, and [`write_all`], which writes them.
//!
//! Replies, requests and status go before messages of topics. Both lanes are short and senders wait for a place, so
//! that for a client that does not read, frames do not pile up here and its subscriptions drop old messages. Long
//! replies and requests also wait for room in bytes. Nothing holds back replies, so they are refused once waiting
//! ones exceed the room.

use std::sync::Arc;
use std::sync::atomic::{AtomicU8, Ordering};
use std::time::Duration;

use futures_util::{Sink, SinkExt as _};
use sgc_websocket::{Message, WebSocketError};
use tokio::sync::{Mutex as Turns, MutexGuard as Turn, mpsc};

use super::envelope::{Envelope, Frame};
use super::op::OpId;
use super::options::RosbridgeError;
use crate::budget::{Budget, Room};
use crate::error::GatewayError;
use crate::keep_alive::{PingState, TooSlow, write_paced};
use crate::quota::Quota;

/// Shortest interval of pings.
const PING_INTERVAL_MIN: Duration = Duration::from_millis(10);
/// Most queued replies, requests and status frames.
const CONTROL_MAX: usize = 64;
/// Most queued batches of messages.
const BATCHES_MAX: usize = 4;
/// Most bytes that are written before a flush.
const FLUSH_BYTES: usize = 256 << 10;

/// The severity of statuses that a client receives.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
#[repr(u8)]
pub(super) enum Level {
    None,
    Error,
    Warning,
    Info,
}

impl Level {
    pub(super) fn from_name(name: &str) -> Option<Self> {
        Some(match name {
            "none" => Self::None,
            "error" => Self::Error,
            "warning" | "warn" => Self::Warning,
            "info" => Self::Info,
            _ => return None,
        })
    }

    fn name(self) -> &'static str {
        match self {
            Self::None => "none",
            Self::Error => "error",
            Self::Warning => "warning",
            Self::Info => "info",
        }
    }
}

/// The frames queued for a client.
#[derive(Clone, Debug)]
pub(super) struct Outbox {
    control: mpsc::Sender<ControlFrame>,
    batches: mpsc::Sender<Vec<Frame>>,
    level: Arc<AtomicU8>,
    room: Arc<Budget>,
    turns: Arc<Turns<()>>,
}

/// A frame of the first lane, and its room until it is written.
#[derive(Debug)]
struct ControlFrame {
    frame: Frame,
    room: Option<Room>,
}

impl ControlFrame {
    fn frames(self) -> (Vec<Frame>, Option<Room>) {
        (vec![self.frame], self.room)
    }
}

/// The receiving end of an [`Outbox`].
#[derive(Debug)]
pub(super) struct Outgoing {
    control: mpsc::Receiver<ControlFrame>,
    batches: mpsc::Receiver<Vec<Frame>>,
}

impl Outgoing {
    /// Drops all queued frames.
    pub(super) fn clear(&mut self) {
        self.batches.close();
        self.control.close();
        while self.batches.try_recv().is_ok() {}
        while self.control.try_recv().is_ok() {}
    }
}

/// The error of an ended connection.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) struct ConnectionClosed;

impl Outbox {
    /// Creates an outbox with `bytes_max` bytes of room for long replies and requests.
    pub(super) fn new(bytes_max: usize, quota: Quota) -> (Self, Outgoing) {
        let (control, control_out) = mpsc::channel(CONTROL_MAX);
        let (batches, batches_out) = mpsc::channel(BATCHES_MAX);
        let level = Arc::new(AtomicU8::new(Level::Error as u8));
        let (room, turns) = (Arc::new(Budget::new(bytes_max, quota)), Arc::default());
        (
            Self { control, batches, level, room, turns },
            Outgoing { control: control_out, batches: batches_out },
        )
    }

    pub(super) fn set_level(&self, level: Level) {
        self.level.store(level as u8, Ordering::Relaxed);
    }

    /// Queues a frame once there is room.
    pub(super) async fn say(&self, frame: Frame) -> Result<(), ConnectionClosed> {
        let room = self.room.take(frame.bytes()).await;
        self.control.send(ControlFrame { frame, room }).await.map_err(|_| ConnectionClosed)
    }

    /// Queues a reply, whose memory is taken already, once there is room.
    ///
    /// # Errors
    /// Too many bytes of replies wait. An ended connection is no error, because there is no client to inform.
    pub(super) async fn say_reply(&self, frame: Frame) -> Result<(), GatewayError> {
        let room = self.room.take_for_reply(frame.bytes()).await?;
        let _ = self.control.send(ControlFrame { frame, room }).await;
        Ok(())
    }

    /// Waits for the turn to write a request, so that a client that does not read has one unsent request.
    pub(super) async fn turn(&self) -> Turn<'_, ()> {
        self.turns.lock().await
    }

    fn status_frame(&self, level: Level, told: &str, id: Option<&OpId>) -> Option<Frame> {
        let is_wanted = level as u8 <= self.level.load(Ordering::Relaxed);
        let status = || Envelope::json("status").text("level", level.name()).text("msg", told).id(id);
        is_wanted.then(|| status().finish())
    }

    /// Sends a status if the client's level asks for it.
    pub(super) async fn status(
        &self,
        level: Level,
        told: &str,
        id: Option<&OpId>,
    ) -> Result<(), ConnectionClosed> {
        match self.status_frame(level, told, id) {
            Some(frame) => self.say(frame).await,
            None => Ok(()),
        }
    }

    /// Sends a status without waiting. It is dropped if there is no room.
    pub(super) fn try_status(&self, level: Level, told: &str, id: Option<&OpId>) {
        if let Some(frame) = self.status_frame(level, told, id) {
            let _ = self.control.try_send(ControlFrame { frame, room: None });
        }
    }

    /// Waits for a place for messages, so that messages are encoded only when there is one.
    pub(super) async fn place(&self) -> Result<mpsc::Permit<'_, Vec<Frame>>, ConnectionClosed> {
        self.batches.reserve().await.map_err(|_| ConnectionClosed)
    }
}

/// Returns the interval of pings and checks.
pub(super) fn ping_interval(silence_max: Duration) -> Duration {
    (silence_max / 4).max(PING_INTERVAL_MIN)
}

/// Writes frames until the connection ends.
pub(super) async fn write_all<W>(
    sink: &mut W,
    outgoing: &mut Outgoing,
    pings: &PingState,
    silence_max: Duration,
) -> RosbridgeError
where
    W: Sink<Message, Error = WebSocketError> + Unpin,
{
    let mut interval = tokio::time::interval(ping_interval(silence_max));
    interval.set_missed_tick_behavior(tokio::time::MissedTickBehavior::Delay);
    interval.reset();
    loop {
        let (said, is_ping) = tokio::select! {
            biased;
            _ = interval.tick() => ((Vec::new(), None), true),
            Some(said) = outgoing.control.recv() => (said.frames(), false),
            Some(batch) = outgoing.batches.recv() => ((batch, None), false),
            else => return RosbridgeError::Socket(WebSocketError::Closed),
        };
        let written = async {
            if is_ping {
                timed(silence_max, 0, sink.send(Message::Ping(Default::default()))).await?;
                pings.asked();
            }
            let mut bytes = 0;
            let (mut frames, mut room) = said;
            loop {
                for frame in frames {
                    bytes += feed(sink, frame, silence_max).await?;
                }
                if bytes >= FLUSH_BYTES {
                    break;
                }
                let next = outgoing.control.try_recv().map(ControlFrame::frames);
                let next = next.or_else(|_| outgoing.batches.try_recv().map(|batch| (batch, None)));
                drop(room);
                (frames, room) = match next {
                    Ok(next) => next,
                    Err(_) => break,
                };
            }
            timed(silence_max, bytes, sink.flush()).await
        };
        if let Err(error) = written.await {
            return error;
        }
    }
}

/// Writes the remaining frames of the first lane, and no messages of topics.
pub(super) async fn write_rest<W>(sink: &mut W, outgoing: &mut Outgoing) -> Result<(), WebSocketError>
where
    W: Sink<Message, Error = WebSocketError> + Unpin,
{
    outgoing.batches.close();
    outgoing.control.close();
    while let Ok(said) = outgoing.control.try_recv() {
        for message in said.frame.messages() {
            sink.feed(message).await?;
        }
    }
    sink.flush().await
}

async fn feed<W>(sink: &mut W, frame: Frame, silence_max: Duration) -> Result<usize, RosbridgeError>
where
    W: Sink<Message, Error = WebSocketError> + Unpin,
{
    let bytes = frame.bytes();
    for message in frame.messages() {
        let length = message.payload_bytes();
        timed(silence_max, length, sink.feed(message)).await?;
    }
    Ok(bytes)
}

/// Limits the duration of a write.
async fn timed(
    silence_max: Duration,
    bytes: usize,
    write: impl Future<Output = Result<(), WebSocketError>>,
) -> Result<(), RosbridgeError> {
    match write_paced(silence_max, bytes, write).await {
        Ok(result) => result.map_err(RosbridgeError::Socket),
        Err(TooSlow(max)) => Err(RosbridgeError::Silent(max)),
    }
}
