//! [`CycloneNetwork`] beside a hostile program on the local network, which speaks RTPS by hand over its own socket.
//!
//! The process and the topics of others continue, whatever the peer sends. It poses as Fast DDS, whose writers are
//! trusted most.

#![allow(clippy::unwrap_used)]

use std::net::UdpSocket;
use std::sync::mpsc::{Receiver, channel};
use std::time::{Duration, Instant};

use bytes::Bytes;
use sgc_dds::{CycloneNetwork, DdsConfig, DiscoveryRange};
use sgc_ros::{DiscoveryEvent, EndpointSpec, Guid, RosNetwork, RosWriter, Sample, SampleHead, SampleKind};
use sgc_wire::Qos;

/// Longest wait for an event, far beyond what any takes.
const PATIENCE: Duration = Duration::from_secs(30);

/// Ports of a domain (RTPS 2.5, 9.6.2.3).
const PORT_BASE: u16 = 7400;
const DOMAIN_GAIN: u16 = 250;
/// Participants of this process whose ports are tried.
const PARTICIPANTS: u16 = 4;

const DATA: u8 = 0x15;
const DATA_FRAG: u8 = 0x16;
const HEARTBEAT: u8 = 0x07;
/// Flags for little endian with a payload.
const DATA_FLAGS: u8 = 0x05;
const FRAG_FLAGS: u8 = 0x01;

/// Entity ids (RTPS 2.5, 9.3.1.3).
const PARTICIPANT: [u8; 4] = [0, 0, 1, 0xc1];
const SPDP_WRITER: [u8; 4] = [0, 1, 0, 0xc2];
const SEDP_WRITER: [u8; 4] = [0, 0, 3, 0xc2];
const SEDP_READER: [u8; 4] = [0, 0, 3, 0xc7];
const USER_WRITER: [u8; 4] = [0, 0, 0x13, 0x03];
const ANY: [u8; 4] = [0; 4];

fn number(n: i64) -> [u8; 8] {
    let mut bytes = [0; 8];
    bytes[..4].copy_from_slice(&((n >> 32) as i32).to_le_bytes());
    bytes[4..].copy_from_slice(&(n as u32).to_le_bytes());
    bytes
}

fn parameter(pid: u16, value: &[u8]) -> Vec<u8> {
    let mut value = value.to_vec();
    value.resize(value.len().next_multiple_of(4), 0);
    [&pid.to_le_bytes()[..], &(value.len() as u16).to_le_bytes(), &value].concat()
}

/// Encodes a sequence of bytes, or a string with its terminator.
fn counted(bytes: &[u8]) -> Vec<u8> {
    [&(bytes.len() as u32).to_le_bytes()[..], bytes].concat()
}

fn list(parameters: &[Vec<u8>]) -> Vec<u8> {
    [&[0, 3, 0, 0][..], &parameters.concat(), &parameter(1, &[])].concat()
}

fn submessage(kind: u8, flags: u8, content: &[u8]) -> Vec<u8> {
    // A length that does not fit means all that follows.
    let length = u16::try_from(content.len()).unwrap_or(0);
    [&[kind, flags][..], &length.to_le_bytes(), content].concat()
}

fn data(reader: [u8; 4], writer: [u8; 4], n: i64, payload: &[u8]) -> Vec<u8> {
    submessage(DATA, DATA_FLAGS, &[&[0, 0, 16, 0][..], &reader, &writer, &number(n), payload].concat())
}

fn heartbeat(reader: [u8; 4], writer: [u8; 4], [first, last]: [i64; 2], count: u32) -> Vec<u8> {
    let numbers = [number(first), number(last)].concat();
    submessage(HEARTBEAT, 0x03, &[&reader[..], &writer, &numbers, &count.to_le_bytes()].concat())
}

/// Returns a fragment of a sample of `bytes` bytes.
fn fragment(writer: [u8; 4], n: i64, at: u32, bytes: u32, payload: &[u8]) -> Vec<u8> {
    let head = [&[0, 0, 28, 0][..], &ANY, &writer, &number(n), &at.to_le_bytes()].concat();
    let size =
        [&1_u16.to_le_bytes()[..], &(payload.len() as u16).to_le_bytes(), &bytes.to_le_bytes()].concat();
    submessage(DATA_FRAG, FRAG_FLAGS, &[&head[..], &size, payload].concat())
}

