//! [`RpcReader`], [`RpcWriter`]: endpoints of a service, whose messages may say in their inline QoS to which request they
//! belong ([`crate::sample`]). What they say elsewhere, and which of both a client or server expects, is for
//! [`crate::service`] to know.

use std::fmt;
use std::sync::{Arc, Mutex, PoisonError};
use std::time::{Instant, SystemTime, UNIX_EPOCH};

use bytes::Bytes;
use cyclors::{
    DDS_RETCODE_TIMEOUT, dds_create_writer, dds_entity_t, dds_forwardcdr, dds_get_entity_sertype,
    ddsi_serdata,
};
use sgc_ros::{EndpointKind, EndpointSpec, Guid, RosError};

use crate::entity::{Entity, check, reason};
use crate::identity::{Mapping, SampleIdentity};
use crate::intake::{Arrival, Intake, Receiver, Taken};
use crate::known_writers::KnownWriters;
use crate::network::Participant;
use crate::payload::{Frame, HEADER_BYTES};
use crate::sample::{Extra, Origin, SampleRef};

/// A message of a service, as it comes from the network.
pub(crate) struct Message {
    /// Who wrote it.
    pub(crate) writer: Guid,
    /// What its packet says.
    pub(crate) origin: Origin,
    /// Encapsulation header and body; in front of the body an id, if the mapping puts it there.
    pub(crate) payload: Bytes,
}

impl Message {
    /// Where it says to which request it belongs. Cyclone's participants are known by the header of their
    /// packets as well: older ones do not begin their GUIDs with the vendor.
    pub(crate) fn mapping(&self) -> Mapping {
        match Mapping::of(self.origin.vendor) {
            Mapping::InlineQos => Mapping::of(self.writer.vendor()),
            body => body,
        }
    }
}

/// Receives messages, on a thread of its reader alone.
pub(crate) trait HandleMessages: Send + 'static {
    /// Receives a message; may wait.
    fn handle(&mut self, message: Message);

    /// So many messages gave way to newer ones.
    fn overrun(&mut self, messages: u64);
}

/// A reader of requests or replies; dropping it ends its thread, waits for a handler that is at work, and deletes the
/// entities. What SGC wrote, this process or another, does not reach the handler.
pub(crate) struct RpcReader<H: HandleMessages> {
    intake: Intake<Messages<H>>,
    ignores_tagged: bool,
}

impl<H: HandleMessages> RpcReader<H> {
    /// `more` elements are added to USER_DATA. Messages come once `start` is called.
    pub(crate) fn new(
        participant: &Arc<Participant>,
        spec: &EndpointSpec,
        more: &str,
    ) -> Result<Self, String> {
        let intake = Intake::new(participant, spec, participant.topic(spec)?, more)?;
        Ok(Self { intake, ignores_tagged: participant.ignores_tagged() })
    }

    /// Hands messages over from now on.
    pub(crate) fn start(&mut self, handler: H) -> Result<(), String> {
        let (ignores_tagged, writers) = (self.ignores_tagged, KnownWriters::default());
        self.intake.start("sgc-dds-rpc", Messages { ignores_tagged, writers, handler })
    }

    /// GUID of the reader, as others discover it.
    pub(crate) fn guid(&self) -> Guid {
        self.intake.guid()
    }

    /// The reader's handle, for calls into Cyclone while `self` lives.
    pub(crate) fn handle(&self) -> dds_entity_t {
        self.intake.handle()
    }
}

impl<H: HandleMessages> fmt::Debug for RpcReader<H> {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_struct("RpcReader").field("guid", &self.guid()).finish_non_exhaustive()
    }
}

/// What a message says, and its packet of it.
struct Content {
    origin: Origin,
    payload: Bytes,
}

impl Taken for Content {
    unsafe fn from_raw(sample: *mut ddsi_serdata) -> Option<Self> {
        // SAFETY: a reference to a sample of this crate's type, by contract and by the topic of this module's readers.
        let sample = unsafe { SampleRef::from_raw(sample) };
        let (origin, payload) = (sample.origin(), sample.into_payload());
        let Some(origin) = origin.filter(|_| payload.len() >= HEADER_BYTES) else {
            tracing::debug!(bytes = payload.len(), "a message of a service without its headers is dropped");
            return None;
        };
        Some(Self { origin, payload })
    }

