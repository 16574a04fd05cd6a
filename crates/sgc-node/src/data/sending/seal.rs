//! The stage in which a source numbers, seals and keeps a message.
//!
//! `sgc-endpoint` seals. This stage notes the progress of the share's sources: the end of an epoch, and the silence
//! after a message. The stage behind it takes the packets while later ones are sealed.

use std::sync::atomic::{AtomicBool, AtomicU64, Ordering::Relaxed, Ordering::SeqCst};
use std::sync::{Arc, MutexGuard};
use std::time::Instant;

use bytes::Bytes;
use sgc_endpoint::{PublishError, Source};
use sgc_sync::lock;
use sgc_wire::{MessageHead, SinkId, TopicGrant};
use tokio::sync::Notify;

use crate::data::sending::emit::EmitStage;
use crate::data::sending::silence::Silence;
use crate::data::sending::source_map::{SourceMap, SourceSlot};
use crate::data::stats::{DataDrop, Dropped};

/// Seals the messages of one share.
pub(crate) struct SealStage {
    /// Messages of one source under one key before a new epoch begins.
    epoch_messages_max: Arc<AtomicU64>,
    /// Whether the message limit of the epoch is reached and the next epoch has not begun.
    is_rotating: AtomicBool,
    /// Whether the control task has yet to see that the epoch is over.
    is_over: AtomicBool,
    silence: Silence,
    /// Wakes the control task, which may otherwise sleep while messages flow.
    control: Arc<Notify>,
    published: AtomicU64,
}

/// The receivers of a message.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Destination {
    /// All sinks. With `more`, the source may keep an unfinished batch.
    Everyone { more: bool },
    /// One sink.
    Sink(SinkId),
    /// Nobody listens now, so the message is only kept for late joiners and rejoining sinks.
    History,
}

impl SealStage {
    /// Creates the stage of a share. `control` is notified when an epoch or a silence ends.
    pub(crate) fn new(epoch_messages_max: Arc<AtomicU64>, control: Arc<Notify>) -> Self {
        Self {
            epoch_messages_max,
            is_rotating: AtomicBool::new(false),
            is_over: AtomicBool::new(false),
            silence: Silence::default(),
            control,
            published: AtomicU64::new(0),
        }
    }

    /// Seals a message by the locked source of `slot`, and emits its packets. Blocks while a link is full.
    pub(crate) fn seal(
        &self,
        slot: &SourceSlot,
        mut source: MutexGuard<'_, Source>,
        head: &MessageHead,
        payload: Bytes,
        to: Destination,
        emit: &EmitStage,
    ) -> Result<(), Dropped> {
        let result = match to {
            // Fragments leave while later ones are sealed, so a large message is under way before its end is read.
            Destination::Everyone { more } => source.publish(head, payload, more, emit.packets()),
            Destination::Sink(sink) => source.publish_to(sink, head, payload, emit.packets()),
            Destination::History => source.record(head, payload),
        };
        drop(source);
        match result {
            Ok(()) => {
                self.note_published(slot);
                Ok(())
            }
            Err(PublishError::TooLarge { .. }) => Err(Dropped::one(DataDrop::TooLarge)),
            Err(PublishError::Exhausted | PublishError::Keeps) => {
                Err(Dropped::one(DataDrop::SourceExhausted))
            }
        }
    }

    fn note_published(&self, slot: &SourceSlot) {
        self.published.fetch_add(1, Relaxed);
        if self.silence.end(&slot.progress) {
            self.control.notify_one();
        }
        if slot.progress.published_in_epoch() >= self.epoch_messages_max.load(Relaxed)
            && !self.is_rotating.swap(true, Relaxed)
        {
            self.is_over.store(true, SeqCst);
            self.control.notify_one();
        }
    }

    /// Seals with the key of a new epoch from here on. A blocked source takes it up after its message.
    pub(crate) fn rekey(&self, sources: &SourceMap, grant: &TopicGrant, emit: &EmitStage) {
        for slot in sources.slots() {
            // A source that was created meanwhile has this key already, or a later one.
            let _ = lock(&slot.source).rekey(grant, emit.packets());
        }
        self.is_rotating.store(false, Relaxed);
    }

    /// Returns `true` once per epoch, when a source has reached the message limit.
    pub(crate) fn is_epoch_over(&self) -> bool {
        self.is_over.swap(false, SeqCst)
    }

