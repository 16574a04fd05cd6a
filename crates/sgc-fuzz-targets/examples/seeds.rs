//! Writes valid inputs of each kind to `fuzz/corpus/`, from which a fuzzer reaches more code than from an empty corpus:
//! `cargo run -p sgc-fuzz-targets --example seeds`.

use std::net::SocketAddr;
use std::path::Path;
use std::time::{Duration, Instant};
use std::{fs, io};

use bytes::Bytes;
use rand_chacha::ChaCha20Rng;
use rand_core::SeedableRng;
use sgc_endpoint::{RecoveryLimits, Source, SourceConfig};
use sgc_fuzz_targets::checks::Meeting;
use sgc_session::DirectOutput;
use sgc_trust::{EnrollRequest, Fleet, KeyRequest, MessageKey, ShareToken, Suite, TopicSecret};
use sgc_wire::{
    AdvertBody, Answer, AnswerBody, Blind, CandidateKind, Catalogue, CatalogueEntry, CatalogueSource,
    Challenge, Class, Consumer, Control, Credentials, DescribedType, Encode, GrantContent, Hello, JoinBody,
    MessageHead, MessageKind, Metadata, Name, OperationAnswer, PathCandidate, PathOffer, PayloadEncoding,
    PayloadForm, Place, Qos, Recover, RefuseReason, RejectReason, Report, ReportQuestion, Request, Role,
    RosNode, SecretBytes, SecretGeneration, SignedBody, SinkId, SourceId, SourceOffer, TopicGrant,
    TypeQuestion, UnixMillis, Wish,
};
use sgc_zenoh::{Attachment, Gid, ZenohId};

/// The time of the targets.
const NOW: UnixMillis = UnixMillis(1_795_000_000_000);
const NAME: Name = Name([1; 32]);
const SINK: SinkId = SinkId([9; 16]);

