//! One subscriber of one name: opens packets, puts messages together, and delivers each once.
//!
//! Nothing is allocated on the word of a header: the packet that claims a size must open first.

use std::collections::{BTreeMap, VecDeque};

use bytes::Bytes;
use sgc_trust::{Freshness, OpenError, ReplayWindow, SourceKey, opened_bytes};
use sgc_wire::{
    Decode, MESSAGE_HEAD_BYTES, MessageHead, MessageKind, Name, Packet, PacketHeader, SourceId, TopicGrant,
};

/// Bounds of one sink.
#[derive(Clone, Debug)]
pub struct SinkLimits {
    /// Sources remembered; beyond it the one idle for longest is forgotten.
    pub sources_max: usize,
    /// Messages of one source that may be incomplete at once.
    pub partials_per_source_max: usize,
    /// Bytes of incomplete messages over all sources.
    pub partial_bytes_max: usize,
}

impl Default for SinkLimits {
    fn default() -> Self {
        Self { sources_max: 256, partials_per_source_max: 4, partial_bytes_max: 128 * 1024 * 1024 }
    }
}

/// A complete message.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Message {
    /// Who published it.
    pub source: SourceId,
    /// Its number at the source.
    pub seq: u64,
    /// What it is and when it was published.
    pub head: MessageHead,
    /// The payload, as it was published.
    pub payload: Bytes,
}

/// What a packet came to.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum Delivery {
    /// It completed a message.
    Message(Message),
    /// More fragments are needed.
    Incomplete,
    /// The source's history must be asked for before its messages can be delivered.
    NeedsHistory(SourceId),
    /// The source's history is complete.
    Synced(SourceId),
}

/// Why a packet was dropped.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, thiserror::Error)]
pub enum SinkDrop {
    /// It could not be opened.
    #[error(transparent)]
    Open(#[from] OpenError),
    /// The message was delivered before, or is too old to tell.
    #[error("message delivered before")]
    Replayed,
    /// The fragment was received before.
    #[error("fragment received before")]
    DuplicateFragment,
    /// The fragment contradicts an earlier one of the same message.
    #[error("fragment contradicts its message")]
    Inconsistent,
    /// The message's head is malformed.
    #[error("message head malformed")]
    Head,
    /// The history of its source has not arrived yet, and will contain it.
    #[error("awaiting the history that contains it")]
    AwaitingHistory,
    /// The bound on incomplete messages is reached.
    #[error("too many incomplete messages")]
    PartialsFull,
}

impl SinkDrop {
    /// A short, stable name for counters.
    pub fn key(&self) -> &'static str {
        match self {
            Self::Open(OpenError::Suite { .. }) => "sink_suite",
            Self::Open(OpenError::Epoch { .. }) => "sink_epoch",
            Self::Open(OpenError::Length) => "sink_length",
            Self::Open(OpenError::Forged) => "sink_forged",
            Self::Replayed => "sink_replayed",
            Self::DuplicateFragment => "sink_duplicate_fragment",
            Self::Inconsistent => "sink_inconsistent",
            Self::Head => "sink_head",
            Self::AwaitingHistory => "sink_awaiting_history",
            Self::PartialsFull => "sink_partials_full",
        }
    }
}

struct Partial {
    seq: u64,
    header: PacketHeader,
    head: Option<MessageHead>,
    message: Vec<u8>,
    have: Vec<u64>,
    missing: u32,
}

struct SourceState {
    key: SourceKey,
    window: ReplayWindow,
    partials: VecDeque<Partial>,
    /// False while a transient-local source's history has been asked for and is not here yet.
    synced: bool,
    used: u64,
}

/// A subscriber.
pub struct Sink {
    name: Name,
    grant: TopicGrant,
    transient_local: bool,
    limits: SinkLimits,
    sources: BTreeMap<SourceId, SourceState>,
    clock: u64,
    incomplete: u64,
    scratch: Vec<u8>,
}

impl Sink {
    /// A sink with the granted key. A transient-local one takes each source's history before anything else.
    pub fn new(name: Name, grant: TopicGrant, transient_local: bool, limits: SinkLimits) -> Self {
        Self {
            name,
            grant,
            transient_local,
            limits,
            sources: BTreeMap::new(),
            clock: 0,
            incomplete: 0,
            scratch: Vec::new(),
        }
    }

    /// Takes a new grant. With the same key (the way to the owner changed) what was delivered is remembered and
    /// histories are asked for again; with another one (the owner started anew) all sources are new.
    pub fn regrant(&mut self, grant: TopicGrant) {
        if grant == self.grant {
            for source in self.sources.values_mut() {
                source.synced = !self.transient_local;
                source.partials.clear();
            }
        } else {
            self.sources.clear();
            self.grant = grant;
        }
    }

