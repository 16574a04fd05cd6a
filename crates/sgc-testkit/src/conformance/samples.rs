//! Samples between programs and proxies.

use std::sync::mpsc::RecvTimeoutError;

use bytes::Bytes;
use sgc_ros::{RosNetwork, RosWriter, SampleHead, SampleKind};
use sgc_wire::{Durability, History};

use super::rig::{
    PATIENCE, QUIET, discover, matched, next, quiet, read, spec, string_cdr, with, write, writer,
};
use super::{Site, appeared, received};

/// A program and a proxy hear each other, in order and with nothing lost.
pub fn program_and_proxy_exchange_strings_both_ways<S: Site>() {
    let site = S::new();
    let (ros, sgc) = (site.open(None), site.open(Some("arm-1")));
    let all = |topic| with(spec(topic), |qos| qos.history = History::KeepAll);
    let (down, up) = (all("down"), all("up"));
    let (_r1, from_sgc) = read(&ros, &down);
    let (_r2, from_ros) = read(&sgc, &up);
    let (w1, w2) = (writer(&sgc, &down, 1), writer(&ros, &up, 1));
    for i in 0..100 {
        write(&w1, &string_cdr(&format!("down {i}")));
        write(&w2, &string_cdr(&format!("up {i}")));
    }
    for i in 0..100 {
        let sample = next(&from_sgc);
        assert_eq!(sample.payload, received::<S>(&format!("down {i}")));
        assert_eq!((sample.kind, sample.writer), (SampleKind::Write, Some(w1.guid())));
        assert_eq!(next(&from_ros).payload, received::<S>(&format!("up {i}")));
    }
}

/// Writers and readers of one proxy neither match nor hear each other.
pub fn network_does_not_hear_itself<S: Site>() {
    let site = S::new();
    let (sgc, ros) = (site.open(Some("arm-1")), site.open(None));
    let (_own, own) = read(&sgc, &spec("echo"));
    let (_other, other) = read(&ros, &spec("echo"));
    let writer = writer(&sgc, &spec("echo"), 1);
    write(&writer, &string_cdr("hello"));
    next(&other);
    quiet(&own);
    assert_eq!(writer.matched_readers(), 1, "its own reader is no match");
}

/// The programs behind a gateway share one participant.
pub fn programs_behind_one_network_without_tag_hear_each_other<S: Site>() {
    let ros = S::new().open(None);
    let (_reader, samples) = read(&ros, &spec("echo"));
    let writer = writer(&ros, &spec("echo"), 1);
    for text in ["hello", &"x".repeat(100_000)] {
        write(&writer, &string_cdr(text));
        let sample = next(&samples);
        assert_eq!((sample.payload, sample.writer), (received::<S>(text).into(), Some(writer.guid())));
    }
    quiet(&samples);
}

/// A writer waits for as many readers as it is told to, and no longer than it is told to.
pub fn readers_are_waited_for_until_they_are_there_or_the_time_is_over<S: Site>() {
    let site = S::new();
    let (ros, other) = (site.open(None), site.open(None));
    let writer = ros.create_writer(&spec("wait")).expect("a writer");
    assert_eq!(writer.wait_matched(1, QUIET), 0);
    let waits = std::thread::scope(|scope| {
        let waits = scope.spawn(|| writer.wait_matched(2, PATIENCE));
        let _readers = [read(&other, &spec("wait")), read(&other, &spec("wait"))];
        waits.join().expect("the writer waits")
    });
    assert_eq!(waits, 2);
}

/// Proof against loops: a proxy does not forward samples of another one.
pub fn samples_of_other_proxies_are_skipped<S: Site>() {
    let site = S::new();
    let [first, second, ros] = [Some("a"), Some("b"), None].map(|tag| site.open(tag));
    let (_reader, samples) = read(&first, &spec("loop"));
    let other = writer(&second, &spec("loop"), u32::from(S::PROXIES_MATCH));
    let plain = writer(&ros, &spec("loop"), 1);
    write(&other, &string_cdr("from sgc"));
    write(&plain, &string_cdr("from ros"));
    assert_eq!(next(&samples).payload, received::<S>("from ros"));
    quiet(&samples);
}

