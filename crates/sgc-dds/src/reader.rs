//! [`CycloneReader`]: a raw reader and the thread that serves it.
//!
//! The thread sleeps in a wait set, takes serialised samples by reference and calls the handler, which may
//! block: then samples gather in this reader's own history, and no other reader waits.

use std::mem::MaybeUninit;
use std::sync::Arc;
use std::thread;

use cyclors::{DDS_ANY_STATE, dds_create_reader, dds_sample_info_t, dds_takecdr, ddsi_serdata};
use sgc_ros::{EndpointKind, EndpointSpec, Guid, Sample, SampleHandler};
use sgc_wire::History;

use crate::entity::{Entity, check};
use crate::known_writers::KnownWriters;
use crate::network::Participant;
use crate::payload::HEADER_BYTES;
use crate::serdata::Serdata;
use crate::wait::{Stop, WaitSet, join};

/// Most samples taken at once. A reader of smaller depth takes no more than its depth, so that a handler
/// that blocks is not followed by a backlog of samples that history has replaced.
const BATCH: usize = 16;

/// A raw reader; dropping it ends its thread, waits for a handler that is at work, and deletes the entities.
#[derive(Debug)]
pub struct CycloneReader {
    guid: Guid,
    stop: Arc<Stop>,
    thread: Option<thread::JoinHandle<()>>,
}

impl CycloneReader {
    pub(crate) fn new(
        participant: &Arc<Participant>,
        spec: &EndpointSpec,
        handler: SampleHandler,
    ) -> Result<Self, String> {
        let qos = participant.endpoint_qos(EndpointKind::Reader, spec, "")?;
        let topic = participant.topic(spec)?;
        let group = participant.group(EndpointKind::Reader, spec)?;
        let parent = group.as_ref().unwrap_or(participant.entity()).handle();
        // SAFETY: the QoS object outlives the call, which copies it; null means no listener.
        let reader = Entity::new(unsafe {
            dds_create_reader(parent, topic.handle(), qos.as_ptr(), std::ptr::null())
        })?;
        let guid = reader.guid()?;
        let condition = reader.read_condition()?;
        let stop = Stop::new(participant)?;
        let wait_set = WaitSet::new(participant, Arc::clone(&stop), &[&condition])?;
        let batch = match spec.qos.history {
            History::KeepLast(n) => (n as usize).clamp(1, BATCH),
            History::KeepAll => BATCH,
        };
        let mut service = Service {
            wait_set,
            _condition: condition,
            reader,
            _group: group,
            _topic: topic,
            stop: Arc::clone(&stop),
            participant: Arc::clone(participant),
            batch,
            writers: KnownWriters::default(),
            handler,
        };
        let thread = thread::Builder::new()
            .name("sgc-dds-read".into())
            .spawn(move || service.run())
            .map_err(|e| e.to_string())?;
        Ok(Self { guid, stop, thread: Some(thread) })
    }

    /// GUID of the reader, as others discover it.
    pub fn guid(&self) -> Guid {
        self.guid
    }
}

impl Drop for CycloneReader {
    fn drop(&mut self) {
        self.stop.request();
        if let Some(thread) = self.thread.take() {
            join(thread);
        }
    }
}

/// What the thread owns. Fields drop in this order: children first.
struct Service {
    wait_set: WaitSet,
    _condition: Entity,
    reader: Entity,
    _group: Option<Entity>,
    _topic: Entity,
    stop: Arc<Stop>,
    participant: Arc<Participant>,
    batch: usize,
    writers: KnownWriters,
    handler: SampleHandler,
}

impl Service {
    fn run(&mut self) {
        let mut batch = Vec::with_capacity(BATCH);
        // Handed over when it is known whether another follows: after the look that finds the next one, or
        // none. That the handler hears of the last one is a promise, so it is kept when this reader ends,
        // too.
        let mut held: Option<Sample> = None;
        while self.wait_set.wait() {
            loop {
                match self.take(&mut batch) {
                    Ok(0) => break,
                    Ok(_) => {}
                    Err(reason) => {
                        tracing::error!(reason, "taking samples failed");
                        break;
                    }
                }
                for (sample, info) in batch.drain(..) {
                    if self.stop.is_requested() {
                        break;
                    }
                    let Some(next) = self.sample(sample, &info) else { continue };
                    if self.batch == 1 {
                        // Only the newest counts: none is held that a blocked handler would make old.
                        (self.handler)(next);
                    } else if let Some(sample) = held.replace(next) {
                        (self.handler)(Sample { more: true, ..sample });
                    }
                }
                if self.stop.is_requested() {
                    break;
                }
            }
            if let Some(last) = held.take() {
                (self.handler)(last);
            }
            if self.stop.is_requested() {
                return;
            }
        }
    }

    fn take(&self, batch: &mut Vec<(Serdata, dds_sample_info_t)>) -> Result<usize, String> {
        let mut samples: [*mut ddsi_serdata; BATCH] = [std::ptr::null_mut(); BATCH];
        let mut infos: [MaybeUninit<dds_sample_info_t>; BATCH] = [const { MaybeUninit::uninit() }; BATCH];
        // SAFETY: both arrays have room for `batch` ≤ `BATCH` entries; the samples' references become ours.
        let taken = unsafe {
            dds_takecdr(
                self.reader.handle(),
                samples.as_mut_ptr(),
                self.batch as u32,
                infos.as_mut_ptr().cast(),
                DDS_ANY_STATE,
            )
        };
        check(taken)?;
        for (sample, info) in samples.into_iter().zip(infos).take(taken as usize) {
            // SAFETY: Cyclone filled the first `taken` of both arrays and gave us a reference to each sample,
            // whose type is the blob type of this reader's topic.
            batch.push(unsafe { (Serdata::from_raw(sample), info.assume_init()) });
        }
        Ok(taken as usize)
    }

    /// What the handler gets of what was taken, if anything.
    fn sample(&mut self, sample: Serdata, info: &dds_sample_info_t) -> Option<Sample> {
        // Changes of instance state: Cyclone makes them up without a payload (see the crate's header).
        if !info.valid_data {
            return None;
        }
        let writer = self.writers.find(&self.reader, info.publication_handle);
        // DDS matches readers with writers of other proxies on this network too. What those wrote came
        // through SGC already: sharing it again would send it round and round.
        if writer.is_some_and(|w| w.tagged) && self.participant.ignores_tagged() {
            return None;
        }
        let kind = sample.kind();
        let payload = sample.into_payload();
        if payload.len() < HEADER_BYTES {
            tracing::debug!(bytes = payload.len(), "a sample without encapsulation header is dropped");
            return None;
        }
        Some(Sample {
            kind,
            writer: writer.map(|w| w.guid),
            source_timestamp_ns: info.source_timestamp,
            payload,
            more: false,
        })
    }
}
