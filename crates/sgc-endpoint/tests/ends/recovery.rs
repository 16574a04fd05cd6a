//! Recovery: the messages that a sink asks for, those that it gets, and those that stay lost.

use super::*;

const SUITE: Suite = Suite::Group;

/// A source with room for few messages, and a sink that was there from the beginning.
fn ends(messages_max: usize) -> (Source, Sink) {
    let recovery = RecoveryLimits { messages_max, bytes_max: 1 << 20 };
    let source = source_with(SUITE, SourceConfig { recovery, ..config(5, 0) });
    let sink = sink(SUITE, &[&source]);
    (source, sink)
}

fn marked(source: &mut Source) -> Vec<Packet> {
    let mut packets = Vec::new();
    source.mark(|p| packets.push(p));
    packets
}

/// Asks for missing messages, hands over the answer, and returns the results.
fn recovered(source: &mut Source, sink: &mut Sink) -> Vec<Bytes> {
    let from = sink.ask(source.id()).expect("something is missing");
    delivered(sink, &replayed_to(source, SINK, from))
}

#[test]
fn a_gap_is_asked_for_and_filled_in_order() {
    for suite in Suite::ALL {
        let mut source = source(suite, 0);
        let mut sink = sink(suite, &[&source]);
        let packets: Vec<_> = (1..=6).map(|n| published(&mut source, bytes(n), false).remove(0)).collect();
        assert_eq!(delivered(&mut sink, &packets[..2]), [1, 2].map(bytes));
        assert_eq!(sink.handle_packet(&packets[3]), Ok(Delivery::NeedsHistory(source.id())));
        assert_eq!(sink.handle_packet(&packets[4]), Err(SinkDrop::AwaitingHistory));
        assert_eq!(sink.unsynced().collect::<Vec<_>>(), [source.id()]);
        assert_eq!(sink.ask(source.id()), Some(3));
        let answer = replayed_to(&mut source, SINK, 3);
        assert_eq!(answer.len(), 4 + 1, "nothing that is here");
        assert_eq!(delivered(&mut sink, &answer), [3, 4, 5, 6].map(bytes), "{suite}");
        assert_eq!((sink.unsynced().count(), sink.ask(source.id())), (0, None));
        // Late messages, on any route, are past.
        for late in &packets[2..] {
            assert_eq!(sink.handle_packet(late), Err(SinkDrop::Replayed));
        }
        assert_eq!(delivered(&mut sink, &published(&mut source, bytes(7), false)), [bytes(7)]);
    }
}

#[test]
fn a_message_of_which_a_part_was_lost_is_asked_for_from_its_beginning() {
    let (mut source, mut sink) = ends(100);
    let large = published(&mut source, bytes(100_000), false);
    assert_eq!(delivered(&mut sink, &large[..3]).len(), 0);
    let next = published(&mut source, bytes(1), false);
    assert_eq!(sink.handle_packet(&next[0]), Ok(Delivery::NeedsHistory(source.id())));
    // The rest comes late over another route, while the answer is in flight.
    assert_eq!(sink.handle_packet(&large[3]), Err(SinkDrop::AwaitingHistory));
    assert_eq!(recovered(&mut source, &mut sink), [bytes(100_000), bytes(1)]);
    // A part of the next message is no gap as long as nothing came after it.
    let large = published(&mut source, bytes(50_000), false);
    assert_eq!(sink.handle_packet(&large[1]), Ok(Delivery::Incomplete));
    assert_eq!(delivered(&mut sink, &large), [bytes(50_000)]);
}