    /// Passes silent sources that have to announce their last message to `announce`. Returns `false` if none has to
    /// before the next message.
    pub(crate) fn look_for_silence(
        &self,
        now: Instant,
        sources: &SourceMap,
        announce: impl FnMut(&SourceSlot),
    ) -> bool {
        self.silence.look(now, sources, announce)
    }

    /// Returns the number of published messages.
    pub(crate) fn published(&self) -> u64 {
        self.published.load(Relaxed)
    }
}

/// Finishes the open batch of a source, because no more messages follow.
pub(crate) fn finish_batch(slot: &SourceSlot, emit: &EmitStage) {
    lock(&slot.source).flush(emit.packets());
}

#[cfg(test)]
mod tests {
    use sgc_wire::MessageKind;

    use super::*;
    use crate::data::dataplane::DataPlane;
    use crate::data::sending::fixtures::{
        NAME, SINK, add_link, addressed_slot, grant, map_of, queued, slot_with_id, unflushed,
    };

    /// Seals a message of four bytes.
    fn seal(stage: &SealStage, slot: &SourceSlot, to: Destination, emit: &EmitStage) -> Result<(), Dropped> {
        let head = MessageHead::new(MessageKind::Write, 0);
        stage.seal(slot, lock(&slot.source), &head, Bytes::from_static(b"data"), to, emit)
    }

    fn is_notified(control: &Notify) -> bool {
        let mut context = std::task::Context::from_waker(std::task::Waker::noop());
        std::pin::pin!(control.notified()).poll(&mut context).is_ready()
    }

    #[test]
    fn message_goes_to_its_destination() {
        let runtime = tokio::runtime::Runtime::new().unwrap();
        let data = Arc::<DataPlane>::default();
        let (flow, emit) = (add_link(&data), EmitStage::new(NAME, data, runtime.handle().clone()));
        let (stage, slot) =
            (SealStage::new(Arc::new(AtomicU64::new(u64::MAX)), Arc::default()), slot_with_id(1));
        let left = || queued(&flow).map(|packet| (packet.header.seq, packet.header.to));
        assert_eq!(seal(&stage, &slot, Destination::Everyone { more: false }, &emit), Ok(()));
        assert_eq!([left(), left()], [Some((1, None)), None]);
        // The batch stays open until it is finished.
        assert_eq!(seal(&stage, &slot, Destination::Everyone { more: true }, &emit), Ok(()));
        assert_eq!(left(), None);
        finish_batch(&slot, &emit);
        assert_eq!([left(), left()], [Some((2, None)), None]);
        assert_eq!(seal(&stage, &slot, Destination::History, &emit), Ok(()));
        assert_eq!((left(), unflushed(&slot), slot.progress.published()), (None, 0, 3));
        // A source with a history addresses no messages.
        let to = Destination::Sink(SINK);
        assert_eq!(seal(&stage, &slot, to, &emit), Err(Dropped::one(DataDrop::SourceExhausted)));
        assert_eq!(seal(&stage, &addressed_slot(), to, &emit), Ok(()));
        assert_eq!(left(), Some((1, Some(SINK))));
        assert_eq!(stage.published(), 4);
    }

    #[test]
    fn message_limit_ends_an_epoch_once_until_the_next_begins() {
        let runtime = tokio::runtime::Runtime::new().unwrap();
        let emit = EmitStage::new(NAME, Arc::default(), runtime.handle().clone());
        let (control, slot) = (Arc::<Notify>::default(), slot_with_id(1));
        let stage = SealStage::new(Arc::new(AtomicU64::new(2)), control.clone());
        let publish = || seal(&stage, &slot, Destination::History, &emit).unwrap();
        publish();
        assert!(is_notified(&control), "the silence is over");
        assert!(!stage.is_epoch_over());
        publish();
        assert!(is_notified(&control) && stage.is_epoch_over());
        publish();
        assert!(!is_notified(&control) && !stage.is_epoch_over());
        stage.rekey(&map_of(slot.clone()), &grant(2), &emit);
        assert_eq!(lock(&slot.source).epoch(), 2);
        publish();
        assert!(!stage.is_epoch_over());
        publish();
        assert!(stage.is_epoch_over());
    }
}
