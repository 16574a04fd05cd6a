//! Behaviour of [`CycloneNetwork`] between participants that talk over the loopback interface, beside that of every
//! network (`conformance.rs`).
//!
//! Each test has its own ROS domain, so that tests run side by side. An untagged network stands for a plain ROS 2
//! process. Each network is its own Cyclone domain, so everything here crosses sockets.

#![allow(clippy::unwrap_used)]

use std::net::UdpSocket;
use std::sync::atomic::{AtomicBool, AtomicUsize, Ordering::Relaxed, Ordering::SeqCst};
use std::sync::mpsc::{Receiver, RecvTimeoutError, Sender, channel};
use std::sync::{Arc, Mutex};
use std::time::{Duration, Instant};

use bytes::Bytes;
use sgc_dds::qos::UNACKNOWLEDGED_MAX;
use sgc_dds::{CycloneNetwork, CycloneReader, CycloneWriter, DdsConfig, DiscoveryRange};
use sgc_ros::graph::{GidBytes, decode_nodes, encode_nodes, graph_reader, graph_writer};
use sgc_ros::{
    DiscoveredEndpoint, DiscoveryEvent, EndpointKind, EndpointSpec, GraphNode, Guid, HandleSamples, RosError,
    RosNetwork, RosWriter, Sample, SampleHead, SampleKind, UNACKNOWLEDGED_MIN,
};
use sgc_testkit::conformance::rig::{
    self, PATIENCE, QUIET, discover, eventually, matched, next, padded, quiet, read, string_cdr, with, write,
    writer,
};
use sgc_wire::{Durability, History, Liveliness, Qos, Reliability, RosNode};

fn config(domain: u32, tag: Option<&str>) -> DdsConfig {
    DdsConfig {
        domain,
        discovery: DiscoveryRange::LocalHost,
        tag: tag.map(str::to_owned),
        ..DdsConfig::default()
    }
}

fn open(domain: u32, tag: Option<&str>) -> CycloneNetwork {
    CycloneNetwork::open(&config(domain, tag)).unwrap()
}

fn spec(topic: &str) -> EndpointSpec {
    EndpointSpec { type_hash: None, ..rig::spec(topic) }
}

fn appeared(events: &Receiver<DiscoveryEvent>) -> DiscoveredEndpoint {
    match next(events) {
        DiscoveryEvent::Appeared(endpoint) => endpoint,
        other => panic!("an appearance was expected: {other:?}"),
    }
}

fn vanished(events: &Receiver<DiscoveryEvent>) -> Guid {
    match next(events) {
        DiscoveryEvent::Vanished { guid } => guid,
        other => panic!("an end was expected: {other:?}"),
    }
}

#[test]
fn discovery_tells_whether_a_type_has_a_key_and_begins_once() {
    let (ros, sgc) = (open(72, None), open(72, Some("arm-1")));
    let events = discover(&sgc);
    for keyless in [false, true] {
        let writer = ros.create_writer(&EndpointSpec { keyless, ..spec("keyed") }).unwrap();
        assert_eq!(appeared(&events).keyless, keyless);
        drop(writer);
        vanished(&events);
    }
    assert!(matches!(sgc.discover(Box::new(|_| {})), Err(RosError::Domain { domain: 72, .. })));
}

/// Length of the fragments of [`fragment`], in bytes.
const FRAGMENT_BYTES: u16 = 52;

/// Returns an RTPS message with one fragment of a best-effort writer's sample (RTPS 2.5, 9.4.5.5). Fragments count
/// from 1.
fn fragment(writer: Guid, number: u32, fragment: u32, sample_bytes: u32) -> Vec<u8> {
    let body = 32 + FRAGMENT_BYTES;
    let mut packet = b"RTPS\x02\x01\x01\x10".to_vec();
    packet.extend(&writer.0[..12]);
    // DATA_FRAG, little endian.
    packet.extend([0x16, 1]);
    packet.extend(body.to_le_bytes());
    // No extra flags; the payload begins 28 bytes behind this field; for any reader.
    packet.extend([0, 0, 28, 0, 0, 0, 0, 0]);
    packet.extend(&writer.0[12..]);
    packet.extend([0; 4]);
    packet.extend(number.to_le_bytes());
    packet.extend(fragment.to_le_bytes());
    packet.extend([1, 0]);
    packet.extend(FRAGMENT_BYTES.to_le_bytes());
    packet.extend(sample_bytes.to_le_bytes());
    let header: &[u8] = if fragment == 1 { &[0, 1, 0, 0] } else { &[7; 4] };
    packet.extend(header);
    packet.resize(packet.len() + usize::from(FRAGMENT_BYTES) - header.len(), 7);
    packet
}

/// Cyclone and `cyclors` copy a sample's fragments into memory of the length that the first one announces. The
/// allocator gives more than 100 bytes, so four bytes beyond the end would do no harm here, and appear as a sample.
#[test]
fn fragments_that_reach_beyond_their_sample_are_refused() {
    const DOMAIN: u32 = 100;
    let (ros, sgc) = (open(DOMAIN, None), open(DOMAIN, Some("arm-1")));
    let socket = UdpSocket::bind("127.0.0.1:0").unwrap();
    // Ports of the first participants of a host (RTPS 2.5, 9.6.2.3). Cyclone accepts data on the discovery port as
    // well.
    let send = |packet: &[u8]| {
        for participant in 0..8 {
            let port = (7400 + 250 * DOMAIN + 10 + 2 * participant) as u16;
            socket.send_to(packet, ("127.0.0.1", port)).unwrap();
        }
    };
    for keyless in [true, false] {
        let spec = with(EndpointSpec { keyless, ..spec(&format!("pieces{keyless}")) }, |q| {
            q.reliability = Reliability::BestEffort;
        });
        let (_reader, samples) = read(&sgc, &spec);
        let writer = writer(&ros, &spec, 1);
        // A best-effort sample is lost until the reader knows the writer.
        eventually("the reader hears the writer", || {
            write(&writer, &string_cdr("known"));
            samples.recv_timeout(QUIET).is_ok()
        });
        while samples.recv_timeout(QUIET).is_ok() {}
        for (number, announced) in [(1000, [100, 104]), (1001, [104, 104])] {
            for (at, bytes) in (1..).zip(announced) {
                send(&fragment(writer.guid(), number, at, bytes));
            }
        }
        let sample = next(&samples);
        assert_eq!(
            sample.payload.len(),
            2 * usize::from(FRAGMENT_BYTES),
            "the sample of 100 bytes was taken"
        );
        quiet(&samples);
    }
}

#[test]
fn odd_lengths_are_padded_with_zeros_and_say_so() {
    let (ros, sgc) = (open(78, None), open(78, Some("arm-1")));
    let (_reader, samples) = read(&ros, &spec("odd"));
    let writer = writer(&sgc, &spec("odd"), 1);
    for body in 0..9 {
        // The payload lies in the middle of a buffer whose other bytes must not be sent.
        let mut buffer = vec![0xaa; 64];
        buffer[16..20].copy_from_slice(&[0, 1, 0, 0]);
        buffer[20..20 + body].fill(0x55);
        let payload = Bytes::from(buffer).slice(16..20 + body);
        write(&writer, &payload);
        let got = next(&samples).payload;
        assert_eq!(got, padded(&payload));
        assert_eq!(got[3] & 3, (body.wrapping_neg() & 3) as u8);
        assert!(!got.contains(&0xaa));
    }
}