#[test]
fn another_way_asks_for_what_was_published_meanwhile_and_no_more() {
    for depth in [0, 3] {
        let mut source = source(SUITE, depth);
        let grant_now = |source: &Source| grant(SUITE, 1, &[source.announce()]);
        let mut sink = Sink::new(NAME, SINK, grant_now(&source), depth > 0, SinkLimits::default());
        if depth > 0 {
            assert!(recovered(&mut source, &mut sink).is_empty());
        }
        for n in 1..=5 {
            let packets = published(&mut source, bytes(n), false);
            assert_eq!(delivered(&mut sink, &packets).len(), 1);
        }
        // Nothing was lost: nothing is asked for, and the half message is completed over the new route.
        let large = published(&mut source, bytes(40_000), false);
        delivered(&mut sink, &large[..1]);
        let before = SourceAnnounce { next: 6, ..source.announce() };
        regranted(&mut sink, SinkId([2; 16]), grant(SUITE, 1, &[before]));
        assert_eq!(sink.unsynced().count(), 0);
        assert_eq!(delivered(&mut sink, &large[1..]).len(), 1);
        // Ten were lost, more than late joiners get, and then there was silence.
        for n in 1..=10 {
            published(&mut source, bytes(n), false);
        }
        let id = SinkId([3; 16]);
        regranted(&mut sink, id, grant_now(&source));
        assert_eq!(sink.ask(source.id()), Some(7), "depth {depth}");
        let answer = replayed_to(&mut source, id, 7);
        assert_eq!(delivered(&mut sink, &answer), (1..=10).map(bytes).collect::<Vec<_>>());
        // A grant on the same route tells nothing about packets in flight.
        published(&mut source, bytes(1), false);
        regranted(&mut sink, id, grant_now(&source));
        assert_eq!(sink.unsynced().count(), 0);
    }
}

#[test]
fn a_late_joiner_gets_its_depth_though_more_is_kept() {
    let mut source = source(SUITE, 2);
    for n in 1..=5 {
        published(&mut source, bytes(n), false);
        marked(&mut source);
    }
    let mut sink =
        Sink::new(NAME, SINK, grant(SUITE, 1, &announced(&[&source])), true, SinkLimits::default());
    assert_eq!(recovered(&mut source, &mut sink), [4, 5].map(bytes));
    // A sink that begins anew gets no more either.
    sink.forget(&source.id());
    assert_eq!(sink.ask(source.id()), Some(0));
    assert_eq!(delivered(&mut sink, &replayed(&mut source)), [4, 5].map(bytes));
    // A volatile topic has no history.
    let mut source = source_with(SUITE, config(6, 0));
    published(&mut source, bytes(1), false);
    let mut fresh = self::sink(SUITE, &[&source]);
    let all = replayed_to(&mut source, SINK, 1);
    assert_eq!(fresh.handle_packet(&all[0]), Err(SinkDrop::BelowFloor));
    assert_eq!(replayed(&mut source).len(), 1, "a late joiner is sent nothing of it");
}

#[test]
fn a_mark_shows_what_was_lost_before_a_silence_and_is_no_message() {
    let (mut source, mut sink) = ends(100);
    assert_eq!(marked(&mut source).len(), 0, "nothing was published");
    delivered(&mut sink, &published(&mut source, bytes(1), false));
    published(&mut source, bytes(2), false);
    let (published_before, marks) = (source.progress().last_message(), marked(&mut source));
    assert_eq!((marks.len(), source.progress().last_message()), (1, published_before));
    assert_eq!(sink.handle_packet(&marks[0]), Ok(Delivery::NeedsHistory(source.id())));
    assert_eq!(recovered(&mut source, &mut sink), [bytes(2)]);
    for _ in 0..3 {
        assert_eq!(sink.handle_packet(&marked(&mut source)[0]), Ok(Delivery::Mark));
    }
    assert_eq!(delivered(&mut sink, &published(&mut source, bytes(3), false)), [bytes(3)]);
    // A lost mark is recovered like a message.
    marked(&mut source);
    let next = published(&mut source, bytes(4), false);
    assert_eq!(sink.handle_packet(&next[0]), Ok(Delivery::NeedsHistory(source.id())));
    assert_eq!(recovered(&mut source, &mut sink), [bytes(4)]);
}

