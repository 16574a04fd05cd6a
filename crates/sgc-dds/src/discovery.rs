//! Discovery of the local network's endpoints: a thread that reads DCPSPublication, DCPSSubscription and
//! DCPSParticipant.
//!
//! It reports each endpoint once when it appears and once when it is gone. An endpoint whose offer changes is
//! reported as gone and new. Endpoints of this participant are never reported, those of other SGC nodes only to a
//! network without a tag.

use std::collections::HashMap;
use std::ffi::{CStr, c_char, c_void};
use std::mem::MaybeUninit;
use std::sync::{Arc, Mutex};
use std::thread;

use cyclors::{
    DDS_BUILTIN_TOPIC_DCPSPARTICIPANT, DDS_BUILTIN_TOPIC_DCPSPUBLICATION, DDS_BUILTIN_TOPIC_DCPSSUBSCRIPTION,
    dds_builtintopic_endpoint_t, dds_builtintopic_participant_t, dds_create_reader, dds_entity_t,
    dds_instance_state_DDS_IST_ALIVE, dds_return_loan, dds_sample_info_t, dds_take,
};
use sgc_ros::{DiscoveredEndpoint, DiscoveryEvent, DiscoveryHandler, EndpointKind, Guid};
use sgc_sync::lock;

use crate::entity::{Entity, check};
use crate::graph::{Announcer, Listener};
use crate::participant::{Participant, SharedHandler};
use crate::reader::CycloneReader;
use crate::wait::{Stop, WaitSet, join};
use crate::{qos, strangers, user_data};

/// Samples taken at once.
const BATCH: usize = 32;

/// Most endpoints that are reported and not yet gone. Further ones are ignored.
const ENDPOINTS_MAX: usize = 65_536;

/// Longest topic or type name, in bytes (ROS 2 and DDS stop at 256).
const NAME_BYTES_MAX: usize = 512;

/// Running discovery. Dropping it ends it and waits for its threads.
#[derive(Debug)]
pub(crate) struct Running {
    stop: Arc<Stop>,
    thread: Option<thread::JoinHandle<()>>,
    /// The reader of participants' announcements of their nodes.
    _nodes: Option<CycloneReader>,
}

impl Drop for Running {
    fn drop(&mut self) {
        self.stop.request();
        if let Some(thread) = self.thread.take() {
            join(thread);
        }
    }
}

/// Starts the thread, which first reports existing endpoints. With an announcer, nodes are reported, too.
pub(crate) fn start(
    participant: Arc<Participant>,
    handler: DiscoveryHandler,
    announcer: Option<Arc<Announcer>>,
) -> Result<Running, String> {
    let handler: SharedHandler = Arc::new(Mutex::new(handler));
    participant.watch(&handler);
    let graph = announcer.map(|announcer| Listener::new(Arc::clone(&handler), announcer));
    let stop = Stop::new(&participant)?;
    let endpoints = [EndpointKind::Writer, EndpointKind::Reader].map(Subject::Endpoint);
    let told = endpoints.into_iter().chain([Subject::Participant]);
    let readers: Vec<_> =
        told.map(|told| BuiltinReader::new(&participant, told)).collect::<Result<_, _>>()?;
    let conditions: Vec<&Entity> = readers.iter().map(|r| &r.condition).collect();
    let wait_set = WaitSet::new(&participant, Arc::clone(&stop), &conditions)?;
    let nodes = graph.as_ref().map(|graph| graph.listen(&participant)).transpose()?;
    let mut discovery = Discovery { wait_set, readers, known: HashMap::new(), handler, graph, participant };
    let thread = thread::Builder::new()
        .name("sgc-dds-disc".into())
        .spawn(move || discovery.run())
        .map_err(|e| e.to_string())?;
    Ok(Running { stop, thread: Some(thread), _nodes: nodes })
}

/// The thread's state. Fields drop in this order: children first.
struct Discovery {
    wait_set: WaitSet,
    readers: Vec<BuiltinReader>,
    known: HashMap<Guid, DiscoveredEndpoint>,
    handler: SharedHandler,
    graph: Option<Arc<Listener>>,
    participant: Arc<Participant>,
}

