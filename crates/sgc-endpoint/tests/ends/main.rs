//! The two ends of the data path against each other, in every suite: a sink delivers each message of a source once, and
//! nothing else.

mod assertions;
mod epochs;
mod forgery;
mod messages;
mod nonces;
mod pairwise;
mod recovery;

use std::sync::OnceLock;

use bytes::Bytes;
use sgc_endpoint::{
    AskAgain, Delivery, Message, RecoveryLimits, Sink, SinkDrop, SinkLimits, Source, SourceConfig,
};
use sgc_trust::{MessageKey, Suite};
use sgc_wire::{
    Class, MessageHead, MessageKind, Name, Packet, SecretBytes, SinkId, SourceAnnounce, SourceId, TopicGrant,
};

const NAME: Name = Name([1; 32]);
const SINK: SinkId = SinkId([9; 16]);
const HEAD: MessageHead = MessageHead::new(MessageKind::Write, 7);

/// A key for the suite's signatures; made once, because RSA keys take their time.
fn message_key(suite: Suite) -> MessageKey {
    static KEYS: OnceLock<[MessageKey; 4]> = OnceLock::new();
    let kinds = [Suite::Group, Suite::Standard, Suite::Paper, Suite::Paper3072];
    let keys = KEYS.get_or_init(|| kinds.map(MessageKey::generate));
    keys.iter().find(|key| key.fits(suite)).expect("a key of each kind was made").clone()
}

/// The grant of an epoch, whose topic key follows from its number.
fn grant(suite: Suite, epoch: u32, sources: &[SourceAnnounce]) -> TopicGrant {
    let key = SecretBytes::new([epoch as u8; 32]);
    TopicGrant { epoch, suite: suite.id(), key, receiver: None, sources: sources.to_vec(), entry: None }
}

fn config(id: u8, history_depth: usize) -> SourceConfig {
    SourceConfig {
        name: NAME,
        id: SourceId([id; 16]),
        class: Class::Default,
        reliable: true,
        history_depth,
        history_bytes_max: 1 << 20,
        recovery: RecoveryLimits::default(),
        receivers: None,
    }
}

fn source(suite: Suite, history_depth: usize) -> Source {
    source_with(suite, config(5, history_depth))
}

fn source_with(suite: Suite, config: SourceConfig) -> Source {
    Source::new(config, &grant(suite, 1, &[]), message_key(suite)).expect("the key is of the suite")
}

/// A source whose lost messages stay lost, and whose messages are delivered in any order.
fn unrecovered(suite: Suite, id: u8) -> Source {
    source_with(suite, SourceConfig { recovery: RecoveryLimits::NONE, ..config(id, 0) })
}

/// Returns a sink with the present announcements of these sources, in epoch 1.
fn sink(suite: Suite, sources: &[&Source]) -> Sink {
    Sink::new(NAME, SINK, grant(suite, 1, &announced(sources)), false, SinkLimits::default())
}

fn announced(sources: &[&Source]) -> Vec<SourceAnnounce> {
    sources.iter().map(|s| s.announce()).collect()
}

fn published(source: &mut Source, payload: impl Into<Bytes>, more: bool) -> Vec<Packet> {
    let mut packets = Vec::new();
    source.publish(&HEAD, payload.into(), more, |p| packets.push(p)).expect("tests publish what fits");
    packets
}

fn flushed(source: &mut Source) -> Vec<Packet> {
    let mut packets = Vec::new();
    source.flush(|p| packets.push(p));
    packets
}

/// Returns the messages that a late joiner gets.
fn replayed(source: &mut Source) -> Vec<Packet> {
    replayed_to(source, SINK, 0)
}

fn replayed_to(source: &mut Source, sink: SinkId, from: u64) -> Vec<Packet> {
    let mut packets = Vec::new();
    source.replay(sink, from, u64::MAX, |p| packets.push(p));
    packets
}

fn delivered(sink: &mut Sink, packets: &[Packet]) -> Vec<Bytes> {
    packets.iter().filter_map(|p| payload(sink.handle_packet(p))).collect()
}

fn payload(result: Result<Delivery, SinkDrop>) -> Option<Bytes> {
    match result {
        Ok(Delivery::Message(Message { payload, .. })) => Some(payload),
        _ => None,
    }
}

/// Returns a sink's results of a grant.
fn regranted(sink: &mut Sink, id: SinkId, grant: TopicGrant) -> Vec<Result<Delivery, SinkDrop>> {
    let mut released = Vec::new();
    sink.regrant(id, grant, |result| released.push(result));
    released
}

fn bytes(n: usize) -> Bytes {
    (0..n).map(|i| (i * 7 % 251) as u8).collect()
}

/// The packet's payload, as one piece.
fn text(packet: &Packet) -> Vec<u8> {
    let mut out = Vec::new();
    packet.payload.copy_into(&mut out);
    out
}
