//! Looking at what goes by: copies of messages for who asks at the status socket.
//!
//! A tap never holds anything up. What does not fit into its queue pushes out the oldest, and is counted; where nobody
//! looks, a message costs the look at one flag.

use std::collections::VecDeque;
use std::sync::atomic::{AtomicBool, Ordering::Relaxed};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::time::{Duration, Instant, SystemTime, UNIX_EPOCH};

use bytes::{Buf as _, Bytes};
use sgc_cdr::Layout;
use sgc_endpoint::{Decompressor, Message};
use sgc_ros::{Sample, SampleKind};
use sgc_types::ResolvedType;
use sgc_wire::{KEY_HASH_BYTES, MessageKind, PayloadEncoding, PayloadForm, Representations};
use tokio::sync::Notify;

use crate::conversion;
use crate::graph::Side;

/// Messages that wait for who looks.
const TAP_MESSAGES_MAX: usize = 256;
/// Bytes of them, but for one message that is larger alone.
const TAP_BYTES_MAX: usize = 16 << 20;
/// Who may look at one topic at one time.
const TAPS_MAX: usize = 8;

/// A message that went by.
#[derive(Clone, Debug)]
pub(crate) struct Tapped {
    /// Data, or the end of an instance.
    pub kind: SampleKind,
    /// When its publisher dated it, nanoseconds since the Unix epoch.
    pub source_timestamp_ns: i64,
    /// When it went by, likewise.
    pub seen_unix_ns: i64,
    /// When it went by.
    pub seen: Instant,
    /// Encapsulation header and body; what came over the network, as that has it, until it is [read](Self::read).
    pub payload: Bytes,
    came: Option<Came>,
}

/// How a message came over the network.
#[derive(Clone, Debug)]
struct Came {
    encoding: PayloadEncoding,
    form: PayloadForm,
    layout: Option<Arc<Layout>>,
}

impl Tapped {
    pub(crate) fn of_sample(sample: &Sample) -> Self {
        Self::now(sample.kind, sample.source_timestamp_ns, sample.payload.clone())
    }

    /// A message that came over the network; `layout` is what it looks like, if that is known. Who looks reads it, since that
    /// takes its time.
    pub(crate) fn of_message(message: &Message, layout: Option<&Arc<Layout>>) -> Self {
        let kind = match message.head.kind {
            MessageKind::Dispose => SampleKind::Dispose,
            MessageKind::Unregister => SampleKind::Unregister,
            // What is no sample is not offered.
            _ => SampleKind::Write,
        };
        let (encoding, form) = (message.head.encoding, message.head.form);
        let came = Came { encoding, form, layout: layout.cloned() };
        let tapped = Self::now(kind, message.head.source_timestamp_ns, message.payload.clone());
        Self { came: Some(came), ..tapped }
    }

    /// As the local network gets it, if what it looks like is known. What cannot be read is shown as it is. Takes its time.
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

    /// Whether reading takes its time.
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

/// Who looks at one topic.
#[derive(Debug, Default)]
pub(crate) struct Taps {
    any: AtomicBool,
    all: Mutex<Vec<Arc<TapQueue>>>,
}

impl Taps {
    /// One more; `None` if there are too many.
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

    /// Whether anybody looks.
    pub(crate) fn is_any(&self) -> bool {
        self.any.load(Relaxed)
    }

    /// Shows a message to who looks.
    pub(crate) fn offer(&self, message: impl FnOnce() -> Tapped) {
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

    /// There is nothing more to see.
    pub(crate) fn close(&self) {
        lock(&self.all).drain(..).for_each(|tap| tap.close());
        self.any.store(false, Relaxed);
    }
}

#[derive(Debug, Default)]
struct Waiting {
    messages: VecDeque<Tapped>,
    bytes: usize,
    dropped: u64,
    is_closed: bool,
}

/// What waits for one who looks.
#[derive(Debug, Default)]
pub(crate) struct TapQueue {
    waiting: Mutex<Waiting>,
    changed: Notify,
}

impl TapQueue {
    /// Takes a message in; older ones give way.
    pub(crate) fn push(&self, message: Tapped) {
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

    /// The next message, and how many were dropped so far; `None` once there is no more.
    pub(crate) async fn pop(&self) -> Option<(Tapped, u64)> {
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

    /// Nobody looks any more, or there is nothing more to see.
    pub(crate) fn close(&self) {
        lock(&self.waiting).is_closed = true;
        self.changed.notify_one();
    }

    /// Whether it is.
    pub(crate) fn is_closed(&self) -> bool {
        lock(&self.waiting).is_closed
    }
}

/// What somebody wants to see.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(crate) struct TapWish {
    /// ROS topic, as it is called here.
    pub topic: String,
    /// Where.
    pub side: Option<Side>,
}

/// What is to be seen.
pub(crate) struct Tap {
    /// Where.
    pub side: Side,
    /// ROS type.
    pub type_name: String,
    /// `RIHS01_…`, if it is known.
    pub type_hash: Option<String>,
    /// What its messages look like, if that is known.
    pub described: Option<Arc<ResolvedType>>,
    /// What goes by.
    pub queue: Arc<TapQueue>,
    /// A local reader that is there for this alone.
    pub reader: Option<Box<dyn std::any::Any + Send>>,
}

/// Why there is nothing to see.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
pub(crate) enum TapError {
    /// Neither used nor published here.
    #[error(
        "nobody publishes {topic} on the local network, and this node does not use it; see `sgc why {topic}`"
    )]
    NoTopic {
        /// The topic.
        topic: String,
    },
    /// Not on that side.
    #[error("{topic} is not to be seen there: {why}")]
    NotThere {
        /// The topic.
        topic: String,
        /// Why.
        why: &'static str,
    },
    /// Too many look.
    #[error("{topic} is looked at by {TAPS_MAX} already")]
    TooMany {
        /// The topic.
        topic: String,
    },
    /// The local network refused.
    #[error("{0}")]
    Network(String),
}

fn lock<T>(mutex: &Mutex<T>) -> MutexGuard<'_, T> {
    mutex.lock().unwrap_or_else(PoisonError::into_inner)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn message(bytes: usize) -> Tapped {
        Tapped::now(SampleKind::Write, 0, Bytes::from(vec![0; bytes]))
    }

    #[test]
    fn what_came_is_read_by_who_looks_and_not_where_it_is_offered() {
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
        let tapped = Tapped::of_message(&message, Some(&layout));
        assert!(tapped.payload == packed && tapped.is_raw());
        let read = tapped.read();
        assert!(!read.is_raw());
        assert_eq!(layout.decode(&read.payload).unwrap().to_json().as_bytes(), json);
        // What it looks like is not known, or it is none: it is shown as it is.
        assert_eq!(Tapped::of_message(&message, None).read().payload, json);
        let broken = Message { payload: Bytes::from_static(b"abc"), ..message };
        assert_eq!(Tapped::of_message(&broken, Some(&layout)).read().payload, broken.payload);
    }

    #[tokio::test]
    async fn what_is_not_looked_at_in_time_gives_way() {
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
