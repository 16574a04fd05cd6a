//! [`SourceState`]: one announced source of a sink, with its keys, its numbers, and what is missing of it.

use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering::Release};

use bytes::Bytes;
use sgc_trust::{BatchVerifier, Freshness, OpenError, ReplayWindow, SourceKey, Suite};
use sgc_wire::{Name, PacketHeader, SourceAnnounce, SourceId, TopicGrant};

use super::delivery::{AskAgain, Delivery, SinkDrop};
use super::partial::Partials;

/// An announced source.
pub(super) struct SourceState {
    /// The announced key of its signatures; parsed when the first packet opens.
    pub(super) announced_key: Bytes,
    pub(super) verifier: Option<BatchVerifier>,
    /// Keys for packets to all, by epoch.
    pub(super) keys: Vec<SourceKey>,
    /// The key for packets to this sink, of the epoch seen last.
    pub(super) addressed: Option<SourceKey>,
    pub(super) window: ReplayWindow,
    /// The window's newest, for [`SinkProgress`].
    pub(super) newest: Arc<AtomicU64>,
    /// Lower numbers to all are replays from before this sink was told of the source.
    pub(super) next: u64,
    /// This sink did not ask for lower numbers.
    pub(super) oldest: u64,
    /// Whether lost messages can be asked for: then messages are delivered in the order of their numbers.
    pub(super) recovers: bool,
    /// The next number: of a source with recovery all lower ones are done, of another it is one more than the newest.
    pub(super) expected: u64,
    pub(super) partials: Partials,
    sync: SyncState,
    answer: AnswerState,
    /// The last epoch of the source, if the newest grant no longer announces it.
    pub(super) last_epoch: Option<u32>,
}

/// Whether messages of a source are missing: a transient-local source's history, or messages lost on a broken route.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum SyncState {
    /// Nothing is missing.
    Synced,
    /// The source has to be asked for messages.
    NotAsked(HistoryStart),
    /// The source was asked.
    Asked(HistoryStart),
}

/// The first of the missing messages.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum HistoryStart {
    /// The next number.
    Expected,
    /// The history may begin at any number.
    Any,
}

/// The answer of a source, since it was asked or looked at.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum AnswerState {
    /// No part of it came.
    Silent,
    /// A part of it came.
    Coming,
    /// It has a hole, so that it must be asked for once more.
    Torn,
}

impl SourceState {
    pub(super) fn new(announce: &SourceAnnounce, transient_local: bool) -> Self {
        let first = if transient_local { announce.oldest } else { announce.next };
        Self {
            announced_key: announce.key.clone(),
            verifier: None,
            keys: Vec::new(),
            addressed: None,
            window: ReplayWindow::default(),
            newest: Arc::default(),
            next: announce.next,
            oldest: first,
            recovers: announce.recover > 0,
            expected: first.max(1),
            partials: Partials::default(),
            sync: if transient_local {
                SyncState::NotAsked(HistoryStart::Expected)
            } else {
                SyncState::Synced
            },
            answer: AnswerState::Silent,
            last_epoch: None,
        }
    }

    /// Takes a repeated announcement and returns the number of messages that are lost for good. The floors stay those
    /// of the first announcement: later messages were not delivered yet, or are in the window.
    pub(super) fn announce_again(&mut self, announce: &SourceAnnounce) -> u64 {
        self.last_epoch = None;
        if self.announced_key != announce.key {
            self.announced_key = announce.key.clone();
            self.verifier = None;
        }
        // Nothing older will be sent to this node.
        let lost = if self.recovers { announce.recover.saturating_sub(self.expected) } else { 0 };
        self.give_up(lost);
        lost
    }

    /// Notes that messages are missing from here on.
    pub(super) fn unsync(&mut self) {
        self.sync = SyncState::NotAsked(self.start().unwrap_or(HistoryStart::Expected));
        self.partials.clear();
    }

