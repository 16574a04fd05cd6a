//! [`SourceState`]: one announced source of a sink, with its keys, its numbers, and what is missing of it.

use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering::Release};

use bytes::Bytes;
use sgc_trust::{BatchVerifier, Freshness, MacKey, OpenError, ReplayWindow, SourceKey, Suite, has_macs};
use sgc_wire::{MessageHead, Name, PacketHeader, SourceAnnounce, SourceId, TopicGrant};

use super::delivery::{AskAgain, Delivery, SinkDrop};
use super::open_buffer::OpenBuffer;
use super::partial::Partials;
use crate::receivers::Receivers;

/// An announced source.
pub(super) struct SourceState {
    /// The announced key of its signatures; parsed when the first packet opens.
    announced_key: Bytes,
    verifier: Option<BatchVerifier>,
    /// Keys for packets to all, by epoch.
    keys: Vec<KeyPair>,
    /// The keys for packets to this sink, of the epoch seen last.
    addressed: Option<KeyPair>,
    window: ReplayWindow,
    /// The window's newest, for [`SinkProgress`].
    newest: Arc<AtomicU64>,
    /// Lower numbers to all are replays from before this sink was told of the source.
    next: u64,
    /// This sink did not ask for lower numbers.
    oldest: u64,
    /// Whether lost messages can be asked for: then messages are delivered in the order of their numbers.
    recovers: bool,
    /// The next number: of a source with recovery all lower ones are done, of another it is one more than the newest.
    expected: u64,
    partials: Partials,
    sync: SyncState,
    answer: AnswerState,
    /// The last epoch of the source, if the newest grant no longer announces it.
    last_epoch: Option<u32>,
}

/// The keys of packets in one epoch.
struct KeyPair {
    seal: SourceKey,
    /// The key of MACs for this node; derived when a packet with MACs has opened, because anybody can send others.
    mac: Option<MacKey>,
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

    /// Notes that a grant no longer announces the source: packets of later epochs than `epoch` do not count.
    pub(super) fn end_after(&mut self, epoch: u32) {
        self.last_epoch = self.last_epoch.or(Some(epoch));
    }

    /// Returns `true` if the newest grant announces the source.
    pub(super) fn is_announced(&self) -> bool {
        self.last_epoch.is_none()
    }

    /// Returns `true` if packets of this epoch count.
    pub(super) fn counts_in(&self, epoch: u32) -> bool {
        self.last_epoch.is_none_or(|last| epoch <= last)
    }

    /// Returns `true` if lost messages can be asked for.
    pub(super) fn recovers(&self) -> bool {
        self.recovers
    }

    /// Returns the greatest delivered number, which changes as messages are delivered.
    pub(super) fn progress(&self) -> Arc<AtomicU64> {
        self.newest.clone()
    }

    /// Returns `true` if both sources sign with the same key.
    pub(super) fn has_key_of(&self, other: &Self) -> bool {
        self.announced_key == other.announced_key
    }

    /// Returns the number of checked signatures.
    pub(super) fn signatures_checked(&self) -> u64 {
        self.verifier.as_ref().map_or(0, BatchVerifier::signatures_checked)
    }

    /// Drops the keys of earlier epochs than `oldest`.
    pub(super) fn drop_keys_before(&mut self, oldest: u32) {
        self.keys.retain(|key| key.seal.epoch() >= oldest);
        self.addressed = self.addressed.take().filter(|key| key.seal.epoch() >= oldest);
    }

    /// Notes that a message was not handed over: it must be asked for, if it can be.
    pub(super) fn suspect(&mut self) {
        if self.recovers && self.is_announced() {
            self.unsync();
        }
    }

    /// Notes that messages below `next` came on another route: those that did not arrive must be asked for, if they can
    /// be.
    pub(super) fn miss_below(&mut self, next: u64, transient_local: bool) {
        if self.expected < next && (self.recovers || transient_local) {
            self.unsync();
        }
    }

    /// Forgets the delivered numbers. A transient-local sink asks for the history once more; other earlier messages
    /// stay past.
    pub(super) fn forget(&mut self, transient_local: bool) {
        self.next = self.next.max(self.window.newest().saturating_add(1));
        self.window = ReplayWindow::default();
        if transient_local {
            self.restart();
        }
    }

