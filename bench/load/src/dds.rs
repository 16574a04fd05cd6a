//! Cyclone DDS as this program needs it: one participant, typed readers and writers of one type, a wait set.
//!
//! The only file with `unsafe`. It does not know what is measured.

use std::ffi::{CStr, CString, c_void};
use std::ptr::{null, null_mut};
use std::time::Duration;

use anyhow::{Context, Result, bail};
use cyclors::*;

use crate::types;

/// Samples that are taken at once.
const TAKE_MAX: usize = 128;
/// How long a write may wait for room before it is tried again.
const WRITE_BLOCK_MAX: Duration = Duration::from_secs(1);

/// An entity of Cyclone, deleted on drop.
#[derive(Debug)]
struct Entity(dds_entity_t);

impl Entity {
    fn new(handle: dds_entity_t) -> Result<Self> {
        check(handle)?;
        Ok(Self(handle))
    }

    fn guid(&self) -> Result<[u8; 16]> {
        let mut guid = dds_guid_t { v: [0; 16] };
        // SAFETY: Cyclone checks the handle; `guid` is a valid place.
        check(unsafe { dds_get_guid(self.0, &mut guid) })?;
        Ok(guid.v)
    }
}

impl Drop for Entity {
    fn drop(&mut self) {
        // SAFETY: takes a number, which Cyclone checks.
        unsafe { dds_delete(self.0) };
    }
}

/// Turns an error code of Cyclone into an error.
fn check(code: dds_return_t) -> Result<()> {
    if code < 0 {
        // SAFETY: returns a constant string for every argument.
        bail!("Cyclone: {}", unsafe { CStr::from_ptr(dds_strretcode(code)) }.to_string_lossy());
    }
    Ok(())
}

/// How a topic is carried.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Quality {
    /// Reliable, or best effort.
    pub(crate) reliable: bool,
    /// Number of newest messages kept; 0 keeps all unacknowledged ones, so that writing waits.
    pub(crate) depth: u32,
}

/// One message as Cyclone has it in memory: `{ uint64 seq; uint64 stamp_ns; sequence<octet> data }`.
#[repr(C)]
struct Sample {
    seq: u64,
    stamp_ns: u64,
    data: dds_sequence_t,
}

/// One message, borrowed.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Message<'a> {
    /// Its number.
    pub(crate) seq: u64,
    /// When it was written, by the clock of [`crate::now_ns`].
    pub(crate) stamp_ns: u64,
    /// The rest.
    pub(crate) data: &'a [u8],
}

/// A participant in a domain. Readers and writers have to go before it.
#[derive(Debug)]
pub(crate) struct Network {
    participant: Entity,
    guid: [u8; 16],
    /// The name of its node.
    node: CString,
    /// The type of its measured messages.
    messages: &'static types::Descriptor,
}

impl Network {
    /// Joins a domain, with the configuration that `CYCLONEDDS_URI` says.
    pub(crate) fn join(domain: u32, node: &str) -> Result<Self> {
        Ok(Self { node: CString::new(node)?, ..Self::join_with(domain, &types::MESSAGE)? })
    }

    /// Joins a domain without a node. Its measured messages have this type.
    pub(crate) fn join_with(domain: u32, messages: &'static types::Descriptor) -> Result<Self> {
        let qos = Qos::new()?;
        // As every participant of ROS 2 has it.
        const ENCLAVE: &[u8] = b"enclave=/;";
        // SAFETY: pointer and length are those of a slice, which is copied; the object outlives the call.
        let handle = unsafe {
            dds_qset_userdata(qos.0, ENCLAVE.as_ptr().cast(), ENCLAVE.len());
            dds_create_participant(domain, qos.0, null())
        };
        let participant = Entity::new(handle).with_context(|| format!("domain {domain}"))?;
        let guid = participant.guid()?;
        Ok(Self { participant, guid, node: CString::default(), messages })
    }