#[test]
fn invalid_payloads_are_refused() {
    let sgc = open(79, Some("arm-1"));
    let writer = sgc.create_writer(&spec("bad")).unwrap();
    let write = |ts, payload: &'static [u8]| writer.write(SampleKind::Write, ts, Bytes::from_static(payload));
    assert_eq!(write(0, b""), Err(RosError::Payload { bytes: 0 }));
    assert_eq!(write(0, &[0, 1, 0]), Err(RosError::Payload { bytes: 3 }));
    assert_eq!(write(0, b"{\"data\":1}"), Err(RosError::Payload { bytes: 10 }));
    assert!(matches!(write(-1, &[0, 1, 0, 0]), Err(RosError::Write { .. })));
    assert!(matches!(write(i64::MAX, &[0, 1, 0, 0]), Err(RosError::Write { .. })));
    let dispose = writer.write(SampleKind::Dispose, 0, Bytes::from_static(&[0, 1, 0, 0]));
    assert!(matches!(dispose, Err(RosError::Write { .. })), "no key, nothing to dispose of");
    assert_eq!(write(0, &[0, 1, 0, 0]), Ok(()));

    let nul = EndpointSpec { topic: "rt/a\0b".into(), ..spec("bad") };
    assert!(matches!(sgc.create_writer(&nul), Err(RosError::Create { kind: "writer", .. })));
    let hash = EndpointSpec { type_hash: Some("RIHS01;sgc=x".into()), ..spec("bad") };
    assert!(matches!(
        sgc.create_reader(&hash, Box::new(|_| {})),
        Err(RosError::Create { kind: "reader", .. })
    ));
}

#[test]
fn samples_that_readers_have_acknowledged_are_not_counted() {
    let (ros, sgc) = (open(163, None), open(163, Some("arm-1")));
    let spec = with(spec("counted"), |qos| qos.history = History::KeepLast(100));
    let writer = sgc.create_writer(&spec).unwrap();
    assert_eq!(writer.unacknowledged(), Some(0));
    let _reader = read(&ros, &spec);
    matched(&writer, 1);
    let ahead = |text: &str| {
        let head = SampleHead::new(SampleKind::Write, 1_000_000_000);
        writer.write_ahead(head, string_cdr(text)).unwrap();
    };
    // A heartbeat may be due at any time, and a reader that hears it asks for what it lacks.
    ros.set_deaf_mute(Duration::from_secs(2));
    (0..5).for_each(|i| ahead(&i.to_string()));
    assert_eq!(writer.unacknowledged(), Some(5));
    assert!(writer.wait_acknowledged(PATIENCE));
    assert_eq!(writer.unacknowledged(), Some(0));
}

#[test]
fn readers_acknowledge_while_a_writer_never_pauses() {
    const SAMPLES: u32 = 1000;
    let (ros, sgc) = (open(164, None), open(164, Some("arm-1")));
    let spec = with(spec("steady"), |qos| qos.history = History::KeepLast(10));
    let writer = sgc.create_writer(&spec).unwrap();
    let _reader = read(&ros, &spec);
    matched(&writer, 1);
    assert_eq!(writer.kept(10), Some(1024));
    let mut most = 0;
    for i in 0..SAMPLES {
        write(&writer, &string_cdr(&i.to_string()));
        std::thread::sleep(Duration::from_micros(200));
        most = most.max(writer.unacknowledged().unwrap());
    }
    // It asks four times while it writes as many samples as it keeps.
    assert!(most < SAMPLES / 2, "{most} of {SAMPLES}");
}

fn latched(topic: &str, history: History) -> EndpointSpec {
    with(spec(topic), |qos| (qos.durability, qos.history) = (Durability::TransientLocal, history))
}

/// The depth is set later for a publisher that announced none.
#[test]
fn late_joiners_get_history_of_a_depth_that_is_set_later() {
    let (ros, sgc) = (open(57, None), open(57, Some("arm-1")));
    let writer = sgc.create_writer(&latched("map", History::UNSAID)).unwrap();
    let (_early, early) = read(&ros, &latched("map", History::KeepLast(50)));
    matched(&writer, 1);
    let texts: Vec<String> = (0..20).map(|i| i.to_string()).collect();
    let assert_late = |first: usize, last: usize| {
        let (_late, samples) = read(&ros, &latched("map", History::KeepLast(50)));
        for text in &texts[first..last] {
            assert_eq!(next(&samples).payload, padded(&string_cdr(text)));
        }
    };
    for text in &texts[..10] {
        write(&writer, &string_cdr(text));
    }
    assert_late(0, 10);
    writer.set_late_depth(5);
    assert_late(5, 10);
    for text in &texts[10..20] {
        write(&writer, &string_cdr(text));
    }
    // Readers of one participant receive samples in transit to any of them.
    for text in &texts[..20] {
        assert_eq!(next(&early).payload, padded(&string_cdr(text)), "all come, once");
    }
    assert_late(15, 20);
}

/// The bound holds for any number of such writers and any length of samples.
#[test]
fn history_of_unknown_depth_is_bounded_in_bytes() {
    const LONG_BYTES: usize = 4 << 20;
    let (ros, sgc) = (open(58, None), open(58, Some("arm-1")));
    let long = |n: u8| Bytes::from([&[0, 1, 0, 0, n, 0, 0, 0][..], &vec![n; LONG_BYTES - 8]].concat());
    let heard = |topic: &str, count: usize| {
        let (_late, samples) = read(&ros, &latched(topic, History::KeepLast(50)));
        (0..count).map(|_| next(&samples).payload[4]).collect::<Vec<_>>()
    };
    let first = sgc.create_writer(&latched("first", History::UNSAID)).unwrap();
    for n in 0..20 {
        write(&first, &long(n));
    }
    assert_eq!(heard("first", 16), (4..20).collect::<Vec<_>>(), "64 MiB of one");
    let writers: Vec<_> = (1..32)
        .map(|n| sgc.create_writer(&latched(&format!("other_{n}"), History::UNSAID)).unwrap())
        .collect();
    write(&first, &long(20));
    assert_eq!(heard("first", 2), [19, 20], "256 MiB of 32");
    drop(writers);
}

