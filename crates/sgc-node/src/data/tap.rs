//! Taps: copies of passing messages for readers at the status socket.
//!
//! A tap never delays anything. A message that does not fit into its queue replaces the oldest, which is counted.
//! Without a tap, a message costs one check of a flag.

use std::collections::VecDeque;
use std::sync::atomic::{AtomicBool, Ordering::Relaxed};
use std::sync::{Arc, Mutex};
use std::time::{Duration, Instant, SystemTime, UNIX_EPOCH};

use bytes::{Buf as _, Bytes};
use sgc_cdr::Layout;
use sgc_endpoint::{Decompressor, Message};
use sgc_ros::{Sample, SampleKind};
use sgc_sync::lock;
use sgc_types::ResolvedType;
use sgc_wire::{KEY_HASH_BYTES, MessageKind, PayloadEncoding, PayloadForm, Representations};
use tokio::sync::Notify;

use crate::admin::graph::Side;
use crate::data::conversion;

/// Most messages that wait for one reader.
const TAP_MESSAGES_MAX: usize = 256;
/// Most bytes that wait for one reader. A single larger message is allowed alone.
const TAP_BYTES_MAX: usize = 16 << 20;
/// Most taps of one topic at a time.
const TAPS_MAX: usize = 8;

/// A copy of a passing message.
#[derive(Clone, Debug)]
pub(crate) struct TapMessage {
    /// Data, or the end of an instance.
    pub kind: SampleKind,
    /// The publisher's time stamp, nanoseconds since the Unix epoch.
    pub source_timestamp_ns: i64,
    /// Wall-clock time at which the message passed, nanoseconds since the Unix epoch.
    pub seen_unix_ns: i64,
    /// Time at which the message passed.
    pub seen: Instant,
    /// Encapsulation header and body. A message from the network keeps its wire form until [`read`](Self::read).
    pub payload: Bytes,
    came: Option<Came>,
}

/// Wire form of a message from the network.
#[derive(Clone, Debug)]
struct Came {
    encoding: PayloadEncoding,
    form: PayloadForm,
    layout: Option<Arc<Layout>>,
}

impl TapMessage {
    pub(crate) fn from_sample(sample: &Sample) -> Self {
        Self::now(sample.kind, sample.source_timestamp_ns, sample.payload.clone())
    }

    /// Copies a message from the network. `layout` is its type, if known. The reader of the tap decodes it, since that
    /// takes time.
    pub(crate) fn from_message(message: &Message, layout: Option<&Arc<Layout>>) -> Self {
        let kind = match message.head.kind {
            MessageKind::Dispose => SampleKind::Dispose,
            MessageKind::Unregister => SampleKind::Unregister,
            // Messages of other kinds are no samples and are not offered.
            _ => SampleKind::Write,
        };
        let (encoding, form) = (message.head.encoding, message.head.form);
        let came = Came { encoding, form, layout: layout.cloned() };
        let tapped = Self::now(kind, message.head.source_timestamp_ns, message.payload.clone());
        Self { came: Some(came), ..tapped }
    }

    /// Decodes the message into the form that the local network gets, if its type is known. Otherwise it stays as it
    /// is. Takes time.
    pub(crate) fn read(mut self) -> Self {
        let Some(Came { encoding, form, layout }) = self.came.take() else { return self };
        if let Ok(plain) = Decompressor::default().decompress(encoding, self.payload.clone()) {
            self.payload = plain;
        }
        let cdr =
            |layout: Arc<Layout>| conversion::from_json(&layout, &self.payload, Representations::XCDR1).ok();
        match form {
            PayloadForm::Cdr => {}
            PayloadForm::Json => self.payload = layout.and_then(cdr).unwrap_or(self.payload),
            PayloadForm::KeyedCdr if self.payload.len() >= KEY_HASH_BYTES => {
                self.payload.advance(KEY_HASH_BYTES);
            }
            PayloadForm::KeyedCdr => {}
        }
        self
    }

    /// Returns `true` if decoding takes time.
    pub(crate) fn is_raw(&self) -> bool {
        self.came
            .as_ref()
            .is_some_and(|came| came.encoding != PayloadEncoding::Plain || came.form != PayloadForm::Cdr)
    }

