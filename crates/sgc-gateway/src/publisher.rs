//! [`Publication`]: what one client publishes on a topic.

use std::collections::VecDeque;
use std::fmt;
use std::sync::atomic::{AtomicBool, AtomicU64, Ordering};
use std::sync::{Arc, Mutex};
use std::time::Duration;

use bytes::Bytes;
use sgc_cdr::{Layout, Value};
use sgc_ros::{EndpointKind, EndpointSpec, RosError, RosWriter, SampleHead, SampleKind, dds_topic, dds_type};
use sgc_wire::{History, Qos};
use tokio::time::Instant;

use crate::content::{Content, serialise};
use crate::error::GatewayError;
use crate::feed::own_endpoint;
use crate::hub::{Shared, lock};
use crate::quota::{Charge, Quota, Waiting};

/// How long readers may take to acknowledge what was written last before its writer ends.
const FAREWELL_MAX: Duration = Duration::from_secs(1);
/// How long a thread waits for readers before it is looked whether anybody still wants that.
const MATCH_WAIT_MAX: Duration = Duration::from_secs(1);
/// Longest payload that the local network takes, bytes (`sgc-dds` refuses more).
const PAYLOAD_BYTES_MAX: usize = 64 << 20;

/// Messages that are written by one thread in one go, and their bytes: what is more waits until these are written.
const AHEAD_MAX: usize = 64;
const AHEAD_BYTES_MAX: usize = 64 << 10;
/// A reliable writer that keeps its last messages does not wait for readers while these have not more bytes than that: Cyclone
/// lets 30 kB be unacknowledged when it begins, more later.
const UNACKNOWLEDGED_BYTES_MIN: usize = 24 << 10;

/// Messages that a transient-local writer of a topic with keys keeps, of all instances (`sgc-dds`).
const KEYED_KEPT_MAX: usize = 4096;

/// Whom a [`Publication`] counts for.
#[derive(Debug)]
pub(crate) struct Account {
    /// The quota of its client.
    pub(crate) quota: Quota,
    /// Its place among the publications of its client's credential, if it has one of its own.
    pub(crate) charge: Option<Charge>,
    /// Bytes of messages that the client's transient-local writers keep, if its messages are counted.
    pub(crate) kept: Option<Arc<Waiting>>,
}

/// Lengths of the messages that a transient-local writer keeps for readers that come later.
#[derive(Debug)]
struct Kept {
    waiting: Arc<Waiting>,
    depth: usize,
    lengths: Mutex<Lengths>,
}

#[derive(Debug, Default)]
struct Lengths {
    /// Lengths in bytes, the newest last.
    each: VecDeque<usize>,
    sum: usize,
}

impl Kept {
    fn new(waiting: Arc<Waiting>, depth: usize) -> Self {
        Self { waiting, depth: depth.max(1), lengths: Mutex::default() }
    }

    /// Takes room for a message, which takes the place of the oldest one if the writer keeps as many as it may.
    fn take(&self, bytes: usize) -> Result<(), GatewayError> {
        let mut lengths = lock(&self.lengths);
        let is_full = lengths.each.len() >= self.depth;
        let oldest = lengths.each.front().copied().filter(|_| is_full).unwrap_or(0);
        match bytes.checked_sub(oldest) {
            Some(more) => self.waiting.take("bytes of messages that are kept for later readers", more)?,
            None => self.waiting.sub(oldest - bytes),
        }
        if is_full {
            lengths.each.pop_front();
        }
        lengths.each.push_back(bytes);
        lengths.sum = lengths.sum - oldest + bytes;
        Ok(())
    }
}

impl Drop for Kept {
    fn drop(&mut self) {
        self.waiting.sub(lock(&self.lengths).sum);
    }
}

/// What one client publishes on a topic; ends when dropped, once reliable readers have what was written.
pub struct Publication {
    shared: Arc<Shared>,
    line: Arc<Line>,
    layout: Arc<Layout>,
    topic: String,
    type_name: String,
    /// Longest message that is written without ever waiting for readers.
    bytes_at_once_max: usize,
    /// Whether a write may wait for readers, since one before it may: they keep their order.
    may_block: AtomicBool,
    /// The quota of its client.
    quota: Quota,
    _charge: Option<Charge>,
}

/// A writer, and what waits to be written by a thread that may wait.
struct Line {
    writer: Arc<dyn RosWriter>,
    ahead: Mutex<Ahead>,
    /// Held by who writes what waits, so that it keeps its order.
    turn: Mutex<()>,
    published: AtomicU64,
    /// The count of the messages that the writer keeps, until the writer ends.
    kept: Option<Kept>,
}