#[test]
fn blocked_keep_all_reader_delays_no_other_reader() {
    const SAMPLES: usize = 2000;
    let (ros, sgc) = (open(99, None), open(99, Some("arm-1")));
    let (release, gate) = channel::<()>();
    let (seen_tx, seen) = channel();
    let all = with(spec("stuck_all"), |qos| qos.history = History::KeepAll);
    let _stuck = sgc
        .create_reader(
            &all,
            Box::new(move |sample: Sample| {
                let _ = gate.recv();
                let _ = seen_tx.send(sample.payload);
            }),
        )
        .unwrap();
    let (_free, free) = read(&sgc, &spec("free"));
    let (w_stuck, w_free) = (writer(&ros, &all, 1), writer(&ros, &spec("free"), 1));
    // More samples than the crowded level, and fewer than may be queued.
    for i in 0..SAMPLES {
        write(&w_stuck, &string_cdr(&format!("stuck {i}")));
        if i % 20 == 0 {
            write(&w_free, &string_cdr(&format!("free {i}")));
            assert_eq!(next(&free).payload, padded(&string_cdr(&format!("free {i}"))));
        }
    }
    drop(release);
    for i in 0..SAMPLES {
        assert_eq!(next(&seen), padded(&string_cdr(&format!("stuck {i}"))));
    }
}

/// A `std_msgs/String` that begins with a number and is long, as CDR.
fn numbered(number: usize, bytes: usize) -> Bytes {
    string_cdr(&format!("{number:08}{}", "x".repeat(bytes)))
}

/// Returns the number of such a string.
fn number_of(payload: &[u8]) -> usize {
    std::str::from_utf8(&payload[8..16]).unwrap().parse().unwrap()
}

/// Returns a reader whose handler waits at a gate after each sample, until the sender is dropped.
fn gated(network: &CycloneNetwork, spec: &EndpointSpec) -> (CycloneReader, Sender<()>, Receiver<Outcome>) {
    let ((release, gate), (tell, handled)) = (channel(), channel());
    let choosy = Choosy { may: Arc::default(), gate, handled: tell };
    (network.create_reader(spec, Box::new(choosy)).unwrap(), release, handled)
}

/// Returns a writer whose samples reach a handler that then waits. They begin with number 1.
fn numbering(network: &CycloneNetwork, spec: &EndpointSpec, handled: &Receiver<Outcome>) -> CycloneWriter {
    let writer = writer(network, spec, 1);
    eventually("the reader knows the writer", || {
        write(&writer, &numbered(0, 0));
        handled.recv_timeout(QUIET).is_ok()
    });
    writer
}

/// A thread that writes numbered samples to a `KEEP_ALL` writer, each until it is taken, and the number of the last one
/// so far.
fn flood(
    writer: CycloneWriter,
    samples: usize,
    bytes: usize,
) -> (std::thread::JoinHandle<CycloneWriter>, Arc<AtomicUsize>) {
    let taken = Arc::new(AtomicUsize::new(0));
    let count = taken.clone();
    let thread = std::thread::spawn(move || {
        for number in 1..=samples {
            let payload = numbered(number, bytes);
            let head = || SampleHead::new(SampleKind::Write, 1_000_000_000);
            while writer.write_ahead(head(), payload.clone()).is_err() {}
            writer.flush();
            count.store(number, SeqCst);
        }
        writer
    });
    (thread, taken)
}

/// Returns the number of the next sample that a handler gets, or the number of those that are lost.
fn next_number(handled: &Receiver<Outcome>) -> Result<usize, usize> {
    loop {
        match next(handled) {
            Outcome::Overrun(samples) => return Err(samples as usize),
            Outcome::OnAWorker(payload) | Outcome::AtOnce(payload) => match number_of(&payload) {
                0 => {}
                number => return Ok(number),
            },
        }
    }
}

/// Adds what a handler gets to the numbers of received samples and to the count of lost ones, up to this number.
fn receive_until(last: usize, handled: &Receiver<Outcome>, numbers: &mut Vec<usize>, overrun: &mut usize) {
    while numbers.last() != Some(&last) {
        match next_number(handled) {
            Ok(number) => numbers.push(number),
            Err(lost) => *overrun += lost,
        }
    }
}

/// Waits until a writer has to wait.
fn stalled(taken: &AtomicUsize) -> usize {
    let mut seen = (usize::MAX, Instant::now());
    eventually("the writer waits", || {
        let now = taken.load(SeqCst);
        if now != seen.0 {
            seen = (now, Instant::now());
        }
        seen.1.elapsed() > Duration::from_millis(700)
    });
    seen.0
}

#[test]
fn keep_all_writer_waits_for_a_reader_without_room_and_loses_nothing() {
    // Samples of one packet and of several. All together are more than a queue may hold.
    for (domain, samples, bytes) in [(167, 40_000, 100), (168, 1000, 200_000)] {
        let (ros, sgc) = (open(domain, None), open(domain, Some("arm-1")));
        let all = with(spec("all"), |qos| qos.history = History::KeepAll);
        let (_reader, release, handled) = gated(&sgc, &all);
        let (_free, free) = read(&sgc, &spec("free"));
        let (w_all, w_free) = (numbering(&ros, &all, &handled), writer(&ros, &spec("free"), 1));
        let (thread, taken) = flood(w_all, samples, bytes);
        let waits_at = stalled(&taken);
        assert!((1..samples).contains(&waits_at), "{waits_at} of {samples} were taken");
        // Meanwhile other topics flow.
        for i in 0..50 {
            let payload = string_cdr(&format!("free {i}"));
            write(&w_free, &payload);
            assert_eq!(next(&free).payload, padded(&payload));
        }
        assert_eq!(taken.load(SeqCst), waits_at);
        drop(release);
        (1..=samples).for_each(|number| assert_eq!(next_number(&handled), Ok(number)));
        thread.join().unwrap();
        quiet(&handled);
    }
}

#[test]
fn samples_that_a_keep_last_writer_drops_while_it_is_refused_are_counted() {
    const UNHEARD: usize = 20_000;
    let (ros, sgc) = (open(171, None), open(171, Some("arm-1")));
    let all = with(spec("last"), |qos| qos.history = History::KeepAll);
    let (_reader, release, handled) = gated(&sgc, &all);
    let writer = numbering(&ros, &spec("last"), &handled);
    let mut written = 0;
    let mut flood = |samples| {
        (written + 1..=written + samples).for_each(|number| write(&writer, &numbered(number, 0)));
        written += samples;
        written
    };
    // It drops nothing before it is refused.
    eventually("the writer is refused", || {
        flood(200);
        !writer.wait_acknowledged(Duration::from_secs(1))
    });
    flood(UNHEARD);
    drop(release);
    let (mut numbers, mut overrun) = (Vec::new(), 0);
    // Losses are counted a little later, and reported with the next sample.
    eventually("all is received or counted", || {
        let written = flood(1);
        receive_until(written, &handled, &mut numbers, &mut overrun);
        std::thread::sleep(Duration::from_millis(50));
        numbers.len() + overrun == written
    });
    assert!(numbers.is_sorted() && overrun > 0, "{overrun} were counted");
}

#[test]
fn writer_is_accepted_again_when_the_reader_that_refused_it_is_gone() {
    const SAMPLES: usize = 1000;
    let (ros, sgc) = (open(169, None), open(169, Some("arm-1")));
    let all = with(spec("all"), |qos| qos.history = History::KeepAll);
    let (reader, release, handled) = gated(&sgc, &all);
    let (thread, taken) = flood(numbering(&ros, &all, &handled), SAMPLES, 200_000);
    let waits_at = stalled(&taken);
    assert!(waits_at < SAMPLES);
    // A second reader of the writer gets nothing while the first one refuses.
    let (_second, second) = read(&sgc, &all);
    let ends = std::thread::spawn(move || drop(reader));
    drop(release);
    ends.join().unwrap();
    drop(handled);
    thread.join().unwrap();
    while number_of(&next(&second).payload) != SAMPLES {}
}