    fn now(kind: SampleKind, source_timestamp_ns: i64, payload: Bytes) -> Self {
        let unix = SystemTime::now().duration_since(UNIX_EPOCH).unwrap_or(Duration::ZERO);
        let seen_unix_ns = unix.as_nanos().try_into().unwrap_or(i64::MAX);
        Self { kind, source_timestamp_ns, seen_unix_ns, seen: Instant::now(), payload, came: None }
    }
}

/// The taps of one topic.
#[derive(Debug, Default)]
pub(crate) struct Taps {
    any: AtomicBool,
    all: Mutex<Vec<Arc<TapQueue>>>,
}

impl Taps {
    /// Adds a tap. Returns `None` if there are too many.
    pub(crate) fn add(&self) -> Option<Arc<TapQueue>> {
        let mut all = lock(&self.all);
        all.retain(|tap| !tap.is_closed());
        if all.len() >= TAPS_MAX {
            return None;
        }
        let tap = Arc::new(TapQueue::default());
        all.push(tap.clone());
        self.any.store(true, Relaxed);
        Some(tap)
    }

    /// Returns `true` if there is a tap.
    pub(crate) fn is_any(&self) -> bool {
        self.any.load(Relaxed)
    }

    /// Offers a message to all taps.
    pub(crate) fn offer(&self, message: impl FnOnce() -> TapMessage) {
        if !self.is_any() {
            return;
        }
        let message = message();
        let mut all = lock(&self.all);
        all.retain(|tap| !tap.is_closed());
        if all.is_empty() {
            self.any.store(false, Relaxed);
        }
        all.iter().for_each(|tap| tap.push(message.clone()));
    }

    /// Closes all taps.
    pub(crate) fn close(&self) {
        lock(&self.all).drain(..).for_each(|tap| tap.close());
        self.any.store(false, Relaxed);
    }
}

#[derive(Debug, Default)]
struct Waiting {
    messages: VecDeque<TapMessage>,
    bytes: usize,
    dropped: u64,
    is_closed: bool,
}

/// Queue of messages for one reader.
#[derive(Debug, Default)]
pub(crate) struct TapQueue {
    waiting: Mutex<Waiting>,
    changed: Notify,
}

impl TapQueue {
    /// Queues a message. Older ones make room.
    pub(crate) fn push(&self, message: TapMessage) {
        let mut waiting = lock(&self.waiting);
        if waiting.is_closed {
            return;
        }
        let bytes = message.payload.len();
        while !waiting.messages.is_empty()
            && (waiting.messages.len() >= TAP_MESSAGES_MAX || waiting.bytes + bytes > TAP_BYTES_MAX)
        {
            if let Some(oldest) = waiting.messages.pop_front() {
                waiting.bytes -= oldest.payload.len();
                waiting.dropped += 1;
            }
        }
        waiting.bytes += bytes;
        waiting.messages.push_back(message);
        drop(waiting);
        self.changed.notify_one();
    }

    /// Returns the next message and the number of drops so far; `None` once the queue is closed.
    pub(crate) async fn pop(&self) -> Option<(TapMessage, u64)> {
        loop {
            let changed = self.changed.notified();
            {
                let mut waiting = lock(&self.waiting);
                if let Some(message) = waiting.messages.pop_front() {
                    waiting.bytes -= message.payload.len();
                    return Some((message, waiting.dropped));
                }
                if waiting.is_closed {
                    return None;
                }
            }
            changed.await;
        }
    }

    /// Closes the queue, because the reader left or the topic ended.
    pub(crate) fn close(&self) {
        lock(&self.waiting).is_closed = true;
        self.changed.notify_one();
    }

    /// Returns `true` if the queue is closed.
    pub(crate) fn is_closed(&self) -> bool {
        lock(&self.waiting).is_closed
    }
}

/// Request for a tap.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(crate) struct TapRequest {
    /// ROS topic on the local network.
    pub topic: String,
    /// Side of the topic.
    pub side: Option<Side>,
}

/// A tap that was opened.
pub(crate) struct Tap {
    /// Side of the topic.
    pub side: Side,
    /// ROS type.
    pub type_name: String,
    /// `RIHS01_…`, if known.
    pub type_hash: Option<String>,
    /// Description of the type, if known.
    pub described: Option<Arc<ResolvedType>>,
    /// Queue of passing messages.
    pub queue: Arc<TapQueue>,
    /// Local reader that exists only for this tap.
    pub reader: Option<Box<dyn std::any::Any + Send>>,
}

