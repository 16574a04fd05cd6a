//! [`Publication`]: what one client publishes on a topic.

use std::fmt;
use std::sync::Arc;
use std::time::Duration;

use bytes::Bytes;
use sgc_cdr::{Layout, Value};
use sgc_ros::{EndpointKind, EndpointSpec, RosWriter, SampleKind, dds_topic, dds_type};
use sgc_wire::{History, Qos};
use tokio::time::Instant;

use crate::content::{Content, serialise};
use crate::error::GatewayError;
use crate::feed::own_endpoint;
use crate::hub::Shared;

/// How long readers may take to acknowledge what was written last before its writer ends.
const FAREWELL_MAX: Duration = Duration::from_secs(1);
/// How often it is looked whether readers are matched: a writer cannot be asked to tell.
const MATCH_LOOK: Duration = Duration::from_millis(5);
/// Longest payload that the local network takes, bytes (`sgc-dds` refuses more).
pub(crate) const PAYLOAD_BYTES_MAX: usize = 256 << 20;

/// What one client publishes on a topic; ends when dropped, once reliable readers have what was written.
pub struct Publication {
    shared: Arc<Shared>,
    writer: Arc<dyn RosWriter>,
    layout: Arc<Layout>,
    topic: String,
    type_name: String,
    /// Whether a write may wait for readers.
    may_block: bool,
}

impl Publication {
    pub(crate) async fn new(
        shared: &Arc<Shared>,
        topic: String,
        type_name: String,
        qos: Qos,
    ) -> Result<Self, GatewayError> {
        let may_block = qos.history == History::KeepAll && qos.is_reliable();
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
                    type_hash: Some(hash.map_or_else(|| layout.type_hash(), str::to_owned)),
                    qos,
                };
                let writer: Arc<dyn RosWriter> = Arc::from(shared.ros.writer(&spec)?);
                shared.know(own_endpoint(EndpointKind::Writer, writer.guid(), &spec));
                Ok(Self { shared: Arc::clone(shared), writer, layout, topic, type_name, may_block })
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
        let payload = content.to_cdr(&self.layout)?;
        if payload.len() > PAYLOAD_BYTES_MAX {
            return Err(GatewayError::TooLong { bytes: payload.len(), max: PAYLOAD_BYTES_MAX });
        }
        self.write(payload).await
    }

    /// The same with a value.
    pub(crate) async fn publish_value(&self, value: &Value) -> Result<(), GatewayError> {
        self.write(serialise(&self.layout, value)?).await
    }

    async fn write(&self, payload: Bytes) -> Result<(), GatewayError> {
        let since = std::time::SystemTime::now().duration_since(std::time::UNIX_EPOCH);
        let stamp = since.map_or(0, |since| since.as_nanos().try_into().unwrap_or(i64::MAX));
        if !self.may_block {
            return Ok(self.writer.write(SampleKind::Write, stamp, payload)?);
        }
        let _place = self.shared.waits.acquire().await.map_err(|_| GatewayError::Stopping)?;
        let writer = Arc::clone(&self.writer);
        self.shared.blocking(move |_| writer.write(SampleKind::Write, stamp, payload)).await
    }

    /// How many local readers hear it at present.
    pub fn matched_readers(&self) -> u32 {
        self.writer.matched_readers()
    }

    /// Waits until so many readers hear it, or for so long; says how many do.
    pub async fn wait_for_readers(&self, readers: u32, max: Duration) -> u32 {
        let until = Instant::now() + max;
        loop {
            let matched = self.matched_readers();
            if matched >= readers || Instant::now() >= until {
                return matched;
            }
            tokio::time::sleep(MATCH_LOOK).await;
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
        let (shared, writer) = (Arc::clone(&self.shared), Arc::clone(&self.writer));
        let place = Arc::clone(&shared.farewells).try_acquire_owned();
        self.shared.runtime.spawn_blocking(move || {
            // Where many end at once, not all can be waited for.
            if place.is_ok() {
                writer.wait_acknowledged(FAREWELL_MAX);
            }
            shared.forget(&[writer.guid()]);
            drop(writer);
        });
    }
}
