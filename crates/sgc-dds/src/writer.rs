//! [`CycloneWriter`]: a raw writer.
//!
//! It writes on the caller's thread, which may block for [`crate::qos::WRITE_BLOCK_MAX_MS`]. That must not be a
//! thread of Cyclone or of an async runtime.

use std::collections::{HashMap, VecDeque};
use std::ffi::c_void;
use std::sync::atomic::{AtomicU32, AtomicU64, AtomicUsize, Ordering};
use std::sync::{Arc, Mutex};
use std::time::{Duration, Instant};

use bytes::Bytes;
use cyclors::{
    DDS_RETCODE_TIMEOUT, DDSI_STATUSINFO_DISPOSE, DDSI_STATUSINFO_UNREGISTER, dds_assert_liveliness,
    dds_create_listener, dds_create_writer, dds_delete_listener, dds_entity_t, dds_forwardcdr,
    dds_get_entity_sertype, dds_get_publication_matched_status, dds_lset_publication_matched_arg,
    dds_publication_matched_status, dds_publication_matched_status_t, dds_set_status_mask, dds_take_status,
    dds_wait_for_acks, dds_write_flush,
};
use sgc_ros::{EndpointKind, EndpointSpec, Guid, KeyHash, RosError, RosWriter, SampleHead, SampleKind};
use sgc_sync::lock;
use sgc_wire::{History, Qos};

use crate::bursts::Bursts;
use crate::entity::{Entity, INFINITE, check, reason};
use crate::late;
use crate::matched;
use crate::participant::Participant;
use crate::payload::Frame;
use crate::qos::{SendWindow, history_of, keys_kept};
use crate::sample::{Extra, SampleRef};
use crate::wait::{READERS_MATCHED, wait_for_status};
use crate::writer_inside::WriterInside;

/// Requests for acknowledgement while a writer writes as many samples as it keeps, so that they come before it has to
/// wait for them.
const ASKED_PER_KEPT: u32 = 4;

/// Latest source timestamp that RTPS can express, in nanoseconds since the Unix epoch: seconds have 32 bits (RTPS
/// 2.5, 9.3.2.1).
const TIMESTAMP_MAX_NS: i64 = 4_294_967_295_999_999_999;

/// A raw writer. Dropping it deletes the entities. If reliable readers lack data, Cyclone keeps sending for up to a
/// second.
///
/// Fields drop in this order: children first.
#[derive(Debug)]
pub struct CycloneWriter {
    writer: Entity,
    /// The matched readers, which the listener writes. It outlives the writer, because the listener points to it.
    matched: Arc<Matched>,
    /// Whether a matched reader may have a small receive buffer.
    has_small_buffers: AtOneMatch,
    _group: Option<Entity>,
    topic: Entity,
    participant: Arc<Participant>,
    guid: Guid,
    keyless: bool,
    /// The send window, if the writer does not wait.
    unacknowledged: Option<SendWindow>,
    /// The number of samples written so far, which wraps.
    written: AtomicU32,
    /// The instance of the next sample, if keys are not kept apart.
    next_instance: AtomicU32,
    /// The instances of keys, if keys are kept apart.
    keys: Option<Mutex<Keys>>,
    /// The history for late joiners, if it may have to shrink.
    late: Option<(Mutex<LateHistory>, WriterCount)>,
    _counted: WriterCount,
}

/// Most bytes that a writer keeps whose publisher did not announce its depth, for late joiners and for readers that
/// have not acknowledged them. A single sample may be longer.
const LATE_BYTES_MAX: usize = 64 << 20;

/// Most such bytes of all these writers of a network together.
const LATE_BYTES_IN_ALL: usize = 256 << 20;

/// The history of a transient-local writer whose publisher did not announce its depth.
#[derive(Debug)]
struct LateHistory {
    /// The depth at creation.
    history: u32,
    /// The publisher's depth.
    wanted: u32,
    /// The number of samples that late joiners get.
    depth: u32,
    /// The lengths of the kept samples, acknowledged or not.
    lengths: VecDeque<usize>,
    bytes: usize,
    /// Most bytes that the writer may keep.
    bytes_max: usize,
}