#[test]
fn messages_that_a_source_no_longer_keeps_are_counted_and_passed_over() {
    for live in [true, false] {
        let (mut source, mut sink) = ends(4);
        delivered(&mut sink, &published(&mut source, bytes(1), false));
        for n in 2..=20 {
            published(&mut source, bytes(n), false);
        }
        if live {
            let next = published(&mut source, bytes(21), false);
            assert_eq!(sink.handle_packet(&next[0]), Ok(Delivery::NeedsHistory(source.id())));
        } else {
            let id = SINK;
            regranted(&mut sink, SinkId([3; 16]), grant(SUITE, 1, &[source.announce()]));
            regranted(&mut sink, id, grant(SUITE, 1, &[source.announce()]));
        }
        assert_eq!(sink.ask(source.id()), Some(2));
        let answer = replayed_to(&mut source, SINK, 2);
        // The mark about it, to all and to this sink, is itself one of the four kept messages.
        let first = if live { 19 } else { 18 };
        assert_eq!((answer[0].header.to, answer[1].header.to), (None, Some(SINK)));
        assert_eq!(sink.handle_packet(&answer[1]), Ok(Delivery::Lost(source.id(), first - 2)));
        let rest: Vec<_> = (first as usize..=if live { 21 } else { 20 }).map(bytes).collect();
        assert_eq!(delivered(&mut sink, &answer[2..]), rest);
        assert_eq!(sink.unsynced().count(), 0);
        assert_eq!(delivered(&mut sink, &published(&mut source, bytes(30), false)), [bytes(30)]);
        // A second question repeats no delivery.
        assert_eq!(delivered(&mut sink, &replayed_to(&mut source, SINK, 2)).len(), 0);
    }
}

#[test]
fn an_answer_with_a_hole_is_asked_for_again() {
    let (mut source, mut sink) = ends(100);
    let all: Vec<_> = (1..=8).map(|n| published(&mut source, bytes(n), false).remove(0)).collect();
    assert!(matches!(sink.handle_packet(&all[7]), Ok(Delivery::NeedsHistory(_))));
    assert_eq!(sink.ask(source.id()), Some(1));
    let mut answer = replayed_to(&mut source, SINK, 1);
    answer.remove(3);
    assert_eq!(delivered(&mut sink, &answer), [1, 2, 3].map(bytes));
    assert_eq!(sink.unsynced().count(), 1, "its end says nothing");
    assert_eq!(sink.ask_again(source.id()), AskAgain::From(4));
    assert_eq!(recovered(&mut source, &mut sink), [4, 5, 6, 7, 8].map(bytes));
    // A message whose last fragment was lost shows with the next message.
    for n in 9..=12 {
        published(&mut source, bytes(n), false);
    }
    regranted(&mut sink, SinkId([3; 16]), grant(SUITE, 1, &[source.announce()]));
    assert_eq!(sink.ask(source.id()), Some(9));
    let mut answer = replayed_to(&mut source, SinkId([3; 16]), 9);
    answer.drain(2..4);
    assert_eq!(delivered(&mut sink, &answer), [9, 10].map(bytes));
    let next = published(&mut source, bytes(13), false);
    assert_eq!(sink.handle_packet(&next[0]), Ok(Delivery::NeedsHistory(source.id())));
    assert_eq!(sink.ask(source.id()), Some(11));
}

#[test]
fn an_answer_that_is_on_its_way_is_waited_for() {
    let (mut source, mut sink) = ends(100);
    let large = published(&mut source, bytes(200_000), false);
    let next = published(&mut source, bytes(1), false);
    assert!(matches!(sink.handle_packet(&next[0]), Ok(Delivery::NeedsHistory(_))));
    assert_eq!(sink.ask(source.id()), Some(1));
    assert_eq!(sink.ask_again(source.id()), AskAgain::From(1), "nothing came");
    let answer = replayed_to(&mut source, SINK, 1);
    for packet in &answer[..large.len() - 1] {
        assert_eq!(sink.handle_packet(packet), Ok(Delivery::Incomplete));
        assert_eq!(sink.ask_again(source.id()), AskAgain::Wait);
    }
    assert_eq!(sink.ask_again(source.id()), AskAgain::From(1), "it stands still");
    assert_eq!(delivered(&mut sink, &answer[large.len() - 1..]).len(), 2);
    assert_eq!(sink.ask_again(source.id()), AskAgain::No);
}

/// A recorded sign of a history's end, sent too early, gains nothing.
#[test]
fn an_end_that_is_played_again_loses_nothing() {
    let mut source = source(SUITE, 5);
    let mut sink =
        Sink::new(NAME, SINK, grant(SUITE, 1, &announced(&[&source])), true, SinkLimits::default());
    let end = replayed(&mut source);
    for n in 1..=4 {
        published(&mut source, bytes(n), false);
    }
    assert_eq!(sink.handle_packet(&end[0]), Ok(Delivery::Synced(source.id())));
    let next = published(&mut source, bytes(5), false);
    assert_eq!(sink.handle_packet(&next[0]), Ok(Delivery::NeedsHistory(source.id())));
    assert_eq!(recovered(&mut source, &mut sink), [1, 2, 3, 4, 5].map(bytes));
}