#[test]
fn writer_with_another_reader_here_is_not_refused() {
    const SAMPLES: usize = 1000;
    let (ros, sgc) = (open(172, None), open(172, Some("arm-1")));
    let all = with(spec("all"), |qos| qos.history = History::KeepAll);
    let (_stuck, release, handled) = gated(&sgc, &all);
    let (_free, free) = read(&sgc, &all);
    let writer = writer(&ros, &all, 2);
    eventually("the readers know the writer", || {
        write(&writer, &numbered(0, 0));
        handled.recv_timeout(QUIET).is_ok() && free.recv_timeout(QUIET).is_ok()
    });
    let (thread, _) = flood(writer, SAMPLES, 200_000);
    let mut numbers =
        std::iter::repeat_with(|| number_of(&next(&free).payload)).skip_while(|number| *number == 0);
    (1..=SAMPLES).for_each(|number| assert_eq!(numbers.next(), Some(number)));
    drop(release);
    thread.join().unwrap();
}

#[test]
fn writer_goes_on_if_a_reader_takes_nothing_for_ten_seconds() {
    const SAMPLES: usize = 1000;
    let (ros, sgc) = (open(170, None), open(170, Some("arm-1")));
    let all = with(spec("all"), |qos| qos.history = History::KeepAll);
    let (_reader, release, handled) = gated(&sgc, &all);
    let (thread, taken) = flood(numbering(&ros, &all, &handled), SAMPLES, 200_000);
    assert!(stalled(&taken) < SAMPLES);
    let began = Instant::now();
    thread.join().unwrap();
    assert!(began.elapsed() > Duration::from_secs(5), "it waited before");
    drop(release);
    let (mut numbers, mut overrun) = (Vec::new(), 0);
    receive_until(SAMPLES, &handled, &mut numbers, &mut overrun);
    assert!(numbers.is_sorted() && overrun > 0);
    assert_eq!(numbers.len() + overrun, SAMPLES, "each is received or counted");
}

#[test]
fn a_handler_that_blocks_delays_no_other_reader() {
    let (ros, sgc) = (open(82, None), open(82, Some("arm-1")));
    let (release, gate) = channel::<()>();
    let (entered_tx, entered) = channel();
    let shallow = with(spec("stuck"), |qos| qos.history = History::KeepLast(1));
    let stuck = sgc
        .create_reader(
            &shallow,
            Box::new(move |sample: Sample| {
                let _ = entered_tx.send(sample.payload);
                let _ = gate.recv();
            }),
        )
        .unwrap();
    let (_free, free) = read(&sgc, &spec("free"));
    let (w_stuck, w_free) = (writer(&ros, &spec("stuck"), 1), writer(&ros, &spec("free"), 1));
    write(&w_stuck, &string_cdr("first"));
    assert_eq!(next(&entered), padded(&string_cdr("first")));
    for i in 0..50 {
        write(&w_stuck, &string_cdr(&format!("stuck {i}")));
        write(&w_free, &string_cdr(&format!("free {i}")));
        assert_eq!(next(&free).payload, padded(&string_cdr(&format!("free {i}"))));
    }
    release.send(()).unwrap();
    assert_eq!(next(&entered), padded(&string_cdr("stuck 49")), "only the newest was kept");

    // Dropping the reader waits for its handler, which continues when the gate closes.
    drop(release);
    drop(stuck);
    assert_eq!(entered.recv_timeout(PATIENCE), Err(RecvTimeoutError::Disconnected), "the handler is gone");
}

#[test]
fn a_reader_says_whether_more_is_at_hand_and_never_at_the_end() {
    let (ros, sgc) = (open(97, None), open(97, Some("arm-1")));
    let (release, gate) = channel::<()>();
    let (seen_tx, seen) = channel();
    let _reader = sgc
        .create_reader(
            &spec("burst"),
            Box::new(move |sample: Sample| {
                let _ = seen_tx.send(sample.more);
                let _ = gate.recv();
            }),
        )
        .unwrap();
    let (arrived_tx, arrived) = channel();
    let arrives = move |_| {
        let _ = arrived_tx.send(());
    };
    let _witness = sgc.create_reader(&spec("burst"), Box::new(arrives)).unwrap();
    let writer = writer(&ros, &spec("burst"), 2);
    // The samples behind the gate are at hand together. The witness may be a moment ahead of the reader, so the gate
    // sometimes opens too early.
    let together = (0..20).any(|_| {
        write(&writer, &string_cdr("first"));
        assert!(!next(&seen), "nothing else was there");
        for i in 0..5 {
            write(&writer, &string_cdr(&format!("{i}")));
        }
        (0..6).for_each(|_| next(&arrived));
        (0..6).for_each(|_| release.send(()).unwrap());
        let more = [(); 5].map(|()| next(&seen));
        assert!(!more[4], "the last of a burst never waits for another");
        more[..4] == [true; 4]
    });
    assert!(together);
}

/// The way in which a sample was handled.
#[derive(Debug, PartialEq, Eq)]
enum Outcome {
    AtOnce(Bytes),
    OnAWorker(Bytes),
    Overrun(u64),
}

/// A handler that handles samples at once while it may, and waits at a gate otherwise.
struct Choosy {
    may: Arc<AtomicBool>,
    gate: Receiver<()>,
    handled: Sender<Outcome>,
}

impl HandleSamples for Choosy {
    fn handle(&mut self, sample: Sample) {
        let _ = self.handled.send(Outcome::OnAWorker(sample.payload));
        let _ = self.gate.recv();
    }

    fn handle_at_once(&mut self, sample: Sample) -> Option<Sample> {
        if !self.may.load(Relaxed) {
            return Some(sample);
        }
        let _ = self.handled.send(Outcome::AtOnce(sample.payload));
        None
    }

    fn overrun(&mut self, samples: u64) {
        let _ = self.handled.send(Outcome::Overrun(samples));
    }
}