/// Reasons why a tap is refused.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
pub(crate) enum TapError {
    /// The topic is neither used nor published here.
    #[error(
        "nobody publishes {topic} on the local network, and this node does not use it; see `sgc why {topic}`"
    )]
    NoTopic {
        /// The topic.
        topic: String,
    },
    /// The topic is used, and no owner has it.
    #[error(
        "nobody publishes {topic} on the local network, and the [[use]] of it has brought nothing yet; see `sgc why {topic}`"
    )]
    NotBrought {
        /// The topic.
        topic: String,
    },
    /// The topic has no messages on that side.
    #[error("{topic} is not to be seen there: {why}")]
    NotThere {
        /// The topic.
        topic: String,
        /// The reason.
        why: &'static str,
    },
    /// The topic has too many taps.
    #[error("{topic} is looked at by {TAPS_MAX} already")]
    TooMany {
        /// The topic.
        topic: String,
    },
    /// The local network refused.
    #[error("{0}")]
    Network(String),
}

#[cfg(test)]
mod tests {
    use super::*;

    fn message(bytes: usize) -> TapMessage {
        TapMessage::now(SampleKind::Write, 0, Bytes::from(vec![0; bytes]))
    }

    #[test]
    fn tap_reader_decodes_messages_off_the_data_path() {
        let text = |_: &sgc_cdr::TypeName| Some("string a".to_owned());
        let layout = sgc_cdr::Library::empty().layout(&"p/msg/M".parse().unwrap(), &mut { text }).unwrap();
        let json = Bytes::from(format!(r#"{{"a":"{}"}}"#, "long ".repeat(1000)));
        let packed = sgc_endpoint::Compressor::default().compress(PayloadEncoding::Zstd, &json).unwrap();
        let head = sgc_wire::MessageHead {
            form: PayloadForm::Json,
            encoding: PayloadEncoding::Zstd,
            ..sgc_wire::MessageHead::new(MessageKind::Write, 1)
        };
        let source = sgc_wire::SourceId([1; 16]);
        let message = Message { source, seq: 1, head, reliable: true, payload: packed.clone() };
        let layout = Arc::new(layout);
        let tapped = TapMessage::from_message(&message, Some(&layout));
        assert!(tapped.payload == packed && tapped.is_raw());
        let read = tapped.read();
        assert!(!read.is_raw());
        assert_eq!(layout.decode(&read.payload).unwrap().to_json().as_bytes(), json);
        // Without a type, or with a message that does not match it, the payload is shown unchanged.
        assert_eq!(TapMessage::from_message(&message, None).read().payload, json);
        let broken = Message { payload: Bytes::from_static(b"abc"), ..message };
        assert_eq!(TapMessage::from_message(&broken, Some(&layout)).read().payload, broken.payload);
    }

    #[tokio::test]
    async fn tap_drops_messages_that_are_not_read_in_time() {
        let taps = Taps::default();
        taps.offer(|| unreachable!("nobody looks"));
        let tap = taps.add().unwrap();
        for n in 0..TAP_MESSAGES_MAX + 3 {
            taps.offer(|| message(n));
        }
        let (first, dropped) = tap.pop().await.unwrap();
        assert_eq!((first.payload.len(), dropped), (3, 3));
        taps.offer(|| message(TAP_BYTES_MAX + 1));
        let (only, dropped) = tap.pop().await.unwrap();
        assert_eq!((only.payload.len(), dropped), (TAP_BYTES_MAX + 1, 3 + TAP_MESSAGES_MAX as u64 - 1));
        tap.close();
        assert!(tap.pop().await.is_none());
        taps.offer(|| message(1));
        assert!(!taps.is_any());
    }

    #[test]
    fn not_everybody_may_look_at_once() {
        let taps = Taps::default();
        let all: Vec<_> = (0..TAPS_MAX).map(|_| taps.add().unwrap()).collect();
        assert!(taps.add().is_none());
        all[0].close();
        assert!(taps.add().is_some());
    }
}