    /// The sources whose history has not arrived yet.
    pub fn unsynced(&self) -> impl Iterator<Item = SourceId> + '_ {
        self.sources.iter().filter(|(_, s)| !s.synced).map(|(id, _)| *id)
    }

    /// Makes a source known before its first packet; true if its history must be asked for.
    pub fn expect(&mut self, source: SourceId) -> bool {
        self.transient_local && self.source(source).is_ok_and(|s| !s.synced)
    }

    /// Forgets a source that is gone.
    pub fn forget(&mut self, source: &SourceId) {
        self.sources.remove(source);
    }

    /// Messages given up because a newer one was complete first, or for want of room.
    pub fn incomplete(&self) -> u64 {
        self.incomplete
    }

    /// Takes a packet.
    pub fn handle_packet(&mut self, packet: &Packet) -> Result<Delivery, SinkDrop> {
        let header = &packet.header;
        debug_assert_eq!(header.name, self.name);
        // Only what opens may make a source known, or any packet could push out a good one.
        let known = self.sources.contains_key(&header.source);
        let fresh_key;
        let key = match self.sources.get(&header.source) {
            Some(state) => {
                if header.seq != 0 && state.window.check(header.seq) != Freshness::Fresh {
                    return Err(SinkDrop::Replayed);
                }
                &state.key
            }
            None => {
                fresh_key = SourceKey::derive(&self.grant, &self.name, &header.source)
                    .ok_or(OpenError::Suite { found: self.grant.suite })?;
                &fresh_key
            }
        };
        let mut opened = std::mem::take(&mut self.scratch);
        opened.clear();
        opened.resize(opened_bytes(header), 0);
        let result = match &packet.payload.0[..] {
            [one] => key.open(header, one, &mut opened),
            _ => {
                let mut joined = Vec::with_capacity(packet.payload.len());
                packet.payload.copy_into(&mut joined);
                key.open(header, &joined, &mut opened)
            }
        };
        if let Err(error) = result {
            self.scratch = opened;
            return Err(error.into());
        }
        let delivery = if !known && self.transient_local && header.to.is_none() {
            self.source(header.source).map(|_| Delivery::NeedsHistory(header.source))
        } else {
            self.accept(header, &mut opened)
        };
        self.scratch = opened;
        delivery
    }

    /// Takes what a packet opened to: fragment, and behind the first one the head.
    fn accept(&mut self, header: &PacketHeader, opened: &mut Vec<u8>) -> Result<Delivery, SinkDrop> {
        let head = match header.index {
            0 => {
                let at = opened.len() - MESSAGE_HEAD_BYTES;
                let head = MessageHead::from_slice(&opened[at..]).map_err(|_| SinkDrop::Head)?;
                opened.truncate(at);
                Some(head)
            }
            _ => None,
        };
        let begins = header.fragments() > 1
            && self
                .sources
                .get(&header.source)
                .is_none_or(|s| s.partials.iter().all(|p| p.seq != header.seq));
        let room =
            if begins { self.limits.partial_bytes_max.saturating_sub(self.partial_bytes()) } else { 0 };
        let partials_max = self.limits.partials_per_source_max;
        let mut given_up = 0;
        let source = self.source(header.source)?;
        if let Some(MessageHead { kind: MessageKind::Synced, .. }) = head {
            source.synced = true;
            return Ok(Delivery::Synced(header.source));
        }
        if !source.synced && header.to.is_none() {
            return Err(SinkDrop::AwaitingHistory);
        }
        let complete = if let (1, Some(head)) = (header.fragments(), head) {
            Some((head, Bytes::copy_from_slice(opened)))
        } else {
            let at = match source.partials.iter().position(|p| p.seq == header.seq) {
                Some(at) => at,
                None => {
                    if header.total as usize > room {
                        return Err(SinkDrop::PartialsFull);
                    }
                    if source.partials.len() >= partials_max {
                        source.partials.pop_front();
                        given_up += 1;
                    }
                    source.partials.push_back(Partial::new(header));
                    source.partials.len() - 1
                }
            };
            let partial = &mut source.partials[at];
            partial.put(header, head, opened)?;
            match (partial.missing, partial.head) {
                (0, Some(head)) => source.partials.remove(at).map(|p| (head, Bytes::from(p.message))),
                _ => None,
            }
        };
        let delivery = complete.map(|(head, message)| {
            source.window.accept(header.seq);
            if header.reliable {
                // A reliable flow is in order: what is older and incomplete will never be complete.
                let before = source.partials.len();
                source.partials.retain(|p| p.seq > header.seq);
                given_up += (before - source.partials.len()) as u64;
            }
            Delivery::Message(Message { source: header.source, seq: header.seq, head, payload: message })
        });
        self.incomplete += given_up;
        Ok(delivery.unwrap_or(Delivery::Incomplete))
    }

    fn partial_bytes(&self) -> usize {
        self.sources.values().flat_map(|s| &s.partials).map(|p| p.message.len()).sum()
    }

    /// The state of a source, made if need be; the one idle for longest makes room.
    fn source(&mut self, id: SourceId) -> Result<&mut SourceState, SinkDrop> {
        self.clock += 1;
        if !self.sources.contains_key(&id) {
            let key = SourceKey::derive(&self.grant, &self.name, &id)
                .ok_or(OpenError::Suite { found: self.grant.suite })?;
            if self.sources.len() >= self.limits.sources_max
                && let Some(idle) = self.sources.iter().min_by_key(|(_, s)| s.used).map(|(id, _)| *id)
            {
                self.sources.remove(&idle);
            }
            let state = SourceState {
                key,
                window: ReplayWindow::default(),
                partials: VecDeque::new(),
                synced: !self.transient_local,
                used: self.clock,
            };
            self.sources.insert(id, state);
        }
        let state = self.sources.get_mut(&id).expect("inserted above if it was missing");
        state.used = self.clock;
        Ok(state)
    }
}

