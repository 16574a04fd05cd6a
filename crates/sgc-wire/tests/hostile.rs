//! Input from the network never panics and decodes to one value only: a short run with fixed seeds of what the fuzz
//! targets in `fuzz/` search at length.

use bytes::Bytes;
use rand_chacha::ChaCha8Rng;
use rand_chacha::rand_core::{RngCore, SeedableRng};
use sgc_wire::{
    AdvertBody, Answer, AnswerBody, Blind, CONSUMERS_MAX, Catalogue, CatalogueEntry, CatalogueSource,
    Challenge, Class, Consumer, Control, Decode, Encode, GrantContent, Hello, JoinBody, Metadata, Name,
    NodeId, Operation, OperationAnswer, OperationRefusal, OperationRequest, Packet, PacketHeader,
    PayloadEncoding, Place, Qos, Recover, RefuseReason, RejectReason, Report, ReportQuestion, Request, Role,
    RosNode, RosterPage, RosterRow, RowCertificate, SecretBytes, SignedBody, SinkId, SourceAnnounce,
    SourceId, TYPE_HASH_BYTES_MAX, TopicGrant, UnixMillis,
};

const ROUNDS: u32 = 20_000;

/// Changes a few bytes, cuts, or repeats a part.
fn mutated(rng: &mut ChaCha8Rng, valid: &[u8]) -> Vec<u8> {
    let mut bytes = valid.to_vec();
    for _ in 0..1 + rng.next_u32() % 4 {
        let at = rng.next_u32() as usize % bytes.len().max(1);
        match rng.next_u32() % 5 {
            0 => bytes.truncate(at),
            1 => bytes.extend_from_within(at.min(bytes.len())..),
            2 if !bytes.is_empty() => bytes[at] = [0, 1, 0x7f, 0x80, 0xff][rng.next_u32() as usize % 5],
            _ if !bytes.is_empty() => bytes[at] ^= 1 << (rng.next_u32() % 8),
            _ => {}
        }
    }
    bytes
}

fn survives<T: Decode + Encode>(samples: &[Vec<u8>], seed: u64) {
    let mut rng = ChaCha8Rng::seed_from_u64(seed);
    let mut accepted = 0;
    for round in 0..ROUNDS {
        let input = mutated(&mut rng, &samples[round as usize % samples.len()]);
        if let Ok(value) = T::from_slice(&input) {
            accepted += 1;
            assert_eq!(value.to_vec(), input, "two encodings of one value");
        }
    }
    assert!(accepted > 0, "the mutations never leave anything valid: the test tests nothing");
}

fn signed() -> SignedBody {
    SignedBody { body: Bytes::from_static(b"some body"), signature: Bytes::from_static(&[7; 70]) }
}

#[test]
fn control_frames_survive_mutation() {
    let (name, sink, source) = (Name([1; 32]), SinkId([2; 16]), SourceId([3; 16]));
    let frames = [
        Control::Hello(Hello {
            minor: 0,
            incarnation: 5,
            transit: true,
            yields: false,
            started: UnixMillis(6),
        }),
        Control::Clock { time: UnixMillis(7) },
        Control::IdentityInUse { place: Place { ip: [8; 16], port: 9 } },
        Control::ObservedAddress { place: Place { ip: [8; 16], port: 10 } },
        Control::Advert { cost: 1, signed: signed() },
        Control::Unreach { names: vec![name; 3] },
        Control::Interest { names: vec![name; 2] },
        Control::Uninterest { names: vec![name] },
        Control::Join { signed: signed() },
        Control::Leave { name, sink },
        Control::Answer { signed: signed() },
        Control::Reject { name, sink, reason: RejectReason::Limit },
        Control::Recover(Recover { name, sink, source, from: 1, to: 9 }),
        Control::Goodbye,
    ];
    survives::<Control>(&frames.map(|f| f.to_vec()), 1);
}