impl LateHistory {
    fn new(spec: &EndpointSpec) -> Option<Self> {
        if !spec.qos.is_transient_local() || !spec.qos.is_reliable() || !spec.qos.history.is_unsaid() {
            return None;
        }
        let (_, depth) = history_of(EndpointKind::Writer, spec.qos.history, spec.keyless);
        let history = u32::try_from(depth).unwrap_or(1);
        let (wanted, depth, bytes_max) = (history, history, LATE_BYTES_MAX);
        Some(Self { history, wanted, depth, lengths: VecDeque::new(), bytes: 0, bytes_max })
    }

    /// Records a sample of this length, given the number of such writers. Returns the number of samples that may stay
    /// if older ones may not.
    fn note(&mut self, bytes: usize, writers: usize) -> Option<u32> {
        self.bytes_max = (LATE_BYTES_IN_ALL / writers.max(1)).min(LATE_BYTES_MAX);
        self.bytes += bytes;
        self.lengths.push_back(bytes);
        self.trim()
    }

    /// Records the publisher's depth. Returns the number of samples that may stay if older ones may not.
    fn want(&mut self, depth: u32) -> Option<u32> {
        self.wanted = depth.clamp(1, self.wanted);
        self.trim()
    }

    fn trim(&mut self) -> Option<u32> {
        let (mut is_over, depth) = (false, self.wanted as usize);
        while self.lengths.len() > depth || (self.bytes > self.bytes_max && self.lengths.len() > 1) {
            // Cyclone itself drops samples beyond the depth at creation.
            is_over |= self.bytes > self.bytes_max || self.wanted < self.history;
            self.bytes -= self.lengths.pop_front().unwrap_or(0);
        }
        is_over.then(|| u32::try_from(self.lengths.len()).unwrap_or(self.wanted))
    }

    /// Returns the number of samples that late joiners may get.
    fn allowed(&self) -> u32 {
        let newest = self.lengths.back().copied().unwrap_or(0);
        // Another sample of the same length would push one out.
        let is_full = self.bytes.saturating_add(newest) > self.bytes_max;
        let kept = u32::try_from(self.lengths.len()).unwrap_or(self.wanted).max(1);
        if is_full { kept.min(self.wanted) } else { self.wanted }
    }

    /// Returns the number of samples of this length that the writer keeps for readers.
    fn kept(&self, bytes: usize) -> u32 {
        u32::try_from(self.bytes_max / bytes.max(1)).unwrap_or(u32::MAX).clamp(1, self.wanted)
    }
}

/// Counts a writer of its network until dropped.
#[derive(Debug)]
struct WriterCount(Arc<Participant>, fn(&Participant) -> &AtomicUsize);

impl WriterCount {
    fn new(participant: &Arc<Participant>, counter: fn(&Participant) -> &AtomicUsize) -> Self {
        counter(participant).fetch_add(1, Ordering::Relaxed);
        Self(Arc::clone(participant), counter)
    }
}

impl Drop for WriterCount {
    fn drop(&mut self) {
        (self.1)(&self.0).fetch_sub(1, Ordering::Relaxed);
    }
}