impl Partial {
    fn new(header: &PacketHeader) -> Self {
        let fragments = header.fragments();
        Self {
            seq: header.seq,
            header: header.clone(),
            head: None,
            message: vec![0; header.total as usize],
            have: vec![0; fragments.div_ceil(64) as usize],
            missing: fragments,
        }
    }

    fn put(
        &mut self,
        header: &PacketHeader,
        head: Option<MessageHead>,
        fragment: &[u8],
    ) -> Result<(), SinkDrop> {
        if (header.total, header.grid) != (self.header.total, self.header.grid) {
            return Err(SinkDrop::Inconsistent);
        }
        let (word, bit) = (usize::from(header.index / 64), 1u64 << (header.index % 64));
        if self.have[word] & bit != 0 {
            return Err(SinkDrop::DuplicateFragment);
        }
        self.have[word] |= bit;
        self.missing -= 1;
        let start = usize::from(header.index) * usize::from(header.grid);
        self.message[start..start + fragment.len()].copy_from_slice(fragment);
        self.head = self.head.or(head);
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use sgc_trust::Suite;
    use sgc_wire::{Class, SecretBytes, SinkId};

    use super::*;
    use crate::{FRAGMENT_BYTES, PublishError, Source, SourceConfig};

    const NAME: Name = Name([1; 32]);
    const HEAD: MessageHead = MessageHead { kind: MessageKind::Write, source_timestamp_ns: 7 };

    fn grant(key: u8) -> TopicGrant {
        TopicGrant {
            epoch: 1,
            suite: Suite::Group.id(),
            key: SecretBytes::new([key; 32]),
            sources: Vec::new(),
            entry: None,
        }
    }

    fn source(history_depth: usize) -> Source {
        source_with_room(history_depth, 1 << 20)
    }

    fn source_with_room(history_depth: usize, history_bytes_max: usize) -> Source {
        let config = SourceConfig {
            name: NAME,
            id: SourceId([5; 16]),
            class: Class::Default,
            reliable: true,
            history_depth,
            history_bytes_max,
        };
        Source::new(config, &grant(1)).unwrap()
    }

    fn sink(transient_local: bool) -> Sink {
        Sink::new(NAME, grant(1), transient_local, SinkLimits::default())
    }

    fn published(source: &mut Source, payload: &[u8]) -> Vec<Packet> {
        let mut packets = Vec::new();
        source.publish(&HEAD, payload, |p| packets.push(p)).unwrap();
        packets
    }

    fn replayed(source: &Source) -> Vec<Packet> {
        let mut packets = Vec::new();
        source.replay(SinkId([9; 16]), 1, u64::MAX, |p| packets.push(p));
        packets
    }

    fn delivered(sink: &mut Sink, packets: &[Packet]) -> Vec<Vec<u8>> {
        packets
            .iter()
            .filter_map(|p| match sink.handle_packet(p) {
                Ok(Delivery::Message(m)) => Some(m.payload.to_vec()),
                _ => None,
            })
            .collect()
    }

    fn bytes(n: usize) -> Vec<u8> {
        (0..n).map(|i| (i * 7 % 251) as u8).collect()
    }

    #[test]
    fn messages_of_every_size_arrive_whole_in_any_order_of_fragments() {
        let grid = usize::from(FRAGMENT_BYTES);
        for n in [0, 1, grid - 1, grid, grid + 1, 3 * grid, 1_000_003] {
            let (mut source, mut sink) = (source(0), sink(false));
            let mut packets = published(&mut source, &bytes(n));
            assert_eq!(packets.len(), n.div_ceil(grid).max(1));
            packets.reverse();
            assert_eq!(delivered(&mut sink, &packets), vec![bytes(n)], "{n} bytes");
        }
    }

    #[test]
    fn a_message_is_delivered_once_however_often_it_comes() {
        let (mut source, mut sink) = (source(0), sink(false));
        let packets = published(&mut source, &bytes(40_000));
        assert_eq!(delivered(&mut sink, &packets).len(), 1);
        assert_eq!(delivered(&mut sink, &packets).len(), 0);
        assert_eq!(sink.handle_packet(&packets[0]), Err(SinkDrop::Replayed));
        sink.regrant(grant(1));
        assert_eq!(delivered(&mut sink, &packets).len(), 0, "after a change of route");
    }

    #[test]
    fn a_forged_packet_leaves_no_trace() {
        let (mut source, mut sink) = (source(0), sink(false));
        let good = published(&mut source, &bytes(60));
        for n in 0..1000u16 {
            let mut bad = good[0].clone();
            bad.header.source = SourceId([(n % 256) as u8; 16]);
            bad.header.total = 60;
            bad.payload = Bytes::from(vec![0; 60 + MESSAGE_HEAD_BYTES + 16]).into();
            assert_eq!(sink.handle_packet(&bad), Err(SinkDrop::Open(OpenError::Forged)));
        }
        assert!(sink.sources.is_empty());
        assert_eq!(delivered(&mut sink, &good).len(), 1);
    }

    #[test]
    fn incomplete_messages_are_bounded_and_counted() {
        let (mut source, mut sink) = (source(0), sink(false));
        for _ in 0..10 {
            let packets = published(&mut source, &bytes(40_000));
            sink.handle_packet(&packets[0]).unwrap();
        }
        assert_eq!(sink.partial_bytes(), 4 * 40_000);
        let last = published(&mut source, &bytes(5));
        assert_eq!(delivered(&mut sink, &last).len(), 1);
        assert_eq!((sink.partial_bytes(), sink.incomplete()), (0, 10));
        sink.limits.partial_bytes_max = 100;
        let packets = published(&mut source, &bytes(40_000));
        assert_eq!(sink.handle_packet(&packets[0]), Err(SinkDrop::PartialsFull));
    }

    #[test]
    fn a_late_joiner_gets_the_history_first_and_each_message_once() {
        let (mut source, mut sink) = (source(3), sink(true));
        for n in 1..=5 {
            published(&mut source, &bytes(n));
        }
        let live = published(&mut source, &bytes(6));
        assert_eq!(sink.handle_packet(&live[0]), Ok(Delivery::NeedsHistory(source.id())));
        assert_eq!(sink.handle_packet(&live[0]), Err(SinkDrop::AwaitingHistory));
        let history = replayed(&source);
        assert_eq!(delivered(&mut sink, &history), vec![bytes(4), bytes(5), bytes(6)]);
        assert_eq!(sink.unsynced().count(), 0);
        assert_eq!(delivered(&mut sink, &live).len(), 0);
        let next = published(&mut source, &bytes(7));
        assert_eq!(delivered(&mut sink, &next), vec![bytes(7)]);
        // The way changed: history again, nothing twice.
        sink.regrant(grant(1));
        assert!(sink.expect(source.id()));
        assert_eq!(delivered(&mut sink, &replayed(&source)).len(), 0);
        assert_eq!(sink.unsynced().count(), 0);
    }

    #[test]
    fn history_is_bounded_in_bytes_but_keeps_the_newest() {
        let mut source = source_with_room(100, 1000);
        for _ in 0..50 {
            published(&mut source, &bytes(400));
        }
        assert_eq!(replayed(&source).len(), 1 + 1);
        published(&mut source, &bytes(5000));
        assert_eq!(replayed(&source).len(), 1 + 1);
    }

    #[test]
    fn the_mark_of_synchrony_is_always_the_same_bytes() {
        let source = source(1);
        let (a, b) = (replayed(&source), replayed(&source));
        assert_eq!(a[0].payload.0, b[0].payload.0);
    }

    #[test]
    fn oversized_messages_are_refused_at_the_source() {
        let payload = vec![0; sgc_wire::MESSAGE_BYTES_MAX as usize + 1];
        let error = source(0).publish(&HEAD, &payload, |_| panic!("nothing is emitted")).unwrap_err();
        assert_eq!(error, PublishError::TooLarge { bytes: payload.len() });
    }
}