#[test]
fn signed_bodies_and_grants_survive_mutation() {
    let chain = vec![Bytes::from_static(&[0x30; 40]); 2];
    let issued_at = UnixMillis(1_700_000_000_000);
    let (name, sink) = (Name([1; 32]), SinkId([2; 16]));
    let advert = AdvertBody {
        chain: chain.clone(),
        seq: 9,
        issued_at,
        lease_ms: 60_000,
        withdraw: false,
        blinds: vec![Blind([4; 32]); 3],
    };
    survives::<AdvertBody>(&[advert.to_vec()], 2);
    let reply_key = Bytes::from_static(&[5; 32]);
    let join =
        JoinBody { name, sink, request: Request::Subscribe { describe: false }, issued_at, chain, reply_key };
    survives::<JoinBody>(&[join.to_vec()], 3);
    let answers = [
        Answer::Grant { enc: Bytes::from_static(&[6; 32]), sealed: Bytes::from_static(&[7; 80]) },
        Answer::Refuse { reason: RefuseReason::NotPermitted },
    ];
    let answers = answers.map(|answer| AnswerBody { name, sink, serial: 3, answer }.to_vec());
    survives::<AnswerBody>(&answers, 4);
    let metadata = Metadata::topic("arm-1", "/camera", "sensor_msgs/msg/Image");
    survives::<Metadata>(&[metadata.to_vec()], 5);
    let entry = CatalogueEntry {
        metadata,
        blind: Blind([4; 32]),
        subscribe: true,
        publish: false,
        suite: 1,
        keyless: true,
        type_hash: Some("RIHS01_ab".into()),
        qos: Qos { partitions: vec!["p".into()], ..Qos::default() },
        class: Class::Realtime,
        sources: vec![CatalogueSource {
            source: SourceId([8; 16]),
            qos: Qos::default(),
            node: RosNode::new("/robot", "talker", Some("/robot")),
        }],
    };
    let contents = [
        GrantContent::Topic(TopicGrant {
            epoch: 1,
            suite: 1,
            key: SecretBytes::new([9; 32]),
            receiver: None,
            sources: vec![SourceAnnounce {
                source: SourceId([8; 16]),
                key: Bytes::new(),
                oldest: 1,
                next: 2,
                recover: 1,
            }],
            entry: Some(Box::new(entry.clone())),
        }),
        GrantContent::Catalogue(Catalogue { version: 2, entries: vec![entry] }),
    ];
    survives::<GrantContent>(&contents.map(|c| c.to_vec()), 6);
}

#[test]
fn operations_survive_mutation() {
    let enroll = Operation::Enroll {
        node: "arm-1".into(),
        groups: vec!["arms".into()],
        router: false,
        may_route: true,
        again: false,
        valid_ms: 1,
        csr: Bytes::from_static(b"csr"),
    };
    let challenge = Challenge([1; 16]);
    let revoke = Operation::Revoke { nodes: vec!["arm-1".into(), "desk".into()] };
    let redeem =
        Operation::Redeem { csr: Bytes::from_static(b"csr"), reply_key: Bytes::from_static(&[1; 32]) };
    let invite = Operation::Invite {
        node: "arm-2".into(),
        groups: vec!["arms".into()],
        router: false,
        may_route: false,
        again: true,
        valid_ms: 2,
        within_ms: 1,
        routers: vec!["quic://r:1".into()],
    };
    let requests =
        [enroll, revoke, redeem, invite].map(|operation| OperationRequest::Execute { challenge, operation });
    survives::<OperationRequest>(&requests.map(|r| r.to_vec()), 8);
    let row = RosterRow {
        name: "arm-1".into(),
        id: NodeId([1; 32]),
        incarnation: 1,
        groups: vec!["arms".into()],
        router: false,
        may_route: false,
        expires: Some(UnixMillis(1)),
        revoked: None,
        generation: 2,
        seen: Some(UnixMillis(2)),
        certificates: vec![RowCertificate {
            serial: Bytes::from_static(&[1; 16]),
            expires: UnixMillis(1),
            incarnation: 0,
            revoked: Some(UnixMillis(2)),
        }],
    };
    let page = RosterPage { fleet: "lab".into(), nodes: vec![row], ..RosterPage::default() };
    let refused = OperationAnswer::Refused { why: OperationRefusal::Fleet, detail: "no".into() };
    let sealed =
        OperationAnswer::Sealed { enc: Bytes::from_static(&[1; 32]), sealed: Bytes::from_static(&[2; 64]) };
    let contents = [OperationAnswer::Roster(page), refused, sealed].map(GrantContent::Operation);
    survives::<GrantContent>(&contents.map(|c| c.to_vec()), 9);
}

