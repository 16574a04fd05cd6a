//! [`CycloneWriter`]: a raw writer.
//!
//! Writes on the caller's thread, which may block for [`crate::qos::WRITE_BLOCK_MAX_MS`]; it must not be a
//! thread of Cyclone's or of an async runtime.

use std::collections::HashMap;
use std::sync::atomic::{AtomicU32, Ordering};
use std::sync::{Arc, Mutex, PoisonError};
use std::time::{Duration, Instant};

use bytes::Bytes;
use cyclors::{
    DDS_RETCODE_TIMEOUT, DDSI_STATUSINFO_DISPOSE, DDSI_STATUSINFO_UNREGISTER, dds_create_writer,
    dds_forwardcdr, dds_get_entity_sertype, dds_get_publication_matched_status,
    dds_publication_matched_status, dds_set_status_mask, dds_take_status, dds_wait_for_acks, dds_write_flush,
};
use sgc_ros::{EndpointKind, EndpointSpec, Guid, KeyHash, RosError, RosWriter, SampleHead, SampleKind};

use crate::entity::{Entity, INFINITE, check, reason};
use crate::network::Participant;
use crate::payload::Frame;
use crate::qos::{Unacknowledged, keys_kept};
use crate::sample::{Extra, SampleRef};
use crate::wait::{READERS_MATCHED, wait_for_status};

/// Latest source time stamp that RTPS can say, nanoseconds since the Unix epoch: seconds are 32 bits
/// (RTPS 2.5, 9.3.2.1).
const TIMESTAMP_MAX_NS: i64 = 4_294_967_295_999_999_999;

/// A raw writer; dropping it deletes the entities. With reliable readers that lack data, Cyclone keeps
/// sending for up to a second.
///
/// Fields drop in this order: children first.
#[derive(Debug)]
pub struct CycloneWriter {
    writer: Entity,
    _group: Option<Entity>,
    _topic: Entity,
    participant: Arc<Participant>,
    guid: Guid,
    keyless: bool,
    /// The room for samples until they are acknowledged, if the writer does not wait.
    unacknowledged: Option<Unacknowledged>,
    /// Samples written so far, which wraps.
    written: AtomicU32,
    /// The instances of keys, where those are kept apart.
    keys: Option<Mutex<Keys>>,
    _counted: Counted,
}

/// Counts a writer of its network for as long as it lives.
#[derive(Debug)]
struct Counted(Arc<Participant>);

impl Counted {
    fn new(participant: &Arc<Participant>) -> Self {
        participant.writers().fetch_add(1, Ordering::Relaxed);
        Self(Arc::clone(participant))
    }
}

impl Drop for Counted {
    fn drop(&mut self) {
        self.0.writers().fetch_sub(1, Ordering::Relaxed);
    }
}

/// The instance of each key that was written, up to a bound: then a new key takes that of the key not written for the longest time.
#[derive(Debug)]
struct Keys {
    max: u32,
    /// With the number of the latest write of each.
    instances: HashMap<KeyHash, (u32, u64)>,
    writes: u64,
}

impl Keys {
    fn new(max: u32) -> Self {
        Self { max, instances: HashMap::new(), writes: 0 }
    }

    fn instance(&mut self, hash: &KeyHash) -> u32 {
        self.writes += 1;
        if let Some((instance, last)) = self.instances.get_mut(hash) {
            *last = self.writes;
            return *instance;
        }
        let known = self.instances.len() as u32;
        let oldest = self.instances.iter().min_by_key(|(_, (_, last))| *last).map(|(oldest, _)| *oldest);
        let instance = match oldest.filter(|_| known >= self.max) {
            Some(oldest) => self.instances.remove(&oldest).map_or(0, |(instance, _)| instance),
            None => known,
        };
        self.instances.insert(*hash, (instance, self.writes));
        instance
    }
}

impl CycloneWriter {
    pub(crate) fn new(participant: &Arc<Participant>, spec: &EndpointSpec) -> Result<Self, String> {
        let qos = participant.endpoint_qos(EndpointKind::Writer, spec, "")?;
        qos.set_batching();
        // Readers of a participant that ignores none of its own endpoints get what is written here as it is.
        let has_own_readers = !participant.ignores_tagged();
        let unacknowledged = Unacknowledged::of(&spec.qos, spec.keyless);
        let unacknowledged =
            unacknowledged.map(|kept| if has_own_readers { kept.of_one_instance() } else { kept });
        if let Some(kept) = unacknowledged {
            qos.set_unacknowledged(kept);
        }
        let topic = participant.topic(spec)?;
        let group = participant.group(EndpointKind::Writer, spec)?;
        let parent = group.as_ref().unwrap_or(participant.entity()).handle();
        // SAFETY: the QoS object outlives the call, which copies it; null means no listener.
        let writer = Entity::new(unsafe {
            dds_create_writer(parent, topic.handle(), qos.as_ptr(), std::ptr::null())
        })?;
        // SAFETY: takes numbers, checked by Cyclone.
        check(unsafe { dds_set_status_mask(writer.handle(), READERS_MATCHED) })?;
        let guid = writer.guid()?;
        Ok(Self {
            writer,
            _group: group,
            _topic: topic,
            participant: Arc::clone(participant),
            guid,
            keyless: spec.keyless,
            unacknowledged,
            written: AtomicU32::new(0),
            keys: keys_kept(&spec.qos, spec.keyless).map(|max| Mutex::new(Keys::new(max))),
            _counted: Counted::new(participant),
        })
    }