    fn bytes(&self) -> usize {
        self.payload.len()
    }
}

/// Hands messages to the handler.
struct Messages<H> {
    ignores_tagged: bool,
    writers: KnownWriters,
    handler: H,
}

impl<H: HandleMessages> Receiver for Messages<H> {
    type Sample = Content;

    fn receive(&mut self, reader: dds_entity_t, arrival: Arrival<Content>) {
        let Some(writer) = self.writers.find(reader, arrival.writer) else { return };
        // Another proxy's client or server: what it has to say comes through SGC.
        if !(writer.tagged && self.ignores_tagged) {
            let Content { origin, payload } = arrival.sample;
            self.handler.handle(Message { writer: writer.guid, origin, payload });
        }
    }

    fn overrun(&mut self, samples: u64) {
        self.handler.overrun(samples);
    }
}

/// A writer of requests or replies. Calls may block, like those of [`crate::CycloneWriter`]. Fields drop in this order:
/// children first.
#[derive(Debug)]
pub(crate) struct RpcWriter {
    writer: Entity,
    _group: Option<Entity>,
    _topic: Entity,
    _participant: Arc<Participant>,
    /// Sequence number of the last message.
    written: Mutex<i64>,
}

impl RpcWriter {
    /// `more` elements are added to USER_DATA.
    pub(crate) fn new(
        participant: &Arc<Participant>,
        spec: &EndpointSpec,
        more: &str,
    ) -> Result<Self, String> {
        let qos = participant.endpoint_qos(EndpointKind::Writer, spec, more)?;
        let topic = participant.topic(spec)?;
        let group = participant.group(EndpointKind::Writer, spec)?;
        let parent = group.as_ref().unwrap_or(participant.entity()).handle();
        // SAFETY: the QoS object outlives the call, which copies it; null means no listener.
        let writer = Entity::new(unsafe {
            dds_create_writer(parent, topic.handle(), qos.as_ptr(), std::ptr::null())
        })?;
        let (topic, participant, written) = (topic, Arc::clone(participant), Mutex::new(0));
        Ok(Self { writer, _group: group, _topic: topic, _participant: participant, written })
    }

    /// The writer itself, for calls into Cyclone while `self` lives.
    pub(crate) fn entity(&self) -> &Entity {
        &self.writer
    }

    /// Writes what `make` returns for the sequence number that the message gets, with the identity to put into its inline
    /// QoS. Returns that number.
    pub(crate) fn write<'a>(
        &self,
        related: Option<SampleIdentity>,
        make: impl FnOnce(i64) -> Result<Frame<'a>, RosError>,
    ) -> Result<i64, RosError> {
        let failed = |reason: String| RosError::Write { reason };
        // Held while writing, so that numbers are known as Cyclone gives them: from 1, one by one, none for a write that
        // fails.
        let mut written = self.written.lock().unwrap_or_else(PoisonError::into_inner);
        let number = *written + 1;
        let frame = make(number)?;
        let mut sertype = std::ptr::null();
        // SAFETY: the handle is checked by Cyclone, and `sertype` is a valid place for the result.
        check(unsafe { dds_get_entity_sertype(self.writer.handle(), &mut sertype) }).map_err(failed)?;
        let unix = SystemTime::now().duration_since(UNIX_EPOCH).unwrap_or_default();
        let now_ns = unix.as_nanos().try_into().unwrap_or(0);
        let extra = Extra { related, ..Extra::default() };
        // SAFETY: the sertype of this writer, whose topic was made with it.
        let sample = unsafe { SampleRef::build_framed(sertype, &frame, extra, now_ns) };
        let mut sample = sample.ok_or_else(|| failed("out of memory".into()))?;
        sample.set_number(number);
        let started = Instant::now();
        // SAFETY: the sample is valid and of the writer's type; the call consumes the reference.
        match unsafe { dds_forwardcdr(self.writer.handle(), sample.into_raw()) } {
            DDS_RETCODE_TIMEOUT => {
                Err(RosError::WriteTimeout { waited_ms: started.elapsed().as_millis() as u64 })
            }
            ret if ret < 0 => Err(failed(reason(ret))),
            _ => {
                *written = number;
                Ok(number)
            }
        }
    }
}