    fn topic(&self, descriptor: &types::Descriptor, name: &str) -> Result<Entity> {
        let name = CString::new(name)?;
        let native = descriptor.native();
        // SAFETY: descriptor, instructions and name are valid for the call, which copies them.
        Entity::new(unsafe { dds_create_topic(self.participant.0, &native, name.as_ptr(), null(), null()) })
    }
}

/// Cyclone's QoS object.
struct Qos(*mut dds_qos_t);

impl Qos {
    fn new() -> Result<Self> {
        // SAFETY: allocates.
        let qos = unsafe { dds_create_qos() };
        if qos.is_null() { bail!("out of memory") } else { Ok(Self(qos)) }
    }

    fn from_quality(quality: Quality, transient_local: bool) -> Result<Self> {
        let qos = Self::new()?;
        let reliability = match quality.reliable {
            true => dds_reliability_kind_DDS_RELIABILITY_RELIABLE,
            false => dds_reliability_kind_DDS_RELIABILITY_BEST_EFFORT,
        };
        let (history, depth) = match quality.depth {
            0 => (dds_history_kind_DDS_HISTORY_KEEP_ALL, 0),
            depth => (dds_history_kind_DDS_HISTORY_KEEP_LAST, i32::try_from(depth)?),
        };
        // SAFETY: the object is valid, setters copy.
        unsafe {
            dds_qset_reliability(qos.0, reliability, WRITE_BLOCK_MAX.as_nanos() as i64);
            dds_qset_history(qos.0, history, depth);
            if transient_local {
                dds_qset_durability(qos.0, dds_durability_kind_DDS_DURABILITY_TRANSIENT_LOCAL);
            }
        }
        Ok(qos)
    }
}

impl Drop for Qos {
    fn drop(&mut self) {
        // SAFETY: made by `dds_create_qos`, deleted once.
        unsafe { dds_delete_qos(self.0) }
    }
}

/// A publisher. Fields go in this order.
#[derive(Debug)]
pub(crate) struct Writer {
    entity: Entity,
    _topic: Entity,
}

impl Writer {
    /// Opens an endpoint on the ROS 2 topic `/name`.
    pub(crate) fn new(network: &Network, name: &str, quality: Quality) -> Result<Self> {
        Self::open(network, network.messages, &types::dds_name(name), Qos::from_quality(quality, false)?)
    }

    /// Opens a writer whose messages may share packets until [`Self::flush`].
    pub(crate) fn with_batching(network: &Network, name: &str, quality: Quality) -> Result<Self> {
        let qos = Qos::from_quality(quality, false)?;
        // SAFETY: the object is valid.
        unsafe { dds_qset_writer_batching(qos.0, true) };
        Self::open(network, network.messages, &types::dds_name(name), qos)
    }

    fn open(network: &Network, descriptor: &types::Descriptor, dds_name: &str, qos: Qos) -> Result<Self> {
        let topic = network.topic(descriptor, dds_name)?;
        // SAFETY: Cyclone checks the handles; the QoS outlives the call.
        let handle = unsafe { dds_create_writer(network.participant.0, topic.0, qos.0, null()) };
        let entity = Entity::new(handle).with_context(|| format!("a writer of {dds_name}"))?;
        let mask = 1 << dds_status_id_DDS_PUBLICATION_MATCHED_STATUS_ID;
        // SAFETY: takes numbers.
        check(unsafe { dds_set_status_mask(entity.0, mask) })?;
        Ok(Self { entity, _topic: topic })
    }

    /// Returns the number of matched readers.
    pub(crate) fn matched(&self) -> Result<u32> {
        // SAFETY: plain numbers, of which zeros are a value.
        let mut status: dds_publication_matched_status_t = unsafe { std::mem::zeroed() };
        // SAFETY: Cyclone checks the handle; `status` is a valid place.
        check(unsafe { dds_get_publication_matched_status(self.entity.0, &mut status) })?;
        Ok(status.current_count)
    }

