//! [`ZenohReader`]: a subscriber that passes serialised samples to a handler.

use std::sync::Arc;
use std::time::Duration;

use bytes::Bytes;
use sgc_ros::{
    EndpointKind, EndpointSpec, Guid, RELIABLE_READER_DEPTH_MIN, Sample, SampleHandler, SampleKind,
};
use sgc_wire::{History, Qos};
use sgc_zenoh::{BACKENDS_CPU, EndpointRef, EntityKind, TopicInfo, ZenohId};
use zenoh::Wait as _;
use zenoh::pubsub::Subscriber;
use zenoh_ext::{AdvancedSubscriber, AdvancedSubscriberBuilderExt as _, HistoryConfig, RecoveryConfig};

use crate::check_length;
use crate::history::LATE_MAX;
use crate::intake::{Intake, Item, Receive, Shared};
use crate::late::{Late, Opened};
use crate::participant::{Entered, Origin, Participant, Refusal};

/// Shortest queue of a reliable reader that asks for [`RELIABLE_READER_DEPTH_MIN`] or more, as with DDS.
const RELIABLE_WAITING_MIN: usize = 16_384;
/// Longest queue of samples.
const WAITING_MAX: usize = 65_536;
/// How long `AdvancedSubscriber` keeps what it knows of a publisher that is silent.
const SILENT_MAX: Duration = Duration::from_secs(60);
/// The key below that of a topic on which publishers of Lyrical send buffers in ordinary memory.
const BUFFERS: &str = "_buf_cpu";

/// A reader. Dropping it ends the subscription and waits for a handler at work.
#[derive(Debug)]
pub struct ZenohReader {
    at: EndpointRef,
    _open: Arc<Late<OpenReader>>,
    _intake: Intake<Sample, Samples>,
}

/// The parts of a reader on the network.
#[derive(Debug)]
struct OpenReader {
    /// Ends first: others count this reader by its token.
    _entered: Entered,
    _subscribers: Subscribers,
}

impl Opened for OpenReader {}

/// The subscriptions of a reader.
#[derive(Debug)]
enum Subscribers {
    Volatile { _plain: Subscriber<()>, _buffers: Subscriber<()> },
    TransientLocal { _subscriber: Box<AdvancedSubscriber<()>> },
}

impl Item for Sample {
    fn bytes(&self) -> usize {
        self.payload.len()
    }
}

/// The receiver that passes samples to the handler.
struct Samples(SampleHandler);

impl Receive<Sample> for Samples {
    fn receive(&mut self, sample: Sample, more: bool) {
        self.0.handle(Sample { more, ..sample });
    }

    fn receive_at_once(&mut self, sample: Sample) -> Option<Sample> {
        self.0.handle_at_once(sample)
    }

    fn overrun(&mut self, samples: u64) {
        self.0.overrun(samples);
    }
}

impl ZenohReader {
    pub(crate) fn new(
        participant: &Arc<Participant>,
        spec: &EndpointSpec,
        handler: SampleHandler,
    ) -> Result<Self, String> {
        let key = participant.topic_of(spec)?;
        let (workers, pace) = (participant.workers(), participant.pace());
        let intake = Intake::new(workers, pace, waiting_max(&spec.qos), Samples(handler));
        let (at, qos, shared) = (participant.reserve(), spec.qos.clone(), intake.shared());
        let open = Late::new(participant, key, move |participant, topic| {
            OpenReader::new(participant, at, topic, &qos, &shared)
        })?;
        Ok(Self { at, _open: open, _intake: intake })
    }

    /// Returns the GUID of the reader, as others discover it.
    pub fn guid(&self) -> Guid {
        self.at.guid(EndpointKind::Reader)
    }
}