struct BuiltinReader {
    condition: Entity,
    reader: Entity,
    told: Subject,
}

/// The subject of a reader's samples.
#[derive(Clone, Copy)]
enum Subject {
    Endpoint(EndpointKind),
    Participant,
}

/// A change that a sample reports.
enum Change {
    Endpoint(Guid, Option<Announcement>),
    /// The participant's USER_DATA, or `None` if the participant is gone.
    Participant(Guid, Option<Vec<u8>>),
}

impl BuiltinReader {
    fn new(participant: &Participant, told: Subject) -> Result<Self, String> {
        let topic: dds_entity_t = match told {
            Subject::Endpoint(EndpointKind::Reader) => DDS_BUILTIN_TOPIC_DCPSSUBSCRIPTION,
            Subject::Endpoint(EndpointKind::Writer) => DDS_BUILTIN_TOPIC_DCPSPUBLICATION,
            Subject::Participant => DDS_BUILTIN_TOPIC_DCPSPARTICIPANT,
        };
        // SAFETY: the topic is a constant of Cyclone's; null means its own QoS and no listener.
        let reader = Entity::new(unsafe {
            dds_create_reader(participant.entity().handle(), topic, std::ptr::null(), std::ptr::null())
        })?;
        Ok(Self { condition: reader.read_condition()?, reader, told })
    }

    /// Takes samples, up to a batch. An endpoint that is not alive or cannot be bridged has no announcement.
    fn take(&self, changes: &mut Vec<Change>) -> Result<usize, String> {
        let mut samples: [*mut c_void; BATCH] = [std::ptr::null_mut(); BATCH];
        let mut infos: [MaybeUninit<dds_sample_info_t>; BATCH] = [const { MaybeUninit::uninit() }; BATCH];
        // SAFETY: both arrays have room for a batch; null pointers ask for loans, given back below.
        let taken = unsafe {
            dds_take(
                self.reader.handle(),
                samples.as_mut_ptr(),
                infos.as_mut_ptr().cast(),
                BATCH,
                BATCH as u32,
            )
        };
        check(taken)?;
        for (sample, info) in samples.iter().zip(&infos).take(taken as usize) {
            // SAFETY: Cyclone filled the first `taken` of both arrays.
            let info = unsafe { info.assume_init_ref() };
            let alive = info.instance_state == dds_instance_state_DDS_IST_ALIVE;
            // A sample that only reports a change of state has nothing but a key.
            if alive && !info.valid_data {
                continue;
            }
            changes.push(match self.told {
                Subject::Endpoint(kind) => {
                    // SAFETY: samples of these two topics are of this type.
                    let endpoint = unsafe { &*sample.cast::<dds_builtintopic_endpoint_t>() };
                    // SAFETY: valid data has valid names and QoS while the loan lasts.
                    let read = || unsafe { Announcement::read(kind, endpoint) };
                    let announcement = if alive { read() } else { None };
                    Change::Endpoint(Guid(endpoint.key.v), announcement)
                }
                Subject::Participant => {
                    // SAFETY: samples of this topic are of this type.
                    let participant = unsafe { &*sample.cast::<dds_builtintopic_participant_t>() };
                    let qos = participant.qos;
                    // SAFETY: valid data has a valid QoS while the loan lasts; null is looked for.
                    let data = (alive && !qos.is_null()).then(|| unsafe { qos::user_data(qos) });
                    Change::Participant(Guid(participant.key.v), data)
                }
            });
        }
        if taken > 0 {
            // SAFETY: gives back the loans of the take above, once.
            check(unsafe { dds_return_loan(self.reader.handle(), samples.as_mut_ptr(), taken) })?;
        }
        Ok(taken as usize)
    }
}

struct Announcement {
    endpoint: DiscoveredEndpoint,
    tagged: bool,
}

