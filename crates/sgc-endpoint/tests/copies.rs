//! Copies of a payload on its way: one at the source, into the packets, and one at the sink, into the message.
//!
//! Every copy is an allocation, and a counting allocator sees those of this thread; so the memory of a message beyond
//! its own length shows whether there is a second copy. `-- --nocapture` prints it.
#![allow(clippy::print_stderr, reason = "what was counted is of use")]

use bytes::Bytes;
use sgc_endpoint::{
    Delivery, FRAGMENT_BYTES, Message, RecoveryLimits, Sink, SinkLimits, Source, SourceConfig,
};
use sgc_testkit::{CountingAllocator, allocations};
use sgc_trust::{MessageKey, Suite, trailer_bytes_max};
use sgc_wire::{
    Class, MessageHead, MessageKind, Name, Packet, Payload, SecretBytes, SinkId, SourceId, TopicGrant,
};

#[global_allocator]
static COUNTING: CountingAllocator = CountingAllocator;

/// Returns the bytes that were allocated meanwhile.
fn taken<T>(work: impl FnOnce() -> T) -> (usize, T) {
    let (taken, result) = allocations(work);
    (taken.bytes, result)
}

const NAME: Name = Name([1; 32]);
const HEAD: MessageHead = MessageHead::new(MessageKind::Write, 7);

/// Number of small messages that share a piece of memory at the source: with fewer it would count once too often, or
/// not at all.
const ROUNDS: usize = 8;
/// Bytes of a packet and a message besides their payload: header, head, tag, counters of references, a signature and
/// the hashes of a batch. Less than the smallest payload here, so that a second copy of any shows.
const ASIDE: usize = 700;
/// Memory of a key, a window and a verifier, once for each source; bytes.
const ONCE: usize = 40_000;

fn ends(suite: Suite, history_depth: usize) -> (Source, Sink) {
    let config = SourceConfig {
        name: NAME,
        id: SourceId([5; 16]),
        class: Class::Default,
        reliable: true,
        history_depth,
        history_bytes_max: 100 << 20,
        recovery: RecoveryLimits::default(),
        receivers: None,
    };
    let key = SecretBytes::new([3; 32]);
    let mut grant =
        TopicGrant { epoch: 1, suite: suite.id(), key, receiver: None, sources: Vec::new(), entry: None };
    let source = Source::new(config, &grant, MessageKey::generate(suite)).expect("the key is of the suite");
    grant.sources = vec![source.announce()];
    (source, Sink::new(NAME, SinkId([9; 16]), grant, false, SinkLimits::default()))
}

fn publish(source: &mut Source, payload: &Bytes, n: usize, packets: &mut Vec<Packet>) {
    for i in 1..=n {
        source.publish(&HEAD, payload.clone(), i < n, |p| packets.push(p)).expect("it is small enough");
    }
}

fn deliver(sink: &mut Sink, packets: &[Packet]) -> Vec<Bytes> {
    let payload = |p| match sink.handle_packet(p) {
        Ok(Delivery::Message(Message { payload, .. })) => Some(payload),
        _ => None,
    };
    packets.iter().filter_map(payload).collect()
}

/// Bytes allocated at the source and at the sink, per message.
fn measure(suite: Suite, bytes: usize, at_once: usize, history: usize) -> (usize, usize) {
    let (mut source, mut sink) = ends(suite, history);
    let payload = Bytes::from(vec![7; bytes]);
    let mut packets = Vec::with_capacity(1000);
    publish(&mut source, &payload, at_once, &mut packets);
    deliver(&mut sink, &packets);
    packets.clear();
    let rounds = if bytes > FRAGMENT_BYTES.into() { 1 } else { ROUNDS };
    let publish_all = |source: &mut Source, packets: &mut Vec<Packet>| {
        (0..rounds).for_each(|_| publish(source, &payload, at_once, packets));
    };
    let (sealing, ()) = taken(|| publish_all(&mut source, &mut packets));
    let (opening, heard) = taken(|| deliver(&mut sink, &packets));
    let messages = rounds * at_once;
    assert_eq!(heard, vec![payload; messages]);
    let each = (sealing / messages, opening / messages);
    eprintln!("{suite}, {bytes} bytes, {at_once} at once: source {} sink {}", each.0, each.1);
    each
}

#[test]
fn a_payload_is_copied_once_at_each_end() {
    for suite in [Suite::Group, Suite::Standard, Suite::StandardChacha] {
        let aside = ASIDE + trailer_bytes_max(suite);
        for (bytes, at_once) in [(1000usize, 1), (1000, 32), (16_000, 1), (1 << 20, 1), (13 << 20, 1)] {
            // A source with a history keeps the payload that it was given.
            for history in [0, 8] {
                let packets = bytes.div_ceil(FRAGMENT_BYTES.into());
                let (source, sink) = measure(suite, bytes, at_once, history);
                // Small messages find some of the memory that those before them gave back.
                assert!(source >= bytes / 2 && sink >= bytes / 2, "the allocator counts");
                assert!(
                    source < bytes + packets * aside,
                    "{suite}: {source} bytes for {bytes} at the source"
                );
                assert!(sink < bytes + packets * aside, "{suite}: {sink} bytes for {bytes} at the sink");
            }
        }
    }
}

/// The first fragment of a large message is opened aside, into memory that is used again and counts the first time.
#[test]
fn a_large_message_takes_one_fragment_more_the_first_time() {
    let bytes = 1 << 20;
    let (mut source, mut sink) = ends(Suite::Standard, 0);
    let mut packets = Vec::with_capacity(1000);
    let payload = Bytes::from(vec![7; bytes]);
    publish(&mut source, &payload, 1, &mut packets);
    let (first, heard) = taken(|| deliver(&mut sink, &packets));
    assert_eq!(heard, [payload]);
    assert!(first > bytes && first < bytes + ONCE, "{first}");
}

/// A packet that the transport received in two pieces is joined first: one copy more.
#[test]
fn a_packet_in_pieces_is_copied_once_more() {
    let (mut source, mut sink) = ends(Suite::Standard, 0);
    let payload = Bytes::from(vec![7; 10_000]);
    let mut packets = Vec::with_capacity(10);
    publish(&mut source, &payload, 1, &mut packets);
    deliver(&mut sink, &packets);
    packets.clear();
    publish(&mut source, &payload, 1, &mut packets);
    for packet in &mut packets {
        let all = packet.payload.0[0].clone();
        packet.payload = Payload([all.slice(..4000), all.slice(4000..)].into());
    }
    let (joined, heard) = taken(|| deliver(&mut sink, &packets));
    assert_eq!(heard, [payload]);
    assert!((20_000..21_000).contains(&joined), "{joined}");
}
