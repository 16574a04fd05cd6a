//! One publisher under one name: numbers messages, cuts and seals them, proves that they are its own, and keeps those
//! that late joiners and sinks with losses may ask for.
//!
//! A payload is read once, from its place into the leaving packets; fragments of a large message leave before its end
//! is read. The endpoint decides who may receive it, and when its epoch ends.

use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering::Acquire, Ordering::Release};

use bytes::{Bytes, BytesMut};
use sgc_trust::{
    Batch, MacKey, MessageKey, SourceKey, Suite, mac_trailer_bytes, put_macs, sealed_bytes, trailer_bytes_max,
};
use sgc_wire::{
    Class, HOP_LIMIT, MESSAGE_BYTES_MAX, MessageHead, MessageKind, Name, Packet, PacketHeader, ReceiverKey,
    SinkId, Slab, SourceAnnounce, SourceId, TopicGrant,
};

use crate::history::{History, HistoryEntry, RecoveryLimits};
use crate::receivers::{ReceiverList, Receivers};

/// Bytes of message in one packet.
pub const FRAGMENT_BYTES: u16 = 16 * 1024;
/// Most messages of one source. At a million a second it lasts nine years; a new source id begins anew.
pub const SOURCE_MESSAGES_MAX: u64 = 1 << 48;

/// Parameters of a source.
#[derive(Clone, Debug)]
pub struct SourceConfig {
    /// The name it publishes under.
    pub name: Name,
    /// Its random id.
    pub id: SourceId,
    /// Class of its packets.
    pub class: Class,
    /// Whether full queues push back and lost packets are sent again.
    pub reliable: bool,
    /// Messages kept for late joiners; 0 for a volatile topic.
    pub history_depth: usize,
    /// Bytes kept for late joiners.
    pub history_bytes_max: usize,
    /// Bounds of messages kept beyond that for recovery; of reliable sources only.
    pub recovery: RecoveryLimits,
    /// The receivers, if this node has their keys: a `pairwise` suite then needs no signature while they are few.
    pub receivers: Option<Arc<Receivers>>,
}

/// The reason why a message was not published.
#[derive(Clone, Copy, Debug, PartialEq, Eq, thiserror::Error)]
pub enum PublishError {
    /// Larger than any sink accepts.
    #[error("a message of {bytes} bytes exceeds the {MESSAGE_BYTES_MAX} that can be carried")]
    TooLarge {
        /// Its length.
        bytes: usize,
    },
    /// The source has used all its numbers; publishing continues with a source of another id.
    #[error("a source carries at most {SOURCE_MESSAGES_MAX} messages")]
    Exhausted,
    /// A message for one sink would be kept for others.
    #[error("a source that keeps messages has none for one sink alone")]
    Keeps,
}

/// Progress of a source, readable without its lock.
#[derive(Debug)]
pub struct SourceProgress {
    source: SourceId,
    key: Bytes,
    /// Whether lost messages can be asked for.
    recovers: bool,
    /// The number of its first message.
    first: u64,
    next: AtomicU64,
    oldest: AtomicU64,
    /// The last number that is no mark.
    last_message: AtomicU64,
    /// Messages published before the present epoch.
    epoch_start: AtomicU64,
    signatures: AtomicU64,
}

impl SourceProgress {
    /// Returns the source with its present floors, for the owner's grant.
    pub fn announce(&self) -> SourceAnnounce {
        // Both only grow, `next` first: read the other way round, the oldest is never beyond the next.
        let oldest = self.oldest.load(Acquire);
        let next = self.next.load(Acquire);
        let recover = if self.recovers { self.first } else { 0 };
        SourceAnnounce { source: self.source, key: self.key.clone(), oldest, next, recover }
    }

    /// Id of the source.
    pub fn id(&self) -> SourceId {
        self.source
    }

    /// Returns the key that verifies its messages; empty if the suite has no signatures.
    pub fn key(&self) -> &Bytes {
        &self.key
    }

    /// Returns `true` if the source can send lost messages again.
    pub fn recovers(&self) -> bool {
        self.recovers
    }

    /// Returns the number of published messages and marks.
    pub fn published(&self) -> u64 {
        self.next.load(Acquire).saturating_sub(self.first)
    }