#[test]
fn messages_recorded_without_a_listener_can_be_recovered() {
    for suite in [Suite::Group, Suite::Standard] {
        let mut source = source(suite, 0);
        let mut sink = sink(suite, &[&source]);
        delivered(&mut sink, &published(&mut source, bytes(1), false));
        source.record(&HEAD, bytes(2)).unwrap();
        source.record(&HEAD, bytes(40_000)).unwrap();
        let next = published(&mut source, bytes(3), false);
        assert_eq!(sink.handle_packet(&next[0]), Ok(Delivery::NeedsHistory(source.id())));
        assert_eq!(recovered(&mut source, &mut sink), [bytes(2), bytes(40_000), bytes(3)]);
    }
}

#[test]
fn a_best_effort_source_is_asked_for_nothing() {
    let config = SourceConfig { reliable: false, ..config(5, 0) };
    let mut source = source_with(SUITE, config);
    let mut sink = sink(SUITE, &[&source]);
    let packets: Vec<_> = (1..=5).map(|n| published(&mut source, bytes(n), false).remove(0)).collect();
    assert_eq!(delivered(&mut sink, &packets[3..]), [4, 5].map(bytes));
    assert_eq!(sink.handle_packet(&packets[0]), Err(SinkDrop::Late), "in order or not at all");
    regranted(&mut sink, SinkId([3; 16]), grant(SUITE, 1, &[source.announce()]));
    assert_eq!(sink.unsynced().count(), 0);
    assert_eq!(marked(&mut source).len(), 0);
    assert_eq!(replayed_to(&mut source, SINK, 1).len(), 1, "it keeps nothing");
}

/// A node that was granted the topic late, and claims to have been there before, gets its floor from the owner.
#[test]
fn a_floor_that_rose_is_passed_over_and_counted() {
    let (mut source, mut sink) = ends(100);
    for n in 1..=9 {
        published(&mut source, bytes(n), false);
    }
    let announce = SourceAnnounce { recover: 7, ..source.announce() };
    let id = SinkId([3; 16]);
    let said = regranted(&mut sink, id, grant(SUITE, 1, &[announce]));
    assert_eq!(said, [Ok(Delivery::Lost(source.id(), 6))]);
    assert_eq!(sink.ask(source.id()), Some(7));
    assert_eq!(delivered(&mut sink, &replayed_to(&mut source, id, 7)), [7, 8, 9].map(bytes));
}

#[test]
fn sink_confirms_when_everything_up_to_the_question_is_there() {
    let (mut source, mut sink) = ends(100);
    let question = |source: &mut Source| {
        let mut packets = Vec::new();
        source.ask_for_confirmation(|p| packets.push(p));
        packets
    };
    assert!(question(&mut source).is_empty(), "nothing was published");
    let first = published(&mut source, bytes(1), false);
    assert_eq!(delivered(&mut sink, &first), [bytes(1)]);
    let asked = question(&mut source);
    assert_eq!(sink.handle_packet(&asked[0]), Ok(Delivery::Confirm(source.id(), 2)));
    assert_eq!(sink.handle_packet(&asked[0]), Err(SinkDrop::Replayed));
    assert_eq!(source.progress().last_message(), 1, "a question is no message");
    // Something is missing: the sink asks for it, and confirms behind it.
    published(&mut source, bytes(3), false);
    let asked = question(&mut source);
    assert_eq!(sink.handle_packet(&asked[0]), Ok(Delivery::NeedsHistory(source.id())));
    let from = sink.ask(source.id()).unwrap();
    let answer = replayed_to(&mut source, SINK, from);
    let results: Vec<_> = answer.iter().map(|packet| sink.handle_packet(packet)).collect();
    assert!(matches!(&results[0], Ok(Delivery::Message(message)) if message.seq == 3), "{results:?}");
    assert_eq!(results[1..], [Ok(Delivery::Confirm(source.id(), 4)), Ok(Delivery::Synced(source.id()))]);
}

#[test]
fn source_that_recovers_nothing_asks_for_no_confirmation() {
    let mut source = unrecovered(SUITE, 5);
    published(&mut source, bytes(1), false);
    source.ask_for_confirmation(|packet| panic!("{:?}", packet.header));
}