    /// Returns `true` if nothing is missing.
    pub(super) fn is_synced(&self) -> bool {
        self.sync == SyncState::Synced
    }

    /// Returns `true` if the history may begin at any number.
    fn begins_anew(&self) -> bool {
        self.start() == Some(HistoryStart::Any)
    }

    fn start(&self) -> Option<HistoryStart> {
        match self.sync {
            SyncState::Synced => None,
            SyncState::NotAsked(start) | SyncState::Asked(start) => Some(start),
        }
    }

    /// Begins anew: the history is asked for, and delivered again.
    pub(super) fn restart(&mut self) {
        self.sync = SyncState::NotAsked(HistoryStart::Any);
        self.partials.clear();
    }

    /// Notes that the id under which this sink asked is no longer valid.
    pub(super) fn moved(&mut self) {
        self.addressed = None;
        if let SyncState::Asked(start) = self.sync {
            self.sync = SyncState::NotAsked(start);
        }
    }

    /// Returns the number from which on the source must be asked, 0 for the whole history, and counts it as asked;
    /// `None` if nothing is missing, or the source is no longer announced.
    pub(super) fn ask(&mut self) -> Option<u64> {
        let start = self.start().filter(|_| self.last_epoch.is_none())?;
        self.sync = SyncState::Asked(start);
        self.answer = AnswerState::Silent;
        Some(match start {
            HistoryStart::Any => 0,
            HistoryStart::Expected => self.expected,
        })
    }

    /// Returns the action a while after the source was asked.
    pub(super) fn ask_again(&mut self) -> AskAgain {
        if !self.is_synced() && self.answer == AnswerState::Coming {
            self.answer = AnswerState::Silent;
            return AskAgain::Wait;
        }
        self.ask().map_or(AskAgain::No, AskAgain::From)
    }

    /// Takes the mark of a history's end. An answer with a hole is asked for again, after a while.
    pub(super) fn take_end(&mut self) -> Result<(), SinkDrop> {
        if self.answer == AnswerState::Torn {
            return Err(SinkDrop::AwaitingHistory);
        }
        self.sync = SyncState::Synced;
        Ok(())
    }

    /// Notes that a packet of the answer came.
    pub(super) fn hear(&mut self) {
        if self.answer == AnswerState::Silent {
            self.answer = AnswerState::Coming;
        }
    }

    /// Takes a number in the order of the source. One that is ahead shows that others are missing.
    pub(super) fn take_number(&mut self, header: &PacketHeader) -> Result<(), SinkDrop> {
        if header.to.is_some() && self.begins_anew() {
            self.sync = match self.sync {
                SyncState::Asked(_) => SyncState::Asked(HistoryStart::Expected),
                _ => SyncState::NotAsked(HistoryStart::Expected),
            };
            self.expected = header.seq;
        } else if self.recovers && header.seq > self.expected {
            if header.to.is_some() {
                self.answer = AnswerState::Torn;
                return Err(SinkDrop::AwaitingHistory);
            }
            self.miss();
        }
        Ok(())
    }

    /// Notes that a number is missing.
    fn miss(&mut self) {
        if self.is_synced() {
            self.unsync();
        }
    }

    /// Handles a message that came too early.
    pub(super) fn await_history(&mut self, source: SourceId) -> Result<Delivery, SinkDrop> {
        match self.sync {
            SyncState::NotAsked(start) => {
                self.sync = SyncState::Asked(start);
                Ok(Delivery::NeedsHistory(source))
            }
            SyncState::Asked(_) | SyncState::Synced => Err(SinkDrop::AwaitingHistory),
        }
    }

    /// Notes that a message is complete.
    pub(super) fn done(&mut self, seq: u64) {
        self.window.accept(seq);
        self.newest.fetch_max(seq, Release);
        self.expected = self.expected.max(seq.saturating_add(1));
    }