    /// Writes a message. Returns `false` if there was no room for a second; then nothing was written.
    pub(crate) fn write(&self, message: &Message<'_>) -> Result<bool> {
        let sample =
            Sample { seq: message.seq, stamp_ns: message.stamp_ns, data: types::sequence(message.data) };
        // SAFETY: the sample is of the type of the topic and lives through the call, which reads it only.
        self.write_raw(unsafe { dds_write(self.entity.0, (&raw const sample).cast()) })
    }

    /// Sends messages that wait for others to share their packet.
    pub(crate) fn flush(&self) -> Result<()> {
        // SAFETY: takes a number.
        check(unsafe { dds_write_flush(self.entity.0) })
    }

    fn write_raw(&self, code: dds_return_t) -> Result<bool> {
        if code == DDS_RETCODE_TIMEOUT {
            return Ok(false);
        }
        check(code)?;
        Ok(true)
    }

    /// Waits until the matched readers have acknowledged all. Returns `false` if that took too long.
    pub(crate) fn until_acknowledged(&self, timeout: Duration) -> Result<bool> {
        // SAFETY: takes numbers.
        self.write_raw(unsafe { dds_wait_for_acks(self.entity.0, nanoseconds(timeout)) })
    }
}

/// The announcement of a node in `ros_discovery_info`.
#[derive(Debug)]
pub(crate) struct Graph(Writer);

impl Graph {
    /// Opens the writer, which every node has.
    pub(crate) fn open(network: &Network) -> Result<Self> {
        let qos = Qos::from_quality(Quality { reliable: true, depth: 1 }, true)?;
        Ok(Self(Writer::open(network, &types::GRAPH, "ros_discovery_info", qos)?))
    }

    /// Announces the node to which the endpoints of this participant belong.
    pub(crate) fn announce(
        &mut self,
        network: &Network,
        readers: &[Reader],
        writers: &[Writer],
    ) -> Result<()> {
        let readers = readers.iter().map(|reader| reader.entity.guid()).collect::<Result<Vec<_>>>()?;
        let writers = writers.iter().map(|writer| writer.entity.guid()).collect::<Result<Vec<_>>>()?;
        let entities = types::NodeEntities {
            namespace: c"/".as_ptr(),
            name: network.node.as_ptr(),
            readers: types::sequence(&readers),
            writers: types::sequence(&writers),
        };
        let entities = [entities];
        let info = types::ParticipantEntities { gid: network.guid, nodes: types::sequence(&entities) };
        // SAFETY: as in `Writer::write`; strings and sequences live through the call.
        self.0.write_raw(unsafe { dds_write(self.0.entity.0, (&raw const info).cast()) })?;
        Ok(())
    }
}

/// A subscriber. Fields go in this order.
#[derive(Debug)]
pub(crate) struct Reader {
    condition: Entity,
    entity: Entity,
    _topic: Entity,
}

impl Reader {
    /// Opens an endpoint on the ROS 2 topic `/name`.
    pub(crate) fn new(network: &Network, name: &str, quality: Quality) -> Result<Self> {
        Self::with(network, name, quality, null())
    }

    fn with(
        network: &Network,
        name: &str,
        quality: Quality,
        listener: *const dds_listener_t,
    ) -> Result<Self> {
        let topic = network.topic(network.messages, &types::dds_name(name))?;
        let qos = Qos::from_quality(quality, false)?;
        // SAFETY: Cyclone checks the handles; QoS and listener outlive the call, which copies them.
        let handle = unsafe { dds_create_reader(network.participant.0, topic.0, qos.0, listener) };
        let entity = Entity::new(handle).with_context(|| format!("a reader of {name}"))?;
        let mask = 1 << dds_status_id_DDS_SUBSCRIPTION_MATCHED_STATUS_ID;
        // SAFETY: take numbers.
        let condition = unsafe {
            check(dds_set_status_mask(entity.0, mask))?;
            dds_create_readcondition(entity.0, DDS_ANY_STATE)
        };
        Ok(Self { condition: Entity::new(condition)?, entity, _topic: topic })
    }