#[derive(Default)]
struct Ahead {
    /// Source time stamps, nanoseconds since the Unix epoch, and payloads.
    messages: VecDeque<(i64, Bytes)>,
    bytes: usize,
}

impl Line {
    /// Writes one message, which leaves with those that follow, or when the writer is flushed.
    fn write(&self, stamp_ns: i64, payload: Bytes) -> Result<(), RosError> {
        self.writer.write_ahead(SampleHead::new(SampleKind::Write, stamp_ns), payload)?;
        self.published.fetch_add(1, Ordering::Relaxed);
        Ok(())
    }

    /// Writes what waits, up to the first message that cannot be written. May block.
    fn write_out(&self) -> Result<(), RosError> {
        let _turn = lock(&self.turn);
        let next = || {
            let mut ahead = lock(&self.ahead);
            let next = ahead.messages.pop_front()?;
            ahead.bytes -= next.1.len();
            Some(next)
        };
        let mut written = Ok(());
        while written.is_ok()
            && let Some((stamp_ns, payload)) = next()
        {
            written = self.write(stamp_ns, payload);
        }
        self.writer.flush();
        written
    }
}

impl Publication {
    pub(crate) async fn new(
        shared: &Arc<Shared>,
        topic: String,
        type_name: String,
        qos: Qos,
        account: Account,
    ) -> Result<Self, GatewayError> {
        shared
            .run(move |shared| {
                let graph = shared.graph();
                let info = graph.topics.get(&topic);
                let hash = info.and_then(|info| info.type_hash(&type_name));
                let layout = shared.types.layout(&type_name, hash)?;
                let ends = info.iter().flat_map(|info| info.subscribers.iter().chain(&info.publishers));
                let is_keyed = ends.filter(|end| end.type_name == type_name).any(|end| !end.keyless);
                let spec = EndpointSpec {
                    topic: dds_topic(&topic),
                    type_name: dds_type(&type_name),
                    keyless: !is_keyed,
                    asks_key_hash: false,
                    type_hash: Some(hash.map_or_else(|| layout.type_hash(), str::to_owned)),
                    qos,
                };
                let kept = account.kept.filter(|_| spec.qos.is_transient_local());
                let kept = kept.map(|kept| Kept::new(kept, kept_max(&spec)));
                let writer: Arc<dyn RosWriter> = Arc::from(shared.ros.writer(&spec)?);
                shared.know(own_endpoint(EndpointKind::Writer, writer.guid(), &spec));
                let (ahead, turn, published) = (Mutex::default(), Mutex::default(), AtomicU64::new(0));
                let line = Arc::new(Line { writer, ahead, turn, published, kept });
                let bytes_at_once_max = bytes_at_once_max(&spec);
                let may_block = AtomicBool::new(bytes_at_once_max == 0);
                let shared = Arc::clone(shared);
                Ok(Self {
                    shared,
                    line,
                    layout,
                    topic,
                    type_name,
                    bytes_at_once_max,
                    may_block,
                    quota: account.quota,
                    _charge: account.charge,
                })
            })
            .await
    }

    /// The topic.
    pub fn topic(&self) -> &str {
        &self.topic
    }

    /// Its ROS type.
    pub fn type_name(&self) -> &str {
        &self.type_name
    }

    /// What its messages look like.
    pub fn layout(&self) -> &Arc<Layout> {
        &self.layout
    }

    /// Publishes a message; waits for readers if the quality of service says so.
    pub async fn publish(&self, content: &Content) -> Result<(), GatewayError> {
        self.publish_ahead(content).await?;
        self.flush().await
    }

    /// The same, but the message need not leave before [`Self::flush`]: those that follow share packets with it, and changes
    /// of threads. If readers are waited for, what fails may be a message before it.
    pub async fn publish_ahead(&self, content: &Content) -> Result<(), GatewayError> {
        self.write_ahead(content.to_cdr(&self.layout)?).await
    }

    /// The same with a value.
    pub(crate) async fn publish_value_ahead(&self, value: &Value) -> Result<(), GatewayError> {
        self.write_ahead(serialise(&self.layout, value)?).await
    }

    /// Publishes a value; waits for readers if the quality of service says so.
    pub(crate) async fn publish_value(&self, value: &Value) -> Result<(), GatewayError> {
        self.publish_value_ahead(value).await?;
        self.flush().await
    }