fn main() -> io::Result<()> {
    let corpus = Path::new(env!("CARGO_MANIFEST_DIR")).join("../../fuzz/corpus");
    let write = |target: &str, seeds: Vec<Vec<u8>>| -> io::Result<()> {
        fs::create_dir_all(corpus.join(target))?;
        for (n, seed) in seeds.iter().enumerate() {
            fs::write(corpus.join(target).join(format!("seed-{n}")), seed)?;
        }
        Ok(())
    };
    write("access", access())?;
    write("cdr", definitions(&[0, 1, 0, 0, 7, 0, 0, 0]))?;
    write("control", control())?;
    write("dtls", dtls())?;
    write("mux", mux())?;
    write("values", definitions(br#"{"a":[1,2],"b":"x"}"#))?;
    write("bodies", bodies())?;
    write("packet", packets(Suite::ALL.as_slice()))?;
    write("certs", certs())?;
    write("sink", sink())?;
    write("checks", checks())?;
    write("grants", grants())?;
    write("store", store())?;
    write("zenoh", zenoh())?;
    write("gateway", gateway())
}

/// Returns authentic checks of the peer, also from elsewhere, and one that is not.
fn checks() -> Vec<Vec<u8>> {
    let mut now = Instant::now();
    let Meeting { mut far, .. } = Meeting::new(now);
    let mut datagrams = Vec::new();
    for _ in 0..20 {
        now += Duration::from_millis(50);
        far.handle_timeout(now);
        let sent = std::iter::from_fn(|| far.poll()).filter_map(|output| match output {
            DirectOutput::Send { datagram, .. } => Some(datagram),
            _ => None,
        });
        datagrams.extend(sent);
    }
    let framed = |source: u8, datagram: &[u8]| {
        [&[source], &(datagram.len() as u16).to_be_bytes()[..], datagram].concat()
    };
    let all = |source: fn(usize) -> u8| {
        datagrams.iter().enumerate().flat_map(|(n, datagram)| framed(source(n), datagram)).collect()
    };
    let mut altered = datagrams.first().cloned().unwrap_or_default();
    altered.iter_mut().skip(20).step_by(7).for_each(|byte| *byte ^= 1);
    vec![all(|_| 2), all(|n| n as u8 + 3), framed(2, &altered)]
}

/// Returns replies of all types, and servers that answer as a cluster and as a single server.
fn store() -> Vec<Vec<u8>> {
    const READY: [u8; 2] = [4, 0];
    const WAIT: [u8; 2] = [6, 100];
    let send = |bytes: &[u8]| [&[9, bytes.len() as u8], bytes].concat();
    let replies = b"\0+OK\r\n:-7\r\n$3\r\nabc\r\n_\r\n#t\r\n-MOVED 7 a:1\r\n*2\r\n%1\r\n+a\r\n:1\r\n$-1\r\n>2\r\n+invalidate\r\n_\r\n";
    let info = send(b"+cluster_state:ok\r\n");
    let slots = send(b"*1\r\n*3\r\n:0\r\n:16383\r\n*2\r\n+a\r\n:1\r\n");
    let single = send(b"-ERR This instance has cluster support disabled\r\n");
    let with = |slots: &[u8], answer: &[u8]| {
        let parts: [&[u8]; 8] = [&[1], &READY, &info, slots, &[0, 7], &send(answer), &WAIT, &[2, 8]];
        parts.concat()
    };
    vec![
        replies.to_vec(),
        with(&slots, b"$5\r\nvalue\r\n"),
        with(&slots, b"-ASK 5 b:2\r\n"),
        with(&slots, b">2\r\n+invalidate\r\n*1\r\n+sgc:n:\r\n"),
        with(&single, b"-READONLY\r\n"),
    ]
}

/// Returns attachments of both forms, tokens, a key, QoS and an id of SGC, as rmw_zenoh writes them.
fn zenoh() -> Vec<Vec<u8>> {
    const STRING: &str = "std_msgs::msg::dds_::String_";
    const HASH: &str = "RIHS01_df668c740482bbd48fb39d76a70dfd4bd59db1288021743503259e948f6b1a18";
    let attachment =
        Attachment { sequence: 1, source_timestamp_ns: 1_700_000_000_123_456_789, gid: Gid([7; 16]) };
    let old = [
        b"\x0fsequence_number".as_slice(),
        &[1; 8],
        b"\x10source_timestamp",
        &[2; 8],
        b"\x0asource_gid\x10",
        &[3; 16],
    ];
    let node = "@ros2_lv/2/aac3178e146ba6f1fc6e6a4085e77f21/0/0/NN/%arm/%robot1/talker".to_owned();
    let endpoint = |kind: &str, name: &str, qos: &str| {
        format!(
            "@ros2_lv/2/8b20917502ee955ac4476e0266340d5c/0/10/{kind}/%/%/talker/{name}/{STRING}/{HASH}/{qos}"
        )
    };
    let with = |choice: u8, bytes: &[u8]| [&[choice], bytes].concat();
    vec![
        with(0, &attachment.encode()),
        with(0, &old.concat()),
        with(1, node.as_bytes()),
        with(1, endpoint("MP", "%chatter", ":1:,1000:,:10,0:,,").as_bytes()),
        with(1, endpoint("MS", "%robot1%chatter", "2:2:2,:1,5:,:3,2,0/backends:cpu:").as_bytes()),
        with(1, endpoint("SS", "%add", "::,10:,:,:,,").as_bytes()),
        with(2, format!("0/robot1/chatter/{STRING}/{HASH}").as_bytes()),
        with(3, b"1:1:1,42:9223372036,854775807:0,1:4,9223372036,1"),
        with(4, ZenohId::of_sgc([9; 10]).to_string().as_bytes()),
    ]
}

/// Returns conversations by the rosbridge protocol and by Foxglove's.
fn gateway() -> Vec<Vec<u8>> {
    let conversations = [
        (
            0,
            [
                r#"{"op":"advertise","id":"a","topic":"/cmd","type":"geometry_msgs/msg/Twist","qos":{"depth":3}}"#,
                r#"{"op":"subscribe","id":"s","topic":"/cmd","compression":"cbor","throttle_rate":1,"fragment_size":20}"#,
                r#"{"op":"publish","topic":"/cmd","msg":{"linear":{"x":1.5}}}"#,
                r#"{"op":"fragment","id":"f","num":0,"total":1,"data":"{\"op\":\"unsubscribe\",\"topic\":\"/cmd\"}"}"#,
                r#"{"op":"unadvertise","id":"a","topic":"/cmd"}"#,
            ],
        ),
        (
            0,
            [
                r#"{"op":"advertise_service","service":"/switch","type":"std_srvs/srv/SetBool"}"#,
                r#"{"op":"call_service","id":"c","service":"/switch","args":[true],"timeout":0.01}"#,
                r#"{"op":"service_response","id":"x","service":"/switch","values":{"success":true},"result":true}"#,
                r#"{"op":"advertise_action","action":"/dock","type":"example_interfaces/action/Fibonacci"}"#,
                r#"{"op":"call_service","id":"d","service":"/rosapi/topics"}"#,
            ],
        ),
        (
            1,
            [
                r#"{"op":"advertise","channels":[{"id":7,"topic":"/cmd","encoding":"json","schemaName":"std_msgs/msg/String"}]}"#,
                r#"{"op":"subscribe","subscriptions":[{"id":1,"channelId":1}]}"#,
                "\u{1}\u{7}\0\0\0{\"data\":\"left\"}",
                r#"{"op":"setParameters","parameters":[{"name":"/n.p","value":[1,2.5]}],"id":"q"}"#,
                r#"{"op":"subscribeConnectionGraph"}"#,
            ],
        ),
    ];
    conversations.map(|(which, lines)| [vec![which], lines.join("\n").into_bytes()].concat()).into()
}

fn control() -> Vec<Vec<u8>> {
    let (name, sink, source) = (NAME, SINK, SourceId([3; 16]));
    let signed =
        SignedBody { body: Bytes::from_static(b"some body"), signature: Bytes::from_static(&[7; 70]) };
    let frames = [
        Control::Hello(Hello {
            minor: 0,
            incarnation: 5,
            transit: true,
            yields: false,
            started: UnixMillis(1),
        }),
        Control::Advert { cost: 1, signed: signed.clone() },
        Control::Unreach { names: vec![name; 3] },
        Control::Interest { names: vec![name; 2] },
        Control::Uninterest { names: vec![name] },
        Control::Join { signed: signed.clone() },
        Control::Leave { name, sink },
        Control::Answer { signed },
        Control::Reject { name, sink, reason: RejectReason::Limit },
        Control::Recover(Recover { name, sink, source, from: 1, to: 9 }),
        Control::Goodbye,
        Control::ObservedAddress { place: Place { ip: [8; 16], port: 9 } },
    ];
    frames.map(|f| f.to_vec()).into()
}

fn bodies() -> Vec<Vec<u8>> {
    let chain = vec![Bytes::from_static(&[0x30; 40]); 2];
    let advert = AdvertBody {
        chain: chain.clone(),
        seq: 9,
        issued_at: NOW,
        lease_ms: 60_000,
        withdraw: false,
        blinds: vec![Blind([4; 32]); 3],
    };
    let offer = SourceOffer { source: SourceId([3; 16]), key: Bytes::from_static(&[5; 32]) };
    let reply_key = Bytes::from_static(&[5; 32]);
    // An empty question asks a node for its consumers.
    let ask = Request::Ask { what: Bytes::new() };
    let joins =
        [Request::Subscribe { describe: true }, Request::Publish { offer }, ask].map(|request| JoinBody {
            name: NAME,
            sink: SINK,
            request,
            issued_at: NOW,
            chain: chain.clone(),
            reply_key: reply_key.clone(),
        });
    let answers = [
        Answer::Grant { enc: Bytes::from_static(&[6; 32]), sealed: Bytes::from_static(&[7; 80]) },
        Answer::Refuse { reason: RefuseReason::NotPermitted },
    ]
    .map(|answer| AnswerBody { name: NAME, sink: SINK, serial: 3, answer });
    let metadata = Metadata::topic("arm-1", "/camera", "sensor_msgs/msg/Image");
    let entry = CatalogueEntry {
        metadata: metadata.clone(),
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
        GrantContent::Topic(TopicGrant { entry: Some(Box::new(entry.clone())), ..grant(Suite::Standard) }),
        GrantContent::Catalogue(Catalogue { version: 2, entries: vec![entry] }),
        GrantContent::Types(vec![DescribedType {
            name: NAME,
            type_hash: "RIHS01_00".into(),
            encoding: PayloadEncoding::Zstd,
            description: Bytes::from_static(b"\0\0\x01\0packed"),
        }]),
        GrantContent::Consumers(vec![
            consumer("rviz", Role::Subscribe, Some("RIHS01_ab")),
            consumer("teleop", Role::Publish, None),
        ]),
        GrantContent::Consumers(Vec::new()),
        GrantContent::Report(Report {
            encoding: PayloadEncoding::Plain,
            document: Bytes::from_static(b"{\"version\":\"1\"}"),
        }),
        GrantContent::Credentials(Credentials {
            chain: chain.clone(),
            secrets: vec![SecretGeneration { generation: 1, secret: SecretBytes::new([4; 32]) }],
        }),
        GrantContent::Operation(OperationAnswer::Challenge(Challenge([1; 16]))),
    ];
    let head = MessageHead::new(MessageKind::Write, 7);
    let mut all = vec![(0, advert.to_vec())];
    all.extend(joins.map(|j| (1, j.to_vec())));
    all.extend(answers.map(|a| (2, a.to_vec())));
    all.extend(contents.map(|c| (3, c.to_vec())));
    let json = MessageHead { form: PayloadForm::Json, ..head };
    all.extend([(4, metadata.to_vec()), (5, head.to_vec()), (5, json.to_vec())]);
    all.push((6, TypeQuestion { names: vec![NAME; 2] }.to_vec()));
    all.push((8, ReportQuestion::Interface("/camera".into()).to_vec()));
    let document = Bytes::from_static(b"{\"version\":\"1\"}");
    all.push((9, Report { encoding: PayloadEncoding::Plain, document }.to_vec()));
    all.push((8, ReportQuestion::Ping.to_vec()));
    let candidate = PathCandidate {
        kind: CandidateKind::ServerReflexive,
        place: SocketAddr::from(([203, 0, 113, 7], 40_000)).into(),
    };
    let password = SecretBytes::new([5; 32]);
    let offer = PathOffer { attempt: 1, user: [2; 4], password, candidates: vec![candidate] };
    all.push((3, GrantContent::Path(offer).to_vec()));
    all.push((3, GrantContent::Clock(NOW).to_vec()));
    let (interval, bits_per_s) = (Some(Duration::from_millis(200)), Some(1_000_000));
    let wish = Wish { interface: NAME, interval, bits_per_s };
    all.push((3, GrantContent::Wishes(vec![wish]).to_vec()));
    all.into_iter().map(|(which, body)| [&[which], &body[..]].concat()).collect()
}

/// Returns a subscriber or a publisher of a node at a desk.
fn consumer(node: &str, role: Role, type_hash: Option<&str>) -> Consumer {
    Consumer {
        interface: NAME,
        id: *b"consumer",
        role,
        is_alive: true,
        node: RosNode::new("/desk", node, None).expect("a node"),
        type_hash: type_hash.map(str::to_owned),
        qos: Qos::default(),
    }
}

/// Returns a grant with another key than that of the target `sink`. In suites without signatures, packets sealed under
/// the same key would count as genuine there, though its source did not make them.
fn grant(suite: Suite) -> TopicGrant {
    let key = SecretBytes::new([4; 32]);
    TopicGrant { epoch: 1, suite: suite.id(), key, receiver: None, sources: Vec::new(), entry: None }
}

/// Returns packets of each suite: to all and addressed, in several fragments and in one.
fn packets(suites: &[Suite]) -> Vec<Vec<u8>> {
    let mut out = Vec::new();
    for suite in suites {
        let config = SourceConfig {
            name: NAME,
            id: SourceId([5; 16]),
            class: Class::Default,
            reliable: true,
            history_depth: 2,
            history_bytes_max: 1 << 20,
            recovery: RecoveryLimits::default(),
            receivers: None,
        };
        let mut source =
            Source::new(config, &grant(*suite), MessageKey::generate(*suite)).expect("of the suite");
        let head = MessageHead::new(MessageKind::Write, 7);
        let mut emit = |packet: sgc_wire::Packet| {
            let mut bytes = packet.header.to_vec();
            packet.payload.copy_into(&mut bytes);
            bytes.truncate(2000);
            out.push(bytes);
        };
        source.publish(&head, Bytes::from(vec![1; 20_000]), true, &mut emit).expect("small");
        source.publish(&head, Bytes::from_static(b"ten bytes!"), false, &mut emit).expect("small");
        source.replay(SINK, 2, 2, &mut emit);
    }
    out
}

fn certs() -> Vec<Vec<u8>> {
    let rng = &mut ChaCha20Rng::seed_from_u64(3);
    let mut fleet = Fleet::create("acme".parse().expect("a name"), NOW, rng).expect("a fleet");
    let request = EnrollRequest::new("arm-1".parse().expect("a name"), NOW);
    let arm = fleet.enroll(&request, rng).expect("an identity");
    fleet.rotate_secret(NOW, rng).expect("a secret");
    fleet.revoke(&["arm-1".parse().expect("a name")], NOW).expect("a list");
    let list = fleet.revocation_list(NOW).expect("a list");
    let again = fleet.enroll(&EnrollRequest { again: true, ..request }, rng).expect("an identity");
    let csr = KeyRequest::generate(None, rng).expect("a request").csr_text();
    fleet.set_authority(Some("keeper".parse().expect("a name")), NOW).expect("a setting");
    let invited = EnrollRequest::new("arm-2".parse().expect("a name"), NOW);
    let routers = vec!["quic://hub:7447".to_owned()];
    let invitation = fleet.invite(&invited, Duration::from_secs(900), routers, rng).expect("an invitation");
    let seeds: [(u8, Vec<u8>); 11] = [
        (0, arm.to_text().as_bytes().to_vec()),
        (1, arm.to_text().as_bytes().to_vec()),
        (2, fleet.to_text().as_bytes().to_vec()),
        (3, arm.to_text().as_bytes().to_vec()),
        (3, csr.into_bytes()),
        (4, list),
        (5, arm.chain()[0].to_vec()),
        (5, fleet.ca_certificate().to_vec()),
        (6, arm.csr()),
        (5, again.chain()[0].to_vec()),
        (1, invitation.to_text().as_bytes().to_vec()),
    ];
    seeds.into_iter().map(|(which, seed)| [&[which], &seed[..]].concat()).collect()
}

/// Returns inputs of suite, size, cut and alteration: none, a byte of the header, a byte of the payload, or truncation.
fn sink() -> Vec<Vec<u8>> {
    let edits: [&[u8]; 4] = [&[], &[0, 1, 1], &[0, 90, 1], &[0, 100, 0]];
    let mut out: Vec<_> = (0..Suite::ALL.len() as u8)
        .flat_map(|suite| edits.map(|edits| [&[suite, 1, 3], edits].concat()))
        .collect();
    out.extend(edits.map(|edits| [&[2, 200, 50], edits].concat()));
    for (n, packet) in packets(&Suite::ALL[..4]).into_iter().enumerate() {
        out.push([&[n as u8 / 5, 0, 0], &packet[..]].concat());
    }
    out
}

fn grants() -> Vec<Vec<u8>> {
    let rng = &mut ChaCha20Rng::seed_from_u64(4);
    let mut fleet = Fleet::create("acme".parse().expect("a name"), NOW, rng).expect("a fleet");
    let arm =
        fleet.enroll(&EnrollRequest::new("arm-1".parse().expect("a name"), NOW), rng).expect("an identity");
    let token = ShareToken {
        owner: arm.node_id(),
        owner_name: "arm-1".parse().expect("a name"),
        ca: fleet.ca_certificate().clone(),
        metadata: Metadata::topic("arm-1", "/tf", "tf2_msgs/msg/TFMessage"),
        secret: TopicSecret::from_bytes([8; 32]),
        routers: vec!["quic://router:1".into()],
        expires: NOW,
    };
    let mut out = Vec::new();
    for which in [1, 2, 4, 6, 7] {
        for kind in 0..3 {
            for edits in [&[][..], &[0, 40, 1], &[0, 200, 0], &[1, 4, 0x80, 0, 3, 2]] {
                out.push([&[which, kind], edits].concat());
            }
        }
    }
    for kind in 0..2 {
        out.push([&[0, kind][..], &[7; 1300]].concat());
        out.push([&[2, kind][..], &[9; 1216]].concat());
    }
    out.push([&[5, 0], token.to_text().as_bytes()].concat());
    out.push([&[6, 200], fleet.ca_certificate().as_ref()].concat());
    for body in bodies().into_iter().filter(|b| b[0] < 3) {
        out.push([&[3, body[0]], &body[1..], &[1; 70]].concat());
    }
    out.push([&[6, 1], &token.metadata.to_vec()[..]].concat());
    out
}

/// Returns tokens, alterations of one, origins of pages, and patterns with names.
fn access() -> Vec<Vec<u8>> {
    let seeds: [(u8, &[u8]); 7] = [
        (0, b"AAAA"),
        (1, &[0, 9, 3]),
        (1, &[0, 200, 0]),
        (2, b"http://localhost:8080"),
        (2, b"https://[2001:db8::1]"),
        (3, b"/camera/** /camera/left/image"),
        (3, b"/odom /odom"),
    ];
    seeds.into_iter().map(|(which, seed)| [&[which], seed].concat()).collect()
}

/// Returns definitions of a message, a service and an action, as `.msg` and as IDL, followed by `bytes`.
fn definitions(bytes: &[u8]) -> Vec<Vec<u8>> {
    let texts = [
        "int32[] a\nstring b\n",
        "float64<=3 a 1.5\nuint8 X=3\nwstring<=4 b\n",
        "module p { module msg { struct M { sequence<long> a; string b; }; }; };",
    ];
    let seed = |(choice, text): (usize, &str)| {
        let text_bytes = (text.len() as u16).to_be_bytes();
        [&[choice as u8], &text_bytes[..], text.as_bytes(), bytes].concat()
    };
    texts.into_iter().enumerate().map(seed).collect()
}

/// Returns beginnings of DTLS records: a handshake, application data, an alert, a record with a connection id (RFC
/// 9146).
fn dtls() -> Vec<Vec<u8>> {
    [[22, 254, 253], [23, 254, 253], [21, 254, 255], [25, 254, 253]]
        .map(|head| [&head[..], &[0, 0, 0, 0, 0, 0, 0, 1, 0, 4, 1, 2, 3, 4]].concat())
        .into()
}

/// Returns operations of two ends, and bytes to one.
fn mux() -> Vec<Vec<u8>> {
    vec![(0..200).map(|n| n % 7 * 2).collect(), [&[1][..], &[0; 40]].concat(), (1..=255).collect()]
}
