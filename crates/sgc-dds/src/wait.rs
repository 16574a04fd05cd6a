//! Sleeping and ending of this crate's threads: [`WaitSet`], [`Stop`], [`join`].
//!
//! No thread polls or sleeps for a time: each blocks until a condition of Cyclone is true.

use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::thread::JoinHandle;
use std::time::Duration;

use cyclors::{
    dds_create_guardcondition, dds_create_waitset, dds_entity_t, dds_set_guardcondition,
    dds_status_id_DDS_PUBLICATION_MATCHED_STATUS_ID, dds_status_id_DDS_SUBSCRIPTION_MATCHED_STATUS_ID,
    dds_waitset_attach, dds_waitset_wait,
};

use crate::entity::{Entity, INFINITE, check};
use crate::participant::Participant;

/// Cyclone's status bits for changes of matches.
pub(crate) const READERS_MATCHED: u32 = 1 << dds_status_id_DDS_PUBLICATION_MATCHED_STATUS_ID;
pub(crate) const WRITERS_MATCHED: u32 = 1 << dds_status_id_DDS_SUBSCRIPTION_MATCHED_STATUS_ID;

/// A request to end a thread: a flag for a working thread, a guard condition for a sleeping one.
#[derive(Debug)]
pub(crate) struct Stop {
    flag: AtomicBool,
    guard: Entity,
    /// The guard condition must be deleted before the participant, and the owner of this may outlive the thread.
    _participant: Arc<Participant>,
}

impl Stop {
    pub(crate) fn new(participant: &Arc<Participant>) -> Result<Arc<Self>, String> {
        // SAFETY: takes a number, checked by Cyclone.
        let guard = Entity::new(unsafe { dds_create_guardcondition(participant.entity().handle()) })?;
        Ok(Arc::new(Self { flag: AtomicBool::new(false), guard, _participant: Arc::clone(participant) }))
    }

    /// Asks the thread to end.
    pub(crate) fn request(&self) {
        self.flag.store(true, Ordering::Release);
        // SAFETY: takes a number, checked by Cyclone.
        if let Err(reason) = check(unsafe { dds_set_guardcondition(self.guard.handle(), true) }) {
            tracing::error!(reason, "cannot wake a DDS thread");
        }
    }

    pub(crate) fn is_requested(&self) -> bool {
        self.flag.load(Ordering::Acquire)
    }
}

/// A set of conditions that a thread waits for, together with the request to end.
#[derive(Debug)]
pub(crate) struct WaitSet {
    set: Entity,
    stop: Arc<Stop>,
}

impl WaitSet {
    /// Creates the set. The conditions must belong to the participant and outlive the set.
    pub(crate) fn new(
        participant: &Participant,
        stop: Arc<Stop>,
        conditions: &[&Entity],
    ) -> Result<Self, String> {
        // SAFETY: takes a number, checked by Cyclone.
        let set = Entity::new(unsafe { dds_create_waitset(participant.entity().handle()) })?;
        for condition in std::iter::once(&stop.guard).chain(conditions.iter().copied()) {
            // SAFETY: takes numbers only; handles are checked by Cyclone, the attachment is opaque to it.
            check(unsafe { dds_waitset_attach(set.handle(), condition.handle(), 0) })?;
        }
        Ok(Self { set, stop })
    }

    /// Blocks without limit. Returns `false` when the thread should end.
    pub(crate) fn wait(&self) -> bool {
        // SAFETY: no attachments are asked for, so the null pointer with length 0 is not written to.
        let ret = unsafe { dds_waitset_wait(self.set.handle(), std::ptr::null_mut(), 0, INFINITE) };
        if let Err(reason) = check(ret) {
            tracing::error!(reason, "waiting for DDS failed");
            return false;
        }
        !self.stop.is_requested()
    }
}

/// Joins a thread, unless it is the calling one: a handler may drop its own caller.
pub(crate) fn join(thread: JoinHandle<()>) {
    if thread.thread().id() == std::thread::current().id() {
        return;
    }
    if thread.join().is_err() {
        tracing::error!("a DDS thread ended by a panic of its handler");
    }
}

/// Sleeps until a status in the mask of one of these entities changes, at most for `longest`.
pub(crate) fn wait_for_status(
    participant: &Participant,
    entities: &[dds_entity_t],
    longest: Duration,
) -> Result<(), String> {
    // SAFETY: takes a number, checked by Cyclone.
    let set = Entity::new(unsafe { dds_create_waitset(participant.entity().handle()) })?;
    for entity in entities {
        // SAFETY: takes numbers only; handles are checked by Cyclone, the attachment is opaque to it.
        check(unsafe { dds_waitset_attach(set.handle(), *entity, 0) })?;
    }
    let longest = i64::try_from(longest.as_nanos()).unwrap_or(INFINITE);
    // SAFETY: no attachments are asked for, so the null pointer with length 0 is not written to.
    check(unsafe { dds_waitset_wait(set.handle(), std::ptr::null_mut(), 0, longest) })
}
