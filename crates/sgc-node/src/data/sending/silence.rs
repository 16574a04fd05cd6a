//! The silence of sources: the times at which each announces its last message, so that sinks notice a loss.
//!
//! [`Marks`] has the times. This module has no clock and seals nothing. The control task looks while a source has to
//! announce something, and the first message after that wakes it.

use std::collections::BTreeMap;
use std::sync::Mutex;
use std::sync::atomic::{AtomicBool, Ordering::Relaxed, Ordering::SeqCst};
use std::time::Instant;

use sgc_endpoint::{Marks, SourceProgress};
use sgc_sync::lock;
use sgc_wire::SourceId;

use crate::data::sending::source_map::{SourceMap, SourceSlot};

/// The silence of the sources of one share.
pub(crate) struct Silence {
    /// Whether all sources are silent. The next message clears it.
    is_quiet: AtomicBool,
    /// Progress of each source at the last look.
    marks: Mutex<BTreeMap<SourceId, Marks>>,
}

impl Default for Silence {
    fn default() -> Self {
        Self { is_quiet: AtomicBool::new(true), marks: Mutex::default() }
    }
}

impl Silence {
    /// Ends the silence by a message of a source. Returns `true` if looks have to begin.
    pub(crate) fn end(&self, source: &SourceProgress) -> bool {
        self.is_quiet.load(Relaxed) && source.recovers() && self.is_quiet.swap(false, SeqCst)
    }

    /// Looks at all sources, and passes those that have to announce their last message now to `announce`. Returns
    /// `false` if none has to before the next message.
    pub(crate) fn look(
        &self,
        now: Instant,
        sources: &SourceMap,
        mut announce: impl FnMut(&SourceSlot),
    ) -> bool {
        if self.is_quiet.load(SeqCst) {
            return false;
        }
        let mut marks = lock(&self.marks);
        marks.retain(|id, _| sources.slot(id).is_some());
        let mut look = || {
            let mut busy = false;
            for slot in sources.slots() {
                let marks = marks.entry(slot.id).or_default();
                if marks.is_due(now, &slot.progress) {
                    announce(slot);
                }
                busy |= marks.deadline().is_some();
            }
            busy
        };
        if look() {
            return true;
        }
        self.is_quiet.store(true, SeqCst);
        // A message may have come between the two checks.
        let busy = look();
        if busy {
            self.is_quiet.store(false, SeqCst);
        }
        busy
    }
}

#[cfg(test)]
mod tests {
    use std::time::Duration;

    use bytes::Bytes;
    use sgc_endpoint::MARK_AFTER;
    use sgc_wire::{MessageHead, MessageKind};

    use super::*;
    use crate::data::sending::fixtures::{map_of, slot_with_id};

    #[test]
    fn silent_source_announces_its_last_message_at_each_time_until_the_next() {
        let (silence, slot, begin) = (Silence::default(), slot_with_id(1), Instant::now());
        let sources = map_of(slot.clone());
        let looks = |after: Duration| {
            let mut announced = 0;
            let is_busy = silence.look(begin + after, &sources, |_| announced += 1);
            (is_busy, announced)
        };
        for round in 0..2 {
            assert_eq!(looks(Duration::ZERO), (false, 0), "round {round}: nothing is new");
            let head = MessageHead::new(MessageKind::Write, 0);
            lock(&slot.source).record(&head, Bytes::from_static(b"data")).unwrap();
            assert!(silence.end(&slot.progress) && !silence.end(&slot.progress));
            assert_eq!(looks(Duration::ZERO), (true, 0));
            let [first, second, last] = MARK_AFTER;
            assert_eq!(looks(first - Duration::from_millis(1)), (true, 0));
            assert_eq!([first, second, last].map(looks), [(true, 1), (true, 1), (false, 1)]);
            assert_eq!(looks(2 * last), (false, 0));
        }
    }

    #[test]
    fn source_that_is_gone_is_forgotten() {
        let (silence, slot, now) = (Silence::default(), slot_with_id(1), Instant::now());
        let head = MessageHead::new(MessageKind::Write, 0);
        lock(&slot.source).record(&head, Bytes::from_static(b"data")).unwrap();
        assert!(silence.end(&slot.progress));
        assert!(silence.look(now, &map_of(slot), |_| ()));
        assert!(!silence.look(now, &SourceMap::default(), |_| ()));
        assert!(lock(&silence.marks).is_empty());
    }
}