impl OpenReader {
    fn new(
        participant: &Arc<Participant>,
        at: EndpointRef,
        topic: &TopicInfo,
        qos: &Qos,
        shared: &Arc<Shared<Sample, Samples>>,
    ) -> Result<Self, String> {
        let key = topic.key(participant.domain());
        let callback = || {
            let (participant, topic, shared) =
                (Arc::downgrade(participant), topic.clone(), Arc::clone(shared));
            move |sample: zenoh::sample::Sample| {
                if let Some(participant) = participant.upgrade() {
                    take(&participant, &topic, &shared, &sample);
                }
            }
        };
        let session = participant.session();
        let subscribe = |key: String| {
            session.declare_subscriber(key).allowed_origin(participant.locality()).callback(callback())
        };
        let refused = |error: zenoh::Error| error.to_string();
        let is_late = qos.is_transient_local();
        let subscribers = if is_late {
            let history = HistoryConfig::default().detect_late_publishers().max_samples(late_depth(qos));
            let subscriber = subscribe(key).history(history);
            let subscriber = if qos.is_reliable() {
                subscriber.recovery(RecoveryConfig::default().heartbeat().retention_period(SILENT_MAX)).wait()
            } else {
                subscriber.wait()
            };
            Subscribers::TransientLocal { _subscriber: Box::new(subscriber.map_err(refused)?) }
        } else {
            let buffers = subscribe(format!("{key}/{BUFFERS}")).wait().map_err(refused)?;
            Subscribers::Volatile { _plain: subscribe(key).wait().map_err(refused)?, _buffers: buffers }
        };
        let backends = (!is_late).then_some(BACKENDS_CPU);
        let entered = participant.enter(at, EntityKind::Subscription, topic, qos, backends)?;
        Ok(Self { _entered: entered, _subscribers: subscribers })
    }
}

/// Takes a sample of Zenoh.
fn take(
    participant: &Participant,
    topic: &TopicInfo,
    shared: &Shared<Sample, Samples>,
    sample: &zenoh::sample::Sample,
) {
    // rmw_zenoh deletes nothing.
    if sample.kind() != zenoh::sample::SampleKind::Put {
        return;
    }
    let Some(attachment) = participant.attachment(sample.attachment()) else { return };
    let stamped_by = sample.timestamp().and_then(|time| ZenohId::from_le_bytes(time.get_id().to_le_bytes()));
    let Origin::Program(writer) = participant.origin(topic, &attachment.gid, stamped_by) else { return };
    let Some(payload) = participant.payload(sample.payload()) else { return };
    shared.arrive(Sample {
        kind: SampleKind::Write,
        writer: writer.map(|at| at.guid(EndpointKind::Writer)),
        source_timestamp_ns: attachment.source_timestamp_ns,
        key_hash: None,
        payload,
        more: false,
    });
}

impl Participant {
    /// Returns a payload in one piece. One that is shorter than its header or too long is refused, and counted.
    pub(crate) fn payload(&self, bytes: &zenoh::bytes::ZBytes) -> Option<Bytes> {
        if check_length(bytes.len()).is_err() {
            self.refuse(Refusal::Payload(bytes.len()));
            return None;
        }
        Some(Bytes::from(bytes.to_bytes().into_owned()))
    }
}

/// Returns the number of samples that may wait for the handler.
fn waiting_max(qos: &Qos) -> usize {
    match qos.history {
        History::KeepAll => WAITING_MAX,
        History::KeepLast(depth) => {
            let depth = usize::try_from(depth).unwrap_or(WAITING_MAX).min(WAITING_MAX);
            let is_deep = qos.is_reliable() && depth >= RELIABLE_READER_DEPTH_MIN as usize;
            if is_deep { depth.max(RELIABLE_WAITING_MIN) } else { depth }
        }
    }
}

/// Returns the number of samples that late joiners get. If it is not known, they get all that are kept.
pub(crate) fn late_depth(qos: &Qos) -> usize {
    match qos.history {
        History::KeepAll => LATE_MAX,
        History::KeepLast(depth) => usize::try_from(depth).unwrap_or(LATE_MAX).clamp(1, LATE_MAX),
    }
}