/// Messages of megabytes arrive as they were sent.
pub fn large_messages_arrive_intact<S: Site>() {
    let site = S::new();
    let (ros, sgc) = (site.open(None), site.open(Some("arm-1")));
    let (_reader, samples) = read(&ros, &spec("image"));
    let writer = writer(&sgc, &spec("image"), 1);
    for (round, bytes) in [1_000_000_usize, 13_000_000, 1_000_003].into_iter().enumerate() {
        let mut payload = vec![0, 1, 0, 0];
        payload.extend((0..bytes as u32).map(|i| (i.wrapping_mul(2_654_435_761) >> (8 + round)) as u8));
        let payload = Bytes::from(payload);
        write(&writer, &payload);
        let got = next(&samples).payload;
        assert!(got == S::received(&payload), "{bytes} bytes came as {}", got.len());
    }
}

/// A transient local writer keeps as many samples for late joiners as it offers; volatile readers get none of them.
pub fn late_joiners_get_history_of_the_depth_asked_for<S: Site>() {
    let site = S::new();
    let (ros, sgc) = (site.open(None), site.open(Some("arm-1")));
    let latched = |depth| {
        with(spec("map"), |qos| {
            qos.durability = Durability::TransientLocal;
            qos.history = History::KeepLast(depth);
        })
    };
    let writer = sgc.create_writer(&latched(5)).expect("a writer");
    for i in 0..20 {
        write(&writer, &string_cdr(&i.to_string()));
    }
    let (_late, samples) = read(&ros, &latched(50));
    for i in 15..20 {
        assert_eq!(next(&samples).payload, received::<S>(&i.to_string()));
    }
    let (_volatile, live) = read(&ros, &spec("map"));
    matched(&writer, 2);
    write(&writer, &string_cdr("live"));
    assert_eq!(next(&live).payload, received::<S>("live"), "a volatile reader gets no history");
    assert_eq!(next(&samples).payload, received::<S>("live"));
}

/// Samples arrive with the time of their source and the writer that discovery tells.
pub fn source_time_and_writer_are_preserved<S: Site>() {
    let site = S::new();
    let (ros, sgc) = (site.open(None), site.open(Some("arm-1")));
    let events = discover(&sgc);
    let (_reader, samples) = read(&sgc, &spec("stamped"));
    let writer = writer(&ros, &spec("stamped"), 1);
    let seen = appeared(&events);
    // RTPS carries units of 2⁻³² s, so the result may be off by a nanosecond.
    for ns in [0, 1, 1_700_000_000_123_456_789, 4_294_967_295_999_999_999] {
        writer.write(SampleKind::Write, ns, string_cdr("x")).expect("the sample is taken");
        let sample = next(&samples);
        assert!((sample.source_timestamp_ns - ns).abs() <= 1, "{} for {ns}", sample.source_timestamp_ns);
        assert_eq!(sample.writer, Some(seen.guid));
    }
    assert_eq!(seen.guid, writer.guid());
}

/// A sample that a writer queues leaves with the next one, or when it is told to flush.
pub fn queued_samples_leave_with_the_next_or_a_flush<S: Site>() {
    let site = S::new();
    let (ros, sgc) = (site.open(None), site.open(Some("arm-1")));
    let many = with(spec("ahead"), |qos| qos.history = History::KeepLast(1000));
    let (_reader, samples) = read(&ros, &many);
    let writer = writer(&sgc, &many, 1);
    let ahead = |text: &str| {
        let queued = writer.write_ahead(SampleHead::new(SampleKind::Write, 1), string_cdr(text));
        queued.expect("the sample is taken");
    };
    let arrive = |range: std::ops::Range<u32>| {
        for i in range {
            assert_eq!(next(&samples).payload, received::<S>(&i.to_string()));
        }
    };
    // There is more than one packet of samples, and then a last sample without successor.
    (0..900).for_each(|i| ahead(&i.to_string()));
    write(&writer, &string_cdr("900"));
    arrive(0..901);
    ahead("901");
    writer.flush();
    arrive(901..902);
    ahead("902");
    assert!(writer.wait_acknowledged(PATIENCE), "it left");
    arrive(902..903);
}

/// A payload is valid after reader, writer and networks are gone. The handler is gone with its reader.
pub fn payloads_outlive_reader_and_network<S: Site>() {
    let site = S::new();
    let (ros, sgc) = (site.open(None), site.open(Some("arm-1")));
    let (reader, samples) = read(&sgc, &spec("kept"));
    let writer = writer(&ros, &spec("kept"), 1);
    write(&writer, &string_cdr("still here"));
    let sample = next(&samples);
    drop((reader, sgc, writer, ros));
    assert_eq!(sample.payload, received::<S>("still here"));
    assert_eq!(sample.payload.slice(8..18), "still here".as_bytes());
    assert_eq!(samples.recv_timeout(PATIENCE), Err(RecvTimeoutError::Disconnected));
}