#[test]
fn samples_are_handled_on_the_receiving_thread_in_order() {
    let (ros, sgc) = (open(111, None), open(111, Some("arm-1")));
    let may = Arc::new(AtomicBool::new(true));
    let ((release, gate), (tell, handled)) = (channel(), channel());
    let choosy = Choosy { may: may.clone(), gate, handled: tell };
    let five = with(spec("prompt"), |qos| qos.history = History::KeepLast(5));
    let _reader = sgc.create_reader(&five, Box::new(choosy)).unwrap();
    let writer = writer(&ros, &with(spec("prompt"), |qos| qos.history = History::KeepAll), 1);
    // The first sample waits for the lookup of its writer, and after each sample the receiving thread rests briefly.
    let is_at_once = (0..1000).any(|i| {
        let text = string_cdr(&i.to_string());
        write(&writer, &text);
        match next(&handled) {
            Outcome::AtOnce(payload) => {
                assert_eq!(payload, padded(&text));
                true
            }
            other => {
                assert_eq!(other, Outcome::OnAWorker(padded(&text).into()));
                release.send(()).unwrap();
                false
            }
        }
    });
    assert!(is_at_once, "a thousand were woken for");

    // Samples of the worker are not overtaken, and samples without room are counted.
    may.store(false, Relaxed);
    write(&writer, &string_cdr("blocks"));
    assert_eq!(next(&handled), Outcome::OnAWorker(padded(&string_cdr("blocks")).into()));
    may.store(true, Relaxed);
    (0..20).for_each(|i| write(&writer, &string_cdr(&format!("behind {i}"))));
    assert!(writer.wait_acknowledged(PATIENCE));
    quiet(&handled);
    (0..6).for_each(|_| release.send(()).unwrap());
    assert_eq!(next(&handled), Outcome::Overrun(15));
    for i in 15..20 {
        let text = string_cdr(&format!("behind {i}"));
        assert_eq!(next(&handled), Outcome::OnAWorker(padded(&text).into()));
    }
}

#[test]
fn a_reader_may_be_dropped_where_its_samples_are_received() {
    /// A handler that drops its reader at once.
    struct Drops(Arc<Mutex<Option<CycloneReader>>>, Sender<bool>);

    impl HandleSamples for Drops {
        fn handle(&mut self, _: Sample) {
            let _ = self.1.send(false);
        }

        fn handle_at_once(&mut self, _: Sample) -> Option<Sample> {
            drop(self.0.lock().unwrap().take());
            let _ = self.1.send(true);
            None
        }
    }

    let (ros, sgc) = (open(112, None), open(112, Some("arm-1")));
    let slot = Arc::new(Mutex::new(None));
    let (tell, handled) = channel();
    let reader = sgc.create_reader(&spec("once"), Box::new(Drops(slot.clone(), tell))).unwrap();
    *slot.lock().unwrap() = Some(reader);
    let writer = writer(&ros, &spec("once"), 1);
    let is_dropped = (0..1000).any(|_| {
        write(&writer, &string_cdr("x"));
        next(&handled)
    });
    assert!(is_dropped);
    matched(&writer, 0);
    assert_eq!(handled.recv_timeout(PATIENCE), Err(RecvTimeoutError::Disconnected), "the handler is gone");
}

#[test]
fn a_reader_may_be_dropped_by_its_own_handler() {
    let (ros, sgc) = (open(83, None), open(83, Some("arm-1")));
    let slot = Arc::new(Mutex::new(None));
    let (done_tx, done) = channel();
    let mine = Arc::clone(&slot);
    let reader = sgc
        .create_reader(
            &spec("once"),
            Box::new(move |_| {
                drop(mine.lock().unwrap().take());
                let _ = done_tx.send(());
            }),
        )
        .unwrap();
    *slot.lock().unwrap() = Some(reader);
    let writer = writer(&ros, &spec("once"), 1);
    write(&writer, &string_cdr("x"));
    next(&done);
    matched(&writer, 0);
    assert_eq!(done.recv_timeout(PATIENCE), Err(RecvTimeoutError::Disconnected), "the handler is gone");
}

#[test]
fn nothing_leaks_when_endpoints_come_and_go() {
    let (ros, sgc) = (open(85, None), open(85, Some("arm-1")));
    let partitioned = with(spec("cycle"), |qos| qos.partitions = vec!["p".into()]);
    let (_reader, samples) = read(&ros, &partitioned);
    let idle = sgc.entity_count();
    for round in 0..200 {
        let writer = sgc.create_writer(&partitioned).unwrap();
        let (reader, _) = read(&sgc, &spec("other"));
        assert!(sgc.entity_count() > idle);
        if round % 20 == 0 {
            matched(&writer, 1);
            write(&writer, &string_cdr("x"));
            next(&samples);
        }
        drop((reader, writer));
        assert_eq!(sgc.entity_count(), idle, "round {round}");
    }
}

#[test]
fn samples_are_freed_when_their_bytes_are() {
    let (ros, sgc) = (open(86, None), open(86, Some("arm-1")));
    let (_reader, samples) = read(&sgc, &spec("leak"));
    let writer = writer(&ros, &spec("leak"), 1);
    let payload = Bytes::from([&[0, 1, 0, 0][..], &vec![7; 1_000_000]].concat());
    let pass = |rounds| {
        for _ in 0..rounds {
            write(&writer, &payload);
            assert_eq!(next(&samples).payload.len(), payload.len());
        }
    };
    pass(50);
    let before = resident_bytes();
    pass(400);
    let grown = resident_bytes().saturating_sub(before);
    // 400 MB have passed. Other tests of this process may hold some tens of megabytes meanwhile.
    assert!(grown < 200_000_000, "{grown} bytes more are resident");
}

fn resident_bytes() -> usize {
    let statm = std::fs::read_to_string("/proc/self/statm").unwrap();
    statm.split_whitespace().nth(1).unwrap().parse::<usize>().unwrap() * 4096
}

#[test]
fn keyed_data_passes_in_both_directions_and_so_does_the_end_of_instances() {
    let (ros, sgc) = (open(88, None), open(88, Some("arm-1")));
    let keyed = |topic| EndpointSpec { keyless: false, ..spec(topic) };
    for (topic, from, to) in [("k0", &sgc, &ros), ("k1", &ros, &sgc)] {
        let (_reader, samples) = read(to, &with(keyed(topic), |q| q.history = History::KeepLast(1)));
        let writer = writer(from, &with(keyed(topic), |q| q.history = History::KeepLast(1)), 1);
        let write = |kind, key_hash, text: &str| {
            let head = SampleHead { key_hash, ..SampleHead::new(kind, 77) };
            let written = writer.write_ahead(head, string_cdr(text));
            writer.flush();
            written
        };
        for i in 0..100 {
            write(SampleKind::Write, Some([7; 16]), &i.to_string()).unwrap();
        }
        for i in 0..100 {
            let sample = next(&samples);
            assert_eq!(sample.payload, padded(&string_cdr(&i.to_string())), "instances are not told apart");
        }
        // Each event keeps its place and its key.
        let said = [
            (SampleKind::Dispose, "1"),
            (SampleKind::Write, "again"),
            (SampleKind::Unregister, "a longer key than sixteen bytes"),
            (SampleKind::Dispose, "never written"),
            (SampleKind::Write, "last"),
        ];
        for (kind, text) in said {
            assert_eq!(write(kind, None, text), Err(RosError::KeyUnknown));
            write(kind, Some([8; 16]), text).unwrap();
        }
        for (kind, text) in said {
            let sample = next(&samples);
            assert_eq!((sample.kind, &sample.payload[..]), (kind, &padded(&string_cdr(text))[..]));
            assert_eq!((sample.source_timestamp_ns, sample.key_hash), (77, Some([8; 16])));
        }
    }

    // A keyless reader does not match a keyed writer.
    let (_keyless, _) = read(&ros, &spec("k2"));
    let w2 = sgc.create_writer(&keyed("k2")).unwrap();
    let (_match, _samples) = read(&ros, &keyed("k2b"));
    let w3 = writer(&sgc, &keyed("k2b"), 1);
    assert_eq!((w2.matched_readers(), w3.matched_readers()), (0, 1));
}

