//! Samples through all stages of a share.

use std::time::{Duration, Instant};

use bytes::Bytes;
use sgc_endpoint::{Delivery, Sink, SinkLimits};
use sgc_ros::{HandleSamples, Sample, SampleKind, Shaping};
use sgc_sync::lock;
use sgc_wire::{PayloadEncoding, PayloadForm, TopicGrant};

use crate::clock::unix_ns;
use crate::data::conversion::KnownType;
use crate::data::dataplane::DataPlane;
use crate::data::pending::PENDING_BYTES_MAX;
use crate::data::sending::fixtures::{
    KNOWN, NAME, SINK, STRANGER, add_link, add_tree, grant, map_of, queued, sample, share, text_type,
    unflushed, wait_until,
};
use crate::data::sending::hold::{Downstream as _, EARLY_SAMPLES_MAX};
use crate::data::sending::intake::Publisher;
use crate::data::sending::share::{AT_HAND_BYTES_MAX, DueMark};
use crate::data::stats::CountDrops;

#[test]
fn nothing_stays_unsigned_when_the_last_sample_of_a_batch_goes_elsewhere() {
    let runtime = tokio::runtime::Runtime::new().unwrap();
    let _inside = runtime.enter();
    let (data, share, slot) = share();
    // Without a sink nothing is sealed.
    share.publish(sample(KNOWN, true));
    assert_eq!((share.published(), unflushed(&slot)), (1, 0));
    add_tree(&data);
    share.publish(sample(KNOWN, true));
    share.publish(sample(STRANGER, false));
    assert_eq!((share.published(), unflushed(&slot)), (2, 0));
    // The stranger is known now and its waiting samples are published.
    share.publish(sample(KNOWN, true));
    assert_eq!(unflushed(&slot), 1, "it does wait while more is to come");
    share.publish(sample(KNOWN, true));
    share.close();
    share.publish(sample(KNOWN, false));
    assert_eq!(unflushed(&slot), 0);
}

#[test]
fn sample_that_would_block_is_handed_back() {
    let runtime = tokio::runtime::Runtime::new().unwrap();
    let _inside = runtime.enter();
    let (data, share, slot) = share();
    let flow = add_link(&data);
    let mut publisher = Publisher::new(share.clone(), None);
    let mut is_taken = |sample: Sample| publisher.handle_at_once(sample).is_none();
    assert!(is_taken(sample(KNOWN, false)));
    assert_eq!((share.published(), flow.has_headroom()), (1, true));
    // These cases wait: an unknown source, a locked source, or an unfinished batch.
    assert!(!is_taken(sample(STRANGER, false)));
    {
        let _replays = lock(&slot.source);
        assert!(!is_taken(sample(KNOWN, false)));
    }
    share.publish(sample(KNOWN, true));
    assert!(!is_taken(sample(KNOWN, false)));
    share.publish(sample(KNOWN, false));
    // Long, shaped or compressed samples wait.
    let payload = Bytes::from(vec![0; AT_HAND_BYTES_MAX + 1]);
    assert!(!is_taken(Sample { payload, ..sample(KNOWN, false) }));
    for shaping in [
        Shaping { compression: PayloadEncoding::Lz4, ..Shaping::default() },
        Shaping { form: PayloadForm::Json, ..Shaping::default() },
        Shaping { max_age: Some(Duration::from_secs(5)), ..Shaping::default() },
    ] {
        share.set_shaping(shaping);
        assert!(!is_taken(sample(KNOWN, false)), "{shaping:?}");
    }
    share.set_shaping(Shaping::default());
    assert!(is_taken(sample(KNOWN, false)));
    // A busy link makes it wait.
    while flow.has_headroom() {
        share.publish(sample(KNOWN, false));
    }
    assert!(!is_taken(sample(KNOWN, false)));
}

#[test]
fn share_knows_whether_messages_wait_here() {
    let runtime = tokio::runtime::Runtime::new().unwrap();
    let _inside = runtime.enter();
    let (data, share, _) = share();
    let flow = add_link(&data);
    assert!(!share.has_waiting());
    share.publish(sample(KNOWN, false));
    assert!(share.has_waiting(), "its packet waits for the link");
    assert!(queued(&flow).is_some() && !share.has_waiting());
    share.publish(sample(KNOWN, true));
    while queued(&flow).is_some() {}
    assert!(share.has_waiting(), "the reader has another one");
    share.publish(sample(KNOWN, false));
    while queued(&flow).is_some() {}
    assert!(!share.has_waiting());
}