    /// Returns the number of the last message that is no mark: a larger one ends a silence.
    pub fn last_message(&self) -> u64 {
        self.last_message.load(Acquire)
    }

    /// Returns the messages published in the present epoch; many require a new one.
    pub fn published_in_epoch(&self) -> u64 {
        let start = self.epoch_start.load(Acquire);
        self.published().saturating_sub(start)
    }

    /// Returns the number of signatures: one for each batch.
    pub fn signatures(&self) -> u64 {
        self.signatures.load(Acquire)
    }
}

/// A publisher.
pub struct Source {
    config: SourceConfig,
    suite: Suite,
    /// The present epoch, for deriving keys; without the lists of its grant.
    grant: TopicGrant,
    key: SourceKey,
    message_key: MessageKey,
    seq: u64,
    batch: Batch,
    /// The packets of `batch`, sealed and not signed.
    unsigned: Vec<(PacketHeader, BytesMut)>,
    /// The keys of MACs in packets to all, and the receivers that they are for.
    macs: Vec<MacKey>,
    listed: Vec<Arc<ReceiverKey>>,
    slab: Slab,
    history: History,
    progress: Arc<SourceProgress>,
}

/// The proof that the packets of a message carry.
enum Proof {
    /// None: members trust each other.
    None,
    /// A MAC for each receiver, under [`Source::macs`].
    Macs,
    /// A MAC for the one receiver.
    Mac(Box<MacKey>),
    /// The signature of their batch.
    Signature,
}

impl Source {
    /// Makes a source that starts at message 1; `None` if the grant's suite is not in this build, or the key does not
    /// fit it. Sources may share a key.
    ///
    /// Never make two sources under one id with one topic key: their nonces would repeat.
    pub fn new(config: SourceConfig, grant: &TopicGrant, message_key: MessageKey) -> Option<Self> {
        Self::from_number(1, config, grant, message_key)
    }

    /// Does the same for a publisher of which this node may not have heard the first messages: the source starts at
    /// message 2. So a receiver knows of which publishers message 1 is the first one that there ever was.
    pub fn midway(config: SourceConfig, grant: &TopicGrant, message_key: MessageKey) -> Option<Self> {
        Self::from_number(2, config, grant, message_key)
    }

    fn from_number(
        first: u64,
        config: SourceConfig,
        grant: &TopicGrant,
        message_key: MessageKey,
    ) -> Option<Self> {
        let key = SourceKey::derive(grant, &config.name, &config.id)?;
        let suite = key.suite();
        if !message_key.fits(suite) {
            return None;
        }
        let progress = SourceProgress {
            source: config.id,
            key: message_key.public().clone(),
            recovers: config.reliable && config.recovery.messages_max > 0,
            first,
            next: AtomicU64::new(first),
            oldest: AtomicU64::new(first),
            last_message: AtomicU64::new(0),
            epoch_start: AtomicU64::new(0),
            signatures: AtomicU64::new(0),
        };
        let recovery = if progress.recovers { config.recovery } else { RecoveryLimits::NONE };
        let history = History::new(first, config.history_depth, config.history_bytes_max, recovery);
        Some(Self {
            config,
            suite,
            grant: without_lists(grant),
            key,
            message_key,
            seq: first - 1,
            batch: Batch::default(),
            unsigned: Vec::new(),
            macs: Vec::new(),
            listed: Vec::new(),
            slab: Slab::default(),
            history,
            progress: Arc::new(progress),
        })
    }

    /// Seals later messages in a new epoch, after the packets that wait for a signature. Returns `false`, and does
    /// nothing, unless the epoch is later than the present one and of the same suite.
    #[must_use]
    pub fn rekey(&mut self, grant: &TopicGrant, emit: impl FnMut(Packet)) -> bool {
        if grant.epoch <= self.grant.epoch || grant.suite != self.grant.suite {
            return false;
        }
        let Some(key) = SourceKey::derive(grant, &self.config.name, &self.config.id) else { return false };
        self.flush(emit);
        self.listed.clear();
        self.macs.clear();
        self.key = key;
        self.grant = without_lists(grant);
        self.progress.epoch_start.store(self.progress.published(), Release);
        true
    }