/// The instance of each written key, up to a bound. Beyond it a new key takes the instance of the key that was not
/// written for the longest time.
#[derive(Debug)]
struct Keys {
    max: u32,
    /// The instance of each key, with the number of its latest write.
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

/// Returns the instance of a sample that is spread over so many, and moves on to the next one. The first instance
/// follows the last one also if the number changes, so no instance gets more than its share of the smallest number.
fn take_instance(next: &AtomicU32, instances: u32) -> u32 {
    let wrapped = |at: u32| if at < instances { at } else { 0 };
    let before = next.fetch_update(Ordering::Relaxed, Ordering::Relaxed, |at| Some(wrapped(at) + 1));
    before.map_or(0, wrapped)
}

impl CycloneWriter {
    pub(crate) fn new(participant: &Arc<Participant>, spec: &EndpointSpec) -> Result<Self, String> {
        let qos = participant.endpoint_qos(EndpointKind::Writer, spec, "")?;
        qos.set_batching();
        // Readers of a participant that ignores none of its own endpoints receive these samples unchanged.
        let has_own_readers = !participant.ignores_tagged();
        let unacknowledged = SendWindow::for_writer(&spec.qos, spec.keyless);
        let unacknowledged =
            unacknowledged.map(|kept| if has_own_readers { kept.for_one_instance() } else { kept });
        if let Some(kept) = unacknowledged {
            qos.set_unacknowledged(kept);
        }
        let topic = participant.topic(spec)?;
        let group = participant.group(EndpointKind::Writer, spec)?;
        let parent = group.as_ref().unwrap_or(participant.entity()).handle();
        let matched = Arc::<Matched>::default();
        let arg = Arc::as_ptr(&matched).cast_mut().cast::<c_void>();
        // SAFETY: the QoS object and the listener outlive the call, which copies them, and the listener is deleted
        // once. `arg` outlives the writer, whose deletion waits for its listener: see the fields' order.
        let writer = unsafe {
            let listener = dds_create_listener(arg);
            // The status stays set, because a wait for readers waits for it.
            dds_lset_publication_matched_arg(listener, Some(readers_changed), arg, false);
            let writer = dds_create_writer(parent, topic.handle(), qos.as_ptr(), listener);
            dds_delete_listener(listener);
            Entity::new(writer)?
        };
        // SAFETY: takes numbers, checked by Cyclone.
        check(unsafe { dds_set_status_mask(writer.handle(), READERS_MATCHED) })?;
        let late = LateHistory::new(spec);
        if let Some(LateHistory { history, depth, .. }) = late
            && !late::set_depth(writer.handle(), topic.handle(), history, [depth; 2], None)
        {
            tracing::warn!(
                topic = spec.topic,
                "late joiners get the last message: depths cannot be changed here"
            );
            let qos = Qos { history: History::KeepLast(1), ..spec.qos.clone() };
            return Self::new(participant, &EndpointSpec { qos, ..spec.clone() });
        }
        let guid = writer.guid()?;
        Ok(Self {
            writer,
            matched,
            has_small_buffers: AtOneMatch::default(),
            _group: group,
            topic,
            participant: Arc::clone(participant),
            guid,
            keyless: spec.keyless,
            unacknowledged,
            written: AtomicU32::new(0),
            next_instance: AtomicU32::new(0),
            keys: keys_kept(&spec.qos, spec.keyless).map(|max| Mutex::new(Keys::new(max))),
            late: late
                .map(|late| (Mutex::new(late), WriterCount::new(participant, Participant::late_writers))),
            _counted: WriterCount::new(participant, Participant::writers),
        })
    }

    /// Returns the number of instances over which samples of this length are spread.
    fn instances(&self, bytes: usize) -> u32 {
        let writers = self.participant.writers().load(Ordering::Relaxed);
        self.unacknowledged.map_or(1, |kept| kept.instances(bytes, writers))
    }

    /// Returns the number of samples of this length that the writer keeps unacknowledged over so many instances.
    fn kept_over(&self, instances: u32, bytes: usize) -> Option<u32> {
        let kept = self.unacknowledged?.depth.saturating_mul(instances);
        let late = self.late.as_ref().map(|(late, _)| lock(late).kept(bytes));
        Some(late.map_or(kept, |late| late.min(kept)))
    }

