//! [`ZenohWriter`]: a publisher of serialised samples.

use std::sync::atomic::{AtomicI64, Ordering::Relaxed};
use std::sync::{Arc, Mutex, Weak};
use std::time::Duration;

use bytes::Bytes;
use sgc_ros::{EndpointKind, EndpointSpec, Guid, RosError, RosWriter, SampleHead, SampleKind};
use sgc_sync::lock;
use sgc_wire::{History, Qos};
use sgc_zenoh::{Attachment, EndpointRef, EntityKind, Graph, TopicInfo};
use zenoh::Wait as _;
use zenoh::pubsub::Publisher;
use zenoh::qos::{CongestionControl, Reliability};
use zenoh_ext::{AdvancedPublisher, AdvancedPublisherBuilderExt as _, MissDetectionConfig};

use crate::check_length;
use crate::history::{Answers, Early, LateHistory};
use crate::late::{Late, Opened};
use crate::participant::{Entered, Participant};
use crate::reader::late_depth;

/// Period in which a publisher with history repeats the number of its last sample if that is new, as rmw_zenoh does.
const HEARTBEAT: Duration = Duration::from_millis(500);

/// A writer.
#[derive(Debug)]
pub struct ZenohWriter {
    at: EndpointRef,
    participant: Arc<Participant>,
    late: Arc<Late<OpenWriter>>,
    /// The samples for late joiners of a transient-local writer.
    history: Option<Arc<Mutex<LateHistory>>>,
    is_depth_unsaid: bool,
}

/// The parts of a writer on the network.
#[derive(Debug)]
struct OpenWriter {
    /// Ends first: others count this writer by its token.
    entered: Entered,
    publisher: Publishes,
    topic: TopicInfo,
    participant: Weak<Participant>,
    /// The number of the next sample, which the next publisher goes on with.
    next: Arc<AtomicI64>,
}

#[derive(Debug)]
enum Publishes {
    Volatile(Publisher<'static>),
    TransientLocal(Box<LatePublisher>),
}

/// A publisher whose samples late joiners get.
#[derive(Debug)]
struct LatePublisher {
    /// Has no cache of its own.
    publisher: AdvancedPublisher<'static>,
    history: Arc<Mutex<LateHistory>>,
    _answers: Answers,
    /// Held while samples get their numbers and are published, since the publisher counts as well.
    order: Mutex<()>,
}

impl ZenohWriter {
    pub(crate) fn new(participant: &Arc<Participant>, spec: &EndpointSpec) -> Result<Self, String> {
        let (key, at, qos) = (participant.topic_of(spec)?, participant.reserve(), spec.qos.clone());
        let history =
            qos.is_transient_local().then(|| Arc::new(Mutex::new(LateHistory::new(late_depth(&qos)))));
        let (kept, next) = (history.clone(), Arc::new(AtomicI64::new(1)));
        let late = Late::new(participant, key, move |participant, topic| {
            OpenWriter::new(participant, at, topic, &qos, kept.as_ref(), &next)
        })?;
        let is_depth_unsaid = spec.qos.history.is_unsaid();
        Ok(Self { at, participant: Arc::clone(participant), late, history, is_depth_unsaid })
    }

    fn readers(&self, graph: &Graph) -> u32 {
        let readers = |open: &OpenWriter| graph.matches(&open.topic, EntityKind::Subscription).count();
        self.late.look(readers).unwrap_or(0) as u32
    }
}

impl OpenWriter {
    fn new(
        participant: &Arc<Participant>,
        at: EndpointRef,
        topic: &TopicInfo,
        qos: &Qos,
        history: Option<&Arc<Mutex<LateHistory>>>,
        next: &Arc<AtomicI64>,
    ) -> Result<Self, String> {
        let (congestion, reliability) = congestion(qos);
        let publisher = participant
            .session()
            .declare_publisher(topic.key(participant.domain()))
            .allowed_destination(participant.locality())
            .congestion_control(congestion)
            .reliability(reliability);
        let refused = |error: zenoh::Error| error.to_string();
        let publisher = if let Some(history) = history {
            let numbered = qos.is_reliable();
            let advanced = publisher.publisher_detection();
            let advanced = if numbered {
                let detection = MissDetectionConfig::default().sporadic_heartbeat(HEARTBEAT);
                advanced.sample_miss_detection(detection)
            } else {
                advanced
            };
            let publisher = advanced.wait().map_err(refused)?;
            lock(history).restart();
            let answers = Answers::start(participant, topic, publisher.id(), numbered, history)?;
            Publishes::TransientLocal(Box::new(LatePublisher {
                publisher,
                history: Arc::clone(history),
                _answers: answers,
                order: Mutex::new(()),
            }))
        } else {
            Publishes::Volatile(publisher.wait().map_err(refused)?)
        };
        let entered = participant.enter(at, EntityKind::Publisher, topic, qos, None)?;
        let (topic, participant, next) = (topic.clone(), Arc::downgrade(participant), Arc::clone(next));
        Ok(Self { entered, publisher, topic, participant, next })
    }