    /// Seals one message and hands its packets to `emit` in order.
    ///
    /// With `more` the caller promises to publish again at once, or to call [`Self::flush`]: packets may then wait for
    /// the next ones, and share a signature with them. Without it nothing waits.
    pub fn publish(
        &mut self,
        head: &MessageHead,
        payload: Bytes,
        more: bool,
        mut emit: impl FnMut(Packet),
    ) -> Result<(), PublishError> {
        let result = self.seal_message(head, payload, &mut emit);
        if !more {
            self.flush(emit);
        }
        result
    }

    /// Seals one message for one sink alone and hands its packets to `emit` in order; for a source without history. The
    /// message has a number like any other: so no nonce is used twice, and the sink takes it once.
    pub fn publish_to(
        &mut self,
        sink: SinkId,
        head: &MessageHead,
        payload: Bytes,
        mut emit: impl FnMut(Packet),
    ) -> Result<(), PublishError> {
        if self.config.history_depth > 0 || self.progress.recovers {
            return Err(PublishError::Keeps);
        }
        self.flush(&mut emit);
        let key = SourceKey::derive_addressed(&self.grant, &self.config.name, &self.config.id, &sink);
        // The suite was in this build when the source was made.
        let Some(key) = key else { return Ok(()) };
        let seq = self.next_number(&payload)?;
        let proof = self.choose_proof(Some(sink));
        self.seal_fragments(Some(&key), &proof, seq, head, &payload, &mut emit);
        self.keep(HistoryEntry { seq, head: *head, payload });
        self.flush(emit);
        Ok(())
    }

    /// Signs and hands over the packets that wait for a signature.
    pub fn flush(&mut self, mut emit: impl FnMut(Packet)) {
        if self.batch.is_empty() {
            return;
        }
        let signed = self.batch.sign(&self.message_key);
        self.progress.signatures.fetch_add(1, Release);
        for (index, (header, mut payload)) in self.unsigned.drain(..).enumerate() {
            signed.put_trailer(self.suite, index, &mut payload);
            emit(Packet { header, payload: payload.freeze().into() });
        }
        self.batch.reuse(signed);
    }

    /// Numbers and keeps one message that nobody listens to, without sealing it: a sink whose route to this source is
    /// not complete will ask for it.
    pub fn record(&mut self, head: &MessageHead, payload: Bytes) -> Result<(), PublishError> {
        let seq = self.next_number(&payload)?;
        self.keep(HistoryEntry { seq, head: *head, payload });
        Ok(())
    }

    /// Tells all sinks the last number, so that those that missed it notice; nothing if no message could be asked for.
    pub fn mark(&mut self, emit: impl FnMut(Packet)) {
        self.publish_mark(&MessageHead::new(MessageKind::Mark, 0), emit);
    }

    /// Does the same as [`Self::mark`], and asks all sinks to confirm that they have everything up to there.
    pub fn ask_for_confirmation(&mut self, emit: impl FnMut(Packet)) {
        self.publish_mark(&MessageHead::for_confirmation(), emit);
    }

    fn publish_mark(&mut self, head: &MessageHead, mut emit: impl FnMut(Packet)) {
        self.flush(&mut emit);
        if !self.progress.recovers || self.progress.published() == 0 || self.seq >= SOURCE_MESSAGES_MAX {
            return;
        }
        self.seal_mark(head, &mut emit);
        self.flush(emit);
    }

    /// Tells all sinks, by a mark, that a publisher asserted its liveliness. The source keeps nothing, so that
    /// assertions take no place of messages.
    ///
    /// # Errors
    /// [`PublishError::Keeps`] if this source keeps messages, [`PublishError::Exhausted`] if it has no number left.
    pub fn assert_publisher(
        &mut self,
        publisher: [u8; 8],
        mut emit: impl FnMut(Packet),
    ) -> Result<(), PublishError> {
        if self.config.history_depth > 0 || self.progress.recovers {
            return Err(PublishError::Keeps);
        }
        let seq = self.next_number(&Bytes::new())?;
        let (head, payload) =
            (MessageHead::for_assertion(publisher), Bytes::copy_from_slice(&seq.to_be_bytes()));
        let proof = self.choose_proof(None);
        self.seal_fragments(None, &proof, seq, &head, &payload, &mut emit);
        self.keep(HistoryEntry { seq, head, payload });
        self.flush(emit);
        Ok(())
    }