#[test]
fn reports_survive_mutation_and_arbitrary_bytes() {
    let questions = [ReportQuestion::Node, ReportQuestion::Interface("/camera".into())];
    survives::<ReportQuestion>(&questions.map(|q| q.to_vec()), 12);
    let report = |encoding| Report { encoding, document: Bytes::from_static(b"{\"version\": \"1\"}") };
    let contents = [PayloadEncoding::Plain, PayloadEncoding::Zstd].map(|e| GrantContent::Report(report(e)));
    survives::<GrantContent>(&contents.map(|c| c.to_vec()), 13);
}

/// The encoding of consumers, and what stands in front of them: their tag and their number.
fn consumers(count: u32) -> Vec<u8> {
    let node = |n: u32| RosNode::new("/desk", &format!("viewer_{n}"), None).expect("a valid name");
    let consumer = |n: u32| Consumer {
        interface: Name([1; 32]),
        id: [2; 8],
        role: if n == 1 { Role::Publish } else { Role::Subscribe },
        is_alive: n != 1,
        node: node(n),
        type_hash: n.is_multiple_of(2).then(|| "RIHS01_ab".to_owned()),
        qos: Qos { partitions: vec!["p".into()], ..Qos::default() },
    };
    GrantContent::Consumers((0..count).map(consumer).collect()).to_vec()
}

#[test]
fn consumers_survive_mutation_and_arbitrary_bytes_within_their_bounds() {
    survives::<GrantContent>(&[consumers(0), consumers(1), consumers(3)], 10);
    // The tag and a small number in front have arbitrary bytes read as consumers, not refused at once.
    let mut rng = ChaCha8Rng::seed_from_u64(11);
    for _ in 0..ROUNDS {
        let mut input = vec![0; rng.next_u32() as usize % 2_048];
        rng.fill_bytes(&mut input);
        let head = [&[5, 0, 0][..], &(rng.next_u32() as u16 % 1_024).to_be_bytes()].concat();
        let of_both = [mutated(&mut rng, &consumers(4)), [head, input.clone()].concat(), input];
        for input in of_both {
            let Ok(GrantContent::Consumers(all)) = GrantContent::from_slice(&input) else { continue };
            assert!(all.len() <= CONSUMERS_MAX);
            for consumer in all {
                let Consumer { node, type_hash, .. } = consumer;
                assert!(node.namespace().len().max(node.name().len()) <= RosNode::NAME_BYTES_MAX);
                assert!(type_hash.is_none_or(|hash| hash.len() <= TYPE_HASH_BYTES_MAX));
            }
        }
    }
}

/// Memory grows with the bytes of an answer, not with the number that it claims.
#[test]
fn claimed_consumers_that_do_not_follow_are_refused() {
    for claimed in [1, CONSUMERS_MAX as u32, CONSUMERS_MAX as u32 + 1, u32::MAX] {
        let input = [&[5][..], &claimed.to_be_bytes(), &consumers(1)[5..60]].concat();
        assert!(GrantContent::from_slice(&input).is_err(), "{claimed}");
    }
}

#[test]
fn packets_survive_mutation_and_their_fragments_stay_inside() {
    let header = PacketHeader {
        reliable: true,
        class: Class::Default,
        hops: 9,
        suite: 1,
        epoch: 1,
        name: Name([1; 32]),
        source: SourceId([2; 16]),
        seq: 5,
        total: 100_000,
        index: 3,
        grid: 16_384,
        to: None,
    };
    let samples: Vec<_> = [None, Some(SinkId([3; 16]))]
        .map(|to| [PacketHeader { to, ..header.clone() }.to_vec(), vec![0xaa; 60]].concat())
        .into();
    let mut rng = ChaCha8Rng::seed_from_u64(7);
    let mut accepted = 0;
    for round in 0..ROUNDS {
        let input = mutated(&mut rng, &samples[round as usize % samples.len()]);
        let Ok(packet) = Packet::from_datagram(Bytes::from(input.clone())) else { continue };
        accepted += 1;
        let start = u64::from(packet.header.index) * u64::from(packet.header.grid);
        assert!(start + packet.header.fragment_bytes() as u64 <= u64::from(packet.header.total.max(1)));
        let mut encoded = packet.header.to_vec();
        packet.payload.copy_into(&mut encoded);
        assert_eq!(encoded, input);
    }
    assert!(accepted > 0, "the mutations never leave anything valid: the test tests nothing");
}
