//! Arbitrary packets into a sink that holds a grant, in every suite: none panics, none is delivered that the source did
//! not make, and packets of the source are still delivered afterwards.
use std::sync::{Arc, OnceLock};

use bytes::Bytes;
use sgc_endpoint::{Delivery, Receivers, RecoveryLimits, Sink, SinkLimits, Source, SourceConfig};
use sgc_trust::{MessageKey, Suite};
use sgc_wire::{
    Class, MessageHead, MessageKind, Name, NodeId, Packet, Payload, ReceiverKey, SecretBytes, SinkId,
    SourceId, TopicGrant,
};

const NAME: Name = Name([1; 32]);
const SINK: SinkId = SinkId([9; 16]);
const HEAD: MessageHead = MessageHead::new(MessageKind::Write, 7);

fn key(suite: Suite) -> &'static MessageKey {
    static KEYS: OnceLock<Vec<(Suite, MessageKey)>> = OnceLock::new();
    let keys = KEYS.get_or_init(|| Suite::ALL.map(|s| (s, MessageKey::generate(s))).to_vec());
    keys.iter().find(|(s, _)| *s == suite).map(|(_, key)| key).expect("there is one for each")
}

fn alter(packet: &Packet, edits: &[u8]) -> Option<Packet> {
    let mut all = Vec::new();
    packet.header.put_into(&mut all);
    packet.payload.copy_into(&mut all);
    for edit in edits.chunks_exact(3) {
        let at = usize::from(u16::from_be_bytes([edit[0], edit[1]])) % all.len();
        match edit[2] {
            0 => all.truncate(at.max(1)),
            bits => all[at] ^= bits,
        }
    }
    Packet::from_datagram(Bytes::from(all)).ok().filter(|p| p.header.name == NAME)
}

/// Runs one input of the target.
pub fn run(input: &[u8]) {
    let [first, size, cut, edits @ ..] = input else { return };
    let suite = Suite::ALL[usize::from(*first) % Suite::ALL.len()];
    // In a pairwise suite, the source knows its receivers or signs.
    let receivers = (suite.is_pairwise() && *first >= 0x80).then(Arc::<Receivers>::default);
    let receiver = ReceiverKey { id: [9; 4], key: SecretBytes::new([9; 32]) };
    if let Some(receivers) = &receivers {
        receivers.add(SINK, NodeId([9; 32]), || receiver.clone());
    }
    let config = SourceConfig {
        name: NAME,
        id: SourceId([5; 16]),
        class: Class::Default,
        reliable: true,
        history_depth: 2,
        history_bytes_max: 1 << 20,
        recovery: RecoveryLimits::default(),
        receivers,
    };
    let topic_key = SecretBytes::new([3; 32]);
    let mut grant = TopicGrant {
        epoch: 1,
        suite: suite.id(),
        key: topic_key,
        receiver: suite.is_pairwise().then_some(receiver),
        sources: Vec::new(),
        entry: None,
    };
    let mut source = Source::new(config, &grant, key(suite).clone()).expect("the key is of the suite");
    grant.sources = vec![source.announce()];
    let mut sink = Sink::new(NAME, SINK, grant.clone(), false, SinkLimits::default());

    let mut good = Vec::new();
    let payloads = [vec![1; usize::from(*size) * 256], vec![2; 10]];
    for (n, payload) in payloads.iter().enumerate() {
        let more = n + 1 < payloads.len();
        source.publish(&HEAD, payload.clone().into(), more, |p| good.push(p)).expect("it is small");
    }
    source.replay(SINK, 0, u64::MAX, |p| good.push(p));

    // The input as it is, and as an alteration of a packet of the source.
    let raw = Packet::from_datagram(Bytes::copy_from_slice(edits)).ok().filter(|p| p.header.name == NAME);
    for mut packet in raw.into_iter().chain(good.iter().filter_map(|p| alter(p, edits))) {
        let same = |g: &&Packet| {
            g.header.associated_data() == packet.header.associated_data()
                && g.payload.0.concat() == packet.payload.0.concat()
        };
        let genuine = good.iter().any(|g| same(&g));
        let all = packet.payload.0.concat();
        let (a, b) = all.split_at(usize::from(*cut).min(all.len()));
        packet.payload = Payload(vec![Bytes::copy_from_slice(a), Bytes::copy_from_slice(b)].into());
        match sink.handle_packet(&packet) {
            Ok(Delivery::Parked) | Err(_) => {}
            Ok(other) => assert!(genuine, "{other:?}"),
        }
    }
    sink.regrant(SINK, grant, |result| assert!(!matches!(result, Ok(Delivery::Message(_)))));
    let delivered = |packets: &[Packet], sink: &mut Sink| {
        packets.iter().filter(|p| matches!(sink.handle_packet(p), Ok(Delivery::Message(_)))).count()
    };
    let mut next = Vec::new();
    source.publish(&HEAD, Bytes::from_static(b"still"), false, |p| next.push(p)).expect("it is small");
    // One that was given them in another order asks again.
    let _ = sink.ask(source.id());
    delivered(&good, &mut sink);
    assert_eq!(delivered(&next, &mut sink), 1);
}