    /// Changes the history for late joiners and updates Cyclone's. The change gets the number of writers like this
    /// one and returns the number of samples that may stay, if others may not.
    fn change_late(&self, change: impl FnOnce(&mut LateHistory, usize) -> Option<u32>) {
        let Some((late, _)) = &self.late else { return };
        let mut late = lock(late);
        let stay = change(&mut late, self.participant.late_writers().load(Ordering::Relaxed));
        let allowed = late.allowed();
        if allowed != late.depth || stay.is_some() {
            let (writer, topic) = (self.writer.handle(), self.topic.handle());
            if late::set_depth(writer, topic, late.history, [late.depth, allowed], stay) {
                late.depth = allowed;
            }
        }
    }

    /// Returns the number of matched readers by Cyclone's status. It has the writer's lock, so this waits for a write.
    /// A listener is called between the change of the status and the wake-up of who waits for it.
    fn matched_now(&self) -> u32 {
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

    /// Returns `true` if a matched reader may have a receive buffer of the kernel's default size. Those of Cyclone ask
    /// for a larger one.
    fn has_small_buffers(&self) -> bool {
        let changes = self.matched.changes.load(Ordering::Acquire);
        self.has_small_buffers.get(changes, || {
            !matched::all_readers_are(self.writer.handle(), |reader| reader.guid.is_of_cyclone())
        })
    }

    /// Returns the GUID of the writer, as others discover it.
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

    fn assert_liveliness(&self) {
        // SAFETY: takes a number, checked by Cyclone.
        if let Err(reason) = check(unsafe { dds_assert_liveliness(self.writer.handle()) }) {
            tracing::debug!(reason, "the liveliness of a writer is not asserted");
        }
    }

    fn set_late_depth(&self, depth: u32) {
        self.change_late(|late, _| late.want(depth));
    }

    fn kept(&self, bytes: usize) -> Option<u32> {
        self.kept_over(self.instances(bytes), bytes)
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
        let number = self.written.fetch_add(1, Ordering::Relaxed);
        let instances = self.instances(payload.len());
        let instance = match (&self.keys, &key_hash) {
            (Some(keys), Some(hash)) => lock(keys).instance(hash),
            _ => take_instance(&self.next_instance, instances),
        };
        let asks = self
            .kept_over(instances, payload.len())
            .is_some_and(|kept| number.is_multiple_of((kept / ASKED_PER_KEPT).max(1)));
        let asked = if asks { WriterInside::find(self.writer.handle(), self.topic.handle()) } else { None };
        if let Some(inside) = &asked {
            inside.ask_for_acknowledgement();
        }

        let mut sertype = std::ptr::null();
        // SAFETY: the handle is checked by Cyclone, and `sertype` is a valid place for the result.
        check(unsafe { dds_get_entity_sertype(self.writer.handle(), &mut sertype) }).map_err(failed)?;
        let extra = Extra { key_only, key_hash, related: None, instance };
        // SAFETY: the sertype of this writer, which keeps it alive.
        let sample = unsafe { SampleRef::build(sertype, &payload, &frame, extra, source_timestamp_ns) };
        let mut sample = sample.ok_or_else(|| failed("out of memory".into()))?;
        sample.set_status(statusinfo);

        let _bursts = Bursts::begin(payload.len(), || self.has_small_buffers());
        let started = Instant::now();
        // SAFETY: the sample is valid and of the writer's type; the call consumes the reference.
        let ret = unsafe { dds_forwardcdr(self.writer.handle(), sample.into_raw()) };
        if let Some(inside) = asked {
            inside.await_acknowledgement();
        }
        match ret {
            DDS_RETCODE_TIMEOUT => {
                Err(RosError::WriteTimeout { waited_ms: started.elapsed().as_millis() as u64 })
            }
            ret if ret < 0 => Err(failed(reason(ret))),
            _ => {
                self.change_late(|late, writers| late.note(payload.len(), writers));
                Ok(())
            }
        }
    }

    fn unacknowledged(&self) -> Option<u32> {
        let inside = WriterInside::find(self.writer.handle(), self.topic.handle())?;
        Some(u32::try_from(inside.unacknowledged()).unwrap_or(u32::MAX))
    }

    fn wait_acknowledged(&self, max: Duration) -> bool {
        let ns = i64::try_from(max.as_nanos()).unwrap_or(INFINITE);
        // Unsent samples cannot be acknowledged.
        self.flush();
        // SAFETY: takes numbers; the handle is checked by Cyclone.
        unsafe { dds_wait_for_acks(self.writer.handle(), ns) >= 0 }
    }

    fn matched_readers(&self) -> u32 {
        // Cyclone's own status has the writer's lock, which a write that waits for acknowledgements holds.
        self.matched.readers.load(Ordering::Relaxed)
    }

    fn wait_matched(&self, readers: u32, max: Duration) -> u32 {
        let handle = self.writer.handle();
        let until = Instant::now() + max;
        loop {
            let mut status = 0;
            // Later changes wake the wait below.
            // SAFETY: the handle is checked by Cyclone, and `status` is a valid place for the result.
            unsafe { dds_take_status(handle, &mut status, READERS_MATCHED) };
            let matched = self.matched_now();
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

/// The listener of matched readers. Cyclone calls it for each change.
unsafe extern "C" fn readers_changed(
    _: dds_entity_t,
    status: dds_publication_matched_status_t,
    arg: *mut c_void,
) {
    // SAFETY: the argument of the listener, which lives until the writer is deleted.
    let matched = unsafe { &*arg.cast::<Matched>() };
    matched.readers.store(status.current_count, Ordering::Relaxed);
    matched.changes.fetch_add(1, Ordering::Release);
}

/// The matched readers of a writer.
#[derive(Debug, Default)]
struct Matched {
    /// Their number.
    readers: AtomicU32,
    /// The number of changes, which wraps.
    changes: AtomicU32,
}

/// A property of the matched readers, which is found anew after they have changed.
#[derive(Debug, Default)]
struct AtOneMatch(AtomicU64);

impl AtOneMatch {
    /// Returns the property after so many changes.
    fn get(&self, changes: u32, find: impl FnOnce() -> bool) -> bool {
        // 0 is that of no change; the lowest bit is the property.
        let at = (u64::from(changes) + 1) << 1;
        let known = self.0.load(Ordering::Relaxed);
        if known & !1 == at {
            return known & 1 == 1;
        }
        let found = find();
        self.0.store(at | u64::from(found), Ordering::Relaxed);
        found
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn property_of_matched_readers_is_found_once_for_each_change() {
        let property = AtOneMatch::default();
        let mut found = 0;
        for (changes, expected) in
            [(0, true), (0, true), (1, false), (1, false), (u32::MAX, true), (0, false)]
        {
            let is = property.get(changes, || {
                found += 1;
                expected
            });
            assert_eq!(is, expected, "{changes}");
        }
        assert_eq!(found, 4);
    }

    #[test]
    fn samples_of_varying_size_share_instances_evenly() {
        const DEPTH: usize = 16;
        let few = 2;
        for many in [3, 4, 63, 64] {
            let (next, mut of_each) = (AtomicU32::new(0), vec![0; many as usize]);
            // Every second sample is long, and as many are written as the long ones leave room for.
            for n in 0..DEPTH * few as usize {
                let instances = if n % 2 == 0 { few } else { many };
                of_each[take_instance(&next, instances) as usize] += 1;
            }
            assert!(of_each.iter().all(|samples| *samples <= DEPTH), "{many}: {of_each:?}");
        }
    }

    #[test]
    fn keys_share_instances_only_beyond_their_bound() {
        let mut keys = Keys::new(2);
        let mut instance = |key: u8| keys.instance(&[key; 16]);
        assert_eq!([instance(1), instance(2), instance(1)], [0, 1, 0]);
        assert_eq!([instance(3), instance(1)], [1, 0], "the key not written for the longest time gives way");
        assert_eq!(instance(2), 1);
    }
}