/// A hostile program.
struct Liar {
    socket: UdpSocket,
    domain: u16,
}

impl Liar {
    fn new(domain: u16) -> Self {
        Self { socket: UdpSocket::bind(("127.0.0.1", 0)).unwrap(), domain }
    }

    fn prefix(participant: u32) -> [u8; 12] {
        let mut prefix = [0x66; 12];
        prefix[..2].copy_from_slice(&[1, 0x0f]);
        prefix[8..].copy_from_slice(&participant.to_be_bytes());
        prefix
    }

    fn guid(participant: u32, entity: [u8; 4]) -> Vec<u8> {
        [&Self::prefix(participant)[..], &entity].concat()
    }

    /// Sends a message to the discovery ports or to those for samples. A message that does not fit a datagram is not
    /// sent.
    fn say(&self, participant: u32, is_discovery: bool, submessages: &[Vec<u8>]) {
        let header = [&b"RTPS\x02\x03\x01\x0f"[..], &Self::prefix(participant)].concat();
        let message = [header, submessages.concat()].concat();
        for index in 0..PARTICIPANTS {
            let port = PORT_BASE + DOMAIN_GAIN * self.domain + 10 + 2 * index + u16::from(!is_discovery);
            let _ = self.socket.send_to(&message, ("127.0.0.1", port));
        }
    }

    fn announce(&self, participant: u32, user_data: &[u8]) {
        let port = u32::from(self.socket.local_addr().unwrap().port());
        let locator = [&1_u32.to_le_bytes()[..], &port.to_le_bytes(), &[0; 12], &[127, 0, 0, 1]].concat();
        let parameters = [
            parameter(0x15, &[2, 3]),
            parameter(0x16, &[1, 0x0f]),
            parameter(0x50, &Self::guid(participant, PARTICIPANT)),
            parameter(0x32, &locator),
            parameter(0x31, &locator),
            parameter(0x02, &[100, 0, 0, 0, 0, 0, 0, 0]),
            parameter(0x58, &0xc3f_u32.to_le_bytes()),
            parameter(0x2c, &counted(user_data)),
        ];
        self.say(participant, true, &[data(ANY, SPDP_WRITER, 1, &list(&parameters))]);
    }

    /// Announces a reliable writer, the `n`th endpoint of its participant.
    fn announce_writer(&self, participant: u32, n: i64, entity: [u8; 4], topic: &[u8], more: &[Vec<u8>]) {
        let parameters = [
            &[
                parameter(0x5a, &Self::guid(participant, entity)),
                parameter(0x05, &counted(&[topic, &[0]].concat())),
                parameter(0x07, &counted(b"std_msgs::msg::dds_::String_\0")),
                parameter(0x1a, &[2, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0]),
            ],
            more,
        ]
        .concat();
        let count = u32::try_from(n).unwrap();
        self.say(
            participant,
            true,
            &[
                heartbeat(SEDP_READER, SEDP_WRITER, [1, n], count),
                data(SEDP_READER, SEDP_WRITER, n, &list(&parameters)),
            ],
        );
    }
}

fn open(domain: u16, tag: Option<&str>) -> CycloneNetwork {
    let config = DdsConfig {
        domain: domain.into(),
        discovery: DiscoveryRange::LocalHost,
        tag: tag.map(str::to_owned),
        graph: true,
        ..DdsConfig::default()
    };
    CycloneNetwork::open(&config).unwrap()
}

fn spec() -> EndpointSpec {
    EndpointSpec {
        topic: "rt/chatter".into(),
        type_name: "std_msgs::msg::dds_::String_".into(),
        keyless: true,
        asks_key_hash: false,
        type_hash: None,
        qos: Qos::default(),
    }
}

fn discover(network: &CycloneNetwork) -> Receiver<DiscoveryEvent> {
    let (tx, rx) = channel();
    network.discover(Box::new(move |event| drop(tx.send(event)))).unwrap();
    rx
}

/// Waits until a hostile writer is discovered, and repeats its announcement meanwhile, because participants are known
/// only a moment after their own announcement.
fn found(events: &Receiver<DiscoveryEvent>, guid: &[u8], say: impl Fn()) {
    let deadline = Instant::now() + PATIENCE;
    while Instant::now() < deadline {
        say();
        while let Ok(event) = events.recv_timeout(Duration::from_millis(100)) {
            if matches!(&event, DiscoveryEvent::Appeared(endpoint) if endpoint.guid.0[..] == *guid) {
                return;
            }
        }
    }
    panic!("the liar is not found");
}