    fn attachment(&self, source_timestamp_ns: i64) -> Attachment {
        let sequence = self.next.fetch_add(1, Relaxed);
        Attachment { sequence, source_timestamp_ns, gid: self.entered.gid() }
    }

    /// Publishes the samples that waited, and then another one.
    fn publish_kept(&self, late: &LatePublisher, last: Option<Early>) -> zenoh::Result<()> {
        let Some(participant) = self.participant.upgrade() else { return Ok(()) };
        let _order = lock(&late.order);
        let early = || lock(&late.history).take_early();
        for sample in std::iter::from_fn(early).chain(last) {
            let attachment = self.attachment(sample.source_timestamp_ns);
            let timestamp = participant.session().new_timestamp();
            lock(&late.history).push(sample.payload.clone(), attachment, timestamp);
            let put = late.publisher.put(sample.payload).attachment(attachment.encode());
            put.timestamp(timestamp).wait()?;
        }
        Ok(())
    }
}

impl Opened for OpenWriter {
    fn settle(&self) {
        if let Publishes::TransientLocal(late) = &self.publisher
            && let Err(error) = self.publish_kept(late, None)
        {
            tracing::debug!(%error, "samples that waited for their key are not published");
        }
    }
}

impl RosWriter for ZenohWriter {
    fn write_ahead(&self, head: SampleHead, payload: Bytes) -> Result<(), RosError> {
        check_length(payload.len())?;
        // There are no instances on Zenoh that could end.
        if head.kind != SampleKind::Write {
            return Ok(());
        }
        let sample = Early { payload, source_timestamp_ns: head.source_timestamp_ns };
        // Nobody hears a writer whose type no program of the network has, but a late joiner may.
        let keep = || self.history.iter().for_each(|history| lock(history).push_early(sample.clone()));
        let Some(open) = self.late.get_or(keep) else { return Ok(()) };
        let written = match &open.publisher {
            Publishes::Volatile(publisher) => {
                let attachment = open.attachment(sample.source_timestamp_ns);
                publisher.put(sample.payload).attachment(attachment.encode()).wait()
            }
            Publishes::TransientLocal(late) => open.publish_kept(late, Some(sample)),
        };
        written.map_err(|error| RosError::Write { reason: error.to_string() })
    }

    fn set_late_depth(&self, depth: u32) {
        if let Some(history) = self.history.as_ref().filter(|_| self.is_depth_unsaid) {
            lock(history).reduce_depth(usize::try_from(depth).unwrap_or(usize::MAX));
        }
    }

    fn matched_readers(&self) -> u32 {
        self.readers(&self.participant.graph().graph)
    }

    fn wait_matched(&self, readers: u32, max: Duration) -> u32 {
        self.participant.wait(max, |graph| {
            let now = self.readers(graph);
            (now >= readers, now)
        })
    }

    fn guid(&self) -> Guid {
        self.at.guid(EndpointKind::Writer)
    }
}

/// Returns what happens to a sample for which there is no room, as in rmw_zenoh: only `KEEP_ALL` waits.
fn congestion(qos: &Qos) -> (CongestionControl, Reliability) {
    match (qos.is_reliable(), qos.history) {
        (true, History::KeepAll) => (CongestionControl::Block, Reliability::Reliable),
        (true, _) => (CongestionControl::Drop, Reliability::Reliable),
        (false, _) => (CongestionControl::Drop, Reliability::BestEffort),
    }
}
