//! Messages of all sizes, bounds, histories.

use sgc_endpoint::{FRAGMENT_BYTES, PublishError};
use sgc_trust::BATCH_PACKETS_MAX;
use sgc_wire::{PAYLOAD_BYTES_MAX, Payload};

use super::*;

const GRID: usize = FRAGMENT_BYTES as usize;

#[test]
fn messages_of_every_size_arrive_whole_in_any_order_of_fragments() {
    for suite in Suite::ALL {
        for n in [0, 1, GRID - 1, GRID, GRID + 1, 3 * GRID, 1_100_003] {
            let mut source = source(suite, 0);
            let mut sink = sink(suite, &[&source]);
            let mut packets = published(&mut source, bytes(n), false);
            assert_eq!(packets.len(), n.div_ceil(GRID).max(1));
            assert!(packets.iter().all(|p| p.payload.len() <= PAYLOAD_BYTES_MAX));
            packets.reverse();
            assert_eq!(delivered(&mut sink, &packets), [bytes(n)], "{n} bytes in {suite}");
        }
    }
}

#[test]
fn a_payload_that_came_in_pieces_opens() {
    let mut source = source(Suite::Standard, 0);
    let mut sink = sink(Suite::Standard, &[&source]);
    let mut packets = published(&mut source, bytes(40_000), false);
    for packet in &mut packets {
        let all = Bytes::from(text(packet));
        packet.payload = Payload(vec![all.slice(..100), all.slice(100..2000), all.slice(2000..)].into());
    }
    assert_eq!(delivered(&mut sink, &packets), [bytes(40_000)]);
}

#[test]
fn a_message_is_delivered_once_however_often_it_comes() {
    let mut source = source(Suite::Standard, 0);
    let mut sink = sink(Suite::Standard, &[&source]);
    let packets = published(&mut source, bytes(40_000), false);
    assert_eq!(sink.handle_packet(&packets[0]), Ok(Delivery::Incomplete));
    assert_eq!(sink.handle_packet(&packets[0]), Err(SinkDrop::DuplicateFragment));
    assert_eq!(delivered(&mut sink, &packets).len(), 1);
    assert_eq!(delivered(&mut sink, &packets).len(), 0);
    assert_eq!(sink.handle_packet(&packets[0]), Err(SinkDrop::Replayed));
    let again = grant(Suite::Standard, 1, &[source.announce()]);
    regranted(&mut sink, SinkId([8; 16]), again);
    assert_eq!(delivered(&mut sink, &packets).len(), 0, "after a change of route");
}

#[test]
fn nothing_waits_without_more_and_a_batch_is_signed_once() {
    let mut source = unrecovered(Suite::Standard, 5);
    let mut sink = sink(Suite::Standard, &[&source]);
    assert_eq!(published(&mut source, bytes(10), false).len(), 1);
    // Message 1 was not seen by the sink; the rest comes in one batch.
    for n in 2..=10 {
        assert_eq!(published(&mut source, bytes(n), true).len(), 0);
    }
    let packets = published(&mut source, bytes(11), false);
    assert_eq!(packets.len(), 10);
    let all: Vec<_> = (2..=11).map(bytes).collect();
    assert_eq!(delivered(&mut sink, &packets), all);
    assert_eq!(sink.signatures_checked(), 1);
    assert_eq!(published(&mut source, bytes(1), true).len(), 0);
    assert_eq!(flushed(&mut source).len(), 1);
    assert_eq!(flushed(&mut source).len(), 0);
    // A refused message takes along the ones that waited before it.
    published(&mut source, bytes(1), true);
    let mut packets = Vec::new();
    let too_large = vec![0; sgc_wire::MESSAGE_BYTES_MAX as usize + 1];
    let error = source.publish(&HEAD, too_large.into(), false, |p| packets.push(p)).unwrap_err();
    assert!(matches!(error, PublishError::TooLarge { .. }));
    assert_eq!(packets.len(), 1);
}

#[test]
fn batches_are_full_at_64_packets_and_leave() {
    for suite in [Suite::Standard, Suite::Group] {
        let mut source = source(suite, 0);
        let mut sink = sink(suite, &[&source]);
        let mut packets = Vec::new();
        for n in 0..BATCH_PACKETS_MAX {
            packets.extend(published(&mut source, bytes(n), true));
        }
        assert_eq!(packets.len(), 64, "{suite}");
        assert_eq!(delivered(&mut sink, &packets).len(), 64);
    }
    let mut source = source(Suite::Standard, 0);
    let mut sink = sink(Suite::Standard, &[&source]);
    let packets = published(&mut source, bytes(2 << 20), true);
    assert_eq!(packets.len(), 128);
    assert_eq!(delivered(&mut sink, &packets).len(), 1);
    assert_eq!(sink.signatures_checked(), 2);
}