#[test]
fn partitions_keep_endpoints_apart() {
    let (ros, sgc) = (open(89, None), open(89, Some("arm-1")));
    let part = |name: &str| with(spec("p"), |qos| qos.partitions = vec![name.into()]);
    let (_left, left) = read(&ros, &part("left"));
    let (_right, right) = read(&ros, &part("right"));
    let writer = writer(&sgc, &part("left"), 1);
    write(&writer, &string_cdr("l"));
    next(&left);
    quiet(&right);
}

#[test]
fn a_write_that_nobody_acknowledges_ends_with_a_timeout() {
    let (ros, sgc) = (open(90, None), open(90, Some("arm-1")));
    let (_reader, samples) = read(&ros, &spec("deaf"));
    let writer = writer(&sgc, &with(spec("deaf"), |qos| qos.history = History::KeepAll), 1);
    write(&writer, &string_cdr("x"));
    next(&samples);
    ros.set_deaf_mute(Duration::from_secs(6));
    let payload = Bytes::from([&[0, 1, 0, 0][..], &vec![7; 400_000]].concat());
    let error = (0..50).find_map(|_| writer.write(SampleKind::Write, 0, payload.clone()).err());
    let Some(RosError::WriteTimeout { waited_ms }) = error else { panic!("{error:?}") };
    assert!((1_500..10_000).contains(&waited_ms), "{waited_ms}");
}

#[test]
fn nodes_on_one_network_know_each_other_by_name() {
    let (arm, desk) = (open(166, Some("arm-1")), open(166, Some("desk")));
    let _plain = open(166, None);
    let (_arms, _desks) = (discover(&arm), discover(&desk));
    let names = |network: &CycloneNetwork| Vec::from_iter(network.nodes_here());
    eventually("the arm knows the desk", || names(&arm) == ["desk"]);
    eventually("the desk knows the arm", || names(&desk) == ["arm-1"]);
    drop(desk);
    eventually("the desk is gone", || names(&arm).is_empty());
}

#[test]
fn readers_are_counted_while_a_write_waits() {
    let (ros, sgc) = (open(165, None), open(165, Some("arm-1")));
    let all = with(spec("counted"), |qos| qos.history = History::KeepAll);
    let (_reader, samples) = read(&ros, &all);
    let writer = writer(&sgc, &all, 1);
    write(&writer, &string_cdr("x"));
    next(&samples);
    ros.set_deaf_mute(Duration::from_secs(6));
    let payload = Bytes::from([&[0, 1, 0, 0][..], &vec![7; 400_000]].concat());
    let (written, has_ended) = (AtomicUsize::new(0), AtomicBool::new(false));
    let mut counted_during = Vec::new();
    std::thread::scope(|scope| {
        scope.spawn(|| {
            while written.load(SeqCst) < 50 && writer.write(SampleKind::Write, 0, payload.clone()).is_ok() {
                written.fetch_add(1, SeqCst);
            }
            has_ended.store(true, SeqCst);
        });
        while !has_ended.load(SeqCst) {
            let before = written.load(SeqCst);
            assert_eq!(writer.matched_readers(), 1);
            if written.load(SeqCst) == before && !has_ended.load(SeqCst) {
                counted_during.push(before);
            }
            std::thread::sleep(Duration::from_millis(1));
        }
    });
    let last = written.load(SeqCst);
    assert!(last < 50, "a write waits until it times out");
    let while_waiting = counted_during.iter().filter(|before| **before == last).count();
    assert!(while_waiting > 100, "{while_waiting}");
}

#[test]
fn discovery_tells_of_a_lapsed_writer_and_of_its_return() {
    let (ros, sgc) = (open(159, None), open(159, Some("arm-1")));
    let leased = with(spec("leased"), |qos| qos.lease_ns = Some(300_000_000));
    let events = discover(&sgc);
    let (_reader, samples) = read(&sgc, &spec("leased"));
    let (writer, endless) = (writer(&ros, &leased, 1), writer(&ros, &spec("leased"), 1));
    let guids = [appeared(&events).guid, appeared(&events).guid];
    assert!(guids.contains(&writer.guid()) && guids.contains(&endless.guid()));
    write(&writer, &string_cdr("alive"));
    next(&samples);
    let liveliness = |is_alive| DiscoveryEvent::Liveliness { guid: writer.guid(), is_alive };
    // The reader cannot know what another one reported before.
    assert_eq!(next(&events), liveliness(true));
    ros.set_deaf_mute(Duration::from_millis(1000));
    assert_eq!(next(&events), liveliness(false));
    // A lapsed writer is alive again once it writes.
    eventually("a message after the silence", || {
        write(&writer, &string_cdr("again"));
        samples.recv_timeout(Duration::from_millis(50)).is_ok()
    });
    assert_eq!(next(&events), liveliness(true));
    quiet(&events);
}

#[test]
fn assertions_of_a_writer_that_is_manual_by_topic_are_seen_without_messages() {
    const LEASE: Duration = Duration::from_millis(200);
    let (ros, sgc) = (open(160, None), open(160, Some("arm-1")));
    let manual = with(spec("manual"), |qos| {
        qos.liveliness = Liveliness::ManualByTopic;
        qos.lease_ns = Some(LEASE.as_nanos() as u64);
    });
    let automatic = with(spec("manual"), |qos| qos.lease_ns = Some(60_000_000_000));
    let events = discover(&sgc);
    let (_reader, _samples) = read(&sgc, &automatic);
    let writers = [writer(&ros, &manual, 1), writer(&ros, &automatic, 1)];
    let found = [appeared(&events).guid, appeared(&events).guid];
    assert!(writers.iter().all(|writer| found.contains(&writer.guid())));
    let [ago, of_automatic] = [0, 1].map(|n| {
        let (sgc, guid) = (&sgc, writers[n].guid());
        move || sgc.renewed_ago(&guid)
    });
    assert_eq!(ago(), None, "it did not say anything yet");
    let renewals: [&dyn Fn(); 2] =
        [&|| writers[0].assert_liveliness(), &|| write(&writers[0], &string_cdr("alive"))];
    for renew in renewals.into_iter().cycle().take(4) {
        let since = Instant::now();
        renew();
        eventually("the lease is renewed", || ago().is_some_and(|ago| ago <= since.elapsed()));
        eventually("the lease has run out", || ago() > Some(2 * LEASE));
    }
    write(&writers[1], &string_cdr("alive"));
    assert_eq!(of_automatic(), None);
    // The lease expires where the messages go, and each writer is reported with its first message only.
    for writer in &writers {
        let is_alive = true;
        assert_eq!(next(&events), DiscoveryEvent::Liveliness { guid: writer.guid(), is_alive });
    }
    quiet(&events);
    drop(writers);
    eventually("it is forgotten", || ago().is_none());
}