    /// Gives up the next numbers, which will never come.
    fn give_up(&mut self, numbers: u64) {
        if numbers > 0 {
            self.expected += numbers;
            self.partials.clear();
        }
    }

    /// Takes a mark; each has its number. A mark ahead of an answer reports messages that are lost for good.
    pub(super) fn take_mark(&mut self, header: &PacketHeader, text: &[u8]) -> Result<Delivery, SinkDrop> {
        let oldest = oldest_of_mark(header, text)?;
        let in_turn = !self.recovers || header.seq == self.expected;
        if header.to.is_none() {
            if !in_turn {
                self.miss();
            }
            if !self.is_synced() {
                return self.await_history(header.source);
            }
        }
        if in_turn {
            self.done(header.seq);
            return Ok(Delivery::Mark);
        }
        // The mark goes ahead of an answer, and counts in its turn.
        let lost = if self.begins_anew() { 0 } else { oldest.saturating_sub(self.expected) };
        if lost == 0 {
            return Ok(Delivery::Incomplete);
        }
        self.give_up(lost);
        Ok(Delivery::Lost(header.source, lost))
    }

    pub(super) fn check_freshness(&self, header: &PacketHeader) -> Result<(), SinkDrop> {
        let floor = match (header.to, header.seq) {
            (Some(_), 0) => return Ok(()),
            (Some(_), _) => self.oldest,
            (None, _) => self.next.max(1),
        };
        if header.seq < floor {
            return Err(SinkDrop::BelowFloor);
        }
        if self.recovers && !self.begins_anew() && header.seq < self.expected {
            return Err(SinkDrop::Replayed);
        }
        match self.window.check(header.seq) {
            // As in DDS: best-effort messages come in order or not at all.
            Freshness::Fresh if !header.reliable && header.to.is_none() && header.seq < self.expected => {
                Err(SinkDrop::Late)
            }
            Freshness::Fresh => Ok(()),
            Freshness::Duplicate | Freshness::TooOld => Err(SinkDrop::Replayed),
        }
    }

    /// Derives the key for a packet if it is not here yet: one for each epoch, and one more for packets to this sink.
    pub(super) fn derive_key(
        &mut self,
        grant: &TopicGrant,
        name: &Name,
        header: &PacketHeader,
    ) -> Result<(), OpenError> {
        if header.to.is_some() {
            if self.addressed.as_ref().is_none_or(|key| key.epoch() != header.epoch) {
                self.addressed = Some(derive(grant, name, header)?);
            }
        } else if self.keys.iter().all(|key| key.epoch() != header.epoch) {
            self.keys.push(derive(grant, name, header)?);
        }
        Ok(())
    }
}

/// Returns the oldest number that the source of a mark could send again.
pub(super) fn oldest_of_mark(header: &PacketHeader, text: &[u8]) -> Result<u64, SinkDrop> {
    let oldest = text.try_into().map(u64::from_be_bytes).map_err(|_| SinkDrop::Head)?;
    if oldest > header.seq { Err(SinkDrop::Head) } else { Ok(oldest) }
}

/// Derives the key of a packet from its header.
pub(super) fn derive(grant: &TopicGrant, name: &Name, header: &PacketHeader) -> Result<SourceKey, OpenError> {
    let key = match &header.to {
        Some(sink) => SourceKey::derive_addressed(grant, name, &header.source, sink),
        None => SourceKey::derive(grant, name, &header.source),
    };
    key.ok_or(OpenError::Suite { found: grant.suite })
}

/// Verifies a packet that opened.
pub(super) fn verify(
    verifier: &mut Option<BatchVerifier>,
    announced_key: &Bytes,
    suite: Suite,
    header: &PacketHeader,
    payload: &[u8],
) -> Result<(), OpenError> {
    if verifier.is_none() {
        *verifier = BatchVerifier::new(suite, announced_key);
    }
    // A source with an unusable key has signed nothing.
    verifier.as_mut().ok_or(OpenError::Signature)?.verify(header, payload)
}