#[test]
fn incomplete_messages_are_bounded_and_counted() {
    let mut source = unrecovered(Suite::Standard, 5);
    let limits = SinkLimits { partial_bytes_max: 200_000, ..SinkLimits::default() };
    let announced = grant(Suite::Standard, 1, &[source.announce()]);
    let mut sink = Sink::new(NAME, SINK, announced, false, limits);
    for _ in 0..10 {
        let packets = published(&mut source, bytes(40_000), false);
        assert_eq!(sink.handle_packet(&packets[0]), Ok(Delivery::Incomplete));
    }
    assert_eq!(sink.incomplete(), 6);
    let packets = published(&mut source, bytes(40_001), false);
    assert_eq!(sink.handle_packet(&packets[0]), Err(SinkDrop::PartialsFull));
    let last = published(&mut source, bytes(5), false);
    assert_eq!(delivered(&mut sink, &last).len(), 1);
    assert_eq!(sink.incomplete(), 10);
    let packets = published(&mut source, bytes(200_000), false);
    assert_eq!(delivered(&mut sink, &packets).len(), 1);
}

#[test]
fn a_source_cannot_take_the_room_for_incomplete_messages_of_others() {
    let mut sources: Vec<_> = (1..=3).map(|id| unrecovered(Suite::Standard, id)).collect();
    let limits = SinkLimits { partial_bytes_max: 200_000, ..SinkLimits::default() };
    let announces: Vec<_> = sources.iter().map(Source::announce).collect();
    let mut sink = Sink::new(NAME, SINK, grant(Suite::Standard, 1, &announces), false, limits);
    let greedy: Vec<_> = (0..4).map(|_| published(&mut sources[0], bytes(50_000), false)).collect();
    for packets in &greedy {
        assert_eq!(sink.handle_packet(&packets[0]), Ok(Delivery::Incomplete));
    }
    // Alone a source may use all the room. When two come, each has its share, and the oldest messages of the first give
    // way.
    let first = published(&mut sources[1], bytes(60_000), false);
    assert_eq!(sink.handle_packet(&first[0]), Ok(Delivery::Incomplete));
    assert_eq!(sink.incomplete(), 2);
    let second = published(&mut sources[2], bytes(60_000), false);
    assert_eq!(sink.handle_packet(&second[0]), Ok(Delivery::Incomplete));
    assert_eq!(sink.incomplete(), 3);
    // The source does not displace them in return.
    for packets in &greedy[..3] {
        assert_eq!(sink.handle_packet(&packets[0]), Err(SinkDrop::PartialsFull));
    }
    let more = published(&mut sources[0], bytes(33_000), false);
    assert_eq!(sink.handle_packet(&more[0]), Err(SinkDrop::PartialsFull));
    assert_eq!(sink.incomplete(), 3);
    assert_eq!(delivered(&mut sink, &first[1..]), [bytes(60_000)]);
    assert_eq!(delivered(&mut sink, &second[1..]), [bytes(60_000)]);
    assert_eq!(delivered(&mut sink, &greedy[3][1..]), [bytes(50_000)]);
}