    /// Opens a reader that calls `arrived` on Cyclone's receiving thread, one call at a time. `arrived` lives until the
    /// process ends.
    pub(crate) fn with_listener<F: FnMut(Inbox) + Send + 'static>(
        network: &Network,
        name: &str,
        quality: Quality,
        arrived: F,
    ) -> Result<Self> {
        unsafe extern "C" fn call<F: FnMut(Inbox)>(reader: dds_entity_t, arrived: *mut c_void) {
            // SAFETY: what the listener was made with, which is never freed; Cyclone makes one call at a time.
            let arrived = unsafe { &mut *arrived.cast::<F>() };
            arrived(Inbox(reader));
        }
        let arrived: *mut F = Box::leak(Box::new(arrived));
        // SAFETY: `arrived` lives as long as the process and is used by calls of this listener only; the listener is
        // copied by the call that makes the reader, and deleted once.
        unsafe {
            let listener = dds_create_listener(arrived.cast());
            dds_lset_data_available(listener, Some(call::<F>));
            let reader = Self::with(network, name, quality, listener);
            dds_delete_listener(listener);
            reader
        }
    }

    /// Returns the number of matched writers.
    pub(crate) fn matched(&self) -> Result<u32> {
        // SAFETY: plain numbers, of which zeros are a value.
        let mut status: dds_subscription_matched_status_t = unsafe { std::mem::zeroed() };
        // SAFETY: Cyclone checks the handle; `status` is a valid place.
        check(unsafe { dds_get_subscription_matched_status(self.entity.0, &mut status) })?;
        Ok(status.current_count)
    }

    /// Returns the inbox of the reader.
    pub(crate) fn inbox(&self) -> Inbox {
        Inbox(self.entity.0)
    }

    /// Takes all messages that are there.
    pub(crate) fn take(&self, handle: impl FnMut(Message<'_>) -> Result<()>) -> Result<()> {
        self.inbox().take(handle)
    }
}

/// The messages that wait at a reader. Empty once the reader is gone.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Inbox(dds_entity_t);

impl Inbox {
    /// Takes all messages that are there.
    pub(crate) fn take(self, mut handle: impl FnMut(Message<'_>) -> Result<()>) -> Result<()> {
        loop {
            let mut samples: [*mut c_void; TAKE_MAX] = [null_mut(); TAKE_MAX];
            // SAFETY: plain data, of which zeros are a value.
            let mut infos: [dds_sample_info_t; TAKE_MAX] = unsafe { std::mem::zeroed() };
            let (buffer, limit) = (samples.as_mut_ptr(), TAKE_MAX);
            // SAFETY: both arrays have as many places as is said; null pointers ask for a loan.
            let taken = unsafe { dds_take(self.0, buffer, infos.as_mut_ptr(), limit, limit as u32) };
            check(taken)?;
            let taken = taken as usize;
            let mut outcome = Ok(());
            for (sample, info) in samples.iter().zip(&infos).take(taken) {
                if !info.valid_data || outcome.is_err() {
                    continue;
                }
                // SAFETY: a valid sample of the topic's type, ours until the loan is returned.
                let sample = unsafe { &*sample.cast::<Sample>() };
                // SAFETY: Cyclone made the sequence from what it received.
                let data = unsafe { slice(&sample.data) };
                outcome = handle(Message { seq: sample.seq, stamp_ns: sample.stamp_ns, data });
            }
            if taken > 0 {
                // SAFETY: what was lent above.
                check(unsafe { dds_return_loan(self.0, buffer, taken as i32) })?;
            }
            outcome?;
            if taken < TAKE_MAX {
                return Ok(());
            }
        }
    }
}

/// A handle that wakes the waiter from any thread.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Bell(dds_entity_t);

impl Bell {
    /// Wakes the waiter.
    pub(crate) fn ring(self) {
        // SAFETY: takes numbers; Cyclone refuses a handle that is gone.
        unsafe { dds_set_guardcondition(self.0, true) };
    }
}

/// Waits for messages, matches and a bell.
#[derive(Debug)]
pub(crate) struct Waiter {
    set: Entity,
    bell: Entity,
    /// Readers and writers whose matches end the wait.
    endpoints: Vec<dds_entity_t>,
    sources: usize,
}

/// The reason why a wait ended.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub(crate) struct Woken {
    /// Readers that have messages, by the number under which they were attached.
    pub(crate) readers: Vec<usize>,
}