impl Announcement {
    /// # Safety
    /// Names and QoS of the sample must be valid.
    unsafe fn read(kind: EndpointKind, sample: &dds_builtintopic_endpoint_t) -> Option<Self> {
        if sample.qos.is_null() {
            return None;
        }
        let guid = Guid(sample.key.v);
        // SAFETY: valid by contract.
        let (topic, type_name) = unsafe { (name(sample.topic_name)?, name(sample.type_name)?) };
        // SAFETY: not null, valid by contract.
        let (qos, data) = unsafe {
            (qos::discovered(kind, guid.vendor(), guid.is_keyless(), sample.qos), qos::user_data(sample.qos))
        };
        let endpoint = DiscoveredEndpoint {
            kind,
            guid,
            topic,
            type_name,
            keyless: guid.is_keyless(),
            type_hash: user_data::type_hash(&data),
            qos: qos?,
        };
        Some(Self { endpoint, tagged: user_data::is_tagged(&data) })
    }
}

/// # Safety
/// Null, or a NUL-terminated string.
unsafe fn name(text: *const c_char) -> Option<String> {
    if text.is_null() {
        return None;
    }
    // SAFETY: valid by contract.
    let text = unsafe { CStr::from_ptr(text) }.to_str().ok()?;
    (text.len() <= NAME_BYTES_MAX).then(|| text.to_owned())
}

impl Discovery {
    fn run(&mut self) {
        let mut changes = Vec::with_capacity(BATCH);
        loop {
            for i in 0..self.readers.len() {
                loop {
                    let taken = self.readers[i].take(&mut changes).unwrap_or_else(|reason| {
                        tracing::error!(reason, "reading DDS discovery failed");
                        0
                    });
                    for change in changes.drain(..) {
                        match change {
                            Change::Endpoint(guid, announcement) => self.apply(guid, announcement),
                            Change::Participant(guid, data) => self.apply_participant(guid, data.as_deref()),
                        }
                    }
                    if taken < BATCH {
                        break;
                    }
                }
            }
            if !self.wait_set.wait() {
                return;
            }
        }
    }

    fn apply(&mut self, guid: Guid, announcement: Option<Announcement>) {
        if self.participant.owns(&guid) {
            return;
        }
        if announcement.is_some() {
            strangers::forget(&guid);
        }
        let endpoint =
            announcement.filter(|a| !(a.tagged && self.participant.ignores_tagged())).map(|a| a.endpoint);
        if endpoint.is_some() && self.known.get(&guid) == endpoint.as_ref() {
            return;
        }
        if self.known.remove(&guid).is_some() {
            lock(&self.handler)(DiscoveryEvent::Vanished { guid });
        }
        let Some(endpoint) = endpoint else { return };
        if self.known.len() >= ENDPOINTS_MAX {
            tracing::debug!(?guid, "too many endpoints on the network: one is ignored");
            return;
        }
        self.known.insert(guid, endpoint.clone());
        lock(&self.handler)(DiscoveryEvent::Appeared(endpoint));
    }

    /// Records a participant in case that it cannot be joined.
    fn note_stranger(&self, guid: Guid, user_data: Option<&[u8]>) {
        let Some(data) = user_data.filter(|data| !user_data::is_tagged(data)) else {
            return strangers::forget(&guid);
        };
        // A participant outside of ROS 2 is recorded only if Cyclone refuses it.
        if let Some(enclave) = user_data::enclave(data)
            && !self.known.keys().any(|endpoint| endpoint.prefix() == guid.prefix())
        {
            strangers::note_participant(&guid, enclave, self.participant.is_secured());
        }
    }

    fn apply_participant(&self, guid: Guid, user_data: Option<&[u8]>) {
        if self.participant.owns(&guid) {
            return;
        }
        self.note_stranger(guid, user_data);
        self.participant.local_nodes().note(&guid, user_data.and_then(user_data::tag));
        let Some(graph) = &self.graph else { return };
        match user_data {
            // Announcements of SGC nodes for remote nodes are for ROS 2, not for other SGC nodes.
            Some(data) if user_data::is_tagged(data) && self.participant.ignores_tagged() => {}
            Some(data) => graph.change(|view| view.participant_there(guid, user_data::enclave(data))),
            None => graph.change(|view| view.participant_gone(&guid)),
        }
    }
}