    async fn write_ahead(&self, payload: Bytes) -> Result<(), GatewayError> {
        if payload.len() > PAYLOAD_BYTES_MAX {
            return Err(GatewayError::TooLong { bytes: payload.len(), max: PAYLOAD_BYTES_MAX });
        }
        if let Some(kept) = &self.line.kept {
            kept.take(payload.len())?;
        }
        let since = std::time::SystemTime::now().duration_since(std::time::UNIX_EPOCH);
        let stamp_ns = since.map_or(0, |since| since.as_nanos().try_into().unwrap_or(i64::MAX));
        if payload.len() > self.bytes_at_once_max {
            self.may_block.store(true, Ordering::Relaxed);
        }
        if !self.may_block.load(Ordering::Relaxed) {
            return Ok(self.line.write(stamp_ns, payload)?);
        }
        let is_full = {
            let mut ahead = lock(&self.line.ahead);
            ahead.bytes += payload.len();
            ahead.messages.push_back((stamp_ns, payload));
            ahead.messages.len() >= AHEAD_MAX || ahead.bytes >= AHEAD_BYTES_MAX
        };
        if is_full { self.flush().await } else { Ok(()) }
    }

    /// Has what was published ahead leave. After an error, which is of one message, that is lost, what is behind it waits for
    /// the next call.
    pub async fn flush(&self) -> Result<(), GatewayError> {
        if !self.may_block.load(Ordering::Relaxed) {
            self.line.writer.flush();
            return Ok(());
        }
        if !self.has_ahead() {
            return Ok(());
        }
        let _thread = self.quota.thread().await?;
        let line = Arc::clone(&self.line);
        self.shared.blocking(move |_| line.write_out()).await
    }

    /// Whether messages wait that were published ahead.
    pub fn has_ahead(&self) -> bool {
        !lock(&self.line.ahead).messages.is_empty()
    }

    /// How many messages were published: those that wait are not counted yet.
    pub fn published(&self) -> u64 {
        self.line.published.load(Ordering::Relaxed)
    }

    /// How many local readers hear it at present.
    pub fn matched_readers(&self) -> u32 {
        self.line.writer.matched_readers()
    }

    /// Waits until so many readers hear it, or for so long; says how many do.
    pub async fn wait_for_readers(&self, readers: u32, max: Duration) -> u32 {
        let until = Instant::now() + max;
        loop {
            let matched = self.matched_readers();
            let left = until.saturating_duration_since(Instant::now()).min(MATCH_WAIT_MAX);
            if matched >= readers || left.is_zero() {
                return matched;
            }
            let Ok(Ok(_thread)) = tokio::time::timeout(left, self.quota.thread()).await else {
                return matched;
            };
            let left = until.saturating_duration_since(Instant::now()).min(MATCH_WAIT_MAX);
            let line = Arc::clone(&self.line);
            let waited = self.shared.blocking(move |_| Ok(line.writer.wait_matched(readers, left)));
            if waited.await.is_err() {
                return matched;
            }
        }
    }

    /// Waits, not long, until those readers are matched that the graph shows: what is written to others before is lost,
    /// as with any writer that is new.
    pub async fn settle(&self, max: Duration) {
        let graph = self.shared.graph();
        let readers = graph.topics.get(&self.topic).map_or(0, |info| {
            let is_one = |end: &&crate::graph::EndpointInfo| end.type_name == self.type_name && !end.is_own;
            info.subscribers.iter().filter(is_one).count()
        });
        self.wait_for_readers(u32::try_from(readers).unwrap_or(u32::MAX), max).await;
    }
}

impl fmt::Debug for Publication {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_struct("Publication").field("topic", &self.topic).finish_non_exhaustive()
    }
}

impl Drop for Publication {
    fn drop(&mut self) {
        let (shared, line) = (Arc::clone(&self.shared), Arc::clone(&self.line));
        let place = Arc::clone(&shared.farewells).try_acquire_owned();
        self.shared.runtime.spawn_blocking(move || {
            // Where many end at once, not all can be waited for.
            if place.is_ok() {
                if let Err(error) = line.write_out() {
                    tracing::debug!(%error, "what was published last is lost");
                }
                line.writer.wait_acknowledged(FAREWELL_MAX);
            }
            shared.forget(&[line.writer.guid()]);
            drop(line);
        });
    }
}

/// Returns the most messages that a transient-local writer keeps.
fn kept_max(spec: &EndpointSpec) -> usize {
    match &spec.qos.history {
        History::KeepLast(depth) if spec.keyless => *depth as usize,
        _ => KEYED_KEPT_MAX,
    }
}

/// Longest message that a writer never has to wait with; 0 if it may with any.
fn bytes_at_once_max(spec: &EndpointSpec) -> usize {
    match (spec.qos.is_reliable(), &spec.qos.history) {
        (false, _) => usize::MAX,
        // Of each instance of a topic with keys so many are kept.
        (true, History::KeepLast(depth)) if spec.keyless => {
            UNACKNOWLEDGED_BYTES_MIN / (*depth as usize).max(1)
        }
        (true, _) => 0,
    }
}