    /// Hands the kept messages `from..=to` to `emit`, sealed for one sink in the present epoch, and then the sign of
    /// their end. Waiting packets leave before. From 0 it is the history for late joiners; if the first requested
    /// message is gone, a mark about that goes ahead.
    pub fn replay(&mut self, sink: SinkId, from: u64, to: u64, mut emit: impl FnMut(Packet)) {
        self.flush(&mut emit);
        let Some(key) = SourceKey::derive_addressed(&self.grant, &self.config.name, &self.config.id, &sink)
        else {
            return;
        };
        let gone = from > 0 && from < self.history.oldest() && self.progress.recovers;
        if gone && self.history.newest().is_none_or(|m| !m.is_mark()) && self.seq < SOURCE_MESSAGES_MAX {
            self.seal_mark(&MessageHead::new(MessageKind::Mark, 0), &mut emit);
        }
        let mark = self.history.newest().filter(|m| gone && m.is_mark()).map(|m| m.seq);
        let from = if from == 0 { self.history.late_from() } else { from };
        // Clones of references, so that the history can be read while packets are put aside for signing.
        let ahead = mark.into_iter().flat_map(|seq| self.history.range(seq, seq));
        let asked: Vec<_> = ahead.chain(self.history.range(from, to)).collect();
        let proof = self.choose_proof(Some(sink));
        for (seq, head, payload) in asked {
            self.seal_fragments(Some(&key), &proof, seq, &head, &payload, &mut emit);
        }
        let head = MessageHead::new(MessageKind::Synced, 0);
        self.seal_fragments(Some(&key), &proof, 0, &head, &[], &mut emit);
        self.flush(emit);
    }

    /// Drops messages dated before `ns`, nanoseconds since the Unix epoch: their lifespan is over, and nobody gets them
    /// any more.
    pub fn expire(&mut self, ns: i64) {
        self.history.expire(ns);
        self.progress.oldest.store(self.history.late_from(), Release);
    }

    /// Sets the number of messages kept for late joiners, if the source keeps any.
    pub fn set_history_depth(&mut self, depth: usize) {
        self.history.set_depth(depth);
        self.progress.oldest.store(self.history.late_from(), Release);
    }

    /// Returns its id.
    pub fn id(&self) -> SourceId {
        self.config.id
    }

    /// Returns the number of published messages and marks.
    pub fn published(&self) -> u64 {
        self.seq
    }

    /// Returns the epoch in which it seals.
    pub fn epoch(&self) -> u32 {
        self.grant.epoch
    }

    /// Returns the messages published in the present epoch; many require a new one.
    pub fn published_in_epoch(&self) -> u64 {
        self.progress.published_in_epoch()
    }

    /// Returns the source with its present floors, for the owner's grant.
    pub fn announce(&self) -> SourceAnnounce {
        self.progress.announce()
    }

    /// Returns its progress, to be read while another thread publishes.
    pub fn progress(&self) -> Arc<SourceProgress> {
        self.progress.clone()
    }

    fn seal_message(
        &mut self,
        head: &MessageHead,
        payload: Bytes,
        emit: &mut impl FnMut(Packet),
    ) -> Result<(), PublishError> {
        let seq = self.next_number(&payload)?;
        let proof = self.choose_proof(None);
        self.seal_fragments(None, &proof, seq, head, &payload, emit);
        self.keep(HistoryEntry { seq, head: *head, payload });
        Ok(())
    }

    /// Publishes a mark; the caller has room for its number.
    fn seal_mark(&mut self, head: &MessageHead, emit: &mut impl FnMut(Packet)) {
        self.seq += 1;
        // The mark's own place in the history may be that of the oldest message: it reports the state after that.
        self.keep(HistoryEntry { seq: self.seq, head: *head, payload: Bytes::from_static(&[0; 8]) });
        let payload = Bytes::copy_from_slice(&self.history.oldest().to_be_bytes());
        if let Some(mark) = self.history.newest_mut() {
            mark.payload = payload.clone();
        }
        let proof = self.choose_proof(None);
        self.seal_fragments(None, &proof, self.seq, head, &payload, emit);
    }

    fn next_number(&mut self, payload: &Bytes) -> Result<u64, PublishError> {
        if payload.len() > MESSAGE_BYTES_MAX as usize {
            return Err(PublishError::TooLarge { bytes: payload.len() });
        }
        if self.seq >= SOURCE_MESSAGES_MAX {
            return Err(PublishError::Exhausted);
        }
        self.seq += 1;
        Ok(self.seq)
    }