#[test]
fn rmw_cyclonedds_on_localhost_is_found() {
    // The configuration that rmw_cyclonedds derives from ROS_AUTOMATIC_DISCOVERY_RANGE=LOCALHOST (since Iron), and
    // from ROS_LOCALHOST_ONLY=1 (up to Humble).
    let iron = "<General><AllowMulticast>false</AllowMulticast></General><Discovery>\
                <ParticipantIndex>auto</ParticipantIndex><MaxAutoParticipantIndex>32</MaxAutoParticipantIndex>\
                <Peers><Peer address=\"localhost\"/></Peers></Discovery>";
    let humble = "<General><Interfaces><NetworkInterface address=\"127.0.0.1\"/></Interfaces></General>";
    for (domain, body) in [(91, iron), (92, humble)] {
        let ros = CycloneNetwork::open(&DdsConfig {
            domain,
            discovery: DiscoveryRange::SystemDefault,
            cyclonedds_uri: Some(format!("<CycloneDDS><Domain Id=\"{domain}\">{body}</Domain></CycloneDDS>")),
            ..DdsConfig::default()
        })
        .unwrap();
        let sgc = open(domain, Some("arm-1"));
        let (_reader, samples) = read(&ros, &spec("t"));
        let (_reader, back) = read(&sgc, &spec("back"));
        let (w1, w2) = (writer(&sgc, &spec("t"), 1), writer(&ros, &spec("back"), 1));
        write(&w1, &string_cdr("x"));
        next(&samples);
        write(&w2, &string_cdr("y"));
        next(&back);
    }
}

#[test]
fn off_is_seen_by_nobody() {
    let off =
        CycloneNetwork::open(&DdsConfig { discovery: DiscoveryRange::Off, ..config(93, None) }).unwrap();
    let (ros, sgc) = (open(93, None), open(93, Some("arm-1")));
    let events = discover(&sgc);
    let hidden = off.create_writer(&spec("hidden")).unwrap();
    let shown = ros.create_writer(&spec("shown")).unwrap();
    assert_eq!(appeared(&events).guid, shown.guid());
    quiet(&events);
    assert_eq!(hidden.matched_readers(), 0);
}

#[test]
fn cyclone_errors_carry_their_reason() {
    let open = |config: DdsConfig| CycloneNetwork::open(&config).unwrap_err().to_string();
    let xml = DdsConfig { cyclonedds_uri: Some("<NoSuchElement/>".into()), ..config(94, None) };
    assert!(open(xml).contains("NoSuchElement"));
    let interface = "<General><Interfaces><NetworkInterface name=\"no-such0\"/></Interfaces></General>";
    let xml = DdsConfig { cyclonedds_uri: Some(interface.into()), ..config(94, None) };
    assert!(open(xml).contains("no-such0"));
    assert!(open(DdsConfig { domain: 233, ..DdsConfig::default() }).contains("232"));
}

#[test]
fn the_users_configuration_overrides_ours() {
    let off = "<Discovery><Tag>elsewhere</Tag></Discovery>";
    let apart = DdsConfig { cyclonedds_uri: Some(off.into()), ..config(95, None) };
    let apart = CycloneNetwork::open(&apart).unwrap();
    let (ros, sgc) = (open(95, None), open(95, Some("arm-1")));
    let events = discover(&sgc);
    let _hidden = apart.create_writer(&spec("hidden")).unwrap();
    let shown = ros.create_writer(&spec("shown")).unwrap();
    assert_eq!(appeared(&events).guid, shown.guid());
    quiet(&events);
}

/// Cyclone 11 considers others' announcements received, and never gets them again, if a second participant of the
/// domain is deleted meanwhile.
#[test]
fn network_has_one_participant_from_the_beginning() {
    let directory = tempfile::tempdir().unwrap();
    let trace = directory.path().join("trace");
    let output = trace.display();
    let uri = format!("<Tracing><Category>discovery</Category><OutputFile>{output}</OutputFile></Tracing>");
    let traced = DdsConfig { cyclonedds_uri: Some(uri), ..config(102, Some("arm-1")) };
    drop(CycloneNetwork::open(&traced).unwrap());
    let trace = std::fs::read_to_string(&trace).unwrap();
    assert_eq!(trace.matches("ddsi_new_participant(").count(), 1, "{trace}");
}

#[test]
fn content_that_is_traced_ends_nobody() {
    let trace = "<Tracing><Category>trace,content</Category><OutputFile>/dev/null</OutputFile></Tracing>";
    let traced = |tag| DdsConfig { cyclonedds_uri: Some(trace.into()), ..config(101, tag) };
    let ros = CycloneNetwork::open(&traced(None)).unwrap();
    let sgc = CycloneNetwork::open(&traced(Some("arm-1"))).unwrap();
    for keyless in [true, false] {
        let spec = EndpointSpec { keyless, ..spec(&format!("traced{keyless}")) };
        let (_reader, samples) = read(&sgc, &spec);
        let writer = writer(&ros, &spec, 1);
        write(&writer, &string_cdr("shown"));
        assert_eq!(next(&samples).payload, padded(&string_cdr("shown")));
    }
}

fn open_graph(domain: u32, tag: Option<&str>) -> CycloneNetwork {
    CycloneNetwork::open(&DdsConfig { graph: true, ..config(domain, tag) }).unwrap()
}

fn graph_node(name: &str, readers: &[Guid], writers: &[Guid]) -> GraphNode {
    let node = RosNode::new("/robot", name, None).unwrap();
    GraphNode { node, readers: readers.to_vec(), writers: writers.to_vec() }
}

/// Returns the next event about nodes, and skips those about endpoints.
fn nodes(events: &Receiver<DiscoveryEvent>) -> (Guid, Vec<GraphNode>) {
    loop {
        if let DiscoveryEvent::Nodes { participant, nodes } = next(events) {
            return (participant, nodes);
        }
    }
}

#[test]
fn endpoints_of_another_participant_are_told_of_no_node() {
    let (ros, sgc) = (open_graph(96, None), open_graph(96, Some("late")));
    let other = open(96, None).create_writer(&spec("chatter")).unwrap();
    ros.announce(&[graph_node("talker", &[], &[other.guid()])]).unwrap();
    assert_eq!(nodes(&discover(&sgc)), (ros.guid(), vec![graph_node("talker", &[], &[])]));
}

#[test]
fn without_a_graph_nodes_are_neither_announced_nor_told() {
    let (ros, other, off) = (open_graph(97, None), open_graph(97, Some("arm-2")), open(97, Some("arm-3")));
    let (other_seen, off_seen) = (discover(&other), discover(&off));
    off.announce(&[graph_node("x", &[], &[])]).unwrap();
    ros.announce(&[graph_node("local", &[], &[])]).unwrap();
    assert_eq!(nodes(&other_seen), (ros.guid(), vec![graph_node("local", &[], &[])]));
    assert!(!off_seen.try_iter().any(|event| matches!(event, DiscoveryEvent::Nodes { .. })));
}

