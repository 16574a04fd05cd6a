//! [`Publication`]: a client's publisher on a topic.

use std::collections::VecDeque;
use std::fmt;
use std::sync::atomic::{AtomicBool, AtomicU64, Ordering};
use std::sync::{Arc, Mutex};
use std::time::Duration;

use bytes::Bytes;
use sgc_cdr::{Layout, Value};
use sgc_ros::{EndpointKind, EndpointSpec, RosError, RosWriter, SampleHead, SampleKind, dds_topic, dds_type};
use sgc_sync::lock;
use sgc_wire::{History, Qos};
use tokio::time::Instant;

use crate::content::{Content, serialise};
use crate::error::GatewayError;
use crate::feed::own_endpoint;
use crate::network::Network;
use crate::quota::{Charge, PendingBytes, Quota, Quotas};

/// Time within which readers must acknowledge the last messages before the writer ends.
const FAREWELL_MAX: Duration = Duration::from_secs(1);
/// Time for which a thread waits for readers before it checks whether the result is still wanted.
const MATCH_WAIT_MAX: Duration = Duration::from_secs(1);
/// Longest payload that `sgc-dds` accepts, in bytes.
const PAYLOAD_BYTES_MAX: usize = 64 << 20;

/// Most messages and bytes that one thread writes in one go. Further messages wait until these are written.
const AHEAD_MAX: usize = 64;
const AHEAD_BYTES_MAX: usize = 64 << 10;
/// A reliable writer that keeps its last messages never blocks while these have at most this many bytes. Cyclone
/// first allows 30 kB unacknowledged, later more.
const UNACKNOWLEDGED_BYTES_MIN: usize = 24 << 10;

/// Most messages that a transient-local writer of a keyed topic keeps over all instances (`sgc-dds`).
const KEYED_KEPT_MAX: usize = 4096;

/// The accounts to which a [`Publication`] is charged.
#[derive(Debug)]
pub(crate) struct Account {
    /// The quota of the client.
    pub(crate) quota: Quota,
    /// The charge of the publication to the client's credential, if it is not part of a served action.
    pub(crate) charge: Option<Charge>,
    /// The bytes of messages that the client's transient-local writers keep, if they are counted.
    pub(crate) kept: Option<Arc<PendingBytes>>,
}

/// The lengths of the messages that a transient-local writer keeps for later readers.
#[derive(Debug)]
struct WriterHistory {
    waiting: Arc<PendingBytes>,
    depth: usize,
    lengths: Mutex<Lengths>,
}

#[derive(Debug, Default)]
struct Lengths {
    /// Lengths in bytes, the newest last.
    each: VecDeque<usize>,
    sum: usize,
}

impl WriterHistory {
    fn new(waiting: Arc<PendingBytes>, depth: usize) -> Self {
        Self { waiting, depth: depth.max(1), lengths: Mutex::default() }
    }

    /// Reserves room for a message, which replaces the oldest one if the writer is at its depth.
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

impl Drop for WriterHistory {
    fn drop(&mut self) {
        self.waiting.sub(lock(&self.lengths).sum);
    }
}

/// A client's publisher on a topic. Dropping it ends the writer after reliable readers have the last messages.
pub struct Publication {
    shared: Arc<Network>,
    line: Arc<WriteQueue>,
    layout: Arc<Layout>,
    topic: String,
    type_name: String,
    /// Longest message that never waits for readers.
    bytes_at_once_max: usize,
    /// `true` if writes go through the queue because an earlier write may block; this keeps their order.
    may_block: AtomicBool,
    /// The quota of the client.
    quota: Quota,
    _charge: Option<Charge>,
}

/// A writer and the messages that a thread will write to it.
struct WriteQueue {
    writer: Arc<dyn RosWriter>,
    ahead: Mutex<PendingWrites>,
    /// Held while the queue is written, which keeps the order.
    turn: Mutex<()>,
    published: AtomicU64,
    quotas: Arc<Quotas>,
    /// The lengths of the messages that the writer keeps, until it ends.
    kept: Option<WriterHistory>,
}

#[derive(Default)]
struct PendingWrites {
    /// Source timestamps in nanoseconds since the Unix epoch, and payloads.
    messages: VecDeque<(i64, Bytes)>,
    bytes: usize,
}

impl WriteQueue {
    /// Writes one message, which is sent with the messages that follow or at the next flush.
    fn write(&self, stamp_ns: i64, payload: Bytes) -> Result<(), RosError> {
        match self.writer.write_ahead(SampleHead::new(SampleKind::Write, stamp_ns), payload) {
            // No subscriber is known while the network is closed, as after the start of a publisher.
            Err(RosError::Closed) => self.quotas.count_unwritten(),
            written => {
                written?;
                self.published.fetch_add(1, Ordering::Relaxed);
            }
        }
        Ok(())
    }