    fn keep(&mut self, message: HistoryEntry) {
        let (seq, is_mark) = (message.seq, message.is_mark());
        self.history.push(message);
        // The order matters: a message that is announced as past may be asked for at once.
        self.progress.next.store(seq + 1, Release);
        self.progress.oldest.store(self.history.late_from(), Release);
        if !is_mark {
            self.progress.last_message.store(seq, Release);
        }
    }

    /// Seals a message under the key for all, or the one for a sink, with the proof [chosen](Self::choose_proof) for
    /// it.
    fn seal_fragments(
        &mut self,
        addressed: Option<&SourceKey>,
        proof: &Proof,
        seq: u64,
        head: &MessageHead,
        payload: &[u8],
        emit: &mut impl FnMut(Packet),
    ) {
        let fragments = payload.len().div_ceil(FRAGMENT_BYTES.into()).max(1);
        let trailer_bytes = match proof {
            Proof::None => 0,
            Proof::Macs => mac_trailer_bytes(self.macs.len()),
            Proof::Mac(_) => mac_trailer_bytes(1),
            Proof::Signature => trailer_bytes_max(self.suite),
        };
        if matches!(proof, Proof::Macs | Proof::Mac(_)) {
            // Packets leave in the order of their numbers, also if the last ones have a signature.
            self.flush(&mut *emit);
        }
        for index in 0..fragments {
            let key = addressed.unwrap_or(&self.key);
            let header = PacketHeader {
                reliable: self.config.reliable,
                class: self.config.class,
                hops: HOP_LIMIT,
                suite: self.suite.id(),
                epoch: key.epoch(),
                name: self.config.name,
                source: self.config.id,
                seq,
                total: payload.len() as u32,
                index: index as u16,
                grid: FRAGMENT_BYTES,
                to: key.to(),
            };
            let start = index * usize::from(FRAGMENT_BYTES);
            let fragment = &payload[start..start + header.fragment_bytes()];
            let bytes = sealed_bytes(&header);
            let mut sealed = self.slab.room(bytes + trailer_bytes);
            sealed.resize(bytes, 0);
            key.seal(&header, head, fragment, &mut sealed);
            match proof {
                Proof::None => {}
                Proof::Macs => put_macs(&header, &mut sealed, &self.macs),
                Proof::Mac(key) => put_macs(&header, &mut sealed, std::slice::from_ref(&**key)),
                Proof::Signature => {
                    self.batch.push(&header, &sealed);
                    self.unsigned.push((header, sealed));
                    if self.batch.is_full() {
                        self.flush(&mut *emit);
                    }
                    continue;
                }
            }
            emit(Packet { header, payload: sealed.freeze().into() });
        }
    }

    /// Chooses the proof of a message to all or to one sink.
    fn choose_proof(&mut self, to: Option<SinkId>) -> Proof {
        if !self.suite.is_signed() {
            return Proof::None;
        }
        let Some(receivers) = self.config.receivers.as_ref().filter(|_| self.suite.is_pairwise()) else {
            return Proof::Signature;
        };
        let SourceConfig { name, id, .. } = &self.config;
        let derive = |key: &ReceiverKey| MacKey::derive(key, &self.grant, name, id, to.as_ref());
        if let Some(sink) = &to {
            let key = receivers.key_of(sink).and_then(|key| derive(&key));
            return key.map_or(Proof::Signature, |key| Proof::Mac(Box::new(key)));
        }
        match receivers.update(&mut self.listed) {
            ReceiverList::TooMany => return Proof::Signature,
            ReceiverList::Unchanged => {}
            ReceiverList::Changed => self.macs = self.listed.iter().filter_map(|key| derive(key)).collect(),
        }
        Proof::Macs
    }
}

/// Returns the part of a grant from which keys are derived.
pub(crate) fn without_lists(grant: &TopicGrant) -> TopicGrant {
    let TopicGrant { epoch, suite, key, receiver, .. } = grant;
    TopicGrant {
        epoch: *epoch,
        suite: *suite,
        key: key.clone(),
        receiver: receiver.clone(),
        sources: Vec::new(),
        entry: None,
    }
}