/// A proxy, an honest program, and a hostile program whose writer the proxy knows.
struct Scene {
    proxy: CycloneNetwork,
    events: Receiver<DiscoveryEvent>,
    _honest: CycloneNetwork,
    talker: sgc_dds::CycloneWriter,
    _reader: sgc_dds::CycloneReader,
    samples: Receiver<Sample>,
    liar: Liar,
    said: u32,
}

impl Scene {
    fn new(domain: u16) -> Self {
        let (proxy, honest) = (open(domain, Some("proxy")), open(domain, None));
        let events = discover(&proxy);
        let (tx, samples) = channel();
        let reader = proxy.create_reader(&spec(), Box::new(move |sample| drop(tx.send(sample)))).unwrap();
        let talker = honest.create_writer(&spec()).unwrap();
        let liar = Liar::new(domain);
        found(&events, &Liar::guid(0, USER_WRITER), || {
            liar.announce(0, b"enclave=/;");
            liar.announce_writer(0, 1, USER_WRITER, b"rt/chatter", &[]);
        });
        let mut scene =
            Self { proxy, events, _honest: honest, talker, _reader: reader, samples, liar, said: 0 };
        scene.assert_goes_on("at first");
        scene
    }

    /// Asserts that the honest program's samples arrive.
    fn assert_goes_on(&mut self, when: &str) {
        let begun = Instant::now();
        self.said += 1;
        let text = format!("honest {}\0", self.said);
        let payload: Bytes = [&[0, 1, 0, 0][..], &counted(text.as_bytes())].concat().into();
        assert!(self.talker.wait_matched(1, PATIENCE) >= 1, "{when}");
        let head = SampleHead::new(SampleKind::Write, 1_000_000_000);
        self.talker.write_ahead(head, payload).unwrap();
        self.talker.flush();
        loop {
            let left = PATIENCE.saturating_sub(begun.elapsed());
            let sample = self.samples.recv_timeout(left);
            let sample = sample.unwrap_or_else(|_| panic!("the honest program is not heard {when}"));
            let said = sample.payload.windows(text.len()).any(|part| part == text.as_bytes());
            if said && sample.writer == Some(self.talker.guid()) {
                return;
            }
        }
    }
}

#[test]
fn numbers_at_the_end_of_their_range_hold_up_nobody() {
    let mut scene = Scene::new(190);
    let sample = [&[0, 1, 0, 0][..], &counted(b"lie\0")].concat();
    let ends = [i64::MAX, i64::MAX - 1, i64::MIN, -1, 0, 1 << 32, (1 << 32) - 1, 2];
    for (count, (first, last)) in (1..).zip(ends.into_iter().flat_map(|a| ends.map(|b| (a, b)))) {
        let submessages = [
            heartbeat(ANY, USER_WRITER, [first, last], count),
            data(ANY, USER_WRITER, last, &sample),
            heartbeat(ANY, USER_WRITER, [first, last], count + 1000),
            fragment(USER_WRITER, first, 1, u32::MAX, &sample),
            fragment(USER_WRITER, last, u32::MAX, 8, &sample),
            fragment(USER_WRITER, last, 0, 0, &[]),
        ];
        scene.liar.say(0, false, &submessages);
        submessages.into_iter().for_each(|one| scene.liar.say(0, false, &[one]));
    }
    scene.assert_goes_on("after numbers at the end of their range");
    let guid = Guid(Liar::guid(0, USER_WRITER).try_into().unwrap());
    for event in scene.events.try_iter() {
        let is_of_liar =
            matches!(&event, DiscoveryEvent::HistoryDepth { guid: of, depth } if *of == guid && *depth == 0);
        assert!(!is_of_liar, "{event:?}");
    }
}

#[test]
fn fragments_that_never_end_hold_up_nobody() {
    let mut scene = Scene::new(191);
    let piece = vec![7; 8000];
    for n in 1..=400 {
        scene.liar.say(0, false, &[fragment(USER_WRITER, n, 1 + n as u32 % 7, 1 << 30, &piece)]);
        if n % 100 == 0 {
            scene.assert_goes_on("after fragments");
        }
    }
}