#[test]
fn sample_to_convert_waits_until_the_owner_describes_its_type() {
    let runtime = tokio::runtime::Runtime::new().unwrap();
    let _inside = runtime.enter();
    let (data, share, _) = share();
    let (layout, payload) = text_type();
    let sample = || Sample { payload: payload.clone(), ..sample(KNOWN, false) };
    share.set_shaping(Shaping { form: PayloadForm::Json, ..Shaping::default() });
    share.set_type(KnownType::Asked);
    assert!(share.lacks_definition());
    (0..EARLY_SAMPLES_MAX + 3).for_each(|_| share.publish(sample()));
    let lost = |data: &DataPlane| data.drops().snapshot().get("no_definition").copied();
    assert_eq!((share.published(), lost(&data)), (0, Some(3)));
    // Large samples are bounded by their bytes.
    let large = Sample { payload: vec![0; PENDING_BYTES_MAX].into(), ..sample() };
    share.publish(large);
    assert_eq!(lost(&data), Some(3 + EARLY_SAMPLES_MAX as u64));
    (0..2).for_each(|_| share.publish(sample()));
    assert_eq!(lost(&data), Some(4 + EARLY_SAMPLES_MAX as u64));
    share.set_type(KnownType::Known(layout));
    wait_until(|| share.published() == 2);
    // Samples leave unconverted where that is configured.
    share.set_type(KnownType::Asked);
    share.publish(sample());
    assert_eq!(share.published(), 2);
    share.set_shaping(Shaping::default());
    wait_until(|| share.published() == 3);
}

#[test]
fn only_data_that_no_late_joiner_gets_is_useless_late() {
    let runtime = tokio::runtime::Runtime::new().unwrap();
    let _inside = runtime.enter();
    let (_, share, mut slot) = share();
    share.set_shaping(Shaping { form: PayloadForm::Json, ..Shaping::default() });
    assert!(!share.is_useless_late(&sample(KNOWN, false)), "it is kept");
    slot.keeps_history = false;
    share.set_map(map_of(slot));
    assert!(share.is_useless_late(&sample(KNOWN, false)));
    assert!(!share.is_useless_late(&sample(STRANGER, false)));
    assert!(!share.is_useless_late(&Sample { kind: SampleKind::Dispose, ..sample(KNOWN, false) }));
    share.set_shaping(Shaping::default());
    assert!(!share.is_useless_late(&sample(KNOWN, false)), "it waits for no type");
}

#[test]
fn rate_limited_topic_sends_the_newest_sample_and_never_drops_the_last() {
    let runtime = tokio::runtime::Runtime::new().unwrap();
    let _inside = runtime.enter();
    let (data, share, slot) = share();
    share.set_shaping(Shaping { interval: Some(Duration::from_millis(200)), ..Shaping::default() });
    let begin = Instant::now();
    for _ in 0..50 {
        share.publish(sample(KNOWN, false));
    }
    wait_until(|| share.published() == 2);
    assert!(begin.elapsed() >= Duration::from_millis(200));
    assert_eq!(data.drops().snapshot()["thinned"], 48);
    assert_eq!(unflushed(&slot), 0);
    // The end of an instance leaves at once, after its held sample.
    share.publish(sample(KNOWN, false));
    share.publish(Sample { kind: SampleKind::Dispose, ..sample(KNOWN, false) });
    assert_eq!(share.published(), 4);
    // Without shaping, samples pass.
    share.set_shaping(Shaping::default());
    (0..10).for_each(|_| share.publish(sample(KNOWN, false)));
    assert_eq!(share.published(), 14);
}