    /// Writes queued messages up to the first one that fails. May block.
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
        shared: &Arc<Network>,
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
                let kept = kept.map(|kept| WriterHistory::new(kept, kept_max(&spec)));
                let writer: Arc<dyn RosWriter> = Arc::from(shared.ros.writer(&spec)?);
                shared.know(own_endpoint(EndpointKind::Writer, writer.guid(), &spec));
                let (ahead, turn, published) = (Mutex::default(), Mutex::default(), AtomicU64::new(0));
                let quotas = Arc::clone(&shared.quotas);
                let line = Arc::new(WriteQueue { writer, ahead, turn, published, quotas, kept });
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

    /// Returns the topic.
    pub fn topic(&self) -> &str {
        &self.topic
    }

    /// Returns the ROS type.
    pub fn type_name(&self) -> &str {
        &self.type_name
    }

    /// Returns the layout of the messages.
    pub fn layout(&self) -> &Arc<Layout> {
        &self.layout
    }

    /// Publishes a message. Waits for readers if the QoS demands it.
    pub async fn publish(&self, content: &Content) -> Result<(), GatewayError> {
        self.publish_ahead(content).await?;
        self.flush().await
    }

    /// Publishes a message that may stay queued until [`Self::flush`], so that later messages share its packets and
    /// thread switches. If the writer waits for readers, an error may belong to an earlier message.
    pub async fn publish_ahead(&self, content: &Content) -> Result<(), GatewayError> {
        self.write_ahead(content.to_cdr(&self.layout)?).await
    }

    /// Publishes a value as [`Self::publish_ahead`] does a message.
    pub(crate) async fn publish_value_ahead(&self, value: &Value) -> Result<(), GatewayError> {
        self.write_ahead(serialise(&self.layout, value)?).await
    }

    /// Publishes a value. Waits for readers if the QoS demands it.
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

    /// Sends queued messages. An error means that one message is lost; the messages behind it stay queued for the
    /// next call.
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

    /// Returns `true` if messages are queued.
    pub fn has_ahead(&self) -> bool {
        !lock(&self.line.ahead).messages.is_empty()
    }

    /// Returns the number of published messages, without queued ones.
    pub fn published(&self) -> u64 {
        self.line.published.load(Ordering::Relaxed)
    }

    /// Returns the number of matched local readers.
    pub fn matched_readers(&self) -> u32 {
        self.line.writer.matched_readers()
    }

    /// Waits for this many matched readers, at most for `max`, and returns their number.
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

    /// Waits, at most for `max`, until the readers in the graph are matched. A new writer's messages are lost to
    /// readers that are not matched yet.
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
            // If many writers end at once, not all of them wait for acknowledgements.
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

/// Returns the number of messages that a transient-local writer keeps at most.
fn kept_max(spec: &EndpointSpec) -> usize {
    match &spec.qos.history {
        History::KeepLast(depth) if spec.keyless => *depth as usize,
        _ => KEYED_KEPT_MAX,
    }
}

/// Returns the longest message with which a write never blocks, or 0 if any write may block.
fn bytes_at_once_max(spec: &EndpointSpec) -> usize {
    match (spec.qos.is_reliable(), &spec.qos.history) {
        (false, _) => usize::MAX,
        // A keyed topic keeps `depth` messages of each instance.
        (true, History::KeepLast(depth)) if spec.keyless => {
            UNACKNOWLEDGED_BYTES_MIN / (*depth as usize).max(1)
        }
        (true, _) => 0,
    }
}
