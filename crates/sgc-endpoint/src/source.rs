//! One publisher under one name: numbers messages, cuts and seals them, and keeps what late joiners may ask for.

use std::collections::VecDeque;

use bytes::Bytes;
use sgc_trust::{SourceKey, TAG_BYTES};
use sgc_wire::{
    Class, HOP_LIMIT, MESSAGE_BYTES_MAX, MESSAGE_HEAD_BYTES, MessageHead, MessageKind, Name, Packet,
    PacketHeader, SinkId, SourceId, TopicGrant,
};

/// Bytes of message in one packet.
pub const FRAGMENT_BYTES: u16 = 16 * 1024;

/// What a source is made of.
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
}

/// Why a message was not published.
#[derive(Clone, Copy, Debug, PartialEq, Eq, thiserror::Error)]
pub enum PublishError {
    /// Larger than any sink accepts.
    #[error("a message of {bytes} bytes exceeds the {MESSAGE_BYTES_MAX} that can be carried")]
    TooLarge {
        /// Its length.
        bytes: usize,
    },
}

/// A publisher.
pub struct Source {
    config: SourceConfig,
    key: SourceKey,
    seq: u64,
    history: VecDeque<Vec<Packet>>,
    history_bytes: usize,
}

impl Source {
    /// A source that starts at message 1; `None` if the grant's suite is not in this build.
    pub fn new(config: SourceConfig, grant: &TopicGrant) -> Option<Self> {
        let key = SourceKey::derive(grant, &config.name, &config.id)?;
        Some(Self { config, key, seq: 0, history: VecDeque::new(), history_bytes: 0 })
    }

    /// Its id.
    pub fn id(&self) -> SourceId {
        self.config.id
    }

    /// Messages published.
    pub fn published(&self) -> u64 {
        self.seq
    }

    /// Seals one message and hands its packets to `emit` in order.
    pub fn publish(
        &mut self,
        head: &MessageHead,
        payload: &[u8],
        mut emit: impl FnMut(Packet),
    ) -> Result<(), PublishError> {
        let total = u32::try_from(payload.len())
            .ok()
            .filter(|n| *n <= MESSAGE_BYTES_MAX)
            .ok_or(PublishError::TooLarge { bytes: payload.len() })?;
        self.seq += 1;
        let mut kept = Vec::new();
        let keep = self.config.history_depth > 0;
        for index in 0..total.div_ceil(FRAGMENT_BYTES.into()).max(1) as u16 {
            let packet = self.seal(self.seq, total, index, head, payload);
            if keep {
                kept.push(packet.clone());
            }
            emit(packet);
        }
        if keep {
            self.keep(kept);
        }
        Ok(())
    }

    /// Hands the kept messages `from..=to` to `emit`, addressed to one sink, and then the mark that they were
    /// sent.
    pub fn replay(&self, sink: SinkId, from: u64, to: u64, mut emit: impl FnMut(Packet)) {
        let addressed = |packet: &Packet| {
            let mut packet = packet.clone();
            packet.header.to = Some(sink);
            packet
        };
        for message in &self.history {
            if message.first().is_some_and(|p| (from..=to).contains(&p.header.seq)) {
                message.iter().for_each(|p| emit(addressed(p)));
            }
        }
        let head = MessageHead { kind: MessageKind::Synced, source_timestamp_ns: 0 };
        emit(addressed(&self.seal(0, 0, 0, &head, &[])));
    }

    fn seal(&self, seq: u64, total: u32, index: u16, head: &MessageHead, payload: &[u8]) -> Packet {
        let header = PacketHeader {
            reliable: self.config.reliable,
            class: self.config.class,
            hops: HOP_LIMIT,
            suite: self.key.suite().id(),
            epoch: self.key.epoch(),
            name: self.config.name,
            source: self.config.id,
            seq,
            total,
            index,
            grid: FRAGMENT_BYTES,
            to: None,
        };
        let start = usize::from(index) * usize::from(FRAGMENT_BYTES);
        let fragment = &payload[start..start + header.fragment_bytes()];
        let mut sealed = Vec::with_capacity(fragment.len() + MESSAGE_HEAD_BYTES + TAG_BYTES);
        self.key.seal(&header, head, fragment, &mut sealed);
        Packet { header, payload: Bytes::from(sealed).into() }
    }

    fn keep(&mut self, message: Vec<Packet>) {
        self.history_bytes += message_bytes(&message);
        self.history.push_back(message);
        let over = |s: &Self| {
            s.history.len() > s.config.history_depth || s.history_bytes > s.config.history_bytes_max
        };
        while over(self) && self.history.len() > 1 {
            if let Some(old) = self.history.pop_front() {
                self.history_bytes -= message_bytes(&old);
            }
        }
    }
}

fn message_bytes(message: &[Packet]) -> usize {
    message.iter().map(Packet::encoded_bytes).sum()
}