#[test]
fn a_late_joiner_gets_the_history_first_and_each_message_once() {
    for suite in Suite::ALL {
        let mut source = source(suite, 3);
        for n in 1..=5 {
            published(&mut source, bytes(n), false);
        }
        let late = grant(suite, 1, &[source.announce()]);
        assert_eq!((late.sources[0].oldest, late.sources[0].next), (3, 6));
        let mut sink = Sink::new(NAME, SINK, late.clone(), true, SinkLimits::default());
        assert_eq!(sink.unsynced().collect::<Vec<_>>(), [source.id()]);
        let live = published(&mut source, bytes(6), false);
        assert_eq!(sink.handle_packet(&live[0]), Ok(Delivery::NeedsHistory(source.id())));
        assert_eq!(sink.handle_packet(&live[0]), Err(SinkDrop::AwaitingHistory));
        // All messages from before its join, and the ones since.
        assert_eq!(sink.ask(source.id()), Some(3));
        let history = replayed_to(&mut source, SINK, 3);
        assert_eq!(delivered(&mut sink, &history), [3, 4, 5, 6].map(bytes));
        assert_eq!(sink.unsynced().count(), 0);
        assert_eq!(delivered(&mut sink, &live).len(), 0);
        let next = published(&mut source, bytes(7), false);
        assert_eq!(delivered(&mut sink, &next), [bytes(7)]);
        // The route changed: only lost messages, nothing twice.
        let here = grant(suite, 1, &[source.announce()]);
        regranted(&mut sink, SinkId([3; 16]), here);
        assert_eq!(sink.unsynced().count(), 0, "nothing was lost");
        published(&mut source, bytes(8), false);
        let id = SinkId([4; 16]);
        regranted(&mut sink, id, grant(suite, 1, &[source.announce()]));
        assert_eq!(sink.ask(source.id()), Some(8));
        let history = replayed_to(&mut source, id, 8);
        assert_eq!((history.len(), delivered(&mut sink, &history)), (2, vec![bytes(8)]));
        assert_eq!(sink.unsynced().count(), 0);
    }
}

#[test]
fn history_is_bounded_in_bytes_but_keeps_the_newest() {
    let mut source = source_with(Suite::Group, SourceConfig { history_bytes_max: 1000, ..config(5, 100) });
    for _ in 0..50 {
        published(&mut source, bytes(400), false);
    }
    assert_eq!(replayed(&mut source).len(), 2 + 1);
    assert_eq!(source.announce().oldest, 49);
    published(&mut source, bytes(5000), false);
    assert_eq!(replayed(&mut source).len(), 1 + 1);
}

#[test]
fn a_sink_that_begins_anew_with_a_source_gets_its_history_again_and_nothing_else() {
    let mut source = source(Suite::Standard, 2);
    let all = grant(Suite::Standard, 1, &[source.announce()]);
    let mut sink = Sink::new(NAME, SINK, all, true, SinkLimits::default());
    assert_eq!(delivered(&mut sink, &replayed(&mut source)).len(), 0);
    let live: Vec<_> = (1..=3).flat_map(|n| published(&mut source, bytes(n), false)).collect();
    assert_eq!(delivered(&mut sink, &live).len(), 3);
    sink.forget(&source.id());
    assert_eq!(sink.unsynced().count(), 1);
    assert_eq!(sink.handle_packet(&live[2]), Err(SinkDrop::BelowFloor));
    assert_eq!(delivered(&mut sink, &replayed(&mut source)), [bytes(2), bytes(3)]);
    assert_eq!(sink.handle_packet(&live[2]), Err(SinkDrop::BelowFloor));
}

#[test]
fn progress_is_seen_without_the_source() {
    let mut source = source(Suite::Standard, 2);
    let progress = source.progress();
    assert_eq!((progress.announce().oldest, progress.announce().next), (1, 1));
    for _ in 0..5 {
        published(&mut source, bytes(1), false);
    }
    let announced = progress.announce();
    assert_eq!((announced.oldest, announced.next, progress.published()), (4, 6, 5));
    assert_eq!(announced.key, message_key(Suite::Standard).public());
    assert_eq!(announced, source.announce());
}

#[test]
fn a_source_takes_no_key_of_another_suite() {
    let ed25519 = message_key(Suite::Standard);
    assert!(Source::new(config(1, 0), &grant(Suite::Paper, 1, &[]), ed25519.clone()).is_none());
    assert!(Source::new(config(1, 0), &grant(Suite::Group, 1, &[]), ed25519.clone()).is_none());
    let unknown = TopicGrant { suite: 99, ..grant(Suite::Standard, 1, &[]) };
    assert!(Source::new(config(1, 0), &unknown, ed25519).is_none());
}

#[test]
fn the_mark_of_synchrony_is_no_message_and_no_message_is_the_mark() {
    let mut source = source(Suite::Group, 1);
    let announced = grant(Suite::Group, 1, &[source.announce()]);
    let mut sink = Sink::new(NAME, SINK, announced, true, SinkLimits::default());
    let head = MessageHead::new(MessageKind::Synced, 0);
    source.publish(&head, Bytes::new(), false, |_| {}).unwrap();
    let history = replayed(&mut source);
    assert_eq!(sink.handle_packet(&history[0]), Err(SinkDrop::Head));
    assert_eq!(sink.unsynced().count(), 1);
    assert_eq!(sink.handle_packet(&history[1]), Ok(Delivery::Synced(source.id())));
}