    /// Notes that messages are missing from here on.
    fn unsync(&mut self) {
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
    fn restart(&mut self) {
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

    /// Notes that a message is delivered. Returns the number of incomplete messages that are given up for it.
    pub(super) fn complete(&mut self, header: &PacketHeader) -> u64 {
        self.done(header.seq);
        // A reliable flow is in order: older incomplete messages will never be complete.
        if header.reliable { self.partials.give_up(header.seq) } else { 0 }
    }

    /// Returns the place of a fragment in its message, to be opened into directly.
    pub(super) fn place(&mut self, header: &PacketHeader) -> Option<&mut [u8]> {
        self.partials.place(header)
    }

    /// Returns `true` if a fragment of the message is here.
    pub(super) fn has_begun(&self, seq: u64) -> bool {
        self.partials.has_begun(seq)
    }

    /// Takes a fragment as [`Partials::put`] does.
    pub(super) fn put_fragment(
        &mut self,
        header: &PacketHeader,
        head: Option<MessageHead>,
        fragment: Option<&[u8]>,
        max: usize,
    ) -> Result<(Option<(MessageHead, Bytes)>, u64), SinkDrop> {
        self.partials.put(header, head, fragment, max)
    }

    /// Returns the memory of incomplete messages.
    pub(super) fn partial_bytes(&self) -> usize {
        self.partials.bytes()
    }

    /// Gives up the oldest incomplete message, and returns its memory, 0 if there is none.
    pub(super) fn give_up_oldest_partial(&mut self) -> usize {
        self.partials.give_up_oldest()
    }

    /// Gives up the next numbers, which will never come.
    fn give_up(&mut self, numbers: u64) {
        if numbers > 0 {
            self.expected += numbers;
            self.partials.clear();
        }
    }

    /// Takes a mark; each has its number. A mark ahead of an answer reports messages that are lost for good.
    pub(super) fn take_mark(
        &mut self,
        header: &PacketHeader,
        head: &MessageHead,
        text: &[u8],
    ) -> Result<Delivery, SinkDrop> {
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
            let is_asked = self.recovers && head.asks_for_confirmation();
            return Ok(if is_asked { Delivery::Confirm(header.source, header.seq) } else { Delivery::Mark });
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
            if self.addressed.as_ref().is_none_or(|key| key.seal.epoch() != header.epoch) {
                self.addressed = Some(KeyPair { seal: derive(grant, name, header)?, mac: None });
            }
        } else if self.keys.iter().all(|key| key.seal.epoch() != header.epoch) {
            self.keys.push(KeyPair { seal: derive(grant, name, header)?, mac: None });
        }
        Ok(())
    }

    /// Opens a packet, whose key is [derived](Self::derive_key), into the buffer, and verifies its proof if the suite
    /// has any.
    pub(super) fn open(
        &mut self,
        suite: Suite,
        grant: &TopicGrant,
        callers: Option<&Receivers>,
        header: &PacketHeader,
        payload: &[u8],
        opened: &mut OpenBuffer,
    ) -> Result<(), OpenError> {
        let pair = if header.to.is_some() {
            self.addressed.as_mut()
        } else {
            self.keys.iter_mut().find(|key| key.seal.epoch() == header.epoch)
        };
        let pair = pair.ok_or(OpenError::Epoch { found: header.epoch })?;
        let out = match opened {
            OpenBuffer::Whole(text) => &mut text[..],
            OpenBuffer::Aside(text) => &mut text[..],
            OpenBuffer::InPlace => self.partials.place(header).unwrap_or_default(),
        };
        pair.seal.open(header, payload, out)?;
        if !suite.is_signed() {
            return Ok(());
        }
        if suite.is_pairwise() && has_macs(header, payload)? {
            return pair.check_mac(grant, callers, header, payload);
        }
        self.verify(suite, header, payload)
    }

    /// Verifies the signature of a packet that opened.
    fn verify(&mut self, suite: Suite, header: &PacketHeader, payload: &[u8]) -> Result<(), OpenError> {
        if self.verifier.is_none() {
            self.verifier = BatchVerifier::new(suite, &self.announced_key);
        }
        // A source with an unusable key has signed nothing.
        self.verifier.as_mut().ok_or(OpenError::Signature)?.verify(header, payload)
    }
}

impl KeyPair {
    /// Checks the MAC for this node in a packet that opened. The key is that of the grant, or at the owner of a service
    /// that of the calling node.
    fn check_mac(
        &mut self,
        grant: &TopicGrant,
        callers: Option<&Receivers>,
        header: &PacketHeader,
        payload: &[u8],
    ) -> Result<(), OpenError> {
        if self.mac.is_none() {
            let caller = callers.and_then(|callers| callers.key_of_caller(&header.source));
            let receiver = grant.receiver.as_ref().or(caller.as_deref()).ok_or(OpenError::NoMac)?;
            self.mac = MacKey::derive(receiver, grant, &header.name, &header.source, header.to.as_ref());
        }
        self.mac.as_ref().ok_or(OpenError::Suite { found: grant.suite })?.check(header, payload)
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