    /// Over how many instances samples of so many bytes are spread.
    fn instances(&self, bytes: usize) -> u32 {
        let writers = self.participant.writers().load(Ordering::Relaxed);
        self.unacknowledged.map_or(1, |kept| kept.instances(bytes, writers))
    }

    /// GUID of the writer, as others discover it.
    pub fn guid(&self) -> Guid {
        self.guid
    }
}

impl RosWriter for CycloneWriter {
    fn guid(&self) -> Guid {
        self.guid
    }

    fn flush(&self) {
        // SAFETY: takes a number, checked by Cyclone.
        if let Err(reason) = check(unsafe { dds_write_flush(self.writer.handle()) }) {
            tracing::error!(reason, "what was written does not leave");
        }
    }

    fn kept(&self, bytes: usize) -> Option<u32> {
        Some(self.unacknowledged?.depth.saturating_mul(self.instances(bytes)))
    }

    fn write_ahead(&self, head: SampleHead, payload: Bytes) -> Result<(), RosError> {
        let SampleHead { kind, source_timestamp_ns, key_hash } = head;
        let failed = |reason: String| RosError::Write { reason };
        let frame = Frame::new(&payload)?;
        if !(0..=TIMESTAMP_MAX_NS).contains(&source_timestamp_ns) {
            return Err(failed(format!("RTPS cannot say the time stamp {source_timestamp_ns} ns")));
        }
        let (key_only, statusinfo) = match kind {
            SampleKind::Write => (false, 0),
            SampleKind::Dispose => (true, DDSI_STATUSINFO_DISPOSE),
            SampleKind::Unregister => (true, DDSI_STATUSINFO_UNREGISTER),
        };
        if key_only && self.keyless {
            return Err(failed("a topic without key has no instances to dispose of".into()));
        }

        let key_hash = key_hash.filter(|_| !self.keyless);
        if key_hash.is_none() && !self.keyless {
            return Err(RosError::KeyUnknown);
        }
        let instance = match (&self.keys, &key_hash) {
            (Some(keys), Some(hash)) => keys.lock().unwrap_or_else(PoisonError::into_inner).instance(hash),
            _ => self.written.fetch_add(1, Ordering::Relaxed) % self.instances(payload.len()),
        };

        let mut sertype = std::ptr::null();
        // SAFETY: the handle is checked by Cyclone, and `sertype` is a valid place for the result.
        check(unsafe { dds_get_entity_sertype(self.writer.handle(), &mut sertype) }).map_err(failed)?;
        let extra = Extra { key_only, key_hash, related: None, instance };
        // SAFETY: the sertype of this writer, which keeps it alive.
        let sample = unsafe { SampleRef::build(sertype, &payload, &frame, extra, source_timestamp_ns) };
        let mut sample = sample.ok_or_else(|| failed("out of memory".into()))?;
        sample.set_status(statusinfo);

        let started = Instant::now();
        // SAFETY: the sample is valid and of the writer's type; the call consumes the reference.
        let ret = unsafe { dds_forwardcdr(self.writer.handle(), sample.into_raw()) };
        match ret {
            DDS_RETCODE_TIMEOUT => {
                Err(RosError::WriteTimeout { waited_ms: started.elapsed().as_millis() as u64 })
            }
            ret if ret < 0 => Err(failed(reason(ret))),
            _ => Ok(()),
        }
    }

    fn wait_acknowledged(&self, max: Duration) -> bool {
        let ns = i64::try_from(max.as_nanos()).unwrap_or(INFINITE);
        // What has not left cannot be acknowledged.
        self.flush();
        // SAFETY: takes numbers; the handle is checked by Cyclone.
        unsafe { dds_wait_for_acks(self.writer.handle(), ns) >= 0 }
    }

    fn matched_readers(&self) -> u32 {
        let mut status = dds_publication_matched_status {
            total_count: 0,
            total_count_change: 0,
            current_count: 0,
            current_count_change: 0,
            last_subscription_handle: 0,
        };
        // SAFETY: the handle is checked by Cyclone, and `status` is a valid place for the result.
        let ret = unsafe { dds_get_publication_matched_status(self.writer.handle(), &mut status) };
        if ret < 0 { 0 } else { status.current_count }
    }

    fn wait_matched(&self, readers: u32, max: Duration) -> u32 {
        let handle = self.writer.handle();
        let until = Instant::now() + max;
        loop {
            let mut status = 0;
            // What happens from here on wakes the wait below.
            // SAFETY: the handle is checked by Cyclone, and `status` is a valid place for the result.
            unsafe { dds_take_status(handle, &mut status, READERS_MATCHED) };
            let matched = self.matched_readers();
            let left = until.saturating_duration_since(Instant::now());
            if matched >= readers || left.is_zero() {
                return matched;
            }
            if let Err(reason) = wait_for_status(&self.participant, &[handle], left) {
                tracing::error!(reason, "waiting for readers failed");
                return matched;
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn keys_share_instances_only_beyond_their_bound() {
        let mut keys = Keys::new(2);
        let mut instance = |key: u8| keys.instance(&[key; 16]);
        assert_eq!([instance(1), instance(2), instance(1)], [0, 1, 0]);
        assert_eq!([instance(3), instance(1)], [1, 0], "the key not written for the longest time gives way");
        assert_eq!(instance(2), 1);
    }
}