#[test]
fn reliable_messages_wait_for_their_bandwidth_until_it_is_closed() {
    let runtime = tokio::runtime::Runtime::new().unwrap();
    let _inside = runtime.enter();
    let (data, share, _) = share();
    share.set_shaping(Shaping { bits_per_s: Some(8 * 80), ..Shaping::default() });
    let begin = Instant::now();
    // 8 bytes each, at 80 bytes a second.
    (0..4).for_each(|_| share.publish(sample(KNOWN, false)));
    assert!(share.published() == 4 && begin.elapsed() >= Duration::from_millis(250));
    share.set_shaping(Shaping { bits_per_s: Some(1), ..Shaping::default() });
    share.publish(sample(KNOWN, false));
    let waits = share.clone();
    let thread = std::thread::spawn(move || waits.publish(sample(KNOWN, false)));
    share.close();
    thread.join().unwrap();
    assert!(!data.drops().snapshot().contains_key("thinned"));
}

#[test]
fn stale_sample_is_dropped_unless_it_is_reliable() {
    let runtime = tokio::runtime::Runtime::new().unwrap();
    let _inside = runtime.enter();
    let dated = |age_s: i64| Sample {
        source_timestamp_ns: unix_ns() - age_s * 1_000_000_000,
        ..sample(KNOWN, false)
    };
    for reliable in [true, false] {
        let (_, share, mut slot) = share();
        slot.reliable = reliable;
        share.set_map(map_of(slot));
        share.set_shaping(Shaping { max_age: Some(Duration::from_secs(5)), ..Shaping::default() });
        [0, 60, 0].into_iter().for_each(|age| share.publish(dated(age)));
        assert_eq!(share.published(), if reliable { 3 } else { 2 });
    }
}

#[test]
fn an_epoch_is_over_once_however_often_that_is_asked() {
    let runtime = tokio::runtime::Runtime::new().unwrap();
    let _inside = runtime.enter();
    let (_, share, slot) = share();
    share.publish(sample(KNOWN, false));
    assert!(!share.is_epoch_over());
    share.publish(sample(KNOWN, false));
    assert_eq!(slot.progress.published_in_epoch(), 2);
    assert!(share.is_epoch_over());
    assert!(!share.is_epoch_over());
    share.rekey(grant(2));
    wait_until(|| lock(&slot.source).epoch() == 2);
    assert_eq!(slot.progress.published_in_epoch(), 0);
}

#[test]
fn a_share_is_looked_at_until_its_silence_was_told_three_times() {
    let runtime = tokio::runtime::Runtime::new().unwrap();
    let _inside = runtime.enter();
    let (_, share, slot) = share();
    let begin = Instant::now();
    let mut due = Vec::new();
    let mut look = |seconds| share.look_for_silence(begin + Duration::from_secs(seconds), &mut due);
    assert!(!look(0), "nothing was published");
    for _ in 0..2 {
        share.publish(sample(KNOWN, false));
        assert!(look(100) && look(102) && look(105) && look(114));
        assert!(!look(116) && !look(900));
    }
    assert!(due.is_empty());
    assert_eq!(slot.progress.published(), 2, "without anybody who listens nothing is said");
}

#[test]
fn marks_of_a_silence_ask_for_confirmations_if_they_are_to() {
    let runtime = tokio::runtime::Runtime::new().unwrap();
    let _inside = runtime.enter();
    let (data, share, slot) = share();
    let flow = add_link(&data);
    let announced = TopicGrant { sources: vec![slot.progress.announce()], ..grant(1) };
    let mut sink = Sink::new(NAME, SINK, announced, false, SinkLimits::default());
    let begin = Instant::now();
    let at = |seconds| begin + Duration::from_secs(seconds);
    for (asks, number) in [(true, 2), (false, 4)] {
        share.ask_in_marks(asks);
        share.publish(sample(KNOWN, false));
        assert!(matches!(sink.handle_packet(&queued(&flow).unwrap()), Ok(Delivery::Message(_))));
        let mut due = Vec::new();
        assert!([100, 102].iter().all(|seconds| share.look_for_silence(at(*seconds), &mut due)));
        assert_eq!(due.len(), 1);
        DueMark::publish_all(due);
        wait_until(|| !flow.is_empty());
        let expected = if asks { Delivery::Confirm(slot.id, number) } else { Delivery::Mark };
        assert_eq!(sink.handle_packet(&queued(&flow).unwrap()), Ok(expected));
    }
}