#[test]
fn shown_endpoints_are_seen_with_type_and_qos_and_match_none() {
    let (ros, sgc) = (open(103, None), open(103, Some("arm-1")));
    let seen = discover(&ros);
    let hash = Some("RIHS01_ab".to_owned());
    let best_effort = |qos: &mut Qos| qos.reliability = Reliability::BestEffort;
    let shown = with(EndpointSpec { type_hash: hash.clone(), ..spec("chatter") }, best_effort);
    let talker = ros.create_writer(&spec("chatter")).unwrap();
    let (_listener, _samples) = read(&ros, &spec("chatter"));
    for kind in [EndpointKind::Reader, EndpointKind::Writer] {
        let endpoint = sgc.show(kind, &shown).unwrap();
        let found = appeared(&seen);
        assert_eq!((found.kind, found.guid, found.topic), (kind, endpoint.guid, shown.topic.clone()));
        assert_eq!((found.type_hash, found.qos.reliability), (hash.clone(), Reliability::BestEffort));
        drop(endpoint);
        assert_eq!(vanished(&seen), found.guid);
    }
    let _shown = [EndpointKind::Reader, EndpointKind::Writer].map(|kind| sgc.show(kind, &shown).unwrap());
    // A matching endpoint comes later, so the others have been considered before.
    let (_reader, samples) = read(&sgc, &spec("chatter"));
    matched(&talker, 2);
    write(&talker, &string_cdr("once"));
    assert_eq!(next(&samples).payload, padded(&string_cdr("once")));
    assert_eq!(talker.matched_readers(), 2);
}

#[test]
fn ids_are_as_long_as_those_of_the_network() {
    let sgc = open_graph(98, Some("arm-1"));
    let events = discover(&sgc);
    sgc.announce(&[graph_node("talker", &[], &[])]).unwrap();
    // A plain participant reads and writes the topic itself, like an older ROS 2.
    let old = open(98, None);
    let (_reader, said) = read(&old, &graph_reader());
    let writer = writer(&old, &graph_writer(), 2);
    let heard = || loop {
        let sample = next(&said);
        if sample.writer != Some(writer.guid()) {
            break decode_nodes(&sample.payload).unwrap();
        }
    };
    assert_eq!(heard().gid_bytes, GidBytes::Sixteen);
    write(&writer, &encode_nodes(&old.guid(), &[graph_node("old", &[], &[])], GidBytes::TwentyFour));
    assert_eq!(nodes(&events).0, old.guid());
    let again = heard();
    assert_eq!(
        (again.gid_bytes, again.participant, again.nodes.len()),
        (GidBytes::TwentyFour, sgc.guid(), 1)
    );
    // Invalid messages, and messages about another participant, change nothing.
    write(&writer, &Bytes::from_static(&[0, 1, 0, 0, 1, 2, 3, 4]));
    write(&writer, &encode_nodes(&sgc.guid(), &[graph_node("forged", &[], &[])], GidBytes::Sixteen));
    write(&writer, &encode_nodes(&old.guid(), &[graph_node("new", &[], &[])], GidBytes::Sixteen));
    assert_eq!(nodes(&events).1[0].node.name(), "new");
    assert_eq!(heard().gid_bytes, GidBytes::Sixteen);
}

#[test]
fn late_joiners_get_the_last_samples_of_each_key() {
    let (ros, sgc) = (open(151, None), open(151, Some("arm-1")));
    let keyed = with(EndpointSpec { keyless: false, ..spec("h") }, |qos| {
        qos.durability = Durability::TransientLocal;
        qos.history = History::KeepLast(2);
    });
    // Long samples come in fragments, the first of which carries the hash.
    let text = |n: usize, key: u8| format!("{n} of {key}").repeat(if n == 3 { 10_000 } else { 1 });
    let latched = writer(&sgc, &keyed, 0);
    for n in 0..4 {
        for key in 0..3 {
            let head = SampleHead { key_hash: Some([key; 16]), ..SampleHead::new(SampleKind::Write, 5) };
            latched.write_ahead(head, string_cdr(&text(n, key))).unwrap();
        }
    }
    latched.flush();
    let (_reader, samples) = read(&ros, &keyed);
    for n in 2..4 {
        for key in 0..3 {
            let sample = next(&samples);
            assert_eq!(sample.key_hash, Some([key; 16]));
            assert_eq!(sample.payload, padded(&string_cdr(&text(n, key))));
        }
    }
    quiet(&samples);
    // A topic without keys has no hash.
    let (_reader, samples) = read(&ros, &spec("h0"));
    write(&writer(&sgc, &spec("h0"), 1), &string_cdr("a"));
    assert_eq!(next(&samples).key_hash, None);
    assert_eq!(sgc_dds::unidentified_messages(), 0);
}

/// Asking for acknowledgements changes times inside of Cyclone's writer. Small numbers beside them, such as those of a
/// condition that was waited for twice, must not pass for them.
#[test]
fn writer_that_waits_for_acknowledgements_goes_on_counting() {
    for run in 0..8 {
        let (ros, sgc) = (open(153, None), open(153, None));
        let spec = with(spec(&format!("counted{run}")), |qos| {
            qos.history = History::KeepLast(1);
            qos.durability = Durability::TransientLocal;
        });
        let deep = with(spec.clone(), |qos| qos.history = History::KeepAll);
        // Cyclone notes in the writer which samples its own readers take.
        let (_far, samples) = read(&ros, &deep);
        let (_own, own) = read(&sgc, &deep);
        let writer = writer(&sgc, &spec, 2);
        for n in 0..20 {
            let payload = string_cdr(&n.to_string());
            write(&writer, &payload);
            assert!(writer.wait_acknowledged(Duration::from_secs(10)));
            assert_eq!(next(&samples).payload, padded(&payload));
            assert_eq!(next(&own).payload, padded(&payload));
        }
        quiet(&samples);
    }
}

#[test]
fn a_reliable_writer_keeps_what_is_not_acknowledged_as_far_as_memory_goes() {
    let (ros, sgc) = (open(152, None), open(152, Some("arm-1")));
    // The publisher keeps one sample.
    let one = |topic| with(spec(topic), |qos| qos.history = History::KeepLast(1));
    let (_reader, samples) = read(&ros, &with(spec("deaf"), |qos| qos.history = History::KeepAll));
    let writer = writer(&sgc, &one("deaf"), 1);
    assert_eq!(writer.kept(100), Some(UNACKNOWLEDGED_MAX));
    let short: Vec<_> = (0..500).map(|n| string_cdr(&n.to_string())).collect();
    ros.set_deaf_mute(Duration::from_millis(500));
    short.iter().for_each(|payload| write(&writer, payload));
    for payload in &short {
        assert_eq!(next(&samples).payload, padded(payload));
    }
    // Of long samples the last ones are kept, as many as there is room for.
    let bytes = 4 << 20;
    let kept = writer.kept(bytes).unwrap();
    assert_eq!(kept, UNACKNOWLEDGED_MIN);
    let long = |n: u32| string_cdr(&format!("{n:08}{}", "x".repeat(bytes)));
    ros.set_deaf_mute(Duration::from_secs(5));
    (0..kept + 8).for_each(|n| write(&writer, &long(n)));
    for n in 8..kept + 8 {
        assert_eq!(next(&samples).payload[8..16], *format!("{n:08}").as_bytes());
    }
    quiet(&samples);
}