/// The attachment of everything but the messages of readers.
const OTHER: dds_attach_t = -1;

impl Waiter {
    /// Returns a waiter that only waits for its bell.
    pub(crate) fn new(network: &Network) -> Result<Self> {
        let participant = network.participant.0;
        // SAFETY: take numbers.
        let (set, bell) =
            unsafe { (dds_create_waitset(participant), dds_create_guardcondition(participant)) };
        let mut waiter =
            Self { set: Entity::new(set)?, bell: Entity::new(bell)?, endpoints: Vec::new(), sources: 0 };
        waiter.attach(waiter.bell.0, OTHER)?;
        Ok(waiter)
    }

    fn attach(&mut self, handle: dds_entity_t, as_what: dds_attach_t) -> Result<()> {
        // SAFETY: takes numbers.
        check(unsafe { dds_waitset_attach(self.set.0, handle, as_what) })?;
        self.sources += 1;
        Ok(())
    }

    /// Attaches the messages and matches of a reader.
    pub(crate) fn attach_reader(&mut self, reader: &Reader, number: usize) -> Result<()> {
        self.attach(reader.condition.0, dds_attach_t::try_from(number)?)?;
        self.endpoints.push(reader.entity.0);
        self.attach(reader.entity.0, OTHER)
    }

    /// Attaches the matches of a writer.
    pub(crate) fn attach_writer(&mut self, writer: &Writer) -> Result<()> {
        self.endpoints.push(writer.entity.0);
        self.attach(writer.entity.0, OTHER)
    }

    /// Returns the bell that wakes the waiter from other threads.
    pub(crate) fn bell(&self) -> Bell {
        Bell(self.bell.0)
    }

    /// Waits for an attached event, at most for `timeout`.
    pub(crate) fn wait(&self, timeout: Duration) -> Result<Woken> {
        let mut woken: Vec<dds_attach_t> = vec![OTHER; self.sources];
        // SAFETY: `woken` has as many places as is said.
        let count =
            unsafe { dds_waitset_wait(self.set.0, woken.as_mut_ptr(), woken.len(), nanoseconds(timeout)) };
        check(count)?;
        let mut rung = false;
        // SAFETY: takes a number and a valid place.
        check(unsafe { dds_take_guardcondition(self.bell.0, &mut rung) })?;
        if woken.iter().take(count as usize).any(|&w| w == OTHER) {
            for endpoint in &self.endpoints {
                let mut status = 0;
                // A status that is not taken would end every later wait at once.
                // SAFETY: takes numbers and a valid place; 0 stands for every status.
                check(unsafe { dds_take_status(*endpoint, &mut status, 0) })?;
            }
        }
        let readers = woken.iter().take(count as usize).filter_map(|&w| usize::try_from(w).ok());
        Ok(Woken { readers: readers.collect() })
    }
}

/// Borrows the content of a sequence.
///
/// # Safety
/// The sequence is Cyclone's, and nobody writes to it meanwhile.
unsafe fn slice(sequence: &dds_sequence_t) -> &[u8] {
    if sequence._buffer.is_null() || sequence._length == 0 {
        return &[];
    }
    // SAFETY: by contract.
    unsafe { std::slice::from_raw_parts(sequence._buffer, sequence._length as usize) }
}

fn nanoseconds(duration: Duration) -> i64 {
    i64::try_from(duration.as_nanos()).unwrap_or(i64::MAX)
}
