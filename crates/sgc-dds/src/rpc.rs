//! [`RpcReader`], [`RpcWriter`]: endpoints of a service, whose messages may say in their inline QoS to which request they
//! belong ([`crate::identified`]). What they say elsewhere, and which of both a client or server expects, is for
//! [`crate::service`] to know.

use std::mem::MaybeUninit;
use std::sync::{Arc, Mutex, PoisonError};
use std::thread;
use std::time::{Instant, SystemTime, UNIX_EPOCH};

use bytes::Bytes;
use cyclors::{
    DDS_ANY_STATE, DDS_RETCODE_TIMEOUT, dds_create_reader, dds_create_writer, dds_entity_t, dds_forwardcdr,
    dds_get_entity_sertype, dds_sample_info_t, dds_takecdr, ddsi_serdata,
};
use sgc_ros::{EndpointKind, EndpointSpec, Guid, RosError};

use crate::entity::{Entity, check, reason};
use crate::identified::{self, IdentifiedSample, Origin};
use crate::identity::{Mapping, SampleIdentity};
use crate::known_writers::KnownWriters;
use crate::network::Participant;
use crate::payload::{Frame, HEADER_BYTES};
use crate::wait::{Stop, WaitSet, join};

/// Messages taken at once.
const BATCH: usize = 16;

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
pub(crate) type MessageHandler = Box<dyn FnMut(Message) + Send>;

/// A reader of requests or replies; dropping it ends its thread, waits for a handler that is at work, and deletes the
/// entities. What SGC wrote, this process or another, does not reach the handler.
#[derive(Debug)]
pub(crate) struct RpcReader {
    guid: Guid,
    /// Of the reader, which lives as long as the thread does.
    handle: dds_entity_t,
    stop: Arc<Stop>,
    thread: Option<thread::JoinHandle<()>>,
}

impl RpcReader {
    /// `more` elements are added to USER_DATA. Messages come once `start` is called.
    pub(crate) fn new(
        participant: &Arc<Participant>,
        spec: &EndpointSpec,
        more: &str,
    ) -> Result<(Self, Service), String> {
        let qos = participant.endpoint_qos(EndpointKind::Reader, spec, more)?;
        let topic = identified::topic(participant, spec)?;
        let group = participant.group(EndpointKind::Reader, spec)?;
        let parent = group.as_ref().unwrap_or(participant.entity()).handle();
        // SAFETY: the QoS object outlives the call, which copies it; null means no listener.
        let reader = Entity::new(unsafe {
            dds_create_reader(parent, topic.handle(), qos.as_ptr(), std::ptr::null())
        })?;
        let (guid, handle) = (reader.guid()?, reader.handle());
        let condition = reader.read_condition()?;
        let stop = Stop::new(participant)?;
        let wait_set = WaitSet::new(participant, Arc::clone(&stop), &[&condition])?;
        let service = Service {
            wait_set,
            _condition: condition,
            reader,
            _group: group,
            _topic: topic,
            stop: Arc::clone(&stop),
            participant: Arc::clone(participant),
            writers: KnownWriters::default(),
        };
        Ok((Self { guid, handle, stop, thread: None }, service))
    }

    /// Hands messages over from now on.
    pub(crate) fn start(&mut self, mut service: Service, mut handler: MessageHandler) -> Result<(), String> {
        let thread = thread::Builder::new()
            .name("sgc-dds-rpc".into())
            .spawn(move || service.run(&mut handler))
            .map_err(|e| e.to_string())?;
        self.thread = Some(thread);
        Ok(())
    }

    /// GUID of the reader, as others discover it.
    pub(crate) fn guid(&self) -> Guid {
        self.guid
    }

    /// The reader's handle, for calls into Cyclone while `self` lives.
    pub(crate) fn handle(&self) -> dds_entity_t {
        self.handle
    }
}

impl Drop for RpcReader {
    fn drop(&mut self) {
        self.stop.request();
        if let Some(thread) = self.thread.take() {
            join(thread);
        }
    }
}

/// What the thread owns. Fields drop in this order: children first.
pub(crate) struct Service {
    wait_set: WaitSet,
    _condition: Entity,
    reader: Entity,
    _group: Option<Entity>,
    _topic: Entity,
    stop: Arc<Stop>,
    participant: Arc<Participant>,
    writers: KnownWriters,
}

impl Service {
    fn run(&mut self, handler: &mut MessageHandler) {
        while self.wait_set.wait() {
            loop {
                let batch = self.take().unwrap_or_else(|reason| {
                    tracing::error!(reason, "taking the messages of a service failed");
                    Vec::new()
                });
                if batch.is_empty() {
                    break;
                }
                for (sample, info) in batch {
                    if self.stop.is_requested() {
                        return;
                    }
                    if let Some(message) = self.message(&sample, &info) {
                        handler(message);
                    }
                }
            }
        }
    }

    fn take(&self) -> Result<Vec<(IdentifiedSample, dds_sample_info_t)>, String> {
        let mut samples: [*mut ddsi_serdata; BATCH] = [std::ptr::null_mut(); BATCH];
        let mut infos: [MaybeUninit<dds_sample_info_t>; BATCH] = [const { MaybeUninit::uninit() }; BATCH];
        // SAFETY: both arrays have room for a batch; the samples' references become ours.
        let taken = unsafe {
            dds_takecdr(
                self.reader.handle(),
                samples.as_mut_ptr(),
                BATCH as u32,
                infos.as_mut_ptr().cast(),
                DDS_ANY_STATE,
            )
        };
        check(taken)?;
        let both = samples.into_iter().zip(infos).take(taken as usize);
        // SAFETY: Cyclone filled the first `taken` of both arrays and gave us a reference to each sample, whose type
        // is that of this reader's topic.
        Ok(both.map(|(s, info)| unsafe { (IdentifiedSample::from_raw(s), info.assume_init()) }).collect())
    }

    /// What the handler gets of what was taken, if anything.
    fn message(&mut self, sample: &IdentifiedSample, info: &dds_sample_info_t) -> Option<Message> {
        // Changes of instance state: Cyclone makes them up without a payload.
        if !info.valid_data {
            return None;
        }
        let writer = self.writers.find(&self.reader, info.publication_handle)?;
        // Another proxy's client or server: what it has to say comes through SGC.
        if writer.tagged && self.participant.ignores_tagged() {
            return None;
        }
        let (origin, payload) = sample.read();
        let Some(origin) = origin.filter(|_| payload.len() >= HEADER_BYTES) else {
            tracing::debug!(bytes = payload.len(), "a message of a service without its headers is dropped");
            return None;
        };
        Some(Message { writer: writer.guid, origin, payload })
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
        let topic = identified::topic(participant, spec)?;
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
        // SAFETY: the sertype of this writer, which `identified::topic` made.
        let sample = unsafe { IdentifiedSample::build(sertype, &frame, related, now_ns) };
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
