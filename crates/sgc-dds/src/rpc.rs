//! [`RpcReader`], [`RpcWriter`]: endpoints of a service, whose messages may name their request in the inline QoS
//! ([`crate::sample`]). [`crate::service`] knows the other mapping, and which one a client or server expects.

use std::fmt;
use std::sync::{Arc, Mutex};
use std::time::{Instant, SystemTime, UNIX_EPOCH};

use bytes::Bytes;
use cyclors::{
    DDS_RETCODE_TIMEOUT, dds_create_writer, dds_entity_t, dds_forwardcdr, dds_get_entity_sertype,
    ddsi_serdata,
};
use sgc_ros::{EndpointKind, EndpointSpec, Guid, RosError};
use sgc_sync::lock;

use crate::arrivals::{Arrival, FromSerdata};
use crate::entity::{Entity, check, reason};
use crate::identity::{Mapping, SampleIdentity};
use crate::intake::{Intake, Receiver};
use crate::known_writers::KnownWriters;
use crate::participant::Participant;
use crate::payload::{Frame, HEADER_BYTES};
use crate::sample::{Extra, Origin, SampleRef};

/// A message of a service, as it comes from the network.
pub(crate) struct Message {
    /// The writer of the message.
    pub(crate) writer: Guid,
    /// The origin of the message, from its packet.
    pub(crate) origin: Origin,
    /// Encapsulation header and body. An id precedes the body if the mapping puts it there.
    pub(crate) payload: Bytes,
}

impl Message {
    /// Returns the mapping of the message. Cyclone's participants are recognised by the header of their packets, too,
    /// because older ones do not begin their GUIDs with the vendor.
    pub(crate) fn mapping(&self) -> Mapping {
        match Mapping::for_vendor(self.origin.vendor) {
            Mapping::InlineQos => Mapping::for_vendor(self.writer.vendor()),
            body => body,
        }
    }
}

/// A handler of messages, which may block.
pub(crate) trait HandleMessages: Send + 'static {
    /// Handles a message. May block.
    fn handle(&mut self, message: Message);

    /// Reports messages that gave way to newer ones.
    fn overrun(&mut self, messages: u64);
}

/// A reader of requests or replies. Dropping it waits for a handler at work, and deletes the entities. Messages written
/// by SGC, in this process or another, do not reach the handler.
pub(crate) struct RpcReader<H: HandleMessages> {
    intake: Intake<Messages<H>>,
    ignores_tagged: bool,
}

impl<H: HandleMessages> RpcReader<H> {
    /// Creates the reader, which receives once it is started. `more` elements are added to USER_DATA.
    pub(crate) fn new(
        participant: &Arc<Participant>,
        spec: &EndpointSpec,
        more: &str,
    ) -> Result<Self, String> {
        let intake = Intake::new(participant, spec, participant.topic(spec)?, more)?;
        Ok(Self { intake, ignores_tagged: participant.ignores_tagged() })
    }

    /// Starts to hand messages over.
    pub(crate) fn start(&mut self, handler: H) -> Result<(), String> {
        let (ignores_tagged, writers) = (self.ignores_tagged, KnownWriters::default());
        self.intake.start(Messages { ignores_tagged, writers, handler })
    }

    /// Returns the GUID of the reader, as others discover it.
    pub(crate) fn guid(&self) -> Guid {
        self.intake.guid()
    }

    /// Returns the reader's handle, for calls into Cyclone while `self` lives.
    pub(crate) fn handle(&self) -> dds_entity_t {
        self.intake.handle()
    }
}

impl<H: HandleMessages> fmt::Debug for RpcReader<H> {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_struct("RpcReader").field("guid", &self.guid()).finish_non_exhaustive()
    }
}

/// The content of a message and its origin.
struct Content {
    origin: Origin,
    payload: Bytes,
}

impl FromSerdata for Content {
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

/// The receiver that passes messages to the handler.
struct Messages<H> {
    ignores_tagged: bool,
    writers: KnownWriters,
    handler: H,
}

impl<H: HandleMessages> Receiver for Messages<H> {
    type Sample = Content;

    fn receive(&mut self, reader: dds_entity_t, arrival: Arrival<Content>) {
        let Some(writer) = self.writers.find(reader, arrival.writer) else { return };
        // Messages of another proxy's client or server come through SGC.
        if !(writer.tagged && self.ignores_tagged) {
            let Content { origin, payload } = arrival.sample;
            self.handler.handle(Message { writer: writer.guid, origin, payload });
        }
    }

    fn overrun(&mut self, samples: u64) {
        self.handler.overrun(samples);
    }
}

/// A writer of requests or replies. Calls may block, like those of [`crate::CycloneWriter`]. Fields drop in this
/// order: children first.
#[derive(Debug)]
pub(crate) struct RpcWriter {
    writer: Entity,
    _group: Option<Entity>,
    _topic: Entity,
    _participant: Arc<Participant>,
    /// The sequence number of the last message.
    written: Mutex<i64>,
}

impl RpcWriter {
    /// Creates the writer. `more` elements are added to USER_DATA.
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

    /// Returns the writer's entity, for calls into Cyclone while `self` lives.
    pub(crate) fn entity(&self) -> &Entity {
        &self.writer
    }

    /// Writes the frame that `make` returns for the message's sequence number, with an identity for its inline QoS.
    /// Returns that number.
    pub(crate) fn write<'a>(
        &self,
        related: Option<SampleIdentity>,
        make: impl FnOnce(i64) -> Result<Frame<'a>, RosError>,
    ) -> Result<i64, RosError> {
        let failed = |reason: String| RosError::Write { reason };
        // The lock is held while writing, so that the numbers agree with Cyclone's: consecutive from 1, without one
        // for a failed write.
        let mut written = lock(&self.written);
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