/// The allocator gives more than an announcement needs, so four bytes beyond its end would do no harm here, and
/// appear as an endpoint.
#[test]
fn fragments_that_reach_beyond_their_announcement_are_refused() {
    let mut scene = Scene::new(194);
    for (n, cut, name) in [(2, 4, b"rt/beyond"), (3, 0, b"rt/within")] {
        let entity = [0, 4, n, 3];
        let mut announcement = list(&[
            parameter(0x5a, &Liar::guid(0, entity)),
            parameter(0x05, &counted(&[&name[..], &[0]].concat())),
            parameter(0x07, &counted(b"std_msgs::msg::dds_::String_\0")),
        ]);
        announcement.extend([0; 4]);
        announcement.resize(announcement.len().next_multiple_of(8), 0);
        let bytes = announcement.len() as u32;
        let halves = announcement.chunks(announcement.len() / 2).zip((1..).zip([bytes - cut, bytes]));
        let mut said = vec![heartbeat(SEDP_READER, SEDP_WRITER, [1, n.into()], n.into())];
        said.extend(halves.map(|(half, (at, bytes))| fragment(SEDP_WRITER, n.into(), at, bytes, half)));
        scene.liar.say(0, true, &said);
    }
    let deadline = Instant::now() + PATIENCE;
    let mut topics = Vec::new();
    while !topics.iter().any(|topic| topic == "rt/within") {
        match scene.events.recv_timeout(deadline.saturating_duration_since(Instant::now())) {
            Ok(DiscoveryEvent::Appeared(endpoint)) => topics.push(endpoint.topic),
            Ok(_) => {}
            Err(_) => panic!("the announcement that is whole is not read: {topics:?}"),
        }
    }
    assert!(!topics.contains(&"rt/beyond".to_owned()), "{topics:?}");
    scene.assert_goes_on("after fragments of announcements");
}

#[test]
fn hostile_names_are_bounded_and_hold_up_nobody() {
    let mut scene = Scene::new(192);
    let long = vec![b'a'; 60_000];
    let user_data = counted(&[&b"typehash=RIHS01_"[..], &long].concat());
    let names: [&[u8]; 6] = [&long, b"rt/a\nb", b"rt/\x1b[2J", b"rt/\xff\xfe", b"", b"rt/chatter"];
    for (n, name) in (2..).zip(names) {
        let entity = [0, 1, n as u8, 3];
        scene.liar.announce_writer(
            0,
            n,
            entity,
            name,
            &[parameter(0x2c, if n == 2 { &[] } else { &user_data })],
        );
    }
    // Lengths and counts exceed the data.
    for (n, pid) in (8..).zip([0x05_u16, 0x07, 0x2c, 0x29, 0x75, 0x1a, 0x50, 0x5a]) {
        for value in [&u32::MAX.to_le_bytes()[..], &[0xff; 16], &[]] {
            scene.liar.announce_writer(0, n, [0, 2, n as u8, 3], b"rt/x", &[parameter(pid, value)]);
        }
    }
    scene.liar.announce_writer(0, 16, [0, 3, 0, 3], b"rt/last", &[]);
    found_bounded(&scene.events, &Liar::guid(0, [0, 3, 0, 3]));
    scene.assert_goes_on("after hostile names");
}

/// Waits for a writer, and checks the names of the endpoints before it.
fn found_bounded(events: &Receiver<DiscoveryEvent>, guid: &[u8]) {
    let deadline = Instant::now() + PATIENCE;
    while let Ok(event) = events.recv_timeout(deadline.saturating_duration_since(Instant::now())) {
        if let DiscoveryEvent::Appeared(endpoint) = &event {
            assert!(
                endpoint.topic.len() <= 512 && endpoint.type_name.len() <= 512,
                "{} bytes",
                endpoint.topic.len()
            );
            assert_eq!(endpoint.type_hash, None, "it is too long for one");
            if endpoint.guid.0[..] == *guid {
                return;
            }
        }
    }
    panic!("the last one is not found");
}

#[test]
fn thousands_of_participants_hold_up_nobody() {
    let mut scene = Scene::new(193);
    for participant in 1..=2000 {
        scene.liar.announce(participant, b"enclave=/hostile;");
        scene.liar.announce_writer(participant, 1, USER_WRITER, b"rt/chatter", &[]);
        if participant % 500 == 0 {
            scene.assert_goes_on("after a flood of participants");
        }
    }
    scene.assert_goes_on("after thousands of participants");
    drop(scene.proxy);
}
